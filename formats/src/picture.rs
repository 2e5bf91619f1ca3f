//! A picture to write, as whoever made it lends it; and one that was read.

use crate::data::Provenance;
use crate::error::{Error, Place, Result};

/// A picture: values of its pixels, row by row from the top left.
#[derive(Clone, Copy, Debug)]
pub struct PictureView<'a> {
    /// Width and height in pixels, each at least 1.
    pub size: [usize; 2],
    /// Linear colour with the primaries of sRGB; 1 is white.
    pub color: &'a [[f32; 3]],
    /// What else is known of the pixels. `.png` has no place for it.
    pub layers: &'a [PictureLayer<'a>],
    /// Where the picture was taken from. `.png` has no place for it.
    pub camera: Option<PictureCamera>,
    /// What made it.
    pub provenance: &'a Provenance,
}

/// The colours of a picture that was read, row by row from the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct ColorPicture {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// Linear colour with the primaries of sRGB; 1 is white.
    pub color: Vec<[f32; 3]>,
}

/// Values of the pixels beside their colour.
#[derive(Clone, Copy, Debug)]
pub struct PictureLayer<'a> {
    /// What the layer is called: one that no other has.
    pub name: &'a str,
    /// What its channels are called; of a vector, `name.X`, `name.Y`, `name.Z`.
    pub channel: &'a str,
    /// The values.
    pub samples: Samples<'a>,
}

/// Values of pixels, as they are and as they are stored.
#[derive(Clone, Copy, Debug)]
pub enum Samples<'a> {
    /// 32 bits each.
    Numbers(&'a [f32]),
    /// 16 bits each.
    HalfNumbers(&'a [f32]),
    /// Three of 32 bits each.
    Vectors(&'a [[f32; 3]]),
    /// Three of 16 bits each.
    HalfVectors(&'a [[f32; 3]]),
}

/// Where a picture was taken from, as matrices that take row vectors from the left; rows one after the other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PictureCamera {
    /// From the world to x right, y up and z into the picture.
    pub world_to_camera: [f32; 16],
    /// From the world to the picture, after division by the last coordinate: (0, 0) is its upper left corner, (1, 1)
    /// its lower right.
    pub world_to_ndc: [f32; 16],
}

impl PictureView<'_> {
    /// Refuses a picture that no file can hold: none at all, one of more than 65 535 pixels along an edge, or values
    /// for another number of pixels. `format` is named in the error.
    pub(crate) fn check(&self, format: &'static str) -> Result<()> {
        let [width, height] = self.size;
        let is_possible = |edge: usize| (1..=EDGE_MAX).contains(&edge);
        if !is_possible(width) || !is_possible(height) {
            let what = format!("a picture of {width} × {height} pixels; an edge has 1 to {EDGE_MAX}");
            return Err(Error::invalid(format, Place::File, what));
        }
        let counts = self.layers.iter().map(|layer| (layer.name, layer.samples.len()));
        let pixel_count = width * height;
        match std::iter::once(("color", self.color.len()))
            .chain(counts)
            .find(|(_, count)| *count != pixel_count)
        {
            Some((name, count)) => {
                let what = format!("{count} values of {name} for {pixel_count} pixels");
                Err(Error::invalid(format, Place::File, what))
            }
            None => Ok(()),
        }
    }
}

impl Samples<'_> {
    /// For how many pixels.
    fn len(&self) -> usize {
        match self {
            Samples::Numbers(values) | Samples::HalfNumbers(values) => values.len(),
            Samples::Vectors(values) | Samples::HalfVectors(values) => values.len(),
        }
    }
}

/// Pixels along an edge, at most.
const EDGE_MAX: usize = 65_535;
