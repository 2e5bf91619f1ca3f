//! The obstacles of a sequence: finds those of each frame, and loads them.
//!
//! ```text
//!   floor.obj          an obstacle of every frame; read once, and again after a change
//!   body.####.obj      moves: each frame needs the file with its own number, or fails
//!   body.usdc          moves if its meshes have several samples: each frame has the meshes of its number
//! ```
//!
//! The files of a frame are found and hashed first. They are parsed only if the frame is not done already.

use std::collections::{HashMap, HashSet};
use std::fmt;
use std::io;
use std::path::{Path, PathBuf, absolute};
use std::sync::{Arc, Mutex, PoisonError};

use crate::surface::obstacle::{Obstacle, Obstacles};
use crate::surface::options::Settings;

use super::obstacle_file::{
    ObstacleSource, ReadObstacle, failed, findings_of, further_files, loading_factor, may_have_further_files,
    name_of, open_edges, parse, read, require_volume,
};
use crate::pipeline::error::ObstacleError;
use crate::pipeline::files::identity::{are_same_file, canonical_path};
use crate::pipeline::files::number_pattern::{NumberPattern, may_be_file};
use crate::pipeline::files::open::require_regular;
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::warning::Warning;

/// The obstacles of a sequence.
#[derive(Debug, Default)]
pub struct ObstacleFiles {
    paths: Vec<PathBuf>,
    /// The loaded obstacles that do not move, by their paths.
    loaded: Mutex<HashMap<PathBuf, LoadedObstacle>>,
    /// The files of each obstacle that may have several, its own first.
    further: Mutex<HashMap<PathBuf, StampedFiles>>,
}

/// Files, and their stamps when they were found.
type StampedFiles = Vec<(PathBuf, Option<FileStamp>)>;

/// The state of a frame's obstacle files at one time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ObstacleStamps {
    /// The stamps as short text: equal texts mean that no file was written in between.
    pub text: String,
    /// Whether every file exists.
    pub all_exist: bool,
}

#[derive(Clone)]
struct LoadedObstacle {
    source: ObstacleSource,
    obstacle: Arc<Obstacle>,
}

impl fmt::Debug for LoadedObstacle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("LoadedObstacle").field("hash", &self.source.hash).finish_non_exhaustive()
    }
}

/// The obstacles of a frame, found and hashed.
#[derive(Default)]
pub(crate) struct FoundObstacles(Vec<FoundObstacle>);

struct FoundObstacle {
    source: ObstacleSource,
    content: ObstacleContent,
}

/// What was read from an obstacle file now, or loaded from it earlier.
enum ObstacleContent {
    Read(ReadObstacle),
    Loaded(Arc<Obstacle>),
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

/// The cached leaves of obstacles may take this fraction of the memory for a frame.
const OBSTACLE_SHARE: u64 = 16;

impl ObstacleFiles {
    /// Obstacles at these paths. If a path does not exist and its name has a placeholder for a number, as in
    /// `body.####.obj`, each frame has the file with its own number.
    pub fn new(mut paths: Vec<PathBuf>) -> ObstacleFiles {
        // Duplicate paths are loaded, and warned about, once.
        let mut seen = HashSet::new();
        paths.retain(|path| seen.insert(absolute(path).unwrap_or_else(|_| path.clone())));
        ObstacleFiles { paths, ..ObstacleFiles::default() }
    }

    /// Whether there are no obstacles.
    pub fn is_empty(&self) -> bool {
        self.paths.is_empty()
    }

    /// Whether no obstacle moves, so that all frames share the same ones.
    pub fn are_static(&self) -> bool {
        self.paths.iter().all(|path| moving_pattern(path).is_none())
    }

    /// The paths that no frame can read, and why: no such file exists, or it is a folder or a device, and the
    /// name has no placeholder.
    pub fn unreadable(&self) -> impl Iterator<Item = (&Path, io::Error)> {
        self.paths.iter().filter(|path| moving_pattern(path).is_none()).filter_map(|path| {
            let error = path.metadata().and_then(|metadata| require_regular(&metadata)).err()?;
            Some((path.as_path(), error))
        })
    }

    /// The obstacle that an output would replace, or that the output would be mistaken for: for a moving
    /// obstacle, any file that matches its pattern.
    pub(crate) fn replaced_by(&self, output: &Path) -> Option<&Path> {
        let entry = canonical_path(output);
        let name = entry.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let is_member = |path: &Path, pattern: NumberPattern| {
            pattern.span_in(name).is_some() && canonical_path(path).parent() == entry.parent()
        };
        let is_replaced = |path: &&PathBuf| {
            are_same_file(path, output)
                || moving_pattern(path).is_some_and(|pattern| is_member(path, pattern))
                || self.further_files(path).iter().any(|buffer| are_same_file(buffer, output))
        };
        self.paths.iter().find(is_replaced).map(PathBuf::as_path)
    }

    /// The current state of a frame's obstacle files.
    pub fn stamps(&self, number: Option<i64>) -> ObstacleStamps {
        let mut stamps = ObstacleStamps { text: String::new(), all_exist: true };
        for path in &self.paths {
            let Ok(file) = file_of(path, number) else {
                stamps.add(path, None);
                continue;
            };
            stamps.add(path, FileStamp::of_path(&file).ok());
            for buffer in self.further_files(&file) {
                stamps.add(&buffer, FileStamp::of_path(&buffer).ok());
            }
        }
        stamps
    }

    /// The memory that loading a frame's obstacles may take, without those that are loaded already, in bytes.
    pub(crate) fn loading_bytes(&self, number: Option<i64>) -> u64 {
        let mut loading_bytes: u64 = 0;
        for file in self.paths.iter().filter_map(|path| file_of(path, number).ok()) {
            if self.unchanged(&file).is_none() {
                let files = self.further_files(&file).into_iter().chain([file.clone()]);
                let sizes = files.map(|file| file.metadata().map_or(0, |metadata| metadata.len()));
                let bytes = sizes.fold(0, u64::saturating_add).saturating_mul(loading_factor(&file));
                loading_bytes = loading_bytes.saturating_add(bytes);
            }
        }
        loading_bytes
    }

    /// Finds and hashes the obstacles of a frame.
    pub(crate) fn find(&self, number: Option<i64>) -> Result<FoundObstacles, ObstacleError> {
        let found = self.paths.iter().map(|path| {
            let file = file_of(path, number)?;
            Ok(match self.unchanged(&file) {
                Some(LoadedObstacle { source, obstacle }) => {
                    FoundObstacle { source, content: ObstacleContent::Loaded(obstacle) }
                }
                None => {
                    let (source, read) = read(file, number)?;
                    FoundObstacle { source, content: ObstacleContent::Read(read) }
                }
            })
        });
        Ok(FoundObstacles(found.collect::<Result<_, _>>()?))
    }

    /// Loads the obstacles. Reading a level set, together with the obstacles before it, may take
    /// `memory_bytes` at most; the cached leaves of all obstacles may take a small part of that.
    pub(crate) fn load(
        &self,
        found: FoundObstacles,
        settings: &Settings,
        memory_bytes: u64,
    ) -> Result<FrameObstacles, ObstacleError> {
        let cache_bytes_max = memory_bytes / OBSTACLE_SHARE / found.0.len().max(1) as u64;
        let cache_bytes_max = usize::try_from(cache_bytes_max).unwrap_or(usize::MAX);
        let mut all = FrameObstacles { recorded: found.recorded(), ..FrameObstacles::default() };
        for FoundObstacle { source, content } in found.0 {
            let path = source.path.clone();
            let obstacle = match content {
                ObstacleContent::Loaded(obstacle) => obstacle,
                // All its meshes may be hidden in this frame.
                ObstacleContent::Read(ReadObstacle::Meshes(meshes))
                    if source.is_animated && meshes.triangles.is_empty() =>
                {
                    continue;
                }
                ObstacleContent::Read(read) => {
                    let shape = parse(&path, read, memory_bytes.saturating_sub(all.all_bytes))?;
                    require_volume(&path, &shape)?;
                    let findings = findings_of(&shape, settings);
                    all.warnings.extend(findings.iter().map(|finding| Warning::of_obstacle(&path, finding)));
                    let obstacle = Arc::new(Obstacle::new(shape, cache_bytes_max));
                    if self.paths.contains(&path) && !source.is_animated {
                        let loaded = LoadedObstacle { source, obstacle: Arc::clone(&obstacle) };
                        lock(&self.loaded).insert(path.clone(), loaded);
                    } else {
                        all.own_bytes += obstacle.size_bytes_max() as u64;
                    }
                    obstacle
                }
            };
            all.paths.push(path);
            all.all_bytes += obstacle.size_bytes_max() as u64;
            all.open_edge_count += open_edges(obstacle.sdf());
            all.obstacles.members.push(obstacle);
        }
        Ok(all)
    }

    /// The obstacle that was loaded from a file, if the file has not changed since.
    fn unchanged(&self, file: &Path) -> Option<LoadedObstacle> {
        let loaded = lock(&self.loaded).get(file).cloned();
        loaded.filter(|loaded| loaded.source.is_unchanged())
    }

    /// The further files of an obstacle; empty if the obstacle cannot be read at present.
    fn further_files(&self, path: &Path) -> Vec<PathBuf> {
        if !may_have_further_files(path) {
            return Vec::new();
        }
        let stamp_of = |file: &Path| FileStamp::of_path(file).ok();
        let known = lock(&self.further).get(path).cloned();
        let is_current = |known: &StampedFiles| known.iter().all(|(file, stamp)| stamp_of(file) == *stamp);
        let files = known.filter(is_current).unwrap_or_else(|| {
            let own = (path.to_owned(), stamp_of(path));
            let further = further_files(path).into_iter().map(|file| (file.clone(), stamp_of(&file)));
            let files: StampedFiles = [own].into_iter().chain(further).collect();
            lock(&self.further).insert(path.to_owned(), files.clone());
            files
        });
        files.into_iter().skip(1).map(|(file, _)| file).collect()
    }
}

impl ObstacleStamps {
    /// Adds a file. Its status change time is left out: `chmod` and new hard links change no content, and must
    /// not cause every frame to be converted again.
    fn add(&mut self, path: &Path, stamp: Option<FileStamp>) {
        self.all_exist &= stamp.is_some();
        self.text += &match stamp {
            Some(FileStamp { size, modified_ns, inode, .. }) => {
                format!("{}: {size} {modified_ns} {inode}\n", path.display())
            }
            None => format!("{}: none\n", path.display()),
        };
    }
}

impl FoundObstacles {
    /// The text that records contain: independent of the folder that the files are in.
    pub(crate) fn recorded(&self) -> String {
        let texts = self.0.iter().map(|FoundObstacle { source, .. }| {
            format!("{} xxh3-128:{:032x}", name_of(&source.path), source.hash)
        });
        texts.collect::<Vec<_>>().join(", ")
    }
}

/// Each update of the map is complete before the lock is released, so the map is consistent even if the
/// lock is poisoned.
fn lock<T>(map: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    map.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The pattern in the name of a moving obstacle; `None` for the path of a file.
fn moving_pattern(path: &Path) -> Option<NumberPattern<'_>> {
    if may_be_file(path) { None } else { NumberPattern::find(path.file_name()?.to_str()?) }
}

/// The obstacle file for the frame with this number: `path` itself, or the file of its pattern.
fn file_of(path: &Path, number: Option<i64>) -> Result<PathBuf, ObstacleError> {
    let missing =
        |path: &Path, message: String| Err(failed(path, io::Error::new(io::ErrorKind::NotFound, message)));
    let Some(pattern) = moving_pattern(path) else {
        return match path.metadata().map(|metadata| require_regular(&metadata)) {
            Ok(Err(error)) => Err(failed(path, error)),
            _ if may_be_file(path) => Ok(path.to_owned()),
            _ => missing(path, "no such file".into()),
        };
    };
    let Some(number) = number else {
        return missing(path, "the frame has no number, so no file of this pattern belongs to it".into());
    };
    let folder = path.parent().unwrap_or(Path::new(""));
    match pattern.file_of(folder, number).map_err(|error| failed(path, error))? {
        Some(file) => Ok(file),
        None => {
            let expected = path.with_file_name(pattern.name_of(number));
            missing(&expected, format!("no such file: {} has no file for frame {number}", name_of(path)))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
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
        let is_known = |found: &FoundObstacles| matches!(found.0[0].content, ObstacleContent::Loaded(_));
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
        assert!(note.contains(&*path.to_string_lossy()) && note.contains("1 open sheet"), "{note}");
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
            ("../a.bin", "outside of its own folder"),
            (absolute_uri.as_str(), "not a path relative"),
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
