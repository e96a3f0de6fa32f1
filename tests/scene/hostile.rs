//! Damaged and made-up files end in a scene or an error, never in a panic.

use std::fs;

use glam::DVec3;
use proptest::prelude::*;
use serde_json::json;

use crate::fixtures::{Dataset, Rig};

/// Flips, inserts or cuts bytes of `data` as `edits` say: (place, value, what).
fn damage(data: &[u8], edits: &[(u32, u8, u8)]) -> Vec<u8> {
    let mut data = data.to_vec();
    for (place, value, what) in edits {
        let at = *place as usize % (data.len() + 1);
        match what % 4 {
            0 => data.truncate(at),
            1 => data.insert(at, *value),
            2 if at + 8 <= data.len() => data[at..at + 8].copy_from_slice(&[*value; 8]),
            _ if at < data.len() => data[at] = *value,
            _ => {}
        }
    }
    data
}

fn edits() -> impl Strategy<Value = Vec<(u32, u8, u8)>> {
    prop::collection::vec((any::<u32>(), any::<u8>(), any::<u8>()), 1..4)
}

/// Opens the dataset and, if that works, uses what came out.
fn exercise(dataset: &Dataset) {
    if let Ok(scene) = dataset.open() {
        let _ = neurodin::scene::Region::estimate(&scene, &Default::default());
        let _ = neurodin::scene::Looks::of(&scene);
        for view in 0..scene.views.len() {
            let _ = scene.load_picture(view);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_colmap_models(binary: bool, part in 0usize..3, edits in edits()) {
        let (rig, dataset) = (Rig::skewed(3), Dataset::new());
        rig.write_pictures(&dataset.at("images"));
        let write = if binary { Rig::write_colmap_binary } else { Rig::write_colmap_text };
        write(&rig, &dataset.at("sparse/0"));
        let name = ["cameras", "images", "points3D"][part];
        let path = format!("sparse/0/{name}.{}", if binary { "bin" } else { "txt" });
        let whole = fs::read(dataset.at(&path)).unwrap();
        dataset.write(&path, damage(&whole, &edits));
        exercise(&dataset);
    }

    #[test]
    fn damaged_transforms(edits in edits()) {
        let rig = Rig::skewed(3);
        let whole = rig.transforms(json!({
            "sphere_center": [1.0, 2.0, 0.5], "sphere_radius": 1.0, "k1": 0.01, "ply_file_path": "points.ply", "aabb_scale": 1,
            "applied_transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "test_filenames": ["images/view_001.png"],
        }));
        let dataset = rig.dataset(&whole);
        dataset.write("transforms.json", damage(whole.to_string().as_bytes(), &edits));
        exercise(&dataset);
    }

    #[test]
    fn damaged_meta_data(edits in edits()) {
        let rig = Rig::skewed(3);
        let whole = rig.meta_data(json!({
            "scene_box": {"aabb": [[-1, -1, -1], [1, 1, 1]], "near": 0.05, "far": 2.5, "radius": 1.0, "collider_type": "sphere"},
            "worldtogt": [[2, 0, 0, 1], [0, 2, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]],
        }));
        let dataset = rig.sdfstudio(&whole);
        dataset.write("meta_data.json", damage(whole.to_string().as_bytes(), &edits));
        exercise(&dataset);
    }

    #[test]
    fn damaged_neus_archives(edits in edits()) {
        let dataset = Rig::skewed(3).neus(DVec3::ONE, 2.0);
        let whole = fs::read(dataset.at("cameras_sphere.npz")).unwrap();
        dataset.write("cameras_sphere.npz", damage(&whole, &edits));
        exercise(&dataset);
    }

    #[test]
    fn damaged_cams(edits in edits()) {
        let mut rig = Rig::skewed(3);
        rig.views.iter_mut().enumerate().for_each(|(index, view)| view.0 = index.to_string());
        let dataset = rig.mvsnet();
        dataset.write("cams/1_cam.txt", damage(rig.cam(1).as_bytes(), &edits));
        exercise(&dataset);
    }

    #[test]
    fn damaged_pictures_and_points(edits in edits()) {
        let rig = Rig::skewed(2);
        let dataset = rig.dataset(&rig.transforms(json!({"ply_file_path": "points.ply"})));
        let whole = fs::read(dataset.at("images/view_000.png")).unwrap();
        dataset.write("images/view_000.png", damage(&whole, &edits));
        let ply = "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
        dataset.write("points.ply", damage(&[ply.as_bytes(), &[7; 48]].concat(), &edits));
        exercise(&dataset);
    }

    #[test]
    fn numbers_out_of_nowhere(values in prop::collection::vec(any::<f64>(), 16), key in 0usize..12) {
        let rig = Rig::skewed(2);
        let key = ["fl_x", "cx", "w", "k1", "k3", "p1", "camera_angle_x", "sphere_radius", "aabb_scale", "scale", "applied_scale", "k6"][key];
        let mut transforms = rig.transforms(json!({"sphere_center": [values[0], values[1], values[2]], key: values[3]}));
        for row in 0..3 {
            transforms["frames"][0]["transform_matrix"][row][3] = json!(values[4 + row]);
        }
        exercise(&rig.dataset(&transforms));
    }
}
