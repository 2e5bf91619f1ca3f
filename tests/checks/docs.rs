//! Checks the documentation: every link has a target, and every link to a test names an existing test.
//!
//! ```text
//!   [yes](../tests/program/sequence_files.rs "fn sequence_file_shows_each_frame_at_its_time")
//!         a file, relative to the page  a test in the file; `def` for a check in Python
//! ```

use std::fs;
use std::path::{Path, PathBuf};

/// The comparison with other programs, where every feature of this program names a test.
const COMPARISON: &str = "docs/compare.md";
const OURS: &str = "meniscus";

/// A link of a page: its target, and the title that a browser shows as a tooltip.
#[derive(Debug, PartialEq)]
struct Link<'text> {
    target: &'text str,
    title: Option<&'text str>,
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// README.md and all pages of `docs` and of the examples, with their text.
fn pages() -> Vec<(PathBuf, String)> {
    let folders =
        ["docs", "docs/results", "examples/blender", "examples/farm"].map(|folder| root().join(folder));
    let files = folders.iter().flat_map(|folder| fs::read_dir(folder).expect("the folder exists"));
    let files = files.map(|entry| entry.expect("an entry").path());
    let paths = files.filter(|path| path.extension().is_some_and(|extension| extension == "md"));
    let paths: Vec<PathBuf> = paths.chain([root().join("README.md")]).collect();
    assert!(paths.len() > 20, "{paths:?}");
    let read = |path: PathBuf| {
        let text = fs::read_to_string(&path).expect("readable");
        (path, text)
    };
    paths.into_iter().map(read).collect()
}

/// A page without its code, which may contain text that looks like a link.
fn prose(text: &str) -> String {
    let outside_blocks: String = text.split("```").step_by(2).collect();
    outside_blocks.split('`').step_by(2).collect()
}

/// All links of a text, except those to other sites.
fn links(text: &str) -> impl Iterator<Item = Link<'_>> {
    let inner = text.split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0));
    let links = inner.map(|inner| match inner.split_once(" \"") {
        Some((target, title)) => Link { target, title: Some(title.trim_end_matches('"')) },
        None => Link { target: inner, title: None },
    });
    links.filter(|link| !link.target.contains("://"))
}

/// The file and the heading that a link leads to.
fn target_of<'link>(page: &Path, target: &'link str) -> (PathBuf, Option<&'link str>) {
    let (file, heading) =
        target.split_once('#').map_or((target, None), |(file, heading)| (file, Some(heading)));
    let file = if file.is_empty() { page.to_owned() } else { page.with_file_name("").join(file) };
    (file, heading)
}

/// Whether a page has a heading with this anchor.
fn has_heading(text: &str, name: &str) -> bool {
    text.lines().filter(|line| line.starts_with('#')).any(|line| {
        let words = line.trim_start_matches('#').trim().to_lowercase().replace(' ', "-");
        words.chars().filter(|&c| c.is_alphanumeric() || "-_".contains(c)).eq(name.chars())
    })
}

#[test]
fn every_link_leads_to_an_existing_file_and_heading() {
    let mut wrong = Vec::new();
    let mut count = 0;
    for (page, text) in pages() {
        for Link { target, .. } in links(&prose(&text)) {
            let (file, heading) = target_of(&page, target);
            let exists = file.exists()
                && heading.is_none_or(|heading| {
                    has_heading(&fs::read_to_string(&file).expect("headings are in pages"), heading)
                });
            if !exists {
                wrong.push(format!("{}: {target}", page.display()));
            }
            count += 1;
        }
    }
    assert!(count > 50, "{count} links were found");
    assert!(wrong.is_empty(), "links without a target:\n{}", wrong.join("\n"));
}

#[test]
fn every_test_named_in_a_page_exists_and_runs() {
    let mut wrong = Vec::new();
    for (page, text) in pages() {
        for Link { target, title } in links(&prose(&text)) {
            let Some(title) = title else { continue };
            let (file, _) = target_of(&page, target);
            let is_run =
                fs::read_to_string(&file).is_ok_and(|source| has_test(&source, title)) && is_run(&file);
            if !is_run {
                wrong.push(format!("{}: {target} has no {title}", page.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Whether `tests/clients/run` runs a check in Python: it names checks by the part after `check_`.
fn is_run(file: &Path) -> bool {
    let name = file.file_stem().and_then(|stem| stem.to_str()?.strip_prefix("check_"));
    let checks = fs::read_to_string(root().join("tests/clients/run")).expect("readable");
    let all = checks.split("checks=(convert").nth(1).and_then(|rest| rest.split(')').next()).expect("a list");
    name.is_none_or(|name| name == "convert" || all.split_whitespace().any(|check| check == name))
}

/// Whether the source has this test in Rust (`fn name`), or this function in Python (`def name`): a test of
/// pytest, or one that the rest of its file calls.
fn has_test(source: &str, title: &str) -> bool {
    let lines: Vec<&str> = source.lines().map(str::trim_start).collect();
    let begins = format!("{title}(");
    let Some(index) = lines.iter().position(|line| line.starts_with(&begins)) else { return false };
    let above = lines[..index].iter().rev();
    let is_test = above.take_while(|line| line.starts_with("#[")).any(|line| *line == "#[test]");
    match title.split_once(' ') {
        Some(("fn", _)) => is_test,
        Some(("def", name)) => name.starts_with("test_") || source.matches(name).count() > 1,
        _ => false,
    }
}

/// In the comparison, every feature of this program links to its test.
#[test]
fn every_feature_in_the_comparison_links_to_a_test() {
    let text = fs::read_to_string(root().join(COMPARISON)).expect("readable");
    let cells = cells_of_ours(&text);
    assert!(cells.len() > 40, "{} cells were found", cells.len());
    let is_no = |cell: &str| cell.split(|c: char| !c.is_alphabetic()).next() == Some("no");
    let is_page = |link: &Link| link.target.split('#').next().is_some_and(|file| file.ends_with(".md"));
    let has_test = |cell: &str| {
        links(cell).any(|link| link.title.is_some())
            && links(cell).all(|link| link.title.is_some() || is_page(&link))
    };
    let wrong: Vec<&&str> = cells.iter().filter(|cell| !is_no(cell) && !has_test(cell)).collect();
    assert!(wrong.is_empty(), "cells without a link to a test: {wrong:#?}");
    assert!(cells.iter().any(|cell| is_no(cell)), "expected at least one cell with no");
}

/// The cells of the second column, in the tables where this column has our name.
fn cells_of_ours(text: &str) -> Vec<&str> {
    let mut is_ours = false;
    let mut cells = Vec::new();
    for line in text.lines() {
        let mut row = line.split('|').map(str::trim).skip(2);
        match row.next() {
            None => is_ours = false,
            Some(OURS) => is_ours = true,
            Some(cell) if is_ours && !cell.starts_with("---") => cells.push(cell),
            Some(_) => {}
        }
    }
    cells
}

#[test]
fn links_titles_and_tests_are_found() {
    let page = "See [one](a.md), [`two`](b.md#its-head \"fn x\"), `[no](c)`,\n```\n[nor](d)\n```\n[out](https://e.f)";
    let found = prose(page);
    let found: Vec<Link> = links(&found).collect();
    let one = Link { target: "a.md", title: None };
    assert_eq!(found, [one, Link { target: "b.md#its-head", title: Some("fn x") }]);
    let page = Path::new("/p/docs/q.md");
    assert_eq!(target_of(page, "b.md#its-head"), (PathBuf::from("/p/docs/b.md"), Some("its-head")));
    assert_eq!(target_of(page, "#here"), (page.to_owned(), Some("here")));
    assert!(
        has_heading("text\n## Its `head`, now\n", "its-head-now") && !has_heading("its-head", "its-head")
    );

    let source = "#[test]\n#[cfg(unix)]\nfn tested() {}\nfn used(by: u8) {}\n";
    assert!(has_test(source, "fn tested") && !has_test(source, "fn used") && !has_test(source, "fn test"));
    assert!(
        has_test("def checks(path):\nchecks(1)\n", "def checks") && !has_test("checks(path)\n", "checks")
    );
    assert!(!has_test("def checks(path):\n    check()\n", "def checks"));

    let tables = "| what | meniscus | x |\n|---|---|---|\n| a | yes | no |\n\n| what | other |\n|---|---|\n| b | c |\n";
    assert_eq!(cells_of_ours(tables), ["yes"]);
}
