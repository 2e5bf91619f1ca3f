//! The native module of the Python package `pymeniscus`. Only the package itself imports it: its names may
//! change in any version.
//!
//! ```text
//!   pymeniscus (Python)     names, types, conversions of arrays, documentation
//!        │
//!   _native (this crate)    reconstruct ─▶ compute (threads, Ctrl-C)    options    errors
//!        │                  surface ─▶ audited (unsafe)     level_set
//!        │                  program: everything that needs the pipeline or the command line
//!        ▼
//!   meniscus::surface, meniscus_formats, meniscus::pipeline, meniscus::cli
//! ```

mod arrays;
mod audited;
mod compute;
mod errors;
mod level_set;
mod options;
mod program;
mod reconstruct;
mod surface;

use pyo3::prelude::*;

/// The native module.
#[pymodule(gil_used = true)]
mod _native {
    #[pymodule_export]
    use crate::arrays::role_of;
    #[pymodule_export]
    use crate::options::{check_options, computed_attributes, option_table, option_warnings};
    #[pymodule_export]
    use crate::program::{
        Obstacle, default_memory, file_hash, format_names, memory_bytes, read, run_command, version,
    };
    #[pymodule_export]
    use crate::reconstruct::{Smoothed, average, reconstruct, resolve, smooth};
    #[pymodule_export]
    use crate::surface::Surface;
}
