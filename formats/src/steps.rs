//! Files with several frames, one after the other: where each begins and ends.
//!
//! ```text
//!   LAMMPS dump                       XYZ atoms
//!   ITEM: TIMESTEP  ┐                 3        ┐ so many atoms
//!   1000            │ a step          water    │ anything
//!   ITEM: ATOMS ..  │                 O 0 0 0  │
//!   1 0.5 0.25 1    ┘                 ..       ┘
//!   ITEM: TIMESTEP  ┐                 3        ┐
//!   2000            │                 ..       ┘
//!   ..              ┘
//! ```
//!
//! Only what tells where a step ends is looked at, line by line, so that a file of any size is gone through in no memory
//! but what the steps take that are found, of which there may be as many as the limits say.
//! What is wrong within a step is found by whoever reads it: the steps around it are not touched by that.

use std::io::{self, BufRead};
use std::ops::Range;

use crate::error::Result;
use crate::limits::Limits;
use crate::probe::Kind;
use crate::{atoms, lammps};

/// A part of a file that is a frame, or should be one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundStep {
    /// Its number: that which the file gives it, or else its place among the others, from 0. `None` where the file should
    /// say it and does not.
    pub number: Option<i64>,
    /// Which bytes of the file, unpacked, are this step. By themselves they are a file of one frame.
    pub range: Range<u64>,
    /// So many lines of the file, unpacked, come before it.
    pub lines_before: u64,
}

/// Whether files of this kind may hold several frames.
pub fn may_have_steps(kind: Kind) -> bool {
    matches!(kind, Kind::LammpsDump | Kind::XyzAtoms)
}

/// The steps of an unpacked file of this kind, in their order; none for kinds that hold one frame.
///
/// # Errors
///
/// [`Error::Io`](crate::Error::Io) when the source cannot be read, [`Error::TooLarge`](crate::Error::TooLarge) beyond
/// `limits`.
pub fn find_steps(kind: Kind, source: impl BufRead, limits: &Limits) -> Result<Vec<FoundStep>> {
    let mut steps = Vec::new();
    find_more_steps(kind, source, &mut steps, limits)?;
    Ok(steps)
}

/// The same of a file of which some `steps` are known. The last of them may have been cut off: the source begins where that
/// does, and it is found once more.
///
/// # Errors
///
/// Those of [`find_steps`].
pub fn find_more_steps(
    kind: Kind,
    source: impl BufRead,
    steps: &mut Vec<FoundStep>,
    limits: &Limits,
) -> Result<()> {
    let (end, count) = steps.pop().map_or((0, 0), |last| (last.range.start, last.lines_before));
    let lines = LineHeads { source, head: Vec::new(), end, count };
    match kind {
        Kind::LammpsDump => steps_of_dump(lines, steps, limits),
        Kind::XyzAtoms => steps_of_atoms(lines, steps, limits),
        _ => Ok(()),
    }
}

/// A step begins at the first `ITEM:` behind rows; one that is cut off ends where the next has its number.
fn steps_of_dump(
    mut lines: LineHeads<impl BufRead>,
    steps: &mut Vec<FoundStep>,
    limits: &Limits,
) -> Result<()> {
    let known_count = steps.len();
    let (mut is_numbered, mut is_in_rows, mut is_number_next) = (false, false, false);
    while let Some(start) = lines.next()? {
        let line = lines.head.trim_ascii();
        if let Some(item) = line.strip_prefix(b"ITEM:").map(<[u8]>::trim_ascii) {
            let is_timestep = item == b"TIMESTEP";
            if steps.len() == known_count || is_in_rows || (is_timestep && is_numbered) {
                end_at(steps, start);
                limits.check_step(lammps::FORMAT, steps.len())?;
                steps.push(FoundStep { number: None, range: start..start, lines_before: lines.count - 1 });
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
            steps.push(FoundStep { number: None, range: start..start, lines_before: lines.count - 1 });
        }
    }
    end_at(steps, lines.end);
    Ok(())
}

/// A count, a comment, and so many lines. Where no count is, all the rest is one step, for nobody knows where the next
/// begins.
fn steps_of_atoms(
    mut lines: LineHeads<impl BufRead>,
    steps: &mut Vec<FoundStep>,
    limits: &Limits,
) -> Result<()> {
    while let Some(start) = lines.next()? {
        let line = lines.head.trim_ascii();
        if line.is_empty() {
            continue;
        }
        end_at(steps, start);
        limits.check_step(atoms::FORMAT, steps.len())?;
        let count: Option<u64> = std::str::from_utf8(line).ok().and_then(|count| count.parse().ok());
        let number = i64::try_from(steps.len()).ok();
        steps.push(FoundStep { number, range: start..start, lines_before: lines.count - 1 });
        // The comment is a line, too.
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

/// The lines of a source: of each as much as tells what it is.
struct LineHeads<R> {
    source: R,
    /// The beginning of the line that was read last.
    head: Vec<u8>,
    /// Where that line ends.
    end: u64,
    /// So many lines were read.
    count: u64,
}

/// Longer than all that is looked for.
const HEAD_BYTES: usize = 64;

impl<R: BufRead> LineHeads<R> {
    /// Reads the next line; where it begins.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;
    use std::io::BufReader;

    fn found(kind: Kind, text: &str) -> Vec<(Option<i64>, String)> {
        // A buffer that ends within lines changes nothing.
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
    fn dumps_are_cut_before_their_items() {
        let step = |number: i64, rows: &str| {
            format!("ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n1\nITEM: ATOMS x y z\n{rows}")
        };
        let first = format!("ITEM: UNITS\nlj\nITEM: TIME\n0.5\n{}", step(10, "1 2 3\n"));
        let (second, third) =
            (step(-20, "1 2 3\n4 5 6\n\n"), format!("ITEM: TIME\n1\n{}", step(30, "7 8 9")));
        let text = [first.clone(), second.clone(), third.clone()].concat();
        let expected = [(Some(10), first.clone()), (Some(-20), second.clone()), (Some(30), third)];
        assert_eq!(found(Kind::LammpsDump, &text), expected);
        // Cut off within its header, and without a number.
        let cut = "ITEM: TIMESTEP\n15\nITEM: NUMBER OF ATOMS\n".to_owned();
        let nameless = "ITEM: TIMESTEP\nten\nITEM: ATOMS x y z\n1 2 3\n".to_owned();
        let text = [cut.clone(), nameless.clone(), second.clone()].concat();
        assert_eq!(found(Kind::LammpsDump, &text), [(Some(15), cut), (None, nameless), (Some(-20), second)]);
        assert_eq!(found(Kind::LammpsDump, "x\n"), [(None, "x\n".into())]);
        assert!(found(Kind::LammpsDump, "").is_empty() && found(Kind::Ply, "ply\n").is_empty());
    }

    #[test]
    fn atoms_are_cut_by_their_counts() {
        let text = "2\nwater\nO 0 0 0\nH 1 0 0\n\n 0 \n\n1\n3\nO 0 0 0\nwhat\nfollows\n";
        let expected = [
            (Some(0), "2\nwater\nO 0 0 0\nH 1 0 0\n\n".into()),
            (Some(1), " 0 \n\n".into()),
            (Some(2), "1\n3\nO 0 0 0\n".into()),
            (Some(3), "what\nfollows\n".into()),
        ];
        assert_eq!(found(Kind::XyzAtoms, text), expected);
        assert_eq!(found(Kind::XyzAtoms, "9\nwater\nO 0 0"), [(Some(0), "9\nwater\nO 0 0".into())]);
    }

    #[test]
    fn steps_beyond_the_limit_are_refused() {
        let limits = Limits { step_count: 3, ..Limits::default() };
        let dump = "ITEM: TIMESTEP\n1\nITEM: NUMBER OF ATOMS\n0\nITEM: ATOMS x y z\n";
        for (kind, step) in [(Kind::LammpsDump, dump), (Kind::XyzAtoms, "0\n\n")] {
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
