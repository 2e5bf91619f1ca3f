//! Rounds positions to what files can store.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::Mesh;
use crate::parallel::Loops as _;

/// How the positions of a mesh are rounded. All files of a frame have the same positions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PositionRounding {
    /// To 32 bits relative to the mesh's origin.
    #[default]
    Local,
    /// Also to 32 bits in world coordinates, for files that have no origin.
    World,
}

impl Mesh {
    /// Rounds the positions. Returns the largest distance by which a vertex moved, in world units.
    pub fn round(&mut self, rounding: PositionRounding) -> f64 {
        if rounding == PositionRounding::Local {
            return 0.0;
        }
        let origin = self.origin;
        let round = |position: &mut Vec3| {
            let exact = std::mem::replace(position, rounded_to_world(origin, *position));
            f64::from(position.distance(exact))
        };
        self.positions.par_iter_mut().halved().map(round).reduce(|| 0.0, f64::max)
    }

    /// Whether rounding changes nothing.
    pub fn is_rounded(&self, rounding: PositionRounding) -> bool {
        let is_stored = |position: &Vec3| rounded_to_world(self.origin, *position) == *position;
        rounding == PositionRounding::Local || self.positions.par_iter().halved().all(is_stored)
    }

    /// Half the distance between adjacent 32-bit numbers at the farthest position, in world units.
    pub fn rounding_error(&self, rounding: PositionRounding) -> f64 {
        let stored = |position: &Vec3| match rounding {
            PositionRounding::Local => *position,
            PositionRounding::World => world(self.origin, *position),
        };
        let coordinate = |position: &Vec3| stored(position).abs().max_element();
        let farthest = self.positions.par_iter().halved().map(coordinate).reduce(|| 0.0, f32::max);
        f64::from(farthest.next_up() - farthest) / 2.0
    }
}

fn rounded_to_world(origin: DVec3, position: Vec3) -> Vec3 {
    (world(origin, position).as_dvec3() - origin).as_vec3()
}

/// The position in world coordinates, rounded to 32 bits.
fn world(origin: DVec3, position: Vec3) -> Vec3 {
    (origin + position.as_dvec3()).as_vec3()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn world_positions_are_those_that_32_bits_can_store() {
        let positions = vec![Vec3::new(0.3, 7.0, -0.4), Vec3::ONE];
        let mut mesh = Mesh { positions, origin: DVec3::new(4e6, 0.0, 0.0), ..Mesh::default() };
        let before = mesh.clone();
        assert_eq!((mesh.round(PositionRounding::Local), &mesh), (0.0, &before));
        assert!(!mesh.is_rounded(PositionRounding::World));
        // At 4e6, adjacent 32-bit numbers differ by a quarter.
        assert_eq!(mesh.rounding_error(PositionRounding::World), 0.125);
        let moved = mesh.round(PositionRounding::World);
        assert!((moved - 0.05).abs() < 1e-6, "{moved}");
        assert_eq!(mesh.positions[0], Vec3::new(0.25, 7.0, -0.4));
        assert!(mesh.is_rounded(PositionRounding::World));
        mesh.origin = DVec3::ZERO;
        assert_eq!(mesh.round(PositionRounding::World), 0.0);
    }
}
