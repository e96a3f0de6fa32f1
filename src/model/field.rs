//! A field: hash grid, one hidden layer and a first output. The SDF, the proposal densities and the background density are fields.

use super::hash_grid::HashGrid;
use super::layer::{Activation, Layer, LayerShape};
use super::params::{Params, WeightHandle};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, PtrMut, Recorder, Work};
use crate::kernels::{Level, field_backward, field_forward, hash_grid_backward};

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
    forward: Kernel<field_forward::Args>,
    backward: Kernel<field_backward::Args>,
    scatter: Kernel<hash_grid_backward::Args>,
    hidden_gradient: Layer,
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
        Ok(Field {
            table,
            hidden,
            heads,
            levels,
            forward: gpu.kernel(forward)?.labelled(label),
            backward: gpu.kernel(backward)?.labelled(label),
            scatter: gpu
                .kernel(hash_grid_backward::Shape {
                    levels: grid_levels,
                    features,
                })?
                .labelled(label),
            hidden_gradient: Layer::new(gpu, &format!("{label} hidden"), gradient, hidden)?,
            shape,
        })
    }

    fn gather_bytes(&self) -> f64 {
        32.0 * f64::from(self.shape.grid.outputs())
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
        let flops = self.hidden_flops() + 2.0 * 8.0 * f64::from(self.shape.grid.outputs());
        let bytes = self.gather_bytes() + 8.0 * f64::from(self.shape.inputs());
        rec.run(
            &self.forward,
            Work::items(u64::from(n)).flops(flops).bytes(bytes),
            args,
        );
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
        let args = hash_grid_backward::Args {
            levels: self.levels.ptr(),
            points,
            d_features: scratch.d_features.ptr(),
            d_table: params.grads().ptr_mut().offset(self.table),
            n,
        };
        let levels = self.shape.grid.levels;
        let work = Work::items(u64::from(n))
            .slices(levels)
            .flops(2.0 * 8.0 * f64::from(self.shape.grid.outputs()));
        rec.run(&self.scatter, work.bytes(2.0 * self.gather_bytes()), args);
    }
}
