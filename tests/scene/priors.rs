//! Depths and normals beside the pictures, object masks: how they are read, and what is refused.

use std::fs;

use image::{GrayImage, Luma};
use neurodin::scene::{ObjectMasks, PriorKind, Scene};
use npyz::{AutoSerialize, WriterBuilder};
use serde_json::json;

use crate::fixtures::{Dataset, Rig, refused};

fn write_npy<T: AutoSerialize + Clone>(dataset: &Dataset, name: &str, shape: &[u64], values: &[T]) {
    let out = fs::File::create(dataset.at(name)).unwrap();
    let options = npyz::WriteOptions::new().default_dtype().shape(shape);
    let mut writer = options.writer(out).begin_nd().unwrap();
    writer.extend(values.iter().cloned()).unwrap();
    writer.finish().unwrap();
}

/// Four views of 64x48 pixels; the first `named` frames name all priors.
fn dataset(named: usize) -> Dataset {
    let rig = Rig::skewed(4);
    let mut meta_data = rig.meta_data(json!({}));
    for frame in meta_data["frames"].as_array_mut().unwrap()[..named].iter_mut() {
        frame["mono_depth_path"] = json!("depth.npy");
        frame["mono_normal_path"] = json!("normal.npy");
        frame["sensor_depth_path"] = json!("sensor.npy");
    }
    rig.sdfstudio(&meta_data)
}

#[test]
fn depths_and_normals_are_read_as_sdfstudio_writes_them() {
    let dataset = dataset(4);
    let (w, h) = (64, 48);
    let mut depth = vec![0.25; 64 * 48];
    (depth[0], depth[1]) = (0.0, f64::NAN);
    write_npy(&dataset, "depth.npy", &[h, w], &depth);
    // Half as large, and unknown in three ways.
    let mut sensor = vec![1.5; 32 * 24];
    (sensor[0], sensor[1], sensor[2]) = (0.0, f64::NAN, -1.0);
    write_npy(&dataset, "sensor.npy", &[1, 24, 32], &sensor);
    // Towards the camera and a little up and to the right, in OpenCV's axes; the first pixel's has no length.
    let n = [2.0 / 7.0, -3.0 / 7.0, -6.0 / 7.0];
    let mut normal: Vec<f64> = (0..3 * 64 * 48)
        .map(|i| (n[i / (64 * 48)] + 1.0) / 2.0)
        .collect();
    (0..3).for_each(|axis| normal[axis * 64 * 48] = 0.5);
    write_npy(&dataset, "normal.npy", &[3, h, w], &normal);

    let scene = dataset.open().unwrap();
    let notes = scene.notes.join("\n");
    assert!(
        notes.contains("mono_normal_path of 4 frames") && notes.contains("loss.mono_normal"),
        "{notes}"
    );
    let prior = scene.load_prior(1, PriorKind::MonoDepth).unwrap();
    assert_eq!((prior.width, prior.height), (64, 48));
    assert!(prior.values[0] == 0.0 && prior.values[1].is_nan() && prior.values[2] == 0.25);
    let prior = scene.load_prior(1, PriorKind::SensorDepth).unwrap();
    assert_eq!((prior.width, prior.height), (32, 24));
    assert_eq!(prior.values[..4], [0.0, 0.0, 0.0, 1.5]);
    let prior = scene.load_prior(1, PriorKind::MonoNormal).unwrap();
    let at = |pixel: usize| [0, 1, 2].map(|axis| prior.values[axis * 64 * 48 + pixel]);
    assert_eq!(at(0), [0.0; 3]);
    for (got, wanted) in at(7).iter().zip([2.0 / 7.0, 3.0 / 7.0, 6.0 / 7.0]) {
        assert!((got - wanted).abs() < 1e-6, "{:?}", at(7));
    }
}

#[test]
fn half_precision_is_read() {
    let dataset = dataset(4);
    let depth = vec![half::f16::from_f32(0.75); 64 * 48];
    write_npy(&dataset, "depth.npy", &[48, 64], &depth);
    let scene = dataset.open().unwrap();
    let prior = scene.load_prior(0, PriorKind::MonoDepth).unwrap();
    assert!(prior.values.iter().all(|&depth| depth == 0.75));
}

#[test]
fn what_is_no_prior_of_its_picture_is_refused() {
    let dataset = dataset(3);
    let load = |view: usize, kind: PriorKind| dataset.open().unwrap().load_prior(view, kind);
    refused(
        load(3, PriorKind::MonoDepth),
        &["loss.mono_depth", "view_003_rgb.png has none", "3 of 4"],
    );
    assert!(load(0, PriorKind::MonoDepth).is_err(), "no such file");

    write_npy(&dataset, "depth.npy", &[48, 60], &[1.0; 48 * 60]);
    refused(
        load(0, PriorKind::MonoDepth),
        &[
            "depth.npy",
            "60x48",
            "64x48",
            "view_000",
            "loss.mono_depth=0",
        ],
    );
    write_npy(&dataset, "depth.npy", &[2, 48, 64], &[1.0; 2 * 48 * 64]);
    refused(
        load(0, PriorKind::MonoDepth),
        &["[2, 48, 64]", "[height, width]"],
    );
    write_npy(&dataset, "depth.npy", &[0, 64], &[0.0; 0]);
    refused(load(0, PriorKind::MonoDepth), &["64x0"]);
    write_npy(&dataset, "depth.npy", &[48, 64], &[f64::NAN; 48 * 64]);
    refused(load(0, PriorKind::MonoDepth), &["holds no value"]);

    write_npy(&dataset, "sensor.npy", &[48, 64], &[0.0; 48 * 64]);
    refused(
        load(0, PriorKind::SensorDepth),
        &["sensor.npy", "holds no value"],
    );

    write_npy(&dataset, "normal.npy", &[48, 64, 3], &[0.5; 3 * 48 * 64]);
    refused(
        load(0, PriorKind::MonoNormal),
        &["[48, 64, 3]", "[3, height, width]"],
    );
    write_npy(&dataset, "normal.npy", &[3, 48, 64], &[-0.5; 3 * 48 * 64]);
    refused(load(0, PriorKind::MonoNormal), &["-0.5", "(n + 1)/2"]);
    fs::write(dataset.at("normal.npy"), "no array").unwrap();
    refused(load(0, PriorKind::MonoNormal), &["normal.npy"]);
}

#[test]
fn object_masks_have_to_hold_something() {
    let rig = Rig::skewed(2);
    let dataset = rig.dataset(&rig.transforms(json!({})));
    let look = |scene: &Scene| {
        let mut masks = ObjectMasks::default();
        for (index, view) in scene.views.iter().enumerate() {
            masks.look(view, &scene.load_picture(index).unwrap())?;
        }
        masks.check(scene)
    };
    refused(
        look(&dataset.open().unwrap()),
        &["loss.mask", "object masks"],
    );
    fs::create_dir_all(dataset.at("masks")).unwrap();
    let file = dataset.at("masks/view_001.png");
    GrayImage::new(64, 48).save(&file).unwrap();
    refused(
        look(&dataset.open().unwrap()),
        &["masks/view_001.png", "is empty", "3072 pixels"],
    );
    let half = GrayImage::from_fn(64, 48, |x, _| Luma([if x < 32 { 0 } else { 255 }]));
    half.save(&file).unwrap();
    look(&dataset.open().unwrap()).unwrap();
}

#[test]
fn masks_have_to_leave_something_to_train_on() {
    let rig = Rig::skewed(2);
    let dataset = rig.dataset(&rig.transforms(json!({})));
    fs::create_dir_all(dataset.at("masks")).unwrap();
    let look = |scene: &Scene| {
        let mut masks = ObjectMasks::default();
        for index in 0..scene.views.len() {
            masks.look_at_any(&scene.load_picture(index).unwrap());
        }
        masks.check_anything_is_left(scene)
    };
    look(&dataset.open().unwrap()).unwrap();
    for name in ["masks/view_000.png", "masks/view_001.png"] {
        look(&dataset.open().unwrap()).unwrap();
        GrayImage::new(64, 48).save(dataset.at(name)).unwrap();
    }
    refused(
        look(&dataset.open().unwrap()),
        &["no pixel to train on", "invert them"],
    );
}
