//! The description of a sequence file for `meniscus info`. Areas and volumes are omitted: their sums over all
//! frames would be meaningless.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use super::super::wording::shortest;
use super::row;

/// A file with all frames of a sequence, as meniscus writes it.
#[derive(Debug, Serialize)]
pub(super) struct SequenceFileRecord {
    pub(super) frames: u64,
    /// The number of the first frame, and of the last.
    first: Option<i64>,
    last: Option<i64>,
    /// Frames per second.
    fps: Option<f64>,
    /// Total over all frames.
    vertices: u64,
    /// Total over all frames.
    triangles: u64,
    /// The names of the vertex attributes.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    attributes: Vec<String>,
}

impl SequenceFileRecord {
    /// A sequence file with this number of frames, these totals of vertices and triangles over all frames,
    /// and these attributes; the rest comes from its recorded metadata.
    pub(super) fn new(
        frames: u64,
        [vertices, triangles]: [u64; 2],
        attributes: Vec<String>,
        made_by: Option<&BTreeMap<String, String>>,
    ) -> SequenceFileRecord {
        let number = |name: &str| made_by?.get(name)?.parse().ok();
        let fps = made_by.and_then(|made_by| made_by.get("fps")?.parse().ok());
        let [first, last] = ["first", "last"].map(number);
        SequenceFileRecord { frames, first, last, fps, vertices, triangles, attributes }
    }
}

impl fmt::Display for SequenceFileRecord {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        row(f, "frames", self.frames)?;
        for (label, number) in [("first frame", self.first), ("last frame", self.last)] {
            number.iter().try_for_each(|number| row(f, label, number))?;
        }
        self.fps.iter().try_for_each(|fps| row(f, "frames per second", shortest(*fps)))?;
        row(f, "vertices", format_args!("{}, in all frames", self.vertices))?;
        row(f, "triangles", format_args!("{}, in all frames", self.triangles))?;
        self.attributes.iter().try_for_each(|name| row(f, "attribute", name))
    }
}
