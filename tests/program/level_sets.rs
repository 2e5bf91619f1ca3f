//! Level sets in .vdb as inputs: contoured unchanged, or smoothed within a maximum offset; and refused
//! options.

use std::fs;
use std::io::Write;
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::Value;
use tempfile::{TempDir, tempdir};

use crate::program::raw_vdb::{Cell, raw_level_set};
use crate::program::scene::{RunResult, block, meniscus, names_in, write_ply};

/// A block of particles as a level set with little smoothing, `in/block.vdb`, and as a mesh.
fn scene() -> TempDir {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    write_ply(&folder.path().join("block.ply"), &block(8, 0.0125));
    let rough = [
        "--preset=paper",
        "--laplacian-steps=0",
        "--steps=0",
        "--voxel-size=0.05",
        "--format=vdb,obj",
        "--out=in",
    ];
    let result = meniscus(folder.path(), &[&["convert", "block.ply"], &rough[..]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    folder
}

fn convert(folder: &Path, more: &[&str]) -> RunResult {
    meniscus(folder, &[&["convert", "in/block.vdb", "--out=out"], more].concat())
}

fn succeeded(result: &RunResult) {
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
}

/// The output of `info` for a file.
fn info(folder: &Path, file: &str) -> Value {
    let result = meniscus(folder, &["info", "--json", file]);
    let json: Value = serde_json::from_str(&result.out).unwrap_or_else(|error| panic!("{file}: {error}"));
    json[0].clone()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value}"))
}

#[test]
fn level_set_is_contoured_unchanged() {
    let folder = scene();
    let folder = folder.path();
    let result = convert(folder, &["--format=obj,glb,vdb"]);
    succeeded(&result);
    assert_eq!(names_in(&folder.join("out")), ["block.glb", "block.obj", "block.vdb"]);
    let [from_particles, again] =
        ["in/block.obj", "out/block.obj"].map(|file| info(folder, file)["mesh"].clone());
    // The mesh in `in` is that of the paper, which is not refined where it is strongly curved.
    let [expected, found] = [&from_particles, &again].map(|mesh| number(&mesh["triangles"]));
    assert!((1.01..1.2).contains(&(found / expected)), "{found} {expected}");
    assert_eq!(again["boundary_edges"], 0);
    let [expected, found] = [&from_particles, &again].map(|mesh| number(&mesh["volume"]));
    assert!((found / expected - 1.0).abs() < 1e-3, "{found} {expected}");
    // The output has the values of the input.
    let [one, other] = ["in/block.vdb", "out/block.vdb"].map(|file| info(folder, file)["grids"][0].clone());
    assert_eq!(one["active_voxels"], other["active_voxels"], "{one}");
    let result = convert(folder, &["--format=obj,glb,vdb", "--skip-done"]);
    assert!(result.out.contains("done already"), "{}", result.out);
    let result = convert(folder, &["--format=obj", "--skip-done", "--max-deviation=0.5"]);
    assert!(!result.out.contains("done already"), "{}", result.out);
}

#[test]
fn skip_done_writes_a_contoured_level_set_with_a_flipped_byte_again() {
    let folder = scene();
    let folder = folder.path();
    succeeded(&convert(folder, &["--format=glb", "--skip-done"]));
    let damaged = folder.join("out/block.glb");
    let whole = fs::read(&damaged).expect("written");
    let mut bytes = whole.clone();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    // Make a new file: its stamp differs even if the clock of the file system has not advanced.
    fs::rename(&damaged, folder.join("old")).expect("moved");
    fs::write(&damaged, bytes).expect("written");
    let result = convert(folder, &["--format=glb", "--skip-done"]);
    succeeded(&result);
    assert!(!result.out.contains("done already"), "{}", result.out);
    assert_eq!(fs::read(&damaged).expect("written"), whole);
    assert!(convert(folder, &["--format=glb", "--skip-done"]).out.contains("done already"));
}

#[test]
fn smoothing_stays_within_max_deviation() {
    let folder = scene();
    let folder = folder.path();
    succeeded(&convert(folder, &["--format=obj"]));
    let area_of = |file: &str| number(&info(folder, file)["mesh"]["area"]);
    let rough = area_of("out/block.obj");
    let volume = number(&info(folder, "out/block.obj")["mesh"]["volume"]);
    succeeded(&convert(folder, &["--format=obj", "--max-deviation=1"]));
    let smooth = info(folder, "out/block.obj")["mesh"].clone();
    assert!(number(&smooth["area"]) < 0.99 * rough, "{smooth} {rough}");
    assert_eq!(smooth["boundary_edges"], 0);
    // The surface moves by at most a voxel everywhere, so the volume changes by at most that of such a shell.
    let moved = (number(&smooth["volume"]) - volume).abs();
    assert!(moved < 0.05 * rough, "{moved}");
    // The bytes are the same on any number of threads.
    let bytes = |threads: &str| {
        succeeded(&convert(folder, &["--format=obj", "--max-deviation=1", threads]));
        fs::read(folder.join("out/block.obj")).expect("there")
    };
    assert_eq!(bytes("--threads=1"), bytes("--threads=2"));
}

#[test]
fn options_that_need_particles_are_refused_by_name() {
    let folder = scene();
    let folder = folder.path();
    for (options, words) in [
        (&["--voxel-size=0.1"][..], "error: --voxel-size cannot be given"),
        (&["--drop-islands=2", "--preset=fluid"], "error: --preset cannot be given"),
        (&["--drop-islands=2", "--radius-min=0.1"], "error: --radius-min, --drop-islands cannot be given"),
        (&["--attributes=all"], "error: --attributes cannot be given"),
        (&["--obstacle=block.ply"], "error: --obstacle cannot be given"),
        (&["--steps=3"], "without --max-deviation it is not smoothed"),
        (&["--max-deviation=4"], "`4` is not a number from 0 to 3"),
        (&["block.ply"], "one command cannot convert both"),
        (&["--offset=1h"], "--offset must be in world units"),
        (&["--max-deviation=1", "--step-size=1e9"], "--step-size"),
        (&["--decimate=100"], "`100` is not a number from 0 to 1"),
    ] {
        let result = convert(folder, options);
        assert_eq!(result.status, 2, "{options:?}");
        assert!(result.err.contains(words), "{options:?}: {}", result.err);
        assert!(!folder.join("out").exists(), "{options:?}");
    }
    for (arguments, words) in [
        (
            &["render", "in/block.vdb", "-o=r.png", "--voxel-size=1"][..],
            "error: --voxel-size cannot be given",
        ),
        (&["render", "in/block.vdb", "-o=r.png", "--steps=1"], "error: --steps cannot be given"),
        (
            &["watch", "in", "--out=watched", "--once", "--pattern=*.vdb", "--voxel-size=1"],
            "error: in: --voxel-size cannot be given",
        ),
        (
            &["convert", "--particles-only", "in/block.vdb", "--out=out"],
            "block.vdb: --particles-only needs particles",
        ),
        (
            &["watch", "in", "--out=watched", "--once"],
            "no frames to convert: 1 level set left alone; --pattern '*.vdb' selects level sets",
        ),
        (
            &["watch", "in", "--out=watched", "--once", "--pattern=*"],
            "no frames to convert: 1 level set left alone; --pattern '*.vdb' selects level sets",
        ),
        (
            &["watch", "in", "--out=watched", "--once", "--pattern=*.vdb"],
            "no frames to convert: 1 level set left alone: results that meniscus wrote are not inputs",
        ),
        (
            &["watch", "in", "--out=watched", "--once", "--pattern=foo*.ply"],
            "no frames to convert: none of the 2 files in this folder matches foo*.ply",
        ),
        (
            &["watch", "in", "--out=watched", "--once", "--pattern=*.VDB"],
            "matches *.VDB; capital and small letters differ",
        ),
        (
            &["watch", "in", "--out=watched", "--once", "--pattern={*.vdb,*.obj}"],
            "matches {*.vdb,*.obj}; braces have no meaning in a pattern",
        ),
        (
            &["watch", "in", "--out=watched", "--once", "--pattern=block.####.ply"],
            "matches block.####.ply; in a pattern, * stands for the number",
        ),
    ] {
        let result = meniscus(folder, arguments);
        assert_eq!(result.status, 2, "{arguments:?}");
        assert!(result.err.contains(words), "{arguments:?}: {}", result.err);
        assert!(!folder.join("out").exists() && !folder.join("r.png").exists(), "{arguments:?}");
    }
    let result = meniscus(folder, &["convert", "block.ply", "--out=out", "--max-deviation=1"]);
    assert!(result.status == 2 && result.err.contains("--max-deviation is for level sets"), "{}", result.err);
}

#[test]
fn file_that_only_has_the_name_of_a_level_set_is_refused_with_its_format() {
    let folder = scene();
    let folder = folder.path();
    let level_set = fs::read(folder.join("in/block.vdb")).expect("there");
    let mut packed = GzEncoder::new(Vec::new(), Compression::default());
    packed.write_all(&level_set).expect("packed");
    for (bytes, words) in [
        (Vec::new(), "in/block.vdb: the file is empty"),
        (
            fs::read(folder.join("block.ply")).expect("there"),
            "the file has another format (PLY): change its extension",
        ),
        (packed.finish().expect("packed"), "the file is gzipped: decompress it"),
    ] {
        fs::write(folder.join("in/block.vdb"), bytes).expect("written");
        let result = convert(folder, &["--format=obj"]);
        assert!(result.status == 2 && result.err.contains(words), "{words}: {}", result.err);
    }
    // A level set with another name.
    fs::write(folder.join("level_set.ply"), level_set).expect("written");
    let result = meniscus(folder, &["convert", "level_set.ply", "--out=out"]);
    let words = "this is a volume, not particles: to convert a level set, rename it";
    assert!(result.status == 2 && result.err.contains(words), "{}", result.err);
}

/// Two level sets of one sequence, `in/f.1.vdb` and `in/f.2.vdb`.
fn sequence() -> TempDir {
    let folder = scene();
    for name in ["f.1.vdb", "f.2.vdb"] {
        fs::copy(folder.path().join("in/block.vdb"), folder.path().join("in").join(name)).expect("copied");
    }
    folder
}

const MADE: [&str; 4] = ["--out=out", "--format=glb,stl", "--max-deviation=0.5", "--steps=3"];

#[test]
fn level_sets_have_reports_previews_and_sequence_files() {
    let folder = sequence();
    let folder = folder.path();
    let more = ["--preview=png", "--preview-size=64x64", "--memory=1GiB", "--report=r.json"];
    let shots = ["--sequence=s.glb", "--sequence=s.abc", "--skip-done"];
    let arguments = [&["convert", "in/f.#.vdb"], &MADE[..], &more, &shots].concat();
    let result = meniscus(folder, &arguments);
    succeeded(&result);
    assert!(result.out.contains("2 frames: 2 done"), "{}", result.out);
    let names = ["f.1.glb", "f.1.png", "f.1.stl", "f.2.glb", "f.2.png", "f.2.stl"];
    assert!(
        names.iter().all(|name| folder.join("out").join(name).is_file()),
        "{:?}",
        names_in(&folder.join("out"))
    );
    assert!(["s.glb", "s.abc"].iter().all(|name| folder.join(name).is_file()));
    let report: Value =
        serde_json::from_slice(&fs::read(folder.join("r.json")).expect("there")).expect("JSON");
    assert_eq!(report["settings"][0]["max_deviation"], 0.5, "{report}");
    assert_eq!(report["settings"][0]["more"]["steps"], "3", "{report}");
    for frame in report["frames"].as_array().expect("frames") {
        assert_eq!((&frame["status"], &frame["voxel_size"]), (&"converted".into(), &0.05.into()), "{frame}");
        assert_eq!(frame["certificate"]["holds"], true, "{frame}");
        assert!(number(&frame["triangles"]) > 0.0 && number(&frame["passes"]) > 0.0, "{frame}");
    }
    let again = meniscus(folder, &arguments);
    assert_eq!(again.out.matches("done already").count(), 2, "{}", again.out);
}
#[test]
fn shards_of_level_sets_give_the_results_of_convert() {
    for options in [&["--format=glb,stl", "--max-deviation=0.5", "--steps=3"][..], &["--format=glb"]] {
        let folder = sequence();
        let folder = folder.path();
        let convert = |more: &[&str]| meniscus(folder, &[&["convert", "in/f.#.vdb"], options, more].concat());
        succeeded(&convert(&["--out=one"]));
        fs::create_dir(folder.join("out")).expect("made");
        for shard in ["--shard=1/2", "--shard=2/2"] {
            succeeded(&convert(&["--out=out", shard]));
        }
        for name in names_in(&folder.join("one")) {
            let bytes = |out: &str| fs::read(folder.join(out).join(&name)).expect("there");
            assert!(bytes("one") == bytes("out"), "{name}");
        }
        let verify = || meniscus(folder, &["verify", "out"]);
        assert_eq!(verify().status, 0, "{}", verify().err);
        assert!(convert(&["--out=out", "--shard=1/2"]).out.contains("done already"));
        // A missing input cannot be compared, and its outputs count as done.
        fs::remove_file(folder.join("in/f.1.vdb")).expect("removed");
        assert_eq!(verify().status, 0, "{}", verify().err);
        let bytes = fs::read(folder.join("in/f.2.vdb")).expect("there");
        fs::write(folder.join("in/f.1.vdb"), [&bytes[..], b" "].concat()).expect("written");
        assert_eq!(verify().status, 1, "{}", verify().err);
    }
}

#[test]
fn watch_converts_foreign_level_sets_that_a_pattern_names() {
    let folder = scene();
    let folder = folder.path();
    fs::write(folder.join("in/ball.1.vdb"), ball(|distance| (0.1 * distance).clamp(-0.3, 0.3)))
        .expect("written");
    let watch = |more: &[&str]| {
        let arguments = ["watch", "in", "--out=in", "--once", "--settle=0ms", "--format=obj"];
        meniscus(folder, &[&arguments[..], more].concat())
    };
    // Without such a pattern, level sets may be outputs of other programs.
    for more in [&[][..], &["--pattern=*"], &["--pattern=ball.*"]] {
        let result = watch(more);
        assert!(!folder.join("in/ball.1.obj").exists(), "{more:?} {}", result.err);
    }
    // `block.vdb` and its mesh are outputs of this program, and must not change.
    let before = fs::read(folder.join("in/block.obj")).expect("there");
    let result = watch(&["--pattern=*.vdb", "--preview=png", "--preview-size=64x64"]);
    assert_eq!(result.status, 0, "{} {}", result.out, result.err);
    assert_eq!(fs::read(folder.join("in/block.obj")).expect("there"), before);
    assert!(folder.join("in/ball.1.png").is_file());
    let mesh = info(folder, "in/ball.1.obj")["mesh"].clone();
    assert_eq!(mesh["boundary_edges"], 0, "{mesh}");
    let expected = meniscus(folder, &["convert", "in/ball.1.vdb", "--out=expected", "--format=obj"]);
    succeeded(&expected);
    let bytes = |path: &str| fs::read(folder.join(path)).expect("there");
    assert!(bytes("in/ball.1.obj") == bytes("expected/ball.1.obj"));
    // A level set has no particles to count.
    assert!(result.err.contains("converted") && !result.err.contains("particles="), "{}", result.err);
    let status = meniscus(folder, &["status", "--out=in"]);
    let line = status.out.lines().find(|line| line.contains("in/ball.1.vdb: "));
    assert!(line.is_some_and(|line| !line.contains("particle")), "{}", status.out);
    let again = watch(&["--pattern=*.vdb", "--preview=png", "--preview-size=64x64"]);
    assert_eq!(again.status, 0, "{} {}", again.out, again.err);
}

#[test]
fn printed_settings_of_a_level_set_make_the_same_files() {
    let folder = scene();
    let folder = folder.path();
    fs::create_dir(folder.join("balls")).expect("made");
    fs::write(folder.join("balls/ball.vdb"), ball(|distance| (0.1 * distance).clamp(-0.3, 0.3)))
        .expect("written");
    let convert = |more: &[&str]| {
        let options = ["--format=obj", "--offset=0.05", "--smooth-normals=2", "--decimate=0.1"];
        meniscus(folder, &[&["convert", "balls/ball.vdb", "--out=out"], &options[..], more].concat())
    };
    let printed = convert(&["--print-settings"]);
    succeeded(&printed);
    for line in ["pattern = \"*.vdb\"", "offset = 0.05", "smooth_normals = 2", "decimate = 0.1"] {
        assert!(printed.out.lines().any(|printed| printed == line), "{line}: {}", printed.out);
    }
    assert!(!printed.out.contains("radius") && !folder.join("out").exists(), "{}", printed.out);
    let block = format!("[[watch]]\ninput = \"balls\"\noutput = \"watched\"\n{}", printed.out);
    fs::write(folder.join("meniscus.toml"), block).expect("written");
    succeeded(&convert(&[]));
    let watch = ["watch", "--config=meniscus.toml", "--once", "--settle=0ms"];
    let result = meniscus(folder, &watch);
    assert_eq!(result.status, 0, "{}", result.err);
    let bytes = |path: &str| fs::read(folder.join(path)).expect("there");
    assert!(bytes("out/ball.obj") == bytes("watched/ball.obj"));
    // A configuration file has no key for the maximum deviation, and nothing is smoothed without one.
    let smoothed = convert(&["--print-settings", "--max-deviation=1", "--steps=3"]);
    assert!(smoothed.out.contains("\n# ") && smoothed.out.contains("\n#steps = 3\n"), "{}", smoothed.out);
}

/// A ball of 3 units in the middle of a cube of 12.8, as a file with `value` of each distance in voxels.
fn ball(value: impl Fn(f32) -> f32) -> Vec<u8> {
    raw_level_set(0.1, 0.3, |cell| {
        let values: Box<[f32; 512]> = Box::new(std::array::from_fn(|offset| {
            let local = [offset / 64, offset / 8 % 8, offset % 8];
            let square = |axis: usize| (cell[axis] * 8 + local[axis] as i32 - 64).pow(2);
            value(((square(0) + square(1) + square(2)) as f32).sqrt() - 30.0)
        }));
        if values.iter().all(|value| *value == values[0]) {
            Cell::Tile(values[0])
        } else {
            Cell::Leaf(values)
        }
    })
}

const NO_BAND: [fn(f32) -> f32; 3] = [
    // A step function, and distances on one side only.
    |distance| 0.3f32.copysign(distance),
    |distance| if distance < 0.0 { -0.3 } else { (0.1 * distance).min(0.3) },
    |distance| if distance < 0.0 { (0.1 * distance).max(-0.3) } else { 0.3 },
];

#[test]
fn level_set_without_a_band_is_rebuilt_with_a_warning() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    fs::create_dir(folder.join("in")).expect("made");
    let expected = 4.0 / 3.0 * std::f64::consts::PI * 27.0;
    for (index, value) in NO_BAND.into_iter().enumerate() {
        fs::write(folder.join("in/block.vdb"), ball(value)).expect("written");
        for deviation in ["--max-deviation=0", "--max-deviation=1"] {
            let result = convert(folder, &["--format=obj,vdb", deviation]);
            assert_eq!(result.status, 0, "{}", result.err);
            assert!(
                result.err.contains("voxels next to the surface have no distance, only a sign"),
                "{}",
                result.err
            );
            assert!(!result.err.contains("failed validation"), "{}", result.err);
            let mesh = info(folder, "out/block.obj")["mesh"].clone();
            assert_eq!(mesh["boundary_edges"], 0, "{mesh}");
            let volume = number(&mesh["volume"]);
            assert!((volume / expected - 1.0).abs() < 0.03, "{index} {deviation}: {volume} {expected}");
        }
    }
}

#[test]
fn surface_between_tiles_is_rebuilt() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    fs::create_dir(folder.join("in")).expect("made");
    // A cube of 4 × 4 × 4 tiles: its faces lie midway between voxels.
    let is_inside = |cell: [i32; 3]| cell.iter().all(|at| (6..10).contains(at));
    let bytes = raw_level_set(0.1, 0.3, |cell| Cell::Tile(if is_inside(cell) { -0.3 } else { 0.3 }));
    fs::write(folder.join("in/block.vdb"), bytes).expect("written");
    let result = convert(folder, &["--format=obj"]);
    assert_eq!(result.status, 0, "{}", result.err);
    // 4 × 4 × 4 cubes, of which 2 × 2 × 2 are not at the surface, and 4 × 4 beyond each face.
    assert!(result.err.contains("(152 leaf nodes were added there)"), "{}", result.err);
    let mesh = info(folder, "out/block.obj")["mesh"].clone();
    assert_eq!(mesh["boundary_edges"], 0, "{mesh}");
    let volume = number(&mesh["volume"]);
    assert!((volume / 3.2f64.powi(3) - 1.0).abs() < 0.02, "{volume}");
}

#[test]
fn obstacle_without_a_band_leaves_no_hole() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write_ply(&folder.join("block.ply"), &block(12, 0.0125));
    // The block of particles is small, so the ball is small, too: radius 0.3, centre (0.64, 0.64, 0.64).
    for value in NO_BAND {
        let bytes = raw_level_set(0.01, 0.03, |cell| {
            Cell::Leaf(Box::new(std::array::from_fn(|offset| {
                let local = [offset / 64, offset / 8 % 8, offset % 8];
                let square = |axis: usize| (cell[axis] * 8 + local[axis] as i32 - 64).pow(2);
                0.1 * value(((square(0) + square(1) + square(2)) as f32).sqrt() - 30.0)
            })))
        });
        fs::write(folder.join("ball.vdb"), bytes).expect("written");
        let arguments = ["convert", "block.ply", "--out=out", "--format=obj", "--voxel-size=0.05"];
        let result = meniscus(folder, &[&arguments[..], &["--obstacle=ball.vdb"]].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        assert!(
            result.err.contains("voxels next to the surface have no distance, only a sign"),
            "{}",
            result.err
        );
        let mesh = info(folder, "out/block.obj")["mesh"].clone();
        assert_eq!(mesh["boundary_edges"], 0, "{mesh}");
    }
}

#[test]
fn level_set_beyond_the_memory_fails_and_says_how_much_would_do() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    fs::create_dir(folder.join("in")).expect("made");
    // Every eighth leaf has a voxel inside, so that every part of the cube is near a surface.
    let bytes = raw_level_set(0.1, 0.3, |cell| {
        if cell.iter().all(|at| at % 2 == 1) {
            Cell::Leaf(Box::new(std::array::from_fn(|offset| if offset == 292 { -0.05 } else { 0.05 })))
        } else {
            Cell::Tile(0.3)
        }
    });
    fs::write(folder.join("in/block.vdb"), bytes).expect("written");
    // The first limit is too small for reading the file, the second for smoothing. Either error has the
    // memory for both.
    for memory in ["--memory=2MiB", "--memory=16MiB"] {
        let result = convert(folder, &["--format=obj", "--max-deviation=1", memory]);
        assert_eq!(result.status, 2, "{}", result.err);
        let needed = result.err.split("use --memory ").nth(1).and_then(|rest| rest.split(' ').next());
        let needed = needed.unwrap_or_else(|| panic!("{}", result.err));
        succeeded(&convert(folder, &["--format=obj", "--max-deviation=1", &format!("--memory={needed}")]));
    }
    let result = convert(folder, &["--format=obj", "--memory=1MiB"]);
    assert!(result.err.contains("the level set in a file of 2 MiB needs"), "{}", result.err);
}
