//! Notifications for the system's service manager. Only systemd uses them; elsewhere they do nothing.

#[cfg(target_os = "linux")]
mod systemd;
#[cfg(target_os = "linux")]
pub(super) use systemd::Service;

#[cfg(not(target_os = "linux"))]
mod noop;
#[cfg(not(target_os = "linux"))]
pub(super) use noop::Service;
