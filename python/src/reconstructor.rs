//! Reconstructs surfaces from particles, for Python.

use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread;
use std::time::Duration;

use meniscus::surface::{CancelToken, Error, Options, RequestedParts, Settings, Storage};
use pyo3::prelude::*;

use crate::arrays::{self, Given, PositionSlice, Positions};
use crate::compute::run_with_progress;
use crate::errors::of_method;
use crate::options::{Pairs, parse, selection};
use crate::program::{Obstacle, needed_attributes, prepared};
use crate::surface::Surface;

/// Reconstructs the frames of a sequence with the same settings.
#[pyclass(frozen, module = "pymeniscus._native")]
pub(crate) struct Reconstructor {
    options: Options,
    inner: Mutex<meniscus::surface::Reconstructor<'static>>,
}

#[pymethods]
impl Reconstructor {
    /// `pairs` are the names and values of options. The surface gets all attributes, or those in
    /// `attribute_names`. A frame may take `memory` bytes; larger frames use scratch files in the folder
    /// `scratch`.
    #[new]
    fn new(
        pairs: Pairs,
        all_attributes: bool,
        attribute_names: Vec<String>,
        memory: u64,
        scratch: Option<PathBuf>,
    ) -> PyResult<Reconstructor> {
        let mut options = parse(&pairs)?;
        options.attributes = selection(all_attributes, attribute_names).or(options.attributes);
        let mut inner = meniscus::surface::Reconstructor::new(options.clone());
        inner.memory_limit(memory);
        if let Some(folder) = scratch {
            inner.scratch(move || {
                Ok(Box::new(ScratchFile(tempfile::tempfile_in(&folder)?)) as Box<dyn Storage>)
            });
        }
        Ok(Reconstructor { options, inner: Mutex::new(inner) })
    }

    /// The surface of a frame. `formats` are the extensions of the files that it is prepared for.
    #[expect(clippy::too_many_arguments, reason = "the Python layer has them as keywords")]
    fn reconstruct(
        &self,
        py: Python<'_>,
        points: &Bound<'_, PyAny>,
        attributes: Vec<Given<'_>>,
        obstacles: Vec<Py<Obstacle>>,
        formats: Vec<String>,
        quantize: bool,
        threads: Option<usize>,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<Surface> {
        let positions = Positions::new(points)?;
        let positions = positions.as_slice()?;
        let (attributes, mut warnings) = needed_attributes(arrays::attributes(attributes)?, &self.options)?;
        let prepared = prepared(&formats, quantize)?;
        let obstacles: Vec<&Obstacle> = obstacles.iter().map(Py::get).collect();
        let recorded: Vec<&str> = obstacles.iter().map(|obstacle| obstacle.recorded()).collect();
        let (recorded, shared) =
            (recorded.join(", "), obstacles.iter().map(|obstacle| obstacle.shared()).collect::<Vec<_>>());
        let made = run_with_progress(py, threads, progress.as_ref(), |token, advance| {
            let mut inner = lock_unless_cancelled(&self.inner, token)?;
            inner.obstacles(shared).cancel_token(token.clone());
            // The receiver exists as long as this closure runs.
            inner.on_progress(move |progress| {
                let _ = advance.send(progress);
            });
            let requested = RequestedParts::from(&prepared);
            let made = match positions {
                PositionSlice::F32(positions) => inner.reconstruct_parts(positions, &attributes, requested),
                PositionSlice::F64(positions) => inner.reconstruct_parts(positions, &attributes, requested),
            };
            // Drops the sender: the caller's thread waits until the channel is closed.
            inner.on_progress(|_| {});
            inner.obstacles([]);
            made
        })?;
        let (surface, settings) = made.map_err(of_method)?;
        if surface.report.particle_count == 0 {
            warnings.push("no particles are left, so the surface is empty".to_owned());
        }
        Ok(Surface::new(surface, Arc::new(settings), recorded, prepared.1.is_some(), warnings))
    }

    /// The resolved settings, as names and values in text; `None` before the first frame.
    fn settings(&self, py: Python<'_>) -> Option<Vec<(&'static str, String)>> {
        let settings = py.detach(|| {
            self.inner.lock().unwrap_or_else(PoisonError::into_inner).settings().map(Settings::to_options)
        });
        settings.map(|options| options.to_pairs())
    }
}

/// Locks a sequence, and waits if another thread uses it, until the token is cancelled.
fn lock_unless_cancelled<'a, T>(
    mutex: &'a Mutex<T>,
    token: &CancelToken,
) -> Result<MutexGuard<'a, T>, Error> {
    loop {
        match mutex.try_lock() {
            Ok(guard) => return Ok(guard),
            Err(TryLockError::Poisoned(poisoned)) => return Ok(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) if token.is_cancelled() => return Err(Error::Cancelled),
            Err(TryLockError::WouldBlock) => thread::sleep(LOCK_INTERVAL),
        }
    }
}

/// Interval between attempts to lock a sequence that another thread uses: short compared with a frame's time.
const LOCK_INTERVAL: Duration = Duration::from_millis(2);

/// The resolved settings, as names and values in text. Lengths that the options leave open are measured on
/// these particles.
#[pyfunction]
pub(crate) fn resolve(
    py: Python<'_>,
    pairs: Pairs,
    points: &Bound<'_, PyAny>,
    attributes: Vec<Given<'_>>,
) -> PyResult<Vec<(&'static str, String)>> {
    let positions = Positions::new(points)?;
    let positions = positions.as_slice()?;
    let options = parse(&pairs)?;
    let (attributes, _) = needed_attributes(arrays::attributes(attributes)?, &options)?;
    let resolved = run_with_progress(py, None, None, |token, _| {
        let mut reconstructor = meniscus::surface::Reconstructor::new(options);
        reconstructor.cancel_token(token.clone());
        let settings = match positions {
            PositionSlice::F32(positions) => reconstructor.resolve_on(positions, &attributes),
            PositionSlice::F64(positions) => reconstructor.resolve_on(positions, &attributes),
        };
        settings.map(Settings::to_options)
    })?;
    Ok(resolved.map_err(of_method)?.to_pairs())
}

/// A file without a name, which the system deletes when it is closed.
struct ScratchFile(File);

#[cfg(unix)]
impl Storage for ScratchFile {
    fn read(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
        std::os::unix::fs::FileExt::read_exact_at(&self.0, bytes, offset)
    }

    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        std::os::unix::fs::FileExt::write_all_at(&self.0, bytes, offset)
    }
}

/// On these systems, reading at an offset moves the file's position. That is safe because tiles are read one
/// after the other.
#[cfg(not(unix))]
impl Storage for ScratchFile {
    fn read(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
        use std::io::{Read, Seek, SeekFrom};
        (&self.0).seek(SeekFrom::Start(offset))?;
        (&self.0).read_exact(bytes)
    }

    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        use std::io::{Seek, SeekFrom, Write};
        (&self.0).seek(SeekFrom::Start(offset))?;
        (&self.0).write_all(bytes)
    }
}
