//! The learned functions and their parameters: what a point, a ray or an image is mapped to. Knows nothing of steps.

mod appearance;
mod background;
mod field;
mod forms;
mod half_copy;
mod hash_grid;
mod layer;
mod lazy_table;
mod params;
mod planes;
mod proposal;
mod surface;

pub use background::{Background, BackgroundBuffers, BackgroundRays};
pub use field::{Field, FieldBuffers, FieldShape, Scratch};
pub use forms::layer_ways;
pub use hash_grid::HashGrid;
pub use layer::{Activation, Layer, LayerShape};
pub use lazy_table::{LazyTable, Rates};
pub use params::{Group, Init, Params, ParamsPlan, Span, WeightHandle};
pub use planes::{Activations, Planes};
pub use proposal::{Proposal, ProposalBuffers};
pub use surface::{ShadeInputs, Surface, SurfaceBuffers, TapStep};

use crate::Result;
use crate::config::Config;
use crate::gpu::{Gpu, Ptr, Recorder};

/// Everything that is learned.
pub struct Model {
    pub params: Params,
    pub surface: Surface,
    pub proposals: Vec<Proposal>,
    pub background: Background,
    /// What of the surface's table a step leaves alone, where the model learns.
    pub table: Option<LazyTable>,
    /// Number of training views, each with an appearance code; the row after them is the code for evaluation.
    pub n_views: u32,
}

impl Model {
    /// Builds and initialises the model of a configuration for `n_views` training views under a sky of this colour.
    /// `learns`: with gradients and moments, three times the memory of the parameters.
    pub fn new(
        gpu: &Gpu,
        config: &Config,
        n_views: u32,
        sky: [f32; 3],
        learns: bool,
    ) -> Result<Model> {
        let mut plan = ParamsPlan::default();
        let surface = Surface::new(gpu, config, &mut plan, n_views)?;
        let proposals = (0..2)
            .map(|level| Proposal::new(gpu, config, &mut plan, level))
            .collect::<Result<_>>()?;
        let background = Background::new(gpu, config, &mut plan, n_views, sky)?;
        let table = match learns {
            true => {
                let beside = u32::from(config.loss.tangent > 0.0);
                let points = config.rays * config.sampling.samples * (surface.blocks() + beside);
                let (shape, table) = (&surface.field.shape, surface.field.table());
                LazyTable::new(
                    gpu,
                    &shape.grid,
                    table,
                    &config.optimizer,
                    points,
                    shape.half,
                )?
            }
            false => None,
        };
        Ok(Model {
            table,
            params: plan.build(gpu, config.seed, learns)?,
            surface,
            proposals,
            background,
            n_views,
        })
    }

    /// Refreshes the networks' effective weights, with so many levels of the surface's grid released.
    pub fn refresh_weights(&self, rec: &mut Recorder, released_levels: u32) {
        let columns = self.surface.released_columns(released_levels);
        self.params.normalise_weights(rec, columns);
    }

    /// Folds the effective weights' gradients back into the parameters'; after [`Model::refresh_weights`] with as many levels.
    pub fn fold_gradients(&self, rec: &mut Recorder, released_levels: u32) {
        let columns = self.surface.released_columns(released_levels);
        self.params.fold_gradients(rec, columns);
    }

    /// Before a training step asks the surface at `points [3, n]`: what it will read of the table is brought up to date.
    pub fn touch(&self, rec: &mut Recorder, points: Ptr<f32>, n: u32) {
        if let Some(table) = &self.table {
            table.touch(rec, &self.params, points, n);
        }
    }

    /// Sets the appearance code that evaluation uses: zero, which it is at first, or the mean of the views' codes.
    ///
    /// # Errors
    /// What the device fails with.
    pub fn set_evaluation_code(&self, gpu: &Gpu, mean: bool) -> Result<()> {
        appearance::set_evaluation_code(gpu, &self.params, mean)
    }
}
