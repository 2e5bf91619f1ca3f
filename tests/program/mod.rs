//! Tests the guarantees of the program from outside, through the command and through the library.

mod attributes; // attributes of particles, from an input file to the surface in the outputs
mod certified; // certificates describe the written mesh
mod cli; // the command: exit statuses, messages, names, refused arguments
mod columns; // tables whose columns get names, and tables that are no frames
mod conflicts; // outputs that would replace inputs, each other, or data of other programs
pub(crate) mod containers; // lists of VTK files, whose frames are joined from several
mod convert; // the command on real frames: same bytes, reports, frames that are done
#[cfg(unix)]
mod escaping; // names and contents of files neither forge lines nor control the terminal
mod filter; // particles chosen by a condition on their attributes
mod flicker; // the flicker of surfaces: known spheres, in meshes of every format
mod info; // the command that describes files
mod level_sets; // level sets in .vdb as inputs
mod library; // the library example gives the results of the command
pub(crate) mod manual; // man pages and shell completions cover every command and option
mod names; // names of frames and results: frame numbers, single files, pipes, clashes
mod obstacles; // obstacles: contact without gaps, from meshes to reports (paper, Fig. 15 and 16)
mod offset; // surface offset: position and guarantees
mod particles_only; // particles from one format to another, without a surface
mod pictures; // pictures of balls with known geometry; picture files, and the command
mod pipeline; // frames in the stages of the pipeline, with a quick method in place of the real one
mod raw_vdb; // writes unusual level sets
mod rest; // attributes that depend on earlier frames, or are computed
mod same_bytes;
pub(crate) mod scene; // small frames of particles, and a way to run the command
mod sequence_files; // meshes in other programs' formats, and all frames of a sequence in one file
mod service; // the daemon as a service: notifications to systemd, and signals
mod shards; // frames divided among machines: plans, shards, verification
mod shared; // files of real programs are converted, or refused with the expected reason
mod sheets; // sheets of pictures: contents, and the commands that they print
mod spacings; // the measured spacing of particles, against known values
mod spray; // small pieces of fluid as points beside the surface
mod stages; // stages that play the files of the frames
mod steps; // files with several frames: LAMMPS dumps and atoms
mod stream; // frames that arrive over time: order, limits, failures
mod temporal; // surfaces that are averaged over time
#[cfg(target_os = "linux")]
mod unreadable; // frames with unreadable metadata fail, instead of being ignored
pub(crate) mod vdb_file; // common parts of small .vdb files
mod velocities; // velocities computed from the frames before and after, and frame rates that contradict the motion
mod voxel_sizes; // voxel sizes and radii that do not fit the particles: errors and warnings
mod watch; // the commands `watch` and `status`: arguments and output
