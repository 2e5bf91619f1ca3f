//! `--where`: the particles that form the surface, chosen by their attributes.

use std::fmt::Write;
use std::fs;
use std::path::Path;

use serde_json::Value;
use tempfile::{TempDir, tempdir};

use crate::program::scene::{assert_refused, block, meniscus, write_ply};

/// A row of a table: a position, a kind, and a density.
type Row = ([f64; 3], &'static str, f64);

/// A block of fluid, moved along x, on a denser floor.
fn fluid_and_floor(shift: f64) -> Vec<Row> {
    let fluid = block(6, shift).into_iter().map(|at| (at, "fluid", 1000.0));
    let floor =
        block(9, 0.0).into_iter().map(|[x, y, z]| ([0.4 * x, 0.4 * y - 0.4, 0.4 * z], "wall", 1200.0));
    fluid.zip(floor.clone()).flat_map(|(fluid, floor)| [fluid, floor]).chain(floor.skip(216)).collect()
}

fn write_table(path: &Path, rows: &[Row]) {
    let mut text = "x,y,z,phase,rho,mk\n".to_owned();
    for ([x, y, z], phase, density) in rows {
        let mk = if *phase == "fluid" { 1 } else { 11 };
        writeln!(text, "{x},{y},{z},{phase},{density},{mk}").expect("strings take everything");
    }
    fs::write(path, text).expect("written");
}

/// A folder with two mixed frames in `mixed`, and the same frames of the fluid alone in `alone`.
fn scene() -> TempDir {
    let folder = tempdir().expect("a folder");
    for name in ["mixed", "alone"] {
        fs::create_dir(folder.path().join(name)).expect("made");
    }
    for number in [1, 2] {
        let name = format!("dam.{number}.csv");
        let rows = fluid_and_floor(0.03 * f64::from(number));
        write_table(&folder.path().join("mixed").join(&name), &rows);
        let fluid: Vec<Row> = rows.into_iter().filter(|(_, phase, _)| *phase == "fluid").collect();
        write_table(&folder.path().join("alone").join(&name), &fluid);
    }
    folder
}

/// The surface in an .obj, without the comments, which contain the provenance.
fn surface_in(obj: &Path) -> Vec<String> {
    let text = fs::read_to_string(obj).unwrap_or_else(|error| panic!("{}: {error}", obj.display()));
    text.lines().filter(|line| !line.starts_with('#')).map(str::to_owned).collect()
}

fn report_in(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).expect("written")).expect("JSON")
}

#[test]
fn chosen_particles_give_the_surface_of_a_file_with_only_them() {
    let scene = scene();
    let folder = scene.path();
    let convert = |input: &str, out: &str, more: &[&str]| {
        let arguments = ["convert", input, "--out", out, "--format", "obj", "--report", "report.json"];
        let result = meniscus(folder, &[&arguments[..], more].concat());
        assert_eq!(result.status, 0, "{more:?}: {}", result.err);
        (result, report_in(&folder.join("report.json")))
    };
    // Pictures would make the bounds of the frames matter; attributes change the .obj.
    let attributes = ["--attributes", "rho"];
    let (_, alone) = convert("alone", "alone/out", &attributes);
    for condition in ["phase == fluid", "rho < 1100", "not mk in 11, 12", "phase != wall and mk <= 1"] {
        let more = [&["--where", condition][..], &attributes].concat();
        let (result, chosen) = convert("mixed", "mixed/out", &more);
        assert!(!result.err.contains("become one surface"), "{}", result.err);
        for name in ["dam.1.obj", "dam.2.obj"] {
            let [expected, found] =
                ["alone/out", "mixed/out"].map(|out| surface_in(&folder.join(out).join(name)));
            assert!(expected.len() > 500 && expected == found, "{condition}: {name}");
        }
        assert_eq!(chosen["settings"][0]["spacing"], alone["settings"][0]["spacing"]);
        assert_eq!(chosen["settings"][0]["more"]["where"], condition);
        assert_eq!(chosen["frames"][1]["particles"], 216);
    }
    // The condition is recorded in the file, and another one makes the file stale.
    let obj = fs::read_to_string(folder.join("mixed/out/dam.1.obj")).expect("written");
    assert!(obj.contains("# meniscus_where: phase != wall and mk <= 1\n"));
    let skip = |condition: &str| {
        let more = [&["--where", condition, "--skip-done"][..], &attributes].concat();
        convert("mixed", "mixed/out", &more).1["frames"][0]["status"].clone()
    };
    assert_eq!(skip("phase != wall and mk <= 1"), "already_done");
    assert_eq!(skip("phase == fluid"), "converted");

    // A folder that is watched, with the condition in a file.
    let config = "[[watch]]\ninput = \"mixed\"\noutput = \"watched\"\nformats = [\"obj\"]\npattern = \"*.csv\"\n\
                  where = \"phase == 'fluid'\"\nattributes = \"rho\"\n";
    fs::write(folder.join("m.toml"), config).expect("written");
    let watched = meniscus(folder, &["watch", "--config", "m.toml", "--once"]);
    assert_eq!(watched.status, 0, "{}", watched.err);
    let [expected, found] =
        ["alone/out", "watched"].map(|out| surface_in(&folder.join(out).join("dam.1.obj")));
    assert!(expected == found, "the watched frame differs");
}

#[test]
fn several_kinds_cause_one_warning_and_are_listed() {
    let scene = scene();
    let folder = scene.path();
    let plain = meniscus(folder, &["convert", "mixed", "--out", "o", "--format", "ply"]);
    assert_eq!(plain.status, 0, "{}", plain.err);
    let warning = "the attribute `phase` has 2 values (fluid, wall), and particles with any of them become one \
                   surface; choose some with --where, such as --where 'phase == VALUE'";
    assert_eq!(plain.err.matches(warning).count(), 1, "{}", plain.err);
    let alone = meniscus(folder, &["convert", "alone", "--out", "o", "--format", "ply"]);
    assert!(!alone.err.contains("become one surface"), "{}", alone.err);
    let info = meniscus(folder, &["info", "mixed/dam.1.csv"]).out;
    assert!(info.contains("phase: string × 1, kind, 2 distinct: 216 × fluid, 729 × wall"), "{info}");
    assert!(info.contains("mk: i32 × 1, 1 to 11: 216 × 1, 729 × 11"), "{info}");
    let json = meniscus(folder, &["info", "--json", "mixed/dam.1.csv"]).out;
    let json: Value = serde_json::from_str(&json).expect("JSON");
    let attributes = json[0]["particles"]["attributes"].as_array().expect("attributes");
    assert_eq!(attributes[0]["counts"][1], serde_json::json!({ "value": "wall", "count": 729 }));
}

#[test]
fn unsuitable_conditions_are_named_with_what_exists() {
    let scene = scene();
    let folder = scene.path();
    let refuse = |condition: &str, words: &[&str]| {
        assert_refused(folder, &["convert", "mixed", "--out", "o", "--where", condition], words);
    };
    refuse("phase = 0", &["--where", "`phase = 0` is not a condition", "at character 7, found `=`"]);
    refuse("phase ==", &["expected a number or a text at its end"]);
    let fail = |condition: &str, word: &str| {
        for spacing in [&[][..], &["--spacing", "0.1"]] {
            let typed = ["convert", "mixed", "--out", "o", "--where", condition];
            let result = meniscus(folder, &[&typed[..], spacing].concat());
            assert!(matches!(result.status, 1 | 2), "{condition}: {}", result.out);
            assert!(result.err.contains(word), "{condition}: {}", result.err);
        }
    };
    fail("material == 1", "the particles have no attribute `material`; available: phase, rho, mk");
    fail("mk == fluid", "the attribute `mk` has numbers, so it cannot be compared with the text `fluid`");
    // No particle is chosen: nothing to measure, or an empty frame.
    let none = ["convert", "mixed", "--out", "o", "--format", "ply", "--where", "mk > 100"];
    let result = meniscus(folder, &none);
    assert_eq!(result.status, 2, "{}", result.err);
    assert!(result.err.contains("because no particle meets the condition \"mk > 100\""), "{}", result.err);
    let result = meniscus(folder, &[&none[..], &["--spacing", "0.1"]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    let warning = "none of the 945 particles meets the condition \"mk > 100\": the frame is empty";
    assert!(result.err.contains(warning), "{}", result.err);
}

#[test]
fn chosen_particles_are_written_without_a_surface() {
    let scene = scene();
    let folder = scene.path();
    let typed =
        ["convert", "mixed", "--out", "o", "--particles-only", "--format", "ply", "--where", "mk == 1"];
    let result = meniscus(folder, &typed);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.out.contains("dam.1.csv: 216 particles"), "{}", result.out);
    let again = meniscus(folder, &[&typed[..], &["--skip-done"]].concat());
    assert_eq!(again.out.matches(": done already").count(), 2, "{}", again.out);
}

/// Writes binary PLY whose records are so long that the file is read in batches.
fn write_long_records(path: &Path, particles: &[([f64; 3], i32)]) {
    const PADDING: usize = 140;
    let padding: String = (0..PADDING).map(|index| format!("property double pad_{index}\n")).collect();
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\n\
         property float z\nproperty int phase\n{padding}end_header\n",
        particles.len()
    )
    .into_bytes();
    for (position, phase) in particles {
        bytes.extend(position.iter().flat_map(|&along| (along as f32).to_le_bytes()));
        bytes.extend(phase.to_le_bytes());
        bytes.extend([0; 8 * PADDING]);
    }
    assert!(bytes.len() > 16 << 20, "{} bytes are read whole", bytes.len());
    fs::write(path, bytes).expect("written");
}

#[test]
fn file_in_batches_and_tiles_gives_the_surface_of_the_chosen_particles() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    let corners = [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [0.1, 0.1]];
    let rod = (0..600).flat_map(|index| corners.map(|[x, y]| [x, y, 0.1 * f64::from(index)]));
    let rod: Vec<([f64; 3], i32)> = rod.map(|at| (at, 0)).collect();
    // Some batches have particles of both kinds, and most have none of the rod.
    let wall: Vec<([f64; 3], i32)> = block(24, -3.0).into_iter().map(|at| (at, 2)).collect();
    write_long_records(&folder.join("mixed.ply"), &[&wall[..9000], &rod[..], &wall[9000..]].concat());
    write_ply(&folder.join("alone.ply"), &rod.iter().map(|(at, _)| *at).collect::<Vec<_>>());
    let convert = |input: &str, out: &str, more: &[&str]| {
        let typed = ["convert", input, "--out", out, "--voxel-size", "0.05", "--format", "obj"];
        meniscus(folder, &[&typed[..], more].concat())
    };
    let alone = convert("alone.ply", "o", &[]);
    assert_eq!((alone.status, &*alone.err), (0, ""));
    let expected = surface_in(&folder.join("o/alone.obj"));
    let chosen = ["--where", "phase in 0, 1"];
    let whole = convert("mixed.ply", "o", &chosen);
    assert_eq!((whole.status, &*whole.err), (0, ""), "{}", whole.out);
    assert!(expected.len() > 1000 && surface_in(&folder.join("o/mixed.obj")) == expected, "in batches");
    let refused = convert("mixed.ply", "o", &[&chosen[..], &["--memory", "1MiB"]].concat());
    let needed =
        refused.err.split("the frame needs at least ").nth(1).and_then(|rest| rest.split(' ').next());
    let memory = format!("{}MiB", needed.unwrap_or_else(|| panic!("{}", refused.err)));
    let tiled = convert("mixed.ply", "tiled", &[&chosen[..], &["--memory", &memory]].concat());
    assert!(tiled.status == 0 && tiled.err.contains("processed in tiles"), "{}", tiled.err);
    assert!(surface_in(&folder.join("tiled/mixed.obj")) == expected, "in tiles");
    // The kinds are found in batches, too, and so are errors.
    let all = convert("mixed.ply", "all", &[]);
    assert!(all.err.contains("the attribute `phase` has 2 values (0, 2)"), "{}", all.err);
    let missing = convert("mixed.ply", "all", &["--where", "mk == 1", "--spacing", "0.1"]);
    assert_eq!(missing.status, 2, "{}", missing.out);
    assert!(missing.err.contains("no attribute `mk`; available: phase, pad"), "{}", missing.err);
    let none = convert("mixed.ply", "none", &["--where", "phase == 7", "--spacing", "0.1"]);
    assert!(none.status == 0 && none.err.contains("none of the 16224 particles meets"), "{}", none.err);
}

/// Solvers put inactive particles at one place: a warning names it, and a condition on positions leaves them out.
#[test]
fn particles_at_one_position_are_named_and_left_out() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for parked in [[0.0; 3], [-1e4, 0.5, 0.1]] {
        let positions = block(8, 0.05).into_iter().chain(std::iter::repeat_n(parked, 60));
        write_ply(&path.join("f.ply"), &positions.collect::<Vec<_>>());
        let convert = ["convert", "f.ply", "-o", "f.obj", "--spacing", "0.1"];
        let result = meniscus(path, &convert);
        let words = "60 of 572 particles have the same position, ";
        assert!(meniscus(path, &["info", "f.ply"]).out.contains(words));
        let found = result.err.split(words).nth(1).unwrap_or_else(|| panic!("{}", result.err));
        let condition = found.split('\'').nth(1).unwrap_or_else(|| panic!("{found}"));
        let result = meniscus(path, &[&convert[..], &["--where", condition]].concat());
        assert!(result.status == 0 && result.out.contains("512 particles"), "{condition}: {}", result.out);
        assert!(!result.err.contains("inactive"), "{}", result.err);
    }
}

/// Also if there are few of them, spread over the frame or together in the middle of it.
#[test]
fn few_particles_at_one_position_are_found() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for is_spread in [true, false] {
        let mut positions: Vec<[f64; 3]> = block(25, 0.0);
        for index in 0..120 {
            positions.insert(if is_spread { 128 * index } else { 8000 }, [0.0, -0.0, 0.0]);
        }
        write_ply(&path.join("f.ply"), &positions);
        let result = meniscus(path, &["info", "f.ply"]);
        assert!(
            result.out.contains("of 15745 particles have the same position, (0, 0, 0)"),
            "{}",
            result.out
        );
    }
}

/// Results of one kind of particles are not replaced by those of another without a word.
#[test]
fn results_of_another_condition_are_replaced_with_a_warning() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let rows: String =
        block(6, 0.1).iter().map(|[x, y, z]| format!("{x},{y},{z},{}\n", i32::from(*x > 0.2))).collect();
    fs::write(path.join("f.1.csv"), format!("x,y,z,kind\n{rows}")).expect("written");
    let convert = |condition: &str| {
        let typed = ["convert", "f.1.csv", "--out", "out", "--format", "obj", "--spacing", "0.1"];
        let result = meniscus(path, &[&typed[..], &["--where", condition]].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        result.err
    };
    assert!(!convert("kind == 1").contains("is replaced"));
    assert!(!convert("kind == 1").contains("is replaced"));
    let warning = convert("kind == 0");
    assert!(
        warning.contains(
            "f.1 was made with --where 'kind == 1', and its results of the same formats are replaced"
        ),
        "{warning}"
    );
    let watched = meniscus(
        path,
        &[
            "watch",
            ".",
            "--out",
            "out",
            "--pattern",
            "f.*.csv",
            "--once",
            "--settle",
            "10ms",
            "--where",
            "kind == 1",
            "--spacing",
            "0.1",
        ],
    );
    assert!(watched.err.contains("f.1 was made with --where 'kind == 0'"), "{}{}", watched.out, watched.err);
}

#[test]
fn results_of_several_conditions_under_their_own_names_are_up_to_date() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for frame in 1..=2 {
        let rows: String =
            block(6, 0.1).iter().map(|[x, y, z]| format!("{x},{y},{z},{}\n", i32::from(*x > 0.2))).collect();
        fs::write(path.join(format!("f.{frame}.csv")), format!("x,y,z,kind\n{rows}")).expect("written");
    }
    for (name, condition) in [("solid", "kind == 0"), ("fluid", "kind == 1")] {
        let out = format!("out/{name}.####.obj");
        let typed =
            ["convert", "f.1.csv", "f.2.csv", "--out", &out, "--spacing", "0.1", "--where", condition];
        let result = meniscus(path, &typed);
        assert_eq!(result.status, 0, "{}", result.err);
    }
    for input in [&[][..], &["--input", "f.1.csv", "--input", "f.2.csv"]] {
        let result = meniscus(path, &[&["verify", "out"], input].concat());
        assert_eq!(result.status, 0, "{}{}", result.out, result.err);
        assert!(result.out.contains("4 frames: 4 done"), "{}", result.out);
    }
}
