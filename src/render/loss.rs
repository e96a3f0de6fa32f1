//! What is wrong with a batch: colour, eikonal, interlevel, bias and optional losses, their sums for the log.

use super::composite::{Composite, Look};
use super::priors::Priors;
use super::renderer::Renderer;
use super::supervision::Supervision;
use super::tangent::Tangent;
use crate::Result;
use crate::config::{BiasReduction, Config};
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, Recorder, Work};
use crate::kernels::{
    LossTerm, bias_correction, color_loss, heaviest_sample, loss_shares, sum_losses,
};
use crate::model::{FieldBuffers, Model, Scratch, Surface};

/// Names of the summed terms, in order; the total of all but the last three, which are figures for the log, follows as the last number.
pub const TERMS: [&str; 14] = [
    "color",
    "eikonal",
    "interlevel_0",
    "interlevel_1",
    "bias",
    "tangent",
    "curvature",
    "mask",
    "sensor_depth",
    "mono_depth",
    "mono_normal",
    "square_error",
    "pixel_weight",
    "crossing",
];

/// Kernels and results of the losses of a batch.
pub struct Loss {
    pub d_color: Buffer<f32>, // [3, n_rays]
    pub sums: Buffer<f32>,    // [TERMS + 1] of the last step
    /// 1 where the last step's loss was not finite.
    pub bad_step: Buffer<u32>, // [1]
    color: Buffer<f32>,       // [n_rays]
    square: Buffer<f32>,      // [n_rays]
    bias: Buffer<f32>,        // [n_rays]
    gate: Buffer<f32>,        // [n_rays]
    heaviest: Buffer<u32>,    // [n_rays]
    queries: Buffer<f32>,     // [3, 2 n_rays] behind the heaviest sample, by ε and by c
    query_field: FieldBuffers,
    query_sdf: Buffer<f32>,   // [2, n_rays]
    d_query_sdf: Buffer<f32>, // [n_rays] of the first; the second is only compared
    pub tangent: Option<Tangent>,
    pub supervision: Option<Supervision>,
    /// Weight of the squared colour error.
    squared: f32,
    /// What the gradients of a sample's eikonal and of a ray's interlevel losses are to be multiplied by, as their sums are.
    pub eikonal_scale: f32,
    pub interlevel_scale: f32,
    terms: Buffer<LossTerm>,
    shares: Buffer<f32>, // [TERMS, n_shares] of their sums
    n_shares: u32,
    color_loss: Kernel<color_loss::Args>,
    heaviest_sample: Kernel<heaviest_sample::Args>,
    bias_correction: Kernel<bias_correction::Args>,
    loss_shares: Kernel<loss_shares::Args>,
    sum_losses: Kernel<sum_losses::Args>,
    epsilon: f32,
    offset: f32,
    published: u32,
    need_opaque: u32,
    n_rays: u32,
    n_samples: u32,
    subgroup_size: u64,
}

impl Loss {
    /// Buffers and kernels for the renderer's batches of rays, with the priors that its losses ask for.
    pub fn new(
        gpu: &Gpu,
        config: &Config,
        renderer: &Renderer,
        priors: Option<Priors>,
    ) -> Result<Loss> {
        let (n_rays, n_samples) = (config.rays, config.sampling.samples);
        let n = u64::from(n_rays);
        let bias = &config.loss.bias;
        let published = u32::from(bias.reduction == BiasReduction::Published);
        let of_share = loss_shares::Shape::default();
        let n_shares = (n_rays * n_samples).div_ceil(of_share.values);
        let sum_losses = gpu.kernel(sum_losses::Shape::default())?;
        assert!(
            TERMS.len() <= sum_losses.local_size() as usize,
            "an invocation for each term"
        );
        let loss = Loss {
            d_color: gpu.scratch("d_color", 3 * n)?,
            sums: gpu.buffer("losses", TERMS.len() as u64 + 1)?,
            bad_step: gpu.buffer("bad step", 1)?,
            color: gpu.scratch("color loss", n)?,
            square: gpu.scratch("square error", n)?,
            // Zero-filled: stays so where bias correction is off.
            bias: gpu.buffer("bias loss", n)?,
            gate: gpu.scratch("bias gate", n)?,
            heaviest: gpu.scratch("heaviest sample", n)?,
            queries: gpu.scratch("bias queries", 6 * n)?,
            query_field: FieldBuffers::new(
                gpu,
                "bias",
                &Surface::field_shape(config).without_gradient(),
                2 * n_rays,
                0,
            )?
            .going_back(n_rays),
            query_sdf: gpu.scratch("bias sdf", 2 * n)?,
            d_query_sdf: gpu.scratch("bias d_sdf", n)?,
            tangent: Tangent::new(gpu, config, n_rays * n_samples)?,
            supervision: Supervision::new(gpu, config, n_rays, priors)?,
            squared: config.loss.color_squared as f32,
            eikonal_scale: config.loss.eikonal as f32 / (n_rays * n_samples) as f32,
            interlevel_scale: config.loss.interlevel as f32 / n_rays as f32,
            terms: gpu.buffer("loss terms", TERMS.len() as u64)?,
            shares: gpu.scratch("loss shares", TERMS.len() as u64 * u64::from(n_shares))?,
            n_shares,
            color_loss: gpu.kernel(color_loss::Shape::default())?,
            heaviest_sample: gpu.kernel(heaviest_sample::Shape::default())?,
            bias_correction: gpu.kernel(bias_correction::Shape { published })?,
            loss_shares: gpu.kernel(of_share)?,
            sum_losses,
            epsilon: bias.epsilon as f32,
            offset: bias.offset as f32,
            published,
            need_opaque: u32::from(!config.surface.inside_out),
            n_rays,
            n_samples,
            subgroup_size: gpu.info().subgroup_size.into(),
        };
        gpu.upload(&loss.terms, 0, &loss.terms_of(config, renderer))?;
        Ok(loss)
    }

    /// Colour loss and its gradient.
    pub fn color(&self, rec: &mut Recorder, composite: &Composite, look: &Look) {
        let args = color_loss::Args {
            image: composite.image.ptr(),
            target: look.rays.target.ptr(),
            loss: self.color.ptr_mut(),
            square: self.square.ptr_mut(),
            d_color: self.d_color.ptr_mut(),
            n_rays: self.n_rays,
            scale: 1.0 / self.n_rays as f32,
            squared: self.squared,
        };
        rec.run(
            &self.color_loss,
            Work::items(u64::from(self.n_rays)).flops(20.0).bytes(50.0),
            args,
        );
    }

    /// Finds each ray's heaviest sample, the points behind it that bias correction asks, and whether the ray meets an opaque surface.
    pub fn heaviest(&self, rec: &mut Recorder, composite: &Composite, look: &Look) {
        let args = heaviest_sample::Args {
            weights: composite.weights.ptr(),
            sdf: look.surface.sdf.ptr(),
            edges: look.sampler.edges.ptr(),
            near_far: look.rays.near_far.ptr(),
            ray_outside: look.rays.outside.ptr(),
            origins: look.rays.origins.ptr(),
            directions: look.rays.directions.ptr(),
            queries: self.queries.ptr_mut(),
            gate: self.gate.ptr_mut(),
            heaviest: self.heaviest.ptr_mut(),
            n_rays: self.n_rays,
            n_samples: self.n_samples,
            eps: self.epsilon,
            offset: self.offset,
            need_opaque: self.need_opaque,
            ask_all: self.published,
        };
        // Eight bytes and about as many operations a sample, shared by a subgroup's lanes.
        let share = 8.0 * f64::from(self.n_samples) / self.subgroup_size as f64;
        // One subgroup a ray; where its size varies, the kernel strides over the rays.
        rec.run(
            &self.heaviest_sample,
            Work::items(u64::from(self.n_rays) * self.subgroup_size)
                .flops(share)
                .bytes(share),
            args,
        );
    }

    /// Explicit bias correction (Wang et al. 2024, NeuRodin): asks the SDF just behind each ray's [`Loss::heaviest`] sample, and pushes it
    /// below zero where it still is free space. Adds the gradients.
    pub fn bias(&self, rec: &mut Recorder, model: &Model, scratch: &Scratch, weight: f32) {
        model.touch(rec, self.queries.ptr(), self.query_field.n);
        model.surface.probes.forward(
            rec,
            &model.params,
            self.queries.ptr(),
            &self.query_field,
            self.query_sdf.ptr_mut(),
        );
        let args = bias_correction::Args {
            query_sdf: self.query_sdf.ptr(),
            gate: self.gate.ptr(),
            loss: self.bias.ptr_mut(),
            d_query_sdf: self.d_query_sdf.ptr_mut(),
            n_rays: self.n_rays,
            eps: self.epsilon,
            scale: weight / self.n_rays as f32,
        };
        rec.run(
            &self.bias_correction,
            Work::items(self.n_rays.into()).bytes(20.0),
            args,
        );
        model.surface.probes.backward(
            rec,
            &model.params,
            self.queries.ptr(),
            self.d_query_sdf.ptr(),
            &self.query_field,
            scratch,
            None,
        );
    }

    /// The table of what to sum, in the order of [`TERMS`].
    fn terms_of(&self, config: &Config, renderer: &Renderer) -> [LossTerm; TERMS.len()] {
        let (n, n_all) = (self.n_rays, self.n_rays * self.n_samples);
        let term = |values: &Buffer<f32>, count: u32, scale: f32| LossTerm {
            values: values.ptr(),
            count,
            scale,
            counts: 1,
            padding: 0,
        };
        let none = term(&self.bias, 0, 0.0);
        let figure = |values: Ptr<f32>| LossTerm {
            values,
            count: n,
            scale: 1.0 / n as f32,
            counts: 0,
            padding: 0,
        };
        let [mask, sensor_depth, mono_depth, mono_normal] = match &self.supervision {
            Some(supervision) => supervision.terms().map(|of| match of {
                Some((values, scale)) => term(values, n, scale),
                None => none,
            }),
            None => [none; 4],
        };
        let (surface, interlevel) = (&renderer.surface, &renderer.sampler.interlevel_loss);
        [
            term(&self.color, n, 1.0 / n as f32),
            term(&surface.eikonal, n_all, self.eikonal_scale),
            term(&interlevel[0], n, self.interlevel_scale),
            term(&interlevel[1], n, self.interlevel_scale),
            term(&self.bias, n, 1.0), // weighted where it is computed: its weight changes with time
            match &self.tangent {
                Some(tangent) => term(&tangent.loss, n_all, tangent.scale),
                None => none,
            },
            match config.loss.curvature.weight > 0.0 {
                true => term(&surface.curvature, n_all, 1.0), // weighted likewise
                false => none,
            },
            mask,
            sensor_depth,
            mono_depth,
            mono_normal,
            figure(self.square.ptr()),
            figure(renderer.rays.target.ptr().offset(3 * u64::from(n))),
            figure(self.gate.ptr()),
        ]
    }

    /// Sums all terms in a fixed order, into `self.sums`, and flags a sum that is not finite.
    pub fn sum(&self, rec: &mut Recorder) {
        rec.fill(&self.bad_step, 0..1, 0);
        let n_terms = TERMS.len() as u32;
        let args = loss_shares::Args {
            terms: self.terms.ptr(),
            shares: self.shares.ptr_mut(),
            n_shares: self.n_shares,
        };
        // Of all that is read, the samples' arrays are nearly everything; there is always one.
        let read = 4.0 * f64::from(self.n_rays * self.n_samples);
        let work = Work::groups(u64::from(self.n_shares)).slices(n_terms);
        rec.run(
            &self.loss_shares,
            work.bytes(read / f64::from(self.n_shares * n_terms)),
            args,
        );
        let args = sum_losses::Args {
            terms: self.terms.ptr(),
            shares: self.shares.ptr(),
            losses: self.sums.ptr_mut(),
            bad_step: self.bad_step.ptr_mut(),
            n_terms,
            n_shares: self.n_shares,
        };
        rec.run(&self.sum_losses, Work::groups(1), args);
    }
}
