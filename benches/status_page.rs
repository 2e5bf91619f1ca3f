//! Measures how much HTTP clients slow down conversion: seconds per frame with 100 clients that subscribe to
//! events and 100 that each read a surface at 100 kB/s, compared with seconds per frame without clients.
//!
//! ```text
//!   one daemon   ── alone ── watched ─── alone ── watched ───▶ the same number of frames each time
//!   one thread   ────────── 200 clients ───────── 200 clients
//! ```
//!
//! The rounds alternate, so that both see the same state of the machine. The clients run on the same machine,
//! so their own cost is included. Exits with 1 if the median of the ratios exceeds the project's target.
//!
//! `cargo bench --bench status_page`

#![expect(clippy::print_stdout, reason = "a benchmark prints its results")]

mod block;

use std::fs;
use std::io::{self, BufRead, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, ChildStderr, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;
use tokio::net::{TcpSocket, TcpStream};
use tokio::runtime;
use tokio::sync::oneshot;
use tokio::time::{sleep, sleep_until};

use block::block_ply;

const FOLLOWER_COUNT: usize = 100;
const READER_COUNT: usize = 100;
const READER_BYTES_PER_S: u64 = 100_000;

const ROUND_COUNT: usize = 15;
const FRAME_COUNT: usize = 16;
/// Sizes of the blocks in the measured frames (25 000 particles), and of the block whose surface the slow
/// clients read. That surface is larger than the system's socket buffers.
const BLOCK: [usize; 3] = [50, 25, 20];
const LARGE_BLOCK: [usize; 3] = [160, 100, 100];

const RATIO_MAX: f64 = 1.05;

fn main() -> ExitCode {
    let folder = tempfile::tempdir().expect("a folder");
    for name in ["in", "staging"] {
        fs::create_dir(folder.path().join(name)).expect("made");
    }
    let mut daemon = Daemon::start(folder.path());
    // Not measured: create the file to read, and warm up.
    publish(folder.path(), "large.1.ply", &block_ply(LARGE_BLOCK, 0.0));
    daemon.await_converted(1);
    daemon.round(folder.path(), "warm");
    println!("{FOLLOWER_COUNT} follow, {READER_COUNT} read at {} kB/s", READER_BYTES_PER_S / 1000);
    println!(
        "  round   alone s/frame     watched   events/s   read MB/s   share of a core: server   clients"
    );
    let rounds: Vec<[f64; 2]> = (0..ROUND_COUNT)
        .map(|round| {
            let alone = daemon.round(folder.path(), &format!("alone{round}"));
            let clients = Clients::start(daemon.address);
            // Wait until all clients are connected and have the initial state.
            thread::sleep(Duration::from_secs(1));
            let (at_start, start) = (clients.counts(), Instant::now());
            let cpu_at_start = [daemon.http_cpu_s(), own_cpu_s()];
            let watched = daemon.round(folder.path(), &format!("seen{round}"));
            let seconds = start.elapsed().as_secs_f64();
            let [events, bytes] = clients.counts();
            println!(
                "{round:7}{alone:16.4}{watched:12.4}{:11.0}{:12.2}{:26.3}{:10.3}",
                (events - at_start[0]) as f64 / seconds,
                (bytes - at_start[1]) as f64 / seconds / 1e6,
                (daemon.http_cpu_s() - cpu_at_start[0]) / seconds,
                (own_cpu_s() - cpu_at_start[1]) / seconds,
            );
            [alone, watched]
        })
        .collect();
    let [alone, watched] = [0, 1].map(|which| median(rounds.iter().map(|round| round[which]).collect()));
    // Ratios of adjacent rounds, because the machine changes from one minute to the next.
    let ratio = median(rounds.iter().map(|[alone, watched]| watched / alone).collect());
    println!("medians: {alone:.4} s and {watched:.4} s per frame; ratio {ratio:.3}");
    if ratio < RATIO_MAX {
        return ExitCode::SUCCESS;
    }
    println!("the ratio is not under {RATIO_MAX}");
    ExitCode::FAILURE
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// A daemon process with an HTTP server, and its log.
struct Daemon {
    child: Child,
    log: BufReader<ChildStderr>,
    address: SocketAddr,
}

impl Daemon {
    fn start(folder: &Path) -> Daemon {
        let mut child = Command::new(env!("CARGO_BIN_EXE_meniscus"))
            .args([
                "watch",
                "in",
                "--out",
                "out",
                "--log",
                "json",
                "--preset",
                "paper",
                "--voxel-size",
                "0.05",
            ])
            .args(["--listen", "127.0.0.1:0"])
            .current_dir(folder)
            .env_remove("NOTIFY_SOCKET")
            .stdin(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the daemon starts");
        let log = BufReader::new(child.stderr.take().expect("a pipe"));
        let mut daemon = Daemon { child, log, address: SocketAddr::from(([127, 0, 0, 1], 0)) };
        let opened = daemon.await_line("serving the status page");
        let address =
            opened["address"].as_str().or(opened["fields"]["address"].as_str()).expect("an address");
        daemon.address =
            address.trim_start_matches("http://").trim_end_matches('/').parse().expect("an address");
        daemon
    }

    /// Lets frames arrive all at once. Returns the seconds per frame until they are converted.
    fn round(&mut self, folder: &Path, name: &str) -> f64 {
        for number in 0..FRAME_COUNT {
            let bytes = block_ply(BLOCK, 0.01 * number as f32);
            fs::write(folder.join(format!("staging/{name}.{number}.ply")), bytes).expect("written");
        }
        let start = Instant::now();
        for number in 0..FRAME_COUNT {
            let file = format!("{name}.{number}.ply");
            fs::rename(folder.join("staging").join(&file), folder.join("in").join(&file)).expect("renamed");
        }
        self.await_converted(FRAME_COUNT);
        start.elapsed().as_secs_f64() / FRAME_COUNT as f64
    }

    fn await_converted(&mut self, count: usize) {
        for _ in 0..count {
            self.await_line("converted");
        }
    }

    fn await_line(&mut self, message: &str) -> Value {
        loop {
            let mut line = String::new();
            let count = self.log.read_line(&mut line).expect("a log");
            assert!(count > 0, "the daemon has ended");
            let line: Value = serde_json::from_str(&line).expect("JSON");
            assert!(line["level"] != "ERROR", "{line}");
            if line["message"] == message {
                return line;
            }
        }
    }

    /// CPU time of the HTTP thread so far.
    fn http_cpu_s(&self) -> f64 {
        let tasks = fs::read_dir(format!("/proc/{}/task", self.child.id())).into_iter().flatten().flatten();
        tasks.filter_map(|task| cpu_s(&task.path().join("stat"), "http")).sum()
    }
}

/// CPU time of this program so far.
fn own_cpu_s() -> f64 {
    cpu_s(Path::new("/proc/self/stat"), "status_page").unwrap_or_default()
}

/// CPU time of a process or thread so far, if its name starts with `name`; `None` if the system does not
/// report it.
fn cpu_s(stat: &Path, name: &str) -> Option<f64> {
    let stat = fs::read_to_string(stat).ok()?;
    let (before, fields) = stat.rsplit_once(") ")?;
    before.split_once('(').filter(|(_, named)| named.starts_with(name))?;
    let ticks = |index: usize| fields.split(' ').nth(index)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) / TICKS_PER_SECOND)
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // It has no work left.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The clock ticks that Linux reports to programs, whatever its internal rate.
const TICKS_PER_SECOND: f64 = 100.0;

/// All clients, on one thread; dropping it disconnects them.
struct Clients {
    counts: Arc<[AtomicU64; 2]>,
    /// Dropping this sender ends the thread.
    _connected: oneshot::Sender<()>,
}

impl Clients {
    fn start(address: SocketAddr) -> Clients {
        let counts = Arc::new([const { AtomicU64::new(0) }; 2]);
        let (connected, closed) = oneshot::channel::<()>();
        let of_thread = Arc::clone(&counts);
        thread::spawn(move || {
            let runtime = runtime::Builder::new_current_thread().enable_io().enable_time().build();
            runtime.expect("a runtime").block_on(async move {
                for number in 0..FOLLOWER_COUNT + READER_COUNT {
                    tokio::spawn(run_client(address, number < FOLLOWER_COUNT, Arc::clone(&of_thread)));
                }
                // This channel carries no message.
                let _ = closed.await;
            });
        });
        Clients { counts, _connected: connected }
    }

    /// The number of events that subscribers received, and the number of bytes that readers read.
    fn counts(&self) -> [u64; 2] {
        [0, 1].map(|which| self.counts[which].load(Ordering::Relaxed))
    }
}

/// Subscribes to events or reads a file. Reconnects if the connection is refused, and after it ends.
async fn run_client(address: SocketAddr, follows: bool, counts: Arc<[AtomicU64; 2]>) {
    loop {
        let _ = if follows { follow(address, &counts[0]).await } else { read(address, &counts[1]).await };
        sleep(Duration::from_millis(100)).await;
    }
}

async fn follow(address: SocketAddr, counts: &AtomicU64) -> io::Result<()> {
    let stream = get(address, "/events").await?;
    let mut piece = vec![0; 64 << 10];
    while receive(&stream, &mut piece).await? > 0 {
        counts.fetch_add(1, Ordering::Relaxed);
    }
    Ok(())
}

/// Reads a file in parts, four times a second, to limit the bytes per second.
async fn read(address: SocketAddr, counts: &AtomicU64) -> io::Result<()> {
    const PARTS_PER_S: u32 = 4;
    let stream = get(address, "/files/large.1.glb").await?;
    let mut piece = vec![0; (READER_BYTES_PER_S / u64::from(PARTS_PER_S)) as usize];
    let mut next = tokio::time::Instant::now();
    loop {
        let count = receive(&stream, &mut piece).await?;
        if count == 0 {
            return Ok(());
        }
        counts.fetch_add(count as u64, Ordering::Relaxed);
        next += Duration::from_secs(1) / PARTS_PER_S;
        sleep_until(next).await;
    }
}

/// Opens a connection with a small receive buffer and sends a GET request.
async fn get(address: SocketAddr, path: &str) -> io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.set_recv_buffer_size(64 << 10)?;
    let stream = socket.connect(address).await?;
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.writable().await?;
    let sent = stream.try_write(request.as_bytes())?;
    assert_eq!(sent, request.len(), "a new connection accepts the whole request");
    Ok(stream)
}

/// Reads what has arrived, up to the size of the buffer; 0 at the end.
async fn receive(stream: &TcpStream, piece: &mut [u8]) -> io::Result<usize> {
    loop {
        stream.readable().await?;
        match stream.try_read(piece) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            other => return other,
        }
    }
}

fn publish(folder: &Path, name: &str, bytes: &[u8]) {
    fs::write(folder.join("staging").join(name), bytes).expect("written");
    fs::rename(folder.join("staging").join(name), folder.join("in").join(name)).expect("renamed");
}
