//! Appearance codes: a learned vector for each training view, and after them a row for evaluation that nothing trains.

use super::params::{Draws, Group, Init, Params, ParamsPlan};
use crate::Result;
use crate::gpu::Gpu;

/// Adds the span `name`, `[views + 1, dims]`: N(0, 1), the last row zero as published. Returns its element offset.
pub(super) fn add_codes(
    plan: &mut ParamsPlan,
    group: Group,
    name: &str,
    seed: u32,
    views: u32,
    dims: u32,
) -> u64 {
    let mut draws = Draws::new(seed, name);
    let mut codes: Vec<f32> = (0..views * dims).map(|_| draws.normal(0.0, 1.0)).collect();
    codes.resize(((views + 1) * dims) as usize, 0.0);
    let shape = [u64::from(views) + 1, u64::from(dims)];
    plan.add(group, name, &shape, Init::Values(codes))
}

/// Sets the row for evaluation in every span of codes: zero, or with `mean` the mean of the views' codes.
pub(super) fn set_evaluation_code(gpu: &Gpu, params: &Params, mean: bool) -> Result<()> {
    let spans = params.spans().iter();
    for span in spans.filter(|span| span.name.ends_with("appearance") && !span.is_empty()) {
        let (views, dims) = (span.shape[0] - 1, span.shape[1]);
        let mut code = vec![0.0; dims as usize];
        if mean {
            let codes = gpu.download(params.values(), span.first, views * dims)?;
            for own in codes.chunks(dims as usize) {
                for (sum, value) in code.iter_mut().zip(own) {
                    *sum += value / views as f32;
                }
            }
        }
        gpu.upload(params.values(), span.first + views * dims, &code)?;
    }
    Ok(())
}
