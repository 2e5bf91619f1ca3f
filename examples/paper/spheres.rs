//! A noisy sphere under both flows (paper, Fig. 5 and 10).
//!
//! ```text
//!      radius 16 ──────  upper bound of φ            (radii in voxels)
//!      radius 20 ─∿∿∿──  φ: the distance from this sphere, ±1 voxel of noise at every voxel
//!      radius 24 ──────  lower bound of φ
//! ```

use std::f64::consts::PI;
use std::path::Path;
use std::sync::Arc;

use glam::{DVec3, IVec3};
use meniscus::render::{CameraPlacement, Layers, Picture, View, render};
use meniscus::surface::contour::contour;
use meniscus::surface::grid::{Field, LEAF_VOXELS, Leaf, Topology, voxel_in_leaf};
use meniscus::surface::level_set::{Bounds, NarrowBand};
use meniscus::surface::mesh::MeshMeasures;
use meniscus::surface::options::Contouring;
use meniscus::surface::smooth::{
    Integrator, SmoothConfig, SmoothContext, SmoothOp, SmoothSteps, Workspace, schedule, smooth,
    smooth_laplacian_only,
};
use meniscus::surface::space::Lattice;

use crate::Outcome;
use crate::output::Files;
use crate::samples::Random;

const RADIUS: f32 = 20.0;
const BOUND_RADII: [f32; 2] = [16.0, 24.0];

/// Half width of the band, in voxels: the stencil of a step plus the movement of the surface.
const HALF_WIDTH: f32 = 9.0;

const LATTICE: Lattice = Lattice { voxel_size: 1.0 };

/// Numbers of Laplacian steps of 0.1 h², and of explicit biharmonic steps of 0.01 h⁴.
const LAPLACIAN_STEPS: [u32; 9] = [0, 5, 15, 50, 100, 200, 400, 700, 1000];
const BIHARMONIC_STEPS: [u32; 9] = [0, 20, 50, 150, 500, 1000, 2000, 5000, 10_000];

/// Both flows over time, and the effect of redistancing.
pub(crate) fn run(folder: &Path) -> Outcome<()> {
    let files = Files::new(folder, "spheres");
    let laplacian = LAPLACIAN_STEPS.map(|steps| {
        let (mut band, bounds) = noisy_sphere(|distance, _| distance);
        if steps > 0 {
            smooth_laplacian_only(&mut band, &bounds, steps);
        }
        (steps, band)
    });
    let biharmonic = BIHARMONIC_STEPS.map(|steps| {
        let (mut band, bounds) = noisy_sphere(|distance, _| distance);
        if steps > 0 {
            smooth(&mut band, &bounds, &explicit(steps), &mut |_| {});
        }
        (steps, band)
    });
    let mut rows = Vec::new();
    for (flow, bands) in [("Laplacian", &laplacian), ("thin-plate", &biharmonic)] {
        for (steps, band) in bands {
            let [volume, energy] = relative(&measured(band));
            rows.push(vec![flow.into(), steps.to_string(), format!("{volume:.4}"), format!("{energy:.4}")]);
        }
    }
    files.table("flows", &["smoothing", "steps", "volume / sphere volume", "∫H² / 4π"], &rows)?;
    let shown = |bands: &[(u32, NarrowBand)], flow: &str| -> Vec<(Picture, String)> {
        let some = [0, 2, 4, 8].into_iter().filter_map(|index| bands.get(index));
        some.map(|(steps, band)| (picture(band), format!("{flow}, {steps} steps"))).collect()
    };
    files.pictures("flows", vec![shown(&laplacian, "Laplacian"), shown(&biharmonic, "thin-plate")])?;
    distances(&files)
}

/// Fig. 10: the effect of redistancing. The flow of the thin-plate energy is linear in φ, so it moves a
/// surface less where φ is steep.
fn distances(files: &Files) -> Outcome<()> {
    let start = || noisy_sphere(|distance, at| distance * (1.0 + 0.4 * (-at.x).max(0.0)));
    let mut rows = Vec::new();
    let mut pictures = Vec::new();
    for (name, redistances) in [("without redistancing", false), ("redistanced", true)] {
        let (mut band, bounds) = start();
        let config = explicit(10_000);
        let mut memory = Workspace::new(band.topology.len());
        // A schedule starts with redistancing, which would repair the distorted distances: remove it.
        let schedule = schedule(&config, u32::MAX)
            .into_iter()
            .filter(|op| redistances || !matches!(op, SmoothOp::Restore | SmoothOp::Redistance));
        for op in schedule {
            SmoothContext {
                config: &config,
                band: &mut band,
                bounds: &bounds,
                workspace: &mut memory,
                own: None,
            }
            .apply(op);
        }
        let [left, right] = [-1.0, 1.0].map(|side| roughness(&band, side));
        rows.push(vec![name.into(), format!("{left:.3}"), format!("{right:.3}")]);
        pictures.push((picture(&band), name.to_owned()));
    }
    files.table(
        "distance",
        &["10 000 explicit steps", "standard deviation of the radius for x < −5 h, h", "for x > 5 h, h"],
        &rows,
    )?;
    files.pictures("distance", vec![pictures])
}

fn explicit(steps: u32) -> SmoothConfig {
    let steps = SmoothSteps {
        integrator: Integrator::Explicit,
        steps,
        step_size: 0.01,
        redistance_every: 50,
        ..SmoothSteps::default()
    };
    SmoothConfig { smoothing: steps, ..SmoothConfig::default() }
}

/// The noisy sphere and its bounds; `field` changes the field, given the distance and the position.
fn noisy_sphere(field: impl Fn(f32, glam::Vec3) -> f32) -> (NarrowBand, Bounds) {
    let topology = Topology::new(leaf_origins());
    let sphere = |radius: f32| {
        let leaf = |&origin: &IVec3| {
            let distance = |offset| (origin + voxel_in_leaf(offset)).as_vec3().length() - radius;
            Leaf { values: std::array::from_fn(distance).map(|d: f32| d.clamp(-HALF_WIDTH, HALF_WIDTH)) }
        };
        Field { leaves: topology.origins().iter().map(leaf).collect() }
    };
    let mut phi = sphere(RADIUS);
    let mut random = Random::new(5);
    for (leaf, origin) in phi.leaves.iter_mut().zip(topology.origins()) {
        for (offset, value) in leaf.values.iter_mut().enumerate() {
            let at = (*origin + voxel_in_leaf(offset)).as_vec3();
            *value = field(*value + 2.0 * random.unit() as f32 - 1.0, at).clamp(-HALF_WIDTH, HALF_WIDTH);
        }
    }
    let bounds = Bounds::new(sphere(BOUND_RADII[1]), sphere(BOUND_RADII[0]));
    (NarrowBand { topology: Arc::new(topology), phi, half_width: HALF_WIDTH }, bounds)
}

/// The leaves with a voxel within the half width.
fn leaf_origins() -> Vec<IVec3> {
    let near = |offset: usize, origin: IVec3| {
        ((origin + voxel_in_leaf(offset)).as_vec3().length() - RADIUS).abs() < HALF_WIDTH
    };
    let origins = (0..8 * 8 * 8).map(|i| (IVec3::new(i / 64, i / 8 % 8, i % 8) - 4) * 8);
    origins.filter(|&origin| (0..LEAF_VOXELS).any(|offset| near(offset, origin))).collect()
}

fn measured(band: &NarrowBand) -> MeshMeasures {
    contour(band, &LATTICE, Contouring::Dual).measure()
}

/// Volume and bending energy relative to the sphere.
fn relative(measures: &MeshMeasures) -> [f64; 2] {
    let sphere = 4.0 / 3.0 * PI * f64::from(RADIUS).powi(3);
    [measures.volume / sphere, measures.bending_energy / (4.0 * PI)]
}

/// The standard deviation of the radius on one side of the sphere, in voxels. The region between the two
/// sides is left out.
fn roughness(band: &NarrowBand, side: f64) -> f64 {
    let mesh = contour(band, &LATTICE, Contouring::Dual);
    let points = mesh.positions.iter().map(|position| mesh.origin + position.as_dvec3());
    let radii: Vec<f64> = points.filter(|at| at.x * side > 5.0).map(DVec3::length).collect();
    let mean = radii.iter().sum::<f64>() / radii.len().max(1) as f64;
    (radii.iter().map(|radius| (radius - mean).powi(2)).sum::<f64>() / radii.len().max(1) as f64).sqrt()
}

fn picture(band: &NarrowBand) -> Picture {
    let reach = DVec3::splat(f64::from(RADIUS) + 1.0);
    let placement = CameraPlacement { azimuth_degrees: 0.0, ..CameraPlacement::AUTO };
    let view = View {
        size: [260, 260],
        camera: placement.around([-reach, reach], 1.0),
        up: placement.up,
        ground: None,
    };
    render(band, &LATTICE, &view, Layers { data: false, velocity: None })
}
