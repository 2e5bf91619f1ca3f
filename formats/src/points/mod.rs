//! Formats of points alone: PCD and PRT.

pub mod pcd;
pub mod prt;
