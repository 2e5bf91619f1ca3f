//! Everything that needs more of meniscus than the method: files, pictures and the command line.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use meniscus::cli::status_of;
use meniscus::pipeline::{
    self, Cause, EmbeddedSurface, FrameError, InMemoryObstacle, OutputFormat, OutputOptions, PictureOptions,
    default_memory_bytes, in_memory_attributes, obstacle_warnings, requested_parts,
};
use meniscus::surface::RequestedParts;
use meniscus::surface::{ColumnNames, Options, Positions, Settings};
use meniscus_formats::{FilePositions, ParticleFrame, UpAxis, Values};
use numpy::{IntoPyArray, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use twox_hash::XxHash3_128;

use crate::arrays::{AttributeSlice, rows_of, word_of_role};
use crate::compute::{run, run_or_abandon};
use crate::errors::{FormatError, of_format};
use crate::options::keyword;

/// The version of meniscus.
#[pyfunction]
pub(crate) fn version() -> &'static str {
    pipeline::GENERATOR_AND_VERSION.split(' ').next_back().unwrap_or_default()
}

/// The memory that a frame may take by default, in bytes: half of the machine's memory.
#[pyfunction]
pub(crate) fn default_memory() -> u64 {
    default_memory_bytes()
}

/// Runs the command line with these arguments, the program's name first, and returns its exit status. It
/// takes over Ctrl-C and writes to the standard streams of the process, so the process should do nothing
/// else.
#[pyfunction]
pub(crate) fn run_command(py: Python<'_>, arguments: Vec<std::ffi::OsString>) -> u8 {
    py.detach(|| status_of(arguments))
}

/// The number of bytes in a text such as `8GiB`, as the command line reads it.
#[pyfunction]
pub(crate) fn memory_bytes(text: &str) -> PyResult<u64> {
    meniscus::cli::parse_bytes(text).map_err(|why| PyValueError::new_err(format!("memory: {why}")))
}

/// The extension of every format that is written.
#[pyfunction]
pub(crate) fn format_names() -> Vec<&'static str> {
    OutputFormat::ALL.into_iter().map(OutputFormat::extension).collect()
}

/// Why a file was not written.
pub(crate) enum WriteError {
    /// An option has an invalid value.
    Choice(String),
    /// The writer of the format, or the operating system, reported an error.
    Format(meniscus_formats::Error),
}

impl WriteError {
    pub(crate) fn raised(self, path: &Path) -> PyErr {
        match self {
            WriteError::Choice(what) => PyValueError::new_err(what),
            WriteError::Format(failure) => of_format(path, failure),
        }
    }
}

impl From<meniscus_formats::Error> for WriteError {
    fn from(failure: meniscus_formats::Error) -> WriteError {
        WriteError::Format(failure)
    }
}

fn format_of(extension: &str) -> Result<OutputFormat, WriteError> {
    OutputFormat::from_extension(extension).ok_or_else(|| {
        let known: Vec<&str> = OutputFormat::ALL.iter().map(|format| format.extension()).collect();
        WriteError::Choice(format!("unknown format `{extension}`: expected one of {}", known.join(", ")))
    })
}

/// How files are written.
#[derive(Clone, Debug, FromPyObject)]
#[pyo3(from_item_all)]
pub(crate) struct WriteOptions {
    up: String,
    meters_per_unit: f64,
    vdb: String,
    size: [usize; 2],
    camera: String,
}

impl WriteOptions {
    fn outputs(&self, format: OutputFormat) -> Result<OutputOptions, WriteError> {
        let choice = |what: String| Err(WriteError::Choice(what));
        let Some(up) = UpAxis::ALL.into_iter().find(|axis| axis.name() == self.up) else {
            return choice(format!("up is `{}`; it must be y or z", self.up));
        };
        if !pipeline::METERS_PER_UNIT.contains(&self.meters_per_unit) {
            return choice(format!(
                "meters_per_unit is {}; it must be from 1e-9 to 1e9",
                self.meters_per_unit
            ));
        }
        let vdb = match self.vdb.parse() {
            Ok(vdb) => vdb,
            Err(why) => return choice(format!("vdb: {why}")),
        };
        if self.size.iter().any(|edge| !(16..=8192).contains(edge)) {
            return choice(format!("size is {:?}; both must be from 16 to 8192", self.size));
        }
        let camera = match self.camera.parse() {
            Ok(camera) => camera,
            Err(why) => return choice(format!("camera: {why}")),
        };
        Ok(OutputOptions {
            up,
            meters_per_unit: self.meters_per_unit,
            vdb,
            picture: PictureOptions { size: self.size, camera },
            ..OutputOptions::new("", &[format])
        })
    }
}

/// Writes a surface to a file that it was prepared for. Returns warnings about what the file cannot store
/// exactly.
pub(crate) fn write(
    embedded: EmbeddedSurface<'_>,
    path: &Path,
    format: &str,
    options: &WriteOptions,
    source: Option<(PathBuf, String)>,
    prepared: RequestedParts,
) -> Result<Vec<String>, WriteError> {
    let format = format_of(format)?;
    let mut outputs = options.outputs(format)?;
    let name = format.extension();
    if !embedded.is_checked(format) {
        return Err(WriteError::Choice(format!(
            "the surface was not checked with the positions of a .{name}, which are rounded: \
             pass formats=[\"{name}\"] to reconstruct"
        )));
    }
    if format.is_picture() {
        // The provenance of a picture has the camera in numbers, so the camera is computed first.
        outputs = with_camera(embedded, outputs);
    }
    let hash = |(path, hash): (PathBuf, String)| match u128::from_str_radix(&hash, 16) {
        Ok(hash) => Ok((path, hash)),
        Err(_) => Err(WriteError::Choice(format!("`{hash}` is not a hash"))),
    };
    let source = source.map(hash).transpose()?;
    let outputs = Arc::new(outputs);
    embedded.write(path, format, &outputs, source)?;
    let has_voxels = !format.is_mesh() && format.has_attributes();
    let has_attributes = !embedded.surface.attributes.vertices.is_empty();
    if has_voxels && has_attributes && prepared.band_half_width_voxels.is_none() {
        return Ok(vec![format!("the .{name} has no attributes: pass formats=[\"{name}\"] to reconstruct")]);
    }
    Ok(embedded.output_warnings(&outputs))
}

/// The bytes of a picture of a surface.
pub(crate) fn picture(
    embedded: EmbeddedSurface<'_>,
    format: &str,
    options: &WriteOptions,
) -> Result<Vec<u8>, WriteError> {
    let format = format_of(format)?;
    let outputs = with_camera(embedded, options.outputs(format)?);
    Ok(embedded.picture(format, &outputs, &[])?)
}

fn with_camera(embedded: EmbeddedSurface<'_>, outputs: OutputOptions) -> OutputOptions {
    match embedded.bounds() {
        Some(bounds) if outputs.needs_camera() => outputs.with_camera_around(bounds),
        _ => outputs,
    }
}

/// What a surface must have for files with these extensions.
///
/// # Errors
/// `ValueError` for an unknown extension.
pub(crate) fn prepared_for(formats: &[String]) -> PyResult<RequestedParts> {
    let formats: Result<Vec<OutputFormat>, WriteError> =
        formats.iter().map(|format| format_of(format)).collect();
    Ok(requested_parts(&formats.map_err(|error| error.raised(Path::new("")))?))
}

/// Those attributes that the options need, and warnings about missing ones.
///
/// # Errors
/// Which attribute is missing or unusable.
pub(crate) fn needed_attributes(
    attributes: &[AttributeSlice<'_>],
    options: &Options,
) -> Result<(Vec<meniscus::surface::Attribute>, Vec<String>), String> {
    let headers = attributes.iter().map(AttributeSlice::header).collect();
    let load = |index: usize| attributes.get(index).map(AttributeSlice::to_attribute);
    in_memory_attributes(headers, load, options, keyword)
}

/// An obstacle, with a cache of its distances.
#[pyclass(frozen, module = "pymeniscus._native")]
pub(crate) struct Obstacle {
    shared: Arc<meniscus::surface::Obstacle>,
    recorded: String,
    /// Its name in warnings.
    name: PathBuf,
    /// `None` for a mesh in memory.
    file: Option<InMemoryObstacle>,
}

impl Obstacle {
    pub(crate) fn shared(&self) -> Arc<meniscus::surface::Obstacle> {
        Arc::clone(&self.shared)
    }

    /// Its name and hash, as files record it.
    pub(crate) fn recorded(&self) -> &str {
        &self.recorded
    }

    /// The likely mistakes in these obstacles and in their positions, one sentence each.
    pub(crate) fn warnings(
        obstacles: &[&Obstacle],
        particles: &Positions<'_>,
        settings: &Settings,
    ) -> Vec<String> {
        let named: Vec<(&Path, &meniscus::surface::Obstacle)> =
            obstacles.iter().map(|obstacle| (&*obstacle.name, &*obstacle.shared)).collect();
        obstacle_warnings(&named, particles, settings)
    }
}

#[pymethods]
impl Obstacle {
    /// The volume that a mesh encloses: vertices (V, 3) float64 in world units, triangles (T, 3) int64.
    #[staticmethod]
    fn from_mesh(
        py: Python<'_>,
        vertices: PyReadonlyArray2<'_, f64>,
        triangles: PyReadonlyArray2<'_, i64>,
    ) -> PyResult<Obstacle> {
        let vertices: &[[f64; 3]] = bytemuck::try_cast_slice(vertices.as_slice()?)
            .map_err(|_| PyValueError::new_err("vertices must have 3 columns"))?;
        let triangles: &[[i64; 3]] = bytemuck::try_cast_slice(triangles.as_slice()?)
            .map_err(|_| PyValueError::new_err("triangles must have 3 columns"))?;
        if triangles.is_empty() {
            return Err(PyValueError::new_err("the obstacle has no triangles"));
        }
        let index = |index: i64| {
            let is_vertex = usize::try_from(index).is_ok_and(|index| index < vertices.len());
            u32::try_from(index).ok().filter(|_| is_vertex).ok_or(index)
        };
        let made = run(py, || {
            let triangle = |[a, b, c]: &[i64; 3]| Ok([index(*a)?, index(*b)?, index(*c)?]);
            let triangles = triangles.iter().map(triangle).collect::<Result<Vec<[u32; 3]>, i64>>()?;
            let hash = |bytes: &[u8]| XxHash3_128::oneshot(bytes);
            let hash =
                hash(bytemuck::cast_slice(vertices)) ^ hash(bytemuck::cast_slice(&triangles)).rotate_left(64);
            let shared = Arc::new(meniscus::surface::Obstacle::from_mesh(vertices, &triangles));
            let recorded = format!("mesh xxh3-128:{hash:032x}");
            Ok(Obstacle { shared, recorded, name: "mesh".into(), file: None })
        })?;
        made.map_err(|index: i64| {
            let count = vertices.len();
            PyValueError::new_err(format!(
                "a triangle of the obstacle has the vertex {index}, which does not exist: there are {count}"
            ))
        })
    }

    /// The mesh or the level set in a file.
    #[staticmethod]
    fn from_file(py: Python<'_>, path: PathBuf, memory: u64) -> PyResult<Obstacle> {
        let name = path.clone();
        let loaded = run_or_abandon(py, move || InMemoryObstacle::load(&path, memory))?;
        let file = loaded.map_err(|failure| match failure.source {
            Some(source) => of_format(&failure.path, source),
            None => FormatError::new_err(failure.to_string()),
        })?;
        let (shared, recorded) = (Arc::clone(&file.obstacle), file.recorded.clone());
        Ok(Obstacle { shared, recorded, name, file: Some(file) })
    }

    /// Whether its files are as they were when it was read.
    fn is_current(&self, py: Python<'_>) -> bool {
        py.detach(|| self.file.as_ref().is_none_or(InMemoryObstacle::is_current))
    }
}

/// An attribute of a file: name, role, number of values per particle, and the values. For text, the values
/// are indices into the last item, the distinct strings.
pub(crate) type ReadAttribute<'py> =
    (String, Option<&'static str>, usize, Bound<'py, PyAny>, Option<Vec<String>>);

/// Positions (N, 3), and attributes.
pub(crate) type FrameArrays<'py> = (Bound<'py, PyAny>, Vec<ReadAttribute<'py>>);

/// Positions (N, 3), attributes, notes, and the hash of the file.
type ReadFrame<'py> = (Bound<'py, PyAny>, Vec<ReadAttribute<'py>>, Vec<String>, String);

/// Reads particles.
#[pyfunction]
pub(crate) fn read<'py>(py: Python<'py>, path: PathBuf, columns: Option<&str>) -> PyResult<ReadFrame<'py>> {
    let columns: Option<ColumnNames> = columns
        .map(str::parse)
        .transpose()
        .map_err(|why: String| PyValueError::new_err(format!("columns: {why}")))?;
    let of_file = path.clone();
    let read = run_or_abandon(py, move || {
        let content = pipeline::read_file(&of_file)?;
        let hash = pipeline::hash_of(&content);
        Ok((hash, pipeline::read_particles_of(&of_file, content, columns.as_ref())?))
    })?;
    let (hash, frame) = read.map_err(|failure: FrameError| of_frame(&path, failure))?;
    let notes = frame.notes.clone();
    let (positions, attributes) = arrays_of(py, frame)?;
    Ok((positions, attributes, notes, format!("{hash:032x}")))
}

/// The arrays of a frame of particles.
pub(crate) fn arrays_of(py: Python<'_>, frame: ParticleFrame) -> PyResult<FrameArrays<'_>> {
    let positions = match frame.positions {
        FilePositions::F32(positions) => rows_of(py, positions)?.into_any(),
        FilePositions::F64(positions) => rows_of(py, positions)?.into_any(),
    };
    let attributes = frame.attributes.into_iter().map(|attribute| {
        let role = attribute.role.and_then(word_of_role);
        let (values, table) = match attribute.values {
            Values::F32(values) => (values.into_pyarray(py).into_any(), None),
            Values::F64(values) => (values.into_pyarray(py).into_any(), None),
            Values::U8(values) => (values.into_pyarray(py).into_any(), None),
            Values::I32(values) => (values.into_pyarray(py).into_any(), None),
            Values::I64(values) => (values.into_pyarray(py).into_any(), None),
            Values::Strings { table, indices } => (indices.into_pyarray(py).into_any(), Some(table)),
        };
        (attribute.name, role, attribute.arity, values, table)
    });
    Ok((positions, attributes.collect()))
}

/// The exception for a frame that cannot be read.
fn of_frame(path: &Path, failure: FrameError) -> PyErr {
    match failure.cause {
        Cause::File(source) => of_format(path, source),
        _ => FormatError::new_err(failure.to_string()),
    }
}

/// The XXH3 hash of a file, as outputs record it.
#[pyfunction]
pub(crate) fn file_hash(py: Python<'_>, path: PathBuf) -> PyResult<String> {
    let of_file = path.clone();
    let hash = run_or_abandon(py, move || Ok(pipeline::hash_of(&pipeline::read_file(&of_file)?)))?;
    Ok(format!("{:032x}", hash.map_err(|failure: FrameError| of_frame(&path, failure))?))
}
