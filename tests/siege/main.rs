//! The daemon under siege: disks that fill up, folders that vanish, many frames, little memory.
//!
//! Each test starts the command itself and looks at it from outside: what it logs, what it tells the
//! service manager, what appears in the folder, what the system says that it takes. With
//! `MENISCUS_LONG=1` the tests have as many frames as were promised; without, a few.

#![cfg(target_os = "linux")]

mod disk; // a disk that fills up, or has too little room from the start
mod fuse; // a file system whose server can be stopped
mod hangs; // file systems that stop answering
mod memory; // large frames through little memory
mod mounts; // tests that mount file systems of their own
mod poll; // looking by itself, where the system tells nothing
mod roots; // folders that vanish, come back, come up empty, come late
mod scale; // many frames that are converted already
mod scene; // a daemon at work, seen from outside; small frames
mod soak; // everything at once, and for long
