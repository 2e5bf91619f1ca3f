//! Particles in, smooth surfaces out.
//!
//! meniscus skins frames of particles by the level-set method of Bhattacharya, Gao and Bargteil
//! ("A Level-set Method for Skinning Animated Particle Data"): the smoothest surface, in the sense
//! of least thin-plate energy, that stays between two unions of spheres around the particles.
//!
//! ```text
//!  file ──read──▶ Particles ──rasterize──▶ NarrowBand + Bounds ──smooth──▶ NarrowBand ──contour──▶ Mesh ──write──▶ files
//!         formats             level set φ, and the φ interval              smoothed φ    │                  .glb .obj .ply
//!                             it may move in                                             └────────────────▶ .vdb (φ itself)
//! ```
//!
//! Signed distances φ are negative inside and, within this crate, measured **in voxels**: dividing
//! by the voxel size h makes every stage free of units. World units appear where particles come in and
//! where vertices go out.

pub mod cli;

pub mod daemon;
pub mod farm;
pub mod window;

pub mod board;

pub mod pipeline;

pub mod skin;

pub mod report;
pub mod settings;

pub mod certify;

pub mod anisotropy;
pub mod contour;
pub mod preview;
pub mod rasterize;
pub mod smooth;
pub mod spacing;
pub mod transfer;
pub mod trim;

pub mod obstacle;

pub mod level_set;

pub mod grid;
pub mod neighbors;

pub mod mesh;
pub mod particles;
pub mod space;

pub mod simd;
