//! Fills bubbles: small enclosed components of the outside.
//!
//! ```text
//!   leaves   [▒▒][▒▒][▒▒]     ▒ stored: a shell around the bubble
//!            [▒▒]    [▒▒]     the missing leaves in between are also outside; a search visits them one
//!            [▒▒][▒▒][▒▒]     by one until the volume limit
//! ```
//!
//! The search stops when the component exceeds the volume limit or leaves the bounding box of all leaves. So
//! it takes a few steps for a bubble, and for the open outside no more than for the largest bubble.
//!
//! A drop within a bubble does not count toward its volume. If the bubble is filled, the drop merges with its
//! surroundings.

use std::collections::VecDeque;

use glam::IVec3;
use rustc_hash::FxHashSet;

use super::pieces::{Contact, Pieces};
use super::turned::{Side, turn};
use crate::surface::grid::{FACE_STEPS, LEAF_EDGE, LEAF_VOXELS, LeafMask, Topology, negative_masks};
use crate::surface::level_set::NarrowBand;
use crate::surface::space::CoordBox;

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
/// Components with a voxel that is `kept` are not filled. `kept` maps a leaf's origin to the mask of such
/// voxels and is called once per leaf.
pub fn fill_cavities(
    band: &mut NarrowBand,
    volume_voxels: f64,
    kept: Option<&dyn Fn(IVec3) -> LeafMask>,
) -> FilledCavities {
    let topology = band.topology.clone();
    let complement = |mask: LeafMask| LeafMask { words: mask.words.map(|word| !word) };
    let outside: Vec<LeafMask> = negative_masks(&band.phi).into_iter().map(complement).collect();
    let mut surroundings = Surroundings::new(&topology, Pieces::new(&topology, &outside, Contact::Edges));
    if let Some(kept) = kept {
        surroundings.keep(kept);
    }
    let mut filled = FilledCavities::default();
    for piece in 0..surroundings.pieces.count as u32 {
        if let Some(volume) = surroundings.enclosed_volume(piece, volume_voxels) {
            filled.cavity_count += 1;
            filled.voxel_count += volume;
        }
    }
    let is_filled: Vec<bool> =
        surroundings.verdicts.iter().map(|verdict| *verdict == Verdict::Enclosed).collect();
    turn(band, &surroundings.pieces.voxels_of(&is_filled), Side::Inside);
    filled
}

/// State of a component.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    Unknown,
    /// At least as large as the limit, or connected to the open outside.
    Open,
    /// Enclosed; part of a cavity to be filled.
    Enclosed,
}

/// The components of the outside, and the missing leaves between them.
struct Surroundings<'a> {
    topology: &'a Topology,
    pieces: Pieces,
    volumes: Vec<u64>,
    /// All contacts between components and missing leaves, sorted by component and by leaf.
    by_piece: Vec<(u32, [i32; 3])>,
    by_leaf: Vec<([i32; 3], u32)>,
    /// Bounding box of all stored leaves.
    extent: CoordBox,
    verdicts: Vec<Verdict>,
    /// Missing leaves that are connected to the open outside or to a component that is too large.
    open: FxHashSet<IVec3>,
}

impl<'a> Surroundings<'a> {
    fn new(topology: &'a Topology, pieces: Pieces) -> Surroundings<'a> {
        let beyond = pieces.beyond(topology);
        let mut by_piece: Vec<_> = beyond.iter().map(|&(piece, leaf)| (piece, leaf.to_array())).collect();
        let mut by_leaf: Vec<_> = beyond.into_iter().map(|(piece, leaf)| (leaf.to_array(), piece)).collect();
        by_piece.sort_unstable();
        by_piece.dedup();
        by_leaf.sort_unstable();
        by_leaf.dedup();
        let mut extent = CoordBox::EMPTY;
        topology.origins().iter().for_each(|&origin| extent.include(origin));
        let (volumes, verdicts) = (pieces.volumes(), vec![Verdict::Unknown; pieces.count]);
        let open = FxHashSet::default();
        Surroundings { topology, pieces, volumes, by_piece, by_leaf, extent, verdicts, open }
    }

    /// Marks the components with a kept voxel as open.
    fn keep(&mut self, kept: &dyn Fn(IVec3) -> LeafMask) {
        for (leaf, &origin) in self.topology.origins().iter().enumerate() {
            let kept = kept(origin);
            if kept.is_empty() {
                continue;
            }
            for (piece, mask) in self.pieces.of_leaf(leaf) {
                if !mask.and(&kept).is_empty() {
                    self.verdicts[piece as usize] = Verdict::Open;
                }
            }
        }
    }

    /// The volume of the cavity that contains a component, in voxels. `None` if it is at least `volume_most`,
    /// open, or already visited.
    fn enclosed_volume(&mut self, piece: u32, volume_most: f64) -> Option<u64> {
        if self.verdicts[piece as usize] != Verdict::Unknown {
            return None;
        }
        let mut walk = Walk { volume: self.volumes[piece as usize], ..Walk::default() };
        walk.pieces.insert(piece);
        self.enter(piece, &mut walk);
        let mut is_enclosed = (walk.volume as f64) < volume_most;
        while is_enclosed && let Some(leaf) = walk.queue.pop_front() {
            walk.volume += LEAF_VOXELS as u64;
            is_enclosed = self.extent.contains(leaf)
                && !self.open.contains(&leaf)
                && self.pass(leaf, &mut walk)
                && (walk.volume as f64) < volume_most;
        }
        let verdict = if is_enclosed { Verdict::Enclosed } else { Verdict::Open };
        for piece in walk.pieces {
            self.verdicts[piece as usize] = verdict;
        }
        if !is_enclosed {
            self.open.extend(walk.leaves);
        }
        is_enclosed.then_some(walk.volume)
    }

    /// Queues the missing leaves that a component touches.
    fn enter(&self, piece: u32, walk: &mut Walk) {
        let first = self.by_piece.partition_point(|&(other, _)| other < piece);
        for &(_, leaf) in self.by_piece[first..].iter().take_while(|&&(other, _)| other == piece) {
            walk.reach(IVec3::from(leaf));
        }
    }

    /// Continues the search from a missing leaf. Returns false if it is known to be open.
    fn pass(&self, leaf: IVec3, walk: &mut Walk) -> bool {
        for face in FACE_STEPS.map(|step| leaf.wrapping_add(step * LEAF_EDGE)) {
            if self.topology.find(face).is_none() {
                walk.reach(face);
            }
        }
        let key = leaf.to_array();
        let first = self.by_leaf.partition_point(|&(other, _)| other < key);
        for &(_, piece) in self.by_leaf[first..].iter().take_while(|&&(other, _)| other == key) {
            if self.verdicts[piece as usize] == Verdict::Open {
                return false;
            }
            if walk.pieces.insert(piece) {
                walk.volume += self.volumes[piece as usize];
                self.enter(piece, walk);
            }
        }
        true
    }
}

/// A breadth-first search through connected components and leaves.
#[derive(Default)]
struct Walk {
    volume: u64,
    pieces: FxHashSet<u32>,
    /// Missing leaves: all that were reached, and those still in the queue.
    leaves: FxHashSet<IVec3>,
    queue: VecDeque<IVec3>,
}

impl Walk {
    fn reach(&mut self, leaf: IVec3) {
        if self.leaves.insert(leaf) {
            self.queue.push_back(leaf);
        }
    }
}
