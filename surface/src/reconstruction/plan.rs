//! Estimates the memory of a frame, and plans how to reconstruct it within a limit: in one piece or in tiles.
//! All memory sizes are in bytes.

use std::fmt;

use glam::{DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::tiles::{HALO_LEAVES, tiles_around};
use super::{TOPOLOGY_LEAF_BYTES, radii, raster_params, shape};
use crate::grid::Leaf;
use crate::obstacle::{ObstacleTooFar, Obstacles};
use crate::options::{Anisotropy, Contouring, Integrator, Settings};
use crate::particles::{AnySource, OwnedPositions, ParticleSource, Unread, erased};
use crate::rasterize::{self, Footprint};
use crate::space::INDEX_LIMIT;
use crate::spacing::{ROUNDING_SHARE_MAX, SourceSample, median, rounding_error, rounding_step};
use crate::words::significant;

/// How a frame is reconstructed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryPlan {
    /// Upper estimate of the peak memory, in bytes, excluding the given particles: at most 1.5 times the
    /// actual peak.
    pub memory_bytes: u64,
    /// Edge of the tiles in leaves; `None` to process the frame in one piece.
    pub tile_leaves: Option<i32>,
    /// Peak memory in one piece, in bytes.
    pub in_core_bytes: u64,
}

/// Error: a frame does not fit into the memory limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLarge {
    /// The smallest limit that may be sufficient, in bytes: the smallest sufficient one, unless even counting
    /// what the frame needs would exceed the limit by far.
    pub needed_bytes: u64,
    /// The limit, in bytes.
    pub allowed_bytes: u64,
    /// True if tiles are impossible because the integrator is global.
    pub requires_in_core: bool,
    /// The part of `needed_bytes` that a picture of the surface takes.
    pub picture_bytes: u64,
    /// The number of frames for which `needed_bytes` is: more than one if the frame is averaged with others.
    pub held_count: u64,
}

impl fmt::Display for TooLarge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let TooLarge { needed_bytes, allowed_bytes, requires_in_core, picture_bytes, held_count } = *self;
        let [needed, picture] = [needed_bytes, picture_bytes].map(|bytes| bytes.div_ceil(MEBIBYTE));
        let limit = allowed_bytes / MEBIBYTE;
        if needed_bytes.saturating_sub(picture_bytes) <= allowed_bytes {
            return write!(
                f,
                "the frame and its picture need at least {needed} MiB of memory, of which the picture needs {picture}, \
                 and the limit is {limit} MiB: raise --memory or choose a smaller picture"
            );
        }
        write!(
            f,
            "the frame needs at least {needed} MiB of memory and the limit is {limit} MiB: raise --memory or increase \
             --voxel-size"
        )?;
        if held_count > 1 {
            write!(f, "; without --temporal, which keeps {held_count} frames in memory, it needs less")?;
        }
        if requires_in_core {
            f.write_str("; other integrators need less: implicit and adaptive cannot work in tiles")?;
        }
        Ok(())
    }
}

impl std::error::Error for TooLarge {}

const MEBIBYTE: u64 = 1 << 20;

/// Memory for counting a leaf, in bytes: its particles, its neighbors, and the tiles that contain it.
const COUNTED_LEAF_BYTES: u64 = 256;

/// Memory that counting may take under any limit, in bytes.
const COUNTING_BYTES_MIN: u64 = 16 * MEBIBYTE;

/// Edges of tiles in leaves, largest first. The smaller the tiles, the more work is done twice, in their
/// overlapping halos.
const TILE_EDGES: [i32; 4] = [128, 64, 32, 16];

/// Inputs besides the particles that need memory.
#[derive(Clone, Copy)]
pub struct PlanInputs<'a> {
    /// The obstacles.
    pub obstacles: &'a Obstacles,
    /// Bytes per particle of the transferred attributes.
    pub attribute_bytes: f64,
    /// Whether the frame may be computed in tiles.
    pub allows_tiles: bool,
}

/// Why a frame cannot be reconstructed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MemoryPlanError {
    /// It does not fit into the memory limit.
    TooLarge(TooLarge),
    /// Its voxels are too small for the precision of positions.
    VoxelTooSmall(VoxelTooSmall),
    /// An obstacle has coordinates that are too large for the precision of distances.
    ObstacleTooFar(ObstacleTooFar),
}

/// Plans a frame with a limit of `allowed_bytes`: in one piece if possible, otherwise in the largest tiles
/// that fit, if tiles are allowed. Reads each particle once.
///
/// # Errors
/// The outer error is the source's. The inner error says why the frame cannot be reconstructed: there is too
/// little memory, the voxels are [too small](VoxelTooSmall), or an obstacle is
/// [too far away](ObstacleTooFar).
pub fn plan_memory<S: ParticleSource>(
    source: &S,
    settings: &Settings,
    surroundings: PlanInputs,
    allowed_bytes: u64,
) -> Result<Result<MemoryPlan, MemoryPlanError>, S::Error> {
    erased(source, |source| plan_any(source, settings, surroundings, allowed_bytes))
}

fn plan_any(
    source: &AnySource<'_>,
    settings: &Settings,
    PlanInputs { obstacles, attribute_bytes, allows_tiles }: PlanInputs,
    allowed_bytes: u64,
) -> Result<Result<MemoryPlan, MemoryPlanError>, Unread> {
    if let Some(too_far) = obstacles.too_far(settings.voxel_size) {
        return Ok(Err(MemoryPlanError::ObstacleTooFar(too_far)));
    }
    // A counted leaf takes less memory than a leaf of the frame, so no frame that fits exceeds this number.
    let leaf_count_max = allowed_bytes.max(COUNTING_BYTES_MIN) / COUNTED_LEAF_BYTES;
    let footprint = rasterize::footprint(
        source,
        &raster_params(settings, obstacles),
        shape::near_surface(settings),
        usize::try_from(leaf_count_max).unwrap_or(usize::MAX),
    )?;
    if let Some(too_small) = voxel_too_small(source, settings, &footprint)? {
        return Ok(Err(MemoryPlanError::VoxelTooSmall(too_small)));
    }
    let too_large = |needed_bytes, requires_in_core| {
        let too_large =
            TooLarge { needed_bytes, allowed_bytes, requires_in_core, picture_bytes: 0, held_count: 1 };
        Ok(Err(MemoryPlanError::TooLarge(too_large)))
    };
    let requires_in_core =
        matches!(settings.smoothing.integrator, Integrator::Implicit | Integrator::Adaptive);
    if footprint.is_partial {
        return too_large(least_bytes(&footprint, settings), requires_in_core);
    }
    let whole = in_core_bytes(&footprint, settings, attribute_bytes);
    if whole <= allowed_bytes {
        return Ok(Ok(MemoryPlan { memory_bytes: whole, tile_leaves: None, in_core_bytes: whole }));
    }
    if requires_in_core {
        return too_large(whole, true);
    }
    let mut needed_bytes = whole;
    for &tile_leaves in TILE_EDGES.iter().filter(|_| allows_tiles) {
        let memory_bytes = tiled_bytes(&footprint, settings, attribute_bytes, tile_leaves);
        if memory_bytes <= allowed_bytes {
            let tile_leaves = Some(tile_leaves);
            return Ok(Ok(MemoryPlan { memory_bytes, tile_leaves, in_core_bytes: whole }));
        }
        needed_bytes = needed_bytes.min(memory_bytes);
    }
    too_large(needed_bytes, false)
}

/// Number of fields in memory during rasterization: three, one that is made, and temporary ones.
const RASTERIZING_FIELDS: f64 = 5.2;

/// Number of fields in memory during smoothing.
pub(super) fn smoothing_fields(settings: &Settings) -> f64 {
    match settings.smoothing.integrator {
        Integrator::Fast | Integrator::Explicit | Integrator::Adaptive => 5.6,
        Integrator::Implicit => 9.2,
    }
}

/// Memory of the mesh, its construction and its measures, in bytes per voxel face of the surface's area.
/// Measured on blocks, sheets and spray.
pub(super) fn mesh_bytes(settings: &Settings) -> f64 {
    match settings.contouring {
        Contouring::Dual if settings.refine => 104.0,
        Contouring::Dual => 80.0,
        Contouring::Tetrahedra => 300.0,
    }
}

/// Memory per leaf that contains particles, in bytes, while culling. A frame in
/// tiles keeps [`occupied_leaf_bytes`] of it while it is rasterized; plans count them for all stages. For anisotropic particles, each leaf also stores the octants of the round
/// ones.
fn sorted_leaf_bytes(settings: &Settings) -> f64 {
    1000.0 + round_octants_bytes(settings)
}

fn occupied_leaf_bytes(settings: &Settings) -> f64 {
    680.0 + round_octants_bytes(settings)
}

fn round_octants_bytes(settings: &Settings) -> f64 {
    if settings.has_per_particle_shapes() { 512.0 } else { 0.0 }
}

/// Memory per kept particle, in bytes. While particles are sorted, each takes [`SORTED_PARTICLE_BYTES`].
const KEPT_PARTICLE_BYTES: f64 = 12.0;
const SORTED_PARTICLE_BYTES: f64 = 40.0;

/// Memory per particle shape, in bytes, for three copies: in the frame, after culling, and in the lookup.
const SHAPE_BYTES: f64 = 200.0;

/// Memory for particle shapes and displacements.
fn shape_bytes(footprint: &Footprint, settings: &Settings) -> f64 {
    let by_attributes =
        settings.per_particle_radius.is_some() || matches!(settings.anisotropy, Anisotropy::Velocity { .. });
    let shaped_count = match (by_attributes, settings.has_per_particle_shapes()) {
        (true, _) => footprint.particle_count,
        // Shapes are computed for each batch, and stored only for the particles that are kept.
        (false, true) => footprint.near_particle_count,
        (false, false) => 0,
    };
    let [_, kept] = shape::changes_bytes(settings);
    let of_changes =
        if settings.uses_neighbors() { kept * footprint.shaped_particle_count as f64 } else { 0.0 };
    let given = if settings.position_smoothing > 0.0 {
        MOVED_PARTICLE_BYTES * footprint.shaped_particle_count.min(footprint.near_particle_count) as f64
    } else {
        0.0
    };
    SHAPE_BYTES * shaped_count as f64 + of_changes + given
}

/// Memory per near particle, in bytes, for the original positions that may lie outside the surface. Few may,
/// unless there are obstacles: then all are kept.
const MOVED_PARTICLE_BYTES: f64 = 36.0;

/// Memory, in bytes, while neighborhoods are evaluated. The rest of the frame does not exist yet.
fn neighbors_bytes(footprint: &Footprint, settings: &Settings) -> f64 {
    if !settings.uses_neighbors() {
        return 0.0;
    }
    let [collected, _] = shape::changes_bytes(settings);
    (sorted_leaf_bytes(settings) + VICINITY_LEAF_BYTES) * footprint.occupied_count as f64
        + shape::gathered_bytes(footprint.particle_count)
        + collected * footprint.shaped_particle_count as f64
}

/// Memory per leaf while the particles near the surface are determined: masks of its cells, and its
/// neighbors.
const VICINITY_LEAF_BYTES: f64 = 300.0;

/// Memory while attributes are transferred and written, in addition to the mesh and two level sets. It holds
/// near particles, sorted and packed. For each voxel face of the surface's area, it also holds eight values
/// of each attribute: two for a vertex or a node of the band (in chunks, then contiguous), and six in the
/// encoded .vdb, whose band is six voxels wide.
fn transfer_bytes(footprint: &Footprint, settings: &Settings, attribute_bytes: f64) -> f64 {
    if attribute_bytes == 0.0 {
        return 0.0;
    }
    let [_, area, _, particles] = counts(footprint, settings);
    // A second copy of the particles, with their shapes.
    let is_shaped = settings.uses_neighbors() && settings.has_per_particle_shapes();
    let moved = if is_shaped { SHAPES_BYTES * footprint.particle_count as f64 } else { 0.0 };
    moved + particles * (80.0 + 2.0 * attribute_bytes) + area * (48.0 + 8.0 * attribute_bytes)
}

/// Memory per ellipsoid for two copies: in its batch, and in the list of all.
const SHAPES_BYTES: f64 = 56.0;

/// Memory during edits: φ, the field of the clip box, components, and, for a tiled frame, the particles that
/// identify islands.
fn edit_bytes(footprint: &Footprint, settings: &Settings) -> f64 {
    let [surface, _, occupied, particles] = counts(footprint, settings);
    let has_pieces = settings.drop_islands > 0 || settings.fill_cavities > 0.0;
    if !has_pieces && settings.clip.is_none() {
        return 0.0;
    }
    let fields = if settings.clip.is_some() { 2.0 } else { 1.0 };
    let pieces = if has_pieces { PIECES_LEAF_BYTES * surface } else { 0.0 };
    let particles = if settings.drop_islands > 0 {
        KEPT_PARTICLE_BYTES * particles + LISTED_LEAF_BYTES * occupied
    } else {
        0.0
    };
    FIELD_BYTES * fields * surface + pieces + particles
}

/// Memory during the offset of this many leaves: φ, its swept copy, and the mask of voxels next to the
/// surface.
fn offset_bytes(settings: &Settings, leaf_count: f64) -> f64 {
    if settings.offset == 0.0 { 0.0 } else { 2.2 * FIELD_BYTES * leaf_count }
}

/// Memory for a leaf's components: masks of its voxels, scattered and then contiguous, and their contacts.
const PIECES_LEAF_BYTES: f64 = 500.0;

/// Additional memory per leaf for a list of its particles.
const LISTED_LEAF_BYTES: f64 = 64.0;

fn in_core_bytes(footprint: &Footprint, settings: &Settings, attribute_bytes: f64) -> u64 {
    let [surface, area, occupied, particles] = counts(footprint, settings);
    let stages = [
        FIELD_BYTES * RASTERIZING_FIELDS * surface + sorted_leaf_bytes(settings) * occupied,
        FIELD_BYTES * smoothing_fields(settings) * surface,
        edit_bytes(footprint, settings),
        offset_bytes(settings, surface),
        FIELD_BYTES * 4.0 * surface + mesh_bytes(settings) * area,
        FIELD_BYTES * 2.0 * surface
            + mesh_bytes(settings) * area
            + transfer_bytes(footprint, settings, attribute_bytes),
    ];
    let stages_bytes = stages.into_iter().fold(0.0, f64::max) + KEPT_PARTICLE_BYTES * particles;
    let after = stages_bytes.max(SORTED_PARTICLE_BYTES * particles) + shape_bytes(footprint, settings);
    after.max(neighbors_bytes(footprint, settings)) as u64
}

/// Lower bound of the memory in tiles or in one piece: what writing needs, and all tiles together.
fn least_bytes(footprint: &Footprint, settings: &Settings) -> u64 {
    let [near, _, occupied, _] = counts(footprint, settings);
    // Counting stopped before the leaves inside the fluid, which are not stored, were left out.
    let surface = (near - occupied).max(0.0);
    (FIELD_BYTES * 2.0 * surface + kept_bytes(surface, occupied, settings)) as u64
}

/// Memory that a frame in tiles keeps from tile to tile; plans count it for all stages.
fn kept_bytes(surface: f64, occupied: f64, settings: &Settings) -> f64 {
    occupied_leaf_bytes(settings) * occupied + TOPOLOGY_LEAF_BYTES as f64 * 2.0 * surface
}

fn tiled_bytes(footprint: &Footprint, settings: &Settings, attribute_bytes: f64, tile_leaves: i32) -> u64 {
    let [surface, area, occupied, particles] = counts(footprint, settings);
    let most = |halo_leaves| most_in_a_tile(&footprint.surface, tile_leaves, halo_leaves) as f64;
    let rasterized = most(radii(settings).window_halo_leaves());
    let smoothed = most(HALO_LEAVES);
    // The particles that can affect the surface in a tile are near it.
    let part = (2.0 * rasterized / surface).min(1.0);
    let particles = SORTED_PARTICLE_BYTES * particles * part;
    let kept = kept_bytes(surface, occupied, settings);
    let sorting = (sorted_leaf_bytes(settings) - occupied_leaf_bytes(settings)) * occupied * part + particles;
    let stages = [
        FIELD_BYTES * RASTERIZING_FIELDS * rasterized + sorting,
        FIELD_BYTES * smoothing_fields(settings) * smoothed,
        edit_bytes(footprint, settings) + sorting,
        offset_bytes(settings, surface),
        FIELD_BYTES * surface + mesh_bytes(settings) * area + sorting,
        // Writing: φ and its compressed copy.
        FIELD_BYTES * 2.0 * surface
            + mesh_bytes(settings) * area
            + transfer_bytes(footprint, settings, attribute_bytes),
    ];
    let after = stages.into_iter().fold(0.0, f64::max) + kept + shape_bytes(footprint, settings);
    after.max(neighbors_bytes(footprint, settings)) as u64
}

/// Memory of a leaf of a field.
pub(super) const FIELD_BYTES: f64 = size_of::<Leaf>() as f64;

fn counts(footprint: &Footprint, settings: &Settings) -> [f64; 4] {
    let Footprint { surface, area_voxels, occupied_count, particle_count, near_particle_count, .. } =
        footprint;
    let kept_count = if settings.drop_islands > 0 { particle_count } else { near_particle_count };
    [surface.len(), *area_voxels, *occupied_count, *kept_count].map(|count| count as f64)
}

/// Number of leaves in the fullest tile, including its halo.
fn most_in_a_tile(leaves: &[IVec3], tile_leaves: i32, halo_leaves: i32) -> usize {
    let mut counts: FxHashMap<IVec3, usize> = FxHashMap::default();
    for tile in leaves.iter().flat_map(|&origin| tiles_around(origin, halo_leaves, tile_leaves)) {
        *counts.entry(tile).or_default() += 1;
    }
    counts.into_values().max().unwrap_or(0)
}

// Detects voxel sizes too small for the precision of positions.
//
//   distance of most particles from their median, in voxels    65 536      1 048 576      16 777 216
//   rounding error of a 32-bit vertex position                 1/256       1/16           1 voxel
//   consequence                                                warning     error          error: no surface
//                                                                                         is possible
//
// Such a voxel size is a mistake, for example a wrong unit of length or an extra zero, and the user would
// wait long for a useless result. A few stray particles are no reason to reject a frame: because the median
// decides, they only cause a warning.

/// Upper limit of the median distance of particles from their median position, in voxels. Beyond it, 32-bit
/// positions are off by 1/16 voxel or more, and the frame is rejected.
pub const SPREAD_MAX_VOXELS: u32 = 1 << 20;

/// Error: the voxels are too small for a frame, because most of its particles are too widely spread or too
/// far from the origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VoxelTooSmall {
    /// The voxel size, in world units.
    pub voxel_size: f64,
    /// The measured particle spacing, in world units.
    pub spacing: f64,
    /// The smallest voxel size that the frame allows, in world units.
    pub least: f64,
    /// Which limit is exceeded.
    pub limit: PrecisionLimit,
}

/// What limits the voxel size from below.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PrecisionLimit {
    /// Most particles are more than [`SPREAD_MAX_VOXELS`] from their median position.
    Spread,
    /// Most particles are more than [`INDEX_LIMIT`] voxels from the origin, outside the grid's index range.
    Reach,
    /// 32-bit positions so far from the origin are rounded to this step, in world units, which distorts the
    /// measured spacing.
    Rounding(f64),
}

impl fmt::Display for VoxelTooSmall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let VoxelTooSmall { voxel_size, spacing, least, limit } = *self;
        // Round up, so that the number in the message, which has few digits, is not below the limit.
        let least = 1.001 * least;
        let [voxels, half, h, shown_least, shown_spacing] =
            [spacing / voxel_size, 0.5 * spacing, voxel_size, least, spacing].map(significant);
        match limit {
            PrecisionLimit::Spread => write!(
                f,
                "the voxel size {h} (--voxel-size) is too small: 32-bit positions cannot resolve such voxels over the \
                 whole frame; particles are {shown_spacing} apart ({voxels} voxels)"
            )?,
            PrecisionLimit::Reach => write!(
                f,
                "the voxel size {h} (--voxel-size) is too small so far from the origin: most particles are more than \
                 {INDEX_LIMIT} voxels away, outside the grid; move them closer, or use --voxel-size {shown_least} or more"
            )?,
            PrecisionLimit::Rounding(step) => f.write_str(&rounding_error(step, spacing))?,
        }
        match limit {
            // The minimum is for experts; it is not a recommendation.
            PrecisionLimit::Spread if 0.5 * spacing >= least => {
                write!(f, "; use --voxel-size {half} (half the spacing); the minimum is {shown_least}")
            }
            PrecisionLimit::Spread => write!(f, "; the minimum is --voxel-size {shown_least}"),
            PrecisionLimit::Reach | PrecisionLimit::Rounding(_) => Ok(()),
        }
    }
}

impl std::error::Error for VoxelTooSmall {}

/// Checks whether the voxels are too small for a frame with this footprint. If the footprint suggests that
/// they are, the particles are read once more, or twice more if there are many.
///
/// # Errors
/// Returns the source's error if a batch cannot be read.
fn voxel_too_small(
    source: &AnySource<'_>,
    settings: &Settings,
    footprint: &Footprint,
) -> Result<Option<VoxelTooSmall>, Unread> {
    let Footprint { particle_count, dropped_count, spread_voxels, .. } = *footprint;
    if spread_voxels <= SPREAD_MAX_VOXELS && dropped_count <= particle_count {
        return Ok(None);
    }
    // A partial footprint does not count all particles.
    let particle_count = (0..source.batch_count()).map(|batch| source.batch_len(batch)).sum();
    let sample = SourceSample::of(source, particle_count)?;
    let Some(estimate) = sample.estimate(source)? else { return Ok(None) };
    let spacing = estimate.spacing;
    let (voxel_size, (least, limit)) = (settings.voxel_size, least_voxel_size(&sample.particles));
    let step = rounding_step(&sample.particles);
    let limit = if step > ROUNDING_SHARE_MAX * spacing { PrecisionLimit::Rounding(step) } else { limit };
    Ok((voxel_size < least).then_some(VoxelTooSmall { voxel_size, spacing, least, limit }))
}

/// The smallest voxel size with which most of these particles are near enough to their median and to the
/// origin, and the limit that determines it.
fn least_voxel_size(particles: &OwnedPositions) -> (f64, PrecisionLimit) {
    let positions = || (0..particles.len()).map(|index| particles.position(index));
    let median = |values: Vec<f64>| median(values).unwrap_or(0.0);
    let along = |axis: usize| median(positions().map(|position| position[axis]).collect());
    let middle = DVec3::new(along(0), along(1), along(2));
    let spread = median(positions().map(|position| (position - middle).abs().max_element()).collect());
    let far = median(positions().map(|position| position.abs().max_element()).collect());
    let by_spread = spread / f64::from(SPREAD_MAX_VOXELS);
    let by_reach = far / f64::from(INDEX_LIMIT);
    if by_spread >= by_reach {
        (by_spread, PrecisionLimit::Spread)
    } else {
        (by_reach, PrecisionLimit::Reach)
    }
}
