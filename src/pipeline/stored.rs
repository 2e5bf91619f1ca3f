//! What files make of the positions of a mesh: the certificate is about these.

use glam::Vec3;
use meniscus_formats::{gltf, stl};

use crate::surface::mesh::Mesh;
use crate::surface::skin::Stored;

use super::outputs::{OutputFormat, OutputOptions};
use super::writing::mesh_view;

/// How the files that are written store the mesh, each way once. Where no file has it, it is checked as it is.
pub(super) fn stored(outputs: &OutputOptions) -> Vec<Stored> {
    let has = |format: &dyn Fn(OutputFormat) -> bool| outputs.formats.iter().any(|&other| format(other));
    let is_quantized = |format| outputs.quantize && format == OutputFormat::Glb;
    let is_as_it_is =
        |format: OutputFormat| format.is_mesh() && format != OutputFormat::Stl && !is_quantized(format);
    let mut stored = Vec::new();
    if has(&is_quantized) {
        stored.push(Stored::Rounded(|mesh| vectors(gltf::quantized_positions(&mesh_view(mesh, &[])))));
    }
    if has(&|format| format == OutputFormat::Stl) {
        stored.push(Stored::Rounded(|mesh: &Mesh| vectors(stl::rounded_positions(&mesh_view(mesh, &[])))));
    }
    if has(&is_as_it_is) || stored.is_empty() {
        stored.push(Stored::AsTheyAre);
    }
    stored
}

/// What a certificate says of a file: what of it was checked.
pub(super) fn checked_as(format: OutputFormat, outputs: &OutputOptions) -> &'static str {
    match format {
        OutputFormat::Vdb if outputs.vdb_half => "level set, before its values are rounded to 16 bits",
        OutputFormat::Vdb => "level set",
        OutputFormat::Glb if outputs.quantize => "mesh, at its 16-bit positions",
        OutputFormat::Stl => "mesh, at its 32-bit positions in the world",
        OutputFormat::Png | OutputFormat::Exr => "level set, of which it is a picture",
        _ => "mesh, at its positions relative to its origin",
    }
}

fn vectors(positions: Vec<[f32; 3]>) -> Vec<Vec3> {
    bytemuck::cast_vec(positions)
}
