//! Vectors of eight or sixteen values: one or two rows of a leaf in a register.
//!
//! Every operation is that of IEEE 754 on each value, so a kernel computes the same bits with every type.
//! Where instruction sets differ, as in `max` with NaN, the [portable type](Portable) defines the result.

/// One row or two consecutive rows of eight 32-bit values. Row `k` is in lanes `8·k` to `8·k + 7`.
pub trait Vector: Copy {
    /// Per-lane mask.
    type Mask: Copy;

    /// Number of rows.
    const ROWS: usize;

    /// Loads row `y` and those after it; `y` is a multiple of [`ROWS`](Self::ROWS).
    fn load_at(rows: &[[f32; 8]; 8], y: usize) -> Self;

    /// Loads row k from `row(k)`.
    fn from_rows<'a>(row: impl Fn(usize) -> &'a [f32; 8]) -> Self;

    /// Stores to row `y` and those after it; `y` is a multiple of [`ROWS`](Self::ROWS).
    fn store_at(self, rows: &mut [[f32; 8]; 8], y: usize);

    /// The same value in all lanes.
    fn splat(value: f32) -> Self;

    /// Sum.
    fn add(self, other: Self) -> Self;

    /// Difference.
    fn sub(self, other: Self) -> Self;

    /// Product.
    fn mul(self, other: Self) -> Self;

    /// Quotient.
    fn div(self, other: Self) -> Self;

    /// Square root.
    fn sqrt(self) -> Self;

    /// Absolute value.
    fn abs(self) -> Self;

    /// The values, with the signs of `sign`.
    fn copysign(self, sign: Self) -> Self;

    /// The smaller of two values per lane; `other` if they are unordered (one is NaN).
    fn min(self, other: Self) -> Self;

    /// The larger of two values per lane; `other` if they are unordered (one is NaN).
    fn max(self, other: Self) -> Self;

    /// Lanes where a value is less than the other.
    fn lt(self, other: Self) -> Self::Mask;

    /// Lanes where the values differ, or one of them is NaN.
    fn ne(self, other: Self) -> Self::Mask;

    /// The mask of row `y` and those after it, from the bits of eight rows: byte `y` has the bits of row `y`.
    /// `y` is a multiple of [`ROWS`](Self::ROWS).
    fn mask_at(rows: u64, y: usize) -> Self::Mask;

    /// The mask as bits: byte k has the bits of row k.
    fn row_bits(mask: Self::Mask) -> u64;

    /// Lanes that are set in both masks.
    fn both(one: Self::Mask, other: Self::Mask) -> Self::Mask;

    /// Lanes that are not set.
    fn not(mask: Self::Mask) -> Self::Mask;

    /// `then` in lanes of the mask, `otherwise` elsewhere.
    fn select(mask: Self::Mask, then: Self, otherwise: Self) -> Self;

    /// Each lane gets the value of the previous lane; the first lane of row k gets `first(k)`.
    fn shift_rows_up(self, first: impl Fn(usize) -> f32) -> Self;

    /// Each lane gets the value of the next lane; the last lane of row k gets `last(k)`.
    fn shift_rows_down(self, last: impl Fn(usize) -> f32) -> Self;

    /// True if any lane is set.
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        Self::row_bits(mask) != 0
    }

    /// All lanes of each row that has a set lane.
    #[inline(always)]
    fn whole_rows(mask: Self::Mask) -> Self::Mask {
        let bits = Self::row_bits(mask);
        let mut whole = 0;
        for row in 0..Self::ROWS {
            let of_row = 0xff << (8 * row);
            whole |= if bits & of_row == 0 { 0 } else { of_row };
        }
        Self::mask_at(whole, 0)
    }
}

/// One row.
pub trait Lanes: Vector {
    /// Loads the values of a row.
    #[inline(always)]
    fn load(row: &[f32; 8]) -> Self {
        Self::from_rows(|_| row)
    }

    /// Stores the values to a row.
    fn store(self, row: &mut [f32; 8]);

    /// The mask with bit k for lane k.
    #[inline(always)]
    fn mask(bits: u8) -> Self::Mask {
        Self::mask_at(u64::from(bits), 0)
    }

    /// The mask as bits.
    #[inline(always)]
    fn bits(mask: Self::Mask) -> u8 {
        Self::row_bits(mask) as u8
    }
}

/// Maximum of eight non-negative values, none of which is NaN.
#[inline(always)]
pub fn greatest<V: Lanes>(values: V) -> f32 {
    let greater = |one: f32, other: f32| if one > other { one } else { other };
    let mut row = [0.0; 8];
    values.store(&mut row);
    // In three steps, not in eight that depend on each other.
    let four: [f32; 4] = std::array::from_fn(|k| greater(row[k], row[k + 4]));
    greater(greater(four[0], four[2]), greater(four[1], four[3]))
}

/// The implementation without intrinsics, for every processor.
#[derive(Clone, Copy)]
pub(super) struct Portable([f32; 8]);

impl Portable {
    #[inline(always)]
    fn map(self, other: Portable, f: impl Fn(f32, f32) -> f32) -> Portable {
        Portable(std::array::from_fn(|k| f(self.0[k], other.0[k])))
    }
}

impl Lanes for Portable {
    #[inline(always)]
    fn store(self, row: &mut [f32; 8]) {
        *row = self.0;
    }
}

impl Vector for Portable {
    type Mask = [bool; 8];

    const ROWS: usize = 1;

    #[inline(always)]
    fn from_rows<'a>(row: impl Fn(usize) -> &'a [f32; 8]) -> Portable {
        Portable(*row(0))
    }

    #[inline(always)]
    fn load_at(rows: &[[f32; 8]; 8], y: usize) -> Portable {
        Portable(rows[y & 7])
    }

    #[inline(always)]
    fn store_at(self, rows: &mut [[f32; 8]; 8], y: usize) {
        rows[y & 7] = self.0;
    }

    #[inline(always)]
    fn splat(value: f32) -> Portable {
        Portable([value; 8])
    }

    #[inline(always)]
    fn add(self, other: Portable) -> Portable {
        self.map(other, |a, b| a + b)
    }

    #[inline(always)]
    fn sub(self, other: Portable) -> Portable {
        self.map(other, |a, b| a - b)
    }

    #[inline(always)]
    fn mul(self, other: Portable) -> Portable {
        self.map(other, |a, b| a * b)
    }

    #[inline(always)]
    fn div(self, other: Portable) -> Portable {
        self.map(other, |a, b| a / b)
    }

    #[inline(always)]
    fn sqrt(self) -> Portable {
        Portable(self.0.map(f32::sqrt))
    }

    #[inline(always)]
    fn abs(self) -> Portable {
        Portable(self.0.map(f32::abs))
    }

    #[inline(always)]
    fn copysign(self, sign: Portable) -> Portable {
        self.map(sign, f32::copysign)
    }

    #[inline(always)]
    fn min(self, other: Portable) -> Portable {
        self.map(other, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn max(self, other: Portable) -> Portable {
        self.map(other, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn lt(self, other: Portable) -> [bool; 8] {
        std::array::from_fn(|k| self.0[k] < other.0[k])
    }

    #[inline(always)]
    fn ne(self, other: Portable) -> [bool; 8] {
        std::array::from_fn(|k| self.0[k] != other.0[k])
    }

    #[inline(always)]
    fn mask_at(rows: u64, y: usize) -> [bool; 8] {
        let bits = (rows >> (8 * (y & 7))) as u8;
        std::array::from_fn(|k| bits >> k & 1 == 1)
    }

    #[inline(always)]
    fn row_bits(mask: [bool; 8]) -> u64 {
        (0..8).fold(0, |bits, k| bits | u64::from(mask[k]) << k)
    }

    #[inline(always)]
    fn both(one: [bool; 8], other: [bool; 8]) -> [bool; 8] {
        std::array::from_fn(|k| one[k] & other[k])
    }

    #[inline(always)]
    fn not(mask: [bool; 8]) -> [bool; 8] {
        mask.map(|holds| !holds)
    }

    #[inline(always)]
    fn select(mask: [bool; 8], then: Portable, otherwise: Portable) -> Portable {
        Portable(std::array::from_fn(|k| if mask[k] { then.0[k] } else { otherwise.0[k] }))
    }

    #[inline(always)]
    fn shift_rows_up(self, first: impl Fn(usize) -> f32) -> Portable {
        let c = self.0;
        Portable([first(0), c[0], c[1], c[2], c[3], c[4], c[5], c[6]])
    }

    #[inline(always)]
    fn shift_rows_down(self, last: impl Fn(usize) -> f32) -> Portable {
        let c = self.0;
        Portable([c[1], c[2], c[3], c[4], c[5], c[6], c[7], last(0)])
    }
}
