//! The region: what is stated, what is estimated in spite of outliers, and what the preview shows of it.

use glam::{DVec3, Vec3};
use neurodin::scene::{
    Beyond, Facing, Looks, Region, RegionOverrides, RegionShape, Scene, write_preview,
};
use serde_json::{Value, json};

use crate::fixtures::{Dataset, Rig, look_at, sphere};

fn estimate(scene: &Scene) -> Region {
    Region::estimate(scene, &RegionOverrides::default()).unwrap()
}

fn colmap_scene(rig: &Rig) -> (Dataset, Scene) {
    let dataset = Dataset::new();
    rig.write_pictures(&dataset.at("images"));
    rig.write_colmap_binary(&dataset.at("sparse/0"));
    let scene = dataset.open().unwrap();
    (dataset, scene)
}

fn transforms_scene(rig: &Rig, extra: Value) -> Scene {
    rig.dataset(&rig.transforms(extra)).open().unwrap()
}

/// Cameras near the middle of a room of ±(3, 4, 1.5) that look at its walls.
fn room() -> Rig {
    let mut rig = Rig::around_a_ball(24);
    rig.focal = glam::DVec2::splat(40.0);
    for (index, (_, pose)) in rig.views.iter_mut().enumerate() {
        let angle = index as f64 * 0.7;
        let outwards = DVec3::new(angle.cos(), angle.sin(), 0.2 * (5.0 * angle).sin());
        let eye = DVec3::new(0.8 * angle.cos(), 0.8 * angle.sin(), 0.1);
        *pose = look_at(eye, eye + outwards);
    }
    let half = DVec3::new(3.0, 4.0, 1.5);
    rig.points = sphere(3000, DVec3::ZERO, 1.0)
        .into_iter()
        .map(|direction| direction / (direction / half).abs().max_element())
        .collect();
    rig
}

#[test]
fn an_object_is_bounded_in_spite_of_outliers_and_background() {
    let mut rig = Rig::around_a_ball(24);
    let middle = DVec3::new(1.0, 2.0, 0.5);
    rig.points = sphere(2000, middle, 1.0);
    // Mismatches: some anywhere, some absurdly far. Background: behind each camera's opposite number.
    rig.points
        .extend(sphere(40, middle + DVec3::new(3.0, -1.0, 2.0), 2.5));
    rig.points.extend(sphere(20, middle, 5e4));
    rig.points.extend(sphere(1500, middle, 30.0));
    let (_dataset, scene) = colmap_scene(&rig);
    let looks = Looks::of(&scene);
    assert_eq!(looks.facing, Facing::Inward, "{}", looks.why);
    assert!(looks.focus.unwrap().distance(middle) < 1e-6);
    let region = estimate(&scene);
    assert_eq!(region.shape, RegionShape::Sphere);
    assert!(region.center.distance(middle) < 0.1, "{region:?}");
    assert!(region.radius > 1.0 && region.radius < 1.5, "{region:?}");
    assert!(region.how.contains("sparse points"), "{}", region.how);
    assert_eq!(region.cameras_inside(&scene), 0);
    assert!(region.points_inside(&scene) >= 2000);
}

#[test]
fn a_room_is_bounded_by_its_walls_and_holds_its_cameras() {
    let mut rig = room();
    rig.points
        .extend(sphere(60, DVec3::new(20.0, 5.0, 0.0), 8.0)); // through the window
    let (_dataset, scene) = colmap_scene(&rig);
    let looks = Looks::of(&scene);
    assert_eq!(looks.facing, Facing::Outward, "{}", looks.why);
    let region = estimate(&scene);
    assert!(region.center.length() < 0.3, "{region:?}");
    let corner = DVec3::new(3.0, 4.0, 1.5).length();
    assert!(
        region.radius > 0.9 * corner && region.radius < 1.3 * corner,
        "{region:?}"
    );
    assert_eq!(region.cameras_inside(&scene), 24);

    let boxed = RegionOverrides {
        prefer_box: true,
        ..Default::default()
    };
    let region = Region::estimate(&scene, &boxed).unwrap();
    let RegionShape::Box { half } = region.shape else {
        panic!("{region:?}")
    };
    let extents = half * region.radius;
    assert!(
        (extents - DVec3::new(3.3, 4.4, 1.65)).abs().max_element() < 0.3,
        "{extents}"
    );
}

#[test]
fn without_points_cameras_alone_decide() {
    let mut rig = Rig::around_a_ball(24);
    rig.points.clear();
    let region = estimate(&transforms_scene(&rig, json!({})));
    assert!(
        region.center.distance(DVec3::new(1.0, 2.0, 0.5)) < 1e-6,
        "{region:?}"
    );
    // Fits the pictures: 4.1 away, 24 of 70 pixels from the middle to the nearer edge.
    assert!(region.radius > 1.2 && region.radius < 1.5, "{region:?}");
    assert!(region.how.contains("no points"), "{}", region.how);

    let mut rig = room();
    rig.points.clear();
    let region = estimate(&transforms_scene(&rig, json!({})));
    assert!(
        region.center.length() < 0.2 && region.radius > 3.0 && region.radius < 4.0,
        "{region:?}"
    );
    assert!(region.how.contains("a guess"), "{}", region.how);

    // Parallel views: before the cameras, as wide as they are spread.
    let mut rig = Rig::around_a_ball(9);
    for (index, (_, pose)) in rig.views.iter_mut().enumerate() {
        let eye = DVec3::new((index % 3) as f64, 0.0, (index / 3) as f64);
        *pose = look_at(eye, eye + DVec3::Y);
    }
    let scene = transforms_scene(&rig, json!({}));
    let looks = Looks::of(&scene);
    assert_eq!(
        (looks.facing, looks.focus),
        (Facing::Inward, None),
        "{}",
        looks.why
    );
    let region = estimate(&scene);
    assert!(region.center.y > region.radius, "{region:?}");
}

#[test]
fn what_lies_beyond_the_region_is_told_by_pixels_and_points() {
    let mut rig = Rig::around_a_ball(8);
    let middle = DVec3::new(1.0, 2.0, 0.5);
    let beyond = |rig: &Rig, radius: f64, backdrop: Option<[u8; 3]>| {
        let (dataset, mut scene) = colmap_scene(rig);
        if let Some(backdrop) = backdrop {
            // A dotted ball before one colour, with a little noise; its outline leaks out of the region.
            let ball = Region {
                center: middle,
                radius: 1.05,
                shape: RegionShape::Sphere,
                how: String::new(),
            };
            for view in &scene.views {
                let picture = image::RgbImage::from_fn(rig.width, rig.height, |x, y| {
                    let pixel = glam::DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    let (origin, direction) = view.ray(pixel);
                    let nearest = origin + direction * (ball.center - origin).dot(direction);
                    image::Rgb(match ball.contains(nearest) {
                        true => [(x * 40 % 256) as u8, (y * 70 % 256) as u8, 9],
                        false => backdrop.map(|channel| channel + ((x + 2 * y) % 5) as u8),
                    })
                });
                picture.save(&view.image_path).unwrap();
            }
            scene = dataset.open().unwrap();
        }
        let region = Region {
            center: middle,
            radius,
            shape: RegionShape::Sphere,
            how: String::new(),
        };
        Beyond::of(&scene, &region).unwrap()
    };
    let even = beyond(&rig, 1.02, Some([90, 140, 200]));
    assert!(!even.runs_on, "{}", even.why);
    assert!(even.why.contains("(92, 142, 202)"), "{}", even.why);
    let uneven = beyond(&rig, 1.02, None);
    assert!(
        uneven.runs_on && uneven.why.contains("median colour"),
        "{}",
        uneven.why
    );
    // A region that fills the pictures: points decide, and without them the worse is supposed.
    let filled = beyond(&rig, 3.9, None);
    assert!(
        !filled.runs_on && filled.why.contains("100 %"),
        "{}",
        filled.why
    );
    rig.points.extend(sphere(100, middle, 9.0));
    let ground = beyond(&rig, 1.02, Some([90, 140, 200]));
    assert!(
        ground.runs_on && ground.why.contains("20 % of the sparse"),
        "{}",
        ground.why
    );
    rig.points.clear();
    let unknown = beyond(&rig, 3.9, None);
    assert!(
        unknown.runs_on && unknown.why.contains("no points"),
        "{}",
        unknown.why
    );
}

#[test]
fn boxes_and_spheres_of_other_layouts_are_taken() {
    let rig = Rig::around_a_ball(8);
    let sdfstudio = |scene_box: Value| {
        let meta_data = rig.meta_data(json!({"scene_box": scene_box}));
        estimate(&rig.sdfstudio(&meta_data).open().unwrap())
    };
    let region = sdfstudio(json!({
        "aabb": [[-1, 0, -1], [3, 4, 2]], "near": 0.05, "far": 2.5, "radius": 1.0, "collider_type": "box",
    }));
    assert_eq!(
        (region.center, region.radius),
        (DVec3::new(1.0, 2.0, 0.5), 2.0)
    );
    let half = DVec3::new(1.0, 1.0, 0.75);
    assert_eq!(region.shape, RegionShape::Box { half });
    assert!(region.how.contains("scene_box"), "{}", region.how);
    let region = sdfstudio(
        json!({"aabb": [[-1, -1, -1], [1, 1, 1]], "radius": 1.5, "collider_type": "sphere"}),
    );
    assert_eq!(
        (region.center, region.radius, region.shape),
        (DVec3::ZERO, 1.5, RegionShape::Sphere)
    );

    let center = DVec3::new(1.0, 2.0, 0.5);
    let scene = rig.neus(center, 1.25).open().unwrap();
    let region = estimate(&scene);
    assert_eq!(
        (region.center, region.radius, region.shape),
        (center, 1.25, RegionShape::Sphere)
    );
    assert!(region.how.contains("scale_mat_0"), "{}", region.how);
    let other = RegionOverrides {
        radius: Some(2.0),
        ..Default::default()
    };
    assert_eq!(Region::estimate(&scene, &other).unwrap().radius, 2.0);
}

#[test]
fn what_the_dataset_states_is_taken() {
    let rig = Rig::around_a_ball(8);
    let center = DVec3::new(1.0, 2.0, 0.5);
    let region = estimate(&transforms_scene(
        &rig,
        json!({"sphere_center": [1.0, 2.0, 0.5], "sphere_radius": 1.35}),
    ));
    assert_eq!(
        (region.center, region.radius, region.shape),
        (center, 1.35, RegionShape::Sphere)
    );
    assert!(region.how.contains("sphere_center"), "{}", region.how);

    let range = json!({"aabb_range": [[0.0, 2.0], [1.0, 3.0], [0.0, 1.0]]});
    let region = estimate(&transforms_scene(&rig, range));
    let half = DVec3::new(1.0, 1.0, 0.5);
    assert_eq!(
        (region.center, region.radius, region.shape),
        (center, 1.0, RegionShape::Box { half })
    );

    // instant-ngp: 0.25 x + (0.25, 0, 0.375) lies in the unit cube for |x - (1, 2, 0.5)| <= 2.
    let cube = json!({"aabb_scale": 1, "scale": 0.25, "offset": [0.25, 0.0, 0.375]});
    let region = estimate(&transforms_scene(&rig, cube));
    assert_eq!(
        (region.center, region.radius, region.shape),
        (center, 2.0, RegionShape::Box { half: DVec3::ONE })
    );
    // A larger aabb_scale holds the background, too.
    let region = estimate(&transforms_scene(&rig, json!({"aabb_scale": 16})));
    assert!(region.how.contains("no points"), "{}", region.how);
}

#[test]
fn overrides_come_first() {
    let rig = Rig::around_a_ball(8);
    let scene = transforms_scene(
        &rig,
        json!({"sphere_center": [1.0, 2.0, 0.5], "sphere_radius": 1.35}),
    );
    let with = |overrides: RegionOverrides| Region::estimate(&scene, &overrides);
    let none = RegionOverrides::default;

    let region = with(RegionOverrides {
        center: Some([0.0, 1.0, 2.0]),
        radius: Some(3.0),
        ..none()
    })
    .unwrap();
    assert_eq!(
        (region.center, region.radius),
        (DVec3::new(0.0, 1.0, 2.0), 3.0)
    );
    let region = with(RegionOverrides {
        center: Some([0.0, 1.0, 2.0]),
        ..none()
    })
    .unwrap();
    assert_eq!(
        (region.center, region.radius),
        (DVec3::new(0.0, 1.0, 2.0), 1.35)
    );
    let region = with(RegionOverrides {
        radius: Some(3.0),
        scale: 2.0,
        ..none()
    })
    .unwrap();
    assert_eq!(
        (region.center, region.radius),
        (DVec3::new(1.0, 2.0, 0.5), 6.0)
    );
    let corners = Some([[1.0, 3.0, 0.0], [-1.0, -1.0, 1.0]]);
    let region = with(RegionOverrides {
        boxed: corners,
        ..none()
    })
    .unwrap();
    assert_eq!(
        (region.center, region.radius),
        (DVec3::new(0.0, 1.0, 0.5), 2.0)
    );
    assert_eq!(
        region.shape,
        RegionShape::Box {
            half: DVec3::new(0.5, 1.0, 0.25)
        }
    );
    assert!(
        region.contains(DVec3::new(0.9, 2.9, 0.9)) && !region.contains(DVec3::new(0.9, 2.9, 1.1))
    );

    for senseless in [
        RegionOverrides {
            radius: Some(0.0),
            ..none()
        },
        RegionOverrides {
            radius: Some(f64::NAN),
            ..none()
        },
        RegionOverrides {
            center: Some([f64::INFINITY, 0.0, 0.0]),
            ..none()
        },
        RegionOverrides {
            scale: -1.0,
            ..none()
        },
        RegionOverrides {
            boxed: Some([[0.0; 3], [1.0, 1.0, 0.0]]),
            ..none()
        },
        RegionOverrides {
            boxed: corners,
            radius: Some(1.0),
            ..none()
        },
    ] {
        assert_eq!(
            with(senseless.clone()).unwrap_err().exit_code(),
            3,
            "{senseless:?}"
        );
    }
}

#[test]
fn cameras_in_one_place_need_a_stated_region() {
    let mut rig = Rig::around_a_ball(4);
    for (_, pose) in &mut rig.views {
        *pose = look_at(DVec3::ZERO, DVec3::X);
    }
    let scene = transforms_scene(&rig, json!({}));
    let error = Region::estimate(&scene, &RegionOverrides::default()).unwrap_err();
    assert!(error.to_string().contains("--center"), "{error}");
    let given = RegionOverrides {
        center: Some([1.0, 0.0, 0.0]),
        radius: Some(0.5),
        ..Default::default()
    };
    assert!(Region::estimate(&scene, &given).is_ok());
}

#[test]
fn region_frames_are_each_others_inverse_and_survive_json() {
    let region = Region {
        center: DVec3::new(1.0, -2.0, 3.0),
        radius: 2.5,
        shape: RegionShape::Box {
            half: DVec3::new(1.0, 0.5, 0.25),
        },
        how: "test".into(),
    };
    let point = DVec3::new(0.3, 0.7, -0.2);
    let there = region.world_from_region().transform_point3(point);
    assert!((there - (point * 2.5 + region.center)).length() < 1e-12);
    assert!((region.region_from_world().transform_point3(there) - point).length() < 1e-12);
    let text = serde_json::to_string(&region).unwrap();
    assert_eq!(serde_json::from_str::<Region>(&text).unwrap(), region);
}

/// Vertices and edges of a preview.
fn read_preview(path: &std::path::Path) -> (Vec<Vec3>, Vec<[i32; 2]>) {
    let data = std::fs::read(path).unwrap();
    let end = data
        .windows(11)
        .position(|window| window == b"end_header\n")
        .unwrap()
        + 11;
    let header = String::from_utf8(data[..end].to_vec()).unwrap();
    let count = |element: &str| -> usize {
        let line = header
            .lines()
            .find(|line| line.starts_with(element))
            .unwrap();
        line.rsplit(' ').next().unwrap().parse().unwrap()
    };
    let (vertices, edges) = (count("element vertex"), count("element edge"));
    assert_eq!(data.len(), end + vertices * 27 + edges * 8);
    let double = |bytes: &[u8]| f64::from_le_bytes(bytes.try_into().unwrap()) as f32;
    let position = |vertex: &[u8]| {
        Vec3::new(
            double(&vertex[..8]),
            double(&vertex[8..16]),
            double(&vertex[16..24]),
        )
    };
    let int = |bytes: &[u8]| i32::from_le_bytes(bytes.try_into().unwrap());
    (
        data[end..end + vertices * 27]
            .chunks(27)
            .map(position)
            .collect(),
        data[end + vertices * 27..]
            .chunks(8)
            .map(|edge| [int(&edge[..4]), int(&edge[4..])])
            .collect(),
    )
}

#[test]
fn the_preview_holds_cameras_points_and_region() {
    let (dataset, scene) = colmap_scene(&Rig::around_a_ball(8));
    let region = estimate(&scene);
    let file = dataset.at("preview.ply");
    write_preview(&scene, &region, &file).unwrap();
    let (vertices, edges) = read_preview(&file);
    assert!(
        edges
            .iter()
            .flatten()
            .all(|vertex| (*vertex as usize) < vertices.len())
    );
    let near = |point: DVec3| {
        vertices
            .iter()
            .any(|vertex| vertex.distance(point.as_vec3()) < 1e-4)
    };
    assert!(scene.views.iter().all(|view| near(view.position())));
    assert!(scene.points.iter().all(|point| near(point.position)));
    let on_region = |vertex: &&Vec3| {
        (vertex.as_dvec3().distance(region.center) / region.radius - 1.0).abs() < 1e-5
    };
    assert_eq!(vertices.iter().filter(on_region).count(), 3 * 192);

    let nowhere =
        write_preview(&scene, &region, &dataset.at("no/such/folder/preview.ply")).unwrap_err();
    assert_eq!(nowhere.exit_code(), 8);
}
