//! The table of formats has a row for each kind of file that is told from others.

use std::collections::HashSet;

/// Names of what is no format.
const NO_FORMATS: [&str; 3] = ["empty file", "text of an unknown kind", "unknown binary file"];

#[test]
fn every_kind_has_a_row() {
    let source = include_str!("../../formats/src/probe.rs");
    let names = source.split_once("pub fn name(self)").expect("there").1;
    let names = names.split_once("\n    }\n").expect("its end").0;
    let name_of = |line: &str| Some(line.split_once("=> \"")?.1.split_once('"')?.0.to_owned());
    let names: Vec<String> = names.lines().filter_map(name_of).collect();
    assert!(names.len() > 20, "{names:?}");
    let table = include_str!("../../docs/formats.md");
    let rows = table.lines().filter_map(|line| line.strip_prefix("| "));
    let rows: Vec<Vec<&str>> = rows.map(|row| row.split('|').map(str::trim).collect()).collect();
    let first: HashSet<&str> = rows.iter().map(|row| row[0]).collect();
    for name in names.iter().filter(|name| !NO_FORMATS.contains(&&***name)) {
        assert!(first.contains(&**name), "docs/formats.md has no row for {name}");
        let row = rows.iter().find(|row| row[0] == name).expect("there");
        assert!(row.len() >= 7, "the row of {name}");
    }
}
