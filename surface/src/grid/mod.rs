//! The sparse grid: leaves of 8 × 8 × 8 voxels, stored only near the surface.
//!
//! ```text
//!   Topology            which leaves are stored, in a fixed order, and their neighbors
//!     leaf 0  leaf 1  leaf 2 …
//!   Field<f32>          one value per voxel:  [512 values][512 values][512 values] …
//!   Field of masks      one bit per voxel:    [512 bits][512 bits] …
//!
//!   one leaf            value index = x·64 + y·8 + z        (z fastest)
//!                       a row is the 8 values along z: one vector register
//!                       mask bit of a voxel = bit z of byte y of word x
//! ```
//!
//! All fields of a frame share one [`Topology`]. A field is a single flat, aligned allocation of leaves in
//! the topology's order. The grid does not depend on distances or particles.
//!
//! Invariants: leaf origins are multiples of 8, distinct, and sorted in the depth-first order of an OpenVDB
//! tree, so that a tree can be written in one pass; `neighbors` is symmetric.

mod leaf;
mod mask;
mod stencil;
mod topology;

pub use leaf::{Field, LEAF_EDGE, LEAF_VOXELS, LEAVES_PER_TASK, Leaf, Row, offset_in_leaf, voxel_in_leaf};
pub use mask::{LeafMask, negative_masks};
pub use stencil::{Neighborhood, ROW_COUNT, SetBits, Slab, slabs_in, vectors_in};
pub use topology::{Direction, FACE_STEPS, NO_LEAF, Topology, leaf_steps_within};
