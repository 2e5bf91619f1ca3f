//! One frame of a dam break with different settings (paper, Fig. 3 and 6 to 9).

use std::path::Path;
use std::time::Instant;

use glam::DVec3;
use meniscus::render::{CameraPlacement, Layers, Picture, View, render};
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus::surface::particles::OwnedPositions;
use meniscus::surface::reconstruction::{FrameSurface, reconstruct_frame, reconstruct_frame_observed};
use meniscus::surface::report::Phase;
use meniscus::surface::smooth::Integrator;
use meniscus::surface::space::Lattice;
use meniscus_formats::{FilePositions, Limits, read_particles};

use crate::Outcome;
use crate::output::{Files, Plot};

/// A frame that the example `dam_break` made.
const FRAME: &str = "examples/frames/dam.0006.bgeo";

/// Half the spacing.
pub(crate) const VOXEL_SIZE: f64 = 0.5 * SPACING;

const SPACING: f64 = 0.05;

const RATIOS: [f64; 5] = [1.0, 1.25, 1.5, 2.0, 4.0];

/// Pseudo-times of the smoothing, in units of h⁴. With the preset `paper`, the time is 100 in five implicit
/// steps of 20, or 5 in 500 explicit steps of 0.01.
const TIMES: [f64; 7] = [0.0, 5.0, 20.0, 40.0, 60.0, 80.0, 100.0];

/// Varies the radius ratio, the voxel size and the smoothing time, and plots the bending energy over the last.
pub(crate) fn run(folder: &Path) -> Outcome<()> {
    let files = Files::new(folder, "frame");
    let particles = particles()?;
    ratios(&files, &particles)?;
    voxels(&files, &particles)?;
    energies(&files, &particles)
}

fn ratios(files: &Files, particles: &OwnedPositions) -> Outcome<()> {
    let mut rows = Vec::new();
    let mut pictures = Vec::new();
    for ratio in RATIOS {
        let choices = MethodOptions { radius_ratio: Some(ratio), ..MethodOptions::default() };
        let surface = reconstruct_frame(particles, &Settings::paper(VOXEL_SIZE, &choices)?);
        let measures = &surface.report.mesh;
        rows.push(vec![
            ratio.to_string(),
            format!("{:.0}", measures.bending_energy),
            format!("{:.4}", measures.volume),
            measures.component_count.to_string(),
            if surface.report.certificate.holds() { "holds" } else { "does not hold" }.to_owned(),
        ]);
        pictures.push((picture(&surface, VOXEL_SIZE, [400, 260]), format!("r_max / r_min = {ratio}")));
    }
    files.table("ratios", &["r_max / r_min", "∫H²", "volume, m³", "pieces", "certificate"], &rows)?;
    let second = pictures.split_off(3);
    files.pictures("ratios", vec![pictures, second])
}

fn voxels(files: &Files, particles: &OwnedPositions) -> Outcome<()> {
    let mut rows = Vec::new();
    let mut pictures = Vec::new();
    let usual = Settings::paper(VOXEL_SIZE, &MethodOptions::default())?;
    let radii = MethodOptions { radius_min: Some(usual.radius_min.into()), ..MethodOptions::default() };
    for (part, choices) in [(1.0, MethodOptions::default()), (0.5, MethodOptions::default()), (0.25, radii)] {
        let voxel_size = part * SPACING;
        let surface = reconstruct_frame(particles, &Settings::paper(voxel_size, &choices)?);
        let measures = &surface.report.mesh;
        rows.push(vec![
            part.to_string(),
            format!("{:.0}", measures.bending_energy),
            format!("{:.4}", measures.volume),
            surface.mesh.triangles.len().to_string(),
        ]);
        pictures.push((picture(&surface, voxel_size, [400, 260]), format!("h = {part} spacings")));
    }
    files.table("voxels", &["h / spacing", "∫H²", "volume, m³", "triangles"], &rows)?;
    files.pictures("voxels", vec![pictures])
}

fn energies(files: &Files, particles: &OwnedPositions) -> Outcome<()> {
    let mut rows = Vec::new();
    let mut over_time = Vec::new();
    let mut over_seconds = Vec::new();
    let mut pictures = Vec::new();
    for (name, integrator, step_size) in [
        ("explicit", Integrator::Explicit, 0.01),
        ("implicit", Integrator::Implicit, 20.0),
        ("fast", Integrator::Fast, 20.0),
    ] {
        let mut surfaces = Vec::new();
        for time in TIMES {
            // Use the fastest run: other processes may have slowed down the others.
            let mut runs = Vec::new();
            for _ in 0..3 {
                runs.push(after(particles, integrator, time, step_size)?);
            }
            runs.sort_by(|(_, one), (_, other)| f64::total_cmp(one, other));
            let (surface, seconds) = runs.swap_remove(0);
            surfaces.push((time, surface, seconds));
        }
        let energy = |surface: &FrameSurface| surface.report.mesh.bending_energy;
        for (time, surface, seconds) in &surfaces {
            rows.push(vec![
                name.into(),
                format!("{time}"),
                format!("{:.0}", energy(surface)),
                format!("{seconds:.3}"),
            ]);
        }
        over_time.push((name.to_owned(), surfaces.iter().map(|(time, s, _)| [*time, energy(s)]).collect()));
        let taken = surfaces.iter().skip(1).map(|(_, s, seconds)| [*seconds, energy(s)]);
        over_seconds.push((name.to_owned(), taken.collect()));
        let some = [0, 2, 4, 6].into_iter().filter_map(|index| surfaces.get(index));
        // Captions cannot contain ⁴: the font of contact sheets has only the characters of Latin-1.
        let shown = some.map(|(time, surface, _)| {
            (picture(surface, VOXEL_SIZE, [300, 200]), format!("{name}, time {time}"))
        });
        pictures.push(shown.collect());
    }
    let choices = MethodOptions { laplacian_steps: Some(0), steps: Some(0), ..MethodOptions::default() };
    let first =
        reconstruct_frame(particles, &Settings::paper(VOXEL_SIZE, &choices)?).report.mesh.bending_energy;
    rows.push(vec!["before the Laplacian steps".into(), "–".into(), format!("{first:.0}"), "–".into()]);
    files.table("time", &["integrator", "time, h⁴", "∫H²", "seconds of smoothing"], &rows)?;
    let title = "Bending energy over integration time".to_owned();
    let axes = ["time, h⁴", "∫H²"];
    files.plot("time", &Plot { title, axes, is_log: [false; 2], curves: over_time })?;
    let title = "Bending energy over seconds".to_owned();
    let axes = ["seconds of smoothing", "∫H²"];
    files.plot("seconds", &Plot { title, axes, is_log: [true, false], curves: over_seconds })?;
    files.pictures("time", pictures)
}

/// The surface after this pseudo-time, in steps of equal size, at most `step_size`, and the seconds that
/// smoothing it took.
fn after(
    particles: &OwnedPositions,
    integrator: Integrator,
    time: f64,
    step_size: f64,
) -> Outcome<(FrameSurface, f64)> {
    let steps = (time / step_size).ceil().max(1.0);
    let choices = MethodOptions {
        integrator: Some(integrator),
        steps: Some(if time == 0.0 { 0 } else { steps as u32 }),
        step_size: Some(if time == 0.0 { step_size } else { time / steps }),
        ..MethodOptions::default()
    };
    let settings = Settings::paper(VOXEL_SIZE, &choices)?;
    let mut starts = Vec::new();
    let surface = reconstruct_frame_observed(particles, &settings, &mut |phase| {
        starts.push((phase, Instant::now()));
    });
    let start = |wanted| starts.iter().find(|(phase, _)| *phase == wanted).map(|(_, start)| *start);
    let smoothing = start(Phase::Contour).zip(start(Phase::Smooth)).map(|(end, start)| end - start);
    Ok((surface, smoothing.unwrap_or_default().as_secs_f64()))
}

/// The particles of the frame.
pub(crate) fn particles() -> Outcome<OwnedPositions> {
    let frame = read_particles(&std::fs::read(FRAME)?, FRAME, &Limits::default())?;
    Ok(match frame.positions {
        FilePositions::F32(positions) => OwnedPositions::F32(positions),
        FilePositions::F64(positions) => OwnedPositions::F64(positions),
    })
}

fn picture(surface: &FrameSurface, voxel_size: f64, size: [usize; 2]) -> Picture {
    let tank = [DVec3::ZERO, DVec3::new(1.6, 0.9, 0.6)];
    let aspect = size[0] as f64 / size[1] as f64;
    let camera = CameraPlacement::AUTO.around(tank, aspect);
    let view = View { size, camera, up: CameraPlacement::AUTO.up, ground: Some(0.0) };
    render(&surface.band, &Lattice { voxel_size }, &view, Layers { data: false, velocity: None })
}
