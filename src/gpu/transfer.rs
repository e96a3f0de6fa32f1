//! Uploads and downloads, through two halves of a host buffer that take turns: one is copied by the host while the device copies the other.

use super::buffer::Buffer;
use super::device::Gpu;
use super::memory::{Parts, Slab};
use super::queue::Ticket;
use crate::Result;
use bytemuck::Pod;
use gpu_allocator::MemoryLocation;

/// Bytes of one half.
const HALF: u64 = 8 << 20;
/// The staging buffer's number among allocations: no other has it.
const STAGING_ID: u64 = 0;

impl Gpu {
    /// Writes `data` to elements `first ..` and waits for the device.
    pub fn upload<T: Pod>(&self, buffer: &Buffer<T>, first: u64, data: &[T]) -> Result<()> {
        let target = buffer.byte_range(first..first + data.len() as u64);
        let bytes: &[u8] = bytemuck::cast_slice(data);
        self.staged(|gpu, staging| {
            let mut tickets: [Option<Ticket>; 2] = [None, None];
            for (turn, chunk) in bytes.chunks(HALF as usize).enumerate() {
                let half = turn % 2;
                if let Some(ticket) = tickets[half].take() {
                    gpu.wait(ticket)?;
                }
                let (at, to) = (half as u64 * HALF, target.start + turn as u64 * HALF);
                staging.write(at, chunk);
                let ticket = gpu.submit("upload", |rec| {
                    rec.note(STAGING_ID, false);
                    rec.note(buffer.slab.id, true);
                    rec.copy_bytes(
                        staging.raw,
                        at,
                        buffer.slab.parts.raw,
                        to,
                        chunk.len() as u64,
                    );
                    Ok(())
                })?;
                tickets[half] = Some(ticket);
            }
            tickets
                .into_iter()
                .flatten()
                .try_for_each(|ticket| gpu.wait(ticket))
        })
    }

    /// Elements `first .. first + len`, once everything submitted before has been done.
    pub fn download<T: Pod>(&self, buffer: &Buffer<T>, first: u64, len: u64) -> Result<Vec<T>> {
        let source = buffer.byte_range(first..first + len);
        let mut data = vec![T::zeroed(); len as usize];
        self.download_bytes(
            &buffer.slab,
            source.start,
            bytemuck::cast_slice_mut(&mut data),
        )?;
        Ok(data)
    }

    /// Bytes of a buffer, padding included.
    pub(super) fn download_bytes(&self, slab: &Slab, from: u64, out: &mut [u8]) -> Result<()> {
        self.staged(|gpu, staging| {
            let mut pending: Option<(Ticket, u64, &mut [u8])> = None;
            for (turn, chunk) in out.chunks_mut(HALF as usize).enumerate() {
                let (at, from) = ((turn % 2) as u64 * HALF, from + turn as u64 * HALF);
                let ticket = gpu.submit("download", |rec| {
                    rec.note(slab.id, false);
                    rec.note(STAGING_ID, true);
                    rec.copy_bytes(slab.parts.raw, from, staging.raw, at, chunk.len() as u64);
                    Ok(())
                })?;
                if let Some((ticket, at, chunk)) = pending.replace((ticket, at, chunk)) {
                    gpu.wait(ticket)?;
                    staging.read(at, chunk);
                }
            }
            if let Some((ticket, at, chunk)) = pending {
                gpu.wait(ticket)?;
                staging.read(at, chunk);
            }
            Ok(())
        })
    }

    /// Lends the staging buffer, made at its first use.
    fn staged(&self, work: impl FnOnce(&Gpu, &Parts) -> Result<()>) -> Result<()> {
        let memory = &self.inner.memory;
        let mut staging = memory
            .staging
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        if staging.is_none() {
            *staging = Some(memory.allocate(
                &self.inner.context,
                "staging",
                2 * HALF,
                MemoryLocation::GpuToCpu,
            )?);
        }
        work(self, staging.as_ref().expect("made just now"))
    }
}
