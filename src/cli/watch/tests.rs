use super::*;
use std::fs;

fn summary(ended: EndReason, done_count: usize, failed_count: usize, left_count: usize) -> WatchSummary {
    let failed = FailedFrame { what: "f: why".to_owned(), frames_since: Some(0) };
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
        let failed = |&frames_since: &Option<usize>| FailedFrame { what: "f: why".to_owned(), frames_since };
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

/// Sends signals to a daemon with this file, and returns the resulting commands.
fn control(config: Option<&std::path::Path>) -> (Control, crossbeam::channel::Receiver<DaemonRequest>) {
    let (sender, commands) = unbounded();
    let args = WatchArgs { config: config.map(Into::into), ..WatchArgs::default() };
    (Control::new(args, (LogChoice::Text, None), sender), commands)
}

#[test]
fn first_signal_finishes_frames_and_second_exits() {
    let (control, commands) = control(None);
    assert!(!control.finish());
    assert!(control.finish());
    assert_eq!(commands.try_iter().collect::<Vec<_>>(), [DaemonRequest::Finish]);
}

#[test]
fn reload_reads_the_current_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("meniscus.toml");
    let (control, commands) = control(Some(&path));
    let write = |text: &str| fs::write(&path, text).expect("written");
    // If the file is invalid or missing, the loop continues, and gets the reason.
    control.reload();
    write("[[watch]]\ninputt = \"in\"\n");
    control.reload();
    let is_refusal =
        |request| matches!(request, DaemonRequest::ReloadRefused(why) if why.contains("meniscus.toml"));
    assert!(commands.try_iter().map(is_refusal).eq([true; 2]) && !control.is_reloading());
    // After two reloads of a valid file, the loop gets one command, and uses the last plan.
    for output in ["first", "last"] {
        write(&format!("[[watch]]\ninput = \"in\"\noutput = \"{output}\"\n"));
        control.reload();
    }
    assert!(control.is_reloading());
    assert_eq!(commands.try_iter().collect::<Vec<_>>(), [DaemonRequest::Reload]);
    let plan = control.next_plan().expect("a plan");
    assert!(plan.config.watches[0].outputs.folder.ends_with("last"));
    assert!(control.next_plan().is_none() && !control.is_reloading());
}

#[test]
fn reload_without_config_is_refused() {
    let (control, commands) = control(None);
    control.reload();
    let [DaemonRequest::ReloadRefused(why)] = &commands.try_iter().collect::<Vec<_>>()[..] else {
        panic!("one request")
    };
    assert!(why.contains("nothing to reload") && control.next_plan().is_none());
}

#[test]
fn shutdown_overrides_pending_reload() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("meniscus.toml");
    fs::write(&path, "[[watch]]\ninput = \"in\"\noutput = \"out\"\n").expect("written");
    let (control, commands) = control(Some(&path));
    control.reload();
    control.finish();
    control.reload();
    assert_eq!(commands.try_iter().collect::<Vec<_>>(), [DaemonRequest::Reload, DaemonRequest::Finish]);
    assert!(!control.is_reloading() && control.next_plan().is_none());
}

/// Set in the child process of the test below.
#[cfg(unix)]
const CHILD: &str = "MENISCUS_TEST_SIGNALS";

/// The loop never receives the command, as if it waited for a file system that does not respond.
#[test]
#[cfg(target_os = "linux")]
fn sigterm_ends_a_daemon_that_hangs() {
    use rustix::process::{Pid, Signal, kill_process};
    use std::io::{BufRead, BufReader, Write};
    use std::process::Stdio;
    use std::time::Instant;

    if std::env::var_os(CHILD).is_some() {
        let (control, _commands) = control(None);
        signals::listen(Arc::new(control)).expect("listens");
        writeln!(std::io::stdout(), "ready").expect("a parent who listens");
        loop {
            std::thread::park();
        }
    }
    let mut child = std::process::Command::new(std::env::current_exe().expect("this test"))
        .args(["sigterm_ends_a_daemon_that_hangs", "--nocapture"])
        .env(CHILD, "1")
        .stdout(Stdio::piped())
        .spawn()
        .expect("a child");
    let mut lines = BufReader::new(child.stdout.take().expect("piped")).lines();
    assert!(lines.any(|line| line.is_ok_and(|line| line.contains("ready"))), "the child is ready");
    kill_process(Pid::from_child(&child), Signal::TERM).expect("sent");
    let start = Instant::now();
    while child.try_wait().expect("a child").is_none() && start.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(10));
    }
    // Killing a child that has already ended is harmless.
    let _ = child.kill();
    assert_eq!(child.wait().expect("ended").code(), Some(0));
}
