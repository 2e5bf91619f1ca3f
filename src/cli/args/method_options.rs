//! The options of the method as arguments, built from their descriptions in the library.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches};

use super::OptionSet;
use crate::surface::options::{MethodOptions, OptionInfo, ValueKind};
use crate::surface::words::Word;

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
            let word = |word: &'static Word| PossibleValue::new(word.name).help(word.help);
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
