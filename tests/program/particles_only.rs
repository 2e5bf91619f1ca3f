//! Conversion of particles from one format to another, without a surface: attributes, provenance, and refused
//! options.

use std::fs;
use std::path::Path;

use meniscus_formats::{FilePositions, Limits, ParticleFrame, read_particles};
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, meniscus, names_in};

/// A table with positions of more digits than 32-bit numbers have, a velocity, numbers and words.
const TABLE: &str = "\
x,y,z,vx,vy,vz,id,temperature
0.123456789012,1,2,0,0,-1,7,293.25
1.5,0.25,-0.125,1,2,3,5000000000,294.5
";

fn read(path: &Path) -> ParticleFrame {
    let name = path.file_name().expect("a name").to_string_lossy();
    let bytes = fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    read_particles(&bytes, &name, &Limits::default()).unwrap_or_else(|error| panic!("{name}: {error}"))
}

fn folder_with(files: &[(&str, &str)]) -> TempDir {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    for (name, text) in files {
        fs::write(folder.path().join("in").join(name), text).expect("written");
    }
    folder
}

fn convert(folder: &Path, input: &str, more: &[&str]) -> RunResult {
    meniscus(folder, &[&["convert", input, "--out=out", "--particles-only"], more].concat())
}

#[test]
fn particles_keep_their_attributes() {
    let folder = folder_with(&[("dam.1.csv", TABLE), ("dam.2.csv", TABLE)]);
    let folder = folder.path();
    let result = convert(folder, "in", &["--format=vtp,ply", "--frames=1"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.out.contains("dam.1.csv: 2 particles"), "{}", result.out);
    assert_eq!(names_in(&folder.join("out")), ["dam.1.ply", "dam.1.vtp"]);
    let expected = read(&folder.join("in/dam.1.csv"));
    assert!(matches!(expected.positions, FilePositions::F64(_)));
    let vtp = read(&folder.join("out/dam.1.vtp"));
    assert_eq!((vtp.positions, vtp.attributes), (expected.positions.clone(), expected.attributes.clone()));
    let ply = read(&folder.join("out/dam.1.ply"));
    assert_eq!(ply.positions, expected.positions);
    assert_eq!(ply.attributes[0], expected.attributes[0]);

    // The outputs are particles, so a folder of them is a sequence. Converting them to another format loses
    // nothing.
    let again = meniscus(folder, &["convert", "out", "--out=two", "--particles-only", "--format=vtp"]);
    assert_eq!(again.status, 1, "{}", again.err);
    assert!(again.err.contains("would both become"), "{}", again.err);
    fs::remove_file(folder.join("out/dam.1.ply")).expect("removed");
    let again = meniscus(folder, &["convert", "out", "--out=two", "--particles-only", "--format=vtp"]);
    assert_eq!((again.status, &*again.err), (0, ""));
    assert_eq!(read(&folder.join("two/dam.1.vtp")), read(&folder.join("out/dam.1.vtp")));
}

#[test]
fn skip_done_writes_particles_with_a_flipped_byte_again() {
    let folder = folder_with(&[("dam.1.csv", "0.5,0,0\n0,0.25,0\n"), ("dam.2.csv", "0,0,0\n1,1,1\n")]);
    let folder = folder.path();
    assert_eq!(convert(folder, "in", &["--skip-done"]).status, 0);
    let damaged = folder.join("out/dam.1.ply");
    let whole = fs::read(&damaged).expect("written");
    let mut bytes = whole.clone();
    *bytes.last_mut().expect("bytes") ^= 1;
    // Make a new file: its stamp differs even if the clock of the file system has not advanced.
    fs::rename(&damaged, folder.join("old")).expect("moved");
    fs::write(&damaged, bytes).expect("written");
    let result = convert(folder, "in", &["--skip-done"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert_eq!(result.out.matches("done already").count(), 1, "{}", result.out);
    assert_eq!(fs::read(&damaged).expect("written"), whole);
}

#[test]
fn done_frames_are_kept_and_failures_are_reported() {
    let step = |number: usize| {
        format!("ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n1\nITEM: ATOMS x y z\n1 2 3\n")
    };
    let broken = step(20).replace("1 2 3", "1 2");
    let dump = [step(0), broken, step(30)].concat();
    let folder = folder_with(&[("d.dump", &dump)]);
    let folder = folder.path();
    let result = convert(folder, "in", &["--skip-done"]);
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(result.err.contains("d.dump/step=20: LAMMPS dump, at line 12"), "{}", result.err);
    assert_eq!(names_in(&folder.join("out")), ["d.0.ply", "d.30.ply"]);
    let result = convert(folder, "in", &["--skip-done"]);
    assert_eq!(result.out.matches("done already").count(), 2, "{}", result.out);
    assert!(result.out.contains("3 frames: 2 done, 1 failed"), "{}", result.out);
    fs::remove_dir_all(folder.join("out")).expect("removed");
    let result = convert(folder, "in", &["--on-error=stop"]);
    assert_eq!((result.status, names_in(&folder.join("out"))), (1, vec!["d.0.ply".to_owned()]));
    assert!(result.out.contains("1 done, 1 failed, 1 not started"), "{}", result.out);
}

#[test]
fn positions_that_are_not_finite_are_kept_with_a_warning() {
    let header =
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n";
    let folder = folder_with(&[("a.ply", &format!("{header}end_header\n1 2 3\nnan 0 0\n"))]);
    let result = convert(folder.path(), "in/a.ply", &["--format=vtp"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.err.contains("1 of 2 positions are not finite"), "{}", result.err);
}

#[test]
fn surface_options_are_refused() {
    let folder = folder_with(&[("a.csv", TABLE)]);
    let folder = folder.path();
    for (option, words) in [
        ("--format=glb", "writes ply and vtp"),
        ("--voxel-size=0.1", "do not apply"),
        ("--attributes=all", "do not apply"),
        ("--up=z", "do not apply"),
        ("--report=r.json", "do not apply"),
        ("--print-settings", "do not apply"),
    ] {
        let result = convert(folder, "in", &[option]);
        assert_eq!(result.status, 2, "{option}");
        assert!(result.err.contains(words), "{option}: {}", result.err);
        assert!(!folder.join("out").exists(), "{option}");
    }
    fs::copy(folder.join("in/a.csv"), folder.join("in/a.ply")).expect("copied");
    let result = meniscus(folder, &["convert", "in/a.csv", "in/a.ply", "--out=in", "--particles-only"]);
    assert_eq!(result.status, 2);
    assert!(result.err.contains("would replace the input"), "{}", result.err);
}
