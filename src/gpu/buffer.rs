//! Device memory: buffers, the pointers that kernels take, and small buffers that the host reads while the device works.
//!
//! Every allocation ends in 64 KiB of padding. A loop over rows may touch one row past the end there (lavapipe 26.x runs a loop's body
//! once more with an empty mask, and its uniform loads are not masked), and guard mode writes its words there.

use super::device::{Context, Gpu, Inner, vulkan};
use crate::{Error, Result};
use ash::vk;
use bytemuck::{Pod, Zeroable};
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{
    Allocation, AllocationCreateDesc, AllocationScheme, Allocator, AllocatorCreateDesc,
};
use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::mem::ManuallyDrop;
use std::ops::{Deref, Range};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, RwLock};

/// Padding behind every buffer, in bytes.
pub(super) const PADDING: u64 = 64 << 10;

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

/// A buffer's memory, freed when the last handle goes.
pub(super) struct Slab {
    pub(super) parts: ManuallyDrop<Parts>,
    pub(super) id: u64,
    pub(super) name: String,
    /// Bytes without padding.
    pub(super) bytes: u64,
    inner: Arc<Inner>,
}

impl Drop for Slab {
    fn drop(&mut self) {
        // SAFETY: taken once, here.
        let parts = unsafe { ManuallyDrop::take(&mut self.parts) };
        self.inner.memory.forget(parts.address);
        self.inner.queue.discard(&self.inner.memory, parts);
    }
}

/// Vulkan's side of a buffer.
pub(super) struct Parts {
    pub(super) raw: vk::Buffer,
    pub(super) address: u64,
    /// Bytes with padding.
    pub(super) size: u64,
    allocation: Allocation,
}

impl Parts {
    /// Copies mapped memory out.
    pub(super) fn read(&self, offset: u64, out: &mut [u8]) {
        let mapped = self.mapped(offset, out.len());
        // SAFETY: `mapped` proved the range to be mapped; the device is done with it (the caller waited).
        unsafe { std::ptr::copy_nonoverlapping(mapped, out.as_mut_ptr(), out.len()) };
    }

    /// Copies into mapped memory.
    pub(super) fn write(&self, offset: u64, data: &[u8]) {
        let mapped = self.mapped(offset, data.len());
        // SAFETY: as above; and only the staging buffer is written, under its lock.
        unsafe { std::ptr::copy_nonoverlapping(data.as_ptr(), mapped, data.len()) };
    }

    fn mapped(&self, offset: u64, len: usize) -> *mut u8 {
        assert!(
            offset + len as u64 <= self.size,
            "bytes {offset} + {len} of {}",
            self.size
        );
        let start = self
            .allocation
            .mapped_ptr()
            .expect("host-visible memory is mapped");
        // SAFETY: within the allocation, as asserted.
        unsafe { start.as_ptr().cast::<u8>().add(offset as usize) }
    }
}

/// A live allocation, as the recorder finds it by address.
pub(super) struct Span {
    pub(super) id: u64,
    pub(super) bytes: u64,
    pub(super) name: String,
}

/// The allocator, and what is alive.
pub(super) struct Memory {
    allocator: Mutex<ManuallyDrop<Allocator>>,
    pub(super) live: RwLock<BTreeMap<u64, Span>>,
    /// Host memory that uploads and downloads pass through.
    pub(super) staging: Mutex<Option<Parts>>,
    next_id: AtomicU64,
    device: ash::Device,
}

impl Memory {
    pub(super) fn new(context: &Context) -> Result<Memory> {
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: context.instance.raw.clone(),
            device: context.device.clone(),
            physical_device: context.physical,
            debug_settings: Default::default(),
            buffer_device_address: true,
            allocation_sizes: Default::default(),
        });
        let allocator = allocator.map_err(|error| Error::OutOfMemory {
            what: format!("the allocator did not start: {error}"),
        })?;
        Ok(Memory {
            allocator: Mutex::new(ManuallyDrop::new(allocator)),
            live: RwLock::new(BTreeMap::new()),
            staging: Mutex::new(None),
            next_id: AtomicU64::new(1),
            device: context.device.clone(),
        })
    }

    /// A buffer of `bytes` and padding.
    pub(super) fn allocate(
        &self,
        context: &Context,
        name: &str,
        bytes: u64,
        location: MemoryLocation,
    ) -> Result<Parts> {
        let size = bytes.next_multiple_of(16) + PADDING;
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST
            | vk::BufferUsageFlags::SHADER_DEVICE_ADDRESS;
        let create = vk::BufferCreateInfo::default().size(size).usage(usage);
        // SAFETY: a live device.
        let raw = unsafe { self.device.create_buffer(&create, None) }
            .map_err(vulkan("vkCreateBuffer"))?;
        // SAFETY: the buffer made just now.
        let requirements = unsafe { self.device.get_buffer_memory_requirements(raw) };
        let wanted = AllocationCreateDesc {
            name,
            requirements,
            location,
            linear: true,
            allocation_scheme: AllocationScheme::GpuAllocatorManaged,
        };
        let allocation = self
            .allocator
            .lock()
            .expect("no panic under the lock")
            .allocate(&wanted);
        let allocation = allocation.map_err(|error| {
            // SAFETY: nothing uses it yet.
            unsafe { self.device.destroy_buffer(raw, None) };
            Error::OutOfMemory {
                what: format!("buffer '{name}' of {bytes} bytes: {error}"),
            }
        })?;
        // SAFETY: fresh buffer, memory of a type that it allows, at the offset that the allocator aligned.
        let bound = unsafe {
            self.device
                .bind_buffer_memory(raw, allocation.memory(), allocation.offset())
        };
        let info = vk::BufferDeviceAddressInfo::default().buffer(raw);
        let address = match bound {
            // SAFETY: bound, and made with SHADER_DEVICE_ADDRESS.
            Ok(()) => unsafe { self.device.get_buffer_device_address(&info) },
            Err(_) => 0,
        };
        let parts = Parts {
            raw,
            address,
            size,
            allocation,
        };
        if let Err(error) = bound {
            self.free(parts);
            return Err(vulkan("vkBindBufferMemory")(error));
        }
        context.name(raw, name);
        Ok(parts)
    }

    /// Frees memory that nothing uses any more.
    pub(super) fn free(&self, parts: Parts) {
        // SAFETY: the caller knows that the device is done with it.
        unsafe { self.device.destroy_buffer(parts.raw, None) };
        let freed = self
            .allocator
            .lock()
            .expect("no panic under the lock")
            .free(parts.allocation);
        debug_assert!(freed.is_ok(), "{freed:?}");
    }

    fn forget(&self, address: u64) {
        self.live
            .write()
            .expect("no panic under the lock")
            .remove(&address);
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        if let Some(parts) = self.staging.lock().expect("no panic under the lock").take() {
            self.free(parts);
        }
        // SAFETY: dropped once, here, before the device.
        unsafe { ManuallyDrop::drop(&mut self.allocator.lock().expect("no panic under the lock")) };
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
        let memory = &self.inner.memory;
        let bytes = len
            .checked_mul(size_of::<T>() as u64)
            .filter(|&bytes| bytes < 1 << 46);
        let bytes = bytes.ok_or_else(|| Error::OutOfMemory {
            what: format!("buffer '{name}' of {len} elements is beyond any device"),
        })?;
        let parts = memory.allocate(&self.inner.context, name, bytes, location)?;
        let id = memory.next_id.fetch_add(1, Ordering::Relaxed);
        let span = Span {
            id,
            bytes,
            name: name.to_string(),
        };
        memory
            .live
            .write()
            .expect("no panic under the lock")
            .insert(parts.address, span);
        let slab = Slab {
            parts: ManuallyDrop::new(parts),
            id,
            name: name.to_string(),
            bytes,
            inner: self.inner.clone(),
        };
        Ok(Buffer {
            slab: Arc::new(slab),
            len,
            of: PhantomData,
        })
    }

    /// First content of a buffer; waits for it, since the host may touch a readback next.
    fn fill_new<T: Pod>(&self, buffer: &Buffer<T>, word: u32) -> Result<()> {
        let ticket = self.submit("new buffer", |rec| {
            rec.fill_bytes(&buffer.slab, 0..buffer.slab.parts.size, word);
            Ok(())
        })?;
        self.wait(ticket)
    }
}

/// A quiet NaN that no computation makes.
pub(super) const POISON: u32 = 0x7fc0_dead;
