//! `meniscus man` and `meniscus completions`: generate man pages and shell completions from the command
//! line's definition.
//!
//! The installed program generates both, so they always match its version, and no copies have to be
//! maintained.
//!
//! A page has the usual sections, and those that the help prints below the options:
//!
//! ```text
//!   Exit status:                          .SH EXIT STATUS
//!     0    no frame has failed     →      .nf
//!     1    some frames have failed        0    no frame has failed
//! ```
//!
//! Pages contain no date, so that the same program always writes the same bytes.

use std::path::Path;

use anyhow::Result;
use clap::CommandFactory;
use clap_mangen::Man;
use clap_mangen::roff::{Roff, roman};

use super::CommandOutcome;
use super::args::{Cli, CompletionsArgs, ManArgs};
use super::console::Console;
use super::destination::{OutFolder, write_file};

/// The name of the command, and the first part of the pages' names.
const PROGRAM: &str = "meniscus";

/// Prints the completions for a shell.
///
/// # Errors
/// If the generated text is not UTF-8.
pub(super) fn completions(args: &CompletionsArgs, console: &mut Console) -> Result<CommandOutcome> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), PROGRAM, &mut script);
    console.print_raw(&String::from_utf8(script)?);
    Ok(CommandOutcome::Done)
}

/// Writes a page for the program, and one for each command.
///
/// # Errors
/// If the folder cannot be created, or a page cannot be written.
pub(super) fn man(args: &ManArgs) -> Result<CommandOutcome> {
    let folder = OutFolder::make(&args.out)?;
    let mut program = Cli::command().disable_help_subcommand(true);
    program.build();
    write_page(program.clone(), &args.out)?;
    for command in program.get_subcommands() {
        write_page(command.clone(), &args.out)?;
    }
    folder.keep();
    Ok(CommandOutcome::Done)
}

/// Writes the page of one command: `meniscus convert` is in `meniscus-convert.1`.
fn write_page(command: clap::Command, folder: &Path) -> Result<()> {
    let usage = command.clone().render_usage().to_string();
    let name = command.get_display_name().unwrap_or(PROGRAM).to_owned();
    let more = command.get_after_long_help().map(ToString::to_string);
    let has_commands = command.has_subcommands();
    let man = Man::new(command);

    let mut page = title(&name).into_bytes();
    man.render_name_section(&mut page)?;
    synopsis(&usage).to_writer(&mut page)?;
    man.render_description_section(&mut page)?;
    man.render_options_section(&mut page)?;
    if has_commands {
        man.render_subcommands_section(&mut page)?;
    } else {
        sections(more.as_deref().unwrap_or_default()).to_writer(&mut page)?;
        see_also().to_writer(&mut page)?;
    }

    let path = folder.join(man.get_filename());
    let page = without_doubled_breaks(&String::from_utf8(page)?);
    write_file(&path, |out| out.write_all(page.as_bytes()))
}

/// The title line with an empty date. The generator would omit an empty date, and the next field would take
/// its place.
fn title(name: &str) -> String {
    let version = env!("CARGO_PKG_VERSION");
    format!(".TH {} 1 \"\" \"{PROGRAM} {version}\" \"{PROGRAM} manual\"\n", name.to_uppercase())
}

/// The synopsis: the usage line of the help, because a list of all options would be longer than the
/// descriptions that follow.
fn synopsis(usage: &str) -> Roff {
    let mut roff = Roff::new();
    roff.control("SH", ["SYNOPSIS"]);
    roff.text([roman(usage.trim_start_matches("Usage: "))]);
    roff
}

/// The sections below the options in the help: lines that are not indented and end with a colon are titles;
/// the lines that follow stay as they are.
fn sections(text: &str) -> Roff {
    let mut roff = Roff::new();
    let mut is_open = false;
    for line in text.lines() {
        let title = line.strip_suffix(':').filter(|title| !title.starts_with(' '));
        if is_open && title.is_some() {
            roff.control("fi", []);
        }
        match title {
            Some(title) => roff.control("SH", [title.to_uppercase().as_str()]).control("nf", []),
            None => roff.text([roman(line.strip_prefix("  ").unwrap_or(line))]),
        };
        is_open = true;
    }
    if is_open {
        roff.control("fi", []);
    }
    roff
}

fn see_also() -> Roff {
    let mut roff = Roff::new();
    roff.control("SH", ["SEE ALSO"]);
    roff.text([roman(format!("{PROGRAM}(1)"))]);
    roff
}

/// Corrects two faults of the generator. Between the paragraphs of an option it writes an empty line between
/// two line breaks, which gives three breaks. It also ends lines with blanks.
fn without_doubled_breaks(page: &str) -> String {
    let lines: Vec<&str> = page.lines().map(str::trim_end).collect();
    let page = lines.join("\n").replace(".br\n\n.br\n", ".sp\n");
    page + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sections_below_options_keep_their_lines() {
        let page = sections("Exit status:\n  0    good\n  1    bad\n\nJSON:\n    deep").to_roff();
        assert_eq!(
            page.lines().filter(|line| !line.is_empty()).collect::<Vec<_>>(),
            [
                ".SH \"EXIT STATUS\"",
                ".nf",
                "0    good",
                "1    bad",
                ".fi",
                ".SH JSON",
                ".nf",
                "  deep",
                ".fi"
            ]
        );
    }

    #[test]
    fn doubled_line_breaks_are_merged() {
        assert_eq!(without_doubled_breaks("a \n.br\n\n.br\nb\n"), "a\n.sp\nb\n");
    }
}
