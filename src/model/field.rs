//! A field: hash grid, one hidden layer and a first output. The SDF, the proposal densities and the background density are fields.

use super::forms::Forms;
use super::hash_grid::HashGrid;
use super::layer::{Activation, Layer, LayerShape};
use super::params::{Params, WeightHandle};
use super::planes::Planes;
use crate::Result;
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, PtrMut, Recorder, Work};
use crate::kernels::{
    Level, field_backward, field_forward, field_gradient, field_point_backward, field_tangent,
    hash_grid_backward, hash_grid_backward_owned,
};
use std::ops::Range;

mod buffers;

use buffers::{AT_ONCE, Slope};
pub use buffers::{FieldBuffers, Scratch};

/// Workgroups that encode a level of all points on devices with few cores, each of which reads it into its core's cache first.
const ENCODERS: u32 = 2;

/// What fixes a field's kernels.
#[derive(Clone, Copy, Debug)]
pub struct FieldShape {
    pub grid: HashGrid,
    pub hidden: u32,
    /// The position itself is an input beside its encoding.
    pub coordinates: bool,
    /// softplus(100 u)/100, or ReLU.
    pub softplus: bool,
    /// The first output's gradient with respect to position is asked for, and learned from.
    pub gradient: bool,
    /// Order up to which devices with few cores keep the encoding's derivatives of every point, for 12 bytes a feature, point and order, in
    /// place of looking them up again: 0; 1, all that the gradient needs; 2, those that the points' own gradients need as well.
    pub kept: u32,
    /// Look-ups read a copy of the table in float16 ([`ParamsPlan::keep_half`](super::ParamsPlan::keep_half)).
    pub half: bool,
}

impl FieldShape {
    /// Inputs of the hidden layer.
    pub fn inputs(&self) -> u32 {
        self.grid.outputs() + self.coordinate_inputs()
    }

    fn coordinate_inputs(&self) -> u32 {
        if self.coordinates { 3 } else { 0 }
    }

    /// The same, for points whose gradient nobody asks for.
    pub fn without_gradient(self) -> FieldShape {
        FieldShape {
            gradient: false,
            ..self
        }
    }

    /// Order up to which [`field_forward`] keeps the encoding's derivatives for the kernels of the gradient on this device.
    fn kept_on(&self, gpu: &Gpu) -> u32 {
        match self.gradient && gpu.info().few_cores {
            true => self.kept,
            false => 0,
        }
    }

    /// Whether this device computes the network by cooperative matrices.
    fn by_matrices_on(&self, gpu: &Gpu) -> Result<bool> {
        let form = Forms::of(gpu, self.hidden)?.linear;
        Ok(form.by_matrices([self.inputs(), self.hidden]))
    }

    /// Rows that only fields with a gradient need.
    fn with_gradient(&self, rows: u32) -> u32 {
        if self.gradient { rows } else { 0 }
    }
}

/// A field's parameters and kernels.
pub struct Field {
    pub shape: FieldShape,
    table: u64,
    hidden: WeightHandle,
    heads: WeightHandle,
    levels: Buffer<Level>,
    /// The network's input alone, level by level.
    encoding: Kernel<field_forward::Args>,
    /// The network, together with its input where that is not `apart`.
    forward: Network<field_forward::Args>,
    /// Each level is encoded before the network begins: where the device's caches hold one level of the table but not all, or where the
    /// network is one of matrices.
    apart: bool,
    /// The network's backward pass ends before its first layer, whose inputs' gradients the layer itself computes, all of them.
    by_matrices: bool,
    few_cores: bool,
    backward: Network<field_backward::Args>,
    scatter: Scatter,
    hidden_layer: Layer,
    by_chain_rule: Option<GradientKernels>,
}

/// Kernels of the first output's gradient g = Jᵀ a.
struct GradientKernels {
    /// The encoding that keeps its derivatives, where the others read them.
    encoding: Option<Kernel<field_forward::Args>>,
    /// Order up to which it does.
    kept: u32,
    /// s by matrices, from which the hidden layer has a before `gradient` begins.
    by_matrices: Option<Kernel<field_gradient::Args>>,
    gradient: Kernel<field_gradient::Args>,
    tangent: Kernel<field_tangent::Args>,
    points: Kernel<field_point_backward::Args>,
    /// d_W₁ += s ȧᵀ.
    steepness: Layer,
}

/// A kernel over a field's points, of which the leading ones have further heads.
struct Network<A> {
    kernel: Kernel<A>,
    /// For devices to which each lane's question about heads is dear: the kernel for points without.
    headless: Option<Kernel<A>>,
}

impl<A> Network<A> {
    /// What to launch for these points, of which those before `n_hidden` have heads; one of the two may be for none.
    fn launches(&self, points: Range<u32>, n_hidden: u32) -> [(&Kernel<A>, Range<u32>); 2] {
        let (headless, border) = match &self.headless {
            Some(headless) => (headless, n_hidden.clamp(points.start, points.end)),
            None => (&self.kernel, points.end),
        };
        [
            (&self.kernel, points.start..border),
            (headless, border..points.end),
        ]
    }
}

/// How the device adds up the table's gradient.
enum Scatter {
    Atomic(Kernel<hash_grid_backward::Args>),
    /// For devices with few cores and slow atomics: a core for each level.
    Owned(Kernel<hash_grid_backward_owned::Args>),
}

/// A stretch of points on their way back through a field.
struct Pass<'a> {
    params: &'a Params,
    points: Ptr<f32>,
    buffers: &'a FieldBuffers,
    scratch: &'a Scratch,
    chunk: Range<u32>,
}

impl Field {
    /// Builds a field over parameters that stand at `table`, `hidden` and row 0 of `heads`.
    pub fn new(
        gpu: &Gpu,
        label: &str,
        shape: FieldShape,
        table: u64,
        hidden: WeightHandle,
        heads: WeightHandle,
    ) -> Result<Field> {
        let table_rows = shape.grid.level_table();
        let levels = gpu.buffer::<Level>(&format!("{label} levels"), table_rows.len() as u64)?;
        gpu.upload(&levels, 0, &table_rows)?;
        let (grid_levels, features) = (shape.grid.levels, shape.grid.features);
        let coordinates = shape.coordinate_inputs();
        let second_order = u32::from(shape.gradient);
        let kept = shape.kept_on(gpu);
        let half = u32::from(shape.half);
        let softplus = u32::from(shape.softplus);
        let bias = u32::from(hidden.bias.is_some());
        let tile = shape.hidden.min(8);
        let few_cores = gpu.info().few_cores;
        let form = Forms::of(gpu, shape.hidden)?.linear;
        // Always compensated: a gradient by finite differences would not survive float16.
        let by_matrices = shape.by_matrices_on(gpu)?;
        let straight = u32::from(form.is_straight([shape.inputs(), shape.hidden]));
        let forward = field_forward::Shape {
            levels: grid_levels,
            features,
            hidden: shape.hidden,
            coordinates,
            softplus,
            bias,
            tile,
            heads: 1,
            part: 0,
            straight,
            kept: 0,
            half,
        };
        let backward = field_backward::Shape {
            levels: grid_levels,
            features,
            hidden: shape.hidden,
            coordinates,
            softplus,
            bias,
            tile,
            heads: 1,
            second_order,
            straight,
        };
        let hidden_layer = |backward_inputs| LayerShape {
            inputs: shape.inputs(),
            outputs: shape.hidden,
            first_row: 0,
            activation: Activation::None,
            backward_inputs,
            inputs_are_relu: false,
        };
        let encoding = format!("{label} encoding");
        let forward_part = |part, heads, name: &str| -> Result<_> {
            let shape = field_forward::Shape {
                part,
                heads,
                ..forward
            };
            let kernel = match by_matrices && part == 2 {
                true => gpu.matrix_kernel(shape, true)?,
                false => gpu.kernel(shape)?,
            };
            Ok(kernel.labelled(name))
        };
        let backward = |heads| -> Result<_> {
            let shape = field_backward::Shape { heads, ..backward };
            let kernel = match by_matrices {
                true => gpu.matrix_kernel(shape, true)?,
                false => gpu.kernel(shape)?,
            };
            Ok(kernel.labelled(label))
        };
        let network = format!("{label} network");
        let gradient = field_gradient::Shape {
            levels: grid_levels,
            features,
            hidden: shape.hidden,
            coordinates,
            softplus,
            bias,
            tile,
            straight,
            kept: kept.min(1),
            given: u32::from(by_matrices),
            half,
        };
        // Where points without further heads have a launch of their own, all others have some.
        let with_heads = if few_cores { 2 } else { 1 };
        let by_chain_rule = match shape.gradient {
            true => Some(GradientKernels {
                encoding: match kept {
                    0 => None,
                    _ => {
                        let shape = field_forward::Shape {
                            part: 1,
                            heads: 0,
                            kept,
                            ..forward
                        };
                        Some(gpu.kernel(shape)?.labelled(&encoding))
                    }
                },
                kept,
                by_matrices: match by_matrices {
                    true => Some(gpu.matrix_kernel(gradient, true)?.labelled(&network)),
                    false => None,
                },
                gradient: gpu.kernel(gradient)?.labelled(label),
                tangent: gpu
                    .kernel(field_tangent::Shape {
                        levels: grid_levels,
                        features,
                        coordinates,
                        kept: kept.min(1),
                        half,
                        ..field_tangent::Shape::default()
                    })?
                    .labelled(label),
                points: gpu
                    .kernel(field_point_backward::Shape {
                        levels: grid_levels,
                        features,
                        coordinates,
                        kept: if kept == 2 { kept } else { 0 },
                        half,
                        ..field_point_backward::Shape::default()
                    })?
                    .labelled(label),
                steepness: Layer::new(
                    gpu,
                    &format!("{label} steepness"),
                    hidden_layer(0),
                    hidden.without_bias(),
                )?,
            }),
            false => None,
        };
        Ok(Field {
            table,
            hidden,
            heads,
            levels,
            encoding: forward_part(1, 0, &encoding)?,
            forward: Network {
                kernel: match few_cores || by_matrices {
                    true => forward_part(2, with_heads, &network)?,
                    false => forward_part(0, with_heads, label)?,
                },
                headless: match few_cores {
                    true => Some(forward_part(2, 0, &network)?),
                    false => None,
                },
            },
            apart: few_cores || by_matrices,
            by_matrices,
            few_cores,
            backward: Network {
                kernel: backward(with_heads)?,
                headless: match few_cores {
                    true => Some(backward(0)?),
                    false => None,
                },
            },
            scatter: match few_cores {
                true => {
                    let shape = hash_grid_backward_owned::Shape {
                        levels: grid_levels,
                        features,
                        second_order,
                    };
                    Scatter::Owned(gpu.kernel(shape)?.labelled(label))
                }
                false => {
                    let shape = hash_grid_backward::Shape {
                        levels: grid_levels,
                        features,
                        second_order,
                    };
                    Scatter::Atomic(gpu.kernel(shape)?.labelled(label))
                }
            },
            hidden_layer: Layer::new(
                gpu,
                &format!("{label} hidden"),
                hidden_layer(if by_matrices { shape.inputs() } else { 0 }),
                hidden,
            )?,
            by_chain_rule,
            shape,
        })
    }

    /// Element offset of the grid's table in the parameter block.
    pub(super) fn table(&self) -> u64 {
        self.table
    }

    fn row_bytes(&self) -> f64 {
        4.0 * f64::from(self.shape.inputs())
    }

    fn gather_bytes(&self) -> f64 {
        let of_feature = if self.shape.half { 16.0 } else { 32.0 };
        of_feature * f64::from(self.shape.grid.outputs())
    }

    /// Order up to which the encoding's derivatives are kept.
    fn kept(&self) -> u32 {
        self.by_chain_rule
            .as_ref()
            .map_or(0, |kernels| kernels.kept)
    }

    /// Of the encoding's derivatives up to an order, at a point.
    fn derivative_bytes(&self, order: u32) -> f64 {
        12.0 * f64::from(order * self.shape.grid.outputs())
    }

    /// Operations and bytes of a product with the encoding's derivatives up to an order: they are read, or looked up once more.
    fn derivative_work(&self, order: u32) -> (f64, f64) {
        let products = 6.0 * f64::from(order * self.shape.grid.outputs());
        match self.kept() >= order {
            true => (products, self.derivative_bytes(order)),
            false => (
                products + 4.0 * self.interpolation_flops(),
                self.gather_bytes(),
            ),
        }
    }

    fn interpolation_flops(&self) -> f64 {
        16.0 * f64::from(self.shape.grid.outputs())
    }

    fn hidden_flops(&self) -> f64 {
        2.0 * f64::from(self.shape.hidden) * f64::from(self.shape.inputs() + 1)
    }

    /// First output at `points [3, n]`, into `first [n]`.
    pub fn forward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        points: Ptr<f32>,
        buffers: &FieldBuffers,
        first: PtrMut<f32>,
    ) {
        let mut flops = self.hidden_flops();
        let mut bytes = self.row_bytes();
        if self.apart {
            self.encode(rec, params, points, buffers);
        } else {
            flops += self.interpolation_flops();
            bytes = 2.0 * bytes + self.gather_bytes();
        }
        for (kernel, launch) in self.forward.launches(0..buffers.n, buffers.n_hidden) {
            let work = work_of(kernel, launch.len(), flops, bytes);
            let args = self.forward_args(params, points, buffers, first, launch);
            rec.run(kernel, work, args);
        }
    }

    /// Only the network's input at `points [3, n]`: enough for [`Field::gradient`] where nobody asks for the output.
    pub fn encode(
        &self,
        rec: &mut Recorder,
        params: &Params,
        points: Ptr<f32>,
        buffers: &FieldBuffers,
    ) {
        let levels = f64::from(self.shape.grid.levels);
        let mut flops = self.interpolation_flops();
        let mut bytes = self.gather_bytes() + self.row_bytes();
        let kernels = buffers.slope.as_ref().and(self.by_chain_rule.as_ref());
        let keeping = kernels.and_then(|kernels| kernels.encoding.as_ref());
        if keeping.is_some() {
            flops *= 4.0;
            bytes += self.derivative_bytes(self.kept());
        }
        let kernel = keeping.unwrap_or(&self.encoding);
        let turns = match self.few_cores {
            true => buffers.n.div_ceil(ENCODERS * kernel.local_size()).max(1),
            false => 1,
        };
        let args = field_forward::Args {
            points_each: turns,
            ..self.forward_args(params, points, buffers, PtrMut::NULL, 0..buffers.n)
        };
        let work = Work::items(buffers.n.into())
            .turns(turns.into())
            .slices(self.shape.grid.levels)
            .flops(flops / levels)
            .bytes(bytes / levels);
        rec.run(kernel, work, args);
    }

    fn forward_args(
        &self,
        params: &Params,
        points: Ptr<f32>,
        buffers: &FieldBuffers,
        first: PtrMut<f32>,
        launch: Range<u32>,
    ) -> field_forward::Args {
        field_forward::Args {
            levels: self.levels.ptr(),
            table: params.table(self.table),
            hidden_weight: params.weight(self.hidden, 0),
            hidden_bias: params.bias(self.hidden, 0),
            head_weight: params.weight(self.heads, 0),
            head_bias: params.bias(self.heads, 0),
            points,
            inputs: buffers.inputs.ptr_mut(),
            hidden: buffers.hidden.write().first,
            first,
            derivatives: match &buffers.slope {
                Some(slope) => slope.derivatives(),
                None => PtrMut::NULL,
            },
            n: buffers.n,
            n_hidden: buffers.n_hidden,
            stride_hidden: buffers.hidden.stride,
            begin: launch.start,
            end: launch.end,
            points_each: 1,
        }
    }

    /// Gradient of the first output at the points of the last [`Field::forward`] or [`Field::encode`], into the buffers' `gradient`.
    pub fn gradient(
        &self,
        rec: &mut Recorder,
        params: &Params,
        points: Ptr<f32>,
        buffers: &FieldBuffers,
    ) {
        let (n, out) = (buffers.n, buffers.slope());
        let args = field_gradient::Args {
            levels: self.levels.ptr(),
            table: params.table(self.table),
            hidden_weight: params.weight(self.hidden, 0),
            hidden_bias: params.bias(self.hidden, 0),
            head_weight: params.weight(self.heads, 0),
            points,
            inputs: buffers.inputs.ptr(),
            derivatives: out.derivatives().read(),
            steepness: out.steepness(),
            slopes: out.slopes.ptr_mut(),
            gradient: out.gradient.ptr_mut(),
            n,
            begin: 0,
            end: n,
        };
        let (mut flops, bytes) = self.derivative_work(1);
        let bytes = 2.0 * self.row_bytes() + bytes;
        match &self.kernels().by_matrices {
            Some(kernel) => self.slopes_by_matrices(rec, params, kernel, args),
            None => flops += 2.0 * self.hidden_flops(),
        }
        let work = Work::items(u64::from(n)).flops(flops).bytes(bytes);
        rec.run(&self.kernels().gradient, work, args);
    }

    /// a = W₁ᵀ s, so many points at once as there is memory for their s.
    fn slopes_by_matrices(
        &self,
        rec: &mut Recorder,
        params: &Params,
        kernel: &Kernel<field_gradient::Args>,
        args: field_gradient::Args,
    ) {
        for begin in (0..args.n).step_by(AT_ONCE as usize) {
            let end = args.n.min(begin + AT_ONCE);
            let m = end - begin;
            let work = work_of(kernel, m as usize, self.hidden_flops(), self.row_bytes());
            rec.run(kernel, work, field_gradient::Args { begin, end, ..args });
            let steepness = Planes::new(args.steepness.read(), m);
            let inputs = Planes::new(args.inputs.offset(begin.into()), args.n);
            let slopes = Planes::new(args.slopes.offset(begin.into()), args.n);
            self.hidden_layer
                .backward(rec, params, steepness, inputs, slopes, m);
        }
    }

    /// Adds all parameter gradients, from `d_first [n_back]`, for the leading points the heads' gradients in `buffers.hidden`, and for a field
    /// with a gradient `d_gradient` of its buffers. Those of such a field's points go into `d_points [3, n]` where they are asked for.
    #[allow(clippy::too_many_arguments)] // what a pass over the points needs; a struct would only rename them
    pub fn backward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        points: Ptr<f32>,
        d_first: Ptr<f32>,
        buffers: &FieldBuffers,
        scratch: &Scratch,
        d_points: Option<PtrMut<f32>>,
    ) {
        for begin in (0..buffers.n_back).step_by(AT_ONCE as usize) {
            let pass = Pass {
                params,
                points,
                buffers,
                scratch,
                chunk: begin..buffers.n_back.min(begin + AT_ONCE),
            };
            if let Some(slope) = &buffers.slope {
                self.tangent(rec, &pass, slope);
            }
            self.network_backward(rec, &pass, d_first);
            self.scatter(rec, &pass);
            if let Some(d_points) = d_points {
                self.point_backward(rec, &pass, d_points);
            }
        }
    }

    /// ȧ = J v.
    fn tangent(&self, rec: &mut Recorder, pass: &Pass, slope: &Slope) {
        let args = field_tangent::Args {
            levels: self.levels.ptr(),
            table: pass.params.table(self.table),
            points: pass.points,
            derivatives: slope.derivatives().read(),
            d_gradient: slope.d_gradient.ptr(),
            tangents: pass.scratch.tangents.ptr_mut(),
            n: pass.buffers.n,
            begin: pass.chunk.start,
            end: pass.chunk.end,
        };
        let levels = f64::from(self.shape.grid.levels);
        let (flops, bytes) = self.derivative_work(1);
        let work = Work::items(pass.chunk.len() as u64)
            .slices(self.shape.grid.levels)
            .flops(flops / levels)
            .bytes((bytes + self.row_bytes()) / levels);
        rec.run(&self.kernels().tangent, work, args);
    }

    /// Down to the network's input, and the gradients of its weights.
    fn network_backward(&self, rec: &mut Recorder, pass: &Pass, d_first: Ptr<f32>) {
        let Pass {
            params,
            buffers,
            scratch,
            chunk,
            ..
        } = pass;
        let (n, m) = (buffers.n, chunk.len() as u32);
        let mut args = field_backward::Args {
            hidden_weight: params.weight(self.hidden, 0),
            hidden_bias: params.bias(self.hidden, 0),
            head_weight: params.weight(self.heads, 0),
            inputs: buffers.inputs.ptr(),
            tangents: scratch.tangents.ptr(),
            d_first,
            d_hidden: buffers.hidden.read().first,
            d_preactivation: scratch.d_preactivation.ptr_mut(),
            steepness: scratch.steepness.ptr_mut(),
            d_inputs: scratch.d_inputs.ptr_mut(),
            d_head_weight: params.d_weight(self.heads, 0),
            d_head_bias: params.d_bias(self.heads, 0),
            n,
            n_hidden: buffers.n_hidden,
            stride_hidden: buffers.hidden.stride,
            begin: 0,
            end: 0,
            first: chunk.start,
            m,
        };
        let products = match (self.shape.gradient, self.by_matrices) {
            (true, false) => 3.0,
            (false, true) => 1.0,
            _ => 2.0,
        };
        for (kernel, launch) in self.backward.launches(chunk.clone(), buffers.n_hidden) {
            (args.begin, args.end) = (launch.start, launch.end);
            let bytes = products * self.row_bytes() + 4.0 * f64::from(self.shape.hidden);
            let work = work_of(kernel, launch.len(), products * self.hidden_flops(), bytes);
            rec.run(kernel, work, args);
        }
        let inputs = buffers.inputs.ptr().offset(u64::from(chunk.start));
        let inputs = Planes::new(inputs, n);
        let layer = &self.hidden_layer;
        let d_preactivation = Planes::new(scratch.d_preactivation.ptr(), m);
        if self.by_matrices {
            let d_inputs = Planes::new(scratch.d_inputs.ptr_mut(), m);
            layer.backward(rec, params, d_preactivation, inputs, d_inputs, m);
        }
        layer.gradient(rec, params, inputs, d_preactivation, m);
        if let Some(kernels) = &self.by_chain_rule {
            let tangents = Planes::new(scratch.tangents.ptr(), m);
            let steepness = Planes::new(scratch.steepness.ptr(), m);
            kernels
                .steepness
                .gradient(rec, params, tangents, steepness, m);
        }
    }

    /// From the network's input into the table.
    fn scatter(&self, rec: &mut Recorder, pass: &Pass) {
        let (n, m) = (pass.buffers.n, pass.chunk.len() as u64);
        let (begin, end) = (pass.chunk.start, pass.chunk.end);
        let coordinates = u64::from(self.shape.coordinate_inputs());
        let points = pass.points;
        let mut d_features = pass.scratch.d_inputs.ptr();
        if self.shape.gradient || self.by_matrices {
            d_features = d_features.offset(coordinates * m);
        }
        let (slopes, d_gradient) = match &pass.buffers.slope {
            Some(slope) => (
                slope.slopes.ptr().offset(coordinates * u64::from(n)),
                slope.d_gradient.ptr(),
            ),
            None => (Ptr::NULL, Ptr::NULL),
        };
        let d_table = pass.params.d_value(self.table);
        let levels = self.levels.ptr();
        let slices = self.shape.grid.levels;
        let flops = self.interpolation_flops() / f64::from(slices);
        let bytes = 2.0 * self.gather_bytes() / f64::from(slices);
        match &self.scatter {
            Scatter::Atomic(kernel) => {
                let args = hash_grid_backward::Args {
                    levels,
                    points,
                    d_features,
                    slopes,
                    d_gradient,
                    d_table,
                    n,
                    begin,
                    end,
                };
                let work = Work::items(m).slices(slices);
                rec.run(kernel, work.flops(flops).bytes(bytes), args);
            }
            Scatter::Owned(kernel) => {
                let args = hash_grid_backward_owned::Args {
                    levels,
                    points,
                    d_features,
                    slopes,
                    d_gradient,
                    d_table,
                    n,
                    begin,
                    end,
                };
                let work = Work::groups(1).slices(slices);
                let (flops, bytes) = (flops * m as f64, bytes * m as f64);
                rec.run(kernel, work.flops(flops).bytes(bytes), args);
            }
        }
    }

    /// Gradients of the points.
    fn point_backward(&self, rec: &mut Recorder, pass: &Pass, d_points: PtrMut<f32>) {
        let slope = pass.buffers.slope();
        let args = field_point_backward::Args {
            levels: self.levels.ptr(),
            table: pass.params.table(self.table),
            points: pass.points,
            d_inputs: pass.scratch.d_inputs.ptr(),
            derivatives: slope.derivatives().read(),
            slopes: slope.slopes.ptr(),
            d_gradient: slope.d_gradient.ptr(),
            d_points,
            n: pass.buffers.n,
            begin: pass.chunk.start,
            end: pass.chunk.end,
        };
        let (flops, bytes) = self.derivative_work(2);
        let work = Work::items(pass.chunk.len() as u64)
            .flops(flops)
            .bytes(bytes + 2.0 * self.row_bytes());
        rec.run(&self.kernels().points, work, args);
    }

    fn kernels(&self) -> &GradientKernels {
        let kernels = self.by_chain_rule.as_ref();
        kernels.expect("a field that was built with a gradient")
    }
}

/// Work of a network's kernel over `points`, each with so many operations and bytes.
fn work_of<A>(kernel: &Kernel<A>, points: usize, flops: f64, bytes: f64) -> Work {
    let (work, share) = match kernel.matrix_tile() {
        Some([_, columns]) => {
            let groups = points.div_ceil(columns as usize);
            (Work::groups(groups as u64), f64::from(columns))
        }
        None => (Work::items(points as u64), 1.0),
    };
    work.flops(flops * share).bytes(bytes * share)
}
