//! Reads the meshes of a file that this crate wrote, with their attributes, and what its tables declare.

use std::io::{self, Read, Seek};
use std::rc::Rc;
use std::sync::Mutex;

use super::tables::check_magic;
use crate::core::batches::{ReadAt, SeekFile};
use crate::core::columns::role_of;
use crate::core::data::{FileAttribute, MeshData, Values, world};
use crate::core::error::{Error, Result};
use crate::core::limits::Limits;
use crate::core::options::UpAxis;
use crate::core::placed_mesh::PlacedMesh;
use crate::usd::composed::{ComposedStage, StagePrim};
use crate::usd::layer::{Layer, unexpected};
use crate::usd::mesh::{PrimMesh, mesh_prims};
use crate::usd::package::LayerBytes;
use crate::usd::points::attributes;
use crate::usd::{ACCELERATIONS, FORMAT, LayerInfo, SampledProperty, TEXTURE, VELOCITIES, attribute_of};

/// A file with the mesh of a frame.
pub struct UsdcLayer<'a> {
    stage: ComposedStage<'a>,
    mesh: Rc<StagePrim>,
    info: LayerInfo,
}

/// The frame of a file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct UsdcFrame {
    /// The mesh, in world units.
    pub mesh: MeshData,
    /// The velocities and accelerations, and the primvars under their own names.
    pub attributes: Vec<FileAttribute>,
}

impl<'a> UsdcLayer<'a> {
    /// Reads the tables of a file; [`UsdcLayer::frame`] reads the mesh.
    ///
    /// # Errors
    ///
    /// [`Error::Truncated`] if the file is truncated; [`Error::Unsupported`] if another program wrote it;
    /// [`Error::Invalid`] if it is damaged; [`Error::TooLarge`] if it exceeds the limits.
    pub fn read(bytes: &'a [u8], limits: &Limits) -> Result<UsdcLayer<'a>> {
        UsdcLayer::of_file(LayerBytes::new(Rc::new(bytes))?, limits)
    }

    fn of_file(bytes: LayerBytes<'a>, limits: &Limits) -> Result<UsdcLayer<'a>> {
        check_magic(&bytes.head::<8>()?)?;
        let stage = ComposedStage::of_file(bytes, &no_other_file, limits, false)?;
        let info = stage.root_layer(layer_info)?;
        let meshes = mesh_prims(&stage)?;
        let [mesh] = &meshes[..] else {
            return Err(Error::unsupported(FORMAT, "this file has several meshes, and meniscus writes one"));
        };
        Ok(UsdcLayer { mesh: Rc::clone(mesh), stage, info })
    }

    /// The summary of the file.
    pub fn info(&self) -> LayerInfo {
        self.info
    }

    /// The frame as it is stored, and the axis that points up.
    pub(super) fn placed_frame(&self) -> Result<(PlacedMesh, UpAxis)> {
        let up = match self.stage.root_layer(|layer| layer.word(0, "upAxis"))?.as_deref() {
            Some("Y") => UpAxis::Y,
            Some("Z") => UpAxis::Z,
            _ => return Err(unexpected("upAxis")),
        };
        Ok((self.placed_mesh()?, up))
    }

    /// Reads the frame.
    ///
    /// # Errors
    ///
    /// [`Error::Invalid`] if it is damaged; [`Error::TooLarge`] if it exceeds the limits.
    pub fn frame(&self) -> Result<UsdcFrame> {
        let PlacedMesh { positions, normals, triangles, origin, attributes } = self.placed_mesh()?;
        let positions = positions.as_chunks::<3>().0;
        let positions = positions.iter().map(|position| world(origin, *position)).collect();
        let normals = normals.as_chunks::<3>().0.to_vec();
        Ok(UsdcFrame { mesh: MeshData { positions, normals, triangles }, attributes })
    }

    /// Reads the frame as it is stored.
    fn placed_mesh(&self) -> Result<PlacedMesh> {
        self.stage.start_anew();
        let PrimMesh { points, normals, triangles, matrix } = PrimMesh::read(&self.stage, &self.mesh, None)?;
        let Values::F32(positions) = points else { return Err(unexpected("points")) };
        if normals.len() != positions.len() {
            return Err(unexpected("normals"));
        }
        let count = positions.len() / 3;
        let arrays = attributes(
            &self.stage,
            &self.mesh,
            (count, None),
            |name| attribute_of(name).is_none(),
            &mut Vec::new(),
        )?;
        let attribute = |array: FileAttribute| {
            let has_role =
                [VELOCITIES, ACCELERATIONS, "displayColor", TEXTURE].contains(&array.name.as_str());
            let role = role_of(&array.name, array.arity).filter(|_| has_role);
            FileAttribute { role, ..array }
        };
        let attributes = arrays.into_iter().map(attribute).collect();
        let [x, y, z, _] = matrix[3];
        Ok(PlacedMesh { positions, normals, triangles, origin: [x, y, z], attributes })
    }
}

/// A file of this crate refers to no other.
fn no_other_file(path: &str) -> io::Result<Box<dyn ReadAt>> {
    Err(io::Error::new(io::ErrorKind::Unsupported, format!("no access to the file {path}")))
}

fn layer_info(layer: &Layer) -> Result<LayerInfo> {
    let counts = layer.entry(&layer.field(0, "customLayerData")?, "meniscus_mesh")?;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a count")]
    let number = |name: &str| -> Result<Option<u64>> {
        Ok(layer.entry(&counts, name)?.and_then(|value| value.number()).map(|number| number as u64))
    };
    match (number("vertices")?, number("faces")?) {
        (Some(vertices), Some(faces)) => Ok(LayerInfo { vertices, faces }),
        _ => Err(Error::unsupported(
            FORMAT,
            "this file has no summary of a mesh: another program wrote it, or it has points",
        )),
    }
}

/// Reads the properties with time samples from a file of this crate, without its arrays.
///
/// # Errors
///
/// [`Error::Io`] if the file cannot be read; otherwise those of [`UsdcLayer::read`].
pub fn read_sampled_properties(
    file: &mut (impl Read + Seek + Send),
    limits: &Limits,
) -> Result<Vec<SampledProperty>> {
    let file = SeekFile(Mutex::new(file));
    let layer = super::read_layer(LayerBytes::new(Rc::new(&file))?, limits)?;
    let mut found = Vec::new();
    for (index, node) in layer.nodes.iter().enumerate().filter(|(_, node)| node.is_attribute) {
        if layer.field(index, "timeSamples")?.is_some() {
            let kind = layer.word(index, "typeName")?.unwrap_or_default();
            found.extend(SampledProperty::checked(&kind, &node.name));
        }
    }
    Ok(found)
}
