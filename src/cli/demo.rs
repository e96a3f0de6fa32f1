//! `neurodin demo`: the built-in scene from photographs to a scored mesh and a report.

pub mod chart;
pub mod mesh_picture;
pub mod report;
