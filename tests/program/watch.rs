//! The commands `watch` and `status`: arguments, errors and output.

use std::fs;
use std::path::Path;

use meniscus::pipeline::FrameRecords;
use meniscus::watch::lock::OutputLock;
use tempfile::tempdir;

use crate::program::scene::{RunResult, block, meniscus, write_ply, write_sequence};

/// Asserts that a command does nothing, exits with status 2, and gives this reason.
fn assert_refused(folder: &Path, arguments: &[&str], words: &[&str]) {
    let result = meniscus(folder, &[&["watch"], arguments].concat());
    assert_eq!(result.status, 2, "{arguments:?}: {} {}", result.out, result.err);
    for word in words {
        assert!(result.err.contains(word), "{arguments:?} does not say {word}: {}", result.err);
    }
}

#[test]
fn contradictory_arguments_are_refused_before_any_output() {
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
        (&["--preset", "paper", "--radius-ratio", "0.5"][..], &["in: the radius ratio is 0.5"][..]),
        (&["--settle", "1"], &["--settle", "not a time"]),
        (&["--memory", "lots"], &["--memory", "not a size"]),
        (&["--order", "random"], &["--order", "natural, latest"]),
        (&["--pattern", "["], &["not a valid pattern"]),
    ] {
        assert_refused(path, &[&["in", "--out", "out"], arguments].concat(), words);
    }
    let file = "error: meniscus.toml: this is a file, and watch needs a folder";
    assert_refused(path, &["meniscus.toml", "--out", "out"], &[file]);
    assert!(!path.join("out").exists());
}

/// The range of a number, as the text on its option states it.
fn stated_range(text: &str) -> Option<String> {
    let phrases = ["at least 1", "positive"];
    let phrase = phrases.into_iter().find(|phrase| text.contains(phrase)).map(str::to_owned);
    phrase.or_else(|| {
        let words: Vec<&str> = text.split([' ', ',', ';']).collect();
        let is_number = |word: &str| word.parse::<f64>().is_ok();
        let range =
            words.windows(3).find(|words| words[1] == "to" && is_number(words[0]) && is_number(words[2]));
        range.map(|words| words.join(" "))
    })
}

/// The docs and the help state the same range for every number, and so does the error for a value outside of
/// the range.
#[test]
fn numbers_have_the_documented_ranges() {
    let folder = tempdir().expect("a folder");
    let help = meniscus(folder.path(), &["convert", "--help"]).out;
    let help = help.split_whitespace().collect::<Vec<_>>().join(" ");
    let of_option = |option: &str| {
        let after = help.split_once(&format!(" {option} <")).or(help.split_once(&format!(" {option}[=<")));
        let (_, after) = after.unwrap_or_else(|| panic!("{option} is not in the help"));
        after.split(" --").next().unwrap_or_default().to_owned()
    };
    let try_out = |option: &str, value: &str| {
        let typed = format!("{option}={value}");
        let others = match option {
            "--voxel-size" | "--spacing" => &[][..],
            "--velocity-gain" => &["--preset=paper", "--voxel-size=1", "--anisotropy=velocity"],
            "--radius-scale" => &["--preset=paper", "--voxel-size=1", "--radius-attribute=pscale"],
            _ => &["--preset=paper", "--voxel-size=1", "--anisotropy=neighbors"],
        };
        meniscus(folder.path(), &[&["convert", "--print-settings", &typed], others].concat())
    };
    let docs = include_str!("../../docs/options.md");
    let mut range_count = 0;
    for row in docs.lines().filter(|line| line.starts_with("| `--")) {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let [_, option, value, text, ..] = cells[..] else { panic!("{row}") };
        // A size is two numbers.
        let Some(range) = stated_range(text).filter(|_| value != "SIZE") else { continue };
        let option = option.trim_matches('`');
        range_count += 1;
        assert!(of_option(option).contains(&range), "{option} {range}: {}", of_option(option));
        let (bad, good): (Vec<String>, Vec<String>) = match range.split_once(" to ") {
            Some((least, most)) => {
                let [low, high]: [f64; 2] = [least, most].map(|bound| bound.parse().expect(&range));
                let below = if low > 0.0 && low < 1.0 { 0.5 * low } else { low - 1.0 };
                // For threads, only the lower limit: the upper limit is more threads than a test should
                // start.
                let good = if option == "--threads" { vec![least] } else { vec![least, most] };
                let bad = vec![below.to_string(), (2.0 * high).to_string()];
                (bad, good.into_iter().map(str::to_owned).collect())
            }
            None if range == "at least 1" => {
                (vec!["0.99".into(), "nan".into()], vec!["1".into(), "30".into()])
            }
            None => (vec!["0".into(), "-1".into(), "inf".into()], vec!["2".into()]),
        };
        for value in &bad {
            let result = try_out(option, value);
            assert_eq!(result.status, 2, "{option} {value}: {}", result.out);
            let words = range.split(" to ").flat_map(|part| part.split(", ").take(1));
            for word in words {
                assert!(result.err.contains(word), "{option} {value} does not say {word}: {}", result.err);
            }
        }
        for value in &good {
            let result = try_out(option, value);
            assert_eq!(result.status, 0, "{option} {value}: {}", result.err);
        }
    }
    assert!(range_count > 17, "{range_count}");
}

/// Records that a frame with outputs in `out` failed for this reason.
fn record_failure(out: &Path, frame: &Path, reason: &str) {
    let input = frame.canonicalize().expect("a path");
    let name = Path::new(frame.file_stem().expect("a name"));
    let records = FrameRecords::open(out).expect("opened");
    records.add_failure(name, &input, reason).expect("recorded");
}

#[test]
fn status_reads_the_records_and_the_lock() {
    let folder = tempdir().expect("a folder");
    let path = &folder.path().canonicalize().expect("a path");
    let status =
        |more: &[&str]| -> RunResult { meniscus(path, &[&["status", "--out", "out"], more].concat()) };
    let nothing = status(&[]);
    assert_eq!(nothing.status, 2);
    assert!(nothing.err.contains("out: nothing is recorded here"), "{}", nothing.err);
    assert!(!path.join("out").exists());

    write_sequence(path, 1, 2);
    let out = path.join("out");
    // Also what `convert` has done.
    let converted = meniscus(path, &["convert", "dam.1.ply", "--out", "out", "--format", "obj"]);
    assert_eq!(converted.status, 0, "{}", converted.err);
    let done = status(&[]);
    assert_eq!((done.status, done.out.lines().nth(1)), (0, Some("1 done, 0 queued, 0 to retry, 0 failed")));
    record_failure(&out, &path.join("dam.2.ply"), "no end");
    let lock = OutputLock::take(&out).expect("the lock");
    let failed = status(&[]);
    assert_eq!(failed.status, 1);
    assert!(failed.out.contains("dam.2.ply: no end ("), "{}", failed.out);
    assert!(failed.out.starts_with("out: starting ("), "{}", failed.out);
    let json = status(&["--json"]);
    let json: serde_json::Value = serde_json::from_str(&json.out).expect("JSON");
    assert_eq!(json["daemon"]["running"], true);
    assert_eq!(json["failed"][0]["reason"], "no end");
    assert_eq!(json["last_done"][0]["particles"], 216);
    drop(lock);
}

#[test]
fn status_of_a_frame_prints_its_record() {
    let folder = tempdir().expect("a folder");
    let path = &folder.path().canonicalize().expect("a path");
    let out = path.join("out");
    fs::create_dir(path.join("real")).expect("made");
    std::os::unix::fs::symlink("real", path.join("in")).expect("linked");
    write_sequence(&path.join("in"), 1, 3);
    let watch = ["watch", "in", "--out", "out", "--once", "--sentinel", "{stem}.ok", "--format", "obj"];
    fs::write(path.join("in/dam.1.ok"), "").expect("written");
    let result = meniscus(path, &watch);
    assert_eq!(result.status, 1, "{}", result.err);
    record_failure(&out, &path.join("real/dam.3.ply"), "no end");
    let settings = "settings  ";
    for (frame, status, words) in [
        ("in/dam.1.ply", 0, &["in/dam.1.ply\n", "state     done, ", "out/dam.1.obj", settings][..]),
        ("real/dam.1.ply", 0, &["state     done, "]),
        (
            "in/dam.2.ply",
            0,
            &["state     not yet complete, ", "its sentinel is missing", "no daemon is running"],
        ),
        ("real/dam.3.ply", 1, &["state     failed, ", "reason    no end"]),
        ("in/gone.ply", 2, &["in/gone.ply: nothing is recorded of it: a frame must be in a watched folder"]),
    ] {
        let result = meniscus(path, &["status", frame, "--out", "out"]);
        let text = format!("{}{}", result.out, result.err);
        assert_eq!(result.status, status, "{text}");
        assert!(words.iter().all(|word| text.contains(word)), "{words:?}: {text}");
    }
    let json = meniscus(path, &["status", "in/dam.2.ply", "--out", "out", "--json"]);
    let json: serde_json::Value = serde_json::from_str(&json.out).expect("JSON");
    assert_eq!(json["state"], "waiting");
}

#[test]
fn status_of_a_file_lists_all_its_folders() {
    let folder = tempdir().expect("a folder");
    let path = &folder.path().canonicalize().expect("a path");
    let blocks = [("water", "out"), ("spray", "out"), ("dust", "other")]
        .map(|(input, output)| format!("[[watch]]\ninput = \"{input}\"\noutput = \"{output}\"\n"));
    fs::write(path.join("meniscus.toml"), blocks.concat()).expect("written");
    for input in ["water", "spray", "dust"] {
        fs::create_dir(path.join(input)).expect("made");
    }
    let result = meniscus(path, &["watch", "--config", "meniscus.toml", "--once"]);
    assert!(result.err.contains("there are no frames to convert"), "{}", result.err);
    // All folders of the file, each once.
    let status = |more: &[&str]| meniscus(path, &[&["status", "--config", "meniscus.toml"], more].concat());
    let all = status(&["--json"]);
    let json: serde_json::Value = serde_json::from_str(&all.out).expect("JSON");
    let outputs = json.as_array().expect("a list").iter().map(|record| record["output"].clone());
    assert!(outputs.eq(["out", "other"].map(|output| serde_json::json!(path.join(output)))), "{json}");
    let text = status(&[]);
    assert_eq!((text.status, text.out.matches("0 done, 0 queued").count()), (0, 2), "{}", text.out);
    let more = "[[watch]]\ninput = \"dust\"\noutput = \"never\"\n";
    fs::write(path.join("meniscus.toml"), blocks.concat() + more).expect("written");
    let text = status(&[]);
    // A block that was added has not run yet.
    assert_eq!((text.status, text.out.matches("0 done, 0 queued").count()), (0, 2), "{}", text.out);
    assert!(text.err.contains("meniscus.toml: valid; nothing is recorded yet in "), "{}", text.err);
}

#[test]
fn sub_folders_are_named_if_there_are_no_other_frames() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for take in ["take1", "take2"] {
        fs::create_dir_all(path.join("in").join(take)).expect("made");
        write_sequence(&path.join("in").join(take), 1, 1);
    }
    let result = meniscus(path, &["watch", "in", "--out", "in/out", "--once"]);
    let reason = "there are no frames to convert: the folder has 2 sub-folders, which are not watched: give --pattern '**'";
    assert!(result.status == 2 && result.err.contains(reason), "{}", result.err);
}

/// The output of --print-settings is a valid configuration file, and gives the same files for any options.
#[test]
fn printed_settings_are_keys_of_a_file() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir_all(path.join("in")).expect("made");
    write_ply(&path.join("in/dam.1.ply"), &block(5, 0.0));
    let corners = "v -1 -1 -1\nv 0.2 -1 -1\nv -1 0.2 -1\nv -1 -1 0.2\n";
    let faces = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";
    fs::write(path.join("a \"b\".obj"), format!("{corners}{faces}")).expect("written");
    let obstacle = ["--obstacle", "a \"b\".obj", "--up", "z", "--vdb", "half,none"];
    for (index, (options, printed_keys)) in [
        (
            &[
                "--preset",
                "splash",
                "--voxel-size",
                "0.05",
                "--clip",
                "-1,-1,-1,0.31,2,2",
                "--max-stretch",
                "3",
            ][..],
            &["anisotropy = \"neighbors\"\n", "fill_cavities = 200\n", "formats = [\"glb\", \"vdb\"]\n"][..],
        ),
        (
            &[&["--preset", "granular", "--voxel-size", ".04"][..], &obstacle].concat(),
            &["up = \"z\"\n", "vdb = \"half,none\"\n", "void_threshold = 1\n"],
        ),
        (&["--blend", "0.3", "--steps", "10"], &["blend = 0.3\n", "steps = 10\n", "up = \"y\"\n"]),
        (
            &["--preset", "preview", "--integrator", "explicit", "--format", "obj,vdb", "--quads"],
            &["steps = 1\n", "quads = true\n", "step_size = 0.01\n"],
        ),
        (&["--format", "vdb"], &["formats = [\"vdb\"]\n"]),
        (&["--format", "obj,usdc", "--stage", "s.usda", "--fps", "30"], &["/s.usda\"\n", "fps = 30\n"]),
        (
            &["--spacing", "0.1", "--voxel-size", "0.5d", "--blend", "2.2d", "--offset", "1h"],
            &["voxel_size = 0.05\n", "blend = 0.22\n", "offset = 0.05\n"],
        ),
    ]
    .into_iter()
    .enumerate()
    {
        let printed = meniscus(path, &[&["convert", "in", "--print-settings"], options].concat());
        assert_eq!((printed.status, &*printed.err), (0, ""), "{options:?}");
        for key in printed_keys {
            assert!(printed.out.contains(key), "{options:?}: no {key} in {}", printed.out);
        }
        let (watched, converted) = (format!("watched{index}"), format!("converted{index}"));
        // The folder of the configuration file does not affect the result.
        let config = path.join(format!("etc{index}/meniscus.toml"));
        fs::create_dir(config.parent().expect("a folder")).expect("made");
        let blocks = format!("[[watch]]\ninput = \"../in\"\noutput = \"../{watched}\"\n{}", printed.out);
        fs::write(&config, blocks).expect("written");
        let result = meniscus(path, &["watch", "--config", &config.to_string_lossy(), "--once"]);
        assert_eq!(result.status, 0, "{}", result.err);
        assert!(!result.err.contains("WARN"), "{}", result.err);
        let result = meniscus(path, &[&["convert", "in", "--out", &converted], options].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        let mut count = 0;
        for extension in ["glb", "vdb", "obj"] {
            let bytes = |out: &str| fs::read(path.join(out).join(format!("dam.1.{extension}"))).ok();
            assert!(bytes(&watched) == bytes(&converted), "{options:?}: {extension}");
            count += usize::from(bytes(&watched).is_some());
        }
        assert!(count > 0);
    }
}

/// Without a spacing, a relative length has no value.
#[test]
fn printed_settings_without_inputs_keep_relative_lengths() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let refused = meniscus(path, &["convert", "--print-settings", "--blend", "0.02"]);
    assert!(refused.status == 2 && refused.err.contains("--spacing"), "{}", refused.err);
    let printed = meniscus(path, &["convert", "--print-settings", "--blend", "2.5d", "--offset=-0.5h"]);
    assert!(printed.out.contains("\nblend = \"2.5d\"\n"), "{}{}", printed.out, printed.err);
    assert!(printed.out.contains("\noffset = \"-0.5h\"\n"), "{}", printed.out);
}

/// A configuration file accepts lengths in spacings and voxels, as the command line does. The results equal
/// those of world units.
#[test]
fn lengths_in_files_have_units() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir_all(path.join("in")).expect("made");
    write_ply(&path.join("in/dam.1.ply"), &block(5, 0.0));
    let watched = |name: &str, keys: &str| {
        let text = format!("[[watch]]\ninput = \"in\"\noutput = \"{name}\"\nspacing = 0.1\n{keys}\n");
        fs::write(path.join("meniscus.toml"), text).expect("written");
        meniscus(path, &["watch", "--config", "meniscus.toml", "--once"])
    };
    let bytes = |name: &str| fs::read(path.join(name).join("dam.1.vdb")).expect("a result");
    assert_eq!(watched("units", "voxel_size = \"0.5d\"\nblend = \"2.2d\"\noffset = \"-1h\"").status, 0);
    assert_eq!(watched("world", "voxel_size = 0.05\nblend = 0.22\noffset = -0.05").status, 0);
    assert!(bytes("units") == bytes("world"));
    // The options are the same as those that are recorded.
    let result = watched("units", "voxel_size = \"0.5d\"\nblend = \"2.2d\"\noffset = \"-1h\"");
    assert_eq!((result.status, result.err.contains("dam.1.ply: converted")), (0, false), "{}", result.err);
    for (keys, why) in [
        ("blend = \"5x\"", "meniscus.toml:5: `blend`: `5x` is not a length"),
        ("voxel_size = \"2h\"", "meniscus.toml:5: `voxel_size`: `2h` is not a voxel size"),
        ("spacing_ = 1", "meniscus.toml:5: unknown key `spacing_`"),
        ("decimate = \"0.1h\"", "meniscus.toml:5: `decimate`: `0.1h` is not a number from 0 to 1"),
    ] {
        let result = watched("wrong", keys);
        assert!(result.status == 2 && result.err.contains(why), "{}", result.err);
    }
}
