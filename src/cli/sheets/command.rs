//! The command line for a cell of a sheet of `meniscus tune`: it converts all frames of INPUT with the cell's
//! options.

use std::path::Path;

use meniscus_formats::UpAxis;

use crate::cli::args::TuneArgs;
use crate::cli::wording::option_name;
use crate::surface::options::MethodOptions;

/// The words of a command, each quoted for the shell.
pub(super) struct CommandLine {
    words: Vec<String>,
    /// The same words with abbreviated paths.
    short_words: Vec<String>,
}

impl CommandLine {
    /// The command that converts the inputs of `tune` with these options. The output folder, the obstacles
    /// and the up axis are those given to `tune`.
    pub(super) fn convert(
        TuneArgs { inputs, out, pictures, .. }: &TuneArgs,
        options: &MethodOptions,
    ) -> CommandLine {
        let mut line = CommandLine { words: Vec::new(), short_words: Vec::new() };
        line.add("meniscus");
        line.add("convert");
        inputs.iter().for_each(|input| line.add_path(input));
        line.add("--out");
        line.add_path(out);
        for (name, value) in options.to_pairs() {
            match name {
                "quads" if value == "true" => line.add("--quads"),
                // The values of these options are optional, so they must follow a =.
                "quads" | "smooth_normals" => line.add(&format!("{}={value}", option_name(name))),
                _ => line.add_option(name, &value),
            }
        }
        for obstacle in &pictures.method.obstacle {
            line.add("--obstacle");
            line.add_path(obstacle);
        }
        if pictures.up == Some(UpAxis::Z) {
            line.add_option("up", "z");
        }
        line
    }

    /// The whole command.
    pub(super) fn text(&self) -> String {
        self.words.join(" ")
    }

    /// The command with abbreviated paths.
    pub(super) fn short_text(&self) -> String {
        self.short_words.join(" ")
    }

    fn add(&mut self, word: &str) {
        self.words.push(quoted(word));
        self.short_words.push(quoted(word));
    }

    fn add_option(&mut self, name: &str, value: &str) {
        let option = option_name(name);
        // A value that begins with a hyphen must follow a =.
        if value.starts_with('-') {
            return self.add(&format!("{option}={value}"));
        }
        self.add(&option);
        self.add(value);
    }

    fn add_path(&mut self, path: &Path) {
        let text = path.to_string_lossy();
        // A path that begins with a hyphen needs a leading `./`.
        let text = if text.starts_with('-') { format!("./{text}") } else { text.into_owned() };
        self.words.push(quoted(&text));
        self.short_words.push(quoted(&abbreviated(&text, path)));
    }
}

/// A path, abbreviated to its last component if it is long.
fn abbreviated(text: &str, path: &Path) -> String {
    match path.file_name() {
        Some(name) if text.chars().count() > PATH_LETTERS => format!(".../{}", name.to_string_lossy()),
        _ => text.to_owned(),
    }
}

/// Paths with more characters are abbreviated on sheets.
const PATH_LETTERS: usize = 40;

/// Quotes a word for the shell.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "-_./,:=+%@".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::args::{Cli, Command};
    use clap::Parser;

    #[test]
    fn words_are_quoted_for_the_shell() {
        for (word, expected) in [
            ("dam.0012.bgeo", "dam.0012.bgeo"),
            ("dam.####.bgeo", "'dam.####.bgeo'"),
            ("a b", "'a b'"),
            ("it's", r"'it'\''s'"),
            ("", "''"),
            ("größe.ply", "größe.ply"),
        ] {
            assert_eq!(quoted(word), expected);
        }
    }

    #[test]
    fn long_paths_are_abbreviated_on_sheets_only() {
        let long = "a/long/way/to/somewhere/that/nobody/knows/dam.####.bgeo";
        let typed = ["meniscus", "tune", long, "./-x.ply", "-o=s.png", "--out=my meshes", "--up=z"];
        let Command::Tune(args) = Cli::parse_from(typed).command else { panic!("another command") };
        let line = CommandLine::convert(
            &TuneArgs { inputs: vec![long.into(), "-x.ply".into()], ..*args },
            &MethodOptions {
                radius_ratio: Some(1.5),
                smooth_normals: Some(3),
                clip: "-1,0,0,1,1,1".parse().ok(),
                ..MethodOptions::default()
            },
        );
        let options = "--radius-ratio 1.5 --clip=-1,0,0,1,1,1 --smooth-normals=3 --up z";
        assert_eq!(line.text(), format!("meniscus convert '{long}' ./-x.ply --out 'my meshes' {options}"));
        let short = format!("meniscus convert '.../dam.####.bgeo' ./-x.ply --out 'my meshes' {options}");
        assert_eq!(line.short_text(), short);
    }
}
