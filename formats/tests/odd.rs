//! Files of one kind each, which imitate files of other programs that were once read wrongly. All are a block of
//! particles, or have none. They are in `corpus/odd`.

use std::path::Path;

use meniscus_formats::compression::decompressed_so_far;
use meniscus_formats::steps::{find_steps, step_of_compressed};
use meniscus_formats::{
    AttributeRole, FilePositions, Format, Limits, ParticleFrame, ProbedKind, Result, Values, looks_like_mesh,
    looks_like_particles, read_particles,
};

fn file(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus/odd").join(name)).expect(name)
}

fn read(name: &str) -> Result<ParticleFrame> {
    read_particles(&file(name), name, &Limits::default())
}

#[test]
fn odd_files_are_read_right_or_refused() {
    // The number of particles and a note, or words of the error.
    type Expected = std::result::Result<(usize, &'static str), &'static str>;
    let table: [(&str, Expected); 13] = [
        ("mtlx.usda", Ok((200, "left out layers that are not USD: ./mat.mtlx"))),
        ("empty.usda", Err("no prims of the type Points or PointInstancer")),
        ("widths_constant.usda", Ok((300, "the radius is half of it"))),
        ("openpmd_mesh_only.h5", Err("expected a group with a data set `pos`")),
        ("maxshape_wrong.h5", Err("its maximal shape is larger than its shape")),
        ("points.off", Err("the row \"80 0 0\" below \"OFF\" may be the number of rows")),
        ("count_row_of_three.txt", Err("the row \"960 0 0\" may be the number of rows")),
        ("atoms.xsf", Err("--columns")),
        ("type_first_nohead.txt", Err("--columns")),
        ("hash_two_coordinates.csv", Err("--columns")),
        ("hash_time.csv", Err("--columns")),
        ("plot3d_binary.xyz", Err("not a supported particle format")),
        ("points.glb", Ok((960, ""))),
    ];
    for (name, expected) in table {
        match (read(name), expected) {
            (Ok(frame), Ok((count, note))) => {
                assert_eq!(frame.positions.len(), count, "{name}");
                let has_note = frame.notes.iter().any(|found| found.contains(note));
                assert!(has_note || note.is_empty(), "{name}: {:?}", frame.notes);
            }
            (Err(error), Err(words)) => assert!(error.to_string().contains(words), "{name}: {error}"),
            (found, _) => panic!("{name}: {found:?}"),
        }
    }
}

/// The lines that show that the file is refused otherwise are skipped.
#[test]
fn named_columns_are_read_below_other_lines() {
    let columns = [("x", "1"), ("y", "2"), ("z", "3")].map(|(name, column)| (name.into(), column.into()));
    for (name, count) in [("points.off", 80), ("count_row_of_three.txt", 960)] {
        let frame = meniscus_formats::read_particles_named(&file(name), name, &columns, &Limits::default());
        assert_eq!(frame.expect(name).positions.len(), count, "{name}");
    }
}

#[test]
fn constant_width_is_a_radius_of_all_particles() {
    let frame = read("widths_constant.usda").expect("particles");
    assert_eq!(frame.attributes[0].role, Some(AttributeRole::Radius));
    assert_eq!(frame.attributes[0].values, Values::F32(vec![0.025; frame.positions.len()]));
}

#[test]
fn steps_of_a_stopped_writer_are_frames() {
    let (bytes, kind, limits) =
        (file("no_end.dump.gz"), ProbedKind::Format(Format::LammpsDump), Limits::default());
    let (content, _) = decompressed_so_far(&bytes, &limits).expect("five steps");
    let steps = find_steps(kind, &*content, &limits).expect("five steps");
    let has_note = steps.iter().map(|step| {
        let step = step_of_compressed(kind, &bytes, step, &limits).expect("a step").expect("in the file");
        let frame = meniscus_formats::particles_of(step, "no_end.dump.gz", &[], &limits).expect("a frame");
        assert_eq!(frame.positions.len(), 960);
        frame.notes.iter().any(|note| note.contains("later steps are missing"))
    });
    assert_eq!(has_note.collect::<Vec<_>>(), [false, false, false, false, true]);
}

#[test]
fn points_of_gltf_are_no_mesh() {
    let bytes = file("points.glb");
    assert!(looks_like_particles(&bytes, "a.glb") && !looks_like_mesh(&bytes, "a.glb"));
    // The same buffer as triangles: the text has the same length.
    let at = bytes.windows(9).position(|word| word == b"\"mode\": 0").expect("a mode");
    let mut triangles = bytes;
    triangles[at + 8] = b'4';
    assert!(!looks_like_particles(&triangles, "a.glb") && looks_like_mesh(&triangles, "a.glb"));
    let error = read_particles(&triangles, "a.glb", &Limits::default()).expect_err("a mesh").to_string();
    assert!(error.contains("this is a mesh, not particles"), "{error}");
}

#[test]
fn points_of_gltf_have_attributes_and_are_placed() {
    let text = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],
        "nodes":[{"mesh":0,"translation":[1,0,0],"scale":[2,2,2]}],
        "meshes":[{"primitives":[{"attributes":{"POSITION":0,"_VELOCITY":0,"COLOR_0":1,"_RADIUS":3},"indices":2,"mode" :
        0}]}],
        "accessors":[{"bufferView":0,"componentType":5126,"count":2,"type":"VEC3"},
        {"bufferView":1,"componentType":5121,"normalized":true,"count":2,"type":"VEC4"},
        {"bufferView":2,"componentType":5121,"count":3,"type":"SCALAR"},
        {"bufferView":0,"byteOffset":12,"componentType":5126,"count":2,"type":"SCALAR"}],
        "bufferViews":[{"buffer":0,"byteLength":24},{"buffer":0,"byteOffset":24,"byteLength":8},
        {"buffer":0,"byteOffset":32,"byteLength":3}],
        "buffers":[{"byteLength":35,"uri":"data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAEAAAEBA/wAA/wD/AP8BAAE="}]}"#;
    let frame = read_particles(text.as_bytes(), "a.gltf", &Limits::default()).expect("points");
    let [zero, one] = [[1.0, 0.0, 0.0], [3.0, 4.0, 6.0]];
    assert_eq!(frame.positions, meniscus_formats::FilePositions::F64(vec![one, zero, one]));
    let of = |role| frame.attributes.iter().find(|found| found.role == Some(role)).map(|found| &found.values);
    let velocity = [2.0, 4.0, 6.0, 0.0, 0.0, 0.0, 2.0, 4.0, 6.0];
    assert_eq!(of(AttributeRole::Velocity), Some(&Values::F32(velocity.to_vec())));
    assert_eq!(of(AttributeRole::Radius), Some(&Values::F32(vec![4.0, 2.0, 4.0])));
    let color = [0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0];
    assert_eq!(of(AttributeRole::Color), Some(&Values::F64(color.to_vec())));
    // Points beside triangles are no particles.
    let mixed = text.replace("0}]}],", "0},{\"attributes\":{\"POSITION\":0}}]}],");
    assert!(looks_like_mesh(mixed.as_bytes(), "a.gltf") && !looks_like_particles(mixed.as_bytes(), "a.gltf"));
    // An index beyond the vertices.
    let wrong = text.replace("/wAA/wD/AP8BAAE=", "/wAA/wD/AP8BAAI=");
    let error =
        read_particles(wrong.as_bytes(), "a.gltf", &Limits::default()).expect_err("an index").to_string();
    assert!(error.contains("an index beyond the vertices"), "{error}");
}

#[test]
fn damaged_points_of_gltf_do_not_panic() {
    let bytes = file("points.glb");
    for at in 0..500 {
        for value in [0, b'0', b'9', b'-', b'}', b'"', 255] {
            let mut damaged = bytes.clone();
            damaged[at] = value;
            let _ = read_particles(&damaged, "a.glb", &Limits::default());
        }
    }
}

/// Words of a sentence are no names of columns.
#[test]
fn comments_above_numbers_are_no_headers() {
    let rows = "0 0 0\n0.1 0 0\n0 0.1 0\n0 0 0.1\n";
    for (comment, is_read) in [
        ("# Dam break simulation", true),
        ("# Created by CloudCompare", true),
        ("// exported from Houdini", true),
        ("# Time step output of solver", true),
        ("# Frame exported from MySolver", true),
        ("# time p1 p2", false),
        ("# Time step output", false),
        ("# u [m/s], p [Pa], t [s]", false),
        ("# p v w", false),
    ] {
        let text = format!("{comment}\n{rows}");
        let found = read_particles(text.as_bytes(), "a.txt", &Limits::default());
        assert_eq!(found.is_ok(), is_read, "{comment}: {found:?}");
        assert_eq!(looks_like_particles(text.as_bytes(), "a.txt"), is_read, "{comment}");
        let columns = [("x", "1"), ("y", "2"), ("z", "3")].map(|(name, column)| (name.into(), column.into()));
        let named =
            meniscus_formats::read_particles_named(text.as_bytes(), "a.txt", &columns, &Limits::default());
        assert_eq!(named.expect("named columns").positions.len(), 4, "{comment}");
    }
}

/// The rows of these files have numbers.
#[test]
fn texts_of_other_programs_are_no_particles() {
    let rows = |row: fn(f64) -> String| (1..=20).map(|index| row(f64::from(index))).collect::<String>();
    let plain = rows(|x| format!("{x} 0.5 0.25\n"));
    for (name, text) in [
        (
            "water.gro",
            format!(
                "water\n   20\n{}   6 5 4\n",
                rows(|x| format!("{x:>5}SOL     OW{x:>5}{x:8.3}   0.500\n"))
            ),
        ),
        (
            "water.pdb",
            rows(|x| format!("ATOM  {x:>5}  OW  SOL A{x:>4}    {x:8.3}   0.500   0.250  1.00  0.00\n")),
        ),
        ("water.pqr", rows(|x| format!("ATOM  {x:>5}  N   ALA  {x:>4}  {x:8.3}  0.500  0.250 -0.30 1.85\n"))),
        ("POSCAR", format!("water\n1.0\n6 0 0\n0 5 0\n0 0 4\nO\n20\nCartesian\n{plain}")),
        ("tecplot.dat", format!("TITLE = \"t\"\nVARIABLES=\"X\",\"Y\",\"Z\"\nZONE I=20, F=POINT\n{plain}")),
        (
            "positions",
            format!(
                "FoamFile\n{{\n    class Cloud;\n}}\n20\n(\n{})\n",
                rows(|x| format!("({x} 0.5 0.25) 1\n"))
            ),
        ),
        ("points.toml", format!("[cloud]\npoints = [\n{}]\n", rows(|x| format!("{x}, 0.5, 0.25,\n")))),
        ("points.xml", format!("<points>\n{plain}</points>\n")),
    ] {
        let found = read_particles(text.as_bytes(), name, &Limits::default());
        assert!(found.is_err(), "{name}: {found:?}");
    }
}

#[test]
fn comments_that_name_positions_of_other_columns_are_asked_about() {
    let limits = Limits::default();
    for head in ["# rho x y z sound speed\n", "# Columns: rho x y z\n", "# rho (kg/m3) x (m) y (m) z (m)\n"] {
        let text = format!("{head}1000.5 0.5 1.5 2.5 340.5\n999.5 0.25 1.25 2.25 341.5\n");
        let error = read_particles(text.as_bytes(), "a.txt", &limits).expect_err(head).to_string();
        assert!(error.contains("--columns x=2,y=3,z=4"), "{error}");
    }
    let text = "# Columns: rho x y z\n1000.5 0.5 1.5 2.5\n999.5 0.25 1.25 2.25\n";
    let frame = read_particles(text.as_bytes(), "a.txt", &limits).expect("a name for each column");
    assert_eq!(frame.positions, FilePositions::F64(vec![[0.5, 1.5, 2.5], [0.25, 1.25, 2.25]]));
    let text = "# positions x y z of the fluid\n0.5 1.5 2.5\n0.25 1.25 2.25\n";
    assert_eq!(read_particles(text.as_bytes(), "a.txt", &limits).expect("three columns").positions.len(), 2);
    // A new name of another column changes nothing.
    let text = b"rho x y z sound speed\n1000.5 0.5 1.5 2.5 340.5\n";
    let columns = [("c".to_owned(), "5".to_owned())];
    assert!(meniscus_formats::read_particles_named(text, "a.txt", &columns, &limits).is_err());
    assert!(meniscus_formats::read_particles_named(text, "a.txt", &[], &limits).is_err());
}

/// Whatever the format, particles of several frames are refused.
#[test]
fn joined_frames_are_refused() {
    let limits = Limits::default();
    let ply = |name: &str, times: [u8; 2]| {
        format!(
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
             property uchar {name}\nend_header\n0 0 0 {0}\n1 0 0 {0}\n0 0 0 {1}\n1 0 0 {1}\n",
            times[0], times[1]
        )
    };
    let json = r#"{"positions": [[0, 0, 0], [1, 0, 0]], "frame": [3, 4]}"#;
    let csv = "x,y,z,id,t\n0,0,0,1,3\n1,0,0,2,3\n0,0,0,1,4\n1,0,0,2,4\n";
    for (name, text) in
        [("a.ply", ply("frame", [3, 4])), ("a.json", json.to_owned()), ("a.csv", csv.to_owned())]
    {
        let error = read_particles(text.as_bytes(), name, &limits).expect_err("two frames").to_string();
        assert!(
            error.contains("several values, such as 3 and 4, so the file joins several frames"),
            "{error}"
        );
    }
    let csv = "t,step,x,y,z\n0,3,0,0,0\n0,3,1,0,0\n0,4,0,0,0\n0,4,1,0,0\n";
    let error = read_particles(csv.as_bytes(), "a.csv", &limits).expect_err("two steps").to_string();
    assert!(error.contains("`step` has several values"), "{error}");
    // Ids that differ by less than a float resolves.
    let csv = "x,y,z,id,step\n0,0,0,1152921504606846977,3\n1,0,0,1152921504606846978,4\n";
    assert_eq!(read_particles(csv.as_bytes(), "a.csv", &limits).expect("a frame").positions.len(), 2);
    // One time, times of particles, and a temperature.
    for text in [ply("frame", [3, 3]), ply("t", [4, 3]), ply("t", [3, 4])] {
        assert_eq!(read_particles(text.as_bytes(), "a.ply", &limits).expect("a frame").positions.len(), 4);
    }
}
