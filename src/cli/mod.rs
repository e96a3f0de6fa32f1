//! Module cli.

pub mod demo;
pub mod inspect;
pub mod scene_args;
