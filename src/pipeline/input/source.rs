//! Groups files into sequences by their names, and orders the frames.
//!
//! ```text
//!   dam.0012.bgeo.gz
//!   └stem──┘└extension┘          the stem names the outputs: dam.0012.glb
//!       └──┘                     the frame's number or time (`frame_number.rs` finds it)
//!   dam.{}.bgeo.gz               the name without the number is the name of the sequence
//!
//!   0.05/p.ply                   a folder for each time: outputs p_0.05, sequence {}/p.ply
//!
//!   dump.lammpstrj/step=1000     one of the steps of a file: outputs dump.1000, number 1000
//!   dump.lammpstrj/step={}       the steps of one file form a sequence
//! ```
//!
//! The frames of a sequence are ordered by their numbers.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::ops::Range;
use std::path::{Path, PathBuf};

use meniscus_formats::Format;
use meniscus_formats::compression::name_without_compression;

use super::measured_spacing::measured_by;
use super::steps::{STEP, name_of, step_in, step_of};
use crate::pipeline::files::frame_number::{
    NameNumber, NumberMeaning, compared_numbers, frame_number, is_number, natural_order, without_numbers,
};
use crate::pipeline::files::names::text_of_name;
use crate::pipeline::target::outputs::OutputFormat;
use crate::surface::options::MethodOptions;

/// A file that contains, or should contain, a frame of particles; or a step of such a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameFile {
    /// Its path, as given.
    pub path: PathBuf,
    /// The frame's number in [`FrameFile::name`].
    number: Option<NameNumber>,
    /// Whether the caller gave the position of the number, so that comparing names does not change it.
    is_number_given: bool,
    /// Whether the number is the name of its folder, which then belongs to the name of the frame.
    is_numbered_by_folder: bool,
    /// The base name of its outputs, if it differs from the file's.
    output_stem: Option<String>,
    /// Whether it is a step of a file, stored to avoid more file-system calls.
    is_step: bool,
}

impl FrameFile {
    /// A file whose frame number is found in its name.
    pub fn new(path: PathBuf) -> FrameFile {
        let is_step = step_of(&path).is_some();
        FrameFile::known(path, is_step)
    }

    /// Like [`new`](FrameFile::new), if the caller knows whether the path is that of a step: makes no
    /// file-system call.
    pub fn known(path: PathBuf, is_step: bool) -> FrameFile {
        let name = name_of(&path, is_step);
        let number = match step_in(&path, is_step) {
            None => frame_number(numbered_part(&name)),
            // The text after a dot distinguishes steps with the same number.
            Some((_, step)) => {
                let start = name.len() - step.len();
                let number = step.split('.').next().filter(|number| is_number(number));
                number.map(|number| frame_at(start..start + number.len()))
            }
        };
        FrameFile {
            path,
            number,
            is_number_given: false,
            is_numbered_by_folder: false,
            output_stem: None,
            is_step,
        }
    }

    /// The frame whose outputs have this base name, which shows whether the path is that of a step: makes no
    /// file-system call.
    pub fn of_outputs(path: PathBuf, stem: &str) -> FrameFile {
        let is_step = step_in(&path, true).is_some() && output_stem(&path, true) == stem;
        FrameFile::known(path, is_step)
    }

    /// A file whose frame number is at a known position: a range of bytes in the file name.
    pub fn with_number_at(path: PathBuf, span: Range<usize>) -> FrameFile {
        let mut file = FrameFile::new(path);
        let kind = file.name().get(span.clone()).map_or(NumberMeaning::Frame, NumberMeaning::of_text);
        file.number = Some(NameNumber { span, kind });
        FrameFile { is_number_given: true, ..file }
    }

    /// The same file, with the name of its folder as its number, if that is one and the file's own name has
    /// none.
    pub fn numbered_by_folder(&self) -> Option<FrameFile> {
        let folder = text_of_name(self.path.parent()?.file_name()?);
        if self.number.is_some() || self.is_step || !is_number(&folder) {
            return None;
        }
        let number = Some(NameNumber { span: 0..folder.len(), kind: NumberMeaning::of_text(&folder) });
        Some(FrameFile { number, is_numbered_by_folder: true, ..self.clone() })
    }

    /// The file as a frame of this watched folder: sub-folders may be those of times.
    pub fn in_watched_folder(self, root: &Path) -> FrameFile {
        let is_below = self.path.parent().is_some_and(|folder| folder != root);
        self.numbered_by_folder().filter(|_| is_below).unwrap_or(self)
    }

    /// The same file, with this base name for its outputs.
    pub fn with_output_stem(self, stem: String) -> FrameFile {
        FrameFile { output_stem: Some(stem), ..self }
    }

    /// The file name without its folder, unless the folder has the number; for a step, followed by the name
    /// of the step.
    pub fn name(&self) -> String {
        let name = name_of(&self.path, self.is_step);
        match self.path.parent().and_then(Path::file_name).filter(|_| self.is_numbered_by_folder) {
            Some(folder) => format!("{}/{name}", text_of_name(folder)),
            None => name,
        }
    }

    /// The folder of the sequence.
    fn folder(&self) -> PathBuf {
        let folder = self.file().parent();
        let folder = if self.is_numbered_by_folder { folder.and_then(Path::parent) } else { folder };
        folder.map(Path::to_owned).unwrap_or_default()
    }

    /// The file and the name of a step; `None` for a frame that is a whole file.
    fn step(&self) -> Option<(&Path, &str)> {
        step_in(&self.path, self.is_step)
    }

    /// The file; for a step, the one that contains it.
    pub fn file(&self) -> &Path {
        self.step().map_or(&*self.path, |(file, _)| file)
    }

    /// The base name of the outputs: the file name without its extension, unless another name was given.
    pub fn stem(&self) -> String {
        if let Some(stem) = &self.output_stem {
            return stem.clone();
        }
        output_stem(&self.path, self.is_step)
    }

    /// The frame's number, if the name has one that fits into 64 bits. Subframes have the number of their
    /// frame; times have none.
    pub fn number(&self) -> Option<i64> {
        let NameNumber { span, kind } = self.number.clone()?;
        kind.frame_in(self.name().get(span)?)
    }

    /// The value of its number or time, by which a sequence is ordered. A number of more than 53 bits is
    /// rounded.
    pub fn value(&self) -> Option<f64> {
        self.name().get(self.number.clone()?.span)?.parse().ok()
    }

    /// Whether the name has a time in place of a frame number.
    pub fn has_time(&self) -> bool {
        self.number.as_ref().is_some_and(|number| number.kind == NumberMeaning::Time)
    }

    /// The key of all files whose names differ only in numbers: the folder, and the name without its numbers.
    /// `None` if the position of the number was given, for steps, and for names without a number.
    pub fn group_key(&self) -> Option<(PathBuf, String)> {
        let is_fixed = self.is_number_given || self.is_numbered_by_folder || self.is_step;
        (!is_fixed && self.number.is_some()).then(|| (self.folder(), without_numbers(&self.name())))
    }

    /// The key of the sequence: the folder, and the name with `{}` in place of the frame's number.
    pub fn sequence(&self) -> (PathBuf, String) {
        let mut name = self.name();
        if let Some((file, _)) = self.step() {
            name = format!("{}/{STEP}{{}}", name_of(file, false));
        } else if let Some(number) = &self.number {
            name.replace_range(number.span.clone(), "{}");
        }
        (self.folder(), name)
    }
}

fn frame_at(span: Range<usize>) -> NameNumber {
    NameNumber { span, kind: NumberMeaning::Frame }
}

/// The base name of the outputs of a sequence with this name, with `{}` in place of the frame's number:
/// `dam.{}` of `dam.{}.bgeo.gz`, `dump.{}` of the steps `dump.lammpstrj/step={}`.
pub fn output_sequence(sequence: &str) -> String {
    match sequence.strip_suffix("{}").and_then(|rest| rest.strip_suffix(STEP)?.strip_suffix('/')) {
        Some(file) => format!("{}.{{}}", stem(file)),
        None => stem_of_file(sequence).to_owned(),
    }
}

/// The base name of the outputs of a frame, derived from the frame's path only.
pub(crate) fn output_stem(frame: &Path, is_step: bool) -> String {
    match step_in(frame, is_step) {
        Some((file, step)) => format!("{}.{step}", stem(&name_of(file, false))),
        None => stem_of_file(&name_of(frame, is_step)).to_owned(),
    }
}

/// The name of a file without its extension. Level sets and meshes are not particle files, but their
/// extensions are removed as well.
fn stem_of_file(name: &str) -> &str {
    let is_surface = |extension: &str| {
        let formats = Format::ALL.iter().filter(|format| format.has_mesh() || **format == Format::Vdb);
        let mut extensions = formats.flat_map(|format| format.extensions());
        extensions.any(|known| extension.eq_ignore_ascii_case(known))
    };
    match name.rsplit_once('.') {
        Some((stem, extension)) if !stem.is_empty() && is_surface(extension) => stem,
        _ => stem(name),
    }
}

/// Files whose names differ only in the frame's number, ordered by it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sequence {
    /// The name of the sequence: the file's name, or `dam.{}.bgeo` for several files.
    pub name: String,
    /// At least one frame.
    pub frames: Vec<FrameFile>,
}

/// Groups files into sequences, in natural order. Comparing the names shows which of several numbers is the
/// frame's: see `use_compared_numbers`. Files of one name in several folders whose names are numbers, such as
/// `0/p.ply` and `0.05/p.ply`, are one sequence; their outputs are named `p_0` and `p_0.05`.
pub fn sequences(mut files: Vec<FrameFile>) -> Vec<Sequence> {
    use_compared_numbers(&mut files);
    use_numbers_of_folders(&mut files);
    files.sort_by(|a, b| natural_order(&a.path.to_string_lossy(), &b.path.to_string_lossy()));
    let mut sequences: Vec<Sequence> = Vec::new();
    let mut index_of: HashMap<(PathBuf, String), usize> = HashMap::new();
    for file in files {
        let key = file.sequence();
        let index = *index_of.entry(key).or_insert(sequences.len());
        match sequences.get_mut(index) {
            Some(sequence) => sequence.frames.push(file),
            None => sequences.push(Sequence { name: file.name(), frames: vec![file] }),
        }
    }
    for sequence in &mut sequences {
        order_by_number(&mut sequence.frames, FrameFile::clone);
        // The whole numbers among times, such as 0 and 1, are times as well.
        if sequence.frames.iter().any(FrameFile::has_time) {
            let numbers = sequence.frames.iter_mut().filter_map(|frame| frame.number.as_mut());
            numbers.for_each(|number| number.kind = NumberMeaning::Time);
        }
        if sequence.frames.len() > 1 {
            sequence.name = sequence.frames[0].sequence().1;
        }
    }
    sequences
}

/// Sorts a sequence that is in natural order by its numbers: subframes follow their frame.
pub fn order_by_number<T>(frames: &mut [T], file: impl Fn(&T) -> FrameFile) {
    // Of floats that are not NaN, the bits have this order if those of negative ones are flipped.
    let ordered_bits = |value: f64| {
        let bits = value.to_bits().cast_signed();
        if bits < 0 { bits ^ i64::MAX } else { bits }
    };
    // A step without a number comes last.
    frames.sort_by_cached_key(|frame| ordered_bits(file(frame).value().unwrap_or(f64::INFINITY)));
}

/// Compares the names in a folder, and corrects the frame numbers that [`FrameFile::new`] found. For example,
/// if another number is the only one that varies, that number is the frame's, such as the first in
/// `dam_0001_b7.ply` and `dam_0002_b7.ply`.
fn use_compared_numbers(files: &mut [FrameFile]) {
    let mut groups: HashMap<(PathBuf, String), Vec<usize>> = HashMap::new();
    for (index, file) in files.iter().enumerate() {
        if let Some(key) = file.group_key() {
            groups.entry(key).or_default().push(index);
        }
    }
    let kind_of = |file: &FrameFile| file.number.as_ref().map(|number| number.kind);
    let has_whole_number = |file: &&FrameFile| kind_of(file) == Some(NumberMeaning::Frame);
    let whole: HashSet<(PathBuf, String)> =
        files.iter().filter(has_whole_number).map(FrameFile::sequence).collect();
    for members in groups.into_values() {
        let names: Vec<String> = members.iter().map(|&index| files[index].name()).collect();
        let stems: Vec<&str> = names.iter().map(|name| numbered_part(name)).collect();
        let found: Vec<NameNumber> =
            members.iter().filter_map(|&index| files[index].number.clone()).collect();
        let belongs_to_sequence = |index: &usize| {
            kind_of(&files[*index]) == Some(NumberMeaning::Subframe)
                && whole.contains(&files[*index].sequence())
        };
        let is_shot_possible = members.len() > 1 && !members.iter().any(belongs_to_sequence);
        let numbers = compared_numbers(&stems, &found, is_shot_possible).unwrap_or_default();
        for (index, number) in members.iter().zip(numbers) {
            files[*index].number = Some(number);
        }
    }
}

/// Finds files of one name in several folders whose names are numbers: these are the numbers of the frames.
fn use_numbers_of_folders(files: &mut [FrameFile]) {
    let mut groups: HashMap<(PathBuf, String), Vec<(usize, FrameFile)>> = HashMap::new();
    for (index, file) in files.iter().enumerate() {
        if let Some(numbered) = file.numbered_by_folder() {
            groups.entry(numbered.sequence()).or_default().push((index, numbered));
        }
    }
    for (index, file) in groups.into_values().filter(|members| members.len() > 1).flatten() {
        let number = file.number.as_ref().map(|number| number.span.clone());
        let folder = number.and_then(|span| file.name().get(span).map(str::to_owned)).unwrap_or_default();
        let stem = format!("{}_{folder}", file.stem());
        files[index] = FrameFile { output_stem: Some(stem), ..file };
    }
}

/// Folders in which most of the sequences whose names differ only in numbers have a single frame, and the
/// number of these single-frame sequences.
pub fn single_frame_sequences(sequences: &[Sequence]) -> Vec<(PathBuf, usize)> {
    let mut counts: BTreeMap<(PathBuf, String), (usize, usize)> = BTreeMap::new();
    for sequence in sequences {
        if let Some(key) = sequence.frames.first().and_then(FrameFile::group_key) {
            let (count, single_count) = counts.entry(key).or_default();
            *count += 1;
            *single_count += usize::from(sequence.frames.len() == 1);
        }
    }
    let fallen_apart = counts.into_iter().filter(|(_, (count, single))| are_single_frames(*count, *single));
    fallen_apart.map(|((folder, _), (_, single_count))| (folder, single_count)).collect()
}

/// Whether at least two, and more than half, of `count` sequences whose names differ only in numbers have a
/// single frame.
pub fn are_single_frames(count: usize, single_count: usize) -> bool {
    single_count > 1 && 2 * single_count > count
}

/// The warning for a folder that [`single_frame_sequences`] returns.
pub fn single_frames_note(count: usize, choices: &MethodOptions) -> String {
    let (what, remedy) = measured_by(choices);
    format!(
        "{count} files form {count} sequences of one frame each, so each gets its own {what}; name the frame number with \
         a pattern such as dam_####_v003.ply, or give {remedy}"
    )
}

/// Whether a file name has the extension of a particle format.
pub fn has_particle_extension(name: &str) -> bool {
    stem(name).len() < name.len()
}

/// Whether the extension is used only for particle files, so that such a file without particles is invalid.
/// Readme files, logs and settings may have the other extensions, such as `.txt` and `.json`: only their content
/// shows what they are.
pub fn promises_particles(name: &str) -> bool {
    let name_without_suffix = name_without_compression(name).to_ascii_lowercase();
    let may_be_any_text =
        [".txt", ".dat", ".asc", ".json"].iter().any(|extension| name_without_suffix.ends_with(extension));
    has_particle_extension(name) && !may_be_any_text
}

/// Whether a file, or a pattern for files, has the extension of lists of files, such as `.pvd`.
pub fn is_named_list(path: &Path) -> bool {
    let extension = path.extension().unwrap_or_default();
    Format::VtkIndex.extensions().iter().any(|known| extension.eq_ignore_ascii_case(known))
}

/// The file name without its particle extension, if it has one. The content of a file determines its format;
/// extensions only determine where the stem ends, and which files in a folder are frames.
fn stem(name: &str) -> &str {
    let name_without_suffix = name_without_compression(name);
    let formats = Format::ALL.into_iter().filter(|format| format.has_particles());
    let extensions = formats.flat_map(Format::extensions);
    let stems = extensions.filter_map(|extension| strip_extension(name_without_suffix, extension));
    // Of `x.bgeo.sc`, `.bgeo.sc` leaves less than an extension `.sc` would.
    stems.min_by_key(|stem| stem.len()).unwrap_or(name)
}

/// The file name without its extension, for particle files and outputs.
fn numbered_part(name: &str) -> &str {
    let of_result = |format: OutputFormat| name.strip_suffix(format.extension())?.strip_suffix('.');
    let found = OutputFormat::ALL.into_iter().find_map(of_result).filter(|left| !left.is_empty());
    found.unwrap_or_else(|| stem(name))
}

/// `name` without `extension` (case-insensitive) and the point before it, if something is left.
fn strip_extension<'a>(name: &'a str, extension: &str) -> Option<&'a str> {
    let (stem, end) = name.split_at_checked(name.len().checked_sub(extension.len())?)?;
    let stem = stem.strip_suffix('.').filter(|stem| !stem.is_empty())?;
    end.eq_ignore_ascii_case(extension).then_some(stem)
}

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
            ("x.stl", "x.stl"),
            ("frame.0001", "frame.0001"),
            ("v1.5", "v1.5"),
            (".ply", ".ply"),
            ("größe.csv", "größe"),
        ] {
            assert_eq!(stem(name), expected, "{name}");
        }
    }

    #[test]
    fn stems_of_outputs_lose_the_extensions_of_surfaces_too() {
        let names = ["dam.0012.glb", "a.OBJ", "x.vdb", "x.bgeo.sc", ".stl"];
        assert_eq!(names.map(|name| file(name).stem()), ["dam.0012", "a", "x", "x", ".stl"]);
    }

    #[test]
    fn last_number_is_the_frame() {
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
    fn names_that_differ_in_the_last_number_form_a_sequence() {
        let names = ["d/b.2.ply", "d/a.10.ply", "d/a.9.ply", "e/a.11.ply", "d/a.1.csv", "d/single.ply"];
        let found: Vec<(String, Vec<Option<i64>>)> = sequences(names.map(file).to_vec())
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

    fn grouped(names: &[&str]) -> Vec<(String, Vec<String>)> {
        let group = |s: Sequence| (s.name, s.frames.iter().map(FrameFile::name).collect());
        let files: Vec<FrameFile> = names.iter().copied().map(file).collect();
        let found = sequences(files.clone());
        // The order in which files are found does not matter.
        assert_eq!(sequences(files.into_iter().rev().collect()), found);
        found.into_iter().map(group).collect()
    }

    #[test]
    fn ordinary_names_are_one_sequence() {
        for (names, sequence) in [
            (&["dam_0001_v003.ply", "dam_0002_v003.ply", "dam_0003_v003.ply"][..], "dam_{}_v003.ply"),
            (&["dam_0001_b7.ply", "dam_0002_b7.ply"], "dam_{}_b7.ply"),
            (&["dam.0001.50.ply", "dam.0002.ply", "dam.0002.05.ply", "dam.0002.5.ply"], "dam.{}.ply"),
            (&["f2_1_points.csv", "f2_2_points.csv", "f2_3_points.csv"], "f2_{}_points.csv"),
            (&["frame_1_particles.csv", "frame_20_particles.csv"], "frame_{}_particles.csv"),
        ] {
            let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
            let refs: Vec<&str> = names.iter().map(String::as_str).collect();
            assert_eq!(grouped(&refs), [(sequence.to_owned(), names)]);
        }
    }

    #[test]
    fn subframes_follow_their_frame_in_order() {
        assert_eq!(file("dam.0001.50.glb").number(), Some(1));
        let names = ["dam.0002.ply", "dam.0010.ply", "dam.0001.5.ply", "dam.0001.25.ply", "dam.0001.ply"];
        let [sequence] = &sequences(names.map(file).to_vec())[..] else { panic!("one sequence") };
        let order: Vec<_> = sequence.frames.iter().map(|file| (file.name(), file.number())).collect();
        let expected = [
            ("dam.0001.ply", 1),
            ("dam.0001.25.ply", 1),
            ("dam.0001.5.ply", 1),
            ("dam.0002.ply", 2),
            ("dam.0010.ply", 10),
        ];
        assert_eq!(order, expected.map(|(name, number)| (name.to_owned(), Some(number))));
        // Subframes of a single frame remain subframes.
        let names = ["dam.0001.25.ply", "dam.0001.50.ply"].map(file).to_vec();
        assert_eq!(sequences(names)[0].frames[1].number(), Some(1));
    }

    #[test]
    fn frames_of_a_shot_form_one_sequence_in_numeric_order() {
        for shot in ["shot.010", "shot.0100", "shot.1000"] {
            let names: Vec<String> = (1..=1200).map(|frame| format!("{shot}.{frame}.ply")).collect();
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            let [(name, found)] = &grouped(&names)[..] else { panic!("one sequence of {shot}") };
            assert_eq!(*name, format!("{shot}.{{}}.ply"));
            assert_eq!(*found, names);
            let found = sequences(names.iter().copied().map(file).collect());
            assert_eq!(found[0].frames[10].number(), Some(11));
        }
        // Whole frames show that these are subframes.
        let names = ["d.0001.ply", "d.0002.ply", "d.0002.1.ply", "d.0002.2.ply"];
        assert_eq!(grouped(&names).len(), 1);
    }

    #[test]
    fn counts_and_versions_keep_files_apart() {
        for names in [
            ["hilbert2_18856_particles.ply", "hilbert2_7954_particles.ply"],
            ["dam2_v001.ply", "dam2_v002.ply"],
            ["dam_1_2.ply", "dam_2_3.ply"],
        ] {
            assert_eq!(grouped(&names).len(), 2, "{names:?}");
            let found = sequences(names.map(file).to_vec());
            assert_eq!(single_frame_sequences(&found), [(PathBuf::new(), 2)], "{names:?}");
        }
        // One pair that happens to share a number does not prevent the warning.
        let names = ["s_1_2.ply", "s_2_3.ply", "s_3_5.ply", "s_3_6.ply"].map(file).to_vec();
        assert_eq!(single_frame_sequences(&sequences(names)), [(PathBuf::new(), 2)]);
        for names in [&["a.1.ply", "a.2.ply"][..], &["a.ply", "b.ply"], &["s1.1.ply", "s2.1.ply", "s2.2.ply"]]
        {
            let found = sequences(names.iter().copied().map(file).collect());
            assert_eq!(single_frame_sequences(&found), [], "{names:?}");
        }
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
        assert_eq!(numbers, [vec![Some(-5), Some(0), Some(1000)]]);
        assert_eq!(found[0].name, "d.7.dump.gz/step={}");
        assert_eq!(found[0].frames[0].sequence().0, Path::new("in"));
    }

    #[test]
    fn outputs_of_a_sequence_have_its_name_without_the_extension() {
        for (sequence, outputs) in [
            ("dam.{}.bgeo.gz", "dam.{}"),
            ("dam_{}_b7.ply", "dam_{}_b7"),
            ("dam.{}.vdb", "dam.{}"),
            ("{}.csv", "{}"),
            ("water.ply", "water"),
            ("dump.lammpstrj/step={}", "dump.{}"),
            ("run.0002.lammpstrj.gz/step={}", "run.0002.{}"),
        ] {
            assert_eq!(output_sequence(sequence), outputs, "{sequence}");
        }
        for path in ["in/dam.0012.bgeo.gz", "in/dump.lammpstrj/step=7"] {
            let (_, name) = file(path).sequence();
            assert_eq!(output_sequence(&name).replace("{}", "7"), file(path).stem().replace("0012", "7"));
        }
    }

    #[test]
    fn outputs_show_whether_a_path_is_that_of_a_step() {
        let steps = FrameFile::of_outputs("in/dump.lammpstrj/step=100".into(), "dump.100");
        assert_eq!((steps.number(), steps.file()), (Some(100), Path::new("in/dump.lammpstrj")));
        let named = FrameFile::of_outputs("in/dam/step=100".into(), "step=100");
        assert_eq!((named.number(), named.file()), (Some(100), Path::new("in/dam/step=100")));
        let plain = FrameFile::of_outputs("in/dam.7.ply".into(), "dam.7");
        assert_eq!((plain.number(), plain.file()), (Some(7), Path::new("in/dam.7.ply")));
    }

    #[test]
    fn given_number_may_be_anywhere_in_the_name() {
        let numbered = |path: &str, span| FrameFile::with_number_at(path.into(), span);
        let found = sequences(vec![numbered("f23_900.ply", 1..3), numbered("f9_900.ply", 1..2)]);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].name, "f{}_900.ply");
        assert_eq!(found[0].frames[0].number(), Some(9));
    }
}
