//! The headers of all responses, and their bodies: complete, or in chunks as the client reads them.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use hyper::body::{Body, Bytes, Frame, SizeHint};
use hyper::header::{
    ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG, HeaderName, HeaderValue,
    IF_NONE_MATCH, REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use hyper::{Request, Response, StatusCode};
use serde::Serialize;
use tokio::sync::mpsc;

use super::connections::Answering;

/// A response.
pub(super) type Answer = Response<ResponseBody>;

/// The body of a response.
#[derive(Debug)]
pub(super) struct ResponseBody {
    source: BodySource,
    /// Keeps the connection busy until the body is dropped.
    _answering: Option<Answering>,
}

#[derive(Debug)]
enum BodySource {
    /// The full body; `None` if it is empty, or once it is sent.
    Full(Option<Bytes>),
    /// Chunks from a task, which waits while the client does not read; and the number of bytes left, if
    /// known.
    Chunks(mpsc::Receiver<io::Result<Bytes>>, Option<u64>),
}

impl ResponseBody {
    pub(super) fn none() -> ResponseBody {
        ResponseBody { source: BodySource::Full(None), _answering: None }
    }

    pub(super) fn full(bytes: impl Into<Bytes>) -> ResponseBody {
        ResponseBody { source: BodySource::Full(Some(bytes.into())), _answering: None }
    }

    /// A body in chunks, of this total size if it is known.
    pub(super) fn chunks(chunks: mpsc::Receiver<io::Result<Bytes>>, size_bytes: Option<u64>) -> ResponseBody {
        ResponseBody { source: BodySource::Chunks(chunks, size_bytes), _answering: None }
    }

    /// The same body; the connection counts as busy until the body is dropped.
    pub(super) fn during(self, answering: Answering) -> ResponseBody {
        ResponseBody { _answering: Some(answering), ..self }
    }
}

impl Body for ResponseBody {
    type Data = Bytes;
    type Error = io::Error;

    fn poll_frame(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<io::Result<Frame<Bytes>>>> {
        match &mut self.get_mut().source {
            BodySource::Full(bytes) => Poll::Ready(bytes.take().map(|bytes| Ok(Frame::data(bytes)))),
            BodySource::Chunks(chunks, left_bytes) => {
                let Some(chunk) = ready!(chunks.poll_recv(context)) else { return Poll::Ready(None) };
                if let (Ok(chunk), Some(left_bytes)) = (&chunk, left_bytes) {
                    *left_bytes = left_bytes.saturating_sub(chunk.len() as u64);
                }
                Poll::Ready(Some(chunk.map(Frame::data)))
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        match &self.source {
            BodySource::Full(bytes) => bytes.as_ref().is_none_or(Bytes::is_empty),
            BodySource::Chunks(_, left_bytes) => *left_bytes == Some(0),
        }
    }

    fn size_hint(&self) -> SizeHint {
        match &self.source {
            BodySource::Full(bytes) => SizeHint::with_exact(bytes.as_ref().map_or(0, Bytes::len) as u64),
            BodySource::Chunks(_, Some(left_bytes)) => SizeHint::with_exact(*left_bytes),
            BodySource::Chunks(_, None) => SizeHint::new(),
        }
    }
}

/// The page may load content only from this server, and no other page may embed it.
const POLICY: &str = "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; \
                      form-action 'none'; frame-ancestors 'none'";

const OPENER: HeaderName = HeaderName::from_static("cross-origin-opener-policy");
const RESOURCE: HeaderName = HeaderName::from_static("cross-origin-resource-policy");

/// A response with this content type, whose headers forbid caching; [`cached`] allows it.
pub(super) fn answer(status: StatusCode, content_type: &'static str, content: ResponseBody) -> Answer {
    let mut answer = Response::new(content);
    *answer.status_mut() = status;
    let headers = answer.headers_mut();
    for (name, value) in [
        (CONTENT_TYPE, content_type),
        (CACHE_CONTROL, "no-store"),
        (CONTENT_SECURITY_POLICY, POLICY),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (X_FRAME_OPTIONS, "DENY"),
        (REFERRER_POLICY, "no-referrer"),
        (OPENER, "same-origin"),
        (RESOURCE, "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    answer
}

/// A response with a line of plain text.
pub(super) fn text(status: StatusCode, line: &str) -> Answer {
    answer(status, "text/plain; charset=utf-8", ResponseBody::full(format!("{line}\n")))
}

/// A response with this value as JSON.
pub(super) fn json(value: &impl Serialize) -> Answer {
    match serde_json::to_vec(value) {
        Ok(bytes) => answer(StatusCode::OK, "application/json", ResponseBody::full(bytes)),
        Err(error) => text(StatusCode::INTERNAL_SERVER_ERROR, &error.to_string()),
    }
}

/// 404: there is no such resource.
pub(super) fn not_found() -> Answer {
    text(StatusCode::NOT_FOUND, "not found")
}

/// 405: the method is neither GET nor HEAD.
pub(super) fn method_not_allowed() -> Answer {
    with(text(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD are allowed"), ALLOW, "GET, HEAD")
}

/// Adds a header to the response; leaves it unchanged if the value is not a valid header value.
pub(super) fn with(mut answer: Answer, name: HeaderName, value: &str) -> Answer {
    if let Ok(value) = HeaderValue::from_str(value) {
        answer.headers_mut().insert(name, value);
    }
    answer
}

/// Lets a browser cache this response, and revalidate it with the tag on each use.
pub(super) fn cached(answer: Answer, tag: &str) -> Answer {
    with(with(answer, CACHE_CONTROL, "private, no-cache"), ETAG, tag)
}

/// 304, if the browser already has the version with this tag; otherwise `None`.
pub(super) fn not_modified<B>(request: &Request<B>, content_type: &'static str, tag: &str) -> Option<Answer> {
    let known = request.headers().get(IF_NONE_MATCH)?;
    let answer = || answer(StatusCode::NOT_MODIFIED, content_type, ResponseBody::none());
    (known.as_bytes() == tag.as_bytes()).then(|| cached(answer(), tag))
}
