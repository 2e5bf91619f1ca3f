//! Finds which files import which: resolves the `use` declarations and the paths in the code of a crate to
//! the files that define the named items.
//!
//! This is not a compiler: it only splits text into words, and leaves out comments and strings. It follows
//! re-exports, so that `use super::Frame` leads to the file that defines `Frame` instead of the file that
//! re-exports it.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Which code to examine.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Code {
    /// All code.
    All,
    /// Without code that is compiled only for tests.
    WithoutTests,
}

/// A crate: its modules by their paths, `["surface", "grid"]`.
pub(super) struct Crate {
    modules: BTreeMap<Vec<String>, Module>,
}

/// One file.
struct Module {
    file: PathBuf,
    /// The names that the file brings into scope, and the paths of their items; `*` for all names of another
    /// module.
    names: Vec<(String, Vec<String>)>,
    /// The paths of all items outside the file that it names.
    paths: BTreeSet<Vec<String>>,
    /// The words of its code.
    words: Vec<String>,
}

impl Crate {
    /// Reads all files below a folder.
    ///
    /// # Panics
    ///
    /// If a file cannot be read.
    pub(super) fn read(root: &Path, code: Code) -> Crate {
        let mut files = Vec::new();
        files_below(root, &mut files);
        let texts = files.into_iter().map(|file| {
            let text = fs::read_to_string(root.join(&file)).expect("readable");
            (file, text)
        });
        Crate::of(texts.collect(), code)
    }

    /// The crate of these files: paths below its root, and their text.
    pub(super) fn of(files: Vec<(PathBuf, String)>, code: Code) -> Crate {
        let mut modules: BTreeMap<_, _> = files
            .into_iter()
            .map(|(file, text)| {
                let module = Module { words: words(&text), file, names: Vec::new(), paths: BTreeSet::new() };
                (module_path(&module.file), module)
            })
            .collect();
        if code == Code::WithoutTests {
            let test_modules: Vec<_> =
                modules.iter().flat_map(|(path, module)| test_modules(path, &module.words)).collect();
            modules.retain(|path, _| !test_modules.iter().any(|tests| path.starts_with(tests)));
        }
        let paths: Vec<_> = modules.keys().cloned().collect();
        for path in &paths {
            let words = std::mem::take(&mut modules.get_mut(path).expect("a key").words);
            let (names, named) = Reader { modules: &modules, words: &words, code }.read(path);
            let module = modules.get_mut(path).expect("a key");
            (module.names, module.paths, module.words) = (names, named, words);
        }
        Crate { modules }
    }

    /// The imports of each file: paths of the imported files below the root, and the text that names an item
    /// there.
    pub(super) fn imports(&self) -> BTreeMap<&Path, BTreeMap<&Path, String>> {
        let mut imports: BTreeMap<&Path, BTreeMap<&Path, String>> = BTreeMap::new();
        for module in self.modules.values() {
            let targets = imports.entry(&module.file).or_default();
            for path in &module.paths {
                let Some(target) = self.resolve(path, 0) else { continue };
                if target.file != module.file {
                    targets.entry(&target.file).or_insert_with(|| path.join("::"));
                }
            }
        }
        imports
    }

    /// The files that contain a word.
    pub(super) fn files_with(&self, word: &str) -> Vec<&Path> {
        let has_it = |module: &&Module| module.words.iter().any(|own| own == word);
        self.modules.values().filter(has_it).map(|module| &*module.file).collect()
    }

    /// The file that defines the item of a path; `None` for items of other crates.
    fn resolve(&self, path: &[String], depth: usize) -> Option<&Module> {
        // The longest prefix of the path that is a module.
        let length = (0..=path.len()).rev().find(|&length| self.modules.contains_key(&path[..length]))?;
        let module = &self.modules[&path[..length]];
        let Some(name) = path.get(length) else { return Some(module) };
        // Follow at most eight re-exports in a row: no path needs more.
        if depth < 8 && !module.defines(name) {
            let passed_on = module.names.iter().find(|(own, _)| own == name);
            if let Some((_, target)) = passed_on {
                return self.resolve(target, depth + 1).or(Some(module));
            }
            let globs = module.names.iter().filter(|(own, _)| own == "*");
            for (_, target) in globs {
                let through = self.resolve(&[&target[..], &path[length..=length]].concat(), depth + 1);
                if let Some(through) = through.filter(|through| through.defines(name)) {
                    return Some(through);
                }
            }
        }
        Some(module)
    }
}

impl Module {
    /// Whether an item of this name is defined here: by its first letters.
    fn defines(&self, name: &str) -> bool {
        const ITEMS: [&str; 9] =
            ["struct", "enum", "fn", "trait", "type", "const", "static", "union", "macro_rules"];
        self.words.windows(2).any(|pair| ITEMS.contains(&&*pair[0]) && pair[1] == name)
    }
}

/// The `.rs` files below a folder, in order, by their paths within it.
fn files_below(root: &Path, files: &mut Vec<PathBuf>) {
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).expect("the folder exists") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                files.push(path.strip_prefix(root).expect("below the root").to_owned());
            }
        }
    }
    files.sort();
}

/// `a/b.rs` and `a/b/mod.rs` are `["a", "b"]`; `lib.rs` is the root.
fn module_path(file: &Path) -> Vec<String> {
    let without_end = file.with_extension("");
    let mut parts: Vec<String> = without_end.iter().map(|part| part.to_string_lossy().into_owned()).collect();
    if parts.last().is_some_and(|last| last == "mod" || parts.len() == 1 && last == "lib") {
        parts.pop();
    }
    parts
}

/// The modules in separate files that are compiled only for tests.
fn test_modules(path: &[String], words: &[String]) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    for at in 0..words.len() {
        let Some(item) = after_test_attribute(words, at) else { continue };
        let named = words[item..].iter().skip_while(|word| *word != "mod").nth(1);
        if words.get(item + 2).is_some_and(|word| word == ";")
            || words.get(item + 3).is_some_and(|word| word == ";")
        {
            found.extend(named.map(|name| [path, std::slice::from_ref(name)].concat()));
        }
    }
    found
}

/// Where the item begins that an attribute `#[cfg(test)]` or `#[cfg(all(test, …))]` at this place leaves to
/// tests.
fn after_test_attribute(words: &[String], at: usize) -> Option<usize> {
    let is = |offset: usize, text: &str| words.get(at + offset).is_some_and(|word| word == text);
    if !(is(0, "#") && is(1, "[") && is(2, "cfg") && is(3, "(")) {
        return None;
    }
    if !(is(4, "test") || is(4, "all") && is(6, "test")) {
        return None;
    }
    let mut next = at;
    // Other attributes may follow.
    while words.get(next).is_some_and(|word| word == "#") {
        next = closing(words, next + 1) + 1;
    }
    Some(next)
}

/// Where the bracket that opens here is closed.
fn closing(words: &[String], opening: usize) -> usize {
    let mut depth = 0;
    for (at, word) in words.iter().enumerate().skip(opening) {
        match &**word {
            "(" | "[" | "{" => depth += 1,
            ")" | "]" | "}" => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return at;
        }
    }
    words.len()
}

/// The text after an item that begins here.
fn after_item(words: &[String], start: usize) -> usize {
    let mut at = start;
    while at < words.len() {
        match &*words[at] {
            ";" => return at + 1,
            "{" => return closing(words, at) + 1,
            "(" | "[" => at = closing(words, at) + 1,
            _ => at += 1,
        }
    }
    at
}

/// Goes through the words of a file.
struct Reader<'a> {
    modules: &'a BTreeMap<Vec<String>, Module>,
    words: &'a [String],
    code: Code,
}

type Names = Vec<(String, Vec<String>)>;

impl Reader<'_> {
    /// The names that the module brings into scope, and every path of this crate that it names.
    fn read(&self, path: &[String]) -> (Names, BTreeSet<Vec<String>>) {
        let (mut names, mut paths) = (Vec::new(), BTreeSet::new());
        // Modules within the file: their names, and where they end.
        let mut within: Vec<(String, usize)> = Vec::new();
        let mut at = 0;
        while at < self.words.len() {
            within.retain(|(_, end)| at < *end);
            let inner: Vec<String> =
                path.iter().chain(within.iter().map(|(name, _)| name)).cloned().collect();
            if let Some(item) = after_test_attribute(self.words, at)
                && self.code == Code::WithoutTests
            {
                at = after_item(self.words, item);
                continue;
            }
            match &*self.words[at] {
                "mod" if self.word(at + 2) == "{" => {
                    within.push((self.words[at + 1].clone(), closing(self.words, at + 2)));
                    at += 3;
                }
                // pub(in crate::surface)
                "pub" if self.word(at + 1) == "(" => at = closing(self.words, at + 1) + 1,
                "use" => {
                    let mut found = Vec::new();
                    self.use_tree(at + 1, &[], &mut found);
                    for (name, used) in found {
                        let Some(used) = self.absolute(&inner, &used) else { continue };
                        if within.is_empty() {
                            names.push((name, used.clone()));
                        }
                        paths.insert(used);
                    }
                    at = self.words[at..]
                        .iter()
                        .position(|word| word == ";")
                        .map_or(self.words.len(), |end| at + end);
                }
                _ if self.word(at + 1) == "::" && (at == 0 || self.word(at - 1) != "::") => {
                    let mut spelt = vec![self.words[at].clone()];
                    while self.word(at + 1) == "::" && is_identifier(self.word(at + 2)) {
                        spelt.push(self.words[at + 2].clone());
                        at += 2;
                    }
                    paths.extend(self.absolute(&inner, &spelt));
                    at += 1;
                }
                _ => at += 1,
            }
        }
        (names, paths)
    }

    fn word(&self, at: usize) -> &str {
        self.words.get(at).map_or("", |word| word)
    }

    /// The names and paths of a tree such as `a::{b, c as d, e::*}`, and the text after it.
    fn use_tree(&self, start: usize, prefix: &[String], found: &mut Names) -> usize {
        let mut path = prefix.to_vec();
        let mut at = start;
        loop {
            match self.word(at) {
                "{" => {
                    let end = closing(self.words, at);
                    at += 1;
                    while at < end {
                        at = self.use_tree(at, &path, found);
                        if self.word(at) == "," {
                            at += 1;
                        }
                    }
                    return end + 1;
                }
                "*" => {
                    found.push(("*".to_owned(), path));
                    return at + 1;
                }
                "::" => at += 1,
                "as" => {
                    let name = self.word(at + 1).to_owned();
                    found.push((name, path));
                    return at + 2;
                }
                word if is_identifier(word) => {
                    path.push(word.to_owned());
                    at += 1;
                }
                _ => {
                    // use a::{self}
                    if path.len() > 1 && path.last().is_some_and(|last| last == "self") {
                        path.pop();
                    }
                    if let Some(name) = path.last().cloned() {
                        found.push((name, path));
                    }
                    return at;
                }
            }
        }
    }

    /// A path from the root of the crate; none for other crates, and for names that are in scope already.
    fn absolute(&self, module: &[String], spelt: &[String]) -> Option<Vec<String>> {
        let mut base = module.to_vec();
        let mut rest = spelt;
        match &*spelt[0] {
            "crate" => (base, rest) = (Vec::new(), &spelt[1..]),
            "meniscus" if module == ["main"] => (base, rest) = (Vec::new(), &spelt[1..]),
            "self" => rest = &spelt[1..],
            "super" => {
                while rest.first().is_some_and(|word| word == "super") {
                    base.pop();
                    rest = &rest[1..];
                }
            }
            child => {
                base.push(child.to_owned());
                return self.modules.contains_key(&base).then(|| [module, spelt].concat());
            }
        }
        Some([&base, rest].concat())
    }
}

fn is_identifier(word: &str) -> bool {
    word.starts_with(|letter: char| letter.is_alphabetic() || letter == '_')
}

/// The words and signs of a text, without comments, strings and letters in quotes.
fn words(text: &str) -> Vec<String> {
    let letters: Vec<char> = text.chars().collect();
    let letter = |at: usize| letters.get(at).copied().unwrap_or('\0');
    let mut words = Vec::new();
    let mut at = 0;
    while at < letters.len() {
        let start = at;
        match letters[at] {
            '/' if letter(at + 1) == '/' => {
                while at < letters.len() && letters[at] != '\n' {
                    at += 1;
                }
            }
            '/' if letter(at + 1) == '*' => {
                at += 2;
                while at < letters.len() && !(letters[at - 1] == '*' && letters[at] == '/' && at > start + 2)
                {
                    at += 1;
                }
                at += 1;
            }
            '"' => at = after_string(&letters, at),
            // A letter in quotes; otherwise a lifetime.
            '\'' if letter(at + 1) == '\\' || letter(at + 2) == '\'' => {
                at += 2 + usize::from(letter(at + 1) == '\\');
                while at < letters.len() && letters[at] != '\'' {
                    at += 1;
                }
                at += 1;
            }
            'r' | 'b' | 'c' if raw_string_end(&letters, at).is_some() => {
                at = raw_string_end(&letters, at).unwrap_or(at + 1);
            }
            ':' if letter(at + 1) == ':' => {
                at += 2;
                words.push("::".to_owned());
            }
            one if one.is_alphanumeric() || one == '_' => {
                while letter(at).is_alphanumeric() || letter(at) == '_' {
                    at += 1;
                }
                words.push(letters[start..at].iter().collect());
            }
            other => {
                at += 1;
                if !other.is_whitespace() {
                    words.push(other.to_string());
                }
            }
        }
    }
    words
}

fn after_string(letters: &[char], opening: usize) -> usize {
    let mut at = opening + 1;
    while at < letters.len() && letters[at] != '"' {
        at += 1 + usize::from(letters[at] == '\\');
    }
    at + 1
}

/// The text after a string such as `r"…"`, `br#"…"#` or `b"…"`; `None` if no string begins here.
fn raw_string_end(letters: &[char], start: usize) -> Option<usize> {
    if start > 0 && (letters[start - 1].is_alphanumeric() || letters[start - 1] == '_') {
        return None;
    }
    let prefix_length =
        letters[start..].iter().take_while(|letter| matches!(letter, 'r' | 'b' | 'c')).count();
    let hashes = letters[start + prefix_length..].iter().take_while(|letter| **letter == '#').count();
    let quote = start + prefix_length + hashes;
    if prefix_length > 2 || letters.get(quote) != Some(&'"') {
        return None;
    }
    if !letters[start..start + prefix_length].contains(&'r') {
        return (hashes == 0).then(|| after_string(letters, quote));
    }
    let is_end = |at: usize| {
        letters[at] == '"' && letters[at + 1..].iter().take(hashes).filter(|l| **l == '#').count() == hashes
    };
    (quote + 1..letters.len()).find(|&at| is_end(at)).map(|end| end + 1 + hashes)
}
