//! The f64 twin against the golden vectors: arrays computed with the authors' own code.
//!
//! The vectors lie in the directory that `NEURODIN_GOLDEN` names, else in `../shared/golden` beside the crate; where they are absent,
//! each test says so and passes. Every shape and number is read from the archives.

#[path = "../reference/mod.rs"]
mod reference;

mod fields;
mod optimization;
mod rendering;
mod whole_step;

use reference::npz::Npz;
use reference::tape::{Tape, Var};

/// |ours − theirs| ≤ relative · max|theirs|, element by element against the largest.
#[track_caller]
fn assert_close(what: &str, ours: &[f64], theirs: &[f64], relative: f64) {
    assert_eq!(ours.len(), theirs.len(), "{what}: lengths");
    let largest = theirs
        .iter()
        .fold(f64::MIN_POSITIVE, |largest, x| x.abs().max(largest));
    for (i, (a, b)) in ours.iter().zip(theirs).enumerate() {
        let error = (a - b).abs();
        assert!(
            error <= relative * largest,
            "{what}[{i}] = {a}, golden {b}: off by {error:.2e}, largest {largest:.2e}"
        );
    }
}

/// The array as a matrix on the tape whose gradient is wanted.
fn parameter(tape: &mut Tape, npz: &Npz, array: &str) -> Var {
    let (shape, values) = (npz.shape(array), npz.values(array).to_vec());
    let cols = shape.last().copied().unwrap_or(1);
    tape.parameter(values.len() / cols, cols, values)
}
