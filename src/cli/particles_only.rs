//! `meniscus convert --particles-only`: particles of any input as .ply or .vtp, without a surface.

use std::time::Instant;

use anyhow::{Context, Result, bail};
use meniscus_formats::listed;

use crate::pipeline::{FrameReport, OutputFormat, OutputOptions, ParticlesToWrite, write_particles_of};

use super::Verdict;
use super::args::{ConvertArgs, Format, FormatArgs, MethodArgs, ShotArgs};
use super::choices::{obstacle_files, output_options};
use super::console::Console;
use super::convert::{conduct, select, thread_pool};
use super::destination::Destination;
use super::out_folder::OutFolder;
use super::output_records::OutputRecords;
use super::selecting::{Selection, refuse_conflicts, refuse_level_sets};
use super::tally::Tally;
use super::wording::counted;

/// Writes the particles that the arguments ask for.
///
/// # Errors
/// When nothing can be done at all. A frame that fails is no error here: it is told, and counted.
pub(super) fn write_particles(
    args: &ConvertArgs,
    destination: &Destination,
    start: Instant,
    console: &mut Console,
) -> Result<Verdict> {
    refuse_beside_particles(args)?;
    let formats = particle_formats(args.format.as_deref())?;
    let selection = select(args, destination, console)?;
    refuse_level_sets(&selection, "--particles-only")?;
    let Selection { sequences, found, .. } = selection;
    let folder = args.out.clone().context("--out is missing: the folder for the results")?;
    let outputs = OutputOptions { formats: formats.clone(), ..output_options(folder, None, &args.formats) };
    let out_folder = OutFolder::make(&outputs.folder)?;
    refuse_conflicts(&sequences, &found, &obstacle_files(&args.method)?, &outputs, None)?;
    let frames: Vec<ParticlesToWrite> = sequences
        .iter()
        .flat_map(|sequence| &sequence.selected)
        .map(|file| ParticlesToWrite {
            input: file.path.clone(),
            stem: file.stem(),
            folder: outputs.folder.clone(),
            formats: formats.clone(),
        })
        .collect();
    let pool = thread_pool(args.threads)?;
    let records = args.skip_done.then(|| OutputRecords::load([outputs.folder.clone()]));
    let conduct = conduct(args, &pool, records.as_ref())?;
    out_folder.keep();
    let mut tally = Tally::default();
    let has_bar = console.show_bar(frames.len());
    write_particles_of(&frames, &conduct, |index, outcome| {
        let described = |report: &FrameReport| counted(report.skin.particle_count, "particle");
        tally.note(&frames[index].input, &outcome, described, (has_bar, console));
        if let Some(records) = &records {
            records.frame_finished();
        }
    });
    console.hide_bar();
    if let Some(records) = &records {
        records.save(console);
    }
    Ok(tally.finish(frames.len(), start.elapsed().as_secs_f64(), console))
}

/// Refuses what is about surfaces.
fn refuse_beside_particles(args: &ConvertArgs) -> Result<()> {
    let ConvertArgs { report, plan, band_slack, print_settings, method, formats, shot, .. } = args;
    let is_alone = report.is_none()
        && band_slack.is_none()
        && plan.is_none()
        && !print_settings
        && *method == MethodArgs::default()
        && *formats == FormatArgs::default()
        && *shot == ShotArgs::default();
    if !is_alone {
        bail!(
            "--particles-only writes particles as they are: beside it only INPUT, --out, --format, --frames, --skip-done, \
             --threads, --memory and --on-error may be given; what is about surfaces, their files and reports makes no sense \
             with it"
        );
    }
    Ok(())
}

/// The formats to write, each once: .ply by default.
fn particle_formats(formats: Option<&[Format]>) -> Result<Vec<OutputFormat>> {
    let mut distinct = Vec::new();
    for &Format(format) in formats.unwrap_or(&[Format(OutputFormat::Ply)]) {
        if format.particles().is_none() {
            let all = OutputFormat::ALL.into_iter().filter(|format| format.particles().is_some());
            let all = listed(all.map(|format| format.to_string()).collect(), "and");
            bail!("--particles-only writes {all}: the other formats are of surfaces");
        }
        if !distinct.contains(&format) {
            distinct.push(format);
        }
    }
    Ok(distinct)
}
