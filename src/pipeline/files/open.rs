//! Opens files: never blocks on a named pipe.
//!
//! ```text
//!   inputs, outputs, plans, settings                  open_regular   links are followed
//!   temporary files, lock, records, served outputs    open_itself    refuses a link at the path
//! ```
//!
//! Opening a named pipe waits until a process opens its other end, which may be never. So this program uses one of
//! these functions to open any path that another process can change; they open only regular files.

use std::fs::{File, FileType, Metadata, OpenOptions};
use std::io::{self, Read};
use std::path::Path;

/// Opens a regular file for reading. Follows links. Opens a pipe only if this process has it open already:
/// shells write `<(zcat dam.ply.gz)` as `/dev/fd/63`.
///
/// # Errors
/// When the system reports an error; `IsADirectory` for a folder, and `InvalidInput` for anything else that is not a
/// regular file.
pub fn open_regular(path: &Path) -> io::Result<File> {
    if is_own_descriptor(path) {
        return File::open(path);
    }
    // The type is checked before the file is opened, because opening a pipe lets the process at its other end
    // continue, and opening a device may act on it.
    require_regular(&path.metadata()?)?;
    let file = match without_waiting(File::options().read(true)).open(path) {
        // An open with `O_NONBLOCK` fails while another process holds a lease on the file. The system takes the
        // lease away within a moment, for which a blocking open waits.
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => File::open(path),
        file => file,
    }?;
    // Another file may have replaced it meanwhile.
    require_regular(&file.metadata()?)?;
    Ok(file)
}

fn is_own_descriptor(path: &Path) -> bool {
    cfg!(unix)
        && (path == Path::new("/dev/stdin")
            || path.starts_with("/dev/fd")
            || path.starts_with("/proc/self/fd"))
}

/// Reads a regular file. Follows links.
///
/// # Errors
/// Those of [`open_regular`], and when the file cannot be read.
pub fn read_regular(path: &Path) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open_regular(path)?.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Reads the text of a regular file. Follows links.
///
/// # Errors
/// Those of [`read_regular`]; `InvalidData` if the text is not UTF-8.
pub fn read_regular_text(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    open_regular(path)?.read_to_string(&mut text)?;
    Ok(text)
}

/// Opens a regular file; a link at its path is not followed.
///
/// # Errors
/// When the system reports an error; `IsADirectory` for a folder, and `InvalidInput` for anything else that is not a
/// regular file.
pub fn open_itself(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    match path.symlink_metadata() {
        Ok(metadata) => require_regular(&metadata)?,
        // The options may create the file.
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => return Err(error),
    }
    let file = match without_links(options, Waiting::No).open(path) {
        // A lease, as in `open_regular`.
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
            without_links(options, Waiting::Yes).open(path)
        }
        file => file,
    }?;
    require_regular(&file.metadata()?)?;
    Ok(file)
}

/// Requires a regular file.
///
/// # Errors
/// The kind of file that it is instead.
pub(crate) fn require_regular(metadata: &Metadata) -> io::Result<()> {
    if metadata.is_file() {
        return Ok(());
    }
    let kind = if metadata.is_dir() { io::ErrorKind::IsADirectory } else { io::ErrorKind::InvalidInput };
    Err(io::Error::new(kind, format!("not a regular file: {}", name_of_kind(metadata.file_type()))))
}

fn name_of_kind(kind: FileType) -> &'static str {
    match kind {
        kind if kind.is_dir() => "a folder",
        kind if kind.is_symlink() => "a symbolic link",
        kind => name_of_special(kind),
    }
}

#[cfg(unix)]
fn name_of_special(kind: FileType) -> &'static str {
    use std::os::unix::fs::FileTypeExt;
    match kind {
        kind if kind.is_fifo() => "a pipe",
        kind if kind.is_socket() => "a socket",
        _ => "a device",
    }
}

#[cfg(windows)]
fn name_of_special(_kind: FileType) -> &'static str {
    "a file of unknown type"
}

/// Whether opening a file may wait for another process.
#[derive(Clone, Copy)]
enum Waiting {
    No,
    Yes,
}

#[cfg(unix)]
fn without_waiting(options: &mut OpenOptions) -> &mut OpenOptions {
    use std::os::unix::fs::OpenOptionsExt;
    options.custom_flags(rustix::fs::OFlags::NONBLOCK.bits() as i32)
}

/// On Windows, named pipes are not in folders.
#[cfg(windows)]
fn without_waiting(options: &mut OpenOptions) -> &mut OpenOptions {
    options
}

#[cfg(unix)]
fn without_links(options: &mut OpenOptions, waiting: Waiting) -> &mut OpenOptions {
    use rustix::fs::OFlags;
    use std::os::unix::fs::OpenOptionsExt;
    let flags = match waiting {
        Waiting::No => OFlags::NONBLOCK | OFlags::NOFOLLOW,
        Waiting::Yes => OFlags::NOFOLLOW,
    };
    options.custom_flags(flags.bits() as i32)
}

/// Opens a link itself, which [`require_regular`] refuses.
#[cfg(windows)]
fn without_links(options: &mut OpenOptions, _waiting: Waiting) -> &mut OpenOptions {
    use std::os::windows::fs::OpenOptionsExt;
    const FILE_FLAG_OPEN_REPARSE_POINT: u32 = 0x0020_0000;
    options.custom_flags(FILE_FLAG_OPEN_REPARSE_POINT)
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;
    use std::path::PathBuf;
    use std::sync::mpsc::channel;
    use std::thread;
    use std::time::Duration;

    use rustix::fs::{CWD, Mode, mkfifoat};

    /// The result of a function that must not block.
    #[track_caller]
    fn at_once<T: Send + 'static>(act: impl FnOnce() -> T + Send + 'static) -> T {
        let (sender, result) = channel();
        thread::spawn(move || sender.send(act()));
        result.recv_timeout(Duration::from_secs(60)).expect("it does not wait")
    }

    fn words<T>(result: io::Result<T>) -> String {
        result.err().map(|error| error.to_string()).unwrap_or_default()
    }

    #[test]
    fn pipe_folder_and_device_are_refused_without_waiting() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        mkfifoat(CWD, path("pipe"), Mode::RUSR | Mode::WUSR).expect("a pipe");
        symlink(path("pipe"), path("link")).expect("a link");
        let cases: [(PathBuf, &str); 4] = [
            (path("pipe"), "a pipe"),
            (path("link"), "a pipe"),
            (folder.path().to_owned(), "a folder"),
            ("/dev/zero".into(), "a device"),
        ];
        for (path, kind) in cases {
            let expected = format!("not a regular file: {kind}");
            assert_eq!(words(at_once(move || open_regular(&path))), expected);
        }
        let pipe = path("pipe");
        let own = at_once(move || open_itself(&pipe, OpenOptions::new().read(true).write(true).create(true)));
        assert_eq!(words(own), "not a regular file: a pipe");
    }

    #[test]
    fn link_is_refused_and_its_target_unchanged() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        fs::write(path("precious"), "precious").expect("written");
        symlink(path("precious"), path("link")).expect("a link");
        assert_eq!(read_regular(&path("link")).expect("followed"), b"precious");
        let open =
            |path: &Path| open_itself(path, OpenOptions::new().write(true).create(true).truncate(true));
        assert_eq!(words(open(&path("link"))), "not a regular file: a symbolic link");
        // Opening a dangling link would create a file at its target.
        symlink(path("nowhere"), path("dangling")).expect("a link");
        assert!(open(&path("dangling")).is_err() && !path("nowhere").exists());
        open(&path("journal")).expect("no link");
        assert_eq!(fs::read(path("precious")).expect("there"), b"precious");
    }
}
