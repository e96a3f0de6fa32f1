//! Recording: launches, copies and fills, in the order in which they take effect.
//!
//! The caller says how many items; grid, limits, barriers and the cut into submissions are made here. A grid has rows of at most 256
//! workgroups, equally long, since one dimension ends at 65535. Submissions are cut by estimated time, because a watchdog ends what runs for
//! seconds; one large launch is itself cut along its rows.

use super::buffer::Buffer;
use super::device::{Gpu, vulkan};
use super::instance::DeviceKind;
use super::kernel::Kernel;
use super::memory::Slab;
use super::profile::Entry;
use super::queue::QueueState;
use crate::{Error, Result};
use ash::vk;
use bytemuck::Pod;
use std::ops::Range;
use std::sync::Arc;

/// Seconds of estimated work after which a submission is cut.
const SUBMISSION_SECONDS: f64 = 0.2;
/// Workgroups in one row of a grid, at most. All rows of a launch are equally long: a short last one would leave processors idle.
const ROW: u64 = 256;
/// What one dimension of a grid has everywhere.
const MAX_GROUPS: u64 = 65535;
/// One fill or copy command covers at most this: software drivers compute with 32-bit sizes.
const TRANSFER_CHUNK: u64 = 1 << 30;
/// Assumed where a caller says nothing.
const DEFAULT_FLOPS: f64 = 100.0;
const DEFAULT_BYTES: f64 = 64.0;

/// How much a launch does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Work {
    count: Count,
    turns: u64,
    parts: u32,
    slices: u32,
    flops: Option<f64>,
    bytes: Option<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Count {
    Items(u64),
    Groups(u64),
}

impl Work {
    /// One invocation for each of `n` items (`item()` in GLSL), rounded up to whole rows of workgroups.
    pub fn items(n: u64) -> Work {
        Work {
            count: Count::Items(n),
            turns: 1,
            parts: 1,
            slices: 1,
            flops: None,
            bytes: None,
        }
    }

    /// One workgroup for each of `n` items (`group()` in GLSL), rounded up to whole rows.
    pub fn groups(n: u64) -> Work {
        Work {
            count: Count::Groups(n),
            ..Work::items(0)
        }
    }

    /// Each invocation takes so many of the items.
    pub fn turns(self, turns: u64) -> Work {
        Work { turns, ..self }
    }

    /// So many workgroups, neighbours in the launch, take a part each of what the same items ask for (`group() % parts` in GLSL).
    pub fn parts(self, k: u32) -> Work {
        Work { parts: k, ..self }
    }

    /// Repeats the launch along a second dimension (`slice()` in GLSL): levels, layers, axes.
    pub fn slices(self, k: u32) -> Work {
        Work { slices: k, ..self }
    }

    /// Floating-point operations of one item in one part and slice, for estimates and the profile.
    pub fn flops(self, per_item: f64) -> Work {
        Work {
            flops: Some(per_item),
            ..self
        }
    }

    /// Bytes that one item in one part and slice moves.
    pub fn bytes(self, per_item: f64) -> Work {
        Work {
            bytes: Some(per_item),
            ..self
        }
    }

    fn count(&self) -> u64 {
        match self.count {
            Count::Items(n) | Count::Groups(n) => n,
        }
    }

    /// (flops, bytes) of a part of the work, as far as the caller gave them.
    fn given(&self, part: f64) -> (f64, f64) {
        let scale = self.total() * part;
        (
            scale * self.flops.unwrap_or(0.0),
            scale * self.bytes.unwrap_or(0.0),
        )
    }

    /// Items in all parts and slices.
    fn total(&self) -> f64 {
        self.count() as f64 * f64::from(self.parts) * f64::from(self.slices)
    }
}

/// Records one call of [`Gpu::submit`].
pub struct Recorder<'a> {
    gpu: &'a Gpu,
    state: &'a mut QueueState,
    name: &'a str,
    /// The name again, shared with the profile's events; made where there are any.
    call: Option<Arc<str>>,
    /// The open command buffer.
    commands: Option<vk::CommandBuffer>,
    /// Estimated seconds in it.
    seconds: f64,
    /// The first failure; what is recorded after it goes nowhere.
    error: Option<Error>,
}

impl<'a> Recorder<'a> {
    pub(super) fn new(gpu: &'a Gpu, state: &'a mut QueueState, name: &'a str) -> Self {
        state.hazards.start();
        Recorder {
            gpu,
            state,
            name,
            call: gpu.inner.options.profile.then(|| name.into()),
            commands: None,
            seconds: 0.0,
            error: None,
        }
    }

    /// Submits what is left; the caller's error, or the first of the recording.
    pub(super) fn finish(mut self, recorded: Result<()>) -> Result<()> {
        if recorded.is_err() || self.error.is_some() {
            // An unfinished command buffer is reset with its pool.
            return recorded.and(self.error.map_or(Ok(()), Err));
        }
        if let Some(commands) = self.commands {
            let barrier = [vk::MemoryBarrier::default()
                .src_access_mask(vk::AccessFlags::SHADER_WRITE | vk::AccessFlags::TRANSFER_WRITE)
                .dst_access_mask(vk::AccessFlags::HOST_READ)];
            let stages = vk::PipelineStageFlags::COMPUTE_SHADER | vk::PipelineStageFlags::TRANSFER;
            // SAFETY: an open command buffer of this recording.
            unsafe {
                let device = self.gpu.inner.device();
                device.cmd_pipeline_barrier(
                    commands,
                    stages,
                    vk::PipelineStageFlags::HOST,
                    vk::DependencyFlags::empty(),
                    &barrier,
                    &[],
                    &[],
                );
            }
        }
        self.cut()
    }

    /// Runs a kernel over `work`. Nothing happens where there is no item.
    ///
    /// Panics where a pointer in `args` lies in no living buffer of this device, or where the grid does not fit into 65535 rows.
    pub fn run<A: Pod>(&mut self, kernel: &Kernel<A>, work: Work, args: A) {
        let local = kernel.local_size() as u64;
        let groups = match work.count {
            Count::Items(n) => n.div_ceil(local * work.turns),
            Count::Groups(n) => n,
        } * u64::from(work.parts);
        if groups == 0 || work.slices == 0 || self.error.is_some() {
            return;
        }
        let rows = groups.div_ceil(ROW);
        let width = groups.div_ceil(rows);
        let limit = u64::from(u32::MAX) / (ROW * local);
        assert!(
            rows <= MAX_GROUPS.min(limit) && work.slices as u64 <= MAX_GROUPS,
            "{}: {} items in {} slices, {rows} rows of workgroups; a launch ends at {}",
            kernel.row,
            work.count(),
            work.slices,
            MAX_GROUPS.min(limit)
        );
        assert!(
            Arc::ptr_eq(&self.gpu.inner, &kernel.gpu.inner),
            "{}: a kernel of another device",
            kernel.row
        );

        let pipeline = match work.count {
            Count::Items(n) => self.gpu.pipeline_for(kernel, n),
            Count::Groups(_) => Ok(kernel.pipeline),
        };
        let pipeline = match pipeline {
            Ok(pipeline) => pipeline,
            Err(error) => {
                self.error = Some(error);
                return;
            }
        };
        let block = bytemuck::bytes_of(&args);
        self.find_accesses(kernel, block);
        self.order(kernel.module.indirect_reads, kernel.module.indirect_writes);

        let seconds = self.estimate(
            work.total() * work.flops.unwrap_or(DEFAULT_FLOPS),
            work.total() * work.bytes.unwrap_or(DEFAULT_BYTES),
        );
        let slices = work.slices as u64;
        let cells = ((rows * slices) as f64 * (SUBMISSION_SECONDS / seconds).min(1.0))
            .floor()
            .max(1.0) as u64;
        let (rows_at_once, slices_at_once) = if cells >= slices {
            (cells / slices, slices)
        } else {
            (1, cells)
        };
        for first_row in (0..rows).step_by(rows_at_once as usize) {
            for first_slice in (0..slices).step_by(slices_at_once as usize) {
                let n_rows = rows_at_once.min(rows - first_row);
                let n_slices = slices_at_once.min(slices - first_slice);
                let part = (n_rows * n_slices) as f64 / (rows * slices) as f64;
                let Some(commands) = self.open(seconds * part) else {
                    return;
                };
                let layout = self.gpu.inner.pipelines.layout;
                let whole = (first_row, first_slice) == (0, 0);
                let cost = work.given(part);
                let end = self.begin_stamp(commands, &kernel.row, whole, cost);
                let device = self.gpu.inner.device();
                self.begin_label(commands, &kernel.row);
                // SAFETY: an open command buffer, a pipeline made with this layout, a block within its range.
                unsafe {
                    device.cmd_bind_pipeline(commands, vk::PipelineBindPoint::COMPUTE, pipeline);
                    device.cmd_push_constants(
                        commands,
                        layout,
                        vk::ShaderStageFlags::COMPUTE,
                        0,
                        block,
                    );
                    device.cmd_dispatch_base(
                        commands,
                        0,
                        first_row as u32,
                        first_slice as u32,
                        width as u32,
                        n_rows as u32,
                        n_slices as u32,
                    );
                }
                self.end_label(commands);
                self.end_stamp(commands, end);
            }
        }
    }

    /// Copies `len` elements. The ranges must not overlap.
    pub fn copy<T: Pod>(
        &mut self,
        from: &Buffer<T>,
        from_first: u64,
        to: &Buffer<T>,
        to_first: u64,
        len: u64,
    ) {
        let source = from.byte_range(from_first..from_first + len);
        let target = to.byte_range(to_first..to_first + len);
        self.state.hazards.reads.push(from.slab.id);
        self.state.hazards.writes.push(to.slab.id);
        self.copy_bytes(
            from.slab.parts.raw,
            source.start,
            to.slab.parts.raw,
            target.start,
            source.end - source.start,
        );
    }

    /// Writes one word over a range of elements.
    pub fn fill<T: Pod>(&mut self, buffer: &Buffer<T>, range: Range<u64>, word: u32) {
        self.fill_bytes(&buffer.slab, buffer.byte_range(range), word);
    }

    pub(super) fn fill_bytes(&mut self, slab: &Slab, range: Range<u64>, word: u32) {
        assert!(
            range.start.is_multiple_of(4) && range.end.is_multiple_of(4),
            "{}: a fill of bytes {range:?} is no whole number of words",
            slab.name
        );
        self.state.hazards.writes.push(slab.id);
        self.order(false, false);
        let mut at = range.start;
        while at < range.end {
            let len = TRANSFER_CHUNK.min(range.end - at);
            let Some(commands) = self.open(self.estimate(0.0, len as f64)) else {
                return;
            };
            let end = self.begin_stamp(commands, "(fill)", at == range.start, (0.0, len as f64));
            // SAFETY: an open command buffer; the range lies in the buffer.
            unsafe {
                self.gpu
                    .inner
                    .device()
                    .cmd_fill_buffer(commands, slab.parts.raw, at, len, word)
            };
            self.end_stamp(commands, end);
            at += len;
        }
    }

    /// Copies bytes between buffers whose accesses have been noted.
    pub(super) fn copy_bytes(
        &mut self,
        from: vk::Buffer,
        from_at: u64,
        to: vk::Buffer,
        to_at: u64,
        len: u64,
    ) {
        self.order(false, false);
        let mut done = 0;
        while done < len {
            let size = TRANSFER_CHUNK.min(len - done);
            let Some(commands) = self.open(self.estimate(0.0, 2.0 * size as f64)) else {
                return;
            };
            let regions = [vk::BufferCopy {
                src_offset: from_at + done,
                dst_offset: to_at + done,
                size,
            }];
            let end = self.begin_stamp(commands, "(copy)", done == 0, (0.0, 2.0 * size as f64));
            // SAFETY: an open command buffer; both ranges lie in their buffers.
            unsafe {
                self.gpu
                    .inner
                    .device()
                    .cmd_copy_buffer(commands, from, to, &regions)
            };
            self.end_stamp(commands, end);
            done += size;
        }
    }

    /// Notes that the next copy reads or writes this allocation.
    pub(super) fn note(&mut self, id: u64, writes: bool) {
        let hazards = &mut self.state.hazards;
        if writes {
            hazards.writes.push(id)
        } else {
            hazards.reads.push(id)
        }
    }

    /// Notes which allocations the block's pointers lie in.
    fn find_accesses<A>(&mut self, kernel: &Kernel<A>, block: &[u8]) {
        let live = self
            .gpu
            .inner
            .memory
            .live
            .read()
            .expect("no panic under the lock");
        for pointer in kernel.module.pointers {
            let address = u64::from_le_bytes(
                block[pointer.offset..pointer.offset + 8]
                    .try_into()
                    .expect("eight bytes"),
            );
            if address == 0 {
                continue;
            }
            let below = live
                .range(..=address)
                .next_back()
                .filter(|(start, span)| address <= *start + span.bytes);
            let Some((_, span)) = below else {
                panic!(
                    "{}: pointer {} = {address:#x} lies in no living buffer",
                    kernel.row, pointer.name
                );
            };
            match pointer.writable {
                true => self.state.hazards.writes.push(span.id),
                false => self.state.hazards.reads.push(span.id),
            }
        }
    }

    /// Puts a barrier before the next command where it touches what earlier ones wrote, or writes what they touched.
    fn order(&mut self, reads_any: bool, writes_any: bool) {
        let options = &self.gpu.inner.options;
        let always = options.barrier_everywhere || options.profile;
        if always || self.state.hazards.collide(reads_any, writes_any) {
            let Some(commands) = self.open(0.0) else {
                return;
            };
            let stages = vk::PipelineStageFlags::COMPUTE_SHADER | vk::PipelineStageFlags::TRANSFER;
            let writes = vk::AccessFlags::SHADER_WRITE | vk::AccessFlags::TRANSFER_WRITE;
            let reads = vk::AccessFlags::SHADER_READ | vk::AccessFlags::TRANSFER_READ;
            let barrier = [vk::MemoryBarrier::default()
                .src_access_mask(writes)
                .dst_access_mask(reads | writes)];
            // SAFETY: an open command buffer.
            unsafe {
                self.gpu.inner.device().cmd_pipeline_barrier(
                    commands,
                    stages,
                    stages,
                    vk::DependencyFlags::empty(),
                    &barrier,
                    &[],
                    &[],
                );
            }
            self.state.hazards.clear();
        }
        self.state.hazards.commit(reads_any, writes_any);
    }

    /// Estimated seconds of so much arithmetic and traffic: deliberately slow rates, for the cut only.
    fn estimate(&self, flops: f64, bytes: f64) -> f64 {
        let (flop_rate, byte_rate) = match self.gpu.inner.info.kind {
            DeviceKind::Discrete => (2e12, 1e11),
            DeviceKind::Integrated | DeviceKind::Virtual => (2e11, 2e10),
            DeviceKind::Cpu | DeviceKind::Other => (5e9, 1e9),
        };
        (flops / flop_rate).max(bytes / byte_rate).max(1e-6)
    }

    /// The open command buffer, with room for so many more seconds; `None` after a failure.
    fn open(&mut self, seconds: f64) -> Option<vk::CommandBuffer> {
        if self.error.is_some() {
            return None;
        }
        if self.commands.is_some()
            && self.seconds > 0.0
            && self.seconds + seconds > SUBMISSION_SECONDS
        {
            self.cut().map_err(|error| self.error = Some(error)).ok()?;
        }
        if self.commands.is_none() {
            let opened = self.state.command_buffer(self.gpu.inner.device());
            let commands = opened.map_err(|error| self.error = Some(error)).ok()?;
            self.commands = Some(commands);
            self.seconds = 0.0;
            self.begin_label(commands, self.name);
        }
        self.seconds += seconds;
        self.commands
    }

    /// Ends the open command buffer and submits it.
    fn cut(&mut self) -> Result<()> {
        let Some(commands) = self.commands.take() else {
            return Ok(());
        };
        self.end_label(commands);
        // SAFETY: an open command buffer.
        unsafe { self.gpu.inner.device().end_command_buffer(commands) }
            .map_err(vulkan("vkEndCommandBuffer"))?;
        self.state.submit(self.gpu, commands)
    }

    /// Writes the timestamp before a command, where the device is profiled; returns where the one behind it goes. `cost` is (flops, bytes).
    fn begin_stamp(
        &mut self,
        commands: vk::CommandBuffer,
        row: &str,
        first: bool,
        cost: (f64, f64),
    ) -> Option<(vk::QueryPool, u32)> {
        let call = self.call.clone()?;
        let entry = Entry {
            row: row.into(),
            call,
            first,
            flops: cost.0,
            bytes: cost.1,
        };
        let slot = self.state.current;
        let begun = self.state.slots[slot]
            .stamps
            .begin(&self.gpu.inner.context, commands, entry);
        begun.map_err(|error| self.error = Some(error)).ok()
    }

    fn end_stamp(&self, commands: vk::CommandBuffer, end: Option<(vk::QueryPool, u32)>) {
        let Some((pool, query)) = end else { return };
        // SAFETY: an open command buffer and the second query of a pair that was reset.
        unsafe {
            self.gpu.inner.device().cmd_write_timestamp(
                commands,
                vk::PipelineStageFlags::BOTTOM_OF_PIPE,
                pool,
                query,
            )
        };
    }

    /// Times nothing: for setting the clock.
    pub(super) fn stamp_nothing(&mut self) {
        let Some(commands) = self.open(0.0) else {
            return;
        };
        let end = self.begin_stamp(commands, "(clock)", true, (0.0, 0.0));
        self.end_stamp(commands, end);
    }

    fn begin_label(&self, commands: vk::CommandBuffer, name: &str) {
        let Some(debug) = &self.gpu.inner.context.debug else {
            return;
        };
        let mut text = [0u8; 64];
        let len = name.len().min(63);
        text[..len].copy_from_slice(&name.as_bytes()[..len]);
        let name = std::ffi::CStr::from_bytes_until_nul(&text).expect("the last byte is zero");
        let label = vk::DebugUtilsLabelEXT::default().label_name(name);
        // SAFETY: an open command buffer.
        unsafe { debug.cmd_begin_debug_utils_label(commands, &label) };
    }

    fn end_label(&self, commands: vk::CommandBuffer) {
        let Some(debug) = &self.gpu.inner.context.debug else {
            return;
        };
        // SAFETY: an open command buffer with an open label.
        unsafe { debug.cmd_end_debug_utils_label(commands) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::GpuOptions;

    #[test]
    fn a_long_launch_is_cut_into_submissions_and_a_short_one_is_not() -> Result<()> {
        use crate::kernels::fill;
        let gpu = Gpu::new(&GpuOptions::default())?;
        let values = gpu.buffer::<f32>("values", 64)?;
        let kernel = gpu.kernel(fill::Shape::default())?;
        let submissions = |seconds: f64, rows: u64, slices: u32| {
            let items = rows * ROW * 64;
            let before = gpu.submit("nothing", |_| Ok(()))?;
            let after = gpu.submit("launch", |rec| {
                // However fast the device: as many operations as are estimated to take so long.
                let flops =
                    seconds / rec.estimate(1e18, 0.0) * 1e18 / (items as f64 * slices as f64);
                let args = fill::Args {
                    values: values.ptr_mut(),
                    n: 64,
                    value: 1.0,
                };
                rec.run(
                    &kernel,
                    Work::items(items).slices(slices).flops(flops).bytes(0.0),
                    args,
                );
                Ok(())
            })?;
            Ok::<u64, Error>(after.0 - before.0)
        };
        assert_eq!(submissions(0.1, 8, 1)?, 1);
        assert_eq!(submissions(1.0, 10, 1)?, 5);
        assert_eq!(submissions(1.0, 5, 2)?, 5);
        assert_eq!(
            submissions(100.0, 3, 2)?,
            6,
            "no further than one row of one slice"
        );
        assert_eq!(submissions(1.0, 1, 10)?, 5);
        Ok(())
    }

    #[test]
    fn synchronisation_checks_see_a_missing_barrier() -> Result<()> {
        let options = GpuOptions {
            validation: true,
            ..GpuOptions::default()
        };
        let gpu = Gpu::new(&options)?;
        let words = gpu.buffer::<u32>("words", 64)?;
        let fill_twice = |forget: bool| {
            gpu.submit("twice", |rec| {
                rec.fill(&words, 0..64, 1);
                if forget {
                    rec.state.hazards.clear();
                }
                rec.fill(&words, 0..64, 2);
                Ok(())
            })
        };
        fill_twice(false)?;
        assert_eq!(gpu.validation_messages(), Vec::<String>::new());
        fill_twice(true)?;
        let said = gpu.validation_messages();
        assert!(
            said.iter().any(
                |text| text.contains("WRITE-AFTER-WRITE") || text.contains("WRITE_AFTER_WRITE")
            ),
            "{said:?}"
        );
        Ok(())
    }
}
