//! What a daemon was asked for, in its line.
//!
//! As in all lines, names and structs are their own, and numbers that results depend on are text: what
//! `why` compares must be the settings to the last bit.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use meniscus_formats::gltf::UpAxis;
use meniscus_formats::vdb::Compression;

use crate::pipeline::{OutputFormat, OutputOptions, PictureOptions};
use crate::surface::options::MethodOptions;
use crate::watch::config::{Patience, Watch};

use super::path::WirePath;
use super::state::PlanRecord;

#[derive(Serialize, Deserialize)]
pub(super) struct WirePlan {
    watches: Vec<WireWatch>,
    settle: Duration,
    unproven: Duration,
    stalled: Duration,
}

#[derive(Serialize, Deserialize)]
struct WireWatch {
    input: WirePath,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pattern: Option<String>,
    recursive: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sentinel: Option<String>,
    outputs: WireOutputs,
    /// By name, as text: see [`MethodOptions::to_pairs`].
    choices: BTreeMap<String, String>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    obstacles: Vec<WirePath>,
}

#[derive(Serialize, Deserialize)]
struct WireOutputs {
    folder: WirePath,
    formats: Vec<OutputFormat>,
    up: WireUp,
    /// As text; missing for metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    meters_per_unit: Option<String>,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    quantize: bool,
    vdb_half: bool,
    vdb_compression: WireCompression,
    /// How pictures are taken, if any are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    picture: Option<WirePicture>,
}

#[derive(Serialize, Deserialize)]
struct WirePicture {
    size: [usize; 2],
    camera: String,
}

/// The lines' own form of an enum, and the ways there and back.
macro_rules! wire_enum {
    ($wire:ident of $kind:ident: $($variant:ident),+) => {
        #[derive(Clone, Copy, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        enum $wire {
            $($variant),+
        }

        impl From<$kind> for $wire {
            fn from(value: $kind) -> $wire {
                match value {
                    $($kind::$variant => $wire::$variant),+
                }
            }
        }

        impl From<$wire> for $kind {
            fn from(value: $wire) -> $kind {
                match value {
                    $($wire::$variant => $kind::$variant),+
                }
            }
        }
    };
}

wire_enum!(WireUp of UpAxis: Y, Z);
wire_enum!(WireCompression of Compression: None, ActiveMask, Blosc);

impl WirePlan {
    pub(super) fn of(record: &PlanRecord) -> WirePlan {
        let Patience { settle, unproven, stalled } = record.patience;
        WirePlan { watches: record.watches.iter().map(WireWatch::of).collect(), settle, unproven, stalled }
    }

    pub(super) fn into_record(self) -> Option<PlanRecord> {
        let WirePlan { watches, settle, unproven, stalled } = self;
        let watches = watches.into_iter().map(WireWatch::into_watch).collect::<Option<_>>()?;
        Some(PlanRecord { watches, patience: Patience { settle, unproven, stalled } })
    }
}

impl WireWatch {
    fn of(watch: &Watch) -> WireWatch {
        let Watch { input, pattern, recursive, sentinel, outputs, choices, obstacles } = watch;
        WireWatch {
            input: WirePath::of(input),
            pattern: pattern.clone(),
            recursive: *recursive,
            sentinel: sentinel.clone(),
            outputs: WireOutputs::of(outputs),
            choices: choices.to_pairs().into_iter().map(|(name, value)| (name.to_owned(), value)).collect(),
            obstacles: obstacles.iter().map(|path| WirePath::of(path)).collect(),
        }
    }

    fn into_watch(self) -> Option<Watch> {
        Some(Watch {
            input: self.input.into_path()?,
            pattern: self.pattern,
            recursive: self.recursive,
            sentinel: self.sentinel,
            outputs: self.outputs.into_options()?,
            choices: MethodOptions::from_pairs(
                self.choices.iter().map(|(name, value)| (name.as_str(), value.as_str())),
            )?,
            obstacles: self.obstacles.into_iter().map(WirePath::into_path).collect::<Option<_>>()?,
        })
    }
}

impl WireOutputs {
    fn of(options: &OutputOptions) -> WireOutputs {
        let OutputOptions {
            folder,
            formats,
            up,
            meters_per_unit,
            quantize,
            vdb_half,
            vdb_compression,
            picture,
        } = options;
        let has_picture = formats.iter().any(|format| format.is_picture());
        WireOutputs {
            folder: WirePath::of(folder),
            formats: formats.clone(),
            up: (*up).into(),
            meters_per_unit: text(Some(*meters_per_unit).filter(|meters| *meters != 1.0)),
            quantize: *quantize,
            vdb_half: *vdb_half,
            vdb_compression: (*vdb_compression).into(),
            picture: has_picture
                .then(|| WirePicture { size: picture.size, camera: picture.camera.to_string() }),
        }
    }

    fn into_options(self) -> Option<OutputOptions> {
        Some(OutputOptions {
            folder: self.folder.into_path()?,
            formats: self.formats,
            up: self.up.into(),
            meters_per_unit: number(self.meters_per_unit)?.unwrap_or(1.0),
            quantize: self.quantize,
            vdb_half: self.vdb_half,
            vdb_compression: self.vdb_compression.into(),
            picture: match self.picture {
                Some(WirePicture { size, camera }) => PictureOptions { size, camera: camera.parse().ok()? },
                None => PictureOptions::default(),
            },
        })
    }
}

/// The shortest text that reads back as this number.
fn text(number: Option<f64>) -> Option<String> {
    number.map(|number| number.to_string())
}

/// The number of a text; `None` where it is none.
fn number(text: Option<String>) -> Option<Option<f64>> {
    text.map(|text| text.parse()).transpose().ok()
}

#[cfg(test)]
mod tests {
    use super::super::line::{parse_line, push_line};
    use super::super::state::Entry;
    use super::*;

    #[track_caller]
    fn comes_back(watch: Watch) {
        let patience = Patience {
            settle: Duration::ZERO,
            unproven: Duration::from_nanos(2_000_000_001),
            stalled: Duration::MAX,
        };
        let plan = PlanRecord { watches: vec![watch], patience };
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
                quantize: false,
                vdb_half: false,
                vdb_compression: Compression::None,
                picture: PictureOptions::default(),
            },
            choices: MethodOptions::default(),
            obstacles: Vec::new(),
        }
    }

    #[test]
    fn plans_come_back_to_the_last_bit() {
        comes_back(bare());
        comes_back(Watch {
            pattern: Some("*/dam.\"é\".*\n".to_owned()),
            recursive: true,
            sentinel: Some("{stem}.ok".to_owned()),
            outputs: OutputOptions {
                formats: OutputFormat::ALL.to_vec(),
                up: UpAxis::Z,
                meters_per_unit: 0.01_f64.next_up(),
                quantize: true,
                vdb_half: true,
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
    fn every_choice_among_several_comes_back() {
        for vdb_compression in [Compression::None, Compression::ActiveMask, Compression::Blosc] {
            comes_back(Watch { outputs: OutputOptions { vdb_compression, ..bare().outputs }, ..bare() });
        }
        for format in OutputFormat::ALL {
            comes_back(Watch {
                outputs: OutputOptions { formats: vec![format], ..bare().outputs },
                ..bare()
            });
        }
    }

    #[test]
    fn a_number_that_is_none_makes_no_plan() {
        let plan = PlanRecord {
            watches: vec![Watch {
                choices: MethodOptions { voxel_size: Some(0.1.into()), ..MethodOptions::default() },
                ..bare()
            }],
            patience: Patience { settle: Duration::ZERO, unproven: Duration::ZERO, stalled: Duration::ZERO },
        };
        let mut wire = WirePlan::of(&plan);
        wire.watches[0].choices.insert("voxel_size".to_owned(), "wide".to_owned());
        assert_eq!(wire.into_record(), None);
    }
}
