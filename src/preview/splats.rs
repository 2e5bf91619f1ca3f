//! A picture of the particles themselves, as balls.

use glam::{DVec3, Vec3};

use super::light::Lighting;
use super::sky::Sky;
use super::{Picture, View};
use crate::particles::Particles;

/// Rays along the edge of a pixel.
const SAMPLES: usize = 2;

/// What a ray shows: how far it is, and the ball's direction there.
#[derive(Clone, Copy)]
struct Splat {
    depth: f32,
    normal: Vec3,
}

/// A picture of balls of this radius, world units.
pub(super) fn render(particles: &Particles, radius: f64, view: &View) -> Picture {
    let [width, height] = view.size;
    let (columns, rows) = (width * SAMPLES, height * SAMPLES);
    let mut splats = vec![Splat { depth: f32::INFINITY, normal: Vec3::ZERO }; columns * rows];
    let camera = &view.camera;
    let scale = rows as f64 / (2.0 * camera.tan_half_view);
    for index in 0..particles.len() {
        let to = particles.position(index) - camera.eye;
        let depth = to.dot(camera.forward);
        if depth.is_nan() || depth <= radius {
            continue;
        }
        let (x, y) = (to.dot(camera.right) / depth * scale, -to.dot(camera.up) / depth * scale);
        let (x, y) = (x + columns as f64 / 2.0, y + rows as f64 / 2.0);
        let edge = (radius / depth * scale).max(0.5);
        let span = |along: f64, count: usize| {
            let first = (along - edge).floor().clamp(0.0, count as f64) as usize;
            first..(along + edge).ceil().clamp(0.0, count as f64) as usize
        };
        for row in span(y, rows) {
            for column in span(x, columns) {
                let aside = [(column as f64 + 0.5 - x) / edge, (row as f64 + 0.5 - y) / edge];
                let toward = 1.0 - aside[0] * aside[0] - aside[1] * aside[1];
                if toward < 0.0 {
                    continue;
                }
                let toward = toward.sqrt();
                let splat = &mut splats[row * columns + column];
                let here = (depth - toward * radius) as f32;
                if here < splat.depth {
                    let normal: DVec3 =
                        camera.right * aside[0] - camera.up * aside[1] - camera.forward * toward;
                    *splat = Splat { depth: here, normal: normal.as_vec3() };
                }
            }
        }
    }
    shade(&splats, view)
}

/// Pixels are the means of their rays.
fn shade(splats: &[Splat], view: &View) -> Picture {
    let [width, height] = view.size;
    let sky = Sky::empty();
    let lighting = Lighting::new(&sky, view);
    let toward = -view.camera.forward.as_vec3();
    let mut picture = Picture { size: view.size, color: Vec::new(), coverage: Vec::new(), data: None };
    let weight = 1.0 / (SAMPLES * SAMPLES) as f32;
    for pixel in 0..width * height {
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
        picture.color.push(color.to_array());
        picture.coverage.push(coverage);
    }
    picture
}
