//! The run around the step: when to tell, to look and to save, and how to go on later exactly where it stopped.

use super::checkpoint::{self, Checkpoint, State, Tensor};
use super::report::{Control, Event, Losses, Pace};
use super::run_directory::RunDirectory;
use super::{StepLosses, Trainer};
use crate::config::Config;
use crate::gpu::Buffer;
use crate::render::TERMS;
use crate::scene::{Scene, Split};
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// After so many steps in a row without finite losses, none of which changed the parameters, training goes back to its last checkpoint,
/// once, with this factor on all learning rates; the second time it gives up.
const BAD_STEPS: u32 = 10;
const SLOWED: f64 = 0.5;

/// Values, first and second moments.
const BLOCKS: usize = 3;

/// Key of that factor in a checkpoint's extra state.
const RATE_FACTOR: &str = "learning_rate_factor";

impl Trainer {
    /// Trains from where this stands to the end of the stage, writing previews and checkpoints into `run`.
    /// `tell` hears of everything that happens; once it answers [`Control::Stop`] a checkpoint is saved and the run ends.
    ///
    /// # Errors
    /// [`Error::Interrupted`] when stopped; [`Error::Numerical`] when losses stay non-finite; [`Error::Output`] when a picture or a
    /// checkpoint cannot be written; whatever the device fails with. Checkpoints that were saved before stay.
    pub fn run(
        &mut self,
        scene: &Scene,
        run: &RunDirectory,
        tell: &mut dyn FnMut(Event) -> Control,
    ) -> Result<()> {
        let began = Instant::now();
        let end = self.config.first_step + self.config.steps;
        let steps = self.config.total_steps();
        let report = self.config.report.clone();
        let mut stop = false;
        let mut tell = |event: Event| {
            stop |= tell(event) == Control::Stop;
            stop
        };
        tell(Event::Started {
            step: self.step,
            steps,
            device: self.gpu.info().name.clone(),
            train_views: scene.split(Split::Train).count(),
            test_views: scene.split(Split::Test).count(),
            parameters: self
                .model
                .params
                .spans()
                .iter()
                .map(|span| span.len())
                .sum(),
        });
        let mut pace = Pace::default();
        pace.mark(self.step);
        let mut bad = BadSteps::default();
        let mut surface = SurfaceWatch::default();
        let mut saved = (self.step, Instant::now());
        while self.step < end {
            self.step()?;
            let step = self.step;
            let mut stopping = tell(Event::Advanced { step, steps });
            let losses = self.losses()?;
            if let Some(losses) = &losses {
                if bad.watch(losses) {
                    let what = self.go_back(run, losses)?;
                    tell(Event::Warning { step, what });
                    (pace, bad) = (Pace::default(), BadSteps::default());
                    continue;
                }
                if step.is_multiple_of(report.log_steps) {
                    pace.mark(step);
                    stopping |= tell(told(losses, &self.config, pace.per_second()));
                    if surface.is_lost(losses.of("crossing")) {
                        let what = NO_SURFACE.into();
                        stopping |= tell(Event::Warning { step, what });
                    }
                }
            }
            let last = step == end;
            if !stopping && due(step, report.preview_steps, last) {
                let begun = Instant::now();
                match self.look(scene, &run.preview(step), &mut || {
                    tell(Event::Advanced { step, steps })
                }) {
                    Ok(Some(psnr)) => {
                        let path = run.preview(step);
                        let seconds = begun.elapsed().as_secs_f64();
                        stopping |= tell(Event::Preview {
                            step,
                            path,
                            psnr,
                            seconds,
                        });
                    }
                    Ok(None) => {}
                    Err(Error::Interrupted { .. }) => stopping = true,
                    // A picture that is not there any more, or cannot be written: no reason to end what trains well without it.
                    Err(error @ (Error::Input { .. } | Error::Output { .. })) => {
                        let what = format!("no preview: {error}");
                        stopping |= tell(Event::Warning { step, what });
                    }
                    Err(error) => return Err(error),
                }
            }
            // (A checkpoint brings a lazy table up to date, which shows in the last digits of what follows.)
            let overdue = !self.config.deterministic
                && report.checkpoint_minutes > 0.0
                && saved.1.elapsed().as_secs_f64() >= 60.0 * report.checkpoint_minutes;
            if stopping || last || overdue || due(step, report.checkpoint_steps, false) {
                if let Some(losses) = self.finish()? {
                    bad.watch(&losses);
                    if last && !step.is_multiple_of(report.log_steps) {
                        pace.mark(step);
                        tell(told(&losses, &self.config, pace.per_second()));
                    }
                }
                // What made the losses bad may be in the parameters: the last checkpoint from before it must stay the newest.
                if bad.count > 0 && !stopping && !last {
                    continue;
                }
                let begun = Instant::now();
                let path = self.save(&run.checkpoints())?;
                saved = (step, Instant::now());
                tell(Event::Saved {
                    step,
                    path,
                    seconds: begun.elapsed().as_secs_f64(),
                });
            }
            if stopping && !last {
                return Err(Error::Interrupted {
                    what: format!(
                        "stopped after step {step} of {steps}; a checkpoint of it was saved, --resume goes on from there"
                    ),
                });
            }
        }
        if saved.0 != self.step || checkpoint::files(&run.checkpoints())?.is_empty() {
            self.save(&run.checkpoints())?;
        }
        if end == steps {
            tell(Event::Finished {
                step: self.step,
                seconds: began.elapsed().as_secs_f64(),
            });
        }
        Ok(())
    }

    /// Takes back the newest checkpoint after losses that were not finite, and says so; fails where that has been done before.
    fn go_back(&mut self, run: &RunDirectory, losses: &StepLosses) -> Result<String> {
        let step = losses.step;
        let terms: Vec<String> = TERMS
            .iter()
            .zip(&losses.values)
            .map(|(name, value)| format!("{name} {value}"))
            .collect();
        let happened = format!(
            "the loss has not been finite for {BAD_STEPS} steps, up to step {step} ({})",
            terms.join(", ")
        );
        let newest = checkpoint::latest(&run.checkpoints()).ok();
        match newest {
            Some(newest) if self.rate_factor == 1.0 => {
                match newest.checkpoint.state().step == self.config.first_step {
                    true => self.begin_from(&newest.checkpoint)?, // the end of the stage before this one
                    false => self.restore(&newest.checkpoint)?,
                }
                self.rate_factor = SLOWED;
                Ok(format!(
                    "{happened}: going on from the checkpoint of step {} with learning rates times {SLOWED}",
                    self.step
                ))
            }
            newest => {
                let next = match newest {
                    Some(newest) => format!(
                        "the checkpoint of step {} is intact: --resume it with smaller learning rates",
                        newest.checkpoint.state().step
                    ),
                    None => "begin again with smaller learning rates".into(),
                };
                Err(Error::Numerical {
                    what: format!(
                        "{happened}\n  next: {next} (optimizer.*.learning_rate), and look at the dataset and its region with `neurodin inspect`"
                    ),
                })
            }
        }
    }

    /// The trainer of the stage after this one, or `None` if this was the last. It begins with the parameters of the newest checkpoint,
    /// which [`Trainer::run`] left at the end of this stage; this stage's memory is freed first.
    ///
    /// # Errors
    /// What [`Trainer::new`] and [`Trainer::begin_from`] fail with.
    pub fn next_stage(self, scene: &Scene, run: &RunDirectory) -> Result<Option<Trainer>> {
        let Some(config) = self.config.second_stage() else {
            return Ok(None);
        };
        let (gpu, region) = (self.gpu.clone(), self.region.clone());
        drop(self);
        let mut next = Trainer::new(&gpu, scene, &region, &config)?;
        next.begin_from(&checkpoint::latest(&run.checkpoints())?.checkpoint)?;
        Ok(Some(next))
    }

    /// Takes the parameters, and nothing else, of the checkpoint at the end of the stage before this one, as NeuRodin's released code does.
    ///
    /// # Errors
    /// [`Error::Input`] if it is not the end of that stage, or of another model or region; what writing device memory fails with.
    pub fn begin_from(&mut self, checkpoint: &Checkpoint) -> Result<()> {
        let state = checkpoint.state();
        if state.step != self.config.first_step {
            return Err(Error::input(
                checkpoint.path(),
                format!(
                    "is of step {}; the stage before this one ends with step {}",
                    state.step, self.config.first_step
                ),
                "finish that stage first, with --resume",
            ));
        }
        self.take(checkpoint, 1)?;
        let params = &self.model.params;
        self.gpu.submit("new moments", |rec| {
            for moment in [params.first_moment(), params.second_moment()] {
                rec.fill(moment, 0..moment.len(), 0);
            }
            Ok(())
        })?;
        self.step = state.step;
        self.tickets.clear();
        self.gpu.finish()
    }

    /// Writes a checkpoint of everything that later steps depend on into `folder`; see [`checkpoint::save`].
    ///
    /// # Errors
    /// [`Error::Output`] if it cannot be written; what reading device memory fails with.
    pub fn save(&self, folder: &Path) -> Result<PathBuf> {
        self.catch_up()?;
        self.gpu.finish()?;
        let state = State {
            step: self.step,
            config: self.config.clone(),
            region: self.region.clone(),
            extra: BTreeMap::from([(RATE_FACTOR.into(), self.rate_factor.to_string())]),
        };
        let parts = self.parts();
        let tensors: Vec<Tensor> = parts.iter().map(|(tensor, ..)| tensor.clone()).collect();
        checkpoint::save(
            folder,
            self.config.report.keep,
            &state,
            &tensors,
            &mut |tensor, range| {
                let (_, buffer, first) = parts
                    .iter()
                    .find(|(part, ..)| part == tensor)
                    .expect("asked for what was offered");
                self.gpu
                    .download(buffer, first + range.start, range.end - range.start)
            },
        )
    }

    /// Takes the state of a checkpoint, which must be of the same model and region.
    ///
    /// # Errors
    /// [`Error::Input`] if the tensors do not fit; what writing device memory fails with.
    pub fn restore(&mut self, checkpoint: &Checkpoint) -> Result<()> {
        self.take(checkpoint, BLOCKS)?;
        let state = checkpoint.state();
        self.step = state.step;
        let factor = state.extra.get(RATE_FACTOR);
        self.rate_factor = factor.and_then(|text| text.parse().ok()).unwrap_or(1.0);
        self.tickets.clear();
        Ok(())
    }

    /// Reads the first `blocks` of values and moments.
    fn take(&mut self, checkpoint: &Checkpoint, blocks: usize) -> Result<()> {
        if checkpoint.state().region != self.region {
            return Err(Error::input(
                checkpoint.path(),
                "belongs to another region than this run's",
                "resume without changing the region, or begin a new run",
            ));
        }
        let parts = self.parts();
        let n_tensors = parts.len() / BLOCKS * blocks;
        for (tensor, buffer, first) in parts.into_iter().take(n_tensors) {
            checkpoint.read(&tensor, &mut |offset, numbers| {
                self.gpu.upload(buffer, first + offset, numbers)
            })?;
        }
        self.model.params.refresh_copy(&self.gpu)?;
        if let Some(table) = &self.model.table {
            self.gpu.submit("reset", |rec| {
                table.reset(rec, &self.model.params);
                Ok(())
            })?;
        }
        self.gpu.finish()
    }

    /// What a checkpoint holds: parameters and their moments, each with its place on the device.
    fn parts(&self) -> Vec<(Tensor, &Buffer<f32>, u64)> {
        let params = &self.model.params;
        let blocks: [_; BLOCKS] = [
            ("", params.values()),
            ("first_moment.", params.first_moment()),
            ("second_moment.", params.second_moment()),
        ];
        blocks
            .into_iter()
            .flat_map(|(prefix, buffer)| {
                params.spans().iter().map(move |span| {
                    let tensor = Tensor {
                        name: format!("{prefix}{}", span.name),
                        shape: span.shape.clone(),
                    };
                    (tensor, buffer, span.first)
                })
            })
            .collect()
    }
}

/// Whether something that happens every `interval` steps (0: never) happens after this one, or `at_last` at the end.
fn due(step: u64, interval: u64, at_last: bool) -> bool {
    interval > 0 && (step.is_multiple_of(interval) || at_last)
}

/// A finished step's losses as an event.
fn told(losses: &StepLosses, config: &Config, it_per_s: f64) -> Event {
    let of = |term| f64::from(losses.of(term));
    let weights = &config.loss;
    let optional = [
        ("tangent", weights.tangent),
        ("curvature", weights.curvature.weight),
        ("mask", weights.mask),
        ("sensor_depth", weights.sensor_depth),
        ("mono_depth", weights.mono_depth),
        ("mono_normal", weights.mono_normal),
    ];
    let mut parts = vec![
        ("color", of("color")),
        ("eikonal", of("eikonal")),
        ("interlevel", of("interlevel_0") + of("interlevel_1")),
        ("bias", of("bias")),
    ];
    let switched_on = optional.iter().filter(|(_, weight)| *weight > 0.0);
    parts.extend(switched_on.map(|&(term, _)| (term, of(term))));
    Event::Step {
        step: losses.step + 1,
        steps: config.total_steps(),
        losses: Losses {
            total: f64::from(losses.total()),
            parts,
        },
        psnr: -10.0 * (of("square_error") / of("pixel_weight")).log10(),
        crossing: of("crossing"),
        it_per_s,
    }
}

const NO_SURFACE: &str = "no ray meets a surface any more: pictures may still come out right, a mesh would be empty. Often the ground runs on \
     beyond the region: try background.kind=field, or a larger --region-scale";

/// Notices when there was a surface and there is none any more.
#[derive(Default)]
struct SurfaceWatch {
    there: bool,
}

impl SurfaceWatch {
    /// Fewer rays than this may miss a surface, or meet one, by chance.
    const CLEARLY_THERE: f32 = 0.05;

    /// Whether it has just gone, given the share of rays that meet it.
    fn is_lost(&mut self, crossing: f32) -> bool {
        let lost = self.there && crossing == 0.0;
        self.there = crossing >= Self::CLEARLY_THERE || self.there && !lost;
        lost
    }
}

/// Counts steps in a row whose losses were not finite.
#[derive(Default)]
struct BadSteps {
    last: Option<u64>,
    count: u32,
}

impl BadSteps {
    /// Whether these losses are the last of too many.
    fn watch(&mut self, losses: &StepLosses) -> bool {
        if self.last != Some(losses.step) {
            self.last = Some(losses.step);
            self.count = match losses.total().is_finite() {
                true => 0,
                false => self.count + 1,
            };
        }
        self.count >= BAD_STEPS
    }
}

#[cfg(test)]
mod tests {
    use super::SurfaceWatch;

    #[test]
    fn a_lost_surface_is_told_once() {
        let mut surface = SurfaceWatch::default();
        let shares = [0.0, 0.01, 0.0, 0.2, 0.01, 0.0, 0.0, 0.3, 0.0];
        let told: Vec<bool> = shares.map(|share| surface.is_lost(share)).into();
        let at: Vec<usize> = (0..told.len()).filter(|&i| told[i]).collect();
        assert_eq!(at, [5, 8]);
    }
}
