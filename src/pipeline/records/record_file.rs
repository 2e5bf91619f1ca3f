//! One file of records, to which one process appends: locks and torn lines.

use std::collections::{HashMap, HashSet};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::frame_records::SettingValues;
use super::record_line::RecordLine;
use crate::pipeline::files::checked_line::push_line;
use crate::pipeline::files::host::host_name;
use crate::pipeline::files::identity::is_still_at;
use crate::pipeline::files::open::open_itself;
use crate::pipeline::files::temporary::{create_locked, random_number, remove_if_exists};

/// The start of the name of a file of records; 8 hexadecimal digits for the machine and 16 others follow.
const FILE_PREFIX: &str = "frames-";

/// The extension of the lock of a file of records.
pub(super) const LOCK_EXTENSION: &str = "lock";

/// Ends a line of which only a part was written. So a reader can tell it from a damaged line.
pub(super) const TORN_LINE_END: &[u8] = b" torn\n";

/// The file that this process appends to.
#[derive(Debug)]
pub(super) struct OwnFile {
    pub(super) path: PathBuf,
    file: File,
    /// Locked until it is dropped. It is another file, because Windows lets no process read a locked one.
    _lock: File,
    /// The settings that this process has written to it.
    settings: HashSet<String>,
    /// Whether its last line is incomplete.
    is_torn: bool,
}

impl OwnFile {
    /// Opens a file that no process writes to, or creates one.
    pub(super) fn open(folder: &Path) -> io::Result<OwnFile> {
        match fs::create_dir(folder) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error),
            _ => {}
        }
        for path in record_files(folder)? {
            // A file that cannot be continued belongs to another user, or was not written by this program.
            if is_of_this_machine(&path)
                && let Ok(Some(lock)) = lock_unused(&path.with_extension(LOCK_EXTENSION))
                && let Ok(own) = OwnFile::adopt(path, lock)
            {
                return Ok(own);
            }
        }
        OwnFile::create(folder)
    }

    /// Creates an empty file.
    pub(super) fn create(folder: &Path) -> io::Result<OwnFile> {
        loop {
            let path = folder.join(format!("{}{:016x}", machine_prefix(), random_number()));
            let lock_path = path.with_extension(LOCK_EXTENSION);
            if let Some(lock) = create_locked(&lock_path)? {
                let created = open_itself(&path, OpenOptions::new().append(true).create_new(true));
                let file = created.inspect_err(|_| drop(remove_if_exists(&lock_path)))?;
                return Ok(OwnFile::new(path, file, lock));
            }
        }
    }

    fn new(path: PathBuf, file: File, lock: File) -> OwnFile {
        OwnFile { path, file, _lock: lock, settings: HashSet::new(), is_torn: false }
    }

    /// Whether the file has its name.
    pub(super) fn is_in_place(&self) -> bool {
        is_still_at(&self.path, &self.file)
    }

    /// Its size in bytes.
    fn size(&self) -> io::Result<u64> {
        Ok(self.file.metadata()?.len())
    }

    /// Removes the file and its lock, as far as possible.
    pub(super) fn remove(&self) {
        let _ = remove_if_exists(&self.path);
        let _ = remove_if_exists(&self.path.with_extension(LOCK_EXTENSION));
    }

    /// Appends lines, and those of `settings_of_id` that they refer to, if the file does not have them. Returns the
    /// size of the file. After an error, the file may end with a torn line.
    pub(super) fn append<'a>(
        &mut self,
        lines: impl Iterator<Item = &'a RecordLine>,
        settings_of_id: &HashMap<String, SettingValues>,
    ) -> io::Result<u64> {
        // Ends a torn line, which is then skipped.
        let mut bytes = if self.is_torn { TORN_LINE_END.to_vec() } else { Vec::new() };
        let mut new_settings = Vec::new();
        for line in lines {
            if let RecordLine::Done(record) = line
                && !self.settings.contains(&record.settings)
                && !new_settings.contains(&record.settings)
                && let Some(values) = settings_of_id.get(&record.settings)
            {
                let (id, values) = (record.settings.clone(), values.clone());
                push_line(&mut bytes, &RecordLine::Settings { id, values })?;
                new_settings.push(record.settings.clone());
            }
            push_line(&mut bytes, line)?;
        }
        self.is_torn = true;
        self.file.write_all(&bytes)?;
        self.is_torn = false;
        self.settings.extend(new_settings);
        self.size()
    }

    /// Writes the lines to the disk.
    pub(super) fn sync(&self) -> io::Result<()> {
        self.file.sync_data()
    }

    /// Continues a file of an earlier process.
    fn adopt(path: PathBuf, lock: File) -> io::Result<OwnFile> {
        let mut file = open_itself(&path, OpenOptions::new().read(true).append(true))?;
        let mut last_byte = [b'\n'];
        if file.seek(SeekFrom::End(0))? > 0 {
            file.seek(SeekFrom::End(-1))?;
            file.read_exact(&mut last_byte)?;
        }
        Ok(OwnFile { is_torn: last_byte != [b'\n'], ..OwnFile::new(path, file, lock) })
    }
}

/// The files of records in a folder, in the order of their names; none if the folder does not exist.
pub(super) fn record_files(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries?,
    };
    let mut files = Vec::new();
    for entry in entries {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let is_records = name.starts_with(FILE_PREFIX) && path.extension().is_none();
        files.extend(is_records.then(|| path.clone()));
    }
    files.sort();
    Ok(files)
}

/// The start of the names of this machine's files.
fn machine_prefix() -> String {
    let hash = twox_hash::XxHash3_64::oneshot(host_name().as_bytes());
    format!("{FILE_PREFIX}{:08x}-", hash as u32)
}

fn is_of_this_machine(path: &Path) -> bool {
    path.file_name().unwrap_or_default().to_string_lossy().starts_with(&machine_prefix())
}

/// Locks a file that no process has locked; `None` if one has, or if the file system has no locks.
fn lock_unused(path: &Path) -> io::Result<Option<File>> {
    let file = open_itself(path, OpenOptions::new().read(true).write(true))?;
    Ok((file.try_lock().is_ok() && is_still_at(path, &file)).then_some(file))
}

#[cfg(all(test, target_os = "linux"))]
impl OwnFile {
    /// A part of a line reaches the file, and no more than that. Returns the path of the file.
    pub(super) fn fill_the_disk(&mut self) -> PathBuf {
        self.file.write_all(b"0123456789abcdef {\"unfini").expect("a torn line");
        self.is_torn = true;
        let path = std::mem::replace(&mut self.path, "/dev/full".into());
        self.file = OpenOptions::new().append(true).open(&self.path).expect("the full device");
        path
    }

    /// There is room again.
    pub(super) fn free_space(&mut self, path: PathBuf) {
        self.path = path;
        self.file = OpenOptions::new().append(true).open(&self.path).expect("opened");
    }
}
