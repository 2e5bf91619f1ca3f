//! Sources without their type: what reads them is compiled once, and not once for each type of source.

use std::sync::{Mutex, PoisonError};

use glam::DVec3;

use super::{ParticleSource, Positions, Shapes};

/// A source of any type, inside [`erased`].
pub type AnySource<'a> = dyn ParticleSource<Error = Unread> + 'a;

/// The source could not be read. [`erased`] returns the error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unread;

/// Calls `read` with the source, without its type.
///
/// # Errors
/// The first error of the source, if `read` returns [`Unread`].
pub fn erased<S: ParticleSource, T>(
    source: &S,
    read: impl FnOnce(&AnySource<'_>) -> Result<T, Unread>,
) -> Result<T, S::Error> {
    let erased = Erased { source, error: Mutex::new(None) };
    read(&erased).map_err(|Unread| {
        let error = erased.error.into_inner().unwrap_or_else(PoisonError::into_inner);
        error.expect("`Unread` comes from a read that failed")
    })
}

/// A source, and its first error.
struct Erased<'a, S: ParticleSource> {
    source: &'a S,
    error: Mutex<Option<S::Error>>,
}

impl<S: ParticleSource> Erased<'_, S> {
    fn unread(&self, error: S::Error) -> Unread {
        self.error.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        Unread
    }
}

impl<S: ParticleSource> ParticleSource for Erased<'_, S> {
    type Error = Unread;

    fn batch_count(&self) -> usize {
        self.source.batch_count()
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, Unread> {
        self.source.batch(batch).map_err(|error| self.unread(error))
    }

    fn batch_len(&self, batch: usize) -> usize {
        self.source.batch_len(batch)
    }

    fn has_shapes(&self) -> bool {
        self.source.has_shapes()
    }

    fn batch_shapes(&self, batch: usize) -> Shapes {
        self.source.batch_shapes(batch)
    }

    fn is_smoothed(&self) -> bool {
        self.source.is_smoothed()
    }

    fn moved_pairs(&self, batch: usize) -> Result<Vec<[DVec3; 2]>, Unread> {
        self.source.moved_pairs(batch).map_err(|error| self.unread(error))
    }
}
