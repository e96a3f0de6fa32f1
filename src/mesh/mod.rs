//! Triangle meshes: taken out of a signed distance field ([`extract`]), cleaned ([`clean`]), read and written.
//!
//! A [`Mesh`] is in the world frame of the input cameras unless said otherwise. Faces wind counter-clockwise seen from free space
//! (where the signed distance is positive), so that their right-hand normals point outward.

pub mod bvh;
pub mod clean;
pub mod extract;
pub mod field;
pub mod marching_cubes;
pub mod read;
pub mod write;

use glam::DVec3;

pub use extract::{
    ExtractOptions, ExtractStats, Lattice, Progress, SurfaceAttributes, extract_mesh,
};
pub use field::Field;
pub use read::read_mesh;
pub use write::{MeshFormat, write_mesh};

/// Triangles with optional normals and colours per vertex. Without faces it is a point cloud.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// `[n_vertices]`
    pub positions: Vec<DVec3>,
    /// `[n_vertices, 3]` unit vectors out of matter, or empty.
    pub normals: Vec<[f32; 3]>,
    /// `[n_vertices, 3]` sRGB, or empty.
    pub colors: Vec<[u8; 3]>,
    /// `[n_faces, 3]` vertex indices, counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
}

impl Mesh {
    /// The three corners of a face.
    pub fn corners(&self, face: usize) -> [DVec3; 3] {
        self.faces[face].map(|vertex| self.positions[vertex as usize])
    }

    /// Smallest box around all vertices; `None` without vertices.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        bounds(&self.positions)
    }

    /// Sum of the faces' areas, in squared units of the positions.
    pub fn area(&self) -> f64 {
        (0..self.faces.len())
            .map(|face| self.area_vector(face).length())
            .sum()
    }

    /// Area times unit normal of a face.
    pub fn area_vector(&self, face: usize) -> DVec3 {
        let [a, b, c] = self.corners(face);
        0.5 * (b - a).cross(c - a)
    }

    /// Normals from the geometry alone: the area-weighted mean of the faces around each vertex; zero for a vertex without faces.
    pub fn face_weighted_normals(&self) -> Vec<[f32; 3]> {
        let mut sums = vec![DVec3::ZERO; self.positions.len()];
        for face in 0..self.faces.len() {
            let normal = self.area_vector(face);
            for vertex in self.faces[face] {
                sums[vertex as usize] += normal;
            }
        }
        sums.into_iter()
            .map(|sum| sum.normalize_or_zero().as_vec3().to_array())
            .collect()
    }
}

/// Smallest box around points; `None` without points.
pub fn bounds(points: &[DVec3]) -> Option<[DVec3; 2]> {
    let first = *points.first()?;
    Some(
        points
            .iter()
            .fold([first, first], |[low, high], &p| [low.min(p), high.max(p)]),
    )
}
