//! Commands that train several runs to show something about them.

use super::{SMALL, fails, neurodin, run, said, write_dataset};
use serde_json::Value;
use std::path::Path;

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
