//! Whether a file that a writer of this crate made is all there.
//!
//! A copy that was broken off, or a disk that was full, leaves the beginning of a file, which is
//! also where its provenance is. The end tells, and costs little to look at:
//!
//! ```text
//!   .glb    the header says how long the file is
//!   .gltf   the document parses to its end
//!   .obj    the last line is the writer's own     # end: 642 vertices, 1280 triangles
//!   .ply    the header says what follows; faces are triangles
//!   .vdb    the descriptor says where the grid ends
//! ```
//!
//! Bytes that were overwritten are not looked for: a file of the right length may still be damaged
//! inside.

use std::io::{Read, Seek, SeekFrom};

use serde::de::IgnoredAny;

use crate::error::Result;
use crate::limits::Limits;
use crate::provenance::{HEAD_BYTES_MAX, Kind};
use crate::{gltf, obj, ply, vdb};

/// Whether a file that a writer of this crate made has neither lost its end nor grown. Other
/// programs' files may well be whole and not be told so.
///
/// # Errors
///
/// [`crate::Error::Io`] if reading fails; [`crate::Error::Invalid`] if the head is not of this kind.
pub fn is_whole(kind: Kind, file: &mut (impl Read + Seek)) -> Result<bool> {
    let file_bytes = file.seek(SeekFrom::End(0))?;
    let expected_bytes = match kind {
        Kind::Gltf => return is_whole_json(file),
        Kind::Obj => return Ok(obj::ends_as_written(&tail(file, file_bytes)?)),
        Kind::Glb => gltf::glb_bytes_claimed(&head(file)?)?,
        Kind::Ply => ply::mesh_bytes_claimed(&head(file)?, &Limits::default())?,
        Kind::Vdb => vdb::only_grid_end(&head(file)?)?,
    };
    Ok(expected_bytes == Some(file_bytes))
}

fn is_whole_json(file: &mut (impl Read + Seek)) -> Result<bool> {
    let mut text = Vec::new();
    file.seek(SeekFrom::Start(0))?;
    file.read_to_end(&mut text)?;
    // The line end is the writer's last byte.
    Ok(text.ends_with(b"\n") && serde_json::from_slice::<IgnoredAny>(&text).is_ok())
}

fn head(file: &mut (impl Read + Seek)) -> Result<Vec<u8>> {
    let mut head = Vec::new();
    file.seek(SeekFrom::Start(0))?;
    file.take(HEAD_BYTES_MAX).read_to_end(&mut head)?;
    Ok(head)
}

fn tail(file: &mut (impl Read + Seek), file_bytes: u64) -> Result<Vec<u8>> {
    const TAIL_BYTES: u64 = 256; // more than the last line has
    let mut tail = Vec::new();
    file.seek(SeekFrom::Start(file_bytes.saturating_sub(TAIL_BYTES)))?;
    file.take(TAIL_BYTES).read_to_end(&mut tail)?;
    Ok(tail)
}
