//! A level set as an obstacle: resampled at the voxels of the reconstruction ("our" voxels).
//!
//! ```text
//!   its voxels   ·   ·   ·   ·          our voxels lie anywhere between its voxels: a value is interpolated
//!   our voxels     x  x  x  x           along the three axes from the eight voxels around it
//! ```
//!
//! The level set has distances only in a band around its surface; beyond the band, its values equal the
//! background. If the band of the reconstruction is wider, distances are extended from the outermost known
//! values. If the level set's band is much narrower than one of our voxels, it has too little information:
//! the surface is then off by a fraction of a voxel.

use std::sync::Arc;

use glam::{DMat3, DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::ObstacleLeaf;
use crate::grid::{LEAF_EDGE, LEAF_VOXELS, Leaf, offset_in_leaf, voxel_in_leaf};
use crate::level_set::{
    NarrowBand, RebuildReason, StoredLevelSet, TooManyLeaves, rebuilding_leaf_count_max,
    rebuilt as rebuilt_band,
};
use crate::space::{INDEX_LIMIT, Lattice};

/// A level set from a file: signed distances in world units, negative inside.
#[derive(Clone, Debug, PartialEq)]
pub struct SourceLevelSet {
    /// Origins of the leaves of 8³ voxels, multiples of 8.
    pub origins: Vec<IVec3>,
    /// The values of each leaf, z fastest.
    pub leaves: Vec<[f32; LEAF_VOXELS]>,
    /// Cubes of voxels with one value: lowest voxel, edge length, value. Edge lengths are powers of two.
    pub tiles: Vec<(IVec3, i32, f32)>,
    /// The value of all other voxels: half the thickness of the band, positive.
    pub background: f32,
    /// Steps from a voxel to the next along each index, world units.
    pub axes: [DVec3; 3],
    /// World position of voxel (0, 0, 0).
    pub translation: DVec3,
}

/// A level set as an obstacle, with hash tables to look up its values.
pub struct GridSdf {
    source: SourceLevelSet,
    leaf_of: FxHashMap<IVec3, u32>,
    tile_of: FxHashMap<(IVec3, i32), f32>,
    tile_sizes: Vec<i32>,
    to_index: DMat3,
    rebuild_reason: Option<RebuildReason>,
}

/// Relative tolerance. Voxels are not cubes if the squared lengths of two axes, or the dot product of two
/// axes and 0, differ by more than this.
const SKEW_MAX: f64 = 1e-4;

/// A distance in our voxels. If it is not known, only its sign is valid.
#[derive(Clone, Copy)]
struct GridSample {
    distance: f32,
    is_known: bool,
}

/// Voxels with known distances.
#[derive(Default)]
struct KnownVoxels {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    distances: Vec<f32>,
}

impl KnownVoxels {
    fn push(&mut self, voxel: IVec3, distance: f32) {
        self.x.push(voxel.x as f32);
        self.y.push(voxel.y as f32);
        self.z.push(voxel.z as f32);
        self.distances.push(distance);
    }

    /// The minimum, over all these voxels, of their distance to the surface plus the distance from `from` to
    /// them; infinite if there are none.
    fn nearest(&self, from: IVec3) -> f32 {
        let from = from.as_vec3();
        let voxels = self.x.iter().zip(&self.y).zip(&self.z).zip(&self.distances);
        voxels.fold(f32::INFINITY, |least, (((x, y), z), distance)| {
            let (x, y, z) = (x - from.x, y - from.y, z - from.z);
            least.min(distance + (x * x + y * y + z * z).sqrt())
        })
    }
}

/// How far around a leaf known values are searched, in voxels.
const EXTENSION_MAX: i32 = 12;

/// Thickness, in voxels, of the layer in which the outermost known values are searched: every path out of the
/// band passes through a voxel of this layer.
const OUTERMOST: f32 = 1.8;

impl SourceLevelSet {
    /// A copy with distances in a band around the surface; `None` if the source already has them.
    fn rebuilt(
        &self,
        voxel_size: f64,
        leaf_count_max: usize,
    ) -> Result<Option<(SourceLevelSet, RebuildReason)>, TooManyLeaves> {
        let SourceLevelSet { origins, leaves, tiles, background, .. } = self;
        let stored = StoredLevelSet { origins, leaves, tiles, background: *background, voxel_size };
        let rebuilt = |(NarrowBand { topology, phi, half_width }, reason): (NarrowBand, RebuildReason)| {
            let scale = voxel_size as f32;
            let background = half_width * scale;
            let source = SourceLevelSet {
                origins: topology.origins().to_vec(),
                leaves: phi.leaves.iter().map(|leaf| leaf.values.map(|value| value * scale)).collect(),
                tiles: tiles
                    .iter()
                    .map(|&(origin, size, value)| (origin, size, background.copysign(value)))
                    .collect(),
                background,
                axes: self.axes,
                translation: self.translation,
            };
            (source, reason)
        };
        Ok(rebuilt_band(&stored, leaf_count_max)?.map(rebuilt))
    }
}

impl GridSdf {
    /// Prepares a level set as an obstacle. If the file lacks distances, rebuilding them may take up to
    /// `memory_bytes` in addition.
    ///
    /// # Errors
    /// The reason, as a sentence without a subject: voxels that are not cubes, a background that is not
    /// positive, or distances that cannot be rebuilt in that memory.
    pub fn new(mut source: SourceLevelSet, memory_bytes: u64) -> Result<GridSdf, String> {
        let [x, y, z] = source.axes;
        let size_squared = x.length_squared();
        let is_even = |squared: f64| (squared - size_squared).abs() <= SKEW_MAX * size_squared;
        let is_square = |product: f64| product.abs() <= SKEW_MAX * size_squared;
        let is_finite = source.translation.is_finite() && size_squared.is_finite() && size_squared > 0.0;
        if !(is_finite && is_even(y.length_squared()) && is_even(z.length_squared())) {
            return Err("has voxels that are not cubes".into());
        }
        if !(is_square(x.dot(y)) && is_square(y.dot(z)) && is_square(z.dot(x))) {
            return Err("has voxels that are not cubes".into());
        }
        if !(source.background.is_finite() && source.background > 0.0) {
            return Err(format!("has the background {}; it must be positive", source.background));
        }
        if source.origins.len() != source.leaves.len() {
            return Err("has leaves without values".into());
        }
        let leaf_count_max = rebuilding_leaf_count_max(memory_bytes);
        let rebuilt = source.rebuilt(size_squared.sqrt(), leaf_count_max).map_err(|TooManyLeaves| {
            format!(
                "has no distances, only signs, and its surface has more than {leaf_count_max} leaves: \
                 allow more memory (--memory), or save it with a narrow band"
            )
        })?;
        let rebuild_reason = rebuilt.as_ref().map(|&(_, reason)| reason);
        source = rebuilt.map_or(source, |(source, _)| source);
        let leaf_of = source.origins.iter().copied().zip(0..).collect();
        let tile_of = source.tiles.iter().map(|&(origin, size, value)| ((origin, size), value)).collect();
        let mut tile_sizes: Vec<i32> = source
            .tiles
            .iter()
            .map(|tile| tile.1)
            .filter(|&size| size > 0 && size & (size - 1) == 0)
            .collect();
        tile_sizes.sort_unstable();
        tile_sizes.dedup();
        let to_index = DMat3::from_cols(x, y, z).inverse();
        Ok(GridSdf { source, leaf_of, tile_of, tile_sizes, to_index, rebuild_reason })
    }

    /// Why its distances were rebuilt; `None` if they were not.
    pub fn rebuild_reason(&self) -> Option<RebuildReason> {
        self.rebuild_reason
    }

    /// The edge length of its voxels, world units.
    pub fn voxel_size(&self) -> f64 {
        self.source.axes[0].length()
    }

    /// How far from the surface its values are known, world units.
    pub fn band_width(&self) -> f64 {
        f64::from(self.source.background)
    }

    /// Samples up to this distance, in world units, are exact; farther samples are interpolated with the
    /// background. If the band is narrower than two voxels, samples up to one voxel from the surface are used
    /// anyway, because the file has no better ones.
    fn known_width(&self) -> f32 {
        let voxel_size = self.voxel_size() as f32;
        (self.source.background - voxel_size).max(voxel_size).min(0.9999 * self.source.background)
    }

    /// A box around all stored values.
    pub(super) fn bounds(&self) -> Option<[DVec3; 2]> {
        let SourceLevelSet { origins, tiles, axes: [x, y, z], translation, .. } = &self.source;
        let leaves = origins.iter().map(|&origin| (origin, LEAF_EDGE));
        let cubes = leaves.chain(tiles.iter().map(|&(origin, size, _)| (origin, size)));
        let corners = cubes.flat_map(|(origin, edge)| {
            (0..8).map(move |corner| {
                let far = IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2) * (edge - 1);
                let [i, j, k] = (origin.as_dvec3() + far.as_dvec3()).to_array();
                i * *x + j * *y + k * *z + *translation
            })
        });
        corners.map(|corner| [corner; 2]).reduce(|[min, max], [one, _]| [min.min(one), max.max(one)])
    }

    /// Its memory, in bytes.
    pub fn size_bytes(&self) -> usize {
        size_of_val(&*self.source.leaves) + 40 * self.source.origins.len() + 60 * self.source.tiles.len()
    }

    /// The signed distances of a leaf.
    pub(super) fn leaf(&self, origin: IVec3, lattice: &Lattice, half_width: f32) -> ObstacleLeaf {
        if let Some(side) = self.side(origin, lattice) {
            return side;
        }
        let mut leaf = Leaf::splat(half_width);
        let mut is_known = true;
        for (offset, value) in leaf.values.iter_mut().enumerate() {
            let sample = self.sample_at(origin + voxel_in_leaf(offset), lattice);
            is_known &= sample.is_known;
            *value = sample.distance.clamp(-half_width, half_width);
        }
        if !is_known {
            self.extend(origin, lattice, half_width, &mut leaf);
        }
        ObstacleLeaf::of_values(Arc::new(leaf), half_width)
    }

    /// The sample at one of our voxels.
    fn sample_at(&self, voxel: IVec3, lattice: &Lattice) -> GridSample {
        let value = self.sample(self.index_of(voxel.as_dvec3(), lattice));
        let distance = (f64::from(value) / lattice.voxel_size) as f32;
        GridSample { distance, is_known: value.abs() < self.known_width() }
    }

    /// Computes the unknown distances of a leaf from known ones around it: the minimum of |φ(y)| + |x − y|
    /// over the outermost known voxels y on the same side.
    fn extend(&self, origin: IVec3, lattice: &Lattice, half_width: f32, leaf: &mut Leaf) {
        let reach = (half_width.ceil() as i32).min(EXTENSION_MAX);
        let outermost = (f64::from(self.known_width()) / lattice.voxel_size) as f32 - OUTERMOST;
        let edge = LEAF_EDGE + 2 * reach;
        let mut sources = [KnownVoxels::default(), KnownVoxels::default()];
        for index in 0..edge * edge * edge {
            let local = IVec3::new(index / (edge * edge), index / edge % edge, index % edge) - reach;
            let sample = self.sample_at(origin + local, lattice);
            if sample.is_known && sample.distance.abs() >= outermost {
                sources[usize::from(sample.distance < 0.0)].push(local, sample.distance.abs());
            }
        }
        for (offset, value) in leaf.values.iter_mut().enumerate() {
            let local = voxel_in_leaf(offset);
            let sample = self.sample_at(origin + local, lattice);
            if !sample.is_known {
                let side = usize::from(sample.distance < 0.0);
                *value = sources[side].nearest(local).min(half_width).copysign(sample.distance);
            }
        }
    }

    /// How deep a point is inside, world units, and the nearest point on the surface. `None` if it is
    /// outside.
    pub(super) fn depth(&self, point: DVec3) -> Option<(f64, DVec3)> {
        let at = |point: DVec3| f64::from(self.sample(self.to_index * (point - self.source.translation)));
        let depth = -at(point);
        let step = 0.5 * self.voxel_size();
        let slope = DVec3::AXES.map(|axis| at(point + axis * step) - at(point - axis * step));
        (depth > 0.0).then(|| (depth, point + DVec3::from(slope).normalize_or_zero() * depth))
    }

    /// Whether the surface may come within `margin_voxels` of a leaf's voxels.
    pub(super) fn touches(&self, origin: IVec3, lattice: &Lattice, margin_voxels: f32) -> bool {
        let (min, max) = self.around(origin, lattice, f64::from(margin_voxels));
        self.has_leaf_between(min, max)
    }

    /// Whether a leaf is inside or outside; `None` if a stored leaf of the level set is near it.
    fn side(&self, origin: IVec3, lattice: &Lattice) -> Option<ObstacleLeaf> {
        let (min, max) = self.around(origin, lattice, 0.0);
        if self.has_leaf_between(min, max) {
            return None;
        }
        // Tiles of both sides meet only where leaves separate them.
        Some(if self.value(min) < 0.0 { ObstacleLeaf::Inside } else { ObstacleLeaf::Outside })
    }

    /// The box of source voxels for the samples of a leaf and `margin` voxels around it.
    fn around(&self, origin: IVec3, lattice: &Lattice, margin: f64) -> (IVec3, IVec3) {
        let half = 0.5 * f64::from(LEAF_EDGE - 1);
        let center = self.index_of(origin.as_dvec3() + half, lattice);
        let scale = lattice.voxel_size / self.voxel_size();
        // Rotated by any angle, a cube stays within the ball around it.
        let reach = DVec3::splat((half + margin) * scale * 3f64.sqrt());
        ((center - reach).floor().as_ivec3(), (center + reach).ceil().as_ivec3())
    }

    /// Whether a leaf in a box of voxels is stored.
    fn has_leaf_between(&self, min: IVec3, max: IVec3) -> bool {
        let edge = IVec3::splat(LEAF_EDGE);
        let (first, last) = (min.div_euclid(edge), max.div_euclid(edge));
        let is_between = |origin: &IVec3| {
            let leaf = origin.div_euclid(edge);
            leaf.cmpge(first).all() && leaf.cmple(last).all()
        };
        // If the source's voxels are much smaller than ours, the box spans more leaves than are stored.
        let spans = last.as_dvec3() - first.as_dvec3() + 1.0;
        if spans.element_product() > self.source.origins.len() as f64 {
            return self.source.origins.iter().any(is_between);
        }
        (first.x..=last.x).any(|x| {
            (first.y..=last.y)
                .any(|y| (first.z..=last.z).any(|z| self.leaf_of.contains_key(&(IVec3::new(x, y, z) * edge))))
        })
    }

    fn index_of(&self, voxel: DVec3, lattice: &Lattice) -> DVec3 {
        self.to_index * (voxel * lattice.voxel_size - self.source.translation)
    }

    /// The value at a position in index space, interpolated between voxels.
    fn sample(&self, at: DVec3) -> f32 {
        let low = at.floor();
        // A NaN index is outside the grid.
        let is_near = low.abs().max_element() < f64::from(INDEX_LIMIT);
        if !is_near {
            return self.source.background;
        }
        let [x, y, z] = (at - low).as_vec3().to_array();
        let low = low.as_ivec3();
        let corner = |dx: i32, dy: i32, dz: i32| self.value(low + IVec3::new(dx, dy, dz));
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let along_z = |dx, dy| mix(corner(dx, dy, 0), corner(dx, dy, 1), z);
        let along_y = |dx| mix(along_z(dx, 0), along_z(dx, 1), y);
        mix(along_y(0), along_y(1), x)
    }

    /// The value of a voxel.
    fn value(&self, voxel: IVec3) -> f32 {
        let local = voxel & (LEAF_EDGE - 1);
        if let Some(&leaf) = self.leaf_of.get(&(voxel - local)) {
            let value = self.source.leaves[leaf as usize][offset_in_leaf(local)];
            // A NaN value counts as background.
            return if value.is_nan() { self.source.background } else { value };
        }
        let of_size = |&size: &i32| self.tile_of.get(&(voxel & -size, size)).copied();
        self.tile_sizes.iter().find_map(of_size).unwrap_or(self.source.background)
    }
}
