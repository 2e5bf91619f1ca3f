//! Formats times.

use std::time::Duration;

/// The time since a moment, in the two largest non-zero units.
pub(super) fn ago(at_ms: u64, now_ms: u64) -> String {
    let seconds = now_ms.saturating_sub(at_ms) / 1000;
    if seconds == 0 {
        return "just now".to_owned();
    }
    let text = humantime::format_duration(Duration::from_secs(seconds)).to_string();
    let units: Vec<&str> = text.split(' ').take(2).collect();
    format!("{} ago", units.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_at_most_two_units() {
        for (seconds, expected) in
            [(0, "just now"), (59, "59s ago"), (3600, "1h ago"), (3725, "1h 2m ago"), (90_061, "1day 1h ago")]
        {
            assert_eq!(ago(1000, 1000 + seconds * 1000 + 999), expected);
        }
        // A clock that was set back.
        assert_eq!(ago(5000, 1000), "just now");
    }
}
