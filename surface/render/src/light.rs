//! Lighting: a bright sky, a sun over the viewer's left shoulder, and ground that reflects some of the light.

use glam::{DVec3, Vec3};

use super::View;
use super::sky::Sky;

/// The light of a scene.
pub(super) struct Lighting<'a> {
    sky: &'a Sky,
    up: Vec3,
    /// The direction to the sun.
    sun: Vec3,
}

/// The light that arrives at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Light {
    /// The light from the hemisphere around the normal, with occlusion, by colour channel.
    pub(super) ambient: Vec3,
    /// The visible fraction of the sun.
    pub(super) sun: f32,
}

impl Light {
    pub(super) const NONE: Light = Light { ambient: Vec3::ZERO, sun: 0.0 };

    pub(super) fn plus(self, other: Light, weight: f32) -> Light {
        Light { ambient: self.ambient + weight * other.ambient, sun: self.sun + weight * other.sun }
    }

    pub(super) fn times(self, factor: f32) -> Light {
        Light { ambient: self.ambient * factor, sun: self.sun * factor }
    }
}

/// The colour of front faces. All colours here are linear.
const WATER: Vec3 = Vec3::new(0.105, 0.34, 0.66);
/// The colour of back faces.
const INSIDE: Vec3 = Vec3::new(0.85, 0.25, 0.03);
const SUN: Vec3 = Vec3::new(1.12, 1.05, 0.95);
const ZENITH: Vec3 = Vec3::new(0.70, 0.78, 0.90);
const HORIZON: Vec3 = Vec3::new(0.74, 0.76, 0.79);
const FROM_BELOW: Vec3 = Vec3::new(0.36, 0.35, 0.34);
const BACKGROUND: Vec3 = Vec3::new(0.80, 0.82, 0.845);
/// Tangents of half the opening angles of a cone of ambient light (30°) and of the sun's cone (5°). The sun's
/// width blurs shadows with distance.
const AMBIENT_TANGENT: f32 = 0.577;
const SUN_TANGENT: f32 = 0.09;
/// Cosine and sine of the angle between the middle cone and the five cones around it.
const TILT: (f32, f32) = (0.5, 0.866);
const MIDDLE_WEIGHT: f32 = 0.25;

impl<'a> Lighting<'a> {
    pub(super) fn new(sky: &'a Sky, view: &View) -> Lighting<'a> {
        let up = view.up.direction();
        let backward = (-view.camera.forward).reject_from(up).normalize_or(-view.camera.up);
        let right = view.camera.right.reject_from(up).normalize_or(view.camera.right);
        let sun = up * 0.78 - right * 0.5 + backward * 0.42;
        Lighting { sky, up: up.as_vec3(), sun: sun.normalize().as_vec3() }
    }

    /// The light that arrives at a point on a surface with this normal. The position is in voxels.
    pub(super) fn incoming(&self, point: DVec3, normal: Vec3) -> Light {
        let (tangent, bitangent) = normal.any_orthonormal_pair();
        let mut ambient = MIDDLE_WEIGHT * self.light_from(point, normal);
        for cone in 0..5 {
            let angle = cone as f32 * (std::f32::consts::TAU / 5.0);
            let around = tangent * angle.cos() + bitangent * angle.sin();
            let direction = normal * TILT.0 + around * TILT.1;
            ambient += (1.0 - MIDDLE_WEIGHT) / 5.0 * self.light_from(point, direction);
        }
        let faces_sun = normal.dot(self.sun) > 0.0;
        let sun = if faces_sun { self.sky.transmittance(point, self.sun, SUN_TANGENT) } else { 0.0 };
        Light { ambient, sun }
    }

    /// The light from a direction, with occlusion.
    fn light_from(&self, point: DVec3, direction: Vec3) -> Vec3 {
        self.radiance(direction) * self.sky.transmittance(point, direction, AMBIENT_TANGENT)
    }

    /// The light from a direction, without occlusion.
    fn radiance(&self, direction: Vec3) -> Vec3 {
        let height = direction.dot(self.up);
        if height > 0.0 {
            HORIZON.lerp(ZENITH, height)
        } else {
            HORIZON.lerp(FROM_BELOW, (-2.0 * height).min(1.0))
        }
    }

    /// The colour of the surface; `toward` points to the viewer.
    pub(super) fn water(&self, light: Light, normal: Vec3, toward: Vec3, is_front: bool) -> Vec3 {
        let albedo = if is_front { WATER } else { INSIDE };
        let facing = normal.dot(self.sun).max(0.0) * light.sun;
        let half = (self.sun + toward).normalize_or(normal);
        let glint = normal.dot(half).max(0.0).powi(90) * light.sun;
        let edge = (1.0 - normal.dot(toward).clamp(0.0, 1.0)).powi(5);
        let mirrored = self.radiance(2.0 * normal.dot(toward) * normal - toward);
        // The reflection of the sky is occluded as much as the ambient light.
        let open = (light.ambient.y / HORIZON.y).min(1.0);
        albedo * (light.ambient + SUN * facing) + (0.02 + 0.5 * edge) * open * mirrored + 0.55 * glint * SUN
    }

    /// The colour of a matte surface with this albedo.
    pub(super) fn matte(&self, albedo: Vec3, light: Light, normal: Vec3) -> Vec3 {
        let facing = normal.dot(self.sun).max(0.0) * light.sun;
        albedo * (light.ambient + SUN * facing)
    }

    /// The colour of the ground: the background, darkened by shadows.
    pub(super) fn ground(&self, light: Light) -> Vec3 {
        let facing = self.up.dot(self.sun);
        let open = self.unoccluded_on_ground() + SUN * facing;
        BACKGROUND * ((light.ambient + SUN * facing * light.sun) / open)
    }

    fn unoccluded_on_ground(&self) -> Vec3 {
        let tilted = self.radiance(self.up * TILT.0 + self.up.any_orthonormal_vector() * TILT.1);
        MIDDLE_WEIGHT * self.radiance(self.up) + (1.0 - MIDDLE_WEIGHT) * tilted
    }

    /// The background colour.
    pub(super) fn background(&self) -> Vec3 {
        BACKGROUND
    }

    /// The unoccluded light on a surface with this normal.
    pub(super) fn unoccluded(&self, normal: Vec3) -> Light {
        let height = 0.5 + 0.5 * normal.dot(self.up);
        Light { ambient: FROM_BELOW.lerp(ZENITH, height), sun: 1.0 }
    }
}
