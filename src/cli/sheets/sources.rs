//! Chooses which file represents each frame on a contact sheet.
//!
//! ```text
//!   dam.0001.png   dam.0001.vdb   dam.0001.bgeo     the same frame: a picture is cheapest, then a level set,
//!   dam.0002.png   dam.0002.vdb   dam.0002.bgeo     a mesh, and particles, which must be converted
//!                  dam.0003.vdb   dam.0003.bgeo
//!                       ▲
//!                       one kind for the whole sequence: the one with the most frames, then the cheapest
//! ```
//!
//! All cells of a sequence share one camera. Existing pictures with different cameras are used only if the
//! sequence has no other files.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

use crate::cli::inputs::{MatchedInputs, find_with_others};
use crate::cli::render_session::surfaces_in;
use crate::cli::wording::counted_are;
use crate::pipeline::{
    FrameFile, Sequence, camera_of_picture, files_in, is_level_set, is_mesh, natural_order, sequences,
};

/// The kinds of files of a frame, the cheapest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum SourceKind {
    Pictures,
    LevelSets,
    Meshes,
    Particles,
}

impl SourceKind {
    fn of(path: &Path) -> SourceKind {
        if is_level_set(path) {
            SourceKind::LevelSets
        } else if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) {
            SourceKind::Pictures
        } else if is_mesh(path) {
            SourceKind::Meshes
        } else {
            SourceKind::Particles
        }
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            SourceKind::Pictures => "pictures",
            SourceKind::LevelSets => "level sets",
            SourceKind::Meshes => "meshes",
            SourceKind::Particles => "particles",
        }
    }
}

/// A sequence, and the kind of its files.
#[derive(Clone, Debug)]
pub(super) struct Strip {
    /// The common part of the frames' names, such as `dam`.
    pub(super) name: String,
    pub(super) kind: SourceKind,
    pub(super) sequence: Sequence,
}

/// The result of the search.
#[derive(Debug, Default)]
pub(super) struct Sources {
    /// In natural order.
    pub(super) strips: Vec<Strip>,
    /// Every file that was found, used or not.
    pub(super) files: Vec<PathBuf>,
    /// The rest of the search: unreadable paths, and warnings.
    pub(super) found: MatchedInputs,
}

/// Finds the frames of these kinds that the inputs name.
///
/// # Errors
/// If an input names no frame.
pub(super) fn find_sources(inputs: &[PathBuf], kinds: &[SourceKind]) -> Result<Sources> {
    let add = |found: &mut MatchedInputs, files, _: &Path| {
        found.add(MatchedInputs { files, ..MatchedInputs::default() })
    };
    let mut found = find_with_others(inputs, surfaces_and_pictures_in, add)?;
    let files: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let kind_of = |file: FrameFile| (SourceKind::of(&file.path), file);
    let all_files: Vec<(SourceKind, FrameFile)> =
        std::mem::take(&mut found.files).into_iter().map(kind_of).collect();
    let mut strips_of: HashMap<(PathBuf, String), Vec<Strip>> = HashMap::new();
    for kind in kinds {
        let of_kind = all_files.iter().filter(|(of_file, _)| of_file == kind);
        for sequence in sequences(of_kind.map(|(_, file)| file.clone()).collect()) {
            let (folder, name) = sequence.frames[0].sequence();
            let (base, name) = (without_extension(&name, *kind), &*sequence.name);
            let name = if sequence.frames.len() > 1 { common_name(&base) } else { name.to_owned() };
            let strip = Strip { name, kind: *kind, sequence };
            strips_of.entry((folder, base)).or_default().push(strip);
        }
    }
    let mut strips: Vec<Strip> = Vec::new();
    for same in strips_of.into_values() {
        let stems = |strip: &Strip| -> HashSet<String> {
            let frames = strip.sequence.frames.iter();
            frames.map(|file| stem_of(file, strip.kind)).collect()
        };
        let all: HashSet<String> = same.iter().flat_map(&stems).collect();
        let Some(strip) = cheapest(same) else { continue };
        let left_out = all.len() - stems(&strip).len();
        if left_out > 0 {
            found.warnings.push(format!(
                "{}: {} not available as {}, and left out",
                strip.name,
                counted_are(left_out as u64),
                strip.kind.name()
            ));
        }
        strips.push(strip);
    }
    found.warnings.sort();
    let first = |strip: &Strip| strip.sequence.frames[0].path.to_string_lossy().into_owned();
    strips.sort_by(|a, b| natural_order(&first(a), &first(b)));
    if strips.is_empty() {
        let names: Vec<&str> = kinds.iter().map(|kind| kind.name()).collect();
        bail!("there are no {} among the {} frames found", names.join(" or "), files.len());
    }
    Ok(Sources { strips, files, found })
}

/// The level sets and meshes in a folder, and the pictures that meniscus rendered; empty if the path is not a
/// folder.
fn surfaces_and_pictures_in(folder: &Path) -> Result<Vec<FrameFile>> {
    let mut others = surfaces_in(folder);
    if folder.is_dir() {
        let is_picture = |path: &PathBuf| camera_of_picture(path).is_some();
        others.extend(files_in(folder)?.into_iter().filter(is_picture).map(FrameFile::new));
    }
    Ok(others)
}

/// The sequence with the most frames; of several such sequences, the cheapest.
fn cheapest(strips: Vec<Strip>) -> Option<Strip> {
    let is_only_one = strips.len() == 1;
    let of_use = strips.into_iter().filter(|strip| is_only_one || has_one_camera(strip));
    of_use.min_by_key(|strip| (usize::MAX - strip.sequence.frames.len(), strip.kind))
}

/// Whether all pictures of this strip share a camera. Pictures that are still to be rendered always do.
fn has_one_camera(strip: &Strip) -> bool {
    if strip.kind != SourceKind::Pictures {
        return true;
    }
    let mut cameras = strip.sequence.frames.iter().map(|file| camera_of_picture(&file.path));
    let first = cameras.next().flatten();
    first.is_some() && cameras.all(|camera| camera == first)
}

/// The name of a frame, without the extensions of its kind.
pub(super) fn stem_of(file: &FrameFile, kind: SourceKind) -> String {
    if kind == SourceKind::Particles { file.stem() } else { without_extension(&file.name(), kind) }
}

/// The name of a file, without the extensions of its kind.
fn without_extension(name: &str, kind: SourceKind) -> String {
    match kind {
        SourceKind::Pictures => name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_owned(),
        _ => FrameFile::new(name.into()).stem(),
    }
}

/// The name without the placeholder of the frame number: `dam` for `dam.{}`.
fn common_name(base: &str) -> String {
    let name = base.replace("{}", "");
    let name = name.trim_matches(['.', '_', '-']);
    if name.is_empty() { base.to_owned() } else { name.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extensions_of_the_kind_are_removed() {
        for (name, kind, expected) in [
            ("dam.0001.png", SourceKind::Pictures, "dam.0001"),
            ("dam.0001.vdb", SourceKind::LevelSets, "dam.0001"),
            ("dam.0001.bgeo.gz", SourceKind::Particles, "dam.0001"),
            ("dam.{}.ply", SourceKind::Particles, "dam.{}"),
            ("dam.{}.glb", SourceKind::Meshes, "dam.{}"),
        ] {
            assert_eq!(without_extension(name, kind), expected);
        }
        for (base, expected) in [("dam.{}", "dam"), ("{}", "{}"), ("shot_{}_fluid", "shot__fluid")] {
            assert_eq!(common_name(base), expected);
        }
    }

    #[test]
    fn kind_with_most_frames_is_chosen_then_the_cheapest() {
        let strip = |kind, count: usize| {
            let frames = (0..count).map(|n| FrameFile::new(format!("there/dam.{n}.vdb").into())).collect();
            Strip { name: "dam".into(), kind, sequence: Sequence { name: "dam.{}".into(), frames } }
        };
        let chosen = |strips: &[(SourceKind, usize)]| {
            let strips = strips.iter().map(|&(kind, count)| strip(kind, count)).collect();
            cheapest(strips).map(|strip| strip.kind)
        };
        assert_eq!(
            chosen(&[(SourceKind::Meshes, 3), (SourceKind::LevelSets, 3), (SourceKind::Particles, 3)]),
            Some(SourceKind::LevelSets)
        );
        assert_eq!(chosen(&[(SourceKind::Meshes, 3), (SourceKind::Particles, 3)]), Some(SourceKind::Meshes));
        assert_eq!(
            chosen(&[(SourceKind::LevelSets, 2), (SourceKind::Particles, 3)]),
            Some(SourceKind::Particles)
        );
        // These pictures do not record their camera.
        assert_eq!(
            chosen(&[(SourceKind::Pictures, 3), (SourceKind::Particles, 3)]),
            Some(SourceKind::Particles)
        );
        assert_eq!(chosen(&[(SourceKind::Pictures, 3)]), Some(SourceKind::Pictures));
        assert_eq!(chosen(&[]), None);
    }
}
