//! Portable Network Graphics: reads and writes the colours of a picture as 8-bit sRGB.
//!
//! ```text
//!   signature   IHDR   sRGB   tEXt meniscus_radius 0.025 …   IDAT …   IEND
//! ```

use std::io::{self, Write};

use ::png::{
    BitDepth, ColorType, Compression, Decoder, DecodingError, Encoder, EncodingError, Limits,
    SrgbRenderingIntent, Transformations,
};

use crate::core::bytes::{Cursor, Endian};
use crate::core::data::{ColorPicture, PictureView};
use crate::core::error::{Error, Position, Result};
use crate::core::options::WriteOption;
use crate::core::provenance::{GENERATOR, escape, from_escaped, prefixed};
use crate::core::row::{Content, FormatRow, Integrity, OutputRow};

const FORMAT: &str = "PNG";

/// Writes the colours of a picture.
///
/// # Errors
///
/// [`Error::Io`] if writing fails; [`Error::Invalid`] if the picture is invalid.
pub fn write(picture: &PictureView, out: &mut dyn Write) -> Result<()> {
    picture.check(FORMAT)?;
    let edge = |pixels: usize| {
        u32::try_from(pixels)
            .map_err(|_| Error::invalid(FORMAT, Position::File, "the picture is too large for PNG"))
    };
    let mut encoder = Encoder::new(out, edge(picture.size[0])?, edge(picture.size[1])?);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Balanced);
    encoder.set_source_srgb(SrgbRenderingIntent::Perceptual);
    encoder.add_text_chunk("Software".to_owned(), GENERATOR.to_owned()).map_err(failed)?;
    for (name, value) in picture.provenance {
        // A tEXt chunk is Latin-1. Readers treat other characters differently, so these are escaped.
        encoder.add_text_chunk(prefixed(&escape(name)), escape(value)).map_err(failed)?;
    }
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(&encoded(picture.color)).map_err(failed)?;
    writer.finish().map_err(failed)
}

fn failed(error: EncodingError) -> Error {
    match error {
        EncodingError::IoError(source) => Error::Io(source),
        other => Error::invalid(FORMAT, Position::File, other.to_string()),
    }
}

/// Converts linear colours to sRGB bytes.
fn encoded(color: &[[f32; 3]]) -> Vec<u8> {
    let thresholds: Vec<f32> = (0..255u8).map(|byte| linear((f32::from(byte) + 0.5) / 255.0)).collect();
    // There are 255 thresholds, so the result is at most 255. NaN exceeds none of them.
    let byte = |value: &f32| {
        u8::try_from(thresholds.partition_point(|threshold| threshold <= value)).unwrap_or(u8::MAX)
    };
    color.as_flattened().iter().map(byte).collect()
}

/// The linear value of an sRGB value.
fn linear(value: f32) -> f32 {
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// Reads the colours of a picture of at most 67 million pixels. Ignores transparency.
///
/// # Errors
///
/// [`Error::Invalid`] if the file is not a PNG or is damaged; [`Error::Truncated`] if it ends too early;
/// [`Error::TooLarge`] if its declared size is too large; [`Error::Unsupported`] if its palette is missing.
pub fn read(bytes: &[u8]) -> Result<ColorPicture> {
    let limits = Limits { bytes: PIXELS_MAX * CHANNELS_MAX };
    let mut decoder = Decoder::new_with_limits(io::Cursor::new(bytes), limits);
    decoder.set_transformations(Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(unreadable)?;
    let size = [reader.info().width, reader.info().height].map(|edge| edge as usize);
    let is_small = size[0].checked_mul(size[1]).is_some_and(|count| count <= PIXELS_MAX);
    let length = reader.output_buffer_size().filter(|_| is_small);
    let length = length.ok_or_else(|| {
        let what = format!("the picture has {} x {} pixels; the limit is {PIXELS_MAX}", size[0], size[1]);
        Error::too_large(FORMAT, what)
    })?;
    // Do not allocate memory for pixels that the file cannot contain.
    if reader.info().raw_bytes() > bytes.len().saturating_mul(DEFLATE_RATIO_MAX) {
        return Err(Error::truncated(
            FORMAT,
            Position::File,
            "the file has less data than its size in pixels needs",
        ));
    }
    let mut samples = vec![0; length];
    let info = reader.next_frame(&mut samples).map_err(unreadable)?;
    samples.truncate(info.buffer_size());
    let bright: Vec<f32> = (0..=u8::MAX).map(|byte| linear(f32::from(byte) / 255.0)).collect();
    let at = |sample: u8| bright[usize::from(sample)];
    let color = match info.color_type {
        ColorType::Rgb => samples.chunks_exact(3).map(|p| [at(p[0]), at(p[1]), at(p[2])]).collect(),
        ColorType::Rgba => samples.chunks_exact(4).map(|p| [at(p[0]), at(p[1]), at(p[2])]).collect(),
        ColorType::Grayscale => samples.iter().map(|&p| [at(p); 3]).collect(),
        ColorType::GrayscaleAlpha => samples.chunks_exact(2).map(|p| [at(p[0]); 3]).collect(),
        ColorType::Indexed => {
            return Err(Error::unsupported(FORMAT, "the picture uses a palette, and the palette is missing"));
        }
    };
    Ok(ColorPicture { size, color })
}

fn unreadable(error: DecodingError) -> Error {
    match error {
        DecodingError::IoError(source) if source.kind() == io::ErrorKind::UnexpectedEof => {
            Error::truncated(FORMAT, Position::File, "the file ends too early")
        }
        DecodingError::IoError(source) => Error::Io(source),
        DecodingError::LimitsExceeded => {
            Error::too_large(FORMAT, "the picture needs more memory than the limit")
        }
        other => Error::invalid(FORMAT, Position::File, other.to_string()),
    }
}

/// The largest supported number of pixels.
const PIXELS_MAX: usize = 8192 * 8192;

/// The largest ratio of decompressed to compressed size that deflate can reach.
const DEFLATE_RATIO_MAX: usize = 1032;

/// Maximum number of samples per pixel.
const CHANNELS_MAX: usize = 4;

/// Names and values of the text chunks in the head of a file.
///
/// # Errors
///
/// [`Error::Invalid`] if this is not the head of a PNG file.
pub(crate) fn texts(head: &[u8]) -> Result<Vec<(String, String)>> {
    let mut cursor = Cursor::new(FORMAT, Endian::Big, head, 0);
    if cursor.take(SIGNATURE.len(), "the signature")? != SIGNATURE {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected the PNG signature"));
    }
    let mut texts = Vec::new();
    loop {
        let length = cursor.u32("the length of a chunk")? as usize;
        let kind = cursor.take(4, "the kind of a chunk")?;
        if kind == b"IDAT" || kind == b"IEND" {
            return Ok(texts);
        }
        let data = cursor.take(length, "a chunk")?;
        cursor.take(4, "the checksum of a chunk")?;
        let mut parts = data.splitn(2, |&byte| byte == 0).map(std::str::from_utf8);
        if kind == b"tEXt"
            && let (Some(Ok(name)), Some(Ok(value))) = (parts.next(), parts.next())
        {
            texts.push((name.to_owned(), value.to_owned()));
        }
    }
}

/// Whether these are the last bytes of a complete file.
pub(crate) fn ends_as_written(tail: &[u8]) -> bool {
    tail.ends_with(&LAST_CHUNK)
}

const SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";

const LAST_CHUNK: [u8; 12] = [0, 0, 0, 0, b'I', b'E', b'N', b'D', 0xae, 0x42, 0x60, 0x82];

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow { signatures: &[b"\x89PNG"], ..FormatRow::new("PNG image", &["png"]) },
    help: "Colours, for any viewer",
    content: Content::Picture(write),
    write_particles: None,
    has_attributes: false,
    options: &[WriteOption::Up, WriteOption::Size, WriteOption::Camera],
    read_provenance: |head| {
        let texts = texts(head)?;
        Ok(from_escaped(texts.iter().map(|(name, text)| (&**name, &**text))))
    },
    integrity: Integrity::Tail(ends_as_written),
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::OutputFormat;
    use crate::read_provenance;
    use crate::table::integrity::is_complete;

    fn written(size: [usize; 2], color: &[[f32; 3]], provenance: &[(String, String)]) -> Vec<u8> {
        let mut bytes = Vec::new();
        let picture = PictureView { size, color, layers: &[], camera: None, provenance };
        write(&picture, &mut bytes).expect("written");
        bytes
    }

    #[test]
    fn linear_colors_are_written_as_srgb() {
        let color = [[0.0, 1.0, 0.5], [7.0, -1.0, f32::NAN], [0.2159, 0.002, 0.9]];
        let bytes = written([3, 1], &color, &[]);
        let mut reader = ::png::Decoder::new(io::Cursor::new(&bytes)).read_info().expect("a picture");
        let mut pixels = vec![0; 9];
        reader.next_frame(&mut pixels).expect("pixels");
        assert_eq!(pixels, [0, 255, 188, 255, 0, 0, 128, 7, 243]);
        assert!(reader.info().srgb.is_some());
    }

    #[test]
    fn provenance_round_trips_and_truncated_files_are_incomplete() {
        let provenance = [("radius", "0.025"), ("input", "größe ∞.ply"), ("größe", "1"), ("empty", "")]
            .map(|(name, value)| (name.to_owned(), value.to_owned()));
        let bytes = written([2, 2], &[[0.5; 3]; 4], &provenance);
        assert_eq!(read_provenance(OutputFormat::Png, &*bytes).expect("readable"), provenance);
        assert!(is_complete(OutputFormat::Png, &mut io::Cursor::new(&bytes)).expect("readable"));
        for length in 0..bytes.len() {
            let part = &bytes[..length];
            assert!(!is_complete(OutputFormat::Png, &mut io::Cursor::new(part)).unwrap_or(false), "{length}");
            // Reading from a part may succeed or fail, but must not panic.
            let _ = read_provenance(OutputFormat::Png, part);
        }
    }

    #[test]
    fn invalid_pictures_are_an_error() {
        for (size, count) in [([0, 1], 0), ([2, 2], 3), ([65_536, 1], 65_536)] {
            let color = vec![[0.0; 3]; count];
            let picture = PictureView { size, color: &color, layers: &[], camera: None, provenance: &[] };
            assert!(write(&picture, &mut Vec::new()).is_err(), "{size:?}");
        }
    }

    #[test]
    fn written_pictures_are_read_back() {
        let color = [[0.0, 1.0, 0.5], [0.2159, 0.002, 0.9], [0.7, 0.1, 0.04], [1.0; 3]];
        let bytes = written([2, 2], &color, &[]);
        let picture = read(&bytes).expect("a picture");
        assert_eq!(picture.size, [2, 2]);
        for (read, written) in picture.color.as_flattened().iter().zip(color.as_flattened()) {
            assert!((read - written).abs() < 0.005, "{read} {written}");
        }
        for length in 0..bytes.len() {
            assert!(read(&bytes[..length]).is_err() || length + 12 >= bytes.len(), "{length}");
        }
    }

    #[test]
    fn huge_declared_size_is_rejected_before_allocation() {
        assert!(matches!(read(&of_size([0xffff, 0xffff])), Err(Error::TooLarge { .. })));
        // The largest allowed size, in a file of a hundred bytes.
        let error = read(&of_size([8192, 8192])).expect_err("the data is missing").to_string();
        assert!(error.contains("less data than its size in pixels needs"), "{error}");
    }

    /// A file with one pixel that declares another size.
    fn of_size(size: [u32; 2]) -> Vec<u8> {
        let mut bytes = written([1, 1], &[[0.5; 3]], &[]);
        // Width and height follow the signature and the header of the first chunk; its checksum comes after
        // them.
        bytes[16..24].copy_from_slice(size.map(u32::to_be_bytes).as_flattened());
        let checksum = crc32(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&checksum.to_be_bytes());
        bytes
    }

    fn crc32(bytes: &[u8]) -> u32 {
        let step = |rest: u32, _| if rest & 1 == 1 { (rest >> 1) ^ 0xedb8_8320 } else { rest >> 1 };
        !bytes.iter().fold(!0, |rest, &byte| (0..8).fold(rest ^ u32::from(byte), step))
    }
}
