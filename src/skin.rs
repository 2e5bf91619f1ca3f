//! The whole method in three calls: rasterize, smooth, contour.

use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::particles::Particles;
use crate::report::SkinReport;
use crate::settings::Settings;

/// The surface of one frame.
#[derive(Clone, Debug)]
pub struct Surface {
    /// The level set that was meshed.
    pub band: NarrowBand,
    /// The mesh.
    pub mesh: Mesh,
    /// What was measured on the way.
    pub report: SkinReport,
}

/// What rasterization hands to smoothing.
pub struct Rasterized {}

/// What smoothing hands to contouring.
pub struct Smoothed {}

/// Skins one frame: rasterize, smooth, contour.
pub fn skin(particles: &Particles, settings: &Settings) -> Surface {
    contour(smooth(rasterize(particles, settings), settings), settings)
}

/// The first stage: particles to level sets.
pub fn rasterize(_particles: &Particles, _settings: &Settings) -> Rasterized {
    unimplemented!("lands from another branch")
}

/// The second stage: the constrained smoothing.
pub fn smooth(_rasterized: Rasterized, _settings: &Settings) -> Smoothed {
    unimplemented!("lands from another branch")
}

/// The third stage: the mesh, its measures and the certificate.
pub fn contour(_smoothed: Smoothed, _settings: &Settings) -> Surface {
    unimplemented!("lands from another branch")
}
