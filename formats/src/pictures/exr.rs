//! OpenEXR: the colours of a picture and its other layers, one part of the file per layer.
//!
//! ```text
//!   part        channels
//!   beauty      R G B A      16-bit floats, linear; A is 1: the background is part of the picture
//!   depth       Z
//!   normals     N.X N.Y N.Z  and so on: parts are named after their layers, channels by convention
//! ```
//!
//! Values are compressed with deflate, in blocks of 16 lines. All provenance is in one attribute, `meniscus`,
//! with a line per name and value. Separate attributes could be reordered, because the exr crate does not
//! preserve the order of custom attributes.

use std::io::{Cursor, Write};

use ::exr::error::Error as ExrError;
use ::exr::image::write::WritableImage;
use ::exr::image::{AnyChannel, AnyChannels, Blocks, Encoding, FlatSamples, Image, Layer};
use ::exr::meta::attribute::{AttributeValue, LineOrder, Text};
use ::exr::meta::header::{ImageAttributes, LayerAttributes};
use ::exr::prelude::Compression;
use half::f16;

use crate::core::bytes::{self, Endian};
use crate::core::data::{PictureView, PixelSamples};
use crate::core::error::{Error, Position, Result};
use crate::core::options::WriteOption;
use crate::core::provenance::{GENERATOR, comments, from_comments};
use crate::core::row::{Content, FormatRow, Integrity, OutputRow};
use crate::core::text::excerpt;

const FORMAT: &str = "OpenEXR";

/// Writes a picture with all its layers. Builds the whole file in memory first.
///
/// # Errors
///
/// [`Error::Io`] if writing fails; [`Error::Invalid`] if the picture is invalid.
pub fn write(picture: &PictureView, out: &mut dyn Write) -> Result<()> {
    picture.check(FORMAT)?;
    let mut attributes = ImageAttributes::with_size((picture.size[0], picture.size[1]));
    let provenance = text(&comments(picture.provenance, ""))?;
    attributes.other.insert(text(PROVENANCE)?, AttributeValue::Text(provenance));
    let mut layers = vec![layer(picture, "beauty", beauty(picture)?)?];
    for of_pixels in picture.layers {
        layers.push(layer(picture, of_pixels.name, channels(of_pixels.channel, of_pixels.samples)?)?);
    }
    let mut file = Cursor::new(Vec::new());
    Image::from_layers(attributes, layers).write().non_parallel().to_buffered(&mut file).map_err(failed)?;
    Ok(out.write_all(file.get_ref())?)
}

fn failed(error: ExrError) -> Error {
    match error {
        ExrError::Io(source) => Error::Io(source),
        other => Error::invalid(FORMAT, Position::File, other.to_string()),
    }
}

fn text(plain: &str) -> Result<Text> {
    let refused = || {
        let outside = plain.chars().find(|&char| char > '\u{ff}').unwrap_or_default();
        let what = format!(
            "the text \"{}\" cannot be stored in OpenEXR: the character {outside:?} is outside Latin-1",
            excerpt(plain)
        );
        Error::invalid(FORMAT, Position::File, what)
    };
    Text::new_or_none(plain).ok_or_else(refused)
}

type Channels = Vec<AnyChannel<FlatSamples>>;

fn layer(picture: &PictureView, name: &str, channels: Channels) -> Result<Layer<AnyChannels<FlatSamples>>> {
    let mut attributes = LayerAttributes::named(text(name)?);
    attributes.software_name = Some(text(GENERATOR)?);
    attributes.world_to_camera = picture.camera.map(|camera| camera.world_to_camera);
    attributes.world_to_normalized_device = picture.camera.map(|camera| camera.world_to_ndc);
    let encoding = Encoding {
        compression: Compression::ZIP16,
        blocks: Blocks::ScanLines,
        line_order: LineOrder::Increasing,
    };
    let size = (picture.size[0], picture.size[1]);
    Ok(Layer::new(size, attributes, encoding, AnyChannels::sort(channels.into())))
}

fn beauty(picture: &PictureView) -> Result<Channels> {
    let opaque = vec![f16::ONE; picture.color.len()];
    let mut channels = vec![AnyChannel::new(text("A")?, FlatSamples::F16(opaque))];
    for (axis, name) in ["R", "G", "B"].into_iter().enumerate() {
        channels.push(AnyChannel::new(text(name)?, halves(picture.color.iter().map(|color| color[axis]))));
    }
    Ok(channels)
}

fn channels(name: &str, samples: PixelSamples) -> Result<Channels> {
    let one = |samples| Ok(vec![AnyChannel::new(text(name)?, samples)]);
    match samples {
        PixelSamples::Numbers(values) => one(FlatSamples::F32(values.to_vec())),
        PixelSamples::HalfNumbers(values) => one(halves(values.iter().copied())),
        PixelSamples::Vectors(values) => vectors(name, values, |values| FlatSamples::F32(values.collect())),
        PixelSamples::HalfVectors(values) => vectors(name, values, |values| halves(values)),
    }
}

fn vectors<'a>(
    name: &str,
    values: &'a [[f32; 3]],
    samples: impl Fn(&mut dyn Iterator<Item = f32>) -> FlatSamples,
) -> Result<Channels> {
    let channel = |(axis, letter): (usize, &str)| {
        let mut along = values.iter().map(move |value: &'a [f32; 3]| value[axis]);
        Ok(AnyChannel::new(text(&format!("{name}.{letter}"))?, samples(&mut along)))
    };
    ["X", "Y", "Z"].into_iter().enumerate().map(channel).collect()
}

fn halves(values: impl IntoIterator<Item = f32>) -> FlatSamples {
    FlatSamples::F16(values.into_iter().map(f16::from_f32).collect())
}

/// The provenance attribute in the head of a file; empty if there is none.
///
/// # Errors
///
/// [`Error::Invalid`] if this is not the head of an OpenEXR file.
pub(crate) fn provenance_text(head: &[u8]) -> Result<Vec<u8>> {
    let mut found = Vec::new();
    walk(head, |name, value| {
        if name == PROVENANCE.as_bytes() {
            found = value.to_vec();
        }
    })?;
    Ok(found)
}

/// The size of the whole file, computed from the table of blocks and the last block; `None` if unknown.
/// `read_at` returns the first bytes of a block.
///
/// # Errors
///
/// [`Error::Invalid`] if this is not the head of a file of this crate; the errors of `read_at`.
pub(crate) fn bytes_declared(
    head: &[u8],
    read_at: impl FnOnce(u64) -> Result<Vec<u8>>,
) -> Result<Option<u64>> {
    let mut block_count = 0u64;
    let tables_at = walk(head, |name, value| {
        if name == b"chunkCount"
            && let Ok(count) = value.try_into().map(u32::from_le_bytes)
        {
            block_count += u64::from(count);
        }
    })?;
    let mut cursor = bytes::Cursor::new(FORMAT, Endian::Little, head, tables_at);
    let mut last = None;
    for _ in 0..block_count {
        last = last.max(Some(cursor.u64("the offset of a block")?));
    }
    let Some(last) = last else { return Ok(None) };
    let block = read_at(last)?;
    let mut cursor = bytes::Cursor::new(FORMAT, Endian::Little, &block, 0);
    cursor.take(8, "the part and the first line of a block")?;
    let data_bytes = cursor.u32("the size of a block")?;
    Ok(last.checked_add(BLOCK_HEAD_BYTES + u64::from(data_bytes)))
}

/// Visits the attributes of all parts; returns the offset of their end.
fn walk(head: &[u8], mut attribute: impl FnMut(&[u8], &[u8])) -> Result<usize> {
    let mut cursor = bytes::Cursor::new(FORMAT, Endian::Little, head, 0);
    if cursor.take(4, "the magic number")? != MAGIC {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected the OpenEXR magic number"));
    }
    let has_parts = cursor.u32("the version")? & MULTIPLE_PARTS != 0;
    loop {
        let name = name(head, &mut cursor)?;
        if !name.is_empty() {
            self::name(head, &mut cursor)?;
            let size = cursor.u32("the size of an attribute")? as usize;
            attribute(name, cursor.take(size, "an attribute")?);
            continue;
        }
        // In a file with several parts, an empty header ends the list of headers.
        if !has_parts {
            return Ok(cursor.at());
        }
        if head.get(cursor.at()) == Some(&0) {
            cursor.take(1, "the end of the headers")?;
            return Ok(cursor.at());
        }
    }
}

/// Takes the bytes up to a zero, and skips the zero.
fn name<'a>(head: &'a [u8], cursor: &mut bytes::Cursor<'a>) -> Result<&'a [u8]> {
    let rest = head.get(cursor.at()..).unwrap_or_default();
    let length = rest.iter().position(|&byte| byte == 0).unwrap_or(rest.len());
    let name = cursor.take(length, "a name")?;
    cursor.take(1, "the end of a name")?;
    Ok(name)
}

/// The name of the provenance attribute.
const PROVENANCE: &str = "meniscus";

const MAGIC: [u8; 4] = [0x76, 0x2f, 0x31, 0x01];

/// The bit of the version field for files with several parts.
const MULTIPLE_PARTS: u32 = 0x1000;

/// Size in bytes of the header of a block: its part, its first line, the size of its data.
pub(crate) const BLOCK_HEAD_BYTES: u64 = 12;

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow { signatures: &[&MAGIC], ..FormatRow::new("OpenEXR image", &["exr"]) },
    help: "OpenEXR: colours, depth, normals and more, one layer each",
    content: Content::Picture(write),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Up, WriteOption::Size, WriteOption::Camera],
    read_provenance: |head| Ok(from_comments(&provenance_text(head)?, "")),
    integrity: Integrity::Length(|head, read| bytes_declared(head, |start| read(start, BLOCK_HEAD_BYTES))),
};

#[cfg(test)]
mod tests {
    use ::exr::prelude::{ReadChannels, ReadLayers, read};

    use super::*;
    use crate::OutputFormat;
    use crate::core::data::{PictureCamera, PictureLayer};
    use crate::read_provenance;
    use crate::table::integrity::is_complete;

    const WIDTH: usize = 37;
    const HEIGHT: usize = 21;

    fn provenance() -> Vec<(String, String)> {
        let pairs = [("radius", "0.025"), ("input", "größe ∞.ply"), ("camera", "eye=1:2:3,up=y")];
        pairs.map(|(name, value)| (name.to_owned(), value.to_owned())).to_vec()
    }

    fn written() -> Vec<u8> {
        let count = WIDTH * HEIGHT;
        let numbers: Vec<f32> = (0..count).map(|index| index as f32 / 3.0).collect();
        let vectors: Vec<[f32; 3]> = numbers.iter().map(|x| [*x, -x, 0.1 * x]).collect();
        let color: Vec<[f32; 3]> = numbers.iter().map(|x| [x / 1000.0, 0.25, 0.5]).collect();
        let layer = |name, channel, samples| PictureLayer { name, channel, samples };
        let layers = [
            layer("depth", "Z", PixelSamples::Numbers(&numbers)),
            layer("coverage", "Y", PixelSamples::HalfNumbers(&numbers)),
            layer("normals", "N", PixelSamples::HalfVectors(&vectors)),
            layer("position", "P", PixelSamples::Vectors(&vectors)),
        ];
        let matrix: [f32; 16] = std::array::from_fn(|index| index as f32);
        let camera = Some(PictureCamera { world_to_camera: matrix, world_to_ndc: [2.0; 16] });
        let provenance = provenance();
        let size = [WIDTH, HEIGHT];
        let picture = PictureView { size, color: &color, layers: &layers, camera, provenance: &provenance };
        let mut bytes = Vec::new();
        write(&picture, &mut bytes).expect("written");
        bytes
    }

    #[test]
    fn layers_and_camera_round_trip() {
        let image = read()
            .no_deep_data()
            .largest_resolution_level()
            .all_channels()
            .all_layers()
            .all_attributes()
            .from_buffered(Cursor::new(written()))
            .expect("an image");
        let of = |layer: &str, channel: &str, index: usize| {
            let named = |name: &Option<Text>| name.as_ref().is_some_and(|name| *name == *layer);
            let layer =
                image.layer_data.iter().find(|layer| named(&layer.attributes.layer_name)).expect("a layer");
            let matrix = layer.attributes.world_to_camera.expect("a camera");
            assert_eq!(matrix[7], 7.0);
            let channels = &layer.channel_data.list;
            let channel = channels.iter().find(|found| found.name.to_string() == channel).expect("a channel");
            channel.sample_data.value_by_flat_index(index).to_f32()
        };
        let index = 3 * WIDTH + 4;
        let x = index as f32 / 3.0;
        let half = |value: f32| f16::from_f32(value).to_f32();
        assert_eq!(image.layer_data.len(), 5);
        assert_eq!(of("beauty", "R", index), half(x / 1000.0));
        assert_eq!([of("beauty", "B", index), of("beauty", "A", index)], [0.5, 1.0]);
        assert_eq!([of("depth", "Z", index), of("coverage", "Y", index)], [x, half(x)]);
        assert_eq!([of("normals", "N.Y", index), of("position", "P.Z", index)], [half(-x), 0.1 * x]);
    }

    #[test]
    fn equal_pictures_give_equal_bytes() {
        assert!(written() == written());
    }

    #[test]
    fn provenance_round_trips_and_truncated_files_are_incomplete() {
        let bytes = written();
        assert_eq!(read_provenance(OutputFormat::Exr, &*bytes).expect("readable"), provenance());
        assert!(is_complete(OutputFormat::Exr, &mut Cursor::new(&bytes)).expect("readable"));
        for length in (0..bytes.len()).step_by(7) {
            let part = &bytes[..length];
            assert!(!is_complete(OutputFormat::Exr, &mut Cursor::new(part)).unwrap_or(false), "{length}");
            // Reading from a part may succeed or fail, but must not panic.
            let _ = read_provenance(OutputFormat::Exr, part);
        }
    }
}
