//! Finds pieces with few particles.
//!
//! A particle with N − 1 linked ones is in a large piece. That is true of nearly all particles, and each is decided
//! alone, in parallel. From the others, a search goes from particle to particle, until it reaches such a particle, has
//! found N, or finds no more. So no search is longer than N steps, except where it follows particles of large pieces.

use rayon::prelude::*;

use crate::cancel::checkpoint;
use crate::neighbors::Neighbors;
use crate::parallel::Loops as _;
use crate::particles::{OwnedPositions, rows};

/// How far particles are linked.
#[derive(Clone, Debug, PartialEq)]
pub struct Links {
    /// r_init of a particle of scale 1, world units.
    pub radius_world: f64,
    /// The scale of each particle; `None` if all are 1.
    pub scales: Option<Vec<f32>>,
}

impl Links {
    /// Those of the particles for which `mask` is true.
    pub(super) fn of_rows(&self, mask: &[bool]) -> Links {
        Links { scales: self.scales.as_ref().map(|scales| rows(scales, 1, mask)), ..*self }
    }

    fn scale(&self, particle: u32) -> f32 {
        self.scales.as_ref().map_or(1.0, |scales| scales[particle as usize])
    }
}

/// A piece of fluid.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Piece {
    /// Its particles, in order.
    pub members: Vec<u32>,
}

/// The pieces with fewer than `count_min` particles, by their first particle. A particle whose position is not finite
/// is in none.
pub fn small_pieces(positions: &OwnedPositions, links: &Links, count_min: u32) -> Vec<Piece> {
    let count_min = count_min as usize;
    if positions.is_empty() || count_min < 2 {
        return Vec::new();
    }
    let linked = LinkedParticles::new(positions, links);
    let mut search = PieceSearch::new(&linked, count_min);
    let mut pieces: Vec<Piece> = (0..linked.len()).filter_map(|slot| search.piece_from(slot)).collect();
    pieces.sort_unstable_by_key(|piece| piece.members[0]);
    pieces
}

/// Particles sorted so that the linked ones are found.
struct LinkedParticles<'a> {
    positions: &'a OwnedPositions,
    links: &'a Links,
    neighbors: Neighbors,
    /// r_init of a particle of scale 1 in cell edges, and the scale of each particle in the sorted order.
    reach: f32,
    scales: Option<Vec<f32>>,
}

impl<'a> LinkedParticles<'a> {
    fn new(positions: &'a OwnedPositions, links: &'a Links) -> LinkedParticles<'a> {
        let largest = links.scales.iter().flatten().copied().fold(0.0, f32::max);
        let largest = if links.scales.is_some() { f64::from(largest) } else { 1.0 };
        let neighbors = Neighbors::new(positions, 2.0 * links.radius_world * largest);
        let scales = links
            .scales
            .is_some()
            .then(|| neighbors.indices().iter().map(|&particle| links.scale(particle)).collect());
        LinkedParticles { positions, links, reach: (0.5 / largest) as f32, neighbors, scales }
    }

    fn len(&self) -> usize {
        self.neighbors.indices().len()
    }

    /// Calls `visit` for each particle that is linked to this one in the sorted order, until it returns false.
    fn visit_linked(&self, slot: usize, mut visit: impl FnMut(usize) -> bool) {
        let cell = self.neighbors.cells()[self.neighbors.cell_at(slot)];
        let [x, y, z] = self.neighbors.locals();
        let here = [x[slot], y[slot], z[slot]];
        let radius = |slot: usize| self.reach * self.scales.as_ref().map_or(1.0, |scales| scales[slot]);
        let own = radius(slot);
        for run in self.neighbors.runs(cell) {
            let [dx, dy, dz] = run.step.as_vec3().to_array();
            let [dx, dy, dz] = [dx - here[0], dy - here[1], dz - here[2]];
            for other in run.slots {
                let offset = [x[other] + dx, y[other] + dy, z[other] + dz];
                let squared = offset.iter().map(|along| along * along).sum::<f32>();
                let reach = own + radius(other);
                let excess = squared - reach * reach;
                let is_linked =
                    if excess.abs() > ROUNDING * reach { excess < 0.0 } else { self.touch(slot, other) };
                if is_linked && other != slot && !visit(other) {
                    return;
                }
            }
        }
    }

    /// Whether two particles are linked, computed without the cells: their edge depends on the largest scale, and far
    /// particles must not decide.
    fn touch(&self, slot: usize, other: usize) -> bool {
        let [one, other] = [slot, other].map(|slot| self.neighbors.indices()[slot]);
        let [from, to] = [one, other].map(|particle| self.positions.position(particle as usize));
        let scales = f64::from(self.links.scale(one)) + f64::from(self.links.scale(other));
        from.distance_squared(to) <= (scales * self.links.radius_world).powi(2)
    }

    /// Whether at least `count` particles are linked to this one.
    fn has_linked(&self, slot: usize, count: usize) -> bool {
        let mut found = 0;
        self.visit_linked(slot, |_| {
            found += 1;
            found < count
        });
        found >= count
    }
}

/// Where a particle is, as far as it is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    Unknown,
    /// It is in a large piece.
    InLarge,
    /// It was found by the current search, or is in a small piece.
    Found,
}

/// Searches from particle to particle.
struct PieceSearch<'a> {
    linked: &'a LinkedParticles<'a>,
    count_min: usize,
    places: Vec<Place>,
    found: Vec<usize>,
}

impl<'a> PieceSearch<'a> {
    fn new(linked: &'a LinkedParticles<'a>, count_min: usize) -> PieceSearch<'a> {
        let place = |slot: usize| {
            if slot.is_multiple_of(CHECKED_EVERY) {
                checkpoint();
            }
            if linked.has_linked(slot, count_min - 1) { Place::InLarge } else { Place::Unknown }
        };
        let places = (0..linked.len()).into_par_iter().halved().map(place).collect();
        PieceSearch { linked, count_min, places, found: Vec::new() }
    }

    /// The piece of a particle, if it is small and not yet known.
    fn piece_from(&mut self, slot: usize) -> Option<Piece> {
        if self.places[slot] != Place::Unknown {
            return None;
        }
        let PieceSearch { linked, count_min, places, found } = self;
        found.clear();
        found.push(slot);
        places[slot] = Place::Found;
        let (mut next, mut is_small) = (0, true);
        while is_small && next < found.len() {
            linked.visit_linked(found[next], |other| {
                match places[other] {
                    Place::InLarge => is_small = false,
                    // Particles of other small pieces are not linked to this one.
                    Place::Found => {}
                    Place::Unknown => {
                        places[other] = Place::Found;
                        found.push(other);
                        is_small = found.len() < *count_min;
                    }
                }
                is_small
            });
            next += 1;
        }
        if !is_small {
            found.iter().for_each(|slot| places[*slot] = Place::InLarge);
            return None;
        }
        let mut members: Vec<u32> = found.iter().map(|slot| linked.neighbors.indices()[*slot]).collect();
        members.sort_unstable();
        Some(Piece { members })
    }
}

/// More than the error of a squared distance in cell edges, relative to the distance.
const ROUNDING: f32 = 4e-6;

/// Particles between two looks whether the computation is cancelled.
const CHECKED_EVERY: usize = 1 << 12;
