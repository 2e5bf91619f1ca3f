//! The programs that make the surfaces.

use std::fs;
use std::path::PathBuf;
use std::time::Instant;

use glam::DVec3;
use meniscus::surface::obstacle::{MeshSdf, Obstacles};
use meniscus::surface::options::{MethodOptions, SequenceSpacing, Settings};
use meniscus::surface::particles::{OwnedPositions, ParticleCloud};
use meniscus::surface::reconstruction::reconstruct_cloud;
use meniscus_formats::{Limits, MeshData, ply};

use super::estimate_of;
use super::sets::{Frame, Set};
use crate::Outcome;
use crate::splashsurf::{Post, Splashsurf};
use crate::surfaces::data;

pub(super) enum Maker {
    /// meniscus, with these settings.
    Ours(Vec<(String, String)>),
    /// splashsurf, with this cell size in spacings.
    Splashsurf { peer: Box<Splashsurf>, post: Post, cell: f64 },
    /// Another program that left a mesh for each frame in a folder.
    Meshes(PathBuf),
}

/// A surface and its cost.
pub(super) struct MadeSurface {
    pub(super) mesh: MeshData,
    pub(super) solid: MeshSdf,
    /// Voxels times smoothing passes; `None` if another program made the surface.
    pub(super) voxel_passes: Option<u64>,
    /// Whether the certificate holds; `None` if another program made the surface.
    pub(super) is_certified: Option<bool>,
    pub(super) seconds: f64,
}

impl Maker {
    /// Makes the surface of a frame.
    pub(super) fn make(&self, set: &Set, frame: &Frame) -> Outcome<MadeSurface> {
        let start = Instant::now();
        let (mut voxel_passes, mut is_certified) = (None, None);
        let (mesh, seconds) = match self {
            Maker::Ours(pairs) => {
                let settings = settings_of(pairs, set)?;
                let positions = OwnedPositions::F64(frame.points.iter().map(DVec3::to_array).collect());
                let surface =
                    reconstruct_cloud(ParticleCloud::from(positions), &settings, &Obstacles::default());
                voxel_passes = Some(surface.report.smoothing.voxel_update_count);
                is_certified = Some(surface.report.certificate.holds());
                (data(&surface), start.elapsed().as_secs_f64())
            }
            Maker::Splashsurf { peer, post, cell } => {
                let mesh = peer.reconstruct(&frame.points, set.spacing, cell * set.spacing, *post)?;
                (mesh, start.elapsed().as_secs_f64())
            }
            Maker::Meshes(folder) => {
                let path = folder.join(set.file_name(frame));
                let bytes = fs::read(&path).map_err(|error| format!("{}: {error}", path.display()))?;
                (ply::read_mesh(&bytes, &Limits::default())?, seconds_in(&bytes).unwrap_or(f64::NAN))
            }
        };
        let solid = MeshSdf::new(&mesh.positions, &mesh.triangles);
        Ok(MadeSurface { mesh, solid, voxel_passes, is_certified, seconds })
    }
}

/// Settings from text. Names that end in `/d` are lengths in spacings. The spacing is the true one, but the preset
/// `auto` is chosen by measured particles.
fn settings_of(pairs: &[(String, String)], set: &Set) -> Outcome<Settings> {
    let mut texts = Vec::new();
    for (name, value) in pairs {
        match name.strip_suffix("/d") {
            Some(name) => texts.push((name, (value.parse::<f64>()? * set.spacing).to_string())),
            None => texts.push((name.as_str(), value.clone())),
        }
    }
    let choices = MethodOptions::from_pairs(texts.iter().map(|(name, value)| (*name, value.as_str())));
    let choices = choices.ok_or("a setting has an unknown name or an invalid value")?;
    let estimate = if choices.is_auto() { estimate_of(set) } else { None };
    let irregularity = estimate.and_then(|estimate| estimate.irregularity);
    let measured = SequenceSpacing { irregularity, ..SequenceSpacing::from(set.spacing) };
    Ok(Settings::resolve(&choices, Some(measured))?)
}

/// The value of the line `comment seconds S` in the header.
fn seconds_in(ply: &[u8]) -> Option<f64> {
    let head = String::from_utf8_lossy(&ply[..ply.len().min(1000)]);
    head.lines().find_map(|line| line.strip_prefix("comment seconds "))?.trim().parse().ok()
}
