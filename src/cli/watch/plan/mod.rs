//! Combines options and the configuration file into the daemon's configuration, resolved and checked once.
//!
//! ```text
//!   options ──────────────┐ merge       DIR... and --out replace the [[watch]] blocks;
//!   meniscus.toml ────────┤             every other option overrides its key in every block
//!   defaults ─────────────┘
//!                         ▼
//!                      WatchPlan        absolute paths; consistent numbers
//! ```

use std::collections::HashSet;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, bail};

use crate::cli::args::{DaemonArgs, FrameArgs, LogChoice, OptionSet, WatchArgs};
use crate::cli::config_file::{ConfigBlock, ConfigFile, WatchKeys, read_config_file};
use crate::cli::destination::refuse_file_name;
use crate::cli::inputs::check_output_path;
use crate::cli::machine::{memory_bytes, thread_count};
use crate::cli::settings::{Use, ignored, refuse_options, refuse_other_kinds};
use crate::http::{AccessToken, Listen};
use crate::pipeline::{
    NumberPattern, ObstacleFiles, are_same_file, canonical_path, read_regular_text, refuse_file_for_folder,
};
use crate::surface::options::Settings;
use crate::watch::selection::FileFilter;
use crate::watch::{Order, Poll, Watch, WatchConfig, names_level_sets};

/// The daemon's configuration, and warnings to log before it starts.
#[derive(Clone, Debug)]
pub(in crate::cli) struct WatchPlan {
    pub(in crate::cli) config: WatchConfig,
    pub(in crate::cli) log: LogChoice,
    /// The address of the status page and the HTTP API.
    pub(in crate::cli) listen: Option<Listen>,
    /// Warnings, one sentence each.
    pub(in crate::cli) warnings: Vec<String>,
}

/// Makes the plan from the options and the file, and checks it.
///
/// # Errors
/// If the file cannot be read, or a setting is invalid. An error that the file causes has the file, the line
/// and the key.
pub(in crate::cli) fn make_plan(args: &WatchArgs) -> Result<WatchPlan> {
    let file = args.config.as_deref().map(read_config_file).transpose()?;
    let mut warnings = Vec::new();
    let blocks = file.as_ref().filter(|_| args.inputs.is_empty());
    let watches = match blocks {
        Some(file) => watches_of_file(args, file, &mut warnings)?,
        None => typed_watches(args, &mut warnings)?,
    };
    // One frame rate for all blocks is right if any of them has a stage.
    if watches.iter().all(|watch| watch.outputs.stage.is_none()) {
        args.frames.formats.refuse_idle_fps()?;
    }
    let blocks = blocks.map_or(&[][..], |file| &file.watches);
    refuse_twins(&watches, blocks)?;
    refuse_shared_stage(&watches, blocks)?;
    // A command-line option causes the same warning in every block: log it once.
    let mut seen = HashSet::new();
    warnings.retain(|warning: &String| seen.insert(warning.clone()));
    let resolved = |daemon: &DaemonArgs| -> Result<WatchPlan> {
        let daemon = args.daemon.clone().over(daemon.clone());
        let config = config(watches.clone(), args.once, &daemon)?;
        let listen = listen(&daemon)?;
        Ok(WatchPlan { config, log: daemon.log.unwrap_or(LogChoice::Text), listen, warnings: Vec::new() })
    };
    let plan = match file.as_ref().and_then(|file| file.daemon.as_ref()) {
        Some(block) => resolved(&block.options).with_context(|| block.place.clone())?,
        None => resolved(&DaemonArgs::default())?,
    };
    Ok(WatchPlan { warnings, ..plan })
}

fn typed_watches(args: &WatchArgs, warnings: &mut Vec<String>) -> Result<Vec<Watch>> {
    let Some(output) = &args.out else {
        bail!("DIR replaces the [[watch]] blocks of the file, so it needs --out as well");
    };
    // Shell globs may name a folder twice.
    let mut seen = HashSet::new();
    let inputs = args.inputs.iter().filter(|input| seen.insert(*input));
    let typed = |input: &PathBuf| {
        check_input(input, args.once)?;
        check_output(output)?;
        watch(input, output, &args.frames, warnings).with_context(|| input.display().to_string())
    };
    inputs.map(typed).collect()
}

fn watches_of_file(args: &WatchArgs, file: &ConfigFile, warnings: &mut Vec<String>) -> Result<Vec<Watch>> {
    let path = file.path.display();
    let Some(first) = file.watches.first() else {
        bail!("{path}: no folder to watch: add a [[watch]] block, or give DIR and --out");
    };
    let has_other_output = |block: &&ConfigBlock<WatchKeys>| block.options.output != first.options.output;
    if args.out.is_some()
        && let Some(other) = file.watches.iter().find(has_other_output)
    {
        bail!(
            "{path}: the [[watch]] blocks at lines {} and {} have different outputs, but --out names only one: \
             leave it out, or give DIR as well",
            first.line,
            other.line
        );
    }
    let watch = |block: &ConfigBlock<WatchKeys>| {
        watch_of_block(args, &block.options, warnings).with_context(|| block.place.clone())
    };
    file.watches.iter().map(watch).collect()
}

fn watch_of_block(args: &WatchArgs, keys: &WatchKeys, warnings: &mut Vec<String>) -> Result<Watch> {
    let input = keys.input.as_ref().context("this block names no input: add one")?;
    let output = args
        .out
        .as_ref()
        .or(keys.output.as_ref())
        .context("this block names no output: add one, or give --out")?;
    check_input(input, args.once)?;
    check_output(output)?;
    let frames = args.frames.clone().over(keys.frames.clone());
    if keys.frames.formats.fps.is_some() {
        frames.formats.refuse_idle_fps()?;
    }
    watch(input, output, &frames, warnings)
}

fn check_input(input: &Path, once: bool) -> Result<()> {
    let name = input.file_name().and_then(OsStr::to_str).unwrap_or_default();
    let by_number = NumberPattern::find_in_new(name);
    if !input.exists() && (name.contains(['*', '?']) || by_number.is_some()) {
        let pattern = by_number.map_or(name.to_owned(), |found| format!("{}*{}", found.before, found.after));
        let folder = input.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
        bail!("{}: watch needs a folder: use {} --pattern '{pattern}'", input.display(), folder.display());
    }
    if once && !input.exists() {
        bail!(
            "{}: there is no such folder: check the path; without --once, watch waits for the folder",
            input.display()
        );
    }
    if input.exists() && !input.is_dir() {
        bail!(
            "{}: this is a file, and watch needs a folder: use `meniscus convert` for files",
            input.display()
        );
    }
    Ok(())
}

fn check_output(output: &Path) -> Result<()> {
    refuse_file_name(output)?;
    Ok(refuse_file_for_folder(&absolute(output)?)?)
}

fn watch(input: &Path, output: &Path, frames: &FrameArgs, warnings: &mut Vec<String>) -> Result<Watch> {
    let choices = frames.method.to_options();
    FileFilter::new(frames.pattern.as_deref(), Vec::new())?;
    let has_level_sets = names_level_sets(&absolute(input)?, frames.pattern.as_deref(), &absolute(output)?);
    if has_level_sets {
        refuse_options(&frames.method, Use::AsItIs)?;
        Settings::for_level_sets(&choices)?;
    } else if choices.needs_measuring() {
        Settings::check(&choices)?;
    } else {
        warnings.extend(Settings::resolve(&choices, None)?.warnings());
    }
    let mut outputs = frames.formats.outputs(absolute(output)?)?;
    outputs.spray = frames.formats.spray(&frames.method, &outputs);
    if let Some(stage) = &mut outputs.stage {
        stage.path = absolute(&stage.path)?;
        // The folder of the results may not exist yet.
        if stage.path.parent() != Some(&*outputs.folder) {
            check_output_path("the stage", &stage.path)?;
        }
    }
    warnings.extend(ignored(&frames.method, &frames.formats, &outputs.formats));
    if let Some(sentinel) = &frames.sentinel {
        check_sentinel(sentinel)?;
    }
    // An obstacle that does not exist may be written later.
    refuse_other_kinds(&ObstacleFiles::new(frames.method.obstacle.clone()))?;
    Ok(Watch {
        input: absolute(input)?,
        pattern: frames.pattern.clone(),
        has_level_sets,
        sentinel: frames.sentinel.clone(),
        outputs,
        choices,
        obstacles: frames.method.obstacle.iter().map(|path| absolute(path)).collect::<Result<_>>()?,
    })
}

/// Refuses a sentinel whose name is a path, or always that of the frame's own file.
fn check_sentinel(name: &str) -> Result<()> {
    let is_name = !name.is_empty() && !name.contains(['/', '\\']) && !["{name}", ".", ".."].contains(&name);
    if !is_name {
        bail!("the sentinel `{name}` must be the name of a file beside the frame, such as {{stem}}.done");
    }
    Ok(())
}

/// Refuses two watches of the same files for the same outputs. `blocks` are those of the watches, unless
/// they are from the command line.
fn refuse_twins(watches: &[Watch], blocks: &[ConfigBlock<WatchKeys>]) -> Result<()> {
    for (index, watch) in watches.iter().enumerate() {
        let is_twin = |other: &&Watch| {
            are_same_file(&other.input, &watch.input)
                && are_same_file(&other.outputs.folder, &watch.outputs.folder)
                && other.pattern == watch.pattern
        };
        let Some(twin) = watches[..index].iter().position(|other| is_twin(&other)) else { continue };
        let input = watch.input.display();
        match (blocks.get(twin), blocks.get(index)) {
            (Some(first), Some(block)) => bail!(
                "{}: {input} is watched twice for the same output, also by the block at line {}: remove one \
                 of the two",
                block.place,
                first.line
            ),
            _ => bail!("{input}: watched twice for the same output"),
        }
    }
    Ok(())
}

/// Refuses a stage for folders whose frames cannot be in the same one.
fn refuse_shared_stage(watches: &[Watch], blocks: &[ConfigBlock<WatchKeys>]) -> Result<()> {
    for (index, watch) in watches.iter().enumerate() {
        let Some(stage) = &watch.outputs.stage else { continue };
        let is_unlike = |other: &&Watch| {
            let [a, b] = [&watch.outputs, &other.outputs];
            let is_same = are_same_file(&a.folder, &b.folder)
                && (a.up, a.meters_per_unit, &a.stage) == (b.up, b.meters_per_unit, &b.stage)
                && a.stage_mesh_format() == b.stage_mesh_format();
            b.stage.as_ref().is_some_and(|other| other.path == stage.path) && !is_same
        };
        if watches[..index].iter().any(|other| is_unlike(&other)) {
            let place = blocks.get(index).map(|block| format!("{}: ", block.place)).unwrap_or_default();
            bail!(
                "{place}{}: several watched folders have this stage, but different outputs, formats, axes, units or \
                 frame rates: give each a stage of its own",
                stage.path.display()
            );
        }
    }
    Ok(())
}

fn config(watches: Vec<Watch>, once: bool, daemon: &DaemonArgs) -> Result<WatchConfig> {
    Ok(WatchConfig {
        watches,
        once,
        order: daemon.order.unwrap_or(Order::Natural),
        threads: thread_count(daemon.run.threads),
        memory_bytes: memory_bytes(daemon.run.memory)?,
        disk_floor_bytes: daemon.disk_floor.unwrap_or(DISK_FLOOR_BYTES),
        settle: daemon.settle.unwrap_or(SETTLE),
        temporal_wait: daemon.temporal_wait.unwrap_or(TEMPORAL_WAIT),
        poll: daemon.poll.unwrap_or(Poll::Auto),
    })
}

/// The address and the access token of the HTTP server.
fn listen(daemon: &DaemonArgs) -> Result<Option<Listen>> {
    let token = daemon.token_file.as_deref().map(token_in).transpose()?;
    let Some(address) = daemon.listen else {
        if token.is_some() {
            bail!("--token-file requires --listen");
        }
        return Ok(None);
    };
    if token.is_none() && !address.ip().to_canonical().is_loopback() {
        bail!(
            "{address} can be reached from other machines: give --token-file to restrict access, or listen on \
             127.0.0.1"
        );
    }
    Ok(Some(Listen { address, token }))
}

fn token_in(path: &Path) -> Result<AccessToken> {
    let text = read_regular_text(path).with_context(|| format!("cannot read {}", path.display()))?;
    let line = text.lines().next().unwrap_or_default();
    AccessToken::new(line.trim()).with_context(|| {
        format!(
            "the first line of {} is not a token: 16 to 256 ASCII letters, digits, or - _ . ~",
            path.display()
        )
    })
}

/// An absolute path: records must identify frames by the same paths wherever the daemon is started.
fn absolute(path: &Path) -> Result<PathBuf> {
    if path.as_os_str().is_empty() {
        bail!("a path is empty: give a file or folder");
    }
    Ok(canonical_path(path))
}

const SETTLE: Duration = Duration::from_millis(500);
const TEMPORAL_WAIT: Duration = Duration::from_secs(30);
const DISK_FLOOR_BYTES: u64 = 1 << 30;

#[cfg(test)]
mod tests;
