//! The decisions of the daemon, without files, clocks or threads.
//!
//! ```text
//!   Event ──▶ handle ─▶ intake ─▶ steps, measuring ─▶ queue ──▶ Effect
//!                       outcomes ─▶ retry
//!   state          the fields                    events         the inputs and outputs
//!   frames         the phase of each frame       completeness   when a file is complete
//!   sequences      settings, resolved once       decision       why a recorded frame is converted again
//!   disk_guard     free space                    publish        views for clients
//!   around         frames that are averaged with those around them
//! ```
//!
//! Every event is a fact that may be out of date. An event that is lost, doubled or late changes only when
//! the daemon acts, not what it does.

mod around;
pub(crate) mod completeness;
mod decision;
pub(crate) mod disk_guard;
pub(crate) mod events;
pub(crate) mod frames;
mod handle;
mod intake;
mod measuring;
mod outcomes;
pub(crate) mod publish;
mod queue;
mod retry;
pub(crate) mod sequences;
pub(crate) mod state;
mod steps;

#[cfg(test)]
mod tests;
