//! Headers that declare data which the file does not have, and headers without an end.
//!
//! Files of gigabytes are sparse: they take no disk space, and reading them gives zeros.

use std::fmt::Write;

use crate::hostile::bombs::archive;
use crate::hostile::scene::{Scene, is_long, ply_header};

/// The length of sparse files.
fn hole_bytes() -> u64 {
    if is_long() { 4 << 30 } else { 256 << 20 }
}

/// The length of headers.
fn header_bytes() -> usize {
    if is_long() { 300 << 20 } else { 30 << 20 }
}

/// The number of attributes.
fn attribute_count() -> usize {
    if is_long() { 1_000_000 } else { 100_000 }
}

/// Memory of the program itself and of the good frames.
const OWN_BYTES: u64 = 128 << 20;

/// Limit of the memory for a file that a reader may load as a whole.
fn most_of(length: u64) -> u64 {
    OWN_BYTES + (64 << 20) + 4 * length
}

/// A header declares more particles than the file can contain: the reader must not allocate memory for them.
#[test]
fn counts_beyond_the_file_allocate_nothing() {
    let scene = Scene::new();
    scene.write_with_hole("in/huge.1.ply", &ply_header(4_000_000_000), hole_bytes());
    scene.assert_costs_itself_alone("huge.1.ply", "4000000000 `vertex` records", OWN_BYTES);
    let mut bgeo = b"BgeoV\0\0\0\x05".to_vec();
    bgeo.extend([i32::MAX, 0, 0, 0, 0, 0, 0, 0].iter().flat_map(|number| number.to_be_bytes()));
    let scene = Scene::new();
    scene.write_with_hole("in/huge.1.bgeo", &bgeo, hole_bytes());
    scene.assert_costs_itself_alone("huge.1.bgeo", "expected", OWN_BYTES);
}

#[test]
fn counts_beyond_an_array_allocate_no_more_than_the_file() {
    let scene = Scene::new();
    let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (4000000000, 3), }";
    let start = [&b"\x93NUMPY\x01\0v\0"[..], format!("{header:<117}\n").as_bytes()].concat();
    scene.write_with_hole("in/huge.1.npy", &start, hole_bytes());
    scene.assert_costs_itself_alone("huge.1.npy", "expected", most_of(hole_bytes()));
}

/// The first bytes of a file of zeros show that it is not text.
#[test]
fn tables_of_zeros_are_refused() {
    let scene = Scene::new();
    scene.write_with_hole("in/huge.1.csv", b"x,y,z\n0,0,0\n", hole_bytes());
    scene.assert_costs_itself_alone("huge.1.csv", "", most_of(hole_bytes()));
    let scene = Scene::new();
    scene.write_with_hole("in/huge.1.vtk", b"# vtk DataFile Version 3.0\n", hole_bytes());
    scene.assert_costs_itself_alone("huge.1.vtk", "", most_of(hole_bytes()));
}

/// A line, a comment or a text has no end.
#[test]
fn headers_without_end_are_refused() {
    let filling = |byte: u8| vec![byte; header_bytes()];
    let npy = [&b"\x93NUMPY\x02\0"[..], &(header_bytes() as u32).to_le_bytes(), &filling(b' ')].concat();
    let ply = [b"ply\nformat ascii 1.0\ncomment ", &filling(b'a')[..], b"\nend_header\n"].concat();
    let lines =
        [b"ply\nformat ascii 1.0\n", &b"comment a\n".repeat(header_bytes() / 10)[..], b"end_header\n"]
            .concat();
    let vtk = [b"# vtk DataFile Version 3.0\n", &filling(b'a')[..], b"\nASCII\nDATASET POLYDATA\n"].concat();
    let vtu = [b"<VTKFile type=\"", &filling(b'a')[..], b"\"></VTKFile>"].concat();
    let dump = [b"ITEM: TIMESTEP\n1\nITEM: ", &filling(b'a')[..], b"\n"].concat();
    let csv = [b"x,y,z,", &filling(b'a')[..], b"\n0,0,0,0\n"].concat();
    let cases: [(&str, Vec<u8>); 7] = [
        ("long.1.npy", npy),
        ("long.1.ply", ply),
        ("lines.1.ply", lines),
        ("long.1.vtk", vtk),
        ("long.1.vtu", vtu),
        ("long.1.dump", dump),
        ("long.1.csv", csv),
    ];
    for (name, bytes) in cases {
        let scene = Scene::new();
        scene.write(format!("in/{name}"), &bytes);
        scene.assert_costs_itself_alone(name, "", most_of(bytes.len() as u64));
    }
}

/// More attributes than any reader accepts, of one particle each.
#[test]
fn attributes_without_end_are_refused() {
    for (name, text) in [
        ("many.1.ply", ply_properties()),
        ("many.1.csv", columns("x,y,z", ",a", "\n0,0,0", ",0")),
        ("many.1.vtk", vtk_arrays()),
        ("many.1.vtp", vtk_elements()),
        (
            "many.1.dump",
            columns(
                "ITEM: TIMESTEP\n1\nITEM: NUMBER OF ATOMS\n1\nITEM: BOX BOUNDS pp pp pp\n0 1\n0 1\n0 1\n\
            ITEM: ATOMS x y z",
                " a",
                "\n0 0 0",
                " 0",
            ),
        ),
    ] {
        let scene = Scene::new();
        scene.write(format!("in/{name}"), &text);
        scene.assert_costs_itself_alone(name, "", most_of(text.len() as u64));
    }
    let scene = Scene::new();
    let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (0, 3), }";
    let array = [&b"\x93NUMPY\x01\0v\0"[..], format!("{header:<117}\n").as_bytes()].concat();
    let names: Vec<String> = (0..0xffff).map(|number| format!("a{number}.npy")).collect();
    scene.write("in/many.1.npz", archive(&names, &array, array.len() as u32, 0));
    scene.assert_costs_itself_alone("many.1.npz", "more than the limit", most_of(64 << 20));
}

fn columns(start: &str, column: &str, second: &str, value: &str) -> String {
    let mut text = start.to_owned();
    for index in 0..attribute_count() {
        write!(text, "{column}{index}").expect("written");
    }
    text + second + &value.repeat(attribute_count()) + "\n"
}

fn ply_properties() -> String {
    let mut text = "ply\nformat ascii 1.0\nelement vertex 1\n".to_owned();
    for index in 0..attribute_count() {
        writeln!(text, "property float a{index}").expect("written");
    }
    text + "end_header\n" + &"0 ".repeat(attribute_count()) + "\n"
}

fn vtk_arrays() -> String {
    let mut text =
        "# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 1 float\n0 0 0\nPOINT_DATA 1\n"
            .to_owned();
    for index in 0..attribute_count() {
        write!(text, "SCALARS a{index} float 1\nLOOKUP_TABLE default\n0\n").expect("written");
    }
    text
}

fn vtk_elements() -> String {
    let mut text = "<VTKFile type=\"PolyData\" version=\"1.0\" byte_order=\"LittleEndian\"><PolyData>\
        <Piece NumberOfPoints=\"1\"><Points><DataArray type=\"Float32\" NumberOfComponents=\"3\" format=\"ascii\">0 0 0\
        </DataArray></Points><PointData>"
        .to_owned();
    for index in 0..attribute_count() {
        write!(text, "<DataArray type=\"Float32\" Name=\"a{index}\" format=\"ascii\">0</DataArray>")
            .expect("written");
    }
    text + "</PointData></Piece></PolyData></VTKFile>"
}
