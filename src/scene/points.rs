//! Sparse points from the PLY file that a transforms.json names (`ply_file_path`): positions and colours of its vertices.

use std::path::Path;

use glam::DVec3;

use super::Point;
use crate::ply::{self, Parsed};
use crate::{Error, Result};

/// Reads the points of the PLY file at `path`. Those that are not finite are left out.
pub(super) fn read_ply(path: &Path) -> Result<Vec<Point>> {
    let data = std::fs::read(path).map_err(|error| Error::unreadable(path, &error))?;
    parse(&data).map_err(|what| {
        Error::input(
            path,
            what,
            "export the points again as a PLY file with x, y, z",
        )
    })
}

fn parse(data: &[u8]) -> Parsed<Vec<Point>> {
    let (elements, mut values) = ply::read(data)?;
    for element in &elements {
        if element.name != "vertex" {
            values.skip(element)?;
            continue;
        }
        let position = element.position()?;
        let color = element.color();
        let mut points = Vec::new();
        values.read(element, |_, vertex| {
            let position = DVec3::from(position.map(|axis| vertex.number(axis)));
            let color = color.map_or([128; 3], |channels| {
                channels.map(|channel| element.channel(channel, vertex.number(channel)))
            });
            if position.is_finite() {
                points.push(Point { position, color });
            }
            Ok(())
        })?;
        return Ok(points);
    }
    Err("has no element 'vertex'".into())
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

    #[test]
    fn what_stands_beside_the_vertices_does_not_matter() {
        let text = format!("ply\nformat ascii 1.0\n{HEADER}1 -2 0.5 10 20 30\n4 5 6 255 0 7\n");
        let before = text
            .replace(
                "element vertex",
                "element camera 1\nproperty list int float of\nelement vertex",
            )
            .replace("header\n", "header\n2 0.5 7\n");
        assert_eq!(parse(before.as_bytes()).unwrap(), wanted());
        let list = text
            .replace(
                "property double z",
                "property list uchar int seen\nproperty double z",
            )
            .replace("-2", "-2 3 7 8 9")
            .replace("5 6", "5 0 6");
        assert_eq!(parse(list.as_bytes()).unwrap(), wanted());
        // What follows is not read, and may be as strange as it likes; so may a header's other lines.
        let after = text.replace(
            "end_header",
            "made by hand\nelement thing many\nproperty int128 x\nelement face 9\nend_header",
        );
        assert_eq!(parse(after.as_bytes()).unwrap(), wanted());
        // Without a place there is no point; without a colour it is grey.
        let bare = text.replace("blue", "azure").replace("4 5 6", "nan 5 6");
        let points = parse(bare.as_bytes()).unwrap();
        assert_eq!((points.len(), points[0].color), (1, [128; 3]));
    }
}
