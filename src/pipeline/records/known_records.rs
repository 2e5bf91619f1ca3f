//! What the record files of a folder say: reads new lines of all files, and appends to one of them.

use std::collections::{BTreeMap, HashMap};
use std::fs::OpenOptions;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::frame_records::SettingValues;
use super::record_file::{OwnFile, TORN_LINE_END, record_files};
use super::record_line::{
    DaemonRecord, DoneRecord, RecordLine, SequenceKey, SharedSettings, UnfinishedRecord,
};
use crate::pipeline::files::checked_line::record_of_line;
use crate::pipeline::files::open::open_itself;
use crate::pipeline::files::out_folder::is_disk_full;

/// A longer line is not a record.
const LINE_BYTES_MAX: u64 = 1 << 20;

/// Other records are read again after this many times as long as reading them took.
const PAUSE_PER_READ: u32 = 10;

/// Of older records of a frame, whose outputs were replaced since, no more than this are kept.
pub(super) const DONE_PER_FRAME_MAX: usize = 8;

#[derive(Debug, Default)]
pub(super) struct KnownRecords {
    /// The records of each frame, the latest one last; they differ in input, settings, obstacles, camera or outputs.
    pub(super) done: HashMap<PathBuf, Vec<Arc<DoneRecord>>>,
    /// By the names of their outputs; one for each input.
    pub(super) unfinished: HashMap<PathBuf, Vec<Arc<UnfinishedRecord>>>,
    pub(super) sequences: HashMap<SequenceKey, SharedSettings>,
    pub(super) daemon: Option<DaemonRecord>,
    pub(super) settings: HashMap<String, SettingValues>,
    /// Lines that are to be written, by their keys.
    pub(super) unwritten: HashMap<String, RecordLine>,
    /// The number of bytes that were read of each file, complete lines only.
    read_bytes: HashMap<PathBuf, u64>,
    /// Files that cannot be read, and why.
    pub(super) unreadable: BTreeMap<PathBuf, String>,
    /// The number of damaged lines in each file that has some.
    pub(super) damaged: BTreeMap<PathBuf, usize>,
    /// When the files were read last, and how long that took.
    last_read: Option<(Instant, Duration)>,
    /// The file that this process appends to.
    pub(super) own: Option<OwnFile>,
}

impl KnownRecords {
    /// The latest time that is recorded of a frame, in milliseconds since 1970; 0 if there is none.
    pub(super) fn latest_ms(&self, name: &Path, input: &Path) -> u64 {
        let done = self.done.get(name).and_then(|records| records.last()).map_or(0, |known| known.at_ms);
        let unfinished = self.unfinished.get(name).into_iter().flatten();
        unfinished.filter(|known| known.input == input).map(|known| known.at_ms).fold(done, u64::max)
    }

    /// Adds a record.
    pub(super) fn insert(&mut self, line: RecordLine) {
        match line {
            RecordLine::Settings { id, values } => {
                self.settings.insert(id, values);
            }
            // Such a record is not one of this program.
            RecordLine::Done(record) if !record.is_plain() => {}
            RecordLine::Done(record) => {
                if let Some(unfinished) = self.unfinished.get_mut(&record.name) {
                    unfinished.retain(|known| known.input != record.input || known.at_ms > record.at_ms);
                }
                let records = self.done.entry(record.name.clone()).or_default();
                let is_same = |known: &Arc<DoneRecord>| known.is_replaced_by(&record);
                if records.iter().any(|known| is_same(known) && known.at_ms > record.at_ms) {
                    return;
                }
                records.retain(|known| !is_same(known));
                records.push(record);
                records.sort_by_key(|record| record.at_ms);
                let count = records.len();
                records.drain(..count.saturating_sub(DONE_PER_FRAME_MAX));
            }
            RecordLine::Unfinished(record) => {
                let records = self.unfinished.entry(record.name.clone()).or_default();
                match records.iter_mut().find(|known| known.input == record.input) {
                    Some(known) if known.at_ms > record.at_ms => {}
                    Some(known) => *known = record,
                    None => records.push(record),
                }
            }
            RecordLine::Sequence { key, shared } => {
                if self.sequences.get(&key).is_none_or(|known| known.at_ms <= shared.at_ms) {
                    self.sequences.insert(key, *shared);
                }
            }
            RecordLine::Daemon(record) => {
                if self.daemon.as_ref().is_none_or(|known| known.at_ms <= record.at_ms) {
                    self.daemon = Some(record);
                }
            }
        }
    }

    /// Reads the lines added to the files since the last call, but not too often. Returns whether there were any.
    pub(super) fn refresh(&mut self, folder: &Path) -> io::Result<bool> {
        let is_recent = |(at, took): (Instant, Duration)| at.elapsed() < took * PAUSE_PER_READ;
        if self.last_read.is_some_and(is_recent) { Ok(false) } else { self.read_news(folder) }
    }

    /// Reads the lines added to the files since the last call. Returns whether there were any.
    pub(super) fn read_news(&mut self, folder: &Path) -> io::Result<bool> {
        let start = Instant::now();
        let mut has_news = false;
        for path in record_files(folder)? {
            let from = self.read_bytes.get(&path).copied().unwrap_or(0);
            match self.read_lines(&path, from) {
                Ok(end) => {
                    has_news |= end > from;
                    self.unreadable.remove(&path);
                    self.read_bytes.insert(path, end);
                }
                // Somebody has removed it.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => drop(self.unreadable.insert(path, error.to_string())),
            }
        }
        self.last_read = Some((Instant::now(), start.elapsed()));
        Ok(has_news)
    }

    /// Takes the records in the complete lines of a file from an offset. Returns where the last one ends.
    fn read_lines(&mut self, path: &Path, from: u64) -> io::Result<u64> {
        let mut file = open_itself(path, OpenOptions::new().read(true))?;
        let size = file.metadata()?.len();
        // A file that is shorter than before was replaced: all of it is read.
        let from = if size < from { 0 } else { from };
        if from == 0 {
            self.damaged.remove(path);
        }
        file.seek(SeekFrom::Start(from))?;
        let (mut reader, mut end, mut line) = (BufReader::new(file), from, Vec::new());
        loop {
            line.clear();
            let count = reader.by_ref().take(LINE_BYTES_MAX).read_until(b'\n', &mut line)? as u64;
            // The writer has not finished the last line.
            if count == 0 || count < LINE_BYTES_MAX && line.last() != Some(&b'\n') {
                return Ok(end);
            }
            end += count;
            // A torn, damaged or foreign line is skipped: its frame is converted again.
            let record = line.strip_suffix(b"\n").and_then(record_of_line);
            match record.and_then(|json| serde_json::from_slice(json).ok()) {
                Some(record) => self.insert(record),
                None if line.ends_with(TORN_LINE_END) => {}
                None => *self.damaged.entry(path.to_owned()).or_default() += 1,
            }
        }
    }

    /// Opens the file that this process appends to, if it is not open.
    pub(super) fn open_own_file(&mut self, folder: &Path) -> io::Result<()> {
        if self.own.is_some() {
            return Ok(());
        }
        self.own = Some(OwnFile::open(folder)?);
        // Its lines so far are read: those that are appended are known.
        self.read_news(folder).map(drop)
    }

    /// Keeps all that is known: the file with it was removed.
    fn keep_all(&mut self) {
        let done = self.done.values().flatten().cloned().map(RecordLine::Done);
        let unfinished = self.unfinished.values().flatten().cloned().map(RecordLine::Unfinished);
        let sequences = self
            .sequences
            .iter()
            .map(|(key, shared)| RecordLine::Sequence { key: key.clone(), shared: Box::new(shared.clone()) });
        let daemon = self.daemon.iter().cloned().map(RecordLine::Daemon);
        let all = done.chain(unfinished).chain(sequences).chain(daemon);
        self.unwritten.extend(all.map(|line| (line.key(), line)));
    }

    /// Writes the lines that were kept, and this one.
    pub(super) fn write(&mut self, folder: &Path, line: Option<&RecordLine>) -> io::Result<()> {
        if self.own.as_ref().is_some_and(|own| !own.is_in_place()) {
            // The lock must be free before a file is opened.
            self.own = None;
            self.keep_all();
        }
        if line.is_none() && self.unwritten.is_empty() {
            return Ok(());
        }
        self.open_own_file(folder)?;
        if let Err(error) = self.append(line) {
            // There is no room for another file, either.
            if is_disk_full(&error) {
                return Err(error);
            }
            // Perhaps only this file cannot be written.
            self.own = Some(OwnFile::create(folder)?);
            if let Err(error) = self.append(line) {
                // Otherwise each attempt would leave a file.
                self.own.take().iter().for_each(OwnFile::remove);
                return Err(error);
            }
        }
        self.unwritten.clear();
        Ok(())
    }

    fn append(&mut self, line: Option<&RecordLine>) -> io::Result<()> {
        if let Some(own) = &mut self.own {
            let end = own.append(self.unwritten.values().chain(line), &self.settings)?;
            self.read_bytes.insert(own.path.clone(), end);
        }
        Ok(())
    }
}
