//! A folder of outputs: takes its lock, removes leftover temporary files, and reads its records. The folder's
//! thread writes records and checks that the folder exists and has free space.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::pipeline::{
    DoneRecord, FrameRecords, STATE_FOLDER, make_out_folder, remove_left_behind, sweep_temporaries,
};
use crate::surface::words::pluralize;
use crate::watch::config::WatchConfig;
use crate::watch::core::events::{Event, OutputFolderState, OutputRequest};

use super::error::DaemonError;
use super::file_system::free_bytes;
use super::lock::{LockError, OutputLock};
use super::selection::FileFilter;
use super::usd_stages::FolderUsdStages;
use super::worker::Work;

/// A folder of outputs that only this daemon writes to.
pub(super) struct OutputFolderWorker {
    index: usize,
    guard: Arc<OutputGuard>,
    /// When the last attempt to write records failed; `None` if it succeeded.
    records_failed_at: Option<Instant>,
    next_check: Instant,
    stages: FolderUsdStages,
}

/// A folder of outputs, locked by this daemon.
#[derive(Debug)]
pub(crate) struct OutputGuard {
    /// The absolute path.
    pub(crate) folder: PathBuf,
    /// The records of finished frames in the folder.
    pub(crate) records: Arc<FrameRecords>,
    lock: Mutex<OutputLock>,
}

/// How often a folder of outputs is checked.
const CHECK_EVERY: Duration = Duration::from_secs(1);

/// Opens all folders of outputs; also returns the index of the folder of each watch.
///
/// Creates the folders, locks them, reads their records, and removes the temporary files of earlier runs
/// that were killed.
///
/// # Errors
/// When a folder cannot be created, another daemon has locked it, or the pattern of a watch with a stage is invalid.
pub(super) fn open_outputs(
    config: &WatchConfig,
) -> Result<(Vec<OutputFolderWorker>, Vec<usize>), DaemonError> {
    let (mut all, mut output_folder_of): (Vec<OutputFolderWorker>, Vec<usize>) = (Vec::new(), Vec::new());
    for watch in &config.watches {
        let folder = open_folder(&watch.outputs.folder)?;
        let known = all.iter().position(|output| output.guard.folder == folder);
        if known.is_none() {
            all.push(OutputFolderWorker::open(all.len(), folder, config)?);
        }
        output_folder_of.push(known.unwrap_or(all.len() - 1));
    }
    Ok((all, output_folder_of))
}

fn open_folder(folder: &Path) -> Result<PathBuf, DaemonError> {
    make_out_folder(folder).map_err(DaemonError::OutFolderRefused)?;
    dunce::canonicalize(folder)
        .map_err(|source| DaemonError::OutFolderUnreadable { folder: folder.to_owned(), source })
}

impl OutputFolderWorker {
    fn open(index: usize, folder: PathBuf, config: &WatchConfig) -> Result<OutputFolderWorker, DaemonError> {
        let lock = OutputLock::take(&folder).map_err(DaemonError::Locked)?;
        let state_folder = folder.join(STATE_FOLDER);
        match sweep(&folder) + sweep_one(&state_folder) {
            0 => {}
            count => {
                let files = pluralize(count, "half-written file");
                tracing::info!(folder = %folder.display(), "removed {files}");
            }
        }
        let records = FrameRecords::open(&folder)
            .map_err(|source| DaemonError::OutFolderUnreadable { folder: state_folder, source })?;
        for problem in records.problems() {
            tracing::warn!(folder = %folder.display(), "{problem}: converting the frames that are recorded there again");
        }
        for watch in &config.watches {
            let is_here = dunce::canonicalize(&watch.outputs.folder).is_ok_and(|at| at == folder);
            let Ok(filter) = FileFilter::new(watch.pattern.as_deref(), Vec::new()) else { continue };
            let condition = watch.choices.r#where.as_ref().map(ToString::to_string);
            let is_asked = |record: &DoneRecord| is_here && filter.takes(&watch.input, &record.input);
            if let Some((name, made)) = records.of_other_particles(is_asked, condition.as_ref()) {
                tracing::warn!(
                    folder = %folder.display(),
                    "{} was made {made}: results of the same names are replaced; to keep both, choose another output folder",
                    name.display()
                );
            }
        }
        // Opens the file of this process now, while its records are in memory: if it is removed later, they are all
        // written again.
        let failure = records.prepare().err();
        if let Some(error) = &failure {
            tracing::warn!(folder = %folder.display(), "cannot write records: {error}");
        }
        let stages = FolderUsdStages::new(&folder, config).map_err(DaemonError::Pattern)?;
        Ok(OutputFolderWorker {
            index,
            guard: Arc::new(OutputGuard { folder, records: Arc::new(records), lock: Mutex::new(lock) }),
            records_failed_at: failure.map(|_| Instant::now()),
            next_check: Instant::now(),
            stages,
        })
    }

    pub(super) fn guard(&self) -> &Arc<OutputGuard> {
        &self.guard
    }

    /// Writes the stages of the recorded frames that are due; `at_once`, also those that are due later.
    /// Returns whether all stages are up to date.
    fn write_stages(&mut self, at_once: bool) -> bool {
        self.stages.write(&self.guard.records, at_once);
        self.stages.due().is_none()
    }

    fn check(&mut self, report: &dyn Fn(Event)) {
        self.next_check = Instant::now() + CHECK_EVERY;
        let (was_removed, lost) = match self.guard.restore() {
            Ok(was_removed) => (was_removed, None),
            Err(error) => (false, Some(error.to_string())),
        };
        let free_bytes = free_bytes(&self.guard.folder).ok();
        report(Event::OutputFolderChecked(OutputFolderState {
            output: self.index,
            was_removed,
            lost,
            free_bytes,
        }));
    }

    /// Writes the records that are kept. If they cannot be written, the only loss is repeated work after a restart.
    /// The failure is logged once, not for every record, and so is the recovery. After a failure the next attempt
    /// is made later, unless it must be made `at_once`. Returns whether all are written.
    fn write_records(&mut self, at_once: bool) -> bool {
        let is_too_soon = !at_once && self.records_failed_at.is_some_and(|at| at.elapsed() < RECORDS_RETRY);
        if is_too_soon {
            return false;
        }
        let (folder, records) = (self.guard.folder.display(), &self.guard.records);
        match if at_once { records.sync() } else { records.write_kept() } {
            Ok(()) => {
                if self.records_failed_at.take().is_some() {
                    tracing::info!(%folder, "records can be written again");
                }
            }
            Err(error) => {
                if self.records_failed_at.replace(Instant::now()).is_none() {
                    tracing::warn!(%folder, "cannot write records: {error}");
                }
            }
        }
        self.records_failed_at.is_none()
    }
}

impl Work for OutputFolderWorker {
    type Request = OutputRequest;

    fn handle(&mut self, request: OutputRequest, report: &dyn Fn(Event)) {
        match request {
            OutputRequest::Record(line, log) => {
                self.stages.note(&line);
                // Records that the pipeline has written already are not written again.
                self.guard.records.keep(line);
                self.write_records(false);
                if let Some(log) = log {
                    log.write();
                }
            }
            OutputRequest::Sync => {
                let is_recorded = self.write_records(true);
                report(Event::OutputSynced(self.write_stages(true) && is_recorded));
            }
        }
    }

    fn on_time(&mut self, report: &dyn Fn(Event)) {
        if self.next_check <= Instant::now() {
            self.check(report);
            self.write_records(false);
            remove_left_behind();
        }
        self.write_stages(false);
    }

    fn next_time(&self) -> Instant {
        self.stages.due().map_or(self.next_check, |due| due.min(self.next_check))
    }
}

impl OutputGuard {
    /// If the folder was removed, creates it again and locks it. Returns whether it did.
    ///
    /// # Errors
    /// If another daemon has locked it meanwhile, or the system refuses.
    fn restore(&self) -> Result<bool, LockError> {
        // The value is replaced as a whole, so it is consistent even if the lock is poisoned.
        let mut lock = self.lock.lock().unwrap_or_else(PoisonError::into_inner);
        if lock.is_in_place(&self.folder) {
            return Ok(false);
        }
        *lock = OutputLock::take(&self.folder)?;
        Ok(true)
    }
}

/// How soon writing records is retried.
const RECORDS_RETRY: Duration = Duration::from_secs(1);

/// Removes all temporary files that no process is writing from a folder and its sub-folders. Returns their
/// number. Folders that cannot be read are skipped.
fn sweep(folder: &Path) -> usize {
    let mut count = sweep_one(folder);
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    // Links are not followed, because the daemon must not remove files outside this folder.
    let folders = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
    for inner in folders.filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b".")) {
        count += sweep(&inner.path());
    }
    count
}

/// Like [`sweep`], without sub-folders.
fn sweep_one(folder: &Path) -> usize {
    let cannot = |error| {
        tracing::warn!(folder = %folder.display(), "cannot look for half-written files: {error}");
    };
    sweep_temporaries(folder).map_err(cannot).unwrap_or_default()
}
