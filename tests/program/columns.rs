//! `--columns`: tables whose columns have unusual names or none, and tables beside them that are no frames.

use std::fmt::Write;
use std::fs;
use std::path::Path;

use tempfile::{TempDir, tempdir};

use crate::program::scene::{assert_refused, block, meniscus, names_in, write_ply};

const NAMED: &str = "x=alpha,y=gamma,z=3,radius=5";

fn write_table(path: &Path, header: &str, rows: impl Iterator<Item = String>) {
    let mut text = format!("{header}\n");
    rows.for_each(|row| writeln!(text, "{row}").expect("strings take everything"));
    fs::write(path, text).expect("written");
}

/// A folder with two frames in `odd`, beside a table of a gauge, and the same frames with usual names in `usual`.
fn scene() -> TempDir {
    let folder = tempdir().expect("a folder");
    for name in ["odd", "usual"] {
        fs::create_dir(folder.path().join(name)).expect("made");
    }
    for number in [1, 2] {
        let particles = block(5, 0.03 * f64::from(number));
        let name = format!("dam.{number}.csv");
        let odd = particles.iter().map(|[x, y, z]| format!("7,{x},{z},{y},0.05"));
        write_table(&folder.path().join("odd").join(&name), "n,alpha,beta,gamma,delta", odd);
        let usual = particles.iter().map(|[x, y, z]| format!("{x},{y},{z},7,0.05"));
        write_table(&folder.path().join("usual").join(&name), "x,y,z,n,radius", usual);
    }
    let gauge = (0..9).map(|time| format!("0.{time},{},3,1,2", 100 + time));
    write_table(&folder.path().join("odd").join("gauge.csv"), "t,p,q,r,s", gauge);
    folder
}

#[test]
fn named_columns_give_the_surface_of_usual_names() {
    let scene = scene();
    let convert = |input: &str, more: &[&str]| {
        let out = format!("{input}_out");
        let arguments = ["convert", input, "--out", &out, "--format", "obj", "--radius-attribute", "radius"];
        let result = meniscus(scene.path(), &[&arguments[..], more].concat());
        assert_eq!(result.status, 0, "{input}: {}", result.err);
        let surface = |number: u32| {
            let path = scene.path().join(&out).join(format!("dam.{number}.obj"));
            let text =
                fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            text.lines().filter(|line| !line.starts_with('#')).map(str::to_owned).collect::<Vec<_>>()
        };
        ([surface(1), surface(2)], result.out)
    };
    let (usual, _) = convert("usual", &[]);
    let (odd, said) = convert("odd", &["--columns", NAMED]);
    assert_eq!(odd, usual);
    assert!(said.contains("skipped gauge.csv: a table without particles"), "{said}");
    let names = names_in(&scene.path().join("odd_out"));
    assert!(!names.iter().any(|name| name.starts_with("gauge")), "{names:?}");
}

#[test]
fn errors_propose_the_option_and_say_what_is_missing() {
    let scene = scene();
    let folder = scene.path();
    write_ply(&folder.join("block.ply"), &block(4, 0.0));
    let convert = ["convert", "odd/dam.1.csv", "--out", "out"];
    assert_refused(
        folder,
        &convert,
        &["--columns x=NAME,y=NAME,z=NAME", "line 1", "n, alpha, beta, gamma, delta"],
    );
    let more = |more: &'static str| [&convert[..], &["--columns", more]].concat();
    assert_refused(folder, &more("x=alpha,y=beta,z=omega"), &["no column `omega`", "found n, alpha, beta"]);
    assert_refused(folder, &more("x=2,y=3,z=6"), &["no column `6`"]);
    assert_refused(folder, &more("x=alpha"), &["--columns names x, and no column is y and z"]);
    assert_refused(folder, &more("x=alpha,x=beta,y=n"), &["has the name `x` twice"]);
    let described = meniscus(folder, &["info", "odd/dam.1.csv", "--columns", "x=alpha,y=beta,z=gamma"]);
    assert!(
        described.status == 0 && described.out.contains("particles"),
        "{}{}",
        described.out,
        described.err
    );
    assert_refused(folder, &more("x=alpha,y"), &["x=centroid_x"]);
    // Other files may be beside tables.
    let ply = ["convert", "block.ply", "--out", "out", "--columns", "x=1,y=2,z=3"];
    let ply = meniscus(folder, &ply);
    assert!(ply.status == 0 && ply.err.contains("--columns is ignored"), "{}{}", ply.out, ply.err);
    fs::write(folder.join("block.json"), r#"{"x": [0, 1, 2], "y": [0, 1, 0], "z": [0, 0, 1]}"#)
        .expect("written");
    assert_refused(
        folder,
        &["convert", "block.json", "--out", "out", "--columns", "x=y,y=x,z=z"],
        &["--columns renames columns of tables"],
    );
    // A folder of files that are not read: the message names one.
    fs::create_dir(folder.join("molecules")).expect("made");
    fs::write(folder.join("molecules/a.0001.xtc"), [0, 0, 7, 203, 0, 0, 0, 9, 0, 0, 0, 1]).expect("written");
    assert_refused(
        folder,
        &["convert", "molecules", "--out", "out"],
        &["no frames of particles", "a.0001.xtc: "],
    );
}

#[test]
fn tables_beside_numbered_folders_and_level_sets_are_no_frames() {
    let scene = scene();
    let folder = scene.path();
    fs::create_dir_all(folder.join("foam/0.5")).expect("made");
    fs::copy(folder.join("odd/gauge.csv"), folder.join("foam/residuals.csv")).expect("copied");
    write_ply(&folder.join("foam/0.5/cloud.ply"), &block(4, 0.0));
    let result = meniscus(folder, &["convert", "foam", "--out", "sets", "--format", "vdb"]);
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
    assert!(result.out.contains("skipped residuals.csv: a table without particles"), "{}", result.out);
    fs::copy(folder.join("odd/gauge.csv"), folder.join("sets/stats.csv")).expect("copied");
    let result = meniscus(folder, &["render", "sets", "--out", "pictures", "--size", "64x48"]);
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
    assert_eq!(names_in(&folder.join("pictures")).len(), 1);
    // A folder with nothing else: the error says what was expected.
    fs::create_dir(folder.join("alone")).expect("made");
    fs::copy(folder.join("odd/gauge.csv"), folder.join("alone/gauge.csv")).expect("copied");
    assert_refused(folder, &["convert", "alone", "--out", "out"], &["gauge.csv", "--columns"]);
}
