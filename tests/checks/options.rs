//! Checks that the help, the example configuration and docs/options.md have the same options.

use std::collections::BTreeSet;

use tempfile::tempdir;

use crate::program::manual;
use crate::program::scene::meniscus;

#[test]
fn help_has_every_key_of_the_file() {
    let folder = tempdir().expect("a folder");
    let help = meniscus(folder.path(), &["watch", "--help"]);
    assert_eq!(help.status, 0);
    let example = include_str!("../../examples/meniscus.toml");
    let keys = example.lines().filter_map(|line| line.split_once(" = "));
    let keys: Vec<&str> =
        keys.map(|(key, _)| key.trim_start_matches('#')).filter(|key| !key.contains(' ')).collect();
    assert!(keys.len() > 30, "{keys:?}");
    for key in keys {
        let option = match key {
            "input" => "[DIR]...".to_owned(),
            "output" => "--out ".to_owned(),
            "formats" => "--format ".to_owned(),
            "obstacles" => "--obstacle ".to_owned(),
            "spray_formats" => "--spray-format ".to_owned(),
            key => format!("--{}", key.replace('_', "-")),
        };
        assert!(help.out.contains(&option), "the help lacks {option}");
    }
}

/// The tables in the docs have exactly the options of `convert`.
#[test]
fn the_docs_have_every_option() {
    let in_help: BTreeSet<String> = manual::options("convert").into_iter().collect();
    let docs = include_str!("../../docs/options.md");
    let rows = docs.lines().filter_map(|line| line.strip_prefix("| `--"));
    let in_docs: BTreeSet<String> =
        rows.filter_map(|row| row.split('`').next()).map(|name| format!("--{name}")).collect();
    assert!(in_help.len() > 30, "{in_help:?}");
    assert_eq!(in_docs, in_help);
}
