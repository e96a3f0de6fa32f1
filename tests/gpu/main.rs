//! The Vulkan layer, on whatever device is there: memory, order of work, limits, errors.

use neurodin::Result;
use neurodin::gpu::{Gpu, GpuOptions, Work};
use neurodin::kernels::{fill, roof_copy};

mod errors;
mod launches;
mod memory;
mod order;
mod tuning;

fn open() -> Result<Gpu> {
    Gpu::new(&GpuOptions::default())
}

/// Under validation and with guard words; also what it said.
fn watched() -> GpuOptions {
    GpuOptions {
        validation: true,
        guard: true,
        ..GpuOptions::default()
    }
}

/// Words that name their own place.
fn numbers(n: u64) -> Vec<u32> {
    (0..n as u32)
        .map(|i| i.wrapping_mul(0x9e37_79b9) ^ 0x5bd1_e995)
        .collect()
}

/// Fills `n` floats by kernel and looks at each.
fn fill_and_look(gpu: &Gpu, n: u32) -> Result<()> {
    let values = gpu.buffer::<f32>("values", n as u64)?;
    let kernel = gpu.kernel(fill::Shape::default())?;
    gpu.submit("fill", |rec| {
        let args = fill::Args {
            values: values.ptr_mut(),
            n,
            value: 1.5,
        };
        rec.run(&kernel, Work::items(n as u64), args);
        Ok(())
    })?;
    let back = gpu.download(&values, 0, n as u64)?;
    assert_eq!(back.iter().position(|&v| v != 1.5), None, "of {n}");
    Ok(())
}

/// Copies `slices` planes by kernel and compares; `work` says how much it pretends to do.
fn copy_and_compare(gpu: &Gpu, n: u64, slices: u32, work: impl Fn(Work) -> Work) -> Result<()> {
    let words = numbers(4 * n * slices as u64);
    let all: &[[u32; 4]] = bytemuck::cast_slice(&words);
    let (from, to) = (
        gpu.buffer::<[u32; 4]>("from", all.len() as u64)?,
        gpu.scratch::<[u32; 4]>("to", all.len() as u64)?,
    );
    gpu.upload(&from, 0, all)?;
    let kernel = gpu.kernel(roof_copy::Shape::default())?;
    gpu.submit("copy", |rec| {
        let args = roof_copy::Args {
            from: from.ptr(),
            to: to.ptr_mut(),
            n: n as u32,
        };
        rec.run(&kernel, work(Work::items(n).slices(slices)), args);
        Ok(())
    })?;
    let back = gpu.download(&to, 0, to.len())?;
    let wrong = back.iter().zip(all).position(|(a, b)| a != b);
    assert_eq!(wrong, None, "{n} items in {slices} slices");
    Ok(())
}
