//! Converts NumPy arrays to the input types of the surface reconstruction.

use meniscus_formats::columns::{self, radius_scale, roles_of, with_role};
use meniscus_formats::{AttributeRole, FileAttribute, Values};
use numpy::ndarray::Array2;
use numpy::{Element, IntoPyArray, PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::{PyRuntimeError, PyTypeError, PyValueError};
use pyo3::prelude::*;

/// Positions that are borrowed from an array for the duration of a call.
pub(crate) enum Positions<'py> {
    F32(PyReadonlyArray2<'py, f32>),
    F64(PyReadonlyArray2<'py, f64>),
}

impl<'py> Positions<'py> {
    /// # Errors
    /// When `array` is not an array (N, 3) of float32 or float64.
    pub(crate) fn new(array: &Bound<'py, PyAny>) -> PyResult<Positions<'py>> {
        let positions =
            match array.extract::<PyReadonlyArray2<'py, f32>>() {
                Ok(positions) => Positions::F32(positions),
                Err(_) => Positions::F64(array.extract::<PyReadonlyArray2<'py, f64>>().map_err(|_| {
                    PyTypeError::new_err("points must be an array (N, 3) of float32 or float64")
                })?),
            };
        let columns = match &positions {
            Positions::F32(array) => array.shape()[1],
            Positions::F64(array) => array.shape()[1],
        };
        match columns {
            3 => Ok(positions),
            _ => Err(PyValueError::new_err(format!("points must have 3 columns, not {columns}"))),
        }
    }

    /// The positions, without a copy. Threads can use them without the interpreter's lock.
    ///
    /// # Errors
    /// When the array is not C-contiguous.
    pub(crate) fn as_slice(&self) -> PyResult<meniscus::surface::Positions<'_>> {
        let is_c_contiguous = match self {
            Positions::F32(array) => array.is_c_contiguous(),
            Positions::F64(array) => array.is_c_contiguous(),
        };
        if !is_c_contiguous {
            return Err(PyValueError::new_err("points must be C-contiguous"));
        }
        Ok(match self {
            Positions::F32(array) => bytemuck::cast_slice::<_, [f32; 3]>(array.as_slice()?).into(),
            Positions::F64(array) => bytemuck::cast_slice::<_, [f64; 3]>(array.as_slice()?).into(),
        })
    }
}

/// An attribute as the Python layer passes it: name, role if it is known, number of values per particle, and
/// the values as a flat array. For text, the values are indices into the last item, the distinct strings.
pub(crate) type Given<'py> = (String, Option<String>, usize, Bound<'py, PyAny>, Option<Vec<String>>);

/// Attributes that are borrowed from arrays for the duration of a call.
pub(crate) struct Attributes<'py>(Vec<BorrowedAttribute<'py>>);

struct BorrowedAttribute<'py> {
    name: String,
    arity: usize,
    /// The role that the caller gave.
    role: Option<AttributeRole>,
    values: BorrowedValues<'py>,
}

enum BorrowedValues<'py> {
    F32(PyReadonlyArray1<'py, f32>),
    F64(PyReadonlyArray1<'py, f64>),
    U8(PyReadonlyArray1<'py, u8>),
    I32(PyReadonlyArray1<'py, i32>),
    I64(PyReadonlyArray1<'py, i64>),
    Strings(Vec<String>, PyReadonlyArray1<'py, i32>),
}

/// An attribute as slices, which threads can use without the interpreter's lock.
pub(crate) struct AttributeSlice<'a> {
    name: &'a str,
    arity: usize,
    role: Option<AttributeRole>,
    /// Whether the caller gave the role, so that the values have it already.
    is_role_given: bool,
    values: ValueSlice<'a>,
}

enum ValueSlice<'a> {
    F32(&'a [f32]),
    F64(&'a [f64]),
    U8(&'a [u8]),
    I32(&'a [i32]),
    I64(&'a [i64]),
    Strings(&'a [String], &'a [i32]),
}

impl<'py> Attributes<'py> {
    /// # Errors
    /// When values have a type that the Python layer never passes, or a role is unknown.
    pub(crate) fn new(given: Vec<Given<'py>>) -> PyResult<Attributes<'py>> {
        let borrowed = |(name, role, arity, values, table): Given<'py>| {
            let role = role.map(|role| role_of_word(&role)).transpose()?;
            Ok(BorrowedAttribute { name, arity, role, values: BorrowedValues::new(&values, table)? })
        };
        Ok(Attributes(given.into_iter().map(borrowed).collect::<PyResult<_>>()?))
    }

    /// The attributes, without a copy. Roles that are not given are recognised by name, as in files.
    ///
    /// # Errors
    /// When an array is not contiguous.
    pub(crate) fn as_slices(&self) -> PyResult<Vec<AttributeSlice<'_>>> {
        let named: Vec<(&str, usize)> = self.0.iter().map(|given| (&*given.name, given.arity)).collect();
        self.0.iter().zip(roles_of(&named)).map(|(given, by_name)| given.as_slice(by_name)).collect()
    }
}

impl BorrowedAttribute<'_> {
    fn as_slice(&self, by_name: Option<AttributeRole>) -> PyResult<AttributeSlice<'_>> {
        Ok(AttributeSlice {
            name: &self.name,
            arity: self.arity,
            role: self.role.or(by_name),
            is_role_given: self.role.is_some(),
            values: self.values.as_slice()?,
        })
    }
}

impl<'py> BorrowedValues<'py> {
    fn new(array: &Bound<'py, PyAny>, table: Option<Vec<String>>) -> PyResult<BorrowedValues<'py>> {
        fn vector<'py, T: Element>(array: &Bound<'py, PyAny>) -> Option<PyReadonlyArray1<'py, T>> {
            array.extract().ok()
        }
        if let Some(table) = table {
            let indices = vector(array);
            let indices = indices.ok_or_else(|| PyTypeError::new_err("the indices of strings must be int32"));
            return Ok(BorrowedValues::Strings(table, indices?));
        }
        let values = vector(array).map(BorrowedValues::F32);
        let values = values.or_else(|| vector(array).map(BorrowedValues::F64));
        let values = values.or_else(|| vector(array).map(BorrowedValues::U8));
        let values = values.or_else(|| vector(array).map(BorrowedValues::I32));
        let values = values.or_else(|| vector(array).map(BorrowedValues::I64));
        values
            .ok_or_else(|| PyTypeError::new_err("attributes must be float32, float64, uint8, int32 or int64"))
    }

    fn as_slice(&self) -> PyResult<ValueSlice<'_>> {
        Ok(match self {
            BorrowedValues::F32(array) => ValueSlice::F32(array.as_slice()?),
            BorrowedValues::F64(array) => ValueSlice::F64(array.as_slice()?),
            BorrowedValues::U8(array) => ValueSlice::U8(array.as_slice()?),
            BorrowedValues::I32(array) => ValueSlice::I32(array.as_slice()?),
            BorrowedValues::I64(array) => ValueSlice::I64(array.as_slice()?),
            BorrowedValues::Strings(table, indices) => ValueSlice::Strings(table, indices.as_slice()?),
        })
    }
}

impl AttributeSlice<'_> {
    /// The attribute without its values.
    pub(crate) fn header(&self) -> FileAttribute {
        self.with(match self.values {
            ValueSlice::F32(_) => Values::F32(Vec::new()),
            ValueSlice::F64(_) => Values::F64(Vec::new()),
            ValueSlice::U8(_) => Values::U8(Vec::new()),
            ValueSlice::I32(_) => Values::I32(Vec::new()),
            ValueSlice::I64(_) => Values::I64(Vec::new()),
            ValueSlice::Strings(..) => Values::Strings { table: Vec::new(), indices: Vec::new() },
        })
    }

    /// A copy in the type that readers of files return.
    pub(crate) fn to_attribute(&self) -> FileAttribute {
        self.with(match self.values {
            ValueSlice::F32(values) => Values::F32(values.to_vec()),
            ValueSlice::F64(values) => Values::F64(values.to_vec()),
            ValueSlice::U8(values) => Values::U8(values.to_vec()),
            ValueSlice::I32(values) => Values::I32(values.to_vec()),
            ValueSlice::I64(values) => Values::I64(values.to_vec()),
            ValueSlice::Strings(table, indices) => {
                Values::Strings { table: table.to_vec(), indices: indices.to_vec() }
            }
        })
    }

    fn with(&self, values: Values) -> FileAttribute {
        let (name, arity, role) = (self.name.to_owned(), self.arity, self.role);
        if self.is_role_given {
            FileAttribute { name, arity, role, values }
        } else {
            with_role(name, arity, role, values)
        }
    }
}

/// The names of roles in Python.
const ROLES: [(AttributeRole, &str); 10] = [
    (AttributeRole::Velocity, "velocity"),
    (AttributeRole::Acceleration, "acceleration"),
    (AttributeRole::Normal, "normal"),
    (AttributeRole::Color, "color"),
    (AttributeRole::Radius, "radius"),
    (AttributeRole::Density, "density"),
    (AttributeRole::Mass, "mass"),
    (AttributeRole::Id, "id"),
    (AttributeRole::Kind, "kind"),
    (AttributeRole::TextureCoordinates, "uv"),
];

/// The name of a role in Python.
pub(crate) fn word_of_role(role: AttributeRole) -> Option<&'static str> {
    ROLES.iter().find(|(known, _)| *known == role).map(|(_, word)| *word)
}

/// The role that an attribute with this name has in files, if the name means the same as all others with this
/// role: an object is not a phase, and a diameter is not a radius.
#[pyfunction]
pub(crate) fn role_of(name: &str) -> Option<&'static str> {
    let role = [3, 1].into_iter().find_map(|arity| columns::role_of(name, arity))?;
    let means_the_same = role != AttributeRole::Kind && radius_scale(name) == 1.0;
    word_of_role(role).filter(|_| means_the_same)
}

fn role_of_word(word: &str) -> PyResult<AttributeRole> {
    let found = ROLES.iter().find(|(_, known)| *known == word).map(|(role, _)| *role);
    found.ok_or_else(|| PyValueError::new_err(format!("unknown role `{word}`")))
}

/// An array with these rows.
pub(crate) fn rows_of<T: Element, const N: usize>(
    py: Python<'_>,
    rows: Vec<[T; N]>,
) -> PyResult<Bound<'_, PyArray2<T>>> {
    let array = Array2::from_shape_vec((rows.len(), N), rows.into_flattened());
    Ok(array.map_err(|error| PyRuntimeError::new_err(error.to_string()))?.into_pyarray(py))
}
