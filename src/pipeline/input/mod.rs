//! Inputs of frames: files, their steps and sequences, and obstacles.
//!
//! ```text
//!   source      groups files into sequences of frames    steps        files with several frames
//!   frame       frames to convert, and their outcomes    bounds       bounding boxes of frames and sequences
//!   frame_rate  the frame rate by the times of frames
//!   frame_input  particles in memory or on disk, or a level set
//!   reading     reads files and parses particles         attributes   the attributes that a frame needs
//!   container   files with frames that are not ranges of bytes, and the files that they name
//!   filter      chooses particles by their attributes
//!   around      the frames before and after a frame
//!   level_set_file  level sets from .vdb                 mesh_file    meshes of any supported format
//!   measured_spacing  the spacing of a sequence          conflicts    outputs that would replace inputs
//!   obstacles   the obstacles of a frame                 obstacle_file  reads and parses one of them
//!   out_of_reach  obstacles too far away to have an effect
//!   position_doubts  positions that cannot make the expected surface
//! ```

pub(super) mod around;
pub(super) mod attributes;
pub(super) mod bounds;
pub(super) mod conflicts;
pub(super) mod container;
pub(super) mod filter;
pub(super) mod frame;
pub(super) mod frame_input;
pub(super) mod frame_rate;
pub(super) mod level_set_file;
pub(super) mod measured_spacing;
pub(super) mod mesh_file;
pub(super) mod obstacle_file;
pub(super) mod obstacles;
pub(super) mod out_of_reach;
pub(super) mod position_doubts;
pub(super) mod reading;
pub(super) mod source;
pub(super) mod steps;
