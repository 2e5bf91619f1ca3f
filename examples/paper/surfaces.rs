//! The compared programs: meniscus with each of its integrators, and splashsurf.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use glam::{DVec3, IVec3};
use meniscus::surface::grid::{Field, LEAF_EDGE, Leaf, Topology, voxel_in_leaf};
use meniscus::surface::level_set::NarrowBand;
use meniscus::surface::obstacle::{MeshSdf, Obstacle, ObstacleLeaf, ObstacleSdf};
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus::surface::particles::OwnedPositions;
use meniscus::surface::reconstruction::{FrameSurface, reconstruct_frame};
use meniscus::surface::smooth::Integrator;
use meniscus::surface::space::Lattice;
use meniscus_formats::MeshData;
use rayon::prelude::*;

use crate::Outcome;
use crate::splashsurf::{Post, Splashsurf};

/// A program that reconstructs surfaces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Program {
    /// meniscus with this integrator.
    Meniscus(Integrator),
    /// splashsurf with this post-processing.
    Splashsurf(Post),
}

impl Program {
    /// All variants.
    pub(crate) const ALL: [Program; 5] = [
        Program::Meniscus(Integrator::Fast),
        Program::Meniscus(Integrator::Implicit),
        Program::Meniscus(Integrator::Explicit),
        Program::Splashsurf(Post::Plain),
        Program::Splashsurf(Post::Processed),
    ];

    /// meniscus with each of its integrators.
    pub(crate) const OURS: [Program; 3] = [
        Program::Meniscus(Integrator::Fast),
        Program::Meniscus(Integrator::Implicit),
        Program::Meniscus(Integrator::Explicit),
    ];

    /// The default of each program.
    pub(crate) const USUAL: [Program; 3] = [
        Program::Meniscus(Integrator::Fast),
        Program::Splashsurf(Post::Plain),
        Program::Splashsurf(Post::Processed),
    ];

    /// Its name in tables.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Program::Meniscus(Integrator::Fast) => "meniscus, fast",
            Program::Meniscus(Integrator::Implicit) => "meniscus, implicit",
            Program::Meniscus(Integrator::Explicit) => "meniscus, explicit",
            Program::Meniscus(Integrator::Adaptive) => "meniscus, adaptive",
            Program::Splashsurf(Post::Plain) => "splashsurf, plain",
            Program::Splashsurf(Post::Processed) => "splashsurf, post-processed",
            Program::Splashsurf(Post::Wide) => "splashsurf, post-processed, kernel twice as wide",
        }
    }
}

/// The grid and the particle spacing.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scale {
    /// Distance between neighbouring particles, world units.
    pub(crate) spacing: f64,
    /// Edge length of a voxel, or of a cell, world units.
    pub(crate) voxel_size: f64,
    /// Options that do not follow from the voxel size; the function gets the spacing.
    choices: fn(f64) -> MethodOptions,
}

impl Scale {
    /// The default of meniscus: half the spacing.
    pub(crate) fn usual(spacing: f64) -> Scale {
        Scale { spacing, voxel_size: 0.5 * spacing, choices: |_| MethodOptions::default() }
    }

    /// A quarter of the spacing, the cell that splashsurf recommends. The options set the radii, because
    /// radii derived from this voxel size would not reach from one particle to the next.
    pub(crate) fn fine(spacing: f64) -> Scale {
        let choices = |spacing: f64| MethodOptions {
            radius_min: Some(spacing.into()),
            laplacian_steps: Some(30),
            ..MethodOptions::default()
        };
        Scale { spacing, voxel_size: 0.25 * spacing, choices }
    }

    fn settings(self, integrator: Integrator) -> Outcome<Settings> {
        let choices = MethodOptions { integrator: Some(integrator), ..(self.choices)(self.spacing) };
        Ok(Settings::paper(self.voxel_size, &choices)?)
    }
}

/// The mesh that a program makes from particles.
pub(crate) fn mesh_of(
    program: Program,
    peer: &Splashsurf,
    particles: &[DVec3],
    scale: Scale,
) -> Outcome<MeshData> {
    match program {
        Program::Meniscus(integrator) => Ok(data(&reconstructed(particles, scale, integrator)?)),
        Program::Splashsurf(post) => peer.reconstruct(particles, scale.spacing, scale.voxel_size, post),
    }
}

/// The surface that meniscus makes from particles, with all of its data.
pub(crate) fn reconstructed(
    particles: &[DVec3],
    scale: Scale,
    integrator: Integrator,
) -> Outcome<FrameSurface> {
    let positions = particles.iter().map(|particle| particle.to_array()).collect();
    Ok(reconstruct_frame(&OwnedPositions::F64(positions), &scale.settings(integrator)?))
}

/// The level set of a closed mesh, up to a distance of at most 8 voxels. Voxels half as large as the cells of the mesh
/// preserve its edges.
pub(crate) fn band_of(mesh: &MeshData, voxel_size: f64, half_width: f32) -> NarrowBand {
    let all = |_: DVec3| f64::NEG_INFINITY;
    let leaves = leaves_near(mesh.positions.iter().copied(), voxel_size);
    intersection(mesh, voxel_size, half_width, leaves, all)
}

/// The level set of a closed mesh without everything above z.
pub(crate) fn cut_open(mesh: &MeshData, voxel_size: f64, z: f64) -> NarrowBand {
    let mesh_leaves = leaves_near(mesh.positions.iter().copied(), voxel_size);
    let columns: BTreeSet<[i32; 2]> = mesh_leaves.iter().map(|[x, y, _]| [*x, *y]).collect();
    let edge = voxel_size * f64::from(LEAF_EDGE);
    // The cut may be inside even where the parts of the mesh above and below it are far away.
    let sides = [0, 1].map(|axis| {
        let along = || columns.iter().map(|column| column[axis]);
        along().min().unwrap_or(0)..=along().max().unwrap_or(0)
    });
    let [across, up] = &sides;
    let in_cut =
        across.clone().flat_map(|x| up.clone().map(move |y| [f64::from(x) * edge, f64::from(y) * edge, z]));
    let mut leaves = mesh_leaves;
    leaves.extend(leaves_near(in_cut, voxel_size));
    intersection(mesh, voxel_size, HALF_WIDTH, leaves, |at| at.z - z)
}

/// The leaves of these points, and the leaves next to them: triangles reach beyond the leaves of their
/// corners.
fn leaves_near(points: impl Iterator<Item = [f64; 3]>, voxel_size: f64) -> BTreeSet<[i32; 3]> {
    let leaf_of =
        |point: [f64; 3]| (DVec3::from(point) / (voxel_size * f64::from(LEAF_EDGE))).floor().as_ivec3();
    let leaves: BTreeSet<[i32; 3]> = points.map(|point| leaf_of(point).to_array()).collect();
    let around = |leaf: &[i32; 3]| {
        let leaf = IVec3::from(*leaf);
        (0..27).map(move |side| (leaf + IVec3::new(side % 3, side / 3 % 3, side / 9) - 1).to_array())
    };
    leaves.iter().flat_map(around).collect()
}

/// The intersection of a mesh and another body, given by its signed distance, in these leaves.
fn intersection(
    mesh: &MeshData,
    voxel_size: f64,
    half_width: f32,
    leaves: BTreeSet<[i32; 3]>,
    other: impl Fn(DVec3) -> f64 + Sync,
) -> NarrowBand {
    let lattice = Lattice { voxel_size };
    let obstacle = Obstacle::new(ObstacleSdf::Mesh(MeshSdf::new(&mesh.positions, &mesh.triangles)), 0);
    let leaves: Vec<[i32; 3]> = leaves.into_iter().collect();
    let known: Vec<(IVec3, Leaf)> = leaves
        .par_iter()
        .filter_map(|leaf| {
            let origin = IVec3::from(*leaf) * LEAF_EDGE;
            let mut leaf = match obstacle.leaf(origin, &lattice, half_width) {
                ObstacleLeaf::Near(leaf) => Leaf::clone(&leaf),
                ObstacleLeaf::Inside => Leaf::splat(-half_width),
                ObstacleLeaf::Outside => return None,
            };
            for (offset, phi) in leaf.values.iter_mut().enumerate() {
                let at = (origin + voxel_in_leaf(offset)).as_dvec3() * voxel_size;
                *phi = phi.max((other(at) / voxel_size) as f32).min(half_width);
            }
            Some((origin, leaf))
        })
        .collect();
    let topology = Topology::new(known.iter().map(|(origin, _)| *origin).collect());
    let values: HashMap<IVec3, Leaf> = known.into_iter().collect();
    let leaves = topology.origins().iter().filter_map(|origin| values.get(origin).cloned()).collect();
    NarrowBand { topology: Arc::new(topology), phi: Field { leaves }, half_width }
}

/// The half width of the band of our surfaces, in voxels.
pub(crate) const HALF_WIDTH: f32 = 4.0;

/// The mesh of a surface, in world units.
pub(crate) fn data(surface: &FrameSurface) -> MeshData {
    let mesh = &surface.mesh;
    MeshData {
        positions: mesh.positions.iter().map(|at| (mesh.origin + at.as_dvec3()).to_array()).collect(),
        normals: mesh.normals.iter().map(|normal| normal.to_array()).collect(),
        triangles: mesh.triangles.clone(),
    }
}
