//! Faults of the daemon's environment.

use std::fs::{self, File};
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::thread;
use std::time::Duration;

use super::producer::Producer;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Fault {
    /// SIGKILL, followed by a restart.
    Kill,
    /// SIGTERM, followed by a restart.
    End,
    /// The disk of the outputs has no free byte while frames are produced.
    FullDisk,
    /// The watched folder is moved away for a while.
    FolderGone,
    /// Many HTTP clients, of which some never read.
    Crowd,
}

impl Fault {
    pub(super) const ALL: [Fault; 5] =
        [Fault::Kill, Fault::End, Fault::FullDisk, Fault::FolderGone, Fault::Crowd];

    /// The faults that do not end the daemon.
    pub(super) const OF_ONE_LIFE: [Fault; 3] = [Fault::FullDisk, Fault::FolderGone, Fault::Crowd];

    /// Causes the fault; faults that end the daemon are handled by the caller.
    pub(super) fn inject(self, folder: &Path, http_address: Option<&str>, producer: &mut Producer) {
        match self {
            Fault::Kill | Fault::End => {}
            Fault::FullDisk => while_the_disk_is_full(folder, producer),
            Fault::FolderGone => {
                let [inside, away] = ["in", "away"].map(|name| folder.join(name));
                fs::rename(&inside, &away).expect("renamed");
                thread::sleep(Duration::from_millis(1500));
                fs::rename(away, inside).expect("renamed");
            }
            Fault::Crowd => http_address.into_iter().for_each(open_many_connections),
        }
    }
}

const CONFIG: &str = "soak.toml";

/// Settings with short waiting times.
pub(super) fn write_config(folder: &Path) {
    let text = "[daemon]\nsettle = \"100ms\"\n\
         disk_floor = \"0\"\nmemory = \"512MiB\"\nlisten = \"127.0.0.1:0\"\n\
         [[watch]]\ninput = \"in\"\noutput = \"out\"\npreset = \"paper\"\nvoxel_size = 0.05\n";
    fs::write(folder.join(CONFIG), text).expect("written");
}

fn while_the_disk_is_full(folder: &Path, producer: &mut Producer) {
    let path = folder.join("out/ballast");
    let mut filler = File::create(&path).expect("made");
    let piece = [1; 1 << 16];
    for size in [piece.len(), 1] {
        let error = (0..).find_map(|_| filler.write(&piece[..size]).err()).expect("the disk is not endless");
        assert_eq!(error.kind(), ErrorKind::StorageFull, "{error}");
    }
    for _ in 0..20 {
        producer.act();
        thread::sleep(Duration::from_millis(50));
    }
    fs::remove_file(path).expect("removed");
}

/// Twenty clients that request everything: half of them read the response, the others disconnect.
fn open_many_connections(address: &str) {
    for number in 0..20 {
        let path = ["/", "/metrics", "/events", "/api/frames"][number % 4];
        let Ok(mut stream) = TcpStream::connect(address) else { continue };
        let sent = write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        if sent.is_ok() && number < 10 {
            // Responses without an end, such as the event stream, are read for a moment.
            let _ = stream.set_read_timeout(Some(Duration::from_millis(100)));
            let _ = stream.read_to_end(&mut Vec::new());
        }
    }
}
