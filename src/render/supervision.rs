//! What is wanted of a ray besides its colour: masks, a sensor's depth, monocular depth and normals (the last two as in MonoSDF, Yu et al.
//! 2022). All are off by default; of those that are, there are neither buffers nor kernels.
//!
//! Each is a mean over the batch's rays, in which those that know nothing count as zero; so is colour. A ray that misses the region or is
//! masked out knows nothing.

use super::composite::{Composite, Look};
use super::priors::Priors;
use super::rays::ViewTable;
use crate::Result;
use crate::config::Config;
use crate::gpu::{Buffer, Gpu, Kernel, KernelShape, Recorder, Work};
use crate::kernels::{mask_loss, mono_depth_loss, mono_normal_loss, sensor_depth_loss};
use crate::model::Model;

/// Kernels and results of these losses.
pub struct Supervision {
    /// Their gradients by what is rendered.
    pub d_image: Buffer<f32>, // [5, n_rays] glsl/lib/supervision.glsl
    pub priors: Option<Priors>,
    mask: Option<RayLoss<mask_loss::Args>>,
    sensor_depth: Option<RayLoss<sensor_depth_loss::Args>>,
    mono_depth: Option<RayLoss<mono_depth_loss::Args>>,
    mono_normal: Option<RayLoss<mono_normal_loss::Args>>,
    n_rays: u32,
}

/// One of them.
struct RayLoss<A> {
    values: Buffer<f32>, // [n_rays]
    kernel: Kernel<A>,
    /// λ/N
    scale: f32,
}

impl<A> RayLoss<A> {
    /// `None` where the weight is zero.
    fn new<S: KernelShape<Args = A>>(
        gpu: &Gpu,
        name: &str,
        shape: S,
        weight: f64,
        n_rays: u32,
    ) -> Result<Option<RayLoss<A>>> {
        if weight == 0.0 {
            return Ok(None);
        }
        Ok(Some(RayLoss {
            values: gpu.scratch(name, u64::from(n_rays))?,
            kernel: gpu.kernel(shape)?,
            scale: weight as f32 / n_rays as f32,
        }))
    }
}

impl Supervision {
    /// Buffers and kernels for a batch of rays, or `None` where the configuration has no such loss.
    ///
    /// # Panics
    /// If there are losses on priors, but no priors.
    pub fn new(
        gpu: &Gpu,
        config: &Config,
        n_rays: u32,
        priors: Option<Priors>,
    ) -> Result<Option<Supervision>> {
        let weights = &config.loss;
        if !weights.is_supervised() {
            return Ok(None);
        }
        let n = n_rays;
        let supervision = Supervision {
            d_image: gpu.scratch("d_image", 5 * u64::from(n))?,
            mask: RayLoss::new(
                gpu,
                "mask loss",
                mask_loss::Shape::default(),
                weights.mask,
                n,
            )?,
            sensor_depth: RayLoss::new(
                gpu,
                "sensor depth loss",
                sensor_depth_loss::Shape::default(),
                weights.sensor_depth,
                n,
            )?,
            mono_depth: RayLoss::new(
                gpu,
                "mono depth loss",
                mono_depth_loss::Shape::default(),
                weights.mono_depth,
                n,
            )?,
            mono_normal: RayLoss::new(
                gpu,
                "mono normal loss",
                mono_normal_loss::Shape::default(),
                weights.mono_normal,
                n,
            )?,
            priors,
            n_rays,
        };
        let without = supervision.sensor_depth.is_none()
            && supervision.mono_depth.is_none()
            && supervision.mono_normal.is_none();
        assert!(
            without || supervision.priors.is_some(),
            "losses on priors need priors"
        );
        Ok(Some(supervision))
    }

    /// Every loss of the batch, and in `d_image` the gradients of all of them together.
    pub fn run(
        &self,
        rec: &mut Recorder,
        model: &Model,
        views: &ViewTable,
        composite: &Composite,
        look: &Look,
    ) {
        let n = self.n_rays;
        let per_ray = Work::items(u64::from(n)).flops(40.0).bytes(40.0);
        rec.fill(&self.d_image, 0..self.d_image.len(), 0);
        if let Some(loss) = &self.mask {
            let args = mask_loss::Args {
                image: composite.image.ptr(),
                target: look.rays.target.ptr(),
                ray_outside: look.rays.outside.ptr(),
                loss: loss.values.ptr_mut(),
                d_image: self.d_image.ptr_mut(),
                n_rays: n,
                scale: loss.scale,
            };
            rec.run(&loss.kernel, per_ray, args);
        }
        let Some(priors) = &self.priors else {
            return;
        };
        if let Some(loss) = &self.sensor_depth {
            let args = sensor_depth_loss::Args {
                image: composite.image.ptr(),
                priors: priors.drawn.ptr(),
                target: look.rays.target.ptr(),
                ray_outside: look.rays.outside.ptr(),
                loss: loss.values.ptr_mut(),
                d_image: self.d_image.ptr_mut(),
                n_rays: n,
                scale: loss.scale,
            };
            rec.run(&loss.kernel, per_ray, args);
        }
        if let Some(loss) = &self.mono_depth {
            let args = mono_depth_loss::Args {
                image: composite.image.ptr(),
                priors: priors.drawn.ptr(),
                target: look.rays.target.ptr(),
                ray_outside: look.rays.outside.ptr(),
                loss: loss.values.ptr_mut(),
                d_image: self.d_image.ptr_mut(),
                n_rays: n,
                scale: loss.scale,
            };
            let work = Work::items(1).bytes(100.0 * f64::from(n));
            rec.run(&loss.kernel, work, args);
        }
        if let Some(loss) = &self.mono_normal {
            composite.normal_map(rec, look, model);
            let args = mono_normal_loss::Args {
                views: views.table(),
                ray_view: look.rays.view.ptr(),
                normals: composite.normals.ptr(),
                priors: priors.drawn.ptr(),
                target: look.rays.target.ptr(),
                ray_outside: look.rays.outside.ptr(),
                loss: loss.values.ptr_mut(),
                d_image: self.d_image.ptr_mut(),
                n_rays: n,
                scale: loss.scale,
            };
            rec.run(&loss.kernel, per_ray, args);
        }
    }

    /// The losses of the batch's rays, and what their sum is to be multiplied by, in the order of [`super::TERMS`]: mask, sensor's depth,
    /// monocular depth, monocular normals.
    pub fn terms(&self) -> [Option<(&Buffer<f32>, f32)>; 4] {
        [
            self.mask.as_ref().map(|loss| (&loss.values, loss.scale)),
            (self.sensor_depth.as_ref()).map(|loss| (&loss.values, loss.scale)),
            (self.mono_depth.as_ref()).map(|loss| (&loss.values, loss.scale)),
            (self.mono_normal.as_ref()).map(|loss| (&loss.values, loss.scale)),
        ]
    }
}
