//! The same kernels against arrays that the published implementation computed (float64); see `harness::golden`.
//!
//! The arrays hold densities and weights where the kernels take signed distances and network outputs, so inputs are inverted first.
//! Shapes are the files'.

use crate::harness::*;
use crate::volume_compositing::Batch;
use crate::volume_losses::{run_bias_correction, run_interlevel};
use crate::volume_rays::near_far_of;
use crate::volume_twin::{self as twin, ProposalRay, RaySamples, Scale};
use neurodin::kernels;

/// Rows of an array `[n, m, ...]`.
fn rows(file: &Npz, array: &str) -> Vec<Vec<f64>> {
    let row = file.values(array).len() / file.shape(array)[0];
    file.values(array)
        .chunks(row)
        .map(<[f64]>::to_vec)
        .collect()
}

/// The logit whose local scale is 1/beta.
fn logit_of(beta: f64, scale: Scale) -> f64 {
    let sigmoid = (beta - scale.floor) / scale.range;
    (sigmoid / (1.0 - sigmoid)).ln()
}

/// Network outputs whose quadrature gives these weights.
fn raw_of(weights: &[f64], lengths: &[f64]) -> Vec<f64> {
    let mut transmittance: f64 = 1.0;
    let raw = weights.iter().zip(lengths).map(|(&w, length)| {
        let alpha = (w / transmittance.max(1e-300)).clamp(0.0, 1.0 - 1e-12);
        transmittance -= w;
        (-(-alpha).ln_1p() / length).ln().clamp(-60.0, 60.0)
    });
    rounded(raw)
}

/// Distances of edges on the device: what midpoint_positions makes of rays from the origin along x.
fn middle_distances(edges: &[Vec<f64>], near_far: &[[f64; 2]]) -> Vec<f64> {
    let device = device();
    let (n, n_samples) = (edges.len(), edges[0].len() - 1);
    let points = device.room("points", 3 * n * n_samples);
    device.run(
        kernels::midpoint_positions::Shape::default(),
        n * n_samples,
        kernels::midpoint_positions::Args {
            origins: device.put("origins", &vec![0.0; 3 * n]).ptr(),
            directions: device
                .put("directions", &planar(&vec![[1.0, 0.0, 0.0]; n]))
                .ptr(),
            near_far: device.put("near_far", &planar(near_far)).ptr(),
            edges: device.put("edges", &edges.concat()).ptr(),
            points: points.ptr_mut(),
            n_rays: n as u32,
            n_samples: n_samples as u32,
        },
    );
    device.take(&points)[..n * n_samples].to_vec()
}

fn middles(edges: &[Vec<f64>]) -> Vec<f64> {
    edges
        .iter()
        .flat_map(|ray| ray.windows(2).map(|pair| (pair[0] + pair[1]) / 2.0))
        .collect()
}

fn place(n: usize, n_samples: usize, draws: Option<&[f64]>) -> Vec<f64> {
    let device = device();
    let edges = device.room("edges", n * (n_samples + 1));
    device.run(
        kernels::place_samples::Shape::default(),
        n * (n_samples + 1),
        kernels::place_samples::Args {
            jitter: device.put("jitter", draws.unwrap_or(&[0.0])).ptr(),
            edges: edges.ptr_mut(),
            n_rays: n as u32,
            n_samples: n_samples as u32,
            train: u32::from(draws.is_some()),
        },
    );
    device.take(&edges)
}

#[test]
fn sphere_collider() {
    let Some(file) = golden("sphere_collider") else {
        return;
    };
    let (near, far, outside) = near_far_of(&file.vectors("origins"), &file.vectors("directions"));
    let (want_near, want_far) = (file.values("near"), file.values("far"));
    for ray in 0..near.len() {
        // A sphere that lies behind the camera leaves the published code with a segment of length zero; here the ray misses it.
        let behind = want_near[ray] == want_far[ray];
        let (want_near, want_far) = if behind {
            (1.0, 1.2)
        } else {
            (want_near[ray], want_far[ray])
        };
        assert_eq!(
            outside[ray] != 0,
            behind || file.values("outside")[ray] != 0.0,
            "ray {ray}"
        );
        assert!(
            (near[ray] + far[ray] - want_near - want_far).abs() < 1e-5,
            "ray {ray}"
        );
        assert!(
            ((far[ray] - near[ray]).powi(2) - (want_far - want_near).powi(2)).abs() < 1e-5,
            "ray {ray}"
        );
    }
}

#[test]
fn proposal_sampling() {
    let Some(file) = golden("proposal_sampling") else {
        return;
    };
    let device = device();
    let (near, far) = (file.values("near"), file.values("far"));
    let near_far: Vec<[f64; 2]> = near
        .iter()
        .zip(far)
        .map(|(&near, &far)| [f64::from(near as f32), f64::from(far as f32)])
        .collect();
    let (n, n_new) = (near.len(), file.scalar("n_new") as usize);
    for mode in ["train", "eval"] {
        let array = |name: &str| format!("{mode}_{name}");
        let draws = |name: &str| file.find(&array(name)).map(|array| array.values.clone());
        let edges = rows(&file, &array("edges_s"));
        let n_samples = edges[0].len() - 1;
        assert_close(
            "edges",
            &place(n, n_samples, draws("xi_uniform").as_deref()),
            &edges.concat(),
            2e-7,
        );
        assert_forward(
            "edges_t",
            &middle_distances(&edges, &near_far),
            &middles(&rows(&file, &array("edges_t"))),
        );

        let edges: Vec<Vec<f64>> = edges.into_iter().map(rounded).collect();
        let weights = rows(&file, &array("weights"));
        let raw: Vec<f64> = (0..n)
            .flat_map(|ray| raw_of(&weights[ray], &twin::lengths(&edges[ray], near_far[ray])))
            .collect();
        let (got_weights, new_edges) = (
            device.room("weights", n * n_samples),
            device.room("new edges", n * (n_new + 1)),
        );
        let jitter = draws("xi_pdf_times_B");
        device.run(
            kernels::resample::Shape::default(),
            n,
            kernels::resample::Args {
                raw: device.put("raw", &raw).ptr(),
                edges: device.put("edges", &edges.concat()).ptr(),
                near_far: device.put("near_far", &planar(&near_far)).ptr(),
                jitter: device
                    .put("jitter", jitter.as_deref().unwrap_or(&[0.0]))
                    .ptr(),
                weights: got_weights.ptr_mut(),
                new_edges: new_edges.ptr_mut(),
                n_rays: n as u32,
                n_samples: n_samples as u32,
                n_new: n_new as u32,
                train: u32::from(jitter.is_some()),
                anneal: file.scalar("anneal") as f32,
            },
        );
        assert_forward("weights", &device.take(&got_weights), &weights.concat());
        let new_edges = device.take(&new_edges);
        assert_close(
            "new edges",
            &new_edges,
            file.values(&array("new_edges_s")),
            2e-5,
        );
        let new_edges: Vec<Vec<f64>> = new_edges.chunks(n_new + 1).map(<[f64]>::to_vec).collect();
        assert_forward(
            "new edges_t",
            &middle_distances(&new_edges, &near_far),
            &middles(&rows(&file, &array("new_edges_t"))),
        );
    }
}

#[test]
fn interlevel() {
    let Some(file) = golden("interlevel") else {
        return;
    };
    let near_far = [0.0, f64::from(0.8f32)];
    let (final_edges, final_weights) = (rows(&file, "edges_final"), rows(&file, "w_final"));
    for level in [0, 1] {
        let edges = rows(&file, &format!("edges{level}"));
        let edges: Vec<Vec<f64>> = edges.into_iter().map(rounded).collect(); // narrow bins feel it
        let weights = rows(&file, &format!("w{level}"));
        let ray = |i: usize| ProposalRay {
            final_edges: final_edges[i].clone(),
            final_weights: final_weights[i].clone(),
            raw: raw_of(&weights[i], &twin::lengths(&edges[i], near_far)),
            edges: edges[i].clone(),
            near_far,
        };
        let rays: Vec<_> = (0..edges.len()).map(ray).collect();
        let scale = 1.0 / rays.len() as f64;
        let (loss, d_raw) = run_interlevel(&rays, &weights.concat(), scale);
        let loss = loss.iter().sum::<f64>() * scale;
        assert_forward("loss", &[loss], &[file.scalar(&format!("loss{level}"))]);
        // The file's gradients are by the weights.
        let d_weights = rows(&file, &format!("grad_w{level}"));
        let d_ray = |(ray, d): (&ProposalRay, &Vec<f64>)| {
            let tau = ray.tau();
            let d_tau = twin::quadrature_backward(&tau, d, 0.0);
            tau.iter()
                .zip(d_tau)
                .map(|(tau, d)| tau * d)
                .collect::<Vec<_>>()
        };
        assert_gradient(
            "d_raw",
            &d_raw,
            &rays
                .iter()
                .zip(&d_weights)
                .flat_map(d_ray)
                .collect::<Vec<_>>(),
        );
    }
}

#[test]
fn compositing() {
    let Some(file) = golden("compositing") else {
        return;
    };
    let (edges_t, sigma, rgb) = (
        rows(&file, "edges"),
        rows(&file, "sigma"),
        rows(&file, "rgb"),
    );
    let background: [f64; 3] = file
        .values("background")
        .try_into()
        .expect("three channels");
    // Deep inside matter the density is the inverse scale: give every sample that of its density.
    let positive = file.values("sigma").iter().copied().filter(|&s| s > 0.0);
    let thinnest = positive.fold(f64::INFINITY, f64::min);
    let scale = Scale {
        range: f64::from((2.0 / thinnest) as f32),
        floor: 0.0,
        inv_s_lower: 0.0,
    };
    let ray = |i: usize| {
        let t = &edges_t[i];
        let near_far = [f64::from(t[0] as f32), f64::from(t[t.len() - 1] as f32)];
        RaySamples {
            sdf: sigma[i]
                .iter()
                .map(|&s| if s > 0.0 { -1e30 } else { 1e30 })
                .collect(),
            logit: rounded(sigma[i].iter().map(|&s| {
                if s > 0.0 {
                    logit_of(1.0 / s, scale)
                } else {
                    0.0
                }
            })),
            edges: rounded(
                t.iter()
                    .map(|&t| twin::position(t, near_far).clamp(0.0, 1.0)),
            ),
            near_far,
            empty: false,
            rgb: rgb[i]
                .chunks(3)
                .map(|c| std::array::from_fn(|k| (c[k] + 0.001) / 1.002))
                .collect(),
            background,
        }
    };
    let rays: Vec<_> = (0..sigma.len()).map(ray).collect();
    let batch = Batch::new(&rays);
    let (weights, image) = batch.forward(scale);
    assert_forward("weights", &weights, file.values("weights"));
    let image = interleaved::<6>(&image);
    let channel = |k: usize| image.iter().map(|pixel| pixel[k]).collect::<Vec<_>>();
    assert_forward(
        "colour",
        &image
            .iter()
            .flat_map(|p| [p[0], p[1], p[2]])
            .collect::<Vec<_>>(),
        file.values("color"),
    );
    assert_forward("accumulation", &channel(3), file.values("accumulation"));
    let middle = middles(&edges_t);
    let (first, last) = middle
        .iter()
        .fold((f64::MAX, f64::MIN), |(a, b), &t| (a.min(t), b.max(t)));
    let depth: Vec<f64> = channel(5).iter().map(|d| d.clamp(first, last)).collect();
    assert_forward("depth", &depth, file.values("depth_clipped"));
    // The file's transmittance is that before each sample; the last sample's weight takes it to the end.
    let end = rows(&file, "transmittance")
        .iter()
        .zip(rows(&file, "weights"))
        .map(|(t, w)| t[t.len() - 1] - w[w.len() - 1])
        .collect::<Vec<_>>();
    assert_forward("transmittance at the end", &channel(4), &end);

    let [_, d_logit, d_rgb, _] = batch.backward(scale, &planar(&file.vectors("cotangent_color")));
    let want_rgb = planar(&file.vectors("grad_rgb"));
    assert_gradient(
        "d_rgb",
        &d_rgb.iter().map(|d| d / 1.002).collect::<Vec<_>>(),
        &want_rgb,
    );
    // Where there is no density, the logit does not reach it.
    let dense: Vec<usize> = (0..d_logit.len())
        .filter(|&p| file.values("sigma")[p] > 0.0)
        .collect();
    let n_samples = sigma[0].len();
    let d_sigma = |&p: &usize| {
        d_logit[p] / twin::local_scale(rays[p / n_samples].logit[p % n_samples], scale).1
    };
    let want: Vec<f64> = dense
        .iter()
        .map(|&p| file.values("grad_sigma")[p])
        .collect();
    assert_gradient(
        "d_sigma",
        &dense.iter().map(d_sigma).collect::<Vec<_>>(),
        &want,
    );
}

/// One sample per ray, so that weights and gradients are those of one density.
fn single_samples(sdf: &[f64], logit: &[f64], length: impl Fn(usize) -> f64) -> Vec<RaySamples> {
    let ray = |i: usize| RaySamples {
        sdf: vec![sdf[i]],
        logit: vec![logit[i]],
        edges: vec![0.0, 1.0],
        near_far: [0.0, f64::from(length(i) as f32)],
        empty: false,
        rgb: vec![[1.001 / 1.002; 3]],
        background: [0.0; 3],
    };
    (0..sdf.len()).map(ray).collect()
}

/// Densities from the weights of single samples.
fn densities(rays: &[RaySamples], weights: &[f64]) -> Vec<f64> {
    rays.iter()
        .zip(weights)
        .map(|(ray, w)| -(-w).ln_1p() / ray.near_far[1])
        .collect()
}

#[test]
fn laplace_density() {
    let Some(file) = golden("laplace_density") else {
        return;
    };
    let (sdf, beta) = (file.values("sdf"), file.values("beta"));
    let (least, most) = beta
        .iter()
        .fold((f64::MAX, 0.0f64), |(a, b), &x| (a.min(x), b.max(x)));
    let round = |x: f64| f64::from(x as f32);
    let scale = Scale {
        range: round(2.0 * most),
        floor: round(0.5 * least),
        inv_s_lower: 0.0,
    };
    let logit: Vec<f64> = beta.iter().map(|&beta| logit_of(beta, scale)).collect();
    let rays = single_samples(sdf, &logit, |i| 0.5 * beta[i]);
    let batch = Batch::new(&rays);
    let (weights, _) = batch.forward(scale);
    assert_forward("sigma", &densities(&rays, &weights), file.values("sigma"));

    let d_color: Vec<[f64; 3]> = vec![[1.0, 0.0, 0.0]; rays.len()];
    let [d_sdf, d_logit, _, _] = batch.backward(scale, &planar(&d_color));
    let d_sigma =
        |i: usize| file.values("cotangent")[i] / ((1.0 - weights[i]) * rays[i].near_far[1]);
    // At exactly zero the published code's sign() has no derivative and gives 0, a measure-zero slip; both one-sided slopes are -1/(2 beta^2).
    let smooth: Vec<usize> = (0..sdf.len()).filter(|&i| sdf[i] != 0.0).collect();
    let got: Vec<f64> = smooth.iter().map(|&i| d_sdf[i] * d_sigma(i)).collect();
    assert_gradient(
        "d_sdf",
        &got,
        &smooth
            .iter()
            .map(|&i| file.values("grad_sdf")[i])
            .collect::<Vec<_>>(),
    );
    let d_beta = |i: usize| {
        let sigmoid = (beta[i] - scale.floor) / scale.range;
        d_logit[i] * d_sigma(i) / (scale.range * sigmoid * (1.0 - sigmoid))
    };
    assert_gradient(
        "d_beta",
        &(0..sdf.len()).map(d_beta).collect::<Vec<_>>(),
        file.values("grad_beta"),
    );

    let bounded = Scale {
        inv_s_lower: round(1.0 / file.scalar("schedule_beta")),
        ..scale
    };
    let (weights, _) = batch.forward(bounded);
    assert_forward(
        "sigma under the bound",
        &densities(&rays, &weights),
        file.values("sigma_clamped"),
    );
}

#[test]
fn local_scale() {
    let Some(file) = golden("local_scale") else {
        return;
    };
    let logit = file.values("v");
    let inside = vec![-1e30; logit.len()]; // density = 1/beta
    let lower = file.scalar("lower_bound");
    for (array, lower) in [("inv_s", 0.0), ("inv_s_clamped", lower)] {
        let scale = Scale {
            range: 0.1,
            floor: 2e-4,
            inv_s_lower: lower,
        };
        let rays = single_samples(&inside, logit, |i| 0.5 / file.values("inv_s")[i]);
        let batch = Batch::new(&rays);
        let (weights, _) = batch.forward(scale);
        assert_forward(array, &densities(&rays, &weights), file.values(array));
        let [_, d_logit, _, _] = batch.backward(scale, &vec![1.0; 3 * rays.len()]);
        for (i, d) in d_logit.iter().enumerate() {
            let clamped = lower > 0.0 && file.values("inv_s")[i] < lower * (1.0 - 1e-6);
            assert_eq!(
                *d == 0.0,
                clamped || logit[i] > 100.0,
                "logit {} has the gradient {d}",
                logit[i]
            );
        }
    }
}

#[test]
fn bias_correction() {
    let Some(file) = golden("bias_correction") else {
        return;
    };
    let device = device();
    let shape = file.shape("weights");
    let (n, n_samples) = (shape[0], shape[1]);
    let (eps, offset, weight) = (file.scalar("eps"), file.scalar("c"), file.scalar("weight"));
    let directions = file.vectors("directions");
    let midpoints = file.vectors("midpoints");
    // The file's midpoints lie on no ray: start each ray so that the middle of its heaviest bin is the file's.
    let near_far = vec![[0.0, f64::from(0.8f32)]; n];
    let edges: Vec<f64> = (0..=n_samples)
        .map(|i| i as f64 / n_samples as f64)
        .collect();
    let origin = |ray: usize| -> [f64; 3] {
        let k = twin::heaviest(&file.values("weights")[ray * n_samples..][..n_samples]);
        let t = (twin::distance(edges[k], near_far[ray])
            + twin::distance(edges[k + 1], near_far[ray]))
            / 2.0;
        std::array::from_fn(|j| midpoints[ray * n_samples + k][j] - t * directions[ray][j])
    };
    let origins: Vec<_> = (0..n).map(origin).collect();
    for (scene, need_opaque) in [("outdoor", 1), ("indoor", 0)] {
        let array = |name: &str| format!("{name}_{scene}");
        let (queries, gate) = (device.room("queries", 6 * n), device.room("gate", n));
        let heaviest = device.room("heaviest", n);
        device.run(
            kernels::heaviest_sample::Shape::default(),
            n * device.gpu.info().subgroup_size as usize,
            kernels::heaviest_sample::Args {
                weights: device.put("weights", file.values("weights")).ptr(),
                sdf: device.put("sdf", file.values("sdf")).ptr(),
                edges: device.put("edges", &edges.repeat(n)).ptr(),
                near_far: device.put("near_far", &planar(&near_far)).ptr(),
                ray_outside: device.table("ray_outside", &vec![0; n]).ptr(),
                origins: device.put("origins", &planar(&origins)).ptr(),
                directions: device.put("directions", &planar(&directions)).ptr(),
                queries: queries.ptr_mut(),
                gate: gate.ptr_mut(),
                heaviest: heaviest.ptr_mut(),
                n_rays: n as u32,
                n_samples: n_samples as u32,
                eps: eps as f32,
                offset: offset as f32,
                need_opaque,
                ask_all: 1,
            },
        );
        assert_close(
            "queries",
            &device.take(&queries),
            &planar(&file.vectors("query_points")),
            2e-6,
        );
        let gate = device.take(&gate);
        assert_eq!(gate, file.values(&array("gate")));

        let (near, behind) = (file.values("f_at_P_plus_eps"), file.values("f_at_P_plus_c"));
        for (form, published) in [("per_ray", false), ("shipped", true)] {
            let scale = weight / n as f64;
            let (loss, d_loss) = run_bias_correction(near, behind, &gate, eps, scale, published);
            let loss = loss.iter().sum::<f64>();
            assert_forward(
                form,
                &[loss],
                &[file.scalar(&array(&format!("loss_{form}")))],
            );
            assert_gradient(
                form,
                &d_loss,
                file.values(&array(&format!("grad_f1_{form}"))),
            );
        }
    }
}

#[test]
fn whole_step_of_stage_1() {
    let Some(file) = golden("e2e_stage1") else {
        return;
    };
    let device = device();
    let (origins, directions) = (file.vectors("origins"), file.vectors("directions"));
    let n = origins.len();
    let met: Vec<_> = (0..n)
        .map(|ray| twin::meet_sphere(origins[ray], directions[ray]))
        .collect();
    let near_far: Vec<[f64; 2]> = met
        .iter()
        .map(|m| [f64::from(m.0 as f32), f64::from(m.1 as f32)])
        .collect();
    let first = rows(&file, "edges_s0");
    assert_close(
        "first edges",
        &place(n, first[0].len() - 1, Some(file.values("draw0_rand"))),
        &first.concat(),
        2e-7,
    );
    for level in 0..3 {
        let edges = rows(&file, &format!("edges_s{level}"));
        let want = middles(&rows(&file, &format!("edges_t{level}")));
        assert_forward("distances", &middle_distances(&edges, &near_far), &want);
    }

    let bound = 1.0 / file.scalar("schedule_beta");
    let scale = Scale {
        range: 0.1,
        floor: 2e-4,
        inv_s_lower: bound,
    };
    let (sdf, edges, rgb) = (
        rows(&file, "sdf"),
        rows(&file, "edges_s2"),
        rows(&file, "sample_rgb"),
    );
    let n_samples = sdf[0].len();
    let ray = |i: usize| RaySamples {
        sdf: sdf[i].clone(),
        logit: file.values("inv_s")[i * n_samples..][..n_samples]
            .iter()
            .map(|s| logit_of(1.0 / s, scale))
            .collect(),
        edges: edges[i].clone(),
        near_far: near_far[i],
        empty: met[i].2,
        rgb: rgb[i]
            .chunks(3)
            .map(|c| std::array::from_fn(|k| (c[k] + 0.001) / 1.002))
            .collect(),
        background: file
            .values("background")
            .try_into()
            .expect("three channels"),
    };
    let rays: Vec<_> = (0..n).map(ray).collect();
    let (weights, image) = Batch::new(&rays).forward(scale);
    assert_forward("weights", &weights, file.values("weights"));
    let color = interleaved::<6>(&image)
        .iter()
        .flat_map(|p| [p[0], p[1], p[2]])
        .collect::<Vec<_>>();
    assert_forward("colour", &color, file.values("rgb"));
    assert_forward(
        "accumulation",
        &image[3 * n..4 * n],
        file.values("accumulation"),
    );

    let target: Vec<[f64; 4]> = file
        .vectors("target")
        .iter()
        .map(|&[r, g, b]| [r, g, b, 1.0])
        .collect();
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
            target: device.put("target", &planar(&target)).ptr(),
            loss: loss.ptr_mut(),
            square: square.ptr_mut(),
            d_color: d_color.ptr_mut(),
            n_rays: n as u32,
            scale: 1.0 / n as f32,
            squared: 0.0,
        },
    );
    let loss = device.take(&loss).iter().sum::<f64>() / n as f64;
    assert_forward("colour loss", &[loss], &[file.scalar("loss_rgb_loss")]);
}
