//! Particles to level sets: the union of spheres, three times (paper, Eq. 1 and 2).
//!
//! ```text
//!      r_max ─────────────    S_max    φ_max = lower bound of φ
//!     r_init ─ ─ ─ ─ ─ ─ ─    S_0      φ_0   = where smoothing starts
//!      r_min ─────────────    S_min    φ_min = upper bound of φ
//!                  ●          particle
//! ```
//!
//! Outside a union of equal spheres, the distance to the nearest centre less the radius is the
//! exact signed distance, and is kept as it is. Inside it is not: it saturates at about half the
//! spacing of the particles. There only the voxels beside the surface keep it, and the others are
//! swept from them. So the zero sets of the bounds are those of the spheres themselves.
//!
//! Most of a frame is far inside, and none of that is ever stored:
//!
//! ```text
//!   particles ──pass 1──▶ Occupancy ──▶ what can matter ──┐
//!       └───────────────pass 2───────────────────────────┴─▶ ParticleBins ──▶ distances ──▶ φ_0, bounds
//! ```
//!
//! A frame that is too large even so is rasterized window by window; the results are those of the whole.

mod batch;
mod bin;
mod cover;
mod distances;
mod ellipsoid;
mod footprint;
mod need;
mod occupancy;
mod region;
mod shards;
mod signed_distance;
mod sphere;
mod spread;
mod strayed;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_of_shapes;
mod vicinity;

use std::sync::Arc;

use glam::IVec3;
use rayon::prelude::*;

pub use bin::ParticleBins;
pub use footprint::{Footprint, NearSurface, footprint};
pub use occupancy::Occupancy;
pub use vicinity::{Block, Gathered, Vicinity};

use crate::surface::grid::{FACE_STEPS, Field, LEAF_EDGE, Leaf, LeafMask, NO_LEAF, ROW_COUNT, Topology};
use crate::surface::level_set::{Bounds, NarrowBand};
use crate::surface::obstacle::{ContactTally, ObstacleLeaf, Obstacles, hold_contact};
use crate::surface::particles::ParticleSource;
use crate::surface::simd::{self, Kernel, Lanes};
use crate::surface::space::{CoordBox, Lattice};
use distances::{Distances, Gauge, Sphere};
use need::{Need, leaves_of_boxes};
use region::Regions;
use signed_distance::signed_distance;

/// The radii of the three unions of spheres, in voxels: `min` ≤ `init` ≤ `max`. Where particles have shapes of their
/// own, these are the units of their half axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Radii {
    /// r_min: the surface stays outside these.
    pub min: f32,
    /// r_init: where it starts.
    pub init: f32,
    /// r_max: the surface stays inside these.
    pub max: f32,
    /// No half axis of a particle is shorter, in units of the radii: 1 for balls.
    pub shortest: f32,
    /// Half axes that the band has room for, in units of the radii: 1 for balls. Particles may have longer ones; then
    /// the surface cannot move quite as far as their bounds would let it.
    pub roomy: f32,
    /// How far the finished surface is moved outward, in voxels; negative inward. The band has room for it.
    pub offset: f32,
}

/// Exact distances are kept so far beyond r_max, in voxels; farther ones are swept.
const EXACT_MARGIN: f32 = 2.0;

impl Radii {
    /// The radii of particles that are all alike.
    pub const fn of_balls(min: f32, init: f32, max: f32) -> Radii {
        Radii { min, init, max, shortest: 1.0, roomy: 1.0, offset: 0.0 }
    }

    /// Half the thickness of the band that is worked on, in voxels: what is left of it around the surface once that is moved
    /// by the offset is the half width of the result.
    pub fn half_width(&self) -> f32 {
        self.result_half_width() + self.offset.abs().ceil()
    }

    /// Half the thickness of the band that smoothing may need (Eq. 7), in voxels: it reads values
    /// up to 5 voxels from the surface, and the surface may move to either bound. The band of the result has it, too.
    pub fn result_half_width(&self) -> f32 {
        let gap = (self.max - self.init).max(self.init - self.min) * self.roomy;
        // Radii that differ by whole voxels but for rounding need no voxel more.
        5.0 + (gap - 1e-4).max(0.0).ceil()
    }

    /// How far a particle can change φ_0 and the bounds, in voxels: its exact distances; φ_0 swept from
    /// them, two voxels a sweep; the leaves that come and go with φ_0; and the bounds swept on those. `longest` is the
    /// longest half axis of any particle, in units of the radii.
    pub fn reach_voxels(&self, longest: f32) -> u32 {
        let swept = 2 * sweep_count(self.half_width());
        self.exact_reach(longest).ceil() as u32 + swept + 2 * LEAF_EDGE as u32 + swept
    }

    /// How many leaves around a window are rasterized with it.
    pub fn window_halo_leaves(&self) -> i32 {
        let regions = Regions::new(CoordBox { min: IVec3::ZERO, max: IVec3::ZERO }, *self, self.roomy);
        (regions.own.min.x - regions.measured.min.x) / LEAF_EDGE
    }

    /// How far exact distances to a particle are kept from its centre, in voxels; it has no half axis longer than this,
    /// in units of the radii.
    fn exact_reach(&self, longest: f32) -> f32 {
        // The certificate asks for the nearest particles of vertices that were moved outward.
        self.max * longest + self.outward() + EXACT_MARGIN
    }

    /// How far the finished surface is moved outward, in voxels: 0 where it is moved inward.
    pub fn outward(&self) -> f32 {
        self.offset.max(0.0)
    }

    /// Leaves are stored if a voxel of theirs is so near, on every axis, to one beside the surface.
    fn band_margin(&self) -> i32 {
        self.half_width() as i32 + 1
    }
}

/// What particles are rasterized into.
#[derive(Clone, Copy)]
pub struct Scene<'a> {
    /// What positions are in voxels.
    pub lattice: Lattice,
    /// The radii of the spheres.
    pub radii: Radii,
    /// What stands in the way.
    pub obstacles: &'a Obstacles,
    /// Gaps between fluid and obstacles that are narrower than this, in voxels, are filled.
    pub void_threshold: f32,
    /// Whether all particles are to be kept: who counts them needs those inside, too.
    pub keeps_all_particles: bool,
}

impl Scene<'_> {
    /// One without obstacles.
    pub fn open(lattice: Lattice, radii: Radii) -> Scene<'static> {
        static NO_OBSTACLES: Obstacles = Obstacles { members: Vec::new() };
        Scene { lattice, radii, obstacles: &NO_OBSTACLES, void_threshold: 0.0, keeps_all_particles: false }
    }

    /// The obstacles' signed distances in the leaf with this origin, in voxels.
    pub fn obstacle(&self, origin: IVec3) -> ObstacleLeaf {
        self.obstacles.leaf(origin, &self.lattice, self.obstacle_half_width())
    }

    /// How far the obstacles' distances are known, in voxels: wherever the surface is before and after it is moved.
    pub fn obstacle_half_width(&self) -> f32 {
        self.radii.half_width() + self.radii.offset.abs()
    }

    /// The same of obstacles that are moved against the offset: a surface that meets these meets the true ones once it is
    /// moved itself. Within the half width of the band.
    pub fn obstacle_before_offset(&self, origin: IVec3) -> ObstacleLeaf {
        self.obstacle(origin).shifted(-self.radii.offset, self.radii.half_width())
    }

    /// Whether the surface of an obstacle may pass by a voxel of the leaf with this origin.
    fn is_at_obstacle(&self, origin: IVec3) -> bool {
        self.obstacles.touches(origin, &self.lattice, OBSTACLE_MARGIN + self.radii.offset.abs())
    }
}

/// A surface that is nearer to a leaf than this, in voxels, may pass between two of its voxels, or the neighbours of
/// these.
const OBSTACLE_MARGIN: f32 = 1.5;

/// What there is after this stage.
#[derive(Clone, Debug)]
pub struct Rasterized {
    /// The particles that matter.
    pub bins: ParticleBins,
    /// The band around the initial surface, with φ_0.
    pub band: NarrowBand,
    /// The bounds on the same leaves.
    pub bounds: Bounds,
    /// What obstacles changed of them.
    pub contact: ContactTally,
}

/// Rasterizes a frame.
///
/// # Errors
/// Those of the source.
pub fn rasterize<S: ParticleSource>(source: &S, scene: &Scene) -> Result<Rasterized, S::Error> {
    let occupancy = Occupancy::new(source, &scene.lattice)?;
    let regions = Regions::new(CoordBox::ALL, scene.radii, occupancy.longest());
    let measured = measure(source, &occupancy, scene, &regions)?;
    drop(occupancy);
    Ok(level_sets(measured, scene, &regions))
}

/// Rasterizes the leaves that touch a window, a box of voxels: those that the whole frame has there, and their
/// values to the last bit. The particles are those that these come from: also some around the window.
///
/// # Errors
/// Those of the source.
pub fn rasterize_window<S: ParticleSource>(
    source: &S,
    occupancy: &Occupancy,
    scene: &Scene,
    window: CoordBox,
) -> Result<Rasterized, S::Error> {
    let regions = Regions::new(window, scene.radii, occupancy.longest());
    let measured = measure(source, occupancy, scene, &regions)?;
    Ok(level_sets(measured, scene, &regions))
}

/// The particles that what is in a window comes from.
///
/// # Errors
/// Those of the source.
pub fn particles_of_window<S: ParticleSource>(
    source: &S,
    occupancy: &Occupancy,
    scene: &Scene,
    window: CoordBox,
) -> Result<ParticleBins, S::Error> {
    let regions = Regions::new(window, scene.radii, occupancy.longest());
    let need = Need::new(occupancy, scene, &regions);
    ParticleBins::new(source, &scene.lattice, occupancy, &need, &regions)
}

/// The leaves around the surface, and how far their voxels are from the particles.
struct Measured {
    bins: ParticleBins,
    topology: Topology,
    distances: Distances,
}

fn measure<S: ParticleSource>(
    source: &S,
    occupancy: &Occupancy,
    scene: &Scene,
    regions: &Regions,
) -> Result<Measured, S::Error> {
    let need = Need::new(occupancy, scene, regions);
    let bins = ParticleBins::new(source, &scene.lattice, occupancy, &need, regions)?;
    let gauge = Gauge::new(&bins, scene.radii);
    let near = gauge.distances(&need.near, &need, None);
    let topology = Topology::new(leaves_near_surface(&need, &near, scene, regions));
    let distances = gauge.distances(&topology, &need, Some((&need.near, &near)));
    Ok(Measured { bins, topology, distances })
}

/// Origins of the leaves with a voxel within the band's margin, on every axis, of a voxel inside S_0 that has a face
/// neighbour outside. With obstacles, also of those inside S_0 and in no obstacle: there are two surfaces then, and a void
/// may be filled beside either. Those of the obstacles are where the moved surface will meet them; where it is before lies within the
/// margin, which has room for the offset, and a plate that is thinner than that is not lost.
fn leaves_near_surface(need: &Need, distances: &Distances, scene: &Scene, regions: &Regions) -> Vec<IVec3> {
    let mut inside = distances.inside(Sphere::Init, scene.radii);
    let margin = scene.radii.band_margin();
    let mut surfaces = crossings(need, &inside, |origin| need.is_deep(origin), margin, regions);
    if !scene.obstacles.is_empty() {
        let leaves = inside.par_iter_mut().zip(need.near.origins());
        leaves.for_each(|(inside, &origin)| remove_obstacle(inside, &scene.obstacle(origin)));
        let is_deep = |origin| need.is_deep(origin) && scene.obstacle(origin) != ObstacleLeaf::Inside;
        surfaces.extend(crossings(need, &inside, is_deep, margin, regions));
    }
    leaves_of_boxes(&surfaces, |origin| regions.swept.contains(origin))
}

/// The boxes of the voxels of each leaf that are inside and beside one that is not, with a margin.
fn crossings(
    need: &Need,
    inside: &[LeafMask],
    is_deep: impl Fn(IVec3) -> bool + Sync,
    margin: i32,
    regions: &Regions,
) -> Vec<(IVec3, CoordBox)> {
    let surface = |(leaf, &origin): (usize, &IVec3)| {
        let faces = std::array::from_fn(|face| match need.near.neighbors()[leaf][face] {
            // What is not near is inside altogether, or outside.
            NO_LEAF if is_deep(origin + FACE_STEPS[face] * LEAF_EDGE) => &LeafMask::FULL,
            NO_LEAF => &LeafMask::EMPTY,
            neighbor => &inside[neighbor as usize],
        });
        let mut crossings = inside[leaf];
        crossings.remove_all(&inside[leaf].surrounded(faces));
        let voxels = crossings.bounding_box();
        (!voxels.is_empty() && regions.crossed.contains(origin)).then(|| (origin, voxels.expanded(margin)))
    };
    need.near.origins().par_iter().enumerate().filter_map(surface).collect()
}

/// Leaves no voxel that is in an obstacle.
fn remove_obstacle(inside: &mut LeafMask, obstacle: &ObstacleLeaf) {
    match obstacle {
        ObstacleLeaf::Outside => {}
        ObstacleLeaf::Inside => *inside = LeafMask::EMPTY,
        ObstacleLeaf::Near(distances) => {
            let outside = LeafMask::from_fn(|offset| distances.values[offset] > 0.0);
            *inside = inside.and(&outside);
        }
    }
}

/// φ_0 and the bounds, on the leaves that hold a value of φ_0 within the half width.
fn level_sets(measured: Measured, scene: &Scene, regions: &Regions) -> Rasterized {
    let Measured { bins, topology, mut distances } = measured;
    let radii = scene.radii;
    let half_width = radii.half_width();
    let mut phi = signed_distance(&topology, &mut distances, Sphere::Init, radii);
    let is_banded = |leaf: usize| {
        let origin = topology.origins()[leaf];
        let is_within = |obstacle: &ObstacleLeaf| has_value_within(&phi.leaves[leaf], half_width, obstacle);
        // A part of an obstacle that the offset makes vanish for now is there again once the surface is moved.
        regions.banded.contains(origin)
            && (is_within(&scene.obstacle_before_offset(origin))
                || radii.offset != 0.0 && is_within(&scene.obstacle(origin)))
    };
    let kept: Vec<usize> = (0..topology.len()).into_par_iter().filter(|&leaf| is_banded(leaf)).collect();
    rayon::join(|| keep(&mut phi, &kept), || distances.keep(&kept));
    let topology = subset(topology, &kept);
    let mut lower = signed_distance(&topology, &mut distances, Sphere::Max, radii);
    let mut upper = signed_distance(&topology, &mut distances, Sphere::Min, radii);
    drop(distances);
    let own: Vec<usize> =
        (0..topology.len()).filter(|&leaf| regions.own.contains(topology.origins()[leaf])).collect();
    for field in [&mut phi, &mut lower, &mut upper] {
        keep(field, &own);
    }
    let topology = Arc::new(subset(topology, &own));
    let mut band = NarrowBand { topology, phi, half_width };
    let mut bounds = Bounds { lower, upper };
    // What is not stored is at least the half width away, and a voxel beside it nearly so. Outer bounds that are
    // farther than the band has room for must not let the surface out of it; those of balls that are alike never do. Inward it
    // goes far only where it is sharply convex, as only small balls are, and their own S_min is near. Room for the offset is
    // not theirs.
    let held_beyond = if bins.shapes.are_balls() { f32::INFINITY } else { radii.result_half_width() - 2.0 };
    finish(&mut band, &mut bounds, (held_beyond, HELD + radii.outward()));
    let contact = match scene.obstacles.is_empty() {
        true => ContactTally::default(),
        false => hold_contact(
            |origin| scene.obstacle_before_offset(origin),
            scene.void_threshold,
            &mut band,
            &mut bounds,
        ),
    };
    Rasterized { bins, band, bounds, contact }
}

/// Whether a leaf has a value within the half width, once an obstacle has cut it (Eq. 12).
fn has_value_within(phi: &Leaf, half_width: f32, obstacle: &ObstacleLeaf) -> bool {
    match obstacle {
        ObstacleLeaf::Outside => phi.values.iter().any(|phi| phi.abs() < half_width),
        ObstacleLeaf::Inside => false,
        ObstacleLeaf::Near(distances) => {
            let cut = phi.values.iter().zip(&distances.values).map(|(phi, distance)| phi.max(-distance));
            cut.into_iter().any(|phi| phi.abs() < half_width)
        }
    }
}

/// Leaves only these of a field, in order.
fn keep(field: &mut Field, kept: &[usize]) {
    if kept.len() == field.leaves.len() {
        return;
    }
    for (to, &from) in kept.iter().enumerate() {
        field.leaves.copy_within(from..from + 1, to);
    }
    field.leaves.truncate(kept.len());
    field.leaves.shrink_to_fit();
}

/// The topology of these leaves of another.
fn subset(topology: Topology, kept: &[usize]) -> Topology {
    if kept.len() == topology.len() {
        return topology;
    }
    Topology::new(kept.iter().map(|&leaf| topology.origins()[leaf]).collect())
}

/// Sweeps after which every voxel within the half width has its distance: a sweep goes one voxel
/// along the axes, and the diagonal is √3 as long.
fn sweep_count(half_width: f32) -> u32 {
    (3f32.sqrt() * half_width).ceil() as u32
}

/// Holds all values within ± half width, makes `lower` ≤ `upper` at every voxel, which sweeping each by itself
/// does not promise, and moves φ between them. Where φ_0 is more than `held_beyond`, φ stays above `held`.
fn finish(band: &mut NarrowBand, bounds: &mut Bounds, (held_beyond, held): (f32, f32)) {
    let half_width = band.half_width;
    let bounds = bounds.lower.leaves.par_iter_mut().zip(&mut bounds.upper.leaves);
    band.phi.leaves.par_iter_mut().zip(bounds).for_each(|(phi, (lower, upper))| {
        simd::dispatch(Finish { half_width, held_beyond, held, phi, lower, upper });
    });
}

/// The least that φ may be where it is to stay positive, in voxels, once the surface is moved.
const HELD: f32 = 1.0;

/// The values of one leaf.
struct Finish<'a> {
    half_width: f32,
    held_beyond: f32,
    held: f32,
    phi: &'a mut Leaf,
    lower: &'a mut Leaf,
    upper: &'a mut Leaf,
}

impl Kernel for Finish<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let (least, most) = (V::splat(-self.half_width), V::splat(self.half_width));
        let (held, held_beyond) = (V::splat(self.held), V::splat(self.held_beyond));
        for row in 0..ROW_COUNT {
            let (phi, lower, upper) =
                (self.phi.row_mut(row), self.lower.row_mut(row), self.upper.row_mut(row));
            let start = V::load(phi).max(least).min(most);
            let lowest = V::select(held_beyond.lt(start), held, least);
            let new_upper = V::load(upper).max(least).min(most);
            let new_lower = V::load(lower).max(lowest).min(most).min(new_upper);
            let new_phi = start.max(new_lower).min(new_upper);
            new_upper.store(upper);
            new_lower.store(lower);
            new_phi.store(phi);
        }
    }
}
