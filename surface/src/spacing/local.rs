//! The particle spacing around one particle.
//!
//! ```text
//!    .   .   .   .         in a body: the cube root of the volume of the particle's Voronoi cell, which is
//!      ┌───┐               exact for lattices and, in the mean, for random particles
//!    . │ ● │ .   .
//!      └───┘               in a sheet or at a surface, where the cell is open: the square root of the area
//!    .   .   .   .         of the cell's section by the plane of the near particles
//!
//!    ●───●───●             in a filament or among few particles, if the section is open, too: the mean
//!                          length of the edges to the neighbours with no particle in between
//! ```
//!
//! Particles of a fluid under pressure have smaller cells than at rest, at nearly the same distances. In a
//! body, the estimate is therefore a weighted mean: the edges have a weight of a quarter.

use glam::{DMat3, DVec3};

use super::cell::{Section, Volume};

/// If a corner of a cell is farther away than this many spacings, the particle is at a surface or in spray,
/// and the cell does not measure the spacing. In a cubic lattice, corners are at 0.87 spacings.
const BODY_RADIUS_MAX: f64 = 1.25;

/// The same limit for a section. In a square lattice, corners are at 0.71 spacings.
const SHEET_RADIUS_MAX: f64 = 1.2;

/// The weight of edges in a body.
const BODY_EDGE_WEIGHT: f64 = 0.25;

/// The β of the lune-based β-skeleton that defines the edges. For any β above 1 it has the edges of a square
/// or cubic lattice, without diagonals. The mean edge of random particles is 1 spacing for a β of 1.24, that
/// of a disturbed lattice for 1.7: this value is in between.
const BETA: f64 = 1.35;

/// Edges longer than this many times the second shortest are gaps. (In a filament, the two shortest edges
/// lead to the two adjacent particles.)
const GAP: f64 = 2.5;

/// Neighbours this many times farther than the nearest are left out, to keep precision.
const FAR: f64 = 1e6;

/// The particle spacing around one particle, by the structure around it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Local {
    /// Neighbours surround the particle.
    Body(f64),
    /// Neighbours surround the particle in a plane.
    Sheet(f64),
    /// Neighbours do not surround the particle.
    Open(f64),
}

impl Local {
    /// Measures a particle among its neighbours, given as offsets, the nearest first. `None` if it has no
    /// neighbours, or if distances do not fit into an `f64`.
    pub(super) fn among(neighbors: &[DVec3]) -> Option<Local> {
        let nearest = neighbors.first()?.length();
        let near_count = neighbors.partition_point(|neighbor| neighbor.length() <= FAR * nearest);
        let neighbors = &neighbors[..near_count];
        let far = neighbors.last()?.length();

        let mut edges = edges(neighbors);
        // In a coiled filament, particles of the next turn are not neighbours.
        let farthest = GAP * edges.get(1).map_or(f64::INFINITY, |second| second.length());
        edges.retain(|edge| edge.length() <= farthest);
        let edge = edges.iter().map(|edge| edge.length()).sum::<f64>() / edges.len() as f64;
        let is_closed = |radius: f64, spacing: f64, max: f64| radius <= far && radius <= max * spacing;

        let Volume { volume, radius } = Volume::among(neighbors);
        let by_volume = volume.cbrt();
        let local = if is_closed(radius, by_volume, BODY_RADIUS_MAX) {
            Local::Body(by_volume + BODY_EDGE_WEIGHT * (edge - by_volume))
        } else {
            let section = normal(&edges).map(|normal| Section::among(neighbors, normal));
            let section = section.map(|Section { area, radius }| (area.sqrt(), radius));
            match section {
                Some((by_area, radius)) if is_closed(radius, by_area, SHEET_RADIUS_MAX) => {
                    Local::Sheet(by_area)
                }
                _ => Local::Open(edge),
            }
        };
        (local.spacing().is_finite() && local.spacing() > 0.0).then_some(local)
    }

    /// The spacing, world units.
    pub(super) fn spacing(self) -> f64 {
        match self {
            Local::Body(spacing) | Local::Sheet(spacing) | Local::Open(spacing) => spacing,
        }
    }
}

/// The neighbours, sorted by distance, with no other particle in the lune in between: no other particle is
/// closer than β/2 edge lengths to both centres of the lune.
///
/// Particles in the lune are closer than the neighbour at the end of the edge, so only those are tested.
fn edges(neighbors: &[DVec3]) -> Vec<DVec3> {
    let is_edge = |&(index, &end): &(usize, &DVec3)| {
        let radius_squared = (0.5 * BETA).powi(2) * end.length_squared();
        let centers = [0.5 * BETA * end, (1.0 - 0.5 * BETA) * end];
        let is_between =
            |other: &DVec3| centers.iter().all(|&center| other.distance_squared(center) < radius_squared);
        !neighbors[..index].iter().any(is_between)
    };
    neighbors.iter().enumerate().filter(is_edge).map(|(_, &end)| end).collect()
}

/// The direction along which the edges extend least; `None` if all edges are on one line.
///
/// It is the eigenvector of the smallest eigenvalue of Σ u·uᵀ over the edge directions u. The adjugate has
/// the same eigenvector for its largest eigenvalue, which dominates its powers.
fn normal(edges: &[DVec3]) -> Option<DVec3> {
    let moments = edges.iter().map(|edge| edge.normalize_or_zero());
    let moments = moments.fold(DMat3::ZERO, |sum, along| sum + outer(along));
    let [a, b, c] = [moments.x_axis, moments.y_axis, moments.z_axis];
    let mut power = DMat3::from_cols(b.cross(c), c.cross(a), a.cross(b));
    let trace = |matrix: &DMat3| matrix.x_axis.x + matrix.y_axis.y + matrix.z_axis.z;
    if trace(&power) <= 1e-9 * trace(&moments).powi(2) {
        return None;
    }
    for _ in 0..6 {
        power *= 1.0 / trace(&power);
        power *= power;
    }
    let diagonal = DVec3::new(power.x_axis.x, power.y_axis.y, power.z_axis.z);
    power.col(diagonal.max_position()).try_normalize()
}

fn outer(along: DVec3) -> DMat3 {
    DMat3::from_cols(along.x * along, along.y * along, along.z * along)
}
