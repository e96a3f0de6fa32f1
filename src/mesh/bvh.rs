//! A bounding volume hierarchy over triangles or points: exact distances, and whether anything stands between two points.
//!
//! Primitives are split where the surface area heuristic is least (Wald 2007: binned), the left part always a whole number of full
//! leaves. A subtree's number of nodes then follows from its number of primitives, and nodes in depth-first order need no pointers.

use glam::DVec3;

use super::Mesh;

/// Primitives per leaf.
const LEAF: usize = 4;
/// Places along each axis where a split is considered.
const BINS: usize = 16;
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

/// The box around some primitives, and how many of them are in the left child; 0 in a leaf.
#[derive(Clone, Copy)]
struct Node {
    low: DVec3,
    high: DVec3,
    n_left: u32,
}

/// A node and its primitives.
type Place = (usize, std::ops::Range<usize>);

/// The hierarchy. Finite coordinates only.
pub struct Bvh<P: Primitive> {
    primitives: Vec<P>,
    /// `[2 leaves - 1]` depth first.
    nodes: Vec<Node>,
}

impl<P: Primitive> Bvh<P> {
    /// Builds the hierarchy in O(n log n).
    pub fn new(mut primitives: Vec<P>) -> Bvh<P> {
        let n_leaves = primitives.len().div_ceil(LEAF);
        let empty = Node {
            low: DVec3::INFINITY,
            high: DVec3::NEG_INFINITY,
            n_left: 0,
        };
        let mut nodes = vec![empty; (2 * n_leaves).saturating_sub(1)];
        if n_leaves > 0 {
            build(&mut primitives, &mut nodes);
        }
        Bvh { primitives, nodes }
    }

    /// Distance from `p` to the nearest primitive; infinite if there is none.
    pub fn distance(&self, p: DVec3) -> f64 {
        let mut best = f64::INFINITY;
        if !self.nodes.is_empty() {
            self.nearest((0, 0..self.primitives.len()), p, &mut best);
        }
        best.sqrt()
    }

    fn nearest(&self, place: Place, p: DVec3, best: &mut f64) {
        let Some((left, right)) = self.children(&place) else {
            for primitive in &self.primitives[place.1] {
                *best = best.min(primitive.distance_squared(p));
            }
            return;
        };
        let reach = |place: &Place| {
            let node = &self.nodes[place.0];
            p.clamp(node.low, node.high).distance_squared(p)
        };
        let (to_left, to_right) = (reach(&left), reach(&right));
        let mut order = [(to_left, left), (to_right, right)];
        if to_right < to_left {
            order.swap(0, 1);
        }
        for (reach, place) in order {
            if reach < *best {
                self.nearest(place, p, best);
            }
        }
    }

    /// The children of a node; `None` for a leaf.
    fn children(&self, (node, range): &Place) -> Option<(Place, Place)> {
        let n_left = self.nodes[*node].n_left as usize;
        let middle = range.start + n_left;
        (n_left > 0).then(|| {
            (
                (node + 1, range.start..middle),
                (node + 2 * (n_left / LEAF), middle..range.end),
            )
        })
    }
}

impl Bvh<Triangle> {
    /// A hierarchy over some faces of a mesh.
    pub fn over_faces(mesh: &Mesh, faces: impl Iterator<Item = usize>) -> Bvh<Triangle> {
        Bvh::new(faces.map(|face| Triangle(mesh.corners(face))).collect())
    }

    /// Whether a triangle crosses `origin + t direction` for a t in (0, end).
    pub fn is_blocked(&self, origin: DVec3, direction: DVec3, end: f64) -> bool {
        !self.nodes.is_empty()
            && self.blocks(
                (0, 0..self.primitives.len()),
                origin,
                direction,
                direction.recip(),
                end,
            )
    }

    fn blocks(
        &self,
        place: Place,
        origin: DVec3,
        direction: DVec3,
        inverse: DVec3,
        end: f64,
    ) -> bool {
        let node = &self.nodes[place.0];
        let (mut enter, mut leave) = (0.0f64, end);
        for axis in 0..3 {
            let mut planes = [node.low[axis], node.high[axis]];
            if inverse[axis] < 0.0 {
                planes.swap(0, 1);
            }
            // A ray inside of a plane gives 0 · ∞ = NaN, which max and min pass over.
            let [near, far] = planes.map(|plane| (plane - origin[axis]) * inverse[axis]);
            (enter, leave) = (enter.max(near), leave.min(far));
        }
        if enter > leave {
            return false;
        }
        match self.children(&place) {
            Some((left, right)) => {
                self.blocks(left, origin, direction, inverse, end)
                    || self.blocks(right, origin, direction, inverse, end)
            }
            None => {
                let mut hits = self.primitives[place.1]
                    .iter()
                    .filter_map(|triangle| triangle.hit(origin, direction));
                hits.any(|t| t > 0.0 && t < end)
            }
        }
    }
}

/// Twice the centre of a primitive's box.
fn center<P: Primitive>(primitive: &P) -> DVec3 {
    let [low, high] = primitive.bounds();
    low + high
}

fn join([low, high]: [DVec3; 2], [l, h]: [DVec3; 2]) -> [DVec3; 2] {
    [low.min(l), high.max(h)]
}

const NOTHING: [DVec3; 2] = [DVec3::INFINITY, DVec3::NEG_INFINITY];

fn build<P: Primitive>(primitives: &mut [P], nodes: &mut [Node]) {
    let n = primitives.len();
    let (own, below) = nodes.split_first_mut().expect("a node per call");
    [own.low, own.high] = primitives.iter().map(P::bounds).fold(NOTHING, join);
    if n <= LEAF {
        return;
    }
    let (axis, n_left) = split(primitives);
    own.n_left = n_left as u32;
    primitives.select_nth_unstable_by(n_left, |a, b| center(a)[axis].total_cmp(&center(b)[axis]));
    let (left, right) = primitives.split_at_mut(n_left);
    let (left_nodes, right_nodes) = below.split_at_mut(2 * (n_left / LEAF) - 1);
    if n >= PARALLEL {
        rayon::join(|| build(left, left_nodes), || build(right, right_nodes));
    } else {
        build(left, left_nodes);
        build(right, right_nodes);
    }
}

/// The axis along which to order the primitives, and how many of them go left: where the sum of each side's area times number is
/// least. Neither side gets less than an eighth, which bounds the depth.
fn split<P: Primitive>(primitives: &[P]) -> (usize, usize) {
    let n = primitives.len();
    let whole_leaves = |wanted: usize| (wanted + LEAF / 2) / LEAF * LEAF;
    let [low, high] = primitives
        .iter()
        .map(|primitive| [center(primitive); 2])
        .fold(NOTHING, join);
    let mut best = (
        f64::INFINITY,
        (high - low).max_position(),
        LEAF * (n.div_ceil(LEAF) / 2),
    );
    for axis in (0..3).filter(|&axis| high[axis] > low[axis]) {
        let mut bins = [(0, NOTHING); BINS];
        for primitive in primitives {
            let at = (center(primitive)[axis] - low[axis]) / (high[axis] - low[axis]) * BINS as f64;
            let bin = &mut bins[(at as usize).min(BINS - 1)];
            *bin = (bin.0 + 1, join(bin.1, primitive.bounds()));
        }
        let gather = |from: &mut dyn Iterator<Item = &(usize, [DVec3; 2])>| {
            let (count, [low, high]) = from.fold((0, NOTHING), |(count, bounds), bin| {
                (count + bin.0, join(bounds, bin.1))
            });
            let size = (high - low).max(DVec3::ZERO);
            (count, size.x * size.y + size.y * size.z + size.z * size.x)
        };
        for boundary in 1..BINS {
            let (n_left, left_area) = gather(&mut bins[..boundary].iter());
            let (n_right, right_area) = gather(&mut bins[boundary..].iter());
            let cost = n_left as f64 * left_area + n_right as f64 * right_area;
            let n_left = whole_leaves(n_left);
            if cost < best.0
                && n_left.min(n.saturating_sub(n_left)) >= (n / 8).max(1)
                && n_left >= LEAF
            {
                best = (cost, axis, n_left);
            }
        }
    }
    (best.1, best.2)
}
