//! The keys of a configuration file: each is the name of an option.

use clap::{Arg, ArgAction, Args, Command};

/// A command line with these options only.
pub(super) fn command<O: Args>() -> Command {
    O::augment_args(Command::new("file").no_binary_name(true).disable_help_flag(true))
}

/// The keys of these options, in the order of their definition.
pub(super) fn keys<O: Args>() -> Vec<String> {
    command::<O>().get_arguments().map(key_of).collect()
}

/// The key of an option: its name, or the plural if it takes a list.
pub(super) fn key_of(option: &Arg) -> String {
    let plural = if is_list(option) { "s" } else { "" };
    format!("{}{plural}", option.get_id())
}

/// The current key of an option that had another one, which is a hidden alias of the option.
pub(super) fn renamed<O: Args>(former: &str) -> Option<String> {
    command::<O>().get_arguments().find(|option| has_former_key(option, former)).map(key_of)
}

pub(super) fn has_former_key(option: &Arg, key: &str) -> bool {
    option.get_all_aliases().is_some_and(|all| all.iter().any(|alias| alias.replace('-', "_") == key))
}

pub(super) fn is_list(option: &Arg) -> bool {
    matches!(option.get_action(), ArgAction::Append)
}
