//! Replaces several files together: after a failure or a kill, the folder has all the old files or all the
//! new ones.
//!
//! A rename replaces a single file atomically, but a process may stop between two renames. So before the
//! first rename:
//!
//! ```text
//!   .meniscus-set-9f3c…       the record: the names and their new files; locked, and synced to disk
//!   .meniscus-set-9f3c….0     backup of the old dam.0012.glb            hard links
//!   .meniscus-set-9f3c….1     backup of the old dam.0012.vdb
//!            │
//!            │ rename each new file, then sync the folder
//!            ▼
//!   remove the record         from here on the new files stay
//!   remove the backups
//! ```
//!
//! If a rename fails, the old files are restored; a name that was free becomes free again. A killed process
//! leaves its record without a lock: [`sweep_temporaries`](super::sweep::sweep_temporaries) finds it and
//! completes the renames, so that no output disappears that a reader has already seen. If that is impossible
//! because a new file is missing, it restores the old files. The sweep runs in the output folder when a
//! daemon, `convert` or a shard starts. Until then, and between two renames, readers can see a mixed set; the
//! hashes in a certificate reveal that.
//!
//! A record is used only if this user created it, it has no second hard link, and this version can read it.
//! Any other record is left in place with its backups, and the sweep returns a warning.
//!
//! The record has the size, modification time and inode of each new and old file. A file that matches neither
//! was written later, and stays. If all names have later files, the set is superseded, and its record and
//! backups are removed: that happens if a run could not read the record and converted the frame again. If
//! only some names have later files, the backups of these names and the record stay.
//!
//! On a file system without hard links, the old file is renamed instead, so its name is missing for a moment.

use std::collections::HashSet;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File, Metadata};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::MutexGuard;

use super::staged_file::{StagedFile, sync_folder};
use super::stamp::FileStamp;
use super::temporary::{
    Temporary, active_temporaries, is_temporary_name, lock_abandoned, random_number, record_left_behind,
    remove_if_exists,
};

/// The prefix of a record's name; 16 hexadecimal digits follow.
const RECORD_PREFIX: &str = ".meniscus-set-";

/// The start of a record.
const RECORD_HEAD: &[u8] = b"meniscus set 2\0";
/// The end of a complete record.
const RECORD_END: &[u8] = b"end\0";

/// Maximum size of a record. All records are smaller: a frame has about a dozen files.
const RECORD_BYTES_MAX: u64 = 1 << 20;

/// The number of attempts to restore the old files. If all fail, the next sweep restores them.
const UNDO_ATTEMPTS: usize = 3;

/// A name, and the new file for it. The stamps distinguish the new and the old file from later files with the
/// same name. They omit the status change time, which is all that a rename changes. They include the inode,
/// because size and modification time are not enough: some file systems have a time resolution of two
/// seconds.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Member {
    name: Box<OsStr>,
    /// The temporary name of the new file.
    temporary: Box<OsStr>,
    new: FileStamp,
    /// The stamp of the old file, if there is one.
    old: Option<FileStamp>,
}

/// Renames several files of one folder to their final names.
///
/// # Errors
/// The path that cannot be replaced, and why. Then all names have their old files, unless the error says
/// otherwise.
pub(crate) fn replace_together(files: &[StagedFile]) -> Result<(), (PathBuf, io::Error)> {
    let Some(first) = files.first() else { return Ok(()) };
    let folder = first.path().parent().unwrap_or(Path::new(""));
    let members = files.iter().map(member).collect::<Result<Vec<_>, _>>()?;
    let at_first = |error| (first.path().to_owned(), error);
    let record = write_record(folder, &members).map_err(at_first)?;
    let set = FileSet { record_path: record.path().to_owned(), members };

    // Held during all renames, so that `stop_writing` runs before the first or after the last.
    let locked = active_temporaries();
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
        // Still locked: if `stop_writing` removed the record now, the old files could not be restored.
        Err(error) => return Err(set.undo_after(error, record, locked)),
    };
    Err(set.undo_after(error, record, active_temporaries()))
}

/// The stamps of a new file and of the file it will replace.
fn member(file: &StagedFile) -> Result<Member, (PathBuf, io::Error)> {
    let failed = |error| (file.path().to_owned(), error);
    let name = file.path().file_name().ok_or_else(|| failed(io::ErrorKind::InvalidFilename.into()))?;
    let temporary = file.written_path().file_name().unwrap_or_default();
    let old = stamp_of(file.path()).map_err(failed)?;
    Ok(Member {
        name: name.into(),
        temporary: temporary.into(),
        new: file.stamp().without_status_change(),
        old,
    })
}

/// Writes the record, and syncs it if old files will be replaced, because the machine may crash between the
/// renames.
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
    let text = |it: &FileStamp| format!("{} {} {}", it.size, it.modified_ns, it.inode);
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

/// The contents of a record.
#[derive(Debug, PartialEq, Eq)]
enum Parsed {
    /// A complete list of files to replace.
    Complete(Vec<Member>),
    /// Empty or truncated. Either the record was never complete, and no file was replaced; or all files were
    /// replaced, and the commit emptied it.
    CutOff,
    /// Another version of this program wrote the record, or it is damaged.
    Unknown,
}

fn parse_record(bytes: &[u8]) -> Parsed {
    if let Some(members) = parse_members(bytes) {
        return Parsed::Complete(members);
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
    // Records are not trusted: a name must be that of a file in this folder, and a new file must have the
    // name of a temporary file of this program.
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
        old => Some(parse_stamp(old)?),
    };
    Some(Member { name: plain(name)?.into(), temporary: temporary.into(), new: parse_stamp(new)?, old })
}

fn parse_stamp(bytes: &[u8]) -> Option<FileStamp> {
    let numbers: Vec<&str> = str::from_utf8(bytes).ok()?.split(' ').collect();
    let [size, modified_ns, inode] = numbers[..] else { return None };
    let (size, modified_ns) = (size.parse().ok()?, modified_ns.parse().ok()?);
    Some(FileStamp { size, modified_ns, inode: inode.parse().ok()?, changed_ns: None })
}

#[cfg(unix)]
fn name_of_bytes(bytes: &[u8]) -> Option<OsString> {
    Some(std::os::unix::ffi::OsStringExt::from_vec(bytes.to_vec()))
}

#[cfg(not(unix))]
fn name_of_bytes(bytes: &[u8]) -> Option<OsString> {
    str::from_utf8(bytes).ok().map(OsString::from)
}

/// Names whose files are replaced together.
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

    /// The backup path for the old file of a member.
    fn old_path(&self, index: usize) -> PathBuf {
        let mut path = self.record_path.clone().into_os_string();
        path.push(format!(".{index}"));
        path.into()
    }

    /// Backs up the old files, and renames the new ones.
    fn replace(&self, files: &[StagedFile]) -> Result<(), (PathBuf, io::Error)> {
        let mut is_kept = vec![true; files.len()];
        for (index, file) in files.iter().enumerate() {
            if self.members[index].old.is_some() {
                match change::hard_link(file.path(), &self.old_path(index)) {
                    // Another process has just removed the old file.
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

    /// Commits: from here on the new files stay.
    fn commit(&self, record: &Temporary) -> io::Result<()> {
        // If the record cannot be removed, it is emptied: an empty record restores no files.
        change::remove(&self.record_path).or_else(|error| change::empty(record.file()).map_err(|_| error))
    }

    fn remove_old_files(&self) {
        for (index, member) in self.members.iter().enumerate() {
            let old = self.old_path(index);
            if member.old.is_some() && remove_if_exists(&old).is_err() {
                record_left_behind(old);
            }
        }
    }

    /// Restores the old files after this error. If that fails, the record stays, so that a later sweep
    /// restores them.
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
                // Dropping the record takes this lock, so release it first.
                drop(locked);
                return (path, error);
            }
            Ok(kept) => io::Error::other(kept_files_message(&kept)),
            Err(of_undo) => of_undo,
        };
        for member in &self.members {
            // Removes the new files, so that a sweep cannot complete this set, whose replacement is reported
            // as failed.
            let _ = remove_if_exists(&self.temporary_path(member));
        }
        locked.remove(&self.record_path);
        drop(locked);
        record.keep();
        let what =
            format!("{error}; could not restore the replaced files: {of_undo}; the next run tries again");
        (path, io::Error::new(error.kind(), what))
    }

    /// Whether some new files already have their final names, and the others can still be renamed to theirs.
    fn can_be_completed(&self) -> io::Result<bool> {
        let mut is_begun = false;
        for (index, member) in self.members.iter().enumerate() {
            let found = stamp_of(&self.path(member))?;
            if found == Some(member.new) {
                is_begun = true;
                continue;
            }
            let is_as_before = found == member.old || found.is_none() && exists(&self.old_path(index))?;
            if !is_as_before || stamp_of(&self.temporary_path(member))? != Some(member.new) {
                return Ok(false);
            }
        }
        Ok(is_begun)
    }

    /// Whether every name has a file that was written later: neither the new file nor the old one.
    fn is_superseded(&self) -> io::Result<bool> {
        for member in &self.members {
            let found = stamp_of(&self.path(member))?;
            if found.is_none() || found == Some(member.new) || found == member.old {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Renames the remaining new files.
    fn complete(&self) -> io::Result<()> {
        for member in &self.members {
            let path = self.path(member);
            if stamp_of(&path)? != Some(member.new) {
                change::rename(&self.temporary_path(member), &path)?;
            }
        }
        Ok(())
    }

    /// Restores the old files where no other program has replaced the new ones. Can be repeated, also after
    /// an interruption. Returns the backups of files that another program has replaced meanwhile: they may be
    /// the only copies, so they and the record must stay.
    fn undo(&self) -> io::Result<Vec<PathBuf>> {
        let mut kept = Vec::new();
        for (index, member) in self.members.iter().enumerate() {
            let (path, old) = (self.path(member), self.old_path(index));
            let found = stamp_of(&path)?;
            let is_new = found == Some(member.new);
            match (member.old.is_some(), exists(&old)?) {
                (true, true) => {
                    if is_new || found.is_none() {
                        change::rename(&old, &path)?;
                    }
                    // A rename does nothing if both names are hard links to the same file. The backup then
                    // still exists.
                    let [named, backup] = [stamp_of(&path)?, stamp_of(&old)?];
                    if backup.is_none() || named == member.old || named == backup {
                        change::remove(&old)?;
                    } else {
                        kept.push(old);
                    }
                }
                (false, _) if is_new => change::remove(&path)?,
                // Already restored, or not yet replaced.
                _ => {}
            }
        }
        Ok(kept)
    }
}

/// The warning about these backups.
fn kept_files_message(kept: &[PathBuf]) -> String {
    let kept: Vec<_> = kept.iter().map(|path| path.display().to_string()).collect();
    format!(
        "another program has replaced some outputs; the previous versions are kept as {}",
        kept.join(", ")
    )
}

/// The stamp of the file with this name; `None` if the name is free.
fn stamp_of(path: &Path) -> io::Result<Option<FileStamp>> {
    match path.symlink_metadata() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        found => Ok(Some(FileStamp::of(&found?).without_status_change())),
    }
}

/// Whether this user created the file, and it has no second hard link.
#[cfg(unix)]
fn is_own_file(metadata: &Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    metadata.uid() == rustix::process::geteuid().as_raw() && metadata.nlink() == 1
}

#[cfg(not(unix))]
fn is_own_file(_metadata: &Metadata) -> bool {
    true
}

/// Whether a file has this name.
fn exists(path: &Path) -> io::Result<bool> {
    Ok(stamp_of(path)?.is_some())
}

/// Whether this is the name of a record.
pub(crate) fn is_record_name(name: &str) -> bool {
    name.strip_prefix(RECORD_PREFIX).is_some_and(is_number)
}

/// The path of the record, if this is a backup of an old file.
pub(crate) fn record_of_old_file(path: &Path) -> Option<PathBuf> {
    let (record, index) = path.file_name()?.to_str()?.rsplit_once('.')?;
    let is_index = !index.is_empty() && index.bytes().all(|byte| byte.is_ascii_digit());
    (is_index && is_record_name(record)).then(|| path.with_file_name(record))
}

fn is_number(text: &str) -> bool {
    text.len() == 16 && text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

/// The result of recovering a record.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum RecordRecovery {
    /// The set was completed, undone or superseded, and the record removed.
    Done,
    /// Another process is using the record.
    InUse,
    /// The record is not trusted or not readable. It and all its files were left in place. Contains the
    /// reason and the remedy.
    Left(String),
}

/// Completes a set whose process was killed, or restores its old files.
///
/// # Errors
/// When the system reports an error; then everything needed for another attempt stays.
pub(crate) fn recover(record_path: &Path) -> io::Result<RecordRecovery> {
    let Some(mut file) = lock_abandoned(record_path)? else { return Ok(RecordRecovery::InUse) };
    let left = |why: &str| {
        let (path, name) = (record_path.display(), record_path.file_name().unwrap_or_default().display());
        RecordRecovery::Left(format!(
            "{path}: {why}; left in place with the files {name}.0, {name}.1, …, which may be the only copies of replaced outputs"
        ))
    };
    // This user's own record has a single hard link. In a shared folder, another account could create a
    // forged record, or a hard link to a record in another folder.
    if !is_own_file(&file.metadata()?) {
        return Ok(left(
            "this record of an interrupted conversion belongs to another user or has a second hard link: run \
             meniscus on this folder as that user, or, if the outputs are as you want them, remove the record \
             and its files",
        ));
    }
    let mut bytes = Vec::new();
    (&mut file).take(RECORD_BYTES_MAX).read_to_end(&mut bytes)?;
    let members = match parse_record(&bytes) {
        Parsed::Complete(members) => members,
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
        // Another process has removed a new file meanwhile.
        Err(error) if error.kind() == io::ErrorKind::NotFound => set.undo()?,
        completed => completed?,
    };
    if !kept.is_empty() {
        return Ok(RecordRecovery::Left(format!(
            "{}: record of an interrupted conversion: {}; to restore one, rename it, then remove the record",
            record_path.display(),
            kept_files_message(&kept)
        )));
    }
    sync_folder(record_path.parent().unwrap_or(Path::new("")));
    change::remove(record_path)?;
    set.remove_old_files();
    Ok(RecordRecovery::Done)
}

/// Removes a backup if its set is complete; returns whether it did.
///
/// # Errors
/// When the system reports an error.
pub(crate) fn remove_old_file(old: &Path, record_path: &Path) -> io::Result<bool> {
    // A record is created before its backups, and removed when they are no longer needed.
    if exists(record_path)? {
        return Ok(false);
    }
    remove_if_exists(old)?;
    Ok(true)
}

/// The operations that change a folder. Tests make any of them fail, or end the process before it.
mod change {
    use super::*;

    pub(crate) fn rename(from: &Path, to: &Path) -> io::Result<()> {
        #[cfg(test)]
        super::tests::before_change(false)?;
        fs::rename(from, to)
    }

    pub(crate) fn hard_link(from: &Path, to: &Path) -> io::Result<()> {
        #[cfg(test)]
        super::tests::before_change(true)?;
        fs::hard_link(from, to)
    }

    pub(crate) fn remove(path: &Path) -> io::Result<()> {
        #[cfg(test)]
        super::tests::before_change(false)?;
        remove_if_exists(path)
    }

    pub(crate) fn empty(file: &File) -> io::Result<()> {
        #[cfg(test)]
        super::tests::before_change(false)?;
        file.set_len(0)
    }
}

#[cfg(test)]
mod tests;
