//! Room for outputs: no frame is begun without some, and one that ran out of it waits for more.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::mounts::free_bytes;

/// Whether there is room for outputs.
#[derive(Debug)]
pub(super) struct Room {
    floor_bytes: u64,
    shortage: Option<Shortage>,
    /// How long the next wait after a full disk is, at most.
    patience: Duration,
}

/// A lack of room.
#[derive(Debug)]
struct Shortage {
    folder: PathBuf,
    /// So much must be free.
    wanted_bytes: u64,
    /// From then on it is tried again, whatever is free: `None` where only room helps.
    try_again_at: Option<Instant>,
    free_bytes: u64,
}

/// More than this must have become free before a disk that was full is tried again at once.
const MARGIN_BYTES: u64 = 1 << 20;

const PATIENCE_FIRST: Duration = Duration::from_secs(5);
const PATIENCE_MAX: Duration = Duration::from_secs(300);

impl Room {
    pub(super) fn new(floor_bytes: u64) -> Room {
        Room { floor_bytes, shortage: None, patience: PATIENCE_FIRST }
    }

    /// A frame found the disk of this folder full.
    pub(super) fn ran_out(&mut self, folder: &Path, now: Instant) {
        let free = free_bytes(folder).unwrap_or(0);
        self.shortage = Some(Shortage {
            folder: folder.to_owned(),
            wanted_bytes: self.floor_bytes.max(free.saturating_add(MARGIN_BYTES)),
            try_again_at: Some(now + self.patience),
            free_bytes: free,
        });
        self.patience = (self.patience * 2).min(PATIENCE_MAX);
    }

    /// A frame was written: there is room.
    pub(super) fn was_enough(&mut self) {
        self.patience = PATIENCE_FIRST;
    }

    /// Looks at these folders again. A folder that cannot be asked is no reason to wait: writing into it
    /// will say what is wrong.
    pub(super) fn check<'a>(&mut self, folders: impl IntoIterator<Item = &'a Path>, now: Instant) {
        if let Some(shortage) = &mut self.shortage {
            shortage.free_bytes = free_bytes(&shortage.folder).unwrap_or(u64::MAX);
            let is_time = shortage.try_again_at.is_some_and(|at| at <= now);
            if shortage.free_bytes < shortage.wanted_bytes && !is_time {
                return;
            }
            self.shortage = None;
        }
        for folder in folders {
            let free = free_bytes(folder).unwrap_or(u64::MAX);
            if free < self.floor_bytes {
                self.shortage = Some(Shortage {
                    folder: folder.to_owned(),
                    wanted_bytes: self.floor_bytes,
                    try_again_at: None,
                    free_bytes: free,
                });
                return;
            }
        }
    }

    /// Why no frame is begun, while none is.
    pub(super) fn shortage(&self) -> Option<String> {
        let Shortage { folder, wanted_bytes, free_bytes, .. } = self.shortage.as_ref()?;
        Some(format!(
            "{} has {} free; waiting for {}",
            folder.display(),
            bytesize::ByteSize(*free_bytes),
            bytesize::ByteSize(*wanted_bytes)
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn below_the_floor_it_waits_for_room_however_long_it_takes() {
        let folder = tempfile::tempdir().expect("a folder");
        let now = Instant::now();
        let mut room = Room::new(u64::MAX);
        for hours in [0, 1, 1000] {
            room.check([folder.path()], now + Duration::from_secs(3600 * hours));
            let shortage = room.shortage().expect("nobody has that much room");
            assert!(shortage.starts_with(&*folder.path().to_string_lossy()), "{shortage}");
        }
        let mut room = Room::new(0);
        room.check([folder.path()], now);
        assert_eq!(room.shortage(), None);
    }

    #[test]
    fn a_full_disk_is_tried_again_after_a_while_and_then_less_often() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut now = Instant::now();
        let mut room = Room::new(0);
        for expected in [5, 10, 20, 40, 80, 160, 300, 300] {
            room.ran_out(folder.path(), now);
            // However much others free or take meanwhile, this is never enough.
            room.shortage.as_mut().expect("a shortage").wanted_bytes = u64::MAX;
            room.check([folder.path()], now + Duration::from_secs(expected - 1));
            assert!(room.shortage().is_some(), "{expected}");
            now += Duration::from_secs(expected);
            room.check([folder.path()], now);
            assert_eq!(room.shortage(), None, "{expected}");
        }
        room.was_enough();
        room.ran_out(folder.path(), now);
        assert_eq!(room.shortage.and_then(|shortage| shortage.try_again_at), Some(now + PATIENCE_FIRST));
    }

    #[test]
    fn room_that_was_made_is_used_at_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let now = Instant::now();
        let mut room = Room::new(0);
        room.ran_out(folder.path(), now);
        room.shortage.as_mut().expect("a shortage").wanted_bytes = 1;
        room.check([folder.path()], now);
        assert_eq!(room.shortage(), None);
    }
}
