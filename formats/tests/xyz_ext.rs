//! Plain and extended XYZ.

use meniscus_formats::{
    AttributeRole, FilePositions, Format, Limits, ParticleFrame, ProbedKind, Values, probe, read_particles,
};

fn read(text: &str) -> ParticleFrame {
    assert_eq!(probe(text.as_bytes(), "a.xyz").kind, ProbedKind::Format(Format::XyzAtoms), "{text}");
    read_particles(text.as_bytes(), "a.xyz", &Limits::default())
        .unwrap_or_else(|error| panic!("{text}: {error}"))
}

#[test]
fn elements_and_positions_are_read() {
    let frame = read("3\nwater\nO 0.0 0.0 0.5\n H  0.75 0.5 0\r\nH\t-0.75 0.5 0\n");
    assert_eq!(
        frame.positions,
        FilePositions::F64(vec![[0.0, 0.0, 0.5], [0.75, 0.5, 0.0], [-0.75, 0.5, 0.0]])
    );
    assert_eq!(frame.attributes.len(), 1);
    assert_eq!(frame.attributes[0].name, "element");
    assert!(matches!(&frame.attributes[0].values, Values::Strings { table, .. } if table.len() == 2));
}

#[test]
fn frame_without_atoms_is_recognised() {
    assert!(read("0\nstep 1\n").positions.is_empty());
    let kind = probe(b"0\nstep 1\n\n1\nstep 2\nO 1 2 3\n", "a.txt").kind;
    assert_eq!(kind, ProbedKind::Format(Format::XyzAtoms));
}

#[test]
fn atomic_numbers_are_read_as_elements() {
    let frame = read("2\n\n8 0.5 0.25 1\n 1 1 2 3\n");
    assert_eq!(frame.positions, FilePositions::F64(vec![[0.5, 0.25, 1.0], [1.0, 2.0, 3.0]]));
    assert_eq!(frame.attributes[0].name, "element");
    assert_eq!(frame.attributes[0].values, Values::I32(vec![8, 1]));
}

/// The first bytes of a file, from which its format is detected, can end anywhere, even within the last atom.
#[test]
fn frame_is_recognised_by_its_head() {
    for (count, row) in [(2, "8 0.5 0.25 1\n"), (700, "1 0.5 0.25 1\n"), (3, "O 0.5 0.25 1\n")] {
        let frame = format!("{count}\n\n{}", row.repeat(count));
        let text = frame.repeat(2);
        let least = frame.find("\n\n").expect("a comment") + 2 + 2 * row.len();
        for cut in least..=text.len().min(least + 8192) {
            let head = &text.as_bytes()[..cut];
            assert_eq!(
                probe(head, "a.xyz").kind,
                ProbedKind::Format(Format::XyzAtoms),
                "{count} atoms, cut at {cut}"
            );
        }
    }
}

/// In a plain table, the line where XYZ has its comment is a row like the others.
#[test]
fn table_below_a_count_is_not_xyz() {
    let tables = ["1\n1 2 3 4\n5 6 7 8\n", "1\n1 2 3 4\n5 6 7 8", "4\n1 0 0 1\n2 1 0 0\n3 0 1 0\n4 1 1 0\n"];
    for text in tables {
        assert_ne!(probe(text.as_bytes(), "a.xyz").kind, ProbedKind::Format(Format::XyzAtoms), "{text}");
    }
}

#[test]
fn columns_after_the_position_are_kept() {
    let frame = read("1\n\nO 0 0 0.5 1 2\n");
    let names: Vec<_> = frame.attributes.iter().map(|attribute| attribute.name.as_str()).collect();
    assert_eq!(names, ["element", "column_5", "column_6"]);
    let comment =
        "Lattice=\"1 0 0 0 1 0 0 0 1\" Properties=species:S:1:id:I:1:pos:R:3:velo:R:3:q:R:2 Time=0.5";
    let frame = read(&format!("1\n{comment}\nO 7 0 0 0.5 1 2.5 3 0.25 0.5\n"));
    let found: Vec<_> = frame.attributes.iter().map(|a| (a.name.as_str(), a.arity, a.role)).collect();
    assert_eq!(
        found,
        [
            ("species", 1, Some(AttributeRole::Kind)),
            ("id", 1, Some(AttributeRole::Id)),
            ("velo", 3, None),
            ("q", 2, None)
        ]
    );
    assert_eq!(frame.attributes[2].values, Values::F64(vec![1.0, 2.5, 3.0]));
}

/// Python's `"\n".join` writes files without a final line end, but an incomplete file can end in the same
/// way.
#[test]
fn missing_last_line_end_adds_a_note() {
    let ended = read("2\nwater\nO 0 0 0\nH 1 0 0.25\n");
    assert!(ended.notes.is_empty(), "{:?}", ended.notes);
    let frame = read("2\nwater\nO 0 0 0\nH 1 0 0.25");
    assert_eq!((&frame.positions, &frame.attributes), (&ended.positions, &ended.attributes));
    assert!(matches!(&frame.notes[..], [note] if note.contains("without a line end")), "{:?}", frame.notes);
    for blanks in ["\r\n", "\n\n", "\n ", " ", "\r"] {
        let text = format!("2\nwater\nO 0 0 0\nH 1 0 0.25{blanks}");
        assert_eq!(read(&text), ended, "{blanks:?}");
    }
}

#[test]
fn too_many_frames_are_an_error() {
    let limits = Limits { step_count: 3, ..Limits::default() };
    let error = |count: usize| {
        let text = "1\n\nO 0 0 0\n".repeat(count);
        read_particles(text.as_bytes(), "a.xyz", &limits).expect_err("several").to_string()
    };
    assert!(error(3).contains("several frames"), "{}", error(3));
    assert!(error(4).contains("more steps than the limit of 3"), "{}", error(4));
}

#[test]
fn invalid_files_are_errors_with_their_line() {
    let table = [
        ("3\nwater\nO 0 0 0\nH 1 0 0\n", "XYZ atoms, at line 4: expected 3 atoms, found 2"),
        ("2\nwater\nO 0 0 0\n\n", "at line 4: expected an atom, found an empty line"),
        ("2\nwater\nO 0 0 0\nH 1 0\n", "XYZ atoms, at line 4"),
        ("2\nwater\nO 0 0 0\nH 1 0 x\n", "XYZ atoms, at line 4"),
        ("1\nProperties=species:S:1:r:R:3\nO 0 0 0\n", "does not contain pos:R:3"),
        ("2\nwater\nO 0 0 0\nH 1 0", "at line 4: expected 4 cells"),
        ("2\nwater\nO 0 0 0\nH 1 0", "found 3; the file ends in this line, which has no line end"),
        ("99999999999\n\nO 0 0 0\n", "more than the limit"),
        ("1\n\nO 0 0 0\n1\n\nO 0 0 0\n", "several frames"),
        ("2\nwater\nO 0 0 0\nH 1 0 -", "found \"-\"; the file ends in this line, which has no line end"),
        ("3\nwater\n8 0 0 0\n1 1 0 0\n", "XYZ atoms, at line 4: expected 3 atoms, found 2"),
    ];
    for (text, words) in table {
        let error =
            read_particles(text.as_bytes(), "a.xyz", &Limits::default()).expect_err(words).to_string();
        assert!(error.contains(words), "expected `{words}` in: {error}");
    }
}
