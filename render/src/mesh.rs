//! Ray intersection with the triangles of a mesh.
//!
//! ```text
//!   tree of boxes ─▶ triangles ─▶ on which side of each edge does the ray pass?
//! ```
//!
//! Two triangles compute the side of their common edge from the same products, so no ray passes between them.

use glam::{DVec3, Vec3};
use meniscus_surface::space::box_of;

use crate::surface::Ray;
use crate::tile::RayTarget;
use crate::tree::BoxTree;

/// A triangle mesh to render.
#[derive(Clone, Copy, Debug)]
pub struct TriangleMesh<'a> {
    /// Vertex positions, world units.
    pub positions: &'a [[f64; 3]],
    /// Outward vertex normals. If there is none for each vertex, the triangles look flat.
    pub normals: &'a [[f32; 3]],
    /// Vertex indices, counter-clockwise seen from outside. A triangle with an index out of range or with a
    /// position that is not finite is not shown.
    pub triangles: &'a [[u32; 3]],
}

impl TriangleMesh<'_> {
    /// The corners of a triangle; `None` if one of them is missing or not finite.
    fn corners(&self, &[a, b, c]: &[u32; 3]) -> Option<[DVec3; 3]> {
        let corner = |index: u32| {
            let position = self.positions.get(index as usize).map(|&position| DVec3::from(position));
            position.filter(|position| position.abs().cmple(DVec3::splat(COORDINATE_MAX)).all())
        };
        Some([corner(a)?, corner(b)?, corner(c)?])
    }

    /// The triangles that can be shown, by index, each with its corners.
    fn visible(&self) -> impl Iterator<Item = (u32, [DVec3; 3])> {
        let has_area = |[a, b, c]: &[DVec3; 3]| (b - a).cross(c - a) != DVec3::ZERO;
        let all = self.triangles.iter().zip(0u32..);
        all.filter_map(move |(triangle, index)| Some((index, self.corners(triangle).filter(has_area)?)))
    }

    /// Number of triangles with a corner that is missing or not finite.
    pub fn broken_count(&self) -> usize {
        self.triangles.iter().filter(|triangle| self.corners(triangle).is_none()).count()
    }

    /// The bounding box of the triangles that can be shown, without outliers, world units; `None` if there
    /// are none.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        let boxes: Vec<[DVec3; 2]> = self.visible().map(|(_, corners)| box_around(corners)).collect();
        box_of(boxes.len(), |index| boxes[index])
    }
}

/// Products of three larger coordinates could overflow.
const COORDINATE_MAX: f64 = 1e60;

fn box_around([a, b, c]: [DVec3; 3]) -> [DVec3; 2] {
    [a.min(b).min(c), a.max(b).max(c)]
}

/// A mesh prepared for ray intersection. Lengths are in voxels: units of about an edge of its triangles, so
/// that a mesh is lit like the level set that it was made from.
pub(super) struct RayMesh<'a> {
    mesh: TriangleMesh<'a>,
    /// World units.
    pub(super) voxel_size: f64,
    /// The bounding box of the triangles without outliers, in voxels.
    pub(super) bounds: Option<[DVec3; 2]>,
    tree: BoxTree,
}

/// A point where a ray hits a triangle.
#[derive(Clone, Copy, Debug)]
pub(super) struct MeshHit {
    pub(super) t: f64,
    /// Whether the ray came from outside.
    pub(super) is_front: bool,
    triangle: u32,
    /// The weights of the triangle's corners.
    weights: [f64; 3],
}

/// A mesh is at least this long, in voxels, so that the shadows of a few large triangles have their shape.
const LENGTH_MIN: f64 = 64.0;

/// A mesh is at most this long, in voxels.
const LENGTH_MAX: f64 = (1 << 20) as f64;

impl<'a> RayMesh<'a> {
    pub(super) fn new(mesh: &TriangleMesh<'a>) -> RayMesh<'a> {
        let has_normals = mesh.normals.len() == mesh.positions.len();
        let mesh = TriangleMesh { normals: if has_normals { mesh.normals } else { &[] }, ..*mesh };
        let bounds = mesh.bounds();
        let (mut edges, mut edge_count) = (0.0, 0usize);
        for (_, [a, b, c]) in mesh.visible() {
            edges += a.distance(b) + b.distance(c) + c.distance(a);
            edge_count += 3;
        }
        let length = bounds.map_or(1.0, |[least, greatest]| (greatest - least).max_element());
        let edge = edges / edge_count.max(1) as f64;
        let voxel_size = edge.min(length / LENGTH_MIN).max(length / LENGTH_MAX).max(f64::MIN_POSITIVE);
        let in_voxels = |bounds: [DVec3; 2]| bounds.map(|corner| corner / voxel_size);
        let mut ray_mesh =
            RayMesh { mesh, voxel_size, bounds: bounds.map(in_voxels), tree: BoxTree::default() };
        let center = |(index, [a, b, c]): (u32, [DVec3; 3])| ((a + b + c) / 3.0, index);
        let items = mesh.visible().map(center).collect();
        ray_mesh.tree = BoxTree::new(items, &|triangle| box_around(ray_mesh.corners(triangle)));
        ray_mesh
    }

    /// The smallest z of a triangle; `None` without triangles.
    pub(super) fn least_z(&self) -> Option<f64> {
        self.tree.bounds().map(|[least, _]| least.z)
    }

    fn corners(&self, triangle: u32) -> [DVec3; 3] {
        let corner = |index: u32| DVec3::from(self.mesh.positions[index as usize]) / self.voxel_size;
        self.mesh.triangles[triangle as usize].map(corner)
    }

    /// Calls `each` with the hits of a ray below a limit of t, in any order. `each` returns the new limit.
    fn visit(&self, ray: &Ray, mut each: impl FnMut(MeshHit) -> f64) {
        self.tree.visit(ray, |triangle, limit| {
            self.hit_triangle(triangle, ray).filter(|hit| hit.t < limit).map_or(limit, &mut each)
        });
    }

    fn hit_triangle(&self, triangle: u32, ray: &Ray) -> Option<MeshHit> {
        let [a, b, c] = self.corners(triangle).map(|corner| corner - ray.origin);
        // Each is positive on one side of an edge and negative on the other.
        let side = |from: DVec3, to: DVec3| from.cross(to).dot(ray.direction);
        let sides = DVec3::new(side(b, c), side(c, a), side(a, b));
        let is_hit = sides.cmpge(DVec3::ZERO).all() || sides.cmple(DVec3::ZERO).all();
        let sum = sides.element_sum();
        if !is_hit || sum == 0.0 {
            return None;
        }
        let weights = (sides / sum).to_array();
        let t = (weights[0] * a + weights[1] * b + weights[2] * c).dot(ray.direction);
        (t > 0.0).then_some(MeshHit { t, is_front: sum < 0.0, triangle, weights })
    }

    /// Calls `each` with t, and with whether the ray came from outside, for all hits of a ray, in any order.
    pub(super) fn crossings(&self, ray: &Ray, mut each: impl FnMut(f64, bool)) {
        self.visit(ray, |hit| {
            each(hit.t, hit.is_front);
            f64::INFINITY
        });
    }

    /// The unit normals at the corners of a triangle; `None` if the mesh has none.
    fn normals(&self, triangle: u32) -> Option<[DVec3; 3]> {
        let normal = |index: u32| self.mesh.normals.get(index as usize);
        let [a, b, c] = self.mesh.triangles[triangle as usize].map(normal);
        let unit = |normal: [f32; 3]| DVec3::from(normal.map(f64::from)).normalize_or_zero();
        Some([*a?, *b?, *c?].map(unit))
    }
}

impl RayTarget for RayMesh<'_> {
    type Local = MeshHit;

    fn hit(&self, ray: &Ray) -> Option<(f64, bool, MeshHit)> {
        let mut nearest = None;
        self.visit(ray, |hit| nearest.insert(hit).t);
        nearest.map(|hit| (hit.t, hit.is_front, hit))
    }

    /// The normal that the mesh has there, on the outside of the triangle.
    fn outward(&self, hit: &MeshHit) -> Vec3 {
        let [a, b, c] = self.corners(hit.triangle);
        let flat = (b - a).cross(c - a).normalize_or_zero();
        let blended = |[a, b, c]: [DVec3; 3]| hit.weights[0] * a + hit.weights[1] * b + hit.weights[2] * c;
        let smooth = self.normals(hit.triangle).map_or(flat, blended).normalize_or(flat);
        (if smooth.dot(flat) < 0.0 { -smooth } else { smooth }).as_vec3()
    }

    /// Half the divergence of the normals, which are interpolated between the corners.
    fn mean_curvature(&self, hit: &MeshHit) -> f32 {
        let Some(normals) = self.normals(hit.triangle) else { return 0.0 };
        let [a, b, c] = self.corners(hit.triangle);
        let across = (b - a).cross(c - a);
        // The gradients of the weights.
        let gradients = [c - b, a - c, b - a].map(|edge| across.cross(edge) / across.length_squared());
        let along = gradients.iter().zip(normals).map(|(gradient, normal)| gradient.dot(normal));
        (0.5 * along.sum::<f64>()) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::Sky;

    struct Ball {
        positions: Vec<[f64; 3]>,
        normals: Vec<[f32; 3]>,
        triangles: Vec<[u32; 3]>,
    }

    impl Ball {
        fn mesh(&self) -> TriangleMesh<'_> {
            TriangleMesh { positions: &self.positions, normals: &self.normals, triangles: &self.triangles }
        }
    }

    /// A ball of this radius around the origin: a latitude–longitude grid, with normals.
    fn ball(radius: f64) -> Ball {
        const ROWS: u32 = 60;
        let vertex = |index: u32| {
            let (row, column) = (index / (2 * ROWS), index % (2 * ROWS));
            let [polar, around] =
                [row, column].map(|along| f64::from(along) / f64::from(ROWS) * std::f64::consts::PI);
            DVec3::new(polar.sin() * around.cos(), polar.cos(), -polar.sin() * around.sin())
        };
        let unit: Vec<DVec3> = (0..(ROWS + 1) * 2 * ROWS).map(vertex).collect();
        let quad = |index: u32| {
            let (row, column) = (index / (2 * ROWS), index % (2 * ROWS));
            let at = |down: u32, right: u32| (row + down) * 2 * ROWS + (column + right) % (2 * ROWS);
            [[at(0, 0), at(1, 0), at(1, 1)], [at(0, 0), at(1, 1), at(0, 1)]]
        };
        let positions = unit.iter().map(|normal| (*normal * radius).to_array()).collect();
        let normals = unit.iter().map(|normal| normal.as_vec3().to_array()).collect();
        Ball { positions, normals, triangles: (0..ROWS * 2 * ROWS).flat_map(quad).collect() }
    }

    #[test]
    fn rays_hit_a_ball_of_triangles_at_its_surface() {
        let ball = ball(3.0);
        let target = RayMesh::new(&ball.mesh());
        let radius = 3.0 / target.voxel_size;
        let mut hit_count = 0;
        for index in 0..4000 {
            let [x, y] = [index % 64, index / 64].map(|along| f64::from(along) / 26.0 - 1.2);
            let ray = Ray::new(DVec3::new(x, y, 10.0) * radius, DVec3::NEG_Z);
            let apart = f64::hypot(x, y);
            match target.hit(&ray) {
                Some((t, is_front, hit)) => {
                    let outward = ray.at(t).normalize();
                    assert!((ray.at(t).length() / radius - 1.0).abs() < 2e-3 && is_front, "{x} {y}");
                    assert!(target.outward(&hit).as_dvec3().dot(outward) > 0.999, "{x} {y}");
                    let curvature = f64::from(target.mean_curvature(&hit)) * radius;
                    assert!((curvature - 1.0).abs() < 0.05, "{x} {y}: {curvature}");
                    let mut sides = Vec::new();
                    target.crossings(&ray, |t, is_front| sides.push((t, is_front)));
                    sides.sort_by(|one, other| one.0.total_cmp(&other.0));
                    let sides: Vec<bool> = sides.iter().map(|(_, is_front)| *is_front).collect();
                    assert_eq!(sides, [true, false], "{x} {y}");
                    hit_count += 1;
                }
                None => assert!(apart > 0.998, "a ray passes through the ball at {x} {y}"),
            }
        }
        assert!(hit_count > 1000);
    }

    #[test]
    fn mesh_occludes_the_sky_like_its_volume() {
        let ball = ball(3.0);
        let mesh = ball.mesh();
        let target = RayMesh::new(&mesh);
        let sky = Sky::of_mesh(&target);
        let expected = 4.0 / 3.0 * std::f64::consts::PI * (3.0 / target.voxel_size).powi(3);
        let volume = sky.inside_voxels();
        assert!((f64::from(volume) / expected - 1.0).abs() < 0.02, "{volume} of {expected}");
        // Rays along z enter half a ball and do not leave it: the inside is unknown.
        let is_kept = |&index: &u32| ball.positions[index as usize][2] < 1e-9;
        let half = ball.triangles.iter().filter(|triangle| triangle.iter().all(is_kept)).copied();
        let half: Vec<[u32; 3]> = half.collect();
        let open = RayMesh::new(&TriangleMesh { triangles: &half, ..mesh });
        assert_eq!(Sky::of_mesh(&open).inside_voxels(), 0.0);
    }

    #[test]
    fn broken_triangles_are_not_shown() {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [f64::NAN; 3], [1e300; 3]];
        let triangles = [[0, 1, 7], [0, 1, 3], [0, 1, 4], [0, 0, 1], [0, 1, 2]];
        let mesh = TriangleMesh { positions: &positions, normals: &[[0.0; 3]; 2], triangles: &triangles };
        assert_eq!(mesh.broken_count(), 3);
        assert_eq!(mesh.bounds(), Some([DVec3::ZERO, DVec3::new(1.0, 1.0, 0.0)]));
        let target = RayMesh::new(&mesh);
        let at = |z: f64| Ray::new(DVec3::new(0.2, 0.2, z) / target.voxel_size, DVec3::Z * -z.signum());
        for (z, expected) in [(1.0, true), (-1.0, false)] {
            let (_, is_front, hit) = target.hit(&at(z)).expect("a triangle");
            assert_eq!((is_front, target.outward(&hit)), (expected, Vec3::Z));
        }
        let nothing = RayMesh::new(&TriangleMesh { triangles: &triangles[..4], ..mesh });
        assert!(nothing.hit(&at(1.0)).is_none() && nothing.bounds.is_none());
    }
}
