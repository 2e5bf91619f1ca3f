//! Renders particles as balls, and marks on a surface as coloured balls.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::light::Lighting;
use super::sky::Sky;
use super::{Camera, Mark, Picture, View};
use meniscus_surface::particles::OwnedPositions;

/// Number of rays along the edge of a pixel.
const SAMPLES: usize = 2;

/// The result of a ray: the distance, and the normal of the ball.
#[derive(Clone, Copy)]
struct Splat {
    depth: f32,
    normal: Vec3,
    /// Index of the ball.
    index: u32,
}

/// A ball, projected to the picture. x and y count rays from the upper left corner of the picture.
#[derive(Clone, Copy)]
struct Disc {
    x: f64,
    y: f64,
    /// Its radius, as a number of rays.
    edge: f64,
    /// Its depth, world units.
    depth: f64,
    index: u32,
}

/// Number of rows of rays per task.
const BAND_ROWS: usize = 64;

/// Renders balls of this radius, world units.
pub(super) fn render(particles: &OwnedPositions, radius: f64, view: &View) -> Picture {
    let splats = draw(particles.len(), |index| particles.position(index), radius, view);
    shade(&splats, view, |lighting, Splat { normal, .. }, toward| {
        lighting.water(lighting.unoccluded(normal), normal, toward, true)
    })
}

/// Renders marks as balls of this radius, world units, each shaded with the normal of the surface that it
/// lies on.
pub(super) fn render_marks(marks: &[Mark], radius: f64, view: &View) -> Picture {
    let splats = draw(marks.len(), |index| marks[index].position, radius, view);
    shade(&splats, view, |lighting, Splat { index, .. }, toward| {
        let Mark { normal, color, .. } = marks[index as usize];
        let normal = normal.as_vec3();
        // A sheet that is seen from behind is shaded like one seen from the front.
        let normal = if normal.dot(toward) < 0.0 { -normal } else { normal };
        lighting.matte(Vec3::from(color), lighting.unoccluded(normal), normal)
    })
}

/// Traces all rays of a picture of balls, and returns their results row by row.
fn draw(count: usize, position: impl Fn(usize) -> DVec3 + Sync, radius: f64, view: &View) -> Vec<Splat> {
    let [columns, rows] = view.size.map(|size| size * SAMPLES);
    let count = u32::try_from(count).unwrap_or(u32::MAX);
    let discs: Vec<Disc> = (0..count)
        .into_par_iter()
        .filter_map(|index| disc(index, position(index as usize), radius, view))
        .collect();
    let nothing = Splat { depth: f32::INFINITY, normal: Vec3::ZERO, index: 0 };
    let mut splats = vec![nothing; columns * rows];
    splats.par_chunks_mut(BAND_ROWS * columns.max(1)).enumerate().for_each(|(band, splats)| {
        let mut band = RowBand { first_row: band * BAND_ROWS, columns, splats };
        discs.iter().for_each(|disc| band.draw(disc, radius, &view.camera));
    });
    splats
}

/// The projection of a ball; `None` if it is behind the camera.
fn disc(index: u32, center: DVec3, radius: f64, view: &View) -> Option<Disc> {
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
    Some(Disc { x, y, edge: (radius * scale).max(0.5), depth, index })
}

/// Some rows of rays.
struct RowBand<'a> {
    first_row: usize,
    columns: usize,
    splats: &'a mut [Splat],
}

impl RowBand<'_> {
    fn draw(&mut self, disc: &Disc, radius: f64, camera: &Camera) {
        let &Disc { x, y, edge, depth, index } = disc;
        let span = |along: f64, count: usize| {
            let first = (along - edge).floor().clamp(0.0, count as f64) as usize;
            first..(along + edge).ceil().clamp(0.0, count as f64) as usize
        };
        let y = y - self.first_row as f64;
        for row in span(y, self.splats.len() / self.columns) {
            for column in span(x, self.columns) {
                let offset = [(column as f64 + 0.5 - x) / edge, (row as f64 + 0.5 - y) / edge];
                let toward = 1.0 - offset[0] * offset[0] - offset[1] * offset[1];
                if toward < 0.0 {
                    continue;
                }
                let toward = toward.sqrt();
                let splat = &mut self.splats[row * self.columns + column];
                let here = (depth - toward * radius) as f32;
                if here < splat.depth {
                    let normal = camera.right * offset[0] - camera.up * offset[1] - camera.forward * toward;
                    *splat = Splat { depth: here, normal: normal.as_vec3(), index };
                }
            }
        }
    }
}

/// Averages the rays of each pixel. `color_of` returns the colour of a ball, as seen from the camera.
fn shade(splats: &[Splat], view: &View, color_of: impl Fn(&Lighting, Splat, Vec3) -> Vec3 + Sync) -> Picture {
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
            let splat = splats[index];
            if splat.depth.is_finite() {
                color += weight * color_of(&lighting, splat, toward);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraPlacement, Up};

    #[test]
    fn marks_show_their_colors_and_occlude_those_behind() {
        let placement =
            CameraPlacement { azimuth_degrees: 0.0, elevation_degrees: 0.0, ..CameraPlacement::AUTO };
        let camera = placement.around([DVec3::NEG_ONE, DVec3::ONE], 2.0);
        let view = View { size: [80, 40], camera, up: Up::Y, ground: None };
        let mark = |x: f64, z: f64, color: [f32; 3]| Mark {
            position: DVec3::new(x, 0.0, z),
            normal: DVec3::Z,
            color,
        };
        let [red, green, blue] = [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]];
        let marks = [mark(-0.8, 0.5, red), mark(0.8, 0.5, green), mark(0.8, -0.5, blue)];
        let picture = render_marks(&marks, 0.3, &view);
        let lit = |color: [f32; 3]| color.map(|part| part > 0.1);
        let at = |x: usize| lit(picture.color[20 * 80 + x]);
        // The box spans 0.88 of half the height: 0.8 is just under 14 pixels from the middle.
        assert_eq!([at(27), at(53)], [[true, false, false], [false, true, false]]);
        assert_eq!(picture.coverage[20 * 80 + 40], 0.0);
        // Marks that are seen from behind are shaded like marks seen from the front.
        let flipped = marks.map(|mark| Mark { normal: -mark.normal, ..mark });
        assert_eq!(render_marks(&flipped, 0.3, &view), picture);
    }
}
