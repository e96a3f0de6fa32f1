//! A run opened to be asked: its model as of the newest whole checkpoint, and its views rendered with it.

use super::checkpoint::{self, Tensor};
use super::run_directory::{RunDirectory, SceneRecord};
use super::schedule::Schedule;
use crate::config::{AppearanceAtEval, Config};
use crate::gpu::Gpu;
use crate::model::Model;
use crate::render::{Annealed, Rendered, Renderer, ViewTable};
use crate::scene::{Region, Scene, Split};
use crate::{Error, Result};
use std::path::PathBuf;

/// What a run has learned.
pub struct Trained {
    pub gpu: Gpu,
    pub config: Config,
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

    /// Everything that rendering the views of `scene` needs, on the device.
    ///
    /// # Errors
    /// What the device fails with.
    pub fn viewer<'t>(&'t self, scene: &Scene) -> Result<Viewer<'t>> {
        let mean = self.config.appearance.at_eval == AppearanceAtEval::Mean;
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
            renderer: Renderer::new(
                &self.gpu,
                &self.config,
                &self.model,
                &self.region,
                self.config.rays,
            )?,
            views: ViewTable::new(&self.gpu, &self.region, std::iter::empty(), cameras.iter())?,
            codes,
        })
    }
}

/// Renders a scene's views with what a run has learned.
pub struct Viewer<'t> {
    trained: &'t Trained,
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
        let Trained {
            gpu, config, model, ..
        } = self.trained;
        let code = match (config.appearance.at_eval, self.codes[view]) {
            (AppearanceAtEval::Frame, Some(own)) => own,
            _ => model.n_views,
        };
        let camera = &scene.views[view].camera;
        self.renderer.view(
            gpu,
            model,
            &self.views,
            view as u32,
            (camera.width, camera.height),
            code,
            self.trained.annealed(),
            keep_going,
        )
    }
}
