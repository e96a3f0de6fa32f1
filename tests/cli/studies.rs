//! Commands that train several runs to show something about them.

use super::{SMALL, fails, neurodin, run, said, write_dataset};
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

#[test]
fn bias_of_a_plane_of_a_dataset_and_of_a_run() {
    let plane = run(&["bias", "--plane", "--json"]);
    assert_eq!(plane.code, Some(0), "{}", plane.stderr);
    let result: Value = serde_json::from_str(&plane.stdout).unwrap();
    let last = &result["plane"][17]["laplace"];
    let [measured, known] =
        ["measured", "closed_form"].map(|name| last[name].as_f64().expect("a number"));
    assert!((measured - known).abs() < 0.01 * known.abs() && known < -20.0);

    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (photos, study) = (path("photos"), path("study"));
    write_dataset(Path::new(&photos));
    fails(&["bias"], 2, &["--plane"]);
    fails(&["bias", &photos], 3, &["--out"]);
    let words = [
        &[
            "bias",
            &photos,
            "--out",
            &study,
            "--preset",
            "outdoor-tiny",
            "--steps",
            "12",
            "--views",
            "1",
            "--samples",
            "64",
            "--json",
        ],
        &SMALL[..],
    ]
    .concat();
    let both = said(neurodin(&words).output().unwrap());
    assert_eq!(both.code, Some(0), "{}", both.stderr);
    let result: Value = serde_json::from_str(&both.stdout).unwrap();
    for (nth, name) in ["without", "with"].into_iter().enumerate() {
        let of = &result["runs"][nth];
        assert_eq!((&of["name"], &of["step"]), (&name.into(), &12.into()));
        let counts = of["histogram"]["counts"].as_array().expect("counts");
        let rays: u64 = counts.iter().filter_map(Value::as_u64).sum();
        assert_eq!(Some(rays), of["rays"].as_u64());
        assert!(rays > 20, "{of}");
        let picture = image::open(of["pictures"][0].as_str().expect("a picture")).unwrap();
        assert_eq!((picture.width(), picture.height()), (24, 18));
    }
    // What is trained already is taken as it is.
    let again = said(neurodin(&words).output().unwrap());
    assert!(
        again.stderr.contains("12 of 12 steps done"),
        "{}",
        again.stderr
    );
    assert_eq!(again.stdout, both.stdout);
    let one = run(&[
        "bias",
        &path("study/with"),
        "--views",
        "1",
        "--samples",
        "64",
    ]);
    assert_eq!(one.code, Some(0), "{}", one.stderr);
    assert!(
        one.stderr.contains("rays meet the surface"),
        "{}",
        one.stderr
    );
}

#[test]
fn methods_are_compared_and_a_study_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (photos, study, points) = (path("photos"), path("study"), path("points.ply"));
    write_dataset(Path::new(&photos));
    let compare = |methods: &str| {
        let words = [
            &["compare", &photos, "--out", &study, "--methods", methods][..],
            &["--preset", "outdoor-tiny", "--steps", "8", "--seeds", "2"],
            &["--resolution", "24", "--reference", &points, "--unseen"],
            &["--thresholds", "0.1,0.8", "--json", "--force", "--report"],
            &[&path("compare.html")],
            &SMALL[..],
        ];
        said(neurodin(&words.concat()).output().unwrap())
    };
    let unknown = compare("neurodin,neus");
    assert_eq!(unknown.code, Some(3), "{}", unknown.stderr);
    assert!(unknown.stderr.contains("'neus-grid'"), "{}", unknown.stderr);
    let no_reference = compare("neuralangelo");
    assert_eq!(no_reference.code, Some(3), "{}", no_reference.stderr);
    assert!(
        no_reference.stderr.contains("points.ply"),
        "{}",
        no_reference.stderr
    );
    assert!(!Path::new(&study).exists(), "nothing was trained");

    // After eight steps the surface still is the ball of radius 0.45 that it began as.
    write_ball(Path::new(&points));
    let first = compare("neuralangelo");
    assert_eq!(first.code, Some(0), "{}", first.stderr);
    let both = compare("neurodin,neuralangelo,neurodin"); // named twice, run once
    assert_eq!(both.code, Some(0), "{}", both.stderr);
    assert_eq!(both.stderr.matches("done before").count(), 2);
    let result: Value = serde_json::from_str(&both.stdout).unwrap();
    assert_eq!(result["methods"].as_array().unwrap().len(), 2);
    for (nth, method) in ["neurodin", "neuralangelo"].into_iter().enumerate() {
        let row = &result["methods"][nth];
        assert_eq!(row["method"], method);
        for column in ["F at 0.800", "PSNR", "s/step", "MiB"] {
            let cell = &row["means"][column];
            assert!(
                cell["mean"].as_f64().is_some_and(|x| x > 0.0),
                "{column}: {row}"
            );
            assert!(cell["spread"].is_f64(), "{column}: {row}");
        }
        let run = &row["runs"][1];
        assert_eq!((&run["seed"], &run["steps"]), (&43.into(), &8.into()));
    }
    let before: Value = serde_json::from_str(&first.stdout).unwrap();
    assert_eq!(before["methods"][0], result["methods"][1]);
    let page = std::fs::read_to_string(path("compare.html")).unwrap();
    assert_eq!(page.matches("<figure>").count(), 2, "a mesh of each method");

    let scores = path("study/neurodin-0/scores.json");
    std::fs::write(&scores, "{}").unwrap();
    let refused = compare("neurodin");
    assert_eq!(refused.code, Some(3));
    assert!(refused.stderr.contains("scores.json"), "{}", refused.stderr);
}

/// What is there is taken only for what it is: trained as is asked now, and scored as is asked now.
#[test]
fn runs_that_were_trained_otherwise_are_not_compared() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (photos, study, page) = (path("photos"), path("study"), path("compare.html"));
    write_dataset(Path::new(&photos));
    let words = |more: &[&'static str]| -> Vec<String> {
        let all = [
            &["compare", &photos, "--out", &study][..],
            &["--methods", "neuralangelo", "--preset", "outdoor-tiny"],
            &SMALL[..],
            &["--set", "seed=7"],
            more,
        ]
        .concat();
        all.into_iter().map(String::from).collect()
    };
    let compare = |more: &[&'static str]| {
        let words = words(more);
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        said(neurodin(&words).output().unwrap())
    };
    let refused = |more: &[&'static str], code: i32, part: &str| {
        let said = compare(more);
        assert_eq!(said.code, Some(code), "{more:?}: {}", said.stderr);
        assert!(said.stderr.contains(part), "{more:?}: {}", said.stderr);
    };
    // Whatever cannot be is said before anything is trained.
    let small = ["--steps", "8", "--resolution", "24"];
    refused(&["--stage", "2"], 3, "--stage 2");
    refused(&["--method", "neus-grid"], 3, "--methods");
    refused(&["--set", "seed=4294967295", "--seeds", "2"], 3, "seed");
    refused(&["--report", "no/such/r.html"], 8, "mkdir");
    std::fs::write(&page, "precious").unwrap();
    fails(
        &["compare", &photos, "--out", &study, "--report", &page],
        8,
        &["--force"],
    );
    for command in ["compare", "bias"] {
        let words = [command, &photos, "--out", &study, "--holdout", "0"];
        fails(&words, 3, &["held out", "--holdout 4"]);
    }
    assert!(!Path::new(&study).exists(), "nothing was trained");

    let first = compare(&[&small[..], &["--json"]].concat());
    assert_eq!(first.code, Some(0), "{}", first.stderr);
    let result: Value = serde_json::from_str(&first.stdout).unwrap();
    assert_eq!(result["methods"][0]["runs"][0]["seed"], 7);
    let longer = ["--steps", "12", "--resolution", "24"];
    refused(&longer, 3, "steps: ");
    refused(&[&small[..], &["--radius", "2"]].concat(), 3, "region: ");
    refused(
        &[&small[..], &["--set", "seed=8"]].concat(),
        3,
        "seed: 7 -> 8",
    );
    let again = compare(&[&small[..], &["--set", "report.log_steps=4"]].concat());
    assert!(again.stderr.contains("done before"), "{}", again.stderr);
    let finer = compare(&["--steps", "8", "--resolution", "32"]);
    assert_eq!(finer.code, Some(0), "{}", finer.stderr);
    assert!(finer.stderr.contains("scored again"), "{}", finer.stderr);

    // Photographs that are no longer where they were have moved; beside those, a copy is another dataset.
    let elsewhere = path("elsewhere");
    write_dataset(Path::new(&elsewhere));
    let at_elsewhere = || {
        let mut words = words(&small);
        words[1].clone_from(&elsewhere);
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        said(neurodin(&words).output().unwrap())
    };
    let copy = at_elsewhere();
    assert_eq!(copy.code, Some(3), "{}", copy.stderr);
    assert!(copy.stderr.contains("dataset: "), "{}", copy.stderr);
    std::fs::remove_dir_all(&photos).unwrap();
    let moved = at_elsewhere();
    assert_eq!(moved.code, Some(0), "{}", moved.stderr);
    assert!(moved.stderr.contains("scored again"), "{}", moved.stderr);
}

/// Points all over the unit sphere.
fn write_ball(path: &Path) {
    let n = 2000;
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    );
    for i in 0..n {
        let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(n);
        let (sin, cos) = (2.399_963 * f64::from(i)).sin_cos();
        let radius = (1.0 - z * z).sqrt();
        text += &format!("{} {} {z}\n", radius * cos, radius * sin);
    }
    std::fs::write(path, text).unwrap();
}

#[test]
fn a_bench_needs_no_dataset_and_two_are_compared() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let bench = |out: &str| {
        let words = ["bench", "--presets", "outdoor-tiny", "--sizes", "0"];
        run(&[&words[..], &["--seconds", "0.1", "--json", "--out", out]].concat())
    };
    let measured = bench(&path("a.json"));
    assert_eq!(measured.code, Some(0), "{}", measured.stderr);
    let result: Value = serde_json::from_str(&measured.stdout).unwrap();
    assert_eq!(result["tables"].as_array().map(Vec::len), Some(3));
    for table in result["tables"].as_array().unwrap() {
        for rate in ["gather_m_per_s", "scatter_m_per_s"] {
            assert!(table[rate].as_f64().is_some_and(|x| x > 0.1), "{table}");
        }
    }
    let stages = result["presets"].as_array().unwrap();
    assert_eq!(stages.len(), 2);
    for stage in stages {
        assert!(stage["rows"].as_array().unwrap().len() > 10);
        let shares = stage["rows"].as_array().unwrap().iter();
        let most = shares
            .filter_map(|row| row["share_of_roof"].as_f64())
            .fold(0.0, f64::max);
        assert!(most > 0.01, "nothing comes near a roof: {most}");
    }
    let again = bench(&path("a.json"));
    assert_eq!(again.code, Some(8), "{}", again.stderr);
    assert!(again.stderr.contains("--force"), "{}", again.stderr);
    assert_eq!(bench(&path("b.json")).code, Some(0));
    let between = run(&["bench", "--between", &path("a.json"), &path("b.json")]);
    assert_eq!(between.code, Some(0), "{}", between.stderr);
    assert!(
        between
            .stderr
            .contains("outdoor-tiny stage 1 (256 rays): adam"),
        "{}",
        between.stderr
    );
    fails(
        &["bench", "--presets", "outdor-tiny"],
        3,
        &["'outdoor-tiny'"],
    );
    fails(
        &["bench", "--between", &path("a.json"), &path("none.json")],
        3,
        &["none.json"],
    );
    for seconds in ["0", "nan", "inf", "soon"] {
        fails(&["bench", "--seconds", seconds], 2, &["--seconds"]);
    }
    fails(&["bench", "--sizes", "50"], 3, &["log2_size"]);
    fails(&["bench", "--out", &path("no/b.json")], 8, &["mkdir"]);
    let photos = path("photos");
    write_dataset(Path::new(&photos));
    let trace = path("no/trace.json");
    fails(&["profile", &photos, "--trace", &trace], 8, &["mkdir"]);
    fails(&["profile", &photos, "--steps", "0"], 3, &["--steps 0"]);
}

/// What was measured before Ctrl-C is told, and told to be not all.
#[test]
#[cfg(unix)]
fn an_interrupted_bench_tells_what_it_has() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("bench.json");
    let words = ["bench", "--presets", "outdoor-tiny", "--sizes", "0"];
    let more = ["--seconds", "1", "--json", "--out", out.to_str().unwrap()];
    let mut child = neurodin(&[&words[..], &more].concat())
        .stderr(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    assert!(lines.any(|line| line.unwrap().starts_with("outdoor-tiny, stage 1")));
    let killed = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status()
        .unwrap();
    assert!(killed.success());
    let told: Vec<String> = lines.map(Result::unwrap).collect();
    let stopped = child.wait_with_output().unwrap();
    assert_eq!(stopped.status.code(), Some(130), "{told:?}");
    let result: Value = serde_json::from_slice(&stopped.stdout).unwrap();
    assert_eq!(result["incomplete"], true);
    assert_eq!(result["presets"].as_array().map(Vec::len), Some(1));
    let written = std::fs::read_to_string(&out).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&written).unwrap(), result);
}
