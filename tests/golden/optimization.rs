//! Golden vectors of the optimisers and of everything annealed.

use crate::assert_close;
use crate::reference::optimizer::Adam;
use crate::reference::{golden, schedule};

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
