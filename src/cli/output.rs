//! The two streams: results on stdout, everything for people on stderr; and what every command gets from the global flags.

use super::{Global, LogFormat};
use crate::gpu::{Gpu, GpuOptions};
use crate::train::report::timestamp;
use crate::{Error, Result};
use indicatif::ProgressBar;
use serde_json::{Map, Value, json};
use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Mutex;
use std::time::SystemTime;

/// What the global flags say.
#[derive(Clone, Debug)]
pub struct Context {
    device: Option<String>,
    wanted_cache: Option<PathBuf>,
    autotune: bool,
    validation: bool,
    json: bool,
    quiet: bool,
    log_json: bool,
    colored: bool,
}

impl Context {
    pub(super) fn new(global: &Global, colored: bool) -> Context {
        Context {
            device: global.device.clone(),
            wanted_cache: global.cache.clone(),
            autotune: !global.no_autotune,
            validation: global.validation,
            json: global.json,
            quiet: global.quiet,
            log_json: global.log_format == LogFormat::Json,
            colored,
        }
    }

    /// Opens the device that was asked for.
    ///
    /// # Errors
    /// [`Error::NoDevice`] if there is none.
    pub fn gpu(&self) -> Result<Gpu> {
        self.gpu_with(GpuOptions::default())
    }

    /// Opens the device that was asked for, otherwise as `options` say.
    ///
    /// # Errors
    /// [`Error::NoDevice`] if there is none; [`Error::Output`] if the cache folder that was asked for cannot be used.
    pub fn gpu_with(&self, options: GpuOptions) -> Result<Gpu> {
        // The user's own cache folder may be missing and read-only; one that was asked for may not.
        if let Some(folder) = &self.wanted_cache {
            let made = std::fs::create_dir_all(folder);
            let usable = made.and_then(|()| tempfile::tempfile_in(folder).map(drop));
            usable.map_err(|error| {
                Error::output(
                    folder,
                    format!("cannot be the cache folder: {error}"),
                    "name a folder that can be written to, or leave --cache and NEURODIN_CACHE out",
                )
            })?;
        }
        let gpu = Gpu::new(&GpuOptions {
            device: self.device.clone(),
            validation: self.validation || options.validation,
            cache_dir: self.wanted_cache.clone().or_else(users_cache),
            autotune: self.autotune,
            ..options
        })?;
        super::diagnostics::note_device(&gpu.info().name);
        Ok(gpu)
    }

    /// The result of a command: JSON on stdout under `--json`, otherwise the text for people on stderr.
    ///
    /// # Errors
    /// If stdout cannot be written.
    pub fn result(&self, json: &Value, text: &str) -> Result<()> {
        if self.json {
            self.print(&format!("{json:#}\n"))
        } else {
            self.say(text);
            Ok(())
        }
    }

    /// Whether results are for programs (`--json`).
    pub fn prints_json(&self) -> bool {
        self.json
    }

    /// Text on stdout. A reader that has gone away is no error.
    ///
    /// # Errors
    /// If stdout cannot be written.
    pub fn print(&self, text: &str) -> Result<()> {
        let mut stdout = std::io::stdout().lock();
        match stdout
            .write_all(text.as_bytes())
            .and_then(|()| stdout.flush())
        {
            Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(Error::output(
                "stdout",
                format!("cannot be written: {error}"),
                "make room where it leads",
            )),
            _ => Ok(()),
        }
    }

    /// A remark for people on stderr, unless `--quiet`.
    pub fn say(&self, text: &str) {
        if self.quiet {
            return;
        }
        match self.log_json {
            true => self.record("info", "message", json!({ "text": text.trim_end() })),
            false => line(text.trim_end()),
        }
    }

    /// Something the user should look at, on stderr, unless `--quiet`.
    pub fn warn(&self, text: &str) {
        if self.quiet {
            return;
        }
        match self.log_json {
            true => self.record("warn", "message", json!({ "text": text })),
            false => line(&format!("{} {text}", self.paint("33;1", "warning:"))),
        }
    }

    /// Something that happened, on stderr, unless `--quiet`: the object for programs (`--log-format json`), or the text for people,
    /// if there is any.
    pub fn tell(&self, record: Map<String, Value>, text: &str) {
        if self.quiet {
            return;
        }
        match self.log_json {
            true => line(&Value::from(record).to_string()),
            false if text.is_empty() => {}
            false => line(text),
        }
    }

    fn record(&self, level: &str, event: &str, rest: Value) {
        let mut record = Map::new();
        record.insert("ts".into(), timestamp(SystemTime::now()).into());
        record.insert("level".into(), level.into());
        record.insert("event".into(), event.into());
        if let Value::Object(rest) = rest {
            record.extend(rest);
        }
        line(&Value::from(record).to_string());
    }

    /// Whether progress is drawn as a bar: stderr is a terminal, and a person reads it.
    pub(super) fn draws_bars(&self) -> bool {
        self.tells_progress() && std::io::stderr().is_terminal()
    }

    /// Whether progress is told in words at all.
    pub(super) fn tells_progress(&self) -> bool {
        !self.quiet && !self.log_json
    }

    fn paint(&self, code: &str, text: &str) -> String {
        match self.colored {
            true => format!("\x1b[{code}m{text}\x1b[0m"),
            false => text.into(),
        }
    }

    /// Tells an error with its causes and returns the exit code that it stands for.
    pub(super) fn fail(&self, error: &anyhow::Error) -> ExitCode {
        let code = exit_code(error);
        let mut lines = vec![error.to_string()];
        for cause in error.chain().skip(1).map(ToString::to_string) {
            // Some messages hold their cause already.
            if !lines.iter().any(|line| line.contains(&cause)) {
                lines.push(cause);
            }
        }
        match self.log_json {
            true => self.record(
                "error",
                "error",
                json!({ "what": lines.join(": "), "code": code }),
            ),
            false => {
                let causes = lines.join("\n  because: ");
                line(&format!("{} {causes}", self.paint("31;1", "error:")));
            }
        }
        ExitCode::from(code)
    }
}

/// The first of our own errors in the chain decides.
fn exit_code(error: &anyhow::Error) -> u8 {
    error
        .chain()
        .find_map(|cause| cause.downcast_ref::<Error>())
        .map_or(1, Error::exit_code)
}

/// The bar that stands at the bottom of the terminal, which lines must step around.
static BAR: Mutex<Option<ProgressBar>> = Mutex::new(None);

/// Puts a bar at the bottom of the terminal, or takes it away.
pub(super) fn set_bar(bar: Option<ProgressBar>) {
    *BAR.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = bar;
}

/// Writes a line on stderr, above the bar if there is one. Whoever closed stderr does not want it.
pub(super) fn line(text: &str) {
    let write = || {
        let _ = writeln!(std::io::stderr(), "{text}");
    };
    // A panic on another thread may hold the lock: better a line through the bar than none.
    match BAR.try_lock().as_deref() {
        Ok(Some(bar)) => bar.suspend(write),
        _ => write(),
    }
}

/// Where the XDG base directory specification puts what a program can make again; `None` where the user has no home.
fn users_cache() -> Option<PathBuf> {
    let folder = |name| std::env::var_os(name).map(PathBuf::from);
    let absolute = folder("XDG_CACHE_HOME").filter(|path| path.is_absolute());
    let caches = absolute.or_else(|| Some(folder("HOME")?.join(".cache")))?;
    Some(caches.join("neurodin"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context as _;

    #[test]
    fn exit_codes_are_found_behind_context() {
        let lost: anyhow::Result<()> = Err(Error::DeviceLost {
            what: "gone".into(),
        }
        .into());
        assert_eq!(exit_code(&lost.context("while training").unwrap_err()), 6);
        assert_eq!(exit_code(&anyhow::anyhow!("anything else")), 1);
    }
}
