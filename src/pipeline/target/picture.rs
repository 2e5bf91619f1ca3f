//! Pictures of frames, and their files.
//!
//! ```text
//!   level set ──▶ Picture ──▶ .png    colours
//!                        └──▶ .exr    colours, coverage, depth, normals, position, velocity, curvature
//! ```

use glam::DVec3;
use meniscus_formats::{
    Content, Error, OutputFormat, PictureLayer, PictureView, PixelSamples, Provenance, UpAxis,
};

use crate::render::{self, Balls, Layers, Picture, Up};
use crate::surface::attributes::BandAttribute;
use crate::surface::grid::Field;
use crate::surface::level_set::NarrowBand;
use crate::surface::particles::Role;
use crate::surface::reconstruction::FrameSurface;
use crate::surface::space::Lattice;
use crate::surface::spray::Spray;

use super::viewpoint::{CameraChoice, Viewpoint};

/// The size and camera of pictures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PictureOptions {
    /// Width and height, pixels.
    pub size: [usize; 2],
    /// The camera. If it is not fixed, the bounds of each frame place it.
    pub camera: CameraChoice,
}

impl Default for PictureOptions {
    fn default() -> PictureOptions {
        PictureOptions { size: [1280, 720], camera: CameraChoice::default() }
    }
}

impl PictureOptions {
    /// Upper estimate of the memory for rendering and encoding a picture in this format, in bytes; 0 for
    /// other formats.
    fn picture_bytes(&self, format: OutputFormat) -> u64 {
        let of_pixel = match (format.is_picture(), format.has_attributes()) {
            (false, _) => 0,
            (true, false) => PIXEL_BYTES,
            (true, true) => PIXEL_BYTES_WITH_DATA,
        };
        (self.size[0] as u64).saturating_mul(self.size[1] as u64).saturating_mul(of_pixel)
    }

    /// The memory for the largest of the pictures in these formats, in bytes; 0 without pictures.
    pub(crate) fn largest_bytes(&self, formats: &[OutputFormat]) -> u64 {
        formats.iter().map(|&format| self.picture_bytes(format)).max().unwrap_or(0)
    }

    /// The width divided by the height.
    pub fn aspect(&self) -> f64 {
        self.size[0] as f64 / self.size[1] as f64
    }
}

/// Memory per pixel in bytes, as measured: the tiles and the picture that is assembled from them, or the
/// picture, its layers as they are stored, and the encoded bytes.
const PIXEL_BYTES: u64 = 60;
const PIXEL_BYTES_WITH_DATA: u64 = 130;

/// A level set to render, with the particles beside it.
#[derive(Clone, Copy, Debug)]
pub struct PictureScene<'a> {
    /// The level set.
    pub band: &'a NarrowBand,
    /// Its voxels.
    pub lattice: Lattice,
    /// The position of voxel (0, 0, 0), world units; 0 beside particles.
    pub origin: DVec3,
    /// Velocities at the voxels of the band, x, y and z, world units per second.
    pub velocity: Option<&'a [Field; 3]>,
    /// The particles beside the surface.
    pub spray: Option<&'a Spray>,
}

impl PictureScene<'_> {
    /// Renders a picture, with the data of its pixels if `data` is set.
    pub fn picture(&self, viewpoint: &Viewpoint, size: [usize; 2], data: bool) -> Picture {
        let view = viewpoint.moved(-self.origin).view(size);
        let layers = Layers { data, velocity: self.velocity };
        let mut picture = match self.spray {
            Some(spray) => {
                let velocities = spray.velocities();
                let (positions, radii) = ((&spray.positions).into(), &spray.radii[..]);
                let balls = Balls { positions, radii, velocities: &velocities };
                render::render_with_balls(self.band, &self.lattice, balls, &view, layers)
            }
            None => render::render(self.band, &self.lattice, &view, layers),
        };
        if self.origin != DVec3::ZERO
            && let Some(data) = &mut picture.data
        {
            let visible =
                data.positions.iter_mut().zip(&data.depth).filter(|(_, depth)| **depth < render::FAR);
            visible.for_each(|(position, _)| {
                *position = (DVec3::from(position.map(f64::from)) + self.origin).as_vec3().to_array();
            });
        }
        picture
    }
}

/// The velocities of a surface as the renderer takes them, if it has any.
pub fn velocities(surface: &FrameSurface) -> Option<[Field; 3]> {
    let is_velocity = |attribute: &&BandAttribute| attribute.role == Role::Velocity && attribute.arity == 3;
    let attribute = surface.attributes.band.iter().find(is_velocity)?;
    let mut fields: [Field; 3] = std::array::from_fn(|_| Field::splat(surface.band.topology.len(), 0.0));
    let mut voxels = [0.0; 3 * crate::surface::grid::LEAF_VOXELS];
    for leaf in 0..surface.band.topology.len() {
        attribute.fill(leaf, &mut voxels);
        for (axis, field) in fields.iter_mut().enumerate() {
            let along = voxels[axis..].iter().step_by(3);
            field.leaves[leaf].values.iter_mut().zip(along).for_each(|(value, along)| *value = *along);
        }
    }
    Some(fields)
}

/// Encodes a picture's file. `camera` is the viewpoint, if the picture has a single one.
///
/// # Errors
/// When the format is not a picture format, or cannot hold the picture.
pub fn encode_picture(
    picture: &Picture,
    camera: Option<&Viewpoint>,
    format: OutputFormat,
    provenance: &Provenance,
) -> meniscus_formats::Result<Vec<u8>> {
    let aspect = picture.size[0] as f64 / picture.size[1].max(1) as f64;
    let layers = layers(picture);
    let view = PictureView {
        size: picture.size,
        color: &picture.color,
        layers: &layers,
        camera: camera.map(|viewpoint| viewpoint.matrices(aspect)),
        provenance,
    };
    let mut bytes = Vec::new();
    match format.content() {
        Content::Picture(write) => write(&view, &mut bytes)?,
        Content::Mesh(_) | Content::LevelSet => {
            return Err(Error::unsupported("picture", format!(".{format} is not a picture format")));
        }
    }
    Ok(bytes)
}

fn layers(picture: &Picture) -> Vec<PictureLayer<'_>> {
    let layer = |name, channel, samples| PictureLayer { name, channel, samples };
    let mut layers = vec![layer("coverage", "Y", PixelSamples::HalfNumbers(&picture.coverage))];
    if let Some(data) = &picture.data {
        layers.push(layer("depth", "Z", PixelSamples::Numbers(&data.depth)));
        layers.push(layer("normals", "N", PixelSamples::HalfVectors(&data.normals)));
        layers.push(layer("position", "P", PixelSamples::Vectors(&data.positions)));
        layers.extend(data.velocities.iter().map(|v| layer("velocity", "V", PixelSamples::Vectors(v))));
        layers.push(layer("curvature", "Y", PixelSamples::Numbers(&data.curvatures)));
    }
    layers
}

/// The up direction for particles with this up axis.
pub fn up_of(axis: UpAxis) -> Up {
    match axis {
        UpAxis::Y => Up::Y,
        UpAxis::Z => Up::Z,
    }
}
