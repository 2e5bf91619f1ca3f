//! The points beside the meshes of a sequence.
//!
//! ```text
//!   frame 1   12 points   ──▶ summary ─┐
//!   frame 2   no file     ──▶ none    ─┼──▶ SequencePoints: one origin, the columns that all frames with points have
//!   frame 3   9 points    ──▶ summary ─┘
//! ```
//!
//! Summaries have no values, so the memory does not depend on the number of points; a writer reads the points of one
//! frame at a time.

use crate::core::data::{AttributeRole, FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::narrow_points::NarrowPoints;

/// What must be known of the points of a frame before a sequence is written.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointsSummary {
    count: usize,
    /// What the positions of the frame's own file are relative to, world units.
    origin: [f64; 3],
    columns: Vec<PointColumn>,
}

/// An attribute of points, without its values.
#[derive(Clone, Debug, PartialEq)]
struct PointColumn {
    name: String,
    role: Option<AttributeRole>,
    /// Number of values per point.
    arity: usize,
    kind: ColumnKind,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum ColumnKind {
    Reals,
    Integers {
        /// Whether a value needs 64 bits.
        is_wide: bool,
    },
    Strings,
}

impl PointsSummary {
    /// Summarises the points of a frame.
    ///
    /// # Errors
    /// [`Error::Invalid`] if an attribute has the wrong number of values, or a position is not finite.
    pub fn of(frame: &ParticleFrame) -> Result<PointsSummary> {
        let points = NarrowPoints::of(frame, "")?;
        Ok(PointsSummary {
            count: frame.positions.len(),
            origin: points.origin,
            columns: frame.attributes.iter().map(PointColumn::of).collect(),
        })
    }

    /// The number of points.
    pub fn count(&self) -> usize {
        self.count
    }
}

impl PointColumn {
    fn of(attribute: &FileAttribute) -> PointColumn {
        let FileAttribute { name, arity, role, values } = attribute;
        let kind = match values {
            Values::F32(_) | Values::F64(_) => ColumnKind::Reals,
            Values::U8(_) | Values::I32(_) => ColumnKind::Integers { is_wide: false },
            Values::I64(values) => {
                let is_wide = values.iter().any(|&value| i32::try_from(value).is_err());
                ColumnKind::Integers { is_wide }
            }
            Values::Strings { .. } => ColumnKind::Strings,
        };
        PointColumn { name: name.clone(), role: *role, arity: *arity, kind }
    }

    /// Whether the columns of two frames are the same attribute with the same type. Formats name some roles
    /// differently.
    fn matches(&self, other: &PointColumn) -> bool {
        let kinds = [self, other].map(|column| match column.kind {
            ColumnKind::Integers { .. } => ColumnKind::Integers { is_wide: false },
            kind => kind,
        });
        let is_same = match self.role {
            Some(
                AttributeRole::Id
                | AttributeRole::Radius
                | AttributeRole::Velocity
                | AttributeRole::Acceleration
                | AttributeRole::Color,
            ) => self.role == other.role,
            _ => self.name == other.name,
        };
        is_same && self.arity == other.arity && kinds[0] == kinds[1]
    }

    /// The attribute of `count` points with this value, or without strings.
    fn filled(&self, count: usize) -> FileAttribute {
        let PointColumn { name, role, arity, kind } = self;
        let count = count * arity;
        let values = match kind {
            ColumnKind::Reals => Values::F32(vec![0.0; count]),
            ColumnKind::Integers { is_wide } => Values::I64(vec![if *is_wide { i64::MAX } else { 0 }; count]),
            ColumnKind::Strings => Values::Strings { table: Vec::new(), indices: vec![-1; count] },
        };
        FileAttribute { name: name.clone(), arity: *arity, role: *role, values }
    }
}

/// The points beside the meshes of a sequence.
pub struct SequencePoints<'a> {
    /// One per frame.
    frames: Vec<PointsSummary>,
    columns: Vec<PointColumn>,
    /// What the positions of all frames are relative to, world units.
    pub(crate) origin: [f64; 3],
    notes: Vec<String>,
    read: Box<ReadPoints<'a>>,
}

/// Reads the points of a frame, by its index.
pub type ReadPoints<'a> = dyn Fn(usize) -> Result<ParticleFrame> + Sync + 'a;

impl<'a> SequencePoints<'a> {
    /// The points of frames with these summaries, one per frame of the sequence; that of a frame without points is the
    /// default. `read` is called only for frames with points.
    pub fn new(frames: Vec<PointsSummary>, read: Box<ReadPoints<'a>>) -> SequencePoints<'a> {
        let found: Vec<&PointsSummary> = frames.iter().filter(|frame| frame.count > 0).collect();
        let (columns, notes) = shared_columns(&found);
        // Points near the world's origin have none of their own.
        let origin = found.iter().map(|frame| frame.origin).find(|origin| *origin != [0.0; 3]);
        SequencePoints { columns, origin: origin.unwrap_or_default(), notes, frames, read }
    }

    /// Notes on attributes that the sequence does not have.
    pub(crate) fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The number of points in all frames.
    pub fn total(&self) -> usize {
        self.frames.iter().map(|frame| frame.count).sum()
    }

    /// The number of points in a frame.
    pub(crate) fn count(&self, index: usize) -> usize {
        self.frames.get(index).map_or(0, |frame| frame.count)
    }

    /// Whether a frame has as many points as the next, so that programs would interpolate between them.
    pub(crate) fn is_as_large_as_next(&self, index: usize) -> bool {
        self.count(index) == self.count(index + 1)
    }

    /// Reads the points of a frame, with the attributes of the sequence in their order; a frame without points has
    /// attributes without values.
    ///
    /// # Errors
    /// Those of reading; [`Error::Invalid`] if the points are others than those that were summarised.
    pub(crate) fn frame(&self, index: usize) -> Result<ParticleFrame> {
        if self.count(index) == 0 {
            return Ok(self.filled(0));
        }
        let mut frame = (self.read)(index)?;
        let changed = || Error::invalid("", Position::File, "the points changed while they were read");
        if frame.positions.len() != self.count(index) {
            return Err(changed());
        }
        let mut take = |column: &PointColumn| {
            let at =
                frame.attributes.iter().position(|attribute| column.matches(&PointColumn::of(attribute)))?;
            let PointColumn { name, role, kind, .. } = column;
            let is_wider = *kind == ColumnKind::Integers { is_wide: false }
                && PointColumn::of(&frame.attributes[at]).kind != *kind;
            if is_wider {
                return None;
            }
            Some(FileAttribute { name: name.clone(), role: *role, ..frame.attributes.swap_remove(at) })
        };
        let attributes = self.columns.iter().map(&mut take).collect::<Option<_>>().ok_or_else(changed)?;
        Ok(ParticleFrame { positions: frame.positions, attributes, notes: Vec::new() })
    }

    /// A frame with one point, whose attributes have the types of those of all frames: an integer needs 64 bits if one
    /// in any frame does.
    pub(crate) fn template(&self) -> ParticleFrame {
        self.filled(1)
    }

    fn filled(&self, count: usize) -> ParticleFrame {
        ParticleFrame {
            positions: FilePositions::F32(vec![[0.0; 3]; count]),
            attributes: self.columns.iter().map(|column| column.filled(count)).collect(),
            notes: Vec::new(),
        }
    }
}

/// The columns that all frames have, and notes on the others.
fn shared_columns(frames: &[&PointsSummary]) -> (Vec<PointColumn>, Vec<String>) {
    let (mut shared, mut lost): (Vec<PointColumn>, Vec<&str>) = (Vec::new(), Vec::new());
    for column in frames.iter().flat_map(|frame| &frame.columns) {
        if shared.iter().any(|known| known.matches(column)) || lost.contains(&&*column.name) {
            continue;
        }
        let found = frames.iter().map(|frame| frame.columns.iter().find(|other| column.matches(other)));
        let Some(found) = found.collect::<Option<Vec<_>>>() else {
            lost.push(&column.name);
            continue;
        };
        let is_wide = found.iter().any(|column| column.kind == ColumnKind::Integers { is_wide: true });
        let kind = if is_wide { ColumnKind::Integers { is_wide } } else { column.kind };
        shared.push(PointColumn { kind, ..column.clone() });
    }
    // Formats differ in the places of these.
    let role = |column: &PointColumn| match column.role {
        Some(AttributeRole::Id) => 0,
        Some(AttributeRole::Velocity) => 1,
        Some(AttributeRole::Radius) => 2,
        _ => 3,
    };
    shared.sort_by_key(role);
    let note = |name| {
        format!("{name} of the points is missing in the sequence: not all frames have it with the same type")
    };
    (shared, lost.into_iter().map(note).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(attributes: &[(&str, Values)]) -> ParticleFrame {
        let attribute = |(name, values): &(&str, Values)| FileAttribute {
            name: (*name).to_owned(),
            arity: 1,
            role: (*name == "id").then_some(AttributeRole::Id),
            values: values.clone(),
        };
        let positions = FilePositions::F64(vec![[1e6, 2.0, 3.0]]);
        ParticleFrame { positions, attributes: attributes.iter().map(attribute).collect(), notes: Vec::new() }
    }

    #[test]
    fn sequence_has_the_attributes_of_all_frames_with_points() {
        let frames = [
            frame(&[
                ("id", Values::I32(vec![5])),
                ("n", Values::I64(vec![7])),
                ("heat", Values::F32(vec![1.0])),
            ]),
            frame(&[
                ("n", Values::I64(vec![1 << 40])),
                ("id", Values::I64(vec![6])),
                ("heat", Values::I32(vec![2])),
            ]),
        ];
        let mut summaries: Vec<PointsSummary> =
            frames.iter().map(|frame| PointsSummary::of(frame).expect("a frame")).collect();
        summaries.insert(1, PointsSummary::default());
        let read = |index: usize| Ok(frames[index / 2].clone());
        let points = SequencePoints::new(summaries, Box::new(read));
        assert_eq!((points.total(), points.origin), (2, [1e6, 2.0, 3.0]));
        assert_eq!(
            points.notes(),
            ["heat of the points is missing in the sequence: not all frames have it with the same type"]
        );
        for (index, values) in [(0, Values::I64(vec![7])), (2, Values::I64(vec![1 << 40]))] {
            let frame = points.frame(index).expect("a frame");
            let names: Vec<&str> = frame.attributes.iter().map(|attribute| &*attribute.name).collect();
            assert_eq!(names, ["id", "n"]);
            assert_eq!(frame.attributes[1].values, values);
        }
        assert!(
            points.frame(1).expect("empty").attributes.iter().all(|attribute| attribute.values.len() == 0)
        );
        assert_eq!(points.template().attributes[1].values, Values::I64(vec![i64::MAX]));
    }

    #[test]
    fn points_that_changed_or_are_not_finite_are_errors() {
        let one = frame(&[("n", Values::I32(vec![7]))]);
        let summary = PointsSummary::of(&one).expect("a frame");
        for other in [frame(&[]), ParticleFrame::default()] {
            let points = SequencePoints::new(vec![summary.clone()], Box::new(|_| Ok(other.clone())));
            assert!(matches!(points.frame(0), Err(Error::Invalid { .. })));
        }
        let positions = FilePositions::F32(vec![[0.0, f32::NAN, 0.0]]);
        assert!(PointsSummary::of(&ParticleFrame { positions, ..one }).is_err());
    }
}
