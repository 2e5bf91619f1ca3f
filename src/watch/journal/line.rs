//! The lines of the journal: see [`checked_line`](crate::pipeline::files::checked_line).

use serde_json::Value;

use crate::pipeline::files::checked_line::record_of_line;

use super::state::Entry;

/// Parses a line without its line break; `None` if the checksum does not match.
pub(super) fn parse_line(line: &[u8]) -> Option<Entry> {
    let record = record_of_line(line)?;
    serde_json::from_slice(record).or_else(|_| without_figures(record)).ok()
}

/// The record without the figures of its frame. Figures are only informative, so a record is also read if its
/// figures are those of another version of this program.
fn without_figures(record: &[u8]) -> serde_json::Result<Entry> {
    let mut record: Value = serde_json::from_slice(record)?;
    if let Some(frame) = record.get_mut("frame").and_then(Value::as_object_mut) {
        frame.remove("figures");
    }
    serde_json::from_value(record)
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;
    use std::sync::Arc;

    use glam::DVec3;

    use super::super::state::{
        DaemonRecord, DaemonState, JournaledFrame, JournaledSequence, JournaledStatus, OutputRecord,
        SequenceCamera, SequenceKey,
    };
    use super::*;
    use twox_hash::XxHash3_64;

    use crate::pipeline::files::checked_line::push_line;
    use crate::pipeline::{FileStamp, Framed, MeasuredSpacing};
    use crate::watch::Reason;
    use crate::watch::status_store::Figures;

    #[track_caller]
    fn comes_back(entry: &Entry) {
        let mut line = Vec::new();
        push_line(&mut line, entry).expect("a line");
        let end = line.iter().position(|&byte| byte == b'\n').expect("an end");
        assert_eq!(end + 1, line.len(), "one line, and only one");
        assert_eq!(parse_line(&line[..end]).as_ref(), Some(entry));
    }

    fn frame(input: impl Into<PathBuf>, status: JournaledStatus) -> Entry {
        let record = JournaledFrame {
            status,
            stamp: FileStamp {
                size: u64::MAX,
                modified_ns: i64::MIN,
                inode: u64::MAX,
                changed_ns: Some(i64::MAX),
            },
            hash: Some(0x0123_4567_89ab_cdef),
            settings: "h=0.1 \"quoted\"\n⏎".to_owned(),
            outputs: vec![
                OutputRecord::of_size("/out/dam.0001.glb".into(), 1 << 60),
                OutputRecord {
                    path: "/out/dam.0001.vdb".into(),
                    stamp: FileStamp {
                        size: 7,
                        modified_ns: i64::MIN,
                        inode: u64::MAX,
                        changed_ns: Some(-1),
                    },
                    hash: Some(u128::MAX),
                },
            ],
            reason: Some(Reason::Error("line 3:\tno number\r\n".to_owned())),
            attempt_count: 3,
            at_ms: 1_760_000_000_000,
            particle_count: Some(250_000),
            seconds: Some(0.25),
            flaws: vec!["1 particle left out".to_owned()],
            figures: Some(Arc::new(Figures { particles: Some(250_000), vertices: 3, ..Figures::default() })),
        };
        Entry::Frame { input: input.into().into(), record: Arc::new(record) }
    }

    #[test]
    fn frame_records_survive_a_round_trip() {
        let statuses = [
            JournaledStatus::Queued,
            JournaledStatus::Done,
            JournaledStatus::Failed,
            JournaledStatus::Retrying,
            JournaledStatus::Refused,
            JournaledStatus::RetriesExhausted,
            JournaledStatus::Waiting,
            JournaledStatus::Ignored,
        ];
        for status in statuses {
            comes_back(&frame("/sim/dam.0001.bgeo", status));
        }
        let Entry::Frame { input, record } = frame("a b\n", JournaledStatus::Queued) else { unreachable!() };
        let bare = JournaledFrame {
            hash: None,
            outputs: Vec::new(),
            reason: None,
            particle_count: None,
            seconds: None,
            flaws: Vec::new(),
            figures: None,
            ..(*record).clone()
        };
        comes_back(&Entry::Frame { input: Arc::clone(&input), record: Arc::new(bare.clone()) });
        for reason in [
            Reason::Changing,
            Reason::Incomplete { expected: u64::MAX, found: 0 },
            Reason::OutputChanged { output: "/out/a b\n.glb".into() },
            Reason::Steps(7),
        ] {
            let record = JournaledFrame { reason: Some(reason), ..bare.clone() };
            comes_back(&Entry::Frame { input: Arc::clone(&input), record: Arc::new(record) });
        }
    }

    #[test]
    fn frame_record_without_newer_fields_is_read() {
        let record = r#"{"frame":{"input":"/in/a.ply","standing":"done","size_bytes":5,"modified_ns":6,"inode":7,"hash":"00000000000000000000000000000008","settings":"s","outputs":[{"path":"/out/a.glb","size_bytes":9}],"attempts":0,"at_ms":1}}"#;
        let line = format!("{:016x} {record}", XxHash3_64::oneshot(record.as_bytes()));
        let Some(Entry::Frame { record, .. }) = parse_line(line.as_bytes()) else { panic!("not a frame") };
        assert_eq!(record.stamp, FileStamp { size: 5, modified_ns: 6, inode: 7, changed_ns: None });
        assert_eq!(record.outputs, [OutputRecord::of_size("/out/a.glb".into(), 9)]);
    }

    #[test]
    fn figures_of_another_version_are_dropped() {
        let Entry::Frame { input, record } = frame("/in/a.ply", JournaledStatus::Done) else {
            unreachable!()
        };
        let mut line = Vec::new();
        push_line(&mut line, &Entry::Frame { input, record: Arc::clone(&record) }).expect("a line");
        let text = String::from_utf8(line).expect("text").trim_end()[17..].to_owned();
        let text = text.replace("\"vertices\":3", "\"vertices\":\"three\"");
        let line = format!("{:016x} {text}", XxHash3_64::oneshot(text.as_bytes()));
        let Some(Entry::Frame { record: read, .. }) = parse_line(line.as_bytes()) else {
            panic!("not a frame")
        };
        assert_eq!(*read, JournaledFrame { figures: None, ..(*record).clone() });
    }

    #[cfg(unix)]
    #[test]
    fn paths_that_are_not_utf8_survive_a_round_trip() {
        use std::os::unix::ffi::OsStringExt;
        let path = PathBuf::from(std::ffi::OsString::from_vec((1..=255).collect()));
        let Entry::Frame { record, .. } = frame("", JournaledStatus::Done) else { unreachable!() };
        let mut record = (*record).clone();
        record.outputs[0].path.clone_from(&path);
        comes_back(&Entry::Frame { input: path.into(), record: Arc::new(record) });
    }

    #[test]
    fn sequence_records_survive_a_round_trip_bit_for_bit() {
        for spacing in [0.1, 1.0 / 3.0, 1e-300, f64::MIN_POSITIVE / 3.0, f64::MAX, 2.5e-8_f64.next_up()] {
            let key = SequenceKey {
                folder: "/sim".into(),
                name: "dam.{}.bgeo".to_owned(),
                choices: "fast".to_owned(),
            };
            let record = JournaledSequence {
                measured: Some(MeasuredSpacing {
                    spacing,
                    confidence: 0.1,
                    radius_median: Some(spacing.next_down()),
                    measured_on: "/sim/dam.0001.bgeo".into(),
                    measured_count: 0,
                    warnings: Vec::new(),
                }),
                camera: Some(SequenceCamera {
                    requested: "1280x720 auto".to_owned(),
                    framed: Framed {
                        camera: "eye=0.1:2:3,target=0:0:0,view=30,up=y,ground=none"
                            .parse()
                            .expect("a camera"),
                        around: Some([DVec3::splat(-spacing), DVec3::new(0.1, 1.0 / 3.0, 1e9)]),
                        earlier: vec!["eye=1:2:3,target=0:0:0".parse().expect("a camera")],
                    },
                }),
            };
            comes_back(&Entry::Sequence { key: key.clone(), record: Box::new(record) });
            comes_back(&Entry::Sequence { key, record: Box::default() });
        }
    }

    #[test]
    fn daemon_records_survive_a_round_trip() {
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
    fn line_with_a_wrong_checksum_or_content_is_not_a_record() {
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
