//! Mount namespaces for tests that mount file systems.
//!
//! Such a test runs a second time in a child process with a private mount namespace. It may mount file
//! systems there, and the kernel removes them when the process ends. Root may create a namespace, and so may
//! other users if the system allows user namespaces. Otherwise the test is skipped with a message.

use std::env;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::siege::scene::print_line;

/// Set in the child process.
const INSIDE: &str = "MENISCUS_SIEGE_OWN_MOUNTS";

/// Runs the calling test, which has this name, in a private mount namespace.
pub(crate) fn with_own_mounts(name: &str, test: impl FnOnce()) {
    if env::var_os(INSIDE).is_some() {
        return test();
    }
    let Some(unshare) = how_to_unshare() else {
        return print_line(&format!("test {name} is SKIPPED: it would mount file systems, and may not"));
    };
    let result = Command::new("unshare")
        .args(unshare)
        .arg(env::current_exe().expect("this test"))
        .args(["--exact", &format!("siege::{name}"), "--include-ignored", "--nocapture"])
        .env(INSIDE, "1")
        // Prints the output of the child process also if the test passes.
        .stderr(Stdio::inherit())
        .output()
        .expect("it starts");
    let message = String::from_utf8_lossy(&result.stdout);
    assert!(result.status.success() && message.contains("1 passed"), "{message}");
}

/// The arguments with which `unshare` creates a namespace that allows mounts; `None` if no arguments work.
fn how_to_unshare() -> Option<&'static [&'static str]> {
    let folder = tempfile::tempdir().expect("a folder");
    let may_mount = |unshare: &&[&str]| {
        let mut command = Command::new("unshare");
        let mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none"];
        command.args(*unshare).args(mount).arg(folder.path());
        command.output().is_ok_and(|output| output.status.success())
    };
    let ways: [&'static [&'static str]; 2] = [&["--mount"], &["--user", "--map-root-user", "--mount"]];
    ways.into_iter().find(may_mount)
}

/// Mounts an empty file system of this size in bytes.
pub(crate) fn mount_tmpfs(folder: &Path, size_bytes: u64) {
    mount(&["-t", "tmpfs", "-o", &format!("size={size_bytes}"), "none"], folder);
}

/// Makes a folder visible at another path.
pub(crate) fn mount_bind(from: &Path, to: &Path) {
    mount(&["--bind", &from.to_string_lossy()], to);
}

fn mount(arguments: &[&str], folder: &Path) {
    let output = Command::new("mount").args(arguments).arg(folder).output().expect("mount runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Unmounts a file system, even while it is in use.
pub(crate) fn unmount(folder: &Path) {
    let output = Command::new("umount").arg("--lazy").arg(folder).output().expect("umount runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
