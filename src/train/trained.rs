//! A run opened to be asked: its model as of the newest whole checkpoint, and its views rendered with it.

use super::checkpoint::{self, Tensor};
use super::run_directory::{RunDirectory, SceneRecord};
use super::schedule::Schedule;
use crate::config::{AppearanceAtEval, Config};
use crate::gpu::Gpu;
use crate::model::Model;
use crate::render::{Annealed, Rendered, Renderer, Shot, ViewTable};
use crate::scene::{Region, Scene, Split};
use crate::{Error, Result};
use std::path::PathBuf;

/// What a run has learned.
pub struct Trained {
    gpu: Gpu,
    config: Config,
    pub region: Region,
    pub record: SceneRecord,
    pub model: Model,
    /// Steps that the model was trained for.
    pub step: u64,
    /// Where it was read from.
    pub checkpoint: PathBuf,
    /// Newer checkpoints that were refused, with the reasons.
    pub refused: Vec<Error>,
}

impl Trained {
    /// Reads the newest whole checkpoint of a run onto the device.
    ///
    /// # Errors
    /// [`Error::Input`] if the run has no whole checkpoint or its files do not belong together; what the device fails with.
    pub fn open(gpu: &Gpu, run: &RunDirectory) -> Result<Trained> {
        let record = SceneRecord::load(run)?;
        let latest = checkpoint::latest(&run.checkpoints())?;
        let state = latest.checkpoint.state().clone();
        let n_training = record
            .views
            .iter()
            .filter(|view| view.split == Split::Train)
            .count();
        let model = Model::new(gpu, &state.config, n_training as u32, [0.5; 3], false)?;
        let values = model.params.values();
        for span in model.params.spans() {
            let tensor = Tensor {
                name: span.name.clone(),
                shape: span.shape.clone(),
            };
            latest.checkpoint.read(&tensor, &mut |first, numbers| {
                gpu.upload(values, span.first + first, numbers)
            })?;
        }
        model.params.refresh_copy(gpu)?;
        let mean = state.config.appearance.at_eval == AppearanceAtEval::Mean;
        model.set_evaluation_code(gpu, mean)?;
        gpu.finish()?;
        Ok(Trained {
            gpu: gpu.clone(),
            config: state.config,
            region: state.region,
            record,
            model,
            step: state.step,
            checkpoint: latest.checkpoint.path().into(),
            refused: latest.refused,
        })
    }

    /// The annealed numbers that the model is asked with.
    pub fn annealed(&self) -> Annealed {
        super::annealed(&Schedule::new(&self.config).at(self.step))
    }

    /// The settings that it was trained with.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Everything that rendering the views of `scene` needs, on the device; with which appearance code, says `at_eval`.
    ///
    /// # Errors
    /// What the device fails with.
    pub fn viewer<'t>(&'t self, scene: &Scene, at_eval: AppearanceAtEval) -> Result<Viewer<'t>> {
        self.viewer_with(scene, &self.config, at_eval)
    }

    /// The same with other numbers of rays and shading samples than in training.
    ///
    /// # Errors
    /// What the device fails with.
    pub fn fine_viewer<'t>(&'t self, scene: &Scene, rays: u32, samples: u32) -> Result<Viewer<'t>> {
        let mut config = self.config.clone();
        config.rays = rays;
        config.sampling.samples = samples;
        self.viewer_with(scene, &config, config.appearance.at_eval)
    }

    fn viewer_with<'t>(
        &'t self,
        scene: &Scene,
        config: &Config,
        at_eval: AppearanceAtEval,
    ) -> Result<Viewer<'t>> {
        let mean = at_eval == AppearanceAtEval::Mean;
        self.model.set_evaluation_code(&self.gpu, mean)?;
        let cameras: Vec<_> = scene
            .views
            .iter()
            .map(|view| (view.camera.clone(), view.world_from_camera))
            .collect();
        // Codes belong to training views by their order among themselves.
        let mut trained = 0;
        let codes = scene
            .views
            .iter()
            .map(|view| {
                let code = (view.split == Split::Train).then_some(trained);
                trained += u32::from(code.is_some());
                code
            })
            .collect();
        Ok(Viewer {
            trained: self,
            at_eval,
            renderer: Renderer::new(&self.gpu, config, &self.model, &self.region, config.rays)?,
            views: ViewTable::new(&self.gpu, &self.region, std::iter::empty(), cameras.iter())?,
            codes,
        })
    }
}

/// Renders a scene's views with what a run has learned.
pub struct Viewer<'t> {
    trained: &'t Trained,
    at_eval: AppearanceAtEval,
    renderer: Renderer,
    views: ViewTable,
    /// Row of each view's own appearance code; `None` for views that were not trained with.
    codes: Vec<Option<u32>>,
}

impl Viewer<'_> {
    /// Renders view number `view` of the scene at its camera's size. `keep_going` is told the share that is done.
    ///
    /// # Errors
    /// [`Error::Interrupted`] when `keep_going` says no; what the device fails with.
    pub fn render(
        &self,
        scene: &Scene,
        view: usize,
        keep_going: &mut dyn FnMut(f64) -> bool,
    ) -> Result<Rendered> {
        let Trained { gpu, model, .. } = self.trained;
        self.renderer
            .view(gpu, model, &self.shot(scene, view), keep_going)
    }

    /// How far behind the surface each of the view's rays is heaviest, in the input's units; `None` where it meets no surface.
    ///
    /// # Errors
    /// As [`Viewer::render`].
    pub fn bias(
        &self,
        scene: &Scene,
        view: usize,
        keep_going: &mut dyn FnMut(f64) -> bool,
    ) -> Result<Vec<Option<f64>>> {
        let Trained { gpu, model, .. } = self.trained;
        let shot = self.shot(scene, view);
        let distances = self.renderer.bias(gpu, model, &shot, keep_going)?;
        let to_world = |distance: f32| f64::from(distance) * self.trained.region.radius;
        Ok(distances.into_iter().map(|d| d.map(to_world)).collect())
    }

    fn shot(&self, scene: &Scene, view: usize) -> Shot<'_> {
        let appearance_row = match (self.at_eval, self.codes[view]) {
            (AppearanceAtEval::Frame, Some(own)) => own,
            _ => self.trained.model.n_views,
        };
        let camera = &scene.views[view].camera;
        Shot {
            views: &self.views,
            view: view as u32,
            size: (camera.width, camera.height),
            appearance_row,
            now: self.trained.annealed(),
        }
    }
}
