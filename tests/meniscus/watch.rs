//! The daemon's command: what it takes, and what it refuses before it begins.

use std::fs;
use std::path::Path;

use tempfile::tempdir;

use crate::scene::meniscus;

/// Asserts that a command does nothing, with exit status 2, and says why.
fn assert_refused(folder: &Path, arguments: &[&str], words: &[&str]) {
    let ran = meniscus(folder, &[&["watch"], arguments].concat());
    assert_eq!(ran.status, 2, "{arguments:?}: {} {}", ran.out, ran.err);
    for word in words {
        assert!(ran.err.contains(word), "{arguments:?} does not say {word}: {}", ran.err);
    }
}

#[test]
fn what_makes_no_sense_is_refused_before_anything_is_made() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let config = "# Settings\n[[watch]]\ninput = \"in\"\noutput = \"out\"\nvoxelsize = 0.1\n";
    fs::write(path.join("meniscus.toml"), config).expect("written");
    let words = ["error: meniscus.toml:5: unknown key `voxelsize`", "did you mean `voxel_size`?"];
    assert_refused(path, &["--config", "meniscus.toml"], &words);
    assert_refused(path, &["--config", "missing.toml"], &["cannot read missing.toml"]);
    assert_refused(path, &[], &["--out", "DIR"]);
    assert_refused(path, &["in"], &["--out"]);
    for (arguments, words) in [
        (&["--radius-ratio", "0.5"][..], &["in: the radius ratio is 0.5"][..]),
        (&["--settle", "1"], &["--settle", "no time"]),
        (&["--memory", "lots"], &["--memory", "no size"]),
        (&["--order", "random"], &["--order", "natural, latest"]),
        (&["--pattern", "[", "--recursive"], &["no glob"]),
    ] {
        assert_refused(path, &[&["in", "--out", "out"], arguments].concat(), words);
    }
    assert!(!path.join("out").exists());
}

#[test]
fn help_has_every_key_of_the_file() {
    let folder = tempdir().expect("a folder");
    let help = meniscus(folder.path(), &["watch", "--help"]);
    assert_eq!(help.status, 0);
    let example = include_str!("../../examples/meniscus.toml");
    let keys = example.lines().filter_map(|line| line.split_once(" = "));
    let keys: Vec<&str> =
        keys.map(|(key, _)| key.trim_start_matches('#')).filter(|key| !key.contains(' ')).collect();
    assert!(keys.len() > 30, "{keys:?}");
    for key in keys {
        let option = match key {
            "input" => "[DIR]...".to_owned(),
            "output" => "--out ".to_owned(),
            "formats" => "--format ".to_owned(),
            key => format!("--{}", key.replace('_', "-")),
        };
        assert!(help.out.contains(&option), "the help does not know {option}");
    }
}
