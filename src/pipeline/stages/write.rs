//! From surfaces to files: threads that wait for the disk, so that none that computes does.

use std::fs::File;
use std::io::BufWriter;
use std::sync::Arc;
use std::time::Instant;

use crossbeam::channel::{Receiver, Sender};

use crate::pipeline::frame::{FrameError, FrameReport, Outcome, Stage};
use crate::pipeline::memory::peak_memory_bytes;
use crate::pipeline::writing::{Written, surface_notes, write_files, write_surface};
use crate::skin::Surface;

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

    fn write_one<K>(&self, label: &Label<K>, known: Known<'_>, surface: Surface) -> Outcome {
        let start = Instant::now();
        let frame = &label.frame;
        (self.began)(frame, Stage::Write);
        let made_from = (known.input.hash, known.obstacles.0.as_str());
        let surface = Arc::new(surface);
        let write = |format, out: &mut BufWriter<&File>| {
            write_surface(&surface, (label.number, frame), made_from, format, &self.crew, out)
        };
        let written = FrameError::catch(&frame.input, Stage::Write, || {
            let certify = self.conduct.certificates.then_some((known.input.hash, &surface.report));
            let written = write_files(frame, write, certify)?;
            Ok((written, surface_notes(&surface, &frame.outputs, &frame.settings)))
        });
        match written.flatten() {
            Ok((Written { paths, sizes_bytes }, notes)) => Outcome::Converted(Box::new(FrameReport {
                input: known.input,
                skin: surface.report.clone(),
                obstacles: known.obstacles.0.clone(),
                obstacle_open_edge_count: known.obstacles.1,
                read_seconds: known.read_seconds,
                write_seconds: start.elapsed().as_secs_f64(),
                peak_memory_bytes: peak_memory_bytes(),
                outputs: paths,
                output_bytes: sizes_bytes,
                notes: [known.noted.notes, notes].concat(),
                unused_velocity: known
                    .noted
                    .unused_velocity
                    .filter(|_| frame.outputs.formats.iter().any(|format| format.has_attributes())),
            })),
            Err(error) => Outcome::Failed(error),
        }
    }
}
