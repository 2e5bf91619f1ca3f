//! The daemon under stress: full disks, vanishing folders, many frames, little memory.
//!
//! Each test runs the command and observes it from outside: its log, its messages to the service manager, the
//! files in the folder, and its resources according to the system. With `MENISCUS_LONG=1` the tests use the
//! full number of frames; without, a few.

#![cfg(target_os = "linux")]

mod disk; // a disk that fills up, or is too full from the start
mod memory; // large frames with little memory
mod mounts; // mount namespaces for tests that mount file systems
mod poll; // periodic scans without file-system events
mod roots; // folders that vanish, return, return empty, or appear late
mod scale; // many frames that are converted already
mod scene; // a running daemon and its log; small frames
mod soak; // all faults together, for a long time
