//! Reads the meshes of stages, such as obstacles.

use std::rc::Rc;
use std::sync::Arc;

use super::FORMAT;
use super::composed::{ComposedStage, StagePrim};
use super::layer::wide;
use super::package::LayerBytes;
use super::place::{PrimMatrix, ancestors, cofactors, determinant, transformed};
use super::points::distinct;
use crate::core::container::{OpenFurther, SceneMeshReader};
use crate::core::data::{FileAttribute, MeshData, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::row::ReadExternal;
use crate::core::text::excerpt;

/// How the meshes of stages are read.
pub(crate) const READER: SceneMeshReader = SceneMeshReader {
    are_animated: |file, limits| is_animated(&ComposedStage::open(file, limits, true)?),
    read: |file, number, limits| {
        #[expect(clippy::cast_precision_loss, reason = "time codes of stages are doubles")]
        let time = number.map(|number| number as f64);
        read_mesh(&ComposedStage::open(file, limits, false)?, time, limits)
    },
};

/// Reads the triangles of all visible prims of the type `Mesh` at a time code; `None` is the default value, or
/// the first sample. Polygons become triangle fans, outward as the prim declares. Other surfaces are not
/// meshes: subdivision surfaces are read as their control meshes. Normals are read if all prims have one per
/// point.
///
/// # Errors
/// [`Error::Unsupported`] without a `Mesh`, and with the path of a prim for what is not supported;
/// [`Error::Invalid`] if faces are inconsistent; otherwise those of the layers.
fn read_mesh(stage: &ComposedStage, time: Option<f64>, limits: &Limits) -> Result<MeshData> {
    let mut mesh = MeshData::default();
    let mut has_normals = true;
    for prim in mesh_prims(stage)? {
        if !stage.is_visible(&prim, time)? {
            continue;
        }
        let PrimMesh { points, normals, triangles, matrix } = PrimMesh::read(stage, &prim, time)?;
        let first = mesh.positions.len();
        limits.check_particles(FORMAT, (first + points.len() / 3) as u64)?;
        let points = wide(&points);
        mesh.positions
            .extend(points.as_chunks::<3>().0.iter().map(|point| transformed(&matrix, *point, 1.0)));
        let is_mirrored = determinant(&matrix) < 0.0;
        let shifted = |corner: u32| u32::try_from(first).ok().and_then(|first| first.checked_add(corner));
        for [a, b, c] in triangles {
            let corners = if is_mirrored { [a, c, b] } else { [a, b, c] };
            let [Some(a), Some(b), Some(c)] = corners.map(shifted) else {
                return Err(Error::too_large(FORMAT, "the meshes have more than 2³² vertices"));
            };
            mesh.triangles.push([a, b, c]);
        }
        has_normals &= normals.len() == points.len();
        mesh.normals.extend(turned_normals(&normals, &matrix));
    }
    if !has_normals {
        mesh.normals.clear();
    }
    Ok(mesh)
}

/// Whether the meshes, their transforms or their visibility have samples at several time codes.
fn is_animated(stage: &ComposedStage) -> Result<bool> {
    let mut codes = Vec::new();
    for prim in mesh_prims(stage)? {
        for name in ["points", "faceVertexCounts", "faceVertexIndices", "holeIndices"] {
            codes.extend(stage.sample_codes(&prim, name)?);
        }
        for prim in ancestors(&prim) {
            codes.extend(stage.sample_codes(prim, "visibility")?);
        }
        codes.extend(stage.transform_codes(&prim)?);
    }
    Ok(distinct(codes).len() > 1)
}

/// Reads the mesh of a file without animation. `read_external` reads the files to which it refers.
pub(crate) fn read_alone(bytes: &[u8], limits: &Limits, read_external: &ReadExternal) -> Result<MeshData> {
    let open: &OpenFurther = &|path| Ok(Box::new(Arc::<[u8]>::from(read_external(path)?)));
    let stage = ComposedStage::of_file(LayerBytes::new(Rc::new(bytes))?, open, limits, true)?;
    if is_animated(&stage)? {
        return Err(Error::unsupported(FORMAT, "this file is a sequence: use the file of one frame"));
    }
    stage.start_anew();
    read_mesh(&stage, None, limits)
}

/// The meshes for final pictures.
pub(crate) fn mesh_prims(stage: &ComposedStage) -> Result<Vec<Rc<StagePrim>>> {
    let mut found = Vec::new();
    stage.traverse(&mut |prim| {
        let kind = stage.type_name(prim)?;
        if !["Mesh", "PointInstancer"].contains(&kind.as_str()) || !stage.is_rendered(prim)? {
            return Ok(true);
        }
        if kind == "PointInstancer" {
            let what = format!("{} places copies of prims, which is not supported", excerpt(&prim.path));
            return Err(Error::unsupported(FORMAT, what));
        }
        found.push(Rc::clone(prim));
        Ok(true)
    })?;
    if found.is_empty() {
        let left_out = stage.left_out_note().map(|note| format!("; {note}")).unwrap_or_default();
        return Err(Error::unsupported(FORMAT, format!("the stage has no prims of the type Mesh{left_out}")));
    }
    Ok(found)
}

/// A mesh in the coordinates of its prim.
pub(crate) struct PrimMesh {
    /// Three numbers each.
    pub(crate) points: Values,
    /// Three numbers each; empty unless there is one for each point.
    pub(crate) normals: Vec<f32>,
    pub(crate) triangles: Vec<[u32; 3]>,
    pub(crate) matrix: PrimMatrix,
}

impl PrimMesh {
    pub(crate) fn read(stage: &ComposedStage, prim: &StagePrim, time: Option<f64>) -> Result<PrimMesh> {
        let array = |name: &str| -> Result<Option<FileAttribute>> {
            Ok(stage.array_at(prim, name, time)?.map(|(array, _)| array))
        };
        let points = match array("points")? {
            Some(points) if points.arity == 3 && !matches!(points.values, Values::Strings { .. }) => {
                points.values
            }
            _ => return Err(invalid(prim, "has no points".into())),
        };
        let integers = |name: &str| match array(name)?.map(|array| array.values) {
            Some(Values::I32(values)) => Ok(values),
            None => Ok(Vec::new()),
            Some(_) => Err(invalid(prim, format!("has {name} other than integers"))),
        };
        let (counts, corners) = (integers("faceVertexCounts")?, integers("faceVertexIndices")?);
        let mut triangles = fans(prim, &counts, &corners, &integers("holeIndices")?, points.len() / 3)?;
        if stage.word_at(prim, "orientation", time)?.as_deref() == Some("leftHanded") {
            triangles.iter_mut().for_each(|[_, b, c]| std::mem::swap(b, c));
        }
        let normals = match array("normals")?.map(|array| array.values) {
            Some(Values::F32(normals)) if normals.len() == points.len() => normals,
            _ => Vec::new(),
        };
        Ok(PrimMesh { points, normals, triangles, matrix: stage.world(prim, time)? })
    }
}

/// Normals after a transform. A translation leaves them as they are.
#[expect(clippy::cast_possible_truncation, reason = "normals have 32 bits")]
fn turned_normals(normals: &[f32], matrix: &PrimMatrix) -> Vec<[f32; 3]> {
    let normals = normals.as_chunks::<3>().0;
    let turn = cofactors(matrix);
    if turn == [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
        return normals.to_vec();
    }
    let sign = determinant(matrix).signum();
    let turned = |normal: &[f32; 3]| {
        let [x, y, z] = normal.map(f64::from);
        let turned: [f64; 3] =
            std::array::from_fn(|axis| x * turn[0][axis] + y * turn[1][axis] + z * turn[2][axis]);
        let length = turned.iter().map(|x| x * x).sum::<f64>().sqrt();
        turned.map(|x| if length > 0.0 { (sign * x / length) as f32 } else { 0.0 })
    };
    normals.iter().map(turned).collect()
}

/// Splits faces, except holes, into triangle fans.
fn fans(
    prim: &StagePrim,
    counts: &[i32],
    corners: &[i32],
    holes: &[i32],
    vertex_count: usize,
) -> Result<Vec<[u32; 3]>> {
    let mut triangles = Vec::new();
    let mut rest = corners;
    let holes: std::collections::HashSet<i32> = holes.iter().copied().collect();
    for (index, &count) in (0..).zip(counts) {
        let face = usize::try_from(count).ok().filter(|&count| count >= 3);
        let Some((face, others)) = face.and_then(|count| rest.split_at_checked(count)) else {
            return Err(invalid(
                prim,
                format!("has a face with {count} corners, but only {} are left", rest.len()),
            ));
        };
        rest = others;
        let is_vertex = |index: i32| usize::try_from(index).is_ok_and(|index| index < vertex_count);
        if let Some(index) = face.iter().find(|&&index| !is_vertex(index)) {
            return Err(invalid(
                prim,
                format!("has a face with vertex {index}, but only {vertex_count} vertices"),
            ));
        }
        if !holes.contains(&index) {
            let pairs = face[1..].windows(2);
            triangles.extend(pairs.map(|pair| [face[0], pair[0], pair[1]].map(i32::cast_unsigned)));
        }
    }
    match rest.len() {
        0 => Ok(triangles),
        count => Err(invalid(prim, format!("has {count} corners that belong to no face"))),
    }
}

fn invalid(prim: &StagePrim, what: String) -> Error {
    Error::invalid(FORMAT, Position::File, format!("{} {what}", excerpt(&prim.path)))
}
