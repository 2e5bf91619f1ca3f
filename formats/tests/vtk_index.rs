//! Files that list VTK files: which files become a frame, what their frame is, and what is refused.

use std::collections::BTreeMap;
use std::io;

use meniscus_formats::container::{self, frames};
use meniscus_formats::{
    AttributeRole, ContainerFile, Error, FilePositions, Format, Limits, Loaded, ParticleFrame, ProbedKind,
    ReadAt, Result, Sample, Values, neighbor, particles_of, probe, read_particles,
};

const KIND: ProbedKind = ProbedKind::Format(Format::VtkIndex);

/// Files by their paths.
type Folder = BTreeMap<String, String>;

/// A `.vtp` with these points along x, an `id`, and these further arrays of one component.
fn piece(xs: &[f32], more: &[&str]) -> String {
    let values = |f: &dyn Fn(f32) -> String| xs.iter().map(|&x| f(x)).collect::<Vec<_>>().join(" ");
    let array = |name: &str| {
        let values = values(&|x| (10.0 * x).to_string());
        format!("<DataArray type=\"Float32\" Name=\"{name}\" format=\"ascii\">{values}</DataArray>")
    };
    format!(
        "<VTKFile type=\"PolyData\"><PolyData><Piece NumberOfPoints=\"{}\">\
         <PointData><DataArray type=\"Int32\" Name=\"id\" format=\"ascii\">{}</DataArray>{}</PointData>\
         <Points><DataArray type=\"Float32\" NumberOfComponents=\"3\" format=\"ascii\">{}</DataArray></Points>\
         </Piece></PolyData></VTKFile>\n",
        xs.len(),
        values(&|x| format!("{x:.0}")),
        more.iter().map(|name| array(name)).collect::<String>(),
        values(&|x| format!("{x} 0.5 -1")),
    )
}

/// A `.vtp` of one triangle.
fn mesh() -> String {
    "<VTKFile type=\"PolyData\"><PolyData><Piece NumberOfPoints=\"3\" NumberOfPolys=\"1\"><Points>\
     <DataArray type=\"Float32\" NumberOfComponents=\"3\" format=\"ascii\">7 0 0 8 0 0 7 1 0</DataArray></Points>\
     <Polys><DataArray type=\"Int32\" Name=\"connectivity\" format=\"ascii\">0 1 2</DataArray>\
     <DataArray type=\"Int32\" Name=\"offsets\" format=\"ascii\">3</DataArray></Polys></Piece></PolyData></VTKFile>"
        .to_owned()
}

fn list(kind: &str, content: &str) -> String {
    format!(
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"{kind}\" version=\"0.1\">\n<{kind}>{content}</{kind}>\n</VTKFile>\n"
    )
}

fn collection(entries: &[(&str, &str)]) -> String {
    let entry = |(time, file): &(&str, &str)| {
        format!("  <DataSet timestep=\"{time}\" group=\"\" part=\"0\" file=\"{file}\"/>\n")
    };
    list("Collection", &entries.iter().map(entry).collect::<String>())
}

/// Calls `work` with a container of these bytes beside these files.
fn opened<T>(bytes: &[u8], folder: &Folder, work: impl FnOnce(&ContainerFile) -> T) -> T {
    let open = |path: &str| -> io::Result<Box<dyn ReadAt>> {
        let text = folder.get(path).ok_or(io::ErrorKind::NotFound)?;
        Ok(Box::new(std::sync::Arc::<[u8]>::from(text.as_bytes())))
    };
    work(&ContainerFile { file: &bytes, name: "list", open: &open })
}

fn sample(file: &ContainerFile, number: usize, limits: &Limits) -> Result<Loaded> {
    container::read_sample(KIND, file, &frames(KIND, file, limits)?, number, limits)
}

fn samples_of(index: &str) -> Result<Vec<Sample>> {
    opened(index.as_bytes(), &Folder::new(), |file| Ok(frames(KIND, file, &Limits::default())?.samples))
}

fn frame(index: &str, folder: &Folder, number: usize) -> Result<ParticleFrame> {
    let limits = Limits::default();
    let loaded = opened(index.as_bytes(), folder, |file| sample(file, number, &limits))?;
    particles_of(loaded, "list", &[], &limits)
}

fn xs(frame: &ParticleFrame) -> Vec<f32> {
    match &frame.positions {
        FilePositions::F32(positions) => positions.iter().map(|position| position[0]).collect(),
        FilePositions::F64(_) => panic!("expected 32 bits"),
    }
}

fn names(frame: &ParticleFrame) -> Vec<&str> {
    frame.attributes.iter().map(|attribute| &*attribute.name).collect()
}

fn folder(files: &[(&str, String)]) -> Folder {
    files.iter().map(|(path, text)| ((*path).to_owned(), text.clone())).collect()
}

#[test]
fn files_of_a_time_become_a_frame() {
    let files = folder(&[
        ("a_0.vtp", piece(&[0.0, 1.0], &["rho", "T"])),
        ("sub/a_1.vtp", piece(&[2.0], &["T", "pscale"])),
        ("b.vtp", piece(&[3.0], &["width"])),
    ]);
    // The same time in other words, another order, and a file that is listed twice.
    let pvd =
        collection(&[("0.25", "a_0.vtp"), ("0.5", "b.vtp"), ("2.5e-1", "sub\\a_1.vtp"), ("0.5", "./b.vtp")]);
    let expected = [(0, 0.25), (1, 0.5)].map(|(number, time)| Sample { number, time: Some(time) });
    assert_eq!(samples_of(&pvd).expect("a list"), expected);
    let listed = opened(pvd.as_bytes(), &files, |file| frames(KIND, file, &Limits::default()));
    assert_eq!(
        listed.expect("a list").files.expect("files"),
        [vec!["a_0.vtp", "sub/a_1.vtp"], vec!["b.vtp"]]
    );
    let first = frame(&pvd, &files, 0).expect("two pieces");
    assert_eq!((xs(&first), names(&first)), (vec![0.0, 1.0, 2.0], vec!["id", "T"]));
    assert_eq!(first.attributes[0].values, Values::I32(vec![0, 1, 2]));
    assert_eq!(
        first.notes,
        ["pscale", "rho"].map(|name| format!("skipped the array `{name}`: it is not the same in all pieces"))
    );
    let second = frame(&pvd, &files, 1).expect("one piece");
    assert_eq!(xs(&second), [3.0]);
    assert_eq!(
        (second.attributes[1].role, &second.attributes[1].values),
        (Some(AttributeRole::Radius), &Values::F32(vec![15.0]))
    );
    // A frame does not depend on the other frames, nor on the order of the files of others.
    let longer =
        collection(&[("0.25", "a_0.vtp"), ("0.25", "sub/a_1.vtp"), ("0.5", "b.vtp"), ("0.75", "c.vtp")]);
    let first = |index: &str| {
        opened(index.as_bytes(), &files, |file| sample(file, 0, &Limits::default()).expect("two pieces"))
    };
    assert_eq!(first(&pvd), first(&longer));
}

#[test]
fn every_kind_of_list_is_read() {
    let files = folder(&[
        ("a_0.vtp", piece(&[0.0], &[])),
        ("a_1.vtp", piece(&[1.0], &[])),
        ("d/d_0.vtp", piece(&[5.0], &[])),
        ("d/d_1.vtp", piece(&[6.0], &[])),
        (
            "d/all.pvtp",
            list("PPolyData", "<PPoints/><Piece Source=\"d_0.vtp\"/><Piece Source=\"../d/d_1.vtp\"/>"),
        ),
        (
            "old.vtk",
            "# vtk DataFile Version 3.0\nby hand\nASCII\nDATASET POLYDATA\nPOINTS 1 float\n9 0 0\n"
                .to_owned(),
        ),
        ("table.csv", "x,y,z\n4,5,6\n".to_owned()),
        ("empty.vtm", list("vtkMultiBlockDataSet", "")),
    ]);
    let both = "<DataSet index=\"0\" file=\"a_0.vtp\"/><DataSet index=\"1\"/><DataSet index=\"2\" file=\"a_1.vtp\"/>";
    let series =
        |files: &str| format!("{{\n \"file-series-version\" : \"1.0\",\n \"files\" : [{files}]\n}}\n");
    for (name, text, counts, expected) in [
        (
            "a.pvtp",
            list("PPolyData", "<PPoints/><Piece Source=\"a_0.vtp\"/><Piece Source=\"a_1.vtp\"/>"),
            1,
            &[0.0, 1.0][..],
        ),
        ("a.pvtu", list("PUnstructuredGrid", "<Piece Source=\"a_1.vtp\"/>"), 1, &[1.0]),
        (
            "a.vtm",
            list("vtkMultiBlockDataSet", &format!("<Block index=\"0\">{both}</Block>")),
            1,
            &[0.0, 1.0],
        ),
        ("a.vtpd", list("vtkPartitionedDataSet", both), 1, &[0.0, 1.0]),
        (
            "a.vtpc",
            list("vtkPartitionedDataSetCollection", &format!("<Partitions index=\"0\">{both}</Partitions>")),
            1,
            &[0.0, 1.0],
        ),
        (
            "a.pvd",
            collection(&[("0", "d/all.pvtp"), ("0", "a_0.vtp"), ("1", "old.vtk")]),
            2,
            &[5.0, 6.0, 0.0],
        ),
        ("a.pvd", list("Collection", "<DataSet file=\"old.vtk\"/><DataSet file=\"empty.vtm\"/>"), 1, &[9.0]),
        (
            "a.vtk.series",
            series("{\"name\": \"old.vtk\", \"time\": 0.5}, {\"name\": \"a_0.vtp\", \"time\": 1}"),
            2,
            &[9.0],
        ),
        ("a.vtp.series", series("{\"name\": \"d/all.pvtp\"}, {\"name\": \"a_0.vtp\"}"), 2, &[5.0, 6.0]),
    ] {
        assert_eq!(probe(text.as_bytes(), name).kind, KIND, "{name}");
        assert!(neighbor(text.as_bytes(), name, &text.as_bytes()).is_some(), "{name}");
        assert_eq!(samples_of(&text).expect(name).len(), counts, "{name}");
        assert_eq!(xs(&frame(&text, &files, 0).expect(name)), expected, "{name}");
    }
    let csv = frame(&series("{\"name\": \"table.csv\"}"), &files, 0).expect("a table");
    assert_eq!(csv.positions, FilePositions::F64(vec![[4.0, 5.0, 6.0]]));
    assert!(samples_of(&list("Collection", "")).expect("no files yet").is_empty());
    let times: Vec<_> = samples_of(&series("{\"name\":\"a\"},{\"name\":\"b\"}")).expect("a list");
    assert_eq!(times.iter().map(|sample| sample.time).collect::<Vec<_>>(), [Some(0.0), Some(1.0)]);
}

#[test]
fn meshes_and_grids_beside_particles_are_left_out() {
    let grid = "<VTKFile type=\"ImageData\"><ImageData/></VTKFile>".to_owned();
    let files = folder(&[("p.vtp", piece(&[1.0], &[])), ("wall.vtp", mesh()), ("box.vti", grid)]);
    let found = frame(&collection(&[("0", "p.vtp"), ("0", "wall.vtp"), ("0", "box.vti")]), &files, 0)
        .expect("particles");
    assert_eq!(xs(&found), [1.0]);
    assert_eq!(
        found.notes,
        ["skipped box.vti: it is a grid, not particles", "skipped wall.vtp: it is a mesh, not particles"]
    );
    // Like the file itself.
    let found = frame(&collection(&[("0", "wall.vtp")]), &files, 0).expect("points");
    assert_eq!((xs(&found), found.notes.len()), (vec![7.0, 8.0, 7.0], 1));
    let error = frame(&collection(&[("0", "box.vti")]), &files, 0).expect_err("a grid").to_string();
    assert!(error.contains("box.vti: ") && error.contains("ImageData"), "{error}");
}

#[test]
fn copies_of_points_in_other_pieces_are_left_out() {
    let ghosts = |flags: &str| {
        format!(
            "<PointData><DataArray type=\"UInt8\" Name=\"vtkGhostType\" format=\"ascii\">{flags}</DataArray>"
        )
    };
    let with = |xs: &[f32], flags: &str| piece(xs, &[]).replace("<PointData>", &ghosts(flags));
    let files = folder(&[("a.vtp", with(&[0.0, 1.0], "0 1")), ("b.vtp", with(&[1.0, 2.0, 9.0], "0 0 2"))]);
    let list = list("PPolyData", "<Piece Source=\"a.vtp\"/><Piece Source=\"b.vtp\"/>");
    let found = frame(&list, &files, 0).expect("two pieces");
    assert_eq!(xs(&found), [0.0, 1.0, 2.0]);
    assert_eq!(found.notes, ["left out 2 points that other pieces have, according to `vtkGhostType`"]);
}

#[test]
fn what_is_wrong_with_a_list_is_named() {
    let cut = piece(&[1.0, 2.0], &[]);
    let files = folder(&[
        ("good.vtp", piece(&[1.0], &[])),
        ("cut.vtp", cut[..cut.len() / 2].to_owned()),
        ("bad.vtp", piece(&[1.0], &[]).replace("0.5", "x")),
        ("self.pvd", collection(&[("0", "self.pvd")])),
        ("twice.pvd", collection(&[("0", "good.vtp"), ("1", "good.vtp")])),
        ("table.csv", "x,y,z\n4,5,6\n".to_owned()),
        ("sub/list.pvtp", list("PPolyData", "<Piece Source=\"gone.vtp\"/>")),
    ]);
    let whole = collection(&[("0", "good.vtp")]);
    for (text, is_truncated, words) in [
        (whole[..whole.len() - 12].to_owned(), true, "ends without </VTKFile>"),
        (
            collection(&[("0", "good.vtp"), ("0", "gone.vtp")]),
            true,
            "the file gone.vtp, which it names, is missing",
        ),
        (collection(&[("0", "sub/list.pvtp")]), true, "the file sub/gone.vtp, which it names, is missing"),
        (collection(&[("0", "cut.vtp")]), true, "cut.vtp: the file ends without"),
        (collection(&[("0", "bad.vtp")]), false, "bad.vtp: the array"),
        (collection(&[("soon", "good.vtp")]), false, "the time \"soon\" is not a number"),
        (collection(&[("nan", "good.vtp")]), false, "the time \"nan\" is not a number"),
        (collection(&[("0", "/data/good.vtp")]), false, "not a path relative to its own folder"),
        (collection(&[("0", "C:\\good.vtp")]), false, "not a path relative to its own folder"),
        (collection(&[("0", "../good.vtp")]), false, "outside of its own folder"),
        (collection(&[("0", "self.pvd")]), false, "nested too deep"),
        (collection(&[("0", "twice.pvd")]), false, "twice.pvd: it lists files of several times"),
        (collection(&[("0", "good.vtp"), ("0", "table.csv")]), false, "table.csv: this is delimited text"),
        (
            list("PImageData", "<Piece Source=\"good.vti\"/>"),
            false,
            "expected a list of files, found \"PImageData\"",
        ),
        (list("Collection", ""), false, "it lists no files yet"),
        (
            "{\"file-series-version\":\"1.0\",\"files\":[{\"name\":".to_owned(),
            true,
            "the file ends too early",
        ),
        ("{\"file-series-version\":\"1.0\",\"files\":7}".to_owned(), false, "expected a sequence"),
    ] {
        let error = frame(&text, &files, 0).expect_err(words);
        assert!(error.to_string().contains(words), "{error}\nexpected {words}");
        assert_eq!(matches!(error, Error::Truncated { .. }), is_truncated, "{error}");
    }
    let few = Limits { step_count: 2, particle_count: 1, ..Limits::default() };
    let three = collection(&[("0", "good.vtp"), ("1", "good.vtp"), ("2", "good.vtp")]);
    let error = opened(three.as_bytes(), &files, |file| frames(KIND, file, &few)).expect_err("three");
    assert!(matches!(error, Error::TooLarge { .. }), "{error}");
    let two = folder(&[("a.vtp", piece(&[1.0], &[])), ("b.vtp", piece(&[1.0], &[]))]);
    let pvd = collection(&[("0", "a.vtp"), ("0", "b.vtp")]);
    let error = opened(pvd.as_bytes(), &two, |file| sample(file, 0, &few)).expect_err("two");
    assert!(matches!(error, Error::TooLarge { .. }), "{error}");
    // Alone, without access to other files.
    let error = read_particles(whole.as_bytes(), "a.pvd", &Limits::default()).expect_err("no access");
    assert!(error.to_string().contains("good.vtp"), "{error}");
}

/// A list that names itself and others several times opens few files.
#[test]
fn number_of_files_of_a_frame_is_limited() {
    let entries = |name: &str| -> String {
        (0..300).map(|index| format!("<DataSet file=\"{name}{index}\"/>")).collect()
    };
    let mut files = Folder::new();
    for level in 0..3 {
        for index in 0..300 {
            files.insert(
                format!("{level}.{index}"),
                list("vtkMultiBlockDataSet", &entries(&format!("{}.", level + 1))),
            );
        }
    }
    let error = frame(&list("vtkMultiBlockDataSet", &entries("0.")), &files, 0).expect_err("too many");
    assert!(matches!(error, Error::TooLarge { .. } | Error::Truncated { .. }), "{error}");
}
