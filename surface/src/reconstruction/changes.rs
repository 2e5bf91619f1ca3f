//! Stores how a source's particles near the surface are changed by their neighbors.
//!
//! ```text
//!   batch 0            batch 1           one bit per particle
//!   · ● ● · · ● · ·    · · ● · ● · · ·   ●: changed
//!     0 1     2            3   4         means, shapes: in particle order
//! ```
//!
//! All changes of a frame are in memory at once, in addition to the level sets, so they are compact: a frame
//! may have hundreds of millions of particles.

use std::ops::Range;

use glam::{DVec3, Vec3};

use crate::particles::{Ellipsoid, ParticleSource, Positions, Shapes};

/// Mean of the positions of a particle's neighbors, relative to the particle, in units of R / 32767, where R is the
/// neighbor radius. That is
/// about a ten-thousandth of the spacing, which is precise enough.
type StoredMean = [i16; 3];

/// Quantizes a mean in units of R, with components in −1..=1.
fn stored(mean: [f32; 3]) -> StoredMean {
    mean.map(|part| (part * f32::from(i16::MAX)).round() as i16)
}

/// Returns the mean in units of R.
fn mean_of(stored: StoredMean) -> Vec3 {
    Vec3::from(stored.map(f32::from)) / f32::from(i16::MAX)
}

/// Rounds a mean to its stored precision; both in units of R.
#[cfg(test)]
pub(super) fn rounded(mean: [f32; 3]) -> Vec3 {
    mean_of(stored(mean))
}

/// The changed particles of a block.
pub(super) struct BlockChanges {
    /// Batch, and index in the batch, of each particle.
    sources: Vec<[u32; 2]>,
    /// Empty if no particle is moved.
    means: Vec<StoredMean>,
    /// Empty if no particle is stretched.
    shapes: Vec<Ellipsoid>,
}

impl BlockChanges {
    /// `sources` holds the batch, and index in the batch, of each particle. `means` are the mean positions of
    /// their neighbors, in units of R, and `shapes` the new shapes of the particles; either is empty if unused. Drops particles
    /// that are neither moved nor stretched, such as those of a lattice behind its outermost layers.
    pub(super) fn new(sources: Vec<[u32; 2]>, means: &[[f32; 3]], shapes: Vec<Ellipsoid>) -> BlockChanges {
        let means: Vec<StoredMean> = means.iter().copied().map(stored).collect();
        if !shapes.is_empty() || means.is_empty() {
            return BlockChanges { sources, means, shapes };
        }
        let is_moved = |(_, mean): &([u32; 2], StoredMean)| *mean != [0; 3];
        let (sources, means) = sources.into_iter().zip(means).filter(is_moved).unzip();
        BlockChanges { sources, means, shapes }
    }
}

/// Memory per changed particle, in bytes: while all are collected, and afterwards.
pub(super) fn changed_bytes(is_moved: bool, is_stretched: bool) -> [f64; 2] {
    let mean = if is_moved { size_of::<StoredMean>() } else { 0 };
    let shape = if is_stretched { size_of::<Ellipsoid>() } else { 0 };
    // There is one bit for each particle of the frame: one byte per changed particle, if one in eight is
    // changed. While changes are sorted, the counts before each word take as much.
    let kept = (1 + mean + shape) as f64;
    [(size_of::<[u32; 2]>() + mean + shape + 1) as f64 + kept, kept]
}

/// The changes that neighbors make to a source's particles.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct NeighborChanges {
    /// Displacement of a particle if the mean of its neighbors is at distance R, in world units: λR, where λ
    /// is the position smoothing.
    step_world: f64,
    /// Scale of the particles that are not stretched and have no scale in the input; `None` if all particles
    /// keep their given shapes.
    ball_scale: Option<f32>,
    /// For each batch, the start of its words in `changed` and of its particles in `means` and `shapes`; one
    /// entry more than there are batches. Empty if nothing is changed.
    starts: Vec<[usize; 2]>,
    /// One bit for each particle of each batch.
    changed: Vec<u64>,
    /// Empty if no particle is moved.
    means: Vec<StoredMean>,
    /// Empty if no particle is stretched.
    shapes: Vec<Ellipsoid>,
}

impl NeighborChanges {
    /// Sorts the changes of all blocks into source order, and frees each block once it is copied. `count_of`
    /// returns the number of particles of a batch.
    pub(super) fn new(
        found: Vec<BlockChanges>,
        step_world: f64,
        ball_scale: Option<f32>,
        batch_count: usize,
        count_of: impl Fn(usize) -> usize,
    ) -> NeighborChanges {
        let mut starts = vec![[0; 2]; batch_count + 1];
        for batch in 0..batch_count {
            starts[batch + 1][0] = starts[batch][0] + count_of(batch).div_ceil(64);
        }
        let mut changed = vec![0u64; starts[batch_count][0]];
        let word_of = |[batch, index]: [u32; 2]| starts[batch as usize][0] + index as usize / 64;
        for &source in found.iter().flat_map(|found| &found.sources) {
            changed[word_of(source)] |= 1 << (source[1] % 64);
        }
        let mut count = 0;
        let before: Vec<usize> = changed
            .iter()
            .map(|word| {
                let start = count;
                count += word.count_ones() as usize;
                start
            })
            .collect();
        let moves = found.iter().any(|found| !found.means.is_empty());
        let stretches = found.iter().any(|found| !found.shapes.is_empty());
        let mut means = vec![[0; 3]; if moves { count } else { 0 }];
        let mut shapes = vec![Ellipsoid::ball(1.0); if stretches { count } else { 0 }];
        for block in found {
            for (index, &source) in block.sources.iter().enumerate() {
                let word = word_of(source);
                let below = changed[word] & ((1 << (source[1] % 64)) - 1);
                let to = before[word] + below.count_ones() as usize;
                if let Some(&mean) = block.means.get(index) {
                    means[to] = mean;
                }
                if let Some(&shape) = block.shapes.get(index) {
                    shapes[to] = shape;
                }
            }
        }
        for start in &mut starts {
            start[1] = before.get(start[0]).copied().unwrap_or(count);
        }
        NeighborChanges { step_world, ball_scale, starts, changed, means, shapes }
    }

    /// True if particles are moved.
    pub(super) fn moves(&self) -> bool {
        self.step_world > 0.0
    }

    /// True if particles are ellipsoids after the change, whatever they were before.
    pub(super) fn stretches(&self) -> bool {
        self.ball_scale.is_some()
    }

    /// Indices in a batch of its changed particles, and the range of their changes.
    fn changed_in(&self, batch: usize) -> (impl Iterator<Item = usize>, Range<usize>) {
        let (words, range) = match self.starts.get(batch..batch + 2) {
            Some(&[[word, first], [word_end, end]]) => (word..word_end, first..end),
            _ => (0..0, 0..0),
        };
        let bits = |(index, &word): (usize, &u64)| {
            (0..64).filter(move |bit| word >> bit & 1 == 1).map(move |bit| 64 * index + bit)
        };
        (self.changed[words].iter().enumerate().filter(|(_, word)| **word != 0).flat_map(bits), range)
    }

    /// Indices in a batch of its moved particles, with the displacement of each in world units.
    pub(super) fn moves_of(&self, batch: usize) -> impl Iterator<Item = (usize, DVec3)> {
        let (indices, range) = self.changed_in(batch);
        // If no particle is moved, `means` is empty, and so is the result.
        let means = self.means.get(range).unwrap_or(&[]);
        indices.zip(means).map(|(index, mean)| (index, mean_of(*mean).as_dvec3() * self.step_world))
    }

    /// The shapes of a batch of `count` particles after the changes; `given` are those before.
    pub(super) fn shapes_of(&self, batch: usize, given: Shapes, count: usize) -> Shapes {
        let Some(ball_scale) = self.ball_scale else { return given };
        // Those that are stretched by their velocities get the size, weight and room of the ball.
        let keeps_stretch = matches!(given, Shapes::Ellipsoids(_));
        let mut shapes = match given {
            Shapes::Uniform => vec![Ellipsoid::ball(ball_scale); count],
            Shapes::Scaled(scales) => scales.into_iter().map(Ellipsoid::ball).collect(),
            Shapes::Ellipsoids(ellipsoids) => ellipsoids,
        };
        let (indices, range) = self.changed_in(batch);
        // If no particle is stretched, `shapes` is empty.
        for (index, &shape) in indices.zip(self.shapes.get(range).unwrap_or(&[])) {
            shapes[index] = if keeps_stretch {
                let given = shapes[index];
                let factor = shape.longest / given.ball_radius();
                Ellipsoid { weight: shape.weight, room: shape.room, ..given.resized(factor) }
            } else {
                shape
            };
        }
        Shapes::Ellipsoids(shapes)
    }

    /// Moves the particles of a batch, which start at index `first` of `positions`.
    pub(super) fn move_batch(&self, batch: usize, positions: &mut Positions, first: usize) {
        for (index, step) in self.moves_of(batch) {
            match positions {
                Positions::F32(positions) => move_single(&mut positions.to_mut()[first + index], step),
                Positions::F64(positions) => move_double(&mut positions.to_mut()[first + index], step),
            }
        }
    }

    /// Changes all particles of a source that is in memory.
    pub(super) fn apply<'a>(&self, mut positions: Positions<'a>, shapes: Shapes) -> (Positions<'a>, Shapes) {
        let batch_count = positions.batch_count();
        for batch in 0..batch_count {
            let first = positions.range_of(batch).start;
            self.move_batch(batch, &mut positions, first);
        }
        if !self.stretches() {
            return (positions, shapes);
        }
        let of_batch = |batch| {
            let range = positions.range_of(batch);
            match self.shapes_of(batch, shapes.slice(range.clone()), range.len()) {
                Shapes::Ellipsoids(ellipsoids) => ellipsoids,
                Shapes::Uniform | Shapes::Scaled(_) => Vec::new(),
            }
        };
        let stretched = Shapes::Ellipsoids((0..batch_count).flat_map(of_batch).collect());
        (positions, stretched)
    }

    /// Memory used, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        let NeighborChanges { starts, changed, means, shapes, .. } = self;
        size_of_val(&**starts) + size_of_val(&**changed) + size_of_val(&**means) + size_of_val(&**shapes)
    }
}

fn move_single(position: &mut [f32; 3], step: DVec3) {
    *position = (Vec3::from(*position).as_dvec3() + step).as_vec3().to_array();
}

/// Moves a particle by a step, in world units.
pub(super) fn move_double(position: &mut [f64; 3], step: DVec3) {
    *position = (DVec3::from(*position) + step).to_array();
}
