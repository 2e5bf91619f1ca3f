//! Trees of files that nobody would make on purpose, or somebody did: the command is run on them, and looked at from
//! outside.
//!
//! ```text
//!   in/dam.1.ply      good            converted, whatever lies beside it
//!   in/hostile.*      not good        one failed frame, with why; or done, where it can be
//!   in/dam.2.ply      good            converted
//! ```
//!
//! What holds for every one of them: the command ends by itself and in good order, takes no more memory than the file
//! could need, and says no word of a panic. With `MENISCUS_LONG=1` files are as large as was promised (gigabytes, most of
//! them holes); without, they are smaller.
#![cfg(target_os = "linux")]

mod bombs; // a little that unpacks to a lot
mod claims; // headers that promise, and headers without end
mod clocks; // files from the past and the future, clocks that are set
mod grids; // small volumes that are full of tiles
mod names; // names that are no text
mod scene; // a folder with good frames, and the command in it
mod sizes; // many steps, many leaves: memory in proportion
mod trees; // links that lead in circles, and what may not be read
#[path = "../meniscus/vdb_file.rs"]
mod vdb_file; // what small .vdb files share
