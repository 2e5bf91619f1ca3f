//! Files that replace others together: after a failure or a kill, the folder has all the old files or all the new ones.
//!
//! A rename replaces one file at once; several renames can be cut off between two of them. So before the first:
//!
//! ```text
//!   .meniscus-set-9f3c…       the record: the names, and which files will replace them; locked, and on the disk
//!   .meniscus-set-9f3c….0     another name of the old dam.0012.glb      hard links
//!   .meniscus-set-9f3c….1     another name of the old dam.0012.vdb
//!            │
//!            │ rename each new file, then put the folder on the disk
//!            ▼
//!   remove the record         from here on the new files stay
//!   remove the old files
//! ```
//!
//! A rename that fails puts the old files back; a name that was free becomes free again. A process that is killed leaves its
//! record without a lock: [`sweep_temporaries`](super::temporary::sweep_temporaries) finds it and goes on with the renames,
//! so that no output that somebody has seen is taken away. Where that is impossible, for a new file is gone, it puts the old files back. That
//! happens when a daemon starts, when `convert` begins, and when a shard begins, in their folder. Until then, and between two renames,
//! readers can see a mixed set; a certificate, which has the hashes of all files of its frame, tells them.
//!
//! A record is used only if this user made it, it has one name, and this version can read it. Any other is left in place with
//! its old files, and the sweep returns a warning.
//!
//! The record has the size, the time of the last write and the inode of each new and old file. A file that is neither was
//! written later, and stays. If all names have later files, the set is superseded, and its record and old files are removed:
//! so it is when a run could not read the record and made the frame again. If only some names have, their old files stay, and
//! so does the record.
//!
//! Where the file system has no hard links the old file is renamed instead, and for a moment its name does not exist.

use std::collections::HashSet;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File, Metadata};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::MutexGuard;

use super::sink::{Unseen, sync_folder};
use super::stamp::FileStamp;
use super::temporary::{
    Temporary, is_temporary_name, leave_behind, lock_abandoned, random_number, remove_if_there, under_way,
};

/// What the name of a record begins with; 16 hexadecimal digits follow.
const RECORD_PREFIX: &str = ".meniscus-set-";

/// The first words of a record.
const RECORD_HEAD: &[u8] = b"meniscus set 2\0";
/// The last word of one that is whole.
const RECORD_END: &[u8] = b"end\0";

/// Longer than any record: a frame has a dozen names.
const RECORD_BYTES_MAX: u64 = 1 << 20;

/// So often it is tried to put the old files back before that is left for later.
const UNDO_ATTEMPTS: usize = 3;

/// What tells a file from another that has its name later; a rename keeps it. Size and time alone do not: on some file
/// systems the time has a resolution of two seconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Trait {
    size: u64,
    modified_ns: i64,
    /// 0 on systems without inodes.
    inode: u64,
}

impl From<FileStamp> for Trait {
    fn from(FileStamp { size, modified_ns, inode, .. }: FileStamp) -> Trait {
        Trait { size, modified_ns, inode }
    }
}

/// A name, and the file that is to appear there.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Member {
    name: Box<OsStr>,
    /// The name of the new file until then.
    temporary: Box<OsStr>,
    new: Trait,
    /// Of the file that had the name before, if there was one.
    old: Option<Trait>,
}

/// Lets several files of one folder appear under their names.
///
/// # Errors
/// The path that cannot be replaced, and why. All names have the files that they had before, unless the error says
/// otherwise.
pub(super) fn replace_together(files: &[Unseen]) -> Result<(), (PathBuf, io::Error)> {
    let Some(first) = files.first() else { return Ok(()) };
    let folder = first.path().parent().unwrap_or(Path::new(""));
    let members = files.iter().map(member).collect::<Result<Vec<_>, _>>()?;
    let at_first = |error| (first.path().to_owned(), error);
    let record = write_record(folder, &members).map_err(at_first)?;
    let set = FileSet { record_path: record.path().to_owned(), members };

    // Locked for all renames: a stop comes before the first or after the last.
    let locked = under_way();
    let error = match set.replace(files) {
        Ok(()) => {
            drop(locked);
            sync_folder(folder);
            match set.commit(&record) {
                Ok(()) => {
                    set.remove_old_files();
                    return Ok(());
                }
                Err(error) => at_first(error),
            }
        }
        // Still locked: a stop that took the record now would take the way back.
        Err(error) => return Err(set.undo_after(error, record, locked)),
    };
    Err(set.undo_after(error, record, under_way()))
}

/// What is known of a file and of its name before anything is replaced.
fn member(file: &Unseen) -> Result<Member, (PathBuf, io::Error)> {
    let failed = |error| (file.path().to_owned(), error);
    let name = file.path().file_name().ok_or_else(|| failed(io::ErrorKind::InvalidFilename.into()))?;
    let temporary = file.written_path().file_name().unwrap_or_default();
    let old = trait_of(file.path()).map_err(failed)?;
    Ok(Member { name: name.into(), temporary: temporary.into(), new: file.stamp().into(), old })
}

/// Writes the record: onto the disk where files will be replaced, for a crash of the machine must not come between these.
fn write_record(folder: &Path, members: &[Member]) -> io::Result<Temporary> {
    let record = Temporary::create_named(&folder.join("record"), || {
        format!("{RECORD_PREFIX}{:016x}", random_number())
    })?;
    record.file().write_all(&record_bytes(members))?;
    if members.iter().any(|member| member.old.is_some()) {
        record.file().sync_all()?;
    }
    Ok(record)
}

fn record_bytes(members: &[Member]) -> Vec<u8> {
    let mut bytes = RECORD_HEAD.to_vec();
    let text = |it: &Trait| format!("{} {} {}", it.size, it.modified_ns, it.inode);
    for Member { name, temporary, new, old } in members {
        let old = old.as_ref().map(text).unwrap_or_default();
        for part in
            [name.as_encoded_bytes(), temporary.as_encoded_bytes(), text(new).as_bytes(), old.as_bytes()]
        {
            bytes.extend(part);
            bytes.push(0);
        }
    }
    bytes.extend(RECORD_END);
    bytes
}

/// What the bytes of a record say.
#[derive(Debug, PartialEq, Eq)]
enum Parsed {
    /// The files to replace.
    Whole(Vec<Member>),
    /// It is empty, or its end is missing: no file was replaced, or all were.
    CutOff,
    /// Another version of this program wrote it, or it is damaged.
    Unknown,
}

fn parse_record(bytes: &[u8]) -> Parsed {
    if let Some(members) = parse_members(bytes) {
        return Parsed::Whole(members);
    }
    let is_begun = RECORD_HEAD.starts_with(bytes) || bytes.starts_with(RECORD_HEAD);
    let is_too_long = bytes.len() as u64 >= RECORD_BYTES_MAX;
    match is_begun && !is_too_long && !bytes.ends_with(RECORD_END) {
        true => Parsed::CutOff,
        false => Parsed::Unknown,
    }
}

fn parse_members(bytes: &[u8]) -> Option<Vec<Member>> {
    let lines = bytes.strip_prefix(RECORD_HEAD)?.strip_suffix(RECORD_END)?;
    let parts: Option<Vec<&[u8]>> =
        lines.split_inclusive(|byte| *byte == 0).map(|part| part.strip_suffix(&[0])).collect();
    parts?.chunks(4).map(parse_member).collect()
}

fn parse_member(parts: &[&[u8]]) -> Option<Member> {
    let &[name, temporary, new, old] = parts else { return None };
    // Nothing outside the folder is touched, and nothing that is not ours is renamed, whoever wrote the record.
    let plain = |bytes: &[u8]| {
        name_of_bytes(bytes)
            .filter(|name| Path::new(name).file_name() == Some(name) && !bytes.contains(&b'/'))
    };
    let temporary = plain(temporary)?;
    if !is_temporary_name(&temporary.to_string_lossy()) {
        return None;
    }
    let old = match old {
        b"" => None,
        old => Some(parse_trait(old)?),
    };
    Some(Member { name: plain(name)?.into(), temporary: temporary.into(), new: parse_trait(new)?, old })
}

fn parse_trait(bytes: &[u8]) -> Option<Trait> {
    let mut numbers = str::from_utf8(bytes).ok()?.split(' ');
    let (size, modified_ns, inode) = (numbers.next()?, numbers.next()?, numbers.next()?);
    let read = Trait {
        size: size.parse().ok()?,
        modified_ns: modified_ns.parse().ok()?,
        inode: inode.parse().ok()?,
    };
    numbers.next().is_none().then_some(read)
}

#[cfg(unix)]
fn name_of_bytes(bytes: &[u8]) -> Option<OsString> {
    Some(std::os::unix::ffi::OsStringExt::from_vec(bytes.to_vec()))
}

#[cfg(not(unix))]
fn name_of_bytes(bytes: &[u8]) -> Option<OsString> {
    str::from_utf8(bytes).ok().map(OsString::from)
}

/// Names that get other files together.
#[derive(Debug)]
struct FileSet {
    record_path: PathBuf,
    members: Vec<Member>,
}

impl FileSet {
    fn path(&self, member: &Member) -> PathBuf {
        self.record_path.with_file_name(&member.name)
    }

    fn temporary_path(&self, member: &Member) -> PathBuf {
        self.record_path.with_file_name(&member.temporary)
    }

    /// Where the old file of a member is kept.
    fn old_path(&self, index: usize) -> PathBuf {
        let mut path = self.record_path.clone().into_os_string();
        path.push(format!(".{index}"));
        path.into()
    }

    /// Keeps the old files, and renames the new ones.
    fn replace(&self, files: &[Unseen]) -> Result<(), (PathBuf, io::Error)> {
        let mut is_kept = vec![true; files.len()];
        for (index, file) in files.iter().enumerate() {
            if self.members[index].old.is_some() {
                match change::hard_link(file.path(), &self.old_path(index)) {
                    // Somebody else has just removed it.
                    Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                    linked => is_kept[index] = linked.is_ok(),
                }
            }
        }
        for (index, file) in files.iter().enumerate() {
            let moved = match is_kept[index] {
                true => Ok(()),
                false => change::rename(file.path(), &self.old_path(index)),
            };
            let renamed = moved.and_then(|()| change::rename(file.written_path(), file.path()));
            renamed.map_err(|error| (file.path().to_owned(), error))?;
        }
        Ok(())
    }

    /// From here on the new files stay.
    fn commit(&self, record: &Temporary) -> io::Result<()> {
        // One that is not whole counts as none.
        change::remove(&self.record_path).or_else(|error| change::empty(record.file()).map_err(|_| error))
    }

    fn remove_old_files(&self) {
        for (index, member) in self.members.iter().enumerate() {
            let old = self.old_path(index);
            if member.old.is_some() && remove_if_there(&old).is_err() {
                leave_behind(old);
            }
        }
    }

    /// Puts the old files back because of this error. Where that fails the record stays, so that it is done later.
    fn undo_after(
        &self,
        (path, error): (PathBuf, io::Error),
        record: Temporary,
        mut locked: MutexGuard<'_, HashSet<PathBuf>>,
    ) -> (PathBuf, io::Error) {
        let mut undone = self.undo();
        for _ in 1..UNDO_ATTEMPTS {
            undone = undone.or_else(|_| self.undo());
        }
        let of_undo = match undone {
            Ok(kept) if kept.is_empty() => {
                // Removing the record takes the lock.
                drop(locked);
                return (path, error);
            }
            Ok(kept) => io::Error::other(said_of_kept(&kept)),
            Err(of_undo) => of_undo,
        };
        for member in &self.members {
            // Else the set could be completed later, which has failed.
            let _ = remove_if_there(&self.temporary_path(member));
        }
        locked.remove(&self.record_path);
        drop(locked);
        record.keep();
        let what = format!("{error}; the files that were replaced are not put back yet: {of_undo}");
        (path, io::Error::new(error.kind(), what))
    }

    /// Whether some new files have their names, and the others can still get theirs.
    fn can_be_completed(&self) -> io::Result<bool> {
        let mut is_begun = false;
        for (index, member) in self.members.iter().enumerate() {
            let found = trait_of(&self.path(member))?;
            if found == Some(member.new) {
                is_begun = true;
                continue;
            }
            let is_as_before = found == member.old || found.is_none() && exists(&self.old_path(index))?;
            if !is_as_before || trait_of(&self.temporary_path(member))? != Some(member.new) {
                return Ok(false);
            }
        }
        Ok(is_begun)
    }

    /// Whether every name has a later file.
    fn is_superseded(&self) -> io::Result<bool> {
        for member in &self.members {
            let found = trait_of(&self.path(member))?;
            if found.is_none() || found == Some(member.new) || found == member.old {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Renames the new files that do not have their names yet.
    fn complete(&self) -> io::Result<()> {
        for member in &self.members {
            let path = self.path(member);
            if trait_of(&path)? != Some(member.new) {
                change::rename(&self.temporary_path(member), &path)?;
            }
        }
        Ok(())
    }

    /// Puts the old files back, as far as nobody else has replaced the new ones. May be done again, and after any part of
    /// it. Returns the old files that another program's file kept from their names: they may be the only copies, so they and the
    /// record have to stay.
    fn undo(&self) -> io::Result<Vec<PathBuf>> {
        let mut kept = Vec::new();
        for (index, member) in self.members.iter().enumerate() {
            let (path, old) = (self.path(member), self.old_path(index));
            let found = trait_of(&path)?;
            let is_new = found == Some(member.new);
            match (member.old.is_some(), exists(&old)?) {
                (true, true) => {
                    if is_new || found.is_none() {
                        change::rename(&old, &path)?;
                    }
                    // Renaming one name of a file to another does nothing.
                    let [named, backup] = [trait_of(&path)?, trait_of(&old)?];
                    if backup.is_none() || named == member.old || named == backup {
                        change::remove(&old)?;
                    } else {
                        kept.push(old);
                    }
                }
                (false, _) if is_new => change::remove(&path)?,
                // Put back already, or not yet replaced.
                _ => {}
            }
        }
        Ok(kept)
    }
}

/// What is wrong with these old files.
fn said_of_kept(kept: &[PathBuf]) -> String {
    let kept: Vec<_> = kept.iter().map(|path| path.display().to_string()).collect();
    format!(
        "another program has replaced outputs meanwhile; the files that had their names are {}",
        kept.join(", ")
    )
}

/// What has this name; `None` if it is free.
fn trait_of(path: &Path) -> io::Result<Option<Trait>> {
    match path.symlink_metadata() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        found => Ok(Some(FileStamp::of(&found?).into())),
    }
}

/// Whether this user made the file, and it has one name.
#[cfg(unix)]
fn is_own_file(metadata: &Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    metadata.uid() == rustix::process::geteuid().as_raw() && metadata.nlink() == 1
}

#[cfg(not(unix))]
fn is_own_file(_metadata: &Metadata) -> bool {
    true
}

/// Whether a name is taken.
fn exists(path: &Path) -> io::Result<bool> {
    Ok(trait_of(path)?.is_some())
}

/// Whether this is the name of a record.
pub(super) fn is_record_name(name: &str) -> bool {
    name.strip_prefix(RECORD_PREFIX).is_some_and(is_number)
}

/// The path of the record, if this is an old file that is kept.
pub(super) fn record_of_old_file(path: &Path) -> Option<PathBuf> {
    let (record, index) = path.file_name()?.to_str()?.rsplit_once('.')?;
    let is_index = !index.is_empty() && index.bytes().all(|byte| byte.is_ascii_digit());
    (is_index && is_record_name(record)).then(|| path.with_file_name(record))
}

fn is_number(text: &str) -> bool {
    text.len() == 16 && text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

/// What became of a record.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Recovery {
    /// The set was completed, undone or superseded, and the record removed.
    Done,
    /// Another process is using the record.
    InUse,
    /// The record cannot be trusted, or cannot be read. It and all its files were left in place. Says why, and what to do.
    Left(String),
}

/// Completes a set whose process was killed, or puts its old files back.
///
/// # Errors
/// When the system refuses: then all that is needed stays, and it can be tried again.
pub(super) fn recover(record_path: &Path) -> io::Result<Recovery> {
    let Some(mut file) = lock_abandoned(record_path)? else { return Ok(Recovery::InUse) };
    let left = |why: &str| {
        let (path, name) = (record_path.display(), record_path.file_name().unwrap_or_default().display());
        Recovery::Left(format!(
            "{path}: {why}; left in place with the files {name}.0, {name}.1, …, which may be the only copies of replaced outputs"
        ))
    };
    // A record has one name. In a shared folder another account could plant one, or link to one from elsewhere.
    if !is_own_file(&file.metadata()?) {
        return Ok(left(
            "this record of an interrupted conversion belongs to another user or has a second name",
        ));
    }
    let mut bytes = Vec::new();
    (&mut file).take(RECORD_BYTES_MAX).read_to_end(&mut bytes)?;
    let members = match parse_record(&bytes) {
        Parsed::Whole(members) => members,
        Parsed::CutOff => Vec::new(),
        Parsed::Unknown => {
            return Ok(left(
                "this record of an interrupted conversion is damaged or from another version of meniscus: run that \
                 version to restore the files",
            ));
        }
    };
    let set = FileSet { record_path: record_path.to_owned(), members };
    let completed = if set.is_superseded()? {
        Ok(Vec::new())
    } else if set.can_be_completed()? {
        set.complete().map(|()| Vec::new())
    } else {
        set.undo()
    };
    let kept = match completed {
        // Somebody else removed a new file meanwhile.
        Err(error) if error.kind() == io::ErrorKind::NotFound => set.undo()?,
        completed => completed?,
    };
    if !kept.is_empty() {
        return Ok(Recovery::Left(format!(
            "{}: record of an interrupted conversion: {}; to restore one, rename it, then remove the record",
            record_path.display(),
            said_of_kept(&kept)
        )));
    }
    sync_folder(record_path.parent().unwrap_or(Path::new("")));
    change::remove(record_path)?;
    set.remove_old_files();
    Ok(Recovery::Done)
}

/// Removes an old file whose set is complete; whether it was.
///
/// # Errors
/// When the system refuses.
pub(super) fn remove_old_file(old: &Path, record_path: &Path) -> io::Result<bool> {
    // A record is there before the old files, and until they are not needed.
    if exists(record_path)? {
        return Ok(false);
    }
    remove_if_there(old)?;
    Ok(true)
}

/// What changes a folder. Tests let each of these fail, or the process end before it.
mod change {
    use super::*;

    pub(super) fn rename(from: &Path, to: &Path) -> io::Result<()> {
        #[cfg(test)]
        super::tests::before_change(false)?;
        fs::rename(from, to)
    }

    pub(super) fn hard_link(from: &Path, to: &Path) -> io::Result<()> {
        #[cfg(test)]
        super::tests::before_change(true)?;
        fs::hard_link(from, to)
    }

    pub(super) fn remove(path: &Path) -> io::Result<()> {
        #[cfg(test)]
        super::tests::before_change(false)?;
        remove_if_there(path)
    }

    pub(super) fn empty(file: &File) -> io::Result<()> {
        #[cfg(test)]
        super::tests::before_change(false)?;
        file.set_len(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;
    use std::process::Command;
    use std::sync::Mutex;
    use std::time::{Duration, Instant};

    use super::super::out_folder::recover_out_folder;
    use super::super::sink::{publish, write_unseen};
    use super::super::temporary::sweep_temporaries;

    /// What becomes of changes in this thread.
    #[derive(Clone, Copy, Default)]
    struct Trouble {
        /// Changes that are left until the trouble.
        changes_left: usize,
        /// How many changes fail then; `None` ends the process.
        failures: Option<usize>,
        /// No file system has hard links.
        without_links: bool,
    }

    /// Held by tests whose changes fail: any thread takes up what another could not remove, which would cost it a failure.
    static ALONE: Mutex<()> = Mutex::new(());

    thread_local!(static TROUBLE: Cell<Option<Trouble>> = const { Cell::new(None) });

    pub(super) fn before_change(is_link: bool) -> io::Result<()> {
        let Some(mut trouble) = TROUBLE.get() else { return Ok(()) };
        if is_link && trouble.without_links {
            return Err(io::ErrorKind::Unsupported.into());
        }
        let left = trouble.changes_left;
        trouble.changes_left = left.saturating_sub(1);
        let fails = left == 0;
        if fails {
            match &mut trouble.failures {
                None => std::process::abort(),
                Some(0) => return Ok(()),
                Some(failures) => *failures -= 1,
            }
        }
        TROUBLE.set(Some(trouble));
        if fails { Err(io::Error::other("a failing disk")) } else { Ok(()) }
    }

    const NAMES: [&str; 3] = ["a.glb", "a.vdb", "a.json"];

    /// A folder in which the first files are there, and the others are not.
    fn write_old(folder: &Path, count: usize) {
        for name in &NAMES[..count] {
            fs::write(folder.join(name), format!("old {name}")).expect("written");
        }
    }

    fn publish_new(folder: &Path) -> Result<(), (PathBuf, io::Error)> {
        let unseen = NAMES.map(|name| {
            let write = |out: &mut io::BufWriter<&File>| Ok(write!(out, "the new {name}")?);
            write_unseen(&folder.join(name), write).expect("written")
        });
        publish(unseen.into()).map(|_| ())
    }

    /// Puts back what can be, as another process would; any thread of this one may be at it already.
    fn recover_all(folder: &Path) {
        let is_open = || contents(folder).iter().any(|(name, _)| name.starts_with('.'));
        let start = Instant::now();
        while is_open() {
            assert!(start.elapsed() < Duration::from_secs(60), "{:?}", contents(folder));
            sweep_temporaries(folder).expect("there");
        }
    }

    /// What the folder has, hidden files included.
    fn contents(folder: &Path) -> Vec<(String, String)> {
        let entries = fs::read_dir(folder).expect("there").map(|entry| entry.expect("an entry"));
        let mut contents: Vec<_> = entries
            .map(|entry| {
                // What goes meanwhile is gone.
                let text = fs::read_to_string(entry.path()).unwrap_or_default();
                (entry.file_name().into_string().expect("a name"), text)
            })
            .collect();
        contents.sort();
        contents
    }

    fn expected(old_count: Option<usize>) -> Vec<(String, String)> {
        let count = old_count.unwrap_or(NAMES.len());
        let prefix = if old_count.is_some() { "old" } else { "the new" };
        let mut contents: Vec<_> =
            NAMES[..count].iter().map(|name| ((*name).to_owned(), format!("{prefix} {name}"))).collect();
        contents.sort();
        contents
    }

    #[test]
    fn failure_of_any_change_leaves_all_old_or_all_new_files() {
        let _alone = ALONE.lock();
        for (old_count, without_links) in [(3, false), (3, true), (1, false), (1, true), (0, false)] {
            let mut failed_count = 0;
            for changes_left in 0..20 {
                let folder = tempfile::tempdir().expect("a folder");
                write_old(folder.path(), old_count);
                TROUBLE.set(Some(Trouble { changes_left, failures: Some(1), without_links }));
                let result = publish_new(folder.path());
                TROUBLE.set(None);
                let wanted = expected(result.as_ref().err().map(|_| old_count));
                assert_eq!(contents(folder.path()), wanted, "{old_count} {without_links} {changes_left}");
                failed_count += usize::from(result.is_err());
            }
            assert!(failed_count >= 3, "{old_count} {without_links}: {failed_count}");
        }
    }

    #[test]
    fn lasting_failure_leaves_all_old_or_all_new_files_when_it_is_over() {
        let _alone = ALONE.lock();
        for (old_count, without_links) in [(3, false), (3, true), (1, false), (0, false)] {
            for changes_left in 0..20 {
                let folder = tempfile::tempdir().expect("a folder");
                write_old(folder.path(), old_count);
                TROUBLE.set(Some(Trouble { changes_left, failures: Some(usize::MAX), without_links }));
                let result = publish_new(folder.path());
                TROUBLE.set(None);
                recover_all(folder.path());
                let found = contents(folder.path());
                // All new, where the last step before the end was the first that failed.
                let is_good =
                    found == expected(None) || result.is_err() && found == expected(Some(old_count));
                assert!(is_good, "{old_count} {without_links} {changes_left}: {found:?}");
            }
        }
    }

    /// Set in the child of the test below: the folder, and the trouble.
    const CHILD: &str = "MENISCUS_TEST_FILE_SET";

    #[test]
    fn process_killed_before_any_change_leaves_all_old_or_all_new_files() {
        if let Ok(orders) = std::env::var(CHILD) {
            let [changes_left, without_links, folder] = orders.splitn(3, ' ').collect::<Vec<_>>()[..] else {
                panic!("{orders}")
            };
            let changes_left = changes_left.parse().expect("a number");
            TROUBLE.set(Some(Trouble {
                changes_left,
                failures: None,
                without_links: without_links == "true",
            }));
            publish_new(Path::new(folder)).expect("published");
            return;
        }
        for (old_count, without_links) in [(3, false), (3, true), (1, false), (0, false)] {
            let mut killed_count = 0;
            let mut restored_count = 0;
            for changes_left in 0.. {
                let folder = tempfile::tempdir().expect("a folder");
                write_old(folder.path(), old_count);
                let orders = format!("{changes_left} {without_links} {}", folder.path().display());
                let status = Command::new(std::env::current_exe().expect("this test"))
                    .args(["process_killed_before_any_change_leaves_all_old_or_all_new_files"])
                    .env(CHILD, orders)
                    .output()
                    .expect("a child")
                    .status;
                if !status.success() {
                    sweep_temporaries(folder.path()).expect("there");
                }
                let found = contents(folder.path());
                let is_old = found == expected(Some(old_count));
                let is_new = found == expected(None);
                assert!(is_new || is_old && !status.success(), "{old_count} {changes_left}: {found:?}");
                if status.success() {
                    break;
                }
                killed_count += 1;
                restored_count += usize::from(is_old);
            }
            // Before each rename, and before the record is removed.
            assert!(
                killed_count >= 4 && restored_count >= 1,
                "{old_count}: {killed_count}, {restored_count}"
            );
            assert!(restored_count < killed_count, "what was begun is completed");
        }
    }

    fn example(name: &OsStr, old: Option<Trait>) -> Member {
        let temporary = OsStr::new(".a b.tmp-0123456789abcdef").into();
        Member { name: name.into(), temporary, new: Trait { size: 7, modified_ns: -5, inode: 3 }, old }
    }

    const OLD: Option<Trait> = Some(Trait { size: 12, modified_ns: 1 << 60, inode: 4 });

    /// The record, old and new files of a set that another process left before any of these names had its present file.
    fn write_abandoned(folder: &Path, names: &[&str]) -> FileSet {
        let members = names.iter().map(|name| example(OsStr::new(name), OLD)).collect();
        let set = FileSet { record_path: folder.join(".meniscus-set-0123456789abcdef"), members };
        fs::write(&set.record_path, record_bytes(&set.members)).expect("written");
        for (index, member) in set.members.iter().enumerate() {
            fs::write(set.old_path(index), "older").expect("written");
            fs::write(set.temporary_path(member), "older").expect("written");
        }
        set
    }

    #[test]
    fn abandoned_set_whose_names_all_have_later_files_is_removed() {
        let folder = tempfile::tempdir().expect("a folder");
        write_old(folder.path(), 3);
        write_abandoned(folder.path(), &NAMES);
        publish_new(folder.path()).expect("published");
        let swept = sweep_temporaries(folder.path()).expect("there");
        assert!(swept.warnings.is_empty(), "{swept:?}");
        assert_eq!(contents(folder.path()), expected(None));
    }

    #[test]
    fn abandoned_set_of_which_some_names_have_later_files_keeps_the_old_files() {
        let folder = tempfile::tempdir().expect("a folder");
        write_old(folder.path(), 3);
        let set = write_abandoned(folder.path(), &[NAMES[0], NAMES[1], NAMES[2], "a.obj"]);
        publish_new(folder.path()).expect("published");
        let swept = sweep_temporaries(folder.path()).expect("there");
        let mut found = contents(folder.path());
        assert!((0..3).all(|index| set.old_path(index).exists()));
        assert!(swept.warnings.len() == 1 && swept.warnings[0].contains("another program"), "{swept:?}");
        // As the warning says.
        fs::remove_file(&set.record_path).expect("removed");
        sweep_temporaries(folder.path()).expect("there");
        found.retain(|(name, _)| !name.starts_with('.') && name != "a.obj");
        assert_eq!(found, expected(None));
        assert_eq!(fs::read_to_string(folder.path().join("a.obj")).expect("put back"), "older");
    }

    #[cfg(unix)]
    #[test]
    fn file_of_the_same_size_and_time_as_the_new_one_is_not_taken_for_it() {
        let folder = tempfile::tempdir().expect("a folder");
        write_old(folder.path(), 1);
        let path = folder.path().join(NAMES[0]);
        let ours = trait_of(&path).expect("known").expect("there");
        // On a file system with a coarse clock, another program's file can be that like.
        let new = Trait { inode: ours.inode + 1, ..ours };
        let members = vec![Member { new, ..example(OsStr::new(NAMES[0]), None) }];
        let record_path = folder.path().join(".meniscus-set-0123456789abcdef");
        fs::write(&record_path, record_bytes(&members)).expect("written");
        sweep_temporaries(folder.path()).expect("there");
        assert_eq!(contents(folder.path()), expected(Some(1)));
    }

    #[test]
    fn set_whose_new_file_is_gone_is_put_back() {
        for old_count in [3, 1, 0] {
            let folder = tempfile::tempdir().expect("a folder");
            write_old(folder.path(), old_count);
            let unseen = NAMES.map(|name| {
                let write = |out: &mut io::BufWriter<&File>| Ok(write!(out, "the new {name}")?);
                write_unseen(&folder.path().join(name), write).expect("written")
            });
            let members: Vec<Member> = unseen.iter().map(|file| member(file).expect("known")).collect();
            let record_path = folder.path().join(".meniscus-set-0123456789abcdef");
            fs::write(&record_path, record_bytes(&members)).expect("written");
            let set = FileSet { record_path, members };
            for (index, file) in unseen.iter().enumerate().take(old_count) {
                fs::hard_link(file.path(), set.old_path(index)).expect("linked");
            }
            fs::rename(unseen[0].written_path(), unseen[0].path()).expect("renamed");
            drop(unseen);
            sweep_temporaries(folder.path()).expect("there");
            assert_eq!(contents(folder.path()), expected(Some(old_count)), "{old_count}");
        }
    }

    #[test]
    fn set_of_a_living_process_is_left_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        write_old(folder.path(), 3);
        let record = write_record(folder.path(), &[]).expect("written");
        let set = FileSet { record_path: record.path().to_owned(), members: Vec::new() };
        fs::write(set.old_path(0), "old").expect("written");
        assert_eq!(sweep_temporaries(folder.path()).expect("there").count, 0);
        assert!(record.path().exists() && set.old_path(0).exists());
        drop(record);
        sweep_temporaries(folder.path()).expect("there");
        assert_eq!(contents(folder.path()), expected(Some(3)));
    }

    #[test]
    fn record_is_read_back_and_only_one_that_is_cut_off_is_void() {
        let mut members = vec![example(OsStr::new("a b.glb"), OLD), example(OsStr::new("ü\n.vdb"), None)];
        #[cfg(unix)]
        members.push(example(std::os::unix::ffi::OsStrExt::from_bytes(b"gr\xfc.vdb"), OLD));
        let bytes = record_bytes(&members);
        assert_eq!(parse_record(&bytes), Parsed::Whole(members));
        for length in 0..bytes.len() {
            assert_eq!(parse_record(&bytes[..length]), Parsed::CutOff, "{length}");
        }
        for other in
            [&b"meniscus set 9\0end\0"[..], b"\0\0\0\0", b"meniscus set 1\0end\0", b"meniscus set 9\0", b"?"]
        {
            assert_eq!(parse_record(other), Parsed::Unknown);
        }
        for name in ["../a.glb", "/etc/passwd", "..", "", "."] {
            let bytes = record_bytes(&[example(OsStr::new(name), None)]);
            assert_eq!(parse_record(&bytes), Parsed::Unknown, "{name}");
        }
        let foreign =
            Member { temporary: OsStr::new("precious").into(), ..example(OsStr::new("a.glb"), None) };
        assert_eq!(parse_record(&record_bytes(&[foreign])), Parsed::Unknown);
    }

    /// A folder with one file, one backup, and a record that would remove the file and the backup.
    fn plant_record(folder: &Path) -> PathBuf {
        write_old(folder, 1);
        let path = folder.join(NAMES[0]);
        let new = trait_of(&path).expect("known").expect("there");
        let members =
            vec![Member { new, ..example(OsStr::new(NAMES[0]), None) }, example(OsStr::new("x"), OLD)];
        let record_path = folder.join(".meniscus-set-0123456789abcdef");
        fs::write(&record_path, record_bytes(&members)).expect("written");
        fs::write(folder.join(".meniscus-set-0123456789abcdef.1"), "kept").expect("written");
        record_path
    }

    #[track_caller]
    fn assert_left_in_place(folder: &Path, words: &str) {
        let before = contents(folder);
        let swept = sweep_temporaries(folder).expect("readable");
        assert_eq!(contents(folder), before);
        assert_eq!(swept.warnings.len(), 1, "{:?}", swept.warnings);
        assert!(swept.warnings[0].contains(words), "{:?}", swept.warnings);
    }

    #[test]
    fn failed_recovery_names_the_record_and_what_to_do() {
        let folder = tempfile::tempdir().expect("a folder");
        let record_path = plant_record(folder.path());
        let _alone = ALONE.lock();
        TROUBLE.set(Some(Trouble { failures: Some(usize::MAX), ..Trouble::default() }));
        let result = recover_out_folder(folder.path());
        TROUBLE.set(None);
        let error = result.expect_err("a failing disk").to_string();
        assert!(error.starts_with(&record_path.display().to_string()), "{error}");
        assert!(error.contains("a failing disk; remove the cause and start again, or remove"), "{error}");
        assert!(record_path.exists());
    }

    #[cfg(unix)]
    #[test]
    fn record_with_two_names_is_left_in_place() {
        let folder = tempfile::tempdir().expect("a folder");
        let record_path = plant_record(folder.path());
        fs::hard_link(&record_path, folder.path().join("second")).expect("linked");
        assert_left_in_place(folder.path(), "belongs to another user or has a second name");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn record_of_another_user_is_left_in_place() {
        let folder = tempfile::tempdir().expect("a folder");
        let record_path = plant_record(folder.path());
        // Only root can give a file away.
        if std::os::unix::fs::chown(&record_path, Some(12345), None).is_ok() {
            assert_left_in_place(folder.path(), "belongs to another user or has a second name");
        }
    }

    #[test]
    fn record_of_another_version_is_left_in_place_with_its_backups() {
        let folder = tempfile::tempdir().expect("a folder");
        let record_path = plant_record(folder.path());
        fs::write(&record_path, "meniscus set 9\0a.glb\0end\0").expect("written");
        assert_left_in_place(folder.path(), "another version");
    }
}
