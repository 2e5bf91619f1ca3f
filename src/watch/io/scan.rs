//! Scans folders. Events are only hints; a scan shows what a folder really contains.
//!
//! ```text
//!   root ─┬─ dam.0001.bgeo          taken, if the selection takes its name
//!         ├─ take2 ─┬─ dam.ply      taken only if the selection is deep
//!         │         └─ up ──▶ root  a folder within itself: not entered
//!         └─ surfaces               an excluded folder: not entered
//! ```
//!
//! Links are followed. If two paths lead to the same folder, each of its files is reported under both.
//! However, a link to a folder that contains the link is not entered. Each file costs one system call.

use std::fs::{self, DirEntry, Metadata};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crate::pipeline::{FileId, FileStamp, file_of, is_link_loop, real_path};

use crate::watch::core::completeness::Seen;
use crate::watch::core::events::Scan;

use super::selection::{FileFilter, is_hidden};

/// Inspects one file; links are followed. `None` if it is gone, or is not a regular file.
///
/// `trust_clock` says whether this machine's clock sets the file's times.
///
/// # Errors
/// When the system refuses.
pub(crate) fn file_state(path: &Path, trust_clock: bool) -> io::Result<Option<Seen>> {
    match fs::metadata(file_of(path)) {
        Ok(metadata) => Ok(seen(&metadata, trust_clock)),
        Err(error) if is_gone(&error) => Ok(None),
        Err(error) => Err(error),
    }
}

/// Scans `folder`, which is `root` or lies in it, and its sub-folders if the selection is deep. The scan
/// of a folder that the selection does not enter is empty.
///
/// # Errors
/// When `folder` itself cannot be read. Other unreadable paths are reported in [`Scan::problems`].
pub(super) fn scan(
    folder: &Path,
    root: &Path,
    selection: &FileFilter,
    trust_clock: bool,
) -> io::Result<Scan> {
    let edges = ScanLimits::new(root, selection)?;
    let mut walk = FolderScan { root, selection, trust_clock, edges, scan: Scan::default() };
    if folder != root && !selection.enters(root, folder) {
        return Ok(walk.scan);
    }
    let mut around = folders_around(folder, root);
    let mut pending = Vec::new();
    walk.enter(folder, &mut around, &mut pending)?;
    while let Some((next, depth)) = pending.pop() {
        // Drops the folders that were entered since `next` was found, because they do not contain it.
        around.truncate(depth);
        match walk.enter(&next, &mut around, &mut pending) {
            Err(error) if !is_gone(&error) => walk.scan.problems.push((next, error.to_string())),
            _ => {}
        }
    }
    Ok(walk.scan)
}

/// The folders from `root` down to the parent of `folder`.
fn folders_around(folder: &Path, root: &Path) -> Vec<FileId> {
    let outward = folder.ancestors().skip(1).take_while(|outer| outer.starts_with(root));
    let mut around: Vec<FileId> = outward.map(FileId::of).collect();
    around.reverse();
    around
}

/// A scan in progress.
struct FolderScan<'a> {
    root: &'a Path,
    selection: &'a FileFilter,
    trust_clock: bool,
    edges: ScanLimits,
    scan: Scan,
}

impl FolderScan<'_> {
    /// Scans one folder, unless it must not be entered. `around` are the folders that contain it.
    fn enter(
        &mut self,
        folder: &Path,
        around: &mut Vec<FileId>,
        pending: &mut Vec<(PathBuf, usize)>,
    ) -> io::Result<()> {
        let id = FileId::of(folder);
        if around.contains(&id) || self.edges.excludes(folder) {
            return Ok(());
        }
        let entries = fs::read_dir(folder)?;
        around.push(id);
        self.scan.folders.push(folder.to_owned());
        for entry in entries {
            let entry = entry?;
            if is_hidden(&entry.file_name()) {
                continue;
            }
            let path = entry.path();
            match self.take(&entry, &path) {
                Ok(true) => pending.push((path, around.len())),
                Ok(false) => {}
                Err(error) if is_gone(&error) => {}
                Err(error) => self.scan.problems.push((path, error.to_string())),
            }
        }
        Ok(())
    }

    /// Takes a file if it is selected; returns whether the entry is a folder to enter instead.
    fn take(&mut self, entry: &DirEntry, path: &Path) -> io::Result<bool> {
        let kind = entry.file_type()?;
        let is_deep = self.selection.is_deep();
        if kind.is_dir() {
            return Ok(is_deep);
        }
        let is_selected = path.strip_prefix(self.root).is_ok_and(|within| self.selection.takes_name(within));
        let metadata = match kind.is_symlink() {
            true if is_selected || is_deep => match fs::metadata(path) {
                Err(error) if !is_selected && is_link_loop(&error) => return Ok(false),
                Err(error) if is_selected && is_gone(&error) && path.is_symlink() => {
                    self.scan.dangling.push(path.to_owned());
                    return Ok(false);
                }
                metadata => metadata?,
            },
            false if is_selected => entry.metadata()?,
            _ => return Ok(false),
        };
        if let Some(seen) = seen(&metadata, self.trust_clock).filter(|_| is_selected) {
            self.scan.files.push((path.to_owned(), seen));
        }
        Ok(is_deep && metadata.is_dir())
    }
}

/// The limits of a scan: the root and the excluded folders, by their canonical paths.
struct ScanLimits {
    root: PathBuf,
    excluded: Vec<PathBuf>,
}

impl ScanLimits {
    fn new(root: &Path, selection: &FileFilter) -> io::Result<ScanLimits> {
        root.metadata()?;
        // A missing folder excludes nothing. A folder that contains the root excludes nothing either: see
        // `excludes`.
        let excluded = selection.excluded().iter().filter(|folder| folder.exists());
        Ok(ScanLimits { excluded: excluded.map(|folder| real_path(folder)).collect(), root: real_path(root) })
    }

    /// Whether this folder is excluded: of the root and the excluded folders, the innermost that contains
    /// this folder decides.
    fn excludes(&self, folder: &Path) -> bool {
        if self.excluded.is_empty() {
            return false;
        }
        let folder = real_path(folder);
        let in_root = folder.starts_with(&self.root);
        let excludes = |excluded: &PathBuf| {
            folder.starts_with(excluded) && !(in_root && self.root.starts_with(excluded))
        };
        self.excluded.iter().any(excludes)
    }
}

/// The state of a file; `None` if the path is not a regular file.
fn seen(metadata: &Metadata, trust_clock: bool) -> Option<Seen> {
    if !metadata.is_file() {
        return None;
    }
    let stamp = FileStamp::of(metadata);
    // Modification times can be set to any value, but setting them changes the status change time.
    let changed_ns = stamp.modified_ns.max(stamp.changed_ns.unwrap_or(i64::MIN));
    let age = u64::try_from(changed_ns).ok().filter(|_| trust_clock).and_then(|changed_ns| {
        SystemTime::now().duration_since(UNIX_EPOCH + Duration::from_nanos(changed_ns)).ok()
    });
    Some(Seen { stamp, age })
}

/// Whether the path no longer exists, for example because one of its folders is now a file.
fn is_gone(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory)
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use super::*;
    use std::ffi::OsStr;
    use std::fs::File;
    use std::os::unix::ffi::OsStrExt;
    use std::os::unix::fs::symlink;

    use tempfile::{TempDir, tempdir};

    /// Creates a folder with empty files at these paths.
    fn folder_of(paths: &[&str]) -> TempDir {
        let folder = tempdir().expect("a folder");
        for path in paths {
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().expect("a folder")).expect("made");
            fs::write(path, b"").expect("written");
        }
        folder
    }

    fn selection(pattern: Option<&str>, excluded: &[PathBuf]) -> FileFilter {
        FileFilter::new(pattern.or(Some("**")), excluded.to_vec()).expect("a pattern")
    }

    /// The paths that a scan finds, relative to its root and sorted; the scan must have no problems.
    fn found(root: &Path, selection: &FileFilter) -> Vec<String> {
        let scan = scan(root, root, selection, true).expect("readable");
        assert!(scan.problems.is_empty(), "{:?}", scan.problems);
        names(root, scan.files.iter().map(|file| &*file.0))
    }

    fn names<'a>(root: &Path, paths: impl Iterator<Item = &'a Path>) -> Vec<String> {
        let within = |path: &Path| path.strip_prefix(root).expect("within").to_string_lossy().into_owned();
        let mut names: Vec<String> = paths.map(within).collect();
        names.sort();
        names
    }

    #[test]
    fn scan_takes_the_same_files_as_the_name_filter() {
        let paths = [
            "a.1.ply",
            "b/a.2.ply",
            "b/c/a.3.ply",
            "b/x.txt",
            "notes.md",
            ".h.ply",
            ".b/a.ply",
            "frame.0001",
            "out/a.ply",
        ];
        let folder = folder_of(&paths);
        let root = folder.path();
        let excluded = [root.join("out")];
        for (pattern, expected) in [
            (Some("**"), &["a.1.ply", "b/a.2.ply", "b/c/a.3.ply", "b/x.txt"][..]),
            (None, &["a.1.ply"]),
            (Some("**/a.*.ply"), &["a.1.ply", "b/a.2.ply", "b/c/a.3.ply"]),
            (Some("a.*.ply"), &["a.1.ply"]),
            (Some("*/a.*"), &["b/a.2.ply"]),
            (Some("**/a.[13].ply"), &["a.1.ply", "b/c/a.3.ply"]),
            (Some("frame.????"), &["frame.0001"]),
        ] {
            let selection = FileFilter::new(pattern, excluded.to_vec()).expect("a pattern");
            assert_eq!(found(root, &selection), expected, "{pattern:?}");
            let selected =
                paths.map(|path| root.join(path)).into_iter().filter(|path| selection.takes(root, path));
            let selected: Vec<PathBuf> = selected.collect();
            assert_eq!(names(root, selected.iter().map(|path| &**path)), expected, "{pattern:?}");
        }
        let flat = FileFilter::new(None, Vec::new()).expect("no pattern");
        let scan = scan(root, root, &flat, true).expect("readable");
        assert_eq!(scan.folders, [root]);
    }

    /// The innermost of the root and the excluded folders decides.
    #[test]
    fn folder_of_outputs_may_be_inside_or_around_the_watched_folder() {
        let folder = folder_of(&["a.ply", "out/b.ply", "out/deep/c.ply", "in/d.ply"]);
        let root = folder.path();
        let outside = tempdir().expect("a folder");
        symlink(root.join("out/deep"), outside.path().join("link")).expect("linked");
        fs::write(outside.path().join("e.ply"), b"").expect("written");
        for (case, root, excluded, expected) in [
            ("within", root, root.join("out"), &["a.ply", "in/d.ply"][..]),
            ("the same", root, root.to_owned(), &["a.ply", "in/d.ply", "out/b.ply", "out/deep/c.ply"]),
            ("around", &root.join("in"), root.to_owned(), &["d.ply"]),
            ("by another path", root, root.join("in/../out"), &["a.ply", "in/d.ply"]),
            ("through a link into it", outside.path(), root.join("out"), &["e.ply"]),
            ("not there", root, root.join("gone"), &["a.ply", "in/d.ply", "out/b.ply", "out/deep/c.ply"]),
        ] {
            assert_eq!(found(root, &selection(None, &[excluded])), expected, "{case}");
        }
        let selection = selection(None, &[root.join("out")]);
        let part = scan(&root.join("out/deep"), root, &selection, true).expect("readable");
        assert!(part.folders.is_empty() && part.files.is_empty(), "scanned directly: {part:?}");
    }

    #[test]
    fn links_are_followed_but_cycles_are_not() {
        let folder = folder_of(&["a/1.ply", "b/2.ply"]);
        let root = folder.path();
        for (target, link) in [
            ("a/1.ply", "l.ply"),
            ("..", "a/up"),
            ("../b", "a/side"),
            ("../a", "b/side"),
            (".", "here"),
            ("nowhere.ply", "broken.ply"),
        ] {
            symlink(target, root.join(link)).expect("linked");
        }
        let expected = ["a/1.ply", "a/side/2.ply", "b/2.ply", "b/side/1.ply", "l.ply"];
        let selection = selection(None, &[]);
        assert_eq!(found(root, &selection), expected);
        // A scan of a sub-folder finds the same files there.
        let part = scan(&root.join("a"), root, &selection, true).expect("readable");
        assert_eq!(names(root, part.files.iter().map(|file| &*file.0)), ["a/1.ply", "a/side/2.ply"]);
        assert_eq!(names(root, part.folders.iter().map(|folder| &**folder)), ["a", "a/side"]);
        let round = scan(&root.join("a/up"), root, &selection, true).expect("readable");
        assert!(round.folders.is_empty(), "{round:?}");
        let hidden = scan(&root.join(".git"), root, &selection, true).expect("not entered");
        assert!(hidden.folders.is_empty(), "{hidden:?}");
    }

    #[test]
    fn names_need_not_be_utf8() {
        let folder = tempdir().expect("a folder");
        let sub = folder.path().join(OsStr::from_bytes(b"caf\xe9"));
        let path = sub.join(OsStr::from_bytes(b"gr\xf6\xdfe.1.ply"));
        // Some file systems only accept UTF-8.
        if fs::create_dir(&sub).and_then(|()| fs::write(&path, b"")).is_err() {
            return;
        }
        for pattern in [None, Some("**/*.ply"), Some("*/*.ply")] {
            let selection = selection(pattern, &[]);
            let scan = scan(folder.path(), folder.path(), &selection, true).expect("readable");
            assert_eq!(scan.files[0].0, path);
            assert!(selection.takes(folder.path(), &path));
        }
    }

    #[test]
    fn unreadable_paths_are_reported_as_problems() {
        use std::os::unix::fs::PermissionsExt;
        let folder = folder_of(&["a.ply", "locked/b.ply"]);
        let root = folder.path();
        symlink("round.ply", root.join("round.ply")).expect("linked");
        let locked = root.join("locked");
        fs::set_permissions(&locked, PermissionsExt::from_mode(0o000)).expect("locked");
        let mut expected = vec!["round.ply"];
        // Some users, such as root, may read everything.
        if fs::read_dir(&locked).is_err() {
            expected.insert(0, "locked");
        }
        let scan = scan(root, root, &selection(None, &[]), true).expect("readable");
        fs::set_permissions(&locked, PermissionsExt::from_mode(0o700)).expect("unlocked");
        assert_eq!(names(root, scan.problems.iter().map(|problem| &*problem.0)), expected);
        assert!(scan.files.iter().any(|file| file.0 == root.join("a.ply")));
    }

    #[test]
    fn scan_of_a_missing_root_fails() {
        let folder = folder_of(&["a.ply"]);
        let selection = selection(None, &[]);
        for path in [folder.path().join("gone"), folder.path().join("a.ply")] {
            let error = scan(&path, &path, &selection, true).expect_err("no folder");
            assert!(is_gone(&error), "{error}");
        }
    }

    #[test]
    fn file_state_is_that_of_regular_files_only() {
        let folder = folder_of(&["a.ply"]);
        let path = folder.path().join("a.ply");
        let file = file_state(&path, true).expect("readable").expect("a file");
        assert_eq!(file.stamp, FileStamp::of_path(&path).expect("a stamp"));
        let a_while = Duration::from_secs(600);
        assert!(file.age.is_some_and(|age| age < a_while), "{:?}", file.age);
        assert_eq!(file_state(&path, false).expect("readable").expect("a file").age, None);
        for nothing in
            [folder.path().to_owned(), folder.path().join("gone"), path.join("within"), "/dev/null".into()]
        {
            assert_eq!(file_state(&nothing, true).expect("an answer"), None, "{}", nothing.display());
        }
        let set = |time| {
            let file = File::options().append(true).open(&path).expect("a file");
            file.set_modified(time).expect("set");
            file_state(&path, true).expect("readable").expect("a file").age
        };
        // The age of a time in the future is unknown.
        assert_eq!(set(SystemTime::now() + Duration::from_secs(3600)), None);
        // Setting the time is itself a change.
        assert!(set(SystemTime::UNIX_EPOCH).is_some_and(|age| age < a_while));
    }
}
