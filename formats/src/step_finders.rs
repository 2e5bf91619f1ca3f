//! Finds the frames of multi-frame files: those of texts line by line, those of arrays by the header.

use std::io::{self, BufRead, Read as _};
use std::ops::Range;
use std::sync::Arc;

use crate::error::Result;
use crate::limits::Limits;

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
    fn of_text(number: Option<i64>, start: u64, lines: &LineHeads) -> FoundStep {
        FoundStep { number, head: Arc::default(), range: start..start, lines_before: lines.count - 1 }
    }
}

/// Finds the steps in the lines of a file and appends them to the known ones.
pub(crate) type FindSteps = fn(LineHeads, &mut Vec<FoundStep>, &Limits) -> Result<()>;

/// Finds the steps of a LAMMPS dump. A step starts at the first `ITEM:` line after the rows of the previous
/// step. If a step lacks its rows, it ends at the next `ITEM: TIMESTEP`.
pub(crate) fn steps_of_dump(mut lines: LineHeads, steps: &mut Vec<FoundStep>, limits: &Limits) -> Result<()> {
    let known_count = steps.len();
    let (mut is_numbered, mut is_in_rows, mut is_number_next) = (false, false, false);
    while let Some(start) = lines.next()? {
        let line = lines.head.trim_ascii();
        if let Some(item) = line.strip_prefix(b"ITEM:").map(<[u8]>::trim_ascii) {
            let is_timestep = item == b"TIMESTEP";
            if steps.len() == known_count || is_in_rows || (is_timestep && is_numbered) {
                end_at(steps, start);
                limits.check_step("LAMMPS dump", steps.len())?;
                steps.push(FoundStep::of_text(None, start, &lines));
                is_numbered = false;
            }
            is_numbered |= is_timestep;
            is_number_next = is_timestep;
            is_in_rows = item.starts_with(b"ATOMS") || item.starts_with(b"ENTRIES");
        } else if is_number_next {
            is_number_next = false;
            if let Some(step) = steps.last_mut() {
                step.number = std::str::from_utf8(line).ok().and_then(|number| number.parse().ok());
            }
        } else if steps.len() == known_count && !line.is_empty() {
            steps.push(FoundStep::of_text(None, start, &lines));
        }
    }
    end_at(steps, lines.end);
    Ok(())
}

/// Finds the steps of a file of atoms. A step is a line with a count N, a comment line, and N lines of atoms.
/// If the count is invalid, the rest of the file is one step, because the start of the next step is unknown.
pub(crate) fn steps_of_atoms(
    mut lines: LineHeads,
    steps: &mut Vec<FoundStep>,
    limits: &Limits,
) -> Result<()> {
    while let Some(start) = lines.next()? {
        let line = lines.head.trim_ascii();
        if line.is_empty() {
            continue;
        }
        end_at(steps, start);
        limits.check_step("XYZ atoms", steps.len())?;
        let count: Option<u64> = std::str::from_utf8(line).ok().and_then(|count| count.parse().ok());
        let number = i64::try_from(steps.len()).ok();
        steps.push(FoundStep::of_text(number, start, &lines));
        // Skips the comment line and the atoms.
        for _ in 0..count.map_or(u64::MAX, |count| count.saturating_add(1)) {
            if lines.next()?.is_none() {
                break;
            }
        }
    }
    end_at(steps, lines.end);
    Ok(())
}

fn end_at(steps: &mut [FoundStep], end: u64) {
    if let Some(step) = steps.last_mut() {
        step.range.end = end;
    }
}

/// The lines of a source; stores only the first bytes of each.
pub(crate) struct LineHeads<'a> {
    source: &'a mut dyn BufRead,
    /// The first bytes of the last line read.
    head: Vec<u8>,
    /// Offset of the end of that line.
    end: u64,
    /// Number of lines read.
    count: u64,
}

/// Number of bytes stored of each line: more than any text that the searches look for.
const HEAD_BYTES: usize = 64;

impl<'a> LineHeads<'a> {
    /// The lines of a source that starts `end` bytes and `count` lines into the file.
    pub(crate) fn new(source: &'a mut dyn BufRead, end: u64, count: u64) -> LineHeads<'a> {
        LineHeads { source, head: Vec::new(), end, count }
    }

    /// The first bytes of the source, instead of its lines.
    pub(crate) fn first_bytes(self, count: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.source.take(count).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    /// Reads the next line and returns its offset.
    fn next(&mut self) -> io::Result<Option<u64>> {
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
