//! OBJ files without faces are particles.

use meniscus_formats::{
    AttributeRole, FilePositions, Limits, Neighbor, ParticleFrame, Result, Values, looks_like_particles,
    neighbor, read_particles,
};

use crate::truncated::gzipped;

fn read(text: &str) -> Result<ParticleFrame> {
    read_particles(text.as_bytes(), "a.obj", &Limits::default())
}

#[test]
fn vertices_are_particles() {
    let frame = read("# points\no cloud\nv 0.5 1 2\nvn 0 0 1\nv 3 4 5 1.0\np 1 2\n").unwrap();
    assert_eq!(frame.positions, FilePositions::F64(vec![[0.5, 1.0, 2.0], [3.0, 4.0, 5.0]]));
    assert!(frame.attributes.is_empty() && frame.notes.is_empty(), "{frame:?}");
    let frame = read("v 0 0 0 1 0.5 0\nv 1 1 1 0 0 0.25").unwrap();
    let [color] = &frame.attributes[..] else { panic!("{frame:?}") };
    assert_eq!((color.arity, color.role), (3, Some(AttributeRole::Color)));
    assert_eq!(color.values, Values::F32(vec![1.0, 0.5, 0.0, 0.0, 0.0, 0.25]));
    assert!(frame.notes[0].contains("may lack digits"), "{:?}", frame.notes);
    let frame = read("v 0 0 0 1 0.5 0\nv 1 1 1\n").unwrap();
    assert!(frame.attributes.is_empty() && frame.notes[0].contains("only some of the vertices"), "{frame:?}");
}

#[test]
fn meshes_and_damaged_lines_are_refused() {
    for (text, truncated, words) in [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", false, "this is a mesh, not particles"),
        ("v 0 0 0\nv 1 0 0\nl 1 2\n", false, "this is a mesh, not particles"),
        (
            "v 0 0 0\nv 1 0\nv 0 1 0\n",
            false,
            "line 2: expected three numbers of a vertex, found the end of the line",
        ),
        ("v 0 0 0\nv 1 a 0\nv 0 1 0\n", false, "line 2: expected three numbers of a vertex, found \"a\""),
        ("v 0 0 0\nv 1 0", true, "line 2"),
    ] {
        let error = read(text).expect_err(words);
        assert!(error.to_string().contains(words), "{error}, not {words}");
        assert_eq!(error.is_truncated(), truncated, "{error}");
    }
}

#[test]
fn faces_below_many_vertices_make_a_mesh_also_if_compressed() {
    let vertices: String = (0..100_000).map(|index| format!("v {index} 0.{index} {}\n", index % 7)).collect();
    let of = |text: String, is_packed: bool| {
        let bytes = if is_packed { gzipped(text.as_bytes()) } else { text.into_bytes() };
        neighbor(&bytes[..8192], "a.obj", &&bytes[..])
    };
    for is_packed in [false, true] {
        assert_eq!(of(format!("{vertices}f 1 2 3\n"), is_packed), Some(Neighbor::Mesh));
        assert_eq!(of(vertices.clone(), is_packed), None);
    }
}

#[test]
fn only_vertices_without_faces_look_like_particles() {
    assert!(looks_like_particles(b"v 0 0 0\nv 1 0 0\np 1 2\n", "a.obj"));
    assert!(!looks_like_particles(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "a.obj"));
}
