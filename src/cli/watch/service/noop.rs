//! The notifications on systems without systemd: they do nothing.

use crate::watch::Notice;

pub(in crate::cli::watch) struct Service;

impl Service {
    pub(in crate::cli::watch) fn new() -> Service {
        Service
    }

    pub(in crate::cli::watch) fn tell(&mut self, _notice: &Notice) {}
}

pub(in crate::cli::watch) fn tell_reloading() {}

pub(in crate::cli::watch) fn tell_not_reloaded(_why: &str) {}
