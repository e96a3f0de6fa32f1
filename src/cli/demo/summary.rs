//! What a demonstration came to: as a report, as JSON, and in a few lines of text.

use std::path::Path;

use glam::{DVec3, dvec3};
use serde_json::{Map, Value, json};

use super::report::{Headline, KernelRow, Report, Threshold};
use super::{Outcome, Seen, report};
use crate::mesh::Mesh;
use crate::picture::chart::{Chart, Series, grouped, short};
use crate::picture::surface::{Eye, Lens, Visible, clay, colors, sun_eye};
use crate::picture::{Rgb, depth_picture, normal_picture};
use crate::scene::synthetic::{CENTER, RADIUS, look};
use crate::srgb;

/// Sides from which the mesh is shown: azimuth and elevation in degrees.
const SIDES: [[f64; 2]; 4] = [[24.0, 28.0], [114.0, 28.0], [204.0, 28.0], [294.0, 28.0]];

/// Pictures of the mesh and of the exact surface.
pub(super) struct Pictures {
    /// Of the mesh, as clay and in its colours, larger than the others.
    large: [Rgb; 2],
    /// From every side: the exact surface as clay, the mesh as clay, the mesh in its colours.
    sides: Vec<[Rgb; 3]>,
}

impl Pictures {
    pub(super) fn of(mesh: &Mesh) -> Pictures {
        let from_sun = sun_eye(CENTER, RADIUS);
        let (sun_on_mesh, sun_on_truth) = (
            Visible::of_mesh(mesh, &from_sun),
            Visible::of_exact_surface(&from_sun),
        );
        let of_mesh = |side: [f64; 2], width: usize| {
            let visible = Visible::of_mesh(mesh, &eye(side, width));
            [clay(&visible, &sun_on_mesh, RADIUS), colors(&visible)]
        };
        Pictures {
            large: of_mesh(SIDES[0], 720),
            sides: SIDES
                .into_iter()
                .map(|side| {
                    let truth = Visible::of_exact_surface(&eye(side, 480));
                    let [plain, painted] = of_mesh(side, 480);
                    [clay(&truth, &sun_on_truth, RADIUS), plain, painted]
                })
                .collect(),
        }
    }

    /// The pictures with names for their files.
    pub(super) fn named(&self) -> Vec<(String, &Rgb)> {
        let mut named = vec![
            ("mesh_clay.png".to_string(), &self.large[0]),
            ("mesh_colors.png".to_string(), &self.large[1]),
        ];
        for (index, [truth, plain, painted]) in self.sides.iter().enumerate() {
            named.push((format!("side_{index}_exact.png"), truth));
            named.push((format!("side_{index}_clay.png"), plain));
            named.push((format!("side_{index}_colors.png"), painted));
        }
        named
    }
}

/// Far enough away to see all of the scene, at 4:3.
fn eye([azimuth, elevation]: [f64; 2], width: usize) -> Eye {
    let target: DVec3 = CENTER - dvec3(0.0, 0.0, 0.17);
    Eye {
        world_from_eye: look(azimuth.to_radians(), elevation.to_radians(), 3.1, target),
        lens: Lens::Perspective(1.13 * width as f64),
        width,
        height: width * 3 / 4,
    }
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = values.len() as f64;
    values.sum::<f64>() / n
}

fn mean_psnr(outcome: &Outcome) -> f64 {
    mean(outcome.views.iter().map(|view| view.psnr))
}

fn mean_ssim(outcome: &Outcome) -> f64 {
    mean(outcome.views.iter().map(|view| view.ssim))
}

/// The scores and what they were reached with.
pub(super) fn as_json(outcome: &Outcome, seconds: f64) -> Value {
    json!({
        "device": outcome.device.name,
        "preset": outcome.config.preset,
        "steps": outcome.config.steps,
        "seed": outcome.config.seed,
        "seconds": seconds,
        "stages": outcome.stages.iter().map(|(name, seconds)| json!({ "stage": name, "seconds": seconds })).collect::<Vec<_>>(),
        "psnr": mean_psnr(outcome),
        "ssim": mean_ssim(outcome),
        "views": outcome.views.iter().map(|view| json!({ "name": view.name, "psnr": view.psnr, "ssim": view.ssim })).collect::<Vec<_>>(),
        "radius": RADIUS,
        "geometry": outcome.scores,
    })
}

/// The scores for people.
pub(super) fn as_text(outcome: &Outcome) -> String {
    let mut text = format!(
        "held-out views: PSNR {:.2} dB, SSIM {:.3}",
        mean_psnr(outcome),
        mean_ssim(outcome)
    );
    for row in thresholds(outcome) {
        text += &format!(
            "\nmesh within {} % of the radius: precision {:.3}, recall {:.3}, F-score {:.3}",
            short(100.0 * row.share),
            row.precision,
            row.recall,
            row.f_score
        );
    }
    text
}

fn thresholds(outcome: &Outcome) -> Vec<Threshold> {
    outcome
        .scores
        .thresholds
        .iter()
        .map(|score| Threshold {
            distance: score.threshold,
            share: score.threshold / RADIUS,
            precision: score.precision,
            recall: score.recall,
            f_score: score.f_score,
        })
        .collect()
}

/// The report's contents. `out` is where everything was written.
pub(super) fn report(outcome: &Outcome, pictures: Pictures, seconds: f64, out: &Path) -> Report {
    let config = &outcome.config;
    let thresholds = thresholds(outcome);
    let at_one_percent = thresholds
        .iter()
        .find(|row| (row.share - 0.01).abs() < 1e-9);
    let headline = |value: String, unit: &str, meaning: &str| Headline {
        value,
        unit: unit.into(),
        meaning: meaning.into(),
    };
    let [plain, painted] = pictures.large;
    let shown = |file: &str| out.join(file).display().to_string();
    Report {
        title: format!("From {} photographs to a mesh", outcome.dataset.train.len()),
        summary: "The built-in scene was photographed by a virtual camera, and its surface was learned from the photographs alone on \
                  this machine: NeuRodin's first stage in Vulkan compute kernels. Every number here was measured in this run."
            .into(),
        facts: vec![
            ("device".into(), outcome.device.name.clone()),
            ("driver".into(), outcome.device.driver.clone()),
            ("preset".into(), config.preset.clone()),
            ("steps".into(), grouped(config.steps as i64)),
            ("neurodin".into(), env!("CARGO_PKG_VERSION").into()),
        ],
        headlines: vec![
            headline(format!("{:.2}", mean_psnr(outcome)), "dB", "PSNR on held-out views"),
            headline(format!("{:.3}", mean_ssim(outcome)), "", "SSIM on held-out views"),
            headline(
                at_one_percent.map_or_else(|| "–".into(), |row| format!("{:.3}", row.f_score)),
                "",
                "F-score at 1 % of the scene's radius",
            ),
            headline(
                format!("{:.2}", 100.0 * outcome.scores.chamfer_trimmed / RADIUS),
                "%",
                "Chamfer distance (trimmed at 5 %), of the radius",
            ),
            headline(
                format!("{}:{:02}", seconds as u64 / 60, seconds as u64 % 60),
                "min",
                "from nothing to this page",
            ),
        ],
        heroes: vec![
            ("The reconstructed mesh, as clay.".into(), plain),
            ("The same mesh in the colours that it learned.".into(), painted),
        ],
        views: outcome.views.iter().map(view).collect(),
        mesh_columns: vec!["exact surface".into(), "reconstruction".into(), "its colours".into()],
        mesh_rows: pictures.sides.into_iter().map(Vec::from).collect(),
        charts: charts(&outcome.log),
        thresholds,
        scores: scores(outcome),
        stages: outcome.stages.clone(),
        kernels: kernels(outcome),
        kernel_note: format!(
            "Device timestamps over {} steps after warm-up; together they cover {:.1} % of these steps' time.",
            outcome.timed.steps,
            100.0 * outcome.timed.device_ms() / outcome.timed.wall_ms
        ),
        settings: config.to_toml(),
        files: vec![
            (shown("dataset"), "the photographs with their cameras, and the ground truth".into()),
            (shown("run"), "settings, log, previews and checkpoints of the training".into()),
            (shown("mesh.ply"), "the mesh in the coordinates of the cameras".into()),
            (shown("scores.json"), "the numbers of this page".into()),
            (shown("pictures"), "the pictures of the mesh".into()),
        ],
        commands: vec![
            format!("neurodin train {} --out longer --preset {} --steps 10000", shown("dataset"), config.preset),
            "neurodin mesh longer -o longer.ply --resolution 512".into(),
            format!("neurodin eval --mesh longer.ply --reference {}", outcome.dataset.reference.display()),
        ],
    }
}

fn view(seen: &Seen) -> report::View {
    let (width, height) = (seen.rendered.width as usize, seen.rendered.height as usize);
    let opaque = |at: usize| seen.rendered.accumulation[at] > 0.5;
    let mut depth = seen.rendered.depth.clone();
    for (at, depth) in depth.iter_mut().enumerate() {
        if !opaque(at) {
            *depth = f32::INFINITY;
        }
    }
    let mut sorted: Vec<f32> = depth
        .iter()
        .copied()
        .filter(|depth| depth.is_finite())
        .collect();
    sorted.sort_by(f32::total_cmp);
    // The range that all but a few stray pixels lie in.
    let at = |share: f64| {
        sorted
            .get((share * (sorted.len().max(1) - 1) as f64) as usize)
            .copied()
    };
    let (near, far) = (at(0.005).unwrap_or(0.0), at(0.995).unwrap_or(1.0));
    for depth in depth.iter_mut().filter(|depth| depth.is_finite()) {
        *depth = depth.min(far);
    }
    let normal: Vec<[f32; 3]> = seen
        .rendered
        .normal
        .iter()
        .enumerate()
        .map(|(at, n)| {
            if opaque(at) {
                glam::Vec3::from(*n).normalize_or_zero().to_array()
            } else {
                [0.0; 3]
            }
        })
        .collect();
    report::View {
        name: seen.name.clone(),
        psnr: seen.psnr,
        ssim: seen.ssim,
        photo: Rgb {
            width: seen.picture.width as usize,
            height: seen.picture.height as usize,
            bytes: seen
                .picture
                .rgba
                .chunks(4)
                .flat_map(|pixel| [pixel[0], pixel[1], pixel[2]])
                .collect(),
        },
        render: Rgb {
            width,
            height,
            bytes: seen
                .rendered
                .rgb
                .iter()
                .flatten()
                .map(|c| srgb::byte(*c))
                .collect(),
        },
        depth: depth_picture(width, height, &depth, near, far.max(near + 1e-6)),
        normal: normal_picture(width, height, &normal),
    }
}

/// Losses and PSNR over the steps, from the training's log: one JSON object a line.
fn charts(log: &str) -> Vec<Chart> {
    let records: Vec<Value> = log
        .lines()
        .filter_map(|line| serde_json::from_str(line).ok())
        .collect();
    let mut losses: Vec<&String> = Vec::new();
    for key in records
        .iter()
        .filter_map(Value::as_object)
        .flat_map(Map::keys)
    {
        if key.starts_with("loss.") && !losses.contains(&key) {
            losses.push(key);
        }
    }
    let series = |name: &str, event: &str, key: &str| Series {
        name: name.into(),
        points: records
            .iter()
            .filter(|record| record["event"] == event)
            .filter_map(|record| Some((record["step"].as_f64()?, record[key].as_f64()?)))
            .collect(),
    };
    let chart = |title: &str, y_label: &str, logarithmic: bool, series: Vec<Series>| Chart {
        title: title.into(),
        x_label: "step".into(),
        y_label: y_label.into(),
        logarithmic,
        series,
    };
    vec![
        chart(
            "Losses, weighted",
            "loss",
            true,
            losses
                .iter()
                .map(|key| {
                    let name = key.trim_start_matches("loss.").replace('_', " ");
                    series(&name, "step", key)
                })
                .collect(),
        ),
        chart(
            "Peak signal-to-noise ratio",
            "PSNR, dB",
            false,
            vec![
                series("training rays", "step", "psnr"),
                series("a held-out view", "preview", "psnr"),
            ],
        ),
    ]
}

fn scores(outcome: &Outcome) -> Vec<(String, String, String)> {
    let scores = &outcome.scores;
    let distance = |value: Option<f64>| {
        value.map_or_else(
            || ("–".into(), String::new()),
            |value| {
                (
                    format!("{value:.4}"),
                    format!(" ({} % of the radius)", short(100.0 * value / RADIUS)),
                )
            },
        )
    };
    let row = |name: &str, value: Option<f64>, meaning: &str| {
        let (value, share) = distance(value);
        (name.into(), value, format!("{meaning}{share}"))
    };
    vec![
        row(
            "accuracy",
            scores.accuracy.mean,
            "mean distance from the mesh to the exact surface",
        ),
        row(
            "completeness",
            scores.completeness.mean,
            "mean distance from the exact surface to the mesh",
        ),
        row("Chamfer distance", scores.chamfer, "mean of both"),
        row(
            "Chamfer distance, trimmed",
            Some(scores.chamfer_trimmed),
            "with every distance cut off at 5 % of the radius",
        ),
        (
            "vertices".into(),
            grouped(scores.vertices as i64),
            "of the mesh".into(),
        ),
        (
            "faces".into(),
            grouped(scores.faces as i64),
            format!(
                "of which {} are seen by a training camera and scored",
                grouped(scores.faces_scored as i64)
            ),
        ),
    ]
}

fn kernels(outcome: &Outcome) -> Vec<KernelRow> {
    let total = outcome.timed.device_ms();
    // 10⁹ units a second, where the kernel says how much it does.
    let rate = |units: f64, ms: f64| (units > 0.0 && ms > 0.0).then(|| units / ms * 1e-6);
    outcome
        .timed
        .profile
        .rows
        .iter()
        .map(|row| KernelRow {
            name: row.name.clone(),
            launches: row.launches,
            total: row.total_ms,
            share: row.total_ms / total,
            min: row.min_ms,
            median: row.median_ms,
            max: row.max_ms,
            gflops: rate(row.flops, row.total_ms),
            gbytes: rate(row.bytes, row.total_ms),
        })
        .collect()
}
