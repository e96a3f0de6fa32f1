//! The slow twin: NeuRodin's training step, of both stages, in plain f64, written to be read as the specification that every kernel is tested against.
//!
//! Nothing here knows of the crate or of a device. Arrays are row-major with the component innermost (`[points, 3]`, not the
//! planar `[3, points]` of the device); sample p of ray r is `r * samples + p`. Derivatives come from a small reverse-mode tape
//! ([`tape`]) whose nodes are whole matrices with hand-written adjoints; `tests/twin.rs` holds them against central differences and
//! `tests/golden.rs` against vectors of the authors' own code.

// Each test crate that includes the twin uses a part of it.
#![allow(dead_code)]

pub mod background;
pub mod batch;
pub mod golden;
pub mod hash_grid;
pub mod losses;
pub mod networks;
pub mod npz;
pub mod optimizer;
pub mod proposal;
pub mod sampling;
pub mod schedule;
pub mod step;
pub mod supervision;
pub mod surface;
pub mod tape;
pub mod trial;
pub mod volume;
