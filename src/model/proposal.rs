//! A proposal network: a small density field that says where along a ray samples are worth taking (Barron et al. 2022, Mip-NeRF 360).

use super::field::{Field, FieldBuffers, FieldShape, Scratch};
use super::hash_grid::HashGrid;
use super::params::{Draws, Group, Init, Params, ParamsPlan};
use crate::Result;
use crate::config::Config;
use crate::gpu::{Buffer, Gpu, Recorder};

/// One proposal level: its network and, for `n_samples` per ray, its samples.
pub struct Proposal {
    field: Field,
    pub n_samples: u32,
}

/// A proposal level's samples for a batch of rays.
pub struct ProposalBuffers {
    pub field: FieldBuffers,
    pub edges: Buffer<f32>,         // [n_rays, n_samples + 1] normalised s
    pub points: Buffer<f32>,        // [3, n] bin midpoints
    pub raw: Buffer<f32>,           // [n] log density
    pub d_raw: Buffer<f32>,         // [n]
    pub weights: Buffer<f32>,       // [n_rays, n_samples]
    pub transmittance: Buffer<f32>, // [n] scratch of the interlevel loss
}

impl Proposal {
    /// The shape of level 0 or 1.
    pub fn field_shape(config: &Config, level: usize) -> FieldShape {
        let s = &config.sampling;
        let grid = HashGrid {
            levels: s.proposal_levels,
            base: s.proposal_base,
            max: s.proposal_max[level],
            log2_size: s.proposal_log2_size,
            features: s.proposal_features,
        };
        FieldShape {
            grid,
            hidden: s.proposal_hidden,
            coordinates: false,
            softplus: false,
            gradient: false,
            kept: 0,
            half: false,
        }
    }

    /// Adds the parameters of level 0 or 1 and builds its kernels.
    pub fn new(
        gpu: &Gpu,
        config: &Config,
        plan: &mut ParamsPlan,
        level: usize,
    ) -> Result<Proposal> {
        let shape = Self::field_shape(config, level);
        let name = format!("proposal.{level}");
        let mut draws = Draws::new(config.seed, &name);
        let mut matrix = |rows: u32, columns: u32| -> Vec<f32> {
            let bound = 1.0 / f64::from(columns).sqrt();
            (0..rows * columns)
                .map(|_| draws.symmetric(bound))
                .collect()
        };
        let (hidden, inputs) = (shape.hidden, shape.inputs());
        let table = plan.add(
            Group::Proposal,
            format!("{name}.table"),
            &[shape.grid.entries(), u64::from(shape.grid.features)],
            Init::Uniform { half_range: 1e-4 },
        );
        let hidden_weight = matrix(hidden, inputs);
        let hidden_handle = plan.add_plain(
            Group::Proposal,
            &format!("{name}.hidden"),
            u64::from(hidden),
            u64::from(inputs),
            hidden_weight,
        );
        let out_weight = matrix(1, hidden);
        let out_handle = plan.add_plain(
            Group::Proposal,
            &format!("{name}.out"),
            1,
            u64::from(hidden),
            out_weight,
        );
        Ok(Proposal {
            field: Field::new(gpu, &name, shape, table, hidden_handle, out_handle)?,
            n_samples: config.sampling.proposal_samples[level],
        })
    }

    /// Buffers for a batch of rays.
    pub fn buffers(&self, gpu: &Gpu, level: usize, n_rays: u32) -> Result<ProposalBuffers> {
        let n = n_rays * self.n_samples;
        let name = |what: &str| format!("proposal {level} {what}");
        Ok(ProposalBuffers {
            field: FieldBuffers::new(gpu, &format!("proposal {level}"), &self.field.shape, n, 0)?,
            edges: gpu.scratch(
                &name("edges"),
                u64::from(n_rays) * u64::from(self.n_samples + 1),
            )?,
            points: gpu.scratch(&name("points"), 3 * u64::from(n))?,
            raw: gpu.scratch(&name("raw"), u64::from(n))?,
            d_raw: gpu.scratch(&name("d_raw"), u64::from(n))?,
            weights: gpu.scratch(&name("weights"), u64::from(n))?,
            transmittance: gpu.scratch(&name("transmittance"), u64::from(n))?,
        })
    }

    /// Log density at the bin midpoints.
    pub fn forward(&self, rec: &mut Recorder, params: &Params, b: &ProposalBuffers) {
        self.field
            .forward(rec, params, b.points.ptr(), &b.field, b.raw.ptr_mut());
    }

    /// Adds all gradients, from `b.d_raw`.
    pub fn backward(
        &self,
        rec: &mut Recorder,
        params: &Params,
        b: &ProposalBuffers,
        scratch: &Scratch,
    ) {
        self.field.backward(
            rec,
            params,
            b.points.ptr(),
            b.d_raw.ptr(),
            &b.field,
            scratch,
            None,
        );
    }
}
