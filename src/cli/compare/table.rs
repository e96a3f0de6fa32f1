//! The table of a comparison: a row per method, a column per score, mean and spread over its seeds.

use super::Scores;
use serde::Serialize;
use serde_json::{Value, json};
use std::fmt::Write;

/// Everything that was scored, in the order of the methods.
#[derive(Default)]
pub(super) struct Table {
    rows: Vec<(String, Vec<Scores>)>,
    failures: Vec<Failure>,
}

/// A run that came to nothing.
#[derive(Serialize)]
struct Failure {
    #[serde(skip)]
    method: String,
    seed: u32,
    /// What it failed with.
    what: String,
}

/// A column: its head, how many decimals it has, whether more is better (or less), and its value for one run.
pub(super) struct Column {
    pub head: String,
    pub decimals: usize,
    pub more_is_better: bool,
    of: Pick,
}

/// Takes a column's number from what a run came to.
type Pick = Box<dyn Fn(&Scores) -> Option<f64>>;

/// Mean and, of several runs, standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Cell {
    pub mean: f64,
    pub spread: Option<f64>,
}

impl Table {
    pub(super) fn add(&mut self, scores: Scores) {
        let method = scores.method.clone();
        self.runs(&method).push(scores);
    }

    /// A method whose run failed has a row all the same.
    pub(super) fn add_failure(&mut self, method: &str, seed: u32, what: &str) {
        self.runs(method);
        self.failures.push(Failure {
            method: method.into(),
            seed,
            what: what.into(),
        });
    }

    fn runs(&mut self, method: &str) -> &mut Vec<Scores> {
        let at = self.rows.iter().position(|(name, _)| name == method);
        let at = at.unwrap_or_else(|| {
            self.rows.push((method.into(), Vec::new()));
            self.rows.len() - 1
        });
        &mut self.rows[at].1
    }

    /// The runs that failed, one a line.
    pub(super) fn failures(&self) -> String {
        let lines = self.failures.iter().map(|failure| {
            let Failure { method, seed, what } = failure;
            format!("  {method}, seed {seed}: {what}")
        });
        lines.collect::<Vec<_>>().join("\n")
    }

    pub(super) fn methods(&self) -> impl Iterator<Item = &str> {
        self.rows.iter().map(|(name, _)| name.as_str())
    }

    /// The columns that there are numbers for.
    pub(super) fn columns(&self) -> Vec<Column> {
        let column =
            |head: &str, decimals, more_is_better, of: fn(&Scores) -> Option<f64>| Column {
                head: head.into(),
                decimals,
                more_is_better,
                of: Box::new(of),
            };
        let mut columns: Vec<Column> = Vec::new();
        let all = || self.rows.iter().flat_map(|(_, runs)| runs);
        if let Some(geometry) = all().find_map(|scores| scores.geometry.as_ref()) {
            let at = geometry["thresholds"].as_array();
            for (nth, threshold) in at.into_iter().flatten().enumerate() {
                columns.push(Column {
                    head: format!("F at {:.3}", threshold["threshold"].as_f64().unwrap_or(0.0)),
                    decimals: 3,
                    more_is_better: true,
                    of: Box::new(move |scores| match &scores.geometry {
                        Some(geometry) => geometry["thresholds"][nth]["f_score"].as_f64(),
                        // Without a surface nothing is right.
                        None => scores.no_mesh.as_ref().map(|_| 0.0),
                    }),
                });
            }
            columns.push(column("Chamfer", 4, false, |scores| {
                scores.geometry.as_ref()?["chamfer_trimmed"].as_f64()
            }));
        }
        columns.push(column("PSNR", 2, true, |scores| scores.psnr));
        columns.push(column("SSIM", 3, true, |scores| scores.ssim));
        columns.push(column("s/step", 3, false, |scores| {
            Some(scores.seconds_per_step)
        }));
        columns.push(column("MiB", 0, false, |scores| {
            Some(scores.device_bytes as f64 / f64::from(1 << 20))
        }));
        columns
    }

    /// A row's number in a column; `None` where no run has it.
    pub(super) fn cell(&self, method: &str, column: &Column) -> Option<Cell> {
        let (_, runs) = self.rows.iter().find(|(name, _)| name == method)?;
        Cell::of(
            &runs
                .iter()
                .filter_map(|run| (column.of)(run))
                .collect::<Vec<_>>(),
        )
    }

    pub(super) fn text(&self) -> String {
        let columns = self.columns();
        let mut text = format!("{:<16}", "method");
        for column in &columns {
            let _ = write!(text, " {:>17}", column.head);
        }
        for method in self.methods() {
            let _ = write!(text, "\n{method:<16}");
            for column in &columns {
                let cell = self.cell(method, column);
                let number = cell.map_or("-".into(), |cell| cell.text(column.decimals));
                let _ = write!(text, " {number:>17}");
            }
        }
        text
    }

    pub(super) fn to_json(&self) -> Value {
        let columns = self.columns();
        let rows = self.rows.iter().map(|(method, runs)| {
            let means: serde_json::Map<String, Value> = columns
                .iter()
                .map(|column| {
                    let cell = self.cell(method, column);
                    let value =
                        cell.map(|cell| json!({ "mean": cell.mean, "spread": cell.spread }));
                    (column.head.clone(), value.into())
                })
                .collect();
            let failures = self.failures.iter().filter(|of| of.method == *method);
            json!({ "method": method, "means": means, "runs": runs, "failures": failures.collect::<Vec<_>>() })
        });
        rows.collect()
    }
}

impl Cell {
    fn of(values: &[f64]) -> Option<Cell> {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let squares = values
            .iter()
            .map(|value| (value - mean).powi(2))
            .sum::<f64>();
        match values {
            [] => None,
            [_] => Some(Cell { mean, spread: None }),
            _ => Some(Cell {
                mean,
                spread: Some((squares / (n - 1.0)).sqrt()),
            }),
        }
    }

    pub(super) fn text(self, decimals: usize) -> String {
        match self.spread {
            Some(spread) => format!("{:.decimals$} ± {spread:.decimals$}", self.mean),
            None => format!("{:.decimals$}", self.mean),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::compare::Scored;
    use crate::config::AppearanceAtEval;

    fn scores(method: &str, seed: u32, f: Option<f64>) -> Scores {
        Scores {
            method: method.into(),
            seed,
            steps: 10,
            seconds_per_step: 0.5,
            device_bytes: 3 << 20,
            psnr: Some(20.0 + f64::from(seed)),
            ssim: None,
            no_mesh: f.is_none().then(|| "none".into()),
            geometry: f.map(|f| json!({ "thresholds": [{ "threshold": 0.01, "f_score": f }], "chamfer_trimmed": 0.1 })),
            scored: Scored {
                resolution: 24,
                appearance: AppearanceAtEval::Mean,
                reference: Vec::new(),
                thresholds: Vec::new(),
                crop: None,
                unseen: false,
            },
        }
    }

    #[test]
    fn means_and_spreads_of_the_seeds() {
        let mut table = Table::default();
        for (seed, f) in [(0, Some(0.4)), (1, Some(0.6))] {
            table.add(scores("a", seed, f));
        }
        table.add(scores("b", 0, None));
        let columns = table.columns();
        let heads: Vec<_> = columns.iter().map(|column| column.head.as_str()).collect();
        assert_eq!(
            heads,
            ["F at 0.010", "Chamfer", "PSNR", "SSIM", "s/step", "MiB"]
        );
        let cell = table.cell("a", &columns[0]).expect("two runs");
        assert!((cell.mean - 0.5).abs() < 1e-12);
        assert!((cell.spread.expect("two runs") - 0.02_f64.sqrt()).abs() < 1e-12);
        let nothing = Some(Cell {
            mean: 0.0,
            spread: None,
        });
        assert_eq!(table.cell("b", &columns[0]), nothing, "no surface scores 0");
        assert_eq!(table.cell("b", &columns[1]), None, "and has no distance");
        assert_eq!(table.cell("a", &columns[3]), None);
        assert!(table.text().contains("20.50 ± 0.71"), "{}", table.text());
        assert_eq!(table.to_json()[0]["means"]["MiB"]["mean"], 3.0);
    }
    #[test]
    fn a_failed_run_has_its_place_and_no_numbers() {
        let mut table = Table::default();
        table.add_failure("a", 0, "not finite");
        table.add(scores("b", 0, Some(0.5)));
        assert_eq!(table.methods().collect::<Vec<_>>(), ["a", "b"]);
        assert!(
            (table.columns().iter()).all(|column| table.cell("a", column).is_none()),
            "{}",
            table.text()
        );
        let rows = table.to_json();
        assert_eq!(rows[0]["failures"][0]["what"], "not finite");
        assert_eq!(rows[1]["failures"].as_array().map(Vec::len), Some(0));
        assert_eq!(table.failures(), "  a, seed 0: not finite");
    }
}
