//! A picture of the particles themselves, as balls.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::light::Lighting;
use super::sky::Sky;
use super::{Camera, Picture, View};
use crate::particles::Particles;

/// Rays along the edge of a pixel.
const SAMPLES: usize = 2;

/// What a ray shows: how far it is, and the ball's direction there.
#[derive(Clone, Copy)]
struct Splat {
    depth: f32,
    normal: Vec3,
}

/// A ball as the camera sees it, in rays from the upper left corner of the picture.
#[derive(Clone, Copy)]
struct Disc {
    x: f64,
    y: f64,
    /// Its radius.
    edge: f64,
    /// World units.
    depth: f64,
}

/// Rows of rays that one task draws.
const BAND_ROWS: usize = 64;

/// A picture of balls of this radius, world units.
pub(super) fn render(particles: &Particles, radius: f64, view: &View) -> Picture {
    let [columns, rows] = view.size.map(|size| size * SAMPLES);
    let discs: Vec<Disc> = (0..particles.len())
        .into_par_iter()
        .filter_map(|index| disc(particles.position(index), radius, view))
        .collect();
    let nothing = Splat { depth: f32::INFINITY, normal: Vec3::ZERO };
    let mut splats = vec![nothing; columns * rows];
    splats.par_chunks_mut(BAND_ROWS * columns.max(1)).enumerate().for_each(|(band, splats)| {
        let mut band = Band { first_row: band * BAND_ROWS, columns, splats };
        discs.iter().for_each(|disc| band.draw(disc, radius, &view.camera));
    });
    shade(&splats, view)
}

/// What is seen of a ball; `None` behind the camera.
fn disc(center: DVec3, radius: f64, view: &View) -> Option<Disc> {
    let camera = &view.camera;
    let [columns, rows] = view.size.map(|size| (size * SAMPLES) as f64);
    let to = center - camera.eye;
    let depth = to.dot(camera.forward);
    if depth.is_nan() || depth <= radius {
        return None;
    }
    let scale = rows / (2.0 * camera.tan_half_view * depth);
    let x = columns / 2.0 + to.dot(camera.right) * scale;
    let y = rows / 2.0 - to.dot(camera.up) * scale;
    Some(Disc { x, y, edge: (radius * scale).max(0.5), depth })
}

/// Some rows of the rays.
struct Band<'a> {
    first_row: usize,
    columns: usize,
    splats: &'a mut [Splat],
}

impl Band<'_> {
    fn draw(&mut self, disc: &Disc, radius: f64, camera: &Camera) {
        let &Disc { x, y, edge, depth } = disc;
        let span = |along: f64, count: usize| {
            let first = (along - edge).floor().clamp(0.0, count as f64) as usize;
            first..(along + edge).ceil().clamp(0.0, count as f64) as usize
        };
        let y = y - self.first_row as f64;
        for row in span(y, self.splats.len() / self.columns) {
            for column in span(x, self.columns) {
                let aside = [(column as f64 + 0.5 - x) / edge, (row as f64 + 0.5 - y) / edge];
                let toward = 1.0 - aside[0] * aside[0] - aside[1] * aside[1];
                if toward < 0.0 {
                    continue;
                }
                let toward = toward.sqrt();
                let splat = &mut self.splats[row * self.columns + column];
                let here = (depth - toward * radius) as f32;
                if here < splat.depth {
                    let normal = camera.right * aside[0] - camera.up * aside[1] - camera.forward * toward;
                    *splat = Splat { depth: here, normal: normal.as_vec3() };
                }
            }
        }
    }
}

/// Pixels are the means of their rays.
fn shade(splats: &[Splat], view: &View) -> Picture {
    let [width, height] = view.size;
    let sky = Sky::empty();
    let lighting = Lighting::new(&sky, view);
    let toward = -view.camera.forward.as_vec3();
    let weight = 1.0 / (SAMPLES * SAMPLES) as f32;
    let pixel = |pixel: usize| {
        let (x, y) = (pixel % width * SAMPLES, pixel / width * SAMPLES);
        let (mut color, mut coverage) = (Vec3::ZERO, 0.0);
        for sample in 0..SAMPLES * SAMPLES {
            let index = (y + sample / SAMPLES) * width * SAMPLES + x + sample % SAMPLES;
            let Splat { depth, normal } = splats[index];
            if depth.is_finite() {
                color += weight * lighting.water(lighting.open(normal), normal, toward, true);
                coverage += weight;
            } else {
                color += weight * lighting.background();
            }
        }
        (color.to_array(), coverage)
    };
    let (color, coverage) = (0..width * height).into_par_iter().map(pixel).unzip();
    Picture { size: view.size, color, coverage, data: None }
}
