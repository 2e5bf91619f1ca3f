//! The HTTP server. Serves the status page, the API and the metrics from the
//! [status store](crate::watch::status_store).
//!
//! ```text
//!   clients ──▶ this file: connections, checks, routes
//!                 ├──▶ api       frames, settings, status as JSON; health; stream of changes; metrics
//!                 └──▶ files     outputs, by their names in the status store, and the page
//! ```
//!
//! One thread serves all clients, and at most two more read files for it, so that clients take at most three
//! threads' time from the conversion, however many they are. The server only reads. It
//! builds no path from a request: it looks names up in the status store, and serves nothing else.
//! `docs/status-page.md` describes the interface for users.

mod api;
mod files;

use std::fmt;
use std::hint::black_box;
use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use axum::Router;
use axum::body::HttpBody;
use axum::extract::{Query, Request, State};
use axum::http::header::{self, AUTHORIZATION, COOKIE, HOST, HeaderName, HeaderValue};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, Method, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use serde::Deserialize;
use tokio::runtime;
use tokio::sync::{Semaphore, watch};
use tokio::time::{sleep, timeout};
use tokio_io_timeout::TimeoutStream;

use crate::watch::status_store::StatusStore;

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
    port: u16,
    /// Becomes true when the server closes.
    closing: watch::Receiver<bool>,
    /// One permit for each subscriber of events that may still connect.
    subscribers: Arc<Semaphore>,
}

type Shared = State<Arc<ServerState>>;

/// What one client may occupy, and for how long.
#[derive(Clone, Copy, Debug)]
struct ClientLimits {
    /// Maximum number of connections; beyond it, a connection ends after [`BRIEF_TIMEOUT`].
    connections_max: usize,
    /// How long a request may take to arrive, and a connection may stay without one.
    request_timeout: Duration,
    /// How long a client may accept nothing of a response.
    write_timeout: Duration,
}

const LIMITS: ClientLimits = ClientLimits {
    connections_max: 512,
    request_timeout: Duration::from_secs(10),
    write_timeout: Duration::from_secs(30),
};

/// Maximum number of connections beyond the others, which slow clients can fill, and how long each may take in all: so a
/// health check is answered within a second, beside 1500 slow clients.
const BRIEF_MAX: usize = 256;
const BRIEF_TIMEOUT: Duration = Duration::from_millis(250);

/// Maximum number of subscribers of events, which keep their connections.
const SUBSCRIBERS_MAX: usize = 256;

/// Maximum size of a request head, in bytes, and maximum number of headers.
const HEAD_BYTES_MAX: usize = 16 << 10;
const HEAD_LINES_MAX: usize = 64;

/// How long the disk may take to open a file.
const OPEN_TIMEOUT: Duration = Duration::from_secs(30);

/// How long responses may continue after the server is asked to close.
const CLOSING_TIMEOUT: Duration = Duration::from_millis(300);

/// Pause after the system fails to accept a connection.
const REFUSED_WAIT: Duration = Duration::from_millis(100);

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
        HttpServer::open_within(LIMITS, listen, store)
    }

    fn open_within(limits: ClientLimits, listen: &Listen, store: Arc<StatusStore>) -> io::Result<HttpServer> {
        let listener = TcpListener::bind(listen.address)?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let (closing, is_closing) = watch::channel(false);
        let state = ServerState {
            store,
            token: listen.token.clone(),
            port: address.port(),
            closing: is_closing.clone(),
            subscribers: Arc::new(Semaphore::new(SUBSCRIBERS_MAX)),
        };
        let runtime = runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .max_blocking_threads(READERS_MAX)
            .thread_stack_size(STACK_BYTES)
            .build()?;
        let thread = thread::Builder::new().name("http".to_owned()).stack_size(STACK_BYTES);
        let thread = thread.spawn(move || {
            if let Err(error) = runtime.block_on(serve(limits, listener, routes(state), is_closing)) {
                tracing::error!("the status page and the API have stopped: {error}; the daemon continues: restart it to get them back");
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

/// Serves all clients until the server closes.
async fn serve(
    limits: ClientLimits,
    listener: TcpListener,
    routes: Router,
    mut closing: watch::Receiver<bool>,
) -> io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let slots = Arc::new(Semaphore::new(limits.connections_max));
    let brief_slots = Arc::new(Semaphore::new(BRIEF_MAX));
    let connections = GracefulShutdown::new();
    let mut protocol = http1::Builder::new();
    protocol
        .timer(TokioTimer::new())
        .header_read_timeout(limits.request_timeout)
        .max_buf_size(HEAD_BYTES_MAX)
        .max_headers(HEAD_LINES_MAX);
    let accept_all = async {
        loop {
            let Ok((stream, _)) = listener.accept().await else {
                // The system lacks a resource, or the client is already gone.
                sleep(REFUSED_WAIT).await;
                continue;
            };
            let (slot, time_limit) = match Arc::clone(&slots).try_acquire_owned() {
                Ok(slot) => (Ok(slot), Duration::MAX),
                Err(_) => (Arc::clone(&brief_slots).acquire_owned().await, BRIEF_TIMEOUT),
            };
            // Events are small and must not be delayed.
            let _ = stream.set_nodelay(true);
            let mut stream = TimeoutStream::new(stream);
            stream.set_write_timeout(Some(limits.write_timeout));
            let service = TowerToHyperService::new(routes.clone());
            let connection = protocol.serve_connection(TokioIo::new(Box::pin(stream)), service);
            let connection = connections.watch(connection);
            tokio::spawn(async move {
                let _slot = slot;
                if let Ok(Err(error)) = timeout(time_limit, connection).await {
                    tracing::debug!("a connection to the status page has ended: {error}");
                }
            });
        }
    };
    tokio::select! {
        () = accept_all => {}
        // An error means that the sender is gone: then the server closes, too.
        _ = closing.wait_for(|&is_closing| is_closing) => {}
    }
    // Connections that do not end in time are cut off.
    let _ = timeout(CLOSING_TIMEOUT, connections.shutdown()).await;
    Ok(())
}

fn routes(state: ServerState) -> Router {
    let state = Arc::new(state);
    Router::new()
        .route("/api/frames", get(api::frames))
        .route("/api/frames/{*name}", get(api::frame))
        .route("/api/settings", get(api::settings))
        .route("/api/status", get(api::status))
        .route("/events", get(api::follow))
        .route("/files/{*name}", get(files::output))
        .route("/metrics", get(api::metrics))
        .fallback(files::asset)
        .layer(middleware::from_fn_with_state(Arc::clone(&state), require_token))
        // These need no token: they reveal only whether the daemon runs.
        .route("/healthz", get(api::health))
        .route("/readyz", get(api::readiness))
        .layer(middleware::from_fn(check))
        .with_state(state)
}

/// Refuses requests that no reader of the status sends, and adds the security headers to every response.
async fn check(request: Request, next: Next) -> Response {
    let mut response = if !is_for_this_machine(&request) {
        let what = "unknown host name: open this page by the IP address of this machine, or as localhost";
        refusal(StatusCode::MISDIRECTED_REQUEST, what)
    } else if !matches!(*request.method(), Method::GET | Method::HEAD) {
        let refusal = refusal(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD are allowed");
        ([(header::ALLOW, "GET, HEAD")], refusal).into_response()
    } else if !request.body().is_end_stream() {
        refusal(StatusCode::PAYLOAD_TOO_LARGE, "requests must not have a body")
    } else {
        next.run(request).await
    };
    for (name, value) in [
        (header::CACHE_CONTROL, "no-store"),
        // The page may load content only from this server, and no other page may embed it.
        (
            header::CONTENT_SECURITY_POLICY,
            "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; \
             form-action 'none'; frame-ancestors 'none'",
        ),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        response.headers_mut().entry(name).or_insert(HeaderValue::from_static(value));
    }
    response
}

/// Closes the connection after this response, because the body of a refused request is not read.
fn refusal(status: StatusCode, what: &'static str) -> Response {
    (status, [(header::CONNECTION, "close")], format!("{what}\n")).into_response()
}

/// The query of the first URL that a browser opens.
#[derive(Deserialize)]
struct Login {
    token: String,
}

/// Requires the token, if there is one: as `Authorization: Bearer`, or in the cookie that `/?token=…` sets.
async fn require_token(State(state): Shared, request: Request, next: Next) -> Response {
    let Some(token) = &state.token else { return next.run(request).await };
    if token.is_in(request.headers(), state.port) {
        return next.run(request).await;
    }
    let login = Query::<Login>::try_from_uri(request.uri());
    if request.uri().path() == "/" && login.is_ok_and(|Query(login)| token.is(&login.token)) {
        // The address that the browser shows and keeps has no token.
        return ([(header::SET_COOKIE, token.cookie(state.port))], Redirect::to("/")).into_response();
    }
    let what =
        "the token is missing or wrong: open /?token=TOKEN, or send it as an Authorization: Bearer header\n";
    (StatusCode::UNAUTHORIZED, [(header::WWW_AUTHENTICATE, "Bearer")], what).into_response()
}

fn not_found() -> Response {
    (StatusCode::NOT_FOUND, "not found\n").into_response()
}

// Access control: the host name of a request, and the token.
//
// A page on any web site can make a browser send requests to this machine, and can even let its own domain
// name resolve to this address (DNS rebinding). But the browser then sends that domain name in the `Host`
// header. So the header must contain an address, or `localhost`. A server that listens on more than the
// loopback address also requires a token.

/// The secret that clients must send. Its `Debug` output does not contain it.
#[derive(Clone, PartialEq, Eq)]
pub struct AccessToken(String);

impl AccessToken {
    /// Creates a token from 16 to 256 ASCII letters, digits, and `-`, `_`, `.`, `~`; `None` if the text has
    /// another length or other characters.
    pub fn new(text: &str) -> Option<AccessToken> {
        let is_right = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.~".contains(&byte);
        let is_valid = (16..=256).contains(&text.len()) && text.bytes().all(is_right);
        is_valid.then(|| AccessToken(text.to_owned()))
    }

    /// Compares in constant time, so that timing does not reveal how much of a guess is right.
    fn is(&self, given: &str) -> bool {
        let pairs = self.0.bytes().zip(given.bytes());
        let difference = pairs.fold(self.0.len() ^ given.len(), |all, (a, b)| all | usize::from(a ^ b));
        black_box(difference) == 0
    }

    /// Whether a request to the server at this port carries the token: as `Authorization: Bearer`, or in the
    /// cookie.
    fn is_in(&self, headers: &HeaderMap, port: u16) -> bool {
        let bearer = headers.get(AUTHORIZATION).and_then(|value| value.to_str().ok()?.split_once(' '));
        let cookies = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
        let name = cookie_name(port);
        let mut given = cookies
            .flat_map(|cookies| cookies.split(';'))
            .filter_map(|cookie| cookie.trim().strip_prefix(&name)?.strip_prefix('='));
        bearer.is_some_and(|(scheme, given)| scheme.eq_ignore_ascii_case("bearer") && self.is(given))
            || given.any(|given| self.is(given))
    }

    /// The cookie that makes a browser send the token to the server at this port.
    fn cookie(&self, port: u16) -> String {
        format!("{}={}; Path=/; HttpOnly; SameSite=Strict", cookie_name(port), self.0)
    }
}

/// Browsers share cookies between all ports of a host: without the port in the name, two daemons would
/// overwrite each other's cookie.
fn cookie_name(port: u16) -> String {
    format!("meniscus_token_{port}")
}

impl fmt::Debug for AccessToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("AccessToken")
    }
}

/// Whether a request names this machine by an address or as `localhost`, with or without a port. Any port and
/// any address are accepted: through a tunnel a client uses those of its other end, and no web site can choose them.
fn is_for_this_machine(request: &Request) -> bool {
    let mut hosts = request.headers().get_all(HOST).iter();
    let (Some(host), None) = (hosts.next(), hosts.next()) else { return false };
    let host = host.to_str().ok().and_then(|host| host.parse().ok());
    host.is_some_and(|host| is_no_domain(&host)) && request.uri().authority().is_none_or(is_no_domain)
}

/// Whether an authority is an address or `localhost`, without a user before it.
fn is_no_domain(authority: &Authority) -> bool {
    let host = authority.host();
    let address = host.trim_start_matches('[').trim_end_matches(']');
    let is_local = host.eq_ignore_ascii_case("localhost") || address.parse::<IpAddr>().is_ok();
    is_local && !authority.as_str().contains('@')
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read, Write};
    use std::net::TcpStream;

    use axum::body::Body;

    #[test]
    fn client_that_is_slower_than_a_limit_is_disconnected() {
        let (soon, never) = (Duration::from_millis(200), Duration::from_secs(3600));
        let page = "GET /vendor/three.core.min.js HTTP/1.1\r\nHost: localhost\r\n\r\n".repeat(100);
        for (what, sent, request_timeout, write_timeout) in [
            ("sends nothing", "", soon, never),
            ("sends half a request", "GET / HTTP/1.1\r\nHost: localhost\r\n", soon, never),
            ("does not read", &page, never, soon),
        ] {
            let limits = ClientLimits { connections_max: 1, request_timeout, write_timeout };
            let listen = Listen { address: "127.0.0.1:0".parse().expect("an address"), token: None };
            let store = Arc::new(StatusStore::new());
            let server = HttpServer::open_within(limits, &listen, store).expect("a port");
            let mut slow = TcpStream::connect(server.address()).expect("connected");
            slow.set_read_timeout(Some(Duration::from_secs(60))).expect("set");
            slow.write_all(sent.as_bytes()).expect("sent");
            thread::sleep(2 * soon);
            // The system may have taken a part of the answers.
            let mut answers = Vec::new();
            let is_over = match slow.read_to_end(&mut answers) {
                Ok(_) => true,
                Err(error) => error.kind() == io::ErrorKind::ConnectionReset,
            };
            assert!(is_over && answers.len() < 20 << 20, "a client that {what}: {} bytes", answers.len());
        }
    }

    #[test]
    fn health_is_answered_however_many_slow_clients_there_are() {
        let never = Duration::from_secs(3600);
        let limits = ClientLimits { connections_max: 4, request_timeout: never, write_timeout: never };
        let listen = Listen { address: "127.0.0.1:0".parse().expect("an address"), token: None };
        let store = Arc::new(StatusStore::new());
        let server = HttpServer::open_within(limits, &listen, store).expect("a port");
        let connect = || TcpStream::connect(server.address()).expect("connected");
        let _slow: Vec<TcpStream> = (0..4 + 2 * BRIEF_MAX).map(|_| connect()).collect();
        let mut client = connect();
        client.set_read_timeout(Some(Duration::from_secs(60))).expect("set");
        client
            .write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            .expect("sent");
        let mut answer = String::new();
        client.read_to_string(&mut answer).expect("an answer");
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    }

    #[test]
    fn only_addresses_and_localhost_are_accepted_as_host() {
        let is_accepted = |uri: &str, hosts: &[&str]| {
            let request = hosts.iter().fold(Request::get(uri), |request, host| request.header(HOST, *host));
            is_for_this_machine(&request.body(Body::empty()).expect("a request"))
        };
        for host in ["localhost", "LOCALHOST:7700", "127.0.0.1:1", "[::1]:7700", "192.168.1.7:7700"] {
            assert!(is_accepted("/", &[host]), "{host}");
        }
        for host in [
            "evil.example",
            "localhost.evil.example",
            "127.0.0.1.nip.io",
            "localhost@evil.example",
            "a:b@127.0.0.1",
            "",
        ] {
            assert!(!is_accepted("/", &[host]), "{host}");
        }
        assert!(!is_accepted("/", &[]));
        assert!(!is_accepted("/", &["localhost", "localhost"]));
        assert!(!is_accepted("http://evil.example/", &["localhost"]));
    }

    #[test]
    fn only_the_whole_token_is_accepted() {
        let token = AccessToken::new("0123456789abcdef").expect("a token");
        assert!(token.is("0123456789abcdef"));
        for wrong in ["", "0123456789abcde", "0123456789abcdeg", "0123456789abcdef0"] {
            assert!(!token.is(wrong), "{wrong}");
        }
        for text in ["short", "0123456789abcde;", "0123456789abcde f", &"x".repeat(257)] {
            assert_eq!(AccessToken::new(text), None, "{text}");
        }
        assert_eq!(format!("{token:?}"), "AccessToken");
    }

    #[test]
    fn token_is_read_from_the_bearer_header_and_the_cookie() {
        let token = AccessToken::new("0123456789abcdef").expect("a token");
        let is_in = |name, value: &'static str| {
            let value = value.parse().expect("a value");
            token.is_in(&HeaderMap::from_iter([(name, value)]), 7700)
        };
        assert!(is_in(AUTHORIZATION, "Bearer 0123456789abcdef"));
        assert!(is_in(AUTHORIZATION, "bearer 0123456789abcdef"));
        assert!(is_in(COOKIE, "a=b; meniscus_token_7700=0123456789abcdef"));
        assert!(is_in(COOKIE, "meniscus_token_7701=x; meniscus_token_7700=0123456789abcdef"));
        assert!(!is_in(AUTHORIZATION, "0123456789abcdef"));
        assert!(!is_in(COOKIE, "xmeniscus_token_7700=0123456789abcdef"));
        assert!(!is_in(COOKIE, "meniscus_token_7701=0123456789abcdef"), "that is for another port");
        assert!(!token.is_in(&HeaderMap::new(), 7700));
        assert!(token.cookie(7700).starts_with("meniscus_token_7700=0123456789abcdef; "));
    }
}
