//! Depths and normals that are known beforehand, on the device beside the pictures, and what a batch drew of them.

use super::rays::{RayDraws, Rays, ViewTable};
use crate::Result;
use crate::config::{Config, LossConfig};
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, Recorder, Work};
use crate::kernels::{ViewPriors, draw_priors};
use crate::scene::{PriorKind, Region, Scene};

/// The priors of all training views, of those kinds that a loss asks for.
pub struct Priors {
    pub drawn: Buffer<f32>,    // [6, n_rays] glsl/lib/supervision.glsl
    table: Buffer<ViewPriors>, // [training views]
    /// One buffer a map, as for pictures.
    _maps: Vec<Buffer<f32>>,
    draw: Kernel<draw_priors::Args>,
}

impl Priors {
    /// Uploads the priors of the scene's views `training`, or `None` where no loss has a use for any.
    ///
    /// # Errors
    /// What [`Scene::load_prior`] and allocating device memory fail with.
    pub fn new(
        gpu: &Gpu,
        config: &Config,
        region: &Region,
        scene: &Scene,
        training: &[usize],
    ) -> Result<Option<Priors>> {
        let wanted = |kind: PriorKind| weight(&config.loss, kind) > 0.0;
        if !PriorKind::ALL.into_iter().any(wanted) {
            return Ok(None);
        }
        let mut maps = Vec::new();
        let mut rows = Vec::with_capacity(training.len());
        for &view in training {
            let mut row: ViewPriors = bytemuck::Zeroable::zeroed();
            for kind in PriorKind::ALL.into_iter().filter(|&kind| wanted(kind)) {
                let mut prior = scene.load_prior(view, kind)?;
                if kind == PriorKind::SensorDepth {
                    let scale = region.radius.recip() as f32;
                    prior.values.iter_mut().for_each(|depth| *depth *= scale);
                }
                let name = format!("{} {view}", kind.key());
                let map = gpu.buffer::<f32>(&name, prior.values.len() as u64)?;
                gpu.upload(&map, 0, &prior.values)?;
                let (values, width, height): (Ptr<f32>, u32, u32) =
                    (map.ptr(), prior.width, prior.height);
                match kind {
                    PriorKind::MonoDepth => {
                        row.mono_depth = values;
                        (row.mono_depth_width, row.mono_depth_height) = (width, height);
                    }
                    PriorKind::MonoNormal => {
                        row.mono_normal = values;
                        (row.mono_normal_width, row.mono_normal_height) = (width, height);
                    }
                    PriorKind::SensorDepth => {
                        row.sensor_depth = values;
                        (row.sensor_depth_width, row.sensor_depth_height) = (width, height);
                    }
                }
                maps.push(map);
            }
            rows.push(row);
        }
        let table = gpu.buffer("priors", rows.len() as u64)?;
        gpu.upload(&table, 0, &rows)?;
        Ok(Some(Priors {
            drawn: gpu.scratch("drawn priors", 6 * u64::from(config.rays))?,
            table,
            _maps: maps,
            draw: gpu.kernel(draw_priors::Shape {
                mono_depth: u32::from(wanted(PriorKind::MonoDepth)),
                mono_normal: u32::from(wanted(PriorKind::MonoNormal)),
                sensor_depth: u32::from(wanted(PriorKind::SensorDepth)),
            })?,
        }))
    }

    /// The priors of the pixels that rays were drawn through.
    pub fn draw(&self, rec: &mut Recorder, views: &ViewTable, rays: &Rays, draws: &RayDraws) {
        let args = draw_priors::Args {
            views: views.table(),
            maps: self.table.ptr(),
            pixel_draws: draws.pixels(),
            ray_view: rays.view.ptr(),
            directions: rays.directions.ptr(),
            priors: self.drawn.ptr_mut(),
            n_rays: rays.n,
        };
        let work = Work::items(u64::from(rays.n)).flops(40.0).bytes(60.0);
        rec.run(&self.draw, work, args);
    }
}

fn weight(loss: &LossConfig, kind: PriorKind) -> f64 {
    match kind {
        PriorKind::MonoDepth => loss.mono_depth,
        PriorKind::MonoNormal => loss.mono_normal,
        PriorKind::SensorDepth => loss.sensor_depth,
    }
}
