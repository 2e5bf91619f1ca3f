//! File names with a placeholder for a number: `dam.####.bgeo`, `dam.%04d.bgeo`, `dam.{:04}.bgeo`, `dam.{}.bgeo`.
//!
//! ```text
//!   ####   0012  10012  -012  -0012       4 digits or more; the width of printf includes the sign, that of
//!                                         others does not
//!   {}     12  0012  -12  0.05  0001.50   any number: also a time, or a frame with its subframe
//! ```

use std::fs;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::frame_number::{is_number, may_precede_sign};

/// A file name with a placeholder for the frame number.
#[derive(Debug, PartialEq, Eq)]
pub struct NumberPattern<'a> {
    /// The text before the number.
    pub before: &'a str,
    /// The text after the number.
    pub after: &'a str,
    /// The minimum number of digits: shorter numbers are padded with zeros.
    pub width_min: usize,
}

impl<'a> NumberPattern<'a> {
    /// Finds the last `####`, `%04d`, `%d`, `{:04}` or `{}` of a name; the rest of the name is literal.
    pub fn find(name: &'a str) -> Option<NumberPattern<'a>> {
        (0..name.len()).rev().filter(|&start| name.is_char_boundary(start)).find_map(|start| {
            let (length, width_min) = placeholder_at(&name[start..])?;
            let before = name[..start].trim_end_matches('#');
            // If the placeholder is a #, the search found the last # of a run, and `before` ends where that
            // run begins. Other placeholders do not use it.
            let run = start - before.len();
            let is_hashes = name[start..].starts_with('#');
            let (before, width_min) =
                if is_hashes { (before, width_min + run) } else { (&name[..start], width_min) };
            Some(NumberPattern { before, after: &name[start + length..], width_min })
        })
    }

    /// Like [`find`](Self::find), but a lone `#` is a letter of the name.
    pub fn find_in_new(name: &'a str) -> Option<NumberPattern<'a>> {
        NumberPattern::find(name)
            .filter(|found| found.width_min > 1 || !name[found.before.len()..].starts_with('#'))
    }

    /// The name with this number, padded to the minimum width as printf does.
    pub fn name_of(&self, number: i64) -> String {
        let width = self.width_min;
        format!("{}{number:0width$}{}", self.before, self.after)
    }

    /// The file in a folder that has this number: the one with the name of [`name_of`](Self::name_of) if it
    /// exists. Otherwise, if the number can be padded in other ways, the first by name of the files that have
    /// it. `None` if there is none.
    ///
    /// # Errors
    /// When the folder cannot be listed.
    pub fn file_of(&self, folder: &Path, number: i64) -> io::Result<Option<PathBuf>> {
        let padded = folder.join(self.name_of(number));
        let may_exist = may_be_file(&padded);
        if self.width_min > 1 && number >= 0 || may_exist {
            return Ok(may_exist.then_some(padded));
        }
        let is_it = |path: &PathBuf| {
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            let digits = self.span_in(name).and_then(|span| name.get(span));
            digits.and_then(|digits| digits.parse().ok()) == Some(number)
        };
        Ok(files_in(folder)?.into_iter().filter(is_it).min())
    }

    /// The range of the number in a matching name.
    pub fn span_in(&self, name: &str) -> Option<Range<usize>> {
        let number = name.strip_prefix(self.before)?.strip_suffix(self.after)?;
        let digits = number.strip_prefix('-').filter(|_| may_precede_sign(self.before)).unwrap_or(number);
        let is_whole = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
        // Padded to the width, and wider only if the number has more digits.
        let has_width =
            |width: usize| width == self.width_min || width > self.width_min && !digits.starts_with('0');
        let matches = match self.width_min {
            0 | 1 => is_whole || !digits.starts_with('-') && is_number(digits),
            _ => is_whole && (has_width(number.len()) || has_width(digits.len())),
        };
        matches.then(|| self.before.len()..self.before.len() + number.len())
    }
}

/// The length of the placeholder at the start of the text, and the minimum width of its number.
fn placeholder_at(text: &str) -> Option<(usize, usize)> {
    if text.starts_with("{}") {
        return Some((2, 1));
    }
    if text.starts_with('#') {
        return Some((1, 1));
    }
    let (format, ends): (&str, &[&str]) = match text.strip_prefix("{:") {
        Some(format) => (format, &["}", "d}"]),
        None => (text.strip_prefix('%')?, &["d"]),
    };
    let digit_count = format.bytes().take_while(u8::is_ascii_digit).count();
    let width = match &format[..digit_count] {
        "" => 1,
        digits => digits.strip_prefix('0')?.parse().ok()?,
    };
    let end = ends.iter().find(|end| format[digit_count..].starts_with(**end))?;
    Some((text.len() - format.len() + digit_count + end.len(), width))
}

/// The files in a folder that are not hidden; see [`may_be_file`].
///
/// # Errors
/// When the folder cannot be listed.
pub fn files_in(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let listed = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let mut files = Vec::new();
    for entry in fs::read_dir(listed)? {
        let name = entry?.file_name();
        let path = folder.join(&name);
        if !name.as_encoded_bytes().starts_with(b".") && may_be_file(&path) {
            files.push(path);
        }
    }
    Ok(files)
}

/// Whether a path is a regular file, or something of unknown type: a dangling link, or a path for which
/// `stat` fails with an error other than ENOENT and ENOTDIR, such as EACCES, EIO or ESTALE. Opening a path of
/// unknown type fails with the same error, so a frame with this path is reported and not skipped. The result
/// is false only if the path does not exist, or is known to be something else.
pub fn may_be_file(path: &Path) -> bool {
    match path.metadata() {
        Ok(metadata) => metadata.is_file(),
        Err(error) => !is_absent(path, &error),
    }
}

/// Whether an error of `stat` means that no file has this name. A dangling link is a file with this name.
pub fn is_absent(path: &Path, error: &io::Error) -> bool {
    let is_missing =
        |error: &io::Error| matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory);
    is_missing(error) && path.symlink_metadata().is_err_and(|error| is_missing(&error))
}

/// Whether a path cannot be resolved because of a loop of links.
#[cfg(unix)]
pub fn is_link_loop(error: &io::Error) -> bool {
    error.raw_os_error() == Some(rustix::io::Errno::LOOP.raw_os_error())
}

/// Whether a path cannot be resolved because of a loop of links.
#[cfg(windows)]
pub fn is_link_loop(error: &io::Error) -> bool {
    const ERROR_CANT_RESOLVE_FILENAME: i32 = 1921;
    error.raw_os_error() == Some(ERROR_CANT_RESOLVE_FILENAME)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn last_placeholder_is_the_frame() {
        for (name, before, after, width_min) in [
            ("dam.####.bgeo", "dam.", ".bgeo", 4),
            ("dam.#.bgeo", "dam.", ".bgeo", 1),
            ("dam.%04d.bgeo", "dam.", ".bgeo", 4),
            ("dam.%d.bgeo", "dam.", ".bgeo", 1),
            ("dam.{}.bgeo", "dam.", ".bgeo", 1),
            ("take#2.{}.ply", "take#2.", ".ply", 1),
            ("{}####", "{}", "", 4),
            ("##_%03d_ü.ply", "##_", "_ü.ply", 3),
        ] {
            assert_eq!(NumberPattern::find(name), Some(NumberPattern { before, after, width_min }), "{name}");
        }
        for name in ["dam.ply", "100%.ply", "%4d.ply", "%x.ply", "{.ply", ""] {
            assert_eq!(NumberPattern::find(name), None, "{name}");
        }
    }

    #[test]
    fn file_of_a_number_may_be_padded_in_several_ways() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["a.0007.ply", "a.-001.ply", "a.-0002.ply", "a.3.ply"] {
            fs::write(folder.path().join(name), "").expect("written");
        }
        for (pattern, number, expected) in [
            ("a.####.ply", 7, Some("a.0007.ply")),
            ("a.####.ply", -1, Some("a.-001.ply")),
            ("a.####.ply", -2, Some("a.-0002.ply")),
            ("a.####.ply", 3, None),
            ("a.{}.ply", 3, Some("a.3.ply")),
            ("a.{}.ply", 7, Some("a.0007.ply")),
            ("a.{}.ply", -2, Some("a.-0002.ply")),
        ] {
            let found = NumberPattern::find(pattern).expect(pattern).file_of(folder.path(), number);
            assert_eq!(found.expect("a folder"), expected.map(|name| folder.path().join(name)), "{number}");
        }
    }

    #[test]
    fn numbers_match_as_printf_formats_them() {
        let matches = |pattern, name| NumberPattern::find(pattern).and_then(|p| p.span_in(name)).is_some();
        for (pattern, name, expected) in [
            ("a.####.ply", "a.0012.ply", true),
            ("a.####.ply", "a.10012.ply", true),
            ("a.####.ply", "a.00012.ply", false),
            ("a.####.ply", "a.012.ply", false),
            ("a.%02d.ply", "a.7.ply", false),
            ("a.{}.ply", "a.7.ply", true),
            ("a.{}.ply", "a.0007.ply", true),
            ("a.{}.ply", "a..ply", false),
            ("a.{}.ply", "a.-7.ply", true),
            ("a{}.ply", "a-7.ply", false),
            ("a-{}.ply", "a-7.ply", true),
            ("a.{}.ply", "a.--7.ply", false),
            ("a.####.ply", "a.-012.ply", true),
            ("a.####.ply", "a.-0012.ply", true),
            ("a.####.ply", "a.-12.ply", false),
            ("a.####.ply", "a.-00012.ply", false),
            ("a.###.ply", "a.-001.ply", true),
            ("a_{}.ply", "a_0.05.ply", true),
            ("a_{}.ply", "a_1e-05.ply", true),
            ("a_####.ply", "a_0.05.ply", false),
            ("a.{}.ply", "a.1.2.3.ply", false),
            ("a.{}.ply", "b.7.ply", false),
            ("1{}1", "11", false),
            ("1{}1", "1", false),
            ("1{}1", "131", true),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern} {name}");
        }
    }
}
