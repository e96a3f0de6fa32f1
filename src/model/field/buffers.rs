//! The memory of a field's passes.

use super::FieldShape;
use crate::Result;
use crate::gpu::{Buffer, Gpu, PtrMut};
use crate::model::planes::Activations;

/// Points that go back through a field at once: the memory that this takes is theirs alone.
pub(super) const AT_ONCE: u32 = 1 << 16;

/// What one evaluation of a field over `n` points leaves for its backward pass.
pub struct FieldBuffers {
    pub n: u32,
    /// Leading points whose hidden activations are kept for further heads.
    pub n_hidden: u32,
    /// Leading points that go back through the field.
    pub(super) n_back: u32,
    pub inputs: Buffer<f32>, // [inputs, n]
    /// [hidden, n_hidden]; in the backward pass the heads put its gradient in its place.
    pub hidden: Activations,
    pub(super) slope: Option<Slope>,
}

/// The gradient of a field's first output, and what its backward pass reads.
pub struct Slope {
    pub gradient: Buffer<f32>,                   // [3, n] g, per region unit
    pub d_gradient: Buffer<f32>,                 // [3, n]
    pub(super) slopes: Buffer<f32>,              // [inputs, n] a
    pub(super) derivatives: Option<Buffer<f32>>, // [3 · order, hash features, n] of the encoding, where they are kept
    steepness: Option<Buffer<f32>>, // [hidden, m] s of so many points at once, where the network is one of matrices
}

impl Slope {
    pub(super) fn derivatives(&self) -> PtrMut<f32> {
        let kept = self.derivatives.as_ref();
        kept.map_or(PtrMut::NULL, Buffer::ptr_mut)
    }

    pub(super) fn steepness(&self) -> PtrMut<f32> {
        let steepness = self.steepness.as_ref();
        steepness.map_or(PtrMut::NULL, Buffer::ptr_mut)
    }
}

impl FieldBuffers {
    /// Buffers for `n` points of fields of this shape.
    pub fn new(gpu: &Gpu, name: &str, shape: &FieldShape, n: u32, n_hidden: u32) -> Result<Self> {
        let rows_of = |what: &str, channels: u32, points: u32| {
            gpu.scratch(
                &format!("{name} {what}"),
                u64::from(channels) * u64::from(points),
            )
        };
        let planes = |what, channels| rows_of(what, channels, n);
        let slope = match shape.gradient {
            true => Some(Slope {
                gradient: planes("gradient", 3)?,
                d_gradient: planes("d_gradient", 3)?,
                slopes: planes("slopes", shape.inputs())?,
                derivatives: match shape.kept_on(gpu) {
                    0 => None,
                    order => Some(planes("derivatives", 3 * order * shape.grid.outputs())?),
                },
                steepness: match shape.by_matrices_on(gpu)? {
                    true => Some(rows_of("steepness", shape.hidden, n.min(AT_ONCE))?),
                    false => None,
                },
            }),
            false => None,
        };
        Ok(FieldBuffers {
            n,
            n_hidden,
            n_back: n,
            inputs: planes("inputs", shape.inputs())?,
            hidden: Activations::new(gpu, &format!("{name} hidden"), shape.hidden, n_hidden)?,
            slope,
        })
    }

    /// The same, where a loss only compares what the field says of the points behind the leading `n_back`.
    pub fn going_back(self, n_back: u32) -> Self {
        FieldBuffers { n_back, ..self }
    }

    /// The gradient's buffers.
    ///
    /// # Panics
    /// If the field has none.
    pub fn slope(&self) -> &Slope {
        self.slope.as_ref().expect("a field with a gradient")
    }
}

/// Memory that a field's backward pass needs only while it runs, for m points at once; one for all fields.
pub struct Scratch {
    pub(super) d_preactivation: Buffer<f32>, // [hidden, m] of the largest field
    pub(super) d_inputs: Buffer<f32>, // [inputs, m] of the largest field; only the hash features' rows where nobody asks for the others
    pub(super) steepness: Buffer<f32>, // [hidden, m] of the largest field with a gradient: s
    pub(super) tangents: Buffer<f32>, // [inputs, m] of the largest field with a gradient: ȧ
}

impl Scratch {
    /// Enough for each of the given (shape, points).
    pub fn new(gpu: &Gpu, users: &[(FieldShape, u32)]) -> Result<Self> {
        let most = |per_point: fn(&FieldShape) -> u32| {
            let sizes = users
                .iter()
                .map(|(shape, n)| u64::from(per_point(shape)) * u64::from((*n).min(AT_ONCE)));
            sizes.max().unwrap_or(1).max(1)
        };
        Ok(Scratch {
            d_preactivation: gpu.scratch("d_preactivation", most(|s| s.hidden))?,
            d_inputs: gpu.scratch("d_inputs", most(FieldShape::inputs))?,
            steepness: gpu.scratch("steepness", most(|s| s.with_gradient(s.hidden)))?,
            tangents: gpu.scratch("tangents", most(|s| s.with_gradient(s.inputs())))?,
        })
    }
}
