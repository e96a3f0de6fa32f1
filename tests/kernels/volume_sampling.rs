//! First edges, resampling and sample positions: each kernel against its float64 twin.

use crate::harness::*;
use crate::volume_twin as twin;
use neurodin::kernels;

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
                n_rays: n as u32,
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
                n_rays: n as u32,
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
            n_rays: n as u32,
            n_samples: n_samples as u32,
        },
    );
    let want: Vec<_> = samples()
        .map(|(ray, i)| at(ray, (t(ray, i) + t(ray, i + 1)) / 2.0))
        .collect();
    assert_close("midpoints", &device.take(&points), &planar(&want), 5e-6);

    let (tap_range, tap_floor) = (0.1f32, 1.0f32 / 4096.0);
    let around = |taps: usize, tap: usize| -> [f64; 3] {
        if taps == 4 {
            let k = [[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]][tap];
            return k.map(|k| f64::from(k) / 3.0_f64.sqrt());
        }
        let mut axis = [0.0; 3];
        axis[tap / 2] = if tap.is_multiple_of(2) { 1.0 } else { -1.0 };
        axis
    };
    for (taps, midpoint) in [(0, 0), (0, 1), (4, 1), (6, 0)] {
        let points = device.room("points", 3 * (1 + taps) * count);
        device.run(
            kernels::surface_points::Shape {
                taps: taps as u32,
                midpoint,
            },
            count,
            kernels::surface_points::Args {
                origins: device.put("origins", &planar(&origins)).ptr(),
                directions: device.put("directions", &planar(&directions)).ptr(),
                near_far: device.put("near_far", &planar(&near_far)).ptr(),
                edges: device.put("edges", &flat(&edges)).ptr(),
                tap_draws: device.put("tap_draws", &draws).ptr(),
                points: points.ptr_mut(),
                n_rays: n as u32,
                n_samples: n_samples as u32,
                tap_range,
                tap_floor,
            },
        );
        let distance = |ray, i| match midpoint {
            0 => t(ray, i),
            _ => (t(ray, i) + t(ray, i + 1)) / 2.0,
        };
        let samples: Vec<[f64; 3]> = samples()
            .map(|(ray, i)| at(ray, distance(ray, i)))
            .collect();
        let mut want = samples.clone();
        for tap in 0..taps {
            want.extend(samples.iter().zip(&draws).map(|(x, draw)| {
                let delta = (f64::from(tap_range) * draw).max(f64::from(tap_floor));
                let offset = around(taps, tap);
                std::array::from_fn::<f64, 3, _>(|axis| x[axis] + delta * offset[axis])
            }));
        }
        assert_close(
            "surface points",
            &device.take(&points),
            &planar(&want),
            5e-6,
        );
    }
}
