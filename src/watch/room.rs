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

/// Why outputs cannot be written.
#[derive(Debug)]
enum Shortage {
    /// There is not enough room.
    Room(NoRoom),
    /// The folder is not there: its file system is not mounted.
    Folder(PathBuf),
    /// The system refuses, for another reason than room, and is asked again at this time.
    Refusal(String, Instant),
}

/// A lack of room.
#[derive(Debug)]
struct NoRoom {
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
        self.shortage = Some(Shortage::Room(NoRoom {
            folder: folder.to_owned(),
            wanted_bytes: self.floor_bytes.max(free.saturating_add(MARGIN_BYTES)),
            try_again_at: Some(self.next_try_at(now)),
            free_bytes: free,
        }));
    }

    /// When a disk that was found full now is tried again. The frames that are under way together find
    /// it full one after the other: that is no reason to wait longer.
    fn next_try_at(&mut self, now: Instant) -> Instant {
        if let Some(Shortage::Room(NoRoom { try_again_at: Some(at), .. })) = self.shortage {
            return at;
        }
        let patience = self.patience;
        self.patience = (patience * 2).min(PATIENCE_MAX);
        now + patience
    }

    /// Nothing can be written, for this reason.
    pub(super) fn was_refused(&mut self, why: String, now: Instant) {
        self.shortage = Some(Shortage::Refusal(why, now + self.patience));
        self.patience = (self.patience * 2).min(PATIENCE_MAX);
    }

    /// A frame was written: there is room.
    pub(super) fn was_enough(&mut self) {
        self.patience = PATIENCE_FIRST;
    }

    /// Looks at these folders again; one of them may be known to be absent. A folder that cannot be asked
    /// is no reason to wait: writing into it will say what is wrong.
    pub(super) fn check<'a>(
        &mut self,
        folders: impl IntoIterator<Item = &'a Path>,
        absent: Option<PathBuf>,
        now: Instant,
    ) {
        if let Some(absent) = absent {
            self.shortage = Some(Shortage::Folder(absent));
            return;
        }
        if let Some(Shortage::Room(shortage)) = &mut self.shortage {
            shortage.free_bytes = free_bytes(&shortage.folder).unwrap_or(u64::MAX);
            let is_time = shortage.try_again_at.is_some_and(|at| at <= now);
            if shortage.free_bytes < shortage.wanted_bytes && !is_time {
                return;
            }
        }
        if matches!(&self.shortage, Some(Shortage::Refusal(_, at)) if now < *at) {
            return;
        }
        let below_floor = |folder: &Path| {
            let free_bytes = free_bytes(folder).unwrap_or(u64::MAX);
            let (wanted_bytes, folder) = (self.floor_bytes, folder.to_owned());
            (free_bytes < wanted_bytes).then_some(NoRoom {
                folder,
                wanted_bytes,
                try_again_at: None,
                free_bytes,
            })
        };
        self.shortage = folders.into_iter().find_map(below_floor).map(Shortage::Room);
    }

    /// Why no frame is begun, while none is.
    pub(super) fn shortage(&self) -> Option<String> {
        Some(match self.shortage.as_ref()? {
            Shortage::Refusal(why, _) => format!("{why}; trying again before long"),
            Shortage::Folder(folder) => format!("{} is not mounted; waiting for it", folder.display()),
            Shortage::Room(NoRoom { folder, wanted_bytes, free_bytes, .. }) => format!(
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

    /// Has a disk that was full wait for this much.
    fn want(room: &mut Room, bytes: u64) {
        match &mut room.shortage {
            Some(Shortage::Room(shortage)) => shortage.wanted_bytes = bytes,
            other => panic!("the disk is not full: {other:?}"),
        }
    }

    #[test]
    fn an_absent_folder_is_waited_for() {
        let folder = tempfile::tempdir().expect("a folder");
        let now = Instant::now();
        let mut room = Room::new(0);
        room.check([folder.path()], Some(folder.path().to_owned()), now);
        assert!(room.shortage().is_some_and(|why| why.ends_with("is not mounted; waiting for it")));
        room.check([folder.path()], None, now);
        assert_eq!(room.shortage(), None);
    }

    #[test]
    fn below_the_floor_it_waits_for_room_however_long_it_takes() {
        let folder = tempfile::tempdir().expect("a folder");
        let now = Instant::now();
        let mut room = Room::new(u64::MAX);
        for hours in [0, 1, 1000] {
            room.check([folder.path()], None, now + Duration::from_secs(3600 * hours));
            let shortage = room.shortage().expect("nobody has that much room");
            assert!(shortage.starts_with(&*folder.path().to_string_lossy()), "{shortage}");
        }
        let mut room = Room::new(0);
        room.check([folder.path()], None, now);
        assert_eq!(room.shortage(), None);
    }

    #[test]
    fn a_full_disk_is_tried_again_after_a_while_and_then_less_often() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut now = Instant::now();
        let mut room = Room::new(0);
        for expected in [5, 10, 20, 40, 80, 160, 300, 300] {
            // By several frames that were under way together.
            for _ in 0..3 {
                room.ran_out(folder.path(), now);
            }
            // However much others free or take meanwhile, this is never enough.
            want(&mut room, u64::MAX);
            room.check([folder.path()], None, now + Duration::from_secs(expected - 1));
            assert!(room.shortage().is_some(), "{expected}");
            now += Duration::from_secs(expected);
            room.check([folder.path()], None, now);
            assert_eq!(room.shortage(), None, "{expected}");
        }
        room.was_enough();
        room.ran_out(folder.path(), now);
        want(&mut room, u64::MAX);
        room.check([folder.path()], None, now + PATIENCE_FIRST);
        assert_eq!(room.shortage(), None);
    }

    #[test]
    fn room_that_was_made_is_used_at_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let now = Instant::now();
        let mut room = Room::new(0);
        room.ran_out(folder.path(), now);
        want(&mut room, 1);
        room.check([folder.path()], None, now);
        assert_eq!(room.shortage(), None);
    }
}
