//! Tests that mount file systems of their own.
//!
//! A test runs once more in a process of its own, in a mount namespace that nobody else sees: there it
//! may mount what it likes, and all of it is gone when it ends. Root may have one, and so may everybody
//! where the system allows user namespaces. Where neither is so, the test says that it is skipped.

use std::env;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::scene::tell;

/// Set in the process of its own.
const INSIDE: &str = "MENISCUS_SIEGE_OWN_MOUNTS";

/// Runs the test of this name, which is the one that calls, in a mount namespace of its own.
pub(crate) fn with_own_mounts(name: &str, test: impl FnOnce()) {
    if env::var_os(INSIDE).is_some() {
        return test();
    }
    let Some(unshare) = how_to_unshare() else {
        return tell(&format!("test {name} is SKIPPED: it would mount file systems, and may not"));
    };
    let ran = Command::new("unshare")
        .args(unshare)
        .arg(env::current_exe().expect("this test"))
        .args(["--exact", name, "--nocapture"])
        .env(INSIDE, "1")
        // What it tells is told, also where it passes.
        .stderr(Stdio::inherit())
        .output()
        .expect("it starts");
    let said = String::from_utf8_lossy(&ran.stdout);
    assert!(ran.status.success() && said.contains("1 passed"), "{said}");
}

/// What to tell `unshare` to get a namespace in which one may mount; `None` where nothing does it.
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

/// Mounts an empty file system of so many bytes.
pub(crate) fn mount_tmpfs(folder: &Path, size_bytes: u64) {
    mount(&["-t", "tmpfs", "-o", &format!("size={size_bytes}"), "none"], folder);
}

/// Lets a folder be seen at another place.
pub(crate) fn mount_bind(from: &Path, to: &Path) {
    mount(&["--bind", &from.to_string_lossy()], to);
}

fn mount(arguments: &[&str], folder: &Path) {
    let output = Command::new("mount").args(arguments).arg(folder).output().expect("mount runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Takes it away again, even while it is looked at.
pub(crate) fn unmount(folder: &Path) {
    let output = Command::new("umount").arg("--lazy").arg(folder).output().expect("umount runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
