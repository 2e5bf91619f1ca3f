//! What was typed. Nothing below the command line sees these types.
//!
//! Options for numbers take negative ones too: what is wrong with those is told where numbers are
//! checked, and not as an option called `-1`.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};

use super::frame_selection::FrameSelection;

/// Particles in, smooth meshes and level sets out.
#[derive(Debug, Parser)]
#[command(name = "meniscus", version, max_term_width = 100)]
pub(super) struct Typed {
    #[command(subcommand)]
    pub(super) command: Command,
}

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// Turn frames of particles into meshes and level sets.
    Convert(Box<ConvertArgs>),
    /// Tell what files hold: particles, meshes, level sets.
    Info(InfoArgs),
}

#[derive(Debug, Args)]
#[command(after_long_help = CHOOSING)]
pub(super) struct ConvertArgs {
    /// Files, folders, globs, or numbered patterns such as dam.####.bgeo, dam.%04d.bgeo, dam.{}.bgeo
    ///
    /// PLY, classic BGEO and delimited text, gzipped or not; the content decides, not the name.
    /// Frames run in natural order; files whose names differ only in the last number are one
    /// sequence, and share their settings.
    #[arg(required = true, value_name = "INPUT")]
    pub(super) inputs: Vec<PathBuf>,

    /// Folder for the results; it is made if it is not there
    ///
    /// dam.0012.bgeo becomes DIR/dam.0012.glb and so on. A file appears under its name only when it
    /// is whole. A result that would replace an input is refused.
    #[arg(long, value_name = "DIR")]
    pub(super) out: PathBuf,

    /// What to write: a list of glb, gltf, vdb, obj, ply
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "glb,vdb")]
    pub(super) format: Vec<Format>,

    /// Convert only frames with these numbers, such as 1-240x2 (every second) or 1-10,20,30-40x5
    #[arg(long, value_name = "NUMBERS")]
    pub(super) frames: Option<FrameSelection>,

    /// Write what was measured on each frame to this file, as JSON
    #[arg(long, value_name = "FILE")]
    pub(super) report: Option<PathBuf>,

    /// Threads to compute on; all there are by default. The results do not depend on it
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(super) threads: Option<u16>,

    /// After a frame that failed, stop or continue with the next
    #[arg(long, value_name = "WHAT", default_value = "continue")]
    pub(super) on_error: OnErrorChoice,

    /// Leave frames alone whose results are there, from the same input, settings and version
    #[arg(long)]
    pub(super) skip_done: bool,

    #[command(flatten, next_help_heading = "Surface")]
    pub(super) surface: SurfaceArgs,

    #[command(flatten, next_help_heading = "Solver")]
    pub(super) solver: SolverArgs,

    #[command(flatten, next_help_heading = "Formats")]
    pub(super) formats: FormatArgs,
}

#[derive(Debug, Args)]
pub(super) struct SurfaceArgs {
    /// Edge of a voxel h, in the particles' unit of length; half the particle spacing by default
    #[arg(long, value_name = "H", allow_negative_numbers = true)]
    pub(super) voxel_size: Option<f64>,

    /// Radius r_min around each particle that is always inside; √3·h by default
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(super) radius_min: Option<f64>,

    /// r_max / r_min: nothing farther than r_max from all particles is inside [default: 2]
    #[arg(long, value_name = "RATIO", allow_negative_numbers = true)]
    pub(super) radius_ratio: Option<f64>,

    /// Radius of the spheres that smoothing starts from; (r_min + r_max) / 2 by default
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(super) radius_init: Option<f64>,

    /// How the level set becomes triangles
    #[arg(long, value_name = "HOW", default_value = "dual")]
    pub(super) contour: ContourChoice,
}

#[derive(Debug, Args)]
pub(super) struct SolverArgs {
    /// How the smoothing is integrated
    #[arg(long, value_name = "WHICH", default_value = "fast")]
    pub(super) integrator: IntegratorChoice,

    /// Laplacian steps before the biharmonic ones; with 0 distances are restored instead [default: 15]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub(super) laplacian_steps: Option<u32>,

    /// Biharmonic steps [default: 5; explicit: 500]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub(super) steps: Option<u32>,

    /// Size of a biharmonic step, in units of h⁴ [default: 20; explicit: 0.01]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub(super) step_size: Option<f64>,

    /// Restore distances after so many biharmonic steps [default: 1; explicit: 50]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub(super) redistance_every: Option<u32>,

    /// Relative tolerance of the conjugate gradients, for implicit only [default: 0.0001]
    #[arg(long, value_name = "E", allow_negative_numbers = true)]
    pub(super) cg_tolerance: Option<f64>,
}

#[derive(Debug, Args)]
pub(super) struct FormatArgs {
    /// Which axis of the particles points up: in glTF it must be y, and z is turned there
    #[arg(long, value_name = "AXIS", default_value = "y")]
    pub(super) up: UpChoice,

    /// Store 16-bit values in .vdb: smaller, with three decimal digits
    #[arg(long)]
    pub(super) vdb_half: bool,

    /// How values are packed in .vdb
    #[arg(long, value_name = "HOW", default_value = "blosc")]
    pub(super) vdb_compression: CompressionChoice,
}

#[derive(Debug, Args)]
pub(super) struct InfoArgs {
    /// Files of particles, meshes or level sets
    #[arg(required = true, value_name = "FILE")]
    pub(super) files: Vec<PathBuf>,

    /// Write JSON: a list with an object for each file
    #[arg(long)]
    pub(super) json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Format {
    /// Binary glTF: positions, normals
    Glb,
    /// Text glTF
    Gltf,
    /// The level set, for OpenVDB
    Vdb,
    /// Wavefront OBJ
    Obj,
    /// Binary PLY
    Ply,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum OnErrorChoice {
    /// Write exactly the frames before the one that failed
    Stop,
    /// Go on with the next frame
    Continue,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum IntegratorChoice {
    /// Implicit steps without reductions: the quickest
    Fast,
    /// The paper's implicit steps: conjugate gradients with a growing active set
    Implicit,
    /// The paper's explicit steps: many small ones
    Explicit,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum ContourChoice {
    /// Dual contouring: fewer and better shaped triangles
    Dual,
    /// Marching tetrahedra: as the paper does
    Tetrahedra,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum UpChoice {
    /// As glTF has it
    Y,
    /// As Blender and many simulators have it
    Z,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum CompressionChoice {
    /// All values as they are
    None,
    /// Active values only
    Active,
    /// Active values only, compressed: OpenVDB's default
    Blosc,
}

const CHOOSING: &str = "\
Choosing the voxel size and the radii:
  The voxel size h is the only number you may need. Without it, h is half the particle spacing,
  measured on the first frame of the sequence that has enough particles, printed, and the same for
  every frame. Half of h shows more detail and takes about four times the time and the memory.

  The surface is the smoothest one that keeps a sphere of radius r_min around every particle inside,
  and leaves everything outside that is farther than r_max from all of them.

  --radius-min    √3·h by default: the diagonal of a voxel, so that the grid catches every particle,
                  wherever it lies between the voxels. With less, single particles may be lost.
  --radius-ratio  r_max / r_min: how much room there is for smoothing. 2 is the paper's choice; more
                  is smoother, less follows the particles more faithfully.
  --radius-init   where smoothing starts. The spheres of neighbouring particles must overlap, or the
                  surface begins with holes that smoothing cannot close: about 0.9 spacings or more.

  With the default h all of that is so. The radii grow and shrink with h; for an h smaller than half
  the spacing, fix them in world units at what they are by default, or the spheres come apart. For
  particles 0.05 apart, say, h = 0.025 needs nothing else, and h = 0.0125 needs
    --voxel-size 0.0125 --radius-min 0.0433 --radius-init 0.065

Exit status:
  0    every frame was converted, or was done already
  1    some frames failed; each is named, with why, and the others are there
  2    the command cannot be carried out, or no frame was converted
  130  interrupted: what is there is whole, and --skip-done goes on from it";
