//! Arrays of single floats that take fewer bytes as integers, or as indices into a table.

use std::collections::HashMap;

/// The code of an array of floats that is stored as integers.
pub(super) const AS_INTEGERS: u8 = b'i';

/// The code of an array of floats that is stored as a table and indices into it.
pub(super) const AS_TABLE: u8 = b't';

/// The most entries of a table.
const TABLE_MAX: usize = 1024;

/// The floats as integers; `None` unless all floats are integers.
#[expect(clippy::cast_possible_truncation, reason = "compared with the value afterwards")]
pub(super) fn as_integers(values: &[f32]) -> Option<Vec<i32>> {
    // The comparison of bits excludes −0. The limit excludes 2³¹, which the cast saturates to `i32::MAX`.
    let integer = |&value: &f32| {
        let integer = value as i32;
        (integer < i32::MAX && (integer as f32).to_bits() == value.to_bits()).then_some(integer)
    };
    values.iter().map(integer).collect()
}

/// The distinct floats in the order of their first occurrence, and the index of each value among them; `None`
/// if a table would not save enough.
pub(super) fn as_table(values: &[f32]) -> Option<(Vec<f32>, Vec<i32>)> {
    let most = (values.len() / 4).min(TABLE_MAX);
    let (mut table, mut index_of) = (Vec::new(), HashMap::new());
    let mut indices = Vec::new();
    for value in values {
        let index = *index_of.entry(value.to_bits()).or_insert(table.len());
        if index == table.len() {
            if index == most {
                return None;
            }
            table.push(*value);
        }
        indices.push(i32::try_from(index).ok()?);
    }
    Some((table, indices))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_and_tables_are_exact() {
        assert_eq!(as_integers(&[0.0, -3.0, 16_777_216.0]), Some(vec![0, -3, 16_777_216]));
        for other in [-0.0, 0.5, 2_147_483_648.0, f32::INFINITY, f32::NAN] {
            assert_eq!(as_integers(&[1.0, other]), None, "{other}");
        }
        assert_eq!(as_integers(&[-2_147_483_648.0]), Some(vec![i32::MIN]));
        let repeated = [0.5, -0.0, 0.5, 0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5];
        let (table, indices) = as_table(&repeated).expect("three values");
        assert_eq!(
            table.iter().map(|x| x.to_bits()).collect::<Vec<_>>(),
            [0.5_f32, -0.0, 0.0].map(f32::to_bits)
        );
        assert_eq!(indices[..4], [0, 1, 0, 2]);
        let distinct: Vec<f32> = (0_u16..100).map(f32::from).collect();
        assert_eq!(as_table(&distinct), None);
        assert_eq!(as_table(&[1.0, 1.0, 1.0]), None);
    }
}
