//! What `meniscus tune` varies: `ratio=1.5,2,3,time,h=0.5x,1x`.
//!
//! ```text
//!   ratio   --radius-ratio     1.5    the number as the option takes it
//!   time    --steps            2x     a multiple of what it is without
//!   h       --voxel-size
//! ```

use std::fmt;
use std::str::FromStr;

use crate::cli::args::MethodArgs;
use crate::cli::wording::significant;
use crate::surface::options::Settings;

/// What differs from cell to cell.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::cli) struct Vary {
    /// One to three, each another axis.
    varied: Vec<Varied>,
}

#[derive(Clone, Debug, PartialEq)]
struct Varied {
    axis: Axis,
    /// None for the axis' own.
    amounts: Option<Vec<Amount>>,
}

/// An option that can be varied: its place in [`PARAMETERS`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Axis(usize);

/// What is known of an option that can be varied.
struct Parameter {
    /// Its short name.
    name: &'static str,
    /// The option.
    option: &'static str,
    /// What it is, in a title.
    meaning: &'static str,
    /// What is counted, one and several, where its values are whole numbers.
    counted: Option<[&'static str; 2]>,
    /// The values beside the one without, where none are given.
    amounts: &'static [Amount],
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Amount {
    /// As the option takes it.
    Of(f64),
    /// In units of what it is without.
    Times(f64),
}

/// A value of an option.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Value {
    axis: Axis,
    /// `None` for what it is without.
    number: Option<f64>,
}

use Amount::{Of, Times};

static PARAMETERS: [Parameter; 14] = [
    // From the most faithful to the smoothest.
    measured("ratio", "radius_ratio", "r_max / r_min", &[Of(1.25), Of(2.0), Of(3.0), Of(4.0)]),
    // None to twice as long.
    counted("time", "steps", ["step", "steps"], &[Times(0.0), Times(0.5), Times(2.0)], "steps of smoothing"),
    // A quick look to four times the work. The coarsest is first: it is the quickest.
    measured("h", "voxel_size", "voxel size h", &[Times(1.5), Times(0.75), Times(0.5)]),
    measured("smoothing", "position_smoothing", "position smoothing", &[Of(0.0), Of(0.5), Of(0.7), Of(0.9)]),
    measured("min", "radius_min", "r_min", &[Times(0.75), Times(0.875), Times(1.25)]),
    measured("init", "radius_init", "r_init", &[Times(0.9), Times(1.1), Times(1.2)]),
    measured(
        "thin",
        "thin_radius",
        "least half axis of flattened particles",
        &[Times(1.5), Times(2.0), Times(3.0)],
    ),
    measured(
        "alone",
        "lone_radius",
        "r_min of particles without neighbours",
        &[Times(1.2), Times(1.4), Times(1.6)],
    ),
    measured(
        "stretch",
        "max_stretch",
        "greatest stretch of particles",
        &[Of(1.0), Of(2.0), Of(4.0), Of(8.0)],
    ),
    measured(
        "neighbors",
        "neighbor_radius",
        "how far neighbours count",
        &[Times(0.75), Times(1.25), Times(1.5)],
    ),
    counted(
        "laplacian",
        "laplacian_steps",
        ["Laplacian step", "Laplacian steps"],
        &[Times(0.0), Times(0.5), Times(2.0), Times(4.0)],
        "Laplacian steps",
    ),
    measured("step", "step_size", "size of a step, h\u{2074}", &[Times(0.25), Times(4.0), Times(16.0)]),
    counted(
        "redistance",
        "redistance_every",
        ["step between redistancings", "steps between redistancings"],
        &[Of(1.0), Of(2.0), Of(4.0)],
        "steps between redistancings",
    ),
    // A multiple of 0 is 0: values must be given.
    measured("offset", "offset", "offset", &[]),
];

const fn measured(
    name: &'static str,
    option: &'static str,
    meaning: &'static str,
    amounts: &'static [Amount],
) -> Parameter {
    Parameter { name, option, meaning, counted: None, amounts }
}

const fn counted(
    name: &'static str,
    option: &'static str,
    counted: [&'static str; 2],
    amounts: &'static [Amount],
    meaning: &'static str,
) -> Parameter {
    Parameter { name, option, meaning, counted: Some(counted), amounts }
}

impl Parameter {
    /// Its value in settings; `None` where these do not use it.
    fn value(&self, settings: &Settings) -> Option<f64> {
        let pairs = settings.to_options().to_pairs();
        let found =
            pairs.iter().find(|(name, _)| *name == self.option).and_then(|(_, text)| text.parse().ok());
        // Settings without an offset have one of 0.
        found.or_else(|| (self.option == "offset").then_some(0.0))
    }
}

impl Vary {
    /// The axes, and the values of each: one at least. `settings` are those without.
    ///
    /// # Errors
    /// When an axis has no values, or changes nothing with these settings.
    pub(super) fn values(&self, settings: &Settings) -> Result<Vec<(Axis, Vec<Value>)>, String> {
        self.varied.iter().map(|varied| Ok((varied.axis, varied.values(settings)?))).collect()
    }
}

impl Varied {
    fn values(&self, settings: &Settings) -> Result<Vec<Value>, String> {
        let Parameter { name, amounts, .. } = self.axis.parameter();
        if self.axis.parameter().value(settings).is_none() {
            return Err(format!(
                "--vary {name} changes nothing where neighbours do not shape particles: add --anisotropy neighbors"
            ));
        }
        let value = |amount: Amount| self.axis.value(amount, settings);
        if let Some(amounts) = &self.amounts {
            return Ok(amounts.iter().copied().map(value).collect());
        }
        if amounts.is_empty() {
            return Err(format!("--vary {name} has no values: write {name}=VALUE,VALUE"));
        }
        let mut values = vec![value(Times(1.0))];
        values.extend(amounts.iter().copied().map(value));
        values.sort_by(|a, b| a.number(settings).total_cmp(&b.number(settings)));
        values.dedup_by(|a, b| a.number(settings) == b.number(settings));
        if *name == "h" {
            values.reverse();
        }
        Ok(values)
    }
}

impl Axis {
    fn named(name: &str) -> Option<Axis> {
        PARAMETERS.iter().position(|parameter| parameter.name == name).map(Axis)
    }

    fn parameter(self) -> &'static Parameter {
        &PARAMETERS[self.0]
    }

    /// What it is, in a title.
    pub(super) fn meaning(self) -> &'static str {
        self.parameter().meaning
    }

    /// What it is without.
    fn without(self, settings: &Settings) -> f64 {
        self.parameter().value(settings).unwrap_or(f64::NAN)
    }

    fn value(self, amount: Amount, settings: &Settings) -> Value {
        let parameter = self.parameter();
        let without = self.without(settings);
        let number = match amount {
            Times(1.0) => None,
            Of(number) => Some(number),
            Times(factor) if parameter.counted.is_none() => Some(short(factor * without)),
            // Half of a step is one.
            Times(factor) if factor > 0.0 => Some((factor * without).round().max(1.0)),
            Times(_) => Some(0.0),
        };
        Value { axis: self, number }
    }
}

impl Value {
    fn number(self, settings: &Settings) -> f64 {
        self.number.unwrap_or_else(|| self.axis.without(settings))
    }

    /// Puts it into options; `settings` are those without.
    pub(super) fn put(self, method: &mut MethodArgs, settings: &Settings) {
        let Some(number) = self.number else { return };
        let Parameter { name, option, .. } = self.axis.parameter();
        let is_set = method.options.set(option, &number.to_string());
        debug_assert!(is_set.is_some(), "{option} takes numbers");
        // In smaller voxels the paper's spheres would shrink, too, and come apart. In larger ones they must grow.
        let follows_voxel_size = method.to_options().preset.unwrap_or_default().follows_voxel_size();
        let is_finer = *name == "h" && number < settings.voxel_size;
        if follows_voxel_size && is_finer && method.options.radius_min.is_none() {
            method.options.radius_min = Some(short(settings.radius_min).into());
        }
    }

    /// As it is written under a cell with these settings.
    pub(super) fn label(self, settings: &Settings) -> String {
        let (parameter, number) = (self.axis.parameter(), self.number(settings));
        match parameter.counted {
            Some([one, _]) if number == 1.0 => format!("1 {one}"),
            Some([_, several]) => format!("{number} {several}"),
            None => format!("{} {}", parameter.name, significant(number)),
        }
    }

    /// Whether it is what it is without.
    pub(super) fn is_without(self, settings: &Settings) -> bool {
        self.number(settings) == self.axis.without(settings)
    }
}

/// A number to four digits, as it is easily typed.
fn short(number: f64) -> f64 {
    format!("{number:.3e}").parse().unwrap_or(number)
}

/// Rows, columns and blocks.
const AXES_MAX: usize = 3;

/// More are no whole number of steps.
const STEPS_TYPED_MAX: f64 = u32::MAX as f64;

impl FromStr for Vary {
    type Err = String;

    fn from_str(text: &str) -> Result<Vary, String> {
        let mut varied: Vec<Varied> = Vec::new();
        for item in text.split(',').map(str::trim) {
            let (name, first) = match item.split_once('=') {
                Some((name, first)) => (Some(name.trim()), Some(first.trim())),
                None if item.starts_with(|c: char| c.is_ascii_alphabetic()) => (Some(item), None),
                None => (None, Some(item)),
            };
            if let Some(name) = name {
                let axis = Axis::named(name)
                    .ok_or_else(|| format!("there is no `{name}` to vary: expected {}", names()))?;
                if varied.iter().any(|varied| varied.axis == axis) {
                    return Err(format!("parameter {name} is given twice"));
                }
                if varied.len() == AXES_MAX {
                    return Err(format!(
                        "{name} is one parameter too many: a sheet has rows, columns and blocks"
                    ));
                }
                varied.push(Varied { axis, amounts: None });
            }
            if let Some(text) = first {
                let last = varied.last_mut();
                let last = last.ok_or_else(|| {
                    format!("value `{text}` has no parameter: write NAME={text}, with one of {}", names())
                })?;
                if name.is_none() && last.amounts.is_none() {
                    let name = last.axis;
                    return Err(format!("`{text}`: values follow a =, such as {name}={text}"));
                }
                last.amounts.get_or_insert_default().push(amount(last.axis, text)?);
            }
        }
        Ok(Vary { varied })
    }
}

fn amount(axis: Axis, text: &str) -> Result<Amount, String> {
    let parsed = match text.strip_suffix('x') {
        Some(factor) => factor.parse().ok().filter(|factor: &f64| *factor >= 0.0).map(Amount::Times),
        None => text.parse().ok().map(Amount::Of),
    };
    let is_counted = axis.parameter().counted.is_some();
    let is_sound = |amount: &Amount| match (is_counted, *amount) {
        (true, Of(steps)) => steps.fract() == 0.0 && (0.0..=STEPS_TYPED_MAX).contains(&steps),
        (_, Of(number) | Times(number)) => number.is_finite(),
    };
    let expected = if is_counted { "a whole number of steps, such as 5" } else { "a number, such as 2" };
    parsed.filter(is_sound).ok_or_else(|| {
        format!("{}=`{text}`: expected {expected}, or a multiple of what it is without, such as 0.5x", axis)
    })
}

impl fmt::Display for Axis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.parameter().name)
    }
}

fn names() -> String {
    let names: Vec<&str> = PARAMETERS.iter().map(|parameter| parameter.name).collect();
    format!("{}, each with values or without, such as ratio=1.5,2,3,time", names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::options::{MethodOptions, Preset};

    fn settings() -> Settings {
        Settings::paper(0.1, &MethodOptions::default()).expect("sound")
    }

    fn values(text: &str, settings: &Settings) -> Vec<Vec<Option<f64>>> {
        let vary: Vary = text.parse().expect(text);
        let numbers = |values: Vec<Value>| values.into_iter().map(|value| value.number).collect();
        vary.values(settings).expect(text).into_iter().map(|(_, values)| numbers(values)).collect()
    }

    #[test]
    fn values_are_those_that_were_given() {
        let given = values("ratio=1.5, 0.7x ,time=7,2x,0x,h=0.3,1x,0.3333333x", &settings());
        assert_eq!(given[0], [Some(1.5), Some(1.4)]);
        assert_eq!(given[1], [Some(7.0), Some(10.0), Some(0.0)]);
        assert_eq!(given[2], [Some(0.3), None, Some(0.03333)]);
    }

    #[test]
    fn without_values_what_it_is_without_is_there() {
        assert_eq!(values("time", &settings())[0], [Some(0.0), Some(3.0), None, Some(10.0)]);
        assert_eq!(values("ratio", &settings())[0], [Some(1.25), None, Some(3.0), Some(4.0)]);
        assert_eq!(values("h", &settings())[0], [Some(0.15), None, Some(0.075), Some(0.05)]);
        let granular = MethodOptions {
            preset: Some(Preset::Granular),
            radius_ratio: Some(1.4),
            ..MethodOptions::default()
        };
        let granular = Settings::paper(0.1, &granular).expect("sound");
        // Half of a step is one.
        assert_eq!(values("time", &granular)[0], [Some(0.0), None, Some(2.0)]);
        assert_eq!(values("ratio", &granular)[0], [Some(1.25), None, Some(2.0), Some(3.0), Some(4.0)]);
    }

    #[test]
    fn axes_without_effect_or_values_are_refused() {
        let refused = |text: &str| {
            let vary: Vary = text.parse().expect(text);
            vary.values(&settings()).err().unwrap_or_default()
        };
        for name in ["thin", "alone", "stretch", "neighbors=1,2"] {
            assert!(refused(name).contains("changes nothing"), "{name}: {}", refused(name));
        }
        assert_eq!(refused("offset"), "--vary offset has no values: write offset=VALUE,VALUE");
        assert_eq!(refused("offset=0,0.1"), "");
    }

    /// What is put into the options comes out of the settings.
    #[test]
    fn every_parameter_changes_the_settings() {
        let with =
            |method: &MethodArgs| Settings::resolve(&method.to_options(), Some(0.2.into())).expect("sound");
        let without = with(&MethodArgs::default());
        for axis in (0..PARAMETERS.len()).map(Axis) {
            let usual = axis.without(&without);
            let number = match axis.parameter().name {
                "offset" => -0.01,
                "redistance" => 2.0,
                _ if axis.parameter().counted.is_some() => 2.0 * usual,
                _ => short(1.01 * usual),
            };
            let mut method = MethodArgs::default();
            let value = Value { axis, number: Some(number) };
            value.put(&mut method, &without);
            assert_eq!(axis.without(&with(&method)), number, "{axis}");
            assert!(value.is_without(&with(&method)) && !value.is_without(&without), "{axis}");
        }
    }

    fn voxel_size_of(number: f64) -> Value {
        Value { axis: Axis::named("h").expect("known"), number: Some(number) }
    }

    #[test]
    fn radii_stay_where_voxels_are_smaller_and_grow_where_they_are_larger() {
        let settings = settings();
        for (voxel_size, radius_min) in [(0.05, Some(0.1732.into())), (0.1, None), (0.2, None)] {
            let mut method = MethodArgs::default();
            method.options.preset = Some(Preset::Paper);
            voxel_size_of(voxel_size).put(&mut method, &settings);
            assert_eq!(
                (method.options.voxel_size, method.options.radius_min),
                (Some(voxel_size.into()), radius_min)
            );
        }
        let mut method = MethodArgs::default();
        method.options.preset = Some(Preset::Paper);
        method.options.radius_min = Some(0.2.into());
        voxel_size_of(0.05).put(&mut method, &settings);
        assert_eq!(method.options.radius_min, Some(0.2.into()));
    }

    #[test]
    fn what_is_wrong_is_named_with_what_was_expected() {
        for (text, told) in [
            ("", "value `` has no parameter"),
            ("2,3", "value `2` has no parameter: write NAME=2"),
            ("size", "no `size` to vary: expected ratio, time, h"),
            ("ratio,2", "such as ratio=2"),
            ("ratio,time,ratio", "parameter ratio is given twice"),
            ("ratio,time,h,min", "min is one parameter too many"),
            ("ratio=", "ratio=``: expected a number"),
            ("ratio=wide", "ratio=`wide`: expected a number"),
            ("time=2.5", "time=`2.5`: expected a whole number"),
            ("time=-1", "time=`-1`"),
            ("h=-1x", "h=`-1x`"),
            ("h=infx", "h=`infx`"),
        ] {
            let error = text.parse::<Vary>().expect_err(text);
            assert!(error.contains(told), "{text}: {error}");
        }
    }
}
