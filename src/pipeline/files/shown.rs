//! Paths in messages. The standard input, or another pipe, is copied to a file before it is read; messages show
//! its name instead of the path of the copy.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// The name of the standard input in messages and reports.
pub const STANDARD_INPUT: &str = "standard input";

/// A file that is shown under another name.
static COPY: OnceLock<(PathBuf, String)> = OnceLock::new();

/// Sets the name of this file in all messages and reports of this process. Only the first call of a
/// process has an effect.
pub fn show_as(copy: &Path, name: &str) {
    COPY.get_or_init(|| (copy.to_owned(), name.to_owned()));
}

/// A path in a message or a report.
pub fn shown(path: &Path) -> impl fmt::Display {
    Displayed(path, COPY.get())
}

struct Displayed<'a>(&'a Path, Option<&'a (PathBuf, String)>);

impl fmt::Display for Displayed<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Displayed(path, copy) = self;
        match copy.and_then(|(copy, name)| Some((name, path.strip_prefix(copy).ok()?))) {
            Some((name, within)) if within.as_os_str().is_empty() => f.write_str(name),
            Some((name, within)) => write!(f, "{name}/{}", within.display()),
            None => path.display().fmt(f),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copy_of_the_standard_input_and_its_steps_are_shown_as_such() {
        let copy = ("/tmp/copy/stdin.ply".into(), STANDARD_INPUT.to_owned());
        for (path, expected) in [
            ("/tmp/copy/stdin.ply", "standard input"),
            ("/tmp/copy/stdin.ply/step=7", "standard input/step=7"),
            ("/tmp/copy/other.ply", "/tmp/copy/other.ply"),
        ] {
            assert_eq!(Displayed(Path::new(path), Some(&copy)).to_string(), expected);
        }
    }
}
