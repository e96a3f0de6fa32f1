//! Kernels: every item, every index, every constant.

use crate::{copy_and_compare, fill_and_look, open, watched};
use neurodin::Result;
use neurodin::gpu::{Gpu, GpuOptions, Work};
use neurodin::kernels::{appearance_backward, roof_fma};

#[test]
fn a_kernel_reaches_every_item() -> Result<()> {
    let gpu = open()?;
    [1, 63, 64, 65, 16384, 16385, 1_000_003]
        .into_iter()
        .try_for_each(|n| fill_and_look(&gpu, n))
}

#[test]
fn more_than_65535_workgroups_keep_their_indices() -> Result<()> {
    copy_and_compare(&open()?, 65_536 * 64 + 17, 1, |work| work.bytes(0.1))
}

#[test]
fn specialisation_constants_reach_the_kernel() -> Result<()> {
    let gpu = open()?;
    let sums = gpu.scratch::<f32>("sums", 100)?;
    for rounds in [1, 3, roof_fma::Shape::default().rounds] {
        let kernel = gpu.kernel(roof_fma::Shape { rounds })?;
        gpu.submit("fma", |rec| {
            let args = roof_fma::Args {
                sums: sums.ptr_mut(),
                n: 100,
                gain: 1.0,
                offset: 0.5,
            };
            rec.run(&kernel, Work::items(100), args);
            Ok(())
        })?;
        // Sixteen chains from 0 … 15, each 16·rounds steps of one half.
        let expected = 120.0 + 16.0 * 16.0 * rounds as f32 * 0.5;
        assert_eq!(
            gpu.download(&sums, 0, 100)?,
            vec![expected; 100],
            "{rounds} rounds"
        );
    }
    Ok(())
}

#[test]
fn roofs_are_measured() -> Result<()> {
    let roofs = open()?.measure_roofs()?;
    assert!(roofs.copy_gb_s > 0.01 && roofs.copy_gb_s < 1e5, "{roofs:?}");
    assert!(
        roofs.fma_gflop_s > 0.1 && roofs.fma_gflop_s < 1e6,
        "{roofs:?}"
    );
    Ok(())
}

#[test]
fn adding_to_one_float_from_everywhere_loses_nothing() -> Result<()> {
    for portable in [false, true] {
        let gpu = Gpu::new(&GpuOptions {
            portable,
            ..watched()
        })?;
        let n = 20_000; // rays of one sample and one channel, all of the first view
        let (ones, views) = (
            gpu.buffer::<f32>("ones", n)?,
            gpu.buffer::<u32>("views", n)?,
        );
        gpu.upload(&ones, 0, &vec![1.0; n as usize])?;
        let sum = gpu.buffer::<f32>("sum", 1)?;
        let kernel = gpu.kernel(appearance_backward::Shape::default())?;
        gpu.submit("add", |rec| {
            let args = appearance_backward::Args {
                d_code: ones.ptr(),
                ray_view: views.ptr(),
                d_appearance: sum.ptr_mut(),
                n_rays: n as u32,
                n_samples: 1,
                channels: 1,
            };
            rec.run(&kernel, Work::items(n), args);
            Ok(())
        })?;
        assert_eq!(
            gpu.download(&sum, 0, 1)?,
            [n as f32],
            "portable: {portable}"
        );
        assert_eq!(gpu.check_guards()?, []);
    }
    Ok(())
}
