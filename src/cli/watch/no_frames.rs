//! Why a watched folder has no frames to convert.

use std::fs;
use std::path::Path;

use glob::Pattern;

use crate::cli::render_session::level_sets_in;
use crate::cli::wording::pluralize;
use crate::pipeline::{FrameFile, files_in};
use crate::watch::selection::FileFilter;
use crate::watch::{Watch, names_level_sets};

/// The reasons that are known, to follow "there are no frames to convert"; empty if there are none.
pub(super) fn reasons(watches: &[Watch]) -> String {
    let mut reasons = Vec::new();
    for watch in watches {
        let Some(reason) = reason(watch).or_else(|| unwatched_folders(watch)) else { continue };
        reasons.push(match watches {
            [_] => reason,
            _ => format!("{}: {reason}", watch.input.display()),
        });
    }
    if reasons.is_empty() { String::new() } else { format!(": {}", reasons.join("; ")) }
}

fn reason(watch: &Watch) -> Option<String> {
    let level_sets = level_sets_in(&watch.input);
    let Some(pattern) = &watch.pattern else { return level_sets_left_alone(level_sets.len()) };
    let filter = FileFilter::new(Some(pattern), Vec::new()).ok()?;
    let is_taken = |file: &FrameFile| filter.takes(&watch.input, &file.path);
    if names_level_sets(Some(pattern)) {
        // Level sets of other programs would be frames.
        let own_count = level_sets.iter().filter(|file| is_taken(file)).count();
        if own_count > 0 {
            let own = pluralize(own_count, "level set");
            return Some(format!("{own} left alone: results that meniscus wrote are not inputs"));
        }
    } else {
        let is_meant = |file: &&FrameFile| {
            Pattern::new(pattern).is_ok_and(|pattern| pattern.matches(&name_of(&file.path)))
        };
        let left = level_sets_left_alone(level_sets.iter().filter(is_meant).count());
        if left.is_some() {
            return left;
        }
    }
    // Files in sub-folders are not counted here.
    let files = if pattern.contains('/') { Vec::new() } else { files_in(&watch.input).unwrap_or_default() };
    if files.is_empty() || files.iter().any(|path| filter.takes(&watch.input, path)) {
        return None;
    }
    let hint = match Pattern::new(&pattern.to_lowercase()) {
        _ if pattern.contains(['{', '}']) => {
            "; braces have no meaning in a pattern: watch each pattern separately"
        }
        Ok(lower) if files.iter().any(|path| lower.matches(&name_of(path).to_lowercase())) => {
            "; capital and small letters differ"
        }
        _ => "",
    };
    Some(format!("none of the {} in this folder matches {pattern}{hint}", pluralize(files.len(), "file")))
}

/// The sub-folders that are not watched.
fn unwatched_folders(watch: &Watch) -> Option<String> {
    let entries = fs::read_dir(&watch.input).into_iter().flatten().flatten();
    let is_hidden = |path: &Path| name_of(path).starts_with('.');
    let folders = entries.map(|entry| entry.path()).filter(|path| path.is_dir() && !is_hidden(path));
    let count = folders.filter(|path| *path != watch.outputs.folder).count();
    let folders = pluralize(count, "sub-folder");
    (count > 0).then(|| format!("it has {folders}, which are not watched: give --pattern '**'"))
}

fn level_sets_left_alone(count: usize) -> Option<String> {
    let level_sets = pluralize(count, "level set");
    (count > 0).then(|| {
        format!(
            "{level_sets} left alone; --pattern '*.vdb' selects level sets, except those that meniscus wrote"
        )
    })
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}
