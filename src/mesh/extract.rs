//! From a signed distance field to a mesh, block by block, in memory that does not depend on the resolution: marching cubes on a regular
//! lattice over the region; a vertex outside of the region takes its faces with it.
//!
//! Blocks share lattice points, not faces: vertices on the border between blocks are found again through a small map that holds only
//! the borders of blocks still to come, so the mesh is the same, vertex for vertex, whatever the block size. For that the lattice's
//! coordinates are integer multiples of a step with few enough mantissa bits to be exact in float32: a device that computes
//! `origin + step · i` in float32 gets the same point from every block.

use std::collections::HashMap;

use glam::{DMat3, DMat4, DVec3, Vec3};

use super::Mesh;
use super::marching_cubes::{MAX_VERTICES, Marcher, OUTSIDE, Sink};
use crate::scene::{Region, RegionShape};
use crate::{Error, Result, srgb};

/// Signed distances on a regular lattice, in the region frame; positive in free space.
pub trait Lattice {
    /// Replaces `values` by those at `origin + step · (x, y, z)`, `values[(z ny + y) nx + x]` with `dims = [nx, ny, nz]`. The value at a
    /// point must not depend on the block that asks for it.
    fn sdf(
        &mut self,
        origin: DVec3,
        step: f64,
        dims: [usize; 3],
        values: &mut Vec<f32>,
    ) -> Result<()>;
}

/// What a surface point carries besides its position.
pub trait SurfaceAttributes {
    /// Colours `[n, 3]` in [0, 1] (sRGB) and signed distance gradients `[n, 3]`, at points of the region frame.
    fn attributes(&mut self, points: &[[f32; 3]]) -> Result<PointAttributes>;
}

/// Colours and gradients, one of each per point.
pub type PointAttributes = (Vec<[f32; 3]>, Vec<[f32; 3]>);

/// How to extract.
#[derive(Clone, Debug)]
pub struct ExtractOptions {
    /// Cells along the longest side of the region (at least; the step is rounded to be exact in float32).
    pub resolution: u32,
    /// Cells along the side of a block. The mesh does not depend on it; scratch memory and device efficiency do.
    pub block: usize,
    /// Faces with a vertex outside of it are left out.
    pub shape: RegionShape,
    /// Similarity that takes the mesh to the input's world.
    pub world_from_region: DMat4,
    /// World-axis box outside which nothing is wanted; blocks beyond it are not evaluated.
    pub crop: Option<[DVec3; 2]>,
    /// Skip blocks that hold no surface if the field is nowhere steeper than this. Exact only if that is true:
    /// compare [`ExtractStats::steepest`]. `None` evaluates everything.
    pub steepest: Option<f64>,
}

impl Default for ExtractOptions {
    fn default() -> Self {
        ExtractOptions {
            resolution: 512,
            block: 64,
            shape: RegionShape::Sphere,
            world_from_region: DMat4::IDENTITY,
            crop: None,
            steepest: None,
        }
    }
}

impl ExtractOptions {
    /// The defaults for a region: all of it, in the world's coordinates.
    pub fn of(region: &Region) -> ExtractOptions {
        ExtractOptions {
            shape: region.shape,
            world_from_region: region.world_from_region(),
            ..Default::default()
        }
    }
}

/// How far an extraction is.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Blocks while `vertices` grows, vertices with attributes after that.
    pub stage: Stage,
    pub done: u64,
    pub total: u64,
    pub vertices: u64,
    pub faces: u64,
}

/// What an extraction is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Evaluating the lattice and marching over it.
    Lattice,
    /// Colours and normals.
    Attributes,
}

/// What an extraction did.
#[derive(Clone, Copy, Debug, Default)]
pub struct ExtractStats {
    /// Cells along x, y, z, and their side in region units.
    pub cells: [usize; 3],
    pub step: f64,
    pub blocks: u64,
    /// Blocks left out because they are outside the region or crop box, and because of [`ExtractOptions::steepest`].
    pub blocks_outside: u64,
    pub blocks_skipped: u64,
    /// Largest slope seen between neighbouring lattice points of the evaluated blocks (only where `steepest` was given).
    pub steepest: f64,
    /// Most bytes held at once beside the mesh itself.
    pub scratch_bytes: usize,
}

/// Vertices per call of [`SurfaceAttributes::attributes`].
const ATTRIBUTE_CHUNK: usize = 1 << 16;
/// Sub-blocks along a side of a block that is tested for skipping.
const PROBES: usize = 8;

/// The zero surface of `field`, with normals and colours, in the world frame. `progress` is called after every block and every chunk of
/// vertices; returning `false` stops.
///
/// # Errors
/// Those of the field; `Numerical` for a value that is not finite; `Config` for senseless options; `OutOfMemory` past 2^32 vertices;
/// `Interrupted` when `progress` returns false.
pub fn extract_mesh<F: Lattice + SurfaceAttributes>(
    field: &mut F,
    options: &ExtractOptions,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Mesh> {
    let (mut mesh, _) = extract_surface(field, options, progress)?;
    add_attributes(&mut mesh, field, progress)?;
    to_world(&mut mesh, options.world_from_region);
    Ok(mesh)
}

/// The zero surface alone: positions (region frame) and faces.
///
/// # Errors
/// See [`extract_mesh`].
pub fn extract_surface(
    field: &mut impl Lattice,
    options: &ExtractOptions,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<(Mesh, ExtractStats)> {
    let grid = Grid::new(options)?;
    let mut stats = ExtractStats {
        cells: grid.cells,
        step: grid.step,
        ..Default::default()
    };
    let n_blocks = grid.cells.map(|cells| cells.div_ceil(options.block));
    stats.blocks = n_blocks.iter().map(|&n| n as u64).product();
    let mut sink = BlockSink::new(options, &grid);
    let mut marcher = Marcher::default();
    let mut values = Vec::new();
    let mut done = 0;
    for block_z in 0..n_blocks[2] {
        for block_y in 0..n_blocks[1] {
            for block_x in 0..n_blocks[0] {
                let first = [block_x, block_y, block_z].map(|b| b * options.block);
                let last: [usize; 3] =
                    std::array::from_fn(|j| (first[j] + options.block).min(grid.cells[j]));
                let (low, high) = (grid.at(first), grid.at(last));
                if !options.shape.meets_box(low, high) || !sink.crop_meets(low, high) {
                    stats.blocks_outside += 1;
                } else if let Some(steepest) = options.steepest
                    && is_far_from_zero(field, low, high, steepest, &mut values)?
                {
                    stats.blocks_skipped += 1;
                } else {
                    let dims: [usize; 3] = std::array::from_fn(|j| last[j] - first[j] + 1);
                    field.sdf(low, grid.step, dims, &mut values)?;
                    sink.begin(first, last);
                    marcher
                        .march(&values, dims, &mut sink)
                        .map_err(|index| not_finite(&grid, options, first, dims, &values, index))?;
                    if options.steepest.is_some() {
                        stats.steepest = stats
                            .steepest
                            .max(steepest_slope(&values, dims) / grid.step);
                    }
                    if sink.mesh.positions.len() >= MAX_VERTICES {
                        let what = format!(
                            "the surface has more than {MAX_VERTICES} vertices; lower the resolution or crop"
                        );
                        return Err(Error::OutOfMemory { what });
                    }
                }
                let held = 4 * values.capacity() + marcher.bytes() + sink.border_bytes();
                stats.scratch_bytes = stats.scratch_bytes.max(held);
                done += 1;
                report(progress, Stage::Lattice, done, stats.blocks, &sink.mesh)?;
            }
            sink.forget_passed(block_y, block_z);
        }
    }
    let mut mesh = sink.mesh;
    super::clean::drop_unused_vertices(&mut mesh);
    tracing::info!(
        cells = ?stats.cells,
        blocks = stats.blocks,
        outside = stats.blocks_outside,
        skipped = stats.blocks_skipped,
        steepest = stats.steepest,
        scratch_bytes = stats.scratch_bytes,
        vertices = mesh.positions.len(),
        faces = mesh.faces.len(),
        "surface extracted"
    );
    Ok((mesh, stats))
}

/// Adds normals (from the gradient; from the faces where it vanishes) and colours to a mesh in the region frame.
///
/// # Errors
/// Those of the field, and `Interrupted`.
pub fn add_attributes(
    mesh: &mut Mesh,
    field: &mut impl SurfaceAttributes,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<()> {
    let n_vertices = mesh.positions.len();
    let mut normals = Vec::with_capacity(n_vertices);
    let mut colors = Vec::with_capacity(n_vertices);
    let mut points = Vec::with_capacity(n_vertices.min(ATTRIBUTE_CHUNK));
    for first in (0..n_vertices).step_by(ATTRIBUTE_CHUNK) {
        let last = (first + ATTRIBUTE_CHUNK).min(n_vertices);
        points.clear();
        points.extend(
            mesh.positions[first..last]
                .iter()
                .map(|p| p.as_vec3().to_array()),
        );
        let (rgb, gradients) = field.attributes(&points)?;
        assert_eq!(
            (rgb.len(), gradients.len()),
            (points.len(), points.len()),
            "attributes per point"
        );
        colors.extend(rgb.iter().map(|rgb| rgb.map(srgb::byte)));
        normals.extend(
            gradients
                .iter()
                .map(|g| Vec3::from(*g).normalize_or_zero().to_array()),
        );
        report(
            progress,
            Stage::Attributes,
            last as u64,
            n_vertices as u64,
            mesh,
        )?;
    }
    if normals.contains(&[0.0; 3]) {
        let of_faces = mesh.face_weighted_normals();
        for (normal, of_faces) in normals.iter_mut().zip(of_faces) {
            if *normal == [0.0; 3] {
                *normal = of_faces;
            }
        }
    }
    (mesh.normals, mesh.colors) = (normals, colors);
    Ok(())
}

/// Applies a similarity (or any affine map) to positions and normals; a mirror also turns the faces round.
pub fn to_world(mesh: &mut Mesh, world_from_region: DMat4) {
    for p in &mut mesh.positions {
        *p = world_from_region.transform_point3(*p);
    }
    let linear = DMat3::from_mat4(world_from_region);
    // Cofactor matrix: the inverse transpose times the determinant. Its sign makes mirrored normals point inward, so it is taken out.
    let sign = linear.determinant().signum();
    let cofactor = DMat3::from_cols(
        linear.y_axis.cross(linear.z_axis),
        linear.z_axis.cross(linear.x_axis),
        linear.x_axis.cross(linear.y_axis),
    );
    for normal in &mut mesh.normals {
        let turned = sign * (cofactor * DVec3::from(normal.map(f64::from)));
        *normal = turned.normalize_or_zero().as_vec3().to_array();
    }
    if sign < 0.0 {
        mesh.faces.iter_mut().for_each(|face| face.swap(1, 2));
    }
}

fn report(
    progress: &mut dyn FnMut(Progress) -> bool,
    stage: Stage,
    done: u64,
    total: u64,
    mesh: &Mesh,
) -> Result<()> {
    let (vertices, faces) = (mesh.positions.len() as u64, mesh.faces.len() as u64);
    if progress(Progress {
        stage,
        done,
        total,
        vertices,
        faces,
    }) {
        return Ok(());
    }
    Err(Error::Interrupted {
        what: format!("mesh extraction stopped after {done} of {total}; nothing was written"),
    })
}

fn not_finite(
    grid: &Grid,
    options: &ExtractOptions,
    first: [usize; 3],
    dims: [usize; 3],
    values: &[f32],
    index: usize,
) -> Error {
    let point = [
        index % dims[0],
        index / dims[0] % dims[1],
        index / dims[0] / dims[1],
    ];
    let p = options
        .world_from_region
        .transform_point3(grid.at(std::array::from_fn(|j| first[j] + point[j])));
    Error::Numerical {
        what: format!(
            "the signed distance at ({:.4}, {:.4}, {:.4}) is {}; take an earlier checkpoint, this one's parameters are damaged",
            p.x, p.y, p.z, values[index]
        ),
    }
}

/// Whether no point between `low` and `high` can be zero if the field's slope is at most `steepest`: true if at the centre of each of
/// `PROBES`³ sub-blocks the value is larger than what the way to its corner can undo.
fn is_far_from_zero(
    field: &mut impl Lattice,
    low: DVec3,
    high: DVec3,
    steepest: f64,
    values: &mut Vec<f32>,
) -> Result<bool> {
    let step = (high - low).max_element() / PROBES as f64;
    // A block cut short by the end of the lattice gets as many whole sub-blocks as cover it.
    let dims = ((high - low) / step - 1e-9)
        .ceil()
        .max(DVec3::ONE)
        .to_array()
        .map(|n| n as usize);
    field.sdf(low + 0.5 * step, step, dims, values)?;
    let reach = steepest * step * 0.75f64.sqrt();
    Ok(values.iter().all(|&value| f64::from(value.abs()) > reach))
}

/// Largest length of the forward difference vector.
fn steepest_slope(values: &[f32], [nx, ny, nz]: [usize; 3]) -> f64 {
    let mut largest = 0.0f32;
    for z in 0..nz - 1 {
        for y in 0..ny - 1 {
            let row = |dy: usize, dz: usize| &values[((z + dz) * ny + y + dy) * nx..][..nx];
            let (here, along_y, along_z) = (row(0, 0), row(1, 0), row(0, 1));
            for x in 0..nx - 1 {
                let d = [
                    here[x + 1] - here[x],
                    along_y[x] - here[x],
                    along_z[x] - here[x],
                ];
                largest = largest.max(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
            }
        }
    }
    f64::from(largest).sqrt()
}

/// Lattice points at `step · (first + i)`: exact in float32.
struct Grid {
    step: f64,
    first: [i64; 3],
    cells: [usize; 3],
}

impl Grid {
    fn new(options: &ExtractOptions) -> Result<Grid> {
        let half = options.shape.half_extents();
        let config = |what: String| Err(Error::Config { what });
        if !(half.is_finite() && half.min_element() > 0.0) {
            return config(format!("the region's half extents {half} must be positive"));
        }
        if !(2..=1 << 16).contains(&options.resolution) {
            return config(format!(
                "resolution {} must lie between 2 and 65536",
                options.resolution
            ));
        }
        if !(2..=512).contains(&options.block) {
            return config(format!(
                "block {} must lie between 2 and 512 cells",
                options.block
            ));
        }
        // Integers up to resolution/2 + 1 take this many bits; the step gets what is left of the 24 bits of a float32, rounded up.
        let index_bits = (options.resolution / 2 + 1).ilog2() as i32 + 1;
        let ideal = 2.0 * half.max_element() / f64::from(options.resolution);
        let unit = (ideal.log2().floor() - f64::from(24 - index_bits - 1)).exp2();
        let step = (ideal / unit).ceil() * unit;
        let reach: [i64; 3] = std::array::from_fn(|j| (half[j] / step).ceil() as i64);
        Ok(Grid {
            step,
            first: reach.map(|r| -r),
            cells: reach.map(|r| 2 * r as usize),
        })
    }

    /// Region-frame position of a lattice point counted from the first.
    fn at(&self, point: [usize; 3]) -> DVec3 {
        DVec3::from(std::array::from_fn(|j| {
            (self.first[j] + point[j] as i64) as f64 * self.step
        }))
    }
}

/// A lattice edge, counted from the lattice's first point.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Edge {
    point: [u32; 3],
    axis: u8,
}

/// Collects blocks' vertices and faces into one mesh.
struct BlockSink<'a> {
    options: &'a ExtractOptions,
    grid: &'a Grid,
    first: [usize; 3],
    last: [usize; 3],
    /// Vertices on the sides of blocks, as far as blocks still to come may ask for them.
    borders: HashMap<Edge, u32>,
    mesh: Mesh,
}

impl<'a> BlockSink<'a> {
    fn new(options: &'a ExtractOptions, grid: &'a Grid) -> Self {
        BlockSink {
            options,
            grid,
            first: [0; 3],
            last: [0; 3],
            borders: HashMap::new(),
            mesh: Mesh::default(),
        }
    }

    fn begin(&mut self, first: [usize; 3], last: [usize; 3]) {
        (self.first, self.last) = (first, last);
    }

    /// Drops border vertices that no block after this row can ask for.
    fn forget_passed(&mut self, block_y: usize, block_z: usize) {
        let end = |block: usize, axis: usize| {
            ((block + 1) * self.options.block).min(self.grid.cells[axis]) as u32
        };
        let (row_end, slab_end) = (end(block_y, 1), end(block_z, 2));
        self.borders
            .retain(|edge, _| edge.point[2] == slab_end || edge.point[1] >= row_end);
    }

    fn border_bytes(&self) -> usize {
        self.borders.capacity() * (size_of::<(Edge, u32)>() + 1)
    }

    /// Whether the world box around a box of the region frame meets the crop box.
    fn crop_meets(&self, low: DVec3, high: DVec3) -> bool {
        let Some([crop_low, crop_high]) = self.options.crop else {
            return true;
        };
        let corners: [DVec3; 8] = std::array::from_fn(|c| {
            let p = DVec3::from(std::array::from_fn(|j| {
                if c >> j & 1 == 1 { high[j] } else { low[j] }
            }));
            self.options.world_from_region.transform_point3(p)
        });
        let [world_low, world_high] = super::bounds(&corners).expect("eight corners");
        world_low.cmple(crop_high).all() && world_high.cmpge(crop_low).all()
    }

    /// The new vertex's id, or `OUTSIDE`. `at` is counted in cells from the lattice's first point.
    fn add(&mut self, at: [f64; 3]) -> u32 {
        let position = DVec3::from(std::array::from_fn(|j| {
            (self.grid.first[j] as f64 + at[j]) * self.grid.step
        }));
        let cropped = || {
            let world = self.options.world_from_region.transform_point3(position);
            self.options
                .crop
                .is_some_and(|[low, high]| world.cmplt(low).any() || world.cmpgt(high).any())
        };
        if !self.options.shape.contains(position)
            || cropped()
            || self.mesh.positions.len() >= MAX_VERTICES
        {
            return OUTSIDE;
        }
        self.mesh.positions.push(position);
        (self.mesh.positions.len() - 1) as u32
    }
}

impl Sink for BlockSink<'_> {
    fn edge_vertex(&mut self, point: [usize; 3], axis: usize, t: f64) -> u32 {
        let point: [usize; 3] = std::array::from_fn(|j| self.first[j] + point[j]);
        let on_border =
            (0..3).any(|j| j != axis && (point[j] == self.first[j] || point[j] == self.last[j]));
        let edge = Edge {
            point: point.map(|j| j as u32),
            axis: axis as u8,
        };
        if on_border && let Some(&id) = self.borders.get(&edge) {
            return id;
        }
        let mut at = point.map(|j| j as f64);
        at[axis] += t;
        let id = self.add(at);
        if on_border {
            self.borders.insert(edge, id);
        }
        id
    }

    fn inner_vertex(&mut self, cell: [usize; 3], offset: [f64; 3]) -> u32 {
        self.add(std::array::from_fn(|j| {
            (self.first[j] + cell[j]) as f64 + offset[j]
        }))
    }

    fn triangle(&mut self, vertices: [u32; 3]) {
        self.mesh.faces.push(vertices);
    }
}
