//! Files that are hostile, or in the folder by accident: the tests run the command on them, and observe it
//! from outside.
//!
//! ```text
//!   in/dam.1.ply      valid           converted, whatever other files are in the folder
//!   in/hostile.*      not valid       a failed frame with a reason, or a done frame if possible
//!   in/dam.2.ply      valid           converted
//! ```
//!
//! For every such file, the command ends normally, does not panic, and uses no more memory than a valid file
//! of this size could need. With `MENISCUS_LONG=1`, the files have their full size (gigabytes, most of them
//! sparse). Without it, they are smaller.
#![cfg(target_os = "linux")]

mod bombs; // decompression bombs
mod claims; // headers that declare missing data, and headers without an end
mod clocks; // files from the past and the future, clocks that change
mod grids; // small volumes that are full of tiles
mod names; // names that are not Unicode
mod scene; // a folder with good frames, and the command in it
mod sizes; // many steps, many leaves: memory in proportion to the file
mod trees; // cycles of links, and unreadable files
