//! Writes a triangle mesh as binary little-endian PLY.

use std::io::Write;

use super::vertex_data::{PlyAttribute, stored_attributes};
use crate::data::{MeshView, Provenance};
use crate::error::{Error, Result};
use crate::provenance::{GENERATOR, comments};

const FORMAT: &str = "PLY";

/// Number of vertices or faces encoded at a time.
const PIECE: usize = 4096;

/// Writes positions, normals, attributes and faces. Positions are floats. If the mesh has an origin, the
/// origin is added, and positions are doubles. Axes are not converted.
///
/// # Errors
///
/// [`Error::Io`] if `out` fails; [`Error::TooLarge`] if the vertex indices exceed the signed 32 bits that
/// readers expect; [`Error::Invalid`] if the mesh is inconsistent or not finite.
pub fn write_mesh(mesh: &MeshView, provenance: &Provenance, out: &mut impl Write) -> Result<()> {
    mesh.check(FORMAT)?;
    if i32::try_from(mesh.positions.len()).is_err() {
        let what = format!("the mesh has {} vertices; the limit of PLY is 2³¹ − 1", mesh.positions.len());
        return Err(Error::too_large(FORMAT, what));
    }
    let far = mesh.origin != [0.0; 3];
    let attributes = stored_attributes(mesh.attributes);
    out.write_all(header(mesh, &attributes, far, provenance).as_bytes())?;
    let vertices = mesh.positions.iter().zip(mesh.normals).enumerate();
    write_pieces(vertices, out, |(vertex, (position, normal)), bytes| {
        if far {
            let world = (0..3).map(|axis| mesh.origin[axis] + f64::from(position[axis]));
            bytes.extend(world.flat_map(f64::to_le_bytes));
        } else {
            bytes.extend_from_slice(position.map(f32::to_le_bytes).as_flattened());
        }
        bytes.extend_from_slice(normal.map(f32::to_le_bytes).as_flattened());
        attributes.iter().for_each(|attribute| attribute.append(vertex, bytes));
    })?;
    write_pieces(mesh.triangles.iter(), out, |triangle, bytes| {
        bytes.push(3);
        bytes.extend_from_slice(triangle.map(u32::to_le_bytes).as_flattened());
    })
}

fn header(mesh: &MeshView, attributes: &[PlyAttribute], far: bool, provenance: &Provenance) -> String {
    let real = if far { "double" } else { "float" };
    let mut header = format!("ply\nformat binary_little_endian 1.0\ncomment {GENERATOR}\n");
    header += &comments(provenance, "comment ");
    attributes.iter().for_each(|attribute| header += &attribute.comments());
    header += &format!("element vertex {}\n", mesh.positions.len());
    for name in ["x", "y", "z"] {
        header += &format!("property {real} {name}\n");
    }
    for name in ["nx", "ny", "nz"] {
        header += &format!("property float {name}\n");
    }
    attributes.iter().for_each(|attribute| header += &attribute.properties());
    header += &format!("element face {}\nproperty list uchar int vertex_indices\n", mesh.triangles.len());
    header + "end_header\n"
}

/// Encodes items with `append`, and writes them in pieces of [`PIECE`] items.
fn write_pieces<T>(
    items: impl Iterator<Item = T>,
    out: &mut impl Write,
    append: impl Fn(T, &mut Vec<u8>),
) -> Result<()> {
    let mut bytes = Vec::new();
    for (index, item) in items.enumerate() {
        append(item, &mut bytes);
        if (index + 1) % PIECE == 0 {
            out.write_all(&bytes)?;
            bytes.clear();
        }
    }
    out.write_all(&bytes)?;
    Ok(())
}
