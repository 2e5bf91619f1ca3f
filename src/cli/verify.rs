//! `meniscus verify`: checks the results in a folder against their records.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::io;
use std::path::{Path, PathBuf, absolute};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use rayon::prelude::*;
use serde::Serialize;

use crate::pipeline::files::json::write_json;
use crate::pipeline::{
    AroundFrame, DoneRecord, FrameFile, FrameRecords, NumberedFrames, OutputComparison, RecordedAround,
    ResultState, STATE_FOLDER, SettingValues, Wanted, canonical_path, entry_key, file_of, hash_of_input,
    sequences,
};

use crate::surface::options::{FrameReach, MethodOptions};

use super::CommandOutcome;
use super::args::VerifyArgs;
use super::console::Console;
use super::destination::write_file;
use super::inputs::{check_output_path, find_inputs};
use super::machine::thread_pool;
use super::wording::pluralize;

/// A frame, and the state of its results.
#[derive(Debug)]
struct VerifiedFrame {
    name: PathBuf,
    input: PathBuf,
    state: ResultState,
    /// Whether its input exists, so that it was compared with the record.
    input_exists: bool,
}

/// The report, as JSON.
#[derive(Debug, Serialize)]
struct VerifyReport<'a> {
    version: &'static str,
    folder: String,
    /// The number of frames in each state, and of frames whose input does not exist.
    summary: BTreeMap<&'static str, usize>,
    frames: Vec<ReportedFrame<'a>>,
}

#[derive(Debug, Serialize)]
struct ReportedFrame<'a> {
    name: String,
    input: String,
    state: &'static str,
    reason: Option<&'a str>,
    input_exists: bool,
}

/// Checks the results in a folder.
///
/// # Errors
/// If nothing can be checked.
pub(super) fn verify(args: &VerifyArgs, console: &mut Console) -> Result<CommandOutcome> {
    let start = Instant::now();
    let folder = &args.folder;
    if !folder.is_dir() {
        bail!("{}: folder not found", folder.display());
    }
    if let Some(report) = &args.report {
        check_output_path("the report", report)?;
    }
    let records = FrameRecords::open(folder)
        .with_context(|| format!("{}: cannot read the records", folder.join(STATE_FOLDER).display()))?;
    for problem in records.problems() {
        console.warning(format_args!("{problem}: the frames that are recorded there count as missing"));
    }
    let mut frames = recorded_frames(&records);
    if !args.input.is_empty() {
        let found = find_inputs(&args.input, None)?;
        found.report(console);
        add_inputs(&mut frames, found.files);
    }
    if frames.is_empty() {
        bail!(
            "{}: there are no records of results here: name the folder that was given to --out",
            folder.display()
        );
    }
    refuse_to_replace(args.report.as_deref(), folder, &frames)?;
    let wanted = current_settings(&frames, &records);
    let frames: Vec<(PathBuf, KnownFrame)> = frames.into_iter().collect();
    let verified: Vec<VerifiedFrame> = thread_pool(args.threads)?.install(|| {
        let hash = |frame: &(PathBuf, KnownFrame)| (frame.1.input.clone(), hash_of_input(&frame.1.input));
        let hashes: InputHashes = frames.par_iter().map(hash).collect();
        let verify = |(name, frame)| verify_frame(&records, name, frame, (&wanted, &hashes));
        frames.into_par_iter().map(verify).collect()
    });
    for frame in verified.iter().filter(|frame| frame.state != ResultState::Done) {
        let (name, state) = (frame.name.display(), frame.state.word());
        console.warn(format_args!("{name}: {state}: {}", frame.state.reason().unwrap_or_default()));
    }
    let done_count = summarize(&verified, start.elapsed().as_secs_f64(), console);
    if let Some(path) = &args.report {
        write_report(path, folder, &verified)?;
    }
    Ok(CommandOutcome::of(done_count, verified.len() - done_count, false))
}

/// A frame to verify.
struct KnownFrame {
    input: PathBuf,
    /// The latest one last.
    records: Vec<Arc<DoneRecord>>,
    /// Whether its input is among those given.
    is_given: bool,
}

/// The frames with a record, by name.
fn recorded_frames(records: &FrameRecords) -> BTreeMap<PathBuf, KnownFrame> {
    let done = records.done().into_iter().filter_map(|(name, records)| {
        let input = records.last()?.input.clone();
        Some((name, KnownFrame { input, records, is_given: false }))
    });
    let others = records.never_done().into_iter().map(|(name, record)| {
        (name, KnownFrame { input: record.input.clone(), records: Vec::new(), is_given: false })
    });
    done.chain(others).collect()
}

/// Adds the frames of these inputs. The paths of inputs replace those in the records, because inputs may have
/// been moved.
fn add_inputs(frames: &mut BTreeMap<PathBuf, KnownFrame>, files: Vec<FrameFile>) {
    // An input may have been converted under several names, with other settings each.
    let mut names_of: HashMap<PathBuf, Vec<PathBuf>> = HashMap::new();
    for (name, frame) in &*frames {
        names_of.entry(frame.input.clone()).or_default().push(name.clone());
    }
    let mut given = HashSet::new();
    for file in sequences(files).into_iter().flat_map(|sequence| sequence.frames) {
        let input = absolute(&file.path).unwrap_or_else(|_| file.path.clone());
        for mut name in names_of.remove(&input).unwrap_or_else(|| vec![file.stem().into()]) {
            // Of several inputs with the same outputs, the first one is converted, and the others are missing.
            if !given.insert(name.clone()) {
                name.clone_from(&file.path);
            }
            let records = frames.remove(&name).map_or_else(Vec::new, |known| known.records);
            frames.insert(name, KnownFrame { input: input.clone(), records, is_given: true });
        }
    }
}

/// What the frame of an input should be made with.
#[derive(Default)]
struct WantedSettings {
    /// The id of its settings.
    id: String,
    /// Whether their values are recorded, and so the frames on which it depends are known.
    has_values: bool,
    /// The frames on which it depends, and how far those are that are not of its history.
    around: Arc<[AroundFrame]>,
    beside: u32,
    /// The frames of its history, as far as they are known from inputs and records.
    history: Vec<AroundFrame>,
}

/// The settings that each frame should have, by name: those with which most frames of its sequence were converted under
/// such names, and of several such settings the latest ones.
fn current_settings(
    frames: &BTreeMap<PathBuf, KnownFrame>,
    records: &FrameRecords,
) -> HashMap<PathBuf, WantedSettings> {
    let mut series: BTreeMap<String, Vec<(&PathBuf, &KnownFrame)>> = BTreeMap::new();
    for (name, frame) in frames {
        let without_digits = name.to_string_lossy().replace(|letter: char| letter.is_ascii_digit(), "");
        series.entry(without_digits).or_default().push((name, frame));
    }
    series.into_values().flat_map(|frames| settings_of_series(&frames, records)).collect()
}

/// Those of frames whose names differ by their numbers.
fn settings_of_series(
    frames: &[(&PathBuf, &KnownFrame)],
    records: &FrameRecords,
) -> HashMap<PathBuf, WantedSettings> {
    let all = || frames.iter().map(|(_, frame)| frame);
    let recorded: HashMap<&Path, &[Arc<DoneRecord>]> =
        all().map(|frame| (&*frame.input, &*frame.records)).collect();
    let given: HashSet<&Path> = all().filter(|frame| frame.is_given).map(|frame| &*frame.input).collect();
    let inputs = all().map(|frame| FrameFile::new(frame.input.clone())).collect();
    let name_of: HashMap<&Path, &PathBuf> =
        frames.iter().map(|(name, frame)| (&*frame.input, *name)).collect();
    let mut settings = HashMap::new();
    for sequence in sequences(inputs) {
        // The number of frames, and the time of the latest.
        let mut uses: HashMap<&str, (usize, u64)> = HashMap::new();
        for records in sequence.frames.iter().filter_map(|file| recorded.get(&*file.path)) {
            let mut of_frame: HashMap<&str, u64> = HashMap::new();
            for record in *records {
                let at_ms = of_frame.entry(&record.settings).or_default();
                *at_ms = record.at_ms.max(*at_ms);
            }
            for (id, at_ms) in of_frame {
                let (count, latest_ms) = uses.entry(id).or_default();
                (*count, *latest_ms) = (*count + 1, at_ms.max(*latest_ms));
            }
        }
        let Some((current, _)) = uses.into_iter().max_by_key(|(_, uses)| *uses) else { continue };
        let values = records.settings(current);
        let reach = values.as_ref().map_or_else(FrameReach::default, frame_reach);
        // A conversion of these inputs depends on no others.
        let given = sequence.frames.iter().filter(|file| given.contains(&*file.path));
        let numbered = NumberedFrames::of_files(given);
        let known = NumberedFrames::of_files(&sequence.frames);
        let beside = reach.beside;
        settings.extend(sequence.frames.iter().map(|file| {
            let around = numbered.frames_around(file.number(), reach);
            let of_all =
                if reach.has_history() { known.frames_around(file.number(), reach) } else { Arc::default() };
            let is_history = |frame: &&AroundFrame| frame.steps.unsigned_abs() > beside;
            let history = of_all.iter().filter(is_history).cloned().collect();
            (
                name_of[&*file.path].clone(),
                WantedSettings {
                    id: current.to_owned(),
                    has_values: values.is_some(),
                    around,
                    beside,
                    history,
                },
            )
        }));
    }
    settings
}

/// The frames that a frame depends on, with these settings.
fn frame_reach(values: &SettingValues) -> FrameReach {
    let pairs = FrameReach::OPTIONS.into_iter().filter_map(|name| Some((name, values.get(name)?.as_str())));
    // Values out of range are of another version.
    let options = MethodOptions::from_pairs(pairs).filter(|options| options.check_ranges().is_ok());
    options.map_or_else(FrameReach::default, |options| options.frame_reach())
}

/// The hashes of the inputs that are known, by path.
type InputHashes = HashMap<PathBuf, meniscus_formats::Result<u128>>;

fn verify_frame(
    records: &FrameRecords,
    name: PathBuf,
    KnownFrame { input, is_given, .. }: KnownFrame,
    (settings, hashes): (&HashMap<PathBuf, WantedSettings>, &InputHashes),
) -> VerifiedFrame {
    let input_hash = match hashes.get(&input) {
        Some(Ok(hash)) => Ok(Some(*hash)),
        None => Ok(None),
        Some(Err(meniscus_formats::Error::Io(error))) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Some(Err(error)) => {
            Err(format!("{}: {error}; the results cannot be compared with their input", input.display()))
        }
    };
    let none = WantedSettings::default();
    let WantedSettings { id: settings_id, has_values, around, beside, history } =
        settings.get(&name).unwrap_or(&none);
    let hash_of = |frame: &AroundFrame| hashes.get(&frame.path)?.as_ref().ok().copied();
    // Obstacles are not read here.
    let around = around.iter().map(|frame| frame.recorded(hash_of(frame), "")).collect();
    let around = RecordedAround::with_history(around, *beside);
    let settings = records.settings(settings_id);
    let wanted = Wanted {
        name: &name,
        outputs: None,
        input_hash: input_hash.clone().ok().flatten(),
        obstacles: None,
        // Without the inputs, frames around may exist that were never converted.
        around: (is_given && *has_values && matches!(input_hash, Ok(Some(_)))).then_some(&*around),
        settings_id,
        settings: settings.as_ref(),
        cameras: Vec::new(),
    };
    let (state, record) = records.state(&wanted, OutputComparison::Bytes);
    let input_exists = input_hash != Ok(None);
    let history = history.iter().map(|frame| frame.recorded(hash_of(frame), "")).collect();
    let history = RecordedAround::with_history(history, *beside).into_iter().next();
    let is_other = |around: &&RecordedAround| {
        if around.is_history() {
            // Others may have been there.
            return history.as_ref().is_some_and(|now| now.name == around.name && now.hash != around.hash);
        }
        let hash =
            hashes.get(&file_of(&input).with_file_name(&around.name)).and_then(|hash| hash.as_ref().ok());
        around.hash.zip(hash).is_some_and(|(recorded, hash)| recorded != *hash)
    };
    let changed = record.as_ref().and_then(|record| record.around.iter().find(is_other));
    let state = match (input_hash, changed) {
        (Err(unreadable), _) if state.is_done() => ResultState::Stale(unreadable),
        (_, Some(around)) if state.is_done() => ResultState::Stale(if around.is_history() {
            format!("one of the {}, on which it depends, has changed since", around.name)
        } else {
            format!("{}, on which it depends, has changed since", around.name)
        }),
        _ => state,
    };
    VerifiedFrame { name, input, state, input_exists }
}

/// Refuses a report that would replace an input or a result.
fn refuse_to_replace(
    report: Option<&Path>,
    folder: &Path,
    frames: &BTreeMap<PathBuf, KnownFrame>,
) -> Result<()> {
    let Some(report) = report else { return Ok(()) };
    let key = |path: &Path| entry_key(canonical_path(path));
    let entry = key(report);
    let is_result = |record: &DoneRecord| {
        let within = folder.join(&record.name);
        record.outputs.iter().any(|file| key(&within.with_file_name(&file.name)) == entry)
    };
    let is_named = |frame: &KnownFrame| {
        frame.records.iter().any(|record| is_result(record)) || key(file_of(&frame.input)) == entry
    };
    if frames.values().any(is_named) {
        bail!("{}: the report would replace an input or a result", report.display());
    }
    Ok(())
}

/// Prints how many frames are in each state. Returns the number of frames that are done.
fn summarize(frames: &[VerifiedFrame], seconds: f64, console: &mut Console) -> usize {
    let counts = counts_of(frames);
    let done_count = counts.get("done").copied().unwrap_or(0);
    let mut summary = format!("{}: {done_count} done", pluralize(frames.len(), "frame"));
    for (state, count) in counts.iter().filter(|(state, _)| **state != "done") {
        summary += &format!(", {count} {state}");
    }
    console.print_line(format_args!("{summary}, in {seconds:.2} s"));
    let gone_count = frames.iter().filter(|frame| !frame.input_exists).count();
    if gone_count > 0 {
        let frames = pluralize(gone_count, "frame");
        console
            .warning(format_args!("{frames} with a missing input: cannot check whether they are up to date"));
    }
    done_count
}

fn counts_of(frames: &[VerifiedFrame]) -> BTreeMap<&'static str, usize> {
    let mut counts = BTreeMap::new();
    for frame in frames {
        *counts.entry(frame.state.word()).or_insert(0) += 1;
    }
    counts
}

fn write_report(path: &Path, folder: &Path, frames: &[VerifiedFrame]) -> Result<()> {
    let states = ["done", "missing", "damaged", "stale", "violations"];
    let mut summary: BTreeMap<&'static str, usize> = states.map(|state| (state, 0)).into();
    summary.extend(counts_of(frames));
    summary.insert("frames", frames.len());
    summary.insert("inputs_missing", frames.iter().filter(|frame| !frame.input_exists).count());
    let report = VerifyReport {
        version: env!("CARGO_PKG_VERSION"),
        folder: folder.to_string_lossy().into_owned(),
        summary,
        frames: frames.iter().map(reported).collect(),
    };
    // If the path is a symbolic link, the report replaces the link's target, not the link.
    let path = dunce::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    write_file(&path, |out| write_json(&mut &mut *out, &report))
}

fn reported(frame: &VerifiedFrame) -> ReportedFrame<'_> {
    ReportedFrame {
        name: frame.name.to_string_lossy().into_owned(),
        input: frame.input.to_string_lossy().into_owned(),
        state: frame.state.word(),
        reason: frame.state.reason(),
        input_exists: frame.input_exists,
    }
}
