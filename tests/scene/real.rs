//! The rendered scenes with ground truth, where they are at hand: `NEURODIN_SCENES`, or `../shared/scenes` beside the repository.

use std::collections::HashMap;
use std::path::PathBuf;

use glam::{DMat4, DVec3};
use neurodin::scene::{
    Beyond, Facing, Format, Looks, Region, RegionOverrides, RegionShape, Scene, SceneOptions, Split,
};

use crate::fixtures::all_views;

/// The directory of a scene, or `None` with the reason printed.
fn scene_folder(name: &str) -> Option<PathBuf> {
    let beside = || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    let folder = std::env::var_os("NEURODIN_SCENES")
        .map_or_else(beside, PathBuf::from)
        .join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    println!(
        "skipped: no scene at {} (set NEURODIN_SCENES)",
        folder.display()
    );
    None
}

#[test]
fn transforms_and_colmap_hold_the_same_cameras() {
    for (name, views, facing) in [
        ("p1_object", 60, Facing::Inward),
        ("p2_room", 90, Facing::Outward),
    ] {
        let Some(folder) = scene_folder(name) else {
            return;
        };
        let json = Scene::open(&folder, &all_views()).unwrap();
        let colmap = Scene::open(&folder.join("sparse/0"), &all_views()).unwrap();
        assert_eq!(
            (json.format, colmap.format),
            (Format::Neuralangelo, Format::Colmap)
        );
        assert_eq!(colmap.views.len(), views);
        assert_eq!(json.split(Split::Train).count(), views);
        assert!(json.split(Split::Test).count() > 0);
        let poses: HashMap<String, DMat4> = json
            .views
            .iter()
            .map(|view| (view.name.replace("images/", ""), view.world_from_camera))
            .collect();
        for view in &colmap.views {
            let difference = view.world_from_camera - poses[&view.name];
            let largest = difference
                .to_cols_array()
                .into_iter()
                .fold(0.0, |a: f64, b| a.max(b.abs()));
            assert!(largest < 1e-6, "{}: {largest}", view.name);
            let camera = &json
                .views
                .iter()
                .find(|other| other.name.ends_with(&view.name))
                .unwrap()
                .camera;
            assert_eq!(camera, &view.camera);
        }
        assert_eq!(json.points, colmap.points);
        for scene in [&json, &colmap] {
            let looks = Looks::of(scene);
            assert_eq!(looks.facing, facing, "{name}: {}", looks.why);
        }
    }
}

#[test]
fn the_region_is_the_stated_one_or_holds_what_it_does() {
    for name in ["p1_object", "p2_room"] {
        let Some(folder) = scene_folder(name) else {
            return;
        };
        let text = std::fs::read_to_string(folder.join("transforms.json")).unwrap();
        let json: serde_json::Value = serde_json::from_str(&text).unwrap();
        let center =
            DVec3::from([0, 1, 2].map(|axis| json["sphere_center"][axis].as_f64().unwrap()));
        let radius = json["sphere_radius"].as_f64().unwrap();

        let scene = Scene::open(&folder, &all_views()).unwrap();
        let stated = Region::estimate(&scene, &RegionOverrides::default()).unwrap();
        assert_eq!(
            (stated.center, stated.radius, stated.shape),
            (center, radius, RegionShape::Sphere)
        );

        let scene = Scene::open(&folder.join("sparse/0"), &all_views()).unwrap();
        let estimated = Region::estimate(&scene, &RegionOverrides::default()).unwrap();
        assert!(
            estimated.center.distance(center) < 0.25 * radius,
            "{name}: {estimated:?}"
        );
        assert!(
            (0.9..1.6).contains(&(estimated.radius / radius)),
            "{name}: {estimated:?}"
        );
        assert!(
            estimated.points_inside(&scene) * 100 >= scene.points.len() * 95,
            "{name}: {estimated:?}"
        );
    }
}

#[test]
fn the_object_stands_before_an_even_backdrop() {
    let Some(folder) = scene_folder("p1_object") else {
        return;
    };
    for masks in [true, false] {
        let scene = Scene::open(
            &folder,
            &SceneOptions {
                masks,
                ..all_views()
            },
        )
        .unwrap();
        // Its floor ends a little outside of the stated region.
        let wider = RegionOverrides {
            scale: 1.5,
            ..Default::default()
        };
        let region = Region::estimate(&scene, &wider).unwrap();
        let beyond = Beyond::of(&scene, &region).unwrap();
        assert!(!beyond.runs_on, "{}", beyond.why);
    }
}

#[test]
fn pictures_and_masks_are_read() {
    let Some(folder) = scene_folder("p1_object") else {
        return;
    };
    let scene = Scene::open(&folder, &all_views()).unwrap();
    assert!(scene.views.iter().all(|view| view.mask_path.is_some()));
    assert!(scene.skipped.is_empty(), "{:?}", scene.skipped);
    for view in [0, scene.views.len() - 1] {
        let picture = scene.load_picture(view).unwrap();
        assert_eq!(
            (picture.width, picture.height, picture.rgba.len()),
            (400, 300, 400 * 300 * 4)
        );
        let foreground = picture
            .rgba
            .chunks(4)
            .filter(|pixel| pixel[3] > 127)
            .count();
        assert!(
            foreground > 10_000 && foreground < 110_000,
            "{foreground} pixels of {}",
            scene.views[view].name
        );
    }
}
