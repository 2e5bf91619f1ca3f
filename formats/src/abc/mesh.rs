//! The objects of an archive, in the schemas of AbcGeom: a mesh, or points, under a transform.
//!
//! ```text
//!   /surface                Xform      .inherits .ops .vals: a matrix, if positions are not in world space
//!   /surface/surfaceShape   PolyMesh   .geom
//!                                        .selfBnds .faceIndices .faceCounts P N .velocities uv
//!                                        .arbGeomParams: the other attributes, each under its name
//! ```
//!
//! In Alembic, Y is up, and faces are clockwise seen from outside.

use std::io::Write;

use super::document::{AbcObject, AbcProperty, Ogawa, Pod, StoredSample};
use crate::core::data::bounds_of;
use crate::core::error::Result;
use crate::core::matrix::{IDENTITY, Matrix};
use crate::core::number::{write_f32s, write_pieces};
use crate::core::options::UpAxis;

/// The names of the objects. They are the same in all files, because programs that play a file per frame look
/// for the same object in each.
pub(crate) const TRANSFORM: &str = "surface";
pub(crate) const MESH: &str = "surfaceShape";

/// The name of the transform of points beside a mesh: in the file of a frame, and in a sequence.
pub(crate) const POINTS: &str = "spray";
pub(crate) const SEQUENCE_POINTS: &str = "surface_spray";

/// The transform of positions into a world with Y up. The positions are relative to `origin`; both use axes
/// in which `up` points up.
pub(crate) fn to_world(up: UpAxis, [x, y, z]: [f64; 3]) -> Matrix {
    match up {
        UpAxis::Y => [IDENTITY[0], IDENTITY[1], IDENTITY[2], [x, y, z, 1.0]],
        UpAxis::Z => {
            [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [x, z, 0.0 - y, 1.0]]
        }
    }
}

/// The names of properties.
pub(crate) mod names {
    pub(crate) const GEOMETRY: &str = ".geom";
    pub(crate) const POSITIONS: &str = "P";
    pub(crate) const CORNERS: &str = ".faceIndices";
    pub(crate) const COUNTS: &str = ".faceCounts";
    pub(crate) const NORMALS: &str = "N";
    pub(crate) const VELOCITIES: &str = ".velocities";
    pub(crate) const IDS: &str = ".pointIds";
    pub(crate) const WIDTHS: &str = ".widths";
    pub(crate) const TEXTURE: &str = "uv";
    pub(crate) const PARAMS: &str = ".arbGeomParams";
    pub(crate) const TRANSFORM: &str = ".xform";
    pub(crate) const OPERATIONS: &str = ".ops";
    pub(crate) const MATRIX: &str = ".vals";
    pub(crate) const INHERITS: &str = ".inherits";
    pub(crate) const VISIBLE: &str = "visible";
}

/// The type of the values of an attribute.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ParamType {
    pub(crate) pod: Pod,
    /// Numbers per element.
    pub(crate) extent: u8,
    /// Elements per vertex.
    pub(crate) elements: usize,
    pub(crate) interpretation: &'static str,
}

impl ParamType {
    /// Floats: a vector if the arity is 2 or 3, else `arity` separate numbers per vertex.
    pub(crate) fn numbers(arity: usize) -> ParamType {
        let vector = |extent| ParamType { extent, interpretation: "vector", ..ParamType::many(Pod::F32, 1) };
        match arity {
            2 => vector(2),
            3 => vector(3),
            arity => ParamType::many(Pod::F32, arity),
        }
    }

    /// A colour: RGBA if the arity is 4, else RGB.
    pub(crate) fn color(arity: usize) -> ParamType {
        let (extent, interpretation) = if arity == 4 { (4, "rgba") } else { (3, "rgb") };
        ParamType { extent, interpretation, ..ParamType::many(Pod::F32, 1) }
    }

    /// `elements` separate numbers per vertex, which are not components of a vector.
    pub(crate) fn many(pod: Pod, elements: usize) -> ParamType {
        ParamType { pod, extent: 1, elements, interpretation: "" }
    }

    const NORMAL: ParamType = ParamType { pod: Pod::F32, extent: 3, elements: 1, interpretation: "normal" };

    /// The metadata of an attribute with a value per vertex. The keys are sorted.
    pub(crate) fn metadata(&self) -> String {
        let ParamType { pod, extent, elements, interpretation } = self;
        let meaning = match *interpretation {
            "" => String::new(),
            interpretation => format!("interpretation={interpretation};"),
        };
        let pod = match pod {
            Pod::F32 => "float32_t",
            Pod::F64 => "float64_t",
            Pod::I32 => "int32_t",
            Pod::I64 => "int64_t",
            Pod::U32 => "uint32_t",
            Pod::U64 => "uint64_t",
            Pod::U8 => "uint8_t",
            Pod::Bool => "bool_t",
            Pod::String => "string",
        };
        format!(
            "arrayExtent={elements};geoScope=vtx;{meaning}isGeomParam=true;podExtent={extent};podName={pod}"
        )
    }

    /// An attribute with these samples.
    pub(crate) fn property(&self, name: &str, samples: Vec<StoredSample>) -> AbcProperty {
        AbcProperty::array(name, &self.metadata(), (self.pod, self.extent), samples)
    }
}

/// The samples of a mesh at one time.
#[derive(Clone, Copy)]
pub(crate) struct FrameSamples {
    pub(crate) bounds: StoredSample,
    pub(crate) positions: StoredSample,
    /// The vertex indices at the faces' corners, and the number of corners of each face.
    pub(crate) faces: [StoredSample; 2],
    pub(crate) normals: StoredSample,
    pub(crate) velocities: Option<StoredSample>,
}

/// The transform of a mesh, and its samples, one for each time.
pub(crate) struct MeshSamples {
    matrix: Matrix,
    bounds: Vec<StoredSample>,
    positions: Vec<StoredSample>,
    corners: Vec<StoredSample>,
    counts: Vec<StoredSample>,
    normals: Vec<StoredSample>,
    /// Empty without velocities.
    velocities: Vec<StoredSample>,
}

impl MeshSamples {
    /// No samples yet, with this transform.
    pub(crate) fn at(matrix: Matrix) -> MeshSamples {
        let [bounds, positions, corners, counts, normals, velocities] = Default::default();
        MeshSamples { matrix, bounds, positions, corners, counts, normals, velocities }
    }

    pub(crate) fn push(&mut self, frame: FrameSamples) {
        let [corners, counts] = frame.faces;
        self.bounds.push(frame.bounds);
        self.positions.push(frame.positions);
        self.corners.push(corners);
        self.counts.push(counts);
        self.normals.push(frame.normals);
        self.velocities.extend(frame.velocities);
    }

    /// The transform with the mesh under it. `texture` are its texture coordinates, and `params` the attributes without a
    /// property of their own in the schema.
    pub(crate) fn object(
        self,
        texture: Option<AbcProperty>,
        params: Vec<AbcProperty>,
        ogawa: &mut Ogawa,
    ) -> Result<AbcObject> {
        let real = (Pod::F32, 3);
        let mut geometry = vec![
            AbcProperty::scalar(".selfBnds", "interpretation=box", (Pod::F64, 6), self.bounds),
            AbcProperty::array(names::POSITIONS, "geoScope=vtx;interpretation=point", real, self.positions),
            AbcProperty::array(names::CORNERS, "", (Pod::I32, 1), self.corners),
            AbcProperty::array(names::COUNTS, "", (Pod::I32, 1), self.counts),
            ParamType::NORMAL.property(names::NORMALS, self.normals),
        ];
        if !self.velocities.is_empty() {
            geometry.push(AbcProperty::array(
                names::VELOCITIES,
                "interpretation=vector",
                real,
                self.velocities,
            ));
        }
        geometry.extend(texture);
        if !params.is_empty() {
            geometry.push(AbcProperty::compound(names::PARAMS, "", params));
        }
        let schema = "schema=AbcGeom_PolyMesh_v1;schemaBaseType=AbcGeom_GeomBase_v1";
        let mesh = AbcObject {
            name: MESH.to_owned(),
            metadata: format!("{schema};schemaObjTitle=AbcGeom_PolyMesh_v1:.geom"),
            properties: vec![AbcProperty::compound(names::GEOMETRY, schema, geometry)],
            children: Vec::new(),
        };
        transformed(TRANSFORM, &self.matrix, mesh, ogawa)
    }
}

/// An object with its transform above it, which has this name.
fn transformed(name: &str, matrix: &Matrix, object: AbcObject, ogawa: &mut Ogawa) -> Result<AbcObject> {
    let schema = "schema=AbcGeom_Xform_v3";
    let properties = transform_properties(matrix, ogawa)?;
    Ok(AbcObject {
        name: name.to_owned(),
        metadata: format!("{schema};schemaObjTitle=AbcGeom_Xform_v3:.xform"),
        properties: vec![AbcProperty::compound(names::TRANSFORM, schema, properties)],
        children: vec![object],
    })
}

/// The samples of points at one time.
pub(crate) struct PointSamples {
    pub(crate) bounds: StoredSample,
    pub(crate) positions: StoredSample,
    pub(crate) ids: StoredSample,
    pub(crate) velocities: Option<StoredSample>,
    pub(crate) widths: Option<StoredSample>,
}

impl PointSamples {
    /// The properties of the schema. `params` are the attributes without a property of their own in the schema.
    pub(crate) fn properties(self, params: Vec<AbcProperty>) -> Vec<AbcProperty> {
        let real = (Pod::F32, 3);
        let mut geometry = vec![
            AbcProperty::scalar(".selfBnds", "interpretation=box", (Pod::F64, 6), vec![self.bounds]),
            AbcProperty::array(
                names::POSITIONS,
                "geoScope=var;interpretation=point",
                real,
                vec![self.positions],
            ),
            AbcProperty::array(names::IDS, "geoScope=var", (Pod::U64, 1), vec![self.ids]),
        ];
        let vector = "interpretation=vector";
        let velocities =
            self.velocities.map(|sample| AbcProperty::array(names::VELOCITIES, vector, real, vec![sample]));
        let widths =
            self.widths.map(|sample| ParamType::many(Pod::F32, 1).property(names::WIDTHS, vec![sample]));
        geometry.extend(velocities.into_iter().chain(widths));
        if !params.is_empty() {
            geometry.push(AbcProperty::compound(names::PARAMS, "", params));
        }
        geometry
    }
}

/// Points under a transform with this name. `geometry` are their [properties](PointSamples::properties).
pub(crate) fn points_object(
    name: &str,
    matrix: &Matrix,
    geometry: Vec<AbcProperty>,
    ogawa: &mut Ogawa,
) -> Result<AbcObject> {
    let schema = "schema=AbcGeom_Points_v1;schemaBaseType=AbcGeom_GeomBase_v1";
    let points = AbcObject {
        name: format!("{name}Shape"),
        metadata: format!("{schema};schemaObjTitle=AbcGeom_Points_v1:.geom"),
        properties: vec![AbcProperty::compound(names::GEOMETRY, schema, geometry)],
        children: Vec::new(),
    };
    transformed(name, matrix, points, ogawa)
}

/// Alembic's code for a transform that is given as a matrix.
const MATRIX_OPERATION: u8 = 0x30;

/// The properties of a transform that is the same at all times. The identity has no matrix.
fn transform_properties(matrix: &Matrix, ogawa: &mut Ogawa) -> Result<Vec<AbcProperty>> {
    let yes = ogawa.small_sample(1, &[1])?;
    let mut properties = vec![AbcProperty::scalar(names::INHERITS, "", (Pod::Bool, 1), vec![yes])];
    if *matrix != IDENTITY {
        let operation = ogawa.small_sample(1, &[MATRIX_OPERATION])?;
        let matrix = ogawa.small_sample(1, &real_bytes(matrix.as_flattened()))?;
        properties.push(AbcProperty::scalar(names::OPERATIONS, "", (Pod::U8, 1), vec![operation]));
        properties.push(AbcProperty::scalar(names::MATRIX, "", (Pod::F64, 16), vec![matrix]));
        properties.push(AbcProperty::scalar("isNotConstantIdentity", "", (Pod::Bool, 1), vec![yes]));
    }
    Ok(properties)
}

/// The minimum and maximum corner of the bounding box; zeros without vertices.
pub(crate) fn bounds(positions: &[[f32; 3]]) -> [[f64; 3]; 2] {
    bounds_of(positions).unwrap_or_default().map(|corner| corner.map(f64::from))
}

/// Writes the sample of a bounding box.
pub(crate) fn bounds_sample(bounds: [[f64; 3]; 2], ogawa: &mut Ogawa) -> Result<StoredSample> {
    ogawa.small_sample(1, &real_bytes(bounds.as_flattened()))
}

fn real_bytes(numbers: &[f64]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

/// Writes vectors or single numbers as a sample: `count` elements, each of `extent` numbers.
pub(crate) fn real_sample(
    values: &[f32],
    (count, extent): (u64, u64),
    ogawa: &mut Ogawa,
) -> Result<StoredSample> {
    let byte_count = 4 * count * extent;
    ogawa.sample(count, byte_count, &mut |out| write_f32s(values, out))
}

/// Writes the vertex indices of triangles, in Alembic's order, and the number of corners of each.
pub(crate) fn triangle_samples(
    triangles: &[[u32; 3]],
    count: u64,
    ogawa: &mut Ogawa,
) -> Result<[StoredSample; 2]> {
    let corners = ogawa.sample(3 * count, 12 * count, &mut |out| {
        let reversed = |[a, b, c]: [u32; 3]| {
            let mut bytes = [0; 12];
            bytes.copy_from_slice([c, b, a].map(u32::to_le_bytes).as_flattened());
            bytes
        };
        write_pieces(triangles, reversed, out)
    })?;
    let counts = ogawa.sample(count, 4 * count, &mut |out| three_each(count, out))?;
    Ok([corners, counts])
}

/// Writes the number of corners of each triangle.
fn three_each(mut count: u64, out: &mut dyn Write) -> Result<()> {
    const PIECE: usize = 4096;
    let piece = [3i32.to_le_bytes(); PIECE];
    while count > 0 {
        let part = usize::try_from(count).map_or(PIECE, |count| count.min(PIECE));
        out.write_all(piece[..part].as_flattened())?;
        count -= part as u64;
    }
    Ok(())
}
