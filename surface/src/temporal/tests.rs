//! Tests with motions that are known.

use std::sync::Arc;

use glam::{DQuat, DVec3};

use super::*;
use crate::grid::{FACE_STEPS, offset_in_leaf};
use crate::mesh::PositionRounding;
use crate::obstacle::{MeshSdf, Obstacle, ObstacleSdf, Obstacles};
use crate::options::{AttributeSelection, MethodOptions, Settings};
use crate::particles::{AttributeValues, OwnedPositions, ParticleCloud, Role};
use crate::reconstruct::{Reconstructor, RequestedParts};
use crate::reconstruction::{FrameSurface, ShapedSource, StagedFrame, shape_particles};

const SPACING: f64 = 0.1;
/// Seconds between two frames.
const SECONDS: f64 = 0.04;

/// A frame of particles with ids, velocities, or both.
#[derive(Clone, Default)]
struct Given {
    points: Vec<DVec3>,
    ids: Option<Vec<i64>>,
    velocities: Option<Vec<DVec3>>,
}

impl Given {
    fn moving(&self) -> MovingParticles {
        let velocities = self.velocities.as_ref();
        MovingParticles {
            positions: OwnedPositions::F64(self.points.iter().map(DVec3::to_array).collect()),
            ids: self.ids.clone(),
            velocities: velocities
                .map(|velocities| velocities.iter().map(|velocity| velocity.as_vec3().to_array()).collect()),
        }
    }
}

fn settings() -> Settings {
    let options = MethodOptions {
        spacing: Some(SPACING),
        temporal: Some(1),
        time_step: Some(SECONDS),
        ..MethodOptions::default()
    };
    Settings::resolve(&options, None).expect("sound")
}

fn smoothed(given: &Given) -> (StagedFrame<ShapedSource<ParticleCloud>>, Arc<TimedFrame>) {
    smoothed_with(&settings(), given, Obstacles::default())
}

fn smoothed_with(
    settings: &Settings,
    given: &Given,
    obstacles: Obstacles,
) -> (StagedFrame<ShapedSource<ParticleCloud>>, Arc<TimedFrame>) {
    let (shaped, stats) = shape_particles(ParticleCloud::from(given.moving().positions), settings);
    let staged = StagedFrame::rasterize(shaped, stats, obstacles, settings, None).expect("in memory");
    let staged = staged.smooth(settings, &mut |_| {}).expect("in memory");
    let timed = staged.timed(given.moving(), settings).expect("in memory");
    (staged, timed)
}

/// The surface of the middle frame, averaged with those of the others, which are one step before and after it.
fn averaged(middle: &Given, others: [Option<&Given>; 2]) -> FrameSurface {
    let beside_none = |given| (given, Obstacles::default());
    averaged_with(&settings(), beside_none(middle), others.map(|given| given.map(beside_none)))
}

/// Like [`averaged`], with obstacles in each frame.
fn averaged_with(
    settings: &Settings,
    (middle, obstacles): (&Given, Obstacles),
    others: [Option<(&Given, Obstacles)>; 2],
) -> FrameSurface {
    let (mut staged, timed) = smoothed_with(settings, middle, obstacles);
    let other = |(steps, other): (i32, Option<(&Given, Obstacles)>)| {
        let (given, obstacles) = other?;
        Some(OtherFrame { frame: smoothed_with(settings, given, obstacles).1, steps })
    };
    let others: Vec<OtherFrame> = [-1, 1].into_iter().zip(others).filter_map(other).collect();
    staged.average(&timed, &others, settings);
    let Ok((surface, _)) = staged.contour(settings, PositionRounding::Local) else { panic!("in memory") };
    assert!(surface.report.certificate.holds(), "{:?}", surface.report.certificate);
    surface
}

fn alone(given: &Given) -> FrameSurface {
    averaged(given, [None, None])
}

/// A block of particles on a lattice, displaced at random by up to `jitter` spacings along each axis.
fn block(edge: i32, jitter: f64, seed: u32) -> Vec<DVec3> {
    let random = |index: u32| {
        let mixed = (index ^ seed.wrapping_mul(0x85eb_ca6b)).wrapping_add(1).wrapping_mul(0x9e37_79b9);
        let mixed = (mixed ^ mixed >> 15).wrapping_mul(0x2c1b_3c6d);
        2.0 * f64::from((mixed ^ mixed >> 12) >> 8) / f64::from(1 << 24) - 1.0
    };
    let point = |index: i32| {
        let at =
            DVec3::new((index / edge / edge).into(), (index / edge % edge).into(), (index % edge).into());
        let offset = DVec3::from_array([0, 1, 2].map(|axis| random(3 * index as u32 + axis)));
        SPACING * (at + jitter * offset)
    };
    (0..edge.pow(3)).map(point).collect()
}

fn ids(count: usize) -> Option<Vec<i64>> {
    Some((0..count as i64).collect())
}

/// Root mean square distance of the vertices on the upper side of a block from their mean plane, in spacings.
fn roughness(surface: &FrameSurface, edge: i32) -> f64 {
    let within = 2.0 * SPACING..f64::from(edge - 3) * SPACING;
    let positions = surface.mesh.positions.iter().map(|position| surface.mesh.origin + position.as_dvec3());
    let heights: Vec<f64> = positions
        .filter(|at| within.contains(&at.x) && within.contains(&at.y) && at.z > within.end)
        .map(|at| at.z / SPACING)
        .collect();
    let mean = heights.iter().sum::<f64>() / heights.len() as f64;
    (heights.iter().map(|height| (height - mean).powi(2)).sum::<f64>() / heights.len() as f64).sqrt()
}

/// The jitter differs in each frame, like the noise of a reconstruction. It is not motion: the velocities are those
/// of the block.
#[test]
fn noise_is_averaged_along_velocities() {
    let edge = 12;
    let velocity = DVec3::new(1.3, -0.7, 0.4);
    let frame = |step: i32| {
        let offset = f64::from(step) * SECONDS * velocity;
        let points: Vec<DVec3> =
            block(edge, 0.2, (10 + step) as u32).into_iter().map(|point| point + offset).collect();
        let count = points.len();
        Given { points, ids: None, velocities: Some(vec![velocity; count]) }
    };
    let [before, middle, after] = [-1, 0, 1].map(frame);
    let surface = averaged(&middle, [Some(&before), Some(&after)]);
    assert_eq!(surface.report.temporal.frame_count, 2);
    assert!(surface.report.temporal.confidence > 0.95, "{:?}", surface.report.temporal);
    let [without, with] = [alone(&middle), surface].map(|surface| roughness(&surface, edge));
    // Equal weights multiply the deviation of independent noise by 0.58, and single frames of kernels have little.
    assert!(with < 0.8 * without, "{with} instead of {without}");
}

/// How φ changes near the surface of a block that is averaged with itself, these numbers of frames later,
/// where the level set is higher by `shift` voxels.
fn changes(shift: f32, frames: u32, steps: &[i32]) -> Vec<f32> {
    let points = block(8, 0.0, 1);
    let given = Given { ids: ids(points.len()), points, velocities: None };
    let (_, timed) = smoothed(&given);
    let mut shifted = NarrowBand::clone(&timed.band);
    shifted.phi.leaves.iter_mut().flat_map(|leaf| &mut leaf.values).for_each(|phi| *phi += shift);
    let shifted = Arc::new(TimedFrame::new(Arc::new(shifted), given.moving(), SPACING));
    let lattice = Lattice { voxel_size: settings().voxel_size };
    let other = |&steps: &i32| OtherFrame { frame: Arc::clone(&shifted), steps };
    let others: Vec<OtherFrame> = steps.iter().map(other).collect();
    let config = TemporalConfig { frames, seconds: None, spacing: SPACING, lattice };
    let mut band = NarrowBand::clone(&timed.band);
    average(&mut band, &timed, &others, &config);
    let values = band.phi.leaves.iter().zip(&timed.band.phi.leaves);
    let values = values.flat_map(|(after, before)| after.values.iter().zip(&before.values));
    values.filter(|(_, before)| before.abs() < 1.0).map(|(after, before)| after - before).collect()
}

/// Each of the 2 N + 1 frames has the same weight, and the weight of a missing frame stays with the frame
/// itself.
#[test]
fn frames_have_equal_weights() {
    const SHIFT: f32 = 0.25;
    for frames in 1..=3 {
        for steps in [vec![1], (-frames..=frames).filter(|step| *step != 0).collect()] {
            let expected = SHIFT * steps.len() as f32 / (2 * frames + 1) as f32;
            let found = changes(SHIFT, frames as u32, &steps);
            assert!(found.iter().all(|change| (change - expected).abs() < 1e-4), "{steps:?}: {found:?}");
            assert!(found.len() > 1000, "{}", found.len());
        }
    }
}

/// A level set that differs by a spacing has its full weight, and one that differs by as much as the band holds
/// has none.
#[test]
fn level_sets_that_disagree_have_no_weight() {
    let spacing_voxels = (SPACING / settings().voxel_size) as f32;
    let most = (5.0 - 1.0) / spacing_voxels;
    assert!(1.0 < most && most < 2.0, "{most}");
    for (spacings, weight) in [(1.0, 1.0), (0.5 + 0.5 * most, 0.5), (most, 0.0), (-2.0, 0.0)] {
        let shift = spacings * spacing_voxels;
        let found = changes(shift, 1, &[1]);
        assert!(found.iter().all(|change| (change - weight * shift / 3.0).abs() < 1e-3), "{spacings}");
    }
}

/// A drop that rotates and falls keeps its volume and its shape: its surface is as close to the sphere as alone.
#[test]
fn rotating_drop_stays_round() {
    const RADIUS: f64 = 6.0 * SPACING;
    let rest: Vec<DVec3> = block(14, 0.2, 3).into_iter().map(|at| at - 6.5 * SPACING).collect();
    let rest: Vec<DVec3> = rest.into_iter().filter(|at| at.length() < RADIUS - 0.5 * SPACING).collect();
    let turn = DVec3::new(0.6, 0.0, 0.8);
    let frame = |step: f64, has_ids: bool| {
        let rotation = DQuat::from_axis_angle(turn, 0.15 * step);
        let fallen = DVec3::new(0.09 * step, 0.0, -0.03 * step * step);
        let points: Vec<DVec3> = rest.iter().map(|&at| rotation * at + fallen).collect();
        let velocity = |at: &DVec3| {
            let falling = DVec3::new(0.09, 0.0, -0.06 * step);
            (falling + 0.15 * turn.cross(*at - fallen)) / SECONDS
        };
        let velocities = (!has_ids).then(|| points.iter().map(velocity).collect());
        Given { ids: ids(rest.len()).filter(|_| has_ids), points, velocities }
    };
    // Distances of the vertices from the sphere, in spacings: their root mean square, and their mean.
    let errors = |surface: &FrameSurface| {
        let positions = surface.mesh.positions.iter().map(|at| surface.mesh.origin + at.as_dvec3());
        let errors: Vec<f64> = positions.map(|at| (at.length() - RADIUS) / SPACING).collect();
        let count = errors.len() as f64;
        let square = errors.iter().map(|error| error * error).sum::<f64>();
        ((square / count).sqrt(), errors.iter().sum::<f64>() / count)
    };
    for has_ids in [true, false] {
        let [before, middle, after] = [-1.0, 0.0, 1.0].map(|step| frame(step, has_ids));
        let [without, with] = [alone(&middle), averaged(&middle, [Some(&before), Some(&after)])];
        assert!(with.report.temporal.confidence > 0.9, "{:?}", with.report.temporal);
        let volume = with.report.mesh.volume / without.report.mesh.volume;
        assert!((volume - 1.0).abs() < 0.003, "{volume}");
        let [(rms, bias), (rms_with, bias_with)] = [without, with].map(|surface| errors(&surface));
        assert!(rms_with < 1.01 * rms, "{rms_with} instead of {rms}");
        assert!((bias_with - bias).abs() < 0.01, "{bias_with} instead of {bias}");
    }
}

/// A standing wave, whose surface is known: averages are no farther from it than single frames are.
#[test]
fn wave_stays_where_it_is() {
    const AMPLITUDE: f64 = 0.8 * SPACING;
    const WAVE_NUMBER: f64 = std::f64::consts::TAU / (14.0 * SPACING);
    const SIZE: [i32; 3] = [30, 8, 10];
    // The phase between two frames.
    const STEP: f64 = 0.3;
    // The displacement of a particle at rest, at this phase of the wave: that of deep water.
    let displaced = |rest: DVec3, phase: f64| {
        let amplitude = AMPLITUDE * (WAVE_NUMBER * rest.y).exp() * phase.cos();
        let (sin, cos) = (WAVE_NUMBER * rest.x).sin_cos();
        rest + DVec3::new(-amplitude * sin, amplitude * cos, 0.0)
    };
    let frame = |phase: f64, seed: u32, has_ids: bool| {
        let [noise, still] = [0.2, 0.0].map(|jitter| block(14, jitter, seed));
        let [columns, depth, width] = SIZE;
        let at = |index: i32| {
            let [x, y, z] =
                [index % columns, index / columns % depth, index / columns / depth].map(f64::from);
            SPACING * DVec3::new(x - 14.5, -y - 0.5, z - 4.5)
        };
        let rest: Vec<DVec3> = (0..columns * depth * width).map(at).collect();
        let moved = rest.iter().zip(noise.iter().zip(&still));
        let points = moved.map(|(rest, (noise, still))| displaced(*rest, phase) + *noise - *still).collect();
        // Half a step in both directions.
        let velocity = |rest: &DVec3| {
            (displaced(*rest, phase + 0.5 * STEP) - displaced(*rest, phase - 0.5 * STEP)) / SECONDS
        };
        let velocities = (!has_ids).then(|| rest.iter().map(velocity).collect());
        Given { points, ids: ids(rest.len()).filter(|_| has_ids), velocities }
    };
    // The errors of the upper side in spacings, far from the edges: their standard deviation, and their mean.
    let errors = |surface: &FrameSurface, phase: f64| {
        let positions =
            surface.mesh.positions.iter().map(|position| surface.mesh.origin + position.as_dvec3());
        let upper = positions
            .filter(|at| at.x.abs() < 10.0 * SPACING && at.z.abs() < 2.5 * SPACING && at.y > -2.0 * SPACING);
        let error = |at: DVec3| {
            let rest = (0..60).fold(at.x, |rest, _| at.x + rest - displaced(DVec3::X * rest, phase).x);
            (at.y - displaced(DVec3::X * rest, phase).y) / SPACING
        };
        let errors: Vec<f64> = upper.map(error).collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        ((errors.iter().map(|error| (error - mean).powi(2)).sum::<f64>() / errors.len() as f64).sqrt(), mean)
    };
    // By ids, each particle keeps its noise; by velocities, each frame has its own.
    for has_ids in [true, false] {
        let mut squares = [0.0; 2];
        for (phase, seed) in [(0.0, 1), (1.0, 11), (1.6, 21)] {
            let given = |at: u32| {
                let seed = if has_ids { seed } else { seed + at };
                frame(phase + STEP * (f64::from(at) - 1.0), seed, has_ids)
            };
            let [before, middle, after] = [0, 1, 2].map(given);
            let alone = errors(&alone(&middle), phase);
            let averaged = errors(&averaged(&middle, [Some(&before), Some(&after)]), phase);
            // The other frames, which have two thirds of the weight, differ by the curvature of the path in time.
            assert!((averaged.1 - alone.1).abs() < 0.016, "{phase}: {averaged:?}, {alone:?}");
            for (square, (deviation, mean)) in squares.iter_mut().zip([alone, averaged]) {
                *square += deviation * deviation + mean * mean;
            }
        }
        let [alone, averaged] = squares.map(f64::sqrt);
        assert!(averaged < 1.01 * alone && alone < 0.225, "{averaged} instead of {alone}");
    }
}

/// A sequence of one frame is the frame alone, to the bit.
#[test]
fn no_other_frames_change_nothing() {
    let given = Given { points: block(6, 0.2, 1), ids: ids(216), velocities: None };
    let without = Settings { temporal: 0, ..settings() };
    let surface = crate::reconstruction::reconstruct_frame(&given.moving().positions, &without);
    let found = alone(&given);
    assert_eq!(found.report, surface.report);
    assert!(found.mesh == surface.mesh && found.band.phi == surface.band.phi);
    // Nor do frames whose particles have neither ids nor velocities.
    let unknown = Given { points: given.points.clone(), ..Given::default() };
    assert!(averaged(&unknown, [Some(&unknown), None]).mesh == surface.mesh);
    // Nor do those that have none of the particles.
    let all_new = Given { ids: Some((1000..1216).collect()), ..given.clone() };
    let found = averaged(&given, [Some(&all_new), Some(&all_new)]);
    assert_eq!((found.report.temporal.frame_count, found.report.temporal.change), (2, 0.0));
    assert!(found.mesh == surface.mesh && found.band.phi == surface.band.phi);
}

/// A frame without particles does not lower the confidence.
#[test]
fn empty_frames_do_not_count() {
    let given = Given { points: block(6, 0.2, 1), ids: ids(216), velocities: None };
    let empty = Given { ids: ids(0), ..Given::default() };
    let temporal = averaged(&given, [Some(&given), Some(&empty)]).report.temporal;
    assert_eq!(temporal.frame_count, 1);
    assert!(temporal.confidence > 0.95, "{temporal:?}");
}

/// A change of one particle changes nothing at a larger distance than the report states. Here the
/// displacement of the particle counts at a larger distance than its surface does.
#[test]
fn far_changes_keep_the_averaged_surface() {
    const FAR: f64 = 150.0;
    let options = MethodOptions {
        spacing: Some(100.0),
        radius_min: Some(1.8.into()),
        laplacian_steps: Some(0),
        steps: Some(0),
        temporal: Some(1),
        ..MethodOptions::default()
    };
    let settings = Settings::paper(1.0, &options).expect("sound");
    let ball = |x: f64| block(4, 0.0, 1).into_iter().map(move |at| at * (2.0 / SPACING) + x * DVec3::X);
    let frame = |step: f64, has_far: bool| {
        let flow = step * DVec3::new(0.3, 0.2, -0.4);
        let far = DVec3::new(FAR, 30.0 * step, 0.0);
        let balls = ball(0.0).chain(ball(FAR + 250.0)).map(|at| at + flow);
        let points: Vec<DVec3> = balls.chain(has_far.then_some(far)).collect();
        Given { ids: ids(points.len()), points, velocities: None }
    };
    let surface = |has_far| {
        let [before, middle, after] = [-1.0, 0.0, 1.0].map(|step| frame(step, has_far));
        let others = [&before, &after].map(|given| Some((given, Obstacles::default())));
        averaged_with(&settings, (&middle, Obstacles::default()), others)
    };
    let (one, other) = (surface(false), surface(true));
    assert!(one.report.temporal.confidence > 0.95, "{:?}", one.report.temporal);
    let reach = other.report.smoothing.reach_voxels.expect("local");
    let mut farthest = 0;
    for (origin, values) in one.band.leaves() {
        let (leaf, _) = other.band.topology.find_voxel(origin).expect("the same balls");
        for (offset, (phi, with)) in values.iter().zip(&other.band.phi.leaves[leaf].values).enumerate() {
            let distance = (origin + voxel_in_leaf(offset)).x.abs_diff(FAR as i32);
            if phi.to_bits() != with.to_bits() {
                farthest = farthest.max(distance);
            }
        }
    }
    let alone = averaged_with(&settings, (&frame(0.0, true), Obstacles::default()), [None, None]);
    let reach_alone = alone.report.smoothing.reach_voxels.expect("local");
    assert!(reach_alone < farthest && farthest <= reach, "{reach_alone}, {farthest}, {reach}");
}

/// The obstacle moves from frame to frame, and the fluid stays outside that of its own frame.
#[test]
fn fluid_stays_outside_the_obstacle_of_its_frame() {
    const RADIUS: f64 = 4.0 * SPACING;
    let center = |step: f64| SPACING * DVec3::new(4.5, 4.5, -3.5 + 0.5 * step);
    let octahedron = |step: f64| {
        let corners = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y, DVec3::Z, -DVec3::Z];
        let positions = corners.map(|corner| (center(step) + RADIUS * corner).to_array());
        let faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];
        let solid = ObstacleSdf::Mesh(MeshSdf::new(&positions, &faces));
        Obstacles { members: vec![Arc::new(Obstacle::new(solid, 1 << 24))] }
    };
    let given = Given { points: block(10, 0.2, 1), ids: ids(1000), velocities: None };
    let others = [-1.0, 1.0].map(|step| Some((&given, octahedron(step))));
    let surface = averaged_with(&settings(), (&given, octahedron(0.0)), others);
    assert!(surface.report.temporal.change > 0.01, "{:?}", surface.report.temporal);
    let depth_voxels = |position: &Vec3| {
        let from_center = surface.mesh.origin + position.as_dvec3() - center(0.0);
        (RADIUS - from_center.abs().element_sum()) / 3f64.sqrt() / settings().voxel_size
    };
    let depths: Vec<f64> = surface.mesh.positions.iter().map(depth_voxels).collect();
    let deepest = depths.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let touching = depths.iter().filter(|depth| depth.abs() < 0.2).count();
    assert!(deepest < 0.2 && touching > 50, "{deepest}, {touching}");
    assert!((surface.report.depth.deepest_voxels - deepest.max(0.0)).abs() < 0.05, "{deepest}");
}

/// Attributes are not averaged: velocities at the vertices are those of the frame's own particles.
#[test]
fn velocities_stay_those_of_the_frame() {
    let points = block(6, 0.2, 1);
    let options = crate::Options {
        spacing: Some(SPACING),
        temporal: Some(1),
        attributes: Some(AttributeSelection::Named(vec!["v".into()])),
        ..crate::Options::default()
    };
    let wanted = RequestedParts {
        rounding: PositionRounding::Local,
        band_half_width_voxels: None,
        allows_empty: false,
    };
    let mut reconstructor = Reconstructor::new(options);
    let mut smoothed = |speed: f32| {
        let velocities = (0..points.len()).flat_map(|index| [speed + 0.004 * index as f32, 0.0, 0.0]);
        let attribute =
            |name: &str, role, arity, values| Attribute { name: name.to_owned(), role, arity, values };
        let ids = AttributeValues::Integers(ids(points.len()).expect("some"));
        let attributes = vec![
            attribute("id", Role::Id, 1, ids),
            attribute("v", Role::Velocity, 3, AttributeValues::Numbers(velocities.collect())),
        ];
        let positions = OwnedPositions::F64(points.iter().map(DVec3::to_array).collect());
        reconstructor.smooth_parts(positions, attributes, wanted).expect("valid")
    };
    let (middle, after) = (smoothed(1.0), smoothed(5.0));
    let others = [OtherFrame { frame: after.timed().expect("in memory"), steps: 1 }];
    let (surface, _) = reconstructor.contour_parts(middle, &others).expect("valid");
    assert_eq!(surface.report.temporal.frame_count, 1);
    let [Attribute { values: AttributeValues::Numbers(values), .. }] = &*surface.attributes.vertices else {
        panic!("{:?}", surface.attributes.vertices)
    };
    assert_eq!(values.len(), 3 * surface.mesh.positions.len());
    assert!(values.chunks(3).all(|v| (1.0..=1.864).contains(&v[0]) && v[1..] == [0.0; 2]));
}

/// However the other frames differ, a voxel comes inside only beside one that was inside.
#[test]
fn fluid_appears_only_beside_fluid() {
    let own = block(8, 0.0, 1);
    let given = Given { points: own.clone(), ids: ids(own.len()), velocities: None };
    let layer = own.iter().filter(|at| at.z < 0.5 * SPACING).map(|at| *at + 8.0 * SPACING * DVec3::Z);
    let grown = Given { points: own.iter().copied().chain(layer).collect(), ..Given::default() };
    let ((_, timed), (_, grown)) = (smoothed(&given), smoothed(&grown));
    let particles = TrackedParticles::new(given.moving(), RADII * SPACING);
    let other = Arc::new(TimedFrame { band: Arc::clone(&grown.band), particles });
    let others = [-1, 1].map(|steps| OtherFrame { frame: Arc::clone(&other), steps });
    let lattice = Lattice { voxel_size: settings().voxel_size };
    let config = TemporalConfig { frames: 1, seconds: None, spacing: SPACING, lattice };
    let mut band = NarrowBand::clone(&timed.band);
    average(&mut band, &timed, &others, &config);
    let is_inside = |band: &NarrowBand, voxel: IVec3| {
        let (leaf, local) = band.topology.find_voxel(voxel)?;
        Some(band.phi.leaves[leaf].values[offset_in_leaf(local)] < 0.0)
    };
    let voxels = band
        .topology
        .origins()
        .iter()
        .flat_map(|&origin| (0..LEAF_VOXELS).map(move |offset| origin + voxel_in_leaf(offset)));
    let appeared = |voxel: &IVec3| {
        is_inside(&band, *voxel) == Some(true) && is_inside(&timed.band, *voxel) == Some(false)
    };
    let appeared: Vec<IVec3> = voxels.filter(appeared).collect();
    assert!(appeared.len() > 100, "{}", appeared.len());
    for voxel in appeared {
        let beside = |step: &IVec3| is_inside(&timed.band, voxel + *step) == Some(true);
        assert!(FACE_STEPS.iter().any(beside), "{voxel}");
    }
}

/// A drop that exists in the middle frame only keeps its volume, and so does one that is deep in the body in
/// the others. A drop that exists in the others only leaves no ghost.
#[test]
fn drops_that_appear_vanish_or_merge_stay_what_they_are() {
    let body = block(10, 0.0, 1);
    let with_drops = |first: i64, drops: Vec<DVec3>| {
        let of_drops = (0..).take(drops.len()).map(|drop| first + drop);
        let ids = ids(body.len()).into_iter().flatten().chain(of_drops).collect();
        Given { points: [&body[..], &drops].concat(), ids: Some(ids), velocities: None }
    };
    let pair = |at: DVec3| vec![at, at + DVec3::new(0.09, 0.0, 0.0)];
    let ball = |at: DVec3| block(3, 0.0, 1).into_iter().map(|point| at + point).collect();
    let own = DVec3::new(-0.8, 0.2, 0.2);
    let drop_volume = |surface: &FrameSurface| {
        let lattice = settings().voxel_size;
        let voxels = surface.band.leaves().flat_map(|(origin, values)| {
            values.iter().enumerate().map(move |(offset, phi)| (origin + voxel_in_leaf(offset), *phi))
        });
        voxels.filter(|(voxel, phi)| *phi < 0.0 && lattice * f64::from(voxel.x) < -0.4).count()
    };
    for (middle, beside) in [
        (with_drops(1000, pair(own)), with_drops(2000, pair(DVec3::new(0.2, 0.2, 1.6)))),
        // The lower side of the ball is so deep that the level sets disagree, and not so deep that they end.
        (with_drops(1000, ball(own)), with_drops(1000, ball(DVec3::new(0.35, 0.35, 0.27)))),
    ] {
        let [without, with] = [alone(&middle), averaged(&middle, [Some(&beside), Some(&beside)])];
        assert_eq!(with.report.mesh.component_count, 2);
        let [before, after] = [drop_volume(&without), drop_volume(&with)];
        assert!(before > 50 && before.abs_diff(after) * 50 <= before, "{before}, then {after}");
    }
}

/// Ids that were dealt anew, and velocities in another unit, do not spoil the surface.
#[test]
fn false_motions_are_not_followed() {
    let points = block(10, 0.2, 1);
    let count = points.len();
    let middle = Given { points: points.clone(), ids: ids(count), velocities: None };
    let shuffled = (0..count as i64).map(|id| id * 367 % count as i64).collect();
    let dealt = Given { points: points.clone(), ids: Some(shuffled), velocities: None };
    let found = averaged(&middle, [Some(&dealt), Some(&dealt)]).report;
    assert!(found.temporal.confidence < 0.02, "{:?}", found.temporal);
    let velocity = DVec3::new(0.9, 0.3, 0.0);
    let moving = |offset: DVec3, factor: f64| Given {
        points: points.iter().map(|at| *at + offset).collect(),
        ids: None,
        velocities: Some(vec![factor * velocity; count]),
    };
    let step = SECONDS * velocity;
    for (factor, most) in [(100.0, 0.02), (-8.0, 0.6)] {
        let [before, middle, after] = [-step, DVec3::ZERO, step].map(|offset| moving(offset, factor));
        let alone = alone(&middle).report.mesh.volume;
        let found = averaged(&middle, [Some(&before), Some(&after)]).report;
        assert!(found.temporal.confidence < most, "{:?}", found.temporal);
        assert!((found.mesh.volume / alone - 1.0).abs() < 0.02);
    }
}

/// The spline passes through the voxels and reproduces quadratic functions.
#[test]
fn sampling_reproduces_quadratic_functions() {
    use crate::grid::{Field, Topology};
    let value = |at: Vec3| 0.3 * at.x * at.x - 0.2 * at.y * at.z + at.z - 1.0;
    let origins = (0..27).map(|leaf| IVec3::new(leaf / 9, leaf / 3 % 3, leaf % 3) * 8).collect();
    let topology = Topology::new(origins);
    let leaf = |&origin: &IVec3| Leaf {
        values: std::array::from_fn(|offset| value((origin + voxel_in_leaf(offset)).as_vec3())),
    };
    let phi = Field { leaves: topology.origins().iter().map(leaf).collect() };
    let band = NarrowBand { topology: topology.into(), phi, half_width: 1000.0 };
    let mut sampler = Sampler::new(&band);
    for index in 0..200 {
        let step = Vec3::new(0.37, 0.61, -0.83) * index as f32;
        let voxel = IVec3::new(3, 2, 20)
            - (step.floor().as_ivec3() - IVec3::new(index % 13, index % 11, -(index % 7)));
        let expected = value(voxel.as_vec3() + step);
        let found = sampler.sample(voxel, step).expect("stored");
        assert!((found - expected).abs() < 1e-3, "{found} instead of {expected}");
    }
    assert_eq!(sampler.sample(IVec3::splat(-40), Vec3::ZERO), None);
    assert_eq!(sampler.sample(IVec3::MAX, Vec3::splat(1e9)), None);
}
