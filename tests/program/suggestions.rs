//! Unknown options: misspelt ones, and those of other commands.

use tempfile::tempdir;

use crate::program::scene::meniscus;

#[test]
fn misspelt_option_is_refused_with_a_suggestion() {
    let folder = tempdir().expect("a folder");
    for (typed, meant) in [
        (&["convert", "a.ply", "--ouput", "o"][..], "'--out'"),
        (&["convert", "a.ply", "--output=o"], "'--out'"),
        (&["watch", "in", "--outptu", "o"], "'--out'"),
        (&["convert", "a.ply", "--upp", "z"], "'--up'"),
        (&["convert", "a.ply", "--presett", "water"], "'--preset'"),
        (&["tune", "a.ply", "--ouput", "t.png"], "'--output'"),
    ] {
        let result = meniscus(folder.path(), typed);
        assert_eq!(result.status, 2);
        let tip = result.err.lines().find(|line| line.contains("similar argument"));
        assert!(tip.is_some_and(|tip| tip.ends_with(meant)), "{typed:?}: {}", result.err);
        assert!(
            result.err.contains("Usage: ") && !result.err.contains("--up <AXIS>") || meant == "'--up'",
            "{}",
            result.err
        );
    }
}

#[test]
fn option_of_another_command_is_refused_with_the_name_of_that_command() {
    let folder = tempdir().expect("a folder");
    for (typed, tip) in [
        (&["watch", "in", "--out=o", "--max-deviation=1"][..], "--max-deviation is an option of convert"),
        (&["watch", "in", "--out=o", "--report", "r.json"], "--report is an option of convert and verify"),
        (&["watch", "in", "--out=o", "--sequence-glb=s.glb"], "--sequence-glb is an option of convert"),
        (&["verify", "out", "--skip-done"], "--skip-done is an option of convert"),
        (&["watch", "in", "--out=o", "--print-settings"], "--print-settings is an option of convert"),
        (&["convert", "a.ply", "--out=o", "--settle=1s"], "--settle is an option of watch"),
    ] {
        let result = meniscus(folder.path(), typed);
        let tips: Vec<&str> = result.err.lines().filter(|line| line.contains("tip:")).collect();
        assert_eq!((result.status, tips), (2, vec![&*format!("  tip: {tip}")]), "{typed:?}: {}", result.err);
        assert!(result.err.contains("Usage: ") && !result.err.contains("--radius-ratio"), "{}", result.err);
    }
    // An argument that resembles no option has no tip.
    for typed in ["--zzzz", "--grxqw=1"] {
        let result = meniscus(folder.path(), &["convert", "a.ply", "--out=o", typed]);
        assert!(result.status == 2 && !result.err.contains("tip:"), "{}", result.err);
    }
}
