//! First weights of the surface's networks: as published, and farther from one another.

use crate::harness::device;
use neurodin::Result;
use neurodin::config::Config;
use neurodin::model::Model;
use std::f64::consts::PI;

/// First values of a span, in rows.
struct Matrix {
    columns: usize,
    values: Vec<f64>,
}

impl Matrix {
    /// Values of these rows and columns.
    fn of(&self, rows: std::ops::RangeFrom<usize>, columns: std::ops::Range<usize>) -> Vec<f64> {
        let rows = self.values.chunks(self.columns).skip(rows.start);
        rows.flat_map(|row| row[columns.clone()].to_vec()).collect()
    }
}

fn first_values(config: &Config, name: &str) -> Result<Matrix> {
    let gpu = &device().gpu;
    let params = Model::new(gpu, config, 3, [0.5; 3], false)?.params;
    let span = params.span(name).expect("a span");
    let values = gpu.download(params.values(), span.first, span.len())?;
    Ok(Matrix {
        columns: span.shape[1] as usize,
        values: values.into_iter().map(f64::from).collect(),
    })
}

/// Mean, and deviation from it.
fn spread(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let square = values.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>();
    (mean, (square / n).sqrt())
}

fn assert_near(what: &str, got: f64, want: f64) {
    assert!((got / want - 1.0).abs() < 0.1, "{what}: {got}, not {want}");
}

#[test]
fn weights_begin_as_published_or_as_far_apart_as_asked() -> Result<()> {
    let mut config = Config::preset("outdoor-tiny")?;
    let hidden = f64::from(config.surface.hidden);
    let (position, mean) = ((2.0 / hidden).sqrt(), (PI / hidden).sqrt());
    for (hash, features, gain) in [(0.0, 0.0, 1.0), (0.5, 1.0, 2.45)] {
        config.surface.init_hash = hash;
        config.surface.init_features = features;
        config.color.init_gain = gain;

        let first = first_values(&config, "surface.hidden.v")?;
        assert_near("position", spread(&first.of(0.., 0..3)).1, position);
        let of_hash = spread(&first.of(0.., 3..first.columns)).1;
        match hash > 0.0 {
            true => assert_near("hash features", of_hash, hash * position),
            false => assert_eq!(of_hash, 0.0),
        }

        let heads = first_values(&config, "surface.heads.v")?;
        let (all, of_features) = (0..heads.columns, spread(&heads.of(2.., 0..heads.columns)));
        let distance_and_scale = Matrix {
            columns: heads.columns,
            values: heads.values[..2 * heads.columns].to_vec(),
        };
        let (middle, deviation) = spread(&distance_and_scale.of(0.., all));
        assert_near("signed distance and scale", middle, mean);
        assert!(deviation < 2e-4);
        assert_near("features", of_features.0, mean);
        match features > 0.0 {
            true => assert_near("features apart", of_features.1, features * mean),
            false => assert!(of_features.1 < 2e-4),
        }

        let color = first_values(&config, "color.0.v")?;
        let largest = color
            .values
            .iter()
            .fold(0.0, |most: f64, x| most.max(x.abs()));
        let bound = gain / (color.columns as f64).sqrt();
        assert!(largest <= bound * 1.000_001);
        assert_near("colours", largest, bound);
    }
    Ok(())
}
