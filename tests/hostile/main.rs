//! Hostile and accidental folder contents: the tests run the command on them, and observe it from outside.
//!
//! ```text
//!   in/dam.1.ply      good            converted, whatever lies next to it
//!   in/hostile.*      not good        one failed frame with its reason, or done if possible
//!   in/dam.2.ply      good            converted
//! ```
//!
//! For every one of them, the command ends normally, takes no more memory than the file could need, and never
//! panics. With `MENISCUS_LONG=1` the files have their full size (gigabytes, most of them sparse); without,
//! they are smaller.
#![cfg(target_os = "linux")]

mod bombs; // small files that unpack to huge ones
mod claims; // headers that promise missing data, and headers without end
mod clocks; // files from the past and the future, clocks that change
mod grids; // small volumes that are full of tiles
mod names; // names that are not Unicode
mod scene; // a folder with good frames, and the command in it
mod sizes; // many steps, many leaves: memory in proportion
mod trees; // cycles of links, and unreadable files
#[path = "../meniscus/vdb_file.rs"]
mod vdb_file; // what small .vdb files share
