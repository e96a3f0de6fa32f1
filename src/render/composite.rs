//! From samples to pixels and back: local scale, Laplace density, quadrature (METHOD 2.5, 2.6).

use super::rays::Rays;
use super::sampler::Sampler;
use crate::Result;
use crate::config::{BackgroundKind, Config, GradientKind};
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, Recorder, Work};
use crate::kernels::{
    composite_backward, composite_forward, normal_map, sight_distance, sight_distance_backward,
};
use crate::model::{BackgroundBuffers, Surface, SurfaceBuffers};

/// Kernels and results of compositing a batch.
pub struct Composite {
    pub weights: Buffer<f32>, // [n_rays, n_samples]
    pub image: Buffer<f32>, // [6, n_rays] red, green, blue, accumulation, transmittance behind the last sample, depth
    pub normals: Buffer<f32>, // [3, n_rays]
    forward: Kernel<composite_forward::Args>,
    backward: Kernel<composite_backward::Args>,
    normal_map: Kernel<normal_map::Args>,
    sight: Option<Sight>,
    scale_range: f32,
    scale_floor: f32,
    outside_empty: u32,
}

/// What turns signed distances into those along the line of sight, where the density is a function of these (METHOD 2.5, stage 2).
struct Sight {
    distance: Buffer<f32>, // [n]
    forward: Kernel<sight_distance::Args>,
    backward: Kernel<sight_distance_backward::Args>,
}

/// Everything that compositing reads of a batch.
pub struct Look<'a> {
    pub rays: &'a Rays,
    pub sampler: &'a Sampler,
    pub surface: &'a SurfaceBuffers,
    pub background: &'a BackgroundBuffers,
    /// Lower bound of 1/β.
    pub inv_s_lower: f32,
}

impl Composite {
    /// Buffers and kernels for a batch of rays.
    pub fn new(gpu: &Gpu, config: &Config, n_rays: u32) -> Result<Composite> {
        let (n, samples) = (u64::from(n_rays), u64::from(config.sampling.samples));
        let shading = normal_map::Shape {
            geometry: config.surface.features,
            appearance: config.appearance.dims,
        };
        Ok(Composite {
            weights: gpu.scratch("weights", n * samples)?,
            image: gpu.scratch("image", 6 * n)?,
            normals: gpu.scratch("normals", 3 * n)?,
            forward: gpu.kernel(composite_forward::Shape::default())?,
            backward: gpu.kernel(composite_backward::Shape::default())?,
            normal_map: gpu.kernel(shading)?,
            sight: match config.surface.gradient {
                GradientKind::Taps => None,
                GradientKind::Analytic => Some(Sight {
                    distance: gpu.scratch("sight distance", n * samples)?,
                    forward: gpu.kernel(sight_distance::Shape::default())?,
                    backward: gpu.kernel(sight_distance_backward::Shape::default())?,
                }),
            },
            scale_range: config.surface.scale_max as f32,
            scale_floor: config.surface.scale_floor as f32,
            outside_empty: u32::from(config.background.kind != BackgroundKind::None),
        })
    }

    /// Weights and pixels.
    pub fn forward(&self, rec: &mut Recorder, look: &Look) {
        let (n, n_samples) = (look.rays.n, look.sampler.n_samples);
        if let Some(sight) = &self.sight {
            let args = sight_distance::Args {
                sdf: look.surface.sdf.ptr(),
                gradient: look.surface.field.slope().gradient.ptr(),
                directions: look.rays.directions.ptr(),
                distance_: sight.distance.ptr_mut(),
                n: n * n_samples,
                n_rays: n,
            };
            rec.run(&sight.forward, per_sample(n, n_samples), args);
        }
        let args = composite_forward::Args {
            sdf: self.distance(look),
            logit: look.surface.shading.ptr(),
            edges: look.sampler.edges.ptr(),
            near_far: look.rays.near_far.ptr(),
            ray_outside: look.rays.outside.ptr(),
            rgb: look.surface.rgb.ptr(),
            background: look.background.color.ptr(),
            weights: self.weights.ptr_mut(),
            image: self.image.ptr_mut(),
            n,
            n_samples,
            scale_range: self.scale_range,
            scale_floor: self.scale_floor,
            inv_s_lower: look.inv_s_lower,
            outside_empty: self.outside_empty,
        };
        rec.run(&self.forward, per_ray(n, n_samples), args);
    }

    /// Gradients of SDF (block 0), scale logit, colour and background, and where the density knows the viewing angle of the surface's
    /// gradient, from `d_color [3, n_rays]`.
    pub fn backward(
        &self,
        rec: &mut Recorder,
        look: &Look,
        model: &Surface,
        d_color: &Buffer<f32>,
    ) {
        let (n, n_samples) = (look.rays.n, look.sampler.n_samples);
        let args = composite_backward::Args {
            sdf: self.distance(look),
            logit: look.surface.shading.ptr(),
            edges: look.sampler.edges.ptr(),
            near_far: look.rays.near_far.ptr(),
            ray_outside: look.rays.outside.ptr(),
            rgb: look.surface.rgb.ptr(),
            background: look.background.color.ptr(),
            d_color: d_color.ptr(),
            d_sdf: look.surface.d_sdf.ptr_mut(),
            d_logit: model.d_logit(look.surface),
            d_rgb: look.surface.d_rgb.ptr_mut(),
            d_background: look.background.d_color.ptr_mut(),
            n,
            n_samples,
            scale_range: self.scale_range,
            scale_floor: self.scale_floor,
            inv_s_lower: look.inv_s_lower,
            outside_empty: self.outside_empty,
        };
        rec.run(&self.backward, per_ray(n, 2 * n_samples), args);
        if let Some(sight) = &self.sight {
            let slope = look.surface.field.slope();
            let args = sight_distance_backward::Args {
                sdf: look.surface.sdf.ptr(),
                gradient: slope.gradient.ptr(),
                directions: look.rays.directions.ptr(),
                d_distance: look.surface.d_sdf.ptr_mut(),
                d_gradient: slope.d_gradient.ptr_mut(),
                n: n * n_samples,
                n_rays: n,
            };
            rec.run(&sight.backward, per_sample(n, n_samples), args);
        }
    }

    /// What the density is a function of: `[n]` signed distances, or those along the line of sight.
    fn distance(&self, look: &Look) -> Ptr<f32> {
        let along_sight = self.sight.as_ref().map(|sight| sight.distance.ptr());
        along_sight.unwrap_or(look.surface.sdf.ptr())
    }

    /// Rendered normals, into `self.normals`.
    pub fn normal_map(&self, rec: &mut Recorder, look: &Look) {
        let args = normal_map::Args {
            weights: self.weights.ptr(),
            shading: look.surface.shading.ptr(),
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
