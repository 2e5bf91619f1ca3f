//! LAMMPS dumps: steps, boxes and columns.

use crate::fixtures;

use fixtures::DUMP;
use meniscus_formats::steps::find_steps;
use meniscus_formats::{
    AttributeRole, FilePositions, Format, Limits, ParticleFrame, ProbedKind, Values, lammps, read_particles,
};

fn read(text: &str) -> ParticleFrame {
    read_particles(text.as_bytes(), "a.dump", &Limits::default())
        .unwrap_or_else(|error| panic!("{text}: {error}"))
}

fn dump(bounds: &str, columns: &str, row: &str) -> String {
    format!(
        "ITEM: UNITS\nlj\nITEM: TIME\n0.5\nITEM: TIMESTEP\n7\nITEM: NUMBER OF ATOMS\n1\nITEM: BOX BOUNDS {bounds}ITEM: ATOMS {columns}\n{row}\n"
    )
}

#[test]
fn single_step_is_read_as_a_frame() {
    let frame = read(DUMP);
    assert_eq!(frame.positions, FilePositions::F64(vec![[0.5, 0.25, 1.0], [0.75, 0.25, 1.0]]));
    let found: Vec<_> = frame.attributes.iter().map(|a| (a.name.as_str(), a.arity, a.role)).collect();
    let expected = [
        ("id", 1, Some(AttributeRole::Id)),
        ("type", 1, Some(AttributeRole::Kind)),
        ("v", 3, Some(AttributeRole::Velocity)),
        ("radius", 1, Some(AttributeRole::Radius)),
    ];
    assert_eq!(found, expected);
    assert_eq!(frame.attributes[0].values, Values::I32(vec![1, 2]));
    assert!(frame.notes.is_empty());
}

#[test]
fn diameters_are_halved_with_a_note() {
    let frame = read(&dump("pp pp pp\n0 1\n0 1\n0 1\n", "x y z diameter", "0 0 0 0.5"));
    assert_eq!(frame.attributes[0].values, Values::F64(vec![0.25]));
    assert_eq!(frame.notes, ["`diameter` looks like a diameter: the radius is half of it"]);
}

#[test]
fn scaled_positions_are_multiplied_by_the_box() {
    let straight = "pp pp pp\n0 10\n-1 1\n2 22\n";
    // A tilted box with a corner at (0, 0, 0) and the edges (4, 0, 0), (1, 2, 0) and (-2, 0.5, 8).
    let tilted = "xy xz yz pp pp pp\n-2 5 1\n0 2.5 -2\n0 8 0.5\n";
    let general = "abc origin pp pp pp\n4 0 0 0\n1 2 0 0\n-2 0.5 8 0\n";
    let table = [
        (straight, "id xs ys zs", "1 0.5 0.5 0.25", [5.0, 0.0, 7.0]),
        (straight, "xsu ysu zsu id", "1.5 0.5 0.25 1", [15.0, 0.0, 7.0]),
        (straight, "id xu yu zu xs ys zs", "1 1 2 3 0 0 0", [1.0, 2.0, 3.0]),
        (straight, "x y z xu yu zu", "1 2 3 9 9 9", [1.0, 2.0, 3.0]),
        (straight, "id z xu yu zu", "1 9 1 2 3", [1.0, 2.0, 3.0]),
        (straight, "id x y xs ys zs", "1 9 9 0.5 0.5 0.25", [5.0, 0.0, 7.0]),
        (tilted, "xs ys zs", "0.5 0.5 0.25", [2.0, 1.125, 2.0]),
        (general, "xs ys zs", "0.5 0.5 0.25", [2.0, 1.125, 2.0]),
    ];
    for (bounds, columns, row, expected) in table {
        let found = match read(&dump(bounds, columns, row)).positions {
            FilePositions::F32(positions) => positions[0].map(f64::from),
            FilePositions::F64(positions) => positions[0],
        };
        assert_eq!(found, expected, "{bounds} {columns}");
    }
}

#[test]
fn columns_with_any_name_become_attributes() {
    let frame =
        read(&dump("pp pp pp\n0 1\n0 1\n0 1\n", "element c_s[1] c_s[2] x y z diameter", "Ar 1 2 3 4 5 0.5"));
    let found: Vec<_> = frame.attributes.iter().map(|a| (a.name.as_str(), a.arity, a.role)).collect();
    assert_eq!(
        found,
        [
            ("element", 1, None),
            ("c_s[1]", 1, None),
            ("c_s[2]", 1, None),
            ("diameter", 1, Some(AttributeRole::Radius))
        ]
    );
    assert_eq!(frame.attributes[3].values, Values::F64(vec![0.25]));
}

#[test]
fn several_steps_are_read_separately() {
    let empty = "ITEM: TIMESTEP\n3000\nITEM: NUMBER OF ATOMS\n0\nITEM: BOX BOUNDS pp pp pp\n0 1\n0 1\n0 1\nITEM: ATOMS id x y z\n";
    let text = [DUMP, &DUMP.replace("1000", "2000").replace("0.75", "0.875"), empty, "\n"].concat();
    let steps = lammps::steps(text.as_bytes(), &Limits::default()).unwrap();
    let found: Vec<_> = steps.iter().map(|step| (step.timestep, step.particle_count)).collect();
    assert_eq!(found, [(1000, 2), (2000, 2), (3000, 0)]);
    let frames: Vec<ParticleFrame> = steps
        .iter()
        .map(|step| lammps::read_step(text.as_bytes(), step, &Limits::default()).unwrap())
        .collect();
    assert_eq!(frames[0], read(DUMP));
    for (step, frame) in steps.iter().zip(&frames) {
        let bytes = &text.as_bytes()[step.range.clone()];
        assert_eq!(read_particles(bytes, "a.dump", &Limits::default()).unwrap(), *frame);
    }
    let found =
        find_steps(ProbedKind::Format(Format::LammpsDump), text.as_bytes(), &Limits::default()).unwrap();
    let found: Vec<_> =
        found.iter().map(|step| (step.number.unwrap(), usize::try_from(step.range.end).unwrap())).collect();
    // The last step includes everything after it.
    let mut expected: Vec<_> = steps.iter().map(|step| (step.timestep, step.range.end)).collect();
    expected[2].1 += 1;
    assert_eq!(found, expected);
    assert_eq!(frames[1].positions, FilePositions::F64(vec![[0.5, 0.25, 1.0], [0.875, 0.25, 1.0]]));
    assert!(frames[2].positions.is_empty());
    let error = read_particles(text.as_bytes(), "a", &Limits::default()).unwrap_err().to_string();
    assert!(error.contains("3 time steps, 1000 to 3000"), "{error}");
}

#[test]
fn missing_last_line_end_adds_a_note() {
    let ended = read_particles(DUMP.as_bytes(), "a", &Limits::default()).expect("whole");
    let frame = read_particles(DUMP.trim_end().as_bytes(), "a", &Limits::default()).expect("whole");
    assert_eq!((&frame.positions, &frame.attributes), (&ended.positions, &ended.attributes));
    let has_note = |frame: &ParticleFrame| frame.notes.iter().any(|note| note.contains("without a line end"));
    assert!(has_note(&frame) && !has_note(&ended), "{:?}", frame.notes);
}

#[test]
fn invalid_dumps_are_errors_with_their_line() {
    let table = [
        (
            DUMP.replace("OF ATOMS\n2", "OF ATOMS\n4000000000"),
            "at line 11: expected 4000000000 atoms, found 2",
        ),
        (DUMP.replace("OF ATOMS\n2", "OF ATOMS\n-2"), "the number of atoms is -2"),
        (DUMP.replace("OF ATOMS\n2", "OF ATOMS\n1"), "at line 11: expected ITEM:, found `2 1 0.75"),
        (DUMP.replace("OF ATOMS\n2", "OF ATOMS\ntwo"), "expected the number of atoms, found `two`"),
        ([&DUMP.replace("OF ATOMS\n2", "OF ATOMS\n3"), DUMP].concat(), "expected 3 atoms, found 2"),
        (DUMP.replace("ATOMS id", "ENTRIES id"), "not atoms"),
        (DUMP.replace("x y z", "a b c"), "at line 9: no position columns"),
        (DUMP.replace("0.75", "three"), "LAMMPS dump, at line 11"),
        (DUMP.replace("0.75", "1 0.75"), "LAMMPS dump, at line 11"),
        (DUMP.replace("\n-1 1", "\n-1"), "expected bounds of the box"),
        (
            DUMP.trim_end().trim_end_matches("0.01").trim_end().into(),
            "at line 11: expected 9 cells, as in the first line of the table, found 8; \
             the file ends in this line, which has no line end",
        ),
        (DUMP[..30].into(), "the line end is missing"),
        (
            DUMP.replace("\n2 1 0.75", "\n\n2 1 0.75").replace("ATOMS\n2", "ATOMS\n3"),
            "expected 3 rows, found 2",
        ),
        (DUMP.replace("\n2 1 0.75", "\n#2 1 0.75"), "expected 2 rows, found 1"),
        (
            DUMP.replace("x y z", "xs ys zs")
                .replace("ITEM: BOX BOUNDS pp pp ff\n", "ITEM: UNITS\n")
                .replace("0.0000000000000000e+00 1.0000000000000000e+01\n-1 1\n2 22\n", "lj\n"),
            "at line 7: positions are fractions of the box, but ITEM: BOX BOUNDS is missing",
        ),
        (
            "by hand\n\n1 atoms\n1 atom types\n\nAtoms # atomic\n\n1 1 0 0 0\n".into(),
            "LAMMPS data: this is a `write_data` file",
        ),
        (DUMP.replace("ITEM: NUMBER OF ATOMS\n2\n", ""), "ITEM: ATOMS before ITEM: NUMBER OF ATOMS"),
    ];
    for (text, words) in table {
        let error = read_particles(text.as_bytes(), "a", &Limits::default()).expect_err(words).to_string();
        assert!(error.contains(words), "expected `{words}` in: {error}");
    }
}
