//! Attributes at the voxels of the band, computed on demand.

use std::sync::Arc;

use glam::IVec3;

use super::nodes::{NODE_EDGE, needed_nodes, node_points};
use super::source::TransferSource;
use super::{Support, TransferCounts, interpolate_at};
use crate::grid::{LEAF_VOXELS, NO_LEAF, Topology};
use crate::level_set::NarrowBand;
use crate::particles::{Attribute, AttributeValues, Positions, Role, scale_numbers};
use crate::simd::{Kernel, Lanes, dispatch};
use crate::space::Lattice;

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
    (band, lattice): (&NarrowBand, &Lattice),
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
    let (interpolated, counts) = interpolate_at(&source, points.len(), &point_of);
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
