//! Connected components of a set of voxels.
//!
//! ```text
//!   leaf 0    leaf 1         parts: connected within one leaf, found by flood filling with bit shifts
//!   ┌──────┬──────┐
//!   │ aa  b│b     │          parts that touch across a face or an edge of leaves are joined into
//!   │ a    │   cc │          components: {a}, {b, b}, {c}
//!   └──────┴──────┘
//! ```
//!
//! Parts and components are numbered in the topology's order, so the numbers do not depend on the number of
//! threads.

use glam::IVec3;
use rayon::prelude::*;

use crate::grid::{FACE_STEPS, LEAF_EDGE, LeafMask, NO_LEAF, Topology, neighbor_slot, offset_in_leaf};
use crate::parallel::Loops as _;

/// Which voxels are connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Connectivity {
    /// Those that share a face.
    Faces,
    /// Those that share a face or an edge.
    Edges,
}

/// A set of voxels connected within one leaf.
#[derive(Clone, Copy, Debug)]
struct LeafPart {
    mask: LeafMask,
    /// The component it belongs to.
    component: u32,
}

/// The connected components of a set of voxels.
#[derive(Clone, Debug)]
pub(super) struct Components {
    /// Index of each leaf's first part; the last entry is the number of parts.
    starts: Vec<u32>,
    parts: Vec<LeafPart>,
    /// Number of components.
    pub(super) count: usize,
}

impl Components {
    /// The components of a set given as one mask per leaf.
    pub(super) fn new(topology: &Topology, sets: &[LeafMask], connectivity: Connectivity) -> Components {
        let parts: Vec<Vec<LeafMask>> =
            sets.par_iter().halved().map(|set| parts_of(set, connectivity)).collect();
        let mut starts = vec![0];
        for parts in &parts {
            starts.push(starts[starts.len() - 1] + parts.len() as u32);
        }
        let masks: Vec<LeafMask> = parts.into_iter().flatten().collect();
        let contacts = |leaf: usize| contacts_of_leaf(topology, &starts, &masks, leaf, connectivity);
        let contacts: Vec<Vec<[u32; 2]>> =
            (0..topology.len()).into_par_iter().halved().map(contacts).collect();
        let mut parents: Vec<u32> = (0..masks.len() as u32).collect();
        for [one, other] in contacts.into_iter().flatten() {
            join(&mut parents, one, other);
        }
        let (component_of, count) = numbered(&mut parents);
        let parts = masks
            .into_iter()
            .zip(component_of)
            .map(|(mask, component)| LeafPart { mask, component })
            .collect();
        Components { starts, parts, count }
    }

    /// The component of the voxel at `local` in a leaf; `None` if the voxel is not in the set.
    pub(super) fn component_at(&self, leaf: usize, local: IVec3) -> Option<u32> {
        let offset = offset_in_leaf(local);
        self.of_leaf(leaf).find(|(_, mask)| mask.contains(offset)).map(|(component, _)| component)
    }

    /// The components in a leaf, with their voxels there. A component may occur more than once.
    pub(super) fn of_leaf(&self, leaf: usize) -> impl Iterator<Item = (u32, &LeafMask)> {
        let parts = self.starts[leaf] as usize..self.starts[leaf + 1] as usize;
        self.parts[parts].iter().map(|part| (part.component, &part.mask))
    }

    /// The voxels of the selected components, for each leaf that has any.
    pub(super) fn voxels_of(&self, is_wanted: &[bool]) -> Vec<(usize, LeafMask)> {
        let wanted = |leaf: usize| {
            let masks = self.of_leaf(leaf).filter(|(component, _)| is_wanted[*component as usize]);
            let voxels = masks.fold(LeafMask::EMPTY, |voxels, (_, mask)| voxels.or(mask));
            (!voxels.is_empty()).then_some((leaf, voxels))
        };
        (0..self.starts.len() - 1).filter_map(wanted).collect()
    }

    /// Number of stored voxels of each component.
    pub(super) fn volumes(&self) -> Vec<u64> {
        let mut volumes = vec![0; self.count];
        for part in &self.parts {
            volumes[part.component as usize] += u64::from(part.mask.count());
        }
        volumes
    }

    /// Where components touch leaves that are not stored: the component, and the origin of the leaf.
    pub(super) fn beyond(&self, topology: &Topology) -> Vec<(u32, IVec3)> {
        let leaves = topology.origins().par_iter().zip(topology.neighbors()).enumerate();
        let reached = leaves.halved().flat_map_iter(|(leaf, (&origin, neighbors))| {
            let mut reached = Vec::new();
            for (&step, _) in FACE_STEPS.iter().zip(neighbors).filter(|(_, neighbor)| **neighbor == NO_LEAF) {
                for (component, mask) in self.of_leaf(leaf) {
                    if !across(mask, step, Connectivity::Faces).is_empty() {
                        reached.push((component, origin.wrapping_add(step * LEAF_EDGE)));
                    }
                }
            }
            reached
        });
        reached.collect()
    }
}

/// The parts of one leaf, ordered by first voxel.
fn parts_of(set: &LeafMask, connectivity: Connectivity) -> Vec<LeafMask> {
    if *set == LeafMask::FULL {
        return vec![LeafMask::FULL];
    }
    let mut rest = *set;
    let mut parts = Vec::new();
    loop {
        let Some(seed) = rest.iter().next() else { return parts };
        let mut part = LeafMask::EMPTY;
        part.insert(seed);
        loop {
            let grown = dilated(&part, connectivity).and(&rest);
            if grown == part {
                break;
            }
            part = grown;
        }
        rest.remove_all(&part);
        parts.push(part);
    }
}

/// The voxels of a leaf that are in the mask or touch a voxel of it.
fn dilated(mask: &LeafMask, connectivity: Connectivity) -> LeafMask {
    let [x, y, z] = [0, 1, 2].map(|axis| widened(mask, axis));
    match connectivity {
        Connectivity::Faces => x.or(&y).or(&z),
        // The 3×3 squares around each voxel in the planes xy, yz and zx.
        Connectivity::Edges => widened(&x, 1).or(&widened(&y, 2)).or(&widened(&z, 0)),
    }
}

/// The voxels of a leaf that are in the mask or adjacent to it along an axis.
fn widened(mask: &LeafMask, axis: usize) -> LeafMask {
    let [before, after] = mask.shifted(axis, 1, &LeafMask::EMPTY, &LeafMask::EMPTY);
    mask.or(&before).or(&after)
}

/// The voxels of the leaf one `step` away that touch a voxel of `mask`.
pub(super) fn across(mask: &LeafMask, step: IVec3, connectivity: Connectivity) -> LeafMask {
    let none = LeafMask::EMPTY;
    // Along each axis of the step: what the mask moves into an empty leaf after its own, or before it.
    let touched = (0..3).fold(*mask, |touched, axis| match step[axis] {
        1 => none.shifted(axis, 1, &touched, &none)[0],
        -1 => none.shifted(axis, 1, &none, &touched)[1],
        _ => touched,
    });
    let is_face = step.abs().element_sum() == 1;
    if connectivity == Connectivity::Faces || !is_face {
        return touched;
    }
    let other_axes = (0..3).filter(|&axis| step[axis] == 0);
    other_axes.fold(touched, |all, axis| all.or(&widened(&touched, axis)))
}

/// One of each pair of opposite steps from a leaf to the leaves that share a face with it.
const HALF_OF_FACES: [IVec3; 3] = [IVec3::X, IVec3::Y, IVec3::Z];

/// The same for the leaves that share only an edge with it.
const HALF_OF_EDGES: [IVec3; 6] = [
    IVec3::new(1, 1, 0),
    IVec3::new(1, -1, 0),
    IVec3::new(1, 0, 1),
    IVec3::new(1, 0, -1),
    IVec3::new(0, 1, 1),
    IVec3::new(0, 1, -1),
];

/// The pairs of touching parts, one in this leaf and one in a later leaf.
fn contacts_of_leaf(
    topology: &Topology,
    starts: &[u32],
    masks: &[LeafMask],
    leaf: usize,
    connectivity: Connectivity,
) -> Vec<[u32; 2]> {
    let parts = |leaf: usize| starts[leaf]..starts[leaf + 1];
    let mut pairs = Vec::new();
    if parts(leaf).is_empty() {
        return pairs;
    }
    let around = topology.neighborhood(leaf);
    let edges = if connectivity == Connectivity::Edges { &HALF_OF_EDGES[..] } else { &[] };
    for &step in HALF_OF_FACES.iter().chain(edges) {
        let other = around[neighbor_slot(step)];
        if other == NO_LEAF {
            continue;
        }
        for one in parts(leaf) {
            let touched = across(&masks[one as usize], step, connectivity);
            let touching = |other: &u32| !touched.and(&masks[*other as usize]).is_empty();
            pairs.extend(parts(other as usize).filter(touching).map(|other| [one, other]));
        }
    }
    pairs
}

/// Joins the trees of two parts. The smaller root stays the root.
fn join(parents: &mut [u32], one: u32, other: u32) {
    let (one, other) = (find(parents, one), find(parents, other));
    parents[one.max(other) as usize] = one.min(other);
}

/// The root of a part. Compresses the path.
fn find(parents: &mut [u32], part: u32) -> u32 {
    let mut root = part;
    while parents[root as usize] != root {
        let parent = parents[root as usize];
        parents[root as usize] = parents[parent as usize];
        root = parent;
    }
    root
}

/// The component number of each part, and the number of components. Components are numbered in the order of
/// their first parts.
fn numbered(parents: &mut [u32]) -> (Vec<u32>, usize) {
    let mut numbers = vec![0; parents.len()];
    let mut count = 0;
    for part in 0..parents.len() as u32 {
        // A root comes before the other parts of its tree.
        let root = find(parents, part);
        if root == part {
            numbers[part as usize] = count;
            count += 1;
        } else {
            numbers[part as usize] = numbers[root as usize];
        }
    }
    (numbers, count as usize)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::voxel_in_leaf;

    /// The components of scattered voxels by a simple walk from voxel to voxel.
    fn walked(voxels: &[IVec3], steps: &[IVec3]) -> Vec<Vec<IVec3>> {
        let mut rest = voxels.to_vec();
        let mut components = Vec::new();
        while let Some(seed) = rest.pop() {
            let mut component = vec![seed];
            let mut next = 0;
            while next < component.len() {
                for step in steps {
                    if let Some(index) = rest.iter().position(|voxel| *voxel == component[next] + step) {
                        component.push(rest.swap_remove(index));
                    }
                }
                next += 1;
            }
            component.sort_by_key(|voxel| voxel.to_array());
            components.push(component);
        }
        components.sort_by_key(|component| component[0].to_array());
        components
    }

    #[test]
    fn components_match_a_simple_walk() {
        let axis = || [-8, 0];
        let origins = axis().into_iter().flat_map(|x| {
            axis().into_iter().flat_map(move |y| axis().into_iter().map(move |z| IVec3::new(x, y, z)))
        });
        let topology = Topology::new(origins.collect());
        let all = (0..27).map(|slot| IVec3::new(slot / 9, slot / 3 % 3, slot % 3) - 1);
        for (connectivity, reach, of_16) in [(Connectivity::Faces, 1, 4), (Connectivity::Edges, 2, 2)] {
            let is_in = |voxel: IVec3| {
                let mixed = (voxel.x * 73 + voxel.y * 1031 + voxel.z * 40_009) as u32;
                (mixed.wrapping_mul(0x9e37_79b9) >> 7).wrapping_mul(0x85eb_ca6b) >> 28 < of_16
            };
            let set = |&origin: &IVec3| LeafMask::from_fn(|offset| is_in(origin + voxel_in_leaf(offset)));
            let sets: Vec<LeafMask> = topology.origins().iter().map(set).collect();
            let components = Components::new(&topology, &sets, connectivity);
            let mut found = vec![Vec::new(); components.count];
            for (leaf, &origin) in topology.origins().iter().enumerate() {
                for (component, mask) in components.of_leaf(leaf) {
                    let voxels = mask.iter().map(|offset| origin + voxel_in_leaf(offset));
                    found[component as usize].extend(voxels);
                }
            }
            let voxels = found.concat();
            found.iter_mut().for_each(|component| component.sort_by_key(|voxel| voxel.to_array()));
            found.sort_by_key(|component| component[0].to_array());
            let steps = all.clone().filter(|step| (1..=reach).contains(&step.abs().element_sum()));
            assert_eq!(found, walked(&voxels, &steps.collect::<Vec<_>>()), "{connectivity:?}");
            assert!(found.len() > 20 && found.iter().any(|component| component.len() > 8), "{}", found.len());
        }
    }
}
