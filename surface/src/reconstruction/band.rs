//! Surfaces a given level set, without particles: unchanged, or smoothed within bounds around it.
//!
//! ```text
//!   given φ ──maximum deviation 0────────────────────────────▶ [offset] ──▶ contour
//!      └──────maximum deviation s──▶ φ − s ≤ φ ≤ φ + s ──smooth──▶ [offset] ──▶ contour
//! ```
//!
//! The result is the smoothest surface that stays within the maximum deviation from the given one. The given
//! surface, moved by ± this distance, replaces the spheres that constrain the surface of particles.

use std::convert::Infallible;

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::plan::{FIELD_BYTES, mesh_bytes, smoothing_fields};
use super::{FrameSurface, SurfaceAttributes, TOPOLOGY_LEAF_BYTES, lattice, postprocess};
use crate::grid::{Field, negative_masks};
use crate::level_set::{
    Bounds, NarrowBand, WIDENED_MAX, offset_surface, widened, widened_leaf_count, widened_leaf_count_max,
};
use crate::mesh::{Mesh, PositionRounding};
use crate::options::Settings;
use crate::parallel::Loops as _;
use crate::report::ReconstructionReport;
use crate::validation::Checks;

/// Limit of the maximum deviation, in voxels: the stored band around the surface is not wider.
pub const DEVIATION_MAX_VOXELS: f32 = 3.0;

/// Half width that other programs expect of a level set, in voxels: narrower bands are widened.
const HALF_WIDTH_MIN: f32 = 3.0;

/// Margin of the smoothing band beyond the maximum deviation, in voxels.
const MARGIN: f32 = 5.0;

/// A level set between two stages, with the bounds that its surface must keep.
pub(super) struct BoundedBand {
    pub(super) band: NarrowBand,
    /// `None` if the surface is not smoothed.
    pub(super) bounds: Option<Bounds>,
    translation: DVec3,
}

impl BoundedBand {
    /// First stage: widens the band and computes the bounds.
    pub(super) fn new(
        band: NarrowBand,
        translation: DVec3,
        max_deviation_voxels: f32,
        settings: &Settings,
    ) -> BoundedBand {
        let max_deviation = max_deviation_voxels.clamp(0.0, DEVIATION_MAX_VOXELS);
        let half_width = working_half_width(band.half_width, max_deviation, offset_voxels(settings));
        let wide = half_width.map(|half_width| widened(&band, half_width));
        // Drops the given band, before there are more fields.
        let band = wide.unwrap_or(band);
        let bounds = || Bounds::new(moved(&band.phi, -max_deviation), moved(&band.phi, max_deviation));
        let bounds = (max_deviation > 0.0).then(bounds);
        BoundedBand { band, bounds, translation }
    }

    /// Third stage: the mesh with rounded positions, and its validation.
    pub(super) fn contour(
        self,
        settings: &Settings,
        rounding: PositionRounding,
        mut report: ReconstructionReport,
    ) -> FrameSurface {
        let BoundedBand { mut band, bounds, translation, .. } = self;
        report.certificate.bound_violation_count =
            bounds.map_or(0, |bounds| bounds.violation_count(&band.phi));
        let offset = offset_voxels(settings);
        if offset != 0.0 {
            let half_width = band.half_width - offset.abs().ceil();
            offset_surface(&mut band, offset, half_width);
        }
        let lattice = lattice(settings);
        let mut mesh = postprocess::contour(&band, &lattice, settings);
        // Rounding to world positions depends on where the mesh is.
        mesh.origin += translation;
        // A level set has no particles to check.
        let validate = |_: &Mesh, _: f32| Ok::<Checks, Infallible>(Checks::EMPTY);
        let Ok(()) = postprocess::finalize(&mut mesh, settings, None, rounding, &mut report, validate);
        let attributes = SurfaceAttributes::default();
        FrameSurface { band, mesh, attributes, spray: None, report }
    }
}

fn offset_voxels(settings: &Settings) -> f32 {
    (settings.offset / settings.voxel_size) as f32
}

/// Half width of the working band; `None` to keep that of the given band. An offset requires a wider band,
/// for two reasons: values in the file need not be distances that far out, and the band left after the offset
/// must not be narrower than without one.
fn working_half_width(given_half_width: f32, max_deviation: f32, offset: f32) -> Option<f32> {
    let without_offset = if max_deviation > 0.0 {
        Some(MARGIN + max_deviation.ceil())
    } else {
        (given_half_width < HALF_WIDTH_MIN).then_some(HALF_WIDTH_MIN)
    };
    if offset == 0.0 {
        return without_offset;
    }
    Some((without_offset.unwrap_or(HALF_WIDTH_MIN) + offset.abs().ceil()).min(WIDENED_MAX))
}

/// Upper estimate of the peak memory of all stages of a [level set](super::StagedFrame::of_level_set), in
/// bytes. It includes the given band.
pub fn smooth_level_set_bytes(band: &NarrowBand, max_deviation_voxels: f32, settings: &Settings) -> u64 {
    let half_width = working_half_width(band.half_width, max_deviation_voxels, offset_voxels(settings));
    let wide = half_width.map(|_| widened_leaf_count(band));
    let crossed = crossed_edge_count(band) as f64;
    working_bytes(band.topology.len(), wide, crossed, max_deviation_voxels, settings)
}

/// Upper estimate of [`smooth_level_set_bytes`] for a band with leaves at these origins, whose values are
/// unknown.
pub fn smooth_level_set_bytes_max(
    origins: &[IVec3],
    half_width: f32,
    max_deviation_voxels: f32,
    settings: &Settings,
) -> u64 {
    let working = working_half_width(half_width, max_deviation_voxels, offset_voxels(settings));
    let wide = working.map(|_| widened_leaf_count_max(origins.iter().copied()));
    let crossed = CROSSED_EDGES_PER_LEAF * origins.len() as f64;
    working_bytes(origins.len(), wide, crossed, max_deviation_voxels, settings)
}

/// Edges of the grid in a leaf that the surface crosses, at most, as the mean of a band: those of a plane
/// through the middle of every leaf, which is inclined to all axes, and a third more.
const CROSSED_EDGES_PER_LEAF: f64 = 128.0;

/// The memory for a band with `given` leaves, which is widened to `wide` leaves unless that is `None`, in
/// bytes.
fn working_bytes(
    given: usize,
    wide: Option<usize>,
    crossed_edge_count: f64,
    max_deviation_voxels: f32,
    settings: &Settings,
) -> u64 {
    let given = given as f64;
    let (leaves, widening) = match wide {
        Some(wide) => {
            let wide = wide as f64;
            // The given band, two fields of the wide band, and the list used to find its leaves.
            (wide, FIELD_BYTES * (given + 2.2 * wide) + WIDENING_LEAF_BYTES * given)
        }
        None => (given, 0.0),
    };
    let mesh = mesh_bytes(settings) * crossed_edge_count;
    let smoothing =
        if max_deviation_voxels > 0.0 { FIELD_BYTES * smoothing_fields(settings) * leaves } else { 0.0 };
    let contouring = FIELD_BYTES * 4.0 * leaves + mesh;
    let topologies = TOPOLOGY_LEAF_BYTES as f64 * (given + leaves);
    (widening.max(smoothing).max(contouring) + topologies) as u64
}

/// Memory per leaf of the given band while the surrounding leaves are listed: 27 origins, once unsorted and
/// once sorted.
const WIDENING_LEAF_BYTES: f64 = 27.0 * 28.0;

/// Number of grid edges that the surface crosses: approximately its area in voxel faces.
fn crossed_edge_count(band: &NarrowBand) -> usize {
    let inside = negative_masks(&band.phi);
    let neighbors = band.topology.neighbors();
    let crossed = |leaf: usize| -> usize {
        let own = &inside[leaf];
        let beyond = |face: usize| inside.get(neighbors[leaf][face] as usize).unwrap_or(own);
        (0..3)
            .map(|axis| {
                // The surface has no crossings beyond the last leaf.
                let [_, after] = own.shifted(axis, 1, own, beyond(2 * axis + 1));
                own.and(&after.complement()).or(&after.and(&own.complement())).iter().count()
            })
            .sum()
    };
    (0..inside.len()).into_par_iter().halved().map(crossed).sum()
}

fn moved(phi: &Field, by: f32) -> Field {
    let mut moved = phi.clone();
    moved.leaves.iter_mut().flat_map(|leaf| &mut leaf.values).for_each(|phi| *phi += by);
    moved
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{LEAF_EDGE, Leaf, Topology, voxel_in_leaf};
    use crate::options::MethodOptions;

    /// A ball in the middle of eight leaves.
    fn ball() -> NarrowBand {
        let corners = (0..8).map(|slot| IVec3::new(slot / 4 - 1, slot / 2 % 2 - 1, slot % 2 - 1) * LEAF_EDGE);
        let topology = Topology::new(corners.collect());
        let distance = |voxel: IVec3| (voxel.as_vec3().length() - 5.0).clamp(-3.0, 3.0);
        let leaf = |origin: &IVec3| Leaf {
            values: std::array::from_fn(|offset| distance(*origin + voxel_in_leaf(offset))),
        };
        let phi = Field { leaves: topology.origins().iter().map(leaf).collect() };
        NarrowBand { topology: topology.into(), phi, half_width: 3.0 }
    }

    #[test]
    fn memory_is_estimated_without_the_values() {
        let band = ball();
        let settings = Settings::paper(0.01, &MethodOptions::default()).expect("sound");
        for max_deviation in [0.0, 1.0] {
            let exact = smooth_level_set_bytes(&band, max_deviation, &settings);
            let most = smooth_level_set_bytes_max(
                band.topology.origins(),
                band.half_width,
                max_deviation,
                &settings,
            );
            assert!((exact..2 * exact).contains(&most), "{exact} {most}");
        }
    }

    #[test]
    fn distant_mesh_is_validated_at_rounded_world_positions() {
        let band = ball();
        let settings = Settings::paper(0.01, &MethodOptions::default()).expect("sound");
        let flat_count = |translation: DVec3| {
            let bounded = BoundedBand::new(band.clone(), translation, 0.0, &settings);
            let surface =
                bounded.contour(&settings, PositionRounding::World, ReconstructionReport::default());
            surface.report.flat_triangles_removed + surface.report.mesh.degenerate_triangle_count
        };
        assert_eq!(flat_count(DVec3::ZERO), 0);
        // At x = 1.5e6, consecutive 32-bit floats are an eighth of a world unit apart.
        assert!(flat_count(DVec3::new(1.5e6, 0.0, 0.0)) > 0);
    }
}
