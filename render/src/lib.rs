//! Renders a picture of a level set directly from φ, without a mesh; or of the triangles of a mesh, with the
//! same light.
//!
//! ```text
//!   camera ──ray──▶ surface, ground or nothing ──▶ incoming light ──▶ colour
//!    every pixel      first root of a cubic in a cell,   one pixel of 4 × 4     edges: mean of eight rays
//!                     or the nearest triangle
//! ```
//!
//! Smooth features are sampled sparsely: light is computed for one pixel of sixteen and interpolated between
//! points in one plane. Sharp features are sampled densely: where neighbouring pixels show different
//! surfaces, a pixel is the mean of eight rays. Each pixel depends only on the frame and the view, not on the
//! number of threads.
//!
//! The back side of the surface is orange. It is visible only if φ has a wrong sign, if triangles are
//! clockwise seen from outside, or if the surface has a hole.

#![warn(clippy::match_bool)]

mod balls;
mod camera;
mod mesh;
mod sheet;
mod sky;
mod surface;
mod tile;
mod tree;

use glam::DVec3;
use meniscus_surface::checkpoint;
use meniscus_surface::grid::Field;
use meniscus_surface::level_set::NarrowBand;
use meniscus_surface::particles::OwnedPositions;
use meniscus_surface::space::Lattice;
use rayon::prelude::*;

pub use balls::Balls;
pub use camera::{Camera, CameraPlacement, Up};
pub use mesh::TriangleMesh;
pub use sheet::{Cell, CellGroup, CellPicture, Line, Plot, Sheet, side_by_side, stacked};

use balls::WithBalls;
use mesh::RayMesh;
use sky::Sky;
use surface::RaySurface;
use tile::{FinishedTile, Lighting, PixelTile, RayTarget, TILE_EDGE, Tracer};

/// The view: camera, picture size and ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Width and height, pixels.
    pub size: [usize; 2],
    /// The camera.
    pub camera: Camera,
    /// Which way is up.
    pub up: Up,
    /// Height of the ground, world units; `None` for no ground.
    pub ground: Option<f64>,
}

/// A picture: the values of its pixels, row by row from the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width and height, pixels.
    pub size: [usize; 2],
    /// Linear colour with the primaries of sRGB; 1 is white.
    pub color: Vec<[f32; 3]>,
    /// The fraction of each pixel that the surface covers.
    pub coverage: Vec<f32>,
    /// Data at the centre of each pixel; `None` unless requested.
    pub data: Option<PictureData>,
}

/// Data at the centre of each pixel.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PictureData {
    /// Distance from the camera along its axis, world units; [`FAR`] if the pixel shows no surface.
    pub depth: Vec<f32>,
    /// Outward unit normals in world space; 0 if the pixel shows no surface.
    pub normals: Vec<[f32; 3]>,
    /// Positions in world units; 0 if the pixel shows no surface.
    pub positions: Vec<[f32; 3]>,
    /// Velocities in world units per second; `None` if the frame has none.
    pub velocities: Option<Vec<[f32; 3]>>,
    /// Mean curvature, per world unit; positive where the fluid is convex.
    pub curvatures: Vec<f32>,
}

/// The depth of pixels without a surface.
pub const FAR: f32 = 1e10;

/// Optional layers of a picture.
#[derive(Clone, Copy, Debug)]
pub struct Layers<'a> {
    /// Whether to fill in [`Picture::data`].
    pub data: bool,
    /// The x, y and z components of the velocities at the voxels of the band, world units per second.
    pub velocity: Option<&'a [Field; 3]>,
}

/// Renders a level set.
pub fn render(band: &NarrowBand, lattice: &Lattice, view: &View, layers: Layers) -> Picture {
    let (surface, sky) = rayon::join(|| RaySurface::new(band, layers.velocity), || Sky::new(band));
    trace((&surface, lattice.voxel_size), &sky, view, layers)
}

/// Renders a level set and the balls beside it.
pub fn render_with_balls(
    band: &NarrowBand,
    lattice: &Lattice,
    balls: Balls<'_>,
    view: &View,
    layers: Layers,
) -> Picture {
    let (surface, sky) = rayon::join(|| RaySurface::new(band, layers.velocity), || Sky::new(band));
    let surface = WithBalls::new(&surface, balls, lattice.voxel_size);
    trace((&surface, lattice.voxel_size), &sky, view, layers)
}

/// Renders a mesh. `data` says whether to fill in [`Picture::data`].
pub fn render_mesh(mesh: &TriangleMesh, view: &View, data: bool) -> Picture {
    let surface = RayMesh::new(mesh);
    let sky = Sky::of_mesh(&surface);
    trace((&surface, surface.voxel_size), &sky, view, Layers { data, velocity: None })
}

/// Renders a surface with this voxel size, world units.
fn trace<S: RayTarget>((surface, voxel_size): (&S, f64), sky: &Sky, view: &View, layers: Layers) -> Picture {
    let tracer = Tracer::new(surface, voxel_size, view);
    let lighting = Lighting::new(sky, view);
    assemble(view.size, |origin| PixelTile::new(&tracer, &lighting, origin).finish(layers))
}

/// Renders particles as balls of this radius, world units, with the same lighting.
pub fn render_particles(particles: &OwnedPositions, radius: f64, view: &View) -> Picture {
    tile::render(particles, radius, view)
}

/// A coloured point on a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// Position, world units.
    pub position: DVec3,
    /// Outward unit normal.
    pub normal: DVec3,
    /// Linear colour with the primaries of sRGB.
    pub color: [f32; 3],
}

/// Renders marks as balls of this radius, world units, in front of the background.
pub fn render_marks(marks: &[Mark], radius: f64, view: &View) -> Picture {
    tile::render_marks(marks, radius, view)
}

/// Assembles a picture from its tiles.
fn assemble(size: [usize; 2], tile: impl Fn([usize; 2]) -> FinishedTile + Sync) -> Picture {
    let [width, height] = size;
    let (columns, rows) = (width.div_ceil(TILE_EDGE), height.div_ceil(TILE_EDGE));
    let origin = |index: usize| [index % columns * TILE_EDGE, index / columns * TILE_EDGE];
    let checked = |index: usize| {
        checkpoint();
        tile(origin(index))
    };
    let tiles: Vec<FinishedTile> = (0..columns * rows).into_par_iter().map(checked).collect();
    let gather = Gather { size, columns };
    let of_data = |pick: &dyn Fn(&PictureData) -> &[[f32; 3]]| {
        gather.rows(&tiles, |tile| tile.data.as_ref().map_or(&[][..], pick))
    };
    let numbers = |pick: &dyn Fn(&PictureData) -> &[f32]| {
        gather.rows(&tiles, |tile| tile.data.as_ref().map_or(&[][..], pick))
    };
    let has =
        |test: &dyn Fn(&PictureData) -> bool| tiles.iter().any(|tile| tile.data.as_ref().is_some_and(test));
    let data = has(&|_| true).then(|| PictureData {
        depth: numbers(&|data| &data.depth),
        normals: of_data(&|data| &data.normals),
        positions: of_data(&|data| &data.positions),
        velocities: has(&|data| data.velocities.is_some())
            .then(|| of_data(&|data| data.velocities.as_deref().unwrap_or_default())),
        curvatures: numbers(&|data| &data.curvatures),
    });
    Picture {
        size,
        color: gather.rows(&tiles, |tile| &tile.color),
        coverage: gather.rows(&tiles, |tile| &tile.coverage),
        data,
    }
}

/// The layout of the tiles in a picture.
struct Gather {
    size: [usize; 2],
    columns: usize,
}

impl Gather {
    fn rows<'t, T: Copy + 't>(
        &self,
        tiles: &'t [FinishedTile],
        values: impl Fn(&'t FinishedTile) -> &'t [T],
    ) -> Vec<T> {
        let [width, height] = self.size;
        let mut all = Vec::with_capacity(width * height);
        for y in 0..height {
            for column in 0..self.columns {
                let of_tile = values(&tiles[y / TILE_EDGE * self.columns + column]);
                let first = y % TILE_EDGE * TILE_EDGE;
                let count = TILE_EDGE.min(width - column * TILE_EDGE);
                all.extend_from_slice(&of_tile[first..first + count]);
            }
        }
        all
    }
}
