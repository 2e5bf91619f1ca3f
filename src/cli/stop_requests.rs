//! Requests to stop this process: from its terminal, a service manager, or the system when it shuts down.
//!
//! ```text
//!   Unix      SIGINT (Ctrl-C)        130      SIGTERM                              143
//!   Windows   Ctrl-C, Ctrl-Break     130      the console is closed, shutdown      143, urgent
//! ```

use std::io;

use tokio::runtime::Builder;

/// A request to stop.
#[derive(Clone, Copy)]
pub(super) struct StopRequest {
    /// The exit status that tells which it was, as shells report it: 130 or 143.
    pub(super) status: i32,
    /// Whether the system ends the process within seconds.
    pub(super) is_urgent: bool,
}

/// Calls `act` in a thread of its own for every request.
///
/// # Errors
/// When the system refuses the handlers or the thread.
pub(super) fn on_stop_requests(mut act: impl FnMut(StopRequest) + Send + 'static) -> io::Result<()> {
    let runtime = Builder::new_current_thread().enable_io().build()?;
    let mut requests = {
        let _entered = runtime.enter();
        listen()?
    };
    let run = move || loop {
        act(runtime.block_on(requests.next()));
    };
    std::thread::Builder::new().name("signals".into()).spawn(run).map(drop)
}

/// By Ctrl-C: 128 + SIGINT.
const INTERRUPTED: StopRequest = StopRequest { status: 130, is_urgent: false };

/// By a service manager, or by the system: 128 + SIGTERM. Windows gives a process whose console is closed 5 seconds.
const TERMINATED: StopRequest = StopRequest { status: 143, is_urgent: cfg!(windows) };

#[cfg(unix)]
struct Signals {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
}

#[cfg(unix)]
fn listen() -> io::Result<Signals> {
    use tokio::signal::unix::{SignalKind, signal};
    Ok(Signals { interrupt: signal(SignalKind::interrupt())?, terminate: signal(SignalKind::terminate())? })
}

#[cfg(unix)]
impl Signals {
    async fn next(&mut self) -> StopRequest {
        tokio::select! {
            _ = self.interrupt.recv() => INTERRUPTED,
            _ = self.terminate.recv() => TERMINATED,
        }
    }
}

#[cfg(windows)]
struct ConsoleEvents {
    interrupt: tokio::signal::windows::CtrlC,
    interrupt_of_batch: tokio::signal::windows::CtrlBreak,
    close: tokio::signal::windows::CtrlClose,
    shutdown: tokio::signal::windows::CtrlShutdown,
}

#[cfg(windows)]
fn listen() -> io::Result<ConsoleEvents> {
    use tokio::signal::windows::{ctrl_break, ctrl_c, ctrl_close, ctrl_shutdown};
    Ok(ConsoleEvents {
        interrupt: ctrl_c()?,
        interrupt_of_batch: ctrl_break()?,
        close: ctrl_close()?,
        shutdown: ctrl_shutdown()?,
    })
}

#[cfg(windows)]
impl ConsoleEvents {
    async fn next(&mut self) -> StopRequest {
        tokio::select! {
            _ = self.interrupt.recv() => INTERRUPTED,
            _ = self.interrupt_of_batch.recv() => INTERRUPTED,
            _ = self.close.recv() => TERMINATED,
            _ = self.shutdown.recv() => TERMINATED,
        }
    }
}
