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
use crate::settings::Settings;

/// What differs from cell to cell.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::cli) struct Vary {
    /// One to three, each another axis.
    varied: Vec<Varied>,
}

#[derive(Clone, Debug, PartialEq)]
struct Varied {
    axis: Axis,
    /// None for those that users need most.
    amounts: Option<Vec<Amount>>,
}

/// An option, by a short name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Axis {
    Ratio,
    Time,
    VoxelSize,
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
pub(super) enum Value {
    Ratio(f64),
    Steps(u32),
    /// `None` for what it is without.
    VoxelSize(Option<f64>),
}

impl Vary {
    /// The axes, and the values of each: one at least. `settings` are those without.
    pub(super) fn values(&self, settings: &Settings) -> Vec<(Axis, Vec<Value>)> {
        self.varied.iter().map(|varied| (varied.axis, varied.values(settings))).collect()
    }
}

impl Varied {
    fn values(&self, settings: &Settings) -> Vec<Value> {
        let value = |amount: Amount| self.axis.value(amount, settings);
        let Some(amounts) = &self.amounts else {
            let without = value(Amount::Times(1.0));
            let mut values: Vec<Value> = self.axis.default_amounts().iter().copied().map(value).collect();
            values.push(without);
            values.sort_by(|a, b| self.axis.number(*a, settings).total_cmp(&self.axis.number(*b, settings)));
            values.dedup();
            if self.axis == Axis::VoxelSize {
                // The coarsest first: it is the quickest.
                values.reverse();
            }
            return values;
        };
        amounts.iter().copied().map(value).collect()
    }
}

impl Axis {
    const ALL: [Axis; 3] = [Axis::Ratio, Axis::Time, Axis::VoxelSize];

    fn name(self) -> &'static str {
        match self {
            Axis::Ratio => "ratio",
            Axis::Time => "time",
            Axis::VoxelSize => "h",
        }
    }

    /// What it is, in a title.
    pub(super) fn meaning(self) -> &'static str {
        match self {
            Axis::Ratio => "r_max / r_min",
            Axis::Time => "steps of smoothing",
            Axis::VoxelSize => "voxel size h",
        }
    }

    /// From the most faithful to the smoothest; none to twice as long; a quick look to four times the work.
    fn default_amounts(self) -> &'static [Amount] {
        use Amount::{Of, Times};
        match self {
            Axis::Ratio => &[Of(1.25), Of(2.0), Of(3.0), Of(4.0)],
            Axis::Time => &[Times(0.0), Times(0.5), Times(2.0)],
            Axis::VoxelSize => &[Times(1.5), Times(0.75), Times(0.5)],
        }
    }

    fn value(self, amount: Amount, settings: &Settings) -> Value {
        match (self, amount) {
            (Axis::Ratio, Amount::Of(ratio)) => Value::Ratio(ratio),
            (Axis::Ratio, Amount::Times(factor)) => Value::Ratio(short(factor * settings.radius_ratio)),
            // What is checked before is whole, and no more than there can be.
            (Axis::Time, Amount::Of(steps)) => Value::Steps(steps as u32),
            (Axis::Time, Amount::Times(factor)) => {
                let steps = (factor * f64::from(settings.steps)).round();
                Value::Steps(if factor > 0.0 { (steps as u32).max(1) } else { 0 })
            }
            (Axis::VoxelSize, Amount::Of(voxel_size)) => Value::VoxelSize(Some(voxel_size)),
            (Axis::VoxelSize, Amount::Times(1.0)) => Value::VoxelSize(None),
            (Axis::VoxelSize, Amount::Times(factor)) => {
                Value::VoxelSize(Some(short(factor * settings.voxel_size)))
            }
        }
    }

    fn number(self, value: Value, settings: &Settings) -> f64 {
        match value {
            Value::Ratio(ratio) => ratio,
            Value::Steps(steps) => f64::from(steps),
            Value::VoxelSize(voxel_size) => voxel_size.unwrap_or(settings.voxel_size),
        }
    }
}

impl Value {
    /// Puts it into options; `settings` are those without.
    pub(super) fn put(self, method: &mut MethodArgs, settings: &Settings) {
        match self {
            Value::Ratio(ratio) => method.surface.radius_ratio = Some(ratio),
            Value::Steps(steps) => method.solver.steps = Some(steps),
            Value::VoxelSize(None) => {}
            Value::VoxelSize(Some(voxel_size)) => {
                method.first.voxel_size = Some(voxel_size);
                // In smaller voxels the spheres would shrink, too, and come apart. In larger ones they must grow.
                if voxel_size < settings.voxel_size && method.surface.radius_min.is_none() {
                    method.surface.radius_min = Some(short(settings.radius_min));
                }
            }
        }
    }

    /// As it is written under a cell; `settings` are those without.
    pub(super) fn label(self, settings: &Settings) -> String {
        match self {
            Value::Ratio(ratio) => format!("ratio {ratio}"),
            Value::Steps(1) => "1 step".to_owned(),
            Value::Steps(steps) => format!("{steps} steps"),
            Value::VoxelSize(voxel_size) => {
                format!("h {}", significant(voxel_size.unwrap_or(settings.voxel_size)))
            }
        }
    }

    /// Whether it is what it is without.
    pub(super) fn is_without(self, settings: &Settings) -> bool {
        match self {
            Value::Ratio(ratio) => ratio == settings.radius_ratio,
            Value::Steps(steps) => steps == settings.steps,
            Value::VoxelSize(voxel_size) => {
                voxel_size.is_none_or(|voxel_size| voxel_size == settings.voxel_size)
            }
        }
    }
}

/// A number to four digits, as it is easily typed.
fn short(number: f64) -> f64 {
    format!("{number:.3e}").parse().unwrap_or(number)
}

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
                let axis = Axis::ALL.into_iter().find(|axis| axis.name() == name);
                let axis = axis.ok_or_else(|| format!("there is no `{name}` to vary: expected {NAMES}"))?;
                if varied.iter().any(|varied| varied.axis == axis) {
                    return Err(format!("{name} is there twice"));
                }
                varied.push(Varied { axis, amounts: None });
            }
            if let Some(text) = first {
                let last = varied.last_mut();
                let last = last.ok_or_else(|| format!("`{text}` is a value of nothing: expected {NAMES}"))?;
                if name.is_none() && last.amounts.is_none() {
                    let name = last.axis.name();
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
    let is_sound = |amount: &Amount| match (axis, *amount) {
        (Axis::Time, Amount::Of(steps)) => steps.fract() == 0.0 && (0.0..=STEPS_TYPED_MAX).contains(&steps),
        (_, Amount::Of(number) | Amount::Times(number)) => number.is_finite(),
    };
    let expected =
        if axis == Axis::Time { "a whole number of steps, such as 5" } else { "a number, such as 2" };
    parsed.filter(is_sound).ok_or_else(|| {
        format!(
            "{}=`{text}`: expected {expected}, or a multiple of what it is without, such as 0.5x",
            axis.name()
        )
    })
}

impl fmt::Display for Axis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

const NAMES: &str = "ratio, time, h, each with values or without, such as ratio=1.5,2,3,time";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::{Choices, Preset};

    fn settings() -> Settings {
        Settings::resolve(0.1, &Choices::default()).expect("sound")
    }

    fn values(text: &str, settings: &Settings) -> Vec<Vec<Value>> {
        let vary: Vary = text.parse().expect(text);
        vary.values(settings).into_iter().map(|(_, values)| values).collect()
    }

    #[test]
    fn values_are_those_that_were_given() {
        use Value::{Ratio, Steps, VoxelSize};
        let given = values("ratio=1.5, 0.7x ,time=7,2x,0x,h=0.3,1x,0.3333333x", &settings());
        assert_eq!(given[0], [Ratio(1.5), Ratio(1.4)]);
        assert_eq!(given[1], [Steps(7), Steps(10), Steps(0)]);
        assert_eq!(given[2], [VoxelSize(Some(0.3)), VoxelSize(None), VoxelSize(Some(0.03333))]);
    }

    #[test]
    fn without_values_what_it_is_without_is_there() {
        use Value::{Ratio, Steps, VoxelSize};
        assert_eq!(values("time", &settings())[0], [0, 3, 5, 10].map(Steps));
        assert_eq!(values("ratio", &settings())[0], [1.25, 2.0, 3.0, 4.0].map(Ratio));
        let sizes = values("h", &settings());
        assert_eq!(sizes[0], [Some(0.15), None, Some(0.075), Some(0.05)].map(VoxelSize));
        let granular =
            Choices { preset: Some(Preset::Granular), radius_ratio: Some(1.4), ..Choices::default() };
        let granular = Settings::resolve(0.1, &granular).expect("sound");
        // Half of a step is one.
        assert_eq!(values("time", &granular)[0], [0, 1, 2].map(Steps));
        assert_eq!(values("ratio", &granular)[0], [1.25, 1.4, 2.0, 3.0, 4.0].map(Ratio));
    }

    #[test]
    fn radii_stay_where_voxels_are_smaller_and_grow_where_they_are_larger() {
        let settings = settings();
        for (voxel_size, radius_min) in [(0.05, Some(0.1732)), (0.1, None), (0.2, None)] {
            let mut method = MethodArgs::default();
            Value::VoxelSize(Some(voxel_size)).put(&mut method, &settings);
            assert_eq!((method.first.voxel_size, method.surface.radius_min), (Some(voxel_size), radius_min));
        }
        let mut method = MethodArgs::default();
        method.surface.radius_min = Some(0.2);
        Value::VoxelSize(Some(0.05)).put(&mut method, &settings);
        assert_eq!(method.surface.radius_min, Some(0.2));
    }

    #[test]
    fn what_is_wrong_is_named_with_what_was_expected() {
        for (text, told) in [
            ("", "`` is a value of nothing"),
            ("2,3", "`2` is a value of nothing"),
            ("size", "no `size` to vary: expected ratio, time, h"),
            ("ratio,2", "such as ratio=2"),
            ("ratio,time,ratio", "ratio is there twice"),
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
