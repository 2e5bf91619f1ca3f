//! Buffers in external files next to the document.
//!
//! ```text
//!   scene.gltf    "uri":"parts/a%20b.bin", "byteLength":96   ──▶   parts/a b.bin, its first 96 bytes
//!   parts/
//!     a b.bin
//! ```
//!
//! Paths in a document are not trusted: they must lie in the document's folder or below it.

use std::collections::BTreeMap;
use std::rc::Rc;

use serde::Deserialize;

use super::FORMAT;
use super::buffer::invalid;
use super::chunks::{chunks, parse};
use crate::error::{Error, Result};
use crate::row::ReadExternal;

/// An external file with buffers of a document.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExternalFile {
    /// Its path relative to the document's folder: names separated by `/`, without `..`.
    pub path: String,
    /// Number of bytes to read from its start.
    pub byte_count: u64,
}

/// The external files of a document, each once, in the order of their first use.
///
/// # Errors
/// [`Error::Invalid`] if the file is not glTF; [`Error::Unsupported`] for a buffer outside the document's
/// folder.
pub fn external_files(bytes: &[u8]) -> Result<Vec<ExternalFile>> {
    #[derive(Deserialize)]
    struct Document {
        #[serde(default)]
        buffers: Vec<Buffer>,
    }
    #[derive(Deserialize)]
    struct Buffer {
        uri: Option<String>,
        #[serde(rename = "byteLength")]
        byte_count: u64,
    }
    let document: Document = parse(chunks(bytes)?.0)?;
    let mut files: Vec<ExternalFile> = Vec::new();
    let mut index_of: BTreeMap<String, usize> = BTreeMap::new();
    for Buffer { uri, byte_count } in document.buffers {
        let Some(uri) = uri.filter(|uri| !is_data(uri)) else { continue };
        let path = path_of(&uri)?;
        let index = *index_of.entry(path.clone()).or_insert(files.len());
        match files.get_mut(index) {
            Some(file) => file.byte_count = file.byte_count.max(byte_count),
            None => files.push(ExternalFile { path, byte_count }),
        }
    }
    Ok(files)
}

/// Whether a URI contains the data itself.
pub(super) fn is_data(uri: &str) -> bool {
    uri.starts_with("data:")
}

/// Reads external files, each only once even if it has several buffers.
pub(super) struct ExternalReader<'a> {
    read_external: Option<&'a ReadExternal<'a>>,
    read: BTreeMap<String, Rc<Vec<u8>>>,
    /// Total size in bytes of the files read so far.
    pub(super) size_bytes: u64,
}

impl<'a> ExternalReader<'a> {
    pub(super) fn new(read_external: Option<&'a ReadExternal<'a>>) -> ExternalReader<'a> {
        ExternalReader { read_external, read: BTreeMap::new(), size_bytes: 0 }
    }

    /// The content of the file at a URI.
    pub(super) fn bytes(&mut self, uri: &str) -> Result<Rc<Vec<u8>>> {
        let Some(read_external) = self.read_external else {
            let what = "a buffer is in a separate file: export as .glb, or embed the buffer";
            return Err(Error::unsupported(FORMAT, what));
        };
        let path = path_of(uri)?;
        if let Some(bytes) = self.read.get(&path) {
            return Ok(Rc::clone(bytes));
        }
        let read = read_external(&path);
        let bytes = read.map_err(|error| {
            std::io::Error::new(error.kind(), format!("cannot read the buffer {path}: {error}"))
        })?;
        let bytes = Rc::new(bytes);
        self.size_bytes = self.size_bytes.saturating_add(bytes.len() as u64);
        self.read.insert(path, Rc::clone(&bytes));
        Ok(bytes)
    }
}

/// Converts a URI to a relative path.
fn path_of(uri: &str) -> Result<String> {
    let path = percent_decoded(uri).ok_or_else(|| invalid(format!("the URI {uri} is invalid")))?;
    // Some exporters write paths with the separators of their system.
    let is_absolute = path.starts_with(['/', '\\']);
    let names: Vec<&str> = path.split(['/', '\\']).filter(|name| !name.is_empty() && *name != ".").collect();
    if is_absolute || path.contains([':', '\0']) || names.contains(&"..") || names.is_empty() {
        let what = format!("the buffer {uri} is outside the folder of the file");
        return Err(Error::unsupported(FORMAT, what));
    }
    Ok(names.join("/"))
}

/// Decodes the percent escapes of a URI.
fn percent_decoded(uri: &str) -> Option<String> {
    let mut parts = uri.split('%');
    let mut bytes = parts.next()?.as_bytes().to_vec();
    for part in parts {
        let (code, rest) = part.split_at_checked(2)?;
        bytes.push(u8::from_str_radix(code, 16).ok()?);
        bytes.extend_from_slice(rest.as_bytes());
    }
    String::from_utf8(bytes).ok()
}
