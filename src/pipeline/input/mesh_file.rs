//! Reads meshes of any supported format, with the buffer files of a `.gltf`.

use std::io::{self, Read};
use std::path::Path;

use meniscus_formats::{Limits, MeshData, gltf, read_mesh};

use crate::pipeline::error::{FrameError, Stage};
use crate::pipeline::files::open::{open_regular, read_regular};

/// Reads the mesh in a file of any supported mesh format. The mesh may be empty.
///
/// # Errors
/// When the file cannot be read, or holds no mesh.
pub fn read_mesh_file(path: &Path) -> Result<MeshData, FrameError> {
    let fail = |error: meniscus_formats::Error| FrameError::file(path, Stage::Read, error);
    let bytes = read_regular(path).map_err(|error| fail(error.into()))?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let read_external = |relative: &str| {
        let files = gltf::external_files(&bytes).map_err(io::Error::other)?;
        let file = files.iter().find(|file| file.path == relative).ok_or(io::ErrorKind::NotFound)?;
        let mut content = Vec::new();
        let at = path.parent().unwrap_or(Path::new("")).join(relative);
        open_regular(&at)?.take(file.byte_count).read_to_end(&mut content)?;
        Ok(content)
    };
    let read = || read_mesh(&bytes, &name, &Limits::default(), &read_external);
    FrameError::catch(path, Stage::Read, read)?.map_err(fail)
}
