//! NumPy arrays: headers as NumPy writes them, built byte by byte.

use crate::fixtures;

use fixtures::{archive, array, f32s, six};
use meniscus_formats::steps::find_steps;
use meniscus_formats::{
    AttributeRole, FileAttribute, FilePositions, Limits, ParticleFrame, Values, npy, probe, read_particles,
};

fn read(bytes: &[u8]) -> ParticleFrame {
    read_particles(bytes, "a.npy", &Limits::default()).unwrap_or_else(|error| panic!("{error}"))
}

const TWO: [[f32; 3]; 2] = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];

#[test]
fn positions_of_all_types_and_orders_are_read() {
    let columns = f32s(&[1.0, 4.0, 2.0, 5.0, 3.0, 6.0]);
    let halves: Vec<u8> = [0x3c00u16, 0x4000, 0x4200, 0x4400, 0x4500, 0x4600]
        .iter()
        .flat_map(|half| half.to_le_bytes())
        .collect();
    let wide: Vec<u8> = (1..=6).flat_map(|n| f64::from(n).to_be_bytes()).collect();
    let integers: Vec<u8> = (1..=6i16).flat_map(i16::to_be_bytes).collect();
    let table = [
        ("version 1", array(1, "'<f4'", false, "(2, 3)", &six()), false),
        ("version 2", array(2, "'<f4'", false, "(2, 3)", &six()), false),
        ("version 3", array(3, "'<f4'", false, "(2, 3)", &six()), false),
        ("Fortran", array(1, "'<f4'", true, "(2, 3)", &columns), false),
        ("three lengths", array(1, "'<f4'", false, "(1, 2, 3)", &six()), false),
        ("halves", array(1, "'<f2'", false, "(2, 3)", &halves), false),
        ("big-endian doubles", array(1, "'>f8'", false, "(2, 3)", &wide), true),
        ("integers", array(1, "'>i2'", false, "(2, 3)", &integers), true),
    ];
    for (case, bytes, is_wide) in table {
        let frame = read(&bytes);
        let expected = if is_wide {
            FilePositions::F64(TWO.map(|position| position.map(f64::from)).to_vec())
        } else {
            FilePositions::F32(TWO.to_vec())
        };
        assert_eq!(frame, ParticleFrame { positions: expected, ..ParticleFrame::default() }, "{case}");
    }
}

#[test]
fn columns_after_the_third_become_attributes() {
    let frame = read(&array(1, "'<f4'", false, "(1, 6)", &six()));
    assert_eq!(frame.positions, FilePositions::F32(vec![TWO[0]]));
    let names: Vec<&str> = frame.attributes.iter().map(|a| a.name.as_str()).collect();
    assert_eq!((names.join(" "), frame.notes.len()), ("column_4 column_5 column_6".into(), 1));
}

#[test]
fn first_column_of_different_integers_is_the_id() {
    let rows = [[7.0, 0.5, 0.25, 0.125, 9.5], [5.0, 1.5, 0.25, 0.125, 9.5], [9.0, 2.5, 0.25, 0.125, 9.5]];
    let rows = [rows.as_flattened(), &[4.0, 3.5, 0.25, 0.125, 9.5]].concat();
    let frame = read(&array(1, "'<f4'", false, "(4, 5)", &f32s(&rows)));
    assert_eq!(frame.positions, FilePositions::F32([0.5, 1.5, 2.5, 3.5].map(|x| [x, 0.25, 0.125]).to_vec()));
    let found: Vec<_> = frame.attributes.iter().map(|a| (a.name.as_str(), a.role)).collect();
    assert_eq!(found, [("id", Some(AttributeRole::Id)), ("column_5", None)]);
    assert_eq!(frame.notes.len(), 1, "{:?}", frame.notes);
}

#[test]
fn bytes_after_the_array_are_noted() {
    let bytes = array(1, "'<f4'", false, "(1, 3)", &f32s(&[0.5, 0.25, 0.125]));
    let frame = read(&[&bytes[..], &bytes].concat());
    assert_eq!(frame.positions.len(), 1);
    assert_eq!(frame.notes.len(), 1);
    assert!(frame.notes[0].contains(&format!("{} bytes more", bytes.len())), "{:?}", frame.notes);
}

/// Each frame, behind the head of its step, is the file of a single frame.
#[test]
fn frames_of_an_array_are_steps() {
    let records = "[('shape', '<f4'), ('pos', '<f4', (3,))]";
    let record = |x: f32| [f32s(&[0.5, x, 2.0, 3.0]), f32s(&[0.5, x, 5.0, 6.0])].concat();
    for (case, file, expected) in [
        ("numbers", array(1, "'<f4'", false, "(2, 1, 3)", &six()), [vec![TWO[0]], vec![TWO[1]]]),
        ("without blanks", array(2, "'<f4'", false, "(2,1,3)", &six()), [vec![TWO[0]], vec![TWO[1]]]),
        (
            "records",
            array(1, records, false, "(2, 2)", &[record(1.0), record(4.0)].concat()),
            [1.0, 4.0].map(|x| vec![[x, 2.0, 3.0], [x, 5.0, 6.0]]),
        ),
    ] {
        let steps = find_steps(probe(&file, "a.npy").kind, &*file, &Limits::default()).expect("steps");
        assert_eq!(steps.iter().map(|step| step.number).collect::<Vec<_>>(), [Some(0), Some(1)], "{case}");
        for (step, expected) in steps.iter().zip(expected) {
            let [start, end] =
                [step.range.start, step.range.end].map(|at| usize::try_from(at).expect("in the file"));
            let frame = read(&[&step.head[..], &file[start..end]].concat());
            assert_eq!(frame.positions, FilePositions::F32(expected), "{case}");
        }
    }
    for shape in ["(2, 3)", "(1, 2, 3)"] {
        let file = array(1, "'<f4'", false, shape, &six());
        let steps = find_steps(probe(&file, "a.npy").kind, &*file, &Limits::default()).expect("steps");
        assert!(steps.is_empty(), "{shape}");
    }
}

#[test]
fn fields_of_structured_arrays_become_attributes() {
    let descr = "[('id', '<u2'), ('', '|V2'), ('pos', '<f4', (3,)), ('v', [('x', '>f4'), ('y', '>f4'), ('z', '>f4')]), \
                 ('name', '|S4'), (('a radius', 'radius'), '<f4')]";
    let mut record = vec![7, 0, 9, 9];
    record.extend(f32s(&TWO[0]));
    record.extend([4.0f32, 5.0, 6.0].iter().flat_map(|v| v.to_be_bytes()));
    record.extend(b"ab\0\0");
    record.extend(f32s(&[0.5]));
    let frame = read(&array(1, descr, false, "(2,)", &[record.clone(), record].concat()));
    let attribute =
        |name: &str, arity, role, values| FileAttribute { name: name.into(), arity, role, values };
    assert_eq!(frame.positions, FilePositions::F32(vec![TWO[0]; 2]));
    assert_eq!(
        frame.attributes,
        [
            attribute("id", 1, Some(AttributeRole::Id), Values::I32(vec![7, 7])),
            attribute("v", 3, Some(AttributeRole::Velocity), Values::F32(TWO[1].repeat(2))),
            attribute("radius", 1, Some(AttributeRole::Radius), Values::F32(vec![0.5; 2])),
        ]
    );
    assert!(frame.notes[0].contains("`name`: it is not numeric"), "{:?}", frame.notes);
}

#[test]
fn stored_and_deflated_archives_are_read() {
    let members = [
        ("positions.npy", array(1, "'<f4'", false, "(2, 3)", &six())),
        ("vel.npy", array(1, "'<f4'", false, "(2, 3)", &six())),
        ("id.npy", array(1, "'<i8'", false, "(2,)", &[5i64.to_le_bytes(), 6i64.to_le_bytes()].concat())),
        ("dt.npy", array(1, "'<f8'", false, "()", &0.5f64.to_le_bytes())),
        ("what.npy", array(1, "'|O'", false, "(1,)", b"\x80")),
        ("readme.txt", b"no array".to_vec()),
    ];
    for deflated in [false, true] {
        let bytes = archive(&members, deflated);
        let frame = read_particles(&bytes, "a", &Limits::default()).unwrap();
        assert_eq!(frame.positions, FilePositions::F32(TWO.to_vec()));
        let found: Vec<_> = frame.attributes.iter().map(|a| (a.name.as_str(), a.role)).collect();
        assert_eq!(found, [("vel", Some(AttributeRole::Velocity)), ("id", Some(AttributeRole::Id))]);
        assert_eq!(frame.notes.len(), 2, "{:?}", frame.notes);
        let with_comment = [&bytes[..bytes.len() - 2], &[3, 0], b"abc"].concat();
        assert_eq!(npy::read_archive(&with_comment, &Limits::default()).unwrap(), frame);
        let comment = [&b"PK\x05\x06"[..], &[0; 40]].concat();
        let with_comment = [&bytes[..bytes.len() - 2], &[44, 0], &comment].concat();
        assert_eq!(npy::read_archive(&with_comment, &Limits::default()).unwrap(), frame);
    }
    let columns = ["x", "y", "z"].map(|axis| (axis, array(1, "'<f4'", false, "(2,)", &f32s(&[1.0, 2.0]))));
    let columns: Vec<(String, Vec<u8>)> = columns.map(|(axis, bytes)| (format!("{axis}.npy"), bytes)).into();
    let columns: Vec<(&str, Vec<u8>)> =
        columns.iter().map(|(name, bytes)| (&name[..], bytes.clone())).collect();
    let frame = npy::read_archive(&archive(&columns, true), &Limits::default()).unwrap();
    assert_eq!(frame.positions, FilePositions::F32(vec![[1.0; 3], [2.0; 3]]));
    let alone = archive(&[("arr_0.npy", array(1, "'<f4'", false, "(2, 3)", &six()))], false);
    let frame = npy::read_archive(&alone, &Limits::default()).unwrap();
    assert_eq!((frame.positions, frame.notes.len()), (FilePositions::F32(TWO.to_vec()), 1));
    let wide = array(1, "'<f4'", false, "(1, 6)", &six());
    let archived =
        npy::read_archive(&archive(&[("arr_0.npy", wide.clone())], false), &Limits::default()).unwrap();
    let plain = npy::read(&wide, &Limits::default()).unwrap();
    assert_eq!((&archived.positions, &archived.attributes), (&plain.positions, &plain.attributes));
    assert_eq!((archived.attributes.len(), archived.notes.len()), (3, 2), "{:?}", archived.notes);
}

#[test]
fn invalid_arrays_are_errors() {
    let table = [
        (
            "too few numbers",
            array(1, "'<f4'", false, "(3, 3)", &six()),
            "expected 36 bytes for the shape (3, 3), 24 remain",
        ),
        ("flat", array(1, "'<f4'", false, "(3, 2)", &six()), "found the shape (3, 2)"),
        ("a list", array(1, "'<f4'", false, "(6,)", &six()), "found the shape (6,)"),
        ("transposed", array(1, "'<f4'", false, "(3, 0)", &[]), "found the shape (3, 0)"),
        (
            "absurd",
            array(1, "'<f4'", false, "(4000000000, 4000000000, 3)", &six()),
            "the array has too many elements",
        ),
        ("many", array(1, "'<f4'", false, "(5000000000, 3)", &six()), "expected 60000000000 bytes"),
        ("objects", array(1, "'|O'", false, "(2, 3)", b"\x80\x04"), "elements of the type \"|O\""),
        ("letters", array(1, "'<q7'", false, "(2, 3)", &six()), "unknown type \"<q7\""),
        (
            "nothing",
            array(1, "[('a', '<f4')]", false, "(6,)", &six()),
            "expected a field `pos` with three numbers",
        ),
        (
            "no record",
            array(1, "[('a', [('pos', '<f4', 3)], 0)]", false, "(6,)", &six()),
            "expected positions",
        ),
        (
            "columns without end",
            array(1, "'|u1'", false, "(1, 5000)", &[0; 5000]),
            "found the shape (1, 5000): a list of particles does not have so many columns; reshape it",
        ),
        (
            "columns of Fortran without end",
            array(1, "'|u1'", true, "(1, 5000)", &[0; 5000]),
            "does not have so many columns",
        ),
        ("columns of nothing", array(1, "'<f4'", false, "(0, 5000)", &[]), "does not have so many columns"),
        (
            "columns of positions",
            array(1, "'|u1'", false, "(3, 33)", &[0; 99]),
            "save its transpose, `array.T`",
        ),
        ("a matrix", array(1, "'|u1'", false, "(33, 33)", &[0; 33 * 33]), "does not have so many columns"),
        (
            "a picture",
            array(1, "'|u1'", false, "(2, 1, 3)", &[0; 6]),
            "(2, 1, 3): 8-bit numbers in three dimensions",
        ),
        (
            "a volume",
            array(1, "'<f4'", false, "(1, 3, 2)", &six()),
            "the last dimension must be that of x, y and z",
        ),
        ("four lengths", array(1, "'<f4'", false, "(1, 1, 2, 3)", &six()), "there are too many dimensions"),
        (
            "frames",
            array(1, "'<f4'", false, "(2, 1, 3)", &six()),
            "(2, 1, 3) has several frames: read each frame",
        ),
        ("frames of columns", array(1, "'<f4'", true, "(2, 1, 3)", &six()), "numpy.ascontiguousarray"),
        (
            "ids or coordinates",
            array(
                1,
                "'<f4'",
                false,
                "(4, 3)",
                &f32s(&[1.0, 0.5, 0.5, 2.0, 0.5, 0.5, 3.0, 0.5, 0.5, 4.0, 0.5, 0.5]),
            ),
            "may be an id or a position",
        ),
        (
            "letters without end",
            array(1, "'<U18446744073709551615'", false, "(2, 3)", &six()),
            "unknown type",
        ),
        ("version", array(4, "'<f4'", false, "(2, 3)", &six()), "the format version is 4.0"),
    ];
    for (case, bytes, words) in table {
        let error = read_particles(&bytes, "a.npy", &Limits::default()).expect_err(case).to_string();
        assert!(error.contains(words), "{case}: {error}");
    }
    let damaged = |at_end: usize, deflated| {
        let mut bytes = archive(&[("pos.npy", array(1, "'<f4'", false, "(2, 3)", &six()))], deflated);
        let at = bytes.len() - at_end;
        bytes[at] ^= 0x10;
        npy::read_archive(&bytes, &Limits::default()).expect_err("damaged").to_string()
    };
    assert!(damaged(100, false).contains("`pos.npy` is damaged"), "{}", damaged(100, false));
    assert!(damaged(100, true).contains("`pos.npy` is damaged"), "{}", damaged(100, true));
    for (name, what) in [("pos.npy", "`pos` has several frames"), ("a.npy", "`a` has several frames")] {
        let frames = archive(&[(name, array(1, "'<f4'", false, "(2, 1, 3)", &six()))], false);
        let error = npy::read_archive(&frames, &Limits::default()).unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
    }
    let several = |name| (name, array(1, "'<f4'", false, "(2, 1, 3)", &six()));
    for pair in [["q.npy", "qd.npy"], ["F_x.npy", "F_v.npy"]] {
        let mass = ("mass.npy", array(1, "'<f4'", false, "(2,)", &f32s(&[1.0; 2])));
        let frames = archive(&[several(pair[0]), several(pair[1]), mass], false);
        let error = npy::read_archive(&frames, &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("has several frames"), "{error}");
    }
    let tensors =
        archive(&[("foo.npy", array(1, "'<f4'", false, "(2, 3)", &six())), several("stress.npy")], false);
    let frame = npy::read_archive(&tensors, &Limits::default()).expect("particles");
    assert_eq!(
        (frame.positions.len(), &*frame.notes[1]),
        (2, "skipped `stress`: it has the shape (2, 1, 3)"),
        "{:?}",
        frame.notes
    );
    let records = array(1, "[('pos', '<f4', (3,)), ('id', '<f4')]", false, "(2, 1)", &f32s(&[0.5; 8]));
    let error = npy::read_archive(&archive(&[("a.npy", records)], false), &Limits::default()).unwrap_err();
    assert!(error.to_string().contains("`a` has several frames"), "{error}");
    let objects = || array(1, "'|O'", false, "()", b"\x80");
    let numbers = || array(1, "'<i8'", false, "(1,)", &[0; 8]);
    for (names, what) in [
        (["particles.npy", "solver_data.npy"], "this is output of PySPH"),
        (["a.npy", "b.npy"], "pickled Python objects: a, b;"),
    ] {
        let pickled = [(names[0], objects()), (names[1], objects()), ("version.npy", numbers())];
        let error = npy::read_archive(&archive(&pickled, false), &Limits::default()).unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
    }
    let other = archive(&[("a.npy", array(1, "'<f4'", false, "(6,)", &six()))], true);
    let error = npy::read_archive(&other, &Limits::default()).unwrap_err().to_string();
    assert!(error.contains("found: a (6, 1)"), "{error}");
}

#[test]
fn transposed_positions_are_refused() {
    let columns = |count: usize, is_fortran| {
        array(1, "'<f4'", is_fortran, &format!("(3, {count})"), &f32s(&vec![0.5; 3 * count]))
    };
    let error = |bytes: &[u8], name| match read_particles(bytes, name, &Limits::default()) {
        Ok(frame) => panic!("{} particles", frame.positions.len()),
        Err(error) => error.to_string(),
    };
    for count in [5, 1000, 5000] {
        let asks =
            format!("the shape (3, {count}), which has a column for each particle: save its transpose");
        for is_fortran in [false, true] {
            let found = error(&columns(count, is_fortran), "a.npy");
            assert!(found.contains(&asks), "{found}");
        }
        for name in ["pos.npy", "arr_0.npy"] {
            let found = error(&archive(&[(name, columns(count, false))], true), "a.npz");
            assert!(found.contains(&asks), "{name}: {found}");
        }
    }
    // Three particles with a radius, and an array that is no position.
    assert_eq!(read(&columns(4, false)).positions.len(), 3);
    let table = archive(
        &[("pos.npy", array(1, "'<f4'", false, "(2, 3)", &six())), ("curve.npy", columns(9, false))],
        true,
    );
    assert_eq!(npy::read_archive(&table, &Limits::default()).unwrap().positions.len(), 2);
}

#[test]
fn wide_array_beside_positions_is_skipped_in_any_order() {
    let positions = || ("pos.npy", array(1, "'<f4'", false, "(2, 3)", &six()));
    let wide = || ("wide.npy", array(1, "'|u1'", false, "(1, 5000)", &[0; 5000]));
    for members in [[positions(), wide()], [wide(), positions()]] {
        let frame = npy::read_archive(&archive(&members, false), &Limits::default()).expect("positions");
        assert_eq!(frame.positions.len(), 2);
        assert!(frame.notes.iter().any(|note| note.contains("skipped `wide`")), "{:?}", frame.notes);
    }
}

#[test]
fn decompression_bombs_are_errors() {
    let zeros = vec![0; 64 << 20];
    let bomb = archive(&[("pos.npy", array(1, "'<f4'", false, "(5592405, 3)", &zeros))], true);
    let error = npy::read_archive(&bomb, &Limits::default()).unwrap_err().to_string();
    assert!(error.contains("more than 200 times its compressed size"), "{error}");
}
