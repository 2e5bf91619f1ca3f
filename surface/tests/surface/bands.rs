//! Narrow bands made from formulas.

use std::sync::Arc;

use glam::IVec3;
use meniscus_surface::grid::{Field, LEAF_EDGE, Leaf, Topology, voxel_in_leaf};
use meniscus_surface::level_set::NarrowBand;

/// Half width of the bands in voxels.
const HALF_WIDTH: f32 = 6.0;

/// The band of a function of index space. It has those leaves of the box between two voxels that contain a
/// voxel within the half width. The function gets coordinates in f64, and should be close to a distance.
pub(crate) fn band(min: IVec3, max: IVec3, phi: impl Fn([f64; 3]) -> f64) -> NarrowBand {
    let values = |origin: IVec3| Leaf {
        values: std::array::from_fn(|offset| {
            let voxel = (origin + voxel_in_leaf(offset)).to_array().map(f64::from);
            (phi(voxel) as f32).clamp(-HALF_WIDTH, HALF_WIDTH)
        }),
    };
    let is_near = |origin: &IVec3| values(*origin).values.iter().any(|phi| phi.abs() < HALF_WIDTH);
    let topology = Topology::new(leaf_origins(min, max).filter(is_near).collect());
    let phi = Field { leaves: topology.origins().iter().map(|&origin| values(origin)).collect() };
    NarrowBand { topology: Arc::new(topology), phi, half_width: HALF_WIDTH }
}

/// A block of given values, z fastest, in leaves that are otherwise outside.
pub(crate) fn block_band(min: IVec3, extent: IVec3, values: &[f32]) -> NarrowBand {
    let topology = Topology::new(leaf_origins(min - 3, min + extent + 3).collect());
    let mut phi = Field::splat(topology.len(), 1.0);
    for (index, &value) in values.iter().enumerate() {
        let index = index as i32;
        let (plane, row) = (extent.y * extent.z, extent.z);
        let voxel = min + IVec3::new(index / plane, index / row % extent.y, index % row);
        let (leaf, local) = topology.find_voxel(voxel).expect("the block is stored");
        phi.leaves[leaf].values[meniscus_surface::grid::offset_in_leaf(local)] = value;
    }
    NarrowBand { topology: Arc::new(topology), phi, half_width: HALF_WIDTH }
}

/// A copy of a band, moved by a multiple of 8 voxels.
pub(crate) fn moved(band: &NarrowBand, step: IVec3) -> NarrowBand {
    let topology = Topology::new(band.topology.origins().iter().map(|&origin| origin + step).collect());
    let from = |&origin: &IVec3| band.phi.leaves[band.topology.find(origin - step).expect("was moved")];
    let phi = Field { leaves: topology.origins().iter().map(from).collect() };
    NarrowBand { topology: Arc::new(topology), phi, half_width: band.half_width }
}

fn leaf_origins(min: IVec3, max: IVec3) -> impl Iterator<Item = IVec3> {
    let [first, last]: [IVec3; 2] = [min >> 3, max >> 3];
    (first.x..=last.x).flat_map(move |x| {
        (first.y..=last.y).flat_map(move |y| (first.z..=last.z).map(move |z| IVec3::new(x, y, z) * LEAF_EDGE))
    })
}

/// The signed distance from a sphere.
pub(crate) fn sphere(center: [f64; 3], radius: f64) -> impl Fn([f64; 3]) -> f64 {
    move |[x, y, z]| (x - center[0]).hypot(y - center[1]).hypot(z - center[2]) - radius
}

/// The signed distance from a torus around the z axis.
pub(crate) fn torus(center: [f64; 3], major: f64, minor: f64) -> impl Fn([f64; 3]) -> f64 {
    move |[x, y, z]| ((x - center[0]).hypot(y - center[1]) - major).hypot(z - center[2]) - minor
}
