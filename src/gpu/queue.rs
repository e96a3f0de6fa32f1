//! Submission: one compute queue, one timeline semaphore that counts submissions, two calls of `submit` in flight.

use super::device::{Context, Gpu, vulkan};
use super::hazards::Hazards;
use super::memory::{Memory, Parts};
use super::profile::Stamps;
use super::recorder::Recorder;
use crate::Result;
use ash::vk;
use std::sync::{Mutex, MutexGuard};
use std::thread::ThreadId;

/// Work that was submitted; done when the timeline semaphore reaches its value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Ticket(pub(super) u64);

/// The queue and what is in flight.
pub(super) struct Queue {
    state: Mutex<QueueState>,
    /// Who records; a second recording by the same thread would wait for itself.
    recording: Mutex<Option<ThreadId>>,
    discarded: Mutex<Discarded>,
    pub(super) timeline: vk::Semaphore,
    device: ash::Device,
}

/// What a recording works on.
pub(super) struct QueueState {
    pub(super) slots: [Slot; 2],
    pub(super) current: usize,
    /// Value of the last submission.
    pub(super) submitted: u64,
    pub(super) hazards: Hazards,
}

/// Command buffers of one call; reset and used again two calls later.
pub(super) struct Slot {
    pool: vk::CommandPool,
    buffers: Vec<vk::CommandBuffer>,
    used: usize,
    last: u64,
    pub(super) stamps: Stamps,
}

/// Memory whose owner is gone while the device may still use it: (value to wait for, memory).
#[derive(Default)]
struct Discarded {
    waiting: Vec<(u64, Parts)>,
    /// Value that covers all work submitted or being recorded.
    horizon: u64,
}

/// The value of work that is being recorded and has no number yet.
const RECORDING: u64 = u64::MAX;

impl Queue {
    pub(super) fn new(context: &Context) -> Result<Queue> {
        let device = &context.device;
        let mut kind =
            vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
        let create = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
        // SAFETY: a live device with timeline semaphores.
        let timeline = unsafe { device.create_semaphore(&create, None) }
            .map_err(vulkan("vkCreateSemaphore"))?;
        let slot = || {
            let create = vk::CommandPoolCreateInfo::default()
                .flags(vk::CommandPoolCreateFlags::TRANSIENT)
                .queue_family_index(context.family);
            // SAFETY: a live device and one of its queue families.
            let pool = unsafe { device.create_command_pool(&create, None) }
                .map_err(vulkan("vkCreateCommandPool"))?;
            Ok(Slot {
                pool,
                buffers: Vec::new(),
                used: 0,
                last: 0,
                stamps: Stamps::default(),
            })
        };
        let slots = [slot()?, slot()?];
        let state = QueueState {
            slots,
            current: 0,
            submitted: 0,
            hazards: Hazards::default(),
        };
        Ok(Queue {
            state: Mutex::new(state),
            recording: Mutex::new(None),
            discarded: Mutex::default(),
            timeline,
            device: device.clone(),
        })
    }

    /// The queue's state, for the call `name`; a thread that is recording would wait for itself.
    fn lock(&self, name: &str) -> MutexGuard<'_, QueueState> {
        let recording = *self.recording.lock().expect("no panic under the lock");
        assert!(
            recording != Some(std::thread::current().id()),
            "'{name}' inside another submit"
        );
        self.state
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// Frees memory now, or when the work that may use it is done.
    pub(super) fn discard(&self, memory: &Memory, parts: Parts) {
        let mut discarded = self.discarded.lock().expect("no panic under the lock");
        if self.completed().is_ok_and(|done| done >= discarded.horizon) {
            drop(discarded);
            memory.free(parts);
        } else {
            let horizon = discarded.horizon;
            discarded.waiting.push((horizon, parts));
        }
    }

    /// Frees what was discarded and is no longer in use; everything after a lost device or before the end.
    fn collect(&self, memory: &Memory, done: u64) {
        let mut discarded = self.discarded.lock().expect("no panic under the lock");
        let (free, keep) = std::mem::take(&mut discarded.waiting)
            .into_iter()
            .partition(|(value, _)| *value <= done);
        discarded.waiting = keep;
        drop(discarded);
        let free: Vec<(u64, Parts)> = free;
        free.into_iter().for_each(|(_, parts)| memory.free(parts));
    }

    /// Waits for everything and frees everything discarded: the last handle is going.
    pub(super) fn collect_all(&self, memory: &Memory) {
        // SAFETY: a live device. A lost one has stopped as well.
        let _ = unsafe { self.device.device_wait_idle() };
        self.collect(memory, RECORDING);
    }

    fn begin(&self) {
        self.discarded
            .lock()
            .expect("no panic under the lock")
            .horizon = RECORDING;
    }

    /// The recording is over; `value` covers what it submitted.
    fn end(&self, value: u64) {
        let mut discarded = self.discarded.lock().expect("no panic under the lock");
        discarded.horizon = value;
        discarded
            .waiting
            .iter_mut()
            .filter(|(v, _)| *v == RECORDING)
            .for_each(|(v, _)| *v = value);
    }

    fn completed(&self) -> Result<u64> {
        // SAFETY: a live semaphore.
        unsafe { self.device.get_semaphore_counter_value(self.timeline) }
            .map_err(vulkan("vkGetSemaphoreCounterValue"))
    }

    fn wait(&self, value: u64) -> Result<()> {
        let (semaphores, values) = ([self.timeline], [value]);
        let info = vk::SemaphoreWaitInfo::default()
            .semaphores(&semaphores)
            .values(&values);
        // SAFETY: a live semaphore.
        unsafe { self.device.wait_semaphores(&info, u64::MAX) }.map_err(vulkan("vkWaitSemaphores"))
    }
}

impl Drop for Queue {
    fn drop(&mut self) {
        let state = self
            .state
            .get_mut()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        // SAFETY: collect_all has waited, and nobody is left to submit.
        unsafe {
            for slot in &mut state.slots {
                slot.stamps.destroy(&self.device);
                self.device.destroy_command_pool(slot.pool, None);
            }
            self.device.destroy_semaphore(self.timeline, None);
        }
    }
}

impl QueueState {
    /// An empty command buffer of the current slot, begun.
    pub(super) fn command_buffer(&mut self, device: &ash::Device) -> Result<vk::CommandBuffer> {
        let slot = &mut self.slots[self.current];
        if slot.used == slot.buffers.len() {
            let wanted = vk::CommandBufferAllocateInfo::default()
                .command_pool(slot.pool)
                .command_buffer_count(4);
            // SAFETY: a live pool, used under the queue's lock.
            let more = unsafe { device.allocate_command_buffers(&wanted) }
                .map_err(vulkan("vkAllocateCommandBuffers"))?;
            slot.buffers.extend(more);
        }
        let commands = slot.buffers[slot.used];
        slot.used += 1;
        let begin = vk::CommandBufferBeginInfo::default()
            .flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: its pool was reset after its last use.
        unsafe { device.begin_command_buffer(commands, &begin) }
            .map_err(vulkan("vkBeginCommandBuffer"))?;
        Ok(commands)
    }

    /// Hands a recorded command buffer to the device.
    pub(super) fn submit(&mut self, gpu: &Gpu, commands: vk::CommandBuffer) -> Result<()> {
        let value = self.submitted + 1;
        let (buffers, semaphores, values) = ([commands], [gpu.inner.queue.timeline], [value]);
        let mut timeline =
            vk::TimelineSemaphoreSubmitInfo::default().signal_semaphore_values(&values);
        let submit = [vk::SubmitInfo::default()
            .command_buffers(&buffers)
            .signal_semaphores(&semaphores)
            .push_next(&mut timeline)];
        // SAFETY: a finished command buffer; the queue is used under its lock.
        unsafe {
            gpu.inner
                .device()
                .queue_submit(gpu.inner.context.queue, &submit, vk::Fence::null())
        }
        .map_err(vulkan("vkQueueSubmit"))?;
        self.submitted = value;
        self.slots[self.current].last = value;
        Ok(())
    }
}

impl Gpu {
    /// Records work and hands it to the device, in pieces that each take the device a fraction of a second. Returns at once, unless two
    /// earlier calls are still running: then it waits for the older. `name` labels it in debuggers and profiles.
    ///
    /// What `record` returns as an error is returned; the pieces that went out before it stay submitted.
    pub fn submit(
        &self,
        name: &str,
        record: impl FnOnce(&mut Recorder) -> Result<()>,
    ) -> Result<Ticket> {
        let queue = &self.inner.queue;
        let mut state = queue.lock(name);
        let _recording = Recording::begin(queue);

        state.current = 1 - state.current;
        let current = state.current;
        queue.wait(state.slots[current].last)?;
        queue.collect(&self.inner.memory, queue.completed()?);
        let slot = &mut state.slots[current];
        // SAFETY: its command buffers are done, as was just waited for.
        unsafe {
            self.inner
                .device()
                .reset_command_pool(slot.pool, vk::CommandPoolResetFlags::empty())
        }
        .map_err(vulkan("vkResetCommandPool"))?;
        slot.used = 0;
        self.inner
            .profiler
            .take(self.inner.device(), &mut slot.stamps)?;

        queue.begin();
        let before = state.submitted;
        let mut recorder = Recorder::new(self, &mut state, name);
        let recorded = record(&mut recorder);
        let finished = recorder.finish(recorded);
        queue.end(state.submitted);
        finished?;
        // (Of every step: the finest level.)
        let submissions = state.submitted - before;
        if submissions > 1 {
            tracing::trace!(name, submissions, "work cut");
        }
        Ok(Ticket(state.submitted))
    }

    /// Waits until the work is done.
    pub fn wait(&self, ticket: Ticket) -> Result<()> {
        self.inner.queue.wait(ticket.0)
    }

    /// Waits until all submitted work is done.
    pub fn finish(&self) -> Result<()> {
        let submitted = self.inner.queue.lock("finish").submitted;
        self.inner.queue.wait(submitted)?;
        self.inner.queue.collect(&self.inner.memory, submitted);
        Ok(())
    }

    /// Waits for everything and reads its timestamps.
    pub(super) fn read_stamps(&self) -> Result<()> {
        let queue = &self.inner.queue;
        let mut state = queue.lock("profile");
        queue.wait(state.submitted)?;
        let older = 1 - state.current;
        for slot in [older, 1 - older] {
            self.inner
                .profiler
                .take(self.inner.device(), &mut state.slots[slot].stamps)?;
        }
        Ok(())
    }

    /// Whether the work is done.
    pub fn is_done(&self, ticket: Ticket) -> Result<bool> {
        Ok(self.inner.queue.completed()? >= ticket.0)
    }
}

/// Marks the thread that records, for as long as it does.
struct Recording<'a>(&'a Queue);

impl<'a> Recording<'a> {
    fn begin(queue: &'a Queue) -> Self {
        let thread = std::thread::current().id();
        *queue.recording.lock().expect("no panic under the lock") = Some(thread);
        Recording(queue)
    }
}

impl Drop for Recording<'_> {
    fn drop(&mut self) {
        *self.0.recording.lock().expect("no panic under the lock") = None;
    }
}
