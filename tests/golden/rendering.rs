//! Golden vectors of everything along a ray: collider, sampling, density, compositing, and the losses.

use crate::reference::losses::BiasReduction;
use crate::reference::sampling::{self, Stretch};
use crate::reference::tape::Tape;
use crate::reference::{golden, losses, surface, volume};
use crate::{assert_close, parameter};

#[test]
fn laplace_density() {
    let Some(npz) = golden::open("laplace_density") else {
        return;
    };
    let tape = &mut Tape::default();
    let (sdf, beta) = (parameter(tape, &npz, "sdf"), parameter(tape, &npz, "beta"));
    let sigma = volume::laplace_density(tape, sdf, beta);
    assert_close("sigma", tape.value(sigma), npz.values("sigma"), 1e-12);
    let gradients = tape.backward_with(sigma, npz.values("cotangent"));
    assert_close(
        "grad_sdf",
        &gradients.get(sdf),
        npz.values("grad_sdf"),
        1e-12,
    );
    assert_close(
        "grad_beta",
        &gradients.get(beta),
        npz.values("grad_beta"),
        1e-12,
    );

    let clamped: Vec<f64> = npz
        .values("beta")
        .iter()
        .map(|beta| beta.min(npz.scalar("schedule_beta")))
        .collect();
    assert_close("beta_clamped", &clamped, npz.values("beta_clamped"), 1e-15);
    let sigma: Vec<f64> = npz
        .values("sdf")
        .iter()
        .zip(&clamped)
        .map(|(&f, &beta)| volume::laplace(f, beta))
        .collect();
    assert_close("sigma_clamped", &sigma, npz.values("sigma_clamped"), 1e-12);
}

#[test]
fn density_along_the_ray() {
    let Some(npz) = golden::open("tuvr_density") else {
        return;
    };
    let tape = &mut Tape::default();
    let [sdf, beta] = ["sdf", "beta"].map(|array| parameter(tape, &npz, array));
    let [sdf, beta] = [sdf, beta].map(|x| tape.reshape(x, x.len(), 1));
    let (gradient, direction) = (
        parameter(tape, &npz, "gradient"),
        parameter(tape, &npz, "direction"),
    );
    let a = volume::distance_along_ray(tape, sdf, gradient, direction);
    let sigma = volume::laplace_density(tape, a, beta);
    assert_close("sigma", tape.value(sigma), npz.values("sigma"), 1e-12);
    let gradients = tape.backward_with(sigma, npz.values("cotangent"));
    assert_close(
        "grad_sdf",
        &gradients.get(sdf),
        npz.values("grad_sdf"),
        1e-11,
    );
    assert_close(
        "grad_gradient",
        &gradients.get(gradient),
        npz.values("grad_gradient"),
        1e-11,
    );
    assert_close(
        "grad_beta",
        &gradients.get(beta),
        npz.values("grad_beta"),
        1e-11,
    );
}

#[test]
fn local_scale() {
    let Some(npz) = golden::open("local_scale") else {
        return;
    };
    let tape = &mut Tape::default();
    let v = parameter(tape, &npz, "v");
    let free = volume::inverse_scale(tape, v, 0.1, 2e-4, 0.0);
    assert_close("inv_s", tape.value(free), npz.values("inv_s"), 1e-13);
    let lower = npz.scalar("lower_bound");
    let bounded = volume::inverse_scale(tape, v, 0.1, 2e-4, lower);
    assert_close(
        "inv_s_clamped",
        tape.value(bounded),
        npz.values("inv_s_clamped"),
        1e-13,
    );
    let beta = volume::reciprocal(tape, bounded);
    assert_close("beta", tape.value(beta), npz.values("beta"), 1e-13);
    let gradient = tape.backward_with(beta, &vec![1.0; beta.len()]).get(v);
    for ((v, inv_s), d_v) in npz
        .values("v")
        .iter()
        .zip(npz.values("inv_s"))
        .zip(gradient)
    {
        if *inv_s < lower {
            assert_eq!(
                d_v, 0.0,
                "the bound holds at v = {v}, and gives no gradient"
            );
        } else if v.abs() < 30.0 {
            assert!(d_v > 0.0, "the bound does not hold at v = {v}");
        }
    }
}

#[test]
fn compositing() {
    let Some(npz) = golden::open("compositing") else {
        return;
    };
    let [rays, samples] = npz.shape("sigma") else {
        panic!("sigma is rays x samples")
    };
    let (rays, samples) = (*rays, *samples);
    let edges: Vec<&[f64]> = npz.values("edges").chunks_exact(samples + 1).collect();
    let tape = &mut Tape::default();
    let (sigma, rgb) = (parameter(tape, &npz, "sigma"), parameter(tape, &npz, "rgb"));
    let background = tape.constant(rays, 3, npz.values("background").repeat(rays));
    let weights = volume::ray_weights(
        tape,
        sigma,
        edges.iter().flat_map(|t| sampling::lengths(t)).collect(),
    );
    let color = volume::composite(tape, weights, rgb, background);
    assert_close("color", tape.value(color), npz.values("color"), 1e-12);
    let gradients = tape.backward_with(color, npz.values("cotangent_color"));
    assert_close(
        "grad_sigma",
        &gradients.get(sigma),
        npz.values("grad_sigma"),
        1e-12,
    );
    assert_close(
        "grad_rgb",
        &gradients.get(rgb),
        npz.values("grad_rgb"),
        1e-12,
    );

    // The published depth is clipped to the extremes of all bins of the batch.
    let middles: Vec<Vec<f64>> = edges.iter().map(|t| sampling::midpoints(t)).collect();
    let first = middles
        .iter()
        .flatten()
        .copied()
        .fold(f64::INFINITY, f64::min);
    let last = middles
        .iter()
        .flatten()
        .copied()
        .fold(f64::NEG_INFINITY, f64::max);
    for (ray, middles) in middles.iter().enumerate() {
        let row = &tape.value(weights)[ray * (samples + 1)..][..samples + 1];
        assert_close(
            "weights",
            &row[..samples],
            &npz.values("weights")[ray * samples..][..samples],
            1e-12,
        );
        let sum: f64 = row[..samples].iter().sum();
        assert_close(
            "accumulation",
            &[sum],
            &npz.values("accumulation")[ray..=ray],
            1e-12,
        );
        let left: Vec<f64> = (0..samples)
            .map(|sample| 1.0 - row[..sample].iter().sum::<f64>())
            .collect();
        assert_close(
            "transmittance",
            &left,
            &npz.values("transmittance")[ray * samples..][..samples],
            1e-12,
        );
        let depth = volume::expected_depth(&row[..samples], middles).clamp(first, last);
        assert_close(
            "depth",
            &[depth],
            &npz.values("depth_clipped")[ray..=ray],
            1e-12,
        );
    }
}

#[test]
fn sphere_collider() {
    let Some(npz) = golden::open("sphere_collider") else {
        return;
    };
    for (ray, (&o, &d)) in npz
        .vectors("origins")
        .iter()
        .zip(&npz.vectors("directions"))
        .enumerate()
    {
        let theirs = Stretch {
            near: npz.values("near")[ray],
            far: npz.values("far")[ray],
            outside: npz.values("outside")[ray] != 0.0,
        };
        let ours = sampling::collide_sphere(o, d);
        if theirs.near == theirs.far {
            // The published stretch of length 0, of rays that leave the sphere behind, is a miss here.
            assert_eq!(theirs.near, 0.0);
            assert_eq!(
                ours,
                Stretch {
                    near: 1.0,
                    far: 1.2,
                    outside: true
                }
            );
        } else {
            assert_close(
                "near, far",
                &[ours.near, ours.far],
                &[theirs.near, theirs.far],
                1e-12,
            );
            assert_eq!(ours.outside, theirs.outside);
        }
    }
}

#[test]
fn proposal_sampling() {
    let Some(npz) = golden::open("proposal_sampling") else {
        return;
    };
    let new = npz.scalar("n_new") as usize;
    for mode in ["train", "eval"] {
        let array = |name: &str| npz.array(&format!("{mode}_{name}"));
        let bins = array("weights").shape[1];
        for ray in 0..npz.values("near").len() {
            let row = |name: &str, width: usize| &array(name).values[ray * width..][..width];
            let stretch = Stretch {
                near: npz.values("near")[ray],
                far: npz.values("far")[ray],
                outside: false,
            };
            let draw = |name: &str| (mode == "train").then(|| array(name).values[ray]);
            let first = draw("xi_uniform");
            let same = |_| first.unwrap_or(0.5);
            let edges = sampling::place(
                bins,
                first.is_some().then_some(&same as &dyn Fn(usize) -> f64),
            );
            assert_close("edges_s", &edges, row("edges_s", bins + 1), 1e-13);
            let t = sampling::distances(&edges, stretch);
            assert_close("edges_t", &t, row("edges_t", bins + 1), 1e-12);
            let weights = row("weights", bins);
            let edges = sampling::resample(
                &edges,
                weights,
                npz.scalar("anneal"),
                new,
                draw("xi_pdf_times_B"),
            );
            assert_close("new_edges_s", &edges, row("new_edges_s", new + 1), 1e-12);
            let t = sampling::distances(&edges, stretch);
            assert_close("new_edges_t", &t, row("new_edges_t", new + 1), 1e-11);
        }
    }
}

#[test]
fn interlevel() {
    let Some(npz) = golden::open("interlevel") else {
        return;
    };
    let tape = &mut Tape::default();
    let mut sum = 0.0;
    for level in 0..2 {
        let weights = parameter(tape, &npz, &format!("w{level}"));
        let edges = npz.values(&format!("edges{level}"));
        let loss = losses::interlevel(
            tape,
            weights,
            edges,
            npz.values("w_final"),
            npz.values("edges_final"),
        );
        assert_close(
            "loss",
            tape.value(loss),
            npz.values(&format!("loss{level}")),
            1e-12,
        );
        sum += tape.scalar(loss);
        let gradient = tape.backward(loss).get(weights);
        assert_close(
            "gradient",
            &gradient,
            npz.values(&format!("grad_w{level}")),
            1e-11,
        );
    }
    assert_close("sum", &[sum], npz.values("loss"), 1e-12);
}

#[test]
fn bias_correction() {
    let Some(npz) = golden::open("bias_correction") else {
        return;
    };
    let [rays, samples] = *npz.shape("weights") else {
        panic!("weights are rays x samples")
    };
    let (epsilon, weight) = (npz.scalar("eps"), npz.scalar("weight"));
    let row = |array: &str, ray: usize| npz.values(array)[ray * samples..][..samples].to_vec();
    let midpoints = npz.vectors("midpoints");
    let middles: Vec<[f64; 3]> = (0..rays)
        .map(|ray| midpoints[ray * samples + losses::heaviest(&row("weights", ray))])
        .collect();
    let points = losses::bias_points(
        &middles,
        &npz.vectors("directions"),
        epsilon,
        npz.scalar("c"),
    );
    assert_close(
        "query_points",
        points.as_flattened(),
        npz.values("query_points"),
        1e-13,
    );

    for place in ["outdoor", "indoor"] {
        let gates: Vec<f64> = (0..rays)
            .map(|ray| {
                losses::bias_gate(&row("sdf", ray), &row("weights", ray), place == "outdoor")
            })
            .collect();
        assert_eq!(gates, npz.values(&format!("gate_{place}")));
        for (name, reduction) in [
            ("shipped", BiasReduction::Published),
            ("per_ray", BiasReduction::PerRay),
        ] {
            let tape = &mut Tape::default();
            let f = [npz.values("f_at_P_plus_eps"), npz.values("f_at_P_plus_c")].concat();
            let f = tape.parameter(2 * rays, 1, f);
            let loss = losses::bias(tape, f, gates.clone(), epsilon, reduction);
            let loss = tape.scale(loss, weight);
            assert_close(
                name,
                tape.value(loss),
                npz.values(&format!("loss_{name}_{place}")),
                1e-12,
            );
            let gradient = tape.backward(loss).get(f);
            assert_close(
                name,
                &gradient[..rays],
                npz.values(&format!("grad_f1_{name}_{place}")),
                1e-12,
            );
            assert!(
                gradient[rays..].iter().all(|&d| d == 0.0),
                "the second point is only compared"
            );
        }
    }
}

#[test]
fn six_tap_gradient() {
    let Some(npz) = golden::open("six_tap_gradient") else {
        return;
    };
    // The floor is the archive's own: no step lies below it.
    let range = 0.1;
    let deltas = npz.values("delta");
    let floor = deltas.iter().copied().fold(f64::INFINITY, f64::min);
    let steps: Vec<f64> = npz
        .values("u")
        .iter()
        .map(|&u| surface::tap_step(u, range, floor))
        .collect();
    assert_close("delta", &steps, deltas, 1e-14);
    let taps = surface::tap_points(6, &npz.vectors("x"), &steps);
    assert_close(
        "tap_points",
        taps.as_flattened(),
        npz.values("tap_points"),
        1e-14,
    );
    let tape = &mut Tape::default();
    let f = tape.parameter(taps.len(), 1, npz.values("tap_sdf").to_vec());
    let gradient = surface::tap_gradient(tape, 6, f, steps);
    assert_close(
        "gradient",
        tape.value(gradient),
        npz.values("gradient"),
        1e-12,
    );
    let eikonal = losses::eikonal(tape, gradient);
    assert_close("eikonal", tape.value(eikonal), npz.values("eikonal"), 1e-12);
}
