//! Pictures of balls with known geometry; picture files, and the command that makes them.

use std::fmt::Write;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::Path;

use exr::prelude::{
    AnyChannels, FlatSamples, Layer, ReadChannels, ReadLayers, read, read_all_flat_layers_from_file,
};
use glam::{DVec3, IVec3};
use meniscus::pipeline::{CameraChoice, PictureScene, Viewpoint, encode_picture};
use meniscus::render::{FAR, Picture, Up};
use meniscus::surface::grid::{Field, Topology, voxel_in_leaf};
use meniscus::surface::level_set::NarrowBand;
use meniscus::surface::space::Lattice;
use meniscus_formats::{OutputFormat, read_provenance};
use rayon::ThreadPoolBuilder;
use tempfile::tempdir;

use crate::program::scene::{block, meniscus, names_in, write_ply, write_sequence};

/// Edge length of a voxel, world units.
const VOXEL_SIZE: f64 = 0.05;

const RADIUS: f64 = 1.0;

const SIZE: [usize; 2] = [240, 160];

/// A ball around the origin; `side` −1 turns it inside out.
fn ball(side: f32) -> NarrowBand {
    let leaves =
        (-4..4).flat_map(|x| (-4..4).flat_map(move |y| (-4..4).map(move |z| IVec3::new(x, y, z) * 8)));
    let topology = Topology::new(leaves.collect());
    let half_width = 6.0;
    let mut phi = Field::splat(topology.len(), half_width);
    for (leaf, origin) in phi.leaves.iter_mut().zip(topology.origins()) {
        for (offset, value) in leaf.values.iter_mut().enumerate() {
            let position = (*origin + voxel_in_leaf(offset)).as_dvec3();
            *value = side * ((position.length() - RADIUS / VOXEL_SIZE) as f32).clamp(-half_width, half_width);
        }
    }
    NarrowBand { topology: topology.into(), phi, half_width }
}

fn viewpoint(spec: &str) -> Viewpoint {
    let camera: CameraChoice = spec.parse().expect("a camera");
    camera.viewpoint([DVec3::NEG_ONE, DVec3::ONE], SIZE[0] as f64 / SIZE[1] as f64, Up::Y)
}

const AWAY: &str = "eye=0:3:4,target=0:0:0,view=40";

fn picture_of(band: &NarrowBand, origin: DVec3, viewpoint: &Viewpoint) -> Picture {
    let lattice = Lattice { voxel_size: VOXEL_SIZE };
    PictureScene { band, lattice, origin, velocity: None, spray: None }.picture(viewpoint, SIZE, true)
}

#[test]
fn picture_of_a_ball_matches_its_geometry() {
    let picture = picture_of(&ball(1.0), DVec3::ZERO, &viewpoint(AWAY));
    // From a distance of 5, the ball's silhouette is at the angle whose sine is RADIUS/5.
    let edge = (RADIUS / 5.0).asin().tan() / 20f64.to_radians().tan() * SIZE[1] as f64 / 2.0;
    let area = std::f64::consts::PI * edge * edge;
    let covered: f64 = picture.coverage.iter().map(|&part| f64::from(part)).sum();
    assert!((covered / area - 1.0).abs() < 0.01, "{covered} pixels of {area}");
    let data = picture.data.expect("data");
    let middle = SIZE[1] / 2 * SIZE[0] + SIZE[0] / 2;
    assert!((f64::from(data.depth[middle]) - 4.0).abs() < 0.005, "{}", data.depth[middle]);
    assert_eq!(data.depth[0], FAR);
    let mut count = 0;
    for pixel in (0..picture.coverage.len()).filter(|&pixel| data.depth[pixel] < FAR) {
        let position = DVec3::from(data.positions[pixel].map(f64::from));
        let normal = DVec3::from(data.normals[pixel].map(f64::from));
        assert!((position.length() - RADIUS).abs() < 0.01, "{position}");
        assert!(normal.dot(position.normalize()) > 0.995, "{normal} at {position}");
        assert!((f64::from(data.curvatures[pixel]) * RADIUS - 1.0).abs() < 0.1, "{}", data.curvatures[pixel]);
        count += 1;
    }
    assert!((f64::from(count) / area - 1.0).abs() < 0.05, "{count} of {area}");
}

/// A picture does not depend on the world position of the level set's origin, if the camera moves with it.
#[test]
fn picture_does_not_depend_on_the_origin_of_the_level_set() {
    let origin = DVec3::new(10.0, -3.0, 0.5);
    let here = picture_of(&ball(1.0), DVec3::ZERO, &viewpoint(AWAY));
    let there = picture_of(&ball(1.0), origin, &viewpoint(AWAY).moved(origin));
    assert_eq!(here.size, there.size);
    let off = here.color.as_flattened().iter().zip(there.color.as_flattened()).map(|(a, b)| (a - b).abs());
    assert!(off.fold(0.0, f32::max) < 0.02);
    let middle = SIZE[1] / 2 * SIZE[0] + SIZE[0] / 2;
    let position = |picture: &Picture| {
        DVec3::from(picture.data.as_ref().expect("data").positions[middle].map(f64::from))
    };
    assert!((position(&there) - position(&here)).distance(origin) < 1e-4);
}

#[test]
fn inverted_surface_is_orange() {
    let middle = SIZE[1] / 2 * SIZE[0] + SIZE[0] / 2;
    let [right, wrong] =
        [1.0, -1.0].map(|side| picture_of(&ball(side), DVec3::ZERO, &viewpoint(AWAY)).color[middle]);
    assert!(right[2] > right[0], "{right:?} is not blue");
    assert!(wrong[0] > 1.5 * wrong[2], "{wrong:?} is not orange");
}

#[test]
fn files_do_not_depend_on_threads() {
    let of_threads = |count: usize| {
        let pool = ThreadPoolBuilder::new().num_threads(count).build().expect("threads");
        pool.install(|| {
            let viewpoint = viewpoint("azimuth=10");
            let picture = picture_of(&ball(1.0), DVec3::ZERO, &viewpoint);
            [OutputFormat::Png, OutputFormat::Exr]
                .map(|format| encode_picture(&picture, Some(&viewpoint), format, &[]).expect("encoded"))
        })
    };
    assert!(of_threads(1) == of_threads(2));
}

/// The names of the layers in a file, and of their channels.
fn layers_of(path: &Path) -> Vec<(String, Vec<String>)> {
    let file = BufReader::new(File::open(path).expect("there"));
    let image = read().no_deep_data().largest_resolution_level().all_channels().all_layers().all_attributes();
    let image = image.from_buffered(file).expect("an image");
    let layers = image.layer_data.iter().map(|layer| {
        assert_eq!((layer.size.0, layer.size.1), (64, 48));
        assert!(
            layer.attributes.world_to_camera.is_some()
                && layer.attributes.world_to_normalized_device.is_some()
        );
        let name = layer.attributes.layer_name.as_ref().expect("a name").to_string();
        (name, layer.channel_data.list.iter().map(|channel| channel.name.to_string()).collect())
    });
    layers.collect()
}

fn velocity_in_the_middle(path: &Path) -> DVec3 {
    let image = read_all_flat_layers_from_file(path).expect("an image");
    let is_velocity = |layer: &&Layer<AnyChannels<FlatSamples>>| {
        layer.attributes.layer_name.as_ref().is_some_and(|name| name == "velocity")
    };
    let layer = image.layer_data.iter().find(is_velocity).expect("a layer");
    let middle = layer.size.1 / 2 * layer.size.0 + layer.size.0 / 2;
    let channels = &layer.channel_data.list;
    let along = [0, 1, 2].map(|axis| channels[axis].sample_data.value_by_flat_index(middle).to_f32());
    DVec3::from(along.map(f64::from))
}

fn camera_in(path: &Path) -> String {
    let kind = if path.extension().is_some_and(|extension| extension == "png") {
        OutputFormat::Png
    } else {
        OutputFormat::Exr
    };
    let pairs = read_provenance(kind, File::open(path).expect("there")).expect("readable");
    pairs.into_iter().find(|(name, _)| name == "camera").expect("a camera").1
}

#[test]
fn particles_and_level_sets_become_pictures() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let mut text = String::from("x,y,z,vx,vy,vz\n");
    for i in 0..512 {
        let [x, y, z] = [i % 8, i / 8 % 8, i / 64].map(|along| f64::from(along) * 0.1);
        writeln!(text, "{x},{y},{z},1,2,3").expect("strings take everything");
    }
    fs::write(path.join("drop.csv"), text).expect("written");
    let result = meniscus(path, &["render", "drop.csv", "-o", "drop.exr", "--size", "64x48"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    let of_vector = |name: &str| ["X", "Y", "Z"].map(|axis| format!("{name}.{axis}")).to_vec();
    let expected = [
        ("beauty", vec!["A".to_owned(), "B".into(), "G".into(), "R".into()]),
        ("coverage", vec!["Y".into()]),
        ("depth", vec!["Z".into()]),
        ("normals", of_vector("N")),
        ("position", of_vector("P")),
        ("velocity", of_vector("V")),
        ("curvature", vec!["Y".into()]),
    ];
    assert_eq!(
        layers_of(&path.join("drop.exr")),
        expected.map(|(name, channels)| (name.to_owned(), channels))
    );

    // The command accepts the camera of an earlier picture.
    let first = fs::read(path.join("drop.exr")).expect("there");
    let again = ["render", "drop.csv", "-o", "again.exr", "--size", "64x48", "--camera-from", "drop.exr"];
    assert_eq!(meniscus(path, &again).status, 0);
    assert!(fs::read(path.join("again.exr")).expect("there") == first);

    let result = meniscus(path, &["convert", "drop.csv", "--out", "o", "--format", "vdb"]);
    assert_eq!(result.status, 0, "{}", result.err);
    let turn = ["render", "o", "--out", "turn", "--format", "exr", "--size", "64x48", "--turntable", "3"];
    let result = meniscus(path, &turn);
    assert_eq!(result.status, 0, "{}", result.err);
    assert_eq!(names_in(&path.join("turn")), ["drop.000.exr", "drop.001.exr", "drop.002.exr"]);
    assert_ne!(camera_in(&path.join("turn/drop.000.exr")), camera_in(&path.join("turn/drop.001.exr")));
    assert_eq!(layers_of(&path.join("turn/drop.001.exr")).len(), 6);

    // The picture of a level set with velocities has a layer for them.
    let with_velocities =
        ["convert", "drop.csv", "--out", "v", "--format", "vdb", "--attributes", "velocity"];
    assert_eq!(meniscus(path, &with_velocities).status, 0);
    let result = meniscus(path, &["render", "v", "-o", "v.exr", "--size", "64x48"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    let [of_particles, of_level_set] =
        ["drop.exr", "v.exr"].map(|name| velocity_in_the_middle(&path.join(name)));
    assert_eq!(layers_of(&path.join("v.exr")), layers_of(&path.join("drop.exr")));
    assert!(of_particles.distance(DVec3::new(1.0, 2.0, 3.0)) < 1e-4, "{of_particles}");
    assert!(of_level_set.distance(of_particles) < 1e-4, "{of_level_set}");

    let result = meniscus(path, &["render", "drop.csv", "-o", "two.png", "--size", "120x40", "--particles"]);
    assert_eq!(result.status, 0, "{}", result.err);
    let decoder = png::Decoder::new(BufReader::new(File::open(path.join("two.png")).expect("there")));
    let reader = decoder.read_info().expect("a picture");
    assert_eq!((reader.info().width, reader.info().height), (120, 40));
}

/// The mesh of a level set looks like it, in every format that is read.
#[test]
fn meshes_become_the_pictures_of_their_level_set() {
    const VIEW: &str = "--camera=eye=2:1.4:2.5,target=0.35:0.35:0.35,ground=0";
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("block.ply"), &block(8, 0.0));
    let convert = ["convert", "block.ply", "--out", "o", "--format", "vdb,glb,gltf,obj,ply,vtp,usdc,abc,stl"];
    let result = meniscus(path, &convert);
    assert_eq!(result.status, 0, "{}", result.err);
    let render = |name: &str| -> (Vec<u8>, usize) {
        let input = format!("o/block.{name}");
        let result = meniscus(path, &["render", &input, "-o", "a.png", "--size", "160x120", VIEW]);
        assert_eq!((result.status, &*result.err), (0, ""), "{name}: {}", result.out);
        let (_, colors) = pixels(&path.join("a.png"));
        let orange = colors.chunks_exact(3).filter(|rgb| u32::from(rgb[0]) > u32::from(rgb[2]) + 40).count();
        (colors, orange)
    };
    let (reference, _) = render("vdb");
    for name in ["glb", "gltf", "obj", "ply", "vtp", "usdc", "abc", "stl"] {
        let (colors, orange) = render(name);
        let off = colors.iter().zip(&reference).map(|(one, other)| f64::from(one.abs_diff(*other)));
        let mean = off.sum::<f64>() / reference.len() as f64;
        assert!(mean < 3.0 && orange == 0, "{name}: off by {mean} levels, {orange} pixels show the inside");
    }

    // Of each frame without particles, a folder gives one surface.
    let result = meniscus(path, &["render", "o", "--out", "pictures", "--size", "64x48"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    assert!(result.out.starts_with("o/block.vdb: "), "{}", result.out);
    assert_eq!(names_in(&path.join("pictures")), ["block.png"]);
    // All frames have the same format, whatever the order of the files.
    fs::create_dir(path.join("both")).expect("made");
    for name in ["a.usdc", "b.glb", "b.usdc", "a.glb"] {
        let format = name.split('.').next_back().expect("an extension");
        fs::copy(path.join(format!("o/block.{format}")), path.join("both").join(name)).expect("copied");
    }
    let result = meniscus(path, &["render", "both", "--out", "of_both", "--size", "64x48"]);
    assert!(result.out.contains("both/a.glb: ") && result.out.contains("both/b.glb: "), "{}", result.out);
    fs::remove_file(path.join("o/block.vdb")).expect("removed");
    fs::copy(path.join("block.ply"), path.join("o/other.ply")).expect("copied");
    let result = meniscus(path, &["render", "o/block.glb", "-o", "turn.exr", "--size", "64x48"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    assert_eq!(layers_of(&path.join("turn.exr")).len(), 6);
    let result = meniscus(path, &["render", "o", "--out", "turn", "--size", "64x48", "--turntable", "2"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    let expected = ["block.000.png", "block.001.png", "other.000.png", "other.001.png"];
    assert_eq!(names_in(&path.join("turn")), expected);
}

#[test]
fn warning_about_an_empty_picture_says_what_is_empty() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("none.ply"), &[]);
    let convert = ["convert", "none.ply", "--out", "o", "--format", "vdb", "--spacing", "0.1"];
    assert_eq!(meniscus(path, &convert).status, 0);
    let rendered = |arguments: &[&str]| {
        let result = meniscus(path, &[&["render", "-o", "e.png", "--size", "64x48"], arguments].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        result.err
    };
    let err = rendered(&["o/none.vdb"]);
    assert!(err.contains("o/none.vdb: the level set is empty, and so is e"), "{err}");
    fs::write(path.join("none.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n").expect("written");
    let err = rendered(&["none.obj"]);
    assert!(err.contains("none.obj: the mesh is empty, and so is e"), "{err}");
    let away = "--camera=eye=9:9:9,target=20:20:20,ground=none";
    let err = rendered(&["none.ply", "--spacing=0.1", away]);
    assert!(err.contains("none.ply: the surface is empty, and so is e"), "{err}");
    write_ply(&path.join("block.ply"), &block(6, 0.0));
    let err = rendered(&["block.ply", "--spacing=0.1", away]);
    assert!(err.contains("block.ply: nothing is in view in e"), "{err}");
}

#[test]
fn invalid_picture_arguments_are_refused() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 2);
    fs::write(path.join("broken.vdb"), "no grid").expect("written");
    fs::write(path.join("broken.stl"), "no triangle").expect("written");
    fs::write(path.join("scene.gltf"), r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[]}]}"#)
        .expect("written");
    for (arguments, words) in [
        (&["dam.1.ply"][..], &["--out"][..]),
        (&["missing.ply", "-o", "a.png"], &["missing.ply", "no such file"]),
        (
            &["dam.1.ply", "-o", "a.jpg"],
            &["a.jpg", ".png or .exr", "for a folder of this name, write a.jpg/"],
        ),
        (&["dam.1.ply", "-o", "a.PNG"], &["must be lower case: use a.png"]),
        (&["dam.1.ply", "-o", "a.mp4"], &["a.mp4", ".png or .exr"]),
        (
            &["dam.1.ply", "-o", "a.png", "--format", "exr"],
            &["a.png", "--format names a format other than .png"],
        ),
        (&["dam.1.ply", "-o", "-"], &["only `meniscus convert` writes to the standard output"]),
        (&["dam.1.ply", "dam.2.ply", "-o", "a.png"], &["2 frames", "--out"]),
        (&["dam.1.ply", "-o", "a.png", "--size", "1280"], &["--size", "1280x720"]),
        (&["dam.1.ply", "-o", "a.png", "--camera", "zoom=far"], &["zoom=`far`", "expected a number"]),
        (
            &["dam.1.ply", "-o", "a.png", "--camera", "azimut=3"],
            &["unknown key `azimut`", "expected one of azimuth"],
        ),
        (&["dam.1.ply", "-o", "a.png", "--camera-from", "scene.gltf"], &["scene.gltf", "no camera"]),
        (&["dam.1.ply", "-o", "a.png", "--camera-from", "dam.2.ply"], &["dam.2.ply", "expected a .glb"]),
        (&["dam.1.ply", "-o", "a.png", "--frames", "7"], &["--frames selects none"]),
        (&["broken.vdb", "-o", "a.png"], &["broken.vdb", "OpenVDB"]),
        (&["broken.vdb", "-o", "a.png", "--particles"], &["--particles"]),
        (&["broken.stl", "-o", "a.png"], &["broken.stl", "not a supported mesh format"]),
        (&["broken.stl", "-o", "a.png", "--particles"], &["this is a mesh"]),
        (&["broken.stl", "-o", "a.png", "--blend=3"], &["a level set or a mesh: this option is for"]),
    ] {
        let result = meniscus(path, &[&["render"], arguments].concat());
        assert_eq!(result.status, 2, "{arguments:?}: {} {}", result.out, result.err);
        for word in words {
            assert!(result.err.contains(word), "{arguments:?} does not say {word}: {}", result.err);
        }
    }
    assert!(names_in(path).iter().all(|name| !name.ends_with(".png")));
}

#[test]
fn previews_of_a_sequence_have_one_camera() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 3);
    let convert =
        ["convert", "dam.#.ply", "--out", "o", "--format", "vdb", "--preview", "png", "--preview-size"];
    let convert = [&convert[..], &["64x48", "--skip-done"]].concat();
    let result = meniscus(path, &convert);
    assert_eq!(result.status, 0, "{}", result.err);
    let picture = |name: &str| path.join("o").join(name);
    let camera = camera_in(&picture("dam.1.png"));
    assert!(camera.starts_with("eye=") && camera == camera_in(&picture("dam.3.png")), "{camera}");
    let first = fs::read(picture("dam.2.png")).expect("there");
    // A part of the sequence is rendered with the camera of the whole sequence.
    fs::remove_file(picture("dam.2.png")).expect("removed");
    let result = meniscus(path, &[&convert[..], &["--frames", "2"]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(fs::read(picture("dam.2.png")).expect("there") == first);
    assert_eq!(meniscus(path, &convert).out.matches("done already").count(), 3);
    let other = [&convert[..], &["--camera", "azimuth=90"]].concat();
    assert_eq!(meniscus(path, &other).out.matches("done already").count(), 0);
}

/// Converts the files of `in` once, without waiting.
const WATCH: [&str; 8] = ["watch", "in", "--out", "o", "--once", "--settle=0", "--format", "vdb"];

#[test]
fn splash_that_leaves_the_picture_of_watch_is_not_cropped() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir(path.join("in")).expect("made");
    // A splash: its second frame is far outside the picture of the first.
    let frame = |number: usize, shift: f64| {
        let moved = block(6, shift).into_iter().map(|[x, y, z]| [x, y + 2.0 * shift, z]);
        let moved: Vec<[f64; 3]> = moved.collect();
        write_ply(&path.join(format!("in/dam.{number}.ply")), &moved);
    };
    let watch =
        [&WATCH[..], &["--preview", "png", "--preview-size", "64x48", "--voxel-size", "0.05"]].concat();
    let run = || {
        let result = meniscus(path, &watch);
        assert_eq!(result.status, 0, "{}", result.err);
        result.err
    };
    let picture = |number: usize| path.join(format!("o/dam.{number}.png"));
    let is_converted = |log: &str| log.matches("INFO converted ").count();
    frame(1, 0.0);
    run();
    let first = camera_in(&picture(1));
    frame(2, 3.0);
    let log = run();
    assert!(log.contains("the camera is refitted"), "{log}");
    let second = camera_in(&picture(2));
    assert_ne!(first, second);
    // A frame inside the picture of the second camera keeps that camera, also after a restart. The refit
    // converts no frame again, not even one that the daemon examines again.
    frame(3, 1.5);
    let untouched = [1, 2].map(|number| fs::read(picture(number)).expect("there"));
    fs::copy(path.join("in/dam.1.ply"), path.join("in/copy")).expect("copied");
    fs::rename(path.join("in/copy"), path.join("in/dam.1.ply")).expect("renamed");
    let log = run();
    assert_eq!(camera_in(&picture(3)), second);
    assert_eq!((is_converted(&log), log.matches("was done already").count()), (1, 1), "{log}");
    assert!(untouched == [1, 2].map(|number| fs::read(picture(number)).expect("there")));
}

#[test]
fn daemon_keeps_its_camera() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir(path.join("in")).expect("made");
    write_sequence(&path.join("in"), 1, 2);
    let watch =
        [&WATCH[..], &["--preview", "exr", "--preview-size", "64x48", "--voxel-size", "0.05"]].concat();
    let result = meniscus(path, &watch);
    assert_eq!(result.status, 0, "{}", result.err);
    let picture = |name: &str| path.join("o").join(name);
    let camera = camera_in(&picture("dam.1.exr"));
    assert!(camera.starts_with("eye=") && camera == camera_in(&picture("dam.2.exr")), "{camera}");
    // After a restart the camera stays, although another frame now comes first.
    write_sequence(&path.join("in"), 0, 0);
    write_sequence(&path.join("in"), 3, 3);
    let result = meniscus(path, &watch);
    assert_eq!(result.status, 0, "{}", result.err);
    for name in ["dam.0.exr", "dam.3.exr"] {
        assert_eq!(camera_in(&picture(name)), camera, "{name}");
    }
}

/// Limit of the mean difference of a picture from its reference, in levels of 255. Only the trigonometric
/// functions differ between machines, which can move the edge of a shape by a pixel.
const MEAN_OFF_MAX: f64 = 0.1;
/// Of all channels of all pixels, at most this number per thousand may differ by more than [`OFF_MAX`].
const FAR_OFF_THOUSANDTHS_MAX: f64 = 1.0;
const OFF_MAX: u8 = 6;

/// Width, height, and red, green and blue of every pixel.
type Pixels = ([u32; 2], Vec<u8>);

fn pixels(path: &Path) -> Pixels {
    let file = BufReader::new(File::open(path).unwrap_or_else(|error| panic!("{}: {error}", path.display())));
    let mut reader = png::Decoder::new(file).read_info().expect("a picture");
    let mut bytes = vec![0; reader.output_buffer_size().expect("a size")];
    let info = reader.next_frame(&mut bytes).expect("pixels");
    let channels = info.color_type.samples();
    let bytes =
        bytes[..info.buffer_size()].chunks_exact(channels).flat_map(|pixel| pixel[..3].to_vec()).collect();
    ([info.width, info.height], bytes)
}

/// The fault of a picture that differs too much from the reference.
fn unlike(picture: &Pixels, reference: &Pixels) -> Option<String> {
    if picture.0 != reference.0 {
        return Some(format!("it has {:?} pixels, and the reference {:?}", picture.0, reference.0));
    }
    let off: Vec<u8> = picture.1.iter().zip(&reference.1).map(|(one, other)| one.abs_diff(*other)).collect();
    let count = off.len() as f64;
    let mean = off.iter().map(|&off| f64::from(off)).sum::<f64>() / count;
    let far_off = 1000.0 * off.iter().filter(|&&off| off > OFF_MAX).count() as f64 / count;
    (mean > MEAN_OFF_MAX || far_off > FAR_OFF_THOUSANDTHS_MAX)
        .then(|| format!("off by {mean:.2} levels in the mean, {far_off:.1} ‰ by more than {OFF_MAX}"))
}

/// A picture of this size takes some gigabytes.
#[test]
fn large_picture_is_refused_within_the_memory_limit() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write_sequence(folder, 1, 1);
    let common = ["--voxel-size", "0.05", "--format", "vdb", "--out", "out"];
    assert_eq!(meniscus(folder, &[&["convert", "dam.1.ply"][..], &common].concat()).status, 0);
    let preview = ["--preview", "exr", "--preview-size", "8192x4096", "--memory", "1GiB"];
    let size = ["-o", "a.exr", "--size", "8192x4096", "--memory", "1GiB"];
    for (arguments, words) in [
        (
            &[&["convert", "dam.1.ply"][..], &common, &preview].concat(),
            "of which the picture needs 4160, and",
        ),
        (&[&["render", "dam.1.ply"][..], &size].concat(), "of which the picture needs 4160, and"),
        (&[&["render", "out/dam.1.vdb"][..], &size].concat(), "the level set with its picture needs 416"),
    ] {
        let result = meniscus(folder, arguments);
        assert_eq!(result.status, 2, "{arguments:?}");
        assert!(result.err.contains(words) && result.err.contains("limit is 1024 MiB"), "{}", result.err);
    }
    // Smaller pictures fit.
    let small =
        [&["convert", "dam.1.ply"][..], &common, &["--preview", "exr", "--memory", "256MiB"]].concat();
    let result = meniscus(folder, &small);
    assert_eq!(result.status, 0, "{}", result.err);
}

/// Pictures of a ball, of a frame of water and of its particles match the references that a person has
/// reviewed. The test leaves a differing picture in the build folder, to be reviewed and copied.
#[test]
fn pictures_match_the_reviewed_references() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let made = Path::new(env!("CARGO_TARGET_TMPDIR")).join("pictures");
    fs::create_dir_all(&made).expect("made");
    let viewpoint = viewpoint(AWAY);
    let picture = picture_of(&ball(1.0), DVec3::ZERO, &viewpoint);
    let bytes = encode_picture(&picture, None, OutputFormat::Png, &[]).expect("encoded");
    fs::write(made.join("ball.png"), bytes).expect("written");
    for (name, arguments) in [
        ("water", &[][..]),
        ("water_above", &["--camera", "azimuth=-60,elevation=60"]),
        ("particles", &["--particles"]),
    ] {
        let output = made.join(format!("{name}.png"));
        let frame = root.join("examples/frames/dam.0006.bgeo");
        let [frame, output] = [&frame, &output].map(|path| path.to_str().expect("UTF-8"));
        let result =
            meniscus(root, &[&["render", frame, "-o", output, "--size", "320x180"], arguments].concat());
        assert_eq!(result.status, 0, "{}", result.err);
    }
    for name in ["ball", "water", "water_above", "particles"] {
        let name = format!("{name}.png");
        let reference = pixels(&root.join("tests/program/references").join(&name));
        let unlike = unlike(&pixels(&made.join(&name)), &reference);
        assert_eq!(unlike, None, "{}", made.join(&name).display());
    }
}

/// A wrong sign, a hole or a light from another direction differs from the reference.
#[test]
fn wrong_pictures_differ_from_the_reference() {
    let picture = |band: &NarrowBand, spec: &str| -> Pixels {
        let picture = picture_of(band, DVec3::ZERO, &viewpoint(spec));
        let bytes = encode_picture(&picture, None, OutputFormat::Png, &[]).expect("encoded");
        let file = tempdir().expect("a folder");
        fs::write(file.path().join("a.png"), bytes).expect("written");
        pixels(&file.path().join("a.png"))
    };
    let right = picture(&ball(1.0), AWAY);
    let mut holed = ball(1.0);
    // Make a hole: a few voxels in front are outside.
    let topology = holed.topology.clone();
    for (leaf, origin) in holed.phi.leaves.iter_mut().zip(topology.origins()) {
        for (offset, value) in leaf.values.iter_mut().enumerate() {
            let away = (*origin + voxel_in_leaf(offset)).as_dvec3() - DVec3::new(0.0, 12.0, 16.0);
            *value = if away.length() < 2.0 { value.abs() } else { *value };
        }
    }
    assert_eq!(unlike(&picture(&ball(1.0), AWAY), &right), None);
    for (wrong, picture) in [
        ("inside out", picture(&ball(-1.0), AWAY)),
        ("with a hole", picture(&holed, AWAY)),
        ("from the side", picture(&ball(1.0), "eye=0.3:3:4,target=0:0:0,view=40")),
    ] {
        assert!(unlike(&picture, &right).is_some(), "{wrong}");
    }
}
