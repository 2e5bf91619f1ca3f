//! Writes surfaces and particles to files, on threads that wait for the disk so that compute threads do not.

use std::fs::File;
use std::io::BufWriter;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam::channel::Sender;
use glam::DVec3;
use meniscus_formats::ParticleFrame;

use crate::pipeline::error::{FrameError, Stage};
use crate::pipeline::input::around;
use crate::pipeline::input::frame::{Frame, FrameReport, Job, Outcome};
use crate::pipeline::memory::peak_memory_bytes;
use crate::pipeline::output::particle_files::{particle_warnings, write_particles_as};
use crate::pipeline::output::spray_files::{points_of, write_points};
use crate::pipeline::output::writing::{WrittenFiles, surface_warnings, write_files, write_surface_as};
use crate::pipeline::records::provenance::{MadeFrom, provenance, spray_provenance};
use crate::pipeline::target::outputs::OutputKind;
use crate::pipeline::target::picture::PictureScene;
use crate::pipeline::warning::Warning;
use crate::surface::reconstruction::FrameSurface;
use crate::surface::space::Lattice;

use super::{FinishedFrame, Inlet, InputInfo, InputNotes, ObstacleSummary, Passed, Stages, WorkItem};

impl<'scope, 'env: 'scope> Stages<'_, 'scope, 'env> {
    /// Writes frames until there are no more. Once the caller no longer receives outcomes, discards frames.
    pub(super) fn write<K>(
        &self,
        from: &Inlet<WorkItem<'env, K, Passed<FrameSurface>>>,
        finished: &Sender<FinishedFrame<K>>,
    ) {
        let mut is_abandoned = false;
        while let Some(WorkItem { order, key, frame, info, content }) = from.receive() {
            // Discarded frames are still taken from the channel: the earlier stages wait for free slots.
            if is_abandoned {
                continue;
            }
            // With `OnError::Stop`, frames keep their order, and all earlier frames have passed the other
            // stages. So timing does not affect which frames are written before a stop.
            let outcome = match content {
                _ if self.shared.is_stopped_before(order) => Outcome::NotStarted,
                Passed::Surface(surface) => self.write_surface(order, &frame, info, surface),
                Passed::Particles(particles) => self.write_particles(&frame, info, &particles),
            };
            is_abandoned = !self.shared.finish(order, finished, FinishedFrame { key, frame, outcome });
        }
    }

    fn write_particles(&self, frame: &Frame, info: InputInfo<'_>, particles: &ParticleFrame) -> Outcome {
        let start = Instant::now();
        self.shared.begin(frame, Stage::Write);
        let written = FrameError::catch(&frame.input, Stage::Write, || {
            let write = |kind: OutputKind, out: &mut BufWriter<&File>| {
                // A conversion of particles has no spray.
                let OutputKind::Frame(format) = kind else { return Ok(()) };
                let made_from = MadeFrom { input_hash: info.input.hash, ..MadeFrom::default() };
                let provenance = provenance(frame, made_from, format);
                write_particles_as(particles, format, &provenance, out)
            };
            let written = write_files(frame, write)?;
            let warnings = particle_warnings(particles, &frame.outputs.formats);
            let mut report = base_report(frame, info, written, warnings);
            report.reconstruction.particle_count = particles.positions.len();
            report.seconds.write = start.elapsed().as_secs_f64();
            record_frame(frame, report)
        });
        converted(written.flatten())
    }

    fn write_surface(
        &self,
        order: usize,
        frame: &Frame,
        mut info: InputInfo<'_>,
        surface: FrameSurface,
    ) -> Outcome {
        let start = Instant::now();
        self.shared.begin(frame, Stage::Write);
        let surface = Arc::new(surface);
        // Everything runs within `catch`, so that a panic in the framing, too, fails only this frame.
        let written = FrameError::catch(&frame.input, Stage::Write, || {
            let frame = &match frame.framing.as_ref().filter(|_| frame.has_pictures()) {
                Some(framing) => frame.with_camera(framing.camera_for(bounds_of(&surface, frame))),
                None => frame.clone(),
            };
            let around = around::recorded(&info.around, frame.settings.frame_reach().beside);
            let made_from = MadeFrom {
                input_hash: info.input.hash,
                obstacles: &info.obstacles.recorded,
                around: &around,
            };
            let mut preview_time = Duration::ZERO;
            let points = surface.spray.as_ref().map(points_of).unwrap_or_default();
            let written = write_files(frame, |kind, out| {
                let start = Instant::now();
                let format = match kind {
                    OutputKind::Frame(format) => format,
                    OutputKind::Spray(format) => {
                        let provenance = spray_provenance(frame, made_from, format);
                        return write_points(&points, format, &frame.outputs, &provenance, out);
                    }
                };
                if format.is_picture() {
                    self.shared.begin(frame, Stage::Preview);
                }
                let written =
                    write_surface_as(&surface, (order, frame), made_from, format, &self.scheduler, out);
                if format.is_picture() {
                    self.shared.begin(frame, Stage::Write);
                    preview_time += start.elapsed();
                }
                written
            })?;
            info.seconds.write = start.elapsed().saturating_sub(preview_time).as_secs_f64();
            info.seconds.preview = preview_time.as_secs_f64();
            let mut warnings = surface_warnings(&surface, &frame.outputs, &frame.settings);
            let of_points = frame.outputs.spray.iter().flat_map(|format| format.notes(&points));
            warnings.extend(of_points.map(Warning::new));
            let reconstruction = surface.report.clone();
            record_frame(frame, FrameReport { reconstruction, ..base_report(frame, info, written, warnings) })
        });
        converted(written.flatten())
    }
}

/// Records a frame whose outputs all have their names.
fn record_frame(frame: &Frame, report: FrameReport) -> Result<FrameReport, FrameError> {
    let recorded = frame.record_done(report).map_err(meniscus_formats::Error::from);
    recorded.map_err(|error| FrameError::file(&frame.outputs.folder, Stage::Write, error))
}

fn converted(written: Result<FrameReport, FrameError>) -> Outcome {
    written.map_or_else(Outcome::Failed, |report| Outcome::Converted(Box::new(report)))
}

/// The part of a frame's report that is the same for particles and surfaces.
fn base_report(
    frame: &Frame,
    info: InputInfo<'_>,
    written: WrittenFiles,
    warnings: Vec<Warning>,
) -> FrameReport {
    let ObstacleSummary { recorded, open_edge_count } = info.obstacles;
    let InputNotes { warnings: of_input, unused_velocity, .. } = info.noted;
    let has_attributes = frame.outputs.formats.iter().any(|format| format.has_attributes());
    FrameReport {
        input: info.input,
        obstacles: recorded,
        around: around::recorded(&info.around, frame.settings.frame_reach().beside),
        obstacle_open_edge_count: open_edge_count,
        voxel_size: matches!(frame.job, Job::LevelSet { .. }).then_some(frame.settings.voxel_size),
        seconds: info.seconds,
        peak_memory_bytes: peak_memory_bytes(),
        outputs: written.paths,
        files: written.files,
        warnings: [of_input, warnings].concat(),
        unused_velocity: unused_velocity.filter(|_| has_attributes),
        ..FrameReport::default()
    }
}

/// The bounding box of the surface and of the points beside it, without outliers.
fn bounds_of(surface: &FrameSurface, frame: &Frame) -> Option<[DVec3; 2]> {
    let lattice = Lattice { voxel_size: frame.settings.voxel_size };
    let (origin, spray) = (frame.job.origin(), surface.spray.as_ref());
    PictureScene { band: &surface.band, lattice, origin, velocity: None, spray }.bounds()
}
