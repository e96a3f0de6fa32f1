//! One fully connected layer on planar activations `[channel, n]`: forward, gradient of the inputs, gradient of the weights.

use super::forms::Forms;
use super::params::{Params, WeightHandle};
use crate::Result;
use crate::gpu::{Gpu, Kernel, Ptr, PtrMut, Recorder, Work};
use crate::kernels::{linear, weight_gradient};

/// What follows the affine map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    None = 0,
    Relu = 1,
    Sigmoid = 2,
}

/// A layer, or some of its output rows: Y = σ(WX + b).
pub struct Layer {
    inputs: u32,
    outputs: u32,
    /// Rows of the matrix that come before this layer's own (heads share one matrix).
    first_row: u32,
    handle: WeightHandle,
    forms: Forms,
    forward: Kernel<linear::Args>,
    /// Adjoint with respect to the first `backward_inputs` inputs; none where nobody asks for them.
    backward: Option<(u32, Kernel<linear::Args>)>,
    gradient: Kernel<weight_gradient::Args>,
}

/// Shape of a [`Layer`].
pub struct LayerShape {
    pub inputs: u32,
    pub outputs: u32,
    pub first_row: u32,
    pub activation: Activation,
    /// How many of the leading inputs receive a gradient.
    pub backward_inputs: u32,
    /// The inputs came out of a ReLU, whose derivative gates their gradient.
    pub inputs_are_relu: bool,
}

/// Samples that one workgroup of the weight gradient sums up.
const GRADIENT_CHUNK: u32 = 1024;

impl Layer {
    /// Builds the layer's kernels, in the forms that suit the device; `label` names their rows in the profile.
    pub fn new(gpu: &Gpu, label: &str, shape: LayerShape, handle: WeightHandle) -> Result<Layer> {
        Layer::in_forms(gpu, label, shape, handle, Forms::of(gpu)?)
    }

    pub(super) fn in_forms(
        gpu: &Gpu,
        label: &str,
        shape: LayerShape,
        handle: WeightHandle,
        forms: Forms,
    ) -> Result<Layer> {
        let bias = u32::from(handle.bias.is_some());
        let base = linear::Shape {
            inputs: shape.inputs,
            outputs: shape.outputs,
            weight_columns: shape.inputs,
            transposed: 0,
            bias,
            activation: shape.activation as u32,
            gated: 0,
            tile: forms.linear.tile(shape.outputs),
        };
        let backward = if shape.backward_inputs > 0 {
            let adjoint = linear::Shape {
                inputs: shape.outputs,
                outputs: shape.backward_inputs,
                transposed: 1,
                bias: 0,
                activation: 0,
                gated: u32::from(shape.inputs_are_relu),
                tile: forms.linear.tile(shape.backward_inputs),
                ..base
            };
            let size = [adjoint.inputs, adjoint.outputs];
            let kernel = forms.linear.kernel(gpu, size, adjoint)?;
            let row = format!("{label} backward");
            Some((shape.backward_inputs, kernel.labelled(&row)))
        } else {
            None
        };
        let gradient = weight_gradient::Shape {
            inputs: shape.inputs,
            outputs: shape.outputs,
            bias,
            tile: forms.gradient.tile(shape.inputs),
        };
        let size = [shape.inputs, shape.outputs];
        Ok(Layer {
            inputs: shape.inputs,
            outputs: shape.outputs,
            first_row: shape.first_row,
            handle,
            forms,
            forward: (forms.linear.kernel(gpu, size, base)?).labelled(&format!("{label} forward")),
            backward,
            gradient: forms.gradient.kernel(gpu, size, gradient)?.labelled(label),
        })
    }

    /// Output channels.
    pub fn outputs(&self) -> u32 {
        self.outputs
    }

    fn weight_offset(&self) -> u64 {
        u64::from(self.first_row) * u64::from(self.inputs)
    }

    /// Work of `linear` for so many samples and output channels.
    fn work(&self, kernel: &Kernel<linear::Args>, n: u32, outputs: u32) -> Work {
        let (work, samples, slices) = match kernel.matrix_tile() {
            Some([rows, columns]) => {
                let groups = n.div_ceil(columns);
                (Work::groups(groups.into()), columns, outputs.div_ceil(rows))
            }
            None => {
                let tile = self.forms.linear.tile(outputs);
                (Work::items(n.into()), 1, outputs.div_ceil(tile))
            }
        };
        let connections = f64::from(self.inputs) * f64::from(self.outputs);
        let share = f64::from(samples) / f64::from(slices);
        work.slices(slices)
            .flops(2.0 * connections * share)
            .bytes(4.0 * f64::from(self.inputs + self.outputs) * share)
    }

    /// `y [outputs, n]` from `x [inputs, n]`.
    pub fn forward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        x: Ptr<f32>,
        y: PtrMut<f32>,
        n: u32,
    ) {
        let args = linear::Args {
            x,
            weight: params.weight(self.handle, self.weight_offset()),
            bias: params.bias(self.handle, u64::from(self.first_row)),
            gate: x,
            y,
            n,
        };
        rec.run(
            &self.forward,
            self.work(&self.forward, n, self.outputs),
            args,
        );
    }

    /// `d_x [backward_inputs, n]` from the gradient `d_y [outputs, n]` before the activation; `x` gates it where the inputs are ReLU's.
    pub fn backward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        d_y: Ptr<f32>,
        x: Ptr<f32>,
        d_x: PtrMut<f32>,
        n: u32,
    ) {
        let (outputs, kernel) = self
            .backward
            .as_ref()
            .expect("a layer built without input gradients was asked for them");
        let args = linear::Args {
            x: d_y,
            weight: params.weight(self.handle, self.weight_offset()),
            bias: params.bias(self.handle, 0),
            gate: x,
            y: d_x,
            n,
        };
        rec.run(kernel, self.work(kernel, n, *outputs), args);
    }

    /// Adds the gradients of weights and bias, from `x` (channels `stride_x` apart) and `d_y [outputs, n]`.
    pub fn gradient(
        &self,
        rec: &mut Recorder,
        params: &Params,
        x: Ptr<f32>,
        stride_x: u32,
        d_y: Ptr<f32>,
        n: u32,
    ) {
        let args = weight_gradient::Args {
            x,
            d_y,
            d_weight: params.d_weight(self.handle, self.weight_offset()),
            d_bias: params.d_bias(self.handle, u64::from(self.first_row)),
            n,
            stride_x,
            chunk: GRADIENT_CHUNK,
        };
        // Outputs and inputs of a workgroup.
        let [rows, columns] = match self.gradient.matrix_tile() {
            Some(tile) => tile,
            None => [
                self.gradient.local_size(),
                self.forms.gradient.tile(self.inputs),
            ],
        };
        let chunks = n.div_ceil(GRADIENT_CHUNK);
        let slices = self.outputs.div_ceil(rows) * self.inputs.div_ceil(columns);
        let (rows, columns) = (rows.min(self.outputs), columns.min(self.inputs));
        let samples = f64::from(n.min(GRADIENT_CHUNK));
        let work = Work::groups(chunks.into())
            .slices(slices)
            .flops(2.0 * f64::from(rows) * f64::from(columns) * samples)
            .bytes(4.0 * f64::from(rows + columns) * samples);
        rec.run(&self.gradient, work, args);
    }
}
