//! Serves output files by their names in the status store.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;
use std::time::UNIX_EPOCH;

use hyper::body::Bytes;
use hyper::header::{ACCEPT_RANGES, CONTENT_LENGTH, CONTENT_RANGE, HeaderName, IF_RANGE, RANGE};
use hyper::{Method, Request, StatusCode};
use tokio::sync::mpsc;
use tokio::task::spawn_blocking;

use crate::pipeline::open_itself;
use crate::watch::status_store::StatusStore;

use super::answer::{Answer, ResponseBody, answer, cached, not_found, not_modified, text, with};

/// Maximum size of a piece that is read at once, in bytes. Up to two pieces for each client are in memory.
const PIECE_BYTES: usize = 64 << 10;

/// An open file.
struct Opened {
    file: File,
    size_bytes: u64,
    /// The ETag: changes when the file does.
    tag: String,
}

/// The output with this name, or the requested range of it.
pub(super) async fn file<B>(store: &StatusStore, request: &Request<B>, name: &str) -> Answer {
    let Some(path) = store.file(name) else { return not_found() };
    let content_type = content_type(&path);
    let opened = match spawn_blocking(move || open(&path)).await {
        Ok(Ok(opened)) => opened,
        Ok(Err(error)) if error.kind() == io::ErrorKind::NotFound => return not_found(),
        _ => return text(StatusCode::INTERNAL_SERVER_ERROR, "cannot read the file"),
    };
    if let Some(answer) = not_modified(request, content_type, &opened.tag) {
        return answer;
    }
    let header = |name: HeaderName| request.headers().get(name).and_then(|value| value.to_str().ok());
    let is_same = header(IF_RANGE).is_none_or(|tag| tag == opened.tag);
    let range = header(RANGE).filter(|_| is_same).and_then(|range| parse_range(range, opened.size_bytes));
    match range {
        Some(Range::Beyond) => {
            let beyond =
                text(StatusCode::RANGE_NOT_SATISFIABLE, "the requested range is beyond the end of the file");
            with(beyond, CONTENT_RANGE, &format!("bytes */{}", opened.size_bytes))
        }
        Some(Range::Part { first, last }) => {
            let content_range = format!("bytes {first}-{last}/{}", opened.size_bytes);
            let part =
                part(request, opened, (first, last + 1 - first), StatusCode::PARTIAL_CONTENT, content_type);
            with(part, CONTENT_RANGE, &content_range)
        }
        None => {
            let size_bytes = opened.size_bytes;
            part(request, opened, (0, size_bytes), StatusCode::OK, content_type)
        }
    }
}

/// Opens a path from the status store if it is a regular file.
fn open(path: &Path) -> io::Result<Opened> {
    // Links are not followed: an output that was replaced by a link must not expose the link's target.
    let file = open_itself(path, File::options().read(true)).map_err(|error| match error.kind() {
        io::ErrorKind::InvalidInput | io::ErrorKind::IsADirectory => io::ErrorKind::NotFound.into(),
        _ => error,
    })?;
    // The metadata of the open file: another file may be at the path by now.
    let metadata = file.metadata()?;
    let since = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    let tag = format!("\"{}-{}\"", metadata.len(), since.unwrap_or_default().as_nanos());
    Ok(Opened { file, size_bytes: metadata.len(), tag })
}

fn part<B>(
    request: &Request<B>,
    opened: Opened,
    (first, count): (u64, u64),
    status: StatusCode,
    content_type: &'static str,
) -> Answer {
    let (sender, chunks) = mpsc::channel(1);
    let content = match *request.method() == Method::HEAD {
        true => ResponseBody::none(),
        false => ResponseBody::chunks(chunks, Some(count)),
    };
    let part = cached(answer(status, content_type, content), &opened.tag);
    if request.method() == Method::GET {
        tokio::spawn(send(opened.file, first, count, sender));
    }
    with(with(part, ACCEPT_RANGES, "bytes"), CONTENT_LENGTH, &count.to_string())
}

/// Sends `count` bytes of a file, as fast as the client reads them.
async fn send(mut file: File, first: u64, count: u64, sender: mpsc::Sender<io::Result<Bytes>>) {
    if let Err(error) = file.seek(SeekFrom::Start(first)) {
        let _ = sender.send(Err(error)).await;
        return;
    }
    let mut left_bytes = count;
    while left_bytes > 0 {
        let wanted_bytes = left_bytes.min(PIECE_BYTES as u64);
        let read = spawn_blocking(move || {
            let mut piece = Vec::with_capacity(PIECE_BYTES);
            let read = (&file).take(wanted_bytes).read_to_end(&mut piece).map(|_| piece);
            (file, read)
        });
        let Ok((same, read)) = read.await else { return };
        file = same;
        let piece = match read {
            // The file is now shorter than the announced length: the connection ends.
            Ok(piece) if piece.is_empty() => Err(io::ErrorKind::UnexpectedEof.into()),
            other => other,
        };
        left_bytes -= piece.as_ref().map_or(left_bytes, |piece| piece.len() as u64);
        if sender.send(piece.map(Bytes::from)).await.is_err() {
            return;
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Range {
    /// These bytes, including `last`.
    Part { first: u64, last: u64 },
    /// The range starts beyond the end of the file.
    Beyond,
}

/// Parses a `Range` header. If it is not a single range of bytes, returns `None`, and the whole file is sent.
fn parse_range(text: &str, size_bytes: u64) -> Option<Range> {
    let (first, last) = text.strip_prefix("bytes=")?.split_once('-')?;
    let (first, last) = match (first, last) {
        ("", count) => (size_bytes.saturating_sub(count.parse().ok()?), u64::MAX),
        (first, "") => (first.parse().ok()?, u64::MAX),
        (first, last) => (first.parse().ok()?, last.parse().ok()?),
    };
    if last < first {
        return None;
    }
    let last = last.min(size_bytes.saturating_sub(1));
    Some(if first < size_bytes { Range::Part { first, last } } else { Range::Beyond })
}

fn content_type(path: &Path) -> &'static str {
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
        let part = |first, last| Some(Range::Part { first, last });
        for (text, expected) in [
            ("bytes=0-0", part(0, 0)),
            ("bytes=5-", part(5, 9)),
            ("bytes=5-100", part(5, 9)),
            ("bytes=-3", part(7, 9)),
            ("bytes=-300", part(0, 9)),
            ("bytes=10-", Some(Range::Beyond)),
            ("bytes=-0", Some(Range::Beyond)),
            ("bytes=5-4", None),
            ("bytes=0-1,3-4", None),
            ("bytes=a-", None),
            ("lines=0-1", None),
            ("bytes=99999999999999999999-", None),
        ] {
            assert_eq!(parse_range(text, 10), expected, "{text}");
        }
        assert_eq!(parse_range("bytes=0-", 0), Some(Range::Beyond));
    }
}
