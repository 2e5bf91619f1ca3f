//! Every part of meniscus that reads bytes from outside: a function for each, which may return any result.
//!
//! ```text
//!   files      particles, meshes, level sets, pictures; checks before reading a file
//!   ours       the configuration and records: text that a user or a disk may have damaged
//!   http       the HTTP server: bytes from a socket
//! ```
//!
//! A target panics if a condition fails that must hold for any bytes. Two programs call the targets: the test
//! next to this file, and `long`, which uses libFuzzer to search for bytes that reach new code.

use std::cell::Cell;
use std::io::{self, Cursor, ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::path::Path;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use meniscus::http::{HttpServer, Listen};
use meniscus::pipeline::{FrameRecords, STATE_FOLDER};
use meniscus::watch::status_store::StatusStore;
use meniscus_formats::steps::find_steps;
use meniscus_formats::{
    ContainerFile, Format, Limits, OutputFormat, ParticleBatch, ParticleBatches, ParticleFrame, ProbedKind,
    ReadAt, Result, Values, abc, bgeo, completeness, compression, container, csv, gltf, hdf5, houdini,
    is_complete, json, lammps, looks_like_particles, npy, obj, pcd, ply, png, probe, prt, read_mesh,
    read_obstacle, read_particles, read_provenance, stl, to_glb, usda, usdc, vdb, vtk, write_abc_sequence,
    xdmf, xyz_ext,
};
use twox_hash::XxHash3_64;

/// A target: a part of meniscus that reads bytes.
pub(crate) struct Target {
    /// The name of the target, and of its folder in `corpus`.
    pub(crate) name: &'static str,
    /// The largest result that the bytes may have.
    pub(crate) content: Content,
    /// Runs the target with these bytes.
    pub(crate) run: fn(&[u8]),
}

/// The largest result of an input.
#[derive(Clone, Copy)]
pub(crate) enum Content {
    /// The result is at most as large as the input.
    Plain,
    /// The result is at most as large as the limits allow for the contents of a compressed file.
    Compressed,
    /// The result is the pixels of a picture: at most as many as its header states and its compressed bytes
    /// could contain.
    Picture,
}

/// All targets.
pub(crate) const TARGETS: &[Target] = &[
    plain("ply", |bytes| checked(ply::read(bytes, &limits()))),
    plain("ply_mesh", |bytes| drop(ply::read_mesh_and_vertices(bytes, &limits()))),
    compressed("bgeo", |bytes| checked(bgeo::read(bytes, &limits()))),
    plain("houdini_binary", |bytes| checked(houdini::read_binary(bytes, &limits()))),
    compressed("houdini_container", |bytes| checked(houdini::read_container(bytes, &limits()))),
    plain("delimited", |bytes| checked(csv::read(bytes, &limits()))),
    plain("npy", |bytes| checked(npy::read(bytes, &limits()))),
    compressed("npz", |bytes| checked(npy::read_archive(bytes, &limits()))),
    compressed("prt", |bytes| checked(prt::read(bytes, &limits()))),
    compressed("pcd", |bytes| checked(pcd::read(bytes, &limits()))),
    plain("json", |bytes| checked(json::read(bytes, &limits()))),
    compressed("hdf5", |bytes| container(bytes, bytes, hdf5::frames)),
    compressed("xdmf", |bytes| list(bytes, xdmf::frames)),
    compressed("vtk_index", vtk_index),
    plain("lammps", |bytes| steps(ProbedKind::Format(Format::LammpsDump), bytes, lammps::read)),
    plain("atoms", |bytes| steps(ProbedKind::Format(Format::XyzAtoms), bytes, xyz_ext::read)),
    plain("vtk_legacy", |bytes| checked(vtk::read_legacy(bytes, &limits()))),
    compressed("vtk_xml", |bytes| checked(vtk::read_xml(bytes, &limits()))),
    compressed("vtp_mesh", |bytes| drop(vtk::read_mesh(bytes, &limits()))),
    compressed("vdb_level_set", |bytes| drop(vdb::read_level_set(bytes, None, &limits()))),
    compressed("vdb_grids", vdb_grids),
    compressed("vdb_points", |bytes| checked(vdb::read_points(bytes, &limits()))),
    plain("gltf", gltf_parts),
    plain("gltf_frame", gltf_frame),
    plain("usda_head", |bytes| drop((usda::read_layer_info(bytes), usda::read_sampled_properties(bytes)))),
    compressed("usdc", usdc_frames),
    compressed("abc", alembic),
    compressed("usd", usd_stage),
    plain("stl", |bytes| drop(stl::read_mesh(bytes, &limits()))),
    plain("obj", |bytes| drop(obj::read_mesh(bytes))),
    Target { name: "png", content: Content::Picture, run: |bytes| drop(png::read(bytes)) },
    compressed("obstacle", |bytes| named(bytes, obstacle)),
    compressed("compression", |bytes| drop(compression::decompressed(bytes, &limits()))),
    compressed("particles", |bytes| named(bytes, particles)),
    plain("batches", |bytes| named(bytes, batches)),
    plain("integrity", integrity),
    plain("config", config),
    plain("records", records),
    plain("http", http),
];

const fn plain(name: &'static str, run: fn(&[u8])) -> Target {
    Target { name, content: Content::Plain, run }
}

const fn compressed(name: &'static str, run: fn(&[u8])) -> Target {
    Target { name, content: Content::Compressed, run }
}

/// The limits of the program.
fn limits() -> Limits {
    Limits::default()
}

/// Checks that the arrays of a frame have the stated lengths.
fn checked(frame: Result<ParticleFrame>) {
    let Ok(frame) = frame else { return };
    for attribute in &frame.attributes {
        let length = match &attribute.values {
            Values::F32(values) => values.len(),
            Values::F64(values) => values.len(),
            Values::U8(values) => values.len(),
            Values::I32(values) => values.len(),
            Values::I64(values) => values.len(),
            Values::Strings { indices, .. } => indices.len(),
        };
        assert_eq!(length, attribute.arity * frame.positions.len(), "values of {}", attribute.name);
    }
}

/// File names, for formats that the content does not determine. The first byte of the input chooses one.
const NAMES: [&str; 15] = [
    "f",
    "f.ply",
    "f.bgeo",
    "f.csv",
    "f.txt",
    "f.xyz",
    "f.dump",
    "f.vtk",
    "f.vtu",
    "f.npz",
    "f.obj",
    "f.gltf",
    "f.gz",
    "f.xyz.gz",
    "f.csv.zst",
];

fn named(bytes: &[u8], run: fn(&[u8], &str)) {
    if let [choice, bytes @ ..] = bytes {
        run(bytes, NAMES[usize::from(*choice) % NAMES.len()]);
    }
}

fn particles(bytes: &[u8], name: &str) {
    let _ = probe(bytes, name).to_string();
    let _ = looks_like_particles(bytes, name);
    checked(read_particles(bytes, name, &limits()));
}

/// Checks that batches contain the same particles as the whole file.
fn batches(bytes: &[u8], name: &str) {
    let Ok(Some(batches)) = ParticleBatches::open(bytes, name, &limits(), 256) else { return };
    let mut batch = ParticleBatch::default();
    let mut count = 0;
    for index in 0..batches.batch_count() {
        batches.read_batch(index, &mut batch).expect("a batch of a file that has not changed");
        let frame = batches.read_frame(index).expect("a batch of a file that has not changed");
        assert_eq!(batch.positions.len(), batches.particle_range(index).len());
        assert_eq!(batch.positions.len(), frame.positions.len());
        count += batch.positions.len();
    }
    assert_eq!(count, batches.particle_count());
    if let Ok(frame) = read_particles(bytes, name, &limits()) {
        assert_eq!(count, frame.positions.len());
    }
}

fn obstacle(bytes: &[u8], name: &str) {
    let _ = read_obstacle(bytes, name, &limits(), &|_| Ok(vec![7; 96]));
}

/// Reads a file that may have several steps: as a whole, and each step alone.
fn steps(kind: ProbedKind, bytes: &[u8], read: fn(&[u8], &Limits) -> Result<ParticleFrame>) {
    checked(read(bytes, &limits()));
    // Reading bytes never fails, but the limits may allow fewer steps than the file has.
    for step in find_steps(kind, bytes, &limits()).unwrap_or_default() {
        let range =
            [step.range.start, step.range.end].map(|at| usize::try_from(at).expect("within the bytes"));
        checked(read(&bytes[range[0]..range[1]], &limits()));
    }
}

type FindFrames = fn(&ContainerFile, &Limits) -> Result<container::ContainerFrames>;

/// Reads the first frames of a container. The first files that each names have the bytes `further`; the memory
/// for these counts once.
fn container(bytes: &[u8], further: &[u8], frames: FindFrames) {
    const OPENED_MAX: usize = 2;
    let opened = Cell::new(0);
    let open = |_: &str| {
        opened.set(opened.get() + 1);
        let is_there = opened.get() <= OPENED_MAX;
        is_there
            .then(|| Box::new(Arc::<[u8]>::from(further)) as Box<dyn ReadAt>)
            .ok_or(ErrorKind::NotFound.into())
    };
    let file = ContainerFile { file: &bytes, name: "f", open: &open };
    let Ok(found) = frames(&file, &limits()) else { return };
    for index in 0..found.samples.len().clamp(1, 3) {
        opened.set(0);
        checked(found.read(&file, index, &limits()));
    }
}

/// Reads the first frames of a text that names files. These have the bytes after the first zero byte, if any.
fn list(bytes: &[u8], frames: FindFrames) {
    let end = bytes.iter().position(|&byte| byte == 0);
    let (text, further) = end.map_or((bytes, bytes), |end| (&bytes[..end], &bytes[end + 1..]));
    container(text, further, frames);
}

fn vtk_index(bytes: &[u8]) {
    const KIND: ProbedKind = ProbedKind::Format(Format::VtkIndex);
    list(bytes, |file, limits| container::frames(KIND, file, limits));
}

fn vdb_grids(bytes: &[u8]) {
    let _ = vdb::grids(bytes, &limits());
    let _ = vdb::read_vectors(bytes, &["velocity", "v"], &limits());
}

fn gltf_parts(bytes: &[u8]) {
    let _ = gltf::external_files(bytes);
    let _ = gltf::read_mesh_with_external(bytes, &limits(), &|_| Ok(vec![7; 96]));
    let _ = gltf::read_attributes(bytes, &limits());
    let _ = gltf::read_camera(bytes);
}

/// Reads the first two meshes and frames of particles of an archive, and the information that needs no mesh.
fn alembic(bytes: &[u8]) {
    let _ = (abc::read_mesh(bytes, &limits()), abc::read_times(bytes));
    let _ = abc::read_sequence_info(&mut Cursor::new(bytes));
    let _ = (abc::read_sample(bytes, 0, &limits()), abc::read_sample(bytes, 1, &limits()));
    let _ = to_glb(bytes, &limits());
    checked(abc::read_points(bytes, 0, &limits()));
    checked(abc::read_points(bytes, 1, &limits()));
}

/// Reads a frame of a sequence. For the .abc, its columns and triangles are read; for the .glb, its data is copied.
fn gltf_frame(bytes: &[u8]) {
    let Ok(file) = gltf::GlbFrame::read(&mut Cursor::new(bytes)) else { return };
    let frame = |code| gltf::SequenceFrame { name: "f".into(), code, file: file.clone() };
    let (shot, open) = ([frame(1), frame(3)], |_: usize| Ok(Cursor::new(bytes)));
    let _ = write_abc_sequence(&shot, None, 24.0, &[], open, &mut std::io::sink());
    let _ = gltf::write_sequence(&shot, 24.0, &[], open, &mut std::io::sink());
}

/// Reads the declarations and the frame of a file, and converts it.
fn usdc_frames(bytes: &[u8]) {
    let _ = usdc::read_sampled_properties(&mut Cursor::new(bytes), &limits());
    let _ = to_glb(bytes, &limits());
    let Ok(layer) = usdc::UsdcLayer::read(bytes, &limits()) else { return };
    let _ = layer.frame();
}

/// Reads the particles and the meshes of a stage.
fn usd_stage(bytes: &[u8]) {
    checked(read_particles(bytes, "f", &limits()));
    let _ = read_mesh(bytes, "f", &limits(), &|_| Ok(bytes.to_vec()));
}

/// Checks that do not read the whole file, for every format and every name.
fn integrity(bytes: &[u8]) {
    for format in OutputFormat::ALL {
        let _ = is_complete(format, &mut Cursor::new(bytes));
        let _ = read_provenance(format, bytes);
    }
    for name in NAMES {
        let _ = completeness(&mut Cursor::new(bytes), name);
    }
}

fn config(bytes: &[u8]) {
    if let Ok(text) = str::from_utf8(bytes) {
        let _ = meniscus::cli::check_config(text);
    }
}

/// Checks that another record keeps those in a file of these bytes. A second pass corrects the checksums first,
/// because random bytes never have correct checksums.
fn records(bytes: &[u8]) {
    let lines = bytes.split_inclusive(|&byte| byte == b'\n');
    let with_checksums: Vec<u8> = lines.flat_map(with_checksum).collect();
    for bytes in [bytes, &with_checksums] {
        let folder = tempfile::tempdir().expect("a folder");
        let open = || FrameRecords::open(folder.path()).expect("opened");
        let record = |records: &FrameRecords| {
            records.add_failure(Path::new("\u{1}"), Path::new("/in"), "why").expect("recorded");
        };
        record(&open());
        // An earlier process has left the file, and the next one continues it.
        let files = std::fs::read_dir(folder.path().join(STATE_FOLDER)).expect("read");
        let mut files = files.map(|file| file.expect("an entry").path());
        let file = files.find(|path| path.extension().is_none()).expect("a file of records");
        std::fs::write(file, bytes).expect("written");
        let before = open();
        record(&before);
        let after = open();
        assert!(before.done().keys().eq(after.done().keys()));
        assert!(before.never_done().keys().eq(after.never_done().keys()));
        assert_eq!(before.latest().sequences, after.latest().sequences);
    }
}

/// Replaces a missing or wrong checksum of a line by the correct one.
fn with_checksum(line: &[u8]) -> Vec<u8> {
    match line.iter().position(|&byte| byte == b'{') {
        None => line.to_vec(),
        Some(at) => {
            let record = &line[at..];
            let text = record.strip_suffix(b"\n").unwrap_or(record);
            [format!("{:016x} ", XxHash3_64::oneshot(text)).as_bytes(), record].concat()
        }
    }
}

/// Sends bytes to the HTTP server and reads the response. The next request must succeed.
fn http(bytes: &[u8]) {
    static SERVER: OnceLock<HttpServer> = OnceLock::new();
    let server = SERVER.get_or_init(|| {
        let address = "127.0.0.1:0".parse().expect("an address");
        HttpServer::open(&Listen { address, token: None }, Arc::new(StatusStore::new())).expect("a server")
    });
    let mut stream = connect(server.address());
    // Writing fails if the server has refused the request already, and does not read the rest.
    let _ = stream.write_all(bytes);
    let _ = stream.shutdown(Shutdown::Write);
    // Any response and a reset are valid.
    let _ = await_end(stream);
    let mut stream = connect(server.address());
    stream.write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").expect("sent");
    let (health, end) = await_end(stream);
    assert!(health.starts_with(b"HTTP/1.1 200 "), "{end:?} after \"{}\"", health.escape_ascii());
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).expect("a connection");
    stream.set_read_timeout(Some(RESPONSE_TIMEOUT)).expect("a timeout");
    stream
}

/// Longer than the server waits for the rest of a request.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(60);

/// Reads until the server closes the connection. Returns the response, and whether the connection was reset:
/// a reset is possible if the client sent more than the server read. Event streams have no end, so only their
/// beginning is read.
fn await_end(mut stream: TcpStream) -> (Vec<u8>, io::Result<()>) {
    let (mut answer, mut piece) = (Vec::new(), [0; 4096]);
    loop {
        match stream.read(&mut piece) {
            Ok(0) => return (answer, Ok(())),
            Ok(count) => answer.extend(&piece[..count]),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                panic!("the server did not end its response: {}", answer.escape_ascii())
            }
            // A signal of the fuzzer's own timer interrupted the call.
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(error) => return (answer, Err(error)),
        }
        if answer.windows(EVENTS.len()).any(|part| part == EVENTS) {
            return (answer, Ok(()));
        }
    }
}

/// Part of the header of a response without an end.
const EVENTS: &[u8] = b"text/event-stream";
