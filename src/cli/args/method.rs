//! The options of the method: the same for every command that converts, and for the keys of a file.
//!
//! Nothing here has a default of its own, so that it is known what was given: an option overrides
//! what stands in a file, and that what a preset says.

use std::path::PathBuf;

use clap::builder::RangedI64ValueParser;
use clap::{Args, ValueEnum};

use crate::surface::options::{AttributeSelection, ClipBox, ISLAND_MAX, ROUNDS_MAX, STEPS_MAX};

/// All of them, by heading.
#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct MethodArgs {
    #[command(flatten)]
    pub(in crate::cli) first: FirstArgs,

    #[command(flatten, next_help_heading = "Surface")]
    pub(in crate::cli) surface: SurfaceArgs,

    #[command(flatten, next_help_heading = "Particles")]
    pub(in crate::cli) particles: ParticleArgs,

    #[command(flatten, next_help_heading = "Obstacles")]
    pub(in crate::cli) obstacles: ObstacleArgs,

    #[command(flatten, next_help_heading = "Mesh")]
    pub(in crate::cli) mesh: MeshArgs,

    #[command(flatten, next_help_heading = "Solver")]
    pub(in crate::cli) solver: SolverArgs,
}

/// What most people need, and no more.
#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct FirstArgs {
    /// The defaults of the options below, for what the particles are; options beside it override it [default: fluid]
    #[arg(long, value_name = "NAME", ignore_case = true)]
    pub(in crate::cli) preset: Option<PresetChoice>,

    #[command(flatten)]
    pub(in crate::cli) spacing: SpacingArgs,

    /// Edge of a voxel h, in the particles' unit of length, positive; 0.4 particle spacings by default, and what another
    /// preset says
    #[arg(long, value_name = "H", allow_negative_numbers = true)]
    pub(in crate::cli) voxel_size: Option<f64>,
}

/// Two ways to state one length.
#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct SpacingArgs {
    /// Distance between neighbouring particles d, in the particles' unit of length, positive; measured by default
    #[arg(long, value_name = "D", allow_negative_numbers = true)]
    pub(in crate::cli) spacing: Option<f64>,

    /// The same, as the radius of a particle in the simulation, positive: half the spacing
    #[arg(long, value_name = "R", allow_negative_numbers = true, conflicts_with = "spacing")]
    pub(in crate::cli) particle_radius: Option<f64>,
}

#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct SurfaceArgs {
    /// Radius r_min around each particle that is always inside, before neighbours flatten it, in the particles' unit of
    /// length, positive; 1.15 particle spacings by default, √3·h at least
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(in crate::cli) radius_min: Option<f64>,

    /// r_max / r_min, at least 1: nothing farther than r_max, which is at most 64 h, from all particles is inside
    /// [default: 2]
    #[arg(long, value_name = "RATIO", allow_negative_numbers = true)]
    pub(in crate::cli) radius_ratio: Option<f64>,

    /// Radius of the spheres that smoothing starts from, in the particles' unit of length, r_min to r_max; 1.26 r_min
    /// by default
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(in crate::cli) radius_init: Option<f64>,

    /// Move the finished surface outward by this, or inward where negative, in the particles' unit of length, -r_min to
    /// 2 h [default: 0]
    #[arg(long, value_name = "D", allow_negative_numbers = true)]
    pub(in crate::cli) offset: Option<f64>,

    /// Drop pieces of surface with fewer particles than this, 0 to 1000 [default: 0]
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = count(0, ISLAND_MAX))]
    pub(in crate::cli) drop_islands: Option<u32>,

    /// Fill enclosed cavities of less volume than this, in units of h³, 0 to 1000000; 25 cubes of the particle spacing by
    /// default
    #[arg(long, value_name = "V", allow_negative_numbers = true)]
    pub(in crate::cli) fill_cavities: Option<f64>,

    /// Cut off what is outside the box x0,y0,z0,x1,y1,z1, least corner first, in the particles' unit of length
    #[arg(long, value_name = "BOX", allow_hyphen_values = true)]
    pub(in crate::cli) clip: Option<ClipBox>,
}

#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct ParticleArgs {
    /// The attribute that has each particle's own radius, in the particles' unit of length, such as pscale: its r_min is
    /// then that radius, and r_init and r_max are larger by the same ratios as without
    #[arg(long, value_name = "NAME")]
    pub(in crate::cli) radius_attribute: Option<String>,

    /// r_min of a particle in units of its own radius, positive [default: 1]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub(in crate::cli) radius_scale: Option<f64>,

    /// What stretches particles, so that sheets and jets are thin and smooth [default: neighbors]
    #[arg(long, value_name = "BY", ignore_case = true)]
    pub(in crate::cli) anisotropy: Option<AnisotropyChoice>,

    /// The longest half axis of a particle in units of its shortest, at most, 1 to 8 [default: 4]
    #[arg(long, value_name = "K", allow_negative_numbers = true)]
    pub(in crate::cli) max_stretch: Option<f64>,

    /// The least half axis of particles that neighbours flatten, in the particles' unit of length, positive, from 0.9 h to
    /// r_min, for --anisotropy neighbors: smaller makes thinner sheets; 0.36 particle spacings by default
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(in crate::cli) thin_radius: Option<f64>,

    /// r_min of a particle without neighbours, in the particles' unit of length, positive and at most r_min, for
    /// --anisotropy neighbors: the radius of drops; 0.7 particle spacings by default
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(in crate::cli) lone_radius: Option<f64>,

    /// How far neighbours count, in the particles' unit of length, positive and at most 200 h, for --anisotropy
    /// neighbors and --position-smoothing; 2.6 particle spacings by default
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(in crate::cli) neighbor_radius: Option<f64>,

    /// Move particles near the surface toward the mean of their neighbours by this part of the way, 0 to 1 [default: 0.7]
    #[arg(long, value_name = "L", allow_negative_numbers = true)]
    pub(in crate::cli) position_smoothing: Option<f64>,

    /// Seconds of movement by which particles are stretched, positive, for --anisotropy velocity [default: 0.01]
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    pub(in crate::cli) velocity_gain: Option<f64>,

    /// Attributes that the surface gets: a list of names, such as velocity,Cd,id; or all, by itself
    ///
    /// Numbers are averaged over the particles around, identities and words are those of the nearest. They are written
    /// as vertex attributes, and to .vdb as grids beside the level set.
    #[arg(long, value_name = "LIST")]
    pub(in crate::cli) attributes: Option<AttributeSelection>,
}

#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct ObstacleArgs {
    /// What the surface must not enter: .obj, .glb, .gltf, .ply, .stl, .vtk, .vtp, .vtu, or a level set in .vdb; more than one if given again
    ///
    /// One file for all frames, or a numbered pattern such as body.####.obj, of which each frame takes the file with its
    /// own number.
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) obstacle: Vec<PathBuf>,

    /// Fill gaps between the surface and obstacles that are narrower than this, in units of h, 0 to 4 [default: 1]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    pub(in crate::cli) void_threshold: Option<f64>,
}

#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct MeshArgs {
    /// How the level set becomes triangles [default: dual]
    #[arg(long, value_name = "HOW", ignore_case = true)]
    pub(in crate::cli) contour: Option<ContourChoice>,

    /// Save triangles where the mesh moves by no more than this, in units of h, 0 to 1 [default: 0]
    #[arg(long, value_name = "ERROR", allow_negative_numbers = true)]
    pub(in crate::cli) decimate: Option<f64>,

    /// Average normals with their neighbours, in so many rounds, 0 to 1000; 10 without =N [default: 0]
    #[arg(
        long,
        value_name = "N",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = ROUNDS,
        value_parser = count(0, ROUNDS_MAX)
    )]
    pub(in crate::cli) smooth_normals: Option<u32>,

    /// Write quads to .obj, .vtp and .usda, as dual contouring makes them
    #[arg(long)]
    pub(in crate::cli) quads: bool,
}

#[derive(Clone, Debug, Default, PartialEq, Args)]
pub(in crate::cli) struct SolverArgs {
    /// How the smoothing is integrated [default: fast]
    #[arg(long, value_name = "WHICH", ignore_case = true)]
    pub(in crate::cli) integrator: Option<IntegratorChoice>,

    /// Laplacian steps before the biharmonic ones, 0 to 1000000; with 0 distances are restored instead; 10 by default,
    /// and more on a finer grid
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = count(0, STEPS_MAX))]
    pub(in crate::cli) laplacian_steps: Option<u32>,

    /// Biharmonic steps, 0 to 1000000 [default: 2; explicit, adaptive: as many as take the same time]
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = count(0, STEPS_MAX))]
    pub(in crate::cli) steps: Option<u32>,

    /// Size of a biharmonic step, in units of h⁴, 1e-6 to 10000; 0.25 fourth powers of the particle spacing by default,
    /// and 0.01 h⁴ for explicit and adaptive
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub(in crate::cli) step_size: Option<f64>,

    /// Restore distances after so many biharmonic steps, 1 to 1000000 [default: 1; explicit, adaptive: 50]
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = count(1, STEPS_MAX))]
    pub(in crate::cli) redistance_every: Option<u32>,

    /// Relative tolerance of the conjugate gradients, 1e-12 to 0.5, for implicit only [default: 0.0001]
    #[arg(long, value_name = "E", allow_negative_numbers = true)]
    pub(in crate::cli) cg_tolerance: Option<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum PresetChoice {
    /// Water and other liquids: the default
    Fluid,
    /// Particles that lie at random, as those of FLIP and MPM do: smoothed more than fluid
    Noisy,
    /// Sheets, threads and drops: finer and thinner than fluid
    Splash,
    /// Sand, snow, grain: near the particles, and hardly smoothed
    Granular,
    /// A quick look: voxels as large as the spacing
    Preview,
    /// The parameters of the paper: lengths follow the voxel size
    Paper,
    /// Deprecated: as paper, with small cavities filled
    Water,
    /// Deprecated: as paper, nearer to the particles
    Faithful,
    /// Deprecated: as paper, with more room and more steps
    Smooth,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum AnisotropyChoice {
    /// Nothing: spheres
    None,
    /// Where the neighbours are: flat in sheets, long in threads
    Neighbors,
    /// The velocity: long along it
    Velocity,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum IntegratorChoice {
    /// Implicit steps without reductions: the quickest
    Fast,
    /// The paper's implicit steps: conjugate gradients with a growing active set
    Implicit,
    /// The paper's explicit steps: many small ones
    Explicit,
    /// The same, each as large as it may be: for stills, a sequence flickers
    Adaptive,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum ContourChoice {
    /// Dual contouring: fewer and better shaped triangles
    Dual,
    /// Marching tetrahedra: as the paper does
    Tetrahedra,
}

/// Rounds of --smooth-normals without a number.
const ROUNDS: &str = "10";

/// A count in a range.
fn count(least: u32, most: u32) -> RangedI64ValueParser<u32> {
    RangedI64ValueParser::new().range(i64::from(least)..=i64::from(most))
}

impl MethodArgs {
    /// These, and where one is not given, that of `below`.
    pub(in crate::cli) fn over(&self, below: &MethodArgs) -> MethodArgs {
        MethodArgs {
            first: self.first.over(&below.first),
            surface: self.surface.over(&below.surface),
            particles: self.particles.over(&below.particles),
            obstacles: self.obstacles.over(&below.obstacles),
            mesh: self.mesh.over(&below.mesh),
            solver: self.solver.over(&below.solver),
        }
    }
}

impl SpacingArgs {
    /// The spacing, where one was given.
    pub(in crate::cli) fn spacing(&self) -> Option<f64> {
        self.spacing.or(self.particle_radius.map(|radius| 2.0 * radius))
    }
}

impl FirstArgs {
    fn over(&self, below: &FirstArgs) -> FirstArgs {
        let given = if self.spacing.spacing().is_some() { &self.spacing } else { &below.spacing };
        FirstArgs {
            preset: self.preset.or(below.preset),
            spacing: given.clone(),
            voxel_size: self.voxel_size.or(below.voxel_size),
        }
    }
}

impl SurfaceArgs {
    fn over(&self, below: &SurfaceArgs) -> SurfaceArgs {
        SurfaceArgs {
            radius_min: self.radius_min.or(below.radius_min),
            radius_ratio: self.radius_ratio.or(below.radius_ratio),
            radius_init: self.radius_init.or(below.radius_init),
            offset: self.offset.or(below.offset),
            drop_islands: self.drop_islands.or(below.drop_islands),
            fill_cavities: self.fill_cavities.or(below.fill_cavities),
            clip: self.clip.or(below.clip),
        }
    }
}

impl ParticleArgs {
    fn over(&self, below: &ParticleArgs) -> ParticleArgs {
        ParticleArgs {
            radius_attribute: self.radius_attribute.clone().or_else(|| below.radius_attribute.clone()),
            radius_scale: self.radius_scale.or(below.radius_scale),
            anisotropy: self.anisotropy.or(below.anisotropy),
            max_stretch: self.max_stretch.or(below.max_stretch),
            thin_radius: self.thin_radius.or(below.thin_radius),
            lone_radius: self.lone_radius.or(below.lone_radius),
            neighbor_radius: self.neighbor_radius.or(below.neighbor_radius),
            position_smoothing: self.position_smoothing.or(below.position_smoothing),
            velocity_gain: self.velocity_gain.or(below.velocity_gain),
            attributes: self.attributes.clone().or_else(|| below.attributes.clone()),
        }
    }
}

impl ObstacleArgs {
    fn over(&self, below: &ObstacleArgs) -> ObstacleArgs {
        let given = if self.obstacle.is_empty() { below } else { self };
        ObstacleArgs {
            obstacle: given.obstacle.clone(),
            void_threshold: self.void_threshold.or(below.void_threshold),
        }
    }
}

impl MeshArgs {
    fn over(&self, below: &MeshArgs) -> MeshArgs {
        MeshArgs {
            contour: self.contour.or(below.contour),
            decimate: self.decimate.or(below.decimate),
            smooth_normals: self.smooth_normals.or(below.smooth_normals),
            quads: self.quads || below.quads,
        }
    }
}

impl SolverArgs {
    fn over(&self, below: &SolverArgs) -> SolverArgs {
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
