//! The surface: SDF, scale, geometry features and the colour network (Wang et al. 2024, NeuRodin).

use super::appearance::add_codes;
use super::field::{Field, FieldBuffers, FieldShape, Scratch};
use super::hash_grid::HashGrid;
use super::layer::{Activation, Layer, LayerShape};
use super::params::{Draws, Group, Init, Params, ParamsPlan};
use super::planes::{Activations, Planes};
use crate::Result;
use crate::config::{Config, DensityKind, GradientKind, ScaleKind};
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, PtrMut, Recorder, Work};
use crate::kernels::{
    appearance_backward, global_scale_backward, shade_backward, shade_forward, sigmoid_backward,
};

/// Parameters and kernels of the surface's networks.
pub struct Surface {
    pub field: Field,
    /// The same field, without gradient, under a name of its own in the profile: the extra points of bias correction.
    pub probes: Field,
    /// The same field under a name of its own in the profile: the extra points of the tangent-normal loss.
    beside: Option<Field>,
    heads: Layer,
    colors: Vec<Layer>,
    appearance: u64,
    appearance_dims: u32,
    geometry: u32,
    shade_forward: Kernel<shade_forward::Args>,
    shade_backward: Kernel<shade_backward::Args>,
    sigmoid_backward: Kernel<sigmoid_backward::Args>,
    appearance_backward: Kernel<appearance_backward::Args>,
    global_scale_backward: Kernel<global_scale_backward::Args>,
    /// Element offset of the scale that all samples share, if they do.
    global_scale: Option<u64>,
    /// Points around a sample; 0 where the gradient is analytic.
    taps: u32,
    gradient_has_other_uses: bool,
}

/// Activations of the surface at `n` samples and at the taps around each: 1, 5 or 7 blocks of points.
pub struct SurfaceBuffers {
    pub n: u32,
    pub points: Buffer<f32>, // [3, blocks * n] samples, then taps (glsl/lib/taps.glsl)
    pub field: FieldBuffers, // of all points
    pub sdf: Buffer<f32>,    // [blocks, n]
    pub d_sdf: Buffer<f32>,  // [blocks, n]
    pub shading: Buffer<f32>, // [rows, n] glsl/lib/shading.glsl; row 0 is the scale logit
    pub d_shading: Buffer<f32>, // [rows that receive gradients, n]
    /// Per hidden colour layer [width, n]; in the backward pass its gradient takes its place.
    pub hidden: Vec<Activations>,
    pub rgb: Buffer<f32>,       // [3, n] sigmoid output, not padded
    pub d_rgb: Buffer<f32>,     // [3, n]
    pub eikonal: Buffer<f32>,   // [n]
    pub curvature: Buffer<f32>, // [n] weighted, where there is a curvature loss
    /// ∂loss/∂g of a gradient by taps, through its other uses, where it has any.
    tap_d_gradient: Option<Buffer<f32>>, // [3, n]
}

/// Distance of the taps from their sample: max(range·u, floor) for a draw u, in region units.
#[derive(Clone, Copy, Debug)]
pub struct TapStep {
    pub range: f32,
    pub floor: f32,
}

/// Samples' companions that shading reads.
pub struct ShadeInputs {
    pub tap_draws: Ptr<f32>, // [n]
    pub tap_step: TapStep,
    /// λ/B of the curvature loss.
    pub curvature_scale: f32,
    pub directions: Ptr<f32>, // [3, n_rays]
    pub ray_view: Ptr<u32>,   // [n_rays]
    pub n_rays: u32,
}

const DIRECTION_ENCODING: u32 = 27;

/// Bytes that the encoding's derivatives at a batch of samples may take where they are kept.
const MOST_KEPT: u64 = 256 << 20;

impl Surface {
    /// The field's shape in this configuration.
    pub fn field_shape(config: &Config) -> FieldShape {
        Self::shape_that_keeps(1, config)
    }

    /// The same for the points of the tangent-normal loss, which hear what their gradient is to be.
    pub fn beside_shape(config: &Config) -> FieldShape {
        Self::shape_that_keeps(2, config)
    }

    /// Keeps derivatives up to this order, or as far as there is room.
    fn shape_that_keeps(order: u32, config: &Config) -> FieldShape {
        let hash = &config.hash;
        let grid = HashGrid {
            levels: hash.levels,
            base: hash.base,
            max: hash.max,
            log2_size: hash.log2_size,
            features: hash.features,
        };
        let samples = u64::from(config.rays) * u64::from(config.sampling.samples);
        let bytes_of_order = 12 * u64::from(grid.outputs()) * samples;
        let room = (MOST_KEPT / bytes_of_order.max(1)).min(2) as u32;
        FieldShape {
            grid,
            hidden: config.surface.hidden,
            coordinates: true,
            softplus: true,
            gradient: config.surface.gradient == GradientKind::Analytic,
            kept: order.min(room),
            half: hash.half,
        }
    }

    /// Adds the parameters with NeuRodin's geometric initialisation and builds the kernels. `views` counts the training views.
    pub fn new(gpu: &Gpu, config: &Config, plan: &mut ParamsPlan, views: u32) -> Result<Surface> {
        let shape = Self::field_shape(config);
        let (hidden, inputs) = (shape.hidden, shape.inputs());
        let geometry = config.surface.features;

        // Hidden layer: xyz columns N(0, √2/√hidden), hash columns 0 (published) or a share of that. Heads: all rows N(±√π/√hidden, 1e-4),
        // bias ∓init_bias, so that f ≈ ‖x‖ − r; mirrored where free space is inside. Rows of features may begin farther apart.
        let mut draws = Draws::new(config.seed, "surface");
        let deviation = (2.0 / f64::from(hidden)).sqrt();
        let v = (0..hidden * inputs)
            .map(|i| {
                let share = if i % inputs < 3 {
                    1.0
                } else {
                    config.surface.init_hash
                };
                match share > 0.0 {
                    true => draws.normal(0.0, share * deviation),
                    false => 0.0,
                }
            })
            .collect();
        let hidden_weight = plan.add_normalised(
            Group::Fields,
            "surface.hidden",
            u64::from(inputs),
            v,
            vec![0.0; hidden as usize],
            true,
        );
        let sign = if config.surface.inside_out { -1.0 } else { 1.0 };
        let mean = sign * (std::f64::consts::PI / f64::from(hidden)).sqrt();
        let rows = 2 + geometry;
        let v = (0..rows * hidden)
            .map(|i| {
                let share = match i / hidden < 2 {
                    true => 0.0,
                    false => config.surface.init_features,
                };
                draws.normal(mean, 1e-4 + share * mean.abs())
            })
            .collect();
        let bias = vec![(-sign * config.surface.init_bias) as f32; rows as usize];
        let heads_weight = plan.add_normalised(
            Group::Fields,
            "surface.heads",
            u64::from(hidden),
            v,
            bias,
            false,
        );
        let global_scale = (config.surface.scale != ScaleKind::Local).then(|| {
            let first = vec![config.surface.scale_init as f32];
            plan.add(Group::Fields, "surface.scale", &[1], Init::Values(first))
        });

        let appearance_dims = config.appearance.dims;
        let color_inputs = geometry + 3 + appearance_dims + 3 + DIRECTION_ENCODING;
        let widths: Vec<u32> = std::iter::once(color_inputs)
            .chain(std::iter::repeat_n(
                config.color.hidden,
                config.color.layers as usize,
            ))
            .chain([3])
            .collect();
        let mut draws = Draws::new(config.seed, "color");
        let mut colors = Vec::new();
        for (layer, pair) in widths.windows(2).enumerate() {
            let (n_in, n_out) = (pair[0], pair[1]);
            let last = layer + 2 == widths.len();
            // PyTorch's default: weights and bias U(±1/√fan_in), but for the gain.
            let bound = 1.0 / f64::from(n_in).sqrt();
            let v = (0..n_in * n_out)
                .map(|_| draws.symmetric(config.color.init_gain * bound))
                .collect();
            let bias = (0..n_out).map(|_| draws.symmetric(bound)).collect();
            let name = format!("color.{layer}");
            let handle = plan.add_normalised(Group::Fields, &name, u64::from(n_in), v, bias, false);
            let shape = LayerShape {
                inputs: n_in,
                outputs: n_out,
                first_row: 0,
                activation: if last {
                    Activation::Sigmoid
                } else {
                    Activation::Relu
                },
                backward_inputs: if layer == 0 {
                    geometry + 3 + appearance_dims
                } else {
                    n_in
                },
                inputs_are_relu: layer > 0,
            };
            colors.push(Layer::new(gpu, &name, shape, handle)?);
        }
        let appearance = add_codes(
            plan,
            Group::Fields,
            "appearance",
            config.seed,
            views,
            appearance_dims,
        );
        let entries = shape.grid.entries();
        let table = plan.add(
            Group::Table,
            "surface.table",
            &[entries, u64::from(shape.grid.features)],
            Init::Uniform { half_range: 1e-4 },
        );
        if shape.half {
            plan.keep_half(table);
        }

        let head_shape = LayerShape {
            inputs: hidden,
            outputs: 1 + geometry,
            first_row: 1,
            activation: Activation::None,
            backward_inputs: hidden,
            inputs_are_relu: false,
        };
        let taps = Self::blocks_of(config) - 1;
        let curvature = u32::from(config.loss.curvature.weight > 0.0);
        let gradient_has_other_uses = Self::gradient_has_other_uses(config);
        Ok(Surface {
            field: Field::new(gpu, "surface", shape, table, hidden_weight, heads_weight)?,
            probes: Field::new(
                gpu,
                "bias",
                shape.without_gradient(),
                table,
                hidden_weight,
                heads_weight,
            )?,
            beside: match shape.gradient {
                true => Some(Field::new(
                    gpu,
                    "tangent",
                    Self::beside_shape(config),
                    table,
                    hidden_weight,
                    heads_weight,
                )?),
                false => None,
            },
            heads: Layer::new(gpu, "heads", head_shape, heads_weight)?,
            colors,
            appearance,
            appearance_dims,
            geometry,
            shade_forward: gpu.kernel(shade_forward::Shape {
                geometry,
                appearance: appearance_dims,
                taps,
                curvature,
            })?,
            shade_backward: gpu.kernel(shade_backward::Shape {
                geometry,
                appearance: appearance_dims,
                taps,
                curvature,
                other_uses: u32::from(gradient_has_other_uses),
            })?,
            sigmoid_backward: gpu.kernel(sigmoid_backward::Shape::default())?,
            appearance_backward: gpu.kernel(appearance_backward::Shape::default())?,
            global_scale_backward: gpu.kernel(global_scale_backward::Shape::default())?,
            global_scale,
            taps,
            gradient_has_other_uses,
        })
    }

    /// Directions of the taps, unit vectors, as glsl/lib/taps.glsl has them.
    pub fn tap_directions(&self) -> &'static [[f32; 3]] {
        const CORNER: f32 = 0.577_350_3;
        match self.taps {
            4 => &[
                [CORNER, -CORNER, -CORNER],
                [-CORNER, -CORNER, CORNER],
                [-CORNER, CORNER, -CORNER],
                [CORNER, CORNER, CORNER],
            ],
            6 => &[
                [1.0, 0.0, 0.0],
                [-1.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [0.0, -1.0, 0.0],
                [0.0, 0.0, 1.0],
                [0.0, 0.0, -1.0],
            ],
            _ => &[],
        }
    }

    /// Columns of the hidden layer that act while so many levels of the grid are released.
    pub fn released_columns(&self, levels: u32) -> u32 {
        3 + levels * self.field.shape.grid.features
    }

    /// The field that the tangent-normal loss asks.
    ///
    /// # Panics
    /// If the configuration's gradient is not analytic.
    pub fn beside(&self) -> &Field {
        self.beside.as_ref().expect("a field with a gradient")
    }

    /// Points per sample: itself and its taps.
    pub fn blocks(&self) -> u32 {
        1 + self.taps
    }

    /// As [`Surface::blocks`], before there is a surface.
    pub fn blocks_of(config: &Config) -> u32 {
        match config.surface.gradient {
            GradientKind::Taps => 1 + config.surface.taps,
            GradientKind::Analytic => 1,
        }
    }

    fn gradient_rows(&self) -> u32 {
        1 + self.geometry + 3 + self.appearance_dims
    }

    /// Buffers for `n` samples.
    pub fn buffers(&self, gpu: &Gpu, n: u32) -> Result<SurfaceBuffers> {
        let (n64, blocks) = (u64::from(n), self.blocks());
        let width = |layer: usize| self.colors[layer].outputs();
        let hidden_layers = self.colors.len() - 1;
        let hidden = (0..hidden_layers)
            .map(|l| Activations::new(gpu, &format!("color hidden {l}"), width(l), n));
        let rows = u64::from(self.gradient_rows() + 3 + DIRECTION_ENCODING);
        Ok(SurfaceBuffers {
            n,
            points: gpu.scratch("surface points", 3 * u64::from(blocks) * n64)?,
            field: FieldBuffers::new(gpu, "surface", &self.field.shape, blocks * n, n)?,
            sdf: gpu.scratch("sdf", u64::from(blocks) * n64)?,
            d_sdf: gpu.scratch("d_sdf", u64::from(blocks) * n64)?,
            shading: gpu.scratch("shading", rows * n64)?,
            d_shading: gpu.scratch("d_shading", u64::from(self.gradient_rows()) * n64)?,
            hidden: hidden.collect::<Result<_>>()?,
            rgb: gpu.scratch("rgb", 3 * n64)?,
            d_rgb: gpu.scratch("d_rgb", 3 * n64)?,
            eikonal: gpu.scratch("eikonal", n64)?,
            curvature: gpu.scratch("curvature", n64)?,
            tap_d_gradient: match self.taps > 0 && self.gradient_has_other_uses {
                true => Some(gpu.scratch("tap d_gradient", 3 * n64)?),
                false => None,
            },
        })
    }

    /// SDF at samples and taps, scale logit, gradient and colour of the samples in `b.points`.
    pub fn forward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        b: &SurfaceBuffers,
        inputs: &ShadeInputs,
    ) {
        self.field
            .forward(rec, params, b.points.ptr(), &b.field, b.sdf.ptr_mut());
        let gradient = match self.field.shape.gradient {
            true => {
                self.field.gradient(rec, params, b.points.ptr(), &b.field);
                b.field.slope().gradient.ptr()
            }
            false => Ptr::NULL, // the kernel takes it from the taps
        };
        self.heads.forward(
            rec,
            params,
            b.field.hidden.read(),
            Planes::new(b.shading.ptr_mut(), b.n),
            b.n,
        );
        let args = shade_forward::Args {
            sdf: b.sdf.ptr(),
            tap_draws: inputs.tap_draws,
            gradient,
            points: b.points.ptr(),
            directions: inputs.directions,
            ray_view: inputs.ray_view,
            appearance: params.values().ptr().offset(self.appearance),
            shading: b.shading.ptr_mut(),
            eikonal: b.eikonal.ptr_mut(),
            curvature: b.curvature.ptr_mut(),
            n: b.n,
            n_rays: inputs.n_rays,
            tap_range: inputs.tap_step.range,
            tap_floor: inputs.tap_step.floor,
            curvature_scale: inputs.curvature_scale,
        };
        rec.run(
            &self.shade_forward,
            Work::items(u64::from(b.n)).flops(200.0).bytes(200.0),
            args,
        );
        let mut x = self.color_inputs(b);
        for (layer, color) in self.colors.iter().enumerate() {
            let y = match b.hidden.get(layer) {
                Some(hidden) => hidden.write(),
                None => Planes::new(b.rgb.ptr_mut(), b.n),
            };
            color.forward(rec, params, x, y, b.n);
            x = y.read();
        }
    }

    /// Adds all gradients, from `b.d_rgb`, `b.d_sdf` block 0, the scale's row 0 of `b.d_shading` and [`Surface::d_gradient`].
    /// `eikonal_scale` is λ/B.
    pub fn backward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        b: &SurfaceBuffers,
        scratch: &Scratch,
        inputs: &ShadeInputs,
        eikonal_scale: f32,
    ) {
        let n = b.n;
        if let Some(scale) = self.global_scale {
            let args = global_scale_backward::Args {
                d_scale: self.d_scale(b),
                d_parameter: params.d_value(scale),
                n,
            };
            let work = Work::items(1).bytes(8.0 * f64::from(n));
            rec.run(&self.global_scale_backward, work, args);
        }
        let work = Work::items(3 * u64::from(n));
        let args = sigmoid_backward::Args {
            y: b.rgb.ptr(),
            d_y: b.d_rgb.ptr_mut(),
            n: 3 * n,
        };
        rec.run(&self.sigmoid_backward, work, args);
        let mut d_y = Planes::new(b.d_rgb.ptr(), n);
        for (layer, color) in self.colors.iter().enumerate().rev() {
            let (x, d_x) = match layer {
                0 => (
                    self.color_inputs(b),
                    Planes::new(b.d_shading.ptr_mut().offset(u64::from(n)), n),
                ),
                _ => (b.hidden[layer - 1].read(), b.hidden[layer - 1].write()),
            };
            color.gradient(rec, params, x, d_y, n);
            color.backward(rec, params, d_y, x, d_x, n);
            d_y = d_x.read();
        }
        let args = shade_backward::Args {
            sdf: b.sdf.ptr(),
            shading: b.shading.ptr(),
            d_shading: b.d_shading.ptr(),
            tap_draws: inputs.tap_draws,
            d_sdf: b.d_sdf.ptr_mut(),
            d_gradient: self.d_gradient(b),
            n,
            tap_range: inputs.tap_step.range,
            tap_floor: inputs.tap_step.floor,
            eikonal_scale,
            curvature_scale: inputs.curvature_scale,
        };
        rec.run(
            &self.shade_backward,
            Work::items(u64::from(n)).flops(30.0).bytes(56.0),
            args,
        );
        if self.appearance_dims > 0 {
            let args = appearance_backward::Args {
                d_code: b
                    .d_shading
                    .ptr()
                    .offset(u64::from(1 + self.geometry + 3) * u64::from(n)),
                ray_view: inputs.ray_view,
                d_appearance: params.d_value(self.appearance),
                n_rays: inputs.n_rays,
                n_samples: n / inputs.n_rays,
                channels: self.appearance_dims,
            };
            rec.run(
                &self.appearance_backward,
                Work::items(u64::from(inputs.n_rays * self.appearance_dims)),
                args,
            );
        }
        let (hidden, d_hidden) = (b.field.hidden.read(), b.field.hidden.write());
        let d_heads = Planes::new(b.d_shading.ptr(), n);
        self.heads.gradient(rec, params, hidden, d_heads, n);
        self.heads
            .backward(rec, params, d_heads, hidden, d_hidden, n);
        self.field.backward(
            rec,
            params,
            b.points.ptr(),
            b.d_sdf.ptr(),
            &b.field,
            scratch,
            None,
        );
    }

    fn color_inputs(&self, b: &SurfaceBuffers) -> Planes<Ptr<f32>> {
        Planes::new(b.shading.ptr().offset(u64::from(b.n)), b.n)
    }

    /// Element of `shading` at which the gradient's three rows begin.
    pub fn gradient_row(&self, b: &SurfaceBuffers) -> u64 {
        u64::from(1 + self.geometry) * u64::from(b.n)
    }

    /// The scale: `[n]` logits, or `[1]` where all samples share one.
    pub fn scale(&self, params: &Params, b: &SurfaceBuffers) -> Ptr<f32> {
        match self.global_scale {
            Some(scale) => params.values().ptr().offset(scale),
            None => b.shading.ptr(),
        }
    }

    /// Where the scale's gradients `[n]` are to be written, row 0 of the shading gradients; of a shared one the summands.
    pub fn d_scale(&self, b: &SurfaceBuffers) -> PtrMut<f32> {
        b.d_shading.ptr_mut()
    }

    /// Whether more than shading and the eikonal loss uses the SDF's gradient: with an analytic one other losses may, with any a density
    /// that is a function of it and a loss on rendered normals.
    pub fn gradient_has_other_uses(config: &Config) -> bool {
        config.surface.gradient == GradientKind::Analytic
            || config.surface.density != DensityKind::Laplace
            || config.loss.mono_normal > 0.0
    }

    /// The SDF's gradient at the samples, `[3, n]`.
    pub fn gradient(&self, b: &SurfaceBuffers) -> Ptr<f32> {
        b.shading.ptr().offset(self.gradient_row(b))
    }

    /// Where ∂loss/∂g of the SDF's gradient through its other uses is to be written, `[3, n]`; nowhere if it has none.
    pub fn d_gradient(&self, b: &SurfaceBuffers) -> PtrMut<f32> {
        match (&b.tap_d_gradient, self.field.shape.gradient) {
            (Some(of_taps), _) => of_taps.ptr_mut(),
            (None, true) => b.field.slope().d_gradient.ptr_mut(),
            (None, false) => PtrMut::NULL,
        }
    }
}
