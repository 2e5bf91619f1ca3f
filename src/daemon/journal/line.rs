//! One record, one line.
//!
//! ```text
//!   8f3a09c1d2e4b576 {"frame":{"input":"/sim/dam.0012.bgeo","standing":"done", … }}⏎
//!   xxh3-64 of the   one JSON object: the kind of record, and the record
//!   rest, in hex
//! ```
//!
//! Lines of text, so that a person can read and search them; a checksum, so that a line that was
//! written in part, or over which something else was written, is known for what it is. A record is
//! taken whole or not at all.
//!
//! The structs here are the lines' own: a field that is renamed elsewhere changes no journal. JSON
//! has no place for what some paths and numbers are, so
//!
//! - a path that is no text is a list of its bytes (on Windows, of its 16-bit units);
//! - a hash is 32 hexadecimal digits;
//! - a number that results depend on is the shortest text that reads back as that number: a parser
//!   of JSON may round the last bit.

use std::ffi::OsString;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use twox_hash::XxHash3_64;

use crate::pipeline::FileStamp;

use super::plan::WirePlan;
use super::state::{
    DaemonRecord, DaemonState, Entry, EntryRef, FrameRecord, OutputRecord, SequenceCamera, SequenceKey,
    SequenceRecord, Standing,
};

/// Digits of a checksum.
const CHECKSUM_DIGITS: usize = 16;

/// Adds the line of a record to `out`.
///
/// # Errors
/// When the record has no form in JSON; `out` is as it was then.
pub(super) fn push_line(out: &mut Vec<u8>, entry: EntryRef<'_>) -> io::Result<()> {
    let record = serde_json::to_vec(&WireEntry::from(entry))?;
    let checksum = XxHash3_64::oneshot(&record);
    out.extend_from_slice(format!("{checksum:0CHECKSUM_DIGITS$x} ").as_bytes());
    out.extend_from_slice(&record);
    out.push(b'\n');
    Ok(())
}

/// The record of a line, without its end; `None` where the line is not as it was written.
pub(super) fn parse_line(line: &[u8]) -> Option<Entry> {
    let (checksum, rest) = line.split_at_checked(CHECKSUM_DIGITS)?;
    let record = rest.strip_prefix(b" ")?;
    let checksum = u64::from_str_radix(str::from_utf8(checksum).ok()?, 16).ok()?;
    if checksum != XxHash3_64::oneshot(record) {
        return None;
    }
    serde_json::from_slice::<WireEntry>(record).ok()?.into_entry()
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum WireEntry {
    Frame(WireFrame),
    Sequence(WireSequence),
    Daemon(WireDaemon),
    Plan(WirePlan),
}

#[derive(Serialize, Deserialize)]
struct WireFrame {
    input: WirePath,
    standing: WireStanding,
    size_bytes: u64,
    modified_ns: i64,
    inode: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    hash: Option<String>,
    settings: String,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    outputs: Vec<WireOutput>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    attempts: u32,
    at_ms: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    particles: Option<usize>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    seconds: Option<f64>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    flaws: Vec<String>,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum WireStanding {
    Queued,
    Done,
    Failed,
    Retrying,
    Refused,
    GivenUp,
}

#[derive(Serialize, Deserialize)]
struct WireOutput {
    path: WirePath,
    size_bytes: u64,
}

#[derive(Serialize, Deserialize)]
struct WireSequence {
    folder: WirePath,
    name: String,
    choices: String,
    voxel_size: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    spacing: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    measured_on: Option<WirePath>,
    /// The camera that was asked for, and where it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    camera: Option<[String; 2]>,
}

#[derive(Serialize, Deserialize)]
struct WireDaemon {
    pid: u32,
    host: String,
    started_ms: u64,
    state: WireState,
    at_ms: u64,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum WireState {
    Running,
    Paused(String),
    Stopped,
}

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
pub(super) enum WirePath {
    Text(String),
    Units(Vec<u16>),
}

impl From<EntryRef<'_>> for WireEntry {
    fn from(entry: EntryRef<'_>) -> WireEntry {
        match entry {
            EntryRef::Frame(input, record) => WireEntry::Frame(WireFrame::of(input, record)),
            EntryRef::Sequence(key, record) => WireEntry::Sequence(WireSequence::of(key, record)),
            EntryRef::Daemon(record) => WireEntry::Daemon(WireDaemon::of(record)),
            EntryRef::Plan(record) => WireEntry::Plan(WirePlan::of(record)),
        }
    }
}

impl WireEntry {
    fn into_entry(self) -> Option<Entry> {
        match self {
            WireEntry::Frame(frame) => frame.into_entry(),
            WireEntry::Sequence(sequence) => sequence.into_entry(),
            WireEntry::Daemon(daemon) => Some(daemon.into_entry()),
            WireEntry::Plan(plan) => plan.into_record().map(Entry::Plan),
        }
    }
}

impl WireFrame {
    fn of(input: &Path, record: &FrameRecord) -> WireFrame {
        let output = |output: &OutputRecord| WireOutput {
            path: WirePath::of(&output.path),
            size_bytes: output.size_bytes,
        };
        WireFrame {
            input: WirePath::of(input),
            standing: WireStanding::of(record.standing),
            size_bytes: record.stamp.size,
            modified_ns: record.stamp.modified_ns,
            inode: record.stamp.inode,
            hash: record.hash.map(|hash| format!("{hash:032x}")),
            settings: record.settings.clone(),
            outputs: record.outputs.iter().map(output).collect(),
            reason: record.reason.clone(),
            attempts: record.attempt_count,
            at_ms: record.at_ms,
            particles: record.particle_count,
            seconds: record.seconds,
            flaws: record.flaws.clone(),
        }
    }

    fn into_entry(self) -> Option<Entry> {
        let hash = match self.hash {
            Some(digits) => Some(u128::from_str_radix(&digits, 16).ok()?),
            None => None,
        };
        let output = |output: WireOutput| {
            Some(OutputRecord { path: output.path.into_path()?, size_bytes: output.size_bytes })
        };
        let record = FrameRecord {
            standing: self.standing.into_standing(),
            stamp: FileStamp { size: self.size_bytes, modified_ns: self.modified_ns, inode: self.inode },
            hash,
            settings: self.settings,
            outputs: self.outputs.into_iter().map(output).collect::<Option<_>>()?,
            reason: self.reason,
            attempt_count: self.attempts,
            at_ms: self.at_ms,
            particle_count: self.particles,
            seconds: self.seconds,
            flaws: self.flaws,
        };
        Some(Entry::Frame(self.input.into_path()?, record))
    }
}

impl WireStanding {
    fn of(standing: Standing) -> WireStanding {
        match standing {
            Standing::Queued => WireStanding::Queued,
            Standing::Done => WireStanding::Done,
            Standing::Failed => WireStanding::Failed,
            Standing::Retrying => WireStanding::Retrying,
            Standing::Refused => WireStanding::Refused,
            Standing::GivenUp => WireStanding::GivenUp,
        }
    }

    fn into_standing(self) -> Standing {
        match self {
            WireStanding::Queued => Standing::Queued,
            WireStanding::Done => Standing::Done,
            WireStanding::Failed => Standing::Failed,
            WireStanding::Retrying => Standing::Retrying,
            WireStanding::Refused => Standing::Refused,
            WireStanding::GivenUp => Standing::GivenUp,
        }
    }
}

impl WireSequence {
    fn of(key: &SequenceKey, record: &SequenceRecord) -> WireSequence {
        WireSequence {
            folder: WirePath::of(&key.folder),
            name: key.name.clone(),
            choices: key.choices.clone(),
            voxel_size: record.voxel_size.to_string(),
            spacing: record.spacing.map(|spacing| spacing.to_string()),
            measured_on: record.measured_on.as_deref().map(WirePath::of),
            camera: record.camera.as_ref().map(|camera| [camera.asked.clone(), camera.fixed.to_string()]),
        }
    }

    fn into_entry(self) -> Option<Entry> {
        let key = SequenceKey { folder: self.folder.into_path()?, name: self.name, choices: self.choices };
        let record = SequenceRecord {
            voxel_size: self.voxel_size.parse().ok()?,
            spacing: match self.spacing {
                Some(spacing) => Some(spacing.parse().ok()?),
                None => None,
            },
            measured_on: match self.measured_on {
                Some(path) => Some(path.into_path()?),
                None => None,
            },
            camera: match self.camera {
                Some([asked, fixed]) => Some(SequenceCamera { asked, fixed: fixed.parse().ok()? }),
                None => None,
            },
        };
        Some(Entry::Sequence(key, record))
    }
}

impl WireDaemon {
    fn of(record: &DaemonRecord) -> WireDaemon {
        let state = match &record.state {
            DaemonState::Running => WireState::Running,
            DaemonState::Paused(why) => WireState::Paused(why.clone()),
            DaemonState::Stopped => WireState::Stopped,
        };
        let DaemonRecord { pid, host, started_ms, at_ms, .. } = record;
        WireDaemon { pid: *pid, host: host.clone(), started_ms: *started_ms, state, at_ms: *at_ms }
    }

    fn into_entry(self) -> Entry {
        let state = match self.state {
            WireState::Running => DaemonState::Running,
            WireState::Paused(why) => DaemonState::Paused(why),
            WireState::Stopped => DaemonState::Stopped,
        };
        let WireDaemon { pid, host, started_ms, at_ms, .. } = self;
        Entry::Daemon(DaemonRecord { pid, host, started_ms, state, at_ms })
    }
}

impl WirePath {
    pub(super) fn of(path: &Path) -> WirePath {
        match path.to_str() {
            Some(text) => WirePath::Text(text.to_owned()),
            None => WirePath::Units(units(path)),
        }
    }

    pub(super) fn into_path(self) -> Option<PathBuf> {
        match self {
            WirePath::Text(text) => Some(PathBuf::from(text)),
            WirePath::Units(units) => from_units(&units).map(PathBuf::from),
        }
    }
}

#[cfg(unix)]
fn units(path: &Path) -> Vec<u16> {
    use std::os::unix::ffi::OsStrExt;
    path.as_os_str().as_bytes().iter().copied().map(u16::from).collect()
}

#[cfg(unix)]
fn from_units(units: &[u16]) -> Option<OsString> {
    use std::os::unix::ffi::OsStringExt;
    let bytes = units.iter().map(|&unit| u8::try_from(unit).ok()).collect::<Option<_>>()?;
    Some(OsString::from_vec(bytes))
}

#[cfg(windows)]
fn units(path: &Path) -> Vec<u16> {
    use std::os::windows::ffi::OsStrExt;
    path.as_os_str().encode_wide().collect()
}

#[cfg(windows)]
fn from_units(units: &[u16]) -> Option<OsString> {
    use std::os::windows::ffi::OsStringExt;
    Some(OsString::from_wide(units))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn comes_back(entry: &Entry) {
        let mut line = Vec::new();
        let entry_ref = match entry {
            Entry::Frame(input, record) => EntryRef::Frame(input, record),
            Entry::Sequence(key, record) => EntryRef::Sequence(key, record),
            Entry::Daemon(record) => EntryRef::Daemon(record),
            Entry::Plan(record) => EntryRef::Plan(record),
        };
        push_line(&mut line, entry_ref).expect("a line");
        let end = line.iter().position(|&byte| byte == b'\n').expect("an end");
        assert_eq!(end + 1, line.len(), "one line, and only one");
        assert_eq!(parse_line(&line[..end]).as_ref(), Some(entry));
    }

    fn frame(input: impl Into<PathBuf>, standing: Standing) -> Entry {
        let record = FrameRecord {
            standing,
            stamp: FileStamp { size: u64::MAX, modified_ns: i64::MIN, inode: u64::MAX },
            hash: Some(0x0123_4567_89ab_cdef),
            settings: "h=0.1 \"quoted\"\n⏎".to_owned(),
            outputs: vec![OutputRecord { path: "/out/dam.0001.glb".into(), size_bytes: 1 << 60 }],
            reason: Some("line 3:\tno number\r\n".to_owned()),
            attempt_count: 3,
            at_ms: 1_760_000_000_000,
            particle_count: Some(250_000),
            seconds: Some(0.25),
            flaws: vec!["1 particle left out".to_owned()],
        };
        Entry::Frame(input.into(), record)
    }

    #[test]
    fn frames_come_back() {
        let standings = [
            Standing::Queued,
            Standing::Done,
            Standing::Failed,
            Standing::Retrying,
            Standing::Refused,
            Standing::GivenUp,
        ];
        for standing in standings {
            comes_back(&frame("/sim/dam.0001.bgeo", standing));
        }
        let Entry::Frame(input, record) = frame("a b\n", Standing::Queued) else { unreachable!() };
        let bare = FrameRecord {
            hash: None,
            outputs: Vec::new(),
            reason: None,
            particle_count: None,
            seconds: None,
            flaws: Vec::new(),
            ..record
        };
        comes_back(&Entry::Frame(input, bare));
    }

    #[cfg(unix)]
    #[test]
    fn paths_that_are_no_text_come_back() {
        use std::os::unix::ffi::OsStringExt;
        let path = PathBuf::from(OsString::from_vec((1..=255).collect()));
        let Entry::Frame(_, mut record) = frame("", Standing::Done) else { unreachable!() };
        record.outputs[0].path.clone_from(&path);
        comes_back(&Entry::Frame(path, record));
    }

    #[test]
    fn sequences_come_back_to_the_last_bit() {
        for voxel_size in [0.1, 1.0 / 3.0, 1e-300, f64::MIN_POSITIVE / 3.0, f64::MAX, 2.5e-8_f64.next_up()] {
            let key = SequenceKey {
                folder: "/sim".into(),
                name: "dam.{}.bgeo".to_owned(),
                choices: "fast".to_owned(),
            };
            let record = SequenceRecord {
                voxel_size,
                spacing: Some(voxel_size.next_down()),
                measured_on: Some("/sim/dam.0001.bgeo".into()),
                camera: Some(SequenceCamera {
                    asked: "1280x720 auto".to_owned(),
                    fixed: "eye=0.1:2:3,target=0:0:0,view=30,up=y,ground=none".parse().expect("a camera"),
                }),
            };
            comes_back(&Entry::Sequence(key.clone(), record));
            comes_back(&Entry::Sequence(
                key,
                SequenceRecord { voxel_size, spacing: None, measured_on: None, camera: None },
            ));
        }
    }

    #[test]
    fn the_daemon_comes_back() {
        let states = [
            DaemonState::Running,
            DaemonState::Paused("/out has less than 2 GiB left".to_owned()),
            DaemonState::Stopped,
        ];
        for state in states {
            comes_back(&Entry::Daemon(DaemonRecord {
                pid: 12,
                host: "render-04".to_owned(),
                started_ms: 1,
                state,
                at_ms: 2,
            }));
        }
    }

    #[test]
    fn what_was_never_written_is_no_record() {
        let with_checksum =
            |record: &str| format!("{:016x} {record}", XxHash3_64::oneshot(record.as_bytes()));
        let paused = r#"{"daemon":{"pid":1,"host":"a","started_ms":1,"state":"stopped","at_ms":1}}"#;
        assert!(parse_line(with_checksum(paused).as_bytes()).is_some());
        let wrong = [
            String::new(),
            "0123".to_owned(),
            paused.to_owned(),
            format!("0123456789abcdef {paused}"),
            format!("éééééééé {paused}"),
            with_checksum(paused).replacen(' ', "", 1),
            with_checksum(""),
            with_checksum(r#"{"planet":{}}"#),
            with_checksum(r#"{"frame":{}}"#),
        ];
        for line in wrong {
            assert_eq!(parse_line(line.as_bytes()), None, "{line}");
        }
    }
}
