//! What a run tells while it lasts.
//!
//! The library prints nothing: everything that happens leaves as an [`Event`], whose receiver answers whether to go on. A [`Log`] keeps
//! events as lines of JSON.

use crate::{Error, Result};
use serde_json::{Map, Value, json};
use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// The answer to an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Control {
    Continue,
    /// Save a checkpoint and return [`Error::Interrupted`].
    Stop,
}

/// A step's loss and its parts, weighted as they are added up.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Losses {
    pub total: f64,
    /// By their names in [`crate::render::TERMS`], both proposal levels together as "interlevel"; without those that are switched off.
    pub parts: Vec<(&'static str, f64)>,
}

/// Something that happened during a run.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Event {
    /// Everything is allocated; the first step comes next.
    Started {
        step: u64,
        steps: u64,
        device: String,
        /// Views trained with and held out.
        train_views: usize,
        test_views: usize,
        /// Learned numbers.
        parameters: u64,
    },
    /// A step was handed to the device: sent for every one, so that its receiver can show progress and stop. Not logged.
    Advanced { step: u64, steps: u64 },
    /// Training goes on from this checkpoint.
    Resumed { step: u64, path: PathBuf },
    /// Where training stands, every `report.log_steps`.
    Step {
        /// Steps done.
        step: u64,
        steps: u64,
        losses: Losses,
        /// Of the batch, dB.
        psnr: f64,
        /// Share of the rays that meet an opaque surface: pictures can be right while there is none.
        crossing: f64,
        it_per_s: f64,
    },
    /// A picture of a held-out view was written.
    Preview {
        step: u64,
        path: PathBuf,
        psnr: f64,
        seconds: f64,
    },
    /// A checkpoint was written.
    Saved {
        step: u64,
        path: PathBuf,
        seconds: f64,
    },
    /// Something that does not stop the run but that its owner should know.
    Warning { step: u64, what: String },
    /// All steps are done and saved.
    Finished { step: u64, seconds: f64 },
}

impl Event {
    /// Its name in logs.
    pub fn name(&self) -> &'static str {
        match self {
            Event::Started { .. } => "started",
            Event::Advanced { .. } => "advanced",
            Event::Resumed { .. } => "resumed",
            Event::Step { .. } => "step",
            Event::Preview { .. } => "preview",
            Event::Saved { .. } => "saved",
            Event::Warning { .. } => "warning",
            Event::Finished { .. } => "finished",
        }
    }

    /// As one log object: ts, level, event, step first, the rest as the fields above, `loss.` before the names of losses.
    /// Numbers that are not finite become null.
    pub fn record(&self) -> Map<String, Value> {
        let (step, rest) = match self {
            Event::Started {
                step,
                steps,
                device,
                train_views,
                test_views,
                parameters,
            } => (
                step,
                json!({
                    "steps": steps, "device": device, "train_views": train_views, "test_views": test_views,
                    "parameters": parameters,
                }),
            ),
            Event::Advanced { step, steps } => (step, json!({ "steps": steps })),
            Event::Resumed { step, path } => (step, json!({ "path": path })),
            Event::Step {
                step,
                steps,
                losses,
                psnr,
                crossing,
                it_per_s,
            } => (
                step,
                json!({
                    "steps": steps, "loss.total": losses.total, "psnr": psnr, "crossing": crossing, "it_per_s": it_per_s,
                }),
            ),
            Event::Preview {
                step,
                path,
                psnr,
                seconds,
            } => (
                step,
                json!({ "path": path, "psnr": psnr, "seconds": seconds }),
            ),
            Event::Saved {
                step,
                path,
                seconds,
            } => (step, json!({ "path": path, "seconds": seconds })),
            Event::Warning { step, what } => (step, json!({ "what": what })),
            Event::Finished { step, seconds } => (step, json!({ "seconds": seconds })),
        };
        let level = match self {
            Event::Warning { .. } => "warn",
            _ => "info",
        };
        let mut record = Map::new();
        record.insert("ts".into(), timestamp(SystemTime::now()).into());
        record.insert("level".into(), level.into());
        record.insert("event".into(), self.name().into());
        record.insert("step".into(), (*step).into());
        let Value::Object(rest) = rest else {
            unreachable!("written as an object above")
        };
        record.extend(rest);
        if let Event::Step { losses, .. } = self {
            let parts = losses.parts.iter();
            record.extend(parts.map(|(name, value)| (format!("loss.{name}"), (*value).into())));
        }
        record
    }
}

/// A moment as RFC 3339 in UTC with milliseconds.
pub fn timestamp(moment: SystemTime) -> String {
    let since = moment.duration_since(UNIX_EPOCH).unwrap_or_default();
    let (days, second) = (since.as_secs() / 86_400, since.as_secs() % 86_400);
    // Gregorian date from days since 1970 (H. Hinnant, "chrono-Compatible Low-Level Date Algorithms"): years begin in March,
    // and 400 of them have 146097 days.
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era =
        (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let march_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * march_month + 2) / 5 + 1;
    let month = if march_month < 10 {
        march_month + 3
    } else {
        march_month - 9
    };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    format!(
        "{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}.{:03}Z",
        second / 3600,
        second / 60 % 60,
        second % 60,
        since.subsec_millis()
    )
}

/// Speed over the last half minute, from which the time left is told.
#[derive(Debug, Default)]
pub struct Pace {
    marks: VecDeque<(Instant, u64)>,
}

impl Pace {
    /// How far back it looks.
    const WINDOW: Duration = Duration::from_secs(30);

    /// Notes that `done` units are done now.
    pub fn mark(&mut self, done: u64) {
        self.mark_at(Instant::now(), done);
    }

    fn mark_at(&mut self, now: Instant, done: u64) {
        self.marks.push_back((now, done));
        // The oldest mark that is kept is the last one outside the window, so that slow steps have a speed too.
        while self.marks.len() > 2 && now - self.marks[1].0 >= Self::WINDOW {
            self.marks.pop_front();
        }
    }

    /// Units per second; 0 before the second mark.
    pub fn per_second(&self) -> f64 {
        match (self.marks.front(), self.marks.back()) {
            (Some((first, before)), Some((last, done))) if last > first => {
                done.saturating_sub(*before) as f64 / (*last - *first).as_secs_f64()
            }
            _ => 0.0,
        }
    }

    /// Time for so many more units, as long as there is a speed.
    pub fn left(&self, units: f64) -> Option<Duration> {
        let rate = self.per_second();
        (rate > 0.0).then(|| Duration::from_secs_f64((units / rate).min(1e9)))
    }
}

/// The log of a run: events, one JSON object a line.
#[derive(Debug)]
pub struct Log {
    path: PathBuf,
    file: File,
}

impl Log {
    /// Opens a log to be continued. A last line that was cut off by a sudden end is closed.
    ///
    /// # Errors
    /// [`Error::Output`] if it cannot be written.
    pub fn append(path: &Path) -> Result<Log> {
        let failed = |error| cannot_log(path, error);
        let mut file = OpenOptions::new()
            .create(true)
            .read(true)
            .append(true)
            .open(path)
            .map_err(failed)?;
        if file.seek(SeekFrom::End(0)).map_err(failed)? > 0 {
            let mut last = [0];
            file.seek(SeekFrom::End(-1)).map_err(failed)?;
            file.read_exact(&mut last).map_err(failed)?;
            if last != *b"\n" {
                file.write_all(b"\n").map_err(failed)?;
            }
        }
        Ok(Log {
            path: path.into(),
            file,
        })
    }

    /// Appends an event, except [`Event::Advanced`].
    ///
    /// # Errors
    /// [`Error::Output`] if it cannot be written.
    pub fn write(&mut self, event: &Event) -> Result<()> {
        if matches!(event, Event::Advanced { .. }) {
            return Ok(());
        }
        let mut line = serde_json::to_vec(&event.record()).expect("a record is plain data");
        line.push(b'\n');
        // One write for one line: whoever reads along never sees half of it.
        self.file
            .write_all(&line)
            .map_err(|error| cannot_log(&self.path, error))
    }
}

fn cannot_log(path: &Path, error: std::io::Error) -> Error {
    Error::output(
        path,
        format!("cannot write the log: {error}"),
        "make room or mend the permissions, then go on with --resume",
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn timestamps() {
        for (seconds, text) in [
            (0, "1970-01-01T00:00:00.000Z"),
            (951_782_400, "2000-02-29T00:00:00.000Z"),
            (1_709_251_199, "2024-02-29T23:59:59.000Z"),
            (1_709_251_200, "2024-03-01T00:00:00.000Z"),
            (4_107_542_399, "2100-02-28T23:59:59.000Z"),
            (4_107_542_400, "2100-03-01T00:00:00.000Z"),
        ] {
            assert_eq!(timestamp(UNIX_EPOCH + Duration::from_secs(seconds)), text);
        }
        assert!(timestamp(UNIX_EPOCH + Duration::from_millis(42)).ends_with("00.042Z"));
    }

    #[test]
    fn pace_follows_the_last_half_minute() {
        let start = Instant::now();
        let mut pace = Pace::default();
        assert_eq!((pace.per_second(), pace.left(10.0)), (0.0, None));
        for second in 0..=100 {
            let done = if second <= 50 {
                second * 100
            } else {
                5_000 + (second - 50) * 10
            };
            pace.mark_at(start + Duration::from_secs(second), done);
        }
        assert_eq!(pace.per_second(), 10.0);
        assert_eq!(pace.left(1_000.0), Some(Duration::from_secs(100)));
        pace.mark_at(start + Duration::from_secs(300), 5_600);
        assert_eq!(pace.per_second(), 0.5, "a step longer than the window");
    }

    #[test]
    fn records_have_stable_keys_and_survive_what_is_not_finite() {
        let event = Event::Step {
            step: 20,
            steps: 100,
            losses: Losses {
                total: f64::NAN,
                parts: vec![("color", f64::INFINITY), ("mask", 0.25)],
            },
            psnr: 20.5,
            crossing: 0.5,
            it_per_s: 3.0,
        };
        let record = event.record();
        let keys: Vec<_> = record.keys().map(String::as_str).collect();
        assert_eq!(
            keys,
            [
                "ts",
                "level",
                "event",
                "step",
                "steps",
                "loss.total",
                "psnr",
                "crossing",
                "it_per_s",
                "loss.color",
                "loss.mask"
            ]
        );
        assert_eq!(record["loss.total"], Value::Null);
        assert_eq!(record["loss.color"], Value::Null);
        assert_eq!(record["loss.mask"], 0.25);
        assert_eq!(record["psnr"], 20.5);
    }

    #[test]
    fn logs_go_on_after_a_line_that_was_cut_off() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.jsonl");
        let event = Event::Finished {
            step: 3,
            seconds: 1.0,
        };
        Log::append(&path).unwrap().write(&event).unwrap();
        let mut cut = fs::read(&path).unwrap();
        cut.extend(b"{\"ts\":");
        fs::write(&path, cut).unwrap();
        Log::append(&path).unwrap().write(&event).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        let whole = text
            .lines()
            .filter(|line| serde_json::from_str::<Value>(line).is_ok());
        assert_eq!(whole.count(), 2, "{text}");
    }
}
