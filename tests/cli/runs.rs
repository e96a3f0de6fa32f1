//! Small runs: from photographs to mesh and scores, stopped and resumed.

use super::{SMALL, fails, logged, neurodin, run, said, write_dataset};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// From photographs to mesh and scores, interrupted and resumed on the way.
#[test]
fn a_run_from_photographs_to_mesh() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_dataset(&root.join("photos"));
    let path = |name: &str| root.join(name).to_str().unwrap().to_string();
    let (photos, out) = (path("photos"), path("run"));
    let train = |more: &[&str]| {
        let words = [
            &["train", &photos, "--out", &out, "--preset", "outdoor-tiny"],
            &SMALL[..],
            more,
        ];
        neurodin(&words.concat())
    };

    // A dry run says what it would do, in full, and writes nothing.
    let dry = said(
        train(&["--steps", "12", "--dry-run", "--json"])
            .output()
            .unwrap(),
    );
    assert_eq!(dry.code, Some(0), "{}", dry.stderr);
    let result: Value = serde_json::from_str(&dry.stdout).unwrap();
    assert_eq!(result["config"]["steps"], 9);
    assert_eq!(result["config"]["stage2"]["steps"], 3);
    assert!(!root.join("run").exists());

    let whole = said(
        train(&[
            "--steps",
            "12",
            "--set",
            "report.log_steps=1",
            "--json",
            "--quiet",
        ])
        .output()
        .unwrap(),
    );
    assert_eq!((whole.code, whole.stderr.as_str()), (Some(0), ""));
    let result: Value = serde_json::from_str(&whole.stdout).unwrap();
    assert_eq!(result["step"], 12);
    let run_folder = root.join("run");
    for file in [
        "config.toml",
        "scene.json",
        "log.jsonl",
        "previews/step-00000004.png",
        "ckpt/step-00000012.safetensors",
    ] {
        assert!(run_folder.join(file).is_file(), "{file}");
    }
    let steps = logged(&run_folder, "step");
    assert!(steps.len() >= 5, "{steps:?}");
    assert!(
        steps
            .iter()
            .all(|record| record["loss.total"].is_f64() && record["psnr"].is_f64())
    );
    assert_eq!(logged(&run_folder, "finished").len(), 1);

    // Longer by --resume; a setting that does not fit is refused by name, one that changes the course is told.
    let refused = fails(
        &["train", "--out", &out, "--resume", "--set", "hash.levels=5"],
        3,
        &["hash.levels: 4 -> 5", "next:"],
    );
    assert!(!refused.contains("panic"), "{refused}");
    // The same flags again mean the same, although the run is in its second stage by now.
    let longer = ["--resume", "--steps", "16", "--set", "loss.eikonal=0.02"];
    let longer = said(train(&longer).output().unwrap());
    assert_eq!(longer.code, Some(0), "{}", longer.stderr);
    let told: Vec<&str> = (longer.stderr.lines())
        .filter(|line| line.contains("changed setting"))
        .collect();
    assert_eq!(told.len(), 2, "{told:?}");
    assert!(told[0].contains("steps: 3 -> 7"), "{told:?}");
    assert!(
        told[1].contains("loss.eikonal: 0.01 -> 0.02: without effect"),
        "{told:?}"
    );
    let text = fs::read_to_string(run_folder.join("config.toml")).unwrap();
    let kept: toml::Table = text.parse().unwrap();
    assert_eq!(kept["steps"].as_integer(), Some(9));
    assert_eq!(kept["stage2"]["steps"].as_integer(), Some(7));
    let first = ["train", "--out", &out, "--resume", "--stage", "1"];
    fails(&first, 3, &["--stage 1", "9 steps"]);
    assert_eq!(logged(&run_folder, "resumed")[0]["step"], 12);

    // A damaged checkpoint is refused, and the one before taken.
    let newest = run_folder.join("ckpt/step-00000016.safetensors");
    let mut bytes = fs::read(&newest).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&newest, bytes).unwrap();
    let meshed = run(&["mesh", &out, "--resolution", "24", "--json"]);
    assert!(
        meshed.stderr.contains("step-00000016") && meshed.stderr.contains("damaged"),
        "{}",
        meshed.stderr
    );
    assert_eq!(meshed.code, Some(0), "{}", meshed.stderr);
    let result: Value = serde_json::from_str(&meshed.stdout).unwrap();
    assert_eq!(result["step"], 12);
    assert!(result["faces"].as_u64().unwrap() > 100, "{result}");
    fails(
        &["mesh", &out, "--resolution", "24"],
        8,
        &["mesh.ply", "exists"],
    );

    // What the flags left nothing of is not the field's fault.
    let none = path("none.ply");
    let small = ["mesh", &out, "-o", &none, "--resolution", "24"];
    for flag in [
        ["--crop", "50,50,50,51,51,51"],
        ["--min-faces", "100000000"],
    ] {
        fails(&[&small[..], &flag[..]].concat(), 3, &flag);
        assert!(!Path::new(&none).exists());
    }

    let pictures = path("pictures");
    let rendered = run(&[
        "render",
        &out,
        "--out",
        &pictures,
        "--what",
        "rgb,depth,normal",
        "--json",
    ]);
    assert_eq!(rendered.code, Some(0), "{}", rendered.stderr);
    let result: Value = serde_json::from_str(&rendered.stdout).unwrap();
    let files = result["files"].as_array().unwrap();
    assert_eq!(files.len(), 5 * result["views"].as_array().unwrap().len());
    assert!(
        files
            .iter()
            .all(|file| Path::new(file.as_str().unwrap()).is_file())
    );
    assert_eq!(image::open(files[0].as_str().unwrap()).unwrap().width(), 24);

    // One view alone, of whichever split.
    let one = path("one");
    let name = result["views"][0].as_str().unwrap();
    let stem = Path::new(name).file_stem().unwrap().to_str().unwrap();
    let rendered = run(&["render", &out, "--view", stem, "--out", &one, "--json"]);
    assert_eq!(rendered.code, Some(0), "{}", rendered.stderr);
    let result: Value = serde_json::from_str(&rendered.stdout).unwrap();
    assert_eq!(result["views"], serde_json::json!([name]));
    assert!(Path::new(&one).join(format!("{stem}.png")).is_file());
    let unknown = format!("{stem}x");
    fails(
        &["render", &out, "--view", &unknown, "--out", &path("none")],
        3,
        &[&unknown, "did you mean", stem],
    );

    // Nine views, of which every fourth was held out.
    for (split, views) in [("test", 3), ("train", 6), ("all", 9)] {
        let scored = run(&["eval", &out, "--split", split, "--json"]);
        assert_eq!(scored.code, Some(0), "{}", scored.stderr);
        let result: Value = serde_json::from_str(&scored.stdout).unwrap();
        assert_eq!(result["views"].as_array().unwrap().len(), views);
        let psnr = result["psnr"].as_f64().unwrap();
        assert!((3.0..60.0).contains(&psnr), "{result}");
    }

    let trace = path("trace.json");
    let words = [
        &[
            "profile",
            &photos,
            "--preset",
            "outdoor-tiny",
            "--steps",
            "3",
            "--warmup",
            "1",
            "--json",
            "--trace",
            &trace,
        ],
        &SMALL[..],
    ];
    let profiled = run(&words.concat());
    assert_eq!(profiled.code, Some(0), "{}", profiled.stderr);
    let result: Value = serde_json::from_str(&profiled.stdout).unwrap();
    assert!(result["rows"].as_array().unwrap().len() > 10, "{result}");
    assert!(result["rows"][0]["launches"].as_u64().unwrap() >= 3);
    let trace: Value = serde_json::from_str(&fs::read_to_string(trace).unwrap()).unwrap();
    assert!(trace["traceEvents"].as_array().unwrap().len() > 30);

    // Photographs that have moved are named once.
    let moved = path("moved");
    fs::rename(&photos, &moved).unwrap();
    fails(&["eval", &out], 3, &["no longer there", "--dataset"]);
    let resumed = run(&["train", &moved, "--out", &out, "--resume"]);
    assert_eq!(resumed.code, Some(0), "{}", resumed.stderr);
    let scored = run(&["eval", &out]);
    assert_eq!(scored.code, Some(0), "{}", scored.stderr);
}

/// The same command as a shell's child that ignores the end of its terminal.
#[cfg(unix)]
fn under_nohup(command: &Command) -> Command {
    let mut shell = Command::new("sh");
    shell.args(["-c", r#"trap "" HUP; exec "$0" "$@""#]);
    shell.arg(command.get_program()).args(command.get_args());
    for (name, value) in command.get_envs() {
        match value {
            Some(value) => shell.env(name, value),
            None => shell.env_remove(name),
        };
    }
    shell
}

/// The first interrupt saves and exits 130, and the run goes on from exactly there.
#[test]
#[cfg(unix)]
fn an_interrupted_run_is_saved_and_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_dataset(&root.join("photos"));
    let path = |name: &str| root.join(name).to_str().unwrap().to_string();
    let (photos, out) = (path("photos"), path("run"));
    let words = [
        &[
            "train",
            &photos,
            "--out",
            &out,
            "--preset",
            "outdoor-tiny",
            "--stage",
            "1",
            "--steps",
            "1000000",
        ],
        &SMALL[..],
    ];
    let train = neurodin(&words.concat());
    let child = under_nohup(&train)
        .stderr(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let log = root.join("run/log.jsonl");
    let deadline = Instant::now() + Duration::from_secs(120);
    while !fs::read_to_string(&log).is_ok_and(|text| text.contains("\"step\",\"step\":")) {
        assert!(Instant::now() < deadline, "it never trained");
        std::thread::sleep(Duration::from_millis(20));
    }
    let send = |signal: &str| {
        let killed = Command::new("kill")
            .args([signal, &child.id().to_string()])
            .status()
            .unwrap();
        assert!(killed.success());
    };
    if cfg!(target_os = "linux") {
        send("-HUP");
        let lines = || fs::read_to_string(&log).unwrap().lines().count();
        let before = lines();
        while lines() < before + 3 {
            assert!(Instant::now() < deadline, "it goes on without a terminal");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
    send("-INT");
    let stopped = said(child.wait_with_output().unwrap());
    assert_eq!(stopped.code, Some(130), "{}", stopped.stderr);
    assert!(stopped.stderr.contains("--resume"), "{}", stopped.stderr);
    let saved = logged(&root.join("run"), "saved")
        .pop()
        .expect("a checkpoint");
    let step = saved["step"].as_u64().unwrap();
    assert!(Path::new(saved["path"].as_str().unwrap()).is_file());
    let second = ["train", "--out", &out, "--resume", "--stage", "2"];
    fails(&second, 3, &["--stage 2", "of 1000000 steps"]);
    let resumed = run(&[
        "train",
        "--out",
        &out,
        "--resume",
        "--steps",
        &(step + 2).to_string(),
    ]);
    assert_eq!(resumed.code, Some(0), "{}", resumed.stderr);
    assert_eq!(logged(&root.join("run"), "resumed")[0]["step"], step);
    let finished = logged(&root.join("run"), "finished").pop().unwrap();
    assert_eq!(finished["step"], step + 2);

    // Its second stage, later; and not without the first.
    let second = run(&[
        "train",
        "--out",
        &out,
        "--resume",
        "--stage",
        "2",
        "--steps",
        &(step + 5).to_string(),
    ]);
    assert_eq!(second.code, Some(0), "{}", second.stderr);
    let finished = logged(&root.join("run"), "finished").pop().unwrap();
    assert_eq!(finished["step"], step + 5);
    let rendered = run(&["eval", &out, "--json"]);
    assert_eq!(rendered.code, Some(0), "{}", rendered.stderr);
    let fewer = (step + 3).to_string();
    let shorter = ["train", "--out", &out, "--resume", "--steps", &fewer];
    fails(&shorter, 3, &["steps", "next:"]);
    let alone = path("alone");
    let refused = ["train", &photos, "--out", &alone, "--stage", "2"];
    fails(&refused, 3, &["first stage", "--resume"]);
    assert!(!root.join("alone").exists());
}
