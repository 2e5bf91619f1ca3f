//! Measures the duration of each phase of the method, which itself reads no clock.

use std::time::Instant;

use crate::surface::report::{Phase, StageSeconds};

/// Measures phases by their start times.
#[derive(Debug, Default)]
pub struct PhaseTimer {
    seconds: StageSeconds,
    current: Option<(Phase, Instant)>,
}

impl PhaseTimer {
    /// Ends the current phase, if there is one, and starts this one.
    pub fn enter(&mut self, phase: Phase) {
        self.end();
        self.current = Some((phase, Instant::now()));
    }

    /// Ends the last phase and returns the seconds of each phase.
    pub fn finish(mut self) -> StageSeconds {
        self.end();
        self.seconds
    }

    fn end(&mut self) {
        let Some((phase, started)) = self.current.take() else { return };
        let seconds = match phase {
            Phase::Rasterize => &mut self.seconds.rasterize,
            Phase::Smooth => &mut self.seconds.smooth,
            Phase::Contour => &mut self.seconds.contour,
            _ => return,
        };
        *seconds += started.elapsed().as_secs_f64();
    }
}
