//! What the system's signals ask of the daemon.
//!
//! SIGTERM ends the process, whatever hangs: the loop has some time to finish the frames under way; after that a thread
//! that touches no file but those of unfinished outputs ends the process. For the same reason the configuration, which may lie on
//! a file system that does not answer, is read again by a thread of its own.

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
                let control = Arc::clone(&control);
                // Two at once: the later one waits for its turn.
                let reloading = std::thread::Builder::new().name("reload".into());
                if let Err(error) = reloading.spawn(move || control.reload()) {
                    tracing::error!("nothing is changed: {error}");
                }
            } else if control.finish() {
                tracing::warn!("asked to end a second time: what is not whole is left for the next time");
                end_at_once(128 + signal);
            } else {
                end_when_overdue(&control);
            }
        }
    })?;
    Ok(())
}

/// Ends the process when the loop, which has to do that sooner, hangs.
#[cfg(unix)]
fn end_when_overdue(control: &Arc<Control>) {
    let control = Arc::clone(control);
    let waiting = std::thread::Builder::new().name("deadline".into()).spawn(move || {
        std::thread::sleep(control.stop_deadline().saturating_add(GRACE));
        tracing::error!("the daemon hangs: what is not whole is left for the next time");
        end_at_once(i32::from(control.args.once));
    });
    if let Err(error) = waiting {
        tracing::warn!("a daemon that hangs ends by a second signal only: {error}");
    }
}

/// The loop ends by itself within the deadline, unless it hangs.
#[cfg(unix)]
const GRACE: std::time::Duration = std::time::Duration::from_secs(5);

/// As shells count it: 130 for Ctrl-C.
#[cfg(unix)]
fn end_at_once(status: i32) -> ! {
    crate::pipeline::stop_writing();
    std::process::exit(status)
}

/// Elsewhere the system ends the process as it sees fit.
#[cfg(not(unix))]
pub(super) fn listen(_control: Arc<Control>) -> Result<()> {
    Ok(())
}
