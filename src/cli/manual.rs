//! `meniscus man` and `meniscus completions`: what the command line is, told to `man` and to shells.
//!
//! Both are made from the definition that arguments are read with, by the program itself: so they
//! are those of the program that is there, however it was installed, and nobody keeps copies.
//!
//! A page has the usual sections. What stands below the options in the help, it has too:
//!
//! ```text
//!   Exit status:                          .SH EXIT STATUS
//!     0    no frame has failed     →      .nf
//!     1    some frames have failed        0    no frame has failed
//! ```
//!
//! No page says when it was made: the same program writes the same bytes.

use std::path::Path;

use anyhow::Result;
use clap::CommandFactory;
use clap_mangen::Man;
use clap_mangen::roff::{Roff, roman};

use super::CommandOutcome;
use super::args::{Cli, CompletionsArgs, ManArgs};
use super::console::Console;
use super::out_folder::{OutFolder, write_file};

/// The name that is completed, and that pages begin with.
const PROGRAM: &str = "meniscus";

/// Prints the completions for a shell.
///
/// # Errors
/// When they are no text.
pub(super) fn completions(args: &CompletionsArgs, console: &mut Console) -> Result<CommandOutcome> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), PROGRAM, &mut script);
    console.say_as_is(&String::from_utf8(script)?);
    Ok(CommandOutcome::Done)
}

/// Writes a page for the program, and one for each of its commands.
///
/// # Errors
/// When the folder cannot be made, or a page cannot be written.
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

/// With an empty date, which the generator would leave out, and the rest would move into its place.
fn title(name: &str) -> String {
    let version = env!("CARGO_PKG_VERSION");
    format!(".TH {} 1 \"\" \"{PROGRAM} {version}\" \"{PROGRAM} manual\"\n", name.to_uppercase())
}

/// As in the help: a list of all options by name would be longer than what follows.
fn synopsis(usage: &str) -> Roff {
    let mut roff = Roff::new();
    roff.control("SH", ["SYNOPSIS"]);
    roff.text([roman(usage.trim_start_matches("Usage: "))]);
    roff
}

/// What stands below the options in the help: lines that are not indented and end with a colon are
/// titles; what follows keeps its lines.
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

/// Between paragraphs of an option the generator breaks the line before and after an empty one, which
/// breaks it as well; and it ends lines with blanks.
fn without_doubled_breaks(page: &str) -> String {
    let lines: Vec<&str> = page.lines().map(str::trim_end).collect();
    let page = lines.join("\n").replace(".br\n\n.br\n", ".sp\n");
    page + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_follows_the_options_keeps_its_lines() {
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
    fn breaks_come_one_at_a_time() {
        assert_eq!(without_doubled_breaks("a \n.br\n\n.br\nb\n"), "a\n.sp\nb\n");
    }
}
