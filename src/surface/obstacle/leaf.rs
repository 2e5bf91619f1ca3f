//! The signed distances of one leaf to an obstacle.

use std::sync::Arc;

use crate::surface::grid::Leaf;

/// φ_o of a leaf: signed distances to obstacles in voxels, negative inside one.
#[derive(Clone, Debug, PartialEq)]
pub enum ObstacleLeaf {
    /// No voxel is within the half width of an obstacle.
    Outside,
    /// All voxels are inside one, farther from its surface than the half width.
    Inside,
    /// Some are nearer; values are within ± the half width.
    Near(Arc<Leaf>),
}

impl ObstacleLeaf {
    /// The leaf with these values, which are within ± `half_width`.
    pub(super) fn of_values(leaf: Arc<Leaf>, half_width: f32) -> ObstacleLeaf {
        if leaf.values.iter().all(|&value| value >= half_width) {
            ObstacleLeaf::Outside
        } else if leaf.values.iter().all(|&value| value <= -half_width) {
            ObstacleLeaf::Inside
        } else {
            ObstacleLeaf::Near(leaf)
        }
    }

    /// The leaf with the distances greater by so much, which must be known so much farther than `half_width`.
    pub fn shifted(self, by: f32, half_width: f32) -> ObstacleLeaf {
        match self {
            ObstacleLeaf::Near(mut leaf) if by != 0.0 => {
                for value in &mut Arc::make_mut(&mut leaf).values {
                    *value = (*value + by).clamp(-half_width, half_width);
                }
                ObstacleLeaf::of_values(leaf, half_width)
            }
            unchanged => unchanged,
        }
    }

    /// The leaf of both obstacles together.
    pub(super) fn union(self, other: ObstacleLeaf) -> ObstacleLeaf {
        match (self, other) {
            (ObstacleLeaf::Outside, other) => other,
            (one, ObstacleLeaf::Outside) => one,
            (ObstacleLeaf::Inside, _) | (_, ObstacleLeaf::Inside) => ObstacleLeaf::Inside,
            (ObstacleLeaf::Near(mut one), ObstacleLeaf::Near(other)) => {
                for (one, other) in Arc::make_mut(&mut one).values.iter_mut().zip(&other.values) {
                    *one = one.min(*other);
                }
                ObstacleLeaf::Near(one)
            }
        }
    }

    /// The bytes that it takes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of::<ObstacleLeaf>() + if matches!(self, ObstacleLeaf::Near(_)) { size_of::<Leaf>() } else { 0 }
    }
}
