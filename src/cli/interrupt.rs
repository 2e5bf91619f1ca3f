//! Ctrl-C, and a polite request to end: nothing half written stays behind.
//!
//! A frame that is under way is given up; those that are whole stay, and `--skip-done` goes on from
//! there.

/// From now on, an interrupted process removes its temporary files before it ends.
#[cfg(unix)]
pub(super) fn clean_up_when_interrupted() {
    use signal_hook::consts::{SIGINT, SIGTERM};
    use signal_hook::iterator::Signals;

    // Without it everything works but for the cleaning up.
    let Ok(mut signals) = Signals::new([SIGINT, SIGTERM]) else { return };
    std::thread::spawn(move || {
        if let Some(signal) = signals.forever().next() {
            crate::pipeline::stop_writing();
            // As shells count it: 130 for Ctrl-C.
            std::process::exit(128 + signal);
        }
    });
}

/// Elsewhere the system ends the process as it sees fit.
#[cfg(not(unix))]
pub(super) fn clean_up_when_interrupted() {}
