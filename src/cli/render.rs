//! `meniscus render`: pictures of frames.
//!
//! ```text
//!   INPUT ──▶ sequences ──▶ a camera for each ──▶ frame ─┬─ .vdb: read ──────┬─▶ pictures: one, or once around
//!                                                        └─ particles: skin ─┘
//! ```

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result, bail};

use crate::pipeline::{
    self, CameraChoice, FrameFile, OutputFormat, PictureOptions, Sequence, Viewpoint, check_outputs,
    encode_picture, is_level_set, output_path, write_whole,
};
use crate::surface::options::Settings;

use super::Verdict;
use super::args::RenderArgs;
use super::choices::refuse_stray_rounds;
use super::console::Console;
use super::convert::thread_pool;
use super::frame_selection::FrameSelection;
use super::interrupt::clean_up_when_interrupted;
use super::out_folder::OutFolder;
use super::resurfacing::refuse_method;
use super::studio::{Studio, Subject, caught, find_subjects, named_picture};
use super::wording::{counted, with_causes};

/// Takes the pictures that the arguments ask for.
///
/// # Errors
/// When nothing can be done at all. A frame that fails is told, and counted.
pub(super) fn render(args: &RenderArgs, console: &mut Console) -> Result<Verdict> {
    clean_up_when_interrupted();
    refuse_stray_rounds(&args.method, &args.inputs)?;
    let found = find_subjects(&args.inputs)?;
    found.report(console);
    let paths: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let sequences = pipeline::sequences(found.files);
    let shots = Shots::new(args, &sequences)?;
    let outputs = &shots.studio.outputs;
    shots.studio.warn_of_ignored(&outputs.formats, console);
    let folder = OutFolder::make(&outputs.folder)?;
    let planned = sequences.iter().flat_map(|sequence| shots.selected(sequence));
    let planned: Vec<(PathBuf, String)> = planned
        .flat_map(|file| shots.stems(file).into_iter().map(|stem| (file.path.clone(), stem)))
        .collect();
    check_outputs(&planned, &paths, &shots.studio.obstacles, outputs, None)?;
    folder.keep();
    let pool = thread_pool(args.run.threads)?;
    let (mut done_count, mut failed_count) = (0, 0);
    for sequence in &sequences {
        let (done, failed) = pool.install(|| shots.take(sequence, console))?;
        done_count += done;
        failed_count += failed;
    }
    Ok(match (failed_count, done_count) {
        (0, _) => Verdict::Done,
        (_, 0) => Verdict::NothingDone,
        _ => Verdict::SomeFailed,
    })
}

/// The pictures that were asked for.
struct Shots<'a> {
    args: &'a RenderArgs,
    studio: Studio<'a>,
    format: OutputFormat,
    /// What the picture of the only frame is called, where it has a name.
    stem: Option<String>,
}

impl<'a> Shots<'a> {
    fn new(args: &'a RenderArgs, sequences: &[Sequence]) -> Result<Shots<'a>> {
        let (folder, stem, format) = match (&args.output, &args.out) {
            (Some(file), _) => {
                let (folder, stem, extension) = named_picture(file, &["png", "exr"])?;
                let format = OutputFormat::from_extension(extension).unwrap_or(OutputFormat::Png);
                (folder, Some(stem), format)
            }
            (None, Some(folder)) => {
                (folder.clone(), None, args.format.map_or(OutputFormat::Png, |format| format.0))
            }
            (None, None) => bail!("--output or --out is missing: where the picture goes"),
        };
        let studio = Studio::new(&args.method, (&args.view, &args.run), (folder, format, args.size))?;
        let shots = Shots { args, studio, format, stem };
        shots.check(sequences)?;
        Ok(shots)
    }

    fn check(&self, sequences: &[Sequence]) -> Result<()> {
        let count = sequences.iter().flat_map(|sequence| self.selected(sequence)).count();
        if count == 0 {
            bail!("--frames selects none of the frames");
        }
        if count > 1 && self.stem.is_some() {
            bail!("-o names one picture, and there are {count} frames: give --out with a folder");
        }
        let mut files = sequences.iter().flat_map(|sequence| &sequence.frames);
        if files.clone().all(|file| is_level_set(&file.path)) {
            refuse_method(&self.args.method)?;
        }
        if self.args.particles
            && let Some(file) = files.find(|file| is_level_set(&file.path))
        {
            bail!("{}: --particles is for files of particles, and this is a level set", file.path.display());
        }
        Ok(())
    }

    fn selected<'s>(&self, sequence: &'s Sequence) -> impl Iterator<Item = &'s FrameFile> {
        let frames = self.args.frames.clone();
        sequence.frames.iter().filter(move |file| FrameSelection::takes(frames.as_ref(), file))
    }

    /// What the pictures of a frame are called.
    fn stems(&self, file: &FrameFile) -> Vec<String> {
        let of_file = file.stem();
        let stem = self.stem.as_deref().unwrap_or(&of_file);
        match self.args.turntable {
            None => vec![stem.to_owned()],
            Some(count) => (0..count).map(|index| format!("{stem}.{index:03}")).collect(),
        }
    }

    /// Takes the pictures of a sequence. How many frames are done, and how many failed.
    fn take(&self, sequence: &Sequence, console: &mut Console) -> Result<(usize, usize)> {
        let (mut done_count, mut failed_count) = (0, 0);
        let frames: Vec<&FrameFile> = self.selected(sequence).collect();
        if frames.is_empty() {
            return Ok((0, 0));
        }
        let prepared = self.studio.settings(sequence, console).and_then(|settings| {
            let viewpoint = self.studio.viewpoint(sequence, settings.as_ref(), self.picture_size())?;
            Ok((settings, viewpoint))
        });
        let (settings, viewpoint) = match prepared {
            Ok(prepared) => prepared,
            Err(error) => {
                console.warn(format_args!("error: {}", with_causes(&error)));
                return Ok((0, frames.len()));
            }
        };
        for file in frames {
            let start = Instant::now();
            let taken = caught(&file.path, || self.take_frame(file, settings.as_ref(), &viewpoint, console));
            match taken {
                Ok(names) => {
                    done_count += 1;
                    let seconds = start.elapsed().as_secs_f64();
                    let what = match &names[..] {
                        [name] => name.strip_prefix(".").unwrap_or(name).display().to_string(),
                        names => counted(names.len(), "picture"),
                    };
                    console.say(format_args!("{}: {what}, {seconds:.2} s", file.path.display()));
                }
                Err(error) => {
                    failed_count += 1;
                    console.warn(format_args!("error: {}", with_causes(&error)));
                }
            }
        }
        Ok((done_count, failed_count))
    }

    /// Of two pictures side by side, the right one.
    fn picture_size(&self) -> [usize; 2] {
        let [width, height] = self.studio.outputs.picture.size;
        [if self.args.particles { width - width / 2 } else { width }, height]
    }

    fn take_frame(
        &self,
        file: &FrameFile,
        settings: Option<&Settings>,
        viewpoint: &Viewpoint,
        console: &Console,
    ) -> Result<Vec<PathBuf>> {
        let subject = self.studio.subject(file, settings)?;
        self.studio.print_warnings(file, &subject, console);
        let outputs = &self.studio.outputs;
        let mut written = Vec::new();
        let stems = self.stems(file);
        for (index, stem) in stems.iter().enumerate() {
            let turned = viewpoint.turned(360.0 * index as f64 / stems.len() as f64);
            let viewpoint = if index == 0 { *viewpoint } else { turned };
            let path = output_path(&outputs.folder, stem, outputs.formats[0]);
            let (bytes, is_empty) = self.encoded(&subject, file, &viewpoint)?;
            if is_empty {
                console.warn(format_args!("warning: {}: nothing is in view in {stem}", file.path.display()));
            }
            write_whole(&path, |out| Ok(std::io::Write::write_all(out, &bytes)?))
                .with_context(|| format!("{}: cannot write", path.display()))?;
            written.push(path);
        }
        Ok(written)
    }

    /// The bytes of a picture, and whether it shows nothing.
    fn encoded(&self, subject: &Subject, file: &FrameFile, viewpoint: &Viewpoint) -> Result<(Vec<u8>, bool)> {
        let options =
            PictureOptions { camera: CameraChoice::from(*viewpoint), ..self.studio.outputs.picture };
        let picture = match self.args.particles {
            true => subject.picture_beside_particles(viewpoint, options.size),
            false => subject.picture(viewpoint, options.size, self.format.has_attributes()),
        };
        let provenance = subject.provenance(&file.path, &options);
        // Side by side are two pictures, and no matrix leads to both.
        let camera = (!self.args.particles).then_some(viewpoint);
        let is_empty = picture.coverage.iter().all(|&part| part == 0.0);
        Ok((encode_picture(&picture, camera, self.format, &provenance)?, is_empty))
    }
}
