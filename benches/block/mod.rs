//! Generated input frames for benchmarks.

/// A binary PLY file with a block of particles, 0.1 apart, moved along x by `shift`.
pub(crate) fn block_ply(block: [usize; 3], shift: f32) -> Vec<u8> {
    let count: usize = block.iter().product();
    let header = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n\
         property float x\nproperty float y\nproperty float z\nend_header\n"
    );
    let mut bytes = header.into_bytes();
    for index in 0..count {
        let [x, y, z] = [index % block[0], index / block[0] % block[1], index / block[0] / block[1]];
        for (along, shift) in [(x, shift), (y, 0.0), (z, 0.0)] {
            bytes.extend((along as f32 * 0.1 + shift).to_le_bytes());
        }
    }
    bytes
}
