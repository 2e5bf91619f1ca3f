//! Occlusion of the sky, by cone tracing: the fluid is approximated by a fog, whose density is stored in a
//! pyramid of coarse cells.
//!
//! ```text
//!     ·  ╱           Each cell stores the fraction of its volume that is inside the fluid. Twice as
//!      ╱───╮         far away, a cone is twice as wide and samples cells with twice the edge. So a cone
//!    ╱──╮  │         takes few samples, and shadows are soft, without noise.
//!   •───┴──┴──
//! ```
//!
//! This work is based on:
//! Cyril Crassin and others. Interactive indirect illumination using voxel cone tracing. 2011

use glam::{DVec3, I64Vec3, IVec3, Vec3};
use meniscus_surface::grid::{LEAF_EDGE, negative_masks};
use meniscus_surface::level_set::NarrowBand;
use meniscus_surface::space::box_of;
use rayon::prelude::*;

use crate::mesh::RayMesh;
use crate::surface::Ray;

/// The occlusion pyramid.
pub(super) struct Sky {
    /// The first voxel of the first cell.
    origin: DVec3,
    levels: Vec<DensityLevel>,
    /// The edge of the finest cells, in voxels.
    edge: f32,
}

/// Cells of one size.
struct DensityLevel {
    size: IVec3,
    /// The fraction of each cell that is inside; z changes fastest.
    density: Vec<f32>,
}

/// The edge of the finest cells, in voxels: half the edge of a leaf.
const FINEST_EDGE: i32 = 4;

/// Upper limit of the number of finest cells: large frames have larger cells.
const CELLS_MAX: f64 = (1 << 20) as f64;

impl Sky {
    /// A sky without occlusion.
    pub(super) fn empty() -> Sky {
        Sky { origin: DVec3::ZERO, levels: Vec::new(), edge: FINEST_EDGE as f32 }
    }

    pub(super) fn new(band: &NarrowBand) -> Sky {
        let origins = band.topology.origins();
        let leaf_at = |index: usize| [origins[index].as_dvec3(), (origins[index] + LEAF_EDGE).as_dvec3()];
        let Some([least, greatest]) = box_of(origins.len(), leaf_at) else { return Sky::empty() };
        let fill = |finest: &mut DensityLevel, edge| fill(finest, band, least.as_ivec3(), edge);
        Sky::of_box(least, (greatest - least).as_i64vec3(), fill)
    }

    /// The occlusion by a mesh.
    pub(super) fn of_mesh(mesh: &RayMesh) -> Sky {
        let (Some([least, greatest]), Some(bottom)) = (mesh.bounds, mesh.least_z()) else {
            return Sky::empty();
        };
        let extent = (greatest - least).ceil().as_i64vec3().max(I64Vec3::ONE);
        Sky::of_box(least, extent, |finest, edge| {
            fill_columns(finest, mesh, (least, bottom), edge as f64);
        })
    }

    /// The cells of a box that begins at `least`, in voxels. `fill` fills in the finest ones, which have this
    /// edge.
    fn of_box(least: DVec3, extent: I64Vec3, fill: impl FnOnce(&mut DensityLevel, i64)) -> Sky {
        let mut edge = i64::from(FINEST_EDGE);
        let size = |edge: i64| (extent + (edge - 1)) / edge;
        while size(edge).as_dvec3().element_product() > CELLS_MAX {
            edge *= 2;
        }
        let count = size(edge).element_product() as usize;
        let mut finest = DensityLevel { size: size(edge).as_ivec3(), density: vec![0.0; count] };
        fill(&mut finest, edge);
        let mut levels = vec![finest];
        while let Some(level) = levels.last().filter(|level| level.size.max_element() > 1) {
            let coarser = level.coarser();
            levels.push(coarser);
        }
        Sky { origin: least, levels, edge: edge as f32 }
    }

    /// The volume of the inside, in voxels.
    #[cfg(test)]
    pub(super) fn inside_voxels(&self) -> f32 {
        self.levels[0].density.iter().sum::<f32>() * self.edge.powi(3)
    }

    /// The fraction of the light that arrives at a point, in voxels, through a cone along a direction.
    /// `tangent` is the tangent of half the cone's opening angle.
    pub(super) fn transmittance(&self, point: DVec3, direction: Vec3, tangent: f32) -> f32 {
        let Some(coarsest) = self.levels.last() else { return 1.0 };
        let extent = self.edge * (1 << (self.levels.len() - 1)) as f32;
        let reach = 1.8 * extent * coarsest.size.max_element() as f32;
        let start = (point - self.origin).as_vec3() / self.edge;
        let (mut t, mut clear) = (1.2f32, 1f32);
        let reach = reach / self.edge;
        while t < reach && clear > 0.02 {
            let width = (2.0 * t * tangent).max(1.0);
            clear *= 1.0 - self.density(start + direction * t, width.log2());
            t += width;
        }
        clear
    }

    /// The inside fraction around a point, interpolated between the two levels whose cells have about the
    /// edge 2^`power`. Point and edge are in units of the finest cells.
    fn density(&self, point: Vec3, power: f32) -> f32 {
        let power = power.clamp(0.0, (self.levels.len() - 1) as f32);
        let finer = power.floor();
        let at = |level: usize| self.levels[level].at(point / (1 << level) as f32);
        let one = at(finer as usize);
        let part = power - finer;
        if part < 0.05 { one } else { one + (at(finer as usize + 1) - one) * part }
    }
}

impl DensityLevel {
    /// The density at a point, by trilinear interpolation; 0 outside of all cells. The unit is the edge of a
    /// cell.
    fn at(&self, point: Vec3) -> f32 {
        let point = point - 0.5;
        let is_near = point.cmpge(Vec3::NEG_ONE).all() && point.cmple(self.size.as_vec3()).all();
        if !is_near {
            return 0.0;
        }
        let first = floor(point);
        let part = point - first.as_vec3();
        let value = |x: i32, y: i32, z: i32| {
            let cell = first + IVec3::new(x, y, z);
            let is_in = cell.cmpge(IVec3::ZERO).all() && cell.cmplt(self.size).all();
            if is_in { self.density[self.index(cell)] } else { 0.0 }
        };
        let mix = |one: f32, other: f32, part: f32| one + (other - one) * part;
        let along_z = |x, y| mix(value(x, y, 0), value(x, y, 1), part.z);
        let along_y = |x| mix(along_z(x, 0), along_z(x, 1), part.y);
        mix(along_y(0), along_y(1), part.x)
    }

    fn index(&self, cell: IVec3) -> usize {
        ((i64::from(cell.x) * i64::from(self.size.y) + i64::from(cell.y)) * i64::from(self.size.z)
            + i64::from(cell.z)) as usize
    }

    /// Merges eight cells into one.
    fn coarser(&self) -> DensityLevel {
        let size = (self.size + 1) / 2;
        let count = size.as_i64vec3().element_product() as usize;
        let mean = |index: usize| {
            let (z, rest) = (index % size.z as usize, index / size.z as usize);
            let first =
                2 * IVec3::new((rest / size.y as usize) as i32, (rest % size.y as usize) as i32, z as i32);
            let mut sum = 0.0;
            for corner in 0..8 {
                let cell = first + IVec3::new(corner >> 2, corner >> 1 & 1, corner & 1);
                if cell.cmplt(self.size).all() {
                    sum += self.density[self.index(cell)];
                }
            }
            sum / 8.0
        };
        DensityLevel { size, density: (0..count).into_par_iter().map(mean).collect() }
    }
}

/// Rounds down, without a function call per component.
fn floor(point: Vec3) -> IVec3 {
    let toward_zero = point.as_ivec3();
    let above = point.cmplt(toward_zero.as_vec3());
    toward_zero - IVec3::select(above, IVec3::ONE, IVec3::ZERO)
}

/// Fills in the inside fraction of each cell. Ignores outlier leaves, which are outside of all cells.
fn fill(level: &mut DensityLevel, band: &NarrowBand, least: IVec3, edge: i64) {
    let per_voxel = (1.0 / edge as f32).powi(3);
    let negative = negative_masks(&band.phi);
    let extent = level.size.as_i64vec3() * edge;
    let from_least = |origin: IVec3| origin.as_i64vec3() - least.as_i64vec3();
    let mut columns: Vec<(I64Vec3, usize)> = (band.topology.origins().iter().enumerate())
        .map(|(leaf, &origin)| (from_least(origin), leaf))
        .filter(|(first, _)| first.cmpge(I64Vec3::ZERO).all() && first.cmplt(extent).all())
        .collect();
    columns.sort_unstable_by_key(|(first, _)| first.to_array());
    let half = LEAF_EDGE / 2;
    for (index, &(first, leaf)) in columns.iter().enumerate() {
        for octant in 0..8 {
            let offset = half * IVec3::new(octant >> 2, octant >> 1 & 1, octant & 1);
            let count: u32 = (0..half * half)
                .map(|row| {
                    let (x, y) = (offset.x + row / half, offset.y + row % half);
                    ((negative[leaf].row((x * 8 + y) as usize) >> offset.z) & 0xf).count_ones()
                })
                .sum();
            let cell_index = level.index(((first + offset.as_i64vec3()) / edge).as_ivec3());
            level.density[cell_index] += count as f32 * per_voxel;
        }
        // Between two leaves of a column along z, all voxels are inside if the first leaf ends inside.
        let Some(&(next, _)) = columns.get(index + 1) else { continue };
        let is_column = next.truncate() == first.truncate();
        let ends_inside = negative[leaf].rows_with(0x80).count_ones() > 32;
        if is_column && ends_inside {
            let (begin, end) = (first.z + i64::from(LEAF_EDGE), next.z);
            for z in begin / edge..=(end - 1) / edge {
                let count = end.min((z + 1) * edge) - begin.max(z * edge);
                for quarter in 0..4 {
                    let offset = i64::from(half) * I64Vec3::new(quarter >> 1, quarter & 1, 0);
                    let cell = ((first + offset) / edge).with_z(z).as_ivec3();
                    let cell_index = level.index(cell);
                    level.density[cell_index] += (count * i64::from(half * half)) as f32 * per_voxel;
                }
            }
        }
    }
}

/// Fills in the inside fraction of each cell, which has this edge, by rays along z: what a ray enters and
/// leaves is inside. The box begins at `least`, and nothing is below `bottom`. If a ray enters an open mesh
/// and does not leave it, or the other way round, the inside is unknown: its cells count as outside.
fn fill_columns(level: &mut DensityLevel, mesh: &RayMesh, (least, bottom): (DVec3, f64), edge: f64) {
    let [rows, count] = [level.size.y as usize, level.size.z as usize];
    let step = 1.0 / COLUMN_RAYS as f32;
    level.density.par_chunks_mut(count).enumerate().for_each(|(column, cells)| {
        let corner = DVec3::new((column / rows) as f64, (column % rows) as f64, 0.0);
        let below = bottom.min(least.z) - edge;
        // How often a ray has entered before the cell after this one, minus how often it has left.
        let mut steps = vec![0.0; count];
        for ray in 0..COLUMN_RAYS {
            // No two rays share x or y, so that a surface along z covers cells smoothly. Neither is a simple
            // fraction, where a mesh may have edges: a ray through an edge hits two triangles.
            let [x, y] = [ray, 7 * ray % COLUMN_RAYS].map(|at| (at as f64 + 0.43) / COLUMN_RAYS as f64);
            let origin = (least + edge * (corner + DVec3::new(x, y, 0.0))).with_z(below);
            mesh.crossings(&Ray::new(origin, DVec3::Z), |t, is_front| {
                let height = ((below + t - least.z) / edge).clamp(0.0, count as f64);
                let cell = (height as usize).min(count - 1);
                let step = if is_front { step } else { -step };
                cells[cell] += step * (cell as f64 + 1.0 - height) as f32;
                steps[cell] += step;
            });
        }
        let mut inside = 0.0;
        for (cell, step) in cells.iter_mut().zip(steps) {
            *cell = (inside + *cell).abs().min(1.0);
            inside += step;
        }
        if inside != 0.0 {
            cells.fill(0.0);
        }
    });
}

/// Number of rays through a column of cells, a power of two.
const COLUMN_RAYS: usize = 16;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use meniscus_surface::grid::{Field, Topology, voxel_in_leaf};

    use super::*;

    /// The level set of a ball of this radius, in voxels, around the origin.
    fn ball(radius: f32) -> NarrowBand {
        let reach = (radius as i32 + 8) / 8 * 8;
        let mut origins = Vec::new();
        for x in (-reach..=reach).step_by(8) {
            for y in (-reach..=reach).step_by(8) {
                for z in (-reach..=reach).step_by(8) {
                    let distance = (IVec3::new(x, y, z) + 4).as_vec3().length() - radius;
                    if distance.abs() < 14.0 {
                        origins.push(IVec3::new(x, y, z));
                    }
                }
            }
        }
        let topology = Topology::new(origins);
        let mut phi = Field::splat(topology.len(), 0.0);
        for (leaf, origin) in phi.leaves.iter_mut().zip(topology.origins()) {
            for (offset, value) in leaf.values.iter_mut().enumerate() {
                *value = (origin + voxel_in_leaf(offset)).as_vec3().length() - radius;
            }
        }
        NarrowBand { topology: Arc::new(topology), phi, half_width: 8.0 }
    }

    #[test]
    fn cells_hold_the_whole_inside_volume() {
        for radius in [10.0f32, 30.0] {
            let sky = Sky::new(&ball(radius));
            let volume = sky.inside_voxels();
            let expected = 4.0 / 3.0 * std::f32::consts::PI * radius.powi(3);
            assert!((volume / expected - 1.0).abs() < 0.02, "{volume} of {expected}");
            assert!(sky.levels[0].density.iter().all(|&density| (0.0..=1.0).contains(&density)));
        }
    }

    #[test]
    fn ball_occludes_the_light_behind_it() {
        let sky = Sky::new(&ball(20.0));
        let below = DVec3::new(0.0, -30.0, 0.0);
        assert!(sky.transmittance(below, Vec3::Y, 0.1) < 0.05);
        assert!(sky.transmittance(below, Vec3::NEG_Y, 0.1) > 0.99);
        assert!(sky.transmittance(DVec3::new(60.0, 0.0, 0.0), Vec3::Y, 0.1) > 0.99);
        let half = sky.transmittance(DVec3::new(20.0, -30.0, 0.0), Vec3::Y, 0.3);
        assert!((0.1..0.9).contains(&half), "{half} past the edge");
    }

    #[test]
    fn outlier_leaf_does_not_change_the_light() {
        let near = ball(30.0);
        let point = DVec3::new(0.0, -40.0, 0.0);
        for outlier in [IVec3::splat(110_000 * 8), IVec3::splat(-(1 << 30)), IVec3::new(0, 0, (1 << 30) - 8)]
        {
            let mut origins = near.topology.origins().to_vec();
            origins.push(outlier);
            let topology = Topology::new(origins);
            let mut phi = Field::splat(topology.len(), -1.0);
            for (leaf, origin) in phi.leaves.iter_mut().zip(topology.origins()) {
                if let Some(known) = near.topology.find(*origin) {
                    leaf.values = near.phi.leaves[known].values;
                }
            }
            let band = NarrowBand { topology: Arc::new(topology), phi, half_width: 8.0 };
            let [with, without] =
                [&band, &near].map(|band| Sky::new(band).transmittance(point, Vec3::X, 0.5));
            assert!((with - without).abs() < 1e-3, "{with} with an outlier at {outlier}, {without} without");
        }
    }

    /// With two leaves as far apart as possible, neither counts as an outlier: each is half of the scene.
    #[test]
    fn leaves_at_both_ends_of_the_grid_share_one_sky() {
        let origins = [IVec3::splat(-(1 << 30)), IVec3::splat((1 << 30) - 8)];
        let topology = Topology::new(origins.to_vec());
        let phi = Field::splat(2, -1.0);
        let sky = Sky::new(&NarrowBand { topology: Arc::new(topology), phi, half_width: 8.0 });
        assert!(sky.transmittance(DVec3::ZERO, Vec3::X, 0.5) > 0.99);
    }
}
