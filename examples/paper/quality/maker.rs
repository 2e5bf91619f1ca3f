//! The programs that make the surfaces.

use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use glam::DVec3;
use meniscus::surface::level_set::NarrowBand;
use meniscus::surface::mesh::PositionRounding;
use meniscus::surface::obstacle::{MeshSdf, Obstacles};
use meniscus::surface::options::{MethodOptions, SequenceSpacing, Settings};
use meniscus::surface::particles::{Attribute, AttributeValues, ParticleCloud, Role};
use meniscus::surface::reconstruction::{
    FrameSurface, ShapedSource, StagedFrame, reconstruct_cloud, shape_particles,
};
use meniscus::surface::space::Lattice;
use meniscus::surface::temporal::{OtherFrame, TemporalConfig, TimedFrame, average};
use meniscus_formats::{Limits, MeshData, ply};

use super::estimate_of;
use super::sets::{Frame, Kind, Set};
use crate::Outcome;
use crate::splashsurf::{Post, Splashsurf};
use crate::surfaces::{band_of, data};

pub(super) enum Maker {
    /// meniscus, with these settings.
    Ours { settings: Vec<(String, String)>, kept: Mutex<KeptFrames<Staged>> },
    /// splashsurf, with this cell size in spacings.
    Splashsurf { peer: Box<Splashsurf>, post: Post, cell: f64 },
    /// splashsurf, whose meshes become level sets that meniscus averages with this number of frames on each
    /// side: nothing is restored or clamped afterwards. With 0, they are only sampled.
    Averaged {
        peer: Box<Splashsurf>,
        post: Post,
        cell: f64,
        frames: u32,
        kept: Mutex<KeptFrames<(MeshData, NarrowBand)>>,
    },
    /// Another program that left a mesh for each frame in a folder.
    Meshes(PathBuf),
}

type Staged = StagedFrame<ShapedSource<ParticleCloud>>;

/// A surface, and the work that it took.
pub(super) struct MadeSurface {
    pub(super) mesh: MeshData,
    pub(super) solid: MeshSdf,
    /// The mesh without averages over time, if there are any.
    pub(super) unaveraged: Option<MeshData>,
    /// Voxels times smoothing passes; `None` if another program made the surface.
    pub(super) voxel_passes: Option<u64>,
    /// Whether the certificate holds; `None` if another program made the surface.
    pub(super) is_certified: Option<bool>,
}

impl Maker {
    /// Makes the surface of a frame.
    pub(super) fn make(&self, set: &Set, frame: &Frame) -> Outcome<MadeSurface> {
        let (mut voxel_passes, mut is_certified, mut unaveraged) = (None, None, None);
        let mesh = match self {
            Maker::Ours { settings, kept } => {
                let settings = settings_of(settings, set)?;
                let alone = || reconstruct_cloud(cloud(frame), &settings, &Obstacles::default());
                let surface = if settings.temporal > 0 {
                    unaveraged = matches!(set.kind, Kind::Moving { .. }).then(|| data(&alone()));
                    averaged(set, frame, &settings, &mut kept.lock().expect("one thread"))?
                } else {
                    alone()
                };
                voxel_passes = Some(surface.report.smoothing.voxel_update_count);
                is_certified = Some(surface.report.certificate.holds());
                data(&surface)
            }
            Maker::Splashsurf { peer, post, cell } => {
                peer.reconstruct(&frame.points, set.spacing, cell * set.spacing, *post)?
            }
            Maker::Averaged { peer, post, cell, frames, kept } => {
                let mesh =
                    |frame: &Frame| peer.reconstruct(&frame.points, set.spacing, cell * set.spacing, *post);
                let mut kept = kept.lock().expect("one thread");
                let (own, averaged) =
                    averaged_meshes(set, frame, cell * set.spacing, *frames, &mut kept, mesh)?;
                unaveraged = Some(own);
                averaged
            }
            Maker::Meshes(folder) => {
                let path = folder.join(set.file_name(frame));
                let bytes = fs::read(&path).map_err(|error| format!("{}: {error}", path.display()))?;
                ply::read_mesh(&bytes, &Limits::default())?
            }
        };
        let solid = MeshSdf::new(&mesh.positions, &mesh.triangles);
        Ok(MadeSurface { mesh, solid, unaveraged, voxel_passes, is_certified })
    }
}

fn cloud(frame: &Frame) -> ParticleCloud {
    let radii = frame.radii.iter().map(|radii| Attribute {
        name: RADII.into(),
        role: Role::Radius,
        arity: 1,
        values: AttributeValues::Numbers(radii.clone()),
    });
    ParticleCloud { attributes: radii.collect(), ..ParticleCloud::from(frame.moving_particles().positions) }
}

/// The attribute with the radii of particles that have their own.
pub(super) const RADII: &str = "pscale";

/// Frames of a set that the frames beside them need, too. `T` is what the surface of a frame is made from.
pub(super) struct KeptFrames<T>(Vec<KeptFrame<T>>);

impl<T> Default for KeptFrames<T> {
    fn default() -> KeptFrames<T> {
        KeptFrames(Vec::new())
    }
}

struct KeptFrame<T> {
    set: String,
    number: usize,
    timed: Arc<TimedFrame>,
    /// `None` once the surface is made.
    own: Option<T>,
}

/// A frame, and the frames around it.
struct Around<T> {
    own: T,
    timed: Arc<TimedFrame>,
    others: Vec<OtherFrame>,
}

impl<T> KeptFrames<T> {
    /// A frame, and those of the set that are at most `frames` away. `make` makes those that are not kept.
    fn around(
        &mut self,
        set: &Set,
        frame: &Frame,
        frames: u32,
        make: impl Fn(&Frame) -> Outcome<(T, Arc<TimedFrame>)>,
    ) -> Outcome<Around<T>> {
        let (kept, reach) = (&mut self.0, frames as usize);
        kept.retain(|kept| kept.set == set.name && kept.number + reach >= frame.number);
        let mut others = Vec::new();
        let mut middle = None;
        for number in frame.number.saturating_sub(reach)..=frame.number + reach {
            let Some(other) = set.frame(number) else { continue };
            let serves =
                |kept: &KeptFrame<T>| kept.number == number && (number != frame.number || kept.own.is_some());
            if !kept.iter().any(serves) {
                kept.retain(|kept| kept.number != number);
                let (own, timed) = make(other)?;
                kept.push(KeptFrame { set: set.name.clone(), number, timed, own: Some(own) });
            }
            let found = kept.iter_mut().find(|kept| kept.number == number).ok_or("just made")?;
            let timed = Arc::clone(&found.timed);
            if number == frame.number {
                middle = found.own.take().map(|own| (own, timed));
            } else {
                let steps = i32::try_from(number)? - i32::try_from(frame.number)?;
                others.push(OtherFrame { frame: timed, steps });
            }
        }
        let (own, timed) = middle.ok_or("just made")?;
        Ok(Around { own, timed, others })
    }
}

/// The surface of a frame, averaged with the frames of the set around it.
fn averaged(
    set: &Set,
    frame: &Frame,
    settings: &Settings,
    kept: &mut KeptFrames<Staged>,
) -> Outcome<FrameSurface> {
    let make = |frame: &Frame| {
        let (shaped, stats) = shape_particles(cloud(frame), settings);
        let staged = StagedFrame::rasterize(shaped, stats, Obstacles::default(), settings, None);
        let staged = staged.map_err(|_| "not in memory")?.smooth(settings, &mut |_| {})?;
        let timed = staged.timed(frame.moving_particles(), settings).ok_or("not in memory")?;
        Ok((staged, timed))
    };
    let Around { own: mut staged, timed, others } = kept.around(set, frame, settings.temporal, make)?;
    staged.average(&timed, &others, settings);
    let (surface, _) = staged.contour(settings, PositionRounding::Local).map_err(|_| "not in memory")?;
    Ok(surface)
}

/// The mesh of a frame, and the surface of its level set, averaged with those of the frames around it.
fn averaged_meshes(
    set: &Set,
    frame: &Frame,
    voxel_size: f64,
    frames: u32,
    kept: &mut KeptFrames<(MeshData, NarrowBand)>,
    mesh: impl Fn(&Frame) -> Outcome<MeshData>,
) -> Outcome<(MeshData, MeshData)> {
    let make = |frame: &Frame| {
        let mesh = mesh(frame)?;
        let band = band_of(&mesh, voxel_size, HALF_WIDTH);
        let timed = TimedFrame::new(Arc::new(band.clone()), frame.moving_particles(), set.spacing);
        Ok(((mesh, band), Arc::new(timed)))
    };
    let Around { own: (own, mut averaged), timed, others } = kept.around(set, frame, frames, make)?;
    let config =
        TemporalConfig { frames, seconds: None, spacing: set.spacing, lattice: Lattice { voxel_size } };
    average(&mut averaged, &timed, &others, &config);
    let settings = Settings::paper(voxel_size, &MethodOptions::default())?;
    let staged = StagedFrame::<ParticleCloud>::of_level_set(averaged, DVec3::ZERO, 0.0, &settings);
    let (surface, _) = staged.contour(&settings, PositionRounding::Local).map_err(|_| "not in memory")?;
    Ok((own, data(&surface)))
}

/// The half width of these level sets, in voxels: two spacings with cells of a quarter of the spacing. The level
/// sets of other frames must reach as far as particles scatter.
const HALF_WIDTH: f32 = 8.0;

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
    let mut choices = choices.ok_or("a setting has an unknown name or an invalid value")?;
    let radii = set.frames.first().and_then(|frame| frame.radii.as_ref());
    if radii.is_some() && choices.radius_attribute.is_none() {
        choices.radius_attribute = Some(RADII.into());
    }
    let estimate = if choices.is_auto() { estimate_of(set) } else { None };
    let irregularity = estimate.and_then(|estimate| estimate.irregularity);
    let radius_median = radii.map(|_| 0.5 * set.spacing * choices.radius_scale.unwrap_or(1.0));
    let measured = SequenceSpacing { spacing: set.spacing, radius_median, irregularity };
    Ok(Settings::resolve(&choices, Some(measured))?)
}
