//! Limits on the resources that a file can make a reader use.
//!
//! The size of the file bounds most of what a reader allocates. These limits bound the rest: text headers,
//! and data that grows when it is decompressed.

use crate::core::error::{Error, Result};

/// Upper limits for reading one file.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Maximum number of particles in one frame.
    pub particle_count: u64,
    /// Maximum size of a text header, in bytes.
    pub header_bytes: u64,
    /// Maximum number of properties or attributes of one element.
    pub attribute_count: usize,
    /// Maximum number of frames in one file.
    pub step_count: usize,
    /// Maximum memory for what is read from one file, decompressed, in bytes. For a level set this includes
    /// the file and the tables that locate its leaves and tiles.
    pub memory_bytes: u64,
    /// Maximum number of decompressed bytes per compressed byte, ignoring the first 16 MiB.
    pub decompression_ratio: u64,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits {
            particle_count: u32::MAX as u64,
            header_bytes: 1 << 20,
            attribute_count: 4096,
            step_count: 1_000_000, // a step can be as short as three bytes, and the reader keeps an entry for each
            memory_bytes: 1 << 36, // `particle_count` positions take 48 GiB
            decompression_ratio: 200, // particles compress by 2 to 10, lattices by 50, a decompression bomb by 1030
        }
    }
}

/// Decompressed bytes that the ratio limit ignores. A vector that grows to this size never holds more than 64
/// MiB, even while it is reallocated.
pub(crate) const RATIO_FREE_BYTES: u64 = 16 << 20;

impl Limits {
    /// The default limits, with this much memory for one file, in bytes.
    pub fn within(memory_bytes: u64) -> Limits {
        Limits { memory_bytes, ..Limits::default() }
    }

    /// Fails if there are more particles or vertices than the limit.
    pub(crate) fn check_particles(&self, format: &'static str, found: u64) -> Result<()> {
        if found <= self.particle_count {
            return Ok(());
        }
        let what = format!("the file has {found} particles, more than the limit of {}", self.particle_count);
        Err(Error::too_large(format, what))
    }

    /// Fails if there are more attributes than the limit. `kind` says what the format calls them.
    pub(crate) fn check_attributes(&self, format: &'static str, found: usize, kind: &str) -> Result<()> {
        if found <= self.attribute_count {
            return Ok(());
        }
        let what = format!("the file has {found} {kind}, more than the limit of {}", self.attribute_count);
        Err(Error::too_large(format, what))
    }

    /// Fails if the limit does not allow another frame after the `found` frames found so far.
    pub(crate) fn check_step(&self, format: &'static str, found: usize) -> Result<()> {
        if found < self.step_count {
            return Ok(());
        }
        let what = format!(
            "the file has more steps than the limit of {}: split it into several files",
            self.step_count
        );
        Err(Error::too_large(format, what))
    }

    /// The maximum decompressed size of `compressed` bytes.
    pub(crate) fn decompressed_bytes_of(&self, compressed: u64) -> u64 {
        self.bytes_by_ratio(compressed).min(self.memory_bytes)
    }

    fn bytes_by_ratio(&self, compressed: u64) -> u64 {
        compressed.saturating_mul(self.decompression_ratio).saturating_add(RATIO_FREE_BYTES)
    }

    /// Fails if `what`, such as "the level set with its picture", needs more memory than the limit.
    ///
    /// # Errors
    /// [`Error::MemoryLimit`] with the required amount.
    pub fn check_memory(&self, needed_bytes: u64, what: &str) -> Result<()> {
        if needed_bytes <= self.memory_bytes {
            return Ok(());
        }
        Err(self.memory_limit(what, Some(needed_bytes.div_ceil(MEBIBYTE))))
    }

    /// Fails if `decompressed` bytes from `consumed` compressed bytes exceed a limit. `format` is
    /// the compression format.
    pub(crate) fn check_decompressed(
        &self,
        format: &'static str,
        decompressed: u64,
        consumed: u64,
    ) -> Result<()> {
        if decompressed > self.bytes_by_ratio(consumed) {
            let most = self.decompression_ratio;
            return Err(Error::too_large(
                format,
                format!("the data expands to more than {most} times its compressed size, the limit"),
            ));
        }
        // More may follow.
        if decompressed > self.memory_bytes {
            return Err(self.memory_limit("reading the file", None));
        }
        Ok(())
    }

    fn memory_limit(&self, what: &str, needed_mebibytes: Option<u64>) -> Error {
        Error::MemoryLimit {
            what: what.to_owned(),
            needed_mebibytes,
            limit_mebibytes: self.memory_bytes / MEBIBYTE,
        }
    }
}

const MEBIBYTE: u64 = 1 << 20;
