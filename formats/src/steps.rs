//! Locates the frames of multi-frame files.
//!
//! ```text
//!   LAMMPS dump                       XYZ atoms
//!   ITEM: TIMESTEP  ┐                 3        ┐ number of atoms
//!   1000            │ a step          water    │ free text
//!   ITEM: ATOMS ..  │                 O 0 0 0  │
//!   1 0.5 0.25 1    ┘                 ..       ┘
//!   ITEM: TIMESTEP  ┐                 3        ┐
//!   2000            │                 ..       ┘
//!   ..              ┘
//! ```
//!
//! In a NumPy array of shape (T, N, 3), the header gives the places of the steps.
//!
//! The search of a text reads line by line and looks only at what marks the end of a step, so it handles
//! files of any size. It stores only the steps it finds, at most as many as the limits allow. It does not
//! validate the content of a step: the reader reports errors there, and they do not affect other steps.

use std::io::{self, BufRead, Read as _};
use std::ops::Range;
use std::sync::Arc;

use crate::compression::decompressed_so_far;
use crate::error::Result;
use crate::limits::Limits;
use crate::packed::pack;
use crate::probe::ProbedKind;

/// Whether files of this kind can contain several frames.
pub fn may_have_steps(kind: ProbedKind) -> bool {
    finder_of(kind).is_some()
}

/// The steps of an uncompressed file of this kind, in file order; empty for kinds with one frame per file.
///
/// # Errors
///
/// [`Error::Io`](crate::Error::Io) if reading fails, [`Error::TooLarge`](crate::Error::TooLarge) beyond `limits`.
pub fn find_steps(kind: ProbedKind, source: impl BufRead, limits: &Limits) -> Result<Vec<FoundStep>> {
    let mut steps = Vec::new();
    find_more_steps(kind, source, &mut steps, limits)?;
    Ok(steps)
}

/// Continues [`find_steps`] after some `steps` are known. The last known step may have been truncated, so it
/// is found again: the source must start at the beginning of this step.
///
/// # Errors
///
/// Those of [`find_steps`].
pub fn find_more_steps(
    kind: ProbedKind,
    mut source: impl BufRead,
    steps: &mut Vec<FoundStep>,
    limits: &Limits,
) -> Result<()> {
    let (end, count) = steps.pop().map_or((0, 0), |last| (last.range.start, last.lines_before));
    let source = StepSource::new(&mut source, end, count);
    finder_of(kind).map_or(Ok(()), |find| find(source, steps, limits))
}

/// The bytes of a step of a compressed file, as [`crate::read_particles`] reads them; `None` if the file has none at
/// this place. If the compressed data ends too early, the particles of the last step have a note that says so.
///
/// # Errors
///
/// Those of [`decompressed_so_far`].
pub fn step_of_compressed(
    kind: ProbedKind,
    bytes: &[u8],
    step: &FoundStep,
    limits: &Limits,
) -> Result<Option<Vec<u8>>> {
    let (content, note) = decompressed_so_far(bytes, limits)?;
    let [start, end] = [step.range.start, step.range.end].map(|at| usize::try_from(at).unwrap_or(usize::MAX));
    let Some(rows) = content.get(start..end) else { return Ok(None) };
    let step = [&*step.head, rows].concat();
    if let Some(note) = note.filter(|_| end == content.len())
        && let Some(format) = kind.format()
        // The caller reads a step that ends too early, and gets the error with its line.
        && let Ok(mut frame) = crate::read_particles(&step, kind.name(), limits)
    {
        frame.notes.push(note);
        return Ok(Some(pack(format, &frame)));
    }
    Ok(Some(step))
}

fn finder_of(kind: ProbedKind) -> Option<FindSteps> {
    kind.format()?.row().particles.as_ref()?.find_steps
}

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
    fn of_text(number: Option<i64>, start: u64, lines: &StepSource) -> FoundStep {
        FoundStep { number, head: Arc::default(), range: start..start, lines_before: lines.count - 1 }
    }
}

/// Finds the steps of a file and appends them to the known ones.
pub(crate) type FindSteps = fn(StepSource, &mut Vec<FoundStep>, &Limits) -> Result<()>;

/// Finds the steps of a LAMMPS dump. A step starts at the first `ITEM:` line after the rows of the previous
/// step. If a step lacks its rows, it ends at the next `ITEM: TIMESTEP`.
pub(crate) fn steps_of_dump(
    mut lines: StepSource,
    steps: &mut Vec<FoundStep>,
    limits: &Limits,
) -> Result<()> {
    let mut is_first = true;
    let (mut is_numbered, mut is_in_rows, mut is_number_next) = (false, false, false);
    while let Some(start) = lines.next_line()? {
        let line = lines.head.trim_ascii();
        if let Some(item) = line.strip_prefix(b"ITEM:").map(<[u8]>::trim_ascii) {
            let is_timestep = item == b"TIMESTEP";
            if is_first || is_in_rows || (is_timestep && is_numbered) {
                is_first = false;
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
        } else if is_first && !line.is_empty() {
            is_first = false;
            steps.push(FoundStep::of_text(None, start, &lines));
        }
    }
    end_at(steps, lines.end);
    Ok(())
}

/// Finds the steps of a file of atoms. A step is a line with a count N, a comment line, and N lines of atoms.
/// If the count is invalid, the rest of the file is one step, because the start of the next step is unknown.
pub(crate) fn steps_of_atoms(
    mut lines: StepSource,
    steps: &mut Vec<FoundStep>,
    limits: &Limits,
) -> Result<()> {
    while let Some(start) = lines.next_line()? {
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
            if lines.next_line()?.is_none() {
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

/// Where the steps of a file are searched: its lines, of which only the first bytes are stored, or its first
/// bytes.
pub(crate) struct StepSource<'a> {
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
    fn next_line(&mut self) -> io::Result<Option<u64>> {
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

#[cfg(test)]
mod tests {
    use std::io::BufReader;
    use std::ops::Range;

    use super::*;
    use crate::Format;
    use crate::error::Error;
    use crate::lammps;

    fn found(kind: ProbedKind, text: &str) -> Vec<(Option<i64>, String)> {
        // A buffer that ends in the middle of lines must not change the result.
        let steps = find_steps(kind, text.as_bytes(), &Limits::default()).expect("readable");
        let by_pieces = BufReader::with_capacity(3, text.as_bytes());
        assert_eq!(find_steps(kind, by_pieces, &Limits::default()).expect("readable"), steps);
        let at = |at: u64| usize::try_from(at).expect("within the text");
        for step in &steps {
            let before = &text.as_bytes()[..at(step.range.start)];
            assert_eq!(step.lines_before, before.iter().filter(|&&byte| byte == b'\n').count() as u64);
        }
        let of = |range: &Range<u64>| text[at(range.start)..at(range.end)].to_owned();
        steps.iter().map(|step| (step.number, of(&step.range))).collect()
    }

    #[test]
    fn dump_steps_start_at_header_items() {
        let step = |number: i64, rows: &str| {
            format!("ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n1\nITEM: ATOMS x y z\n{rows}")
        };
        let first = format!("ITEM: UNITS\nlj\nITEM: TIME\n0.5\n{}", step(10, "1 2 3\n"));
        let (second, third) =
            (step(-20, "1 2 3\n4 5 6\n\n"), format!("ITEM: TIME\n1\n{}", step(30, "7 8 9")));
        let text = [first.clone(), second.clone(), third.clone()].concat();
        let expected = [(Some(10), first.clone()), (Some(-20), second.clone()), (Some(30), third)];
        assert_eq!(found(ProbedKind::Format(Format::LammpsDump), &text), expected);
        // A step that is truncated in its header, and a step without a number.
        let cut = "ITEM: TIMESTEP\n15\nITEM: NUMBER OF ATOMS\n".to_owned();
        let nameless = "ITEM: TIMESTEP\nten\nITEM: ATOMS x y z\n1 2 3\n".to_owned();
        let text = [cut.clone(), nameless.clone(), second.clone()].concat();
        assert_eq!(
            found(ProbedKind::Format(Format::LammpsDump), &text),
            [(Some(15), cut), (None, nameless), (Some(-20), second)]
        );
        assert_eq!(found(ProbedKind::Format(Format::LammpsDump), "x\n"), [(None, "x\n".into())]);
        assert!(
            found(ProbedKind::Format(Format::LammpsDump), "").is_empty()
                && found(ProbedKind::Format(Format::Ply), "ply\n").is_empty()
        );
    }

    #[test]
    fn xyz_steps_follow_atom_counts() {
        let text = "2\nwater\nO 0 0 0\nH 1 0 0\n\n 0 \n\n1\n3\nO 0 0 0\nwhat\nfollows\n";
        let expected = [
            (Some(0), "2\nwater\nO 0 0 0\nH 1 0 0\n\n".into()),
            (Some(1), " 0 \n\n".into()),
            (Some(2), "1\n3\nO 0 0 0\n".into()),
            (Some(3), "what\nfollows\n".into()),
        ];
        assert_eq!(found(ProbedKind::Format(Format::XyzAtoms), text), expected);
        assert_eq!(
            found(ProbedKind::Format(Format::XyzAtoms), "9\nwater\nO 0 0"),
            [(Some(0), "9\nwater\nO 0 0".into())]
        );
    }

    #[test]
    fn steps_beyond_the_limit_are_an_error() {
        let limits = Limits { step_count: 3, ..Limits::default() };
        let dump = "ITEM: TIMESTEP\n1\nITEM: NUMBER OF ATOMS\n0\nITEM: ATOMS x y z\n";
        for (kind, step) in
            [(ProbedKind::Format(Format::LammpsDump), dump), (ProbedKind::Format(Format::XyzAtoms), "0\n\n")]
        {
            let found = |count: usize| find_steps(kind, step.repeat(count).as_bytes(), &limits);
            assert_eq!(found(3).expect("as many as may be").len(), 3);
            let error = found(4).expect_err("one more");
            assert!(matches!(&error, Error::TooLarge { what, .. } if what.contains("limit of 3")), "{error}");
        }
        assert!(lammps::steps(dump.repeat(3).as_bytes(), &limits).is_ok());
        let error = lammps::steps(dump.repeat(4).as_bytes(), &limits).expect_err("one more");
        assert!(matches!(error, Error::TooLarge { .. }), "{error}");
    }
}
