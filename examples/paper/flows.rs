//! Sequences of which the motion is known: the test of Enright, and Zalesak's sphere (paper, Fig. 4).
//!
//! ```text
//!   particles of the body ──flow──▶ particles of each frame ──▶ a surface by each program
//!                                                                      │ distances
//!   points on the first surface ──flow──▶ points at that time ─────────┘
//! ```
//!
//! Every program has the same particles and the same grid. The points begin on the surface that is scored.

use std::path::Path;
use std::time::Instant;

use glam::DVec3;
use meniscus::obstacle::Solid;
use meniscus::preview::{Layers, Picture, Placement, View, render};
use meniscus::skin::Surface;
use meniscus::smooth::Integrator;
use meniscus::space::Lattice;

use crate::flicker::{Flicker, Score};
use crate::flow::Flow;
use crate::output::{Page, Plot};
use crate::samples::{on_surface, particles_in};
use crate::splashsurf::{Post, Splashsurf};
use crate::surfaces::{Program, Scale, mesh_of, skinned};
use crate::{Length, Outcome, told};

/// Frames of a whole cycle. The quickest of 5 000 particles moves by a spacing and a half between two.
const FRAMES: usize = 300;

const POINTS: usize = 4000;

/// Where pictures are taken, in parts of a cycle.
const PICTURES: [usize; 4] = [0, FRAMES / 6, FRAMES / 3, FRAMES / 2];

/// A body of so many particles in a flow.
struct Case {
    title: &'static str,
    flow: Flow,
    count: usize,
}

/// How large voxels are.
struct Grid {
    part: &'static str,
    heading: &'static str,
    scale: fn(f64) -> Scale,
}

const GRIDS: [Grid; 2] = [
    Grid { part: "fine", heading: FINE, scale: Scale::fine },
    Grid { part: "usual", heading: USUAL, scale: Scale::usual },
];

/// The flicker of programs, on either grid.
pub(crate) fn run(folder: &Path, length: Length) -> Outcome<()> {
    let peer = Splashsurf::find()?;
    let mut page = Page::new(folder, "flows", "Sequences in known flows");
    page.say(INTRODUCTION);
    let enright = |title, count| Case { title, flow: Flow::Enright, count };
    let mut cases = vec![
        enright("Enright, 5 000 particles", 5_000),
        enright("Enright, 500 particles", 500),
        Case { title: "Zalesak, 5 000 particles", flow: Flow::Zalesak, count: 5_000 },
    ];
    let programs = match length {
        Length::Short => &Program::USUAL[..],
        Length::Long => {
            cases.push(enright("Enright, 50 000 particles", 50_000));
            &Program::ALL
        }
    };
    for Grid { part, heading, scale } in GRIDS {
        page.say(heading);
        let mut rows = Vec::new();
        let mut curves = Vec::new();
        let mut pictures = Vec::new();
        for case in &cases {
            for &program in programs {
                let start = Instant::now();
                let sequence = follow(case, program, &peer, scale, length)?;
                rows.push(sequence.row(case, program));
                told(&format!(
                    "{}: {:.0} s",
                    rows.last().unwrap_or(&Vec::new()).join(", "),
                    start.elapsed().as_secs_f64()
                ))?;
                let is_compared = matches!(
                    program,
                    Program::Meniscus(Integrator::Fast) | Program::Splashsurf(Post::Plain | Post::Processed)
                );
                if case.count == 5_000 && case.flow == Flow::Enright && is_compared {
                    curves.push((program.name().to_owned(), sequence.over_time));
                }
                if program == Program::Meniscus(Integrator::Fast) {
                    pictures.push(sequence.pictures);
                }
            }
        }
        page.table(&["sequence", "program", "flicker, h", "median, h", "greatest, h"], &rows);
        page.plot(
            part,
            &Plot {
                title: "Enright, 5 000 particles: flicker of each frame".to_owned(),
                axes: ["frame", "flicker, h"],
                is_log: [false, true],
                curves,
            },
        )?;
        page.pictures(part, "Each sequence at four times", pictures)?;
    }
    page.finish()
}

const INTRODUCTION: &str = "\
Particles on a lattice fill a body, but for half a spacing below its surface, so there are some less than their name says, and are carried by a flow that is known everywhere, so that nothing of what a surface does but follow them is their doing. \
300 frames make a cycle: twelve and a half seconds of film. 4000 points begin on the first surface of each program, and are carried as well. The flicker is the root of the mean square of the second \
difference in time of their signed distances to the surface, in units of h. It has two parts: a trembling of all the surface, which the median tells, \
and jumps where a sheet tears, or where two meet, which are the greatest.

In the second half of the test of Enright all frames of the first come back in reverse. That half is run with `--long` only, as are 50 000 particles and the other integrators.";

const FINE: &str = "\
## On a fine grid

h is a quarter of the spacing, which is the cell that splashsurf recommends. As the paper does it, the radii do not follow such a grid: r_min is the spacing, r_max twice as much. There are 30 Laplacian steps, \
for they reach half as far in the world.";

const USUAL: &str = "\
## On the usual grid

h is half the spacing, and all else is as meniscus has it where nothing is said. splashsurf's cells are as large.";

/// What came of a sequence.
struct Sequence {
    score: Score,
    over_time: Vec<[f64; 2]>,
    pictures: Vec<(Picture, String)>,
}

impl Sequence {
    fn row(&self, case: &Case, program: Program) -> Vec<String> {
        let Score { rms, median, max } = self.score;
        let number = |value: f64| format!("{value:.4}");
        vec![case.title.into(), program.name().into(), number(rms), number(median), format!("{max:.2}")]
    }
}

fn follow(
    case: &Case,
    program: Program,
    peer: &Splashsurf,
    scale: fn(f64) -> Scale,
    length: Length,
) -> Outcome<Sequence> {
    let (mut particles, spacing) = particles_in(case.flow, case.count);
    let scale = scale(spacing);
    let mut points = Vec::new();
    let mut flicker = Flicker::default();
    let mut pictures = Vec::new();
    let time = |frame: usize| case.flow.period() * frame as f64 / FRAMES as f64;
    // In the second half of the test of Enright all frames of the first come back.
    let is_half = case.flow == Flow::Enright && length == Length::Short;
    for frame in 0..=if is_half { FRAMES / 2 } else { FRAMES } {
        let mesh = mesh_of(program, peer, &particles, scale)?;
        let solid = Solid::new(&mesh.positions, &mesh.triangles);
        if frame == 0 {
            points = on_surface(case.flow, POINTS, |at| solid.distance(at).unwrap_or(f64::INFINITY));
        }
        flicker.add(&solid, &points);
        if let Program::Meniscus(integrator) = program
            && PICTURES.contains(&frame)
        {
            let surface = skinned(&particles, scale, integrator)?;
            pictures.push((picture(&surface, scale), format!("{}, frame {frame}", case.title)));
        }
        case.flow.carry(&mut particles, time(frame), time(frame + 1));
        case.flow.carry(&mut points, time(frame), time(frame + 1));
    }
    let over_time = flicker.over_time(scale.voxel_size);
    Ok(Sequence { score: flicker.score(scale.voxel_size), over_time, pictures })
}

/// All of the unit cube that bodies come to.
fn picture(surface: &Surface, scale: Scale) -> Picture {
    let bounds = [DVec3::splat(0.05), DVec3::splat(0.95)];
    let view = View {
        size: [300, 300],
        camera: Placement { zoom: 1.25, ..Placement::AUTO }.around(bounds, 1.0),
        up: Placement::AUTO.up,
        ground: None,
    };
    render(
        &surface.band,
        &Lattice { voxel_size: scale.voxel_size },
        &view,
        Layers { data: false, velocity: None },
    )
}
