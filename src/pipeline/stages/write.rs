//! From surfaces to files: threads that wait for the disk, so that none that computes does.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender};
use glam::DVec3;

use crate::pipeline::frame::{Frame, FrameError, FrameReport, Outcome, Stage};
use crate::pipeline::memory::peak_memory_bytes;
use crate::pipeline::notes::fault;
use crate::pipeline::open::require_no_links;
use crate::pipeline::outputs::OutputFormat;
use crate::pipeline::picture::Scene;
use crate::pipeline::writing::{Written, surface_notes, write_files, write_surface};
use crate::surface::skin::Surface;
use crate::surface::space::Lattice;

use super::line::{Ended, Known, Label, Line, Parcel};

impl<'scope, 'env: 'scope, M> Line<'_, 'scope, 'env, M> {
    /// Writes surfaces until there are none, or nobody listens any more.
    pub(super) fn write<'l, K>(&self, from: &Receiver<Parcel<'l, K, Surface>>, ended: &Sender<Ended<K>>) {
        for Parcel { label, known, content } in from {
            // Where frames keep their order, those before this one are past all other stages: what is
            // written before a stop does not depend on timing.
            let outcome = if self.is_stopped_before(label.number) {
                Outcome::NotStarted
            } else {
                self.write_one(&label, known, content)
            };
            if ended.send(self.end(label, outcome)).is_err() {
                return;
            }
        }
    }

    /// Refuses a folder that is reached through a link, where it mirrors one of inputs.
    pub(super) fn refuse_links(&self, folder: &Path) -> Result<(), FrameError> {
        let within = self.conduct.mirrors.iter().filter_map(|mirror| folder.strip_prefix(mirror).ok());
        let depth = within.map(|within| within.components().count()).min().unwrap_or(0);
        let refused = meniscus_formats::Error::from;
        require_no_links(folder, depth)
            .map_err(|error| FrameError::file(folder, Stage::Write, refused(error)))
    }

    fn write_one<K>(&self, label: &Label<K>, known: Known<'_>, surface: Surface) -> Outcome {
        let start = Instant::now();
        self.begin(&label.frame, Stage::Write);
        let made_from = (known.input.hash, known.obstacles.0.as_str());
        let surface = Arc::new(surface);
        let preview_time = Mutex::new(Duration::ZERO);
        // All of it: a panic in the framing, too, fails this frame alone.
        let written = FrameError::catch(&label.frame.input, Stage::Write, || {
            self.refuse_links(&label.frame.outputs.folder)?;
            let frame = &match label.frame.framing.as_ref().filter(|_| label.frame.has_pictures()) {
                Some(framing) => label.frame.taken_by(framing.camera_for(bounds_of(&surface, &label.frame))),
                None => label.frame.clone(),
            };
            let write = |format: OutputFormat, out: &mut BufWriter<&File>| {
                let mut write =
                    || write_surface(&surface, (label.number, frame), made_from, format, &self.crew, out);
                if !format.is_picture() {
                    return write();
                }
                let start = Instant::now();
                self.begin(&label.frame, Stage::Preview);
                let written = write();
                self.begin(&label.frame, Stage::Write);
                *preview_time.lock().unwrap_or_else(PoisonError::into_inner) += start.elapsed();
                written
            };
            let certify = self.conduct.certificates.then_some((known.input.hash, &surface.report));
            let written = write_files(frame, write, certify)?;
            self.conduct.record(&frame.output_paths(), fault(&surface.report).as_deref());
            Ok((written, surface_notes(&surface, &frame.outputs, &frame.settings)))
        });
        let preview_time = *preview_time.lock().unwrap_or_else(PoisonError::into_inner);
        match written.flatten() {
            Ok((Written { paths, sizes_bytes }, notes)) => Outcome::Converted(Box::new(FrameReport {
                input: known.input,
                skin: surface.report.clone(),
                obstacles: known.obstacles.0.clone(),
                obstacle_open_edge_count: known.obstacles.1,
                read_seconds: known.read_seconds,
                write_seconds: start.elapsed().saturating_sub(preview_time).as_secs_f64(),
                preview_seconds: preview_time.as_secs_f64(),
                peak_memory_bytes: peak_memory_bytes(),
                outputs: paths,
                output_bytes: sizes_bytes,
                notes: [known.noted.notes, notes].concat(),
                unused_velocity: known
                    .noted
                    .unused_velocity
                    .filter(|_| label.frame.outputs.formats.iter().any(|format| format.has_attributes())),
            })),
            Err(error) => Outcome::Failed(error),
        }
    }
}

/// The box that holds the surface, without what strayed.
fn bounds_of(surface: &Surface, frame: &Frame) -> Option<[DVec3; 2]> {
    let lattice = Lattice { voxel_size: frame.settings.voxel_size };
    Scene { band: &surface.band, lattice, origin: DVec3::ZERO, velocity: None }.bounds()
}
