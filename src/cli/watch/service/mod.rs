//! What the system's service manager is told. systemd alone wants to know; where there is none, nobody
//! is told.

#[cfg(target_os = "linux")]
mod systemd;
#[cfg(target_os = "linux")]
pub(super) use systemd::{Service, tell_not_reloaded, tell_reloading};

#[cfg(not(target_os = "linux"))]
mod noop;
#[cfg(not(target_os = "linux"))]
pub(super) use noop::{Service, tell_not_reloaded, tell_reloading};
