//! The file system of a folder: whether it reports changes, and how much space is free.
//!
//! The kernel reports changes that are made through it. Changes that another machine, or the host of a
//! virtual machine, makes on a shared file system bypass it, so such folders must be polled.

use std::io;
use std::path::Path;

/// The name of the file system at `path`, if changes to it may go unreported: a network file system, one
/// shared with the host of a virtual machine, or one provided by a program.
///
/// Known on Linux only: elsewhere the result is always `None`, and users must request polling.
///
/// # Errors
/// When the path does not exist, or the system refuses.
#[cfg(target_os = "linux")]
pub(crate) fn network_file_system(path: &Path) -> io::Result<Option<&'static str>> {
    // The magic number has 32 bits, in an integer whose width and sign depend on the machine.
    let magic = rustix::fs::statfs(path)?.f_type as u32;
    Ok(NETWORK_FILE_SYSTEMS.iter().find(|entry| entry.0 == magic).map(|entry| entry.1))
}

#[cfg(not(target_os = "linux"))]
pub(crate) fn network_file_system(path: &Path) -> io::Result<Option<&'static str>> {
    path.metadata().map(|_| None)
}

/// The bytes that this user may still write to the file system at `path`.
///
/// # Errors
/// When the path does not exist, or the system refuses.
pub(crate) fn free_bytes(path: &Path) -> io::Result<u64> {
    // On Windows, the call below accepts a missing path.
    path.metadata()?;
    fs4::available_space(path)
}

/// The magic numbers in `statfs` of file systems whose changes may go unreported, with their common names.
#[cfg(target_os = "linux")]
const NETWORK_FILE_SYSTEMS: &[(u32, &str)] = &[
    (0x6969, "NFS"),
    (0xff53_4d42, "SMB (CIFS)"),
    (0xfe53_4d42, "SMB"),
    (0x517b, "SMB"),
    (0x0102_1997, "9P"),
    (0x6573_5546, "FUSE, such as SSHFS or virtiofs"), // or a local one: both have this number
    (0x6b41_4653, "AFS"),
    (0x5346_414f, "AFS"),
    (0x00c3_6400, "Ceph"),
    (0x0bd0_0bd0, "Lustre"),
    (0x4750_4653, "GPFS (Storage Scale)"),
    (0x1983_0326, "BeeGFS"),
    (0x2003_0528, "OrangeFS"),
    (0xaad7_aaea, "PanFS"),
    (0xbeef_dead, "StorNext"),
    (0x7375_7245, "Coda"),
    (0x0116_1970, "GFS2"),
    (0x7461_636f, "OCFS2"),
    (0x786f_4256, "a shared folder of VirtualBox"),
    (0xbacb_acbc, "a shared folder of VMware"),
    (0x7c7c_6673, "a shared folder of Parallels"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_path_is_an_error() {
        let folder = tempfile::tempdir().expect("a folder");
        let gone = folder.path().join("gone");
        let not_found = |error: io::Error| error.kind() == io::ErrorKind::NotFound;
        assert!(network_file_system(&gone).is_err_and(not_found));
        assert!(free_bytes(&gone).is_err());
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn local_file_systems_report_changes() {
        for path in ["/proc", "/sys", "/dev/shm"].map(Path::new).into_iter().filter(|path| path.is_dir()) {
            assert_eq!(network_file_system(path).expect("readable"), None, "{}", path.display());
        }
        let magics: std::collections::HashSet<u32> =
            NETWORK_FILE_SYSTEMS.iter().map(|entry| entry.0).collect();
        assert_eq!(magics.len(), NETWORK_FILE_SYSTEMS.len(), "each once");
    }

    #[test]
    fn free_space_is_in_bytes() {
        let folder = tempfile::tempdir().expect("a folder");
        let before = free_bytes(folder.path()).expect("room");
        assert!((1 << 16..1 << 60).contains(&before), "{before}");
        // Pseudo file systems have no space.
        #[cfg(target_os = "linux")]
        assert_eq!(free_bytes(Path::new("/proc")).expect("room"), 0);
    }
}
