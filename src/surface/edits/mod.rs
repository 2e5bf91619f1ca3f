//! Edits of the level set after smoothing: specks and bubbles that nobody wants, and a box that cuts it off.
//!
//! ```text
//!   ╭──────────────╮   ·  island      with fewer than so many particles: becomes outside
//!   │    ○         │
//!   │    cavity    ┊                  of less than so many voxels: becomes inside
//!   ╰──────────────┊
//!                  ┊ box              the fluid beyond it is cut off, the cut closed by a flat cap
//! ```
//!
//! They change φ and not the mesh, so that the mesh and the .vdb agree. The bounds, which were checked before, say nothing of what
//! is moved on purpose; the caller is told how much that was.
//!
//! The order is islands, cavities, box. A drop in a bubble that is too small goes first, and the bubble is then as
//! large as it looks; a hollow drop that is too small goes with its hollow. Pieces are judged as the fluid
//! has them and not as the box cuts them, so that moving the box does not make drops come and go.
//!
//! **What a piece is** follows the contouring ([`crate::surface::contour`]): on a face of a cell where the signs alternate it
//! separates the insides. So voxels inside are connected across faces, and voxels outside across faces and edges.
//!
//! **What reaches how far.** A piece is judged whole. But what is dropped or filled is small, by what was asked for, and
//! φ changes within the band's half width of it; the box changes what is within half a width of its planes. So
//! changes far away stay there.

mod cavities;
mod clip;
mod islands;
mod pieces;
mod turned;

pub use cavities::{FilledCavities, fill_cavities};
pub use clip::{ClipBox, Clipped, clip};
pub use islands::{DroppedIslands, drop_islands};
