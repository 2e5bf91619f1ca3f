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
//!
//! # In another program
//!
//! [`surface::skin::skin`] is a frame without files: particles in, a mesh and a level set out. What was measured on the way, and what
//! was checked of the result, is in its report.
//!
//! ```
//! use meniscus::surface::particles::Particles;
//! use meniscus::surface::options::{Choices, Settings};
//! use meniscus::surface::skin::skin;
//!
//! let block = (0..125).map(|i| [i % 5, i / 5 % 5, i / 25].map(|place| 0.1 * place as f32));
//! let settings = Settings::paper(0.05, &Choices::default())?;
//! let surface = skin(&Particles::Single(block.collect()), &settings);
//! assert!(surface.report.certificate.holds());
//! assert!(surface.mesh.measure().is_closed_manifold());
//! # Ok::<(), meniscus::surface::options::SettingsError>(())
//! ```
//!
//! [`pipeline`] is frames from files to files, several at once, as the command has them. `examples/library` has both,
//! with the files: a frame to a .glb, and a folder to a folder. A program that is to follow a simulation runs
//! [`watch::run`], as `examples/dam_break` does. `default-features = false` leaves out the command line, and the ten crates
//! that only it needs.
//!
//! Bytes become particles, and meshes bytes, in a crate of its own, `meniscus-formats`. Nothing starts threads but what says
//! so: loops run in the rayon pool that the caller is in.

pub mod surface;

#[cfg(feature = "render")]
pub mod render;

#[cfg(feature = "pipeline")]
pub mod pipeline;

#[cfg(feature = "pipeline")]
pub mod farm;

#[cfg(feature = "watch")]
pub mod watch;

#[cfg(feature = "http")]
pub mod http;

#[cfg(feature = "cli")]
pub mod cli;
