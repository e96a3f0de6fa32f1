//! Ctrl-C: the first asks for an orderly end, the second ends at once.

use super::Context;
use crate::{Error, Result};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

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
    let ignored = ignored();
    ctrlc::set_handler(move || {
        if set.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
        let then = *THEN.lock().unwrap_or_else(PoisonError::into_inner);
        context.say(&format!("interrupted: {then}; once more stops at once"));
    })?;
    ignore(&ignored);
    Ok(Arc::clone(HANDLER.get_or_init(|| flag)))
}

/// Requests that whoever started the program wants ignored, as `nohup` does with the terminal's end.
#[cfg(unix)]
fn ignored() -> Vec<libc::c_int> {
    let mut requests = vec![libc::SIGINT, libc::SIGTERM, libc::SIGHUP];
    requests.retain(|&request| {
        // SAFETY: plain numbers and a null pointer, for which zero is a value; the call writes what is in force, and changes nothing.
        let (read, now) = unsafe {
            let mut now: libc::sigaction = std::mem::zeroed();
            (
                libc::sigaction(request, std::ptr::null(), &raw mut now),
                now,
            )
        };
        read == 0 && now.sa_sigaction == libc::SIG_IGN
    });
    requests
}

#[cfg(unix)]
fn ignore(requests: &[libc::c_int]) {
    for &request in requests {
        // SAFETY: no handler of ours is named.
        unsafe { libc::signal(request, libc::SIG_IGN) };
    }
}

#[cfg(not(unix))]
fn ignored() {}

#[cfg(not(unix))]
fn ignore(_: &()) {}

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
