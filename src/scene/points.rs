//! Sparse points from the PLY file that a transforms.json names (`ply_file_path`): ASCII or binary, positions and colours.
//!
//! Only the element `vertex` is read; others may follow it, not precede it.

use std::path::Path;

use glam::DVec3;

use super::Point;
use crate::{Error, Result};

/// How a property is stored.
#[derive(Clone, Copy)]
enum Number {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Number {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Number::I8,
            "uchar" | "uint8" => Number::U8,
            "short" | "int16" => Number::I16,
            "ushort" | "uint16" => Number::U16,
            "int" | "int32" => Number::I32,
            "uint" | "uint32" => Number::U32,
            "float" | "float32" => Number::F32,
            "double" | "float64" => Number::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Number::I8 | Number::U8 => 1,
            Number::I16 | Number::U16 => 2,
            Number::I32 | Number::U32 | Number::F32 => 4,
            Number::F64 => 8,
        }
    }

    /// The value at the beginning of `data`, which holds at least `bytes()`.
    fn read(self, data: &[u8], big_endian: bool) -> f64 {
        let mut little = [0; 8];
        let bytes = self.bytes();
        little[..bytes].copy_from_slice(&data[..bytes]);
        if big_endian {
            little[..bytes].reverse();
        }
        let [a, b, c, d, ..] = little;
        match self {
            Number::I8 => f64::from(a as i8),
            Number::U8 => f64::from(a),
            Number::I16 => f64::from(i16::from_le_bytes([a, b])),
            Number::U16 => f64::from(u16::from_le_bytes([a, b])),
            Number::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Number::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Number::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Number::F64 => f64::from_le_bytes(little),
        }
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// What the header says of the vertices.
struct Header {
    encoding: Encoding,
    vertices: u64,
    /// Name and storage, in order.
    properties: Vec<(String, Number)>,
    /// Where the data begin.
    length: usize,
}

/// Reads the points of the PLY file at `path`. Those that are not finite are left out.
pub(super) fn read_ply(path: &Path) -> Result<Vec<Point>> {
    let data = std::fs::read(path).map_err(|source| Error::io(path, source))?;
    parse(&data).map_err(|what| {
        Error::input(
            path,
            what,
            "export the points again as a PLY file with x, y, z",
        )
    })
}

fn parse(data: &[u8]) -> std::result::Result<Vec<Point>, String> {
    let header = parse_header(data)?;
    let column = |name: &str| {
        header
            .properties
            .iter()
            .position(|(property, _)| property == name)
    };
    let axis =
        |name: &str| column(name).ok_or_else(|| format!("its vertices have no property {name}"));
    let axes = [axis("x")?, axis("y")?, axis("z")?];
    let channels = [column("red"), column("green"), column("blue")];
    let point = |values: &[f64]| {
        let color = channels.map(|channel| {
            let Some(column) = channel else { return 128 };
            let scale = match header.properties[column].1 {
                Number::F32 | Number::F64 => 255.0,
                _ => 1.0,
            };
            (values[column] * scale).clamp(0.0, 255.0).round() as u8
        });
        Point {
            position: DVec3::from(axes.map(|axis| values[axis])),
            color,
        }
    };
    let mut points = Vec::new();
    let mut keep = |values: &[f64]| {
        let point = point(values);
        if point.position.is_finite() {
            points.push(point);
        }
    };
    let mut values = vec![0.0; header.properties.len()];
    let body = &data[header.length..];
    if header.encoding == Encoding::Ascii {
        let text = String::from_utf8_lossy(body);
        let mut words = text.split_ascii_whitespace();
        for vertex in 0..header.vertices {
            for value in &mut values {
                let word = words.next().ok_or_else(|| {
                    format!("it ends within vertex {vertex} of {}", header.vertices)
                })?;
                *value = word
                    .parse()
                    .map_err(|_| format!("{word:?} in vertex {vertex} is not a number"))?;
            }
            keep(&values);
        }
        return Ok(points);
    }
    let stride: usize = header
        .properties
        .iter()
        .map(|(_, number)| number.bytes())
        .sum();
    if header.vertices > (body.len() / stride) as u64 {
        return Err(format!(
            "it says that it holds {} vertices of {stride} bytes, but only {} bytes follow its header",
            header.vertices,
            body.len()
        ));
    }
    for record in body.chunks_exact(stride).take(header.vertices as usize) {
        let mut at = 0;
        for (value, (_, number)) in values.iter_mut().zip(&header.properties) {
            *value = number.read(&record[at..], header.encoding == Encoding::BigEndian);
            at += number.bytes();
        }
        keep(&values);
    }
    Ok(points)
}

fn parse_header(data: &[u8]) -> std::result::Result<Header, String> {
    let mut header = Header {
        encoding: Encoding::Ascii,
        vertices: 0,
        properties: Vec::new(),
        length: 0,
    };
    let (mut element, mut known) = (String::new(), false);
    for (number, line) in data.split_inclusive(|byte| *byte == b'\n').enumerate() {
        header.length += line.len();
        let line = String::from_utf8_lossy(line);
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        if number == 0 && words != ["ply"] {
            return Err("it is no PLY file: it does not begin with ply".into());
        }
        match words.as_slice() {
            ["format", "ascii", _] => known = true,
            ["format", "binary_little_endian", _] => {
                (header.encoding, known) = (Encoding::LittleEndian, true)
            }
            ["format", "binary_big_endian", _] => {
                (header.encoding, known) = (Encoding::BigEndian, true)
            }
            ["element", name, count] => {
                if *name != "vertex" && element.is_empty() {
                    return Err(format!(
                        "its first element is {name}; vertex has to come first"
                    ));
                }
                element = (*name).to_owned();
                if element == "vertex" {
                    header.vertices = count
                        .parse()
                        .map_err(|_| format!("{count:?} is no number of vertices"))?;
                }
            }
            ["property", "list", ..] if element == "vertex" => {
                return Err("its vertices hold a list".into());
            }
            ["property", kind, name] if element == "vertex" => {
                let kind =
                    Number::named(kind).ok_or_else(|| format!("{kind:?} is no property type"))?;
                header.properties.push(((*name).to_owned(), kind));
            }
            ["end_header"] if known && !header.properties.is_empty() => return Ok(header),
            ["end_header"] => {
                return Err("its header names no format or no vertex properties".into());
            }
            _ => {}
        }
    }
    Err("its header has no end".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "element vertex 2\nproperty float x\nproperty float y\nproperty double z\nproperty uchar red\n\
                          property uchar green\nproperty uchar blue\nend_header\n";

    fn wanted() -> Vec<Point> {
        vec![
            Point {
                position: DVec3::new(1.0, -2.0, 0.5),
                color: [10, 20, 30],
            },
            Point {
                position: DVec3::new(4.0, 5.0, 6.0),
                color: [255, 0, 7],
            },
        ]
    }

    fn binary(big_endian: bool) -> Vec<u8> {
        let name = if big_endian {
            "binary_big_endian"
        } else {
            "binary_little_endian"
        };
        let mut data = format!("ply\nformat {name} 1.0\n{HEADER}").into_bytes();
        for point in wanted() {
            let [x, y] = [point.position.x as f32, point.position.y as f32];
            let z = point.position.z;
            if big_endian {
                data.extend([x.to_be_bytes(), y.to_be_bytes()].concat());
                data.extend(z.to_be_bytes());
            } else {
                data.extend([x.to_le_bytes(), y.to_le_bytes()].concat());
                data.extend(z.to_le_bytes());
            }
            data.extend(point.color);
        }
        data
    }

    #[test]
    fn all_encodings_read_the_same() {
        let ascii = format!("ply\nformat ascii 1.0\n{HEADER}1 -2 0.5 10 20 30\n4 5 6 255 0 7\n");
        assert_eq!(parse(ascii.as_bytes()).unwrap(), wanted());
        assert_eq!(parse(&binary(false)).unwrap(), wanted());
        assert_eq!(parse(&binary(true)).unwrap(), wanted());
    }

    #[test]
    fn what_is_cut_short_is_refused() {
        let whole = binary(false);
        for length in 0..whole.len() {
            assert!(
                parse(&whole[..length]).is_err(),
                "{length} of {} bytes",
                whole.len()
            );
        }
        let hostile = format!("ply\nformat binary_little_endian 1.0\n{HEADER}")
            .replace("vertex 2", "vertex 99999999999999");
        assert!(
            parse(hostile.as_bytes())
                .unwrap_err()
                .contains("99999999999999")
        );
    }
}
