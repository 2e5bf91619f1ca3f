//! Chooses the particles of a frame that form the surface, right after they are read.

use meniscus_formats::columns::aliases;
use meniscus_formats::{AttributeRole, FileAttribute, ParticleFrame};

use crate::surface::particles::{Attribute, ParticleFilter};

use super::attributes::{attribute, header};
use crate::pipeline::warning::{InputWarning, Warning};

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
    for index in filter.needed(&attributes).map_err(failed)? {
        attributes[index] = attribute(frame.attributes[index].clone());
    }
    let particle_count = frame.positions.len();
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
    let condition = filter.to_string();
    is_none.then_some(Warning::Input(InputWarning::NoneChosen { condition, particle_count }))
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
        let attribute = first[index].name.clone();
        let is_kind_count = (2..=KIND_COUNT_MAX).contains(&values.len());
        is_kind_count.then_some(Warning::Input(InputWarning::SeveralKinds { attribute, values }))
    })
}

/// A warning if the particles of these parts of a frame carry radii of different sizes.
pub(super) fn various_radii<'a>(parts: impl Iterator<Item = &'a [FileAttribute]>) -> Option<Warning> {
    let mut name = None;
    let (mut smallest, mut largest) = (f64::INFINITY, 0.0f64);
    for attribute in parts.flatten().filter(|attribute| attribute.role == Some(AttributeRole::Radius)) {
        name.get_or_insert(&attribute.name);
        let given = super::attributes::attribute(attribute.clone());
        let radii = given.values.numbers().unwrap_or_default();
        for &radius in radii.iter().filter(|radius| radius.is_finite() && **radius > 0.0) {
            (smallest, largest) = (smallest.min(radius.into()), largest.max(radius.into()));
        }
    }
    let attribute = name.filter(|_| largest > RADIUS_RATIO_MIN * smallest)?.clone();
    Some(Warning::Input(InputWarning::VariousRadii { attribute, smallest, largest }))
}

/// From this ratio of the largest radius to the smallest on, they are meant to differ.
const RADIUS_RATIO_MIN: f64 = 1.01;

/// An attribute with more values numbers something else than kinds, such as pieces.
const KIND_COUNT_MAX: usize = 16;

#[cfg(test)]
mod tests {
    use meniscus_formats::{FilePositions, Values};

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
            various_radii([&frame.attributes[..]].into_iter()).map(|warning| warning.to_string())
        };
        let expected = "the particles carry radii from 0.1 to 0.25 (`pscale`), which are not used";
        assert_eq!(of(&[0.1, 0.25, 0.0, f32::NAN]).as_deref(), Some(expected));
        assert_eq!(of(&[0.1, 0.1, 0.1005, 0.1]), None);
        assert_eq!(of(&[]), None);
    }

    #[test]
    fn particles_of_several_kinds_cause_a_warning() {
        let table = || vec!["wall".to_owned(), "fluid".to_owned()];
        let of = |name: &str, values: Values| {
            let parts = [frame(name, values)];
            several_kinds(parts.iter().map(|part| &part.attributes[..])).map(|warning| warning.to_string())
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
        let none = keep_chosen(&mut given.clone(), Some(&condition("phase == 7")));
        let expected = InputWarning::NoneChosen { condition: "phase == 7".to_owned(), particle_count: 4 };
        assert_eq!(none, Ok(Some(Warning::Input(expected))));
        let missing = keep_chosen(&mut given.clone(), Some(&condition("mk == 7")));
        assert_eq!(
            missing.expect_err("missing"),
            "--where \"mk == 7\": the particles have no attribute `mk`; available: phase"
        );
    }
}
