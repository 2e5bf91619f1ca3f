//! Sequences with known motion: the test of Enright, and Zalesak's sphere (paper, Fig. 4).
//!
//! ```text
//!   particles of the body ───────flow──▶ particles of each frame ──▶ a surface by each program
//!                                                                        │ distances d of the points
//!   points on the first surface ─flow──▶ points at that time ────────────┘ from the surface: see flicker.rs
//! ```
//!
//! All programs get the same particles and the same grid. The points of a program start on its own surface of
//! the first frame, evenly by area. Particles on a lattice fill the body, except for half a spacing below its
//! surface. Zalesak's sphere has the radius 0.15, and a notch 0.05 wide and 0.125 deep.
//!
//! The whole surface may tremble, which the median of the second differences measures, or jump where a sheet
//! tears or two sheets meet, which the maximum shows. The share of the worst 5 % of the points in the sum of
//! squares is 5 % if all points flicker equally.

use std::path::Path;
use std::time::Instant;

use glam::DVec3;
use meniscus::render::{CameraPlacement, Layers, Picture, View, render};
use meniscus::surface::level_set::NarrowBand;
use meniscus::surface::obstacle::MeshSdf;
use meniscus::surface::smooth::Integrator;
use meniscus::surface::space::Lattice;

use crate::flicker::{Flicker, Score};
use crate::flow::Flow;
use crate::output::{Files, Plot};
use crate::samples::{on_mesh, particles_in};
use crate::splashsurf::{Post, Splashsurf};
use crate::surfaces::{HALF_WIDTH, Program, Scale, band_of, mesh_of};
use crate::{Outcome, print_progress};

/// Number of frames of a whole cycle. With 5 000 particles, the fastest moves by one and a half spacings per
/// frame.
const FRAMES: usize = 300;

const POINTS: usize = 4000;

/// Frames that are rendered.
const PICTURES: [usize; 4] = [0, FRAMES / 6, FRAMES / 3, FRAMES / 2];

/// A flow, and the number of particles in the body that it carries.
struct Case {
    flow: Flow,
    count: usize,
    /// Whether to run the whole cycle. The second half of the test of Enright repeats the frames of the
    /// first.
    is_whole: bool,
    /// Out of this many frames, three consecutive ones are reconstructed. Their score represents all frames.
    every: usize,
}

impl Case {
    /// All distinct frames.
    fn short(flow: Flow, count: usize) -> Case {
        Case { flow, count, is_whole: flow != Flow::Enright, every: 1 }
    }

    /// The whole cycle, of which some frames are reconstructed.
    fn sampled(flow: Flow, count: usize) -> Case {
        Case { flow, count, is_whole: true, every: 10 }
    }

    fn name(&self) -> &'static str {
        match self.flow {
            Flow::Enright => "Enright",
            Flow::Zalesak => "Zalesak",
        }
    }

    fn is_pictured(&self, program: Program) -> bool {
        let is_comparison = program == Program::Splashsurf(Post::Processed) && self.is_first();
        program == Program::Meniscus(Integrator::Fast) || is_comparison
    }

    /// The first case of each study is plotted, and rendered next to splashsurf.
    fn is_first(&self) -> bool {
        self.flow == Flow::Enright && self.count >= 5_000
    }

    /// Multiples of `every`, and the frames next to them.
    fn takes(&self, frame: usize) -> bool {
        (frame + 1) % self.every <= 2
    }

    fn frame_count(&self) -> usize {
        if self.is_whole { FRAMES } else { FRAMES / 2 }
    }
}

/// The voxel size.
#[derive(Clone, Copy)]
struct Grid {
    part: &'static str,
    scale: fn(f64) -> Scale,
}

const FINE: Grid = Grid { part: "fine", scale: Scale::fine };
const USUAL: Grid = Grid { part: "usual", scale: Scale::usual };

/// What to compare.
struct Study {
    name: &'static str,
    cases: Vec<Case>,
    programs: &'static [Program],
    grids: &'static [Grid],
}

/// The flicker of programs, on both grids.
pub(crate) fn run(folder: &Path) -> Outcome<()> {
    let cases = [(Flow::Enright, 5_000), (Flow::Enright, 500), (Flow::Zalesak, 5_000)];
    let study = Study {
        name: "flows",
        cases: cases.map(|(flow, count)| Case::short(flow, count)).into(),
        programs: &Program::USUAL,
        grids: &[FINE, USUAL],
    };
    study.publish(folder)
}

/// The flicker of our three integrators with their defaults.
pub(crate) fn run_integrators(folder: &Path) -> Outcome<()> {
    let cases = [(Flow::Enright, 5_000), (Flow::Enright, 500), (Flow::Zalesak, 5_000)];
    let study = Study {
        name: "flows_integrators",
        cases: cases.map(|(flow, count)| Case::sampled(flow, count)).into(),
        programs: &Program::OURS,
        grids: &[USUAL],
    };
    study.publish(folder)
}

/// The flicker of all programs with more particles. The paper's finest set of particles is on such a grid.
pub(crate) fn run_many(folder: &Path) -> Outcome<()> {
    let study = Study {
        name: "flows_many",
        cases: vec![Case::sampled(Flow::Enright, 50_000)],
        programs: &Program::ALL,
        grids: &[USUAL],
    };
    study.publish(folder)
}

impl Study {
    fn publish(&self, folder: &Path) -> Outcome<()> {
        let peer = Splashsurf::find()?;
        let files = Files::new(folder, self.name);
        self.grids.iter().try_for_each(|grid| self.publish_grid(grid, &peer, &files))
    }

    fn publish_grid(&self, grid: &Grid, peer: &Splashsurf, files: &Files) -> Outcome<()> {
        let mut rows = Vec::new();
        let mut curves = Vec::new();
        let mut pictures = Vec::new();
        for case in &self.cases {
            for &program in self.programs {
                let start = Instant::now();
                let sequence = follow(case, program, peer, grid.scale)?;
                let row = sequence.row(case, program);
                print_progress(&format!("{}: {:.0} s", row.join(", "), start.elapsed().as_secs_f64()))?;
                rows.push(row);
                if case.is_first() {
                    curves.push((program.name().to_owned(), sequence.over_time));
                }
                if case.is_pictured(program) {
                    pictures.push(sequence.pictures);
                }
            }
        }
        files.table(grid.part, &COLUMNS, &rows)?;
        let title = "The first of them: flicker around each frame".to_owned();
        let axes = ["frame", "flicker, h"];
        files.plot(grid.part, &Plot { title, axes, is_log: [false, true], curves })?;
        files.pictures(grid.part, pictures)
    }
}

const COLUMNS: [&str; 8] = [
    "sequence",
    "particles",
    "program",
    "flicker, h",
    "median, h",
    "99th percentile, h",
    "maximum, h",
    "share of the worst 5 %",
];

/// The results of a sequence.
struct Sequence {
    particle_count: usize,
    score: Score,
    over_time: Vec<[f64; 2]>,
    pictures: Vec<(Picture, String)>,
}

impl Sequence {
    fn row(&self, case: &Case, program: Program) -> Vec<String> {
        let Score { rms, median, most, max, worst } = self.score;
        let number = |value: f64| format!("{value:.4}");
        let sequence = if case.is_whole { "a whole cycle" } else { "half a cycle" };
        vec![
            format!("{}, {sequence}", case.name()),
            self.particle_count.to_string(),
            program.name().into(),
            number(rms),
            number(median),
            number(most),
            format!("{max:.2}"),
            format!("{:.0} %", 100.0 * worst),
        ]
    }
}

fn follow(case: &Case, program: Program, peer: &Splashsurf, scale: fn(f64) -> Scale) -> Outcome<Sequence> {
    let (mut particles, spacing) = particles_in(case.flow, case.count);
    let scale = scale(spacing);
    let mut points = Vec::new();
    let mut flicker = Flicker::default();
    let mut pictures = Vec::new();
    let time = |frame: usize| case.flow.period() * frame as f64 / FRAMES as f64;
    for frame in 0..=case.frame_count() {
        if case.takes(frame) {
            let mesh = mesh_of(program, peer, &particles, scale)?;
            let solid = MeshSdf::new(&mesh.positions, &mesh.triangles);
            if frame == 0 {
                points = on_mesh(&mesh, POINTS);
            }
            flicker.add(frame, &solid, &points)?;
            if case.is_pictured(program) && PICTURES.contains(&frame) {
                let name = if let Program::Splashsurf(_) = program { program.name() } else { case.name() };
                let label = format!("{name}, {} particles, frame {frame}", particles.len());
                let voxel_size = 0.5 * scale.voxel_size;
                pictures.push((picture(&band_of(&mesh, voxel_size, HALF_WIDTH), voxel_size), label));
            }
        }
        case.flow.carry(&mut particles, time(frame), time(frame + 1));
        case.flow.carry(&mut points, time(frame), time(frame + 1));
    }
    let over_time = flicker.over_time(scale.voxel_size);
    let score = flicker.score(scale.voxel_size)?;
    Ok(Sequence { particle_count: particles.len(), score, over_time, pictures })
}

/// Renders the part of the unit cube that the bodies reach.
fn picture(band: &NarrowBand, voxel_size: f64) -> Picture {
    let bounds = [DVec3::splat(0.05), DVec3::splat(0.95)];
    let view = View {
        size: [300, 300],
        camera: CameraPlacement { zoom: 1.25, ..CameraPlacement::AUTO }.around(bounds, 1.0),
        up: CameraPlacement::AUTO.up,
        ground: None,
    };
    render(band, &Lattice { voxel_size }, &view, Layers { data: false, velocity: None })
}
