//! Sampling, compositing and their losses: each kernel against its float64 twin, gradients included.

use crate::harness::*;
use crate::volume_twin::{self as twin, ProposalRay, RaySamples, Scale};
use neurodin::kernels;

const SCALE: Scale = Scale {
    range: 0.1,
    floor: 2e-4,
    inv_s_lower: 18.0,
};

/// Near and far of `n` rays: both sides of the warp's bend at 1, across it, and short.
fn near_far(random: &mut Random, n: usize) -> Vec<[f64; 2]> {
    let ray = |r: &mut Random, i: usize| match i % 4 {
        0 => [0.0, r.uniform(0.5, 0.9)],
        1 => [r.uniform(1.1, 3.0), r.uniform(3.1, 5.0)],
        2 => [r.uniform(0.2, 0.8), r.uniform(1.2, 2.5)],
        _ => [1.0, r.uniform(1.1, 1.2)],
    };
    (0..n).map(|i| ray(random, i)).collect()
}

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

fn flat<'a>(rows: impl IntoIterator<Item = &'a Vec<f64>>) -> Vec<f64> {
    rows.into_iter().flatten().copied().collect()
}

fn flat_rgb(rays: &[RaySamples]) -> Vec<f64> {
    planar(
        &rays
            .iter()
            .flat_map(|ray| ray.rgb.clone())
            .collect::<Vec<_>>(),
    )
}

#[test]
fn first_edges() {
    let device = device();
    let (n, n_samples) = (70, 13);
    let mut random = Random(1);
    let draws = random.many(n, 0.0, 1.0);
    for train in [0, 1] {
        let edges = device.room("edges", n * (n_samples + 1));
        device.run(
            kernels::place_samples::Shape::default(),
            n * (n_samples + 1),
            kernels::place_samples::Args {
                jitter: device.put("jitter", &draws).ptr(),
                edges: edges.ptr_mut(),
                n: n as u32,
                n_samples: n_samples as u32,
                train,
            },
        );
        let want = draws
            .iter()
            .flat_map(|&u| twin::place_samples(n_samples, (train != 0).then_some(u)));
        assert_close(
            "edges",
            &device.take(&edges),
            &want.collect::<Vec<_>>(),
            2e-7,
        );
    }
}

#[test]
fn resampled_edges_and_proposal_weights() {
    let device = device();
    let (n, n_samples, n_new) = (66, 37, 19);
    let mut random = Random(2);
    let near_far = near_far(&mut random, n);
    let edges: Vec<Vec<f64>> = (0..n)
        .map(|_| uneven_edges(&mut random, n_samples))
        .collect();
    let mut raw: Vec<Vec<f64>> = (0..n).map(|_| random.many(n_samples, -6.0, 5.0)).collect();
    raw[0] = vec![-60.0; n_samples]; // nothing at all on this ray
    raw[1] = vec![-60.0; n_samples];
    raw[1][11] = 60.0; // everything in one bin
    raw[2] = vec![200.0; n_samples]; // opaque from the first bin on, density beyond float32
    let draws = random.many(n, 0.0, 1.0);
    for (train, anneal) in [(1, 0.7), (0, 1.0), (1, 0.0), (0, 0.3)] {
        let weights = device.room("weights", n * n_samples);
        let new_edges = device.room("new edges", n * (n_new + 1));
        device.run(
            kernels::resample::Shape::default(),
            n,
            kernels::resample::Args {
                raw: device.put("raw", &flat(&raw)).ptr(),
                edges: device.put("edges", &flat(&edges)).ptr(),
                near_far: device.put("near_far", &planar(&near_far)).ptr(),
                jitter: device.put("jitter", &draws).ptr(),
                weights: weights.ptr_mut(),
                new_edges: new_edges.ptr_mut(),
                n: n as u32,
                n_samples: n_samples as u32,
                n_new: n_new as u32,
                train,
                anneal: anneal as f32,
            },
        );
        let (mut want_weights, mut want_edges) = (Vec::new(), Vec::new());
        for i in 0..n {
            let lengths = twin::lengths(&edges[i], near_far[i]);
            let tau: Vec<f64> = raw[i]
                .iter()
                .zip(lengths)
                .map(|(raw, length)| raw.exp() * length)
                .collect();
            let (weights, _) = twin::quadrature(&tau);
            let offset = if train != 0 { draws[i] } else { 0.5 };
            want_edges.extend(twin::resample(
                &edges[i],
                &weights,
                n_new,
                offset,
                f64::from(anneal as f32),
            ));
            want_weights.extend(weights);
        }
        let got = device.take(&new_edges);
        assert_forward("weights", &device.take(&weights), &want_weights);
        assert_forward("new edges", &got, &want_edges);
        assert_close("new edges", &got, &want_edges, 2e-5);
        for ray in got.chunks(n_new + 1) {
            assert!(
                ray.windows(2).all(|pair| pair[0] <= pair[1]),
                "edges go back: {ray:?}"
            );
            assert!(
                ray[0] >= 0.0 && ray[n_new] <= 1.0,
                "edges leave [0,1]: {ray:?}"
            );
        }
    }
}

#[test]
fn sample_points() {
    let device = device();
    let (n, n_samples) = (65, 6);
    let count = n * n_samples;
    let mut random = Random(3);
    let near_far = near_far(&mut random, n);
    let edges: Vec<Vec<f64>> = (0..n)
        .map(|_| uneven_edges(&mut random, n_samples))
        .collect();
    let origins: Vec<[f64; 3]> = (0..n)
        .map(|_| std::array::from_fn(|_| random.uniform(-2.0, 2.0)))
        .collect();
    let directions: Vec<[f64; 3]> = (0..n).map(|_| random.direction()).collect();
    let mut draws = random.many(count, 0.0, 1.0);
    draws[5] = 0.0; // the floor acts
    let at = |ray: usize, t: f64| -> [f64; 3] {
        std::array::from_fn(|j| origins[ray][j] + t * directions[ray][j])
    };
    let t = |ray: usize, edge: usize| twin::distance(edges[ray][edge], near_far[ray]);
    let samples = || (0..n).flat_map(|ray| (0..n_samples).map(move |i| (ray, i)));

    let points = device.room("points", 3 * count);
    device.run(
        kernels::midpoint_positions::Shape::default(),
        count,
        kernels::midpoint_positions::Args {
            origins: device.put("origins", &planar(&origins)).ptr(),
            directions: device.put("directions", &planar(&directions)).ptr(),
            near_far: device.put("near_far", &planar(&near_far)).ptr(),
            edges: device.put("edges", &flat(&edges)).ptr(),
            points: points.ptr_mut(),
            n: n as u32,
            n_samples: n_samples as u32,
        },
    );
    let want: Vec<_> = samples()
        .map(|(ray, i)| at(ray, (t(ray, i) + t(ray, i + 1)) / 2.0))
        .collect();
    assert_close("midpoints", &device.take(&points), &planar(&want), 5e-6);

    let (tap_range, tap_floor) = (0.1f32, 1.0f32 / 4096.0);
    for n_blocks in [1, 7] {
        let points = device.room("points", 3 * n_blocks * count);
        device.run(
            kernels::surface_points::Shape::default(),
            count,
            kernels::surface_points::Args {
                origins: device.put("origins", &planar(&origins)).ptr(),
                directions: device.put("directions", &planar(&directions)).ptr(),
                near_far: device.put("near_far", &planar(&near_far)).ptr(),
                edges: device.put("edges", &flat(&edges)).ptr(),
                tap_draws: device.put("tap_draws", &draws).ptr(),
                points: points.ptr_mut(),
                n: n as u32,
                n_samples: n_samples as u32,
                n_blocks: n_blocks as u32,
                tap_range,
                tap_floor,
            },
        );
        let mut want: Vec<[f64; 3]> = samples().map(|(ray, i)| at(ray, t(ray, i))).collect();
        for block in 1..n_blocks {
            for i in 0..count {
                let delta = (f64::from(tap_range) * draws[i]).max(f64::from(tap_floor));
                let mut point = want[i];
                point[(block - 1) / 2] += if block % 2 == 1 { delta } else { -delta };
                want.push(point);
            }
        }
        assert_close(
            "surface points",
            &device.take(&points),
            &planar(&want),
            5e-6,
        );
    }
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
            outside: device.put_uints("ray_outside", &outside),
        }
    }

    /// (weights, image)
    pub fn forward(&self, scale: Scale) -> (Vec<f64>, Vec<f64>) {
        let device = device();
        let [sdf, logit, edges, near_far, rgb, background] = &self.arrays;
        let weights = device.room("weights", self.n * self.n_samples);
        let image = device.room("image", 6 * self.n);
        device.run(
            kernels::composite_forward::Shape::default(),
            self.n,
            kernels::composite_forward::Args {
                sdf: sdf.ptr(),
                logit: logit.ptr(),
                edges: edges.ptr(),
                near_far: near_far.ptr(),
                ray_outside: self.outside.ptr(),
                rgb: rgb.ptr(),
                background: background.ptr(),
                weights: weights.ptr_mut(),
                image: image.ptr_mut(),
                n: self.n as u32,
                n_samples: self.n_samples as u32,
                scale_range: scale.range as f32,
                scale_floor: scale.floor as f32,
                inv_s_lower: scale.inv_s_lower as f32,
                outside_empty: 1,
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
                sdf: sdf.ptr(),
                logit: logit.ptr(),
                edges: edges.ptr(),
                near_far: near_far.ptr(),
                ray_outside: self.outside.ptr(),
                rgb: rgb.ptr(),
                background: background.ptr(),
                d_color: device.put("d_color", d_color).ptr(),
                d_sdf: d[0].ptr_mut(),
                d_logit: d[1].ptr_mut(),
                d_rgb: d[2].ptr_mut(),
                d_background: d[3].ptr_mut(),
                n: self.n as u32,
                n_samples: self.n_samples as u32,
                scale_range: scale.range as f32,
                scale_floor: scale.floor as f32,
                inv_s_lower: scale.inv_s_lower as f32,
                outside_empty: 1,
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

#[test]
fn colour_loss() {
    let device = device();
    let n = 67;
    let mut random = Random(6);
    let image = random.many(6 * n, 0.0, 1.0);
    let mut target = random.many(4 * n, 0.0, 1.0);
    (0..n).for_each(|ray| target[3 * n + ray] = (ray % 3 != 0) as u8 as f64);
    target[4] = image[4]; // no error, no gradient
    let (loss, square, d_color) = (
        device.room("loss", n),
        device.room("square", n),
        device.room("d_color", 3 * n),
    );
    device.run(
        kernels::color_loss::Shape::default(),
        n,
        kernels::color_loss::Args {
            image: device.put("image", &image).ptr(),
            target: device.put("target", &target).ptr(),
            loss: loss.ptr_mut(),
            square: square.ptr_mut(),
            d_color: d_color.ptr_mut(),
            n: n as u32,
            scale: 0.5 / n as f32,
        },
    );
    let error = |ray: usize, c: usize| image[c * n + ray] - target[c * n + ray];
    let weight = |ray: usize| target[3 * n + ray];
    let want: Vec<f64> = (0..n)
        .map(|ray| weight(ray) * (0..3).map(|c| error(ray, c).abs()).sum::<f64>() / 3.0)
        .collect();
    assert_forward("loss", &device.take(&loss), &want);
    let want: Vec<f64> = (0..n)
        .map(|ray| weight(ray) * (0..3).map(|c| error(ray, c).powi(2)).sum::<f64>() / 3.0)
        .collect();
    assert_forward("square", &device.take(&square), &want);
    let slope = |ray: usize, c: usize| {
        let error = error(ray, c);
        if error == 0.0 {
            0.0
        } else {
            0.5 / n as f64 * weight(ray) * error.signum() / 3.0
        }
    };
    let want: Vec<f64> = (0..3)
        .flat_map(|c| (0..n).map(move |ray| slope(ray, c)))
        .collect();
    assert_gradient("d_color", &device.take(&d_color), &want);
}

#[test]
fn heaviest_samples_and_bias_queries() {
    let device = device();
    let mut random = Random(7);
    for n_samples in [1, 5, 8, 32, 33, 100] {
        let n = 67;
        let near_far = near_far(&mut random, n);
        let edges: Vec<Vec<f64>> = (0..n)
            .map(|_| uneven_edges(&mut random, n_samples))
            .collect();
        let origins: Vec<[f64; 3]> = (0..n)
            .map(|_| std::array::from_fn(|_| random.uniform(-2.0, 2.0)))
            .collect();
        let directions: Vec<[f64; 3]> = (0..n).map(|_| random.direction()).collect();
        // Few distinct values: most rays have several maxima, some are all zero.
        let levels = |r: &mut Random, ray: usize| match ray % 9 {
            0 => 0.0,
            _ => r.below(4) as f64 / 4.0,
        };
        let weights: Vec<f64> = (0..n * n_samples)
            .map(|p| levels(&mut random, p / n_samples))
            .collect();
        let sdf: Vec<f64> = (0..n * n_samples)
            .map(|p| random.uniform(if p / n_samples % 2 == 0 { 0.0 } else { -0.2 }, 1.0))
            .collect();
        let outside: Vec<u32> = (0..n).map(|ray| u32::from(ray % 11 == 1)).collect();
        let (eps, offset) = (5e-4f32, 1e-2f32);
        for need_opaque in [0, 1] {
            let queries = device.room("queries", 6 * n);
            let gate = device.room("gate", n);
            let heaviest = device.room_uints("heaviest", n);
            device.run(
                kernels::heaviest_sample::Shape::default(),
                n * device.gpu.info().subgroup_size as usize,
                kernels::heaviest_sample::Args {
                    weights: device.put("weights", &weights).ptr(),
                    sdf: device.put("sdf", &sdf).ptr(),
                    edges: device.put("edges", &flat(&edges)).ptr(),
                    near_far: device.put("near_far", &planar(&near_far)).ptr(),
                    ray_outside: device.put_uints("ray_outside", &outside).ptr(),
                    origins: device.put("origins", &planar(&origins)).ptr(),
                    directions: device.put("directions", &planar(&directions)).ptr(),
                    queries: queries.ptr_mut(),
                    gate: gate.ptr_mut(),
                    heaviest: heaviest.ptr_mut(),
                    n: n as u32,
                    n_samples: n_samples as u32,
                    eps,
                    offset,
                    need_opaque,
                },
            );
            let row = |values: &[f64], ray: usize| values[ray * n_samples..][..n_samples].to_vec();
            let want: Vec<usize> = (0..n)
                .map(|ray| twin::heaviest(&row(&weights, ray)))
                .collect();
            assert_eq!(
                device.take_uints(&heaviest),
                want.iter().map(|&k| k as u32).collect::<Vec<_>>()
            );
            let open = |ray: usize| {
                let crosses = row(&sdf, ray).iter().any(|&f| f < 0.0);
                let opaque = row(&weights, ray).iter().sum::<f64>() > 0.999;
                crosses && outside[ray] == 0 && (need_opaque == 0 || opaque)
            };
            let want_gate: Vec<f64> = (0..n)
                .map(|ray| if open(ray) { 1.0 } else { 0.0 })
                .collect();
            assert_eq!(device.take(&gate), want_gate);
            let point = |ray: usize, behind: f32| -> [f64; 3] {
                let t = |edge: usize| twin::distance(edges[ray][edge], near_far[ray]);
                let t = (t(want[ray]) + t(want[ray] + 1)) / 2.0 + f64::from(behind);
                std::array::from_fn(|j| origins[ray][j] + t * directions[ray][j])
            };
            let want: Vec<_> = [eps, offset]
                .iter()
                .flat_map(|&behind| (0..n).map(move |ray| (ray, behind)))
                .collect();
            let want: Vec<_> = want
                .into_iter()
                .map(|(ray, behind)| point(ray, behind))
                .collect();
            assert_close("queries", &device.take(&queries), &planar(&want), 5e-6);
        }
    }
}

/// (loss, d_query_sdf) of the bias-correction kernel.
pub fn run_bias_correction(
    near: &[f64],
    behind: &[f64],
    gate: &[f64],
    eps: f64,
    scale: f64,
    published: bool,
) -> (Vec<f64>, Vec<f64>) {
    let device = device();
    let n = gate.len();
    let (loss, d_query_sdf) = (device.room("loss", n), device.room("d_query_sdf", 2 * n));
    device.run(
        kernels::bias_correction::Shape::default(),
        1,
        kernels::bias_correction::Args {
            query_sdf: device.put("query_sdf", &[near, behind].concat()).ptr(),
            gate: device.put("gate", gate).ptr(),
            loss: loss.ptr_mut(),
            d_query_sdf: d_query_sdf.ptr_mut(),
            n: n as u32,
            eps: eps as f32,
            scale: scale as f32,
            published: u32::from(published),
        },
    );
    (device.take(&loss), device.take(&d_query_sdf))
}

#[test]
fn bias_correction_losses() {
    let mut random = Random(8);
    for n in [3, 256, 700] {
        let near = random.many(n, -0.1, 0.1);
        let behind = random.many(n, -0.1, 0.1);
        let gate: Vec<f64> = (0..n).map(|_| random.below(2) as f64).collect();
        let eps = f64::from(5e-4f32);
        let scale = 0.1 / n as f64;
        for published in [false, true] {
            let (loss, d_loss) = twin::bias_correction(&near, &behind, &gate, eps, published);
            assert_central_differences("bias", &near, &d_loss, |x| {
                twin::bias_correction(x, &behind, &gate, eps, published)
                    .0
                    .iter()
                    .sum()
            });
            let (got, d_got) = run_bias_correction(&near, &behind, &gate, eps, scale, published);
            assert_forward(
                "loss",
                &got,
                &loss.iter().map(|loss| loss * scale).collect::<Vec<_>>(),
            );
            assert_gradient(
                "d_query_sdf",
                &d_got[..n],
                &d_loss.iter().map(|d| d * scale).collect::<Vec<_>>(),
            );
            assert!(
                d_got[n..].iter().all(|&d| d == 0.0),
                "the second query is only compared"
            );
        }
    }
}

/// (loss, d_raw) of the interlevel kernel; `weights` are the proposal's, row by row.
pub fn run_interlevel(rays: &[ProposalRay], weights: &[f64], scale: f64) -> (Vec<f64>, Vec<f64>) {
    let device = device();
    let (n, n_final, n_samples) = (rays.len(), rays[0].final_weights.len(), rays[0].raw.len());
    let near_far: Vec<_> = rays.iter().map(|ray| ray.near_far).collect();
    let (loss, d_raw) = (device.room("loss", n), device.room("d_raw", n * n_samples));
    let transmittance = device.room("transmittance", n * n_samples);
    device.run(
        kernels::interlevel::Shape::default(),
        n,
        kernels::interlevel::Args {
            final_edges: device
                .put(
                    "final_edges",
                    &flat(rays.iter().map(|ray| &ray.final_edges)),
                )
                .ptr(),
            final_weights: device
                .put(
                    "final_weights",
                    &flat(rays.iter().map(|ray| &ray.final_weights)),
                )
                .ptr(),
            edges: device
                .put("edges", &flat(rays.iter().map(|ray| &ray.edges)))
                .ptr(),
            weights: device.put("weights", weights).ptr(),
            raw: device
                .put("raw", &flat(rays.iter().map(|ray| &ray.raw)))
                .ptr(),
            near_far: device.put("near_far", &planar(&near_far)).ptr(),
            loss: loss.ptr_mut(),
            d_raw: d_raw.ptr_mut(),
            transmittance: transmittance.ptr_mut(),
            n: n as u32,
            n_final: n_final as u32,
            n_samples: n_samples as u32,
            scale: scale as f32,
        },
    );
    (device.take(&loss), device.take(&d_raw))
}

#[test]
fn interlevel_loss_and_gradient() {
    let mut random = Random(9);
    let (n, n_final, n_samples) = (67, 21, 31);
    let near_far = near_far(&mut random, n);
    let ray = |&near_far: &[f64; 2]| {
        let raw = random.many(n_samples, -4.0, 4.0);
        let tau = random.many(n_final, 0.0, 0.4);
        let mut ray = ProposalRay {
            final_edges: uneven_edges(&mut random, n_final),
            final_weights: rounded(twin::quadrature(&tau).0),
            edges: uneven_edges(&mut random, n_samples),
            raw,
            near_far,
        };
        // Coinciding edges, as where nothing was resampled, decide what the two-sided search counts.
        ray.final_edges[3] = ray.edges[1].clamp(ray.final_edges[2], ray.final_edges[4]);
        ray
    };
    let mut rays: Vec<ProposalRay> = near_far.iter().map(ray).collect();
    rays[0].raw[5] = 17.0; // where the slope of the truncated exponential is bounded
    rays[1].raw[5] = -17.0;
    rays[2].raw.iter_mut().for_each(|raw| *raw = -40.0); // a proposal that sees nothing
    let scale = 1.0 / n as f64;

    let weights: Vec<Vec<f64>> = rays
        .iter()
        .map(|ray| twin::quadrature(&ray.tau()).0)
        .collect();
    for ray in rays.iter().skip(3).take(8) {
        let value = |x: &[f64]| {
            let moved = ProposalRay {
                raw: x.to_vec(),
                ..ray.clone()
            };
            moved.interlevel(&twin::quadrature(&moved.tau()).0)
        };
        assert_central_differences("raw", &ray.raw, &ray.interlevel_by_raw(), value);
    }
    let (loss, d_raw) = run_interlevel(&rays, &flat(&weights), scale);
    let want: Vec<f64> = rays
        .iter()
        .zip(&weights)
        .map(|(ray, w)| ray.interlevel(w))
        .collect();
    assert_forward("loss", &loss, &want);
    let want: Vec<f64> = rays
        .iter()
        .flat_map(|ray| ray.interlevel_by_raw())
        .map(|d| d * scale)
        .collect();
    assert_gradient("d_raw", &d_raw, &want);
}

#[test]
fn loss_sums() {
    let device = device();
    let mut random = Random(10);
    let arrays: Vec<Vec<f64>> = [1, 255, 256, 5000].map(|n| random.many(n, 0.0, 1.0)).into();
    let buffers: Vec<_> = arrays
        .iter()
        .map(|values| device.put("values", values))
        .collect();
    let term = |(buffer, k): (&neurodin::gpu::Buffer<f32>, usize)| kernels::LossTerm {
        values: buffer.ptr(),
        count: buffer.len() as u32,
        scale: 0.25 * k as f32,
        counts: u32::from(k != 2),
        padding: 0,
    };
    let terms: Vec<_> = buffers.iter().zip(1..).map(term).collect();
    let table = device
        .gpu
        .buffer("terms", terms.len() as u64)
        .expect("a small buffer");
    device.gpu.upload(&table, 0, &terms).expect("upload");
    let (losses, non_finite) = (
        device.room("losses", terms.len() + 1),
        device.put_uints("non_finite", &[0]),
    );
    let sum = || {
        device.run(
            kernels::sum_losses::Shape::default(),
            1,
            kernels::sum_losses::Args {
                terms: table.ptr(),
                losses: losses.ptr_mut(),
                non_finite: non_finite.ptr_mut(),
                n_terms: terms.len() as u32,
            },
        );
        device.take(&losses)
    };
    let mut want: Vec<f64> = arrays
        .iter()
        .zip(1..)
        .map(|(values, k)| 0.25 * k as f64 * values.iter().sum::<f64>())
        .collect();
    want.push(want[0] + want[2] + want[3]); // the second is a figure for the log
    let got = sum();
    assert_forward("losses", &got, &want);
    assert_eq!(got, sum(), "the same values, the same sums");
    assert_eq!(device.take_uints(&non_finite), [0]);
    device
        .gpu
        .upload(&buffers[2], 200, &[f32::NAN])
        .expect("upload");
    sum();
    assert_eq!(device.take_uints(&non_finite), [1]);
}
