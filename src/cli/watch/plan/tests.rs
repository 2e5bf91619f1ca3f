use super::*;
use crate::cli::args::{Cli, Command};
use crate::pipeline::OutputFormat;
use clap::Parser;
use std::fs;
use tempfile::TempDir;

/// A folder with a `meniscus.toml`, for tests that make plans from this file.
struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new(text: &str) -> Bench {
        let folder = tempfile::tempdir().expect("a folder");
        fs::write(folder.path().join("meniscus.toml"), text).expect("written");
        Bench { folder }
    }

    fn config_path(&self) -> PathBuf {
        self.folder.path().join("meniscus.toml")
    }

    /// The plan from this file and these options.
    fn plan(&self, options: &[&str]) -> Result<WatchPlan> {
        let config = self.config_path();
        plan(&[&["--config", config.to_str().expect("text")], options].concat())
    }

    fn refused(&self, options: &[&str], words: &[&str]) {
        assert_refused(self.plan(options), words);
    }
}

fn plan(options: &[&str]) -> Result<WatchPlan> {
    let typed = Cli::try_parse_from([&["meniscus", "watch"], options].concat())?;
    let Command::Watch(args) = typed.command else { panic!("another command") };
    make_plan(&args)
}

fn assert_refused(plan: Result<WatchPlan>, words: &[&str]) {
    let error = format!("{:#}", plan.map(|_| ()).expect_err("it is refused"));
    for word in words {
        assert!(error.contains(word), "{error} does not say {word}");
    }
}

#[test]
fn defaults_are_filled_in() {
    let WatchPlan { config, log, listen, warnings } = plan(&["in", "--out", "out"]).expect("a plan");
    assert_eq!((log, listen, warnings.len(), config.once), (LogChoice::Text, None, 0, false));
    assert_eq!((config.order, config.poll), (Order::Natural, Poll::Auto));
    assert_eq!(config.disk_floor_bytes, 1 << 30);
    assert_eq!(config.settle.as_millis(), 500);
    assert!(config.threads > 0 && config.memory_bytes > 0);
    let [watch] = &config.watches[..] else { panic!("one folder") };
    assert!(watch.input.is_absolute() && watch.input.ends_with("in") && watch.outputs.folder.is_absolute());
    assert_eq!(watch.outputs.formats, [OutputFormat::Glb, OutputFormat::Vdb]);
    assert_eq!(watch.choices, Default::default());
    assert!(watch.pattern.is_none() && watch.sentinel.is_none());
}

#[test]
fn frame_rate_needs_a_stage_in_the_block_or_in_any_block() {
    let block =
        |more: &str| format!("[[watch]]\ninput = \"a\"\noutput = \"o\"\nformats = [\"usdc\"]\n{more}");
    let other = "[[watch]]\ninput = \"b\"\noutput = \"p\"\n";
    // On the command line, it is for the blocks that have a stage.
    let bench = Bench::new(&(block("stage = \"s.usda\"\n") + other));
    let plan = bench.plan(&["--fps", "25"]).expect("a plan");
    let fps = |watch: &Watch| watch.outputs.stage.as_ref().map(|stage| stage.fps);
    assert_eq!(plan.config.watches.iter().map(fps).collect::<Vec<_>>(), [Some(25.0), None]);
    Bench::new(other).refused(&["--fps", "25"], &["--fps is for a stage"]);
    let bench = Bench::new(&(block("stage = \"s.usda\"\n") + other + "fps = 25\n"));
    bench.refused(&[], &["meniscus.toml:6: [[watch]]: --fps is for a stage: give --stage as well"]);
    // The stage may be on the command line.
    let bench = Bench::new(&block("fps = 30\n"));
    assert_eq!(fps(&bench.plan(&["--stage", "s.usda"]).expect("a plan").config.watches[0]), Some(30.0));
}

#[test]
fn non_loopback_address_requires_token() {
    let bench =
        Bench::new("[daemon]\nlisten = \"127.0.0.1:7700\"\n[[watch]]\ninput = \"a\"\noutput = \"o\"\n");
    let listen = bench.plan(&[]).expect("a plan").listen.expect("an address");
    assert_eq!((listen.address.port(), listen.token), (7700, None));
    for address in ["[::1]:0", "127.8.9.1:80", "[::ffff:127.0.0.1]:80"] {
        assert!(bench.plan(&["--listen", address]).is_ok(), "{address}");
    }
    let token = bench.folder.path().join("token");
    let token_file = ["--token-file", token.to_str().expect("text")];
    fs::write(&token, "short\n").expect("written");
    bench.refused(&token_file, &["the first line of", "is not a token: 16 to 256"]);
    fs::write(&token, "0123456789abcdef\n").expect("written");
    for address in ["0.0.0.0:80", "[::]:80", "192.168.1.7:80"] {
        bench.refused(&["--listen", address], &[address, "--token-file"]);
        let listen = bench.plan(&[&["--listen", address][..], &token_file].concat()).expect("a plan").listen;
        assert_eq!(listen.expect("an address").token, AccessToken::new("0123456789abcdef"), "{address}");
    }
    bench.refused(&["--token-file", "none-there"], &["cannot read none-there"]);
    let bench = Bench::new("[daemon]\nlisten = \"7700\"\n");
    bench.refused(&[], &["meniscus.toml:2", "`listen`", "not an address with a port"]);
}

#[test]
fn options_override_every_block() {
    let bench = Bench::new(
        "[daemon]\norder = \"latest\"\nsettle = \"3s\"\n\
         [[watch]]\ninput = \"a\"\noutput = \"o\"\nvoxel_size = 0.5\nsteps = 7\nformats = [\"obj\"]\n\
         [[watch]]\ninput = \"b\"\noutput = \"o\"\nvoxel_size = 0.25\npattern = \"*.ply\"\n",
    );
    let config = bench.plan(&[]).expect("a plan").config;
    assert_eq!((config.order, config.settle.as_secs()), (Order::Latest, 3));
    assert_eq!(config.watches[0].input, bench.folder.path().join("a"));
    assert_eq!(config.watches[0].choices.steps, Some(7));

    let options =
        ["--voxel-size", "1", "--order", "natural", "--format", "ply", "--pattern", "**", "--out", "x"];
    let config = bench.plan(&options).expect("a plan").config;
    assert_eq!((config.order, config.settle.as_secs()), (Order::Natural, 3));
    for watch in &config.watches {
        assert_eq!((watch.choices.voxel_size, watch.pattern.as_deref()), (Some(1.0.into()), Some("**")));
        assert_eq!(watch.outputs.formats, [OutputFormat::Ply]);
        assert!(
            watch.outputs.folder.ends_with("x") && !watch.outputs.folder.starts_with(bench.folder.path())
        );
    }
}

#[test]
fn folders_on_the_command_line_replace_blocks() {
    let bench =
        Bench::new("[daemon]\nsettle = \"3s\"\n[[watch]]\ninput = \"a\"\noutput = \"o\"\nvoxel_size = 0.5\n");
    let config = bench.plan(&["c", "d", "c", "--out", "x"]).expect("a plan").config;
    assert_eq!((config.watches.len(), config.settle.as_secs()), (2, 3));
    assert!(config.watches.iter().all(|watch| watch.choices.voxel_size.is_none()));
    bench.refused(&["c"], &["replaces the [[watch]] blocks", "needs --out"]);
}

#[test]
fn one_out_for_blocks_with_different_outputs_is_refused() {
    let block = |input: &str, output: &str| format!("[[watch]]\ninput = \"{input}\"\n{output}\n");
    let bench = Bench::new(&(block("a", "output = \"o\"") + &block("b", "output = \"p\"")));
    bench.refused(&["--out", "x"], &["lines 1 and 4", "different outputs", "--out"]);
    assert_eq!(bench.plan(&[]).expect("a plan").config.watches.len(), 2);
    let bench = Bench::new(&(block("a", "") + &block("b", "")));
    bench.refused(&[], &["meniscus.toml:1", "names no output", "--out"]);
    assert_eq!(bench.plan(&["--out", "x"]).expect("a plan").config.watches.len(), 2);
    Bench::new("[daemon]\n").refused(&[], &["no folder to watch"]);
    Bench::new("[daemon]\n").refused(&["--out", "x"], &["no folder to watch"]);
}

#[test]
fn duplicate_watch_is_refused() {
    let block = |input: &str, more: &str| format!("[[watch]]\ninput = \"{input}\"\noutput = \"o\"\n{more}\n");
    let bench = Bench::new(&(block("a", "") + &block("./a", "voxel_size = 1")));
    bench.refused(
        &[],
        &["meniscus.toml:5: [[watch]]: ", "watched twice for the same output", "the block at line 1"],
    );
    let with_patterns = block("a", "pattern = \"dam*\"") + &block("a", "pattern = \"spray*\"");
    assert_eq!(Bench::new(&with_patterns).plan(&[]).expect("a plan").config.watches.len(), 2);
}

#[test]
fn invalid_options_are_refused() {
    let bench = Bench::new("[[watch]]\ninput = \"a\"\noutput = \"o\"\nblend = \"65h\"\n");
    bench.refused(&[], &["meniscus.toml:1: [[watch]]: ", "blend 65h is "]);
    assert!(bench.plan(&["--blend", "2d"]).is_ok());
    for (options, words) in [
        (&["--voxel-size", "-1"][..], &["in: ", "voxel size"][..]),
        (&["--radius-ratio", "0.5", "--preset", "paper"], &["radius ratio is 0.5"]),
        (&["--pattern", "a[", "--out", "o"], &["`a[` is not a valid pattern"]),
        (&["--sentinel", ""], &["sentinel"]),
        (&["--sentinel", "../{stem}"], &["beside the frame"]),
        (&["--sentinel", "{name}"], &["beside the frame"]),
        (&["--once"], &["in: there is no such folder", "without --once"]),
        (&["--settle", "soon"], &["--settle", "not a time"]),
        (&["--poll", "1us"], &["--poll", "from 50ms"]),
        (&["--memory", "some"], &["--memory", "not a size"]),
        (&["--threads", "0"], &["--threads"]),
        (&["--format", "fbx"], &["fbx"]),
    ] {
        let options =
            if options.contains(&"--out") { options.to_vec() } else { [options, &["--out", "o"]].concat() };
        assert_refused(plan(&[&["in"], &options[..]].concat()), words);
    }
    assert_refused(plan(&["in"]), &["--out"]);
    assert_refused(plan(&["--out", "o"]), &["DIR"]);
    assert_refused(plan(&[]), &["DIR"]);
    let file = bench.config_path();
    assert_refused(plan(&["in", "--out", file.to_str().expect("text")]), &[".toml is not an output format"]);
}

/// An error that concerns keys together, or a file that they name, has the line of their block.
#[test]
fn errors_name_the_line_of_the_block() {
    for (entry, words) in [
        ("stage = \"s.usda\"", &["--stage plays", "add usdc to --format"][..]),
        ("clip = \"1,1,1,0,0,0\"", &["the box"]),
        ("pattern = \"a[\"", &["not a valid pattern"]),
        ("blend = \"65h\"\npreset = \"granular\"", &["blend 65h is "]),
        ("sentinel = \"../a\"", &["beside the frame"]),
        #[cfg(unix)]
        ("obstacles = [\"none.obj\", \"/dev/zero\"]", &["obstacle /dev/zero: not a regular file: a device"]),
        ("spacing = 0.1\npattern = \"*.vdb\"", &["--spacing cannot be given with a level set"]),
    ] {
        let bench = Bench::new(&format!("[[watch]]\noutput = \"o\"\ninput = \"a\"\n{entry}\n"));
        bench.refused(&[], &[&["meniscus.toml:1: [[watch]]: "][..], words].concat());
        // The blocks do not matter if folders are given.
        assert!(bench.plan(&["b", "--out", "o"]).is_ok(), "{entry}");
    }
    for (entry, words) in [
        ("memory = 8", &["too small"][..]),
        ("listen = \"0.0.0.0:7700\"", &["--token-file"]),
        ("token_file = \"none\"\nlisten = \"127.0.0.1:1\"", &["cannot read"]),
        ("token_file = \"meniscus.toml\"", &["the first line of"]),
    ] {
        let block = "[[watch]]\ninput = \"a\"\noutput = \"o\"\n";
        let bench = Bench::new(&format!("{block}[daemon]\n{entry}\n"));
        bench.refused(&[], &[&["meniscus.toml:4: [daemon]: "][..], words].concat());
    }
    let block = "[[watch]]\ninput = \"meniscus.toml\"\noutput = \"o\"\n";
    Bench::new(block).refused(&[], &["meniscus.toml:1: [[watch]]: ", "this is a file"]);
    let block = "[[watch]]\ninput = \"a\"\noutput = \"meniscus.toml\"\n";
    Bench::new(block).refused(&[], &["meniscus.toml:1: [[watch]]: "]);
    let bench = Bench::new("");
    fs::write(bench.config_path(), [0xff, 0xfe]).expect("written");
    bench.refused(&[], &["meniscus.toml: this is not a text file"]);
}

#[test]
fn warnings_are_not_repeated() {
    let options = ["a", "b", "--out", "o", "--void-threshold", "2", "--voxel-size", "1", "--radius-min", "1"];
    let options = [&options[..], &["--preset", "paper"]].concat();
    let warnings = plan(&options).expect("a plan").warnings;
    assert_eq!(warnings.len(), 2, "{warnings:?}");
    assert!(warnings[0].contains("r_min is 1") && warnings[1].contains("--void-threshold is ignored"));
}
