//! Vulkan compute: devices, memory, kernels, recorded work. Knows nothing of rays or surfaces.
//!
//! The only module with `unsafe` and `vk::`. A kernel is declared once, in its GLSL; its arguments are device pointers and numbers in
//! one push-constant block, so there are no descriptor sets and no binding numbers. A launch reads
//!
//! ```no_run
//! # use neurodin::gpu::{Gpu, GpuOptions, Work};
//! # use neurodin::kernels::fill;
//! # fn main() -> neurodin::Result<()> {
//! let gpu = Gpu::new(&GpuOptions::default())?;
//! let values = gpu.buffer::<f32>("values", 1 << 20)?; // [n]
//! let kernel = gpu.kernel(fill::Shape::default())?;
//! let ticket = gpu.submit("example", |rec| {
//!     rec.run(&kernel, Work::items(values.len()), fill::Args { values: values.ptr_mut(), n: 1 << 20, value: 2.0 });
//!     Ok(())
//! })?;
//! gpu.wait(ticket)?;
//! assert_eq!(gpu.download(&values, 7, 1)?, [2.0]);
//! # Ok(())
//! # }
//! ```
//!
//! Recording order is execution order. Barriers are derived: the recorder knows from a kernel's block which allocations it reads and
//! writes. A buffer that is dropped while submitted work still uses it lives on until that work is done.

mod buffer;
mod device;
mod hazards;
mod instance;
mod kernel;
mod memory;
mod profile;
mod queue;
mod recorder;
#[cfg(test)]
mod reflect;
mod roofs;
mod transfer;
mod tuning;
mod validation;

pub use buffer::{Buffer, Ptr, PtrMut, Readback};
pub use device::{Gpu, GpuOptions, Matrices};
pub use instance::{DeviceInfo, DeviceKind};
pub use kernel::{Kernel, KernelModule, KernelShape, PointerArg};
pub use memory::{MemoryPlan, Overrun};
pub use profile::{Event, Profile, ProfileRow};
pub use queue::Ticket;
pub use recorder::{Recorder, Work};
pub use roofs::{Roofs, TableRoofs};
pub use validation::ValidationLog;
