//! Frames through the stages: from files to files, several at once.
//!
//! ```text
//!   source      which files are frames, in which order, of which sequence
//!   voxel_size  the voxel size of a sequence, where nobody gave one
//!   outputs     which files will be written, and that none of them is an input
//!   stages      read ─▶ rasterize ─▶ smooth ─▶ contour ─▶ write, a thread each
//!   reading     bytes to particles           writing     surfaces to bytes
//!   sink        whole files or none          provenance  what made them
//!   record      what was measured, as JSON
//! ```
//!
//! One command for one file, a sequence and a daemon run this same pipeline; they differ only in
//! where frames come from. The pipeline knows nothing of flags, terminals or how the method works.

mod budget;
mod crew;
mod frame;
mod memory;
mod method;
mod outputs;
mod provenance;
mod reading;
mod record;
mod sink;
mod source;
mod stages;
mod stamp;
mod temporary;
mod voxel_size;
mod writing;

pub use frame::{Cause, Frame, FrameError, FrameReport, Outcome, ReadInput, Stage};
pub use memory::default_memory_bytes;
pub use method::{LevelSetSkinning, Method};
pub use outputs::{Conflict, OutputFormat, OutputOptions, check_outputs, output_path};
pub use provenance::{is_own_output, settings_fingerprint};
pub use reading::{ReadFrame, parse_particles, particles, read_file};
pub use record::{RunRecord, SequenceRecord};
pub use sink::{stop_writing, write_whole};
pub use source::{FrameFile, Sequence, has_particle_extension, natural_order, sequences};
pub use stages::{Conduct, OnError, default_in_flight, run, stream};
pub use stamp::FileStamp;
pub use temporary::sweep_temporaries;
pub use voxel_size::{AutomaticVoxelSize, NoVoxelSize, VOXELS_PER_SPACING, automatic_voxel_size};
