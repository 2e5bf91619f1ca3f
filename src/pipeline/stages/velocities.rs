//! Computes the velocities of particles that have none, from the frames before and after (`--time-step`), or compares
//! those that they have with their motion.

use crate::pipeline::input::around::{FoundFrame, not_averaged};
use crate::pipeline::input::attributes::AttributeRequest;
use crate::pipeline::input::frame::Frame;
use crate::pipeline::input::frame_rate::is_same_time;
use crate::pipeline::warning::{InputWarning, Warning};
use crate::surface::attributes::{FoundBy, add_velocities, time_between};
use crate::surface::particles::ParticleCloud;

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
                Some(FoundBy::Order) => Some(InputWarning::FollowedByOrder),
                // Another warning says that.
                None if frame.number.is_none() => None,
                None if around.is_empty() => Some(InputWarning::NoFrameBeside),
                None => Some(InputWarning::VelocitiesNotComputed),
            }
        } else {
            let pair = before.as_ref().zip(after.as_ref());
            let time = pair.and_then(|(before, after)| time_between(before, cloud, after));
            let measured = time.map(|time| time / settings.velocity_scale);
            let is_other = |measured: &f64| !is_same_time(*measured, seconds);
            measured.filter(is_other).map(|measured| {
                let velocity_scale = settings.velocity_scale * measured / seconds;
                InputWarning::OtherTimeStep { measured, given: seconds, velocity_scale }
            })
        };
        notes.warnings.extend(warning.map(Warning::Input));
    }
}
