//! A frame that is larger than memory, in tiles.
//!
//! ```text
//!   ┌────────┬────────┬────────┐      tiles: cubes of leaves, anchored to the world
//!   │        │   ┌────┼───┐    │
//!   │        │   │halo│   │    │      a tile and its halo are in memory at a time; the others wait on the shelves
//!   ├────────┼───┼────┼───┼────┤
//!   │        │   │ ▒▒▒▒▒▒ │    │      what comes out in the tile itself is what the whole frame would give there:
//!   │        │   └────┼───┘    │      no act reads farther than the halo is wide
//!   └────────┴────────┴────────┘
//! ```
//!
//! Rasterization goes from tile to tile once. Smoothing goes around all tiles for each of its [acts](crate::surface::smooth::Act).
//! Then φ alone, a fifth of what smoothing needs, is taken into memory and contoured whole.

use std::collections::BTreeMap;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use glam::IVec3;

use super::shelves::Shelves;
use crate::surface::grid::{Field, LEAF_EDGE, Topology};
use crate::surface::level_set::{Bounds, NarrowBand};
use crate::surface::smooth::{Act, Config, Memory, SmoothReport, Tally, Work, acts};
use crate::surface::space::CoordBox;

/// Leaves around a tile that are read with it.
pub(super) const HALO_LEAVES: i32 = 6;

/// A frame's leaves, and in which tile and at which place on the shelves each of them is.
pub(super) struct Tiling {
    pub(super) topology: Topology,
    /// For each leaf its place.
    places: Vec<u32>,
    /// For each tile its own leaves, and those of its halo too, both in the order of the topology.
    tiles: Vec<Tile>,
}

struct Tile {
    /// Leaves of the tile and of its halo.
    leaves: Vec<u32>,
    /// For each of them whether it is the tile's own.
    own: Vec<bool>,
}

/// The tile that holds a leaf: its least leaf, in units of tiles.
pub(super) fn tile_of(origin: IVec3, tile_leaves: i32) -> IVec3 {
    origin.div_euclid(IVec3::splat(tile_leaves * LEAF_EDGE))
}

/// The tiles that hold leaves within so many leaves of one.
pub(super) fn tiles_around(
    origin: IVec3,
    margin_leaves: i32,
    tile_leaves: i32,
) -> impl Iterator<Item = IVec3> {
    let margin = IVec3::splat(margin_leaves * LEAF_EDGE);
    let (first, last) = (tile_of(origin - margin, tile_leaves), tile_of(origin + margin, tile_leaves));
    let axis = move |axis: usize| first[axis]..=last[axis];
    axis(0).flat_map(move |x| axis(1).flat_map(move |y| axis(2).map(move |z| IVec3::new(x, y, z))))
}

/// The voxels of a tile.
pub(super) fn tile_voxels(tile: IVec3, tile_leaves: i32) -> CoordBox {
    let min = tile * tile_leaves * LEAF_EDGE;
    CoordBox { min, max: min + IVec3::splat(tile_leaves * LEAF_EDGE - 1) }
}

impl Tiling {
    /// Tiles for the leaves with these origins, whose places are their numbers.
    pub(super) fn new(origins: &[IVec3], tile_leaves: i32, halo_leaves: i32) -> Tiling {
        let topology = Topology::new(origins.to_vec());
        let mut places = vec![0; topology.len()];
        for (place, &origin) in origins.iter().enumerate() {
            places[topology.find(origin).expect("the topology was made of these")] = place as u32;
        }
        let mut tiles: BTreeMap<[i32; 3], Tile> = BTreeMap::new();
        for (leaf, &origin) in topology.origins().iter().enumerate() {
            let own = tile_of(origin, tile_leaves);
            for tile in tiles_around(origin, halo_leaves, tile_leaves) {
                let empty = || Tile { leaves: Vec::new(), own: Vec::new() };
                let entry = tiles.entry(tile.to_array()).or_insert_with(empty);
                entry.leaves.push(leaf as u32);
                entry.own.push(tile == own);
            }
        }
        let tiles = tiles.into_values().filter(|tile| tile.own.contains(&true)).collect();
        Tiling { topology, places, tiles }
    }

    /// The same leaves at the same places, with another halo.
    #[cfg(test)]
    pub(super) fn with_halo(&self, tile_leaves: i32, halo_leaves: i32) -> Tiling {
        let mut origins = vec![IVec3::ZERO; self.places.len()];
        for (&place, &origin) in self.places.iter().zip(self.topology.origins()) {
            origins[place as usize] = origin;
        }
        Tiling::new(&origins, tile_leaves, halo_leaves)
    }

    /// Tiles with leaves of their own.
    #[cfg(test)]
    pub(super) fn tile_count(&self) -> usize {
        self.tiles.len()
    }

    /// The places of these leaves, as runs.
    fn runs(&self, leaves: impl Iterator<Item = u32>) -> Vec<Range<usize>> {
        let mut runs: Vec<Range<usize>> = Vec::new();
        for place in leaves.map(|leaf| self.places[leaf as usize] as usize) {
            match runs.last_mut() {
                Some(run) if run.end == place => run.end += 1,
                _ => runs.push(place..place + 1),
            }
        }
        runs
    }

    /// The tile's own leaves, as runs of leaves of the tile whose places follow one another, with the first of
    /// these.
    fn own_runs(&self, tile: &Tile) -> Vec<(Range<usize>, usize)> {
        let mut runs: Vec<(Range<usize>, usize)> = Vec::new();
        for (index, &leaf) in tile.leaves.iter().enumerate().filter(|&(index, _)| tile.own[index]) {
            let place = self.places[leaf as usize] as usize;
            match runs.last_mut() {
                Some((run, first)) if run.end == index && *first + run.len() == place => run.end += 1,
                _ => runs.push((index..index + 1, place)),
            }
        }
        runs
    }

    /// The places of all leaves, in the order of the topology.
    pub(super) fn all_places(&self) -> Vec<Range<usize>> {
        self.runs(0..self.topology.len() as u32)
    }
}

/// Smooths the frame on the shelves.
///
/// # Errors
/// Those of the storage. The fields are lost then.
pub(super) fn smooth(
    shelves: &mut Shelves,
    tiling: &Tiling,
    half_width: f32,
    config: &Config,
    advanced: &mut dyn FnMut(f64),
) -> io::Result<SmoothReport> {
    let mut report = SmoothReport::new(config);
    let acts = acts(config, (HALO_LEAVES * LEAF_EDGE) as u32);
    let step = 1.0 / (acts.len() * tiling.tiles.len()).max(1) as f64;
    let mut done_count = 0;
    for act in acts {
        assert!(act.reach_voxels().is_some(), "an act that reaches everywhere was to be refused");
        let mut tally = Tally::default();
        for tile in &tiling.tiles {
            tally = tally.and(perform(shelves, tiling, tile, half_width, config, act)?);
            done_count += 1;
            advanced(f64::from(done_count) * step);
        }
        shelves.turn(act.writes());
        report.add(act, tally);
    }
    Ok(report)
}

/// Does an act on a tile.
fn perform(
    shelves: &Shelves,
    tiling: &Tiling,
    tile: &Tile,
    half_width: f32,
    config: &Config,
    act: Act,
) -> io::Result<Tally> {
    let runs = tiling.runs(tile.leaves.iter().copied());
    let origins = tile.leaves.iter().map(|&leaf| tiling.topology.origins()[leaf as usize]).collect();
    let [lower, upper] = shelves.read_bounds(&runs)?;
    let bounds = Bounds { lower, upper };
    let phi = shelves.read(0, &runs)?;
    let mut band = NarrowBand { topology: Arc::new(Topology::new(origins)), phi, half_width };
    let read = |field: usize| match act.reads()[field] {
        true => shelves.read(field, &runs),
        false => Ok(Field::splat(tile.leaves.len(), 0.0)),
    };
    let mut memory = Memory { first: read(1)?, second: read(2)? };
    let own = Some(&tile.own[..]);
    let tally = Work { config, band: &mut band, bounds: &bounds, memory: &mut memory, own }.perform(act);
    let fields = [&band.phi, &memory.first, &memory.second];
    for (field, values) in fields.into_iter().enumerate().filter(|&(field, _)| act.writes()[field]) {
        for (leaves, place) in tiling.own_runs(tile) {
            shelves.write(field, place, &values.leaves[leaves])?;
        }
    }
    Ok(tally)
}
