//! Edits of the level set after smoothing: removes islands, fills cavities, and clips with a box.
//!
//! ```text
//!   ╭──────────────╮   ·  island      with few particles: becomes outside
//!   │    ○         │
//!   │    cavity    ┊                  of small volume: becomes inside
//!   ╰──────────────┊
//!                  ┊ box              the fluid outside is removed, the cut closed by a flat cap
//! ```
//!
//! Edits change φ rather than the mesh, so that the mesh and the .vdb file agree. The bounds of φ
//! ([`Bounds`](crate::level_set::Bounds)) are checked before edits and do not apply to them. Each
//! edit returns what it changed.
//!
//! The order is islands, cavities, box. Islands come first: a small drop in a bubble is removed before the
//! bubble's volume is compared with the limit, and a small hollow drop is removed together with its hollow.
//! Islands and cavities are found before the box cuts them, so that moving the box does not make drops appear
//! and disappear.
//!
//! **Connectivity** follows the contouring ([`crate::contour`]). On a cell face with alternating
//! signs, the contouring separates the two inside corners. So inside voxels are connected across faces, and
//! outside voxels across faces and edges.
//!
//! **Locality.** Whether a component is removed or filled depends on the whole component. But such a
//! component is small, within the requested limit, and φ changes only within the band's half width of it. The
//! box changes φ only outside and within a half width of its planes. So changes stay local.

mod cavities;
mod clip;
mod components;
mod flip;
mod islands;

pub use cavities::{FilledCavities, fill_cavities};
pub use clip::{Clipped, VoxelClip, clip};
pub use islands::{DroppedIslands, drop_islands};
