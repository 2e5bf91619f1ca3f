//! File names: which files are the frames of one sequence, and in which order.
//!
//! ```text
//!   dam.0012.bgeo.gz
//!   └stem──┘└extension┘          the stem names the outputs: dam.0012.glb
//!       └──┘                     the last number of the stem is the frame's
//!   dam.{}.bgeo.gz               what is left when it is taken out names the sequence
//!
//!   dump.lammpstrj/step=1000     a step of a file with several: its outputs are called dump.1000, and its number is 1000
//!   dump.lammpstrj/step={}       the steps of a file are a sequence of their own
//! ```
//!
//! Natural order compares runs of digits as numbers: frame 9 comes before frame 10.

use std::cmp::Ordering;
use std::collections::HashMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

use meniscus_formats::packing::unpacked_name;

use super::steps::{STEP, frame_name, step_of};

/// A file that holds, or should hold, a frame of particles; or a step of one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameFile {
    /// Where it is, as it was asked for.
    pub path: PathBuf,
    /// Where in the file name the frame's number stands: bytes of [`FrameFile::name`].
    number_span: Option<Range<usize>>,
}

impl FrameFile {
    /// A file whose frame number is the last number of its stem.
    pub fn new(path: PathBuf) -> FrameFile {
        let number_span = match step_of(&path) {
            None => last_number(stem(&frame_name(&path))),
            // What follows a dot tells steps of one number apart.
            Some((_, step)) => {
                let name = frame_name(&path);
                let start = name.len() - step.len();
                let digits = step.find('.').unwrap_or(step.len());
                let is_number = digits > 0 && step.as_bytes()[..digits].iter().all(u8::is_ascii_digit);
                is_number.then_some(start..start + digits)
            }
        };
        FrameFile { path, number_span }
    }

    /// A file whose frame number stands at a known place: bytes of the file name, all digits.
    pub fn with_number_at(path: PathBuf, number_span: Range<usize>) -> FrameFile {
        FrameFile { path, number_span: Some(number_span) }
    }

    /// The file name, without its folder; of a step, what tells it from others behind that.
    pub fn name(&self) -> String {
        frame_name(&self.path)
    }

    /// The file name without what says that it is a file of particles: what outputs are called.
    pub fn stem(&self) -> String {
        match step_of(&self.path) {
            Some((file, step)) => format!("{}.{step}", stem(&frame_name(file))),
            None => {
                let name = self.name();
                // Level sets are no frames of particles, and lose their extension all the same.
                strip_extension(&name, ".vdb").unwrap_or_else(|| stem(&name)).to_owned()
            }
        }
    }

    /// The frame's number, where the name has one of up to 64 bits.
    pub fn number(&self) -> Option<u64> {
        let span = self.number_span.clone()?;
        self.name().get(span)?.parse().ok()
    }

    /// What the files of a sequence share: their folder, and the name with `{}` for the frame's number.
    pub fn sequence(&self) -> (PathBuf, String) {
        if let Some((file, _)) = step_of(&self.path) {
            return (
                file.parent().map(Path::to_owned).unwrap_or_default(),
                format!("{}/{STEP}{{}}", frame_name(file)),
            );
        }
        let mut name = self.name();
        if let Some(span) = self.number_span.clone() {
            name.replace_range(span, "{}");
        }
        (self.path.parent().map(Path::to_owned).unwrap_or_default(), name)
    }
}

/// Files whose names differ only in the frame's number, in natural order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sequence {
    /// What to call it: the file's name, or `dam.{}.bgeo` where there are several.
    pub name: String,
    /// At least one frame.
    pub frames: Vec<FrameFile>,
}

/// Sorts files into sequences; the sequences, too, are in natural order.
pub fn sequences(mut files: Vec<FrameFile>) -> Vec<Sequence> {
    files.sort_by(|a, b| natural_order(&a.path.to_string_lossy(), &b.path.to_string_lossy()));
    let mut sequences: Vec<Sequence> = Vec::new();
    let mut place_of: HashMap<(PathBuf, String), usize> = HashMap::new();
    for file in files {
        let key = file.sequence();
        let place = *place_of.entry(key).or_insert(sequences.len());
        match sequences.get_mut(place) {
            Some(sequence) => sequence.frames.push(file),
            None => sequences.push(Sequence { name: file.name(), frames: vec![file] }),
        }
    }
    for sequence in &mut sequences {
        if sequence.frames.len() > 1 {
            sequence.name = sequence.frames[0].sequence().1;
        }
    }
    sequences
}

/// Compares text with its runs of digits as numbers, however long; equal numbers with fewer zeros
/// in front come first.
pub fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (a.as_bytes(), b.as_bytes());
    while let (Some(&l), Some(&r)) = (left.first(), right.first()) {
        let order = if l.is_ascii_digit() && r.is_ascii_digit() {
            let (number_l, rest_l) = left.split_at(digit_count(left));
            let (number_r, rest_r) = right.split_at(digit_count(right));
            (left, right) = (rest_l, rest_r);
            let (value_l, value_r) = (without_zeros(number_l), without_zeros(number_r));
            value_l.len().cmp(&value_r.len()).then_with(|| value_l.cmp(value_r))
        } else {
            (left, right) = (&left[1..], &right[1..]);
            l.cmp(&r)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
    left.len().cmp(&right.len()).then_with(|| a.len().cmp(&b.len())).then_with(|| a.cmp(b))
}

/// Whether a file name ends like one of a file of particles.
pub fn has_particle_extension(name: &str) -> bool {
    stem(name).len() < name.len()
}

/// Whether a file name promises particles so that one without any is broken, and no readme file or log: of names that
/// these have, too, only the content tells.
pub fn promises_particles(name: &str) -> bool {
    let unpacked = unpacked_name(name).to_ascii_lowercase();
    let may_be_any_text = [".txt", ".dat", ".asc"].iter().any(|extension| unpacked.ends_with(extension));
    has_particle_extension(name) && !may_be_any_text
}

/// The file name without its particle extensions; all of it where it has none.
fn stem(name: &str) -> &str {
    let unpacked = unpacked_name(name);
    PARTICLE_EXTENSIONS.iter().find_map(|extension| strip_extension(unpacked, extension)).unwrap_or(name)
}

/// `name` without `extension` in any case, if something is left.
fn strip_extension<'a>(name: &'a str, extension: &str) -> Option<&'a str> {
    let cut = name.len().checked_sub(extension.len()).filter(|&cut| cut > 0)?;
    let (stem, end) = name.split_at_checked(cut)?;
    end.eq_ignore_ascii_case(extension).then_some(stem)
}

fn last_number(text: &str) -> Option<Range<usize>> {
    let end = text.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = text[..end]
        .rfind(|c: char| !c.is_ascii_digit())
        .map_or(0, |before| before + text[before..].chars().next().map_or(1, char::len_utf8));
    Some(start..end)
}

fn digit_count(text: &[u8]) -> usize {
    text.iter().take_while(|byte| byte.is_ascii_digit()).count()
}

fn without_zeros(digits: &[u8]) -> &[u8] {
    let zeros = digits.iter().take_while(|&&digit| digit == b'0').count();
    &digits[zeros..]
}

/// Longer ones first where one ends like another. What is read is decided by content; these only
/// say where the stem ends, and which files of a folder are frames.
const PARTICLE_EXTENSIONS: [&str; 21] = [
    ".bgeo.sc",
    ".geo.sc",
    ".bgeo",
    ".geo",
    ".bhclassic",
    ".hclassic",
    ".ply",
    ".csv",
    ".tsv",
    ".txt",
    ".dat",
    ".asc",
    ".xyz",
    ".pts",
    ".vtk",
    ".vtp",
    ".vtu",
    ".npy",
    ".npz",
    ".dump",
    ".lammpstrj",
];

#[cfg(test)]
mod tests {
    use super::*;

    fn file(path: &str) -> FrameFile {
        FrameFile::new(path.into())
    }

    #[test]
    fn stems_lose_particle_extensions_only() {
        for (name, expected) in [
            ("dam.0012.bgeo", "dam.0012"),
            ("dam.0012.bgeo.gz", "dam.0012"),
            ("dam.BGEO.SC", "dam"),
            ("x.ply.gz", "x"),
            ("x.ply.zst", "x"),
            ("x.npz", "x"),
            ("x.lammpstrj.gz", "x"),
            ("x.gz", "x.gz"),
            ("frame.0001", "frame.0001"),
            ("v1.5", "v1.5"),
            (".ply", ".ply"),
            ("größe.csv", "größe"),
        ] {
            assert_eq!(stem(name), expected, "{name}");
        }
    }

    #[test]
    fn the_last_number_is_the_frame() {
        for (name, expected) in [
            ("dam.0012.bgeo", Some(12)),
            ("take2_frame7.ply", Some(7)),
            ("frame_12_particles.csv", Some(12)),
            ("frame.0001", Some(1)),
            ("dam.ply", None),
            ("ü3ß.ply", Some(3)),
            ("x99999999999999999999999.ply", None),
        ] {
            assert_eq!(file(name).number(), expected, "{name}");
        }
    }

    #[test]
    fn order_is_natural() {
        // The page of the window sorts the same names (order.js), and is held to the same list.
        let sorted: Vec<&str> = include_str!("../../tests/natural_order.txt").lines().collect();
        assert!(sorted.len() > 30);
        for (i, left) in sorted.iter().enumerate() {
            for (j, right) in sorted.iter().enumerate() {
                assert_eq!(natural_order(left, right), i.cmp(&j), "{left} {right}");
            }
        }
        let huge = "9".repeat(40);
        assert_eq!(natural_order(&huge, &format!("1{huge}")), Ordering::Less);
    }

    #[test]
    fn names_that_differ_in_the_last_number_are_a_sequence() {
        let names = ["d/b.2.ply", "d/a.10.ply", "d/a.9.ply", "e/a.11.ply", "d/a.1.csv", "d/single.ply"];
        let found: Vec<(String, Vec<Option<u64>>)> = sequences(names.map(file).to_vec())
            .into_iter()
            .map(|s| (s.name, s.frames.iter().map(FrameFile::number).collect()))
            .collect();
        let expected = [
            ("a.1.csv", vec![Some(1)]),
            ("a.{}.ply", vec![Some(9), Some(10)]),
            ("b.2.ply", vec![Some(2)]),
            ("single.ply", vec![None]),
            ("a.11.ply", vec![Some(11)]),
        ];
        assert_eq!(found, expected.map(|(name, numbers)| (name.to_owned(), numbers)));
    }

    #[test]
    fn steps_are_frames_of_their_file() {
        let all = ["in/d.7.dump.gz/step=1000", "in/d.7.dump.gz/step=0", "in/d.7.dump.gz/step=-5"];
        let named = ["in/d.7.dump.gz/step=1000.2", "in/d.7.dump.gz/step=unnumbered"].map(file);
        let found: Vec<_> = named.iter().map(|step| (step.stem(), step.number())).collect();
        assert_eq!(found, [("d.7.1000.2".to_owned(), Some(1000)), ("d.7.unnumbered".to_owned(), None)]);
        let found = sequences(all.map(file).to_vec());
        let numbers: Vec<_> =
            found.iter().map(|s| s.frames.iter().map(FrameFile::number).collect::<Vec<_>>()).collect();
        assert_eq!(numbers, [vec![None, Some(0), Some(1000)]]);
        assert_eq!(found[0].name, "d.7.dump.gz/step={}");
        assert_eq!(found[0].frames[0].sequence().0, Path::new("in"));
    }

    #[test]
    fn a_number_may_stand_elsewhere() {
        let numbered = |path: &str, span| FrameFile::with_number_at(path.into(), span);
        let found = sequences(vec![numbered("f23_900.ply", 1..3), numbered("f9_900.ply", 1..2)]);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].name, "f{}_900.ply");
        assert_eq!(found[0].frames[0].number(), Some(9));
    }
}
