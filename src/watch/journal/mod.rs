//! What the daemon remembers from one run to the next: one text file, to which lines are added.
//!
//! ```text
//!   meniscus journal 1⏎
//!   8f3a09c1d2e4b576 {"frame":{"input":"/sim/dam.0001.bgeo","standing":"queued", … }}⏎
//!   41d07e5522a98c3f {"frame":{"input":"/sim/dam.0001.bgeo","standing":"done", … }}⏎    the last one holds
//!   c2609b1ea0f347d8 {"frame":{"input":"/sim/dam.00                                     torn: cut off
//! ```
//!
//! It says which frames are done, so that they are not converted again, which failed and why, which
//! settings a sequence was given, and what the daemon was asked for. The last record of a frame holds.
//!
//! **Losing it only costs work.** Outputs are on the disk before they have their names, and say
//! themselves what they were made from; without a journal, frames are read again and found done.
//! Hence what is simple here: a record is one write at the end of the file, and nothing waits for the
//! disk; a line that a crash has torn is cut off; a damaged one is passed over; a journal of another
//! version is set aside. The one thing that must not be is a record that was never made: each line
//! has a checksum.
//!
//! **The disk may fill up.** [`JournalState`] in memory is always right. A record that could not be written
//! stays pending, and goes out with the next one; what half of it reached the disk is cut off first.
//! The same holds where the file is taken away under a running daemon: it is written anew.
//!
//! When most lines have been overtaken by later ones, a fresh file is written beside it and renamed
//! over it. Readers that have the old one open read on in that.
//!
//! One daemon writes a journal: the lock of the outputs sees to that. Anybody may read it meanwhile.

mod line;
mod state;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_of_plan;

use std::collections::HashSet;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use crate::pipeline::{FileStamp, has_other_names, is_disk_full, open_own, replace_own};

use line::{parse_line, push_line};
pub(in crate::watch) use state::Entry;
use state::RecordKey;

pub use state::{
    DaemonRecord, DaemonState, JournalState, JournaledFrame, JournaledSequence, OutputCheck, OutputRecord,
    PlanRecord, SequenceCamera, SequenceKey, Standing,
};

/// The folder, in that of the outputs, of what the daemon keeps for itself.
pub const STATE_FOLDER: &str = ".meniscus";

/// The time of a record: milliseconds since 1970.
pub fn now_ms() -> u64 {
    // A clock before 1970 is as good as none.
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

/// The journal in its folder.
pub(in crate::watch) const FILE_NAME: &str = "journal";
/// One of another version.
const SET_ASIDE_NAME: &str = "journal.old-version";

/// The first line. A change that older programs would misread needs another number.
const VERSION_LINE: &[u8] = b"meniscus journal 1\n";

/// A journal of fewer lines is left as it is.
const COMPACTED_LINES_MIN: usize = 1000;

/// The journal of a running daemon.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    state: JournalState,
    /// What the state knows and the disk does not.
    pending: HashSet<RecordKey>,
    /// Where lines are added; `None` until the first one, and after a write that failed.
    file: Option<File>,
    /// Which file that is.
    inode: u64,
    /// How much of it is whole lines.
    whole_bytes: u64,
    /// Lines in it after the first.
    line_count: usize,
    /// From how many lines on it is worth a fresh file.
    compacted_from_lines: usize,
    /// Nothing is written for now.
    is_held: bool,
}

impl Journal {
    /// Opens the journal in `folder`, or begins one; the folder is made where it is missing.
    ///
    /// # Errors
    /// When the system refuses. A full disk is no error: what is to be written waits.
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
            tracing::warn!(journal = %path.display(), line_count, "damaged lines were passed over");
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
            is_held: false,
        };
        match journal.write_pending() {
            Err(error) if is_disk_full(&error) => {
                tracing::warn!(journal = %journal.path.display(), %error, "the journal cannot be written yet");
            }
            result => result?,
        }
        journal.compact();
        Ok(journal)
    }

    /// What the journal in `folder` says, whether or not a daemon is writing it. Without one, nothing.
    ///
    /// # Errors
    /// When the system refuses, or the journal is of another version.
    pub fn read(folder: &Path) -> io::Result<JournalState> {
        match load(&folder.join(FILE_NAME))? {
            JournalFile::Journal(loaded) => Ok(loaded.state),
            JournalFile::OtherVersion => {
                let what = "the journal was written by another version of meniscus";
                Err(io::Error::new(io::ErrorKind::InvalidData, what))
            }
        }
    }

    /// All that is remembered, also what could not be written yet.
    pub fn state(&self) -> &JournalState {
        &self.state
    }

    /// Holds back what is to be written, while that is known to be in vain or wrong; it is remembered, and
    /// written with the first record after.
    pub fn hold(&mut self, is_held: bool) {
        self.is_held = is_held;
    }

    /// Adds a record, in place of the one before it.
    ///
    /// # Errors
    /// When it is not on the disk. It is in the state all the same, and will be written with the next
    /// record.
    pub(in crate::watch) fn note(&mut self, entry: Entry) -> io::Result<()> {
        self.pending.insert(entry.key());
        self.state.take(entry);
        if self.is_held {
            return Ok(());
        }
        self.write_pending()?;
        self.compact();
        Ok(())
    }

    /// Remembers what became of a frame.
    ///
    /// # Errors
    /// When it is not on the disk.
    pub fn note_frame(&mut self, input: &Path, record: JournaledFrame) -> io::Result<()> {
        self.note(Entry::Frame { input: input.into(), record: record.into() })
    }

    /// Remembers what the daemon was asked for.
    ///
    /// # Errors
    /// When it is not on the disk.
    pub fn note_plan(&mut self, record: PlanRecord) -> io::Result<()> {
        self.note(Entry::Plan(record))
    }

    /// Writes what is pending and waits until all of it is on the disk: for the end of a run.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn sync(&mut self) -> io::Result<()> {
        self.write_pending()?;
        match &self.file {
            Some(file) => file.sync_data(),
            None => Ok(()),
        }
    }

    /// Adds the lines of all pending records, in one write. Nothing waits for the disk: a record that
    /// the system has taken outlives this process, and one that is lost with the machine only costs
    /// work.
    fn write_pending(&mut self) -> io::Result<()> {
        // Whatever fails from here on, the file stays closed, and is opened by its name the next time.
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

    /// The file, open for adding to its last whole line; `None` where the one that was written to is
    /// no longer there: people remove folders of outputs to begin again.
    fn take_file(&mut self) -> io::Result<Option<File>> {
        match self.file.take() {
            Some(file) => {
                let is_there = FileStamp::of_path(&self.path).is_ok_and(|stamp| stamp.inode == self.inode);
                Ok(is_there.then_some(file))
            }
            None => self.reopen(),
        }
    }

    /// Opens what is there, less what a torn write left at its end; `None` where there is nothing, or
    /// less than was written.
    fn reopen(&mut self) -> io::Result<Option<File>> {
        let file = match open_own(&self.path, OpenOptions::new().append(true)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            file => file?,
        };
        let metadata = file.metadata()?;
        let stamp = FileStamp::of(&metadata);
        // Where the file has another name as well, lines would be added to what somebody else keeps.
        if self.whole_bytes == 0 || stamp.size < self.whole_bytes || has_other_names(&metadata) {
            return Ok(None);
        }
        if stamp.size > self.whole_bytes {
            // By a handle of its own: on Windows one that only adds cannot cut.
            open_own(&self.path, OpenOptions::new().write(true))?.set_len(self.whole_bytes)?;
        }
        self.inode = stamp.inode;
        Ok(Some(file))
    }

    /// Puts a fresh file of one line per record in place of what is there.
    fn rewrite(&mut self) -> io::Result<()> {
        // Windows renames nothing over a file that is open.
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

    /// Writes a fresh file when more than half of the lines have been overtaken.
    fn compact(&mut self) {
        let overtaken_count = self.line_count.saturating_sub(self.state.entry_count());
        if self.line_count < self.compacted_from_lines || overtaken_count * 2 <= self.line_count {
            return;
        }
        // Where it fails, the old file is as good as it was: no record is missing, and it is not tried
        // again with every line.
        if let Err(error) = self.rewrite() {
            self.compacted_from_lines = self.line_count * 2;
            tracing::warn!(journal = %self.path.display(), %error, "the journal could not be made shorter");
        }
    }
}

/// What there is under the name of a journal.
enum JournalFile {
    Journal(Box<Loaded>),
    OtherVersion,
}

/// A journal that was read.
#[derive(Default)]
struct Loaded {
    state: JournalState,
    /// Without a torn line at the end.
    whole_bytes: u64,
    /// Lines after the first.
    line_count: usize,
}

/// Reads the journal at `path`; where there is none, an empty one.
fn load(path: &Path) -> io::Result<JournalFile> {
    match open_own(path, OpenOptions::new().read(true)) {
        Ok(file) => parse(BufReader::new(file)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(JournalFile::Journal(Box::default())),
        Err(error) => Err(error),
    }
}

/// Reads a journal, whole lines only.
fn parse(mut reader: impl BufRead) -> io::Result<JournalFile> {
    let mut loaded = Box::<Loaded>::default();
    let mut line = Vec::new();
    reader.read_until(b'\n', &mut line)?;
    if line != VERSION_LINE {
        // Whoever began it was stopped before the end of the first line: nothing is in it.
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

/// Makes way for a journal of this version.
fn set_aside(path: &Path) -> io::Result<()> {
    let aside = path.with_file_name(SET_ASIDE_NAME);
    tracing::warn!(
        journal = %path.display(),
        kept_as = %aside.display(),
        "the journal is not of this version of meniscus: a new one is begun"
    );
    fs::rename(path, aside)
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
