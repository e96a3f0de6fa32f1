//! Which parts of a mesh the cameras see: rasterised depth maps, and faces tested against them.
//!
//! A depth is the distance from the camera's centre, so that fisheyes need no case of their own. Triangles are cut until they span a few
//! pixels, where any lens is nearly linear.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use glam::{DMat4, DVec2, DVec3};
use rayon::prelude::*;

use super::Mesh;

/// A camera as far as seeing is concerned.
pub trait Viewpoint: Sync {
    /// Rigid; the camera looks along its −z.
    fn world_from_camera(&self) -> DMat4;
    /// Width and height in pixels.
    fn size(&self) -> [u32; 2];
    /// Pixel (centres at +0.5) of a point in the camera's frame; `None` if no pixel can show it. May lie outside the image.
    fn project(&self, p_camera: DVec3) -> Option<DVec2>;
}

/// How visibility is decided.
#[derive(Clone, Copy, Debug)]
pub struct VisibilityOptions {
    /// Views that must see a face.
    pub min_views: u32,
    /// A point is hidden only by what is nearer by more than this fraction of its distance.
    pub slack: f64,
    /// Depth map pixels along an image pixel, halved by 0.5.
    pub scale: f64,
}

impl Default for VisibilityOptions {
    fn default() -> Self {
        VisibilityOptions {
            min_views: 1,
            slack: 2e-3,
            scale: 1.0,
        }
    }
}

/// For each face, whether at least `min_views` of the views see its centre or one of its corners.
pub fn seen_faces<V: Viewpoint>(
    mesh: &Mesh,
    views: &[V],
    options: &VisibilityOptions,
) -> Vec<bool> {
    let n_seeing: Vec<AtomicU32> = mesh.faces.iter().map(|_| AtomicU32::new(0)).collect();
    views.par_iter().for_each(|view| {
        let depth = DepthMap::new(mesh, view, options.scale);
        for (face, n_seeing) in n_seeing.iter().enumerate() {
            if n_seeing.load(Relaxed) < options.min_views {
                let [a, b, c] = mesh.corners(face);
                let seen = [(a + b + c) / 3.0, a, b, c]
                    .into_iter()
                    .any(|p| depth.sees(p, options.slack));
                n_seeing.fetch_add(u32::from(seen), Relaxed);
            }
        }
    });
    n_seeing
        .into_iter()
        .map(|n| n.into_inner() >= options.min_views)
        .collect()
}

/// Longest side, in pixels, of the triangles that are filled by linear interpolation.
const SMALL: f64 = 6.0;
/// Triangles are halved at most so often along each side.
const MAX_CUTS: u32 = 10;

/// Distances from a camera to the nearest surface along each pixel.
pub struct DepthMap<'a, V: Viewpoint> {
    view: &'a V,
    camera_from_world: DMat4,
    scale: f64,
    width: usize,
    height: usize,
    /// `[height, width]` infinite where there is nothing
    depth: Vec<f32>,
}

impl<'a, V: Viewpoint> DepthMap<'a, V> {
    /// Renders `mesh` as `view` sees it, with `scale` pixels per image pixel.
    pub fn new(mesh: &Mesh, view: &'a V, scale: f64) -> Self {
        let [width, height] = view
            .size()
            .map(|n| ((f64::from(n) * scale).ceil() as usize).max(1));
        let camera_from_world = view.world_from_camera().inverse();
        let depth = vec![f32::INFINITY; width * height];
        let mut map = DepthMap {
            view,
            camera_from_world,
            scale,
            width,
            height,
            depth,
        };
        let corners: Vec<Corner> = mesh
            .positions
            .iter()
            .map(|&p| map.corner(map.camera_from_world.transform_point3(p)))
            .collect();
        for face in &mesh.faces {
            map.draw(face.map(|vertex| corners[vertex as usize]), MAX_CUTS);
        }
        map
    }

    /// Whether `p` (world) is in the picture and nothing is nearer by more than `slack` times its distance.
    pub fn sees(&self, p: DVec3, slack: f64) -> bool {
        let corner = self.corner(self.camera_from_world.transform_point3(p));
        let Some(pixel) = corner.pixel else {
            return false;
        };
        if !(pixel.cmpge(DVec2::ZERO).all()
            && pixel.x < self.width as f64
            && pixel.y < self.height as f64)
        {
            return false;
        }
        // On a slanted surface the four pixel centres around a point lie before and behind it: compare with the farthest.
        let around =
            |x: f64, n: usize| [(x - 0.5).max(0.0) as usize, ((x + 0.5) as usize).min(n - 1)];
        let farthest = around(pixel.y, self.height)
            .into_iter()
            .flat_map(|y| around(pixel.x, self.width).map(|x| self.depth[y * self.width + x]))
            .fold(0.0, f32::max);
        corner.p.length() * (1.0 - slack) <= f64::from(farthest)
    }

    fn corner(&self, p: DVec3) -> Corner {
        let pixel = self
            .view
            .project(p)
            .filter(|pixel| pixel.is_finite())
            .map(|pixel| pixel * self.scale);
        Corner { p, pixel }
    }

    /// Draws a triangle, in pieces where it is large or partly outside of what the lens can show.
    fn draw(&mut self, corners: [Corner; 3], cuts: u32) {
        let pixels = corners.map(|corner| corner.pixel);
        let whole = if let [Some(a), Some(b), Some(c)] = pixels {
            let (low, high) = (a.min(b).min(c), a.max(b).max(c));
            if high.cmplt(DVec2::ZERO).any()
                || low.x > self.width as f64
                || low.y > self.height as f64
            {
                return;
            }
            if (high - low).max_element() <= SMALL || cuts == 0 {
                return self.fill([a, b, c], corners.map(|corner| corner.p.length()));
            }
            true
        } else {
            pixels.iter().any(Option::is_some)
        };
        let [a, b, c] = corners.map(|corner| corner.p);
        let longest = (b - a).length().max((c - b).length()).max((a - c).length());
        let nearest = a.length().min(b.length()).min(c.length());
        // A triangle of which no corner shows may still show if it is large for its distance.
        if cuts > 0 && (whole || longest > 0.5 * nearest) {
            let [ab, bc, ca] =
                [(a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0].map(|p| self.corner(p));
            let [a, b, c] = corners;
            for piece in [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]] {
                self.draw(piece, cuts - 1);
            }
        }
    }

    fn fill(&mut self, [a, b, c]: [DVec2; 3], depths: [f64; 3]) {
        let area = (b - a).perp_dot(c - a);
        if area == 0.0 {
            return;
        }
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let first = |x: f64| (x - 0.5).ceil().max(0.0) as usize;
        let end = |x: f64, n: usize| (((x - 0.5).floor() + 1.0).max(0.0) as usize).min(n);
        for y in first(low.y)..end(high.y, self.height) {
            for x in first(low.x)..end(high.x, self.width) {
                let p = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                let weights = [
                    (c - b).perp_dot(p - b) / area,
                    (a - c).perp_dot(p - c) / area,
                    (b - a).perp_dot(p - a) / area,
                ];
                if weights.iter().all(|&w| w >= 0.0) {
                    let depth = (0..3).map(|i| weights[i] * depths[i]).sum::<f64>() as f32;
                    let nearest = &mut self.depth[y * self.width + x];
                    *nearest = nearest.min(depth);
                }
            }
        }
    }
}

/// A point in the camera's frame and where the picture shows it.
#[derive(Clone, Copy)]
struct Corner {
    p: DVec3,
    pixel: Option<DVec2>,
}
