//! What the program says of its own insides: nothing unless it is asked, then lines of a known form.

use super::{SMALL, Said, neurodin, said, write_dataset};
use serde_json::Value;
use std::path::Path;

/// Lines of one level.
fn lines<'s>(said: &'s Said, level: &str) -> Vec<&'s str> {
    let lines = said.stderr.lines();
    lines.filter(|line| line.starts_with(level)).collect()
}

#[test]
fn insides_are_told_as_far_as_asked() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (photos, out) = (path("photos"), path("run"));
    write_dataset(Path::new(&photos));
    let train = |log: Option<&str>, more: &[&str]| {
        let words = [
            &["train", &photos, "--out", &out, "--force"][..],
            &["--preset", "outdoor-tiny"],
            &SMALL,
            &["--set", "report.preview_steps=0"],
            more,
        ]
        .concat();
        let mut command = neurodin(&words);
        if let Some(log) = log {
            command.env("RUST_LOG", log);
        }
        let said = said(command.output().unwrap());
        assert_eq!(said.code, Some(0), "{}", said.stderr);
        said
    };
    let silent = train(None, &["--steps", "4"]);
    for level in ["info:", "debug:", "trace:"] {
        assert_eq!(lines(&silent, level), [""; 0], "{}", silent.stderr);
    }

    let told = train(None, &["--steps", "4", "-v"]);
    for what in [
        "info: dataset opened format=\"Neuralangelo",
        "info: region and preset chosen center=",
        "info: device chosen device=",
        "info: pipeline cache opened file=",
        "info: tuning answers taken file=",
        "info: checkpoint written file=",
    ] {
        assert!(told.stderr.contains(what), "no '{what}' in {}", told.stderr);
    }
    assert_eq!(lines(&told, "debug:"), [""; 0]);

    let how = train(None, &["--steps", "4", "-vv"]);
    assert!(lines(&how, "info:").len() >= 6, "{}", how.stderr);
    for what in [
        "debug: pipeline built kernel=\"adam\"",
        "debug: buffer made buffer=",
    ] {
        assert!(how.stderr.contains(what), "no '{what}' in {}", how.stderr);
    }
    // None of it comes with every step.
    let longer = train(None, &["--steps", "16", "-vv"]);
    assert_eq!(
        lines(&longer, "debug:").len(),
        lines(&how, "debug:").len(),
        "{}",
        longer.stderr
    );

    // RUST_LOG picks parts; what was said to be quiet stays so.
    let part = train(Some("neurodin::scene=info"), &["--steps", "4"]);
    assert!(part.stderr.contains("info: dataset opened"));
    assert!(!part.stderr.contains("info: device"), "{}", part.stderr);
    let quiet = train(Some("debug"), &["--steps", "4", "--quiet"]);
    assert_eq!(quiet.stderr, "");
}

#[test]
fn every_line_is_an_object_where_programs_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (photos, out) = (path("photos"), path("run"));
    write_dataset(Path::new(&photos));
    let words = [
        &["train", &photos, "--out", &out, "--steps", "4"][..],
        &["--preset", "outdoor-tiny", "-vv", "--log-format", "json"],
        &SMALL,
    ]
    .concat();
    let said = said(neurodin(&words).output().unwrap());
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    let records: Vec<Value> = said
        .stderr
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}")))
        .collect();
    for record in &records {
        for key in ["ts", "level", "event"] {
            assert!(record[key].is_string(), "{key}: {record}");
        }
    }
    let of = |event: &str| {
        let mut found = records.iter().filter(|record| record["event"] == event);
        found
            .next()
            .unwrap_or_else(|| panic!("no '{event}' in {}", said.stderr))
    };
    let dataset = of("dataset opened");
    assert_eq!(dataset["level"], "info");
    assert_eq!(
        (&dataset["train"], &dataset["test"]),
        (&6.into(), &3.into())
    );
    assert_eq!(of("checkpoint written")["step"], 3);
    assert_eq!(of("pipeline built")["level"], "debug");
    assert!(of("pipeline built")["ms"].is_f64());
    assert!(of("buffer made")["bytes"].as_u64().is_some_and(|n| n > 0));
    // What happens during a run stands among them, under its own names.
    assert_eq!(of("saved")["step"], 3);
}

#[test]
fn a_wrong_filter_is_refused() {
    let refused = said(
        neurodin(&["devices"])
            .env("RUST_LOG", "neurodin=loud")
            .output()
            .unwrap(),
    );
    assert_eq!(refused.code, Some(3), "{}", refused.stderr);
    assert!(refused.stderr.contains("RUST_LOG=neurodin=loud"));
}
