//! Compares converting frames with the pipeline and with a plain loop over its stages.
//!
//! ```text
//! cargo bench --bench pipeline                      40 frames of 19 683 particles on 2 threads
//! cargo bench --bench pipeline -- 8 64 16           8 frames of 64³ particles on 16 threads
//! ```
//!
//! The plain loop reads, reconstructs and writes one frame after the other, with all threads on each.
//! Pipeline and loop run alternately, because other processes always disturb the times a little. The result
//! is the time of the pipeline divided by that of the loop in the same round: below 1 the pipeline is faster.

#![expect(clippy::print_stdout, reason = "a benchmark prints its results")]

use std::error::Error;
use std::fs;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use meniscus::pipeline::{
    AttributeRequest, Frame, FrameFile, Outcome, OutputFormat, OutputOptions, PipelineOptions,
    encode_level_set, mesh_view, parse_particles, read_file, run, write_atomically,
};
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus::surface::reconstruction::reconstruct_frame;
use meniscus_formats::{FilePositions, MeshOptions, ParticleFrame, bgeo, gltf, vdb};
use rayon::ThreadPool;

/// Distance between particles.
const SPACING: f32 = 0.1;

/// Number of rounds, each with the loop and the pipeline.
const ROUND_COUNT: usize = 5;

fn main() -> Result<(), Box<dyn Error>> {
    let numbers: Vec<usize> = std::env::args().filter_map(|argument| argument.parse().ok()).collect();
    let number = |index: usize, default| numbers.get(index).copied().unwrap_or(default);
    let (frame_count, edge_count, thread_count) = (number(0, 40), number(1, 27), number(2, 2));
    let folder = tempfile::tempdir()?;
    let frames = write_frames(folder.path(), frame_count, edge_count)?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(thread_count).build()?;
    println!("{frame_count} frames of {} particles, {thread_count} threads", edge_count.pow(3));
    let mut ratios = Vec::new();
    for _ in 0..ROUND_COUNT {
        let start = Instant::now();
        for frame in &frames {
            convert_in_loop(frame, &pool)?;
        }
        let loop_s = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let first = convert_with_pipeline(&frames, &pool)?;
        let pipeline_s = start.elapsed().as_secs_f64();
        println!(
            "loop {loop_s:.2} s, pipeline {pipeline_s:.2} s: {:.3}; first frame after {first:.2} s",
            pipeline_s / loop_s
        );
        ratios.push(pipeline_s / loop_s);
    }
    ratios.sort_by(f64::total_cmp);
    println!("median {:.3}", ratios[ROUND_COUNT / 2]);
    Ok(())
}

/// Blocks of particles with small displacements, different in each frame.
fn write_frames(folder: &Path, frame_count: usize, edge_count: usize) -> Result<Vec<Frame>, Box<dyn Error>> {
    let settings = Arc::new(Settings::paper(f64::from(SPACING) / 2.0, &MethodOptions::default())?);
    let outputs = Arc::new(OutputOptions::new(folder.join("out"), &[OutputFormat::Glb, OutputFormat::Vdb]));
    fs::create_dir(&outputs.folder)?;
    let mut frames = Vec::new();
    for number in 0..frame_count {
        let input = folder.join(format!("f.{number:04}.bgeo"));
        let positions = FilePositions::F32(block(edge_count, number));
        let frame = ParticleFrame { positions, ..ParticleFrame::default() };
        bgeo::write(&frame, &mut BufWriter::new(fs::File::create(&input)?))?;
        frames.push(Frame::new(&FrameFile::new(input), &settings, &outputs));
    }
    Ok(frames)
}

fn block(edge_count: usize, number: usize) -> Vec<[f32; 3]> {
    let moved = |step: usize, phase: f32| step as f32 * SPACING + 0.3 * SPACING * (phase * 12.9898).sin();
    let particle = |index: usize| {
        let (x, y, z) = (index % edge_count, index / edge_count % edge_count, index / edge_count.pow(2));
        let phase = (index * 3 + number) as f32;
        [moved(x, phase), moved(y, phase + 1.0), moved(z, phase + 2.0)]
    };
    (0..edge_count.pow(3)).map(particle).collect()
}

/// Runs the pipeline. Returns the seconds until the first frame was written.
fn convert_with_pipeline(frames: &[Frame], pool: &ThreadPool) -> Result<f64, Box<dyn Error>> {
    let start = Instant::now();
    let mut first = None;
    let pipeline_options = PipelineOptions { memory_bytes: u64::MAX, ..PipelineOptions::new(pool) };
    let mut failures = Vec::new();
    run(frames, &pipeline_options, |index, outcome| {
        first.get_or_insert_with(|| start.elapsed().as_secs_f64());
        if !matches!(outcome, Outcome::Converted(_)) {
            failures.push(format!("frame {index}: {outcome:?}"));
        }
    });
    if failures.is_empty() { Ok(first.unwrap_or_default()) } else { Err(failures.join("\n").into()) }
}

/// Converts one frame in the plain loop.
fn convert_in_loop(frame: &Frame, pool: &ThreadPool) -> Result<(), Box<dyn Error>> {
    let content = read_file(&frame.input)?;
    let read = parse_particles(&frame.input, content, &AttributeRequest::default())?;
    let surface = pool.install(|| reconstruct_frame(&read.cloud.positions, &frame.settings));
    let path =
        |extension: &str| -> PathBuf { frame.outputs.folder.join(format!("{}.{extension}", frame.stem)) };
    write_atomically(&path("glb"), |out| {
        let mesh = mesh_view(&surface.mesh, &[]);
        pool.install(|| gltf::write_glb(&mesh, &MeshOptions::default(), &[], out))
    })?;
    write_atomically(&path("vdb"), |out| {
        let options = vdb::WriteOptions::default();
        pool.install(|| encode_level_set(&surface, &frame.settings, &options, &[]))?.write(out)
    })?;
    Ok(())
}
