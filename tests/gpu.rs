//! The Vulkan layer, on whatever device is there: memory, order of work, limits, errors.

use neurodin::gpu::{Gpu, GpuOptions, Work};
use neurodin::kernels::fill;
use neurodin::{Error, Result};

fn open() -> Result<Gpu> {
    Gpu::new(&GpuOptions::default())
}

/// Under validation and with guard words.
fn open_watched() -> Result<Gpu> {
    Gpu::new(&GpuOptions {
        validation: true,
        guard: true,
        ..GpuOptions::default()
    })
}

fn run_fill(gpu: &Gpu, n: u32) -> Result<()> {
    let values = gpu.buffer::<f32>("values", n as u64)?;
    let kernel = gpu.kernel(fill::Shape::default())?;
    let ticket = gpu.submit("fill", |rec| {
        let args = fill::Args {
            values: values.ptr_mut(),
            n,
            value: 1.5,
        };
        rec.run(&kernel, Work::items(n as u64), args);
        Ok(())
    })?;
    gpu.wait(ticket)?;
    let back = gpu.download(&values, 0, n as u64)?;
    let wrong = back.iter().position(|&v| v != 1.5);
    assert_eq!(wrong, None, "of {n}");
    Ok(())
}

#[test]
fn a_kernel_reaches_every_item() -> Result<()> {
    let gpu = open()?;
    [1, 63, 64, 65, 16384, 16385, 1_000_003]
        .into_iter()
        .try_for_each(|n| run_fill(&gpu, n))
}

#[test]
fn a_round_trip_of_more_than_128_mib_keeps_every_word() -> Result<()> {
    let gpu = open()?;
    let n = (150 << 20) / 4u64;
    let words: Vec<u32> = (0..n as u32).map(|i| i.wrapping_mul(0x9e37_79b9)).collect();
    let buffer = gpu.buffer::<u32>("words", n)?;
    gpu.upload(&buffer, 0, &words)?;
    let copy = gpu.buffer::<u32>("copy", n)?;
    gpu.submit("copy", |rec| {
        rec.copy(&buffer, 0, &copy, 0, n);
        Ok(())
    })?;
    assert!(gpu.download(&copy, 0, n)? == words);
    Ok(())
}

#[test]
fn an_unknown_device_is_refused_with_the_list() {
    let options = GpuOptions {
        device: Some("no such device".into()),
        ..GpuOptions::default()
    };
    let error = Gpu::new(&options).expect_err("there is no such device");
    assert!(matches!(error, Error::NoDevice { .. }));
    let text = error.to_string();
    let first = &Gpu::list().expect("a device is there")[0];
    assert!(
        text.contains("no such device") && text.contains(&first.name),
        "{text}"
    );
}

#[test]
fn the_validation_layer_has_nothing_to_say() -> Result<()> {
    let gpu = open_watched()?;
    let log = gpu.validation_log();
    run_fill(&gpu, 100_000)?;
    assert_eq!(gpu.check_guards()?, []);
    drop(gpu);
    assert_eq!(log.messages(), Vec::<String>::new());
    Ok(())
}
