//! Reads a mesh from a file in any supported format.

use crate::compression::name_without_compression;
use crate::data::MeshData;
use crate::error::{Error, Position, Result};
use crate::gltf::ReadExternal;
use crate::limits::Limits;
use crate::probe::{Probe, ProbedKind, probe};
use crate::table::{Format, listed};

/// Reads the triangles of a file in any supported mesh format, compressed or not. The content decides the
/// format. `read_external` reads the external buffers of a .gltf file. The mesh can be empty.
///
/// # Errors
/// The errors of the format's reader; [`Error::Unsupported`] if the file is not a mesh, or contains several
/// frames.
pub fn read_mesh(
    bytes: &[u8],
    file_name: &str,
    limits: &Limits,
    read_external: &ReadExternal,
) -> Result<MeshData> {
    let Probe { kind, codec } = probe_mesh(bytes, file_name);
    let Some(read) = reader_of(kind) else {
        return match kind {
            ProbedKind::Empty => Err(Error::truncated("", Position::File, "the file is empty")),
            _ => {
                let what = format!("not a supported mesh format: use {}", readable(&[]));
                Err(Error::unsupported(kind.name(), what))
            }
        };
    };
    match codec {
        Some(codec) => read(&codec.decompress(bytes, limits)?, limits, read_external),
        None => read(bytes, limits, read_external),
    }
}

/// Lists the extensions of all mesh formats and of `others`, joined as in a sentence.
pub(crate) fn readable(others: &[Format]) -> String {
    let formats = Format::ALL.iter().filter(|format| format.row().read_mesh.is_some()).chain(others);
    let extensions = formats.flat_map(|format| format.extensions());
    listed(extensions.map(|extension| format!(".{extension}")).collect(), "or")
}

/// Recognises a file that may be a mesh.
pub(crate) fn probe_mesh(bytes: &[u8], file_name: &str) -> Probe {
    let Probe { mut kind, codec } = probe(bytes, file_name);
    // Some OBJ files look like a table because of the order of their lines, so the name decides.
    let name = file_name.to_ascii_lowercase();
    let is_vague = matches!(kind, ProbedKind::Format(Format::Delimited) | ProbedKind::UnknownText);
    if is_vague && name_without_compression(&name).ends_with(".obj") {
        kind = ProbedKind::Format(Format::Obj);
    }
    Probe { kind, codec }
}

/// Turns the decompressed bytes of a file into a mesh.
type MeshFileReader = fn(&[u8], &Limits, &ReadExternal) -> Result<MeshData>;

/// The mesh reader for files of this kind.
pub(crate) fn reader_of(kind: ProbedKind) -> Option<MeshFileReader> {
    kind.format()?.row().read_mesh
}
