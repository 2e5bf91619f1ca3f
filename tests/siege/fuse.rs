//! A file system whose server the test can stop, to imitate a file server that stops responding.
//!
//! The server is a second process of this test program. It serves a folder read-only and disables the
//! kernel's caches, so that every call of a client waits for it.

use std::collections::HashMap;
use std::env;
use std::fs::{self, File, Metadata, OpenOptions};
use std::io::{BufRead, BufReader, ErrorKind, Lines, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};

use rustix::io::{FdFlags, fcntl_setfd};

/// Set in the process of the server: the folder that it serves, and the mount point.
const SERVED: &str = "MENISCUS_SIEGE_FUSE_SERVED";
const MOUNTED_AT: &str = "MENISCUS_SIEGE_FUSE_AT";

/// The server prints this when the file system is mounted.
const MOUNTED: &str = "the file system is mounted";

/// A mounted file system; dropping it unmounts it.
pub(crate) struct Mount {
    server: Child,
    at: PathBuf,
    /// The output of the server: kept open, because the server would end if the pipe were closed.
    _output: Lines<BufReader<ChildStdout>>,
}

impl Mount {
    /// Serves `folder` at `at`, which is an empty folder. `None` if the system has no FUSE.
    pub(crate) fn new(folder: &Path, at: &Path) -> Option<Mount> {
        OpenOptions::new().read(true).write(true).open("/dev/fuse").ok()?;
        let mut server = Command::new(env::current_exe().expect("this test"))
            .args(["--exact", "siege::fuse::server", "--nocapture"])
            .env(SERVED, folder)
            .env(MOUNTED_AT, at)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("it starts");
        let mut lines = BufReader::new(server.stdout.take().expect("piped")).lines();
        let is_mounted = lines.any(|line| line.is_ok_and(|line| line.contains(MOUNTED)));
        let mount = Mount { server, at: at.to_owned(), _output: lines };
        is_mounted.then_some(mount)
    }

    /// From now on, no call to this file system returns.
    pub(crate) fn stop(&self) {
        self.signal("STOP");
    }

    /// Lets all calls return.
    pub(crate) fn go_on(&self) {
        self.signal("CONT");
    }

    fn signal(&self, name: &str) {
        let sent = Command::new("kill").args(["-s", name, &self.server.id().to_string()]).status();
        assert!(sent.expect("kill runs").success());
    }
}

impl Drop for Mount {
    fn drop(&mut self) {
        // Blocked calls fail when the server ends.
        let _ = self.server.kill();
        let _ = self.server.wait();
        let _ = Command::new("umount").arg("--lazy").arg(&self.at).status();
    }
}

/// The entry point of the server process; does nothing as a test.
#[test]
#[expect(clippy::print_stdout, reason = "the test that started this process reads the line")]
fn server() {
    let (Some(folder), Some(at)) = (env::var_os(SERVED), env::var_os(MOUNTED_AT)) else { return };
    let device = OpenOptions::new().read(true).write(true).open("/dev/fuse").expect("FUSE");
    fcntl_setfd(&device, FdFlags::empty()).expect("inherited by mount");
    let options = format!("fd={},rootmode=40000,user_id=0,group_id=0,allow_other", device.as_raw_fd());
    let mount = Command::new("mount").args(["-i", "-t", "fuse", "-o", &options, "siege"]).arg(&at).output();
    let mount = mount.expect("mount runs");
    assert!(mount.status.success(), "{}", String::from_utf8_lossy(&mount.stderr));
    println!("{MOUNTED}");
    Server { device, paths: vec![folder.into()], nodes: HashMap::new() }.serve();
}

struct Server {
    device: File,
    /// The path of each node; the first is the root, number 1.
    paths: Vec<PathBuf>,
    nodes: HashMap<PathBuf, u64>,
}

const ENOENT: i32 = 2;
const ENOSYS: i32 = 38;

/// A reply: bytes, or an error number.
type Answer = Result<Vec<u8>, i32>;

impl Server {
    fn serve(mut self) {
        let mut request = vec![0; 1 << 20];
        loop {
            let length = match self.device.read(&mut request) {
                Ok(length) => length,
                // A SIGCONT interrupts the call; the kernel may withdraw a request before it is read.
                Err(error) if matches!(error.kind(), ErrorKind::Interrupted | ErrorKind::NotFound) => {
                    continue;
                }
                // The file system was unmounted.
                Err(_) => return,
            };
            let (header, body) = request[..length].split_at(40);
            let (operation, unique, node) = (u32_at(header, 4), u64_at(header, 8), u64_at(header, 16));
            // FORGET, INTERRUPT and BATCH_FORGET have no reply.
            if matches!(operation, 2 | 36 | 42) {
                continue;
            }
            let answer = self.answer(operation, node, body);
            let (error, bytes) = match answer {
                Ok(bytes) => (0, bytes),
                Err(error) => (-error, Vec::new()),
            };
            let length = u32::try_from(16 + bytes.len()).expect("small");
            let mut out = length.to_le_bytes().to_vec();
            out.extend(error.to_le_bytes());
            out.extend(unique.to_le_bytes());
            out.extend(bytes);
            // The kernel discards the reply to an interrupted request.
            let _ = self.device.write(&out);
        }
    }

    fn answer(&mut self, operation: u32, node: u64, body: &[u8]) -> Answer {
        let path = self.paths.get(usize::try_from(node).expect("small").wrapping_sub(1)).cloned();
        let path = path.unwrap_or_default();
        match operation {
            1 => {
                let name = String::from_utf8_lossy(body.split(|&byte| byte == 0).next().unwrap_or_default());
                let path = path.join(&*name);
                let metadata = fs::metadata(&path).map_err(|_| ENOENT)?;
                let node = self.node_of(path);
                let mut out = words(&[node, 0, 0, 0, 0]);
                out.extend(attributes(&metadata));
                Ok(out)
            }
            3 => {
                let mut out = words(&[0, 0]);
                out.extend(attributes(&fs::metadata(path).map_err(|_| ENOENT)?));
                Ok(out)
            }
            // OPEN, OPENDIR
            14 | 27 => Ok(words(&[0, 0])),
            15 => {
                let mut bytes = vec![0; u32_at(body, 16) as usize];
                let file = File::open(path).map_err(|_| ENOENT)?;
                let length = file.read_at(&mut bytes, u64_at(body, 8)).map_err(|_| ENOENT)?;
                bytes.truncate(length);
                Ok(bytes)
            }
            // STATFS
            17 => Ok(vec![0; 80]),
            26 => Ok(initial(body)),
            28 => Ok(entries(&path, u64_at(body, 8), u32_at(body, 16) as usize)),
            // RELEASE, RELEASEDIR, DESTROY
            18 | 29 | 38 => Ok(Vec::new()),
            _ => Err(ENOSYS),
        }
    }

    fn node_of(&mut self, path: PathBuf) -> u64 {
        let next = self.paths.len() as u64 + 1;
        let node = *self.nodes.entry(path.clone()).or_insert(next);
        if node == next {
            self.paths.push(path);
        }
        node
    }
}

/// The reply to INIT: version 7.31, without options.
fn initial(body: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    for word in [7, 31, u32_at(body, 8), 0] {
        out.extend(word.to_le_bytes());
    }
    out.extend(16_u16.to_le_bytes()); // requests in the background
    out.extend(12_u16.to_le_bytes());
    out.extend(4096_u32.to_le_bytes()); // bytes of a write
    out.extend(1_u32.to_le_bytes()); // granularity of times
    out.resize(64, 0);
    out
}

/// The names in a folder, from an offset on, as many as fit.
fn entries(path: &Path, offset: u64, size: usize) -> Vec<u8> {
    let mut names: Vec<(String, u64)> = fs::read_dir(path)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| {
            (entry.file_name().to_string_lossy().into_owned(), entry.metadata().map_or(1, |m| m.ino()))
        })
        .collect();
    names.sort();
    let mut out = Vec::new();
    for ((name, inode), next) in names.into_iter().zip(1_u64..).skip(offset as usize) {
        let mut entry = words(&[inode, next]);
        entry.extend(u32::try_from(name.len()).expect("short").to_le_bytes());
        entry.extend(8_u32.to_le_bytes()); // a regular file
        entry.extend(name.as_bytes());
        entry.resize(entry.len().next_multiple_of(8), 0);
        if out.len() + entry.len() > size {
            break;
        }
        out.extend(entry);
    }
    out
}

fn attributes(metadata: &Metadata) -> Vec<u8> {
    let [atime, mtime, ctime] =
        [metadata.atime(), metadata.mtime(), metadata.ctime()].map(|time| time as u64);
    let mut out = words(&[metadata.ino(), metadata.size(), metadata.blocks(), atime, mtime, ctime]);
    let nanoseconds = [metadata.atime_nsec(), metadata.mtime_nsec(), metadata.ctime_nsec()];
    for word in nanoseconds.map(|time| time as u32) {
        out.extend(word.to_le_bytes());
    }
    for word in [metadata.mode(), 1, metadata.uid(), metadata.gid(), 0, 4096, 0] {
        out.extend(word.to_le_bytes());
    }
    out
}

fn words(words: &[u64]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}
