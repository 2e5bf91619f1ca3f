//! Finds out whether the first column of a table without names is an id or a type instead of a coordinate.
//!
//! ```text
//!   17 0.11 0.52 0.34        a different integer in each row, then numbers with fractions: an id
//!   2 0.11 0.52 0.34         integers, some of them equal, then numbers with fractions: unclear
//!   0 0 0 0.05               the first column counts up by 1, and the others do not show whether it is an id:
//!   1 0 0 0.05               unclear
//!   1 0.11 0.52              counts up, then only two fractions: unclear
//!   0.5 0.5 0.5 7            a coordinate
//! ```
//!
//! A surface of particles whose x is an id would look plausible, so an unclear table is an error.

/// What the first column is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FirstColumn {
    Coordinate,
    Id,
    Unclear,
}

/// Number of rows that are examined.
pub(crate) const ROWS_MAX: usize = 1000;

/// With fewer rows the first column is a coordinate: a few integers may differ by chance.
const ROWS_MIN: usize = 4;

impl FirstColumn {
    /// Judges by the first four numbers of each row of a table with this many columns; NaN where there is no
    /// number.
    pub(crate) fn of(rows: impl Iterator<Item = [f64; 4]>, column_count: usize) -> FirstColumn {
        let rows: Vec<[f64; 4]> = rows.take(ROWS_MAX).collect();
        let mut ids: Vec<f64> = rows.iter().map(|row| row[0]).collect();
        if rows.len() < ROWS_MIN || ids.iter().any(|id| id.fract() != 0.0) {
            return FirstColumn::Coordinate;
        }
        let is_count = ids.windows(2).all(|pair| pair[1] - pair[0] == 1.0);
        ids.sort_by(f64::total_cmp);
        let are_different = ids.windows(2).all(|pair| pair[0] != pair[1]);
        let has_fractions =
            |&column: &usize| rows.iter().any(|row| row[column].is_finite() && row[column].fract() != 0.0);
        let fraction_count = (1..4.min(column_count)).filter(has_fractions).count();
        match column_count {
            // Of three columns, an id leaves only two for the position.
            3 if is_count && fraction_count == 2 => FirstColumn::Unclear,
            4.. if are_different && fraction_count == 3 => FirstColumn::Id,
            4.. if is_count || fraction_count > 0 => FirstColumn::Unclear,
            _ => FirstColumn::Coordinate,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_that_differ_before_three_fractions_are_ids() {
        let of = |x: [f64; 4], y: f64, z: f64, w: f64, column_count| {
            FirstColumn::of(x.into_iter().map(|x| [x, y, z, w]), column_count)
        };
        let (shuffled, counting) = ([7.0, 2.0, 9.0, 4.0], [3.0, 4.0, 5.0, 6.0]);
        for (case, found, expected) in [
            ("an id", of(shuffled, 0.1, 0.2, 0.3, 4), FirstColumn::Id),
            ("in a plane", of(shuffled, 0.1, 0.2, 0.0, 4), FirstColumn::Unclear),
            ("a lattice of ids", of(counting, 1.0, 2.0, 3.0, 7), FirstColumn::Unclear),
            ("x of a lattice", of(shuffled, 1.0, 2.0, 3.0, 4), FirstColumn::Coordinate),
            ("a type", of([1.0; 4], 0.1, 0.2, 0.3, 4), FirstColumn::Unclear),
            ("fractions", of([0.5, 1.0, 2.0, 3.0], 0.1, 0.2, 0.3, 4), FirstColumn::Coordinate),
            ("id, x and y", of(counting, 0.1, 0.2, f64::NAN, 3), FirstColumn::Unclear),
            ("a row of particles", of(counting, 0.0, 0.0, f64::NAN, 3), FirstColumn::Coordinate),
        ] {
            assert_eq!(found, expected, "{case}");
        }
        let few = [[1.0, 0.1, 0.2, 0.3], [2.0, 0.1, 0.2, 0.3]];
        assert_eq!(FirstColumn::of(few.into_iter(), 4), FirstColumn::Coordinate);
    }
}
