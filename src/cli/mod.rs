//! Module cli.

pub mod eval;
pub mod inspect;
pub mod scene_args;
