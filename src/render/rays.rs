//! Pictures on the device, the random numbers of a step, and rays through pixels.

use glam::DMat4;

use crate::Result;
use crate::config::{Config, GradientKind};
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, Recorder, Work};
use crate::kernels::{self, draw_rays, draw_uniforms, view_rays};
use crate::model::Background;
use crate::scene::{Camera, Picture, Region, RegionShape};

/// Cameras of all views and, for training views, their pictures, on the device.
pub struct ViewTable {
    table: Buffer<kernels::View>,  // [views] training views first
    cumulative_share: Buffer<f32>, // [training views]
    /// RGBA8, one buffer a picture, so that no allocation grows with the dataset.
    _pixels: Vec<Buffer<u32>>,
    n_training: u32,
    /// The commonest colour along the pictures' borders: what an even sky looks like.
    border_color: [f32; 3],
}

impl ViewTable {
    /// Uploads training pictures and all cameras. `training` and `others` give each view's camera at its picture's size and its pose.
    pub fn new<'a>(
        gpu: &Gpu,
        region: &Region,
        training: impl ExactSizeIterator<Item = Result<(Camera, DMat4, Picture)>>,
        others: impl Iterator<Item = &'a (Camera, DMat4)>,
    ) -> Result<ViewTable> {
        let n_training = training.len() as u32;
        let (mut rows, mut pixels, mut counts) = (Vec::new(), Vec::new(), Vec::new());
        let mut borders = BorderColors::default();
        for (index, view) in training.enumerate() {
            let (camera, pose, picture) = view?;
            let rgba: &[u32] = bytemuck::cast_slice(&picture.rgba);
            let buffer = gpu.buffer::<u32>(&format!("picture {index}"), rgba.len() as u64)?;
            gpu.upload(&buffer, 0, rgba)?;
            rows.push(view_row(region, &camera, &pose, buffer.ptr()));
            counts.push(rgba.len() as f64);
            borders.add(&picture);
            pixels.push(buffer);
        }
        let none = pixels
            .first()
            .map_or(bytemuck::Zeroable::zeroed(), Buffer::ptr);
        rows.extend(others.map(|(camera, pose)| view_row(region, camera, pose, none)));
        let total: f64 = counts.iter().sum();
        let mut sum = 0.0;
        let mut share: Vec<f32> = counts
            .iter()
            .map(|n| {
                sum += n;
                (sum / total) as f32
            })
            .collect();
        if let Some(last) = share.last_mut() {
            *last = 1.0;
        }
        let table = gpu.buffer("views", rows.len().max(1) as u64)?;
        gpu.upload(&table, 0, &rows)?;
        let cumulative_share = gpu.buffer("cumulative pixel share", share.len().max(1) as u64)?;
        gpu.upload(&cumulative_share, 0, &share)?;
        Ok(ViewTable {
            table,
            cumulative_share,
            _pixels: pixels,
            n_training,
            border_color: borders.commonest(),
        })
    }

    /// The device's table, training views first.
    pub fn table(&self) -> Ptr<kernels::View> {
        self.table.ptr()
    }

    /// The commonest colour along the borders of the training pictures, in [0, 1].
    pub fn border_color(&self) -> [f32; 3] {
        self.border_color
    }

    /// Number of training views; also the row of the appearance code that evaluation uses.
    pub fn n_training(&self) -> u32 {
        self.n_training
    }
}

/// A coarse colour histogram of picture borders.
#[derive(Default)]
struct BorderColors {
    /// Count and sum of the colours by their upper four bits per channel.
    bins: std::collections::HashMap<[u8; 3], (u64, [u64; 3])>,
}

impl BorderColors {
    fn add(&mut self, picture: &Picture) {
        let (w, h) = (picture.width as usize, picture.height as usize);
        let rows = (0..w).flat_map(|x| [x, (h - 1) * w + x]);
        let columns = (0..h).flat_map(|y| [y * w, y * w + w - 1]);
        for pixel in rows.chain(columns) {
            let rgb: [u8; 3] = std::array::from_fn(|c| picture.rgba[4 * pixel + c]);
            let (count, sum) = self.bins.entry(rgb.map(|c| c >> 4)).or_default();
            *count += 1;
            for (sum, value) in sum.iter_mut().zip(rgb) {
                *sum += u64::from(value);
            }
        }
    }

    /// Mean of the fullest bin; grey without pictures. Ties go to the darker one, so that the answer does not depend on hashing.
    fn commonest(&self) -> [f32; 3] {
        let fullest = self
            .bins
            .iter()
            .max_by_key(|(bin, (count, _))| (*count, std::cmp::Reverse(**bin)));
        fullest.map_or([0.5; 3], |(_, (count, sum))| {
            sum.map(|s| s as f32 / (*count as f32 * 255.0))
        })
    }
}

fn view_row(
    region: &Region,
    camera: &Camera,
    world_from_camera: &DMat4,
    pixels: Ptr<u32>,
) -> kernels::View {
    let center = (world_from_camera.w_axis.truncate() - region.center) / region.radius;
    let mut region_from_camera = [0.0f32; 12];
    for row in 0..3 {
        for column in 0..3 {
            region_from_camera[row * 4 + column] = world_from_camera.col(column)[row] as f32;
        }
        region_from_camera[row * 4 + 3] = center[row] as f32;
    }
    kernels::View {
        pixels,
        region_from_camera,
        params: camera.params_f32(),
        model: camera.model as u32,
        width: camera.width,
        height: camera.height,
        padding: 0,
    }
}

/// All random numbers of one step, raw in [0, 1), drawn by one kernel from (seed, step).
pub struct RayDraws {
    pub all: Buffer<f32>,
    n_rays: u64,
    /// Draws for all samples of a ray.
    for_samples: u64,
    kernel: Kernel<draw_uniforms::Args>,
    seed: u32,
}

impl RayDraws {
    /// Room for the draws of a batch.
    pub fn new(gpu: &Gpu, config: &Config, n_rays: u32) -> Result<RayDraws> {
        let n_rays = u64::from(n_rays);
        let for_samples = u64::from(config.sampling.samples)
            * match config.surface.gradient {
                GradientKind::Taps => 1,
                GradientKind::Analytic => 2,
            };
        let per_ray = 3 + 3 + for_samples + u64::from(Background::draws_per_ray(config));
        Ok(RayDraws {
            all: gpu.scratch("draws", n_rays * per_ray)?,
            n_rays,
            for_samples,
            kernel: gpu.kernel(draw_uniforms::Shape::default())?,
            seed: config.seed,
        })
    }

    /// Fills the buffer; training and evaluation differ by `purpose`.
    pub fn fill(&self, rec: &mut Recorder, step: u64, purpose: u32) {
        let n = self.all.len();
        let args = draw_uniforms::Args {
            draws: self.all.ptr_mut(),
            n: n as u32,
            seed: self.seed,
            step: step as u32,
            purpose,
        };
        rec.run(&self.kernel, Work::items(n).flops(20.0).bytes(4.0), args);
    }

    /// `[3, n_rays]`: picture, column, row.
    pub fn pixels(&self) -> Ptr<f32> {
        self.all.ptr()
    }

    /// `[n_rays]` jitter of the first sampler (0) and the two resamplings (1, 2).
    pub fn jitter(&self, level: u64) -> Ptr<f32> {
        self.all.ptr().offset((3 + level) * self.n_rays)
    }

    /// `[n_rays, n_samples]` tap distances; with the analytic gradient `[2, n_rays, n_samples]` directions of the tangent-normal loss.
    pub fn per_sample(&self) -> Ptr<f32> {
        self.all.ptr().offset(6 * self.n_rays)
    }

    /// `[n_rays, background samples + 1]` jitter of the background's edges.
    pub fn background(&self) -> Ptr<f32> {
        self.all.ptr().offset((6 + self.for_samples) * self.n_rays)
    }
}

/// A batch of rays.
pub struct Rays {
    pub n: u32,
    pub origins: Buffer<f32>,    // [3, n] region frame
    pub directions: Buffer<f32>, // [3, n] unit
    pub near_far: Buffer<f32>,   // [2, n]
    pub view: Buffer<u32>,       // [n] row of the appearance code
    pub outside: Buffer<u32>,    // [n] 1: the region is missed
    pub target: Buffer<f32>,     // [4, n] rgb, weight
    draw: Kernel<draw_rays::Args>,
    through: Kernel<view_rays::Args>,
    region_shape: u32,
    half_extents: [f32; 3],
    use_mask: u32,
    /// 1: a batch is of one view.
    one_view: u32,
}

impl Rays {
    /// Buffers for `n` rays in a region.
    pub fn new(gpu: &Gpu, config: &Config, region: &Region, n: u32) -> Result<Rays> {
        let region_shape = match region.shape {
            RegionShape::Sphere => 0,
            RegionShape::Box { .. } => 1,
        };
        let n64 = u64::from(n);
        Ok(Rays {
            n,
            origins: gpu.scratch("origins", 3 * n64)?,
            directions: gpu.scratch("directions", 3 * n64)?,
            near_far: gpu.scratch("near far", 2 * n64)?,
            view: gpu.scratch("ray view", n64)?,
            outside: gpu.scratch("ray outside", n64)?,
            target: gpu.scratch("target", 4 * n64)?,
            draw: gpu.kernel(draw_rays::Shape::default())?,
            through: gpu.kernel(view_rays::Shape::default())?,
            region_shape,
            half_extents: region.shape.half_extents().as_vec3().to_array(),
            use_mask: u32::from(config.scene.masks.reads()),
            // The scale and shift of a monocular depth are those of its picture.
            one_view: u32::from(config.loss.mono_depth > 0.0),
        })
    }

    /// Rays through pixels drawn uniformly over all training pictures, or over one of them drawn in proportion to its pixels.
    pub fn draw(&self, rec: &mut Recorder, views: &ViewTable, draws: &RayDraws) {
        let args = draw_rays::Args {
            views: views.table.ptr(),
            cumulative_share: views.cumulative_share.ptr(),
            pixel_draws: draws.pixels(),
            origins: self.origins.ptr_mut(),
            directions: self.directions.ptr_mut(),
            near_far: self.near_far.ptr_mut(),
            ray_view: self.view.ptr_mut(),
            ray_outside: self.outside.ptr_mut(),
            target: self.target.ptr_mut(),
            n_rays: self.n,
            n_views: views.n_training,
            use_mask: self.use_mask,
            region_shape: self.region_shape,
            half_extents: self.half_extents,
            one_view: self.one_view,
        };
        rec.run(
            &self.draw,
            Work::items(u64::from(self.n)).flops(200.0).bytes(80.0),
            args,
        );
    }

    /// Rays through the pixels `first..first + n` (row by row) of one view, coloured by the appearance code `appearance_row`.
    pub fn through(
        &self,
        rec: &mut Recorder,
        views: &ViewTable,
        view: u32,
        first: u32,
        appearance_row: u32,
    ) {
        let args = view_rays::Args {
            views: views.table.ptr(),
            origins: self.origins.ptr_mut(),
            directions: self.directions.ptr_mut(),
            near_far: self.near_far.ptr_mut(),
            ray_view: self.view.ptr_mut(),
            ray_outside: self.outside.ptr_mut(),
            n_rays: self.n,
            view,
            first,
            appearance_view: appearance_row,
            region_shape: self.region_shape,
            half_extents: self.half_extents,
        };
        rec.run(
            &self.through,
            Work::items(u64::from(self.n)).flops(200.0).bytes(80.0),
            args,
        );
    }
}
