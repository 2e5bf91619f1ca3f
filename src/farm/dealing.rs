//! Frames dealt into contiguous chunks.

use std::ops::Range;

/// More shards are a mistake: Slurm has no larger arrays, either.
pub const SHARDS_MAX: usize = 100_000;

/// Deals `frame_count` frames to `shard_count` shards, at least one: neighbours to the same, as many to each as to any
/// other or one more. Where there are more shards than frames, the last have none.
pub fn deal(frame_count: usize, shard_count: usize) -> Vec<Range<usize>> {
    let (each, more) = (frame_count / shard_count, frame_count % shard_count);
    let first_of = |shard: usize| shard * each + shard.min(more);
    (0..shard_count).map(|shard| first_of(shard)..first_of(shard + 1)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_frame_is_dealt_once_and_evenly() {
        for frame_count in [0, 1, 2, 7, 8, 9, 240, 1001] {
            for shard_count in [1, 2, 3, 8, 16, 300] {
                let shards = deal(frame_count, shard_count);
                assert_eq!(shards.len(), shard_count);
                let dealt: Vec<usize> = shards.iter().cloned().flatten().collect();
                assert_eq!(dealt, (0..frame_count).collect::<Vec<_>>());
                let sizes = || shards.iter().map(ExactSizeIterator::len);
                assert!(sizes().max().unwrap_or(0) - sizes().min().unwrap_or(0) <= 1, "{shards:?}");
            }
        }
        assert_eq!(deal(8, 3), [0..3, 3..6, 6..8]);
    }
}
