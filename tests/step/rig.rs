//! A trainer on the device beside the twin of its configuration, and the way of numbers between the two.

use crate::half_copy::cut;
use crate::reference::background::{Background, FieldConfig};
use crate::reference::batch::{Density, Draws, Rays, Scale, Stage, Step, StepConfig, Tangent};
use crate::reference::hash_grid::{Grid, Level};
use crate::reference::losses;
use crate::reference::sampling::{self, Stretch};
use crate::reference::supervision::{Known, Supervision};
use crate::reference::tape::ReluEdge;
use crate::reference::trial::Random;
use neurodin::Result;
use neurodin::config::{
    BackgroundKind, BiasReduction, Config, DensityKind, GradientKind, ScaleKind,
};
use neurodin::gpu::{Buffer, Gpu, GpuOptions};
use neurodin::model::HashGrid;
use neurodin::scene::synthetic::{CENTER, RADIUS, SyntheticOptions};
use neurodin::scene::{PriorPaths, Region, RegionShape, Scene, SceneOptions, Split};
use neurodin::train::Trainer;
use npyz::WriterBuilder;
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::Path;

pub struct Rig {
    pub gpu: Gpu,
    pub config: Config,
    pub trainer: Trainer,
    pub twin: StepConfig,
    /// Axes of the training views' cameras, by view.
    axes: Vec<[[f64; 3]; 3]>,
    _folder: tempfile::TempDir,
}

impl Rig {
    /// A trainer on a few small pictures of the built-in scene, under the validation layer, with guard words and poisoned scratch.
    /// `options` say by which kernels.
    pub fn new(config: Config, shape: RegionShape, options: GpuOptions) -> Result<Rig> {
        let supervised = config.loss.is_supervised();
        Rig::with(config, shape, options, &mut |scene, folder| {
            if supervised {
                add_knowledge(scene, folder);
            }
        })
    }

    /// The same on a scene that `prepare` changes, with files in a folder that lasts as long as this.
    pub fn with(
        config: Config,
        shape: RegionShape,
        options: GpuOptions,
        prepare: &mut dyn FnMut(&mut Scene, &Path),
    ) -> Result<Rig> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let root = folder.path().join("scene");
        let pictures = SyntheticOptions {
            train_views: 3,
            test_views: 1,
            width: 32,
            height: 24,
            reference_spacing: 0.5,
        };
        pictures.write(&root, &mut |_, _, _| {})?;
        let mut scene = Scene::open(&root, &SceneOptions::default())?;
        prepare(&mut scene, folder.path());
        let region = Region {
            center: CENTER,
            radius: RADIUS,
            shape,
            how: "given".into(),
        };
        let config = config.validated()?;
        let gpu = Gpu::new(&GpuOptions {
            guard: true,
            validation: true,
            matrices: config.matrices,
            ..options
        })?;
        let trainer = Trainer::new(&gpu, &scene, &region, &config)?;
        let twin = twin_config(&config, &shape, trainer.model().n_views + 1);
        let axes = scene.split(Split::Train).map(|view| {
            let pose = scene.views[view].world_from_camera;
            [pose.x_axis, pose.y_axis, pose.z_axis].map(|axis| axis.truncate().to_array())
        });
        Ok(Rig {
            gpu,
            config,
            trainer,
            twin,
            axes: axes.collect(),
            _folder: folder,
        })
    }

    /// Nothing was written behind the end of a buffer, and the validation layer has nothing to say.
    pub fn check_device(&self) -> Result<()> {
        self.gpu.finish()?;
        let overruns = self.gpu.check_guards()?;
        assert!(overruns.is_empty(), "written past the end: {overruns:?}");
        let messages = self.gpu.validation_messages();
        assert!(messages.is_empty(), "{}", messages.join("\n"));
        Ok(())
    }

    pub fn n_rays(&self) -> usize {
        self.config.rays as usize
    }

    pub fn download(&self, buffer: &Buffer<f32>) -> Result<Vec<f64>> {
        let values = self.gpu.download(buffer, 0, buffer.len())?;
        Ok(values.into_iter().map(f64::from).collect())
    }

    pub fn upload(
        &self,
        buffer: &Buffer<f32>,
        values: impl IntoIterator<Item = f64>,
    ) -> Result<()> {
        let values: Vec<f32> = values.into_iter().map(|x| x as f32).collect();
        self.gpu.upload(buffer, 0, &values)
    }

    /// Rounds the twin's parameters to float32 and puts them on the device.
    pub fn upload_parameters(&self, params: &mut BTreeMap<String, Vec<f64>>) -> Result<()> {
        // What entries are behind with belongs to what stood there.
        self.trainer.catch_up()?;
        let block = &self.trainer.model().params;
        let spans = || block.spans().iter().filter(|span| !span.is_empty());
        for span in spans() {
            let values = params
                .get_mut(&span.name)
                .unwrap_or_else(|| panic!("the twin has no span {}", span.name));
            if span.name == "surface.table" && self.config.hash.half {
                values.iter_mut().for_each(|x| *x = cut(*x));
            }
            let mut rounded: Vec<f32> = values.iter().map(|&x| x as f32).collect();
            *values = rounded.iter().map(|&x| f64::from(x)).collect();
            if let Some(order) = self.column_order(&span.name) {
                let rows = rounded.chunks_exact(order.len());
                rounded = rows.flat_map(|row| order.iter().map(|&c| row[c])).collect();
            }
            assert_eq!(rounded.len() as u64, span.len(), "{}", span.name);
            self.gpu.upload(block.values(), span.first, &rounded)?;
        }
        assert_eq!(params.len(), spans().count(), "spans of both sides");
        block.refresh_copy(&self.gpu)?;
        Ok(())
    }

    /// A buffer shaped like the parameter block, by the twin's spans.
    pub fn download_spans(&self, block: &Buffer<f32>) -> Result<BTreeMap<String, Vec<f64>>> {
        self.trainer.catch_up()?;
        let mut spans = BTreeMap::new();
        let block_spans = self.trainer.model().params.spans();
        for span in block_spans.iter().filter(|span| !span.is_empty()) {
            let values = self.gpu.download(block, span.first, span.len())?;
            let mut values: Vec<f64> = values.into_iter().map(f64::from).collect();
            if let Some(order) = self.column_order(&span.name) {
                let mut back = vec![0.0; values.len()];
                for (row, theirs) in back
                    .chunks_exact_mut(order.len())
                    .zip(values.chunks_exact(order.len()))
                {
                    order.iter().zip(theirs).for_each(|(&c, &x)| row[c] = x);
                }
                values = back;
            }
            spans.insert(span.name.clone(), values);
        }
        Ok(spans)
    }

    /// The twin's columns in the device's order, where they differ: the first colour layers' inputs, which the device sorts so that
    /// those that receive gradients come first (glsl/lib/shading.glsl, glsl/lib/background.glsl).
    fn column_order(&self, span: &str) -> Option<Vec<usize>> {
        let twin = &self.twin;
        // Widths of the twin's parts, in its order, and the device's order of the parts.
        let (widths, order) = match (span, &twin.background) {
            ("color.0.v", _) => (
                vec![3, 27, 3, twin.features, twin.appearance],
                vec![3, 2, 4, 0, 1],
            ),
            ("background.color.0", Background::Field(field)) => {
                (vec![16, field.geometry, field.appearance], vec![1, 2, 0])
            }
            _ => return None,
        };
        let columns = |part: usize| {
            let first: usize = widths[..part].iter().sum();
            first..first + widths[part]
        };
        Some(order.into_iter().flat_map(columns).collect())
    }

    /// The rays that lie in the device's buffers.
    pub fn rays(&self) -> Result<Rays> {
        let rays = &self.trainer.renderer().rays;
        let near_far = self.download(&rays.near_far)?;
        let outside = self.gpu.download(&rays.outside, 0, rays.outside.len())?;
        let view = self.gpu.download(&rays.view, 0, rays.view.len())?;
        let n = self.n_rays();
        let stretch = |ray: usize| Stretch {
            near: near_far[ray],
            far: near_far[n + ray],
            outside: outside[ray] != 0,
        };
        Ok(Rays {
            origins: interleaved(&self.download(&rays.origins)?),
            directions: interleaved(&self.download(&rays.directions)?),
            target: interleaved(&self.download(&rays.target)?),
            view: view.iter().map(|&view| view as usize).collect(),
            supervision: self.supervision(&view)?,
            stretches: Some((0..n).map(stretch).collect()),
        })
    }

    /// What is wanted of rays of these views besides colour, and the priors that lie in the device's buffers.
    fn supervision(&self, view: &[u32]) -> Result<Supervision> {
        let loss = &self.config.loss;
        let supervision = self.trainer.loss().supervision.as_ref();
        let drawn = match supervision.and_then(|supervision| supervision.priors.as_ref()) {
            Some(priors) => interleaved::<6>(&self.download(&priors.drawn)?),
            None => Vec::new(),
        };
        let known = |(drawn, &view): (&[f64; 6], &u32)| Known {
            cosine: drawn[0],
            mono_depth: drawn[1],
            mono_normal: [drawn[2], drawn[3], drawn[4]],
            sensor_depth: drawn[5],
            axes: self.axes[view as usize],
        };
        Ok(Supervision {
            mask: loss.mask,
            sensor_depth: loss.sensor_depth,
            mono_depth: loss.mono_depth,
            mono_normal: loss.mono_normal,
            known: drawn.iter().zip(view).map(known).collect(),
        })
    }

    /// Puts rays into the device's buffers, and gives back what float32 made of them.
    pub fn upload_rays(&self, rays: &Rays) -> Result<Rays> {
        let on_device = &self.trainer.renderer().rays;
        let collide = |ray: usize| {
            sampling::collide(self.twin.region, rays.origins[ray], rays.directions[ray])
        };
        let stretches: Vec<Stretch> = (0..self.n_rays()).map(collide).collect();
        self.upload(&on_device.origins, planar(&rays.origins))?;
        self.upload(&on_device.directions, planar(&rays.directions))?;
        self.upload(&on_device.target, planar(&rays.target))?;
        let near_far: Vec<[f64; 2]> = stretches.iter().map(|s| [s.near, s.far]).collect();
        self.upload(&on_device.near_far, planar(&near_far))?;
        let outside: Vec<u32> = stretches.iter().map(|s| u32::from(s.outside)).collect();
        self.gpu.upload(&on_device.outside, 0, &outside)?;
        let view: Vec<u32> = rays.view.iter().map(|&view| view as u32).collect();
        self.gpu.upload(&on_device.view, 0, &view)?;
        self.rays()
    }

    /// The random numbers that lie in the device's buffer: pixels [3, n], jitter [3, n], taps [n, S] or the tangent loss's directions
    /// [2, n, S], background [n, edges].
    pub fn draws(&self) -> Result<(Draws, Stage)> {
        let all = self.download(&self.trainer.renderer().draws.all)?;
        let (n, samples) = (self.n_rays(), self.n_rays() * self.twin.samples);
        let (jitter, rest) = all[3 * n..].split_at(3 * n);
        let jitter = |level: usize| jitter[level * n..(level + 1) * n].to_vec();
        let surface = &self.config.surface;
        let (taps, blocks) = match surface.gradient {
            GradientKind::Taps => (surface.taps as usize, 1),
            GradientKind::Analytic => (0, 2),
        };
        let (of_samples, background) = rest.split_at(blocks * samples);
        let stage = Stage {
            taps,
            density: match surface.density {
                DensityKind::Laplace => Density::Laplace,
                DensityKind::Sight => Density::Sight,
                DensityKind::Neus => Density::Neus,
            },
            bias: self.config.loss.bias.weight > 0.0,
            tangent: (self.config.loss.tangent > 0.0).then(|| Tangent {
                weight: self.config.loss.tangent,
                step: 0.01,
                draws: (0..samples)
                    .map(|i| direction(of_samples[i], of_samples[samples + i]))
                    .collect(),
            }),
        };
        let draws = Draws {
            jitter: [jitter(0), jitter(1), jitter(2)],
            taps: of_samples[..samples].to_vec(),
            background: background.to_vec(),
        };
        Ok((draws, stage))
    }

    pub fn upload_draws(&self, draws: &Draws, stage: &Stage) -> Result<(Draws, Stage)> {
        let pixels = vec![0.5; 3 * self.n_rays()];
        let [first, second, third] = &draws.jitter;
        let of_samples = match &stage.tangent {
            None => draws.taps.clone(),
            Some(tangent) => planar(&tangent.draws.iter().map(uniforms).collect::<Vec<_>>()),
        };
        let all = [
            &pixels,
            first,
            second,
            third,
            &of_samples,
            &draws.background,
        ];
        self.upload(
            &self.trainer.renderer().draws.all,
            all.into_iter().flatten().copied(),
        )?;
        self.draws()
    }

    /// The surface's points: samples and taps, or samples and the tangent loss's points.
    pub fn points(&self) -> Result<Vec<[f64; 3]>> {
        let points = &self.trainer.renderer().surface.points;
        let mut points = interleaved(&self.download(points)?);
        if let Some(tangent) = &self.trainer.loss().tangent {
            points.extend(interleaved::<3>(&self.download(&tangent.points)?));
        }
        Ok(points)
    }

    /// Normalised edges of all three levels.
    pub fn edges(&self) -> Result<[Vec<f64>; 3]> {
        let of = |level: usize| self.download(self.trainer.renderer().sampler.edges_of(level));
        Ok([of(0)?, of(1)?, of(2)?])
    }
}

pub fn write_npy(file: &Path, shape: &[u64], values: &[f64]) {
    let out = std::fs::File::create(file).expect("a file");
    let options = npyz::WriteOptions::new().default_dtype().shape(shape);
    let mut writer = options.writer(out).begin_nd().expect("an array");
    writer.extend(values).expect("its values");
    writer.finish().expect("its end");
}

/// Gives every view an object mask and priors: numbers without a meaning, of other sizes than the picture, some of them unknown.
fn add_knowledge(scene: &mut Scene, folder: &Path) {
    let random = &mut Random(77);
    let write = |name: &str, shape: &[u64], values: &[f64]| {
        let file = folder.join(name);
        write_npy(&file, shape, values);
        Some(file)
    };
    for (index, view) in scene.views.iter_mut().enumerate() {
        let (w, h) = (view.camera.width, view.camera.height);
        let mask = image::GrayImage::from_fn(w, h, |x, y| {
            let left_out = (x / 4 + y / 3 + index as u32).is_multiple_of(4);
            image::Luma([if left_out { 0 } else { 255 }])
        });
        let file = folder.join(format!("{index}_mask.png"));
        mask.save(&file).expect("a picture");
        view.mask_path = Some(file);
        let (w, h) = (u64::from(w), u64::from(h));
        let mut some = |count: u64, unknown: f64| -> Vec<f64> {
            let value = |random: &mut Random| match random.uniform() {
                u if u < 0.1 => unknown,
                _ => random.uniform(),
            };
            (0..count).map(|_| value(random)).collect()
        };
        view.priors = PriorPaths([
            write(
                &format!("{index}_depth.npy"),
                &[2 * h, 2 * w],
                &some(4 * w * h, f64::NAN),
            ),
            write(
                &format!("{index}_normal.npy"),
                &[3, h, w],
                &some(3 * w * h, f64::NAN),
            ),
            write(
                &format!("{index}_sensor.npy"),
                &[1, h / 2, w / 2],
                &some(w * h / 4, 0.0),
            ),
        ]);
    }
}

/// The unit vector that the device makes of two uniforms (glsl/lib/tangent.glsl).
fn direction(z: f64, turn: f64) -> [f64; 3] {
    let z = 2.0 * z - 1.0;
    let radius = (1.0 - z * z).max(0.0).sqrt();
    let (sine, cosine) = (TAU * turn).sin_cos();
    [radius * cosine, radius * sine, z]
}

/// The uniforms that make a vector's direction.
fn uniforms(v: &[f64; 3]) -> [f64; 2] {
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    [
        0.5 * (v[2] / length + 1.0),
        v[1].atan2(v[0]).rem_euclid(TAU) / TAU,
    ]
}

/// The twin's configuration for one of the crate's.
fn twin_config(config: &Config, shape: &RegionShape, views: u32) -> StepConfig {
    let (surface, sampling, bias) = (&config.surface, &config.sampling, &config.loss.bias);
    let proposal_grid = |level: usize| {
        grid(HashGrid {
            levels: sampling.proposal_levels,
            base: sampling.proposal_base,
            max: sampling.proposal_max[level],
            log2_size: sampling.proposal_log2_size,
            features: sampling.proposal_features,
        })
    };
    let background = &config.background;
    StepConfig {
        region: match shape {
            RegionShape::Sphere => sampling::Region::Sphere,
            RegionShape::Box { half } => sampling::Region::Box {
                half: half.to_array(),
            },
        },
        train: true,
        proposal_grids: [proposal_grid(0), proposal_grid(1)],
        proposal_hidden: sampling.proposal_hidden as usize,
        proposal_samples: sampling.proposal_samples.map(|samples| samples as usize),
        samples: sampling.samples as usize,
        grid: grid(HashGrid {
            levels: config.hash.levels,
            base: config.hash.base,
            max: config.hash.max,
            log2_size: config.hash.log2_size,
            features: config.hash.features,
        }),
        hidden: surface.hidden as usize,
        features: surface.features as usize,
        scale: match surface.scale {
            ScaleKind::Local => Scale::Local,
            ScaleKind::Beta => Scale::Beta,
            ScaleKind::Exponential => Scale::Exponential {
                rate: surface.scale_rate,
            },
        },
        scale_range: surface.scale_max,
        scale_floor: surface.scale_floor,
        tap_range: surface.tap_range,
        tap_floor: 1.0 / (4.0 * f64::from(config.hash.max)),
        color_hidden: config.color.hidden as usize,
        color_layers: config.color.layers as usize,
        views: views as usize,
        appearance: config.appearance.dims as usize,
        background: match background.kind {
            BackgroundKind::None => Background::Black,
            BackgroundKind::Constant => Background::Learned,
            BackgroundKind::Field => Background::Field(FieldConfig {
                grid: grid(HashGrid {
                    levels: background.levels,
                    base: background.base,
                    max: background.max,
                    log2_size: background.log2_size,
                    features: background.features,
                }),
                samples: background.samples as usize,
                far: background.far,
                hidden: background.hidden as usize,
                geometry: background.geometry as usize,
                appearance: config.appearance.dims as usize,
                contraction: background.contraction,
            }),
        },
        color_squared: config.loss.color_squared,
        eikonal_weight: config.loss.eikonal,
        interlevel_weight: config.loss.interlevel,
        bias_epsilon: bias.epsilon,
        bias_offset: bias.offset,
        bias_reduction: match bias.reduction {
            BiasReduction::PerRay => losses::BiasReduction::PerRay,
            BiasReduction::Published => losses::BiasReduction::Published,
        },
        bias_needs_opaque: !surface.inside_out,
    }
}

/// A grid with the device's own level table.
fn grid(shape: HashGrid) -> Grid {
    let level = |level: &neurodin::kernels::Level| Level {
        scale: f64::from(level.scale),
        resolution: level.resolution,
        entries: level.entries,
        offset: level.offset as usize,
        dense: level.hashed == 0,
        float32_cells: true,
    };
    Grid {
        levels: shape.level_table().iter().map(level).collect(),
        features: shape.features as usize,
    }
}

/// `[n, C]` from the planes `[C, n]`.
pub fn interleaved<const C: usize>(planes: &[f64]) -> Vec<[f64; C]> {
    let n = planes.len() / C;
    (0..n)
        .map(|i| std::array::from_fn(|c| planes[c * n + i]))
        .collect()
}

/// The planes `[C, n]` of `[n, C]`.
pub fn planar<const C: usize>(vectors: &[[f64; C]]) -> Vec<f64> {
    (0..C)
        .flat_map(|c| vectors.iter().map(move |v| v[c]))
        .collect()
}

/// The twin's gradients with the slope of every ReLU near its edge taken as 0, and as 1.
pub struct GradientRange([BTreeMap<String, Vec<f64>>; 2]);

impl GradientRange {
    pub fn of(step: &Step) -> GradientRange {
        let with = |slope: f64| {
            let relu_edge = ReluEdge {
                margin: 1e-6,
                slope,
            };
            Step {
                relu_edge,
                ..step.clone()
            }
            .run()
            .gradients
        };
        GradientRange([with(0.0), with(1.0)])
    }

    /// Relative L2 distance of at most `tolerance` and a cosine of at least 0.99999 to the nearest gradient in range.
    #[track_caller]
    pub fn check(&self, span: &str, device: &[f64], tolerance: f64) {
        let [a, b] = [&self.0[0][span], &self.0[1][span]];
        assert_eq!(device.len(), a.len(), "{span}");
        let range = a.iter().zip(b).zip(device);
        let nearest: Vec<f64> = range
            .map(|((a, b), x)| x.clamp(a.min(*b), a.max(*b)))
            .collect();
        let (distance, cosine) = agreement(device, &nearest);
        println!(
            "{span}: relative L2 {distance:.1e}, 1 - cosine {:.1e}",
            1.0 - cosine
        );
        assert!(
            distance <= tolerance && cosine >= 0.99999,
            "{span}: relative L2 {distance:.2e}, cosine {cosine}"
        );
    }
}

/// ‖ours − theirs‖/‖theirs‖ and the cosine between the two.
pub fn agreement(ours: &[f64], theirs: &[f64]) -> (f64, f64) {
    assert_eq!(ours.len(), theirs.len());
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let error: f64 = ours.iter().zip(theirs).map(|(a, b)| (a - b).powi(2)).sum();
    let (ours_length, length) = (dot(ours, ours).sqrt(), dot(theirs, theirs).sqrt());
    (
        error.sqrt() / length,
        dot(ours, theirs) / (ours_length * length),
    )
}
