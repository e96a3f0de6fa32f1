//! The golden training steps of both stages: a batch of eight rays through the whole of the authors' model.

use crate::assert_close;
use crate::reference::batch::Stage;
use crate::reference::npz::Npz;
use crate::reference::{golden, sampling};

#[test]
fn whole_step_of_stage_1() {
    if let Some(npz) = golden::open("e2e_stage1") {
        check_whole_step(
            &npz,
            &Stage::first(),
            ("bias", "loss_back_pts_negative_loss"),
        );
    }
}

#[test]
fn whole_step_of_stage_2() {
    if let Some(npz) = golden::open("e2e_stage2") {
        let own_loss = ("tangent", "loss_tangent_normal_consistent_loss");
        check_whole_step(&npz, &golden::second_stage(&npz), own_loss);
    }
}

/// A whole stage on a small batch: samples, fields, image, losses, and the gradient of every parameter.
fn check_whole_step(npz: &Npz, stage: &Stage, own_loss: (&str, &str)) {
    let mut step = golden::whole_step(npz);
    step.stage = stage.clone();
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
        own_loss,
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
