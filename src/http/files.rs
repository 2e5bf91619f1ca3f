//! Serves output files by their names in the status store, and the files of the status page, which are
//! compiled into the program.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path;
use std::time::UNIX_EPOCH;

use axum::body::{Body, Bytes};
use axum::extract::{Path, State};
use axum::http::header::{
    ACCEPT_RANGES, CACHE_CONTROL, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG, HeaderName,
    IF_NONE_MATCH, IF_RANGE, RANGE,
};
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{Stream, try_unfold};
use tokio::task::spawn_blocking;
use tokio::time::timeout;
use twox_hash::XxHash3_64;

use crate::pipeline::open_itself;

use super::{OPEN_TIMEOUT, Shared, not_found};

/// Maximum size of a piece that is read at once, in bytes. Up to two pieces for each client are in memory.
const PIECE_BYTES: u64 = 64 << 10;

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const TEXT: &str = "text/plain; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

/// The path of each file of the page, its content type, and its content.
const ASSETS: [(&str, &str, &[u8]); 12] = [
    ("/", HTML, include_bytes!("page/index.html")),
    ("/page.css", CSS, include_bytes!("page/page.css")),
    ("/page.js", SCRIPT, include_bytes!("page/page.js")),
    ("/order.js", SCRIPT, include_bytes!("page/order.js")),
    ("/scene.js", SCRIPT, include_bytes!("page/scene.js")),
    ("/vendor/three.module.min.js", SCRIPT, include_bytes!("page/vendor/three.module.min.js")),
    ("/vendor/three.core.min.js", SCRIPT, include_bytes!("page/vendor/three.core.min.js")),
    ("/vendor/GLTFLoader.js", SCRIPT, include_bytes!("page/vendor/GLTFLoader.js")),
    ("/vendor/OrbitControls.js", SCRIPT, include_bytes!("page/vendor/OrbitControls.js")),
    ("/vendor/BufferGeometryUtils.js", SCRIPT, include_bytes!("page/vendor/BufferGeometryUtils.js")),
    ("/vendor/SkeletonUtils.js", SCRIPT, include_bytes!("page/vendor/SkeletonUtils.js")),
    ("/vendor/LICENSE", TEXT, include_bytes!("page/vendor/LICENSE")),
];

/// The file of the page at this path.
pub(super) async fn asset(uri: Uri, request: HeaderMap) -> Response {
    let Some(&(_, content_type, bytes)) = ASSETS.iter().find(|(path, ..)| *path == uri.path()) else {
        return not_found();
    };
    let tag = format!("\"{:016x}\"", XxHash3_64::oneshot(bytes));
    if is_known(&request, &tag) {
        return (StatusCode::NOT_MODIFIED, kept(&tag)).into_response();
    }
    (kept(&tag), [(CONTENT_TYPE, content_type)], bytes).into_response()
}

/// The output with this name, or the requested range of it.
pub(super) async fn output(State(state): Shared, Path(name): Path<String>, request: HeaderMap) -> Response {
    let Some(path) = state.store.file(&name) else { return not_found() };
    let content_type = content_type(&path);
    let opened = timeout(OPEN_TIMEOUT, spawn_blocking(move || open(&path))).await;
    let (file, size_bytes, tag) = match opened {
        Ok(Ok(Ok(opened))) => opened,
        Ok(Ok(Err(error))) if error.kind() == io::ErrorKind::NotFound => return not_found(),
        _ => return (StatusCode::INTERNAL_SERVER_ERROR, "cannot read the file\n").into_response(),
    };
    if is_known(&request, &tag) {
        return (StatusCode::NOT_MODIFIED, kept(&tag)).into_response();
    }
    let header = |name: HeaderName| request.get(name).and_then(|value| value.to_str().ok());
    let is_same = header(IF_RANGE).is_none_or(|known| known == tag);
    let range = header(RANGE).filter(|_| is_same).and_then(|range| parse_range(range, size_bytes));
    if range.as_ref().is_some_and(Range::is_empty) {
        let what = "the requested range is beyond the end of the file\n";
        let size = [(CONTENT_RANGE, format!("bytes */{size_bytes}"))];
        return (StatusCode::RANGE_NOT_SATISFIABLE, size, what).into_response();
    }
    let status = range.as_ref().map_or(StatusCode::OK, |_| StatusCode::PARTIAL_CONTENT);
    let part = range
        .as_ref()
        .map(|Range { start, end }| [(CONTENT_RANGE, format!("bytes {start}-{}/{size_bytes}", end - 1))]);
    let range = range.unwrap_or(0..size_bytes);
    let length = [(CONTENT_LENGTH, (range.end - range.start).to_string())];
    let kind = [(CONTENT_TYPE, content_type), (ACCEPT_RANGES, "bytes")];
    (status, kept(&tag), kind, length, part, Body::from_stream(pieces(file, range))).into_response()
}

/// Whether the browser already has the version with this tag.
fn is_known(request: &HeaderMap, tag: &str) -> bool {
    request.get(IF_NONE_MATCH).is_some_and(|known| known.as_bytes() == tag.as_bytes())
}

/// Lets a browser keep this content, and revalidate it with the tag on each use.
fn kept(tag: &str) -> [(HeaderName, &str); 2] {
    [(CACHE_CONTROL, "private, no-cache"), (ETAG, tag)]
}

/// Opens a path from the status store if it is a regular file; returns its size, and a tag that changes when
/// the file does.
fn open(path: &path::Path) -> io::Result<(File, u64, String)> {
    // Links are not followed: an output that was replaced by a link must not expose the link's target.
    let file = open_itself(path, File::options().read(true)).map_err(|error| match error.kind() {
        io::ErrorKind::InvalidInput | io::ErrorKind::IsADirectory => io::ErrorKind::NotFound.into(),
        _ => error,
    })?;
    // The metadata of the open file: another file may be at the path by now.
    let metadata = file.metadata()?;
    let since = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    let tag = format!("\"{}-{}\"", metadata.len(), since.unwrap_or_default().as_nanos());
    Ok((file, metadata.len(), tag))
}

/// The bytes of this range of a file, read as fast as the client reads them.
fn pieces(file: File, range: Range<u64>) -> impl Stream<Item = io::Result<Bytes>> {
    try_unfold((file, range), |(mut file, Range { start, end })| async move {
        if start == end {
            return Ok(None);
        }
        let read = spawn_blocking(move || {
            file.seek(SeekFrom::Start(start))?;
            let mut piece = Vec::with_capacity(PIECE_BYTES as usize);
            (&file).take(PIECE_BYTES.min(end - start)).read_to_end(&mut piece)?;
            if piece.is_empty() {
                // The file is now shorter than the announced length: the connection ends.
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            let rest = start + piece.len() as u64..end;
            Ok(Some((Bytes::from(piece), (file, rest))))
        });
        read.await?
    })
}

/// The bytes that a `Range` header asks for: none if they are beyond the end of the file. If it is not a single
/// range of bytes, returns `None`, and the whole file is sent.
fn parse_range(text: &str, size_bytes: u64) -> Option<Range<u64>> {
    let (first, last) = text.strip_prefix("bytes=")?.split_once('-')?;
    let (first, last) = match (first, last) {
        ("", count) => (size_bytes.saturating_sub(count.parse().ok()?), u64::MAX),
        (first, "") => (first.parse().ok()?, u64::MAX),
        (first, last) => (first.parse().ok()?, last.parse().ok()?),
    };
    (first <= last).then(|| first..last.saturating_add(1).min(size_bytes))
}

fn content_type(path: &path::Path) -> &'static str {
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("glb") => "model/gltf-binary",
        Some("gltf") => "model/gltf+json",
        Some("png") => "image/png",
        Some("obj") => "model/obj",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn range_is_clipped_to_the_file() {
        for (text, expected) in [
            ("bytes=0-0", Some(0..1)),
            ("bytes=5-", Some(5..10)),
            ("bytes=5-100", Some(5..10)),
            ("bytes=-3", Some(7..10)),
            ("bytes=-300", Some(0..10)),
            ("bytes=10-", Some(10..10)),
            ("bytes=-0", Some(10..10)),
            ("bytes=5-4", None),
            ("bytes=0-1,3-4", None),
            ("bytes=a-", None),
            ("lines=0-1", None),
            ("bytes=99999999999999999999-", None),
        ] {
            assert_eq!(parse_range(text, 10), expected, "{text}");
        }
        assert_eq!(parse_range("bytes=0-", 0), Some(0..0));
    }
}
