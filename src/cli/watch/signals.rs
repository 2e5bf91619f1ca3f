//! What the system's signals ask of the daemon.

use std::sync::Arc;

use anyhow::Result;

use super::Control;

/// From now on, SIGTERM and SIGINT end the daemon in good order, and at once when one comes again;
/// SIGHUP makes it read its file again.
///
/// # Errors
/// When the system refuses.
#[cfg(unix)]
pub(super) fn listen(control: Arc<Control>) -> Result<()> {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
    use signal_hook::iterator::Signals;

    let mut signals = Signals::new([SIGHUP, SIGINT, SIGTERM])?;
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        for signal in signals.forever() {
            if signal == SIGHUP {
                control.reload();
            } else if control.finish() {
                tracing::warn!("asked to end a second time: what is not whole is left for the next time");
                crate::pipeline::stop_writing();
                // As shells count it: 130 for Ctrl-C.
                std::process::exit(128 + signal);
            }
        }
    })?;
    Ok(())
}

/// Elsewhere the system ends the process as it sees fit.
#[cfg(not(unix))]
pub(super) fn listen(_control: Arc<Control>) -> Result<()> {
    Ok(())
}
