//! Profiles: two timestamps around every launch, summed by row.
//!
//! Timing is on where the device was opened with [`super::GpuOptions::profile`]; the recorder then puts a barrier before every command,
//! so that a row's time is its own. Timestamps are put on the host's clock by one that was taken when the device was opened, to within
//! the time of an empty submission (about 0.1 ms).

use super::device::{Context, Gpu, vulkan};
use super::instance::DeviceInfo;
use crate::{Error, Result};
use ash::vk;
use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Instant;

/// Launches that one query pool times.
const LAUNCHES_PER_POOL: usize = 512;
/// Events that are kept; later ones enter the rows only.
const MOST_EVENTS: usize = 1 << 20;

/// What one kernel, or one label of it, took.
#[derive(Clone, Debug, PartialEq)]
pub struct ProfileRow {
    /// The kernel's file stem and label; "(copy)" and "(fill)" for transfers.
    pub name: String,
    pub launches: u64,
    /// Milliseconds on the device: of all launches, and of the fastest, middle and slowest.
    pub total_ms: f64,
    pub min_ms: f64,
    pub median_ms: f64,
    pub max_ms: f64,
    /// Floating-point operations and bytes of all launches, as [`super::Work`] was told; 0 where it was not.
    pub flops: f64,
    pub bytes: f64,
}

/// One launch, or one part of a launch that was cut.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    pub row: Arc<str>,
    /// Name of the [`Gpu::submit`] that it belongs to.
    pub call: Arc<str>,
    /// Nanoseconds since the device was opened ([`Gpu::now_ns`]).
    pub begin_ns: i64,
    pub end_ns: i64,
}

/// What the device did since it was opened, or since [`Gpu::reset_profile`].
#[derive(Clone, Debug, Default)]
pub struct Profile {
    /// By total time, longest first.
    pub rows: Vec<ProfileRow>,
    /// In order; the first million.
    pub events: Vec<Event>,
}

/// A timed command of one call.
pub(super) struct Entry {
    pub(super) row: Arc<str>,
    pub(super) call: Arc<str>,
    /// False for the later parts of a launch that was cut.
    pub(super) first: bool,
    pub(super) flops: f64,
    pub(super) bytes: f64,
}

/// Query pools of one slot of the queue, and what each pair of timestamps stands for.
#[derive(Default)]
pub(super) struct Stamps {
    pools: Vec<vk::QueryPool>,
    entries: Vec<Entry>,
}

/// Clock and tables.
pub(super) struct Profiler {
    opened: Instant,
    /// Nanoseconds per tick, and how many bits of a timestamp count.
    period: f64,
    valid_bits: u32,
    tables: Mutex<Tables>,
}

#[derive(Default)]
struct Tables {
    ticks: Ticks,
    /// What the host's clock said at the first timestamp.
    first_ns: i64,
    rows: HashMap<Arc<str>, Row>,
    events: Vec<Event>,
}

/// The device's clock, which begins again behind its last bit: read on past it.
#[derive(Default)]
struct Ticks {
    last: Option<u64>,
    since_first: i64,
}

impl Ticks {
    /// From the first timestamp to this one, less than half a round of the clock before or after the last one.
    fn at(&mut self, stamp: u64, valid_bits: u32) -> i64 {
        let step = stamp.wrapping_sub(self.last.unwrap_or(stamp));
        let unused = u64::BITS - valid_bits;
        self.since_first += (step << unused) as i64 >> unused;
        self.last = Some(stamp);
        self.since_first
    }
}

#[derive(Default)]
struct Row {
    ms: Vec<f32>,
    flops: f64,
    bytes: f64,
}

impl Profiler {
    pub(super) fn new(info: &DeviceInfo, valid_bits: u32) -> Profiler {
        Profiler {
            opened: Instant::now(),
            period: info.timestamp_period,
            valid_bits,
            tables: Mutex::default(),
        }
    }

    /// Refuses where the device has no clock.
    pub(super) fn check(&self, info: &DeviceInfo) -> Result<()> {
        match self.valid_bits {
            0 => Err(Error::NoDevice {
                what: format!(
                    "{} has no timestamps, so it cannot be profiled\n  next: run without",
                    info.name
                ),
            }),
            _ => Ok(()),
        }
    }

    /// Reads the timestamps of a call that is done.
    pub(super) fn take(&self, device: &ash::Device, stamps: &mut Stamps) -> Result<()> {
        let mut tables = self.tables.lock().expect("no panic under the lock");
        let Tables {
            ticks,
            first_ns,
            rows,
            events,
        } = &mut *tables;
        let mut entries = stamps.entries.drain(..);
        let mut times = Vec::new();
        for pool in &stamps.pools {
            let entries: Vec<Entry> = entries.by_ref().take(LAUNCHES_PER_POOL).collect();
            times.clear();
            times.resize(2 * entries.len(), [0u64; 2]); // (ticks, whether they are there)
            if times.is_empty() {
                break;
            }
            let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WITH_AVAILABILITY;
            // SAFETY: a live pool whose writes are done.
            let read = unsafe { device.get_query_pool_results(*pool, 0, &mut times, flags) };
            match read {
                Ok(()) | Err(vk::Result::NOT_READY) => {}
                Err(error) => return Err(vulkan("vkGetQueryPoolResults")(error)),
            }
            for (entry, pair) in entries.into_iter().zip(times.chunks_exact(2)) {
                let [[begin, there], [end, there_too]] = [pair[0], pair[1]];
                if there == 0 || there_too == 0 {
                    continue; // recorded, never submitted: the recording failed
                }
                let [begin, end] = [begin, end].map(|stamp| ticks.at(stamp, self.valid_bits));
                let ns = |ticks: i64| *first_ns + (ticks as f64 * self.period) as i64;
                let ms = (end - begin) as f64 * self.period * 1e-6;
                let row = rows.entry(entry.row.clone()).or_default();
                match row.ms.last_mut() {
                    Some(last) if !entry.first => *last += ms as f32,
                    _ => row.ms.push(ms as f32),
                }
                row.flops += entry.flops;
                row.bytes += entry.bytes;
                if events.len() < MOST_EVENTS {
                    events.push(Event {
                        row: entry.row,
                        call: entry.call,
                        begin_ns: ns(begin),
                        end_ns: ns(end),
                    });
                }
            }
        }
        Ok(())
    }
}

impl Stamps {
    /// Notes a command and writes the timestamp before it; returns where the one behind it goes.
    pub(super) fn begin(
        &mut self,
        context: &Context,
        commands: vk::CommandBuffer,
        entry: Entry,
    ) -> Result<(vk::QueryPool, u32)> {
        let (pool, within) = (
            self.entries.len() / LAUNCHES_PER_POOL,
            self.entries.len() % LAUNCHES_PER_POOL,
        );
        let queries = 2 * LAUNCHES_PER_POOL as u32;
        if pool == self.pools.len() {
            let create = vk::QueryPoolCreateInfo::default()
                .query_type(vk::QueryType::TIMESTAMP)
                .query_count(queries);
            // SAFETY: a live device.
            let made = unsafe { context.device.create_query_pool(&create, None) }
                .map_err(vulkan("vkCreateQueryPool"))?;
            self.pools.push(made);
        }
        let pool = self.pools[pool];
        let query = 2 * within as u32;
        // SAFETY: an open command buffer; the pool's last use is over, since its slot was waited for.
        unsafe {
            if within == 0 {
                context
                    .device
                    .cmd_reset_query_pool(commands, pool, 0, queries);
            }
            context.device.cmd_write_timestamp(
                commands,
                vk::PipelineStageFlags::BOTTOM_OF_PIPE,
                pool,
                query,
            );
        }
        self.entries.push(entry);
        Ok((pool, query + 1))
    }

    pub(super) fn destroy(&mut self, device: &ash::Device) {
        for pool in self.pools.drain(..) {
            // SAFETY: the queue is idle.
            unsafe { device.destroy_query_pool(pool, None) };
        }
    }
}

impl Gpu {
    /// Nanoseconds since the device was opened: the clock of [`Event`].
    pub fn now_ns(&self) -> i64 {
        self.inner.profiler.opened.elapsed().as_nanos() as i64
    }

    /// Waits for all submitted work and says what it took. Empty where the device was opened without [`super::GpuOptions::profile`].
    pub fn profile(&self) -> Result<Profile> {
        self.read_stamps()?;
        let tables = self
            .inner
            .profiler
            .tables
            .lock()
            .expect("no panic under the lock");
        let mut rows: Vec<ProfileRow> = tables
            .rows
            .iter()
            .map(|(name, row)| row.summary(name))
            .collect();
        rows.sort_by(|a, b| {
            b.total_ms
                .total_cmp(&a.total_ms)
                .then_with(|| a.name.cmp(&b.name))
        });
        Ok(Profile {
            rows,
            events: tables.events.clone(),
        })
    }

    /// Waits for all submitted work and forgets what it took: for leaving a warm-up out.
    pub fn reset_profile(&self) -> Result<()> {
        self.read_stamps()?;
        let mut tables = self
            .inner
            .profiler
            .tables
            .lock()
            .expect("no panic under the lock");
        tables.rows.clear();
        tables.events.clear();
        Ok(())
    }

    /// Finds out what the host's clock says at a timestamp: the middle of an empty submission's life, of the shortest of a few.
    pub(super) fn set_clock(&self) -> Result<()> {
        let mut lives = Vec::new();
        for _ in 0..8 {
            let sent = self.now_ns();
            let ticket = self.submit("clock", |rec| {
                rec.stamp_nothing();
                Ok(())
            })?;
            self.wait(ticket)?;
            lives.push((sent, self.now_ns()));
        }
        let stamps = self.profile()?.events; // until now in nanoseconds since the first of them
        self.reset_profile()?;
        let shortest = stamps
            .iter()
            .zip(lives)
            .min_by_key(|(_, (sent, there))| there - sent);
        let mut tables = self
            .inner
            .profiler
            .tables
            .lock()
            .expect("no panic under the lock");
        if let Some((stamp, (sent, there))) = shortest {
            tables.first_ns = (sent + there) / 2 - stamp.begin_ns;
        }
        Ok(())
    }
}

impl Row {
    fn summary(&self, name: &str) -> ProfileRow {
        let mut sorted = self.ms.clone();
        sorted.sort_by(f32::total_cmp);
        let at = |i: usize| sorted.get(i).copied().unwrap_or(0.0) as f64;
        ProfileRow {
            name: name.to_string(),
            launches: sorted.len() as u64,
            total_ms: sorted.iter().map(|&ms| ms as f64).sum(),
            min_ms: at(0),
            median_ms: at(sorted.len() / 2),
            max_ms: at(sorted.len().saturating_sub(1)),
            flops: self.flops,
            bytes: self.bytes,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_begins_again_goes_on() {
        for valid_bits in [36, 64] {
            let last = u64::MAX >> (u64::BITS - valid_bits);
            let third = (last / 3) as i64;
            // Over the end, a little back, and on; with few bits for some rounds.
            let rounds = (1..10).map(|k| k * third);
            let long = rounds.take_while(|_| valid_bits < 64);
            let mut ticks = Ticks::default();
            for since_first in [0, 5, 9, 3, 12].into_iter().chain(long) {
                let stamp = (last - 7).wrapping_add_signed(since_first) & last;
                assert_eq!(ticks.at(stamp, valid_bits), since_first);
            }
        }
    }
}
