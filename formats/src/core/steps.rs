//! The frames of files that have several: where they are, and a source for finding them line by line.

use std::io::{self, BufRead, Read as _};
use std::ops::Range;
use std::sync::Arc;

use crate::core::error::Result;
use crate::core::limits::Limits;

/// A part of a file that is treated as one frame, even if it is incomplete or damaged.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundStep {
    /// The step number that the file states or, if the format has no step numbers, the index of the step,
    /// from 0. `None` if the format has step numbers and this step states none.
    pub number: Option<i64>,
    /// Bytes that precede those of the range in a file with this step alone: the header of its array; empty
    /// for text.
    pub head: Arc<[u8]>,
    /// The byte range of this step in the uncompressed file. These bytes, after the head, are a valid
    /// single-frame file, unless the step is damaged.
    pub range: Range<u64>,
    /// Number of lines before this step in the uncompressed file.
    pub lines_before: u64,
}

impl FoundStep {
    /// A step of a text, which begins with the last line that was read.
    pub(crate) fn of_text(number: Option<i64>, start: u64, lines: &StepSource) -> FoundStep {
        FoundStep { number, head: Arc::default(), range: start..start, lines_before: lines.count - 1 }
    }
}

/// Finds the steps of a file and appends them to the known ones.
pub(crate) type FindSteps = fn(StepSource, &mut Vec<FoundStep>, &Limits) -> Result<()>;

/// Sets where the last step ends.
pub(crate) fn end_at(steps: &mut [FoundStep], end: u64) {
    if let Some(step) = steps.last_mut() {
        step.range.end = end;
    }
}

/// Where the steps of a file are searched: its lines, of which only the first bytes are stored, or its first
/// bytes.
pub(crate) struct StepSource<'a> {
    source: &'a mut dyn BufRead,
    /// The first bytes of the last line read.
    pub(crate) head: Vec<u8>,
    /// Offset of the end of that line.
    pub(crate) end: u64,
    /// Number of lines read.
    count: u64,
}

/// Number of bytes stored of each line: more than any text that the searches look for.
const HEAD_BYTES: usize = 64;

impl<'a> StepSource<'a> {
    /// A source that starts `end` bytes and `count` lines into the file.
    pub(crate) fn new(source: &'a mut dyn BufRead, end: u64, count: u64) -> StepSource<'a> {
        StepSource { source, head: Vec::new(), end, count }
    }

    /// The first bytes of the source, instead of its lines.
    pub(crate) fn first_bytes(self, count: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.source.take(count).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    /// Reads the next line and returns its offset.
    pub(crate) fn next_line(&mut self) -> io::Result<Option<u64>> {
        let start = self.end;
        self.head.clear();
        loop {
            let bytes = match self.source.fill_buf() {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                bytes => bytes?,
            };
            let newline = bytes.iter().position(|&byte| byte == b'\n');
            let length = newline.map_or(bytes.len(), |at| at + 1);
            let kept = length.min(HEAD_BYTES.saturating_sub(self.head.len()));
            self.head.extend_from_slice(&bytes[..kept]);
            self.source.consume(length);
            self.end += length as u64;
            if newline.is_some() || length == 0 {
                let is_line = self.end > start;
                self.count += u64::from(is_line);
                return Ok(is_line.then_some(start));
            }
        }
    }
}
