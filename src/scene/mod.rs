//! Module scene.

pub mod synthetic;
