//! `meniscus render`: pictures of frames.
//!
//! ```text
//!   INPUT ──▶ sequences ──▶ a camera for each ──▶ frame ─┬─ surface: read ──────────┬─▶ one picture,
//!                                                        └─ particles: reconstruct ─┘   or a turntable
//! ```

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Result, anyhow, bail};

use crate::pipeline::{
    self, CameraChoice, FrameFile, OutputFormat, PictureOptions, Viewpoint, check_outputs, encode_picture,
    output_path,
};
use crate::surface::options::Settings;

use super::args::RenderArgs;
use super::console::Console;
use super::destination::{OutFolder, contradicts_format, names_file, refuse_stdout, write_file};
use super::inputs::{SelectedSequence, selected_files, selected_of};
use super::machine::thread_pool;
use super::render_session::{
    RenderSession, RenderSource, catch_panic, find_render_sources, named_picture, surface_name,
};
use super::settings::{Use, refuse_options};
use super::wording::{pluralize, with_causes};
use super::{CommandOutcome, DoneCounts};

/// Renders the requested pictures.
///
/// # Errors
/// If rendering cannot start, for example because an option is invalid. A failed frame is not an error here:
/// it is reported and counted.
pub(super) fn render(args: &RenderArgs, console: &mut Console) -> Result<CommandOutcome> {
    let found = find_render_sources(&args.inputs, args.pictures.method.to_options().columns.as_ref())?;
    found.report(console);
    let paths: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let sequences = selected_of(pipeline::sequences(found.files), args.frames.as_ref())?;
    let shots = RequestedPictures::new(args, &sequences)?;
    let outputs = &shots.session.outputs;
    shots.session.warn_of_ignored(&outputs.formats, console);
    let folder = OutFolder::make(&outputs.folder)?;
    let mut planned: Vec<(PathBuf, String)> = Vec::new();
    for file in selected_files(&sequences) {
        planned.extend(shots.stems(file).into_iter().map(|stem| (file.path.clone(), stem)));
    }
    check_outputs(&planned, &paths, &shots.session.obstacles, outputs, &[])?;
    folder.keep();
    let pool = thread_pool(args.pictures.run.threads)?;
    let mut counts = DoneCounts::default();
    for sequence in &sequences {
        pool.install(|| shots.take(sequence, &mut counts, console));
    }
    Ok(counts.outcome())
}

/// The requested pictures.
struct RequestedPictures<'a> {
    args: &'a RenderArgs,
    session: RenderSession<'a>,
    format: OutputFormat,
    /// The name of the picture of the only frame, if `--out` gives one.
    stem: Option<String>,
}

impl<'a> RequestedPictures<'a> {
    fn new(args: &'a RenderArgs, sequences: &[SelectedSequence]) -> Result<RequestedPictures<'a>> {
        refuse_stdout(&args.out)?;
        let (folder, stem, format) = if names_file(&args.out) {
            let named = named_picture(&args.out, &["png", "exr"]);
            let (folder, stem, extension) = named.map_err(|error| {
                let name = args.out.display();
                anyhow!("{error}; for a folder of this name, write {name}/ or create it first")
            })?;
            let format = OutputFormat::from_extension(extension).unwrap_or(OutputFormat::Png);
            if args.format.is_some_and(|other| other != format) {
                return Err(contradicts_format(&args.out, extension));
            }
            (folder, Some(stem), format)
        } else {
            (args.out.clone(), None, args.format.unwrap_or(OutputFormat::Png))
        };
        let session = RenderSession::new(&args.pictures, folder, format, args.size)?;
        let shots = RequestedPictures { args, session, format, stem };
        shots.check(sequences)?;
        Ok(shots)
    }

    fn check(&self, sequences: &[SelectedSequence]) -> Result<()> {
        let count = selected_files(sequences).count();
        if count > 1 && self.stem.is_some() {
            bail!("--out names one picture, but there are {count} frames: name a folder");
        }
        let mut files = sequences.iter().flat_map(|selected| &selected.sequence.frames);
        if files.clone().all(|file| surface_name(&file.path).is_some()) {
            refuse_options(&self.args.pictures.method, Use::Picture)?;
        }
        if self.args.particles
            && let Some((file, name)) = files.find_map(|file| Some((file, surface_name(&file.path)?)))
        {
            bail!("{}: --particles needs a particle file, and this is a {name}", file.path.display());
        }
        Ok(())
    }

    /// The names of the pictures of a frame.
    fn stems(&self, file: &FrameFile) -> Vec<String> {
        let of_file = file.stem();
        let stem = self.stem.as_deref().unwrap_or(&of_file);
        match self.args.turntable {
            None => vec![stem.to_owned()],
            Some(count) => (0..count).map(|index| format!("{stem}.{index:03}")).collect(),
        }
    }

    /// Renders the pictures of a sequence.
    fn take(&self, selected: &SelectedSequence, counts: &mut DoneCounts, console: &mut Console) {
        let prepared = self.session.prepare(&selected.sequence, self.picture_size(), console);
        let (settings, viewpoint) = match prepared {
            Ok(prepared) => prepared,
            Err(error) => {
                console.error(with_causes(&error));
                counts.failed_count += selected.selected.len();
                return;
            }
        };
        for file in &selected.selected {
            let start = Instant::now();
            let rendered =
                catch_panic(&file.path, || self.take_frame(file, settings.as_ref(), &viewpoint, console));
            counts.add(rendered.is_ok());
            match rendered {
                Ok(names) => {
                    let seconds = start.elapsed().as_secs_f64();
                    let what = match &names[..] {
                        [name] => name.strip_prefix(".").unwrap_or(name).display().to_string(),
                        names => pluralize(names.len(), "picture"),
                    };
                    console.print_line(format_args!("{}: {what}, {seconds:.2} s", file.path.display()));
                }
                Err(error) => console.error(with_causes(&error)),
            }
        }
    }

    /// The size of the picture of the surface, in pixels. If particles are shown beside it, it is the right
    /// half of the whole picture.
    fn picture_size(&self) -> [usize; 2] {
        let [width, height] = self.session.outputs.picture.size;
        [if self.args.particles { width - width / 2 } else { width }, height]
    }

    fn take_frame(
        &self,
        file: &FrameFile,
        settings: Option<&Settings>,
        viewpoint: &Viewpoint,
        console: &Console,
    ) -> Result<Vec<PathBuf>> {
        let source = self.session.source(file, settings, console)?;
        let outputs = &self.session.outputs;
        let mut written = Vec::new();
        let stems = self.stems(file);
        for (index, stem) in stems.iter().enumerate() {
            let rotated = viewpoint.rotated(360.0 * index as f64 / stems.len() as f64);
            let viewpoint = if index == 0 { *viewpoint } else { rotated };
            let path = output_path(&outputs.folder, stem, outputs.formats[0]);
            let (bytes, is_empty) = self.encoded(&source, file, &viewpoint)?;
            if is_empty {
                let input = file.path.display();
                match source.empty_part() {
                    Some(part) => {
                        console.warning(format_args!("{input}: the {part} is empty, and so is {stem}"))
                    }
                    None => console.warning(format_args!("{input}: nothing is in view in {stem}")),
                }
            }
            write_file(&path, |out| out.write_all(&bytes))?;
            written.push(path);
        }
        Ok(written)
    }

    /// The bytes of a picture, and whether it is empty.
    fn encoded(
        &self,
        source: &RenderSource,
        file: &FrameFile,
        viewpoint: &Viewpoint,
    ) -> Result<(Vec<u8>, bool)> {
        let options =
            PictureOptions { camera: CameraChoice::from(*viewpoint), ..self.session.outputs.picture };
        let picture = if self.args.particles {
            source.picture_beside_particles(viewpoint, options.size)
        } else {
            source.picture(viewpoint, options.size, self.format.has_attributes())
        };
        let provenance = source.provenance(&file.path, &options);
        // Two pictures side by side have no common projection matrix.
        let camera = (!self.args.particles).then_some(viewpoint);
        let is_empty = picture.coverage.iter().all(|&part| part == 0.0);
        Ok((encode_picture(&picture, camera, self.format, &provenance)?, is_empty))
    }
}
