//! Buffers in files of their own, beside the document.
//!
//! ```text
//!   scene.gltf    "uri":"parts/a%20b.bin", "byteLength":96   ──▶   parts/a b.bin, 96 bytes of it
//!   parts/
//!     a b.bin
//! ```
//!
//! A document is not trusted with paths: what it names lies in its own folder, or below.

use std::collections::BTreeMap;
use std::rc::Rc;

use serde::Deserialize;

use super::FORMAT;
use super::buffer::invalid;
use super::read::{chunks, parse};
use crate::error::{Error, Result};
use crate::row::Beside;

/// A file that has buffers of a document.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FileBeside {
    /// Where it is, from the folder of the document on: names with `/` between them, and no `..`.
    pub path: String,
    /// How many of its first bytes are read.
    pub byte_count: u64,
}

/// The files beside a document that have buffers of it, each once, in the order in which they are named.
///
/// # Errors
/// [`Error::Invalid`] if this is no glTF; [`Error::Unsupported`] for a buffer that is not beside the document.
pub fn files_beside(bytes: &[u8]) -> Result<Vec<FileBeside>> {
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
    let mut files: Vec<FileBeside> = Vec::new();
    let mut index_of: BTreeMap<String, usize> = BTreeMap::new();
    for Buffer { uri, byte_count } in document.buffers {
        let Some(uri) = uri.filter(|uri| !is_data(uri)) else { continue };
        let path = path_of(&uri)?;
        let index = *index_of.entry(path.clone()).or_insert(files.len());
        match files.get_mut(index) {
            Some(file) => file.byte_count = file.byte_count.max(byte_count),
            None => files.push(FileBeside { path, byte_count }),
        }
    }
    Ok(files)
}

/// Whether a URI is the data itself.
pub(super) fn is_data(uri: &str) -> bool {
    uri.starts_with("data:")
}

/// What is read of files beside: each once, however many buffers are in it.
pub(super) struct ReadBeside<'a> {
    beside: Option<&'a Beside<'a>>,
    read: BTreeMap<String, Rc<Vec<u8>>>,
    /// Their bytes.
    pub(super) size_bytes: u64,
}

impl<'a> ReadBeside<'a> {
    pub(super) fn new(beside: Option<&'a Beside<'a>>) -> ReadBeside<'a> {
        ReadBeside { beside, read: BTreeMap::new(), size_bytes: 0 }
    }

    /// The bytes of the file at a URI.
    pub(super) fn bytes(&mut self, uri: &str) -> Result<Rc<Vec<u8>>> {
        let Some(beside) = self.beside else {
            let what = "a buffer in a file of its own; export as .glb, or embed it";
            return Err(Error::unsupported(FORMAT, what));
        };
        let path = path_of(uri)?;
        if let Some(bytes) = self.read.get(&path) {
            return Ok(Rc::clone(bytes));
        }
        let read = beside(&path);
        let bytes =
            read.map_err(|error| std::io::Error::new(error.kind(), format!("its buffer {path}: {error}")))?;
        let bytes = Rc::new(bytes);
        self.size_bytes = self.size_bytes.saturating_add(bytes.len() as u64);
        self.read.insert(path, Rc::clone(&bytes));
        Ok(bytes)
    }
}

/// The relative path that a URI is.
fn path_of(uri: &str) -> Result<String> {
    let path = percent_decoded(uri).ok_or_else(|| invalid(format!("the URI {uri}")))?;
    // Some exporters write paths as their system has them.
    let is_absolute = path.starts_with(['/', '\\']);
    let names: Vec<&str> = path.split(['/', '\\']).filter(|name| !name.is_empty() && *name != ".").collect();
    if is_absolute || path.contains([':', '\0']) || names.contains(&"..") || names.is_empty() {
        let what = format!("a buffer that is not beside the file, but at {uri}");
        return Err(Error::unsupported(FORMAT, what));
    }
    Ok(names.join("/"))
}

/// A path as it was before it became part of a URI.
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
