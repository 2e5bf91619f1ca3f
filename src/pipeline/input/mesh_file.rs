//! Reads meshes of any supported format, with the buffer files of a `.gltf` and the layers of a USD file.

use std::io::{self, Read};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use glam::DVec3;
use meniscus_formats::compression::{name_without_compression, read_head};
use meniscus_formats::{
    Format, MeshData, Neighbor, gltf, looks_like_mesh, looks_like_particles, neighbor, read_mesh,
};
use twox_hash::XxHash3_128;
use twox_hash::xxhash3_128::Hasher;

use super::container::OpenContainer;
use super::obstacle_file::may_have_buffers;
use crate::pipeline::error::{FrameError, Stage};
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::files::named_files::path_of_named;
use crate::pipeline::files::open::{open_regular, read_regular};
use crate::pipeline::memory::reading_limits;
use crate::pipeline::records::content::{SniffedContent, own_content};
use crate::pipeline::target::viewpoint::Viewpoint;
use crate::render::{Picture, TriangleMesh, render_mesh};

/// The meshes of a USD stage or an Alembic archive, and whether they are animated: then those of the first samples.
/// `None` for other files.
///
/// # Errors
/// When the file cannot be read, or holds no meshes.
pub fn read_scene_mesh(path: &Path) -> meniscus_formats::Result<Option<(MeshData, bool)>> {
    let Some(open) = OpenContainer::open(path)? else { return Ok(None) };
    let Some(is_animated) = open.are_meshes_animated()? else { return Ok(None) };
    Ok(open.meshes(None)?.map(|mesh| (mesh, is_animated)))
}

/// A mesh that was read from a file.
#[derive(Clone, Debug)]
pub struct MeshFile {
    /// The mesh, which may be empty.
    pub data: MeshData,
    /// The XXH3 hash of the file and of those to which it refers, 128 bits.
    pub hash: u128,
}

impl MeshFile {
    /// Reads the mesh in a file of any supported mesh format.
    ///
    /// # Errors
    /// When the file cannot be read, or holds no mesh.
    pub fn read(path: &Path) -> Result<MeshFile, FrameError> {
        let fail = |error: meniscus_formats::Error| FrameError::file(path, Stage::Read, error);
        let bytes = read_regular(path).map_err(|error| fail(error.into()))?;
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let folder = path.parent().unwrap_or(Path::new(""));
        let further = Mutex::new(None::<Hasher>);
        let read_one = |relative: &str| {
            let further = path_of_named(folder, relative)?;
            if !may_have_buffers(path) {
                return read_regular(&further);
            }
            let files = gltf::external_files(&bytes).map_err(io::Error::other)?;
            let file = files.iter().find(|file| file.path == relative).ok_or(io::ErrorKind::NotFound)?;
            let mut content = Vec::new();
            open_regular(&further)?.take(file.byte_count).read_to_end(&mut content)?;
            Ok(content)
        };
        let read_external = |relative: &str| {
            let content = read_one(relative)?;
            let mut further = further.lock().unwrap_or_else(PoisonError::into_inner);
            further.get_or_insert_default().write(&content);
            Ok(content)
        };
        let read = || read_mesh(&bytes, &name, &reading_limits(), &read_external);
        let data = FrameError::catch(path, Stage::Read, read)?.map_err(fail)?;
        let further = further.into_inner().unwrap_or_else(PoisonError::into_inner);
        let hash = XxHash3_128::oneshot(&bytes) ^ further.map_or(0, |hasher| hasher.finish_128());
        Ok(MeshFile { data, hash })
    }

    fn scene(&self) -> TriangleMesh<'_> {
        let MeshData { positions, normals, triangles } = &self.data;
        TriangleMesh { positions, normals, triangles }
    }

    /// Number of triangles with a corner that is missing or not finite: pictures do not show them.
    pub fn broken_count(&self) -> usize {
        self.scene().broken_count()
    }

    /// The bounding box of the triangles, without outliers, in world units; `None` if there are none.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        self.scene().bounds()
    }

    /// Renders a picture, with the data of its pixels if `data` is set.
    pub fn picture(&self, viewpoint: &Viewpoint, size: [usize; 2], data: bool) -> Picture {
        render_mesh(&self.scene(), &viewpoint.view(size), data)
    }
}

/// Whether a file is a mesh, judged by its name and its first bytes. A damaged file counts as one if its
/// extension is that of meshes only; a file that cannot be opened does not.
pub fn is_mesh(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let Some((_, extension)) = name_without_compression(&name).rsplit_once('.') else { return false };
    let is_named = |format: &&Format| format.has_mesh() && format.extensions().contains(&extension);
    let Some(format) = Format::ALL.iter().find(is_named) else { return false };
    let Ok(head) = open_regular(path).and_then(|file| read_head(file, HEAD_BYTES)) else { return false };
    let has_faces =
        || InputFile::open(path).is_ok_and(|file| neighbor(&head, &name, &file) == Some(Neighbor::Mesh));
    // A mesh of an empty frame has no faces.
    let is_own_empty =
        || *format == Format::Obj && own_content(&head, &name) == Some(SniffedContent::OwnOutput);
    looks_like_mesh(&head, &name)
        || is_own_empty()
        || has_faces()
        || !format.has_particles() && !looks_like_particles(&head, &name)
}

/// More bytes than the headers of meshes.
const HEAD_BYTES: u64 = 64 << 10;

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn hash_contains_the_layers_of_a_stage() {
        let folder = tempfile::tempdir().expect("a folder");
        let [root, layer] = ["root.usda", "layer.usda"].map(|name| folder.path().join(name));
        fs::write(&root, "#usda 1.0\n( subLayers = [@./layer.usda@] )\n").expect("written");
        let hashes = [1, 2, 1].map(|x| {
            let text = format!(
                "#usda 1.0\ndef Mesh \"m\" {{ point3f[] points = [(0, 0, 0), ({x}, 0, 0), (0, 1, 0)] \
                 int[] faceVertexCounts = [3] int[] faceVertexIndices = [0, 1, 2] }}"
            );
            fs::write(&layer, text).expect("written");
            MeshFile::read(&root).expect("a mesh").hash
        });
        assert!(hashes[0] != hashes[1] && hashes[0] == hashes[2]);
    }
}
