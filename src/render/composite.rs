//! From samples to pixels and back: optical depth (glsl/lib/optical_depth.glsl) and quadrature (Mildenhall et al. 2020, NeRF).

use super::rays::Rays;
use super::renderer::Annealed;
use super::sampler::Sampler;
use crate::Result;
use crate::config::{Config, DensityKind, ScaleKind};
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, Recorder, Work};
use crate::kernels::{
    composite_backward, composite_forward, normal_map, normal_map_backward, optical_depth,
    optical_depth_backward,
};
use crate::model::{BackgroundBuffers, Model, Surface, SurfaceBuffers};

/// Kernels and results of compositing a batch.
pub struct Composite {
    pub weights: Buffer<f32>, // [n_rays, n_samples]
    pub image: Buffer<f32>, // [6, n_rays] red, green, blue, accumulation, transmittance behind the last sample, depth
    pub normals: Buffer<f32>, // [3, n_rays]
    forward: Kernel<composite_forward::Args>,
    backward: Kernel<composite_backward::Args>,
    normal_map: Kernel<normal_map::Args>,
    /// Where there is a loss on normals.
    normal_map_backward: Option<Kernel<normal_map_backward::Args>>,
    optical_depth: Buffer<f32>, // [n_rays, n_samples]
    optical_depth_forward: Kernel<optical_depth::Args>,
    optical_depth_backward: Kernel<optical_depth_backward::Args>,
    scale_range: f32,
    scale_floor: f32,
}

/// Everything that compositing reads of a batch.
pub struct Look<'a> {
    pub rays: &'a Rays,
    pub sampler: &'a Sampler,
    pub surface: &'a SurfaceBuffers,
    pub background: &'a BackgroundBuffers,
    pub now: Annealed,
}

impl Composite {
    /// Buffers and kernels for a batch of rays.
    pub fn new(gpu: &Gpu, config: &Config, n_rays: u32) -> Result<Composite> {
        let (n, samples) = (u64::from(n_rays), u64::from(config.sampling.samples));
        let density = density_of(config.surface.density);
        let scale = scale_of(config.surface.scale);
        Ok(Composite {
            weights: gpu.scratch("weights", n * samples)?,
            image: gpu.scratch("image", 6 * n)?,
            normals: gpu.scratch("normals", 3 * n)?,
            forward: gpu.kernel(composite_forward::Shape::default())?,
            backward: gpu.kernel(composite_backward::Shape {
                supervised: u32::from(config.loss.is_supervised()),
            })?,
            normal_map: gpu.kernel(normal_map::Shape::default())?,
            normal_map_backward: match config.loss.mono_normal > 0.0 {
                true => Some(gpu.kernel(normal_map_backward::Shape::default())?),
                false => None,
            },
            optical_depth: gpu.scratch("optical depth", n * samples)?,
            optical_depth_forward: gpu.kernel(optical_depth::Shape { density, scale })?,
            optical_depth_backward: gpu.kernel(optical_depth_backward::Shape {
                density,
                scale,
                gradient: u32::from(Surface::gradient_has_other_uses(config)),
            })?,
            scale_range: match config.surface.scale {
                ScaleKind::Exponential => config.surface.scale_rate,
                _ => config.surface.scale_max,
            } as f32,
            scale_floor: config.surface.scale_floor as f32,
        })
    }

    /// Weights and pixels.
    pub fn forward(&self, rec: &mut Recorder, look: &Look, model: &Model) {
        let (n, n_samples) = (look.rays.n, look.sampler.n_samples);
        let surface = look.surface;
        let args = optical_depth::Args {
            sdf: surface.sdf.ptr(),
            gradient: model.surface.gradient(surface),
            scale: model.surface.scale(&model.params, surface),
            directions: look.rays.directions.ptr(),
            edges: look.sampler.edges.ptr(),
            near_far: look.rays.near_far.ptr(),
            ray_outside: look.rays.outside.ptr(),
            optical_depth: self.optical_depth.ptr_mut(),
            n_rays: n,
            n_samples,
            scale_range: self.scale_range,
            scale_floor: self.scale_floor,
            inv_s_lower: look.now.inv_s_lower,
            anneal: look.now.cosine_anneal,
        };
        rec.run(&self.optical_depth_forward, per_sample(n, n_samples), args);
        let args = composite_forward::Args {
            optical_depth: self.optical_depth.ptr(),
            edges: look.sampler.edges.ptr(),
            near_far: look.rays.near_far.ptr(),
            rgb: surface.rgb.ptr(),
            background: look.background.color.ptr(),
            weights: self.weights.ptr_mut(),
            image: self.image.ptr_mut(),
            n_rays: n,
            n_samples,
        };
        rec.run(&self.forward, per_ray(n, n_samples), args);
    }

    /// Gradients of SDF (block 0), scale, colour and background, and where density or rendered normals read it, of the SDF's gradient,
    /// from `d_color [3, n_rays]` and, where there are losses on more than colour, `d_image [5, n_rays]`.
    pub fn backward(
        &self,
        rec: &mut Recorder,
        look: &Look,
        model: &Model,
        d_color: &Buffer<f32>,
        d_image: Option<&Buffer<f32>>,
    ) {
        let (n, n_samples) = (look.rays.n, look.sampler.n_samples);
        let surface = look.surface;
        let args = composite_backward::Args {
            optical_depth: self.optical_depth.ptr(),
            rgb: surface.rgb.ptr(),
            background: look.background.color.ptr(),
            d_color: d_color.ptr(),
            edges: look.sampler.edges.ptr(),
            near_far: look.rays.near_far.ptr(),
            image: self.image.ptr(),
            gradient: model.surface.gradient(surface),
            d_image: d_image.map_or(Ptr::NULL, Buffer::ptr),
            // Left where the SDF's own gradient will take its place.
            d_optical_depth: surface.d_sdf.ptr_mut(),
            d_rgb: surface.d_rgb.ptr_mut(),
            d_background: look.background.d_color.ptr_mut(),
            n_rays: n,
            n_samples,
        };
        rec.run(&self.backward, per_ray(n, 2 * n_samples), args);
        let args = optical_depth_backward::Args {
            sdf: surface.sdf.ptr(),
            gradient: model.surface.gradient(surface),
            scale: model.surface.scale(&model.params, surface),
            directions: look.rays.directions.ptr(),
            edges: look.sampler.edges.ptr(),
            near_far: look.rays.near_far.ptr(),
            ray_outside: look.rays.outside.ptr(),
            d_sdf: surface.d_sdf.ptr_mut(),
            d_scale: model.surface.d_scale(surface),
            d_gradient: model.surface.d_gradient(surface),
            n_rays: n,
            n_samples,
            scale_range: self.scale_range,
            scale_floor: self.scale_floor,
            inv_s_lower: look.now.inv_s_lower,
            anneal: look.now.cosine_anneal,
        };
        rec.run(&self.optical_depth_backward, per_sample(n, n_samples), args);
        // Added to what optical_depth_backward wrote.
        if let (Some(kernel), Some(d_image)) = (&self.normal_map_backward, d_image) {
            let args = normal_map_backward::Args {
                weights: self.weights.ptr(),
                gradient: model.surface.gradient(surface),
                d_image: d_image.ptr(),
                d_gradient: model.surface.d_gradient(surface),
                n_rays: n,
                n_samples,
            };
            rec.run(kernel, per_sample(n, n_samples), args);
        }
    }

    /// Rendered normals, into `self.normals`.
    pub fn normal_map(&self, rec: &mut Recorder, look: &Look, model: &Model) {
        let args = normal_map::Args {
            weights: self.weights.ptr(),
            gradient: model.surface.gradient(look.surface),
            normals: self.normals.ptr_mut(),
            n_rays: look.rays.n,
            n_samples: look.sampler.n_samples,
        };
        rec.run(
            &self.normal_map,
            per_ray(look.rays.n, look.sampler.n_samples),
            args,
        );
    }
}

/// By the numbers of glsl/lib/optical_depth.glsl.
pub(super) fn density_of(kind: DensityKind) -> u32 {
    match kind {
        DensityKind::Laplace => 0,
        DensityKind::Sight => 1,
        DensityKind::Neus => 2,
    }
}

pub(super) fn scale_of(kind: ScaleKind) -> u32 {
    match kind {
        ScaleKind::Local => 0,
        ScaleKind::Beta => 1,
        ScaleKind::Exponential => 2,
    }
}

fn per_ray(n: u32, n_samples: u32) -> Work {
    Work::items(u64::from(n))
        .flops(60.0 * f64::from(n_samples))
        .bytes(40.0 * f64::from(n_samples))
}

fn per_sample(n: u32, n_samples: u32) -> Work {
    Work::items(u64::from(n) * u64::from(n_samples))
        .flops(20.0)
        .bytes(30.0)
}
