//! Finds the particles near the points that need values. Most particles lie deep inside and are not near any
//! point.
//!
//! ```text
//!   ┌───────┬───────┐     The edge of the cells is 2R. The ball of radius R around a point overlaps only the
//!   │     ╭─┼─╮     │     eight cells around the cell corner nearest to the point. These cells are marked.
//!   ├─────┼─●─┼─────┤     A particle outside of all marked cells is not near any point.
//!   │     ╰─┼─╯     │
//!   └───────┴───────┘
//! ```

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::CHUNK;
use crate::parallel::Loops as _;
use crate::particles::Positions;
use crate::space::Lattice;

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
