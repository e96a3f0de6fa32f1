//! One rig of cameras in every layout gives the same rays; and the many ways in which layouts are bent in practice.

use std::fs;

use glam::{DMat4, DVec2, DVec3};
use neurodin::scene::{CameraModel, Format, Scene, SceneOptions, Split};
use npyz::WriterBuilder;
use serde_json::json;

use crate::fixtures::{Dataset, Rig, all_views, assert_rays, rows};

#[test]
fn colmap_text_and_binary_give_the_rays() {
    for binary in [false, true] {
        let (rig, dataset) = (Rig::skewed(6), Dataset::new());
        rig.write_pictures(&dataset.at("images"));
        let write = if binary {
            Rig::write_colmap_binary
        } else {
            Rig::write_colmap_text
        };
        write(&rig, &dataset.at("sparse/0"));
        let scene = dataset.open().unwrap();
        assert_eq!(scene.format, Format::Colmap);
        assert_rays(&rig, &scene);
        assert_eq!(scene.points.len(), rig.points.len());
        assert!((scene.points[5].position - rig.points[5]).length() < 1e-12);
        assert_eq!(scene.points[5].color, [10, 20, 30]);
        let names: Vec<_> = scene.views.iter().map(|view| view.name.clone()).collect();
        assert!(names.is_sorted(), "{names:?}");
    }
}

#[test]
fn transforms_dialects_give_the_rays() {
    let rig = Rig::skewed(6);
    let cases = [
        (
            Format::Nerfstudio,
            json!({"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}),
        ),
        (
            Format::InstantNgp,
            json!({"aabb_scale": 16, "scale": 0.5, "offset": [0.5, 0.5, 0.5]}),
        ),
        (
            Format::Neuralangelo,
            json!({"sphere_center": [1.0, 2.0, 0.5], "sphere_radius": 1.5, "sk_x": 0.0, "sk_y": 0.0,
                   "aabb_range": [[0.0, 2.0], [1.0, 3.0], [-0.5, 1.5]], "aabb_scale": 1.0}),
        ),
    ];
    for (format, extra) in cases {
        let scene = rig.dataset(&rig.transforms(extra)).open().unwrap();
        assert_eq!(scene.format, format);
        assert_rays(&rig, &scene);
    }
}

#[test]
fn one_rig_in_every_layout_gives_the_same_rays() {
    let mut rig = Rig::skewed(7);
    for (index, (name, _)) in rig.views.iter_mut().enumerate() {
        *name = format!("{index:08}");
    }
    let colmap = Dataset::new();
    rig.write_pictures(&colmap.at("images"));
    rig.write_colmap_binary(&colmap.at("sparse/0"));
    let ngp = json!({"aabb_scale": 4, "scale": 0.33, "offset": [0.5, 0.5, 0.5]});
    let neuralangelo = json!({"sphere_center": [1.0, 2.0, 0.5], "sphere_radius": 1.5});
    let mut opencv = rig.clone();
    for (index, (_, pose)) in opencv.views.iter_mut().enumerate() {
        *pose = rig.opencv_pose(index);
    }
    let neus2 =
        json!({"from_na": true, "aabb_scale": 1.0, "scale": 0.5, "offset": [0.5, 0.5, 0.5]});
    let layouts = [
        (Format::Colmap, colmap),
        (Format::Nerfstudio, rig.dataset(&rig.transforms(json!({})))),
        (Format::InstantNgp, rig.dataset(&rig.transforms(ngp))),
        (Format::InstantNgp, rig.dataset(&opencv.transforms(neus2))),
        (
            Format::Neuralangelo,
            rig.dataset(&rig.transforms(neuralangelo)),
        ),
        (Format::Sdfstudio, rig.sdfstudio(&rig.meta_data(json!({})))),
        (Format::Neus, rig.neus(DVec3::new(1.0, 2.0, 0.5), 1.5)),
        (Format::VisMvsnet, rig.mvsnet()),
    ];
    for (format, dataset) in layouts {
        let scene = dataset.open().unwrap();
        assert_eq!(scene.format, format);
        assert_rays(&rig, &scene);
    }
}

#[test]
fn neus2_holds_views_out_in_a_file_of_its_own() {
    let (rig, dataset) = (Rig::skewed(5), Dataset::new());
    rig.write_pictures(&dataset.at("images"));
    for (split, views) in [("train", 0..3), ("test", 3..5)] {
        let mut part = rig.clone();
        part.views = rig.views[views].to_vec();
        let transforms = part.transforms(json!({"from_na": false}));
        dataset.write(&format!("transform_{split}.json"), transforms.to_string());
    }
    let scene = dataset.open().unwrap();
    assert_rays(&rig, &scene);
    assert_eq!(scene.split(Split::Test).collect::<Vec<_>>(), [3, 4]);
}

#[test]
fn sdfstudio_intrinsics_may_be_small_and_refer_to_another_size() {
    let rig = Rig::skewed(4);
    let mut meta_data = rig.meta_data(json!({"width": 128, "height": 96, "has_mono_prior": true}));
    for frame in meta_data["frames"].as_array_mut().unwrap() {
        let [f, c] = [rig.focal * 2.0, rig.center * 2.0];
        frame["intrinsics"] = json!([[f.x, 0.0, c.x], [0.0, f.y, c.y], [0.0, 0.0, 1.0]]);
        frame["mono_depth_path"] = json!("depth.npy");
    }
    let scene = rig.sdfstudio(&meta_data).open().unwrap();
    assert_rays(&rig, &scene);
    let notes = scene.notes.join("\n");
    assert!(
        notes.contains("mono_depth_path of 4 frames") && notes.contains("128x96"),
        "{notes}"
    );

    // Without a size, lengths are in pixels of the picture.
    let mut meta_data = rig.meta_data(json!({}));
    meta_data.as_object_mut().unwrap().remove("width");
    meta_data.as_object_mut().unwrap().remove("height");
    assert_rays(&rig, &rig.sdfstudio(&meta_data).open().unwrap());
}

#[test]
fn an_sdfstudio_scene_knows_the_way_into_the_frame_of_the_truth() {
    // As sdfstudio makes it: the dataset is the world moved and scaled into a box, worldtogt the way back.
    let truth = Rig::skewed(6);
    let world_from_truth = DMat4::from_scale(DVec3::splat(0.125))
        * DMat4::from_translation(DVec3::new(-1.0, 2.0, 0.3));
    let mut rig = truth.clone();
    for (_, pose) in &mut rig.views {
        let position = world_from_truth.transform_point3(pose.w_axis.truncate());
        pose.w_axis = position.extend(1.0);
    }
    let meta_data = rig.meta_data(json!({"worldtogt": rows(world_from_truth.inverse())}));
    let dataset = rig.sdfstudio(&meta_data);
    let scene = dataset.open().unwrap();
    let back = scene.truth_from_world.unwrap();
    for (view, (_, pose)) in scene.views.iter().zip(&truth.views) {
        let position = back.transform_point3(view.position());
        assert!((position - pose.w_axis.truncate()).length() < 1e-9);
    }
    // A COLMAP model in the truth's frame gives its points, in the frame of the dataset's cameras.
    let mut colmap = truth.clone();
    for (name, _) in &mut colmap.views {
        *name += "_rgb";
    }
    colmap.write_colmap_binary(&dataset.at("colmap"));
    let scene = dataset.open().unwrap();
    assert_eq!(scene.points.len(), truth.points.len());
    let wanted = world_from_truth.transform_point3(truth.points[9]);
    assert!((scene.points[9].position - wanted).length() < 1e-9);
}

#[test]
fn neus_masks_belong_to_pictures_by_order_and_float32_is_enough() {
    let rig = Rig::skewed(5);
    let dataset = rig.neus(DVec3::ZERO, 1.0);
    fs::create_dir(dataset.at("mask")).unwrap();
    for index in 0..5u8 {
        let mask = image::GrayImage::from_pixel(rig.width, rig.height, image::Luma([index * 60]));
        mask.save(dataset.at(&format!("mask/{index:03}.png")))
            .unwrap();
    }
    let scene = dataset.open().unwrap();
    for (index, view) in scene.views.iter().enumerate() {
        let mask = view.mask_path.as_ref().unwrap();
        assert!(mask.ends_with(format!("mask/{index:03}.png")), "{mask:?}");
    }
    let picture = scene.load_picture(2).unwrap();
    assert!(picture.rgba.chunks(4).all(|pixel| pixel[3] == 120));

    // IDR's name, in single precision as its files are, and stored by columns.
    fs::remove_file(dataset.at("cameras_sphere.npz")).unwrap();
    let mut npz = npyz::npz::NpzWriter::create(dataset.at("cameras.npz")).unwrap();
    for index in 0..5 {
        let builder = npz
            .array(&format!("world_mat_{index}"), Default::default())
            .unwrap();
        let builder = builder.default_dtype().order(npyz::Order::Fortran);
        let mut writer = builder.shape(&[4, 4]).begin_nd().unwrap();
        let columns = rig.world_mat(index).to_cols_array();
        writer.extend(columns.map(|x| x as f32)).unwrap();
        writer.finish().unwrap();
    }
    drop(npz);
    let scene = dataset.open().unwrap();
    assert!(scene.region_hint.is_none());
    assert_rays(&rig, &scene);
}

#[test]
fn of_several_layouts_one_is_read_and_the_others_are_said() {
    let rig = Rig::skewed(4);
    let dataset = rig.dataset(&rig.transforms(json!({})));
    dataset.write("meta_data.json", "{}");
    dataset.write("cams/00000000_cam.txt", "");
    let scene = dataset.open().unwrap();
    assert_eq!(scene.format, Format::Nerfstudio);
    let skipped: Vec<_> = scene.skipped.iter().map(|skipped| &skipped.what).collect();
    assert!(
        skipped[0].ends_with("meta_data.json") && skipped[1].ends_with("cams"),
        "{skipped:?}"
    );
    // Named by its own file, another one is read.
    let whole = rig.sdfstudio(&rig.meta_data(json!({})));
    whole.write("transforms.json", "{}");
    let scene = Scene::open(&whole.at("meta_data.json"), &all_views()).unwrap();
    assert_eq!(scene.format, Format::Sdfstudio);
}

#[test]
fn blender_sets_give_the_rays() {
    let (rig, dataset) = (Rig::around_a_ball(8), Dataset::new());
    let angle = 2.0 * (0.5 * f64::from(rig.width) / rig.focal.x).atan();
    for (split, views) in [("train", 0..5), ("val", 5..6), ("test", 6..8)] {
        let mut part = rig.clone();
        part.views = rig.views[views].to_vec();
        part.write_pictures(&dataset.at(split));
        let frames = part.frames(|name| format!("./{split}/{name}"));
        let document = json!({"camera_angle_x": angle, "frames": frames});
        dataset.write(&format!("transforms_{split}.json"), document.to_string());
    }
    // The validation pictures are not those of the held-out split: what is left is 5 + 2.
    let scene = dataset.open().unwrap();
    assert_eq!(scene.format, Format::Blender);
    assert_eq!(
        (
            scene.split(Split::Train).count(),
            scene.split(Split::Test).count()
        ),
        (5, 2)
    );
    assert!(
        scene
            .skipped
            .iter()
            .any(|skipped| skipped.what.ends_with("transforms_val.json"))
    );
    let mut read = rig.clone();
    read.views.remove(5);
    assert_rays(&read, &scene);
}

#[test]
fn a_colmap_model_is_found_wherever_it_lies() {
    let rig = Rig::skewed(4);
    for (model, images, opened) in [
        ("sparse/0", "images", ""),
        ("sparse", "images", ""),
        ("colmap/sparse/0", "images", ""),
        ("", "images", ""),
        ("", "", ""),
        ("sparse/0", "input", ""),
        ("sparse/0", "images", "sparse/0"),
        ("sparse/0", "images", "sparse"),
        ("sparse/0", "images", "sparse/0/../0/../0"),
        ("colmap/sparse/0", "images", "colmap/sparse/0"),
    ] {
        let dataset = Dataset::new();
        rig.write_pictures(&dataset.at(images));
        rig.write_colmap_binary(&dataset.at(model));
        // COLMAP 4 writes these beside; they are not read.
        for name in ["rigs.bin", "frames.bin"] {
            fs::write(dataset.at(model).join(name), [1, 2, 3]).unwrap();
        }
        let scene = Scene::open(&dataset.at(opened), &all_views()).unwrap();
        assert_rays(&rig, &scene);
    }
}

#[test]
fn names_of_colmap_images_may_have_folders_and_spaces() {
    for binary in [false, true] {
        let (mut rig, dataset) = (Rig::skewed(4), Dataset::new());
        for (index, (name, _)) in rig.views.iter_mut().enumerate() {
            *name = format!("left side/pic {index}");
        }
        fs::create_dir_all(dataset.at("images/left side")).unwrap();
        rig.write_pictures(&dataset.at("images"));
        let write = if binary {
            Rig::write_colmap_binary
        } else {
            Rig::write_colmap_text
        };
        write(&rig, &dataset.at("sparse/0"));
        assert_rays(&rig, &dataset.open().unwrap());
    }
}

#[test]
fn other_models_of_the_same_pictures_are_named() {
    let (rig, dataset) = (Rig::skewed(4), Dataset::new());
    rig.write_pictures(&dataset.at("images"));
    rig.write_colmap_binary(&dataset.at("sparse/0"));
    rig.write_colmap_binary(&dataset.at("sparse/1"));
    let skipped = dataset.open().unwrap().skipped;
    assert_eq!(skipped.len(), 1);
    assert!(skipped[0].what.ends_with("sparse/1"), "{skipped:?}");
}

#[test]
fn paths_are_found_as_people_write_them() {
    let rig = Rig::skewed(3);
    let forms: [fn(&str) -> String; 6] = [
        |name| format!("./images/{name}.png"),
        |name| format!("images/{name}"),
        |name| format!("images\\{name}.png"),
        |name| format!("C:\\Users\\me\\scan\\images\\{name}.png"),
        |name| format!("/somewhere/else/{name}.jpg"),
        |name| format!("{name}.JPG"),
    ];
    for form in forms {
        let mut transforms = rig.transforms(json!({}));
        transforms["frames"] = rig.frames(form).into();
        assert_rays(&rig, &rig.dataset(&transforms).open().unwrap());
    }
}

#[test]
fn intrinsics_may_stand_in_each_frame() {
    let rig = Rig::skewed(3);
    let mut frames = rig.frames(|name| format!("images/{name}.png"));
    for frame in &mut frames {
        frame.as_object_mut().unwrap().extend(rig.intrinsics());
    }
    // What the file says at its top is for other pictures.
    let transforms =
        json!({"fl_x": 1.0, "fl_y": 1.0, "cx": 0.0, "cy": 0.0, "w": 2, "h": 2, "frames": frames});
    assert_rays(&rig, &rig.dataset(&transforms).open().unwrap());

    let matrix = json!([
        [rig.focal.x, 0.0, rig.center.x],
        [0.0, rig.focal.y, rig.center.y],
        [0.0, 0.0, 1.0]
    ]);
    let transforms = json!({"intrinsic_matrix": matrix, "frames": rig.frames(|name| format!("images/{name}.png"))});
    assert_rays(&rig, &rig.dataset(&transforms).open().unwrap());
}

#[test]
fn three_rows_and_a_scale_make_a_pose_too() {
    let rig = Rig::skewed(3);
    let mut transforms = rig.transforms(json!({}));
    for frame in transforms["frames"].as_array_mut().unwrap() {
        let rows = frame["transform_matrix"].as_array_mut().unwrap();
        rows.pop();
        for row in rows {
            for entry in &mut row.as_array_mut().unwrap()[..3] {
                *entry = json!(entry.as_f64().unwrap() * 2.5);
            }
        }
    }
    assert_rays(&rig, &rig.dataset(&transforms).open().unwrap());
}

#[test]
fn lens_keys_choose_the_model() {
    let rig = Rig::skewed(2);
    let cases = [
        (json!({}), CameraModel::Pinhole, vec![]),
        (
            json!({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}),
            CameraModel::Opencv,
            vec![0.1, 0.2, 0.3, 0.4],
        ),
        (
            json!({"k1": 0.1, "k2": 0.2, "k3": 0.5, "p1": 0.3, "p2": 0.4}),
            CameraModel::FullOpencv,
            vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0],
        ),
        (
            json!({"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "is_fisheye": true}),
            CameraModel::OpencvFisheye,
            vec![0.1, 0.2, 0.3, 0.4],
        ),
        (
            json!({"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "camera_model": "OPENCV_FISHEYE"}),
            CameraModel::OpencvFisheye,
            vec![0.1, 0.2, 0.3, 0.4],
        ),
    ];
    for (keys, model, distortion) in cases {
        let scene = rig.dataset(&rig.transforms(keys)).open().unwrap();
        let camera = &scene.views[0].camera;
        assert_eq!(camera.model, model);
        let mut wanted = vec![rig.focal.x, rig.focal.y, rig.center.x, rig.center.y];
        wanted.extend(distortion);
        assert_eq!(camera.params, wanted);
    }
}

#[test]
fn distortion_may_be_a_list_where_no_key_says_it() {
    let rig = Rig::skewed(2);
    let list = json!([0.1, 0.2, 0.0, 0.0, 0.3, 0.4]);
    let distortion = |transforms: &serde_json::Value| {
        let scene = rig.dataset(transforms).open().unwrap();
        scene.views[1].camera.params[4..].to_vec()
    };
    let whole = rig.transforms(json!({"distortion_params": list}));
    assert_eq!(distortion(&whole), [0.1, 0.2, 0.3, 0.4]);
    let mut own = rig.transforms(json!({"distortion_params": [0.5, 0, 0, 0, 0, 0]}));
    own["frames"][1]["distortion_params"] = list.clone();
    assert_eq!(distortion(&own), [0.1, 0.2, 0.3, 0.4]);
    own["k1"] = json!(0.7);
    assert_eq!(distortion(&own), [0.1, 0.2, 0.3, 0.4], "a frame's own");
    let keys = rig.transforms(json!({"distortion_params": list, "k1": 0.7}));
    assert_eq!(distortion(&keys), [0.7, 0.0, 0.0, 0.0]);
    rig.dataset(&rig.transforms(json!({"distortion_params": [0.1, 0.2]})))
        .refuses(&["distortion_params is [0.1,0.2]", "k1, k2, k3, k4, p1, p2"]);
}

#[test]
fn keys_that_are_not_used_are_said() {
    let rig = Rig::skewed(3);
    let mut transforms = rig.transforms(json!({"fisheye_crop_radius": 30.0}));
    for frame in &mut transforms["frames"].as_array_mut().unwrap()[..2] {
        frame["depth_file_path"] = json!("depth.png");
    }
    let skipped = rig.dataset(&transforms).open().unwrap().skipped;
    let what: Vec<_> = skipped.iter().map(|skipped| &skipped.what).collect();
    assert_eq!(what, ["fisheye_crop_radius", "depth_file_path of 2 frames"]);
}

#[test]
fn held_out_views_come_from_the_dataset_or_every_eighth() {
    let rig = Rig::skewed(20);
    let splits = |scene: &Scene| {
        (
            scene.split(Split::Train).count(),
            scene.split(Split::Test).count(),
        )
    };

    let dataset = rig.dataset(&rig.transforms(json!({})));
    let open = |holdout| {
        let options = SceneOptions {
            holdout,
            ..SceneOptions::default()
        };
        Scene::open(dataset.path(), &options)
    };
    let scene = open(8).unwrap();
    assert_eq!(scene.split(Split::Test).collect::<Vec<_>>(), [0, 8, 16]);
    assert_eq!(splits(&open(0).unwrap()), (20, 0));
    assert_eq!(
        splits(&open(15).unwrap()),
        (20, 0),
        "two held out of twenty would leave too little to tell"
    );
    assert!(open(1).is_err());

    // A file of its own; one picture stands in both, and must not be trained on.
    let mut train = rig.clone();
    train.views.truncate(17);
    let dataset = rig.dataset(&train.transforms(json!({})));
    let mut test = rig.clone();
    test.views.drain(..16);
    dataset.write(
        "transforms_test.json",
        test.transforms(json!({})).to_string(),
    );
    let scene = Scene::open(dataset.path(), &SceneOptions::default()).unwrap();
    assert_eq!(splits(&scene), (16, 4));
    assert!(
        scene
            .notes
            .iter()
            .any(|note| note.contains("1 views are in")),
        "{:?}",
        scene.notes
    );

    // nerfstudio's lists.
    let names = |range: std::ops::Range<usize>| -> Vec<String> {
        rig.views[range]
            .iter()
            .map(|(name, _)| format!("images/{name}.png"))
            .collect()
    };
    let lists = json!({"train_filenames": names(0..15), "test_filenames": names(15..18)});
    let scene = rig.dataset(&rig.transforms(lists)).open().unwrap();
    assert_eq!(splits(&scene), (15, 3));
    assert_eq!(scene.skipped[0].what, "2 frames");
}

#[test]
fn scannetpp_holds_views_out_names_bad_ones_and_keeps_pictures_beside() {
    let (rig, dataset) = (Rig::skewed(8), Dataset::new());
    let mut frames = rig.frames(|name| format!("{name}.png"));
    for frame in &mut frames {
        frame["mask_path"] = frame["file_path"].clone();
        frame["is_bad"] = json!(false);
    }
    frames[1]["is_bad"] = json!(true);
    let mut transforms = rig.transforms(json!({}));
    // As its undistorting script leaves it, held-out views are in both lists.
    transforms["frames"] = [&frames[..6], &frames[7..]].concat().into();
    frames[7]["is_bad"] = json!(true);
    transforms["test_frames"] = frames[5..].into();
    for (file, images, masks) in [
        ("transforms.json", "resized_images", "resized_anon_masks"),
        (
            "transforms_undistorted.json",
            "resized_undistorted_images",
            "resized_undistorted_masks",
        ),
    ] {
        let file = format!("dslr/nerfstudio/{file}");
        dataset.write(&file, transforms.to_string());
        rig.write_pictures(&dataset.at("dslr").join(images));
        rig.write_pictures(&dataset.at("dslr").join(masks));
        let scene = Scene::open(&dataset.at(&file), &SceneOptions::default()).unwrap();
        let mut read = rig.clone();
        read.views.truncate(7);
        read.views.remove(1);
        assert_rays(&read, &scene);
        assert_eq!(scene.split(Split::Test).collect::<Vec<_>>(), [4, 5]);
        assert!(scene.views[4].name.contains(&rig.views[5].0));
        let skipped = &scene.skipped[0];
        assert!(
            skipped.what.contains(&rig.views[1].0) && skipped.why.contains("is_bad"),
            "{skipped:?}"
        );
        for view in &scene.views {
            let mask = view.mask_path.as_ref().unwrap();
            assert!(view.image_path.parent().unwrap().ends_with(images));
            assert!(mask.parent().unwrap().ends_with(masks), "{mask:?}");
        }
    }
}

#[test]
fn points_come_from_the_ply_file_named() {
    let rig = Rig::skewed(3);
    let dataset = rig.dataset(&rig.transforms(json!({"ply_file_path": ".\\sparse_pc.ply"})));
    let header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                  property uint8 red\nproperty uint8 green\nproperty uint8 blue\nend_header\n";
    dataset.write(
        "sparse_pc.ply",
        format!("{header}1 2 3 4 5 6\n-1 0.5 7 255 0 9\n"),
    );
    let points = dataset.open().unwrap().points;
    assert_eq!(points.len(), 2);
    assert_eq!(
        (points[1].position, points[1].color),
        (DVec3::new(-1.0, 0.5, 7.0), [255, 0, 9])
    );

    fs::remove_file(dataset.at("sparse_pc.ply")).unwrap();
    let scene = dataset.open().unwrap();
    assert!(scene.points.is_empty());
    assert!(
        scene.skipped[0].why.contains("ply_file_path"),
        "{:?}",
        scene.skipped
    );
}

#[test]
fn points_of_a_model_beside_transforms_are_used_if_its_cameras_agree() {
    let rig = Rig::skewed(6);
    let dataset = rig.dataset(&rig.transforms(json!({})));
    rig.write_colmap_binary(&dataset.at("sparse/0"));
    let scene = dataset.open().unwrap();
    assert_eq!(scene.format, Format::Nerfstudio);
    assert_eq!(scene.points.len(), rig.points.len());

    // Another frame of reference, as nerfstudio makes it: refused unless the file says how it was made.
    let applied = DMat4::from_rotation_translation(
        glam::DQuat::from_rotation_x(1.0),
        DVec3::new(3.0, 0.0, 1.0),
    );
    let mut moved = rig.clone();
    for (_, pose) in &mut moved.views {
        *pose = applied * *pose;
    }
    let dataset = moved.dataset(&moved.transforms(json!({})));
    rig.write_colmap_binary(&dataset.at("sparse/0"));
    let scene = dataset.open().unwrap();
    assert!(scene.points.is_empty());
    assert!(
        scene.skipped[0].why.contains("another frame"),
        "{:?}",
        scene.skipped
    );

    let rows: Vec<[f64; 4]> = (0..3).map(|row| applied.row(row).to_array()).collect();
    dataset.write(
        "transforms.json",
        moved
            .transforms(json!({"applied_transform": rows}))
            .to_string(),
    );
    let scene = dataset.open().unwrap();
    assert_eq!(scene.points.len(), rig.points.len());
    let wanted = applied.transform_point3(rig.points[7]);
    assert!((scene.points[7].position - wanted).length() < 1e-9);

    // Before nerfstudio said what it did, it did this.
    let swapped = |p: DVec3| DVec3::new(p.y, p.x, -p.z);
    let mut older = rig.clone();
    for (_, pose) in &mut older.views {
        let [x, y, z, w] = [pose.x_axis, pose.y_axis, pose.z_axis, pose.w_axis]
            .map(|axis| swapped(axis.truncate()).extend(axis.w));
        *pose = DMat4::from_cols(x, y, z, w);
    }
    let dataset = older.dataset(&older.transforms(json!({})));
    rig.write_colmap_binary(&dataset.at("sparse/0"));
    let scene = dataset.open().unwrap();
    assert_eq!(scene.points.len(), rig.points.len());
    assert!((scene.points[7].position - swapped(rig.points[7])).length() < 1e-9);
}

#[test]
fn fields_of_view_in_degrees_are_read() {
    let rig = Rig::around_a_ball(3);
    let degrees = |side: u32, focal: f64| 2.0 * (0.5 * f64::from(side) / focal).atan().to_degrees();
    let transforms = json!({
        "x_fov": degrees(64, 70.0), "y_fov": degrees(48, 70.0),
        "frames": rig.frames(|name| format!("images/{name}.png")),
    });
    let scene = rig.dataset(&transforms).open().unwrap();
    assert_rays(&rig, &scene);
    let centre = scene.views[0].camera.direction(DVec2::new(32.0, 24.0));
    assert!((centre - DVec3::NEG_Z).length() < 1e-12);
}
