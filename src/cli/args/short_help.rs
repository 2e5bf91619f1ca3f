//! What `-h` shows of the commands with very many options: those of an ordinary day. `--help` shows all.

use std::ffi::OsString;

use clap::{Arg, CommandFactory, FromArgMatches};

use super::Cli;

/// The options that `-h` shows, and in which words.
pub(super) const ORDINARY: [(&str, &str); 24] = [
    ("out", "Folder for the results"),
    ("config", "File with folders and settings"),
    ("once", "Convert the existing frames, and exit"),
    ("pattern", "Only files with names such as 'dam.*.bgeo'"),
    ("format", "Formats to write, separated by commas [default: glb,vdb]"),
    ("frames", "Only these frames, such as 1-240x2 or 1-10,20"),
    ("skip_done", "Skip frames that are done with the same input and settings"),
    ("shard", "Only part K of N of the frames, for farms"),
    ("preset", "Defaults for a kind of particles [default: fluid]"),
    ("spacing", "Distance between neighbouring particles [default: measured]"),
    ("voxel_size", "Voxel edge length [default: 0.32d]"),
    ("up", "Axis of the particles that points up [default: y]"),
    ("preview", "Also write a picture of each frame"),
    ("stage", "Write a USD stage that plays the frames"),
    ("fps", "Frames per second of the animation [default: 24]"),
    ("blend", "Distance up to which particles blend [default: 1.7d]"),
    ("spray", "Write pieces of fewer particles than this as points"),
    ("where", "Only particles that meet this condition, such as 'phase == 0'"),
    ("radius_attribute", "Attribute with each particle's own radius, such as pscale"),
    ("attributes", "Attributes for the surface, such as velocity,Cd, or all"),
    ("temporal", "Average each surface with N frames before and after it"),
    ("obstacle", "Mesh or level set that the surface must not enter"),
    ("threads", "Number of threads [default: all cores]"),
    ("memory", "Memory limit, such as 8GiB [default: half of the machine's]"),
];

/// Parses a command line.
///
/// # Errors
/// The usage or the help, as [`clap::Parser::try_parse_from`] returns them.
pub(in crate::cli) fn parse(
    words: impl IntoIterator<Item = impl Into<OsString> + Clone>,
) -> Result<Cli, clap::Error> {
    let mut program = Cli::command();
    for name in ["convert", "watch"] {
        program = program.mut_subcommand(name, |command| command.mut_args(for_short_help));
    }
    Cli::from_arg_matches(&program.try_get_matches_from(words)?)
}

fn for_short_help(arg: Arg) -> Arg {
    let id = arg.get_id().as_str();
    let ordinary = ORDINARY.iter().find(|(ordinary, _)| *ordinary == id);
    let whole = arg.get_long_help().or(arg.get_help()).cloned();
    match (ordinary, whole) {
        _ if arg.is_positional() => arg,
        (Some((_, words)), Some(whole)) => arg.help(*words).long_help(whole),
        _ => arg.hide_short_help(true),
    }
}
