//! A PLY file to look at before training: cameras as little pyramids, sparse points, the region's outline.
//!
//! Everything is there twice, as edges and as rows of points along them, since viewers that show points often ignore edges.

use std::io::{BufWriter, Write};
use std::path::Path;

use glam::{DVec2, DVec3};

use super::{Region, RegionShape, Scene, Split};
use crate::ply::{self, Element, Scalar};
use crate::{Error, Result, whole_file};

const TRAIN: [u8; 3] = [40, 110, 230];
const TEST: [u8; 3] = [220, 50, 50];
const UP: [u8; 3] = [60, 200, 90];
const OUTLINE: [u8; 3] = [250, 180, 20];
/// Points along each edge.
const DOTS: u32 = 12;

struct Drawing {
    vertices: Vec<(DVec3, [u8; 3])>,
    edges: Vec<[u32; 2]>,
}

impl Drawing {
    fn line(&mut self, from: DVec3, to: DVec3, color: [u8; 3]) {
        let first = self.vertices.len() as u32;
        for dot in 0..=DOTS {
            self.vertices
                .push((from.lerp(to, f64::from(dot) / f64::from(DOTS)), color));
        }
        self.edges
            .extend((first..first + DOTS).map(|dot| [dot, dot + 1]));
    }

    /// A closed curve through `count` points.
    fn loop_of(&mut self, count: u32, color: [u8; 3], at: impl Fn(f64) -> DVec3) {
        let first = self.vertices.len() as u32;
        for step in 0..count {
            let angle = std::f64::consts::TAU * f64::from(step) / f64::from(count);
            self.vertices.push((at(angle), color));
            self.edges.push([first + step, first + (step + 1) % count]);
        }
    }
}

/// Writes cameras (training blue, held out red, their upper edge green), points and the region (yellow) to a binary PLY file at
/// `path`, in world coordinates. An existing file is replaced, and only by a whole one.
pub fn write_preview(scene: &Scene, region: &Region, path: &Path) -> Result<()> {
    let mut drawing = Drawing {
        vertices: scene
            .points
            .iter()
            .map(|point| (point.position, point.color))
            .collect(),
        edges: Vec::new(),
    };
    let size = camera_size(scene, region);
    for view in &scene.views {
        let color = if view.split == Split::Train {
            TRAIN
        } else {
            TEST
        };
        let (w, h) = (f64::from(view.camera.width), f64::from(view.camera.height));
        let [a, b, c, d] = [(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)].map(|(x, y)| {
            let (origin, direction) = view.ray(DVec2::new(x, y));
            origin + direction * size
        });
        for corner in [a, b, c, d] {
            drawing.line(view.position(), corner, color);
        }
        drawing.line(a, b, UP);
        drawing.line(b, c, color);
        drawing.line(c, d, color);
        drawing.line(d, a, color);
    }
    outline(region, &mut drawing);
    write_ply(&drawing, path)
}

/// Long enough to be seen, short enough not to touch: a fifth of the median distance from a camera to its nearest neighbour.
fn camera_size(scene: &Scene, region: &Region) -> f64 {
    let positions: Vec<DVec3> = scene.views.iter().map(|view| view.position()).collect();
    let stride = (positions.len() / 200).max(1);
    let mut nearest: Vec<f64> = positions
        .iter()
        .enumerate()
        .step_by(stride)
        .map(|(view, position)| {
            let others = positions
                .iter()
                .enumerate()
                .filter(|(other, _)| *other != view);
            others
                .map(|(_, other)| other.distance(*position))
                .fold(f64::INFINITY, f64::min)
        })
        .collect();
    nearest.sort_by(f64::total_cmp);
    let typical = 0.4
        * nearest
            .get(nearest.len() / 2)
            .copied()
            .unwrap_or(f64::INFINITY);
    typical.clamp(0.02 * region.radius, 0.2 * region.radius)
}

fn outline(region: &Region, drawing: &mut Drawing) {
    let (center, radius) = (region.center, region.radius);
    match region.shape {
        RegionShape::Sphere => {
            for (a, b) in [
                (DVec3::X, DVec3::Y),
                (DVec3::Y, DVec3::Z),
                (DVec3::Z, DVec3::X),
            ] {
                drawing.loop_of(192, OUTLINE, |angle| {
                    center + (a * angle.cos() + b * angle.sin()) * radius
                });
            }
        }
        RegionShape::Box { half } => {
            let corner = |bits: usize| {
                let sign = |axis: usize| if bits >> axis & 1 == 1 { 1.0 } else { -1.0 };
                center + DVec3::new(sign(0), sign(1), sign(2)) * half * radius
            };
            for from in 0..8usize {
                for axis in (0..3).filter(|axis| from >> axis & 1 == 0) {
                    drawing.line(corner(from), corner(from | 1 << axis), OUTLINE);
                }
            }
        }
    }
}

fn write_ply(drawing: &Drawing, path: &Path) -> Result<()> {
    let elements = [
        Element::new("vertex", drawing.vertices.len())
            .with(Scalar::F64, &["x", "y", "z"])
            .with(Scalar::U8, &["red", "green", "blue"]),
        Element::new("edge", drawing.edges.len()).with(Scalar::I32, &["vertex1", "vertex2"]),
    ];
    let comment = "neurodin preview: cameras, points, region; world coordinates";
    whole_file::replace(path, |file| {
        let mut out = BufWriter::new(file);
        ply::write(&mut out, comment, &elements, |element, index, values| {
            if element == "edge" {
                values.extend(drawing.edges[index].map(f64::from));
                return;
            }
            let (position, color) = drawing.vertices[index];
            values.extend(position.to_array());
            values.extend(color.map(f64::from));
        })?;
        out.flush()
    })
    .map_err(|error| Error::unwritable(path, &error))
}
