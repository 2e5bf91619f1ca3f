//! Camera options and viewpoints as text: on the command line, in the records and in pictures.
//!
//! ```text
//!   azimuth=32,elevation=22,view=30,zoom=1,up=z      around the subject: fits the bounds of the frames
//!   eye=1:2:3,target=0:0:0,view=40,up=y              fixed
//!                 │ with bounds
//!                 ▼
//!   eye=…,target=…,top=…,view=…,up=y,ground=0        a viewpoint: the same picture for any bounds
//! ```
//!
//! The text of a viewpoint fully determines a picture's camera. Numbers have the shortest form that reads
//! back as the same number, so the same text always gives the same picture.

use std::fmt;
use std::str::FromStr;

use glam::DVec3;
use meniscus_formats::PictureCamera;

use crate::render::{Camera, CameraPlacement, Up, View};

/// The camera that the user requested.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraChoice {
    position: CameraPosition,
    /// The vertical angle of view, in degrees.
    view_degrees: Option<f64>,
    up: Option<Up>,
    /// The height of the ground, world units; by default the minimum of the bounds.
    ground: Option<Ground>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum CameraPosition {
    /// Around the subject.
    Around { azimuth_degrees: Option<f64>, elevation_degrees: Option<f64>, zoom: Option<f64> },
    /// Fixed, in world units. `top` is the up direction of the picture.
    At { eye: DVec3, target: DVec3, top: Option<DVec3> },
}

impl Default for CameraPosition {
    fn default() -> CameraPosition {
        CameraPosition::Around { azimuth_degrees: None, elevation_degrees: None, zoom: None }
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Ground {
    None,
    At(f64),
}

/// A fixed camera, with the up axis of the world and the height of the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Viewpoint {
    /// The position of the camera, world units.
    pub eye: DVec3,
    /// The point in the middle of the picture, world units.
    pub target: DVec3,
    /// The up direction of the picture, as close as the direction of view allows.
    pub top: DVec3,
    /// The vertical angle of view, in degrees.
    pub view_degrees: f64,
    /// The up axis of the world.
    pub up: Up,
    /// The height of the ground, world units; `None` for no ground.
    pub ground: Option<f64>,
}

impl CameraChoice {
    /// The viewpoint that shows these bounds (minimum and maximum corner in world units) in pictures of this
    /// aspect ratio (width over height). `up` is the default up axis.
    pub fn viewpoint(&self, bounds: [DVec3; 2], aspect: f64, up: Up) -> Viewpoint {
        let up = self.up.unwrap_or(up);
        let view_degrees = self.view_degrees.unwrap_or(CameraPlacement::AUTO.view_degrees);
        let ground = match self.ground {
            None => Some(bounds[0].dot(up.direction())),
            Some(Ground::At(height)) => Some(height),
            Some(Ground::None) => None,
        };
        let (eye, target, top) = match self.position {
            CameraPosition::At { eye, target, top } => (eye, target, top.unwrap_or(up.direction())),
            CameraPosition::Around { azimuth_degrees, elevation_degrees, zoom } => {
                let placement = CameraPlacement {
                    azimuth_degrees: azimuth_degrees.unwrap_or(CameraPlacement::AUTO.azimuth_degrees),
                    elevation_degrees: elevation_degrees.unwrap_or(CameraPlacement::AUTO.elevation_degrees),
                    zoom: zoom.unwrap_or(CameraPlacement::AUTO.zoom),
                    view_degrees,
                    up,
                };
                let camera = placement.around(bounds, aspect);
                (camera.eye, (bounds[0] + bounds[1]) / 2.0, camera.up)
            }
        };
        Viewpoint { eye, target, top, view_degrees, up, ground }
    }

    /// The requested up axis, or else `up`.
    pub fn up_or(&self, up: Up) -> Up {
        self.up.unwrap_or(up)
    }

    /// Whether the camera is placed around the subject.
    pub(crate) fn is_orbit(&self) -> bool {
        matches!(self.position, CameraPosition::Around { .. })
    }

    /// The same camera; a camera that zooms in is moved back until all of the bounds are in view.
    pub(crate) fn not_zoomed_in(mut self) -> CameraChoice {
        if let CameraPosition::Around { zoom: Some(zoom), .. } = &mut self.position {
            *zoom = zoom.min(1.0);
        }
        self
    }

    /// Whether the viewpoint depends on the bounds of the subject.
    pub fn needs_bounds(&self) -> bool {
        matches!(self.position, CameraPosition::Around { .. }) || self.ground.is_none()
    }
}

impl From<Viewpoint> for CameraChoice {
    fn from(viewpoint: Viewpoint) -> CameraChoice {
        let Viewpoint { eye, target, top, view_degrees, up, ground } = viewpoint;
        CameraChoice {
            position: CameraPosition::At { eye, target, top: Some(top) },
            view_degrees: Some(view_degrees),
            up: Some(up),
            ground: Some(ground.map_or(Ground::None, Ground::At)),
        }
    }
}

impl Viewpoint {
    /// The renderer's view from this viewpoint, for pictures of this size.
    pub fn view(&self, size: [usize; 2]) -> View {
        View { size, camera: self.camera(), up: self.up, ground: self.ground }
    }

    fn camera(&self) -> Camera {
        let tan_half_view = (self.view_degrees.to_radians() / 2.0).tan();
        let camera = Camera::looking_along(self.target - self.eye, self.top, tan_half_view);
        Camera { eye: self.eye, ..camera }
    }

    /// Whether pictures with this aspect ratio (width over height) show all of these bounds.
    pub(crate) fn contains(&self, [least, greatest]: [DVec3; 2], aspect: f64) -> bool {
        let Camera { eye, right, up, forward, tan_half_view } = self.camera();
        (0..8).all(|corner| {
            let side = |axis: usize| if corner >> axis & 1 == 0 { least[axis] } else { greatest[axis] };
            let away = DVec3::new(side(0), side(1), side(2)) - eye;
            let half = away.dot(forward) * tan_half_view;
            away.dot(right).abs() <= half * aspect && away.dot(up).abs() <= half
        })
    }

    /// The same viewpoint, turned to the right around its target by this many degrees.
    pub fn rotated(&self, degrees: f64) -> Viewpoint {
        let rotation = glam::DQuat::from_axis_angle(self.up.direction(), degrees.to_radians());
        Viewpoint {
            eye: self.target + rotation * (self.eye - self.target),
            top: rotation * self.top,
            ..*self
        }
    }

    /// The same viewpoint, with all its positions moved by `by`.
    pub fn moved(&self, by: DVec3) -> Viewpoint {
        let ground = self.ground.map(|height| height + by.dot(self.up.direction()));
        Viewpoint { eye: self.eye + by, target: self.target + by, ground, ..*self }
    }

    /// The matrices for pictures with this aspect ratio (width over height).
    pub fn matrices(&self, aspect: f64) -> PictureCamera {
        let Camera { eye, right, up, forward, tan_half_view } = self.camera();
        let camera = [right, up, forward].map(|axis| [axis.x, axis.y, axis.z, -axis.dot(eye)]);
        let [across, along, depth] = camera;
        // After the division by the depth, x goes from 0 to 1 to the right, and y from 0 to 1 downwards.
        let ndc = |axis: [f64; 4], scale: f64| -> [f64; 4] {
            std::array::from_fn(|i| 0.5 * depth[i] + axis[i] * scale)
        };
        let nearer = ndc(across, 0.5 / (tan_half_view * aspect));
        let lower = ndc(along, -0.5 / tan_half_view);
        PictureCamera {
            world_to_camera: columns([across, along, depth, [0.0, 0.0, 0.0, 1.0]]),
            world_to_ndc: columns([nearer, lower, depth, depth]),
        }
    }
}

/// The matrix with these columns, in row-major order.
fn columns(columns: [[f64; 4]; 4]) -> [f32; 16] {
    std::array::from_fn(|index| columns[index % 4][index / 4] as f32)
}

impl fmt::Display for Viewpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        CameraChoice::from(*self).fmt(f)
    }
}

impl fmt::Display for CameraChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut pairs: Vec<String> = Vec::new();
        let mut number = |name: &str, value: Option<f64>| {
            pairs.extend(value.map(|value| format!("{name}={value}")));
        };
        match self.position {
            CameraPosition::Around { azimuth_degrees, elevation_degrees, zoom } => {
                number("azimuth", azimuth_degrees);
                number("elevation", elevation_degrees);
                number("zoom", zoom);
            }
            CameraPosition::At { eye, target, top } => {
                pairs.push(format!("eye={}", triple(eye)));
                pairs.push(format!("target={}", triple(target)));
                pairs.extend(top.map(|top| format!("top={}", triple(top))));
            }
        }
        pairs.extend(self.view_degrees.map(|degrees| format!("view={degrees}")));
        pairs.extend(self.up.map(|up| format!("up={}", if up == Up::Y { "y" } else { "z" })));
        pairs.extend(self.ground.map(|ground| match ground {
            Ground::None => "ground=none".to_owned(),
            Ground::At(height) => format!("ground={height}"),
        }));
        if pairs.is_empty() {
            return f.write_str(AUTO);
        }
        f.write_str(&pairs.join(","))
    }
}

fn triple(v: DVec3) -> String {
    format!("{}:{}:{}", v.x, v.y, v.z)
}

/// The largest allowed coordinate, world units: beyond it, a camera could not be turned.
const COORDINATE_MAX: f64 = 1e15;

/// The text of the default camera, which fits the bounds of the subject.
const AUTO: &str = "auto";

impl FromStr for CameraChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<CameraChoice, String> {
        let mut typed = ParsedCamera::default();
        if text.trim() != AUTO {
            for pair in text.split(',') {
                let Some((key, value)) = pair.split_once('=') else {
                    return Err(format!("`{pair}`: expected {AUTO}, or a list of key=value: {KEYS}"));
                };
                typed.set(key.trim(), value.trim())?;
            }
        }
        typed.choice()
    }
}

/// The keys that have been parsed.
#[derive(Default)]
struct ParsedCamera {
    azimuth: Option<f64>,
    elevation: Option<f64>,
    zoom: Option<f64>,
    eye: Option<DVec3>,
    target: Option<DVec3>,
    top: Option<DVec3>,
    view: Option<f64>,
    up: Option<Up>,
    ground: Option<Ground>,
}

impl ParsedCamera {
    fn set(&mut self, key: &str, value: &str) -> Result<(), String> {
        let wrong = |expected: &str| format!("{key}=`{value}`: expected {expected}");
        let number = || value.parse().ok().filter(|number: &f64| number.is_finite());
        let within = |least: f64, greatest: f64, expected: &str| {
            number().filter(|number| (least..=greatest).contains(number)).ok_or_else(|| wrong(expected))
        };
        let is_near = |point: &DVec3| point.abs().max_element() <= COORDINATE_MAX;
        let point = || {
            let expected = "three numbers separated by colons, such as 1:2:3, each at most 1e15";
            vector(value).filter(is_near).ok_or_else(|| wrong(expected))
        };
        match key {
            "azimuth" => put(&mut self.azimuth, key, within(-360.0, 360.0, "degrees from -360 to 360")?),
            "elevation" => put(&mut self.elevation, key, within(-90.0, 90.0, "degrees from -90 to 90")?),
            "zoom" => put(&mut self.zoom, key, within(0.01, 100.0, "a number from 0.01 to 100")?),
            "view" => put(&mut self.view, key, within(1.0, 150.0, "degrees from 1 to 150")?),
            "eye" => put(&mut self.eye, key, point()?),
            "target" => put(&mut self.target, key, point()?),
            "top" => put(&mut self.top, key, point()?),
            "up" => match value {
                "y" => put(&mut self.up, key, Up::Y),
                "z" => put(&mut self.up, key, Up::Z),
                _ => Err(wrong("y or z")),
            },
            "ground" if value == "none" => put(&mut self.ground, key, Ground::None),
            "ground" => {
                let height = number().ok_or_else(|| wrong("a height in world units, or none"))?;
                put(&mut self.ground, key, Ground::At(height))
            }
            _ => Err(format!("unknown key `{key}`: expected one of {KEYS}")),
        }
    }

    fn choice(self) -> Result<CameraChoice, String> {
        let ParsedCamera { azimuth, elevation, zoom, eye, target, top, view, up, ground } = self;
        let is_around = azimuth.is_some() || elevation.is_some() || zoom.is_some();
        let position = match (eye, target) {
            (Some(_), Some(_)) if is_around => {
                return Err("eye and target fix the camera: leave out azimuth, elevation and zoom".into());
            }
            (Some(eye), Some(target)) if eye == target => {
                return Err("eye and target: expected two different places".into());
            }
            (Some(eye), Some(target)) => CameraPosition::At { eye, target, top },
            (Some(_), None) => return Err("eye without target: expected both".into()),
            (None, Some(_)) => return Err("target without eye: expected both".into()),
            (None, None) if top.is_some() => {
                return Err("top without eye and target: expected all three".into());
            }
            (None, None) => {
                CameraPosition::Around { azimuth_degrees: azimuth, elevation_degrees: elevation, zoom }
            }
        };
        Ok(CameraChoice { position, view_degrees: view, up, ground })
    }
}

fn put<T>(into: &mut Option<T>, key: &str, value: T) -> Result<(), String> {
    match into.replace(value) {
        None => Ok(()),
        Some(_) => Err(format!("{key} is given twice")),
    }
}

fn vector(text: &str) -> Option<DVec3> {
    let numbers: Vec<f64> =
        text.split(':').map(|number| number.trim().parse().ok()).collect::<Option<_>>()?;
    let &[x, y, z] = &numbers[..] else { return None };
    Some(DVec3::new(x, y, z)).filter(|v| v.is_finite())
}

const KEYS: &str = "azimuth, elevation, zoom; or eye, target, top; and view, up, ground";

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> CameraChoice {
        text.parse().expect("a camera")
    }

    #[test]
    fn formatted_camera_parses_to_the_same_camera() {
        for text in [
            "auto",
            "azimuth=10,elevation=-20.5,zoom=2,view=40,up=z,ground=none",
            "eye=1:2:3,target=0:0:0.1,top=0:1:0,view=40,up=y,ground=-0.25",
        ] {
            assert_eq!(parsed(text).to_string(), text);
        }
    }

    #[test]
    fn invalid_camera_names_its_fault_and_the_expected_value() {
        for (text, expected) in [
            ("", "key=value"),
            ("zoom", "`zoom`: expected auto, or a list"),
            ("azimut=3", "unknown key `azimut`: expected one of azimuth"),
            ("azimuth=east", "azimuth=`east`: expected degrees"),
            ("view=0", "view=`0`: expected degrees from 1"),
            ("up=x", "up=`x`: expected y or z"),
            ("eye=1:2,target=0:0:0", "eye=`1:2`: expected three numbers"),
            ("eye=1:2:nan,target=0:0:0", "eye="),
            ("eye=1:2:3", "without target"),
            ("eye=1:1:1,target=1:1:1", "two different places"),
            ("eye=1:2:3,target=0:0:0,zoom=2", "leave out"),
            ("zoom=2,zoom=3", "zoom is given twice"),
        ] {
            let error = text.parse::<CameraChoice>().expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
    }

    #[test]
    fn viewpoint_parses_from_its_text() {
        let bounds = [DVec3::new(-1.1, 0.3, 2.7), DVec3::new(5.2, 1.9, 3.3)];
        for text in ["auto", "azimuth=117.3,elevation=90,up=z", "eye=1:2:3,target=0.1:0:0,view=40"] {
            let viewpoint = parsed(text).viewpoint(bounds, 16.0 / 9.0, Up::Y);
            let again = parsed(&viewpoint.to_string()).viewpoint([DVec3::ZERO; 2], 1.0, Up::Z);
            assert_eq!(again, viewpoint, "{text}");
            assert_eq!(again.view([16, 9]), viewpoint.view([16, 9]));
        }
    }

    #[test]
    fn matrices_project_target_to_the_middle_and_a_corner_to_the_corner() {
        let viewpoint = parsed("eye=0:0:5,target=0:0:0,view=90").viewpoint([DVec3::ZERO; 2], 2.0, Up::Y);
        let matrices = viewpoint.matrices(2.0);
        let apply = |m: &[f32; 16], p: [f32; 4]| -> [f32; 4] {
            std::array::from_fn(|column| (0..4).map(|row| p[row] * m[4 * row + column]).sum())
        };
        assert_eq!(apply(&matrices.world_to_camera, [1.0, 2.0, 3.0, 1.0]), [1.0, 2.0, 2.0, 1.0]);
        let [x, y, _, w] = apply(&matrices.world_to_ndc, [10.0, 5.0, 0.0, 1.0]);
        // The angle of view is 90 degrees, so the camera is as far away as half the picture is high.
        assert!((x / w - 1.0).abs() < 1e-6 && (y / w).abs() < 1e-6, "{x} {y} {w}");
    }

    #[test]
    fn full_turn_returns_to_the_start() {
        let viewpoint = parsed("auto").viewpoint([DVec3::ZERO, DVec3::ONE], 1.0, Up::Z);
        assert!(viewpoint.rotated(360.0).eye.distance(viewpoint.eye) < 1e-12);
        let half = viewpoint.rotated(180.0);
        assert!((half.eye + viewpoint.eye - 2.0 * viewpoint.target).truncate().length() < 1e-12);
    }
}
