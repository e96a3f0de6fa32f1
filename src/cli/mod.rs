//! Module cli.

pub mod inspect;
pub mod scene_args;
pub mod demo;
