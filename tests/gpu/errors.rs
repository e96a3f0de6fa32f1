//! What is refused, and how it is said.

use crate::{fill_and_look, open, watched};
use neurodin::gpu::{Gpu, GpuOptions, Work};
use neurodin::kernels::fill;
use neurodin::{Error, Result};

#[test]
fn what_does_not_fit_is_refused_with_its_numbers() -> Result<()> {
    let gpu = open()?;
    let held = gpu.buffer::<f32>("parameters", 1 << 20)?;
    let beyond = gpu.info().max_buffer / 4 + 1;
    let error = gpu
        .buffer::<f32>("table", beyond)
        .expect_err("larger than any buffer");
    assert!(matches!(error, Error::OutOfMemory { .. }), "{error}");
    let text = error.to_string();
    assert!(
        text.contains("'table'") && text.contains("GiB") && text.contains("next:"),
        "{text}"
    );
    let error = gpu
        .buffer::<f32>("table", u64::MAX / 4)
        .expect_err("larger than any address");
    assert!(matches!(error, Error::OutOfMemory { .. }), "{error}");
    drop(held);

    // A limit of 16 MiB takes three buffers of 4 MiB with their padding, and a fourth when one of them goes.
    let gpu = Gpu::new(&GpuOptions {
        memory_limit: Some(16 << 20),
        ..watched()
    })?;
    let four = |name: &str| gpu.buffer::<f32>(name, 1 << 20);
    let (_a, b, c) = (four("a")?, four("b")?, four("c")?);
    let error = four("d").expect_err("more than the limit");
    let text = error.to_string();
    assert!(matches!(error, Error::OutOfMemory { .. }), "{text}");
    assert!(
        text.contains("'d' needs 4.0 MiB; of 16.0 MiB")
            && text.contains("held: a 4.0 MiB, b 4.0 MiB"),
        "{text}"
    );
    drop(b);
    let d = four("d")?;
    assert_eq!(gpu.download(&c, 0, 1)?, gpu.download(&d, 0, 1)?);
    assert_eq!(gpu.memory_plan().budget, 16 << 20);
    Ok(())
}

#[test]
fn compiled_pipelines_are_kept_and_a_broken_file_does_no_harm() -> Result<()> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = GpuOptions {
        cache_dir: Some(folder.path().join("pipelines")),
        validation: true,
        ..GpuOptions::default()
    };
    let files = || -> Vec<_> {
        let entries =
            std::fs::read_dir(folder.path().join("pipelines")).expect("the folder was made");
        entries
            .map(|entry| entry.expect("it can be listed").path())
            .collect()
    };
    for _ in 0..2 {
        let gpu = Gpu::new(&options)?;
        fill_and_look(&gpu, 100)?;
        drop(gpu);
        assert_eq!(files().len(), 1);
    }
    let file = &files()[0];
    let good = std::fs::read(file).expect("written");
    for broken in [Vec::new(), vec![0xff; 100], good[..good.len() / 2].to_vec()] {
        std::fs::write(file, broken).expect("writable");
        let gpu = Gpu::new(&options)?;
        fill_and_look(&gpu, 100)?;
        assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    }
    Ok(())
}

#[test]
fn an_unknown_device_is_refused_with_the_list() -> Result<()> {
    let devices = Gpu::list()?;
    // A number is one of the list's, even where a name has it (llvmpipe's has its compiler's version).
    for unknown in ["no such device", "", "15", "19", "99"] {
        let options = GpuOptions {
            device: Some(unknown.into()),
            ..GpuOptions::default()
        };
        let error = Gpu::new(&options).expect_err("there is no such device");
        assert!(matches!(error, Error::NoDevice { .. }));
        let text = error.to_string();
        assert!(
            text.contains(unknown) && text.contains(&devices[0].name),
            "{text}"
        );
    }
    // By number, and by part of its name in another case.
    let able = devices
        .iter()
        .find(|device| device.missing.is_empty())
        .expect("one that can");
    let named = able.name.to_uppercase();
    for wanted in [able.index.to_string(), named[..named.len() / 2].to_string()] {
        let gpu = Gpu::new(&GpuOptions {
            device: Some(wanted),
            ..GpuOptions::default()
        })?;
        assert_eq!(gpu.info().name, able.name);
    }
    Ok(())
}

#[test]
fn what_was_left_out_on_request_is_not_blamed_on_the_device() -> Result<()> {
    let deterministic = |portable| {
        Gpu::new(&GpuOptions {
            deterministic: true,
            portable,
            ..GpuOptions::default()
        })
    };
    let device_lacks_it = deterministic(false).is_err();
    let error = deterministic(true).expect_err("portable leaves 64-bit integers out");
    assert!(matches!(error, Error::NoDevice { .. }));
    let text = error.to_string();
    assert_eq!(
        text.contains("GpuOptions::portable"),
        !device_lacks_it,
        "{text}"
    );
    assert!(text.contains("next: "), "{text}");
    Ok(())
}

#[test]
fn a_failed_recording_says_so_and_the_device_works_on() -> Result<()> {
    let gpu = Gpu::new(&watched())?;
    let words = gpu.buffer::<u32>("words", 16)?;
    let failed = gpu.submit("fails", |rec| {
        rec.fill(&words, 0..16, 9);
        Err(Error::Numerical {
            what: "stop".into(),
        })
    });
    assert!(matches!(failed, Err(Error::Numerical { .. })));
    assert_eq!(gpu.download(&words, 0, 16)?, [0; 16]);
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    Ok(())
}

/// What a closure that must panic says.
fn panic_of(action: impl FnOnce()) -> String {
    let payload = std::panic::catch_unwind(std::panic::AssertUnwindSafe(action));
    let payload = payload.expect_err("must panic");
    payload
        .downcast_ref::<String>()
        .cloned()
        .unwrap_or_default()
}

#[test]
fn broken_invariants_name_themselves() -> Result<()> {
    let gpu = open()?;
    let words = gpu.buffer::<f32>("words", 16)?;
    let kernel = gpu.kernel(fill::Shape::default())?;
    let gone = gpu.buffer::<f32>("gone", 16)?.ptr_mut();
    let run = |items: u64, values| {
        let _ = gpu.submit("broken", |rec| {
            rec.run(
                &kernel,
                Work::items(items),
                fill::Args {
                    values,
                    n: 16,
                    value: 0.0,
                },
            );
            Ok(())
        });
    };
    let text = panic_of(|| run(16, gone));
    assert!(
        text.contains("fill: pointer values") && text.contains("no living buffer"),
        "{text}"
    );
    let text = panic_of(|| run(u64::MAX / 128, words.ptr_mut()));
    assert!(text.contains("rows of workgroups"), "{text}");
    let text = panic_of(|| {
        let _ = gpu.submit("outer", |_| gpu.upload(&words, 0, &[1.0]));
    });
    assert!(text.contains("inside another submit"), "{text}");
    let text = panic_of(|| {
        let _ = words.at(17);
    });
    assert!(text.contains("words: element 17 of 16"), "{text}");
    // And the device works on after every one of them.
    fill_and_look(&gpu, 1000)
}
