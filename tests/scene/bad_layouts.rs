//! sdfstudio, NeuS and Vis-MVSNet datasets that cannot be used: which file, which numbers, what next.

use std::fs;

use glam::{DMat4, DVec3};
use neurodin::scene::{Scene, SceneOptions};
use serde_json::{Value, json};

use crate::fixtures::{Dataset, Rig, all_views, refused, write_npz};

/// Cameras whose names are numbers.
fn numbered(count: usize) -> Rig {
    let mut rig = Rig::skewed(count);
    for (index, (name, _)) in rig.views.iter_mut().enumerate() {
        *name = format!("{index:08}");
    }
    rig
}

#[test]
fn what_a_meta_data_file_lacks_is_named() {
    let rig = Rig::skewed(4);
    let with = |change: &dyn Fn(&mut Value)| {
        let mut meta_data = rig.meta_data(json!({}));
        change(&mut meta_data);
        rig.sdfstudio(&meta_data)
    };
    let remove = |value: &mut Value, key: &str| {
        value.as_object_mut().unwrap().remove(key);
    };
    with(&|top| remove(top, "frames")).refuses(&["meta_data.json", "no list of frames"]);
    with(&|top| top["frames"] = json!([])).refuses(&["meta_data.json", "0 cameras"]);
    with(&|top| top["frames"][1] = json!(3)).refuses(&["frame 1 is 3"]);
    for key in ["rgb_path", "camtoworld", "intrinsics"] {
        with(&|top| remove(&mut top["frames"][2], key)).refuses(&["frame 2", "has no", key]);
    }
    with(&|top| remove(top, "width")).refuses(&["no picture size"]);
    with(&|top| top["frames"][2]["intrinsics"] = json!([[70, 0], [0, 70]]))
        .refuses(&["frame 2 (view_002_rgb.png)", "not a 3x3 or 4x4 matrix"]);
    with(&|top| top["frames"][2]["intrinsics"][1][2] = json!("x"))
        .refuses(&["view_002", "intrinsics has \"x\" in row 1, column 2"]);
    with(&|top| top["frames"][2]["intrinsics"][0][0] = json!(-70.0))
        .refuses(&["view_002", "focal length -70"]);
    with(&|top| top["frames"][2]["camtoworld"] = json!([[1, 0], [0, 1]])).refuses(&[
        "view_002",
        "camtoworld is",
        "not a 4x4 matrix",
    ]);
    with(&|top| top["frames"][2]["camtoworld"][0][3] = Value::Null).refuses(&[
        "view_002",
        "camtoworld has NaN or infinity in row 0, column 3",
    ]);
    with(&|top| top["frames"][0]["foreground_mask"] = json!("gone.png")).refuses(&[
        "view_000",
        "gone.png",
        "--no-masks",
    ]);
    with(&|top| top["worldtogt"] = json!([[1, 2, 3]])).refuses(&["worldtogt"]);
    with(&|top| top["worldtogt"] = json!(vec![[0; 4]; 4])).refuses(&["worldtogt is singular"]);

    let dataset = with(&|_| {});
    fs::remove_file(dataset.at("view_001_rgb.png")).unwrap();
    let scene = dataset.open().unwrap();
    assert_eq!(scene.views.len(), 3);
    assert!(scene.skipped[0].why.contains("view_001_rgb.png"));
    fs::remove_file(dataset.at("view_002_rgb.png")).unwrap();
    fs::remove_file(dataset.at("view_003_rgb.png")).unwrap();
    dataset.refuses(&["3 of the 4 pictures", "view_001_rgb.png"]);
}

#[test]
fn scene_boxes_that_bound_nothing_are_refused() {
    let rig = Rig::skewed(4);
    for (scene_box, what) in [
        (json!({}), "aabb is not there"),
        (json!({"aabb": [[-1, -1, -1]]}), "not two corners"),
        (json!({"aabb": [[-1, -1], [1, 1]]}), "not two corners"),
        (json!({"aabb": [[-1, -1, -1], [1, 1, -1]]}), "aabb is empty"),
        (
            json!({"aabb": [[-1, -1, -1], [1, 1, 1]], "radius": 0, "collider_type": "sphere"}),
            "radius is 0",
        ),
    ] {
        rig.sdfstudio(&rig.meta_data(json!({"scene_box": scene_box})))
            .refuses(&["meta_data.json", "scene_box", what, "--box"]);
    }
}

#[test]
fn neus_cameras_and_pictures_have_to_be_equally_many() {
    let rig = Rig::skewed(5);
    let dataset = rig.neus(DVec3::ZERO, 1.0);
    fs::remove_file(dataset.at("image/view_003.png")).unwrap();
    dataset.refuses(&[
        "cameras_sphere.npz",
        "holds 5 cameras",
        "image has 4 pictures",
        "by their order",
    ]);
    fs::remove_dir_all(dataset.at("image")).unwrap();
    dataset.refuses(&["cameras_sphere.npz", "no folder image"]);

    // A wrong number of masks counts only where masks are wanted.
    let dataset = rig.neus(DVec3::ZERO, 1.0);
    fs::create_dir(dataset.at("mask")).unwrap();
    rig.picture(0).save(dataset.at("mask/000.png")).unwrap();
    dataset.refuses(&["1 masks for 5 cameras", "--no-masks"]);
    let options = SceneOptions {
        masks: false,
        ..all_views()
    };
    assert!(Scene::open(dataset.path(), &options).is_ok());
}

#[test]
fn neus_matrices_that_are_no_cameras_are_named() {
    let rig = Rig::skewed(4);
    let dataset = rig.neus(DVec3::ZERO, 1.0);
    let matrices = || {
        let of = |index: usize| {
            let values = rig.world_mat(index).transpose().to_cols_array().to_vec();
            (format!("world_mat_{index}"), vec![4u64, 4], values)
        };
        (0..4).map(of).collect::<Vec<_>>()
    };
    let written = |arrays: &[(String, Vec<u64>, Vec<f64>)], parts: &[&str]| {
        write_npz(&dataset.at("cameras_sphere.npz"), arrays);
        dataset.refuses(&[&["cameras_sphere.npz"], parts].concat());
    };
    let mut arrays = matrices();
    arrays[2].1 = vec![3, 3];
    arrays[2].2.truncate(9);
    written(&arrays, &["world_mat_2", "[3, 3]", "4x4"]);
    let mut arrays = matrices();
    arrays[1].2[6] = f64::NAN;
    written(&arrays, &["world_mat_1 holds NaN in row 1, column 2"]);
    let mut arrays = matrices();
    arrays[1].2[..12].fill(1.0);
    written(&arrays, &["world_mat_1", "singular"]);
    let mut arrays = matrices();
    arrays.remove(1);
    written(&arrays, &["world_mat_2 but no world_mat_1"]);
    written(&[], &["holds 0 cameras", "4 pictures"]);
    let mut arrays = matrices();
    let flat = DMat4::from_scale(DVec3::new(1.0, 1.0, 0.5));
    arrays.push((
        "scale_mat_0".into(),
        vec![4, 4],
        flat.to_cols_array().to_vec(),
    ));
    written(&arrays, &["scale_mat_0 makes no sphere"]);
}

#[test]
fn a_truncated_archive_is_refused_wherever_it_ends() {
    let rig = Rig::skewed(3);
    let dataset = rig.neus(DVec3::ZERO, 1.0);
    let whole = fs::read(dataset.at("cameras_sphere.npz")).unwrap();
    for length in (0..whole.len()).step_by(13) {
        dataset.write("cameras_sphere.npz", &whole[..length]);
        dataset.refuses(&["cameras_sphere.npz", &format!("{length} bytes"), "copy"]);
    }
    // Bytes of one array changed: the archive's checksum tells.
    let mut damaged = whole.clone();
    damaged[140] ^= 0x55;
    dataset.write("cameras_sphere.npz", damaged);
    dataset.refuses(&["cameras_sphere.npz", "world_mat_0"]);
}

#[test]
fn damaged_cams_are_named() {
    let rig = numbered(4);
    let dataset = rig.mvsnet();
    let good = rig.cam(2);
    let numbers = |text: &str| {
        text.split_whitespace()
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    let changed = |at: usize, with: &str| {
        let mut words = numbers(&good);
        words[at] = with.into();
        words.join(" ")
    };
    for (text, what) in [
        (String::new(), "has no word extrinsic"),
        (changed(0, "pose"), "has no word extrinsic"),
        (changed(17, "K"), "has no word intrinsic"),
        (
            changed(6, "x"),
            "extrinsic takes 16 numbers, but after 5 of them \"x\" follows",
        ),
        (
            numbers(&good)[..25].join(" "),
            "intrinsic takes 9 numbers, but after 7 of them the file ends",
        ),
        (changed(4, "nan"), "holds NaN"),
        (changed(4, "inf"), "holds inf"),
        (changed(1, "9"), "extrinsic: the pose is not rigid"),
        (changed(18, "-70"), "focal length -70"),
    ] {
        dataset.write("cams/00000002_cam.txt", text);
        dataset.refuses(&["0000002", what]);
    }
}

#[test]
fn cams_and_pictures_without_each_other_are_skipped_until_they_are_most() {
    let rig = numbered(5);
    let dataset = rig.mvsnet();
    fs::remove_file(dataset.at("images/00000001.png")).unwrap();
    fs::remove_file(dataset.at("cams/00000003_cam.txt")).unwrap();
    let scene = dataset.open().unwrap();
    assert_eq!(scene.views.len(), 3);
    let why: Vec<_> = scene.skipped.iter().map(|s| format!("{s:?}")).collect();
    assert!(
        why[0].contains("00000003.png") && why[0].contains("no camera"),
        "{why:?}"
    );
    assert!(
        why[1].contains("00000001_cam.txt") && why[1].contains("number 1"),
        "{why:?}"
    );
    for number in [0, 2] {
        fs::remove_file(dataset.at(&format!("images/0000000{number}.png"))).unwrap();
    }
    dataset.refuses(&["3 of the 4 pictures", "no picture with the number 0"]);
}

#[test]
fn a_picture_of_another_shape_is_named() {
    let rig = Rig::skewed(4);
    let dataset = rig.sdfstudio(&rig.meta_data(json!({})));
    image::RgbImage::new(48, 64)
        .save(dataset.at("view_001_rgb.png"))
        .unwrap();
    dataset.refuses(&["view_001_rgb.png", "48x64", "64x48"]);
}

#[test]
fn arrays_in_other_files_are_refused() {
    let rig = Rig::skewed(4);
    let dataset: Dataset = rig.neus(DVec3::ZERO, 1.0);
    dataset.write("cameras.txt", "1 2 3");
    refused(
        Scene::open(&dataset.at("cameras.txt"), &all_views()),
        &["cameras.txt", "cameras_sphere.npz"],
    );
}
