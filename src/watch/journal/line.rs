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

use std::io;
use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};
use twox_hash::XxHash3_64;

use crate::pipeline::MeasuredSpacing;
use crate::pipeline::{FileStamp, Framed, OutputState};

use super::path::WirePath;
use super::plan::WirePlan;
use super::state::{
    DaemonRecord, DaemonState, Entry, FrameRecord, OutputRecord, SequenceCamera, SequenceKey, SequenceRecord,
    Standing,
};

/// Digits of a checksum.
const CHECKSUM_DIGITS: usize = 16;

/// Adds the line of a record to `out`.
///
/// # Errors
/// When the record has no form in JSON; `out` is as it was then.
pub(super) fn push_line(out: &mut Vec<u8>, entry: &Entry) -> io::Result<()> {
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
    changed_ns: Option<i64>,
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
    /// As `/api/frames/NAME` has them: that form is promised, too. For people; what cannot be read is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    figures: Option<serde_json::Value>,
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
    #[serde(flatten, default, skip_serializing_if = "Option::is_none")]
    state: Option<WireOutputState>,
}

#[derive(Serialize, Deserialize)]
struct WireOutputState {
    modified_ns: i64,
    inode: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    changed_ns: Option<i64>,
    hash: String,
}

#[derive(Serialize, Deserialize)]
struct WireSequence {
    folder: WirePath,
    name: String,
    choices: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    spacing: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    confidence: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    radius_median: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    measured_on: Option<WirePath>,
    /// The camera that was asked for, and where it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    camera: Option<[String; 2]>,
    /// What the camera is placed around, six numbers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    camera_around: Vec<String>,
    /// The cameras before it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    earlier_cameras: Vec<String>,
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

impl From<&Entry> for WireEntry {
    fn from(entry: &Entry) -> WireEntry {
        match entry {
            Entry::Frame(input, record) => WireEntry::Frame(WireFrame::of(input, record)),
            Entry::Sequence(key, record) => WireEntry::Sequence(WireSequence::of(key, record)),
            Entry::Daemon(record) => WireEntry::Daemon(WireDaemon::of(record)),
            Entry::Plan(record) => WireEntry::Plan(WirePlan::of(record)),
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
        let state = |OutputState { stamp, hash }: OutputState| WireOutputState {
            modified_ns: stamp.modified_ns,
            inode: stamp.inode,
            changed_ns: stamp.changed_ns,
            hash: format!("{hash:032x}"),
        };
        let output = |output: &OutputRecord| WireOutput {
            path: WirePath::of(&output.path),
            size_bytes: output.size_bytes,
            state: output.state.map(state),
        };
        WireFrame {
            input: WirePath::of(input),
            standing: WireStanding::of(record.standing),
            size_bytes: record.stamp.size,
            modified_ns: record.stamp.modified_ns,
            inode: record.stamp.inode,
            changed_ns: record.stamp.changed_ns,
            hash: record.hash.map(|hash| format!("{hash:032x}")),
            settings: record.settings.clone(),
            outputs: record.outputs.iter().map(output).collect(),
            reason: record.reason.clone(),
            attempts: record.attempt_count,
            at_ms: record.at_ms,
            particles: record.particle_count,
            seconds: record.seconds,
            flaws: record.flaws.clone(),
            figures: record.figures.as_ref().and_then(|figures| serde_json::to_value(&**figures).ok()),
        }
    }

    fn into_entry(self) -> Option<Entry> {
        let hash = match self.hash {
            Some(digits) => Some(u128::from_str_radix(&digits, 16).ok()?),
            None => None,
        };
        let output = |WireOutput { path, size_bytes, state }: WireOutput| {
            let state = match state {
                Some(WireOutputState { modified_ns, inode, changed_ns, hash }) => Some(OutputState {
                    stamp: FileStamp { size: size_bytes, modified_ns, inode, changed_ns },
                    hash: u128::from_str_radix(&hash, 16).ok()?,
                }),
                None => None,
            };
            Some(OutputRecord { path: path.into_path()?, size_bytes, state })
        };
        let record = FrameRecord {
            standing: self.standing.into_standing(),
            stamp: FileStamp {
                size: self.size_bytes,
                modified_ns: self.modified_ns,
                inode: self.inode,
                changed_ns: self.changed_ns,
            },
            hash,
            settings: self.settings,
            outputs: self.outputs.into_iter().map(output).collect::<Option<_>>()?,
            reason: self.reason,
            attempt_count: self.attempts,
            at_ms: self.at_ms,
            particle_count: self.particles,
            seconds: self.seconds,
            flaws: self.flaws,
            figures: self.figures.and_then(|figures| serde_json::from_value(figures).ok()).map(Arc::new),
        };
        Some(Entry::Frame(self.input.into_path()?.into(), Arc::new(record)))
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
        let (measured, framed) = (record.measured.as_ref(), record.camera.as_ref());
        let around = framed.and_then(|camera| camera.framed.around);
        let around = around.map(|[least, greatest]| [least.to_array(), greatest.to_array()].concat());
        let earlier = framed.into_iter().flat_map(|camera| &camera.framed.earlier);
        WireSequence {
            folder: WirePath::of(&key.folder),
            name: key.name.clone(),
            choices: key.choices.clone(),
            spacing: measured.map(|measured| measured.spacing.to_string()),
            confidence: measured.map(|measured| measured.confidence),
            radius_median: measured
                .and_then(|measured| measured.radius_median)
                .map(|radius| radius.to_string()),
            measured_on: measured.map(|measured| WirePath::of(&measured.measured_on)),
            camera: framed.map(|camera| [camera.asked.clone(), camera.framed.camera.to_string()]),
            camera_around: around.into_iter().flatten().map(|number| number.to_string()).collect(),
            earlier_cameras: earlier.map(|camera| camera.to_string()).collect(),
        }
    }

    fn into_entry(self) -> Option<Entry> {
        let key = SequenceKey { folder: self.folder.into_path()?, name: self.name, choices: self.choices };
        let record = SequenceRecord {
            measured: match (self.spacing, self.measured_on) {
                (Some(spacing), Some(path)) => {
                    let radius_median = match self.radius_median {
                        Some(radius) => Some(radius.parse().ok()?),
                        None => None,
                    };
                    Some(MeasuredSpacing {
                        spacing: spacing.parse().ok()?,
                        confidence: self.confidence?,
                        radius_median,
                        measured_on: path.into_path()?,
                        warnings: Vec::new(),
                    })
                }
                _ => None,
            },
            camera: match self.camera {
                Some([asked, camera]) => {
                    let cameras = self.earlier_cameras.iter().map(|camera| camera.parse().ok());
                    let earlier = cameras.collect::<Option<_>>()?;
                    let numbers = self.camera_around.iter().map(|number| number.parse().ok());
                    let around = match numbers.collect::<Option<Vec<f64>>>()?[..] {
                        [] => None,
                        [x, y, z, to_x, to_y, to_z] => {
                            Some([DVec3::new(x, y, z), DVec3::new(to_x, to_y, to_z)])
                        }
                        _ => return None,
                    };
                    let framed = Framed { camera: camera.parse().ok()?, around, earlier };
                    Some(SequenceCamera { asked, framed })
                }
                None => None,
            },
        };
        Some(Entry::Sequence(key, Box::new(record)))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::watch::board::Figures;
    use std::path::PathBuf;

    #[track_caller]
    fn comes_back(entry: &Entry) {
        let mut line = Vec::new();
        push_line(&mut line, entry).expect("a line");
        let end = line.iter().position(|&byte| byte == b'\n').expect("an end");
        assert_eq!(end + 1, line.len(), "one line, and only one");
        assert_eq!(parse_line(&line[..end]).as_ref(), Some(entry));
    }

    fn frame(input: impl Into<PathBuf>, standing: Standing) -> Entry {
        let record = FrameRecord {
            standing,
            stamp: FileStamp {
                size: u64::MAX,
                modified_ns: i64::MIN,
                inode: u64::MAX,
                changed_ns: Some(i64::MAX),
            },
            hash: Some(0x0123_4567_89ab_cdef),
            settings: "h=0.1 \"quoted\"\n⏎".to_owned(),
            outputs: vec![
                OutputRecord { path: "/out/dam.0001.glb".into(), size_bytes: 1 << 60, state: None },
                OutputRecord {
                    path: "/out/dam.0001.vdb".into(),
                    size_bytes: 7,
                    state: Some(OutputState {
                        stamp: FileStamp {
                            size: 7,
                            modified_ns: i64::MIN,
                            inode: u64::MAX,
                            changed_ns: Some(-1),
                        },
                        hash: u128::MAX,
                    }),
                },
            ],
            reason: Some("line 3:\tno number\r\n".to_owned()),
            attempt_count: 3,
            at_ms: 1_760_000_000_000,
            particle_count: Some(250_000),
            seconds: Some(0.25),
            flaws: vec!["1 particle left out".to_owned()],
            figures: Some(Arc::new(Figures { particles: 250_000, vertices: 3, ..Figures::default() })),
        };
        Entry::Frame(input.into().into(), Arc::new(record))
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
            figures: None,
            ..(*record).clone()
        };
        comes_back(&Entry::Frame(input, Arc::new(bare)));
    }

    #[test]
    fn frame_of_an_older_journal_is_read_without_what_is_new() {
        let record = r#"{"frame":{"input":"/in/a.ply","standing":"done","size_bytes":5,"modified_ns":6,"inode":7,"hash":"00000000000000000000000000000008","settings":"s","outputs":[{"path":"/out/a.glb","size_bytes":9}],"attempts":0,"at_ms":1}}"#;
        let line = format!("{:016x} {record}", XxHash3_64::oneshot(record.as_bytes()));
        let Some(Entry::Frame(_, record)) = parse_line(line.as_bytes()) else { panic!("not a frame") };
        assert_eq!(record.stamp, FileStamp { size: 5, modified_ns: 6, inode: 7, changed_ns: None });
        assert_eq!(record.outputs, [OutputRecord { path: "/out/a.glb".into(), size_bytes: 9, state: None }]);
    }

    #[cfg(unix)]
    #[test]
    fn paths_that_are_no_text_come_back() {
        use std::os::unix::ffi::OsStringExt;
        let path = PathBuf::from(std::ffi::OsString::from_vec((1..=255).collect()));
        let Entry::Frame(_, record) = frame("", Standing::Done) else { unreachable!() };
        let mut record = (*record).clone();
        record.outputs[0].path.clone_from(&path);
        comes_back(&Entry::Frame(path.into(), Arc::new(record)));
    }

    #[test]
    fn sequences_come_back_to_the_last_bit() {
        for spacing in [0.1, 1.0 / 3.0, 1e-300, f64::MIN_POSITIVE / 3.0, f64::MAX, 2.5e-8_f64.next_up()] {
            let key = SequenceKey {
                folder: "/sim".into(),
                name: "dam.{}.bgeo".to_owned(),
                choices: "fast".to_owned(),
            };
            let record = SequenceRecord {
                measured: Some(MeasuredSpacing {
                    spacing,
                    confidence: 0.1,
                    radius_median: Some(spacing.next_down()),
                    measured_on: "/sim/dam.0001.bgeo".into(),
                    warnings: Vec::new(),
                }),
                camera: Some(SequenceCamera {
                    asked: "1280x720 auto".to_owned(),
                    framed: Framed {
                        camera: "eye=0.1:2:3,target=0:0:0,view=30,up=y,ground=none"
                            .parse()
                            .expect("a camera"),
                        around: Some([DVec3::splat(-spacing), DVec3::new(0.1, 1.0 / 3.0, 1e9)]),
                        earlier: vec!["eye=1:2:3,target=0:0:0".parse().expect("a camera")],
                    },
                }),
            };
            comes_back(&Entry::Sequence(key.clone(), Box::new(record)));
            comes_back(&Entry::Sequence(key, Box::default()));
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
