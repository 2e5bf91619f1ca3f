//! Tests the program from outside, through the command and through the library.

mod checks; // the documentation and the manifests agree with the program
mod daemon; // the daemon's guarantees
mod faults; // file operations that fail, and a program that is killed
mod hostile; // files that are hostile, or in the folder by accident
mod memory_limit; // the memory of a process that converts many frames
mod program; // the guarantees of the commands
mod siege; // the daemon under stress
