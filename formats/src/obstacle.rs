//! What stands in the way of a fluid: a mesh, or a level set.

use crate::data::MeshData;
use crate::error::{Error, Place, Result};
use crate::excerpt::excerpt;
use crate::gltf::Beside;
use crate::limits::Limits;
use crate::packing::unpacked_name;
use crate::probe::{Kind, Probe, probe};
use crate::vdb::{self, LevelSetData};
use crate::{gltf, obj, ply};

/// An obstacle as its file has it.
#[derive(Clone, Debug, PartialEq)]
pub enum ObstacleData {
    /// Triangles, of a mesh that need not be closed.
    Mesh(MeshData),
    /// A level set with values in world units.
    LevelSet(Box<LevelSetData>),
}

/// Reads an obstacle from a file of any format that has one, packed or not: OBJ, glTF, PLY, or OpenVDB. The
/// content decides what the format is. `beside` gives the buffers of a .gltf that are files of their own.
///
/// # Errors
/// Those of the format's reader; [`Error::Invalid`] for a mesh without triangles; [`Error::Unsupported`] for a file
/// that is something else, a volume that is no level set, or a shot.
pub fn read_obstacle(
    bytes: &[u8],
    file_name: &str,
    limits: &Limits,
    beside: &Beside,
) -> Result<ObstacleData> {
    let Probe { mut kind, packing } = probe(bytes, file_name);
    // Some lines of an OBJ file, in an order of their own, look like a table.
    let name = file_name.to_ascii_lowercase();
    if matches!(kind, Kind::Delimited | Kind::UnknownText) && unpacked_name(&name).ends_with(".obj") {
        kind = Kind::Obj;
    }
    let unpacked;
    let bytes = match packing.filter(|_| is_read(kind)) {
        Some(packing) => {
            unpacked = packing.unpack(bytes, limits)?;
            &unpacked
        }
        None => bytes,
    };
    let mesh = match kind {
        Kind::Obj => obj::read_mesh(bytes)?,
        Kind::Glb => one_mesh(bytes, limits, beside)?,
        Kind::GltfJson => gltf::read_mesh_with(bytes, limits, beside)?,
        Kind::Ply => ply::read_mesh(bytes, limits)?,
        Kind::OpenVdb => return level_set(bytes, limits),
        Kind::Empty => return Err(Error::short("", Place::File, "the file is empty")),
        _ => {
            let what = "not a format that obstacles are read from: use .obj, .glb, .gltf, .ply or .vdb";
            return Err(Error::unsupported(kind.name(), what));
        }
    };
    if mesh.triangles.is_empty() {
        return Err(Error::invalid(kind.name(), Place::File, "no triangle, so there is nothing in the way"));
    }
    Ok(ObstacleData::Mesh(mesh))
}

fn is_read(kind: Kind) -> bool {
    matches!(kind, Kind::Obj | Kind::Glb | Kind::GltfJson | Kind::Ply | Kind::OpenVdb)
}

/// Of a shot nobody could say which frame is in the way.
fn one_mesh(bytes: &[u8], limits: &Limits, beside: &Beside) -> Result<MeshData> {
    if let Some(shot) = gltf::read_shot_info(bytes)? {
        let what = format!(
            "this is a shot of {} frames, and an obstacle is one mesh: give the .glb of a frame, or of each as in body.####.glb",
            shot.frames
        );
        return Err(Error::unsupported(Kind::Glb.name(), what));
    }
    gltf::read_mesh_with(bytes, limits, beside)
}

fn level_set(bytes: &[u8], limits: &Limits) -> Result<ObstacleData> {
    let data = vdb::read_level_set(bytes, None, limits)?;
    // Some programs do not say what a grid is; what they write is used as it is.
    if !["level set", "unknown", ""].contains(&data.class.as_str()) {
        let what = format!(
            "the grid \"{}\" is a {}; an obstacle is a level set",
            excerpt(&data.name),
            excerpt(&data.class)
        );
        return Err(Error::unsupported("OpenVDB", what));
    }
    Ok(ObstacleData::LevelSet(Box::new(data)))
}
