//! From a surface to files, one for each format.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use meniscus_formats::{LevelSetView, MeshView, gltf, obj, ply, vdb};

use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::skin::Surface;

use super::frame::{Frame, FrameError, Stage};
use super::outputs::{OutputFormat, OutputOptions, output_path};
use super::provenance::provenance;
use super::sink::{Unseen, publish, write_unseen};

/// Half the thickness of the band in a .vdb, in voxels: what programs expect of a level set.
const VDB_HALF_WIDTH_VOXELS: f32 = 3.0;

/// The files of a frame.
pub(super) struct Written {
    pub(super) paths: Vec<PathBuf>,
    pub(super) sizes_bytes: Vec<u64>,
}

/// Writes a frame in every format, each as `encoded` gives it: all of these files appear, whole and
/// together, or none. Their folder is made where it is missing.
///
/// # Errors
/// The first file that cannot be written.
pub(super) fn write_files(
    frame: &Frame,
    encoded: impl Fn(OutputFormat) -> meniscus_formats::Result<Vec<u8>>,
) -> Result<Written, FrameError> {
    let OutputOptions { folder, formats, .. } = &*frame.outputs;
    let fail = |path: &Path, error| FrameError::file(path, Stage::Write, error);
    fs::create_dir_all(folder).map_err(|error| fail(folder, error.into()))?;
    let write_one = |&format: &OutputFormat| {
        let path = output_path(folder, &frame.stem, format);
        let bytes = encoded(format).map_err(|error| fail(&path, error))?;
        write_unseen(&path, |out| Ok(out.write_all(&bytes)?)).map_err(|error| fail(&path, error))
    };
    let unseen: Vec<Unseen> = formats.iter().map(write_one).collect::<Result<_, _>>()?;
    let sizes_bytes = unseen.iter().map(Unseen::size_bytes).collect();
    let paths = publish(unseen).map_err(|(path, error)| fail(&path, error.into()))?;
    Ok(Written { paths, sizes_bytes })
}

/// The bytes of the file in `format`. It is encoded as a whole before any of it is written: threads that
/// compute do not wait for the disk.
///
/// # Errors
/// When the format has no place for so much.
pub(super) fn encode(
    surface: &Surface,
    frame: &Frame,
    input_hash: u128,
    format: OutputFormat,
) -> meniscus_formats::Result<Vec<u8>> {
    let options = &*frame.outputs;
    let provenance = provenance(&frame.settings, &frame.input, input_hash, format, options);
    let mut out = Vec::new();
    let mesh = mesh_view(&surface.mesh);
    match format {
        OutputFormat::Vdb => {
            let origins = leaf_origins(&surface.band);
            let levels = LevelSetView {
                origins: &origins,
                leaves: surface.band.phi.as_arrays(),
                half_width_voxels: VDB_HALF_WIDTH_VOXELS,
                voxel_size: frame.settings.voxel_size,
            };
            let write_options = vdb::WriteOptions {
                half: options.vdb_half,
                compression: options.vdb_compression,
                ..vdb::WriteOptions::default()
            };
            vdb::write(&levels, &write_options, &provenance, &mut out)
        }
        OutputFormat::Glb => gltf::write_glb(&mesh, &gltf_options(options), &provenance, &mut out),
        OutputFormat::Gltf => gltf::write_gltf(&mesh, &gltf_options(options), &provenance, &mut out),
        OutputFormat::Obj => obj::write(&mesh, &obj::WriteOptions::default(), &provenance, &mut out),
        OutputFormat::Ply => ply::write::write_mesh(&mesh, &provenance, &mut out),
    }?;
    Ok(out)
}

fn gltf_options(options: &OutputOptions) -> gltf::WriteOptions {
    gltf::WriteOptions { up: options.up, ..gltf::WriteOptions::default() }
}

fn mesh_view(mesh: &Mesh) -> MeshView<'_> {
    MeshView {
        positions: bytemuck::cast_slice(&mesh.positions),
        normals: bytemuck::cast_slice(&mesh.normals),
        triangles: &mesh.triangles,
        origin: mesh.origin.to_array(),
    }
}

fn leaf_origins(band: &NarrowBand) -> Vec<[i32; 3]> {
    band.topology.origins().iter().map(|origin| origin.to_array()).collect()
}
