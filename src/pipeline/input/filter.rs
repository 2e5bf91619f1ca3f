//! Chooses the particles of a frame that form the surface, right after they are read.

use glam::Vec3;
use meniscus_formats::columns::aliases;
use meniscus_formats::{AttributeRole, FileAttribute, FilePositions, ParticleFrame};

use crate::surface::particles::{Attribute, ParticleFilter, coordinate, coordinates};

use super::attributes::{attribute, header};
use crate::pipeline::warning::Warning;
use crate::surface::words::{pluralize, significant};

/// Keeps the particles of a frame that meet the condition. Returns a warning if none of them does.
///
/// # Errors
/// If the condition does not suit the attributes: a sentence with the condition, and with the attributes that
/// exist.
pub fn keep_chosen(
    frame: &mut ParticleFrame,
    filter: Option<&ParticleFilter>,
) -> Result<Option<Warning>, String> {
    let Some(filter) = filter else { return Ok(None) };
    let failed = |why| format!("--where \"{filter}\": {why}");
    let mut attributes: Vec<Attribute> =
        frame.attributes.iter().map(|given| attribute(header(given))).collect();
    let particle_count = frame.positions.len();
    let coordinates = coordinates(&attributes);
    attributes.extend(coordinates);
    for index in filter.needed(&attributes).map_err(failed)? {
        match frame.attributes.get(index) {
            Some(given) => attributes[index] = attribute(given.clone()),
            None => {
                let name = &attributes[index].name;
                attributes[index].values = match &frame.positions {
                    FilePositions::F32(at) => {
                        coordinate(name, at.len(), |index| Vec3::from(at[index]).as_dvec3())
                    }
                    FilePositions::F64(at) => coordinate(name, at.len(), |index| at[index].into()),
                };
            }
        }
    }
    let mask = filter.mask(&attributes, particle_count).map_err(failed)?;
    frame.retain(&mask);
    Ok(none_chosen(filter, particle_count, frame.positions.len()))
}

/// The warning if none of the particles meets the condition.
pub(super) fn none_chosen(
    filter: &ParticleFilter,
    particle_count: usize,
    chosen_count: usize,
) -> Option<Warning> {
    let is_none = chosen_count == 0 && particle_count > 0;
    is_none.then(|| {
        let particles = pluralize(particle_count, "particle");
        Warning::new(format!("none of the {particles} meets the condition \"{filter}\": the frame is empty"))
    })
}

/// A warning if the attributes of these parts of a frame show that its particles are of several kinds, such
/// as fluid and walls, which all become one surface.
pub(super) fn several_kinds<'a>(parts: impl Iterator<Item = &'a [FileAttribute]> + Clone) -> Option<Warning> {
    let first = parts.clone().next()?;
    let is_kind = |attribute: &FileAttribute| {
        aliases(AttributeRole::Kind).iter().any(|alias| attribute.name.eq_ignore_ascii_case(alias))
    };
    (0..first.len()).filter(|&index| is_kind(&first[index])).find_map(|index| {
        let mut values: Vec<String> = Vec::new();
        for part in parts.clone() {
            let counts = part.get(index)?.value_counts(KIND_COUNT_MAX)?;
            values.extend(counts.into_iter().map(|(value, _)| value));
        }
        // Integers in the order of their values.
        values.sort_by_key(|value| (value.parse::<i64>().ok(), value.clone()));
        values.dedup();
        let (attribute, count) = (&first[index].name, values.len());
        (2..=KIND_COUNT_MAX).contains(&count).then(|| {
            Warning::new(format!(
                "the attribute `{attribute}` has {count} values ({}), and particles with any of them become one surface",
                values.join(", ")
            ))
            .about(attribute)
            .with_remedy(format!("choose some with --where, such as --where '{attribute} == VALUE'"))
        })
    })
}

/// A warning if the particles of these parts of a frame have different sizes: radii, or else smoothing lengths or masses.
pub(super) fn various_sizes<'a>(parts: impl Iterator<Item = &'a [FileAttribute]> + Clone) -> Option<Warning> {
    ParticleSize::ALL.into_iter().find_map(|size| {
        let mut name = None;
        let (mut smallest, mut largest) = (f64::INFINITY, 0.0f64);
        for attribute in parts.clone().flatten().filter(|attribute| size.is_of(attribute)) {
            name.get_or_insert(&attribute.name);
            let given = super::attributes::attribute(attribute.clone());
            let values = given.values.numbers().unwrap_or_default();
            for &value in values.iter().filter(|value| value.is_finite() && **value > 0.0) {
                (smallest, largest) = (smallest.min(value.into()), largest.max(value.into()));
            }
        }
        let attribute = name.filter(|_| largest > size.ratio_min() * smallest)?;
        let [smallest, largest] = [smallest, largest].map(significant);
        let warning = Warning::new(format!(
            "the particles have {} from {smallest} to {largest} (`{attribute}`), which are not used",
            size.noun()
        ));
        Some(warning.with_remedy(size.remedy(attribute)))
    })
}

/// What an attribute says of the size of particles.
#[derive(Clone, Copy)]
enum ParticleSize {
    Radius,
    /// The reach of their kernels in the simulation.
    SmoothingLength,
    Mass,
}

impl ParticleSize {
    const ALL: [ParticleSize; 3] = [ParticleSize::Radius, ParticleSize::SmoothingLength, ParticleSize::Mass];

    /// Whether an attribute has this size of its particles.
    fn is_of(self, attribute: &FileAttribute) -> bool {
        let names: &[&str] = match self {
            ParticleSize::Radius => return attribute.role == Some(AttributeRole::Radius),
            ParticleSize::SmoothingLength => {
                &["h", "hsml", "smoothing_length", "smoothinglength", "smoothinglengths"]
            }
            ParticleSize::Mass => &["m", "mass", "masses"],
        };
        attribute.arity == 1 && names.iter().any(|name| attribute.name.eq_ignore_ascii_case(name))
    }

    fn noun(self) -> &'static str {
        match self {
            ParticleSize::Radius => "radii",
            ParticleSize::SmoothingLength => "smoothing lengths",
            ParticleSize::Mass => "masses",
        }
    }

    fn remedy(self, attribute: &str) -> String {
        match self {
            ParticleSize::Radius => format!("--radius-attribute {attribute} uses them"),
            ParticleSize::SmoothingLength => {
                format!(
                    "use --radius-attribute {attribute}, with the radius of a particle over it as --radius-scale"
                )
            }
            ParticleSize::Mass => "write their radii, too, and name them with --radius-attribute".to_owned(),
        }
    }

    /// From this ratio of the largest to the smallest on, particles are meant to have different sizes: smoothing lengths
    /// follow the density, and masses may differ a little at walls.
    fn ratio_min(self) -> f64 {
        match self {
            ParticleSize::Radius => 1.01,
            ParticleSize::SmoothingLength | ParticleSize::Mass => 1.5,
        }
    }
}

/// An attribute with more values numbers something else than kinds, such as pieces.
const KIND_COUNT_MAX: usize = 16;

#[cfg(test)]
mod tests {
    use meniscus_formats::Values;

    use super::*;

    fn frame(name: &str, values: Values) -> ParticleFrame {
        ParticleFrame {
            positions: FilePositions::F32((0..4).map(|i| [i as f32; 3]).collect()),
            attributes: vec![FileAttribute { name: name.to_owned(), arity: 1, role: None, values }],
            notes: Vec::new(),
        }
    }

    #[test]
    fn radii_of_different_sizes_cause_a_warning() {
        let of = |radii: &[f32]| {
            let mut frame = frame("pscale", Values::F32(radii.to_vec()));
            frame.attributes[0].role = Some(AttributeRole::Radius);
            various_sizes([&frame.attributes[..]].into_iter()).map(|warning| warning.sentence)
        };
        let expected = "the particles have radii from 0.1 to 0.25 (`pscale`), which are not used";
        assert_eq!(of(&[0.1, 0.25, 0.0, f32::NAN]).as_deref(), Some(expected));
        assert_eq!(of(&[0.1, 0.1, 0.1005, 0.1]), None);
        assert_eq!(of(&[]), None);
        let of_name = |name, values: &[f32]| {
            let frame = frame(name, Values::F32(values.to_vec()));
            various_sizes([&frame.attributes[..]].into_iter()).map(|warning| warning.sentence)
        };
        let expected = "the particles have masses from 1 to 8 (`mass`), which are not used";
        assert_eq!(of_name("mass", &[1.0, 8.0, 1.0, 1.0]).as_deref(), Some(expected));
        let lengths = of_name("h", &[0.1, 0.2, 0.1, 0.1]).expect("different");
        assert!(
            lengths.starts_with("the particles have smoothing lengths from 0.1 to 0.2 (`h`)"),
            "{lengths}"
        );
        assert_eq!(of_name("h", &[0.1, 0.12, 0.1, 0.1]), None);
    }

    #[test]
    fn particles_of_several_kinds_cause_a_warning() {
        let table = || vec!["wall".to_owned(), "fluid".to_owned()];
        let of = |name: &str, values: Values| {
            let parts = [frame(name, values)];
            several_kinds(parts.iter().map(|part| &part.attributes[..])).map(|warning| warning.sentence)
        };
        let kinds = of("Mk", Values::I32(vec![10, 2, 10, -1])).expect("three kinds");
        assert!(kinds.contains("`Mk` has 3 values (-1, 2, 10)"), "{kinds}");
        let kinds = of("phase", Values::Strings { table: table(), indices: vec![0, 1, 1, 0] });
        assert!(kinds.expect("two kinds").contains("(fluid, wall)"));
        assert!(of("type", Values::F32(vec![1.0, 2.0, 1.0, 1.0])).is_some());
        for (name, values) in [
            ("phase", Values::I32(vec![1; 4])),
            ("phase", Values::F32(vec![0.0, 0.5, 1.0, 1.0])),
            ("id", Values::I32(vec![0, 1, 2, 3])),
            ("phase", Values::Strings { table: table(), indices: vec![1; 4] }),
        ] {
            assert_eq!(of(name, values.clone()), None, "{name}: {values:?}");
        }
        // The kinds may be in different parts.
        let parts = [frame("mk", Values::U8(vec![1; 4])), frame("mk", Values::U8(vec![2; 4]))];
        assert!(several_kinds(parts.iter().map(|part| &part.attributes[..])).is_some());
    }

    #[test]
    fn particles_that_meet_the_condition_are_kept() {
        let condition = |text: &str| text.parse::<ParticleFilter>().expect("a condition");
        let given = frame("phase", Values::U8(vec![0, 1, 1, 2]));
        let mut kept = given.clone();
        assert_eq!(keep_chosen(&mut kept, None), Ok(None));
        assert_eq!(kept, given);
        assert_eq!(keep_chosen(&mut kept, Some(&condition("phase == 1"))), Ok(None));
        assert_eq!(kept.positions, FilePositions::F32(vec![[1.0; 3], [2.0; 3]]));
        let mut right = given.clone();
        assert_eq!(keep_chosen(&mut right, Some(&condition("x > 1 and z <= 2"))), Ok(None));
        assert_eq!(right.positions, FilePositions::F32(vec![[2.0; 3]]));
        let none = keep_chosen(&mut given.clone(), Some(&condition("phase == 7")));
        let sentence = "none of the 4 particles meets the condition \"phase == 7\": the frame is empty";
        assert_eq!(none, Ok(Some(Warning::new(sentence))));
        let missing = keep_chosen(&mut given.clone(), Some(&condition("mk == 7")));
        assert_eq!(
            missing.expect_err("missing"),
            "--where \"mk == 7\": the particles have no attribute `mk`; available: phase, x, y, z"
        );
    }
}
