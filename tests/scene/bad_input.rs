//! What cannot be used is refused with the file, the numbers and the next move; what can be done without is skipped and said.

use std::fs;
use std::path::Path;

use neurodin::scene::{Scene, UNSUPPORTED_MODELS};
use serde_json::{Value, json};

use crate::fixtures::{Dataset, Rig, all_views, refused};

/// A dataset of `rig` in COLMAP's binary layout.
fn colmap(rig: &Rig) -> Dataset {
    let dataset = Dataset::new();
    rig.write_pictures(&dataset.at("images"));
    rig.write_colmap_binary(&dataset.at("sparse/0"));
    dataset
}

#[test]
fn what_is_no_dataset_says_what_is_there() {
    let dataset = Dataset::new();
    dataset.refuses(&["no dataset here", "it holds nothing"]);
    dataset.write("holiday.txt", "sun");
    dataset.refuses(&["holiday.txt", "transforms.json", "sparse/0"]);
    dataset.refuses(&["meta_data.json", "cameras_sphere.npz", "cams/*_cam.txt"]);
    refused(
        Scene::open(Path::new("/no/such/place"), &all_views()),
        &["/no/such/place", "does not exist"],
    );
    refused(
        Scene::open(&dataset.at("holiday.txt"), &all_views()),
        &["holiday.txt", "neither a directory"],
    );
}

#[test]
fn a_missing_picture_is_skipped_and_many_are_an_error() {
    let rig = Rig::skewed(6);
    for dataset in [colmap(&rig), rig.dataset(&rig.transforms(json!({})))] {
        fs::remove_file(dataset.at("images/view_002.png")).unwrap();
        let scene = dataset.open().unwrap();
        assert_eq!(scene.views.len(), 5);
        assert_eq!(scene.skipped.len(), 1);
        assert!(
            scene.skipped[0].what.contains("view_002.png"),
            "{:?}",
            scene.skipped
        );
        assert!(
            scene.skipped[0].why.contains("no such file"),
            "{:?}",
            scene.skipped
        );
        for name in ["view_000", "view_003", "view_005"] {
            fs::remove_file(dataset.at(&format!("images/{name}.png"))).unwrap();
        }
        dataset.refuses(&["4 of the 6 pictures", "view_000.png", "no such file"]);
        fs::remove_dir_all(dataset.at("images")).unwrap();
        dataset.refuses(&["6 of the 6 pictures"]);
    }
}

#[test]
fn a_picture_that_cannot_be_decoded_is_named() {
    let rig = Rig::skewed(3);
    let dataset = colmap(&rig);
    dataset.write("images/view_001.png", "not a picture");
    dataset.refuses(&["view_001.png", "cannot be read as a picture"]);

    // A whole header with half the pixels behind it: found when it is loaded.
    rig.write_pictures(&dataset.at("images"));
    let whole = fs::read(dataset.at("images/view_001.png")).unwrap();
    dataset.write("images/view_001.png", &whole[..whole.len() / 2]);
    refused(
        dataset.open().unwrap().load_picture(1),
        &["view_001.png", "cannot be read as a picture"],
    );
}

#[test]
fn truncated_binaries_name_the_byte_and_the_size() {
    let rig = Rig::skewed(4);
    for (name, data) in [
        ("cameras.bin", rig.colmap_cameras(1)),
        ("images.bin", rig.colmap_images()),
        ("points3D.bin", rig.colmap_points()),
    ] {
        let dataset = colmap(&rig);
        for length in (0..data.len()).step_by(if data.len() > 1000 { 37 } else { 1 }) {
            dataset.write(&format!("sparse/0/{name}"), &data[..length]);
            dataset.refuses(&[
                name,
                "byte",
                &format!("the file has {length} bytes"),
                "truncated",
            ]);
        }
    }
}

#[test]
fn counts_that_no_file_could_hold_are_refused_before_memory_is_taken() {
    let rig = Rig::skewed(4);
    let dataset = colmap(&rig);
    for count in [1u64 << 40, u64::MAX, u64::MAX / 24] {
        for (name, mut data) in [
            ("cameras.bin", rig.colmap_cameras(1)),
            ("images.bin", rig.colmap_images()),
            ("points3D.bin", rig.colmap_points()),
        ] {
            let good = data.clone();
            data[..8].copy_from_slice(&count.to_le_bytes());
            dataset.write(&format!("sparse/0/{name}"), data);
            dataset.refuses(&[name, &count.to_string(), "bytes"]);
            dataset.write(&format!("sparse/0/{name}"), good);
        }
        // The number of observed points of the first image.
        let mut data = rig.colmap_images();
        let name_end = 72 + data[72..].iter().position(|byte| *byte == 0).unwrap();
        data[name_end + 1..name_end + 9].copy_from_slice(&count.to_le_bytes());
        dataset.write("sparse/0/images.bin", data);
        dataset.refuses(&["images.bin", &count.to_string()]);
        dataset.write("sparse/0/images.bin", rig.colmap_images());
    }
}

#[test]
fn unsupported_camera_models_are_refused_by_name() {
    let rig = Rig::skewed(4);
    let dataset = colmap(&rig);
    for (id, name) in UNSUPPORTED_MODELS {
        dataset.write("sparse/0/cameras.bin", rig.colmap_cameras(id));
        dataset.refuses(&["cameras.bin", name, &id.to_string(), "image_undistorter"]);
    }
    dataset.write("sparse/0/cameras.bin", rig.colmap_cameras(99));
    dataset.refuses(&["cameras.bin", "number 99"]);

    let dataset = Dataset::new();
    rig.write_pictures(&dataset.at("images"));
    rig.write_colmap_text(&dataset.at("sparse/0"));
    dataset.write("sparse/0/cameras.txt", "7 EUCM 64 48 1 1 1 1 1 1\n");
    dataset.refuses(&["cameras.txt", "EUCM", "image_undistorter"]);

    for (key, value, name) in [
        ("camera_model", json!("EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
        ("orthographic", json!(true), "orthographic"),
        ("ftheta_p0", json!(1.0), "F-theta"),
    ] {
        rig.dataset(&rig.transforms(json!({key: value}))).refuses(&[
            "transforms.json",
            name,
            "not supported",
        ]);
    }
    rig.dataset(&rig.transforms(json!({"k4": 0.1})))
        .refuses(&["k4 = 0.1", "not supported"]);
}

#[test]
fn poses_that_are_no_poses_are_refused_with_their_picture() {
    let rig = Rig::skewed(4);
    let broken = |row: usize, column: usize, entry: Value| {
        let mut transforms = rig.transforms(json!({}));
        transforms["frames"][2]["transform_matrix"][row][column] = entry;
        transforms
    };
    rig.dataset(&broken(0, 3, Value::Null))
        .refuses(&["view_002.png", "NaN or infinity in row 0, column 3"]);
    rig.dataset(&broken(1, 1, json!("x")))
        .refuses(&["view_002.png", "row 1, column 1"]);
    rig.dataset(&broken(1, 1, json!(9.0)))
        .refuses(&["view_002.png", "not rigid"]);

    // Python's json writes NaN, which is no JSON.
    for word in ["NaN", "Infinity", "-Infinity"] {
        let text = broken(0, 3, json!("HERE"))
            .to_string()
            .replace("\"HERE\"", word);
        let dataset = rig.dataset(&json!({}));
        dataset.write("transforms.json", text);
        dataset.refuses(&["view_002.png", "NaN or infinity in row 0, column 3"]);
        // Nor is it a setting that is absent.
        for key in ["fl_x", "k1", "sphere_radius"] {
            let text = rig.transforms(json!({ key: "HERE" })).to_string();
            dataset.write("transforms.json", text.replace("\"HERE\"", word));
            dataset.refuses(&["transforms.json", key, word]);
        }
    }

    let mut mirrored = rig.transforms(json!({}));
    for row in mirrored["frames"][2]["transform_matrix"]
        .as_array_mut()
        .unwrap()
    {
        row[0] = json!(-row[0].as_f64().unwrap());
    }
    rig.dataset(&mirrored)
        .refuses(&["view_002.png", "mirror image"]);

    let dataset = colmap(&rig);
    let good = rig.colmap_images();
    for (entry, bad, what) in [(0, f64::NAN, "NaN"), (5, f64::INFINITY, "inf")] {
        let mut data = good.clone();
        data[12 + entry * 8..20 + entry * 8].copy_from_slice(&bad.to_le_bytes());
        dataset.write("sparse/0/images.bin", data);
        dataset.refuses(&["images.bin", "view_003.png", what, "image_deleter"]);
    }
    let mut data = good;
    data[12..44].fill(0);
    dataset.write("sparse/0/images.bin", data);
    dataset.refuses(&["view_003.png", "quaternion of length 0"]);
}

#[test]
fn too_few_cameras_are_refused_with_their_number() {
    let none = Rig::skewed(0);
    colmap(&none).refuses(&["images.bin", "0 cameras"]);
    none.dataset(&none.transforms(json!({})))
        .refuses(&["transforms.json", "0 cameras"]);
    let one = Rig::skewed(1);
    colmap(&one).refuses(&["1 training view(s) of 1", "at least 2"]);
    one.dataset(&one.transforms(json!({})))
        .refuses(&["1 training view(s) of 1", "at least 2"]);
    assert_eq!(colmap(&Rig::skewed(2)).open().unwrap().views.len(), 2);
}

#[test]
fn what_a_transforms_file_lacks_is_named() {
    let rig = Rig::skewed(3);
    let without = |key: &str| {
        let mut transforms = rig.transforms(json!({}));
        transforms.as_object_mut().unwrap().remove(key);
        transforms
    };
    rig.dataset(&without("frames"))
        .refuses(&["transforms.json", "no list of frames"]);
    let mut no_focal = without("fl_x");
    no_focal.as_object_mut().unwrap().remove("fl_y");
    rig.dataset(&no_focal)
        .refuses(&["view_000.png", "no focal length"]);
    for (path, what) in [
        ("file_path", "frame 1 has no file_path"),
        ("transform_matrix", "has no transform_matrix"),
    ] {
        let mut transforms = rig.transforms(json!({}));
        transforms["frames"][1]
            .as_object_mut()
            .unwrap()
            .remove(path);
        rig.dataset(&transforms).refuses(&["transforms.json", what]);
    }
    rig.dataset(&rig.transforms(json!({"fl_x": "wide"})))
        .refuses(&["fl_x is \"wide\", not a number"]);
    rig.dataset(&rig.transforms(json!({"fl_x": -3.0})))
        .refuses(&["focal length -3"]);
    rig.dataset(&rig.transforms(json!({"w": 0})))
        .refuses(&["w and h"]);
    rig.dataset(&rig.transforms(json!({"sphere_center": [1, 2], "sphere_radius": 1})))
        .refuses(&["sphere_center"]);
    rig.dataset(&rig.transforms(json!({"sphere_center": [1, 2, 3], "sphere_radius": 0})))
        .refuses(&["sphere_radius is 0"]);

    let dataset = rig.dataset(&json!({}));
    dataset.write(
        "transforms.json",
        &rig.transforms(json!({})).to_string()[..200],
    );
    dataset.refuses(&["transforms.json", "no JSON", "200 bytes"]);

    let mut masked = rig.transforms(json!({}));
    masked["frames"][0]["mask_path"] = json!("masks/gone.png");
    rig.dataset(&masked)
        .refuses(&["view_000.png", "masks/gone.png", "--no-masks"]);
}

#[test]
fn damaged_colmap_texts_name_the_line() {
    let rig = Rig::skewed(3);
    let dataset = Dataset::new();
    rig.write_pictures(&dataset.at("images"));
    for (file, line, with, what) in [
        (
            "cameras.txt",
            1,
            "7 PINHOLE 64",
            "line 2: ends before the height",
        ),
        (
            "cameras.txt",
            1,
            "7 PINHOLE 64 48 x 1 2 3",
            "line 2: \"x\" cannot be a camera parameter",
        ),
        (
            "cameras.txt",
            1,
            "7 PINHOLE 64 48 1 2 3",
            "takes 4 parameters, not 3",
        ),
        (
            "cameras.txt",
            1,
            "8 PINHOLE 64 48 1 2 3 4",
            "refers to camera 7",
        ),
        (
            "images.txt",
            1,
            "3 1 0 0 0 0 0 0 7",
            "line 2: ends before the picture's name",
        ),
        ("images.txt", 2, "1 2 3 4", "line 3: 4 numbers are no list"),
        (
            "points3D.txt",
            3,
            "3 1 2 3 10 20 300 0.5",
            "line 4: \"300\" cannot be a colour",
        ),
    ] {
        rig.write_colmap_text(&dataset.at("sparse/0"));
        let path = dataset.at("sparse/0").join(file);
        let mut lines: Vec<String> = fs::read_to_string(&path)
            .unwrap()
            .lines()
            .map(str::to_owned)
            .collect();
        lines[line] = with.to_owned();
        fs::write(&path, lines.join("\n")).unwrap();
        dataset.refuses(&[what]);
    }
    fs::remove_file(dataset.at("sparse/0/images.txt")).unwrap();
    dataset.refuses(&["lacks images.bin (or images.txt)"]);
}

#[test]
fn a_colmap_text_that_ends_between_two_images_is_said() {
    let rig = Rig::skewed(3);
    let dataset = Dataset::new();
    rig.write_pictures(&dataset.at("images"));
    rig.write_colmap_text(&dataset.at("sparse/0"));
    let path = dataset.at("sparse/0/images.txt");
    let text = fs::read_to_string(&path).unwrap();
    for (stated, notes) in [(rig.views.len(), 0), (rig.views.len() + 2, 1)] {
        let head = format!("# Number of images: {stated}, mean observations per image: 1\n");
        fs::write(&path, head + &text).unwrap();
        let scene = dataset.open().unwrap();
        assert_eq!(scene.notes.len(), notes, "{:?}", scene.notes);
    }
    let note = dataset.open().unwrap().notes.concat();
    assert!(note.contains("holds 3 images, but says 5"), "{note}");
}

#[test]
fn points_that_are_not_finite_are_left_out_and_missing_points_said() {
    let rig = Rig::skewed(3);
    let dataset = colmap(&rig);
    let mut data = rig.colmap_points();
    data[16..24].copy_from_slice(&f64::NAN.to_le_bytes());
    dataset.write("sparse/0/points3D.bin", data);
    let scene = dataset.open().unwrap();
    assert_eq!(scene.points.len(), rig.points.len() - 1);
    assert!(
        scene.notes[0].contains("1 of 400 points"),
        "{:?}",
        scene.notes
    );
    fs::remove_file(dataset.at("sparse/0/points3D.bin")).unwrap();
    let scene = dataset.open().unwrap();
    assert!(scene.points.is_empty() && scene.skipped[0].what == "points3D");
}

#[test]
fn a_picture_listed_twice_counts_once() {
    let rig = Rig::skewed(3);
    let mut transforms = rig.transforms(json!({}));
    let again = transforms["frames"][1].clone();
    transforms["frames"].as_array_mut().unwrap().push(again);
    let scene = rig.dataset(&transforms).open().unwrap();
    assert_eq!(scene.views.len(), 3);
    assert!(
        scene.skipped[0].why.contains("twice"),
        "{:?}",
        scene.skipped
    );
}
