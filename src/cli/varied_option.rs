//! An option that `meniscus tune` varies, with the values to show: `--vary preset=fluid,noisy,splash`.

use std::str::FromStr;

use crate::surface::options::{MethodOptions, OptionInfo};

use super::wording::option_name;

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
}

fn flag(info: &OptionInfo<MethodOptions>) -> String {
    option_name(info.name).trim_start_matches('-').to_owned()
}

impl FromStr for VariedOption {
    type Err = String;

    fn from_str(text: &str) -> Result<VariedOption, String> {
        let Some((name, values)) = text.split_once('=') else {
            return Err("expected an option and its values, such as radius-ratio=1.5,2,3".to_owned());
        };
        let info = MethodOptions::ALL.iter().find(|info| flag(info) == name);
        let info = info.ok_or_else(|| format!("there is no option --{name} to vary"))?;
        let values: Vec<String> = values.split(',').map(|value| value.trim().to_owned()).collect();
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
    fn option_is_varied_by_its_own_name() {
        let varied: VariedOption = "radius-min=0.85d, 1d".parse().expect("lengths");
        let mut options = MethodOptions::default();
        varied.put(&varied.values[1], &mut options);
        assert_eq!(options.to_pairs(), [("radius_min", "1d".to_owned())]);
        for text in DEFAULT {
            assert_eq!(text.parse::<VariedOption>().map(|varied| varied.values.len()), Ok(4));
        }
    }

    #[test]
    fn errors_name_the_option_and_the_expected_values() {
        for (text, expected) in [
            ("", "such as radius-ratio=1.5,2,3"),
            ("2,3", "such as radius-ratio=1.5,2,3"),
            ("q=2", "there is no option --q to vary"),
            ("voxel_size=1", "there is no option --voxel_size to vary"),
            ("radius-ratio=", "radius-ratio: `` is not a number"),
            ("steps=1,2.5", "steps: `2.5` is not a whole number"),
            ("voxel-size=2h", "voxel-size: `2h` is not a voxel size"),
            ("preset=fluid,sea", "preset: `sea` is unknown: expected one of fluid"),
            ("clip=0,0,0,1,1,1", "clip: `0` is not a box"),
        ] {
            let error = text.parse::<VariedOption>().expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
