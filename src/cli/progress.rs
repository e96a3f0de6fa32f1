//! How far something is: a bar on a terminal, otherwise a plain line every ten seconds; both on stderr.

use super::output::{Context, line, set_bar};
use crate::train::report::Pace;
use indicatif::{ProgressBar, ProgressStyle};
use std::time::{Duration, Instant};

/// Between two plain lines.
const INTERVAL: Duration = Duration::from_secs(10);

/// Progress of one piece of work. It disappears when dropped.
pub struct Progress {
    what: String,
    total: u64,
    /// Units from the first on take the second times as long.
    slower: (u64, f64),
    pace: Pace,
    bar: Option<ProgressBar>,
    plain: bool,
    last: Option<Instant>,
}

impl Progress {
    /// Progress of `what`, in `total` units.
    pub fn new(context: &Context, what: &str, total: u64) -> Progress {
        let bar = context.draws_bars().then(|| {
            let style = ProgressStyle::with_template("{prefix} {bar:20} {msg}")
                .expect("a template of known fields");
            let bar = ProgressBar::new(total)
                .with_style(style)
                .with_prefix(what.to_string());
            set_bar(Some(bar.clone()));
            bar
        });
        Progress {
            what: what.into(),
            total,
            slower: (total, 1.0),
            pace: Pace::default(),
            plain: context.tells_progress() && bar.is_none(),
            bar,
            last: None,
        }
    }

    /// The same, if the units from this one on will take `times` as long as those before, which is all that is known of them until then.
    pub fn slower_from(mut self, unit: u64, times: f64) -> Progress {
        self.slower = (unit, times);
        self
    }

    /// `done` units are done; `note` is what else there is to say.
    pub fn at(&mut self, done: u64, note: &str) {
        self.pace.mark(done);
        let text = || {
            let per_second = self.pace.per_second();
            let left = self.pace.left(left(done, self.total, self.slower));
            let mut text = format!("{done}/{}", self.total);
            if per_second > 0.0 {
                text += &format!("  {}/s", three_digits(per_second));
            }
            if let Some(left) = left.filter(|_| done < self.total) {
                text += &format!("  {} left", clock(left));
            }
            if !note.is_empty() {
                text += &format!("  {note}");
            }
            text
        };
        if let Some(bar) = &self.bar {
            bar.set_position(done);
            bar.set_message(text());
        } else if self.plain && self.last.is_none_or(|last| last.elapsed() >= INTERVAL) {
            // The first call only starts the clock: short work has nothing to tell.
            if self.last.is_some() {
                line(&format!("{} {}", self.what, text()));
            }
            self.last = Some(Instant::now());
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
            set_bar(None);
        }
    }
}

/// What is left of `total`, in units as long as those at `done`, if those from the border on take so many times as long.
fn left(done: u64, total: u64, (border, times): (u64, f64)) -> f64 {
    let left = |from: u64| total.saturating_sub(from) as f64;
    match done < border {
        true => left(done) + (times - 1.0) * left(border),
        false => left(done),
    }
}

/// "0.123", "1.23", "12.3", "123", "1234".
fn three_digits(number: f64) -> String {
    let decimals = match number {
        100.0.. => 0,
        10.0.. => 1,
        1.0.. => 2,
        _ => 3,
    };
    format!("{number:.decimals$}")
}

/// "0:59", "59:59", "23:59:59".
pub fn clock(duration: Duration) -> String {
    let seconds = duration.as_secs();
    let (hours, minutes, seconds) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
    match hours {
        0 => format!("{minutes}:{seconds:02}"),
        _ => format!("{hours}:{minutes:02}:{seconds:02}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_counts_slower_units_for_more() {
        let slower = [0, 79, 80, 100].map(|done| left(done, 100, (80, 3.0)));
        assert_eq!(slower, [140.0, 61.0, 20.0, 0.0]);
        assert_eq!(
            [0, 99].map(|done| left(done, 100, (100, 1.0))),
            [100.0, 1.0]
        );
    }

    #[test]
    fn numbers_for_people() {
        assert_eq!(clock(Duration::from_secs(59)), "0:59");
        assert_eq!(clock(Duration::from_secs(3_600)), "1:00:00");
        assert_eq!(clock(Duration::from_secs(86_399)), "23:59:59");
        assert_eq!(
            [0.1234, 1.234, 12.34, 123.4].map(three_digits),
            ["0.123", "1.23", "12.3", "123"]
        );
    }
}
