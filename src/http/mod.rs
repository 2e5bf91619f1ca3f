//! The HTTP server. Serves the status page, the API and the metrics from the
//! [status store](crate::watch::status_store).
//!
//! ```text
//!   serve     sockets ──▶ requests: limits of number, size and time
//!   access    host name and token
//!   routes    dispatch by path           api       frames, settings, status as JSON
//!   answer    headers and bodies         events    stream of changes
//!                                        files     outputs, by their names in the status store
//!                                        metrics   for Prometheus
//!                                        assets    the page
//! ```
//!
//! One thread serves all clients, and at most two more threads read files for it, so the conversion of frames
//! loses at most the time of these threads to clients, however many there are. The server only reads. It
//! builds no path from a request: it looks names up in the status store, and serves nothing else.
//! `docs/status-page.md` describes the interface for users.

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

/// The address to listen on, and the token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listen {
    /// Port 0 means any free port.
    pub address: SocketAddr,
    /// The token that clients must send. If `None`, every client that reaches the address may read.
    pub token: Option<AccessToken>,
}

/// A running server; dropping it closes it.
#[derive(Debug)]
pub struct HttpServer {
    address: SocketAddr,
    closing: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

/// State shared by all requests.
#[derive(Debug)]
struct ServerState {
    store: Arc<StatusStore>,
    token: Option<AccessToken>,
    /// Becomes true when the server closes.
    closing: watch::Receiver<bool>,
    subscribers: events::Subscribers,
}

/// Stack size of the server's threads, which have no deep call chains.
const STACK_BYTES: usize = 512 << 10;

/// Maximum number of threads that read files. They are separate so that the disk does not block the server's
/// thread.
const READERS_MAX: usize = 2;

impl HttpServer {
    /// Serves the status store at this address.
    ///
    /// # Errors
    /// When the address is in use, or the system refuses.
    pub fn open(listen: &Listen, store: Arc<StatusStore>) -> io::Result<HttpServer> {
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
        let thread = thread::Builder::new().name("http".to_owned()).stack_size(STACK_BYTES);
        let thread = thread.spawn(move || {
            if let Err(error) = runtime.block_on(serve::serve(listener, shared)) {
                tracing::error!("the status page and the API have stopped: {error}; the daemon continues");
            }
            // Does not wait for threads that still read a file.
            runtime.shutdown_background();
        })?;
        Ok(HttpServer { address, closing, thread: Some(thread) })
    }

    /// The address that the server listens on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for HttpServer {
    fn drop(&mut self) {
        // Fails if the thread has already ended.
        let _ = self.closing.send(true);
        if let Some(thread) = self.thread.take() {
            // The thread has logged its error.
            let _ = thread.join();
        }
    }
}
