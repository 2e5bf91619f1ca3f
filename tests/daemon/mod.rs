//! Tests the guarantees of the daemon from outside: the tests run the program, write and remove files, and
//! kill the program.
//!
//! The tests run in a short form by default; `MENISCUS_LONG=1` selects the long form. They need Linux for its
//! file-system events, its signals and its named pipes.
#![cfg(target_os = "linux")]

mod bursts; // bursts that overflow the event queue; folders that arrive with files
mod conflicts; // outputs whose names collide with other files
mod http; // the HTTP server: contents, access, and misbehaving clients
mod invalid_files; // files that are not frames, and unreadable frames
mod killed; // SIGKILL loses no frame and leaves no incomplete output
mod links_and_pipes; // links and named pipes instead of files
mod lists; // lists of files that a simulation extends
mod log; // `status` and the log, for running and stopped daemons
mod restart; // what is recorded survives a restart
mod rewrites; // frames that change before, during or after conversion
mod scene; // a watched folder, the daemon beside it, and its log
mod sentinels; // sentinel files, which mark a frame as complete
mod sequences; // one voxel size for a sequence, in any order
mod signals; // signals: end, end at once
mod stages; // stages that grow with the frames, and survive restarts
mod steps; // dumps to which a simulation appends steps
mod temporal; // frames that are averaged with those around them
mod writers; // the ways in which programs write frames
