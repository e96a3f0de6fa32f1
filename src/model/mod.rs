//! The learned functions and their parameters: what a point, a ray or an image is mapped to. Knows nothing of steps.

mod background;
mod field;
mod hash_grid;
mod layer;
mod params;
mod proposal;
mod surface;

pub use background::Background;
pub use field::{Field, FieldBuffers, FieldShape, Scratch};
pub use hash_grid::HashGrid;
pub use layer::{Activation, Layer};
pub use params::{Group, Init, Params, ParamsPlan, Span, WeightHandle};
pub use proposal::Proposal;
pub use surface::{Surface, SurfaceBuffers};
