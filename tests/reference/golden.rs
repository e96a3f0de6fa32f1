//! The golden vectors (arrays computed with the authors' own code): where they are, and their whole training step as a [`Step`].

use super::background::Background;
use super::batch::{Draws, Now, Rays, Scale, Stage, Step, StepConfig, Tangent};
use super::hash_grid::Grid;
use super::losses::BiasReduction;
use super::npz::Npz;
use super::sampling::Region;
use super::tape::ReluEdge;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// An archive of the golden directory (`NEURODIN_GOLDEN`, else `../shared/golden` beside the crate), or None, with a word why.
pub fn open(archive: &str) -> Option<Npz> {
    let directory = std::env::var_os("NEURODIN_GOLDEN").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/golden")),
        PathBuf::from,
    );
    let path = directory.join(format!("{archive}.npz"));
    if path.is_file() {
        return Some(Npz::open(&path));
    }
    println!(
        "skipped: {} is not there (NEURODIN_GOLDEN names the directory)",
        path.display()
    );
    None
}

/// The tables' closed form: ((i · 2654435761) mod 2³²)/2³² − ½ at the flat index i, times `factor`.
pub fn table(parameters: usize, factor: f64) -> Vec<f64> {
    let value =
        |i: u64| (i.wrapping_mul(2_654_435_761) & 0xffff_ffff) as f64 / 4_294_967_296.0 - 0.5;
    (0..parameters as u64).map(|i| factor * value(i)).collect()
}

/// Span of the contract and array of the archive, for all parameters but the tables.
pub fn small_spans() -> Vec<(String, String)> {
    let mut pairs = Vec::new();
    let parts = [("v", "weight_v"), ("g", "weight_g"), ("bias", "bias")];
    for (ours, theirs) in parts {
        pairs.push((
            format!("surface.hidden.{ours}"),
            format!("field_geometry_net_glin0_{theirs}"),
        ));
        pairs.push((
            format!("surface.heads.{ours}"),
            format!("field_geometry_net_glin1_{theirs}"),
        ));
        for layer in 0..3 {
            pairs.push((
                format!("color.{layer}.{ours}"),
                format!("field_appearance_net_clin{layer}_{theirs}"),
            ));
        }
    }
    for level in 0..2 {
        let theirs =
            |layer: usize| format!("proposal_networks_{level}_mlp_base_net_net_{layer}_weight");
        pairs.push((format!("proposal.{level}.hidden"), theirs(0)));
        pairs.push((format!("proposal.{level}.out"), theirs(2)));
    }
    pairs
}

/// Span and array of the three tables.
pub fn table_spans() -> Vec<(String, String)> {
    let theirs = |level: usize| format!("proposal_networks_{level}_mlp_base_enc_params");
    vec![
        ("surface.table".into(), "field_encoding_params".into()),
        ("proposal.0.table".into(), theirs(0)),
        ("proposal.1.table".into(), theirs(1)),
    ]
}

/// The archive `e2e_stage1` or `e2e_stage2` as a step: 12 levels 16 → 1024 of 2^17 entries, proposals 5 levels 16 → 64 and 16 → 256, one fixed
/// background colour. Everything else is read from the arrays.
pub fn whole_step(npz: &Npz) -> Step {
    let bins = |level: usize| npz.shape(&format!("edges_s{level}"))[1] - 1;
    let small = |array: &str| npz.array(&format!("param_{array}"));
    let hidden = small("field_geometry_net_glin0_weight_v");
    let grid = Grid::exact(12, 16, 1024, 17, 2);
    assert_eq!(hidden.shape[1], 3 + grid.width());
    let background = npz.values("background");
    let config = StepConfig {
        region: Region::Sphere,
        train: true,
        proposal_grids: [
            Grid::exact(5, 16, 64, 17, 2),
            Grid::exact(5, 16, 256, 17, 2),
        ],
        proposal_hidden: small("proposal_networks_0_mlp_base_net_net_0_weight").shape[0],
        proposal_samples: [bins(0), bins(1)],
        samples: bins(2),
        tap_floor: 1.0 / (4.0 * 1024.0),
        grid,
        hidden: hidden.shape[0],
        features: small("field_geometry_net_glin1_bias").values.len() - 2,
        scale: Scale::Local,
        scale_range: 0.1,
        scale_floor: 2e-4,
        tap_range: 0.1,
        color_hidden: small("field_appearance_net_clin0_bias").values.len(),
        color_layers: 2,
        views: 0,
        appearance: 0,
        background: Background::Fixed([background[0], background[1], background[2]]),
        color_squared: 0.0,
        eikonal_weight: 0.01,
        interlevel_weight: 1.0,
        bias_epsilon: 5e-4,
        bias_offset: 0.001,
        bias_reduction: BiasReduction::Published,
        bias_needs_opaque: true,
    };
    let mut params: BTreeMap<String, Vec<f64>> = small_spans()
        .into_iter()
        .map(|(ours, theirs)| (ours, small(&theirs).values.clone()))
        .collect();
    params.insert("surface.table".into(), table(config.grid.parameters(), 0.2));
    for (level, grid) in config.proposal_grids.iter().enumerate() {
        params.insert(
            format!("proposal.{level}.table"),
            table(grid.parameters(), 2.0),
        );
    }
    let origins = npz.vectors("origins");
    let now = Now {
        anneal: npz.scalar("anneal"),
        inv_s_lower: 1.0 / npz.scalar("schedule_beta"),
        bias_weight: 0.1,
        curvature_weight: 0.0,
        released_levels: config.grid.levels.len(),
        cosine_anneal: 1.0,
        inv_count: 1.0 / origins.len() as f64,
    };
    let rays = Rays {
        directions: npz.vectors("directions"),
        target: npz
            .vectors("target")
            .iter()
            .map(|&[r, g, b]| [r, g, b, 1.0])
            .collect(),
        view: vec![0; origins.len()],
        origins,
        ..Rays::default()
    };
    let jitter = ["draw0_rand", "draw1_rand", "draw2_rand"].map(|draw| npz.values(draw).to_vec());
    let draws = Draws {
        jitter,
        taps: npz
            .find("draw3_rand")
            .map_or(Vec::new(), |taps| taps.values.clone()),
        background: Vec::new(),
    };
    Step {
        config,
        params,
        rays,
        draws,
        now,
        edges: None,
        points: None,
        stage: Stage::first(),
        relu_edge: ReluEdge::default(),
    }
}

/// Stage 2 of the archive `e2e_stage2`.
pub fn second_stage(npz: &Npz) -> Stage {
    Stage::second(Tangent {
        weight: 0.005,
        step: 0.01,
        draws: npz.vectors("draw3_randn"),
    })
}
