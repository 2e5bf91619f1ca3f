//! What is to be done with a frame, and what came of it.

use std::any::Any;
use std::fmt;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;

use crate::surface::options::Settings;
use crate::surface::report::SkinReport;
use crate::surface::skin::{TooFine, TooLarge};

use super::bounds::is_level_set;
use super::framing::Framing;
use super::obstacles::ObstacleFiles;
use super::out_folder::is_disk_full;
use super::outputs::{OutputOptions, output_path};
use super::picture::PictureOptions;
use super::shown::shown;
use super::source::FrameFile;
use super::stamp::FileStamp;
use super::viewpoint::CameraChoice;
use super::warning::Warning;

/// What a frame is made from, and what it becomes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Job {
    /// Particles become a surface.
    #[default]
    Surface,
    /// The level set in a .vdb becomes a surface. The settings of the frame get the voxel size of the file when it is read.
    LevelSet {
        /// By how much smoothing may move the surface, in voxels; 0 leaves it as it is.
        slack_voxels: f64,
        /// Where the level set's voxel (0, 0, 0) is, in world units: known when it is read.
        origin: DVec3,
    },
    /// Particles are written as they are, in formats that hold particles. The settings do not matter.
    Particles,
}

impl Job {
    /// The level set in a .vdb becomes a surface that is at most this many voxels away from it.
    pub fn level_set(slack_voxels: f64) -> Job {
        Job::LevelSet { slack_voxels, origin: DVec3::ZERO }
    }

    /// How a file becomes a surface, by its name: a level set as it is.
    pub fn of(path: &Path) -> Job {
        if is_level_set(path) { Job::level_set(0.0) } else { Job::Surface }
    }

    pub(super) fn slack_voxels(&self) -> f64 {
        if let Job::LevelSet { slack_voxels, .. } = self { *slack_voxels } else { 0.0 }
    }

    /// Where voxel (0, 0, 0) is, world units.
    pub(super) fn origin(&self) -> DVec3 {
        if let Job::LevelSet { origin, .. } = self { *origin } else { DVec3::ZERO }
    }
}

/// One frame to convert.
#[derive(Clone, Debug)]
pub struct Frame {
    /// The file of particles, or of a level set.
    pub input: PathBuf,
    /// What it becomes.
    pub job: Job,
    /// What the outputs are called, without folder and extension.
    pub stem: String,
    /// The settings of its sequence.
    pub settings: Arc<Settings>,
    /// What is written, and where.
    pub outputs: Arc<OutputOptions>,
    /// Its number, where it has one: of obstacles that move, it has the file with the same.
    pub number: Option<u64>,
    /// What stands in the way.
    pub obstacles: Arc<ObstacleFiles>,
    /// The camera of its sequence, where frames that are not known yet may make it another one; else that of the
    /// outputs is taken.
    pub framing: Option<Arc<Framing>>,
}

impl Frame {
    /// The frame in a file, with nothing in its way. Its outputs are called what the file is called.
    pub fn new(file: &FrameFile, settings: &Arc<Settings>, outputs: &Arc<OutputOptions>) -> Frame {
        Frame {
            input: file.path.clone(),
            job: Job::of(&file.path),
            stem: file.stem(),
            settings: Arc::clone(settings),
            outputs: Arc::clone(outputs),
            number: file.number(),
            obstacles: Arc::default(),
            framing: None,
        }
    }

    /// The same frame with its pictures taken by this camera.
    pub(super) fn taken_by(&self, camera: CameraChoice) -> Frame {
        let picture = PictureOptions { camera, ..self.outputs.picture };
        Frame { outputs: Arc::new(OutputOptions { picture, ..(*self.outputs).clone() }), ..self.clone() }
    }

    /// Whether a picture is made of it.
    pub(super) fn has_pictures(&self) -> bool {
        self.outputs.has_pictures()
    }

    /// The files that the frame becomes.
    pub fn output_paths(&self) -> Vec<PathBuf> {
        let OutputOptions { folder, formats, .. } = &*self.outputs;
        formats.iter().map(|&format| output_path(folder, &self.stem, format)).collect()
    }
}

/// Which state of a file was read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReadInput {
    /// What the file system said of it, the same before and after reading.
    pub stamp: FileStamp,
    /// A hash of the file as it was on the disk. It tells files apart that are not made to be
    /// confused; it is not a seal.
    pub hash: u128,
}

/// What came of a frame.
#[derive(Debug)]
pub enum Outcome {
    /// All outputs were written.
    Converted(Box<FrameReport>),
    /// All outputs were there already, made from the same input by the same settings.
    AlreadyDone {
        /// Which state of the input was read.
        input: ReadInput,
        /// What did not hold when the frame was checked, by its certificate or the records of outputs; `None` where all
        /// held, or neither knows.
        fault: Option<String>,
    },
    /// The file was written while it was read: what was read is neither the old file nor the new
    /// one. It is to be read again later.
    Changed,
    /// No output was written.
    Failed(FrameError),
    /// Not attempted: an earlier frame failed, and that was to be the end.
    NotStarted,
}

/// What was measured on a frame that was converted.
#[derive(Clone, Debug, Default)]
pub struct FrameReport {
    /// What was read.
    pub input: ReadInput,
    /// What the method measured.
    pub skin: SkinReport,
    /// What stood in the way: names and hashes of files. Empty if nothing did.
    pub obstacles: String,
    /// Edges at which the meshes of obstacles are open.
    pub obstacle_open_edge_count: usize,
    /// The voxel size of a level set, in world units; `None` where the settings of the frame say it.
    pub voxel_size: Option<f64>,
    /// Seconds of reading and parsing.
    pub read_seconds: f64,
    /// Seconds of encoding and writing, without pictures.
    pub write_seconds: f64,
    /// Seconds of rendering and writing pictures.
    pub preview_seconds: f64,
    /// The most memory that this process has held at any time until the frame was written;
    /// `None` where the system does not tell.
    pub peak_memory_bytes: Option<u64>,
    /// The files that were written.
    pub outputs: Vec<PathBuf>,
    /// The size of each of them.
    pub output_bytes: Vec<u64>,
    /// What a user should know though the frame was converted, beside what [was measured](FrameReport::all_warnings).
    pub warnings: Vec<Warning>,
    /// The name of the particles' velocities, where there are some and the outputs could have them but do not.
    pub unused_velocity: Option<String>,
}

/// The stages of a frame, as users know them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// File to particles.
    Read,
    /// Particles to level sets.
    Rasterize,
    /// Smoothing.
    Smooth,
    /// Level set to mesh.
    Contour,
    /// Mesh and level set to files.
    Write,
    /// Level set to pictures.
    Preview,
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Stage::Read => "read",
            Stage::Rasterize => "rasterize",
            Stage::Smooth => "smooth",
            Stage::Contour => "contour",
            Stage::Write => "write",
            Stage::Preview => "preview",
        })
    }
}

/// Why a frame was not converted.
#[derive(Debug)]
pub struct FrameError {
    /// The file at fault: the input, or the output that could not be written. Of [`Cause::Scratch`], the
    /// outputs without their extension: they lie where what does not fit into memory was to be.
    pub path: PathBuf,
    /// The stage that failed.
    pub during: Stage,
    /// Why.
    pub cause: Cause,
}

/// What went wrong.
#[derive(Debug)]
pub enum Cause {
    /// The file: its content, or the system's refusal.
    File(meniscus_formats::Error),
    /// The input was written, replaced or removed while it was read.
    Changed,
    /// An obstacle.
    Obstacle(Box<ObstacleError>),
    /// The particles lack an attribute, or any use of it, without which they cannot be skinned as asked.
    Missing(String),
    /// The frame does not fit into the memory that it may take.
    TooLarge(TooLarge),
    /// The voxels are too small for the frame.
    TooFine(TooFine),
    /// What does not fit into memory could not be put on the disk, beside the outputs.
    Scratch(io::Error),
    /// This program: a broken invariant, told by the panic's message.
    Panic(String),
}

/// What is wrong with an obstacle of a frame.
#[derive(Debug)]
pub struct ObstacleError {
    /// Its file; of those that move, the one that the frame was to have.
    pub path: PathBuf,
    /// Why it cannot be read; `None` if it was written while it was read.
    pub source: Option<meniscus_formats::Error>,
}

impl fmt::Display for ObstacleError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "obstacle {}: ", self.path.display())?;
        match &self.source {
            Some(source) => source.fmt(f),
            None => f.write_str("changed while it was read"),
        }
    }
}

impl FrameError {
    /// A failure on account of a file.
    pub fn file(path: &Path, during: Stage, source: impl Into<meniscus_formats::Error>) -> FrameError {
        FrameError { path: path.to_owned(), during, cause: Cause::File(source.into()) }
    }

    /// Whether an output could not be written because the disk, or what its owner may use of it, is
    /// full: it will go better once there is room.
    pub fn is_disk_full(&self) -> bool {
        let source = match &self.cause {
            Cause::File(meniscus_formats::Error::Io(source)) if self.during == Stage::Write => source,
            Cause::Scratch(source) => source,
            _ => return false,
        };
        is_disk_full(source)
    }

    /// A failure of a stage of the method.
    pub(super) fn of_stage(frame: &Frame, during: Stage, cause: Cause) -> FrameError {
        let path = match cause {
            Cause::Scratch(_) => frame.outputs.folder.join(&frame.stem),
            _ => frame.input.clone(),
        };
        FrameError { path, during, cause }
    }

    /// Does `work` on the frame at `path`; a panic becomes an error of this frame.
    ///
    /// # Errors
    /// The panic's message.
    pub fn catch<T>(path: &Path, during: Stage, work: impl FnOnce() -> T) -> Result<T, FrameError> {
        // What was under way when the panic came is dropped with the frame: nobody sees it broken.
        catch_unwind(AssertUnwindSafe(work)).map_err(|payload| FrameError {
            path: path.to_owned(),
            during,
            cause: Cause::Panic(panic_message(&*payload)),
        })
    }
}

fn panic_message(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied();
    text.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message").to_owned()
}

impl fmt::Display for FrameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let FrameError { path, during, cause } = self;
        let path = shown(path);
        match cause {
            Cause::File(source) if *during == Stage::Read => write!(f, "{}: {source}", path),
            Cause::File(source) => write!(f, "{}: cannot {during}: {source}", path),
            Cause::Changed => write!(f, "{}: changed while it was read", path),
            Cause::Obstacle(error) => write!(f, "{}: {error}", path),
            Cause::Missing(what) => write!(f, "{}: {what}", path),
            Cause::TooLarge(too_large) => write!(f, "{}: {too_large}", path),
            Cause::TooFine(too_fine) => write!(f, "{}: {too_fine}", path),
            Cause::Scratch(source) => {
                write!(f, "{}: cannot keep what does not fit into memory here: {source}", path)
            }
            Cause::Panic(what) => {
                write!(f, "{}: a fault in this program, in the {during} stage: {what}", path)
            }
        }
    }
}

impl std::error::Error for FrameError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match &self.cause {
            Cause::File(source) => Some(source),
            Cause::Obstacle(error) => error.source.as_ref().map(|source| source as _),
            Cause::TooLarge(source) => Some(source),
            Cause::TooFine(source) => Some(source),
            Cause::Scratch(source) => Some(source),
            Cause::Changed | Cause::Missing(_) | Cause::Panic(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::OutputFormat;
    use crate::surface::options::MethodOptions;

    /// Whoever waits for room looks at the folder of the path.
    #[test]
    fn what_cannot_be_kept_is_told_of_where_it_was_to_be() {
        let settings = Settings::paper(0.1, &MethodOptions::default()).expect("settings");
        let outputs = OutputOptions::new("out", &[OutputFormat::Glb]);
        let file = FrameFile::new("in/dam.1.ply".into());
        let frame = Frame::new(&file, &Arc::new(settings), &Arc::new(outputs));
        let full = Cause::Scratch(io::ErrorKind::StorageFull.into());
        let error = FrameError::of_stage(&frame, Stage::Smooth, full);
        assert_eq!(error.path, Path::new("out").join("dam.1"));
        assert!(error.is_disk_full());
        assert!(error.to_string().contains("dam.1: cannot keep what does not fit into memory here: "));
        let changed = FrameError::of_stage(&frame, Stage::Smooth, Cause::Changed);
        assert_eq!(changed.path, frame.input);
    }
}
