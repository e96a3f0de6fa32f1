//! A field: hash grid, one hidden layer and a first output. The SDF, the proposal densities and the background density are fields.

use super::hash_grid::HashGrid;
use super::layer::{Activation, Layer, LayerShape};
use super::params::{Params, WeightHandle};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, PtrMut, Recorder, Work};
use crate::kernels::{
    Level, field_backward, field_forward, field_gradient, field_point_backward, field_tangent,
    hash_grid_backward, hash_grid_backward_owned,
};
use std::ops::Range;

/// Weights up to which a network's forward pass is straight-line code: beyond, drivers take long over it and make it slower.
const MOST_WRITTEN_OUT: u32 = 64 * 64;

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
    /// Whether the device's caches hold one level of the table but not all: then each is encoded before the network begins.
    apart: bool,
    backward: Network<field_backward::Args>,
    scatter: Scatter,
    hidden_gradient: Layer,
    by_chain_rule: Option<GradientKernels>,
}

/// Kernels of the first output's gradient g = Jᵀ a.
struct GradientKernels {
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
    /// What to launch for `n` points, `n_hidden` of them with heads.
    fn launches(&self, n: u32, n_hidden: u32) -> Vec<(&Kernel<A>, Range<u32>)> {
        match &self.headless {
            None => vec![(&self.kernel, 0..n)],
            Some(headless) => vec![(&self.kernel, 0..n_hidden), (headless, n_hidden..n)],
        }
    }
}

/// How the device adds up the table's gradient.
enum Scatter {
    Atomic(Kernel<hash_grid_backward::Args>),
    /// For devices with few cores and slow atomics: a core for each level.
    Owned(Kernel<hash_grid_backward_owned::Args>),
}

/// What one evaluation of a field over `n` points leaves for its backward pass.
pub struct FieldBuffers {
    pub n: u32,
    /// Leading points whose hidden activations are kept for further heads.
    pub n_hidden: u32,
    pub inputs: Buffer<f32>,   // [inputs, n]
    pub hidden: Buffer<f32>,   // [hidden, n_hidden]
    pub d_hidden: Buffer<f32>, // [hidden, n_hidden]
    slope: Option<Slope>,
}

/// The gradient of a field's first output, and what its backward pass reads.
pub struct Slope {
    pub gradient: Buffer<f32>,   // [3, n] g, per region unit
    pub d_gradient: Buffer<f32>, // [3, n]
    slopes: Buffer<f32>,         // [inputs, n] a
}

impl FieldBuffers {
    /// Buffers for `n` points of fields of this shape.
    pub fn new(gpu: &Gpu, name: &str, shape: &FieldShape, n: u32, n_hidden: u32) -> Result<Self> {
        let hidden_len = u64::from(shape.hidden) * u64::from(n_hidden.max(1));
        let planes = |what: &str, channels: u32| {
            gpu.scratch(
                &format!("{name} {what}"),
                u64::from(channels) * u64::from(n),
            )
        };
        let slope = match shape.gradient {
            true => Some(Slope {
                gradient: planes("gradient", 3)?,
                d_gradient: planes("d_gradient", 3)?,
                slopes: planes("slopes", shape.inputs())?,
            }),
            false => None,
        };
        Ok(FieldBuffers {
            n,
            n_hidden,
            inputs: planes("inputs", shape.inputs())?,
            hidden: gpu.scratch(&format!("{name} hidden"), hidden_len)?,
            d_hidden: gpu.scratch(&format!("{name} d_hidden"), hidden_len)?,
            slope,
        })
    }

    /// The gradient's buffers.
    ///
    /// # Panics
    /// If the field has none.
    pub fn slope(&self) -> &Slope {
        self.slope.as_ref().expect("a field with a gradient")
    }
}

/// Memory that a field's backward pass needs only while it runs; one for all fields.
pub struct Scratch {
    d_preactivation: Buffer<f32>, // [hidden, n] of the largest field
    d_inputs: Buffer<f32>, // [inputs, n] of the largest field; only the hash features' rows where there is no gradient
    steepness: Buffer<f32>, // [hidden, n] of the largest field with a gradient: s
    tangents: Buffer<f32>, // [inputs, n] of the largest field with a gradient: ȧ
}

impl Scratch {
    /// Enough for each of the given (shape, points).
    pub fn new(gpu: &Gpu, users: &[(FieldShape, u32)]) -> Result<Self> {
        let most = |per_point: fn(&FieldShape) -> u32| {
            let sizes = users
                .iter()
                .map(|(shape, n)| u64::from(per_point(shape)) * u64::from(*n));
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
        let softplus = u32::from(shape.softplus);
        let bias = u32::from(hidden.bias.is_some());
        let tile = shape.hidden.min(8);
        let forward = field_forward::Shape {
            levels: grid_levels,
            features,
            hidden: shape.hidden,
            coordinates,
            softplus,
            bias,
            tile,
            heads: 1,
            block: match shape.hidden * shape.inputs() > MOST_WRITTEN_OUT {
                true => tile,
                false => shape.hidden,
            },
            part: 0,
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
        };
        let hidden_layer = || LayerShape {
            inputs: shape.inputs(),
            outputs: shape.hidden,
            first_row: 0,
            activation: Activation::None,
            backward_inputs: 0,
            inputs_are_relu: false,
        };
        let few_cores = gpu.info().few_cores;
        let forward_part = |part, heads, name: &str| -> Result<_> {
            let shape = field_forward::Shape {
                part,
                heads,
                ..forward
            };
            Ok(gpu.kernel(shape)?.labelled(name))
        };
        let backward = |heads| -> Result<_> {
            let shape = field_backward::Shape { heads, ..backward };
            Ok(gpu.kernel(shape)?.labelled(label))
        };
        let network = format!("{label} network");
        let by_chain_rule = match shape.gradient {
            true => Some(GradientKernels {
                gradient: gpu
                    .kernel(field_gradient::Shape {
                        levels: grid_levels,
                        features,
                        hidden: shape.hidden,
                        coordinates,
                        softplus,
                        bias,
                        tile,
                    })?
                    .labelled(label),
                tangent: gpu
                    .kernel(field_tangent::Shape {
                        levels: grid_levels,
                        features,
                        coordinates,
                        ..field_tangent::Shape::default()
                    })?
                    .labelled(label),
                points: gpu
                    .kernel(field_point_backward::Shape {
                        levels: grid_levels,
                        features,
                        coordinates,
                        ..field_point_backward::Shape::default()
                    })?
                    .labelled(label),
                steepness: Layer::new(
                    gpu,
                    &format!("{label} steepness"),
                    hidden_layer(),
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
            encoding: forward_part(1, 0, &format!("{label} encoding"))?,
            forward: match few_cores {
                true => Network {
                    kernel: forward_part(2, 1, &network)?,
                    headless: Some(forward_part(2, 0, &network)?),
                },
                false => Network {
                    kernel: forward_part(0, 1, label)?,
                    headless: None,
                },
            },
            apart: few_cores,
            backward: Network {
                kernel: backward(1)?,
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
            hidden_gradient: Layer::new(gpu, &format!("{label} hidden"), hidden_layer(), hidden)?,
            by_chain_rule,
            shape,
        })
    }

    /// Element offset of the grid's table in the parameter block.
    pub(super) fn table(&self) -> u64 {
        self.table
    }

    fn gather_bytes(&self) -> f64 {
        32.0 * f64::from(self.shape.grid.outputs())
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
        let mut bytes = 4.0 * f64::from(self.shape.inputs());
        if self.apart {
            self.encode(rec, params, points, buffers);
        } else {
            flops += self.interpolation_flops();
            bytes = 2.0 * bytes + self.gather_bytes();
        }
        for (kernel, launch) in self.forward.launches(buffers.n, buffers.n_hidden) {
            let work = Work::items(launch.len() as u64).flops(flops).bytes(bytes);
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
        let unused = buffers.inputs.ptr_mut();
        let args = self.forward_args(params, points, buffers, unused, 0..buffers.n);
        let levels = f64::from(self.shape.grid.levels);
        let rows = 4.0 * f64::from(self.shape.inputs());
        let work = Work::items(u64::from(buffers.n))
            .slices(self.shape.grid.levels)
            .flops(self.interpolation_flops() / levels)
            .bytes((self.gather_bytes() + rows) / levels);
        rec.run(&self.encoding, work, args);
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
            table: params.values().ptr().offset(self.table),
            hidden_weight: params.weight(self.hidden, 0),
            hidden_bias: params.bias(self.hidden, 0),
            head_weight: params.weight(self.heads, 0),
            head_bias: params.bias(self.heads, 0),
            points,
            inputs: buffers.inputs.ptr_mut(),
            hidden: buffers.hidden.ptr_mut(),
            first,
            n: buffers.n,
            n_hidden: buffers.n_hidden,
            begin: launch.start,
            end: launch.end,
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
            table: params.values().ptr().offset(self.table),
            hidden_weight: params.weight(self.hidden, 0),
            hidden_bias: params.bias(self.hidden, 0),
            head_weight: params.weight(self.heads, 0),
            points,
            inputs: buffers.inputs.ptr(),
            slopes: out.slopes.ptr_mut(),
            gradient: out.gradient.ptr_mut(),
            n,
        };
        let flops = 2.0 * self.hidden_flops() + 4.0 * self.interpolation_flops();
        let bytes = self.gather_bytes() + 16.0 * f64::from(self.shape.inputs());
        let work = Work::items(u64::from(n)).flops(flops).bytes(bytes);
        rec.run(&self.kernels().gradient, work, args);
    }

    /// Adds all parameter gradients, from `d_first [n]`, for the leading points the heads' `buffers.d_hidden`, and for a field with a
    /// gradient `d_gradient` of its buffers.
    pub fn backward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        points: Ptr<f32>,
        d_first: Ptr<f32>,
        buffers: &FieldBuffers,
        scratch: &Scratch,
    ) {
        let n = buffers.n;
        let slope = buffers.slope.as_ref();
        let items = Work::items(u64::from(n));
        let rows = 4.0 * f64::from(self.shape.inputs());
        if let Some(slope) = slope {
            let args = field_tangent::Args {
                levels: self.levels.ptr(),
                table: params.values().ptr().offset(self.table),
                points,
                d_gradient: slope.d_gradient.ptr(),
                tangents: scratch.tangents.ptr_mut(),
                n,
            };
            let levels = f64::from(self.shape.grid.levels);
            let by_level = items
                .slices(self.shape.grid.levels)
                .flops(4.0 * self.interpolation_flops() / levels);
            rec.run(
                &self.kernels().tangent,
                by_level.bytes((self.gather_bytes() + rows) / levels),
                args,
            );
        }
        let mut args = field_backward::Args {
            hidden_weight: params.weight(self.hidden, 0),
            hidden_bias: params.bias(self.hidden, 0),
            head_weight: params.weight(self.heads, 0),
            inputs: buffers.inputs.ptr(),
            tangents: scratch.tangents.ptr(),
            d_first,
            d_hidden: buffers.d_hidden.ptr(),
            d_preactivation: scratch.d_preactivation.ptr_mut(),
            steepness: scratch.steepness.ptr_mut(),
            d_inputs: scratch.d_inputs.ptr_mut(),
            d_head_weight: params.d_weight(self.heads, 0),
            d_head_bias: params.d_bias(self.heads, 0),
            n,
            n_hidden: buffers.n_hidden,
            begin: 0,
            end: n,
        };
        let products = if slope.is_some() { 3.0 } else { 2.0 };
        for (kernel, launch) in self.backward.launches(n, buffers.n_hidden) {
            let work = Work::items(launch.len() as u64)
                .flops(products * self.hidden_flops())
                .bytes(products * rows + 4.0 * f64::from(self.shape.hidden));
            (args.begin, args.end) = (launch.start, launch.end);
            rec.run(kernel, work, args);
        }
        let d_preactivation = scratch.d_preactivation.ptr();
        self.hidden_gradient
            .gradient(rec, params, buffers.inputs.ptr(), n, d_preactivation, n);
        let coordinates = u64::from(self.shape.coordinate_inputs()) * u64::from(n);
        let (d_features, slopes, d_gradient) = match slope {
            Some(slope) => {
                let (tangents, steepness) = (scratch.tangents.ptr(), scratch.steepness.ptr());
                self.kernels()
                    .steepness
                    .gradient(rec, params, tangents, n, steepness, n);
                (
                    scratch.d_inputs.ptr().offset(coordinates),
                    slope.slopes.ptr().offset(coordinates),
                    slope.d_gradient.ptr(),
                )
            }
            // Nobody reads the last two.
            None => (scratch.d_inputs.ptr(), points, points),
        };
        let d_table = params.grads().ptr_mut().offset(self.table);
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
                };
                rec.run(kernel, items.slices(slices).flops(flops).bytes(bytes), args);
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
                };
                let work = Work::groups(1).slices(slices);
                let points = f64::from(n);
                rec.run(
                    kernel,
                    work.flops(flops * points).bytes(bytes * points),
                    args,
                );
            }
        }
    }

    /// What the points hear, into `d_points [3, n]`; right after [`Field::backward`], whose scratch memory it reads.
    pub fn point_backward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        points: Ptr<f32>,
        buffers: &FieldBuffers,
        scratch: &Scratch,
        d_points: PtrMut<f32>,
    ) {
        let (n, slope) = (buffers.n, buffers.slope());
        let args = field_point_backward::Args {
            levels: self.levels.ptr(),
            table: params.values().ptr().offset(self.table),
            points,
            d_inputs: scratch.d_inputs.ptr(),
            slopes: slope.slopes.ptr(),
            d_gradient: slope.d_gradient.ptr(),
            d_points,
            n,
        };
        let work = Work::items(u64::from(n)).flops(8.0 * self.interpolation_flops());
        let bytes = self.gather_bytes() + 8.0 * f64::from(self.shape.inputs());
        rec.run(&self.kernels().points, work.bytes(bytes), args);
    }

    fn kernels(&self) -> &GradientKernels {
        let kernels = self.by_chain_rule.as_ref();
        kernels.expect("a field that was built with a gradient")
    }
}
