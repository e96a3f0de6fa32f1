//! Every kernel against a slow twin in float64, and against arrays of the published implementation.

mod field_chunks;
mod first_weights;
mod half_copy;
mod harness;
mod layer;
mod lazy_table;
#[path = "../reference/optimizer.rs"]
mod optimizer;
mod volume_compositing;
mod volume_golden;
mod volume_grazing;
mod volume_losses;
mod volume_rays;
mod volume_sampling;
mod volume_supervision;
mod volume_twin;
