//! The HTTP server, tested with plain sockets: contents, access, and misbehaving clients.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use serde_json::Value;

use super::scene::{Scene, WINDOW, Watching, await_that, moving, ply, timeout};

/// A response: its status, its headers in lower case, and its body.
pub(crate) struct Answer {
    status: u16,
    headers: String,
    content: Vec<u8>,
}

impl Answer {
    fn text(&self) -> String {
        String::from_utf8_lossy(&self.content).into_owned()
    }

    #[track_caller]
    pub(crate) fn json(&self) -> Value {
        serde_json::from_slice(&self.content).unwrap_or_else(|error| panic!("{error}: {}", self.text()))
    }
}

/// Starts the daemon with an HTTP server at a free port, and returns its address.
fn watch(scene: &Scene, arguments: &[&str]) -> (Watching, String) {
    let watching = scene.watch(&[&WINDOW[..], arguments].concat());
    let address = watching.window_address();
    (watching, address)
}

fn connect(address: &str) -> TcpStream {
    let stream = TcpStream::connect(address).expect("a connection");
    stream.set_read_timeout(Some(timeout())).expect("a timeout");
    stream
}

/// Sends these bytes, and reads the response until the server closes the connection.
fn exchange(address: &str, bytes: &[u8]) -> Answer {
    let mut stream = connect(address);
    // Writing fails if the server has refused the request already, and does not read the rest.
    let _ = stream.write_all(bytes);
    let mut all = Vec::new();
    // The server may reset the connection if the client sent more than the server read.
    let _ = stream.read_to_end(&mut all);
    let end = all.windows(4).position(|four| four == b"\r\n\r\n").unwrap_or(all.len());
    let headers = String::from_utf8_lossy(&all[..end]).to_lowercase();
    let status = headers.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
    Answer { status, headers, content: all.get(end + 4..).unwrap_or_default().to_vec() }
}

/// Requests a path, with these header lines in addition to the required ones.
fn send_request(address: &str, path: &str, lines: &str) -> Answer {
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n{lines}\r\n");
    exchange(address, request.as_bytes())
}

pub(crate) fn get(address: &str, path: &str) -> Answer {
    send_request(address, path, "")
}

/// A subscription to the event stream.
struct Following(BufReader<TcpStream>);

impl Following {
    fn new(address: &str, query: &str) -> Following {
        let mut stream = connect(address);
        write!(stream, "GET /events{query} HTTP/1.1\r\nHost: {address}\r\n\r\n").expect("sent");
        Following(BufReader::new(stream))
    }

    /// Subscribes, and returns when the subscription is active: it receives every later event.
    fn from_now(address: &str) -> Following {
        let mut following = Following::new(address, "");
        assert_eq!(following.next().1, "hello");
        following
    }

    /// The next event: its id, type and data.
    fn next(&mut self) -> (String, String, Value) {
        let (mut id, mut kind) = (String::new(), String::new());
        let start = Instant::now();
        loop {
            let mut line = String::new();
            // Comments keep the connection alive between events.
            assert!(start.elapsed() < timeout(), "no event within {:?}", timeout());
            assert!(self.0.read_line(&mut line).expect("a line") > 0, "the events have ended");
            let field = |name: &str| line.strip_prefix(name).map(|value| value.trim().to_owned());
            id = field("id: ").unwrap_or(id);
            kind = field("event: ").unwrap_or(kind);
            if let Some(data) = field("data: ") {
                return (id, kind, serde_json::from_str(&data).expect("JSON"));
            }
        }
    }

    /// Reads until this number of frames has reached this state; returns the id of the last event.
    fn await_state(&mut self, state: &str, count: usize) -> String {
        let mut names = std::collections::BTreeSet::new();
        loop {
            let (id, _, data) = self.next();
            for frame in data["frames"].as_array().into_iter().flatten() {
                if frame["state"] == state {
                    names.insert(frame["name"].to_string());
                }
            }
            if count <= names.len() {
                return id;
            }
        }
    }
}

#[test]
fn frames_appear_while_a_producer_writes() {
    let scene = Scene::new();
    let (watching, address) = watch(&scene, &[]);
    let mut following = Following::from_now(&address);
    scene.put_moving(1..=4);
    following.await_state("done", 4);
    let page = get(&address, "/api/frames?limit=3").json();
    let names = |page: &Value| {
        let frames = page["frames"].as_array().expect("frames").iter();
        frames.map(|frame| frame["name"].as_str().expect("a name").to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(names(&page), ["dam.1.ply", "dam.2.ply", "dam.3.ply"]);
    assert_eq!((&page["total"], &page["next"]), (&4.into(), &"dam.3.ply".into()));
    let rest = get(&address, "/api/frames?after=dam.3.ply").json();
    assert_eq!((names(&rest), &rest["next"]), (vec!["dam.4.ply".to_owned()], &Value::Null));
    let frame = get(&address, "/api/frames/dam.2.ply").json();
    assert_eq!((&frame["state"], &frame["particles"]), (&"done".into(), &216.into()));
    assert_eq!(frame["figures"]["certificate"]["holds"], true);
    assert!(frame["figures"]["seconds"]["smooth"].as_f64().is_some_and(|seconds| seconds > 0.0));
    assert_eq!(frame["outputs"][0]["name"], "dam.2.glb");
    assert_eq!(get(&address, "/files/dam.2.glb").content, scene.bytes("out/dam.2.glb"));
    let settings = get(&address, "/api/settings").json();
    let sequence = &settings["sequences"][0];
    assert_eq!(sequence["sequence"], "dam.{}.ply");
    // The default voxel size is 0.32 spacings.
    let [spacing, voxel_size] =
        ["spacing", "voxel_size"].map(|key| sequence[key].as_f64().expect("a number"));
    assert!((0.32 * spacing / voxel_size - 1.0).abs() < 1e-9, "{spacing} {voxel_size}");
    assert!(sequence["measured_on"].as_str().is_some_and(|path| path.ends_with("dam.1.ply")));
    assert!(get(&address, "/metrics").text().contains("\nmeniscus_frames_converted_total 4\n"));
    assert_eq!(get(&address, "/api/status").json()["frames"]["done"], 4);
    let forecast = &get(&address, "/api/status").json()["forecast"];
    assert_eq!((&forecast["expected_count"], &forecast["seconds_left"]), (&4.into(), &Value::Null));
    assert_eq!([get(&address, "/healthz").status, get(&address, "/readyz").status], [200, 200]);
    watching.assert_no_complaints();
}

#[test]
fn figures_of_finished_frames_survive_a_restart_and_a_touch() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    let arguments = ["--preview", "png", "--preview-size", "64x48", "--settle", "10ms"];
    let (watching, address) = watch(&scene, &arguments);
    let figures = |address: &str| {
        let frame = get(address, "/api/frames/dam.1.ply").json();
        (frame["figures"].clone(), frame["seconds"].clone(), frame["particles"].clone())
    };
    watching.await_converted("dam.1.ply");
    await_that("it is shown", || figures(&address).0.is_object());
    let before = figures(&address);
    let seconds = |stage: &str| before.0["seconds"][stage].as_f64().expect("seconds");
    assert!(seconds("preview") > 0.0 && seconds("write") > 0.0, "{}", before.0);
    watching.await_converted("dam.2.ply");
    watching.finish();
    let (watching, address) = watch(&scene, &arguments);
    await_that("it is shown", || get(&address, "/api/frames").json()["total"] == 2);
    assert_eq!(figures(&address), before);
    scene.put_moving([1]);
    watching.await_line("it is found done", |line| line.is_found_done() && line.is_about("dam.1.ply"));
    await_that("it is done", || get(&address, "/api/frames/dam.1.ply").json()["state"] == "done");
    assert_eq!(figures(&address), before);
}

#[test]
fn failed_frame_has_its_error() {
    let scene = Scene::new();
    let (_watching, address) = watch(&scene, &[]);
    let mut following = Following::from_now(&address);
    scene.put("in/bad.1.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n");
    following.await_state("failed", 1);
    await_that("the reason is shown", || {
        let frame = get(&address, "/api/frames/bad.1.ply").json();
        frame["reason"].as_str().is_some_and(|reason| reason.contains("no properties x, y and z"))
    });
}

#[test]
fn frames_of_earlier_runs_are_shown_unless_removed() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    scene.once(&[]).assert_status(0);
    let (_watching, address) = watch(&scene, &[]);
    let frame = get(&address, "/api/frames/dam.1.ply").json();
    assert_eq!((&frame["state"], &frame["particles"]), (&"done".into(), &216.into()));
    assert_eq!(get(&address, "/files/dam.1.glb").content, scene.bytes("out/dam.1.glb"));
    scene.remove("in/dam.1.ply");
    await_that("the frame is gone", || get(&address, "/api/frames/dam.1.ply").status == 404);
    assert_eq!(get(&address, "/files/dam.1.glb").status, 404);
}

#[test]
fn client_that_reconnects_receives_the_events_it_missed() {
    let scene = Scene::new();
    let (_watching, address) = watch(&scene, &[]);
    scene.put_moving([1]);
    let id = Following::new(&address, "?after=0-0").next();
    assert_eq!(id.1, "resync", "an id of another run");
    await_that("the frame is done", || get(&address, "/api/status").json()["frames"]["done"] == 1);
    let at = get(&address, "/api/frames").json()["at"].as_str().expect("a place").to_owned();
    scene.put_moving([2]);
    await_that("the frame is done", || get(&address, "/api/status").json()["frames"]["done"] == 2);
    let mut following = Following::new(&address, &format!("?after={at}"));
    assert_eq!(following.next().1, "hello");
    following.await_state("done", 1);
}

#[test]
fn only_outputs_are_served_by_their_names() {
    let scene = Scene::new();
    scene.put_moving([1]);
    scene.write("secret", "the secret");
    scene.write("out/beside.glb", "the secret");
    let (watching, address) = watch(&scene, &[]);
    watching.await_converted("dam.1.ply");
    await_that("it is served", || get(&address, "/files/dam.1.glb").status == 200);
    let absolute = scene.path("secret").display().to_string();
    let encoded = absolute.replace('/', "%2f");
    for name in [
        "../secret",
        "..%2fsecret",
        "..%2Fsecret",
        "%2e%2e%2fsecret",
        "%2e%2e/secret",
        "..%252fsecret",
        "..%5csecret",
        "./dam.1.glb",
        "dam.1.glb/../../secret",
        "dam.1.glb%00.png",
        "%00",
        "dam.1.glb/",
        "beside.glb",
        ".meniscus/lock",
        "dam.1.ply",
        "%c0%ae%c0%ae/secret",
        "%",
        "",
        &absolute,
        &encoded,
    ] {
        let answer = get(&address, &format!("/files/{name}"));
        assert!(matches!(answer.status, 400 | 404), "{name}: {}", answer.status);
        assert!(!answer.text().contains("the secret"), "{name}");
        assert!(matches!(get(&address, &format!("/api/frames/{name}x")).status, 400 | 404), "{name}");
    }
    assert_eq!(get(&address, "/../secret").status, 404);
    // A link at the path of an output leads to a file that the server must not show.
    scene.remove("out/dam.1.glb");
    std::os::unix::fs::symlink(scene.path("secret"), scene.path("out/dam.1.glb")).expect("a link");
    assert_eq!(get(&address, "/files/dam.1.glb").status, 404);
    // No process writes into this pipe: opening it would block.
    scene.remove("out/dam.1.glb");
    rustix::fs::mkfifoat(rustix::fs::CWD, scene.path("out/dam.1.glb"), rustix::fs::Mode::RUSR)
        .expect("a pipe");
    assert_eq!(get(&address, "/files/dam.1.glb").status, 404);
}

#[test]
fn range_and_conditional_requests_are_answered() {
    let scene = Scene::new();
    scene.put_moving([1]);
    let (watching, address) = watch(&scene, &[]);
    watching.await_converted("dam.1.ply");
    await_that("it is served", || get(&address, "/files/dam.1.glb").status == 200);
    let whole = scene.bytes("out/dam.1.glb");
    let part = send_request(&address, "/files/dam.1.glb", "Range: bytes=4-11\r\n");
    assert_eq!((part.status, &part.content[..]), (206, &whole[4..12]));
    assert!(part.headers.contains(&format!("content-range: bytes 4-11/{}", whole.len())), "{}", part.headers);
    let beyond = send_request(&address, "/files/dam.1.glb", "Range: bytes=999999999-\r\n");
    assert_eq!(beyond.status, 416);
    let tag = part.headers.lines().find_map(|line| line.strip_prefix("etag: ")).expect("a tag").to_owned();
    let known = send_request(&address, "/files/dam.1.glb", &format!("If-None-Match: {tag}\r\n"));
    assert_eq!((known.status, known.content.len()), (304, 0));
    let head = format!("HEAD /files/dam.1.glb HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    let head = exchange(&address, head.as_bytes());
    assert_eq!((head.status, head.content.len()), (200, 0));
    assert!(head.headers.contains(&format!("content-length: {}", whole.len())), "{}", head.headers);
}

#[test]
fn every_response_has_the_security_headers() {
    let scene = Scene::new();
    let (_watching, address) = watch(&scene, &[]);
    for path in ["/", "/page.js", "/api/frames", "/metrics", "/files/none", "/none"] {
        let headers = get(&address, path).headers;
        for header in [
            "x-frame-options: deny",
            "x-content-type-options: nosniff",
            "referrer-policy: no-referrer",
            "content-security-policy: default-src 'self'",
            "cache-control: ",
        ] {
            assert!(headers.contains(header), "{path} has no {header}:\n{headers}");
        }
    }
}

#[test]
fn other_hosts_and_other_methods_are_refused() {
    let scene = Scene::new();
    let (_watching, address) = watch(&scene, &[]);
    for (host, status) in
        [("localhost", 200), ("[::1]:1", 200), ("evil.example", 421), ("localhost.evil.example:80", 421)]
    {
        let request = format!("GET /api/frames HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n");
        assert_eq!(exchange(&address, request.as_bytes()).status, status, "{host}");
    }
    assert_eq!(exchange(&address, b"GET /api/frames HTTP/1.0\r\n\r\n").status, 421);
    for method in ["POST", "PUT", "DELETE", "OPTIONS", "TRACE", "PATCH"] {
        let request =
            format!("{method} /api/frames HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        assert_eq!(exchange(&address, request.as_bytes()).status, 405, "{method}");
    }
}

#[test]
fn oversized_and_malformed_requests_are_refused() {
    let scene = Scene::new();
    let (_watching, address) = watch(&scene, &[]);
    let long = "x".repeat(40 << 10);
    assert_eq!(send_request(&address, "/", &format!("X: {long}\r\n")).status, 431);
    assert_eq!(send_request(&address, "/", &"X: y\r\n".repeat(200)).status, 431);
    assert!(matches!(get(&address, &format!("/{long}")).status, 414 | 431));
    assert_eq!(send_request(&address, "/", "Content-Length: 5\r\n").status, 413);
    assert_eq!(send_request(&address, "/", "Transfer-Encoding: chunked\r\n").status, 413);
    for garbage in
        [&b"\0\x01\x02\r\n\r\n"[..], b"GET\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"]
    {
        let mut stream = connect(&address);
        stream.write_all(garbage).expect("sent");
        stream.shutdown(std::net::Shutdown::Write).expect("ended");
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        assert!(!answer.starts_with(b"HTTP/1.1 2"), "{garbage:?}");
    }
    assert_eq!(get(&address, "/healthz").status, 200);
}

#[test]
fn unfinished_requests_time_out_and_do_not_block_others() {
    let scene = Scene::new();
    let (watching, address) = watch(&scene, &[]);
    let slow: Vec<TcpStream> = (0..50)
        .map(|_| {
            let mut stream = connect(&address);
            write!(stream, "GET / HTTP/1.1\r\nHost: {address}\r\nX: ").expect("sent");
            stream
        })
        .collect();
    scene.put_moving([1]);
    watching.await_converted("dam.1.ply");
    assert_eq!(get(&address, "/api/frames").status, 200);
    for mut stream in slow {
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        assert!(!answer.starts_with(b"HTTP/1.1 2"));
    }
}

#[test]
fn slow_requests_do_not_block_others() {
    let scene = Scene::new();
    let (watching, address) = watch(&scene, &[]);
    let mut slow: Vec<TcpStream> = (0..300).map(|_| connect(&address)).collect();
    let done = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut letters = b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ".iter().chain([b'x'; 4096].iter());
            while let Some(letter) = letters.next().filter(|_| !done.load(Ordering::Relaxed)) {
                for stream in &mut slow {
                    // By now the server has disconnected some of them.
                    let _ = stream.write_all(&[*letter]);
                }
                thread::sleep(Duration::from_millis(20));
            }
        });
        scene.put_moving(1..=4);
        for number in 1..=4 {
            watching.await_converted(&format!("dam.{number}.ply"));
        }
        assert_eq!(get(&address, "/api/frames").status, 200);
        done.store(true, Ordering::Relaxed);
    });
    drop(slow);
    watching.assert_no_complaints();
    scene.assert_as_converted(&[]);
}

#[test]
fn other_protocols_and_smuggled_requests_are_refused() {
    let scene = Scene::new();
    scene.write("secret", "the secret");
    let (watching, address) = watch(&scene, &[]);
    scene.put_moving(1..=2);
    let host = format!("Host: {address}\r\n");
    let second = format!("GET /api/settings HTTP/1.1\r\n{host}\r\n");
    let upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\
                   Sec-WebSocket-Version: 13\r\n";
    let answered = exchange(&address, format!("GET /api/nothing HTTP/1.1\r\n{host}{upgrade}\r\n").as_bytes());
    assert_eq!(answered.status, 404, "an upgrade does not change that");
    for (what, request) in [
        ("HTTP/2", "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0".to_owned()),
        (
            "two lengths",
            format!("GET / HTTP/1.1\r\n{host}Content-Length: 0\r\nContent-Length: 9\r\n\r\n{second}"),
        ),
        (
            "a length and chunks",
            format!(
                "GET / HTTP/1.1\r\n{host}Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n{second}"
            ),
        ),
        ("chunks", format!("GET / HTTP/1.1\r\n{host}Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n{second}")),
        (
            "chunks in disguise",
            format!(
                "GET / HTTP/1.1\r\n{host}Transfer-Encoding: xchunked\r\nContent-Length: 4\r\n\r\nGET {second}"
            ),
        ),
        ("a body", format!("GET / HTTP/1.1\r\n{host}Content-Length: {}\r\n\r\n{second}", second.len())),
        ("two hosts", format!("GET / HTTP/1.1\r\n{host}Host: evil.example\r\n\r\n")),
        ("a tunnel", format!("CONNECT 127.0.0.1:22 HTTP/1.1\r\n{host}\r\n")),
        ("another's address", format!("GET http://evil.example/api/frames HTTP/1.1\r\n{host}\r\n")),
        ("a line within a line", format!("GET /\r\n/api/frames HTTP/1.1\r\n{host}\r\n")),
    ] {
        let answer = exchange(&address, request.as_bytes());
        assert!(!(200..400).contains(&answer.status), "{what}: {}", answer.headers);
        let text = answer.text();
        // The server does not treat the bytes after a refused request as another request.
        assert!(!text.contains("HTTP/1.1 200") && !text.contains("sequences"), "{what}: {text}");
    }
    for number in 1..=2 {
        watching.await_converted(&format!("dam.{number}.ply"));
    }
    assert_eq!(get(&address, "/healthz").status, 200);
    watching.assert_no_complaints();
    scene.assert_as_converted(&[]);
}

#[test]
fn clients_that_never_read_do_not_block_others() {
    let scene = Scene::new();
    scene.put_moving([1]);
    let (watching, address) = watch(&scene, &[]);
    watching.await_converted("dam.1.ply");
    await_that("it is served", || get(&address, "/files/dam.1.glb").status == 200);
    let unread: Vec<TcpStream> = (0..80)
        .map(|number| {
            let mut stream = connect(&address);
            let path = ["/files/dam.1.glb", "/events?after=0-0", "/vendor/three.core.min.js"][number % 3];
            let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n");
            // Requests without a pause: the responses soon fill the socket buffers, because the client is
            // slow.
            stream.write_all(request.repeat(20).as_bytes()).expect("sent");
            stream
        })
        .collect();
    scene.put_moving(2..=8);
    for number in 2..=8 {
        watching.await_converted(&format!("dam.{number}.ply"));
    }
    assert_eq!(get(&address, "/files/dam.1.glb").content, scene.bytes("out/dam.1.glb"));
    drop(unread);
    watching.assert_no_complaints();
    scene.assert_as_converted(&[]);
}

#[test]
fn idle_connections_beyond_the_limit_block_others_only_until_they_time_out() {
    let scene = Scene::new();
    let (watching, address) = watch(&scene, &[]);
    let mut following: Vec<Following> = (0..200).map(|_| Following::from_now(&address)).collect();
    // Half of the clients send nothing, and the others send half a request.
    let idle: Vec<TcpStream> = (0..400)
        .map(|number| {
            let mut stream = connect(&address);
            if number % 2 == 1 {
                let _ = write!(stream, "GET / HTTP/1.1\r\nHost: {address}\r\n");
            }
            stream
        })
        .collect();
    for path in ["/healthz", "/readyz", "/api/frames"] {
        assert_eq!(get(&address, path).status, 200, "{path}");
    }
    // Connections with a response in progress are still served.
    scene.put_moving(1..=2);
    for follower in &mut following {
        follower.await_state("done", 2);
    }
    drop(idle);
    watching.assert_no_complaints();
}

#[test]
fn fifty_subscribers_receive_all_events_beside_twenty_that_never_read() {
    let scene = Scene::new();
    let (watching, address) = watch(&scene, &[]);
    let unread: Vec<Following> = (0..20).map(|_| Following::new(&address, "")).collect();
    let following: Vec<_> = (0..50)
        .map(|_| {
            let mut following = Following::from_now(&address);
            thread::spawn(move || following.await_state("done", 6))
        })
        .collect();
    scene.put_moving(1..=6);
    for thread in following {
        thread.join().expect("no panic");
    }
    drop(unread);
    watching.assert_no_complaints();
    scene.assert_as_converted(&[]);
}

#[test]
fn requests_without_the_token_are_refused() {
    let scene = Scene::new();
    scene.write("token", "0123456789abcdef\n");
    let (_watching, address) = watch(&scene, &["--token-file", "token"]);
    for path in ["/", "/api/frames", "/events", "/metrics", "/files/x", "/?token=0123456789abcdee"] {
        assert_eq!(get(&address, path).status, 401, "{path}");
    }
    assert_eq!(get(&address, "/healthz").status, 200);
    let bearer = "Authorization: Bearer 0123456789abcdef\r\n";
    assert_eq!(send_request(&address, "/api/frames", bearer).status, 200);
    let opened = get(&address, "/?token=0123456789abcdef");
    assert_eq!(opened.status, 303);
    let cookie = opened.headers.lines().find_map(|line| line.strip_prefix("set-cookie: ")).expect("a cookie");
    assert!(cookie.contains("httponly") && cookie.contains("samesite=strict"), "{cookie}");
    let port = address.rsplit(':').next().expect("a port");
    assert!(cookie.starts_with(&format!("meniscus_token_{port}=")), "{cookie}");
    let (cookie, _) = cookie.split_once(';').expect("what follows");
    assert_eq!(send_request(&address, "/api/frames", &format!("Cookie: {cookie}\r\n")).status, 200);
}

#[test]
fn address_in_use_is_an_error() {
    let scene = Scene::new();
    let (_watching, address) = watch(&scene, &[]);
    let refused = |arguments: &[&str], words: &str| {
        let result = scene.run(&[&["watch", "elsewhere", "--out", "other"], arguments].concat());
        assert_eq!(result.status, Some(2), "{}", result.err);
        assert!(result.err.contains(words), "{}", result.err);
    };
    refused(&["--listen", &address], &format!("cannot listen on {address}"));
    refused(&["--listen", "0.0.0.0:0"], "--token-file");
    refused(&["--listen", "[::]:0"], "--token-file");
    refused(&["--listen", "7700"], "not an address with a port");
    scene.write("token", "short\n");
    refused(&["--listen", "127.0.0.1:0", "--token-file", "token"], "16 to 256");
    scene.write("token", "0123456789abcdef\n");
    refused(&["--token-file", "token"], "--listen");
}

#[test]
fn server_ends_with_the_daemon() {
    let scene = Scene::new();
    let (mut watching, address) = watch(&scene, &[]);
    let mut following = Following::from_now(&address);
    watching.signal(Signal::TERM);
    let mut rest = Vec::new();
    let _ = following.0.read_to_end(&mut rest);
    // The page shows that it has stopped, instead of a lost connection.
    assert!(
        String::from_utf8_lossy(&rest).contains("\"stopping\":true"),
        "{}",
        String::from_utf8_lossy(&rest)
    );
    await_that("the daemon ends", || !watching.is_alive());
    assert!(TcpStream::connect(&address).is_err());
    assert!(fs::metadata(scene.path("out")).is_ok_and(|out| out.is_dir()));
}

#[test]
fn several_watched_folders_are_numbered() {
    let scene = Scene::new();
    for folder in ["a", "b"] {
        scene.write(&format!("{folder}/dam.1.ply"), ply(&moving(1)));
    }
    scene.write(
        "two.toml",
        "[daemon]\nlisten = \"127.0.0.1:0\"\n[[watch]]\ninput = \"a\"\noutput = \"x\"\n[[watch]]\ninput = \"b\"\noutput = \"y\"\n",
    );
    let watching = scene.start_as(&["watch", "--config", "two.toml", "--log", "json"]);
    let address = &*watching.window_address();
    await_that("both are done", || get(address, "/api/status").json()["frames"]["done"] == 2);
    for (number, folder) in [(1, "x"), (2, "y")] {
        assert_eq!(get(address, &format!("/api/frames/{number}/dam.1.ply")).status, 200);
        let served = get(address, &format!("/files/{number}/dam.1.glb")).content;
        assert_eq!(served, scene.bytes(&format!("{folder}/dam.1.glb")));
    }
}
