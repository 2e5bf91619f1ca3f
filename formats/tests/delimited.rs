//! Delimited text: compares every file in `corpus/delimited/{valid,invalid}` with the description next to it.
//!
//! To add a case, add a file. Run once with `MENISCUS_BLESS=1` to write its description, and review that
//! before committing it.

#![expect(clippy::cast_possible_truncation, reason = "the tests check narrowing")]

use meniscus_formats::{Error, FileAttribute, FilePositions, Limits, ParticleFrame, Values, csv};
use std::fmt::{Debug, Write};
use std::path::{Path, PathBuf};

#[test]
fn valid_files_match_their_descriptions() {
    for path in corpus("valid") {
        let bytes = std::fs::read(&path).unwrap();
        let frame = csv::read(&bytes, &Limits::default()).unwrap_or_else(|error| panic!("{path:?}: {error}"));
        compare(&path, &describe(&frame));
    }
}

#[test]
fn invalid_files_match_their_error_messages() {
    for path in corpus("invalid") {
        let bytes = std::fs::read(&path).unwrap();
        match csv::read(&bytes, &Limits::default()) {
            Ok(frame) => panic!("{path:?} was read: {}", describe(&frame)),
            Err(error) => compare(&path, &format!("{error}\n")),
        }
    }
}

fn corpus(promise: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus/delimited").join(promise);
    let paths = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut paths: Vec<PathBuf> = paths.filter(|path| path.extension().unwrap() != "expected").collect();
    paths.sort();
    paths
}

fn compare(path: &Path, found: &str) {
    let expected_path = PathBuf::from(format!("{}.expected", path.display()));
    if std::env::var_os("MENISCUS_BLESS").is_some() {
        std::fs::write(&expected_path, found).unwrap();
    }
    let expected = std::fs::read_to_string(&expected_path).unwrap_or_default();
    assert_eq!(found, expected, "{path:?}; MENISCUS_BLESS=1 accepts the result");
}

/// Describes a frame in a few lines for review.
fn describe(frame: &ParticleFrame) -> String {
    let mut text = match &frame.positions {
        FilePositions::F32(positions) => format!("F32 {positions:?}\n"),
        FilePositions::F64(positions) => format!("F64 {positions:?}\n"),
    };
    for FileAttribute { name, arity, role, values } in &frame.attributes {
        let role = role.map_or(String::new(), |role| format!(" ({role:?})"));
        writeln!(text, "{name}: {arity}{role} {}", describe_values(values)).unwrap();
    }
    for note in &frame.notes {
        writeln!(text, "note: {note}").unwrap();
    }
    text
}

fn describe_values(values: &Values) -> String {
    fn list(name: &str, values: &[impl Debug]) -> String {
        format!("{name} {values:?}")
    }
    match values {
        Values::F32(values) => list("F32", values),
        Values::F64(values) => list("F64", values),
        Values::U8(values) => list("U8", values),
        Values::I32(values) => list("I32", values),
        Values::I64(values) => list("I64", values),
        Values::Strings { table, indices } => format!("{} of {table:?}", list("Strings", indices)),
    }
}

#[test]
fn comment_with_too_many_words_is_not_a_header() {
    for words in ["word ", "word,", "x y z "] {
        let text = format!("# {}\n# x y z mass\n1 2 3 4\n", words.repeat(5000));
        let frame = csv::read(text.as_bytes(), &Limits::default()).unwrap();
        assert_eq!((frame.positions.len(), frame.attributes[0].name.as_str()), (1, "mass"));
        let text = format!("x,y,z\n# {}\n1,2,3\n#{}", words.repeat(5000), words.repeat(5000));
        assert_eq!(csv::read(text.as_bytes(), &Limits::default()).unwrap().positions.len(), 1);
    }
}

#[test]
fn rows_columns_and_head_beyond_limits_are_an_error() {
    let mut wide = String::from("x,y,z");
    wide += &",a".repeat(5000);
    let long_head = "# no table\n".repeat(200_000);
    let long_line = "a".repeat(3 << 20);
    let table = [
        ("rows", "x,y,z\n1,2,3\n4,5,6\n7,8,9\n", "more rows than the limit of 2"),
        ("columns", wide.as_str(), "columns, more than the limit of 4096"),
        ("columns of numbers", &"1,".repeat(5000), "columns, more than the limit of 4096"),
        ("head", &long_head, "no row ends in the first 1048576 bytes"),
        ("line", &long_line, "no row ends in the first 1048576 bytes"),
    ];
    let limits = Limits { particle_count: 2, ..Limits::default() };
    for (case, text, expected) in table {
        let error = csv::read(text.as_bytes(), &limits).expect_err(case);
        assert!(matches!(error, Error::TooLarge { .. }), "{case}: {error}");
        assert!(error.to_string().contains(expected), "{case}: {error}");
    }
}

#[test]
fn floats_have_64_bits_for_any_number_of_digits() {
    let value = |index: i32| f64::from(index).sin() * 10f64.powi(index % 7 - 3);
    type Print = fn(f64) -> String;
    let cases: [(&str, Print); 4] = [
        ("shortest f32", |v| format!("{}", v as f32)),
        ("7 digits", |v| format!("{v:.6e}")),
        ("shortest f64", |v| format!("{v}")),
        ("19 digits", |v| format!("{v:.18e}")),
    ];
    for (case, print) in cases {
        let mut text = String::from("x,y,z,a\n");
        for index in 0..2000 {
            let [x, y, z, a] = [0, 1, 2, 3].map(|k| print(value(4 * index + k)));
            writeln!(text, "{x},{y},{z},{a}").unwrap();
        }
        let frame = csv::read(text.as_bytes(), &Limits::default()).unwrap();
        assert!(matches!(frame.attributes[0].values, Values::F64(_)), "{case}");
        let FilePositions::F64(positions) = frame.positions else { panic!("{case}: not 64 bits") };
        for (index, &found) in positions.as_flattened().iter().enumerate() {
            let index = i32::try_from(index / 3 * 4 + index % 3).unwrap();
            assert_eq!(found, print(value(index)).parse::<f64>().unwrap(), "{case}, value {index}");
        }
    }
}

#[test]
fn digits_of_one_particle_do_not_change_other_particles() {
    let read = |last: &str| {
        let text = format!("x,y,z,radius,id\n0.1,0.2,0.3,0.05,1\n0.7,0.11,0.13,0.025,2\n{last}\n");
        let frame = csv::read(text.as_bytes(), &Limits::default()).expect("a table");
        let FilePositions::F64(positions) = frame.positions else { panic!("not 64 bits") };
        let Values::F64(radii) = &frame.attributes[0].values else { panic!("not 64 bits") };
        (positions[..2].to_vec(), radii[..2].to_vec())
    };
    let short = read("9.5,9.5,9.5,0.05,3");
    assert_eq!(read("9.500000123456,9.5,9.5,0.05,3"), short);
    assert_eq!(read("9,9,9,0.0512345678901,3"), short);
}

#[test]
fn integers_are_exact_or_rounded_with_a_note() {
    let read = |ids: &[&str]| {
        let rows: String = ids.iter().map(|id| format!("0,0,0,{id}\n")).collect();
        let text = format!("x,y,z,id\n{rows}");
        let mut frame = csv::read(text.as_bytes(), &Limits::default()).expect("a table");
        (frame.attributes.remove(0).values, frame.notes)
    };
    let all = [i64::MIN, i64::MIN + 1, -1, i64::MAX - 1, i64::MAX];
    let (values, notes) = read(&all.map(|id| id.to_string()).each_ref().map(String::as_str));
    assert_eq!((values, notes), (Values::I64(all.into()), vec![]));
    let expected_notes = ["integers of \"id\" are rounded: some exceed 64 bits, so all become 64-bit floats"];
    let power = 2f64.powi(63);
    for (ids, expected) in [
        (["9223372036854775807", "9223372036854775809"], [power, power]),
        (["9223372036854775808", "9223372036854777857"], [power, power + 2048.0]),
        (["-9223372036854775809", "+18446744073709551615"], [-power, 2.0 * power]),
        (["9007199254740993", "0.5"], [9_007_199_254_740_992.0, 0.5]),
        (["", "\"9007199254740993\""], [f64::NAN, 9_007_199_254_740_992.0]),
        (["1", "100000000000000000000000000000000000000001"], [1.0, 1e41]),
    ] {
        let (values, notes) = read(&ids);
        assert_eq!(format!("{values:?}"), format!("{:?}", Values::F64(expected.into())), "{ids:?}");
        assert_eq!(notes, expected_notes, "{ids:?}");
    }
    // Integers that floats represent exactly are not reported as rounded.
    for ids in [["9007199254740992", "0.5"], ["36893488147419103232", "1"], ["0", "12345678901234567.5"]] {
        assert_eq!(read(&ids).1, [""; 0], "{ids:?}");
    }
}

#[test]
#[expect(clippy::print_stderr, reason = "a test that did not run must say so")]
fn files_of_other_programs_are_read() {
    let root = std::env::var_os("MENISCUS_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared")), PathBuf::from);
    let table = [
        ("third-party/splashsurf/double_dam_break_frame_26_4732_particles.csv", 4732, ""),
        ("ours/csv/vtkDelimitedTextWriter.csv", 64, "velocity radius id"),
    ];
    for (path, count, names) in table {
        let Ok(bytes) = std::fs::read(root.join("data").join(path)) else {
            eprintln!("not tested, file missing: {path}");
            continue;
        };
        let frame = csv::read(&bytes, &Limits::default()).unwrap_or_else(|error| panic!("{path}: {error}"));
        assert_eq!(frame.positions.len(), count, "{path}");
        assert!(matches!(frame.positions, FilePositions::F64(_)), "{path}");
        assert_eq!(frame.notes, Vec::<String>::new(), "{path}");
        let found_names: Vec<&str> = frame.attributes.iter().map(|a| a.name.as_str()).collect();
        assert_eq!(found_names.join(" "), names, "{path}");
    }
}

/// The frame of a text with new names for columns, given as `x=a,y=b`.
fn read_named(text: &str, names: &str) -> Result<String, String> {
    let pairs = names.split(',').map(|pair| pair.split_once('=').unwrap());
    let pairs: Vec<_> = pairs.map(|(new, column)| (new.to_owned(), column.to_owned())).collect();
    let frame = csv::read_named(text.as_bytes(), &pairs, &Limits::default());
    frame.map(|frame| describe(&frame)).map_err(|error| error.to_string())
}

#[test]
fn columns_get_new_names() {
    let expected = read_named("x,y,z,radius\n1.5,2,3,4\n5,6,7,8\n", "x=x").unwrap();
    for (text, names) in [
        ("a,b,c,r\n1.5,2,3,4\n5,6,7,8\n", "x=a,y=b,z=c,radius=r"),
        ("A [m];\"b\";c (m);d\n1.5;2;3;4\n5;6;7;8\n", "x=a,y=B,z=c,radius=d"),
        ("a b c d\n1.5 2 3 4\n5 6 7 8\n", "x=1,y=2,z=3,radius=4"),
        ("# made by hand\n1.5 2 3 4\n5 6 7 8\n", "x=1,y=2,z=3,radius=4"),
        ("# a b c d\n1.5 2 3 4\n5 6 7 8\n", "x=a,y=b,z=c,radius=d"),
    ] {
        assert_eq!(read_named(text, names).as_ref(), Ok(&expected), "{text} {names}");
    }
    // Lines above the columns are skipped with a note.
    for (above, names, count) in [
        ("0,1,2,3", "x=1,y=2,z=3,radius=4", "a line"),
        ("[Name]\nWater\n\na,b,c,d", "x=a,y=b,z=c,radius=d", "2 lines"),
    ] {
        let text = format!("{above}\n1.5,2,3,4\n5,6,7,8\n");
        let found = read_named(&text, names).unwrap();
        assert!(
            found.starts_with(&*expected) && found.contains(&format!("skipped {count} above")),
            "{found}"
        );
    }
    // Names that other columns had before.
    let found = read_named("x,y,z,cx,cy,cz\n9,9,9,1,2,3\n8,8,8,4,5,6\n", "x=cx,y=cy,z=cz").unwrap();
    assert!(found.starts_with("F64 [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]"), "{found}");
    assert!(found.contains("column: 3 I32 [9, 9, 9, 8, 8, 8]"), "{found}");
    // Some of them, where the others have the usual names.
    let found = read_named("ID,X,Y,Z\n7,1,2,3\n8,4,5,6\n", "y=Z,z=Y").unwrap();
    assert!(found.starts_with("F64 [[1.0, 3.0, 2.0], [4.0, 6.0, 5.0]]"), "{found}");
    // An unclear first column is no position if the position is named.
    let rows = "4 1 1 1\n2 1 1 2\n3 2 1 1\n1 2 2 2\n";
    let found = read_named(rows, "id=1,x=2,y=3,z=4").unwrap();
    assert!(found.contains("id: 1 (Id)"), "{found}");
    for (text, names, words) in [
        ("a,b,c\n1,2,3\n", "x=a,y=b,z=d", "there is no column `d`, which --columns names; found a, b, c"),
        (
            "a,b,c\n1,2,3\n",
            "x=a",
            "--columns names x, and no column is y and z: name x, y and z; found a, b, c",
        ),
        ("a,b,c\n1,2,3\n", "radius=a", "--columns names no x, y and z"),
        ("a,b,c\n1,2,3\n", "x=a,y=a,z=b", "--columns names the column `a` twice, x and y"),
        ("a,b,c\n1,2,3\n", "x=a,y=2,z=b", "--columns names the column `b` twice, y and z"),
        ("id,cx,cy,cz\n1,2,3,4\n", "z=id", "--columns names z, and no column is x and y"),
        ("id,cx,cy,cz\n1,2,3,4\n", "y=cz,z=cy", "--columns names y and z, and no column is x"),
        ("1,2,3\n4,5,6\n", "radius=4", "there is no column `4`"),
    ] {
        let error = read_named(text, names).unwrap_err();
        assert!(error.contains(words), "{error}");
    }
}
