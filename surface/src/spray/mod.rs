//! Separates small pieces of fluid from the rest: drops, clusters and filaments, which a mesh shows badly.
//!
//! ```text
//!        ∙      ∙∙                 two particles are linked if their r_init spheres touch; linked particles, and those
//!            ∙ ∙                   linked to them, form a piece
//!      ∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙
//!      ∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙            pieces with fewer than N particles are apart: they are spray
//! ```
//!
//! **Over time.** A particle that is apart in some frames and not in others would flicker between mesh and points. With
//! ids, it changes sides only for at least K frames (`history`).
//!
//! Invariants: whether a particle is apart depends only on the particles of its piece and on those linked to them, up to
//! N of these; it does not depend on their order, or on the number of threads.

mod history;
mod pieces;

pub use history::{FrameSides, frames_needed, steady_sides};
pub use pieces::{Links, Piece, small_pieces};

use glam::DVec3;

use crate::particles::{Attribute, OwnedPositions, find_attribute, rows, rows_of};

/// The shape of a piece of spray.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SprayClass {
    /// One particle.
    Drop,
    /// Several particles.
    Cluster,
    /// Several particles in a row.
    Filament,
}

impl SprayClass {
    /// All classes, in the order of their indices in files.
    pub const ALL: [SprayClass; 3] = [SprayClass::Drop, SprayClass::Cluster, SprayClass::Filament];

    /// The name in files.
    pub fn name(self) -> &'static str {
        match self {
            SprayClass::Drop => "drop",
            SprayClass::Cluster => "cluster",
            SprayClass::Filament => "filament",
        }
    }
}

/// The particles of a frame that are spray, in the order of the frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Spray {
    /// Their positions.
    pub positions: OwnedPositions,
    /// The radius of the ball that has the volume of a particle, world units.
    pub radii: Vec<f32>,
    /// The shape of the piece that each belongs to.
    pub classes: Vec<SprayClass>,
    /// The number of particles of that piece.
    pub piece_sizes: Vec<u32>,
    /// For how many frames before this one each has been apart in a row, as far as these were looked at; `None` without
    /// ids.
    pub ages: Option<Vec<u32>>,
    /// The attributes of the frame's particles.
    pub attributes: Vec<Attribute>,
}

/// How much spray a frame has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct SprayCounts {
    /// Number of particles.
    pub particles: usize,
    /// Number of single particles.
    pub drops: usize,
    /// Number of clusters.
    pub clusters: usize,
    /// Number of filaments.
    pub filaments: usize,
}

impl Spray {
    /// The memory of all particles, in bytes.
    pub fn size_bytes(&self) -> usize {
        let Spray { positions, radii, classes, piece_sizes, ages, attributes } = self;
        let attributes: usize = attributes.iter().map(|attribute| attribute.values.size_bytes()).sum();
        let ages = ages.as_ref().map_or(0, |ages| size_of_val(&**ages));
        let shapes = size_of_val(&**radii) + size_of_val(&**classes) + size_of_val(&**piece_sizes);
        positions.size_bytes() + shapes + ages + attributes
    }

    /// Their velocities, world units per second; empty if they are unknown.
    pub fn velocities(&self) -> Vec<[f32; 3]> {
        let found = find_attribute(&self.attributes, "velocity", 3);
        let numbers = found.and_then(|attribute| attribute.values.numbers());
        numbers.map(|numbers| numbers.as_chunks().0.to_vec()).unwrap_or_default()
    }

    /// Keeps the points for which `mask` is true.
    pub(crate) fn retain(&mut self, mask: &[bool]) {
        (self.positions, self.attributes) = rows_of(&(&self.positions).into(), &self.attributes, mask);
        self.radii = rows(&self.radii, 1, mask);
        self.classes = rows(&self.classes, 1, mask);
        self.piece_sizes = rows(&self.piece_sizes, 1, mask);
        self.ages = self.ages.take().map(|ages| rows(&ages, 1, mask));
    }

    /// The number of particles and of pieces.
    pub fn counts(&self) -> SprayCounts {
        let of = |class: SprayClass| {
            let sizes = self.classes.iter().zip(&self.piece_sizes).filter(|(other, _)| **other == class);
            // Each particle of a piece counts as its part of it.
            sizes.map(|(_, size)| 1.0 / f64::from(*size)).sum::<f64>().round() as usize
        };
        SprayCounts {
            particles: self.positions.len(),
            drops: of(SprayClass::Drop),
            clusters: of(SprayClass::Cluster),
            filaments: of(SprayClass::Filament),
        }
    }
}

/// Which particles are spray.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SpraySides {
    /// Whether each particle is.
    pub is_spray: Vec<bool>,
    /// See [`Spray::ages`].
    pub ages: Option<Vec<u32>>,
}

/// Takes the spray out of a frame. Returns it, and the other particles with their attributes. `radii` are those of all
/// particles; `links` are those with which the sides were determined.
pub fn take_spray(
    positions: &OwnedPositions,
    attributes: &[Attribute],
    sides: &SpraySides,
    radii: &[f32],
    (links, spacing): (&Links, f64),
) -> (OwnedPositions, Vec<Attribute>, Spray) {
    let SpraySides { is_spray, ages } = sides;
    let is_fluid: Vec<bool> = is_spray.iter().map(|is_spray| !is_spray).collect();
    let (fluid, of_fluid) = rows_of(&positions.into(), attributes, &is_fluid);
    let (positions, attributes) = rows_of(&positions.into(), attributes, is_spray);
    let ages = ages.as_ref().map(|ages| rows(ages, 1, is_spray));
    let count = positions.len();
    let (mut classes, mut piece_sizes) = (vec![SprayClass::Cluster; count], vec![1; count]);
    // Spray may be of any size: it can have touched other spray.
    let all = u32::try_from(count).unwrap_or(u32::MAX).saturating_add(1);
    for Piece { members } in small_pieces(&positions, &links.of_rows(is_spray), all) {
        let class = class_of(&positions, &members, spacing);
        for member in &members {
            classes[*member as usize] = class;
            piece_sizes[*member as usize] = members.len() as u32;
        }
    }
    let spray = Spray { positions, radii: rows(radii, 1, is_spray), classes, piece_sizes, ages, attributes };
    (fluid, of_fluid, spray)
}

/// The shape of a piece. Of large pieces only the first particles are compared.
fn class_of(positions: &OwnedPositions, members: &[u32], spacing: f64) -> SprayClass {
    if members.len() == 1 {
        return SprayClass::Drop;
    }
    let members: Vec<DVec3> =
        members.iter().take(COMPARED_MAX).map(|member| positions.position(*member as usize)).collect();
    let pairs = members.iter().enumerate().flat_map(|(index, one)| {
        members[index + 1..].iter().map(move |other| (one.distance_squared(*other), *one, *other))
    });
    let Some((squared, from, to)) = pairs.max_by(|one, other| one.0.total_cmp(&other.0)) else {
        return SprayClass::Cluster;
    };
    let length = squared.sqrt();
    if length < LENGTH_MIN * spacing {
        return SprayClass::Cluster;
    }
    let along = (to - from) / length;
    let from_line = |position: &DVec3| (*position - from).reject_from_normalized(along).length_squared();
    let deviation = (members.iter().map(from_line).sum::<f64>() / members.len() as f64).sqrt();
    if deviation <= DEVIATION_MAX * length { SprayClass::Filament } else { SprayClass::Cluster }
}

/// A filament is at least this long, in spacings.
const LENGTH_MIN: f64 = 2.5;

/// The particles of a filament deviate from a line by at most this fraction of its length, in the root mean square.
const DEVIATION_MAX: f64 = 1.0 / 6.0;

/// Particles of a piece that are compared in pairs.
const COMPARED_MAX: usize = 1000;

/// The radius of a ball that has the volume of a cube with this edge.
pub fn radius_of_volume(edge: f64) -> f64 {
    RADIUS_OF_CUBE * edge
}

/// The cube root of 3/4π.
const RADIUS_OF_CUBE: f64 = 0.620_350_490_899_400_1;

#[cfg(test)]
mod tests;
