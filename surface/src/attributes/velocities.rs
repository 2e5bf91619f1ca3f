//! The velocities of particles, from their positions in the frames before and after.
//!
//! ```text
//!   before    own     after
//!     ○        ●        ○      velocity: from ○ to ○ over twice the time between frames; at the ends of a sequence, and of
//!                              the life of a particle, from ● to the only ○
//! ```
//!
//! Particles are found by their ids. Without ids, the particles of frames of equal size are taken to be in the same
//! order, if nearly all of them stay within [`MOVE_MAX`].

use glam::DVec3;

use crate::options::{AttributeSelection, Settings};
use crate::particles::{
    Attribute, AttributeValues, OwnedPositions, ParticleCloud, Role, find_attribute, ids_of, unique_ids,
};
use crate::spacing::median;

use super::computed::OF_VELOCITIES;

/// The farthest that a particle moves from a frame to the next if it is found by its place in the order, and the
/// greatest difference of two moves of a particle, in spacings.
const MOVE_MAX: f64 = 8.0;

/// By how many medians of all moves the only move of a particle may be longer.
const LONE_MEDIANS: f64 = 4.0;

/// The largest share of particles that may move farther.
const FAR_MAX: f64 = 0.01;

/// How particles are found in the frames before and after.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FoundBy {
    /// By their ids.
    Ids,
    /// By their order.
    Order,
}

/// Whether the selection names velocities, or what is computed from them.
pub fn names_velocity(selection: Option<&AttributeSelection>) -> bool {
    let Some(AttributeSelection::Named(names)) = selection else { return false };
    let is_computed =
        |name: &str| OF_VELOCITIES.iter().any(|attribute| name.eq_ignore_ascii_case(attribute.name()));
    names.iter().any(|name| Role::Velocity.has_name(name) || is_computed(name))
}

/// Adds velocities to particles that have none, from the frames before and after: NaN for a particle that is in neither, or
/// only in one, to which it would have jumped. Returns how they were found; `None` if they cannot be followed to any of
/// these frames.
pub fn add_velocities(
    cloud: &mut ParticleCloud,
    beside: [Option<&ParticleCloud>; 2],
    settings: &Settings,
) -> Option<FoundBy> {
    let time = settings.frame_time()?;
    let own = TrackedCloud::of(cloud);
    let found = own.find(beside.map(|other| other.map(TrackedCloud::of)), settings.spacing);
    if found.iter().all(Option::is_none) {
        return None;
    }
    let longest = MOVE_MAX * settings.spacing;
    // Fast fluid moves farther.
    let lone_max = longest + LONE_MEDIANS * own.median_move(beside, &found).unwrap_or(0.0);
    let velocity = |particle: usize| {
        let here = cloud.positions.position(particle);
        let there =
            |side: usize| Some(beside[side]?.positions.position(found[side].as_ref()?[particle]? as usize));
        let moved = match [there(0).map(|before| here - before), there(1).map(|after| after - here)] {
            // A solver gave the id to another particle.
            [Some(first), Some(second)] if (second - first).length() > longest => {
                if first.length() < second.length() { first } else { second }
            }
            [Some(first), Some(second)] => 0.5 * (first + second),
            [Some(only), None] | [None, Some(only)] if only.length() <= lone_max => only,
            _ => DVec3::NAN,
        };
        (moved / time).as_vec3().to_array()
    };
    let values = (0..cloud.positions.len()).flat_map(velocity).collect();
    let found_by = if own.ids.is_some() { FoundBy::Ids } else { FoundBy::Order };
    let (name, values) = ("velocity".to_owned(), AttributeValues::Numbers(values));
    cloud.attributes.push(Attribute { name, role: Role::Velocity, arity: 3, values });
    Some(found_by)
}

/// The time from one frame to the next according to particles that have ids and velocities, in the unit of time of the
/// velocities: the median of half their way from the frame before to the frame after over their velocity, of those that
/// are at least as fast as the mean. `None` if most of these cannot be followed.
pub fn time_between(before: &ParticleCloud, own: &ParticleCloud, after: &ParticleCloud) -> Option<f64> {
    let tracked = TrackedCloud::of(own);
    tracked.ids?;
    let velocities = find_attribute(&own.attributes, "velocity", 3)?.values.numbers()?;
    let velocities: Vec<DVec3> = velocities
        .as_chunks()
        .0
        .iter()
        .map(|velocity: &[f32; 3]| DVec3::from(velocity.map(f64::from)))
        .collect();
    let [from, to] =
        tracked.find([Some(TrackedCloud::of(before)), Some(TrackedCloud::of(after))], f64::INFINITY);
    let (from, to) = from.zip(to)?;
    let mean_speed =
        velocities.iter().map(|velocity| velocity.length()).sum::<f64>() / velocities.len() as f64;
    // The mean of equal numbers may be rounded up.
    let least = 0.999 * mean_speed;
    let fast = (0..own.positions.len()).filter(|&particle| velocities[particle].length() >= least);
    let time = |particle: usize| {
        let [from, to] = [(before, from[particle]?), (after, to[particle]?)]
            .map(|(cloud, index)| cloud.positions.position(index as usize));
        let velocity = velocities[particle];
        Some(0.5 * (to - from).dot(velocity) / velocity.length_squared()).filter(|time| *time > 0.0)
    };
    let times: Vec<Option<f64>> = fast.map(time).collect();
    let found: Vec<f64> = times.iter().copied().flatten().collect();
    if 2 * found.len() < times.len() { None } else { median(found) }
}

/// Particles, and what identifies them.
struct TrackedCloud<'a> {
    ids: Option<&'a [i64]>,
    positions: &'a OwnedPositions,
}

/// Where each particle of a frame is among those of another one.
type Places = Vec<Option<u32>>;

impl TrackedCloud<'_> {
    fn of(cloud: &ParticleCloud) -> TrackedCloud<'_> {
        let ids = ids_of(&cloud.attributes).filter(|ids| ids.len() == cloud.positions.len());
        TrackedCloud { ids, positions: &cloud.positions }
    }

    /// Where these particles are in other frames; `None` for a frame to which they cannot be followed.
    fn find(&self, others: [Option<TrackedCloud<'_>>; 2], spacing: f64) -> [Option<Places>; 2] {
        let Some(ids) = self.ids else {
            return others.map(|other| self.in_order_of(&other?, spacing));
        };
        let own = unique_ids(ids);
        others.map(|other| {
            let other = unique_ids(other?.ids?);
            let places = ids.iter().map(|id| other.get(id).filter(|_| own.contains_key(id)).copied());
            let places: Places = places.collect();
            places.iter().any(Option::is_some).then_some(places)
        })
    }

    /// The median of the distances to these places.
    fn median_move(&self, others: [Option<&ParticleCloud>; 2], places: &[Option<Places>; 2]) -> Option<f64> {
        let sides = others.into_iter().zip(places).filter_map(|(other, places)| other.zip(places.as_ref()));
        median(
            sides
                .flat_map(|(other, places)| {
                    let distance = |(particle, place): (usize, &Option<u32>)| {
                        let there = other.positions.position((*place)? as usize);
                        Some((there - self.positions.position(particle)).length())
                    };
                    places.iter().enumerate().filter_map(distance)
                })
                .collect(),
        )
    }

    /// The same places, but for particles that move too far.
    fn in_order_of(&self, other: &TrackedCloud<'_>, spacing: f64) -> Option<Places> {
        let count = u32::try_from(self.positions.len()).ok()?;
        if other.ids.is_some() || other.positions.len() != self.positions.len() {
            return None;
        }
        let place = |index: u32| {
            let moved = other.positions.position(index as usize) - self.positions.position(index as usize);
            (moved.length() <= MOVE_MAX * spacing).then_some(index)
        };
        let places: Places = (0..count).map(place).collect();
        let far_count = places.iter().filter(|place| place.is_none()).count();
        (count > 0 && far_count as f64 <= FAR_MAX * f64::from(count)).then_some(places)
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

    /// The velocities along x that are added, of the particles that have one.
    fn added(own: &ParticleCloud, beside: [Option<&ParticleCloud>; 2]) -> Option<(FoundBy, Vec<f32>)> {
        let mut cloud = own.clone();
        let settings = settings(&[("attributes", "v"), ("time_step", "0.5"), ("velocity_scale", "4")]);
        let followed = add_velocities(&mut cloud, beside, &settings)?;
        let velocities = cloud.find_attribute("velocity", 3)?.values.numbers()?.into_owned();
        let along = velocities.as_chunks::<3>().0.iter().map(|[x, ..]| *x);
        Some((followed, along.filter(|x| !x.is_nan()).collect()))
    }

    #[test]
    fn particles_are_followed_by_their_ids() {
        let own = cloud(&[10.0, 20.0, 30.0, 40.0, 50.0], Some(&[1, 2, 3, 4, 4]), None);
        let before = cloud(&[28.0, 8.0, 0.0], Some(&[3, 1, 4]), None);
        let after = cloud(&[24.0, 16.0], Some(&[2, 1]), None);
        // Per half a second, over the factor of 4: 1 from both, 2 from one of them.
        let both = added(&own, [Some(&before), Some(&after)]);
        assert_eq!(both, Some((FoundBy::Ids, vec![2.0, 2.0, 1.0])));
        let last = added(&own, [Some(&before), None]);
        assert_eq!(last, Some((FoundBy::Ids, vec![1.0, 1.0])));
        // An id that another particle got.
        let reused = cloud(&[300.0, 18.0], Some(&[1, 2]), None);
        let both = added(&own, [Some(&before), Some(&reused)]);
        assert_eq!(both, Some((FoundBy::Ids, vec![1.0, -1.0, 1.0])));
        // At the end of a sequence a jump is no velocity.
        let jumped = added(&own, [None, Some(&reused)]);
        assert_eq!(jumped, Some((FoundBy::Ids, vec![-1.0])));
        let strangers = cloud(&[1.0], Some(&[9]), None);
        assert_eq!(added(&own, [Some(&strangers), None]), None);
        assert_eq!(added(&own, [None, None]), None);
    }

    #[test]
    fn few_particles_out_of_order_have_no_velocity() {
        let mut places: Vec<f64> = (0..200).map(f64::from).collect();
        let own = cloud(&places, None, None);
        places[7] = 500.0;
        let (followed, velocities) =
            added(&own, [None, Some(&cloud(&places, None, None))]).expect("followed");
        assert_eq!((followed, velocities), (FoundBy::Order, vec![0.0; 199]));
    }

    #[test]
    fn order_counts_only_without_ids_and_for_short_ways() {
        let own = cloud(&[0.0, 40.0], None, None);
        let after = cloud(&[2.0, 44.0], None, None);
        assert_eq!(added(&own, [None, Some(&after)]), Some((FoundBy::Order, vec![1.0, 2.0])));
        let swapped = cloud(&[44.0, 2.0], None, None);
        let with_ids = cloud(&[2.0, 44.0], Some(&[1, 2]), None);
        for other in [swapped, with_ids, cloud(&[2.0, 44.0, 50.0], None, None), cloud(&[], None, None)] {
            assert_eq!(added(&own, [None, Some(&other)]), None);
        }
    }

    #[test]
    fn time_between_frames_is_that_of_particles_that_move() {
        // They accelerate: the way before is shorter than that after.
        let before = cloud(&[9.5, 19.5, -70.0], Some(&[2, 3, 1]), None);
        let own = cloud(&[0.0, 10.0, 20.0], Some(&[1, 2, 3]), Some(5.0));
        let after = cloud(&[21.5, 11.5, 90.0], Some(&[3, 2, 1]), None);
        assert_eq!(time_between(&before, &own, &after), Some(0.2));
        // The mean of equal speeds, which is rounded, may be above each of them.
        let ids: Vec<i64> = (0..1000).collect();
        let [before, mut own, after] = [-1.0, 0.0, 1.0].map(|x| cloud(&[x; 1000], Some(&ids), Some(1.0)));
        own.attributes[1].values = AttributeValues::Numbers([1.0, 0.3, 0.2].repeat(1000));
        let time = time_between(&before, &own, &after).expect("equal speeds");
        assert!((time - 1.0 / 1.13).abs() < 1e-6, "{time}");
        let still = cloud(&[0.0], Some(&[1]), Some(0.0));
        assert_eq!(time_between(&before, &still, &after), None);
        assert_eq!(time_between(&before, &cloud(&[0.0], None, Some(5.0)), &after), None);
        assert_eq!(time_between(&before, &own, &cloud(&[1.0], Some(&[7]), None)), None);
    }

    #[test]
    fn names_of_velocities_and_of_what_needs_them() {
        let named = |names: &str| names_velocity(Some(&names.parse().expect("names")));
        assert!(named("Cd,VEL") && named("speed") && named("id,Vorticity"));
        assert!(!named("id,normal_curvature") && !named("all") && !names_velocity(None));
    }
}
