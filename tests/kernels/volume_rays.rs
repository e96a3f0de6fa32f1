//! Random numbers, pixels and rays: from draws to origins, directions, near and far, and target colours.

use crate::harness::*;
use crate::volume_twin as twin;
use glam::DVec2;
use neurodin::gpu::Buffer;
use neurodin::kernels::{self, View};
use neurodin::scene::{Camera, CameraModel};

const SPHERE: u32 = 0;
const BOX: u32 = 1;

#[test]
fn philox_gives_the_published_numbers() {
    // Random123's known answers (kat_vectors, philox4x32 10 rounds), first word.
    assert_eq!(twin::philox([0; 4], [0; 2]), 0x6627_e8d5);
    assert_eq!(twin::philox([u32::MAX; 4], [u32::MAX; 2]), 0x408f_276d);
    let pi = [0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344];
    assert_eq!(twin::philox(pi, [0xa409_3822, 0x299f_31d0]), 0xd16c_fe09);
}

fn draws(n: usize, [seed, step, purpose]: [u32; 3]) -> Vec<f64> {
    let device = device();
    let draws = device.room("draws", n);
    device.run(
        kernels::draw_uniforms::Shape::default(),
        n,
        kernels::draw_uniforms::Args {
            draws: draws.ptr_mut(),
            n: n as u32,
            seed,
            step,
            purpose,
        },
    );
    device.take(&draws)
}

#[test]
fn uniform_draws() {
    let n = 5000;
    let keys = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [42, 299_999, 7]];
    let all = keys.map(|key| draws(n, key));
    for ([seed, step, purpose], got) in keys.into_iter().zip(&all) {
        let bits = |i: usize| twin::philox([i as u32, step, 0, 0], [seed, purpose]);
        let want: Vec<f64> = (0..n)
            .map(|i| f64::from(bits(i) >> 8) / f64::from(1 << 24))
            .collect();
        assert_eq!(*got, want, "seed {seed} step {step} purpose {purpose}");
        let mean = got.iter().sum::<f64>() / n as f64;
        assert!(
            (mean - 0.5).abs() < 4.0 * (1.0 / 12.0 / n as f64).sqrt(),
            "mean {mean}"
        );
    }
    for (a, x) in all.iter().enumerate() {
        for y in &all[..a] {
            let correlation = x
                .iter()
                .zip(y)
                .map(|(x, y)| 12.0 * (x - 0.5) * (y - 0.5))
                .sum::<f64>()
                / n as f64;
            assert!(
                correlation.abs() < 4.0 / (n as f64).sqrt(),
                "streams are correlated: {correlation}"
            );
        }
    }
}

/// A picture on the device and the camera that took it.
struct Picture {
    camera: Camera,
    /// 3 rows of 4.
    region_from_camera: [f64; 12],
    rgba: Vec<u32>,
    pixels: Buffer<u32>,
}

impl Picture {
    fn new(camera: Camera, region_from_camera: [f64; 12], rgba: Vec<u32>) -> Picture {
        assert_eq!(rgba.len(), (camera.width * camera.height) as usize);
        let region_from_camera = region_from_camera.map(|x| f64::from(x as f32));
        Picture {
            camera,
            region_from_camera,
            pixels: device().table("pixels", &rgba),
            rgba,
        }
    }

    fn view(&self) -> View {
        let mut params = [0.0; 12];
        params
            .iter_mut()
            .zip(&self.camera.params)
            .for_each(|(to, &from)| *to = from as f32);
        View {
            pixels: self.pixels.ptr(),
            region_from_camera: self.region_from_camera.map(|x| x as f32),
            params,
            model: self.camera.model as u32,
            width: self.camera.width,
            height: self.camera.height,
            padding: 0,
        }
    }

    fn origin(&self) -> [f64; 3] {
        std::array::from_fn(|row| self.region_from_camera[4 * row + 3])
    }

    fn direction(&self, column: u32, row: u32) -> [f64; 3] {
        let d = self
            .camera
            .direction(DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5))
            .normalize();
        std::array::from_fn(|i| {
            (0..3)
                .map(|j| self.region_from_camera[4 * i + j] * d[j])
                .sum()
        })
    }

    /// Red, green, blue and weight.
    fn target(&self, column: u32, row: u32, masks: bool) -> [f64; 4] {
        let [r, g, b, a] = self.rgba[(row * self.camera.width + column) as usize]
            .to_le_bytes()
            .map(|x| f64::from(x) / 255.0);
        [r, g, b, if masks && a < 0.5 { 0.0 } else { 1.0 }]
    }
}

/// Rotation that takes -z to `direction`, with a turn about it, beside a translation.
fn look_along(direction: [f64; 3], origin: [f64; 3], turn: f64) -> [f64; 12] {
    let z = glam::DVec3::from(direction).normalize() * -1.0;
    let (x, y) = z.any_orthonormal_pair();
    let (x, y) = (
        x * turn.cos() + y * turn.sin(),
        y * turn.cos() - x * turn.sin(),
    );
    // any_orthonormal_pair may give either hand; a camera is right-handed.
    let y = if x.cross(y).dot(z) > 0.0 { y } else { -y };
    let row = |i: usize| [x[i], y[i], z[i], origin[i]];
    [row(0), row(1), row(2)]
        .concat()
        .try_into()
        .expect("3 rows of 4")
}

/// One camera of every model with a plausible lens, all but a few near the region, pictures of different sizes.
fn pictures(random: &mut Random) -> Vec<Picture> {
    let lens = |model: CameraModel, w: f64, h: f64| -> Vec<f64> {
        let focal = if model.is_fisheye() {
            0.5 * w.max(h)
        } else {
            0.9 * w.max(h)
        };
        let focals = if model.has_single_focal() {
            vec![focal]
        } else {
            vec![focal, 1.05 * focal]
        };
        let distortion: &[f64] = match model {
            CameraModel::SimplePinhole | CameraModel::Pinhole => &[],
            CameraModel::SimpleRadial | CameraModel::SimpleRadialFisheye => &[0.05],
            CameraModel::Radial | CameraModel::RadialFisheye => &[-0.08, 0.02],
            CameraModel::Opencv => &[-0.1, 0.03, 0.002, -0.001],
            CameraModel::OpencvFisheye => &[0.02, -0.01, 0.003, -0.0005],
            CameraModel::FullOpencv => &[0.1, 0.02, 0.001, -0.002, 0.003, 0.05, 0.01, 0.001],
            CameraModel::Fov => &[0.6],
            CameraModel::ThinPrismFisheye => {
                &[0.02, -0.01, 0.001, -0.001, 0.002, -0.0003, 0.001, 0.0005]
            }
        };
        [&focals[..], &[0.51 * w, 0.48 * h], distortion].concat()
    };
    let picture = |(i, model): (usize, CameraModel)| {
        let (width, height) = [(8, 5), (3, 11), (1, 1), (16, 9)][i % 4];
        let params = rounded(lens(model, f64::from(width), f64::from(height)));
        let camera = Camera::new(model, width, height, params).expect("a camera");
        let away = random.direction();
        let distance = if i == 5 {
            0.3
        } else {
            random.uniform(1.5, 3.0)
        };
        let toward = if i == 7 {
            away
        } else {
            away.map(|x| -x + random.uniform(-0.2, 0.2))
        };
        let pose = look_along(toward, away.map(|x| distance * x), random.uniform(0.0, 6.0));
        let rgba = (0..width * height)
            .map(|_| random.below(1 << 32) as u32)
            .collect();
        Picture::new(camera, pose, rgba)
    };
    CameraModel::ALL
        .into_iter()
        .enumerate()
        .map(picture)
        .collect()
}

/// What the ray kernels write.
struct Rays {
    origins: Buffer<f32>,
    directions: Buffer<f32>,
    near_far: Buffer<f32>,
    view: Buffer<u32>,
    outside: Buffer<u32>,
    target: Buffer<f32>,
}

impl Rays {
    fn room(n: usize) -> Rays {
        let device = device();
        Rays {
            origins: device.room("origins", 3 * n),
            directions: device.room("directions", 3 * n),
            near_far: device.room("near_far", 2 * n),
            view: device.room("ray_view", n),
            outside: device.room("ray_outside", n),
            target: device.room("target", 4 * n),
        }
    }

    /// Draws as many as there is room for; without half extents in the unit sphere.
    fn draw(
        &self,
        views: &Buffer<View>,
        shares: &[f64],
        draws: &[f64],
        half: Option<[f64; 3]>,
        use_mask: u32,
        one_view: u32,
    ) {
        let device = device();
        let n = self.view.len() as usize;
        device.run(
            kernels::draw_rays::Shape::default(),
            n,
            kernels::draw_rays::Args {
                views: views.ptr(),
                cumulative_share: device.put("shares", shares).ptr(),
                pixel_draws: device.put("pixel_draws", draws).ptr(),
                origins: self.origins.ptr_mut(),
                directions: self.directions.ptr_mut(),
                near_far: self.near_far.ptr_mut(),
                ray_view: self.view.ptr_mut(),
                ray_outside: self.outside.ptr_mut(),
                target: self.target.ptr_mut(),
                n_rays: n as u32,
                n_views: shares.len() as u32,
                use_mask,
                region_shape: if half.is_some() { BOX } else { SPHERE },
                half_extents: half.unwrap_or([1.0; 3]).map(|x| x as f32),
                one_view,
            },
        );
    }

    /// Compares with pixels (picture, column, row) of `pictures`.
    fn check(&self, pictures: &[Picture], pixels: &[(usize, u32, u32)], half: Option<[f64; 3]>) {
        let device = device();
        let of = |f: &dyn Fn(&Picture, u32, u32) -> [f64; 3]| -> Vec<f64> {
            planar(
                &pixels
                    .iter()
                    .map(|&(v, column, row)| f(&pictures[v], column, row))
                    .collect::<Vec<_>>(),
            )
        };
        assert_eq!(
            device.take(&self.origins),
            of(&|picture, _, _| picture.origin())
        );
        assert_close(
            "directions",
            &device.take(&self.directions),
            &of(&|picture, column, row| picture.direction(column, row)),
            2e-6,
        );
        let meet = |&(v, column, row): &(usize, u32, u32)| {
            let (o, d) = (pictures[v].origin(), pictures[v].direction(column, row));
            half.map_or_else(
                || twin::meet_sphere(o, d),
                |half| twin::meet_box(o, d, half),
            )
        };
        let want: Vec<_> = pixels.iter().map(meet).collect();
        assert!(
            want.iter().any(|ray| ray.2) && want.iter().any(|ray| !ray.2),
            "some rays meet the region, some do not"
        );
        let outside: Vec<u32> = want.iter().map(|ray| u32::from(ray.2)).collect();
        assert_eq!(device.read(&self.outside), outside);
        let near_far = interleaved::<2>(&device.take(&self.near_far));
        for (got, want) in near_far.iter().zip(&want) {
            // Near a grazing ray the ends of the chord move without bound for a given error; its middle and squared length do not.
            let (middle, chord) = (got[0] + got[1], (got[1] - got[0]).powi(2));
            assert!(
                (middle - want.0 - want.1).abs() < 2e-4,
                "{got:?}, wanted {want:?}"
            );
            assert!(
                (chord - (want.1 - want.0).powi(2)).abs() < 2e-4,
                "{got:?}, wanted {want:?}"
            );
        }
    }

    /// Compares colours and weights with those of the pixels.
    fn check_target(&self, pictures: &[Picture], pixels: &[(usize, u32, u32)], masks: bool) {
        let want: Vec<_> = pixels
            .iter()
            .map(|&(v, column, row)| pictures[v].target(column, row, masks))
            .collect();
        let got = device().take(&self.target);
        assert_close("target", &got, &planar(&want), 1e-7);
    }
}

#[test]
fn training_rays() {
    let device = device();
    let mut random = Random(11);
    let pictures = pictures(&mut random);
    let views: Vec<View> = pictures.iter().map(Picture::view).collect();
    let table = device.table("views", &views);
    let total: usize = pictures.iter().map(|picture| picture.rgba.len()).sum();
    let share = |sum: &mut usize, picture: &Picture| {
        *sum += picture.rgba.len();
        Some(*sum as f64 / total as f64)
    };
    let shares = rounded(pictures.iter().scan(0, share));

    let n = 4000;
    let mut draws = random.many(3 * n, 0.0, 1.0);
    let largest = 1.0 - 1.0 / f64::from(1 << 24);
    [0, n, 2 * n].into_iter().for_each(|at| draws[at] = largest);
    [1, n + 1, 2 * n + 1]
        .into_iter()
        .for_each(|at| draws[at] = 0.0);
    let pixel = |ray: usize| {
        let view = shares
            .iter()
            .position(|&share| share > draws[ray])
            .expect("the last share is 1");
        let along = |draw: f64, size: u32| ((draw as f32 * size as f32) as u32).min(size - 1);
        let camera = &pictures[view].camera;
        (
            view,
            along(draws[n + ray], camera.width),
            along(draws[2 * n + ray], camera.height),
        )
    };
    let pixels: Vec<_> = (0..n).map(pixel).collect();

    for (region_shape, half, use_mask) in [(SPHERE, [0.0; 3], 0), (BOX, [1.0, 0.5, 0.75], 1)] {
        let rays = Rays::room(n);
        let half = (region_shape == BOX).then_some(half);
        rays.draw(&table, &shares, &draws, half, use_mask, 0);
        assert_eq!(
            device.read(&rays.view),
            pixels
                .iter()
                .map(|pixel| pixel.0 as u32)
                .collect::<Vec<_>>()
        );
        rays.check(&pictures, &pixels, half);
        rays.check_target(&pictures, &pixels, use_mask != 0);
    }
    // Every pixel of every picture is as likely as any other: a picture's rays in proportion to its pixels, four standard deviations.
    for (view, picture) in pictures.iter().enumerate() {
        let p = picture.rgba.len() as f64 / total as f64;
        let got = pixels.iter().filter(|pixel| pixel.0 == view).count() as f64;
        assert!(
            (got - p * n as f64).abs() < 4.0 * (p * n as f64).sqrt() + 1.0,
            "picture {view}: {got} of {n} rays"
        );
    }
}

#[test]
fn rays_of_a_view() {
    let device = device();
    let mut random = Random(12);
    let pictures = pictures(&mut random);
    let views: Vec<View> = pictures.iter().map(Picture::view).collect();
    let table = device.table("views", &views);
    let view = (0..views.len())
        .find(|&v| views[v].width == 16)
        .expect("one of them");
    let (width, height) = (views[view].width, views[view].height);
    let (first, n) = (40, 130); // past the last pixel: 144
    assert!(first + n > width * height);
    let pixel = |i: u32| {
        let number = (first + i).min(width * height - 1);
        (view, number % width, number / width)
    };
    let pixels: Vec<_> = (0..n).map(pixel).collect();
    let rays = Rays::room(n as usize);
    let half = [0.3, 0.2, 0.4];
    device.run(
        kernels::view_rays::Shape::default(),
        n as usize,
        kernels::view_rays::Args {
            views: table.ptr(),
            origins: rays.origins.ptr_mut(),
            directions: rays.directions.ptr_mut(),
            near_far: rays.near_far.ptr_mut(),
            ray_view: rays.view.ptr_mut(),
            ray_outside: rays.outside.ptr_mut(),
            n_rays: n,
            view: view as u32,
            first,
            appearance_view: 5,
            region_shape: BOX,
            half_extents: half.map(|x| x as f32),
        },
    );
    assert_eq!(device.read(&rays.view), vec![5; n as usize]);
    rays.check(&pictures, &pixels, Some(half));
}

/// Priors of the pixels of a batch of one view each: what lies where the pixel's middle falls on the prior's own raster.
#[test]
fn priors_are_drawn_with_their_pixels() {
    let device = device();
    let mut random = Random(13);
    let pictures = pictures(&mut random);
    let views: Vec<View> = pictures.iter().map(Picture::view).collect();
    let table = device.table("views", &views);
    let shares: Vec<f64> = rounded((1..=views.len()).map(|i| i as f64 / views.len() as f64));
    // As large as the picture, half as large where that is whole, three times as large; every number occurs once.
    let sizes = |picture: &Picture| {
        let (w, h) = (picture.camera.width, picture.camera.height);
        [(w, h), (w.div_ceil(2), h.div_ceil(2)), (3 * w, 3 * h)]
    };
    let map = |(width, height): (u32, u32), channels: u32, first: u32| -> Vec<f64> {
        let count = f64::from(width * height * channels);
        (0..count as u32).map(|i| f64::from(first + i)).collect()
    };
    let channels = [1, 3, 1];
    let maps: Vec<[Buffer<f32>; 3]> = (pictures.iter().enumerate())
        .map(|(view, picture)| {
            let sizes = sizes(picture);
            [0, 1, 2].map(|kind| {
                let first = 10_000 * (view as u32 + 1) + 2_000 * kind as u32;
                device.put("prior", &map(sizes[kind], channels[kind], first))
            })
        })
        .collect();
    let rows: Vec<kernels::ViewPriors> = (maps.iter().zip(&pictures))
        .map(|(maps, picture)| {
            let [depth, normal, sensor] = sizes(picture);
            kernels::ViewPriors {
                mono_depth: maps[0].ptr(),
                mono_normal: maps[1].ptr(),
                sensor_depth: maps[2].ptr(),
                mono_depth_width: depth.0,
                mono_depth_height: depth.1,
                mono_normal_width: normal.0,
                mono_normal_height: normal.1,
                sensor_depth_width: sensor.0,
                sensor_depth_height: sensor.1,
            }
        })
        .collect();
    let of_views = device.table("priors", &rows);

    let n = 60;
    for (view, picture) in pictures.iter().enumerate() {
        let mut draws = random.many(3 * n, 0.0, 1.0);
        draws[0] = (view as f64 + 0.5) / views.len() as f64;
        let rays = Rays::room(n);
        rays.draw(&table, &shares, &draws, None, 0, 1);
        assert_eq!(device.read(&rays.view), vec![view as u32; n], "one view");
        let priors = device.room("drawn", 6 * n);
        device.run(
            kernels::draw_priors::Shape {
                mono_depth: 1,
                mono_normal: 1,
                sensor_depth: 1,
            },
            n,
            kernels::draw_priors::Args {
                views: table.ptr(),
                maps: of_views.ptr(),
                pixel_draws: device.put("pixel_draws", &draws).ptr(),
                ray_view: rays.view.ptr(),
                directions: rays.directions.ptr(),
                priors: priors.ptr_mut(),
                n_rays: n as u32,
            },
        );
        let camera = &picture.camera;
        let along = |draw: f64, size: u32| ((draw as f32 * size as f32) as u32).min(size - 1);
        let want = |ray: usize| -> [f64; 6] {
            let column = along(draws[n + ray], camera.width);
            let row = along(draws[2 * n + ray], camera.height);
            let at = |kind: usize, channel: u32| {
                let (width, height) = sizes(picture)[kind];
                let part = |i: u32, to: u32, from: u32| {
                    ((f64::from(i) + 0.5) * f64::from(to) / f64::from(from)).floor() as u32
                };
                let (x, y) = (
                    part(column, width, camera.width),
                    part(row, height, camera.height),
                );
                let first = 10_000 * (view as u32 + 1) + 2_000 * kind as u32;
                f64::from(first + (channel * height + y) * width + x)
            };
            let direction =
                camera.direction(DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5));
            [
                -direction.normalize().z,
                at(0, 0),
                at(1, 0),
                at(1, 1),
                at(1, 2),
                at(2, 0),
            ]
        };
        let want: Vec<[f64; 6]> = (0..n).map(want).collect();
        let got = interleaved::<6>(&device.take(&priors));
        for (got, want) in got.iter().zip(&want) {
            assert!((got[0] - want[0]).abs() < 2e-6, "{got:?}, wanted {want:?}");
            assert_eq!(got[1..], want[1..]);
        }
    }
}

/// (near, far, outside) of rays given as one-pixel pictures, region the unit sphere.
pub fn near_far_of(
    origins: &[[f64; 3]],
    directions: &[[f64; 3]],
) -> (Vec<f64>, Vec<f64>, Vec<u32>) {
    let device = device();
    let n = origins.len();
    let camera =
        Camera::new(CameraModel::Pinhole, 1, 1, vec![1.0, 1.0, 0.5, 0.5]).expect("a camera");
    let picture = |(o, d): (&[f64; 3], &[f64; 3])| {
        Picture::new(camera.clone(), look_along(*d, *o, 0.0), vec![0])
    };
    let pictures: Vec<_> = origins.iter().zip(directions).map(picture).collect();
    let views: Vec<View> = pictures.iter().map(Picture::view).collect();
    let table = device.table("views", &views);
    let shares: Vec<f64> = (1..=n).map(|i| i as f64 / n as f64).collect();
    let draws: Vec<f64> = (0..3 * n)
        .map(|i| ((i % n) as f64 + 0.5) / n as f64)
        .collect();
    let rays = Rays::room(n);
    rays.draw(&table, &shares, &draws, None, 0, 0);
    assert_eq!(device.read(&rays.view), (0..n as u32).collect::<Vec<_>>());
    let near_far = device.take(&rays.near_far);
    (
        near_far[..n].to_vec(),
        near_far[n..].to_vec(),
        device.read(&rays.outside),
    )
}
