//! Checks whether outputs can be written: no frame starts without free space, and a frame that ran out of
//! space waits for more.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Blocks the start of frames while their outputs cannot be written.
#[derive(Debug)]
pub(crate) struct DiskGuard {
    floor_bytes: u64,
    block: Option<WriteBlock>,
    /// How long to wait the next time that the disk is full or the system refuses to write.
    backoff: Duration,
}

/// Why outputs cannot be written.
#[derive(Debug)]
enum WriteBlock {
    /// There is not enough free space.
    Full(Full),
    /// The system refuses for a reason other than space. The next attempt is at this time.
    Refused(String, Instant),
}

#[derive(Debug)]
struct Full {
    folder: PathBuf,
    wanted_bytes: u64,
    /// When the next attempt is made, even if nothing was freed; `None` if free space is below the floor,
    /// where only freeing space helps.
    retry_at: Option<Instant>,
    free_bytes: u64,
}

/// The last known state of a folder of outputs.
#[derive(Clone, Debug)]
pub(crate) struct FoundSpace<'a> {
    pub(crate) folder: &'a Path,
    /// Why this daemon may not write there, if it may not.
    pub(crate) lost: Option<&'a str>,
    /// Free bytes, if the file system reports them.
    pub(crate) free_bytes: Option<u64>,
}

/// How much space must be freed before a disk that was full is tried again at once.
const MARGIN_BYTES: u64 = 1 << 20;

const BACKOFF_FIRST: Duration = Duration::from_secs(5);
const BACKOFF_MAX: Duration = Duration::from_secs(300);

impl DiskGuard {
    pub(crate) fn new(floor_bytes: u64) -> DiskGuard {
        DiskGuard { floor_bytes, block: None, backoff: BACKOFF_FIRST }
    }

    /// A frame found the disk of this folder full, with this much free space.
    pub(crate) fn on_full(&mut self, folder: &Path, free_bytes: Option<u64>, now: Instant) {
        let free_bytes = free_bytes.unwrap_or(0);
        // Frames that are in progress together find the disk full one after another: all share one wait.
        let retry_at = match &self.block {
            Some(WriteBlock::Full(Full { retry_at: Some(at), .. })) => *at,
            _ => now + self.next_backoff(),
        };
        self.block = Some(WriteBlock::Full(Full {
            folder: folder.to_owned(),
            wanted_bytes: self.floor_bytes.max(free_bytes.saturating_add(MARGIN_BYTES)),
            retry_at: Some(retry_at),
            free_bytes,
        }));
    }

    /// The system refuses to write, for this reason.
    pub(crate) fn on_refusal(&mut self, reason: String, now: Instant) {
        let wait = self.next_backoff();
        self.block = Some(WriteBlock::Refused(reason, now + wait));
    }

    /// A frame was written: the next wait is short.
    pub(crate) fn on_success(&mut self) {
        self.backoff = BACKOFF_FIRST;
    }

    fn next_backoff(&mut self) -> Duration {
        let doubled = (self.backoff * 2).min(BACKOFF_MAX);
        std::mem::replace(&mut self.backoff, doubled)
    }

    /// Decides again, from the current state of the folders, whether frames may start. A folder with unknown
    /// free space does not block, because an attempt to write there reports what is wrong.
    pub(crate) fn check(&mut self, found: &[FoundSpace<'_>], now: Instant) {
        if let Some(why) = found.iter().find_map(|found| found.lost) {
            self.block = Some(WriteBlock::Refused(why.to_owned(), now));
            return;
        }
        match &mut self.block {
            Some(WriteBlock::Full(full)) => {
                let of_disk = found.iter().find(|found| full.folder.starts_with(found.folder));
                full.free_bytes = of_disk.and_then(|found| found.free_bytes).unwrap_or(u64::MAX);
                let is_time = full.retry_at.is_some_and(|at| at <= now);
                if full.free_bytes < full.wanted_bytes && !is_time {
                    return;
                }
            }
            Some(WriteBlock::Refused(_, at)) if now < *at => return,
            _ => {}
        }
        let below_floor = |found: &FoundSpace<'_>| {
            let free_bytes = found.free_bytes.unwrap_or(u64::MAX);
            (free_bytes < self.floor_bytes).then(|| Full {
                folder: found.folder.to_owned(),
                wanted_bytes: self.floor_bytes,
                retry_at: None,
                free_bytes,
            })
        };
        self.block = found.iter().find_map(below_floor).map(WriteBlock::Full);
    }

    /// Why no frame starts; `None` if frames may start.
    pub(crate) fn reason(&self) -> Option<String> {
        Some(match self.block.as_ref()? {
            WriteBlock::Refused(reason, _) => format!("{reason}; trying again soon"),
            WriteBlock::Full(Full { folder, wanted_bytes, free_bytes, .. }) => format!(
                "{} has {} free; waiting for {}",
                folder.display(),
                bytesize::ByteSize(*free_bytes),
                bytesize::ByteSize(*wanted_bytes)
            ),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OUT: &str = "/out";

    fn found(free_bytes: u64) -> [FoundSpace<'static>; 1] {
        [FoundSpace { folder: Path::new(OUT), lost: None, free_bytes: Some(free_bytes) }]
    }

    #[test]
    fn folder_of_another_daemon_blocks_until_it_is_free() {
        let now = Instant::now();
        let mut guard = DiskGuard::new(0);
        guard.check(&[FoundSpace { lost: Some("another daemon"), ..found(9)[0].clone() }], now);
        assert_eq!(guard.reason().as_deref(), Some("another daemon; trying again soon"));
        guard.check(&found(9), now);
        assert_eq!(guard.reason(), None);
    }

    #[test]
    fn below_the_floor_only_free_space_unblocks() {
        let now = Instant::now();
        let mut guard = DiskGuard::new(100);
        for hours in [0, 1, 1000] {
            guard.check(&found(99), now + Duration::from_secs(3600 * hours));
            assert!(guard.reason().is_some_and(|why| why.starts_with(OUT)));
        }
        guard.check(&found(100), now);
        assert_eq!(guard.reason(), None);
    }

    #[test]
    fn full_disk_is_retried_with_backoff() {
        let mut now = Instant::now();
        let mut guard = DiskGuard::new(0);
        for expected in [5, 10, 20, 40, 80, 160, 300, 300] {
            // Reported by several frames that were in progress together.
            for _ in 0..3 {
                guard.on_full(Path::new("/out/sub"), Some(7), now);
            }
            guard.check(&found(7 + MARGIN_BYTES - 1), now + Duration::from_secs(expected - 1));
            assert!(guard.reason().is_some(), "{expected}");
            now += Duration::from_secs(expected);
            guard.check(&found(7), now);
            assert_eq!(guard.reason(), None, "{expected}");
        }
        guard.on_success();
        guard.on_full(Path::new(OUT), None, now);
        guard.check(&found(0), now + BACKOFF_FIRST);
        assert_eq!(guard.reason(), None);
    }

    #[test]
    fn freed_space_unblocks_at_once() {
        let now = Instant::now();
        let mut guard = DiskGuard::new(0);
        guard.on_full(Path::new(OUT), Some(7), now);
        guard.check(&found(7 + MARGIN_BYTES), now);
        assert_eq!(guard.reason(), None);
    }
}
