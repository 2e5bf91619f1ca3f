//! Down only: a module imports lower rows, never its own or a higher one.
//!
//! Whenever two modules want the same type, it moves one row down; that is the only way types are
//! shared.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The page that says which module is in which row: what it says is what is checked.
const ARCHITECTURE: &str = include_str!("../../docs/architecture.md");

/// The crate of the file formats is visible from here up.
const FORMATS_VISIBLE_FROM: u32 = 3;

#[test]
fn imports_go_down_only() {
    let rows = rows();
    let mut wrong = Vec::new();
    let files = source_files(Path::new(env!("CARGO_MANIFEST_DIR")).join("src"));
    for (module, path) in &files {
        if module == "lib" {
            continue;
        }
        let Some(&row) = rows.get(module.as_str()) else {
            wrong.push(format!("{}: the module `{module}` has no row", path.display()));
            continue;
        };
        let code = code(path);
        for import in imports(&code, path) {
            // A module may name itself: that is how its own files meet.
            let is_lower = import == *module || rows.get(&*import).is_none_or(|&imported| imported < row);
            if !is_lower {
                wrong.push(format!("{} (row {row}) imports {import}", path.display()));
            }
        }
        if row < FORMATS_VISIBLE_FROM && code.contains("meniscus_formats") {
            wrong.push(format!("{} (row {row}) imports the formats", path.display()));
        }
    }
    assert!(files.len() > 10, "the sources were not found");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// The rows of the table under "Layers": a number, the modules between `,` or `|`, two blanks, a remark.
fn rows() -> HashMap<&'static str, u32> {
    let table = ARCHITECTURE
        .split("## Layers")
        .nth(1)
        .and_then(|rest| rest.split("```").nth(1))
        .expect("a table of layers");
    let mut rows = HashMap::new();
    for line in table.lines() {
        let Some((number, rest)) = line.trim().split_once(' ') else { continue };
        let row = number.parse().expect("a row begins with its number");
        let modules = rest.trim().split("  ").next().expect("modules follow the number");
        rows.extend(modules.split([',', '|']).map(|module| (module.trim(), row)));
    }
    assert!(rows.len() > 6, "the table of layers was not understood");
    rows
}

/// Every source file, and the top-level module it belongs to.
fn source_files(root: PathBuf) -> Vec<(String, PathBuf)> {
    let mut files = Vec::new();
    let mut folders = vec![root.clone()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).expect("the folder is there") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let within = path.strip_prefix(&root).expect("below the root");
                let first = within.components().next().expect("a name").as_os_str().to_string_lossy();
                files.push((first.trim_end_matches(".rs").to_owned(), path));
            }
        }
    }
    files
}

/// The file without its comments: documentation may point upwards.
fn code(path: &Path) -> String {
    let text = fs::read_to_string(path).expect("readable");
    text.lines().map(|line| line.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

/// The top-level modules that code names.
fn imports(code: &str, path: &Path) -> Vec<String> {
    let is_top = path.file_name().is_some_and(|name| name == "mod.rs")
        || path.parent().is_some_and(|folder| folder.ends_with("src"));
    let mut roots = vec!["crate::", "meniscus::"];
    if is_top && path.ancestors().nth(2).is_some_and(|folder| folder.ends_with("src")) {
        roots.push("super::");
    }
    let mut names = Vec::new();
    for root in roots {
        for (_, after) in code.match_indices(root).map(|(at, _)| code.split_at(at + root.len())) {
            match after.strip_prefix('{') {
                // use crate::{grid::Field, mesh}
                Some(group) => names.extend(group_heads(group)),
                None => names.push(identifier(after)),
            }
        }
    }
    names
}

/// The first word of each entry of a braced group, nested groups left out.
fn group_heads(group: &str) -> Vec<String> {
    let mut heads = vec![identifier(group.trim_start())];
    let mut depth = 1;
    for (at, letter) in group.char_indices() {
        match letter {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 1 => heads.push(identifier(group[at + 1..].trim_start())),
            _ => {}
        }
        if depth == 0 {
            break;
        }
    }
    heads
}

fn identifier(text: &str) -> String {
    text.chars().take_while(|letter| letter.is_alphanumeric() || *letter == '_').collect()
}

#[test]
fn imports_are_found() {
    let code = "use crate::mesh::Mesh;\nuse crate::{grid::{Field, Leaf}, skin};\nlet x = crate::report::X;";
    assert_eq!(imports(code, Path::new("src/a/b.rs")), ["mesh", "grid", "skin", "report"]);
    assert_eq!(imports("use super::mesh;", Path::new("src/a/mod.rs")), ["mesh"]);
    assert_eq!(imports("use super::mesh;", Path::new("src/a/b.rs")), [""; 0]);
}
