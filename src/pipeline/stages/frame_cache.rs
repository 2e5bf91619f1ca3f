//! What was computed from the frames that were looked at last, for the frames after them.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::surface::options::Settings;

/// Values of frames within a limit of memory: the oldest give way to later ones.
pub(super) struct FrameCache<K, V> {
    limit_bytes: u64,
    /// The latest ones, this many, are kept whatever their size.
    least_count: usize,
    size_bytes: fn(&V) -> u64,
    /// The latest last.
    entries: VecDeque<(K, Arc<Settings>, V)>,
}

impl<K: PartialEq, V> FrameCache<K, V> {
    /// Keeps values within this memory, in bytes, and the latest ones, this many, whatever their size.
    pub(super) fn new(limit_bytes: u64, least_count: usize, size_bytes: fn(&V) -> u64) -> FrameCache<K, V> {
        FrameCache { limit_bytes, least_count, size_bytes, entries: VecDeque::new() }
    }

    /// The value that was computed from this with these settings.
    pub(super) fn find(&self, key: &K, settings: &Arc<Settings>) -> Option<&V> {
        let mut entries = self.entries.iter();
        entries.find(|entry| is_of(entry, key, settings)).map(|(.., value)| value)
    }

    /// Removes a value that was computed with these settings and meets the condition.
    pub(super) fn take(&mut self, settings: &Arc<Settings>, is_wanted: impl Fn(&V) -> bool) -> Option<V> {
        let mut entries = self.entries.iter();
        let index = entries.position(|(_, of, value)| Arc::ptr_eq(of, settings) && is_wanted(value))?;
        self.entries.remove(index).map(|(.., value)| value)
    }

    /// Keeps a value in place of that of the same key, and at most `count` others.
    pub(super) fn keep(&mut self, key: K, settings: &Arc<Settings>, value: V, count: usize) {
        self.entries.retain(|entry| !is_of(entry, &key, settings));
        self.entries.push_back((key, Arc::clone(settings), value));
        let mut bytes: u64 = self.entries.iter().map(|(.., value)| (self.size_bytes)(value)).sum();
        let is_over = |len: usize, bytes: u64| {
            len > count.saturating_add(1) || len > self.least_count && bytes > self.limit_bytes
        };
        while is_over(self.entries.len(), bytes) {
            bytes -= self.entries.pop_front().map_or(0, |(.., value)| (self.size_bytes)(&value));
        }
    }

    pub(super) fn clear(&mut self) {
        self.entries.clear();
    }
}

fn is_of<K: PartialEq, V>((of, with, _): &(K, Arc<Settings>, V), key: &K, settings: &Arc<Settings>) -> bool {
    of == key && Arc::ptr_eq(with, settings)
}
