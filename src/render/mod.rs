//! Rays in, images and gradients out: where samples lie, what a ray sees, what is wrong with it.

pub mod bias;
mod composite;
mod loss;
mod priors;
mod rays;
mod renderer;
mod sampler;
mod supervision;
mod tangent;

pub use composite::{Composite, Look};
pub use loss::{Loss, TERMS};
pub use priors::Priors;
pub use rays::{RayDraws, Rays, ViewTable};
pub use renderer::{Annealed, Rendered, Renderer, Shot, TRAINING};
pub use sampler::Sampler;
pub use supervision::Supervision;
