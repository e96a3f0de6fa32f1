//! How the products of a layer are computed, and which way of it is fastest on a device.

use super::layer::{Activation, Layer, LayerShape, MOST_HELD};
use super::params::{Group, Params, ParamsPlan};
use super::planes::Activations;
use crate::Result;
use crate::gpu::{DeviceKind, Gpu, Kernel, KernelShape, Matrices, Recorder};

/// How one product is computed: by cooperative matrices where it is wide, otherwise with so many channels per invocation, in one of the
/// ways that the kernels know.
#[derive(Clone, Copy, Debug)]
pub(super) struct Form {
    matrices: Matrices,
    tile: u32,
    /// Straight-line code, where it is narrow.
    straight: bool,
    /// Outputs per invocation of a weight gradient whose lanes are samples; 0 where they are outputs.
    rows: u32,
}

/// Forms of `linear` and of `weight_gradient`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Forms {
    pub linear: Form,
    pub gradient: Form,
}

/// Inputs and outputs from which on cooperative matrices are worth their padding.
const WIDE: u32 = 32;

/// Channels of one part, where no part has more than `most` and all are about equal.
fn equal_parts(channels: u32, most: u32) -> u32 {
    channels.div_ceil(channels.div_ceil(most))
}

impl Form {
    const fn tiles(tile: u32) -> Form {
        Form {
            matrices: Matrices::Off,
            tile,
            straight: false,
            rows: 0,
        }
    }

    /// For devices that are slow in loops (lib/straight.glsl).
    const fn straight(tile: u32) -> Form {
        Form {
            straight: true,
            ..Form::tiles(tile)
        }
    }

    /// For devices to which each load is dear, though all lanes want the same.
    const fn by_samples(rows: u32, tile: u32) -> Form {
        Form {
            rows,
            ..Form::tiles(tile)
        }
    }

    fn by(self, matrices: Matrices) -> Form {
        Form { matrices, ..self }
    }

    /// Outputs per invocation of a weight gradient whose lanes are samples.
    pub fn rows(&self, outputs: u32) -> Option<u32> {
        (self.rows > 0).then(|| equal_parts(outputs, self.rows))
    }

    /// Channels per invocation; what cooperative matrices take, [`Kernel::matrix_tile`] says.
    pub fn tile(&self, channels: u32) -> u32 {
        equal_parts(channels, self.tile)
    }

    /// Whether a product of this size is computed by cooperative matrices.
    pub fn by_matrices(&self, size: [u32; 2]) -> bool {
        self.matrices.is_demanded() && size.iter().all(|&size| size >= WIDE)
    }

    /// Whether a product of this size is computed by straight-line code.
    pub fn is_straight(&self, size: [u32; 2]) -> bool {
        self.straight && size.iter().all(|&size| size <= MOST_HELD)
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
            false if self.rows > 0 => write!(f, "samples, {} x {}", self.rows, self.tile),
            false if self.straight => write!(f, "straight tiles of {}", self.tile),
            false => write!(f, "tiles of {}", self.tile),
        }
    }
}

impl Forms {
    /// What the device was opened for; where that is left to it, what it does fastest with a layer about as wide.
    pub fn of(gpu: &Gpu, width: u32) -> Result<Forms> {
        let [linear, gradient] = ways(gpu, width);
        let usual = Forms {
            linear: linear[0],
            gradient: gradient[0],
        };
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
                |t, layer, rec| layer.forward(rec, &t.params, t.x.read(), t.y.write(), t.n),
            )?,
            gradient: Trial::fastest(
                gpu,
                size,
                "gradient",
                &gradient,
                with_gradient,
                |t, layer, rec| layer.gradient(rec, &t.params, t.x.read(), t.y.read(), t.n),
            )?,
        })
    }
}

/// Forms of `linear` and of `weight_gradient` that may be the fastest on this device; the usual one comes first.
fn ways(gpu: &Gpu, width: u32) -> [Vec<Form>; 2] {
    let narrow = width <= MOST_HELD;
    let (wanted, info) = (gpu.options().matrices, gpu.info());
    // Narrow layers of a software device are held, and differ little by their tiles, of which each takes seconds to compile.
    let linear: &[u32] = match (narrow, info.few_cores) {
        (true, true) => &[16],
        (true, false) => &[16, 24, 8],
        (false, _) => &[24, 16, 8],
    };
    let mut linear: Vec<Form> = linear.iter().copied().map(Form::tiles).collect();
    let mut gradient = [32, 16].map(Form::tiles).to_vec();
    if wanted.is_demanded() {
        return [linear, gradient].map(|ways| vec![ways[0].by(wanted)]);
    }
    if info.few_cores && narrow {
        linear.push(Form::straight(linear[0].tile));
    }
    gradient.push(match info.few_cores {
        true => Form::by_samples(16, 32),
        false => Form::by_samples(8, 8),
    });
    // Software devices imitate matrices, several times slower than what they do without.
    if wanted == Matrices::Auto && info.matrix.is_some() && info.kind != DeviceKind::Cpu {
        linear.push(linear[0].by(Matrices::Compensated));
        gradient.push(gradient[0].by(Matrices::Compensated));
    }
    [linear, gradient]
}

/// Names of the ways from which the fastest is chosen for layers about as wide, as [`GpuOptions::ways`](crate::gpu::GpuOptions) takes them.
pub fn layer_ways(gpu: &Gpu, width: u32) -> Vec<String> {
    let ways = ways(gpu, width).concat();
    ways.iter().map(Form::to_string).collect()
}

/// The same layer in several forms.
struct Trial {
    layers: Vec<Layer>,
    params: Params,
    x: Activations, // [width, n]
    y: Activations, // [width, n]
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
            x: Activations::new(gpu, "trial x", width, n)?,
            y: Activations::new(gpu, "trial y", width, n)?,
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
