//! What a frame will take, and how to skin it with less.

use std::fmt;

use glam::IVec3;
use rustc_hash::FxHashMap;

use super::fineness::{TooFine, too_fine};
use super::tiles::{HALO_LEAVES, tiles_around};
use super::{TOPOLOGY_LEAF_BYTES, radii, scene, shape};
use crate::surface::grid::Leaf;
use crate::surface::obstacle::Obstacles;
use crate::surface::options::{Anisotropy, Contouring, Integrator, Settings};
use crate::surface::particles::ParticleSource;
use crate::surface::rasterize::{self, Footprint};

/// How a frame is to be skinned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plan {
    /// The most memory that it takes, in bytes, beside the particles that are given: never much less than it does,
    /// and up to half as much again.
    pub memory_bytes: u64,
    /// The edge of its tiles in leaves; `None` to have it in memory whole.
    pub tile_leaves: Option<i32>,
    /// What it would take in memory whole, in bytes.
    pub whole_bytes: u64,
}

/// A frame does not fit into the memory that it may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLarge {
    /// The least memory with which it could be skinned, in bytes.
    pub least_bytes: u64,
    /// What it may take, in bytes.
    pub allowed_bytes: u64,
    /// Whether the integrator is what keeps it from being done in tiles.
    pub is_coupled: bool,
}

impl fmt::Display for TooLarge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mebibytes = |bytes: u64| bytes.div_ceil(MEBIBYTE);
        write!(
            f,
            "the frame needs {} MiB of memory, and may take {} MiB: allow more (--memory), or choose a larger voxel size",
            mebibytes(self.least_bytes),
            self.allowed_bytes / MEBIBYTE
        )?;
        if self.is_coupled {
            f.write_str(
                "; the implicit and the adaptive integrator couple all voxels, the others can do with less",
            )?;
        }
        Ok(())
    }
}

impl std::error::Error for TooLarge {}

const MEBIBYTE: u64 = 1 << 20;

/// Edges of tiles in leaves, the largest first: the smaller they are, the more of the work is done twice.
const TILE_EDGES: [i32; 4] = [128, 64, 32, 16];

/// What a frame has beside its particles that takes memory.
#[derive(Clone, Copy)]
pub struct Surroundings<'a> {
    /// What stands in the way.
    pub obstacles: &'a Obstacles,
    /// Bytes of a particle's attributes that go on the surface.
    pub attribute_bytes: f64,
}

/// Why a frame cannot be skinned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Unfit {
    /// It does not fit into the memory that it may take.
    TooLarge(TooLarge),
    /// Its voxels are so small that positions cannot tell them apart.
    TooFine(TooFine),
}

/// How to skin a frame in `allowed_bytes`: in memory whole if that will do, and in the largest tiles that will
/// if not. It looks at each particle once.
///
/// # Errors
/// Those of the source; and, within, that it cannot be done: there is too little memory, or the voxels are
/// [too small](TooFine) for it.
pub fn plan<S: ParticleSource>(
    source: &S,
    settings: &Settings,
    surroundings: Surroundings,
    allowed_bytes: u64,
) -> Result<Result<Plan, Unfit>, S::Error> {
    plan_with_tiles(source, settings, surroundings, allowed_bytes, &TILE_EDGES)
}

/// The same without tiles.
pub(crate) fn plan_whole<S: ParticleSource>(
    source: &S,
    settings: &Settings,
    surroundings: Surroundings,
    allowed_bytes: u64,
) -> Result<Result<Plan, Unfit>, S::Error> {
    plan_with_tiles(source, settings, surroundings, allowed_bytes, &[])
}

fn plan_with_tiles<S: ParticleSource>(
    source: &S,
    settings: &Settings,
    surroundings: Surroundings,
    allowed_bytes: u64,
    tile_edges: &[i32],
) -> Result<Result<Plan, Unfit>, S::Error> {
    let Surroundings { obstacles, attribute_bytes } = surroundings;
    let footprint = rasterize::footprint(source, &scene(settings, obstacles), shape::near_surface(settings))?;
    if let Some(too_fine) = too_fine(source, settings, &footprint)? {
        return Ok(Err(Unfit::TooFine(too_fine)));
    }
    let whole = whole_bytes(&footprint, settings, attribute_bytes);
    if whole <= allowed_bytes {
        return Ok(Ok(Plan { memory_bytes: whole, tile_leaves: None, whole_bytes: whole }));
    }
    if matches!(settings.integrator, Integrator::Implicit | Integrator::Adaptive) {
        let too_large = TooLarge { least_bytes: whole, allowed_bytes, is_coupled: true };
        return Ok(Err(Unfit::TooLarge(too_large)));
    }
    let mut least_bytes = whole;
    for &tile_leaves in tile_edges {
        let memory_bytes = tiled_bytes(&footprint, settings, attribute_bytes, tile_leaves);
        if memory_bytes <= allowed_bytes {
            let tile_leaves = Some(tile_leaves);
            return Ok(Ok(Plan { memory_bytes, tile_leaves, whole_bytes: whole }));
        }
        least_bytes = least_bytes.min(memory_bytes);
    }
    Ok(Err(Unfit::TooLarge(TooLarge { least_bytes, allowed_bytes, is_coupled: false })))
}

/// Fields of a frame in memory while it is rasterized, with what they are swept in. Particles with shapes of their own
/// have distances to three surfaces where others have one to a centre.
fn rasterizing_fields(settings: &Settings) -> f64 {
    if settings.has_shapes() { 7.4 } else { 5.2 }
}

/// While it is smoothed.
pub(super) fn smoothing_fields(settings: &Settings) -> f64 {
    match settings.integrator {
        Integrator::Fast | Integrator::Explicit | Integrator::Adaptive => 5.6,
        Integrator::Implicit => 9.2,
    }
}

/// Bytes of the mesh, of what measures it and of what makes it, for each face of a voxel that the surface is as
/// large as. Measured on blocks, sheets and spray.
pub(super) fn mesh_bytes(settings: &Settings) -> f64 {
    match settings.contouring {
        Contouring::Dual => 80.0,
        Contouring::Tetrahedra => 300.0,
    }
}

/// Memory for a leaf that holds particles: while it is found out which of them matter, and of that what is kept of a
/// frame in tiles. Where particles have shapes of their own, it is known of each leaf where the round ones are, too.
fn sorted_leaf_bytes(settings: &Settings) -> f64 {
    1000.0 + round_octants_bytes(settings)
}

fn occupied_leaf_bytes(settings: &Settings) -> f64 {
    680.0 + round_octants_bytes(settings)
}

fn round_octants_bytes(settings: &Settings) -> f64 {
    if settings.has_shapes() { 512.0 } else { 0.0 }
}

/// Memory for a particle that matters, and for one while it is sorted.
const KEPT_PARTICLE_BYTES: f64 = 12.0;
const SORTED_PARTICLE_BYTES: f64 = 40.0;

/// Memory for a particle's shape: in the frame, where it is kept, and as it is looked up.
const SHAPE_BYTES: f64 = 200.0;

/// Memory for the shapes of particles, and for where neighbours move them.
fn shape_bytes(footprint: &Footprint, settings: &Settings) -> f64 {
    let by_attributes =
        settings.own_radii.is_some() || matches!(settings.anisotropy, Anisotropy::Velocity { .. });
    let shaped_count = match (by_attributes, settings.has_shapes()) {
        (true, _) => footprint.particle_count,
        // They are made for each batch, and kept of the particles that are.
        (false, true) => footprint.near_particle_count,
        (false, false) => 0,
    };
    let [_, kept] = shape::changes_bytes(settings);
    let of_changes =
        if settings.uses_neighbors() { kept * footprint.shaped_particle_count as f64 } else { 0.0 };
    let given = if settings.position_smoothing > 0.0 {
        GIVEN_BYTES * footprint.shaped_particle_count.min(footprint.near_particle_count) as f64
    } else {
        0.0
    };
    SHAPE_BYTES * shaped_count as f64 + of_changes + given
}

/// Memory for where particles were given that may be outside of the surface: of each particle near it, in the mean. Few are.
const GIVEN_BYTES: f64 = 6.0;

/// Memory while neighbours are looked at, before anything else of the frame is kept.
fn neighbors_bytes(footprint: &Footprint, settings: &Settings) -> f64 {
    if !settings.uses_neighbors() {
        return 0.0;
    }
    let [collected, _] = shape::changes_bytes(settings);
    (sorted_leaf_bytes(settings) + VICINITY_LEAF_BYTES) * footprint.occupied_count as f64
        + shape::gathered_bytes(footprint.particle_count)
        + collected * footprint.shaped_particle_count as f64
}

/// Memory for a leaf while it is found out which particles are near the surface: masks of its cells, and the leaves around it.
const VICINITY_LEAF_BYTES: f64 = 300.0;

/// Memory while attributes are transferred and written, beside the mesh and two level sets: near particles sorted and
/// packed; values at vertices and in the band, once as they are found and once in a row, then packed for six voxels.
fn transfer_bytes(footprint: &Footprint, settings: &Settings, attribute_bytes: f64) -> f64 {
    if attribute_bytes == 0.0 {
        return 0.0;
    }
    let [_, area, _, particles] = counts(footprint, settings);
    // The particles once more, in their shapes.
    let moved = match (settings.uses_neighbors(), settings.anisotropy) {
        (true, Anisotropy::Neighbors { .. }) => SHAPES_BYTES * footprint.particle_count as f64,
        _ => 0.0,
    };
    moved + particles * (80.0 + 2.0 * attribute_bytes) + area * (48.0 + 8.0 * attribute_bytes)
}

/// Memory for an ellipsoid, and for it in one batch and in all.
const SHAPES_BYTES: f64 = 56.0;

/// Memory while islands, cavities and what is beyond a box are taken away: φ, the field that a box makes of it, pieces, and, of a frame in tiles, particles, of which islands are told by.
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

/// Memory while the surface is moved, of so many leaves: φ, what it is swept into, and which voxels are beside the surface.
fn offset_bytes(settings: &Settings, leaf_count: f64) -> f64 {
    if settings.offset == 0.0 { 0.0 } else { 2.2 * FIELD_BYTES * leaf_count }
}

/// Memory for the pieces in a leaf: masks of its voxels, once as they are found and once in a row, and what they touch.
const PIECES_LEAF_BYTES: f64 = 500.0;

/// Memory for a list of particles, beside these.
const LISTED_LEAF_BYTES: f64 = 64.0;

fn whole_bytes(footprint: &Footprint, settings: &Settings, attribute_bytes: f64) -> u64 {
    let [surface, area, occupied, particles] = counts(footprint, settings);
    let stages = [
        FIELD_BYTES * rasterizing_fields(settings) * surface + sorted_leaf_bytes(settings) * occupied,
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

fn tiled_bytes(footprint: &Footprint, settings: &Settings, attribute_bytes: f64, tile_leaves: i32) -> u64 {
    let [surface, area, occupied, particles] = counts(footprint, settings);
    let most = |halo_leaves| most_in_a_tile(&footprint.surface, tile_leaves, halo_leaves) as f64;
    let rasterized = most(radii(settings).window_halo_leaves());
    let smoothed = most(HALO_LEAVES);
    // The particles that matter in a tile are near its surface.
    let part = (2.0 * rasterized / surface).min(1.0);
    let particles = SORTED_PARTICLE_BYTES * particles * part;
    let kept = occupied_leaf_bytes(settings) * occupied + TOPOLOGY_LEAF_BYTES as f64 * 2.0 * surface;
    let sorting = (sorted_leaf_bytes(settings) - occupied_leaf_bytes(settings)) * occupied * part + particles;
    let stages = [
        FIELD_BYTES * rasterizing_fields(settings) * rasterized + sorting,
        FIELD_BYTES * smoothing_fields(settings) * smoothed,
        edit_bytes(footprint, settings) + sorting,
        offset_bytes(settings, surface),
        FIELD_BYTES * surface + mesh_bytes(settings) * area + sorting,
        // Writing: φ, and φ as it is packed.
        FIELD_BYTES * 2.0 * surface
            + mesh_bytes(settings) * area
            + transfer_bytes(footprint, settings, attribute_bytes),
    ];
    let after = stages.into_iter().fold(0.0, f64::max) + kept + shape_bytes(footprint, settings);
    after.max(neighbors_bytes(footprint, settings)) as u64
}

/// Memory for a leaf of a field.
pub(super) const FIELD_BYTES: f64 = size_of::<Leaf>() as f64;

fn counts(footprint: &Footprint, settings: &Settings) -> [f64; 4] {
    let Footprint { surface, area_voxels, occupied_count, particle_count, near_particle_count, .. } =
        footprint;
    let kept_count = if settings.drop_islands > 0 { particle_count } else { near_particle_count };
    [surface.len(), *area_voxels, *occupied_count, *kept_count].map(|count| count as f64)
}

/// The number of leaves in the tile, with its halo, that has most of them.
fn most_in_a_tile(leaves: &[IVec3], tile_leaves: i32, halo_leaves: i32) -> usize {
    let mut counts: FxHashMap<IVec3, usize> = FxHashMap::default();
    for tile in leaves.iter().flat_map(|&origin| tiles_around(origin, halo_leaves, tile_leaves)) {
        *counts.entry(tile).or_default() += 1;
    }
    counts.into_values().max().unwrap_or(0)
}
