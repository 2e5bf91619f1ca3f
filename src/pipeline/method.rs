//! The three stages of the method, as the pipeline sees them.

use crate::particles::Particles;
use crate::settings::Settings;
use crate::skin::{self, Surface};

/// The three stages of the method. Tests put a quick or a failing one in its place.
pub trait Method: Sync {
    /// What rasterization hands to smoothing.
    type Rasterized: Send;
    /// What smoothing hands to contouring.
    type Smoothed: Send;

    /// The most memory that the three stages take for these particles, in bytes.
    fn memory_bytes(&self, particles: &Particles, settings: &Settings) -> u64;
    /// The first stage.
    fn rasterize(&self, particles: &Particles, settings: &Settings) -> Self::Rasterized;
    /// The second stage.
    fn smooth(&self, rasterized: Self::Rasterized, settings: &Settings) -> Self::Smoothed;
    /// The third stage.
    fn contour(&self, smoothed: Self::Smoothed, settings: &Settings) -> Surface;
}

/// The method that this program is for.
#[derive(Clone, Copy, Debug)]
pub struct LevelSetSkinning;

impl Method for LevelSetSkinning {
    type Rasterized = skin::Rasterized;
    type Smoothed = skin::Smoothed;

    fn memory_bytes(&self, particles: &Particles, settings: &Settings) -> u64 {
        skin::memory_estimate_bytes(particles, settings)
    }

    fn rasterize(&self, particles: &Particles, settings: &Settings) -> skin::Rasterized {
        skin::rasterize(particles, settings)
    }

    fn smooth(&self, rasterized: skin::Rasterized, settings: &Settings) -> skin::Smoothed {
        skin::smooth(rasterized, settings)
    }

    fn contour(&self, smoothed: skin::Smoothed, settings: &Settings) -> Surface {
        skin::contour(smoothed, settings)
    }
}
