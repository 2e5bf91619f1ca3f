//! An obstacle file: reads and hashes it, turns it into a solid, and finds likely mistakes in it.
//!
//! The buffers of a `.gltf` and the layers of a stage may be separate files. They belong to the obstacle: their
//! content is hashed with it, and a change of one of them reloads it. Of an animation, the hash is that of the
//! meshes in the frame, so that a longer animation changes no frame.

use std::collections::HashMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use glam::{DVec3, IVec3};
use meniscus_formats::compression::name_without_compression;
use meniscus_formats::vdb::LevelSetData;
use meniscus_formats::{Error, Limits, MeshData, ObstacleData, gltf, read_obstacle};
use twox_hash::XxHash3_128;
use twox_hash::xxhash3_128::Hasher;

use crate::surface::obstacle::{GridSdf, MeshFindings, MeshSdf, ObstacleSdf, SourceLevelSet};
use crate::surface::options::Settings;

use super::container::OpenContainer;
use crate::pipeline::error::ObstacleError;
use crate::pipeline::files::input_file::{read_start_unchanged, read_unchanged};
use crate::pipeline::files::named_files::path_of_named;
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::warning::counted;

/// Identifies the content of an obstacle file.
#[derive(Clone)]
pub(super) struct ObstacleSource {
    pub(super) path: PathBuf,
    /// The file and its further files, with their stamps when they were read.
    files: Vec<(PathBuf, FileStamp)>,
    pub(super) hash: u128,
    /// Whether each frame has its own meshes.
    pub(super) is_animated: bool,
}

impl ObstacleSource {
    /// Whether none of its files has changed since it was read.
    pub(super) fn is_unchanged(&self) -> bool {
        self.files.iter().all(|(path, stamp)| FileStamp::of_path(path).is_ok_and(|now| now == *stamp))
    }
}

/// What was read of an obstacle.
pub(super) enum ReadObstacle {
    /// The bytes of the file, and those of each of its buffer files.
    Bytes { file: Vec<u8>, buffers: HashMap<String, Vec<u8>> },
    /// The meshes of an animation or of several layers.
    Meshes(MeshData),
}

/// Reads an obstacle for the frame with a number, and all files that belong to it.
///
/// # Errors
/// When a file cannot be read, or is written meanwhile.
pub(super) fn read(
    path: PathBuf,
    number: Option<i64>,
) -> Result<(ObstacleSource, ReadObstacle), ObstacleError> {
    if let Some(scene) = read_scene(&path, number)? {
        return Ok(scene);
    }
    let unchanged = read_unchanged(&path).map_err(|error| failed(&path, error))?;
    let (file, stamp) = unchanged.ok_or_else(|| changed(&path))?;
    let mut files = vec![(path.clone(), stamp)];
    let mut buffers = HashMap::new();
    let mut buffer_hasher: Option<Hasher> = None;
    for external in buffers_of(&path, &file).map_err(|error| failed(&path, error))? {
        let of_buffer = |error: io::Error| {
            let message = format!("its buffer {}: {error}", external.path);
            failed(&path, io::Error::new(error.kind(), message))
        };
        let buffer =
            path_of_named(path.parent().unwrap_or(Path::new("")), &external.path).map_err(of_buffer)?;
        let unchanged = read_start_unchanged(&buffer, external.byte_count).map_err(of_buffer)?;
        let (bytes, stamp) = unchanged.ok_or_else(|| changed(&buffer))?;
        buffer_hasher.get_or_insert_with(Hasher::new).write(&bytes);
        files.push((buffer, stamp));
        buffers.insert(external.path, bytes);
    }
    let hash = XxHash3_128::oneshot(&file) ^ buffer_hasher.map_or(0, |hasher| hasher.finish_128());
    let source = ObstacleSource { path, files, hash, is_animated: false };
    Ok((source, ReadObstacle::Bytes { file, buffers }))
}

/// Reads the meshes of an animation or of a scene of several files; `None` for other files.
fn read_scene(
    path: &Path,
    number: Option<i64>,
) -> Result<Option<(ObstacleSource, ReadObstacle)>, ObstacleError> {
    let fail = |error: Error| failed(path, error);
    let Some(open) = OpenContainer::open(path).map_err(fail)? else { return Ok(None) };
    let Some(is_animated) = open.are_meshes_animated().map_err(fail)? else { return Ok(None) };
    if is_animated && number.is_none() {
        let what = "its meshes are animated, and the frame has no number that says which of them belong to it: use a \
                    file of one frame";
        return Err(fail(Error::unsupported("", what)));
    }
    if !is_animated && open.further_files().is_empty() {
        return Ok(None);
    }
    let meshes = open.meshes(number.filter(|_| is_animated)).map_err(fail)?.ok_or_else(|| changed(path))?;
    let further = open.further_files().into_iter().filter_map(|(path, stamp)| Some((path, stamp?)));
    let files = further.chain([(path.to_owned(), open.stamp())]).collect();
    let mut hasher = Hasher::new();
    hasher.write(bytemuck::cast_slice(&meshes.positions));
    hasher.write(bytemuck::cast_slice(&meshes.triangles));
    let source = ObstacleSource { path: path.to_owned(), files, hash: hasher.finish_128(), is_animated };
    Ok(Some((source, ReadObstacle::Meshes(meshes))))
}

/// The files that an obstacle names: its buffers or layers, as far as it can be read.
pub(super) fn further_files(path: &Path) -> Vec<PathBuf> {
    if may_have_buffers(path) {
        let bytes = read_unchanged(path).ok().flatten().map(|(bytes, _)| bytes);
        let buffers = bytes.and_then(|bytes| buffers_of(path, &bytes).ok()).unwrap_or_default();
        return buffers.iter().map(|buffer| path.with_file_name(&buffer.path)).collect();
    }
    let Ok(Some(open)) = OpenContainer::open(path) else { return Vec::new() };
    // The files that were wanted before an error are known.
    let _ = open.are_meshes_animated();
    open.further_files().into_iter().map(|(path, _)| path).collect()
}

/// Whether an obstacle may name further files, judged by its name.
pub(super) fn may_have_further_files(path: &Path) -> bool {
    let is_layer = |extension: &str| ["usd", "usda", "usdc"].contains(&extension);
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let extension = name_without_compression(&name).rsplit_once('.').map(|(_, extension)| extension);
    may_have_buffers(path) || extension.is_some_and(is_layer)
}

/// An obstacle's buffer files.
///
/// # Errors
/// When the file is not a valid `.gltf`, or a buffer is outside of its folder.
fn buffers_of(path: &Path, bytes: &[u8]) -> meniscus_formats::Result<Vec<gltf::ExternalFile>> {
    if !may_have_buffers(path) {
        return Ok(Vec::new());
    }
    gltf::external_files(bytes)
}

/// Whether the buffers may be separate files: only a `.gltf` has those.
pub(super) fn may_have_buffers(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("gltf"))
}

/// Parses an obstacle. `memory_bytes` limits a level set, including all memory for rebuilding it.
///
/// # Errors
/// When the bytes are no valid obstacle, or need more memory.
pub(super) fn parse(
    path: &Path,
    obstacle: ReadObstacle,
    memory_bytes: u64,
) -> Result<ObstacleSdf, ObstacleError> {
    let (file, buffers) = match obstacle {
        ReadObstacle::Bytes { file, buffers } => (file, buffers),
        ReadObstacle::Meshes(meshes) => {
            return Ok(ObstacleSdf::Mesh(MeshSdf::new(&meshes.positions, &meshes.triangles)));
        }
    };
    // The reader takes a shared function, and each file is taken once.
    let buffers = Mutex::new(buffers);
    let take = |relative: &str| {
        let bytes = buffers.lock().unwrap_or_else(PoisonError::into_inner).remove(relative);
        bytes.ok_or_else(|| {
            let message = "it refers to another file for its data, which only a .gltf may do: save it as .glb with all data inside";
            io::Error::new(io::ErrorKind::Unsupported, message)
        })
    };
    let data = read_obstacle(&file, &name_of(path), &Limits::within(memory_bytes), &take)
        .map_err(|error| failed(path, error))?;
    match data {
        ObstacleData::Mesh(mesh) => Ok(ObstacleSdf::Mesh(MeshSdf::new(&mesh.positions, &mesh.triangles))),
        ObstacleData::LevelSet(data) => {
            let name = data.name.clone();
            let used_bytes = (file.len() as u64).saturating_add(data.memory_bytes());
            let sdf = GridSdf::new(source_of(*data), memory_bytes.saturating_sub(used_bytes));
            sdf.map(|sdf| ObstacleSdf::Grid(Box::new(sdf))).map_err(|message| {
                failed(path, Error::unsupported("OpenVDB", format!("the grid \"{name}\" {message}")))
            })
        }
    }
}

fn source_of(data: LevelSetData) -> SourceLevelSet {
    SourceLevelSet {
        origins: data.origins.into_iter().map(IVec3::from).collect(),
        leaves: data.leaves,
        tiles: data.tiles.into_iter().map(|tile| (IVec3::from(tile.origin), tile.size, tile.value)).collect(),
        background: data.background,
        axes: data.transform.axes.map(DVec3::from),
        translation: DVec3::from(data.transform.translation),
    }
}

/// The likely mistakes in an obstacle.
pub(crate) fn findings_of(shape: &ObstacleSdf, settings: &Settings) -> Vec<String> {
    match shape {
        ObstacleSdf::Mesh(solid) => {
            let MeshFindings {
                open_edge_count,
                encloses_nothing,
                flipped_count,
                unchecked_part_count,
                invalid_count,
                triangle_count,
                sheet_count,
                ..
            } = *solid.findings();
            let open = if encloses_nothing {
                NO_VOLUME
            } else {
                "the mesh has {}: its holes were closed approximately (where the winding number is 1/2); close them in the \
                 model for an exact obstacle"
            };
            let sheets = "the mesh has {}, taken as solid behind the normals, as deep as it is wide: flip the normals if the \
                          fluid is on that side, or give it a thickness";
            let flipped = "flipped {} that faced inwards, or opposite to adjacent triangles";
            let unchecked = "did not flip {} that may face inwards: the mesh has too many parts to detect cavities; correct \
                             the normals in the model";
            let invalid = "{} ignored: a vertex is not finite, or does not exist";
            let flat = "no triangle has an area, so the obstacle has no effect";
            let findings = [
                counted(sheet_count, "open sheet", sheets),
                counted(open_edge_count, "open edge", open),
                counted(flipped_count, "triangle", flipped),
                counted(unchecked_part_count, "part", unchecked),
                counted(invalid_count, "triangle", invalid),
                (triangle_count == 0).then(|| flat.to_owned()),
            ];
            findings.into_iter().flatten().collect()
        }
        ObstacleSdf::Grid(sampled) => {
            let known_voxels = (sampled.band_width() - sampled.voxel_size()) / settings.voxel_size;
            let rebuilt = sampled.rebuild_reason().map(|reason| reason.to_string());
            let narrow = (known_voxels < KNOWN_VOXELS_MIN).then(|| {
                format!(
                    "its narrow band is only {known_voxels:.2} h wide, and its surface may be off by that much: write it with a \
                     wider band"
                )
            });
            rebuilt.into_iter().chain(narrow).collect()
        }
    }
}

/// A level set is known up to its band width, less one of its own voxels. If that is less than this many voxels
/// of the frame, it hardly shows where the surface is.
const KNOWN_VOXELS_MIN: f64 = 1.0;

const NO_VOLUME: &str = "the mesh has {} and encloses no volume: close it, or give it a thickness";

/// Refuses an obstacle whose mesh encloses no volume.
///
/// # Errors
/// The finding.
pub(super) fn require_volume(path: &Path, shape: &ObstacleSdf) -> Result<(), ObstacleError> {
    let ObstacleSdf::Mesh(solid) = shape else { return Ok(()) };
    let MeshFindings { open_edge_count, encloses_nothing, .. } = *solid.findings();
    match counted(open_edge_count, "open edge", NO_VOLUME).filter(|_| encloses_nothing) {
        Some(finding) => Err(failed(path, Error::unsupported("", finding))),
        None => Ok(()),
    }
}

/// The memory for loading an obstacle, as a multiple of the file size: about 320 bytes for a triangle.
/// Measured with two million triangles, and with a level set of 15 million values.
pub(super) fn loading_factor(path: &Path) -> u64 {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    match &*extension {
        "vdb" => 5,
        "obj" => 9,
        // The unpacked size of compressed files is unknown in advance.
        "gz" | "vtp" | "vtu" => 45,
        _ => 18,
    }
}

/// The number of boundary edges of an obstacle's mesh.
pub(super) fn open_edges(shape: &ObstacleSdf) -> usize {
    match shape {
        ObstacleSdf::Mesh(solid) => solid.findings().open_edge_count,
        ObstacleSdf::Grid(_) => 0,
    }
}

pub(super) fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

pub(super) fn failed(path: &Path, error: impl Into<Error>) -> ObstacleError {
    ObstacleError { path: path.to_owned(), source: Some(error.into()) }
}

fn changed(path: &Path) -> ObstacleError {
    ObstacleError { path: path.to_owned(), source: None }
}
