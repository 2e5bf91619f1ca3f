//! All unsafe code of the package. Each block states why it is sound.
#![expect(unsafe_code, reason = "borrowed NumPy memory and the floating-point mode have no safe interface")]

pub(crate) mod float_mode;
pub(crate) mod views;
