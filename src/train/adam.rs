//! AdamW over the parameter block, one launch per group: the groups differ in learning rate and weight decay. The surface's hash table,
//! of which a step needs little, is updated where it is needed.

use super::schedule::Now;
use crate::Result;
use crate::config::{Config, OptimizerConfig};
use crate::gpu::{Buffer, Gpu, Kernel, Recorder, Work};
use crate::kernels::adam;
use crate::model::{Group, Model, Rates};

/// The optimiser of all parameter groups.
pub struct Adam {
    config: OptimizerConfig,
    /// Pairs of parameters of an invocation.
    turns: u64,
    kernel: Kernel<adam::Args>,
    /// For a table that has a copy in float16.
    with_copy: Kernel<adam::Args>,
}

impl Adam {
    /// The optimiser of a configuration.
    pub fn new(gpu: &Gpu, config: &Config) -> Result<Adam> {
        let turns = if gpu.info().few_cores { 32 } else { 1 };
        Ok(Adam {
            turns: turns.into(),
            config: config.optimizer.clone(),
            kernel: gpu.kernel(adam::Shape { half: 0, turns })?,
            with_copy: gpu.kernel(adam::Shape { half: 1, turns })?,
        })
    }

    /// One update of every parameter with the rates of `now`; gradients are consumed. `now.step` counts from 0.
    pub fn update(&self, rec: &mut Recorder, model: &Model, now: &Now, bad_step: &Buffer<u32>) {
        let (c, params) = (&self.config, &model.params);
        let t = (now.step + 1) as f64;
        let groups = [
            (Group::Fields, now.lr_fields, c.fields.weight_decay),
            (Group::Table, now.lr_table, c.table.weight_decay),
            (Group::Proposal, now.lr_proposal, c.proposal.weight_decay),
            (
                Group::Background,
                now.lr_background,
                c.background.weight_decay,
            ),
        ];
        for (group, learning_rate, weight_decay) in groups {
            let rates = Rates {
                rate: (learning_rate / (1.0 - c.beta1.powf(t))) as f32,
                decay: (learning_rate * weight_decay) as f32,
                correction: (1.0 - c.beta2.powf(t)).sqrt() as f32,
            };
            let Some(mut range) = params.group(group) else {
                continue;
            };
            if let (Group::Table, Some(table)) = (group, &model.table) {
                table.update(rec, params, &rates, now.step, bad_step);
                range.end = table.first();
            }
            let n = range.end - range.start;
            let args = adam::Args {
                params: params.values().at_mut(range.start),
                halves: params.copy_of(range.start),
                grads: params.d_value(range.start),
                first_moment: params.first_moment().at_mut(range.start),
                second_moment: params.second_moment().at_mut(range.start),
                bad_step: bad_step.ptr(),
                n: n as u32,
                rate: rates.rate,
                decay: rates.decay,
                correction: rates.correction,
                one_minus_beta1: (1.0 - c.beta1) as f32,
                one_minus_beta2: (1.0 - c.beta2) as f32,
                epsilon: c.epsilon as f32,
            };
            let kernel = match args.halves.address() {
                0 => &self.kernel,
                _ => &self.with_copy,
            };
            let work = Work::items(n.div_ceil(2)).turns(self.turns);
            let work = work.flops(30.0).bytes(64.0);
            rec.run(kernel, work, args);
        }
    }
}
