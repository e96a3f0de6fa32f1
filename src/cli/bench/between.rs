//! Two results of `neurodin bench` as one table: what became faster, and by how much.

use super::read;
use crate::Result;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::Path;

/// One number of both results.
struct Row {
    what: String,
    before: f64,
    after: f64,
}

/// Times per step of everything that both files hold, and their ratio.
///
/// # Errors
/// [`crate::Error::Input`] for a file that is no such result.
pub(super) fn compare(before: &Path, after: &Path) -> Result<(Value, String)> {
    let files = [read(before)?, read(after)?];
    let mut rows = Vec::new();
    for (key, value) in numbers(&files[0]) {
        if let Some((_, after)) = numbers(&files[1])
            .into_iter()
            .find(|(other, _)| *other == key)
        {
            rows.push(Row {
                what: key,
                before: value,
                after,
            });
        }
    }
    let mut text = String::new();
    for (name, file) in ["before", "after"].into_iter().zip(&files) {
        let _ = writeln!(
            text,
            "{name:<7} {} on {}{}",
            file["version"].as_str().unwrap_or("?"),
            file["device"].as_str().unwrap_or("?"),
            match file["incomplete"].as_bool() {
                Some(true) => ", stopped before all was timed",
                _ => "",
            }
        );
    }
    let _ = write!(
        text,
        "{:<64} {:>10} {:>10} {:>7}",
        "ms per step", "before", "after", "ratio"
    );
    for row in &rows {
        let _ = write!(
            text,
            "\n{:<64} {:>10.3} {:>10.3} {:>7.3}",
            row.what,
            row.before,
            row.after,
            row.after / row.before
        );
    }
    let rows = rows.iter().map(|row| {
        json!({ "what": row.what, "before": row.before, "after": row.after, "ratio": row.after / row.before })
    });
    Ok((json!({ "rows": rows.collect::<Vec<_>>() }), text))
}

/// Milliseconds per step by what they are of, in the order of the file.
fn numbers(file: &Value) -> Vec<(String, f64)> {
    let mut numbers = Vec::new();
    let mut add = |what: String, value: Option<f64>| {
        numbers.extend(value.filter(|ms| *ms > 0.0).map(|ms| (what, ms)));
    };
    let array = |value: &Value| value.as_array().cloned().unwrap_or_default();
    for part in array(&file["presets"]) {
        let of = format!(
            "{} stage {} ({} rays)",
            part["preset"].as_str().unwrap_or("?"),
            part["stage"],
            part["rays"]
        );
        add(format!("{of}: CPU"), part["cpu_ms_per_step"].as_f64());
        add(format!("{of}: device"), part["device_ms_per_step"].as_f64());
        let steps = part["steps"].as_f64().unwrap_or(1.0);
        for row in array(&part["rows"]) {
            let name = row["name"].as_str().unwrap_or("?");
            add(
                format!("{of}: {name}"),
                row["total_ms"].as_f64().map(|ms| ms / steps),
            );
        }
    }
    for part in array(&file["dictionary"]) {
        let of = format!("outdoor-large at 2^{}", part["log2_size"]);
        add(format!("{of}: CPU"), part["cpu_ms_per_step"].as_f64());
        add(format!("{of}: device"), part["device_ms_per_step"].as_f64());
    }
    numbers
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_of_what_both_have() {
        let folder = std::env::temp_dir().join(format!("neurodin-between-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder");
        let file = |name: &str, ms: f64, kernel: &str| {
            let value = json!({
                "version": "1", "device": "d", "dictionary": [],
                "presets": [{ "preset": "p", "stage": 1, "rays": 8, "steps": 2, "cpu_ms_per_step": ms, "device_ms_per_step": ms,
                              "rows": [{ "name": kernel, "total_ms": 2.0 * ms }] }],
            });
            let path = folder.join(name);
            std::fs::write(&path, value.to_string()).expect("a file");
            path
        };
        let (result, text) =
            compare(&file("a", 10.0, "adam"), &file("b", 5.0, "adam")).expect("both");
        let rows = result["rows"].as_array().expect("rows");
        assert_eq!(rows.len(), 3);
        assert!(rows.iter().all(|row| row["ratio"] == 0.5), "{text}");
        let (result, _) =
            compare(&file("a", 10.0, "adam"), &file("b", 5.0, "linear")).expect("both");
        assert_eq!(
            result["rows"].as_array().map(Vec::len),
            Some(2),
            "another kernel"
        );
        std::fs::write(folder.join("c"), "{}").expect("a file");
        assert!(compare(&folder.join("a"), &folder.join("c")).is_err());
        std::fs::remove_dir_all(&folder).expect("gone");
    }
}
