//! Module cli.

pub mod demo;
pub mod eval;
pub mod inspect;
pub mod scene_args;
