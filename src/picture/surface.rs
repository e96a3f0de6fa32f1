//! Pictures of a surface on the CPU: a z-buffer for meshes, rays for the exact surface, and one light for both.
//!
//! Either way first fills a [`Visible`]: per pixel depth, normal and colour of what is seen. From it [`clay`] shades grey clay under a
//! sun with a shadow map (Williams 1978) and a sky dimmed by ambient occlusion in screen space (Mittring 2007), and [`colors`] shows
//! the colours as they are. Pictures are computed with [`OVERSAMPLING`]² samples per pixel. Frames as everywhere: z up, an eye looks
//! along its -z.

use glam::{DMat4, DVec2, DVec3, Vec3, dvec2, dvec3, vec3};
use rayon::prelude::*;

use super::Rgb;
use crate::mesh::Mesh;
use crate::scene::synthetic::{self, SUN};
use crate::srgb;

/// Samples per pixel and axis.
pub const OVERSAMPLING: usize = 2;
const PAPER: Vec3 = Vec3::new(0.90, 0.905, 0.91);
const CLAY: Vec3 = Vec3::new(0.54, 0.505, 0.46);
/// The inner side of the surface, where a mesh is open.
const INNER_SIDE: Vec3 = Vec3::new(0.45, 0.16, 0.11);

/// From where, and onto how many pixels.
#[derive(Clone, Copy, Debug)]
pub struct Eye {
    /// Rigid; the eye looks along its -z, y up.
    pub world_from_eye: DMat4,
    pub lens: Lens,
    pub width: usize,
    pub height: usize,
}

#[derive(Clone, Copy, Debug)]
pub enum Lens {
    /// Perspective with this focal length in pixels.
    Perspective(f64),
    /// Parallel rays, this many pixels to the world's unit.
    Parallel(f64),
}

/// What an eye sees: per sample, row-major.
pub struct Visible {
    eye: Eye,
    /// Distance along the viewing axis, infinite where there is nothing.
    depth: Vec<f32>,
    /// Unit, towards the eye's side.
    normal: Vec<Vec3>,
    /// Linear.
    color: Vec<Vec3>,
    /// Whether the inner side is seen.
    inner: Vec<bool>,
}

impl Eye {
    /// The same view on `OVERSAMPLING` times as many pixels each way.
    fn finer(&self) -> Eye {
        let factor = OVERSAMPLING as f64;
        Eye {
            lens: match self.lens {
                Lens::Perspective(focal) => Lens::Perspective(factor * focal),
                Lens::Parallel(scale) => Lens::Parallel(factor * scale),
            },
            width: OVERSAMPLING * self.width,
            height: OVERSAMPLING * self.height,
            ..*self
        }
    }

    fn middle(&self) -> DVec2 {
        0.5 * dvec2(self.width as f64, self.height as f64)
    }

    /// Pixel coordinates and distance along the axis of a point in the eye's frame; `None` where it is behind a perspective eye.
    fn project(&self, p: DVec3) -> Option<(DVec2, f64)> {
        let depth = -p.z;
        let scale = match self.lens {
            Lens::Perspective(_) if depth < 1e-3 => return None,
            Lens::Perspective(focal) => focal / depth,
            Lens::Parallel(scale) => scale,
        };
        Some((self.middle() + scale * dvec2(p.x, -p.y), depth))
    }

    /// The point in the eye's frame that is seen at a pixel at a depth.
    fn unproject(&self, pixel: DVec2, depth: f64) -> DVec3 {
        let offset = pixel - self.middle();
        let scale = match self.lens {
            Lens::Perspective(focal) => depth / focal,
            Lens::Parallel(scale) => 1.0 / scale,
        };
        dvec3(offset.x * scale, -offset.y * scale, -depth)
    }
}

impl Visible {
    fn nothing(eye: &Eye) -> Visible {
        let n = eye.width * eye.height;
        Visible {
            eye: *eye,
            depth: vec![f32::INFINITY; n],
            normal: vec![Vec3::ZERO; n],
            color: vec![Vec3::ZERO; n],
            inner: vec![false; n],
        }
    }

    /// What `eye` sees of a mesh in the world frame. Without normals they are the mean of the faces'; without colours all is clay.
    pub fn of_mesh(mesh: &Mesh, eye: &Eye) -> Visible {
        let eye = eye.finer();
        let eye_from_world = eye.world_from_eye.inverse();
        let corners: Vec<Option<(DVec2, f64)>> = mesh
            .positions
            .par_iter()
            .map(|p| eye.project(eye_from_world.transform_point3(*p)))
            .collect();
        let own_normals;
        let normals = if mesh.normals.is_empty() {
            own_normals = mesh.face_weighted_normals();
            &own_normals
        } else {
            &mesh.normals
        };
        let mut visible = Visible::nothing(&eye);
        let rows_per_band = eye
            .height
            .div_ceil(4 * rayon::current_num_threads())
            .max(16);
        let band = eye.width * rows_per_band;
        let Visible {
            depth,
            normal,
            color,
            inner,
            ..
        } = &mut visible;
        depth
            .par_chunks_mut(band)
            .zip(normal.par_chunks_mut(band))
            .zip(color.par_chunks_mut(band))
            .zip(inner.par_chunks_mut(band))
            .enumerate()
            .for_each(|(index, (((depth, normal), color), inner))| {
                let first_row = index * rows_per_band;
                let rows = first_row..first_row + depth.len() / eye.width;
                for face in &mesh.faces {
                    let [Some(a), Some(b), Some(c)] = face.map(|v| corners[v as usize]) else {
                        continue;
                    };
                    scan(&eye, [a, b, c], rows.clone(), |at, weights, z| {
                        if z >= depth[at] {
                            return;
                        }
                        depth[at] = z;
                        let mix = |of: &dyn Fn(usize) -> Vec3| {
                            (0..3)
                                .map(|k| weights[k] * of(face[k] as usize))
                                .sum::<Vec3>()
                        };
                        normal[at] = mix(&|v| Vec3::from(normals[v])).normalize_or(Vec3::Z);
                        color[at] = if mesh.colors.is_empty() {
                            CLAY
                        } else {
                            mix(&|v| {
                                Vec3::from(mesh.colors[v].map(|byte| srgb::decode(byte) as f32))
                            })
                        };
                        // Counter-clockwise in space, y up, is clockwise on a screen whose y points down.
                        inner[at] = (b.0 - a.0).perp_dot(c.0 - a.0) > 0.0;
                    });
                }
            });
        for (normal, inner) in visible.normal.iter_mut().zip(&visible.inner) {
            if *inner {
                *normal = -*normal;
            }
        }
        visible
    }

    /// What `eye` sees of the built-in scene's exact surface.
    pub fn of_exact_surface(eye: &Eye) -> Visible {
        let eye = eye.finer();
        let mut visible = Visible::nothing(&eye);
        let Visible {
            depth,
            normal,
            color,
            ..
        } = &mut visible;
        depth
            .par_chunks_mut(eye.width)
            .zip(normal.par_chunks_mut(eye.width))
            .zip(color.par_chunks_mut(eye.width))
            .enumerate()
            .for_each(|(y, ((depth, normal), color))| {
                for x in 0..eye.width {
                    let pixel = dvec2(x as f64 + 0.5, y as f64 + 0.5);
                    let (near, far) = (eye.unproject(pixel, 0.0), eye.unproject(pixel, 1.0));
                    let origin = eye.world_from_eye.transform_point3(near);
                    let ray = eye.world_from_eye.transform_vector3(far - near);
                    let per_depth = ray.length();
                    if let Some(hit) = synthetic::trace(origin, ray / per_depth, 20.0) {
                        depth[x] = (hit.distance / per_depth) as f32;
                        normal[x] = hit.normal.as_vec3();
                        color[x] = synthetic::radiance(&hit).as_vec3();
                    }
                }
            });
        visible
    }

    /// World position of the sample `at`.
    fn position(&self, at: usize) -> DVec3 {
        let pixel = dvec2(
            (at % self.eye.width) as f64 + 0.5,
            (at / self.eye.width) as f64 + 0.5,
        );
        let seen = self.eye.unproject(pixel, f64::from(self.depth[at]));
        self.eye.world_from_eye.transform_point3(seen)
    }

    /// Index of the sample that a world point falls on, and the point's depth.
    fn sample_at(&self, eye_from_world: &DMat4, p: DVec3) -> Option<(usize, f64)> {
        let (pixel, depth) = self.eye.project(eye_from_world.transform_point3(p))?;
        let inside = pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(2.0 * self.eye.middle()).all();
        inside.then(|| (pixel.y as usize * self.eye.width + pixel.x as usize, depth))
    }

    /// Averages `shade` over the samples of each pixel, in linear light.
    fn develop(&self, shade: impl Fn(usize) -> Vec3 + Sync) -> Rgb {
        let (width, height) = (
            self.eye.width / OVERSAMPLING,
            self.eye.height / OVERSAMPLING,
        );
        let mut bytes = vec![0; 3 * width * height];
        bytes
            .par_chunks_mut(3 * width)
            .enumerate()
            .for_each(|(y, row)| {
                for (x, pixel) in row.chunks_mut(3).enumerate() {
                    let mut sum = Vec3::ZERO;
                    for sample in 0..OVERSAMPLING * OVERSAMPLING {
                        let column = OVERSAMPLING * x + sample % OVERSAMPLING;
                        let line = OVERSAMPLING * y + sample / OVERSAMPLING;
                        let at = line * self.eye.width + column;
                        sum += if self.depth[at].is_finite() {
                            shade(at)
                        } else {
                            PAPER
                        };
                    }
                    let mean = sum / (OVERSAMPLING * OVERSAMPLING) as f32;
                    for (byte, value) in pixel.iter_mut().zip(mean.to_array()) {
                        *byte = srgb::encode(value);
                    }
                }
            });
        Rgb {
            width,
            height,
            bytes,
        }
    }
}

/// The surface's own colours, without any light.
pub fn colors(visible: &Visible) -> Rgb {
    visible.develop(|at| visible.color[at])
}

/// Grey clay. `from_sun` is the same surface seen by [`sun_eye`]; `radius` is that of the scene, the scale of the occlusion.
pub fn clay(visible: &Visible, from_sun: &Visible, radius: f64) -> Rgb {
    let eye_from_world = visible.eye.world_from_eye.inverse();
    let sun_from_world = from_sun.eye.world_from_eye.inverse();
    visible.develop(|at| {
        let (position, normal) = (visible.position(at), visible.normal[at]);
        let start = position + 0.004 * radius * normal.as_dvec3();
        let turn = scramble(at as u32);
        let facing = normal.as_dvec3().dot(SUN).max(0.0);
        let sun = facing * lit_share(from_sun, &sun_from_world, start, 0.006 * radius, turn);
        let open = open_share(visible, &eye_from_world, start, normal, 0.16 * radius, turn);
        let sky = vec3(0.80, 0.88, 1.0) * (0.5 + 0.5 * normal.z)
            + vec3(0.42, 0.39, 0.36) * (0.5 - 0.5 * normal.z);
        let matter = if visible.inner[at] { INNER_SIDE } else { CLAY };
        matter * (0.78 * open as f32 * sky + 0.95 * sun as f32 * vec3(1.0, 0.96, 0.88))
    })
}

/// The sun's view of a scene within the sphere around `center`: what [`clay`] takes its shadows from.
pub fn sun_eye(center: DVec3, radius: f64) -> Eye {
    const SIZE: usize = 500;
    let right = DVec3::Z.cross(SUN).normalize();
    let away = center + 2.0 * radius * SUN;
    Eye {
        world_from_eye: DMat4::from_cols(
            right.extend(0.0),
            SUN.cross(right).extend(0.0),
            SUN.extend(0.0),
            away.extend(1.0),
        ),
        lens: Lens::Parallel(SIZE as f64 / (2.0 * radius)),
        width: SIZE,
        height: SIZE,
    }
}

/// Share of a small disk around `start` that the sun sees.
fn lit_share(
    from_sun: &Visible,
    sun_from_world: &DMat4,
    start: DVec3,
    blur: f64,
    turn: f64,
) -> f64 {
    const TAPS: usize = 8;
    let right = from_sun.eye.world_from_eye.x_axis.truncate();
    let up = from_sun.eye.world_from_eye.y_axis.truncate();
    let lit = (0..TAPS)
        .filter(|&tap| {
            let offset = blur * spiral(tap, TAPS, turn);
            match from_sun.sample_at(sun_from_world, start + offset.x * right + offset.y * up) {
                Some((at, depth)) => depth < f64::from(from_sun.depth[at]) + 2.0 * blur,
                None => true,
            }
        })
        .count();
    lit as f64 / TAPS as f64
}

/// Share of the hemisphere within `reach` that no visible surface covers.
fn open_share(
    visible: &Visible,
    eye_from_world: &DMat4,
    start: DVec3,
    normal: Vec3,
    reach: f64,
    turn: f64,
) -> f64 {
    const TAPS: usize = 14;
    let normal = normal.as_dvec3();
    let (u, v) = normal.any_orthonormal_pair();
    let mut covered = 0.0;
    for tap in 0..TAPS {
        let flat = spiral(tap, TAPS, turn);
        let direction =
            flat.x * u + flat.y * v + (1.0 - flat.length_squared()).max(0.0).sqrt() * normal;
        let distance = reach * (0.12 + 0.88 * ((tap * 5 + 3) % TAPS) as f64 / TAPS as f64);
        if let Some((at, depth)) = visible.sample_at(eye_from_world, start + distance * direction) {
            let gap = depth - f64::from(visible.depth[at]);
            // What lies far in front hides the sample from the eye, not from the sky.
            if gap > 0.0 && gap < 2.0 * reach {
                covered += 1.0 - 0.5 * gap / reach;
            }
        }
    }
    1.0 - 0.9 * covered / TAPS as f64
}

/// Point `index` of `n` in the unit disk, evenly spread, turned by `turn` of a full turn.
fn spiral(index: usize, n: usize, turn: f64) -> DVec2 {
    let radius = ((index as f64 + 0.5) / n as f64).sqrt();
    radius * DVec2::from_angle(2.399_963 * index as f64 + std::f64::consts::TAU * turn)
}

/// A number in [0, 1) for a sample, so that neighbours take different taps.
fn scramble(n: u32) -> f64 {
    let mut h = n.wrapping_mul(0x9e37_79b9);
    h = (h ^ (h >> 16)).wrapping_mul(0x85eb_ca6b);
    h = (h ^ (h >> 13)).wrapping_mul(0xc2b2_ae35);
    f64::from(h >> 8) / f64::from(1u32 << 24)
}

/// Calls `put(sample, barycentric weights, depth)` for every sample of `rows` whose centre the triangle covers; indices count from the
/// first of `rows`. Weights are corrected for perspective (Blinn 1992).
fn scan(
    eye: &Eye,
    corners: [(DVec2, f64); 3],
    rows: std::ops::Range<usize>,
    mut put: impl FnMut(usize, [f32; 3], f32),
) {
    let [a, b, c] = corners.map(|corner| corner.0);
    let area = (b - a).perp_dot(c - a);
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    let top = ((low.y - 0.5).ceil().max(rows.start as f64)) as usize;
    let bottom = ((high.y - 0.5).floor().min(rows.end as f64 - 1.0)).max(-1.0) as i64;
    if area == 0.0 || high.y < 0.5 || bottom < top as i64 {
        return;
    }
    let left = (low.x - 0.5).ceil().max(0.0) as usize;
    let right = (high.x - 0.5).floor().min(eye.width as f64 - 1.0);
    for y in top..=bottom as usize {
        let mut x = left;
        while x as f64 <= right {
            let p = dvec2(x as f64 + 0.5, y as f64 + 0.5);
            let flat = [
                (c - b).perp_dot(p - b),
                (a - c).perp_dot(p - c),
                (b - a).perp_dot(p - a),
            ]
            .map(|edge| edge / area);
            if flat.iter().all(|weight| *weight >= 0.0) {
                let (depth, weights) = match eye.lens {
                    Lens::Perspective(_) => {
                        let over: [f64; 3] = std::array::from_fn(|k| flat[k] / corners[k].1);
                        let sum = over.iter().sum::<f64>();
                        (1.0 / sum, over.map(|w| w / sum))
                    }
                    Lens::Parallel(_) => {
                        let depth = (0..3).map(|k| flat[k] * corners[k].1).sum::<f64>();
                        (depth, flat)
                    }
                };
                put(
                    (y - rows.start) * eye.width + x,
                    weights.map(|w| w as f32),
                    depth as f32,
                );
            }
            x += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cube of edge 1, wound outwards, each corner in its own colour.
    fn cube() -> Mesh {
        let upper = |k: u32, axis: u32| k >> axis & 1 == 1;
        let quads = [
            [0, 2, 3, 1],
            [4, 5, 7, 6],
            [0, 1, 5, 4],
            [2, 6, 7, 3],
            [0, 4, 6, 2],
            [1, 3, 7, 5],
        ];
        let split = |q: &[u32; 4]| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]];
        let place =
            |k: u32| DVec3::from([0, 1, 2].map(|axis| if upper(k, axis) { 0.5 } else { -0.5 }));
        Mesh {
            positions: (0..8).map(place).collect(),
            faces: quads.iter().flat_map(split).collect(),
            colors: (0..8)
                .map(|k| [0, 1, 2].map(|axis| if upper(k, axis) { 255 } else { 0 }))
                .collect(),
            normals: Vec::new(),
        }
    }

    /// Looks down at the origin from a height of 4.
    fn from_above(lens: Lens) -> Eye {
        Eye {
            world_from_eye: DMat4::from_translation(dvec3(0.0, 0.0, 4.0)),
            lens,
            width: 80,
            height: 60,
        }
    }

    fn covered(visible: &Visible) -> usize {
        visible
            .depth
            .iter()
            .filter(|depth| depth.is_finite())
            .count()
    }

    #[test]
    fn a_cube_is_seen_where_it_is() {
        let mesh = cube();
        for (lens, half) in [
            (Lens::Parallel(40.0), 20.0),
            (Lens::Perspective(140.0), 20.0),
        ] {
            let visible = Visible::of_mesh(&mesh, &from_above(lens));
            // The upper face is 40 pixels wide in both views (3.5 away, 140 pixels focal length), whatever lies behind it.
            let side = 2.0 * half * OVERSAMPLING as f64;
            assert_eq!(covered(&visible), (side * side) as usize);
            let middle = visible.eye.height / 2 * visible.eye.width + visible.eye.width / 2;
            assert!((visible.depth[middle] - 3.5).abs() < 1e-5);
            assert!(
                visible
                    .position(middle)
                    .abs_diff_eq(dvec3(0.0, 0.0, 0.5), 0.02)
            );
            assert!(!visible.inner[middle]);
            // Right is +x and up is +y: the corner's colour says which one it is.
            let picture = super::colors(&visible);
            let at = |x: usize, y: usize| -> [u8; 3] {
                picture.bytes[3 * (y * picture.width + x)..][..3]
                    .try_into()
                    .unwrap()
            };
            let [right_up, left_down] = [at(58, 11), at(21, 48)];
            assert!(
                right_up.iter().all(|channel| *channel > 230),
                "{right_up:?}"
            );
            assert!(
                left_down[0] < 90 && left_down[1] < 90 && left_down[2] > 230,
                "{left_down:?}"
            );
        }
    }

    #[test]
    fn colours_are_right_in_perspective() {
        // A floor that recedes: halfway in depth is not halfway on the screen.
        let positions = [
            [-1.0, 0.0, -1.0],
            [1.0, 0.0, -1.0],
            [1.0, 8.0, -1.0],
            [-1.0, 8.0, -1.0],
        ];
        let colors = [[0; 3], [0; 3], [255; 3], [255; 3]];
        let mesh = Mesh {
            positions: positions.map(DVec3::from).to_vec(),
            faces: vec![[0, 1, 2], [0, 2, 3]],
            colors: colors.to_vec(),
            normals: Vec::new(),
        };
        let eye = Eye {
            // Looks along +y.
            world_from_eye: DMat4::from_cols(
                DVec3::X.extend(0.0),
                DVec3::Z.extend(0.0),
                DVec3::NEG_Y.extend(0.0),
                dvec3(0.0, -1.0, 0.0).extend(1.0),
            ),
            ..from_above(Lens::Perspective(60.0))
        };
        let visible = Visible::of_mesh(&mesh, &eye);
        let mut seen = 0;
        for at in 0..visible.depth.len() {
            if visible.depth[at].is_finite() {
                let expected = (visible.position(at).y / 8.0) as f32;
                assert!((visible.color[at].x - expected).abs() < 1e-4);
                seen += 1;
            }
        }
        assert!(seen > 500, "{seen} samples");
    }

    #[test]
    fn an_open_surface_shows_its_inner_side() {
        let mut mesh = cube();
        mesh.colors.clear();
        // Without the upper face one looks at the lower one from within.
        mesh.faces.drain(2..4);
        let visible = Visible::of_mesh(&mesh, &from_above(Lens::Parallel(40.0)));
        let middle = visible.eye.height / 2 * visible.eye.width + visible.eye.width / 2;
        assert!(visible.inner[middle]);
        assert!((visible.depth[middle] - 4.5).abs() < 1e-5);
        let picture = clay(
            &visible,
            &Visible::of_mesh(&mesh, &sun_eye(DVec3::ZERO, 1.0)),
            1.0,
        );
        let pixel = &picture.bytes[3 * (30 * 80 + 40)..][..3];
        assert!(pixel[0] > pixel[2] + 20, "the inner side is red: {pixel:?}");
    }

    #[test]
    fn shadows_fall_away_from_the_sun() {
        // A small plate above a large one.
        let plate = |half: f64, z: f64| {
            [
                [-half, -half, z],
                [half, -half, z],
                [half, half, z],
                [-half, half, z],
            ]
        };
        let positions: Vec<[f64; 3]> = plate(1.0, 0.0).into_iter().chain(plate(0.2, 0.4)).collect();
        let faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]];
        let mesh = Mesh {
            positions: positions.into_iter().map(DVec3::from).collect(),
            faces: faces.to_vec(),
            ..Mesh::default()
        };
        let visible = Visible::of_mesh(&mesh, &from_above(Lens::Parallel(30.0)));
        let from_sun = Visible::of_mesh(&mesh, &sun_eye(DVec3::ZERO, 1.5));
        let picture = clay(&visible, &from_sun, 1.0);
        let brightness = |x: f64, y: f64| {
            let (column, row) = ((40.0 + 30.0 * x) as usize, (30.0 - 30.0 * y) as usize);
            i32::from(picture.bytes[3 * (row * 80 + column)])
        };
        // The middle of the shadow lies 0.4 below along the sun's direction.
        let (x, y) = (-0.4 * SUN.x / SUN.z, -0.4 * SUN.y / SUN.z);
        assert!(brightness(-x, -y) > brightness(x, y) + 40);
    }

    #[test]
    fn the_exact_surface_is_seen_like_a_mesh_of_it() {
        // The white ball: its top is at a known place.
        let eye = Eye {
            world_from_eye: DMat4::from_translation(dvec3(-0.557, -0.39, 3.0)),
            ..from_above(Lens::Parallel(200.0))
        };
        let visible = Visible::of_exact_surface(&eye);
        let middle = visible.eye.height / 2 * visible.eye.width + visible.eye.width / 2;
        assert!((f64::from(visible.depth[middle]) - (3.0 - 0.34)).abs() < 1e-4);
        assert!(visible.normal[middle].z > 0.999);
    }
}
