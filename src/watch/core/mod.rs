//! What the daemon decides, without files, clocks or threads.
//!
//! ```text
//!   Event ──▶ handle ─▶ intake ─▶ steps, settle ─▶ queue ──▶ Effect
//!                       outcomes ─▶ retry
//!   frames         how far each frame is         completeness   when a file is complete
//!   sequences      settings, fixed once each     decision       why a frame is, or is not, converted
//!   disk_guard     free space and mounts         publish        what users see of it
//! ```
//!
//! Every event is a fact that may be old: an event that is lost, doubled or late changes nothing but the time.

pub mod completeness;
pub mod decision;
pub(in crate::watch) mod disk_guard;
pub(in crate::watch) mod events;
pub(in crate::watch) mod file_steps;
pub(in crate::watch) mod frames;
mod handle;
mod intake;
mod outcomes;
pub(in crate::watch) mod publish;
mod queue;
mod retry;
pub(in crate::watch) mod sequences;
mod settle;
pub(in crate::watch) mod state;
mod steps;

#[cfg(test)]
mod tests;

pub(in crate::watch) use handle::Tally;
