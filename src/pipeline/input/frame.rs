//! What is to be done with a frame, and what came of it.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::surface::options::Settings;
use crate::surface::report::SkinReport;

use super::level_set_file::is_level_set;
use super::obstacles::ObstacleFiles;
use super::source::FrameFile;
use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::target::framing::Framing;
use crate::pipeline::target::outputs::{OutputOptions, output_path};
use crate::pipeline::target::picture::PictureOptions;
use crate::pipeline::target::viewpoint::CameraChoice;
use crate::pipeline::warning::Warning;

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

    pub(crate) fn slack_voxels(&self) -> f64 {
        if let Job::LevelSet { slack_voxels, .. } = self { *slack_voxels } else { 0.0 }
    }

    /// Where voxel (0, 0, 0) is, world units.
    pub(crate) fn origin(&self) -> DVec3 {
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
    pub(crate) fn taken_by(&self, camera: CameraChoice) -> Frame {
        let picture = PictureOptions { camera, ..self.outputs.picture };
        Frame { outputs: Arc::new(OutputOptions { picture, ..(*self.outputs).clone() }), ..self.clone() }
    }

    /// Whether a picture is made of it.
    pub(crate) fn has_pictures(&self) -> bool {
        self.outputs.has_pictures()
    }

    /// A failure of a stage of the method on this frame.
    pub(crate) fn failed(&self, during: Stage, cause: Cause) -> FrameError {
        let path = match cause {
            Cause::Scratch(_) => self.outputs.folder.join(&self.stem),
            _ => self.input.clone(),
        };
        FrameError { path, during, cause }
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

/// Wall-clock seconds in each stage. Frames overlap: with several of them each has a thread to itself where one alone has all, so
/// these may add up to more than the run took. Only of a frame that is converted alone are they the cost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Seconds {
    /// Of reading and parsing.
    pub read: f64,
    /// Of rasterizing.
    pub rasterize: f64,
    /// Of smoothing.
    pub smooth: f64,
    /// Of contouring.
    pub contour: f64,
    /// Of encoding and writing, without pictures.
    pub write: f64,
    /// Of rendering and writing pictures.
    #[serde(default)]
    pub preview: f64,
}

impl Seconds {
    /// In the order of the stages.
    pub fn by_stage(&self) -> [f64; 6] {
        [self.read, self.rasterize, self.smooth, self.contour, self.write, self.preview]
    }

    /// Of all stages together.
    pub fn total(&self) -> f64 {
        self.by_stage().iter().sum()
    }
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
    /// Seconds in each stage.
    pub seconds: Seconds,
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

#[cfg(test)]
mod tests {
    use std::io;

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
        let error = frame.failed(Stage::Smooth, full);
        assert_eq!(error.path, Path::new("out").join("dam.1"));
        assert!(error.is_disk_full());
        assert!(error.to_string().contains("dam.1: cannot keep what does not fit into memory here: "));
        let changed = frame.failed(Stage::Smooth, Cause::Changed);
        assert_eq!(changed.path, frame.input);
    }
}
