//! The signed distances of one leaf to an obstacle.

use std::sync::Arc;

use crate::grid::Leaf;

/// φ_o of a leaf: signed distances to obstacles in voxels, negative inside an obstacle.
#[derive(Clone, Debug, PartialEq)]
pub enum ObstacleLeaf {
    /// All voxels are outside, farther from obstacles than the half width.
    Outside,
    /// All voxels are inside, farther from the surface than the half width.
    Inside,
    /// Some voxels are closer; values are clamped to ± the half width.
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

    /// Adds `by` to the distances and clamps them to ± `half_width`. Distances up to `half_width` + |`by`|
    /// must be known.
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

    /// The union of two obstacles.
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

    /// The memory of the leaf, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of::<ObstacleLeaf>() + if matches!(self, ObstacleLeaf::Near(_)) { size_of::<Leaf>() } else { 0 }
    }
}
