//! Checks every result before it is written. The certificate of a frame has the results.
//!
//! ```text
//!   φ within its bounds at every voxel                    (Eq. 6), before the surface is moved by an offset
//!   no vertex deeper inside S_min than h/2                the surface stays outside S_min and inside S_max,
//!   no vertex farther outside S_max than h/2              except for the interpolation error within a cell
//!   every particle inside
//!   the mesh closed and 2-manifold
//! ```
//!
//! The mesh is checked as it is written: after decimation, and with rounded positions.
//!
//! A surface that is moved outward by b is farther from S_min by b, and farther from S_max by at most b. A
//! surface that is moved inward by b is closer to S_min by b, but may be as close to S_max as before:
//!
//! ```text
//!    S_max ╲   ╱ S_max       Where two spheres meet, a point b deep inside their union is less deep in each.
//!           ╲ ╱
//!    moved ──×── inward by b
//! ```
//!
//! The tolerance of half a voxel is the interpolation error within a cell: the bounds hold at voxels, and a
//! sphere is curved between them.

mod containment;
mod distances;
mod mesh_cells;
mod surfaces;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

pub use containment::{
    MovedParticle, count_inputs_outside, count_inputs_outside_of_source, possibly_outside,
};
pub use distances::BoundViolation;
pub use mesh_cells::MeshCells;

use crate::level_set::NarrowBand;
use crate::mesh::{Mesh, MeshMeasures};
use crate::parallel::Loops as _;
use crate::particles::LONE_RADIUS;
use crate::rasterize::{ParticleBins, Radii, Start};
use crate::space::{CoordBox, Lattice};
use crate::words::pluralize;

/// The results of the checks of the finished surface. [`holds`](Self::holds) says whether it passed all of
/// them, and [`violations`](Self::violations) which ones failed. Distances are to the centre of the nearest
/// particle, in voxels unless a field says world units. For particles with their own shapes, r_min and r_max
/// mean their inner and outer ellipsoids.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct Certificate {
    /// Voxels where φ violates its bounds (Eq. 6), before the surface is offset. Always 0.
    pub bound_violation_count: usize,
    /// Number of dropped particles, as in `Report::dropped_count`: not finite, or too far from the others.
    pub particles_left_out: usize,
    /// Smallest distance from a mesh vertex to a particle; infinite for an empty mesh.
    pub vertex_distance_min: f64,
    /// Largest distance from a mesh vertex to its nearest particle; 0 for an empty mesh.
    pub vertex_distance_max: f64,
    /// How far the surface was moved outward after its bounds were checked, world units; negative values mean
    /// inward.
    pub offset: f64,
    /// The smallest and the largest allowed distance from a vertex to its nearest particle, world units:
    /// r_min and r_max plus the offset. `None` for surfaces of level sets.
    pub distance_limits: Option<[f64; 2]>,
    /// Mesh vertices closer to a particle than the first limit by more than h/2.
    pub vertices_inside_min: usize,
    /// Mesh vertices farther from all particles than the second limit by more than h/2.
    pub vertices_outside_max: usize,
    /// Particles outside the mesh, except exempt ones.
    pub particles_outside: ParticlesOutside,
    /// Whether the inward offset is so large that particles may end up outside: these are counted, but
    /// fail no check.
    pub may_leave_particles_outside: bool,
    /// If position smoothing moved the particles before they were checked: the particles whose input position
    /// is outside the surface. They fail no check. `None` if particles were not moved.
    pub input_positions_outside: Option<ParticlesOutside>,
    /// Exempt particles: in a dropped island, outside a clip box or next to its faces, inside an obstacle or
    /// next to it. Only those near a surface are counted.
    pub particles_exempt: usize,
    /// Whether every edge is in two triangles, the triangles around every vertex form one ring, and no
    /// triangle is degenerate.
    pub mesh_is_closed_manifold: bool,
    /// Rounding error of 32-bit positions, in voxels: large only if part of a frame is tens of thousands of
    /// voxels from the rest, or from the world origin if a file has world positions.
    pub position_rounding: f64,
}

impl Certificate {
    /// Whether the surface passed all checks.
    pub fn holds(&self) -> bool {
        self.bound_violation_count == 0
            && self.vertices_inside_min == 0
            && self.vertices_outside_max == 0
            && self.particle_violation_count() == 0
            && self.mesh_is_closed_manifold
    }

    /// Number of particles outside that fail the check.
    pub fn particle_violation_count(&self) -> usize {
        if self.may_leave_particles_outside { 0 } else { self.particles_outside.count }
    }

    /// The failed checks as text; empty if the surface passed all.
    pub fn violations(&self) -> String {
        let mut faults = Vec::new();
        if self.bound_violation_count > 0 {
            faults.push(format!(
                "the level set is outside its bounds at {}",
                pluralize(self.bound_violation_count, "voxel")
            ));
        }
        let counts = [
            (self.vertices_inside_min, "vertex", "too near to particles"),
            (self.vertices_outside_max, "vertex", "too far from particles"),
            (self.particle_violation_count(), "particle", "outside"),
        ];
        let counts = counts.into_iter().filter(|&(count, ..)| count > 0);
        faults.extend(counts.map(|(count, noun, what)| format!("{} {what}", pluralize(count, noun))));
        if !self.mesh_is_closed_manifold {
            faults.push("the mesh is not a closed 2-manifold".to_owned());
        }
        faults.join(", ")
    }
}

/// The number of particles outside a surface, and how far.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct ParticlesOutside {
    /// Number of particles.
    pub count: usize,
    /// Distance from the surface of the particle that is farthest outside, world units; 0 if all are inside.
    /// The distance comes from φ, which is limited to the half width of its band: five voxels or more.
    pub deepest: f64,
}

/// Regions of a result that are not checked because they were removed on purpose.
pub trait ExclusionMask: Sync {
    /// Whether nothing is excluded, so that everything is checked.
    fn is_empty(&self) -> bool;

    /// Whether a particle, in voxels relative to the origin of its leaf, may be outside.
    fn particle(&self, leaf_origin: IVec3, local: Vec3) -> bool;

    /// Whether a vertex, in voxels, may violate the distance limits.
    fn vertex(&self, index: DVec3) -> bool;
}

/// Checks everything.
#[derive(Clone, Copy, Debug)]
pub struct NoExclusions;

impl ExclusionMask for NoExclusions {
    fn is_empty(&self) -> bool {
        true
    }

    fn particle(&self, _: IVec3, _: Vec3) -> bool {
        false
    }

    fn vertex(&self, _: DVec3) -> bool {
        false
    }
}

/// The results of these checks as a certificate. `radii` are those of the particles, and `None` for surfaces of
/// level sets.
pub fn certificate(
    checks: &ParticleChecks,
    radii: Option<&Radii>,
    measures: &MeshMeasures,
    voxel_size: f64,
) -> Certificate {
    let distance_limits = radii.map(|radii| DistanceLimits::new(radii).limits());
    Certificate {
        mesh_is_closed_manifold: measures.is_closed_manifold(),
        vertex_distance_min: f64::from(checks.vertex_distance_min),
        vertex_distance_max: f64::from(checks.vertex_distance_max),
        distance_limits: distance_limits.map(|limits| limits.map(|limit| f64::from(limit) * voxel_size)),
        vertices_inside_min: checks.vertices_inside_min,
        vertices_outside_max: checks.vertices_outside_max,
        particles_outside: ParticlesOutside {
            count: checks.particles_outside,
            deepest: f64::from(checks.deepest_outside) * voxel_size,
        },
        may_leave_particles_outside: radii.is_some_and(may_leave_particles_outside),
        particles_exempt: checks.particles_exempt,
        ..Certificate::default()
    }
}

/// Whether the inward offset is so large that a particle may end up outside: the corners of the cell that
/// contains the particle need not all be inside. With kernels, that of a lone particle.
fn may_leave_particles_outside(radii: &Radii) -> bool {
    let depth = match radii.start {
        Start::Spheres => radii.depth_min(),
        Start::Kernels => LONE_RADIUS * radii.max + radii.offset,
    };
    radii.offset < 0.0 && depth <= SURE_DEPTH
}

/// A ball of this radius, in voxels, contains all corners of the cell around its centre: √3. In a smaller
/// ball a corner of the cell may be outside.
const SURE_DEPTH: f32 = 1.732_051;

/// The limits of the distance between a vertex and the particles.
#[derive(Clone, Copy, Debug, PartialEq)]
struct DistanceLimits {
    /// The radii of the inner and the outer spheres, in voxels: the units of semi-axes.
    radii: [f32; 2],
    /// The smallest offset from the inner spheres and the largest from the outer ones, outward, in voxels.
    from_spheres: [f32; 2],
    /// Whether the inner spheres are equal balls, whatever shapes the particles have.
    has_balls: bool,
}

impl DistanceLimits {
    fn new(radii: &Radii) -> DistanceLimits {
        DistanceLimits {
            radii: [radii.min, radii.max],
            from_spheres: [radii.offset, radii.outward()],
            has_balls: radii.start == Start::Kernels,
        }
    }

    /// The limits that the shapes of particles set.
    fn of_shapes(self) -> DistanceLimits {
        if !self.has_balls {
            return self;
        }
        let [[_, max], [_, from_max]] = [self.radii, self.from_spheres];
        DistanceLimits { radii: [0.0, max], from_spheres: [f32::NEG_INFINITY, from_max], ..self }
    }

    /// The distance limits from particle centres, if all semi-axes are 1.
    fn limits(&self) -> [f32; 2] {
        let [min, max] = self.radii;
        let [from_min, from_max] = self.from_spheres;
        [(min + from_min).max(0.0), max + from_max]
    }

    /// The same limits, relaxed by `margin` voxels.
    fn with_margin(self, margin: f32) -> DistanceLimits {
        let [from_min, from_max] = self.from_spheres;
        DistanceLimits { from_spheres: [from_min - margin, from_max + margin], ..self }
    }
}

// Checks particles and surface against each other, leaf by leaf.
//
//   part A ──▶ checks ─┐
//   part B ──▶ checks ─┼─ and ─▶ checks of the whole
//   part C ──▶ checks ─┘
//
// A vertex belongs to the leaf that it lies in, a particle to the leaf of its bin. So a frame can be checked
// in parts, each with the particles in and around it, and every vertex and particle is counted once.

/// A part of a frame: the leaves whose origins are in a box.
#[derive(Clone, Copy)]
pub struct CheckedRegion<'a> {
    /// The particles in these leaves, and around them up to a distance of r_max, plus an outward offset, plus
    /// two voxels. Particles so deep inside that no voxel near them is stored may be missing.
    pub bins: &'a ParticleBins,
    /// The radii and the offset in voxels.
    pub radii: Radii,
    /// The contoured band, in these leaves and their neighbours.
    pub band: &'a NarrowBand,
    /// The mesh; its vertices in these leaves are checked.
    pub mesh: &'a Mesh,
    /// The cells that the mesh passes through.
    pub cells: &'a MeshCells,
    /// How far rounding may move a vertex, in voxels. Vertices are moved farther into their bounds by this.
    pub rounding_voxels: f32,
    /// Converts the mesh's positions to voxels.
    pub lattice: &'a Lattice,
    /// The voxels whose leaves are checked.
    pub owned: CoordBox,
    /// The regions that are not checked.
    pub exempt: &'a dyn ExclusionMask,
}

/// The checks of vertices and particles. Distances are in voxels, to the centre of the nearest particle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParticleChecks {
    /// Smallest distance from a vertex to a particle; infinite without vertices.
    pub vertex_distance_min: f32,
    /// Largest distance from a vertex to its nearest particle; 0 without vertices.
    pub vertex_distance_max: f32,
    /// Vertices closer to a particle than r_min + offset − h/2.
    pub vertices_inside_min: usize,
    /// Vertices farther from all particles than r_max + h/2, plus an outward offset.
    pub vertices_outside_max: usize,
    /// Particles outside the mesh, except exempt ones.
    pub particles_outside: usize,
    /// Distance of the farthest of these particles from the surface, in voxels, according to φ; 0 if all are
    /// inside.
    pub deepest_outside: f32,
    /// Number of exempt particles.
    pub particles_exempt: usize,
}

impl ParticleChecks {
    /// The checks of an empty part.
    pub const EMPTY: ParticleChecks = ParticleChecks {
        vertex_distance_min: f32::INFINITY,
        vertex_distance_max: 0.0,
        vertices_inside_min: 0,
        vertices_outside_max: 0,
        particles_outside: 0,
        deepest_outside: 0.0,
        particles_exempt: 0,
    };

    /// The combined checks of two parts without common leaves.
    pub fn merge(self, other: ParticleChecks) -> ParticleChecks {
        ParticleChecks {
            vertex_distance_min: self.vertex_distance_min.min(other.vertex_distance_min),
            vertex_distance_max: self.vertex_distance_max.max(other.vertex_distance_max),
            vertices_inside_min: self.vertices_inside_min + other.vertices_inside_min,
            vertices_outside_max: self.vertices_outside_max + other.vertices_outside_max,
            particles_outside: self.particles_outside + other.particles_outside,
            deepest_outside: self.deepest_outside.max(other.deepest_outside),
            particles_exempt: self.particles_exempt + other.particles_exempt,
        }
    }
}

/// The checks of a part of a frame, and the vertices to move.
#[derive(Debug)]
pub struct Checks {
    /// The checks of vertices and particles.
    pub particles: ParticleChecks,
    /// A corrected position for each vertex that is out of bounds, if the correction steps reach one within
    /// one voxel of the vertex.
    pub violations: Vec<BoundViolation>,
}

impl Checks {
    /// The checks of an empty part.
    pub const EMPTY: Checks = Checks { particles: ParticleChecks::EMPTY, violations: Vec::new() };

    /// The combined checks of two parts without common leaves.
    pub fn merge(mut self, other: Checks) -> Checks {
        self.violations.extend(other.violations);
        Checks { particles: self.particles.merge(other.particles), ..self }
    }
}

/// Checks a part of a frame.
pub fn check(part: &CheckedRegion) -> Checks {
    let (vertices, violations) = distances::check_vertices(part);
    let (outside, particles_exempt) = containment::particles_outside(part);
    let depth = |&(origin, local): &(IVec3, Vec3)| containment::depth_outside(part.band, origin, local);
    let deepest_outside = outside.par_iter().halved().map(depth).reduce(|| 0.0, f32::max);
    let particles =
        ParticleChecks { particles_outside: outside.len(), deepest_outside, particles_exempt, ..vertices };
    Checks { particles, violations }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contour::{Contouring, contour};
    use crate::particles::{Ellipsoid, OwnedPositions, ParticleCloud, Shapes};
    use crate::rasterize::{RasterFields, RasterParams, rasterize};

    /// Particles in a wavy sheet, and a few beside it.
    fn particles(spacing: f64) -> OwnedPositions {
        let position = |index: usize| {
            let (x, y, z) = (index / 60, index / 3 % 20, index % 3);
            [x as f64 * spacing, y as f64 * spacing, z as f64 * spacing + 3.0 * (x as f64 * 0.4).sin()]
        };
        OwnedPositions::F64((0..1800).map(position).chain([[-9.0, -9.0, 30.0], [70.0, 7.0, -20.0]]).collect())
    }

    #[test]
    fn merged_parts_equal_the_whole_frame() {
        let lattice = Lattice { voxel_size: 1.0 };
        let made = Radii::uniform(1.7, 2.6, 3.4);
        let Ok(RasterFields { bins, band, .. }) =
            rasterize(&particles(1.9), &RasterParams::open(lattice, made));
        let mesh = contour(&band, &lattice, Contouring::Dual);
        // The surface of these particles passes; with other particles or radii, every check fails.
        let Ok(RasterFields { bins: others, .. }) =
            rasterize(&particles(2.3), &RasterParams::open(lattice, made));
        let other_radii = Radii::uniform(3.0, 1.0, 2.2);
        for (bins, radii, holds) in [(&bins, made, true), (&others, other_radii, false)] {
            let cells = &MeshCells::new(&mesh, &band, &lattice);
            let part = |owned: CoordBox| -> ParticleChecks {
                let (exempt, mesh, lattice) = (&NoExclusions, &mesh, &lattice);
                check(&CheckedRegion {
                    bins,
                    radii,
                    band: &band,
                    mesh,
                    cells,
                    rounding_voxels: 0.0,
                    lattice,
                    owned,
                    exempt,
                })
                .particles
            };
            let whole = part(CoordBox::ALL);
            let counts = [whole.vertices_inside_min, whole.vertices_outside_max, whole.particles_outside];
            assert_eq!(counts.map(|count| count == 0), [holds; 3], "{whole:?}");
            let (low, high) = (IVec3::MIN, IVec3::MAX);
            let parts = [
                CoordBox { min: low, max: IVec3::new(15, i32::MAX, i32::MAX) },
                CoordBox { min: IVec3::new(16, i32::MIN, i32::MIN), max: IVec3::new(i32::MAX, 7, i32::MAX) },
                CoordBox { min: IVec3::new(16, 8, i32::MIN), max: high },
            ];
            let checks = parts.map(part);
            assert!(checks.iter().all(|checks| checks.vertex_distance_max > 0.0));
            assert_eq!(checks.into_iter().fold(ParticleChecks::EMPTY, ParticleChecks::merge), whole);
        }
    }

    /// However low the sum of kernels is, particles are inside, and the mesh is closed.
    #[test]
    fn particles_with_hardly_any_weight_are_inside() {
        let radii =
            Radii { start: Start::Kernels, room: 1.4, min_scale: 0.4, ..Radii::uniform(1.0, 3.2, 5.3) };
        for (spacing, weight) in [(3.1, 0.01), (3.1, 0.06), (3.1, 0.2), (2.3, 0.05), (6.0, 0.5)] {
            let at =
                |index: usize| [index % 14, index / 14 % 14, index / 196].map(|along| spacing * along as f64);
            let positions = OwnedPositions::F64((0..14 * 14 * 14).map(at).collect());
            let shape = Ellipsoid { weight, ..Ellipsoid::ball(1.0) };
            let shapes = Shapes::Ellipsoids(vec![shape; positions.len()]);
            let cloud = ParticleCloud { shapes, ..ParticleCloud::from(positions) };
            let lattice = Lattice { voxel_size: 1.0 };
            let Ok(RasterFields { bins, band, .. }) = rasterize(&cloud, &RasterParams::open(lattice, radii));
            let mesh = &contour(&band, &lattice, Contouring::Dual);
            assert!(
                mesh.triangles.len() > 1000 && mesh.measure().is_closed_manifold(),
                "{spacing}, {weight}"
            );
            let cells = &MeshCells::new(mesh, &band, &lattice);
            let (owned, exempt, lattice, band) = (CoordBox::ALL, &NoExclusions, &lattice, &band);
            let rounding_voxels = 0.0;
            let part = CheckedRegion {
                bins: &bins,
                radii,
                band,
                mesh,
                cells,
                rounding_voxels,
                lattice,
                owned,
                exempt,
            };
            let checks = check(&part).particles;
            assert_eq!(checks.particles_outside, 0, "{spacing}, {weight}: {checks:?}");
        }
    }

    /// Deep inside a body φ is not stored, and small particles do not reach the corners of their cells. The
    /// large particles show that the small ones are inside, although some of the large ones were left out.
    #[test]
    fn small_particles_deep_in_a_body_are_inside() {
        let along = |index: usize| 2.0 * index as f64 - 64.0;
        let indices = (0..65).flat_map(|x| (0..65).flat_map(move |y| (0..65).map(move |z| [x, y, z])));
        let position = |[x, y, z]: [usize; 3]| {
            let shift = |salt: usize| ((x * 7 + y * 13 + z * 29 + salt * 5) % 11) as f64 / 11.0 - 0.5;
            [along(x) + shift(0), along(y) + shift(1), along(z) + shift(2)]
        };
        let length = |[x, y, z]: [f64; 3]| (x * x + y * y + z * z).sqrt();
        let positions: Vec<[f64; 3]> =
            indices.map(position).filter(|&position| length(position) < 64.0).collect();
        // Particles in the upper quarter of every leaf are small, if they are deep inside.
        let scale = |position: &[f64; 3]| {
            if position[2].rem_euclid(8.0) > 6.0 && length(*position) < 52.0 { 0.3 } else { 1.0 }
        };
        let shapes = Shapes::Scaled(positions.iter().map(scale).collect());
        let cloud = ParticleCloud { shapes, ..ParticleCloud::from(OwnedPositions::F64(positions)) };
        let lattice = Lattice { voxel_size: 1.0 };
        let radii = Radii { min_scale: 0.3, ..Radii::uniform(3.0, 4.0, 5.0) };
        let Ok(RasterFields { bins, band, .. }) = rasterize(&cloud, &RasterParams::open(lattice, radii));
        assert!(bins.len() < bins.particle_count, "none was left out");
        let has_small = |leaf: usize| bins.range(leaf).any(|index| bins.shapes.inner_radius(index) < 0.5);
        let mut leaves = bins.topology.origins().iter().enumerate();
        assert!(leaves.any(|(leaf, &origin)| bins.is_deep(origin) && has_small(leaf)));
        let mesh = &contour(&band, &lattice, Contouring::Dual);
        let cells = &MeshCells::new(mesh, &band, &lattice);
        let (owned, exempt, lattice) = (CoordBox::ALL, &NoExclusions, &lattice);
        let part = CheckedRegion {
            bins: &bins,
            radii,
            band: &band,
            mesh,
            cells,
            rounding_voxels: 0.0,
            lattice,
            owned,
            exempt,
        };
        assert_eq!(check(&part).particles.particles_outside, 0);
    }
}
