//! From a level set that is given, and no particles, to its surface: within bounds around the given one, or as it is.
//!
//! ```text
//!   φ given ──no slack──────────────────────────────▶ contour
//!      └────slack s──▶ φ − s ≤ φ ≤ φ + s ──smooth──▶ contour
//! ```
//!
//! The smoothest surface that nowhere leaves the given one by more than the slack: what spheres are to particles, the given surface
//! is to itself.

use std::convert::Infallible;
use std::time::Instant;

use super::finish::{Checked, Stored};
use super::{Surface, SurfaceAttributes, finish, lattice, smooth_config};
use crate::certify::{Part, certificate};
use crate::contour;
use crate::grid::Field;
use crate::level_set::{Bounds, NarrowBand, widened};
use crate::report::SkinReport;
use crate::settings::Settings;
use crate::smooth;

/// The largest slack, in voxels: the band around it is stored no wider.
pub const SLACK_MAX_VOXELS: f32 = 3.0;

/// What programs expect of the band of a level set, in voxels: a narrower one is made as wide.
const HALF_WIDTH_MIN: f32 = 3.0;

/// How much wider than the slack the band is that smoothing works in, in voxels.
const MARGIN: f32 = 5.0;

/// The surface of a level set with values in voxels of the settings' size. With a slack, in voxels, it is the smoothest one that
/// is nowhere farther than that from the given one. Of the settings those of particles have no say.
/// `stored` says how files store the mesh: so it is checked.
pub fn resurface(band: NarrowBand, slack_voxels: f32, settings: &Settings, stored: &[Stored]) -> Surface {
    let started = Instant::now();
    let slack = slack_voxels.clamp(0.0, SLACK_MAX_VOXELS);
    let mut band = match slack > 0.0 {
        true => widened(&band, MARGIN + slack.ceil()),
        false if band.half_width < HALF_WIDTH_MIN => widened(&band, HALF_WIDTH_MIN),
        false => band,
    };
    let bounds = Bounds { lower: moved(&band.phi, -slack), upper: moved(&band.phi, slack) };
    let mut report = SkinReport { leaf_count: band.topology.len(), ..SkinReport::default() };
    report.seconds.rasterize = started.elapsed().as_secs_f64();
    let started = Instant::now();
    if slack > 0.0 {
        let smoothed = smooth::smooth(&mut band, &bounds, &smooth_config(settings));
        report.free_voxel_count = smoothed.free_voxel_count;
        report.pass_count = smoothed.pass_count;
        report.moved_count = smoothed.moved_count;
        report.reach_voxels = smoothed.reach_voxels;
        report.convergence = smoothed.convergence;
        report.cfl_exceeded_count = smoothed.cfl_exceeded_count;
    }
    report.seconds.smooth = started.elapsed().as_secs_f64();
    let started = Instant::now();
    let lattice = lattice(settings);
    let mut mesh = contour::contour(&band, &lattice, settings.contouring);
    report.bending_energy = contour::bending_energy(&band, &lattice, &mesh);
    // There is no particle to ask about.
    let no_part = |_: &Checked, _: &mut dyn FnMut(&Part)| Ok::<(), Infallible>(());
    let Ok(checks) = finish::settle(&mut mesh, &band, (settings, stored), &mut report, no_part);
    let counts = (bounds.violation_count(&band.phi), 0);
    report.certificate = certificate(checks, counts, &mesh, &report.mesh, &lattice);
    report.seconds.contour = started.elapsed().as_secs_f64();
    Surface { band, mesh, attributes: SurfaceAttributes::default(), report }
}

fn moved(phi: &Field, by: f32) -> Field {
    let mut moved = phi.clone();
    moved.leaves.iter_mut().flat_map(|leaf| &mut leaf.values).for_each(|phi| *phi += by);
    moved
}
