//! Warnings about frames that were converted.
//!
//! A warning states a fact. The remedy depends on the caller: the command line adds the options that help.

#![expect(missing_docs, reason = "fields are what their names and the sentence say")]

use std::collections::HashSet;
use std::fmt;
use std::mem::{Discriminant, discriminant};
use std::path::PathBuf;

use glam::DVec3;
use meniscus_formats::OutputFormat;

use crate::surface::level_set::RebuildReason;
use crate::surface::mesh::MeshMeasures;
use crate::surface::options::Preset;
use crate::surface::spacing::ROUNDING_REMEDY;
use crate::surface::words::{pluralize, significant};

/// A warning about a converted frame. Its `Display` form is a sentence.
#[derive(Clone, Debug, PartialEq)]
pub enum Warning {
    /// A sentence from a reader or writer of a format, or about the settings.
    Sentence(String),
    /// A likely mistake in the input, or in the choice of its particles.
    Input(InputWarning),
    /// A likely mistake in an obstacle.
    Obstacle { path: PathBuf, finding: ObstacleFinding },
    /// The frame was reconstructed in tiles; in one piece it would need `whole_bytes` of memory.
    Tiled { whole_bytes: u64 },
    /// Settings that do not suit the particles.
    Surface(SurfaceWarning),
    /// A fact about this frame, which says nothing about the others of its sequence.
    Frame(FrameWarning),
    /// The result failed validation.
    Violation(Violation),
}

/// What an attribute says of the size of particles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ParticleSize {
    /// Their radii.
    Radius,
    /// The reach of their kernels in the simulation.
    SmoothingLength,
    /// Their masses.
    Mass,
}

impl fmt::Display for ParticleSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            ParticleSize::Radius => "radii",
            ParticleSize::SmoothingLength => "smoothing lengths",
            ParticleSize::Mass => "masses",
        })
    }
}

/// A likely mistake in the input, or in the choice of its particles.
#[derive(Clone, Debug, PartialEq)]
pub enum InputWarning {
    /// An attribute selected for the surface is missing.
    MissingAttribute { name: String, available: Vec<String> },
    /// A selected attribute cannot be computed, because the particles have no velocities.
    NotComputed { name: &'static str },
    /// The particles are of several kinds, such as fluid and walls, according to an attribute with these
    /// values, and no condition chooses some of them.
    SeveralKinds { attribute: String, values: Vec<String> },
    /// The particles have different sizes, in units of the file, and no option uses them.
    VariousSizes { size: ParticleSize, attribute: String, smallest: f64, largest: f64 },
    /// No particle of the frame meets the condition.
    NoneChosen { condition: String, particle_count: usize },
    /// The file has more grids than the one that was read.
    OtherGrids { count: usize },
    /// In places the level set stored only signs, so its distances were rebuilt.
    Rebuilt(RebuildReason),
    /// The velocities of a level set cannot be used.
    VelocitiesNotShown(String),
    /// Positions that are infinite or NaN were copied to the output.
    PositionsNotFinite { count: usize, particle_count: usize },
    /// 32-bit positions far from the origin that were rounded to this step. Lengths are in world units.
    RoundedParticles { step: f64, spacing: f64 },
    /// The particles are spaced so irregularly that another preset than the default suits them.
    Irregular { irregularity: f64, suitable: Preset },
    /// The particles cannot be followed to the frames around: they have no ids, and no velocities with a time step.
    NotFollowed,
    /// The velocities of the particles cannot be computed: they cannot be found in the frames before and after.
    VelocitiesNotComputed,
    /// The same, because there is no such frame.
    NoFrameBeside,
    /// The particles have no ids, and were found in the frames before and after by their order.
    FollowedByOrder,
    /// The particles move as if frames were this far apart, and another time is given, in seconds. With this velocity
    /// scale both agree.
    OtherTimeStep { measured: f64, given: f64, velocity_scale: f64 },
    /// The particles have no ids, so each frame alone decides which of them are spray.
    SprayWithoutIds,
    /// The frame has no number, so no frame is before or after it.
    NotNumbered,
    /// The particles share all ids, so none can be followed back.
    SharedIds,
    /// The first frame of the rest coordinates, which has this number.
    ReferenceMissing { number: u32 },
    /// The frames around hardly count, because this share of their weight was confident.
    HardlyFollowed { confidence: f64 },
    /// The particles are too few to choose a preset by them.
    PresetNotMeasured { used: Preset },
    /// All particles have the same coordinate along this axis.
    Planar { axis: char, at: f64 },
    /// Many particles have one position.
    SharedPosition { count: usize, particle_count: usize, at: [f64; 3] },
    /// Radii too small for the grid. `voxel_size` is the largest that resolves all, in world units.
    SmallRadii { count: usize, voxel_size: f64 },
    /// Radii that are not positive numbers.
    InvalidRadii { count: usize },
    /// Radii too large for the grid. `voxel_size` is the smallest at which none is, in world units.
    LargeRadii { count: usize, voxel_size: f64 },
    /// Particles without a finite velocity, which could not be stretched along it.
    NotStretched { count: usize },
    /// Attribute values that are not finite, and were ignored.
    ValuesNotFinite { count: usize },
}

/// Settings that do not suit the particles.
#[derive(Clone, Debug, PartialEq)]
pub enum SurfaceWarning {
    /// The surface is completely outside the clip box.
    ClippedAway,
    /// Every piece of the surface had too few particles and was dropped.
    IslandsDropped,
    /// All of the surface is inside obstacles.
    InsideObstacles,
    /// The particles are so small that no voxel is inside any of their spheres. Lengths are in world units.
    BetweenVoxels { voxel_size: f64, radius_min: f64, radius_max: f64 },
    /// An inward offset moved all of the surface away. A length in world units.
    OffsetAway { offset: f64 },
    /// Most pieces of the surface come from a single particle.
    Spray { particle_count: usize, piece_count: usize, voxel_size: f64 },
    /// The surface has many holes.
    Holes { particle_count: usize, hole_count: usize, voxel_size: f64 },
    /// The surface is in many pieces, none of which has half of the volume.
    Fragmented { particle_count: usize, piece_count: usize, voxel_size: f64 },
    /// All particles are within `width_voxels` voxels: the voxels are too large.
    Blob { particle_count: usize, width_voxels: f64, voxel_size: f64 },
    /// Vertices without a particle in range of the attribute transfer.
    VerticesWithoutAttributes { count: usize },
    /// Voxels of a .vdb without a particle in range of the attribute transfer.
    VoxelsWithoutAttributes { count: usize },
}

/// A fact about one frame.
#[derive(Clone, Debug, PartialEq)]
pub enum FrameWarning {
    /// Particles that the surface ignores, and the approximate position of one of them.
    ParticlesIgnored { count: usize, near: Option<DVec3> },
    /// Particles in obstacles.
    ParticlesInObstacles { count: usize, are_most: bool },
    /// The conjugate gradients stopped before they converged.
    NotConverged,
    /// Explicit steps that exceed the CFL bound.
    CflExceeded { step_count: usize },
    /// The 32-bit positions of the mesh are coarse: the frame is wide, or far from the origin, and all its
    /// files have the world positions that `format` stores.
    CoarsePositions { voxels: f64, format: Option<OutputFormat> },
    /// One of the frames around it, on which the surface depends, is left out.
    NotAveraged { why: String },
    /// Particles outside the surface, which an offset or smoothed positions allow.
    ParticlesOutside { count: usize, particle_count: usize, is_offset: bool, is_smoothed: bool },
}

/// A check that the result of a frame failed.
#[derive(Clone, Debug, PartialEq)]
pub enum Violation {
    /// φ leaves its bounds.
    OutOfBounds { voxel_count: usize },
    /// Vertices nearer to a particle than the limit, by more than half a voxel.
    VerticesTooNear { count: usize, nearest_voxels: f64 },
    /// Vertices farther from all particles than the limit, by more than half a voxel.
    VerticesTooFar { count: usize, farthest_voxels: f64 },
    /// Particles that the surface does not enclose.
    NotEnclosed { count: usize },
    /// The mesh is not closed and manifold; its measures count the faults.
    NotClosed(Box<MeshMeasures>),
}

/// A likely mistake in an obstacle, or in its position.
#[derive(Clone, Debug, PartialEq)]
pub enum ObstacleFinding {
    /// Open sheets in its mesh, such as planes, which were closed behind their normals.
    Sheets { count: usize },
    /// Its mesh is open.
    Open { edge_count: usize, encloses_nothing: bool },
    /// Triangles with reversed orientation, which were flipped.
    Flipped { triangle_count: usize },
    /// Parts that seem to face inwards, but were not changed.
    PossiblyInverted { part_count: usize },
    /// Triangles with an invalid vertex.
    InvalidTriangles { triangle_count: usize },
    /// No triangle has an area.
    Flat,
    /// Its level set had no distances in places.
    Rebuilt(RebuildReason),
    /// The narrow band of its level set is too narrow: distances are known up to `known_voxels` voxels.
    NarrowBand { known_voxels: f64 },
    /// It is out of reach of all particles. The fields are the bounding boxes of both: minimum and maximum
    /// corners, world units.
    OutOfReach { obstacle: [DVec3; 2], particles: [DVec3; 2] },
}

/// The frames that a warning applies to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// Only this frame.
    Frame,
    /// This frame, and usually the later ones: one report for the sequence is enough.
    Sequence,
}

impl Warning {
    /// The frames that the warning applies to.
    pub fn scope(&self) -> Scope {
        match self {
            Warning::Frame(_) | Warning::Violation(_) => Scope::Frame,
            Warning::Sentence(_)
            | Warning::Input(_)
            | Warning::Obstacle { .. }
            | Warning::Tiled { .. }
            | Warning::Surface(_) => Scope::Sequence,
        }
    }

    /// Whether the frame has a fault that does not depend on the settings: ignored particles, or failed
    /// validation.
    pub fn is_flaw(&self) -> bool {
        matches!(self, Warning::Violation(_) | Warning::Frame(FrameWarning::ParticlesIgnored { .. }))
    }
}

/// The warnings of a sequence that were reported already: their variants, and the names in them.
#[derive(Clone, Debug, Default)]
pub struct ReportedWarnings(HashSet<(Variant, String)>);

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Variant {
    Sentence,
    Input(Discriminant<InputWarning>),
    Obstacle(Discriminant<ObstacleFinding>),
    Tiled,
    Surface(Discriminant<SurfaceWarning>),
    Frame(Discriminant<FrameWarning>),
    Violation(Discriminant<Violation>),
}

impl ReportedWarnings {
    /// Whether no similar warning was reported before. Warnings of the same variant are similar, whatever
    /// their numbers; warnings with a name are similar only if the name is the same.
    pub fn is_new(&mut self, warning: &Warning) -> bool {
        let mut name = String::new();
        let variant = match warning {
            Warning::Sentence(text) => {
                // Such sentences have no variants, so they are compared without digits.
                name.extend(text.chars().filter(|c| !c.is_ascii_digit() && !".-".contains(*c)));
                Variant::Sentence
            }
            Warning::Input(input) => {
                if let InputWarning::MissingAttribute { name: attribute, .. }
                | InputWarning::SeveralKinds { attribute, .. } = input
                {
                    name.clone_from(attribute);
                }
                if let InputWarning::NotComputed { name: attribute } = input {
                    name += attribute;
                }
                Variant::Input(discriminant(input))
            }
            Warning::Obstacle { path, finding } => {
                name += &path.to_string_lossy();
                Variant::Obstacle(discriminant(finding))
            }
            Warning::Tiled { .. } => Variant::Tiled,
            Warning::Surface(surface) => Variant::Surface(discriminant(surface)),
            Warning::Frame(frame) => Variant::Frame(discriminant(frame)),
            Warning::Violation(violation) => Variant::Violation(discriminant(violation)),
        };
        self.0.insert((variant, name))
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Warning::Sentence(text) => f.write_str(text),
            Warning::Input(warning) => warning.fmt(f),
            Warning::Obstacle { path, finding } => write!(f, "obstacle {}: {finding}", path.display()),
            Warning::Tiled { whole_bytes } => {
                let mebibytes = whole_bytes.div_ceil(1 << 20);
                write!(f, "processed in tiles, which takes longer: without tiles it needs {mebibytes} MiB")
            }
            Warning::Surface(warning) => warning.fmt(f),
            Warning::Frame(warning) => warning.fmt(f),
            Warning::Violation(violation) => write!(f, "failed validation: {violation}"),
        }
    }
}

impl fmt::Display for InputWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let particles = |count: &usize| pluralize(*count, "particle");
        match self {
            InputWarning::MissingAttribute { name, available } => {
                let available = if available.is_empty() { "none".to_owned() } else { available.join(", ") };
                write!(f, "the particles have no attribute `{name}` for the surface; available: {available}")
            }
            InputWarning::NotComputed { name } => {
                write!(f, "`{name}` is not computed: the particles have no velocities")
            }
            InputWarning::SeveralKinds { attribute, values } => write!(
                f,
                "the attribute `{attribute}` has {} values ({}), and particles with any of them become one surface",
                values.len(),
                values.join(", ")
            ),
            InputWarning::VariousSizes { size, attribute, smallest, largest } => {
                let [smallest, largest] = [smallest, largest].map(|size| significant(*size));
                write!(f, "the particles have {size} from {smallest} to {largest} (`{attribute}`), which are not used")
            }
            InputWarning::NoneChosen { condition, particle_count } => {
                let particles = particles(particle_count);
                write!(f, "none of the {particles} meets the condition \"{condition}\": the frame is empty")
            }
            InputWarning::OtherGrids { count: 1 } => f.write_str("1 more grid in the file is ignored"),
            InputWarning::OtherGrids { count } => write!(f, "{count} more grids in the file are ignored"),
            InputWarning::Rebuilt(reason) => reason.fmt(f),
            InputWarning::VelocitiesNotShown(why) => write!(f, "velocities are ignored: {why}"),
            InputWarning::PositionsNotFinite { count, particle_count } => {
                write!(f, "{count} of {particle_count} positions are not finite")
            }
            InputWarning::RoundedParticles { step, spacing } => {
                let [step, spacing] = [*step, *spacing].map(significant);
                write!(
                    f,
                    "positions are rounded to steps of {step}, as 32-bit numbers so far from the origin are, and the \
                     particle spacing is {spacing}: {ROUNDING_REMEDY}"
                )
            }
            InputWarning::Irregular { irregularity, suitable } => write!(
                f,
                "the particles are spaced irregularly (irregularity {} %): the preset {} makes pools and waves calmer, but splashes thicker, than {}",
                (100.0 * irregularity).round(),
                suitable,
                Preset::default()
            ),
            InputWarning::NotFollowed => f.write_str(
                "the surface is not averaged with the frames around it: the particles have no ids of their own, \
                 and no velocities with a time step, by which they could be followed",
            ),
            InputWarning::VelocitiesNotComputed => f.write_str(
                "velocities are not computed: the frames before and after have no particles with the same ids, nor as many in \
                 the same order",
            ),
            InputWarning::NoFrameBeside => {
                f.write_str("velocities are not computed: there is no frame with the number before or after")
            }
            InputWarning::FollowedByOrder => f.write_str(
                "the particles have no ids: their velocities are computed as if all frames had them in the same order",
            ),
            InputWarning::OtherTimeStep { measured, given, .. } => {
                let [measured, given] = [*measured, *given].map(significant);
                write!(
                    f,
                    "by their velocities and ids, the particles move as if frames were {measured} seconds apart, not {given}"
                )
            }
            InputWarning::SprayWithoutIds => f.write_str(
                "the particles have no ids of their own, so each frame alone decides which of them are spray, and pieces may \
                 flicker between the surface and the points",
            ),
            InputWarning::NotNumbered => f.write_str(
                "the frame depends on no others, although an option wants that: its name has no frame number; times in names \
                 do not count",
            ),
            InputWarning::SharedIds => f.write_str(
                "rest coordinates are those of this frame: the particles have no ids of their own, by which they could be \
                 followed",
            ),
            InputWarning::ReferenceMissing { number } => write!(
                f,
                "frame {number}, which --rest names, is missing or there twice: particles have the position at which they appeared \
                 after it"
            ),
            InputWarning::HardlyFollowed { confidence } => write!(
                f,
                "the surface is hardly averaged with the frames around it: only {} % of their weight was used, because few \
                 of its particles could be followed, or they move irregularly; check the ids, or the unit and the time \
                 step of the velocities",
                (100.0 * confidence).round()
            ),
            InputWarning::PresetNotMeasured { used } => write!(
                f,
                "too few particles are surrounded by others to measure how evenly they are spaced: the preset is {used}"
            ),
            InputWarning::SharedPosition { count, particle_count, at: [x, y, z] } => write!(
                f,
                "{count} of {particle_count} particles have the same position, ({x}, {y}, {z}), as inactive particles of \
                 solvers do: they become a drop"
            ),
            InputWarning::Planar { axis, at } => write!(
                f,
                "all particles have {axis} = {}: the surface of such a two-dimensional frame is a layer of one particle",
                significant(*at)
            ),
            InputWarning::SmallRadii { count, .. } => {
                write!(f, "{} too small for the grid, with the smallest radius that it resolves instead of their own", particles(count))
            }
            InputWarning::InvalidRadii { count } => write!(
                f,
                "{} without a radius that is a positive number: the smallest radius is used",
                particles(count)
            ),
            InputWarning::LargeRadii { count, .. } => {
                write!(f, "{} too large for the grid: the largest possible radius is used", particles(count))
            }
            InputWarning::NotStretched { count } => {
                write!(f, "{} not stretched: no finite velocity", particles(count))
            }
            InputWarning::ValuesNotFinite { count } => {
                write!(f, "{} of particle attributes ignored: infinite or NaN", pluralize(*count, "value"))
            }
        }
    }
}

impl fmt::Display for SurfaceWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            SurfaceWarning::ClippedAway => {
                f.write_str("the clip box contains no part of the surface: the mesh is empty")
            }
            SurfaceWarning::IslandsDropped => f.write_str(
                "every piece of the surface was dropped because all have too few particles: the mesh is empty",
            ),
            SurfaceWarning::InsideObstacles => {
                f.write_str("all of the surface is inside obstacles: the mesh is empty")
            }
            SurfaceWarning::BetweenVoxels { voxel_size, radius_min, radius_max } => {
                let [least, most] = [radius_min / voxel_size, radius_max / voxel_size].map(significant);
                write!(
                    f,
                    "all particles fall between the voxels: the mesh is empty; r_min and r_max are {least} and {most} voxels, and \
                     only an r_min of at least √3 voxels encloses every particle"
                )
            }
            SurfaceWarning::OffsetAway { offset } => {
                write!(f, "the offset {} removed the whole surface: the mesh is empty", significant(*offset))
            }
            SurfaceWarning::Spray { particle_count, piece_count, voxel_size } => write!(
                f,
                "{particle_count} particles became {piece_count} pieces, most of one particle each: unless they really are spray, \
                 the voxel size {} is too small for the particle spacing",
                significant(*voxel_size)
            ),
            SurfaceWarning::Holes { particle_count, hole_count, voxel_size } => write!(
                f,
                "the surface of {particle_count} particles has {}: unless the fluid really has them, the voxel size {} \
                 or --blend is too small for the particle spacing",
                pluralize(*hole_count, "hole"),
                significant(*voxel_size)
            ),
            SurfaceWarning::Fragmented { particle_count, piece_count, voxel_size } => write!(
                f,
                "{particle_count} particles became {piece_count} pieces, none with half of the volume: unless they really are spray, \
                 the voxel size {} or the blend is too small for the particle spacing",
                significant(*voxel_size)
            ),
            SurfaceWarning::Blob { particle_count, width_voxels, voxel_size } => write!(
                f,
                "all of the {particle_count} particles are within {width_voxels} voxels: the voxel size {} is too large for them",
                significant(*voxel_size)
            ),
            SurfaceWarning::VerticesWithoutAttributes { count } => {
                let vertices = pluralize(*count, "vertex");
                write!(f, "{vertices} without a particle in range: attributes are 0 or missing")
            }
            SurfaceWarning::VoxelsWithoutAttributes { count } => {
                let voxels = pluralize(*count, "sampled voxel");
                write!(f, "{voxels} of the .vdb without a particle in range: attributes are 0 there")
            }
        }
    }
}

impl fmt::Display for FrameWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FrameWarning::ParticlesIgnored { count, near } => {
                let particles = pluralize(*count, "particle");
                write!(
                    f,
                    "{particles} left out: not finite, or too far from the origin or from the other particles"
                )?;
                near.map_or(Ok(()), |near| {
                    let [x, y, z] = near.to_array().map(significant);
                    write!(f, "; one is near ({x}, {y}, {z})")
                })
            }
            FrameWarning::ParticlesInObstacles { count, are_most } => {
                let particles = pluralize(*count, "particle");
                // If the mesh of a container is only its inner side, the whole inside of the container is
                // solid.
                let hint = if *are_most {
                    "; if the obstacle is a container, give its walls a thickness: otherwise all of it is solid"
                } else {
                    ""
                };
                write!(f, "{particles} inside obstacles: the surface does not follow them there{hint}")
            }
            FrameWarning::NotAveraged { why } => {
                write!(f, "one of the frames around it, on which the surface depends, is left out: {why}")
            }
            FrameWarning::NotConverged => {
                f.write_str("the implicit solver did not converge to its tolerance")
            }
            FrameWarning::CflExceeded { step_count } => {
                let steps = pluralize(*step_count, "explicit step");
                write!(f, "{steps} exceeded the CFL limit of one voxel per step")
            }
            FrameWarning::CoarsePositions { voxels, format } => {
                match format {
                    Some(format) => {
                        write!(f, "a .{format} has world positions, so in all files of this frame")?
                    }
                    None => f.write_str("parts of this frame lie so far apart that")?,
                }
                let voxels = significant(*voxels);
                write!(f, " the 32-bit positions of some vertices are off by up to {voxels} voxels")
            }
            FrameWarning::ParticlesOutside { count, particle_count, is_offset, is_smoothed } => {
                let verb = if *count == 1 { "is" } else { "are" };
                let cause = match (is_offset, is_smoothed) {
                    (true, true) => "an offset moved it inward, and positions were smoothed",
                    (true, false) => "an offset moved it inward",
                    (false, _) => "positions were smoothed",
                };
                let particles = pluralize(*particle_count, "particle");
                write!(f, "{count} of {particles} {verb} outside the surface: {cause}")
            }
        }
    }
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Violation::OutOfBounds { voxel_count } => {
                write!(f, "the level set is outside its bounds at {}", pluralize(*voxel_count, "voxel"))
            }
            Violation::VerticesTooNear { count, nearest_voxels } => write!(
                f,
                "{} of the mesh too near to a particle (nearer than allowed by more than half a voxel); the smallest distance is {} voxels",
                pluralize(*count, "vertex"),
                significant(*nearest_voxels)
            ),
            Violation::VerticesTooFar { count, farthest_voxels } => write!(
                f,
                "{} of the mesh too far from all particles (farther than allowed by more than half a voxel); the largest distance is {} voxels",
                pluralize(*count, "vertex"),
                significant(*farthest_voxels)
            ),
            Violation::NotEnclosed { count } => {
                write!(f, "{} outside the surface", pluralize(*count, "particle"))
            }
            Violation::NotClosed(mesh) => {
                let mut faults = vec![
                    (mesh.boundary_edge_count, "boundary edge"),
                    (mesh.non_manifold_edge_count, "non-manifold edge"),
                    (mesh.non_manifold_vertex_count, "non-manifold vertex"),
                    (mesh.degenerate_triangle_count, "triangle without area"),
                ];
                faults.retain(|(count, _)| *count > 0);
                let faults: Vec<String> =
                    faults.iter().map(|(count, noun)| pluralize(*count, noun)).collect();
                write!(f, "the mesh is not closed and manifold: {}", faults.join(", "))
            }
        }
    }
}

impl fmt::Display for ObstacleFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ObstacleFinding::Open { edge_count, encloses_nothing: true } => {
                let edges = pluralize(*edge_count, "open edge");
                write!(f, "the mesh has {edges} and encloses no volume: close it, or give it a thickness")
            }
            ObstacleFinding::Sheets { count } => {
                let sheets =
                    if *count == 1 { "an open sheet".to_owned() } else { pluralize(*count, "open sheet") };
                write!(
                    f,
                    "the mesh has {sheets}, taken as solid behind the normals, as deep as it is wide: flip the normals if \
                     the fluid is on that side, or give it a thickness"
                )
            }
            ObstacleFinding::Open { edge_count, encloses_nothing: false } => {
                let edges = pluralize(*edge_count, "open edge");
                write!(
                    f,
                    "the mesh has {edges}: its holes were closed approximately (where the winding number is 1/2); \
                     close them in the model for an exact obstacle"
                )
            }
            ObstacleFinding::Flipped { triangle_count } => write!(
                f,
                "flipped {} that faced inwards, or opposite to adjacent triangles",
                pluralize(*triangle_count, "triangle")
            ),
            ObstacleFinding::PossiblyInverted { part_count } => write!(
                f,
                "did not flip {} that may face inwards: the mesh has too many parts to detect cavities; correct the normals in the model",
                pluralize(*part_count, "part")
            ),
            ObstacleFinding::InvalidTriangles { triangle_count } => {
                let triangles = pluralize(*triangle_count, "triangle");
                write!(f, "{triangles} ignored: a vertex is not finite, or does not exist")
            }
            ObstacleFinding::Flat => f.write_str("no triangle has an area, so the obstacle has no effect"),
            ObstacleFinding::Rebuilt(reason) => reason.fmt(f),
            ObstacleFinding::NarrowBand { known_voxels } => write!(
                f,
                "its narrow band is only {known_voxels:.2} h wide, and its surface may be off by that much: write it with a wider band"
            ),
            ObstacleFinding::OutOfReach { obstacle, particles } => {
                let [obstacle, particles] = [*obstacle, *particles].map(box_text);
                write!(
                    f,
                    "too far from the particles to have an effect: it spans {obstacle}, and the particles span \
                     {particles}; check its position, unit of length and up axis"
                )
            }
        }
    }
}

/// A box with four digits for each coordinate.
fn box_text(corners: [DVec3; 2]) -> String {
    let short = |value: f64| format!("{value:.3e}").parse::<f64>().unwrap_or(value).to_string();
    let [min, max] = corners.map(|corner| corner.to_array().map(short).join(", "));
    format!("({min}) to ({max})")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warnings_of_one_variant_are_reported_once_for_each_name() {
        let mut reported = ReportedWarnings::default();
        let sentence = |text: &str| Warning::Sentence(text.to_owned());
        let about = |path: &str, finding| Warning::Obstacle { path: path.into(), finding };
        let missing =
            |name: &str| InputWarning::MissingAttribute { name: name.to_owned(), available: vec![] };
        for (warning, is_new) in [
            (Warning::Input(InputWarning::SmallRadii { count: 1, voxel_size: 0.1 }), true),
            (Warning::Input(InputWarning::SmallRadii { count: 2, voxel_size: 0.2 }), false),
            (Warning::Input(InputWarning::InvalidRadii { count: 1 }), true),
            (Warning::Input(missing("v1")), true),
            (Warning::Input(missing("v2")), true),
            (Warning::Input(missing("v1")), false),
            (sentence("3 columns are not read"), true),
            (sentence("14 columns are not read"), false),
            (sentence("3 rows are not read"), true),
            (about("a.obj", ObstacleFinding::Flat), true),
            (about("b.obj", ObstacleFinding::Flat), true),
            (about("a.obj", ObstacleFinding::Flipped { triangle_count: 1 }), true),
            (about("a.obj", ObstacleFinding::Flipped { triangle_count: 9 }), false),
        ] {
            assert_eq!(reported.is_new(&warning), is_new, "{warning}");
        }
    }
}
