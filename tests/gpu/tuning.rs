//! Ways of doing the same are compared once.

use neurodin::Result;
use neurodin::gpu::{Gpu, GpuOptions, Work};
use neurodin::kernels::roof_fma;

/// Asks which of a long and a short kernel is faster; also whether they had to be tried.
fn ask(gpu: &Gpu, ways: [&str; 2]) -> Result<(usize, bool)> {
    let mut tried = false;
    let prepare = || {
        tried = true;
        let kernel = |rounds| gpu.kernel(roof_fma::Shape { rounds });
        Ok((
            [kernel(4000)?, kernel(1)?],
            gpu.scratch::<f32>("sums", 256)?,
        ))
    };
    let chosen = gpu.fastest(
        "sums",
        &ways.map(String::from),
        prepare,
        |(kernels, sums), way, rec| {
            let args = roof_fma::Args {
                sums: sums.ptr_mut(),
                n: 256,
                gain: 1.0,
                offset: 0.5,
            };
            rec.run(&kernels[way], Work::items(256), args);
        },
    )?;
    Ok((chosen, tried))
}

#[test]
fn the_fastest_way_is_found_once() -> Result<()> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = GpuOptions {
        autotune: true,
        cache_dir: Some(folder.path().join("cache")),
        ..GpuOptions::default()
    };
    let ways = ["long", "short"];
    let gpu = Gpu::new(&options)?;
    assert_eq!(ask(&gpu, ways)?, (1, true));
    assert_eq!(ask(&gpu, ways)?, (1, false));
    // At the next start the answer is known, by name.
    let again = Gpu::new(&options)?;
    assert_eq!(ask(&again, ways)?, (1, false));
    assert_eq!(ask(&again, ["short", "long"])?, (0, false));
    assert_eq!(
        ask(&again, ["long", "another"])?,
        (1, true),
        "a new way is tried"
    );
    assert_eq!(
        ask(&again, ["another", "short"])?,
        (1, true),
        "the fastest of others is no answer"
    );
    assert_eq!(ask(&again, ways)?, (1, false), "nor is that one forgotten");
    // What was measured with other kernels is no answer.
    let file = std::fs::read_dir(folder.path().join("cache"))
        .expect("the folder of the cache")
        .map(|entry| entry.expect("an entry").path())
        .find(|path| {
            path.extension()
                .is_some_and(|extension| extension == "json")
        })
        .expect("a file of answers");
    let text = std::fs::read_to_string(&file).expect("the answers");
    let mut kept: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    kept["kernels"] = "others".into();
    std::fs::write(&file, kept.to_string()).expect("written");
    assert_eq!(ask(&Gpu::new(&options)?, ["long", "another"])?, (1, true));
    Ok(())
}

#[test]
fn without_tuning_it_is_the_first() -> Result<()> {
    assert_eq!(
        ask(&Gpu::new(&GpuOptions::default())?, ["long", "short"])?,
        (0, false)
    );
    let deterministic = GpuOptions {
        autotune: true,
        deterministic: true,
        ..GpuOptions::default()
    };
    match Gpu::new(&deterministic) {
        Ok(gpu) => assert_eq!(ask(&gpu, ["long", "short"])?, (0, false)),
        Err(error) => println!("skipped: {error}"),
    }
    Ok(())
}

#[test]
fn a_wanted_way_is_taken_unmeasured() -> Result<()> {
    let wants = |way: &str| {
        Gpu::new(&GpuOptions {
            autotune: true,
            ways: vec![way.into()],
            ..GpuOptions::default()
        })
    };
    assert_eq!(ask(&wants("long")?, ["short", "long"])?, (1, false));
    assert_eq!(ask(&wants("another")?, ["long", "short"])?, (1, true));
    Ok(())
}
