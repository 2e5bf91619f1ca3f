//! The status page, the API and the metrics: what is in the [status store](crate::watch::status_store), by HTTP.
//!
//! ```text
//!   serve     sockets ──▶ requests: how large, how slow; connections: how many
//!   access    who may ask: the name of the host, the token
//!   routes    what is asked for          api       frames, settings, status as JSON
//!   answer    what every answer says     events    changes, as they come
//!                                        files     outputs, by their names in the status store
//!                                        metrics   for Prometheus
//!                                        assets    the page
//! ```
//!
//! One thread serves all clients and does nothing else, so they slow down a frame by no more than that. It only reads.
//! No path is made of what a request says: names are looked up in the status store, and what is not there is not served.
//! `docs/window.md` is the interface as users know it.

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

use crate::watch::status_store::StatusStore;

pub use access::{AccessToken, TokenError};

/// Where to listen, and to whom.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listen {
    /// Port 0 stands for any that is free.
    pub address: SocketAddr,
    /// Who does not have it sees nothing. Without it, whoever reaches the address may look.
    pub token: Option<AccessToken>,
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
struct ServerState {
    store: Arc<StatusStore>,
    token: Option<AccessToken>,
    /// Becomes true when the window closes.
    closing: watch::Receiver<bool>,
    subscribers: events::Subscribers,
}

/// The thread calls nothing that goes deep.
const STACK_BYTES: usize = 512 << 10;

/// Files are read beside the thread, which the disk must not hold up.
const READERS_MAX: usize = 2;

impl Window {
    /// Serves the status store at this address.
    ///
    /// # Errors
    /// When somebody else has the address, or the system refuses.
    pub fn open(listen: &Listen, store: Arc<StatusStore>) -> io::Result<Window> {
        let listener = TcpListener::bind(listen.address)?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let (closing, is_closing) = watch::channel(false);
        let shared = Arc::new(ServerState {
            store,
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
