//! VTK files: every XML encoding against the same frame, and the legacy format section by section.

use crate::fixtures;

use fixtures::{Compressor, Encoding, Mode, vtk_xml, xz_packed, zlib_packed};
use meniscus_formats::{AttributeRole, FilePositions, Limits, ParticleFrame, Values, read_particles, vtk};

fn read(bytes: &[u8], name: &str) -> ParticleFrame {
    read_particles(bytes, name, &Limits::default()).unwrap_or_else(|error| panic!("{name}: {error}"))
}

#[test]
fn all_xml_encodings_give_the_same_frame() {
    for mode in [Mode::Ascii, Mode::Inline, Mode::AppendedRaw, Mode::AppendedBase64] {
        for compressor in [Compressor::None, Compressor::Zlib, Compressor::Lz4, Compressor::Lzma] {
            for (wide, big_endian) in [(false, false), (false, true), (true, false), (true, true)] {
                let encoding = Encoding { mode, compressor, wide, big_endian };
                let frame = read(&vtk_xml(encoding), "a.vtp");
                let expected = [0.0f32, 1.0, 2.0, 3.0, 4.0].map(|n| [n, n + 0.5, -n]);
                assert_eq!(frame.positions, FilePositions::F32(expected.to_vec()), "{encoding:?}");
                let doubled: Vec<f64> = expected.as_flattened().iter().map(|&x| f64::from(x) * 2.0).collect();
                let found: Vec<_> =
                    frame.attributes.iter().map(|a| (a.name.as_str(), a.role, &a.values)).collect();
                let ids = Values::I64(vec![0, 1, 2, 3, 4]);
                let expected =
                    [("a <velocity>", None, &Values::F64(doubled)), ("id", Some(AttributeRole::Id), &ids)];
                assert_eq!(found, expected, "{encoding:?}");
                assert!(frame.notes.is_empty(), "{:?}", frame.notes);
            }
        }
    }
}

/// Reads files with line breaks in data, a separately encoded header, an empty piece, and arrays that differ
/// between pieces.
#[test]
fn unusual_xml_is_read() {
    let file = |pieces: &str| {
        format!(
            "<VTKFile type=\"UnstructuredGrid\"><UnstructuredGrid>{pieces}</UnstructuredGrid></VTKFile>\r\n"
        )
    };
    let points = "<Points><DataArray type=\"Float32\" NumberOfComponents=\"3\" format=\"ascii\">1 2 3</DataArray></Points>";
    let data = |name: &str| {
        format!(
            "<PointData Scalars=\"a\"><DataArray type=\"Int8\" Name=\"{name}\"> -1 </DataArray></PointData>"
        )
    };
    let text = file(&format!(
        "<Piece NumberOfPoints=\"0\"/><Piece NumberOfPoints=\"1\">{}{points}</Piece><!-- <x> --><Piece NumberOfPoints=\"1\">{points}{}</Piece>",
        data("a"),
        data("b")
    ));
    let frame = read(text.as_bytes(), "a.vtu");
    assert_eq!(frame.positions, FilePositions::F32(vec![[1.0, 2.0, 3.0]; 2]));
    assert_eq!((frame.attributes.len(), frame.notes.len()), (0, 2), "{:?}", frame.notes);

    let letters = ["DAAAAA==\nAACA\nPwAAAEAAAEBA", "DAAAAAAAgD8AAABA\n  AABAQA=="];
    for letters in letters {
        let points = format!(
            "<Points><DataArray type=\"Float32\" NumberOfComponents=\"3\" format=\"binary\">{letters}</DataArray></Points>"
        );
        let text = file(&format!("<Piece NumberOfPoints=\"1\">{points}</Piece>"));
        assert_eq!(
            read(text.as_bytes(), "a.vtu").positions,
            FilePositions::F32(vec![[1.0, 2.0, 3.0]]),
            "{letters}"
        );
    }
    // A single value of one byte. Header and data are encoded together, with less base64 padding than the
    // header alone.
    let points = "<Points><DataArray type=\"UInt8\" NumberOfComponents=\"3\" format=\"ascii\">1 2 3</DataArray></Points>";
    let data =
        "<PointData><DataArray type=\"UInt8\" Name=\"a\" format=\"binary\">AQAAAAc=</DataArray></PointData>";
    let text = file(&format!("<Piece NumberOfPoints=\"1\">{points}{data}</Piece>"));
    assert_eq!(read(text.as_bytes(), "a.vtu").attributes[0].values, Values::U8(vec![7]));
}

#[test]
fn invalid_xml_is_an_error() {
    let good = String::from_utf8(vtk_xml(Encoding {
        mode: Mode::Inline,
        compressor: Compressor::Zlib,
        wide: false,
        big_endian: false,
    }))
    .unwrap();
    let cut = good.len() - 20;
    let table = [
        (
            good.replace("NumberOfPoints=\"3\"", "NumberOfPoints=\"4\""),
            "expected 12 values of 4 bytes, found 36 bytes",
        ),
        (
            good.replace("NumberOfPoints=\"3\"", "NumberOfPoints=\"4000000000\""),
            "expected 12000000000 values",
        ),
        (good.replace("NumberOfPoints=\"3\"", "NumberOfPoints=\"x\""), "found \"x\""),
        (good.replace("type=\"PolyData\"", "type=\"ImageData\""), "\"ImageData\", which is not supported"),
        (good.replace("type=\"PolyData\"", "type=\"PPolyData\""), "use those (.vtp or .vtu)"),
        (good.replace("ZLib", "Zstd"), "compressed with vtkZstdDataCompressor"),
        (good.replace("UInt32\"", "UInt16\""), "unknown header type"),
        (good.replace("<Points>", "<Pts>"), "a piece has no array of points"),
        (
            good.replace("\"Points\" NumberOfComponents=\"3\"", "\"Points\" NumberOfComponents=\"2\""),
            "the array of points has 2 components per point; expected 3",
        ),
        (
            good.replace("format=\"binary\"", "format=\"appended\" offset=\"7\""),
            "should be appended, but the file has no appended data",
        ),
        (good.replace("format=\"binary\"", "format=\"ascii\""), "is not a value of the array's type"),
        (good.replace("eJ", "!!"), "is not valid base64"),
        (good[..cut].to_string(), "the file ends without </VTKFile>"),
    ];
    for (text, words) in table {
        let error = vtk::read_xml(text.as_bytes(), &Limits::default()).expect_err(words).to_string();
        assert!(error.contains(words), "expected `{words}` in: {error}");
    }
    let deep = format!("<VTKFile type=\"PolyData\">{}</VTKFile>", "<a>".repeat(1 << 20));
    assert!(vtk::read_xml(deep.as_bytes(), &Limits::default()).is_err());
}

/// With overlapping arrays, a file of some megabytes would give gigabytes of data.
#[test]
fn overlapping_arrays_are_an_error() {
    let array = |name: usize| {
        format!("<DataArray type=\"UInt8\" Name=\"a{name}\" format=\"appended\" offset=\"0\"/>")
    };
    let arrays: String = (0..4000).map(array).collect();
    let points = "<Points><DataArray type=\"UInt8\" NumberOfComponents=\"3\" format=\"appended\" offset=\"0\"/></Points>";
    let mut bytes = format!(
        "<VTKFile type=\"PolyData\"><PolyData><Piece NumberOfPoints=\"1000000\">{points}<PointData>{arrays}</PointData></Piece>\
         </PolyData><AppendedData encoding=\"raw\">_"
    )
    .into_bytes();
    bytes.extend(3_000_000u32.to_le_bytes());
    bytes.extend(vec![1; 3_000_000]);
    bytes.extend(b"</AppendedData></VTKFile>");
    let error = vtk::read_xml(&bytes, &Limits::default()).unwrap_err().to_string();
    assert!(error.contains("have more bytes in total than the file"), "{error}");
}

/// If the last block could be larger than the others, the memory in the account would be too small.
#[test]
fn last_block_larger_than_the_others_is_an_error() {
    for (compressor, packed) in
        [("ZLib", zlib_packed(&vec![0; 64 << 20])), ("LZMA", xz_packed(&vec![0; 64 << 20]))]
    {
        let bytes = one_compressed_array(compressor, &[1, 1, 64 << 20, packed.len() as u64], &packed);
        let error = vtk::read_xml(&bytes, &Limits::default()).unwrap_err().to_string();
        assert!(
            error.contains("the last block has 67108864 bytes, more than the block size of 1"),
            "{error}"
        );
    }
}

#[test]
fn more_blocks_than_the_file_has_room_for_are_an_error() {
    let bytes = one_compressed_array("ZLib", &[1000, 1, 0], &[]);
    let error = vtk::read_xml(&bytes, &Limits::default()).unwrap_err().to_string();
    assert!(error.contains("expected at least 8024 bytes of "), "{error}");
}

/// A file with one point, whose compressed array has this header.
fn one_compressed_array(compressor: &str, header: &[u64], packed: &[u8]) -> Vec<u8> {
    let mut bytes = format!(
        "<VTKFile type=\"PolyData\" header_type=\"UInt64\" compressor=\"vtk{compressor}DataCompressor\"><PolyData>\
         <Piece NumberOfPoints=\"1\"><Points><DataArray type=\"UInt8\" NumberOfComponents=\"3\" format=\"appended\" \
         offset=\"0\"/></Points></Piece></PolyData><AppendedData encoding=\"raw\">_"
    )
    .into_bytes();
    bytes.extend(header.iter().flat_map(|number| number.to_le_bytes()));
    bytes.extend(packed);
    bytes.extend(b"</AppendedData></VTKFile>");
    bytes
}

const HEAD: &str = "# vtk DataFile Version 3.0\na title\nASCII\nDATASET POLYDATA\n";

#[test]
fn all_sections_of_legacy_files_are_read() {
    let text = format!(
        "{HEAD}FIELD meta 1\nTIME 1 1 double\n0.5\nPOINTS 2 double\n1 2 3 4\n5 6\nVERTICES 2 4\n1 0 1 1\n\
         CELL_DATA 2\nSCALARS c float\nLOOKUP_TABLE default\n9 9\nPOINT_DATA 2\nSCALARS id unsigned_int 1\n\
         LOOKUP_TABLE default\n7 8\nVECTORS vel float\n1 1 1 2 2 2\nNORMALS n float\n0 0 1 0 0 1\n\
         METADATA\nINFORMATION 0\n\nFIELD data 3\na%20name 1 2 short\n-1 -2\nother 1 1 int\n5\nflags 1 2 bit\n1 0\n"
    );
    let frame = read(text.as_bytes(), "a.vtk");
    assert_eq!(frame.positions, FilePositions::F64(vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]));
    let found: Vec<_> = frame.attributes.iter().map(|a| (a.name.as_str(), a.arity, a.role)).collect();
    let expected = [
        ("id", 1, Some(AttributeRole::Id)),
        ("vel", 3, Some(AttributeRole::Velocity)),
        ("n", 3, Some(AttributeRole::Normal)),
        ("a name", 1, None),
    ];
    assert_eq!(found, expected);
    assert_eq!(frame.attributes[3].values, Values::I32(vec![-1, -2]));
    assert_eq!(frame.notes.len(), 2, "{:?}", frame.notes);
}

#[test]
fn polygons_add_a_single_note() {
    let points = format!("{HEAD}POINTS 3 float\n1 2 3 4 5 6 7 8 9\n");
    let xml = |polys: usize| {
        format!(
            "<VTKFile type=\"PolyData\"><PolyData><Piece NumberOfPoints=\"1\" NumberOfPolys=\"{polys}\"><Points>\
             <DataArray type=\"Float32\" NumberOfComponents=\"3\">1 2 3</DataArray></Points></Piece></PolyData></VTKFile>"
        )
    };
    let table = [
        (format!("{points}POLYGONS 1 4\n3 0 1 2\n"), 1),
        (format!("{points}POLYGONS 1 4\n3 0 1 2\nPOLYGONS 1 4\n3 0 1 2\n"), 1),
        (format!("{points}POLYGONS 2 3\nOFFSETS vtktypeint64\n0 3\nCONNECTIVITY vtktypeint64\n0 1 2\n"), 1),
        (format!("{points}POLYGONS 1 0\nOFFSETS vtktypeint64\n0\nCONNECTIVITY vtktypeint64\n"), 0),
        (format!("{points}VERTICES 1 2\n1 0\n"), 0),
        (xml(1), 1),
        (xml(0), 0),
    ];
    for (text, count) in table {
        let notes = read(text.as_bytes(), "a").notes;
        assert_eq!(
            notes,
            vec!["the file also has polygons, which are ignored: only its points are read"; count],
            "{text}"
        );
    }
}

/// Only a line that consists of the word METADATA starts a section to skip, so an array may have this name.
#[test]
fn array_can_be_named_metadata() {
    let text = format!(
        "{HEAD}POINTS 1 float\n1 2 3\nPOINT_DATA 1\nFIELD f 2\nMETADATA\nINFORMATION 0\n\nmetadata 1 1 int\n7\nb 1 1 int\n8\n"
    );
    let frame = read(text.as_bytes(), "a");
    let found: Vec<_> = frame.attributes.iter().map(|a| (a.name.as_str(), &a.values)).collect();
    assert_eq!(found, [("metadata", &Values::I32(vec![7])), ("b", &Values::I32(vec![8]))]);
}

#[test]
fn invalid_legacy_lines_are_errors() {
    let points = format!("{HEAD}POINTS 1 float\n1 2 3\n");
    let table = [
        (format!("{HEAD}POINTS 4000000000 float\n1 2 3\n"), "expected 12000000000 numbers of POINTS"),
        (format!("{HEAD}POINTS -1 float\n"), "expected the number of points, found `-1`"),
        (format!("{HEAD}POINTS 1 float\n1 two 3\n"), "found `two`"),
        (format!("{HEAD}POINTS 1 string\n1 2 3\n"), "the points have the unsupported type `string`"),
        (format!("{points}POINT_DATA 2\n"), "POINT_DATA is for 2 points, but the file has 1"),
        (format!("{points}SCALARS a float\n1\n"), "outside POINT_DATA"),
        (format!("{points}POINT_DATA 1\nFIELD f 1\nnames 1 1 string\nx\n"), "has the unknown type `string`"),
        (format!("{points}POINT_DATA 1\nPOINTS 2 float\n1 2 3 4 5 6\n"), "the file has POINTS twice"),
        (format!("{points}WHAT 1\n"), "found `WHAT`"),
        (points.replace("POLYDATA", "STRUCTURED_POINTS"), "STRUCTURED_POINTS, which is not supported"),
        (points.replace("3.0", "9.0"), "the version is \"9.0\""),
        (points.replace("ASCII", "TEXT"), "expected ASCII or BINARY, found `TEXT`"),
        (points.replace("POINTS 1", "POINTS 5000000000"), "more than the limit"),
    ];
    for (text, words) in table {
        let error = vtk::read_legacy(text.as_bytes(), &Limits::default()).expect_err(words).to_string();
        assert!(error.contains(words), "expected `{words}` in: {error}");
    }
}

#[test]
fn data_can_start_on_the_line_of_its_keyword() {
    let text = "# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\nPOINTS 3 float 0 0 0\n1 0 0 0 1 0\n\
        VERTICES 1 2 1 0\nPOLYGONS 1 4 3\n0 1 2\nPOINT_DATA 3\nVECTORS v float -1 2\n3 4 5 6 7 8 9\n\
        FIELD f 1\nPOINTS 1 3 int 7 8\n9\nNORMALS n float\n0 0 1 0 0 1 0 0 1\n\
        SCALARS s int 1 4\n5 6\nSCALARS r int\nLOOKUP_TABLE default 1\n2 3\n";
    let frame = read_particles(text.as_bytes(), "a", &Limits::default()).expect("three points");
    assert_eq!(frame.positions, FilePositions::F32(vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]));
    let values = |name: &str| &frame.attributes.iter().find(|found| found.name == name).expect(name).values;
    assert_eq!(*values("v"), Values::F32(vec![-1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]));
    assert_eq!(*values("POINTS"), Values::I32(vec![7, 8, 9]));
    assert_eq!(*values("n"), Values::F32([0.0, 0.0, 1.0].repeat(3)));
    assert_eq!(*values("s"), Values::I32(vec![4, 5, 6]));
    assert_eq!(*values("r"), Values::I32(vec![1, 2, 3]));
    let mesh = meniscus_formats::vtk::read_legacy_mesh(text.as_bytes(), &Limits::default());
    assert_eq!(mesh.expect("a triangle").triangles, [[0, 1, 2]]);
}
