//! Outputs that would replace inputs, each other, or data of other programs are refused.

use std::fs;
use std::path::Path;

use tempfile::tempdir;

use crate::program::scene::{assert_refused, meniscus, names_in, write_sequence};

#[test]
fn inputs_are_never_replaced() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 3);
    let before = fs::read(path.join("dam.1.ply")).expect("readable");
    fs::create_dir(path.join("out")).expect("made");
    let refused = |arguments: &[&str]| {
        let words = ["would replace the input", "dam."];
        assert_refused(path, &[&["convert", "--format", "ply"], arguments].concat(), &words);
    };
    refused(&["dam.1.ply", "--out", "."]);
    refused(&["dam.#.ply", "--out", "out/.."]);
    refused(&["dam.#.ply", "--out", "new/.."]);
    refused(&["dam.2.ply", "--report", "dam.2.ply", "--out", "out"]);
    // A frame of the sequence is protected even if it is not selected.
    refused(&["dam.#.ply", "--frames", "1", "--report", "dam.3.ply", "--out", "out"]);
    // A named input of another sequence is protected even if its number is not selected.
    for (from, to) in [("dam.1.ply", "a3_9.ply"), ("dam.2.ply", "a3_9.csv")] {
        fs::copy(path.join(from), path.join(to)).expect("copied");
    }
    let words = ["would replace the input", "a3_9.ply"];
    let arguments = ["convert", "a{}_9.csv", "a3_9.ply", "--frames", "3", "--out", ".", "--format", "ply"];
    assert_refused(path, &arguments, &words);
    for copy in ["dam.1.ply", "a3_9.ply"] {
        assert_eq!(fs::read(path.join(copy)).expect("readable"), before);
    }
    assert_eq!(names_in(&path.join("out")), [""; 0]);
}

#[test]
#[cfg(unix)]
fn input_behind_a_link_is_not_replaced() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 1);
    let link =
        |target: &Path, name: &str| std::os::unix::fs::symlink(target, path.join(name)).expect("linked");
    link(path, "same_folder");
    for out in ["linked_file", "linked_hard"] {
        fs::create_dir(path.join(out)).expect("made");
    }
    link(&path.join("dam.1.ply"), "linked_file/dam.1.ply");
    fs::hard_link(path.join("dam.1.ply"), path.join("linked_hard/dam.1.ply")).expect("linked");
    for out in ["same_folder", "linked_file", "linked_hard"] {
        let arguments = ["convert", "dam.1.ply", "--format", "ply", "--out", out];
        assert_refused(path, &arguments, &["would replace the input"]);
    }
    // In the opposite case, the input is a link into the output folder.
    fs::create_dir(path.join("out")).expect("made");
    fs::rename(path.join("dam.1.ply"), path.join("out/dam.1.ply")).expect("moved");
    link(&path.join("out/dam.1.ply"), "in.1.ply");
    link(&path.join("out/dam.1.ply"), "dam.1.ply");
    assert_refused(path, &["convert", "dam.1.ply", "--format", "ply", "--out", "out"], &["would replace"]);
}

#[test]
fn two_inputs_with_the_same_output_are_refused() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for name in ["a", "b"] {
        fs::create_dir(path.join(name)).expect("made");
        write_sequence(&path.join(name), 1, 1);
    }
    let (first, second) = (Path::new("a").join("dam.1.ply"), Path::new("b").join("dam.1.ply"));
    let words = [first.to_str().expect("text"), second.to_str().expect("text"), "would both become"];
    assert_refused(path, &["convert", "a", "b", "--out", "o"], &words);
    let arguments = ["convert", "a", "--out", "o", "--report", "o/dam.1.glb"];
    assert_refused(path, &arguments, &["the report", "would both become"]);
    assert!(!path.join("o").exists());
}

/// They may be the only copy. Only their frame fails. A file without content, such as one that reserves a name, is
/// replaced.
#[test]
fn particles_and_level_sets_of_others_are_not_replaced() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 2);
    fs::create_dir(path.join("out")).expect("made");
    let output = path.join("out/dam.2.ply");
    let convert = ["convert", ".", "--out", "out", "--format", "ply", "--spacing", "0.1"];
    fs::copy(path.join("dam.1.ply"), &output).expect("copied");
    let particles = fs::read(&output).expect("readable");
    let words = ["dam.2.ply would replace a file that is not a surface of meniscus", "move that file away"];
    let shard = [&convert[..], &["--shard", "1/1"]].concat();
    for arguments in [&convert[..], &shard, &[&convert[..6], &["--particles-only"]].concat()] {
        fails_in_one_frame(path, arguments, &words);
        let status = meniscus(path, &["status", "dam.2.ply", "--out", "out"]).out;
        assert!(status.contains("failed") && status.contains(words[0]), "{status}");
        assert_eq!(fs::read(&output).expect("readable"), particles);
        fs::remove_file(path.join("out/dam.1.ply")).expect("the other frame is converted");
    }

    // The frame after it is not started.
    write_sequence(path, 1, 3);
    let stop = [&convert[..], &["--on-error", "stop", "--report", "r.json"]].concat();
    fails_in_one_frame(path, &stop, &words);
    assert!(path.join("out/dam.1.ply").exists() && !path.join("out/dam.3.ply").exists());
    assert!(fs::read_to_string(path.join("r.json")).expect("a report").contains(words[0]));
    fs::remove_file(path.join("dam.3.ply")).expect("removed");

    fs::write(&output, "").expect("written");
    let only_particles = [&convert[..6], &["--particles-only"]].concat();
    for arguments in [&convert[..], &convert, &[&convert[..6], &["--format", "vdb"]].concat()] {
        let result = meniscus(path, arguments);
        assert_eq!(result.status, 0, "{}", result.err);
    }
    // Particles of this program are replaced by particles only.
    fs::remove_file(&output).expect("removed");
    assert_eq!(meniscus(path, &[&only_particles[..], &["--frames", "2"]].concat()).status, 0);
    assert_eq!(meniscus(path, &[&only_particles[..], &["--frames", "2"]].concat()).status, 0);
    fails_in_one_frame(path, &convert, &words);

    let volume = path.join("out/dam.1.vdb");
    let foreign = fs::read(&volume).expect("readable");
    let at = foreign.windows(9).position(|bytes| bytes == b"generator").expect("provenance");
    fs::write(&volume, [&foreign[..at], b"gonerator", &foreign[at + 9..]].concat()).expect("written");
    let words = ["dam.1.vdb would replace a file that is not a surface of meniscus"];
    fails_in_one_frame(path, &[&convert[..4], &["--format", "vdb"]].concat(), &words);
}

fn fails_in_one_frame(path: &Path, arguments: &[&str], words: &[&str]) {
    let result = meniscus(path, arguments);
    assert_eq!(result.status, 1, "{arguments:?}: {}", result.err);
    for word in words {
        assert!(result.err.contains(word), "{arguments:?} does not say {word}: {}", result.err);
    }
}

#[test]
fn points_in_an_obj_are_not_replaced_and_an_empty_mesh_is() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 1);
    fs::create_dir(path.join("out")).expect("made");
    let convert = ["convert", "dam.1.ply", "--format", "obj", "--out", "out"];
    fs::write(path.join("out/dam.1.obj"), "v 0 0 0\nv 1 0 0\n").expect("written");
    assert_refused(path, &convert, &["dam.1.obj would replace a file that is not a surface of meniscus"]);
    // A mesh without faces is still a mesh of this program.
    fs::write(path.join("dam.1.csv"), "x,y,z\n").expect("written");
    let convert = ["convert", "dam.1.csv", "--format", "obj", "--out", "empty", "--spacing", "0.1"];
    for _ in 0..2 {
        let result = meniscus(path, &convert);
        assert_eq!(result.status, 0, "{}", result.err);
    }
    let result = meniscus(path, &["render", "empty", "--out", "pictures", "--size", "64x48"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert_eq!(names_in(&path.join("pictures")), ["dam.1.png"]);
}
