//! The macro that defines a struct of options: one place for everything about an option.
//!
//! ```text
//!   Surface {                              the heading in --help, and the group of the option
//!       /// Fill enclosed cavities …       the help, and the documentation of the field
//!       #[value(named("VOXELS"))]          how the command line writes its value
//!       fill_cavities: f64 in 0.0..=1e6,   the name, on the command line, in files and here; type and range
//!       radius_scale: f64
//!           => [OptionName::new("radius_attribute")],   the options of which it needs one to have an effect,
//!           |options, _| …,                and whether one is given
//!   }
//! ```

use std::fmt::{Display, LowerExp};
use std::ops::RangeInclusive;
use std::str::FromStr;

use crate::words::Word;

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

/// How the command line writes the value of an option.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ValueSyntax {
    /// The value in the help, such as `LENGTH`.
    pub name: &'static str,
    /// Whether the text of a value may begin with a hyphen and not be a number, such as `-0.3d`.
    pub may_begin_with_hyphen: bool,
    /// The value if the option is given without one. Other values then follow an equals sign.
    pub if_omitted: Option<&'static str>,
}

impl ValueSyntax {
    /// A value with this name.
    pub(super) const fn named(name: &'static str) -> ValueSyntax {
        ValueSyntax { name, may_begin_with_hyphen: false, if_omitted: None }
    }

    pub(super) const fn signed(self) -> ValueSyntax {
        ValueSyntax { may_begin_with_hyphen: true, ..self }
    }

    pub(super) const fn or_omitted(self, value: &'static str) -> ValueSyntax {
        ValueSyntax { if_omitted: Some(value), ..self }
    }
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
    /// How the command line writes its value.
    pub syntax: ValueSyntax,
    /// The words that it accepts, each with its help; empty if its values are not words.
    pub words: &'static [Word],
    /// What else must be set for it to have an effect; `None` if nothing.
    pub need: Option<Need<Options>>,
    /// The lines of its help. An empty line separates paragraphs.
    pub(super) help: &'static [&'static str],
    /// Checks that a text is a value of the option, in its range.
    pub(super) check: fn(&str) -> Result<(), String>,
}

impl<Options: 'static> OptionInfo<Options> {
    /// Its help, a string for each paragraph.
    pub fn help(&self) -> Vec<String> {
        let paragraphs = self.help.split(|line| line.trim().is_empty());
        let text = |lines: &[&str]| lines.iter().map(|line| line.trim()).collect::<Vec<_>>().join(" ");
        paragraphs.map(text).collect()
    }

    /// Whether this text is a value of the option, in its range.
    ///
    /// # Errors
    /// A message with the text, and with the valid values.
    pub fn check(&self, text: &str) -> Result<(), String> {
        (self.check)(text)
    }
}

/// The value of an option. Its text on the command line and in records parses as the same value.
pub trait OptionValue: Display + FromStr {
    /// How it is written in a file.
    const KIND: ValueKind = ValueKind::Text;
    /// The words that are values; empty if values are not words.
    const WORDS: &'static [Word] = &[];

    /// The value with this text.
    ///
    /// # Errors
    /// A message with the text, and with the expected form.
    fn parsed(text: &str) -> Result<Self, String>;
}

impl OptionValue for f64 {
    const KIND: ValueKind = ValueKind::Number;

    fn parsed(text: &str) -> Result<f64, String> {
        expected(text, text.trim().parse().ok(), "a number")
    }
}

impl OptionValue for u32 {
    const KIND: ValueKind = ValueKind::Count;

    fn parsed(text: &str) -> Result<u32, String> {
        expected(text, text.trim().parse().ok(), "a whole number of at least 0")
    }
}

impl OptionValue for bool {
    const KIND: ValueKind = ValueKind::Switch;

    fn parsed(text: &str) -> Result<bool, String> {
        expected(text, text.parse().ok(), "true or false")
    }
}

impl OptionValue for String {
    fn parsed(text: &str) -> Result<String, String> {
        Ok(text.to_owned())
    }
}

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
pub fn expected<T>(text: &str, value: Option<T>, what: impl Display) -> Result<T, String> {
    value.ok_or_else(|| format!("`{text}` is not {what}"))
}

/// The name of a field without the `r#` of a name that is a keyword of Rust.
pub(super) const fn unraw(name: &str) -> &str {
    match name.as_bytes() {
        [b'r', b'#', ..] => name.split_at(2).1,
        _ => name,
    }
}

/// Parses a value within a range, for the command line.
pub fn ranged<T>(
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

/// The parser of an option's text: the option's own, or that of its range, or that of its type.
macro_rules! parser {
    ($value:ident, $parser:expr) => {
        $parser
    };
    ($value:ident) => {
        <$value as OptionValue>::parsed
    };
    ($value:ident in $range:expr) => {
        fields::ranged::<$value>($range)
    };
}
pub(super) use parser;

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
                $(
                    $(#[doc = $help:literal])+
                    #[value($syntax:ident($value_name:literal) $(.$modifier:ident($($argument:literal)?))*)]
                    $(#[parser($parser:expr)])?
                    $name:ident: $value:ident $(in $range:expr)? $(=> $need:expr, $is_met:expr)?,
                )+
            })+
        }
    ) => {
        $(#[$attribute])*
        #[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct $options {
            $($(
                $(#[doc = $help])+
                #[serde(skip_serializing_if = "Option::is_none")]
                pub $name: Option<$value>,
            )+)+
        }

        impl $options {
            /// All options, in the order of `--help` and of files.
            pub const ALL: &'static [OptionInfo<$options>] = &[$($(OptionInfo {
                name: fields::unraw(stringify!($name)),
                group: OptionGroup::$group,
                kind: <$value as OptionValue>::KIND,
                syntax: fields::ValueSyntax::$syntax($value_name)$(.$modifier($($argument)?))*,
                words: <$value as OptionValue>::WORDS,
                need: fields::need!($($need, $is_met)?),
                help: &[$($help),+],
                check: |text| fields::parser!($value $(in $range)? $(, $parser)?)(text).map(|_| ()),
            },)+)+];

            /// These options; those that are not set come from `below`.
            pub fn over(self, below: $options) -> $options {
                $options { $($($name: self.$name.or(below.$name),)+)+ }
            }

            /// The options that are set, as text by name.
            pub fn to_pairs(&self) -> Pairs {
                let pairs = [$($(
                    (fields::unraw(stringify!($name)), self.$name.as_ref().map(ToString::to_string)),
                )+)+];
                pairs.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
            }

            /// Sets the option with this name. The range of the value is not checked.
            ///
            /// # Errors
            /// A message if no option has this name, or if the text is not a value of it.
            pub fn set(&mut self, name: &str, text: &str) -> Result<(), String> {
                $($(
                    if name == fields::unraw(stringify!($name)) {
                        self.$name = Some(fields::parser!($value $(, $parser)?)(text)?);
                        return Ok(());
                    }
                )+)+
                Err(format!("unknown option `{name}`"))
            }

            /// The range of an option, such as `0 to 4`, if its definition has one.
            pub fn range(name: &str) -> Option<String> {
                match name {
                    $($($(stringify!($name) => Some(fields::range_text::<$value>(&$range)),)?)+)+
                    _ => None,
                }
            }

            /// Checks every option whose definition has a range.
            ///
            /// # Errors
            /// The first value that is out of its range.
            pub fn check_ranges(&self) -> Result<(), SettingsError> {
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
