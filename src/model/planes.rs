//! Activations: channels of samples, each a plane of memory.

use crate::Result;
use crate::gpu::{Buffer, Gpu, Ptr, PtrMut};

/// Where channels of samples lie: the first one, and how many elements behind one the next begins.
#[derive(Clone, Copy, Debug)]
pub struct Planes<P> {
    pub first: P,
    pub stride: u32,
}

impl<P> Planes<P> {
    /// Planes that begin so many elements apart.
    pub fn new(first: P, stride: u32) -> Planes<P> {
        Planes { first, stride }
    }
}

impl Planes<PtrMut<f32>> {
    /// The same places, for reading.
    pub fn read(&self) -> Planes<Ptr<f32>> {
        Planes::new(self.first.read(), self.stride)
    }
}

/// Elements of a cache line.
const LINE: u32 = 16;

/// Memory for activations `[channels, n]`.
pub struct Activations {
    pub values: Buffer<f32>, // [channels, stride]
    /// An odd number of cache lines, at least n elements. Whoever takes a sample through all channels would find planes that lie a power
    /// of two apart in the same few places of a processor's caches.
    pub stride: u32,
}

impl Activations {
    /// Memory whose content is not anything yet.
    pub fn new(gpu: &Gpu, name: &str, channels: u32, n: u32) -> Result<Activations> {
        let stride = (n.div_ceil(LINE) | 1) * LINE;
        Ok(Activations {
            values: gpu.scratch(name, u64::from(channels) * u64::from(stride))?,
            stride,
        })
    }

    /// For reading.
    pub fn read(&self) -> Planes<Ptr<f32>> {
        self.write().read()
    }

    /// For writing.
    pub fn write(&self) -> Planes<PtrMut<f32>> {
        Planes::new(self.values.ptr_mut(), self.stride)
    }
}
