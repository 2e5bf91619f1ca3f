//! PLY in all its dialects: files round-trip, and another reader agrees.

use std::path::Path;

use meniscus_formats::NumberType;
use meniscus_formats::ply::{Encoding, PropertyType, read, read_header, read_mesh};
use meniscus_formats::{AttributeRole, Error, FilePositions, Limits, ParticleFrame, Values};

fn read_text(text: &str) -> ParticleFrame {
    read(text.as_bytes(), &Limits::default()).unwrap_or_else(|error| panic!("{error} in {text}"))
}

fn positions(frame: &ParticleFrame) -> Vec<[f64; 3]> {
    match &frame.positions {
        FilePositions::F32(positions) => positions.iter().map(|position| position.map(f64::from)).collect(),
        FilePositions::F64(positions) => positions.clone(),
    }
}

/// The values of an attribute, which must need fewer than 53 bits.
fn values(frame: &ParticleFrame, name: &str) -> Vec<f64> {
    let attribute = frame.attributes.iter().find(|attribute| attribute.name == name);
    match &attribute.unwrap_or_else(|| panic!("no attribute {name}")).values {
        Values::F32(values) => values.iter().map(|&value| f64::from(value)).collect(),
        Values::F64(values) => values.clone(),
        Values::U8(values) => values.iter().map(|&value| f64::from(value)).collect(),
        Values::I32(values) => values.iter().map(|&value| f64::from(value)).collect(),
        Values::I64(values) => values.iter().map(|&value| value as f64).collect(),
        Values::Strings { .. } => Vec::new(),
    }
}

#[test]
fn headers_with_any_line_end_precede_a_binary_body() {
    for end in ["\n", "\r\n", "\r"] {
        let lines = "ply;format binary_little_endian 1.0;comment by hand;element vertex 2;\
                     property float x;property float y;property float z;property uchar k;end_header;";
        let mut file = lines.replace(';', end).into_bytes();
        // The first byte of the body looks like a line end.
        let x = f32::from_le_bytes([b'\n', b'\r', b'\n', 0x40]);
        for (position, k) in [([x, 2.0, 3.0], 10), ([4.0, 5.0, 6.0], 13)] {
            position.iter().for_each(|c: &f32| file.extend(c.to_le_bytes()));
            file.push(k);
        }
        let frame = read(&file, &Limits::default()).unwrap();
        assert_eq!(frame.positions, FilePositions::F32(vec![[x, 2.0, 3.0], [4.0, 5.0, 6.0]]), "with {end:?}");
        assert_eq!(values(&frame, "k"), [10.0, 13.0]);
        let size = read_header(&file, &Limits::default()).unwrap().file_size_min();
        assert_eq!(size, Some(file.len() as u64));
    }
}

#[test]
fn other_elements_and_lists_are_skipped() {
    let text = "ply\nformat ascii 1.0\nelement empty 7\nelement material 2\nproperty list uchar float shine\n\
                property int k\nelement Vertex 2\nproperty double z\nproperty list uchar int near\n\
                property double y\nproperty double x\nproperty float diameter\nelement face 1\n\
                property list uchar int vertex_indices\nend_header\n\
                2 0.5 0.5 1\n\n0 2\n 3 0 2 1 4\t\r\n6 2 8 9 5 4 1\n3 0 1 1\n";
    let frame = read_text(text);
    assert_eq!(positions(&frame), [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
    assert_eq!(frame.attributes[0].role, Some(AttributeRole::Radius));
    assert_eq!(values(&frame, "diameter"), [2.0, 0.5], "halved");
    assert_eq!(frame.notes.len(), 3, "diameter, list, faces: {:?}", frame.notes);
}

#[test]
fn particles_are_read_from_an_element_with_another_name() {
    let text = "ply\nformat ascii 1.0\nelement particle 1\nproperty float px\nproperty float py\n\
                property float pz\nend_header\n1 2 nan\n";
    let frame = read_text(text);
    assert!(positions(&frame)[0][2].is_nan(), "readers do not validate positions");
    assert_eq!(frame.notes, ["no element is named `vertex`: the particles are read from `particle`"]);
}

#[test]
fn positions_keep_their_precision() {
    let cases = [
        (["float", "float", "float"], true),
        (["double", "double", "double"], false),
        (["float", "double", "float"], false),
        (["int", "int", "int"], false),
        (["short", "uchar", "float"], true),
    ];
    for (types, is_f32) in cases {
        let properties: String = types
            .iter()
            .zip(["x", "y", "z"])
            .fold(String::new(), |text, (kind, name)| text + &format!("property {kind} {name}\n"));
        let text = format!("ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n100 200 30\n");
        let frame = read_text(&text);
        assert_eq!(matches!(frame.positions, FilePositions::F32(_)), is_f32, "of {types:?}");
        assert_eq!(positions(&frame), [[100.0, 200.0, 30.0]]);
    }
}

/// The RealSense Viewer writes the color of a vertex in a line of its own.
#[test]
fn vertex_over_two_lines_is_read() {
    let header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                  property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n\
                  property list uchar int vertex_index\nend_header\n";
    let body = "0 1 2 \n255 10 0 \n3 4 5\n\n255 10 1\n6 7 8\n255 10 2\n3 0 1 2\n";
    let frame = read_text(&format!("{header}{body}"));
    assert_eq!(positions(&frame), [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0, 8.0]]);
    assert_eq!(values(&frame, "color")[6..], [255.0, 10.0, 2.0]);
    let mesh = read_mesh(format!("{header}{body}").as_bytes(), &Limits::default()).expect("a mesh");
    assert_eq!(mesh.triangles, [[0, 1, 2]]);
    for (wrong, expected) in [
        (
            "0 1 2\n255 10 0\n3 4\n5 255 10 0 6 7 8 9\n",
            "at line 16: the values of a record end within the line",
        ),
        (
            "0 1 2 255 10 0\n3 4 5\n255 10 1\n6 7 8 255 10 2\n",
            "at line 14: the line ends where a value of `red`",
        ),
        (
            "0.000 1.000 2.000\n255 10 0\n3.000 4.000 5.000\n255 10",
            "the file ends where a value of `blue` was expected",
        ),
    ] {
        let error =
            read(format!("{header}{wrong}").as_bytes(), &Limits::default()).expect_err(wrong).to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn file_without_particles_is_an_empty_frame() {
    let properties = "property float x\nproperty float y\nproperty float z\n";
    for encoding in ["ascii", "binary_little_endian"] {
        let frame =
            read_text(&format!("ply\nformat {encoding} 1.0\nelement vertex 0\n{properties}end_header\n"));
        assert!(frame.positions.is_empty());
    }
}

#[test]
fn files_beyond_limits_are_errors() {
    let header =
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
    let text = format!("{header}end_header\n1 2 3\n1 2 3\n1 2 3\n");
    let cases = [
        (Limits { particle_count: 2, ..Limits::default() }, "3 particles, more than the limit of 2"),
        (Limits { header_bytes: 60, ..Limits::default() }, "no `end_header` within the 60 bytes"),
        (Limits { attribute_count: 2, ..Limits::default() }, "more properties than the limit of 2"),
    ];
    for (limits, expected) in cases {
        let error = read(text.as_bytes(), &limits).unwrap_err();
        assert!(matches!(error, Error::TooLarge { .. }), "{error}");
        assert!(error.to_string().contains(expected), "{error}");
    }
}

#[test]
fn faces_are_read_as_triangles() {
    let text = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n\
                property float nx\nproperty float ny\nproperty float nz\nelement face 3\nproperty uchar k\n\
                property list uchar int vertex_index\nend_header\n\
                0 0 0 0 0 1\n1 0 0 0 0 1\n1 1 0 0 0 1\n0 1 0 0 0 1\n0 2 0 0 0 1\n\
                9 3 0 1 2\n9 5 0 1 2 3 4\n9 2 0 1\n";
    let mesh = read_mesh(text.as_bytes(), &Limits::default()).unwrap();
    assert_eq!(mesh.positions[2], [1.0, 1.0, 0.0]);
    assert_eq!(mesh.normals, [[0.0, 0.0, 1.0]; 5]);
    assert_eq!(mesh.triangles, [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4]]);

    let beyond = text.replace("9 2 0 1\n", "9 3 0 1 5\n");
    let error = read_mesh(beyond.as_bytes(), &Limits::default()).unwrap_err().to_string();
    assert!(error.contains("at line 21: a face has vertex index 5, but the file has 5 vertices"), "{error}");

    let file = std::fs::read(corpus().join("meshlab_mesh.ply")).unwrap();
    let mesh = read_mesh(&file, &Limits::default()).unwrap();
    assert_eq!((mesh.positions.len(), mesh.triangles.len()), (642, 1280), "an icosphere: F = 2 V - 4");
}

fn corpus() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus/valid")
}

/// Compares every scalar of every vertex in the corpus with `ply-rs-bw`.
#[test]
fn ply_rs_bw_reads_the_same_values() {
    use ply_rs_bw::{parser::Parser, ply::DefaultElement, ply::Property};
    let mut value_count = 0;
    for entry in std::fs::read_dir(corpus()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|extension| extension != "ply") {
            continue;
        }
        let bytes = std::fs::read(&path).unwrap();
        let frame = read(&bytes, &Limits::default()).unwrap();
        let header = read_header(&bytes, &Limits::default()).unwrap();
        let element = header.vertex_element().unwrap();
        let theirs = Parser::<DefaultElement>::new().read_ply(&mut &bytes[..]).unwrap();
        let theirs = &theirs.payload["vertex"];
        let mut compare = |column: usize, index: usize, ours: f64| {
            let name = &element.properties[column].name;
            let theirs = match theirs[index][name] {
                Property::Float(value) => f64::from(value),
                Property::Double(value) => value,
                Property::UChar(value) => f64::from(value),
                Property::Int(value) => f64::from(value),
                Property::UInt(value) => f64::from(value),
                ref other => panic!("{other:?}"),
            };
            assert_eq!(ours, theirs, "{name} of vertex {index} in {}", path.display());
            value_count += 1;
        };
        let columns = element.columns();
        for (index, position) in positions(&frame).iter().enumerate() {
            for (component, &column) in columns.position.unwrap().iter().enumerate() {
                compare(column, index, position[component]);
            }
        }
        for group in &columns.groups {
            for (index, row) in values(&frame, &group.name).chunks(group.arity()).enumerate() {
                for (component, &column) in group.columns.iter().enumerate() {
                    compare(column, index, row[component]);
                }
            }
        }
    }
    assert!(value_count > 5000);
}

/// A table of vertices to write: names, types, and rows of numbers that fit the types.
#[derive(Clone, Debug)]
struct Vertices {
    columns: Vec<(String, NumberType)>,
    rows: Vec<Vec<f64>>,
    /// Whether a list is between the vertex properties, and an element with a list is before the vertices.
    lists: bool,
    line_end: &'static str,
}

impl Vertices {
    fn write(&self, encoding: Encoding) -> Vec<u8> {
        let name = match encoding {
            Encoding::Ascii => "ascii",
            Encoding::BinaryLittleEndian => "binary_little_endian",
            Encoding::BinaryBigEndian => "binary_big_endian",
        };
        let mut lines = vec!["ply".to_string(), format!("format {name} 1.0")];
        if self.lists {
            lines.push("element other 1\nproperty list uint8 int16 list".replace('\n', self.line_end));
        }
        lines.push(format!("element vertex {}", self.rows.len()));
        for (index, (name, scalar)) in self.columns.iter().enumerate() {
            lines.push(format!("property {} {name}", type_name(*scalar)));
            if self.lists && index == 1 {
                lines.push("property list uint8 int16 list".into());
            }
        }
        lines.push("end_header".into());
        let mut file = (lines.join(self.line_end) + self.line_end).into_bytes();
        if self.lists {
            self.write_list(encoding, &mut file);
            self.end_row(encoding, &mut file);
        }
        for row in &self.rows {
            for (index, (&value, &(_, scalar))) in row.iter().zip(&self.columns).enumerate() {
                write_value(value, scalar, encoding, &mut file);
                if self.lists && index == 1 {
                    self.write_list(encoding, &mut file);
                }
            }
            self.end_row(encoding, &mut file);
        }
        file
    }

    fn write_list(&self, encoding: Encoding, file: &mut Vec<u8>) {
        write_value(2.0, NumberType::U8, encoding, file);
        write_value(-7.0, NumberType::I16, encoding, file);
        write_value(7.0, NumberType::I16, encoding, file);
    }

    fn end_row(&self, encoding: Encoding, file: &mut Vec<u8>) {
        if encoding == Encoding::Ascii {
            file.extend(self.line_end.bytes());
        }
    }
}

fn type_name(scalar: NumberType) -> &'static str {
    match scalar {
        NumberType::I8 => "char",
        NumberType::U8 => "uint8",
        NumberType::I16 => "short",
        NumberType::U16 => "uint16",
        NumberType::I32 => "int",
        NumberType::U32 => "uint32",
        NumberType::F32 => "float32",
        NumberType::F64 => "double",
        _ => panic!("PLY has no {scalar:?}"),
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the value was made for the type"
)]
fn write_value(value: f64, scalar: NumberType, encoding: Encoding, file: &mut Vec<u8>) {
    let (mut bytes, text) = match scalar {
        NumberType::I8 => ((value as i8).to_le_bytes().to_vec(), value.to_string()),
        NumberType::U8 => ((value as u8).to_le_bytes().to_vec(), value.to_string()),
        NumberType::I16 => ((value as i16).to_le_bytes().to_vec(), value.to_string()),
        NumberType::U16 => ((value as u16).to_le_bytes().to_vec(), value.to_string()),
        NumberType::I32 => ((value as i32).to_le_bytes().to_vec(), value.to_string()),
        NumberType::U32 => ((value as u32).to_le_bytes().to_vec(), value.to_string()),
        NumberType::F32 => ((value as f32).to_le_bytes().to_vec(), (value as f32).to_string()),
        NumberType::F64 => (value.to_le_bytes().to_vec(), format!("{value:e}")),
        _ => panic!("PLY has no {scalar:?}"),
    };
    match encoding {
        Encoding::Ascii => file.extend(format!("{text} ").bytes()),
        Encoding::BinaryLittleEndian => file.extend(bytes),
        Encoding::BinaryBigEndian => {
            bytes.reverse();
            file.extend(bytes);
        }
    }
}

/// Random numbers (SplitMix64).
struct Random(u64);

impl Random {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    fn below(&mut self, bound: usize) -> usize {
        usize::try_from(self.bits() % bound as u64).unwrap()
    }

    fn one_of<T: Copy>(&mut self, values: &[T]) -> T {
        values[self.below(values.len())]
    }

    /// Any finite value of the type: one of its limits, or random bits.
    #[expect(clippy::cast_possible_truncation, reason = "the lower bits are as random as the others")]
    fn value(&mut self, scalar: NumberType) -> f64 {
        let bits = [self.bits(), self.bits(), self.bits()];
        let bits = self.one_of(&[bits[0], bits[1], bits[2], 0, 1, u64::MAX, u64::MAX >> 1]);
        let number = match scalar {
            NumberType::I8 => f64::from(bits as i8),
            NumberType::U8 => f64::from(bits as u8),
            NumberType::I16 => f64::from(bits as i16),
            NumberType::U16 => f64::from(bits as u16),
            NumberType::I32 => f64::from(bits as i32),
            NumberType::U32 => f64::from(bits as u32),
            NumberType::F32 => f64::from(f32::from_bits(bits as u32)),
            NumberType::F64 => f64::from_bits(bits),
            _ => panic!("PLY has no {scalar:?}"),
        };
        if number.is_finite() { number } else { self.value(scalar) }
    }

    /// Vertices with x, y and z in this order after a rotation, other attributes, and values of any type.
    fn vertices(&mut self) -> Vertices {
        use NumberType::{F32, F64, I8, I16, I32, U8, U16, U32};
        let mut names: Vec<String> = ["x", "y", "z"].map(String::from).to_vec();
        names.rotate_left(self.below(3));
        names.extend((3..3 + self.below(6)).map(|index| format!("attribute{index}q")));
        let scalars = [I8, U8, I16, U16, I32, U32, F32, F64];
        let columns: Vec<_> = names.into_iter().map(|name| (name, self.one_of(&scalars))).collect();
        let row_count = self.below(20);
        let mut row = || columns.iter().map(|(_, scalar)| self.value(*scalar)).collect();
        let rows = (0..row_count).map(|_| row()).collect();
        Vertices { columns, rows, lists: self.below(2) == 1, line_end: self.one_of(&["\n", "\r\n", "\r"]) }
    }
}

#[test]
fn written_vertices_are_read_back() {
    for seed in 0..256 {
        let vertices = Random(seed).vertices();
        for encoding in [Encoding::Ascii, Encoding::BinaryLittleEndian, Encoding::BinaryBigEndian] {
            let file = vertices.write(encoding);
            let frame = read(&file, &Limits::default()).unwrap();
            assert_eq!(frame.positions.len(), vertices.rows.len(), "{seed}");
            let positions = positions(&frame);
            for (column, (name, scalar)) in vertices.columns.iter().enumerate() {
                let expected: Vec<f64> = vertices.rows.iter().map(|row| row[column]).collect();
                let found = match name.as_str() {
                    "x" => positions.iter().map(|position| position[0]).collect(),
                    "y" => positions.iter().map(|position| position[1]).collect(),
                    "z" => positions.iter().map(|position| position[2]).collect(),
                    _ => values(&frame, name),
                };
                assert_eq!(found, expected, "{seed}: {name} {scalar:?} in {encoding:?}");
            }
            let header = read_header(&file, &Limits::default()).unwrap();
            assert_eq!(header.encoding, encoding);
            let lists = header.elements.iter().flat_map(|element| &element.properties);
            let lists = lists.filter(|property| matches!(property.kind, PropertyType::List { .. })).count();
            assert_eq!(lists, if vertices.lists { 2 } else { 0 }, "{seed}");
        }
    }
}
