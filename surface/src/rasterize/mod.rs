//! Particles to level sets: three unions of spheres (paper, Eq. 1 and 2).
//!
//! ```text
//!      r_max ─────────────    S_max    φ_max = lower bound of φ
//!     r_init ─ ─ ─ ─ ─ ─ ─    S_0      φ_0   = where smoothing starts
//!      r_min ─────────────    S_min    φ_min = upper bound of φ
//!                  ●          particle
//! ```
//!
//! Outside a union of equal spheres, the distance to the nearest center minus the radius is the exact signed
//! distance and is kept unchanged. Inside the union, that value is not the distance to the surface: however
//! deep a voxel lies, some center is near it. So inside, only the voxels next to the surface keep the value,
//! and fast sweeping computes the others from them. The zero sets of the bounds are therefore those of the
//! spheres themselves. Only there do bounds bind, so they are computed near them and are open elsewhere.
//!
//! Most of a frame is deep inside. `Culling` determines which particles and leaves can affect the surface;
//! nothing else is stored:
//!
//! ```text
//!   particles ──pass 1──▶ Occupancy ──▶ Culling ──┐
//!       └───pass 2────────────────────────────────┴─▶ ParticleBins ──▶ distances ──▶ φ_0, bounds
//! ```
//!
//! A frame that is still too large is rasterized window by window; the results equal those of the whole
//! frame.

mod bin;
mod culling;
mod distances;
mod ellipsoid;
mod footprint;
mod kernels;
mod occupancy;
mod vicinity;

use std::sync::Arc;

use glam::IVec3;
use rayon::prelude::*;

pub use bin::{ParticleBins, StoredBins};
pub use footprint::{Footprint, NearSurface, footprint};
pub use occupancy::Occupancy;
pub use vicinity::{GatherBlock, Gathered, Vicinity};

use crate::grid::{FACE_STEPS, Field, LEAF_EDGE, Leaf, LeafMask, NO_LEAF, ROW_COUNT, Topology};
use crate::level_set::{Bounds, NarrowBand, Sweeps, redistance_field};
use crate::obstacle::{ContactStats, ObstacleLeaf, Obstacles, fill_gaps_at_obstacles};
use crate::parallel::Loops as _;
use crate::particles::{AnySource, LEVEL_AT, ParticleSource, Unread, erased};
use crate::simd::{self, Kernel, Lanes};
use crate::space::{CoordBox, Lattice};
use culling::{Culling, leaves_around_boxes};
use distances::{DistanceSolver, SphereDistances, SphereUnion, signed_distance};
use occupancy::middle;

/// The radii of the three unions of spheres, in voxels: `min` ≤ `init` ≤ `max`. The semi-axes of anisotropic
/// particles are given as multiples of these radii.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Radii {
    /// r_min: the surface stays outside these spheres.
    pub min: f32,
    /// r_init: the initial surface.
    pub init: f32,
    /// r_max: the surface stays inside these spheres.
    pub max: f32,
    /// Lower bound of all semi-axes, in units of the radii: 1 for uniform balls.
    pub min_scale: f32,
    /// The semi-axis for which the width of the band is computed, in units of the radii: 1 for uniform balls.
    /// If particles have longer semi-axes, the band is too narrow for the surface to move quite as far as
    /// their bounds would allow.
    pub band_scale: f32,
    /// How much less than its bounds allow the surface moves, in voxels: the band is narrower by that.
    pub unused_gap: f32,
    /// Offset of the finished surface, in voxels: positive outward, negative inward. The band is wide enough
    /// for it.
    pub offset: f32,
    /// What the initial surface is made of.
    pub start: Start,
    /// How far the surface may move outward from a start of kernels, in voxels.
    pub room: f32,
}

/// What the initial surface is made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Start {
    /// Three unions of spheres (paper, Eq. 1 and 2).
    #[default]
    Spheres,
    /// The level of a sum of kernels. Each reaches to r_max.
    Kernels,
}

impl Start {
    /// The radius of the smallest ball that the grid resolves wherever it is, in voxels.
    pub const fn resolved_voxels(self) -> f64 {
        match self {
            Start::Spheres => 1.732_050_807_568_877_2,
            Start::Kernels => 1.1,
        }
    }
}

/// Bounds are distances up to this far from their zero set, in voxels: far enough to cover both voxels of every
/// edge that the zero set crosses. Farther away they only keep φ on its side, by at least this distance. The
/// surface differs from that with bounds everywhere by a hundredth of a voxel.
const BOUND_REACH: f32 = 1.5;

/// Exact distances are kept up to this far beyond r_max, in voxels; fast sweeping computes those beyond.
const EXACT_MARGIN: f32 = 2.0;

impl Radii {
    /// The radii of uniform balls.
    pub const fn uniform(min: f32, init: f32, max: f32) -> Radii {
        Radii {
            min,
            init,
            max,
            min_scale: 1.0,
            band_scale: 1.0,
            unused_gap: 0.0,
            offset: 0.0,
            start: Start::Spheres,
            room: 0.0,
        }
    }

    /// Half width of the band during smoothing, in voxels. The offset uses up a part of this width: around
    /// the moved surface [`result_half_width`](Self::result_half_width) is left.
    pub fn half_width(&self) -> f32 {
        self.result_half_width() + self.offset.abs().ceil()
    }

    /// Half width that smoothing needs at most (Eq. 7), in voxels: it reads values up to 5 voxels from the
    /// surface, and the surface may move to either bound, less the unused gap. The band of the result has this
    /// half width, too.
    pub fn result_half_width(&self) -> f32 {
        let gap = match self.start {
            Start::Spheres => {
                (self.max - self.init).max(self.init - self.min) * self.band_scale - self.unused_gap
            }
            Start::Kernels => 0.0,
        };
        // Tolerates rounding: radii that differ by whole voxels need no extra voxel.
        5.0 + (gap - 1e-4).max(0.0).ceil()
    }

    /// Maximum distance, in voxels, at which a particle can change φ_0 and the bounds. It is the sum of four
    /// terms: the reach of exact distances; that of the sweeps of φ_0, which read values up to two voxels
    /// away; two leaves, which may appear or disappear with φ_0; and that of the sweeps of the bounds on
    /// these leaves. `longest` is the longest semi-axis of any particle, in units of the radii.
    pub fn reach_voxels(&self, longest: f32) -> u32 {
        let swept = [self.half_width(), BOUND_REACH].map(|reach| 2 * sweep_count(reach));
        self.exact_reach(longest).ceil() as u32 + swept[0] + 2 * LEAF_EDGE as u32 + swept[1]
    }

    /// Number of leaves around a window that are rasterized with it.
    pub fn window_halo_leaves(&self) -> i32 {
        let regions = Regions::new(CoordBox { min: IVec3::ZERO, max: IVec3::ZERO }, *self, self.band_scale);
        (regions.own.min.x - regions.measured.min.x) / LEAF_EDGE
    }

    /// Distance from a particle's center up to which exact distances are kept, in voxels. `longest` is the
    /// longest semi-axis, in units of the radii.
    fn exact_reach(&self, longest: f32) -> f32 {
        // Validation looks up the nearest particles of vertices that were moved outward.
        self.max * longest + self.outward() + EXACT_MARGIN
    }

    /// How far the finished surface is moved outward, in voxels; 0 if it is moved inward.
    pub fn outward(&self) -> f32 {
        self.offset.max(0.0)
    }

    /// The least depth of a particle below the finished surface, in voxels.
    pub fn depth_min(&self) -> f32 {
        match self.start {
            Start::Spheres => self.min * self.min_scale + self.offset,
            Start::Kernels => self.min + self.offset,
        }
    }

    /// The radius of the ball around a particle of scale 1 that is inside the initial surface, in voxels.
    pub fn inside(&self) -> f32 {
        match self.start {
            Start::Spheres => self.init,
            Start::Kernels => LEVEL_AT * self.max,
        }
    }

    /// How far from a particle the initial surface may be, in voxels, if its longest semi-axis is 1.
    pub fn start_reach(&self) -> f32 {
        match self.start {
            Start::Spheres => self.init,
            Start::Kernels => kernels::REACH * self.max,
        }
    }

    /// A leaf is stored if one of its voxels is within this distance, per axis, of a voxel next to the
    /// surface.
    fn band_margin(&self) -> i32 {
        self.half_width() as i32 + 1
    }
}

/// Parameters of rasterization.
#[derive(Clone, Copy)]
pub struct RasterParams<'a> {
    /// Maps world positions to voxels.
    pub lattice: Lattice,
    /// The radii of the spheres.
    pub radii: Radii,
    /// Obstacles that the fluid must not enter.
    pub obstacles: &'a Obstacles,
    /// Gaps between fluid and obstacles narrower than this, in voxels, are filled.
    pub void_threshold: f32,
    /// Whether to keep all particles, for callers that count them. Otherwise those deep inside are dropped.
    pub keeps_all_particles: bool,
}

impl RasterParams<'_> {
    /// Parameters without obstacles.
    pub fn open(lattice: Lattice, radii: Radii) -> RasterParams<'static> {
        static NO_OBSTACLES: Obstacles = Obstacles { members: Vec::new() };
        RasterParams {
            lattice,
            radii,
            obstacles: &NO_OBSTACLES,
            void_threshold: 0.0,
            keeps_all_particles: false,
        }
    }

    /// The obstacles' signed distances in the leaf with this origin, in voxels.
    pub fn obstacle(&self, origin: IVec3) -> ObstacleLeaf {
        self.obstacles.leaf(origin, &self.lattice, self.obstacle_half_width())
    }

    /// Distance from obstacles up to which their signed distance is known, in voxels: covers the surface
    /// before and after the offset.
    pub fn obstacle_half_width(&self) -> f32 {
        self.radii.half_width() + self.radii.offset.abs()
    }

    /// Signed distances to obstacles that are grown by the offset (shrunk if it is negative): a surface that
    /// touches these touches the real obstacles after it is moved. Known within the half width of the band.
    pub fn obstacle_before_offset(&self, origin: IVec3) -> ObstacleLeaf {
        self.obstacle(origin).shifted(-self.radii.offset, self.radii.half_width())
    }

    /// True if an obstacle's surface may pass near a voxel of the leaf with this origin.
    fn is_at_obstacle(&self, origin: IVec3) -> bool {
        self.obstacles.touches(origin, &self.lattice, OBSTACLE_MARGIN + self.radii.offset.abs())
    }
}

/// An obstacle's surface nearer to a leaf than this, in voxels, may pass between two of its voxels or their
/// neighbors.
const OBSTACLE_MARGIN: f32 = 1.5;

/// Result of rasterization.
#[derive(Clone, Debug)]
pub struct RasterFields {
    /// The particles that can affect φ_0 or the bounds.
    pub bins: ParticleBins,
    /// The band around the initial surface, with φ_0.
    pub band: NarrowBand,
    /// The bounds, on the same leaves.
    pub bounds: Bounds,
    /// What the obstacles changed.
    pub contact: ContactStats,
}

/// Rasterizes a frame.
///
/// # Errors
/// Returns the source's error if a batch cannot be read.
pub fn rasterize<S: ParticleSource>(source: &S, scene: &RasterParams) -> Result<RasterFields, S::Error> {
    erased(source, |source| rasterize_any(source, scene))
}

/// Like [`rasterize()`].
pub(crate) fn rasterize_any(source: &AnySource<'_>, scene: &RasterParams) -> Result<RasterFields, Unread> {
    let occupancy = Occupancy::new(source, &scene.lattice)?;
    let regions = Regions::new(CoordBox::ALL, scene.radii, occupancy.longest());
    let measured = measure(source, &occupancy, scene, &regions)?;
    drop(occupancy);
    Ok(level_sets(measured, scene, &regions))
}

/// Rasterizes the leaves that touch a window, a box of voxels. Leaves and values are bit-identical to those
/// of the whole frame. The result also contains particles around the window that contribute to it.
///
/// # Errors
/// Returns the source's error if a batch cannot be read.
pub fn rasterize_window(
    source: &AnySource<'_>,
    occupancy: &Occupancy,
    scene: &RasterParams,
    window: CoordBox,
) -> Result<RasterFields, Unread> {
    let regions = Regions::new(window, scene.radii, occupancy.longest());
    let measured = measure(source, occupancy, scene, &regions)?;
    Ok(level_sets(measured, scene, &regions))
}

/// The leaves around the surface, with the distances from their voxels to the particles.
struct NearDistances {
    bins: ParticleBins,
    topology: Topology,
    distances: SphereDistances,
}

fn measure(
    source: &AnySource<'_>,
    occupancy: &Occupancy,
    scene: &RasterParams,
    regions: &Regions,
) -> Result<NearDistances, Unread> {
    let mut culling = Culling::new(occupancy, scene, regions);
    let mut bins = ParticleBins::new(source, &scene.lattice, occupancy, &culling, regions)?;
    let solver = DistanceSolver::new(&bins, scene.radii);
    solver.deepen(&mut culling, scene);
    let near = solver.distances(&culling.near, &culling);
    let topology = Topology::new(leaves_near_surface(&culling, &near, scene, regions));
    let distances = solver.extended((&culling.near, near), &topology, &culling);
    drop(solver);
    if occupancy.has_shapes {
        bins.record_deep(&culling);
    }
    Ok(NearDistances { bins, topology, distances })
}

/// Origins of the leaves near the surface: those with a voxel within about the band's margin of a voxel
/// inside S_0 that has a face neighbor outside. With obstacles there are two surfaces, that of S_0 and that
/// of S_0 minus the obstacles. A void may be filled next to either of them, so the leaves near the second
/// surface are included. Here the obstacles have their real surfaces, which φ meets after the offset. During
/// smoothing, obstacles are grown or shrunk by the offset; their surfaces then lie within the margin, which
/// includes the offset. So a plate that is thinner than the offset is not lost, although it vanishes when it
/// is shrunk.
fn leaves_near_surface(
    culling: &Culling,
    distances: &SphereDistances,
    scene: &RasterParams,
    regions: &Regions,
) -> Vec<IVec3> {
    let mut inside = distances.inside(SphereUnion::Init, scene.radii);
    let mut surfaces = crossings(culling, &inside, |origin| culling.is_deep(origin), regions);
    if !scene.obstacles.is_empty() {
        let leaves = inside.par_iter_mut().zip(culling.near.origins());
        leaves.halved().for_each(|(inside, &origin)| remove_obstacle(inside, &scene.obstacle(origin)));
        let is_deep = |origin| culling.is_deep(origin) && scene.obstacle(origin) != ObstacleLeaf::Inside;
        surfaces.extend(crossings(culling, &inside, is_deep, regions));
    }
    leaves_around_boxes(&surfaces, scene.radii.band_margin(), |origin| regions.swept.contains(origin))
}

/// For each eighth of each leaf, the bounding box of its voxels that are inside and next to an outside voxel. The
/// boxes of whole leaves would be near twice as many leaves as are stored.
fn crossings(
    culling: &Culling,
    inside: &[LeafMask],
    is_deep: impl Fn(IVec3) -> bool + Sync,
    regions: &Regions,
) -> Vec<(IVec3, CoordBox)> {
    let surface = |(leaf, &origin): (usize, &IVec3)| {
        let faces = std::array::from_fn(|face| match culling.near.neighbors()[leaf][face] {
            // A leaf that is not near the surface is either entirely inside or entirely outside.
            NO_LEAF if is_deep(origin + FACE_STEPS[face] * LEAF_EDGE) => &LeafMask::FULL,
            NO_LEAF => &LeafMask::EMPTY,
            neighbor => &inside[neighbor as usize],
        });
        let mut crossings = inside[leaf];
        crossings.remove_all(&inside[leaf].surrounded(faces));
        let is_crossed = !crossings.is_empty() && regions.crossed.contains(origin);
        let eighths = is_crossed.then(|| crossings.eighths()).into_iter().flatten();
        eighths.filter(|eighth| !eighth.is_empty()).map(move |eighth| (origin, eighth.bounding_box()))
    };
    culling.near.origins().par_iter().enumerate().halved().flat_map_iter(surface).collect()
}

/// Clears the voxels that are in an obstacle.
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

/// φ_0 and the bounds, on the leaves with a value of φ_0 within the half width.
fn level_sets(measured: NearDistances, scene: &RasterParams, regions: &Regions) -> RasterFields {
    let NearDistances { bins, topology, mut distances } = measured;
    let radii = scene.radii;
    // Memory for the sweeps.
    let mut scratch = Field::default();
    let half_width = radii.half_width();
    let mut phi = match radii.start {
        Start::Spheres => {
            signed_distance(&topology, &mut distances, SphereUnion::Init, radii, half_width, &mut scratch)
        }
        Start::Kernels => {
            distance_to_zero(&topology, distances.take(SphereUnion::Init), half_width, &mut scratch)
        }
    };
    let is_banded = |leaf: usize| {
        let origin = topology.origins()[leaf];
        let is_within = |obstacle: &ObstacleLeaf| has_value_within(&phi.leaves[leaf], half_width, obstacle);
        // A thin part of an obstacle that vanishes when it is shrunk by the offset is needed again after the
        // surface is moved.
        regions.banded.contains(origin)
            && (is_within(&scene.obstacle_before_offset(origin))
                || radii.offset != 0.0 && is_within(&scene.obstacle(origin)))
    };
    let kept: Vec<usize> =
        (0..topology.len()).into_par_iter().halved().filter(|&leaf| is_banded(leaf)).collect();
    if topology.len() - kept.len() > WASTED_LEAVES_MAX {
        scratch = Field::default();
    }
    // One after the other, so that only one of them exists twice for a moment.
    keep(&mut phi, &kept);
    distances.keep(&kept);
    let topology = subset(topology, &kept);
    let [mut lower, mut upper] = match radii.start {
        Start::Spheres => [SphereUnion::Max, SphereUnion::Min].map(|sphere| {
            signed_distance(&topology, &mut distances, sphere, radii, BOUND_REACH, &mut scratch)
        }),
        Start::Kernels => {
            let [nearest, room] = [SphereUnion::Max, SphereUnion::Min].map(|sphere| distances.take(sphere));
            kernels::bounds(&phi, nearest, room, [radii.room, radii.min])
        }
    };
    drop((distances, scratch));
    let own: Vec<usize> =
        (0..topology.len()).filter(|&leaf| regions.own.contains(topology.origins()[leaf])).collect();
    [&mut phi, &mut lower, &mut upper].into_iter().for_each(|field| keep(field, &own));
    let topology = Arc::new(subset(topology, &own));
    let mut band = NarrowBand { topology, phi, half_width };
    // Voxels that are not stored are at least the half width from the surface, and stored voxels next to them
    // are almost as far from it. If particles are not uniform balls, the lower bounds at these voxels would
    // let the surface leave the band, so the bounds are raised to keep φ positive there. The upper bounds
    // need no such limit: the surface moves far inward only where it is sharply convex, as around small
    // balls, and there S_min is near. `inner_from` does not include the extra width for the offset.
    let inner_from = if bins.shapes.is_uniform() { f32::INFINITY } else { radii.result_half_width() - 2.0 };
    finish(&mut band, [&mut lower, &mut upper], inner_from, POSITIVE_MARGIN + radii.outward());
    let contact = if scene.obstacles.is_empty() {
        ContactStats::default()
    } else {
        fill_gaps_at_obstacles(
            |origin| scene.obstacle_before_offset(origin),
            scene.void_threshold,
            radii.start,
            &mut band,
            [&mut lower, &mut upper],
        )
    };
    RasterFields { bins, band, bounds: Bounds::new(lower, upper), contact }
}

/// The signed distances to the zero set of a field, up to `half_width`.
fn distance_to_zero(topology: &Topology, field: Field, half_width: f32, scratch: &mut Field) -> Field {
    scratch.copy_from(&field);
    let mut phi = field;
    redistance_field(topology, &mut phi, half_width, Sweeps::accurate(sweep_count(half_width)), scratch);
    phi
}

/// True if a leaf has a value within the half width after obstacles are cut out (Eq. 12).
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

/// Keeps only these leaves of a field, in ascending order. A field that loses few leaves keeps its memory,
/// because the system takes longer to provide new memory.
fn keep(field: &mut Field, kept: &[usize]) {
    if field.leaves.len() - kept.len() > (field.leaves.len() / 6).min(WASTED_LEAVES_MAX) {
        field.leaves = kept.par_iter().halved().map(|&leaf| field.leaves[leaf]).collect();
    } else {
        keep_in_place(field, kept);
    }
}

/// Like [`keep`], always in the same memory.
fn keep_in_place(field: &mut Field, kept: &[usize]) {
    if kept.len() < field.leaves.len() {
        kept.iter().enumerate().for_each(|(to, &from)| field.leaves.copy_within(from..from + 1, to));
        field.leaves.truncate(kept.len());
    }
}

/// Number of leaves per field whose memory may stay unused: 2 MiB.
const WASTED_LEAVES_MAX: usize = (2 << 20) / size_of::<Leaf>();

/// The topology that contains only the leaves `kept` of `topology`.
fn subset(topology: Topology, kept: &[usize]) -> Topology {
    if kept.len() == topology.len() {
        return topology;
    }
    Topology::new(kept.iter().map(|&leaf| topology.origins()[leaf]).collect())
}

/// Number of sweeps after which every voxel within the half width has its distance: a sweep advances one
/// voxel along the axes, so a distance along the diagonal needs √3 times as many sweeps.
fn sweep_count(half_width: f32) -> u32 {
    (3f32.sqrt() * half_width).ceil() as u32
}

/// Clamps φ to ± half width, and opens the bounds beyond [`BOUND_REACH`]. Ensures `lower` ≤ `upper` at every
/// voxel (independent sweeps do not guarantee it), and clamps φ between them. Where φ_0 is above `inner_from`,
/// φ stays at or above `inner_value`.
fn finish(band: &mut NarrowBand, [lower, upper]: [&mut Field; 2], inner_from: f32, inner_value: f32) {
    let half_width = band.half_width;
    let bounds = lower.leaves.par_iter_mut().zip(&mut upper.leaves);
    band.phi.leaves.par_iter_mut().zip(bounds).halved().for_each(|(phi, (lower, upper))| {
        simd::dispatch(ClampLeaf { half_width, inner_from, inner_value, phi, lower, upper });
    });
}

/// Lower limit of φ where it must stay positive after the offset, in voxels.
const POSITIVE_MARGIN: f32 = 1.0;

/// Kernel: clamps the values of one leaf.
struct ClampLeaf<'a> {
    half_width: f32,
    inner_from: f32,
    inner_value: f32,
    phi: &'a mut Leaf,
    lower: &'a mut Leaf,
    upper: &'a mut Leaf,
}

impl Kernel for ClampLeaf<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let (least, most) = (V::splat(-self.half_width), V::splat(self.half_width));
        let (inward, outward) = (V::splat(-BOUND_REACH), V::splat(BOUND_REACH));
        let (inner_value, inner_from) = (V::splat(self.inner_value), V::splat(self.inner_from));
        for row in 0..ROW_COUNT {
            let (phi, lower, upper) =
                (self.phi.row_mut(row), self.lower.row_mut(row), self.upper.row_mut(row));
            let start = V::load(phi).max(least).min(most);
            let lowest = V::select(inner_from.lt(start), inner_value, least);
            let (given_lower, given_upper) = (V::load(lower), V::load(upper));
            let new_upper = V::select(outward.lt(given_upper), most, given_upper.max(inward));
            let open_lower = V::select(given_lower.lt(inward), least, given_lower.min(outward));
            let new_lower = open_lower.max(lowest).min(new_upper);
            let new_phi = start.max(new_lower).min(new_upper);
            new_upper.store(upper);
            new_lower.store(lower);
            new_phi.store(phi);
        }
    }
}

// Computes how much around a window is needed to make its results identical to those of the whole frame.
//
//   own        the window's leaves: φ_0, the bounds, which leaves are stored
//   banded     φ_0, which leaves are stored; the bounds are swept on these    ⎫ each: 2 voxels per sweep,
//   swept      distances; φ_0 is swept on these                               ⎭ plus 1 for their start
//   crossed    surface crossings: leaves within the margin of one are stored    the band's margin
//   measured   distances: where a crossing is depends on neighbors              1 voxel
//   populated  particles                                                        reach of distances
//
// Read bottom-up, the lines are the steps of rasterization. Read top-down, each line depends on the next
// one, whose region is wider by the amount on the right of that next line. Leaves count as a whole, since a
// leaf is stored if any of its voxels is. A smaller region cannot be proved sufficient: a sweep reads values
// two voxels away along an axis, and each sweep reads those of the previous one. Sweeps start from the
// voxels whose distance is known, and whether it is known depends on the face neighbours: hence the 1.

/// Larger than the grid's index range, and small enough that adding margins does not overflow.
const EVERYWHERE: CoordBox = CoordBox { min: IVec3::splat(-3 << 29), max: IVec3::splat(3 << 29) };

/// The boxes of leaves that a window's results depend on, each inside the next.
#[derive(Clone, Copy, Debug)]
struct Regions {
    own: CoordBox,
    banded: CoordBox,
    swept: CoordBox,
    crossed: CoordBox,
    measured: CoordBox,
    populated: CoordBox,
}

impl Regions {
    /// The regions for the leaves that a window touches. `longest` bounds the semi-axes of all particles, in
    /// units of the radii.
    fn new(window: CoordBox, radii: Radii, longest: f32) -> Regions {
        let swept_voxels = |reach| 2 * sweep_count(reach) as i32 + 1;
        let window = CoordBox { min: window.min.max(EVERYWHERE.min), max: window.max.min(EVERYWHERE.max) };
        let own = leaves_around(window, 0);
        let banded = leaves_around(own, swept_voxels(BOUND_REACH));
        let swept = leaves_around(banded, swept_voxels(radii.half_width()));
        let crossed = leaves_around(swept, radii.band_margin());
        let measured = leaves_around(crossed, 1);
        // Rounding can put a particle on the upper boundary of its cell, so the index of its voxel may be too
        // small by one.
        let populated = leaves_around(measured, radii.exact_reach(longest).ceil() as i32 + 1);
        Regions { own, banded, swept, crossed, measured, populated }
    }
}

/// The box of the leaves within `margin` voxels of a box.
fn leaves_around(voxels: CoordBox, margin: i32) -> CoordBox {
    let (expanded, edge) = (voxels.expanded(margin), IVec3::splat(LEAF_EDGE));
    CoordBox {
        min: expanded.min.div_euclid(edge) * LEAF_EDGE,
        max: expanded.max.div_euclid(edge) * LEAF_EDGE + (LEAF_EDGE - 1),
    }
}

/// True if two boxes share a voxel.
fn meet(one: &CoordBox, other: &CoordBox) -> bool {
    one.min.cmple(other.max).all() && other.min.cmple(one.max).all()
}

// Finds outliers: particles so far away that 32-bit positions cannot represent a surface around them.
//
//   ┌──┬──┬──┐                                              ┌──┐
//   │ 9│50│30│  ◀────────── more than 2²⁰ voxels ─────────▶  │ 1│     dropped: few, and far from all others
//   └──┴──┴──┘                                              └──┘
//
// At that distance from the mesh's origin, 32-bit positions are off by 1/16 voxel or more. For the same
// reason, the spread of a frame has the same limit (`reconstruction::SPREAD_MAX_VOXELS`). If more than a few
// particles are that far away, the frame really is that wide and all particles are kept. The result depends
// only on the number of particles in each leaf.

/// Leaves farther than this from the median of the particles along an axis, in voxels, are too far away.
const FARTHEST_VOXELS: i32 = 1 << 20;

/// Up to 8 particles or 1 % of all count as few, and always fewer than half.
const FEW: usize = 8;
const FEW_ONE_IN: usize = 100;

/// Origins of the leaves whose particles are dropped, sorted. `leaves` yields leaf origins with their
/// particle counts.
fn outlier_leaves<L: Iterator<Item = (IVec3, usize)>>(leaves: impl Fn() -> L) -> Vec<IVec3> {
    let bounds = leaves().map(|(origin, _)| (origin, origin));
    let bounds = bounds.reduce(|(low, high), (one, other)| (low.min(one), high.max(other)));
    // The difference of two indices of the grid fits into 32 bits.
    let is_wide = bounds.is_some_and(|(low, high)| (high - low).max_element() > FARTHEST_VOXELS);
    if !is_wide {
        return Vec::new();
    }
    let along = |axis: usize| middle(leaves().map(|(origin, count)| (origin[axis], count)));
    let center = IVec3::new(along(0), along(1), along(2));
    let is_far = |(origin, _): &(IVec3, usize)| (*origin - center).abs().max_element() > FARTHEST_VOXELS;
    let far: Vec<(IVec3, usize)> = leaves().filter(is_far).collect();
    let far_count: usize = far.iter().map(|(_, count)| count).sum();
    let all_count: usize = leaves().map(|(_, count)| count).sum();
    if far_count > FEW.max(all_count / FEW_ONE_IN) || 2 * far_count >= all_count {
        return Vec::new();
    }
    let mut far: Vec<IVec3> = far.into_iter().map(|(origin, _)| origin).collect();
    far.sort_unstable_by_key(|origin| origin.to_array());
    far
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod tests_of_shapes;

#[cfg(test)]
mod tests_of_regions {
    use super::*;

    #[test]
    fn one_leaf_window_needs_these_rings_of_leaves() {
        let radii = Radii::uniform(1.732, 2.598, 3.464);
        let regions = Regions::new(CoordBox { min: IVec3::ZERO, max: IVec3::splat(7) }, radii, 1.0);
        // 7 and 23 voxels for the sweeps are one and three leaves; then follow 7 voxels, 1 voxel and 7 voxels.
        let rings = [0, 1, 4, 5, 6, 7];
        let found = [
            regions.own,
            regions.banded,
            regions.swept,
            regions.crossed,
            regions.measured,
            regions.populated,
        ];
        for (found, ring) in found.into_iter().zip(rings) {
            assert_eq!((found.min, found.max), (IVec3::splat(-8 * ring), IVec3::splat(8 * ring + 7)));
            assert!(found.contains(found.min) && !found.contains(found.min - IVec3::new(0, 8, 0)));
        }
        assert!(meet(&regions.own, &CoordBox { min: IVec3::splat(7), max: IVec3::splat(9) }));
        assert!(!meet(&regions.own, &CoordBox { min: IVec3::new(0, 0, 8), max: IVec3::splat(9) }));
    }

    #[test]
    fn everywhere_contains_the_index_range() {
        let radii = Radii::uniform(32.0, 48.0, 64.0);
        let own = Regions::new(CoordBox::ALL, radii, 1.0).own;
        let farthest = IVec3::splat(crate::space::INDEX_LIMIT + 1000);
        assert!(own.contains(farthest) && own.contains(-farthest));
    }

    #[test]
    fn only_a_few_particles_far_from_the_rest_are_outliers() {
        let outliers_of = |leaves: &[(i32, usize)]| -> Vec<i32> {
            let found = outlier_leaves(|| leaves.iter().map(|&(x, count)| (IVec3::new(8, x, 0), count)));
            found.into_iter().map(|origin| origin.y).collect()
        };
        let far = 2 * FARTHEST_VOXELS;
        assert_eq!(outliers_of(&[]), [0; 0]);
        assert_eq!(outliers_of(&[(0, 9), (far, 1), (8, 3)]), [far]);
        assert_eq!(outliers_of(&[(0, 900), (far, 8), (-far, 1)]), [-far, far]);
        assert_eq!(outliers_of(&[(0, 800), (far, 8), (-far, 1)]), [0; 0], "more than a few");
        assert_eq!(outliers_of(&[(0, 1), (far, 1)]), [0; 0], "half of the particles");
        assert_eq!(outliers_of(&[(0, 600), (far, 400)]), [0; 0], "two large clusters");
        assert_eq!(outliers_of(&[(0, 900), (FARTHEST_VOXELS, 1)]), [0; 0], "at the limit");
    }
}
