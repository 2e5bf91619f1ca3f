//! Recognises VTK files that have no particles, from a few of their bytes.
//!
//! The legacy format has its cells after the points, so the points are skipped. In a text they must be read,
//! up to a limit.

use crate::neighbor::Neighbor;
use crate::records::ReadAt;

use super::cells::is_face;
use super::legacy::size_of_type;

/// How much of a file is read. If there are no faces in it, the file is taken for particles.
const READ_BYTES_MAX: u64 = 16 << 20;

/// The number of cells whose types are examined.
const TYPES_MAX: u64 = 1 << 10;

/// The number of bytes that are read at once.
const WINDOW_BYTES: usize = 64 << 10;

/// What a legacy file contains instead of particles.
pub(crate) fn legacy_neighbor(file: &dyn ReadAt) -> Option<Neighbor> {
    let size = file.size_bytes().ok()?;
    let mut scan =
        LegacyScan { file, size, at: 0, window: Vec::new(), window_at: 0, readable_bytes: READ_BYTES_MAX };
    scan.line()?;
    scan.line()?;
    let is_binary = scan.line()?.trim_ascii().eq_ignore_ascii_case("BINARY");
    while let Some(line) = scan.keyword_line(is_binary) {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let word = |index: usize| words.get(index).copied().unwrap_or_default();
        let number = |index: usize| word(index).parse::<u64>().ok();
        let mut skipped_bytes = 0;
        match &*word(0).to_ascii_uppercase() {
            "DATASET" => match &*word(1).to_ascii_uppercase() {
                "POLYDATA" | "UNSTRUCTURED_GRID" => {}
                _ => return Some(Neighbor::Grid),
            },
            "POINTS" => skipped_bytes = number(1)?.saturating_mul(3).saturating_mul(size_of_type(word(2))?),
            "METADATA" => while !scan.line()?.trim_ascii().is_empty() {},
            "POLYGONS" | "TRIANGLE_STRIPS" if number(2)? > 0 => return Some(Neighbor::Mesh),
            "VERTICES" | "LINES" | "POLYGONS" | "TRIANGLE_STRIPS" | "CELLS" if is_binary => {
                skipped_bytes = scan.cell_bytes(number(1)?, number(2)?)?;
            }
            "VERTICES" | "LINES" | "POLYGONS" | "TRIANGLE_STRIPS" | "CELLS" | "OFFSETS" | "CONNECTIVITY" => {}
            "CELL_TYPES" => {
                let has_faces = scan.types(number(1)?, is_binary)?.into_iter().any(is_face);
                return has_faces.then_some(Neighbor::Mesh);
            }
            _ => return None,
        }
        if is_binary {
            scan.at = scan.at.saturating_add(skipped_bytes);
        }
    }
    None
}

/// The position in a file, and a piece of the file.
struct LegacyScan<'a> {
    file: &'a dyn ReadAt,
    size: u64,
    at: u64,
    window: Vec<u8>,
    window_at: u64,
    /// The number of bytes that may still be read.
    readable_bytes: u64,
}

impl LegacyScan<'_> {
    /// The bytes from the position on, at least `length` if the file has as many; `None` beyond the end of
    /// the file or the limit.
    fn bytes(&mut self, length: usize) -> Option<&[u8]> {
        let left = self.size.checked_sub(self.at)?;
        let start = self.at.checked_sub(self.window_at).and_then(|start| usize::try_from(start).ok());
        let known = start.and_then(|start| self.window.get(start..)).map_or(0, <[u8]>::len);
        if (known as u64) < left.min(length as u64) {
            let length = left.min(WINDOW_BYTES as u64);
            self.readable_bytes = self.readable_bytes.checked_sub(length)?;
            self.window.resize(usize::try_from(length).ok()?, 0);
            self.file.read_exact_at(&mut self.window, self.at).ok()?;
            self.window_at = self.at;
        }
        self.window.get(usize::try_from(self.at - self.window_at).ok()?..)
    }

    /// The next line; `None` at the end of the file, and if it is too long.
    fn line(&mut self) -> Option<String> {
        let end = |bytes: &[u8]| bytes.iter().position(|&byte| byte == b'\n');
        let length = match end(self.bytes(1)?) {
            Some(length) => length,
            None => end(self.bytes(WINDOW_BYTES)?)?,
        };
        let line = String::from_utf8_lossy(&self.bytes(length)?[..length]).into_owned();
        self.at += length as u64 + 1;
        Some(line)
    }

    /// The next line that begins with a keyword. In a binary file it is the next that is not blank; in a
    /// text, the numbers before it are skipped.
    fn keyword_line(&mut self, is_binary: bool) -> Option<String> {
        loop {
            let line = self.line()?;
            // Not-a-number and infinity are numbers as well.
            let is_keyword = line.starts_with(|c: char| c.is_ascii_uppercase() && !matches!(c, 'N' | 'I'));
            if is_keyword {
                return Some(line);
            }
            if is_binary && !line.trim_ascii().is_empty() {
                return None;
            }
        }
    }

    /// The size of the cells of a section in a binary file: `count` cells of `size` 32-bit numbers together
    /// or, since version 5, two arrays with these numbers of integers.
    fn cell_bytes(&mut self, count: u64, size: u64) -> Option<u64> {
        if !self.bytes(b"OFFSETS".len())?.starts_with(b"OFFSETS") {
            return Some(size.saturating_mul(4));
        }
        let offsets = self.line()?;
        let size_of = |line: &str| size_of_type(line.split_ascii_whitespace().nth(1)?);
        self.at = self.at.saturating_add(count.saturating_mul(size_of(&offsets)?));
        let connectivity = self.keyword_line(true)?;
        Some(size.saturating_mul(size_of(&connectivity)?))
    }

    /// The types of the first cells.
    fn types(&mut self, count: u64, is_binary: bool) -> Option<Vec<i64>> {
        let count = usize::try_from(count.min(TYPES_MAX)).ok()?;
        let bytes = self.bytes(8 * count)?;
        if is_binary {
            let types = bytes.as_chunks().0.iter().take(count);
            return Some(types.map(|bytes| i32::from_be_bytes(*bytes).into()).collect());
        }
        let words = bytes.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        words.take(count).map(|word| std::str::from_utf8(word).ok()?.parse().ok()).collect()
    }
}
