//! The paper's experiments on generated data: tables, plots and pictures.
//!
//! ```text
//! cargo run --release -p paper                     all of them, into docs/results
//! cargo run --release -p paper -- flows            one of them
//! cargo run --release -p paper -- --long           including those that take hours
//! ```
//!
//! Some experiments compare with splashsurf, which `benches/peers` installs; `SPLASHSURF` can name another
//! executable.

mod drop;
mod flicker;
mod flow;
mod flows;
mod frame;
mod output;
mod quality;
mod random_ball;
mod samples;
mod shapes;
mod spheres;
mod splashsurf;
mod submerged;
mod surfaces;

use std::error::Error;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use crate::splashsurf::Splashsurf;

/// The result of an experiment, or its error.
pub(crate) type Outcome<T> = Result<T, Box<dyn Error>>;

/// An experiment, which writes its tables and pictures into a folder.
#[derive(Clone, Copy)]
struct Experiment {
    name: &'static str,
    run: fn(&Path) -> Outcome<()>,
    /// Whether it takes hours instead of minutes.
    is_long: bool,
}

const fn short(name: &'static str, run: fn(&Path) -> Outcome<()>) -> Experiment {
    Experiment { name, run, is_long: false }
}

const EXPERIMENTS: [Experiment; 8] = [
    short("frame", frame::run),
    short("spheres", spheres::run),
    short("shapes", shapes::run),
    short("flows", flows::run),
    short("drop", drop::run),
    short("random_ball", random_ball::run),
    Experiment { name: "flows_integrators", run: flows::run_integrators, is_long: true },
    Experiment { name: "flows_many", run: flows::run_many, is_long: true },
];

const WITHOUT_SPLASHSURF: [&str; 3] = ["frame", "spheres", "shapes"];

fn main() -> Outcome<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    if let Some(("quality", settings)) = words.split_first().map(|(first, rest)| (first.as_str(), rest)) {
        return quality::run(settings);
    }
    let (options, names): (Vec<String>, Vec<String>) =
        std::env::args().skip(1).partition(|argument| argument.starts_with("--"));
    let is_long = match options.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [] => false,
        ["--long"] if names.is_empty() => true,
        _ => return Err("usage: paper --long | [EXPERIMENT...]".into()),
    };
    let known = EXPERIMENTS.map(|experiment| experiment.name);
    if let Some(name) = names.iter().find(|name| !known.contains(&&***name)) {
        return Err(format!("unknown experiment {name}; expected one of: {}", known.join(", ")).into());
    }
    let is_selected = |experiment: &Experiment| {
        if names.is_empty() {
            is_long || !experiment.is_long
        } else {
            names.iter().any(|name| name == experiment.name)
        }
    };
    let selected: Vec<Experiment> = EXPERIMENTS.into_iter().filter(is_selected).collect();
    // Check for splashsurf before the first experiment, because experiments take minutes.
    if selected.iter().any(|experiment| !WITHOUT_SPLASHSURF.contains(&experiment.name)) {
        Splashsurf::find()?;
    }
    let folder = PathBuf::from("docs/results");
    fs::create_dir_all(&folder)?;
    for Experiment { name, run, .. } in selected {
        let start = Instant::now();
        run(&folder)?;
        print_progress(&format!("{name}: {:.0} s", start.elapsed().as_secs_f64()))?;
    }
    Ok(())
}

/// Prints progress, because an experiment takes minutes.
pub(crate) fn print_progress(line: &str) -> Outcome<()> {
    Ok(writeln!(std::io::stdout(), "{line}")?)
}
