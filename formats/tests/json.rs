//! JSON: where positions are found, and what is wrong with other texts.

use meniscus_formats::{
    AttributeRole, FileAttribute, FilePositions, Limits, ParticleFrame, Result, Values, read_particles,
};

use crate::fixtures::{LISTS, RECORDS};

fn read(text: &str) -> Result<ParticleFrame> {
    read_particles(text.as_bytes(), "a.json", &Limits::default())
}

fn positions(text: &str) -> Vec<[f64; 3]> {
    match read(text).unwrap_or_else(|error| panic!("{text}: {error}")).positions {
        FilePositions::F64(positions) => positions,
        FilePositions::F32(positions) => panic!("{text}: 32 bits: {positions:?}"),
    }
}

fn attribute<'a>(frame: &'a ParticleFrame, name: &str) -> &'a FileAttribute {
    let found = frame.attributes.iter().find(|attribute| attribute.name == name);
    found.unwrap_or_else(|| panic!("{name} in {:?}", frame.attributes))
}

/// The texts that splashsurf documents and writes, and other spellings of the same.
#[test]
fn positions_are_found_in_every_form() {
    let expected = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.5]];
    for text in [
        "[[1.0, 2.0, 3.0], [4.0, 5.0, 6.5]]",
        "[[1.0,2.0,3.0],[4.0,5.0,6.5]]",
        "\u{feff}\n[\n  [\n    1,\n    2e0,\n    3\n  ], [ 4.0 ,5.0, 65e-1 ] ]\r\n",
        r#"{"positions": [[1, 2, 3], [4, 5, 6.5]]}"#,
        r#"{"P": [[1, 2, 3], [4, 5, 6.5]]}"#,
        r#"{"time": 0, "particles": [[1, 2, 3], [4, 5, 6.5]]}"#,
        r#"{"particles": [{"x": 1, "y": 2, "z": 3}, {"z": 6.5, "y": 5, "x": 4}]}"#,
        r#"[{"position": [1, 2, 3]}, {"position": [4, 5, 6.5]}]"#,
        r#"{"x": [1, 4], "y": [2, 5], "z": [3, 6.5]}"#,
        r#"{"positions": [1, 2, 3, 4, 5, 6.5], "p": [0.5, 0.25]}"#,
        r#"{"pos_x": [1, 4], "pos_y": [2, 5], "pos_z": [3, 6.5]}"#,
    ] {
        assert_eq!(positions(text), expected, "{text}");
    }
    for text in ["[]", r#"{"positions": []}"#, r#"{"particles": [], "v": []}"#] {
        assert!(read(text).unwrap().positions.is_empty(), "{text}");
    }
    assert_eq!(positions("[[1e6, 0.1, 9007199254740993]]"), [[1e6, 0.1, 9_007_199_254_740_992.0]]);
    assert_eq!(
        positions("[[2.2250738585072014e-308, -0.30000000000000004, 123456789012345678901]]").len(),
        1
    );
    assert_eq!(positions("[[null, NaN, -Infinity], [0, 0, 0]]")[1], [0.0; 3]);
    for text in [
        "[[1, 2, 3], [1, Na",
        "[[1, 2, 3], [1, -Infin",
        "[[1, 2, 3], [1, -",
        "[[1, 2, 3], [1, 2e-",
        "[[1, 2, 3]",
    ] {
        assert!(read(text).unwrap_err().is_truncated(), "{text}");
    }
}

#[test]
fn records_have_attributes() {
    let frame = read(RECORDS).unwrap();
    assert_eq!(frame.positions, FilePositions::F64(vec![[0.5, 1.0, 2.0], [-0.25, 1.0, 2.0]]));
    assert_eq!(attribute(&frame, "id").values, Values::I64(vec![7, 9_007_199_254_740_993]));
    assert_eq!(attribute(&frame, "id").role, Some(AttributeRole::Id));
    assert_eq!(attribute(&frame, "v").values, Values::F64(vec![0.0, 0.0, 1.0, 0.0, 0.0, 2.0]));
    assert_eq!(attribute(&frame, "on").values, Values::I32(vec![1, 0]));
    assert_eq!(frame.notes.len(), 1, "{:?}", frame.notes);
    assert_eq!(frame.notes[0], "skipped `name`: row 1: expected a number, found a text");
}

#[test]
fn lists_have_attributes() {
    let frame = read(LISTS).unwrap();
    assert_eq!(frame.positions, FilePositions::F64(vec![[0.0, 1.0, 3.0], [0.5, 2.0, 4.5]]));
    let Values::F64(velocities) = &attribute(&frame, "v").values else { panic!("{:?}", frame.attributes) };
    assert_eq!(velocities[..5], [0.0, 1.0, 0.5, 0.0, 1.0]);
    assert_eq!(attribute(&frame, "Cd").values, Values::U8(vec![255, 0, 7, 1, 2, 3]));
    assert_eq!(attribute(&frame, "width").values, Values::F64(vec![0.25, 0.125]));
    let notes = frame.notes.join("\n");
    for words in ["skipped `time`: it is not a list", "`meta`: it is not a list", "`tags`: row 1", "diameter"]
    {
        assert!(notes.contains(words), "`{words}` in {notes}");
    }
    let flat =
        read(r#"{"position": [0, 1, 2, 3, 4, 5], "rgba": [1, 0, 0, 1, 0, 1, 0, 1], "t": [1, 2], "n": [1]}"#)
            .unwrap();
    assert_eq!(attribute(&flat, "rgba").arity, 4);
    assert_eq!(attribute(&flat, "t").arity, 1);
    let notes = flat.notes.join("\n");
    assert!(notes.contains("each three numbers") && notes.contains("skipped `n`: it has 1 rows"), "{notes}");
    let rows = read("[[1, 2.5, 3, 0.5], [4, 5, 6, 0.25]]").unwrap();
    assert_eq!(attribute(&rows, "column_4").values, Values::F64(vec![0.5, 0.25]));
}

#[test]
fn invalid_texts_are_errors_with_a_reason() {
    for (text, words) in [
        ("[[1, 2, 3],\n[4, 5]]", "at line 2: expected a list of 3 numbers, found 2, column 6"),
        ("[[1, 2, 3], [4, 5]]", "at line 1: expected a list of 3 numbers, found 2, column 18"),
        ("[[1, 2, 3],\n\n [4, 5, 6, 7]]", "at line 3: expected a list of 3 numbers, found 4"),
        ("[[1, 2]]", "expected a list of 3 numbers, found 2"),
        ("[[]]", "expected a list of 3 numbers, found 0"),
        ("[[1, 2, \"3\"]]", "at line 1: expected a number, found a text, column 11"),
        ("[[1, 2, 0x3]]", "expected `,` or `]`, column 10"),
        ("[[1 2 3]]", "expected `,` or `]`, column 5"),
        ("[[1, 2, 3,]]", "trailing comma"),
        ("[[1, 2, 3]] 4", "at line 1: the text goes on after its first value"),
        ("[[1, 2, 3]]\n[[1, 2, 3]]", "at line 2: the text goes on after its first value"),
        ("{\"x\": 1, \"y\": 2}\n{\"x\": 3, \"y\": 4}\n", "at line 2: the text goes on after its first value"),
        ("[[1, 2, 3]]{\"x\": 1}\n", "put all of them into one list"),
        ("[x]{\"x\": 1}\n[y]{\"x\": 2}\n", "expected value, column 2"),
        ("[1, 2, 3]", "expected a list of 3 numbers, found 1"),
        ("[[[1, 2, 3]]]", "found a list; save each frame as a file"),
        ("[{\"x\": 1}, {\"y\": 2}]", "expected `x` once in each record"),
        ("[{\"x\": 1}, {\"x\": 1, \"y\": 2}]", "expected `y` once in each record"),
        ("[{\"x\": 1}, {}]", "expected `x` once in each record"),
        ("[{\"x\": 1, \"x\": 1}]", "expected `x` once"),
        ("[{\"position\": [1, 2, \"a\"]}]", "expected a number, found a text"),
        ("[{\"v\": 1}, 3]", "expected an object, as before"),
        ("[[1, 2, 3], {\"v\": 1}]", "expected a number, found an object"),
        ("[{x: 1}]", "key must be a string"),
        ("{\"a\": 1, \"a\": 2}", "the name `a` appears twice"),
        ("{\"a\": ]}", "expected value"),
        ("{\"a\" 1}", "expected `:`"),
        ("{\"positions\": [[1, 2, \"a\"]]}", "expected a number"),
        ("{\"positions\": [[1, 2], [3, 4]]}", "no positions"),
        (
            "{\"x\": [1], \"y\": [2], \"note\": \"a\"}",
            "found the lists: x, y; skipped `note`: it is not a list",
        ),
        ("{\"x\": [1], \"y\": [2], \"z\": [1, 2]}", "no positions"),
        ("{\"particles\": [], \"Particles\": []}", "appears twice"),
        ("{\"\\ud800\": 1}", "unexpected end of hex escape"),
        ("{}", "no positions"),
        ("[[NaN, 1, 2]]", "none of the 1 particles has a finite position"),
    ] {
        let error = read(text).expect_err(text);
        assert!(error.to_string().contains(words) && !error.is_truncated(), "{text}: `{words}` in: {error}");
    }
    let names: String = (0..5000).map(|n| format!("\"a{n}\":0,")).collect();
    let error = read(&format!("{{{names}")).unwrap_err().to_string();
    assert!(error.contains("names, more than the limit of 4096"), "{error}");
}
