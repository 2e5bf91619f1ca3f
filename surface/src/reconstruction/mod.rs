//! The whole method in three stages: rasterize, smooth, contour.
//!
//! The stages are separate methods of [`StagedFrame`], so that a pipeline can run a different frame in each;
//! [`reconstruct_frame`] runs all three. They do not start threads or open files: loops run in the caller's
//! rayon pool. `plan` estimates the memory of a frame, and decides whether it is computed in tiles.

mod band;
mod changes;
mod plan;
mod postprocess;
mod shape;
mod spray;
mod staged;
mod tiles;

use std::borrow::Cow;

pub use band::{DEVIATION_MAX_VOXELS, smooth_level_set_bytes, smooth_level_set_bytes_max};
pub use plan::{
    MemoryPlan, MemoryPlanError, PlanInputs, PrecisionLimit, SPREAD_MAX_VOXELS, TooLarge, VoxelTooSmall,
    plan_memory,
};
pub(crate) use shape::shapes_by_attributes;
pub use shape::{ShapedSource, shape_by_attributes, shape_by_neighbors, shape_particles};
pub use spray::ApartParticles;
pub use staged::{StageError, StagedFrame, TileStorage};

use crate::attributes::{
    BandAttribute, ComputedAttribute, Support, interpolate_to_band, interpolate_to_vertices, radius_world,
};
use crate::grid::Leaf;
use crate::level_set::{NarrowBand, offset_reach_voxels};
use crate::mesh::{Mesh, PositionRounding};
use crate::obstacle::Obstacles;
use crate::options::{Settings, Start};
use crate::particles::{
    AnySource, Attribute, AttributeValues, OwnedPositions, ParticleCloud, ParticleSource, Positions, Role,
    Shapes, Unread,
};
use crate::rasterize::{Radii, RasterParams};
use crate::report::{Phase, ReconstructionReport, ShapeStats, TransferReport};
use crate::smooth;
use crate::space::Lattice;
use crate::spray::Spray;

/// The surface of one frame.
#[derive(Clone, Debug)]
pub struct FrameSurface {
    /// The level set that was meshed.
    pub band: NarrowBand,
    /// The mesh.
    pub mesh: Mesh,
    /// Attributes of the surface; empty unless [transferred](transfer_attributes).
    pub attributes: SurfaceAttributes,
    /// The particles that are not in the mesh; `None` if the settings do not ask for it, or the caller has them.
    pub spray: Option<Spray>,
    /// Measurements and validation results.
    pub report: ReconstructionReport,
}

impl FrameSurface {
    /// Adds the particles that are not in the mesh.
    pub fn with_spray(mut self, spray: Option<Spray>) -> FrameSurface {
        self.report.spray = spray.as_ref().map(Spray::counts);
        self.spray = spray;
        self
    }

    /// Memory used, in bytes.
    pub fn size_bytes(&self) -> u64 {
        let leaves = self.band.phi.leaves.len() * (size_of::<Leaf>() + TOPOLOGY_LEAF_BYTES);
        let Mesh { positions, normals, triangles, .. } = &self.mesh;
        let mesh = size_of_val(&**positions) + size_of_val(&**normals) + size_of_val(&**triangles);
        let spray = self.spray.as_ref().map_or(0, Spray::size_bytes);
        (leaves + mesh + self.attributes.size_bytes() + spray) as u64
    }
}

/// Reconstructs the surface of one frame: applies anisotropy, rasterizes, smooths, contours. Runs in the
/// caller's rayon pool; the same particles and settings give bit-identical results on any number of threads.
/// Particles are dropped, and counted in the report, if their position is not finite or outside the grid's
/// range of indices, or if they are outliers: more than 2²⁰ voxels from the median of the particles along an
/// axis. If outliers are more than 8 particles and more than 1 % of all, or at least half of all, none of
/// them is dropped. [`plan_memory()`] detects voxels that are too small for a frame.
///
/// Positions are in world units, like the voxel size and the radii in the settings. `docs/method.md` explains
/// the method, after Bhattacharya, Gao and Bargteil.
///
/// ```
/// use meniscus_surface::particles::OwnedPositions;
/// use meniscus_surface::options::{MethodOptions, Settings};
/// use meniscus_surface::reconstruction::reconstruct_frame;
///
/// let settings = Settings::paper(0.1, &MethodOptions::default())?;
/// let drop = reconstruct_frame(&OwnedPositions::F32(vec![[1.0, 2.0, 3.0]]), &settings);
/// // An isolated particle becomes a ball, and the certificate confirms that the surface of the ball is
/// // between the particle's r_min and r_max.
/// assert!(drop.report.certificate.holds());
/// assert_eq!(drop.mesh.measure().euler_characteristic, 2);
/// # Ok::<(), meniscus_surface::options::SettingsError>(())
/// ```
pub fn reconstruct_frame(particles: &OwnedPositions, settings: &Settings) -> FrameSurface {
    reconstruct_frame_observed(particles, settings, &mut |_| {})
}

/// Like [`reconstruct_frame`]; `entered` is called at the start of each phase.
pub fn reconstruct_frame_observed(
    particles: &OwnedPositions,
    settings: &Settings,
    entered: &mut dyn FnMut(Phase),
) -> FrameSurface {
    let Ok((shaped, shape_stats)) = shape_by_neighbors(particles, ShapeStats::default(), settings);
    let obstacles = Obstacles::default();
    let surface = reconstruct_shaped(shaped, shape_stats, obstacles, settings, None, entered);
    surface.expect("everything is in memory").0
}

/// Reconstructs the surface of one frame of particles with attributes and obstacles, and transfers the
/// selected attributes to the vertices.
pub fn reconstruct_cloud(cloud: ParticleCloud, settings: &Settings, obstacles: &Obstacles) -> FrameSurface {
    let (shaped, shape_stats) = shape_particles(cloud, settings);
    let surface = reconstruct_shaped(shaped, shape_stats, obstacles.clone(), settings, None, &mut |_| {});
    let (mut surface, shaped) = surface.expect("everything is in memory");
    if let Some(shaped) = shaped {
        let targets = Targets { vertices: true, band_half_width_voxels: None };
        let ParticleCloud { positions, shapes, attributes } = shaped.into_moved();
        transfer_attributes(&mut surface, (positions.into(), None), &shapes, &attributes, settings, targets);
    }
    surface
}

/// Runs all stages on particles that have their shapes. `entered` is called at the start of each stage.
///
/// # Errors
/// An error of the source or of the storage.
pub fn reconstruct_shaped<S: ParticleSource>(
    shaped: S,
    shape_stats: ShapeStats,
    obstacles: Obstacles,
    settings: &Settings,
    tiles: Option<TileStorage>,
    entered: &mut dyn FnMut(Phase),
) -> Result<(FrameSurface, Option<S>), StageError<S::Error>> {
    entered(Phase::Rasterize);
    let frame = StagedFrame::rasterize(shaped, shape_stats, obstacles, settings, tiles)?;
    entered(Phase::Smooth);
    let frame = frame.smooth(settings, &mut |_| {})?;
    entered(Phase::Contour);
    frame.contour(settings, PositionRounding::Local)
}

/// How far particles can change φ_0 and the bounds, in voxels.
fn reach_of_particles(settings: &Settings, shapes: &ShapeStats) -> u32 {
    let radii = radii(settings);
    let longest = longest_of(shapes);
    let of_shapes = shape::shape_reach(settings, longest);
    let of_offset = if radii.offset == 0.0 { 0 } else { offset_reach_voxels(radii.result_half_width()) };
    radii.reach_voxels(longest).saturating_add(of_shapes).saturating_add(of_offset)
}

fn lattice(settings: &Settings) -> Lattice {
    Lattice { voxel_size: settings.voxel_size }
}

/// Parameters of rasterization.
fn raster_params<'a>(settings: &Settings, obstacles: &'a Obstacles) -> RasterParams<'a> {
    RasterParams {
        lattice: lattice(settings),
        radii: radii(settings),
        obstacles,
        void_threshold: settings.void_threshold as f32,
        keeps_all_particles: settings.drop_islands > 0,
    }
}

/// Number of particles inside obstacles.
fn inside_obstacles(source: &AnySource<'_>, scene: &RasterParams) -> Result<usize, Unread> {
    if scene.obstacles.is_empty() {
        Ok(0)
    } else {
        scene.obstacles.count_inside(source, &scene.lattice, scene.obstacle_half_width())
    }
}

/// The radii in voxels.
fn radii(settings: &Settings) -> Radii {
    let voxels = |world: f64| (world / settings.voxel_size) as f32;
    let [min, init, max] = [settings.radius_min, settings.radius_init, settings.radius_max].map(voxels);
    let offset = voxels(settings.offset);
    if settings.has_per_particle_shapes() {
        // The semi-axes of an ellipsoid are recovered from its matrix, which may round them slightly down.
        Radii {
            min,
            init,
            max,
            min_scale: 0.9999 * shape::min_scale(settings),
            band_scale: shape::band_scale(settings),
            unused_gap: shape::unused_gap(settings),
            offset,
            start: settings.start,
            room: voxels(settings.room()),
        }
    } else {
        Radii { offset, ..Radii::uniform(min, init, max) }
    }
}

/// Longest semi-axis of all particles, in units of the radii.
fn longest_of(shape_stats: &ShapeStats) -> f32 {
    if *shape_stats == ShapeStats::default() { 1.0 } else { shape_stats.longest }
}

fn smooth_config(settings: &Settings, obstacles: &Obstacles) -> smooth::SmoothConfig {
    smooth::SmoothConfig {
        redistances_first: !obstacles.is_empty(),
        smoothing: settings.smoothing,
        pin_isolated_spheres: can_spheres_shrink(settings),
        // The offset moves the surface to the level φ = offset, so distances must be accurate up to there.
        distances_voxels: (settings.offset / settings.voxel_size).abs() as f32,
    }
}

/// Maximum acceptable shrinking of an isolated sphere's radius in implicit steps, in voxels.
const SHRINKING_MAX: f64 = 0.15;

/// True if implicit steps could shrink an isolated sphere by more than [`SHRINKING_MAX`] before its radius
/// reaches r_min. This is always true with per-particle radii. It is false if the radii are derived from the
/// voxel size and there are 15 Laplacian steps, because these already shrink the sphere to r_min.
fn can_spheres_shrink(settings: &Settings) -> bool {
    let [least, init] = [settings.radius_min, settings.radius_init].map(|world| world / settings.voxel_size);
    let left = smooth::radius_after_laplacian(init, settings.smoothing.laplacian_steps);
    settings.start == Start::Spheres
        && (settings.per_particle_radius.is_some() || left - least > SHRINKING_MAX)
}

/// Memory per leaf of a topology: its origin, its neighbors, and its entry in the map.
const TOPOLOGY_LEAF_BYTES: usize = 80;

// Transfers particle attributes to the surface.

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

/// Transfers the attributes selected in the settings from particles to the surface. `unsmoothed` are their positions before
/// smoothing, which rest coordinates need.
pub fn transfer_attributes(
    surface: &mut FrameSurface,
    (positions, unsmoothed): (Positions<'_>, Option<&OwnedPositions>),
    shapes: &Shapes,
    attributes: &[Attribute],
    settings: &Settings,
    targets: Targets,
) {
    if !settings.has_attributes() {
        return;
    }
    let selected: Vec<Cow<Attribute>> =
        attributes.iter().filter(|attribute| settings.selects(attribute)).map(without_depth).collect();
    let selected: Vec<&Attribute> = selected.iter().map(Cow::as_ref).collect();
    let support = support(settings, shapes, unsmoothed);
    let curvature = ComputedAttribute::NormalCurvature;
    let has_curvature = curvature.is_wanted(settings.attributes.as_ref(), attributes);
    let mut report = TransferReport {
        attributes: selected
            .iter()
            .map(|attribute| attribute.name.clone())
            .chain(has_curvature.then(|| curvature.name().to_owned()))
            .collect(),
        ..TransferReport::default()
    };
    if targets.vertices {
        let (vertices, counts) =
            interpolate_to_vertices(positions.borrowed(), &selected, &surface.mesh, support);
        (surface.attributes.vertices, report.vertices) = (vertices, counts);
        if has_curvature {
            surface.attributes.vertices.push(curvature.with_values(surface.mesh.curvatures()));
        }
    }
    if let Some(half_width_voxels) = targets.band_half_width_voxels {
        let grids: Vec<Cow<Attribute>> = selected.iter().copied().filter_map(of_grid).collect();
        let grids: Vec<&Attribute> = grids.iter().map(Cow::as_ref).collect();
        let (band, lattice) = (&surface.band, &lattice(settings));
        let (found, counts) =
            interpolate_to_band(positions, &grids, band, lattice, half_width_voxels, support);
        (surface.attributes.band, report.band) = (found, counts);
    }
    surface.attributes.scale_velocities(settings.velocity_scale);
    surface.report.transfer = Some(report);
}

/// Upper estimate of the number of voxels in the band per sample point.
const VOXELS_PER_POINT: usize = 6;

/// How far the attributes of a particle reach; see [`crate::attributes`].
fn support<'a>(
    settings: &Settings,
    shapes: &'a Shapes,
    unsmoothed: Option<&'a OwnedPositions>,
) -> Support<'a> {
    let Settings { radius_max, offset, voxel_size, .. } = *settings;
    Support {
        radius_world: radius_world(settings),
        radius_max_world: radius_max,
        margin_world: MARGIN_VOXELS * voxel_size + offset.max(0.0),
        shapes,
        unsmoothed,
    }
}

/// Vertices are rarely farther than this outside the union of the r_max spheres, in voxels.
const MARGIN_VOXELS: f64 = 2.0;

/// The attribute; texture coordinates without their third number, which has no meaning for pictures.
fn without_depth(attribute: &Attribute) -> Cow<'_, Attribute> {
    match &attribute.values {
        AttributeValues::Numbers(values)
            if (attribute.role, attribute.arity) == (Role::TextureCoordinates, 3) =>
        {
            let flat = values.chunks_exact(3).flat_map(|all| &all[..2]).copied().collect();
            let (name, role) = (attribute.name.clone(), attribute.role);
            Cow::Owned(Attribute { name, role, arity: 2, values: AttributeValues::Numbers(flat) })
        }
        _ => Cow::Borrowed(attribute),
    }
}

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
        let (more, _) =
            super::shape_particles(drops(&[(900.0, 4.0), (0.0, 1.5), (-50.0, 3.0), (9.0, 2.0)]), &settings);
        let ParticleCloud { positions, shapes, attributes } = more.into_moved();
        let targets = Targets { vertices: true, band_half_width_voxels: None };
        transfer_attributes(&mut surface, (positions.into(), None), &shapes, &attributes, &settings, targets);
        for (one, other) in surface.attributes.vertices.iter().zip(&reference) {
            assert_eq!(one.values, other.values);
        }
    }
}
