//! Reads meshes: those of any archive in world space, and the archives of this crate with their provenance.

use std::io::{Read, Seek};
use std::sync::Mutex;

use super::FORMAT;
use super::archive::{Archive, check_start, own_metadata};
use super::document::{HEADER_BYTES, Pod, ROOT_CHILDREN};
use super::mesh::names;
use super::points::frame_numbers;
use super::scene::{Geometry, GeometryKind, Scene, vectors};
use crate::core::batches::SeekFile;
use crate::core::container::{SceneMeshReader, frame_at};
use crate::core::data::MeshData;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::matrix::{determinant, normal_transform, transformed};
use crate::core::sequence::MOMENTS;
use crate::core::sequence::{SEQUENCE_FRAMES, SequenceInfo};

/// The name of the attribute in the property for velocities.
pub(super) const VELOCITY: &str = "velocity";

/// The number at an offset of the first bytes of a file.
fn number_in(head: &[u8], at: u64) -> Option<u64> {
    let at = usize::try_from(at).ok()?;
    head.get(at..)?.first_chunk().map(|bytes| u64::from_le_bytes(*bytes))
}

/// The provenance in the first bytes of a file, where our writer puts the metadata; `None` for files of other
/// programs.
pub(super) fn own_head(head: &[u8]) -> Option<Vec<(String, String)>> {
    let length = usize::try_from(number_in(head, HEADER_BYTES)?).ok()?;
    let start = usize::try_from(HEADER_BYTES).ok()? + 8;
    own_metadata(head.get(start..)?.get(..length)?)
}

/// Reads the provenance from the first bytes of a file.
pub(super) fn read_provenance(head: &[u8]) -> Result<Vec<(String, String)>> {
    check_start(head)?;
    Ok(own_head(head).unwrap_or_default())
}

/// The size of a complete file with this head: the root group comes last. `None` for files of other programs.
pub(super) fn bytes_declared(head: &[u8]) -> Result<Option<u64>> {
    check_start(head)?;
    let root = own_head(head).and_then(|_| number_in(head, 8));
    Ok(root.and_then(|root| root.checked_add(8 * (1 + ROOT_CHILDREN))))
}

/// Reads the mesh of an archive with one frame, in world space: all its visible meshes.
///
/// # Errors
///
/// [`Error::Unsupported`] for archives without meshes, for HDF5, and for sequences; [`Error::Truncated`] or
/// [`Error::Invalid`], with the position, if the file is truncated or damaged; [`Error::TooLarge`] beyond
/// `limits`.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    let scene = Scene::open(&bytes, limits)?;
    check_single_frame(&scene, limits)?;
    mesh(&scene, None, limits)
}

/// How the meshes of scenes are read.
pub(super) const MESHES: SceneMeshReader = SceneMeshReader {
    are_animated: |file, limits| {
        Ok(Scene::open(file.file, limits)?.times(GeometryKind::Mesh, limits)?.len() > 1)
    },
    read: |file, number, limits| {
        let scene = Scene::open(file.file, limits)?;
        let times = scene.times(GeometryKind::Mesh, limits)?;
        // A frame of our sequences has two samples.
        let is_own = own_metadata(&scene.archive.metadata).is_some();
        mesh(&scene, number.map(|number| time_of(number, &times, is_own)).transpose()?.flatten(), limits)
    },
};

/// The time of the frame with a number, in seconds: that of the last sample at or before it, or else of the first;
/// `None` if there is one sample, without a time.
fn time_of(number: i64, times: &[f64], is_own: bool) -> Result<Option<f64>> {
    if times.len() < 2 {
        return Ok(None);
    }
    let Some(samples) = frame_numbers(times) else {
        let what = "the times of its samples are not whole frames at any frame rate: use a file of each frame, as in \
                    body.####.abc";
        return Err(Error::unsupported(FORMAT, what));
    };
    // The shortest step may be that from the last moment of a frame to the next frame.
    let is_held = |sample: &i64| [0, MOMENTS - 1].contains(&sample.rem_euclid(MOMENTS));
    let sample = if is_own && samples.iter().all(is_held) { number.saturating_mul(MOMENTS) } else { number };
    let later = samples.partition_point(|known| *known <= sample);
    Ok(times.get(later.saturating_sub(1)).copied())
}

/// The times of the samples of an archive, in seconds. A frame may have two samples.
///
/// # Errors
///
/// Those of [`read_mesh`].
pub fn read_times(bytes: &[u8]) -> Result<Vec<f64>> {
    let limits = Limits::default();
    let times = Scene::open(&bytes, &limits)?.times(GeometryKind::Mesh, &limits)?;
    Ok(if times.is_empty() { vec![0.0] } else { times })
}

/// Reads the mesh of one sample of an archive, by its index among [`read_times`].
///
/// # Errors
///
/// Those of [`read_mesh`]; [`Error::Invalid`] if there are fewer samples.
pub fn read_sample(bytes: &[u8], index: usize, limits: &Limits) -> Result<MeshData> {
    let time = *frame_at(FORMAT, &read_times(bytes)?, index)?;
    mesh(&Scene::open(&bytes, limits)?, Some(time), limits)
}

/// The content of a sequence of this crate, and the names of its vertex attributes, except normals; `None`
/// for other archives. Reads the structure of the file, and the number of bytes of each array.
///
/// # Errors
///
/// [`Error::Io`] if the file cannot be read, and those of [`read_mesh`].
pub fn read_sequence_info(
    file: &mut (impl Read + Seek + Send),
) -> Result<Option<(SequenceInfo, Vec<String>)>> {
    let (limits, file) = (Limits::default(), SeekFile(Mutex::new(file)));
    let archive = Archive::open(&file, &limits)?;
    let Some(frames) = frames_of(&own_metadata(&archive.metadata).unwrap_or_default())? else {
        return Ok(None);
    };
    let scene = Scene::open(&file, &limits)?;
    let mesh = own_mesh(&scene)?;
    let mut info = SequenceInfo { frames, ..SequenceInfo::default() };
    let mut last = None;
    for index in 0..mesh.required(names::POSITIONS)?.sample_count {
        let sample = |name: &str| scene.archive.sample(mesh.required(name)?, index);
        let samples = [sample(names::POSITIONS)?, sample(names::COUNTS)?];
        // A frame may have two samples, which refer to the same data.
        if last.replace(samples) != Some(samples) {
            let [positions, counts] = samples;
            info.vertices = info.vertices.saturating_add(scene.archive.sample_bytes(positions)? / 12);
            info.triangles = info.triangles.saturating_add(scene.archive.sample_bytes(counts)? / 4);
        }
    }
    let mut attributes = Vec::new();
    attributes.extend(mesh.property(names::VELOCITIES).map(|_| VELOCITY.to_owned()));
    if let Some(params) = mesh.property(names::PARAMS) {
        attributes.extend(scene.archive.compound(params)?.into_iter().map(|param| param.name));
    }
    Ok(Some((info, attributes)))
}

/// The number of frames in the provenance of a sequence; `None` for one frame.
fn frames_of(provenance: &[(String, String)]) -> Result<Option<u64>> {
    let frames = provenance.iter().find(|(name, _)| name == SEQUENCE_FRAMES);
    let frames = frames.map(|(_, frames)| {
        let what = format!("the sequence has an invalid number of frames `{frames}`");
        frames.parse().map_err(|_| Error::invalid(FORMAT, Position::Offset(HEADER_BYTES), what))
    });
    frames.transpose()
}

/// Whether an archive is a sequence of this crate.
pub(super) fn is_own_sequence(scene: &Scene) -> Result<bool> {
    let provenance = own_metadata(&scene.archive.metadata).unwrap_or_default();
    Ok(frames_of(&provenance)?.is_some())
}

/// Fails for a sequence, because it is unknown which of its meshes to use.
pub(super) fn check_single_frame(scene: &Scene, limits: &Limits) -> Result<()> {
    let provenance = own_metadata(&scene.archive.metadata).unwrap_or_default();
    let samples = scene.times(GeometryKind::Mesh, limits)?.len();
    let found = match frames_of(&provenance)? {
        Some(frames) => format!("a sequence of {frames} frames"),
        None if samples > 1 => format!("an animation of {samples} samples"),
        None => return Ok(()),
    };
    let what = format!(
        "this file is {found}, and a single mesh is needed: use the file of one frame, or of each frame, as in body.####.abc"
    );
    Err(Error::unsupported(FORMAT, what))
}

/// The mesh in an archive of this crate.
pub(super) fn own_mesh<'s>(scene: &'s Scene) -> Result<&'s Geometry> {
    let mut meshes = scene.of_kind(GeometryKind::Mesh);
    match (own_metadata(&scene.archive.metadata), meshes.next(), meshes.next()) {
        (Some(_), Some(mesh), None) => Ok(mesh),
        (None, ..) => {
            let what = "only the .abc files of meniscus can be converted: save the mesh as PLY, OBJ or glTF";
            Err(Error::unsupported(FORMAT, what))
        }
        _ => Err(scene.without(GeometryKind::Mesh)),
    }
}

/// All visible meshes at a time. The normals are empty unless all meshes have one per vertex.
fn mesh(scene: &Scene, time: Option<f64>, limits: &Limits) -> Result<MeshData> {
    if scene.of_kind(GeometryKind::Mesh).next().is_none() {
        return Err(scene.without(GeometryKind::Mesh));
    }
    let mut joined = MeshData::default();
    for geometry in scene.of_kind(GeometryKind::Mesh) {
        if !scene.is_visible(geometry, time)? {
            continue;
        }
        let part = SampledMesh::read(scene, geometry, time)?;
        let first = joined.positions.len();
        let count = first + part.positions.len();
        limits.check_particles(FORMAT, count as u64)?;
        let (Ok(first_index), true) = (u32::try_from(first), u32::try_from(count).is_ok()) else {
            return Err(Error::too_large(FORMAT, "the meshes have more than 2³² vertices"));
        };
        let matrix = scene.world(geometry, time)?;
        let has_normals = joined.normals.len() == first && part.normals.len() == part.positions.len();
        if has_normals {
            let turn = normal_transform(&matrix);
            #[expect(clippy::cast_possible_truncation, reason = "normals have 32 bits")]
            let to_world = |normal: &[f32; 3]| turn(normal.map(f64::from)).map(|along| along as f32);
            joined.normals.extend(part.normals.iter().map(to_world));
        } else {
            joined.normals = Vec::new();
        }
        let is_mirrored = determinant(&matrix) < 0.0;
        joined.positions.extend(part.positions.iter().map(|p| transformed(&matrix, p.map(f64::from), 1.0)));
        joined.triangles.extend(part.triangles.into_iter().map(|triangle| {
            let [a, b, c] = triangle.map(|corner| first_index + corner);
            if is_mirrored { [a, c, b] } else { [a, b, c] }
        }));
    }
    Ok(joined)
}

/// A mesh at a time, before its transform.
pub(super) struct SampledMesh {
    pub(super) positions: Vec<[f32; 3]>,
    /// One per vertex; empty if the file has none, or others.
    pub(super) normals: Vec<[f32; 3]>,
    pub(super) triangles: Vec<[u32; 3]>,
}

impl SampledMesh {
    pub(super) fn read(scene: &Scene, mesh: &Geometry, time: Option<f64>) -> Result<SampledMesh> {
        let archive = &scene.archive;
        let positions = mesh.required(names::POSITIONS)?;
        let positions = vectors(scene, positions, archive.index_at(positions, time))?;
        // Normals with indices, and those of corners, are a compound or have another length.
        let normals = match mesh.property(names::NORMALS).filter(|property| property.pod().is_some()) {
            Some(normals) => vectors(scene, normals, archive.index_at(normals, time))?,
            None => Vec::new(),
        };
        let normals = if normals.len() == positions.len() { normals } else { Vec::new() };
        let triangles = triangles(archive, mesh, time, positions.len())?;
        Ok(SampledMesh { positions, normals, triangles })
    }
}

/// The triangles of a mesh, counterclockwise. Faces are clockwise in the file; those with more than three
/// corners become triangle fans. Faces with fewer have no area.
fn triangles(
    archive: &Archive,
    mesh: &Geometry,
    time: Option<f64>,
    vertex_count: usize,
) -> Result<Vec<[u32; 3]>> {
    let invalid = |what: String| Error::invalid(FORMAT, Position::File, what);
    let numbers = |name: &str| -> Result<Vec<u32>> {
        let property = mesh.required(name)?;
        let index = archive.index_at(property, time);
        let numbers = archive.elements::<4>(property, (Pod::I32, 1), index)?;
        Ok(numbers.into_iter().map(u32::from_le_bytes).collect())
    };
    let corners = numbers(names::CORNERS)?;
    if let Some(corner) = corners.iter().find(|corner| **corner as usize >= vertex_count) {
        let what = format!("a face has vertex index {corner}, but the mesh has {vertex_count} vertices");
        return Err(invalid(what));
    }
    let (mut rest, mut triangles) = (&*corners, Vec::new());
    for count in numbers(names::COUNTS)? {
        let Some((face, others)) = rest.split_at_checked(count as usize) else {
            let what = format!("a face has {count} corners, but all faces together have {}", corners.len());
            return Err(invalid(what));
        };
        if let [others @ .., last] = face {
            triangles.extend(others.windows(2).rev().map(|pair| [*last, pair[1], pair[0]]));
        }
        rest = others;
    }
    match rest {
        [] => Ok(triangles),
        _ => Err(invalid(format!("{} corners belong to no face", rest.len()))),
    }
}
