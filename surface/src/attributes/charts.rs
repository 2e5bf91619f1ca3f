//! Texture coordinates at vertices: those of one chart at a time, because a mean of two charts is a place in the picture
//! that belongs to neither.
//!
//! ```text
//!      a a a ┊ b b b      The charts are not known, so they follow from jumps: two particles near each other belong to one
//!      a a a ┊ b b b      chart if each coordinate differs by at most JUMP times as much as it usually does between
//!      a a ╱─┼─╲ b b      particles at this distance, around both of them.
//!      ───○──┼──○────     A vertex has the chart of the particle nearest to it. A triangle has one chart: that of the
//!         └─ ┊ ─┘         nearest of its vertices' particles. Vertices with another chart get a second value for its
//!            ┊            corner, from the particles of its chart only.
//! ```
//!
//! Values are those of a linear function that fits the coordinates of a chart's particles within the radius, as for rest
//! coordinates: a mean would be too far from a seam, because it has particles on one side of it only.

use glam::DVec3;
use rayon::prelude::*;

use super::interpolate::{Interpolated, near_particles};
use super::rest::{WaySums, visit_near};
use super::{CHUNK, NO_PARTICLE, TransferSource, numbers_of, subset};
use crate::cancel::checkpoint;
use crate::mesh::Mesh;
use crate::neighbors::Neighbors;
use crate::parallel::Loops as _;
use crate::particles::{Attribute, OwnedPositions, Role};

/// The texture coordinates of a mesh with seams, where triangles with different charts meet.
#[derive(Clone, Debug, PartialEq)]
pub struct Seams {
    /// The index of the attribute of the vertices that these coordinates belong to.
    pub attribute: usize,
    /// Two numbers per row. First one row for each vertex, with the values of the attribute, then the other rows.
    pub values: Vec<[f32; 2]>,
    /// The rows of the corners of each triangle: the index of its vertex, or one of the other rows.
    pub triangles: Vec<[u32; 3]>,
}

impl Seams {
    /// Memory used, in bytes.
    pub fn size_bytes(&self) -> usize {
        size_of_val(&*self.values) + size_of_val(&*self.triangles)
    }
}

/// How much more than usual a coordinate of particles of one chart may differ. That of a linear function differs by 2.5
/// times as much as it [usually](USUAL) does between particles along its gradient.
const JUMP: f32 = 4.5;

/// The usual difference is that of this fraction of the particles around a particle. It is below one half, because almost
/// half of the particles around one at a seam belong to another chart.
const USUAL: f64 = 0.4;

/// The fraction of the particles around a particle whose usual difference is at most that which counts.
const CLEAN: f64 = 0.25;

/// With fewer particles around a particle, its usual difference is unknown, and taken as zero.
const KNOWN_MIN: usize = 4;

/// The most particles around a point that are looked at: the nearest. More are there only if they nearly coincide.
const AROUND_MAX: usize = 256;

/// Coordinates that differ by less are the same.
const SAME: f32 = 1e-5;

/// A difference that is never a jump: a texel of a large texture.
const TEXEL: f32 = 1.0 / 4096.0;

/// Whether the coordinates of this attribute are on charts.
pub(crate) fn has_charts(attribute: &Attribute) -> bool {
    attribute.role == Role::TextureCoordinates && attribute.arity == 2 && numbers_of(attribute).is_some()
}

/// Replaces the means of the first attribute with texture coordinates; `None` without seams. A vertex without particles
/// within the radius keeps what it has.
pub(super) fn fit_charts(
    source: &TransferSource,
    interpolated: &mut Interpolated,
    mesh: &Mesh,
    point_of: &(impl Fn(usize) -> DVec3 + Sync),
) -> Option<Seams> {
    let attribute = source.attributes.iter().position(|attribute| has_charts(attribute))?;
    let is_number = |attribute: &&&Attribute| numbers_of(attribute).is_some();
    let number = source.attributes[..attribute].iter().filter(is_number).count();
    let count = interpolated.nearest.len();
    let particles =
        ChartParticles::new(source, source.numbers[number].values.as_chunks().0, (count, point_of));
    let values = interpolated.numbers[number].as_chunks_mut::<2>().0;
    let mut own = vec![OwnChart::default(); count];
    values.par_chunks_mut(CHUNK).zip(own.par_chunks_mut(CHUNK)).enumerate().halved().for_each_init(
        Vec::new,
        |around, (chunk, (values, own))| {
            checkpoint();
            for (offset, (value, own)) in values.iter_mut().zip(own).enumerate() {
                let charts = particles.charts_at(point_of(chunk * CHUNK + offset), around);
                if let Some(first) = charts.first() {
                    *value = first.value;
                    *own = OwnChart { particle: first.members[0], is_alone: charts.len() == 1 };
                }
            }
        },
    );
    VertexCharts { particles, own }.seams(mesh, point_of, values, attribute)
}

/// The particles near the vertices.
struct ChartParticles {
    neighbors: Neighbors,
    positions: OwnedPositions,
    coordinates: Vec<[f32; 2]>,
    /// How much the coordinates usually change around each particle, per world unit.
    slopes: Vec<[f32; 2]>,
}

impl ChartParticles {
    fn new(
        source: &TransferSource,
        coordinates: &[[f32; 2]],
        points: (usize, &(impl Fn(usize) -> DVec3 + Sync)),
    ) -> ChartParticles {
        let radius = source.support.radius_world;
        // The slope of a particle depends on those around it.
        let positions = source.unsmoothed();
        let indices = near_particles(&positions, 2.0 * radius, points);
        let positions = subset(&positions, &indices);
        let coordinates: Vec<[f32; 2]> = indices.iter().map(|&index| coordinates[index as usize]).collect();
        let neighbors = Neighbors::new(&positions, radius);
        let mut particles = ChartParticles { neighbors, positions, coordinates, slopes: Vec::new() };
        let all = || (0..particles.coordinates.len()).into_par_iter().halved();
        let own: Vec<[f32; 2]> =
            all().map_init(Default::default, |ratios, index| particles.slopes_at(index, ratios)).collect();
        particles.slopes = all()
            .map_init(Default::default, |near, index| particles.clean_slopes_at(index, &own, near))
            .collect();
        particles
    }

    fn slopes_at(&self, index: usize, changes: &mut [CoordinateChanges; 2]) -> [f32; 2] {
        changes.iter_mut().for_each(CoordinateChanges::clear);
        visit_near(&self.neighbors, &self.positions, self.positions.position(index), |other, _, offset| {
            let apart = (offset.length() * self.neighbors.edge_world()) as f32;
            if apart > 0.0 {
                for (changes, difference) in changes.iter_mut().zip(self.differences(index, other as usize)) {
                    changes.push(difference, apart);
                }
            }
        });
        changes.each_mut().map(CoordinateChanges::usual)
    }

    /// The lower quartile of these slopes around a particle: where charts are mixed, some particles near by are not.
    fn clean_slopes_at(&self, index: usize, own: &[[f32; 2]], near: &mut [Vec<f32>; 2]) -> [f32; 2] {
        near.iter_mut().for_each(Vec::clear);
        visit_near(&self.neighbors, &self.positions, self.positions.position(index), |other, _, _| {
            for (near, slope) in near.iter_mut().zip(own[other as usize]) {
                near.push(slope);
            }
        });
        near.each_mut().map(|near| part_of(near, CLEAN))
    }

    fn differences(&self, one: usize, other: usize) -> [f32; 2] {
        let (one, other) = (self.coordinates[one], self.coordinates[other]);
        std::array::from_fn(|along| (one[along] - other[along]).abs())
    }

    /// Whether two particles near each other belong to one chart.
    fn are_together(&self, one: u32, other: u32) -> bool {
        let (one, other) = (one as usize, other as usize);
        let apart = self.positions.position(one).distance(self.positions.position(other)) as f32;
        let differences = self.differences(one, other);
        (0..2).all(|along| {
            let usual = self.slopes[one][along].min(self.slopes[other][along]) * apart;
            differences[along] <= (JUMP * usual).max(TEXEL)
        })
    }

    /// The charts at a point: first that of the particle nearest to it, which is the first of its members. Empty without
    /// particles within the radius.
    fn charts_at(&self, point: DVec3, around: &mut Vec<ParticleNear>) -> Vec<Chart> {
        around.clear();
        visit_near(&self.neighbors, &self.positions, point, |particle, weight, offset| {
            if self.coordinates[particle as usize].iter().all(|along| along.is_finite()) {
                around.push(ParticleNear {
                    distance_squared: offset.length_squared(),
                    particle,
                    weight,
                    offset,
                });
            }
        });
        around.sort_unstable_by(|one, other| {
            one.distance_squared.total_cmp(&other.distance_squared).then(one.particle.cmp(&other.particle))
        });
        let mut charts = Vec::new();
        around.truncate(AROUND_MAX);
        while !around.is_empty() {
            charts.push(self.take_chart(around));
        }
        charts
    }

    /// Takes the first particle, and all that are linked to it through others.
    fn take_chart(&self, around: &mut Vec<ParticleNear>) -> Chart {
        let mut found = vec![around.remove(0)];
        let mut next = 0;
        while let Some(from) = found.get(next).map(|near| near.particle) {
            found.extend(around.extract_if(.., |near| self.are_together(from, near.particle)));
            next += 1;
        }
        let mut sums = WaySums::NONE;
        for near in &found {
            let [u, v] = self.coordinates[near.particle as usize].map(f64::from);
            sums.add(near.weight, near.offset, DVec3::new(u, v, 0.0));
        }
        let first = self.coordinates[found[0].particle as usize];
        let value = sums.at_point().map_or(first, |at| [at.x as f32, at.y as f32]);
        Chart { value, members: found.iter().map(|near| near.particle).collect() }
    }
}

/// How much a coordinate changes from one particle to those around it.
#[derive(Default)]
struct CoordinateChanges {
    /// How many have the same coordinate.
    same_count: usize,
    /// The changes per world unit of the others.
    slopes: Vec<f32>,
    least: f32,
    greatest: f32,
}

impl CoordinateChanges {
    fn clear(&mut self) {
        self.slopes.clear();
        (self.same_count, self.least, self.greatest) = (0, f32::INFINITY, 0.0);
    }

    fn push(&mut self, difference: f32, apart: f32) {
        if difference <= SAME {
            self.same_count += 1;
        } else if difference.is_finite() {
            self.slopes.push(difference / apart);
            (self.least, self.greatest) = (self.least.min(difference), self.greatest.max(difference));
        }
    }

    /// The [usual](USUAL) change per world unit. On a lattice, many particles have the same coordinate even if it changes
    /// along an axis; but where charts of constant coordinates meet, there is one difference only.
    fn usual(&mut self) -> f32 {
        let all = self.same_count + self.slopes.len();
        if all < KNOWN_MIN {
            return 0.0;
        }
        let place = (USUAL * all as f64) as usize;
        match place.checked_sub(self.same_count) {
            Some(place) => *self.slopes.select_nth_unstable_by(place, f32::total_cmp).1,
            None if self.greatest >= 1.5 * self.least => part_of(&mut self.slopes, USUAL),
            None => 0.0,
        }
    }
}

/// The number below which there is this fraction of the numbers; 0 without numbers.
fn part_of(numbers: &mut [f32], fraction: f64) -> f32 {
    let at = (fraction * numbers.len() as f64) as usize;
    if at < numbers.len() { *numbers.select_nth_unstable_by(at, f32::total_cmp).1 } else { 0.0 }
}

/// A particle within the radius of a point.
struct ParticleNear {
    distance_squared: f64,
    particle: u32,
    weight: f64,
    /// From the point, in units of the radius.
    offset: DVec3,
}

/// A chart at a vertex.
struct Chart {
    value: [f32; 2],
    /// Its particles within the radius.
    members: Vec<u32>,
}

/// The first chart at a vertex.
#[derive(Clone, Copy)]
struct OwnChart {
    /// The particle nearest to the vertex, or [`NO_PARTICLE`].
    particle: u32,
    /// Whether the vertex has no other chart.
    is_alone: bool,
}

impl Default for OwnChart {
    fn default() -> OwnChart {
        OwnChart { particle: NO_PARTICLE, is_alone: true }
    }
}

/// A chart at a vertex other than its first.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum OtherChart {
    /// By its index.
    Near(u32),
    /// That of a particle with which no particle within the radius shares a chart.
    Far(u32),
}

/// A corner of a triangle with another chart than the first of its vertex.
#[derive(Clone, Copy)]
struct SeamCorner {
    triangle: usize,
    /// From 0 to 2.
    corner: usize,
    /// The vertex, and the chart there.
    row: (u32, OtherChart),
    value: [f32; 2],
}

/// The charts at all vertices.
struct VertexCharts {
    particles: ChartParticles,
    own: Vec<OwnChart>,
}

impl VertexCharts {
    fn seams(
        &self,
        mesh: &Mesh,
        point_of: &(impl Fn(usize) -> DVec3 + Sync),
        values: &[[f32; 2]],
        attribute: usize,
    ) -> Option<Seams> {
        let chunks: Vec<Vec<SeamCorner>> = mesh
            .triangles
            .par_chunks(CHUNK)
            .enumerate()
            .halved()
            .map_init(Vec::new, |around, (chunk, triangles)| {
                checkpoint();
                let mut found = Vec::new();
                for (index, triangle) in (chunk * CHUNK..).zip(triangles) {
                    let Some(particle) = self.particle_of(triangle, point_of) else { continue };
                    for (corner, &vertex) in triangle.iter().enumerate() {
                        let chart = self.other_chart(vertex, particle, point_of, around);
                        found.extend(chart.map(|(chart, value)| SeamCorner {
                            triangle: index,
                            corner,
                            row: (vertex, chart),
                            value,
                        }));
                    }
                }
                found
            })
            .collect();
        let corners = chunks.concat();
        if corners.is_empty() {
            return None;
        }
        let mut others: Vec<((u32, OtherChart), [f32; 2])> =
            corners.iter().map(|found| (found.row, found.value)).collect();
        others.sort_unstable_by_key(|(row, _)| *row);
        others.dedup_by_key(|(row, _)| *row);
        // Such a mesh would need more than 100 GB.
        u32::try_from(values.len() + others.len()).ok()?;
        let mut triangles = mesh.triangles.clone();
        for SeamCorner { triangle, corner, row, .. } in corners {
            let other = others.binary_search_by_key(&row, |(row, _)| *row).unwrap_or_default();
            triangles[triangle][corner] = (values.len() + other) as u32;
        }
        let values = values.iter().copied().chain(others.into_iter().map(|(_, value)| value)).collect();
        Some(Seams { attribute, values, triangles })
    }

    /// The particle whose chart a triangle has: of those nearest to its vertices, the one nearest to its middle. `None`
    /// without a choice.
    fn particle_of(&self, triangle: &[u32; 3], point_of: &impl Fn(usize) -> DVec3) -> Option<u32> {
        let nearest = triangle.map(|vertex| self.own[vertex as usize].particle);
        if nearest.iter().all(|particle| *particle == nearest[0]) {
            return None;
        }
        let middle = triangle.iter().map(|vertex| point_of(*vertex as usize)).sum::<DVec3>() / 3.0;
        let away =
            |particle: u32| self.particles.positions.position(particle as usize).distance_squared(middle);
        let known = nearest.into_iter().filter(|particle| *particle != NO_PARTICLE);
        known.min_by(|one, other| away(*one).total_cmp(&away(*other)).then(one.cmp(other)))
    }

    /// The chart of a particle at a vertex, and its value there; `None` if it is the first, or the vertex has no particle
    /// within the radius.
    fn other_chart(
        &self,
        vertex: u32,
        particle: u32,
        point_of: &impl Fn(usize) -> DVec3,
        around: &mut Vec<ParticleNear>,
    ) -> Option<(OtherChart, [f32; 2])> {
        let own = self.own[vertex as usize];
        if [NO_PARTICLE, particle].contains(&own.particle) {
            return None;
        }
        let point = point_of(vertex as usize);
        let positions = &self.particles.positions;
        let is_near =
            positions.position(particle as usize).distance(point) < self.particles.neighbors.edge_world();
        let far = (OtherChart::Far(particle), self.particles.coordinates[particle as usize]);
        if own.is_alone {
            let is_first = is_near || self.particles.are_together(own.particle, particle);
            return (!is_first).then_some(far);
        }
        let charts = self.particles.charts_at(point, around);
        let with = charts.iter().position(|chart| chart.members.contains(&particle));
        let shares =
            |chart: &Chart| chart.members.iter().any(|near| self.particles.are_together(*near, particle));
        match with.or_else(|| charts.iter().position(shares)) {
            Some(0) => None,
            Some(index) => Some((OtherChart::Near(index as u32), charts[index].value)),
            None => Some(far),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::options::AttributeSelection;
    use crate::particles::AttributeValues;
    use crate::{Options, Reconstructor, Surface};

    const SPACING: f64 = 0.1;

    /// A ball of jittered particles and its surface, with these coordinates.
    fn surface_with(coordinates: impl Fn(DVec3) -> [f32; 2]) -> Surface {
        surface_beside(&[], 0.4, coordinates)
    }

    /// The same with other particles, which are the last, and displacements from a lattice up to half of `jitter`.
    fn surface_beside(others: &[DVec3], jitter: f64, coordinates: impl Fn(DVec3) -> [f32; 2]) -> Surface {
        let mut state = 7_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 8) / f64::from(1 << 24) - 0.5
        };
        let mut points = Vec::new();
        for cell in 0..17_i32.pow(3) {
            let cell = DVec3::new((cell % 17).into(), (cell / 17 % 17).into(), (cell / 289).into()) - 8.0;
            let point = SPACING * (cell + jitter * DVec3::new(random(), random(), random()));
            if point.length() < 0.8 {
                points.push(point);
            }
        }
        points.extend_from_slice(others);
        let values = points.iter().flat_map(|point| coordinates(*point)).collect();
        let values = AttributeValues::Numbers(values);
        let role = Role::TextureCoordinates;
        let positions = OwnedPositions::F64(points.iter().map(DVec3::to_array).collect());
        let attributes = vec![Attribute { name: "uv".to_owned(), role, arity: 2, values }];
        let options = Options {
            spacing: Some(SPACING),
            attributes: Some(AttributeSelection::All),
            ..Options::default()
        };
        Reconstructor::new(options).reconstruct_with(&positions, &attributes).expect("a surface")
    }

    /// The coordinates of the corners of each triangle, and their places.
    fn corners(surface: &Surface) -> Vec<[([f32; 2], DVec3); 3]> {
        let AttributeValues::Numbers(values) = &surface.attributes[0].values else { panic!("numbers") };
        let own: Vec<[f32; 2]> = values.as_chunks().0.to_vec();
        let (rows, places) = surface
            .seams
            .as_ref()
            .map_or((&own, &surface.triangles), |found| (&found.values, &found.triangles));
        assert_eq!(rows[..own.len()], own[..]);
        let pairs = places.iter().zip(&surface.triangles);
        pairs
            .map(|(rows_of, vertices)| {
                std::array::from_fn(|corner| {
                    let (row, vertex) = (rows_of[corner] as usize, vertices[corner] as usize);
                    assert!(row >= own.len() || row == vertex);
                    (rows[row], surface.positions[vertex])
                })
            })
            .collect()
    }

    /// Once around the z axis, from 0 to 1.
    fn around(point: DVec3) -> f64 {
        point.y.atan2(point.x) / std::f64::consts::TAU + 0.5
    }

    #[test]
    fn triangles_at_the_seam_of_a_wrapped_picture_are_on_one_side_of_it() {
        let surface = surface_with(|point| [around(point) as f32, point.z as f32]);
        let (mut at_seam, mut worst) = (0, 0.0_f64);
        for triangle in corners(&surface) {
            // The coordinates have no sense at the poles.
            if triangle.iter().any(|(_, at)| at.truncate().length() < 0.35) {
                continue;
            }
            let u = triangle.map(|([u, _], _)| f64::from(u));
            let spread =
                u.iter().copied().fold(f64::MIN, f64::max) - u.iter().copied().fold(f64::MAX, f64::min);
            assert!(spread < 0.1, "{triangle:?}");
            for ([u, v], at) in triangle {
                let apart = (f64::from(u) - around(at)).rem_euclid(1.0);
                worst = worst.max(apart.min(1.0 - apart)).max((f64::from(v) - at.z).abs());
                at_seam += usize::from((f64::from(u) - around(at)).abs() > 0.5);
            }
        }
        // Some corners have the value of the other side of the seam.
        assert!(at_seam > 20 && worst < 0.06, "{at_seam} {worst}");
    }

    #[test]
    fn a_triangle_has_one_of_two_charts() {
        let chart = |point: DVec3| if point.x < 0.02 { [0.1, 0.2] } else { [0.7, 0.3] };
        let surface = surface_with(|point| {
            let [u, v] = chart(point);
            [u + 0.05 * point.y as f32, v + 0.05 * point.z as f32]
        });
        let (mut counts, mut sum) = ([0, 0], 0.0);
        for triangle in corners(&surface) {
            let is_second = triangle.map(|([u, _], _)| u > 0.4);
            assert!(is_second.iter().all(|is| *is == is_second[0]), "{triangle:?}");
            for ([u, v], at) in triangle {
                let [first, second] = if is_second[0] { [0.7, 0.3] } else { [0.1, 0.2] };
                let apart = [f64::from(u) - first, f64::from(v) - second].map(|along| 20.0 * along);
                let error = (apart[0] - at.y).abs().max((apart[1] - at.z).abs()) / SPACING;
                assert!(error < 1.2, "{triangle:?}");
                sum += error;
                counts[usize::from(is_second[0])] += 1;
            }
            let middle = triangle.iter().map(|(_, at)| at.x).sum::<f64>() / 3.0;
            assert!((middle - 0.02).abs() < 0.1 || is_second[0] == (middle > 0.02), "{triangle:?}");
        }
        // The mean error, in particle spacings.
        let mean = sum / f64::from(counts[0] + counts[1]);
        assert!(mean < 0.05 && counts.iter().all(|count| *count > 1000), "{mean} {counts:?}");
    }

    #[test]
    fn charts_that_are_mixed_at_their_edge_are_not_averaged() {
        // The edge is a wave, and particles on both sides of it have crossed it.
        let is_second = |at: DVec3| at.x + 0.15 * (20.0 * at.y).sin() + 0.06 * (1e5 * at.z).sin() > 0.02;
        let sloped = |at: DVec3| {
            if is_second(at) { [0.7 + 0.1 * at.y as f32, 0.6] } else { [0.1, 0.2 + 0.1 * at.z as f32] }
        };
        let constant = |at: DVec3| if is_second(at) { [0.7, 0.6] } else { [0.1, 0.2] };
        for surface in [surface_with(sloped), surface_with(constant)] {
            for triangle in corners(&surface) {
                let is_second = triangle.map(|([u, v], _)| (u > 0.4, v > 0.4));
                assert!(is_second.iter().all(|is| is.0 == is.1 && *is == is_second[0]), "{triangle:?}");
            }
            assert!(surface.seams.is_some());
        }
    }

    #[test]
    fn far_particles_change_nothing() {
        let wrapped = |point: DVec3| [around(point) as f32, point.z as f32];
        let (alone, beside) = (surface_with(wrapped), surface_beside(&[DVec3::splat(7.0); 3], 0.4, wrapped));
        let [alone, beside] = [&alone, &beside].map(corners);
        assert!(beside.len() > alone.len());
        // The drop of the others comes after the ball, or before it.
        let of_ball = beside.iter().filter(|triangle| triangle[0].1.length() < 2.0);
        assert!(of_ball.eq(alone.iter()));
    }

    #[test]
    fn coincident_particles_are_bounded_work() {
        let noise = |point: DVec3| [(1e9 * point.x).sin() as f32, (1e9 * point.y).cos() as f32];
        let crowd: Vec<DVec3> =
            (0..3000).map(|index| DVec3::new(0.5, 0.5, 0.5) + 1e-6 * f64::from(index)).collect();
        assert!(!surface_beside(&crowd, 0.4, noise).triangles.is_empty());
    }

    #[test]
    fn smooth_coordinates_have_no_seams() {
        let waves = |point: DVec3| [0.5 + 0.3 * (4.0 * point.x).sin() as f32, 0.2 * point.y as f32];
        assert!(surface_with(waves).seams.is_none());
        assert!(surface_with(|_| [0.25, 0.5]).seams.is_none());
        // On a lattice, many particles around each have its coordinate.
        let along = |at: DVec3| [0.5 * at.x as f32, 2.0 * at.z as f32];
        assert!(surface_beside(&[], 0.0, along).seams.is_none());
        assert!(surface_with(|_| [f32::NAN, 0.5]).seams.is_none());
    }
}
