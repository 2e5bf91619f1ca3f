//! Converts frames through a sequence of stages: from files to files, several at once.
//!
//! ```text
//!   files        names and stamps of files; atomic writes
//!   target       the outputs of a frame: formats, pictures, and their camera
//!   input        the inputs of frames: files and their steps, particles, level sets, obstacles
//!   records      the record of finished frames, provenance in outputs, the report of a run
//!   output       encodes surfaces and particles, and files that show all frames; reads pictures again
//!   error        why a frame was not converted          warning    likely mistakes in a converted frame
//!   diagnostics  detects voxel sizes and radii that do not fit the particles
//!
//!   stages       read ─▶ rasterize ─▶ smooth ─▶ contour ─▶ write, several frames in parallel
//!   scheduler    which frame computes next              budget     memory limits of frames in flight
//!   semaphore    slots in the channels between stages   memory     the memory of the machine and the process
//!   method       the three compute stages               observer   receives progress
//!   reconstruct  one frame in memory, without files
//!   in_memory    files and reports for surfaces that another program reconstructs in memory
//! ```
//!
//! `convert`, for one file or a sequence, and the daemon use the same pipeline; they differ only in the
//! source of frames. The pipeline does not depend on command-line flags, terminals, or the inner workings of
//! the method.
//!
//! To convert files, pass them to [`sequences`], resolve the settings of each sequence, create a [`Frame`]
//! for each file, and call [`run`]; [`stream`] takes frames one at a time, as they arrive.
//!
//! ```
//! use std::sync::Arc;
//! use meniscus::pipeline::{
//!     PipelineOptions, Frame, FrameFile, Outcome, OutputFormat, OutputOptions, measure_spacing, run,
//! };
//! use meniscus::surface::options::{MethodOptions, Settings, SpacingOptions};
//!
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("block.csv");
//! # let line = |i: i32| format!("{},{},{}\n", i % 5, i / 5 % 5, i / 25);
//! # std::fs::write(&path, (0..125).map(line).collect::<String>())?;
//! # let out = folder.path().join("out");
//! let measured = measure_spacing([&*path], &SpacingOptions::default())?;
//! let settings = Arc::new(Settings::resolve(&MethodOptions::default(), Some((&measured).into()))?);
//! let outputs = Arc::new(OutputOptions::new(&out, &[OutputFormat::Glb, OutputFormat::Vdb]));
//! let frames = [Frame::new(&FrameFile::new(path), &settings, &outputs)];
//! let pool = rayon::ThreadPoolBuilder::new().build()?;
//! run(&frames, &PipelineOptions::new(&pool), |_, outcome| match outcome {
//!     Outcome::Converted(report) => assert_eq!(report.outputs, [out.join("block.glb"), out.join("block.vdb")]),
//!     other => panic!("{other:?}"),
//! });
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod budget;
mod diagnostics;
mod error;
pub(crate) mod files;
mod in_memory;
mod input;
mod memory;
mod method;
mod observer;
mod output;
mod reconstruct;
mod records;
mod scheduler;
mod semaphore;
mod stages;
mod target;
mod warning;

pub(crate) use error::is_error_of_machine;
pub use error::{Cause, Conflict, FrameError, ObstacleError, Stage};
pub use files::atomic_write::{stop_writing, write_atomically};
pub use files::frame_number::{is_number, natural_order};
pub use files::host::host_name;
pub use files::identity::{FileId, are_same_file, canonical_path, entry_key};
pub(crate) use files::identity::{is_still_at, real_path};
pub use files::input_file::InputFile;
pub use files::named_files::NamedFiles;
pub(crate) use files::names::text_of_name;
pub use files::number_pattern::{NumberPattern, files_in, is_absent, is_link_loop, may_be_file};
pub use files::open::{open_itself, open_regular, read_regular, read_regular_text};
pub use files::out_folder::{
    OutFolderError, check_out_folder, is_disk_full, make_out_folder, refuse_file_for_folder,
};
pub use files::shown::{STANDARD_INPUT, show_as, shown};
pub use files::stamp::{FileStamp, now_ms};
pub use files::sweep::{remove_left_behind, sweep_temporaries, sweep_temporaries_of};
pub use in_memory::{
    EmbeddedSurface, InMemoryObstacle, in_memory_attributes, obstacle_warnings, requested_parts,
};
pub use input::around::{AroundFrame, NumberedFrames, RecordedAround, not_followed};
pub use input::attributes::AttributeRequest;
pub use input::bounds::{EMPTY_BOUNDS, bounds_of_particles, sequence_bounds};
pub use input::conflicts::check_outputs;
pub use input::container::files_joined_by;
pub use input::filter::keep_chosen;
pub use input::frame::{Frame, FrameReport, InputState, Job, Outcome, Seconds};
pub use input::frame_rate::{frame_rate, is_same_time, seconds_by_motion};
pub use input::level_set_file::{LevelSetFile, is_level_set};
pub(crate) use input::measured_spacing::{Attempt, measure_sequence};
pub use input::measured_spacing::{MeasuredSpacing, NoSpacing, measure_spacing, measured_by, preset_warning};
pub use input::mesh_file::{MeshFile, is_mesh, read_scene_mesh};
pub use input::obstacles::{FrameObstacles, ObstacleFiles, ObstacleStamps};
pub(crate) use input::position_doubts::shared_position;
pub use input::reading::{
    ParsedParticles, hash_of, hash_of_input, parse_particles, particles, read_file, read_particles_of,
    refuse_foreign,
};
pub(crate) use input::source::output_stem;
pub use input::source::{
    FrameFile, Sequence, are_single_frames, has_particle_extension, is_named_list, order_by_number,
    output_sequence, promises_particles, sequences, single_frame_sequences, single_frames_note,
};
pub use input::steps::{
    FileFrames, IndexPolicy, file_of, frame_name, frames_in, frames_in_unless, has_container_frames,
    is_missing_step, may_hold_several, size_bytes, step_of, time_of_frame,
};
pub(crate) use input::steps::{named_by_unreadable, step_in};
pub(crate) use memory::reading_limits;
pub use memory::{default_memory_bytes, limit_reading, resident_memory_bytes};
pub use method::ScratchFile;
pub use observer::Observer;
pub use output::picture_file::{camera_of_picture, read_picture};
pub use output::sequence_file::{
    SEQUENCE_POINTS, SequenceError, SequenceFormat, SequenceReport, SequenceSource, check_sequence_path,
    common_step, is_sequence_file, write_sequence_file,
};
pub use output::spray_files::points_of as spray_points;
pub(crate) use output::usd_stage::USD_STAGE_FRAMES;
pub use output::usd_stage::{
    UsdStageFrame, UsdStageReport, UsdStageSequence, next_stage_update, stage_frame_count, write_stage,
};
pub use output::writing::{encode_level_set, mesh_view, vertex_attributes};
pub use reconstruct::{LoadedFrame, Reconstruction};
pub use records::content::{SniffedContent, content, content_with, is_spray, spray_beside};
pub use records::figures::Figures;
pub use records::frame_records::{
    FrameRecords, LatestRecords, OutputComparison, RecordedFrame, ResultState, STATE_FOLDER, SettingValues,
    Wanted, settings_id,
};
pub use records::provenance::{
    CAMERA, GENERATOR_AND_VERSION, SheetPart, are_particles, is_own_output, picture_provenance,
    sheet_provenance,
};
pub(crate) use records::provenance::{recorded_settings, valid_cameras};
pub use records::reason::Reason;
pub use records::record::{RunRecord, SequenceRecord};
pub use records::record_line::{
    ChangedOutput, DaemonRecord, DaemonState, DoneRecord, OutputFile, RecordLine, SequenceCamera,
    SequenceKey, SharedSettings, UnfinishedRecord, UnfinishedState,
};
pub use stages::{OnError, PipelineOptions, default_in_flight, run, stream};
pub use target::close_up::close_up;
pub use target::framing::{Framed, Framing};
pub use target::outputs::{
    FRAME_RATES, METERS_PER_UNIT, OutputFormat, OutputOptions, PointFormat, UsdStageOptions, output_path,
};
pub use target::picture::{PictureOptions, PictureScene, encode_picture, up_of, velocities};
pub use target::viewpoint::{CameraChoice, Viewpoint};
pub use warning::{ReportedWarnings, Warning};
