use super::*;
use super::{command, key_of};
use crate::cli::args::{FormatArgs, LogChoice, RunArgs};
use crate::pipeline::OutputFormat;
use crate::surface::options::{Contouring, MethodOptions, ValueKind};
use crate::watch::{Order, Poll};
use std::time::Duration;
use toml::de::DeValue;

fn parsed(text: &str) -> Result<ConfigFile> {
    parse(&ConfigSource { path: Path::new("farm/meniscus.toml"), text })
}

/// Asserts that a file is refused at this line, with these words in the message.
fn assert_wrong(text: &str, line: usize, words: &[&str]) {
    let error = parsed(text).map(|_| ()).expect_err(text).to_string();
    assert!(error.starts_with(&format!("farm/meniscus.toml:{line}: ")), "{text}: {error}");
    for word in words {
        assert!(error.contains(word), "{text}: {error} does not say {word}");
    }
}

#[test]
fn keys_of_blocks_become_options() {
    let file = parsed(
        "[daemon]\norder = \"latest\"\nmemory = \"8GiB\"\ndisk_floor = 0x400\npoll = \"auto\"\nlog = \"json\"\n\
         threads = 4\nsettle = \"2s\"\n\n\
         [[watch]]\ninput = \"a\"\noutput = \"/out\"\nformats = [\"glb\", \"ply\"]\nvoxel_size = 1\n\
         radius_ratio = 1.5\ncontour = \"tetrahedra\"\nsteps = 1_0\n\n[[watch]]\ninput = \"b\"\nquads = true\n\
         up = \"Z\"\n",
    )
    .expect("a good file");
    let DaemonArgs { order, run, disk_floor, poll, log, settle, .. } = file.daemon.expect("a block").options;
    assert_eq!((order, log), (Some(Order::Latest), Some(LogChoice::Json)));
    assert_eq!((run, disk_floor), (RunArgs { threads: Some(4), memory: Some(8 << 30) }, Some(1024)));
    assert_eq!((poll, settle), (Some(Poll::Auto), Some(Duration::from_secs(2))));
    let [first, second] = &file.watches[..] else { panic!("two blocks") };
    assert_eq!((first.line, second.line), (10, 19));
    let [first, second] = [&first.options, &second.options];
    let paths = |keys: &WatchKeys| [&keys.input, &keys.output].map(|path| path.clone().unwrap_or_default());
    assert_eq!(paths(first), ["farm/a", "/out"].map(PathBuf::from));
    assert_eq!(paths(second), ["farm/b", ""].map(PathBuf::from));
    assert_eq!(first.frames.formats.format, Some(vec![OutputFormat::Glb, OutputFormat::Ply]));
    assert_eq!(first.frames.method.options.0.contour, Some(Contouring::Tetrahedra));
    assert_eq!(
        (first.frames.method.options.0.voxel_size, first.frames.method.options.0.steps),
        (Some(1.0.into()), Some(10))
    );
    let formats = FormatArgs { up: Some(meniscus_formats::UpAxis::Z), ..FormatArgs::default() };
    assert_eq!(second.frames.method.options.0.quads, Some(true));
    assert_eq!(second.frames.formats, formats);
}

#[test]
fn lists_are_taken_for_text_with_commas() {
    let frames = |keys: &str| {
        let file = parsed(&format!("[[watch]]\ninput = \"a\"\n{keys}")).expect("a good file");
        file.watches[0].options.frames.clone()
    };
    for (list, text) in [
        ("attributes = [\"v\", \"Cd\"]", "attributes = \"v,Cd\""),
        ("formats = [\"glb\"]", "formats = \"glb\""),
        ("vdb = [\"half\", \"none\"]", "vdb = \"half,none\""),
        ("clip = [-1, 0, 0.5, 1, 2, 0x3]", "clip = \"-1,0,0.5,1,2,3\""),
        ("camera = [\"azimuth=32\", \"zoom=2\"]", "camera = \"azimuth=32,zoom=2\""),
    ] {
        assert_eq!(frames(list), frames(text), "{list}");
    }
}

#[test]
fn unknown_keys_are_errors_that_name_the_nearest() {
    for (text, line, words) in [
        (
            "[[watch]]\ninput = \"a\"\nvoxelsize = 1\n",
            3,
            &["`voxelsize` in [[watch]]", "mean `voxel_size`?"][..],
        ),
        ("[[watch]]\ninput = \"a\"\nvoxel-size = 1\n", 3, &["mean `voxel_size`?"]),
        ("[[watch]]\ninput = \"a\"\nout = \"b\"\n", 3, &["mean `output`?"]),
        ("[[watch]]\ninput = \"a\"\nformat = []\n", 3, &["mean `formats`?"]),
        ("[daemon]\n\ndisk_flor = \"1GiB\"\n", 3, &["in [daemon]", "mean `disk_floor`?"]),
        ("[daemon]\nzzz = 1\naaa = 1\n", 2, &["`zzz` in [daemon]: examples/meniscus.toml has every key"]),
        ("[[watch]]\nmax_deviation = 1\n", 2, &["unknown key `max_deviation` in [[watch]]"]),
        ("[demon]\n", 1, &["unknown key `demon`", "expected [daemon] or [[watch]]"]),
        ("input = \"a\"\n", 1, &["unknown key `input`", "expected [daemon] or [[watch]]"]),
    ] {
        assert_wrong(text, line, words);
    }
}

#[test]
fn wrong_values_are_errors_with_their_line() {
    for (entry, words) in [
        ("step_size = \"one\"", &["`step_size`: `one` is not a number"][..]),
        ("voxel_size = true", &["`true`"]),
        ("steps = -1", &["`steps`: `-1`", "whole number from 0 to 1000000"]),
        ("steps = 1.5", &["`steps`: `1.5`", "whole number"]),
        ("quads = 1", &["true, false"]),
        ("quads = \"yes\"", &["true, false"]),
        ("contour = \"cubes\"", &["`contour`: `cubes` is unknown", "dual, tetrahedra"]),
        ("formats = []", &["`formats` is empty"]),
        ("formats = [\"glb\", \"fbx\"]", &["`fbx` is unknown", "gltf"]),
        ("formats = [1]", &["`1` is unknown: expected one of"]),
        ("output = \"\"", &["`output` is empty"]),
        ("output = 1979-05-27", &["a date"]),
        ("output = { a = 1 }", &["`output` is a block"]),
        ("clip = []", &["`clip` is empty"]),
        ("clip = [0, [1]]", &["`clip` contains a list in a list"]),
        ("clip = [0, 1]", &["`clip`: "]),
        ("output = \"b\"\noutput = \"c\"", &["duplicate key `output`"]),
    ] {
        let line = 3 + entry.matches('\n').count();
        assert_wrong(&format!("[[watch]]\ninput = \"a\"\n{entry}\n"), line, words);
    }
    for (entry, words) in [
        ("settle = 1", &["`settle`: `1` is not a time", "with a unit"][..]),
        ("settle = \"soon\"", &["`settle`: `soon` is not a time"]),
        ("poll = \"0s\"", &["from 50ms"]),
        ("poll = \"99d\"", &["to 30days"]),
        ("memory = \"lots\"", &["`memory`: `lots` is not a size"]),
        ("memory = -1", &["`memory`: `-1` is not a size"]),
        ("threads = 0", &["from 1 to 1024"]),
        ("log = \"xml\"", &["text, json"]),
    ] {
        assert_wrong(&format!("# A comment\n[daemon]\n{entry}\n"), 3, words);
    }
}

#[test]
fn wrong_number_of_brackets_is_refused() {
    assert_wrong("\n[watch]\ninput = \"a\"\n", 2, &["write [[watch]], not [watch]"]);
    assert_wrong("[[daemon]]\n", 1, &["write one block, [daemon]"]);
    assert_wrong("watch = [1]\n", 1, &["[[watch]]"]);
    assert_wrong("[[watch]]\ninput = \"a\n", 2, &[]);
    assert_wrong("[daemon\n", 1, &[]);
    assert_eq!(parsed("").map(|file| file.watches.len()).expect("an empty file"), 0);
}

/// The example with every commented-out setting enabled: `#key = value`.
fn example(all: bool) -> String {
    let text = include_str!("../../../examples/meniscus.toml");
    let is_setting = |line: &str| line.starts_with('#') && !line.starts_with("# ") && line.contains(" = ");
    let line =
        |line: &str| line.strip_prefix('#').filter(|_| all && is_setting(line)).unwrap_or(line).to_owned();
    text.lines().map(|text| line(text) + "\n").collect()
}

#[test]
fn example_file_is_valid() {
    let file = parsed(&example(false)).expect("a good example");
    assert_eq!(file.watches.len(), 1);
    assert_eq!(file.watches[0].options.input.as_deref(), Some(Path::new("farm/frames")));
}

/// The example; `MENISCUS_WRITE_DOCS=1 cargo test --lib cli::` adds missing options of the method.
const EXAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/meniscus.toml");

/// An option of the method, as a commented-out setting.
fn mention(key: &str) -> Option<String> {
    let kind = MethodOptions::info(key)?.kind;
    let command = WatchKeys::augment_args(clap::Command::new("watch"));
    let option = command.get_arguments().find(|option| option.get_id() == key)?;
    let value = match kind {
        // A range such as `0 to 4` begins with a valid value.
        ValueKind::Length | ValueKind::Number | ValueKind::Count => MethodOptions::range(key)
            .and_then(|range| Some(range.split_once(" to ")?.0.to_owned()))
            .unwrap_or_else(|| "1".to_owned()),
        ValueKind::Switch => "true".to_owned(),
        ValueKind::Text => format!("\"{}\"", option.get_possible_values().first()?.get_name()),
    };
    Some(format!("\n# {}.\n#{key} = {value}\n", option.get_help()?))
}

#[test]
fn example_file_has_every_key() {
    let text = example(true);
    parsed(&text).expect("a good example");
    let root = DeTable::parse(&text).expect("TOML");
    let blocks = |name: &str| match root.get_ref().get(name).expect(name).get_ref() {
        DeValue::Array(array) => array.iter().filter_map(|value| value.get_ref().as_table()).collect(),
        value => Vec::from_iter(value.as_table()),
    };
    for (name, command) in [("watch", command::<WatchKeys>()), ("daemon", command::<DaemonArgs>())] {
        let blocks = blocks(name);
        for key in command.get_arguments().map(key_of) {
            let mut is_present = blocks.iter().any(|block| block.contains_key(&*key));
            if let Some(mention) = mention(&key).filter(|_| !is_present)
                && std::env::var_os("MENISCUS_WRITE_DOCS").is_some()
            {
                let example = std::fs::read_to_string(EXAMPLE).expect("the example");
                std::fs::write(EXAMPLE, example + &mention).expect("written");
                is_present = true;
            }
            assert!(is_present, "no {key} in the example's {name}");
        }
    }
}
