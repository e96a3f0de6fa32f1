//! Compositing, forward and backward, against its float64 twin.

use crate::harness::*;
use crate::volume_twin::{self as twin, RaySamples, Scale};
use neurodin::kernels;

const SCALE: Scale = Scale {
    range: 0.1,
    floor: 2e-4,
    inv_s_lower: 18.0,
};
/// Rays that pass a surface at varied angles and sharpness; some miss it, some are flagged empty.
fn rays(random: &mut Random, n: usize, n_samples: usize) -> Vec<RaySamples> {
    let near_far = near_far(random, n);
    let ray = |(i, &near_far): (usize, &[f64; 2])| {
        let edges = uneven_edges(random, n_samples);
        let surface = if i % 5 == 4 {
            1e3
        } else {
            random.uniform(0.2, 0.9)
        };
        let (slope, sharpness) = (random.uniform(0.1, 1.0), random.uniform(-7.0, 4.0));
        let sdf = |r: &mut Random, s: f64| ((surface - s) * slope + r.uniform(-0.02, 0.02)) as f32;
        RaySamples {
            sdf: edges[..n_samples]
                .iter()
                .map(|&s| f64::from(sdf(random, s)))
                .collect(),
            logit: rounded((0..n_samples).map(|_| sharpness + random.uniform(-1.0, 1.0))),
            near_far,
            empty: i % 7 == 3,
            rgb: (0..n_samples)
                .map(|_| std::array::from_fn(|_| random.uniform(0.0, 1.0)))
                .collect(),
            background: std::array::from_fn(|_| random.uniform(0.0, 1.0)),
            edges,
        }
    };
    near_far.iter().enumerate().map(ray).collect()
}

fn flat_rgb(rays: &[RaySamples]) -> Vec<f64> {
    planar(
        &rays
            .iter()
            .flat_map(|ray| ray.rgb.clone())
            .collect::<Vec<_>>(),
    )
}
/// Device arrays of a batch of rays.
pub struct Batch {
    n: usize,
    n_samples: usize,
    arrays: [neurodin::gpu::Buffer<f32>; 6],
    outside: neurodin::gpu::Buffer<u32>,
}

impl Batch {
    pub fn new(rays: &[RaySamples]) -> Batch {
        let device = device();
        let backgrounds: Vec<_> = rays.iter().map(|ray| ray.background).collect();
        let near_far: Vec<_> = rays.iter().map(|ray| ray.near_far).collect();
        let outside: Vec<u32> = rays.iter().map(|ray| u32::from(ray.empty)).collect();
        Batch {
            n: rays.len(),
            n_samples: rays[0].sdf.len(),
            arrays: [
                device.put("sdf", &flat(rays.iter().map(|ray| &ray.sdf))),
                device.put("logit", &flat(rays.iter().map(|ray| &ray.logit))),
                device.put("edges", &flat(rays.iter().map(|ray| &ray.edges))),
                device.put("near_far", &planar(&near_far)),
                device.put("rgb", &flat_rgb(rays)),
                device.put("background", &planar(&backgrounds)),
            ],
            outside: device.table("ray_outside", &outside),
        }
    }

    /// The optical depth of every bin.
    fn depth(&self, scale: Scale) -> neurodin::gpu::Buffer<f32> {
        let device = device();
        let [sdf, logit, edges, near_far, ..] = &self.arrays;
        let count = self.n * self.n_samples;
        let depth = device.room("optical depth", count);
        device.run(
            kernels::optical_depth::Shape::default(),
            count,
            kernels::optical_depth::Args {
                sdf: sdf.ptr(),
                gradient: sdf.ptr(),
                scale: logit.ptr(),
                directions: sdf.ptr(),
                edges: edges.ptr(),
                near_far: near_far.ptr(),
                ray_outside: self.outside.ptr(),
                optical_depth: depth.ptr_mut(),
                n_rays: self.n as u32,
                n_samples: self.n_samples as u32,
                scale_range: scale.range as f32,
                scale_floor: scale.floor as f32,
                inv_s_lower: scale.inv_s_lower as f32,
                anneal: 1.0,
            },
        );
        depth
    }

    /// (weights, image)
    pub fn forward(&self, scale: Scale) -> (Vec<f64>, Vec<f64>) {
        let device = device();
        let [_, _, edges, near_far, rgb, background] = &self.arrays;
        let weights = device.room("weights", self.n * self.n_samples);
        let image = device.room("image", 6 * self.n);
        device.run(
            kernels::composite_forward::Shape::default(),
            self.n,
            kernels::composite_forward::Args {
                optical_depth: self.depth(scale).ptr(),
                edges: edges.ptr(),
                near_far: near_far.ptr(),
                rgb: rgb.ptr(),
                background: background.ptr(),
                weights: weights.ptr_mut(),
                image: image.ptr_mut(),
                n_rays: self.n as u32,
                n_samples: self.n_samples as u32,
            },
        );
        (device.take(&weights), device.take(&image))
    }

    /// (d_sdf, d_logit, d_rgb, d_background)
    pub fn backward(&self, scale: Scale, d_color: &[f64]) -> [Vec<f64>; 4] {
        let device = device();
        let [sdf, logit, edges, near_far, rgb, background] = &self.arrays;
        let count = self.n * self.n_samples;
        let d = [count, count, 3 * count, 3 * self.n].map(|len| device.room("gradient", len));
        device.run(
            kernels::composite_backward::Shape::default(),
            self.n,
            kernels::composite_backward::Args {
                optical_depth: self.depth(scale).ptr(),
                rgb: rgb.ptr(),
                background: background.ptr(),
                d_color: device.put("d_color", d_color).ptr(),
                edges: edges.ptr(),
                near_far: near_far.ptr(),
                image: rgb.ptr(), // this and the next two are not read: nothing but colour is wanted
                gradient: rgb.ptr(),
                d_image: rgb.ptr(),
                d_optical_depth: d[0].ptr_mut(),
                d_rgb: d[2].ptr_mut(),
                d_background: d[3].ptr_mut(),
                n_rays: self.n as u32,
                n_samples: self.n_samples as u32,
            },
        );
        device.run(
            kernels::optical_depth_backward::Shape::default(),
            count,
            kernels::optical_depth_backward::Args {
                sdf: sdf.ptr(),
                gradient: sdf.ptr(),
                scale: logit.ptr(),
                directions: sdf.ptr(),
                edges: edges.ptr(),
                near_far: near_far.ptr(),
                ray_outside: self.outside.ptr(),
                d_sdf: d[0].ptr_mut(),
                d_scale: d[1].ptr_mut(),
                d_gradient: d[2].ptr_mut(), // not written: nobody hears it
                n_rays: self.n as u32,
                n_samples: self.n_samples as u32,
                scale_range: scale.range as f32,
                scale_floor: scale.floor as f32,
                inv_s_lower: scale.inv_s_lower as f32,
                anneal: 1.0,
            },
        );
        d.each_ref().map(|buffer| device.take(buffer))
    }
}

/// The settings as float32 has them.
fn rounded_scale(scale: Scale) -> Scale {
    let round = |x: f64| f64::from(x as f32);
    Scale {
        range: round(scale.range),
        floor: round(scale.floor),
        inv_s_lower: round(scale.inv_s_lower),
    }
}

#[test]
fn compositing_forward() {
    let rays = rays(&mut Random(4), 71, 33);
    let (weights, image) = Batch::new(&rays).forward(SCALE);
    let want: Vec<_> = rays
        .iter()
        .map(|ray| ray.composite(rounded_scale(SCALE)))
        .collect();
    assert_forward(
        "weights",
        &weights,
        &flat(want.iter().map(|ray| &ray.weights)),
    );
    let pixel = |ray: &twin::Composite| {
        let [r, g, b] = ray.color;
        [r, g, b, ray.accumulation, ray.end, ray.depth]
    };
    let want: Vec<[f64; 6]> = want.iter().map(pixel).collect();
    for (plane, what) in [
        "red",
        "green",
        "blue",
        "accumulation",
        "transmittance",
        "depth",
    ]
    .into_iter()
    .enumerate()
    {
        let want: Vec<f64> = want.iter().map(|pixel| pixel[plane]).collect();
        assert_forward(what, &image[plane * rays.len()..][..rays.len()], &want);
    }
    for (ray, pixel) in rays.iter().zip(interleaved::<6>(&image)) {
        if ray.empty {
            assert_eq!(
                pixel[..4],
                [ray.background[0], ray.background[1], ray.background[2], 0.0],
                "an empty ray is background"
            );
        }
    }
}

#[test]
fn compositing_backward() {
    let mut random = Random(5);
    let rays = rays(&mut random, 71, 33);
    let scale = rounded_scale(SCALE);
    let d_color: Vec<[f64; 3]> = rays
        .iter()
        .map(|_| std::array::from_fn(|_| random.uniform(-1.0, 1.0)))
        .collect();
    let want: Vec<_> = rays
        .iter()
        .zip(&d_color)
        .map(|(ray, d)| ray.composite_backward(scale, *d))
        .collect();

    for (ray, (d_color, want)) in rays.iter().zip(d_color.iter().zip(&want)).take(14) {
        let value = |ray: &RaySamples| {
            let color = ray.composite(scale).color;
            (0..3).map(|c| color[c] * d_color[c]).sum::<f64>()
        };
        let d_sdf = if ray.empty {
            vec![0.0; ray.sdf.len()]
        } else {
            want.sdf.clone()
        };
        assert_central_differences("sdf", &ray.sdf, &d_sdf, |x| {
            value(&RaySamples {
                sdf: x.to_vec(),
                ..ray.clone()
            })
        });
        assert_central_differences("logit", &ray.logit, &want.logit, |x| {
            value(&RaySamples {
                logit: x.to_vec(),
                ..ray.clone()
            })
        });
        let as_rgb = |x: &[f64]| x.chunks(3).map(|c| [c[0], c[1], c[2]]).collect::<Vec<_>>();
        let d_rgb = want.rgb.concat();
        assert_central_differences("rgb", &ray.rgb.concat(), &d_rgb, |x| {
            value(&RaySamples {
                rgb: as_rgb(x),
                ..ray.clone()
            })
        });
        assert_central_differences("background", &ray.background, &want.background, |x| {
            value(&RaySamples {
                background: as_rgb(x)[0],
                ..ray.clone()
            })
        });
    }
    let clamped = |ray: &RaySamples, i: usize| twin::local_scale(ray.logit[i], scale).1 == 0.0;
    let n_clamped = rays
        .iter()
        .map(|ray| (0..ray.logit.len()).filter(|&i| clamped(ray, i)).count())
        .sum::<usize>();
    assert!(n_clamped > 100, "only {n_clamped} samples test the clamp");

    let [d_sdf, d_logit, d_rgb, d_background] =
        Batch::new(&rays).backward(SCALE, &planar(&d_color));
    assert_gradient("d_sdf", &d_sdf, &flat(want.iter().map(|ray| &ray.sdf)));
    assert_gradient(
        "d_logit",
        &d_logit,
        &flat(want.iter().map(|ray| &ray.logit)),
    );
    assert_gradient(
        "d_rgb",
        &d_rgb,
        &planar(
            &want
                .iter()
                .flat_map(|ray| ray.rgb.clone())
                .collect::<Vec<_>>(),
        ),
    );
    assert_gradient(
        "d_background",
        &d_background,
        &planar(&want.iter().map(|ray| ray.background).collect::<Vec<_>>()),
    );
    for (p, d) in d_logit.iter().enumerate() {
        let (ray, i) = (&rays[p / 33], p % 33);
        assert!(
            *d == 0.0 || !clamped(ray, i),
            "sample {p} is clamped, but its logit has the gradient {d}"
        );
    }
}

/// A sharp surface far inside a wide region: densities of 5000 in bins of 0.1, with the surface in the last bin's middle.
#[test]
fn compositing_survives_extremes() {
    let edges: Vec<f64> = (0..=8).map(|i| i as f64 / 8.0).collect();
    let ray = |sdf: f64, logit: f64| RaySamples {
        sdf: vec![sdf; 8],
        logit: vec![logit; 8],
        edges: edges.clone(),
        near_far: [0.0, 0.8],
        empty: false,
        rgb: vec![[0.5; 3]; 8],
        background: [1.0, 0.0, 0.25],
    };
    let cases = [
        (-1e3, -100.0),
        (1e3, -100.0),
        (-1e3, 100.0),
        (1e3, 100.0),
        (0.0, -100.0),
        (1e-6, 0.0),
        (-1e-6, 0.0),
    ];
    let rays: Vec<_> = cases
        .iter()
        .map(|&(sdf, logit)| ray(f64::from(sdf as f32), logit))
        .collect();
    let scale = Scale {
        inv_s_lower: 0.01,
        ..SCALE
    };
    let want: Vec<_> = rays
        .iter()
        .map(|ray| ray.composite(rounded_scale(scale)))
        .collect();
    let (weights, image) = Batch::new(&rays).forward(scale);
    assert_forward(
        "weights",
        &weights,
        &flat(want.iter().map(|ray| &ray.weights)),
    );
    assert_forward(
        "colour",
        &image[..3 * rays.len()],
        &planar(&want.iter().map(|ray| ray.color).collect::<Vec<_>>()),
    );
    let d_color = vec![1.0; 3 * rays.len()];
    let got = Batch::new(&rays).backward(scale, &d_color);
    let want: Vec<_> = rays
        .iter()
        .map(|ray| ray.composite_backward(rounded_scale(scale), [1.0; 3]))
        .collect();
    assert_gradient("d_sdf", &got[0], &flat(want.iter().map(|ray| &ray.sdf)));
    assert_gradient("d_logit", &got[1], &flat(want.iter().map(|ray| &ray.logit)));
}
