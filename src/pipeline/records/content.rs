//! Recognises frames, outputs of this program and other files by their first bytes.

use std::io;
use std::path::{Path, PathBuf};

use meniscus_formats::compression::read_head;
use meniscus_formats::container::is_container;
use meniscus_formats::provenance::{CONTENTS, SPRAY};
use meniscus_formats::{
    Content, Format, Neighbor, OutputFormat, PointFormat, has_columns, looks_like_particles, neighbor, probe,
    read_provenance,
};

use super::provenance::{HEAD_BYTES, are_particles};
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::files::open::open_regular;
use crate::pipeline::input::frame::Job;
use crate::pipeline::input::level_set_file::is_level_set;
use crate::pipeline::input::source::promises_particles;
use crate::pipeline::input::steps::{ContainerContent, content_of_container};
use crate::pipeline::output::spray_files::SPRAY_CLASS;
use crate::pipeline::target::outputs::{OutputKind, OutputOptions, has_spray_name, spray_path};
use crate::surface::options::ColumnNames;

/// The kind of a file, by its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SniffedContent {
    /// A frame, or a file whose name claims to be one: it is read, if only to report what is wrong with it.
    Particles,
    /// Particles that this program wrote, with `--particles-only`: a frame, too.
    OwnParticles,
    /// Another output of this program.
    OwnOutput,
    /// A file of a simulation in a format of particles, such as a mesh.
    Neighbor(Neighbor),
    /// Anything else.
    NotParticles,
}

impl SniffedContent {
    /// Whether the file counts as a frame.
    pub fn is_frame(self) -> bool {
        matches!(self, SniffedContent::Particles | SniffedContent::OwnParticles)
    }

    /// Whether it may be data of another program, which must not be replaced.
    pub fn is_data(self) -> bool {
        self.is_frame() || matches!(self, SniffedContent::Neighbor(_))
    }
}

/// Like [`content`], for conversions with new names for columns: a table that has these columns is a frame.
///
/// # Errors
/// When the file cannot be read.
pub fn content_with(path: &Path, columns: Option<&ColumnNames>) -> io::Result<SniffedContent> {
    let found = content(path)?;
    let may_be_table =
        matches!(found, SniffedContent::NotParticles | SniffedContent::Neighbor(Neighbor::Table));
    match columns {
        Some(columns) if may_be_table && path.metadata()?.is_file() => {
            let (head, name) = head_and_name(path)?;
            let is_table = has_columns(&head, &name, columns.pairs());
            Ok(if is_table { SniffedContent::Particles } else { found })
        }
        _ => Ok(found),
    }
}

/// Reads the first bytes of a file and returns its kind.
///
/// # Errors
/// When the file cannot be read.
pub fn content(path: &Path) -> io::Result<SniffedContent> {
    if !path.metadata()?.is_file() {
        return Ok(SniffedContent::NotParticles);
    }
    let (head, name) = head_and_name(path)?;
    if let Some(own) = own_content(&head, &name) {
        return Ok(own);
    }
    let kind = probe(&head, &name).kind;
    // If its structure cannot be read, reading it reports what is wrong.
    let found = is_container(kind).then(|| content_of_container(path).unwrap_or(ContainerContent::Frames));
    if found == Some(ContainerContent::Frames) {
        return Ok(SniffedContent::Particles);
    }
    if let Some(neighbor) = neighbor(&head, &name, &InputFile::open(path)?) {
        return Ok(SniffedContent::Neighbor(neighbor));
    }
    if found == Some(ContainerContent::NoParticles) {
        return Ok(SniffedContent::NotParticles);
    }
    let promises = promises_particles(&name) || is_level_set(path);
    let is_frame = promises || looks_like_particles(&head, &name);
    Ok(if is_frame { SniffedContent::Particles } else { SniffedContent::NotParticles })
}

/// The first output of `job` for the frame with this stem that would replace particles, or a mesh or a level set of
/// another program: they may be the only copy.
///
/// # Errors
/// The first output that exists but cannot be read, and why.
pub(crate) fn irreplaceable_output(
    stem: &str,
    options: &OutputOptions,
    job: Job,
) -> Result<Option<PathBuf>, (PathBuf, io::Error)> {
    for (kind, output) in options.files(stem) {
        let may_be_data = match kind {
            // Programs for scanning write points as OBJ; this one writes meshes only.
            OutputKind::Frame(format) => {
                let is_level_set = matches!(format.content(), Content::LevelSet);
                format == OutputFormat::Obj || format.particles().is_some() || is_level_set
            }
            OutputKind::Spray(_) => true,
        };
        if !may_be_data {
            continue;
        }
        match is_irreplaceable(&output, job) {
            Ok(false) => {}
            Ok(true) => return Ok(Some(output)),
            Err(error) => return Err((output, error)),
        }
    }
    Ok(None)
}

/// Whether a file must not be replaced by an output of `job`: its format is one for particles or level sets,
/// and this program did not write it. Particles that it wrote may only be replaced by particles. An extension
/// is not sufficient, so an empty file, such as one that reserves a name, may be replaced.
///
/// # Errors
/// When the file exists but cannot be read.
fn is_irreplaceable(path: &Path, job: Job) -> io::Result<bool> {
    let (head, name) = match path.metadata() {
        Ok(metadata) if metadata.is_file() => head_and_name(path)?,
        Ok(_) => return Ok(false),
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            return Ok(false);
        }
        Err(error) => return Err(error),
    };
    Ok(match own_content(&head, &name) {
        Some(SniffedContent::OwnParticles) => job != Job::Particles,
        Some(_) => false,
        None => match probe(&head, &name).kind.format() {
            Some(Format::Vdb) => true,
            Some(Format::Obj) => neighbor(&head, &name, &InputFile::open(path)?).is_none(),
            _ => looks_like_particles(&head, &name),
        },
    })
}

fn head_and_name(path: &Path) -> io::Result<(Vec<u8>, String)> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    Ok((read_head(open_regular(path)?, HEAD_BYTES)?, name))
}

/// The points beside a mesh that this program wrote, if there are any.
pub fn spray_beside(mesh: &Path) -> Option<PathBuf> {
    let (folder, stem) = (mesh.parent()?, mesh.file_stem()?.to_string_lossy());
    let mut paths = PointFormat::ALL.into_iter().map(|format| spray_path(folder, &stem, format));
    paths.find(|path| path.is_file() && is_spray(path))
}

/// The points that were written together with a mesh.
#[derive(Debug, PartialEq)]
pub(crate) enum SprayOfMesh {
    /// The mesh was made without `--spray`.
    None,
    Found(PathBuf, PointFormat),
    /// No file has its name.
    Missing,
    /// The file with its name has other contents.
    Other(PathBuf),
}

/// The setting, as recorded with a mesh, whose points are beside it.
const SPRAY_SETTING: &str = "spray";

/// Formats in which points are looked for: last those without provenance, whose files may be of an earlier run.
const LOOKED_FOR: [PointFormat; 6] = [
    PointFormat::Usdc,
    PointFormat::Usda,
    PointFormat::Abc,
    PointFormat::Vtp,
    PointFormat::Ply,
    PointFormat::Bgeo,
];

/// Finds the points that were written together with the mesh that has this provenance. A later run may have replaced
/// the mesh only, so what is recorded with both must not differ.
pub(crate) fn spray_of(mesh: &Path, recorded: &[(String, String)]) -> SprayOfMesh {
    if !recorded.iter().any(|(name, _)| name == SPRAY_SETTING) {
        return SprayOfMesh::None;
    }
    let is_recorded = |(name, value): &(String, String)| {
        recorded.iter().all(|(known, other)| known != name || value == other)
    };
    let (folder, stem) = (mesh.parent().unwrap_or(Path::new("")), mesh.file_stem().unwrap_or_default());
    let mut other = None;
    for format in LOOKED_FOR {
        let path = spray_path(folder, &stem.to_string_lossy(), format);
        let found = match head_and_name(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            head => head.ok().and_then(|(head, name)| spray_provenance_in(&head, &name)),
        };
        if found.is_some_and(|pairs| pairs.iter().all(is_recorded)) {
            return SprayOfMesh::Found(path, format);
        }
        other.get_or_insert(path);
    }
    other.map_or(SprayOfMesh::Missing, SprayOfMesh::Other)
}

/// Whether a file has points that this program wrote beside a surface; false if it cannot be read.
pub fn is_spray(path: &Path) -> bool {
    has_spray_name(path) && head_and_name(path).is_ok_and(|(head, name)| is_spray_head(&head, &name))
}

/// Whether these are the first bytes of points beside a surface.
fn is_spray_head(head: &[u8], name: &str) -> bool {
    spray_provenance_in(head, name).is_some()
}

/// The provenance in the first bytes of points beside a surface; `None` for other files. Formats without provenance have
/// their attribute.
fn spray_provenance_in(head: &[u8], name: &str) -> Option<Vec<(String, String)>> {
    match probe(head, name).kind.format().and_then(Format::output) {
        Some(format) => read_provenance(format, head)
            .ok()
            .filter(|recorded| recorded.iter().any(|(key, value)| key == CONTENTS && value == SPRAY)),
        None => {
            let has_class = head.windows(SPRAY_CLASS.len()).any(|bytes| bytes == SPRAY_CLASS.as_bytes());
            has_class.then(Vec::new)
        }
    }
}

/// The content of a file whose first bytes contain this program's provenance, or of points beside a surface.
pub(crate) fn own_content(head: &[u8], name: &str) -> Option<SniffedContent> {
    if has_spray_name(Path::new(name)) && is_spray_head(head, name) {
        return Some(SniffedContent::OwnOutput);
    }
    let format = probe(head, name).kind.format().and_then(Format::output);
    let format = format.filter(|format| !format.is_picture())?;
    // A damaged head contains no provenance.
    let recorded = read_provenance(format, head).ok()?;
    let is_own = recorded.iter().any(|(name, _)| name == "generator");
    let content =
        if are_particles(&recorded) { SniffedContent::OwnParticles } else { SniffedContent::OwnOutput };
    is_own.then_some(content)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    use tempfile::tempdir;

    #[test]
    fn content_distinguishes_frames_outputs_and_other_files() {
        use meniscus_formats::{MeshOptions, MeshView, gltf, ply};
        let folder = tempdir().expect("a folder");
        let of = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            fs::write(&path, bytes).expect("written");
            content(&path).expect("readable")
        };
        assert_eq!(of("a.ply", b"ply\nformat ascii 1.0\ncomment by hand\n"), SniffedContent::Particles);
        assert_eq!(of("broken.ply", b"what is this"), SniffedContent::Particles);
        assert_eq!(of("empty.bgeo", b""), SniffedContent::Particles);
        assert_eq!(of("table.txt", b"x y z\n1 2 3\n"), SniffedContent::Particles);
        assert_eq!(of("frame.0001", b"BgeoV\0\0\0\x05"), SniffedContent::Particles);
        assert_eq!(of("readme.txt", b"Read me, please.\n"), SniffedContent::NotParticles);
        assert_eq!(of("points.obj", b"v 1 2 3\nv 4 5 6\n"), SniffedContent::Particles);
        let mesh = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
        assert_eq!(of("mesh.obj", mesh), SniffedContent::Neighbor(Neighbor::Mesh));
        let mesh = MeshView {
            positions: &[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            normals: &[[0.0, 0.0, 1.0]; 3],
            triangles: &[[0, 1, 2]],
            origin: [0.0; 3],
            attributes: &[],
        };
        let maker = [("generator".to_owned(), "meniscus".to_owned())];
        let mut bytes = Vec::new();
        ply::write::write_mesh(&mesh, &maker, &mut bytes).expect("written");
        assert_eq!(of("surface.ply", &bytes), SniffedContent::OwnOutput);
        bytes.clear();
        ply::write::write_mesh(&mesh, &[], &mut bytes).expect("written");
        assert_eq!(of("foreign.ply", &bytes), SniffedContent::Neighbor(Neighbor::Mesh));
        let pvd = b"<VTKFile type=\"Collection\"><Collection/></VTKFile>";
        assert_eq!(of("all.pvd", pvd), SniffedContent::Neighbor(Neighbor::Index));
        assert_eq!(of("cut_off.vtk", b"# vtk DataFile Version 3.0\n"), SniffedContent::Particles);
        bytes.clear();
        OutputFormat::Obj.write_mesh(&mesh, &MeshOptions::default(), &maker, &mut bytes).expect("written");
        assert_eq!(of("surface.obj", &bytes), SniffedContent::OwnOutput);
        bytes.clear();
        gltf::write_glb(&mesh, &MeshOptions::default(), &maker, &mut bytes).expect("written");
        assert_eq!(of("surface.glb", &bytes), SniffedContent::OwnOutput);
        assert!(content(&folder.path().join("gone.ply")).is_err());
    }
}
