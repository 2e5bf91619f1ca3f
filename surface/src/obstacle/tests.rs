//! Compares distances from obstacles with the exact distances from balls, boxes and tori, and with brute
//! force over all triangles.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use glam::{DVec3, IVec3, Vec3};

use super::mesh_sdf::{winding, winding_gradient};
use super::tree::TriangleTree;
use super::{GridSdf, MeshFindings, MeshSdf, Obstacle, ObstacleLeaf, ObstacleSdf, Obstacles, SourceLevelSet};
use crate::grid::{LEAF_VOXELS, voxel_in_leaf};
use crate::space::Lattice;

const HALF_WIDTH: f32 = 6.0;
const UNIT: Lattice = Lattice { voxel_size: 1.0 };

/// Corners and triangles.
#[derive(Clone, Default)]
struct TestMesh {
    positions: Vec<[f64; 3]>,
    triangles: Vec<[u32; 3]>,
}

impl TestMesh {
    /// A surface over a grid of `u` × `v` quads, closed along u, and along v if it is `ring`.
    fn swept(u_count: u32, v_count: u32, ring: bool, at: impl Fn(f64, f64) -> DVec3) -> TestMesh {
        let mut mesh = TestMesh::default();
        let rows = if ring { v_count } else { v_count + 1 };
        for v in 0..rows {
            for u in 0..u_count {
                let position = at(f64::from(u) / f64::from(u_count), f64::from(v) / f64::from(v_count));
                mesh.positions.push(position.to_array());
            }
        }
        for v in 0..v_count {
            for u in 0..u_count {
                let corner = |du, dv| (v + dv) % rows * u_count + (u + du) % u_count;
                mesh.triangles.push([corner(0, 0), corner(1, 0), corner(1, 1)]);
                mesh.triangles.push([corner(0, 0), corner(1, 1), corner(0, 1)]);
            }
        }
        mesh
    }

    fn ball(center: DVec3, radius: f64, count: u32) -> TestMesh {
        TestMesh::swept(2 * count, count, false, |u, v| {
            let (angle, height) = (TAU * u, PI * v);
            // All vertices of a pole are at one position.
            let across = if v == 0.0 || v == 1.0 { 0.0 } else { height.sin() };
            center - radius * DVec3::new(across * angle.cos(), across * angle.sin(), height.cos())
        })
    }

    fn torus(center: DVec3, radius: f64, thickness: f64, count: u32) -> TestMesh {
        TestMesh::swept(2 * count, count, true, |u, v| {
            let (around, across) = (TAU * u, TAU * v);
            let reach = radius + thickness * across.cos();
            center + DVec3::new(reach * around.cos(), reach * around.sin(), thickness * across.sin())
        })
    }

    fn cuboid(min: DVec3, max: DVec3) -> TestMesh {
        let corner =
            |index: usize| [0, 1, 2].map(|axis| if index >> axis & 1 == 1 { max[axis] } else { min[axis] });
        let quads: [[u32; 4]; 6] =
            [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        TestMesh { positions: (0..8).map(corner).collect(), triangles }
    }

    fn and(mut self, other: TestMesh) -> TestMesh {
        let first = self.positions.len() as u32;
        self.positions.extend(other.positions);
        self.triangles.extend(other.triangles.iter().map(|triangle| triangle.map(|corner| first + corner)));
        self
    }

    fn flipped(mut self) -> TestMesh {
        self.triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
        self
    }

    fn solid(&self) -> MeshSdf {
        MeshSdf::new(&self.positions, &self.triangles)
    }

    fn corners(&self) -> Vec<[DVec3; 3]> {
        let corner = |index: u32| DVec3::from(self.positions[index as usize]);
        let has_area = |[a, b, c]: &[DVec3; 3]| (b - a).cross(c - a).length() > 1e-9;
        self.triangles.iter().map(|triangle| triangle.map(corner)).filter(has_area).collect()
    }
}

/// φ_o at all voxels of the leaves of a box, with the voxels.
fn sample(
    from: IVec3,
    to: IVec3,
    lattice: &Lattice,
    leaf: impl Fn(IVec3, &Lattice, f32) -> ObstacleLeaf,
) -> Vec<(IVec3, f32)> {
    let mut values = Vec::new();
    for x in (from.x..to.x).step_by(8) {
        for y in (from.y..to.y).step_by(8) {
            for z in (from.z..to.z).step_by(8) {
                let origin = IVec3::new(x, y, z);
                let leaf = leaf(origin, lattice, HALF_WIDTH);
                values.extend((0..LEAF_VOXELS).map(|offset| {
                    let value = match &leaf {
                        ObstacleLeaf::Outside => HALF_WIDTH,
                        ObstacleLeaf::Inside => -HALF_WIDTH,
                        ObstacleLeaf::Near(leaf) => leaf.values[offset],
                    };
                    (origin + voxel_in_leaf(offset), value)
                }));
            }
        }
    }
    values
}

/// The largest difference between φ_o around the origin and a known distance.
fn error_of(solid: &MeshSdf, lattice: &Lattice, known: impl Fn(DVec3) -> f64) -> f64 {
    let reach = IVec3::splat(24);
    let far = f64::from(HALF_WIDTH);
    let error = |(voxel, value): (IVec3, f32)| {
        let known = known(voxel.as_dvec3() * lattice.voxel_size) / lattice.voxel_size;
        (known.clamp(-far, far) - f64::from(value)).abs()
    };
    let values = sample(-reach, reach, lattice, |origin, lattice, far| solid.leaf(origin, lattice, far));
    values.into_iter().map(error).fold(0.0, f64::max)
}

fn to_cuboid(min: DVec3, max: DVec3, point: DVec3) -> f64 {
    let apart = (min - point).max(point - max);
    apart.max(DVec3::ZERO).length() + apart.max_element().min(0.0)
}

fn to_torus(radius: f64, thickness: f64, point: DVec3) -> f64 {
    (point.truncate().length() - radius).hypot(point.z) - thickness
}

#[test]
fn distances_match_the_exact_shapes() {
    let (min, max) = (DVec3::new(-9.3, -7.1, -12.0), DVec3::new(8.2, 10.4, 3.7));
    assert!(error_of(&TestMesh::cuboid(min, max).solid(), &UNIT, |point| to_cuboid(min, max, point)) < 2e-5);
    let ball = TestMesh::ball(DVec3::ZERO, 13.0, 48).solid();
    // The distance between a chord and its arc is less than r(1 − cos(π/96)).
    assert!(error_of(&ball, &UNIT, |point| point.length() - 13.0) < 0.02);
    let torus = TestMesh::torus(DVec3::ZERO, 12.0, 5.0, 48).solid();
    assert!(error_of(&torus, &UNIT, |point| to_torus(12.0, 5.0, point)) < 0.03);
    let fine = Lattice { voxel_size: 0.37 };
    let small = TestMesh::torus(DVec3::ZERO, 0.37 * 12.0, 0.37 * 5.0, 48).solid();
    assert!(error_of(&small, &fine, |point| to_torus(0.37 * 12.0, 0.37 * 5.0, point)) < 0.03);
    for solid in [ball, torus] {
        let open =
            MeshFindings { triangle_count: solid.findings().triangle_count, ..MeshFindings::default() };
        let findings = MeshFindings { degenerate_count: 0, ..*solid.findings() };
        assert_eq!(findings, open);
    }
}

#[test]
fn distances_match_brute_force_over_all_triangles() {
    let mesh = TestMesh::torus(DVec3::new(1.3, -0.4, 2.2), 6.0, 2.5, 6);
    let (solid, corners) = (mesh.solid(), mesh.corners());
    let brute = |point: DVec3| {
        let to = |triangle: &[DVec3; 3]| to_triangle(triangle, point);
        let distance = corners.iter().map(to).fold(f64::INFINITY, f64::min);
        let angles: f64 = corners.iter().map(|triangle| solid_angle(triangle, point)).sum();
        if angles > TAU { -distance } else { distance }
    };
    assert!(error_of(&solid, &UNIT, brute) < 1e-5);
}

/// The distance of a point from a triangle: from its plane if the projection is inside, else from its edges.
fn to_triangle(&[a, b, c]: &[DVec3; 3], point: DVec3) -> f64 {
    let normal = (b - a).cross(c - a).normalize();
    let foot = point - normal * normal.dot(point - a);
    let is_in = |from: DVec3, to: DVec3| (to - from).cross(foot - from).dot(normal) >= 0.0;
    if is_in(a, b) && is_in(b, c) && is_in(c, a) {
        return foot.distance(point);
    }
    let to_edge = |from: DVec3, to: DVec3| {
        let fraction = ((point - from).dot(to - from) / (to - from).length_squared()).clamp(0.0, 1.0);
        from.lerp(to, fraction).distance(point)
    };
    to_edge(a, b).min(to_edge(b, c)).min(to_edge(c, a))
}

/// The solid angle of a triangle, computed from the angles of the spherical triangle.
fn solid_angle(triangle: &[DVec3; 3], point: DVec3) -> f64 {
    let [a, b, c] = triangle.map(|corner| (corner - point).normalize());
    let angle = |at: DVec3, to: DVec3, other: DVec3| {
        let flat = |direction: DVec3| (direction - at * at.dot(direction)).normalize();
        flat(to).dot(flat(other)).clamp(-1.0, 1.0).acos()
    };
    let excess = angle(a, b, c) + angle(b, c, a) + angle(c, a, b) - PI;
    excess.copysign(a.dot(b.cross(c)))
}

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn winding_numbers_match_the_sum_over_all_triangles() {
    let mut mesh = TestMesh::ball(DVec3::new(0.3, 0.2, -0.1), 10.0, 40);
    // Keep half of the triangles, so that all winding numbers between 0 and 1 occur.
    mesh.triangles.truncate(mesh.triangles.len() / 2);
    let (tree, corners) = (TriangleTree::new(mesh.corners()), mesh.corners());
    let mut worst: f64 = 0.0;
    for index in 0..4000 {
        let point = IVec3::new(index % 20, index / 20 % 20, index / 400).as_dvec3() * 1.61 - 15.7;
        let all: f64 = corners.iter().map(|triangle| solid_angle(triangle, point)).sum::<f64>() / (4.0 * PI);
        worst = worst.max((winding(&tree, point) - all).abs());
        let step = 1e-4;
        let slopes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| {
            let at = |point| corners.iter().map(|triangle| solid_angle(triangle, point)).sum::<f64>();
            (at(point + axis * step) - at(point - axis * step)) / (2.0 * step * 4.0 * PI)
        });
        let (gradient, slope) = (winding_gradient(&tree, point), DVec3::from(slopes));
        assert!((gradient - slope).length() < 0.03 + 0.1 * slope.length(), "{point} {slope}");
    }
    assert!(worst < super::mesh_sdf::WINDING_ERROR, "{worst}");
}

/// Defects of the mesh do not matter: flipped parts, duplicate parts, seams.
#[test]
fn defective_meshes_enclose_the_intended_volume() {
    let mesh = TestMesh::torus(DVec3::new(0.2, 0.1, -0.3), 12.0, 5.0, 16);
    let sound = mesh.solid();
    let values = |solid: &MeshSdf| {
        sample(IVec3::splat(-24), IVec3::splat(24), &UNIT, |origin, lattice, far| {
            solid.leaf(origin, lattice, far)
        })
    };
    let expected = values(&sound);
    let inside_out = mesh.clone().flipped().solid();
    assert_eq!(inside_out.findings().flipped_count, mesh.triangles.len());
    let mut patched = mesh.clone();
    patched.triangles[100..300].iter_mut().for_each(|triangle| triangle.swap(0, 1));
    let mut two_sided = mesh.clone();
    two_sided.triangles.extend(mesh.clone().flipped().triangles);
    // Unshare the vertices: each triangle has its own corners.
    let own = |corner: &u32| mesh.positions[*corner as usize];
    let torn = TestMesh {
        positions: mesh.triangles.iter().flatten().map(own).collect(),
        triangles: (0..mesh.triangles.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
    };
    let mut broken = mesh.clone();
    broken.positions.push([f64::NAN; 3]);
    broken.triangles.extend([[0, 1, broken.positions.len() as u32 - 1], [0, 1, u32::MAX], [2, 2, 3]]);
    for (name, solid) in [
        ("inside out", inside_out),
        ("a patch turned", patched.solid()),
        ("two-sided", two_sided.solid()),
        ("torn", torn.solid()),
        ("broken", broken.solid()),
    ] {
        assert_eq!(solid.findings().open_edge_count, 0, "{name}");
        let found = values(&solid);
        let worst =
            found.iter().zip(&expected).map(|(one, other)| (one.1 - other.1).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-5, "{name}: {worst}");
    }
    assert_eq!(two_sided.solid().findings().duplicate_count, mesh.triangles.len());
    let findings = *broken.solid().findings();
    assert_eq!((findings.invalid_count, findings.degenerate_count), (2, 1));
    assert_eq!(findings.triangle_count, mesh.triangles.len());
}

#[test]
fn parts_are_united_and_cavities_stay() {
    let (min, max, step) = (DVec3::splat(-9.5), DVec3::splat(3.5), DVec3::splat(6.0));
    let both = |point: DVec3| to_cuboid(min, max, point).min(to_cuboid(min + step, max + step, point));
    let second = TestMesh::cuboid(min + step, max + step);
    for second in [second.clone(), second.flipped()] {
        let solid = TestMesh::cuboid(min, max).and(second).solid();
        for (voxel, value) in sample(IVec3::splat(-16), IVec3::splat(16), &UNIT, |at, lattice, far| {
            solid.leaf(at, lattice, far)
        }) {
            let known = both(voxel.as_dvec3());
            // Inside, walls that are in the other part also count for the distance, so only the sign is
            // compared.
            assert_eq!(value < 0.0, known < 0.0, "{voxel}");
            assert!(known < 0.0 || (known.min(6.0) - f64::from(value)).abs() < 1e-5, "{voxel}");
        }
    }
    let (inner, outer) = (TestMesh::ball(DVec3::ZERO, 8.0, 24), TestMesh::ball(DVec3::ZERO, 18.0, 24));
    let hollow = outer.clone().and(inner.clone().flipped());
    for mesh in [hollow.clone(), hollow.flipped()] {
        let solid = mesh.solid();
        let error = error_of(&solid, &UNIT, |point| (point.length() - 18.0).max(8.0 - point.length()));
        assert!(error < 0.12, "{error}");
    }
    let filled = outer.and(inner).solid();
    assert!(matches!(filled.leaf(IVec3::splat(-4), &UNIT, 0.5), ObstacleLeaf::Inside));
}

/// A separate part that faces inwards is flipped if there are few parts, even with many cavities; with too
/// many parts it is reported.
#[test]
fn inward_facing_parts_are_flipped_or_reported() {
    let cube = |x: usize, y: usize, size: f64| {
        let min = DVec3::new(x as f64, y as f64, 0.0) * 4.0;
        TestMesh::cuboid(min, min + size)
    };
    let block = TestMesh::cuboid(DVec3::new(-2.0, -2.0, -2.0), DVec3::new(262.0, 262.0, 3.0));
    for (cavity_count, is_tested) in [(3, true), (4000, true), (4100, false)] {
        let aside = TestMesh::cuboid(DVec3::new(-9.0, -9.0, -9.0), DVec3::splat(-5.0)).flipped();
        let mut mesh = aside.and(block.clone());
        for index in 0..cavity_count {
            mesh = mesh.and(cube(index % 65, index / 65, 1.0).flipped());
        }
        let findings = *mesh.solid().findings();
        let expected = if is_tested { (12, 0) } else { (0, cavity_count + 1) };
        assert_eq!((findings.flipped_count, findings.unchecked_part_count), expected, "{cavity_count}");
    }
}

/// A patch closes a hole: distances are continuous there, and the open edges are reported.
#[test]
fn holes_are_closed_by_a_patch() {
    let (min, max) = (DVec3::splat(-10.0), DVec3::splat(10.0));
    let mut mesh = TestMesh::cuboid(min, max);
    let lid = 10; // one of the two triangles at z = 10
    assert!(
        mesh.corners()[lid].iter().all(|corner| corner.x == 10.0 || corner.z == 10.0 || corner.y == 10.0)
    );
    mesh.triangles.remove(lid);
    let solid = mesh.solid();
    assert_eq!(solid.findings().open_edge_count, 3);
    let values: std::collections::HashMap<IVec3, f32> =
        sample(IVec3::splat(-16), IVec3::splat(16), &UNIT, |at, lattice, far| solid.leaf(at, lattice, far))
            .into_iter()
            .collect();
    let mut steepest: f32 = 0.0;
    for (voxel, value) in &values {
        let known = to_cuboid(min, max, voxel.as_dvec3());
        // The patch is curved: it deviates from a plane by a fraction of the width of the hole, 20 voxels.
        // Voxels near it are not checked.
        assert!(known.abs() < 5.0 || (*value < 0.0) == (known < 0.0), "{voxel}: {value}");
        for step in [IVec3::X, IVec3::Y, IVec3::Z] {
            if let Some(next) = values.get(&(*voxel + step)) {
                steepest = steepest.max((value - next).abs());
            }
        }
    }
    assert!(steepest < 2.0, "{steepest}");
    let mut ball = TestMesh::ball(DVec3::ZERO, 13.0, 48);
    ball.triangles.remove(2000);
    let error = error_of(&ball.solid(), &UNIT, |point| point.length() - 13.0);
    assert!(error < 0.1, "{error}");
}

#[test]
fn precision_is_kept_far_from_the_origin() {
    // The lattice moves along, so the values are the same.
    let far = IVec3::new(1 << 28, -(1 << 27), 1 << 26);
    let mesh = TestMesh::torus(DVec3::new(0.5, 0.25, -0.125), 12.0, 5.0, 16);
    let mut moved = mesh.clone();
    for position in &mut moved.positions {
        *position = (DVec3::from(*position) + far.as_dvec3()).to_array();
    }
    let (near, there) = (mesh.solid(), moved.solid());
    for index in 0..64 {
        let origin = (IVec3::new(index / 16, index / 4 % 4, index % 4) - 2) * 8;
        let (one, other) = (near.leaf(origin, &UNIT, 6.0), there.leaf(origin + far, &UNIT, 6.0));
        match (one, other) {
            (ObstacleLeaf::Near(one), ObstacleLeaf::Near(other)) => {
                let pairs = one.values.iter().zip(&other.values);
                assert!(pairs.map(|(one, other)| (one - other).abs()).fold(0.0, f32::max) < 1e-4, "{origin}");
            }
            (one, other) => assert_eq!(one, other, "{origin}"),
        }
    }
}

/// A ball as a level set with voxels of this edge, rotated about z.
fn level_set(center: DVec3, radius: f64, voxel_size: f64, band_voxels: f32) -> SourceLevelSet {
    let (sine, cosine) = 0.3f64.sin_cos();
    let axes =
        [DVec3::new(cosine, sine, 0.0), DVec3::new(-sine, cosine, 0.0), DVec3::Z].map(|a| a * voxel_size);
    let background = band_voxels * voxel_size as f32;
    let at = |voxel: IVec3| {
        let position =
            axes[0] * f64::from(voxel.x) + axes[1] * f64::from(voxel.y) + axes[2] * f64::from(voxel.z);
        ((position.length() - radius) as f32).clamp(-background, background)
    };
    let mut source = SourceLevelSet {
        origins: Vec::new(),
        leaves: Vec::new(),
        tiles: Vec::new(),
        background,
        axes,
        translation: center,
    };
    let reach = ((radius / voxel_size + f64::from(band_voxels)) / 8.0) as i32 + 1;
    for index in 0..(2 * reach).pow(3) {
        let position =
            IVec3::new(index / (2 * reach).pow(2), index / (2 * reach) % (2 * reach), index % (2 * reach));
        let origin = (position - reach) * 8;
        let leaf: [f32; LEAF_VOXELS] = std::array::from_fn(|offset| at(origin + voxel_in_leaf(offset)));
        if leaf.iter().any(|value| value.abs() < background) {
            source.origins.push(origin);
            source.leaves.push(leaf);
        } else if leaf[0] < 0.0 {
            source.tiles.push((origin, 8, leaf[0]));
        }
    }
    source
}

#[test]
fn resampled_level_sets_match_the_original_ball() {
    let center = DVec3::new(1.7, -2.2, 0.4);
    for (voxel_size, band, tolerance) in [(1.0, 8.0, 0.05), (0.37, 20.0, 0.02), (2.3, 4.0, 0.25)] {
        let sampled = GridSdf::new(level_set(center, 12.0, voxel_size, band), 1 << 30).expect("a level set");
        let mut worst: f64 = 0.0;
        for (voxel, value) in sample(IVec3::splat(-24), IVec3::splat(24), &UNIT, |at, lattice, far| {
            sampled.leaf(at, lattice, far)
        }) {
            let known = (voxel.as_dvec3().distance(center) - 12.0).clamp(-6.0, 6.0);
            worst = worst.max((known - f64::from(value)).abs());
        }
        assert!(worst < tolerance, "voxels of {voxel_size}: {worst}");
    }
    let narrow = GridSdf::new(level_set(center, 12.0, 1.0, 3.0), 1 << 30).expect("a level set");
    for (voxel, value) in
        sample(IVec3::splat(-24), IVec3::splat(24), &UNIT, |at, lattice, far| narrow.leaf(at, lattice, far))
    {
        let known = voxel.as_dvec3().distance(center) - 12.0;
        let is_right = (known.clamp(-6.0, 6.0) - f64::from(value)).abs() < 0.25;
        let is_on_side = known.abs() < 0.05 || (value < 0.0) == (known < 0.0);
        assert!(is_right && is_on_side, "{voxel}: {value} {known}");
    }
}

#[test]
fn invalid_level_sets_are_rejected() {
    let sound = level_set(DVec3::ZERO, 5.0, 1.0, 3.0);
    for (source, word) in [
        (SourceLevelSet { axes: [DVec3::X, DVec3::Y * 2.0, DVec3::Z], ..sound.clone() }, "cubes"),
        (SourceLevelSet { axes: [DVec3::X, DVec3::Y, DVec3::Y], ..sound.clone() }, "cubes"),
        (SourceLevelSet { axes: [DVec3::ZERO; 3], ..sound.clone() }, "cubes"),
        (SourceLevelSet { background: 0.0, ..sound.clone() }, "background"),
        (SourceLevelSet { leaves: Vec::new(), ..sound }, "leaves"),
    ] {
        let error = GridSdf::new(source, 1 << 30).err().expect("no level set");
        assert!(error.contains(word), "{error}");
    }
}

fn obstacle(mesh: &TestMesh, cache_bytes_max: usize) -> Arc<Obstacle> {
    Arc::new(Obstacle::new(ObstacleSdf::Mesh(mesh.solid()), cache_bytes_max))
}

#[test]
fn cached_leaves_equal_computed_leaves() {
    let mesh = TestMesh::ball(DVec3::splat(0.3), 13.0, 12);
    let other = TestMesh::cuboid(DVec3::new(5.0, -20.0, -3.0), DVec3::new(30.0, 20.0, 3.0));
    for cache_bytes_max in [0, 20 << 10, 1 << 30] {
        let obstacles =
            Obstacles { members: vec![obstacle(&mesh, cache_bytes_max), obstacle(&other, cache_bytes_max)] };
        for lattice in [UNIT, Lattice { voxel_size: 1.5 }] {
            for _ in 0..2 {
                for index in 0..216 {
                    let origin = (IVec3::new(index / 36, index / 6 % 6, index % 6) - 3) * 8;
                    let fresh = mesh.solid().leaf(origin, &lattice, HALF_WIDTH);
                    let union = fresh.union(other.solid().leaf(origin, &lattice, HALF_WIDTH));
                    let found = obstacles.leaf(origin, &lattice, HALF_WIDTH);
                    assert_eq!(found, union, "{origin}");
                    if matches!(found, ObstacleLeaf::Near(_)) {
                        assert!(obstacles.touches(origin, &lattice, HALF_WIDTH), "{origin}");
                    }
                }
            }
        }
        assert!(obstacles.members[0].cache.size_bytes() <= cache_bytes_max);
        assert!(obstacles.members[0].size_bytes() <= obstacles.members[0].size_bytes_max());
        assert_eq!(obstacles.members[0].cache.size_bytes() > 0, cache_bytes_max > 0);
    }
    let obstacles = Obstacles { members: vec![obstacle(&mesh, 0)] };
    assert!(!obstacles.touches(IVec3::splat(64), &UNIT, HALF_WIDTH));
    assert!(!obstacles.touches(IVec3::splat(-4), &UNIT, 1.0));
}

#[test]
fn empty_mesh_is_outside_everywhere() {
    for (positions, triangles) in [
        (vec![], vec![]),
        (vec![[0.0; 3]; 3], vec![[0, 1, 2]]),
        (vec![[f64::INFINITY; 3]; 3], vec![[0, 1, 2]]),
    ] {
        let solid = MeshSdf::new(&positions, &triangles);
        assert_eq!(solid.findings().triangle_count, 0);
        assert_eq!(solid.leaf(IVec3::ZERO, &UNIT, 6.0), ObstacleLeaf::Outside);
        assert!(!solid.touches(IVec3::ZERO, &UNIT, 6.0));
        assert_eq!(solid.depth(DVec3::ZERO), None);
    }
}

/// A vertex that is moved to a wall gets the normal of the wall. Other vertices keep their normals.
#[test]
fn moved_vertices_face_the_wall() {
    let wall = TestMesh::cuboid(DVec3::new(-30.0, -30.0, -20.0), DVec3::new(30.0, 30.0, 0.25));
    let obstacles = Obstacles { members: vec![obstacle(&wall, 0)] };
    let mut mesh = crate::mesh::Mesh {
        positions: vec![Vec3::new(1.0, 2.0, -0.25), Vec3::new(1.0, 2.0, 0.2), Vec3::new(1.0, 2.0, 0.5)],
        normals: vec![Vec3::X; 3],
        ..crate::mesh::Mesh::default()
    };
    let stats = obstacles.move_vertices_out(&mut mesh, &UNIT, HALF_WIDTH);
    assert_eq!(stats.moved_count, 1);
    assert!(mesh.positions[0].distance(Vec3::new(1.0, 2.0, 0.25)) < 1e-6, "{}", mesh.positions[0]);
    assert!(mesh.normals[0].distance(Vec3::NEG_Z) < 1e-6, "{}", mesh.normals[0]);
    assert_eq!(mesh.normals[1..], [Vec3::X; 2]);
}

/// A sheet is solid behind its normals: a plane, whichever way it faces, and terrain. Other meshes keep their
/// shape, open or not.
#[test]
fn open_sheets_are_solid_behind_their_normals() {
    let tilted = |x: f64, y: f64| DVec3::new(x, 0.8 * y - 0.3, 0.6 * y + 0.2);
    let quad = |at: &dyn Fn(f64, f64) -> DVec3| TestMesh {
        positions: [(-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (-30.0, 30.0)]
            .map(|(x, y)| at(x, y).to_array())
            .to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
    };
    let bumpy = TestMesh {
        positions: (0..31 * 31)
            .map(|index| [f64::from(index % 31) * 2.0 - 30.0, f64::from(index / 31) * 2.0 - 30.0])
            .map(|[x, y]| [x, y, (0.3 * x).sin() + (0.4 * y).cos()])
            .collect(),
        triangles: (0..30 * 30)
            .map(|index| index / 30 * 31 + index % 30)
            .flat_map(|corner| [[corner, corner + 1, corner + 32], [corner, corner + 32, corner + 31]])
            .collect(),
    };
    let level = quad(&|x, y| DVec3::new(x, y, 0.25));
    let aside = TestMesh::ball(DVec3::new(0.0, 0.0, 20.0), 4.0, 12);
    let height = |point: DVec3| point.z - 0.25;
    let slope = |point: DVec3| (point - DVec3::new(0.0, -0.3, 0.2)).dot(DVec3::new(0.0, -0.6, 0.8));
    let bumps = |point: DVec3| point.z - (0.3 * point.x).sin() - (0.4 * point.y).cos();
    type Distance<'a> = &'a dyn Fn(DVec3) -> f64;
    let cases: [(&str, TestMesh, Distance, f64); 5] = [
        ("level", level.clone(), &height, 1e-5),
        ("facing down", level.clone().flipped(), &|point| -height(point), 1e-5),
        ("tilted", quad(&tilted), &slope, 1e-5),
        // The distance to bumps is not exact: only signs are compared.
        ("bumpy", bumpy, &bumps, f64::INFINITY),
        ("beside a ball", level.clone().and(aside.flipped()), &height, 1e-5),
    ];
    for (name, mesh, known, tolerance) in cases {
        let solid = mesh.solid();
        let MeshFindings { sheet_count, open_edge_count, encloses_nothing, .. } = *solid.findings();
        assert_eq!((sheet_count, open_edge_count, encloses_nothing), (1, 0, false), "{name}");
        let (from, to) = (IVec3::new(-16, -16, -16), IVec3::new(16, 16, 8));
        for (voxel, value) in sample(from, to, &UNIT, |at, lattice, far| solid.leaf(at, lattice, far)) {
            let known = known(voxel.as_dvec3());
            assert!(known.abs() < 0.2 || (value < 0.0) == (known < 0.0), "{name}, {voxel}: {value}");
            assert!(
                (known.clamp(-6.0, 6.0) - f64::from(value)).abs() < tolerance.max(1e-5),
                "{name}, {voxel}"
            );
        }
    }
    // The sides of a box that share no vertices, facing out or in, are no sheets.
    let whole = TestMesh::cuboid(DVec3::splat(-9.5), DVec3::splat(9.5));
    let mut apart = TestMesh::default();
    for side in whole.triangles.chunks(2) {
        let nudge = 1e-9 * apart.triangles.len() as f64;
        let positions = whole.positions.iter().map(|position| position.map(|along| along + nudge)).collect();
        apart = apart.and(TestMesh { positions, triangles: side.to_vec() });
    }
    for mesh in [apart.clone(), apart.flipped()] {
        let solid = mesh.solid();
        assert_eq!(solid.findings().sheet_count, 0);
        for (at, is_inside) in [(0.0, true), (9.0, true), (10.0, false)] {
            let distance = solid.distance(DVec3::new(at, 0.5, -0.5)).expect("triangles");
            assert_eq!(distance < 0.0, is_inside, "{at}: {distance}");
        }
    }
}

/// Coordinates that round to more than thousandths of a voxel are refused: distances from them have no
/// digits.
#[test]
fn obstacles_beyond_the_precision_are_refused() {
    let limit = 2f64.powi(42);
    for (corner, is_refused) in [(0.9 * limit, false), (1.1 * limit, true), (1e18, true), (-1e70, true)] {
        let mut mesh = TestMesh::ball(DVec3::ZERO, 5.0, 8);
        mesh.positions.extend([[corner, 0.0, 0.0], [f64::NAN; 3]]);
        let unused = Obstacles { members: vec![obstacle(&mesh, 0)] };
        assert_eq!(unused.too_far(1.0), None, "{corner}: no triangle has this vertex");
        let last = mesh.positions.len() as u32 - 2;
        mesh.triangles.extend([[0, 1, last], [0, 1, last + 1]]);
        let obstacles = Obstacles { members: vec![unused.members[0].clone(), obstacle(&mesh, 0)] };
        let too_far = obstacles.too_far(1.0);
        assert_eq!(too_far.map(|far| (far.index, far.point.x)), is_refused.then_some((1, corner)));
        assert!(obstacles.too_far(1e-3 * corner.abs() / limit).is_some());
    }
}

/// An open mesh that encloses nothing and faces several ways is reported.
#[test]
fn open_meshes_that_enclose_nothing_are_reported() {
    let terrain = |bumps: f64| {
        let at = |u: f64, v: f64| {
            DVec3::new(v * 40.0, (20.0 * v).sin() * (TAU * u).cos() * bumps, (TAU * u).cos() * 20.0)
        };
        TestMesh::swept(24, 24, false, at)
    };
    let half_a_torus = |u: f64, v: f64| {
        let (around, across) = (TAU * u, PI * v);
        DVec3::new(
            (9.0 + 4.0 * across.cos()) * around.cos(),
            (9.0 + 4.0 * across.cos()) * around.sin(),
            4.0 * across.sin(),
        )
    };
    let ring = TestMesh::swept(24, 1, false, |u, v| DVec3::new((TAU * u).cos(), (TAU * u).sin(), 0.05 * v));
    let mut open_box = TestMesh::cuboid(DVec3::ZERO, DVec3::splat(4.0));
    open_box.triangles.truncate(10);
    let mut plane = TestMesh::cuboid(DVec3::ZERO, DVec3::splat(4.0));
    plane.triangles.truncate(2);
    for (name, mesh, expected) in [
        ("a plane", plane.clone(), false),
        ("hardly bent", terrain(0.0), false),
        ("a ring", ring, true),
        ("a box", TestMesh::cuboid(DVec3::ZERO, DVec3::splat(4.0)), false),
        ("a box without a side", open_box, false),
        ("half a torus", TestMesh::swept(24, 24, false, half_a_torus), false),
        ("a plane beside a ball", plane.and(TestMesh::ball(DVec3::splat(30.0), 5.0, 8)), false),
    ] {
        assert_eq!(mesh.solid().findings().encloses_nothing, expected, "{name}");
    }
}

#[test]
fn distances_of_points_are_negative_inside() {
    let solid = |mesh: &TestMesh| MeshSdf::new(&mesh.positions, &mesh.triangles);
    let torus = solid(&TestMesh::torus(DVec3::new(1.0, 2.0, 3.0), 5.0, 1.5, 96));
    for at in [DVec3::ZERO, DVec3::new(6.0, 2.0, 3.0), DVec3::new(1.0, 2.0, 3.0), DVec3::new(40.0, -7.0, 3.5)]
    {
        let from_middle = at - DVec3::new(1.0, 2.0, 3.0);
        let truth = (from_middle.truncate().length() - 5.0).hypot(from_middle.z) - 1.5;
        let distance = torus.distance(at).expect("a surface");
        assert!((distance - truth).abs() < 0.01, "{at}: {distance} and not {truth}");
    }
    assert_eq!(solid(&TestMesh::default()).distance(DVec3::ZERO), None);
}
