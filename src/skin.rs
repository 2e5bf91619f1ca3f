//! The whole method in three calls: rasterize, smooth, contour.
//!
//! The calls are separate so that a pipeline can have a different frame in each of them; [`skin`]
//! is the three in a row. None of them starts threads of its own or touches a file: loops run in
//! whatever rayon pool the caller is in.

use std::time::Instant;

use crate::certify::certify;
use crate::contour;
use crate::grid::Leaf;
use crate::level_set::{Bounds, NarrowBand};
use crate::mesh::Mesh;
use crate::particles::Particles;
use crate::rasterize::{self, ParticleBins, Radii};
use crate::report::SkinReport;
use crate::settings::{Contouring, Integrator, Settings};
use crate::smooth;
use crate::space::Lattice;

/// The surface of one frame.
#[derive(Clone, Debug)]
pub struct Surface {
    /// The level set that was meshed.
    pub band: NarrowBand,
    /// The mesh.
    pub mesh: Mesh,
    /// What was measured on the way.
    pub report: SkinReport,
}

impl Surface {
    /// The memory that it takes, in bytes.
    pub fn size_bytes(&self) -> u64 {
        let leaves = self.band.phi.leaves.len() * (size_of::<Leaf>() + TOPOLOGY_LEAF_BYTES);
        let Mesh { positions, normals, triangles, .. } = &self.mesh;
        let mesh = size_of_val(&**positions) + size_of_val(&**normals) + size_of_val(&**triangles);
        (leaves + mesh) as u64
    }
}

/// What rasterization hands to smoothing.
#[derive(Clone, Debug)]
pub struct Rasterized {
    bins: ParticleBins,
    band: NarrowBand,
    bounds: Bounds,
    report: SkinReport,
}

/// What smoothing hands to contouring.
#[derive(Clone, Debug)]
pub struct Smoothed {
    bins: ParticleBins,
    band: NarrowBand,
    bounds: Bounds,
    report: SkinReport,
}

/// Skins one frame: rasterize, smooth, contour.
pub fn skin(particles: &Particles, settings: &Settings) -> Surface {
    contour(smooth(rasterize(particles, settings), settings), settings)
}

/// The most memory that the three stages take for these particles, in bytes: never much less than they do,
/// and up to half as much again. It looks at each particle once.
pub fn memory_estimate_bytes(particles: &Particles, settings: &Settings) -> u64 {
    let Ok(leaves) = rasterize::footprint(particles, &lattice(settings), radii(settings));
    let [surface, area] = [leaves.surface_count, leaves.area_voxels].map(|count| count as f64);
    // Fields that there are at once; and bytes of the mesh, of what measures it and of what makes it, for
    // each face of a voxel that the surface is as large as. Measured on blocks, sheets and spray.
    let smoothing_fields = match settings.integrator {
        Integrator::Fast | Integrator::Explicit => 7.2,
        Integrator::Implicit => 9.2,
    };
    let mesh_bytes = match settings.contouring {
        Contouring::Dual => 80.0,
        Contouring::Tetrahedra => 250.0,
    };
    let field_bytes = size_of::<Leaf>() as f64;
    let stages = [
        // The first surface, its bounds, and what they are swept in.
        field_bytes * 5.2 * surface,
        field_bytes * smoothing_fields * surface,
        field_bytes * 4.0 * surface + mesh_bytes * area,
    ];
    let stages_bytes = stages.into_iter().fold(0.0, f64::max);
    // The particles as they were read and as they are sorted are there all the while; sorting takes more.
    let [beside_bytes, sorting_bytes] = [36.0, 100.0].map(|bytes| bytes * particles.len() as f64);
    (stages_bytes + beside_bytes).max(sorting_bytes) as u64
}

/// The first stage: particles to level sets.
pub fn rasterize(particles: &Particles, settings: &Settings) -> Rasterized {
    let started = Instant::now();
    let Ok(rasterized) = rasterize::rasterize(particles, &lattice(settings), radii(settings));
    let rasterize::Rasterized { bins, band, bounds } = rasterized;
    let mut report = SkinReport {
        particle_count: bins.particle_count,
        dropped_count: bins.dropped_count,
        leaf_count: band.topology.len(),
        ..SkinReport::default()
    };
    report.seconds.rasterize = started.elapsed().as_secs_f64();
    Rasterized { bins, band, bounds, report }
}

/// The second stage: the constrained smoothing.
pub fn smooth(rasterized: Rasterized, settings: &Settings) -> Smoothed {
    let started = Instant::now();
    let Rasterized { bins, mut band, bounds, mut report } = rasterized;
    let smoothed = smooth::smooth(&mut band, &bounds, &smooth_config(settings));
    report.free_voxel_count = smoothed.free_voxel_count;
    report.pass_count = smoothed.pass_count;
    report.moved_count = smoothed.moved_count;
    report.reach_voxels =
        smoothed.reach_voxels.map(|reach| reach.saturating_add(radii(settings).reach_voxels()));
    report.convergence = smoothed.convergence;
    report.cfl_exceeded_count = smoothed.cfl_exceeded_count;
    report.seconds.smooth = started.elapsed().as_secs_f64();
    Smoothed { bins, band, bounds, report }
}

/// The third stage: the mesh, its measures and the certificate.
pub fn contour(smoothed: Smoothed, settings: &Settings) -> Surface {
    let started = Instant::now();
    let Smoothed { bins, band, bounds, mut report } = smoothed;
    let lattice = lattice(settings);
    let mesh = contour::contour(&band, &lattice, settings.contouring);
    report.mesh = mesh.measure();
    report.certificate = certify(&bins, radii(settings), &band, &bounds, &mesh, &report.mesh, &lattice);
    report.bending_energy = contour::bending_energy(&band, &lattice, &mesh);
    report.seconds.contour = started.elapsed().as_secs_f64();
    Surface { band, mesh, report }
}

fn lattice(settings: &Settings) -> Lattice {
    Lattice { voxel_size: settings.voxel_size }
}

/// The radii in voxels.
fn radii(settings: &Settings) -> Radii {
    let voxels = |world: f64| (world / settings.voxel_size) as f32;
    Radii {
        min: voxels(settings.radius_min),
        init: voxels(settings.radius_init),
        max: voxels(settings.radius_max),
    }
}

fn smooth_config(settings: &Settings) -> smooth::Config {
    smooth::Config {
        laplacian_steps: settings.laplacian_steps,
        integrator: settings.integrator,
        steps: settings.steps,
        step_size: settings.step_size as f32,
        redistance_every: settings.redistance_every,
        cg_tolerance: settings.cg_tolerance,
    }
}

/// Memory that a topology takes for a leaf: its origin, its neighbours, and its place in the map.
const TOPOLOGY_LEAF_BYTES: usize = 80;
