//! Everything annealed, in closed form from the step index k.

/// Schedule A, the lower bound of 1/β in stage 1: 0.01 + 99.99 log2(1 + min(k, duration)/duration), duration 250 000.
pub fn inverse_scale_stage_1(k: f64, duration: f64) -> f64 {
    0.01 + 99.99 * (1.0 + k.min(duration) / duration).log2()
}

/// Schedule B, the same in stage 2: exponential to 500 at 200 000, on to 3000 at 300 000.
pub fn inverse_scale_stage_2(k: f64) -> f64 {
    if k < 200_000.0 {
        0.01 + 499.99 * (4.0 * k / 200_000.0).exp_m1() / 4.0_f64.exp_m1()
    } else {
        500.0 + 2500.0 * ((k - 200_000.0) / 100_000.0).min(1.0).exp_m1() / 1.0_f64.exp_m1()
    }
}

/// The bias loss's weight indoors: from 0.001 to 0.05 over `duration` = 10 000.
pub fn bias_ramp(k: f64, duration: f64) -> f64 {
    0.001 + 0.049 * (1.0 + k.min(duration) / duration).log2()
}

/// Exponent of the proposal weights: 10x/(9x + 1), x = min(k/10 000, 1).
pub fn proposal_anneal(k: f64, duration: f64) -> f64 {
    let x = (k / duration).min(1.0);
    10.0 * x / (9.0 * x + 1.0)
}

/// Linear warm-up, then a factor `gamma` past each milestone: at a milestone itself the old factor holds where `inclusive` is false.
pub fn multi_step(k: u64, warmup: u64, milestones: &[u64], gamma: f64, inclusive: bool) -> f64 {
    if k < warmup {
        return k as f64 / warmup as f64;
    }
    let past = milestones
        .iter()
        .filter(|&&milestone| {
            if inclusive {
                k >= milestone
            } else {
                k > milestone
            }
        })
        .count();
    gamma.powi(past as i32)
}

/// Fields and table: warm-up over 5000, tenths after 160 000 and 240 000.
pub fn fields_factor(k: u64) -> f64 {
    multi_step(k, 5000, &[160_000, 240_000], 0.1, false)
}

/// Proposal networks: 0.33 from 150 000, 225 000, 270 000 on.
pub fn proposal_factor(k: u64) -> f64 {
    multi_step(k, 0, &[150_000, 225_000, 270_000], 0.33, true)
}

/// The background's learning rate: log-linear from `start` to `end` over `duration`.
pub fn exponential(k: f64, start: f64, end: f64, duration: f64) -> f64 {
    let x = (k / duration).min(1.0);
    (start.ln() * (1.0 - x) + end.ln() * x).exp()
}
