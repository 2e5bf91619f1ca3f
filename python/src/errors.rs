//! Converts errors to the exceptions that the Python package declares in `pymeniscus._errors`.

use std::path::Path;

use meniscus::surface::Error;
use meniscus::surface::options::OptionName;
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use pyo3::import_exception;
use pyo3::prelude::*;

use crate::options::keyword;

import_exception!(pymeniscus._errors, FormatError);
import_exception!(pymeniscus._errors, MemoryLimitError);
import_exception!(pymeniscus._errors, OptionError);
import_exception!(pymeniscus._errors, ParticleError);

/// The exception for an error of the reconstruction. `scratch` is the folder for scratch files.
pub(crate) fn of_method(failure: Error, scratch: &Path) -> PyErr {
    let message = failure.to_string();
    match failure {
        Error::Options(error) => OptionError::new_err(error.message(keyword)),
        Error::UnknownSpacing => OptionError::new_err(message),
        Error::MemoryLimit { .. } => MemoryLimitError::new_err(message),
        Error::Scratch(failure) => of_io(scratch, &failure),
        Error::NoParticles { .. }
        | Error::MissingAttribute { .. }
        | Error::AttributeLength { .. }
        | Error::RoundedPositions { .. }
        | Error::Filter(_)
        | Error::VoxelTooSmall { .. } => ParticleError::new_err(message),
        Error::ObstacleTooFar(_) => PyValueError::new_err(message),
        // Only an exception cancels a call, and the caller gets that exception.
        _ => PyRuntimeError::new_err(message),
    }
}

/// The exception for a file that cannot be read or written. Errors of the operating system keep their class,
/// such as `FileNotFoundError`.
pub(crate) fn of_format(path: &Path, failure: meniscus_formats::Error) -> PyErr {
    match failure {
        meniscus_formats::Error::Io(failure) => of_io(path, &failure),
        meniscus_formats::Error::MemoryLimit { what, needed_mebibytes, limit_mebibytes } => {
            let needed = needed_mebibytes.map_or_else(
                || format!("more than {limit_mebibytes} MiB of memory, the limit"),
                |needed| format!("{needed} MiB of memory, and the limit is {limit_mebibytes} MiB"),
            );
            let option = keyword(OptionName::new("memory"));
            MemoryLimitError::new_err(format!("{}: {what} needs {needed}: raise {option}", path.display()))
        }
        other => FormatError::new_err(format!("{}: {other}", path.display())),
    }
}

/// The exception for an error of the operating system, with the path of the file.
pub(crate) fn of_io(path: &Path, failure: &std::io::Error) -> PyErr {
    let Some(number) = failure.raw_os_error() else {
        // The kind determines the class, such as `FileNotFoundError`.
        return std::io::Error::new(failure.kind(), format!("{}: {failure}", path.display())).into();
    };
    Python::attach(|py| {
        // Rust's text also contains the number, which Python adds itself.
        let text = py.import("os").and_then(|os| os.call_method1("strerror", (number,))?.extract::<String>());
        match text {
            // Python chooses the subclass of `OSError` by the number.
            Ok(text) => PyOSError::new_err((number, text, path.display().to_string())),
            Err(error) => error,
        }
    })
}
