//! The way from rays to pixels for one batch, with every buffer that it needs; training and evaluation go the same way.

use super::composite::{Composite, Look};
use super::rays::{RayDraws, Rays, ViewTable};
use super::sampler::Sampler;
use crate::config::Config;
use crate::gpu::{Gpu, Recorder};
use crate::model::{BackgroundBuffers, BackgroundRays, Model, ShadeInputs, SurfaceBuffers};
use crate::scene::Region;
use crate::{Error, Result};

/// The buffers and kernels of a batch of rays.
pub struct Renderer {
    pub rays: Rays,
    pub draws: RayDraws,
    pub sampler: Sampler,
    pub surface: SurfaceBuffers,
    pub background: BackgroundBuffers,
    pub composite: Composite,
}

/// What a view looks like, row by row from the top left.
pub struct Rendered {
    pub width: u32,
    pub height: u32,
    /// Red, green, blue in [0, 1].
    pub rgb: Vec<[f32; 3]>,
    /// Distance along the ray, region units.
    pub depth: Vec<f32>,
    /// Σ w n in the region frame, whose axes are the world's.
    pub normal: Vec<[f32; 3]>,
    /// Accumulated weight.
    pub accumulation: Vec<f32>,
}

/// The annealed numbers that a forward pass depends on.
#[derive(Clone, Copy, Debug)]
pub struct Annealed {
    /// Exponent of the proposal weights.
    pub anneal: f32,
    /// Lower bound of 1/β.
    pub inv_s_lower: f32,
}

/// Purposes of random numbers.
pub const TRAINING: u32 = 0;
const EVALUATION: u32 = 1;

impl Renderer {
    /// Buffers for batches of `n_rays`.
    pub fn new(
        gpu: &Gpu,
        config: &Config,
        model: &Model,
        region: &Region,
        n_rays: u32,
    ) -> Result<Renderer> {
        Ok(Renderer {
            rays: Rays::new(gpu, config, region, n_rays)?,
            draws: RayDraws::new(gpu, config, n_rays)?,
            sampler: Sampler::new(gpu, config, model, n_rays)?,
            surface: model
                .surface
                .buffers(gpu, n_rays * config.sampling.samples)?,
            background: model.background.buffers(gpu, n_rays)?,
            composite: Composite::new(gpu, config, n_rays)?,
        })
    }

    /// What compositing reads.
    pub fn look(&self, inv_s_lower: f32) -> Look<'_> {
        Look {
            rays: &self.rays,
            sampler: &self.sampler,
            surface: &self.surface,
            background: &self.background,
            inv_s_lower,
        }
    }

    /// What shading reads beside the points.
    pub fn shade_inputs(&self) -> ShadeInputs {
        ShadeInputs {
            tap_draws: self.draws.per_sample(),
            directions: self.rays.directions.ptr(),
            ray_view: self.rays.view.ptr(),
            n_rays: self.rays.n,
        }
    }

    /// What the background reads.
    pub fn background_rays(&self, train: bool) -> BackgroundRays {
        BackgroundRays {
            origins: self.rays.origins.ptr(),
            directions: self.rays.directions.ptr(),
            near_far: self.rays.near_far.ptr(),
            ray_view: self.rays.view.ptr(),
            draws: self.draws.background(),
            jittered: train,
            n_rays: self.rays.n,
        }
    }

    /// From rays and draws to pixels: samples where the surface is likely, the fields there, the background, compositing.
    pub fn forward(&self, rec: &mut Recorder, model: &Model, now: Annealed, train: bool) {
        self.sampler.place(
            rec,
            model,
            &self.rays,
            &self.draws,
            now.anneal,
            train,
            &self.surface.points,
        );
        if train {
            model.touch(rec, self.surface.points.ptr(), self.surface.field.n);
        }
        model
            .surface
            .forward(rec, &model.params, &self.surface, &self.shade_inputs());
        model.background.forward(
            rec,
            &model.params,
            &self.background,
            &self.background_rays(train),
        );
        self.composite.forward(rec, &self.look(now.inv_s_lower));
    }

    /// Renders a whole view of `width`×`height` pixels. Depth is the distance along the ray in region units. `keep_going` is asked
    /// between batches and told the share that is done.
    #[allow(clippy::too_many_arguments)] // one view: which, how large, with which code, at which time
    pub fn view(
        &self,
        gpu: &Gpu,
        model: &Model,
        views: &ViewTable,
        view: u32,
        size: (u32, u32),
        appearance_row: u32,
        now: Annealed,
        keep_going: &mut dyn FnMut(f64) -> bool,
    ) -> Result<Rendered> {
        let (width, height) = size;
        let (n, total) = (self.rays.n as usize, width as usize * height as usize);
        let mut out = Rendered {
            width,
            height,
            rgb: Vec::with_capacity(total),
            depth: Vec::with_capacity(total),
            normal: Vec::with_capacity(total),
            accumulation: Vec::with_capacity(total),
        };
        for first in (0..total).step_by(n) {
            if !keep_going(first as f64 / total as f64) {
                return Err(Error::Interrupted {
                    what: format!("rendering stopped after {first} of {total} pixels"),
                });
            }
            gpu.submit("view", |rec| {
                model.params.normalise_weights(rec);
                self.draws.fill(rec, first as u64, EVALUATION);
                self.rays
                    .through(rec, views, view, first as u32, appearance_row);
                self.forward(rec, model, now, false);
                self.composite.normal_map(rec, &self.look(now.inv_s_lower));
                Ok(())
            })?;
            let image = gpu.download(&self.composite.image, 0, self.composite.image.len())?;
            let normals = gpu.download(&self.composite.normals, 0, self.composite.normals.len())?;
            for i in 0..n.min(total - first) {
                out.rgb.push([image[i], image[n + i], image[2 * n + i]]);
                out.accumulation.push(image[3 * n + i]);
                out.depth.push(image[5 * n + i]);
                out.normal
                    .push([normals[i], normals[n + i], normals[2 * n + i]]);
            }
        }
        Ok(out)
    }
}
