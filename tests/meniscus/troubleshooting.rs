//! The page of symptoms quotes the program: each message in it is one that the program has.

use std::fs;
use std::path::Path;

const PAGE: &str = include_str!("../../docs/troubleshooting.md");

/// Shorter pieces are found anywhere.
const PIECE_MIN: usize = 4;

#[test]
fn every_message_that_is_quoted_is_one_of_the_program() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let program = [root.join("src"), root.join("formats/src")].map(|folder| messages_below(&folder)).concat();
    let quoted = quoted(PAGE);
    assert!(quoted.len() > 60, "only {} messages were found", quoted.len());
    let pieces =
        quoted.iter().flat_map(|message| message.split('…').map(move |piece| (message, piece.trim())));
    let unknown: Vec<&str> = pieces
        .filter(|(_, piece)| piece.len() >= PIECE_MIN && !program.contains(piece))
        .map(|(message, _)| *message)
        .collect();
    assert!(unknown.is_empty(), "the program does not say so: {unknown:#?}");
}

/// What stands between backticks in the tables and is neither a command nor an option.
fn quoted(page: &str) -> Vec<&str> {
    let rows = page.lines().filter(|line| line.starts_with('|'));
    let code = rows.flat_map(|row| row.split('`').skip(1).step_by(2));
    code.filter(|text| text.contains(' ') && !text.starts_with("--") && !text.starts_with("meniscus "))
        .collect()
}

/// All sources below a folder without their tests and comments; text that goes on in the next line is one.
fn messages_below(folder: &Path) -> String {
    let mut text = String::new();
    for entry in fs::read_dir(folder).expect("the folder is there") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            text += &messages_below(&path);
        } else if path.extension().is_some_and(|extension| extension == "rs") && !path.ends_with("tests.rs") {
            text += &said_in(&fs::read_to_string(&path).expect("readable"));
        }
    }
    text
}

/// What a source says when it runs.
fn said_in(source: &str) -> String {
    let source = source.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
    let code = source.lines().filter(|line| !line.trim_start().starts_with("//"));
    code.fold(String::new(), |text, line| match text.strip_suffix('\\') {
        Some(begun) => format!("{begun}{}", line.trim_start()),
        None => text + "\n" + line,
    })
}

#[test]
fn messages_are_found() {
    let source = "/// Said.\nf(\"one \\\n    two\"); g()\n    // never\n#[cfg(test)]\nmod tests {\nthree";
    assert_eq!(said_in(source), "\nf(\"one two\"); g()");
    let page =
        "Words `like this`.\n| `it is … not` | `--set 1` | `meniscus info F`, `done` and `all gone` |\n";
    assert_eq!(quoted(page), ["it is … not", "all gone"]);
}
