//! Meshes on disk and their cleaning: round trips, refusals, hostile files, components.

use std::fs;
use std::path::Path;
use std::sync::OnceLock;

use glam::DVec3;
use neurodin::Error;
use neurodin::mesh::clean::{components, drop_small, keep_largest};
use neurodin::mesh::{Mesh, read_mesh, write_mesh};
use proptest::prelude::*;
use serde_json::Value;

/// A sphere of triangles: an octahedron whose faces are cut into `n`² pieces.
fn ball(center: DVec3, radius: f64, n: u32) -> Mesh {
    let mut mesh = Mesh::default();
    let sides = [DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y];
    for top in [DVec3::Z, DVec3::NEG_Z] {
        for i in 0..4 {
            let (mut a, mut b) = (sides[i], sides[(i + 1) % 4]);
            if top.z < 0.0 {
                std::mem::swap(&mut a, &mut b);
            }
            let first = mesh.positions.len() as u32;
            let mut at = |row: u32, column: u32| {
                let (u, v) = (
                    f64::from(column) / f64::from(n),
                    f64::from(row) / f64::from(n),
                );
                mesh.positions
                    .push(center + radius * (a + (b - a) * u + (top - a) * v).normalize());
                mesh.colors
                    .push([(row * 10) as u8, (column * 10) as u8, i as u8 * 80]);
                mesh.normals.push(
                    (a + (b - a) * u + (top - a) * v)
                        .normalize()
                        .as_vec3()
                        .to_array(),
                );
            };
            for row in 0..=n {
                (0..=n - row).for_each(|column| at(row, column));
            }
            let id = |row: u32, column: u32| {
                first + row * (n + 1) - row * row.saturating_sub(1) / 2 + column
            };
            for row in 0..n {
                for column in 0..n - row {
                    mesh.faces
                        .push([id(row, column), id(row, column + 1), id(row + 1, column)]);
                    if column + 1 < n - row {
                        mesh.faces.push([
                            id(row, column + 1),
                            id(row + 1, column + 1),
                            id(row + 1, column),
                        ]);
                    }
                }
            }
        }
    }
    mesh
}

fn merged(parts: &[Mesh]) -> Mesh {
    let mut all = Mesh::default();
    for part in parts {
        let first = all.positions.len() as u32;
        all.positions.extend(&part.positions);
        all.normals.extend(&part.normals);
        all.colors.extend(&part.colors);
        all.faces.extend(
            part.faces
                .iter()
                .map(|face| face.map(|vertex| vertex + first)),
        );
    }
    all
}

/// Positions rounded to float32, as most files hold them.
fn single(mesh: &Mesh) -> Mesh {
    Mesh {
        positions: mesh
            .positions
            .iter()
            .map(|p| p.as_vec3().as_dvec3())
            .collect(),
        ..mesh.clone()
    }
}

#[test]
fn the_test_ball_is_a_ball() {
    let mesh = ball(DVec3::ONE, 2.0, 16);
    assert!((mesh.area() / (16.0 * std::f64::consts::PI) - 1.0).abs() < 0.01);
    for face in 0..mesh.faces.len() {
        assert!(
            mesh.area_vector(face)
                .dot(mesh.corners(face)[0] - DVec3::ONE)
                > 0.0,
            "face {face} winds inward"
        );
    }
}

#[test]
fn ply_and_obj_come_back() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = ball(DVec3::new(0.1, 0.2, -0.3), 1.5, 5);
    for name in ["mesh.ply", "mesh.obj"] {
        let path = folder.path().join(name);
        write_mesh(&path, &mesh, false).unwrap();
        assert!(
            single(&read_mesh(&path).unwrap()) == single(&mesh),
            "{name}"
        );
        let bare = Mesh {
            normals: vec![],
            colors: vec![],
            ..mesh.clone()
        };
        write_mesh(&path, &bare, true).unwrap();
        assert!(
            single(&read_mesh(&path).unwrap()) == single(&bare),
            "{name} without attributes"
        );
        let points = Mesh {
            faces: vec![],
            normals: vec![],
            ..mesh.clone()
        };
        write_mesh(&path, &points, true).unwrap();
        assert!(
            single(&read_mesh(&path).unwrap()) == single(&points),
            "{name} without faces"
        );
        write_mesh(&path, &Mesh::default(), true).unwrap();
        assert!(
            read_mesh(&path).unwrap() == Mesh::default(),
            "{name} without anything"
        );
    }
}

#[test]
fn coordinates_far_from_the_origin_keep_their_digits() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = ball(DVec3::new(512_345.25, 5_212_345.5, 431.0), 2.0, 5);
    for name in ["far.ply", "far.obj"] {
        let path = folder.path().join(name);
        write_mesh(&path, &mesh, false).unwrap();
        assert_eq!(
            read_mesh(&path).unwrap().positions,
            mesh.positions,
            "{name}"
        );
    }
    let (document, binary) = glb_parts(&folder.path().join("far.glb"), &mesh);
    let shift: Vec<f64> = document["nodes"][0]["translation"]
        .as_array()
        .unwrap()
        .iter()
        .map(|x| x.as_f64().unwrap())
        .collect();
    for (vertex, p) in floats(&document, &binary, "POSITION").chunks(3).enumerate() {
        let p = DVec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]))
            + DVec3::from_slice(&shift);
        assert!(p.distance(mesh.positions[vertex]) < 1e-6);
    }
}

fn glb_parts(path: &Path, mesh: &Mesh) -> (Value, Vec<u8>) {
    write_mesh(path, mesh, false).unwrap();
    let bytes = fs::read(path).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!(&bytes[..4], b"glTF");
    assert_eq!((word(4), word(8)), (2, bytes.len()));
    let json_length = word(12);
    assert_eq!(&bytes[16..20], b"JSON");
    let document = serde_json::from_slice(&bytes[20..20 + json_length]).unwrap();
    assert_eq!(&bytes[24 + json_length..28 + json_length], b"BIN\0");
    assert_eq!(word(20 + json_length), bytes.len() - 28 - json_length);
    assert_eq!(json_length % 4, 0);
    (document, bytes[28 + json_length..].to_vec())
}

/// The bytes behind an accessor.
fn accessor<'a>(document: &Value, binary: &'a [u8], index: &Value) -> &'a [u8] {
    let accessor = &document["accessors"][index.as_u64().unwrap() as usize];
    let view = &document["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
    let first = view["byteOffset"].as_u64().unwrap() as usize;
    assert_eq!(first % 4, 0);
    &binary[first..first + view["byteLength"].as_u64().unwrap() as usize]
}

fn floats(document: &Value, binary: &[u8], attribute: &str) -> Vec<f32> {
    let index = &document["meshes"][0]["primitives"][0]["attributes"][attribute];
    accessor(document, binary, index)
        .chunks(4)
        .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
        .collect()
}

#[test]
fn glb_holds_the_mesh() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = ball(DVec3::new(0.1, 0.2, -0.3), 1.5, 5);
    let (document, binary) = glb_parts(&folder.path().join("mesh.glb"), &mesh);
    let positions: Vec<f32> = mesh
        .positions
        .iter()
        .flat_map(|p| p.as_vec3().to_array())
        .collect();
    assert_eq!(floats(&document, &binary, "POSITION"), positions);
    assert_eq!(
        floats(&document, &binary, "NORMAL"),
        mesh.normals.as_flattened()
    );
    let primitive = &document["meshes"][0]["primitives"][0];
    let indices = accessor(&document, &binary, &primitive["indices"]);
    let indices: Vec<u32> = indices
        .chunks(4)
        .map(|b| u32::from_le_bytes(b.try_into().unwrap()))
        .collect();
    assert_eq!(indices, mesh.faces.as_flattened());
    // Linear 16 bit fractions; back to sRGB they are the colours.
    let colors = accessor(&document, &binary, &primitive["attributes"]["COLOR_0"]);
    for (texel, color) in colors.chunks(8).zip(&mesh.colors) {
        for channel in 0..3 {
            let linear = f64::from(u16::from_le_bytes(
                texel[2 * channel..][..2].try_into().unwrap(),
            )) / 65535.0;
            let srgb = if linear <= 0.0031308 {
                12.92 * linear
            } else {
                1.055 * linear.powf(1.0 / 2.4) - 0.055
            };
            assert_eq!((255.0 * srgb).round() as u8, color[channel]);
        }
        assert_eq!(texel[6..8], [255, 255]);
    }
    let accessor =
        &document["accessors"][primitive["attributes"]["POSITION"].as_u64().unwrap() as usize];
    let [low, high] = mesh.bounds().unwrap();
    for axis in 0..3 {
        assert_eq!(
            accessor["min"][axis].as_f64().unwrap() as f32,
            low[axis] as f32
        );
        assert_eq!(
            accessor["max"][axis].as_f64().unwrap() as f32,
            high[axis] as f32
        );
    }
}

#[test]
fn what_exists_is_not_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = ball(DVec3::ZERO, 1.0, 2);
    let path = folder.path().join("mesh.ply");
    fs::write(&path, "precious").unwrap();
    assert!(matches!(
        write_mesh(&path, &mesh, false),
        Err(Error::Output { .. })
    ));
    assert_eq!(fs::read(&path).unwrap(), b"precious");
    write_mesh(&path, &mesh, true).unwrap();
    assert_eq!(read_mesh(&path).unwrap().faces, mesh.faces);
    for wrong in ["mesh.stl", "mesh", "missing/mesh.ply"] {
        let result = write_mesh(&folder.path().join(wrong), &mesh, false);
        assert!(
            matches!(result, Err(Error::Output { .. })),
            "{wrong}: {result:?}"
        );
    }
    let left: Vec<_> = fs::read_dir(folder.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name())
        .collect();
    assert_eq!(left, ["mesh.ply"], "temporary files are left behind");
}

#[cfg(unix)]
#[test]
fn a_written_mesh_can_be_read_by_others() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let mode = |name: &str| {
        fs::metadata(folder.path().join(name))
            .unwrap()
            .permissions()
            .mode()
    };
    write_mesh(
        &folder.path().join("mesh.ply"),
        &ball(DVec3::ZERO, 1.0, 2),
        false,
    )
    .unwrap();
    fs::write(folder.path().join("plain"), "").unwrap();
    assert_eq!(mode("mesh.ply"), mode("plain"));
}

fn parse(name: &str, bytes: &[u8]) -> neurodin::Result<Mesh> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    read_mesh(&path)
}

const ASCII: &str = "ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 4\nproperty float x\nproperty float y\nproperty double z\n\
    property float quality\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n\
    property list uchar int vertex_indices\nproperty uchar flag\nelement edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n\
    0 0 0 0.5 1 2 3\n1 0 0 0.5 4 5 6\n1 1 0 0.5 7 8 9\n0 1 0.25 0.5 10 11 255\n4 0 1 2 3 7\n3 0 1 3 8\n0 1\n";

#[test]
fn ply_of_other_programs() {
    let mesh = parse("a.ply", ASCII.as_bytes()).unwrap();
    assert_eq!(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 3]]);
    assert_eq!(mesh.positions[3], DVec3::new(0.0, 1.0, 0.25));
    assert_eq!(mesh.colors[3], [10, 11, 255]);
    assert!(mesh.normals.is_empty());
    assert_eq!(
        parse("b.PLY", ASCII.replace('\n', "\r\n").as_bytes()).unwrap(),
        mesh
    );

    // Lines that say nothing of the values, and lists among a vertex's numbers.
    let odd = ASCII
        .replace("comment", "made by some program\nobj_info none\n\ncomment")
        .replace("float quality", "list uchar int seen_by")
        .replace(" 0.5 ", " 2 7 8 ");
    assert_eq!(parse("d.ply", odd.as_bytes()).unwrap(), mesh);

    let mut big = b"ply\nformat binary_big_endian 1.0\nelement vertex 3\nproperty short x\nproperty double y\nproperty float z\n\
        property float red\nproperty float green\nproperty float blue\nelement face 1\nproperty list uint ushort vertex_index\nend_header\n"
        .to_vec();
    for vertex in 0..3i16 {
        big.extend((vertex - 1).to_be_bytes());
        big.extend((f64::from(vertex) + 0.25).to_be_bytes());
        big.extend(2.5f32.to_be_bytes());
        [0.0f32, 0.5, 7.0]
            .iter()
            .for_each(|channel| big.extend(channel.to_be_bytes()));
    }
    big.extend(3u32.to_be_bytes());
    [2u16, 1, 0]
        .iter()
        .for_each(|index| big.extend(index.to_be_bytes()));
    let mesh = parse("c.ply", &big).unwrap();
    assert_eq!(mesh.positions[0], DVec3::new(-1.0, 0.25, 2.5));
    assert_eq!(mesh.colors[2], [0, 128, 255]);
    assert_eq!(mesh.faces, [[2, 1, 0]]);
}

#[test]
fn obj_of_other_programs() {
    let text = "# a comment\nmtllib x.mtl\no thing\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nusemtl m\ns off\n\
        f 1/1/1 2/1/1 3/1/1 4/1/1\nf -4 -3 -1\n";
    let mesh = parse("a.obj", text.as_bytes()).unwrap();
    assert_eq!(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 3]]);
    assert_eq!(mesh.normals, [[0.0, 0.0, 1.0]; 4]);
}

#[test]
fn damaged_files_are_refused() {
    let edits: [(&str, &str); 11] = [
        ("ply\n", "plx\n"),
        ("ascii", "braille"),
        ("vertex 4", "vertex 99999999999999"),
        ("vertex 4", "vertex -4"),
        ("face 2", "face 4000000000"),
        ("end_header", "end"),
        ("property float y\n", ""),
        ("property float quality", "property quaternion quality"),
        ("4 0 1 2 3 7", "4 0 1 2 4 7"),
        ("4 0 1 2 3 7", "4 0 1 2 -3 7"),
        ("1 1 0 0.5", "1 nan 0 0.5"),
    ];
    for (from, to) in edits {
        assert!(ASCII.contains(from));
        let result = parse("a.ply", ASCII.replacen(from, to, 1).as_bytes());
        assert!(
            matches!(result, Err(Error::Input { .. })),
            "{from:?} → {to:?}: {result:?}"
        );
    }
    for text in [
        "v 0 0\n",
        "v 0 0 x\n",
        "v 0 0 inf\n",
        "v 0 0 0\nf 1 1 2\n",
        "v 0 0 0\nf 1 1 0\n",
        "v 0 0 0\nf -2 1 1\n",
        "f a b c\n",
    ] {
        assert!(
            matches!(parse("a.obj", text.as_bytes()), Err(Error::Input { .. })),
            "{text:?}"
        );
    }
    // What is wrong is said with its place and numbers.
    for (from, to, said) in [
        (
            "vertex 4",
            "vertex 40",
            "promises 40 of 'vertex' of at least 14 bytes each",
        ),
        ("0 1\n", "0\n \n", "ends within edge 0 of 1"),
        ("4 5 6", "4 e 6", "'e' is not a number"),
        ("float quality", "quaternion quality", "'quaternion'"),
        ("face 2", "face two", "'element face two' has no count"),
    ] {
        assert!(ASCII.contains(from));
        let error = parse("a.ply", ASCII.replacen(from, to, 1).as_bytes()).unwrap_err();
        assert!(
            error.to_string().contains(said),
            "{from:?} → {to:?}: {error}"
        );
    }
    assert!(matches!(parse("a.stl", b"solid"), Err(Error::Input { .. })));
    assert!(matches!(
        read_mesh(Path::new("/nonexistent/mesh.ply")),
        Err(Error::Input { .. })
    ));
}

/// A file of each kind, undamaged.
fn whole_files() -> &'static [(&'static str, Vec<u8>); 3] {
    static FILES: OnceLock<[(&str, Vec<u8>); 3]> = OnceLock::new();
    FILES.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let written = |name| {
            let path = folder.path().join(name);
            write_mesh(&path, &ball(DVec3::ZERO, 1.0, 3), false).unwrap();
            (name, fs::read(&path).unwrap())
        };
        [
            ("a.ply", ASCII.as_bytes().to_vec()),
            written("b.ply"),
            written("c.obj"),
        ]
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn mangled_files_never_panic(
        kind in 0usize..3,
        edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..12),
        cut in any::<prop::sample::Index>(),
        whole: bool,
    ) {
        let (name, mut bytes) = whole_files()[kind].clone();
        for (at, byte) in edits {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        if !whole {
            bytes.truncate(cut.index(bytes.len()));
        }
        if let Ok(mesh) = parse(name, &bytes) {
            prop_assert!(mesh.faces.as_flattened().iter().all(|&vertex| (vertex as usize) < mesh.positions.len()));
            prop_assert!(mesh.colors.is_empty() || mesh.colors.len() == mesh.positions.len());
            prop_assert!(mesh.normals.is_empty() || mesh.normals.len() == mesh.positions.len());
        }
    }
}

/// As [`ball`], with the patches' common vertices joined.
fn welded_ball(center: DVec3, radius: f64, n: u32) -> Mesh {
    let mesh = ball(center, radius, n);
    let mut first = std::collections::HashMap::new();
    let id: Vec<u32> = mesh
        .positions
        .iter()
        .enumerate()
        .map(|(vertex, p)| {
            *first
                .entry(((p - center) * 1e6).round().as_i64vec3().to_array())
                .or_insert(vertex as u32)
        })
        .collect();
    let mut welded = Mesh {
        faces: mesh
            .faces
            .iter()
            .map(|face| face.map(|vertex| id[vertex as usize]))
            .collect(),
        ..mesh
    };
    neurodin::mesh::clean::drop_unused_vertices(&mut welded);
    welded
}

#[test]
fn components_are_counted_and_chosen() {
    let parts = [
        welded_ball(DVec3::ZERO, 1.0, 3),
        welded_ball(DVec3::X * 4.0, 1.0, 6),
        welded_ball(DVec3::X * 8.0, 1.0, 4),
    ];
    let mesh = merged(&parts);
    let (component, sizes) = components(&mesh);
    assert_eq!(sizes, [72, 288, 128]);
    assert_eq!(component.iter().filter(|&&c| c == 1).count(), 288);
    let mut largest = mesh.clone();
    keep_largest(&mut largest);
    assert!(largest == parts[1]);
    let mut two = mesh.clone();
    drop_small(&mut two, 128);
    assert!(two == merged(&parts[1..]));
    let mut nothing = Mesh::default();
    keep_largest(&mut nothing);
    assert!(nothing == Mesh::default());
}
