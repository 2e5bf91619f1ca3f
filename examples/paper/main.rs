//! The paper's experiments, from generated data: tables, plots and pictures.
//!
//! ```text
//! cargo run --release --example paper                     all of them, into docs/results
//! cargo run --release --example paper -- flows            one of them
//! cargo run --release --example paper -- --long           and what takes hours
//! ```
//!
//! Some stand beside splashsurf, which `benches/peers` installs, or which `SPLASHSURF` names.

mod drop;
mod flicker;
mod flow;
mod flows;
mod frame;
mod output;
mod random_ball;
mod samples;
mod shapes;
mod spheres;
mod splashsurf;
mod surfaces;

use std::error::Error;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use crate::splashsurf::Splashsurf;

/// What an experiment comes to, or why it did not.
pub(crate) type Outcome<T> = Result<T, Box<dyn Error>>;

/// How much is done. Only flows have a longer form.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Length {
    /// What takes minutes.
    Short,
    /// And what takes hours.
    Long,
}

type Experiment = fn(&Path, Length) -> Outcome<()>;

const EXPERIMENTS: [(&str, Experiment); 6] = [
    ("frame", frame::run),
    ("spheres", spheres::run),
    ("shapes", shapes::run),
    ("flows", flows::run),
    ("drop", drop::run),
    ("random_ball", random_ball::run),
];

const BESIDE_SPLASHSURF: [&str; 3] = ["flows", "drop", "random_ball"];

fn main() -> Outcome<()> {
    let (options, names): (Vec<String>, Vec<String>) =
        std::env::args().skip(1).partition(|argument| argument.starts_with("--"));
    let length = match options.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [] => Length::Short,
        ["--long"] => Length::Long,
        _ => return Err("usage: paper [EXPERIMENT...] [--long]".into()),
    };
    let known = EXPERIMENTS.map(|(name, _)| name);
    if let Some(name) = names.iter().find(|name| !known.contains(&&***name)) {
        return Err(format!("no experiment {name}; there are: {}", known.join(", ")).into());
    }
    let is_asked = |name: &str| names.is_empty() || names.iter().any(|asked| asked == name);
    if length == Length::Long && !is_asked("flows") {
        return Err("--long is for flows".into());
    }
    // Missed before the first experiment takes its minutes.
    if BESIDE_SPLASHSURF.into_iter().any(is_asked) {
        Splashsurf::find()?;
    }
    let folder = PathBuf::from("docs/results");
    fs::create_dir_all(&folder)?;
    for (name, run) in EXPERIMENTS.into_iter().filter(|(name, _)| is_asked(name)) {
        let start = Instant::now();
        run(&folder, length)?;
        told(&format!("{name}: {:.0} s", start.elapsed().as_secs_f64()))?;
    }
    Ok(())
}

/// What is under way takes minutes: those who wait are told.
pub(crate) fn told(line: &str) -> Outcome<()> {
    Ok(writeln!(std::io::stdout(), "{line}")?)
}
