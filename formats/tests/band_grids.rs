//! Additional grids in a .vdb, read by our own reader and by another reader.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use std::collections::HashMap;

use crate::solids;

use std::io::Cursor;

use meniscus_formats::OutputFormat;
use meniscus_formats::is_complete;
use meniscus_formats::vdb::{
    Compression, WriteOptions, grid_notes, grids, read_level_set, read_vectors, write,
};
use meniscus_formats::{AttributeRole, BandGrid, LeafValues, LevelSetView, Limits};
use solids::Solid;

const COMPRESSIONS: [Compression; 3] = [Compression::None, Compression::ActiveMask, Compression::Blosc];

fn to_bytes(view: &LevelSetView, compression: Compression, half: bool) -> Vec<u8> {
    let options = WriteOptions { compression, half, ..WriteOptions::default() };
    let mut bytes = Vec::new();
    write(view, &options, &[("a".into(), "b".into())], &mut bytes).expect("writing to memory");
    bytes
}

/// The value of a component at a voxel. 16 bits represent it exactly.
fn value_at(voxel: [i32; 3], component: usize) -> f32 {
    let [x, y, z] = voxel.map(|c| (c & 63) as f32);
    [x + y / 8.0, y - 2.0 * z, -1.5][component]
}

fn voxels(solid: &Solid) -> Vec<[i32; 3]> {
    let mut voxels = Vec::new();
    for (origin, leaf) in solid.origins.iter().zip(&solid.leaves) {
        for (index, phi) in leaf.iter().enumerate() {
            if phi.abs() < solid.half_width_voxels {
                let i = index as i32;
                voxels.push([origin[0] + (i >> 6), origin[1] + (i >> 3 & 7), origin[2] + (i & 7)]);
            }
        }
    }
    voxels
}

/// The values of all voxels of all leaves; NaN outside the band.
#[derive(Clone, Debug)]
struct Values {
    arity: usize,
    leaves: Vec<Vec<f32>>,
}

impl LeafValues for Values {
    fn fill(&self, leaf: usize, out: &mut [f32]) {
        out.copy_from_slice(&self.leaves[leaf]);
    }
}

fn values(solid: &Solid, arity: usize) -> Values {
    let value = |origin: &[i32; 3], phi: &[f32; 512], index: usize| {
        let i = (index / arity) as i32;
        let voxel = [origin[0] + (i >> 6), origin[1] + (i >> 3 & 7), origin[2] + (i & 7)];
        let in_band = phi[index / arity].abs() < solid.half_width_voxels;
        if in_band { value_at(voxel, index % arity) } else { f32::NAN }
    };
    let leaves = solid.origins.iter().zip(&solid.leaves);
    let leaves =
        leaves.map(|(origin, phi)| (0..512 * arity).map(|index| value(origin, phi, index)).collect());
    Values { arity, leaves: leaves.collect() }
}

/// The leaf and index of a voxel in the band.
fn leaf_and_voxel(solid: &Solid, number: usize) -> (usize, usize) {
    let in_band = |leaf: usize| {
        (0..512)
            .filter(move |&i| solid.leaves[leaf][i].abs() < solid.half_width_voxels)
            .map(move |i| (leaf, i))
    };
    (0..solid.leaves.len()).flat_map(in_band).nth(number).expect("enough voxels")
}

#[test]
fn openvdb_rs_reads_values_at_the_active_voxels() {
    for (name, solid) in solids::all() {
        let (vectors, scalars) = (values(&solid, 3), values(&solid, 1));
        let velocity =
            BandGrid { name: "v", role: Some(AttributeRole::Velocity), arity: 3, values: &vectors };
        let age = BandGrid { name: "age", role: None, arity: 1, values: &scalars };
        for compression in COMPRESSIONS {
            for half in [false, true] {
                let case = format!("{name} {compression:?} half {half}");
                let alone = to_bytes(&solid.view(), compression, half);
                let bytes =
                    to_bytes(&LevelSetView { grids: &[velocity, age], ..solid.view() }, compression, half);
                let limits = Limits::default();
                assert_eq!(
                    read_level_set(&bytes, None, &limits).expect(&case),
                    read_level_set(&alone, None, &limits).expect(&case)
                );
                let own = read_vectors(&bytes, &["velocity"], &limits).expect(&case).expect("velocities");
                let (_, found) = vdb::io::read_stream(&bytes[..]).expect(&case);
                let [vdb::AnyGrid::Float(surface), vdb::AnyGrid::Vec3S(velocity), vdb::AnyGrid::Float(age)] =
                    &found[..]
                else {
                    panic!("{case}: {} grids", found.len())
                };
                assert_eq!((surface.name(), velocity.name(), age.name()), ("surface", "velocity", "age"));
                assert_eq!(velocity.active_voxel_count(), surface.active_voxel_count(), "{case}");
                assert_eq!(age.active_voxel_count(), surface.active_voxel_count(), "{case}");
                assert_eq!(velocity.tree().leaf_count(), surface.tree().leaf_count(), "{case}");
                let leaf_of: HashMap<_, _> = own.origins.iter().zip(&own.leaves).collect();
                let mut active = 0;
                for voxel in voxels(&solid) {
                    let at = vdb::Coord::new(voxel[0], voxel[1], voxel[2]);
                    if surface.get_value(&at).abs() < *surface.background() {
                        active += 1;
                        assert_eq!(
                            velocity.get_value(&at).0,
                            [0, 1, 2].map(|k| value_at(voxel, k)),
                            "{case}"
                        );
                        assert_eq!(age.get_value(&at), value_at(voxel, 0), "{case}");
                        let [x, y, z] = voxel.map(|c| (c & 7) as usize);
                        let value = leaf_of[&voxel.map(|c| c & !7)][64 * x + 8 * y + z];
                        assert_eq!(value, velocity.get_value(&at).0, "{case}");
                    }
                }
                assert_eq!(active, surface.active_voxel_count(), "{case}");
                assert_eq!(velocity.get_value(&vdb::Coord::new(1 << 20, 0, 0)).0, [0.0; 3]);
                assert_eq!((own.background, own.tiles.len()), ([0.0; 3], 0));
            }
        }
    }
}

#[test]
fn grids_get_unique_names_and_are_found_by_name() {
    let solid = solids::sphere([0.5; 3], 30.0);
    let (vectors, scalars) = (values(&solid, 3), values(&solid, 1));
    fn grid<'a>(
        name: &'a str,
        role: Option<AttributeRole>,
        arity: usize,
        values: &'a Values,
    ) -> BandGrid<'a> {
        BandGrid { name, role, arity, values }
    }
    let list = [
        grid("surface", None, 1, &scalars),
        grid("vel", Some(AttributeRole::Velocity), 3, &vectors),
        grid("Velocity", None, 3, &vectors),
        grid("", None, 1, &scalars),
        grid("Cd", Some(AttributeRole::Color), 3, &vectors),
        grid("odd\n\u{1e}name", None, 1, &scalars),
    ];
    let bytes = to_bytes(&LevelSetView { grids: &list, ..solid.view() }, Compression::Blosc, false);
    let limits = Limits::default();
    let found = grids(&bytes, &limits).expect("our own file");
    let names: Vec<&str> = found.iter().map(|grid| grid.name.as_str()).collect();
    let expected = ["surface", "surface_2", "velocity", "Velocity_2", "attribute", "Cd", "odd__name"];
    assert_eq!(names, expected);
    let types: Vec<&str> = found.iter().map(|grid| grid.type_name.as_str()).collect();
    assert_eq!(types[..4], ["Tree_float_5_4_3", "Tree_float_5_4_3", "Tree_vec3s_5_4_3", "Tree_vec3s_5_4_3"]);
    for grid in &found {
        assert_eq!(grid.active_voxel_count, found[0].active_voxel_count);
        assert_eq!(grid.active_bounds, found[0].active_bounds);
        assert_eq!(grid.transform, found[0].transform);
    }
    let entry = |grid: usize, key: &str| {
        let found = found[grid].metadata.iter().find(|(name, _)| name == key);
        found.map(|(_, value)| format!("{value:?}"))
    };
    assert_eq!(entry(2, "vector_type").as_deref(), Some("String(\"contravariant relative\")"));
    assert_eq!(entry(5, "vector_type").as_deref(), Some("String(\"invariant\")"));
    assert_eq!(entry(1, "vector_type"), None);
    assert_eq!(entry(2, "class").as_deref(), Some("String(\"unknown\")"));
    let data = read_level_set(&bytes, Some("surface"), &limits).expect("the level set");
    assert_eq!(data.class, "level set");
    let data = read_level_set(&bytes, Some("Cd"), &limits).expect_err("vectors are not read").to_string();
    assert!(data.contains("vec3s"), "{data}");
    let data = read_vectors(&bytes, &["Cd", "v"], &limits).expect("readable").expect("there");
    let stored = read_level_set(&bytes, Some("surface"), &limits).expect("the level set").leaves.len();
    assert_eq!((&*data.name, data.leaves.len()), ("Cd", stored));
    assert!(
        read_vectors(&bytes, &["surface"], &limits).expect("readable").is_none(),
        "not a grid of vectors"
    );
    assert_eq!(
        grid_notes(&list, "surface"),
        [
            "surface is named surface_2 in the .vdb",
            "Velocity is named Velocity_2 in the .vdb",
            " is named attribute in the .vdb",
            "odd\n\u{1e}name is named odd__name in the .vdb",
        ]
    );
}

#[test]
fn bytes_do_not_depend_on_threads_and_truncation_is_detected() {
    let solid = solids::shell(60.0, 30.0);
    let (vectors, scalars) = (values(&solid, 3), values(&solid, 1));
    let list = [
        BandGrid { name: "v", role: Some(AttributeRole::Velocity), arity: 3, values: &vectors },
        BandGrid { name: "age", role: None, arity: 1, values: &scalars },
    ];
    let view = LevelSetView { grids: &list, ..solid.view() };
    let bytes = to_bytes(&view, Compression::Blosc, false);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(7).build().expect("threads");
    assert!(pool.install(|| to_bytes(&view, Compression::Blosc, false)) == bytes);
    let is_whole = |bytes: &[u8]| is_complete(OutputFormat::Vdb, &mut Cursor::new(bytes));
    assert!(is_whole(&bytes).expect("our own file"));
    let ends = [bytes.len() / 4, bytes.len() / 2, bytes.len() - 1, bytes.len() - 100_000];
    for length in ends.into_iter().chain(0..300) {
        assert!(!is_whole(&bytes[..length]).unwrap_or(false), "{length}");
    }
    assert!(!is_whole(&[&bytes[..], b"more"].concat()).expect("a head"));
}

#[test]
fn grid_with_values_beyond_half_range_keeps_32_bits() {
    let solid = solids::sphere([0.5; 3], 20.0);
    let mut scalars = values(&solid, 1);
    let (leaf, voxel) = leaf_and_voxel(&solid, 5);
    scalars.leaves[leaf][voxel] = -70_000.25;
    let small = values(&solid, 1);
    let list = [
        BandGrid { name: "pressure", role: None, arity: 1, values: &scalars },
        BandGrid { name: "age", role: None, arity: 1, values: &small },
    ];
    let bytes = to_bytes(&LevelSetView { grids: &list, ..solid.view() }, Compression::Blosc, true);
    let found = grids(&bytes, &Limits::default()).expect("our own file");
    assert_eq!(found.iter().map(|grid| grid.half).collect::<Vec<_>>(), [true, false, true]);
    let (_, read) = vdb::io::read_stream(&bytes[..]).expect("a file");
    let vdb::AnyGrid::Float(pressure) = &read[1] else { panic!("no floats") };
    let [x, y, z] = voxels(&solid)[5];
    assert_eq!(pressure.get_value(&vdb::Coord::new(x, y, z)), -70_000.25);
}

#[test]
fn invalid_grids_are_an_error() {
    let solid = solids::sphere([0.5; 3], 20.0);
    let good = values(&solid, 3);
    let (leaf, voxel) = leaf_and_voxel(&solid, 100);
    let broken = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY].map(|broken| {
        let mut values = good.clone();
        values.leaves[leaf][3 * voxel + 1] = broken;
        values
    });
    let odd = [0, 2, 4].map(|arity| Values { arity, leaves: vec![Vec::new(); solid.leaves.len()] });
    for values in broken.iter().chain(&odd) {
        let list = [BandGrid { name: "odd", role: None, arity: values.arity, values }];
        let view = LevelSetView { grids: &list, ..solid.view() };
        for half in [false, true] {
            let options = WriteOptions { half, ..WriteOptions::default() };
            let error = write(&view, &options, &[], &mut Vec::new()).expect_err("an invalid grid");
            assert!(error.to_string().contains("odd"), "{error}");
        }
    }
}
