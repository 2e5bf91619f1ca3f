//! The example for other programs gives the results of the command.

use std::fs;

use meniscus_formats::Limits;
use meniscus_formats::gltf::read_mesh;
use tempfile::tempdir;

use crate::program::scene::{meniscus, names_in, write_sequence};

#[path = "../../examples/library/main.rs"]
#[expect(dead_code, reason = "the test calls what its main calls")]
mod example;

#[test]
fn example_gives_the_outputs_of_convert_for_a_folder() {
    let folder = tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    fs::create_dir(path("in")).expect("made");
    write_sequence(&path("in"), 9, 11);
    assert_eq!(example::convert_folder(&path("in"), &path("example")).expect("converted"), 3);
    assert_eq!(meniscus(folder.path(), &["convert", "in", "--out", "command"]).status, 0);
    let names = names_in(&path("command"));
    assert_eq!(names.len(), 6);
    assert_eq!(names_in(&path("example")), names);
    for name in names {
        let [ours, theirs] =
            ["example", "command"].map(|out| fs::read(path(out).join(&name)).expect("readable"));
        assert!(ours == theirs, "{name} differs");
    }
}

#[test]
fn example_makes_a_mesh_of_a_frame() {
    let folder = tempdir().expect("a folder");
    write_sequence(folder.path(), 1, 1);
    let (from, to) = (folder.path().join("dam.1.ply"), folder.path().join("dam.glb"));
    example::reconstruct_file(&from, &to).expect("converted");
    let mesh = read_mesh(&fs::read(to).expect("readable"), &Limits::default()).expect("a mesh");
    assert!(mesh.triangles.len() > 100);
}
