//! Reconstructs smooth surfaces from particles, in memory.
//!
//! The method is the level-set method of Bhattacharya, Gao and Bargteil ("A Level-set Method for Skinning
//! Animated Particle Data"): it starts from a smooth sum of kernels, and thin-plate flow smooths the surface
//! within bounds around that start. The surface is bit-identical on any number of threads.
//!
//! ```
//! use meniscus_surface::{Options, reconstruct};
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
//! # Ok::<(), meniscus_surface::Error>(())
//! ```
//!
//! [`reconstruct`] makes the surface of one frame. A [`Reconstructor`] makes the surfaces of a sequence, with
//! attributes, obstacles, a progress callback, cancellation and a memory limit. [`Options`] has every option
//! of the method; its defaults are for liquids. [`Surface`] is a mesh with absolute positions, its level set,
//! and a [`Report`] of what was measured and [checked](Certificate).
//!
//! ```text
//!  positions ──rasterize──▶ level set, bounds ──smooth──▶ level set ──contour──▶ mesh
//!                           signed distance φ, and the    smoothed φ
//!                           interval that it may move in
//! ```
//!
//! φ is negative inside, and in voxels. All lengths of the API are in world units unless a field says voxels
//! (h) or particle spacings (d).
//!
//! The crate opens no files, reads no clock, starts no threads, and computes in the caller's rayon pool.

/// The vector types in this crate's API.
pub use glam;

mod cancel;
mod error;
mod reconstruct;

pub use cancel::CancelToken;
#[doc(hidden)]
pub use cancel::checkpoint;
pub use error::Error;
pub use reconstruct::{MEMORY_LIMIT, Progress, Reconstructor, Surface, reconstruct};
#[doc(hidden)]
pub use reconstruct::{RequestedParts, SmoothedFrame};

#[doc(inline)]
pub use self::{
    attributes::TransferCounts,
    contour::Contouring,
    grid::{Field, LEAF_EDGE, Leaf, Topology},
    level_set::NarrowBand,
    mesh::MeshMeasures,
    obstacle::{ContactStats, DepthStats, MeshFindings, Obstacle, ObstacleTooFar},
    options::{
        Anisotropy, AnisotropyKind, AttributeSelection, ClipBox, ColumnNames, Length, LengthUnit,
        MethodOptions as Options, PerParticleRadius, Preset, Settings, SettingsError,
    },
    particles::{Attribute, AttributeValues, ParticleFilter, Positions, Role},
    report::{EditReport, Phase, ReconstructionReport as Report, ShapeStats, TransferReport},
    smooth::{Convergence, Integrator, SmoothReport},
    spacing::{SequenceEstimate, SpacingEstimate, combine_estimates, estimate_spacing},
    spray::{Spray, SprayClass, SprayCounts},
    storage::Storage,
    validation::{Certificate, ParticlesOutside},
};

mod parallel;

// The modules below are public for the tests, benchmarks and experiments of this repository, and for the
// crates of the program. They are not part of the API: anything in them may change in any version.

#[doc(hidden)]
pub mod reconstruction;

#[doc(hidden)]
pub mod options;
#[doc(hidden)]
pub mod report;

#[doc(hidden)]
pub mod validation;

#[doc(hidden)]
pub mod anisotropy;
#[doc(hidden)]
pub mod attributes;
#[doc(hidden)]
pub mod contour;
#[doc(hidden)]
pub mod edits;
#[doc(hidden)]
pub mod flicker;
#[doc(hidden)]
pub mod origins;
#[doc(hidden)]
pub mod rasterize;
#[doc(hidden)]
pub mod smooth;
#[doc(hidden)]
pub mod spacing;
#[doc(hidden)]
pub mod spray;
#[doc(hidden)]
pub mod temporal;

#[doc(hidden)]
pub mod obstacle;

#[doc(hidden)]
pub mod level_set;

#[doc(hidden)]
pub mod grid;
mod motion;
#[doc(hidden)]
pub mod neighbors;

#[doc(hidden)]
pub mod mesh;
#[doc(hidden)]
pub mod particles;
#[doc(hidden)]
pub mod space;

#[doc(hidden)]
pub mod simd;

mod storage;

#[doc(hidden)]
pub mod words;
