//! A mesh from a file of any format that has one.

use crate::compression::unpacked_name;
use crate::data::MeshData;
use crate::error::{Error, Place, Result};
use crate::gltf::Beside;
use crate::limits::Limits;
use crate::probe::{Kind, Probe, probe};
use crate::table::{Format, listed};

/// Reads the triangles of a file of any format that has some, compressed or not. The content decides what the format is.
/// `beside` gives the buffers of a .gltf that are files of their own. A mesh may be empty.
///
/// # Errors
/// Those of the format's reader; [`Error::Unsupported`] for a file that is something else, or a shot of several frames.
pub fn read_mesh(bytes: &[u8], file_name: &str, limits: &Limits, beside: &Beside) -> Result<MeshData> {
    let Probe { kind, codec } = probe_mesh(bytes, file_name);
    let Some(read) = reader_of(kind) else {
        return match kind {
            Kind::Empty => Err(Error::short("", Place::File, "the file is empty")),
            _ => {
                let what = format!("not a format that meshes are read from: use {}", readable(&[]));
                Err(Error::unsupported(kind.name(), what))
            }
        };
    };
    match codec {
        Some(codec) => read(&codec.unpack(bytes, limits)?, limits, beside),
        None => read(bytes, limits, beside),
    }
}

/// The extensions of the formats that meshes are read from, and `others`, in a sentence.
pub(crate) fn readable(others: &[Format]) -> String {
    let formats = Format::ALL.iter().filter(|format| format.row().read_mesh.is_some()).chain(others);
    let extensions = formats.flat_map(|format| format.extensions());
    listed(extensions.map(|extension| format!(".{extension}")).collect(), "or")
}

/// What a file is that may be a mesh.
pub(crate) fn probe_mesh(bytes: &[u8], file_name: &str) -> Probe {
    let Probe { mut kind, codec } = probe(bytes, file_name);
    // Some lines of an OBJ file, in an order of their own, look like a table.
    let name = file_name.to_ascii_lowercase();
    let is_vague = matches!(kind, Kind::Format(Format::Delimited) | Kind::UnknownText);
    if is_vague && unpacked_name(&name).ends_with(".obj") {
        kind = Kind::Format(Format::Obj);
    }
    Probe { kind, codec }
}

/// Turns the decompressed bytes of a file into a mesh.
type Reader = fn(&[u8], &Limits, &Beside) -> Result<MeshData>;

/// What reads meshes from files of this kind.
pub(crate) fn reader_of(kind: Kind) -> Option<Reader> {
    kind.format()?.row().read_mesh
}
