//! Smooths the surface by thin-plate flow, and keeps it between its bounds (paper, §3.2 to §3.5).
//!
//! ```text
//!   φ_0 ──15 Laplacian steps──▶ φ ──step──▶ redistance ──▶ clamp ──▶ … ──▶ φ
//!                                  └─ explicit, implicit or fast ─┘
//! ```
//!
//! Every frame is integrated over the same fictitious time rather than until convergence: that keeps a
//! sequence temporally coherent. The clamp comes last, so that the bounds (Eq. 6) hold at every voxel of the
//! result; the redistancing before it could violate them.

mod explicit;
mod heavy_ball;
mod implicit;
mod peaks;
mod schedule;

use rayon::prelude::*;

pub use explicit::EIGENVALUE_MAX;
pub use implicit::Convergence;
pub use schedule::{FieldSet, SmoothContext, SmoothOp, SmoothStats, Workspace, schedule};

use crate::grid::{Direction, Field, Leaf, LeafMask, NO_LEAF, ROW_COUNT, Topology};
use crate::level_set::{Bounds, NEAREST_TO_ZERO, NarrowBand};
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes};
use crate::words::word_enum;

word_enum! {
    /// How the constrained smoothing is integrated in fictitious time.
    #[derive(Default)]
    pub enum Integrator {
        /// Implicit steps by projected gradients with momentum: the fastest
        #[default]
        Fast = "fast",
        /// The paper's Algorithm 2, implicit steps: conjugate gradients with a growing active set
        Implicit = "implicit",
        /// The paper's Algorithm 1, explicit steps: many small steps
        Explicit = "explicit",
        /// Explicit steps as large as is stable (paper, §3.5), for single frames: sequences flicker
        Adaptive = "adaptive",
    }
}

impl Integrator {
    /// True if each step solves a linear system.
    pub fn is_implicit(self) -> bool {
        matches!(self, Integrator::Fast | Integrator::Implicit)
    }
}

/// The steps of the smoothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SmoothSteps {
    /// Number of Laplacian steps before the biharmonic ones. If 0, φ is redistanced instead.
    pub laplacian_steps: u32,
    /// The integrator of the biharmonic steps.
    pub integrator: Integrator,
    /// Number of biharmonic steps.
    pub steps: u32,
    /// Size of a biharmonic step, in units of h⁴. `Adaptive` varies the size within the same total time.
    pub step_size: f64,
    /// Number of biharmonic steps between redistancings. The last step is always followed by one.
    pub redistance_every: u32,
}

impl SmoothSteps {
    /// The size of a biharmonic step in the precision of voxels.
    fn step_size_f32(&self) -> f32 {
        self.step_size as f32
    }
}

impl Default for SmoothSteps {
    /// No steps.
    fn default() -> SmoothSteps {
        SmoothSteps {
            laplacian_steps: 0,
            integrator: Integrator::default(),
            steps: 0,
            step_size: 1.0,
            redistance_every: 1,
        }
    }
}

/// Configuration, in units of voxels and of the time h⁴.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SmoothConfig {
    /// True if φ_0 is no distance, as next to obstacles: φ is redistanced first.
    pub redistances_first: bool,
    /// The steps.
    pub smoothing: SmoothSteps,
    /// Pins the radius of isolated spheres in implicit steps, so that they keep the radius left by the
    /// Laplacian steps. Explicit steps keep it without pinning. With pinning, thin filaments of the smallest
    /// particles become slightly thicker and rougher.
    pub pin_isolated_spheres: bool,
    /// The result has exact distances within this distance of the surface, in voxels. With 0, distances are
    /// only as exact as the integrator needs.
    pub distances_voxels: f32,
}

/// Statistics of a smoothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SmoothReport {
    /// Number of unknowns of the first step: voxels with |φ| ≤ 3 voxels.
    pub free_voxel_count: usize,
    /// Maximum number of applications of the biharmonic operator to a voxel.
    pub pass_count: usize,
    /// Number of voxel updates. If all free voxels have the same number of passes, this is free voxels times
    /// passes.
    pub voxel_update_count: u64,
    /// How far a change of φ_0 or the bounds can propagate, in voxels; in the report of a frame, how far a
    /// change of one of its particles can. `None` for `Implicit`, whose dot products couple all voxels, and
    /// for `Adaptive`, whose step size depends on the fastest voxel.
    pub reach_voxels: Option<u32>,
    /// How the conjugate gradients converged; `None` unless the integrator is `Implicit`.
    pub convergence: Option<Convergence>,
    /// Number of explicit steps that moved some value by more than a voxel (Eq. 8).
    pub cfl_exceeded_count: usize,
}

/// Smooths `band` within `bounds`. `advanced` receives the progress, from 0 to 1.
pub fn smooth(
    band: &mut NarrowBand,
    bounds: &Bounds,
    config: &SmoothConfig,
    advanced: &mut dyn FnMut(f64),
) -> SmoothReport {
    let mut report = SmoothReport::new(config);
    let mut workspace = Workspace::new(band.topology.len());
    let schedule = schedule(config, u32::MAX);
    let op_count = schedule.len() as f64;
    for (index, op) in schedule.into_iter().enumerate() {
        let stats = SmoothContext { config, band, bounds, workspace: &mut workspace, own: None }.apply(op);
        report.add(op, stats);
        advanced((index + 1) as f64 / op_count);
    }
    report
}

/// Restores the distances and bounds of a smoothed level set that was changed since.
pub fn restore(band: &mut NarrowBand, bounds: &Bounds, config: &SmoothConfig) {
    smooth(band, bounds, &without_steps(config), &mut |_| {});
}

/// How far [`restore`] can propagate a change, in voxels; see [`SmoothReport::reach_voxels`].
pub fn restore_reach(config: &SmoothConfig) -> Option<u32> {
    SmoothReport::new(&without_steps(config)).reach_voxels
}

fn without_steps(config: &SmoothConfig) -> SmoothConfig {
    SmoothConfig {
        redistances_first: false,
        smoothing: SmoothSteps { laplacian_steps: 0, steps: 0, ..config.smoothing },
        ..*config
    }
}

/// Moves values away from zero, unless the bounds require values that small.
fn keep_off_zero(phi: &mut Field, bounds: &Bounds) {
    phi.leaves.par_iter_mut().enumerate().halved().for_each(|(leaf, phi)| {
        let [lower, upper] = bounds.of_leaf(leaf);
        for (offset, phi) in phi.values.iter_mut().enumerate() {
            if phi.abs() < NEAREST_TO_ZERO {
                *phi = NEAREST_TO_ZERO.copysign(*phi).max(lower.values[offset]).min(upper.values[offset]);
            }
        }
    });
}

/// Radius of an isolated sphere after Laplacian steps, in voxels: dr/dt = −2/r.
pub fn radius_after_laplacian(radius_voxels: f64, steps: u32) -> f64 {
    let time = f64::from(schedule::LAPLACIAN_STEP_SIZE) * f64::from(steps);
    (radius_voxels * radius_voxels - 4.0 * time).max(0.0).sqrt()
}

/// The Laplacian flow alone, for comparison with the biharmonic one (paper, Fig. 5): `steps` steps of 0.1 h²,
/// redistanced and clamped every 50 steps and at the end.
pub fn smooth_laplacian_only(band: &mut NarrowBand, bounds: &Bounds, steps: u32) {
    const REDISTANCE_EVERY: u32 = 50;
    let steps =
        SmoothSteps { laplacian_steps: steps, integrator: Integrator::Explicit, ..SmoothSteps::default() };
    let config = SmoothConfig { smoothing: steps, ..SmoothConfig::default() };
    let mut workspace = Workspace::new(band.topology.len());
    for op in schedule(&config, REDISTANCE_EVERY) {
        if matches!(op, SmoothOp::Laplacian { .. }) {
            for op in [op, SmoothOp::Redistance] {
                SmoothContext { config: &config, band, bounds, workspace: &mut workspace, own: None }
                    .apply(op);
            }
        }
    }
}

// Selects the voxels that a step may change, and the rows it must visit.
//
//      |φ| ≤ 3   free: the unknowns of a step
//      + 1       their face neighbors: the inner Laplacian is also needed here
//      + 1       the next neighbors: read, but held fixed
//
// The free voxels are selected from φ at the start of a step (paper, §3.5) and do not change during the
// step.

/// The free voxels of a step, and the rows where the inner Laplacian is needed.
struct FreeVoxels {
    /// Free voxels, by leaf.
    free: Vec<LeafMask>,
    /// Rows with a free voxel, by leaf: bit `x·8 + y`.
    free_rows: Vec<u64>,
    /// Rows with a free voxel or a face neighbor of one, by leaf: bit `x·8 + y`.
    laplacian_rows: Vec<u64>,
}

impl FreeVoxels {
    /// The free voxels are those with |φ| ≤ `width` voxels.
    fn new(topology: &Topology, phi: &Field, width: f32) -> FreeVoxels {
        FreeVoxels::of(topology, near(phi, width))
    }

    /// Like [`new`](Self::new), without the voxels that are pinned.
    fn excluding(topology: &Topology, phi: &Field, width: f32, held: &[LeafMask]) -> FreeVoxels {
        let mut free = near(phi, width);
        free.par_iter_mut().zip(held).halved().for_each(|(free, held)| free.remove_all(held));
        FreeVoxels::of(topology, free)
    }

    /// Uses exactly these free voxels.
    fn of(topology: &Topology, free: Vec<LeafMask>) -> FreeVoxels {
        let neighbors = topology.neighbors();
        let laplacian_rows = (0..free.len())
            .into_par_iter()
            .halved()
            .map(|leaf| dilated_rows(&free, &neighbors[leaf], leaf))
            .collect();
        let free_rows = free.par_iter().halved().map(LeafMask::occupied_rows).collect();
        FreeVoxels { free, free_rows, laplacian_rows }
    }

    /// Updates `free_rows` after voxels were removed from `free`. `laplacian_rows` need not change: extra
    /// rows cost only time.
    fn recount_free_rows(&mut self) {
        self.free_rows = self.free.par_iter().halved().map(LeafMask::occupied_rows).collect();
    }

    /// Number of free voxels in all leaves, or in those that are `own`.
    fn free_count(&self, own: Option<&[bool]>) -> u64 {
        let counted =
            self.free.par_iter().enumerate().halved().filter(|(leaf, _)| own.is_none_or(|own| own[*leaf]));
        counted.map(|(_, mask)| u64::from(mask.count())).sum()
    }
}

/// The voxels with |φ| ≤ `width`.
fn near(phi: &Field, width: f32) -> Vec<LeafMask> {
    phi.leaves.par_iter().halved().map(|leaf| simd::dispatch(NearZero { leaf, width })).collect()
}

/// The voxels of a leaf with |φ| ≤ `width`.
struct NearZero<'a> {
    leaf: &'a Leaf,
    width: f32,
}

impl Kernel for NearZero<'_> {
    type Output = LeafMask;

    #[inline(always)]
    fn run<V: Lanes>(self) -> LeafMask {
        let mut mask = LeafMask::EMPTY;
        for row in 0..ROW_COUNT {
            let is_beyond = V::splat(self.width).lt(V::load(self.leaf.row(row)).abs());
            mask.set_row(row, !V::bits(is_beyond));
        }
        mask
    }
}

/// The rows of a leaf that contain a free voxel or a face neighbor of one.
fn dilated_rows(free: &[LeafMask], neighbors: &[u32; 6], leaf: usize) -> u64 {
    let face = |direction: Direction| {
        let neighbor = neighbors[direction as usize];
        if neighbor == NO_LEAF { LeafMask::EMPTY } else { free[neighbor as usize] }
    };
    let own = free[leaf].occupied_rows();
    // Row (x, y) is bit x·8 + y: a step in x shifts by 8, a step in y by 1 within each byte.
    let along_x = own << 8 | own >> 8;
    let along_y = (own << 1 & !0x0101_0101_0101_0101) | (own >> 1 & !0x8080_8080_8080_8080);
    let from_x = face(Direction::XMinus).occupied_rows() >> 56 | face(Direction::XPlus).occupied_rows() << 56;
    let from_y = (face(Direction::YMinus).occupied_rows() >> 7 & 0x0101_0101_0101_0101)
        | (face(Direction::YPlus).occupied_rows() << 7 & 0x8080_8080_8080_8080);
    let from_z = face(Direction::ZMinus).rows_with(0x80) | face(Direction::ZPlus).rows_with(0x01);
    own | along_x | along_y | from_x | from_y | from_z
}

// Finds where the free region is so thick that a step converges slowly.
//
// The free voxels of a step are a layer along the surface, about six voxels thick, between fixed values.
// Modes that fit into this layer have a wavelength of about its thickness, and therefore an eigenvalue of at
// least 1 + (4.73/6.5)⁴·Δt, like a plate clamped on both sides. Only where surfaces come close, as in spray
// and thin sheets, do their layers merge into a thicker region, which has slow modes.
//
//   fixed ──────────      ────────╮  ╭────────
//   free  ▒▒▒▒▒▒▒▒▒▒      ▒▒▒▒▒▒▒▒╰▒▒╯▒▒▒▒▒▒▒▒
//         ~~surface~      ~surface~▒▒~surface~       the middle is more than four voxels from any fixed
//   free  ▒▒▒▒▒▒▒▒▒▒      ▒▒▒▒▒▒▒▒╭▒▒╮▒▒▒▒▒▒▒▒       voxel: a deep voxel
//   fixed ──────────      ────────╯  ╰────────
//
// Deep voxels remain after four erosions, alternating between a cross and a cube, which together approximate
// a ball. Voxels around deep ones count as thick. The test is per voxel and does not depend on leaf
// boundaries.

/// Voxels within this distance of a deep one, per axis, count as thick. Deep voxels are more than four from
/// fixed ones.
const AROUND_DEEP: usize = 6;

/// Maximum distance of the voxels that affect whether a voxel is thick.
const THICKNESS_REACH: u32 = AROUND_DEEP as u32 + 4;

/// The free voxels that are thick.
fn thick(topology: &Topology, free: &[LeafMask]) -> Vec<LeafMask> {
    let mut left = free.to_vec();
    for axes in [&[0, 1, 2][..], &[0], &[1], &[2], &[0, 1, 2], &[0], &[1], &[2]] {
        left = with_neighbors(topology, &left, axes, 1, LeafMask::and);
    }
    if left.par_iter().halved().all(LeafMask::is_empty) {
        return left;
    }
    for axis in 0..3 {
        left = with_neighbors(topology, &left, &[axis], AROUND_DEEP, LeafMask::or);
    }
    left.par_iter().zip(free).halved().map(|(near_deep, free)| near_deep.and(free)).collect()
}

/// Joins each mask with copies of itself shifted along these axes, in both directions and by up to `steps`.
fn with_neighbors(
    topology: &Topology,
    masks: &[LeafMask],
    axes: &[usize],
    steps: usize,
    join: impl Fn(&LeafMask, &LeafMask) -> LeafMask + Sync,
) -> Vec<LeafMask> {
    let joined = |(leaf, mask): (usize, &LeafMask)| {
        let beyond = |face: usize| match topology.neighbors()[leaf][face] {
            NO_LEAF => LeafMask::EMPTY,
            neighbor => masks[neighbor as usize],
        };
        let mut all = *mask;
        for &axis in axes {
            let (before, after) = (beyond(2 * axis), beyond(2 * axis + 1));
            for steps in 1..=steps {
                let [one, other] = mask.shifted(axis, steps, &before, &after);
                all = join(&join(&all, &one), &other);
            }
        }
        all
    };
    masks.par_iter().enumerate().halved().map(joined).collect()
}

#[cfg(test)]
mod tests {
    use glam::IVec3;

    use super::*;

    #[test]
    fn laplacian_rows_include_face_neighbors_of_free_voxels() {
        let corner = IVec3::new(7, 0, 7);
        let topology =
            Topology::new(vec![IVec3::ZERO, IVec3::new(8, 0, 0), IVec3::new(0, -8, 0), IVec3::new(0, 0, 8)]);
        let mut phi = Field::splat(topology.len(), 6.0);
        phi.leaves[topology.find(IVec3::ZERO).unwrap()].values[crate::grid::offset_in_leaf(corner)] = 1.0;
        let band = FreeVoxels::new(&topology, &phi, 3.0);
        assert_eq!(band.free_count(None), 1);
        let rows = |x: i32, y: i32, z: i32| band.laplacian_rows[topology.find(IVec3::new(x, y, z)).unwrap()];
        assert_eq!(rows(0, 0, 0), 1 << 56 | 1 << 57 | 1 << 48);
        assert_eq!(rows(8, 0, 0), 1 << 0);
        assert_eq!(rows(0, -8, 0), 1 << 63);
        assert_eq!(rows(0, 0, 8), 1 << 56);
    }

    /// Number of thick voxels in a block of 4³ leaves whose free voxels are those that satisfy `is_free`.
    fn thick_count(is_free: impl Fn(IVec3) -> bool) -> usize {
        let origins = (0..64).map(|leaf| IVec3::new(leaf >> 4, leaf >> 2 & 3, leaf & 3) * 8).collect();
        let topology = Topology::new(origins);
        let free: Vec<LeafMask> = topology
            .origins()
            .iter()
            .map(|&origin| LeafMask::from_fn(|offset| is_free(origin + crate::grid::voxel_in_leaf(offset))))
            .collect();
        thick(&topology, &free).iter().map(|mask| mask.count() as usize).sum()
    }

    #[test]
    fn single_layer_is_thin_and_double_layer_is_thick() {
        for normal in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [1.0, -2.0, 3.0]] {
            let normal = glam::Vec3::from(normal).normalize();
            let depth = |voxel: IVec3| normal.dot(voxel.as_vec3() - 15.6).abs();
            assert_eq!(thick_count(|voxel| depth(voxel) <= 3.0), 0, "{normal}");
            assert!(thick_count(|voxel| depth(voxel) <= 6.0) > 0, "{normal}");
        }
    }
}
