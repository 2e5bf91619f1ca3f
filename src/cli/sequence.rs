//! Combines the frames of a sequence into one file: `meniscus sequence`, and `meniscus convert --sequence`.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

use crate::pipeline::{
    FrameFile, OutputFormat, OutputOptions, SequenceFormat, SequenceReport, SequenceSource, are_same_file,
    check_sequence_path, is_sequence_file, write_sequence_file,
};

use super::CommandOutcome;
use super::args::{ConvertArgs, FPS, SequenceArgs};
use super::console::Console;
use super::frame_selection::missing_numbers;
use super::inputs::{check_output_path, find_inputs, only_sequence, with_files_of_folders};
use super::machine::thread_pool;
use super::wording::{counted_are, pluralize};

/// Combines the frames that the arguments name.
///
/// # Errors
/// If no sequence file can be made.
pub(super) fn sequence(args: &SequenceArgs, console: &mut Console) -> Result<CommandOutcome> {
    let format = format_of(&args.out)?;
    check_output_path("the sequence file", &args.out)?;
    // Of a folder with several formats, the files of the first one in this list are used.
    let formats: &[&[&str]] = &[&["glb"], &["abc"], &["usdc"]];
    let inputs = with_files_of_folders(&args.inputs, formats, ".glb, .abc or .usdc files of frames")?;
    let found = find_inputs(&inputs, None)?;
    found.report(console);
    let frames = without_old_sequence_file(found.files, &args.out)?;
    let sequence = only_sequence(frames, "a sequence file holds one sequence")?;
    let source = |file: &FrameFile| SequenceSource { path: file.path.clone(), number: file.number() };
    let sources: Vec<SequenceSource> = sequence.frames.iter().map(source).collect();
    let shot = thread_pool(None)?.install(|| write_sequence_file(&args.out, format, &sources, args.fps))?;
    warn_gaps(&args.out, &sources, console);
    report_sequence(&args.out, &shot, console);
    Ok(if shot.left_out.is_empty() { CommandOutcome::Done } else { CommandOutcome::SomeFailed })
}

/// # Errors
/// If the name does not end like that of a sequence file.
fn format_of(path: &Path) -> Result<SequenceFormat> {
    SequenceFormat::of(path).with_context(|| {
        format!(
            "{}: the name of a sequence file must end in .glb or .abc; for USD, `meniscus convert --stage` writes a stage \
             that plays the frames",
            path.display()
        )
    })
}

/// These files without `output`: a pattern may match the old sequence file, which the new one replaces.
///
/// # Errors
/// If `output` is among the files but is not a sequence file, so that the new file would replace an input; or
/// if no frame remains.
fn without_old_sequence_file(files: Vec<FrameFile>, output: &Path) -> Result<Vec<FrameFile>> {
    let (old, frames): (Vec<_>, Vec<_>) =
        files.into_iter().partition(|file| are_same_file(&file.path, output));
    if let Some(input) = old.iter().find(|file| !is_sequence_file(&file.path)) {
        bail!(
            "{}: the sequence file would replace the input {}: choose another name",
            output.display(),
            input.path.display()
        );
    }
    if frames.is_empty() {
        bail!(
            "{}: this is a sequence file, and there is no frame to combine: give the .glb, .abc or .usdc files of the frames",
            output.display()
        );
    }
    Ok(frames)
}

/// Warns about missing frames, and about numbers that do not increase. Frames without a number are counted, so
/// none of them are missing.
fn warn_gaps(path: &Path, frames: &[SequenceSource], console: &mut Console) {
    let numbers: Option<Vec<i64>> = frames.iter().map(|frame| frame.number).collect();
    let Some(numbers) = numbers else { return };
    let pair = frames.windows(2).find(|pair| pair[0].number >= pair[1].number);
    if let Some([before, after]) = pair {
        console.warning(format_args!(
            "{}: the frames are counted from 1, because the number of {} is not greater than that of {}",
            path.display(),
            after.path.display(),
            before.path.display()
        ));
    } else if let Some((gaps, count)) = missing_numbers(&numbers) {
        let are = counted_are(count);
        console.warning(format_args!("{}: {gaps}: {are} missing", path.display()));
    }
}

fn report_sequence(path: &Path, shot: &SequenceReport, console: &mut Console) {
    for (frame, why) in &shot.left_out {
        console.error(format_args!("{}: left out of the sequence file: {why}", frame.display()));
    }
    for note in &shot.notes {
        console.warning(format_args!("{}: {note}", path.display()));
    }
    let frames = pluralize(shot.frame_count, "frame");
    let points = shot.point_count.map(|count| format!(", {}", pluralize(count, "point"))).unwrap_or_default();
    console.print_line(format_args!(
        "{}: a sequence file of {frames}{points}, {} bytes",
        path.display(),
        shot.size_bytes
    ));
}

/// The sequence files to make after a conversion.
pub(super) struct SequenceOutputs {
    files: Vec<(PathBuf, SequenceFormat)>,
    fps: f64,
    /// Whether only some of the frames were selected. Gaps in the frame numbers then cause no warning.
    are_picked: bool,
}

impl SequenceOutputs {
    /// The requested sequence files, possibly none. `known_fps` is the frame rate by the times of the frames.
    ///
    /// # Errors
    /// If the files cannot be made with these options.
    pub(super) fn new(
        args: &ConvertArgs,
        outputs: &OutputOptions,
        sequence_count: usize,
        known_fps: Option<f64>,
    ) -> Result<SequenceOutputs> {
        let mut files = Vec::new();
        for path in &args.sequence {
            files.push((path.clone(), format_of(path)?));
            check_sequence_path(path)?;
            if !outputs.formats.contains(&OutputFormat::Glb) {
                bail!(
                    "--sequence: a sequence file is made from the .glb files of its frames: add glb to --format"
                );
            }
            if sequence_count > 1 {
                bail!(
                    "--sequence: a sequence file holds one sequence, but the inputs form \
                     {sequence_count} sequences: convert each of them with its own command"
                );
            }
        }
        let fps = args.formats.fps;
        if files.is_empty() && outputs.stage.is_none() && fps.is_some() && !args.print_settings {
            bail!(
                "--fps is for a sequence file or a stage: give --sequence or --stage as well, or --time-step to compute velocities"
            );
        }
        let fps = fps.or(known_fps).unwrap_or(FPS);
        Ok(SequenceOutputs { files, fps, are_picked: args.frames.is_some() })
    }

    /// Their frame rate, and that of the stage.
    pub(super) fn fps(&self) -> f64 {
        self.fps
    }

    /// Whether all of them are `.glb`.
    pub(super) fn are_glb(&self) -> bool {
        self.files.iter().all(|(_, format)| *format == SequenceFormat::Glb)
    }

    /// The files.
    pub(super) fn paths(&self) -> impl Iterator<Item = &Path> {
        self.files.iter().map(|(path, _)| &**path)
    }

    /// Combines the finished frames of a conversion of `frame_count` frames. If some frames are not finished,
    /// an existing sequence file is not replaced.
    pub(super) fn write(
        &self,
        frames: &[SequenceSource],
        frame_count: usize,
        outcome: CommandOutcome,
        console: &mut Console,
    ) -> CommandOutcome {
        let mut outcome = outcome;
        for (path, format) in &self.files {
            if frames.len() < frame_count && path.exists() {
                let (path, done_count) = (path.display(), frames.len());
                console.warning(format_args!(
                    "{path}: not replaced, because only {done_count} of {frame_count} frames are done; delete it \
                     to write a sequence file of the finished frames"
                ));
                continue;
            }
            match write_sequence_file(path, *format, frames, self.fps) {
                Ok(shot) => {
                    if !self.are_picked {
                        warn_gaps(path, frames, console);
                    }
                    report_sequence(path, &shot, console);
                    if !shot.left_out.is_empty() {
                        outcome = CommandOutcome::SomeFailed;
                    }
                }
                Err(error) => {
                    console.error(error);
                    if outcome == CommandOutcome::Done {
                        outcome = CommandOutcome::SomeFailed;
                    }
                }
            }
        }
        outcome
    }
}
