//! Limits how often everything is scanned again after events were lost.
//!
//! The first few losses cause a scan at once. But events are lost when there are too many of them, and a scan
//! for each loss would block all other work. So scans for further losses are delayed more and more.

use std::time::{Duration, Instant};

/// When the next scan after a loss is due.
#[derive(Debug, Default)]
pub(crate) struct RescanBackoff {
    /// When the next scan is due, if one is requested.
    pub(crate) due_at: Option<Instant>,
    last_at: Option<Instant>,
    consecutive_count: u32,
}

/// The number of scans that are granted at once.
const AT_ONCE: u32 = 3;

/// The first delay; it doubles from then on.
const WAIT_FIRST: Duration = Duration::from_millis(100);
const WAIT_MAX: Duration = Duration::from_secs(10);

/// After this long without a loss, the delays start over.
const RESET_AFTER: Duration = Duration::from_secs(60);

impl RescanBackoff {
    /// Events were lost.
    pub(crate) fn request(&mut self, now: Instant) {
        if self.due_at.is_some() {
            return;
        }
        if self.last_at.is_none_or(|last| now.duration_since(last) > RESET_AFTER) {
            self.consecutive_count = 0;
        }
        let wait = match self.consecutive_count.checked_sub(AT_ONCE) {
            None => Duration::ZERO,
            Some(more) => WAIT_FIRST.saturating_mul(1 << more.min(16)).min(WAIT_MAX),
        };
        self.due_at = Some(now + wait);
        self.consecutive_count += 1;
    }

    /// Whether a scan is due; if so, it counts as done.
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

    /// The delays after this many losses; each loss occurs right after the scan for the previous one.
    fn waits(count: usize) -> Vec<u128> {
        let mut backoff = RescanBackoff::default();
        let mut now = Instant::now();
        let mut waits = Vec::new();
        for _ in 0..count {
            backoff.request(now);
            let due_at = backoff.due_at.expect("a scan is due");
            waits.push((due_at - now).as_millis());
            now = due_at;
            assert!(backoff.is_due(now) && !backoff.is_due(now));
        }
        waits
    }

    #[test]
    fn consecutive_losses_are_delayed_more_and_more() {
        assert_eq!(waits(7), [0, 0, 0, 100, 200, 400, 800]);
        assert_eq!(waits(40).last(), Some(&10_000));
    }

    #[test]
    fn losses_while_a_scan_is_due_change_nothing() {
        let mut backoff = RescanBackoff::default();
        let now = Instant::now();
        for _ in 0..100 {
            backoff.request(now);
        }
        assert!(backoff.is_due(now));
        backoff.request(now + RESET_AFTER + RESET_AFTER);
        assert!(backoff.is_due(now + RESET_AFTER + RESET_AFTER));
    }
}
