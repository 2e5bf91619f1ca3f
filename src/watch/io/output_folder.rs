//! A folder of outputs: takes its lock, removes leftover temporary files, and reads its records. The folder's
//! thread writes records and checks that the folder exists and has free space, so a file system that
//! hangs delays nothing else.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::pipeline::{FrameRecords, STATE_FOLDER, make_out_folder, remove_left_behind, sweep_temporaries};
use crate::surface::words::pluralize;
use crate::watch::config::WatchConfig;
use crate::watch::core::events::{Event, OutputFolderState, OutputRequest, Presence};

use super::error::DaemonError;
use super::lock::{FILE_NAME as LOCK_FILE_NAME, OutputLock};
use super::mounts::{device, free_bytes};
use super::usd_stages::FolderUsdStages;
use super::worker::Work;

/// A folder of outputs that only this daemon writes to.
pub(super) struct OutputFolderWorker {
    index: usize,
    guard: Arc<OutputGuard>,
    /// When the last attempt to write records failed; `None` if it succeeded.
    records_failed_at: Option<Instant>,
    /// Whether the folder is in place. If another one has replaced it, nothing is written there.
    is_mounted: bool,
    next_check: Instant,
    stages: FolderUsdStages,
}

/// Checks whether a folder of outputs is still the one that was opened.
#[derive(Debug)]
pub(crate) struct OutputGuard {
    /// The absolute path.
    pub(crate) folder: PathBuf,
    /// The records of finished frames in the folder.
    pub(crate) records: Arc<FrameRecords>,
    floor_bytes: u64,
    locked: Mutex<LockedFolder>,
}

#[derive(Debug)]
struct LockedFolder {
    lock: OutputLock,
    /// The device of the folder when it was opened.
    device: u64,
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
        let failed = |source| DaemonError::OutFolderUnreadable { folder: folder.clone(), source };
        let device = device(&folder).map_err(failed)?;
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
        // Opens the file of this process now, while its records are in memory: if it is removed later, they are all
        // written again.
        let failure = records.prepare().err();
        if let Some(error) = &failure {
            tracing::warn!(folder = %folder.display(), "cannot write records: {error}");
        }
        let locked = Mutex::new(LockedFolder { lock, device });
        let stages = FolderUsdStages::new(&folder, config).map_err(DaemonError::Pattern)?;
        Ok(OutputFolderWorker {
            index,
            guard: Arc::new(OutputGuard {
                folder,
                records: Arc::new(records),
                floor_bytes: config.disk_floor_bytes,
                locked,
            }),
            records_failed_at: failure.map(|_| Instant::now()),
            is_mounted: true,
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
        self.is_mounted &= self.guard.is_in_place();
        if self.is_mounted {
            self.stages.write(&self.guard.records, at_once);
        }
        self.stages.due().is_none()
    }

    fn check(&mut self, report: &dyn Fn(Event)) {
        self.next_check = Instant::now() + CHECK_EVERY;
        let found = self.guard.check(self.index);
        self.is_mounted = found.presence != Presence::Missing;
        report(Event::OutputFolderChecked(found));
    }

    /// Writes the records that are kept. If they cannot be written, the only loss is repeated work after a restart.
    /// The failure is logged once, not for every record, and so is the recovery. After a failure the next attempt
    /// is made later, unless it must be made `at_once`. Returns whether all are written.
    fn write_records(&mut self, at_once: bool) -> bool {
        // Nothing is written if another folder may be in its place.
        self.is_mounted &= self.guard.is_in_place();
        let is_too_soon = !at_once && self.records_failed_at.is_some_and(|at| at.elapsed() < RECORDS_RETRY);
        if !self.is_mounted || is_too_soon {
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
            OutputRequest::Check => self.check(report),
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
        // A check decides whether a stage can be written.
        let stages = self.stages.due().filter(|_| self.is_mounted);
        stages.map_or(self.next_check, |due| due.min(self.next_check))
    }
}

impl OutputGuard {
    /// Whether the folder exists and is the one that was opened.
    pub(crate) fn is_in_place(&self) -> bool {
        self.locked().lock.is_in_place(&self.folder)
    }

    /// Whether frames with outputs here may start.
    pub(crate) fn may_begin(&self) -> bool {
        self.is_in_place() && free_bytes(&self.folder).map_or(true, |free| free >= self.floor_bytes)
    }

    /// Checks the folder. If it was removed, it is created again and locked.
    pub(crate) fn check(&self, output: usize) -> OutputFolderState {
        let presence = self.find();
        let free_bytes = free_bytes(&self.folder).ok();
        OutputFolderState { output, presence, free_bytes }
    }

    fn find(&self) -> Presence {
        let mut locked = self.locked();
        if locked.lock.is_in_place(&self.folder) {
            return Presence::Present;
        }
        let nearest = self.folder.ancestors().find_map(|folder| device(folder).ok());
        // `convert` also creates a folder with this name, but only the daemon creates this file in it.
        let is_back = self.folder.join(STATE_FOLDER).join(LOCK_FILE_NAME).is_file();
        // If the nearest existing folder on the path is on another file system than before, the file system
        // of the outputs was unmounted. Its files come back when it is mounted again, so the daemon waits. If
        // the file system is the same, the folder was removed and its files are lost, so it is created again.
        // If the daemon's lock exists, the folder has come back, and is only locked again.
        if nearest != Some(locked.device) && !is_back {
            return Presence::Missing;
        }
        // If this fails, the daemon waits for the folder, and logs once why no frame starts.
        let Ok(lock) = OutputLock::take(&self.folder) else { return Presence::Missing };
        let device = device(&self.folder).unwrap_or(locked.device);
        *locked = LockedFolder { lock, device };
        Presence::Recreated
    }

    fn locked(&self) -> MutexGuard<'_, LockedFolder> {
        // The value is replaced as a whole, so it is consistent even if the lock is poisoned.
        self.locked.lock().unwrap_or_else(PoisonError::into_inner)
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
