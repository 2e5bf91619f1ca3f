//! A tile of a picture, with a border. The border contains the pixels outside of the tile that its own pixels
//! are compared with, or whose light is interpolated.

use glam::{DVec2, DVec3, Vec3};
use meniscus_surface::particles::OwnedPositions;
use rayon::prelude::*;

use crate::sky::Sky;
use crate::surface::Ray;
use crate::{Camera, FAR, Layers, Mark, Picture, PictureData, View};

/// Edge of a tile, pixels.
pub(super) const TILE_EDGE: usize = 64;

/// Border of a tile, pixels: wide enough to contain the nearest points with computed light outside the tile.
const BORDER: usize = 4;

const TRACED_EDGE: usize = TILE_EDGE + 2 * BORDER;

/// Distance between points with computed light, pixels.
const LIGHT_STEP: usize = 4;

const LIGHT_EDGE: usize = TRACED_EDGE / LIGHT_STEP;

/// A surface that rays are traced to. Lengths are in voxels.
pub(super) trait RayTarget: Sync {
    /// The surface at a hit.
    type Local;

    /// The first hit of a ray: t, whether the ray came from outside, and the surface there.
    fn hit(&self, ray: &Ray) -> Option<(f64, bool, Self::Local)>;

    /// The outward normal, of any length.
    fn outward(&self, local: &Self::Local) -> Vec3;

    /// The mean curvature, per voxel: positive where the fluid is convex.
    fn mean_curvature(&self, local: &Self::Local) -> f32;

    /// The velocity, world units per second; `None` if the surface has no velocities.
    fn velocity(&self, _: &Self::Local) -> Option<[f32; 3]> {
        None
    }
}

/// Traces rays through pixels. Lengths are in voxels.
pub(super) struct Tracer<'a, S> {
    surface: &'a S,
    view: &'a View,
    voxel_size: f64,
    /// The position of the camera, in voxels.
    eye: DVec3,
}

/// The result of a ray.
#[derive(Clone, Copy, Debug)]
struct RayHit {
    what: HitKind,
    /// Distance from the camera, in voxels.
    t: f64,
    /// Position, in voxels.
    position: DVec3,
    normal: Vec3,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum HitKind {
    Nothing,
    Ground,
    Outside,
    Inside,
}

impl<'a, S: RayTarget> Tracer<'a, S> {
    pub(super) fn new(surface: &'a S, voxel_size: f64, view: &'a View) -> Tracer<'a, S> {
        Tracer { surface, view, voxel_size, eye: view.camera.eye / voxel_size }
    }

    /// The ray through a point of the picture, in pixels from its upper left corner.
    fn ray(&self, point: DVec2) -> Ray {
        let [width, height] = self.view.size.map(|size| size as f64);
        let direction = DVec2::new(2.0 * point.x - width, height - 2.0 * point.y) / height;
        Ray::new(self.eye, self.view.camera.direction(direction))
    }

    /// The edge of a pixel at this distance, in voxels.
    fn pixel_edge(&self, t: f64) -> f64 {
        2.0 * self.view.camera.tan_half_view * t / self.view.size[1] as f64
    }

    fn trace(&self, point: DVec2) -> (RayHit, Option<S::Local>) {
        let ray = self.ray(point);
        // The ground only receives shadows. It hides nothing, because fluid may be below it, or rest on it
        // without a gap.
        if let Some((t, is_front, local)) = self.surface.hit(&ray) {
            let outward = self.surface.outward(&local).normalize_or(-ray.direction.as_vec3());
            let (what, normal) =
                if is_front { (HitKind::Outside, outward) } else { (HitKind::Inside, -outward) };
            return (RayHit { what, t, position: ray.at(t), normal }, Some(local));
        }
        let up = self.view.up.direction().as_vec3();
        let seen = match self.ground_at(&ray) {
            Some(t) => RayHit { what: HitKind::Ground, t, position: ray.at(t), normal: up },
            None => {
                RayHit { what: HitKind::Nothing, t: f64::INFINITY, position: DVec3::INFINITY, normal: up }
            }
        };
        (seen, None)
    }

    /// Where a ray hits the ground from above.
    fn ground_at(&self, ray: &Ray) -> Option<f64> {
        let up = self.view.up.direction();
        let above = ray.origin.dot(up) - self.view.ground? / self.voxel_size;
        let descent = -ray.direction.dot(up);
        (above > 0.0 && descent > 1e-6).then(|| above / descent)
    }
}

/// The rays of a tile's pixels and its border.
pub(super) struct PixelTile<'a, S: RayTarget> {
    tracer: &'a Tracer<'a, S>,
    lighting: &'a Lighting<'a>,
    /// The first pixel, including the border. It may be outside of the picture.
    first: [isize; 2],
    seen: Vec<RayHit>,
    locals: Vec<Option<S::Local>>,
    /// The light at one pixel of every `LIGHT_STEP` × `LIGHT_STEP`; `None` if its ray hit nothing.
    lights: Vec<Option<Light>>,
}

/// A finished tile: the values of its pixels, row by row.
pub(super) struct FinishedTile {
    pub(super) color: Vec<[f32; 3]>,
    pub(super) coverage: Vec<f32>,
    pub(super) data: Option<PictureData>,
}

impl<'a, S: RayTarget> PixelTile<'a, S> {
    /// The tile whose first pixel is `first_pixel`.
    pub(super) fn new(
        tracer: &'a Tracer<'a, S>,
        lighting: &'a Lighting<'a>,
        first_pixel: [usize; 2],
    ) -> PixelTile<'a, S> {
        let first = first_pixel.map(|along| along as isize - BORDER as isize);
        let mut tile =
            PixelTile { tracer, lighting, first, seen: Vec::new(), locals: Vec::new(), lights: Vec::new() };
        for y in 0..TRACED_EDGE {
            for x in 0..TRACED_EDGE {
                let (seen, local) = tracer.trace(tile.pixel_corner(x, y) + 0.5);
                tile.seen.push(seen);
                tile.locals.push(local);
            }
        }
        for y in 0..LIGHT_EDGE {
            for x in 0..LIGHT_EDGE {
                let [x, y] = [x, y].map(|along| along * LIGHT_STEP + LIGHT_STEP / 2);
                let light = tile.trace_light(x, y);
                tile.lights.push(light);
            }
        }
        tile
    }

    /// A pixel's upper left corner in the picture.
    fn pixel_corner(&self, x: usize, y: usize) -> DVec2 {
        DVec2::new((self.first[0] + x as isize) as f64, (self.first[1] + y as isize) as f64)
    }

    fn trace_light(&self, x: usize, y: usize) -> Option<Light> {
        let seen = &self.seen[y * TRACED_EDGE + x];
        (seen.what != HitKind::Nothing).then(|| self.lighting.incoming(seen.position, seen.normal))
    }

    /// Shades the tile's own pixels.
    pub(super) fn finish(&self, layers: Layers) -> FinishedTile {
        let own = BORDER..BORDER + TILE_EDGE;
        let lit: Vec<Light> = (0..TRACED_EDGE * TRACED_EDGE)
            .map(|index| {
                let (x, y) = (index % TRACED_EDGE, index / TRACED_EDGE);
                let is_near_own = |along: usize| (BORDER - 1..BORDER + TILE_EDGE + 1).contains(&along);
                if is_near_own(x) && is_near_own(y) { self.light_at(x, y) } else { Light::NONE }
            })
            .collect();
        let pixels = || own.clone().flat_map(|y| own.clone().map(move |x| (x, y)));
        let mut finished = FinishedTile { color: Vec::new(), coverage: Vec::new(), data: None };
        for (x, y) in pixels() {
            let (color, coverage) =
                if self.is_edge(x, y) { self.mean(&lit, x, y) } else { self.single(&lit, x, y) };
            finished.color.push(color.to_array());
            finished.coverage.push(coverage);
        }
        if layers.data {
            let mut data =
                PictureData { velocities: layers.velocity.map(|_| Vec::new()), ..PictureData::default() };
            pixels().for_each(|(x, y)| self.push_data(&mut data, x, y));
            finished.data = Some(data);
        }
        finished
    }

    /// The light at a pixel, interpolated from those of the four surrounding points with computed light that
    /// lie in the plane of the pixel's surface.
    fn light_at(&self, x: usize, y: usize) -> Light {
        let seen = self.seen[y * TRACED_EDGE + x];
        if seen.what == HitKind::Nothing {
            return Light::NONE;
        }
        let [(x_light, x_part), (y_light, y_part)] = [x, y].map(|along| {
            let along = (along as f32 - (LIGHT_STEP / 2) as f32) / LIGHT_STEP as f32;
            (along.floor() as usize, along.fract())
        });
        let position = seen.position;
        let tolerance = (PLANE_TOLERANCE * LIGHT_STEP as f64 * self.tracer.pixel_edge(seen.t)) as f32;
        let contact = CONTACT_VOXELS.max(CONTACT_PIXELS * self.tracer.pixel_edge(seen.t));
        let (mut sum, mut weights) = (Light::NONE, 0.0);
        for corner in 0..4 {
            let (right, down) = (corner & 1, corner >> 1);
            let (x_light, y_light) = (x_light + right, y_light + down);
            if x_light >= LIGHT_EDGE || y_light >= LIGHT_EDGE {
                continue;
            }
            let Some(light) = self.lights[y_light * LIGHT_EDGE + x_light] else { continue };
            let [x_seen, y_seen] = [x_light, y_light].map(|along| along * LIGHT_STEP + LIGHT_STEP / 2);
            let other = self.seen[y_seen * TRACED_EDGE + x_seen];
            let is_contact = seen.what == HitKind::Ground
                && matches!(other.what, HitKind::Outside | HitKind::Inside)
                && other.position.distance(position) < contact;
            if is_contact {
                return self.lighting.incoming(position, seen.normal);
            }
            let apart = (other.position - position).as_vec3().dot(seen.normal).abs();
            let alike = other.normal.dot(seen.normal).max(0.0).powi(8) * (1.0 - apart / tolerance).max(0.0);
            if other.what != seen.what || alike <= 0.0 {
                continue;
            }
            let across = if right == 1 { x_part } else { 1.0 - x_part };
            let along = if down == 1 { y_part } else { 1.0 - y_part };
            let weight = across * along * alike;
            (sum, weights) = (sum.plus(light, weight), weights + weight);
        }
        if weights < MIN_WEIGHT {
            self.lighting.incoming(position, seen.normal)
        } else {
            sum.times(1.0 / weights)
        }
    }

    /// Whether there is an edge between the pixel and one of its four neighbours.
    fn is_edge(&self, x: usize, y: usize) -> bool {
        let seen = self.seen[y * TRACED_EDGE + x];
        let position = seen.position;
        [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)].into_iter().any(|(x, y)| {
            let other = self.seen[y * TRACED_EDGE + x];
            // Ground and background have the same colour.
            let is_fluid = |what: HitKind| matches!(what, HitKind::Outside | HitKind::Inside);
            if other.what != seen.what {
                return is_fluid(other.what) || is_fluid(seen.what);
            }
            if !is_fluid(seen.what) {
                return false;
            }
            let apart = (other.position - position).as_vec3().dot(seen.normal).abs();
            let is_step = apart > (EDGE_STEP * self.tracer.pixel_edge(seen.t)) as f32;
            other.normal.dot(seen.normal) < EDGE_COSINE || is_step
        })
    }

    fn single(&self, lit: &[Light], x: usize, y: usize) -> (Vec3, f32) {
        let index = y * TRACED_EDGE + x;
        let toward = -self.tracer.ray(self.pixel_corner(x, y) + 0.5).direction.as_vec3();
        self.shade(&self.seen[index], lit[index], toward)
    }

    /// The mean of eight rays through a pixel.
    fn mean(&self, lit: &[Light], x: usize, y: usize) -> (Vec3, f32) {
        let (mut color, mut coverage) = (Vec3::ZERO, 0.0);
        for offset in OFFSETS {
            let point = self.pixel_corner(x, y) + offset;
            let (seen, _) = self.tracer.trace(point);
            let toward = -self.tracer.ray(point).direction.as_vec3();
            let light = self.light_of(&seen, lit, x, y);
            let (one, covers) = self.shade(&seen, light, toward);
            // A highlight must not outshine the rest of the pixel.
            color += one.min(Vec3::splat(2.0)) / OFFSETS.len() as f32;
            coverage += covers / OFFSETS.len() as f32;
        }
        (color, coverage)
    }

    /// The light for a ray within a pixel: the light of the pixel itself, or of a neighbour, if it shows the
    /// same surface. Otherwise the light is computed.
    fn light_of(&self, seen: &RayHit, lit: &[Light], x: usize, y: usize) -> Light {
        if seen.what == HitKind::Nothing {
            return Light::NONE;
        }
        let position = seen.position;
        let within = (2.5 * self.tracer.pixel_edge(seen.t)).powi(2);
        let neighbors = [(x, y), (x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)];
        let alike = neighbors.into_iter().find(|&(x, y)| {
            let other = self.seen[y * TRACED_EDGE + x];
            other.what == seen.what
                && other.normal.dot(seen.normal) > EDGE_COSINE
                && (seen.what == HitKind::Ground || other.position.distance_squared(position) < within)
        });
        match alike {
            Some((x, y)) => lit[y * TRACED_EDGE + x],
            None => self.lighting.incoming(position, seen.normal),
        }
    }

    fn shade(&self, seen: &RayHit, light: Light, toward: Vec3) -> (Vec3, f32) {
        match seen.what {
            HitKind::Nothing => (self.lighting.background(), 0.0),
            HitKind::Ground => (self.lighting.ground(light), 0.0),
            HitKind::Outside => (self.lighting.water(light, seen.normal, toward, true), 1.0),
            HitKind::Inside => (self.lighting.water(light, seen.normal, toward, false), 1.0),
        }
    }

    fn push_data(&self, data: &mut PictureData, x: usize, y: usize) {
        let index = y * TRACED_EDGE + x;
        let Tracer { surface, voxel_size, view, .. } = *self.tracer;
        let camera = &view.camera;
        let Some(local) = &self.locals[index] else {
            data.depth.push(FAR);
            data.normals.push([0.0; 3]);
            data.positions.push([0.0; 3]);
            data.curvatures.push(0.0);
            if let Some(velocities) = &mut data.velocities {
                velocities.push([0.0; 3]);
            }
            return;
        };
        let position = self.seen[index].position * voxel_size;
        data.depth.push((position - camera.eye).dot(camera.forward) as f32);
        data.normals.push(surface.outward(local).normalize_or_zero().to_array());
        data.positions.push(position.as_vec3().to_array());
        data.curvatures.push((f64::from(surface.mean_curvature(local)) / voxel_size) as f32);
        if let Some(velocities) = &mut data.velocities {
            velocities.push(surface.velocity(local).unwrap_or_default());
        }
    }
}

/// A point counts as in the plane of a pixel's surface if its offset from the plane is less than this
/// fraction of the distance between points with computed light.
const PLANE_TOLERANCE: f64 = 0.7;

/// Ground that is closer to the fluid than the larger of these limits, in voxels and in pixels, gets computed
/// light instead of interpolated light: where ground and fluid touch, light fades within a voxel.
const CONTACT_VOXELS: f64 = 6.0;
const CONTACT_PIXELS: f64 = 3.0 * LIGHT_STEP as f64;

/// If the weights of the interpolated points have a smaller sum, the light is computed for the pixel itself.
const MIN_WEIGHT: f32 = 0.3;

/// There is an edge between two neighbouring pixels if their points are more than `EDGE_STEP` pixel edges
/// apart along the normal, or if the cosine of the angle between their normals is less than `EDGE_COSINE`.
const EDGE_STEP: f64 = 1.5;
const EDGE_COSINE: f32 = 0.94;

/// Eight points in a pixel. On a grid of 8 × 8 in the pixel, no two points share a row or a column.
const OFFSETS: [DVec2; 8] = [
    DVec2::new(0.0625, 0.4375),
    DVec2::new(0.1875, 0.8125),
    DVec2::new(0.3125, 0.1875),
    DVec2::new(0.4375, 0.6875),
    DVec2::new(0.5625, 0.3125),
    DVec2::new(0.6875, 0.9375),
    DVec2::new(0.8125, 0.0625),
    DVec2::new(0.9375, 0.5625),
];

// Lighting: a bright sky, a sun over the viewer's left shoulder, and ground that reflects some of the light.

/// The light of a scene.
pub(super) struct Lighting<'a> {
    sky: &'a Sky,
    up: Vec3,
    /// The direction to the sun.
    sun: Vec3,
}

/// The light that arrives at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Light {
    /// The light from the hemisphere around the normal, with occlusion, by colour channel.
    ambient: Vec3,
    /// The visible fraction of the sun.
    sun: f32,
}

impl Light {
    const NONE: Light = Light { ambient: Vec3::ZERO, sun: 0.0 };

    fn plus(self, other: Light, weight: f32) -> Light {
        Light { ambient: self.ambient + weight * other.ambient, sun: self.sun + weight * other.sun }
    }

    pub(super) fn times(self, factor: f32) -> Light {
        Light { ambient: self.ambient * factor, sun: self.sun * factor }
    }
}

/// The colour of front faces. All colours here are linear.
const WATER: Vec3 = Vec3::new(0.105, 0.34, 0.66);
/// The colour of back faces.
const INSIDE: Vec3 = Vec3::new(0.85, 0.25, 0.03);
const SUN: Vec3 = Vec3::new(1.12, 1.05, 0.95);
const ZENITH: Vec3 = Vec3::new(0.70, 0.78, 0.90);
const HORIZON: Vec3 = Vec3::new(0.74, 0.76, 0.79);
const FROM_BELOW: Vec3 = Vec3::new(0.36, 0.35, 0.34);
const BACKGROUND: Vec3 = Vec3::new(0.80, 0.82, 0.845);
/// Tangents of half the opening angles of a cone of ambient light (30°) and of the sun's cone (5°). The sun's
/// width blurs shadows with distance.
const AMBIENT_TANGENT: f32 = 0.577;
const SUN_TANGENT: f32 = 0.09;
/// Cosine and sine of the angle between the middle cone and the five cones around it.
const TILT: (f32, f32) = (0.5, 0.866);
const MIDDLE_WEIGHT: f32 = 0.25;

impl<'a> Lighting<'a> {
    pub(super) fn new(sky: &'a Sky, view: &View) -> Lighting<'a> {
        let up = view.up.direction();
        let backward = (-view.camera.forward).reject_from(up).normalize_or(-view.camera.up);
        let right = view.camera.right.reject_from(up).normalize_or(view.camera.right);
        let sun = up * 0.78 - right * 0.5 + backward * 0.42;
        Lighting { sky, up: up.as_vec3(), sun: sun.normalize().as_vec3() }
    }

    /// The light that arrives at a point on a surface with this normal. The position is in voxels.
    pub(super) fn incoming(&self, point: DVec3, normal: Vec3) -> Light {
        let (tangent, bitangent) = normal.any_orthonormal_pair();
        let mut ambient = MIDDLE_WEIGHT * self.light_from(point, normal);
        for cone in 0..5 {
            let angle = cone as f32 * (std::f32::consts::TAU / 5.0);
            let around = tangent * angle.cos() + bitangent * angle.sin();
            let direction = normal * TILT.0 + around * TILT.1;
            ambient += (1.0 - MIDDLE_WEIGHT) / 5.0 * self.light_from(point, direction);
        }
        let faces_sun = normal.dot(self.sun) > 0.0;
        let sun = if faces_sun { self.sky.transmittance(point, self.sun, SUN_TANGENT) } else { 0.0 };
        Light { ambient, sun }
    }

    /// The light from a direction, with occlusion.
    fn light_from(&self, point: DVec3, direction: Vec3) -> Vec3 {
        self.radiance(direction) * self.sky.transmittance(point, direction, AMBIENT_TANGENT)
    }

    /// The light from a direction, without occlusion.
    fn radiance(&self, direction: Vec3) -> Vec3 {
        let height = direction.dot(self.up);
        if height > 0.0 {
            HORIZON.lerp(ZENITH, height)
        } else {
            HORIZON.lerp(FROM_BELOW, (-2.0 * height).min(1.0))
        }
    }

    /// The colour of the surface; `toward` points to the viewer.
    fn water(&self, light: Light, normal: Vec3, toward: Vec3, is_front: bool) -> Vec3 {
        let albedo = if is_front { WATER } else { INSIDE };
        let facing = normal.dot(self.sun).max(0.0) * light.sun;
        let half = (self.sun + toward).normalize_or(normal);
        let glint = normal.dot(half).max(0.0).powi(90) * light.sun;
        let edge = (1.0 - normal.dot(toward).clamp(0.0, 1.0)).powi(5);
        let mirrored = self.radiance(2.0 * normal.dot(toward) * normal - toward);
        // The reflection of the sky is occluded as much as the ambient light.
        let open = (light.ambient.y / HORIZON.y).min(1.0);
        albedo * (light.ambient + SUN * facing) + (0.02 + 0.5 * edge) * open * mirrored + 0.55 * glint * SUN
    }

    /// The colour of a matte surface with this albedo.
    fn matte(&self, albedo: Vec3, light: Light, normal: Vec3) -> Vec3 {
        let facing = normal.dot(self.sun).max(0.0) * light.sun;
        albedo * (light.ambient + SUN * facing)
    }

    /// The colour of the ground: the background, darkened by shadows.
    pub(super) fn ground(&self, light: Light) -> Vec3 {
        let facing = self.up.dot(self.sun);
        let open = self.unoccluded_on_ground() + SUN * facing;
        BACKGROUND * ((light.ambient + SUN * facing * light.sun) / open)
    }

    fn unoccluded_on_ground(&self) -> Vec3 {
        let tilted = self.radiance(self.up * TILT.0 + self.up.any_orthonormal_vector() * TILT.1);
        MIDDLE_WEIGHT * self.radiance(self.up) + (1.0 - MIDDLE_WEIGHT) * tilted
    }

    /// The background colour.
    pub(super) fn background(&self) -> Vec3 {
        BACKGROUND
    }

    /// The unoccluded light on a surface with this normal.
    fn unoccluded(&self, normal: Vec3) -> Light {
        let height = 0.5 + 0.5 * normal.dot(self.up);
        Light { ambient: FROM_BELOW.lerp(ZENITH, height), sun: 1.0 }
    }
}

// Renders particles as balls, and marks on a surface as coloured balls.

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
