//! The demonstration: from nothing to a report.

use super::{fails, run};
use serde_json::Value;
use std::fs;

#[test]
fn a_small_demo_goes_all_the_way() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("tour");
    let demo = |extra: &[&str]| {
        let small = [
            "--views",
            "8",
            "--width",
            "64",
            "--steps",
            "20",
            "--resolution",
            "48",
        ];
        let words = ["demo", "--json", "--out", out.to_str().unwrap()];
        run(&[&words[..], &small, extra].concat())
    };
    let first = demo(&[]);
    assert_eq!(first.code, Some(0), "{}", first.stderr);

    let result: Value = serde_json::from_str(&first.stdout).unwrap();
    assert_eq!(result["steps"].as_u64(), Some(20));
    assert!(result["psnr"].as_f64().unwrap() > 5.0, "{result:#}");
    assert_eq!(
        result["geometry"]["thresholds"].as_array().unwrap().len(),
        3
    );
    for file in [
        "dataset/transforms.json",
        "dataset/ground_truth/surface.ply",
        "run/log.jsonl",
        "mesh.ply",
        "scores.json",
        "report.html",
        "pictures/mesh_clay.png",
    ] {
        assert!(out.join(file).is_file(), "{file} is missing");
    }
    let page = fs::read_to_string(out.join("report.html")).unwrap();
    for text in [
        "Held-out views",
        "Device time per kernel",
        "hash_grid",
        "F-score",
        "rays = 256",
    ] {
        assert!(page.contains(text), "the report lacks {text:?}");
    }
    // Two held-out views of four pictures, two large ones, four sides of three.
    assert_eq!(page.matches("<img").count(), 2 * 4 + 2 + 4 * 3);

    // A second demo does not write over the first, unless it is told to.
    let again = demo(&[]);
    assert_eq!(again.code, Some(8));
    assert_eq!(fs::read_to_string(out.join("report.html")).unwrap(), page);

    // Nor does it remove that before it has a device.
    let words = ["demo", "--force", "--device", "nosuch", "--out"];
    fails(
        &[&words[..], &[out.to_str().unwrap()]].concat(),
        4,
        &["nosuch"],
    );
    assert!(out.join("dataset/transforms.json").is_file());

    // Nor, ever, what no demo has written.
    let mine = folder.path().join("mine");
    fs::create_dir(&mine).unwrap();
    fs::write(mine.join("mesh.ply"), "precious").unwrap();
    fs::create_dir(mine.join("dataset")).unwrap();
    fs::write(mine.join("dataset/transforms.json"), "{}").unwrap();
    fails(
        &["demo", "--force", "--out", mine.to_str().unwrap()],
        8,
        &["mine", "exists"],
    );
    assert_eq!(
        fs::read_to_string(mine.join("mesh.ply")).unwrap(),
        "precious"
    );
    assert!(mine.join("dataset/transforms.json").is_file());
}
