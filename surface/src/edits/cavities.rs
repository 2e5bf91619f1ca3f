//! Fills bubbles: small enclosed components of the outside.
//!
//! ```text
//!   leaves   [▒▒][▒▒][▒▒]     ▒ stored: a shell around the bubble
//!            [▒▒]    [▒▒]     the missing leaf in the middle is also outside; a search visits missing leaves
//!            [▒▒][▒▒][▒▒]     one by one, up to the volume limit
//! ```
//!
//! The search stops when the component exceeds the volume limit or leaves the bounding box of all leaves. So
//! it takes few steps for a bubble, and for the open outside no more steps than for the largest bubble.
//!
//! A drop within a bubble does not count toward the bubble's volume. If the bubble is filled, the drop merges
//! with its surroundings.

use std::collections::VecDeque;

use glam::IVec3;
use rustc_hash::FxHashSet;

use super::components::{Components, Connectivity};
use super::flip::{FlipSide, flip};
use crate::grid::{FACE_STEPS, LEAF_EDGE, LEAF_VOXELS, LeafMask, Topology, negative_masks};
use crate::level_set::NarrowBand;
use crate::space::CoordBox;

/// Result of filling cavities.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FilledCavities {
    /// Number of cavities.
    pub cavity_count: usize,
    /// Number of voxels that changed from outside to inside.
    pub voxel_count: u64,
}

/// Fills the enclosed components of the outside with fewer than `volume_voxels` voxels.
///
/// `kept` maps a leaf's origin to a mask of its voxels and is called once per leaf. Components with a voxel
/// in such a mask are not filled.
pub fn fill_cavities(
    band: &mut NarrowBand,
    volume_voxels: f64,
    kept: Option<&dyn Fn(IVec3) -> LeafMask>,
) -> FilledCavities {
    let topology = band.topology.clone();
    let complement = |mask: LeafMask| LeafMask { words: mask.words.map(|word| !word) };
    let outside: Vec<LeafMask> = negative_masks(&band.phi).into_iter().map(complement).collect();
    let mut search = CavitySearch::new(&topology, Components::new(&topology, &outside, Connectivity::Edges));
    if let Some(kept) = kept {
        search.keep(kept);
    }
    let mut filled = FilledCavities::default();
    for component in 0..search.components.count as u32 {
        if let Some(volume) = search.enclosed_volume(component, volume_voxels) {
            filled.cavity_count += 1;
            filled.voxel_count += volume;
        }
    }
    let is_filled: Vec<bool> = search.states.iter().map(|state| *state == ComponentState::Enclosed).collect();
    flip(band, &search.components.voxels_of(&is_filled), FlipSide::Inside);
    filled
}

/// State of a component.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ComponentState {
    Unknown,
    /// At least as large as the limit, or connected to the open outside.
    Open,
    /// Enclosed; part of a cavity to be filled.
    Enclosed,
}

/// The components of the outside, and the missing leaves between them.
struct CavitySearch<'a> {
    topology: &'a Topology,
    components: Components,
    volumes: Vec<u64>,
    /// The contacts between components and missing leaves, sorted by component; `by_leaf` has the same
    /// contacts sorted by leaf.
    by_component: Vec<(u32, [i32; 3])>,
    by_leaf: Vec<([i32; 3], u32)>,
    /// Bounding box of all stored leaves.
    extent: CoordBox,
    states: Vec<ComponentState>,
    /// Missing leaves that are connected to the open outside or to a component that is too large.
    open: FxHashSet<IVec3>,
}

impl<'a> CavitySearch<'a> {
    fn new(topology: &'a Topology, components: Components) -> CavitySearch<'a> {
        let beyond = components.beyond(topology);
        let mut by_component: Vec<_> =
            beyond.iter().map(|&(component, leaf)| (component, leaf.to_array())).collect();
        let mut by_leaf: Vec<_> =
            beyond.into_iter().map(|(component, leaf)| (leaf.to_array(), component)).collect();
        by_component.sort_unstable();
        by_component.dedup();
        by_leaf.sort_unstable();
        by_leaf.dedup();
        let mut extent = CoordBox::EMPTY;
        topology.origins().iter().for_each(|&origin| extent.include(origin));
        let (volumes, states) = (components.volumes(), vec![ComponentState::Unknown; components.count]);
        let open = FxHashSet::default();
        CavitySearch { topology, components, volumes, by_component, by_leaf, extent, states, open }
    }

    /// Marks the components with a kept voxel as open.
    fn keep(&mut self, kept: &dyn Fn(IVec3) -> LeafMask) {
        for (leaf, &origin) in self.topology.origins().iter().enumerate() {
            let kept = kept(origin);
            if kept.is_empty() {
                continue;
            }
            for (component, mask) in self.components.of_leaf(leaf) {
                if !mask.and(&kept).is_empty() {
                    self.states[component as usize] = ComponentState::Open;
                }
            }
        }
    }

    /// The volume of the cavity that contains a component, in voxels. `None` if it is at least `volume_max`,
    /// open, or already visited.
    fn enclosed_volume(&mut self, component: u32, volume_max: f64) -> Option<u64> {
        if self.states[component as usize] != ComponentState::Unknown {
            return None;
        }
        let mut walk = CavityWalk { volume: self.volumes[component as usize], ..CavityWalk::default() };
        walk.components.insert(component);
        self.enter(component, &mut walk);
        let mut is_enclosed = (walk.volume as f64) < volume_max;
        while is_enclosed && let Some(leaf) = walk.queue.pop_front() {
            walk.volume += LEAF_VOXELS as u64;
            is_enclosed = self.extent.contains(leaf)
                && !self.open.contains(&leaf)
                && self.pass(leaf, &mut walk)
                && (walk.volume as f64) < volume_max;
        }
        let state = if is_enclosed { ComponentState::Enclosed } else { ComponentState::Open };
        for component in walk.components {
            self.states[component as usize] = state;
        }
        if !is_enclosed {
            self.open.extend(walk.leaves);
        }
        is_enclosed.then_some(walk.volume)
    }

    /// Queues the missing leaves that a component touches.
    fn enter(&self, component: u32, walk: &mut CavityWalk) {
        let first = self.by_component.partition_point(|&(other, _)| other < component);
        for &(_, leaf) in self.by_component[first..].iter().take_while(|&&(other, _)| other == component) {
            walk.reach(IVec3::from(leaf));
        }
    }

    /// Continues the search from a missing leaf. Returns false if the leaf touches a component that is open.
    fn pass(&self, leaf: IVec3, walk: &mut CavityWalk) -> bool {
        for face in FACE_STEPS.map(|step| leaf.wrapping_add(step * LEAF_EDGE)) {
            if self.topology.find(face).is_none() {
                walk.reach(face);
            }
        }
        let key = leaf.to_array();
        let first = self.by_leaf.partition_point(|&(other, _)| other < key);
        for &(_, component) in self.by_leaf[first..].iter().take_while(|&&(other, _)| other == key) {
            if self.states[component as usize] == ComponentState::Open {
                return false;
            }
            if walk.components.insert(component) {
                walk.volume += self.volumes[component as usize];
                self.enter(component, walk);
            }
        }
        true
    }
}

/// A breadth-first search through connected components and leaves.
#[derive(Default)]
struct CavityWalk {
    volume: u64,
    components: FxHashSet<u32>,
    /// Missing leaves: all that were reached, and those still in the queue.
    leaves: FxHashSet<IVec3>,
    queue: VecDeque<IVec3>,
}

impl CavityWalk {
    fn reach(&mut self, leaf: IVec3) {
        if self.leaves.insert(leaf) {
            self.queue.push_back(leaf);
        }
    }
}
