//! Pictures as they are handed to the device: formats, masks, alpha, reduction, sizes that differ, sideways phones.

use std::fs;

use glam::DVec2;
use image::codecs::jpeg::JpegEncoder;
use image::{GrayImage, ImageEncoder, Luma, Rgba, RgbaImage};
use neurodin::scene::{Scene, SceneOptions};
use serde_json::json;

use crate::fixtures::{Dataset, Rig, all_views, refused};

/// A rig whose frames name `images/NAME.ENDING`.
fn with_ending(rig: &Rig, ending: &str) -> Dataset {
    let dataset = Dataset::new();
    fs::create_dir_all(dataset.at("images")).unwrap();
    let mut transforms = rig.transforms(json!({}));
    transforms["frames"] = rig.frames(|name| format!("images/{name}.{ending}")).into();
    dataset.write("transforms.json", transforms.to_string());
    dataset
}

fn load(dataset: &Dataset, view: usize) -> neurodin::scene::Picture {
    dataset.open().unwrap().load_picture(view).unwrap()
}

fn linear_from_srgb(encoded: u8) -> f32 {
    let value = f32::from(encoded) / 255.0;
    if value <= 0.04045 {
        value / 12.92
    } else {
        ((value + 0.055) / 1.055).powf(2.4)
    }
}

#[test]
fn png_tiff_and_exr_give_the_same_pixels_and_jpeg_nearly() {
    let rig = Rig::skewed(2);
    for ending in ["png", "tiff", "tif", "exr", "jpg"] {
        let dataset = with_ending(&rig, ending);
        for (index, (name, _)) in rig.views.iter().enumerate() {
            let path = dataset.at(&format!("images/{name}.{ending}"));
            let picture = rig.picture(index);
            match ending {
                "exr" => exr::prelude::write_rgb_file(&path, 64, 48, |x, y| {
                    let [r, g, b] = picture
                        .get_pixel(x as u32, y as u32)
                        .0
                        .map(linear_from_srgb);
                    (r, g, b)
                })
                .unwrap(),
                "jpg" => {
                    let file = fs::File::create(path).unwrap();
                    JpegEncoder::new_with_quality(file, 98)
                        .encode_image(&picture)
                        .unwrap();
                }
                _ => picture.save(path).unwrap(),
            }
        }
        let read = load(&dataset, 1);
        assert_eq!((read.width, read.height), (64, 48));
        for (x, y, wanted) in rig.picture(1).enumerate_pixels() {
            let at = (y * 64 + x) as usize * 4;
            assert_eq!(read.rgba[at + 3], 255);
            let off = (0..3)
                .map(|channel| read.rgba[at + channel].abs_diff(wanted[channel]))
                .max()
                .unwrap();
            assert!(
                off <= if ending == "jpg" { 24 } else { 0 },
                "{ending} ({x}, {y}): off by {off}"
            );
        }
    }
}

/// A mask that is black in its left half.
fn left_half_black(rig: &Rig, white: u8) -> GrayImage {
    GrayImage::from_fn(rig.width, rig.height, |x, _| {
        Luma([if x < rig.width / 2 { 0 } else { white }])
    })
}

fn assert_left_half_hidden(dataset: &Dataset, view: usize) {
    let picture = load(dataset, view);
    for (index, pixel) in picture.rgba.chunks(4).enumerate() {
        let wanted = if index % 64 < 32 { 0 } else { 255 };
        assert_eq!(pixel[3], wanted, "pixel {index}");
    }
    let options = SceneOptions {
        masks: false,
        ..all_views()
    };
    let bare = Scene::open(dataset.path(), &options).unwrap();
    let picture = bare.load_picture(view).unwrap();
    assert!(picture.rgba.chunks(4).all(|pixel| pixel[3] == 255));
    // A mask is said to be there; an alpha channel is looked at no sooner than its picture.
    let masked = dataset.open().unwrap().views[view].mask_path.is_some();
    let said = bare
        .skipped
        .iter()
        .filter(|skipped| skipped.what == "masks");
    assert_eq!(said.count(), usize::from(masked), "{:?}", bare.skipped);
}

#[test]
fn masks_are_found_where_tools_put_them() {
    let rig = Rig::skewed(2);
    for (place, white, named) in [
        ("elsewhere/a.png", 255, true),
        ("masks/view_001.png", 255, false),
        ("masks/view_001.png.png", 255, false),
        ("masks/view_001.png", 1, false),
    ] {
        let mut transforms = rig.transforms(json!({}));
        if named {
            transforms["frames"][1]["mask_path"] = json!(place);
        }
        let dataset = rig.dataset(&transforms);
        fs::create_dir_all(dataset.at(place).parent().unwrap()).unwrap();
        left_half_black(&rig, white)
            .save(dataset.at(place))
            .unwrap();
        assert_left_half_hidden(&dataset, 1);
        assert!(dataset.open().unwrap().views[0].mask_path.is_none());
    }
}

#[test]
fn instant_ngps_dynamic_masks_hide_what_is_white() {
    let rig = Rig::skewed(2);
    let dataset = rig.dataset(&rig.transforms(json!({})));
    let mut mask = left_half_black(&rig, 255);
    mask.pixels_mut()
        .for_each(|pixel| pixel[0] = 255 - pixel[0]);
    mask.save(dataset.at("images/dynamic_mask_view_001.png"))
        .unwrap();
    assert_left_half_hidden(&dataset, 1);
}

#[test]
fn alpha_hides_and_is_black_where_masks_are_not_used() {
    let rig = Rig::skewed(2);
    let dataset = rig.dataset(&rig.transforms(json!({})));
    let half = RgbaImage::from_fn(64, 48, |x, _| {
        Rgba([200, 100, 50, if x < 32 { 0 } else { 255 }])
    });
    half.save(dataset.at("images/view_001.png")).unwrap();
    assert_left_half_hidden(&dataset, 1);
    let options = SceneOptions {
        masks: false,
        ..all_views()
    };
    let bare = Scene::open(dataset.path(), &options)
        .unwrap()
        .load_picture(1)
        .unwrap();
    assert_eq!(bare.rgba[..4], [0, 0, 0, 255]);
    assert_eq!(bare.rgba[40 * 4..41 * 4], [200, 100, 50, 255]);
}

#[test]
fn masks_of_another_size_are_refused() {
    let rig = Rig::skewed(2);
    let dataset = rig.dataset(&rig.transforms(json!({})));
    fs::create_dir_all(dataset.at("masks")).unwrap();
    GrayImage::new(32, 24)
        .save(dataset.at("masks/view_001.png"))
        .unwrap();
    dataset.refuses(&["masks/view_001.png", "32x24", "64x48", "--no-masks"]);
    let options = SceneOptions {
        masks: false,
        ..all_views()
    };
    assert!(Scene::open(dataset.path(), &options).is_ok());
}

/// A file that is there but fails to be read, played by the process's memory, of which the first page is never there.
#[test]
#[cfg(target_os = "linux")]
fn files_that_cannot_be_read_are_unusable_input() {
    let fails_to_read = |dataset: &Dataset, file: &str| {
        fs::remove_file(dataset.at(file)).unwrap();
        std::os::unix::fs::symlink("/proc/self/mem", dataset.at(file)).unwrap();
        let first = dataset.open().and_then(|scene| scene.load_picture(0));
        refused(first, &[file, "cannot be read: ", "next: "]);
    };
    let rig = Rig::skewed(3);
    let transforms = || rig.dataset(&rig.transforms(json!({})));
    fails_to_read(&transforms(), "images/view_000.png");
    fails_to_read(&transforms(), "transforms.json");
    let text = Dataset::new();
    rig.write_pictures(&text.at("images"));
    rig.write_colmap_text(&text.at("sparse/0"));
    fails_to_read(&text, "sparse/0/images.txt");
}

#[test]
fn reduced_pictures_see_the_same_rays() {
    let rig = Rig::skewed(2);
    let dataset = rig.dataset(&rig.transforms(json!({})));
    let options = SceneOptions {
        downscale: 2.0,
        ..all_views()
    };
    let scene = Scene::open(dataset.path(), &options).unwrap();
    let (view, picture) = (&scene.views[1], scene.load_picture(1).unwrap());
    assert_eq!((view.camera.width, view.camera.height), (32, 24));
    assert_eq!((picture.width, picture.height), (32, 24));
    let (_, direction) = view.ray(DVec2::new(10.5, 7.5));
    assert!((direction - rig.ray(1, DVec2::new(21.0, 15.0)).1).length() < 1e-9);
    // Pixel (10, 7) is the mean of columns 20 and 21, rows 14 and 15 of the gradient.
    let at = (7 * 32 + 10) * 4;
    assert_eq!(picture.rgba[at..at + 4], [82, 73, 20, 255]);
    for downscale in [0.5, 0.0, f64::NAN, f64::INFINITY] {
        let options = SceneOptions {
            downscale,
            ..all_views()
        };
        refused(
            Scene::open(dataset.path(), &options),
            &["reduced by a factor of 1 or more"],
        );
    }
}

#[test]
fn intrinsics_follow_pictures_of_another_size() {
    let rig = Rig::skewed(3);
    let mut transforms = rig.transforms(json!({}));
    for (key, value) in [
        ("w", 128.0),
        ("h", 96.0),
        ("fl_x", 2.0 * rig.focal.x),
        ("fl_y", 2.0 * rig.focal.y),
        ("cx", 2.0 * rig.center.x),
        ("cy", 2.0 * rig.center.y),
    ] {
        transforms[key] = json!(value);
    }
    let scene = rig.dataset(&transforms).open().unwrap();
    crate::fixtures::assert_rays(&rig, &scene);
    assert_eq!(scene.notes.len(), 1);
    assert!(
        scene.notes[0].contains("64x48") && scene.notes[0].contains("128x96"),
        "{:?}",
        scene.notes
    );

    transforms["h"] = json!(128);
    rig.dataset(&transforms)
        .refuses(&["view_000.png", "64x48", "128x128"]);
}

/// A rig whose pictures are JPEGs of noise with EXIF data, and the first of them.
fn noisy_jpegs(exif: &[u8]) -> (Dataset, std::path::PathBuf) {
    let rig = Rig::skewed(2);
    let dataset = with_ending(&rig, "jpg");
    for (name, _) in &rig.views {
        let noise = image::RgbImage::from_fn(rig.width, rig.height, |x, y| {
            image::Rgb([(x * 97) ^ (y * 61), x * 31 + y * 7, x * y].map(|value| value as u8))
        });
        let file = fs::File::create(dataset.at(&format!("images/{name}.jpg"))).unwrap();
        let mut encoder = JpegEncoder::new_with_quality(file, 90);
        encoder.set_exif_metadata(exif.to_vec()).unwrap();
        encoder.encode_image(&noise).unwrap();
    }
    let first = dataset.at(&format!("images/{}.jpg", rig.views[0].0));
    (dataset, first)
}

/// Decoders fill what is missing with grey.
#[test]
fn jpegs_that_are_cut_off_are_refused() {
    // The preview in the EXIF data is whole either way.
    let (dataset, file) = noisy_jpegs(b"\xff\xd8\xff\xda\0\x02\xff\xd9");
    load(&dataset, 0);
    let whole = fs::read(&file).unwrap();
    for kept in [whole.len() * 2 / 3, whole.len() - 2] {
        fs::write(&file, &whole[..kept]).unwrap();
        let told = dataset.open().unwrap().load_picture(0).unwrap_err();
        let told = told.to_string();
        assert!(
            told.contains("ends in the middle of the picture") && told.contains(".jpg"),
            "{told}"
        );
    }
}

/// Motion photos: a film follows the end of the picture.
#[test]
fn jpegs_that_something_follows_are_whole() {
    let (dataset, file) = noisy_jpegs(b"");
    let alone = load(&dataset, 0);
    let whole = fs::read(&file).unwrap();
    let film = [b"\0\0\0\x18ftypmp42", &[0xff, 0xda, 7, 0xff][..]].concat();
    fs::write(&file, [whole, film].concat()).unwrap();
    assert_eq!(load(&dataset, 0), alone);
}

#[test]
fn sideways_phone_pictures_are_turned_as_the_camera_says() {
    // Stored lying (48x64 as the camera has it, turned by EXIF orientation 6: the first row is on the right).
    let mut rig = Rig::skewed(2);
    (rig.width, rig.height) = (48, 64);
    rig.center = DVec2::new(24.0, 32.0);
    let dataset = with_ending(&rig, "jpg");
    let lying = image::RgbImage::from_fn(64, 48, |x, _| {
        image::Rgb([if x < 32 { 250 } else { 5 }, 0, 0])
    });
    let exif = b"MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0".to_vec();
    for (name, _) in &rig.views {
        let file = fs::File::create(dataset.at(&format!("images/{name}.jpg"))).unwrap();
        let mut encoder = JpegEncoder::new_with_quality(file, 95);
        encoder.set_exif_metadata(exif.clone()).unwrap();
        encoder.encode_image(&lying).unwrap();
    }
    let picture = load(&dataset, 0);
    assert_eq!((picture.width, picture.height), (48, 64));
    let red = |x: usize, y: usize| picture.rgba[(y * 48 + x) * 4];
    // Turned clockwise, what was left is at the top.
    assert!(
        red(10, 5) > 200 && red(40, 5) > 200,
        "{} {}",
        red(10, 5),
        red(40, 5)
    );
    assert!(
        red(10, 60) < 50 && red(40, 60) < 50,
        "{} {}",
        red(10, 60),
        red(40, 60)
    );
}
