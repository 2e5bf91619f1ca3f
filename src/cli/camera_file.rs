//! Reads the camera of a scene, or of a picture that meniscus made.

use std::path::Path;

use anyhow::{Context, Result, bail};
use glam::DVec3;
use meniscus_formats::gltf::{CameraData, read_camera};
use meniscus_formats::{OutputFormat, UpAxis, read_provenance};

use crate::pipeline::{CAMERA, CameraChoice, open_regular, read_regular};

/// Reads the camera. `up` is the axis of the particles that the scene's y axis corresponds to.
///
/// # Errors
/// If the file has no camera.
pub(super) fn camera_of_file(path: &Path, up: Option<UpAxis>) -> Result<CameraChoice> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let camera = match &*extension {
        "glb" | "gltf" => camera_of_scene(path, up.unwrap_or_default()),
        "exr" => camera_of_picture(path, OutputFormat::Exr),
        "png" => camera_of_picture(path, OutputFormat::Png),
        _ => bail!(
            "{}: expected a .glb or .gltf with a camera, or a .exr or .png that meniscus wrote",
            path.display()
        ),
    };
    camera.with_context(|| path.display().to_string())
}

fn camera_of_picture(path: &Path, format: OutputFormat) -> Result<CameraChoice> {
    let pairs = read_provenance(format, open_regular(path)?)?;
    let Some((_, text)) = pairs.iter().find(|(name, _)| name == CAMERA) else {
        bail!("this picture does not record its camera: expected a picture that meniscus made");
    };
    text.parse().map_err(anyhow::Error::msg)
}

fn camera_of_scene(path: &Path, up: UpAxis) -> Result<CameraChoice> {
    let CameraData { eye, forward, up: top, view_radians } = read_camera(&read_regular(path)?)?;
    let rotated = |[x, y, z]: [f64; 3]| match up {
        UpAxis::Y => DVec3::new(x, y, z),
        UpAxis::Z => DVec3::new(x, -z, y),
    };
    let (eye, forward, top) = (rotated(eye), rotated(forward).normalize_or_zero(), rotated(top));
    let target = eye + forward;
    let text = |v: DVec3| format!("{}:{}:{}", v.x, v.y, v.z);
    let degrees = view_radians.to_degrees();
    let spec = format!(
        "eye={},target={},top={},view={degrees},up={}",
        text(eye),
        text(target),
        text(top),
        up.name()
    );
    spec.parse().map_err(anyhow::Error::msg)
}
