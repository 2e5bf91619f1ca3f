//! From a .png to a picture, for sheets of pictures that are there already.

use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

use meniscus_formats::provenance::{Kind, read_provenance};
use meniscus_formats::{Error, Place};
use png::{ColorType, Decoder, DecodingError, Limits, Transformations};

use crate::preview::Picture;

use super::frame::{FrameError, Stage};
use super::provenance::{CAMERA, HEAD_BYTES, SHEET};
use super::reading::read_file;

/// Reads the colours of a picture. Transparency is left out.
///
/// # Errors
/// When the system refuses, or it is no such picture, or one that is too large.
pub fn read_picture(path: &Path) -> Result<Picture, FrameError> {
    let bytes = read_file(path)?;
    FrameError::catch(path, Stage::Read, || decoded(&bytes))?
        .map_err(|error| FrameError::file(path, Stage::Read, error))
}

/// Where the picture of a frame was taken from, if it is one of this program and no sheet.
pub fn camera_of_picture(path: &Path) -> Option<String> {
    let is_png = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png"));
    // Opening a pipe would wait for its other end.
    if !is_png || !path.metadata().is_ok_and(|metadata| metadata.is_file()) {
        return None;
    }
    let head = File::open(path).ok()?.take(HEAD_BYTES);
    let pairs = read_provenance(Kind::Png, head).ok()?;
    let value = |wanted: &str| pairs.iter().find(|(name, _)| name == wanted).map(|(_, value)| value.clone());
    if value(SHEET).is_some() { None } else { value(CAMERA) }
}

fn decoded(bytes: &[u8]) -> meniscus_formats::Result<Picture> {
    let limits = Limits { bytes: PIXELS_MAX * CHANNELS_MAX };
    let mut decoder = Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_transformations(Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(failed)?;
    let (width, height) = reader.info().size();
    let size = [width as usize, height as usize];
    let length = reader.output_buffer_size().filter(|_| size[0] * size[1] <= PIXELS_MAX);
    let length = length.ok_or_else(|| {
        let what = format!("{width} x {height} pixels; at most {PIXELS_MAX} are read");
        Error::too_large(FORMAT, what)
    })?;
    let mut samples = vec![0; length];
    let info = reader.next_frame(&mut samples).map_err(failed)?;
    samples.truncate(info.buffer_size());
    let bright: Vec<f32> = (0..=u8::MAX).map(linear).collect();
    let at = |sample: u8| bright[usize::from(sample)];
    let color: Vec<[f32; 3]> = match info.color_type {
        ColorType::Rgb => samples.chunks_exact(3).map(|p| [at(p[0]), at(p[1]), at(p[2])]).collect(),
        ColorType::Rgba => samples.chunks_exact(4).map(|p| [at(p[0]), at(p[1]), at(p[2])]).collect(),
        ColorType::Grayscale => samples.iter().map(|&p| [at(p); 3]).collect(),
        ColorType::GrayscaleAlpha => samples.chunks_exact(2).map(|p| [at(p[0]); 3]).collect(),
        ColorType::Indexed => {
            return Err(Error::unsupported(FORMAT, "its colours are indices of a palette that is not there"));
        }
    };
    Ok(Picture { size, coverage: vec![1.0; color.len()], color, data: None })
}

fn failed(error: DecodingError) -> Error {
    match error {
        DecodingError::IoError(source) if source.kind() == std::io::ErrorKind::UnexpectedEof => {
            Error::short(FORMAT, Place::File, "it ends too soon")
        }
        DecodingError::IoError(source) => Error::Io(source),
        DecodingError::LimitsExceeded => {
            Error::too_large(FORMAT, "it asks for more memory than a picture may")
        }
        other => Error::invalid(FORMAT, Place::File, other.to_string()),
    }
}

/// How bright a byte of sRGB is.
fn linear(byte: u8) -> f32 {
    let value = f32::from(byte) / 255.0;
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

const FORMAT: &str = "PNG";

/// The largest picture that this program takes.
const PIXELS_MAX: usize = 8192 * 8192;

/// Samples of a pixel.
const CHANNELS_MAX: usize = 4;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{PictureFormat, encode_picture};

    #[test]
    fn pictures_come_back_as_they_were_written() {
        let color = vec![[0.0, 1.0, 0.5], [0.2159, 0.002, 0.9], [0.7, 0.1, 0.04], [1.0; 3]];
        let picture = Picture { size: [2, 2], coverage: vec![1.0; 4], color, data: None };
        let bytes = encode_picture(&picture, None, PictureFormat::Png, &[]).expect("encoded");
        let read = decoded(&bytes).expect("a picture");
        assert_eq!(read.size, picture.size);
        for (read, written) in read.color.as_flattened().iter().zip(picture.color.as_flattened()) {
            assert!((read - written).abs() < 0.005, "{read} {written}");
        }
        for length in 0..bytes.len() {
            assert!(decoded(&bytes[..length]).is_err() || length + 12 >= bytes.len(), "{length}");
        }
    }

    #[test]
    fn what_says_that_it_is_huge_is_refused_before_there_is_room_for_it() {
        let picture = Picture { size: [1, 1], color: vec![[0.5; 3]], coverage: vec![1.0], data: None };
        let mut bytes = encode_picture(&picture, None, PictureFormat::Png, &[]).expect("encoded");
        // Width and height are behind the signature and the head of the first chunk, and before its checksum.
        bytes[16..24].copy_from_slice(&[0, 0, 0xff, 0xff, 0, 0, 0xff, 0xff]);
        let checksum = crc32(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&checksum.to_be_bytes());
        assert!(matches!(decoded(&bytes), Err(Error::TooLarge { .. })));
    }

    fn crc32(bytes: &[u8]) -> u32 {
        let step = |rest: u32, _| if rest & 1 == 1 { (rest >> 1) ^ 0xedb8_8320 } else { rest >> 1 };
        !bytes.iter().fold(!0, |rest, &byte| (0..8).fold(rest ^ u32::from(byte), step))
    }
}
