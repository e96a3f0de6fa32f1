//! A field: hash grid, one hidden layer and a first output. The SDF, the proposal densities and the background density are fields.

use super::hash_grid::HashGrid;
use super::layer::{Activation, Layer, LayerShape};
use super::params::{Params, WeightHandle};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, PtrMut, Recorder, Work};
use crate::kernels::{
    Level, field_backward, field_forward, hash_grid_backward, hash_grid_backward_owned,
};

/// What fixes a field's kernels.
#[derive(Clone, Copy, Debug)]
pub struct FieldShape {
    pub grid: HashGrid,
    pub hidden: u32,
    /// The position itself is an input beside its encoding.
    pub coordinates: bool,
    /// softplus(100 u)/100, or ReLU.
    pub softplus: bool,
}

impl FieldShape {
    /// Inputs of the hidden layer.
    pub fn inputs(&self) -> u32 {
        self.grid.outputs() + if self.coordinates { 3 } else { 0 }
    }
}

/// A field's parameters and kernels.
pub struct Field {
    pub shape: FieldShape,
    table: u64,
    hidden: WeightHandle,
    heads: WeightHandle,
    levels: Buffer<Level>,
    forward: Forward,
    backward: Kernel<field_backward::Args>,
    scatter: Scatter,
    hidden_gradient: Layer,
}

/// How the device evaluates a field.
enum Forward {
    Fused(Kernel<field_forward::Args>),
    /// For devices whose caches hold one level of the table but not all: level by level, then the network.
    Parts(Kernel<field_forward::Args>, Kernel<field_forward::Args>),
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
}

impl FieldBuffers {
    /// Buffers for `n` points of fields of this shape.
    pub fn new(gpu: &Gpu, name: &str, shape: &FieldShape, n: u32, n_hidden: u32) -> Result<Self> {
        let hidden_len = u64::from(shape.hidden) * u64::from(n_hidden.max(1));
        Ok(FieldBuffers {
            n,
            n_hidden,
            inputs: gpu.scratch(
                &format!("{name} inputs"),
                u64::from(shape.inputs()) * u64::from(n),
            )?,
            hidden: gpu.scratch(&format!("{name} hidden"), hidden_len)?,
            d_hidden: gpu.scratch(&format!("{name} d_hidden"), hidden_len)?,
        })
    }
}

/// Memory that a field's backward pass needs only while it runs; one for all fields.
pub struct Scratch {
    d_preactivation: Buffer<f32>, // [hidden, n] of the largest field
    d_features: Buffer<f32>,      // [features, n] of the largest field
}

impl Scratch {
    /// Enough for each of the given (shape, points).
    pub fn new(gpu: &Gpu, users: &[(FieldShape, u32)]) -> Result<Self> {
        let most = |per_point: fn(&FieldShape) -> u32| {
            users
                .iter()
                .map(|(shape, n)| u64::from(per_point(shape)) * u64::from(*n))
                .max()
                .unwrap_or(1)
        };
        Ok(Scratch {
            d_preactivation: gpu.scratch("d_preactivation", most(|s| s.hidden))?,
            d_features: gpu.scratch("d_features", most(|s| s.grid.outputs()))?,
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
        let coordinates = if shape.coordinates { 3 } else { 0 };
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
        };
        let gradient = LayerShape {
            inputs: shape.inputs(),
            outputs: shape.hidden,
            first_row: 0,
            activation: Activation::None,
            backward_inputs: 0,
            inputs_are_relu: false,
        };
        let few_cores = gpu.info().few_cores;
        let forward_part = |part, name: &str| -> Result<_> {
            let shape = field_forward::Shape { part, ..forward };
            Ok(gpu.kernel(shape)?.labelled(name))
        };
        Ok(Field {
            table,
            hidden,
            heads,
            levels,
            forward: match few_cores {
                true => Forward::Parts(
                    forward_part(1, &format!("{label} encoding"))?,
                    forward_part(2, &format!("{label} network"))?,
                ),
                false => Forward::Fused(forward_part(0, label)?),
            },
            backward: gpu.kernel(backward)?.labelled(label),
            scatter: match few_cores {
                true => {
                    let shape = hash_grid_backward_owned::Shape {
                        levels: grid_levels,
                        features,
                    };
                    Scatter::Owned(gpu.kernel(shape)?.labelled(label))
                }
                false => {
                    let shape = hash_grid_backward::Shape {
                        levels: grid_levels,
                        features,
                    };
                    Scatter::Atomic(gpu.kernel(shape)?.labelled(label))
                }
            },
            hidden_gradient: Layer::new(gpu, &format!("{label} hidden"), gradient, hidden)?,
            shape,
        })
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
        let n = buffers.n;
        let args = field_forward::Args {
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
            n,
            n_hidden: buffers.n_hidden,
        };
        let work = Work::items(u64::from(n));
        let (interpolation, network) = (self.interpolation_flops(), self.hidden_flops());
        let (gather, rows) = (self.gather_bytes(), 4.0 * f64::from(self.shape.inputs()));
        match &self.forward {
            Forward::Fused(kernel) => {
                let work = work.flops(interpolation + network);
                rec.run(kernel, work.bytes(gather + 2.0 * rows), args);
            }
            Forward::Parts(encoding, head) => {
                let levels = f64::from(self.shape.grid.levels);
                let by_level = work
                    .slices(self.shape.grid.levels)
                    .flops(interpolation / levels);
                rec.run(encoding, by_level.bytes((gather + rows) / levels), args);
                rec.run(head, work.flops(network).bytes(rows), args);
            }
        }
    }

    /// Adds all parameter gradients, from `d_first [n]` and, for the leading points, the heads' `buffers.d_hidden`.
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
        let args = field_backward::Args {
            hidden_weight: params.weight(self.hidden, 0),
            hidden_bias: params.bias(self.hidden, 0),
            head_weight: params.weight(self.heads, 0),
            inputs: buffers.inputs.ptr(),
            d_first,
            d_hidden: buffers.d_hidden.ptr(),
            d_preactivation: scratch.d_preactivation.ptr_mut(),
            d_features: scratch.d_features.ptr_mut(),
            d_head_weight: params.d_weight(self.heads, 0),
            d_head_bias: params.d_bias(self.heads, 0),
            n,
            n_hidden: buffers.n_hidden,
        };
        let bytes =
            4.0 * f64::from(self.shape.inputs() + self.shape.hidden + self.shape.grid.outputs());
        rec.run(
            &self.backward,
            Work::items(u64::from(n))
                .flops(2.0 * self.hidden_flops())
                .bytes(bytes),
            args,
        );
        self.hidden_gradient.gradient(
            rec,
            params,
            buffers.inputs.ptr(),
            n,
            scratch.d_preactivation.ptr(),
            n,
        );
        let d_table = params.grads().ptr_mut().offset(self.table);
        let (levels, d_features) = (self.levels.ptr(), scratch.d_features.ptr());
        let slices = self.shape.grid.levels;
        let flops = self.interpolation_flops() / f64::from(slices);
        let bytes = 2.0 * self.gather_bytes() / f64::from(slices);
        match &self.scatter {
            Scatter::Atomic(kernel) => {
                let args = hash_grid_backward::Args {
                    levels,
                    points,
                    d_features,
                    d_table,
                    n,
                };
                let work = Work::items(u64::from(n)).slices(slices);
                rec.run(kernel, work.flops(flops).bytes(bytes), args);
            }
            Scatter::Owned(kernel) => {
                let args = hash_grid_backward_owned::Args {
                    levels,
                    points,
                    d_features,
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
}
