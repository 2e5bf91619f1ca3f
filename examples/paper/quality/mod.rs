//! Measures the quality of surfaces: one line of JSON per set of particles, for `benches/quality`.
//!
//! ```text
//! cargo run --release -p paper -- quality preset=fluid               ours, on generated particles
//! cargo run --release -p paper -- quality splashsurf=plain cell=0.25
//! cargo run --release -p paper -- quality splashsurf=post temporal=1    its meshes as level sets, averaged by ours
//! cargo run --release -p paper -- quality preset=fluid 'only=Enright 5000,jittered pool'   some sets
//! cargo run --release -p paper -- quality preset=fluid only= frame=dam.ply:0.05   a file, with its spacing
//! cargo run --release -p paper -- quality preset=fluid only= moving=dam:0.05:0.0333:36-44   frames of a simulation,
//!                                              with spacing, seconds per frame, and the first and last frame
//! cargo run --release -p paper -- quality spacings                   estimated / true spacings
//!
//! for another program: write the particles as .ply files; then read and score its meshes of the same names:
//! cargo run --release -p paper -- quality write=particles
//! cargo run --release -p paper -- quality meshes=surfaces
//! ```
//!
//! Settings are `name=value` as in a settings file; names that end in `/d` are lengths in particle spacings.
//! All lengths in scores are in particle spacings d, so that scores on different grids are comparable.

mod heights;
mod looks;
mod maker;
mod scores;
mod sets;

use std::path::PathBuf;
use std::sync::Mutex;
use std::time::Instant;

use meniscus::surface::particles::OwnedPositions;
use meniscus::surface::spacing::{SequenceEstimate, SpacingEstimate, combine_estimates, estimate_spacing};
use meniscus_formats::{AttributeRole, FileAttribute, FilePositions, ParticleFrame, Values, ply};
use serde_json::{Map, Value, json};

use crate::splashsurf::{Post, Splashsurf};
use crate::{Outcome, print_progress};
use maker::Maker;
use sets::{Set, Sets};

/// Runs the action that the arguments select.
pub(crate) fn run(words: &[String]) -> Outcome<()> {
    let Arguments { task, sets } = Arguments::new(words)?;
    sets.visit(|set| {
        let start = Instant::now();
        let mut found = match &task {
            Task::Score(maker) => scores::score(maker, &set)?,
            Task::Write(folder) => write_particles(folder, &set)?,
            Task::Spacings => estimated_spacing(&set),
        };
        found.insert("data".into(), set.name.into());
        found.insert("seconds_in_all".into(), start.elapsed().as_secs_f64().round().into());
        print_progress(&Value::Object(found).to_string())
    })
}

struct Arguments {
    task: Task,
    sets: Sets,
}

enum Task {
    /// Makes the surfaces and scores them.
    Score(Maker),
    /// Writes the particles of each frame into a folder.
    Write(PathBuf),
    /// Estimates the particle spacings.
    Spacings,
}

impl Arguments {
    fn new(words: &[String]) -> Outcome<Arguments> {
        let (mut settings, mut peer, mut cell) = (Vec::new(), None, 0.25);
        let (mut other_task, mut meshes, mut frames) = (None, None, None);
        let mut sets = Sets::default();
        for word in words {
            if word == "spacings" {
                other_task = Some(Task::Spacings);
                continue;
            }
            let (name, value) = word.split_once('=').ok_or_else(|| format!("{word}: not name=value"))?;
            match name {
                "write" => other_task = Some(Task::Write(value.into())),
                "meshes" => meshes = Some(Maker::Meshes(value.into())),
                "cell" => cell = value.parse()?,
                "splashsurf" => {
                    peer = Some(match value {
                        "plain" => Post::Plain,
                        "post" => Post::Processed,
                        _ => return Err("splashsurf=plain or splashsurf=post".into()),
                    });
                }
                "temporal" => {
                    sets.reach = value.parse()?;
                    frames = Some(value.parse()?);
                    settings.push((name.to_owned(), value.to_owned()));
                }
                _ if sets.parse_argument(name, value)? => {}
                _ => settings.push((name.to_owned(), value.to_owned())),
            }
        }
        let maker = match (meshes, peer) {
            (Some(meshes), _) => meshes,
            (None, Some(post)) => {
                let peer = Box::new(Splashsurf::find()?);
                match frames {
                    Some(frames) => Maker::Averaged { peer, post, cell, frames, kept: Mutex::default() },
                    None => Maker::Splashsurf { peer, post, cell },
                }
            }
            (None, None) => Maker::Ours { settings, kept: Mutex::default() },
        };
        Ok(Arguments { task: other_task.unwrap_or(Task::Score(maker)), sets })
    }
}

/// Writes each frame in single precision, which other programs read, with the radii of particles that have their own;
/// the header contains the spacing.
fn write_particles(folder: &PathBuf, set: &Set) -> Outcome<Map<String, Value>> {
    std::fs::create_dir_all(folder)?;
    for frame in &set.frames {
        let positions = frame.points.iter().map(|point| point.as_vec3().to_array()).collect();
        let radii = frame.radii.iter().map(|radii| FileAttribute {
            name: maker::RADII.into(),
            arity: 1,
            role: Some(AttributeRole::Radius),
            values: Values::F32(radii.clone()),
        });
        let particles = ParticleFrame {
            positions: FilePositions::F32(positions),
            attributes: radii.collect(),
            ..ParticleFrame::default()
        };
        let mut bytes = Vec::new();
        ply::write_particles(&particles, &[("spacing".into(), set.spacing.to_string())], &mut bytes)?;
        std::fs::write(folder.join(set.file_name(frame)), bytes)?;
    }
    Ok(map(json!({ "frames": set.frames.len() })))
}

/// The spacing and the irregularity estimated from the first, middle and last frame.
fn estimate_of(set: &Set) -> Option<SequenceEstimate> {
    let last = set.frames.len() - 1;
    let mut indices = vec![0, last / 2, last];
    indices.dedup();
    let estimate = |index: usize| {
        let points = set.frames[index].points.iter().map(|point| point.to_array()).collect();
        estimate_spacing(OwnedPositions::F64(points))
    };
    let estimates: Vec<SpacingEstimate> = indices.into_iter().filter_map(estimate).collect();
    combine_estimates(&estimates)
}

/// The estimated spacing divided by the true one, its confidence, and the irregularity.
fn estimated_spacing(set: &Set) -> Map<String, Value> {
    let found = estimate_of(set);
    map(json!({
        "spacing": found.map(|found| round(found.spacing / set.spacing)),
        "confidence": found.map(|found| round(found.confidence)),
        "irregularity": found.and_then(|found| found.irregularity).map(round),
    }))
}

fn map(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

/// Six decimal places.
fn round(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}
