//! Frames to convert, and their outcomes.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::surface::options::Settings;
use crate::surface::report::ReconstructionReport;

use super::around::{AroundFrame, RecordedAround};
use super::level_set_file::is_level_set;
use super::obstacles::ObstacleFiles;
use super::source::FrameFile;
use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::files::named_files::NamedFiles;
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::records::frame_records::FrameRecords;
use crate::pipeline::records::record_line::{DoneRecord, OutputFile};
use crate::pipeline::target::framing::Framing;
use crate::pipeline::target::outputs::OutputOptions;
use crate::pipeline::target::picture::PictureOptions;
use crate::pipeline::target::viewpoint::CameraChoice;
use crate::pipeline::warning::Warning;

/// The kind of conversion.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Job {
    /// Particles become a surface.
    #[default]
    Surface,
    /// The level set in a .vdb becomes a surface. When the file is read, its voxel size replaces that of the
    /// frame's settings.
    LevelSet {
        /// The distance by which smoothing may move the surface, in voxels; 0 leaves the surface unchanged.
        max_deviation_voxels: f64,
        /// The position of voxel (0, 0, 0) in world units, set when the file is read.
        origin: DVec3,
    },
    /// Particles are written unchanged, in particle formats. Of the settings only the condition matters.
    Particles,
}

impl Job {
    /// The conversion of a level set to a surface that smoothing moves by at most this many voxels.
    pub fn level_set(max_deviation_voxels: f64) -> Job {
        Job::LevelSet { max_deviation_voxels, origin: DVec3::ZERO }
    }

    /// The conversion of a file to a surface, chosen by the file's name. A level set is not smoothed.
    pub fn of(path: &Path) -> Job {
        if is_level_set(path) { Job::level_set(0.0) } else { Job::Surface }
    }

    pub(crate) fn max_deviation_voxels(&self) -> f64 {
        if let Job::LevelSet { max_deviation_voxels, .. } = self { *max_deviation_voxels } else { 0.0 }
    }

    /// The position of voxel (0, 0, 0), world units.
    pub(crate) fn origin(&self) -> DVec3 {
        if let Job::LevelSet { origin, .. } = self { *origin } else { DVec3::ZERO }
    }
}

/// One frame to convert.
#[derive(Clone, Debug)]
pub struct Frame {
    /// The particle file or level-set file.
    pub input: PathBuf,
    /// The kind of conversion.
    pub job: Job,
    /// The base name of the outputs, without folder and extension.
    pub stem: String,
    /// The settings of its sequence.
    pub settings: Arc<Settings>,
    /// The outputs, and their folder.
    pub outputs: Arc<OutputOptions>,
    /// Its number, if it has one. A frame uses the files of moving obstacles that have the same number.
    pub number: Option<i64>,
    /// Its obstacles.
    pub obstacles: Arc<ObstacleFiles>,
    /// The frames before and after it on which its surface depends; as many as its settings need, or fewer at the ends
    /// of a sequence.
    pub around: Arc<[AroundFrame]>,
    /// The camera of its sequence, if later frames may still change it; `None` if the camera in `outputs` is
    /// used.
    pub framing: Option<Arc<Framing>>,
    /// A hash of the stamps of its obstacle files when the daemon queued it, for its record.
    pub obstacle_stamp: Option<String>,
    /// The records of the folder of its outputs; `None` if they are not recorded.
    pub records: Option<Arc<FrameRecords>>,
}

impl Frame {
    /// The frame in a file, without obstacles. Its outputs have the base name of the file.
    pub fn new(file: &FrameFile, settings: &Arc<Settings>, outputs: &Arc<OutputOptions>) -> Frame {
        Frame {
            input: file.path.clone(),
            job: Job::of(&file.path),
            stem: file.stem(),
            settings: Arc::clone(settings),
            outputs: Arc::clone(outputs),
            number: file.number(),
            obstacles: Arc::default(),
            around: Arc::default(),
            framing: None,
            obstacle_stamp: None,
            records: None,
        }
    }

    /// The same frame with this camera for its pictures.
    pub(crate) fn with_camera(&self, camera: CameraChoice) -> Frame {
        let picture = PictureOptions { camera, ..self.outputs.picture };
        Frame { outputs: Arc::new(OutputOptions { picture, ..(*self.outputs).clone() }), ..self.clone() }
    }

    /// Whether its surface is averaged with those of other frames.
    pub(crate) fn is_averaged(&self) -> bool {
        let is_averaged = |around: &AroundFrame| around.steps.unsigned_abs() <= self.settings.temporal;
        self.job == Job::Surface && self.around.iter().any(is_averaged)
    }

    /// How many frames are in memory at most while it is computed. All frames that are averaged have the same number,
    /// so whether one fits does not depend on the frame for which it is computed.
    pub(crate) fn held_count(&self) -> u64 {
        if self.is_averaged() { self.settings.held_frame_count() } else { 1 }
    }

    /// Whether pictures of the frame are written.
    pub(crate) fn has_pictures(&self) -> bool {
        self.outputs.has_pictures()
    }

    /// The error of a stage of the method on this frame.
    pub(crate) fn failed(&self, during: Stage, cause: Cause) -> FrameError {
        let path = match cause {
            Cause::Scratch(_) => self.outputs.folder.join(&self.stem),
            _ => self.input.clone(),
        };
        FrameError { path, during, cause }
    }

    /// The paths of the frame's outputs.
    pub fn output_paths(&self) -> Vec<PathBuf> {
        self.outputs.files(&self.stem).into_iter().map(|(_, path)| path).collect()
    }
}

/// The state of a file that was read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct InputState {
    /// The stamp of the file, the same before and after the read.
    pub stamp: FileStamp,
    /// A hash of the file's bytes. It distinguishes files reliably, but is not secure against deliberate
    /// collisions.
    pub hash: u128,
    /// The files that the frame was read from besides this one, if there are any.
    pub named: Option<Arc<NamedFiles>>,
}

/// The outcome of a frame.
#[derive(Debug)]
pub enum Outcome {
    /// All outputs were written.
    Converted(Box<FrameReport>),
    /// All outputs existed already, from the same input with the same settings.
    AlreadyDone {
        /// The state of the input that was read.
        input: InputState,
        /// The record of the frame.
        record: Arc<DoneRecord>,
    },
    /// The input was written while it was read, so the bytes are neither those of the old file nor those of
    /// the new one. The caller has to read it again later.
    Changed,
    /// No output was written.
    Failed(FrameError),
    /// Not attempted, because an earlier frame failed and the run stops at the first failure.
    NotStarted,
}

/// Wall-clock seconds in each stage. Several frames are converted at once, each on one thread; a frame alone
/// uses all threads. So the seconds may add up to more than the run took, and they show the cost of a frame
/// only if it is converted alone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Seconds {
    /// Reading and parsing.
    pub read: f64,
    /// Rasterizing.
    pub rasterize: f64,
    /// Smoothing.
    pub smooth: f64,
    /// Contouring, and interpolating attributes.
    pub contour: f64,
    /// Encoding and writing, without pictures.
    pub write: f64,
    /// Rendering and writing pictures.
    #[serde(default)]
    pub preview: f64,
}

impl Seconds {
    /// The seconds of a stage.
    pub(crate) fn of_stage(&mut self, stage: Stage) -> &mut f64 {
        match stage {
            Stage::Read => &mut self.read,
            Stage::Rasterize => &mut self.rasterize,
            Stage::Smooth => &mut self.smooth,
            Stage::Contour => &mut self.contour,
            Stage::Write => &mut self.write,
            Stage::Preview => &mut self.preview,
        }
    }

    /// The seconds of the method, without reading and writing.
    pub fn computing(&self) -> f64 {
        self.rasterize + self.smooth + self.contour
    }

    /// In the order of the stages.
    pub fn by_stage(&self) -> [f64; 6] {
        [self.read, self.rasterize, self.smooth, self.contour, self.write, self.preview]
    }

    /// The sum of all stages.
    pub fn total(&self) -> f64 {
        self.by_stage().iter().sum()
    }
}

/// The measurements of a converted frame.
#[derive(Clone, Debug, Default)]
pub struct FrameReport {
    /// The state of the input that was read.
    pub input: InputState,
    /// The report of the method.
    pub reconstruction: ReconstructionReport,
    /// The names and hashes of its obstacle files; empty without obstacles.
    pub obstacles: String,
    /// The frames before and after it on which it depends.
    pub around: Vec<RecordedAround>,
    /// The number of boundary edges of the obstacle meshes.
    pub obstacle_open_edge_count: usize,
    /// The voxel size of a level set, in world units; `None` for other inputs, whose settings contain it.
    pub voxel_size: Option<f64>,
    /// Seconds in each stage.
    pub seconds: Seconds,
    /// The peak memory of this process until the frame was written, in bytes; `None` if the system does not
    /// report it.
    pub peak_memory_bytes: Option<u64>,
    /// The paths of the files that were written.
    pub outputs: Vec<PathBuf>,
    /// The names, stamps and hashes of the files in `outputs`.
    pub files: Vec<OutputFile>,
    /// Warnings about the frame, without those from [measurements](FrameReport::all_warnings).
    pub warnings: Vec<Warning>,
    /// The name of the particles' velocities, if the outputs could have velocities but do not.
    pub unused_velocity: Option<String>,
    /// The record of the frame, if it has records.
    pub record: Option<Arc<DoneRecord>>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::OutputFormat;
    use crate::surface::options::MethodOptions;

    /// After a full disk, the daemon checks the folder of the error's path before it retries.
    #[test]
    fn scratch_error_names_the_path_of_the_outputs() {
        let settings = Settings::paper(0.1, &MethodOptions::default()).expect("settings");
        let outputs = OutputOptions::new("out", &[OutputFormat::Glb]);
        let file = FrameFile::new("in/dam.1.ply".into());
        let frame = Frame::new(&file, &Arc::new(settings), &Arc::new(outputs));
        let full = Cause::Scratch(std::io::ErrorKind::StorageFull.into());
        let error = frame.failed(Stage::Smooth, full);
        assert_eq!(error.path, Path::new("out").join("dam.1"));
        assert!(error.is_disk_full());
        assert!(error.to_string().contains("dam.1: cannot write temporary files beside the results "));
        let changed = frame.failed(Stage::Smooth, Cause::Changed);
        assert_eq!(changed.path, frame.input);
    }
}
