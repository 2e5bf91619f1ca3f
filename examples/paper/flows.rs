//! Sequences with known motion: the test of Enright, and Zalesak's sphere (paper, Fig. 4).
//!
//! ```text
//!   particles of the body ───────flow──▶ particles of each frame ──▶ a surface by each program
//!                                                                        │ distances d of the points
//!   points on the first surface ─flow──▶ points at that time ────────────┘ from the surface: see flicker.rs
//! ```
//!
//! All programs get the same particles and the same grid. The points of a program start on its own surface of
//! the first frame.

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
use crate::output::{Page, Plot};
use crate::samples::{on_mesh, particles_in};
use crate::splashsurf::{Post, Splashsurf};
use crate::surfaces::{Program, Scale, band_of, mesh_of};
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

    /// The first case of each page is plotted, and rendered next to splashsurf.
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
    heading: &'static str,
    scale: fn(f64) -> Scale,
}

const FINE: Grid = Grid { part: "fine", heading: ON_FINE, scale: Scale::fine };
const USUAL: Grid = Grid { part: "usual", heading: ON_USUAL, scale: Scale::usual };

/// The contents of a page.
struct Study {
    name: &'static str,
    title: &'static str,
    introduction: &'static str,
    cases: Vec<Case>,
    programs: &'static [Program],
    grids: &'static [Grid],
}

/// The flicker of programs, on both grids.
pub(crate) fn run(folder: &Path) -> Outcome<()> {
    let cases = [(Flow::Enright, 5_000), (Flow::Enright, 500), (Flow::Zalesak, 5_000)];
    let study = Study {
        name: "flows",
        title: "Sequences in known flows",
        introduction: INTRODUCTION,
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
        title: "Sequences in known flows, by three integrators",
        introduction: SAMPLED,
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
        title: "50 000 particles in a known flow",
        introduction: SAMPLED,
        cases: vec![Case::sampled(Flow::Enright, 50_000)],
        programs: &Program::ALL,
        grids: &[USUAL],
    };
    study.publish(folder)
}

impl Study {
    fn publish(&self, folder: &Path) -> Outcome<()> {
        let peer = Splashsurf::find()?;
        let mut page = Page::new(folder, self.name, self.title);
        page.paragraph(self.introduction);
        for grid in self.grids {
            self.publish_grid(grid, &peer, &mut page)?;
        }
        page.finish()
    }

    fn publish_grid(&self, grid: &Grid, peer: &Splashsurf, page: &mut Page) -> Outcome<()> {
        page.paragraph(grid.heading);
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
        page.table(&COLUMNS, &rows);
        let title = "The first of them: flicker around each frame".to_owned();
        let axes = ["frame", "flicker, h"];
        page.plot(grid.part, &Plot { title, axes, is_log: [false, true], curves })?;
        page.pictures(
            grid.part,
            "Sequences at four times: surfaces of meniscus, unless another program is named",
            pictures,
        )
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

const INTRODUCTION: &str = "\
Particles on a lattice fill a body, except for half a spacing below its surface, and an analytic flow carries them: any motion of the surface relative to the flow comes from the program.
A cycle has 300 frames: 12.5 seconds at 24 frames per second.
4000 points start on the first surface of each program, evenly by area, and follow the flow as well.

The flicker is the root mean square of the second difference in time of the points' signed distances to the surface, in units of h.
It has two parts: the whole surface trembles, which the median measures, and it jumps where a sheet tears or two sheets meet, which the maximum shows.
The last column is the share of the worst 5 % of the points in the sum of squares: 5 % if all points flicker equally.
The unit is h, so only scores on the same grid can be compared.

In the second half of the test of Enright all frames of the first return in reverse, so a whole cycle has nearly the score of its half, which is in the table.
Zalesak's sphere has the radius 0.15, and a notch 0.05 wide and 0.125 deep.";

const SAMPLED: &str = "\
The flows are those of [flows.md](flows.md). This page covers a whole cycle, but only three consecutive frames of every ten are reconstructed: 29 of the 299 second differences.";

const ON_FINE: &str = "\
## On a fine grid

h is a quarter of the spacing, the cell size that splashsurf recommends, and splashsurf has the settings that its authors recommend.
As in the paper, the radii of meniscus do not follow such a grid: r_min is the spacing, r_max twice as much.
There are 30 Laplacian steps, between the 15 of the usual grid and the 60 that would reach as far in world units.
r_min and these steps were chosen for sequences by this score, from a few candidates: with r_min at 0.87 spacings and 15 steps, the values of the usual grid, the flicker of 5 000 particles was a fifth larger.
For a spacing of 1 the options are `--voxel-size 0.25 --radius-min 1 --laplacian-steps 30`.
Time steps are in units of h, so smoothing reaches less far here than on the usual grid: at frame 0 the steps of the lattice are visible.";

const ON_USUAL: &str = "\
## On the usual grid

h is half the spacing, and all other settings are those of the preset `paper`.
splashsurf's cells have the same size, which is twice what it recommends.";

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
                pictures.push((picture(&band_of(&mesh, voxel_size), voxel_size), label));
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
