//! Frames through the stages: from files to files, several at once.
//!
//! ```text
//!   source      which files are frames, in which order, of which sequence   steps  those of a file that has several
//!   measured_spacing  the particle spacing of a sequence, where nobody gave one
//!   outputs     which files will be written, and that none of them is an input
//!   frame       what is to be done, and what came of it
//!
//!   stages      read ─▶ rasterize ─▶ smooth ─▶ contour ─▶ write, several frames side by side
//!   scheduler   which frame computes next             budget   which frame may take how much memory
//!   semaphore   places in the channels between stages
//!   method      the three stages in the middle        memory   how much there is
//!
//!   attributes  what else is needed of each particle   obstacles  what is in the way of a frame
//!   number_pattern  names with a number in them
//!   reading     bytes to particles, of a file that     stamp     what tells one that was written again
//!               nobody writes meanwhile          frame_input  particles, in memory or read batch by batch, or a level set
//!   writing     surfaces to bytes                      provenance  what made them
//!   picture     surfaces to pictures                   viewpoint   where they are taken from
//!   level_set_file  level sets from .vdb                 picture_file  pictures from .png
//!   mesh_file   meshes of any program
//!   reconstruct  one frame in memory, and no files       particle_files  particles as they are, and no surface
//!   sink        all files of a frame, whole, or none   temporary   what they are until then
//!   file_set    replaces several files, or none        open        opens files without waiting at pipes
//!   output_states  finds outputs with damaged bytes    stored      positions as files hold them
//!   framing     the camera of a sequence of pictures   frame_number  the number in a frame's name
//!   warning     what a user should know of a frame     diagnostics  voxels that do not fit the particles
//!   observer    is notified while frames advance
//!   record      what was measured, as JSON             shot      all frames in one file
//!   json        values that JSON has no form for
//!   certificate_file  what was checked of a frame, beside it   inspection  what there is of a frame already
//! ```
//!
//! One command for one file, a sequence and a daemon run this same pipeline; they differ only in
//! where frames come from. The pipeline knows nothing of flags, terminals or how the method works.
//!
//! Whoever has files gives them to [`sequences`], finds the settings of each sequence, makes a [`Frame`] of each file,
//! and [`run`]s them; [`stream`] takes them one by one, as they come.
//!
//! ```
//! use std::sync::Arc;
//! use meniscus::pipeline::{
//!     PipelineOptions, Frame, FrameFile, LevelSetSkinning, Outcome, OutputFormat, OutputOptions, measure_spacing, run,
//! };
//! use meniscus::surface::options::{MethodOptions, Settings};
//!
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("block.csv");
//! # let line = |i: i32| format!("{},{},{}\n", i % 5, i / 5 % 5, i / 25);
//! # std::fs::write(&path, (0..125).map(line).collect::<String>())?;
//! # let out = folder.path().join("out");
//! let measured = measure_spacing([&*path], None)?;
//! let settings = Arc::new(Settings::resolve(&MethodOptions::default(), Some((&measured).into()))?);
//! let outputs = Arc::new(OutputOptions::new(&out, &[OutputFormat::Glb, OutputFormat::Vdb]));
//! let frames = [Frame::new(&FrameFile::new(path), &settings, &outputs)];
//! let pool = rayon::ThreadPoolBuilder::new().build()?;
//! run(&LevelSetSkinning, &frames, &PipelineOptions::new(&pool), |_, outcome| match outcome {
//!     Outcome::Converted(report) => assert_eq!(report.outputs, [out.join("block.glb"), out.join("block.vdb")]),
//!     other => panic!("{other:?}"),
//! });
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod attributes;
mod bounds;
mod budget;
mod certificate_file;
mod close_up;
mod diagnostics;
mod file_set;
mod frame;
mod frame_input;
mod frame_number;
mod frame_warnings;
mod framing;
mod inspection;
pub(crate) mod json;
mod level_set_file;
mod measured_spacing;
mod memory;
mod mesh_file;
mod method;
mod names;
mod number_pattern;
mod observer;
mod obstacle_warnings;
mod obstacles;
mod open;
mod out_folder;
mod output_states;
mod outputs;
mod particle_files;
mod phase_timer;
mod picture;
mod picture_file;
mod provenance;
mod reading;
mod reconstruct;
mod record;
mod scheduler;
mod semaphore;
mod shot;
mod shown; // paths as users see them
mod sink;
mod source;
mod stages;
mod stamp;
mod steps;
mod stored;
mod temporary;
mod viewpoint;
mod warning;
mod writing;

pub use attributes::Wanted;
pub use bounds::{NOTHING, bounds_of_particles, is_level_set, sequence_bounds};
pub use certificate_file::certificate_path;
pub use close_up::close_up;
pub use frame::{Cause, Frame, FrameError, FrameReport, Job, ObstacleError, Outcome, ReadInput, Stage};
pub use frame_input::FrameInput;
pub use framing::{Framed, Framing};
pub use inspection::{FrameState, Inspection, inspect};
pub use level_set_file::LevelSetFile;
pub(crate) use measured_spacing::{Attempt, measure_sequence};
pub use measured_spacing::{MeasuredSpacing, NoSpacing, measure_spacing};
pub use memory::{default_memory_bytes, resident_memory_bytes};
pub use mesh_file::read_mesh_file;
pub use method::{LevelSetSkinning, Method};
pub(crate) use names::text_of_name;
pub use number_pattern::{NumberPattern, files_in, is_absent, is_link_loop, may_be_file};
pub use observer::Observer;
pub use obstacles::{FrameObstacles, ObstacleFiles, ObstacleStamps};
pub use open::{has_other_names, open_itself, open_own, open_regular, read_regular, read_regular_text};
pub use out_folder::{
    OutFolderError, check_out_folder, is_disk_full, make_out_folder, recover_out_folder,
    refuse_file_for_folder,
};
pub use output_states::{OutputState, OutputStates};
pub use outputs::{
    Conflict, METERS_PER_UNIT, OutputFormat, OutputOptions, are_one_file, check_outputs, entry, output_path,
};
pub use phase_timer::PhaseTimer;
pub use picture::{PictureOptions, Scene, encode_picture, up_of, velocities};
pub use picture_file::{camera_of_picture, read_picture};
pub use provenance::{
    CAMERA, GENERATOR_AND_VERSION, SheetPart, are_particles, is_own_output, outputs_made_from,
    picture_provenance, settings_fingerprint, sheet_provenance,
};
pub use reading::{InputFile, ReadFrame, parse_particles, particles, read_file};
pub use reconstruct::{LoadedFrame, Reconstruction};
pub use record::{RunRecord, SequenceRecord};
pub use shot::{ShotError, ShotFormat, ShotOptions, ShotReport, ShotSource, is_shot, write_shot};
pub use shown::{STANDARD_INPUT, show_as, shown};
pub use sink::{replace_own, stop_writing, write_whole};
pub use source::{
    FrameFile, Sequence, has_particle_extension, have_fallen_apart, natural_order, order_subframes,
    promises_particles, sequences, single_frame_sequences, single_frames_note,
};
pub use stages::{OnError, PipelineOptions, default_in_flight, run, stream};
pub use stamp::FileStamp;
pub use steps::{
    FileFrames, StepsFoundBy, file_of, frame_name, frames_in, frames_in_unless, is_missing_step,
    may_hold_several, size_bytes, step_of,
};
pub use temporary::{SweepError, Swept, remove_left_behind, sweep_temporaries};
pub use viewpoint::{CameraChoice, Viewpoint};
pub use warning::{ObstacleFinding, ReportedWarnings, Scope, Warning};
pub use writing::{encode_level_set, mesh_view, vertex_attributes};
