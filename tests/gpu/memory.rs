//! Memory: round trips, first content, guard words, readbacks, lifetimes.

use crate::{numbers, open, watched};
use neurodin::Result;
use neurodin::gpu::{Buffer, Gpu, Work};
use neurodin::kernels::fill;

#[test]
fn a_round_trip_of_more_than_128_mib_keeps_every_word() -> Result<()> {
    let gpu = open()?;
    let n = (150 << 20) / 4;
    let words = numbers(n);
    let (buffer, copy) = (
        gpu.buffer::<u32>("words", n)?,
        gpu.buffer::<u32>("copy", n)?,
    );
    gpu.upload(&buffer, 0, &words)?;
    gpu.submit("copy", |rec| {
        rec.copy(&buffer, 0, &copy, 0, n);
        Ok(())
    })?;
    assert!(gpu.download(&copy, 0, n)? == words);
    assert_eq!(gpu.download(&copy, n - 3, 3)?, words[n as usize - 3..]);
    // By pointer, over the whole of it and from its middle on.
    let kernel = gpu.kernel(fill::Shape::default())?;
    let middle = n / 2 + 1;
    gpu.submit("fill", |rec| {
        let args = fill::Args {
            values: copy.at_mut(middle).cast(),
            n: (n - middle) as u32,
            value: -2.0,
        };
        rec.run(&kernel, Work::items(n - middle), args);
        Ok(())
    })?;
    let back = gpu.download(&copy, 0, n)?;
    assert!(back[..middle as usize] == words[..middle as usize]);
    assert!(
        back[middle as usize..]
            .iter()
            .all(|&word| word == (-2.0f32).to_bits())
    );
    Ok(())
}

#[test]
fn a_write_past_the_end_is_found_and_named() -> Result<()> {
    let gpu = Gpu::new(&watched())?;
    let (whole, broken) = (
        gpu.buffer::<f32>("whole", 333)?,
        gpu.scratch::<f32>("broken", 333)?,
    );
    let kernel = gpu.kernel(fill::Shape::default())?;
    let fill = |buffer: &Buffer<f32>, n| {
        gpu.submit("fill", |rec| {
            rec.run(
                &kernel,
                Work::items(n as u64),
                fill::Args {
                    values: buffer.ptr_mut(),
                    n,
                    value: 3.0,
                },
            );
            Ok(())
        })
    };
    fill(&whole, 333)?;
    assert_eq!(gpu.check_guards()?, []);
    fill(&broken, 334)?;
    let overruns = gpu.check_guards()?;
    assert_eq!(overruns.len(), 1);
    let found = &overruns[0];
    assert_eq!(
        (found.buffer.as_str(), found.bytes, found.first, found.words),
        ("broken", 4 * 333, 0, 1)
    );
    assert_eq!(found.value, 3.0f32.to_bits());
    assert!(
        found.to_string().contains("'broken' of 1332 bytes"),
        "{found}"
    );
    Ok(())
}

#[test]
fn buffers_are_zero_and_scratch_is_poisoned_in_guard_mode() -> Result<()> {
    let gpu = Gpu::new(&watched())?;
    // What an earlier tenant leaves behind must not show.
    let earlier = gpu.buffer::<f32>("earlier", 5000)?;
    gpu.upload(&earlier, 0, &vec![7.0; 5000])?;
    drop(earlier);
    assert_eq!(
        gpu.download(&gpu.buffer::<f32>("zero", 5001)?, 0, 5001)?,
        vec![0.0; 5001]
    );
    let scratch = gpu.download(&gpu.scratch::<f32>("scratch", 5001)?, 0, 5001)?;
    assert!(scratch.iter().all(|v| v.is_nan()));
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    Ok(())
}

#[test]
fn a_readback_is_read_without_waiting_for_later_work() -> Result<()> {
    let gpu = Gpu::new(&watched())?;
    let ring = gpu.readback::<f32>("losses", 8)?;
    let losses = gpu.buffer::<f32>("losses on the device", 2)?;
    let kernel = gpu.kernel(fill::Shape::default())?;
    let mut tickets = Vec::new();
    for step in 0..4u64 {
        tickets.push(gpu.submit("step", |rec| {
            let args = fill::Args {
                values: losses.ptr_mut(),
                n: 2,
                value: step as f32 + 0.5,
            };
            rec.run(&kernel, Work::items(2), args);
            match step % 2 {
                0 => rec.copy(&losses, 0, &ring, 2 * step, 2),
                _ => rec.run(
                    &kernel,
                    Work::items(2),
                    fill::Args {
                        values: ring.at_mut(2 * step),
                        ..args
                    },
                ),
            }
            Ok(())
        })?);
    }
    for (step, ticket) in tickets.into_iter().enumerate() {
        gpu.wait(ticket)?;
        assert!(gpu.is_done(ticket)?);
        let step = step as u64;
        assert_eq!(ring.read(2 * step..2 * step + 2), [step as f32 + 0.5; 2]);
    }
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    Ok(())
}

#[test]
fn memory_dropped_in_flight_lives_until_its_work_is_done() -> Result<()> {
    let gpu = Gpu::new(&watched())?;
    let log = gpu.validation_log();
    let kept = gpu.buffer::<u32>("kept", 1 << 20)?;
    for round in 0..10u32 {
        let passing = gpu.scratch::<u32>("passing", 1 << 20)?;
        gpu.submit("pass", |rec| {
            rec.fill(&passing, 0..1 << 20, round);
            rec.copy(&passing, 0, &kept, 0, 1 << 20);
            drop(passing); // while it is being recorded
            Ok(())
        })?;
        let plan = gpu.memory_plan();
        assert_eq!(plan.buffers, [("kept".to_string(), 4 << 20)]);
        assert!(plan.total > 4 << 20 && plan.budget > plan.total, "{plan}");
    }
    assert_eq!(gpu.download(&kept, (1 << 20) - 1, 1)?, [9]);
    drop((kept, gpu));
    assert_eq!(log.messages(), Vec::<String>::new());
    Ok(())
}
