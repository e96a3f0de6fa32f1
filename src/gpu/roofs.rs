//! What the device can do at most, measured: the two roofs that a profile's rows are compared with (Williams et al. 2009), and how fast
//! tables are read and added to at random.

use super::device::Gpu;
use super::instance::DeviceKind;
use super::recorder::Work;
use crate::Result;
use crate::kernels::{roof_copy, roof_fma, roof_gather, roof_scatter};
use std::time::Instant;

/// Fastest copy and fastest arithmetic of the device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Roofs {
    /// Memory read and written by a copy, in 10⁹ bytes per second.
    pub copy_gb_s: f64,
    /// Float32 multiply-adds in registers, in 10⁹ operations per second (a multiply-add counts two).
    pub fma_gflop_s: f64,
}

/// How fast a table of one size is read and added to at random, in 10⁶ entries of eight floats per second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TableRoofs {
    /// The table has 2^log2_entries entries.
    pub log2_entries: u32,
    pub gather_m_s: f64,
    /// By float atomics.
    pub scatter_m_s: f64,
}

/// Seconds that one timed submission takes at least, so that submitting does not count.
const LONG_ENOUGH: f64 = 0.05;
/// Timed submissions, of which the fastest counts.
const REPEATS: usize = 3;

impl Gpu {
    /// Measures both roofs, in about a second. The device should have nothing else to do.
    pub fn measure_roofs(&self) -> Result<Roofs> {
        let (copied, launched) = match self.info().kind {
            DeviceKind::Cpu | DeviceKind::Other => (64u64 << 20, 1u64 << 14),
            _ => (512 << 20, 1 << 20),
        };
        let n = copied / 16;
        let (from, to) = (
            self.buffer::<[u32; 4]>("roof from", n)?,
            self.buffer::<[u32; 4]>("roof to", n)?,
        );
        let copy = self.kernel(roof_copy::Shape::default())?;
        let copy_seconds = self.seconds_of(|rec| {
            let args = roof_copy::Args {
                from: from.ptr(),
                to: to.ptr_mut(),
                n: n as u32,
            };
            rec.run(&copy, Work::items(n).bytes(32.0), args);
        })?;

        let sums = self.buffer::<f32>("roof sums", launched)?; // [launched]
        let shape = roof_fma::Shape::default();
        let flops = 2.0 * 16.0 * 16.0 * shape.rounds as f64;
        let fma = self.kernel(shape)?;
        let fma_seconds = self.seconds_of(|rec| {
            let args = roof_fma::Args {
                sums: sums.ptr_mut(),
                n: launched as u32,
                gain: 0.999,
                offset: 0.001,
            };
            rec.run(&fma, Work::items(launched).flops(flops), args);
        })?;
        Ok(Roofs {
            copy_gb_s: 2.0 * copied as f64 / copy_seconds * 1e-9,
            fma_gflop_s: flops * launched as f64 / fma_seconds * 1e-9,
        })
    }

    /// Measures the rates of tables of these sizes, in about a second each.
    pub fn measure_tables(&self, log2_entries: &[u32]) -> Result<Vec<TableRoofs>> {
        let launched = match self.info().kind {
            DeviceKind::Cpu | DeviceKind::Other => 1u64 << 14,
            _ => 1 << 20,
        };
        let largest = log2_entries.iter().copied().max().unwrap_or(0);
        let table = self.buffer::<f32>("roof table", 8 << largest)?;
        let sums = self.buffer::<f32>("roof sums", launched)?;
        let (gathers, scatters) = (
            roof_gather::Shape::default(),
            roof_scatter::Shape::default(),
        );
        let gather = self.kernel(gathers)?;
        let scatter = self.kernel(scatters)?;
        let rate =
            |entries: u32, seconds: f64| launched as f64 * f64::from(entries) / seconds * 1e-6;
        let mut measured = Vec::new();
        for &log2_entries in log2_entries {
            let mask = (1u32 << log2_entries) - 1;
            let gathered = self.seconds_of(|rec| {
                let args = roof_gather::Args {
                    table: table.ptr().cast(),
                    sums: sums.ptr_mut(),
                    n: launched as u32,
                    mask,
                };
                rec.run(&gather, Work::items(launched).bytes(512.0), args);
            })?;
            let scattered = self.seconds_of(|rec| {
                let args = roof_scatter::Args {
                    table: table.ptr_mut(),
                    n: launched as u32,
                    mask,
                };
                rec.run(&scatter, Work::items(launched).bytes(1024.0), args);
            })?;
            measured.push(TableRoofs {
                log2_entries,
                gather_m_s: rate(gathers.entries, gathered),
                scatter_m_s: rate(scatters.entries, scattered),
            });
        }
        Ok(measured)
    }

    /// Seconds of one launch, from as many at once as take long enough to be timed on the host.
    pub(super) fn seconds_of(&self, mut launch: impl FnMut(&mut super::Recorder)) -> Result<f64> {
        let mut time = |launches: u32| {
            let start = Instant::now();
            let ticket = self.submit("roofs", |rec| {
                (0..launches).for_each(|_| launch(rec));
                Ok(())
            })?;
            self.wait(ticket)?;
            Ok::<f64, crate::Error>(start.elapsed().as_secs_f64())
        };
        time(1)?; // drivers compile at the first launch
        let mut launches = 1;
        while time(launches)? < LONG_ENOUGH && launches < 1 << 16 {
            launches *= 2;
        }
        let mut best = f64::INFINITY;
        for _ in 0..REPEATS {
            best = best.min(time(launches)? / launches as f64);
        }
        Ok(best)
    }
}
