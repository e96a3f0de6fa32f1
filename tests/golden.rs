//! The f64 twin against the golden vectors: arrays computed with the authors' own code.
//!
//! The vectors lie in the directory that `NEURODIN_GOLDEN` names, else in `../shared/golden` beside the crate; where they are absent,
//! each test says so and passes. Every shape and number is read from the archives.

mod reference;

use reference::hash_grid::Grid;
use reference::losses::BiasReduction;
use reference::networks::{self, NormedLayer};
use reference::npz::Npz;
use reference::optimizer::Adam;
use reference::sampling::{self, Stretch};
use reference::tape::{Tape, Var};
use reference::{golden, losses, schedule, surface, volume};

/// |ours − theirs| ≤ relative · max|theirs|, element by element against the largest.
#[track_caller]
fn assert_close(what: &str, ours: &[f64], theirs: &[f64], relative: f64) {
    assert_eq!(ours.len(), theirs.len(), "{what}: lengths");
    let largest = theirs
        .iter()
        .fold(f64::MIN_POSITIVE, |largest, x| x.abs().max(largest));
    for (i, (a, b)) in ours.iter().zip(theirs).enumerate() {
        let error = (a - b).abs();
        assert!(
            error <= relative * largest,
            "{what}[{i}] = {a}, golden {b}: off by {error:.2e}, largest {largest:.2e}"
        );
    }
}

/// The array as a matrix on the tape whose gradient is wanted.
fn parameter(tape: &mut Tape, npz: &Npz, array: &str) -> Var {
    let (shape, values) = (npz.shape(array), npz.values(array).to_vec());
    let cols = shape.last().copied().unwrap_or(1);
    tape.parameter(values.len() / cols, cols, values)
}

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
    for (inv_s, d_v) in npz.values("inv_s").iter().zip(gradient) {
        assert_eq!(
            *inv_s < lower,
            d_v == 0.0,
            "no gradient exactly where the bound holds (1/β = {inv_s})"
        );
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
    for ray in 0..rays {
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
        let depth = volume::expected_depth(&row[..samples], &middles[ray]).clamp(first, last);
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

/// Puts the layers `{prefix}{0..}` of an archive on the tape, and gives them back with their arrays' names.
fn layers(tape: &mut Tape, npz: &Npz, prefix: &str) -> (Vec<NormedLayer>, Vec<(String, Var)>) {
    let (mut layers, mut named) = (Vec::new(), Vec::new());
    while npz
        .find(&format!("{prefix}{}_bias", layers.len()))
        .is_some()
    {
        let mut put = |part: &str| {
            let array = format!("{prefix}{}_{part}", layers.len());
            let var = parameter(tape, npz, &array);
            named.push((array, var));
            var
        };
        layers.push(NormedLayer {
            v: put("weight_v"),
            g: put("weight_g"),
            bias: put("bias"),
        });
    }
    assert!(layers.len() >= 2);
    (layers, named)
}

fn check_network(
    archive: &str,
    prefix: &str,
    network: impl Fn(&mut Tape, &[NormedLayer], Var) -> Var,
) {
    let Some(npz) = golden::open(archive) else {
        return;
    };
    let tape = &mut Tape::default();
    let x = parameter(tape, &npz, "x");
    let (layers, named) = layers(tape, &npz, prefix);
    let y = network(tape, &layers, x);
    assert_close("y", tape.value(y), npz.values("y"), 1e-12);
    let gradients = tape.backward_with(y, npz.values("cotangent"));
    assert_close("grad_x", &gradients.get(x), npz.values("grad_x"), 1e-11);
    for (array, var) in named {
        assert_close(
            &array,
            &gradients.get(var),
            npz.values(&format!("grad_{array}")),
            1e-11,
        );
    }
}

#[test]
fn geometry_net() {
    check_network("geometry_net", "glin", |tape, layers, x| {
        networks::geometry_network(tape, layers[0], layers[1], x)
    });
}

#[test]
fn color_net() {
    check_network("color_net", "clin", networks::color_network);
}

#[test]
fn direction_encoding() {
    let Some(npz) = golden::open("direction_encoding") else {
        return;
    };
    let ours: Vec<f64> = npz
        .vectors("d")
        .into_iter()
        .flat_map(networks::direction_encoding)
        .collect();
    assert_close("encoding", &ours, npz.values("encoding"), 1e-13);
}

/// One hash-grid archive: level table, indices, weights, encoding, first and second derivatives.
fn check_hash_grid(archive: &str, base: u32, max: u32, log2_size: u32) {
    let Some(npz) = golden::open(archive) else {
        return;
    };
    let levels = npz.values("scale").len();
    let [points, width] = *npz.shape("encoding") else {
        panic!("encoding is points x features")
    };
    let grid = Grid::exact(levels, base, max, log2_size, width / levels);
    let ours = |f: &dyn Fn(&reference::hash_grid::Level) -> f64| -> Vec<f64> {
        grid.levels.iter().map(f).collect()
    };
    assert_close(
        "scale",
        &ours(&|level| level.scale),
        npz.values("scale"),
        1e-14,
    );
    assert_eq!(
        ours(&|level| f64::from(level.resolution)),
        npz.values("resolution")
    );
    assert_eq!(
        ours(&|level| f64::from(level.entries)),
        npz.values("entries")
    );
    assert_eq!(
        ours(&|level| f64::from(u8::from(level.dense))),
        npz.values("dense")
    );
    assert_eq!(
        ours(&|level| level.offset as f64),
        npz.values("offset")[..levels]
    );
    assert_eq!(grid.entries() as f64, npz.values("offset")[levels]);

    let table = golden::table(grid.parameters(), 1.0);
    let u: Vec<[f64; 3]> = npz
        .vectors("x")
        .iter()
        .map(|x| x.map(|x| (x + 1.0) / 2.0))
        .collect();
    let rows = npz.shape("index")[0];
    let cells: Vec<_> = u[..rows]
        .iter()
        .flat_map(|&u| grid.levels.iter().map(move |level| level.cell(u)))
        .collect();
    let index: Vec<f64> = cells
        .iter()
        .flat_map(|cell| cell.index.map(f64::from))
        .collect();
    assert_eq!(index, npz.values("index"));
    let weight: Vec<f64> = cells.iter().flat_map(|cell| cell.weight).collect();
    assert_close("weight", &weight, npz.values("weight"), 1e-7); // stored as f32

    let (mut encoding, mut d_u, mut d2_u) = (Vec::new(), Vec::new(), Vec::new());
    let mut d_table = vec![0.0; grid.parameters()];
    let mut d2_table = vec![0.0; grid.parameters()];
    let cotangents = npz.values("cotangent").chunks_exact(width);
    for ((&u, cotangent), h) in u.iter().zip(cotangents).zip(npz.vectors("cotangent2")) {
        encoding.extend(grid.encode(&table, u));
        d_u.extend(grid.point_gradient(&table, u, cotangent));
        d2_u.extend(grid.point_gradient_of_slope(&table, u, cotangent, h));
        grid.add_table_gradient(u, cotangent, &mut d_table);
        grid.add_table_gradient_of_slope(u, cotangent, h, &mut d2_table);
    }
    assert_eq!(u.len(), points);
    // A scale that is rounded otherwise in its last place moves a fine level's weights by 1e-12.
    assert_close("encoding", &encoding, npz.values("encoding"), 1e-10);
    assert_close("grad_u", &d_u, npz.values("grad_u"), 1e-10);
    assert_close("grad2_u", &d2_u, npz.values("grad2_u"), 1e-10);
    for (name, gradient) in [("gt", &d_table), ("gt2", &d2_table)] {
        let some: Vec<f64> = npz
            .values(&format!("{name}_index"))
            .iter()
            .map(|&i| gradient[i as usize])
            .collect();
        assert_close(name, &some, npz.values(&format!("{name}_value")), 1e-10);
    }
    let sum: f64 = d_table.iter().map(|d| d.abs()).sum();
    assert_close("gt_abs_sum", &[sum], npz.values("gt_abs_sum"), 1e-10);
}

#[test]
fn hash_grid_of_the_surface() {
    check_hash_grid("hash_sdf_shipped", 32, 2048, 19);
}

#[test]
fn hash_grids_of_the_proposals() {
    check_hash_grid("hash_prop0", 16, 64, 17);
    check_hash_grid("hash_prop1", 16, 256, 17);
}

#[test]
fn hash_grid_of_the_background() {
    check_hash_grid("hash_background", 16, 1024, 19);
}

#[test]
fn hash_grids_for_a_cpu() {
    check_hash_grid("hash_cpu", 16, 1024, 17);
    check_hash_grid("hash_cpu512", 16, 512, 17);
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
    let taps = surface::tap_points(&npz.vectors("x"), &steps);
    assert_close(
        "tap_points",
        taps.as_flattened(),
        npz.values("tap_points"),
        1e-14,
    );
    let tape = &mut Tape::default();
    let f = tape.parameter(taps.len(), 1, npz.values("tap_sdf").to_vec());
    let gradient = surface::six_tap_gradient(tape, f, steps);
    assert_close(
        "gradient",
        tape.value(gradient),
        npz.values("gradient"),
        1e-12,
    );
    let eikonal = losses::eikonal(tape, gradient);
    assert_close("eikonal", tape.value(eikonal), npz.values("eikonal"), 1e-12);
}

#[test]
fn optimizers() {
    for archive in ["optim_adamw", "optim_adam"] {
        let Some(npz) = golden::open(archive) else {
            return;
        };
        let mut params = npz.values("p0").to_vec();
        let [beta1, beta2] = *npz.values("betas") else {
            panic!("two betas")
        };
        let mut adam = Adam::new(
            params.len(),
            [beta1, beta2],
            npz.scalar("eps"),
            npz.scalar("weight_decay"),
        );
        for (step, &rate) in npz.values("lr").iter().enumerate() {
            let row = step * params.len()..(step + 1) * params.len();
            adam.update(&mut params, &npz.values("grads")[row.clone()], rate);
            assert_close(archive, &params, &npz.values("params")[row], 1e-12);
        }
    }
}

#[test]
fn schedules() {
    let Some(npz) = golden::open("schedules") else {
        return;
    };
    let steps = npz.values("step");
    let check = |array: &str, at: &dyn Fn(f64) -> f64| {
        for (i, &k) in steps.iter().enumerate() {
            assert_close(
                &format!("{array} at {k}"),
                &[at(k)],
                &npz.values(array)[i..=i],
                1e-11,
            );
        }
    };
    check("A_inv_s_lower", &|k| {
        schedule::inverse_scale_stage_1(k, 250_000.0)
    });
    check("B_inv_s_lower", &schedule::inverse_scale_stage_2);
    check("bias_ramp_indoor", &|k| schedule::bias_ramp(k, 10_000.0));
    check("proposal_anneal", &|k| {
        schedule::proposal_anneal(k, 10_000.0)
    });
    check("lr_mult_fields", &|k| schedule::fields_factor(k as u64));
    check("lr_mult_proposals", &|k| {
        schedule::proposal_factor(k as u64)
    });
    check("lr_background", &|k| {
        schedule::exponential(k, 1e-2, 1e-4, 300_000.0)
    });
}

/// The whole of stage 1 on a small batch: samples, fields, image, losses, and the gradient of every parameter.
#[test]
fn whole_step() {
    let Some(npz) = golden::open("e2e_stage1") else {
        return;
    };
    let step = golden::whole_step(&npz);
    let outcome = step.run();
    let images = &outcome.images;
    let samples = step.config.samples;

    for level in 0..3 {
        assert_close(
            "edges_s",
            &images.edges[level],
            npz.values(&format!("edges_s{level}")),
            1e-11,
        );
        assert_close(
            "edges_t",
            &images.distances[level],
            npz.values(&format!("edges_t{level}")),
            1e-11,
        );
    }
    let outside: Vec<bool> = (0..npz.values("sdf").len())
        .map(|i| images.stretches[i / samples].outside)
        .collect();
    let sdf: Vec<f64> = images
        .sdf
        .iter()
        .zip(&outside)
        .map(|(&f, &outside)| if outside { 1000.0 } else { f })
        .collect();
    for ((ours, theirs), outside) in sdf.iter().zip(npz.values("sdf")).zip(&outside) {
        assert!(
            (ours - theirs).abs() < 1e-10 && *outside == (*theirs == 1000.0),
            "sdf {ours}, golden {theirs}"
        );
    }
    assert_close("gradient", &images.gradient, npz.values("gradient"), 1e-10);
    assert_close("inv_s", &images.inv_s, npz.values("inv_s"), 1e-11);
    assert_close("density", &images.density, npz.values("density"), 1e-10);
    let padded: Vec<f64> = images.rgb.iter().map(|rgb| 1.002 * rgb - 0.001).collect();
    assert_close("sample_rgb", &padded, npz.values("sample_rgb"), 1e-10);
    assert_close("weights", &images.weights, npz.values("weights"), 1e-10);
    assert_close(
        "accumulation",
        &images.accumulation,
        npz.values("accumulation"),
        1e-10,
    );
    assert_close("normal", &images.normal, npz.values("normal"), 1e-10);
    assert_close("rgb", &images.color, npz.values("rgb"), 1e-10);
    let middles: Vec<f64> = images.distances[2]
        .chunks_exact(samples + 1)
        .flat_map(sampling::midpoints)
        .collect();
    let first = middles.iter().copied().fold(f64::INFINITY, f64::min);
    let last = middles.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let depth: Vec<f64> = images
        .depth
        .iter()
        .map(|depth| depth.clamp(first, last))
        .collect();
    assert_close("depth", &depth, npz.values("depth"), 1e-10);

    let names = [
        ("color", "loss_rgb_loss"),
        ("eikonal", "loss_eikonal_loss"),
        ("interlevel", "loss_interlevel_loss"),
        ("bias", "loss_back_pts_negative_loss"),
        ("total", "loss_total"),
    ];
    for (ours, theirs) in names {
        assert_close(ours, &[outcome.losses[ours]], npz.values(theirs), 1e-10);
    }

    for (ours, theirs) in golden::small_spans() {
        assert_close(
            &ours,
            &outcome.gradients[&ours],
            npz.values(&format!("grad_{theirs}")),
            1e-9,
        );
    }
    for (ours, theirs) in golden::table_spans() {
        let gradient = &outcome.gradients[&ours];
        let some: Vec<f64> = npz
            .values(&format!("gradidx_{theirs}"))
            .iter()
            .map(|&i| gradient[i as usize])
            .collect();
        assert_close(&ours, &some, npz.values(&format!("gradval_{theirs}")), 1e-9);
        let sum: f64 = gradient.iter().map(|d| d.abs()).sum();
        assert_close(
            &ours,
            &[sum],
            npz.values(&format!("gradabs_{theirs}")),
            1e-9,
        );
        // An entry whose gradient cancels may be 0 on one side and 1e-20 on the other.
        let touched = gradient.iter().filter(|&&d| d != 0.0).count() as f64;
        assert_close(
            &ours,
            &[touched],
            npz.values(&format!("gradnnz_{theirs}")),
            1e-3,
        );
    }
}
