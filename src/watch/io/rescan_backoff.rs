//! How soon everything is looked at again after events were lost.
//!
//! At once, a few times; but events are lost when there are too many of them, and a scan for each loss
//! would be the end of all other work. So further losses are answered less and less quickly.

use std::time::{Duration, Instant};

/// When the next scan after a loss is due.
#[derive(Debug, Default)]
pub(crate) struct RescanBackoff {
    /// When, if one is wanted.
    pub(crate) due_at: Option<Instant>,
    last_at: Option<Instant>,
    in_a_row: u32,
}

/// So many scans are granted at once.
const AT_ONCE: u32 = 3;

/// The wait for the next; it doubles from then on.
const WAIT_FIRST: Duration = Duration::from_millis(100);
const WAIT_MAX: Duration = Duration::from_secs(10);

/// After so long without a loss, all is forgotten.
const CALM: Duration = Duration::from_secs(60);

impl RescanBackoff {
    /// Events were lost.
    pub(crate) fn ask(&mut self, now: Instant) {
        if self.due_at.is_some() {
            return;
        }
        if self.last_at.is_none_or(|last| now.duration_since(last) > CALM) {
            self.in_a_row = 0;
        }
        let wait = match self.in_a_row.checked_sub(AT_ONCE) {
            None => Duration::ZERO,
            Some(more) => WAIT_FIRST.saturating_mul(1 << more.min(16)).min(WAIT_MAX),
        };
        self.due_at = Some(now + wait);
        self.in_a_row += 1;
    }

    /// Whether it is time; then the scan counts as done.
    pub(crate) fn is_due(&mut self, now: Instant) -> bool {
        let is_due = self.due_at.is_some_and(|due_at| due_at <= now);
        if is_due {
            self.due_at = None;
            self.last_at = Some(now);
        }
        is_due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The waits of so many losses, each right after the scan of the one before.
    fn waits(count: usize) -> Vec<u128> {
        let mut pace = RescanBackoff::default();
        let mut now = Instant::now();
        let mut waits = Vec::new();
        for _ in 0..count {
            pace.ask(now);
            let due_at = pace.due_at.expect("a scan is due");
            waits.push((due_at - now).as_millis());
            now = due_at;
            assert!(pace.is_due(now) && !pace.is_due(now));
        }
        waits
    }

    #[test]
    fn losses_in_a_row_are_answered_ever_more_slowly() {
        assert_eq!(waits(7), [0, 0, 0, 100, 200, 400, 800]);
        assert_eq!(waits(40).last(), Some(&10_000));
    }

    #[test]
    fn losses_while_a_scan_is_due_change_nothing() {
        let mut pace = RescanBackoff::default();
        let now = Instant::now();
        for _ in 0..100 {
            pace.ask(now);
        }
        assert!(pace.is_due(now));
        pace.ask(now + CALM + CALM);
        assert!(pace.is_due(now + CALM + CALM));
    }
}
