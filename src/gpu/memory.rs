//! Device memory: allocations, what is alive, what fits, and the words that show a write past the end.
//!
//! Every allocation ends in 64 KiB of padding. A loop over rows may touch one row past the end there (lavapipe 26.x runs a loop's body
//! once more with an empty mask, and its uniform loads are not masked), and guard mode writes its words there. Memory whose last handle
//! goes while submitted work may still use it waits for that work ([`super::queue`]).

use super::device::{Context, Gpu, Inner, vulkan};
use super::instance::{DeviceInfo, DeviceKind};
use crate::{Error, Result};
use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{
    Allocation, AllocationCreateDesc, AllocationScheme, Allocator, AllocatorCreateDesc,
};
use std::collections::BTreeMap;
use std::fmt;
use std::mem::ManuallyDrop;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, RwLock, Weak};

/// Padding behind every buffer, in bytes.
pub(super) const PADDING: u64 = 64 << 10;
/// What scratch holds at first in guard mode: a quiet NaN that no computation makes.
pub(super) const POISON: u32 = 0x7fc0_dead;
/// What the padding holds in guard mode: another.
pub(super) const GUARD: u32 = 0x7fc6_a2d0;

/// A buffer's memory, freed when the last handle goes.
pub(super) struct Slab {
    pub(super) parts: ManuallyDrop<Parts>,
    pub(super) id: u64,
    pub(super) name: String,
    /// Bytes without padding.
    bytes: u64,
    inner: Arc<Inner>,
}

impl Slab {
    pub(super) fn new(
        inner: &Arc<Inner>,
        name: &str,
        bytes: u64,
        location: MemoryLocation,
    ) -> Result<Arc<Slab>> {
        let memory = &inner.memory;
        let on_device = location == MemoryLocation::GpuOnly;
        if on_device {
            memory.check_fit(&inner.context, &inner.info, name, bytes)?;
        }
        let parts = memory.allocate(&inner.context, name, bytes, location)?;
        tracing::debug!(buffer = name, bytes, on_device, "buffer made");
        let id = memory.next_id.fetch_add(1, Ordering::Relaxed);
        let (address, size) = (parts.address, parts.size);
        let slab = Arc::new(Slab {
            parts: ManuallyDrop::new(parts),
            id,
            name: name.to_string(),
            bytes,
            inner: inner.clone(),
        });
        let span = Span {
            id,
            bytes,
            size,
            on_device,
            slab: Arc::downgrade(&slab),
        };
        memory
            .live
            .write()
            .expect("no panic under the lock")
            .insert(address, span);
        Ok(slab)
    }

    /// Where the guard words begin: at the first whole word behind the content.
    pub(super) fn guard_start(&self) -> u64 {
        self.bytes.next_multiple_of(4)
    }
}

impl Drop for Slab {
    fn drop(&mut self) {
        // SAFETY: taken once, here.
        let parts = unsafe { ManuallyDrop::take(&mut self.parts) };
        let memory = &self.inner.memory;
        memory
            .live
            .write()
            .expect("no panic under the lock")
            .remove(&parts.address);
        self.inner.queue.discard(memory, parts);
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
    /// Bytes without padding.
    pub(super) bytes: u64,
    /// Bytes with padding.
    size: u64,
    on_device: bool,
    slab: Weak<Slab>,
}

/// The allocator, and what is alive.
pub(super) struct Memory {
    allocator: Mutex<ManuallyDrop<Allocator>>,
    pub(super) live: RwLock<BTreeMap<u64, Span>>,
    /// Host memory that uploads and downloads pass through.
    pub(super) staging: Mutex<Option<Parts>>,
    next_id: AtomicU64,
    /// Host memory that was free when the device was opened: the budget of a device that computes on the CPU.
    host_bytes: Option<u64>,
    /// What the caller allows.
    limit: Option<u64>,
    device: ash::Device,
}

impl Memory {
    pub(super) fn new(context: &Context, limit: Option<u64>) -> Result<Memory> {
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: context.instance.raw.clone(),
            device: context.device.clone(),
            physical_device: context.physical,
            debug_settings: Default::default(),
            buffer_device_address: true,
            allocation_sizes: Default::default(),
        });
        let allocator = allocator.map_err(|error| Error::OutOfMemory {
            what: format!(
                "the allocator did not start: {error}\n  next: close what else uses the device, or choose another"
            ),
        })?;
        Ok(Memory {
            allocator: Mutex::new(ManuallyDrop::new(allocator)),
            live: RwLock::new(BTreeMap::new()),
            staging: Mutex::new(None),
            next_id: AtomicU64::new(1),
            host_bytes: available_host_memory(),
            limit,
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
            let (need, plan) = (mib(bytes), self.largest());
            Error::OutOfMemory {
                what: format!(
                    "buffer '{name}' needs {need}: {error}\n  held: {plan}\n  next: {NEXT}"
                ),
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

    /// Refuses a buffer that the device cannot hold, with the numbers.
    fn check_fit(
        &self,
        context: &Context,
        info: &DeviceInfo,
        name: &str,
        bytes: u64,
    ) -> Result<()> {
        let refuse = |why: String| {
            Err(Error::OutOfMemory {
                what: format!(
                    "buffer '{name}' needs {}; {why}\n  next: {NEXT}",
                    mib(bytes)
                ),
            })
        };
        if bytes + PADDING > info.max_buffer {
            return refuse(format!(
                "one buffer on {} ends at {}",
                info.name,
                mib(info.max_buffer)
            ));
        }
        let (budget, left) = self.budget(context, info);
        if bytes + PADDING > left {
            return refuse(format!(
                "of {} on {}, {} are left\n  held: {}",
                mib(budget),
                info.name,
                mib(left),
                self.largest()
            ));
        }
        Ok(())
    }

    /// (all that this program may use on the device, what is left of it) in bytes.
    fn budget(&self, context: &Context, info: &DeviceInfo) -> (u64, u64) {
        let live = self.live.read().expect("no panic under the lock");
        let held: u64 = live
            .values()
            .filter(|span| span.on_device)
            .map(|span| span.size)
            .sum();
        drop(live);
        let (total, left) = self.device_budget(context, info, held);
        match self.limit {
            Some(limit) => (total.min(limit), left.min(limit.saturating_sub(held))),
            None => (total, left),
        }
    }

    fn device_budget(&self, context: &Context, info: &DeviceInfo, held: u64) -> (u64, u64) {
        if let (DeviceKind::Cpu, Some(total)) = (info.kind, self.host_bytes) {
            // Heap sizes of software devices are fiction (2 GiB, not enforced; or all of the host's memory).
            return (total, total.saturating_sub(held));
        }
        if context.has_memory_budget {
            let mut budget = vk::PhysicalDeviceMemoryBudgetPropertiesEXT::default();
            let mut properties =
                vk::PhysicalDeviceMemoryProperties2::default().push_next(&mut budget);
            // SAFETY: the device offers the extension; the chain outlives the call.
            unsafe {
                context
                    .instance
                    .raw
                    .get_physical_device_memory_properties2(context.physical, &mut properties)
            };
            let heaps = properties.memory_properties;
            let local = heaps.memory_heaps_as_slice().iter().enumerate();
            let local =
                local.filter(|(_, heap)| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
            if let Some((heap, _)) = local.max_by_key(|(_, heap)| heap.size) {
                let (total, used) = (budget.heap_budget[heap], budget.heap_usage[heap]);
                return (total, total.saturating_sub(used.max(held)));
            }
        }
        (info.memory, info.memory.saturating_sub(held))
    }

    /// Handles of everything alive. They are taken first and used after the lock: work recorded meanwhile needs the lock, too.
    fn slabs(&self) -> Vec<Arc<Slab>> {
        let live = self.live.read().expect("no panic under the lock");
        live.values()
            .filter_map(|span| span.slab.upgrade())
            .collect()
    }

    /// The largest allocations, for messages.
    fn largest(&self) -> String {
        let mut slabs = self.slabs();
        slabs.sort_by_key(|slab| std::cmp::Reverse(slab.bytes));
        let named: Vec<String> = slabs
            .iter()
            .take(4)
            .map(|slab| format!("{} {}", slab.name, mib(slab.bytes)))
            .collect();
        match slabs.len() {
            0 => "nothing".into(),
            n if n > 4 => format!("{} and {} more", named.join(", "), n - 4),
            _ => named.join(", "),
        }
    }
}

/// What to do about memory.
const NEXT: &str = "choose smaller tables or batches, or a device with more memory";

impl Drop for Memory {
    fn drop(&mut self) {
        if let Some(parts) = self
            .staging
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
            .take()
        {
            self.free(parts);
        }
        // SAFETY: dropped once, here, before the device.
        unsafe {
            ManuallyDrop::drop(
                &mut self
                    .allocator
                    .lock()
                    .unwrap_or_else(|poisoned| poisoned.into_inner()),
            )
        };
    }
}

/// Bytes in the unit that suits them.
fn mib(bytes: u64) -> String {
    match bytes {
        0..0x10_0000 => format!("{:.1} KiB", bytes as f64 / 1024.0),
        0x10_0000..0x4000_0000 => format!("{:.1} MiB", bytes as f64 / (1u64 << 20) as f64),
        _ => format!("{:.2} GiB", bytes as f64 / (1u64 << 30) as f64),
    }
}

/// Memory that the host could still give, where the system says so (Linux: MemAvailable).
fn available_host_memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

/// Who holds how much of the device.
#[derive(Clone, Debug)]
pub struct MemoryPlan {
    /// (name, bytes) of every buffer, largest first.
    pub buffers: Vec<(String, u64)>,
    /// Bytes of all of them, with the padding behind each.
    pub total: u64,
    /// Bytes that this program may use on the device.
    pub budget: u64,
}

impl fmt::Display for MemoryPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (name, bytes) in &self.buffers {
            writeln!(f, "{:>12}  {name}", mib(*bytes))?;
        }
        write!(
            f,
            "{:>12}  in all, of {}",
            mib(self.total),
            mib(self.budget)
        )
    }
}

/// Words behind a buffer that something changed.
#[derive(Clone, Debug, PartialEq)]
pub struct Overrun {
    /// The buffer's name and bytes.
    pub buffer: String,
    pub bytes: u64,
    /// Byte behind the end where the first changed word lies.
    pub first: u64,
    /// That word.
    pub value: u32,
    /// How many words changed.
    pub words: u64,
}

impl fmt::Display for Overrun {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Overrun {
            buffer,
            bytes,
            first,
            value,
            words,
        } = self;
        let float = f32::from_bits(*value);
        write!(
            f,
            "buffer '{buffer}' of {bytes} bytes: {words} words behind it were written, the first at byte +{first} ({value:#x} = {float:e})"
        )
    }
}

impl Gpu {
    /// All buffers in use, and what the device has for them.
    pub fn memory_plan(&self) -> MemoryPlan {
        let memory = &self.inner.memory;
        let slabs = memory.slabs();
        let mut buffers: Vec<(String, u64)> = slabs
            .iter()
            .map(|slab| (slab.name.clone(), slab.bytes))
            .collect();
        buffers.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        let total = slabs.iter().map(|slab| slab.parts.size).sum();
        let (budget, _) = memory.budget(&self.inner.context, &self.inner.info);
        MemoryPlan {
            buffers,
            total,
            budget,
        }
    }

    /// In guard mode: every buffer behind whose end something was written, once all submitted work is done. A kernel that writes further
    /// than 64 KiB past the end is not seen. Panics where the device was opened without guard mode.
    pub fn check_guards(&self) -> Result<Vec<Overrun>> {
        assert!(
            self.inner.options.guard,
            "check_guards needs GpuOptions::guard"
        );
        let mut overruns = Vec::new();
        let mut words = Vec::new();
        for slab in self.inner.memory.slabs() {
            let start = slab.guard_start();
            words.clear();
            words.resize(((slab.parts.size - start) / 4) as usize, 0u32);
            self.download_bytes(&slab, start, bytemuck::cast_slice_mut(&mut words))?;
            let mut changed = words.iter().enumerate().filter(|(_, word)| **word != GUARD);
            if let Some((at, &value)) = changed.next() {
                let first = start + 4 * at as u64 - slab.bytes;
                let words = 1 + changed.count() as u64;
                overruns.push(Overrun {
                    buffer: slab.name.clone(),
                    bytes: slab.bytes,
                    first,
                    value,
                    words,
                });
            }
        }
        Ok(overruns)
    }
}
