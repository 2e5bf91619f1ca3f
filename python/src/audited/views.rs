//! NumPy arrays that borrow the memory of a surface.
//!
//! An array keeps the surface that it borrows from alive, and cannot be written to. Nothing else can write to
//! that memory either: a surface is a frozen class, so that Python code only ever gets shared references to
//! it, and its vectors have no interior mutability. So the memory is not moved, freed or changed while the
//! array exists.

use numpy::ndarray::{ArrayView, IntoDimension};
use numpy::{Element, PyArray};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;

use crate::surface::Surface;

/// A read-only array of this shape over what `data` borrows from the surface.
///
/// # Errors
/// When the shape has another number of elements than the data.
pub(crate) fn view<'py, T: Element, I: IntoDimension>(
    owner: &Bound<'py, Surface>,
    shape: I,
    data: impl for<'a> FnOnce(&'a Surface) -> &'a [T],
) -> PyResult<Bound<'py, PyArray<T, I::Dim>>> {
    let values = ArrayView::from_shape(shape.into_dimension(), data(owner.get()))
        .map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
    // SAFETY: `data` must accept a reference of any lifetime, so the slice that it returns lives in the
    // surface (or in a static) and is valid for as long as the surface exists. The array holds a reference to
    // `owner`, so the surface outlives the array. `Surface` is frozen and its vectors have no interior
    // mutability, so they are not reallocated or changed before the surface is dropped.
    let array = unsafe { PyArray::borrow_from_array(&values, owner.clone().into_any()) };
    make_read_only(&array)?;
    Ok(array)
}

/// Makes an array that Rust code created read-only. This needs no borrow of the array: another thread may be
/// reading another view of the same memory.
///
/// # Errors
/// When NumPy refuses it.
pub(crate) fn make_read_only<T: Element, D>(array: &Bound<'_, PyArray<T, D>>) -> PyResult<()> {
    // Python code cannot make the array writeable again: NumPy allows that only for an array that owns its
    // memory or whose base has a writeable buffer.
    array.call_method1("setflags", (false,))?;
    Ok(())
}
