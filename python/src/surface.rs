//! A surface for Python: it owns the memory of the result, of which Python gets views.

use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use meniscus::glam::IVec3;
use meniscus::pipeline::{EmbeddedSurface, spray_points};
use meniscus::surface::reconstruction::FrameSurface;
use meniscus::surface::{AttributeValues, LEAF_EDGE, NarrowBand, RequestedParts, Role, Settings};
use numpy::ndarray::{Array1, Array3};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArray4, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::{PyIndexError, PyMemoryError, PyValueError};
use pyo3::prelude::*;

use crate::arrays::rows_of;
use crate::audited::views::{make_read_only, view};
use crate::compute::run;
use crate::level_set::Rows;
use crate::options::effective_pairs;
use crate::program::{self, FrameArrays, WriteOptions};

/// A surface. It never changes, because arrays borrow its memory.
#[pyclass(frozen, module = "pymeniscus._native")]
pub(crate) struct Surface {
    surface: FrameSurface,
    settings: Arc<Settings>,
    obstacles: String,
    prepared: RequestedParts,
    warnings: Vec<String>,
    rows: OnceLock<Rows>,
}

/// Faces as rows of vertex indices.
type Faces<'py> = Bound<'py, PyArray2<u32>>;

/// Name, role, number of values per vertex, and for text the distinct strings.
type AttributeInfo = (String, Option<&'static str>, usize, Option<Vec<String>>);

impl Surface {
    pub(crate) fn new(
        surface: FrameSurface,
        settings: Arc<Settings>,
        obstacles: String,
        prepared: RequestedParts,
        warnings: Vec<String>,
    ) -> Surface {
        let rows = OnceLock::new();
        Surface { surface, settings, obstacles, prepared, warnings, rows }
    }

    fn band(&self) -> &NarrowBand {
        &self.surface.band
    }

    fn rows(&self) -> &Rows {
        self.rows.get_or_init(|| Rows::new(self.band()))
    }

    fn embedded(&self) -> EmbeddedSurface<'_> {
        EmbeddedSurface { surface: &self.surface, settings: &self.settings, obstacles: &self.obstacles }
    }
}

#[pymethods]
impl Surface {
    /// (V, 3) float32, world units relative to the origin.
    fn vertices<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let count = slf.get().surface.mesh.positions.len();
        view(slf, [count, 3], |this| bytemuck::cast_slice(&this.surface.mesh.positions))
    }

    /// (V, 3) float32.
    fn normals<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let count = slf.get().surface.mesh.normals.len();
        view(slf, [count, 3], |this| bytemuck::cast_slice(&this.surface.mesh.normals))
    }

    /// (T, 3) uint32.
    fn triangles<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArray2<u32>>> {
        let count = slf.get().surface.mesh.triangles.len();
        view(slf, [count, 3], |this| this.surface.mesh.triangles.as_flattened())
    }

    /// World position that vertices are relative to.
    fn origin(&self) -> [f64; 3] {
        self.surface.mesh.origin.to_array()
    }

    /// Quads (Q, 4), and the triangles (L, 3) that are not halves of a quad, both uint32.
    fn quads<'py>(&self, py: Python<'py>) -> PyResult<(Faces<'py>, Faces<'py>)> {
        let (quads, loose) = run(py, || {
            let is_first = self.surface.mesh.quads();
            let triangles = &self.surface.mesh.triangles;
            let (mut quads, mut loose) = (Vec::new(), Vec::new());
            let mut index = 0;
            while index < triangles.len() {
                let [a, b, c] = triangles[index];
                if is_first[index] {
                    let [first, second, third] = triangles[index + 1];
                    // The diagonal is c–a, or a–b: see `meniscus::surface::mesh`.
                    let is_from_diagonal = first == c && third == a;
                    quads.push(if is_from_diagonal { [a, b, c, second] } else { [a, third, b, c] });
                    index += 2;
                } else {
                    loose.push([a, b, c]);
                    index += 1;
                }
            }
            (quads, loose)
        })?;
        let (quads, loose) = (rows_of(py, quads)?, rows_of(py, loose)?);
        make_read_only(&quads)?;
        make_read_only(&loose)?;
        Ok((quads, loose))
    }

    /// Every attribute of the vertices.
    fn attributes(&self) -> Vec<AttributeInfo> {
        let info = |attribute: &meniscus::surface::Attribute| {
            let role = match attribute.role {
                Role::Velocity => Some("velocity"),
                Role::Acceleration => Some("acceleration"),
                Role::Color => Some("color"),
                Role::Radius => Some("radius"),
                Role::Id => Some("id"),
                Role::Rest | Role::TextureCoordinates | Role::Other => None,
            };
            let table = match &attribute.values {
                AttributeValues::Strings { table, .. } => Some(table.to_vec()),
                AttributeValues::Numbers(_) | AttributeValues::Integers(_) => None,
            };
            (attribute.name.clone(), role, attribute.arity, table)
        };
        self.surface.attributes.vertices.iter().map(info).collect()
    }

    /// The values of an attribute, (V, arity): float32, int64, or for text int32 indices of strings.
    fn attribute<'py>(slf: &Bound<'py, Self>, index: usize) -> PyResult<Bound<'py, PyAny>> {
        let all = &slf.get().surface.attributes.vertices;
        let attribute = all.get(index).ok_or_else(|| PyIndexError::new_err("no such attribute"))?;
        let shape = [attribute.values.len() / attribute.arity.max(1), attribute.arity];
        match &attribute.values {
            AttributeValues::Numbers(_) => {
                Ok(view(slf, shape, |this| match &this.surface.attributes.vertices[index].values {
                    AttributeValues::Numbers(values) => &values[..],
                    _ => &[],
                })?
                .into_any())
            }
            AttributeValues::Integers(_) => {
                Ok(view(slf, shape, |this| match &this.surface.attributes.vertices[index].values {
                    AttributeValues::Integers(values) => &values[..],
                    _ => &[],
                })?
                .into_any())
            }
            AttributeValues::Strings { .. } => {
                Ok(view(slf, shape, |this| match &this.surface.attributes.vertices[index].values {
                    AttributeValues::Strings { indices, .. } => &indices[..],
                    _ => &[],
                })?
                .into_any())
            }
        }
    }

    /// The positions (N, 3) and the attributes of the particles that are not in the mesh; `None` without the option.
    fn spray<'py>(&self, py: Python<'py>) -> PyResult<Option<FrameArrays<'py>>> {
        let Some(spray) = &self.surface.spray else { return Ok(None) };
        program::arrays_of(py, spray_points(spray)).map(Some)
    }

    /// (L, 3) int32: the index of the voxel with the least x, y and z in each leaf.
    fn leaf_origins<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArray2<i32>>> {
        let count = slf.get().band().topology.len();
        view(slf, [count, 3], |this| bytemuck::cast_slice(this.band().topology.origins()))
    }

    /// (L, 8, 8, 8) float32: φ at the voxels of each leaf, in units of voxels.
    fn leaf_values<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let (count, edge) = (slf.get().band().phi.leaves.len(), LEAF_EDGE as usize);
        view(slf, [count, edge, edge, edge], |this| this.band().phi.as_arrays().as_flattened())
    }

    #[getter]
    fn voxel_size(&self) -> f64 {
        self.settings.voxel_size
    }

    /// The largest absolute value of the level set, in voxels.
    #[getter]
    fn half_width(&self) -> f32 {
        self.band().half_width
    }

    /// φ at the voxels of a box, in units of voxels.
    fn dense<'py>(
        &self,
        py: Python<'py>,
        least: [i32; 3],
        size: [usize; 3],
    ) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let bytes = size.iter().try_fold(size_of::<f32>(), |bytes, edge| bytes.checked_mul(*edge));
        let is_within = least.iter().zip(size).all(|(least, size)| {
            i64::from(*least) + i64::try_from(size).unwrap_or(i64::MAX / 2) <= i64::from(i32::MAX)
        });
        if !is_within || bytes.is_none_or(|bytes| bytes > isize::MAX as usize) {
            return Err(PyValueError::new_err("the box is too large"));
        }
        let values = run(py, || self.rows().dense(self.band(), IVec3::from(least), size))?;
        let values = values.map_err(|_| {
            let bytes = bytes.unwrap_or(usize::MAX);
            PyMemoryError::new_err(format!("the values in the box need {bytes} bytes of memory"))
        })?;
        let values =
            Array3::from_shape_vec(size, values).map_err(|error| PyValueError::new_err(error.to_string()))?;
        Ok(values.into_pyarray(py))
    }

    /// φ in units of voxels, at points (N, 3) float64 in world units.
    fn sample<'py>(
        &self,
        py: Python<'py>,
        points: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        if points.shape()[1] != 3 {
            return Err(PyValueError::new_err("points must have 3 columns"));
        }
        let points = bytemuck::cast_slice::<f64, [f64; 3]>(points.as_slice()?);
        let voxel_size = self.settings.voxel_size;
        let values = run(py, || self.rows().sample(self.band(), points, voxel_size))?;
        Ok(Array1::from(values).into_pyarray(py))
    }

    /// The resolved settings that have an effect, as names and values in text.
    fn settings(&self) -> Vec<(&'static str, String)> {
        effective_pairs(&self.settings.to_options(), !self.obstacles.is_empty(), &[])
    }

    /// The measurements as JSON.
    fn report_json(&self) -> String {
        self.embedded().report_json()
    }

    /// The violated guarantees as text; empty if all hold.
    fn fault(&self) -> String {
        self.surface.report.certificate.violations()
    }

    /// The warnings, one sentence each.
    fn warnings(&self, py: Python<'_>) -> PyResult<Vec<String>> {
        run(py, || self.warnings.iter().cloned().chain(self.embedded().warnings()).collect())
    }

    /// Writes a file. `source` is the file of the particles with its hash. Returns warnings about what the
    /// file cannot store exactly.
    fn write(
        &self,
        py: Python<'_>,
        path: PathBuf,
        format: &str,
        options: WriteOptions,
        source: Option<(PathBuf, String)>,
    ) -> PyResult<Vec<String>> {
        let write = || program::write(self.embedded(), &path, format, &options, source, self.prepared);
        let written = run(py, write)?;
        written.map_err(|error| error.raised(&path))
    }

    /// The bytes of a picture.
    fn picture(&self, py: Python<'_>, format: &str, options: WriteOptions) -> PyResult<Vec<u8>> {
        let made = run(py, || program::picture(self.embedded(), format, &options))?;
        made.map_err(|error| error.raised(std::path::Path::new("picture")))
    }
}
