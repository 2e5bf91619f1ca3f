//! Grids of points in .vdb, built byte by byte. `tests/clients` reads those that OpenVDB writes.

use meniscus_formats::{
    Error, FilePositions, Format, Limits, ParticleFrame, ProbedKind, looks_like_particles, probe,
    read_obstacle, read_particles, vdb,
};

use crate::fixtures::{CODECS, INDEX_POSITIONS, Pages, TRANSLATION, VOXEL, vdb_points};

const PAGES: [Pages; 3] = [Pages::None, Pages::Raw, Pages::Blosc];

fn read(bytes: &[u8]) -> Result<ParticleFrame, Error> {
    read_particles(bytes, "points.vdb", &Limits::default())
}

#[test]
fn points_are_read_with_all_codecs_and_pages() {
    for (codec, tolerance) in CODECS.into_iter().zip([1e-12, 1e-12, 1.0 / 65535.0, 1.0 / 255.0]) {
        for pages in PAGES {
            let bytes = vdb_points(codec, pages);
            assert_eq!(probe(&bytes, "a").kind, ProbedKind::Format(Format::VdbPoints));
            let frame = read(&bytes).unwrap_or_else(|error| panic!("{codec} {pages:?}: {error}"));
            let FilePositions::F64(positions) = &frame.positions else { panic!("64 bits") };
            assert_eq!(positions.len(), 4);
            for (found, index) in positions.iter().zip(INDEX_POSITIONS) {
                for axis in 0..3 {
                    let expected = TRANSLATION[axis] + VOXEL * index[axis];
                    assert!(
                        (found[axis] - expected).abs() <= VOXEL * tolerance,
                        "{codec} {pages:?}: {found:?}"
                    );
                }
            }
        }
    }
}

#[test]
fn attributes_strings_and_groups_are_read() {
    for pages in PAGES {
        let frame = read(&vdb_points("null", pages)).expect("points");
        let described = frame.attributes.iter().map(|attribute| {
            format!("{} {} {:?} {:?}", attribute.name, attribute.arity, attribute.role, attribute.values)
        });
        let expected = [
            "v 3 Some(Velocity) F32([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0])",
            "id 1 Some(Id) I32([11, 12, 13, 14])",
            "Cd 3 Some(Color) F32([0.0, 0.2, 1.0, 0.0, 0.0, 0.0, 0.003921569, 0.003921569, 0.003921569, 1.0, 1.0, 1.0])",
            "N 3 Some(Normal) F32([0.57735026, 0.57735026, 0.57735026, 0.0, 0.0, 1.0, -0.0, 0.0, 1.0, 0.0, -1.0, 0.0])",
            "heat 1 None F32([1.5, 1.5, 1.5, 2.5])",
            "phase 1 Some(Kind) Strings { table: [\"oil\", \"water\"], indices: [1, 0, -1, 0] }",
            "inflow 1 None U8([1, 0, 1, 0])",
            "splash 1 None U8([0, 1, 1, 0])",
        ];
        assert_eq!(described.collect::<Vec<_>>(), expected, "{pages:?}");
        let notes = [
            "positions are stored relative to their voxels, in 32-bit floats",
            "skipped `odd`: its type is bytes with the codec own",
            "skipped `secret`: it is hidden",
        ];
        assert_eq!(frame.notes, notes);
    }
}

#[test]
fn points_are_particles_and_no_level_sets() {
    let bytes = vdb_points("null", Pages::None);
    assert!(looks_like_particles(&bytes, "a.vdb"));
    assert!(matches!(vdb::read_level_set(&bytes, None, &Limits::default()), Err(Error::Unsupported { .. })));
    let error = read_obstacle(&bytes, "a.vdb", &Limits::default(), &|_| Ok(Vec::new())).expect_err("points");
    assert!(error.to_string().contains("not a supported obstacle format"), "{error}");
}

#[test]
fn truncated_points_are_rejected() {
    for pages in PAGES {
        let bytes = vdb_points("fxpt16", pages);
        for length in (0..bytes.len()).step_by(7).chain([bytes.len() - 1]) {
            let error = vdb::read_points(&bytes[..length], &Limits::default()).expect_err("a part");
            assert!(error.is_truncated(), "{length} of {}: {error}", bytes.len());
        }
    }
}

#[test]
fn leaves_with_different_attributes_and_other_codecs_are_refused() {
    let bytes = vdb_points("own", Pages::None);
    let error = read(&bytes).expect_err("an unknown codec").to_string();
    assert!(error.contains("the positions have the type vec3s with the codec own"), "{error}");
    let limits = Limits { particle_count: 3, ..Limits::default() };
    let bytes = vdb_points("null", Pages::None);
    assert!(matches!(vdb::read_points(&bytes, &limits), Err(Error::TooLarge { .. })));
}
