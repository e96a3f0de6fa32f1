//! Ctrl-C: the first asks for an orderly end, the second ends at once.

use super::Context;
use crate::{Error, Result};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

#[cfg(unix)]
use signal_hook::{
    consts::{SIGHUP, SIGINT, SIGTERM},
    iterator::Signals,
};

/// The process has one handler, whatever a command does one after another.
static HANDLER: OnceLock<Arc<AtomicBool>> = OnceLock::new();
/// What happens because of the first request, at this moment.
static THEN: Mutex<&str> = Mutex::new("");

/// The flag that the first interrupt (or termination) request sets. `then` says what happens because of it from now on, in the way in
/// which `context` speaks.
///
/// # Errors
/// If the handler cannot be installed.
pub(super) fn flag(context: &Context, then: &'static str) -> anyhow::Result<Arc<AtomicBool>> {
    *THEN.lock().unwrap_or_else(PoisonError::into_inner) = then;
    if let Some(flag) = HANDLER.get() {
        return Ok(Arc::clone(flag));
    }
    let flag = Arc::new(AtomicBool::new(false));
    let (set, context) = (Arc::clone(&flag), context.clone());
    listen(move || {
        if set.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
        let then = *THEN.lock().unwrap_or_else(PoisonError::into_inner);
        context.say(&format!("interrupted: {then}; once more stops at once"));
    })?;
    Ok(Arc::clone(HANDLER.get_or_init(|| flag)))
}

/// Calls `asked` at every request to end: Ctrl-C, termination, and the terminal's end unless `nohup` wants that ignored.
#[cfg(unix)]
fn listen(asked: impl Fn() + Send + 'static) -> anyhow::Result<()> {
    let mut requests = vec![SIGINT, SIGTERM];
    if !is_ignored(SIGHUP) {
        requests.push(SIGHUP);
    }
    let mut requests = Signals::new(requests)?;
    std::thread::spawn(move || requests.forever().for_each(|_| asked()));
    Ok(())
}

/// Whether the program was started with this signal ignored, where that can be told without the system's own calls: on Linux.
#[cfg(unix)]
fn is_ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status
        .lines()
        .find_map(|line| line.strip_prefix("SigIgn:"))
        .and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

#[cfg(not(unix))]
fn listen(asked: impl Fn() + Send + 'static) -> anyhow::Result<()> {
    Ok(ctrlc::set_handler(asked)?)
}

/// [`Error::Interrupted`], in these words, once an end was asked for.
///
/// # Errors
/// That one.
pub(super) fn stop_if(interrupted: &AtomicBool, what: &str) -> Result<()> {
    match interrupted.load(Ordering::SeqCst) {
        true => Err(Error::Interrupted { what: what.into() }),
        false => Ok(()),
    }
}
