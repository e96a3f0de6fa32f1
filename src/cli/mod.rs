//! Module cli.

pub mod demo;
