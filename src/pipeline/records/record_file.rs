//! One file of records, to which one process appends: locks, torn lines, compaction.

use std::collections::{HashMap, HashSet, VecDeque};
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use super::frame_records::SettingValues;
use super::known_records::DONE_PER_FRAME_MAX;
use super::record_line::{RecordLine, unfinished_key};
use crate::pipeline::files::checked_line::{push_line, record_of_line};
use crate::pipeline::files::host::host_name;
use crate::pipeline::files::identity::is_still_at;
use crate::pipeline::files::open::open_itself;
use crate::pipeline::files::temporary::{create_locked, random_number, remove_if_exists};

/// The start of the name of a file of records; 8 hexadecimal digits for the machine and 16 others follow.
const FILE_PREFIX: &str = "frames-";

/// The extension of the lock of a file of records.
pub(super) const LOCK_EXTENSION: &str = "lock";

/// The largest file that a new process continues. To continue a file, it reads all of it into memory.
const CONTINUED_BYTES_MAX: u64 = 1 << 28;

/// Ends a line of which only a part was written. So a reader can tell it from a damaged line.
pub(super) const TORN_LINE_END: &[u8] = b" torn\n";

/// A file is compacted only if it has at least this many lines.
pub(super) const COMPACTED_LINES_MIN: usize = 1000;

/// The file that this process appends to.
#[derive(Debug)]
pub(super) struct OwnFile {
    pub(super) path: PathBuf,
    file: File,
    /// Locked until it is dropped. It is another file, because Windows lets no process read a locked one.
    lock: File,
    /// The settings in the file.
    settings: HashSet<String>,
    line_count: usize,
    /// It is compacted only if it has at least this many lines.
    compacted_from_lines: usize,
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
        OwnFile {
            path,
            file,
            lock,
            settings: HashSet::new(),
            line_count: 0,
            compacted_from_lines: COMPACTED_LINES_MIN,
            is_torn: false,
        }
    }

    /// Whether the file has its name.
    pub(super) fn is_in_place(&self) -> bool {
        is_still_at(&self.path, &self.file)
    }

    /// Whether it has many lines, and most of them are superseded; `needed_count` lines would do.
    pub(super) fn is_superseded(&self, needed_count: usize) -> bool {
        self.line_count >= self.compacted_from_lines && needed_count * 2 < self.line_count
    }

    /// Its size in bytes.
    pub(super) fn size(&self) -> io::Result<u64> {
        Ok(self.file.metadata()?.len())
    }

    /// Reopens the file, which compacts it if most of its lines are superseded. The lock stays held. If the file
    /// cannot be continued, it stays as it is, and this creates another.
    pub(super) fn reopened(self, folder: &Path) -> io::Result<OwnFile> {
        let OwnFile { path, lock, file, .. } = self;
        drop(file);
        OwnFile::adopt(path, lock).or_else(|_| OwnFile::create(folder))
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
        let mut line_count = 0;
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
            line_count += 1;
        }
        self.is_torn = true;
        self.file.write_all(&bytes)?;
        self.is_torn = false;
        self.line_count += line_count + new_settings.len();
        self.settings.extend(new_settings);
        self.size()
    }

    /// Writes the lines to the disk.
    pub(super) fn sync(&self) -> io::Result<()> {
        self.file.sync_data()
    }

    /// Continues a file of an earlier process. Compacts it if most of its lines are superseded.
    fn adopt(path: PathBuf, lock: File) -> io::Result<OwnFile> {
        let mut file = open_itself(&path, OpenOptions::new().read(true).append(true))?;
        if file.metadata()?.len() > CONTINUED_BYTES_MAX {
            return Err(io::ErrorKind::Unsupported.into());
        }
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        let mut own = OwnFile::new(path, file, lock);
        let mut last_lines: HashMap<String, &[u8]> = HashMap::new();
        let mut done_keys: HashMap<PathBuf, VecDeque<String>> = HashMap::new();
        for line in bytes.split_inclusive(|byte| *byte == b'\n') {
            own.line_count += 1;
            let json = line.strip_suffix(b"\n").and_then(record_of_line);
            let record: Option<RecordLine> = json.and_then(|json| serde_json::from_slice(json).ok());
            let Some(record) = record else { continue };
            let key = record.key();
            if let RecordLine::Done(done) = &record {
                // A done frame is no longer unfinished.
                last_lines.remove(&unfinished_key(&done.input));
                // Of the lines of a frame that say how it was done, only the last few are needed.
                let keys = done_keys.entry(done.name.clone()).or_default();
                keys.retain(|earlier| *earlier != key);
                keys.push_back(key.clone());
                if keys.len() > DONE_PER_FRAME_MAX
                    && let Some(oldest) = keys.pop_front()
                {
                    last_lines.remove(&oldest);
                }
            }
            if let RecordLine::Settings { id, .. } = record {
                own.settings.insert(id);
            }
            last_lines.insert(key, line);
        }
        if own.is_superseded(last_lines.len()) {
            // If this fails, the old file is still complete.
            if let Ok(new) = own.compacted(last_lines.into_values()) {
                return Ok(new);
            }
        }
        // Compacting it now would gain little, or has failed: not before it has twice as many lines.
        own.compacted_from_lines = COMPACTED_LINES_MIN.max(own.line_count * 2);
        own.is_torn = bytes.last().is_some_and(|byte| *byte != b'\n');
        Ok(own)
    }

    /// Moves these lines to a new file, and removes the old one. Until then, both are read.
    fn compacted<'a>(&self, lines: impl Iterator<Item = &'a [u8]>) -> io::Result<OwnFile> {
        let mut lines: Vec<&[u8]> = lines.collect();
        // Restores the order of the file, because of lines with the same time the last one counts: all lines are
        // slices of one buffer, so their addresses have this order.
        lines.sort_unstable_by_key(|line| line.as_ptr());
        let mut new = OwnFile::create(self.path.parent().unwrap_or(Path::new("")))?;
        new.settings.clone_from(&self.settings);
        new.line_count = lines.len();
        let mut out = BufWriter::new(&new.file);
        let written = lines.iter().try_for_each(|line| out.write_all(line)).and_then(|()| out.flush());
        drop(out);
        let moved = written.and_then(|()| new.file.sync_data()).and_then(|()| remove_if_exists(&self.path));
        if moved.is_ok() {
            self.remove()
        } else {
            // Otherwise each start would leave another copy.
            new.remove()
        }
        moved.map(|()| new)
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
