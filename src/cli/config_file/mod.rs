//! `meniscus.toml`: what to watch, and how.
//!
//! ```text
//!   [daemon]              order, threads, memory …        at most one
//!   [[watch]]             input, output, formats, voxel_size …    any number
//! ```
//!
//! Keys are the options of the command line, with underscores, and their values are checked by the
//! same functions. Relative paths are relative to the file's own folder, so that it can be moved
//! together with what it names. Whatever is not understood is an error with its line: a misspelt key
//! that is passed over in silence would cost somebody a night.

mod block;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use toml::de::DeTable;

use super::args::{
    DaemonArgs, FirstArgs, FormatArgs, FrameArgs, MeshArgs, MethodArgs, ObstacleArgs, ParticleArgs,
    SolverArgs, SpacingArgs, SurfaceArgs,
};
use super::quantities::{
    parse_bytes, parse_duration, parse_listen, parse_meters_per_unit, parse_picture_size, parse_poll,
    parse_rescan,
};
use crate::pipeline::read_regular_text;
use crate::surface::options::{ISLAND_MAX, ROUNDS_MAX, STEPS_MAX};

use block::{Block, Source};

/// What stands in a file.
#[derive(Clone, Debug)]
pub(super) struct ConfigFile {
    /// Where it is.
    pub(super) path: PathBuf,
    /// In the order of the file.
    pub(super) watches: Vec<WatchBlock>,
    pub(super) daemon: DaemonArgs,
}

/// A `[[watch]]` block.
#[derive(Clone, Debug)]
pub(super) struct WatchBlock {
    /// The line that it begins on.
    pub(super) line: usize,
    pub(super) input: PathBuf,
    pub(super) output: Option<PathBuf>,
    pub(super) frames: FrameArgs,
}

/// Reads the file at `path`.
///
/// # Errors
/// When it cannot be read, or says something that makes no sense: file, line, and what would.
pub(super) fn read_config_file(path: &Path) -> Result<ConfigFile> {
    let text = read_regular_text(path).with_context(|| format!("cannot read {}", path.display()))?;
    parse(&Source { path, text: &text })
}

/// Reads a file that has no place.
pub(super) fn check(text: &str) -> Result<()> {
    parse(&Source { path: Path::new("meniscus.toml"), text }).map(drop)
}

fn parse(source: &Source<'_>) -> Result<ConfigFile> {
    let root = DeTable::parse(source.text).map_err(|error| {
        let message = error.message().replace('\n', ", ");
        source.error(error.span().map_or(0, |span| span.start), message)
    })?;
    let root = Block::new(source, "", root.get_ref(), 0)?;
    let watches: Result<Vec<WatchBlock>> =
        root.blocks("watch")?.iter().map(|block| watch_block(source, block)).collect();
    let daemon = root.block("daemon")?.map_or_else(|| Ok(DaemonArgs::default()), |block| daemon_args(&block));
    Ok(ConfigFile { path: source.path.to_owned(), watches: watches?, daemon: daemon? })
}

fn watch_block(source: &Source<'_>, block: &Block<'_>) -> Result<WatchBlock> {
    let input = block.path("input")?.ok_or_else(|| block.error("this [[watch]] block names no input"))?;
    Ok(WatchBlock {
        line: source.line(block.start),
        input,
        output: block.path("output")?,
        frames: FrameArgs {
            pattern: block.text("pattern")?,
            recursive: block.switch("recursive")?,
            sentinel: block.text("sentinel")?,
            format: block.choices("formats")?,
            method: method_args(block)?,
            formats: FormatArgs {
                up: block.choice("up")?,
                meters_per_unit: block.number_as("meters_per_unit", parse_meters_per_unit)?,
                quantize: block.switch("quantize")?,
                vdb_half: block.switch("vdb_half")?,
                vdb_compression: block.choice("vdb_compression")?,
                preview: block.choice("preview")?,
                preview_size: block.parsed("preview_size", parse_picture_size)?,
                camera: block.as_typed("camera")?,
            },
        },
    })
}

fn method_args(block: &Block<'_>) -> Result<MethodArgs> {
    Ok(MethodArgs {
        first: FirstArgs {
            preset: block.choice("preset")?,
            spacing: SpacingArgs {
                spacing: block.number("spacing")?,
                particle_radius: block.number("particle_radius")?,
            },
            voxel_size: block.number("voxel_size")?,
        },
        surface: SurfaceArgs {
            radius_min: block.number("radius_min")?,
            radius_ratio: block.number("radius_ratio")?,
            radius_init: block.number("radius_init")?,
            offset: block.number("offset")?,
            drop_islands: block.count("drop_islands", 0..=ISLAND_MAX)?,
            fill_cavities: block.number("fill_cavities")?,
            clip: block.as_typed("clip")?,
        },
        particles: ParticleArgs {
            radius_attribute: block.text("radius_attribute")?,
            radius_scale: block.number("radius_scale")?,
            anisotropy: block.choice("anisotropy")?,
            max_stretch: block.number("max_stretch")?,
            thin_radius: block.number("thin_radius")?,
            lone_radius: block.number("lone_radius")?,
            neighbor_radius: block.number("neighbor_radius")?,
            position_smoothing: block.number("position_smoothing")?,
            velocity_gain: block.number("velocity_gain")?,
            attributes: block.as_typed("attributes")?,
        },
        obstacles: ObstacleArgs {
            obstacle: block.paths("obstacles")?,
            void_threshold: block.number("void_threshold")?,
        },
        mesh: MeshArgs {
            contour: block.choice("contour")?,
            decimate: block.number("decimate")?,
            smooth_normals: block.count("smooth_normals", 0..=ROUNDS_MAX)?,
            quads: block.switch("quads")?,
        },
        solver: SolverArgs {
            integrator: block.choice("integrator")?,
            laplacian_steps: block.count("laplacian_steps", 0..=STEPS_MAX)?,
            steps: block.count("steps", 0..=STEPS_MAX)?,
            step_size: block.number("step_size")?,
            redistance_every: block.count("redistance_every", 1..=STEPS_MAX)?,
            cg_tolerance: block.number("cg_tolerance")?,
        },
    })
}

fn daemon_args(block: &Block<'_>) -> Result<DaemonArgs> {
    Ok(DaemonArgs {
        order: block.choice("order")?,
        threads: block.count("threads", 1..=1024)?,
        in_flight: block.count("in_flight", 1..=1024)?,
        memory: block.size("memory", parse_bytes)?,
        disk_floor: block.size("disk_floor", parse_bytes)?,
        settle: block.parsed("settle", parse_duration)?,
        unproven: block.parsed("unproven", parse_duration)?,
        stalled: block.parsed("stalled", parse_duration)?,
        poll: block.parsed("poll", parse_poll)?,
        rescan: block.parsed("rescan", parse_rescan)?,
        journal: block.path("journal")?,
        log: block.choice("log")?,
        listen: block.parsed("listen", parse_listen)?,
        token: None,
        token_file: block.path("token_file")?,
        stop_deadline: block.parsed("stop_deadline", parse_duration)?,
    })
}

/// What each block may hold; the file itself is the block without a name.
fn keys_of(block: &str) -> &'static [&'static str] {
    match block {
        "watch" => &WATCH_KEYS,
        "daemon" => &DAEMON_KEYS,
        _ => &ROOT_KEYS,
    }
}

const ROOT_KEYS: [&str; 2] = ["watch", "daemon"];

const WATCH_KEYS: [&str; 47] = [
    "input",
    "output",
    "pattern",
    "recursive",
    "sentinel",
    "formats",
    "preset",
    "spacing",
    "particle_radius",
    "voxel_size",
    "radius_min",
    "radius_ratio",
    "radius_init",
    "offset",
    "drop_islands",
    "fill_cavities",
    "clip",
    "radius_attribute",
    "radius_scale",
    "anisotropy",
    "max_stretch",
    "thin_radius",
    "lone_radius",
    "neighbor_radius",
    "position_smoothing",
    "velocity_gain",
    "attributes",
    "obstacles",
    "void_threshold",
    "contour",
    "decimate",
    "smooth_normals",
    "quads",
    "integrator",
    "laplacian_steps",
    "steps",
    "step_size",
    "redistance_every",
    "cg_tolerance",
    "up",
    "meters_per_unit",
    "quantize",
    "vdb_half",
    "vdb_compression",
    "preview",
    "preview_size",
    "camera",
];

const DAEMON_KEYS: [&str; 15] = [
    "order",
    "threads",
    "in_flight",
    "memory",
    "disk_floor",
    "settle",
    "unproven",
    "stalled",
    "poll",
    "rescan",
    "journal",
    "log",
    "listen",
    "token_file",
    "stop_deadline",
];

#[cfg(test)]
mod tests;
