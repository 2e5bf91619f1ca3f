//! A pinhole camera, and its placement around a box.

use glam::{DQuat, DVec2, DVec3};

/// Which axis points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Up {
    /// Along y, as in glTF.
    Y,
    /// Along z.
    Z,
}

impl Up {
    /// Its unit vector.
    pub fn direction(self) -> DVec3 {
        match self {
            Up::Y => DVec3::Y,
            Up::Z => DVec3::Z,
        }
    }

    /// The direction from the box towards a camera of azimuth 0, which looks along −z if y is up, and along y
    /// if z is up.
    fn front(self) -> DVec3 {
        match self {
            Up::Y => DVec3::Z,
            Up::Z => DVec3::NEG_Y,
        }
    }
}

/// A pinhole camera in world space. `right`, `up` and `forward` are orthonormal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Its position, world units.
    pub eye: DVec3,
    /// Towards the right edge of the picture.
    pub right: DVec3,
    /// Towards the upper edge.
    pub up: DVec3,
    /// Into the picture.
    pub forward: DVec3,
    /// The tangent of half the vertical angle of view.
    pub tan_half_view: f64,
}

/// The placement of a camera relative to a box.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraPlacement {
    /// Azimuth, degrees; positive values place the camera farther to the right.
    pub azimuth_degrees: f64,
    /// Elevation above the horizon, degrees.
    pub elevation_degrees: f64,
    /// The vertical angle of view, degrees.
    pub view_degrees: f64,
    /// 1 fits the box; 2 shows it twice as large.
    pub zoom: f64,
    /// Which axis points up.
    pub up: Up,
}

impl CameraPlacement {
    /// From the right and a little above. From there, flat surfaces look flat, and the front of the scene
    /// hides little of the rest.
    pub const AUTO: CameraPlacement = CameraPlacement {
        azimuth_degrees: 32.0,
        elevation_degrees: 22.0,
        view_degrees: 30.0,
        zoom: 1.0,
        up: Up::Y,
    };

    /// The camera that shows a whole box, `least` to `greatest` in world units, in a picture with this aspect
    /// ratio (width / height).
    pub fn around(&self, [least, greatest]: [DVec3; 2], aspect: f64) -> Camera {
        let up = self.up.direction();
        let rotation = DQuat::from_axis_angle(up, self.azimuth_degrees.to_radians());
        let level = rotation * self.up.front();
        let elevation = self.elevation_degrees.to_radians();
        let backward = level * elevation.cos() + up * elevation.sin();
        let camera = Camera::looking_along(-backward, up, (self.view_degrees.to_radians() / 2.0).tan());
        let center = (least + greatest) / 2.0;
        let half = (greatest - least) / 2.0;
        let corners = (0..8).map(|corner| {
            let side = |bit: i32| if corner >> bit & 1 == 0 { -1.0 } else { 1.0 };
            half * DVec3::new(side(0), side(1), side(2))
        });
        let limit = DVec2::new(camera.tan_half_view * aspect, camera.tan_half_view) * MARGIN;
        let away = |corner: DVec3| {
            let lateral = DVec2::new(corner.dot(camera.right).abs(), corner.dot(camera.up).abs());
            (lateral / limit).max_element() - corner.dot(camera.forward)
        };
        let distance = corners.map(away).fold(f64::MIN_POSITIVE, f64::max) / self.zoom;
        Camera { eye: center - camera.forward * distance, ..camera }
    }
}

/// The box fills at most this fraction of the distance from the middle of the picture to each edge.
const MARGIN: f64 = 0.88;

impl Camera {
    /// A camera at the origin that looks along `forward`, with `up` as far up as possible.
    pub fn looking_along(forward: DVec3, up: DVec3, tan_half_view: f64) -> Camera {
        let forward = forward.normalize_or(DVec3::NEG_Z);
        let lateral = forward.cross(up);
        // Straight up or down, the right direction is undefined; choose one.
        let right = if lateral.length_squared() > 1e-12 {
            lateral.normalize()
        } else {
            forward.any_orthonormal_vector()
        };
        Camera { eye: DVec3::ZERO, right, up: right.cross(forward), forward, tan_half_view }
    }

    /// The unit direction of the ray through a point of the picture: x from -`aspect` to `aspect` to the
    /// right, y from -1 to 1 upwards.
    pub(super) fn direction(&self, point: DVec2) -> DVec3 {
        let lateral = self.right * point.x + self.up * point.y;
        (self.forward + lateral * self.tan_half_view).normalize()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_box_is_in_the_picture() {
        let boxes = [
            [DVec3::ZERO, DVec3::ONE],
            [DVec3::new(-5.0, 0.0, 2.0), DVec3::new(90.0, 0.1, 2.5)],
            [DVec3::splat(1e6), DVec3::splat(1e6) + DVec3::new(0.1, 7.0, 0.1)],
        ];
        for up in [Up::Y, Up::Z] {
            for (azimuth_degrees, elevation_degrees) in [(32.0, 22.0), (180.0, -40.0), (0.0, 90.0)] {
                for [least, greatest] in boxes {
                    let placement =
                        CameraPlacement { azimuth_degrees, elevation_degrees, up, ..CameraPlacement::AUTO };
                    let camera = placement.around([least, greatest], 16.0 / 9.0);
                    let mut farthest = 0f64;
                    for corner in 0..8 {
                        let pick =
                            |axis: usize| if corner >> axis & 1 == 0 { least[axis] } else { greatest[axis] };
                        let to = DVec3::new(pick(0), pick(1), pick(2)) - camera.eye;
                        let depth = to.dot(camera.forward) * camera.tan_half_view;
                        assert!(depth > 0.0, "a corner is behind the camera");
                        let lateral = to.dot(camera.right).abs() / depth / (16.0 / 9.0);
                        farthest = farthest.max(lateral).max(to.dot(camera.up).abs() / depth);
                    }
                    assert!((0.8..0.89).contains(&farthest), "{farthest} of the picture is filled");
                }
            }
        }
    }

    #[test]
    fn rays_match_the_coordinates_of_the_picture() {
        let camera =
            CameraPlacement { elevation_degrees: 0.0, azimuth_degrees: 0.0, ..CameraPlacement::AUTO }
                .around([DVec3::NEG_ONE, DVec3::ONE], 1.0);
        assert!(camera.direction(DVec2::ZERO).dot(DVec3::NEG_Z) > 0.999_999);
        assert!(
            camera.direction(DVec2::new(1.0, 0.0)).x > 0.0 && camera.direction(DVec2::new(0.0, 1.0)).y > 0.0
        );
    }
}
