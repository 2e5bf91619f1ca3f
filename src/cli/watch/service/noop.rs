//! The notifications on systems without systemd: they do nothing.

use crate::watch::Notice;

pub(in crate::cli::watch) struct Service;

impl Service {
    pub(in crate::cli::watch) fn new() -> Service {
        Service
    }

    pub(in crate::cli::watch) fn notify(&mut self, _notice: &Notice) {}
}
