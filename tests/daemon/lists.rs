//! Lists of files that a simulation extends: `.pvd` and the like.

use crate::daemon::scene::{Line, Scene, moving};
use crate::program::containers::{pvd, vtp};

const ARGUMENTS: [&str; 10] = [
    "--pattern",
    "*.pvd",
    "--format",
    "obj",
    "--settle",
    "100ms",
    "--preset",
    "paper",
    "--voxel-size",
    "0.06",
];
const CONVERT: [&str; 6] = ["--format", "obj", "--preset", "paper", "--voxel-size", "0.06"];

fn piece(number: usize) -> String {
    let particles: Vec<[f64; 3]> = moving(number).iter().map(|position| position.map(f64::from)).collect();
    vtp(&particles, 0)
}

/// Writes the list of the first frames, 0 to `last`.
fn write_list(scene: &Scene, last: usize) {
    let names: Vec<String> = (0..=last).map(|number| format!("d/{number}.vtp")).collect();
    scene.write("in/d.pvd", pvd(names.iter().enumerate().map(|(index, name)| (0.5 * index as f64, &**name))));
}

#[test]
fn growing_list_is_followed() {
    let scene = Scene::new();
    for number in 0..2 {
        scene.write(&format!("in/d/{number}.vtp"), piece(number));
    }
    write_list(&scene, 1);
    let daemon = scene.watch(&ARGUMENTS);
    daemon.await_converted("d.pvd/step=0");
    daemon.await_converted("d.pvd/step=1");
    // The list names a piece that is written later.
    write_list(&scene, 2);
    daemon.await_line("a piece is missing", |line| line.is_complaint() && line.is_about("d.pvd/step=2"));
    scene.put("in/d/2.vtp", piece(2));
    daemon.await_converted("d.pvd/step=2");
    scene.put("in/d/3.vtp", piece(3));
    write_list(&scene, 3);
    daemon.await_converted("d.pvd/step=3");
    let log = daemon.finish();
    assert_eq!(log.iter().filter(|line| line.is_converted()).count(), 4);
    // The frames whose pieces did not change were not read again.
    let is_early = |line: &&Line| ["d.pvd/step=0", "d.pvd/step=1"].iter().any(|frame| line.is_about(frame));
    assert_eq!(log.iter().filter(is_early).filter(|line| line.is_found_done()).count(), 0);
    scene.assert_as_converted(&CONVERT);
    let once = scene.once(&ARGUMENTS);
    assert_eq!(once.converted(), [""; 0]);
}

/// Without a pattern, the files of a list beside it are frames, and the list is none.
#[test]
fn list_beside_its_files_is_skipped() {
    let scene = Scene::new();
    for number in 0..2 {
        scene.write(&format!("in/d.{number}.vtp"), piece(number));
    }
    scene.write("in/d.pvd", pvd([(0.0, "d.0.vtp"), (0.5, "d.1.vtp")]));
    let once = scene.once(&ARGUMENTS[2..]);
    once.assert_status(0);
    assert_eq!(once.converted(), ["d.0.vtp", "d.1.vtp"]);
    // The pattern asks for the list.
    let scene = Scene::new();
    scene.write("in/d.0.vtp", piece(0));
    scene.write("in/d.pvd", pvd([(0.0, "d.0.vtp")]));
    let once = scene.once(&ARGUMENTS);
    once.assert_status(0);
    assert_eq!(once.converted(), ["d.pvd"]);
}

/// The list stays as it is, and so does the size of the file.
#[test]
fn rewritten_file_of_a_list_is_seen() {
    for is_alone in [false, true] {
        let scene = Scene::new();
        for number in 0..2 {
            scene.write(&format!("in/d/{number}.vtp"), piece(number));
        }
        write_list(&scene, usize::from(!is_alone));
        let (frame, name) = if is_alone { ("d.pvd", "d.pvd") } else { ("d.pvd/step=0", "step=0") };
        scene.once(&ARGUMENTS).assert_status(0);
        // Copied, but not changed.
        scene.put("in/d/0.vtp", piece(0));
        let once = scene.once(&ARGUMENTS);
        assert_eq!((once.converted(), once.found_done()), (vec![], vec![name.to_owned()]));
        assert_eq!(scene.once(&ARGUMENTS).found_done(), [""; 0]);
        // While no daemon runs.
        scene.put("in/d/0.vtp", piece(5));
        assert_eq!(scene.once(&ARGUMENTS).converted(), [name]);
        scene.assert_as_converted(&CONVERT);
        // A failed frame is read again, too.
        scene.put("in/d/0.vtp", "<VTKFile type=\"PolyData\"><PolyData></PolyData></VTKFile>\n");
        scene.once(&ARGUMENTS).assert_status(1 + i32::from(is_alone));
        scene.put("in/d/0.vtp", piece(5));
        scene.once(&ARGUMENTS).assert_status(0);
        scene.assert_as_converted(&CONVERT);
        // While a daemon runs.
        let daemon = scene.watch(&[&ARGUMENTS[..], &["--poll", "200ms"]].concat());
        scene.put("in/d/0.vtp", "<VTKFile type=\"PolyData\"><PolyData></PolyData></VTKFile>\n");
        daemon.await_line("the frame fails", |line| line.is_complaint() && line.is_about(frame));
        scene.put("in/d/0.vtp", piece(6));
        daemon.await_converted(frame);
        daemon.finish();
        scene.assert_as_converted(&CONVERT);
    }
}
