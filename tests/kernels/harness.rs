//! A device under the validation layer and with guard words, arrays to and from it, and how results are compared.
//!
//! Give `Device::run` its input buffers as temporaries inside the arguments: they live until the launch has finished.

// Shared with the float64 twin's own tests, which use more of it.
#[allow(dead_code)]
#[path = "../reference/npz.rs"]
mod npz;

use bytemuck::Pod;
use neurodin::gpu::{Buffer, Gpu, GpuOptions, KernelShape, Work};
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

pub use npz::Npz;

/// The device of all tests of this program.
pub struct Device {
    pub gpu: Gpu,
    turn: Mutex<()>,
}

/// Opens the device on first use. There is no point in running these tests without one, so its absence is a failure.
pub fn device() -> &'static Device {
    static DEVICE: OnceLock<Device> = OnceLock::new();
    DEVICE.get_or_init(|| {
        let options = GpuOptions {
            validation: true,
            guard: true,
            ..GpuOptions::default()
        };
        let gpu = Gpu::new(&options).expect("kernel tests need a Vulkan device");
        eprintln!(
            "kernel tests on {} ({})",
            gpu.info().name,
            gpu.info().driver
        );
        Device {
            gpu,
            turn: Mutex::new(()),
        }
    })
}

impl Device {
    /// Buffers are made and kernels run one at a time: guard words are looked at only when every buffer has its own.
    fn turn(&self) -> MutexGuard<'_, ()> {
        self.turn.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Elements of any kind on the device.
    pub fn table<T: Pod>(&self, name: &str, values: &[T]) -> Buffer<T> {
        let _turn = self.turn();
        let buffer = self.gpu.buffer(name, values.len() as u64);
        let buffer = buffer.expect("a small buffer");
        self.gpu.upload(&buffer, 0, values).expect("upload");
        buffer
    }

    /// Numbers on the device, rounded to float32. Round them in the test too ([`rounded`]) before a twin sees them.
    pub fn put(&self, name: &str, values: &[f64]) -> Buffer<f32> {
        let values: Vec<f32> = values.iter().map(|&x| x as f32).collect();
        self.table(name, &values)
    }

    /// Room for results: poisoned, so that what a kernel leaves out is seen.
    pub fn room<T: Pod>(&self, name: &str, len: usize) -> Buffer<T> {
        let _turn = self.turn();
        self.gpu.scratch(name, len as u64).expect("a small buffer")
    }

    /// Runs one kernel over `items` invocations, waits for it, and looks at the guard words and at what the validation layer says.
    pub fn run<S: KernelShape>(&self, shape: S, items: usize, args: S::Args) {
        self.run_work(shape, Work::items(items as u64), args);
    }

    /// The same of any work.
    pub fn run_work<S: KernelShape>(&self, shape: S, work: Work, args: S::Args) {
        let _turn = self.turn();
        let kernel = self.gpu.kernel(shape).expect("the kernel can be built");
        let ticket = self.gpu.submit("test", |rec| {
            rec.run(&kernel, work, args);
            Ok(())
        });
        self.gpu.wait(ticket.expect("submitted")).expect("finished");
        let overruns = self.gpu.check_guards().expect("guard words can be read");
        assert!(overruns.is_empty(), "written past an end: {overruns:?}");
        let messages = self.gpu.validation_messages();
        assert!(
            messages.is_empty(),
            "the validation layer objects: {messages:?}"
        );
    }

    /// Results as the twins have them.
    pub fn take(&self, buffer: &Buffer<f32>) -> Vec<f64> {
        self.read(buffer).into_iter().map(f64::from).collect()
    }

    /// Results of any kind.
    pub fn read<T: Pod>(&self, buffer: &Buffer<T>) -> Vec<T> {
        self.gpu
            .download(buffer, 0, buffer.len())
            .expect("download")
    }
}

/// Arrays of the published implementation: `$NEURODIN_GOLDEN/name.npz`. Without the folder the test says so and does nothing.
pub fn golden(name: &str) -> Option<Npz> {
    let default = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/golden");
    let folder = std::env::var_os("NEURODIN_GOLDEN").map_or(default, PathBuf::from);
    if !folder.is_dir() {
        println!(
            "skipped: no golden arrays in {} (set NEURODIN_GOLDEN)",
            folder.display()
        );
        return None;
    }
    Some(Npz::open(&folder.join(format!("{name}.npz"))))
}

/// What a float32 device makes of numbers before it begins.
pub fn rounded(values: impl IntoIterator<Item = f64>) -> Vec<f64> {
    values.into_iter().map(|x| f64::from(x as f32)).collect()
}

/// Planar from interleaved: `[n, C]` to `[C, n]`.
pub fn planar<const C: usize>(vectors: &[[f64; C]]) -> Vec<f64> {
    (0..C)
        .flat_map(|c| vectors.iter().map(move |v| v[c]))
        .collect()
}

/// Interleaved from planar: `[C, n]` to `[n, C]`.
pub fn interleaved<const C: usize>(planes: &[f64]) -> Vec<[f64; C]> {
    let n = planes.len() / C;
    (0..n)
        .map(|i| std::array::from_fn(|c| planes[c * n + i]))
        .collect()
}

fn compare(what: &str, got: &[f64], want: &[f64]) -> (f64, f64, f64) {
    assert_eq!(got.len(), want.len(), "{what}: lengths");
    assert!(!got.is_empty(), "{what}: nothing to compare");
    if let Some(i) = got.iter().position(|x| !x.is_finite()) {
        panic!("{what}: element {i} is {}, wanted {}", got[i], want[i]);
    }
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let error: f64 = got.iter().zip(want).map(|(a, b)| (a - b).powi(2)).sum();
    (
        error,
        dot(want, want),
        dot(got, want) / (dot(got, got) * dot(want, want)).sqrt(),
    )
}

/// Normalised mean squared error of at most 1e-7: the bar for everything computed forward.
#[track_caller]
pub fn assert_forward(what: &str, got: &[f64], want: &[f64]) {
    let (error, power, _) = compare(what, got, want);
    let nmse = error / power;
    assert!(nmse <= 1e-7 || error == 0.0, "{what}: NMSE {nmse:e}");
}

/// Relative L2 distance of at most 1e-4 and a cosine of at least 0.99999: the bar for gradients.
#[track_caller]
pub fn assert_gradient(what: &str, got: &[f64], want: &[f64]) {
    let (error, power, cosine) = compare(what, got, want);
    let distance = (error / power).sqrt();
    assert!(
        distance <= 1e-4 && cosine >= 0.99999,
        "{what}: relative L2 {distance:e}, cosine {cosine}"
    );
}

/// Every element within an absolute tolerance.
#[track_caller]
pub fn assert_close(what: &str, got: &[f64], want: &[f64], tolerance: f64) {
    compare(what, got, want);
    let worst = (0..got.len()).max_by(|&a, &b| {
        (got[a] - want[a])
            .abs()
            .total_cmp(&(got[b] - want[b]).abs())
    });
    let i = worst.expect("not empty");
    let error = (got[i] - want[i]).abs();
    assert!(
        error <= tolerance,
        "{what}: element {i} is {}, wanted {}, {error:e} apart",
        got[i],
        want[i]
    );
}

/// An analytic gradient against central differences with steps of 1e-6 (atol 1e-5, rtol 1e-3).
#[track_caller]
pub fn assert_central_differences(
    what: &str,
    at: &[f64],
    gradient: &[f64],
    value: impl Fn(&[f64]) -> f64,
) {
    let step = 1e-6;
    for i in 0..at.len() {
        let moved = |by: f64| {
            let mut x = at.to_vec();
            x[i] += by;
            value(&x)
        };
        let difference = (moved(step) - moved(-step)) / (2.0 * step);
        let tolerance = 1e-5 + 1e-3 * difference.abs();
        let error = (gradient[i] - difference).abs();
        assert!(
            error <= tolerance,
            "{what}: element {i}: analytic {}, difference {difference}",
            gradient[i]
        );
    }
}

/// Random numbers of the tests (SplitMix64, Steele et al. 2014): the same in every run.
pub struct Random(pub u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// In [low, high), rounded to float32.
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        let u = (self.next() >> 40) as f64 / (1u64 << 24) as f64;
        f64::from((low + (high - low) * u) as f32)
    }

    pub fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }

    pub fn many(&mut self, n: usize, low: f64, high: f64) -> Vec<f64> {
        (0..n).map(|_| self.uniform(low, high)).collect()
    }

    /// A unit vector, rounded to float32.
    pub fn direction(&mut self) -> [f64; 3] {
        loop {
            let v: [f64; 3] = std::array::from_fn(|_| self.uniform(-1.0, 1.0));
            let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
            if (0.1..1.0).contains(&length) {
                return v.map(|x| f64::from((x / length) as f32));
            }
        }
    }
}

/// `n + 1` increasing edges from 0 to 1, of very different widths.
pub fn uneven_edges(random: &mut Random, n: usize) -> Vec<f64> {
    let widths: Vec<f64> = (0..n).map(|_| random.uniform(-4.0, 0.0).exp()).collect();
    let total: f64 = widths.iter().sum();
    let mut edges = vec![0.0];
    edges.extend(widths.iter().scan(0.0, |sum, w| {
        *sum += w / total;
        Some(sum.min(1.0))
    }));
    rounded(edges)
}

/// Near and far of `n` rays: both sides of the warp's bend at 1, across it, and short.
pub fn near_far(random: &mut Random, n: usize) -> Vec<[f64; 2]> {
    let ray = |r: &mut Random, i: usize| match i % 4 {
        0 => [0.0, r.uniform(0.5, 0.9)],
        1 => [r.uniform(1.1, 3.0), r.uniform(3.1, 5.0)],
        2 => [r.uniform(0.2, 0.8), r.uniform(1.2, 2.5)],
        _ => [1.0, r.uniform(1.1, 1.2)],
    };
    (0..n).map(|i| ray(random, i)).collect()
}

/// Rows one after another.
pub fn flat<'a>(rows: impl IntoIterator<Item = &'a Vec<f64>>) -> Vec<f64> {
    rows.into_iter().flatten().copied().collect()
}
