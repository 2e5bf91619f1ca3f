//! Tables of text: columns with names or without (`.csv`, `.txt`, `.xyz` …), LAMMPS dumps, and extended XYZ.

pub mod csv;
pub mod lammps;
pub mod xyz_ext;
