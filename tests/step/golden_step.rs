//! The golden training step of the authors' own model, through the device.
//!
//! Two differences of definition are left aside by giving the twin what the device has: the authors' grid scales are in double
//! precision there, and their background is a fixed colour, here the learned one at that colour.

use crate::reference::background::Background;
use crate::reference::batch::{Stage, Step};
use crate::reference::golden;
use crate::reference::npz::Npz;
use crate::reference::tape::ReluEdge;
use crate::rig::{GradientRange, Rig, agreement};
use neurodin::Result;
use neurodin::config::{BiasReduction, Config};
use neurodin::gpu::GpuOptions;
use neurodin::scene::RegionShape;
use neurodin::train::schedule::Schedule;

#[test]
fn published_step() -> Result<()> {
    match golden::open("e2e_stage1") {
        Some(npz) => check(&npz, Config::preset("outdoor-tiny")?, Stage::first()),
        None => Ok(()),
    }
}

#[test]
fn published_step_of_stage_2() -> Result<()> {
    let Some(npz) = golden::open("e2e_stage2") else {
        return Ok(());
    };
    let second = Config::preset("outdoor-tiny")?.second_stage();
    let config = Config {
        first_step: 0,
        ..second.expect("a preset with two stages")
    };
    check(&npz, config, golden::second_stage(&npz))
}

fn check(npz: &Npz, mut config: Config, stage: Stage) -> Result<()> {
    let published = golden::whole_step(npz);
    config.rays = published.rays.origins.len() as u32;
    config.loss.bias.reduction = BiasReduction::Published;
    config.loss.color_squared = 0.0; // as published
    let rig = Rig::new(config, RegionShape::Sphere, GpuOptions::default())?;
    assert_eq!(rig.twin.samples, published.config.samples);
    assert_eq!(rig.twin.proposal_samples, published.config.proposal_samples);

    let mut params = published.params.clone();
    let Background::Fixed(color) = published.config.background else {
        panic!("a fixed background");
    };
    let logits = color.iter().map(|c| (c / (1.0 - c)).ln()).collect();
    params.insert("background.constant".into(), logits);
    rig.upload_parameters(&mut params)?;
    let rays = rig.upload_rays(&published.rays)?;
    let (draws, stage) = rig.upload_draws(&published.draws, &stage)?;
    let now = neurodin::train::schedule::Now {
        anneal: published.now.anneal,
        inv_s_lower: published.now.inv_s_lower,
        bias_weight: match stage.bias {
            true => published.now.bias_weight,
            false => 0.0,
        },
        ..Schedule::new(&rig.config).at(0)
    };
    rig.gpu.submit("golden step", |rec| {
        rig.trainer.gradients(rec, &now);
        Ok(())
    })?;
    let gradients = rig.download_spans(rig.trainer.model().params.grads())?;

    let twin = Step {
        config: rig.twin.clone(),
        params,
        rays,
        draws,
        now: published.now,
        edges: Some(rig.edges()?),
        points: Some(rig.points()?),
        stage,
        relu_edge: ReluEdge::default(),
    };
    // These tables are rough: a cell turns g by much more than it is long, and where a ray grazes, g·d is a small difference of large
    // numbers, that float32 knows to three digits.
    let tolerance = match twin.stage.tangent {
        None => 1e-4,
        Some(_) => 1e-3,
    };
    let twin = GradientRange::of(&twin);
    for (span, gradient) in &gradients {
        twin.check(span, gradient, tolerance);
    }
    for (span, array) in golden::small_spans() {
        let (distance, cosine) = agreement(&gradients[&span], npz.values(&format!("grad_{array}")));
        println!(
            "{span}: against the authors: relative L2 {distance:.1e}, 1 - cosine {:.1e}",
            1.0 - cosine
        );
        assert!(
            distance <= 2e-3 && cosine >= 0.99999,
            "{span}: relative L2 {distance:.2e}, cosine {cosine}"
        );
    }
    for (span, array) in golden::table_spans() {
        let indices = npz.values(&format!("gradidx_{array}"));
        let some: Vec<f64> = indices
            .iter()
            .map(|&i| gradients[&span][i as usize])
            .collect();
        let (distance, cosine) = agreement(&some, npz.values(&format!("gradval_{array}")));
        println!(
            "{span}: against the authors: relative L2 {distance:.1e}, 1 - cosine {:.1e}",
            1.0 - cosine
        );
        assert!(
            distance <= 2e-3 && cosine >= 0.99999,
            "{span}: relative L2 {distance:.2e}, cosine {cosine}"
        );
    }
    rig.check_device()
}
