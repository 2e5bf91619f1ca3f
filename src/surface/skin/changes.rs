//! What neighbours change of the particles of a source: of those near its surface.
//!
//! ```text
//!   batch 0            batch 1           one bit for each particle
//!   · ● ● · · ● · ·    · · ● · ● · · ·   ●: changed
//!     0 1     2            3   4         means, shapes: in the order of the particles
//! ```
//!
//! A frame of hundreds of millions of particles keeps them all at once, beside what it is rasterized into: so they are small.

use std::ops::Range;

use glam::{DVec3, Vec3};

use crate::surface::particles::{Ellipsoid, ParticleSource, Positions, Shapes};

/// Where the mean of a particle's neighbours is, from the particle, in units of R / 32767: a ten-thousandth of the
/// spacing is enough.
type StoredMean = [i16; 3];

/// From units of R, each at most 1 from 0.
fn stored(mean: [f32; 3]) -> StoredMean {
    mean.map(|part| (part * f32::from(i16::MAX)).round() as i16)
}

/// In units of R.
fn mean_of(stored: StoredMean) -> Vec3 {
    Vec3::from(stored.map(f32::from)) / f32::from(i16::MAX)
}

/// A mean as it is used, for one that was computed: both in units of R.
#[cfg(test)]
pub(super) fn rounded(mean: [f32; 3]) -> Vec3 {
    mean_of(stored(mean))
}

/// What neighbours make of the particles of a block.
pub(super) struct Found {
    /// The batch of each, and its place in that.
    sources: Vec<[u32; 2]>,
    /// Empty where none is moved.
    means: Vec<StoredMean>,
    /// Empty where none is stretched.
    shapes: Vec<Ellipsoid>,
}

impl Found {
    /// `sources` has the batch of each particle and its place in that. `means` are those of their neighbours, in units of R, and
    /// `shapes` their own; either is empty where it does not matter. Particles that are neither moved nor stretched are left
    /// out: those of a lattice, behind its outermost layers.
    pub(super) fn new(sources: Vec<[u32; 2]>, means: &[[f32; 3]], shapes: Vec<Ellipsoid>) -> Found {
        let means: Vec<StoredMean> = means.iter().copied().map(stored).collect();
        if !shapes.is_empty() || means.is_empty() {
            return Found { sources, means, shapes };
        }
        let is_moved = |(_, mean): &([u32; 2], StoredMean)| *mean != [0; 3];
        let (sources, means) = sources.into_iter().zip(means).filter(is_moved).unzip();
        Found { sources, means, shapes }
    }
}

/// The memory of a particle that is changed, in bytes: while all are collected, and what is kept.
pub(super) fn changed_bytes(is_moved: bool, is_stretched: bool) -> [f64; 2] {
    let mean = if is_moved { size_of::<StoredMean>() } else { 0 };
    let shape = if is_stretched { size_of::<Ellipsoid>() } else { 0 };
    // A bit of each particle of the frame, of which one in eight is near the surface.
    let kept = (1 + mean + shape) as f64;
    [(size_of::<[u32; 2]>() + mean + shape) as f64 + kept, kept]
}

/// What neighbours change of the particles of a source.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Changes {
    /// How far a mean that is R away moves a particle, world units: λR.
    step_world: f64,
    /// The scale of those that are not stretched and have none of their own; `None` where particles keep their shapes.
    ball: Option<f32>,
    /// Where the words of each batch start in `changed`, and its particles in what follows; one more entry than batches, or none where nothing is
    /// changed.
    starts: Vec<[usize; 2]>,
    /// A bit for each particle of each batch.
    changed: Vec<u64>,
    /// Empty where none is moved.
    means: Vec<StoredMean>,
    /// Empty where none is stretched.
    shapes: Vec<Ellipsoid>,
}

impl Changes {
    /// Puts what was found in blocks in the order of the source. It frees a block once it is in place. `count_of` tells how many particles
    /// a batch has.
    pub(super) fn new(
        found: Vec<Found>,
        (step_world, ball): (f64, Option<f32>),
        batch_count: usize,
        count_of: impl Fn(usize) -> usize,
    ) -> Changes {
        let mut starts = vec![[0; 2]; batch_count + 1];
        for batch in 0..batch_count {
            starts[batch + 1][0] = starts[batch][0] + count_of(batch).div_ceil(64);
        }
        let mut changed = vec![0u64; starts[batch_count][0]];
        let word_of = |[batch, place]: [u32; 2]| starts[batch as usize][0] + place as usize / 64;
        for &source in found.iter().flat_map(|found| &found.sources) {
            changed[word_of(source)] |= 1 << (source[1] % 64);
        }
        let mut count = 0;
        let before: Vec<usize> = changed
            .iter()
            .map(|word| {
                count += word.count_ones() as usize;
                count - word.count_ones() as usize
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
        Changes { step_world, ball, starts, changed, means, shapes }
    }

    /// Whether particles are moved.
    pub(super) fn moves(&self) -> bool {
        self.step_world > 0.0
    }

    /// Whether particles have shapes of their own after this, whatever they had before.
    pub(super) fn stretches(&self) -> bool {
        self.ball.is_some()
    }

    /// The places in a batch of the particles that are changed, and the range of what they are changed to.
    fn of(&self, batch: usize) -> (impl Iterator<Item = usize>, Range<usize>) {
        let (words, range) = match self.starts.get(batch..batch + 2) {
            Some(&[[word, first], [word_end, end]]) => (word..word_end, first..end),
            _ => (0..0, 0..0),
        };
        let bits = |(index, &word): (usize, &u64)| {
            (0..64).filter(move |bit| word >> bit & 1 == 1).map(move |bit| 64 * index + bit)
        };
        (self.changed[words].iter().enumerate().filter(|(_, word)| **word != 0).flat_map(bits), range)
    }

    /// The places in a batch of the particles that are moved, and by how much, world units.
    pub(super) fn moves_of(&self, batch: usize) -> impl Iterator<Item = (usize, DVec3)> {
        let (places, range) = self.of(batch);
        // Empty where none is moved: then there is no place either.
        let means = self.means.get(range).unwrap_or(&[]);
        places.zip(means).map(|(place, mean)| (place, mean_of(*mean).as_dvec3() * self.step_world))
    }

    /// The shapes of a batch, of which so many were given.
    pub(super) fn shapes_of(&self, batch: usize, given: Shapes, count: usize) -> Shapes {
        let Some(ball) = self.ball else { return given };
        let mut shapes = match given {
            Shapes::Balls => vec![Ellipsoid::ball(ball); count],
            Shapes::Scaled(scales) => scales.into_iter().map(Ellipsoid::ball).collect(),
            Shapes::Ellipsoids(ellipsoids) => ellipsoids,
        };
        let (places, range) = self.of(batch);
        for (place, &shape) in places.zip(&self.shapes[range]) {
            shapes[place] = shape;
        }
        Shapes::Ellipsoids(shapes)
    }

    /// Moves the particles of a batch, which are `positions` from `first` on.
    pub(super) fn move_batch(&self, batch: usize, positions: &mut Positions, first: usize) {
        for (place, step) in self.moves_of(batch) {
            match positions {
                Positions::F32(positions) => moved_single(&mut positions.to_mut()[first + place], step),
                Positions::F64(positions) => moved_double(&mut positions.to_mut()[first + place], step),
            }
        }
    }

    /// Changes all particles that were given, which are in memory.
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
            match self.shapes_of(batch, shapes.in_range(range.clone()), range.len()) {
                Shapes::Ellipsoids(ellipsoids) => ellipsoids,
                Shapes::Balls | Shapes::Scaled(_) => Vec::new(),
            }
        };
        let stretched = Shapes::Ellipsoids((0..batch_count).flat_map(of_batch).collect());
        (positions, stretched)
    }

    /// The memory that these take, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        let Changes { starts, changed, means, shapes, .. } = self;
        size_of_val(&**starts) + size_of_val(&**changed) + size_of_val(&**means) + size_of_val(&**shapes)
    }
}

fn moved_single(position: &mut [f32; 3], step: DVec3) {
    *position = (Vec3::from(*position).as_dvec3() + step).as_vec3().to_array();
}

/// Moves a particle by a step, world units.
pub(super) fn moved_double(position: &mut [f64; 3], step: DVec3) {
    *position = (DVec3::from(*position) + step).to_array();
}
