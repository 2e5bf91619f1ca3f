//! Reconstructs smooth surfaces from particles.
//!
//! meniscus reconstructs surfaces from the particles of a simulation by the level-set method of Bhattacharya,
//! Gao and Bargteil ("A Level-set Method for Skinning Animated Particle Data"): it starts from a smooth
//! sum of kernels, and thin-plate flow smooths the surface within bounds around that start. A certificate lists the checks that the surface passed. The surface is bit-identical on any number of
//! threads.
//!
//! ```
//! use meniscus::surface::{Options, reconstruct};
//!
//! // Particles of your simulation: `&[[f32; 3]]` or `&[[f64; 3]]`. Here a block of 10 × 10 × 10, 0.1 apart.
//! let particles: Vec<[f32; 3]> =
//!     (0..1000).map(|i| [i % 10, i / 10 % 10, i / 100].map(|step| 0.1 * step as f32)).collect();
//!
//! let surface = reconstruct(&particles, &Options::default())?;
//!
//! for triangle in &surface.triangles {
//!     let corners = triangle.map(|vertex| surface.positions[vertex as usize]);
//!     // Hand the triangle to your renderer.
//! }
//! assert!(surface.report.certificate.holds());
//! # Ok::<(), meniscus::surface::Error>(())
//! ```
//!
//! The particle spacing is measured unless you set it; all other lengths follow from it. For a sequence of
//! frames use a [`Reconstructor`](surface::Reconstructor), which measures the spacing only once. A
//! `Reconstructor` also takes attributes, obstacles, a memory limit, a progress callback and a cancellation
//! token.
//!
//! # Modules
//!
//! | module | contents |
//! |---|---|
//! | [`surface`] | the method, in memory: the crate `meniscus-surface` |
//! | [`render`] | pictures of level sets: the crate `meniscus-render` |
//! | [`pipeline`] | conversion of files, several frames at once |
//! | [`watch`], [`http`] | a daemon that follows a simulation, and its status page |
//! | [`cli`] | the command line |
//!
//! To embed the method alone, depend on `meniscus-surface`. The crate `meniscus-formats` reads particles and
//! writes meshes and level sets. `examples/library` in the repository converts files with this crate.
//!
//! # How it works
//!
//! ```text
//!  file ──read──▶ positions ──rasterize──▶ level set, bounds ──smooth──▶ level set ──contour──▶ mesh
//!   meniscus-formats        signed distance φ, and the                   smoothed φ             │
//!                           interval that it may move in                 │                      │
//!                                                                        ▼ write                ▼ write
//!                                                                        .vdb (φ itself)      .glb .obj .ply
//! ```
//!
//! Signed distances φ are negative inside. They are measured **in voxels**: after the division by the voxel
//! size h, no stage needs units. World units appear only in the positions of particles that come in and of
//! vertices that go out.
//!
//! Loops run in the caller's rayon pool. A module that starts threads says so in its documentation.

/// The vector types in this crate's API.
pub use glam;

pub use meniscus_render as render;
pub use meniscus_surface as surface;

pub mod pipeline;

pub mod watch;

pub mod http;

pub mod cli;
