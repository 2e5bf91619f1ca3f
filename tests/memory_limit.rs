//! Compares the peak memory of a process that converts many frames with the limit.

#![cfg(target_os = "linux")]

use std::env;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use meniscus::pipeline::{
    Frame, FrameFile, Job, ObstacleFiles, Outcome, OutputFormat, OutputOptions, PipelineOptions, run,
};
use meniscus::surface::options::{ClipBox, MethodOptions, Settings};
use meniscus_formats::{FilePositions, ParticleFrame, bgeo};
use tempfile::tempdir;

/// The process may exceed the limit by this fraction, for the program itself and for memory that the
/// allocator keeps.
const EXCESS_MAX: f64 = 0.1;

/// Set in the process that converts the frames.
const IS_CHILD: &str = "MENISCUS_TEST_OF_MEMORY";

/// Whether this is the process for a test. Otherwise runs the test in such a process: a process has only one
/// peak memory.
fn is_child(test: &str) -> bool {
    if env::var_os(IS_CHILD).is_some() {
        return true;
    }
    let mut child = Command::new(env::current_exe().expect("the path of this program"));
    child.args(["--exact", &format!("memory_limit::{test}"), "--nocapture"]).env(IS_CHILD, "1");
    let output = child.output().expect("started");
    let text = [output.stdout, output.stderr].concat();
    let text = String::from_utf8_lossy(&text);
    assert!(output.status.success() && text.contains("1 passed"), "{text}");
    false
}

/// Each of these particles has 125 leaves near it. Even counting these takes more memory than the limit, so the
/// frame is refused before they are counted. The message states what is known by then.
#[test]
fn scattered_frame_is_refused_within_the_limit() {
    if !is_child("scattered_frame_is_refused_within_the_limit") {
        return;
    }
    let folder = tempdir().expect("a folder");
    let input = folder.path().join("spray.bgeo");
    write(&input, spray(200_000).into_iter().map(|position| position.map(|along| 50.0 * along)).collect());
    let settings = Settings::paper(0.05, &MethodOptions::default()).expect("valid");
    let outputs = OutputOptions::new(folder.path().join("out"), &[OutputFormat::Vdb]);
    let frame = Frame::new(&FrameFile::new(input), &Arc::new(settings), &Arc::new(outputs));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads");
    let memory_bytes = 64 << 20;
    let pipeline_options = PipelineOptions { memory_bytes, ..PipelineOptions::new(&pool) };
    run(&[frame], &pipeline_options, |_, outcome| {
        let Outcome::Failed(error) = outcome else { panic!("{outcome:?}") };
        let message = error.to_string();
        assert!(
            message.contains("the frame needs at least ") && message.contains("limit is 64 MiB"),
            "{message}"
        );
    });
    assert!(peak_bytes() < memory_bytes, "{} bytes", peak_bytes());
}

/// Two of these frames together need more than the limit; one frame does not.
#[test]
fn memory_limit_holds() {
    if !is_child("memory_limit_holds") {
        return;
    }
    let memory_share = memory_of_frames(8, 128 << 20, Some(1));
    // The program must also make use of the memory within the limit.
    assert!(memory_share > 0.5, "only {memory_share:.2} of the limit");
}

/// Converts blocks of 250 047 particles alternating with spray that takes about as much memory. Some frames
/// have islands, cavities and parts beyond a box to remove, some an obstacle that belongs to them. Returns
/// the memory taken as a fraction of the limit, which is at most 1.
fn memory_of_frames(frame_count: usize, memory_bytes: u64, steps: Option<u32>) -> f64 {
    // The program also makes this call first.
    meniscus::cli::give_memory_back();
    let folder = tempdir().expect("a folder");
    // The memory of a frame does not depend on the number of steps.
    let choices = MethodOptions { laplacian_steps: steps, steps, ..MethodOptions::default() };
    let edits = MethodOptions {
        drop_islands: Some(5),
        fill_cavities: Some(100.0),
        clip: Some(ClipBox { min: [0.5; 3], max: [9.0; 3] }),
        ..choices.clone()
    };
    let settings = [choices, edits].map(|choices| Arc::new(Settings::paper(0.05, &choices).expect("valid")));
    let obstacles = folder.path().join("ball.#.obj");
    let bumps = bumps();
    (0..frame_count).for_each(|number| {
        fs::write(folder.path().join(format!("ball.{number}.obj")), &bumps).expect("written");
    });
    let obstacles = [ObstacleFiles::default(), ObstacleFiles::new(vec![obstacles])].map(Arc::new);
    let formats = [OutputFormat::Glb, OutputFormat::Vdb];
    let outputs = Arc::new(OutputOptions::new(folder.path().join("out"), &formats));
    let inputs = [("block.bgeo", block(63)), ("spray.bgeo", spray(20_000))];
    let inputs = inputs.map(|(name, positions)| {
        let path = folder.path().join(name);
        write(&path, positions);
        path
    });
    let frames: Vec<Frame> = (0..frame_count)
        .map(|number| Frame {
            job: Job::Surface,
            input: inputs[number % inputs.len()].clone(),
            stem: number.to_string(),
            settings: settings[number / 2 % 2].clone(),
            outputs: outputs.clone(),
            number: Some(number as i64),
            obstacles: obstacles[number / 4 % 2].clone(),
            around: Arc::default(),
            framing: None,
            obstacle_stamp: None,
            records: None,
        })
        .collect();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads");
    let pipeline_options = PipelineOptions { in_flight: 8, memory_bytes, ..PipelineOptions::new(&pool) };
    run(&frames, &pipeline_options, |index, outcome| {
        let Outcome::Converted(mut report) = outcome else { panic!("frame {index}: {outcome:?}") };
        // Spray with many holes causes a warning.
        report.warnings.retain(|warning| !warning.sentence.contains("holes: unless"));
        assert_eq!((report.warnings, report.obstacle_open_edge_count), (vec![], 0), "frame {index}");
    });
    let memory_share = peak_bytes() as f64 / memory_bytes as f64;
    assert!(memory_share < 1.0 + EXCESS_MAX, "{memory_share:.2} of the limit");
    memory_share
}

fn block(edge_count: usize) -> Vec<[f32; 3]> {
    let position = |index: usize| {
        [index / edge_count.pow(2), index / edge_count % edge_count, index % edge_count]
            .map(|i| i as f32 * 0.1)
    };
    (0..edge_count.pow(3)).map(position).collect()
}

/// A mesh of about 57 000 triangles: a floor with bumps, closed below.
fn bumps() -> String {
    const EDGE: usize = 120;
    let mut text = String::new();
    for index in 0..2 * EDGE * EDGE {
        let (x, y, is_top) = (index / EDGE % EDGE, index % EDGE, index >= EDGE * EDGE);
        let [x, y] = [x, y].map(|i| i as f64 * 10.0 / EDGE as f64 - 1.0);
        let z = if is_top { 0.2 * (5.0 * x).sin() * (5.0 * y).cos() } else { -1.0 };
        writeln!(text, "v {x:.6} {y:.6} {z:.6}").expect("strings take everything");
    }
    let mut quad = |corners: [usize; 4]| {
        let [a, b, c, d] = corners.map(|corner| corner + 1);
        writeln!(text, "f {a} {b} {c}\nf {a} {c} {d}").expect("strings take everything");
    };
    let (top, last) = (EDGE * EDGE, EDGE - 1);
    for i in 0..last {
        for j in 0..last {
            let at = |di: usize, dj: usize| (i + di) * EDGE + j + dj;
            quad([top + at(0, 0), top + at(1, 0), top + at(1, 1), top + at(0, 1)]);
            quad([at(0, 0), at(0, 1), at(1, 1), at(1, 0)]);
        }
        let sides = [
            [i * EDGE, (i + 1) * EDGE],
            [(i + 1) * EDGE + last, i * EDGE + last],
            [i + 1, i],
            [last * EDGE + i, last * EDGE + i + 1],
        ];
        for [a, b] in sides {
            quad([a, b, top + b, top + a]);
        }
    }
    text
}

/// Particles so far apart that nearly each is a separate drop.
fn spray(count: usize) -> Vec<[f32; 3]> {
    let extent = 0.2 * (count as f32).cbrt();
    let mut state = 1u64;
    let mut along = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 24) as f32 * extent
    };
    (0..count).map(|_| [along(), along(), along()]).collect()
}

fn write(path: &Path, positions: Vec<[f32; 3]>) {
    let frame = ParticleFrame { positions: FilePositions::F32(positions), ..ParticleFrame::default() };
    let file = File::create(path).expect("created");
    bgeo::write(&frame, &mut BufWriter::new(file)).expect("written");
}

/// The peak memory of this process.
fn peak_bytes() -> u64 {
    let status = fs::read_to_string("/proc/self/status").expect("readable");
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).expect("a peak");
    let kibibytes: u64 = peak.trim().trim_end_matches(" kB").parse().expect("a number");
    kibibytes << 10
}
