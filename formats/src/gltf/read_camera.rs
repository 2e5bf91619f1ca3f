//! Reads the camera of a glTF file, as placed by its default scene.

use ::gltf::camera::Projection;
use serde::Deserialize;
use serde::de::IgnoredAny;

use super::FORMAT;
use super::chunks::{chunks, parse};
use super::read::{document, placed};
use crate::error::{Error, Position, Result};

/// A perspective camera. The directions are not normalized.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraData {
    /// Position, world units.
    pub eye: [f64; 3],
    /// Viewing direction.
    pub forward: [f64; 3],
    /// Up direction of the picture.
    pub up: [f64; 3],
    /// Vertical field of view, in radians.
    pub view_radians: f64,
}

/// Reads the first camera of the default scene, or of the first scene.
///
/// # Errors
///
/// [`Error::Invalid`] for a damaged file; [`Error::Unsupported`] if there is no camera, or only an
/// orthographic one.
pub fn read_camera(bytes: &[u8]) -> Result<CameraData> {
    let (json, _) = chunks(bytes)?;
    let document = document(json)?;
    let transforms = parse(json)?;
    let Cameras { cameras: cameras_of } = parse(json)?;
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else {
        return Err(Error::unsupported(
            FORMAT,
            "the file has no scene and no camera: export the scene with its camera",
        ));
    };
    let cameras = placed(&scene, &transforms, |node| node.camera())?;
    let Some((camera, placement)) = cameras.first() else {
        return Err(Error::unsupported(FORMAT, "the file has no camera: export it with the scene"));
    };
    if !cameras_of.iter().all(CameraEntry::has_its_kind) {
        return Err(Error::invalid(FORMAT, Position::File, "a camera lacks the parameters of its type"));
    }
    let Projection::Perspective(perspective) = camera.projection() else {
        return Err(Error::unsupported(FORMAT, "the camera is orthographic: use a perspective camera"));
    };
    let [_, up, backward] = placement.axes;
    Ok(CameraData {
        eye: placement.translation,
        forward: backward.map(|along| -along),
        up,
        view_radians: f64::from(perspective.yfov()),
    })
}

/// The fields of cameras that the crate gltf does not validate.
#[derive(Deserialize)]
struct Cameras {
    #[serde(default)]
    cameras: Vec<CameraEntry>,
}

#[derive(Deserialize)]
struct CameraEntry {
    #[serde(rename = "type")]
    kind: String,
    perspective: Option<IgnoredAny>,
    orthographic: Option<IgnoredAny>,
}

impl CameraEntry {
    fn has_its_kind(&self) -> bool {
        match &*self.kind {
            "perspective" => self.perspective.is_some(),
            _ => self.orthographic.is_some(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(camera: &str) -> String {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
                "nodes":[{{"translation":[1,2,3],"children":[1]}},
                         {{"rotation":[0,0.7071067811865476,0,0.7071067811865476],"camera":0}}],
                "cameras":[{camera}]}}"#
        )
    }

    #[test]
    fn camera_is_placed_by_its_nodes() {
        let text = scene(r#"{"type":"perspective","perspective":{"yfov":0.5,"znear":0.1}}"#);
        let camera = read_camera(text.as_bytes()).expect("a camera");
        assert_eq!((camera.eye, camera.view_radians), ([1.0, 2.0, 3.0], 0.5));
        let is_near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|axis| (a[axis] - b[axis]).abs() < 1e-9);
        // A quarter turn to the left: from −z to −x.
        assert!(
            is_near(camera.forward, [-1.0, 0.0, 0.0]) && is_near(camera.up, [0.0, 1.0, 0.0]),
            "{camera:?}"
        );
    }

    #[test]
    fn missing_and_invalid_cameras_are_errors() {
        let orthographic =
            scene(r#"{"type":"orthographic","orthographic":{"xmag":1,"ymag":1,"znear":0.1,"zfar":9}}"#);
        let none = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{}]}"#;
        // Cameras with the parameters of the other type, or without any.
        let crossed = [
            scene(r#"{"type":"perspective","orthographic":{"xmag":1,"ymag":1,"znear":0.1,"zfar":9}}"#),
            scene(r#"{"type":"orthographic","perspective":{"yfov":0.5,"znear":0.1}}"#),
            scene(r#"{"type":"perspective"}"#),
        ];
        for text in crossed {
            let error = read_camera(text.as_bytes()).expect_err(&text).to_string();
            assert!(error.contains("lacks the parameters of its type"), "{error}");
        }
        for (text, words) in [(&*orthographic, "orthographic"), (none, "no camera"), ("{}", "")] {
            let error = read_camera(text.as_bytes()).expect_err(text).to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}
