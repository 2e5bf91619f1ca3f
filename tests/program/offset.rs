//! Moving the finished surface by a constant distance: its position, its guarantees, and the particles that
//! are outside afterwards.

use std::fs;
use std::path::Path;

use glam::{DVec3, Vec3};
use meniscus::surface::obstacle::Obstacles;
use meniscus::surface::options::{AnisotropyKind, AttributeSelection, MethodOptions, Settings};
use meniscus::surface::particles::{Attribute, AttributeValues, OwnedPositions, ParticleCloud, Role};
use meniscus::surface::reconstruction::{FrameSurface, reconstruct_cloud, reconstruct_frame};
use serde_json::Value;
use tempfile::tempdir;

use crate::program::scene::{block, meniscus, write_ply};

/// The surface of particles with voxels of 1.
fn skinned(positions: &[DVec3], choices: &MethodOptions) -> FrameSurface {
    let settings = Settings::paper(1.0, choices).expect("sound");
    reconstruct_frame(
        &OwnedPositions::F64(positions.iter().map(|position| position.to_array()).collect()),
        &settings,
    )
}

fn with_offset(offset: f64) -> MethodOptions {
    MethodOptions { offset: Some(offset.into()), ..MethodOptions::default() }
}

/// Particles 2 apart.
fn lattice(counts: [usize; 3]) -> Vec<DVec3> {
    let cells = (0..counts.into_iter().product::<usize>())
        .map(|index| [index / (counts[1] * counts[2]), index / counts[2] % counts[1], index % counts[2]]);
    cells.map(|cell| DVec3::from(cell.map(|along| 2.0 * along as f64))).collect()
}

fn vertices(surface: &FrameSurface) -> impl Iterator<Item = DVec3> + '_ {
    surface.mesh.positions.iter().map(|position| surface.mesh.origin + position.as_dvec3())
}

/// The mean height of the top of a surface above the middle of a block.
fn top(surface: &FrameSurface, middle: DVec3) -> f64 {
    let above = vertices(surface)
        .filter(|vertex| (*vertex - middle).truncate().abs().max_element() < 5.0 && vertex.z > middle.z);
    let heights: Vec<f64> = above.map(|vertex| vertex.z).collect();
    assert!(heights.len() > 50);
    heights.iter().sum::<f64>() / heights.len() as f64
}

/// The sphere of a lone particle, whose radius is √(r_init² − 6h²), is larger or smaller by the offset.
#[test]
fn lone_particle_has_the_radius_of_its_sphere_and_the_offset() {
    let center = DVec3::new(0.31, -0.17, 0.43);
    for offset in [-2.5, -1.3, 0.8, 2.0] {
        let choices =
            MethodOptions { radius_min: Some(4.5.into()), radius_ratio: Some(1.5), ..with_offset(offset) };
        let surface = skinned(&[center], &choices);
        let expected = (5.625f64.powi(2) - 6.0).sqrt() + offset;
        let errors = vertices(&surface).map(|vertex| (vertex.distance(center) - expected).abs());
        let error = errors.fold(0.0, f64::max);
        assert!(error < 0.25, "{offset}: {error}");
        let certificate = &surface.report.certificate;
        assert!(certificate.holds(), "{offset}: {certificate:?}");
        assert_eq!(certificate.offset, offset);
        let [least, greatest] = certificate.distance_limits.expect("of particles");
        let expected = [4.5 + offset, 6.75 + offset.max(0.0)];
        assert!(
            (least - expected[0]).abs() < 1e-5 && (greatest - expected[1]).abs() < 1e-5,
            "{least} {greatest}"
        );
    }
}

/// The top of a pool stays flat and moves by the offset; its sides move, too.
#[test]
fn flat_top_of_a_pool_moves_by_the_offset() {
    let positions = lattice([14, 14, 8]);
    let middle = DVec3::new(13.0, 13.0, 7.0);
    let plain = top(&skinned(&positions, &MethodOptions::default()), middle);
    for offset in [-1.7, -0.9, 0.6, 1.9] {
        let surface = skinned(&positions, &with_offset(offset));
        let moved = top(&surface, middle);
        assert!((moved - offset - plain).abs() < 0.1, "{offset}: {plain} {moved}");
        assert!(surface.report.certificate.holds(), "{:?}", surface.report.certificate);
    }
}

/// An offset of 0 leaves every byte unchanged.
#[test]
fn offset_of_zero_changes_nothing() {
    let positions = lattice([6, 6, 6]);
    let (one, other) =
        (skinned(&positions, &MethodOptions::default()), skinned(&positions, &with_offset(0.0)));
    assert!(one.mesh == other.mesh && one.band.phi == other.band.phi);
    assert_eq!(one.report.certificate, other.report.certificate);
}

/// Outside a convex body, the slope of φ is 1 in the whole band, because no two parts of the surface are near
/// each other.
#[test]
fn level_set_holds_distances_after_the_offset() {
    let plain = skinned(&lattice([12, 12, 8]), &MethodOptions::default()).band;
    for offset in [-1.6, 1.8] {
        let band = skinned(&lattice([12, 12, 8]), &with_offset(offset)).band;
        assert_eq!(band.half_width, plain.half_width);
        let phi = |voxel| {
            let (leaf, local) = band.topology.find_voxel(voxel)?;
            Some(f64::from(band.phi.leaves[leaf].values[meniscus::surface::grid::offset_in_leaf(local)]))
        };
        let (mut count, mut straight_count) = (0, 0);
        for (leaf, &origin) in band.phi.leaves.iter().zip(band.topology.origins()) {
            for (index, value) in leaf.values.iter().enumerate() {
                assert!(value.abs() <= band.half_width && value.abs() >= 1.0 / 128.0, "{value}");
                let voxel = origin + meniscus::surface::grid::voxel_in_leaf(index);
                let along = |axis: usize| {
                    let step = glam::IVec3::AXES[axis];
                    Some(0.5 * (phi(voxel + step)? - phi(voxel - step)?))
                };
                let (true, Some(x), Some(y), Some(z)) =
                    ((0.0..3.0).contains(value), along(0), along(1), along(2))
                else {
                    continue;
                };
                count += 1;
                straight_count += usize::from((DVec3::new(x, y, z).length() - 1.0).abs() < 0.1);
            }
        }
        assert!(count > 5000 && straight_count * 100 > count * 95, "{offset}: {straight_count} of {count}");
    }
}

/// An inward offset removes thin parts such as a sheet, or a drop next to a body. The certificate counts the
/// particles outside, but this is not a violation, because the user asked for the offset.
#[test]
fn particles_that_an_inward_offset_leaves_outside_are_counted() {
    let mut positions = lattice([8, 8, 8]);
    positions.push(DVec3::new(7.0, 7.0, 30.0));
    let surface = skinned(&positions, &with_offset(-1.732));
    let certificate = &surface.report.certificate;
    assert!(certificate.holds() && certificate.may_leave_particles_outside, "{certificate:?}");
    let outside = certificate.particles_outside;
    assert!(outside.count >= 1 && outside.count < positions.len() / 4, "{outside:?}");
    // The drop is farther from the body than the band is wide.
    assert!((outside.deepest - f64::from(surface.band.half_width)).abs() < 1e-6, "{outside:?}");
    assert_eq!(surface.report.mesh.component_count, 1);
    let body = skinned(&positions[..512], &with_offset(-1.732)).report.certificate.particles_outside;
    assert_eq!(body.count + 1, outside.count);
    assert!(body.deepest < 1.0, "{body:?}");
}

/// At every position between the voxels, a lone particle stays inside as long as the certificate requires
/// this.
#[test]
fn particles_stay_inside_where_the_offset_leaves_room_for_them() {
    for (radius_min, offset, is_sure) in [(1.733, -0.3, false), (1.733, -1.6, false), (3.0, -1.2, true)] {
        let cells = (0..216).map(|cell| [cell / 36, cell / 6 % 6, cell % 6]);
        let positions: Vec<DVec3> =
            cells.map(|cell| DVec3::from(cell.map(|along| f64::from(along) * (20.0 + 1.0 / 6.0)))).collect();
        let choices = MethodOptions { radius_min: Some(radius_min.into()), ..with_offset(offset) };
        let certificate = skinned(&positions, &choices).report.certificate;
        assert_eq!(certificate.may_leave_particles_outside, !is_sure, "{offset}");
        assert!(certificate.holds(), "{offset}: {certificate:?}");
        assert_eq!(certificate.particles_outside.count > 0, offset == -1.6, "{offset}: {certificate:?}");
    }
}

/// Vertices keep their attributes wherever the surface is moved.
#[test]
fn normals_and_attributes_follow_the_moved_surface() {
    let positions = lattice([8, 8, 6]);
    let velocities = positions.iter().flat_map(|position| [1.0, position.x as f32, -2.0]).collect();
    let velocity = Attribute {
        name: "v".into(),
        role: Role::Velocity,
        arity: 3,
        values: AttributeValues::Numbers(velocities),
    };
    for offset in [-1.6, 2.0] {
        let choices = MethodOptions {
            attributes: Some(AttributeSelection::All),
            anisotropy: Some(AnisotropyKind::Neighbors),
            ..with_offset(offset)
        };
        let settings = Settings::paper(1.0, &choices).expect("sound");
        let particles = OwnedPositions::F64(positions.iter().map(|position| position.to_array()).collect());
        let cloud = ParticleCloud { attributes: vec![velocity.clone()], ..ParticleCloud::from(particles) };
        let surface = reconstruct_cloud(cloud, &settings, &Obstacles::default());
        let certificate = &surface.report.certificate;
        assert!(certificate.holds(), "{offset}: {certificate:?}");
        assert!(surface.mesh.normals.iter().all(|normal: &Vec3| (normal.length() - 1.0).abs() < 1e-3));
        let transfer = surface.report.transfer.as_ref().expect("transferred");
        assert_eq!(
            (transfer.vertices.point_count, transfer.vertices.empty_count),
            (surface.mesh.positions.len(), 0)
        );
        let AttributeValues::Numbers(values) = &surface.attributes.vertices[0].values else {
            panic!("reals")
        };
        for (value, vertex) in values.chunks_exact(3).zip(vertices(&surface)) {
            assert!((value[0], value[2]) == (1.0, -2.0), "{value:?}");
            assert!((f64::from(value[1]) - vertex.x.clamp(0.0, 14.0)).abs() < 2.5, "{value:?} at {vertex}");
        }
    }
}

#[test]
fn number_of_threads_does_not_matter() {
    let positions = lattice([9, 7, 5]);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| skinned(&positions, &with_offset(-0.9)))
    };
    let (one, three) = (on(1), on(3));
    assert!(one.mesh == three.mesh && one.band.phi == three.band.phi);
}

#[test]
fn command_moves_the_surface_and_reports_it() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write_ply(&folder.join("block.ply"), &block(8, 0.0125));
    let convert =
        |input: &str, more: &[&str]| meniscus(folder, &[&["convert", input, "--out=out"], more].concat());
    let result =
        convert("block.ply", &["--preset=paper", "--voxel-size=0.05", "--offset=0.11", "--format=obj"]);
    assert_eq!(result.status, 2, "{}", result.err);
    assert!(result.err.contains("the offset is 0.11; it must be from -r_min = -0.0866"), "{}", result.err);
    let volume = |file: &str| {
        let result = meniscus(folder, &["info", "--json", file]);
        let json: Value = serde_json::from_str(&result.out).expect("JSON");
        json[0]["mesh"]["volume"].as_f64().expect("a volume")
    };
    let edge = |file: &str| volume(file).cbrt();
    let voxels = ["--preset=paper", "--voxel-size=0.05", "--format=obj,vdb"];
    assert_eq!(convert("block.ply", &voxels).status, 0);
    fs::rename(folder.join("out"), folder.join("plain")).expect("moved");
    let result = convert("block.ply", &[&voxels[..], &["--offset=-0.06", "--report=r.json"]].concat());
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    let report = fs::read_to_string(folder.join("r.json")).expect("written");
    let report: Value = serde_json::from_str(&report).expect("JSON");
    let certificate = &report["frames"][0]["certificate"];
    assert_eq!((&certificate["offset"], &certificate["holds"]), (&Value::from(-0.06), &Value::from(true)));
    assert_eq!(report["settings"][0]["more"]["offset"], "-0.06");
    let limit = certificate["distance_limits"][0].as_f64().expect("a length");
    assert!((limit - (3f64.sqrt() * 0.05 - 0.06)).abs() < 1e-6, "{certificate}");
    assert!(certificate["particles_outside"]["deepest"].is_number(), "{certificate}");
    // The edges of the surface are rounded, which removes less from a smaller block.
    let shrunk = edge("plain/block.obj") - edge("out/block.obj");
    assert!((shrunk - 0.12).abs() < 0.02, "{shrunk}");
    // The level set without an offset, moved by the same distance, gives about the same surface. Its records
    // differ, so `--skip-done` converts it.
    let result = convert("plain/block.vdb", &["--format=obj", "--offset=-0.06", "--skip-done"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    let again = edge("plain/block.obj") - edge("out/block.obj");
    assert!((again - shrunk).abs() < 0.004, "{again} {shrunk}");
    let result = convert("plain/block.vdb", &["--format=obj", "--offset=-0.05", "--skip-done"]);
    assert!(!result.out.contains("done already"), "{}", result.out);
    let result = convert("plain/block.vdb", &["--format=obj", "--offset=-0.2"]);
    let expected = "block.vdb: the offset is -0.2; it must be from -√3 h = -0.0866025 to 2 h = 0.1";
    assert!(result.status != 0 && result.err.contains(expected), "{} {}", result.status, result.err);
}

/// With the default settings, particles are flattened. Near the centre of such a particle, a first-order
/// distance to its surface is far too large.
#[test]
fn inward_offsets_of_flattened_particles_pass_validation() {
    let folder = tempdir().expect("a folder");
    let frames = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/frames");
    let frames = frames.to_str().expect("text");
    for offset in ["-0.4d", "-0.6d"] {
        let out = format!("--out={offset}");
        let result = meniscus(folder.path(), &["convert", frames, &out, "--frames=3-8", "--offset", offset]);
        assert_eq!(result.status, 0, "{offset}: {}", result.err);
    }
}
