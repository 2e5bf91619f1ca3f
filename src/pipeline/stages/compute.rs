//! The three stages of the method: a lane for each core, which share one pool.

use std::sync::{Arc, PoisonError};

use crossbeam::channel::{Receiver, Sender};

use crate::pipeline::frame::{Cause, FrameError, Stage};
use crate::pipeline::method::Method;
use crate::surface::options::Settings;
use crate::surface::skin::Surface;

use super::line::{Ended, Known, Label, Line, Parcel, Read, outcome_of};

impl<'scope, 'env: 'scope, M: Method> Line<'_, 'scope, 'env, M> {
    /// From particles to level sets. A frame gets its seat and its memory here.
    pub(super) fn rasterize<'l, K>(
        &'l self,
        from: &Receiver<Parcel<'l, K, Read>>,
        to: &Sender<Parcel<'l, K, M::Rasterized>>,
        ended: &Sender<Ended<K>>,
    ) {
        let method = self.method;
        while let Some(Parcel { label, known, content }) = self.admit(from) {
            let scratch = label.frame.outputs.folder.clone();
            // A frame in tiles makes this folder and writes scratch files into it.
            let allowed = self.refuse_links(&scratch);
            let work = move |Read { particles, obstacles, plan }: Read, settings: &Settings| {
                method.rasterize(particles, obstacles, settings, &plan, &scratch)
            };
            let computed = allowed.and_then(|()| self.compute(Stage::Rasterize, &label, content, work));
            if !self.pass(label, known, computed, to, ended) {
                return;
            }
        }
    }

    /// The next frame, once there is a seat and memory for it. It is the one that was read first: nobody
    /// else waits here.
    fn admit<'l, K>(&'l self, from: &Receiver<Parcel<'l, K, Read>>) -> Option<Parcel<'l, K, Read>> {
        let _door = self.door.lock().unwrap_or_else(PoisonError::into_inner);
        let seat = self.seats.take();
        let mut parcel = from.recv().ok()?;
        let Read { particles, obstacles, plan } = &parcel.content;
        let given_bytes = particles.size_bytes().saturating_add(obstacles.own_bytes);
        parcel.known.memory.admit(plan.memory_bytes.saturating_add(given_bytes));
        parcel.known.seat = Some(seat);
        Some(parcel)
    }

    /// A frame keeps its seat.
    pub(super) fn smooth<'l, K>(
        &self,
        from: &Receiver<Parcel<'l, K, M::Rasterized>>,
        to: &Sender<Parcel<'l, K, M::Smoothed>>,
        ended: &Sender<Ended<K>>,
    ) {
        let method = self.method;
        let observer = self.conduct.observer;
        for Parcel { label, known, content } in from {
            let frame = label.frame.clone();
            let work = move |rasterized, settings: &Settings| {
                method.smooth_observed(rasterized, settings, &mut |fraction| {
                    if let Some(observer) = observer {
                        observer.advanced(&frame, Stage::Smooth, fraction);
                    }
                })
            };
            let computed = self.compute(Stage::Smooth, &label, content, work);
            if !self.pass(label, known, computed, to, ended) {
                return;
            }
        }
    }

    /// From level sets to surfaces. A frame leaves its seat.
    pub(super) fn contour<'l, K>(
        &self,
        from: &Receiver<Parcel<'l, K, M::Smoothed>>,
        to: &Sender<Parcel<'l, K, Surface>>,
        ended: &Sender<Ended<K>>,
    ) {
        let method = self.method;
        for Parcel { label, mut known, content } in from {
            let outputs = Arc::clone(&label.frame.outputs);
            let work = move |smoothed, settings: &Settings| method.contour(smoothed, settings, &outputs);
            let computed = self.compute(Stage::Contour, &label, content, work);
            if let Ok(surface) = &computed {
                known.seat = None;
                let packing_bytes = surface.attributes.packing_bytes() as u64;
                let surface_bytes = surface.size_bytes().saturating_mul(WRITING_MEMORY);
                known.memory.resize(surface_bytes.saturating_add(packing_bytes));
            }
            if !self.pass(label, known, computed, to, ended) {
                return;
            }
        }
    }

    /// A stage of the method.
    fn compute<K, A: Send + 'env, B: Send + 'env>(
        &self,
        stage: Stage,
        label: &Label<K>,
        content: A,
        work: impl FnOnce(A, &Settings) -> Result<B, Cause> + Send + 'env,
    ) -> Result<B, FrameError> {
        let settings = Arc::clone(&label.frame.settings);
        self.begin(&label.frame, stage);
        let computed = FrameError::catch(&label.frame.input, stage, || {
            self.crew.run(label.number, move || work(content, &settings))
        });
        computed?.map_err(|cause| FrameError::of_stage(&label.frame, stage, cause))
    }

    /// Sends a frame to the next stage, or its end if this was it. Returns whether anybody listens.
    fn pass<'l, K, B>(
        &self,
        label: Label<K>,
        known: Known<'l>,
        computed: Result<B, FrameError>,
        to: &Sender<Parcel<'l, K, B>>,
        ended: &Sender<Ended<K>>,
    ) -> bool {
        match computed {
            Ok(content) => to.send(Parcel { label, known, content }).is_ok(),
            Err(error) => ended.send(self.end(label, outcome_of(error))).is_ok(),
        }
    }
}

/// Memory for writing a surface, in sizes of the surface: itself, and its level set as it is packed, or not.
const WRITING_MEMORY: u64 = 2;
