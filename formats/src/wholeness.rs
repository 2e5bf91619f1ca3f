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
//!   .vtp    the data and the document are closed as the writer closes them
//!   .stl    the head says how many triangles follow
//!   .usda   the last line is the writer's own     # end: 642 vertices, 1280 faces
//!   .vdb    each grid's descriptor says where it ends, and where the next one is
//!   .png    the last chunk says that it is the last
//!   .exr    the last block says how long it is
//! ```
//!
//! Bytes that were overwritten are not looked for: a file of the right length may still be damaged
//! inside.

use std::io::{Read, Seek, SeekFrom};

use serde::de::IgnoredAny;

use crate::error::Result;
use crate::limits::Limits;
use crate::provenance::{HEAD_BYTES_MAX, Kind};
use crate::{exr, gltf, obj, ply, png, stl, usda, vdb, vtk};

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
        Kind::Vtp => return Ok(vtk::ends_as_written(&tail(file, file_bytes)?)),
        Kind::Usda => return Ok(usda::ends_as_written(&tail(file, file_bytes)?)),
        Kind::Stl => stl::bytes_claimed(&head(file)?),
        Kind::Png => return Ok(png::ends_as_written(&tail(file, file_bytes)?)),
        Kind::Exr => exr::bytes_claimed(&head(file)?, |start| piece(file, start, exr::BLOCK_HEAD_BYTES))?,
        Kind::Glb => gltf::glb_bytes_claimed(&head(file)?)?,
        Kind::Ply => ply::mesh_bytes_claimed(&head(file)?, &Limits::default())?,
        Kind::Vdb => vdb::last_grid_end(&head(file)?, |start| piece(file, start, DESCRIPTOR_BYTES_MAX))?,
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

/// More bytes than the descriptor of a grid has that a writer of this crate made.
const DESCRIPTOR_BYTES_MAX: u64 = 64 << 10;

fn head(file: &mut (impl Read + Seek)) -> Result<Vec<u8>> {
    piece(file, 0, HEAD_BYTES_MAX)
}

/// The bytes from `start` on, so many if there are.
fn piece(file: &mut (impl Read + Seek), start: u64, byte_count: u64) -> Result<Vec<u8>> {
    let mut piece = Vec::new();
    file.seek(SeekFrom::Start(start))?;
    file.take(byte_count).read_to_end(&mut piece)?;
    Ok(piece)
}

fn tail(file: &mut (impl Read + Seek), file_bytes: u64) -> Result<Vec<u8>> {
    const TAIL_BYTES: u64 = 256; // more than the last line has
    piece(file, file_bytes.saturating_sub(TAIL_BYTES), TAIL_BYTES)
}
