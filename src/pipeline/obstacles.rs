//! The files of what stands in the way: which of them are a frame's, and what is in them.
//!
//! ```text
//!   floor.obj          in the way of every frame; read once, and again when the file was written again
//!   body.####.obj      moves: each frame has the file with its own number, or fails
//! ```
//!
//! Of a frame they are found and hashed first. Only if it is not done already is there any need to know what is
//! in them.

use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use glam::{DVec3, IVec3};
use meniscus_formats::vdb::LevelSetData;
use meniscus_formats::{Limits, ObstacleData, read_obstacle};
use twox_hash::XxHash3_128;
use twox_hash::xxhash3_128::Hasher;

use crate::obstacle::{LevelSetSource, Obstacle, Obstacles, Sampled, Shape, Solid};
use crate::settings::Settings;

use super::frame::{Cause, FrameError, Stage};
use super::number_pattern::NumberPattern;
use super::reading::read_unchanged;
use super::stamp::FileStamp;

/// The obstacles of a sequence.
#[derive(Debug, Default)]
pub struct ObstacleFiles {
    paths: Vec<PathBuf>,
    /// What is known of those that stand still.
    known: Mutex<Vec<Option<Known>>>,
}

/// A file that was read.
#[derive(Clone)]
struct Known {
    stamp: FileStamp,
    hash: u128,
    obstacle: Arc<Obstacle>,
}

impl fmt::Debug for Known {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Known").field("hash", &self.hash).finish_non_exhaustive()
    }
}

/// The obstacles of a frame, found and hashed.
#[derive(Default)]
pub(super) struct FoundObstacles {
    found: Vec<FoundObstacle>,
}

/// A file of these.
struct FoundObstacle {
    path: PathBuf,
    stamp: FileStamp,
    hash: u128,
    content: Content,
    /// Where it is among the paths, if it stands still.
    still: Option<usize>,
}

/// What is there of it.
enum Content {
    Bytes(Vec<u8>),
    /// Its hash is that of several files, so that they had to be read.
    Data(Box<ObstacleData>),
    Obstacle(Arc<Obstacle>),
}

/// What a frame is to go around.
#[derive(Clone, Default)]
pub struct FrameObstacles {
    /// All of them.
    pub obstacles: Obstacles,
    /// What a user should know of those that were read for this frame.
    pub(super) notes: Vec<String>,
    /// What is recorded of them: names and hashes. Empty if there is none.
    pub(super) recorded: String,
    /// Edges at which meshes are open.
    pub(super) open_edge_count: usize,
    /// Memory that those take which are this frame's only, and that all take, in bytes.
    pub(super) own_bytes: u64,
    pub(super) all_bytes: u64,
}

impl ObstacleFiles {
    /// Obstacles at these paths. Where there is no such file, and the name has a place for a number as in
    /// `body.####.obj`, each frame has the file with its own.
    pub fn new(paths: Vec<PathBuf>) -> ObstacleFiles {
        let known = Mutex::new(vec![None; paths.len()]);
        ObstacleFiles { paths, known }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.paths.is_empty()
    }

    /// The first path that no frame can have: there is no such file, and no place for a number in its name.
    pub fn missing(&self) -> Option<&Path> {
        let is_missing = |path: &&PathBuf| !path.is_file() && pattern_of(path).is_none();
        self.paths.iter().find(is_missing).map(PathBuf::as_path)
    }

    /// The files of a frame, as far as they are there.
    pub fn files_of(&self, number: Option<u64>) -> Vec<PathBuf> {
        self.paths.iter().filter_map(|path| file_of(path, number).ok()).collect()
    }

    /// What the files of a frame are now, in short: equal ones mean that none was written since.
    pub fn stamps(&self, number: Option<u64>) -> String {
        let stamp = |path: &PathBuf| match file_of(path, number).map(|path| FileStamp::of_path(&path)) {
            Ok(Ok(stamp)) => format!("{}: {stamp:?}\n", path.display()),
            _ => format!("{}: none\n", path.display()),
        };
        self.paths.iter().map(stamp).collect()
    }

    /// Finds and hashes those of a frame.
    pub(super) fn find(&self, number: Option<u64>) -> Result<FoundObstacles, FrameError> {
        let found = self.paths.iter().enumerate().map(|(index, path)| {
            let at = file_of(path, number).map_err(|error| failed(path, error.into()))?;
            let still = (at == *path).then_some(index);
            match still.and_then(|index| self.known_of(index)) {
                Some(known) if FileStamp::of_path(&at).ok() == Some(known.stamp) => Ok(FoundObstacle {
                    path: at,
                    stamp: known.stamp,
                    hash: known.hash,
                    content: Content::Obstacle(known.obstacle),
                    still,
                }),
                _ => read(at, still),
            }
        });
        Ok(FoundObstacles { found: found.collect::<Result<_, _>>()? })
    }

    /// What is in them. The leaves that are kept of all together take no more than so many bytes.
    pub(super) fn load(
        &self,
        found: FoundObstacles,
        settings: &Settings,
        kept_bytes_max: u64,
    ) -> Result<FrameObstacles, FrameError> {
        let mut all = FrameObstacles { recorded: found.recorded(), ..FrameObstacles::default() };
        let kept_bytes_max = kept_bytes_max / found.found.len().max(1) as u64;
        for file in found.found {
            let name = name_of(&file.path);
            let data = match file.content {
                Content::Obstacle(obstacle) => {
                    all.all_bytes += obstacle.size_bytes() as u64;
                    all.open_edge_count += open_edges(obstacle.shape());
                    all.obstacles.members.push(obstacle);
                    continue;
                }
                Content::Data(data) => *data,
                Content::Bytes(bytes) => parse(&file.path, &bytes)?.0,
            };
            let shape = shape_of(data)
                .map_err(|what| failed(&file.path, meniscus_formats::Error::unsupported("OpenVDB", what)))?;
            all.notes.extend(notes_of(&shape, &name, settings));
            all.open_edge_count += open_edges(&shape);
            let obstacle =
                Arc::new(Obstacle::new(shape, usize::try_from(kept_bytes_max).unwrap_or(usize::MAX)));
            let bytes = obstacle.size_bytes() as u64 + kept_bytes_max;
            all.all_bytes += bytes;
            match file.still {
                Some(index) => {
                    let known = Known { stamp: file.stamp, hash: file.hash, obstacle: Arc::clone(&obstacle) };
                    if let Some(place) =
                        self.known.lock().unwrap_or_else(PoisonError::into_inner).get_mut(index)
                    {
                        *place = Some(known);
                    }
                }
                None => all.own_bytes += bytes,
            }
            all.obstacles.members.push(obstacle);
        }
        Ok(all)
    }

    fn known_of(&self, index: usize) -> Option<Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner).get(index).cloned().flatten()
    }
}

impl FoundObstacles {
    /// What is recorded of them: the same from wherever they are read.
    pub(super) fn recorded(&self) -> String {
        let one = |file: &FoundObstacle| format!("{} xxh3-128:{:032x}", name_of(&file.path), file.hash);
        self.found.iter().map(one).collect::<Vec<_>>().join(", ")
    }
}

/// The pattern that a path's name is.
fn pattern_of(path: &Path) -> Option<NumberPattern<'_>> {
    NumberPattern::find(path.file_name()?.to_str()?)
}

/// The file that a path stands for in a frame with this number.
fn file_of(path: &Path, number: Option<u64>) -> io::Result<PathBuf> {
    let missing = |what: String| Err(io::Error::new(io::ErrorKind::NotFound, what));
    if path.is_file() {
        return Ok(path.to_owned());
    }
    let (Some(pattern), folder) = (pattern_of(path), path.parent().unwrap_or(Path::new(""))) else {
        return missing("no such file".into());
    };
    let Some(number) = number else {
        return missing("the frame has no number, so none of these files is its own".into());
    };
    match pattern.file_of(folder, number)? {
        Some(file) => Ok(file),
        None => missing(format!("no file for frame {number}")),
    }
}

fn read(path: PathBuf, still: Option<usize>) -> Result<FoundObstacle, FrameError> {
    let unchanged = read_unchanged(&path).map_err(|error| of_obstacle(&path, error.cause))?;
    let (bytes, stamp) = unchanged.ok_or_else(|| of_obstacle(&path, Cause::Changed))?;
    let hash = XxHash3_128::oneshot(&bytes);
    if !is_gltf_text(&path) {
        return Ok(FoundObstacle { path, stamp, hash, content: Content::Bytes(bytes), still });
    }
    // Its buffers may be files beside it: they count, too.
    let (data, beside) = parse(&path, &bytes)?;
    let hash = beside.map_or(hash, |beside| hash ^ beside);
    Ok(FoundObstacle { path, stamp, hash, content: Content::Data(Box::new(data)), still })
}

fn is_gltf_text(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("gltf"))
}

/// What is in the bytes of a file; and the hash of the files beside it that belong to it.
fn parse(path: &Path, bytes: &[u8]) -> Result<(ObstacleData, Option<u128>), FrameError> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let beside_hash: Mutex<Option<Hasher>> = Mutex::default();
    let beside = |relative: &str| {
        let bytes = fs::read(folder.join(relative))?;
        let mut hasher = beside_hash.lock().unwrap_or_else(PoisonError::into_inner);
        hasher.get_or_insert_with(Hasher::new).write(&bytes);
        Ok(bytes)
    };
    let data = read_obstacle(bytes, &name_of(path), &Limits::default(), &beside)
        .map_err(|error| failed(path, error))?;
    let hasher = beside_hash.into_inner().unwrap_or_else(PoisonError::into_inner);
    Ok((data, hasher.map(|hasher| hasher.finish_128())))
}

fn shape_of(data: ObstacleData) -> Result<Shape, String> {
    Ok(match data {
        ObstacleData::Mesh(mesh) => Shape::Solid(Solid::new(&mesh.positions, &mesh.triangles)),
        ObstacleData::LevelSet(data) => {
            let name = data.name.clone();
            Shape::Sampled(
                Sampled::new(source_of(*data))
                    .map(Box::new)
                    .map_err(|what| format!("the grid \"{name}\" {what}"))?,
            )
        }
    })
}

fn source_of(data: LevelSetData) -> LevelSetSource {
    LevelSetSource {
        origins: data.origins.into_iter().map(IVec3::from).collect(),
        leaves: data.leaves,
        tiles: data.tiles.iter().map(|tile| (IVec3::from(tile.origin), tile.size, tile.value)).collect(),
        background: data.background,
        axes: data.transform.axes.map(DVec3::from),
        translation: DVec3::from(data.transform.translation),
    }
}

/// A level set with a band that is narrower than this, in units of h, tells little of where it is.
const KNOWN_MIN: f64 = 1.0;

/// What a user should know of an obstacle.
fn notes_of(shape: &Shape, name: &str, settings: &Settings) -> Vec<String> {
    let mut notes = Vec::new();
    let mut tell = |count: usize, what: &str| {
        if count > 0 {
            notes.push(format!("obstacle {name}: {count} {what}"));
        }
    };
    match shape {
        Shape::Solid(solid) => {
            let findings = solid.findings();
            tell(findings.open_edge_count, "open edges: holes are closed where its winding number is 1/2");
            tell(findings.turned_count, "triangles faced the other way, and were turned");
            tell(findings.broken_count, "triangles left out: a corner is not finite, or does not exist");
            if findings.triangle_count == 0 {
                notes.push(format!(
                    "obstacle {name}: no triangle has an area, so there is nothing in the way"
                ));
            }
        }
        Shape::Sampled(sampled) => {
            let known = (sampled.band_width() - sampled.voxel_size()) / settings.voxel_size;
            if known < KNOWN_MIN {
                notes.push(format!(
                    "obstacle {name}: its distances are known to {known:.2} h only, and its surface may be off by as much: \
                     make it with a wider band"
                ));
            }
        }
    }
    notes
}

fn open_edges(shape: &Shape) -> usize {
    match shape {
        Shape::Solid(solid) => solid.findings().open_edge_count,
        Shape::Sampled(_) => 0,
    }
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn failed(path: &Path, error: meniscus_formats::Error) -> FrameError {
    of_obstacle(path, Cause::File(error))
}

/// An error of a frame on account of an obstacle.
fn of_obstacle(path: &Path, cause: Cause) -> FrameError {
    FrameError { path: path.to_owned(), during: Stage::Read, cause: Cause::Obstacle(Box::new(cause)) }
}
