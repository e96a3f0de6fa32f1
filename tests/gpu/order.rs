//! Order: barriers, cuts, threads, what runs when, and how long it took.

use crate::{copy_and_compare, fill_and_look, open, watched};
use neurodin::Result;
use neurodin::gpu::{Gpu, GpuOptions, Work};
use neurodin::kernels::{fill, roof_fma};

#[test]
fn a_launch_that_is_cut_does_the_same() -> Result<()> {
    let gpu = open()?;
    // One launch of 3 rows in 5 slices that claims to take from a fraction of a second to hours.
    for flops in [1e3, 1e5, 1e7, 1e9] {
        copy_and_compare(&gpu, 40_000, 5, |work| work.flops(flops))?;
    }
    copy_and_compare(&gpu, 100, 7, |work| work.flops(1e12))
}

/// A chain in which every command needs the one before: fill, copy, kernel, copy back, kernel over a part.
fn chain(options: &GpuOptions) -> Result<Vec<f32>> {
    let gpu = Gpu::new(options)?;
    let n = 50_000u64;
    let (a, b) = (gpu.scratch::<f32>("a", n)?, gpu.scratch::<f32>("b", n)?);
    let kernel = gpu.kernel(fill::Shape::default())?;
    let last = gpu.submit("chain", |rec| {
        for round in 0..20 {
            let value = round as f32;
            rec.fill(&a, 0..n, value.to_bits());
            rec.copy(&a, 0, &b, 0, n);
            let args = fill::Args {
                values: b.at_mut(1000 * round),
                n: 500,
                value: -value,
            };
            rec.run(&kernel, Work::items(500), args);
            rec.copy(&b, 0, &a, n / 2, n / 2);
            let args = fill::Args {
                values: a.at_mut(n / 2 + 7 * round),
                n: 3,
                value: 0.25,
            };
            rec.run(&kernel, Work::items(3), args);
            rec.copy(&a, 0, &b, 0, n);
        }
        Ok(())
    })?;
    gpu.wait(last)?;
    let result = gpu.download(&b, 0, n)?;
    if options.guard {
        assert_eq!(gpu.check_guards()?, []);
    }
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    Ok(result)
}

#[test]
fn derived_barriers_do_what_a_barrier_everywhere_does() -> Result<()> {
    let derived = chain(&GpuOptions::default())?;
    let n = 50_000;
    let mut b: Vec<f32> = Vec::new();
    for round in 0..20 {
        let mut a = vec![round as f32; n];
        b.clone_from(&a);
        b[1000 * round..][..500].fill(-(round as f32));
        a[n / 2..].copy_from_slice(&b[..n / 2]);
        a[n / 2 + 7 * round..][..3].fill(0.25);
        b.clone_from(&a);
    }
    assert!(derived == b);
    assert!(
        derived
            == chain(&GpuOptions {
                barrier_everywhere: true,
                ..GpuOptions::default()
            })?
    );
    assert!(derived == chain(&watched())?);
    Ok(())
}

#[test]
fn a_profile_counts_launches_operations_and_time() -> Result<()> {
    let gpu = Gpu::new(&GpuOptions {
        profile: true,
        validation: true,
        ..GpuOptions::default()
    })?;
    let sums = gpu.scratch::<f32>("sums", 1 << 11)?;
    let kernel = gpu.kernel(roof_fma::Shape::default())?;
    let other = kernel.labelled("other");
    let args = roof_fma::Args {
        sums: sums.ptr_mut(),
        n: 1 << 11,
        gain: 0.5,
        offset: 1.0,
    };
    let launch = |launches: u32| {
        gpu.submit("step", |rec| {
            for _ in 0..launches {
                rec.run(&kernel, Work::items(1 << 11).flops(8192.0).bytes(4.0), args);
            }
            rec.run(&other, Work::items(1 << 11).slices(3).flops(1e9), args); // cut into parts, and still one launch
            rec.fill(&sums, 0..16, 0);
            Ok(())
        })
    };
    launch(1)?; // a driver may compile now
    gpu.reset_profile()?;
    let before = gpu.now_ns();
    for launches in [300, 1, 299] {
        launch(launches)?;
    }
    let profile = gpu.profile()?;
    let after = gpu.now_ns();
    let row = |name: &str| {
        profile
            .rows
            .iter()
            .find(|row| row.name == name)
            .unwrap_or_else(|| panic!("{name}: {:?}", profile.rows))
    };
    assert_eq!(
        (
            row("roof_fma").launches,
            row("roof_fma other").launches,
            row("(fill)").launches
        ),
        (600, 3, 3)
    );
    let parts = profile
        .events
        .iter()
        .filter(|event| &*event.row == "roof_fma other");
    assert_eq!(parts.count(), 9, "three launches in three slices");
    assert_eq!(row("roof_fma").flops, 600.0 * 8192.0 * 2048.0);
    assert_eq!(row("roof_fma").bytes, 600.0 * 4.0 * 2048.0);
    let fma = row("roof_fma");
    assert!(
        0.0 < fma.min_ms
            && fma.min_ms <= fma.median_ms
            && fma.median_ms <= fma.max_ms
            && fma.max_ms <= fma.total_ms
    );
    let span_ms = (after - before) as f64 * 1e-6;
    let busy_ms: f64 = profile.rows.iter().map(|row| row.total_ms).sum();
    assert!(
        busy_ms <= span_ms + 5.0,
        "{busy_ms} ms of work in {span_ms} ms"
    );
    let slack = 50_000_000; // clocks agree to within an empty submission, on a busy machine
    let mut last = before - slack;
    for event in &profile.events {
        assert!(
            last <= event.begin_ns
                && event.begin_ns <= event.end_ns
                && event.end_ns <= after + slack,
            "{event:?} after {last}"
        );
        assert_eq!(&*event.call, "step");
        last = event.begin_ns;
    }
    gpu.reset_profile()?;
    assert!(gpu.profile()?.rows.is_empty());
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    Ok(())
}

#[test]
fn threads_share_a_device() -> Result<()> {
    let gpu = Gpu::new(&watched())?;
    std::thread::scope(|scope| {
        let workers: Vec<_> = (1..5u32).map(|n| (n, gpu.clone())).collect();
        let running: Vec<_> = workers
            .into_iter()
            .map(|(n, gpu)| {
                scope.spawn(move || (0..10).try_for_each(|i| fill_and_look(&gpu, 1000 * n + i)))
            })
            .collect();
        running
            .into_iter()
            .try_for_each(|worker| worker.join().expect("no panic"))
    })?;
    assert_eq!(gpu.check_guards()?, []);
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    Ok(())
}

#[test]
fn submitting_does_not_wait_for_the_device() -> Result<()> {
    let gpu = open()?;
    let sums = gpu.scratch::<f32>("sums", 1 << 16)?;
    let kernel = gpu.kernel(roof_fma::Shape { rounds: 1500 })?;
    let launch = || {
        gpu.submit("long", |rec| {
            let args = roof_fma::Args {
                sums: sums.ptr_mut(),
                n: 1 << 16,
                gain: 0.5,
                offset: 1.0,
            };
            rec.run(&kernel, Work::items(1 << 16).flops(1.0), args);
            Ok(())
        })
    };
    gpu.wait(launch()?)?;
    let ticket = launch()?;
    let was_done = gpu.is_done(ticket)?;
    gpu.finish()?;
    assert!(gpu.is_done(ticket)?);
    assert!(!was_done, "long work was done when submit returned");
    Ok(())
}
