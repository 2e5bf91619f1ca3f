//! Writes a surface to files, one for each format.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use meniscus_formats::{
    AttributeRole, BandGrid, Content, LeafValues, LevelSetView, MeshEncoder, MeshView, Provenance,
    VertexAttribute, VertexValues, vdb,
};

use crate::surface::attributes::BandAttribute;
use crate::surface::level_set::NarrowBand;
use crate::surface::mesh::Mesh;
use crate::surface::options::Settings;
use crate::surface::particles::{Attribute, AttributeValues, Role};
use crate::surface::reconstruction::FrameSurface;
use crate::surface::space::Lattice;

use crate::pipeline::diagnostics::diagnose;
use crate::pipeline::error::{FrameError, Stage};
use crate::pipeline::files::atomic_write::{StagedFile, commit};
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::input::bounds::EMPTY_BOUNDS;
use crate::pipeline::input::frame::Frame;
use crate::pipeline::records::provenance::{MadeFrom, provenance};
use crate::pipeline::records::record_line::OutputFile;
use crate::pipeline::scheduler::Scheduler;
use crate::pipeline::target::outputs::{OutputFormat, OutputKind, OutputOptions, VDB_HALF_WIDTH_VOXELS};
use crate::pipeline::target::picture::{PictureOptions, PictureScene, encode_picture, up_of, velocities};
use crate::pipeline::warning::Warning;

/// The files of a frame.
pub(crate) struct WrittenFiles {
    pub(crate) paths: Vec<PathBuf>,
    pub(crate) files: Vec<OutputFile>,
}

/// Writes every file of a frame with `write`. All files are complete before the first gets its name. Creates
/// their folder if it is missing.
///
/// # Errors
/// The first file that cannot be written.
pub(crate) fn write_files(
    frame: &Frame,
    mut write: impl FnMut(OutputKind, &mut BufWriter<&File>) -> meniscus_formats::Result<()>,
) -> Result<WrittenFiles, FrameError> {
    let OutputOptions { folder, .. } = &*frame.outputs;
    let fail = |path: &Path, error| FrameError::file(path, Stage::Write, error);
    fs::create_dir_all(folder).map_err(|error| fail(folder, error.into()))?;
    let write_one = |(kind, path): (OutputKind, PathBuf)| {
        StagedFile::write(&path, |out| write(kind, out)).map_err(|error| fail(&path, error))
    };
    let files = frame.outputs.files(&frame.stem).into_iter();
    let staged: Vec<StagedFile> = files.map(write_one).collect::<Result<_, _>>()?;
    // The hashes are those of the bytes on disk, not of those in memory.
    let hash = |file: &StagedFile| InputFile::open(file.written_path())?.hash();
    let hashed = |file: &StagedFile| hash(file).map_err(|error| fail(file.path(), error.into()));
    let hashes: Vec<u128> = staged.iter().map(hashed).collect::<Result<_, _>>()?;
    commit(&staged).map_err(|(path, error)| fail(&path, error.into()))?;
    let paths: Vec<PathBuf> = staged.iter().map(|file| file.path().to_owned()).collect();
    let output = |(file, hash): (&StagedFile, u128)| OutputFile {
        name: file.path().file_name().unwrap_or_default().into(),
        stamp: file.stamp_after_rename(),
        hash,
    };
    Ok(WrittenFiles { files: staged.iter().zip(hashes).map(output).collect(), paths })
}

/// Writes a surface in one format. The pool encodes level sets and pictures whole, and meshes in text formats in
/// batches, each of which is complete before it is written, so that compute threads do not wait for the disk. Meshes
/// in other formats need no computing: this thread streams them.
///
/// # Errors
/// When the format cannot hold this amount of data, or the system reports an error.
pub(crate) fn write_surface_as<'env>(
    surface: &Arc<FrameSurface>,
    (order, frame): (usize, &Frame),
    made_from: MadeFrom<'_>,
    format: OutputFormat,
    scheduler: &Scheduler<'_, '_, 'env>,
    out: &mut impl Write,
) -> meniscus_formats::Result<()> {
    let provenance = provenance(frame, made_from, format);
    let writer = match format.content() {
        Content::LevelSet => {
            let (surface, frame) = (Arc::clone(surface), frame.clone());
            let encode = move || encode_levels(&surface, &frame.settings, &frame.outputs, &provenance);
            return scheduler.run(order, encode)?.write(out);
        }
        Content::Picture(_) => {
            let (surface, frame) = (Arc::clone(surface), frame.clone());
            let encode = move || {
                let Frame { settings, outputs, .. } = &frame;
                encode_picture_of(&surface, settings, outputs, frame.job.origin(), format, &provenance)
            };
            return Ok(out.write_all(&scheduler.run(order, encode)?)?);
        }
        Content::Mesh(writer) => writer,
    };
    let quads = if frame.settings.quads { surface.mesh.quads().into() } else { Arc::default() };
    let options = frame.outputs.mesh(quads);
    let attributes = vertex_attributes(&surface.attributes.vertices);
    let mesh = mesh_view(&surface.mesh, &attributes);
    let MeshEncoder::Batches { count, encode } = writer.encoder else {
        return writer.write(&mesh, &options, &provenance, out);
    };
    for index in 0..count(&mesh, &options) {
        let (surface, options, provenance) = (Arc::clone(surface), options.clone(), provenance.clone());
        let encode = move || {
            let attributes = vertex_attributes(&surface.attributes.vertices);
            encode(&mesh_view(&surface.mesh, &attributes), &options, &provenance, index)
        };
        for text in scheduler.run(order, encode)? {
            out.write_all(&text)?;
        }
    }
    Ok(())
}

/// Renders a picture of a surface whose voxel (0, 0, 0) is at `origin`, and encodes it.
///
/// # Errors
/// If the format is not a picture format.
pub(crate) fn encode_picture_of(
    surface: &FrameSurface,
    settings: &Settings,
    outputs: &OutputOptions,
    origin: DVec3,
    format: OutputFormat,
    provenance: &Provenance,
) -> meniscus_formats::Result<Vec<u8>> {
    let has_data = format.has_attributes();
    let velocity = if has_data { velocities(surface) } else { None };
    let lattice = Lattice { voxel_size: settings.voxel_size };
    let (band, spray) = (&surface.band, surface.spray.as_ref());
    let scene = PictureScene { band, lattice, origin, velocity: velocity.as_ref(), spray };
    let PictureOptions { size, camera } = outputs.picture;
    let bounds = scene.bounds().unwrap_or(EMPTY_BOUNDS);
    let viewpoint = camera.viewpoint(bounds, outputs.picture.aspect(), up_of(outputs.up));
    let picture = scene.picture(&viewpoint, size, has_data);
    encode_picture(&picture, Some(&viewpoint), format, provenance)
}

/// The half width of the band, in voxels, in which files in these formats have attributes; `None` if no file
/// has any there.
pub(crate) fn attribute_half_width_voxels(formats: &[OutputFormat]) -> Option<f32> {
    let has_voxels = formats.iter().any(|format| !format.is_mesh() && format.has_attributes());
    has_voxels.then_some(VDB_HALF_WIDTH_VOXELS)
}

/// Encodes the level set of a surface with the options for its outputs.
pub(crate) fn encode_levels(
    surface: &FrameSurface,
    settings: &Settings,
    outputs: &OutputOptions,
    provenance: &Provenance,
) -> meniscus_formats::Result<vdb::EncodedVdb> {
    encode_level_set(surface, settings, &outputs.vdb(), provenance)
}

/// Encodes the level set of a surface as a .vdb, with the attributes that are known in its band. To write the
/// file, call [`write`](vdb::EncodedVdb::write) of the result. `settings` must be those of the
/// reconstruction, because the values of the level set are in units of their voxel size.
///
/// # Errors
/// When the format cannot hold this amount of data.
pub fn encode_level_set(
    surface: &FrameSurface,
    settings: &Settings,
    options: &vdb::WriteOptions,
    provenance: &Provenance,
) -> meniscus_formats::Result<vdb::EncodedVdb> {
    let origins = leaf_origins(&surface.band);
    let voxels: Vec<Voxels> = surface.attributes.band.iter().map(Voxels).collect();
    let grids = band_grids(&voxels);
    let levels = LevelSetView {
        origins: &origins,
        leaves: surface.band.phi.as_arrays(),
        half_width_voxels: VDB_HALF_WIDTH_VOXELS,
        voxel_size: settings.voxel_size,
        grids: &grids,
    };
    vdb::encode(&levels, options, provenance)
}

/// A mesh in the form that the writers of the formats take: in world units, relative to its origin, with the
/// attributes of its [vertices](vertex_attributes), in the mesh's order.
pub fn mesh_view<'a>(mesh: &'a Mesh, attributes: &'a [VertexAttribute<'a>]) -> MeshView<'a> {
    MeshView {
        positions: bytemuck::cast_slice(&mesh.positions),
        normals: bytemuck::cast_slice(&mesh.normals),
        triangles: &mesh.triangles,
        origin: mesh.origin.to_array(),
        attributes,
    }
}

fn leaf_origins(band: &NarrowBand) -> Vec<[i32; 3]> {
    band.topology.origins().iter().map(|origin| origin.to_array()).collect()
}

/// The attributes of a mesh's vertices in the form that the writers of the formats take.
pub fn vertex_attributes<'a>(attributes: &'a [Attribute]) -> Vec<VertexAttribute<'a>> {
    let view = |attribute: &'a Attribute| VertexAttribute {
        name: &attribute.name,
        role: file_role(attribute.role),
        arity: attribute.arity,
        values: match &attribute.values {
            AttributeValues::Numbers(values) => VertexValues::Numbers(values),
            AttributeValues::Integers(values) => VertexValues::Integers(values),
            AttributeValues::Strings { table, indices } => VertexValues::Strings { table, indices },
        },
    };
    attributes.iter().map(view).collect()
}

/// An attribute at the voxels of the band.
#[derive(Debug)]
struct Voxels<'a>(&'a BandAttribute);

impl LeafValues for Voxels<'_> {
    fn fill(&self, leaf: usize, out: &mut [f32]) {
        self.0.fill(leaf, out);
    }
}

fn band_grids<'a>(voxels: &'a [Voxels<'a>]) -> Vec<BandGrid<'a>> {
    let grid = |voxels: &'a Voxels<'a>| {
        let BandAttribute { name, role, arity, .. } = voxels.0;
        BandGrid { name, role: file_role(*role), arity: *arity, values: voxels }
    };
    voxels.iter().map(grid).collect()
}

pub(super) fn file_role(role: Role) -> Option<AttributeRole> {
    match role {
        Role::Velocity => Some(AttributeRole::Velocity),
        Role::Acceleration => Some(AttributeRole::Acceleration),
        Role::Color => Some(AttributeRole::Color),
        Role::Radius => Some(AttributeRole::Radius),
        Role::Id => Some(AttributeRole::Id),
        Role::TextureCoordinates => Some(AttributeRole::TextureCoordinates),
        Role::Rest | Role::Other => None,
    }
}

/// Warnings about a surface and its files.
pub(crate) fn surface_warnings(
    surface: &FrameSurface,
    outputs: &OutputOptions,
    settings: &Settings,
) -> Vec<Warning> {
    let about_surface = diagnose(&surface.mesh, &surface.report, settings);
    about_surface.into_iter().chain(output_warnings(surface, outputs)).collect()
}

/// Warnings about attributes that the files cannot hold exactly.
pub(crate) fn output_warnings(surface: &FrameSurface, outputs: &OutputOptions) -> Vec<Warning> {
    let vertices = vertex_attributes(&surface.attributes.vertices);
    let mut warnings: Vec<Warning> = Vec::new();
    for mesh in written(outputs).filter_map(OutputFormat::mesh) {
        for warning in (mesh.attribute_notes)(&vertices).into_iter().map(Warning::new) {
            // .glb and .gltf give the same warning.
            if !warnings.contains(&warning) {
                warnings.push(warning);
            }
        }
    }
    if outputs.formats.contains(&OutputFormat::Vdb) {
        let band = &surface.attributes.band;
        let names = surface.report.transfer.iter().flat_map(|transfer| &transfer.attributes);
        let left_out = names.filter(|name| band.iter().all(|attribute| attribute.name != **name));
        warnings.extend(left_out.map(|name| {
            let why = match &**name {
                CURVATURE => "because it is that of the mesh",
                _ => "which can store only attributes of one or three floating-point numbers",
            };
            Warning::new(format!("{name} is not in the .vdb, {why}"))
        }));
        let voxels: Vec<Voxels> = band.iter().map(Voxels).collect();
        let of_grids = vdb::grid_notes(&band_grids(&voxels), &vdb::WriteOptions::default().name);
        warnings.extend(of_grids.into_iter().map(Warning::new));
    }
    warnings
}

/// The name of the curvature that is computed.
const CURVATURE: &str = "normal_curvature";

/// The output formats, in the order of the format table.
fn written(outputs: &OutputOptions) -> impl Iterator<Item = OutputFormat> {
    OutputFormat::ALL.into_iter().filter(|format| outputs.formats.contains(format))
}
