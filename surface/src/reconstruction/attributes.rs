//! Transfers particle attributes to the surface.

use std::borrow::Cow;

use super::{FrameSurface, lattice};
use crate::attributes::{BandAttribute, Support, interpolate_to_band, interpolate_to_vertices};
use crate::options::Settings;
use crate::particles::{Attribute, AttributeValues, ParticleCloud, Positions, Role, Shapes};
use crate::report::TransferReport;

/// Attributes of a surface.
#[derive(Clone, Debug, Default)]
pub struct SurfaceAttributes {
    /// Attributes of the mesh's vertices.
    pub vertices: Vec<Attribute>,
    /// Attributes at the voxels of the band, limited to those a grid can store: a scalar or a 3-vector.
    pub band: Vec<BandAttribute>,
}

impl SurfaceAttributes {
    /// Converts velocities and accelerations to the scale of the settings.
    fn scale_velocities(&mut self, velocity_scale: f64) {
        let factor = |role: Role| Some(role.scale(velocity_scale)).filter(|factor| *factor != 1.0);
        for Attribute { role, values, .. } in &mut self.vertices {
            if let Some(factor) = factor(*role) {
                values.scale(factor);
            }
        }
        for attribute in &mut self.band {
            if let Some(factor) = factor(attribute.role) {
                attribute.scale(factor);
            }
        }
    }

    /// Memory that the attributes use, in bytes.
    pub fn size_bytes(&self) -> usize {
        let vertices: usize = self.vertices.iter().map(|attribute| attribute.values.size_bytes()).sum();
        vertices + self.band.iter().map(BandAttribute::size_bytes).sum::<usize>()
    }

    /// Upper limit of the additional memory while grids are compressed, in bytes.
    pub fn packing_bytes(&self) -> usize {
        VOXELS_PER_POINT * self.band.iter().map(BandAttribute::size_bytes).sum::<usize>()
    }
}

/// Where attributes are transferred to.
#[derive(Clone, Copy, Debug)]
pub struct Targets {
    /// To the vertices of the mesh.
    pub vertices: bool,
    /// To voxels with |φ| below this, in voxels.
    pub band_half_width_voxels: Option<f32>,
}

/// Transfers the attributes selected in the settings from the particles to the surface.
pub fn transfer_attributes(
    surface: &mut FrameSurface,
    cloud: &ParticleCloud,
    settings: &Settings,
    targets: Targets,
) {
    let particles = (Positions::from(&cloud.positions), &cloud.shapes, &*cloud.attributes);
    transfer_attributes_from(particles, surface, settings, targets);
}

/// Like [`transfer_attributes`], for particles that may be borrowed: positions, shapes and attributes.
pub(crate) fn transfer_attributes_from(
    (positions, shapes, attributes): (Positions<'_>, &Shapes, &[Attribute]),
    surface: &mut FrameSurface,
    settings: &Settings,
    targets: Targets,
) {
    let Some(selection) = &settings.attributes else { return };
    let selected: Vec<&Attribute> =
        attributes.iter().filter(|attribute| selection.selects(attribute)).collect();
    let support = support(settings, shapes);
    let mut report = TransferReport {
        attributes: selected.iter().map(|attribute| attribute.name.clone()).collect(),
        ..TransferReport::default()
    };
    if targets.vertices {
        let (vertices, counts) =
            interpolate_to_vertices(positions.borrowed(), &selected, &surface.mesh, support);
        (surface.attributes.vertices, report.vertices) = (vertices, counts);
    }
    if let Some(half_width_voxels) = targets.band_half_width_voxels {
        let grids: Vec<Cow<Attribute>> = selected.iter().copied().filter_map(of_grid).collect();
        let grids: Vec<&Attribute> = grids.iter().map(Cow::as_ref).collect();
        let band = (&surface.band, &lattice(settings));
        let (found, counts) = interpolate_to_band(positions, &grids, band, half_width_voxels, support);
        (surface.attributes.band, report.band) = (found, counts);
    }
    surface.attributes.scale_velocities(settings.velocity_scale);
    surface.report.transfer = Some(report);
}

/// Upper estimate of the number of voxels in the band per sample point.
const VOXELS_PER_POINT: usize = 6;

/// How far the attributes of a particle reach; see [`crate::attributes`].
fn support<'a>(settings: &Settings, shapes: &'a Shapes) -> Support<'a> {
    let Settings { radius_init, radius_max, offset, voxel_size, .. } = *settings;
    Support {
        radius_world: RADII * radius_init,
        radius_max_world: radius_max,
        margin_world: MARGIN_VOXELS * voxel_size + offset.max(0.0),
        shapes,
    }
}

/// Radius of the weighted mean, in units of r_init.
const RADII: f64 = 2.0;

/// Vertices are rarely farther than this outside the union of the r_max spheres, in voxels.
const MARGIN_VOXELS: f64 = 2.0;

/// The part of an attribute that a grid can store, if any: a color loses its alpha channel.
fn of_grid(attribute: &Attribute) -> Option<Cow<'_, Attribute>> {
    let AttributeValues::Numbers(values) = &attribute.values else { return None };
    match (attribute.arity, attribute.role) {
        (1 | 3, _) => Some(Cow::Borrowed(attribute)),
        (4, Role::Color) => {
            let opaque = values.chunks_exact(4).flat_map(|color| &color[..3]).copied().collect();
            let (name, role) = (attribute.name.clone(), attribute.role);
            Some(Cow::Owned(Attribute { name, role, arity: 3, values: AttributeValues::Numbers(opaque) }))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::obstacle::Obstacles;
    use crate::options::{AttributeSelection, MethodOptions};
    use crate::particles::OwnedPositions;
    use crate::reconstruction::reconstruct_cloud;

    /// Isolated particles at these positions along x, with their scale.
    fn drops(drops: &[(f64, f32)]) -> ParticleCloud {
        let attribute = |name: &str, values| Attribute {
            name: name.to_owned(),
            role: Role::Other,
            arity: 1,
            values: AttributeValues::Numbers(values),
        };
        let points = drops.iter().map(|(x, _)| [*x, 0.0, 0.0]).collect();
        let attributes = vec![
            attribute("pscale", drops.iter().map(|(_, radius)| *radius).collect()),
            attribute("x", drops.iter().map(|(x, _)| *x as f32).collect()),
        ];
        ParticleCloud { attributes, ..ParticleCloud::from(OwnedPositions::F64(points)) }
    }

    #[test]
    fn large_drops_keep_their_values_next_to_larger_ones() {
        let choices = MethodOptions {
            radius_attribute: Some("pscale".into()),
            attributes: Some(AttributeSelection::All),
            ..MethodOptions::default()
        };
        let settings = Settings::paper(0.1, &choices).expect("sound");
        let mut surface =
            reconstruct_cloud(drops(&[(0.0, 1.5), (9.0, 2.0)]), &settings, &Obstacles::default());
        let counts = surface.report.transfer.clone().expect("transferred").vertices;
        assert!(
            counts.isolated_count == surface.mesh.positions.len() && counts.empty_count == 0,
            "{counts:?}"
        );
        let AttributeValues::Numbers(found) = &surface.attributes.vertices[1].values else { panic!("reals") };
        for (position, x) in surface.mesh.positions.iter().zip(found) {
            let own = if f64::from(position.x) + surface.mesh.origin.x < 4.0 { 0.0 } else { 9.0 };
            assert_eq!(*x, own, "at {position}");
        }
        let reference = surface.attributes.vertices.clone();
        let (more, _) = crate::reconstruction::shape_particles(
            drops(&[(900.0, 4.0), (0.0, 1.5), (-50.0, 3.0), (9.0, 2.0)]),
            &settings,
        );
        let more = more.into_moved();
        let targets = Targets { vertices: true, band_half_width_voxels: None };
        transfer_attributes(&mut surface, &more, &settings, targets);
        for (one, other) in surface.attributes.vertices.iter().zip(&reference) {
            assert_eq!(one.values, other.values);
        }
    }
}
