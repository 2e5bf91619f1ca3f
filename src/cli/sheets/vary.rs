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
use crate::cli::choices::choices;
use crate::cli::wording::significant;
use crate::surface::options::{Anisotropy, Settings};

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
    /// What it is, in a title.
    meaning: &'static str,
    /// What is counted, one and several, where its values are whole numbers.
    counted: Option<[&'static str; 2]>,
    /// The values beside that without, where none are given.
    amounts: &'static [Amount],
    /// Its value in settings.
    get: fn(&Settings) -> f64,
    /// Puts a value into options.
    put: fn(&mut MethodArgs, f64),
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
    Parameter {
        name: "ratio",
        meaning: "r_max / r_min",
        counted: None,
        amounts: &[Of(1.25), Of(2.0), Of(3.0), Of(4.0)],
        get: |settings| settings.radius_ratio,
        put: |method, ratio| method.surface.radius_ratio = Some(ratio),
    },
    // None to twice as long.
    Parameter {
        name: "time",
        meaning: "steps of smoothing",
        counted: Some(["step", "steps"]),
        amounts: &[Times(0.0), Times(0.5), Times(2.0)],
        get: |settings| f64::from(settings.steps),
        put: |method, steps| method.solver.steps = Some(steps as u32),
    },
    // A quick look to four times the work. The coarsest is first: it is the quickest.
    Parameter {
        name: "h",
        meaning: "voxel size h",
        counted: None,
        amounts: &[Times(1.5), Times(0.75), Times(0.5)],
        get: |settings| settings.voxel_size,
        put: |method, voxel_size| method.first.voxel_size = Some(voxel_size),
    },
    Parameter {
        name: "smoothing",
        meaning: "position smoothing",
        counted: None,
        amounts: &[Of(0.0), Of(0.5), Of(0.7), Of(0.9)],
        get: |settings| settings.position_smoothing,
        put: |method, part| method.particles.position_smoothing = Some(part),
    },
    Parameter {
        name: "min",
        meaning: "r_min",
        counted: None,
        amounts: &[Times(0.75), Times(0.875), Times(1.25)],
        get: |settings| settings.radius_min,
        put: |method, radius| method.surface.radius_min = Some(radius),
    },
    Parameter {
        name: "init",
        meaning: "r_init",
        counted: None,
        amounts: &[Times(0.9), Times(1.1), Times(1.2)],
        get: |settings| settings.radius_init,
        put: |method, radius| method.surface.radius_init = Some(radius),
    },
    Parameter {
        name: "thin",
        meaning: "least half axis of flattened particles",
        counted: None,
        amounts: &[Times(1.5), Times(2.0), Times(3.0)],
        get: |settings| match settings.anisotropy {
            Anisotropy::Neighbors { thin_radius, .. } => thin_radius,
            Anisotropy::None | Anisotropy::Velocity { .. } => settings.radius_min,
        },
        put: |method, radius| method.particles.thin_radius = Some(radius),
    },
    Parameter {
        name: "alone",
        meaning: "r_min of particles without neighbours",
        counted: None,
        amounts: &[Times(1.2), Times(1.4), Times(1.6)],
        get: |settings| match settings.anisotropy {
            Anisotropy::Neighbors { lone_radius, .. } => lone_radius,
            Anisotropy::None | Anisotropy::Velocity { .. } => settings.radius_min,
        },
        put: |method, radius| method.particles.lone_radius = Some(radius),
    },
    Parameter {
        name: "stretch",
        meaning: "greatest stretch of particles",
        counted: None,
        amounts: &[Of(1.0), Of(2.0), Of(4.0), Of(8.0)],
        get: |settings| match settings.anisotropy {
            Anisotropy::None => 1.0,
            Anisotropy::Neighbors { max_stretch, .. } | Anisotropy::Velocity { max_stretch, .. } => {
                max_stretch
            }
        },
        put: |method, stretch| method.particles.max_stretch = Some(stretch),
    },
    Parameter {
        name: "neighbors",
        meaning: "how far neighbours count",
        counted: None,
        amounts: &[Times(0.75), Times(1.25), Times(1.5)],
        get: |settings| settings.neighbor_radius,
        put: |method, radius| method.particles.neighbor_radius = Some(radius),
    },
    Parameter {
        name: "laplacian",
        meaning: "Laplacian steps",
        counted: Some(["Laplacian step", "Laplacian steps"]),
        amounts: &[Times(0.0), Times(0.5), Times(2.0), Times(4.0)],
        get: |settings| f64::from(settings.laplacian_steps),
        put: |method, steps| method.solver.laplacian_steps = Some(steps as u32),
    },
    Parameter {
        name: "step",
        meaning: "size of a step, h\u{2074}",
        counted: None,
        amounts: &[Times(0.25), Times(4.0), Times(16.0)],
        get: |settings| settings.step_size,
        put: |method, size| method.solver.step_size = Some(size),
    },
    Parameter {
        name: "redistance",
        meaning: "steps between redistancings",
        counted: Some(["step between redistancings", "steps between redistancings"]),
        amounts: &[Of(1.0), Of(2.0), Of(4.0)],
        get: |settings| f64::from(settings.redistance_every),
        put: |method, steps| method.solver.redistance_every = Some(steps as u32),
    },
    // A multiple of 0 is 0: values must be given.
    Parameter {
        name: "offset",
        meaning: "offset",
        counted: None,
        amounts: &[],
        get: |settings| settings.offset,
        put: |method, offset| method.surface.offset = Some(offset),
    },
];

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
        let has_effect = match *name {
            "thin" | "alone" => matches!(settings.anisotropy, Anisotropy::Neighbors { .. }),
            "stretch" => settings.anisotropy != Anisotropy::None,
            "neighbors" => settings.uses_neighbors(),
            _ => true,
        };
        if !has_effect {
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

    fn value(self, amount: Amount, settings: &Settings) -> Value {
        let parameter = self.parameter();
        let without = (parameter.get)(settings);
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
        self.number.unwrap_or_else(|| (self.axis.parameter().get)(settings))
    }

    /// Puts it into options; `settings` are those without.
    pub(super) fn put(self, method: &mut MethodArgs, settings: &Settings) {
        let Some(number) = self.number else { return };
        let parameter = self.axis.parameter();
        (parameter.put)(method, number);
        // In smaller voxels the paper's spheres would shrink, too, and come apart. In larger ones they must grow.
        let follows_voxel_size = choices(method).preset.unwrap_or_default().follows_voxel_size();
        let is_finer = parameter.name == "h" && number < settings.voxel_size;
        if follows_voxel_size && is_finer && method.surface.radius_min.is_none() {
            method.surface.radius_min = Some(short(settings.radius_min));
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
        self.number(settings) == (self.axis.parameter().get)(settings)
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
    use crate::cli::args::PresetChoice;
    use crate::surface::options::{Choices, Preset};

    fn settings() -> Settings {
        Settings::paper(0.1, &Choices::default()).expect("sound")
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
        let granular =
            Choices { preset: Some(Preset::Granular), radius_ratio: Some(1.4), ..Choices::default() };
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
            |method: &MethodArgs| Settings::resolve(&choices(method), Some(0.2.into())).expect("sound");
        let without = with(&MethodArgs::default());
        for axis in (0..PARAMETERS.len()).map(Axis) {
            let usual = (axis.parameter().get)(&without);
            let number = match axis.parameter().name {
                "offset" => -0.01,
                "redistance" => 2.0,
                _ if axis.parameter().counted.is_some() => 2.0 * usual,
                _ => short(1.01 * usual),
            };
            let mut method = MethodArgs::default();
            let value = Value { axis, number: Some(number) };
            value.put(&mut method, &without);
            assert_eq!((axis.parameter().get)(&with(&method)), number, "{axis}");
            assert!(value.is_without(&with(&method)) && !value.is_without(&without), "{axis}");
        }
    }

    fn voxel_size_of(number: f64) -> Value {
        Value { axis: Axis::named("h").expect("known"), number: Some(number) }
    }

    #[test]
    fn radii_stay_where_voxels_are_smaller_and_grow_where_they_are_larger() {
        let settings = settings();
        for (voxel_size, radius_min) in [(0.05, Some(0.1732)), (0.1, None), (0.2, None)] {
            let mut method = MethodArgs::default();
            method.first.preset = Some(PresetChoice::Paper);
            voxel_size_of(voxel_size).put(&mut method, &settings);
            assert_eq!((method.first.voxel_size, method.surface.radius_min), (Some(voxel_size), radius_min));
        }
        let mut method = MethodArgs::default();
        method.first.preset = Some(PresetChoice::Paper);
        method.surface.radius_min = Some(0.2);
        voxel_size_of(0.05).put(&mut method, &settings);
        assert_eq!(method.surface.radius_min, Some(0.2));
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
