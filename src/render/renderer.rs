//! The way from rays to pixels for one batch, with every buffer that it needs; training and evaluation go the same way.

use super::bias;
use super::composite::{Composite, Look};
use super::rays::{RayDraws, Rays, ViewTable};
use super::sampler::Sampler;
use crate::config::{Config, DensityKind};
use crate::gpu::{Gpu, Recorder};
use crate::model::{
    BackgroundBuffers, BackgroundRays, Model, ShadeInputs, SurfaceBuffers, TapStep,
};
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
    /// Whether the surface is asked in the bins' middles, not at their starts.
    midpoints: bool,
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
    /// Lower bound of the local 1/β.
    pub inv_s_lower: f32,
    /// How hard NeuS's cosine is, 0 to 1.
    pub cosine_anneal: f32,
    pub tap_step: TapStep,
    /// Levels of the surface's grid that its network sees.
    pub released_levels: u32,
    /// Weight of the curvature loss, which is computed on the way.
    pub curvature_weight: f32,
}

/// One view: which, how large in pixels, with which appearance code, at which time.
pub struct Shot<'v> {
    pub views: &'v ViewTable,
    /// Row of the table.
    pub view: u32,
    pub size: (u32, u32),
    pub appearance_row: u32,
    pub now: Annealed,
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
            midpoints: config.surface.density == DensityKind::Neus,
        })
    }

    /// What compositing reads.
    pub fn look(&self, now: Annealed) -> Look<'_> {
        Look {
            rays: &self.rays,
            sampler: &self.sampler,
            surface: &self.surface,
            background: &self.background,
            now,
        }
    }

    /// What shading reads beside the points.
    pub fn shade_inputs(&self, now: Annealed) -> ShadeInputs {
        ShadeInputs {
            tap_draws: self.draws.per_sample(),
            tap_step: now.tap_step,
            curvature_scale: now.curvature_weight / self.surface.n as f32,
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
            now,
            train,
            &self.surface.points,
        );
        if train {
            model.touch(rec, self.surface.points.ptr(), self.surface.field.n);
        }
        model
            .surface
            .forward(rec, &model.params, &self.surface, &self.shade_inputs(now));
        model.background.forward(
            rec,
            &model.params,
            &self.background,
            &self.background_rays(train),
        );
        self.composite.forward(rec, &self.look(now), model);
    }

    /// Renders a whole view. `keep_going` is asked between batches and told the share that is done.
    pub fn view(
        &self,
        gpu: &Gpu,
        model: &Model,
        shot: &Shot,
        keep_going: &mut dyn FnMut(f64) -> bool,
    ) -> Result<Rendered> {
        let (width, height) = shot.size;
        let (n, total) = (self.rays.n as usize, width as usize * height as usize);
        let mut out = Rendered {
            width,
            height,
            rgb: Vec::with_capacity(total),
            depth: Vec::with_capacity(total),
            normal: Vec::with_capacity(total),
            accumulation: Vec::with_capacity(total),
        };
        self.batches(gpu, model, shot, keep_going, &mut |count| {
            let image = gpu.download(&self.composite.image, 0, self.composite.image.len())?;
            let normals = gpu.download(&self.composite.normals, 0, self.composite.normals.len())?;
            for i in 0..count {
                out.rgb.push([image[i], image[n + i], image[2 * n + i]]);
                out.accumulation.push(image[3 * n + i]);
                out.depth.push(image[5 * n + i]);
                out.normal
                    .push([normals[i], normals[n + i], normals[2 * n + i]]);
            }
            Ok(())
        })?;
        Ok(out)
    }

    /// How far behind the surface each pixel's ray is heaviest, row by row from the top left, in region units ([`super::bias`]); `None`
    /// where it meets no surface.
    pub fn bias(
        &self,
        gpu: &Gpu,
        model: &Model,
        shot: &Shot,
        keep_going: &mut dyn FnMut(f64) -> bool,
    ) -> Result<Vec<Option<f32>>> {
        let (n, samples) = (self.rays.n as usize, self.sampler.n_samples as usize);
        let mut out = Vec::new();
        self.batches(gpu, model, shot, keep_going, &mut |count| {
            let block = self.surface.points.len() / 3;
            let planes = [0, 1, 2]
                .map(|axis| gpu.download(&self.surface.points, axis * block, (n * samples) as u64));
            let [x, y, z] = planes;
            let points = [x?, y?, z?];
            let origins = gpu.download(&self.rays.origins, 0, self.rays.origins.len())?;
            let sdf = gpu.download(&self.surface.sdf, 0, (n * samples) as u64)?;
            let weights = gpu.download(&self.composite.weights, 0, self.composite.weights.len())?;
            for ray in 0..count {
                let row = ray * samples..(ray + 1) * samples;
                let distance = |p: usize| {
                    let along = [0, 1, 2].map(|axis| points[axis][p] - origins[axis * n + ray]);
                    along.iter().map(|x| x * x).sum::<f32>().sqrt()
                };
                let distances: Vec<f32> = row.clone().map(distance).collect();
                out.push(bias::behind_surface(
                    &distances,
                    &sdf[row.clone()],
                    &weights[row],
                    self.midpoints,
                ));
            }
            Ok(())
        })?;
        Ok(out)
    }

    /// Renders a view batch by batch; `each` is told how many of the batch's rays are pixels.
    fn batches(
        &self,
        gpu: &Gpu,
        model: &Model,
        shot: &Shot,
        keep_going: &mut dyn FnMut(f64) -> bool,
        each: &mut dyn FnMut(usize) -> Result<()>,
    ) -> Result<()> {
        let (n, total) = (
            self.rays.n as usize,
            shot.size.0 as usize * shot.size.1 as usize,
        );
        for first in (0..total).step_by(n) {
            if !keep_going(first as f64 / total as f64) {
                return Err(Error::Interrupted {
                    what: format!("rendering stopped after {first} of {total} pixels"),
                });
            }
            gpu.submit("view", |rec| {
                model.refresh_weights(rec, shot.now.released_levels);
                self.draws.fill(rec, first as u64, EVALUATION);
                self.rays.through(
                    rec,
                    shot.views,
                    shot.view,
                    first as u32,
                    shot.appearance_row,
                );
                self.forward(rec, model, shot.now, false);
                self.composite.normal_map(rec, &self.look(shot.now), model);
                Ok(())
            })?;
            each(n.min(total - first))?;
        }
        Ok(())
    }
}
