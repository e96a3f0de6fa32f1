//! A bounding volume hierarchy over triangles or points: exact distances, and whether anything stands between two points.
//!
//! Primitives are split at the median of the longest side of their centres' box, the left half always a whole number of leaves. The
//! tree's shape then follows from the number of primitives alone, and nodes, in depth-first order, hold nothing but their boxes.

use glam::DVec3;

use super::Mesh;

/// Primitives per leaf.
const LEAF: usize = 4;
/// From this many primitives on, the halves are built in parallel.
const PARALLEL: usize = 1 << 13;

/// Something with a place in space.
pub trait Primitive: Copy + Send + Sync {
    /// Smallest box around it.
    fn bounds(&self) -> [DVec3; 2];
    /// Squared distance from `p` to the nearest of its points.
    fn distance_squared(&self, p: DVec3) -> f64;
}

impl Primitive for DVec3 {
    fn bounds(&self) -> [DVec3; 2] {
        [*self, *self]
    }

    fn distance_squared(&self, p: DVec3) -> f64 {
        DVec3::distance_squared(*self, p)
    }
}

/// Three corners; may be degenerate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Triangle(pub [DVec3; 3]);

impl Primitive for Triangle {
    fn bounds(&self) -> [DVec3; 2] {
        let [a, b, c] = self.0;
        [a.min(b).min(c), a.max(b).max(c)]
    }

    fn distance_squared(&self, p: DVec3) -> f64 {
        let [a, b, c] = self.0.map(|corner| corner - p);
        let normal = (b - a).cross(c - a);
        let squared = normal.length_squared();
        // Above the inside: on the same side of all three planes through a side and the normal.
        let inside = |from: DVec3, to: DVec3| normal.cross(to - from).dot(from) <= 0.0;
        if squared > 0.0 && inside(a, b) && inside(b, c) && inside(c, a) {
            return normal.dot(a).powi(2) / squared;
        }
        segment_distance_squared(a, b)
            .min(segment_distance_squared(b, c))
            .min(segment_distance_squared(c, a))
    }
}

impl Triangle {
    /// Where the ray `origin + t direction` crosses the triangle, from either side (Möller & Trumbore 1997).
    fn hit(&self, origin: DVec3, direction: DVec3) -> Option<f64> {
        let [a, b, c] = self.0;
        let (ab, ac) = (b - a, c - a);
        let p = direction.cross(ac);
        let determinant = ab.dot(p);
        if determinant == 0.0 {
            return None;
        }
        let from_a = origin - a;
        let u = from_a.dot(p) / determinant;
        let q = from_a.cross(ab);
        let v = direction.dot(q) / determinant;
        (u >= 0.0 && v >= 0.0 && u + v <= 1.0).then(|| ac.dot(q) / determinant)
    }
}

/// Squared distance from the origin to the segment from `a` to `b`.
fn segment_distance_squared(a: DVec3, b: DVec3) -> f64 {
    let along = b - a;
    let squared = along.length_squared();
    let t = if squared > 0.0 {
        (-a.dot(along) / squared).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (a + t * along).length_squared()
}

/// The hierarchy. Finite coordinates only.
pub struct Bvh<P: Primitive> {
    primitives: Vec<P>,
    /// `[2 leaves - 1]` depth first.
    boxes: Vec<[DVec3; 2]>,
}

impl<P: Primitive> Bvh<P> {
    /// Builds the hierarchy in O(n log n).
    pub fn new(mut primitives: Vec<P>) -> Bvh<P> {
        let n_leaves = primitives.len().div_ceil(LEAF);
        let mut boxes = vec![[DVec3::ZERO; 2]; (2 * n_leaves).saturating_sub(1)];
        if n_leaves > 0 {
            build(&mut primitives, &mut boxes);
        }
        Bvh { primitives, boxes }
    }

    /// Distance from `p` to the nearest primitive; infinite if there is none.
    pub fn distance(&self, p: DVec3) -> f64 {
        let mut best = f64::INFINITY;
        if !self.boxes.is_empty() {
            self.nearest(0, 0..self.primitives.len(), p, &mut best);
        }
        best.sqrt()
    }

    fn nearest(&self, node: usize, range: std::ops::Range<usize>, p: DVec3, best: &mut f64) {
        if range.len() <= LEAF {
            for primitive in &self.primitives[range] {
                *best = best.min(primitive.distance_squared(p));
            }
            return;
        }
        let (left, right) = children(node, range);
        let reach = |node: usize| {
            let [low, high] = self.boxes[node];
            p.clamp(low, high).distance_squared(p)
        };
        let mut order = [(reach(left.0), left), (reach(right.0), right)];
        if order[1].0 < order[0].0 {
            order.swap(0, 1);
        }
        for (reach, (node, range)) in order {
            if reach < *best {
                self.nearest(node, range, p, best);
            }
        }
    }
}

impl Bvh<Triangle> {
    /// A hierarchy over some faces of a mesh.
    pub fn over_faces(mesh: &Mesh, faces: impl Iterator<Item = usize>) -> Bvh<Triangle> {
        Bvh::new(faces.map(|face| Triangle(mesh.corners(face))).collect())
    }

    /// Whether a triangle crosses `origin + t direction` for a t in (0, end).
    pub fn is_blocked(&self, origin: DVec3, direction: DVec3, end: f64) -> bool {
        if self.boxes.is_empty() {
            return false;
        }
        let mut open = vec![(0, 0..self.primitives.len())];
        while let Some((node, range)) = open.pop() {
            let [low, high] = self.boxes[node];
            let axis = |j: usize| {
                if direction[j] == 0.0 {
                    let between = (low[j]..=high[j]).contains(&origin[j]);
                    return if between { (0.0, end) } else { (end, 0.0) };
                }
                let (t0, t1) = (
                    (low[j] - origin[j]) / direction[j],
                    (high[j] - origin[j]) / direction[j],
                );
                (t0.min(t1), t0.max(t1))
            };
            let (enter, leave) = (0..3)
                .map(axis)
                .fold((0.0, end), |(e, l), (near, far)| (near.max(e), far.min(l)));
            if enter > leave {
                continue;
            }
            if range.len() <= LEAF {
                let mut hits = self.primitives[range]
                    .iter()
                    .filter_map(|triangle| triangle.hit(origin, direction));
                if hits.any(|t| t > 0.0 && t < end) {
                    return true;
                }
            } else {
                let (left, right) = children(node, range);
                open.extend([left, right]);
            }
        }
        false
    }
}

/// Primitives in the left half: as many whole leaves as make half of them.
fn left_half(n: usize) -> usize {
    LEAF * (n.div_ceil(LEAF) / 2)
}

type Child = (usize, std::ops::Range<usize>);

fn children(node: usize, range: std::ops::Range<usize>) -> (Child, Child) {
    let n_left = left_half(range.len());
    let middle = range.start + n_left;
    (
        (node + 1, range.start..middle),
        (node + 2 * (n_left / LEAF), middle..range.end),
    )
}

fn build<P: Primitive>(primitives: &mut [P], boxes: &mut [[DVec3; 2]]) {
    let n = primitives.len();
    let empty = [DVec3::INFINITY, DVec3::NEG_INFINITY];
    let join = |[low, high]: [DVec3; 2], [l, h]: [DVec3; 2]| [low.min(l), high.max(h)];
    let (own, below) = boxes.split_first_mut().expect("a node per call");
    *own = primitives.iter().map(P::bounds).fold(empty, join);
    if n <= LEAF {
        return;
    }
    let center = |primitive: &P| {
        let [low, high] = primitive.bounds();
        low + high
    };
    let [low, high] = primitives
        .iter()
        .map(|primitive| [center(primitive); 2])
        .fold(empty, join);
    let axis = (high - low).max_position();
    let n_left = left_half(n);
    primitives.select_nth_unstable_by(n_left, |a, b| center(a)[axis].total_cmp(&center(b)[axis]));
    let (left, right) = primitives.split_at_mut(n_left);
    let (left_boxes, right_boxes) = below.split_at_mut(2 * (n_left / LEAF) - 1);
    if n >= PARALLEL {
        rayon::join(|| build(left, left_boxes), || build(right, right_boxes));
    } else {
        build(left, left_boxes);
        build(right, right_boxes);
    }
}
