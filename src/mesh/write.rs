//! Writing meshes: binary PLY, OBJ, and GLB (glTF 2.0), chosen by the file's extension.
//!
//! A file appears whole or not at all. Colours are sRGB bytes in PLY (`red green blue`), sRGB fractions after the position in OBJ, and
//! linear 16-bit `COLOR_0` in GLB, as its specification wants.

use std::io::Write;
use std::path::Path;

use glam::DVec3;
use serde_json::json;

use super::{Mesh, bounds};
use crate::destination;
use crate::ply::{self, Element, Scalar};
use crate::{Error, Result, srgb};

/// File formats that meshes are written in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshFormat {
    Ply,
    Obj,
    Glb,
}

impl MeshFormat {
    /// The format that the extension names.
    ///
    /// # Errors
    /// `Output` for any other extension.
    pub fn of(path: &Path) -> Result<MeshFormat> {
        let extension = path
            .extension()
            .and_then(|e| e.to_str())
            .unwrap_or("")
            .to_ascii_lowercase();
        match extension.as_str() {
            "ply" => Ok(MeshFormat::Ply),
            "obj" => Ok(MeshFormat::Obj),
            "glb" => Ok(MeshFormat::Glb),
            _ => Err(Error::output(
                path,
                format!("no mesh format is called '{extension}'"),
                "name it .ply, .obj or .glb",
            )),
        }
    }
}

/// Whether a mesh can be written to `path`, before any work is done for it.
///
/// # Errors
/// `Output` if the extension is unknown, the folder is missing, or the file exists and `force` is not set.
pub fn check_destination(path: &Path, force: bool) -> Result<MeshFormat> {
    let format = MeshFormat::of(path)?;
    destination::check(path, force)?;
    Ok(format)
}

/// Writes `mesh` to `path`; an existing file is replaced only with `force`.
///
/// # Errors
/// See [`check_destination`]; `Output` also when the disk is full or the folder is read-only; the file is then as it was before.
pub fn write_mesh(path: &Path, mesh: &Mesh, force: bool) -> Result<()> {
    let format = check_destination(path, force)?;
    assert!(
        mesh.normals.is_empty() || mesh.normals.len() == mesh.positions.len(),
        "one normal per vertex, or none"
    );
    assert!(
        mesh.colors.is_empty() || mesh.colors.len() == mesh.positions.len(),
        "one colour per vertex, or none"
    );
    if format == MeshFormat::Glb && glb_bytes(mesh) > u64::from(u32::MAX) {
        return Err(Error::output(
            path,
            format!(
                "{} bytes do not fit the 4 GiB of a GLB file",
                glb_bytes(mesh)
            ),
            "write a .ply",
        ));
    }
    destination::write(path, force, |mut out| match format {
        MeshFormat::Ply => ply(&mut out, mesh),
        MeshFormat::Obj => obj(&mut out, mesh),
        MeshFormat::Glb => glb(&mut out, mesh),
    })?;
    tracing::info!(
        file = %path.display(),
        vertices = mesh.positions.len(),
        faces = mesh.faces.len(),
        "mesh written"
    );
    Ok(())
}

/// Whether float32 would move vertices by more than a hundred-thousandth of the mesh's size: georeferenced coordinates, for example.
fn needs_f64(mesh: &Mesh) -> bool {
    bounds(&mesh.positions).is_some_and(|[low, high]| {
        let reach = low.abs().max(high.abs()).max_element();
        reach * f64::from(f32::EPSILON) > 1e-5 * (high - low).max_element()
    })
}

fn ply(out: &mut impl Write, mesh: &Mesh) -> std::io::Result<()> {
    let real = match needs_f64(mesh) {
        true => Scalar::F64,
        false => Scalar::F32,
    };
    let mut vertex = Element::new("vertex", mesh.positions.len()).with(real, &["x", "y", "z"]);
    if !mesh.normals.is_empty() {
        vertex = vertex.with(Scalar::F32, &["nx", "ny", "nz"]);
    }
    if !mesh.colors.is_empty() {
        vertex = vertex.with(Scalar::U8, &["red", "green", "blue"]);
    }
    let mut elements = vec![vertex];
    if !mesh.faces.is_empty() {
        let face = Element::new("face", mesh.faces.len());
        elements.push(face.with_list(Scalar::U8, Scalar::I32, "vertex_indices"));
    }
    ply::write(out, "neurodin", &elements, |element, index, values| {
        if element == "face" {
            values.push(3.0);
            values.extend(mesh.faces[index].map(f64::from));
            return;
        }
        values.extend(mesh.positions[index].to_array());
        if let Some(normal) = mesh.normals.get(index) {
            values.extend(normal.map(f64::from));
        }
        if let Some(color) = mesh.colors.get(index) {
            values.extend(color.map(f64::from));
        }
    })
}

fn obj(out: &mut impl Write, mesh: &Mesh) -> std::io::Result<()> {
    writeln!(
        out,
        "# neurodin: {} vertices, {} faces",
        mesh.positions.len(),
        mesh.faces.len()
    )?;
    let wide = needs_f64(mesh);
    for (vertex, p) in mesh.positions.iter().enumerate() {
        if wide {
            write!(out, "v {} {} {}", p.x, p.y, p.z)?;
        } else {
            let p = p.as_vec3();
            write!(out, "v {} {} {}", p.x, p.y, p.z)?;
        }
        match mesh
            .colors
            .get(vertex)
            .map(|color| color.map(|channel| f64::from(channel) / 255.0))
        {
            Some([r, g, b]) => writeln!(out, " {r:.4} {g:.4} {b:.4}")?,
            None => writeln!(out)?,
        }
    }
    for [x, y, z] in &mesh.normals {
        writeln!(out, "vn {x} {y} {z}")?;
    }
    for face in &mesh.faces {
        let [a, b, c] = face.map(|vertex| u64::from(vertex) + 1);
        if mesh.normals.is_empty() {
            writeln!(out, "f {a} {b} {c}")?;
        } else {
            writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
        }
    }
    Ok(())
}

/// Upper bound of the size of the GLB file.
fn glb_bytes(mesh: &Mesh) -> u64 {
    let vertex = 12
        + if mesh.normals.is_empty() { 0 } else { 12 }
        + if mesh.colors.is_empty() { 0 } else { 8 };
    mesh.positions.len() as u64 * vertex + mesh.faces.len() as u64 * 12 + 4096
}

/// One buffer: indices, positions, normals, colours; each a buffer view of its own.
fn glb(out: &mut impl Write, mesh: &Mesh) -> std::io::Result<()> {
    const FLOAT: u32 = 5126;
    const UNSIGNED_INT: u32 = 5125;
    const UNSIGNED_SHORT: u32 = 5123;
    let n_vertices = mesh.positions.len();
    // Positions are float32 in glTF; far from the origin they are relative to a node's translation.
    let [low, high] = bounds(&mesh.positions).unwrap_or_default();
    let center = if needs_f64(mesh) {
        ((low + high) / 2.0).round()
    } else {
        DVec3::ZERO
    };
    let local = |p: DVec3| (p - center).as_vec3();

    let (mut views, mut accessors, mut attributes) = (Vec::new(), Vec::new(), json!({}));
    let mut length = 0;
    let mut add = |bytes: usize, target: u32, accessor: serde_json::Value| {
        views.push(
            json!({ "buffer": 0, "byteOffset": length, "byteLength": bytes, "target": target }),
        );
        let mut accessor = accessor;
        accessor["bufferView"] = json!(views.len() - 1);
        accessors.push(accessor);
        length += bytes;
        accessors.len() - 1
    };
    const ARRAY: u32 = 34962;
    const ELEMENT_ARRAY: u32 = 34963;
    let mut primitive = json!({ "mode": if mesh.faces.is_empty() { 0 } else { 4 }, "material": 0 });
    if !mesh.faces.is_empty() {
        let count = 3 * mesh.faces.len();
        primitive["indices"] = json!(add(
            4 * count,
            ELEMENT_ARRAY,
            json!({ "componentType": UNSIGNED_INT, "count": count, "type": "SCALAR" })
        ));
    }
    if n_vertices > 0 {
        let (min, max) = (local(low).to_array(), local(high).to_array());
        let accessor = json!({ "componentType": FLOAT, "count": n_vertices, "type": "VEC3", "min": min, "max": max });
        attributes["POSITION"] = json!(add(12 * n_vertices, ARRAY, accessor));
    }
    if !mesh.normals.is_empty() {
        attributes["NORMAL"] = json!(add(
            12 * n_vertices,
            ARRAY,
            json!({ "componentType": FLOAT, "count": n_vertices, "type": "VEC3" })
        ));
    }
    if !mesh.colors.is_empty() {
        let accessor = json!({ "componentType": UNSIGNED_SHORT, "normalized": true, "count": n_vertices, "type": "VEC4" });
        attributes["COLOR_0"] = json!(add(8 * n_vertices, ARRAY, accessor));
    }
    primitive["attributes"] = attributes;
    let mut document = json!({
        "asset": { "version": "2.0", "generator": "neurodin" },
        "scene": 0,
        "scenes": [{}],
    });
    if n_vertices > 0 {
        document["scenes"] = json!([{ "nodes": [0] }]);
        document["nodes"] = json!([{ "mesh": 0, "translation": center.to_array() }]);
        document["meshes"] = json!([{ "primitives": [primitive] }]);
        let surface = json!({ "metallicFactor": 0.0, "roughnessFactor": 1.0 });
        document["materials"] = json!([{ "pbrMetallicRoughness": surface, "doubleSided": true }]);
        document["accessors"] = json!(accessors);
        document["bufferViews"] = json!(views);
        document["buffers"] = json!([{ "byteLength": length }]);
    }
    let mut text = document.to_string();
    while !text.len().is_multiple_of(4) {
        text.push(' ');
    }
    let binary_chunk = if length > 0 { 8 + length } else { 0 };
    let mut word = |value: usize| out.write_all(&(value as u32).to_le_bytes());
    word(0x4654_6c67)?; // "glTF"
    word(2)?;
    word(12 + 8 + text.len() + binary_chunk)?;
    word(text.len())?;
    word(0x4e4f_534a)?; // "JSON"
    out.write_all(text.as_bytes())?;
    if length == 0 {
        return Ok(());
    }
    out.write_all(&(length as u32).to_le_bytes())?;
    out.write_all(b"BIN\0")?;
    for face in &mesh.faces {
        out.write_all(bytemuck::bytes_of(&face.map(u32::to_le_bytes)))?;
    }
    for &p in &mesh.positions {
        out.write_all(bytemuck::bytes_of(
            &local(p).to_array().map(f32::to_le_bytes),
        ))?;
    }
    for normal in &mesh.normals {
        out.write_all(bytemuck::bytes_of(&normal.map(f32::to_le_bytes)))?;
    }
    let linear: [u16; 256] =
        std::array::from_fn(|byte| (65535.0 * srgb::decode(byte as u8)).round() as u16);
    for color in &mesh.colors {
        let [r, g, b] = color.map(|channel| linear[channel as usize].to_le_bytes());
        out.write_all(bytemuck::bytes_of(&[r, g, b, [0xff, 0xff]]))?;
    }
    Ok(())
}
