//! The retry policy: errors that may be temporary are retried with exponential backoff, a limited number of
//! times.

use std::io;
use std::time::Duration;

use meniscus_formats::Error;

use crate::pipeline::{Cause, FrameError, ObstacleError, Stage};

/// What to do about a failed frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RetryAction {
    /// The file is gone: forget it.
    Forget,
    /// No output can be written now: pause until that changes, then continue.
    AwaitOutputs,
    /// The error may be temporary: retry.
    Retry,
    /// Only a changed file or a restart can help: a restart may have a higher memory limit, and reads the
    /// obstacles and the outputs again.
    AwaitRestart,
    /// Only a changed file can help.
    AwaitChange,
}

/// The action for this error.
pub(crate) fn recovery(error: &FrameError) -> RetryAction {
    if error.is_disk_full() {
        return RetryAction::AwaitOutputs;
    }
    match &error.cause {
        Cause::File(source) => recovery_of_file(error.during, source),
        // Scratch files are in the folder of the outputs: if they cannot be written, outputs cannot either.
        Cause::Scratch(error) if concerns_all(error.kind()) => RetryAction::AwaitOutputs,
        Cause::Scratch(_) | Cause::Changed => RetryAction::Retry,
        Cause::Obstacle(error) => recovery_of_obstacle(error),
        Cause::TooLarge(_) | Cause::Conflict(_) => RetryAction::AwaitRestart,
        Cause::VoxelTooSmall(_) | Cause::Missing(_) | Cause::Settings(_) | Cause::Panic(_) => {
            RetryAction::AwaitChange
        }
    }
}

/// A missing or incomplete obstacle may still be written. Obstacles are not watched, so other errors need a
/// restart.
fn recovery_of_obstacle(error: &ObstacleError) -> RetryAction {
    match &error.source {
        Some(Error::Io(error)) if is_other_kind(error.kind()) => RetryAction::AwaitRestart,
        Some(source) if !matches!(source, Error::Io(_)) && !source.is_truncated() => {
            RetryAction::AwaitRestart
        }
        _ => RetryAction::Retry,
    }
}

fn recovery_of_file(during: Stage, source: &Error) -> RetryAction {
    match source {
        Error::Io(error) if during == Stage::Read && error.kind() == io::ErrorKind::NotFound => {
            RetryAction::Forget
        }
        Error::Io(error) if during == Stage::Write && concerns_all(error.kind()) => RetryAction::AwaitOutputs,
        Error::Io(error) if during == Stage::Read && is_other_kind(error.kind()) => RetryAction::AwaitChange,
        Error::Io(_) => RetryAction::Retry,
        source if source.is_truncated() => RetryAction::Retry,
        _ => RetryAction::AwaitChange,
    }
}

/// Whether a read error means that the path is that of another kind of file, such as a folder or a device.
fn is_other_kind(kind: io::ErrorKind) -> bool {
    matches!(kind, io::ErrorKind::InvalidInput | io::ErrorKind::IsADirectory)
}

/// Whether a write error that occurred for one frame would occur for all frames.
fn concerns_all(kind: io::ErrorKind) -> bool {
    matches!(
        kind,
        io::ErrorKind::ReadOnlyFilesystem
            | io::ErrorKind::StaleNetworkFileHandle
            | io::ErrorKind::NotConnected
            | io::ErrorKind::HostUnreachable
            | io::ErrorKind::NetworkUnreachable
            | io::ErrorKind::TimedOut
    )
}

/// The wait after `attempt_count` consecutive failures; `None` if there are no retries left.
pub(crate) fn backoff(attempt_count: u32, once: bool) -> Option<Duration> {
    // A run with `once` must end soon, so it does not wait for minutes.
    let attempts_max = if once { ATTEMPTS_MAX_ONCE } else { ATTEMPTS_MAX };
    let doublings = attempt_count.saturating_sub(1);
    (attempt_count < attempts_max)
        .then(|| BACKOFF_FIRST.saturating_mul(1 << doublings.min(16)).min(BACKOFF_MAX))
}

const BACKOFF_FIRST: Duration = Duration::from_millis(500);
const BACKOFF_MAX: Duration = Duration::from_secs(60);

/// With this limit, the waits take about five minutes in total.
const ATTEMPTS_MAX: u32 = 12;

/// With this limit, the waits take three and a half seconds in total.
const ATTEMPTS_MAX_ONCE: u32 = 4;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::reconstruction::TooLarge;
    use meniscus_formats::Position;
    use std::path::Path;

    fn after(during: Stage, source: Error) -> RetryAction {
        recovery(&FrameError::file(Path::new("a"), during, source))
    }

    #[test]
    fn error_determines_the_retry_action() {
        let io = |kind: io::ErrorKind| Error::Io(kind.into());
        assert_eq!(after(Stage::Read, io(io::ErrorKind::NotFound)), RetryAction::Forget);
        assert_eq!(after(Stage::Write, io(io::ErrorKind::NotFound)), RetryAction::Retry);
        assert_eq!(after(Stage::Read, io(io::ErrorKind::PermissionDenied)), RetryAction::Retry);
        assert_eq!(after(Stage::Read, io(io::ErrorKind::IsADirectory)), RetryAction::AwaitChange);
        assert_eq!(after(Stage::Write, io(io::ErrorKind::StorageFull)), RetryAction::AwaitOutputs);
        assert_eq!(after(Stage::Write, io(io::ErrorKind::QuotaExceeded)), RetryAction::AwaitOutputs);
        assert_eq!(after(Stage::Write, io(io::ErrorKind::ReadOnlyFilesystem)), RetryAction::AwaitOutputs);
        assert_eq!(after(Stage::Read, io(io::ErrorKind::StaleNetworkFileHandle)), RetryAction::Retry);
        assert_eq!(after(Stage::Write, io(io::ErrorKind::IsADirectory)), RetryAction::Retry);
        assert_eq!(after(Stage::Read, Error::invalid("PLY", Position::File, "no")), RetryAction::AwaitChange);
        assert_eq!(after(Stage::Read, Error::unsupported("PLY", "no")), RetryAction::AwaitChange);
        assert_eq!(after(Stage::Read, Error::too_large("PLY", "no")), RetryAction::AwaitChange);
        let smoothing = |cause| recovery(&FrameError { path: "a".into(), during: Stage::Smooth, cause });
        let scratch = |kind: io::ErrorKind| smoothing(Cause::Scratch(kind.into()));
        assert_eq!(scratch(io::ErrorKind::StorageFull), RetryAction::AwaitOutputs);
        assert_eq!(scratch(io::ErrorKind::QuotaExceeded), RetryAction::AwaitOutputs);
        assert_eq!(scratch(io::ErrorKind::ReadOnlyFilesystem), RetryAction::AwaitOutputs);
        assert_eq!(scratch(io::ErrorKind::PermissionDenied), RetryAction::Retry);
        assert_eq!(scratch(io::ErrorKind::NotFound), RetryAction::Retry);
        assert_eq!(smoothing(Cause::Changed), RetryAction::Retry);
        let too_large = TooLarge {
            needed_bytes: 2,
            allowed_bytes: 1,
            requires_in_core: false,
            picture_bytes: 0,
            held_count: 1,
        };
        assert_eq!(smoothing(Cause::TooLarge(too_large)), RetryAction::AwaitRestart);
        assert_eq!(smoothing(Cause::Panic("no".into())), RetryAction::AwaitChange);
        let obstacle =
            |source| smoothing(Cause::Obstacle(Box::new(ObstacleError { path: "b".into(), source })));
        assert_eq!(obstacle(Some(io(io::ErrorKind::NotFound))), RetryAction::Retry);
        assert_eq!(obstacle(Some(io(io::ErrorKind::InvalidInput))), RetryAction::AwaitRestart);
        assert_eq!(obstacle(None), RetryAction::Retry);
        let invalid = Error::invalid("OBJ", Position::Line(3), "no");
        assert_eq!(obstacle(Some(invalid)), RetryAction::AwaitRestart);
    }

    #[test]
    fn backoff_doubles_up_to_a_minute_then_ends() {
        let waits = |once| -> Vec<f64> {
            (1..).map_while(|attempt| backoff(attempt, once)).map(|wait| wait.as_secs_f64()).collect()
        };
        assert_eq!(waits(true), [0.5, 1.0, 2.0]);
        assert_eq!(waits(false)[..9], [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]);
        assert_eq!(waits(false).len(), ATTEMPTS_MAX as usize - 1);
        assert_eq!(backoff(u32::MAX, false), None);
    }
}
