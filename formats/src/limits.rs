//! How much a file may ask for.
//!
//! What a reader allocates is bounded first by the bytes that the file really has; these limits
//! bound what is left: text headers, and data that grows when it is decompressed.

use crate::error::{Error, Result};

/// Upper limits for reading one file.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Particles in one frame.
    pub particle_count: u64,
    /// Bytes of a text header.
    pub header_bytes: u64,
    /// Properties or attributes of one element.
    pub attribute_count: usize,
    /// Frames in one file.
    pub step_count: usize,
    /// Bytes after decompression.
    pub decompressed_bytes: u64,
    /// Decompressed bytes per compressed byte, counted after the first 16 MiB.
    pub decompression_ratio: u64,
    /// Memory for a level set, in bytes: of its file, of what is read from it, and of the tables that find its leaves and tiles.
    pub level_set_bytes: u64,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits {
            particle_count: u32::MAX as u64,
            header_bytes: 1 << 20,
            attribute_count: 4096,
            step_count: 1_000_000, // the shortest has three bytes, and each is remembered
            decompressed_bytes: 1 << 36, // the positions of as many particles as are allowed take 48 GiB
            decompression_ratio: 200, // particles shrink 2 to 10 times, lattices 50 times, a bomb 1030 times
            level_set_bytes: 1 << 36,
        }
    }
}

/// Decompressed bytes before their ratio counts. A vector that grows to so many never holds more than
/// 64 MiB, not even while it is moved.
pub(crate) const RATIO_FREE_BYTES: u64 = 16 << 20;

impl Limits {
    /// Refuses another frame of a file in which so many were found.
    pub(crate) fn check_step(&self, format: &'static str, found: usize) -> Result<()> {
        if found < self.step_count {
            return Ok(());
        }
        let what = format!("more steps than the limit of {}: cut the file into several", self.step_count);
        Err(Error::too_large(format, what))
    }

    /// How many bytes may come out of `compressed` bytes.
    pub(crate) fn decompressed_bytes_of(&self, compressed: u64) -> u64 {
        let by_ratio = compressed.saturating_mul(self.decompression_ratio).saturating_add(RATIO_FREE_BYTES);
        by_ratio.min(self.decompressed_bytes)
    }

    /// Refuses a level set that needs more memory than it may take. `content` says what needs it, and may be empty.
    ///
    /// # Errors
    /// What it needs.
    pub fn check_level_set(&self, needed_bytes: u64, content: &str) -> Result<()> {
        const MEBIBYTE: u64 = 1 << 20;
        if needed_bytes <= self.level_set_bytes {
            return Ok(());
        }
        let (needed, allowed) = (needed_bytes.div_ceil(MEBIBYTE), self.level_set_bytes / MEBIBYTE);
        let what = format!(
            "the level set{content} needs {needed} MiB of memory and may take {allowed} MiB: use --memory {needed}MiB or more"
        );
        Err(Error::too_large("OpenVDB", what))
    }

    /// Refuses `unpacked` bytes that came out of `consumed` ones, if these are too many. `format` is what packed them.
    pub(crate) fn check_unpacked(&self, format: &'static str, unpacked: u64, consumed: u64) -> Result<()> {
        if unpacked > self.decompressed_bytes {
            let most = self.decompressed_bytes;
            return Err(Error::too_large(format, format!("more than {most} bytes after decompression")));
        }
        if unpacked > self.decompressed_bytes_of(consumed) {
            let most = self.decompression_ratio;
            return Err(Error::too_large(
                format,
                format!("more than {most} bytes out of each compressed byte"),
            ));
        }
        Ok(())
    }
}
