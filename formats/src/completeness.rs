//! Whether a file of particles is all there, as far as its own format can tell.

/// What the format says of a file that may still be growing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Completeness {
    /// It has all that it declares.
    Complete,
    /// It declares more than there is.
    Incomplete {
        /// Bytes that it declares, at least.
        expected: u64,
        /// Bytes that there are.
        found: u64,
    },
    /// A cheap look does not tell, but reading it does: text with a count, and what is packed.
    ByReading,
    /// The format has no way of telling: a table may always have another row.
    Unproven,
}
