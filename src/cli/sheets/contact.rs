//! `meniscus contact-sheet`: an overview of a sequence on one picture.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Result, bail};

use crate::cli::args::{ContactSheetArgs, MethodArgs, PictureArgs};
use crate::cli::console::Console;
use crate::cli::frame_selection::FrameSelection;
use crate::cli::inputs::{MatchedInputs, find_with_others, refuse_times};
use crate::cli::machine::{memory_bytes, thread_pool};
use crate::cli::render_session::{RenderSession, RenderSource, catch_panic, surfaces_in};
use crate::cli::wording::{counted_are, pluralize, significant, with_causes};
use crate::cli::{CommandOutcome, DoneCounts};
use crate::pipeline::{
    FrameFile, PictureOptions, Sequence, SheetPart, Viewpoint, camera_of_picture, files_in, is_level_set,
    is_mesh, natural_order, read_picture, sequences,
};
use crate::render::{Cell, CellGroup, CellPicture, Picture, Sheet};
use crate::surface::options::{ColumnNames, Settings};

use super::{SheetFile, even_columns, fixed, reason, refuse_large};

/// Puts the selected frames on a sheet.
///
/// # Errors
/// If no frame can be attempted. A frame that fails is reported and counted.
pub(in crate::cli) fn contact_sheet(
    args: &ContactSheetArgs,
    console: &mut Console,
) -> Result<CommandOutcome> {
    let Sources { strips, files, found } = find_sources(
        &args.inputs,
        args.pictures.method.to_options().columns.as_ref(),
        kinds(&args.pictures),
    )?;
    found.report(console);
    let selected_strips = select_frames(strips, args)?;
    let cell_count = selected_strips.iter().map(|strip| strip.frames.len()).sum();
    refuse_large(cell_count, args.size, memory_bytes(args.pictures.run.memory)?)?;
    let (file, session) = SheetFile::prepare(&args.out, &args.pictures, args.size, &files, None, console)?;
    let contact = Contact { args, session };
    console.show_bar(cell_count);
    let pool = thread_pool(args.pictures.run.threads)?;
    let mut counts = DoneCounts::default();
    let parts: Vec<SequenceRows> = selected_strips
        .into_iter()
        .map(|selected_strip| pool.install(|| contact.part(selected_strip, &mut counts, console)))
        .collect();
    console.hide_bar();
    if counts.done_count > 0 {
        for part in &parts {
            console.print_line(part.title_with_time());
        }
        let made_from: Vec<SheetPart> = parts.iter().map(SequenceRows::made_from).collect();
        console.print_line(file.write(&contact.sheet(parts), "contact-sheet", &made_from)?);
    }
    Ok(counts.outcome())
}

/// The kinds of files that the sheet may be made from. Surface options require particles, because the others
/// already contain a surface. Camera options exclude pictures, which already have a camera.
fn kinds(PictureArgs { camera, camera_from, up, method, .. }: &PictureArgs) -> &'static [SourceKind] {
    if *method != MethodArgs::default() {
        &[SourceKind::Particles]
    } else if camera.is_some() || camera_from.is_some() || up.is_some() {
        &[SourceKind::LevelSets, SourceKind::Meshes, SourceKind::Particles]
    } else {
        &[SourceKind::Pictures, SourceKind::LevelSets, SourceKind::Meshes, SourceKind::Particles]
    }
}

/// A sequence, and its frames on the sheet.
struct SelectedStrip {
    strip: Strip,
    /// The number of selected frames.
    selected_count: usize,
    frames: Vec<FrameFile>,
}

fn select_frames(strips: Vec<Strip>, args: &ContactSheetArgs) -> Result<Vec<SelectedStrip>> {
    refuse_times(args.frames.as_ref(), strips.iter().map(|strip| &strip.sequence))?;
    let is_selected = |file: &&FrameFile| FrameSelection::takes(args.frames.as_ref(), file);
    let selected_strips = strips.into_iter().map(|strip| {
        let selected: Vec<FrameFile> = strip.sequence.frames.iter().filter(is_selected).cloned().collect();
        let indices = evenly(selected.len(), usize::from(args.count));
        let frames = indices.into_iter().map(|index| selected[index].clone()).collect();
        SelectedStrip { strip, selected_count: selected.len(), frames }
    });
    let selected_strips: Vec<SelectedStrip> =
        selected_strips.filter(|strip| !strip.frames.is_empty()).collect();
    if selected_strips.is_empty() {
        bail!("--frames selects none of the frames");
    }
    Ok(selected_strips)
}

/// The indices of at most `most` out of `count` items, evenly spaced, including the first and the last.
fn evenly(count: usize, most: usize) -> Vec<usize> {
    if count <= most {
        return (0..count).collect();
    }
    let last = most.saturating_sub(1).max(1);
    (0..most).map(|index| (index * (count - 1) + last / 2) / last).collect()
}

/// The cells of a sequence.
struct SequenceRows {
    selected_strip: SelectedStrip,
    cells: Vec<Cell>,
    settings: Option<Settings>,
    options: Option<PictureOptions>,
    /// The rendering time.
    seconds: f64,
}

impl SequenceRows {
    /// Whether it is a single file and not a sequence.
    fn is_single(&self) -> bool {
        self.selected_strip.strip.sequence.frames.len() == 1
    }

    fn title(&self) -> String {
        format!("{}: {}", self.selected_strip.strip.name, self.what())
    }

    /// The title and the rendering time. The time differs from run to run, so it is not part of the picture.
    fn title_with_time(&self) -> String {
        match self.selected_strip.strip.kind {
            SourceKind::Pictures => self.title(),
            _ => format!("{}, {:.2} s", self.title(), self.seconds),
        }
    }

    /// The number of frames, the kind of files that they are made from, and the voxel size if it is known.
    fn what(&self) -> String {
        let SelectedStrip { strip, selected_count, frames } = &self.selected_strip;
        let selected = pluralize(*selected_count, "frame");
        let frames = if frames.len() == *selected_count {
            selected
        } else {
            format!("{} of {selected}", frames.len())
        };
        let kind = strip.kind.name();
        let voxels = self
            .settings
            .as_ref()
            .map_or(String::new(), |settings| format!(", voxel size {}", significant(settings.voxel_size)));
        format!("{frames}, from {kind}{voxels}")
    }

    fn made_from(&self) -> SheetPart {
        let name = self.selected_strip.strip.name.clone();
        SheetPart {
            name,
            hash: None,
            what: self.what(),
            settings: self.settings.clone(),
            options: self.options,
        }
    }
}

/// What all sequences of a sheet share.
struct Contact<'a> {
    args: &'a ContactSheetArgs,
    session: RenderSession<'a>,
}

impl Contact<'_> {
    /// The cells of a sequence. If it has no settings or no camera, no cell has a picture.
    fn part(
        &self,
        selected_strip: SelectedStrip,
        counts: &mut DoneCounts,
        console: &mut Console,
    ) -> SequenceRows {
        let start = Instant::now();
        let prepared = self.prepared(&selected_strip.strip, console);
        if let Err(error) = &prepared {
            console.error(with_causes(error));
        }
        let cells = selected_strip.frames.iter().map(|file| {
            let rendered = match &prepared {
                Ok((settings, viewpoint)) => catch_panic(&file.path, || {
                    let kind = selected_strip.strip.kind;
                    self.picture(file, kind, settings.as_ref(), viewpoint.as_ref(), console)
                }),
                Err(error) => Err(anyhow::anyhow!(with_causes(error))),
            };
            console.advance_bar();
            counts.add(rendered.is_ok());
            if let (Ok(_), Err(error)) = (&prepared, &rendered) {
                console.error(with_causes(error));
            }
            cell(file, selected_strip.strip.kind, rendered)
        });
        let cells = cells.collect();
        let (settings, viewpoint) = prepared.unwrap_or_default();
        let options = viewpoint.map(|viewpoint| fixed(&self.session, viewpoint));
        SequenceRows { selected_strip, cells, settings, options, seconds: start.elapsed().as_secs_f64() }
    }

    /// The settings and the camera that all pictures of a sequence share. Existing pictures need neither.
    fn prepared(&self, strip: &Strip, console: &Console) -> Result<(Option<Settings>, Option<Viewpoint>)> {
        if strip.kind == SourceKind::Pictures {
            return Ok((None, None));
        }
        let size = self.session.outputs.picture.size;
        let (settings, viewpoint) = self.session.prepare(&strip.sequence, size, console)?;
        Ok((settings, Some(viewpoint)))
    }

    /// The picture of a frame, and its number of particles if known.
    fn picture(
        &self,
        file: &FrameFile,
        kind: SourceKind,
        settings: Option<&Settings>,
        viewpoint: Option<&Viewpoint>,
        console: &Console,
    ) -> Result<(Picture, Option<usize>)> {
        let size = self.session.outputs.picture.size;
        let Some(viewpoint) = viewpoint.filter(|_| kind != SourceKind::Pictures) else {
            return Ok((read_picture(&file.path)?.scaled_to_fit(size), None));
        };
        let source = self.session.source(file, settings, console)?;
        let particle_count = match &source {
            RenderSource::LevelSet(_) | RenderSource::Mesh(_) => None,
            RenderSource::Reconstructed(reconstructed) => Some(reconstructed.frame.particles().len()),
        };
        Ok((source.picture(viewpoint, size, false), particle_count))
    }

    /// Sequences below each other, and single files side by side.
    fn sheet(&self, parts: Vec<SequenceRows>) -> Sheet {
        let block = |title: String, cells: Vec<Cell>| {
            let columns = self.args.per_row.map_or(even_columns(cells.len()), usize::from);
            CellGroup { title, cells, columns }
        };
        let (singles, sequences): (Vec<SequenceRows>, Vec<SequenceRows>) =
            parts.into_iter().partition(SequenceRows::is_single);
        let counts: Vec<String> = [(sequences.len(), "sequence"), (singles.len(), "file")]
            .into_iter()
            .filter(|(count, _)| *count > 0)
            .map(|(count, noun)| pluralize(count, noun))
            .collect();
        let mut blocks: Vec<CellGroup> =
            sequences.into_iter().map(|part| block(part.title(), part.cells)).collect();
        let of_singles = match &singles[..] {
            [part] => part.title(),
            parts => pluralize(parts.len(), "single file"),
        };
        let cells: Vec<Cell> = singles.into_iter().flat_map(|part| part.cells).collect();
        if !cells.is_empty() {
            blocks.push(block(of_singles, cells));
        }
        // If there is only one block, its title becomes that of the sheet.
        let title = match &mut blocks[..] {
            [block] => std::mem::take(&mut block.title),
            _ => counts.join(" and "),
        };
        Sheet { title, picture_size: self.args.size.map(usize::from), blocks, footer: Vec::new() }
    }
}

/// A picture with its frame's name, and the number of particles if known.
fn cell(file: &FrameFile, kind: SourceKind, rendered: Result<(Picture, Option<usize>)>) -> Cell {
    let mut lines = vec![stem_of(file, kind)];
    let content = match rendered {
        Ok((picture, particle_count)) => {
            lines.extend(particle_count.map(|count| pluralize(count, "particle")));
            CellPicture::Picture(picture)
        }
        Err(error) => CellPicture::Text(reason(&error, &file.path)),
    };
    Cell { content, lines }
}

// Chooses which file represents each frame on a contact sheet.
//
// ```text
//   dam.0001.png   dam.0001.vdb   dam.0001.bgeo     the same frame: a picture is cheapest, then a level set,
//   dam.0002.png   dam.0002.vdb   dam.0002.bgeo     a mesh, and particles, which must be converted
//                  dam.0003.vdb   dam.0003.bgeo
//                       ▲
//                       one kind for the whole sequence: the one with the most frames, then the cheapest
// ```
//
// All cells of a sequence share one camera. Existing pictures with different cameras are used only if the
// sequence has no other files.

/// The kinds of files of a frame, the cheapest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum SourceKind {
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
struct Strip {
    /// The common part of the frames' names, such as `dam`.
    pub(super) name: String,
    pub(super) kind: SourceKind,
    pub(super) sequence: Sequence,
}

/// The result of the search.
#[derive(Debug, Default)]
struct Sources {
    /// In natural order.
    strips: Vec<Strip>,
    /// Every file that was found, used or not.
    pub(super) files: Vec<PathBuf>,
    /// The rest of the search: unreadable paths, and warnings.
    pub(super) found: MatchedInputs,
}

/// Finds the frames of these kinds that the inputs name.
///
/// # Errors
/// If an input names no frame.
fn find_sources(inputs: &[PathBuf], columns: Option<&ColumnNames>, kinds: &[SourceKind]) -> Result<Sources> {
    let add = |found: &mut MatchedInputs, files, _: &Path| {
        found.add(MatchedInputs { files, ..MatchedInputs::default() })
    };
    let mut found = find_with_others(inputs, columns, surfaces_and_pictures_in, add)?;
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
fn stem_of(file: &FrameFile, kind: SourceKind) -> String {
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
    fn evenly_spaced_indices_include_first_and_last() {
        assert_eq!(evenly(5, 60), [0, 1, 2, 3, 4]);
        assert_eq!(evenly(0, 60), [0; 0]);
        assert_eq!(evenly(240, 2), [0, 239]);
        assert_eq!(evenly(9, 5), [0, 2, 4, 6, 8]);
        for (count, most) in [(61, 60), (240, 60), (10_000, 7), (1001, 1000)] {
            let indices = evenly(count, most);
            assert_eq!((indices.len(), indices[0], indices[most - 1]), (most, 0, count - 1));
            let steps: Vec<usize> = indices.windows(2).map(|pair| pair[1] - pair[0]).collect();
            let (least, greatest) = (steps.iter().min(), steps.iter().max());
            assert!(greatest.zip(least).is_some_and(|(g, l)| *l > 0 && g - l <= 1), "{count} {most}");
        }
    }

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
