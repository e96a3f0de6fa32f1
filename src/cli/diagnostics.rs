//! What the program says about its own insides: the library's trace on stderr, and the last words of a crash.

use super::{Global, LogFormat, VERSION, output};
use crate::train::report::timestamp;
use crate::{Error, Result};
use serde_json::{Map, Value};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::SystemTime;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::layer::{Context, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

/// Shows the library's trace: warnings, with -v what it decides and touches, with -vv how, with -vvv what it does at every step;
/// RUST_LOG says otherwise, but not against --quiet.
///
/// # Errors
/// [`Error::Config`] for a RUST_LOG that is none.
pub(super) fn install_log(global: &Global, colored: bool) -> Result<()> {
    let level = match (global.quiet, global.verbose) {
        (true, _) => "error",
        (false, 0) => "warn",
        (false, 1) => "info",
        (false, 2) => "debug",
        (false, _) => "trace",
    };
    let asked = std::env::var(EnvFilter::DEFAULT_ENV).unwrap_or_default();
    let filter = match global.quiet || asked.is_empty() {
        true => EnvFilter::new(format!("neurodin={level}")),
        false => EnvFilter::try_new(&asked).map_err(|error| Error::Config {
            what: format!(
                "RUST_LOG={asked}: {error}\n  next: for example RUST_LOG=info, or neurodin::gpu=debug"
            ),
        })?,
    };
    let trace = Trace {
        json: global.log_format == LogFormat::Json,
        colored,
    };
    // It is the only one: this is called once.
    let _ = tracing_subscriber::registry()
        .with(filter)
        .with(trace)
        .try_init();
    Ok(())
}

/// Writes trace events as lines on stderr.
struct Trace {
    json: bool,
    colored: bool,
}

/// The message and fields of a trace event.
#[derive(Default)]
struct Fields(Map<String, Value>);

impl Visit for Fields {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        self.0
            .insert(field.name().into(), format!("{value:?}").into());
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.0.insert(field.name().into(), value.into());
    }

    fn record_f64(&mut self, field: &Field, value: f64) {
        self.0.insert(field.name().into(), value.into());
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.0.insert(field.name().into(), value.into());
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.0.insert(field.name().into(), value.into());
    }

    fn record_bool(&mut self, field: &Field, value: bool) {
        self.0.insert(field.name().into(), value.into());
    }
}

impl<S: Subscriber> Layer<S> for Trace {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut fields = Fields::default();
        event.record(&mut fields);
        let message = match fields.0.shift_remove("message") {
            Some(Value::String(text)) => text,
            _ => String::new(),
        };
        let level = *event.metadata().level();
        if self.json {
            let mut record = Map::new();
            record.insert("ts".into(), timestamp(SystemTime::now()).into());
            record.insert("level".into(), level.as_str().to_lowercase().into());
            record.insert("event".into(), message.into());
            record.insert("target".into(), event.metadata().target().into());
            record.extend(fields.0);
            return output::line(&Value::from(record).to_string());
        }
        let (word, color) = match level {
            Level::ERROR => ("error:", "31;1"),
            Level::WARN => ("warning:", "33;1"),
            Level::INFO => ("info:", "32"),
            Level::DEBUG => ("debug:", "34"),
            Level::TRACE => ("trace:", "2"),
        };
        let mut text = match self.colored {
            true => format!("\x1b[{color}m{word}\x1b[0m {message}"),
            false => format!("{word} {message}"),
        };
        for (name, value) in &fields.0 {
            let _ = write!(text, " {name}={value}");
        }
        output::line(&text);
    }
}

/// What a crash should be reported with.
#[derive(Default)]
struct Situation {
    device: Option<String>,
    step: Option<u64>,
    checkpoint: Option<PathBuf>,
}

static SITUATION: Mutex<Situation> = Mutex::new(Situation {
    device: None,
    step: None,
    checkpoint: None,
});

fn note(change: impl FnOnce(&mut Situation)) {
    change(
        &mut SITUATION
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner()),
    );
}

/// Remembers the device for a crash report.
pub(super) fn note_device(name: &str) {
    note(|situation| situation.device = Some(name.into()));
}

/// Remembers how far training is.
pub(super) fn note_step(step: u64) {
    note(|situation| situation.step = Some(step));
}

/// Remembers the last good checkpoint.
pub(super) fn note_checkpoint(path: &Path) {
    note(|situation| situation.checkpoint = Some(path.into()));
}

/// A crash says what, where, on which device, at which step, and where the last checkpoint is.
pub(super) fn install_panic_hook() {
    std::panic::set_hook(Box::new(|panic| {
        let payload = panic.payload();
        let what = payload
            .downcast_ref::<&str>()
            .copied()
            .or_else(|| payload.downcast_ref::<String>().map(String::as_str))
            .unwrap_or("a panic without words");
        let place = panic
            .location()
            .map(ToString::to_string)
            .unwrap_or_default();
        // Nothing may block or panic here.
        let (device, step, checkpoint) = match SITUATION.try_lock() {
            Ok(situation) => (
                situation.device.clone(),
                situation.step,
                situation.checkpoint.clone(),
            ),
            Err(_) => (None, None, None),
        };
        let mut text = format!(
            "error: neurodin failed in a way that it should not: {what}\n  at {place}, neurodin {}",
            VERSION.as_str()
        );
        if let Some(device) = device {
            let _ = write!(text, ", device {device}");
        }
        if let Some(step) = step {
            let _ = write!(text, ", step {step}");
        }
        if let Some(checkpoint) = checkpoint {
            let _ = write!(
                text,
                "\n  the last checkpoint is {}; --resume goes on from it",
                checkpoint.display()
            );
        }
        let _ = write!(
            text,
            "\n  please report these lines with the command that was typed"
        );
        if std::env::var_os("RUST_BACKTRACE").is_some_and(|value| value != "0") {
            let _ = write!(text, "\n{}", std::backtrace::Backtrace::force_capture());
        }
        output::line(&text);
    }));
}
