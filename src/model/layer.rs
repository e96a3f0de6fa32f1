//! One fully connected layer on planar activations: forward, gradient of the inputs, gradient of the weights.

use super::forms::{Form, Forms};
use super::params::{Params, WeightHandle};
use super::planes::Planes;
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
    forward: Product,
    /// Adjoint with respect to the first `backward_inputs` inputs; none where nobody asks for them.
    backward: Option<Product>,
    inputs_are_relu: bool,
    gradient: WeightGradient,
    /// What reads samples in pairs, of which there must be an even number.
    paired_gradient: Option<WeightGradient>,
}

/// `weight_gradient` in one form: what of d_W and of the samples a workgroup sums up.
struct WeightGradient {
    kernel: Kernel<weight_gradient::Args>,
    outputs: u32,
    inputs: u32,
    chunk: u32,
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

/// `linear` for products of one size.
struct Product {
    kernel: Kernel<linear::Args>,
    inputs: u32,
    outputs: u32,
    /// Parts into which a launch cuts the outputs.
    parts: u32,
}

/// Inputs that an invocation of `linear` holds at most: with more, its code would no longer fit a processor's cache.
pub(super) const MOST_HELD: u32 = 80;

impl Product {
    /// `shape.tile` and `shape.held` are chosen here.
    fn new(gpu: &Gpu, label: &str, shape: linear::Shape, forms: Forms) -> Result<Product> {
        let (inputs, outputs) = (shape.inputs, shape.outputs);
        let tile = forms.linear.tile(outputs);
        // A few cores have work enough in the samples; reading an input anew for each tile costs them as much as its products.
        let held = gpu.info().few_cores && inputs <= MOST_HELD;
        let shape = linear::Shape {
            tile,
            held: u32::from(held),
            straight: u32::from(held && forms.linear.is_straight([inputs, outputs])),
            ..shape
        };
        let kernel = forms.linear.kernel(gpu, [inputs, outputs], shape)?;
        let parts = match kernel.matrix_tile() {
            Some([rows, _]) => outputs.div_ceil(rows),
            None if held => 1,
            None => outputs.div_ceil(tile),
        };
        Ok(Product {
            kernel: kernel.labelled(label),
            inputs,
            outputs,
            parts,
        })
    }

    fn run(&self, rec: &mut Recorder, args: linear::Args) {
        let (work, samples) = match self.kernel.matrix_tile() {
            Some([_, columns]) => (Work::groups(args.n.div_ceil(columns).into()), columns),
            None => (Work::items(args.n.into()), 1),
        };
        let connections = f64::from(self.inputs) * f64::from(self.outputs);
        let share = f64::from(samples) / f64::from(self.parts);
        let work = work
            .parts(self.parts)
            .flops(2.0 * connections * share)
            .bytes(4.0 * f64::from(self.inputs + self.outputs) * share);
        rec.run(&self.kernel, work, args);
    }
}

impl WeightGradient {
    /// `shape.tile` is chosen here.
    fn new(gpu: &Gpu, label: &str, shape: weight_gradient::Shape, form: Form) -> Result<Self> {
        let tile = form.tile(shape.inputs);
        let shape = weight_gradient::Shape { tile, ..shape };
        let kernel = form.kernel(gpu, [shape.inputs, shape.outputs], shape)?;
        let [outputs, inputs] = match kernel.matrix_tile() {
            Some(tile) => tile,
            None if shape.rows > 0 => [shape.rows, tile],
            None => [kernel.local_size(), tile],
        };
        Ok(WeightGradient {
            kernel: kernel.labelled(label),
            outputs,
            inputs,
            // Each subgroup adds up what it has of samples, which takes as long as some hundred of them.
            chunk: if shape.rows > 0 { 4096 } else { 1024 },
        })
    }
}

impl Layer {
    /// Builds the layer's kernels, in the forms that suit the device; `label` names their rows in the profile.
    pub fn new(gpu: &Gpu, label: &str, shape: LayerShape, handle: WeightHandle) -> Result<Layer> {
        let forms = Forms::of(gpu, shape.inputs.max(shape.outputs))?;
        Layer::in_forms(gpu, label, shape, handle, forms)
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
            tile: 1,
            held: 0,
            straight: 0,
        };
        let backward = if shape.backward_inputs > 0 {
            let adjoint = linear::Shape {
                inputs: shape.outputs,
                outputs: shape.backward_inputs,
                transposed: 1,
                bias: 0,
                activation: 0,
                gated: u32::from(shape.inputs_are_relu),
                ..base
            };
            let row = format!("{label} backward");
            Some(Product::new(gpu, &row, adjoint, forms)?)
        } else {
            None
        };
        let gradient = weight_gradient::Shape {
            inputs: shape.inputs,
            outputs: shape.outputs,
            bias,
            tile: 1,
            rows: 0,
        };
        let paired_gradient = match forms.gradient.rows(shape.outputs) {
            Some(rows) => {
                let shape = weight_gradient::Shape { rows, ..gradient };
                Some(WeightGradient::new(gpu, label, shape, forms.gradient)?)
            }
            None => None,
        };
        Ok(Layer {
            inputs: shape.inputs,
            outputs: shape.outputs,
            first_row: shape.first_row,
            handle,
            forward: Product::new(gpu, &format!("{label} forward"), base, forms)?,
            backward,
            inputs_are_relu: shape.inputs_are_relu,
            gradient: WeightGradient::new(gpu, label, gradient, forms.gradient)?,
            paired_gradient,
        })
    }

    /// Output channels.
    pub fn outputs(&self) -> u32 {
        self.outputs
    }

    fn weight_offset(&self) -> u64 {
        u64::from(self.first_row) * u64::from(self.inputs)
    }

    /// `y [outputs, n]` from `x [inputs, n]`.
    pub fn forward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        x: Planes<Ptr<f32>>,
        y: Planes<PtrMut<f32>>,
        n: u32,
    ) {
        let args = linear::Args {
            x: x.first,
            weight: params.weight(self.handle, self.weight_offset()),
            bias: params.bias(self.handle, u64::from(self.first_row)),
            gate: Ptr::NULL,
            y: y.first,
            n,
            stride_x: x.stride,
            stride_y: y.stride,
        };
        self.forward.run(rec, args);
    }

    /// `d_x [backward_inputs, n]` from the gradient `d_y [outputs, n]` before the activation; `x` gates it where the inputs are ReLU's, and
    /// then has the stride of `d_x`, which may take its place.
    pub fn backward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        d_y: Planes<Ptr<f32>>,
        x: Planes<Ptr<f32>>,
        d_x: Planes<PtrMut<f32>>,
        n: u32,
    ) {
        let product = self
            .backward
            .as_ref()
            .expect("a layer built without input gradients was asked for them");
        assert!(
            !self.inputs_are_relu || x.stride == d_x.stride,
            "a gate whose planes lie {} apart, for gradients {} apart",
            x.stride,
            d_x.stride
        );
        let args = linear::Args {
            x: d_y.first,
            weight: params.weight(self.handle, self.weight_offset()),
            bias: Ptr::NULL,
            gate: x.first,
            y: d_x.first,
            n,
            stride_x: d_y.stride,
            stride_y: d_x.stride,
        };
        product.run(rec, args);
    }

    /// Adds the gradients of weights and bias, from `x [inputs, n]` and `d_y [outputs, n]`.
    pub fn gradient(
        &self,
        rec: &mut Recorder,
        params: &Params,
        x: Planes<Ptr<f32>>,
        d_y: Planes<Ptr<f32>>,
        n: u32,
    ) {
        let even = [n, x.stride, d_y.stride]
            .iter()
            .all(|count| count.is_multiple_of(2));
        let gradient = match &self.paired_gradient {
            Some(paired) if even => paired,
            _ => &self.gradient,
        };
        let args = weight_gradient::Args {
            x: x.first,
            d_y: d_y.first,
            d_weight: params.d_weight(self.handle, self.weight_offset()),
            d_bias: params.d_bias(self.handle, u64::from(self.first_row)),
            n,
            stride_x: x.stride,
            stride_d_y: d_y.stride,
            chunk: gradient.chunk,
        };
        let slices =
            self.outputs.div_ceil(gradient.outputs) * self.inputs.div_ceil(gradient.inputs);
        let outputs = f64::from(gradient.outputs.min(self.outputs));
        let inputs = f64::from(gradient.inputs.min(self.inputs));
        let samples = f64::from(n.min(gradient.chunk));
        let work = Work::groups(n.div_ceil(gradient.chunk).into())
            .slices(slices)
            .flops(2.0 * outputs * inputs * samples)
            .bytes(4.0 * (outputs + inputs) * samples);
        rec.run(&gradient.kernel, work, args);
    }
}
