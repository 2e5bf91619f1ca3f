//! The parameter sweep of `meniscus tune`: `ratio=1.5,2,3,time,h=0.5x,1x`.
//!
//! ```text
//!   name    option             value
//!   ratio   --radius-ratio     1.5    a value of the option
//!   time    --steps            2x     a multiple of the base value, the value without --vary
//!   h       --voxel-size
//!   min     --radius-min       0.6d   a length, with a unit as in the option
//! ```

use std::fmt::Write;
use std::str::FromStr;

use meniscus_formats::listed;

use crate::surface::options::{Length, LengthUnit, MethodOptions, Settings, ValueKind};

use super::wording::{option_name, significant};

/// The parameters that differ from cell to cell.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ParameterSweep {
    /// One to three different parameters.
    axes: Vec<SweepAxis>,
}

#[derive(Clone, Debug, PartialEq)]
struct SweepAxis {
    parameter: &'static Parameter,
    /// `None` for the parameter's default values.
    amounts: Option<Vec<AxisValue>>,
}

/// An option that can be varied.
#[derive(Debug, PartialEq)]
pub(super) struct Parameter {
    /// Its short name.
    pub(super) name: &'static str,
    /// The option.
    option: &'static str,
    /// Its meaning, for titles. For whole numbers, the part before the first ` of ` is the counted noun, such
    /// as `steps` in `steps of smoothing`.
    pub(super) meaning: &'static str,
    /// The default values, shown beside the base value.
    amounts: (SweepUnit, &'static [f64]),
}

/// A number and its unit.
type AxisValue = (SweepUnit, f64);

#[derive(Clone, Copy, Debug, PartialEq)]
enum SweepUnit {
    /// A value of the option in this unit; the world unit if the option is not a length.
    Value(LengthUnit),
    /// A multiple of the base value.
    Times,
}

/// A value of an option.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SweepValue {
    parameter: &'static Parameter,
    /// A number that is not a length has the world unit. `None` for the base value.
    value: Option<Length>,
}

use SweepUnit::{Times, Value};

const PLAIN: SweepUnit = Value(LengthUnit::World);

static PARAMETERS: [Parameter; 14] = [
    // From the most faithful to the smoothest.
    parameter("ratio", "radius_ratio", "r_max / r_min", PLAIN, &[1.25, 2.0, 3.0, 4.0]),
    // From no smoothing to twice as long.
    parameter("time", "steps", "steps of smoothing", Times, &[0.0, 0.5, 2.0]),
    // From a quick look to four times the work. The coarsest voxels come first: they take the least time.
    parameter("h", "voxel_size", "voxel size h", Times, &[1.5, 0.75, 0.5]),
    parameter("smoothing", "position_smoothing", "position smoothing", PLAIN, &[0.0, 0.5, 0.7, 0.9]),
    parameter("min", "radius_min", "r_min", Times, &[0.75, 0.875, 1.25]),
    parameter("init", "radius_init", "r_init", Times, &[0.9, 1.1, 1.2]),
    parameter("thin", "thin_radius", "least semi-axis of flattened particles", Times, &[1.5, 2.0, 3.0]),
    parameter("alone", "lone_radius", "r_min of particles without neighbours", Times, &[1.2, 1.4, 1.6]),
    parameter("stretch", "max_stretch", "greatest stretch of particles", PLAIN, &[1.0, 2.0, 4.0, 8.0]),
    parameter("neighbors", "neighbor_radius", "search radius for neighbours", Times, &[0.75, 1.25, 1.5]),
    parameter("laplacian", "laplacian_steps", "Laplacian steps", Times, &[0.0, 0.5, 2.0, 4.0]),
    parameter("step", "step_size", "size of a step, h\u{2074}", Times, &[0.25, 4.0, 16.0]),
    parameter("redistance", "redistance_every", "steps between redistancings", PLAIN, &[1.0, 2.0, 4.0]),
    // Without default values: the base value is usually 0, and its multiples are 0 as well.
    parameter("offset", "offset", "offset", PLAIN, &[]),
];

const fn parameter(
    name: &'static str,
    option: &'static str,
    meaning: &'static str,
    unit: SweepUnit,
    numbers: &'static [f64],
) -> Parameter {
    Parameter { name, option, meaning, amounts: (unit, numbers) }
}

/// The section that `meniscus tune --help` prints below the options.
pub(super) fn tuning_help() -> String {
    let mut text =
        "Parameters for --vary. If you give no values for one, the sheet shows its base value and these:\n"
            .to_owned();
    for Parameter { name, option, meaning, amounts: (unit, numbers) } in &PARAMETERS {
        let x = if *unit == Times { "x" } else { "" };
        let numbers: Vec<String> = numbers.iter().map(|number| format!("{number}{x}")).collect();
        let numbers = if numbers.is_empty() { "give values".to_owned() } else { numbers.join(",") };
        // Writing into a string cannot fail.
        let _ = writeln!(text, "  {name:<11} {:<21} {meaning}: {numbers}", option_name(option));
    }
    text + TUNING
}

const TUNING: &str = "\
  Give values after a =, separated by commas, as in --vary ratio=1.5,2,3,h=0.5x,1x. A plain number is a
  value of the option; lengths also take d and h, as in min=0.6d. A number with an x is a multiple of
  the base value: the value without --vary.
  The first parameter differs from row to row, the second from column to column, the third from block
  to block. With --preset paper and an h below its base value, r_min keeps its base value, because
  otherwise the spheres of neighbouring particles would not overlap.

What is shown:
  A close-up of the part of the frame with the most surface, 16 particle spacings wide; with --camera
  zoom=1 the whole frame. --camera and --camera-from select any other view.

  All other options apply to every cell. For each cell, the command that converts INPUT with its
  settings is on the sheet, and is printed with the time that the cell took.

Exit status:
  0    every cell has its picture
  1    some settings were refused or failed: their cells have the reasons, and the others are shown
  2    the command is invalid, or no cell has a picture: no sheet was written";

impl ParameterSweep {
    /// The parameters with at least one value each. `settings` are the base settings.
    ///
    /// # Errors
    /// If a parameter has no values, or has no effect with these settings.
    pub(super) fn values(
        &self,
        settings: &Settings,
    ) -> Result<Vec<(&'static Parameter, Vec<SweepValue>)>, String> {
        self.axes.iter().map(|varied| Ok((varied.parameter, varied.values(settings)?))).collect()
    }

    /// The options with a value in particle spacings, if there is one: such a value needs the spacing, even
    /// if the options do not.
    pub(super) fn with_spacings(&self, options: &MethodOptions) -> MethodOptions {
        let mut options = options.clone();
        for SweepAxis { parameter, amounts } in &self.axes {
            for amount in amounts.iter().flatten() {
                if let (Value(unit @ LengthUnit::Spacing), value) = *amount {
                    parameter.put(Length { value, unit }, &mut options);
                }
            }
        }
        options
    }
}

impl SweepAxis {
    fn values(&self, settings: &Settings) -> Result<Vec<SweepValue>, String> {
        let &Parameter { name, amounts: (unit, numbers), .. } = self.parameter;
        if self.parameter.value_in(settings).is_none() {
            let needed = MethodOptions::info(self.parameter.option).and_then(|info| info.need.as_ref());
            let reason = needed.map_or("with the other options".to_owned(), |need| {
                format!("without {}", listed(need.any_of.iter().map(|option| option.flag()).collect(), "or"))
            });
            return Err(format!("--vary {name} has no effect {reason}"));
        }
        let value = |amount: AxisValue| self.parameter.value(amount, settings);
        if let Some(amounts) = &self.amounts {
            let is_multiple = |amount: &&AxisValue| amount.0 == Times && amount.1 != 1.0;
            if self.parameter.without(settings) == 0.0
                && let Some((_, factor)) = amounts.iter().find(is_multiple)
            {
                return Err(format!(
                    "--vary {name}={factor}x: the base value is 0, and so are its multiples: give values without an x"
                ));
            }
            return Ok(amounts.iter().copied().map(value).collect());
        }
        if numbers.is_empty() {
            return Err(format!("--vary {name} has no values: write {name}=VALUE,VALUE"));
        }
        let mut values = vec![value((Times, 1.0))];
        values.extend(numbers.iter().map(|&number| value((unit, number))));
        values.sort_by(|a, b| a.number(settings).total_cmp(&b.number(settings)));
        values.dedup_by(|a, b| a.number(settings) == b.number(settings));
        if name == "h" {
            values.reverse();
        }
        Ok(values)
    }
}

impl Parameter {
    fn named(name: &str) -> Result<&'static Parameter, String> {
        let found = PARAMETERS.iter().find(|parameter| parameter.name == name);
        found.ok_or_else(|| format!("there is no `{name}` to vary: expected {}", names()))
    }

    /// Whether its values are whole numbers.
    fn is_counted(&self) -> bool {
        MethodOptions::info(self.option).is_some_and(|info| info.kind == ValueKind::Count)
    }

    /// The parameter's value in the settings; `None` if they do not use the parameter.
    fn value_in(&self, settings: &Settings) -> Option<f64> {
        let pairs = settings.to_options().to_pairs();
        let found = pairs.iter().find(|(name, _)| *name == self.option);
        // Settings without an offset have an offset of 0.
        found.and_then(|(_, text)| text.parse().ok()).or_else(|| (self.option == "offset").then_some(0.0))
    }

    /// The base value; NaN if the settings do not use the parameter.
    fn without(&self, settings: &Settings) -> f64 {
        self.value_in(settings).unwrap_or(f64::NAN)
    }

    fn value(&'static self, amount: AxisValue, settings: &Settings) -> SweepValue {
        let without = self.without(settings);
        let value = match amount {
            (Times, 1.0) => None,
            (Value(unit), value) => Some(Length { value, unit }),
            (Times, factor) if !self.is_counted() => Some(short(factor * without).into()),
            // A positive multiple is at least one step.
            (Times, factor) if factor > 0.0 => Some((factor * without).round().max(1.0).into()),
            (Times, _) => Some(0.0.into()),
        };
        SweepValue { parameter: self, value }
    }

    /// Sets the option to this value.
    fn put(&self, value: Length, options: &mut MethodOptions) {
        let is_set = options.set(self.option, &value.to_string());
        debug_assert!(is_set.is_ok(), "{} takes numbers", self.option);
    }

    /// The units in which a value can be given. A voxel size cannot be given in voxels.
    fn units(&self) -> &'static [LengthUnit] {
        use LengthUnit::{Spacing, Voxel, World};
        match (self.option, MethodOptions::info(self.option).map(|info| info.kind)) {
            ("voxel_size", _) => &[World, Spacing],
            (_, Some(ValueKind::Length)) => &[World, Spacing, Voxel],
            _ => &[World],
        }
    }

    /// Parses a value: a number, with a unit if it is a length, or a multiple with an `x`.
    fn amount(&self, text: &str) -> Result<AxisValue, String> {
        let units = self.units();
        let parsed = match text.strip_suffix('x') {
            Some(factor) => factor.parse().ok().filter(|factor| *factor >= 0.0).map(|factor| (Times, factor)),
            None => {
                let length = text.parse().ok().filter(|length: &Length| units.contains(&length.unit));
                length.map(|Length { value, unit }| (Value(unit), value))
            }
        };
        let is_counted = self.is_counted();
        let is_sound = |amount: &AxisValue| match *amount {
            (Value(_), steps) if is_counted => {
                steps.fract() == 0.0 && (0.0..=STEPS_TYPED_MAX).contains(&steps)
            }
            (_, number) => number.is_finite(),
        };
        let expected = match units {
            _ if is_counted => "a whole number of steps, such as 5",
            [_] => "a number, such as 2",
            [_, _] => "a length, such as 0.05 or 0.4d",
            _ => "a length, such as 0.05, 0.6d or 5h",
        };
        parsed.filter(is_sound).ok_or_else(|| {
            let name = self.name;
            format!("{name}=`{text}`: expected {expected}, or a multiple of the base value, such as 0.5x")
        })
    }
}

impl SweepValue {
    fn number(self, settings: &Settings) -> f64 {
        let resolve = |length: Length| length.resolve(settings.spacing, settings.voxel_size);
        self.value.map_or_else(|| self.parameter.without(settings), resolve)
    }

    /// Sets the option; `settings` are the base settings.
    pub(super) fn put(self, options: &mut MethodOptions, settings: &Settings) {
        let Some(value) = self.value else { return };
        self.parameter.put(value, options);
        // With the paper's preset, radii follow the voxel size. With smaller voxels they would shrink, until
        // the spheres of neighbouring particles no longer overlap, so r_min keeps its value. With larger
        // voxels they must grow.
        let follows_voxel_size = options.preset.unwrap_or_default().follows_voxel_size();
        let is_finer = self.parameter.name == "h" && self.number(settings) < settings.voxel_size;
        if follows_voxel_size && is_finer && options.radius_min.is_none() {
            options.radius_min = Some(short(settings.radius_min).into());
        }
    }

    /// The label of a cell with these settings.
    pub(super) fn label(self, settings: &Settings) -> String {
        let (&Parameter { name, meaning, .. }, number) = (self.parameter, self.number(settings));
        let noun = meaning.split(" of ").next().unwrap_or_default();
        match self.parameter.is_counted() {
            true if number == 1.0 => format!("1 {}", noun.replacen("steps", "step", 1)),
            true => format!("{number} {noun}"),
            false => match self.value.filter(|length| length.unit != LengthUnit::World) {
                Some(length) => format!("{name} {length}"),
                None => format!("{name} {}", significant(number)),
            },
        }
    }

    /// Whether it is the base value.
    pub(super) fn is_without(self, settings: &Settings) -> bool {
        self.number(settings) == self.parameter.without(settings)
    }
}

/// A number rounded to four digits, short enough to type.
fn short(number: f64) -> f64 {
    format!("{number:.3e}").parse().unwrap_or(number)
}

/// The maximum number of parameters: one each for rows, columns and blocks.
const PARAMETERS_MAX: usize = 3;

/// The largest plain number of steps: the options are 32-bit integers.
const STEPS_TYPED_MAX: f64 = u32::MAX as f64;

impl FromStr for ParameterSweep {
    type Err = String;

    fn from_str(text: &str) -> Result<ParameterSweep, String> {
        let mut varied: Vec<SweepAxis> = Vec::new();
        for item in text.split(',').map(str::trim) {
            let (name, value) = match item.split_once('=') {
                Some((name, value)) => (Some(name.trim()), Some(value.trim())),
                None if item.starts_with(|c: char| c.is_ascii_alphabetic()) => (Some(item), None),
                None => (None, Some(item)),
            };
            if let Some(name) = name {
                let parameter = Parameter::named(name)?;
                if varied.iter().any(|varied| varied.parameter == parameter) {
                    return Err(format!("parameter {name} is given twice"));
                }
                if varied.len() == PARAMETERS_MAX {
                    return Err(format!(
                        "{name} is the fourth parameter, and a sheet shows at most three: in rows, columns and blocks"
                    ));
                }
                varied.push(SweepAxis { parameter, amounts: None });
            }
            let Some(value) = value else { continue };
            let Some(SweepAxis { parameter, amounts }) = varied.last_mut() else {
                return Err(format!(
                    "value `{value}` has no parameter: write NAME={value}, with one of {}",
                    names()
                ));
            };
            if name.is_none() && amounts.is_none() {
                return Err(format!("`{value}`: values follow a =, such as {}={value}", parameter.name));
            }
            amounts.get_or_insert_default().push(parameter.amount(value)?);
        }
        Ok(ParameterSweep { axes: varied })
    }
}

fn names() -> String {
    let names: Vec<&str> = PARAMETERS.iter().map(|parameter| parameter.name).collect();
    format!("{}, each with values or without, such as ratio=1.5,2,3,time", names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::options::Preset;

    fn settings() -> Settings {
        Settings::paper(0.1, &MethodOptions::default()).expect("sound")
    }

    fn values(text: &str, settings: &Settings) -> Vec<Vec<Option<f64>>> {
        let vary: ParameterSweep = text.parse().expect(text);
        let numbers = |values: Vec<SweepValue>| {
            values.into_iter().map(|value| value.value.and_then(Length::world)).collect()
        };
        vary.values(settings).expect(text).into_iter().map(|(_, values)| numbers(values)).collect()
    }

    #[test]
    fn given_values_are_used() {
        let given = values("ratio=1.5, 0.7x ,time=7,2x,0x,h=0.3,1x,0.3333333x", &settings());
        assert_eq!(given[0], [Some(1.5), Some(1.4)]);
        assert_eq!(given[1], [Some(7.0), Some(10.0), Some(0.0)]);
        assert_eq!(given[2], [Some(0.3), None, Some(0.03333)]);
    }

    #[test]
    fn lengths_take_units_and_keep_them_in_labels_and_commands() {
        // h = 0.1 and d = 0.2.
        let settings = settings();
        let vary: ParameterSweep = "min=0.9d,offset=-0.2d,0,1h,h=0.4d".parse().expect("lengths");
        let axes = vary.values(&settings).expect("sound");
        let labels = |axis: usize| -> Vec<String> {
            axes[axis].1.iter().map(|value| value.label(&settings)).collect()
        };
        assert_eq!(labels(0), ["min 0.9d"]);
        assert_eq!(labels(1), ["offset -0.2d", "offset 0", "offset 1h"]);
        assert_eq!(labels(2), ["h 0.4d"]);
        let numbers: Vec<f64> = axes[1].1.iter().map(|value| value.number(&settings)).collect();
        assert_eq!(numbers, [-0.04, 0.0, 0.1]);
        let mut options = MethodOptions::default();
        for (_, values) in &axes {
            values[0].put(&mut options, &settings);
        }
        let expected = [("voxel_size", "0.4d"), ("radius_min", "0.9d"), ("offset", "-0.2d")];
        assert_eq!(options.to_pairs(), expected.map(|(name, value)| (name, value.to_owned())));
        for (text, expected) in [
            ("h=2h", "a length, such as 0.05 or 0.4d"),
            ("min=0.6w", "a length, such as 0.05, 0.6d or 5h"),
            ("ratio=2d", "a number, such as 2"),
            ("time=2h", "a whole number of steps, such as 5"),
        ] {
            let why = text.parse::<ParameterSweep>().expect_err(text);
            assert!(why.contains(expected), "{why}");
        }
    }

    #[test]
    fn default_values_include_the_base_value() {
        assert_eq!(values("time", &settings())[0], [Some(0.0), Some(3.0), None, Some(10.0)]);
        assert_eq!(values("ratio", &settings())[0], [Some(1.25), None, Some(3.0), Some(4.0)]);
        assert_eq!(values("h", &settings())[0], [Some(0.15), None, Some(0.075), Some(0.05)]);
        let granular = MethodOptions {
            preset: Some(Preset::Granular),
            radius_ratio: Some(1.4),
            ..MethodOptions::default()
        };
        let granular = Settings::paper(0.1, &granular).expect("sound");
        // Half of one step counts as one step.
        assert_eq!(values("time", &granular)[0], [Some(0.0), None, Some(2.0)]);
        assert_eq!(values("ratio", &granular)[0], [Some(1.25), None, Some(2.0), Some(3.0), Some(4.0)]);
    }

    #[test]
    fn axes_without_effect_or_values_are_refused() {
        let refused = |text: &str| {
            let vary: ParameterSweep = text.parse().expect(text);
            vary.values(&settings()).err().unwrap_or_default()
        };
        for (name, reason) in [
            ("thin", "--vary thin has no effect without --anisotropy neighbors"),
            ("alone", "--vary alone has no effect without --anisotropy neighbors"),
            ("stretch", "--vary stretch has no effect without --anisotropy"),
            (
                "neighbors=1,2",
                "--vary neighbors has no effect without --anisotropy neighbors or --position-smoothing",
            ),
        ] {
            assert_eq!(refused(name), reason);
        }
        assert_eq!(refused("offset"), "--vary offset has no values: write offset=VALUE,VALUE");
        assert_eq!(refused("offset=0,0.1"), "");
        assert_eq!(refused("offset=1x,0.1"), "");
        assert_eq!(
            refused("offset=0.5x,1x"),
            "--vary offset=0.5x: the base value is 0, and so are its multiples: give values without an x"
        );
    }

    /// A value set in the options is the value read from the resulting settings.
    #[test]
    fn every_parameter_changes_the_settings() {
        let with = |options: &MethodOptions| Settings::resolve(options, Some(0.2.into())).expect("sound");
        let without = with(&MethodOptions::default());
        for parameter in &PARAMETERS {
            let usual = parameter.without(&without);
            let number = match parameter.name {
                "offset" => -0.01,
                "redistance" => 2.0,
                _ if parameter.is_counted() => 2.0 * usual,
                _ => short(1.01 * usual),
            };
            let mut options = MethodOptions::default();
            let value = SweepValue { parameter, value: Some(number.into()) };
            value.put(&mut options, &without);
            assert_eq!(parameter.without(&with(&options)), number, "{}", parameter.name);
            assert!(value.is_without(&with(&options)) && !value.is_without(&without), "{}", parameter.name);
        }
    }

    #[test]
    fn counted_nouns_are_singular_or_plural() {
        for (name, labels) in [
            ("time", ["1 step", "5 steps"]),
            ("laplacian", ["1 Laplacian step", "5 Laplacian steps"]),
            ("redistance", ["1 step between redistancings", "5 steps between redistancings"]),
            ("h", ["h 1", "h 5"]),
        ] {
            let parameter = Parameter::named(name).expect("known");
            let label = |number: f64| SweepValue { parameter, value: Some(number.into()) }.label(&settings());
            assert_eq!([label(1.0), label(5.0)], labels);
        }
    }

    fn voxel_size_of(number: f64) -> SweepValue {
        SweepValue { parameter: Parameter::named("h").expect("known"), value: Some(number.into()) }
    }

    #[test]
    fn paper_radii_stay_for_smaller_voxels_and_grow_for_larger_ones() {
        let settings = settings();
        for (voxel_size, radius_min) in [(0.05, Some(0.1732.into())), (0.1, None), (0.2, None)] {
            let mut options = MethodOptions { preset: Some(Preset::Paper), ..MethodOptions::default() };
            voxel_size_of(voxel_size).put(&mut options, &settings);
            assert_eq!((options.voxel_size, options.radius_min), (Some(voxel_size.into()), radius_min));
        }
        let mut options = MethodOptions {
            preset: Some(Preset::Paper),
            radius_min: Some(0.2.into()),
            ..MethodOptions::default()
        };
        voxel_size_of(0.05).put(&mut options, &settings);
        assert_eq!(options.radius_min, Some(0.2.into()));
    }

    #[test]
    fn errors_quote_the_input_and_the_expected_values() {
        for (text, expected) in [
            ("", "value `` has no parameter"),
            ("2,3", "value `2` has no parameter: write NAME=2"),
            ("size", "no `size` to vary: expected ratio, time, h"),
            ("ratio,2", "such as ratio=2"),
            ("ratio,time,ratio", "parameter ratio is given twice"),
            ("ratio,time,h,min", "min is the fourth parameter"),
            ("ratio=", "ratio=``: expected a number"),
            ("ratio=wide", "ratio=`wide`: expected a number"),
            ("time=2.5", "time=`2.5`: expected a whole number"),
            ("time=-1", "time=`-1`"),
            ("h=-1x", "h=`-1x`"),
            ("h=infx", "h=`infx`"),
        ] {
            let error = text.parse::<ParameterSweep>().expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
