//! The daemon's memory between runs: an append-only text file.
//!
//! ```text
//!   meniscus journal 1⏎
//!   8f3a09c1d2e4b576 {"frame":{"input":"/sim/dam.0001.bgeo","standing":"queued", … }}⏎
//!   41d07e5522a98c3f {"frame":{"input":"/sim/dam.0001.bgeo","standing":"done", … }}⏎    the last one counts
//!   c2609b1ea0f347d8 {"frame":{"input":"/sim/dam.00                                     torn: truncated
//! ```
//!
//! The journal records which frames are done, so that they are not converted again, and why the others are
//! not. It also records the settings of each sequence. If a frame has several records, the last one counts.
//!
//! **Losing the journal only costs time.** An output is on disk before it gets its name, and contains the
//! provenance of its input. Without a journal, frames are read again and found done. This keeps the journal
//! simple: a record is one write at the end of the file, and nothing waits for the disk. A line that was torn
//! by a crash is truncated, a damaged line is skipped, and a journal of another version is renamed. A damaged
//! line must never be read as a valid record, so each line has a checksum.
//!
//! **The disk may fill up.** [`JournalState`] in memory is always correct. A record that cannot be written
//! stays pending, and is written with the next one; a partial write is truncated first. If the file is
//! removed under a running daemon, it is written again completely.
//!
//! When most lines are superseded by later ones, a compacted file is written and renamed over the old one.
//! Readers that have the old file open keep reading it.
//!
//! The lock on the folder of outputs ensures that only one daemon writes a journal. Any process may read it
//! at the same time.

mod line;
mod state;
#[cfg(test)]
mod tests;

use std::collections::HashSet;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

use crate::pipeline::files::checked_line::push_line;
use crate::pipeline::{FileStamp, has_other_names, is_disk_full, open_own, replace_own};

use line::parse_line;
pub(in crate::watch) use state::Entry;
use state::RecordKey;

pub use state::{
    DaemonRecord, DaemonState, JournalState, JournaledFrame, JournaledSequence, JournaledStatus, OutputCheck,
    OutputRecord, SequenceCamera, SequenceKey,
};

pub use crate::pipeline::{STATE_FOLDER, now_ms};

/// The name of the journal in its folder.
pub(in crate::watch) const FILE_NAME: &str = "journal";
/// The new name of a journal of another version.
const SET_ASIDE_NAME: &str = "journal.old-version";

/// The first line. A change that older programs would misread requires another number.
const VERSION_LINE: &[u8] = b"meniscus journal 1\n";

/// A journal with fewer lines is not compacted.
const COMPACTED_LINES_MIN: usize = 1000;

/// The journal of a running daemon.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    state: JournalState,
    /// Records that are in the state but not on disk.
    pending: HashSet<RecordKey>,
    /// The file for appending; `None` until the first write, and after a failed write.
    file: Option<File>,
    /// The inode of the file.
    inode: u64,
    /// The size of its complete lines, in bytes.
    whole_bytes: u64,
    /// The number of lines after the first.
    line_count: usize,
    /// The number of lines from which compaction is worthwhile.
    compacted_from_lines: usize,
    /// Whether writes are suspended.
    is_suspended: bool,
}

impl Journal {
    /// Opens the journal in `folder`, or starts a new one; creates the folder if it is missing.
    ///
    /// # Errors
    /// When the system refuses. A full disk is not an error: records stay pending.
    pub fn open(folder: &Path) -> io::Result<Journal> {
        fs::create_dir_all(folder)?;
        let path = folder.join(FILE_NAME);
        let loaded = match load(&path)? {
            JournalFile::Journal(loaded) => *loaded,
            JournalFile::OtherVersion => {
                set_aside(&path)?;
                Loaded::default()
            }
        };
        let Loaded { state, whole_bytes, line_count } = loaded;
        if state.damaged_line_count > 0 {
            let line_count = state.damaged_line_count;
            tracing::warn!(journal = %path.display(), line_count, "skipped damaged lines");
        }
        let mut journal = Journal {
            path,
            state,
            pending: HashSet::new(),
            file: None,
            inode: 0,
            whole_bytes,
            line_count,
            compacted_from_lines: COMPACTED_LINES_MIN,
            is_suspended: false,
        };
        match journal.write_pending() {
            Err(error) if is_disk_full(&error) => {
                tracing::warn!(journal = %journal.path.display(), %error, "cannot write the journal yet");
            }
            result => result?,
        }
        journal.compact();
        Ok(journal)
    }

    /// Reads the journal in `folder`, whether or not a daemon is writing it. Without a journal, the state is
    /// empty.
    ///
    /// # Errors
    /// When the system refuses, or the journal is of another version.
    pub fn read(folder: &Path) -> io::Result<JournalState> {
        match load(&folder.join(FILE_NAME))? {
            JournalFile::Journal(loaded) => Ok(loaded.state),
            JournalFile::OtherVersion => {
                let what = "it was written by another version of meniscus: use that version, or start \
                            `meniscus watch` of this one, which begins a new journal";
                Err(io::Error::new(io::ErrorKind::InvalidData, what))
            }
        }
    }

    /// The current state, including records that are not on disk yet.
    pub fn state(&self) -> &JournalState {
        &self.state
    }

    /// Suspends writing if `is_suspended`, otherwise resumes it. The caller suspends writing while a write
    /// would fail, or while the output disk is not mounted: a write would then go to the folder that is the
    /// mount point. Records stay pending, and are written with the first record afterwards.
    pub fn set_suspended(&mut self, is_suspended: bool) {
        self.is_suspended = is_suspended;
    }

    /// Adds a record, which replaces the earlier one with the same key.
    ///
    /// # Errors
    /// When the record cannot be written. It is in the state nevertheless, and is written with the next
    /// record.
    pub(in crate::watch) fn note(&mut self, entry: Entry) -> io::Result<()> {
        self.pending.insert(entry.key());
        self.state.take(entry);
        if self.is_suspended {
            return Ok(());
        }
        self.write_pending()?;
        self.compact();
        Ok(())
    }

    /// Records the status of a frame.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub fn note_frame(&mut self, input: &Path, record: JournaledFrame) -> io::Result<()> {
        self.note(Entry::Frame { input: input.into(), record: record.into() })
    }

    /// Writes pending records and syncs the file to disk, at the end of a run, unless writing is suspended.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn sync(&mut self) -> io::Result<()> {
        if self.is_suspended {
            return Ok(());
        }
        self.write_pending()?;
        match &self.file {
            Some(file) => file.sync_data(),
            None => Ok(()),
        }
    }

    /// Appends the lines of all pending records in one write, without syncing: a record that the system has
    /// accepted survives this process, and a record that is lost with the machine only costs time.
    fn write_pending(&mut self) -> io::Result<()> {
        // If anything fails from here on, the file stays closed, and is reopened by name the next time.
        let Some(mut file) = self.take_file()? else { return self.rewrite() };
        let mut lines = Vec::new();
        for entry in self.pending.iter().filter_map(|key| self.state.entry(key)) {
            push_line(&mut lines, &entry)?;
        }
        file.write_all(&lines)?;
        self.file = Some(file);
        self.whole_bytes += lines.len() as u64;
        self.line_count += self.pending.len();
        self.pending.clear();
        Ok(())
    }

    /// The file, open for appending after its last complete line; `None` if the file was removed: users
    /// remove folders of outputs to start over.
    fn take_file(&mut self) -> io::Result<Option<File>> {
        match self.file.take() {
            Some(file) => {
                let is_in_place = FileStamp::of_path(&self.path).is_ok_and(|stamp| stamp.inode == self.inode);
                Ok(is_in_place.then_some(file))
            }
            None => self.reopen(),
        }
    }

    /// Opens the existing file and truncates a torn line; `None` if the file is missing, is shorter than what
    /// was written, or has another hard link.
    fn reopen(&mut self) -> io::Result<Option<File>> {
        let file = match open_own(&self.path, OpenOptions::new().append(true)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            file => file?,
        };
        let metadata = file.metadata()?;
        let stamp = FileStamp::of(&metadata);
        // If the file has another hard link, appending would change a file that a user keeps under that name.
        if self.whole_bytes == 0 || stamp.size < self.whole_bytes || has_other_names(&metadata) {
            return Ok(None);
        }
        if stamp.size > self.whole_bytes {
            // Through a separate handle: on Windows a handle for appending cannot truncate.
            open_own(&self.path, OpenOptions::new().write(true))?.set_len(self.whole_bytes)?;
        }
        self.inode = stamp.inode;
        Ok(Some(file))
    }

    /// Replaces the file with a compacted one of one line per record.
    fn rewrite(&mut self) -> io::Result<()> {
        // Windows cannot rename over an open file.
        self.file = None;
        #[cfg(test)]
        tests::before_rewrite()?;
        if let Some(folder) = self.path.parent() {
            fs::create_dir_all(folder)?;
        }
        self.whole_bytes = replace_own(&self.path, |out| write_fresh(out, &self.state))?;
        self.line_count = self.state.entry_count();
        self.compacted_from_lines = COMPACTED_LINES_MIN;
        self.pending.clear();
        Ok(())
    }

    /// Compacts the file when more than half of its lines are superseded.
    fn compact(&mut self) {
        let overtaken_count = self.line_count.saturating_sub(self.state.entry_count());
        if self.line_count < self.compacted_from_lines || overtaken_count * 2 <= self.line_count {
            return;
        }
        // If this fails, the old file is still complete. Compaction is tried again only when the file has
        // twice as many lines.
        if let Err(error) = self.rewrite() {
            self.compacted_from_lines = self.line_count * 2;
            tracing::warn!(journal = %self.path.display(), %error, "cannot compact the journal");
        }
    }
}

/// The content of a file with the name of the journal.
enum JournalFile {
    Journal(Box<Loaded>),
    OtherVersion,
}

/// The content of a journal.
#[derive(Default)]
struct Loaded {
    state: JournalState,
    /// The size of its complete lines, without a torn line at the end, in bytes.
    whole_bytes: u64,
    /// The number of lines after the first.
    line_count: usize,
}

/// Reads the journal at `path`; an empty one if the file is missing.
fn load(path: &Path) -> io::Result<JournalFile> {
    match open_own(path, OpenOptions::new().read(true)) {
        Ok(file) => parse(BufReader::new(file)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(JournalFile::Journal(Box::default())),
        Err(error) => Err(error),
    }
}

/// Reads the complete lines of a journal.
fn parse(mut reader: impl BufRead) -> io::Result<JournalFile> {
    let mut loaded = Box::<Loaded>::default();
    let mut line = Vec::new();
    reader.read_until(b'\n', &mut line)?;
    if line != VERSION_LINE {
        // If the first line is torn, the process that created the journal was stopped while it wrote this
        // line: the journal is empty.
        let is_torn = VERSION_LINE.starts_with(&line);
        return Ok(if is_torn { JournalFile::Journal(loaded) } else { JournalFile::OtherVersion });
    }
    loop {
        loaded.whole_bytes += line.len() as u64;
        line.clear();
        reader.read_until(b'\n', &mut line)?;
        let Some(record) = line.strip_suffix(b"\n") else { return Ok(JournalFile::Journal(loaded)) };
        loaded.line_count += 1;
        match parse_line(record) {
            Some(entry) => loaded.state.take(entry),
            None => loaded.state.damaged_line_count += 1,
        }
    }
}

/// Renames a journal of another version.
fn set_aside(path: &Path) -> io::Result<()> {
    let set_aside_path = path.with_file_name(SET_ASIDE_NAME);
    tracing::warn!(
        journal = %path.display(),
        kept_as = %set_aside_path.display(),
        "the journal is of another version of meniscus: starting a new one"
    );
    fs::rename(path, set_aside_path)
}

/// Writes a journal of one line per record. Returns its size.
fn write_fresh(out: &mut impl Write, state: &JournalState) -> io::Result<u64> {
    let mut whole_bytes = VERSION_LINE.len() as u64;
    out.write_all(VERSION_LINE)?;
    let mut line = Vec::new();
    for entry in state.entries() {
        line.clear();
        push_line(&mut line, &entry)?;
        out.write_all(&line)?;
        whole_bytes += line.len() as u64;
    }
    Ok(whole_bytes)
}
