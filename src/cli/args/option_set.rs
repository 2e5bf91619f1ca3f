//! Operations on every struct of options: list the options that are given, and merge the options of the
//! command line with those of a file.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches};

use crate::surface::options::{MethodOptions, OptionInfo, ValueKind};
use crate::surface::words::Word;

/// Options that may be absent.
pub(in crate::cli) trait OptionSet: Sized {
    /// These options, and those of `below` where `self` has none.
    fn over(self, below: Self) -> Self;

    /// Adds the names of the options that are given, such as `up`; `name` is the name of the field that
    /// contains this option or set of options.
    fn add_given(&self, name: &'static str, given: &mut Vec<&'static str>);

    /// The names of the options that are given.
    fn given(&self) -> Vec<&'static str> {
        let mut given = Vec::new();
        self.add_given("", &mut given);
        given
    }
}

impl<T> OptionSet for Option<T> {
    fn over(self, below: Self) -> Self {
        self.or(below)
    }

    fn add_given(&self, name: &'static str, given: &mut Vec<&'static str>) {
        given.extend(self.is_some().then_some(name));
    }
}

impl<T> OptionSet for Vec<T> {
    fn over(self, below: Self) -> Self {
        if self.is_empty() { below } else { self }
    }

    fn add_given(&self, name: &'static str, given: &mut Vec<&'static str>) {
        given.extend((!self.is_empty()).then_some(name));
    }
}

impl OptionSet for bool {
    fn over(self, below: Self) -> Self {
        self || below
    }

    fn add_given(&self, name: &'static str, given: &mut Vec<&'static str>) {
        given.extend(self.then_some(name));
    }
}

/// Defines a struct of options, each a field with its help, and implements the operations on it.
macro_rules! option_set {
    (
        $(#[$attribute:meta])*
        $visibility:vis struct $name:ident {
            $($(#[$field_attribute:meta])* $field_visibility:vis $field:ident: $type:ty,)+
        }
    ) => {
        $(#[$attribute])*
        $visibility struct $name {
            $($(#[$field_attribute])* $field_visibility $field: $type,)+
        }

        impl $crate::cli::args::OptionSet for $name {
            fn over(self, below: $name) -> $name {
                $name { $($field: $crate::cli::args::OptionSet::over(self.$field, below.$field),)+ }
            }

            fn add_given(&self, _: &'static str, given: &mut Vec<&'static str>) {
                $($crate::cli::args::OptionSet::add_given(&self.$field, stringify!($field), given);)+
            }
        }
    };
}
pub(in crate::cli) use option_set;

// The options of the method as arguments, built from their descriptions in the library.

/// The options of the method that are given.
#[derive(Clone, Debug, Default, PartialEq)]
pub(in crate::cli) struct MethodOptionArgs(pub(in crate::cli) MethodOptions);

/// The text of a value that its option accepts.
#[derive(Clone, Debug)]
struct AcceptedText(String);

/// The argument of an option.
fn argument(info: &'static OptionInfo<MethodOptions>) -> Arg {
    let paragraphs = info.help();
    let mut argument = Arg::new(info.name)
        .long(info.name.replace('_', "-"))
        .help(paragraphs[0].clone())
        .help_heading(info.group.heading())
        .action(ArgAction::Set)
        .value_name(info.syntax.name)
        .allow_negative_numbers(true)
        .allow_hyphen_values(info.syntax.may_begin_with_hyphen);
    if paragraphs.len() > 1 {
        argument = argument.long_help(paragraphs.join("\n\n"));
    }
    if let Some(value) = info.syntax.if_omitted {
        argument = argument.num_args(0..=1).require_equals(true).default_missing_value(value);
    }
    match info.kind {
        ValueKind::Switch => {
            let words = PossibleValuesParser::new(["true", "false"]);
            argument.value_parser(words.map(AcceptedText)).hide_possible_values(true)
        }
        ValueKind::Text if !info.words.is_empty() => {
            let word = |word: &'static Word| {
                PossibleValue::new(word.name).aliases(word.others).help(word.full_help())
            };
            let words = PossibleValuesParser::new(info.words.iter().map(word));
            argument.value_parser(words.map(|word| AcceptedText(word.to_ascii_lowercase()))).ignore_case(true)
        }
        _ => {
            argument.value_parser(move |text: &str| info.check(text).map(|()| AcceptedText(text.to_owned())))
        }
    }
}

impl Args for MethodOptionArgs {
    fn augment_args(command: Command) -> Command {
        command.args(MethodOptions::ALL.iter().map(argument))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for MethodOptionArgs {
    fn from_arg_matches(matches: &ArgMatches) -> Result<MethodOptionArgs, clap::Error> {
        let mut options = MethodOptionArgs::default();
        options.update_from_arg_matches(matches)?;
        Ok(options)
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        for info in MethodOptions::ALL {
            if let Some(AcceptedText(text)) = matches.get_one(info.name) {
                self.0.set(info.name, text).expect("the parser of the argument accepted the text");
            }
        }
        Ok(())
    }
}

impl OptionSet for MethodOptionArgs {
    fn over(self, below: Self) -> Self {
        MethodOptionArgs(self.0.over(below.0))
    }

    fn add_given(&self, _: &'static str, given: &mut Vec<&'static str>) {
        given.extend(self.0.to_pairs().iter().map(|(name, _)| *name));
    }
}
