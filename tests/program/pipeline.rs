//! Frames in the stages of the pipeline.

use std::fmt;
use std::fs;
use std::path::PathBuf;
use std::sync::Arc;

use meniscus::pipeline::{
    Cause, FileStamp, Frame, FrameRecords, IndexPolicy, Job, Observer, OnError, Outcome, OutputFormat,
    OutputOptions, PictureOptions, PipelineOptions, STATE_FOLDER, Stage, run,
};
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus_formats::{gltf, vdb};
use rayon::ThreadPool;
use tempfile::{TempDir, tempdir};

use crate::program::scene::{block, names_in, write_ply};

/// Calls a function as each stage begins, with the number of particles of the frame.
pub(crate) struct OnStage<H>(pub(crate) H);

impl<H> fmt::Debug for OnStage<H> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("OnStage")
    }
}

impl<H: Fn(Stage, usize) + Sync> Observer for OnStage<H> {
    fn began(&self, frame: &Frame, stage: Stage) {
        (self.0)(stage, count_of(frame));
    }
}

/// The number of particles of a frame, which is in its name.
pub(crate) fn count_of(frame: &Frame) -> usize {
    let name = frame.input.file_name().expect("a name").to_string_lossy();
    name.split('.').nth(2).expect("a number").parse().expect("a number")
}

/// The number of particles of frames that panic in a stage.
const BROKEN_COUNT: usize = 27;

/// Panics as this stage of a frame of [`BROKEN_COUNT`] particles begins.
fn broken(broken_stage: Option<Stage>) -> OnStage<impl Fn(Stage, usize)> {
    OnStage(move |stage, count| {
        let is_broken = broken_stage == Some(stage) && count == BROKEN_COUNT;
        assert!(!is_broken, "cannot bear {count} particles");
    })
}

/// A folder with frames, and the parts of a pipeline.
pub(crate) struct Bench {
    pub(crate) folder: TempDir,
    pub(crate) frames: Vec<Frame>,
}

impl Bench {
    /// A frame of `edge_count`³ particles for each number; 0 makes an invalid frame.
    pub(crate) fn new(edge_counts: &[usize]) -> Bench {
        let folder = tempdir().expect("a folder");
        let settings = Arc::new(Settings::paper(0.05, &MethodOptions::default()).expect("valid"));
        let outputs = Arc::new(OutputOptions {
            folder: folder.path().join("out"),
            formats: vec![OutputFormat::Glb, OutputFormat::Vdb, OutputFormat::Obj, OutputFormat::Ply],
            up: gltf::UpAxis::Y,
            meters_per_unit: 1.0,
            vdb: vdb::ValueEncoding::default(),
            picture: PictureOptions::default(),
            spray: Vec::new(),
            stage: None,
        });
        fs::create_dir(&outputs.folder).expect("made");
        let records = Arc::new(FrameRecords::open(&outputs.folder).expect("readable"));
        let mut frames = Vec::new();
        for (number, &edge_count) in edge_counts.iter().enumerate() {
            let input = folder.path().join(format!("f.{number}.{}.ply", edge_count.pow(3)));
            match edge_count {
                0 => fs::write(&input, "ply\nformat nonsense 1.0\n").expect("written"),
                _ => write_ply(&input, &block(edge_count, 0.0)),
            }
            let stem = format!("f.{number}");
            frames.push(Frame {
                input,
                job: Job::Surface,
                stem,
                settings: settings.clone(),
                outputs: outputs.clone(),
                number: None,
                obstacles: Arc::default(),
                around: Arc::default(),
                framing: None,
                obstacle_stamp: None,
                records: Some(Arc::clone(&records)),
            });
        }
        Bench { folder, frames }
    }

    pub(crate) fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    /// Changes the outputs of all frames.
    fn change_outputs(&mut self, change: impl Fn(&mut OutputOptions)) {
        for frame in &mut self.frames {
            change(Arc::make_mut(&mut frame.outputs));
        }
    }

    fn run_with(
        &self,
        broken_stage: Option<Stage>,
        on_error: OnError,
        skip_done: bool,
        threads: usize,
    ) -> Vec<Outcome> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let observer = broken(broken_stage);
        let options =
            PipelineOptions { on_error, skip_done, observer: Some(&observer), ..pipeline_options(&pool) };
        let mut outcomes = Vec::new();
        run(&self.frames, &options, |index, outcome| {
            assert_eq!(index, outcomes.len(), "outcomes come in order");
            outcomes.push(outcome);
        });
        assert_eq!(outcomes.len(), self.frames.len());
        assert!(names_in(&self.out()).iter().all(|name| !name.contains("tmp")), "a temporary file is left");
        outcomes
    }

    /// Converts all frames, or those that are not done yet.
    fn run(&self, skip_done: bool) -> Vec<Outcome> {
        self.run_with(None, OnError::Continue, skip_done, 2)
    }

    /// The numbers of the frames that have all outputs. Asserts that the other frames have none.
    pub(crate) fn written(&self) -> Vec<usize> {
        let names: Vec<_> = names_in(&self.out()).into_iter().filter(|name| name != STATE_FOLDER).collect();
        let count = |number: usize| names.iter().filter(|n| n.starts_with(&format!("f.{number}."))).count();
        let written: Vec<usize> = (0..self.frames.len()).filter(|&number| count(number) == 4).collect();
        assert_eq!(names.len(), 4 * written.len(), "{names:?}");
        written
    }
}

/// The usual settings, for tests in which they do not matter.
pub(crate) fn pipeline_options(pool: &ThreadPool) -> PipelineOptions<'_> {
    PipelineOptions {
        pool,
        on_error: OnError::Continue,
        skip_done: false,
        in_flight: 5,
        memory_bytes: 1 << 30,
        index_policy: IndexPolicy::OnRead,
        observer: None,
    }
}

/// One letter for each outcome.
pub(crate) fn letters(outcomes: &[Outcome]) -> String {
    let letter = |outcome: &Outcome| match outcome {
        Outcome::Converted(_) => 'c',
        Outcome::AlreadyDone { .. } => 'd',
        Outcome::Failed(_) => 'f',
        Outcome::NotStarted => 'n',
        Outcome::Changed => 'x',
    };
    outcomes.iter().map(letter).collect()
}

#[test]
fn frames_are_converted_in_order() {
    let bench = Bench::new(&[2, 3, 4, 5, 6, 2, 3, 4, 5, 6, 2, 3, 4, 5, 6, 2]);
    let outcomes = bench.run(false);
    assert_eq!(letters(&outcomes), "cccccccccccccccc");
    assert_eq!(bench.written().len(), 16);
    let Outcome::Converted(report) = &outcomes[1] else { panic!("not converted") };
    assert_eq!(report.reconstruction.particle_count, 27);
    assert_eq!(report.outputs[0], bench.out().join("f.1.glb"));
    let size_bytes = |path: &PathBuf| fs::metadata(path).expect("there").len();
    let sizes: Vec<u64> = report.files.iter().map(|file| file.stamp.size).collect();
    assert_eq!(sizes, report.outputs.iter().map(size_bytes).collect::<Vec<_>>());
    assert_eq!(report.input.stamp, FileStamp::of_path(&bench.frames[1].input).expect("there"));
    // The report has the hash and the stamp of the file, also for a frame that was done already.
    let again = bench.run(true);
    let Outcome::AlreadyDone { input, .. } = &again[1] else { panic!("not done already") };
    assert_eq!((input, report.input.hash != 0), (&report.input, true));
    assert!(!cfg!(target_os = "linux") || report.peak_memory_bytes.is_some_and(|bytes| bytes > 1 << 20));
}

#[test]
fn failed_frame_does_not_stop_others() {
    for broken_stage in [Stage::Rasterize, Stage::Smooth, Stage::Contour] {
        let bench = Bench::new(&[2, 3, 0, 4]);
        let outcomes = bench.run_with(Some(broken_stage), OnError::Continue, false, 2);
        assert_eq!(letters(&outcomes), "cffc");
        assert_eq!(bench.written(), [0, 3]);
        let Outcome::Failed(error) = &outcomes[1] else { panic!("not failed") };
        assert_eq!(error.during, broken_stage);
        assert!(matches!(&error.cause, Cause::Panic(what) if what == "cannot bear 27 particles"), "{error}");
        assert!(error.to_string().contains("f.1.27.ply"), "{error}");
        let Outcome::Failed(error) = &outcomes[2] else { panic!("not failed") };
        assert!(error.to_string().contains("f.2.0.ply: PLY, at"), "{error}");
    }
}

#[test]
fn stop_writes_exactly_the_frames_before() {
    for broken_stage in [None, Some(Stage::Rasterize), Some(Stage::Contour)] {
        let broken_edge = if broken_stage.is_none() { 0 } else { 3 };
        let bench = Bench::new(&[2, 2, broken_edge, 4, 4, 4, 4, 4, 4, 4, 4, 4]);
        assert_eq!(letters(&bench.run_with(broken_stage, OnError::Stop, false, 2)), "ccfnnnnnnnnn");
        assert_eq!(bench.written(), [0, 1]);
    }
}

#[test]
fn unwritable_output_fails_its_frame() {
    let bench = Bench::new(&[2, 2, 2]);
    fs::create_dir(bench.out().join("f.1.vdb")).expect("made");
    let outcomes = bench.run(false);
    assert_eq!(letters(&outcomes), "cfc");
    let Outcome::Failed(error) = &outcomes[1] else { panic!("not failed") };
    assert_eq!((error.during, error.path.clone()), (Stage::Write, bench.out().join("f.1.vdb")));
    assert!(std::error::Error::source(error).is_some_and(|cause| cause.is::<meniscus_formats::Error>()));
    // The frame has no output. It is converted when the folder at its path is removed.
    fs::remove_dir(bench.out().join("f.1.vdb")).expect("removed");
    assert_eq!(bench.written(), [0, 2]);
    assert_eq!(letters(&bench.run(true)), "dcd");
}

#[test]
fn missing_output_folder_is_created() {
    let mut bench = Bench::new(&[2, 2]);
    fs::remove_dir(bench.out()).expect("removed");
    bench.change_outputs(|outputs| outputs.folder = outputs.folder.join("shot/take"));
    assert_eq!(letters(&bench.run(false)), "cc");
    assert_eq!(names_in(&bench.out().join("shot/take")).len(), 8);
    // If a file has the path of the folder, the error names that file.
    let below_a_file = bench.folder.path().join("file/out");
    fs::write(bench.folder.path().join("file"), "").expect("written");
    bench.change_outputs(|outputs| outputs.folder.clone_from(&below_a_file));
    let outcomes = bench.run(false);
    let Outcome::Failed(error) = &outcomes[0] else { panic!("not failed") };
    assert_eq!((error.during, error.path.clone()), (Stage::Write, below_a_file));
}

#[test]
fn done_frames_are_kept_and_all_others_are_converted() {
    let mut bench = Bench::new(&[2, 2, 2, 2]);
    bench.change_outputs(|outputs| outputs.formats.push(OutputFormat::Gltf));
    let run = |bench: &Bench| letters(&bench.run(true));
    assert_eq!(run(&bench), "cccc");
    assert_eq!(run(&bench), "dddd");
    // A frame's input has changed, another's output is missing, another's output is damaged.
    write_ply(&bench.folder.path().join("f.0.8.ply"), &block(3, 0.0));
    fs::remove_file(bench.out().join("f.2.obj")).expect("removed");
    fs::write(bench.out().join("f.3.glb"), "glTF").expect("written");
    assert_eq!(run(&bench), "cdcc");
    assert_eq!(run(&bench), "dddd");
    // An option of one format has changed.
    bench.change_outputs(|outputs| outputs.vdb.half = true);
    assert_eq!(run(&bench), "cccc");
    bench.change_outputs(|outputs| outputs.up = gltf::UpAxis::Z);
    assert_eq!(run(&bench), "cccc");
    // Settings have changed.
    let choices = MethodOptions { laplacian_steps: Some(14), ..MethodOptions::default() };
    bench.frames[2].settings = Arc::new(Settings::paper(0.05, &choices).expect("valid"));
    assert_eq!(run(&bench), "ddcd");
}

#[test]
fn truncated_output_is_made_again() {
    let mut bench = Bench::new(&[2]);
    let formats: Vec<OutputFormat> =
        OutputFormat::ALL.into_iter().filter(|format| !format.is_picture()).collect();
    bench.change_outputs(|outputs| outputs.formats = formats.clone());
    let run = |bench: &Bench| letters(&bench.run(true));
    assert_eq!(run(&bench), "c");
    for extension in formats {
        let path = bench.out().join(format!("f.0.{extension}"));
        let whole = fs::read(&path).expect("readable");
        for length in [whole.len() * 6 / 10, whole.len() - 1] {
            fs::write(&path, &whole[..length]).expect("written");
            assert_eq!(run(&bench), "c", "{extension} cut to {length} of {} bytes", whole.len());
            assert!(fs::read(&path).expect("readable") == whole);
        }
        fs::write(&path, [&whole[..], b"x"].concat()).expect("written");
        assert_eq!(run(&bench), "c", "{extension} that grew");
    }
    assert_eq!(run(&bench), "d");
}

#[test]
fn bytes_do_not_depend_on_threads_or_other_frames() {
    let contents = |bench: &Bench| -> Vec<(String, Vec<u8>)> {
        let read = |name: String| (name.clone(), fs::read(bench.out().join(name)).expect("readable"));
        names_in(&bench.out()).into_iter().map(read).collect()
    };
    let mut expected = None;
    for threads in [1, 2, 4] {
        let mut bench = Bench::new(&[2, 3, 4, 5]);
        if threads == 4 {
            bench.frames.reverse();
        }
        bench.run_with(None, OnError::Continue, false, threads);
        let found = contents(&bench);
        assert_eq!(found.len(), 16);
        assert!(*expected.get_or_insert_with(|| found.clone()) == found, "{threads} threads");
    }
    // The outputs contain neither paths of this machine nor times: the folders above had different names.
}
