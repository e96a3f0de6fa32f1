//! Steps that are timed kernel by kernel: for `profile`, and for `bench`.

use crate::Result;
use crate::gpu::{Gpu, Profile, ProfileRow, Roofs};
use crate::train::Trainer;
use cpu_time::ProcessTime;
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::time::Instant;

/// What is said of an interrupted measurement.
pub(super) const STOPPED: &str = "stopped before all was timed";

/// How many steps are timed.
#[derive(Clone, Copy, Debug)]
pub(super) enum Until {
    Steps(u64),
    /// As many as this takes, at least a few.
    Seconds(f64),
}

/// What timed steps took together.
pub(super) struct Timed {
    pub profile: Profile,
    pub steps: u64,
    pub wall_ms: f64,
    /// Of all threads of this process: on a software device, the price of the steps; on a GPU, that of driving it.
    pub cpu_ms: f64,
}

/// Times steps of a trainer on a device that was opened with timestamps, after some that are not timed. `tell` hears of every step done,
/// and may end it all.
pub(super) fn time(
    gpu: &Gpu,
    trainer: &mut Trainer,
    warmup: u64,
    until: Until,
    tell: &mut dyn FnMut(u64) -> Result<()>,
) -> Result<Timed> {
    const LEAST: u64 = 4;
    let mut step = |trainer: &mut Trainer| -> Result<()> {
        trainer.step()?;
        tell(trainer.steps_done())
    };
    for _ in 0..warmup {
        step(trainer)?;
    }
    trainer.finish()?;
    gpu.reset_profile()?;
    let (begun, cpu_begun) = (Instant::now(), ProcessTime::now());
    let mut steps = 0;
    while match until {
        Until::Steps(wanted) => steps < wanted,
        Until::Seconds(seconds) => steps < LEAST || begun.elapsed().as_secs_f64() < seconds,
    } {
        step(trainer)?;
        steps += 1;
    }
    trainer.finish()?;
    let wall_ms = begun.elapsed().as_secs_f64() * 1e3;
    let cpu_ms = cpu_begun.elapsed().as_secs_f64() * 1e3;
    Ok(Timed {
        profile: gpu.profile()?,
        steps,
        wall_ms,
        cpu_ms,
    })
}

impl Timed {
    /// All rows together.
    pub fn device_ms(&self) -> f64 {
        self.profile.rows.iter().map(|row| row.total_ms).sum()
    }

    /// Steps, times of one, and all rows.
    pub fn to_json(&self, roofs: &Roofs) -> Value {
        let steps = self.steps as f64;
        let total = self.device_ms();
        json!({
            "steps": self.steps,
            "wall_ms_per_step": self.wall_ms / steps,
            "cpu_ms_per_step": self.cpu_ms / steps,
            "device_ms_per_step": total / steps,
            "coverage": total / self.wall_ms,
            "rows": self.profile.rows.iter().map(|row| row_json(row, total, roofs)).collect::<Vec<_>>(),
        })
    }

    pub fn text(&self, roofs: &Roofs) -> String {
        let total = self.device_ms();
        let rows = &self.profile.rows;
        let width = rows.iter().map(|row| row.name.len()).max().unwrap_or(0);
        let mut text = format!(
            "{:<width$} {:>8} {:>10} {:>6} {:>9} {:>9} {:>9} {:>8} {:>9} {:>6}\n",
            "kernel",
            "launches",
            "ms",
            "%",
            "min ms",
            "median ms",
            "max ms",
            "GB/s",
            "GFLOP/s",
            "roof %"
        );
        for row in rows {
            let _ = writeln!(
                text,
                "{:<width$} {:>8} {:>10.2} {:>6.2} {:>9.4} {:>9.4} {:>9.4} {:>8.2} {:>9.2} {:>6.1}",
                row.name,
                row.launches,
                row.total_ms,
                100.0 * row.total_ms / total,
                row.min_ms,
                row.median_ms,
                row.max_ms,
                giga_per_s(row.bytes, row.total_ms),
                giga_per_s(row.flops, row.total_ms),
                100.0 * roof_share(row, roofs),
            );
        }
        let (steps, wall_ms, cpu_ms) = (self.steps as f64, self.wall_ms, self.cpu_ms);
        let _ = write!(
            text,
            "{steps} steps: {:.2} ms each on the device, {:.2} ms on the clock ({:.1} % covered), {:.2} ms of CPU time; \
             roofs {:.1} GB/s, {:.1} GFLOP/s",
            total / steps,
            wall_ms / steps,
            100.0 * total / wall_ms,
            cpu_ms / steps,
            roofs.copy_gb_s,
            roofs.fma_gflop_s
        );
        text
    }
}

/// 10⁹ units a second.
fn giga_per_s(units: f64, ms: f64) -> f64 {
    if ms > 0.0 { units / ms * 1e-6 } else { 0.0 }
}

/// How near a row comes to the roof that is nearest to it.
fn roof_share(row: &ProfileRow, roofs: &Roofs) -> f64 {
    let memory = giga_per_s(row.bytes, row.total_ms) / roofs.copy_gb_s;
    memory.max(giga_per_s(row.flops, row.total_ms) / roofs.fma_gflop_s)
}

fn row_json(row: &ProfileRow, total_ms: f64, roofs: &Roofs) -> Value {
    let (bytes, flops) = (
        giga_per_s(row.bytes, row.total_ms),
        giga_per_s(row.flops, row.total_ms),
    );
    json!({
        "name": row.name,
        "launches": row.launches,
        "total_ms": row.total_ms,
        "share": row.total_ms / total_ms,
        "min_ms": row.min_ms,
        "median_ms": row.median_ms,
        "max_ms": row.max_ms,
        "gb_per_s": bytes,
        "gflop_per_s": flops,
        "share_of_copy_roof": bytes / roofs.copy_gb_s,
        "share_of_arithmetic_roof": flops / roofs.fma_gflop_s,
        "share_of_roof": roof_share(row, roofs),
    })
}
