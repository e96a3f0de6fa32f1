//! Reading meshes and point clouds: PLY (ASCII, binary of either byte order) and OBJ. Files are not trusted: every count is held against
//! the bytes that are there before anything is allocated, every index against the vertices.

use std::path::Path;

use glam::DVec3;

use super::Mesh;
use crate::ply::{self, Element, Parsed, Values};
use crate::{Error, Result, srgb};

/// Reads a mesh, or a point cloud where there are no faces. Polygons are cut into fans. Normals and colours are kept if every vertex has
/// them.
///
/// # Errors
/// `Input` for a file that cannot be read, an unknown extension, or a damaged file, with the place.
pub fn read_mesh(path: &Path) -> Result<Mesh> {
    let extension = path
        .extension()
        .and_then(|e| e.to_str())
        .unwrap_or("")
        .to_ascii_lowercase();
    let parse = match extension.as_str() {
        "ply" => parse_ply,
        "obj" => parse_obj,
        _ => {
            let what = format!("meshes are read from .ply and .obj, not from '{extension}'");
            return Err(Error::input(
                path,
                what,
                "convert it to PLY, for example with MeshLab or Blender",
            ));
        }
    };
    let bytes = std::fs::read(path).map_err(|error| Error::unreadable(path, &error))?;
    parse(&bytes).map_err(|what| {
        Error::input(
            path,
            what,
            "export the mesh again; the file is damaged or of another kind",
        )
    })
}

fn parse_ply(bytes: &[u8]) -> Parsed<Mesh> {
    let (elements, mut values) = ply::read(bytes)?;
    let mut mesh = Mesh::default();
    let mut found_vertices = false;
    for element in &elements {
        match element.name.as_str() {
            "vertex" if !found_vertices => {
                found_vertices = true;
                ply_vertices(element, &mut values, &mut mesh)?;
            }
            "face" => ply_faces(element, &mut values, &mut mesh)?,
            _ => values.skip(element)?,
        }
    }
    if !found_vertices {
        return Err("has no element 'vertex'".into());
    }
    check_faces(&mesh)?;
    Ok(mesh)
}

fn ply_vertices(element: &Element, values: &mut Values, mesh: &mut Mesh) -> Parsed<()> {
    let position = element.position()?;
    let normal = element.columns(["nx", "ny", "nz"]);
    let color = element.color();
    values.check(element)?;
    let count = element.count as usize;
    mesh.positions.reserve_exact(count);
    mesh.normals
        .reserve_exact(if normal.is_some() { count } else { 0 });
    mesh.colors
        .reserve_exact(if color.is_some() { count } else { 0 });
    values.read(element, |number, vertex| {
        let p = DVec3::from(position.map(|axis| vertex.number(axis)));
        if !p.is_finite() {
            return Err(format!("vertex {number} is at {p}"));
        }
        mesh.positions.push(p);
        mesh.normals
            .extend(normal.map(|at| at.map(|axis| vertex.number(axis) as f32)));
        mesh.colors.extend(
            color.map(|at| at.map(|channel| element.channel(channel, vertex.number(channel)))),
        );
        Ok(())
    })
}

fn ply_faces(element: &Element, values: &mut Values, mesh: &mut Mesh) -> Parsed<()> {
    // A file can promise faces of no corners at a byte each: room for the rest is made as they come.
    mesh.faces.reserve(element.count.min(1 << 16) as usize);
    let polygons: Vec<usize> = (0..element.properties.len())
        .filter(|&at| {
            let name = element.properties[at].name.as_str();
            matches!(name, "vertex_indices" | "vertex_index")
        })
        .collect();
    let mut polygon = Vec::new();
    values.read(element, |number, face| {
        for &property in &polygons {
            polygon.clear();
            for &index in face.list(property) {
                if !(0.0..f64::from(u32::MAX)).contains(&index) || index.fract() != 0.0 {
                    return Err(format!("face {number} names vertex {index}"));
                }
                polygon.push(index as u32);
            }
            add_fan(&polygon, &mut mesh.faces);
        }
        Ok(())
    })
}

fn parse_obj(bytes: &[u8]) -> Parsed<Mesh> {
    let mut mesh = Mesh::default();
    let mut file_normals: Vec<[f32; 3]> = Vec::new();
    // (vertex, normal in the file) pairs of the faces
    let mut normal_of: Vec<(u32, u32)> = Vec::new();
    let mut polygon = Vec::new();
    for (number, line) in bytes.split(|&b| b == b'\n').enumerate() {
        let place = |what: &str| format!("line {}: {what}", number + 1);
        let Ok(line) = std::str::from_utf8(line) else {
            continue;
        }; // names may be in any encoding
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("v") => {
                let mut numbers = [0.0f64; 6];
                let mut count = 0;
                for (number, word) in numbers.iter_mut().zip(words) {
                    *number = word
                        .parse()
                        .map_err(|_| place(&format!("'{word:.40}' is not a number")))?;
                    count += 1;
                }
                let [x, y, z, r, g, b] = numbers;
                if count < 3 || !DVec3::new(x, y, z).is_finite() {
                    return Err(place("a vertex needs three finite coordinates"));
                }
                mesh.positions.push(DVec3::new(x, y, z));
                if count == 6 {
                    mesh.colors.push([r, g, b].map(srgb::byte));
                }
            }
            Some("vn") => {
                let mut normal = [0.0f32; 3];
                for (value, word) in normal.iter_mut().zip(words) {
                    *value = word
                        .parse()
                        .map_err(|_| place(&format!("'{word:.40}' is not a number")))?;
                }
                file_normals.push(normal);
            }
            Some("f") => {
                polygon.clear();
                for word in words {
                    let mut indices = word.split('/');
                    let mut index = |count: usize| -> Parsed<Option<u32>> {
                        let Some(text) = indices.next().filter(|text| !text.is_empty()) else {
                            return Ok(None);
                        };
                        let index: i64 = text
                            .parse()
                            .map_err(|_| place(&format!("'{word:.40}' is no corner")))?;
                        // From 1 on, or back from the last.
                        let zero_based = if index < 0 {
                            count as i64 + index
                        } else {
                            index - 1
                        };
                        u32::try_from(zero_based)
                            .map(Some)
                            .map_err(|_| place(&format!("'{word:.40}' names no vertex")))
                    };
                    let vertex = index(mesh.positions.len())?
                        .ok_or_else(|| place("a corner without a vertex"))?;
                    index(0).ok(); // texture coordinates are not read
                    if let Some(normal) = index(file_normals.len())? {
                        normal_of.push((vertex, normal));
                    }
                    polygon.push(vertex);
                }
                add_fan(&polygon, &mut mesh.faces);
            }
            _ => {}
        }
    }
    check_faces(&mesh)?;
    if mesh.colors.len() != mesh.positions.len() {
        mesh.colors = Vec::new();
    }
    if !normal_of.is_empty() {
        let mut normals = vec![None; mesh.positions.len()];
        for (vertex, normal) in normal_of {
            if let Some(of_vertex) = normals.get_mut(vertex as usize) {
                *of_vertex = file_normals.get(normal as usize).copied();
            }
        }
        mesh.normals = normals
            .into_iter()
            .collect::<Option<_>>()
            .unwrap_or_default();
    }
    Ok(mesh)
}

fn add_fan(polygon: &[u32], faces: &mut Vec<[u32; 3]>) {
    faces.extend((2..polygon.len()).map(|i| [polygon[0], polygon[i - 1], polygon[i]]));
}

fn check_faces(mesh: &Mesh) -> Parsed<()> {
    let n_vertices = mesh.positions.len();
    if n_vertices > u32::MAX as usize {
        return Err(format!(
            "has {n_vertices} vertices, more than 32 bits can count"
        ));
    }
    let bad = mesh
        .faces
        .as_flattened()
        .iter()
        .position(|&vertex| vertex as usize >= n_vertices);
    bad.map_or(Ok(()), |corner| {
        let vertex = mesh.faces.as_flattened()[corner];
        Err(format!(
            "triangle {} names vertex {vertex} of {n_vertices}",
            corner / 3
        ))
    })
}
