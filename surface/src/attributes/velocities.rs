//! The velocities of particles, from their positions in the frames before and after.
//!
//! ```text
//!   before    own     after
//!     ○        ●        ○      velocity: from ○ to ○ over twice the time between frames; at the ends of a sequence, and of
//!                              the life of a particle, from ● to the only ○
//! ```
//!
//! Particles are found by their ids. Without ids, the particles of frames of equal size are taken to be in the same
//! order, if none of them moves farther than [`MOVE_MAX`].

use glam::DVec3;

use crate::options::{AttributeSelection, Settings};
use crate::particles::{
    Attribute, AttributeValues, OwnedPositions, ParticleCloud, Role, find_attribute, ids_of, unique_ids,
};
use crate::spacing::median;

use super::computed::OF_VELOCITIES;

/// The farthest that a particle moves from a frame to the next if it is found by its place in the order, in spacings.
const MOVE_MAX: f64 = 8.0;

/// Where the velocities of particles come from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Followed {
    /// Their ids in the frames around.
    ById,
    /// Their places in the order of the frames around.
    ByOrder,
}

/// Whether the selection names velocities, or what is computed from them.
pub fn names_velocity(selection: Option<&AttributeSelection>) -> bool {
    let Some(AttributeSelection::Named(names)) = selection else { return false };
    let computed = OF_VELOCITIES.map(|attribute| attribute.name());
    let all = || Role::Velocity.names().iter().chain(&computed);
    names.iter().any(|name| all().any(|known| name.eq_ignore_ascii_case(known)))
}

/// Adds velocities to particles that have none, from the frames before and after. A particle that is in neither has the
/// velocity 0. Returns how they were found; `None` if they cannot be followed to any of these frames.
pub fn add_velocities(
    cloud: &mut ParticleCloud,
    beside: [Option<&ParticleCloud>; 2],
    settings: &Settings,
) -> Option<Followed> {
    let own = Places::of(cloud);
    let found = beside.map(|other| Some(own.find(&Places::of(other?), settings.spacing)?));
    if found.iter().all(Option::is_none) {
        return None;
    }
    let seconds = frame_seconds(settings)?;
    let place = |side: usize, particle: usize| found[side].as_ref()?[particle];
    let velocity = |particle: usize| {
        let here = cloud.positions.position(particle);
        let moved = match [0, 1].map(|side| place(side, particle)) {
            [Some(before), Some(after)] => 0.5 * (after - before),
            [Some(before), None] => here - before,
            [None, Some(after)] => after - here,
            [None, None] => DVec3::ZERO,
        };
        (moved / seconds).as_vec3().to_array()
    };
    let values = (0..cloud.positions.len()).flat_map(velocity).collect();
    let followed = if own.ids.is_some() { Followed::ById } else { Followed::ByOrder };
    let (name, values) = ("velocity".to_owned(), AttributeValues::Numbers(values));
    cloud.attributes.push(Attribute { name, role: Role::Velocity, arity: 3, values });
    Some(followed)
}

/// The time from one frame to another according to particles that have ids and velocities, in seconds: the median of
/// displacement over velocity of those that are at least as fast as the mean. `None` if most of these cannot be followed.
pub fn seconds_between(from: &ParticleCloud, to: &ParticleCloud, velocity_scale: f64) -> Option<f64> {
    let own = Places::of(from);
    own.ids?;
    let velocities = find_attribute(&from.attributes, "velocity", 3)?.values.numbers()?;
    let found = own.find(&Places::of(to), f64::INFINITY)?;
    let velocities = velocities.as_chunks().0.iter();
    let velocities: Vec<DVec3> =
        velocities.map(|velocity| velocity_scale * DVec3::from(velocity.map(f64::from))).collect();
    let fast = velocities.iter().map(|velocity| velocity.length()).sum::<f64>() / velocities.len() as f64;
    let is_fast = |(_, velocity): &(usize, &DVec3)| velocity.length() >= fast;
    let seconds = |(particle, velocity): (usize, &DVec3)| {
        let moved = found[particle]? - from.positions.position(particle);
        Some(moved.dot(*velocity) / velocity.length_squared()).filter(|seconds| *seconds > 0.0)
    };
    let fast_ones: Vec<(usize, &DVec3)> = velocities.iter().enumerate().filter(is_fast).collect();
    let found: Vec<f64> = fast_ones.iter().copied().filter_map(seconds).collect();
    if 2 * found.len() < fast_ones.len() { None } else { median(found) }
}

/// The time between two frames, in seconds of the velocities of the particles.
fn frame_seconds(settings: &Settings) -> Option<f64> {
    Some(settings.time_step? * settings.velocity_scale)
}

/// Where particles are, and what identifies them.
struct Places<'a> {
    ids: Option<&'a [i64]>,
    positions: &'a OwnedPositions,
}

impl Places<'_> {
    fn of(cloud: &ParticleCloud) -> Places<'_> {
        let ids = ids_of(&cloud.attributes).filter(|ids| ids.len() == cloud.positions.len());
        Places { ids, positions: &cloud.positions }
    }

    /// Where each of these particles is in another frame; `None` if they cannot be followed there.
    fn find(&self, other: &Places<'_>, spacing: f64) -> Option<Vec<Option<DVec3>>> {
        if let Some(ids) = self.ids {
            let (own, others) = (unique_ids(ids), unique_ids(other.ids?));
            let place = |id: &i64| {
                own.get(id)?;
                others.get(id).map(|index| other.positions.position(*index as usize))
            };
            let found: Vec<Option<DVec3>> = ids.iter().map(place).collect();
            return found.iter().any(Option::is_some).then_some(found);
        }
        let count = self.positions.len();
        let moves_little = |particle: usize| {
            let moved = other.positions.position(particle) - self.positions.position(particle);
            !moved.is_finite() || moved.length() <= MOVE_MAX * spacing
        };
        let is_same = other.ids.is_none() && other.positions.len() == count && count > 0;
        (is_same && (0..count).all(moves_little))
            .then(|| (0..count).map(|particle| Some(other.positions.position(particle))).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::options::MethodOptions;
    use crate::particles::Shapes;

    /// Particles at these places on the x axis.
    fn cloud(places: &[f64], ids: Option<&[i64]>, velocity: Option<f32>) -> ParticleCloud {
        let mut attributes = Vec::new();
        attributes.extend(ids.map(|ids| Attribute {
            name: "id".to_owned(),
            role: Role::Id,
            arity: 1,
            values: AttributeValues::Integers(ids.to_vec()),
        }));
        attributes.extend(velocity.map(|along| Attribute {
            name: "v".to_owned(),
            role: Role::Velocity,
            arity: 3,
            values: AttributeValues::Numbers([along, 0.0, 0.0].repeat(places.len())),
        }));
        let positions = OwnedPositions::F64(places.iter().map(|x| [*x, 0.0, 0.0]).collect());
        ParticleCloud { positions, shapes: Shapes::default(), attributes }
    }

    fn settings(options: &[(&str, &str)]) -> Settings {
        let options = MethodOptions::from_pairs(options.iter().copied()).expect("options");
        Settings::paper(1.0, &options).expect("settings")
    }

    /// The velocities along x that are added.
    fn added(own: &ParticleCloud, beside: [Option<&ParticleCloud>; 2]) -> Option<(Followed, Vec<f32>)> {
        let mut cloud = own.clone();
        let settings = settings(&[("attributes", "v"), ("time_step", "0.5"), ("velocity_scale", "4")]);
        let followed = add_velocities(&mut cloud, beside, &settings)?;
        let velocities = cloud.find_attribute("velocity", 3)?.values.numbers()?.into_owned();
        Some((followed, velocities.as_chunks::<3>().0.iter().map(|[x, ..]| *x).collect()))
    }

    #[test]
    fn particles_are_followed_by_their_ids() {
        let own = cloud(&[10.0, 20.0, 30.0, 40.0, 50.0], Some(&[1, 2, 3, 4, 4]), None);
        let before = cloud(&[28.0, 8.0, 0.0], Some(&[3, 1, 4]), None);
        let after = cloud(&[24.0, 16.0], Some(&[2, 1]), None);
        // Per half a second, over the factor of 4: 1 from both, 2 from one of them, 0 without any.
        let both = added(&own, [Some(&before), Some(&after)]);
        assert_eq!(both, Some((Followed::ById, vec![2.0, 2.0, 1.0, 0.0, 0.0])));
        let last = added(&own, [Some(&before), None]);
        assert_eq!(last, Some((Followed::ById, vec![1.0, 0.0, 1.0, 0.0, 0.0])));
        let strangers = cloud(&[1.0], Some(&[9]), None);
        assert_eq!(added(&own, [Some(&strangers), None]), None);
        assert_eq!(added(&own, [None, None]), None);
    }

    #[test]
    fn order_counts_only_without_ids_and_for_short_ways() {
        let own = cloud(&[0.0, 40.0], None, None);
        let after = cloud(&[2.0, 44.0], None, None);
        assert_eq!(added(&own, [None, Some(&after)]), Some((Followed::ByOrder, vec![1.0, 2.0])));
        let swapped = cloud(&[44.0, 2.0], None, None);
        let with_ids = cloud(&[2.0, 44.0], Some(&[1, 2]), None);
        for other in [swapped, with_ids, cloud(&[2.0, 44.0, 50.0], None, None), cloud(&[], None, None)] {
            assert_eq!(added(&own, [None, Some(&other)]), None);
        }
    }

    #[test]
    fn time_between_frames_is_that_of_particles_that_move() {
        let from = cloud(&[0.0, 10.0, 20.0], Some(&[1, 2, 3]), Some(5.0));
        let to = cloud(&[21.0, 11.0, 90.0], Some(&[3, 2, 1]), None);
        assert_eq!(seconds_between(&from, &to, 2.0), Some(0.1));
        assert_eq!(seconds_between(&cloud(&[0.0], Some(&[1]), Some(0.0)), &to, 1.0), None);
        assert_eq!(seconds_between(&cloud(&[0.0], None, Some(5.0)), &to, 1.0), None);
        assert_eq!(seconds_between(&from, &cloud(&[1.0], Some(&[7]), None), 1.0), None);
    }

    #[test]
    fn names_of_velocities_and_of_what_needs_them() {
        let named = |names: &str| names_velocity(Some(&names.parse().expect("names")));
        assert!(named("Cd,VEL") && named("speed") && named("id,Vorticity"));
        assert!(!named("id,normal_curvature") && !named("all") && !names_velocity(None));
    }
}
