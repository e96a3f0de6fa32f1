//! Buffers, the pointers that kernels take, and small buffers that the host reads while the device works.

use super::device::Gpu;
use super::memory::{GUARD, POISON, Slab};
use crate::{Error, Result};
use bytemuck::{Pod, Zeroable};
use gpu_allocator::MemoryLocation;
use std::marker::PhantomData;
use std::ops::{Deref, Range};
use std::sync::Arc;

/// A readable device pointer: what a kernel's `readonly` argument takes.
#[repr(transparent)]
pub struct Ptr<T> {
    words: [u32; 2],
    of: PhantomData<T>,
}

/// A writable device pointer.
#[repr(transparent)]
pub struct PtrMut<T> {
    words: [u32; 2],
    of: PhantomData<T>,
}

macro_rules! pointer {
    ($name:ident) => {
        impl<T> Clone for $name<T> {
            fn clone(&self) -> Self {
                *self
            }
        }
        impl<T> Copy for $name<T> {}
        impl<T> PartialEq for $name<T> {
            fn eq(&self, other: &Self) -> bool {
                self.words == other.words
            }
        }
        impl<T> std::fmt::Debug for $name<T> {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(f, "{}({:#x})", stringify!($name), self.address())
            }
        }
        /// As GLSL's uvec2: for structures that hold addresses as numbers.
        impl<T> From<$name<T>> for [u32; 2] {
            fn from(pointer: $name<T>) -> Self {
                pointer.words
            }
        }
        // SAFETY: two words and nothing else; any bits are a value, whatever T is.
        unsafe impl<T> Zeroable for $name<T> {}
        // SAFETY: as above, without padding; T is only a mark.
        unsafe impl<T: 'static> Pod for $name<T> {}

        impl<T> $name<T> {
            /// Points nowhere; for arguments that a kernel does not touch.
            pub const NULL: Self = Self::new(0);

            pub(super) const fn new(address: u64) -> Self {
                Self {
                    words: [address as u32, (address >> 32) as u32],
                    of: PhantomData,
                }
            }

            /// The device address.
            pub fn address(&self) -> u64 {
                self.words[0] as u64 | (self.words[1] as u64) << 32
            }

            /// `n` elements further.
            pub fn offset(&self, n: u64) -> Self {
                Self::new(self.address() + n * size_of::<T>() as u64)
            }

            /// The same place, seen as elements of another type.
            pub fn cast<U>(&self) -> $name<U> {
                $name::new(self.address())
            }
        }
    };
}
pointer!(Ptr);
pointer!(PtrMut);

impl<T> PtrMut<T> {
    /// The same place, for reading.
    pub fn read(&self) -> Ptr<T> {
        Ptr::new(self.address())
    }
}

/// `len` elements of device memory. Clones are the same memory; the last one to go frees it, once submitted work is done with it.
pub struct Buffer<T> {
    pub(super) slab: Arc<Slab>,
    len: u64,
    of: PhantomData<T>,
}

impl<T> Clone for Buffer<T> {
    fn clone(&self) -> Self {
        Buffer {
            slab: self.slab.clone(),
            len: self.len,
            of: PhantomData,
        }
    }
}

impl<T> std::fmt::Debug for Buffer<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "Buffer({}, {} x {})",
            self.slab.name,
            self.len,
            std::any::type_name::<T>()
        )
    }
}

impl<T: Pod> Buffer<T> {
    /// Pointer to the first element, for reading.
    pub fn ptr(&self) -> Ptr<T> {
        Ptr::new(self.slab.parts.address)
    }

    /// Pointer to the first element, for writing.
    pub fn ptr_mut(&self) -> PtrMut<T> {
        PtrMut::new(self.slab.parts.address)
    }

    /// Pointer to element `first`, for reading; `first` may be the end.
    pub fn at(&self, first: u64) -> Ptr<T> {
        self.at_mut(first).read()
    }

    /// Pointer to element `first`, for writing; `first` may be the end.
    pub fn at_mut(&self, first: u64) -> PtrMut<T> {
        assert!(
            first <= self.len,
            "{}: element {first} of {}",
            self.slab.name,
            self.len
        );
        self.ptr_mut().offset(first)
    }

    /// Number of elements.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// Whether it has no elements.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Bytes of its elements, without padding.
    pub fn bytes(&self) -> u64 {
        self.len * size_of::<T>() as u64
    }

    /// The name that it was made with.
    pub fn name(&self) -> &str {
        &self.slab.name
    }

    /// Byte range of elements `first .. first + len`.
    pub(super) fn byte_range(&self, range: Range<u64>) -> Range<u64> {
        assert!(
            range.start <= range.end && range.end <= self.len,
            "{}: elements {range:?} of {}",
            self.slab.name,
            self.len
        );
        let size = size_of::<T>() as u64;
        range.start * size..range.end * size
    }
}

/// A small buffer in host memory, mapped for as long as it lives: kernels and copies write it, the host reads it without a staging copy.
pub struct Readback<T> {
    buffer: Buffer<T>,
}

impl<T> Deref for Readback<T> {
    type Target = Buffer<T>;

    fn deref(&self) -> &Buffer<T> {
        &self.buffer
    }
}

impl<T: Pod> Readback<T> {
    /// Copies elements out. Does not wait: the ticket of the work that wrote them must be done.
    pub fn read(&self, range: Range<u64>) -> Vec<T> {
        let bytes = self.buffer.byte_range(range);
        let mut out = vec![T::zeroed(); (bytes.end - bytes.start) as usize / size_of::<T>().max(1)];
        self.buffer
            .slab
            .parts
            .read(bytes.start, bytemuck::cast_slice_mut(&mut out));
        out
    }
}

impl Gpu {
    /// `len` zeros in device memory. Fails with [`Error::OutOfMemory`] where they do not fit.
    pub fn buffer<T: Pod>(&self, name: &str, len: u64) -> Result<Buffer<T>> {
        let buffer = self.allocate(name, len, MemoryLocation::GpuOnly)?;
        self.fill_new(&buffer, 0)?;
        Ok(buffer)
    }

    /// `len` elements whose content need not be anything: written before they are read. NaN in guard mode.
    pub fn scratch<T: Pod>(&self, name: &str, len: u64) -> Result<Buffer<T>> {
        let buffer = self.allocate(name, len, MemoryLocation::GpuOnly)?;
        if self.inner.options.guard {
            self.fill_new(&buffer, POISON)?;
        }
        Ok(buffer)
    }

    /// `len` zeros in host memory that the device can write and the host can read at any time.
    pub fn readback<T: Pod>(&self, name: &str, len: u64) -> Result<Readback<T>> {
        let buffer = self.allocate(name, len, MemoryLocation::GpuToCpu)?;
        self.fill_new(&buffer, 0)?;
        Ok(Readback { buffer })
    }

    fn allocate<T: Pod>(
        &self,
        name: &str,
        len: u64,
        location: MemoryLocation,
    ) -> Result<Buffer<T>> {
        assert!(size_of::<T>() > 0, "{name}: elements without size");
        let bytes = len
            .checked_mul(size_of::<T>() as u64)
            .filter(|&bytes| bytes < 1 << 46);
        let bytes = bytes.ok_or_else(|| Error::OutOfMemory {
            what: format!(
                "buffer '{name}' of {len} elements is beyond any device\n  next: ask for less"
            ),
        })?;
        let slab = Slab::new(&self.inner, name, bytes, location)?;
        Ok(Buffer {
            slab,
            len,
            of: PhantomData,
        })
    }

    /// First content of a buffer and of what lies behind it; waits, since the host may touch a readback next.
    fn fill_new<T: Pod>(&self, buffer: &Buffer<T>, word: u32) -> Result<()> {
        let ticket = self.submit("new buffer", |rec| {
            let end = buffer.slab.guard_start();
            rec.fill_bytes(&buffer.slab, 0..end, word);
            let behind = if self.inner.options.guard { GUARD } else { 0 };
            rec.fill_bytes(&buffer.slab, end..buffer.slab.parts.size, behind);
            Ok(())
        })?;
        self.wait(ticket)
    }
}
