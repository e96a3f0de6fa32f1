//! Going on from a checkpoint is going on: the same state, and the same next step.

use glam::{DMat4, DVec3};
use neurodin::config::Config;
use neurodin::gpu::{Gpu, GpuOptions};
use neurodin::mesh::Field;
use neurodin::scene::{Region, RegionShape, Scene, SceneOptions};
use neurodin::train::Trainer;
use neurodin::train::checkpoint::Checkpoint;
use neurodin::train::report::{Control, Event};
use neurodin::train::run_directory::{RunDirectory, SceneRecord};
use neurodin::train::trained::Trained;
use std::fs;
use std::path::Path;

/// Nine pictures of coloured noise from a ring of cameras.
fn scene(folder: &Path) -> Scene {
    let mut frames = Vec::new();
    for view in 0..9u32 {
        let turned = DMat4::from_rotation_y(f64::from(view) * 0.7);
        let pose = turned * DMat4::from_translation(DVec3::new(0.0, 0.0, 3.0));
        let rows: Vec<[f64; 4]> = (0..4).map(|row| pose.row(row).to_array()).collect();
        let name = format!("view{view}.png");
        image::RgbImage::from_fn(20, 16, |x, y| {
            image::Rgb([7, 11, 13].map(|prime| ((x * prime + y * 5 + view * 29) % 256) as u8))
        })
        .save(folder.join(&name))
        .unwrap();
        frames.push(serde_json::json!({ "file_path": name, "transform_matrix": rows }));
    }
    let transforms = serde_json::json!({
        "w": 20, "h": 16, "fl_x": 18.0, "fl_y": 18.0, "cx": 10.0, "cy": 8.0,
        "sphere_center": [0.0, 0.0, 0.0], "sphere_radius": 1.0, "frames": frames,
    });
    fs::write(folder.join("transforms.json"), transforms.to_string()).unwrap();
    Scene::open(folder, &SceneOptions::default()).unwrap()
}

fn sphere(radius: f64) -> Region {
    Region {
        center: DVec3::ZERO,
        radius,
        shape: RegionShape::Sphere,
        how: "stated".into(),
    }
}

/// Trains to the end; what it warns of on the way.
fn run_to_the_end(trainer: &mut Trainer, scene: &Scene, run: &RunDirectory) -> Vec<String> {
    let mut warnings = Vec::new();
    let mut tell = |event: Event| {
        if let Event::Warning { what, .. } = event {
            warnings.push(what);
        }
        Control::Continue
    };
    trainer.run(scene, run, &mut tell).unwrap();
    warnings
}

#[test]
fn a_restored_run_takes_the_same_next_step() {
    restored_takes_the_same_next_step(&of_every_kind());
}

#[test]
fn a_restored_run_looks_up_its_own_table_in_float16() {
    let with_copy = of_every_kind().with_assignment("hash.half=true").unwrap();
    restored_takes_the_same_next_step(&with_copy);
}

fn restored_takes_the_same_next_step(config: &Config) {
    let folder = tempfile::tempdir().unwrap();
    let scene = scene(folder.path());
    let region = sphere(1.1);
    let gpu = Gpu::new(&GpuOptions::default()).unwrap();
    let mut first = Trainer::new(&gpu, &scene, &region, config).unwrap();
    for _ in 0..6 {
        first.step().unwrap();
    }
    assert!(first.model().table.is_some());
    let saved = first.save(&folder.path().join("first")).unwrap();
    let begun_anew = Checkpoint::open(&saved).unwrap();
    let moved = |name: &str| begun_anew.tensor(name).unwrap().1.iter().any(|x| *x != 0.0);
    assert!(
        moved("second_moment.surface.table") && moved("first_moment.appearance"),
        "it has trained"
    );

    let mut second = Trainer::new(&gpu, &scene, &region, config).unwrap();
    second.restore(&begun_anew).unwrap();
    assert_eq!(second.steps_done(), 6);
    let again = second.save(&folder.path().join("second")).unwrap();
    assert!(
        fs::read(&saved).unwrap() == fs::read(&again).unwrap(),
        "saved, restored, saved: the same bytes"
    );

    // Losses are summed in a fixed order, so the next step's are equal to the last bit; after it, gradients meet in any order.
    first.step().unwrap();
    second.step().unwrap();
    let (first, second) = (
        first.finish().unwrap().unwrap(),
        second.finish().unwrap().unwrap(),
    );
    assert_eq!((first.step, second.step), (6, 6));
    assert_eq!(first.values, second.values);
    assert!(
        first.values.iter().all(|value| value.is_finite()),
        "{first:?}"
    );
}

#[test]
fn an_opened_run_looks_up_its_own_table_in_float16() {
    let config = of_every_kind().with_assignment("hash.half=true").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (scene, region) = (scene(folder.path()), sphere(1.1));
    let gpu = Gpu::new(&GpuOptions::default()).unwrap();
    let mut trainer = Trainer::new(&gpu, &scene, &region, &config).unwrap();
    for _ in 0..6 {
        trainer.step().unwrap();
    }
    let run = RunDirectory::create(&folder.path().join("run"), false).unwrap();
    trainer.save(&run.checkpoints()).unwrap();
    let record = SceneRecord::new(folder.path(), &scene, &region).unwrap();
    run.write(&run.scene(), &record.to_json()).unwrap();
    let trained = Trained::open(&gpu, &run).unwrap();

    let points: Vec<[f32; 3]> = (0..200u8)
        .map(|i| [7u8, 31, 83].map(|prime| f32::from(i.wrapping_mul(prime)) / 160.0 - 0.8))
        .collect();
    let ask = |model, now| {
        let mut field = Field::new(&gpu, &config, model, now).unwrap();
        field.sdf(&points).unwrap()
    };
    let was = ask(trainer.model(), trainer.annealed());
    assert_eq!(ask(&trained.model, trained.annealed()), was);
}

/// Every kind of parameter there is: codes, a background field, both proposals, and a table of which a step leaves a part alone.
fn of_every_kind() -> Config {
    let settings = "steps = 40\nrays = 32\nappearance.dims = 8\nbackground.kind = 'field'\nbackground.samples = 8\nhash.levels = 4\nhash.log2_size = 17";
    Config::preset("outdoor-tiny")
        .and_then(|config| config.with_toml(settings, "test"))
        .and_then(Config::validated)
        .unwrap()
}

#[test]
fn deterministic_runs_are_the_same_to_the_bit() {
    let folder = tempfile::tempdir().unwrap();
    let scene = scene(folder.path());
    let region = sphere(1.1);
    let gpu = |deterministic| {
        Gpu::new(&GpuOptions {
            deterministic,
            validation: true,
            guard: true,
            ..GpuOptions::default()
        })
        .unwrap()
    };
    let (fixed, floating) = (gpu(true), gpu(false));
    let one = of_every_kind();
    let two = one.second_stage().unwrap();
    for (stage, config) in [("1", one), ("2", two)] {
        let trained = |gpu: &Gpu, name: &str, from: Option<&Checkpoint>, steps: u64| {
            let mut config = config.clone();
            config.deterministic = gpu.deterministic();
            let mut trainer = Trainer::new(gpu, &scene, &region, &config).unwrap();
            if let Some(from) = from {
                trainer.restore(from).unwrap();
            }
            for _ in 0..steps {
                trainer.step().unwrap();
            }
            trainer.finish().unwrap();
            assert_eq!(gpu.check_guards().unwrap(), []);
            let saved = trainer.save(&folder.path().join(stage).join(name)).unwrap();
            Checkpoint::open(&saved).unwrap()
        };
        let bytes = |checkpoint: &Checkpoint| fs::read(checkpoint.path()).unwrap();
        let middle = trained(&fixed, "middle", None, 8);
        let again = trained(&fixed, "again", None, 8);
        assert!(bytes(&middle) == bytes(&again), "stage {stage}: run again");
        let end = trained(&fixed, "end", Some(&middle), 8);
        let resumed = trained(&fixed, "resumed", Some(&again), 8);
        assert!(bytes(&end) == bytes(&resumed), "stage {stage}: resumed");

        // After one step the first moments are gradients.
        let gradients = |gpu: &Gpu, name: &str| -> Vec<f64> {
            let checkpoint = trained(gpu, name, None, 1);
            let spans = ["surface.table", "surface.hidden.v", "proposal.0.table"].iter();
            spans
                .flat_map(|span| {
                    let (_, values) = checkpoint.tensor(&format!("first_moment.{span}")).unwrap();
                    values.iter().map(|&x| f64::from(x)).collect::<Vec<_>>()
                })
                .collect()
        };
        let (sums, floats) = (gradients(&fixed, "fixed"), gradients(&floating, "floating"));
        let pairs = sums.iter().zip(&floats);
        let error: f64 = pairs.map(|(a, b)| (a - b).powi(2)).sum();
        let norm: f64 = floats.iter().map(|b| b.powi(2)).sum();
        assert!(
            norm > 0.0 && error <= 1e-10 * norm,
            "stage {stage}: {error:e} of {norm:e}"
        );
    }
    let mut unlike = of_every_kind();
    unlike.deterministic = true;
    let refused = Trainer::new(&floating, &scene, &region, &unlike)
        .err()
        .unwrap();
    assert!(
        refused.to_string().contains("deterministic = true"),
        "{refused}"
    );
    for gpu in [fixed, floating] {
        assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    }
}

#[test]
fn losses_that_are_not_finite_lead_back_to_the_last_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let scene = scene(folder.path());
    let region = sphere(1.1);
    let settings = "steps = 30\nrays = 16\nhash.levels = 4\nhash.log2_size = 10\nreport.preview_steps = 0\nreport.checkpoint_steps = 5";
    let config = Config::preset("outdoor-tiny")
        .and_then(|config| config.with_toml(settings, "test"))
        .unwrap();
    let gpu = Gpu::new(&GpuOptions::default()).unwrap();
    let trained = |steps: u64| {
        let mut trainer = Trainer::new(&gpu, &scene, &region, &config).unwrap();
        for _ in 0..steps {
            trainer.step().unwrap();
        }
        trainer.finish().unwrap();
        trainer
    };
    let poison = |trainer: &Trainer| {
        let params = &trainer.model().params;
        let mut spans = params.spans().iter();
        let bias = spans
            .find(|span| span.name == "surface.heads.bias")
            .unwrap();
        gpu.upload(params.values(), bias.first, &[f32::NAN])
            .unwrap();
    };
    let run = RunDirectory::create(&folder.path().join("run"), false).unwrap();
    let mut trainer = trained(3);
    trainer.save(&run.checkpoints()).unwrap();
    poison(&trainer);
    let warnings = run_to_the_end(&mut trainer, &scene, &run);
    assert_eq!(trainer.steps_done(), 30);
    let losses = trainer.finish().unwrap().unwrap();
    assert!(
        losses.values.iter().all(|value| value.is_finite()),
        "{losses:?}"
    );
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    assert!(
        warnings[0].contains("checkpoint of step 3 "),
        "{warnings:?}"
    );
    let last = neurodin::train::checkpoint::latest(&run.checkpoints()).unwrap();
    let mut again = trained(0);
    again.restore(&last.checkpoint).unwrap();
    let saved = again.save(&folder.path().join("again")).unwrap();
    assert!(
        fs::read(saved).unwrap() == fs::read(last.checkpoint.path()).unwrap(),
        "the smaller learning rates are part of the state"
    );

    // Without a checkpoint there is nothing to go back to.
    let run = RunDirectory::create(&folder.path().join("empty"), false).unwrap();
    let mut trainer = trained(1);
    poison(&trainer);
    let error = trainer
        .run(&scene, &run, &mut |_| Control::Continue)
        .unwrap_err();
    assert_eq!(error.exit_code(), 7);
    let text = error.to_string();
    assert!(text.contains("not been finite for 10 steps"), "{text}");
}

/// A preview is for people: a run goes on without it.
#[test]
fn a_preview_that_cannot_be_written_ends_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let scene = scene(folder.path());
    let gpu = Gpu::new(&GpuOptions::default()).unwrap();
    let config = of_every_kind().with_toml("steps = 6\nreport.preview_steps = 3", "test");
    let config = config.and_then(Config::validated).unwrap();
    let run = RunDirectory::create(&folder.path().join("run"), false).unwrap();
    fs::remove_dir(run.previews()).unwrap();
    let mut trainer = Trainer::new(&gpu, &scene, &sphere(1.1), &config).unwrap();
    let warnings = run_to_the_end(&mut trainer, &scene, &run);
    assert_eq!(trainer.steps_done(), 6);
    assert_eq!(warnings.len(), 2, "{warnings:?}");
    assert!(warnings[0].contains("no preview"), "{warnings:?}");
}

/// What the second stage goes back to before its own first checkpoint is the end of the first stage: its parameters, but not its moments.
#[test]
fn a_second_stage_that_goes_back_begins_anew() {
    let folder = tempfile::tempdir().unwrap();
    let scene = scene(folder.path());
    let settings = "deterministic = true\nsteps = 6\nrays = 16\nhash.levels = 4\nhash.log2_size = 17\nreport.preview_steps = 0";
    let config = Config::preset("outdoor-tiny")
        .and_then(|config| config.with_toml(settings, "test"))
        .unwrap();
    let gpu = Gpu::new(&GpuOptions {
        deterministic: true,
        ..GpuOptions::default()
    })
    .unwrap();
    let run = RunDirectory::create(&folder.path().join("run"), false).unwrap();
    let mut first = Trainer::new(&gpu, &scene, &sphere(1.1), &config).unwrap();
    first.run(&scene, &run, &mut |_| Control::Continue).unwrap();
    let mut second = first.next_stage(&scene, &run).unwrap().unwrap();
    let begin = second.steps_done();
    second.step().unwrap();
    let straight = second.save(&folder.path().join("straight")).unwrap();
    let end_of_first = neurodin::train::checkpoint::latest(&run.checkpoints()).unwrap();
    second.begin_from(&end_of_first.checkpoint).unwrap();

    let params = &second.model().params;
    gpu.upload(params.values(), 0, &[f32::NAN]).unwrap();
    let mut back = false;
    let mut tell = |event: Event| {
        back |= matches!(event, Event::Warning { .. });
        match back && matches!(event, Event::Advanced { .. }) {
            true => Control::Stop,
            false => Control::Continue,
        }
    };
    let stopped = second.run(&scene, &run, &mut tell).unwrap_err();
    assert_eq!(stopped.exit_code(), 130, "{stopped}");
    let newest = neurodin::train::checkpoint::latest(&run.checkpoints()).unwrap();
    let (back, straight) = (newest.checkpoint, Checkpoint::open(&straight).unwrap());
    assert_eq!(back.state().step, begin + 1);
    assert_eq!(straight.state().step, begin + 1);
    for span in ["surface.table", "surface.hidden.v", "proposal.0.table"] {
        for moment in ["first_moment", "second_moment"] {
            let name = format!("{moment}.{span}");
            let [(_, back), (_, straight)] =
                [&back, &straight].map(|checkpoint| checkpoint.tensor(&name).unwrap());
            assert!(straight.iter().any(|&x| x != 0.0), "{name}");
            assert!(back == straight, "{name}");
        }
    }
}

#[test]
fn a_checkpoint_of_another_region_or_model_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let scene = scene(folder.path());
    let config = Config::preset("outdoor-tiny")
        .and_then(|config| config.with_toml("rays = 16\nhash.log2_size = 10", "test"))
        .unwrap();
    let gpu = Gpu::new(&GpuOptions::default()).unwrap();
    let saved = Trainer::new(&gpu, &scene, &sphere(1.0), &config)
        .and_then(|trainer| trainer.save(folder.path()))
        .unwrap();
    let checkpoint = Checkpoint::open(&saved).unwrap();
    let refusal = |radius: f64, setting: &str| {
        let config = config.clone().with_assignment(setting).unwrap();
        let mut other = Trainer::new(&gpu, &scene, &sphere(radius), &config).unwrap();
        let error = other.restore(&checkpoint).unwrap_err();
        assert_eq!(error.exit_code(), 3);
        error.to_string()
    };
    assert!(refusal(2.0, "rays=16").contains("another region"));
    let other_model = refusal(1.0, "hash.log2_size=11");
    assert!(other_model.contains("surface.table"), "{other_model}");
}
