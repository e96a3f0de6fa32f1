//! Scores: how far a mesh is from the true surface ([`geometry`], and by the protocols of [`tanks`] and [`dtu`]), how far a rendered
//! picture is from the photograph ([`images`]).

pub mod cloud;
pub mod dtu;
pub mod geometry;
pub mod images;
pub mod tanks;

pub use geometry::{GeometryOptions, GeometryScores, Reference, Viewpoint, score_geometry};
pub use images::{psnr, ssim};
