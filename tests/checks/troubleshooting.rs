//! Checks that every message quoted in docs/troubleshooting.md is a message of the program.

use std::fs;
use std::path::Path;

const PAGE: &str = include_str!("../../docs/troubleshooting.md");

/// Minimum length of a piece of a message to search for: shorter pieces occur everywhere.
const PIECE_MIN: usize = 4;

#[test]
fn every_quoted_message_exists_in_the_source() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let program = ["src", "formats/src", "surface/src", "render/src"]
        .map(|folder| messages_below(&root.join(folder)))
        .concat();
    let quoted = quoted(PAGE);
    assert!(quoted.len() > 40, "only {} messages were found", quoted.len());
    let pieces =
        quoted.iter().flat_map(|message| message.split('…').map(move |piece| (message, piece.trim())));
    let unknown: Vec<&str> = pieces
        .filter(|(_, piece)| piece.len() >= PIECE_MIN && !program.contains(piece))
        .map(|(message, _)| *message)
        .collect();
    assert!(unknown.is_empty(), "quoted messages that no source contains: {unknown:#?}");
}

/// The texts in backticks in tables that are neither commands nor options.
fn quoted(page: &str) -> Vec<&str> {
    let rows = page.lines().filter(|line| line.starts_with('|'));
    let code = rows.flat_map(|row| row.split('`').skip(1).step_by(2));
    code.filter(|text| text.contains(' ') && !text.starts_with("--") && !text.starts_with("meniscus "))
        .collect()
}

/// The string literals of all sources below a folder, without tests.
fn messages_below(folder: &Path) -> String {
    let mut text = String::new();
    for entry in fs::read_dir(folder).expect("the folder exists") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            text += &messages_below(&path);
        } else if path.extension().is_some_and(|extension| extension == "rs") && !path.ends_with("tests.rs") {
            text += &literals_of(&fs::read_to_string(&path).expect("readable"));
        }
    }
    text
}

/// The string literals of a source, each on a line; a literal that continues on the next line of the source
/// is joined.
fn literals_of(source: &str) -> String {
    let source = source.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
    let mut text_of_message = String::new();
    let mut rest = source;
    while let Some(start) = rest.find(['"', '\'', '/', 'r']) {
        let (before, from) = rest.split_at(start);
        rest = if from.starts_with("//") {
            from.split_once('\n').map_or("", |(_, after)| after)
        } else if let Some(after) = from.strip_prefix("'\"'").or(from.strip_prefix("'\\\"'")) {
            after
        } else if let Some(text) = from.strip_prefix('"') {
            text_of_message.push('\n');
            unescaped(text, &mut text_of_message)
        } else if let Some((text, after)) = raw(from).filter(|_| !before.ends_with(is_identifier_char)) {
            text_of_message += &format!("\n{text}");
            after
        } else {
            &from[1..]
        };
    }
    text_of_message
}

/// Appends the text up to the closing quote, and returns the rest.
fn unescaped<'s>(text: &'s str, text_of_message: &mut String) -> &'s str {
    let mut characters = text.chars();
    while let Some(character) = characters.next() {
        match character {
            '"' => return characters.as_str(),
            '\\' => match characters.next() {
                Some('\n') => characters = characters.as_str().trim_start().chars(),
                Some('n') => text_of_message.push('\n'),
                other => text_of_message.extend(other),
            },
            _ => text_of_message.push(character),
        }
    }
    ""
}

/// The text of a raw string literal, and the rest of the source.
fn raw(from: &str) -> Option<(&str, &str)> {
    let after = from.strip_prefix('r')?;
    let opened = after.trim_start_matches('#');
    let end = format!("\"{}", &after[..after.len() - opened.len()]);
    opened.strip_prefix('"')?.split_once(&*end)
}

fn is_identifier_char(character: char) -> bool {
    character.is_alphanumeric() || character == '_'
}

#[test]
fn messages_are_found() {
    let source = "/// \"Said\".\nf(\"one \\\n    two\"); g('\"', 5 / 3, \"a \\\"b\\\"\")\n    // \"never\"\nh(r#\"c\"d\"#, r\"\\e\", for\"f\")\n#[cfg(test)]\nmod tests {\n\"g\"";
    assert_eq!(literals_of(source), "\none two\na \"b\"\nc\"d\n\\e\nf");
    let page =
        "Words `like this`.\n| `it is … not` | `--set 1` | `meniscus info F`, `done` and `all gone` |\n";
    assert_eq!(quoted(page), ["it is … not", "all gone"]);
}
