//! Computes the velocities of particles that have none, from the frames before and after (`--time-step`), or compares
//! those that they have with their motion.

use crate::pipeline::input::around::{FoundFrame, not_averaged};
use crate::pipeline::input::attributes::AttributeRequest;
use crate::pipeline::input::frame::Frame;
use crate::pipeline::input::frame_rate::is_same_time;
use crate::pipeline::warning::Warning;
use crate::surface::attributes::{FoundBy, add_velocities, time_between};
use crate::surface::particles::ParticleCloud;
use crate::surface::words::significant;

use super::StageContext;
use super::compute::is_of_content;
use super::history::HistoryNotes;

impl StageContext<'_> {
    /// Adds velocities to the particles of a frame, if the settings ask for them and the particles have none.
    pub(super) fn complete_velocities(
        &self,
        cloud: &mut ParticleCloud,
        frame: &Frame,
        around: &[FoundFrame],
        notes: &mut HistoryNotes,
    ) {
        let settings = &*frame.settings;
        let Some(seconds) = settings.time_step.filter(|_| settings.computes_velocities()) else { return };
        if cloud.positions.is_empty() {
            return;
        }
        let mut beside = [None, None];
        for found in around.iter().filter(|found| found.frame.steps.unsigned_abs() == 1) {
            let Some(content) = &found.content else { continue };
            let wanted = AttributeRequest::to_follow(&settings.reading);
            match self.particles_of(&content.path, content.hash, &wanted) {
                Ok(other) => beside[usize::from(found.frame.steps > 0)] = Some(other),
                Err(error) => {
                    notes.warnings.push(not_averaged(&error));
                    if !is_of_content(&error.cause, "") {
                        notes.unread.push(found.frame.steps);
                    }
                }
            }
        }
        let [before, after] = &beside;
        let warning = if cloud.find_attribute("velocity", 3).is_none() {
            notes.has_computed_velocities = true;
            match add_velocities(cloud, [before.as_ref(), after.as_ref()], settings) {
                Some(FoundBy::Ids) => None,
                Some(FoundBy::Order) => Some(Warning::new(
                    "the particles have no ids: their velocities are computed as if all frames had them in the same order",
                )),
                // Another warning says that.
                None if frame.number.is_none() => None,
                None if around.is_empty() => Some(Warning::new(
                    "velocities are not computed: there is no frame with the number before or after",
                )),
                None => Some(Warning::new(
                    "velocities are not computed: the frames before and after have no particles with the same ids, nor as \
                     many in the same order",
                )),
            }
        } else {
            let pair = before.as_ref().zip(after.as_ref());
            let time = pair.and_then(|(before, after)| time_between(before, cloud, after));
            let measured = time.map(|time| time / settings.velocity_scale);
            let is_other = |measured: &f64| !is_same_time(*measured, seconds);
            measured.filter(is_other).map(|measured| {
                let velocity_scale = significant(settings.velocity_scale * measured / seconds);
                let [measured, requested] = [measured, seconds].map(significant);
                Warning::new(format!(
                    "by their velocities and ids, the particles move as if frames were {measured} seconds apart, not {requested}"
                ))
                .with_remedy(format!(
                    "check --time-step, or use --velocity-scale {velocity_scale} if the velocities have another unit of time"
                ))
            })
        };
        notes.warnings.extend(warning);
    }
}
