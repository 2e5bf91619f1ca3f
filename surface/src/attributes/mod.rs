//! Transfers particle attributes to the surface: velocities, colors, ids.
//!
//! ```text
//!            ● vertex                 numbers      the mean of the particles within the radius R, with weights
//!          ╱ │ ╲                                   (1 − r²/R²)³ at the distance r: smooth, and zero from R on
//!      ∙ ∙ ∙ ∙ ∙ ∙  particles         others       the value of the nearest particle; on ties, the first
//!      ∙ ∙ ∙ ∙ ∙ ∙
//!      └──R──┘
//! ```
//!
//! A mean stays within the range of its inputs, exactly: it is clamped to their minimum and maximum. So a
//! constant attribute stays constant.
//!
//! **Radius.** R is 2·r_init: 2 particle spacings by default, and 2.6 with the preset `paper`. There, on a regular lattice of
//! particles, a vertex then has about 20 particles within R, and at least 12. The weights fall to one half at
//! 0.45 R, about 1.2 spacings. So the noise of single particles is smoothed, and a shear across a few
//! particles is preserved. Particles may be larger than r_max (per-particle radii, ellipsoids). If no
//! particle is within R, the point gets the values of the nearest particle whose own r_max, plus a margin,
//! reaches the point. If no particle reaches it, numbers are 0, integers −1, strings missing, and the point
//! is counted.
//!
//! **Rest coordinates** are positions in an earlier frame. Their mean belongs to the mean of the particles' positions,
//! which is about half a spacing deeper in the fluid than the vertex: see `rest`.
//!
//! **Band.** Volume renderers need values in a band around the surface that is several voxels wide. Outside
//! the fluid, a voxel gets the values at the nearest point on the surface, because a point far from all
//! particles has no values of its own. The mean has no voxel-sized detail, so it is computed for every second
//! voxel along each axis, and the voxels in between are interpolated.
//!
//! Invariants: values depend only on the particles within the radius, or on those that reach the point.
//! Changes farther away, and the number of threads, leave the values bit-identical, however large the other
//! particles are.

mod computed;
mod interpolate;
mod rest;
mod velocities;

use std::sync::Arc;

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::cancel::checkpoint;
use crate::grid::{LEAF_VOXELS, NO_LEAF, Topology};
use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::neighbors::Neighbors;
use crate::options::Settings;
use crate::parallel::Loops as _;
use crate::particles::{Attribute, AttributeValues, OwnedPositions, Positions, Role, Shapes, scale_numbers};
use crate::simd::{Kernel, Lanes, dispatch};
use crate::space::Lattice;
use interpolate::{
    Interpolated, NODE_EDGE, Scratch, Tree, TreeParticle, interpolate, near_particles, needed_nodes,
    node_points,
};

use rest::fit_rest;

pub use computed::{ComputedAttribute, add_computed, wants_computed};
pub use rest::has_rest;
pub use velocities::{FoundBy, add_velocities, names_velocity, time_between};

/// The radius R of the weighted mean with these settings, world units.
pub fn radius_world(settings: &Settings) -> f64 {
    RADII * settings.radius_init
}

/// Radius of the weighted mean, in units of r_init.
const RADII: f64 = 2.0;

/// How far particle values reach, in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Support<'a> {
    /// Radius of the weighted mean; weights are zero from here on.
    pub radius_world: f64,
    /// r_max of the settings: the maximum distance of the reconstructed surface from the center of a particle
    /// that is a ball of scale 1.
    pub radius_max_world: f64,
    /// Margin that is added to a particle's own r_max. Points up to the sum away from the particle can get
    /// its values.
    pub margin_world: f64,
    /// The shapes of the particles: one per particle, unless they are balls.
    pub shapes: &'a Shapes,
    /// The positions of the particles before they were smoothed, if they have rest coordinates.
    pub unsmoothed: Option<&'a OwnedPositions>,
}

impl Support<'_> {
    /// Distance up to which a particle is used if none is within the radius. Depends on this particle alone.
    fn limit_world(&self, particle: u32) -> f64 {
        let longest = self.shapes.outer_radius(particle as usize).max(1.0);
        self.radius_max_world * f64::from(longest) + self.margin_world
    }
}

/// How many points got attribute values, and from how near. Many isolated points mean that the surface is far
/// from its particles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[non_exhaustive]
pub struct TransferCounts {
    /// Number of points: vertices, or nodes in the band.
    #[serde(rename = "count")]
    pub point_count: usize,
    /// Points without a particle within the radius, which got the values of the nearest particle that reaches
    /// them.
    #[serde(rename = "isolated")]
    pub isolated_count: usize,
    /// Points that no particle reaches.
    #[serde(rename = "empty")]
    pub empty_count: usize,
    /// Number of ignored values, because they are not finite, over all particles near the surface.
    #[serde(rename = "left_out")]
    pub ignored_value_count: usize,
}

/// The attributes of a mesh's vertices, in the order of the particles' attributes.
///
/// Panics if an attribute does not have `arity` values per particle, or if `support` has too few
/// shapes for them.
pub fn interpolate_to_vertices<'a>(
    particles: impl Into<Positions<'a>>,
    attributes: &[&'a Attribute],
    mesh: &Mesh,
    support: Support<'a>,
) -> (Vec<Attribute>, TransferCounts) {
    let point_of = |vertex: usize| mesh.origin + mesh.positions[vertex].as_dvec3();
    let source = TransferSource::new(
        particles.into(),
        attributes.to_vec(),
        support,
        (mesh.positions.len(), &point_of),
    );
    let (mut interpolated, counts) = interpolate_at(&source, mesh.positions.len(), &point_of);
    fit_rest(&source, &mut interpolated, &point_of);
    let mut numbers = interpolated.numbers.into_iter();
    let mut values_of = |attribute: &Attribute| match &attribute.values {
        AttributeValues::Numbers(_) => AttributeValues::Numbers(numbers.next().unwrap_or_default()),
        AttributeValues::Integers(values) => {
            AttributeValues::Integers(of_nearest(values, attribute.arity, &interpolated.nearest))
        }
        AttributeValues::Strings { table, indices } => {
            let indices = of_nearest(indices, attribute.arity, &interpolated.nearest);
            AttributeValues::Strings { table: table.clone(), indices }
        }
    };
    let transferred = source.attributes.iter().map(|attribute| Attribute {
        name: attribute.name.clone(),
        role: attribute.role,
        arity: attribute.arity,
        values: values_of(attribute),
    });
    (transferred.collect(), counts)
}

/// Index of a missing particle.
const NO_PARTICLE: u32 = u32::MAX;

/// The values of these particles, or −1 if missing.
fn of_nearest<T: Copy + From<i8> + Send + Sync>(values: &[T], arity: usize, nearest: &[u32]) -> Vec<T> {
    let value = |nearest: u32, component: usize| match nearest {
        NO_PARTICLE => T::from(-1),
        _ => values[nearest as usize * arity + component],
    };
    let mut found = vec![T::from(-1); nearest.len() * arity];
    found.par_chunks_mut(arity).zip(nearest).halved().for_each(|(found, &nearest)| {
        for (component, found) in found.iter_mut().enumerate() {
            *found = value(nearest, component);
        }
    });
    found
}

/// Number of points per task. Consecutive points share most of the particles around them.
const CHUNK: usize = 2048;

/// The means at these points, and the particles nearest to them.
fn interpolate_at(
    source: &TransferSource,
    count: usize,
    point_of: &(impl Fn(usize) -> DVec3 + Sync),
) -> (Interpolated, TransferCounts) {
    let chunks: Vec<Interpolated> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .halved()
        .map_init(Scratch::default, |scratch, chunk| {
            checkpoint();
            let vertices = chunk * CHUNK..count.min((chunk + 1) * CHUNK);
            let points: Vec<DVec3> = vertices.map(point_of).collect();
            interpolate(source, &points, scratch)
        })
        .collect();
    let mut interpolated = Interpolated::joined(source, &chunks);
    let mut counts = assign_nearest(source, &mut interpolated, point_of);
    counts.point_count = count;
    counts.ignored_value_count = source.ignored_value_count;
    (interpolated, counts)
}

// The particles near the points that need values, sorted and packed.
//
//   particle    v v v  r g b  a  ○ | …        the values of all numeric attributes of a particle, padded (○)
//               └─ 8 values, a row ─┘         to rows of eight: a row is multiplied by its weight at once
//
// Attributes with values that are not finite are not in the rows: their means have to skip the particles
// with such values.

/// The particles that values are interpolated from.
struct TransferSource<'a> {
    particles: Positions<'a>,
    attributes: Vec<&'a Attribute>,
    support: Support<'a>,
    /// The particles near the points, in cells of size R.
    neighbors: Neighbors,
    /// The indices of the near particles among all particles, in order.
    indices: Vec<u32>,
    /// `row_count` rows per near particle.
    rows: Vec<[f32; 8]>,
    row_count: usize,
    /// The numeric attributes, in order.
    numbers: Vec<NumericAttribute<'a>>,
    ignored_value_count: usize,
}

/// A numeric attribute.
struct NumericAttribute<'a> {
    values: &'a [f32],
    arity: usize,
    /// First column of its values in the rows; `None` if some values are not finite.
    column: Option<usize>,
}

impl<'a> TransferSource<'a> {
    /// Collects the particles near these points.
    fn new(
        particles: Positions<'a>,
        attributes: Vec<&'a Attribute>,
        support: Support<'a>,
        points: (usize, &(impl Fn(usize) -> DVec3 + Sync)),
    ) -> TransferSource<'a> {
        for attribute in &attributes {
            let (found, arity) = (attribute.values.len(), attribute.arity);
            assert!(0 < arity && found == particles.len() * arity, "{found} values of {}", attribute.name);
        }
        let indices = near_particles(&particles, support.radius_world, points);
        let neighbors = Neighbors::new(&subset(&particles, &indices), support.radius_world);
        let mut numbers: Vec<NumericAttribute> =
            attributes.iter().filter_map(|attribute| numbers_of(attribute)).collect();
        let mut ignored_value_count = 0;
        let mut width = 0;
        for numbers in &mut numbers {
            let broken_count = broken_count(numbers, &indices);
            ignored_value_count += broken_count;
            if broken_count == 0 {
                numbers.column = Some(width);
                width += numbers.arity;
            }
        }
        let row_count = width.div_ceil(8);
        let rows = rows_of(&numbers, &indices, row_count);
        TransferSource {
            particles,
            attributes,
            support,
            neighbors,
            indices,
            rows,
            row_count,
            numbers,
            ignored_value_count,
        }
    }

    /// Converts an index among the near particles to the index among all particles.
    fn original(&self, index: u32) -> u32 {
        self.indices.get(index as usize).copied().unwrap_or(NO_PARTICLE)
    }
}

fn subset(particles: &Positions<'_>, indices: &[u32]) -> OwnedPositions {
    match particles {
        Positions::F32(positions) => {
            OwnedPositions::F32(indices.par_iter().halved().map(|&index| positions[index as usize]).collect())
        }
        Positions::F64(positions) => {
            OwnedPositions::F64(indices.par_iter().halved().map(|&index| positions[index as usize]).collect())
        }
    }
}

fn numbers_of(attribute: &Attribute) -> Option<NumericAttribute<'_>> {
    match &attribute.values {
        AttributeValues::Numbers(values) => {
            Some(NumericAttribute { values, arity: attribute.arity, column: None })
        }
        AttributeValues::Integers(_) | AttributeValues::Strings { .. } => None,
    }
}

impl NumericAttribute<'_> {
    /// The values of a particle, given its index among all particles.
    #[inline(always)]
    fn of(&self, particle: u32) -> &[f32] {
        let first = particle as usize * self.arity;
        &self.values[first..first + self.arity]
    }
}

fn broken_count(numbers: &NumericAttribute, indices: &[u32]) -> usize {
    let broken = |&index: &u32| numbers.of(index).iter().filter(|value| !value.is_finite()).count();
    indices.par_iter().halved().map(broken).sum()
}

fn rows_of(numbers: &[NumericAttribute], indices: &[u32], row_count: usize) -> Vec<[f32; 8]> {
    let mut rows = vec![[0.0; 8]; indices.len() * row_count];
    if row_count != 0 {
        rows.par_chunks_mut(row_count).zip(indices).halved().for_each(|(rows, &index)| {
            let row = rows.as_flattened_mut();
            for numbers in numbers {
                if let Some(column) = numbers.column {
                    row[column..column + numbers.arity].copy_from_slice(numbers.of(index));
                }
            }
        });
    }
    rows
}

// Attributes at the voxels of the band, computed on demand.

/// An attribute at the voxels of a band.
#[derive(Clone, Debug)]
pub struct BandAttribute {
    /// Its name in the particle file.
    pub name: String,
    /// Its semantic.
    pub role: Role,
    /// Number of components per voxel.
    pub arity: usize,
    nodes: Arc<Nodes>,
    /// `arity` values per node, node by node.
    values: Vec<f32>,
}

/// The nodes of a band that have values: every second voxel along each axis.
#[derive(Debug)]
struct Nodes {
    topology: Arc<Topology>,
    /// For each leaf, a mask of its nodes that have values.
    needed: Vec<u64>,
    /// For each leaf, the number of nodes with values in all previous leaves.
    starts: Vec<usize>,
}

/// Transfers the numeric attributes of the particles to voxels with |φ| below the half width.
///
/// Panics if an attribute does not have `arity` values per particle, or if `support` has too few
/// shapes for them.
pub fn interpolate_to_band<'a>(
    particles: impl Into<Positions<'a>>,
    attributes: &[&'a Attribute],
    band: &NarrowBand,
    lattice: &Lattice,
    half_width_voxels: f32,
    support: Support<'a>,
) -> (Vec<BandAttribute>, TransferCounts) {
    let is_numbers = |attribute: &&&'a Attribute| matches!(attribute.values, AttributeValues::Numbers(_));
    let attributes: Vec<&'a Attribute> = attributes.iter().filter(is_numbers).copied().collect();
    let needed = needed_nodes(band, half_width_voxels);
    let points = node_points(band, lattice, &needed);
    let point_of = |point: usize| points[point];
    // Unlike vertices, nodes may be about the half width away from the surface.
    let margin_world = support.margin_world + f64::from(half_width_voxels) * lattice.voxel_size;
    let support = Support { margin_world, ..support };
    let source = TransferSource::new(particles.into(), attributes, support, (points.len(), &point_of));
    let (mut interpolated, counts) = interpolate_at(&source, points.len(), &point_of);
    fit_rest(&source, &mut interpolated, &point_of);
    let mut end = 0;
    let starts = needed.iter().map(|nodes| {
        let start = end;
        end += nodes.count_ones() as usize;
        start
    });
    let starts = starts.collect();
    let nodes = Arc::new(Nodes { topology: Arc::clone(&band.topology), needed, starts });
    let found = source.attributes.iter().zip(interpolated.numbers).map(|(attribute, values)| BandAttribute {
        name: attribute.name.clone(),
        role: attribute.role,
        arity: attribute.arity,
        nodes: Arc::clone(&nodes),
        values,
    });
    (found.collect(), counts)
}

impl BandAttribute {
    /// Memory used, in bytes.
    pub fn size_bytes(&self) -> usize {
        size_of_val(&*self.values)
    }

    /// Multiplies all values by a factor.
    pub(crate) fn scale(&mut self, factor: f64) {
        scale_numbers(&mut self.values, factor);
    }

    /// The values of all voxels of a leaf, `arity` each. Values of voxels outside the band are meaningless.
    ///
    /// Panics if the leaf does not exist, or `out` is too short for 512 voxels.
    pub fn fill(&self, leaf: usize, out: &mut [f32]) {
        let around = self.nodes.topology.neighborhood(leaf);
        for component in 0..self.arity {
            let nodes = self.nodes_around(leaf, &around, component);
            let voxels = dispatch(Between { nodes: &nodes });
            let voxels = voxels.as_flattened().as_flattened();
            for (out, &value) in out[..LEAF_VOXELS * self.arity].chunks_exact_mut(self.arity).zip(voxels) {
                out[component] = value;
            }
        }
    }

    /// The values of a leaf's nodes, and of the nodes in the next leaves that its voxels need.
    fn nodes_around(&self, leaf: usize, around: &[u32; 27], component: usize) -> NodeValues {
        let mut nodes = [[[0.0; NODE_EDGE + 1]; NODE_EDGE + 1]; NODE_EDGE + 1];
        for (x, plane) in (0..).zip(&mut nodes) {
            for (y, row) in (0..).zip(plane) {
                for (z, value) in (0..).zip(row) {
                    let node = IVec3::new(x, y, z);
                    // If the band ends with this leaf, the leaf's last nodes replace those of the next leaf.
                    let found = self.value_at(around, node, component).or_else(|| {
                        let last = node.min(IVec3::splat(NODE_EDGE as i32 - 1));
                        self.value_of(leaf, last, component)
                    });
                    *value = found.unwrap_or(0.0);
                }
            }
        }
        nodes
    }

    /// The value of a node in a leaf or in the next one.
    fn value_at(&self, around: &[u32; 27], node: IVec3, component: usize) -> Option<f32> {
        let step: IVec3 = node >> 2;
        match around[(9 * (step.x + 1) + 3 * (step.y + 1) + step.z + 1) as usize] {
            NO_LEAF => None,
            leaf => self.value_of(leaf as usize, node & 3, component),
        }
    }

    fn value_of(&self, leaf: usize, node: IVec3, component: usize) -> Option<f32> {
        let Nodes { needed, starts, .. } = &*self.nodes;
        let bit = node.x << 4 | node.y << 2 | node.z;
        if needed[leaf] >> bit & 1 == 0 {
            return None;
        }
        let before = (needed[leaf] & ((1 << bit) - 1)).count_ones() as usize;
        Some(self.values[(starts[leaf] + before) * self.arity + component])
    }
}

type NodeValues = [[[f32; NODE_EDGE + 1]; NODE_EDGE + 1]; NODE_EDGE + 1];

/// Kernel: interpolates voxels between nodes along z, then y, then x.
struct Between<'a> {
    nodes: &'a NodeValues,
}

impl Kernel for Between<'_> {
    type Output = [[[f32; 8]; 8]; 8];

    #[inline(always)]
    fn run<V: Lanes>(self) -> Self::Output {
        let mut rows = [[[0.0; 8]; NODE_EDGE + 1]; NODE_EDGE + 1];
        for (rows, nodes) in rows.iter_mut().zip(self.nodes) {
            for (row, nodes) in rows.iter_mut().zip(nodes) {
                for z in 0..NODE_EDGE {
                    row[2 * z] = nodes[z];
                    row[2 * z + 1] = 0.5 * nodes[z] + 0.5 * nodes[z + 1];
                }
            }
        }
        let mut planes = [[[0.0; 8]; 8]; NODE_EDGE + 1];
        for (plane, rows) in planes.iter_mut().zip(&rows) {
            for y in 0..NODE_EDGE {
                plane[2 * y] = rows[y];
                plane[2 * y + 1] = between::<V>(&rows[y], &rows[y + 1]);
            }
        }
        let mut voxels = [[[0.0; 8]; 8]; 8];
        for x in 0..NODE_EDGE {
            voxels[2 * x] = planes[x];
            for y in 0..8 {
                voxels[2 * x + 1][y] = between::<V>(&planes[x][y], &planes[x + 1][y]);
            }
        }
        voxels
    }
}

/// The mean of two rows. Adds halves of the values, because their sum might overflow.
#[inline(always)]
fn between<V: Lanes>(one: &[f32; 8], other: &[f32; 8]) -> [f32; 8] {
    let half = V::splat(0.5);
    let mut mean = [0.0; 8];
    V::load(one).mul(half).add(V::load(other).mul(half)).store(&mut mean);
    mean
}

// Assigns values to isolated points, which have no particle within the radius: the values of the nearest
// particle that reaches the point.
//
// Isolated points occur around large particles. Usually they are few; with per-particle radii, they may be
// the whole surface. Only particles that reach farther than the radius can reach an isolated point, so only
// these particles are sorted into a [tree](super::tree). The search for a point then visits a small part of
// them, however far they reach.

/// Assigns the values of the nearest particle to isolated points. Returns the number of points that got
/// values, and the number of points that no particle reaches.
fn assign_nearest(
    source: &TransferSource,
    interpolated: &mut Interpolated,
    point_of: &(impl Fn(usize) -> DVec3 + Sync),
) -> TransferCounts {
    let is_isolated = |point: &usize| interpolated.nearest[*point] == NO_PARTICLE;
    let isolated: Vec<usize> = (0..interpolated.nearest.len()).filter(is_isolated).collect();
    let mut counts = TransferCounts { empty_count: isolated.len(), ..TransferCounts::default() };
    if isolated.is_empty() {
        return counts;
    }
    let particle_at = |particle: u32| TreeParticle {
        position: source.particles.position(particle as usize),
        limit_world: source.support.limit_world(particle),
    };
    let tree = Tree::new(reaching(source, &particle_at), &particle_at);
    let nearest = |&point: &usize| {
        checkpoint();
        tree.nearest(point_of(point), particle_at)
    };
    let nearest: Vec<u32> = isolated.par_iter().halved().map(nearest).collect();
    for (point, particle) in isolated.into_iter().zip(nearest) {
        if particle == NO_PARTICLE {
            continue;
        }
        counts.empty_count -= 1;
        counts.isolated_count += 1;
        interpolated.nearest[point] = particle;
        for (numbers, out) in source.numbers.iter().zip(&mut interpolated.numbers) {
            let out = &mut out[point * numbers.arity..(point + 1) * numbers.arity];
            for (out, &value) in out.iter_mut().zip(numbers.of(particle)) {
                if value.is_finite() {
                    *out = value;
                }
            }
        }
    }
    counts
}

/// The particles that reach farther than the radius.
fn reaching(source: &TransferSource, particle_at: &(impl Fn(u32) -> TreeParticle + Sync)) -> Vec<u32> {
    let end = u32::try_from(source.particles.len()).unwrap_or(NO_PARTICLE);
    let is_reaching = |&particle: &u32| {
        let TreeParticle { position, limit_world } = particle_at(particle);
        source.support.radius_world < limit_world && position.is_finite()
    };
    (0..end).into_par_iter().halved().filter(is_reaching).collect()
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod tests_of_sizes;
