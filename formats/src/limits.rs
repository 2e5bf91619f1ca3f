//! How much a file may ask for.
//!
//! What a reader allocates is bounded first by the bytes that the file really has; these limits
//! bound what is left: text headers, and data that grows when it is decompressed.

/// Upper limits for reading one file.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Particles in one frame.
    pub particle_count: u64,
    /// Bytes of a text header.
    pub header_bytes: u64,
    /// Properties or attributes of one element.
    pub attribute_count: usize,
    /// Bytes after decompression.
    pub decompressed_bytes: u64,
    /// Decompressed bytes per compressed byte, counted after the first mebibyte.
    pub decompression_ratio: u64,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits {
            particle_count: u32::MAX as u64,
            header_bytes: 1 << 20,
            attribute_count: 4096,
            decompressed_bytes: 1 << 40,
            decompression_ratio: 1100, // deflate itself cannot exceed 1032
        }
    }
}
