//! The losses on rays and the points that one of them asks for: each kernel against its float64 twin, gradients included.

use crate::harness::*;
use crate::volume_twin::{self as twin, ProposalRay};
use neurodin::gpu::Work;
use neurodin::kernels;

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
            n_rays: n as u32,
            scale: 0.5 / n as f32,
            squared: 3.0,
        },
    );
    let error = |ray: usize, c: usize| image[c * n + ray] - target[c * n + ray];
    let weight = |ray: usize| target[3 * n + ray];
    let want: Vec<f64> = (0..n)
        .map(|ray| {
            let errors = (0..3).map(|c| error(ray, c));
            weight(ray) * errors.map(|e| e.abs() + 3.0 * e * e).sum::<f64>() / 3.0
        })
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
            0.5 / n as f64 * weight(ray) * (error.signum() + 6.0 * error) / 3.0
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
        for (need_opaque, ask_all) in [(0, 1), (1, 0), (1, 1)] {
            let queries = device.room("queries", 6 * n);
            let gate = device.room("gate", n);
            let heaviest = device.room("heaviest", n);
            device.run(
                kernels::heaviest_sample::Shape::default(),
                n * device.gpu.info().subgroup_size as usize,
                kernels::heaviest_sample::Args {
                    weights: device.put("weights", &weights).ptr(),
                    sdf: device.put("sdf", &sdf).ptr(),
                    edges: device.put("edges", &flat(&edges)).ptr(),
                    near_far: device.put("near_far", &planar(&near_far)).ptr(),
                    ray_outside: device.table("ray_outside", &outside).ptr(),
                    origins: device.put("origins", &planar(&origins)).ptr(),
                    directions: device.put("directions", &planar(&directions)).ptr(),
                    queries: queries.ptr_mut(),
                    gate: gate.ptr_mut(),
                    heaviest: heaviest.ptr_mut(),
                    n_rays: n as u32,
                    n_samples: n_samples as u32,
                    eps,
                    offset,
                    need_opaque,
                    ask_all,
                },
            );
            let row = |values: &[f64], ray: usize| values[ray * n_samples..][..n_samples].to_vec();
            let want: Vec<usize> = (0..n)
                .map(|ray| twin::heaviest(&row(&weights, ray)))
                .collect();
            assert_eq!(
                device.read(&heaviest),
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
                if ask_all == 0 && !open(ray) {
                    return [0.0; 3];
                }
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
    let (loss, d_query_sdf) = (device.room("loss", n), device.room("d_query_sdf", n));
    device.run(
        kernels::bias_correction::Shape {
            published: u32::from(published),
        },
        n,
        kernels::bias_correction::Args {
            query_sdf: device.put("query_sdf", &[near, behind].concat()).ptr(),
            gate: device.put("gate", gate).ptr(),
            loss: loss.ptr_mut(),
            d_query_sdf: d_query_sdf.ptr_mut(),
            n_rays: n as u32,
            eps: eps as f32,
            scale: scale as f32,
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
                &d_got,
                &d_loss.iter().map(|d| d * scale).collect::<Vec<_>>(),
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
            n_rays: n as u32,
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
    let table = device.table("terms", &terms);
    // So many shares that their workgroups stand in rows, which are equally long.
    let of_share = kernels::loss_shares::Shape { values: 9 };
    let n_shares = 5000u32.div_ceil(of_share.values);
    let (losses, shares, bad_step) = (
        device.room("losses", terms.len() + 1),
        device.room("shares", terms.len() * n_shares as usize),
        device.table("bad_step", &[0]),
    );
    let n_terms = terms.len() as u32;
    let sum = || {
        device.run_work(
            of_share,
            Work::groups(n_shares.into()).slices(n_terms),
            kernels::loss_shares::Args {
                terms: table.ptr(),
                shares: shares.ptr_mut(),
                n_shares,
            },
        );
        device.run(
            kernels::sum_losses::Shape::default(),
            1,
            kernels::sum_losses::Args {
                terms: table.ptr(),
                shares: shares.ptr(),
                losses: losses.ptr_mut(),
                bad_step: bad_step.ptr_mut(),
                n_terms,
                n_shares,
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
    assert_eq!(device.read(&bad_step), [0]);
    device
        .gpu
        .upload(&buffers[2], 200, &[f32::NAN])
        .expect("upload");
    sum();
    assert_eq!(device.read(&bad_step), [1]);
}
