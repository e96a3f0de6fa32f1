//! Photographs to triangle meshes with neural surfaces: NeuRodin's two-stage neural SDF in hand-written Vulkan compute kernels.
//!
//! What flows: photos + cameras ([`scene`]) → rays → samples → image and its gradients ([`render`]) through the learned functions
//! ([`model`]) → optimiser steps and checkpoints ([`train`]) → triangle mesh ([`mesh`]) → scores ([`eval`]). Everything that runs on
//! the device goes through [`gpu`], the only module that knows Vulkan.

mod arrays;
pub mod cli;
pub mod config;
mod destination;
pub mod error;
pub mod eval;
pub mod gpu;
pub mod kernels;
pub mod mesh;
pub mod model;
pub mod picture;
mod ply;
mod random;
pub mod render;
pub mod scene;
mod srgb;
pub mod train;
mod whole_file;

pub use error::{Error, Result};
