//! Where samples lie along a ray: two rounds of proposals, then the shading samples (Barron et al. 2022, Mip-NeRF 360).

use super::rays::{RayDraws, Rays};
use super::renderer::Annealed;
use crate::Result;
use crate::config::{Config, DensityKind};
use crate::gpu::{Buffer, Gpu, Kernel, Recorder, Work};
use crate::kernels::{interlevel, midpoint_positions, place_samples, resample, surface_points};
use crate::model::{Model, ProposalBuffers, Scratch};

/// The samples of a batch.
pub struct Sampler {
    levels: Vec<ProposalBuffers>,
    pub edges: Buffer<f32>, // [n_rays, n_samples + 1] of the shading samples
    pub n_samples: u32,
    place: Kernel<place_samples::Args>,
    resample: Kernel<resample::Args>,
    midpoints: Kernel<midpoint_positions::Args>,
    surface_points: Kernel<surface_points::Args>,
    interlevel: Kernel<interlevel::Args>,
    pub interlevel_loss: Vec<Buffer<f32>>, // per level [n_rays]
}

impl Sampler {
    /// Buffers and kernels for a batch of rays.
    pub fn new(gpu: &Gpu, config: &Config, model: &Model, n_rays: u32) -> Result<Sampler> {
        let n_samples = config.sampling.samples;
        let mut levels = Vec::new();
        let mut interlevel_loss = Vec::new();
        for (level, proposal) in model.proposals.iter().enumerate() {
            interlevel_loss
                .push(gpu.scratch(&format!("interlevel loss {level}"), u64::from(n_rays))?);
            levels.push(proposal.buffers(gpu, level, n_rays)?);
        }
        Ok(Sampler {
            levels,
            edges: gpu.scratch("edges", u64::from(n_rays) * u64::from(n_samples + 1))?,
            n_samples,
            place: gpu.kernel(place_samples::Shape::default())?,
            resample: gpu.kernel(resample::Shape::default())?,
            midpoints: gpu.kernel(midpoint_positions::Shape::default())?,
            surface_points: gpu.kernel(surface_points::Shape {
                taps: model.surface.blocks() - 1,
                midpoint: u32::from(config.surface.density == DensityKind::Neus),
            })?,
            interlevel: gpu.kernel(interlevel::Shape::default())?,
            interlevel_loss,
        })
    }

    /// Edges of level 0, 1 (proposals) and 2 (shading samples), each `[n_rays, samples + 1]`.
    pub fn edges_of(&self, level: usize) -> &Buffer<f32> {
        self.levels.get(level).map_or(&self.edges, |b| &b.edges)
    }

    /// Places the shading samples: `self.edges`, and into `points` their points with the taps, if any. Without `train`, no jitter.
    #[allow(clippy::too_many_arguments)] // what a pass over the rays needs; a struct would only rename them
    pub fn place(
        &self,
        rec: &mut Recorder,
        model: &Model,
        rays: &Rays,
        draws: &RayDraws,
        now: Annealed,
        train: bool,
        points: &Buffer<f32>,
    ) {
        let n = rays.n;
        let per_ray = |samples: u32| {
            Work::items(u64::from(n))
                .flops(50.0 * f64::from(samples))
                .bytes(16.0 * f64::from(samples))
        };
        let train = u32::from(train);
        let args = place_samples::Args {
            jitter: draws.jitter(0),
            edges: self.levels[0].edges.ptr_mut(),
            n_rays: n,
            n_samples: model.proposals[0].n_samples,
            train,
        };
        let n_edges = u64::from(n) * u64::from(args.n_samples + 1);
        rec.run(
            &self.place,
            Work::items(n_edges).flops(10.0).bytes(8.0),
            args,
        );
        for (level, (proposal, b)) in model.proposals.iter().zip(&self.levels).enumerate() {
            let n_samples = proposal.n_samples;
            let args = midpoint_positions::Args {
                origins: rays.origins.ptr(),
                directions: rays.directions.ptr(),
                near_far: rays.near_far.ptr(),
                edges: b.edges.ptr(),
                points: b.points.ptr_mut(),
                n_rays: n,
                n_samples,
            };
            rec.run(
                &self.midpoints,
                Work::items(u64::from(n * n_samples))
                    .flops(30.0)
                    .bytes(40.0),
                args,
            );
            proposal.forward(rec, &model.params, b);
            let (next, n_new) = match self.levels.get(level + 1) {
                Some(next) => (&next.edges, model.proposals[level + 1].n_samples),
                None => (&self.edges, self.n_samples),
            };
            let args = resample::Args {
                raw: b.raw.ptr(),
                edges: b.edges.ptr(),
                near_far: rays.near_far.ptr(),
                jitter: draws.jitter(level as u64 + 1),
                weights: b.weights.ptr_mut(),
                new_edges: next.ptr_mut(),
                n_rays: n,
                n_samples,
                n_new,
                train,
                anneal: now.anneal,
            };
            rec.run(&self.resample, per_ray(2 * n_samples + n_new), args);
        }
        let args = surface_points::Args {
            origins: rays.origins.ptr(),
            directions: rays.directions.ptr(),
            near_far: rays.near_far.ptr(),
            edges: self.edges.ptr(),
            tap_draws: draws.per_sample(),
            points: points.ptr_mut(),
            n_rays: n,
            n_samples: self.n_samples,
            tap_range: now.tap_step.range,
            tap_floor: now.tap_step.floor,
        };
        rec.run(
            &self.surface_points,
            Work::items(u64::from(n * self.n_samples))
                .flops(50.0)
                .bytes(100.0),
            args,
        );
    }

    /// Pulls both proposals' weights over those of the shading samples: interlevel loss (scaled by weight/n_rays) and its gradients.
    pub fn backward(
        &self,
        rec: &mut Recorder,
        model: &Model,
        rays: &Rays,
        weights: &Buffer<f32>,
        scratch: &Scratch,
        scale: f32,
    ) {
        for ((proposal, b), loss) in model
            .proposals
            .iter()
            .zip(&self.levels)
            .zip(&self.interlevel_loss)
        {
            let args = interlevel::Args {
                final_edges: self.edges.ptr(),
                final_weights: weights.ptr(),
                edges: b.edges.ptr(),
                weights: b.weights.ptr(),
                raw: b.raw.ptr(),
                near_far: rays.near_far.ptr(),
                loss: loss.ptr_mut(),
                d_raw: b.d_raw.ptr_mut(),
                transmittance: b.transmittance.ptr_mut(),
                n_rays: rays.n,
                n_final: self.n_samples,
                n_samples: proposal.n_samples,
                scale,
            };
            let samples = f64::from(self.n_samples + proposal.n_samples);
            rec.run(
                &self.interlevel,
                Work::items(u64::from(rays.n))
                    .flops(40.0 * samples)
                    .bytes(16.0 * samples),
                args,
            );
            proposal.backward(rec, &model.params, b, scratch);
        }
    }
}
