//! XDMF files, and the HDF5 and binary files that they name.

use std::io;
use std::sync::Arc;

use meniscus_formats::{
    AttributeRole, ContainerFile, Error, FilePositions, Limits, ParticleFrame, ReadAt, Result, Sample,
    Values, probe, xdmf,
};

use crate::fixtures::{XDMF, hdf5_files};

/// Opens the files of the HDF5 tests, and one of raw numbers.
fn open(path: &str) -> io::Result<Box<dyn ReadAt>> {
    let raw: Vec<u8> = (0..6i32).flat_map(|i| (7 + i).to_be_bytes()).collect();
    let mut files = hdf5_files().into_iter().chain([("raw.bin".to_owned(), [vec![1; 4], raw].concat())]);
    let found = files.find(|(name, _)| name == path);
    found
        .map(|(_, bytes)| Box::new(Arc::<[u8]>::from(bytes)) as Box<dyn ReadAt>)
        .ok_or(io::ErrorKind::NotFound.into())
}

fn samples(text: &str) -> Result<Vec<Sample>> {
    let container = ContainerFile { file: &text.as_bytes(), name: "a.xmf", open: &open };
    Ok(xdmf::frames(&container, &Limits::default())?.samples)
}

fn read(text: &str, index: usize) -> Result<ParticleFrame> {
    let container = ContainerFile { file: &text.as_bytes(), name: "a.xmf", open: &open };
    let limits = Limits::default();
    xdmf::frames(&container, &limits)?.read(&container, index, &limits)
}

fn within(grids: &str) -> String {
    format!("<?xml version=\"1.0\"?>\n<Xdmf Version=\"3.0\"><Domain>{grids}</Domain></Xdmf>\n")
}

fn sample(number: i64, time: f64) -> Sample {
    Sample { number, time: Some(time) }
}

#[test]
fn times_are_frames_with_items_of_all_formats() {
    assert_eq!(probe(XDMF.as_bytes(), "a").to_string(), "XDMF");
    assert_eq!(samples(XDMF).unwrap(), [sample(0, 0.25), sample(1, 0.5)]);
    let frame = read(XDMF, 0).unwrap_or_else(|error| panic!("{error}"));
    let position = |i: f64, step: f64| [i / 2.0 + step, i / 4.0 - 1.0, 3.0 - i];
    let expected: Vec<_> = (0..6).map(|i| position(i.into(), 0.0)).collect();
    assert_eq!(frame.positions, FilePositions::F64(expected));
    let found: Vec<_> =
        frame.attributes.iter().map(|array| (&*array.name, array.arity, array.role)).collect();
    assert_eq!(
        found,
        [("v", 3, Some(AttributeRole::Velocity)), ("id", 1, Some(AttributeRole::Id)), ("raw", 1, None)]
    );
    assert_eq!(frame.attributes[1].values, Values::I32((100..106).collect()));
    assert_eq!(frame.attributes[2].values, Values::I32((7..13).collect()));
    assert_eq!(frame.notes, ["skipped `cell`: it has no values at the points"]);
    // Two grids of one time.
    let frame = read(XDMF, 1).unwrap_or_else(|error| panic!("{error}"));
    let expected: Vec<_> =
        [10.0, 0.0].into_iter().flat_map(|step| (0..6).map(move |i| position(i.into(), step))).collect();
    assert_eq!(frame.positions, FilePositions::F64(expected));
    assert_eq!(frame.attributes[0].values, Values::I64((100..106).chain(100..106).collect()));
    assert!(read(XDMF, 2).is_err());
}

#[test]
fn times_are_found_in_all_places() {
    let point = "<Geometry Type=\"XYZ\"><DataItem Dimensions=\"1 3\">1 2 3</DataItem></Geometry></Grid>";
    let grid = |time: &str| format!("<Grid>{time}{point}");
    let collection =
        |grids: &str| format!("<Grid GridType=\"Collection\" CollectionType=\"Temporal\">{grids}</Grid>");
    let table = [
        (grid("<Time Value=\" 1.5 \"/>"), vec![Some(1.5)]),
        (grid(""), vec![None]),
        (grid("").repeat(2), vec![None]),
        ([grid("<Time Value=\"1\"/>"), grid("<Time Value=\"2\"/>")].concat(), vec![Some(1.0), Some(2.0)]),
        (collection(&grid("").repeat(2)), vec![None, None]),
        (collection(&["<Time Value=\"3\"/>", &grid(""), &grid("")].concat()), vec![Some(3.0), Some(3.0)]),
    ];
    for (grids, expected) in table {
        let found = samples(&within(&grids)).unwrap();
        assert_eq!(found.iter().map(|sample| sample.time).collect::<Vec<_>>(), expected, "of {grids}");
        let frame = read(&within(&grids), 0).unwrap();
        assert!(matches!(&frame.positions, FilePositions::F32(positions) if positions[0] == [1.0, 2.0, 3.0]));
    }
}

#[test]
fn what_cannot_be_read_is_an_error() {
    let item = |attributes: &str, text: &str| {
        within(&format!("<Grid><Geometry><DataItem {attributes}>{text}</DataItem></Geometry></Grid>"))
    };
    let hdf = "Dimensions=\"6 3\" Precision=\"8\" Format=\"HDF\"";
    let table = [
        (item("Dimensions=\"1 3\"", "1 2"), "expected 3 numbers, found 2"),
        (item("Dimensions=\"1 3\"", "1 2 z"), "expected 3 numbers, found z"),
        (
            item("Dimensions=\"1 3\" ItemType=\"HyperSlab\"", ""),
            "an item of the type hyperslab is not supported",
        ),
        (item("", "1 2 3"), "the item has no Dimensions"),
        (item("Dimensions=\"1 3\" Precision=\"3\"", "1 2 3"), "unknown NumberType or Precision"),
        (item(hdf, "gadget.h5"), "expected FILE:/DATA_SET"),
        (item(hdf, "gadget.h5:/PartType0/Masses"), "`PartType0/Masses` has 6 numbers, and 18 were expected"),
        (item(hdf, "gadget.h5:/PartType0/None"), "gadget.h5"),
        (item(hdf, "none/such.h5:/a"), "none/such.h5"),
        (item("Dimensions=\"9 3\" Format=\"Binary\"", "raw.bin"), "has fewer than 27 numbers"),
        (item("Dimensions=\"1 2\"", "1 2"), "the points must be one item, or three"),
        (
            item("Dimensions=\"99999999 9999\" Format=\"HDF\"", "none.h5:/x"),
            "more than 200 times its compressed size",
        ),
        (within("<xi:include href=\"a\"/>"), "xi:include"),
        (within(""), "expected a <Grid>"),
        (within(&"<Grid GridType=\"Tree\">".repeat(40)), "nested more than 16 deep"),
        (within("</Grid>"), "expected no </Grid>"),
    ];
    for (text, words) in table {
        let error = read(&text, 0).expect_err(&text).to_string();
        assert!(error.contains(words), "expected `{words}` in: {error}");
    }
    let mesh = within("<Grid><Geometry GeometryType=\"ORIGIN_DXDYDZ\"/></Grid>");
    assert_eq!(samples(&mesh).unwrap(), []);
    assert!(matches!(read(&mesh, 0), Err(Error::Unsupported { .. })));
    assert!(samples(XDMF.trim_end_matches("</Xdmf>\n")).unwrap_err().is_truncated());
}
