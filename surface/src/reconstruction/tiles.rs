//! Processes a frame larger than memory in tiles.
//!
//! ```text
//!   ┌────────┬────────┬────────┐      tiles: cubes of leaves on a world-aligned grid
//!   │        │   ┌────┼───┐    │
//!   │        │   │halo│   │    │      one tile and its halo are in memory at a time; the rest is in files
//!   ├────────┼───┼────┼───┼────┤
//!   │        │   │ ▒▒▒▒▒▒ │    │      the result in the tile equals that of the whole frame, because no
//!   │        │   └────┼───┘    │      operation reads beyond the halo
//!   └────────┴────────┴────────┘
//! ```
//!
//! Rasterization visits each tile once. Smoothing visits all tiles for each of its
//! [operations](crate::smooth::SmoothOp). Then φ is loaded and contoured in one piece: it takes a
//! fifth of the memory that smoothing needs.

use std::collections::BTreeMap;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use glam::IVec3;

use crate::grid::{Field, LEAF_EDGE, LEAF_VOXELS, Leaf, Topology};
use crate::level_set::{Bounds, NarrowBand};
use crate::smooth::{
    FieldSet, SmoothConfig, SmoothContext, SmoothOp, SmoothReport, SmoothStats, Workspace, schedule,
};
use crate::space::CoordBox;
use crate::storage::Storage;

/// Number of leaves around a tile that are read with it.
pub(super) const HALO_LEAVES: i32 = 6;

/// A frame's leaves, with the tile and the slot in the field store of each.
pub(super) struct Tiling {
    pub(super) topology: Topology,
    /// Slot of each leaf.
    slots: Vec<u32>,
    /// For each tile, its own leaves and those of its halo, in the order of the topology.
    tiles: Vec<LeafTile>,
}

struct LeafTile {
    /// Leaves of the tile and of its halo.
    leaves: Vec<u32>,
    /// For each of these leaves, true if it is the tile's own.
    own: Vec<bool>,
}

/// Coordinates of the tile that contains a leaf, in units of tiles.
fn tile_of(origin: IVec3, tile_leaves: i32) -> IVec3 {
    origin.div_euclid(IVec3::splat(tile_leaves * LEAF_EDGE))
}

/// The tiles that contain leaves within `margin_leaves` of a leaf.
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
    /// Tiles for the leaves with these origins. Slots are indices into `origins`.
    pub(super) fn new(origins: &[IVec3], tile_leaves: i32, halo_leaves: i32) -> Tiling {
        let topology = Topology::new(origins.to_vec());
        let mut slots = vec![0; topology.len()];
        for (slot, &origin) in origins.iter().enumerate() {
            slots[topology.find(origin).expect("the topology contains every origin")] = slot as u32;
        }
        let mut tiles: BTreeMap<[i32; 3], LeafTile> = BTreeMap::new();
        for (leaf, &origin) in topology.origins().iter().enumerate() {
            let own = tile_of(origin, tile_leaves);
            for tile in tiles_around(origin, halo_leaves, tile_leaves) {
                let empty = || LeafTile { leaves: Vec::new(), own: Vec::new() };
                let entry = tiles.entry(tile.to_array()).or_insert_with(empty);
                entry.leaves.push(leaf as u32);
                entry.own.push(tile == own);
            }
        }
        let tiles = tiles.into_values().filter(|tile| tile.own.contains(&true)).collect();
        Tiling { topology, slots, tiles }
    }

    /// The same leaves and slots with a different halo.
    #[cfg(test)]
    pub(super) fn with_halo(&self, tile_leaves: i32, halo_leaves: i32) -> Tiling {
        let mut origins = vec![IVec3::ZERO; self.slots.len()];
        for (&slot, &origin) in self.slots.iter().zip(self.topology.origins()) {
            origins[slot as usize] = origin;
        }
        Tiling::new(&origins, tile_leaves, halo_leaves)
    }

    /// Number of tiles that own leaves.
    #[cfg(test)]
    pub(super) fn tile_count(&self) -> usize {
        self.tiles.len()
    }

    /// The slots of these leaves, as runs of consecutive slots.
    fn runs(&self, leaves: impl Iterator<Item = u32>) -> Vec<Range<usize>> {
        let mut runs: Vec<Range<usize>> = Vec::new();
        for slot in leaves.map(|leaf| self.slots[leaf as usize] as usize) {
            match runs.last_mut() {
                Some(run) if run.end == slot => run.end += 1,
                _ => runs.push(slot..slot + 1),
            }
        }
        runs
    }

    /// The tile's own leaves, as ranges of `tile.leaves` with consecutive slots; each range with its first
    /// slot.
    fn own_runs(&self, tile: &LeafTile) -> Vec<(Range<usize>, usize)> {
        let mut runs: Vec<(Range<usize>, usize)> = Vec::new();
        for (index, &leaf) in tile.leaves.iter().enumerate().filter(|&(index, _)| tile.own[index]) {
            let slot = self.slots[leaf as usize] as usize;
            match runs.last_mut() {
                Some((run, first)) if run.end == index && *first + run.len() == slot => run.end += 1,
                _ => runs.push((index..index + 1, slot)),
            }
        }
        runs
    }

    /// The slots of all leaves, in the order of the topology.
    pub(super) fn all_slots(&self) -> Vec<Range<usize>> {
        self.runs(0..self.topology.len() as u32)
    }
}

/// Smooths the frame in the field store.
///
/// # Errors
/// Returns an error of the storage. The fields are then invalid.
pub(super) fn smooth(
    store: &mut FieldStore,
    tiling: &Tiling,
    half_width: f32,
    config: &SmoothConfig,
    advanced: &mut dyn FnMut(f64),
) -> io::Result<SmoothReport> {
    let mut report = SmoothReport::new(config);
    let schedule = schedule(config, (HALO_LEAVES * LEAF_EDGE) as u32);
    let step = 1.0 / (schedule.len() * tiling.tiles.len()).max(1) as f64;
    let mut done_count = 0;
    for op in schedule {
        assert!(op.reach_voxels().is_some(), "global operations cannot run in tiles");
        let mut stats = SmoothStats::default();
        for tile in &tiling.tiles {
            stats = stats.merge(apply(store, tiling, tile, half_width, config, op)?);
            done_count += 1;
            advanced(f64::from(done_count) * step);
        }
        store.swap(op.writes());
        report.add(op, stats);
    }
    Ok(report)
}

/// Applies an operation to a tile.
fn apply(
    store: &FieldStore,
    tiling: &Tiling,
    tile: &LeafTile,
    half_width: f32,
    config: &SmoothConfig,
    op: SmoothOp,
) -> io::Result<SmoothStats> {
    let runs = tiling.runs(tile.leaves.iter().copied());
    let origins = tile.leaves.iter().map(|&leaf| tiling.topology.origins()[leaf as usize]).collect();
    let [lower, upper] = store.read_bounds(&runs)?;
    let bounds = Bounds::new(lower, upper);
    let phi = store.read(0, &runs)?;
    let mut band = NarrowBand { topology: Arc::new(Topology::new(origins)), phi, half_width };
    let read = |field: usize| {
        if op.reads()[field] { store.read(field, &runs) } else { Ok(Field::splat(tile.leaves.len(), 0.0)) }
    };
    let mut workspace = Workspace { first: read(1)?, second: read(2)? };
    let own = Some(&tile.own[..]);
    let stats =
        SmoothContext { config, band: &mut band, bounds: &bounds, workspace: &mut workspace, own }.apply(op);
    let fields = [&band.phi, &workspace.first, &workspace.second];
    for (field, values) in fields.into_iter().enumerate().filter(|&(field, _)| op.writes()[field]) {
        for (leaves, slot) in tiling.own_runs(tile) {
            store.write(field, slot, &values.leaves[leaves])?;
        }
    }
    Ok(stats)
}

// Out-of-core fields: φ, its auxiliary fields and its bounds, in files.
//
//   slot        0        1        2        3            a leaf has the same slot in every file
//   φ        [leaf]   [leaf]   [leaf]   [leaf] …        two files: before and after the current operation
//   first    [leaf]   [leaf]   [leaf]   [leaf] …        two files
//   second   [leaf]   [leaf]   [leaf]   [leaf] …        two files
//   lower    [leaf]   [leaf]   [leaf]   [leaf] …        one file
//   upper    [leaf]   [leaf]   [leaf]   [leaf] …        one file
//
// A tile must read the values that its neighbors had before the current operation, in whatever order tiles
// are processed. So the fields that change are double-buffered.

/// The fields of a frame, with one storage for each file in the drawing above.
pub(super) struct FieldStore {
    storages: Vec<Box<dyn Storage>>,
    /// For each changing field, which of its two buffers holds the current values.
    current: [usize; 3],
}

/// Number of storages for the fields of a frame.
const FIELD_STORE_FILES: usize = 8;

/// Indices of the bounds' storages, after two for each changing field.
const LOWER: usize = 6;
const UPPER: usize = 7;

impl FieldStore {
    /// Creates an empty store. `make` makes one file.
    pub(super) fn new(mut make: impl FnMut() -> io::Result<Box<dyn Storage>>) -> io::Result<FieldStore> {
        let storages = (0..FIELD_STORE_FILES).map(|_| make()).collect::<io::Result<_>>()?;
        Ok(FieldStore { storages, current: [0; 3] })
    }

    /// Writes φ and the bounds of consecutive leaves, from slot `first` on.
    pub(super) fn put(&self, first: usize, [phi, lower, upper]: [&Field; 3]) -> io::Result<()> {
        for (file, field) in [(self.current[0], phi), (LOWER, lower), (UPPER, upper)] {
            write_run(&*self.storages[file], first, &field.leaves)?;
        }
        Ok(())
    }

    /// Reads the current values of a changing field in these slots.
    pub(super) fn read(&self, field: usize, slots: &[Range<usize>]) -> io::Result<Field> {
        read_runs(&*self.storages[2 * field + self.current[field]], slots)
    }

    /// Reads the bounds in these slots.
    pub(super) fn read_bounds(&self, slots: &[Range<usize>]) -> io::Result<[Field; 2]> {
        Ok([read_runs(&*self.storages[LOWER], slots)?, read_runs(&*self.storages[UPPER], slots)?])
    }

    /// Writes the next values of a changing field. They become current with [`swap`](FieldStore::swap).
    pub(super) fn write(&self, field: usize, first: usize, leaves: &[Leaf]) -> io::Result<()> {
        write_run(&*self.storages[2 * field + 1 - self.current[field]], first, leaves)
    }

    /// Swaps the buffers of these fields.
    fn swap(&mut self, written: FieldSet) {
        for (current, written) in self.current.iter_mut().zip(written) {
            *current ^= usize::from(written);
        }
    }
}

/// Size of a leaf in storage, in bytes.
const LEAF_BYTES: u64 = (LEAF_VOXELS * size_of::<f32>()) as u64;

fn write_run(storage: &dyn Storage, first: usize, leaves: &[Leaf]) -> io::Result<()> {
    storage.write(first as u64 * LEAF_BYTES, bytemuck::cast_slice(leaves))
}

fn read_runs(storage: &dyn Storage, slots: &[Range<usize>]) -> io::Result<Field> {
    let mut field = Field::splat(slots.iter().map(Range::len).sum(), 0.0);
    let mut rest = &mut field.leaves[..];
    for run in slots {
        let (leaves, after) = std::mem::take(&mut rest).split_at_mut(run.len());
        storage.read(run.start as u64 * LEAF_BYTES, bytemuck::cast_slice_mut(leaves))?;
        rest = after;
    }
    Ok(field)
}
