//! `meniscus contact-sheet` and `meniscus tune`: many pictures on one sheet.
//!
//! ```text
//!   contact   an overview of a sequence
//!   tune      a frame under many settings, with the command for each
//! ```

mod contact;
mod tune;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

use crate::pipeline::{
    CameraChoice, OutputFormat, PictureOptions, SheetPart, Viewpoint, check_outputs, encode_picture,
    output_path, sheet_provenance,
};
use crate::render::Sheet;

use super::args::PictureArgs;
use super::console::Console;
use super::destination::{OutFolder, write_file};
use super::quantities::PictureSize;
use super::render_session::{RenderSession, named_picture};
use super::wording::with_causes;

pub(super) use contact::contact_sheet;
pub(super) use tune::{VariedOption, tune};

/// The output file of a sheet.
struct SheetFile {
    folder: PathBuf,
    stem: String,
}

impl SheetFile {
    /// Creates its folder, checks that no input is replaced, and starts a session for pictures of this size.
    /// Warns about options that have no effect on the formats `written`, which by default are those of the
    /// sheet.
    fn prepare<'a>(
        output: &Path,
        args: &'a PictureArgs,
        size: PictureSize,
        inputs: &[PathBuf],
        written: Option<&[OutputFormat]>,
        console: &Console,
    ) -> Result<(SheetFile, RenderSession<'a>)> {
        let (folder, stem, _) = named_picture(output, &["png"])?;
        let session = RenderSession::new(args, folder.clone(), OutputFormat::Png, size)?;
        session.warn_of_ignored(written.unwrap_or(&session.outputs.formats), console);
        let out_folder = OutFolder::make(&folder)?;
        let planned = [(inputs.first().cloned().unwrap_or_default(), stem.clone())];
        check_outputs(&planned, inputs, &session.obstacles, &session.outputs, &[])?;
        out_folder.keep();
        Ok((SheetFile { folder, stem }, session))
    }

    /// Draws a sheet of this kind, and writes it.
    fn write(&self, sheet: &Sheet, kind: &str, parts: &[SheetPart]) -> Result<String> {
        let picture = sheet.picture();
        let bytes = encode_picture(&picture, None, OutputFormat::Png, &sheet_provenance(kind, parts))?;
        let path = output_path(&self.folder, &self.stem, OutputFormat::Png);
        write_file(&path, |out| out.write_all(&bytes))?;
        let name = path.strip_prefix(".").unwrap_or(&path).display().to_string();
        let [width, height] = picture.size;
        Ok(format!("{name}: {width}x{height} pixels"))
    }
}

/// Refuses sheets that are too large to view, or for the memory limit, before any work starts.
fn refuse_large(cell_count: usize, [width, height]: PictureSize, memory_bytes: u64) -> Result<()> {
    let pixel_count = cell_count * usize::from(width) * usize::from(height);
    if pixel_count > PIXELS_MAX {
        bail!(
            "{cell_count} cells of {width}x{height} pixels are {} million pixels, and a sheet has {} million at most: \
             choose fewer cells or a smaller --size",
            pixel_count / 1_000_000,
            PIXELS_MAX / 1_000_000
        );
    }
    let needed_bytes = pixel_count as u64 * PIXEL_BYTES;
    if needed_bytes > memory_bytes {
        bail!(
            "{cell_count} cells of {width}x{height} pixels need {} MiB of memory, and the limit is {} MiB: raise \
             --memory, or choose fewer cells or a smaller --size",
            needed_bytes.div_ceil(1 << 20),
            memory_bytes >> 20
        );
    }
    Ok(())
}

/// Maximum number of pixels of a sheet.
const PIXELS_MAX: usize = 64_000_000;

/// Memory per pixel in bytes: colour and coverage, in the cell and on the sheet, and the encoded bytes.
const PIXEL_BYTES: u64 = 40;

/// The number of columns of an approximately square sheet with few empty cells.
fn even_columns(cell_count: usize) -> usize {
    let least = (cell_count as f64).sqrt().ceil() as usize;
    let empty = |columns: &usize| columns * cell_count.div_ceil(*columns) - cell_count;
    (least.max(1)..=least + EXTRA_COLUMNS).min_by_key(empty).unwrap_or(1)
}

/// A sheet may have up to this many columns more than a square one, to have fewer empty cells.
const EXTRA_COLUMNS: usize = 2;

/// The reason why a frame has no picture, as text for its cell. The path of the frame's file is removed,
/// because the cell names the frame already.
fn reason(error: &anyhow::Error, path: &Path) -> String {
    let message = with_causes(error);
    let bare = message.strip_prefix(&format!("{}: ", path.display()));
    format!("failed: {}", bare.unwrap_or(&message))
}

/// The picture options of the session, with this viewpoint as the camera.
fn fixed(session: &RenderSession, viewpoint: Viewpoint) -> PictureOptions {
    PictureOptions { camera: CameraChoice::from(viewpoint), ..session.outputs.picture }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sheets_are_about_square_and_nearly_full() {
        for (cell_count, columns) in
            [(1, 1), (2, 2), (3, 3), (4, 2), (5, 5), (7, 4), (8, 4), (12, 4), (60, 10)]
        {
            assert_eq!(even_columns(cell_count), columns, "{cell_count}");
        }
        for cell_count in 1..200 {
            let columns = even_columns(cell_count);
            assert!(columns >= cell_count.div_ceil(columns), "{cell_count}: higher than wide");
        }
    }

    #[test]
    fn too_many_pixels_are_refused() {
        let refused = |cell_count, size, memory_bytes| refuse_large(cell_count, size, memory_bytes);
        assert!(refused(60, [1024, 1024], 4 << 30).is_ok());
        let why = refused(1000, [640, 360], u64::MAX).expect_err("too many").to_string();
        assert!(why.contains("230 million") && why.contains("64 million"), "{why}");
        let why = refused(60, [1024, 1024], 1 << 30).expect_err("too little memory").to_string();
        assert!(why.contains("need 2400 MiB of memory, and the limit is 1024 MiB"), "{why}");
    }
}
