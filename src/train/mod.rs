//! Optimiser steps, their schedules, what is saved of them and what is told about them.

mod adam;
pub mod checkpoint;
mod preview;
pub mod report;
mod run;
pub mod run_directory;
pub mod schedule;
pub mod trained;

use glam::DMat4;

use crate::config::{AppearanceAtEval, Config, MaskUse};
use crate::gpu::{Gpu, Readback, Recorder, Ticket};
use crate::model::{Background, Model, Proposal, Scratch, Surface, TapStep};
use crate::render::{Annealed, Loss, Priors, Rendered, Renderer, Shot, TERMS, TRAINING, ViewTable};
use crate::scene::{Camera, ObjectMasks, Region, Scene, Split};
use crate::{Error, Result};
use adam::Adam;
use preview::PreviewView;
use schedule::{Now, Schedule};

/// Trains a model on a scene: [`Trainer::step`] is one optimiser step.
pub struct Trainer {
    gpu: Gpu,
    config: Config,
    schedule: Schedule,
    region: Region,
    model: Model,
    renderer: Renderer,
    loss: Loss,
    scratch: Scratch,
    optimizer: Adam,
    views: ViewTable,
    /// Indices into the scene's views in the order of the device's table: training views, then held-out ones.
    view_order: Vec<usize>,
    /// What a preview shows; the last row of the device's table.
    preview: Option<PreviewView>,
    step: u64,
    /// On all learning rates: 1, or less once losses were not finite.
    rate_factor: f64,
    /// Losses of the last steps, [LOSS_HISTORY, TERMS + 1], read without waiting.
    history: Readback<f32>,
    tickets: std::collections::VecDeque<(u64, Ticket)>,
}

/// Losses of one step.
#[derive(Clone, Debug)]
pub struct StepLosses {
    pub step: u64,
    /// By the names of [`TERMS`], the total last.
    pub values: [f32; TERMS.len() + 1],
}

impl StepLosses {
    /// What the step made smaller.
    pub fn total(&self) -> f32 {
        self.values[TERMS.len()]
    }

    /// The term of this name in [`TERMS`].
    ///
    /// # Panics
    /// If there is none.
    pub fn of(&self, term: &str) -> f32 {
        let found = TERMS.iter().position(|name| *name == term);
        self.values[found.unwrap_or_else(|| panic!("no term is called '{term}'"))]
    }
}

/// Steps whose losses stay readable.
const LOSS_HISTORY: u64 = 64;

impl Trainer {
    /// Builds the model, uploads the training pictures and allocates everything that a step needs.
    ///
    /// # Errors
    /// What reading a picture, a mask or a prior or allocating device memory fails with; `Config` where the device was not opened as the
    /// configuration wants it.
    pub fn new(gpu: &Gpu, scene: &Scene, region: &Region, config: &Config) -> Result<Trainer> {
        if config.deterministic != gpu.deterministic() {
            return Err(Error::Config {
                what: format!(
                    "deterministic = {}, but the device was opened with GpuOptions::deterministic = {}\n  \
                     next: open it with GpuOptions {{ deterministic: config.deterministic, .. }}",
                    config.deterministic,
                    gpu.deterministic()
                ),
            });
        }
        if config.matrices != gpu.options().matrices {
            return Err(Error::Config {
                what: format!(
                    "matrices = {}, but the device was opened with those of matrices = {}\n  \
                     next: open it with GpuOptions {{ matrices: config.matrices, .. }}",
                    serde_json::json!(config.matrices),
                    serde_json::json!(gpu.options().matrices)
                ),
            });
        }
        let training: Vec<usize> = scene.split(Split::Train).collect();
        let held_out: Vec<usize> = scene.split(Split::Test).collect();
        let preview = PreviewView::choose(scene, config);
        let mut others: Vec<(Camera, DMat4)> = held_out
            .iter()
            .map(|&v| {
                (
                    scene.views[v].camera.clone(),
                    scene.views[v].world_from_camera,
                )
            })
            .collect();
        others.extend(
            preview
                .iter()
                .map(|preview| (preview.camera.clone(), preview.world_from_camera)),
        );
        let mut masks = ObjectMasks::default();
        let pictures = training.iter().map(|&v| {
            let (view, picture) = (&scene.views[v], scene.load_picture(v)?);
            match config.scene.masks {
                MaskUse::Ignore => {}
                MaskUse::Exclude => masks.look_at_any(&picture),
                MaskUse::Foreground => masks.look(view, &picture)?,
            }
            Ok((view.camera.clone(), view.world_from_camera, picture))
        });
        let views = ViewTable::new(gpu, region, pictures, others.iter())?;
        if config.scene.masks == MaskUse::Exclude {
            masks.check_anything_is_left(scene)?;
        }
        if config.loss.mask > 0.0 {
            masks.check(scene)?;
        }
        let priors = Priors::new(gpu, config, region, scene, &training)?;

        let n_rays = config.rays;
        let model = Model::new(
            gpu,
            config,
            training.len() as u32,
            views.border_color(),
            true,
        )?;
        let renderer = Renderer::new(gpu, config, &model, region, n_rays)?;
        let loss = Loss::new(gpu, config, &renderer, priors)?;
        let s = &config.sampling;
        let mut users = vec![
            (
                Surface::field_shape(config),
                Surface::blocks_of(config) * n_rays * s.samples,
            ),
            (
                Proposal::field_shape(config, 0),
                n_rays * s.proposal_samples[0],
            ),
            (
                Proposal::field_shape(config, 1),
                n_rays * s.proposal_samples[1],
            ),
        ];
        users.extend(
            Background::field_shape(config)
                .map(|shape| (shape, n_rays * config.background.samples)),
        );
        Ok(Trainer {
            schedule: Schedule::new(config),
            scratch: Scratch::new(gpu, &users)?,
            optimizer: Adam::new(gpu, config)?,
            history: gpu.readback("loss history", LOSS_HISTORY * (TERMS.len() as u64 + 1))?,
            tickets: std::collections::VecDeque::new(),
            view_order: training.into_iter().chain(held_out).collect(),
            gpu: gpu.clone(),
            config: config.clone(),
            region: region.clone(),
            preview,
            step: config.first_step,
            rate_factor: 1.0,
            model,
            renderer,
            loss,
            views,
        })
    }

    /// One optimiser step: a batch of pixels in, better parameters out. Returns once the work is handed to the device.
    pub fn step(&mut self) -> Result<()> {
        let now = self
            .schedule
            .at(self.step)
            .with_rates_times(self.rate_factor);
        let ticket = self.gpu.submit("step", |rec| {
            self.renderer.draws.fill(rec, self.step, TRAINING);
            self.renderer
                .rays
                .draw(rec, &self.views, &self.renderer.draws);
            if let Some(priors) = self.priors() {
                let render = &self.renderer;
                priors.draw(rec, &self.views, &render.rays, &render.draws);
            }
            self.gradients(rec, &now);
            self.optimizer
                .update(rec, &self.model, &now, &self.loss.bad_step);
            let width = TERMS.len() as u64 + 1;
            rec.copy(
                &self.loss.sums,
                0,
                &self.history,
                self.step % LOSS_HISTORY * width,
                width,
            );
            Ok(())
        })?;
        self.tickets.push_back((self.step, ticket));
        if self.tickets.len() as u64 > LOSS_HISTORY {
            self.tickets.pop_front();
        }
        self.step += 1;
        Ok(())
    }

    /// Depths and normals that are known of the training pictures, where a loss asks for them.
    fn priors(&self) -> Option<&Priors> {
        self.loss.supervision.as_ref()?.priors.as_ref()
    }

    /// Losses of the batch of rays and draws that lie in the renderer's buffers, and the gradients of all parameters.
    pub fn gradients(&self, rec: &mut Recorder, now: &Now) {
        let (model, render, loss) = (&self.model, &self.renderer, &self.loss);
        let annealed = annealed(now);
        let look = render.look(annealed);

        // Forward: put samples where the surface is likely, ask the fields, composite.
        model.refresh_weights(rec, annealed.released_levels);
        render.forward(rec, model, annealed, true);
        // Loss: its value for the log, its gradient for everything below; a few more points are asked behind the heaviest samples.
        loss.color(rec, &render.composite, &look);
        loss.heaviest(rec, &render.composite, &look);
        let supervision = loss.supervision.as_ref();
        if let Some(supervision) = supervision {
            supervision.run(rec, model, &self.views, &render.composite, &look);
        }
        if now.bias_weight > 0.0 {
            loss.bias(rec, model, &self.scratch, now.bias_weight as f32);
        }
        // Backward: the same sentence, right to left.
        let d_image = supervision.map(|supervision| &supervision.d_image);
        render
            .composite
            .backward(rec, &look, model, &loss.d_color, d_image);
        if let Some(tangent) = &loss.tangent {
            tangent.run(rec, model, &look, &render.draws, &self.scratch);
        }
        let background_rays = render.background_rays(true);
        model.background.backward(
            rec,
            &model.params,
            &render.background,
            &self.scratch,
            &background_rays,
        );
        let shade_inputs = render.shade_inputs(annealed);
        model.surface.backward(
            rec,
            &model.params,
            &render.surface,
            &self.scratch,
            &shade_inputs,
            loss.eikonal_scale,
        );
        render.sampler.backward(
            rec,
            model,
            &render.rays,
            &render.composite.weights,
            &self.scratch,
            loss.interlevel_scale,
        );
        model.fold_gradients(rec, annealed.released_levels);
        loss.sum(rec);
    }

    /// Steps done so far, in all stages.
    pub fn steps_done(&self) -> u64 {
        self.step
    }

    /// Losses of the newest finished step, without waiting for the device; `None` before the first.
    pub fn losses(&self) -> Result<Option<StepLosses>> {
        for &(step, ticket) in self.tickets.iter().rev() {
            if self.gpu.is_done(ticket)? {
                return Ok(Some(self.losses_of(step)));
            }
        }
        Ok(None)
    }

    /// Waits for all steps, then the losses of the last.
    pub fn finish(&self) -> Result<Option<StepLosses>> {
        self.gpu.finish()?;
        Ok(self.tickets.back().map(|&(step, _)| self.losses_of(step)))
    }

    fn losses_of(&self, step: u64) -> StepLosses {
        let width = TERMS.len() as u64 + 1;
        let first = step % LOSS_HISTORY * width;
        let mut values = [0.0; TERMS.len() + 1];
        values.copy_from_slice(&self.history.read(first..first + width));
        StepLosses { step, values }
    }

    /// Brings all parameters up to date, for whoever reads them outside of a step: of the hash table, a step only changes what it needs.
    ///
    /// # Errors
    /// What the device fails with.
    pub fn catch_up(&self) -> Result<()> {
        let Some(table) = &self.model.table else {
            return Ok(());
        };
        self.gpu.submit("catch up", |rec| {
            table.flush(rec, &self.model.params);
            Ok(())
        })?;
        Ok(())
    }

    /// Renders view `view` of the scene at its picture's size, at the current step; other views than those trained with by the appearance
    /// code zero, since the mean of the others is taken when training is over ([`trained`]).
    pub fn render(
        &self,
        view: usize,
        size: (u32, u32),
        keep_going: &mut dyn FnMut(f64) -> bool,
    ) -> Result<Rendered> {
        let row = self
            .view_order
            .iter()
            .position(|&v| v == view)
            .expect("a view of the scene that this was built from") as u32;
        let n_training = self.views.n_training();
        let appearance = match self.config.appearance.at_eval {
            AppearanceAtEval::Frame if row < n_training => row,
            _ => n_training,
        };
        self.render_row(row, size, appearance, keep_going)
    }

    /// Renders a row of the device's table of views.
    fn render_row(
        &self,
        row: u32,
        size: (u32, u32),
        appearance: u32,
        keep_going: &mut dyn FnMut(f64) -> bool,
    ) -> Result<Rendered> {
        self.catch_up()?;
        let shot = Shot {
            views: &self.views,
            view: row,
            size,
            appearance_row: appearance,
            now: self.annealed(),
        };
        self.renderer
            .view(&self.gpu, &self.model, &shot, keep_going)
    }

    /// The annealed numbers that the model is asked with as it is now.
    pub fn annealed(&self) -> Annealed {
        annealed(&self.schedule.at(self.step))
    }

    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }
    /// The model; its parameters are those of all steps done after [`Trainer::catch_up`].
    pub fn model(&self) -> &Model {
        &self.model
    }
    pub fn renderer(&self) -> &Renderer {
        &self.renderer
    }
    pub fn loss(&self) -> &Loss {
        &self.loss
    }
    pub fn region(&self) -> &Region {
        &self.region
    }
    pub fn config(&self) -> &Config {
        &self.config
    }
}

fn annealed(now: &Now) -> Annealed {
    Annealed {
        anneal: now.anneal as f32,
        inv_s_lower: now.inv_s_lower as f32,
        cosine_anneal: now.cosine_anneal as f32,
        tap_step: TapStep {
            range: now.tap_range as f32,
            floor: now.tap_floor as f32,
        },
        released_levels: now.released_levels,
        curvature_weight: now.curvature_weight as f32,
    }
}
