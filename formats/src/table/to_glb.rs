//! Converts the mesh of a file of this crate to a `.glb` of the same mesh: sequences are assembled from `.glb` files.

use std::borrow::Cow;

use crate::core::data::{FileAttribute, MeshView, VertexAttribute};
use crate::core::error::Result;
use crate::core::limits::Limits;
use crate::core::options::MeshOptions;
use crate::core::placed_mesh::StoredMesh;
use crate::meshes::gltf::{naming_notes, write_glb};
use crate::usd::usdc;

/// Reads the mesh of a file with one frame, as it is stored.
type StoredMeshReader = fn(&[u8], &Limits) -> Result<StoredMesh>;

/// Whether [`to_glb`] converts a file that starts with these bytes: an `.abc` or a `.usdc`.
pub fn becomes_glb(head: &[u8]) -> bool {
    reader_of(head).is_some()
}

fn reader_of(head: &[u8]) -> Option<StoredMeshReader> {
    if crate::abc::is_archive(head) {
        Some(crate::abc::read_stored)
    } else if usdc::is_layer(head) {
        Some(usdc::read_stored)
    } else {
        None
    }
}

/// Converts an `.abc` or a `.usdc` of this crate with one frame to a `.glb`. Also returns notes on attributes that a `.glb`
/// does not hold exactly. Frees the bytes before it makes the `.glb`, so that the two are not in memory at once. Returns
/// the bytes themselves for other files.
///
/// # Errors
///
/// Those of the readers of the two formats, and of [`write_glb`].
pub fn to_glb<'a>(bytes: impl Into<Cow<'a, [u8]>>, limits: &Limits) -> Result<(Vec<u8>, Vec<String>)> {
    let bytes = bytes.into();
    let Some(read) = reader_of(&bytes) else { return Ok((bytes.into_owned(), Vec::new())) };
    let StoredMesh { mesh: stored, up, provenance } = read(&bytes, limits)?;
    let byte_count = bytes.len();
    drop(bytes);
    // A vector that grows would need up to twice as many bytes.
    let mut glb = Vec::with_capacity(byte_count);
    let views: Vec<VertexAttribute> = stored.attributes.iter().filter_map(FileAttribute::view).collect();
    let mesh = MeshView {
        positions: stored.positions.as_chunks().0,
        normals: stored.normals.as_chunks().0,
        triangles: &stored.triangles,
        origin: stored.origin,
        attributes: if stored.positions.is_empty() { &[] } else { &views },
    };
    write_glb(&mesh, &MeshOptions { up, ..MeshOptions::default() }, &provenance, &mut glb)?;
    Ok((glb, naming_notes(mesh.attributes)))
}
