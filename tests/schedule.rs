//! The schedules against the published implementation's own numbers.
//!
//! `schedules.npz` lies in the directory named by NEURODIN_GOLDEN (default ../shared/golden); where it is absent this says so and
//! passes.

use neurodin::config::Config;
use neurodin::train::schedule::Schedule;
use npyz::npz::NpzArchive;
use std::path::PathBuf;

/// One array of the archive, as f64 whatever it was saved as.
fn array(archive: &mut NpzArchive<std::io::BufReader<std::fs::File>>, name: &str) -> Vec<f64> {
    let file = archive
        .by_name(name)
        .expect("a readable archive")
        .unwrap_or_else(|| panic!("schedules.npz holds no '{name}'"));
    match file.dtype().descr().as_str() {
        "'<i8'" => file
            .into_vec::<i64>()
            .expect("integers")
            .into_iter()
            .map(|value| value as f64)
            .collect(),
        _ => file.into_vec().expect("floats"),
    }
}

#[test]
fn published_schedules() {
    let folder = std::env::var_os("NEURODIN_GOLDEN")
        .map_or_else(|| "../shared/golden".into(), PathBuf::from);
    let path = folder.join("schedules.npz");
    if !path.exists() {
        eprintln!(
            "skipped: {} is absent (set NEURODIN_GOLDEN)",
            path.display()
        );
        return;
    }
    let mut archive = NpzArchive::open(&path).expect("schedules.npz opens");
    let mut golden = |name: &str| array(&mut archive, name);
    let steps = golden("step");
    assert!(!steps.is_empty());

    let outdoor = Schedule::new(&Config::default());
    let indoor = Schedule::new(&Config::preset("indoor-large").unwrap());
    let config = Config::default();
    let rates = (
        config.optimizer.fields.learning_rate,
        config.optimizer.proposal.learning_rate,
    );
    for (name, ours) in [
        (
            "A_inv_s_lower",
            Box::new(|step| outdoor.at(step).inv_s_lower) as Box<dyn Fn(u64) -> f64>,
        ),
        (
            "bias_ramp_indoor",
            Box::new(|step| indoor.at(step).bias_weight),
        ),
        ("proposal_anneal", Box::new(|step| outdoor.at(step).anneal)),
        (
            "lr_mult_fields",
            Box::new(|step| outdoor.at(step).lr_fields / rates.0),
        ),
        (
            "lr_mult_proposals",
            Box::new(|step| outdoor.at(step).lr_proposal / rates.1),
        ),
        (
            "lr_background",
            Box::new(|step| outdoor.at(step).lr_background),
        ),
    ] {
        for (step, theirs) in steps.iter().zip(golden(name)) {
            let ours = ours(*step as u64);
            assert!(
                (ours - theirs).abs() <= 1e-10 * theirs.abs().max(1e-3),
                "{name} at step {step}: {ours} here, {theirs} published"
            );
        }
    }
}
