//! Accepts connections, and enforces limits on the number of connections, the size of requests, and the
//! slowness of clients.
//!
//! A client that reads its response too slowly would occupy its slot forever. So each connection has a time
//! budget, which decreases while the client reads nothing, and increases as it reads. When all slots are
//! taken, the connection that has been idle for longest is closed. While nearly all are busy, only health
//! checks are answered.

use std::convert::Infallible;
use std::future::{Future, poll_fn};
use std::io;
use std::net::TcpListener;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::{Instant, Sleep, sleep, timeout};

use super::ServerState;
use super::connections::{Connection, Connections};
use super::routes::{answer_to, answer_when_busy};

/// The limits of connections.
#[derive(Clone, Copy, Debug)]
struct ConnectionLimits {
    /// Maximum number of connections; beyond it, idle ones are closed.
    connections_max: usize,
    /// How long a request head may take to arrive, and a connection may stay idle.
    head_timeout: Duration,
}

const LIMITS: ConnectionLimits =
    ConnectionLimits { connections_max: 512, head_timeout: Duration::from_secs(10) };

/// Slots reserved for health checks.
const CONNECTIONS_FOR_HEALTH: usize = 16;

/// Maximum size of a request head, in bytes, and maximum number of headers.
const HEAD_BYTES_MAX: usize = 16 << 10;
const HEAD_LINES_MAX: usize = 64;

/// How long a client may read nothing of a response.
const STALL_TIMEOUT: Duration = Duration::from_secs(30);

/// The minimum rate of reading: a client that reads more slowly uses up its time budget.
const READ_BYTES_PER_S_MIN: f64 = 10e3;

/// How long responses may continue after the server is asked to close.
const CLOSING_TIMEOUT: Duration = Duration::from_millis(300);

/// Pause after the system fails to accept a connection.
const REFUSED_WAIT: Duration = Duration::from_millis(100);

/// The response while the clock is before 1970.
const CLOCK_IS_WRONG: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\ncontent-type: text/plain\r\n\
    connection: close\r\n\r\nthe clock of this machine is before 1970: set it\n";

/// Serves all clients until the server closes.
pub(super) async fn serve(listener: TcpListener, shared: Arc<ServerState>) -> io::Result<()> {
    serve_within(LIMITS, listener, shared).await
}

async fn serve_within(
    limits: ConnectionLimits,
    listener: TcpListener,
    shared: Arc<ServerState>,
) -> io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let ConnectionLimits { connections_max, head_timeout } = limits;
    let busy_max = connections_max.saturating_sub(CONNECTIONS_FOR_HEALTH);
    let connections = Arc::new(Connections::new(connections_max, busy_max));
    let shared_by_all = Arc::clone(&shared);
    let accepting = tokio::spawn(accept_all(listener, Arc::clone(&connections), shared_by_all, head_timeout));
    let mut closing = shared.closing.clone();
    // An error means that the sender is gone: then the server closes, too.
    let _ = closing.wait_for(|&is_closing| is_closing).await;
    accepting.abort();
    // Connections that do not end in time are cut off.
    let _ = timeout(CLOSING_TIMEOUT, connections.all_ended()).await;
    Ok(())
}

async fn accept_all(
    listener: tokio::net::TcpListener,
    connections: Arc<Connections>,
    shared: Arc<ServerState>,
    head_timeout: Duration,
) {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => {
                let connection = Arc::new(connections.add().await);
                let (connections, shared) = (Arc::clone(&connections), Arc::clone(&shared));
                tokio::spawn(answer_all(stream, connection, connections, shared, head_timeout));
            }
            // The system lacks a resource, or the client is already gone.
            Err(_) => sleep(REFUSED_WAIT).await,
        }
    }
}

/// Answers the requests of one connection.
async fn answer_all(
    stream: TcpStream,
    connection: Arc<Connection>,
    connections: Arc<Connections>,
    shared: Arc<ServerState>,
    head_timeout: Duration,
) {
    let Ok(local) = stream.local_addr() else { return };
    if SystemTime::now() < UNIX_EPOCH {
        // For such a time hyper cannot write the `date` header, so this bypasses hyper. A new socket is not
        // known to be writable until `writable` has waited for it.
        if let Ok(Ok(())) = timeout(CLOSING_TIMEOUT, stream.writable()).await {
            let _ = stream.try_write(CLOCK_IS_WRONG);
        }
        return;
    }
    // Events are small and must not be delayed.
    let _ = stream.set_nodelay(true);
    let service = service_fn(|request| {
        let (shared, answering) = (Arc::clone(&shared), connection.begin());
        let is_busy = connections.is_busy();
        async move {
            let answer = match is_busy {
                true => answer_when_busy(&shared, &request, local).await,
                false => answer_to(&shared, &request, local).await,
            };
            Ok::<_, Infallible>(answer.map(|content| content.during(answering)))
        }
    });
    let mut served = pin!(
        http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(head_timeout)
            .max_buf_size(HEAD_BYTES_MAX)
            .max_headers(HEAD_LINES_MAX)
            .serve_connection(TokioIo::new(StallTimeout::new(stream, Arc::clone(&connection))), service)
    );
    let mut is_to_close = pin!(connection.is_to_close());
    let ended = poll_fn(|context| match is_to_close.as_mut().poll(context) {
        // Another connection needs the slot: dropping this one closes the socket.
        Poll::Ready(()) => Poll::Ready(Ok(())),
        Poll::Pending => served.as_mut().poll(context),
    });
    if let Err(error) = ended.await {
        tracing::debug!("a connection to the status page has ended: {error}");
    }
}

/// A socket that times out if the client reads nothing, or too slowly.
struct StallTimeout {
    stream: TcpStream,
    /// The rest of the client's time budget.
    budget: Duration,
    /// Since when the client has read nothing, and a timer for the end of its budget; `None` while it reads.
    stalled: Option<(Instant, Pin<Box<Sleep>>)>,
    connection: Arc<Connection>,
}

impl StallTimeout {
    fn new(stream: TcpStream, connection: Arc<Connection>) -> StallTimeout {
        StallTimeout { stream, budget: STALL_TIMEOUT, stalled: None, connection }
    }

    /// Updates the time budget after the client has read this many bytes.
    fn on_read(&mut self, count: usize) {
        let held = self.stalled.take().map_or(Duration::ZERO, |(since, _)| since.elapsed());
        self.budget = budget_after(self.budget, held, count);
    }

    /// Called while the client reads nothing: returns whether its time budget is used up, and otherwise wakes
    /// the task when it is.
    fn is_over(&mut self, context: &mut Context<'_>) -> bool {
        let timeout = self.budget;
        let (_, end) = self.stalled.get_or_insert_with(|| (Instant::now(), Box::pin(sleep(timeout))));
        end.as_mut().poll(context).is_ready()
    }
}

/// The time budget after the client has read nothing for `held`, and has then read `sent_bytes`.
fn budget_after(before: Duration, held: Duration, sent_bytes: usize) -> Duration {
    let allowance = Duration::from_secs_f64(sent_bytes as f64 / READ_BYTES_PER_S_MIN);
    (before.saturating_sub(held) + allowance).min(STALL_TIMEOUT)
}

impl AsyncRead for StallTimeout {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for StallTimeout {
    fn poll_write(self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        match Pin::new(&mut this.stream).poll_write(context, bytes) {
            Poll::Ready(Ok(count)) => {
                this.on_read(count);
                Poll::Ready(Ok(count))
            }
            Poll::Ready(Err(error)) => Poll::Ready(Err(error)),
            Poll::Pending if this.is_over(context) => Poll::Ready(Err(io::ErrorKind::TimedOut.into())),
            Poll::Pending => Poll::Pending,
        }
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        // A socket has no buffer to flush: written data is already with the system. hyper flushes after the
        // last byte of a response.
        let this = self.get_mut();
        this.connection.flushed();
        Pin::new(&mut this.stream).poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use std::io::{Read, Write};
    use std::net::TcpStream as Client;
    use std::thread;

    use tokio::runtime;
    use tokio::sync::watch;

    use super::super::events::Subscribers;
    use crate::watch::status_store::StatusStore;

    /// The number of pieces of 20 kB that a client receives if it reads one piece every `every_s` seconds.
    fn chunks_received(every_s: u64) -> usize {
        let every = Duration::from_secs(every_s);
        let mut timeout = STALL_TIMEOUT;
        let is_patient = |_: &usize| {
            let is_in_time = every < timeout;
            timeout = budget_after(timeout, every, 20_000);
            is_in_time
        };
        (0..1000).take_while(is_patient).count()
    }

    #[test]
    fn slow_reader_is_disconnected() {
        assert_eq!(chunks_received(1), 1000, "twice the minimum rate");
        assert_eq!(chunks_received(2), 1000, "exactly the minimum rate");
        // At the minimum rate a piece takes two seconds. This client takes five, so each piece costs it three
        // of its thirty seconds.
        assert_eq!(chunks_received(5), 9);
        assert_eq!(chunks_received(30), 0);
    }

    #[test]
    fn connection_that_is_idle_for_longest_is_closed_for_a_new_one() {
        // No connection times out while this test runs.
        let limits = ConnectionLimits { connections_max: 20, head_timeout: Duration::from_secs(3600) };
        let (closing, is_closing) = watch::channel(false);
        let shared = Arc::new(ServerState {
            store: Arc::new(StatusStore::new()),
            token: None,
            closing: is_closing,
            subscribers: Subscribers::default(),
        });
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        listener.set_nonblocking(true).expect("set");
        let address = listener.local_addr().expect("an address");
        let serving = thread::spawn(move || {
            let runtime = runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
            runtime.block_on(serve_within(limits, listener, shared))
        });
        let connect = || {
            let stream = Client::connect(address).expect("connected");
            stream.set_read_timeout(Some(Duration::from_secs(600))).expect("set");
            stream
        };
        // Half of the clients send nothing; the others send half a request.
        let idle: Vec<Client> = (0..limits.connections_max)
            .map(|number| {
                let mut stream = connect();
                if number % 2 == 1 {
                    write!(stream, "GET / HTTP/1.1\r\nHost: {address}\r\n").expect("sent");
                }
                stream
            })
            .collect();
        let mut another = connect();
        let request = format!("GET /healthz HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        another.write_all(request.as_bytes()).expect("sent");
        let mut answer = String::new();
        another.read_to_string(&mut answer).expect("an answer");
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        let end = (&idle[0]).read(&mut [0]);
        let is_reset = |error: &io::Error| error.kind() == io::ErrorKind::ConnectionReset;
        assert!(matches!(end, Ok(0)) || end.as_ref().is_err_and(is_reset), "{end:?}");
        for stream in &idle[1..] {
            stream.set_nonblocking(true).expect("set");
            let still_open = (&*stream).read(&mut [0]).expect_err("nothing to read, and no end");
            assert_eq!(still_open.kind(), io::ErrorKind::WouldBlock);
        }
        closing.send(true).expect("served");
        serving.join().expect("no panic").expect("served");
    }

    #[test]
    fn time_budget_does_not_accumulate_beyond_its_limit() {
        assert_eq!(budget_after(STALL_TIMEOUT, Duration::ZERO, usize::MAX >> 16), STALL_TIMEOUT);
    }
}
