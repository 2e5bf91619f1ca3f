//! Reads level sets from .vdb files, for pictures and surfaces.

use std::io;
use std::ops::RangeInclusive;
use std::path::Path;

use glam::{DVec3, IVec3};
use meniscus_formats::compression::read_head;
use meniscus_formats::vdb::{self, LevelSetData, Transform, VectorGridData};
use meniscus_formats::{Error, Format, Limits, Position, Probe, ProbedKind, probe};
use twox_hash::XxHash3_128;

use crate::surface::grid::{Field, LEAF_EDGE, LEAF_VOXELS, Leaf, Topology};
use crate::surface::level_set::{
    NarrowBand, StoredLevelSet, TooManyLeaves, rebuilding_leaf_count_max, rebuilt,
};
use crate::surface::space::{INDEX_LIMIT, Lattice};

use crate::pipeline::error::{FrameError, Stage};
use crate::pipeline::files::open::{open_regular, read_regular};
use crate::pipeline::memory::reading_limits;
use crate::pipeline::target::outputs::OutputOptions;
use crate::pipeline::target::picture::PictureScene;
use crate::pipeline::warning::Warning;
use crate::surface::words::pluralize;

/// A level set that was read from a file.
#[derive(Clone, Debug)]
pub struct LevelSetFile {
    band: NarrowBand,
    lattice: Lattice,
    origin: DVec3,
    velocity: Option<[Field; 3]>,
    /// The name of the grid.
    name: String,
    /// The class of the grid, according to the file.
    class: String,
    /// The XXH3 hash of the file, 128 bits.
    pub hash: u128,
    /// Warnings from reading the file.
    pub warnings: Vec<Warning>,
}

impl LevelSetFile {
    /// Reads the level set of a .vdb, with its velocities if `wants_velocity` is set, within a memory limit.
    ///
    /// # Errors
    /// When the system reports an error, or the file has no readable level set, or it needs more memory.
    pub fn read(path: &Path, wants_velocity: bool, memory_bytes: u64) -> Result<LevelSetFile, FrameError> {
        let bytes = read_regular(path).map_err(|error| FrameError::file(path, Stage::Read, error))?;
        LevelSetFile::of_bytes(path, &bytes, wants_velocity, memory_bytes)
    }

    /// Parses the bytes of a .vdb as [`read`](LevelSetFile::read) does, with a memory limit.
    ///
    /// # Errors
    /// When the file has no readable level set, or it needs more memory.
    pub(crate) fn of_bytes(
        path: &Path,
        bytes: &[u8],
        wants_velocity: bool,
        memory_bytes: u64,
    ) -> Result<LevelSetFile, FrameError> {
        let fail = |error| FrameError::file(path, Stage::Read, error);
        let hash = XxHash3_128::oneshot(bytes);
        refuse_other_format(bytes).map_err(fail)?;
        let limits = Limits::within(memory_bytes);
        let data = vdb::read_level_set(bytes, None, &limits).map_err(fail)?;
        let transform = data.transform;
        let rebuilding_bytes = memory_bytes.saturating_sub(bytes.len() as u64 + data.memory_bytes());
        let mut file = level_set(data, hash, rebuilding_leaf_count_max(rebuilding_bytes))
            .map_err(|what| fail(Error::unsupported("OpenVDB", what)))?;
        if wants_velocity {
            let vectors = vdb::read_vectors(bytes, &VELOCITY_NAMES, &limits).map_err(fail)?;
            match vectors.map(|vectors| velocities(&vectors, &transform, &file.band)) {
                Some(Ok(velocity)) => file.velocity = Some(velocity),
                Some(Err(why)) => file.warnings.push(Warning::new(format!("velocities are ignored: {why}"))),
                None => {}
            }
        }
        Ok(file)
    }

    /// The band without the other data of the file.
    pub(crate) fn into_band(self) -> NarrowBand {
        self.band
    }

    /// The edge of its voxels, world units.
    pub(crate) fn voxel_size(&self) -> f64 {
        self.lattice.voxel_size
    }

    /// Fails if the grid has another class than "level set".
    ///
    /// # Errors
    /// The message, which says what to do.
    pub(crate) fn require_level_set(&self) -> Result<(), String> {
        match &*self.class {
            "level set" => Ok(()),
            _ => Err(format!(
                "the class of the grid \"{}\" is not \"level set\": save it as a level set",
                self.name
            )),
        }
    }

    /// Fails if the level set and a picture of it do not fit into a memory limit. `path` is its file.
    ///
    /// # Errors
    /// The amount of memory that they need.
    pub fn require_memory(
        &self,
        path: &Path,
        outputs: &OutputOptions,
        memory_bytes: u64,
    ) -> Result<(), FrameError> {
        let fields = if self.velocity.is_some() { 4 } else { 1 };
        let leaf_count = self.band.topology.len() * fields;
        let needed_bytes = (leaf_count * size_of::<Leaf>()) as u64 + outputs.picture_bytes();
        Limits::within(memory_bytes)
            .check_memory(needed_bytes, "the level set with its picture")
            .map_err(|error| FrameError::file(path, Stage::Read, error))
    }

    /// The position of its voxel (0, 0, 0), world units.
    pub(crate) fn origin(&self) -> DVec3 {
        self.origin
    }

    /// The scene for a picture of the level set.
    pub fn scene(&self) -> PictureScene<'_> {
        PictureScene {
            band: &self.band,
            lattice: self.lattice,
            origin: self.origin,
            velocity: self.velocity.as_ref(),
            spray: None,
        }
    }
}

/// Refuses a file in another format, which only has the name of a level set.
fn refuse_other_format(bytes: &[u8]) -> Result<(), Error> {
    if bytes.is_empty() {
        return Err(Error::truncated("", Position::File, "the file is empty"));
    }
    let what = match probe(bytes, "") {
        Probe { kind: ProbedKind::Format(Format::Vdb), codec: None } => return Ok(()),
        Probe { codec: Some(codec), .. } => format!("the file is {}: decompress it", codec.adjective()),
        // What is not recognised may be a damaged file.
        Probe { kind: ProbedKind::Unknown, codec: None } => return Ok(()),
        Probe { kind, codec: None } => {
            format!("the file has another format ({kind}): change its extension to that of its format")
        }
    };
    Err(Error::unsupported("OpenVDB", what))
}

/// Whether a file is a level set, judged by its name. If it exists, its first bytes must not begin a grid of points.
pub fn is_level_set(path: &Path) -> bool {
    let is_named = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("vdb"));
    is_named && !has_points(path).unwrap_or(false)
}

/// Whether a file has particles instead of a level set.
fn has_points(path: &Path) -> io::Result<bool> {
    if !path.metadata()?.is_file() {
        return Ok(false);
    }
    let head = read_head(open_regular(path)?, HEAD_BYTES)?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    Ok(probe(&head, &name).kind == ProbedKind::Format(Format::VdbPoints))
}

/// More bytes than the header of a file and of its first grid.
const HEAD_BYTES: u64 = 8 << 10;

/// A warning about a file with several grids, of which only one is read.
pub(crate) fn other_grids(bytes: &[u8]) -> Option<Warning> {
    let grids = vdb::grids(bytes, &reading_limits()).unwrap_or_default();
    let count = grids.len().saturating_sub(1);
    (count > 0).then(|| Warning::new(format!("ignored in the file: {}", pluralize(count, "other grid"))))
}

/// The usual names of velocity grids.
const VELOCITY_NAMES: [&str; 3] = ["velocity", "vel", "v"];

/// The level set in the data of a file with this hash, without velocities.
fn level_set(data: LevelSetData, hash: u128, rebuilt_leaf_count_max: usize) -> Result<LevelSetFile, String> {
    let LevelSetData { name, class, transform, background, origins, leaves, tiles, .. } = data;
    if class == "fog volume" {
        return Err(format!("the grid \"{name}\" is a fog volume and not a level set"));
    }
    let voxel_size = voxel_size(&transform)
        .ok_or_else(|| format!("the grid \"{name}\" has voxels that are not axis-aligned cubes"))?;
    let half_width = (f64::from(background) / voxel_size) as f32;
    if !(half_width.is_finite() && half_width > 0.0) {
        return Err(format!(
            "the grid \"{name}\" has the background {background}; a level set has a positive one"
        ));
    }
    let leaf_origins: Vec<IVec3> = origins.iter().map(|&origin| IVec3::from(origin)).collect();
    if !leaf_origins.iter().all(is_leaf_origin) {
        return Err(format!("the grid \"{name}\" has voxels beyond the range of indices"));
    }
    if !leaves.iter().flatten().all(|value| value.is_finite()) {
        return Err(format!("the grid \"{name}\" has values that are not finite"));
    }
    let tiles: Vec<_> =
        tiles.into_iter().map(|tile| (IVec3::from(tile.origin), tile.size, tile.value)).collect();
    let stored =
        StoredLevelSet { origins: &leaf_origins, leaves: &leaves, tiles: &tiles, background, voxel_size };
    let mut warnings = Vec::new();
    let band = match rebuilt(&stored, rebuilt_leaf_count_max) {
        Ok(None) => stored_band(leaf_origins, leaves, voxel_size, half_width),
        Ok(Some((band, reason))) => {
            warnings.push(Warning::new(reason.to_string()));
            band
        }
        Err(TooManyLeaves) => {
            return Err(format!(
                "the grid \"{name}\" stores only inside and outside, and its distances would need more than \
                 {rebuilt_leaf_count_max} blocks of 8³ voxels: raise --memory, or save it as a narrow-band level set"
            ));
        }
    };
    let (lattice, origin) = (Lattice { voxel_size }, DVec3::from(transform.translation));
    Ok(LevelSetFile { band, lattice, origin, velocity: None, name, class, hash, warnings })
}

/// The band of a file's leaves, with values in voxels.
fn stored_band(
    leaf_origins: Vec<IVec3>,
    leaves: Vec<[f32; LEAF_VOXELS]>,
    voxel_size: f64,
    half_width: f32,
) -> NarrowBand {
    let topology = Topology::new(leaf_origins.clone());
    let mut phi = Field::splat(topology.len(), half_width);
    let scale = (1.0 / voxel_size) as f32;
    for (origin, values) in leaf_origins.into_iter().zip(leaves) {
        if let Some(index) = topology.find(origin) {
            let values = values.map(|value| (value * scale).clamp(-half_width, half_width));
            phi.leaves[index] = Leaf { values };
        }
    }
    NarrowBand { topology: topology.into(), phi, half_width }
}

/// Whether a leaf can have this origin: it is a multiple of 8 within the range of indices.
pub(crate) fn is_leaf_origin(origin: &IVec3) -> bool {
    let limit = IVec3::splat(INDEX_LIMIT);
    origin.cmpge(-limit).all() && origin.cmplt(limit).all() && (*origin & (LEAF_EDGE - 1)) == IVec3::ZERO
}

/// The velocities at the voxels of a band.
fn velocities(
    vectors: &VectorGridData,
    transform: &Transform,
    band: &NarrowBand,
) -> Result<[Field; 3], String> {
    if vectors.class == "staggered" {
        return Err(
            "the velocity grid is staggered: resample it to a collocated grid (values at voxel centres)"
                .to_owned(),
        );
    }
    if vectors.transform != *transform {
        return Err(
            "the velocity grid has another transform than the level set: resample it to the same voxels"
                .to_owned(),
        );
    }
    if !vectors.leaves.iter().flatten().flatten().all(|number| number.is_finite()) {
        return Err("some velocities are infinite or NaN".to_owned());
    }
    let mut fields = vectors.background.map(|number| Field::splat(band.topology.len(), number));
    for (&origin, values) in vectors.origins.iter().zip(&vectors.leaves) {
        // Velocities outside the band are skipped: no code reads those far from the surface.
        let Some(leaf) = band.topology.find(IVec3::from(origin)) else { continue };
        for (axis, field) in fields.iter_mut().enumerate() {
            field.leaves[leaf] = Leaf { values: values.map(|value| value[axis]) };
        }
    }
    Ok(fields)
}

/// The edge of a voxel; `None` if the voxels are not axis-aligned cubes.
pub(crate) fn voxel_size(transform: &Transform) -> Option<f64> {
    let [[x, a, b], [c, y, d], [e, f, z]] = transform.axes;
    let is_straight = [a, b, c, d, e, f].iter().all(|across| across.abs() <= SKEW_MAX * x);
    let is_even = (y - x).abs() <= SKEW_MAX * x && (z - x).abs() <= SKEW_MAX * x;
    let is_placed = transform.translation.iter().all(|along| along.abs() <= COORDINATE_MAX);
    (VOXEL_SIZES.contains(&x) && is_straight && is_even && is_placed).then_some(x)
}

/// The accepted voxel sizes and coordinates, in world units. Other values are mistakes in the file.
const VOXEL_SIZES: RangeInclusive<f64> = 1e-15..=1e15;
const COORDINATE_MAX: f64 = 1e15;

/// How far the axes of the transform may deviate from those of axis-aligned cubes, as a fraction of the voxel
/// size.
const SKEW_MAX: f64 = 1e-4;
