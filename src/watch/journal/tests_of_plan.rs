//! Tests that a plan survives the round trip through its line.

use std::time::Duration;

use meniscus_formats::UpAxis;
use meniscus_formats::vdb::Compression;

use super::line::{parse_line, push_line};
use super::state::{Entry, PlanRecord};
use crate::pipeline::{OutputFormat, OutputOptions, PictureOptions, StageOptions};
use crate::surface::options::MethodOptions;
use crate::watch::config::{StabilityTimeouts, Watch};

#[track_caller]
fn comes_back(watch: Watch) {
    let timeouts = StabilityTimeouts {
        settle: Duration::ZERO,
        unverifiable: Duration::from_nanos(2_000_000_001),
        stalled: Duration::MAX,
    };
    let plan = PlanRecord { watches: vec![watch], timeouts };
    let mut line = Vec::new();
    push_line(&mut line, &Entry::Plan(plan.clone())).expect("a line");
    assert_eq!(parse_line(line.strip_suffix(b"\n").expect("an end")), Some(Entry::Plan(plan)));
}

fn bare() -> Watch {
    Watch {
        input: "/sim".into(),
        pattern: None,
        recursive: false,
        sentinel: None,
        outputs: OutputOptions {
            folder: "/out".into(),
            formats: Vec::new(),
            up: UpAxis::Y,
            meters_per_unit: 1.0,
            vdb_half: false,
            vdb_compression: Compression::None,
            picture: PictureOptions::default(),
            stage: None,
        },
        choices: MethodOptions::default(),
        obstacles: Vec::new(),
    }
}

#[test]
fn plan_survives_a_round_trip_bit_for_bit() {
    comes_back(bare());
    comes_back(Watch {
        pattern: Some("*/dam.\"é\".*\n".to_owned()),
        recursive: true,
        sentinel: Some("{stem}.ok".to_owned()),
        outputs: OutputOptions {
            formats: OutputFormat::ALL.to_vec(),
            up: UpAxis::Z,
            meters_per_unit: 0.01_f64.next_up(),
            vdb_half: true,
            stage: Some(StageOptions { path: "/s\u{e9} 1.usda".into(), fps: 1.0 / 3.0 }),
            ..bare().outputs
        },
        choices: MethodOptions {
            voxel_size: Some(0.1_f64.next_up().into()),
            radius_min: Some((1.0 / 3.0).into()),
            radius_init: Some((f64::MIN_POSITIVE / 3.0).into()),
            radius_attribute: Some("p \"é\"".to_owned()),
            offset: Some("-0.3d".parse().expect("a length")),
            neighbor_radius: Some("5h".parse().expect("a length")),
            steps: Some(u32::MAX),
            ..MethodOptions::default()
        },
        obstacles: vec!["/sim/floor é.obj".into(), "/sim/body.####.glb".into()],
        ..bare()
    });
}

#[test]
fn every_option_value_survives_a_round_trip() {
    for vdb_compression in [Compression::None, Compression::ActiveMask, Compression::Blosc] {
        comes_back(Watch { outputs: OutputOptions { vdb_compression, ..bare().outputs }, ..bare() });
    }
    for format in OutputFormat::ALL {
        comes_back(Watch { outputs: OutputOptions { formats: vec![format], ..bare().outputs }, ..bare() });
    }
}

#[test]
fn plan_with_a_number_that_is_invalid_is_not_read() {
    let voxel_size = Some(0.1.into());
    let watch = Watch { choices: MethodOptions { voxel_size, ..MethodOptions::default() }, ..bare() };
    let timeouts =
        StabilityTimeouts { settle: Duration::ZERO, unverifiable: Duration::ZERO, stalled: Duration::ZERO };
    let plan = Entry::Plan(PlanRecord { watches: vec![watch], timeouts });
    let text = serde_json::to_string(&plan).expect("written");
    assert_eq!(serde_json::from_str::<Entry>(&text).expect("read"), plan);
    let wrong = text.replace(r#""voxel_size":"0.1""#, r#""voxel_size":"wide""#);
    assert!(wrong != text && serde_json::from_str::<Entry>(&wrong).is_err());
}

#[test]
fn plan_of_an_older_journal_is_read() {
    let old = r#"{"plan":{"watches":[{"input":"/sim","recursive":false,"outputs":{"folder":"/out","formats":[],"up":"y","vdb_half":false,"vdb_compression":"active_mask"},"choices":{}}],"settle":{"secs":0,"nanos":0},"unproven":{"secs":0,"nanos":0},"stalled":{"secs":0,"nanos":0}}}"#;
    let Ok(Entry::Plan(plan)) = serde_json::from_str(old) else { panic!("not a plan") };
    let outputs = OutputOptions { vdb_compression: Compression::ActiveMask, ..bare().outputs };
    assert_eq!(plan.watches, [Watch { outputs, ..bare() }]);
}
