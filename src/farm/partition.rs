//! Partitions frames into contiguous chunks.

use std::ops::Range;

/// Upper limit of the number of shards. A larger number is probably a mistake: it is far above the default
/// limit of Slurm's job arrays (`MaxArraySize`, about 1000).
pub const SHARDS_MAX: usize = 100_000;

/// Partitions `frame_count` frames into contiguous chunks for `shard_count` shards (at least one). The sizes
/// of the chunks differ by one at most. If there are more shards than frames, the last chunks are empty.
pub fn partition(frame_count: usize, shard_count: usize) -> Vec<Range<usize>> {
    let (each, more) = (frame_count / shard_count, frame_count % shard_count);
    let first_of = |shard: usize| shard * each + shard.min(more);
    (0..shard_count).map(|shard| first_of(shard)..first_of(shard + 1)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_partitioned_into_even_chunks() {
        for frame_count in [0, 1, 2, 7, 8, 9, 240, 1001] {
            for shard_count in [1, 2, 3, 8, 16, 300] {
                let shards = partition(frame_count, shard_count);
                assert_eq!(shards.len(), shard_count);
                let dealt: Vec<usize> = shards.iter().cloned().flatten().collect();
                assert_eq!(dealt, (0..frame_count).collect::<Vec<_>>());
                let sizes = || shards.iter().map(ExactSizeIterator::len);
                assert!(sizes().max().unwrap_or(0) - sizes().min().unwrap_or(0) <= 1, "{shards:?}");
            }
        }
        assert_eq!(partition(8, 3), [0..3, 3..6, 6..8]);
    }
}
