//! The weighted mean of the particles around a point, and the nearest of them.
//!
//! Points are processed cell by cell: the particles around a cell are gathered once. Their distances from a
//! point are computed eight at a time. The few particles within the radius are collected in a list, and the
//! means are computed from this list.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::{CHUNK, NO_PARTICLE, NumericAttribute, TransferSource};
use crate::cancel::checkpoint;
use crate::grid::{Leaf, NO_LEAF, Topology, neighbor_slot, offset_in_leaf};
use crate::level_set::NarrowBand;
use crate::neighbors::{NeighborPackets, Particle8};
use crate::parallel::Loops as _;
use crate::particles::Positions;
use crate::simd::{Kernel, Lanes, dispatch};
use crate::space::Lattice;

/// The interpolated values at some points.
pub(super) struct Interpolated {
    /// The means of each numeric attribute, point by point.
    pub(super) numbers: Vec<Vec<f32>>,
    /// The nearest particle of each point, or [`NO_PARTICLE`].
    pub(super) nearest: Vec<u32>,
}

/// Memory that is reused between chunks.
#[derive(Default)]
pub(super) struct Scratch {
    points: Vec<CellPoint>,
    around: NeighborPackets,
    near: Vec<WeightedParticle>,
}

/// A point in a cell.
struct CellPoint {
    cell: IVec3,
    /// Position relative to the cell's corner, in units of the radius.
    local: Vec3,
    index: u32,
}

/// A particle within the radius of a point.
#[derive(Clone, Copy)]
struct WeightedParticle {
    /// The squared distance, in units of the squared radius: less than 1. Later replaced by the weight.
    distance_squared: f32,
    /// Index among the near particles of the source.
    particle: u32,
}

/// The means at these points.
pub(super) fn interpolate(source: &TransferSource, points: &[DVec3], scratch: &mut Scratch) -> Interpolated {
    let Scratch { points: located, around, near } = scratch;
    let mut interpolated = Interpolated::empty(source, points.len());
    located.clear();
    located.extend((0u32..).zip(points).filter_map(|(index, &point)| {
        let (cell, local) = source.neighbors.locate(point)?;
        Some(CellPoint { cell, local, index })
    }));
    located.sort_unstable_by_key(|point| (point.cell.to_array(), point.index));
    for group in located.chunk_by(|one, next| one.cell == next.cell) {
        around.gather(&source.neighbors, group[0].cell, usize::MAX);
        dispatch(CellKernel {
            source,
            eights: around.eights(),
            group,
            near,
            interpolated: &mut interpolated,
        });
    }
    interpolated
}

impl Interpolated {
    /// Zeros, and no nearest particle.
    pub(super) fn empty(source: &TransferSource, count: usize) -> Interpolated {
        let numbers = source.numbers.iter().map(|numbers| vec![0.0; count * numbers.arity]).collect();
        Interpolated { numbers, nearest: vec![NO_PARTICLE; count] }
    }

    /// The results of all chunks, in order.
    pub(super) fn joined(source: &TransferSource, chunks: &[Interpolated]) -> Interpolated {
        let joined = |number: usize| {
            let chunks: Vec<&[f32]> = chunks.iter().map(|chunk| &*chunk.numbers[number]).collect();
            chunks.concat()
        };
        let nearest: Vec<&[u32]> = chunks.iter().map(|chunk| &*chunk.nearest).collect();
        Interpolated { numbers: (0..source.numbers.len()).map(joined).collect(), nearest: nearest.concat() }
    }
}

/// Kernel: the points in one cell.
struct CellKernel<'a> {
    source: &'a TransferSource<'a>,
    eights: &'a [Particle8],
    group: &'a [CellPoint],
    near: &'a mut Vec<WeightedParticle>,
    interpolated: &'a mut Interpolated,
}

impl Kernel for CellKernel<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let CellKernel { source, eights, group, near, interpolated } = self;
        for point in group {
            collect_near::<V>(eights, point.local, near);
            if near.is_empty() {
                continue;
            }
            let index = point.index as usize;
            interpolated.nearest[index] = source.original(nearest_of(near));
            // Replaces squared distances by weights.
            for near in near.iter_mut() {
                let rest = 1.0 - near.distance_squared;
                near.distance_squared = rest * rest * rest;
            }
            means::<V>(source, near, index, interpolated);
        }
    }
}

/// Collects the particles within the radius of a point.
#[inline(always)]
fn collect_near<V: Lanes>(eights: &[Particle8], point: Vec3, near: &mut Vec<WeightedParticle>) {
    let [x, y, z] = point.to_array().map(V::splat);
    near.clear();
    for eight in eights {
        let [dx, dy, dz] = [
            V::load(&eight.along[0]).sub(x),
            V::load(&eight.along[1]).sub(y),
            V::load(&eight.along[2]).sub(z),
        ];
        let distance_squared = dx.mul(dx).add(dy.mul(dy)).add(dz.mul(dz));
        let mut bits = V::bits(distance_squared.lt(V::splat(1.0)));
        if bits == 0 {
            continue;
        }
        let mut stored = [0.0; 8];
        distance_squared.store(&mut stored);
        while bits != 0 {
            let k = bits.trailing_zeros() as usize & 7;
            near.push(WeightedParticle { distance_squared: stored[k], particle: eight.indices[k] });
            bits &= bits - 1;
        }
    }
}

/// The nearest particle; on ties, the one with the lowest index.
#[inline(always)]
fn nearest_of(near: &[WeightedParticle]) -> u32 {
    let mut nearest = WeightedParticle { distance_squared: f32::INFINITY, particle: NO_PARTICLE };
    for other in near {
        let is_nearer = other.distance_squared < nearest.distance_squared
            || other.distance_squared == nearest.distance_squared && other.particle < nearest.particle;
        if is_nearer {
            nearest = *other;
        }
    }
    nearest.particle
}

/// The means of all attributes at a point. Squared distances have been replaced by weights.
#[inline(always)]
fn means<V: Lanes>(
    source: &TransferSource,
    near: &[WeightedParticle],
    index: usize,
    interpolated: &mut Interpolated,
) {
    let mut total = 0.0;
    for near in near {
        total += near.distance_squared;
    }
    for row in 0..source.row_count {
        let mean = mean_row::<V>(source, near, row, total);
        for (numbers, out) in source.numbers.iter().zip(&mut interpolated.numbers) {
            let Some(column) = numbers.column else { continue };
            // The columns of the attribute that are in this row.
            let first = column.max(8 * row);
            let end = (column + numbers.arity).min(8 * row + 8);
            for at in first..end {
                out[index * numbers.arity + at - column] = mean[at - 8 * row];
            }
        }
    }
    for (numbers, out) in source.numbers.iter().zip(&mut interpolated.numbers) {
        if numbers.column.is_none() {
            let out = &mut out[index * numbers.arity..(index + 1) * numbers.arity];
            mean_of_sound(source, numbers, near, out);
        }
    }
}

/// The means of a row of eight numbers.
#[inline(always)]
fn mean_row<V: Lanes>(
    source: &TransferSource,
    near: &[WeightedParticle],
    row: usize,
    total: f32,
) -> [f32; 8] {
    let mut sum = V::splat(0.0);
    let (mut least, mut greatest) = (V::splat(f32::INFINITY), V::splat(f32::NEG_INFINITY));
    for near in near {
        let values = V::load(&source.rows[near.particle as usize * source.row_count + row]);
        sum = sum.add(values.mul(V::splat(near.distance_squared)));
        least = least.min(values);
        greatest = greatest.max(values);
    }
    let mut mean = [0.0; 8];
    // If the sum overflows, the result is clamped to the range of the values, like any other result.
    sum.div(V::splat(total)).min(greatest).max(least).store(&mut mean);
    mean
}

/// The mean of an attribute over the particles with finite values. Without such particles, `out` is
/// unchanged.
#[inline(always)]
fn mean_of_sound(
    source: &TransferSource,
    numbers: &NumericAttribute,
    near: &[WeightedParticle],
    out: &mut [f32],
) {
    for (component, out) in out.iter_mut().enumerate() {
        let (mut sum, mut total) = (0.0, 0.0);
        let (mut least, mut greatest) = (f32::INFINITY, f32::NEG_INFINITY);
        for near in near {
            let value = numbers.of(source.original(near.particle))[component];
            if value.is_finite() {
                sum += value * near.distance_squared;
                total += near.distance_squared;
                least = least.min(value);
                greatest = greatest.max(value);
            }
        }
        if total > 0.0 {
            *out = (sum / total).min(greatest).max(least);
        }
    }
}

// The nodes of the band at which means are computed: every second voxel along each axis.
//
//   ● ∙ ● ∙ ● ∙ ● ∙ ┊ ●      ● node. A leaf has 4 nodes along each axis. A voxel between two nodes gets the
//   ∙ ∙ ∙ ∙ ∙ ∙ ∙ ∙ ┊        mean of both, so a leaf also needs the first nodes of the next leaves.
//   ● ∙ ● ∙ ● ∙ ● ∙ ┊ ●

/// Nodes along an edge of a leaf.
pub(super) const NODE_EDGE: usize = 4;

/// For each leaf, a mask of its nodes that any voxel of the band needs: bit `x·16 + y·4 + z`.
pub(super) fn needed_nodes(band: &NarrowBand, half_width_voxels: f32) -> Vec<u64> {
    let leaves = &band.phi.leaves;
    let active: Vec<[u8; 64]> =
        leaves.par_iter().halved().map(|leaf| dispatch(ActiveRows { leaf, half_width_voxels })).collect();
    (0..leaves.len()).into_par_iter().halved().map(|leaf| needed_of(&band.topology, &active, leaf)).collect()
}

/// Kernel: for each row of a leaf, a mask of the voxels in the band.
struct ActiveRows<'a> {
    leaf: &'a Leaf,
    half_width_voxels: f32,
}

impl Kernel for ActiveRows<'_> {
    type Output = [u8; 64];

    #[inline(always)]
    fn run<V: Lanes>(self) -> [u8; 64] {
        let mut rows = [0; 64];
        for (row, bits) in rows.iter_mut().enumerate() {
            *bits = V::bits(V::load(self.leaf.row(row)).abs().lt(V::splat(self.half_width_voxels)));
        }
        rows
    }
}

/// A mask of the needed nodes of a leaf: the nodes with a voxel of the band among the 27 voxels around them.
/// These voxels may be in a previous leaf.
fn needed_of(topology: &Topology, active: &[[u8; 64]], leaf: usize) -> u64 {
    let around = topology.neighborhood(leaf);
    let row = |x: i32, y: i32, leaf_z: i32| match around[neighbor_slot(IVec3::new(x >> 3, y >> 3, leaf_z))] {
        NO_LEAF => 0,
        leaf => active[leaf as usize][((x & 7) << 3 | y & 7) as usize],
    };
    let mut columns = [[0u8; 9]; 9];
    for (x, columns) in (-1..).zip(&mut columns) {
        for (y, column) in (-1..).zip(columns) {
            let here = row(x, y, 0);
            *column = (here | here << 1 | here >> 1 | row(x, y, -1) >> 7) & 0b0101_0101;
        }
    }
    let mut needed = 0;
    for x in 0..NODE_EDGE {
        for y in 0..NODE_EDGE {
            let near = columns[2 * x..2 * x + 3].iter().flat_map(|columns| &columns[2 * y..2 * y + 3]);
            let bits = near.fold(0, |any, column| any | column);
            for z in 0..NODE_EDGE {
                needed |= u64::from(bits >> (2 * z) & 1) << (16 * x + 4 * y + z);
            }
        }
    }
    needed
}

/// World positions of the needed nodes, leaf by leaf. For a node outside the fluid, the nearest point on the
/// surface.
pub(super) fn node_points(band: &NarrowBand, lattice: &Lattice, needed: &[u64]) -> Vec<DVec3> {
    let points = needed.par_iter().enumerate().halved().flat_map_iter(|(leaf, &nodes)| {
        let around = if nodes == 0 { [NO_LEAF; 27] } else { band.topology.neighborhood(leaf) };
        (0..64).filter(move |node| nodes >> node & 1 == 1).map(move |node: i32| {
            let voxel = IVec3::new(node >> 4, node >> 2 & 3, node & 3) * 2;
            let offset_from_surface = offset_from_surface(band, &around, leaf, voxel);
            ((band.topology.origins()[leaf] + voxel).as_dvec3() - offset_from_surface.as_dvec3())
                * lattice.voxel_size
        })
    });
    points.collect()
}

/// The vector from the nearest point on the surface to an outside voxel; zero for an inside voxel.
fn offset_from_surface(band: &NarrowBand, around: &[u32; 27], leaf: usize, voxel: IVec3) -> Vec3 {
    let leaves = &band.phi.leaves;
    let phi = leaves[leaf].values[offset_in_leaf(voxel)];
    if phi <= 0.0 {
        return Vec3::ZERO;
    }
    // The one-sided difference toward the neighbor that is nearer to the surface. Between two surfaces, this
    // picks one of them.
    let slope = |axis: usize| {
        let mut before = voxel;
        before[axis] -= 1;
        let mut after = voxel;
        after[axis] += 1;
        // A node is never the last voxel of a leaf, so the voxel after it is in the same leaf.
        let after = phi - leaves[leaf].values[offset_in_leaf(after)];
        let other = if before[axis] < 0 { around[CENTER - WEIGHTS[axis]] } else { leaf as u32 };
        before[axis] &= 7;
        let before = match other {
            NO_LEAF => 0.0,
            other => phi - leaves[other as usize].values[offset_in_leaf(before)],
        };
        if before > 0.0 && before >= after { before } else { -after.max(0.0) }
    };
    let slope = Vec3::new(slope(0), slope(1), slope(2));
    if slope == Vec3::ZERO { Vec3::ZERO } else { slope.normalize() * phi }
}

/// Slot of a leaf in its own neighborhood, and the strides of the slots along each axis.
const CENTER: usize = 13;
const WEIGHTS: [usize; 3] = [9, 3, 1];

// Finds the particles near the points that need values. Most particles lie deep inside and are not near any
// point.
//
//   ┌───────┬───────┐     The edge of the cells is 2R. The ball of radius R around a point overlaps only the
//   │     ╭─┼─╮     │     eight cells around the cell corner nearest to the point. These cells are marked.
//   ├─────┼─●─┼─────┤     A particle outside of all marked cells is not near any point.
//   │     ╰─┼─╯     │
//   └───────┴───────┘

/// Indices of the particles within `radius_world` of any of the points, in order. Includes some particles
/// that are farther away.
pub(super) fn near_particles(
    particles: &Positions<'_>,
    radius_world: f64,
    (count, point_of): (usize, &(impl Fn(usize) -> DVec3 + Sync)),
) -> Vec<u32> {
    let cells = Lattice { voxel_size: 2.0 * radius_world };
    let marked = marked_cells(&cells, count, point_of);
    let is_near = |index: &u32| {
        let cell = cells.index_from_world(particles.position(*index as usize));
        cell.is_some_and(|cell| marked.contains(&cell.floor().as_ivec3()))
    };
    // 32-bit indices suffice: sources with more particles are read in batches from a file, and have no
    // attributes.
    let end = u32::try_from(particles.len()).unwrap_or(super::NO_PARTICLE);
    (0..end).into_par_iter().halved().filter(is_near).collect()
}

fn marked_cells(
    cells: &Lattice,
    count: usize,
    point_of: &(impl Fn(usize) -> DVec3 + Sync),
) -> FxHashSet<IVec3> {
    let chunks: Vec<FxHashSet<IVec3>> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .halved()
        .map(|chunk| {
            let points = (chunk * CHUNK..count.min((chunk + 1) * CHUNK)).map(point_of);
            let corners = points.filter_map(|point| Some(cells.index_from_world(point)?.round().as_ivec3()));
            corners.collect()
        })
        .collect();
    let corners: FxHashSet<IVec3> = chunks.into_iter().flatten().collect();
    let around =
        |corner: IVec3| (0..8).map(move |bits| corner - IVec3::new(bits & 1, bits >> 1 & 1, bits >> 2 & 1));
    corners.into_iter().flat_map(around).collect()
}

// Finds the nearest particle that reaches a point, with a tree of bounding boxes.
//
//   ┌─────────┬──────┐     Particles are split in half across the longest side of their bounding box,
//   │∙ ∙    ∙ │    ∙ │     recursively, until a box contains few particles.
//   │  ∙   ∙  ├──────┤
//   │     ∙   │ ∙  ∙ │
//   └─────────┴──────┘
//
// A search visits the nearer box first. It skips a box that is farther away than the nearest particle so
// far, or that is so far away that none of its particles reaches the point. So it visits a small part of the
// particles, however far away they are. A grid with a fixed cell size cannot do that: its cells are too
// large for dense clusters or too small for isolated particles.
//
// Invariant: the result is the minimum of (distance², index) over the particles that reach the point,
// computed in 64 bits, whatever the boxes are. So particles that do not reach the point have no influence.

/// A particle as seen by the tree.
#[derive(Clone, Copy)]
pub(super) struct TreeParticle {
    /// Must be finite.
    pub(super) position: DVec3,
    /// The particle reaches points nearer than this.
    pub(super) limit_world: f64,
}

/// A tree of particles.
pub(super) struct Tree {
    /// Indices of the particles; those of a box are contiguous.
    particles: Vec<u32>,
    /// The boxes in preorder: a box is followed by all boxes in its first half, then all boxes in its second
    /// half.
    boxes: Vec<NodeBounds>,
}

/// Bounds over the particles of a box.
#[derive(Clone, Copy)]
struct NodeBounds {
    min: DVec3,
    max: DVec3,
    /// The maximum of `limit_world` over the particles of the box.
    limit_world: f64,
    /// The minimum index of a particle in the box.
    first: u32,
}

/// Maximum number of particles of a box that is not split.
const LEAF_MAX: usize = 16;

impl Tree {
    /// Builds the tree of these particles.
    pub(super) fn new(mut particles: Vec<u32>, particle_at: &(impl Fn(u32) -> TreeParticle + Sync)) -> Tree {
        let mut leaf_count = usize::from(!particles.is_empty());
        while leaf_count * LEAF_MAX < particles.len() {
            leaf_count *= 2;
        }
        let mut boxes = vec![NodeBounds::EMPTY; (2 * leaf_count).saturating_sub(1)];
        halve(&mut boxes, &mut particles, particle_at);
        Tree { particles, boxes }
    }

    /// The nearest particle that reaches a point; on ties, the one with the lowest index. [`NO_PARTICLE`] if
    /// no particle reaches the point.
    pub(super) fn nearest(&self, point: DVec3, particle_at: impl FnMut(u32) -> TreeParticle) -> u32 {
        let mut search = NearestSearch { point, particle_at, nearest: (f64::INFINITY, NO_PARTICLE) };
        if point.is_finite() {
            search.descend(&self.boxes, &self.particles);
        }
        search.nearest.1
    }
}

fn halve(
    boxes: &mut [NodeBounds],
    particles: &mut [u32],
    particle_at: &(impl Fn(u32) -> TreeParticle + Sync),
) {
    checkpoint();
    let Some((bounds, rest)) = boxes.split_first_mut() else { return };
    *bounds = NodeBounds::of(particles, particle_at);
    if rest.is_empty() {
        return;
    }
    let axis = (bounds.max - bounds.min).max_position();
    let along = |particle: &u32| particle_at(*particle).position[axis];
    let middle = particles.len() / 2;
    particles.select_nth_unstable_by(middle, |one, other| along(one).total_cmp(&along(other)));
    let (one, other) = particles.split_at_mut(middle);
    let (boxes_of_one, boxes_of_other) = rest.split_at_mut(rest.len() / 2);
    rayon::join(|| halve(boxes_of_one, one, particle_at), || halve(boxes_of_other, other, particle_at));
}

impl NodeBounds {
    const EMPTY: NodeBounds = NodeBounds {
        min: DVec3::INFINITY,
        max: DVec3::NEG_INFINITY,
        limit_world: f64::NEG_INFINITY,
        first: NO_PARTICLE,
    };

    fn of(particles: &[u32], particle_at: &impl Fn(u32) -> TreeParticle) -> NodeBounds {
        particles.iter().fold(NodeBounds::EMPTY, |bounds, &particle| {
            let TreeParticle { position, limit_world } = particle_at(particle);
            NodeBounds {
                min: bounds.min.min(position),
                max: bounds.max.max(position),
                limit_world: bounds.limit_world.max(limit_world),
                first: bounds.first.min(particle),
            }
        })
    }

    /// A lower bound of (distance², index) for the particles of the box. Rounding is monotone, so no particle
    /// is below this bound by even a bit.
    fn least(&self, point: DVec3) -> (f64, u32) {
        let outside = (self.min - point).max(point - self.max).max(DVec3::ZERO);
        (outside.length_squared(), self.first)
    }
}

/// The search for one point.
struct NearestSearch<F> {
    point: DVec3,
    particle_at: F,
    /// The squared distance and the index of the nearest particle so far.
    nearest: (f64, u32),
}

impl<F: FnMut(u32) -> TreeParticle> NearestSearch<F> {
    /// Searches the box `boxes[0]`. The boxes of its halves follow it, arranged by [`halve`].
    fn descend(&mut self, boxes: &[NodeBounds], particles: &[u32]) {
        let Some((bounds, rest)) = boxes.split_first() else { return };
        if !self.is_nearer(bounds.least(self.point), bounds.limit_world) {
            return;
        }
        if rest.is_empty() {
            particles.iter().for_each(|&particle| self.visit(particle));
            return;
        }
        let (one, other) = particles.split_at(particles.len() / 2);
        let (boxes_of_one, boxes_of_other) = rest.split_at(rest.len() / 2);
        let mut halves = [(boxes_of_one, one), (boxes_of_other, other)];
        if boxes_of_other[0].least(self.point) < boxes_of_one[0].least(self.point) {
            halves.reverse();
        }
        for (boxes, particles) in halves {
            self.descend(boxes, particles);
        }
    }

    fn visit(&mut self, particle: u32) {
        let TreeParticle { position, limit_world } = (self.particle_at)(particle);
        let found = ((position - self.point).length_squared(), particle);
        if self.is_nearer(found, limit_world) {
            self.nearest = found;
        }
    }

    fn is_nearer(&self, found: (f64, u32), limit_world: f64) -> bool {
        found.0 < limit_world * limit_world && found < self.nearest
    }
}
