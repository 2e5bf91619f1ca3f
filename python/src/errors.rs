//! Converts errors to the exceptions that the Python package declares in `pymeniscus._errors`.

use meniscus::surface::Error;
use pyo3::exceptions::{PyOSError, PyRuntimeError};
use pyo3::prelude::*;
use pyo3::types::PyType;

/// A class of `pymeniscus._errors`.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Class {
    Option,
    Particles,
    MemoryLimit,
    Format,
    Cancelled,
}

impl Class {
    fn name(self) -> &'static str {
        match self {
            Class::Option => "OptionError",
            Class::Particles => "ParticleError",
            Class::MemoryLimit => "MemoryLimitError",
            Class::Format => "FormatError",
            Class::Cancelled => "CancelledError",
        }
    }
}

/// An error of this class.
pub(crate) fn error(class: Class, message: impl Into<String>) -> PyErr {
    let message = message.into();
    Python::attach(|py| {
        let found = || -> PyResult<Bound<'_, PyType>> {
            Ok(py.import("pymeniscus._errors")?.getattr(class.name())?.cast_into::<PyType>()?)
        };
        match found() {
            Ok(class) => PyErr::from_type(class, message),
            Err(error) => error,
        }
    })
}

/// The exception for an error of the reconstruction.
pub(crate) fn of_method(failure: Error) -> PyErr {
    let message = failure.to_string();
    match failure {
        Error::Options(_) | Error::UnknownSpacing => error(Class::Option, message),
        Error::MemoryLimit { .. } => error(Class::MemoryLimit, message),
        Error::Scratch(_) => PyOSError::new_err(message),
        Error::Cancelled => error(Class::Cancelled, message),
        Error::NoParticles { .. }
        | Error::MissingAttribute { .. }
        | Error::AttributeLength { .. }
        | Error::VoxelTooSmall { .. } => error(Class::Particles, message),
        _ => PyRuntimeError::new_err(message),
    }
}

/// The exception for a file that cannot be read or written. Errors of the operating system keep their class,
/// such as `FileNotFoundError`.
pub(crate) fn of_format(path: &std::path::Path, failure: meniscus_formats::Error) -> PyErr {
    match failure {
        meniscus_formats::Error::Io(failure) => of_io(path, &failure),
        other => error(Class::Format, format!("{}: {other}", path.display())),
    }
}

/// The exception for an error of the operating system, with the path of the file.
pub(crate) fn of_io(path: &std::path::Path, failure: &std::io::Error) -> PyErr {
    match failure.raw_os_error() {
        // Python chooses the subclass of `OSError` by the error number.
        Some(number) => PyOSError::new_err((number, failure.to_string(), path.display().to_string())),
        None => PyOSError::new_err(format!("{}: {failure}", path.display())),
    }
}
