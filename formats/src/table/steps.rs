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

use std::io::BufRead;

use crate::core::compression::decompressed_so_far;
use crate::core::error::Result;
use crate::core::limits::Limits;
pub use crate::core::steps::FoundStep;
use crate::core::steps::{FindSteps, StepSource};
use crate::table::loaded::Loaded;
use crate::table::probe::ProbedKind;

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

/// A step of a compressed file; `None` if the file has none at
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
) -> Result<Option<Loaded>> {
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
        return Ok(Some(Loaded::Particles(format, Box::new(frame))));
    }
    Ok(Some(Loaded::Bytes(step)))
}

fn finder_of(kind: ProbedKind) -> Option<FindSteps> {
    kind.format()?.row().particles.as_ref()?.find_steps
}

#[cfg(test)]
mod tests {
    use std::io::BufReader;
    use std::ops::Range;

    use super::*;
    use crate::Format;
    use crate::core::error::Error;
    use crate::tables::lammps;

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
