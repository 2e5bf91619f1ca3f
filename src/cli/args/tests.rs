//! Checks that the documentation and the configuration file agree with the definition of the options.

use std::fmt::Write;

use clap::{Arg, CommandFactory};

use super::*;
use crate::surface::options::{MethodOptions, ValueKind};

/// The page with the generated tables: `MENISCUS_WRITE_DOCS=1 cargo test --lib cli::args` updates them.
const PAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/options.md");

fn options_of_convert() -> Vec<Arg> {
    let mut program = Cli::command();
    program.build();
    let convert = program.find_subcommand("convert").expect("a command");
    convert.get_arguments().filter(|option| option.get_id() != "help").cloned().collect()
}

/// The table of the options under a heading.
fn table(heading: Option<&str>) -> String {
    let mut table = "| option | value | what |\n|---|---|---|\n".to_owned();
    for option in options_of_convert().iter().filter(|option| option.get_help_heading() == heading) {
        let id = option.get_id().as_str();
        let name = match option.get_long() {
            Some(long) => format!("--{long}"),
            None => option.get_value_names().map_or(id.to_owned(), |names| names[0].to_string()),
        };
        let short = option.get_short().map_or(String::new(), |short| format!(", `-{short}`"));
        let words = option.get_possible_values();
        let value = match option.get_value_names() {
            _ if option.get_long().is_none() || !option.get_action().takes_values() => String::new(),
            _ if !words.is_empty() && !option.is_hide_possible_values_set() => {
                let names: Vec<String> = words.iter().map(|word| format!("`{}`", word.get_name())).collect();
                names.join(", ")
            }
            names => names.map_or(String::new(), |names| names[0].to_string()),
        };
        let help = option.get_help().map(ToString::to_string).unwrap_or_default();
        let what = help.split_whitespace().collect::<Vec<_>>().join(" ").replace('|', "\\|");
        writeln!(table, "| `{name}`{short} | {value} | {what} |").expect("text");
    }
    table
}

/// The page, with tables generated from the definition.
fn generated(page: &str) -> String {
    let mut written = String::new();
    let mut is_table = false;
    let mut heading = None;
    for line in page.lines() {
        if let Some(name) = line.strip_prefix("## ") {
            heading = Some(name);
        }
        let begins_table = line.starts_with("| option |");
        is_table = begins_table || (is_table && line.starts_with('|'));
        match heading {
            Some(name) if begins_table => {
                written += &table(Some(name).filter(|name| *name != "Input, output and scale"))
            }
            _ if is_table => {}
            _ => written += &format!("{line}\n"),
        }
    }
    written
}

#[test]
fn tables_in_docs_match_the_definition() {
    let mut page = std::fs::read_to_string(PAGE).expect("the page");
    let generated = generated(&page);
    if std::env::var_os("MENISCUS_WRITE_DOCS").is_some() {
        std::fs::write(PAGE, &generated).expect("written");
        page.clone_from(&generated);
    }
    assert!(page == generated, "docs/options.md differs from the definition: run with MENISCUS_WRITE_DOCS=1");
    for option in options_of_convert() {
        let name = option.get_long().unwrap_or("INPUT");
        assert!(page.contains(&format!("`--{name}`")) || name == "INPUT", "no {name} in docs/options.md");
    }
}

#[test]
fn help_states_ranges_and_units() {
    let options = options_of_convert();
    for info in MethodOptions::ALL {
        let option = options.iter().find(|option| option.get_id() == info.name).expect(info.name);
        let help = option.get_help().expect(info.name).to_string();
        if let Some(range) = MethodOptions::range(info.name) {
            assert!(help.contains(&range), "{}: {range}: {help}", info.name);
        }
        let value = option.get_value_names().expect(info.name)[0].as_str();
        assert_eq!(value == "LENGTH", info.kind == ValueKind::Length, "{}", info.name);
        assert_eq!(option.get_help_heading(), info.group.heading(), "{}", info.name);
    }
}

#[test]
fn lengths_have_units_on_the_command_line() {
    let parsed = |words: &[&str]| {
        let words = ["meniscus", "convert", "a.ply", "--out", "b"].iter().chain(words);
        let typed = Cli::try_parse_from(words).map_err(|error| error.to_string())?;
        match typed.command {
            Command::Convert(args) => Ok(args.method.to_options()),
            _ => Err("another command".to_owned()),
        }
    };
    let options = parsed(&[
        "--radius-min",
        "0.6d",
        "--offset",
        "-0.3d",
        "--neighbor-radius",
        "5h",
        "--voxel-size=0.5d",
    ]);
    let pairs = options.expect("lengths").to_pairs();
    let expected =
        [("voxel_size", "0.5d"), ("radius_min", "0.6d"), ("offset", "-0.3d"), ("neighbor_radius", "5h")];
    assert_eq!(pairs, expected.map(|(name, text)| (name, text.to_owned())));
    assert_eq!(parsed(&["--offset", "-1"]).expect("a length").offset, Some((-1.0).into()));
    for (words, why) in [
        (["--voxel-size", "2h"], "0.4d"),
        (["--radius-min", "5x"], "such as 0.6d"),
        (["--spacing", "1d"], "world units"),
        (["--decimate", "0.1h"], "from 0 to 1"),
    ] {
        let error = parsed(&words).expect_err("no such unit");
        assert!(error.contains(why) && error.contains(words[1]), "{error}");
    }
}

#[test]
fn short_help_shows_few_options_and_long_help_all() {
    let help = |words: &[&str]| parse(words).expect_err("help").to_string();
    for command in ["convert", "watch"] {
        let (short, long) = (help(&["meniscus", command, "-h"]), help(&["meniscus", command, "--help"]));
        assert!(short.lines().count() <= 48 && short.contains("--spacing"), "{short}");
        assert!(
            !short.contains("--redistance-every") && long.contains("--redistance-every"),
            "{short}{long}"
        );
    }
    let all = [help(&["meniscus", "convert", "-h"]), help(&["meniscus", "watch", "-h"])].concat();
    for (id, words) in short_help::ORDINARY {
        assert!(all.contains(&format!("--{} ", id.replace('_', "-"))), "{id}");
        assert!(words.len() <= 72, "{words}");
    }
}
