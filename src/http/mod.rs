//! The window: what is on the [board](crate::watch::board), for a browser and for programs, by HTTP.
//!
//! ```text
//!   serve     sockets ──▶ requests: how large, how slow; connections: how many
//!   access    who may ask: the name of the host, the token
//!   routes    what is asked for          api       frames, settings, status as JSON
//!   answer    what every answer says     events    changes, as they come
//!                                        files     outputs, by their names on the board
//!                                        metrics   for Prometheus
//!                                        assets    the page
//! ```
//!
//! One thread serves all who look, and has nothing else to do: nobody who looks can slow down a frame by more
//! than that. It only reads. Whatever a request says, no path is made of it: names are looked up on the
//! board, and what is not there is not served. `docs/window.md` is the interface as users know it.

mod access;
mod answer;
mod api;
mod assets;
mod connections;
mod events;
mod files;
mod metrics;
mod query;
mod routes;
mod serve;

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use tokio::runtime;
use tokio::sync::watch;

use crate::watch::board::Board;

pub use access::{Token, TokenError};

/// Where to listen, and to whom.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listen {
    /// Port 0 stands for any that is free.
    pub address: SocketAddr,
    /// Who does not have it sees nothing. Without it, whoever reaches the address may look.
    pub token: Option<Token>,
}

/// A window that is open; it closes when it is dropped.
#[derive(Debug)]
pub struct Window {
    address: SocketAddr,
    closing: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

/// What all requests share.
#[derive(Debug)]
struct Shared {
    board: Arc<Board>,
    token: Option<Token>,
    /// Becomes true when the window closes.
    closing: watch::Receiver<bool>,
    subscribers: events::Subscribers,
}

/// The thread calls nothing that goes deep.
const STACK_BYTES: usize = 512 << 10;

/// Files are read beside the thread, which the disk must not hold up.
const READERS_MAX: usize = 2;

impl Window {
    /// Opens a window at this address onto the board.
    ///
    /// # Errors
    /// When somebody else has the address, or the system refuses.
    pub fn open(listen: &Listen, board: Arc<Board>) -> io::Result<Window> {
        let listener = TcpListener::bind(listen.address)?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let (closing, is_closing) = watch::channel(false);
        let shared = Arc::new(Shared {
            board,
            token: listen.token.clone(),
            closing: is_closing,
            subscribers: events::Subscribers::default(),
        });
        let runtime = runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .max_blocking_threads(READERS_MAX)
            .thread_stack_size(STACK_BYTES)
            .build()?;
        let thread = thread::Builder::new().name("window".to_owned()).stack_size(STACK_BYTES);
        let thread = thread.spawn(move || {
            if let Err(error) = runtime.block_on(serve::serve(listener, shared)) {
                tracing::error!("the window is closed: {error}");
            }
            // Who still reads a file does not hold up the end.
            runtime.shutdown_background();
        })?;
        Ok(Window { address, closing, thread: Some(thread) })
    }

    /// Where it is.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Window {
    fn drop(&mut self) {
        // Nobody hears it where the thread has ended.
        let _ = self.closing.send(true);
        if let Some(thread) = self.thread.take() {
            // What it ended with was told.
            let _ = thread.join();
        }
    }
}
