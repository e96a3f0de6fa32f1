//! The demo's report: self-contained, complete, and well-formed whatever goes into it.

use neurodin::cli::demo::report::{Headline, KernelRow, Report, Threshold, View, duration};
use neurodin::picture::chart::{Chart, Series};
use neurodin::picture::{Rgb, depth_picture, normal_picture};

fn picture(shade: u8) -> Rgb {
    Rgb {
        width: 4,
        height: 3,
        bytes: vec![shade; 36],
    }
}

fn report() -> Report {
    Report {
        title: "Photographs & <meshes>".into(),
        summary: "What was done.".into(),
        facts: vec![("device".into(), "a \"device\"".into())],
        headlines: vec![Headline {
            value: "24.2".into(),
            unit: "dB".into(),
            meaning: "PSNR".into(),
        }],
        heroes: vec![("Clay.".into(), picture(10))],
        views: vec![View {
            name: "test_000.png".into(),
            psnr: 24.187,
            ssim: 0.7812,
            photo: picture(20),
            render: picture(30),
            depth: picture(40),
            normal: picture(50),
        }],
        mesh_columns: vec!["exact".into(), "mesh".into()],
        mesh_rows: vec![vec![picture(60), picture(70)]],
        charts: vec![Chart {
            title: "Loss".into(),
            series: vec![Series {
                name: "total".into(),
                points: vec![(0.0, 1.0), (1.0, 0.5)],
            }],
            ..Chart::default()
        }],
        thresholds: vec![Threshold {
            distance: 0.012,
            share: 0.01,
            precision: 0.8,
            recall: 0.6,
            f_score: 0.686,
        }],
        scores: vec![("Chamfer distance".into(), "0.01".into(), "mean".into())],
        stages: vec![("training".into(), 311.4), ("mesh".into(), 20.0)],
        kernels: vec![KernelRow {
            name: "hash_grid_backward surface".into(),
            launches: 1500,
            total: 812.5,
            share: 0.35,
            min: 0.5,
            median: 0.54,
            max: 0.9,
            gflops: Some(41.3),
            gbytes: None,
        }],
        kernel_note: "50 steps".into(),
        settings: "preset = \"outdoor-tiny\"".into(),
        files: vec![("mesh.ply".into(), "the mesh".into())],
        commands: vec!["neurodin mesh run -o mesh.ply".into()],
    }
}

/// Fails unless every element that is opened is closed in order.
fn assert_balanced(html: &str) {
    let mut open: Vec<String> = Vec::new();
    for tag in html.split('<').skip(1) {
        let inner = tag.split('>').next().unwrap();
        let name: String = inner
            .trim_start_matches('/')
            .chars()
            .take_while(|c| c.is_alphanumeric())
            .collect();
        if inner.starts_with('!')
            || inner.ends_with('/')
            || ["meta", "img"].contains(&name.as_str())
        {
            continue;
        }
        if inner.starts_with('/') {
            assert_eq!(
                open.pop().as_deref(),
                Some(name.as_str()),
                "closing </{name}>"
            );
        } else {
            open.push(name);
        }
    }
    assert_eq!(open, Vec::<String>::new(), "left open");
}

#[test]
fn the_page_holds_everything_and_needs_nothing() {
    let html = report().html();
    assert_balanced(&html);
    for text in [
        "Photographs &amp; &lt;meshes&gt;",
        "a &quot;device&quot;",
        "24.19 dB",
        "0.781",
        "0.686",
        "hash_grid_backward surface",
        "1500",
        "812.5 ms",
        "35.0 %",
        "41.3",
        "5 min 11 s",
        "5 min 31 s",
        "preset = &quot;outdoor-tiny&quot;",
        "neurodin mesh run -o mesh.ply",
        "<svg",
    ] {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
    assert_eq!(html.matches("<img").count(), 1 + 4 + 2);
    assert_eq!(html.matches("data:image/png;base64,").count(), 1 + 4 + 2);
    for foreign in ["http", "<link", "<script", "url("] {
        assert!(
            !html.contains(foreign),
            "the page refers to something outside: {foreign}"
        );
    }
}

#[test]
fn pictures_survive_the_way_into_the_page() {
    use base64::Engine;
    let html = report().html();
    let first = html
        .split("base64,")
        .nth(1)
        .unwrap()
        .split('"')
        .next()
        .unwrap();
    let file = base64::engine::general_purpose::STANDARD
        .decode(first)
        .unwrap();
    let decoded = image::load_from_memory(&file).unwrap().to_rgb8();
    assert_eq!((decoded.width(), decoded.height()), (4, 3));
    assert_eq!(decoded.into_raw(), picture(10).bytes);
}

#[test]
fn a_report_of_nothing_is_still_a_page() {
    let html = Report::default().html();
    assert_balanced(&html);
    assert!(!html.contains("<section"));
    let broken = Report {
        stages: vec![("training".into(), 0.0)],
        kernels: vec![KernelRow {
            share: f64::NAN,
            ..KernelRow::default()
        }],
        ..Report::default()
    };
    assert!(
        !broken.html().contains("NaN%"),
        "a share that is not a number draws no bar"
    );
}

#[test]
fn depths_grow_darker_and_nothing_is_white() {
    let depths = [1.0, 1.5, 2.0, 2.5, 3.0, f32::INFINITY, 3.5, f32::NAN];
    let picture = depth_picture(4, 2, &depths, 1.0, 3.0);
    let brightness: Vec<u32> = picture
        .bytes
        .chunks(3)
        .map(|c| c.iter().map(|b| u32::from(*b)).sum())
        .collect();
    assert!(
        brightness[..5].windows(2).all(|pair| pair[0] > pair[1]),
        "{brightness:?}"
    );
    assert_eq!(brightness[5..], [765; 3]);
}

#[test]
fn normals_are_bytes_around_the_middle() {
    let picture = normal_picture(3, 1, &[[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.6, 0.8]]);
    assert_eq!(picture.bytes, [255, 128, 0, 255, 255, 255, 128, 204, 230]);
}

#[test]
fn durations_read_well() {
    assert_eq!(duration(0.04), "0.0 s");
    assert_eq!(duration(59.9), "59.9 s");
    assert_eq!(duration(59.97), "1 min 00 s");
    assert_eq!(duration(311.4), "5 min 11 s");
}
