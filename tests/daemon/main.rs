//! What the daemon promises, tested from outside: the program runs, files come and go, and it is killed.
//!
//! These tests take their short form by default; `MENISCUS_LONG=1` has the long one. They need Linux:
//! its events, its signals, its named pipes.
#![cfg(target_os = "linux")]

mod bursts; // more files at once than the system tells of; folders that come with files in them
mod conflicts; // outputs that would meet other files: our own, the user's, another daemon's
mod killed; // killed at any moment, nothing is lost and nothing half-made is ever seen
mod links; // links and named pipes in the place of files
mod oddities; // what is no frame, and frames that cannot be read
mod remembered; // what is done, failed or fixed stays so after a restart, also without the journal
mod rewrites; // frames that change after they were converted, while they are, or before
mod scene; // a watched folder, the daemon beside it, and its log
mod sentinels; // files that say that another is complete
mod sequences; // one voxel size for a sequence, whatever the order
mod signals; // asked to end, to hurry, or to read its file again
mod steps; // a dump to which steps are appended
mod told; // what the commands tell of a running and of a stopped daemon
mod window; // what is shown while it runs, to whom, and that nobody who looks does any harm
mod writers; // the ways in which frames come into being
