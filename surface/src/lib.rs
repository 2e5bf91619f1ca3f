//! The method: reconstructs a smooth surface from particles. It opens no files, reads no clock, and computes
//! in the caller's rayon pool.
//!
//! [`reconstruct`] makes the surface of one frame. A [`Reconstructor`] makes the surfaces of a sequence, with
//! attributes, obstacles, a progress callback, cancellation and a memory limit. [`Options`] has every option
//! of the method; its defaults are for liquids. [`Surface`] is a mesh with absolute positions, its level set,
//! and a [`Report`] of what was measured and [checked](Certificate).
//!
//! All lengths are in world units unless a field says voxels (h) or particle spacings (d).

mod cancel;
mod error;
mod reconstruct;

pub use cancel::CancelToken;
pub use error::Error;
#[doc(hidden)]
pub use interrupt::checkpoint;
#[doc(hidden)]
pub use reconstruct::RequestedParts;
pub use reconstruct::{MEMORY_LIMIT, Progress, Reconstructor, Surface, reconstruct};

#[doc(inline)]
pub use self::{
    attributes::TransferCounts,
    contour::Contouring,
    grid::{Field, LEAF_EDGE, LEAF_VOXELS, Leaf, Topology},
    level_set::NarrowBand,
    mesh::MeshMeasures,
    obstacle::{ContactStats, DepthStats, MeshFindings, Obstacle},
    options::{
        Anisotropy, AnisotropyKind, AttributeSelection, ClipBox, Length, LengthUnit,
        MethodOptions as Options, PerParticleRadius, Preset, Settings, SettingsError,
    },
    particles::{Attribute, AttributeValues, Positions, Role},
    reconstruction::Storage,
    report::{EditReport, Phase, ReconstructionReport as Report, ShapeStats, StageSeconds, TransferReport},
    smooth::{Convergence, Integrator},
    spacing::{SequenceEstimate, SpacingEstimate, combine_estimates, estimate_spacing},
    validation::{Certificate, ParticlesOutside},
};

mod interrupt;
mod parallel;

// The modules below are public for the tests, benchmarks and experiments of this repository, and for the
// other parts of this crate. They are not part of the API: anything in them may change in any version.

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
pub mod rasterize;
#[doc(hidden)]
pub mod smooth;
#[doc(hidden)]
pub mod spacing;

#[doc(hidden)]
pub mod obstacle;

#[doc(hidden)]
pub mod level_set;

#[doc(hidden)]
pub mod grid;
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

#[doc(hidden)]
pub mod words;
