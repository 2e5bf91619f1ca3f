//! A static pool and a drop that flies over it: measures how much the surface of the pool changes.
//!
//! ```text
//!        o ──▶ o ──▶ o           the drop, in 24 frames
//!   ≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈    the pool: the same particles in each frame
//! ```
//!
//! Each frame is reconstructed without the others, on a grid that does not depend on the particles, and
//! smoothing does not couple surfaces through air. So the surface of the pool is bit-identical in all frames.
//! Implicit steps are the exception: conjugate gradients stop when the whole frame is close enough to the
//! solution, so the drop changes the whole frame a little.
//!
//! A vertex has changed if the other frame has no vertex with exactly the same bits, whether it is new or
//! gone. Its movement is its distance to the surface of the other frame.

use std::collections::HashSet;
use std::path::Path;

use glam::{DVec3, IVec3};
use meniscus::render::{CameraPlacement, Layers, Picture, View, render};
use meniscus::surface::obstacle::MeshSdf;
use meniscus::surface::smooth::Integrator;
use meniscus::surface::space::Lattice;

use crate::Outcome;
use crate::output::Files;
use crate::samples::Random;
use crate::splashsurf::{Post, Splashsurf};
use crate::surfaces::{Program, Scale, mesh_of, reconstructed};

const FRAMES: usize = 24;

/// Number of particles along, down and across the pool.
const POOL: [i32; 3] = [48, 6, 32];

/// Height of the centre of the drop above the pool, in spacings.
const HEIGHT: f64 = 14.0;

/// Radius of the drop, in spacings.
const RADIUS: f64 = 4.0;

/// Measures the changes of the pool for each program.
pub(crate) fn run(folder: &Path) -> Outcome<()> {
    let peer = Splashsurf::find()?;
    let files = Files::new(folder, "drop");
    let programs = [
        Program::Meniscus(Integrator::Fast),
        Program::Meniscus(Integrator::Explicit),
        Program::Meniscus(Integrator::Implicit),
        Program::Splashsurf(Post::Plain),
        Program::Splashsurf(Post::Processed),
    ];
    let rows = programs.map(|program| Ok(changes(program, &peer)?.row(program)));
    files.table(
        "frames",
        &[
            "program",
            "vertices of the pool",
            "vertices changed in a frame, minimum",
            "maximum",
            "largest movement, h",
        ],
        &rows.into_iter().collect::<Outcome<Vec<_>>>()?,
    )?;
    let pictures: Outcome<Vec<_>> = [0, FRAMES / 2, FRAMES - 1].into_iter().map(picture).collect();
    files.pictures("frames", vec![pictures?])
}

/// Changes of the pool's vertices from frame to frame.
struct Changes {
    vertex_count: usize,
    least: usize,
    most: usize,
    /// The largest movement of a vertex, in units of h.
    farthest: f64,
}

impl Changes {
    fn row(&self, program: Program) -> Vec<String> {
        let Changes { vertex_count, least, most, farthest } = self;
        let farthest = if *farthest == 0.0 { "0".to_owned() } else { format!("{farthest:.0e}") };
        vec![program.name().into(), vertex_count.to_string(), least.to_string(), most.to_string(), farthest]
    }
}

fn changes(program: Program, peer: &Splashsurf) -> Outcome<Changes> {
    let scale = Scale::usual(1.0);
    let pool = pool();
    let mut changes = Changes { vertex_count: 0, least: usize::MAX, most: 0, farthest: 0.0 };
    let mut before: Option<(HashSet<[u64; 3]>, MeshSdf)> = None;
    for frame in 0..FRAMES {
        let particles = [&pool[..], &drop_at(frame)].concat();
        let mesh = mesh_of(program, peer, &particles, scale)?;
        let vertices: Vec<DVec3> = mesh.positions.iter().map(|&position| position.into()).collect();
        let vertices: Vec<DVec3> = vertices.into_iter().filter(|vertex| vertex.y < 0.5 * HEIGHT).collect();
        if let Some((known, surface)) = &before {
            let changed: Vec<&DVec3> =
                vertices.iter().filter(|vertex| !known.contains(&bits(vertex))).collect();
            let distances = changed.iter().filter_map(|vertex| surface.distance(**vertex));
            let farthest = distances.map(f64::abs).fold(0.0, f64::max) / scale.voxel_size;
            changes.farthest = changes.farthest.max(farthest);
            // Vertices that disappeared have changed, too.
            let kept_count = vertices.len() - changed.len();
            let changed_count = changed.len().max(known.len().saturating_sub(kept_count));
            changes.least = changes.least.min(changed_count);
            changes.most = changes.most.max(changed_count);
        }
        changes.vertex_count = vertices.len();
        before = Some((vertices.iter().map(bits).collect(), MeshSdf::new(&mesh.positions, &mesh.triangles)));
    }
    Ok(changes)
}

fn picture(frame: usize) -> Outcome<(Picture, String)> {
    let scale = Scale::usual(1.0);
    let particles = [&pool()[..], &drop_at(frame)].concat();
    let surface = reconstructed(&particles, scale, Integrator::Fast)?;
    let [along, down, across] = POOL.map(f64::from);
    let bounds = [DVec3::new(0.0, -down, 0.0), DVec3::new(along, HEIGHT + RADIUS, across)];
    let size = [400, 240];
    let view = View {
        size,
        camera: CameraPlacement::AUTO.around(bounds, size[0] as f64 / size[1] as f64),
        up: CameraPlacement::AUTO.up,
        ground: None,
    };
    let lattice = Lattice { voxel_size: scale.voxel_size };
    let layers = Layers { data: false, velocity: None };
    Ok((render(&surface.band, &lattice, &view, layers), format!("frame {frame}")))
}

fn bits(vertex: &DVec3) -> [u64; 3] {
    vertex.to_array().map(f64::to_bits)
}

/// A lattice whose points are displaced by up to a fifth of a spacing, at most 0 high.
fn pool() -> Vec<DVec3> {
    let mut random = Random::new(20);
    let [along, down, across] = POOL;
    let cells = (0..along * down * across)
        .map(|index| IVec3::new(index % along, -(index / along % down), index / (along * down)));
    cells.map(|cell| cell.as_dvec3() + random.in_ball(0.2)).collect()
}

/// The drop moves along the pool by a non-integer number of voxels per frame.
fn drop_at(frame: usize) -> Vec<DVec3> {
    let reach = RADIUS as i32;
    let middle = DVec3::new(4.0 + 1.7 * frame as f64, HEIGHT, 0.5 * f64::from(POOL[2]));
    let lattice = -reach..=reach;
    let points = lattice.clone().flat_map(|x| {
        lattice.clone().flat_map(move |y| (-reach..=reach).map(move |z| IVec3::new(x, y, z).as_dvec3()))
    });
    points.filter(|point| point.length() <= RADIUS).map(|point| middle + point).collect()
}
