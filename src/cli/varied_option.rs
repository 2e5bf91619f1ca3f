//! An option that `meniscus tune` varies, with the values to show: `--vary preset=fluid,noisy,splash`.

use std::str::FromStr;

use strsim::jaro;

use crate::surface::options::{Length, LengthUnit, MethodOptions, OptionInfo, Settings, ValueKind};

use super::wording::{option_name, significant};

/// An option and its values.
#[derive(Clone, Debug)]
pub(super) struct VariedOption {
    info: &'static OptionInfo<MethodOptions>,
    /// At least one. The option accepts them.
    pub(super) values: Vec<String>,
}

/// What `tune` varies by itself.
pub(super) const DEFAULT: [&str; 2] = ["position-smoothing=0,0.5,0.7,0.9", "radius-min=0.85d,1d,1.15d,1.45d"];

impl VariedOption {
    /// The name of the option's field.
    pub(super) fn name(&self) -> &'static str {
        self.info.name
    }

    /// The option without the hyphens at its beginning.
    pub(super) fn flag(&self) -> String {
        flag(self.info)
    }

    /// Sets the option to one of the values.
    pub(super) fn put(&self, value: &str, options: &mut MethodOptions) {
        let is_set = options.set(self.info.name, value);
        debug_assert!(is_set.is_ok(), "{} accepted {value} before", self.info.name);
    }

    /// The option and one of the values, for a cell with these settings. Lengths in world units are shown in
    /// particle spacings.
    pub(super) fn label(&self, value: &str, settings: &Settings) -> String {
        let length = (self.info.kind == ValueKind::Length).then(|| value.parse().ok()).flatten();
        let in_world = length.filter(|length: &Length| length.unit == LengthUnit::World);
        let in_spacings = in_world.map(|length| format!("{}d", significant(length.value / settings.spacing)));
        format!("{} {}", self.flag(), in_spacings.as_deref().unwrap_or(value))
    }
}

fn flag(info: &OptionInfo<MethodOptions>) -> String {
    option_name(info.name).trim_start_matches('-').to_owned()
}

/// The minimum similarity of a suggestion, from 0 to 1 (equal).
const LIKENESS_MIN: f64 = 0.8;

impl FromStr for VariedOption {
    type Err = String;

    fn from_str(text: &str) -> Result<VariedOption, String> {
        let Some((name, values)) = text.split_once('=') else {
            return Err("expected an option and its values, such as radius-ratio=1.5,2,3".to_owned());
        };
        let Some(info) = MethodOptions::ALL.iter().find(|info| flag(info) == name) else {
            let likeness = |info: &&OptionInfo<MethodOptions>| jaro(&flag(info), name);
            let nearest =
                MethodOptions::ALL.iter().max_by(|one, other| likeness(one).total_cmp(&likeness(other)));
            let nearest = nearest.filter(|info| likeness(info) >= LIKENESS_MIN);
            let hint = nearest.map_or(String::new(), |info| format!(": did you mean {}?", flag(info)));
            return Err(format!("there is no option --{name} to vary{hint}"));
        };
        let separator = if values.contains(';') { ';' } else { ',' };
        let values: Vec<String> = values.split(separator).map(|value| value.trim().to_owned()).collect();
        for value in &values {
            info.check(value).map_err(|why| format!("{name}: {why}"))?;
        }
        Ok(VariedOption { info, values })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_option_is_varied_by_its_own_name() {
        for info in MethodOptions::ALL {
            let texts = ["1", "0.5", "true", "0,0,0,1,1,1;0,0,0,2,2,2"];
            let word = info.words.first().map(|word| word.name);
            let parsed = |value| format!("{}={value}", flag(info)).parse::<VariedOption>();
            let varied = word.into_iter().chain(texts).map(parsed).find_map(Result::ok);
            let varied = varied.unwrap_or_else(|| panic!("{} takes no value", info.name));
            let mut options = MethodOptions::default();
            varied.put(&varied.values[0], &mut options);
            assert_eq!(options.to_pairs(), [(info.name, varied.values[0].clone())]);
        }
        for text in DEFAULT {
            assert_eq!(text.parse::<VariedOption>().map(|varied| varied.values.len()), Ok(4));
        }
    }

    #[test]
    fn lengths_are_shown_in_particle_spacings() {
        // h = 0.1 and d = 0.2.
        let settings = Settings::paper(0.1, &MethodOptions::default()).expect("sound");
        let varied: VariedOption = "offset=-0.05, 0.3d,1h".parse().expect("lengths");
        let labels = varied.values.iter().map(|value| varied.label(value, &settings));
        assert_eq!(labels.collect::<Vec<_>>(), ["offset -0.25d", "offset 0.3d", "offset 1h"]);
        let varied: VariedOption = "preset=fluid,noisy".parse().expect("presets");
        assert_eq!(varied.label(&varied.values[1], &settings), "preset noisy");
    }

    #[test]
    fn errors_name_the_option_and_the_expected_values() {
        for (text, expected) in [
            ("", "such as radius-ratio=1.5,2,3"),
            ("2,3", "such as radius-ratio=1.5,2,3"),
            ("q=2", "there is no option --q to vary"),
            ("voxel_size=1", "there is no option --voxel_size to vary: did you mean voxel-size?"),
            ("radius-ratio=", "radius-ratio: `` is not a number"),
            ("steps=1,2.5", "steps: `2.5` is not a whole number"),
            ("voxel-size=2h", "voxel-size: `2h` is not a voxel size"),
            ("preset=water,sea", "preset: `sea` is unknown: expected one of fluid"),
            ("clip=0,0,0,1,1,1", "clip: `0` is not a box"),
        ] {
            let error = text.parse::<VariedOption>().expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
