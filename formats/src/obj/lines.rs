//! Extracts the lines of an OBJ file that define a mesh, and normalises them.
//!
//! This adapter sits between the file and the tobj crate, which parses the result:
//!
//! ```text
//!   in the file               for the parser
//!   v 1 2 3 0.5 0.5 0.5       v 1 2 3              vertex colours are dropped
//!   vt 0 1                                         dropped, as are materials, objects, groups, comments
//!   f 1/1/1 2/2/2 \           f 1//1 2//2 3//3     a continued line is joined
//!   3/3/3
//! ```
//!
//! This module checks indices, because relative indices can only be resolved at their line, and so that an
//! error can name the line. It ignores text that is not valid UTF-8, which old programs write into names.

use crate::excerpt::excerpt;
use std::io::{self, BufRead, Read};

/// The normalised lines, as the parser sees them.
pub(super) struct MeshLines<'a> {
    rest: &'a [u8],
    /// The current line.
    line: Vec<u8>,
    /// Number of bytes of the current line that the parser has consumed.
    read: usize,
    line_number: u64,
    vertex_count: u64,
    normal_count: u64,
    /// Forward references, to vertices and to normals: the line and the index of each reference whose index
    /// is larger than all before. They include the first reference that exceeds the final count.
    awaited: [Vec<(u64, u64)>; 2],
    is_at_end: bool,
    /// The error in the current line.
    error: Option<String>,
}

impl<'a> MeshLines<'a> {
    pub(super) fn new(text: &'a [u8]) -> MeshLines<'a> {
        MeshLines {
            rest: text,
            line: Vec::new(),
            read: 0,
            line_number: 0,
            vertex_count: 0,
            normal_count: 0,
            awaited: [Vec::new(), Vec::new()],
            is_at_end: false,
            error: None,
        }
    }

    /// The line number of an error, starting at 1, and its message if this module found the error. The line
    /// is the last line read or, at the end of the file, the first with an unresolved forward reference.
    pub(super) fn position(&mut self) -> (u64, Option<String>) {
        if !self.is_at_end {
            return (self.line_number, self.error.take());
        }
        let [vertices, normals] = &self.awaited;
        let first = |awaited: &[(u64, u64)], count: u64, kind: &'static str| {
            let beyond = awaited.iter().find(|(_, number)| *number > count);
            beyond.map(|(line, number)| {
                (*line, format!("a face has {kind} {number}, but the file has {count}"))
            })
        };
        let vertex = first(vertices, self.vertex_count, "vertex");
        let normal = first(normals, self.normal_count, "normal");
        let missing = vertex.into_iter().chain(normal).min_by_key(|(line, _)| *line);
        missing.map_or((self.line_number, None), |(line, what)| (line, Some(what)))
    }

    /// Prepares the next line; false at the end.
    fn advance(&mut self) -> io::Result<bool> {
        self.read = 0;
        self.line.clear();
        if self.rest.is_empty() {
            self.is_at_end = true;
            return Ok(false);
        }
        self.line_number += 1;
        let text = self.take_line();
        if let Err(what) = self.prepare(&text) {
            self.error = Some(what);
            return Err(io::ErrorKind::InvalidData.into());
        }
        self.line.push(b'\n');
        Ok(true)
    }

    /// Takes the next line, including its continuation lines.
    fn take_line(&mut self) -> Vec<u8> {
        let mut text = Vec::new();
        loop {
            let end = self.rest.iter().position(|&byte| byte == b'\n');
            let (line, rest) = self.rest.split_at(end.map_or(self.rest.len(), |end| end + 1));
            self.rest = rest;
            let line = line.trim_ascii();
            match line.strip_suffix(b"\\") {
                Some(start) if !rest.is_empty() => {
                    text.extend_from_slice(start);
                    text.push(b' ');
                    self.line_number += 1;
                }
                _ => {
                    text.extend_from_slice(line);
                    return text;
                }
            }
        }
    }

    fn prepare(&mut self, text: &[u8]) -> Result<(), String> {
        let mut words = text.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let keyword = words.next().unwrap_or_default();
        match keyword {
            b"v" => {
                self.vertex_count += 1;
                self.numbers("v", words)
            }
            b"vn" => {
                self.normal_count += 1;
                self.numbers("vn", words)
            }
            b"f" => {
                self.line.push(b'f');
                words.try_for_each(|corner| self.corner(corner))
            }
            _ => Ok(()),
        }
    }

    /// Appends the three numbers of a position or normal. Drops a weight or a colour after them.
    fn numbers<'t>(&mut self, keyword: &str, words: impl Iterator<Item = &'t [u8]>) -> Result<(), String> {
        self.line.extend_from_slice(keyword.as_bytes());
        for word in words.take(3) {
            if !word.is_ascii() {
                return Err(format!("`{}` is not a number", excerpt(word)));
            }
            self.line.push(b' ');
            self.line.extend_from_slice(word);
        }
        Ok(())
    }

    /// Appends the corner of a face: its vertex and, if present, its normal.
    fn corner(&mut self, corner: &[u8]) -> Result<(), String> {
        let mut parts = corner.split(|&byte| byte == b'/');
        let vertex = index(parts.next().unwrap_or_default(), self.vertex_count, corner)?;
        await_element(&mut self.awaited[0], self.line_number, vertex, self.vertex_count);
        self.line.push(b' ');
        self.line.extend_from_slice(vertex.to_string().as_bytes());
        let normal = parts.nth(1).filter(|normal| !normal.is_empty());
        if let Some(normal) = normal {
            let normal = index(normal, self.normal_count, corner)?;
            await_element(&mut self.awaited[1], self.line_number, normal, self.normal_count);
            self.line.extend_from_slice(format!("//{normal}").as_bytes());
        }
        Ok(())
    }
}

/// Records a forward reference if it is larger than all recorded ones.
fn await_element(awaited: &mut Vec<(u64, u64)>, line: u64, number: u64, count: u64) {
    if number > count && awaited.last().is_none_or(|(_, most)| number > *most) {
        awaited.push((line, number));
    }
}

/// Converts an index to one that counts from 1. A negative index counts backwards from the last element
/// before the line. Only the end of the file shows whether the element exists: see [`MeshLines::position`].
fn index(text: &[u8], count: u64, corner: &[u8]) -> Result<u64, String> {
    let wrong = || format!("a face has an invalid corner `{}`", excerpt(corner));
    let number: i64 = std::str::from_utf8(text).ok().and_then(|text| text.parse().ok()).ok_or_else(wrong)?;
    let index = match number {
        ..0 => count.checked_sub(number.unsigned_abs()).map(|before| before + 1),
        _ => u64::try_from(number).ok(),
    };
    index.filter(|index| (1..=u64::from(u32::MAX)).contains(index)).ok_or_else(wrong)
}

impl Read for MeshLines<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let mut line = self.fill_buf()?;
        let count = line.read(out)?;
        self.consume(count);
        Ok(count)
    }
}

impl BufRead for MeshLines<'_> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        if self.read == self.line.len() {
            self.advance()?;
        }
        Ok(&self.line[self.read..])
    }

    fn consume(&mut self, count: usize) {
        self.read = (self.read + count).min(self.line.len());
    }
}
