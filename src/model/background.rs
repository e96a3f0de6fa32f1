//! What a ray sees behind the region: nothing, one learned colour, or a learned radiance field (after nerfstudio's nerfacto, as in
//! NeuRodin's released code).

use super::appearance::add_codes;
use super::field::{Field, FieldBuffers, FieldShape, Scratch};
use super::hash_grid::HashGrid;
use super::layer::{Activation, Layer, LayerShape};
use super::params::{Draws, Group, Init, Params, ParamsPlan};
use super::planes::{Activations, Planes};
use crate::Result;
use crate::config::{BackgroundKind, Config};
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, Recorder, Work};
use crate::kernels::{
    background_composite_backward, background_composite_forward, background_constant,
    background_constant_backward, background_points, background_shade, sigmoid_backward,
};

/// The three kinds of background.
pub enum Background {
    None,
    Constant(Constant),
    Field(Box<Radiance>),
}

/// Activations of the background for a batch of rays.
pub struct BackgroundBuffers {
    pub color: Buffer<f32>,   // [3, n_rays]; black where there is no background
    pub d_color: Buffer<f32>, // [3, n_rays]
    radiance: Option<RadianceBuffers>,
}

/// What the background reads of the rays.
pub struct BackgroundRays {
    pub origins: Ptr<f32>,    // [3, n_rays]
    pub directions: Ptr<f32>, // [3, n_rays]
    pub near_far: Ptr<f32>,   // [2, n_rays]
    pub ray_view: Ptr<u32>,   // [n_rays]
    pub draws: Ptr<f32>,      // [n_rays, samples + 1]
    pub jittered: bool,
    pub n_rays: u32,
}

impl Background {
    /// The field's shape in this configuration, if its background has one.
    pub fn field_shape(config: &Config) -> Option<FieldShape> {
        let b = &config.background;
        (b.kind == BackgroundKind::Field).then_some(FieldShape {
            grid: HashGrid {
                levels: b.levels,
                base: b.base,
                max: b.max,
                log2_size: b.log2_size,
                features: b.features,
            },
            hidden: b.hidden,
            coordinates: false,
            softplus: false,
            gradient: false,
            kept: 0,
            half: false,
        })
    }

    /// Random numbers per ray and step.
    pub fn draws_per_ray(config: &Config) -> u32 {
        match config.background.kind {
            BackgroundKind::Field => config.background.samples + 1,
            BackgroundKind::None | BackgroundKind::Constant => 0,
        }
    }

    /// Adds the parameters and builds the kernels. `sky` is where a constant background starts: a sky that began far from its colour
    /// would first be explained by an opaque shell around the cameras, which never goes away again.
    pub fn new(
        gpu: &Gpu,
        config: &Config,
        plan: &mut ParamsPlan,
        views: u32,
        sky: [f32; 3],
    ) -> Result<Background> {
        Ok(match config.background.kind {
            BackgroundKind::None => Background::None,
            BackgroundKind::Constant => Background::Constant(Constant::new(gpu, plan, sky)?),
            BackgroundKind::Field => {
                Background::Field(Box::new(Radiance::new(gpu, config, plan, views)?))
            }
        })
    }

    /// Buffers for a batch of rays.
    pub fn buffers(&self, gpu: &Gpu, n_rays: u32) -> Result<BackgroundBuffers> {
        Ok(BackgroundBuffers {
            // Zero-filled, not scratch: without a background nobody writes it.
            color: gpu.buffer("background color", 3 * u64::from(n_rays))?,
            d_color: gpu.scratch("background d_color", 3 * u64::from(n_rays))?,
            radiance: match self {
                Background::Field(radiance) => Some(radiance.buffers(gpu, n_rays)?),
                Background::None | Background::Constant(_) => None,
            },
        })
    }

    /// Colour behind each ray, into `b.color`.
    pub fn forward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        b: &BackgroundBuffers,
        rays: &BackgroundRays,
    ) {
        match self {
            Background::None => {}
            Background::Constant(constant) => constant.forward(rec, params, b, rays.n_rays),
            Background::Field(radiance) => radiance.forward(rec, params, b, rays),
        }
    }

    /// Adds all gradients, from `b.d_color`.
    pub fn backward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        b: &BackgroundBuffers,
        scratch: &Scratch,
        rays: &BackgroundRays,
    ) {
        match self {
            Background::None => {}
            Background::Constant(constant) => constant.backward(rec, params, b, rays.n_rays),
            Background::Field(radiance) => radiance.backward(rec, params, b, scratch, rays),
        }
    }
}

/// One learned colour, as logits.
pub struct Constant {
    logits: u64,
    forward: Kernel<background_constant::Args>,
    backward: Kernel<background_constant_backward::Args>,
}

impl Constant {
    fn new(gpu: &Gpu, plan: &mut ParamsPlan, sky: [f32; 3]) -> Result<Constant> {
        let logits = sky
            .map(|c| c.clamp(0.01, 0.99))
            .map(|c| (c / (1.0 - c)).ln());
        Ok(Constant {
            logits: plan.add(
                Group::Background,
                "background.constant",
                &[3],
                Init::Values(logits.to_vec()),
            ),
            forward: gpu.kernel(background_constant::Shape::default())?,
            backward: gpu.kernel(background_constant_backward::Shape::default())?,
        })
    }

    fn forward(&self, rec: &mut Recorder, params: &Params, b: &BackgroundBuffers, n_rays: u32) {
        let logits = params.values().ptr().offset(self.logits);
        let args = background_constant::Args {
            logits,
            color: b.color.ptr_mut(),
            n_rays,
        };
        rec.run(&self.forward, Work::items(u64::from(n_rays)), args);
    }

    fn backward(&self, rec: &mut Recorder, params: &Params, b: &BackgroundBuffers, n_rays: u32) {
        let args = background_constant_backward::Args {
            logits: params.values().ptr().offset(self.logits),
            d_color: b.d_color.ptr(),
            d_logits: params.d_value(self.logits),
            n_rays,
        };
        rec.run(&self.backward, Work::items(1), args);
    }
}

/// A radiance field: density from a hash grid, colour from its features, the direction and an appearance code.
pub struct Radiance {
    field: Field,
    heads: Layer,
    colors: Vec<Layer>,
    appearance: u64,
    appearance_dims: u32,
    geometry: u32,
    n_samples: u32,
    far: f32,
    points: Kernel<background_points::Args>,
    shade: Kernel<background_shade::Args>,
    sigmoid_backward: Kernel<sigmoid_backward::Args>,
    composite_forward: Kernel<background_composite_forward::Args>,
    composite_backward: Kernel<background_composite_backward::Args>,
    appearance_backward: Kernel<crate::kernels::appearance_backward::Args>,
}

struct RadianceBuffers {
    field: FieldBuffers,
    edges: Buffer<f32>,       // [n_rays, samples + 1] distances
    points: Buffer<f32>,      // [3, n]
    raw: Buffer<f32>,         // [n]
    d_raw: Buffer<f32>,       // [n]
    shading: Buffer<f32>,     // [geometry + appearance + 16, n] glsl/lib/background.glsl
    d_shading: Buffer<f32>,   // [geometry + appearance, n]
    hidden: [Activations; 2], // [64, n]; in the backward pass its gradient takes its place
    rgb: Buffer<f32>,         // [3, n]
    d_rgb: Buffer<f32>,       // [3, n]
}

const HARMONICS: u32 = 16;

impl Radiance {
    fn new(gpu: &Gpu, config: &Config, plan: &mut ParamsPlan, views: u32) -> Result<Radiance> {
        let shape = Background::field_shape(config)
            .expect("a radiance field is only built where the configuration has one");
        let (hidden, inputs, geometry) = (shape.hidden, shape.inputs(), config.background.geometry);
        let appearance_dims = config.appearance.dims;
        let mut draws = Draws::new(config.seed, "background");
        // Xavier: U(±√(6/(fan_in + fan_out))).
        let mut matrix = |rows: u32, columns: u32| -> Vec<f32> {
            let bound = (6.0 / f64::from(rows + columns)).sqrt();
            (0..rows * columns)
                .map(|_| draws.symmetric(bound))
                .collect()
        };
        let group = Group::Background;
        let table = plan.add(
            group,
            "background.table",
            &[shape.grid.entries(), u64::from(shape.grid.features)],
            Init::Uniform { half_range: 1e-4 },
        );
        let mut add = |name: &str, rows: u32, columns: u32, plan: &mut ParamsPlan| {
            plan.add_plain(
                group,
                name,
                u64::from(rows),
                u64::from(columns),
                matrix(rows, columns),
            )
        };
        let hidden_handle = add("background.hidden", hidden, inputs, plan);
        let heads_handle = add("background.heads", 1 + geometry, hidden, plan);
        let color_inputs = geometry + appearance_dims + HARMONICS;
        let widths = [color_inputs, 64, 64, 3];
        let mut colors = Vec::new();
        for (layer, pair) in widths.windows(2).enumerate() {
            let name = format!("background.color.{layer}");
            let handle = add(&name, pair[1], pair[0], plan);
            let layer_shape = LayerShape {
                inputs: pair[0],
                outputs: pair[1],
                first_row: 0,
                activation: if layer == 2 {
                    Activation::Sigmoid
                } else {
                    Activation::Relu
                },
                backward_inputs: if layer == 0 {
                    geometry + appearance_dims
                } else {
                    pair[0]
                },
                inputs_are_relu: layer > 0,
            };
            colors.push(Layer::new(gpu, &name, layer_shape, handle)?);
        }
        let appearance = add_codes(
            plan,
            group,
            "background.appearance",
            config.seed,
            views,
            appearance_dims,
        );
        let head_shape = LayerShape {
            inputs: hidden,
            outputs: geometry,
            first_row: 1,
            activation: Activation::None,
            backward_inputs: hidden,
            inputs_are_relu: false,
        };
        Ok(Radiance {
            field: Field::new(gpu, "background", shape, table, hidden_handle, heads_handle)?,
            heads: Layer::new(gpu, "background heads", head_shape, heads_handle)?,
            colors,
            appearance,
            appearance_dims,
            geometry,
            n_samples: config.background.samples,
            far: config.background.far as f32,
            points: gpu.kernel(background_points::Shape {
                contraction: u32::from(config.background.contraction),
            })?,
            shade: gpu.kernel(background_shade::Shape {
                geometry,
                appearance: appearance_dims,
            })?,
            sigmoid_backward: gpu
                .kernel(sigmoid_backward::Shape::default())?
                .labelled("background"),
            composite_forward: gpu.kernel(background_composite_forward::Shape::default())?,
            composite_backward: gpu.kernel(background_composite_backward::Shape::default())?,
            appearance_backward: gpu
                .kernel(crate::kernels::appearance_backward::Shape::default())?
                .labelled("background"),
        })
    }

    fn buffers(&self, gpu: &Gpu, n_rays: u32) -> Result<RadianceBuffers> {
        let n = n_rays * self.n_samples;
        let scratch = |what: &str, rows: u32| {
            gpu.scratch(
                &format!("background {what}"),
                u64::from(rows) * u64::from(n),
            )
        };
        Ok(RadianceBuffers {
            field: FieldBuffers::new(gpu, "background", &self.field.shape, n, n)?,
            edges: gpu.scratch(
                "background edges",
                u64::from(n_rays) * u64::from(self.n_samples + 1),
            )?,
            points: scratch("points", 3)?,
            raw: scratch("raw", 1)?,
            d_raw: scratch("d_raw", 1)?,
            shading: scratch("shading", self.geometry + self.appearance_dims + HARMONICS)?,
            d_shading: scratch("d_shading", self.geometry + self.appearance_dims)?,
            hidden: [
                Activations::new(gpu, "background hidden 0", 64, n)?,
                Activations::new(gpu, "background hidden 1", 64, n)?,
            ],
            rgb: scratch("rgb", 3)?,
            d_rgb: scratch("d_rgb", 3)?,
        })
    }

    fn forward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        b: &BackgroundBuffers,
        rays: &BackgroundRays,
    ) {
        let r = b.radiance.as_ref().expect("a radiance field's buffers");
        let (n_rays, n_samples, n) = (rays.n_rays, self.n_samples, rays.n_rays * self.n_samples);
        let args = background_points::Args {
            origins: rays.origins,
            directions: rays.directions,
            near_far: rays.near_far,
            draws: rays.draws,
            edges: r.edges.ptr_mut(),
            points: r.points.ptr_mut(),
            n_rays,
            n_samples,
            far: self.far,
            jittered: u32::from(rays.jittered),
        };
        rec.run(
            &self.points,
            Work::items(u64::from(n_rays)).bytes(20.0 * f64::from(n_samples)),
            args,
        );
        self.field
            .forward(rec, params, r.points.ptr(), &r.field, r.raw.ptr_mut());
        let shading = Planes::new(r.shading.ptr_mut(), n);
        self.heads
            .forward(rec, params, r.field.hidden.read(), shading, n);
        let args = background_shade::Args {
            directions: rays.directions,
            ray_view: rays.ray_view,
            appearance: params.values().ptr().offset(self.appearance),
            shading: r.shading.ptr_mut(),
            n,
            n_rays,
        };
        rec.run(
            &self.shade,
            Work::items(u64::from(n)).flops(60.0).bytes(64.0),
            args,
        );
        let rgb = Planes::new(r.rgb.ptr_mut(), n);
        let activations = [shading, r.hidden[0].write(), r.hidden[1].write(), rgb];
        for (color, pair) in self.colors.iter().zip(activations.windows(2)) {
            color.forward(rec, params, pair[0].read(), pair[1], n);
        }
        let args = background_composite_forward::Args {
            edges: r.edges.ptr(),
            raw: r.raw.ptr(),
            rgb: r.rgb.ptr(),
            color: b.color.ptr_mut(),
            n_rays,
            n_samples,
        };
        rec.run(
            &self.composite_forward,
            Work::items(u64::from(n_rays)).bytes(20.0 * f64::from(n_samples)),
            args,
        );
    }

    fn backward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        b: &BackgroundBuffers,
        scratch: &Scratch,
        rays: &BackgroundRays,
    ) {
        let r = b.radiance.as_ref().expect("a radiance field's buffers");
        let (n_rays, n_samples, n) = (rays.n_rays, self.n_samples, rays.n_rays * self.n_samples);
        let args = background_composite_backward::Args {
            edges: r.edges.ptr(),
            raw: r.raw.ptr(),
            rgb: r.rgb.ptr(),
            d_color: b.d_color.ptr(),
            d_raw: r.d_raw.ptr_mut(),
            d_rgb: r.d_rgb.ptr_mut(),
            n_rays,
            n_samples,
        };
        rec.run(
            &self.composite_backward,
            Work::items(u64::from(n_rays)).bytes(36.0 * f64::from(n_samples)),
            args,
        );
        let args = sigmoid_backward::Args {
            y: r.rgb.ptr(),
            d_y: r.d_rgb.ptr_mut(),
            n: 3 * n,
        };
        rec.run(
            &self.sigmoid_backward,
            Work::items(3 * u64::from(n)).bytes(12.0),
            args,
        );
        let shading = Planes::new(r.shading.ptr(), n);
        let xs = [shading, r.hidden[0].read(), r.hidden[1].read()];
        let d_shading = Planes::new(r.d_shading.ptr_mut(), n);
        let d_xs = [d_shading, r.hidden[0].write(), r.hidden[1].write()];
        let mut d_y = Planes::new(r.d_rgb.ptr(), n);
        for layer in (0..3).rev() {
            self.colors[layer].gradient(rec, params, xs[layer], d_y, n);
            self.colors[layer].backward(rec, params, d_y, xs[layer], d_xs[layer], n);
            d_y = d_xs[layer].read();
        }
        if self.appearance_dims > 0 {
            let args = crate::kernels::appearance_backward::Args {
                d_code: r
                    .d_shading
                    .ptr()
                    .offset(u64::from(self.geometry) * u64::from(n)),
                ray_view: rays.ray_view,
                d_appearance: params.d_value(self.appearance),
                n_rays,
                n_samples,
                channels: self.appearance_dims,
            };
            rec.run(
                &self.appearance_backward,
                Work::items(u64::from(n_rays * self.appearance_dims)),
                args,
            );
        }
        let (hidden, d_hidden) = (r.field.hidden.read(), r.field.hidden.write());
        self.heads
            .gradient(rec, params, hidden, d_shading.read(), n);
        self.heads
            .backward(rec, params, d_shading.read(), hidden, d_hidden, n);
        self.field.backward(
            rec,
            params,
            r.points.ptr(),
            r.d_raw.ptr(),
            &r.field,
            scratch,
            None,
        );
    }
}
