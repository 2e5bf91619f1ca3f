//! The man pages and shell completions have all commands and options of the command line, and no others.

use std::fs;

use tempfile::tempdir;

use crate::program::scene::{meniscus, names_in};

/// The commands that the help lists.
fn commands() -> Vec<String> {
    let folder = tempdir().expect("a folder");
    let help = meniscus(folder.path(), &["--help"]).out;
    let listed = help.split("Commands:\n").nth(1).expect("a list").split("\n\n").next().expect("its lines");
    // Lines that continue a description are indented farther.
    let entries =
        listed.lines().filter_map(|line| line.strip_prefix("  ")).filter(|line| !line.starts_with(' '));
    let names = entries.filter_map(|line| line.split_whitespace().next());
    let names: Vec<String> = names.filter(|name| *name != "help").map(str::to_owned).collect();
    assert!(names.len() > 5, "{names:?}");
    names
}

/// The options that the help of a command lists.
pub(crate) fn options(command: &str) -> Vec<String> {
    let folder = tempdir().expect("a folder");
    let help = meniscus(folder.path(), &[command, "--help"]).out;
    let lines = help.lines().map(str::trim_start);
    let starts = lines
        .map(|line| line.trim_start_matches("-o, ").trim_start_matches("-q, "))
        .filter(|line| line.starts_with("--"));
    let names = starts.filter_map(|line| line.split([' ', '[', '=']).next());
    names.map(str::to_owned).collect()
}

#[test]
fn every_command_has_a_page_with_every_option() {
    let folder = tempdir().expect("a folder");
    let result = meniscus(folder.path(), &["man", "--out", "share/man1"]);
    assert_eq!((result.status, &*result.out, &*result.err), (0, "", ""));
    let pages = folder.path().join("share/man1");
    let mut wanted: Vec<String> = commands().iter().map(|name| format!("meniscus-{name}.1")).collect();
    wanted.push("meniscus.1".to_owned());
    wanted.sort();
    assert_eq!(names_in(&pages), wanted);
    for command in commands() {
        let page = fs::read_to_string(pages.join(format!("meniscus-{command}.1"))).expect("a page");
        let page = page.replace("\\-", "-");
        assert!(page.contains(&format!("meniscus {command} ")), "{command}: no synopsis");
        for option in options(&command) {
            assert!(page.contains(&option), "the page of {command} does not know {option}");
        }
    }
    let page = fs::read_to_string(pages.join("meniscus-convert.1")).expect("a page");
    assert!(page.contains("\n.SH \"EXIT STATUS\"\n.nf\n0    every frame was converted"), "{page}");
}

#[test]
fn page_that_cannot_be_written_is_an_error() {
    let folder = tempdir().expect("a folder");
    fs::create_dir_all(folder.path().join("out/meniscus.1")).expect("a folder at the path");
    let result = meniscus(folder.path(), &["man", "--out", "out"]);
    assert_eq!(result.status, 2);
    assert!(result.err.contains("out/meniscus.1: cannot write"), "{}", result.err);
}

#[test]
fn completions_have_every_command() {
    let folder = tempdir().expect("a folder");
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let result = meniscus(folder.path(), &["completions", shell]);
        assert_eq!((result.status, &*result.err), (0, ""));
        for command in commands() {
            assert!(result.out.contains(&command), "{shell} does not hear of {command}");
        }
        assert!(result.out.contains("voxel-size"), "{shell} does not hear of options");
    }
    assert_eq!(meniscus(folder.path(), &["completions", "csh"]).status, 2);
}
