//! Requests to stop this process: from its terminal, a service manager, or the system when it shuts down.
//!
//! ```text
//!   Unix      SIGINT (Ctrl-C)        130      SIGTERM                                        143
//!   Windows   Ctrl-C, Ctrl-Break     130      the console is closed, logoff, shutdown        143
//! ```
//!
//! When a console is closed, Windows ends the process 5 seconds after the request.

use std::io;

use tokio::runtime::Builder;

/// Calls `act` in a thread of its own for every request, with the exit status that tells which it was: 130 or 143, as
/// shells report it.
///
/// # Errors
/// When the system refuses the handlers or the thread.
pub(super) fn on_stop_requests(mut act: impl FnMut(i32) + Send + 'static) -> io::Result<()> {
    let runtime = Builder::new_current_thread().enable_io().build()?;
    let mut requests = {
        let _entered = runtime.enter();
        Requests::new()?
    };
    let listen = move || loop {
        act(runtime.block_on(requests.next()));
    };
    std::thread::Builder::new().name("signals".into()).spawn(listen).map(drop)
}

/// The exit status of a process that Ctrl-C ended: 128 + SIGINT.
const INTERRUPTED: i32 = 130;

/// The exit status of a process that was asked to terminate: 128 + SIGTERM.
const TERMINATED: i32 = 143;

#[cfg(unix)]
struct Requests {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
}

#[cfg(unix)]
impl Requests {
    fn new() -> io::Result<Requests> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Requests {
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
        })
    }

    async fn next(&mut self) -> i32 {
        tokio::select! {
            _ = self.interrupt.recv() => INTERRUPTED,
            _ = self.terminate.recv() => TERMINATED,
        }
    }
}

#[cfg(windows)]
struct Requests {
    interrupt: tokio::signal::windows::CtrlC,
    interrupt_of_batch: tokio::signal::windows::CtrlBreak,
    close: tokio::signal::windows::CtrlClose,
    logoff: tokio::signal::windows::CtrlLogoff,
    shutdown: tokio::signal::windows::CtrlShutdown,
}

#[cfg(windows)]
impl Requests {
    fn new() -> io::Result<Requests> {
        use tokio::signal::windows::{ctrl_break, ctrl_c, ctrl_close, ctrl_logoff, ctrl_shutdown};
        Ok(Requests {
            interrupt: ctrl_c()?,
            interrupt_of_batch: ctrl_break()?,
            close: ctrl_close()?,
            logoff: ctrl_logoff()?,
            shutdown: ctrl_shutdown()?,
        })
    }

    async fn next(&mut self) -> i32 {
        tokio::select! {
            _ = self.interrupt.recv() => INTERRUPTED,
            _ = self.interrupt_of_batch.recv() => INTERRUPTED,
            _ = self.close.recv() => TERMINATED,
            _ = self.logoff.recv() => TERMINATED,
            _ = self.shutdown.recv() => TERMINATED,
        }
    }
}
