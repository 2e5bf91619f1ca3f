//! Converts NumPy arrays to the types that the method takes.

use meniscus_formats::columns::roles_of;
use meniscus_formats::{AttributeRole, FileAttribute, Values};
use numpy::{PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

/// Positions that are borrowed from an array for the duration of a call.
pub(crate) enum Positions<'py> {
    F32(PyReadonlyArray2<'py, f32>),
    F64(PyReadonlyArray2<'py, f64>),
}

/// The same positions as slices, which threads can use without the interpreter's lock.
#[derive(Clone, Copy)]
pub(crate) enum PositionSlice<'a> {
    F32(&'a [[f32; 3]]),
    F64(&'a [[f64; 3]]),
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

    /// The positions, without a copy.
    ///
    /// # Errors
    /// When the array is not C-contiguous.
    pub(crate) fn as_slice(&self) -> PyResult<PositionSlice<'_>> {
        Ok(match self {
            Positions::F32(array) => PositionSlice::F32(bytemuck::cast_slice(array.as_slice()?)),
            Positions::F64(array) => PositionSlice::F64(bytemuck::cast_slice(array.as_slice()?)),
        })
    }
}

/// An attribute as the Python layer passes it: name, role if it is known, number of values per particle, and
/// the values as a flat array. For text, the values are indices into the last item, the distinct strings.
pub(crate) type Given<'py> = (String, Option<String>, usize, Bound<'py, PyAny>, Option<Vec<String>>);

/// Converts attributes to the type that readers of files return. Roles that are not given are recognised by
/// name, as in files.
///
/// # Errors
/// When values have a type that the Python layer never passes.
pub(crate) fn attributes(given: Vec<Given<'_>>) -> PyResult<Vec<FileAttribute>> {
    let names: Vec<(String, usize)> =
        given.iter().map(|(name, _, arity, ..)| (name.clone(), *arity)).collect();
    let names: Vec<(&str, usize)> = names.iter().map(|(name, arity)| (&**name, *arity)).collect();
    let by_name = roles_of(&names);
    let attribute = |((name, role, arity, values, table), by_name): (Given<'_>, Option<AttributeRole>)| {
        let role = match role {
            Some(role) => Some(role_of_word(&role)?),
            None => by_name,
        };
        Ok(FileAttribute { name, arity, role, values: values_of(&values, table)? })
    };
    given.into_iter().zip(by_name).map(attribute).collect()
}

fn values_of(array: &Bound<'_, PyAny>, table: Option<Vec<String>>) -> PyResult<Values> {
    fn vector<'py, T: numpy::Element + Copy>(array: &Bound<'py, PyAny>) -> Option<PyResult<Vec<T>>> {
        let array = array.extract::<PyReadonlyArray1<'py, T>>().ok()?;
        Some(array.as_slice().map(<[T]>::to_vec).map_err(PyErr::from))
    }
    if let Some(table) = table {
        let indices = vector::<i32>(array)
            .ok_or_else(|| PyTypeError::new_err("the indices of strings must be int32"))??;
        return Ok(Values::Strings { table, indices });
    }
    let values = vector(array).map(|values| values.map(Values::F32));
    let values = values.or_else(|| Some(vector(array)?.map(Values::F64)));
    let values = values.or_else(|| Some(vector(array)?.map(Values::U8)));
    let values = values.or_else(|| Some(vector(array)?.map(Values::I32)));
    let values = values.or_else(|| Some(vector(array)?.map(Values::I64)));
    values
        .ok_or_else(|| PyTypeError::new_err("attributes must be float32, float64, uint8, int32 or int64"))?
}

/// The names of roles in Python.
const ROLES: [(AttributeRole, &str); 8] = [
    (AttributeRole::Velocity, "velocity"),
    (AttributeRole::Normal, "normal"),
    (AttributeRole::Color, "color"),
    (AttributeRole::Radius, "radius"),
    (AttributeRole::Density, "density"),
    (AttributeRole::Mass, "mass"),
    (AttributeRole::Id, "id"),
    (AttributeRole::Kind, "kind"),
];

/// The name of a role in Python.
pub(crate) fn word_of_role(role: AttributeRole) -> Option<&'static str> {
    ROLES.iter().find(|(known, _)| *known == role).map(|(_, word)| *word)
}

fn role_of_word(word: &str) -> PyResult<AttributeRole> {
    let found = ROLES.iter().find(|(_, known)| *known == word).map(|(role, _)| *role);
    found.ok_or_else(|| PyValueError::new_err(format!("unknown role `{word}`")))
}
