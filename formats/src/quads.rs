//! Merges pairs of triangles into quads, for formats with polygons.
//!
//! ```text
//!    d ─── c
//!    │ ╲   │     (a b d) (b c d)  ──▶  a b c d, counter-clockwise like the triangles
//!    │   ╲ │
//!    a ─── b
//! ```

use std::ops::Range;

use crate::error::{Error, Position, Result};

/// A face of a mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Face {
    Triangle([u32; 3]),
    Quad([u32; 4]),
}

impl Face {
    /// Its vertices, counter-clockwise seen from outside.
    pub(crate) fn corners(&self) -> &[u32] {
        match self {
            Face::Triangle(corners) => corners,
            Face::Quad(corners) => corners,
        }
    }
}

/// The faces whose first triangle is in `range`. `quads` says for each triangle whether it and the next one
/// form a quad; if `quads` is empty, there are no quads. A quad takes the place of its first triangle in the
/// order.
pub(crate) fn faces<'a>(
    triangles: &'a [[u32; 3]],
    quads: &'a [bool],
    range: Range<usize>,
) -> impl Iterator<Item = Face> + 'a {
    let is_quad = |index: usize| quads.get(index).copied().unwrap_or(false);
    range.filter(move |&index| index == 0 || !is_quad(index - 1)).map(move |index| {
        let quad = if is_quad(index) { quad_of(triangles[index], triangles[index + 1]) } else { None };
        quad.map_or(Face::Triangle(triangles[index]), Face::Quad)
    })
}

/// The number of quads among the faces.
pub(crate) fn quad_count(quads: &[bool]) -> usize {
    quads.iter().filter(|&&is_quad| is_quad).count()
}

/// Fails if two triangles marked as a quad share no edge, or a triangle belongs to two quads.
pub(crate) fn check_quads(format: &'static str, triangles: &[[u32; 3]], quads: &[bool]) -> Result<()> {
    let invalid = |what: String| Err(Error::invalid(format, Position::File, what));
    if !quads.is_empty() && quads.len() != triangles.len() {
        return invalid(format!("there are {} quad flags for {} triangles", quads.len(), triangles.len()));
    }
    let is_none = |&index: &usize| {
        quads[index]
            && (quads.get(index + 1) != Some(&false)
                || quad_of(triangles[index], triangles[index + 1]).is_none())
    };
    match (0..quads.len()).find(is_none) {
        Some(index) => invalid(format!("triangle {index} and the next one do not form a quad")),
        None => Ok(()),
    }
}

/// The quad formed by two triangles, counter-clockwise like them; `None` unless they share an edge that they
/// traverse in opposite directions.
fn quad_of(one: [u32; 3], other: [u32; 3]) -> Option<[u32; 4]> {
    let turns = |[a, b, c]: [u32; 3]| [[a, b, c], [b, c, a], [c, a, b]];
    turns(one).into_iter().find_map(|[a, b, c]| {
        let [.., d] = turns(other).into_iter().find(|[from, to, _]| [*from, *to] == [b, a])?;
        Some([a, d, b, c])
    })
}
