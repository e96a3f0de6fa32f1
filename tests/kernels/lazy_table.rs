//! The lazily updated hash table against AdamW of every entry in every step, in float64 and in float32.

use crate::half_copy::assert_copy;
use crate::harness::Random;
use crate::optimizer::Adam;
use neurodin::Result;
use neurodin::config::{Config, OptimizerConfig};
use neurodin::gpu::{Buffer, Gpu, GpuOptions, Kernel, PtrMut, Recorder, Work};
use neurodin::kernels::weight_gradient;
use neurodin::model::{Group, HashGrid, Init, LazyTable, Params, ParamsPlan, Rates};
use std::collections::BTreeSet;

const GRID: HashGrid = HashGrid {
    levels: 4,
    base: 6,
    max: 160,
    log2_size: 11,
    features: 2, // each test has its own number of them
};
/// A table does not begin where the parameters do.
const BEFORE: u64 = 24;

/// A table on the device, its twin, and points with gradients that steps choose from.
struct Bench {
    gpu: Gpu,
    params: Params,
    lazy: LazyTable,
    /// Adds a batch's gradients to those that are there: the weights of a layer of one input, which is 1, have those of its outputs.
    add: Kernel<weight_gradient::Args>,
    one: Buffer<f32>, // [1]
    batches: Vec<Batch>,
    /// [1] 0 and 1.
    bad_step: [Buffer<u32>; 2],
    twin: Adam,
    values: Vec<f64>,
    /// The same in float32, which forgets what is less than half a last digit: (p, m, v) of every parameter.
    dense: Vec<[f32; 3]>,
    optimizer: OptimizerConfig,
}

/// Points, and the gradients that they leave.
struct Batch {
    n: u32,
    points: Buffer<f32>,
    touched: BTreeSet<usize>, // entries
    gradients: Vec<f64>,
    /// As they are, and with the other sign.
    on_device: [Buffer<f32>; 2],
}

fn entries() -> usize {
    GRID.entries() as usize
}

/// The entries around a point, as the device finds them (glsl/lib/hash_grid.glsl).
fn corners(point: [f32; 3]) -> Vec<usize> {
    let mut found = Vec::new();
    for level in GRID.level_table() {
        let half = 0.5 * level.scale;
        let low = point.map(|x| (half.mul_add(x, half) + 0.5).floor() as i32 as u32);
        for corner in 0..8u32 {
            let at: [u32; 3] = std::array::from_fn(|axis| low[axis] + (corner >> axis & 1));
            let index = match level.hashed {
                0 => {
                    (at[0] + level.resolution * (at[1] + level.resolution * at[2])) % level.entries
                }
                _ => {
                    (at[0] ^ at[1].wrapping_mul(2_654_435_761) ^ at[2].wrapping_mul(805_459_861))
                        & (level.entries - 1)
                }
            };
            found.push((level.offset + index) as usize);
        }
    }
    found
}

impl Bench {
    /// `half`: with a copy of the table in float16.
    fn new(features: u32, decay: f64, half: bool, options: GpuOptions) -> Result<Bench> {
        let grid = HashGrid { features, ..GRID };
        let of_entry = features as usize;
        let gpu = Gpu::new(&GpuOptions {
            validation: true,
            guard: true,
            ..options
        })?;
        let mut optimizer = Config::default().optimizer;
        optimizer.table.weight_decay = decay;
        let mut random = Random(7);
        let values: Vec<f64> = random.many(entries() * of_entry, -0.02, 0.02);
        let mut plan = ParamsPlan::default();
        let pad = Init::Values(vec![0.5; BEFORE as usize]);
        plan.add(Group::Fields, "before", &[BEFORE], pad);
        let table = Init::Values(values.iter().map(|&x| x as f32).collect());
        let first = plan.add(
            Group::Table,
            "table",
            &[GRID.entries(), features.into()],
            table,
        );
        if half {
            plan.keep_half(first);
        }
        let params = plan.build(&gpu, 1, true)?;
        let lazy = LazyTable::new(&gpu, &grid, first, &optimizer, 4, half)?;
        let lazy = lazy.expect("levels to be lazy with");
        assert_eq!(lazy.first(), first, "the smallest level is one of them");
        let flag = |value: u32| -> Result<Buffer<u32>> {
            let flag = gpu.buffer("bad step", 1)?;
            gpu.upload(&flag, 0, &[value])?;
            Ok(flag)
        };
        let bad_step = [flag(0)?, flag(1)?];
        let add = gpu.kernel(weight_gradient::Shape {
            inputs: 1,
            outputs: features * entries() as u32,
            bias: 0,
            tile: 1,
            rows: 0,
        })?;
        let one = gpu.buffer("one", 1)?;
        gpu.upload(&one, 0, &[1.0])?;
        // Batches of all sizes: the largest touches most of the coarse levels. Their gradients are of all sizes, too: down to where ε
        // counts, and to where squares vanish in float32; and some entries are touched without one.
        let sizes = [1, 2, 3, 5, 8, 8, 20, 50, 90, 400];
        let batches = (0..40).map(|i| {
            let n = sizes[i % sizes.len()];
            let scale =
                10f64.powf([-1.0, -3.0, -6.0, -9.0, -12.0, -14.0, -15.0, -17.0, -22.0][i % 9]);
            let mut points: Vec<[f32; 3]> = (0..n)
                .map(|_| std::array::from_fn(|_| random.uniform(-1.0, 1.0) as f32))
                .collect();
            // Of two, the second is in the cell beside the first: their entries' stamps share words.
            if let [first, second] = &mut points[..] {
                let finest = GRID.level_table()[GRID.levels as usize - 1];
                let cell = 2.0 / finest.scale;
                *second = [first[0] - cell * first[0].signum(), first[1], first[2]];
            }
            let touched: BTreeSet<usize> = points.iter().flat_map(|&p| corners(p)).collect();
            let mut gradients = vec![0.0; of_entry * entries()];
            for &entry in &touched {
                for feature in 0..of_entry {
                    let zero = random.below(7) == 0;
                    let size = scale * random.uniform(-3.0, 0.0).exp();
                    let sign = if random.below(3) == 0 { -1.0 } else { 1.0 };
                    let gradient = if zero { 0.0 } else { sign * size };
                    gradients[of_entry * entry + feature] = f64::from(gradient as f32);
                }
            }
            let planes: Vec<f32> = (0..3)
                .flat_map(|c| points.iter().map(move |p| p[c]))
                .collect();
            let on_points = gpu.buffer("points", planes.len() as u64)?;
            gpu.upload(&on_points, 0, &planes)?;
            let signed = |sign: f64| -> Result<Buffer<f32>> {
                let on_device = gpu.buffer("batch gradients", gradients.len() as u64)?;
                let rounded: Vec<f32> = gradients.iter().map(|&g| (sign * g) as f32).collect();
                gpu.upload(&on_device, 0, &rounded)?;
                Ok(on_device)
            };
            Ok(Batch {
                on_device: [signed(1.0)?, signed(-1.0)?],
                n: n as u32,
                points: on_points,
                touched,
                gradients,
            })
        });
        let batches = batches.collect::<Result<Vec<Batch>>>()?;
        let betas = [optimizer.beta1, optimizer.beta2];
        Ok(Bench {
            twin: Adam::new(values.len(), betas, optimizer.epsilon, decay),
            gpu,
            params,
            lazy,
            add,
            one,
            batches,
            bad_step,
            dense: values.iter().map(|&x| [x as f32, 0.0, 0.0]).collect(),
            values,
            optimizer,
        })
    }

    /// One step of both; `bad` ones change nothing but the time.
    fn step(&mut self, rec: &mut Recorder, step: u64, batch: usize, rate: f64, bad: bool) {
        let chosen = &self.batches[batch];
        // The same points in two launches: what is touched twice is brought up to date once. One or two settle what they mark, more are
        // followed by a walk over the marks; then one comes that leaves no gradient.
        for points in [chosen, chosen, &self.batches[0]] {
            self.lazy
                .touch(rec, &self.params, points.points.ptr(), points.n);
        }
        // Parameters wander about and stay small, as they do in training: float32 would lose more of large ones.
        let turned = step % 2 == 1;
        let gradients = &chosen.on_device[usize::from(turned)];
        let sign = if turned { -1.0 } else { 1.0 };
        let args = weight_gradient::Args {
            x: self.one.ptr(),
            d_y: gradients.ptr(),
            d_weight: self.params.d_value(BEFORE),
            d_bias: PtrMut::NULL,
            n: 1,
            stride_x: 1,
            stride_d_y: 1,
            chunk: 1,
        };
        let outputs = u64::from(self.add.local_size());
        let blocks = gradients.len().div_ceil(outputs) as u32;
        rec.run(&self.add, Work::groups(1).slices(blocks), args);
        let t = step as i32 + 1;
        let (beta1, beta2) = (self.optimizer.beta1, self.optimizer.beta2);
        let rates = Rates {
            rate: (rate / (1.0 - beta1.powi(t))) as f32,
            decay: (rate * self.optimizer.table.weight_decay) as f32,
            correction: (1.0 - beta2.powi(t)).sqrt() as f32,
        };
        let flag = &self.bad_step[usize::from(bad)];
        self.lazy.update(rec, &self.params, &rates, step, flag);
        match bad {
            true => self.twin.steps += 1,
            false => {
                let gradients: Vec<f64> = chosen.gradients.iter().map(|g| sign * g).collect();
                self.twin.update(&mut self.values, &gradients, rate);
                let shares = [(1.0 - beta1) as f32, (1.0 - beta2) as f32];
                let epsilon = self.optimizer.epsilon as f32;
                for ([p, m, v], g) in self.dense.iter_mut().zip(&gradients) {
                    let g = *g as f32;
                    *m = shares[0].mul_add(g - *m, *m);
                    *v = shares[1].mul_add(g * g - *v, *v);
                    let moved = rates.rate * *m / (v.sqrt() / rates.correction + epsilon);
                    *p -= rates.decay.mul_add(*p, moved);
                }
            }
        }
    }

    fn download(&self, block: &Buffer<f32>) -> Result<Vec<f64>> {
        let values = self.gpu.download(block, BEFORE, self.values.len() as u64)?;
        Ok(values.into_iter().map(f64::from).collect())
    }

    fn flush(&self) -> Result<()> {
        self.gpu.submit("flush", |rec| {
            self.lazy.flush(rec, &self.params);
            Ok(())
        })?;
        Ok(())
    }

    /// The flushed table is the twin's.
    fn check(&self, step: u64) -> Result<()> {
        self.flush()?;
        let worst = |got: &[f64], want: &[f64], scale: &dyn Fn(f64) -> f64| {
            got.iter()
                .zip(want)
                .enumerate()
                .map(|(i, (got, want))| ((got - want).abs() / scale(want.abs()), i))
                .fold(
                    (0.0, 0),
                    |a, b| if b.0 > a.0 || b.0.is_nan() { b } else { a },
                )
        };
        let of_dense: Vec<f64> = self.dense.iter().map(|x| f64::from(x[0])).collect();
        let values = self.download(self.params.values())?;
        let (p, i) = worst(&values, &self.values, &|_| 1.0);
        let (dense, _) = worst(&of_dense, &self.values, &|_| 1.0);
        println!(
            "step {step}: parameter {i} is off by {p:.1e}; AdamW in float32 by up to {dense:.1e}"
        );
        for (i, (got, want)) in values.iter().zip(&self.values).enumerate() {
            let (off, unavoidable) = ((got - want).abs(), (of_dense[i] - want).abs());
            assert!(
                off <= 1e-6 + unavoidable,
                "parameter {i} is {off:e} off at step {step}, in float32 {unavoidable:e}"
            );
        }
        if let Some(copy) = self.params.copy() {
            assert_copy(&self.gpu.download(copy, 0, copy.len())?, &values);
        }
        let of_its_size = |x: f64| x.max(1e-30);
        let (m, i) = worst(
            &self.download(self.params.first_moment())?,
            &self.twin.m,
            &of_its_size,
        );
        assert!(
            m <= 1e-3,
            "first moment {i} is {m:e} of its size off at step {step}"
        );
        let (v, i) = worst(
            &self.download(self.params.second_moment())?,
            &self.twin.v,
            &of_its_size,
        );
        assert!(
            v <= 1e-4,
            "second moment {i} is {v:e} of its size off at step {step}"
        );
        let grads = self.download(self.params.grads())?;
        assert!(grads.iter().all(|&g| g == 0.0), "gradients are consumed");
        Ok(())
    }

    fn check_device(&self) -> Result<()> {
        self.gpu.finish()?;
        let overruns = self.gpu.check_guards()?;
        assert!(overruns.is_empty(), "written past an end: {overruns:?}");
        let messages = self.gpu.validation_messages();
        assert!(messages.is_empty(), "{}", messages.join("\n"));
        let before = self.gpu.download(self.params.values(), 0, BEFORE)?;
        assert_eq!(before, vec![0.5; BEFORE as usize]);
        Ok(())
    }
}

/// Warm-up from zero, milestones, and rates halved in the middle of it all.
fn learning_rate(step: u64) -> f64 {
    let rise = (step as f64 / 150.0).min(1.0);
    let drops = [4000, 7500]
        .iter()
        .filter(|&&milestone| step > milestone)
        .count();
    let slowed = if step >= 6000 { 0.5 } else { 1.0 };
    1e-3 * rise * 0.1f64.powi(drops as i32) * slowed
}

/// Most steps take a small batch, a few in a row a large one; some batches come once in the whole run, and some entries never.
fn batch_of(step: u64, random: &mut Random) -> usize {
    match step {
        40 | 3_000 => 38,
        500 | 3_900 => 37,
        100..=120 | 5_000..=5_090 => 9,
        _ if random.below(50) == 0 => 10 + random.below(27),
        _ => random.below(9),
    }
}

fn ten_thousand_steps(features: u32, decay: f64, half: bool, options: GpuOptions) -> Result<()> {
    let mut bench = Bench::new(features, decay, half, options)?;
    let used: BTreeSet<usize> = bench
        .batches
        .iter()
        .flat_map(|b| b.touched.clone())
        .collect();
    assert!(used.len() + 100 < entries(), "some entries stay untouched");
    let mut random = Random(3);
    let gpu = bench.gpu.clone();
    for first in (0..10_000u64).step_by(50) {
        gpu.submit("steps", |rec| {
            for step in first..first + 50 {
                let batch = batch_of(step, &mut random);
                bench.step(rec, step, batch, learning_rate(step), random.below(40) == 0);
            }
            Ok(())
        })?;
        if [50, 150, 2000, 4500, 9_950].contains(&first) {
            bench.check(first + 50)?;
        }
    }
    bench.check_device()
}

/// Where powers of β₂ run out of float32 within a sweep, the table is updated whole.
#[test]
fn too_short_a_memory_has_no_closed_form() -> Result<()> {
    let gpu = Gpu::new(&GpuOptions::default())?;
    for (beta2, lazy) in [(0.999, true), (0.9, true), (0.6, false), (0.0, false)] {
        let optimizer = OptimizerConfig {
            beta2,
            ..Config::default().optimizer
        };
        let table = LazyTable::new(&gpu, &GRID, BEFORE, &optimizer, 1, false)?;
        assert_eq!(table.is_some(), lazy, "{beta2}");
    }
    Ok(())
}

#[test]
fn ten_thousand_steps_are_those_of_adamw() -> Result<()> {
    ten_thousand_steps(8, 0.01, false, GpuOptions::default())
}

#[test]
fn ten_thousand_steps_without_decay_by_the_portable_kernels_with_a_copy() -> Result<()> {
    let portable = GpuOptions {
        portable: true,
        ..GpuOptions::default()
    };
    ten_thousand_steps(2, 0.0, true, portable)
}

#[test]
fn what_is_touched_is_up_to_date_before_it_is_read() -> Result<()> {
    for many_cores in [false, true] {
        touch_before_reading(GpuOptions {
            many_cores,
            ..GpuOptions::default()
        })?;
    }
    Ok(())
}

fn touch_before_reading(options: GpuOptions) -> Result<()> {
    let mut bench = Bench::new(2, 0.01, false, options)?;
    let gpu = bench.gpu.clone();
    let mut random = Random(5);
    for first in (0..600u64).step_by(30) {
        gpu.submit("steps", |rec| {
            for step in first..first + 30 {
                bench.step(rec, step, random.below(5), 1e-3, false);
            }
            let asked = &bench.batches[5];
            bench
                .lazy
                .touch(rec, &bench.params, asked.points.ptr(), asked.n);
            Ok(())
        })?;
        let values = bench.download(bench.params.values())?;
        for &entry in &bench.batches[5].touched {
            for i in [2 * entry, 2 * entry + 1] {
                let apart = (values[i] - bench.values[i]).abs();
                assert!(
                    apart <= 1e-6,
                    "parameter {i} is {apart:e} off after {first} steps"
                );
            }
        }
        let stale = (0..values.len()).filter(|&i| (values[i] - bench.values[i]).abs() > 1e-6);
        assert!(stale.count() > 100, "others wait until they are asked for");
    }
    bench.check(600)?;
    bench.check_device()
}

/// A checkpoint holds a flushed table: going on with it and going on from it are the same to the last bit.
#[test]
fn a_flushed_table_goes_on_like_an_uploaded_one() -> Result<()> {
    let mut bench = Bench::new(4, 0.01, false, GpuOptions::default())?;
    let gpu = bench.gpu.clone();
    let steps = |bench: &mut Bench, range: std::ops::Range<u64>, batches: usize| {
        let mut random = Random(range.start + 1);
        gpu.submit("steps", |rec| {
            for step in range {
                let batch = random.below(batches);
                bench.step(rec, step, batch, 1e-3, step % 17 == 3);
            }
            Ok(())
        })
    };
    let state = |bench: &Bench| -> Result<Vec<Vec<f32>>> {
        bench.flush()?;
        let params = &bench.params;
        let blocks = [
            params.values(),
            params.first_moment(),
            params.second_moment(),
        ];
        blocks
            .iter()
            .map(|block| bench.gpu.download(block, 0, block.len()))
            .collect()
    };
    steps(&mut bench, 0..300, 10)?;
    let saved = state(&bench)?;
    steps(&mut bench, 300..650, 10)?;
    let went_on = state(&bench)?;
    // Other steps in between, which a reset forgets: small ones, whose gradients still wait for their updates.
    steps(&mut bench, 650..700, 5)?;
    let params = &bench.params;
    let blocks = [
        params.values(),
        params.first_moment(),
        params.second_moment(),
    ];
    for (block, values) in blocks.iter().zip(&saved) {
        bench.gpu.upload(block, 0, values)?;
    }
    bench.gpu.submit("reset", |rec| {
        bench.lazy.reset(rec, &bench.params);
        Ok(())
    })?;
    steps(&mut bench, 300..650, 10)?;
    assert!(state(&bench)? == went_on);
    bench.check_device()
}
