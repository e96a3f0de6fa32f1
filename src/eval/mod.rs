//! Scores: how far a mesh is from the true surface ([`geometry`]), how far a rendered picture is from the photograph ([`images`]).

pub mod geometry;
pub mod images;

pub use geometry::{GeometryOptions, GeometryScores, Reference, score_geometry};
pub use images::{psnr, ssim};
