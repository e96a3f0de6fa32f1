//! The whole training step on the device against the float64 twin: samples, images, losses, the gradient of every parameter, the
//! optimiser's update.

#[path = "../reference/mod.rs"]
mod reference;

mod golden_step;
#[path = "../kernels/half_copy.rs"]
mod half_copy;
mod own_priors;
mod rig;
mod training_step;
