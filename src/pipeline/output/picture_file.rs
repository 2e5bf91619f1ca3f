//! Reads existing .png pictures for sheets.

use std::io::Read;
use std::path::Path;

use meniscus_formats::{ColorPicture, png};
use meniscus_formats::{OutputFormat, read_provenance};

use crate::render::Picture;

use crate::pipeline::error::{FrameError, Stage};
use crate::pipeline::files::open::{open_regular, read_regular};
use crate::pipeline::records::provenance::{CAMERA, HEAD_BYTES, SHEET};

/// Reads the colours of a picture, without transparency.
///
/// # Errors
/// When the system reports an error, the file is not such a picture, or the picture is too large.
pub fn read_picture(path: &Path) -> Result<Picture, FrameError> {
    let read = || png::read(&read_regular(path)?);
    let ColorPicture { size, color } = FrameError::catch(path, Stage::Read, read)?
        .map_err(|error| FrameError::file(path, Stage::Read, error))?;
    Ok(Picture { size, coverage: vec![1.0; color.len()], color, data: None })
}

/// The viewpoint of a frame's picture, as its provenance records it; `None` for a sheet, or a picture of
/// another program.
pub fn camera_of_picture(path: &Path) -> Option<String> {
    let is_png = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png"));
    if !is_png {
        return None;
    }
    let head = open_regular(path).ok()?.take(HEAD_BYTES);
    let pairs = read_provenance(OutputFormat::Png, head).ok()?;
    let value = |wanted: &str| pairs.iter().find(|(name, _)| name == wanted).map(|(_, value)| value.clone());
    if value(SHEET).is_some() { None } else { value(CAMERA) }
}
