//! Tangent-normal consistency: the surface's normal just beside a sample should be that at the sample (Rosu and Behnke 2023, PermutoSDF,
//! as in NeuRodin's released code).

use super::composite::Look;
use super::rays::RayDraws;
use crate::Result;
use crate::config::Config;
use crate::gpu::{Buffer, Gpu, Kernel, Recorder, Work};
use crate::kernels::{tangent_loss, tangent_points, tangent_points_backward};
use crate::model::{FieldBuffers, Model, Scratch, Surface};

/// Buffers and kernels of the tangent-normal loss of a batch of samples.
pub struct Tangent {
    pub loss: Buffer<f32>,   // [n]
    pub points: Buffer<f32>, // [3, n] beside the samples
    d_points: Buffer<f32>,   // [3, n]
    d_sdf: Buffer<f32>,      // [n] zero: nobody asks for the signed distance there
    field: FieldBuffers,
    place: Kernel<tangent_points::Args>,
    compare: Kernel<tangent_loss::Args>,
    place_backward: Kernel<tangent_points_backward::Args>,
    /// What the gradient of a sample's loss is to be multiplied by, as their sum is.
    pub scale: f32,
}

impl Tangent {
    /// Buffers and kernels for `n` samples, or `None` where the configuration has no such loss.
    pub fn new(gpu: &Gpu, config: &Config, n: u32) -> Result<Option<Tangent>> {
        if config.loss.tangent == 0.0 {
            return Ok(None);
        }
        let n64 = u64::from(n);
        Ok(Some(Tangent {
            loss: gpu.scratch("tangent loss", n64)?,
            points: gpu.scratch("tangent points", 3 * n64)?,
            d_points: gpu.scratch("tangent d_points", 3 * n64)?,
            d_sdf: gpu.buffer("tangent d_sdf", n64)?,
            field: FieldBuffers::new(gpu, "tangent", &Surface::beside_shape(config), n, 0)?,
            place: gpu.kernel(tangent_points::Shape::default())?,
            compare: gpu.kernel(tangent_loss::Shape::default())?,
            place_backward: gpu.kernel(tangent_points_backward::Shape::default())?,
            scale: config.loss.tangent as f32 / n as f32,
        }))
    }

    /// The loss of every sample, and its gradients: added to the parameters', and to the samples' own `d_gradient`.
    pub fn run(
        &self,
        rec: &mut Recorder,
        model: &Model,
        look: &Look,
        draws: &RayDraws,
        scratch: &Scratch,
    ) {
        let at_samples = look.surface.field.slope();
        let beside = self.field.slope();
        let (n, n_rays) = (self.field.n, look.rays.n);
        let per_sample = Work::items(u64::from(n)).flops(60.0).bytes(60.0);
        let args = tangent_points::Args {
            origins: look.rays.origins.ptr(),
            directions: look.rays.directions.ptr(),
            near_far: look.rays.near_far.ptr(),
            edges: look.sampler.edges.ptr(),
            gradient: at_samples.gradient.ptr(),
            draws: draws.per_sample(),
            points: self.points.ptr_mut(),
            n,
            n_rays,
        };
        rec.run(&self.place, per_sample, args);
        let (params, field, points) = (&model.params, model.surface.beside(), self.points.ptr());
        model.touch(rec, points, n);
        field.encode(rec, params, points, &self.field);
        field.gradient(rec, params, points, &self.field);
        let args = tangent_loss::Args {
            gradient: at_samples.gradient.ptr(),
            gradient_beside: beside.gradient.ptr(),
            loss: self.loss.ptr_mut(),
            d_gradient: at_samples.d_gradient.ptr_mut(),
            d_gradient_beside: beside.d_gradient.ptr_mut(),
            n,
            scale: self.scale,
        };
        rec.run(&self.compare, per_sample, args);
        let (d_sdf, d_points) = (self.d_sdf.ptr(), Some(self.d_points.ptr_mut()));
        field.backward(rec, params, points, d_sdf, &self.field, scratch, d_points);
        let args = tangent_points_backward::Args {
            gradient: at_samples.gradient.ptr(),
            draws: draws.per_sample(),
            d_points: self.d_points.ptr(),
            d_gradient: at_samples.d_gradient.ptr_mut(),
            n,
        };
        rec.run(&self.place_backward, per_sample, args);
    }
}
