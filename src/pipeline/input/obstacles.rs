//! Obstacle files: finds those of a frame, hashes them and loads them.
//!
//! ```text
//!   floor.obj          an obstacle of every frame; read once, and again after a change
//!   body.####.obj      moves: each frame needs the file with its own number, or fails
//! ```
//!
//! The files of a frame are found and hashed first. They are parsed only if the frame is not done already.
//!
//! The buffers of a `.gltf` may be separate files. They belong to the obstacle: their bytes are hashed with
//! it, and a change of one of them reloads it.

use std::collections::{HashMap, HashSet};
use std::fmt;
use std::io;
use std::path::{Path, PathBuf, absolute};
use std::sync::{Arc, Mutex, PoisonError};

use glam::{DVec3, IVec3};
use meniscus_formats::vdb::LevelSetData;
use meniscus_formats::{ObstacleData, gltf, read_obstacle};
use twox_hash::XxHash3_128;
use twox_hash::xxhash3_128::Hasher;

use crate::surface::obstacle::{GridSdf, MeshSdf, Obstacle, ObstacleSdf, Obstacles, SourceLevelSet};
use crate::surface::options::Settings;

use super::level_set_file::level_set_limits;
use super::obstacle_warnings::findings_of;
use crate::pipeline::error::ObstacleError;
use crate::pipeline::files::input_file::{read_start_unchanged, read_unchanged};
use crate::pipeline::files::number_pattern::{NumberPattern, may_be_file};
use crate::pipeline::files::open::require_regular;
use crate::pipeline::files::path_identity::{are_same_file, canonical_entry};
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::warning::{ObstacleFinding, Warning};

/// The obstacles of a sequence.
#[derive(Debug, Default)]
pub struct ObstacleFiles {
    paths: Vec<PathBuf>,
    /// The loaded obstacles that do not move, by the index of their path.
    loaded: Mutex<Vec<Option<LoadedObstacle>>>,
    /// The buffer files of each `.gltf`, and the stamp of the `.gltf` that named them.
    buffers: Mutex<HashMap<PathBuf, (FileStamp, Vec<PathBuf>)>>,
}

/// The state of a frame's obstacle files at one time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ObstacleStamps {
    /// The stamps as short text: equal texts mean that no file was written in between.
    pub text: String,
    /// Whether every file exists.
    pub all_exist: bool,
}

/// An obstacle that was loaded.
#[derive(Clone)]
struct LoadedObstacle {
    /// All files that it was read from, with their stamps at that time.
    files: Vec<(PathBuf, FileStamp)>,
    hash: u128,
    obstacle: Arc<Obstacle>,
}

impl fmt::Debug for LoadedObstacle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("LoadedObstacle").field("hash", &self.hash).finish_non_exhaustive()
    }
}

/// The obstacles of a frame, found and hashed.
#[derive(Default)]
pub(crate) struct FoundObstacles {
    found: Vec<FoundObstacle>,
}

/// An obstacle of a frame, found and hashed.
struct FoundObstacle {
    path: PathBuf,
    /// The file and its buffer files, with their stamps.
    files: Vec<(PathBuf, FileStamp)>,
    hash: u128,
    content: ObstacleShape,
    /// The index of the obstacle's path; `None` if the obstacle moves.
    still: Option<usize>,
}

/// The contents of an obstacle file: bytes, or the obstacle that was loaded from them earlier.
enum ObstacleShape {
    /// The bytes of the file, and those of each of its buffer files.
    Bytes(Vec<u8>, HashMap<String, Vec<u8>>),
    Obstacle(Arc<Obstacle>),
}

/// The obstacles of a frame, ready for the reconstruction.
#[derive(Clone, Default)]
pub struct FrameObstacles {
    /// All obstacles.
    pub obstacles: Obstacles,
    /// Warnings about the obstacles that were read for this frame.
    pub(crate) warnings: Vec<Warning>,
    /// The path of each obstacle.
    pub(crate) paths: Vec<PathBuf>,
    /// The names and hashes that records contain; empty without obstacles.
    pub(crate) recorded: String,
    /// The number of boundary edges of the meshes.
    pub(crate) open_edge_count: usize,
    /// The memory of the obstacles that only this frame has, and of all its obstacles, in bytes.
    pub(crate) own_bytes: u64,
    pub(crate) all_bytes: u64,
}

impl ObstacleFiles {
    /// Obstacles at these paths. If a path does not exist and its name has a placeholder for a number, as in
    /// `body.####.obj`, each frame has the file with its own number.
    pub fn new(mut paths: Vec<PathBuf>) -> ObstacleFiles {
        // Duplicate paths are loaded, and warned about, once.
        let mut seen = HashSet::new();
        paths.retain(|path| seen.insert(absolute(path).unwrap_or_else(|_| path.clone())));
        let known = Mutex::new(vec![None; paths.len()]);
        ObstacleFiles { paths, loaded: known, buffers: Mutex::default() }
    }

    /// Whether there are no obstacles.
    pub fn is_empty(&self) -> bool {
        self.paths.is_empty()
    }

    /// The paths that no frame can read, and why: no such file exists, or it is a folder or a device, and the
    /// name has no placeholder.
    pub fn unreadable(&self) -> impl Iterator<Item = (&Path, io::Error)> {
        self.paths.iter().filter(|path| pattern_of(path).is_none()).filter_map(|path| {
            let error = path.metadata().and_then(|metadata| require_regular(&metadata)).err()?;
            Some((path.as_path(), error))
        })
    }

    /// The obstacle that an output would replace, or that the output would be mistaken for: for a moving
    /// obstacle, any file that matches its pattern.
    pub(crate) fn replaced_by(&self, output: &Path) -> Option<&Path> {
        let is_member = |path: &Path, pattern: NumberPattern| {
            let (entry, of_pattern) = (canonical_entry(output), canonical_entry(path));
            let name = entry.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            entry.parent() == of_pattern.parent() && pattern.span_in(name).is_some()
        };
        let is_in_the_way = |path: &&PathBuf| {
            are_same_file(path, output)
                || !may_be_file(path) && pattern_of(path).is_some_and(|pattern| is_member(path, pattern))
                || self.external_files(path).iter().any(|external| are_same_file(external, output))
        };
        self.paths.iter().find(is_in_the_way).map(PathBuf::as_path)
    }

    /// Whether no obstacle moves, so that all frames share the same ones.
    pub fn are_static(&self) -> bool {
        self.paths.iter().all(|path| may_be_file(path) || pattern_of(path).is_none())
    }

    /// The current state of a frame's obstacle files.
    pub fn stamps(&self, number: Option<i64>) -> ObstacleStamps {
        let mut stamps = ObstacleStamps { text: String::new(), all_exist: true };
        let mut add = |path: &Path, stamp: Option<FileStamp>| {
            stamps.all_exist &= stamp.is_some();
            stamps.text += &match stamp {
                Some(stamp) => format!("{}: {}\n", path.display(), text_of(&stamp)),
                None => format!("{}: none\n", path.display()),
            };
        };
        for path in &self.paths {
            let at = file_of(path, number).ok();
            add(path, at.as_deref().and_then(stamp_of));
            let external = at.map(|at| self.external_files(&at)).unwrap_or_default();
            external.iter().for_each(|path| add(path, stamp_of(path)));
        }
        stamps
    }

    /// The buffer files of an obstacle; empty if the obstacle cannot be read at present.
    fn external_files(&self, path: &Path) -> Vec<PathBuf> {
        if !is_gltf_text(path) {
            return Vec::new();
        }
        let lock = || self.buffers.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((stamp, files)) = lock().get(path)
            && stamp_of(path) == Some(*stamp)
        {
            return files.clone();
        }
        let Ok(Some((bytes, stamp))) = read_unchanged(path) else { return Vec::new() };
        let files = gltf::external_files(&bytes).unwrap_or_default();
        let files: Vec<PathBuf> = files.iter().map(|file| folder_of(path).join(&file.path)).collect();
        lock().insert(path.to_owned(), (stamp, files.clone()));
        files
    }

    /// The memory that loading a frame's obstacles may take, without those that are loaded already, in bytes.
    pub(crate) fn loading_bytes(&self, number: Option<i64>) -> u64 {
        let size = |path: &Path| path.metadata().map_or(0, |metadata| metadata.len());
        let of_one = |(index, path): (usize, &PathBuf)| {
            if self.loaded_of(index).is_some_and(|known| known.is_as_it_was()) {
                return 0;
            }
            let Ok(at) = file_of(path, number) else { return 0 };
            let external = self.external_files(&at);
            let bytes = external.iter().map(|path| size(path)).fold(size(&at), u64::saturating_add);
            bytes.saturating_mul(loading_factor(&at))
        };
        self.paths.iter().enumerate().map(of_one).fold(0, u64::saturating_add)
    }

    /// Whether all obstacles of the frame with this number exist.
    pub fn exist(&self, number: Option<i64>) -> bool {
        self.stamps(number).all_exist
    }

    /// Finds and hashes the obstacles of a frame.
    pub(crate) fn find(&self, number: Option<i64>) -> Result<FoundObstacles, ObstacleError> {
        let found = self.paths.iter().enumerate().map(|(index, path)| {
            let at = file_of(path, number)?;
            let still = (at == *path).then_some(index);
            match still.and_then(|index| self.loaded_of(index)) {
                Some(known) if known.is_as_it_was() => Ok(FoundObstacle {
                    path: at,
                    files: known.files,
                    hash: known.hash,
                    content: ObstacleShape::Obstacle(known.obstacle),
                    still,
                }),
                _ => read(at, still),
            }
        });
        Ok(FoundObstacles { found: found.collect::<Result<_, _>>()? })
    }

    /// Loads the obstacles. Reading a level set, together with the obstacles before it, may take
    /// `memory_bytes` at most; the cached leaves of all obstacles may take a small part of that.
    pub(crate) fn load(
        &self,
        found: FoundObstacles,
        settings: &Settings,
        memory_bytes: u64,
    ) -> Result<FrameObstacles, ObstacleError> {
        let mut all = FrameObstacles { recorded: found.recorded(), ..FrameObstacles::default() };
        let kept_bytes_max = memory_bytes / OBSTACLE_SHARE / found.found.len().max(1) as u64;
        for file in found.found {
            all.paths.push(file.path.clone());
            let (data, file_bytes) = match file.content {
                ObstacleShape::Obstacle(obstacle) => {
                    all.all_bytes += obstacle.size_bytes_max() as u64;
                    all.open_edge_count += open_edges(obstacle.sdf());
                    all.obstacles.members.push(obstacle);
                    continue;
                }
                ObstacleShape::Bytes(bytes, external) => {
                    let left_bytes = memory_bytes.saturating_sub(all.all_bytes);
                    (parse(&file.path, &bytes, external, left_bytes)?, bytes.len() as u64)
                }
            };
            let shape = shape_of(data, memory_bytes.saturating_sub(file_bytes + all.all_bytes))
                .map_err(|what| failed(&file.path, meniscus_formats::Error::unsupported("OpenVDB", what)))?;
            let findings = findings_of(&shape, settings);
            let is_fatal = |finding: &&ObstacleFinding| {
                matches!(finding, ObstacleFinding::Open { encloses_nothing: true, .. })
            };
            if let Some(finding) = findings.iter().find(is_fatal) {
                return Err(failed(
                    &file.path,
                    meniscus_formats::Error::unsupported("", finding.to_string()),
                ));
            }
            let about = |finding| Warning::Obstacle { path: file.path.clone(), finding };
            all.warnings.extend(findings.into_iter().map(about));
            all.open_edge_count += open_edges(&shape);
            let obstacle =
                Arc::new(Obstacle::new(shape, usize::try_from(kept_bytes_max).unwrap_or(usize::MAX)));
            let bytes = obstacle.size_bytes_max() as u64;
            all.all_bytes += bytes;
            match file.still {
                Some(index) => {
                    let known = LoadedObstacle {
                        files: file.files,
                        hash: file.hash,
                        obstacle: Arc::clone(&obstacle),
                    };
                    if let Some(slot) =
                        self.loaded.lock().unwrap_or_else(PoisonError::into_inner).get_mut(index)
                    {
                        *slot = Some(known);
                    }
                }
                None => all.own_bytes += bytes,
            }
            all.obstacles.members.push(obstacle);
        }
        Ok(all)
    }

    fn loaded_of(&self, index: usize) -> Option<LoadedObstacle> {
        self.loaded.lock().unwrap_or_else(PoisonError::into_inner).get(index).cloned().flatten()
    }
}

impl LoadedObstacle {
    /// Whether none of its files has changed since it was loaded.
    fn is_as_it_was(&self) -> bool {
        self.files.iter().all(|(path, stamp)| stamp_of(path) == Some(*stamp))
    }
}

impl FoundObstacles {
    /// The text that records contain: independent of the folder that the files are in.
    pub(crate) fn recorded(&self) -> String {
        let one = |file: &FoundObstacle| format!("{} xxh3-128:{:032x}", name_of(&file.path), file.hash);
        self.found.iter().map(one).collect::<Vec<_>>().join(", ")
    }
}

/// The pattern in a path's name.
fn pattern_of(path: &Path) -> Option<NumberPattern<'_>> {
    NumberPattern::find(path.file_name()?.to_str()?)
}

/// The obstacle file for the frame with this number: `path` itself, or the file of its pattern.
fn file_of(path: &Path, number: Option<i64>) -> Result<PathBuf, ObstacleError> {
    let missing =
        |path: &Path, what: String| Err(failed(path, io::Error::new(io::ErrorKind::NotFound, what).into()));
    if may_be_file(path) {
        return Ok(path.to_owned());
    }
    let Some(pattern) = pattern_of(path) else {
        return match path.metadata().map(|metadata| require_regular(&metadata)) {
            Ok(Err(error)) => Err(failed(path, error.into())),
            _ => missing(path, "no such file".into()),
        };
    };
    let Some(number) = number else {
        return missing(path, "the frame has no number, so no file of this pattern belongs to it".into());
    };
    match pattern.file_of(folder_of(path), number).map_err(|error| failed(path, error.into()))? {
        Some(file) => Ok(file),
        None => {
            let expected = folder_of(path).join(pattern.name_of(number));
            missing(&expected, format!("no such file: {} has no file for frame {number}", name_of(path)))
        }
    }
}

fn stamp_of(path: &Path) -> Option<FileStamp> {
    FileStamp::of_path(path).ok()
}

/// A stamp as text. It leaves out the status change time: `chmod` and new hard links change no content, and must not cause
/// every frame to be converted again.
fn text_of(stamp: &FileStamp) -> String {
    let FileStamp { size, modified_ns, inode, changed_ns: _ } = stamp;
    format!("FileStamp {{ size: {size}, modified_ns: {modified_ns}, inode: {inode} }}")
}

fn folder_of(path: &Path) -> &Path {
    path.parent().unwrap_or(Path::new(""))
}

fn read(path: PathBuf, still: Option<usize>) -> Result<FoundObstacle, ObstacleError> {
    let unchanged = read_unchanged(&path).map_err(|error| failed(&path, error.into()))?;
    let (bytes, stamp) = unchanged.ok_or_else(|| changed(&path))?;
    let mut hash = XxHash3_128::oneshot(&bytes);
    let mut files = vec![(path.clone(), stamp)];
    let mut contents = HashMap::new();
    if is_gltf_text(&path) {
        let mut hasher: Option<Hasher> = None;
        for gltf::ExternalFile { path: relative, byte_count } in
            gltf::external_files(&bytes).map_err(|error| failed(&path, error))?
        {
            let at = folder_of(&path).join(&relative);
            let unchanged = read_start_unchanged(&at, byte_count).map_err(|error| {
                let what = format!("its buffer {relative}: {error}");
                failed(&path, io::Error::new(error.kind(), what).into())
            })?;
            let (bytes, stamp) = unchanged.ok_or_else(|| changed(&at))?;
            hasher.get_or_insert_with(Hasher::new).write(&bytes);
            files.push((at, stamp));
            contents.insert(relative, bytes);
        }
        hash ^= hasher.map_or(0, |hasher| hasher.finish_128());
    }
    Ok(FoundObstacle { path, files, hash, content: ObstacleShape::Bytes(bytes, contents), still })
}

/// Whether the buffers may be separate files: only a `.gltf` has those.
fn is_gltf_text(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("gltf"))
}

/// Parses the bytes of a file, with those of its buffer files.
fn parse(
    path: &Path,
    bytes: &[u8],
    external: HashMap<String, Vec<u8>>,
    memory_bytes: u64,
) -> Result<ObstacleData, ObstacleError> {
    let external = Mutex::new(external);
    // Each file is requested once.
    let take = |relative: &str| {
        let bytes = external.lock().unwrap_or_else(PoisonError::into_inner).remove(relative);
        bytes.ok_or_else(|| {
            let what = "it refers to another file for its data, which only a .gltf may do: save it as .glb with all data inside";
            io::Error::new(io::ErrorKind::Unsupported, what)
        })
    };
    read_obstacle(bytes, &name_of(path), &level_set_limits(memory_bytes), &take)
        .map_err(|error| failed(path, error))
}

/// The obstacle in the data; `memory_bytes` limits a level set, including all memory for rebuilding it.
fn shape_of(data: ObstacleData, memory_bytes: u64) -> Result<ObstacleSdf, String> {
    Ok(match data {
        ObstacleData::Mesh(mesh) => ObstacleSdf::Mesh(MeshSdf::new(&mesh.positions, &mesh.triangles)),
        ObstacleData::LevelSet(data) => {
            let name = data.name.clone();
            let rebuilding_bytes = memory_bytes.saturating_sub(data.memory_bytes());
            ObstacleSdf::Grid(
                GridSdf::new(source_of(*data), rebuilding_bytes)
                    .map(Box::new)
                    .map_err(|what| format!("the grid \"{name}\" {what}"))?,
            )
        }
    })
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

/// The cached leaves of obstacles may take this fraction of the memory for a frame.
const OBSTACLE_SHARE: u64 = 16;

/// The memory for loading an obstacle, as a multiple of the file size: about 320 bytes for a triangle.
/// Measured with two million triangles, and with a level set of 15 million values.
fn loading_factor(path: &Path) -> u64 {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    match &*extension {
        "vdb" => 5,
        "obj" => 9,
        // The unpacked size of compressed files is unknown in advance.
        "gz" | "vtp" | "vtu" => 45,
        _ => 18,
    }
}

fn open_edges(shape: &ObstacleSdf) -> usize {
    match shape {
        ObstacleSdf::Mesh(solid) => solid.findings().open_edge_count,
        ObstacleSdf::Grid(_) => 0,
    }
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn failed(path: &Path, error: meniscus_formats::Error) -> ObstacleError {
    ObstacleError { path: path.to_owned(), source: Some(error) }
}

fn changed(path: &Path) -> ObstacleError {
    ObstacleError { path: path.to_owned(), source: None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fingerprint_text_of_stamp_is_that_of_older_versions() {
        let stamp = FileStamp { size: 1, modified_ns: -2, inode: 3, changed_ns: Some(4) };
        assert_eq!(text_of(&stamp), "FileStamp { size: 1, modified_ns: -2, inode: 3 }");
    }
    use std::fs;

    /// A document with one triangle, whose buffer is a separate file.
    const DOCUMENT: &str = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],
        "meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],
        "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}],
        "bufferViews":[{"buffer":0,"byteLength":36}],"buffers":[{"byteLength":36,"uri":"URI"}]}"#;

    fn triangle(size: f32) -> Vec<u8> {
        let numbers = [0.0, 0.0, 0.0, size, 0.0, 0.0, 0.0, size, 0.0];
        numbers.iter().flat_map(|number: &f32| number.to_le_bytes()).collect()
    }

    #[test]
    fn changed_buffer_file_reloads_the_obstacle() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, buffer) = (folder.path().join("a.gltf"), folder.path().join("a.bin"));
        fs::write(&path, DOCUMENT.replace("URI", "a.bin")).expect("written");
        fs::write(&buffer, triangle(1.0)).expect("written");
        let settings =
            Settings::paper(0.1, &crate::surface::options::MethodOptions::default()).expect("settings");
        let files = ObstacleFiles::new(vec![path.clone()]);
        let find = || files.find(None).expect("both files");
        let is_known = |found: &FoundObstacles| matches!(found.found[0].content, ObstacleShape::Obstacle(_));
        let first = find();
        let (recorded, stamps) = (first.recorded(), files.stamps(None));
        let loaded = files.load(first, &settings, 1 << 24).expect("a triangle");
        assert_eq!(loaded.obstacles.members.len(), 1);
        let again = find();
        assert!(is_known(&again));
        assert_eq!((again.recorded(), files.stamps(None)), (recorded.clone(), stamps.clone()));
        // Longer than the buffer: the extra bytes are never read, but the file has changed.
        fs::write(&buffer, [triangle(1.0), vec![1; 8]].concat()).expect("written");
        assert_ne!(files.stamps(None), stamps);
        let longer = find();
        assert!(!is_known(&longer));
        assert_eq!(longer.recorded(), recorded);
        fs::write(&buffer, triangle(2.0)).expect("written");
        let other = find();
        assert!(!is_known(&other));
        assert_ne!(other.recorded(), recorded);
        // A new instance computes the same stamps.
        assert_eq!(ObstacleFiles::new(vec![path]).stamps(None), files.stamps(None));
    }

    #[test]
    fn output_that_replaces_an_obstacle_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("inner")).expect("made");
        for name in ["still.obj", "body.0001.obj"] {
            fs::write(at(name), "v 0 0 0\n").expect("written");
        }
        fs::write(at("a.gltf"), DOCUMENT.replace("URI", "a.glb")).expect("written");
        let names = ["inner/../still.obj", "body.####.obj", "missing.obj", "a.gltf"];
        let files = ObstacleFiles::new(names.map(at).to_vec());
        for (output, is_refused) in [
            ("still.obj", true),
            ("inner/../still.obj", true),
            ("still.ply", false),
            ("inner/still.obj", false),
            ("body.0001.obj", true),
            ("body.0002.obj", true),
            ("inner/../body.0003.obj", true),
            ("body.2.obj", false),
            ("body.0002.glb", false),
            ("inner/body.0002.obj", false),
            ("missing.obj", true),
            ("a.glb", true),
        ] {
            assert_eq!(files.replaced_by(&at(output)).is_some(), is_refused, "{output}");
        }
        assert!(!files.are_static() && ObstacleFiles::new(vec![at("still.obj")]).are_static());
    }

    /// A path that exists and is no file will not become one: the daemon must not wait for it.
    #[test]
    #[cfg(unix)]
    fn other_kinds_of_files_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let pipe = folder.path().join("pipe.obj");
        rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, rustix::fs::Mode::RUSR).expect("a pipe");
        let socket = folder.path().join("socket.obj");
        let _listener = std::os::unix::net::UnixListener::bind(&socket).expect("a socket");
        for (path, what) in [
            (Path::new("/dev/zero"), "not a regular file: a device"),
            (&pipe, "not a regular file: a pipe"),
            (&socket, "not a regular file: a socket"),
            (folder.path(), "not a regular file: a folder"),
            (Path::new("missing.obj"), "no such file"),
        ] {
            let files = ObstacleFiles::new(vec![path.to_owned()]);
            let error = files.find(None).err().expect("no obstacle").to_string();
            assert_eq!(error, format!("obstacle {}: {what}", path.display()));
            assert_eq!(files.unreadable().count(), 1);
        }
    }

    #[test]
    fn duplicate_path_is_loaded_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.obj");
        fs::write(&path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("written");
        let files = ObstacleFiles::new(vec![path.clone(), folder.path().join("./a.obj"), path.clone()]);
        let settings =
            Settings::paper(0.1, &crate::surface::options::MethodOptions::default()).expect("settings");
        let loaded = files.load(files.find(None).expect("there"), &settings, 1 << 24).expect("a triangle");
        assert_eq!(loaded.obstacles.members.len(), 1);
        // A loaded obstacle needs no more memory, until its file changes.
        let size = path.metadata().expect("there").len();
        assert_eq!(ObstacleFiles::new(vec![path.clone()]).loading_bytes(None), 9 * size);
        assert_eq!(files.loading_bytes(None), 0);
        fs::write(&path, "v 0 0 0\n").expect("written");
        assert_eq!(files.loading_bytes(None), 9 * 8);
        assert_eq!(ObstacleFiles::new(vec![folder.path().join("b.obj")]).loading_bytes(None), 0);
        let [note] = &loaded.warnings[..] else { panic!("{:?}", loaded.warnings) };
        let note = note.to_string();
        assert!(note.contains(&*path.to_string_lossy()) && note.contains("an open sheet"), "{note}");
    }

    #[test]
    fn buffer_outside_the_folder_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let inner = folder.path().join("inner");
        fs::create_dir_all(inner.join("b.bin")).expect("made");
        fs::write(folder.path().join("a.bin"), triangle(1.0)).expect("written");
        let path = inner.join("a.gltf");
        let absolute_uri = folder.path().join("a.bin").display().to_string().replace('\\', "/");
        for (uri, word) in [
            ("../a.bin", "outside the folder"),
            (absolute_uri.as_str(), "outside the folder"),
            ("b.bin", "not a regular file"),
            ("c.bin", "c.bin"),
        ] {
            fs::write(&path, DOCUMENT.replace("URI", uri)).expect("written");
            let error = ObstacleFiles::new(vec![path.clone()]).find(None).err().expect(uri).to_string();
            assert!(error.contains(word), "{error}");
        }
        // A file with another extension may not have buffer files.
        let path = inner.join("a.json");
        fs::write(&path, DOCUMENT.replace("URI", "a.bin")).expect("written");
        fs::write(inner.join("a.bin"), triangle(1.0)).expect("written");
        let files = ObstacleFiles::new(vec![path]);
        let settings =
            Settings::paper(0.1, &crate::surface::options::MethodOptions::default()).expect("settings");
        let found = files.find(None).expect("readable");
        let error = files.load(found, &settings, 1 << 24).err().expect("a buffer elsewhere").to_string();
        assert!(error.contains("only a .gltf"), "{error}");
    }
}
