//! Scores of the surfaces of a set of particles. All lengths are in particle spacings.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use glam::DVec3;
use meniscus::surface::flicker::{
    Carrier, Distribution, Enclosed, FlickerFrame, carried_distances, enclosed, flicker, lag,
};
use meniscus::surface::mesh::Mesh;
use meniscus::surface::obstacle::{MeshDistance, MeshSdf};
use meniscus_formats::MeshData;
use rayon::prelude::*;
use serde_json::{Map, Value, json};

use super::heights::Rays;
use super::looks::{Facets, companies, dashes, percentile_95, waist};
use super::maker::{MadeSurface, Maker};
use super::sets::{
    FRAMES, Frame, Kind, REST_DENSITY, Set, WELD_FRAMES, WELD_PLACES, WELDS, lone_radii, pair_distances,
    weld_distance,
};
use super::{map, round};
use crate::Outcome;
use crate::flicker::Flicker;
use crate::flow::Flow;
use crate::samples::on_mesh;

/// The scores of a set, by name.
pub(super) fn score(maker: &Maker, set: &Set) -> Outcome<Map<String, Value>> {
    let mut measures = Measures::default();
    let mut of_kind = match &set.kind {
        Kind::Flow(flow) => in_flow(maker, set, *flow, &mut measures)?,
        Kind::Moving { seconds } => moving(maker, set, *seconds, &mut measures)?,
        Kind::Pool { rays } => pool(maker, set, rays, &mut measures)?,
        Kind::Still | Kind::Clusters | Kind::Pairs | Kind::Drops | Kind::Welds | Kind::Sizes => {
            still(maker, set, &mut measures)?
        }
    };
    of_kind.append(&mut match &set.kind {
        Kind::Clusters => cluster_volumes(set, &measures.volumes),
        Kind::Pairs => of_pairs(&measures),
        Kind::Drops => of_drops(&mut measures),
        Kind::Welds => of_welds(&measures),
        Kind::Sizes => of_sizes(&measures),
        _ => Map::new(),
    });
    of_kind.append(&mut measures.scores());
    Ok(of_kind)
}

/// Number of points on a mesh at which flicker is measured.
const POINTS: usize = 4000;

/// Surfaces of a flow are measured only at frames that are multiples of this number: finding the particles
/// outside takes longer than the reconstruction.
const MEASURED_EVERY: usize = 50;

/// The flicker of a flow, as in the experiment `flows`. `error` is the root mean square of the distances from the
/// surface to points of the true surface, and `bias` the mean, positive where the true surface is inside.
fn in_flow(maker: &Maker, set: &Set, flow: Flow, measures: &mut Measures) -> Outcome<Map<String, Value>> {
    let (mut carried, mut truth) = (Vec::new(), Vec::new());
    let mut errors: Vec<f64> = Vec::new();
    let mut flicker = Flicker::default();
    let time = |number: usize| flow.period() * number as f64 / FRAMES as f64;
    let mut before = 0;
    for frame in &set.frames {
        for number in before..frame.number {
            flow.carry(&mut carried, time(number), time(number + 1));
            flow.carry(&mut truth, time(number), time(number + 1));
        }
        before = frame.number;
        let made = maker.make(set, frame)?;
        if frame.number == 0 {
            carried = on_mesh(&made.mesh, POINTS);
            truth = carried.iter().map(|point| flow.nearest(*point)).collect();
        }
        errors.extend(truth.iter().filter_map(|point| Some(-made.solid.distance(*point)? / set.spacing)));
        flicker.add(frame.number, &made.solid, &carried)?;
        measures.add_costs(&made);
        if frame.number.is_multiple_of(MEASURED_EVERY) {
            measures.add_shape(&made, frame, set.spacing);
        }
    }
    let score = flicker.score(set.spacing)?;
    Ok(map(json!({
        "flicker": round(score.rms), "median": round(score.median), "most": round(score.most),
        "max": round(score.max), "worst_part": round(score.worst),
        "error": round(Distribution::of(errors.iter().copied()).rms), "bias": round(mean(&errors)),
    })))
}

/// The flicker of a simulation, from the motion of its particles: see docs/flicker.md. `first` and `lag2` are
/// the root mean squares of the distances of points that particles carry to the next frame, and to the one
/// after it, from the surface there. Errors are standard errors over the frames. `ghosts` are counted in all frames;
/// the volume step is the largest change of the volume from frame to frame, relative to it. The `waist` is the mean
/// over the frames, and so is `volume_of_fluid`, the volume relative to that of the fluid.
fn moving(maker: &Maker, set: &Set, seconds: f64, measures: &mut Measures) -> Outcome<Map<String, Value>> {
    let (mut frames, mut unaveraged) = (Vec::new(), Vec::new());
    let (mut waists, mut of_fluid) = (Vec::new(), Vec::new());
    for frame in &set.frames {
        let made = maker.make(set, frame)?;
        measures.add_costs(&made);
        measures.add_shape(&made, frame, set.spacing);
        waists.extend(waist(&frame.points, set.spacing, &made.solid));
        let volume_of_last = measures.volumes[measures.volumes.len() - 1];
        of_fluid.extend(volume_per_particle(frame, set.spacing).map(|fluid| volume_of_last / fluid));
        unaveraged.push(made.unaveraged.map(|mesh| MeshDistance::new(&mesh.positions, &mesh.triangles)));
        let surface = MeshDistance::new(&made.mesh.positions, &made.mesh.triangles);
        frames.push(FlickerFrame::new(frame.moving_particles(), surface, set.spacing));
    }
    let has_ids = frames.iter().all(|frame| frame.has(Carrier::Ids));
    let carrier = if has_ids { Carrier::Ids } else { Carrier::Velocities { seconds } };
    let second_differences = |three: &[FlickerFrame]| match three {
        [before, middle, after] => {
            let found = flicker([before, middle, after], carrier, set.spacing, POINTS).points;
            found.iter().map(|point| point.value).collect()
        }
        _ => Vec::new(),
    };
    let flickers: Vec<Vec<f64>> = frames.windows(3).map(second_differences).collect();
    let distances = |lag: u32| -> Vec<Vec<f64>> {
        let pairs = frames.iter().zip(frames.iter().skip(lag as usize));
        let carrier = carrier.over(lag);
        let found = pairs.map(|(from, to)| carried_distances(from, to, carrier, set.spacing, POINTS));
        found.map(|found| found.into_iter().flatten().collect()).collect()
    };
    let [first, lag2] = [1, 2].map(|lag| with_error(&distances(lag)));
    let flicker = with_error(&flickers);
    let score = Distribution::of(flickers.into_iter().flatten());
    let pairs = frames.iter().zip(frames.iter().skip(1)).zip(&unaveraged);
    let of_pair = |((from, to), own): ((&FlickerFrame, &FlickerFrame), &Option<MeshDistance>)| {
        lag(from, to, own.as_ref()?, carrier, set.spacing, POINTS)
    };
    let lags: Vec<f64> = pairs.filter_map(of_pair).collect();
    let enclosed: Vec<Enclosed> = frames.iter().map(|frame| enclosed(frame, set.spacing)).collect();
    let step = |two: &[Enclosed]| (two[1].volume / two[0].volume - 1.0).abs();
    Ok(map(json!({
        "ghosts": enclosed.iter().map(|enclosed| enclosed.ghost_count).sum::<usize>(),
        "volume_step": round(enclosed.windows(2).map(step).fold(0.0, f64::max)),
        "lag": (!lags.is_empty()).then(|| round(mean(&lags))),
        "waist": (!waists.is_empty()).then(|| round(mean(&waists))),
        "volume_of_fluid": (!of_fluid.is_empty()).then(|| round(mean(&of_fluid))),
        "flicker": flicker[0], "flicker_error": flicker[1], "median": round(score.median),
        "most": round(score.percentile_99), "max": round(score.max),
        "first": first[0], "first_error": first[1], "lag2": lag2[0], "lag2_error": lag2[1],
        "volume_jitter": round(volume_jitter(&measures.volumes)),
    })))
}

/// The volume of fluid for each particle, in d³: the mean over the particles in full company of the density at rest
/// over the density there. A stream that falls faster and faster has its particles farther apart than they are at
/// rest. Particles at its surface are as far apart, but their densities count the air around them. `None` without
/// densities.
fn volume_per_particle(frame: &Frame, spacing: f64) -> Option<f64> {
    let companies = companies(&frame.points, spacing);
    let of_particles = frame.densities.as_ref()?.iter().zip(companies);
    let inside = of_particles.filter(|(_, company)| *company == 1.0);
    let volumes: Vec<f64> = inside.map(|(density, _)| REST_DENSITY / f64::from(*density)).collect();
    (!volumes.is_empty()).then(|| mean(&volumes))
}

/// The root mean square of the values of several frames, and its standard error, if the frames' mean squares
/// are independent.
fn with_error(frames: &[Vec<f64>]) -> [f64; 2] {
    let squares: Vec<f64> =
        frames.iter().map(|values| Distribution::of(values.iter().copied()).rms.powi(2)).collect();
    let rms = mean(&squares).sqrt();
    [rms, deviation(&squares) / (squares.len() as f64).sqrt() / (2.0 * rms)].map(round)
}

/// The root mean square of the second differences of the volume over time, relative to the mean volume.
fn volume_jitter(volumes: &[f64]) -> f64 {
    let differences = volumes.windows(3).map(|three| three[0] - 2.0 * three[1] + three[2]);
    Distribution::of(differences).rms / mean(volumes)
}

/// The mean volume of clusters of each number of particles, relative to N d³.
fn cluster_volumes(set: &Set, volumes: &[f64]) -> Map<String, Value> {
    let mut of_count: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
    for (frame, volume) in set.frames.iter().zip(volumes) {
        of_count.entry(frame.points.len()).or_default().push(*volume);
    }
    let means: Map<String, Value> =
        of_count.iter().map(|(count, volumes)| (count.to_string(), round(mean(volumes)).into())).collect();
    map(json!({ "clusters": means }))
}

/// The largest distance at which two particles have one surface, and the largest change of its volume in a
/// step, in d³: the largest of all pairs. And the mean volume of pairs that are d apart, relative to 2 d³.
fn of_pairs(measures: &Measures) -> Map<String, Value> {
    let distances: Vec<f64> = pair_distances().collect();
    let (mut merged, mut step) = (0.0f64, 0.0f64);
    for pieces in measures.component_counts.chunks(distances.len()) {
        let joined = distances.iter().zip(pieces).filter(|(_, pieces)| **pieces == 1.0);
        merged = joined.fold(merged, |merged, (apart, _)| merged.max(*apart));
    }
    for volumes in measures.volumes.chunks(distances.len()) {
        // Volumes are relative to two particles.
        step = volumes.windows(2).fold(step, |step, two| step.max(2.0 * (two[1] - two[0]).abs()));
    }
    let apart_by_d = distances.iter().map(|apart| (apart - 1.0).abs() < 1e-9).cycle();
    let volumes = measures.volumes.iter().zip(apart_by_d).filter(|(_, is_apart_by_d)| *is_apart_by_d);
    let volumes: Vec<f64> = volumes.map(|(volume, _)| *volume).collect();
    map(json!({
        "merge_distance": round(merged), "volume_step": round(step), "volume_of_pair": round(mean(&volumes)),
    }))
}

/// The difference of the largest and the smallest distance of a vertex from the particle, relative to the
/// mean distance: the median of all drops. And the scatter of their volumes, and what 95 % of the angles of their faces
/// and of their vertex normals do not exceed, in degrees.
fn of_drops(measures: &mut Measures) -> Map<String, Value> {
    let roundness = Distribution::of(measures.roundness.iter().copied()).median;
    let scatter = deviation(&measures.volumes) / mean(&measures.volumes);
    let Facets { of_faces, of_vertices } = std::mem::take(&mut measures.facets);
    let [faces, vertices] = [of_faces, of_vertices].map(|angles| percentile_95(angles).map(round));
    map(json!({
        "roundness": round(roundness), "volume_scatter": round(scatter), "facets": faces, "facets_of_vertices": vertices,
    }))
}

/// By number of particles in a strip, the largest [`jump`] of the area and of the volume in the frames of its welds.
fn of_welds(measures: &Measures) -> Map<String, Value> {
    let jumps = |values: &[f64]| -> Vec<f64> {
        let of_size = |values: &[f64]| round(values.chunks(WELD_FRAMES).map(jump).fold(0.0, f64::max));
        values.chunks(WELD_FRAMES * WELD_PLACES).map(of_size).collect()
    };
    let [areas, volumes] = [&measures.areas, &measures.volumes].map(|values| jumps(values));
    let of_size =
        |size: usize| (WELDS[size].to_string(), json!({ "area": areas[size], "volume": volumes[size] }));
    let of_sizes: Map<String, Value> = (0..WELDS.len()).map(of_size).collect();
    map(json!({ "welds": of_sizes }))
}

/// The largest second difference of the values in the frames of a weld, relative to the value: what changes beyond the
/// change that steady motion gives. The frames between which the motion turns do not count.
fn jump(values: &[f64]) -> f64 {
    let second = |at: &dyn Fn(usize) -> f64, frame: usize| at(frame - 1) - 2.0 * at(frame) + at(frame + 1);
    let steady = (1..values.len() - 1).filter(|frame| second(&weld_distance, *frame).abs() < 1e-9);
    steady.map(|frame| second(&|frame| values[frame], frame).abs() / values[frame]).fold(0.0, f64::max)
}

/// The mean volumes of lone particles of each size, relative to the balls of their own radii, the smallest first.
fn of_sizes(measures: &Measures) -> Map<String, Value> {
    let of_size = |size: usize| {
        let volumes: Vec<f64> = measures.lone_volumes.iter().map(|of_frame| of_frame[size]).collect();
        round(mean(&volumes))
    };
    map(json!({ "sizes": (0..lone_radii().count()).map(of_size).collect::<Vec<f64>>() }))
}

pub(super) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The standard deviation of a population of which these values are a sample.
fn deviation(values: &[f64]) -> f64 {
    let middle = mean(values);
    let squares: f64 = values.iter().map(|value| (value - middle).powi(2)).sum();
    (squares / (values.len() as f64 - 1.0)).sqrt()
}

/// Only what is measured of each frame.
fn still(maker: &Maker, set: &Set, measures: &mut Measures) -> Outcome<Map<String, Value>> {
    for frame in &set.frames {
        let made = maker.make(set, frame)?;
        measures.add_costs(&made);
        measures.add_shape(&made, frame, set.spacing);
    }
    Ok(Map::new())
}

/// The bumps of a pool's surface, their changes from frame to frame, and the error of its level.
fn pool(maker: &Maker, set: &Set, rays: &Rays, measures: &mut Measures) -> Outcome<Map<String, Value>> {
    let mut before: Option<Vec<f64>> = None;
    let (mut bumps, mut changes, mut level) = (Vec::new(), Vec::new(), 0.0);
    for frame in &set.frames {
        let made = maker.make(set, frame)?;
        measures.add_costs(&made);
        measures.add_shape(&made, frame, set.spacing);
        let heights = rays.heights(&made.mesh);
        let bumps_of_frame = rays.bumps(&heights);
        if let Some(before) = &before {
            changes.extend(bumps_of_frame.iter().zip(before).map(|(after, before)| after - before));
        }
        level += heights.iter().sum::<f64>() / heights.len() as f64 - rays.true_level(&frame.points);
        bumps.extend_from_slice(&bumps_of_frame);
        before = Some(bumps_of_frame);
    }
    // A ray that misses the surface has no bump.
    let rms = |values: &[f64]| Distribution::of(values.iter().copied().filter(|value| value.is_finite())).rms;
    let level = level / set.frames.len() as f64;
    let [bumps, changes, level] =
        [rms(&bumps), rms(&changes), level].map(|length| round(length / set.spacing));
    Ok(map(json!({ "bumps": bumps, "flicker": changes, "level_error": level })))
}

/// Measures of one or more surfaces.
#[derive(Default)]
struct Measures {
    bending_energies: Vec<f64>,
    outer_bending_energies: Vec<f64>,
    areas: Vec<f64>,
    volumes: Vec<f64>,
    curvatures: Vec<f64>,
    /// Of lone particles: see [`of_drops`].
    roundness: Vec<f64>,
    facets: Facets,
    /// In each frame of lone particles with radii of their own, the volume of each, relative to the ball of its radius.
    lone_volumes: Vec<Vec<f64>>,
    component_counts: Vec<f64>,
    handle_counts: Vec<f64>,
    triangle_counts: Vec<f64>,
    dashes: Vec<f64>,
    outside: f64,
    deepest: f64,
    voxel_passes: Vec<f64>,
    uncertified: usize,
}

impl Measures {
    fn add_costs(&mut self, made: &MadeSurface) {
        self.voxel_passes.extend(made.voxel_passes.map(|count| count as f64));
        self.uncertified += usize::from(made.is_certified == Some(false));
    }

    fn add_shape(&mut self, made: &MadeSurface, frame: &Frame, spacing: f64) {
        let mesh = mesh_of(&made.mesh);
        let whole = mesh.measure();
        self.bending_energies.push(whole.bending_energy);
        self.outer_bending_energies.push(outer_part(&mesh).measure().bending_energy);
        self.areas.push(whole.area / spacing.powi(2));
        self.volumes.push(whole.volume / (frame.points.len() as f64 * spacing.powi(3)));
        self.curvatures.push((whole.bending_energy / whole.area).sqrt() * spacing);
        if let [center] = frame.points[..] {
            let distances: Vec<f64> =
                made.mesh.positions.iter().map(|at| DVec3::from(*at).distance(center)).collect();
            let [least, greatest] = limits(&distances);
            self.roundness.push((greatest - least) / mean(&distances));
            self.facets.add(&made.mesh, center);
        }
        if let Some(radii) = &frame.radii {
            self.lone_volumes.push(lone_volumes(&made.mesh, &frame.points, radii));
        }
        self.component_counts.push(whole.component_count as f64);
        // The total genus of all pieces.
        self.handle_counts.push(whole.component_count as f64 - 0.5 * whole.euler_characteristic as f64);
        self.triangle_counts.push(whole.triangle_count as f64);
        self.dashes.extend(dashes(&made.mesh, spacing));
        let (outside, deepest) = outside_fraction_and_depth(&made.solid, &frame.points, spacing);
        self.outside = self.outside.max(outside);
        self.deepest = self.deepest.max(deepest);
    }

    /// The scores of all surfaces: means, except the smallest and the largest volume, and the largest
    /// fraction of particles outside. The curvature is the root mean square of the mean curvature, and [`dashes`] are the
    /// variation of curvature along ridges.
    fn scores(self) -> Map<String, Value> {
        let mean = |values: &[f64]| (!values.is_empty()).then(|| round(mean(values)));
        map(json!({
            "h2": mean(&self.bending_energies), "outer_h2": mean(&self.outer_bending_energies),
            "curvature": mean(&self.curvatures),
            "volume": limits(&self.volumes).map(round), "volume_mean": mean(&self.volumes),
            "components": mean(&self.component_counts), "handles": mean(&self.handle_counts),
            "triangles": mean(&self.triangle_counts), "dashes": mean(&self.dashes),
            "outside": round(self.outside), "deepest": round(self.deepest),
            "voxel_passes": mean(&self.voxel_passes), "uncertified": self.uncertified,
        }))
    }
}

/// The volume around each lone particle, relative to the ball of its radius.
fn lone_volumes(mesh: &MeshData, points: &[DVec3], radii: &[f32]) -> Vec<f64> {
    let mut volumes = vec![0.0; points.len()];
    for triangle in &mesh.triangles {
        let corners = triangle.map(|vertex| DVec3::from(mesh.positions[vertex as usize]));
        let distances = points.iter().map(|point| point.distance_squared(corners[0])).enumerate();
        if let Some((nearest, _)) = distances.min_by(|one, other| one.1.total_cmp(&other.1)) {
            let [a, b, c] = corners.map(|corner| corner - points[nearest]);
            volumes[nearest] += a.dot(b.cross(c)) / 6.0;
        }
    }
    let balls = radii.iter().map(|radius| 4.0 / 3.0 * PI * f64::from(*radius).powi(3));
    volumes.iter().zip(balls).map(|(volume, ball)| volume / ball).collect()
}

/// The smallest and the largest of some numbers.
fn limits(values: &[f64]) -> [f64; 2] {
    let with = |[least, greatest]: [f64; 2], value: &f64| [least.min(*value), greatest.max(*value)];
    values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], with)
}

/// The fraction of particles outside, and the depth of the deepest, in spacings.
fn outside_fraction_and_depth(solid: &MeshSdf, points: &[DVec3], spacing: f64) -> (f64, f64) {
    let depths: Vec<f64> =
        points.par_iter().map(|point| solid.distance(*point).unwrap_or(f64::INFINITY) / spacing).collect();
    let outside = depths.iter().filter(|depth| **depth > 0.0).count();
    (outside as f64 / points.len().max(1) as f64, depths.iter().copied().fold(0.0, f64::max))
}

/// Converts to meniscus' mesh type, which has the functions that measure meshes.
fn mesh_of(data: &MeshData) -> Mesh {
    let origin = data.positions.first().map_or(DVec3::ZERO, |at| DVec3::from(*at));
    let positions = data.positions.iter().map(|at| (DVec3::from(*at) - origin).as_vec3()).collect();
    Mesh { positions, normals: Vec::new(), triangles: data.triangles.clone(), origin }
}

/// The pieces that enclose fluid, without those that bound a cavity.
fn outer_part(mesh: &Mesh) -> Mesh {
    let mut parent: Vec<usize> = (0..mesh.positions.len()).collect();
    fn root(parent: &mut [usize], mut vertex: usize) -> usize {
        while parent[vertex] != vertex {
            parent[vertex] = parent[parent[vertex]];
            vertex = parent[vertex];
        }
        vertex
    }
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|vertex| root(&mut parent, vertex as usize));
        let least = a.min(b).min(c);
        [a, b, c].into_iter().for_each(|vertex| parent[vertex] = least);
    }
    let mut volume_of: BTreeMap<usize, f64> = BTreeMap::new();
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|vertex| mesh.positions[vertex as usize].as_dvec3());
        *volume_of.entry(root(&mut parent, triangle[0] as usize)).or_default() += a.dot(b.cross(c)) / 6.0;
    }
    let triangles = if volume_of.values().all(|volume| *volume > 0.0) {
        mesh.triangles.clone()
    } else {
        let roots: Vec<usize> = (0..parent.len()).map(|vertex| root(&mut parent, vertex)).collect();
        mesh.triangles
            .iter()
            .filter(|triangle| volume_of[&roots[triangle[0] as usize]] > 0.0)
            .copied()
            .collect()
    };
    Mesh { triangles, ..mesh.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What changes evenly has no jump, also where the motion turns; a step has its height.
    #[test]
    fn jumps() {
        let even: Vec<f64> = (0..WELD_FRAMES).map(|frame| 10.0 + weld_distance(frame)).collect();
        assert!(jump(&even) < 1e-9, "{}", jump(&even));
        let torn: Vec<f64> = (0..WELD_FRAMES).map(|frame| if frame < 40 { 10.0 } else { 11.0 }).collect();
        assert!((jump(&torn) - 0.1).abs() < 1e-9, "{}", jump(&torn));
    }

    /// Each piece counts for the particle in it, relative to the ball of its radius.
    #[test]
    fn volumes_of_lone_particles() {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let triangles = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        let moved = positions.map(|at| (10.0 * DVec3::X + 2.0 * DVec3::from(at)).to_array());
        let mesh = MeshData {
            positions: [positions, moved].concat(),
            normals: Vec::new(),
            triangles: [triangles, triangles.map(|triangle| triangle.map(|vertex| vertex + 4))].concat(),
        };
        let found =
            lone_volumes(&mesh, &[DVec3::splat(0.2), DVec3::splat(0.3) + 10.0 * DVec3::X], &[1.0, 2.0]);
        let expected = 1.0 / (8.0 * PI);
        assert!(found.iter().all(|volume| (volume - expected).abs() < 1e-9), "{found:?}");
    }
}
