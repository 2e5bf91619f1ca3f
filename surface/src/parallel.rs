//! Parallel loops that compile fast.
//!
//! rayon compiles its whole machinery for joining two tasks once for each loop: about 1,000 lines of
//! intermediate code, more than most loops. [`Loops::halved`] splits a loop in the same way, and joins its
//! halves through one function that is compiled once.

use rayon::iter::plumbing::{Consumer, Folder, Producer, ProducerCallback, Reducer, UnindexedConsumer};
use rayon::iter::{IndexedParallelIterator, ParallelIterator};

/// Loops over a known number of items.
pub(crate) trait Loops: IndexedParallelIterator {
    /// The same loop, split by this module. Call it after `zip`, `enumerate` and the like: they split a loop
    /// themselves.
    fn halved(self) -> Halved<Self> {
        Halved(self)
    }
}

impl<I: IndexedParallelIterator> Loops for I {}

/// A loop that this module splits.
pub(crate) struct Halved<I>(I);

impl<I: IndexedParallelIterator> ParallelIterator for Halved<I> {
    type Item = I::Item;

    fn drive_unindexed<C: UnindexedConsumer<I::Item>>(self, consumer: C) -> C::Result {
        self.drive(consumer)
    }

    fn opt_len(&self) -> Option<usize> {
        Some(self.0.len())
    }
}

impl<I: IndexedParallelIterator> IndexedParallelIterator for Halved<I> {
    fn len(&self) -> usize {
        self.0.len()
    }

    fn drive<C: Consumer<I::Item>>(self, consumer: C) -> C::Result {
        let len = self.0.len();
        self.0.with_producer(WholeLoop { len, consumer })
    }

    fn with_producer<CB: ProducerCallback<I::Item>>(self, callback: CB) -> CB::Output {
        self.0.with_producer(callback)
    }
}

struct WholeLoop<C> {
    len: usize,
    consumer: C,
}

impl<T, C: Consumer<T>> ProducerCallback<T> for WholeLoop<C> {
    type Output = C::Result;

    fn callback<P: Producer<Item = T>>(self, producer: P) -> C::Result {
        let splits = rayon::current_num_threads().max(self.len / producer.max_len().max(1));
        let split = Split { len_min: producer.min_len().max(1), splits };
        Part { len: self.len, producer, consumer: self.consumer }.run(split, false)
    }
}

/// When a part of a loop is split: rayon's rule. There are as many parts as threads, and more if another
/// thread takes one, for then the threads are unequally busy.
#[derive(Clone, Copy)]
struct Split {
    /// Parts have at least this many items.
    len_min: usize,
    /// How many parts are still to be made from this one.
    splits: usize,
}

impl Split {
    fn next(self, len: usize, was_taken: bool) -> Option<Split> {
        let splits =
            if was_taken { rayon::current_num_threads().max(self.splits / 2) } else { self.splits / 2 };
        (len / 2 >= self.len_min && (was_taken || self.splits > 0)).then_some(Split { splits, ..self })
    }
}

/// A part of a loop.
struct Part<P, C> {
    len: usize,
    producer: P,
    consumer: C,
}

impl<P: Producer, C: Consumer<P::Item>> Part<P, C> {
    fn run(self, split: Split, was_taken: bool) -> C::Result {
        let Part { len, producer, consumer } = self;
        if consumer.full() {
            return consumer.into_folder().complete();
        }
        let Some(split) = split.next(len, was_taken) else {
            return producer.fold_with(consumer.into_folder()).complete();
        };
        let middle = len / 2;
        let (producer, other_producer) = producer.split_at(middle);
        let (consumer, other_consumer, reducer) = consumer.split_at(middle);
        let mut one = Half::ToDo(Part { len: middle, producer, consumer });
        let mut other =
            Half::ToDo(Part { len: len - middle, producer: other_producer, consumer: other_consumer });
        join(&mut |was_taken| one.run(split, was_taken), &mut |was_taken| other.run(split, was_taken));
        match (one, other) {
            (Half::Done(one), Half::Done(other)) => reducer.reduce(one, other),
            _ => unreachable!("`join` runs both halves"),
        }
    }
}

/// A half of a part: its work, and then its result.
enum Half<P, C, R> {
    ToDo(Part<P, C>),
    Running,
    Done(R),
}

impl<P: Producer, C: Consumer<P::Item>> Half<P, C, C::Result> {
    fn run(&mut self, split: Split, was_taken: bool) {
        if let Half::ToDo(part) = std::mem::replace(self, Half::Running) {
            *self = Half::Done(part.run(split, was_taken));
        }
    }
}

/// Runs both tasks, on two threads if another one is idle. A task learns whether another thread took it.
fn join(one: &mut (dyn FnMut(bool) + Send), other: &mut (dyn FnMut(bool) + Send)) {
    rayon::join_context(|context| one(context.migrated()), |context| other(context.migrated()));
}
