//! The command line from outside: streams, exit codes, messages.

mod demo;
mod runs;
mod studies;
mod trace;

use serde_json::Value;
use std::f64::consts::TAU;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// The program, in an environment without anyone's settings. A private Mesa has a C library of its own and with it a launcher.
fn neurodin(words: &[&str]) -> Command {
    match std::env::var_os("NEURODIN_LAUNCHER") {
        Some(launcher) => {
            let mut command = Command::new(launcher);
            command.arg(PROGRAM);
            unsettled(command, words)
        }
        None => unsettled(Command::new(PROGRAM), words),
    }
}

const PROGRAM: &str = env!("CARGO_BIN_EXE_neurodin");

fn unsettled(mut command: Command, words: &[&str]) -> Command {
    for (name, _) in std::env::vars_os() {
        if name.to_string_lossy().starts_with("NEURODIN_") {
            command.env_remove(name);
        }
    }
    command
        .env_remove("RUST_LOG")
        .env_remove("RUST_BACKTRACE")
        .env(
            "NEURODIN_CACHE",
            concat!(env!("CARGO_TARGET_TMPDIR"), "/cache"),
        )
        .args(words);
    command
}

struct Said {
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

fn said(output: Output) -> Said {
    Said {
        code: output.status.code(),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    }
}

fn run(words: &[&str]) -> Said {
    said(neurodin(words).output().unwrap())
}

/// Runs to failure with an exit code, nothing on stdout, and all of `parts` in the message.
fn fails(words: &[&str], code: i32, parts: &[&str]) -> String {
    let said = run(words);
    assert_eq!(said.code, Some(code), "{words:?}: {}", said.stderr);
    assert_eq!(said.stdout, "", "{words:?}");
    for part in parts {
        assert!(
            said.stderr.contains(part),
            "{words:?}: no '{part}' in: {}",
            said.stderr
        );
    }
    said.stderr
}

/// A white ball on a coloured gradient, seen from a ring of cameras: a dataset in the dialect that states its region.
fn write_dataset(folder: &Path) {
    let (width, height, focal) = (24u32, 18u32, 22.0);
    fs::create_dir_all(folder.join("images")).unwrap();
    let mut frames = Vec::new();
    for view in 0..9 {
        let angle = TAU * f64::from(view) / 9.0;
        let (sin, cos) = angle.sin_cos();
        // Camera axes in the world: x right, y up, looking along -z at the origin from 3 away.
        let pose = [
            [-sin, 0.0, cos, 3.0 * cos],
            [cos, 0.0, sin, 3.0 * sin],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ];
        let picture = image::RgbImage::from_fn(width, height, |x, y| {
            let (dx, dy) = (f64::from(x) + 0.5 - 12.0, f64::from(y) + 0.5 - 9.0);
            match (dx * dx + dy * dy).sqrt() < 4.0 {
                true => image::Rgb([250, 240, 230]),
                false => image::Rgb([40, 90, (120 + 5 * y) as u8]),
            }
        });
        let name = format!("images/view{view}.png");
        picture.save(folder.join(&name)).unwrap();
        frames.push(serde_json::json!({ "file_path": name, "transform_matrix": pose }));
    }
    let transforms = serde_json::json!({
        "w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": 12.0, "cy": 9.0,
        "sphere_center": [0.0, 0.0, 0.0], "sphere_radius": 1.0, "frames": frames,
    });
    fs::write(folder.join("transforms.json"), transforms.to_string()).unwrap();
}

/// Settings with which a step takes milliseconds anywhere.
const SMALL: [&str; 16] = [
    "--holdout",
    "4",
    "--set",
    "rays=16",
    "--set",
    "hash.levels=4",
    "--set",
    "hash.log2_size=10",
    "--set",
    "sampling.proposal_samples=16,12",
    "--set",
    "sampling.samples=8",
    "--set",
    "report.log_steps=2",
    "--set",
    "report.preview_steps=4",
];

#[test]
fn help_shows_examples_and_exit_codes() {
    let help = run(&["--help"]);
    assert_eq!(help.code, Some(0));
    assert_eq!(help.stderr, "");
    for code in [
        "  0  ", "  1  ", "  2  ", "  3  ", "  4  ", "  5  ", "  6  ", "  7  ", "  8  ", "  130  ",
    ] {
        assert!(help.stdout.contains(code), "{code} in {}", help.stdout);
    }
    for command in [
        "devices", "inspect", "train", "mesh", "render", "eval", "profile", "bench", "compare",
        "bias", "demo",
    ] {
        assert!(
            help.stdout.contains(&format!("  {command} ")),
            "{command} in {}",
            help.stdout
        );
        let help = run(&[command, "--help"]);
        assert_eq!((help.code, help.stderr.as_str()), (Some(0), ""));
        let shown = help.stdout.split("Example").nth(1).expect("an example");
        assert!(shown.contains(&format!("neurodin {command}")), "{shown}");
        assert!(
            help.stdout.contains("--json"),
            "global flags are told everywhere"
        );
    }
    let version = run(&["--version"]).stdout;
    assert!(
        version.starts_with(concat!("neurodin ", env!("CARGO_PKG_VERSION"))),
        "{version}"
    );
}

#[test]
fn wrong_usage_exits_2_with_a_hint() {
    fails(&["trian"], 2, &["'train'"]);
    fails(&["train", "somewhere"], 2, &["--out"]);
    fails(&["train", "--out", "x"], 2, &["DATASET"]);
    fails(
        &["train", "--out", "x", "--resume", "--radius", "2"],
        2,
        &["--radius"],
    );
    fails(
        &["mesh", "run", "--resolution", "many"],
        2,
        &["--resolution"],
    );
    fails(&["eval"], 2, &["--mesh"]);
    // What would have no effect is refused.
    fails(&["eval", "run", "--samples", "9"], 2, &["--samples"]);
    let mesh = ["eval", "--mesh", "a.ply", "--reference", "b.ply"];
    fails(&[&mesh[..], &["--split", "all"]].concat(), 2, &["--split"]);
    fails(&["train", "-q", "-v", "x", "--out", "y"], 2, &["--quiet"]);
    let colored = run(&["--color", "always", "trian"]).stderr;
    assert!(colored.contains("\x1b["), "{colored}");
}

#[test]
fn settings_are_resolved_by_precedence() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("mine.toml");
    fs::write(
        &file,
        "preset = \"indoor-tiny\"\nrays = 100\nseed = 1\nsteps = 7\n",
    )
    .unwrap();
    let file = file.to_str().unwrap();
    let printed = |command: &mut Command| -> toml::Table {
        let said = said(command.output().unwrap());
        assert_eq!((said.code, said.stderr.as_str()), (Some(0), ""));
        assert!(said.stdout.contains("# "), "settings are explained");
        said.stdout.parse().unwrap()
    };
    let table = printed(
        neurodin(&[
            "train",
            "--print-config",
            "--config",
            file,
            "--set",
            "rays=50",
        ])
        .env("NEURODIN_SEED", "2"),
    );
    let number = |name: &str| table[name].as_integer().unwrap();
    assert_eq!(table["preset"].as_str(), Some("indoor-tiny"));
    assert_eq!(
        ["steps", "seed", "rays"].map(number),
        [7, 2, 50],
        "file < environment < flags"
    );
    let table = printed(
        neurodin(&[
            "train",
            "--print-config",
            "--preset",
            "outdoor-large",
            "--seed",
            "3",
        ])
        .env("NEURODIN_SEED", "2"),
    );
    assert_eq!(table["seed"].as_integer(), Some(3));
    assert_eq!(table["hash"]["features"].as_integer(), Some(8));

    // A method is what it is, whatever a file says of its preset or holds of NeuRodin's settings; one that the file names, it may change.
    let print = ["train", "--print-config", "--config"];
    let density = |table: &toml::Table| table["surface"]["density"].clone();
    let named = printed(&mut neurodin(
        &[&print[..], &[file, "--method", "neus-grid"]].concat(),
    ));
    assert_eq!(named["method"].as_str(), Some("neus-grid"));
    assert_eq!(
        (density(&named).as_str(), &named["rays"]),
        (Some("neus"), &100.into())
    );
    let whole = folder.path().join("whole.toml");
    let every_setting = run(&["train", "--print-config", "--preset", "indoor-tiny"]).stdout;
    fs::write(&whole, every_setting).unwrap();
    let whole = whole.to_str().unwrap();
    let named = printed(&mut neurodin(
        &[&print[..], &[whole, "--method", "neus-grid"]].concat(),
    ));
    assert_eq!(density(&named).as_str(), Some("neus"));
    let own = folder.path().join("own.toml");
    fs::write(&own, "method = 'neus-grid'\nsurface.scale_init = 0.5").unwrap();
    let own = own.to_str().unwrap();
    let named = printed(&mut neurodin(
        &[&print[..], &[own, "--method", "neus-grid"]].concat(),
    ));
    assert_eq!(named["surface"]["scale_init"].as_float(), Some(0.5));
    let other = [&print[..], &[own, "--method", "neurodin"]].concat();
    fails(&other, 3, &["neurodin", "neus-grid already"]);
}

#[test]
fn unusable_settings_exit_3_and_name_the_nearest() {
    let print = ["train", "--print-config"];
    let with = |more: &[&str], parts: &[&str]| fails(&[&print[..], more].concat(), 3, parts);
    with(
        &["--preset", "outdoor-tinny"],
        &["'outdoor-tinny'", "'outdoor-tiny'"],
    );
    with(
        &["--set", "hash.log2size=20"],
        &["'hash.log2size'", "'hash.log2_size'"],
    );
    with(
        &["--set", "hash.levels=few"],
        &["hash.levels=few", "whole number"],
    );
    with(
        &["--set", "hash.features=3"],
        &["hash.features = 3", "1, 2, 4 or 8"],
    );
    with(&["--steps", "0"], &["steps = 0"]);
    with(&["--config", "/nowhere/mine.toml"], &["/nowhere/mine.toml"]);
    let json = fails(
        &[
            "train",
            "--print-config",
            "--preset",
            "x",
            "--log-format",
            "json",
        ],
        3,
        &["outdoor-tiny"],
    );
    let record: Value = serde_json::from_str(json.trim()).expect("one object a line");
    assert_eq!(
        (record["level"].as_str(), record["code"].as_i64()),
        (Some("error"), Some(3))
    );
    assert!(record["ts"].is_string() && record["what"].is_string());
}

#[test]
fn unusable_inputs_exit_3_and_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (nowhere, out) = (path("nowhere"), path("run"));
    fails(
        &["train", &nowhere, "--out", &out],
        3,
        &["nowhere", "next:"],
    );
    fails(&["inspect", &nowhere], 3, &["nowhere", "next:"]);
    fails(
        &["mesh", &nowhere, "-o", &path("m.ply")],
        3,
        &["nowhere", "config.toml", "next:"],
    );
    fails(
        &["render", &nowhere, "--out", &out],
        3,
        &["nowhere", "next:"],
    );
    fails(&["eval", &nowhere], 3, &["nowhere", "next:"]);
    fails(
        &["train", "--out", &nowhere, "--resume"],
        3,
        &["nowhere", "next:"],
    );
    assert!(!Path::new(&out).exists(), "nothing was begun");
}

/// Losses on more than colour need what they compare with; where they have it, the log names them.
#[test]
fn supervision_needs_something_to_go_by() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (dataset, out) = (path("dataset"), path("run"));
    write_dataset(Path::new(&dataset));
    let train = |more: &[&str]| {
        let words = ["train", &dataset, "--out", &out, "--steps", "12", "--force"];
        [&words[..], &["--preset", "outdoor-tiny"], &SMALL, more]
            .concat()
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<String>>()
    };
    let refused = |more: &[&str], parts: &[&str]| {
        let words = train(more);
        fails(
            &words.iter().map(String::as_str).collect::<Vec<_>>(),
            3,
            parts,
        )
    };
    let mask = ["--set", "loss.mask=0.1"];
    refused(&mask, &["loss.mask = 0.1", "\"foreground\""]);
    let silhouettes = [&mask[..], &["--set", "scene.masks=foreground"]].concat();
    refused(&silhouettes, &["loss.mask", "object masks", "next:"]);
    refused(
        &["--set", "loss.mono_normal=0.05"],
        &["loss.mono_normal", "mono_normal_path", "0 of 9", "next:"],
    );

    fs::create_dir_all(Path::new(&dataset).join("masks")).unwrap();
    for view in 0..9 {
        let disc = image::GrayImage::from_fn(24, 18, |x, y| {
            let (dx, dy) = (f64::from(x) - 11.5, f64::from(y) - 8.5);
            image::Luma([if dx * dx + dy * dy < 16.0 { 255 } else { 0 }])
        });
        disc.save(format!("{dataset}/masks/view{view}.png"))
            .unwrap();
    }
    let words = train(&[&silhouettes[..], &["--set", "report.log_steps=1"]].concat());
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let done = said(neurodin(&words).output().unwrap());
    assert_eq!(done.code, Some(0), "{}", done.stderr);
    let steps = logged(Path::new(&out), "step");
    assert!(!steps.is_empty());
    for step in steps {
        assert!(
            step["loss.mask"].as_f64().is_some_and(|loss| loss > 0.0),
            "{step}"
        );
        assert!(step.get("loss.mono_depth").is_none(), "{step}");
    }
}

#[test]
fn outputs_that_exist_exit_8_untouched() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_dataset(&root.join("photos"));
    let photos = root.join("photos").to_str().unwrap().to_string();
    let occupied = root.join("occupied");
    fs::create_dir(&occupied).unwrap();
    fs::write(occupied.join("notes.txt"), "mine").unwrap();
    let out = occupied.to_str().unwrap();
    fails(
        &["train", &photos, "--out", out],
        8,
        &["occupied", "not empty", "--force"],
    );
    fs::write(occupied.join("config.toml"), "").unwrap();
    fails(
        &["train", &photos, "--out", out, "--force"],
        8,
        &["config.toml", "no run that it could belong to"],
    );
    fs::write(occupied.join("scene.json"), "{}").unwrap();
    fails(
        &["train", &photos, "--out", out],
        8,
        &["holds a run", "--resume", "--force"],
    );
    fails(&["render", out, "--out", out], 8, &["not empty", "--force"]);
    let notes = occupied.join("notes.txt");
    fails(
        &["mesh", out, "-o", notes.to_str().unwrap()],
        8,
        &["notes.txt", ".ply"],
    );
    fails(
        &["profile", &photos, "--trace", notes.to_str().unwrap()],
        8,
        &["notes.txt", "--force"],
    );
    fails(
        &["profile", &photos, "--cache", notes.to_str().unwrap()],
        8,
        &["notes.txt", "cannot be the cache folder", "--cache"],
    );
    assert_eq!(fs::read_to_string(notes).unwrap(), "mine");
}

#[test]
fn no_device_exits_4() {
    let absent = "/nowhere/icd.json";
    let said = said(
        // Not launched: a launcher names its own driver.
        unsettled(Command::new(PROGRAM), &["devices"])
            .env("VK_DRIVER_FILES", absent)
            .env("VK_ICD_FILENAMES", absent)
            .output()
            .unwrap(),
    );
    assert_eq!(
        (said.code, said.stdout.as_str()),
        (Some(4), ""),
        "{}",
        said.stderr
    );
    fails(
        &["profile", "/nowhere", "--device", "no such device"],
        3,
        &["/nowhere"],
    );
}

#[test]
fn devices_are_listed_for_people_and_programs() {
    let people = run(&["devices", "--color", "never"]);
    assert_eq!(
        (people.code, people.stdout.as_str()),
        (Some(0), ""),
        "{}",
        people.stderr
    );
    let programs = run(&["devices", "--json", "--quiet"]);
    assert_eq!((programs.code, programs.stderr.as_str()), (Some(0), ""));
    let listed: Value = serde_json::from_str(&programs.stdout).unwrap();
    let first = &listed["devices"][0];
    assert!(
        people.stderr.contains(first["name"].as_str().unwrap()),
        "{}",
        people.stderr
    );
    assert!(first["usable"].is_boolean() && first["memory"].is_u64());
}

/// Numbers of the log's events of one kind.
fn logged(run: &Path, event: &str) -> Vec<Value> {
    fs::read_to_string(run.join("log.jsonl"))
        .unwrap()
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap())
        .filter(|record| record["event"] == event)
        .collect()
}

/// Without a preset the dataset chooses; with another one it is taken as it is, and what speaks against it is said.
#[test]
fn presets_are_suggested_and_contradicted() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (photos, out) = (path("photos"), path("run"));
    write_dataset(Path::new(&photos));
    let inspected = run(&["inspect", &photos, "--json"]);
    assert_eq!(inspected.code, Some(0), "{}", inspected.stderr);
    let report: Value = serde_json::from_str(&inspected.stdout).unwrap();
    assert_eq!(report["suggested"]["preset"], "outdoor-tiny");
    assert_eq!(report["suggested"]["settings"][0], "background.kind=field");
    assert_eq!(report["beyond"]["runs_on"], true);
    // The region is the one that training takes, of the preset that is named.
    let radius = |preset: &[&str]| {
        let inspected = run(&[&["inspect", &photos, "--json"], preset].concat());
        let report: Value = serde_json::from_str(&inspected.stdout).unwrap();
        report["region"]["radius"].as_f64().unwrap()
    };
    let (tiny, large) = (radius(&[]), radius(&["--preset", "outdoor-large"]));
    assert!((tiny / large - 1.5).abs() < 1e-9, "{tiny} {large}");
    assert_eq!(radius(&["--radius", "2"]), 2.0);
    let text = run(&["inspect", &photos]).stderr;
    assert!(
        text.contains("--preset outdoor-tiny --set background.kind=field"),
        "{text}"
    );

    let dry = |more: &[&str]| {
        let words = [
            &["train", &photos, "--out", &out, "--dry-run", "--json"],
            &SMALL[..],
            more,
        ];
        let said = run(&words.concat());
        assert_eq!(said.code, Some(0), "{}", said.stderr);
        let result: Value = serde_json::from_str(&said.stdout).unwrap();
        (result["config"].clone(), said.stderr)
    };
    let (config, stderr) = dry(&[]);
    assert_eq!(config["preset"], "outdoor-tiny");
    assert_eq!(config["background"]["kind"], "field");
    assert!(
        stderr.contains("look inwards") && stderr.contains("only 6 training views"),
        "{stderr}"
    );
    assert_eq!(stderr.matches("warning").count(), 1, "{stderr}");
    assert!(stderr.contains("MiB for stage 2"), "{stderr}");
    let printed = |more: &[&str]| {
        let words = [&["train", &photos, "--print-config"], &SMALL[..], more].concat();
        let said = run(&words);
        assert_eq!(said.code, Some(0), "{}", said.stderr);
        said.stdout
    };
    let table: toml::Table = printed(&[]).parse().unwrap();
    assert_eq!(table["background"]["kind"].as_str(), Some("field"));
    let object: Value = serde_json::from_str(&printed(&["--json"])).unwrap();
    assert_eq!(object, config, "what a dry run would take");
    // The region that is shown is the one that is trained.
    let region = |said: &str| {
        let number = said.split("radius ").nth(1).unwrap();
        let number = number.split([',', ' ']).next().unwrap();
        number.parse::<f64>().unwrap()
    };
    assert!(
        (region(&text) - region(&stderr)).abs() < 1e-3,
        "{text}{stderr}"
    );
    let (config, stderr) = dry(&["--preset", "indoor-tiny"]);
    assert_eq!(config["preset"], "indoor-tiny");
    assert!(
        stderr.contains("warning") && stderr.contains("for rooms") && stderr.contains("inwards"),
        "{stderr}"
    );
    let (config, stderr) = dry(&["--preset", "outdoor-tiny"]);
    assert_eq!(config["background"]["kind"], "constant");
    assert!(
        stderr.contains("warning") && stderr.contains("--set background.kind=field"),
        "{stderr}"
    );
}
