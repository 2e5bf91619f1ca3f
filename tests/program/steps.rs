//! Files with several frames: LAMMPS dumps, atoms and arrays. Every command treats each step as a frame.

use std::fmt::Write;
use std::fs;
use std::path::Path;

use meniscus_formats::{OutputFormat, read_provenance};
use serde_json::Value;
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, block, meniscus, names_in, write_ply};

const OUT: [&str; 3] = ["--out=out", "--format=obj", "--spacing=0.1"];

fn particles(number: usize) -> Vec<[f64; 3]> {
    block(5, 0.02 * number as f64)
}

/// A step of a dump.
pub(crate) fn step(number: usize) -> String {
    let particles = particles(number);
    let mut text = format!(
        "ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n{}\nITEM: BOX BOUNDS pp pp pp\n0 1\n0 1\n0 1\nITEM: ATOMS id x y z\n",
        particles.len()
    );
    for (id, [x, y, z]) in particles.iter().enumerate() {
        writeln!(text, "{id} {} {} {}", *x as f32, *y as f32, *z as f32).expect("strings take everything");
    }
    text
}

fn atoms(number: usize) -> String {
    let particles = particles(number);
    particles.iter().fold(format!("{}\nframe {number}\n", particles.len()), |mut text, [x, y, z]| {
        writeln!(text, "O {} {} {}", *x as f32, *y as f32, *z as f32).expect("strings take everything");
        text
    })
}

fn write_dump(folder: &Path, numbers: &[usize]) {
    let text: String = numbers.iter().map(|&number| step(number)).collect();
    fs::write(folder.join("d.lammpstrj"), text).expect("written");
}

/// A folder with a dump of these steps.
fn dump(numbers: &[usize]) -> TempDir {
    let folder = tempdir().expect("a folder");
    write_dump(folder.path(), numbers);
    folder
}

fn convert(folder: &Path, more: &[&str]) -> RunResult {
    meniscus(folder, &[&["convert"][..], &OUT, more].concat())
}

fn succeeded(result: &RunResult) {
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
}

/// The lines of an .obj without its provenance comments.
fn surface(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    text.lines().filter(|line| !line.starts_with('#')).collect::<Vec<_>>().join("\n")
}

/// The name of the source in the provenance of a mesh.
fn input_of(path: &Path) -> String {
    let pairs = read_provenance(OutputFormat::Obj, fs::File::open(path).expect("there")).expect("readable");
    pairs.into_iter().find(|(name, _)| name == "input").expect("recorded").1
}

#[test]
fn each_step_is_a_frame() {
    let folder = dump(&[0, 5, 20]);
    let folder = folder.path();
    let text = |steps: [usize; 3], of: fn(usize) -> String| steps.map(of).concat();
    fs::write(folder.join("a.xyz"), text([0, 5, 20], atoms)).expect("written");
    let result = convert(folder, &["d.lammpstrj", "a.xyz", "--report=report.json"]);
    succeeded(&result);
    let expected = ["a.0.obj", "a.1.obj", "a.2.obj", "d.0.obj", "d.20.obj", "d.5.obj"];
    assert_eq!(names_in(&folder.join("out")), expected);
    assert!(result.out.contains("d.lammpstrj/step={}: 3 frames"), "{}", result.out);
    for (number, index) in [(0, 0), (5, 1), (20, 2)] {
        // The table has the same decimals as the dump, because text is read with 64 bits.
        let row = |[x, y, z]: &[f64; 3]| format!("{},{},{}\n", *x as f32, *y as f32, *z as f32);
        let rows: String = particles(number).iter().map(row).collect();
        fs::write(folder.join("alone.csv"), format!("x,y,z\n{rows}")).expect("written");
        succeeded(&convert(folder, &["alone.csv"]));
        let expected = surface(&folder.join("out/alone.obj"));
        assert_eq!(surface(&folder.join(format!("out/d.{number}.obj"))), expected);
        assert_eq!(surface(&folder.join(format!("out/a.{index}.obj"))), expected);
        assert_eq!(
            input_of(&folder.join(format!("out/d.{number}.obj"))),
            format!("d.lammpstrj/step={number}")
        );
    }
    let report: Value = serde_json::from_str(&fs::read_to_string(folder.join("report.json")).expect("there"))
        .expect("a report");
    let inputs: Vec<_> = report["frames"].as_array().expect("frames").iter().map(|f| &f["input"]).collect();
    assert_eq!(inputs[3..], ["d.lammpstrj/step=0", "d.lammpstrj/step=5", "d.lammpstrj/step=20"]);
}

/// A NumPy array of 64-bit numbers with this shape.
fn array(shape: &str, particles: &[Vec<[f64; 3]>]) -> Vec<u8> {
    let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}");
    let data = particles.iter().flatten().flatten().flat_map(|number| number.to_le_bytes());
    let head = [&b"\x93NUMPY\x01\0"[..], &[118, 0], format!("{header:<117}\n").as_bytes()].concat();
    head.into_iter().chain(data).collect()
}

#[test]
fn each_frame_of_an_array_is_a_frame() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    let all = [0, 5, 20].map(particles);
    let bytes = array("(3, 125, 3)", &all);
    fs::write(folder.join("a.npy"), &bytes).expect("written");
    let result = convert(folder, &["a.npy"]);
    succeeded(&result);
    assert!(result.out.contains("a.npy/step={}: 3 frames"), "{}", result.out);
    assert_eq!(names_in(&folder.join("out")), ["a.0.obj", "a.1.obj", "a.2.obj"]);
    fs::write(folder.join("alone.npy"), array("(125, 3)", &all[1..2])).expect("written");
    succeeded(&convert(folder, &["alone.npy"]));
    assert_eq!(surface(&folder.join("out/a.1.obj")), surface(&folder.join("out/alone.obj")));
    // The last frame is truncated.
    fs::write(folder.join("a.npy"), &bytes[..bytes.len() - 8]).expect("written");
    let result = convert(folder, &["a.npy", "--on-error=continue"]);
    assert_eq!(result.status, 1, "{}", result.err);
    let message =
        "a.npy/step=2: NumPy array, at byte 128: expected 3000 bytes for the shape (125, 3), 2992 remain";
    assert!(result.err.contains(message), "{}", result.err);
}

#[test]
fn trajectory_may_begin_without_atoms() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    fs::write(folder.join("a.xyz"), format!("0\nnothing yet\n{}", atoms(5))).expect("written");
    let result = convert(folder, &["a.xyz"]);
    assert_eq!(result.status, 0, "{}", result.err);
    fs::write(folder.join("alone.xyz"), atoms(5)).expect("written");
    succeeded(&convert(folder, &["alone.xyz"]));
    assert_eq!(surface(&folder.join("out/a.1.obj")), surface(&folder.join("out/alone.obj")));
}

#[test]
fn steps_are_selected_by_their_numbers_and_named_one_by_one() {
    let folder = dump(&[0, 5, 20]);
    let folder = folder.path();
    succeeded(&convert(folder, &["d.lammpstrj", "--frames=5"]));
    assert_eq!(names_in(&folder.join("out")), ["d.5.obj"]);
    succeeded(&convert(folder, &["d.lammpstrj/step=20", "d.lammpstrj/step=20"]));
    assert_eq!(names_in(&folder.join("out")), ["d.20.obj", "d.5.obj"]);
    let result = convert(folder, &["d.lammpstrj/step=7"]);
    assert_eq!(result.status, 2);
    assert_eq!(result.err.matches("there is no step 7").count(), 1, "{}", result.err);
    // The spacing is measured on the whole dump, whichever step is converted.
    let measured =
        |more: &[&str]| meniscus(folder, &[&["convert", "d.lammpstrj", "--out=m"], more].concat()).out;
    let [all, one] = [measured(&[]), measured(&["--frames=20"])];
    let where_from = "measured on 3 frames)";
    assert!(all.contains(where_from) && one.contains(where_from), "{all}\n{one}");
}

#[test]
fn done_steps_are_kept_when_steps_are_appended() {
    let folder = dump(&[0, 5]);
    let folder = folder.path();
    succeeded(&convert(folder, &["d.lammpstrj", "--skip-done"]));
    let before = fs::metadata(folder.join("out/d.5.obj")).and_then(|m| m.modified()).expect("there");
    write_dump(folder, &[0, 5, 20]);
    let result = convert(folder, &["d.lammpstrj", "--skip-done"]);
    succeeded(&result);
    assert_eq!(result.out.matches("done already").count(), 2, "{}", result.out);
    assert_eq!(names_in(&folder.join("out")), ["d.0.obj", "d.20.obj", "d.5.obj"]);
    let after = fs::metadata(folder.join("out/d.5.obj")).and_then(|m| m.modified()).expect("there");
    assert_eq!(before, after);
}

#[test]
fn damaged_step_is_one_failed_frame() {
    let folder = dump(&[]);
    let folder = folder.path();
    let short = step(5).lines().take(40).map(|line| format!("{line}\n")).collect::<String>();
    let text = [step(0), short, step(20), step(20), step(30).replace("30\n", "thirty\n")].concat();
    fs::write(folder.join("d.lammpstrj"), text).expect("written");
    let result = convert(folder, &["d.lammpstrj", "--on-error=continue"]);
    assert_eq!(result.status, 1, "{}", result.err);
    assert_eq!(names_in(&folder.join("out")), ["d.0.obj", "d.20.2.obj", "d.20.obj"]);
    for words in ["d.lammpstrj/step=5: LAMMPS dump, at line 174: expected 125 atoms", "step=unnumbered: "] {
        assert!(result.err.contains(words), "{words}: {}", result.err);
    }
    assert_eq!(surface(&folder.join("out/d.20.obj")), surface(&folder.join("out/d.20.2.obj")));
}

#[test]
fn steps_beyond_the_limit_cause_an_error() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    fs::write(folder.join("many.xyz"), "1\n\nO 0 0 0\n".repeat(1_000_001)).expect("written");
    for command in [&["convert", "many.xyz", "--out=out"][..], &["info", "many.xyz"]] {
        let result = meniscus(folder, command);
        assert_eq!(result.status, 2, "{command:?}: {}{}", result.out, result.err);
        let message = "many.xyz: XYZ atoms: the file has more steps than the limit of 1000000";
        assert!(result.err.contains(message), "{command:?}: {}", result.err);
    }
    assert!(!folder.join("out").exists());
    // The other steps are converted.
    write_dump(folder, &[1, 2]);
    let result = convert(folder, &["many.xyz", "d.lammpstrj"]);
    assert_eq!(result.status, 1, "{}{}", result.out, result.err);
    assert!(
        result.err.contains("error: many.xyz: XYZ atoms: the file has more steps than the limit"),
        "{}",
        result.err
    );
    assert!(folder.join("out/d.2.obj").exists(), "{}", result.out);
}

#[test]
fn last_line_without_a_newline_causes_a_warning() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    fs::write(folder.join("a.xyz"), [atoms(0), atoms(5)].concat().trim_end()).expect("written");
    let result = convert(folder, &["a.xyz"]);
    assert_eq!((result.status, names_in(&folder.join("out"))), (0, vec!["a.0.obj".into(), "a.1.obj".into()]));
    assert_eq!(
        result.err.matches("a.xyz/step=1: the file ends without a line end").count(),
        1,
        "{}",
        result.err
    );
    assert_eq!(result.err.lines().count(), 1, "{}", result.err);
}

#[test]
fn names_of_steps_do_not_collide() {
    let folder = dump(&[0, 5]);
    let folder = folder.path();
    write_ply(&folder.join("d.5.ply"), &block(5, 0.0));
    let result = convert(folder, &["d.lammpstrj", "d.5.ply"]);
    assert_eq!(result.status, 1);
    assert!(result.err.contains("would both become"), "{}", result.err);
    assert_eq!(names_in(&folder.join("out")), ["d.0.obj", "d.5.obj"]);
    fs::remove_dir_all(folder.join("out")).expect("removed");
    // The outputs of a dump do not replace it.
    fs::rename(folder.join("d.lammpstrj"), folder.join("d.5.obj")).expect("renamed");
    let result = meniscus(folder, &["convert", "d.5.obj", "--out=.", "--format=obj", "--frames=5"]);
    assert_eq!(
        (result.status, names_in(folder)),
        (0, vec!["d.5.5.obj".into(), "d.5.obj".into(), "d.5.ply".into()])
    );
}

#[test]
fn steps_are_divided_into_shards_and_verified() {
    let folder = dump(&[0, 5, 20]);
    let folder = folder.path();
    fs::create_dir(folder.join("out")).expect("made");
    for shard in ["1/2", "2/2"] {
        succeeded(&convert(folder, &["d.lammpstrj", "--shard", shard]));
    }
    succeeded(&meniscus(folder, &["verify", "out", "--input", "d.lammpstrj"]));
    let again = convert(folder, &["d.lammpstrj", "--shard=1/2"]);
    assert_eq!(again.out.matches("done already").count(), 2, "{}", again.out);
    write_dump(folder, &[0, 5]);
    let result = meniscus(folder, &["verify", "out"]);
    assert!(result.err.contains("1 frame with a missing input"), "{}", result.err);
    let text: String = [step(0), step(5).replace("0.1 ", "0.125 "), step(20)].concat();
    fs::write(folder.join("d.lammpstrj"), text).expect("written");
    let result = meniscus(folder, &["verify", "out"]);
    assert!(result.err.contains("d.5: stale: the input has changed"), "{}", result.err);
    assert!(result.out.contains("2 done, 1 stale"), "{}", result.out);
}

#[test]
fn render_makes_pictures_of_steps() {
    let folder = dump(&[0, 5]);
    let folder = folder.path();
    let result = meniscus(folder, &["render", "d.lammpstrj", "--out=pictures", "--size=64x48"]);
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
    assert_eq!(names_in(&folder.join("pictures")), ["d.0.png", "d.5.png"]);
}
