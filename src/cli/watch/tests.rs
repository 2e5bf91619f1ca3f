use super::*;

fn summary(ended: EndReason, done_count: usize, failed_count: usize, left_count: usize) -> WatchSummary {
    let failed = FailedFrame { message: "f: why".to_owned(), frames_since: Some(0) };
    let failed = vec![failed; failed_count];
    WatchSummary { ended, done_count, broken_count: 0, failed, left_count, has_unwritten: false }
}

#[test]
fn once_has_the_exit_status_of_convert() {
    for (done, failed, left, expected) in [
        (3, 0, 0, CommandOutcome::Done),
        (3, 1, 0, CommandOutcome::SomeFailed),
        (3, 0, 1, CommandOutcome::SomeFailed),
        (0, 1, 0, CommandOutcome::NothingDone),
        (0, 0, 0, CommandOutcome::NothingDone),
    ] {
        assert_eq!(log_summary(Some(false), &[], &summary(EndReason::Drained, done, failed, left)), expected);
    }
    let unwritten = WatchSummary { has_unwritten: true, ..summary(EndReason::Drained, 3, 0, 0) };
    assert_eq!(log_summary(Some(true), &[], &unwritten), CommandOutcome::SomeFailed);
    assert_eq!(log_summary(None, &[], &unwritten), CommandOutcome::Done);
    // A daemon that was stopped on request succeeded.
    assert_eq!(log_summary(None, &[], &summary(EndReason::Finish, 0, 3, 3)), CommandOutcome::Done);
}

#[test]
fn once_with_violations_exits_with_1_unless_they_are_allowed() {
    let broken = WatchSummary { broken_count: 1, ..summary(EndReason::Drained, 3, 0, 0) };
    assert_eq!(log_summary(Some(false), &[], &broken), CommandOutcome::SomeFailed);
    assert_eq!(log_summary(Some(true), &[], &broken), CommandOutcome::Done);
    assert_eq!(log_summary(None, &[], &broken), CommandOutcome::Done);
}

#[test]
fn recent_failures_are_not_logged_again() {
    let failed = |frames_since: &[Option<usize>]| -> Vec<FailedFrame> {
        let failed =
            |&frames_since: &Option<usize>| FailedFrame { message: "f: why".to_owned(), frames_since };
        frames_since.iter().map(failed).collect()
    };
    for (frames_since, expected) in [
        (&[][..], false),
        (&[Some(0), Some(20)], false),
        (&[Some(0), Some(21)], true),
        (&[Some(0), None], true),
    ] {
        assert_eq!(has_scrolled_away(&failed(frames_since)), expected, "{frames_since:?}");
    }
}
