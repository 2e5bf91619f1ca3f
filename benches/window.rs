//! What it costs the frames that many look through the window: seconds per frame with 100 that follow the
//! changes and 100 that each read a surface at 100 kB/s, against seconds per frame with nobody there.
//!
//! ```text
//!   one daemon   ── alone ── looked at ── alone ── looked at ──▶ so many frames each time
//!   one thread   ────────── 200 clients ───────── 200 clients
//! ```
//!
//! The rounds take turns, so that both see the machine as it is in that minute. The clients run on the same machine, so
//! what they cost themselves is counted, too. Ends with 1 where the median of the ratios is not what the project promises.
//!
//! `cargo bench --bench window`

#![expect(clippy::print_stdout, reason = "it is what a benchmark is for")]

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
/// Blocks of 25 000 particles, and the one whose surface is read: larger than what systems keep for a slow reader.
const BLOCK: [usize; 3] = [50, 25, 20];
const LARGE_BLOCK: [usize; 3] = [160, 100, 100];

const RATIO_MAX: f64 = 1.05;

fn main() -> ExitCode {
    let folder = tempfile::tempdir().expect("a folder");
    for name in ["in", "beside"] {
        fs::create_dir(folder.path().join(name)).expect("made");
    }
    let mut daemon = Daemon::start(folder.path());
    // Unmeasured: what is read, and a round to warm up.
    land(folder.path(), "large.1.ply", &block_ply(LARGE_BLOCK, 0.0));
    daemon.await_converted(1);
    daemon.round(folder.path(), "warm");
    println!("{FOLLOWER_COUNT} follow, {READER_COUNT} read at {} kB/s", READER_BYTES_PER_S / 1000);
    println!(
        "  round   alone s/frame   looked at   events/s   read MB/s   share of a core: window   clients"
    );
    let rounds: Vec<[f64; 2]> = (0..ROUND_COUNT)
        .map(|round| {
            let alone = daemon.round(folder.path(), &format!("alone{round}"));
            let clients = Clients::start(daemon.address);
            // All are there, and have been told what there is.
            thread::sleep(Duration::from_secs(1));
            let (at_start, start) = (clients.told(), Instant::now());
            let cpu_at_start = [daemon.window_cpu_s(), own_cpu_s()];
            let looked_at = daemon.round(folder.path(), &format!("seen{round}"));
            let seconds = start.elapsed().as_secs_f64();
            let [events, bytes] = clients.told();
            println!(
                "{round:7}{alone:16.4}{looked_at:12.4}{:11.0}{:12.2}{:26.3}{:10.3}",
                (events - at_start[0]) as f64 / seconds,
                (bytes - at_start[1]) as f64 / seconds / 1e6,
                (daemon.window_cpu_s() - cpu_at_start[0]) / seconds,
                (own_cpu_s() - cpu_at_start[1]) / seconds,
            );
            [alone, looked_at]
        })
        .collect();
    let [alone, looked_at] = [0, 1].map(|which| median(rounds.iter().map(|round| round[which]).collect()));
    // Of two neighbours, for the machine changes from one minute to the next.
    let ratio = median(rounds.iter().map(|[alone, looked_at]| looked_at / alone).collect());
    println!("medians: {alone:.4} s and {looked_at:.4} s per frame; ratio {ratio:.3}");
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

/// A daemon with a window, and its log.
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
        let opened = daemon.await_line("the window is open");
        let address =
            opened["address"].as_str().or(opened["fields"]["address"].as_str()).expect("an address");
        daemon.address =
            address.trim_start_matches("http://").trim_end_matches('/').parse().expect("an address");
        daemon
    }

    /// Lets frames land all at once; the seconds until they are converted, for each.
    fn round(&mut self, folder: &Path, name: &str) -> f64 {
        for number in 0..FRAME_COUNT {
            let bytes = block_ply(BLOCK, 0.01 * number as f32);
            fs::write(folder.join(format!("beside/{name}.{number}.ply")), bytes).expect("written");
        }
        let start = Instant::now();
        for number in 0..FRAME_COUNT {
            let file = format!("{name}.{number}.ply");
            fs::rename(folder.join("beside").join(&file), folder.join("in").join(&file)).expect("renamed");
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

    /// What the thread of the window has computed until now.
    fn window_cpu_s(&self) -> f64 {
        let tasks = fs::read_dir(format!("/proc/{}/task", self.child.id())).into_iter().flatten().flatten();
        tasks.filter_map(|task| cpu_s(&task.path().join("stat"), "window")).sum()
    }
}

/// What this program has computed until now.
fn own_cpu_s() -> f64 {
    cpu_s(Path::new("/proc/self/stat"), "window").unwrap_or_default()
}

/// What a process or thread has computed until now, if its name begins so; nothing where the system does not tell.
fn cpu_s(stat: &Path, name: &str) -> Option<f64> {
    let stat = fs::read_to_string(stat).ok()?;
    let (before, fields) = stat.rsplit_once(") ")?;
    before.split_once('(').filter(|(_, named)| named.starts_with(name))?;
    let ticks = |index: usize| fields.split(' ').nth(index)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) / TICKS_PER_SECOND)
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // It has nothing left to do.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What Linux counts in for programs, whatever it counts in itself.
const TICKS_PER_SECOND: f64 = 100.0;

/// All who look, on one thread; they are gone when it is dropped.
struct Clients {
    told: Arc<[AtomicU64; 2]>,
    /// Ends the thread when it is dropped.
    _here: oneshot::Sender<()>,
}

impl Clients {
    fn start(address: SocketAddr) -> Clients {
        let told = Arc::new([const { AtomicU64::new(0) }; 2]);
        let (here, gone) = oneshot::channel::<()>();
        let of_thread = Arc::clone(&told);
        thread::spawn(move || {
            let runtime = runtime::Builder::new_current_thread().enable_io().enable_time().build();
            runtime.expect("a runtime").block_on(async move {
                for number in 0..FOLLOWER_COUNT + READER_COUNT {
                    tokio::spawn(look(address, number < FOLLOWER_COUNT, Arc::clone(&of_thread)));
                }
                // Nothing is ever sent.
                let _ = gone.await;
            });
        });
        Clients { told, _here: here }
    }

    /// How often a follower was told something, and how many bytes were read.
    fn told(&self) -> [u64; 2] {
        [0, 1].map(|which| self.told[which].load(Ordering::Relaxed))
    }
}

/// Follows or reads; whoever is refused, or has read all, comes again.
async fn look(address: SocketAddr, follows: bool, told: Arc<[AtomicU64; 2]>) {
    loop {
        let _ = if follows { follow(address, &told[0]).await } else { read(address, &told[1]).await };
        sleep(Duration::from_millis(100)).await;
    }
}

async fn follow(address: SocketAddr, told: &AtomicU64) -> io::Result<()> {
    let stream = asked(address, "/events").await?;
    let mut piece = vec![0; 64 << 10];
    while take(&stream, &mut piece).await? > 0 {
        told.fetch_add(1, Ordering::Relaxed);
    }
    Ok(())
}

/// Reads a file, four times a second a part of what may be read in a second.
async fn read(address: SocketAddr, told: &AtomicU64) -> io::Result<()> {
    const PARTS_PER_S: u32 = 4;
    let stream = asked(address, "/files/large.1.glb").await?;
    let mut piece = vec![0; (READER_BYTES_PER_S / u64::from(PARTS_PER_S)) as usize];
    let mut next = tokio::time::Instant::now();
    loop {
        let count = take(&stream, &mut piece).await?;
        if count == 0 {
            return Ok(());
        }
        told.fetch_add(count as u64, Ordering::Relaxed);
        next += Duration::from_secs(1) / PARTS_PER_S;
        sleep_until(next).await;
    }
}

/// A connection on which this was asked for; little is kept for it on this side.
async fn asked(address: SocketAddr, path: &str) -> io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.set_recv_buffer_size(64 << 10)?;
    let stream = socket.connect(address).await?;
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.writable().await?;
    let sent = stream.try_write(request.as_bytes())?;
    assert_eq!(sent, request.len(), "a new connection takes so much");
    Ok(stream)
}

/// What has come, as much as there is room for; 0 at the end.
async fn take(stream: &TcpStream, piece: &mut [u8]) -> io::Result<usize> {
    loop {
        stream.readable().await?;
        match stream.try_read(piece) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            other => return other,
        }
    }
}

fn land(folder: &Path, name: &str, bytes: &[u8]) {
    fs::write(folder.join("beside").join(name), bytes).expect("written");
    fs::rename(folder.join("beside").join(name), folder.join("in").join(name)).expect("renamed");
}
