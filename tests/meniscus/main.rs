//! What the program promises, tested from outside: through the command, and through the library.

mod cli; // the command: exit codes, messages, names, what is refused
mod convert; // the command on real frames: the same bytes, reports, what is done already
mod info; // the command that tells what files hold
mod layers; // the house: no module imports its own row or a higher one
mod pipeline; // frames through the stages, with a quick method in place of the real one
mod scene; // small frames of particles, and a way to run the command
