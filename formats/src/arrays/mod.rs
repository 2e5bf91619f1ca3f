//! Arrays with names: NumPy, HDF5, JSON, and XDMF, which describes arrays in other files.

pub mod hdf5;
pub mod json;
pub mod npy;
pub mod xdmf;
