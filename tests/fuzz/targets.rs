//! Everything of meniscus that takes bytes from others: one function for each, which may return what it likes.
//!
//! ```text
//!   files      particles, meshes, level sets, pictures; what is asked of a file before it is read
//!   ours       the configuration, the journal, the plan: text that somebody may have edited, or a disk damaged
//!   window     what comes in by a socket
//! ```
//!
//! A target panics where something does not hold that must hold for any bytes. Two programs call them: the test
//! beside this file, and `long`, where libFuzzer looks for bytes that reach what none has reached before.

use std::io::{self, Cursor, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use meniscus::http::{Listen, Window};
use meniscus::watch::journal::Journal;
use meniscus::watch::status_store::StatusStore;
use meniscus_formats::steps::find_steps;
use meniscus_formats::{
    Format, Limits, OutputFormat, ParticleBatch, ParticleBatches, ParticleFrame, ProbedKind, Result, Values,
    bgeo, completeness, compression, csv, gltf, houdini, is_whole, lammps, looks_like_particles, npy, obj,
    ply, png, probe, read_obstacle, read_particles, read_provenance, stl, usda, vdb, vtk, xyz, xyz_ext,
};
use twox_hash::XxHash3_64;

/// One of them.
pub(crate) struct Target {
    /// Also the name of its folder in `corpus`.
    pub(crate) name: &'static str,
    /// What may come out of its bytes.
    pub(crate) content: Content,
    /// Gives it these bytes.
    pub(crate) run: fn(&[u8]),
}

/// What may come out of bytes.
#[derive(Clone, Copy)]
pub(crate) enum Content {
    /// As much as they are.
    Plain,
    /// What the limits let out of a packed file.
    Packed,
    /// The pixels of a picture, as many as it says that there are and its packed bytes could stand for.
    Picture,
}

/// All of them.
pub(crate) const TARGETS: [Target; 33] = [
    plain("ply", |bytes| checked(ply::read(bytes, &limits()))),
    plain("ply_mesh", |bytes| drop(ply::read_mesh_and_vertices(bytes, &limits()))),
    packed("bgeo", |bytes| checked(bgeo::read(bytes, &limits()))),
    plain("bgeo_text", |bytes| checked(bgeo::read_text(bytes, &limits()))),
    plain("houdini_binary", |bytes| checked(houdini::read_binary(bytes, &limits()))),
    plain("houdini_text", |bytes| checked(houdini::read_text(bytes, &limits()))),
    packed("houdini_container", |bytes| checked(houdini::read_container(bytes, &limits()))),
    plain("delimited", |bytes| checked(csv::read(bytes, &limits()))),
    plain("xyz", |bytes| checked(xyz::read(bytes, &limits()))),
    plain("npy", |bytes| checked(npy::read(bytes, &limits()))),
    packed("npz", |bytes| checked(npy::read_archive(bytes, &limits()))),
    plain("lammps", |bytes| steps(ProbedKind::Format(Format::LammpsDump), bytes, lammps::read)),
    plain("atoms", |bytes| steps(ProbedKind::Format(Format::XyzAtoms), bytes, xyz_ext::read)),
    plain("vtk_legacy", |bytes| checked(vtk::read_legacy(bytes, &limits()))),
    packed("vtk_xml", |bytes| checked(vtk::read_xml(bytes, &limits()))),
    packed("vtp_mesh", |bytes| drop(vtk::read_mesh(bytes, &limits()))),
    packed("vdb_level_set", |bytes| drop(vdb::read_level_set(bytes, None, &limits()))),
    packed("vdb_grids", vdb_grids),
    plain("gltf", gltf_parts),
    plain("gltf_frame", gltf_frame),
    plain("usda_head", |bytes| drop(usda::read_layer_info(bytes))),
    plain("stl", |bytes| drop(stl::read_mesh(bytes, &limits()))),
    plain("obj", |bytes| drop(obj::read_mesh(bytes))),
    Target { name: "png", content: Content::Picture, run: |bytes| drop(png::read(bytes)) },
    packed("obstacle", |bytes| named(bytes, obstacle)),
    packed("packing", |bytes| drop(compression::unpacked(bytes, &limits()))),
    packed("particles", |bytes| named(bytes, particles)),
    plain("batches", |bytes| named(bytes, batches)),
    plain("ends", ends),
    plain("config", config),
    plain("journal", journal),
    plain("plan", |bytes| drop(meniscus::farm::parse(bytes))),
    plain("window", window),
];

const fn plain(name: &'static str, run: fn(&[u8])) -> Target {
    Target { name, content: Content::Plain, run }
}

const fn packed(name: &'static str, run: fn(&[u8])) -> Target {
    Target { name, content: Content::Packed, run }
}

/// Those that the program has.
fn limits() -> Limits {
    Limits::default()
}

/// What was read is as long as it says.
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

/// Names that a file may have, which decides where its bytes do not. The first byte of the input chooses.
const NAMES: [&str; 16] = [
    "f",
    "f.ply",
    "f.bgeo",
    "f.geo",
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

/// Batches have the particles that the whole file has, and the same.
fn batches(bytes: &[u8], name: &str) {
    let Ok(Some(batches)) = ParticleBatches::open(bytes, name, &limits(), 256) else { return };
    let mut batch = ParticleBatch::default();
    let mut count = 0;
    for index in 0..batches.batch_count() {
        batches.read_batch(index, &mut batch).expect("a batch of a file that has not changed");
        assert_eq!(batch.positions.len(), batches.particles_of(index).len());
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

/// A file that may have several steps: as a whole, and each of them alone.
fn steps(kind: ProbedKind, bytes: &[u8], read: fn(&[u8], &Limits) -> Result<ParticleFrame>) {
    checked(read(bytes, &limits()));
    // Bytes can always be read, but there may be more steps than the limits let in.
    for step in find_steps(kind, bytes, &limits()).unwrap_or_default() {
        let range =
            [step.range.start, step.range.end].map(|at| usize::try_from(at).expect("within the bytes"));
        checked(read(&bytes[range[0]..range[1]], &limits()));
    }
}

fn vdb_grids(bytes: &[u8]) {
    let _ = vdb::grids(bytes, &limits());
    let _ = vdb::read_vectors(bytes, &["velocity", "v"], &limits());
}

fn gltf_parts(bytes: &[u8]) {
    let _ = gltf::files_beside(bytes);
    let _ = gltf::read_mesh_with(bytes, &limits(), &|_| Ok(vec![7; 96]));
    let _ = gltf::read_attributes(bytes, &limits());
    let _ = gltf::read_camera(bytes);
}

/// A frame of a shot, twice in it: its columns and triangles are read for the .usda, its data copied for the .glb.
fn gltf_frame(bytes: &[u8]) {
    let Ok(file) = gltf::SequenceFrame::read(&mut Cursor::new(bytes)) else { return };
    let frame = |code| gltf::ShotFrame { name: "f".into(), code, file: file.clone() };
    let (shot, open) = ([frame(1), frame(3)], |_: usize| Ok(Cursor::new(bytes)));
    let _ = usda::write_sequence(&shot, (24.0, 1.0), &[], open, &mut std::io::sink());
    let _ = gltf::write_sequence(&shot, 24.0, &[], open, &mut std::io::sink());
}

/// What is asked of a file without reading all of it. The first byte says whose.
fn ends(bytes: &[u8]) {
    const FORMATS: [OutputFormat; 10] = [
        OutputFormat::Glb,
        OutputFormat::Gltf,
        OutputFormat::Obj,
        OutputFormat::Ply,
        OutputFormat::Vdb,
        OutputFormat::Png,
        OutputFormat::Exr,
        OutputFormat::Vtp,
        OutputFormat::Stl,
        OutputFormat::Usda,
    ];
    let [choice, bytes @ ..] = bytes else { return };
    let format = FORMATS[usize::from(*choice) % FORMATS.len()];
    let _ = is_whole(format, &mut Cursor::new(bytes));
    let _ = read_provenance(format, bytes);
    let _ = completeness(&mut Cursor::new(bytes), NAMES[usize::from(*choice) % NAMES.len()]);
}

fn config(bytes: &[u8]) {
    if let Ok(text) = str::from_utf8(bytes) {
        let _ = meniscus::cli::check_config(text);
    }
}

/// A journal as it is found: what it says stays when it is opened and written anew. Checksums are made right in
/// a second look, for no bytes that are found by chance have them.
fn journal(bytes: &[u8]) {
    let lines = bytes.split_inclusive(|&byte| byte == b'\n');
    let with_checksums: Vec<u8> = lines.flat_map(with_checksum).collect();
    for bytes in [bytes, &with_checksums] {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("journal"), bytes).expect("written");
        let Ok(before) = Journal::read(folder.path()) else { continue };
        drop(Journal::open(folder.path()).expect("opened"));
        let after = Journal::read(folder.path()).expect("read");
        assert_eq!(before.frames, after.frames);
        assert_eq!(before.sequences, after.sequences);
    }
}

/// A line that has no checksum, or another one, with its own.
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

/// Bytes that somebody sends to the window, who then listens; the next one is answered all the same.
fn window(bytes: &[u8]) {
    static WINDOW: OnceLock<(Window, Arc<StatusStore>)> = OnceLock::new();
    let (window, store) = WINDOW.get_or_init(|| {
        let address = "127.0.0.1:0".parse().expect("an address");
        let store = Arc::new(StatusStore::new());
        (Window::open(&Listen { address, token: None }, Arc::clone(&store)).expect("a window"), store)
    });
    store.pulse();
    let mut stream = connect(window.address());
    // A side that has refused already does not listen to the rest.
    let _ = stream.write_all(bytes);
    let _ = stream.shutdown(Shutdown::Write);
    // What it is answered with, and whether it is reset, is between the two.
    let _ = await_end(stream);
    let mut stream = connect(window.address());
    stream.write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").expect("sent");
    let (health, end) = await_end(stream);
    assert!(health.starts_with(b"HTTP/1.1 200 "), "{end:?} after \"{}\"", health.escape_ascii());
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).expect("a connection");
    stream.set_read_timeout(Some(WINDOW_PATIENCE)).expect("a timeout");
    stream
}

/// Longer than the window waits for the rest of a request.
const WINDOW_PATIENCE: Duration = Duration::from_secs(60);

/// All that comes until the other side ends it, and how it does; by a reset, perhaps, where it was sent more than it
/// read. Events have no end: of these, what comes first.
fn await_end(mut stream: TcpStream) -> (Vec<u8>, io::Result<()>) {
    let (mut answer, mut piece) = (Vec::new(), [0; 4096]);
    loop {
        match stream.read(&mut piece) {
            Ok(0) => return (answer, Ok(())),
            Ok(count) => answer.extend(&piece[..count]),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                panic!("the window did not end its answer: {}", answer.escape_ascii())
            }
            // The fuzzer's own clock.
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(error) => return (answer, Err(error)),
        }
        if answer.windows(EVENTS.len()).any(|part| part == EVENTS) {
            return (answer, Ok(()));
        }
    }
}

/// What the head of an answer without end says.
const EVENTS: &[u8] = b"text/event-stream";
