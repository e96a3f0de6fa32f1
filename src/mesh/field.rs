//! A trained model's signed distance, colour and gradient at given points: what extraction asks of the device.

use glam::{DVec3, Vec3};

use super::extract::{Lattice, PointAttributes, SurfaceAttributes};
use crate::Result;
use crate::config::Config;
use crate::gpu::{Buffer, Gpu, Kernel, Work};
use crate::kernels::lattice_points;
use crate::model::{FieldBuffers, Model, ShadeInputs, SurfaceBuffers, TapStep};
use crate::render::Annealed;

/// Evaluates a model at points of the region frame.
pub struct Field<'m> {
    gpu: Gpu,
    model: &'m Model,
    lattice: Kernel<lattice_points::Args>,
    points: Buffer<f32>, // [3, BATCH]
    batch: FieldBuffers,
    /// Grows to the largest block asked for.
    distances: Buffer<f32>,
    surface: SurfaceBuffers,
    tap_draws: Buffer<f32>, // [SHADE_BATCH] without effect: the distance is given
    directions: Buffer<f32>, // [3, SHADE_BATCH]
    code: Buffer<u32>,      // [SHADE_BATCH] row of the appearance code for evaluation
    /// The taps' mean distance in training: colours belong to such gradients.
    color_step: f32,
    near_step: f32,
}

/// Points of one pass of the signed distance, and of shading, which keeps seven times as much.
const BATCH: u32 = 1 << 15;
const SHADE_BATCH: u32 = 1 << 13;
/// Distance of the taps of mesh vertices' normals, in cells of the finest level: far enough for float32, near enough for detail.
const TAP_CELLS: f32 = 2.0;

impl<'m> Field<'m> {
    /// Buffers and kernels to ask `model`, which was built with `config`, as it is at the time `now`.
    pub fn new(gpu: &Gpu, config: &Config, model: &'m Model, now: Annealed) -> Result<Field<'m>> {
        gpu.submit("weights", |rec| {
            model.refresh_weights(rec, now.released_levels);
            Ok(())
        })?;
        let code = gpu.buffer("appearance row", u64::from(SHADE_BATCH))?;
        gpu.upload(&code, 0, &vec![model.n_views; SHADE_BATCH as usize])?;
        let shape = model.surface.field.shape.without_gradient();
        Ok(Field {
            lattice: gpu.kernel(lattice_points::Shape::default())?,
            points: gpu.scratch("lattice points", 3 * u64::from(BATCH))?,
            batch: FieldBuffers::new(gpu, "lattice", &shape, BATCH, 0)?,
            distances: gpu.scratch("lattice distances", u64::from(BATCH))?,
            surface: model.surface.buffers(gpu, SHADE_BATCH)?,
            directions: gpu.buffer("view directions", 3 * u64::from(SHADE_BATCH))?,
            gpu: gpu.clone(),
            model,
            tap_draws: gpu.buffer("tap draws", u64::from(SHADE_BATCH))?,
            code,
            color_step: (0.5 * now.tap_step.range).max(now.tap_step.floor),
            near_step: TAP_CELLS * 2.0 / config.hash.max as f32,
        })
    }

    /// Signed distances at points of the region frame, positive in free space.
    pub fn sdf(&mut self, points: &[[f32; 3]]) -> Result<Vec<f32>> {
        let mut distances = Vec::with_capacity(points.len());
        for chunk in points.chunks(BATCH as usize) {
            self.gpu
                .upload(&self.points, 0, &planar(chunk, BATCH as usize))?;
            self.gpu.submit("sdf", |rec| {
                let field = &self.model.surface.field;
                field.forward(
                    rec,
                    &self.model.params,
                    self.points.ptr(),
                    &self.batch,
                    self.distances.ptr_mut(),
                );
                Ok(())
            })?;
            distances.extend(self.gpu.download(&self.distances, 0, chunk.len() as u64)?);
        }
        Ok(distances)
    }

    /// Uploads samples with their taps, if any, `tap_step` away, shades them as seen along `directions`, and returns colours and
    /// gradients.
    fn shade(
        &mut self,
        points: &[[f32; 3]],
        directions: &[[f32; 3]],
        tap_step: f32,
    ) -> Result<PointAttributes> {
        let n = SHADE_BATCH as usize;
        let mut all = Vec::with_capacity(21 * n);
        for axis in 0..3 {
            let taps = self.model.surface.tap_directions().iter();
            for offset in std::iter::once(0.0).chain(taps.map(|tap| tap_step * tap[axis])) {
                all.extend((0..n).map(|i| points.get(i).map_or(0.0, |p| p[axis]) + offset));
            }
        }
        self.gpu.upload(&self.surface.points, 0, &all)?;
        self.gpu
            .upload(&self.directions, 0, &planar(directions, n))?;
        let inputs = ShadeInputs {
            tap_draws: self.tap_draws.ptr(),
            tap_step: TapStep {
                range: 0.0,
                floor: tap_step,
            },
            curvature_scale: 0.0,
            directions: self.directions.ptr(),
            ray_view: self.code.ptr(),
            n_rays: SHADE_BATCH,
        };
        self.gpu.submit("shade", |rec| {
            self.model
                .surface
                .forward(rec, &self.model.params, &self.surface, &inputs);
            Ok(())
        })?;
        let rgb = self
            .gpu
            .download(&self.surface.rgb, 0, 3 * u64::from(SHADE_BATCH))?;
        let gradient_row = self.model.surface.gradient_row(&self.surface);
        let gradients = self.gpu.download(
            &self.surface.shading,
            gradient_row,
            3 * u64::from(SHADE_BATCH),
        )?;
        let triples = |planes: &[f32]| {
            (0..points.len())
                .map(|i| [planes[i], planes[n + i], planes[2 * n + i]])
                .collect()
        };
        Ok((triples(&rgb), triples(&gradients)))
    }
}

impl Lattice for Field<'_> {
    fn sdf(
        &mut self,
        origin: DVec3,
        step: f64,
        dims: [usize; 3],
        values: &mut Vec<f32>,
    ) -> Result<()> {
        let total = dims.iter().product::<usize>() as u64;
        let batches = total.div_ceil(u64::from(BATCH));
        if self.distances.len() < batches * u64::from(BATCH) {
            self.distances = self
                .gpu
                .scratch("lattice distances", batches * u64::from(BATCH))?;
        }
        self.gpu.submit("lattice", |rec| {
            for batch in 0..batches {
                let args = lattice_points::Args {
                    points: self.points.ptr_mut(),
                    n: BATCH,
                    first: (batch * u64::from(BATCH)) as u32,
                    n_x: dims[0] as u32,
                    n_y: dims[1] as u32,
                    origin: origin.as_vec3().to_array(),
                    step: step as f32,
                };
                rec.run(
                    &self.lattice,
                    Work::items(u64::from(BATCH)).flops(10.0).bytes(12.0),
                    args,
                );
                let to = self.distances.at_mut(batch * u64::from(BATCH));
                self.model.surface.field.forward(
                    rec,
                    &self.model.params,
                    self.points.ptr(),
                    &self.batch,
                    to,
                );
            }
            Ok(())
        })?;
        *values = self.gpu.download(&self.distances, 0, total)?;
        Ok(())
    }
}

impl SurfaceAttributes for Field<'_> {
    /// Colours as seen head-on, along the inward normal: a mesh has one colour a vertex, the network one for every direction.
    fn attributes(&mut self, points: &[[f32; 3]]) -> Result<PointAttributes> {
        let (mut colors, mut gradients) = (
            Vec::with_capacity(points.len()),
            Vec::with_capacity(points.len()),
        );
        for chunk in points.chunks(SHADE_BATCH as usize) {
            let any = vec![[0.0, 0.0, -1.0]; chunk.len()];
            let (_, gradient) = self.shade(chunk, &any, self.near_step)?;
            let inward: Vec<[f32; 3]> = gradient
                .iter()
                .map(|&g| {
                    (-Vec3::from(g))
                        .try_normalize()
                        .unwrap_or(Vec3::NEG_Z)
                        .to_array()
                })
                .collect();
            // The network knows colours by the gradients that it was trained with, those of taps at their mean distance.
            let (rgb, _) = self.shade(chunk, &inward, self.color_step)?;
            // The padding that compositing applies (glsl/lib/volume.glsl).
            colors.extend(
                rgb.into_iter()
                    .map(|c| c.map(|x| (1.002 * x - 0.001).clamp(0.0, 1.0))),
            );
            gradients.extend(gradient);
        }
        Ok((colors, gradients))
    }
}

/// `[3, n]` from points, padded with zeros.
fn planar(points: &[[f32; 3]], n: usize) -> Vec<f32> {
    (0..3)
        .flat_map(|axis| (0..n).map(move |i| points.get(i).map_or(0.0, |p| p[axis])))
        .collect()
}
