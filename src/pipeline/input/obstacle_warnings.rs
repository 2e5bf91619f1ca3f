//! Checks for likely mistakes in obstacle files.

use crate::surface::obstacle::{MeshFindings, ObstacleSdf};
use crate::surface::options::Settings;

use crate::pipeline::warning::ObstacleFinding;

/// Minimum band width of a level set, less one of its own voxels, in units of the frame's voxel size h. A
/// narrower band hardly shows where the surface of the obstacle is.
const KNOWN_MIN: f64 = 1.0;

/// The likely mistakes in an obstacle.
pub(crate) fn findings_of(shape: &ObstacleSdf, settings: &Settings) -> Vec<ObstacleFinding> {
    let mut found = Vec::new();
    match shape {
        ObstacleSdf::Mesh(solid) => {
            let MeshFindings { open_edge_count, encloses_nothing, flipped_count, .. } = *solid.findings();
            let MeshFindings { unchecked_part_count, invalid_count, triangle_count, .. } = *solid.findings();
            let MeshFindings { sheet_count, .. } = *solid.findings();
            if sheet_count > 0 {
                found.push(ObstacleFinding::Sheets { count: sheet_count });
            }
            if open_edge_count > 0 {
                found.push(ObstacleFinding::Open { edge_count: open_edge_count, encloses_nothing });
            }
            if flipped_count > 0 {
                found.push(ObstacleFinding::Flipped { triangle_count: flipped_count });
            }
            if unchecked_part_count > 0 {
                found.push(ObstacleFinding::PossiblyInverted { part_count: unchecked_part_count });
            }
            if invalid_count > 0 {
                found.push(ObstacleFinding::InvalidTriangles { triangle_count: invalid_count });
            }
            if triangle_count == 0 {
                found.push(ObstacleFinding::Flat);
            }
        }
        ObstacleSdf::Grid(sampled) => {
            found.extend(sampled.rebuild_reason().map(ObstacleFinding::Rebuilt));
            let known_voxels = (sampled.band_width() - sampled.voxel_size()) / settings.voxel_size;
            if known_voxels < KNOWN_MIN {
                found.push(ObstacleFinding::NarrowBand { known_voxels });
            }
        }
    }
    found
}
