//! Files whose frames are not ranges of their bytes, and that name other files: lists of VTK files.

use std::fmt::Write;
use std::fs;
use std::path::Path;

use serde_json::Value;
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, block, meniscus, names_in};

const OUT: [&str; 3] = ["--out=out", "--format=obj", "--spacing=0.1"];

/// Particles as a `.vtp`, with their ids from `first` on.
pub(crate) fn vtp(particles: &[[f64; 3]], first: usize) -> String {
    let rows = particles.iter().fold(String::new(), |mut rows, [x, y, z]| {
        write!(rows, "{} {} {} ", *x as f32, *y as f32, *z as f32).expect("strings take everything");
        rows
    });
    let ids: String = (first..first + particles.len()).map(|id| format!("{id} ")).collect();
    format!(
        "<VTKFile type=\"PolyData\"><PolyData><Piece NumberOfPoints=\"{}\">\
         <PointData><DataArray type=\"Int32\" Name=\"id\" format=\"ascii\">{ids}</DataArray></PointData><Points>\
         <DataArray type=\"Float32\" NumberOfComponents=\"3\" format=\"ascii\">{rows}</DataArray></Points>\
         </Piece></PolyData></VTKFile>\n",
        particles.len(),
    )
}

/// A `.pvd` of files with their times.
pub(crate) fn pvd<'a>(entries: impl IntoIterator<Item = (f64, &'a str)>) -> String {
    let entries = entries.into_iter().fold(String::new(), |mut text, (time, file)| {
        writeln!(text, "<DataSet timestep=\"{time}\" group=\"\" part=\"0\" file=\"{file}\"/>")
            .expect("strings take everything");
        text
    });
    format!("<VTKFile type=\"Collection\" version=\"0.1\"><Collection>\n{entries}</Collection></VTKFile>\n")
}

/// The two pieces of a frame, in the folder `run`, and their names.
fn write_pieces(folder: &Path, number: usize) -> [String; 2] {
    fs::create_dir_all(folder.join("run")).expect("made");
    let particles = block(5, 0.02 * number as f64);
    let (start, end) = particles.split_at(60);
    [(start, 0), (end, 60)].map(|(particles, first)| {
        let name = format!("run/{number}_{first}.vtp");
        fs::write(folder.join(&name), vtp(particles, first)).expect("written");
        name
    })
}

/// A folder with a `.pvd` of this many times, a 25th of a second apart, and two pieces for each.
fn run(count: usize) -> TempDir {
    let folder = tempdir().expect("a folder");
    write_run(folder.path(), count);
    folder
}

fn write_run(folder: &Path, count: usize) {
    let pieces: Vec<[String; 2]> = (0..count).map(|number| write_pieces(folder, number)).collect();
    let entry = |(number, pair): (usize, &[String; 2])| pair.clone().map(|name| (0.04 * number as f64, name));
    let entries: Vec<(f64, String)> = pieces.iter().enumerate().flat_map(entry).collect();
    fs::write(folder.join("run.pvd"), pvd(entries.iter().map(|(time, name)| (*time, &**name))))
        .expect("written");
}

fn convert(folder: &Path, more: &[&str]) -> RunResult {
    meniscus(folder, &[&["convert"][..], &OUT, more].concat())
}

fn succeeded(result: &RunResult) {
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
}

/// The lines of an .obj without its provenance comments.
fn surface(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    text.lines().filter(|line| !line.starts_with('#')).collect::<Vec<_>>().join("\n")
}

#[test]
fn each_time_of_a_list_is_a_frame() {
    let folder = run(3);
    let folder = folder.path();
    let result = convert(folder, &["run.pvd", "--report=report.json"]);
    succeeded(&result);
    assert!(result.out.contains("run.pvd/step={}: 3 frames"), "{}", result.out);
    assert_eq!(names_in(&folder.join("out")), ["run.0.obj", "run.1.obj", "run.2.obj"]);
    fs::write(folder.join("alone.vtp"), vtp(&block(5, 0.02), 0)).expect("written");
    succeeded(&convert(folder, &["alone.vtp"]));
    assert_eq!(surface(&folder.join("out/run.1.obj")), surface(&folder.join("out/alone.obj")));
    // The pieces are not in the folder, so the folder means the list.
    succeeded(&convert(folder, &["run.pvd/step=2", "--skip-done"]));
    fs::remove_file(folder.join("alone.vtp")).expect("removed");
    let all = convert(folder, &[".", "--skip-done"]);
    assert_eq!(all.out.matches("done already").count(), 3, "{}{}", all.out, all.err);
    let info = meniscus(folder, &["info", "--json", "run.pvd"]);
    let info: Value = serde_json::from_str(&info.out).expect("JSON");
    let of = |index: usize| (&info[index]["kind"], &info[index]["time"], &info[index]["particles"]["count"]);
    assert_eq!(of(0), (&"ParaView index".into(), &0.0.into(), &125.into()));
    assert_eq!(of(2), (&"ParaView index".into(), &0.08.into(), &125.into()));
    let text = meniscus(folder, &["info", "run.pvd/step=1"]).out;
    assert!(text.contains("time                 0.04 s"), "{text}");
    // A condition on an attribute of all pieces.
    let chosen = convert(folder, &["run.pvd/step=0", "--where", "id >= 60", "--print-settings"]);
    assert_eq!(chosen.status, 0, "{}", chosen.err);
    let few = meniscus(folder, &["convert", "run.pvd", "--out=few", "--where=id < 60", "--particles-only"]);
    assert_eq!(few.status, 0, "{}", few.err);
    let count = meniscus(folder, &["info", "--json", "few/run.1.ply"]);
    assert!(count.out.contains("\"count\": 60"), "{}", count.out);
}

#[test]
fn times_give_the_frame_rate_of_a_sequence_file() {
    let folder = run(3);
    let folder = folder.path();
    let fps = |more: &[&str]| {
        let arguments =
            ["convert", "run.pvd", "--out=glb", "--format=glb", "--spacing=0.1", "--sequence=all.glb"];
        succeeded(&meniscus(folder, &[&arguments[..], more].concat()));
        let info = meniscus(folder, &["info", "--json", "all.glb"]).out;
        let info: Value = serde_json::from_str(&info).expect("JSON");
        info[0]["shot"]["fps"].as_f64()
    };
    assert_eq!((fps(&[]), fps(&["--fps=30"])), (Some(25.0), Some(30.0)));
}

#[test]
fn done_frames_of_a_list_stay_valid_when_it_grows() {
    let folder = run(2);
    let folder = folder.path();
    succeeded(&convert(folder, &["run.pvd", "--skip-done"]));
    let modified =
        |name: &str| fs::metadata(folder.join(name)).and_then(|file| file.modified()).expect("there");
    let before = modified("out/run.1.obj");
    write_run(folder, 3);
    let result = convert(folder, &["run.pvd", "--skip-done"]);
    succeeded(&result);
    assert_eq!(result.out.matches("done already").count(), 2, "{}", result.out);
    assert_eq!(modified("out/run.1.obj"), before);
    succeeded(&meniscus(folder, &["verify", "out", "--input", "run.pvd"]));
    // A changed piece makes its frame out of date, and no other.
    fs::write(folder.join("run/1_60.vtp"), vtp(&block(5, 0.5)[60..], 60)).expect("written");
    let result = meniscus(folder, &["verify", "out", "--input", "run.pvd"]);
    assert_eq!(result.status, 1, "{}", result.out);
    assert!(result.err.contains("run.1: stale") && !result.err.contains("run.0"), "{}", result.err);
    let result = convert(folder, &["run.pvd", "--skip-done"]);
    assert_eq!(result.out.matches("done already").count(), 2, "{}", result.out);
}

#[test]
fn missing_piece_fails_its_frame() {
    let folder = run(3);
    let folder = folder.path();
    fs::remove_file(folder.join("run/1_60.vtp")).expect("removed");
    let result = convert(folder, &["run.pvd", "--on-error=continue"]);
    assert_eq!(result.status, 1, "{}", result.out);
    let message = "run.pvd/step=1: ParaView index: the file run/1_60.vtp, which it names, is missing";
    assert!(result.err.contains(message), "{}", result.err);
    assert_eq!(names_in(&folder.join("out")), ["run.0.obj", "run.2.obj"]);
    // A list of one frame has no steps.
    fs::write(folder.join("gone.pvd"), pvd([(0.0, "gone.vtp")])).expect("written");
    let result = convert(folder, &["gone.pvd"]);
    assert!(result.err.contains("gone.pvd: ParaView index: the file gone.vtp"), "{}", result.err);
    let result = convert(folder, &["run.pvd/step=3"]);
    assert!(result.err.contains("there is no step 3"), "{}", result.err);
    fs::write(folder.join("out.pvd"), pvd([(0.0, "../gone.vtp")])).expect("written");
    let result = meniscus(folder, &["info", "out.pvd"]);
    assert!(result.err.contains("outside of its own folder"), "{}", result.err);
}

#[test]
fn folder_has_each_frame_once() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    let write = |name: &str, text: String| fs::write(folder.join(name), text).expect("written");
    // A list of frames beside it.
    for number in 0..2 {
        write(&format!("a.{number}.vtp"), vtp(&block(5, 0.0), 0));
    }
    write("a.pvd", pvd([(0.0, "a.0.vtp"), (0.5, "a.1.vtp")]));
    let result = convert(folder, &["."]);
    succeeded(&result);
    assert!(result.out.contains("skipped a.pvd: a list of other files"), "{}", result.out);
    assert_eq!(names_in(&folder.join("out")), ["a.0.obj", "a.1.obj"]);
    // A file that joins pieces beside it.
    for name in ["b_0.vtp", "b_1.vtp"] {
        let particles = block(5, 0.0);
        let (start, end) = particles.split_at(60);
        write(name, if name == "b_0.vtp" { vtp(start, 0) } else { vtp(end, 60) });
    }
    let pieces = "<Piece Source=\"b_0.vtp\"/><Piece Source=\"b_1.vtp\"/>";
    write("b.pvtp", format!("<VTKFile type=\"PPolyData\"><PPolyData>{pieces}</PPolyData></VTKFile>"));
    let result = convert(folder, &["."]);
    succeeded(&result);
    assert!(result.out.contains("skipped b_0.vtp and 1 other file: parts of frames"), "{}", result.out);
    assert_eq!(names_in(&folder.join("out")), ["a.0.obj", "a.1.obj", "b.obj"]);
    assert_eq!(surface(&folder.join("out/b.obj")), surface(&folder.join("out/a.0.obj")));
    // Named, the list is converted.
    succeeded(&meniscus(folder, &["convert", "a.pvd", "--out=named", "--format=obj", "--spacing=0.1"]));
    assert_eq!(names_in(&folder.join("named")), ["a.0.obj", "a.1.obj"]);
}

#[test]
fn settings_in_json_are_no_frames() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    let write = |name: &str, text: &str| fs::write(folder.join(name), text).expect("written");
    let particles = serde_json::to_string(&block(5, 0.0)).expect("JSON");
    write("a.0.json", &particles);
    write("settings.json", "{\"gravity\": [0, 0, -9.81], \"particles\": \"a.0.json\"}");
    let result = convert(folder, &["."]);
    succeeded(&result);
    assert!(result.out.contains("skipped settings.json: not a particle file"), "{}", result.out);
    assert_eq!(names_in(&folder.join("out")), ["a.0.obj"]);
}

/// A file from elsewhere does not make the program open other files.
#[test]
fn named_files_are_in_the_folder_of_the_file_that_names_them() {
    let outside = tempdir().expect("a folder");
    fs::write(outside.path().join("far.vtp"), vtp(&block(5, 0.0), 0)).expect("written");
    fs::write(outside.path().join("far.bin"), [0; 1500]).expect("written");
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    let xmf = |path: &str| {
        format!(
            "<Xdmf Version=\"3.0\"><Domain><Grid><Geometry GeometryType=\"XYZ\">\
             <DataItem Dimensions=\"125 3\" NumberType=\"Float\" Precision=\"4\" Format=\"Binary\">{path}</DataItem>\
             </Geometry></Grid></Domain></Xdmf>"
        )
    };
    let list = |path: &str| pvd([(0.0, path)]);
    let layer = |path: &str| format!("#usda 1.0\n( subLayers = [@{path}@] )\n");
    let far = outside.path().join("far.bin");
    let far = far.to_str().expect("a name");
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(outside.path(), folder.join("link")).expect("linked");
        fs::write(outside.path().join("far.usda"), "#usda 1.0\n").expect("written");
    }
    let link = "a link leads out of the folder";
    for (name, text, why) in [
        ("a.xmf", xmf(far), "which is not a path relative to its own folder"),
        ("b.xmf", xmf("../far.bin"), "which is outside of its own folder"),
        ("c.xmf", xmf("far.bin"), "which it names, is missing"),
        ("d.xmf", xmf("link/far.bin"), link),
        ("d.pvd", list("link/far.vtp"), link),
        ("d.usda", layer("link/far.usda"), link),
    ] {
        fs::write(folder.join(name), text).expect("written");
        if why == link && !cfg!(unix) {
            continue;
        }
        let result = convert(folder, &[name]);
        assert_ne!(result.status, 0, "{name}: {}", result.out);
        assert!(result.err.contains(why), "{name}: {}", result.err);
    }
}

#[test]
fn reading_keeps_to_the_memory_limit() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let points: String = (0..27).map(|i| format!("({}, {}, {}),", i % 3, i / 3 % 3, i / 9)).collect();
    let prims: String = (0..8000).map(|i| format!("def \"p{i}\" {{}}\n")).collect();
    let layer = format!("#usda 1.0\n{prims}def Points \"water\" {{ point3f[] points = [{points}] }}\n");
    fs::write(path.join("scene.usda"), layer).expect("written");
    let convert = |memory: &str| {
        meniscus(path, &["convert", "scene.usda", "--out", "out", "--format", "obj", "--memory", memory])
    };
    let refused = convert("4MiB");
    assert_ne!(refused.status, 0, "{}", refused.out);
    assert!(
        refused
            .err
            .contains("reading the file needs more than 4 MiB of memory, the limit: use a larger --memory"),
        "{}",
        refused.err
    );
    assert_eq!(convert("64MiB").status, 0);
}
