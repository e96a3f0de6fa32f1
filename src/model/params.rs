//! All parameters as one block with named spans, so that the optimiser, checkpoints, gradient norms and tests are each one loop.
//!
//! Weight-normalised layers keep direction v and length g in the block; the matrices that kernels multiply by, W = g·v/‖v‖, stand in
//! a second, small block that is refreshed at the beginning of a step and whose gradient is folded back at its end.

use super::half_copy::HalfCopy;
use crate::Result;
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, PtrMut, Recorder, Work};
use crate::kernels::{self, WeightRow, weight_norm_backward, weight_norm_forward};
use crate::random;

/// Which optimiser settings a span follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Group {
    /// Networks and appearance codes of the surface.
    Fields,
    /// The SDF's hash table.
    Table,
    /// Both proposal networks.
    Proposal,
    /// Everything of the background.
    Background,
}

/// First values of a span.
pub enum Init {
    /// Given values, row-major.
    Values(Vec<f32>),
    /// U(−half_range, half_range), drawn by position from the seed.
    Uniform { half_range: f32 },
}

/// A named part of the parameter block.
#[derive(Clone, Debug, PartialEq)]
pub struct Span {
    pub name: String,
    pub group: Group,
    /// Element offset in the block.
    pub first: u64,
    /// Row-major shape, innermost last.
    pub shape: Vec<u64>,
}

impl Span {
    /// Number of elements.
    pub fn len(&self) -> u64 {
        self.shape.iter().product()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A matrix and bias as kernels use them: where the values stand and where their gradients go.
#[derive(Clone, Copy, Debug)]
pub struct WeightHandle {
    pub weight: WeightAt,
    /// Element offset of the bias in the parameter block, if the layer has one.
    pub bias: Option<u64>,
}

impl WeightHandle {
    /// The matrix alone.
    pub fn without_bias(self) -> WeightHandle {
        WeightHandle { bias: None, ..self }
    }
}

/// Where a matrix stands.
#[derive(Clone, Copy, Debug)]
pub enum WeightAt {
    /// In the parameter block itself.
    Plain(u64),
    /// In the block of effective weights.
    Normalised(u64),
}

/// What the model will hold; filled in by its parts, then turned into device memory once.
#[derive(Default)]
pub struct ParamsPlan {
    spans: Vec<(Span, Init)>,
    rows: Vec<WeightRow>,
    len: u64,
    effective_len: u64,
    /// First element of the table that look-ups read in float16, if there is one.
    in_half: Option<u64>,
}

/// Spans begin at multiples of this many elements, so that vector loads stay possible.
const ALIGNMENT: u64 = 8;

impl ParamsPlan {
    /// Adds a span and returns its element offset. Spans of one group must be added in one go.
    pub fn add(&mut self, group: Group, name: impl Into<String>, shape: &[u64], init: Init) -> u64 {
        let span = Span {
            name: name.into(),
            group,
            first: self.len,
            shape: shape.to_vec(),
        };
        if let Init::Values(values) = &init {
            assert_eq!(
                values.len() as u64,
                span.len(),
                "initial values of {}",
                span.name
            );
        }
        if let Some((last, _)) = self.spans.last() {
            let reopened = last.group != group && self.spans.iter().any(|(s, _)| s.group == group);
            assert!(
                !reopened,
                "group {group:?} of {} is not contiguous",
                span.name
            );
        }
        self.len = (self.len + span.len()).next_multiple_of(ALIGNMENT);
        let first = span.first;
        self.spans.push((span, init));
        first
    }

    /// Adds a weight-normalised matrix `[rows, columns]` (spans `name.v`, `name.g`, `name.bias`); g starts as ‖v‖. `released`: its last
    /// columns belong to hash levels that the network may not see yet.
    pub fn add_normalised(
        &mut self,
        group: Group,
        name: &str,
        columns: u64,
        v: Vec<f32>,
        bias: Vec<f32>,
        released: bool,
    ) -> WeightHandle {
        let rows = bias.len() as u64;
        let lengths: Vec<f32> = v
            .chunks(columns as usize)
            .map(|row| {
                row.iter()
                    .map(|&x| f64::from(x) * f64::from(x))
                    .sum::<f64>()
                    .sqrt() as f32
            })
            .collect();
        let v_first = self.add(
            group,
            format!("{name}.v"),
            &[rows, columns],
            Init::Values(v),
        );
        let g_first = self.add(group, format!("{name}.g"), &[rows], Init::Values(lengths));
        let bias_first = self.add(group, format!("{name}.bias"), &[rows], Init::Values(bias));
        let weight = self.effective_len;
        for row in 0..rows {
            self.rows.push(WeightRow {
                v: (v_first + row * columns) as u32,
                g: (g_first + row) as u32,
                weight: (weight + row * columns) as u32,
                columns: columns as u32,
                released: u32::from(released),
            });
        }
        self.effective_len = (weight + rows * columns).next_multiple_of(ALIGNMENT);
        WeightHandle {
            weight: WeightAt::Normalised(weight),
            bias: Some(bias_first),
        }
    }

    /// Adds a plain matrix without bias.
    pub fn add_plain(
        &mut self,
        group: Group,
        name: &str,
        rows: u64,
        columns: u64,
        values: Vec<f32>,
    ) -> WeightHandle {
        let first = self.add(group, name, &[rows, columns], Init::Values(values));
        WeightHandle {
            weight: WeightAt::Plain(first),
            bias: None,
        }
    }

    /// Look-ups read the table at this element, which has features in pairs, in float16.
    pub fn keep_half(&mut self, table: u64) {
        self.in_half = Some(table);
    }

    /// Elements in the block.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// Whether nothing has been added.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Allocates the block, where it `learns` with gradients and moments, and uploads the initial values.
    pub fn build(self, gpu: &Gpu, seed: u32, learns: bool) -> Result<Params> {
        let values = gpu.buffer::<f32>("params", self.len)?;
        for (span, init) in &self.spans {
            match init {
                Init::Values(v) => gpu.upload(&values, span.first, v)?,
                Init::Uniform { half_range } => {
                    upload_uniform(gpu, &values, span, *half_range, seed)?
                }
            }
        }
        let row_table = gpu.buffer::<WeightRow>("weight rows", self.rows.len().max(1) as u64)?;
        gpu.upload(&row_table, 0, &self.rows)?;
        // A sum takes 64 bits where its order must not count (glsl/lib/sums.glsl).
        let width = if gpu.deterministic() { 2 } else { 1 };
        let learning = match learns {
            true => Some(Learning {
                grads: gpu.buffer("gradients", self.len * width)?,
                first_moment: gpu.buffer("first moments", self.len)?,
                second_moment: gpu.buffer("second moments", self.len)?,
            }),
            false => None,
        };
        let of_table = |table| {
            // (An empty span may begin at the same place.)
            let is_table = |span: &&Span| span.first == table && !span.is_empty();
            let span = self.spans.iter().map(|(span, _)| span).find(is_table);
            let span = span.expect("a table is a span");
            HalfCopy::new(gpu, span.first..span.first + span.len())
        };
        let params = Params {
            half: self.in_half.map(of_table).transpose()?,
            learning,
            effective: gpu.buffer("effective weights", self.effective_len.max(1))?,
            d_effective: gpu.buffer(
                "effective weight gradients",
                self.effective_len.max(1) * width,
            )?,
            width,
            row_table,
            n_rows: self.rows.len() as u64,
            forward: gpu.kernel(weight_norm_forward::Shape::default())?,
            backward: gpu.kernel(weight_norm_backward::Shape::default())?,
            values,
            spans: self.spans.into_iter().map(|(span, _)| span).collect(),
        };
        params.refresh_copy(gpu)?;
        Ok(params)
    }
}

/// Draws a span's values in pieces, so that a table of gigabytes needs no second copy on the host.
fn upload_uniform(
    gpu: &Gpu,
    values: &Buffer<f32>,
    span: &Span,
    half_range: f32,
    seed: u32,
) -> Result<()> {
    const PIECE: u64 = 1 << 22;
    let mut first = 0;
    while first < span.len() {
        let count = PIECE.min(span.len() - first);
        let piece: Vec<f32> = (first..first + count)
            .map(|i| (2.0 * uniform(seed, span.first + i) - 1.0) as f32 * half_range)
            .collect();
        gpu.upload(values, span.first + first, &piece)?;
        first += count;
    }
    Ok(())
}

/// A uniform in [0, 1) as a function of (seed, index < 2³²).
pub(super) fn uniform(seed: u32, index: u64) -> f64 {
    let seed = u64::from(seed.rotate_left(8)) << 32;
    let nth = index.wrapping_add(seed).wrapping_add(1);
    random::unit(random::mix(nth.wrapping_mul(random::STEP)))
}

/// Initial values drawn one after another from a seed and a purpose.
pub(super) struct Draws {
    seed: u32,
    next: u64,
}

impl Draws {
    /// A sequence of its own for each purpose.
    pub(super) fn new(seed: u32, purpose: &str) -> Self {
        let hash = purpose.bytes().fold(0xcbf2_9ce4_8422_2325u64, |h, b| {
            (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3)
        });
        Draws { seed, next: hash }
    }

    /// U(−half_range, half_range).
    pub(super) fn symmetric(&mut self, half_range: f64) -> f32 {
        self.next = self.next.wrapping_add(1);
        ((2.0 * uniform(self.seed, self.next) - 1.0) * half_range) as f32
    }

    /// N(mean, deviation), by Box and Muller.
    pub(super) fn normal(&mut self, mean: f64, deviation: f64) -> f32 {
        self.next = self.next.wrapping_add(2);
        let radius = (-2.0 * (1.0 - uniform(self.seed, self.next)).ln()).sqrt();
        let angle = std::f64::consts::TAU * uniform(self.seed, self.next.wrapping_sub(1));
        (mean + deviation * radius * angle.cos()) as f32
    }
}

/// What a block that learns has beside its values.
struct Learning {
    /// [len] sums; between steps zero, but for those of a lazily updated table.
    grads: Buffer<f32>,
    first_moment: Buffer<f32>,  // [len]
    second_moment: Buffer<f32>, // [len]
}

/// The parameter block on the device.
pub struct Params {
    spans: Vec<Span>,
    values: Buffer<f32>, // [len]
    half: Option<HalfCopy>,
    learning: Option<Learning>,
    effective: Buffer<f32>, // [effective_len] W of every weight-normalised layer
    d_effective: Buffer<f32>, // [effective_len] sums, zero between steps
    /// Float32 words of a sum.
    width: u64,
    row_table: Buffer<WeightRow>,
    n_rows: u64,
    forward: Kernel<kernels::weight_norm_forward::Args>,
    backward: Kernel<kernels::weight_norm_backward::Args>,
}

impl Params {
    /// The named parts, in order.
    pub fn spans(&self) -> &[Span] {
        &self.spans
    }

    /// The span called `name`.
    pub fn span(&self, name: &str) -> Option<&Span> {
        self.spans.iter().find(|s| s.name == name)
    }

    /// Element range of a group, or `None` if the model has nothing in it.
    pub fn group(&self, group: Group) -> Option<std::ops::Range<u64>> {
        let mut of_group = self.spans.iter().filter(|s| s.group == group);
        let first = of_group.next()?;
        let last = of_group.next_back().unwrap_or(first);
        Some(first.first..last.first + last.len())
    }

    /// Values, and where the block learns gradients, first and second moments, each `[len]`. (On a deterministic device, gradients are not
    /// floats.)
    pub fn values(&self) -> &Buffer<f32> {
        &self.values
    }
    pub fn grads(&self) -> &Buffer<f32> {
        &self.learning().grads
    }
    pub fn first_moment(&self) -> &Buffer<f32> {
        &self.learning().first_moment
    }
    pub fn second_moment(&self) -> &Buffer<f32> {
        &self.learning().second_moment
    }

    fn learning(&self) -> &Learning {
        let learning = self.learning.as_ref();
        learning.expect("a model that was built to be trained")
    }

    /// What look-ups read of the table at this element: its values, or their copy in float16.
    pub fn table(&self, first: u64) -> Ptr<u32> {
        let copy = self.half.as_ref().and_then(|half| half.of(first));
        copy.map_or(self.values.at(first).cast(), |copy| copy.read())
    }

    /// Where the copy of the values from this element on is kept; nowhere if they have none.
    pub fn copy_of(&self, first: u64) -> PtrMut<u32> {
        let copy = self.half.as_ref().and_then(|half| half.of(first));
        copy.unwrap_or(PtrMut::NULL)
    }

    /// The copy in float16 of the table that has one, features in pairs.
    pub fn copy(&self) -> Option<&Buffer<u32>> {
        self.half.as_ref().map(HalfCopy::pairs)
    }

    /// To be called when values were written from outside.
    ///
    /// # Errors
    /// What the device fails with.
    pub fn refresh_copy(&self, gpu: &Gpu) -> Result<()> {
        let Some(half) = &self.half else {
            return Ok(());
        };
        gpu.submit("float16 copy", |rec| {
            half.refresh(rec, &self.values);
            Ok(())
        })?;
        Ok(())
    }

    /// Refreshes the effective weights from v and g. `released_columns`: of matrices with release, those that act.
    pub fn normalise_weights(&self, rec: &mut Recorder, released_columns: u32) {
        let args = weight_norm_forward::Args {
            rows: self.row_table.ptr(),
            params: self.values.ptr(),
            weights: self.effective.ptr_mut(),
            n: self.n_rows as u32,
            released_columns,
        };
        rec.run(&self.forward, Work::items(self.n_rows), args);
    }

    /// Folds the effective weights' gradients back into v and g.
    pub fn fold_gradients(&self, rec: &mut Recorder, released_columns: u32) {
        let args = weight_norm_backward::Args {
            rows: self.row_table.ptr(),
            params: self.values.ptr(),
            d_weights: self.d_effective.ptr_mut(),
            d_params: self.d_value(0),
            n: self.n_rows as u32,
            released_columns,
        };
        rec.run(&self.backward, Work::items(self.n_rows), args);
    }

    /// Matrix values, at an element offset within the matrix.
    pub fn weight(&self, handle: WeightHandle, offset: u64) -> Ptr<f32> {
        match handle.weight {
            WeightAt::Plain(first) => self.values.ptr().offset(first + offset),
            WeightAt::Normalised(first) => self.effective.ptr().offset(first + offset),
        }
    }

    /// Where gradients are accumulated from this element of the block on.
    pub fn d_value(&self, first: u64) -> PtrMut<f32> {
        self.grads().at_mut(first * self.width)
    }

    /// Sets the gradients of these elements to zero.
    pub fn forget_gradients(&self, rec: &mut Recorder, elements: std::ops::Range<u64>) {
        let words = elements.start * self.width..elements.end * self.width;
        rec.fill(self.grads(), words, 0);
    }

    /// Where the matrix's gradient is accumulated.
    pub fn d_weight(&self, handle: WeightHandle, offset: u64) -> PtrMut<f32> {
        match handle.weight {
            WeightAt::Plain(first) => self.d_value(first + offset),
            WeightAt::Normalised(first) => self.d_effective.at_mut((first + offset) * self.width),
        }
    }

    /// Bias values; nowhere if the layer has none.
    pub fn bias(&self, handle: WeightHandle, offset: u64) -> Ptr<f32> {
        match handle.bias {
            Some(first) => self.values.ptr().offset(first + offset),
            None => Ptr::NULL,
        }
    }

    /// Where the bias's gradient is accumulated; nowhere if the layer has none.
    pub fn d_bias(&self, handle: WeightHandle, offset: u64) -> PtrMut<f32> {
        match handle.bias {
            Some(first) => self.d_value(first + offset),
            None => PtrMut::NULL,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::uniform;

    #[test]
    fn every_bit_of_a_seed_counts() {
        for bit in 0..32 {
            assert_ne!(uniform(0, 5), uniform(1 << bit, 5), "bit {bit}");
        }
    }
}
