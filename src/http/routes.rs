//! Checks a request, and dispatches it by its path.

use std::net::SocketAddr;
use std::sync::Arc;

use hyper::body::Body;
use hyper::header::{CONNECTION, LOCATION, SET_COOKIE, WWW_AUTHENTICATE};
use hyper::{Method, Request, StatusCode};

use super::ServerState;
use super::access::is_for_this_host;
use super::answer::{Answer, method_not_allowed, not_found, text, with};
use super::query::{decoded, value_of};
use super::{api, assets, events, files, metrics};

/// Answers a request that came in at the address `local`.
pub(super) async fn answer_to<B: Body>(
    shared: &Arc<ServerState>,
    request: &Request<B>,
    local: SocketAddr,
) -> Answer {
    match refusal(shared, request, local) {
        Some(refusal) => refusal,
        None => route(shared, request).await,
    }
}

/// Answers a request while few slots are free: refuses all requests except health checks. The connection
/// closes afterwards.
pub(super) async fn answer_when_busy<B: Body>(
    shared: &Arc<ServerState>,
    request: &Request<B>,
    local: SocketAddr,
) -> Answer {
    closing(match is_about_health(request) {
        true => answer_to(shared, request, local).await,
        false => text(StatusCode::SERVICE_UNAVAILABLE, "too many connections"),
    })
}

fn is_about_health<B>(request: &Request<B>) -> bool {
    matches!(request.uri().path(), "/healthz" | "/readyz")
}

/// The response to a request that is not dispatched: an error, or the redirect after a login with
/// `/?token=…`. `None` if the request is allowed.
fn refusal<B: Body>(shared: &ServerState, request: &Request<B>, local: SocketAddr) -> Option<Answer> {
    if !is_for_this_host(request, local.ip()) {
        return Some(closing(text(
            StatusCode::MISDIRECTED_REQUEST,
            "unknown host name: open this page by the IP address of this machine, or as localhost",
        )));
    }
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        return Some(closing(method_not_allowed()));
    }
    if !request.body().is_end_stream() {
        return Some(closing(text(StatusCode::PAYLOAD_TOO_LARGE, "requests must not have a body")));
    }
    let token = shared.token.as_ref()?;
    // Health checks need no token: they reveal only whether the daemon runs.
    if is_about_health(request) || token.is_in(request, local.port()) {
        return None;
    }
    let typed = value_of(request.uri().query(), "token").filter(|_| request.uri().path() == "/");
    match typed {
        Some(typed) if token.is(&typed) => Some(with_cookie(&token.cookie(local.port()))),
        _ => Some(unauthorized()),
    }
}

/// Dispatches the request by its path.
async fn route<B>(shared: &Arc<ServerState>, request: &Request<B>) -> Answer {
    let (path, query) = (request.uri().path(), request.uri().query());
    let store = &shared.store;
    match path {
        "/api/frames" => api::frames(store, query),
        "/api/settings" => api::settings(store),
        "/api/status" => api::status(store),
        "/events" => events::follow(shared, request),
        "/metrics" => metrics::metrics(store),
        "/healthz" => api::health(store),
        "/readyz" => api::readiness(store),
        _ => {
            let name_after = |prefix| path.strip_prefix(prefix).map(decoded);
            match (name_after("/api/frames/"), name_after("/files/")) {
                (Some(name), _) => name.map_or_else(not_found, |name| api::frame(store, &name)),
                (_, Some(Some(name))) => files::file(store, request, &name).await,
                (_, Some(None)) => not_found(),
                (None, None) => assets::asset(request),
            }
        }
    }
}

/// Closes the connection after this response, because anything else that the client sends on it would be
/// ignored.
fn closing(answer: Answer) -> Answer {
    with(answer, CONNECTION, "close")
}

fn unauthorized() -> Answer {
    let what = "a token is required: open /?token=TOKEN, or send it as an Authorization: Bearer header";
    with(text(StatusCode::UNAUTHORIZED, what), WWW_AUTHENTICATE, "Bearer")
}

/// Stores the token as a cookie, and redirects to an address without the token.
fn with_cookie(cookie: &str) -> Answer {
    with(with(text(StatusCode::SEE_OTHER, ""), LOCATION, "/"), SET_COOKIE, cookie)
}
