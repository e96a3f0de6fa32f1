//! Reading meshes and point clouds: PLY (ASCII, binary of either byte order) and OBJ. Files are not trusted: every count is held against
//! the bytes that are there before anything is allocated, every index against the vertices.

use std::path::Path;

use glam::DVec3;

use super::Mesh;
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

/// What is wrong with a file.
type Parsed<T> = std::result::Result<T, String>;

#[derive(Clone, Copy, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &str) -> Parsed<Scalar> {
        Ok(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return Err(format!("unknown property type '{name}'")),
        })
    }

    fn bytes(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    /// What 1.0 is as a colour channel.
    fn full(self) -> f64 {
        match self {
            Scalar::I8 | Scalar::U8 => 255.0,
            Scalar::I16 | Scalar::U16 => 65535.0,
            Scalar::I32 | Scalar::U32 => f64::from(u32::MAX),
            Scalar::F32 | Scalar::F64 => 1.0,
        }
    }
}

struct Property {
    name: String,
    /// Type of the length, for lists.
    length: Option<Scalar>,
    scalar: Scalar,
}

struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

/// The values after the header, one after the other.
enum Values<'a> {
    Ascii(std::str::SplitAsciiWhitespace<'a>),
    Binary { rest: &'a [u8], little: bool },
}

impl Values<'_> {
    fn next(&mut self, scalar: Scalar) -> Parsed<f64> {
        match self {
            Values::Ascii(words) => {
                let word = words.next().ok_or("ends in the middle of its values")?;
                word.parse()
                    .map_err(|_| format!("'{word:.40}' is not a number"))
            }
            Values::Binary { rest, little } => {
                let (value, after) = rest
                    .split_at_checked(scalar.bytes())
                    .ok_or("ends in the middle of its values")?;
                *rest = after;
                let mut wide = [0; 8];
                wide[..value.len()].copy_from_slice(value);
                if !*little {
                    wide[..value.len()].reverse();
                }
                let bits = u64::from_le_bytes(wide);
                Ok(match scalar {
                    Scalar::I8 => f64::from(bits as u8 as i8),
                    Scalar::U8 => f64::from(bits as u8),
                    Scalar::I16 => f64::from(bits as u16 as i16),
                    Scalar::U16 => f64::from(bits as u16),
                    Scalar::I32 => f64::from(bits as u32 as i32),
                    Scalar::U32 => f64::from(bits as u32),
                    Scalar::F32 => f64::from(f32::from_bits(bits as u32)),
                    Scalar::F64 => f64::from_bits(bits),
                })
            }
        }
    }
}

fn parse_ply(bytes: &[u8]) -> Parsed<Mesh> {
    let (format, elements, body) = ply_header(bytes)?;
    let mut values = match format.as_str() {
        "ascii" => Values::Ascii(
            std::str::from_utf8(body)
                .map_err(|_| "is not text after an ASCII header")?
                .split_ascii_whitespace(),
        ),
        "binary_little_endian" => Values::Binary {
            rest: body,
            little: true,
        },
        "binary_big_endian" => Values::Binary {
            rest: body,
            little: false,
        },
        _ => return Err(format!("unknown format '{format:.40}'")),
    };
    // An item takes at least this many bytes: of binary values their sizes, of ASCII ones a digit and a blank (the last has none).
    let is_text = matches!(values, Values::Ascii(_));
    for element in &elements {
        let smallest: usize = element
            .properties
            .iter()
            .map(|p| p.length.unwrap_or(p.scalar))
            .map(|s| if is_text { 2 } else { s.bytes() })
            .sum();
        if smallest == 0 && element.count > 0 {
            return Err(format!("the element '{}' has no properties", element.name));
        }
        if element.count.saturating_mul(smallest as u64) > body.len() as u64 + u64::from(is_text) {
            return Err(format!(
                "promises {} of '{}', which do not fit its {} bytes",
                element.count,
                element.name,
                body.len()
            ));
        }
    }
    let mut mesh = Mesh::default();
    let mut found_vertices = false;
    for element in &elements {
        match element.name.as_str() {
            "vertex" if !found_vertices => {
                found_vertices = true;
                ply_vertices(element, &mut values, &mut mesh)?;
            }
            "face" => ply_faces(element, &mut values, &mut mesh)?,
            _ => {
                for _ in 0..element.count {
                    for property in &element.properties {
                        let length = property
                            .length
                            .map_or(Ok(1.0), |length| values.next(length))?;
                        for _ in 0..length as u64 {
                            values.next(property.scalar)?;
                        }
                    }
                }
            }
        }
    }
    if !found_vertices {
        return Err("has no element 'vertex'".into());
    }
    check_faces(&mesh)?;
    Ok(mesh)
}

/// Format, elements, and what follows the header.
fn ply_header(bytes: &[u8]) -> Parsed<(String, Vec<Element>, &[u8])> {
    let mut rest = bytes;
    let mut line = || -> Parsed<&str> {
        let end = rest
            .iter()
            .take(4096)
            .position(|&b| b == b'\n')
            .ok_or("has no PLY header that ends")?;
        let line =
            std::str::from_utf8(&rest[..end]).map_err(|_| "has a header that is not text")?;
        rest = &rest[end + 1..];
        Ok(line.trim())
    };
    if line()? != "ply" {
        return Err("does not begin with 'ply'".into());
    }
    let mut format = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let line = line()?;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["end_header"] => break,
            ["format", name, _] => format = Some(name.to_string()),
            ["element", name, count] => {
                let count = count
                    .parse()
                    .map_err(|_| format!("'{line:.80}' has no count"))?;
                elements.push(Element {
                    name: name.into(),
                    count,
                    properties: Vec::new(),
                });
            }
            ["property", ref kind @ .., name] => {
                let element = elements
                    .last_mut()
                    .ok_or("has a property before any element")?;
                let (length, scalar) = match *kind {
                    [scalar] => (None, Scalar::named(scalar)?),
                    ["list", length, scalar] => {
                        (Some(Scalar::named(length)?), Scalar::named(scalar)?)
                    }
                    _ => return Err(format!("'{line:.80}' is no property")),
                };
                element.properties.push(Property {
                    name: name.into(),
                    length,
                    scalar,
                });
            }
            ["comment" | "obj_info", ..] | [] => {}
            _ => return Err(format!("'{line:.80}' does not belong in a PLY header")),
        }
    }
    Ok((format.ok_or("has no format")?, elements, rest))
}

fn ply_vertices(element: &Element, values: &mut Values, mesh: &mut Mesh) -> Parsed<()> {
    let find = |names: [&str; 3]| {
        let at = names.map(|name| {
            element
                .properties
                .iter()
                .position(|p| p.name == name && p.length.is_none())
        });
        Some([at[0]?, at[1]?, at[2]?])
    };
    let position = find(["x", "y", "z"]).ok_or("has vertices without x, y, z")?;
    let normal = find(["nx", "ny", "nz"]);
    let color = find(["red", "green", "blue"]).or_else(|| find(["r", "g", "b"]));
    let count = element.count as usize;
    mesh.positions.reserve_exact(count);
    mesh.normals
        .reserve_exact(if normal.is_some() { count } else { 0 });
    mesh.colors
        .reserve_exact(if color.is_some() { count } else { 0 });
    let mut row = vec![0.0; element.properties.len()];
    for vertex in 0..count {
        for (value, property) in row.iter_mut().zip(&element.properties) {
            match property.length {
                None => *value = values.next(property.scalar)?,
                Some(length) => {
                    for _ in 0..values.next(length)? as u64 {
                        values.next(property.scalar)?;
                    }
                }
            }
        }
        let p = DVec3::from(position.map(|i| row[i]));
        if !p.is_finite() {
            return Err(format!("vertex {vertex} is at {p}"));
        }
        mesh.positions.push(p);
        mesh.normals
            .extend(normal.map(|at| at.map(|i| row[i] as f32)));
        mesh.colors.extend(
            color.map(|at| at.map(|i| srgb::byte(row[i] / element.properties[i].scalar.full()))),
        );
    }
    Ok(())
}

fn ply_faces(element: &Element, values: &mut Values, mesh: &mut Mesh) -> Parsed<()> {
    // A file can promise faces of no corners at a byte each: room for the rest is made as they come.
    mesh.faces.reserve(element.count.min(1 << 16) as usize);
    let mut polygon = Vec::new();
    for face in 0..element.count {
        for property in &element.properties {
            let is_polygon = matches!(property.name.as_str(), "vertex_indices" | "vertex_index");
            let length = property
                .length
                .map_or(Ok(1.0), |length| values.next(length))?;
            polygon.clear();
            for _ in 0..length as u64 {
                let index = values.next(property.scalar)?;
                if !is_polygon {
                    continue;
                }
                if !(0.0..f64::from(u32::MAX)).contains(&index) || index.fract() != 0.0 {
                    return Err(format!("face {face} names vertex {index}"));
                }
                polygon.push(index as u32);
            }
            if is_polygon {
                add_fan(&polygon, &mut mesh.faces);
            }
        }
    }
    Ok(())
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
