//! From a surface to files, one for each format.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use meniscus_formats::{LevelSetView, MeshView, Provenance, gltf, obj, ply, vdb};

use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::skin::Surface;

use super::crew::Crew;
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

/// Writes a frame in every format, each as `write` does it: all of these files appear, whole and
/// together, or none. Their folder is made where it is missing.
///
/// # Errors
/// The first file that cannot be written.
pub(super) fn write_files(
    frame: &Frame,
    write: impl Fn(OutputFormat, &mut BufWriter<&File>) -> meniscus_formats::Result<()>,
) -> Result<Written, FrameError> {
    let OutputOptions { folder, formats, .. } = &*frame.outputs;
    let fail = |path: &Path, error| FrameError::file(path, Stage::Write, error);
    fs::create_dir_all(folder).map_err(|error| fail(folder, error.into()))?;
    let write_one = |&format: &OutputFormat| {
        let path = output_path(folder, &frame.stem, format);
        write_unseen(&path, |out| write(format, out)).map_err(|error| fail(&path, error))
    };
    let unseen: Vec<Unseen> = formats.iter().map(write_one).collect::<Result<_, _>>()?;
    let sizes_bytes = unseen.iter().map(Unseen::size_bytes).collect();
    let paths = publish(unseen).map_err(|(path, error)| fail(&path, error.into()))?;
    Ok(Written { paths, sizes_bytes })
}

/// Writes one file of a frame. What takes computing is computed by the crew, as pieces that are whole before they
/// are written: threads that compute do not wait for the disk. No more than a piece is held beside the surface.
///
/// # Errors
/// When the format has no place for so much, or the system refuses.
pub(super) fn write_surface<'env>(
    surface: &Arc<Surface>,
    (number, frame): (usize, &Frame),
    input_hash: u128,
    format: OutputFormat,
    crew: &Crew<'_, '_, 'env>,
    out: &mut impl Write,
) -> meniscus_formats::Result<()> {
    let options = &*frame.outputs;
    let provenance = provenance(&frame.settings, &frame.input, input_hash, format, options);
    let mesh = mesh_view(&surface.mesh);
    match format {
        OutputFormat::Vdb => {
            let (surface, frame) = (Arc::clone(surface), frame.clone());
            crew.run(number, move || encode_levels(&surface, &frame, &provenance))?.write(out)
        }
        OutputFormat::Obj => {
            let options = obj::WriteOptions::default();
            for index in 0..obj::batch_count(&mesh) {
                let (surface, options, provenance) =
                    (Arc::clone(surface), options.clone(), provenance.clone());
                let encode =
                    move || obj::encode_batch(&mesh_view(&surface.mesh), &options, &provenance, index);
                for text in crew.run(number, encode)? {
                    out.write_all(&text)?;
                }
            }
            Ok(())
        }
        // These are copies of what the mesh has: writing them costs more.
        OutputFormat::Glb => gltf::write_glb(&mesh, &gltf_options(options), &provenance, out),
        OutputFormat::Gltf => gltf::write_gltf(&mesh, &gltf_options(options), &provenance, out),
        OutputFormat::Ply => ply::write::write_mesh(&mesh, &provenance, out),
    }
}

fn encode_levels(
    surface: &Surface,
    frame: &Frame,
    provenance: &Provenance,
) -> meniscus_formats::Result<vdb::Encoded> {
    let origins = leaf_origins(&surface.band);
    let levels = LevelSetView {
        origins: &origins,
        leaves: surface.band.phi.as_arrays(),
        half_width_voxels: VDB_HALF_WIDTH_VOXELS,
        voxel_size: frame.settings.voxel_size,
        grids: &[],
    };
    let options = vdb::WriteOptions {
        half: frame.outputs.vdb_half,
        compression: frame.outputs.vdb_compression,
        ..vdb::WriteOptions::default()
    };
    vdb::encode(&levels, &options, provenance)
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
        attributes: &[],
    }
}

fn leaf_origins(band: &NarrowBand) -> Vec<[i32; 3]> {
    band.topology.origins().iter().map(|origin| origin.to_array()).collect()
}
