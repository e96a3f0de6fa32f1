//! How the products of a layer are computed, and which way of it is fastest on a device.

use super::layer::{Activation, Layer, LayerShape, MOST_HELD};
use super::params::{Group, Params, ParamsPlan};
use crate::Result;
use crate::gpu::{Buffer, DeviceKind, Gpu, Kernel, KernelShape, Matrices, Recorder};

/// How one product is computed: by cooperative matrices where it is wide, otherwise with so many channels per invocation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Form {
    matrices: Matrices,
    tile: u32,
}

/// Forms of `linear` and of `weight_gradient`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Forms {
    pub linear: Form,
    pub gradient: Form,
}

/// Inputs and outputs from which on cooperative matrices are worth their padding.
const WIDE: u32 = 32;

impl Form {
    const fn tiles(tile: u32) -> Form {
        Form {
            matrices: Matrices::Off,
            tile,
        }
    }

    fn by(self, matrices: Matrices) -> Form {
        Form { matrices, ..self }
    }

    /// Channels per invocation, so that no tile has more than the form says and all are about equal; what cooperative matrices take,
    /// [`Kernel::matrix_tile`] says.
    pub fn tile(&self, channels: u32) -> u32 {
        channels.div_ceil(channels.div_ceil(self.tile))
    }

    /// Whether a product of this size is computed by cooperative matrices.
    pub fn by_matrices(&self, size: [u32; 2]) -> bool {
        self.matrices.is_demanded() && size.iter().all(|&size| size >= WIDE)
    }

    /// The kernel of a product of this size.
    pub fn kernel<S: KernelShape>(
        &self,
        gpu: &Gpu,
        size: [u32; 2],
        shape: S,
    ) -> Result<Kernel<S::Args>> {
        match self.by_matrices(size) {
            true => gpu.matrix_kernel(shape, self.matrices == Matrices::Compensated),
            false => gpu.kernel(shape),
        }
    }
}

impl std::fmt::Display for Form {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.matrices.is_demanded() {
            true => f.write_str("matrices"),
            false => write!(f, "tiles of {}", self.tile),
        }
    }
}

impl Forms {
    /// What the device was opened for; where that is left to it, what it does fastest with a layer about as wide.
    pub fn of(gpu: &Gpu, width: u32) -> Result<Forms> {
        // What comes first is the usual.
        let mut linear = match width <= MOST_HELD {
            true => [16, 24, 8],
            false => [24, 16, 8],
        }
        .map(Form::tiles)
        .to_vec();
        let mut gradient = [32, 16].map(Form::tiles).to_vec();
        let usual = Forms {
            linear: linear[0],
            gradient: gradient[0],
        };
        let (wanted, info) = (gpu.options().matrices, gpu.info());
        if wanted.is_demanded() {
            return Ok(Forms {
                linear: usual.linear.by(wanted),
                gradient: usual.gradient.by(wanted),
            });
        }
        // Software devices imitate matrices, several times slower than what they do without.
        if wanted == Matrices::Auto && info.matrix.is_some() && info.kind != DeviceKind::Cpu {
            linear.push(usual.linear.by(Matrices::Compensated));
            gradient.push(usual.gradient.by(Matrices::Compensated));
        }
        // So many samples that a launch itself costs little beside them.
        let size = match gpu.info().kind {
            DeviceKind::Cpu if width <= MOST_HELD => (64, 1 << 13),
            DeviceKind::Cpu => (256, 1 << 11),
            _ => (256, 1 << 16),
        };
        let with_linear = |linear| Forms { linear, ..usual };
        let with_gradient = |gradient| Forms { gradient, ..usual };
        Ok(Forms {
            linear: Trial::fastest(
                gpu,
                size,
                "forward",
                &linear,
                with_linear,
                |t, layer, rec| layer.forward(rec, &t.params, t.x.ptr(), t.y.ptr_mut(), t.n),
            )?,
            gradient: Trial::fastest(
                gpu,
                size,
                "gradient",
                &gradient,
                with_gradient,
                |t, layer, rec| layer.gradient(rec, &t.params, t.x.ptr(), t.n, t.y.ptr(), t.n),
            )?,
        })
    }
}

/// The same layer in several forms.
struct Trial {
    layers: Vec<Layer>,
    params: Params,
    x: Buffer<f32>, // [width, n]
    y: Buffer<f32>, // [width, n]
    n: u32,
}

impl Trial {
    fn new(gpu: &Gpu, width: u32, n: u32, forms: &[Forms]) -> Result<Trial> {
        let mut plan = ParamsPlan::default();
        let rows = u64::from(width);
        let weights = vec![0.1; (rows * rows) as usize];
        let matrix = plan.add_plain(Group::Fields, "trial", rows, rows, weights);
        let layers = forms.iter().map(|&forms| {
            let shape = LayerShape {
                inputs: width,
                outputs: width,
                first_row: 0,
                activation: Activation::Relu,
                backward_inputs: 0,
                inputs_are_relu: false,
            };
            Layer::in_forms(gpu, "trial", shape, matrix, forms)
        });
        Ok(Trial {
            layers: layers.collect::<Result<_>>()?,
            params: plan.build(gpu, 0, true)?,
            x: gpu.buffer("trial x", rows * u64::from(n))?,
            y: gpu.buffer("trial y", rows * u64::from(n))?,
            n,
        })
    }

    /// The fastest way to compute a layer of that width, with so many samples.
    fn fastest(
        gpu: &Gpu,
        (width, n): (u32, u32),
        product: &str,
        ways: &[Form],
        forms: impl Fn(Form) -> Forms,
        run: impl Fn(&Trial, &Layer, &mut Recorder),
    ) -> Result<Form> {
        let names: Vec<String> = ways.iter().map(Form::to_string).collect();
        let all: Vec<Forms> = ways.iter().map(|&way| forms(way)).collect();
        let fastest = gpu.fastest(
            &format!("layer of {width} x {width}, {product}"),
            &names,
            || Trial::new(gpu, width, n, &all),
            |trial, way, rec| run(trial, &trial.layers[way], rec),
        )?;
        Ok(ways[fastest])
    }
}
