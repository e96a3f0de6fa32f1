//! A layer's three products against float64, in each way in which a device may multiply matrices.

use crate::harness::Random;
use neurodin::gpu::{Buffer, Gpu, GpuOptions, Matrices};
use neurodin::model::{
    Activation, Group, Init, Layer, LayerShape, ParamsPlan, Planes, WeightHandle, layer_ways,
};
use neurodin::{Error, Result};
use std::collections::BTreeSet;
use std::sync::OnceLock;

/// (inputs, outputs, samples): narrow, odd in every direction, blocks whose weights leave lanes over, fewer samples than lanes, and several
/// tiles of everything.
const SIZES: [(usize, usize, usize); 7] = [
    (5, 3, 70),
    (70, 37, 333),
    (45, 35, 70),
    (64, 33, 3),
    (130, 40, 7),
    (64, 64, 64),
    (256, 258, 1100),
];

struct Case {
    inputs: usize,
    outputs: usize,
    n: usize,
    weight: Vec<f64>, // [outputs, inputs]
    bias: Vec<f64>,
    x: Vec<f64>,   // [inputs, n] of a ReLU
    d_y: Vec<f64>, // [outputs, n]
}

impl Case {
    /// Inputs and gradients of all sizes, as networks have them: features far below 1, gradients of a mean over many rays.
    fn new((inputs, outputs, n): (usize, usize, usize), random: &mut Random) -> Case {
        let mut planes = |rows: usize, most: f64| -> Vec<f64> {
            let rows = (0..rows).flat_map(|_| {
                let scale = most * random.uniform(-8.0, 0.0).exp();
                random.many(n, -scale, scale)
            });
            rows.map(|x| f64::from(x as f32)).collect()
        };
        let x = planes(inputs, 3.0)
            .into_iter()
            .map(|x| x.max(0.0))
            .collect();
        let d_y = planes(outputs, 1e-7);
        let weight = random.many(outputs * inputs, -0.2, 0.2);
        Case {
            inputs,
            outputs,
            n,
            weight,
            bias: random.many(outputs, -1.0, 1.0),
            x,
            d_y,
        }
    }

    /// Wx + b, gated Wᵀd_y, d_y xᵀ and Σ d_y.
    fn twin(&self) -> [Vec<f64>; 4] {
        let (inputs, outputs, n) = (self.inputs, self.outputs, self.n);
        let mut y: Vec<f64> = (0..outputs * n).map(|i| self.bias[i / n]).collect();
        let mut d_x = vec![0.0; inputs * n];
        let mut d_weight = vec![0.0; outputs * inputs];
        for o in 0..outputs {
            for i in 0..inputs {
                let w = self.weight[o * inputs + i];
                for s in 0..n {
                    let (x, d) = (self.x[i * n + s], self.d_y[o * n + s]);
                    y[o * n + s] += w * x;
                    d_x[i * n + s] += if x > 0.0 { w * d } else { 0.0 };
                    d_weight[o * inputs + i] += d * x;
                }
            }
        }
        let d_bias = self.d_y.chunks(n).map(|row| row.iter().sum()).collect();
        [y, d_x, d_weight, d_bias]
    }

    /// The same by the kernels.
    fn device(&self, gpu: &Gpu) -> Result<[Vec<f64>; 4]> {
        let (inputs, outputs, n) = (self.inputs as u32, self.outputs as u32, self.n as u32);
        let single = |values: &[f64]| values.iter().map(|&x| x as f32).collect::<Vec<f32>>();
        let mut plan = ParamsPlan::default();
        let weights = single(&self.weight);
        let matrix = plan.add_plain(
            Group::Fields,
            "weight",
            outputs.into(),
            inputs.into(),
            weights,
        );
        let bias = Init::Values(single(&self.bias));
        let bias = plan.add(Group::Fields, "bias", &[outputs.into()], bias);
        let handle = WeightHandle {
            bias: Some(bias),
            ..matrix
        };
        let shape = LayerShape {
            inputs,
            outputs,
            first_row: 0,
            activation: Activation::None,
            backward_inputs: inputs,
            inputs_are_relu: true,
        };
        let layer = Layer::new(gpu, "layer", shape, handle)?;
        let params = plan.build(gpu, 1, true)?;
        // Each of them with gaps of its own between planes, which nobody reads or writes.
        let filled = |name: &str, values: &[f64], stride: u32| {
            let mut spread = Vec::new();
            for plane in single(values).chunks(self.n) {
                spread.extend(plane);
                spread.resize(spread.len() + (stride - n) as usize, f32::NAN);
            }
            let buffer = gpu.buffer(name, spread.len() as u64)?;
            gpu.upload(&buffer, 0, &spread)?;
            Ok::<_, Error>(Planes::new(buffer, stride))
        };
        let x = filled("x", &self.x, n + 6)?;
        let d_y = filled("d_y", &self.d_y, n + 2)?;
        let y = filled("y", &vec![0.0; self.d_y.len()], n + 4)?;
        gpu.submit("layer", |rec| {
            let reading =
                |planes: &Planes<Buffer<f32>>| Planes::new(planes.first.ptr(), planes.stride);
            let writing =
                |planes: &Planes<Buffer<f32>>| Planes::new(planes.first.ptr_mut(), planes.stride);
            layer.forward(rec, &params, reading(&x), writing(&y), n);
            layer.gradient(rec, &params, reading(&x), reading(&d_y), n);
            // In place, as networks do it.
            layer.backward(rec, &params, reading(&d_y), reading(&x), writing(&x), n);
            Ok(())
        })?;
        // While the buffers live: their guard words go with them.
        gpu.finish()?;
        let overruns = gpu.check_guards()?;
        assert!(overruns.is_empty(), "written past an end: {overruns:?}");
        let wide = |values: Vec<f32>| values.into_iter().map(f64::from).collect();
        let grads = |first, len| gpu.download(params.grads(), first, len).map(wide);
        let gathered = |planes: &Planes<Buffer<f32>>| {
            let spread = gpu.download(&planes.first, 0, planes.first.len())?;
            let mut values = Vec::new();
            for plane in spread.chunks(planes.stride as usize) {
                let (inside, gap) = plane.split_at(self.n);
                assert!(gap.iter().all(|x| x.is_nan()), "written between planes");
                values.extend_from_slice(inside);
            }
            Ok::<_, Error>(wide(values))
        };
        Ok([
            gathered(&y)?,
            gathered(&x)?,
            grads(0, u64::from(outputs * inputs))?,
            grads(bias, outputs.into())?,
        ])
    }
}

/// What is asked of every way, and the answers.
fn cases() -> &'static [(Case, [Vec<f64>; 4])] {
    static CASES: OnceLock<Vec<(Case, [Vec<f64>; 4])>> = OnceLock::new();
    CASES.get_or_init(|| {
        let mut random = Random(11);
        let cases = SIZES.map(|size| Case::new(size, &mut random));
        let with_twin = |case: Case| {
            let twin = case.twin();
            (case, twin)
        };
        cases.into_iter().map(with_twin).collect()
    })
}

/// Every product within a relative L2 distance, guard words whole, nothing to say for the validation layer.
fn check(options: GpuOptions, most: f64) -> Result<()> {
    let gpu = Gpu::new(&GpuOptions {
        validation: true,
        guard: true,
        ..options.clone()
    })?;
    let how = match options.ways.is_empty() {
        true => format!("{:?}", options.matrices),
        false => options.ways.join(", "),
    };
    for (case, twin) in cases() {
        let size = (case.inputs, case.outputs, case.n);
        let products = ["y", "d_x", "d_weight", "d_bias"].into_iter();
        for ((product, got), want) in products.zip(case.device(&gpu)?).zip(twin) {
            let power: f64 = want.iter().map(|x| x * x).sum();
            let error: f64 = got.iter().zip(want).map(|(a, b)| (a - b).powi(2)).sum();
            let distance = (error / power).sqrt();
            println!("{how} {size:?} {product}: relative L2 {distance:.1e}");
            assert!(distance <= most, "{how} {size:?} {product}: {distance:e}");
        }
    }
    let messages = gpu.validation_messages();
    assert!(messages.is_empty(), "{}", messages.join("\n"));
    Ok(())
}

/// Whether the device has matrices to multiply with; says so where it has none.
fn has_matrices() -> Result<bool> {
    let gpu = Gpu::new(&GpuOptions::default())?;
    let there = gpu.info().matrix.is_some();
    if !there {
        println!("skipped: {} has no cooperative matrices", gpu.info().name);
    }
    Ok(there)
}

fn by(matrices: Matrices) -> GpuOptions {
    GpuOptions {
        matrices,
        ..GpuOptions::default()
    }
}

#[test]
fn in_float32() -> Result<()> {
    check(by(Matrices::Off), 1e-6)
}

#[test]
fn in_float32_by_the_portable_kernels() -> Result<()> {
    let options = GpuOptions {
        portable: true,
        ..by(Matrices::Off)
    };
    check(options, 1e-6)
}

/// Whichever way a device takes, narrow layers and wide ones; by the portable kernels also what devices with many cores choose from.
#[test]
fn in_every_way_that_may_be_the_fastest() -> Result<()> {
    for portable in [false, true] {
        let options = GpuOptions {
            portable,
            ..GpuOptions::default()
        };
        let gpu = Gpu::new(&options)?;
        let widths = [64, 256].iter();
        let ways: BTreeSet<String> = widths.flat_map(|&width| layer_ways(&gpu, width)).collect();
        assert!(ways.len() > 2, "{ways:?}");
        for way in ways {
            let ways = vec![way];
            check(
                GpuOptions {
                    ways,
                    ..options.clone()
                },
                1e-6,
            )?;
        }
    }
    Ok(())
}

#[test]
fn by_matrices_compensated() -> Result<()> {
    if !has_matrices()? {
        return Ok(());
    }
    check(by(Matrices::Compensated), 1e-6)
}

#[test]
fn by_matrices_of_float16() -> Result<()> {
    if !has_matrices()? {
        return Ok(());
    }
    check(by(Matrices::Float16), 1e-3)
}

#[test]
fn matrices_that_are_not_there_are_refused() -> Result<()> {
    let wanted = GpuOptions {
        matrices: Matrices::Float16,
        ..GpuOptions::default()
    };
    match Gpu::new(&wanted) {
        Ok(_) => assert!(has_matrices()?),
        Err(error) => assert!(
            matches!(&error, Error::NoDevice { what } if what.contains("no cooperative matrices")),
            "{error}"
        ),
    }
    Ok(())
}
