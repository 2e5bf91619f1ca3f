//! What the method needs of the particles.

use glam::DVec3;

/// Particle positions in world units, in the precision they came in.
#[derive(Clone, Debug, PartialEq)]
pub enum Particles {
    /// 32-bit positions.
    Single(Vec<[f32; 3]>),
    /// 64-bit positions.
    Double(Vec<[f64; 3]>),
}

impl Particles {
    /// The number of particles.
    pub fn len(&self) -> usize {
        match self {
            Particles::Single(positions) => positions.len(),
            Particles::Double(positions) => positions.len(),
        }
    }

    /// Whether there is no particle.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The position of particle `index`.
    pub fn position(&self, index: usize) -> DVec3 {
        match self {
            Particles::Single(positions) => glam::Vec3::from(positions[index]).as_dvec3(),
            Particles::Double(positions) => DVec3::from(positions[index]),
        }
    }
}
