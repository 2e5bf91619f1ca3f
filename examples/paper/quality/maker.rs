//! The programs that make the surfaces.

use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use meniscus::surface::mesh::PositionRounding;
use meniscus::surface::obstacle::{MeshSdf, Obstacles};
use meniscus::surface::options::{MethodOptions, SequenceSpacing, Settings};
use meniscus::surface::particles::ParticleCloud;
use meniscus::surface::reconstruction::{
    FrameSurface, ShapedSource, StagedFrame, reconstruct_cloud, shape_particles,
};
use meniscus::surface::temporal::{OtherFrame, TimedFrame};
use meniscus_formats::{Limits, MeshData, ply};

use super::estimate_of;
use super::sets::{Frame, Set};
use crate::Outcome;
use crate::splashsurf::{Post, Splashsurf};
use crate::surfaces::data;

pub(super) enum Maker {
    /// meniscus, with these settings. Smoothed frames are kept for the frames around them.
    Ours { settings: Vec<(String, String)>, smoothed: Mutex<Vec<Smoothed>> },
    /// splashsurf, with this cell size in spacings.
    Splashsurf { peer: Box<Splashsurf>, post: Post, cell: f64 },
    /// Another program that left a mesh for each frame in a folder.
    Meshes(PathBuf),
}

/// A smoothed frame of a set.
pub(super) struct Smoothed {
    set: String,
    number: usize,
    timed: Arc<TimedFrame>,
    /// The frame itself, until its surface is made.
    staged: Option<StagedFrame<ShapedSource<ParticleCloud>>>,
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
            Maker::Ours { settings, smoothed } => {
                let settings = settings_of(settings, set)?;
                let surface = if settings.temporal > 0 {
                    averaged(set, frame, &settings, &mut smoothed.lock().expect("one thread"))?
                } else {
                    reconstruct_cloud(cloud(frame), &settings, &Obstacles::default())
                };
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

fn cloud(frame: &Frame) -> ParticleCloud {
    ParticleCloud::from(frame.moving_particles().positions)
}

/// The surface of a frame, averaged with the frames of the set around it.
fn averaged(
    set: &Set,
    frame: &Frame,
    settings: &Settings,
    smoothed: &mut Vec<Smoothed>,
) -> Outcome<FrameSurface> {
    let reach = settings.temporal as usize;
    smoothed.retain(|kept| kept.set == set.name && kept.number + reach >= frame.number);
    let mut others = Vec::new();
    let mut own = None;
    for number in frame.number.saturating_sub(reach)..=frame.number + reach {
        let Some(other) = set.frame(number) else { continue };
        let is_known = smoothed
            .iter()
            .any(|kept| kept.number == number && (number != frame.number || kept.staged.is_some()));
        if !is_known {
            smoothed.retain(|kept| kept.number != number);
            let (shaped, stats) = shape_particles(cloud(other), settings);
            let staged = StagedFrame::rasterize(shaped, stats, Obstacles::default(), settings, None);
            let staged = staged.map_err(|_| "not in memory")?.smooth(settings, &mut |_| {})?;
            let band = Arc::new(staged.band().ok_or("not in memory")?.clone());
            let timed = Arc::new(TimedFrame::new(band, other.moving_particles(), settings.spacing));
            smoothed.push(Smoothed { set: set.name.clone(), number, timed, staged: Some(staged) });
        }
        let kept = smoothed.iter_mut().find(|kept| kept.number == number).ok_or("just made")?;
        if number == frame.number {
            own = kept.staged.take().map(|staged| (staged, Arc::clone(&kept.timed)));
        } else {
            let steps = i32::try_from(number)? - i32::try_from(frame.number)?;
            others.push(OtherFrame { frame: Arc::clone(&kept.timed), steps });
        }
    }
    let (mut staged, timed) = own.ok_or("just made")?;
    staged.average(&timed, &others, settings);
    let (surface, _) = staged.contour(settings, PositionRounding::Local).map_err(|_| "not in memory")?;
    Ok(surface)
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
