//! From sockets to requests: how many at once, how large, and how slow they may be.

use std::convert::Infallible;
use std::io;
use std::net::TcpListener;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Sleep, sleep, timeout};

use super::Shared;
use super::routes::answer_to;

/// Others wait until one of these has ended.
const CONNECTIONS_MAX: usize = 512;

/// What a request may say before its body, and in how many lines.
const HEAD_BYTES_MAX: usize = 16 << 10;
const HEAD_LINES_MAX: usize = 64;

/// How long a request may take to arrive, and a connection be without one.
const HEAD_PATIENCE: Duration = Duration::from_secs(10);

/// How long the other side may take nothing of an answer.
const STALL_PATIENCE: Duration = Duration::from_secs(30);

/// How long what is being answered may go on when the window closes.
const CLOSING_PATIENCE: Duration = Duration::from_millis(300);

/// Where the system refuses a connection, it is asked again after so long.
const REFUSED_WAIT: Duration = Duration::from_millis(100);

/// Serves all who come, until the window closes.
pub(super) async fn serve(listener: TcpListener, shared: Arc<Shared>) -> io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let room = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    let accepting = tokio::spawn(accept_all(listener, Arc::clone(&room), Arc::clone(&shared)));
    let mut closing = shared.closing.clone();
    // It fails when whoever could close the window is gone: then it is closed.
    let _ = closing.wait_for(|&is_closing| is_closing).await;
    accepting.abort();
    // What does not end in time is cut off.
    let _ = timeout(CLOSING_PATIENCE, room.acquire_many(CONNECTIONS_MAX as u32)).await;
    Ok(())
}

async fn accept_all(listener: tokio::net::TcpListener, room: Arc<Semaphore>, shared: Arc<Shared>) {
    loop {
        // The semaphore is never closed.
        let Ok(place) = Arc::clone(&room).acquire_owned().await else { return };
        match listener.accept().await {
            Ok((stream, _)) => drop(tokio::spawn(answer_all(stream, place, Arc::clone(&shared)))),
            // The system is short of something, or the other side is gone already.
            Err(_) => sleep(REFUSED_WAIT).await,
        }
    }
}

/// Answers the requests of one connection.
async fn answer_all(stream: TcpStream, _place: OwnedSemaphorePermit, shared: Arc<Shared>) {
    let Ok(local) = stream.local_addr() else { return };
    // Events are small, and nobody wants to wait for them.
    let _ = stream.set_nodelay(true);
    let service = service_fn(|request| {
        let shared = Arc::clone(&shared);
        async move { Ok::<_, Infallible>(answer_to(&shared, &request, local.ip()).await) }
    });
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_PATIENCE)
        .max_buf_size(HEAD_BYTES_MAX)
        .max_headers(HEAD_LINES_MAX)
        .serve_connection(TokioIo::new(Guarded { stream, stalled: None }), service)
        .await;
    if let Err(error) = served {
        tracing::debug!("a connection of the window has ended: {error}");
    }
}

/// A socket that gives up on a side that takes nothing.
struct Guarded {
    stream: TcpStream,
    /// Ends when the other side has had its time; `None` while it takes what it is sent.
    stalled: Option<Pin<Box<Sleep>>>,
}

impl Guarded {
    fn watched<T>(&mut self, written: Poll<io::Result<T>>, context: &mut Context<'_>) -> Poll<io::Result<T>> {
        if written.is_ready() {
            self.stalled = None;
            return written;
        }
        let stalled = self.stalled.get_or_insert_with(|| Box::pin(sleep(STALL_PATIENCE)));
        match stalled.as_mut().poll(context) {
            Poll::Ready(()) => Poll::Ready(Err(io::ErrorKind::TimedOut.into())),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl AsyncRead for Guarded {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Guarded {
    fn poll_write(self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let written = Pin::new(&mut this.stream).poll_write(context, bytes);
        this.watched(written, context)
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        let flushed = Pin::new(&mut this.stream).poll_flush(context);
        this.watched(flushed, context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_shutdown(context)
    }
}
