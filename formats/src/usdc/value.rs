//! Value representations: 64 bits with the type of a value, and the value or its offset in the file.
//!
//! ```text
//!   63        62        61           55..48   47..0
//!   array     inlined   compressed   type     the value, if inlined; else its offset
//! ```

/// The types of values that this crate writes, by their codes in the format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum ValueType {
    Bool = 1,
    Int = 3,
    Int64 = 5,
    Float = 8,
    Double = 9,
    String = 10,
    Token = 11,
    Vec2f = 20,
    Vec2i = 22,
    Vec3d = 23,
    Vec3f = 24,
    Vec3i = 26,
    Vec4f = 28,
    Vec4i = 30,
    Dictionary = 31,
    TokenVector = 41,
    Specifier = 42,
    Variability = 44,
    TimeSamples = 46,
    DoubleVector = 48,
}

/// A value or a reference to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct ValueRep(pub(super) u64);

const ARRAY: u64 = 1 << 63;
const INLINED: u64 = 1 << 62;
const COMPRESSED: u64 = 1 << 61;
/// All flags, including the one for edits of arrays, which this crate does not write.
const FLAGS: u64 = 0xff << 56;
const PAYLOAD: u64 = (1 << 48) - 1;

impl ValueRep {
    /// An inlined value of 32 bits.
    pub(super) fn inlined(kind: ValueType, value: u32) -> ValueRep {
        ValueRep(INLINED | Self::code(kind) | u64::from(value))
    }

    /// A value at an offset.
    pub(super) fn at(kind: ValueType, offset: u64) -> ValueRep {
        ValueRep(Self::code(kind) | offset & PAYLOAD)
    }

    /// An array at an offset; offset 0 is the empty array.
    pub(super) fn array(kind: ValueType, offset: u64, is_compressed: bool) -> ValueRep {
        let compressed = if is_compressed { COMPRESSED } else { 0 };
        ValueRep(ARRAY | compressed | Self::code(kind) | offset & PAYLOAD)
    }

    fn code(kind: ValueType) -> u64 {
        u64::from(kind as u8) << 48
    }

    /// The inlined value, if it is inlined and of this type.
    #[expect(clippy::cast_possible_truncation, reason = "inlined values have 32 bits")]
    pub(super) fn value(self, kind: ValueType) -> Option<u32> {
        (self.0 & !PAYLOAD == INLINED | Self::code(kind)).then_some((self.0 & PAYLOAD) as u32)
    }

    /// The offset of the value, if it is of this type and not inlined.
    pub(super) fn offset(self, kind: ValueType) -> Option<u64> {
        (self.0 & !PAYLOAD == Self::code(kind)).then_some(self.0 & PAYLOAD)
    }

    /// The offset of an array of this type, and whether it is compressed.
    pub(super) fn array_offset(self, kind: ValueType) -> Option<(u64, bool)> {
        let flags = self.0 & FLAGS;
        let is_array = flags & !COMPRESSED == ARRAY && self.0 & (0xff << 48) == Self::code(kind);
        is_array.then_some((self.0 & PAYLOAD, flags & COMPRESSED != 0))
    }
}
