//! Takes the spray out of frames. With ids, it depends on the frames around, which are read for that: which of their
//! particles are apart is kept for the next frames.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::pipeline::error::FrameError;
use crate::pipeline::input::around::FoundFrame;
use crate::pipeline::input::attributes::AttributeRequest;
use crate::pipeline::input::frame::Frame;
use crate::surface::options::Settings;
use crate::surface::particles::ParticleCloud;
use crate::surface::reconstruction::ApartParticles;
use crate::surface::spray::{FrameSides, Spray};

use super::frame_cache::FrameCache;
use super::{StageContext, lock};

/// Which particles of frames are apart, by the path of each and the hash of its bytes; `None` without ids.
pub(super) type KnownSides = FrameCache<(PathBuf, u128), Option<Arc<FrameSides>>>;

/// A frame of a sequence: by how many frames it is later than another one, its file, and the hash of its bytes.
pub(super) type FrameInSequence<'a> = (i32, &'a Path, u128);

/// A frame and those around it.
pub(super) fn with_around<'a>(
    frame: &'a Frame,
    hash: u128,
    around: &'a [FoundFrame],
) -> Vec<FrameInSequence<'a>> {
    let others = around.iter().filter_map(|found| {
        let content = found.content.as_ref()?;
        Some((found.frame.steps, &*content.path, content.hash))
    });
    std::iter::once((0, &*frame.input, hash)).chain(others).collect()
}

/// The frames of a sequence that say which particles of the frame at `steps` are spray: by how many frames each is later
/// than that one, and the hash of its bytes, in order.
pub(super) fn sides_around(
    sequence: &[FrameInSequence<'_>],
    steps: i32,
    settings: &Settings,
) -> Vec<(i32, u128)> {
    let reach = settings.spray_reach();
    let is_around = |at: i32| at != steps && at.abs_diff(steps) <= reach;
    let around = sequence.iter().filter(|(at, ..)| is_around(*at));
    let mut sides: Vec<(i32, u128)> = around.map(|(at, _, hash)| (at - steps, *hash)).collect();
    sides.sort_unstable();
    sides
}

/// The particles of a frame without its spray.
pub(super) struct SeparatedCloud {
    pub(super) fluid: ParticleCloud,
    /// `None` if the settings do not ask for it.
    pub(super) spray: Option<Spray>,
    /// Whether the frames around should have said what is spray, but there are no ids.
    pub(super) lacks_ids: bool,
    /// The frames around that are left out because they could not be read, by how many frames each is later than the first
    /// one of the sequence.
    pub(super) failures: Vec<(i32, FrameError)>,
}

impl StageContext<'_> {
    /// Takes the spray out of the particles of the frame at `steps` in a sequence, if the settings ask for it.
    pub(super) fn without_spray(
        &self,
        cloud: ParticleCloud,
        settings: &Arc<Settings>,
        sequence: &[FrameInSequence<'_>],
        steps: i32,
    ) -> SeparatedCloud {
        if settings.spray == 0 {
            return SeparatedCloud { fluid: cloud, spray: None, lacks_ids: false, failures: Vec::new() };
        }
        let ParticleCloud { positions, shapes, attributes } = cloud;
        let is_empty = positions.is_empty();
        let apart = ApartParticles::find(&positions, &attributes, settings);
        let reach = settings.spray_reach();
        let (mut around, mut failures): (Vec<(i32, Arc<FrameSides>)>, _) = (Vec::new(), Vec::new());
        let own = apart.by_ids();
        let has_ids = own.as_ref().is_some_and(|own| !own.is_empty());
        if reach > 0 {
            if let Some((_, path, hash)) = sequence.iter().find(|(at, ..)| *at == steps) {
                self.keep_sides(path, *hash, settings, own);
            }
            let others =
                sequence.iter().filter(|(at, ..)| *at != steps && at.abs_diff(steps) <= reach && has_ids);
            for &(at, path, hash) in others {
                match self.sides_of(path, hash, settings) {
                    Ok(sides) => around.extend(sides.map(|sides| (at - steps, sides))),
                    Err(error) => failures.push((at, error)),
                }
            }
        }
        let around: Vec<(i32, &FrameSides)> =
            around.iter().map(|(steps, sides)| (*steps, &**sides)).collect();
        let (positions, attributes, spray) = apart.take_spray(&positions, &attributes, &around, settings);
        let lacks_ids = reach > 0 && !has_ids && !is_empty;
        let fluid = ParticleCloud { positions, shapes, attributes };
        SeparatedCloud { fluid, spray: Some(spray), lacks_ids, failures }
    }

    /// Which particles of a frame around are apart; `None` without ids.
    fn sides_of(
        &self,
        path: &Path,
        hash: u128,
        settings: &Arc<Settings>,
    ) -> Result<Option<Arc<FrameSides>>, FrameError> {
        if let Some(known) = lock(&self.sides).find(&(path.to_owned(), hash), settings) {
            return Ok(known.clone());
        }
        let cloud = self.particles_of(path, hash, &AttributeRequest::for_sides(settings))?;
        let apart = ApartParticles::find(&cloud.positions, &cloud.attributes, settings);
        let sides = apart.by_ids();
        self.keep_sides(path, hash, settings, sides.clone());
        Ok(sides)
    }

    fn keep_sides(&self, path: &Path, hash: u128, settings: &Arc<Settings>, sides: Option<Arc<FrameSides>>) {
        // Frames in flight are looked at in any order.
        let count = 2 * settings.frame_reach().beside as usize + 2 * self.options.in_flight;
        lock(&self.sides).keep((path.to_owned(), hash), settings, sides, count);
    }
}
