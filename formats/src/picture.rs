//! Picture types: a borrowed picture to write, and one that was read.

use crate::data::Provenance;
use crate::error::{Error, Position, Result};

/// A picture to write: pixel values, row by row from the top left.
#[derive(Clone, Copy, Debug)]
pub struct PictureView<'a> {
    /// Width and height in pixels, each at least 1.
    pub size: [usize; 2],
    /// Linear colour with sRGB primaries; 1 is white.
    pub color: &'a [[f32; 3]],
    /// Additional layers. `.png` cannot store them.
    pub layers: &'a [PictureLayer<'a>],
    /// The camera. `.png` cannot store it.
    pub camera: Option<PictureCamera>,
    /// How the picture was made.
    pub provenance: &'a Provenance,
}

/// The colours of a picture read from a file, row by row from the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct ColorPicture {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// Linear colour with sRGB primaries; 1 is white.
    pub color: Vec<[f32; 3]>,
}

/// Pixel values other than colour.
#[derive(Clone, Copy, Debug)]
pub struct PictureLayer<'a> {
    /// The layer's name, unique within the picture.
    pub name: &'a str,
    /// The name of its channel. For vectors, the prefix of three: `N` gives `N.X`, `N.Y` and `N.Z`.
    pub channel: &'a str,
    /// The values.
    pub samples: PixelSamples<'a>,
}

/// Pixel values and the precision in which they are stored.
#[derive(Clone, Copy, Debug)]
pub enum PixelSamples<'a> {
    /// 32 bits each.
    Numbers(&'a [f32]),
    /// 16 bits each.
    HalfNumbers(&'a [f32]),
    /// Three components of 32 bits each.
    Vectors(&'a [[f32; 3]]),
    /// Three components of 16 bits each.
    HalfVectors(&'a [[f32; 3]]),
}

/// The camera of a picture, as two matrices M, stored row by row. They transform a row vector v to v · M.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PictureCamera {
    /// From the world to camera space: x right, y up and z into the picture.
    pub world_to_camera: [f32; 16],
    /// From the world to the picture, after division by the last coordinate: (0, 0) is the upper left corner
    /// and (1, 1) the lower right one.
    pub world_to_ndc: [f32; 16],
}

impl PictureView<'_> {
    /// Fails if the picture is invalid: empty, more than 65 535 pixels along an edge, or the wrong number of
    /// values. `format` is named in the error.
    pub(crate) fn check(&self, format: &'static str) -> Result<()> {
        let [width, height] = self.size;
        let is_possible = |edge: usize| (1..=EDGE_MAX).contains(&edge);
        if !is_possible(width) || !is_possible(height) {
            let what =
                format!("the picture has {width} × {height} pixels; each edge must have 1 to {EDGE_MAX}");
            return Err(Error::invalid(format, Position::File, what));
        }
        let counts = self.layers.iter().map(|layer| (layer.name, layer.samples.len()));
        let pixel_count = width * height;
        match std::iter::once(("color", self.color.len()))
            .chain(counts)
            .find(|(_, count)| *count != pixel_count)
        {
            Some((name, count)) => {
                let what = format!("layer {name} has {count} values for {pixel_count} pixels");
                Err(Error::invalid(format, Position::File, what))
            }
            None => Ok(()),
        }
    }
}

impl PixelSamples<'_> {
    /// The number of pixels.
    fn len(&self) -> usize {
        match self {
            PixelSamples::Numbers(values) | PixelSamples::HalfNumbers(values) => values.len(),
            PixelSamples::Vectors(values) | PixelSamples::HalfVectors(values) => values.len(),
        }
    }
}

/// Maximum number of pixels along an edge.
const EDGE_MAX: usize = 65_535;
