//! Runs every command in the README, the tutorials and other pages exactly as written, in a folder with the
//! files that it names.
//!
//! Commands are the lines of code blocks in `sh`. Text after two or more blanks is a remark. A `meniscus`
//! command runs in a shell. It must exit with status 0 (or with 1 if the remark says so), and must make the
//! files that it names. For a command that begins with `cargo`, the program or the example runs with the same
//! arguments, as built for these tests. Any other command must be in `RUN_ELSEWHERE`, so that every command
//! on the pages is run by some check.

#![cfg(target_os = "linux")]

use std::collections::{BTreeMap, BTreeSet};
use std::env;
use std::fs::{self, File};
use std::io::{BufWriter, ErrorKind};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use glam::{IVec3, Vec3};
use meniscus::pipeline::encode_level_set;
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus::surface::particles::OwnedPositions;
use meniscus::surface::reconstruction::reconstruct_frame;
use meniscus_formats::{AttributeRole, FileAttribute, FilePositions, ParticleFrame, Values, bgeo, vdb};
use tempfile::{TempDir, tempdir};

use crate::program::scene::{block, meniscus, write_ply};

/// The pages whose commands run here, each in a separate folder, from top to bottom.
const PAGES: [(&str, &str); 10] = [
    ("README.md", include_str!("../../README.md")),
    ("docs/commands.md", include_str!("../../docs/commands.md")),
    ("docs/howto-blender.md", include_str!("../../docs/howto-blender.md")),
    ("docs/howto-houdini.md", include_str!("../../docs/howto-houdini.md")),
    ("docs/library.md", include_str!("../../docs/library.md")),
    ("docs/tutorial-first-surface.md", include_str!("../../docs/tutorial-first-surface.md")),
    ("docs/tutorial-live.md", include_str!("../../docs/tutorial-live.md")),
    ("docs/tutorial-houdini-blender.md", include_str!("../../docs/tutorial-houdini-blender.md")),
    ("docs/tutorial-spray.md", include_str!("../../docs/tutorial-spray.md")),
    ("docs/tutorial-farm.md", include_str!("../../docs/tutorial-farm.md")),
];

/// A timeout far longer than any command here takes.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Numbers of the frames in `cache/`, and of those with the same names in the folder above.
const FRAMES: [usize; 3] = [11, 12, 13];

/// Number of frames in `shot/`: with 60 shards, shard 18 in docs/commands.md is the last shard with a frame.
const SHOT_FRAMES: usize = 18;

/// Runs every command of a page, and checks that each makes the files that it names. A test for each page, so that
/// they run side by side.
fn run_page(page: &str) {
    let (_, text) = PAGES.iter().find(|(name, _)| *name == page).expect("one of the pages");
    let scene = Scene::new();
    commands(text).iter().for_each(|command| run_command(page, command, &scene));
    if page == "README.md" {
        // The README lists the first outputs of its first command.
        let out = scene.path().join("out");
        assert!(out.join("dam.0001.glb").is_file() && out.join("dam.0001.vdb").is_file());
    }
}

#[test]
fn commands_of_readme_run() {
    run_page("README.md");
}

#[test]
fn commands_of_commands_run() {
    run_page("docs/commands.md");
}

#[test]
fn commands_of_tutorial_spray_run() {
    run_page("docs/tutorial-spray.md");
}

#[test]
fn commands_of_howto_blender_run() {
    run_page("docs/howto-blender.md");
}

#[test]
fn commands_of_howto_houdini_run() {
    run_page("docs/howto-houdini.md");
}

#[test]
fn commands_of_library_run() {
    run_page("docs/library.md");
}

#[test]
fn commands_of_tutorial_first_surface_run() {
    run_page("docs/tutorial-first-surface.md");
}

#[test]
fn commands_of_tutorial_live_run() {
    run_page("docs/tutorial-live.md");
}

#[test]
fn commands_of_tutorial_houdini_blender_run() {
    run_page("docs/tutorial-houdini-blender.md");
}

#[test]
fn commands_of_tutorial_farm_run() {
    run_page("docs/tutorial-farm.md");
}

#[test]
fn every_page_has_commands_and_a_test() {
    let source = include_str!("commands.rs");
    for (page, text) in PAGES {
        assert!(!commands(text).is_empty(), "no commands were found in {page}");
        assert!(source.contains(&format!("run_page(\"{page}\");")), "no test runs the commands of {page}");
    }
}

fn run_command(page: &str, &PageCommand { text: command, status }: &PageCommand, scene: &Scene) {
    if RUN_ELSEWHERE.iter().any(|(elsewhere, ..)| *elsewhere == command) {
        return;
    }
    let words: Vec<&str> = command.split_whitespace().collect();
    let made = made_by(&words);
    let before = scene.outputs(&made);
    match words[..] {
        ["cargo", "test"] => {}
        ["cargo", "run", "-p", example, "--", ..] => {
            let arguments = command.split_once(" -- ").expect("just seen").1;
            scene.runs(&format!("{} {arguments}", example_program(example).display()), status);
        }
        ["cargo", "run", "--", ..] => {
            let arguments = command.split_once(" -- ").expect("just seen").1;
            scene.runs(&format!("meniscus {arguments}"), status);
        }
        ["meniscus", "watch", .., "--once"] => scene.runs(command, status),
        ["meniscus", "watch", ..] => scene.watches(command),
        ["meniscus", ..] => {
            if page == "docs/commands.md" && command.starts_with("meniscus verify ") {
                scene.runs_other_shards();
            }
            scene.runs(command, status);
        }
        ["cp" | "mkdir" | "rm", ..] => scene.runs(command, status),
        _ => panic!("{page}: this test does not know how to run: {command}"),
    }
    // With `--once` the frames may be done already.
    if words.contains(&"--once") {
        return;
    }
    let after = scene.outputs(&made);
    for (made, (before, after)) in made.iter().zip(before.iter().zip(&after)) {
        assert!(before != after && !after.is_empty(), "{page}: {command}: nothing new in {made}");
    }
}

/// A command of a page, without its remark, and the exit status that it must have.
#[derive(Debug, PartialEq)]
struct PageCommand<'text> {
    text: &'text str,
    status: i32,
}

/// The commands in the code blocks in `sh`.
fn commands(text: &str) -> Vec<PageCommand<'_>> {
    let blocks = text.split("```").skip(1).step_by(2).filter_map(|block| block.strip_prefix("sh\n"));
    let lines = blocks.flat_map(str::lines).map(str::trim).filter(|line| !line.is_empty());
    let command = |line| {
        let (text, remark) = str::split_once(line, "  ").unwrap_or((line, ""));
        PageCommand { text, status: i32::from(remark.contains("exit status 1")) }
    };
    lines.map(command).collect()
}

/// Commands in code blocks that other checks run: the file of the check, and the text in it that runs the
/// command.
const RUN_ELSEWHERE: [(&str, &str, &str); 6] = [
    ("cargo install --path . --locked", ".ci/install", "cargo install --path . --locked"),
    ("pip install pysplishsplash==2.19.0", "tests/clients/install", "pysplishsplash==2.19.0"),
    (
        "python tests/clients/simulate_splishsplash.py simulation",
        "tests/clients/check_simulators.py",
        "simulate_{name}.py",
    ),
    (
        "python benches/simulate_scenes.py dam 0 simulation",
        "benches/quality",
        "[\"benches/simulate_scenes.py\", scene]",
    ),
    (
        "examples/farm/submit.sh 4 --cpus-per-task=1 --time=5 -- examples/frames --out meshes",
        "tests/clients/check_slurm.py",
        "\"submit.sh\"",
    ),
    (
        "openjd run examples/farm/openjd.yaml -p Input=\"$PWD/examples/frames\" -p Out=\"$PWD/meshes\" -p Shards=4",
        "tests/clients/check_openjd.py",
        "OPENJD, \"run\", TEMPLATE",
    ),
];

#[test]
fn commands_that_run_elsewhere_are_in_a_page_and_in_their_check() {
    for (command, file, part) in RUN_ELSEWHERE {
        let is_in_page =
            PAGES.iter().any(|(_, text)| commands(text).iter().any(|found| found.text == command));
        assert!(is_in_page, "no page has the command {command}");
        let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).expect("readable");
        assert!(text.contains(part), "{command}: {file} has no {part}");
    }
}

/// Commands within sentences: the file of the check that runs each command, and the text there that runs it.
const IN_SENTENCES: [(&str, &str, &str); 6] = [
    ("meniscus flicker", "docs/commands.md", "\nmeniscus flicker 'surfaces"),
    ("meniscus help COMMAND", "tests/program/manual.rs", "--help"),
    ("meniscus man", "docs/commands.md", "\nmeniscus man "),
    ("meniscus convert", "docs/commands.md", "\nmeniscus convert "),
    ("meniscus watch", "docs/commands.md", "\nmeniscus watch "),
    ("cargo doc --open", ".ci/run", "cargo doc"),
];

#[test]
fn commands_in_sentences_run_elsewhere() {
    let begins = ["cargo ", "meniscus ", "blender ", ".debian/", "benches/"];
    let mut found = BTreeSet::new();
    for (_, text) in PAGES {
        let sentences: String = text.split("```").step_by(2).collect();
        let code = sentences.split('`').skip(1).step_by(2);
        found.extend(code.filter(|code| begins.iter().any(|b| code.starts_with(b))).map(str::to_owned));
    }
    let known: BTreeSet<String> = IN_SENTENCES.iter().map(|(command, ..)| (*command).to_owned()).collect();
    assert_eq!(found, known);
    for (command, file, part) in IN_SENTENCES {
        let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).expect("readable");
        assert!(text.contains(part), "{command}: {file} has no {part}");
    }
}

/// The files and folders that a command makes.
fn made_by<'a>(words: &[&'a str]) -> Vec<&'a str> {
    match words[..] {
        // Without a folder for surfaces after the number of frames, it writes only frames of particles.
        [.., "dam_break", "--", cache, _] => return vec![cache],
        // Examples take no options: their output comes last.
        ["cargo", .., output] if words.contains(&"-p") => return vec![output],
        ["cp", .., output] => return vec![output],
        _ => {}
    }
    let options: &[&str] = match words[..] {
        [_, "status", ..] => &[],
        _ => &["--out", "-o", "--report", "--sequence"],
    };
    words.windows(2).filter(|pair| options.contains(&pair[0])).map(|pair| pair[1]).collect()
}

/// Builds an example, in the profile of this test.
fn example_program(name: &str) -> PathBuf {
    let build = Command::new(env!("CARGO"))
        .args(["build", "--locked", "-p", name, "--bin", name])
        .args(["--message-format", "json"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("cargo starts");
    let (out, err) = (String::from_utf8_lossy(&build.stdout), String::from_utf8_lossy(&build.stderr));
    assert!(build.status.success(), "{name}: {err}");
    let messages = out.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).expect("JSON"));
    let messages = messages.filter(|message| message["target"]["name"] == name);
    let mut programs = messages.filter_map(|message| Some(message["executable"].as_str()?.into()));
    programs.next_back().unwrap_or_else(|| panic!("cargo built no program {name}"))
}

/// The README builds the program first. The examples that follow must not take minutes more to build.
#[test]
fn examples_in_pages_need_no_crate_or_feature_that_the_program_does_not_need() {
    let crates = |arguments: &[&str]| {
        let tree = ["tree", "--edges", "normal,build", "--prefix", "none", "--format", "{p} {f}"];
        let tree = Command::new(env!("CARGO"))
            .args(tree)
            .args(["--locked", "--offline"])
            .args(arguments)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .output()
            .expect("cargo starts");
        assert!(tree.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&tree.stderr));
        let lines = String::from_utf8(tree.stdout).expect("text");
        lines.lines().map(|line| line.trim_end_matches(" (*)").to_owned()).collect::<BTreeSet<String>>()
    };
    let program = crates(&[]);
    let commands = PAGES.iter().flat_map(|(_, text)| commands(text));
    let examples = commands.filter_map(|command| command.text.strip_prefix("cargo run -p "));
    let examples: BTreeSet<&str> = examples.filter_map(|rest| rest.split(' ').next()).collect();
    assert_eq!(examples, BTreeSet::from(["dam_break", "library"]));
    for example in examples {
        let more: Vec<String> = crates(&["-p", example]).difference(&program).cloned().collect();
        assert!(more.len() == 1 && more[0].starts_with(example), "{example} needs more: {more:#?}");
    }
}

/// Files by path, with values that differ between versions of a file: inode, modification time, size.
type Outputs = BTreeMap<PathBuf, (u64, i64, u64)>;

/// A folder with all files that the commands of a page name.
struct Scene {
    folder: TempDir,
}

impl Scene {
    fn new() -> Scene {
        let folder = tempdir().expect("a folder");
        let path = folder.path();
        for name in ["cache", "shot", "simulation/partio"] {
            fs::create_dir_all(path.join(name)).expect("made");
        }
        for number in FRAMES {
            let name = format!("dam.{number:04}.bgeo");
            write_bgeo(&path.join("cache").join(&name), 6, number);
            write_bgeo(&path.join(&name), 6, number);
        }
        // Frames with the names that SPlisHSPlasH uses.
        for number in 1..=FRAMES.len() {
            let name = format!("simulation/partio/ParticleData_Fluid_{number}.bgeo");
            write_bgeo(&path.join(name), 6, number);
        }
        (1..=SHOT_FRAMES)
            .for_each(|number| write_bgeo(&path.join(format!("shot/shot.{number:04}.bgeo")), 4, number));
        write_bgeo(&path.join("dam.bgeo"), 6, 0);
        write_ply(&path.join("frame.ply"), &block(6, 0.0));
        for number in [1, 2] {
            write_ply(&path.join(format!("spray.{number:04}.ply")), &block(4, 0.02 * number as f64));
        }
        write_beads(&path.join("beads.ply"));
        write_dump(&path.join("dump.lammpstrj"));
        write_ship(&path.join("ship.obj"));
        write_level_set(&path.join("dam.0012.vdb"));
        let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
        std::os::unix::fs::symlink(examples, path.join("examples")).expect("linked");
        Scene { folder }
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    /// A shell with the program in its PATH.
    fn shell(&self, command: &str) -> Command {
        let program = Path::new(env!("CARGO_BIN_EXE_meniscus")).parent().expect("a folder").to_owned();
        let others = env::var_os("PATH").unwrap_or_default();
        let folders: Vec<PathBuf> = [program].into_iter().chain(env::split_paths(&others)).collect();
        // Commands may use the shell's quotes and patterns, and no other feature of the shell.
        let is_plain = |unquoted: &str| !unquoted.contains([';', '&', '|', '<', '>', '$', '`']);
        assert!(command.split('\'').step_by(2).all(is_plain), "{command}");
        let mut shell = Command::new("sh");
        shell.args(["-c", &format!("exec {command}")]).current_dir(self.path()).stdin(Stdio::null());
        shell.env("PATH", env::join_paths(folders).expect("a list of folders"));
        shell
    }

    /// Runs a command until it ends, and asserts its exit status.
    fn runs(&self, command: &str, exit_status: i32) {
        let Output { status, stdout, stderr } = self.shell(command).output().expect("the shell starts");
        let (out, err) = (String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
        assert_eq!(status.code(), Some(exit_status), "{command}\n{out}{err}");
        assert!(!err.contains("is ignored: it affects"), "{command}\n{err}");
    }

    /// The files at these paths, and below these folders.
    fn outputs(&self, made: &[&str]) -> Vec<Outputs> {
        made.iter().map(|made| files_below(&self.path().join(made))).collect()
    }

    /// Runs a daemon until it has converted all frames, and stops it. Earlier outputs are removed, so that it
    /// converts all.
    fn watches(&self, command: &str) {
        // The port of the page may be in use on this machine.
        let command = &command.replace("127.0.0.1:7700", "127.0.0.1:0");
        let surfaces = self.path().join("surfaces");
        if surfaces.exists() {
            fs::remove_dir_all(surfaces).expect("removed");
        }
        let socket = self.path().join("notify");
        let manager = UnixDatagram::bind(&socket).expect("a socket");
        manager.set_read_timeout(Some(TIMEOUT)).expect("a socket");
        let mut shell = self.shell(command);
        let daemon = shell.env("NOTIFY_SOCKET", &socket).stdout(Stdio::null()).stderr(Stdio::null());
        let mut daemon = Ended(daemon.spawn().expect("the shell starts"));
        wait_for(&manager, &format!("STATUS={} done, 0 queued", FRAMES.len()));
        let sent = Command::new("kill").args(["-s", "TERM", &daemon.0.id().to_string()]).status();
        assert!(sent.expect("the signal is sent").success());
        assert_eq!(daemon.0.wait().expect("it ends").code(), Some(0), "{command}");
        fs::remove_file(socket).expect("removed");
    }

    /// Runs all shards in docs/commands.md except the last one with a frame, which a command on the page runs.
    fn runs_other_shards(&self) {
        for shard in 1..SHOT_FRAMES {
            let shard = format!("{shard}/60");
            let result =
                meniscus(self.path(), &["convert", "shot", "--out", "shot_meshes", "--shard", &shard]);
            assert_eq!(result.status, 0, "{}{}", result.out, result.err);
        }
    }
}

/// A file, or all files below a folder; empty if the path does not exist.
fn files_below(path: &Path) -> Outputs {
    if let Ok(entries) = fs::read_dir(path) {
        let paths = entries.map(|entry| entry.expect("an entry").path());
        return paths.flat_map(|path| files_below(&path)).collect();
    }
    let version = |file: fs::Metadata| (path.to_owned(), (file.ino(), file.mtime_nsec(), file.len()));
    fs::metadata(path).ok().map(version).into_iter().collect()
}

/// Waits until the daemon sends a notification with this start to its service manager.
fn wait_for(manager: &UnixDatagram, start: &str) {
    let mut bytes = [0; 4096];
    loop {
        match manager.recv(&mut bytes) {
            Ok(count) if String::from_utf8_lossy(&bytes[..count]).starts_with(start) => return,
            Ok(_) => {}
            // A signal arrived, for example because a child of another test has exited.
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => panic!("no {start}: {error}"),
        }
    }
}

/// A daemon that is killed when the test ends.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        // The daemon has already exited, unless the test has failed.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A moving block with velocities and colours.
fn write_bgeo(path: &Path, edge_count: usize, number: usize) {
    let particles = block(edge_count, 0.01 * number as f64);
    let vector = |name: &str, role, value: [f32; 3]| FileAttribute {
        name: name.into(),
        arity: 3,
        role: Some(role),
        values: Values::F32(value.repeat(particles.len())),
    };
    let frame = ParticleFrame {
        positions: FilePositions::F32(particles.iter().map(|position| position.map(|x| x as f32)).collect()),
        attributes: vec![
            vector("v", AttributeRole::Velocity, [0.24, 0.0, 0.0]),
            vector("Cd", AttributeRole::Color, [0.1, 0.4, 0.8]),
        ],
        ..ParticleFrame::default()
    };
    bgeo::write(&frame, &mut BufWriter::new(File::create(path).expect("made"))).expect("written");
}

/// Particles with two different radii.
fn write_beads(path: &Path) {
    let particles = block(4, 0.0);
    let lines = particles
        .iter()
        .zip([0.05, 0.06].iter().cycle())
        .map(|([x, y, z], radius)| format!("{x:.2} {y:.2} {z:.2} {radius}\n"));
    let properties = ["x", "y", "z", "pscale"].map(|name| format!("property float {name}\n")).concat();
    let header =
        format!("ply\nformat ascii 1.0\nelement vertex {}\n{properties}end_header\n", particles.len());
    fs::write(path, header + &lines.collect::<String>()).expect("written");
}

/// A LAMMPS dump with two steps.
fn write_dump(path: &Path) {
    let step = |number: usize| {
        let particles = block(4, 0.01 * number as f64);
        let atoms = particles.iter().enumerate();
        let atoms: String = atoms.map(|(id, [x, y, z])| format!("{id} 1 {x:.2} {y:.2} {z:.2}\n")).collect();
        format!(
            "ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n{}\nITEM: BOX BOUNDS pp pp pp\n0 1\n0 1\n0 1\n\
             ITEM: ATOMS id type x y z\n{atoms}",
            particles.len()
        )
    };
    fs::write(path, [0, 10].map(step).concat()).expect("written");
}

/// A box inside the block of particles.
fn write_ship(path: &Path) {
    let corner = |index: i32| IVec3::new(index & 1, index >> 1 & 1, index >> 2 & 1).as_vec3();
    let position = |index| Vec3::new(0.2, 0.2, -0.2) + corner(index) * Vec3::new(0.2, 0.2, 1.0);
    let vertices = (0..8).map(|index| {
        let [x, y, z] = position(index).to_array();
        format!("v {x:.2} {y:.2} {z:.2}\n")
    });
    let sides = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"];
    let sides = sides.map(|side| format!("f {side}\n")).concat();
    fs::write(path, vertices.collect::<String>() + &sides).expect("written");
}

/// The level set of a block.
fn write_level_set(path: &Path) {
    let settings = Settings::paper(0.05, &MethodOptions::default()).expect("sound");
    let surface = reconstruct_frame(&OwnedPositions::F64(block(4, 0.0)), &settings);
    let encoded = encode_level_set(&surface, &settings, &vdb::WriteOptions::default(), &[]);
    let mut out = BufWriter::new(File::create(path).expect("made"));
    encoded.expect("it fits").write(&mut out).expect("written");
}

#[test]
fn commands_are_found_without_their_remarks() {
    let text = "Words.\n\n```sh\nmeniscus a b     # remark\n\nmeniscus d.##.e   # exit status 1\n```\nWords.\n\
                ```sh\ncargo test\n```\n```rust\nuse a;\n```\n```\noutput\n```\n";
    let found = commands(text);
    let found: Vec<(&str, i32)> = found.iter().map(|command| (command.text, command.status)).collect();
    assert_eq!(found, [("meniscus a b", 0), ("meniscus d.##.e", 1), ("cargo test", 0)]);
    assert_eq!(made_by(&["meniscus", "convert", "a", "-o", "b", "--report", "c"]), ["b", "c"]);
    assert_eq!(made_by(&["meniscus", "status", "--out", "c"]), [""; 0]);
    assert_eq!(made_by(&["cargo", "run", "-p", "e", "--", "in", "out"]), ["out"]);
    assert_eq!(made_by(&["cargo", "run", "-p", "dam_break", "--", "in", "60"]), ["in"]);
    assert_eq!(made_by(&["cp", "-r", "a", "b"]), ["b"]);
}
