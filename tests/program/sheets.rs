//! Contact sheets: their contents, their sources, and the commands that they print.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::Stdio;
use std::thread;
use std::time::Duration;

use meniscus::surface::Preset;
use meniscus_formats::{OutputFormat, read_provenance};
use tempfile::tempdir;

use crate::program::scene::{RunResult, block, command, meniscus, names_in, write_ply, write_sequence};

/// Size of a cell in the tests, in pixels.
const CELL: [usize; 2] = [112, 84];

const SIZE: &str = "112x84";

/// Gap between cells and around them, in pixels.
const GAP: usize = 10;

/// Height above the first cells, in pixels: one line of title, with gaps.
const HEAD: usize = GAP + 22 + GAP;

/// A decoded sheet.
struct Seen {
    width: usize,
    pixels: Vec<[u8; 3]>,
}

impl Seen {
    fn read(path: &Path) -> Seen {
        let file = BufReader::new(File::open(path).expect("a file"));
        let mut reader = png::Decoder::new(file).read_info().expect("a picture");
        let mut bytes = vec![0; reader.output_buffer_size().expect("small")];
        reader.next_frame(&mut bytes).expect("whole");
        let pixels = bytes.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
        Seen { width: reader.info().width as usize, pixels }
    }

    /// The pixels within a box, clipped to the sheet.
    fn part(&self, [left, top]: [usize; 2], [width, height]: [usize; 2]) -> Vec<[u8; 3]> {
        let rows = self.pixels.chunks_exact(self.width).skip(top).take(height);
        rows.flat_map(|row| row[left..left + width].iter().copied()).collect()
    }

    /// The picture in a cell, if this number of text lines is below each picture.
    fn cell(&self, column: usize, row: usize, line_count: usize) -> Vec<[u8; 3]> {
        self.part(cell_position(column, row, line_count), CELL)
    }

    /// The number of pixels with text below the picture of a cell.
    fn ink(&self, column: usize, row: usize, line_count: usize) -> usize {
        let [left, top] = cell_position(column, row, line_count);
        let below = self.part([left, top + CELL[1]], [CELL[0], 3 + 15 * line_count]);
        below.iter().filter(|pixel| pixel.iter().all(|&value| value < 100)).count()
    }
}

fn cell_position(column: usize, row: usize, line_count: usize) -> [usize; 2] {
    [GAP + column * (CELL[0] + GAP), HEAD + row * (CELL[1] + 3 + 15 * line_count + GAP)]
}

/// Whether a picture shows fluid: blue, unlike paper, ground and shadow.
fn has_fluid(pixels: &[[u8; 3]]) -> bool {
    pixels.iter().filter(|[red, _, blue]| u32::from(*blue) > u32::from(*red) + 60).count() > 50
}

fn is_plain(pixels: &[[u8; 3]]) -> bool {
    pixels[..CELL[0]].iter().all(|pixel| *pixel == pixels[0])
}

fn sheet_of(folder: &Path, arguments: &[&str]) -> RunResult {
    meniscus(folder, &[&["contact-sheet", "-o", "sheet.png", "--size", SIZE], arguments].concat())
}

#[test]
fn sheet_of_a_sequence_shows_a_picture_of_each_frame() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 6);
    let result = sheet_of(path, &[".", "--per-row", "4"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    let title =
        result.out.lines().find(|line| line.starts_with("dam: 6 frames, from particles, voxel size "));
    assert!(title.is_some_and(|title| title.ends_with(" s")), "{}", result.out);
    let seen = Seen::read(&path.join("sheet.png"));
    assert_eq!(seen.width, GAP + 4 * (CELL[0] + GAP));
    // Below each picture are the name and the number of particles.
    let line_count = 2;
    for index in 0..6 {
        let (column, row) = (index % 4, index / 4);
        assert!(has_fluid(&seen.cell(column, row, line_count)), "cell {index}");
        assert!(seen.ink(column, row, line_count) > 60, "cell {index} has no label");
    }
    assert!(!has_fluid(&seen.cell(2, 1, line_count)) && seen.ink(2, 1, line_count) == 0);
    let first = fs::read(path.join("sheet.png")).expect("there");
    let result = sheet_of(path, &[".", "--per-row", "4", "--threads", "1"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(fs::read(path.join("sheet.png")).expect("there") == first, "another run has other bytes");

    let result = sheet_of(path, &["dam.#.ply", "--count", "3"]);
    assert!(
        result.status == 0 && result.out.contains("dam: 3 of 6 frames, from particles"),
        "{}",
        result.out
    );
    let result = sheet_of(path, &["dam.#.ply", "--frames", "2-3", "--blend", "2.5d"]);
    assert!(result.status == 0 && result.out.contains("dam: 2 frames, from particles"), "{}", result.out);
    // The sheet in the folder is not a frame.
    let result = meniscus(path, &["convert", ".", "--out", "o", "--format", "vdb"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(names_in(&path.join("o")).iter().all(|name| name.ends_with(".vdb")));
}

#[test]
fn sheet_uses_the_cheapest_source() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir(path.join("in")).expect("made");
    write_sequence(&path.join("in"), 1, 3);
    let convert = ["convert", "in", "--out", "o", "--format", "vdb", "--preview", "png", "--preview-size"];
    let result = meniscus(path, &[&convert[..], &["192x144"]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    let from = |arguments: &[&str], kind: &str| {
        let result = sheet_of(path, arguments);
        assert_eq!((result.status, &*result.err), (0, ""), "{arguments:?} {}", result.out);
        assert!(
            result.out.starts_with(&format!("dam: 3 frames, from {kind}")),
            "{arguments:?}: {}",
            result.out
        );
    };
    from(&["o", "--per-row", "3"], "pictures");
    let seen = Seen::read(&path.join("sheet.png"));
    assert!((0..3).all(|column| has_fluid(&seen.cell(column, 0, 1))), "pictures are shrunk");
    from(&["o", "--camera", "azimuth=90"], "level sets");
    from(&["in"], "particles");
    let result = meniscus(path, &["convert", "in", "--out", "m", "--format", "obj,glb"]);
    assert_eq!(result.status, 0, "{}", result.err);
    from(&["m", "--per-row", "3"], "meshes");
    let seen = Seen::read(&path.join("sheet.png"));
    assert!((0..3).all(|column| has_fluid(&seen.cell(column, 0, 1))), "meshes are shown");
    from(&["m/dam.#.obj"], "meshes");
    // One picture is missing, and in its place is a sheet, which is not a picture of a frame.
    fs::rename(path.join("sheet.png"), path.join("o/dam.2.png")).expect("moved");
    from(&["o"], "level sets");
    // A picture with a different camera.
    let result = meniscus(path, &["render", "o/dam.2.vdb", "-o", "o/dam.2.png", "--camera", "azimuth=90"]);
    assert_eq!(result.status, 0, "{}", result.err);
    from(&["o"], "level sets");
    from(&["o/dam.#.png"], "pictures");
}

#[test]
fn failed_frame_leaves_the_other_cells() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 4);
    fs::write(path.join("dam.3.ply"), "ply\nformat ascii 1.0\nelement vertex 9\n").expect("written");
    let result = sheet_of(path, &["dam.#.ply", "--per-row", "4"]);
    assert_eq!(result.status, 1, "{} {}", result.out, result.err);
    assert!(result.err.contains("dam.3.ply") && result.err.matches("error").count() == 1, "{}", result.err);
    let seen = Seen::read(&path.join("sheet.png"));
    let fluid: Vec<bool> = (0..4).map(|column| has_fluid(&seen.cell(column, 0, 2))).collect();
    assert_eq!(fluid, [true, true, false, true]);
    assert!(is_plain(&seen.cell(2, 0, 2)) && seen.ink(2, 0, 2) > 20, "it is empty, and has its name");
    fs::remove_file(path.join("sheet.png")).expect("removed");
    let result = sheet_of(path, &["dam.3.ply"]);
    assert!(result.status == 2 && !path.join("sheet.png").exists(), "{}", result.out);
}

#[test]
fn sequences_are_one_after_another() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 2);
    write_ply(&path.join("other.1.ply"), &block(5, 0.0));
    write_ply(&path.join("other.2.ply"), &block(7, 0.0));
    write_ply(&path.join("alone.ply"), &block(6, 0.0));
    let result = sheet_of(path, &["."]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    for title in ["dam: 2 frames", "other: 2 frames", "alone.ply: 1 frame"] {
        assert!(result.out.contains(title), "{title}: {}", result.out);
    }
    let pairs =
        read_provenance(OutputFormat::Png, File::open(path.join("sheet.png")).expect("there")).expect("ours");
    let cameras = pairs.iter().filter(|(name, _)| name == "camera").map(|(_, value)| value);
    let cameras: Vec<&String> = cameras.collect();
    assert!(cameras.len() == 3 && cameras[0] != cameras[1], "each has its own camera: {cameras:?}");
}

/// The commands that the run printed.
/// The commands of the cells, in the order of their numbers, which the line before each has.
fn commands(out: &str) -> Vec<Vec<&str>> {
    let lines: Vec<&str> = out.lines().collect();
    let pairs = lines.windows(2).filter(|pair| pair[1].starts_with("meniscus convert "));
    let numbered =
        |pair: &[&'_ str]| -> usize { pair[0].split(':').next().expect("a number").parse().expect("it") };
    let mut pairs: Vec<(usize, &str)> = pairs.map(|pair| (numbered(pair), pair[1])).collect();
    pairs.sort_unstable();
    pairs.into_iter().map(|(_, line)| line.split_whitespace().skip(2).collect()).collect()
}

fn provenance(format: OutputFormat, path: &Path) -> HashMap<String, String> {
    read_provenance(format, File::open(path).expect("there")).expect("ours").into_iter().collect()
}

#[test]
fn printed_commands_give_the_pictures_of_the_cells() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("dam.7.ply"), &block(8, 0.0));
    let tune = ["tune", "dam.7.ply", "-o", "tune.png", "--size", SIZE, "--results", "my meshes", "--vary"];
    let tune = [&tune[..], &["laplacian-steps=2,40", "--vary", "preset=fluid,granular,paper"]].concat();
    let tune = [&tune[..], &["--fill-cavities=9", "--clip", "-1,-1,-1,0.6,2,2"]].concat();
    let tune = [&tune[..], &["--smooth-normals=2"]].concat();
    let result = meniscus(path, &[&tune[..], &["--threads", "1"]].concat());
    assert_eq!(result.status, 0, "{} {}", result.out, result.err);
    let first = fs::read(path.join("tune.png")).expect("there");
    assert_eq!(meniscus(path, &tune).status, 0);
    assert!(fs::read(path.join("tune.png")).expect("there") == first, "another run has other bytes");

    assert_eq!(result.out.matches("--out 'my meshes' --").count(), 6, "{}", result.out);
    let out = result.out.replace("'my meshes'", "meshes");
    let commands = commands(&out);
    assert_eq!(commands.len(), 6);
    let seen = Seen::read(&path.join("tune.png"));
    let mut cells: Vec<Vec<[u8; 3]>> = Vec::new();
    for (index, command) in commands.iter().enumerate() {
        let out = format!("o{index}");
        let out_index = command.iter().position(|word| *word == "--out").expect("a folder");
        let options = &command[out_index + 2..];
        let convert = [&["convert", "dam.7.ply", "--format", "vdb", "--out", &out], options].concat();
        let result = meniscus(path, &convert);
        assert_eq!(result.status, 0, "{convert:?} {}", result.err);
        let render = ["render", "dam.7.ply", "-o", "cell.png", "--camera-from", "tune.png", "--size", SIZE];
        let result = meniscus(path, &[&render[..], options].concat());
        assert_eq!(result.status, 0, "{options:?} {}", result.err);
        let [level_set, picture] = [
            provenance(OutputFormat::Vdb, &path.join(&out).join("dam.7.vdb")),
            provenance(OutputFormat::Png, &path.join("cell.png")),
        ];
        let same = level_set.iter().filter(|(name, _)| picture.contains_key(*name));
        let same: Vec<&String> =
            same.filter(|(name, value)| picture[*name] == **value).map(|(n, _)| n).collect();
        for name in ["input_hash", "voxel_size", "laplacian_steps", "steps", "clip", "fill_cavities"] {
            assert!(same.iter().any(|same| *same == name), "{name}: {level_set:?} {picture:?}");
        }
        cells.push(Seen::read(&path.join("cell.png")).pixels);
    }
    // Two rows of three cells.
    let mut tops = Vec::new();
    for (index, cell) in cells.iter().enumerate() {
        let left = GAP + index % 3 * (CELL[0] + GAP);
        let height = seen.pixels.len() / seen.width;
        let is_at = |&top: &usize| seen.part([left, top], CELL) == *cell;
        tops.extend((0..height).find(is_at));
        assert!(has_fluid(cell) && tops.len() == index + 1, "cell {} is not on the sheet", index + 1);
        assert!(cells[..index].iter().all(|other| other != cell), "cell {} appears twice", index + 1);
    }
    assert!(tops.is_sorted() && tops[0] == tops[2] && tops[2] < tops[3], "{tops:?}");
}

/// Options that decide which attributes are read, and whether the spacing is measured, differ between cells.
#[test]
fn each_cell_is_what_its_command_reads_and_measures() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let line = |[x, y, z]: [f64; 3]| format!("{x},{y},{z},3,0,0,0.05\n");
    let lines: String = block(6, 0.0).into_iter().map(line).collect();
    fs::write(path.join("jet.csv"), format!("x,y,z,vx,vy,vz,pscale\n{lines}")).expect("written");
    let tune = ["tune", "jet.csv", "-o", "t.png", "--size", SIZE];
    for (vary, labels) in [
        ("anisotropy=none,velocity", ["anisotropy none", "anisotropy velocity"]),
        ("radius-attribute=pscale,missing", ["radius-attribute pscale", ""]),
        ("spacing=0.1,0.11", ["spacing 0.1 (the defaults)", "spacing 0.11"]),
        ("preset=auto,noisy", ["preset auto (the defaults)", "preset noisy"]),
        ("voxel-size=0.05,0.32d", ["voxel-size 0.05", "voxel-size 0.32d (the defaults)"]),
    ] {
        let result = meniscus(path, &[&tune[..], &["--vary", vary]].concat());
        let expected = if labels[1].is_empty() { 1 } else { 2 };
        assert_eq!(result.status, 2 - expected, "{vary}: {}", result.err);
        for (index, label) in labels.iter().take(expected as usize).enumerate() {
            let label = format!("{}: {label}: ", index + 1);
            assert!(result.out.contains(&label), "{vary} does not print {label}: {}", result.out);
        }
    }
    // Without --vary, an option that is given is not varied.
    let result = meniscus(path, &[&tune[..], &["--blend", "2d"]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    let label = "11: position-smoothing 0.5, laplacian-steps 15 (without --vary): ";
    assert!(result.out.contains(label), "{}", result.out);
    assert_eq!(commands(&result.out).len(), 16);
}

#[test]
fn what_is_varied_by_default_suits_every_preset_and_grid() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("block.ply"), &block(5, 0.0));
    let tune = ["tune", "block.ply", "-o", "t.png", "--size", SIZE];
    let presets = Preset::ALL.iter().map(|preset| ["--preset", preset.name()]);
    for more in presets.chain([["--voxel-size", "0.5d"], ["--voxel-size", "0.2d"]]) {
        let result = meniscus(path, &[&tune[..], &more[..]].concat());
        assert_eq!((result.status, commands(&result.out).len()), (0, 16), "{more:?}: {}", result.err);
    }
}

/// Who stops `tune` keeps the cells that were done.
#[test]
fn sheet_is_there_before_all_cells_are_done() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("block.ply"), &block(12, 0.0));
    let blends: Vec<String> = (0..50).map(|step| format!("{}d", 1.4 + 0.01 * f64::from(step))).collect();
    let vary = format!("blend={}", blends.join(","));
    let tune = ["tune", "block.ply", "-o", "t.png", "--size", SIZE, "--vary", &vary, "--threads", "1"];
    let mut process = command(path, &tune).stdout(Stdio::null()).spawn().expect("the command starts");
    while !path.join("t.png").exists() {
        assert!(process.try_wait().expect("a process").is_none(), "it ended without a sheet before");
        thread::sleep(Duration::from_millis(5));
    }
    process.kill().expect("it ran");
    process.wait().expect("it ended");
    let seen = Seen::read(&path.join("t.png"));
    assert!(seen.ink(0, 0, 2) > 0 && seen.ink(9, 4, 2) == 0, "the first cell has a label, the last has none");
}

#[cfg(unix)]
#[test]
fn interrupted_tune_keeps_every_cell_that_it_printed() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("block.ply"), &block(12, 0.0));
    // The last cell takes minutes.
    let vary = ["--integrator", "explicit", "--vary", "steps=1,2,3,1000000"];
    let tune = [&["tune", "block.ply", "-o", "t.png", "--size", SIZE], &vary[..]].concat();
    let mut process = command(path, &tune).stdout(Stdio::piped()).spawn().expect("the command starts");
    let out = BufReader::new(process.stdout.take().expect("a pipe"));
    let printed = out.lines().map_while(Result::ok).filter(|line| line.starts_with("meniscus convert "));
    assert_eq!(printed.take(3).count(), 3);
    let sent = std::process::Command::new("kill").args(["-s", "INT", &process.id().to_string()]).status();
    assert!(sent.expect("the signal is sent").success());
    assert_eq!(process.wait().expect("it ended").code(), Some(130));
    let seen = Seen::read(&path.join("t.png"));
    let inks: Vec<bool> = (0..4).map(|column| seen.ink(column, 0, 2) > 0).collect();
    assert_eq!(inks, [true, true, true, false]);
}

#[test]
fn cells_with_large_voxels_are_computed_first() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("block.ply"), &block(6, 0.0));
    let tune = ["tune", "block.ply", "-o", "t.png", "--size", SIZE, "--vary", "voxel-size=0.4d,0.9d,0.6d"];
    let result = meniscus(path, &tune);
    let labels = result.out.lines().filter_map(|line| line.split_once(": voxel-size "));
    assert_eq!(labels.map(|(number, _)| number).collect::<Vec<_>>(), ["2", "3", "1"], "{}", result.out);
}

#[test]
fn invalid_setting_leaves_the_other_cells() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 3);
    let tune = ["tune", ".", "-o", "t.png", "--size", SIZE, "--vary", "blend=65h,7h"];
    let result = meniscus(path, &tune);
    assert_eq!(result.status, 1, "{} {}", result.out, result.err);
    assert!(result.err.contains("cell 1: blend 65h: the blend 65h is "), "{}", result.err);
    assert!(
        result.out.contains("showing dam.2.ply, one of 3 frames of ") && commands(&result.out).len() == 1,
        "{}",
        result.out
    );
    let result =
        meniscus(path, &["tune", ".", "-o", "t.png", "--size", SIZE, "--vary", "steps=0", "--frames", "3"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.out.contains("showing dam.3.ply, one of 3 frames of "), "{}", result.out);
    assert!(!result.err.contains("its sequence has"), "{}", result.err);
    // The spacing of a frame of a sequence is that of the whole sequence only if the sequence is named.
    let result = meniscus(path, &["tune", "dam.3.ply", "-o", "t.png", "--size", SIZE, "--vary", "steps=0"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.err.contains("dam.3.ply: its sequence has 3 frames"), "{}", result.err);
    // If the common settings are invalid, there is nothing to compare.
    let result = meniscus(path, &["tune", ".", "-o", "u.png", "--blend", "-1"]);
    assert!(
        result.status == 2 && result.err.contains("the blend is -1") && !path.join("u.png").exists(),
        "{}",
        result.err
    );
}

#[test]
fn invalid_sheet_arguments_are_refused() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 2);
    write_ply(&path.join("other.ply"), &block(5, 0.0));
    fs::create_dir(path.join("empty")).expect("made");
    fs::write(path.join("grid.vdb"), "no grid").expect("written");
    fs::create_dir(path.join("meshes")).expect("made");
    fs::write(path.join("meshes/b.stl"), "not a mesh").expect("written");
    let result = meniscus(path, &["render", "dam.1.ply", "-o", "picture.png", "--size", SIZE]);
    assert_eq!(result.status, 0, "{}", result.err);
    for (arguments, words) in [
        (&["contact-sheet", "."][..], &["--out"][..]),
        (&["contact-sheet", ".", "-o", "a.jpg"], &["a.jpg", ".png"]),
        (&["contact-sheet", ".", "-o", "a.exr"], &["a.exr", ".png"]),
        (&["contact-sheet", "missing", "-o", "a.png"], &["missing", "no such file or folder"]),
        (&["contact-sheet", "empty", "-o", "a.png"], &["empty: the folder is empty"]),
        (&["contact-sheet", "dam.#.ply", "-o", "a.png", "--frames", "7"], &["--frames selects none"]),
        (&["contact-sheet", "picture.png", "-o", "picture.png"], &["picture.png", "replace the input"]),
        (&["contact-sheet", ".", "-o", "picture.png"], &["picture.png", "replace the input"]),
        (&["contact-sheet", "grid.vdb", "-o", "a.png", "--steps", "3"], &["no particles"]),
        (&["contact-sheet", "dam.#.ply", "-o", "a.png", "--count", "1"], &["--count", "2 to 1000"]),
        (&["contact-sheet", ".", "-o", "a.png", "--size", "8192x4096"], &["8192x4096", "smaller --size"]),
        (&["tune", ".", "-o", "a.png"], &["sequences", "dam.{}.ply", "other.ply", "name one"]),
        (&["tune", "grid.vdb", "-o", "a.png"], &["grid.vdb", "tune needs the particles"]),
        (&["tune", "dam.1.ply", "-o", "dam.1.ply"], &["dam.1.ply", ".png"]),
        (&["tune", "dam.1.ply", "-o", "a.png", "--frames", "7"], &["--frames selects none"]),
        (&["tune", "dam.1.ply", "-o", "a.png", "--size", "8192x4096"], &["16 cells", "smaller --size"]),
        (&["tune", "meshes", "-o", "a.png"], &["meshes: no frames of particles", "`contact-sheet` show"]),
        (&["tune", "meshes/b.stl", "-o", "a.png"], &["this is a mesh, and tune needs the particles"]),
        (&["contact-sheet", "meshes", "-o", "a.png", "--steps", "3"], &["no particles"]),
    ] {
        let result = meniscus(path, arguments);
        assert_eq!(result.status, 2, "{arguments:?}: {} {}", result.out, result.err);
        for word in words {
            assert!(result.err.contains(word), "{arguments:?} does not say {word}: {}", result.err);
        }
    }
    let many: Vec<String> = (0..101).map(|index| index.to_string()).collect();
    let many = format!("steps={}", many.join(","));
    for (varied, given, words) in [
        (&["size=1"][..], &[][..], "no option --size to vary"),
        (&["radius-ratio=x"], &[], "radius-ratio: `x` is not a number"),
        (&["blend=0.6w"], &[], "blend: `0.6w` is not a length"),
        (&["steps=1", "steps=2"], &[], "--vary steps: give all values of an option in one --vary"),
        (&["steps=1", "offset=0", "quads=true"], &[], "varies at most two options"),
        (&["steps=1"], &["--steps=2"], "--steps is given and varied"),
        (&["blend=2d"], &["--preset=paper"], "has no effect without --preset fluid"),
        (&["velocity-gain=1", "anisotropy=none,neighbors"], &[], "without --anisotropy velocity"),
        (&[&many], &[], "101 cells; at most 100"),
    ] {
        let varied = varied.iter().flat_map(|vary| ["--vary", *vary]);
        let tune = ["tune", "dam.1.ply", "-o", "a.png"].into_iter().chain(varied);
        let tune: Vec<&str> = tune.chain(given.iter().copied()).collect();
        let result = meniscus(path, &tune);
        assert!(result.status == 2 && result.err.contains(words), "{words}: {}", result.err);
    }
    assert!(!path.join("a.png").exists());
}
