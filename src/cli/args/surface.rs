//! The options of the method and of what is written: the same for every command that converts, and
//! for the keys of a file.
//!
//! Nothing here has a default of its own, so that it is known what was given: an option overrides
//! what stands in a file.

use clap::{Args, ValueEnum};

#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct SurfaceArgs {
    /// Edge of a voxel h, in the particles' unit of length; half the particle spacing by default
    #[arg(long, value_name = "H", allow_negative_numbers = true)]
    pub(in crate::cli) voxel_size: Option<f64>,

    /// Radius r_min around each particle that is always inside; √3·h by default
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(in crate::cli) radius_min: Option<f64>,

    /// r_max / r_min: nothing farther than r_max from all particles is inside [default: 2]
    #[arg(long, value_name = "RATIO", allow_negative_numbers = true)]
    pub(in crate::cli) radius_ratio: Option<f64>,

    /// Radius of the spheres that smoothing starts from; (r_min + r_max) / 2 by default
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(in crate::cli) radius_init: Option<f64>,

    /// How the level set becomes triangles [default: dual]
    #[arg(long, value_name = "HOW")]
    pub(in crate::cli) contour: Option<ContourChoice>,
}

#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct SolverArgs {
    /// How the smoothing is integrated [default: fast]
    #[arg(long, value_name = "WHICH")]
    pub(in crate::cli) integrator: Option<IntegratorChoice>,

    /// Laplacian steps before the biharmonic ones; with 0 distances are restored instead [default: 15]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub(in crate::cli) laplacian_steps: Option<u32>,

    /// Biharmonic steps [default: 5; explicit: 500]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub(in crate::cli) steps: Option<u32>,

    /// Size of a biharmonic step, in units of h⁴ [default: 20; explicit: 0.01]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub(in crate::cli) step_size: Option<f64>,

    /// Restore distances after so many biharmonic steps [default: 1; explicit: 50]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub(in crate::cli) redistance_every: Option<u32>,

    /// Relative tolerance of the conjugate gradients, for implicit only [default: 0.0001]
    #[arg(long, value_name = "E", allow_negative_numbers = true)]
    pub(in crate::cli) cg_tolerance: Option<f64>,
}

#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct FormatArgs {
    /// Which axis of the particles points up: in glTF it must be y, and z is turned there [default: y]
    #[arg(long, value_name = "AXIS")]
    pub(in crate::cli) up: Option<UpChoice>,

    /// Store 16-bit values in .vdb: smaller, with three decimal digits
    #[arg(long)]
    pub(in crate::cli) vdb_half: bool,

    /// How values are packed in .vdb [default: blosc]
    #[arg(long, value_name = "HOW")]
    pub(in crate::cli) vdb_compression: Option<CompressionChoice>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum Format {
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
pub(in crate::cli) enum IntegratorChoice {
    /// Implicit steps without reductions: the quickest
    Fast,
    /// The paper's implicit steps: conjugate gradients with a growing active set
    Implicit,
    /// The paper's explicit steps: many small ones
    Explicit,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum ContourChoice {
    /// Dual contouring: fewer and better shaped triangles
    Dual,
    /// Marching tetrahedra: as the paper does
    Tetrahedra,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum UpChoice {
    /// As glTF has it
    Y,
    /// As Blender and many simulators have it
    Z,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum CompressionChoice {
    /// All values as they are
    None,
    /// Active values only
    Active,
    /// Active values only, compressed: OpenVDB's default
    Blosc,
}

impl SurfaceArgs {
    /// These, and where one is not given, that of `below`.
    pub(in crate::cli) fn over(&self, below: &SurfaceArgs) -> SurfaceArgs {
        SurfaceArgs {
            voxel_size: self.voxel_size.or(below.voxel_size),
            radius_min: self.radius_min.or(below.radius_min),
            radius_ratio: self.radius_ratio.or(below.radius_ratio),
            radius_init: self.radius_init.or(below.radius_init),
            contour: self.contour.or(below.contour),
        }
    }
}

impl SolverArgs {
    /// These, and where one is not given, that of `below`.
    pub(in crate::cli) fn over(&self, below: &SolverArgs) -> SolverArgs {
        SolverArgs {
            integrator: self.integrator.or(below.integrator),
            laplacian_steps: self.laplacian_steps.or(below.laplacian_steps),
            steps: self.steps.or(below.steps),
            step_size: self.step_size.or(below.step_size),
            redistance_every: self.redistance_every.or(below.redistance_every),
            cg_tolerance: self.cg_tolerance.or(below.cg_tolerance),
        }
    }
}

impl FormatArgs {
    /// These, and where one is not given, that of `below`.
    pub(in crate::cli) fn over(&self, below: &FormatArgs) -> FormatArgs {
        FormatArgs {
            up: self.up.or(below.up),
            vdb_half: self.vdb_half || below.vdb_half,
            vdb_compression: self.vdb_compression.or(below.vdb_compression),
        }
    }
}
