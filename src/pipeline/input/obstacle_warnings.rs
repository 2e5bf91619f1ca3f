//! Checks for likely mistakes in obstacle files.

use crate::surface::obstacle::{MeshFindings, Shape};
use crate::surface::options::Settings;

use crate::pipeline::warning::ObstacleFinding;

/// A level set with a narrower band than this, in units of h, hardly shows where its surface is.
const KNOWN_MIN: f64 = 1.0;

/// The likely mistakes in an obstacle.
pub(crate) fn findings_of(shape: &Shape, settings: &Settings) -> Vec<ObstacleFinding> {
    let mut found = Vec::new();
    match shape {
        Shape::Solid(solid) => {
            let MeshFindings { open_edge_count, encloses_nothing, turned_count, .. } = *solid.findings();
            let MeshFindings { unasked_part_count, broken_count, triangle_count, .. } = *solid.findings();
            if open_edge_count > 0 {
                found.push(ObstacleFinding::Open { edge_count: open_edge_count, encloses_nothing });
            }
            if turned_count > 0 {
                found.push(ObstacleFinding::Turned { triangle_count: turned_count });
            }
            if unasked_part_count > 0 {
                found.push(ObstacleFinding::Unasked { part_count: unasked_part_count });
            }
            if broken_count > 0 {
                found.push(ObstacleFinding::Broken { triangle_count: broken_count });
            }
            if triangle_count == 0 {
                found.push(ObstacleFinding::Flat);
            }
        }
        Shape::Sampled(sampled) => {
            found.extend(sampled.rebuilt_because().map(ObstacleFinding::Rebuilt));
            let known_voxels = (sampled.band_width() - sampled.voxel_size()) / settings.voxel_size;
            if known_voxels < KNOWN_MIN {
                found.push(ObstacleFinding::NarrowBand { known_voxels });
            }
        }
    }
    found
}
