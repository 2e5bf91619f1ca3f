//! The macro that defines a struct of options: one place for everything about an option.
//!
//! ```text
//!   Surface {                              the heading in --help, and the group of the option
//!       /// Fill enclosed cavities …       the help, and the documentation of the field
//!       #[arg(value_name = "VOXELS")]      what else the command line shows
//!       fill_cavities: f64 in 0.0..=1e6,   the name, on the command line, in files and here; type and range
//!       radius_scale: f64
//!           => [OptionName::new("radius_attribute")],   the options of which it needs one to have an effect,
//!           |options, _| …,                and whether one is given
//!   }
//! ```

use std::fmt::{Display, LowerExp};
use std::ops::RangeInclusive;
use std::str::FromStr;

/// The group of an option.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OptionGroup {
    /// Preset and scale.
    General,
    /// Radii, and edits of the level set.
    Surface,
    /// Sizes and shapes of particles, and their attributes.
    Particles,
    /// Obstacles.
    Obstacles,
    /// Mesh.
    Mesh,
    /// Smoothing.
    Solver,
}

/// How the value of an option is written in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ValueKind {
    /// A number in world units, or text with a unit: a [`Length`](super::Length).
    Length,
    /// A number, with a decimal point or without.
    Number,
    /// A whole number.
    Count,
    /// `true` or `false`.
    Switch,
    /// Text in quotes.
    Text,
}

/// The name of an option in a message, or that of an option with a value. Each front end has its own
/// spelling: `--anisotropy neighbors`, or `anisotropy="neighbors"` in Python.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OptionName {
    /// The name of its field, or `obstacle`, which only the command line has as an option.
    pub name: &'static str,
    /// The value that the message is about.
    pub value: Option<&'static str>,
}

impl OptionName {
    /// An option with any value.
    pub const fn new(name: &'static str) -> OptionName {
        OptionName { name, value: None }
    }

    /// An option with this value.
    pub const fn with_value(name: &'static str, value: &'static str) -> OptionName {
        OptionName { name, value: Some(value) }
    }

    /// The spelling of the command line.
    pub fn flag(self) -> String {
        let flag = format!("--{}", self.name.replace('_', "-"));
        self.value.map_or(flag.clone(), |value| format!("{flag} {value}"))
    }
}

/// What an option needs to have an effect.
#[derive(Debug)]
pub struct Need<Options: 'static> {
    /// The options of which one has to be given.
    pub any_of: &'static [OptionName],
    /// Whether one is given. The arguments are the options, and whether there are obstacles.
    pub(super) is_met: fn(&Options, bool) -> bool,
}

/// The description of an option, without its value.
#[derive(Debug)]
pub struct OptionInfo<Options: 'static> {
    /// The name of its field, and its key in files. The command line has hyphens instead of underscores.
    pub name: &'static str,
    /// Its group.
    pub group: OptionGroup,
    /// How its value is written.
    pub kind: ValueKind,
    /// What else must be set for it to have an effect; `None` if nothing.
    pub need: Option<Need<Options>>,
}

/// The value of an option. Its text on the command line, in journals and in plans parses as the same value.
pub trait OptionValue: Display + FromStr {
    /// How it is written in a file.
    const KIND: ValueKind = ValueKind::Text;
}

impl OptionValue for f64 {
    const KIND: ValueKind = ValueKind::Number;
}

impl OptionValue for u32 {
    const KIND: ValueKind = ValueKind::Count;
}

impl OptionValue for bool {
    const KIND: ValueKind = ValueKind::Switch;
}

impl OptionValue for String {}

impl OptionGroup {
    /// The heading of the group in `--help`; `None` for the first.
    pub fn heading(self) -> Option<&'static str> {
        match self {
            OptionGroup::General => None,
            OptionGroup::Surface => Some("Surface"),
            OptionGroup::Particles => Some("Particles"),
            OptionGroup::Obstacles => Some("Obstacles"),
            OptionGroup::Mesh => Some("Mesh"),
            OptionGroup::Solver => Some("Solver"),
        }
    }
}

/// A range as text, without long runs of zeros.
pub(super) fn range_text<T: Display + LowerExp>(range: &RangeInclusive<T>) -> String {
    let bound = |bound: &T| match bound.to_string() {
        text if text.starts_with("0.000") || text.ends_with("00000000") => format!("{bound:e}"),
        text => text,
    };
    format!("{} to {}", bound(range.start()), bound(range.end()))
}

/// Returns the parsed `value` of an option; if there is none, the error message, in the form that all options
/// use: `text` is not `what`.
#[cfg(feature = "cli")]
pub(crate) fn expected<T>(text: &str, value: Option<T>, what: impl Display) -> Result<T, String> {
    value.ok_or_else(|| format!("`{text}` is not {what}"))
}

/// Parses a value within a range, for the command line.
#[cfg(feature = "cli")]
pub(crate) fn ranged<T>(
    range: RangeInclusive<T>,
) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static
where
    T: FromStr + PartialOrd + Display + LowerExp + Clone + Send + Sync + 'static,
{
    move |text| {
        let value = text.trim().parse().ok().filter(|value| range.contains(value));
        let noun = if "0.5".parse::<T>().is_ok() { "number" } else { "whole number" };
        expected(text, value, format_args!("a {noun} from {}", range_text(&range)))
    }
}

/// What an option needs, if anything.
macro_rules! need {
    () => {
        None
    };
    ($any_of:expr, $is_met:expr) => {
        Some(fields::Need { any_of: &$any_of, is_met: $is_met })
    };
}
pub(super) use need;

/// Defines [`MethodOptions`](super::MethodOptions), and everything that applies to all options.
macro_rules! method_options {
    (
        $(#[$attribute:meta])*
        pub struct $options:ident {
            $($group:ident {
                $($(#[doc = $help:literal])+ $(#[arg($($arg:tt)*)])? $name:ident: $value:ident $(in $range:expr)? $(=> $need:expr, $is_met:expr)?,)+
            })+
        }
    ) => {
        $(#[$attribute])*
        #[derive(Clone, Debug, Default, PartialEq)]
        #[cfg_attr(feature = "cli", derive(clap::Args))]
        #[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
        #[cfg_attr(feature = "serde", serde(default, deny_unknown_fields))]
        pub struct $options {
            $($(
                $(#[doc = $help])+
                #[cfg_attr(feature = "cli", arg(
                    long,
                    help_heading = OptionGroup::$group.heading(),
                    allow_negative_numbers = true,
                    $(value_parser = fields::ranged::<$value>($range),)?
                    $($($arg)*)?
                ))]
                #[cfg_attr(feature = "serde", serde(skip_serializing_if = "Option::is_none"))]
                pub $name: Option<$value>,
            )+)+
        }

        impl $options {
            /// All options, in the order of `--help` and of files.
            pub const ALL: &'static [OptionInfo<$options>] = &[$($(OptionInfo {
                name: stringify!($name),
                group: OptionGroup::$group,
                kind: <$value as OptionValue>::KIND,
                need: fields::need!($($need, $is_met)?),
            },)+)+];

            /// These options; those that are not set come from `below`.
            pub fn over(self, below: $options) -> $options {
                $options { $($($name: self.$name.or(below.$name),)+)+ }
            }

            /// The options that are set, as text by name.
            pub fn to_pairs(&self) -> Pairs {
                let pairs = [$($((stringify!($name), self.$name.as_ref().map(ToString::to_string)),)+)+];
                pairs.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
            }

            /// Sets the option with this name; `None` if it does not exist or the text is not a value of it.
            pub fn set(&mut self, name: &str, text: &str) -> Option<()> {
                match name {
                    $($(stringify!($name) => self.$name = Some(text.parse().ok()?),)+)+
                    _ => return None,
                }
                Some(())
            }

            /// The range of an option, such as `0 to 4`, if its definition has one.
            pub fn range(name: &str) -> Option<String> {
                match name {
                    $($($(stringify!($name) => Some(fields::range_text::<$value>(&$range)),)?)+)+
                    _ => None,
                }
            }

            /// Checks every option whose definition has a range.
            pub(super) fn check_ranges(&self) -> Result<(), SettingsError> {
                $($($(
                    let range: RangeInclusive<$value> = $range;
                    if let Some(value) = self.$name && !range.contains(&value) {
                        return Err(out_of_range(stringify!($name), value, &range));
                    }
                )?)+)+
                Ok(())
            }
        }
    };
}
pub(super) use method_options;
