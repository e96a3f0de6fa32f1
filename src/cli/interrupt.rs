//! Ctrl-C: the first asks for an orderly end, the second ends at once.

use super::output;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The flag that the first interrupt (or termination) request sets. `then` says what happens because of it.
///
/// # Errors
/// If the handler cannot be installed, as when this is called twice.
pub(super) fn flag(then: &'static str) -> anyhow::Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let set = Arc::clone(&flag);
    ctrlc::set_handler(move || {
        if set.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
        output::line(&format!("interrupted: {then}; once more stops at once"));
    })?;
    Ok(flag)
}
