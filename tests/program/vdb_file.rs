//! The common parts of small hand-made .vdb files with one level set: everything except the nodes of the
//! tree.

/// The bytes of a file whose grid has this header and these buffers of leaves.
pub(crate) fn vdb_file(head: &[u8], buffers: &[u8]) -> Vec<u8> {
    let mut file = vec![0x20, 0x42, 0x44, 0x56, 0, 0, 0, 0];
    for number in [224u32, 10, 0] {
        file.extend(number.to_le_bytes());
    }
    file.push(1); // offsets follow
    file.extend([b'0'; 36]); // in place of a UUID
    file.extend(0u32.to_le_bytes()); // metadata
    file.extend(1u32.to_le_bytes()); // grids
    for text in ["surface", "Tree_float_5_4_3", ""] {
        push_string(text, &mut file);
    }
    let start = file.len() + 24;
    for offset in [start, start + head.len(), start + head.len() + buffers.len()] {
        file.extend((offset as u64).to_le_bytes());
    }
    [&file, head, buffers].concat()
}

/// The header of a grid, up to the number of its upper nodes; `compression` is the value of the field in the
/// file.
pub(crate) fn grid_head(compression: u32, voxel_size: f64, background: f32, node_count: u32) -> Vec<u8> {
    let mut head = compression.to_le_bytes().to_vec();
    head.extend(1u32.to_le_bytes());
    for text in ["class", "string", "level set", "UniformScaleMap"] {
        push_string(text, &mut head);
    }
    let (inverse, square) = (1.0 / voxel_size, 1.0 / voxel_size / voxel_size);
    for number in [voxel_size, voxel_size, inverse, square, 0.5 * inverse] {
        (0..3).for_each(|_| head.extend(number.to_le_bytes()));
    }
    head.extend(1u32.to_le_bytes()); // buffers for each leaf
    head.extend(background.to_le_bytes());
    head.extend(0u32.to_le_bytes()); // tiles of the root
    head.extend(node_count.to_le_bytes());
    head
}

fn push_string(text: &str, out: &mut Vec<u8>) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}
