//! Simulates a dam break of 3 072 particles and reconstructs its surfaces while it runs.
//!
//! ```text
//! cargo run --release -p dam_break -- out/cache 60 out/surfaces
//! ```
//!
//! The simulation writes several frames per second into `out/cache`. Meanwhile the daemon watches
//! that folder, as `meniscus watch out/cache --out out/surfaces` does, and writes each surface to
//! `out/surfaces` as soon as it is ready. The frames are classic BGEO files with velocity, as SPlisHSPlasH
//! and partio write them.
//!
//! Without a folder for surfaces, the example only simulates. The frames in `examples/frames` were made by
//! this command:
//!
//! ```text
//! cargo run --release -p dam_break -- examples/frames 8
//! ```

mod water;

use std::error::Error;
use std::io::{IsTerminal, Write};
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use crossbeam::channel;
use meniscus::pipeline::{OutputFormat, OutputOptions, default_memory_bytes};
use meniscus::surface::options::MethodOptions;
use meniscus::watch::{self, Order, Poll, Watch, WatchConfig, WatchSummary};
use meniscus_formats::{AttributeRole, FileAttribute, FilePositions, ParticleFrame, Values, bgeo};

use water::Water;

const STEPS_PER_FRAME: usize = 15;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.as_slice() {
        [cache, count] => simulate(Path::new(cache), count.parse()?),
        [cache, count, surfaces] => simulate_and_watch(Path::new(cache), count.parse()?, Path::new(surfaces)),
        _ => Err("usage: dam_break FOLDER FRAMES [SURFACES]".into()),
    }
}

/// Runs the daemon in another thread, and the simulation in this one.
fn simulate_and_watch(cache: &Path, frame_count: usize, surfaces: &Path) -> Result<(), Box<dyn Error>> {
    let stderr = std::io::stderr;
    tracing_subscriber::fmt().with_target(false).with_ansi(stderr().is_terminal()).with_writer(stderr).init();
    std::fs::create_dir_all(cache)?;
    std::fs::create_dir_all(surfaces)?;
    let config = config(&std::path::absolute(cache)?, &std::path::absolute(surfaces)?);
    let (finish, requests) = channel::unbounded();
    let (simulated, end, watched) = thread::scope(|scope| {
        let watching = scope.spawn(|| watch::run(&config, None, &requests, &mut |_| ()));
        let simulated = simulate(cache, frame_count);
        let end = Instant::now();
        // If the daemon has already ended, its thread returns the reason.
        let _ = finish.send(());
        (simulated, end, watching.join())
    });
    simulated?;
    watched.map_err(|_| "the daemon panicked")??;
    // The simulation may end before the daemon has started all frames. A second run continues from the
    // records of the first, and converts the frames that are left.
    let summary = watch::run(&WatchConfig { once: true, ..config }, None, &requests, &mut |_| ())?;
    print_summary(&summary, end.elapsed())
}

fn print_summary(summary: &WatchSummary, after: Duration) -> Result<(), Box<dyn Error>> {
    writeln!(
        std::io::stdout(),
        "{} frames have their surfaces, {:.2} s after the simulation ended",
        summary.done_count,
        after.as_secs_f64()
    )?;
    let failed: Vec<&str> = summary.failed.iter().map(|failed| &*failed.message).collect();
    if failed.is_empty() { Ok(()) } else { Err(failed.join("\n").into()) }
}

/// The settings of `meniscus watch CACHE --out SURFACES`: its defaults, written out.
fn config(cache: &Path, surfaces: &Path) -> WatchConfig {
    let threads = thread::available_parallelism().map_or(1, usize::from);
    WatchConfig {
        watches: vec![watch(cache, surfaces)],
        once: false,
        order: Order::Natural,
        threads,
        memory_bytes: default_memory_bytes(),
        disk_floor_bytes: 1 << 30,
        settle: Duration::from_millis(500),
        temporal_wait: Duration::from_secs(30),
        poll: Poll::Auto,
    }
}

fn watch(cache: &Path, surfaces: &Path) -> Watch {
    Watch {
        input: cache.to_owned(),
        pattern: None,
        has_level_sets: false,
        sentinel: None,
        outputs: OutputOptions::new(surfaces, &[OutputFormat::Glb, OutputFormat::Vdb]),
        choices: MethodOptions::default(),
        obstacles: Vec::new(),
    }
}

fn simulate(cache: &Path, frame_count: usize) -> Result<(), Box<dyn Error>> {
    std::fs::create_dir_all(cache)?;
    let mut water = Water::block();
    for frame in 1..=frame_count {
        write_frame(&water, &cache.join(format!("dam.{frame:04}.bgeo")))?;
        for _ in 0..STEPS_PER_FRAME {
            water.step();
        }
    }
    Ok(())
}

/// Writes to a temporary name and renames it, so that a watcher sees complete frames only.
fn write_frame(water: &Water, path: &Path) -> Result<(), Box<dyn Error>> {
    let velocity = FileAttribute {
        name: "v".into(),
        arity: 3,
        role: Some(AttributeRole::Velocity),
        values: Values::F32(water.velocities.iter().flat_map(|velocity| velocity.to_array()).collect()),
    };
    let frame = ParticleFrame {
        positions: FilePositions::F32(water.positions.iter().map(|position| position.to_array()).collect()),
        attributes: vec![velocity],
        ..ParticleFrame::default()
    };
    let unfinished = path.with_extension("unfinished");
    let mut file = std::io::BufWriter::new(std::fs::File::create(&unfinished)?);
    bgeo::write(&frame, &mut file)?;
    file.into_inner()?.sync_all()?;
    std::fs::rename(&unfinished, path)?;
    Ok(())
}
