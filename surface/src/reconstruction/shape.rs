//! Determines each particle's shape and position before rasterization: scaled, stretched, moved toward its
//! neighbors, or an unchanged ball.
//!
//! ```text
//!   given ──attributes──▶ sizes, stretch by velocity ──neighbors──▶ positions, stretch by neighbors
//!           each particle independently               particles near uncovered places only
//! ```
//!
//! Particles deep inside do not affect the surface, so they stay where they are and remain balls. The
//! required depth is part of the method and does not depend on tiles or memory.
//!
//! Let R be the neighbor radius, and call a voxel covered if it is certainly within r_init of a given
//! particle. A particle is deep if every voxel within R plus its own r_init is covered. A deep particle then
//! has neighbors on all sides within R, so their mean is approximately its own position, and its shape is
//! approximately a ball. The additional r_init puts a layer of moved particles between the deep ones and the
//! surface, so that the nearest particle of any place outside is a moved one. Where the density of deep
//! particles changes within R, smoothing their positions would open voids; because they stay where they are, it
//! does not.
//!
//! Displacements are computed in blocks, so the result is the same for frames larger than memory.

use std::borrow::Cow;

use glam::DVec3;

use super::changes::{BlockChanges, NeighborChanges, changed_bytes};
use super::lattice;
use crate::anisotropy::{
    KernelConfig, NeighborConfig, NeighborShapes, RadiusScales, Stretch, VelocityConfig, from_neighbors,
    from_velocities, radius_scales,
};
use crate::options::{Anisotropy, PerParticleRadius, RADIUS_MAX_VOXELS, Settings, Start};
use crate::particles::{
    AnySource, Attribute, BODY_SCALE, LONE_SCALE, OwnedPositions, ParticleCloud, ParticleSource, Positions,
    Shapes, Unread, erased, find_attribute,
};
use crate::rasterize::{NearSurface, Vicinity};
use crate::report::ShapeStats;

/// Applies the shapes and positions that the settings request. If an attribute that the settings require is
/// missing, or does not have a number or a vector per particle, the particles are balls; callers check the
/// attributes first.
pub fn shape_particles(
    cloud: ParticleCloud,
    settings: &Settings,
) -> (ShapedSource<ParticleCloud>, ShapeStats) {
    let (cloud, shape_stats) = shape_by_attributes(cloud, settings);
    let Ok(shaped) = shape_by_neighbors(cloud, shape_stats, settings);
    shaped
}

/// Applies the shapes that the settings derive from attributes.
pub fn shape_by_attributes(cloud: ParticleCloud, settings: &Settings) -> (ParticleCloud, ShapeStats) {
    let (shapes, shape_stats) = shapes_by_attributes(cloud.positions.len(), &cloud.attributes, settings);
    let shapes = if settings.has_per_particle_shapes() { shapes } else { cloud.shapes };
    (ParticleCloud { shapes, ..cloud }, shape_stats)
}

/// The shapes that the settings derive from attributes, for `count` particles.
pub(crate) fn shapes_by_attributes(
    count: usize,
    attributes: &[Attribute],
    settings: &Settings,
) -> (Shapes, ShapeStats) {
    if !settings.has_per_particle_shapes() {
        return (Shapes::Uniform, ShapeStats::default());
    }
    let mut shape_stats = ShapeStats::default();
    let scales = settings
        .per_particle_radius
        .as_ref()
        .and_then(|own| scales(count, attributes, own, settings, &mut shape_stats));
    let by_velocity = match settings.anisotropy {
        Anisotropy::None | Anisotropy::Neighbors { .. } => None,
        Anisotropy::Velocity { gain, max_stretch } => {
            let gain_per_speed = (gain * settings.velocity_scale / settings.unit_radius()) as f32;
            let max_stretch = max_stretch as f32;
            let config = VelocityConfig { gain_per_speed, max_stretch, floor: resolved_radius(settings) };
            numbers(count, attributes, "velocity", 3)
                .map(|velocities| from_velocities(&velocities, scales.as_deref(), &config))
        }
    };
    let shapes = match (by_velocity, scales) {
        (Some(shaped), _) => {
            shape_stats.raised_count = shaped.raised_count;
            shape_stats.ball_count = shaped.ball_count;
            Shapes::Ellipsoids(shaped.shapes)
        }
        (None, Some(scales)) => Shapes::Scaled(scales),
        (None, None) => Shapes::Uniform,
    };
    shape_stats.longest = (0..count).map(|index| shapes.outer_radius(index)).fold(0.0, f32::max);
    (shapes, shape_stats)
}

/// Applies the positions and shapes that the settings derive from neighbors. `shape_stats` are the statistics
/// of the attribute step.
///
/// # Errors
/// Returns the source's error if a batch cannot be read.
pub fn shape_by_neighbors<S: ParticleSource>(
    given: S,
    shape_stats: ShapeStats,
    settings: &Settings,
) -> Result<(ShapedSource<S>, ShapeStats), S::Error> {
    in_blocks(given, shape_stats, settings, GATHERED_MAX)
}

/// Like [`shape_by_neighbors`], with blocks of about `gathered_max` particles, including neighbors.
fn in_blocks<S: ParticleSource>(
    given: S,
    shape_stats: ShapeStats,
    settings: &Settings,
    gathered_max: usize,
) -> Result<(ShapedSource<S>, ShapeStats), S::Error> {
    if !settings.uses_neighbors() {
        return Ok((ShapedSource { given, changes: NeighborChanges::default() }, shape_stats));
    }
    let (changes, shape_stats) =
        erased(&given, |given| changes_in_blocks(given, shape_stats, settings, gathered_max))?;
    Ok((ShapedSource { given, changes }, shape_stats))
}

fn changes_in_blocks(
    given: &AnySource<'_>,
    mut shape_stats: ShapeStats,
    settings: &Settings,
    gathered_max: usize,
) -> Result<(NeighborChanges, ShapeStats), Unread> {
    let stretch = stretch(settings);
    let lattice = lattice(settings);
    let depth = Depth::new(settings, given.has_shapes());
    // Where particles are very dense, neighbors are sampled from whole cells of the search grid: the
    // particle's own cell and those around it.
    let margin = (2.0 * settings.neighbor_radius / settings.voxel_size).ceil() as i32 + 1;
    let depth_of = |longest| depth.voxels(longest);
    let vicinity = Vicinity::new(given, &lattice, depth.cover_voxels, depth_of, margin)?;
    let config = neighbor_config(settings);
    let mut found: Vec<BlockChanges> = Vec::new();
    let mut longest_found = 0.0f32;
    for block in vicinity.blocks(gathered_max) {
        let gathered = vicinity.gather(&block, given, &lattice)?;
        let positions = OwnedPositions::F64(gathered.positions);
        let scales = (!gathered.scales.is_empty()).then_some(&*gathered.scales);
        let NeighborShapes { indices, means, shapes, raised_count, ball_count } =
            from_neighbors(&positions, |index| gathered.is_own[index], scales, &config);
        shape_stats.near_count += gathered.is_own.iter().filter(|is_own| **is_own).count();
        shape_stats.raised_count += raised_count;
        shape_stats.ball_count += ball_count;
        longest_found = shapes.iter().map(|shape| shape.longest).fold(longest_found, f32::max);
        let sources = indices.iter().map(|&index| gathered.sources[index as usize]).collect();
        let means = if settings.position_smoothing > 0.0 { &*means } else { &[] };
        found.push(BlockChanges::new(sources, means, shapes));
    }
    // Particles that are stretched by their velocities grow by the size that is found.
    let is_resized = stretch.is_some() && matches!(settings.anisotropy, Anisotropy::Velocity { .. });
    let growth = if is_resized { GROWTH_MAX } else { 1.0 };
    let unchanged = if stretch.is_some() { depth.ball } else { 0.0 };
    shape_stats.longest = (vicinity.longest() * growth).max(longest_found).max(unchanged);
    drop(vicinity);
    let step_world = settings.position_smoothing * settings.neighbor_radius;
    let ball = stretch.is_some().then_some(depth.ball);
    let changes =
        NeighborChanges::new(found, step_world, ball, given.batch_count(), |batch| given.batch_len(batch));
    Ok((changes, shape_stats))
}

/// By how much a particle in a body is larger than alone, and a little more for rounding.
const GROWTH_MAX: f32 = 1.001 * BODY_SCALE;

/// Approximate number of particles per block: some hundred bytes each.
const GATHERED_MAX: usize = 1 << 22;

/// The depth below which particles are neither moved nor stretched by neighbors.
struct Depth {
    /// Radius of the ball that each particle certainly contains when scaled to r_init, in voxels.
    cover_voxels: f32,
    /// Scale of the particles for which the input gives none, in units of the settings' radii.
    ball: f32,
    neighbor_voxels: f64,
    radius_init_voxels: f64,
}

impl Depth {
    fn new(settings: &Settings, given_have_shapes: bool) -> Depth {
        let voxels = |world: f64| world / settings.voxel_size;
        let ball = if settings.has_per_particle_shapes() { resolved_radius(settings).max(1.0) } else { 1.0 };
        let cover_scale = if given_have_shapes {
            // The semi-axes of an ellipsoid are recovered from its matrix, which may round them slightly
            // down.
            0.9999 * resolved_radius(settings)
        } else {
            ball
        };
        Depth {
            cover_voxels: voxels(settings.radius_init) as f32 * cover_scale,
            ball,
            neighbor_voxels: voxels(settings.neighbor_radius),
            radius_init_voxels: voxels(settings.radius_init),
        }
    }

    /// The depth for the particles of a leaf whose longest semi-axis is `longest`.
    fn voxels(&self, longest: f32) -> f32 {
        (self.neighbor_voxels + self.radius_init_voxels * f64::from(longest.max(self.ball))) as f32
    }

    /// Maximum distance from a particle, in voxels, at which others affect whether it is moved.
    fn reach_voxels(&self, longest: f32) -> f64 {
        // `Vicinity` groups leaves by powers of two of their longest semi-axis, and may lose one voxel per
        // erosion step.
        let depth = f64::from(self.voxels(2.0 * longest));
        let steps = (depth / 7.0).ceil() + f64::from(longest.max(1.0).log2().ceil()) + 1.0;
        // A leaf that contains a long particle is treated as a whole.
        depth + steps + f64::from(self.cover_voxels) + 8.0 + 2.0
    }
}

/// Which particles may be moved or stretched according to their neighbors; `None` if the settings do neither.
pub(super) fn near_surface(settings: &Settings) -> Option<NearSurface> {
    let depth = Depth::new(settings, settings.per_particle_radius.is_some());
    settings.uses_neighbors().then(|| NearSurface { depth: depth.voxels(1.0), cover: depth.cover_voxels })
}

/// Memory per particle that may be moved or stretched by its neighbors, in bytes: while the results are
/// collected, and afterwards.
pub(super) fn changes_bytes(settings: &Settings) -> [f64; 2] {
    changed_bytes(settings.position_smoothing > 0.0, stretch(settings).is_some())
}

/// Memory for the particles of a block and their neighbors, in a frame of `particle_count` particles, in
/// bytes.
pub(super) fn gathered_bytes(particle_count: usize) -> f64 {
    GATHERED_BYTES * particle_count.min(2 * GATHERED_MAX) as f64
}

/// Memory per particle of a block, in bytes: its position, unsorted and sorted, and its sort key.
const GATHERED_BYTES: f64 = 110.0;

/// Maximum distance, in voxels, at which other particles affect a particle's position and shape, plus its
/// displacement. `longest` bounds the semi-axes, in units of the radii.
pub(super) fn shape_reach(settings: &Settings, longest: f32) -> u32 {
    if !settings.uses_neighbors() {
        return 0;
    }
    let radius = settings.neighbor_radius / settings.voxel_size;
    let depth = Depth::new(settings, settings.per_particle_radius.is_some());
    let moved = settings.position_smoothing * radius;
    // Where particles are very dense, neighbors are sampled from whole cells.
    (moved + depth.reach_voxels(longest).max(2.0 * radius)).ceil() as u32
}

/// A particle source with the displacements and shapes from neighbors applied.
#[derive(Clone, Debug)]
pub struct ShapedSource<S> {
    given: S,
    changes: NeighborChanges,
}

impl<S> ShapedSource<S> {
    /// The same changes, to particles that `map` makes from the given ones.
    pub fn filter_map<T>(self, map: impl FnOnce(S) -> Option<T>) -> Option<ShapedSource<T>> {
        Some(ShapedSource { given: map(self.given)?, changes: self.changes })
    }

    /// The particles as given.
    pub fn given(&self) -> &S {
        &self.given
    }

    /// Memory used in addition to the given particles, in bytes.
    pub fn size_bytes(&self) -> usize {
        self.changes.size_bytes()
    }

    /// The changed positions and shapes. Borrowed positions are copied only if some particles are moved.
    pub(crate) fn into_positions<'a>(
        self,
        of_given: impl FnOnce(S) -> (Positions<'a>, Shapes),
    ) -> (Positions<'a>, Shapes) {
        let ShapedSource { given, changes } = self;
        let (positions, shapes) = of_given(given);
        changes.apply(positions, shapes)
    }
}

impl ShapedSource<ParticleCloud> {
    /// The changed particles.
    pub fn into_moved(self) -> ParticleCloud {
        let ShapedSource { given: ParticleCloud { positions, shapes, attributes }, changes } = self;
        let (positions, shapes) = changes.apply(positions.into(), shapes);
        ParticleCloud { positions: positions.into(), shapes, attributes }
    }
}

impl<S: ParticleSource> ParticleSource for ShapedSource<S> {
    type Error = S::Error;

    fn batch_count(&self) -> usize {
        self.given.batch_count()
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, S::Error> {
        let mut positions = self.given.batch(batch)?;
        self.changes.move_batch(batch, &mut positions, 0);
        Ok(positions)
    }

    fn has_shapes(&self) -> bool {
        self.changes.stretches() || self.given.has_shapes()
    }

    fn batch_shapes(&self, batch: usize) -> Shapes {
        self.changes.shapes_of(batch, self.given.batch_shapes(batch), self.given.batch_len(batch))
    }

    fn batch_len(&self, batch: usize) -> usize {
        self.given.batch_len(batch)
    }

    fn is_smoothed(&self) -> bool {
        self.changes.moves()
    }

    fn moved_pairs(&self, batch: usize) -> Result<Vec<[DVec3; 2]>, S::Error> {
        let mut moves = self.changes.moves_of(batch).peekable();
        if moves.peek().is_none() {
            return Ok(Vec::new());
        }
        let positions = self.given.batch(batch)?;
        let both = |(particle, step)| {
            let given = positions.position(particle);
            [given, given + step]
        };
        Ok(moves.map(both).collect())
    }
}

/// Scale of each particle, in units of the settings' radii.
pub(super) fn scales(
    count: usize,
    attributes: &[Attribute],
    own: &PerParticleRadius,
    settings: &Settings,
    shape_stats: &mut ShapeStats,
) -> Option<Vec<f32>> {
    let radii = numbers(count, attributes, &own.attribute, 1)?;
    let RadiusScales { mut scales, raised_count, invalid_count } =
        radius_scales(&radii, own.scale, settings.unit_own_radius(), resolved_radius(settings));
    shape_stats.small_radius_count = raised_count;
    if raised_count > 0 {
        let least = own.radii_min(attributes).into_iter().reduce(f64::min).unwrap_or(0.0);
        let unit = settings.unit_radius() / settings.unit_own_radius();
        shape_stats.small_voxel_size = least * unit / settings.start.resolved_voxels();
    }
    shape_stats.invalid_radius_count = invalid_count;
    let most = ((RADIUS_MAX_VOXELS * settings.voxel_size / settings.radius_max) as f32)
        .max(resolved_radius(settings));
    shape_stats.large_radius_count = scales.iter().filter(|&&scale| scale > most).count();
    let greatest = scales.iter().copied().fold(most, f32::max);
    shape_stats.large_voxel_size = settings.voxel_size * f64::from(greatest / most);
    scales.iter_mut().for_each(|scale| *scale = scale.min(most));
    Some(scales)
}

/// The numbers of an attribute with `arity` values for each of `count` particles.
fn numbers<'a>(
    count: usize,
    attributes: &'a [Attribute],
    name: &str,
    arity: usize,
) -> Option<Cow<'a, [f32]>> {
    let numbers = find_attribute(attributes, name, arity)?.values.numbers()?;
    (numbers.len() == arity * count).then_some(numbers)
}

/// How neighbors move and stretch particles.
fn neighbor_config(settings: &Settings) -> NeighborConfig {
    let weight_scale = (COMPANY_RADIUS * settings.spacing / settings.neighbor_radius).powi(3) as f32;
    // The radius of a particle is half the spacing of particles of its size.
    let own_spacing = settings
        .per_particle_radius
        .as_ref()
        .map_or(1.0, |own| (2.0 * settings.unit_own_radius() / (own.scale * settings.spacing)) as f32);
    NeighborConfig {
        radius_world: settings.neighbor_radius,
        weight_scale,
        own_spacing,
        stretch: stretch(settings),
    }
}

/// How neighbors shape particles, if at all.
fn stretch(settings: &Settings) -> Option<Stretch> {
    let per_voxel = (settings.spacing / settings.voxel_size) as f32;
    let kernels = (settings.start == Start::Kernels).then(|| KernelConfig {
        per_reach: (settings.neighbor_radius / settings.radius_max) as f32,
        room_least: ROOM_LEAST * per_voxel,
        room_most: (settings.room() / settings.voxel_size) as f32,
    });
    match settings.anisotropy {
        Anisotropy::Neighbors { max_stretch } => {
            Some(Stretch { max_stretch: max_stretch as f32, floor: thinnest(settings), kernels })
        }
        // Company changes only their sizes, from that of a lone particle on.
        Anisotropy::None | Anisotropy::Velocity { .. } => {
            let floor = LONE_SCALE * resolved_radius(settings);
            kernels.map(|_| Stretch { max_stretch: 1.0, floor, kernels })
        }
    }
}

/// How far the surface may move inward from its start where fluid is thin, in spacings: hardly, or drops and
/// sheets would shrink.
const ROOM_LEAST: f32 = 0.03;

/// The smallest semi-axis of a particle flattened by its neighbours, in units of the settings' radii.
fn thinnest(settings: &Settings) -> f32 {
    match settings.start {
        Start::Spheres => resolved_radius(settings),
        Start::Kernels => {
            ((THIN_MIN_VOXELS * settings.voxel_size / settings.unit_radius()) as f32).min(LONE_SCALE)
        }
    }
}

/// The smallest semi-axis of a flattened particle, in units of h. The two sides of a sheet are then 1.8
/// voxels apart.
const THIN_MIN_VOXELS: f64 = 0.9;

/// The limits of a particle's company are sums of weights within this distance, in spacings.
const COMPANY_RADIUS: f64 = 2.6;

/// Radius of the smallest ball that the grid resolves wherever it is, in units of the settings' radii. No semi-axis of a
/// ball, or of a particle stretched by velocity, is shorter.
fn resolved_radius(settings: &Settings) -> f32 {
    (settings.start.resolved_voxels() * settings.voxel_size / settings.unit_radius()) as f32
}

/// Lower bound of all semi-axes, in units of the settings' radii.
pub(super) fn min_scale(settings: &Settings) -> f32 {
    stretch(settings).map_or(resolved_radius(settings), |stretch| stretch.floor)
}

/// The semi-axis for which the width of the band is computed, in units of the settings' radii. It is the same
/// for all frames of a sequence, whatever particles they contain. Stretched particles need no wider band:
/// where the surface may move, at the faces of sheets and the sides of filaments, they are thin.
pub(super) fn band_scale(settings: &Settings) -> f32 {
    if settings.per_particle_radius.is_some() { SCALE_MARGIN } else { 1.0 }
}

/// How much less than its bounds allow the surface of stretched particles moves, in voxels. On the grids of the
/// presets, a band that is narrower by this leaves ∫H² as it is, within 1 %.
pub(super) fn unused_gap(settings: &Settings) -> f32 {
    let is_stretched = settings.anisotropy != Anisotropy::None && settings.per_particle_radius.is_none();
    if is_stretched { 3.0 } else { 0.0 }
}

/// With the radii of the paper, the bounds of a particle with three times the smallest radius are three
/// voxels (rounded up) from the initial surface: farther than smoothing moves a surface.
const SCALE_MARGIN: f32 = 3.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::anisotropy::from_neighbors;
    use crate::obstacle::Obstacles;
    use crate::options::{AnisotropyKind, MethodOptions, Preset};
    use crate::particles::Ellipsoid;
    use crate::reconstruction::changes::{move_double, rounded};
    use crate::reconstruction::{FrameSurface, reconstruct_shaped};

    /// A source with batches of a given size, as from a file.
    struct Batches<'a> {
        cloud: &'a ParticleCloud,
        size: usize,
    }

    impl Batches<'_> {
        fn range(&self, batch: usize) -> std::ops::Range<usize> {
            batch * self.size..self.cloud.positions.len().min((batch + 1) * self.size)
        }
    }

    impl ParticleSource for Batches<'_> {
        type Error = std::convert::Infallible;

        fn batch_count(&self) -> usize {
            self.cloud.positions.len().div_ceil(self.size)
        }

        fn batch(&self, batch: usize) -> Result<Positions<'_>, Self::Error> {
            let range = self.range(batch);
            Ok(match &self.cloud.positions {
                OwnedPositions::F32(positions) => Positions::F32(Cow::Borrowed(&positions[range])),
                OwnedPositions::F64(positions) => Positions::F64(Cow::Borrowed(&positions[range])),
            })
        }

        fn batch_len(&self, batch: usize) -> usize {
            self.range(batch).len()
        }

        fn has_shapes(&self) -> bool {
            !self.cloud.shapes.is_uniform()
        }

        fn batch_shapes(&self, batch: usize) -> Shapes {
            self.cloud.shapes.slice(self.range(batch))
        }
    }

    fn random(state: &mut u32) -> f64 {
        *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(*state >> 8) / f64::from(1 << 24) - 0.5
    }

    /// A block with a deep interior and a very dense spot, a filament, and isolated particles: spacing 1,
    /// shuffled.
    fn cloud(edge: usize) -> ParticleCloud {
        let mut state = 5;
        let mut jitter = || random(&mut state) * 0.5;
        let mut positions: Vec<[f64; 3]> = (0..edge.pow(3))
            .map(|index| {
                [index / edge / edge, index / edge % edge, index % edge].map(|along| along as f64 + jitter())
            })
            .collect();
        let high = edge as f64;
        positions.extend((0..9).map(|index| [high + f64::from(index), 3.0, 4.0 + jitter()]));
        positions.extend((0..300).map(|_| [high, high + 0.1 * jitter(), high + 0.1 * jitter()]));
        positions.extend([[-7.0, -8.0, 2.0], [f64::NAN, 0.0, 1.0]]);
        let count = positions.len();
        let mut order: Vec<usize> = (0..count).collect();
        order.sort_by_key(|index| (*index as u32).wrapping_mul(0x9e37_79b9));
        OwnedPositions::F64(order.into_iter().map(|index| positions[index]).collect()).into()
    }

    fn choices() -> [MethodOptions; 3] {
        let balls = MethodOptions {
            position_smoothing: Some(0.9),
            neighbor_radius: Some(2.6.into()),
            ..MethodOptions::default()
        };
        let neighbors = MethodOptions { anisotropy: Some(AnisotropyKind::Neighbors), ..balls.clone() };
        [balls, neighbors.clone(), MethodOptions { position_smoothing: None, ..neighbors }]
    }

    fn bits<S: ParticleSource>(source: &S) -> (Vec<[u64; 3]>, Vec<Ellipsoid>) {
        let (mut positions, mut shapes) = (Vec::new(), Vec::new());
        for batch in 0..source.batch_count() {
            let Ok(of_batch) = source.batch(batch) else { panic!("in memory") };
            let bits = |particle| of_batch.position(particle).to_array().map(f64::to_bits);
            positions.extend((0..of_batch.len()).map(bits));
            if let Shapes::Ellipsoids(ellipsoids) = source.batch_shapes(batch) {
                shapes.extend(ellipsoids);
            }
        }
        (positions, shapes)
    }

    #[test]
    fn batches_and_blocks_of_any_size_give_the_same_bits() {
        let cloud = cloud(20);
        for choices in choices() {
            let settings = Settings::paper(0.5, &choices).expect("sound");
            let (whole, shape_stats) = shape_particles(cloud.clone(), &settings);
            assert!(
                shape_stats.near_count > 3000 && shape_stats.near_count < cloud.positions.len(),
                "{shape_stats:?}"
            );
            for (size, gathered_max) in [(1 << 20, 1), (700, 3000), (11, 1 << 22)] {
                let source = Batches { cloud: &cloud, size };
                let Ok((streamed, of_streamed)) =
                    in_blocks(source, ShapeStats::default(), &settings, gathered_max);
                assert_eq!(of_streamed, shape_stats);
                assert!(bits(&streamed) == bits(&whole), "batches of {size}, blocks of {gathered_max}");
            }
            let moved = whole.clone().into_moved();
            assert!(bits(&moved) == bits(&whole));
        }
    }

    fn reconstructed<S: ParticleSource>(
        source: &S,
        shape_stats: ShapeStats,
        settings: &Settings,
    ) -> FrameSurface {
        let obstacles = Obstacles::default();
        let surface = reconstruct_shaped(source, shape_stats, obstacles, settings, None, &mut |_| {});
        surface.unwrap_or_else(|_| panic!("in memory")).0
    }

    /// The particles within a ball, so that the surface has normals in all directions.
    fn round(cloud: &ParticleCloud, radius: f64) -> ParticleCloud {
        let OwnedPositions::F64(positions) = &cloud.positions else { panic!("64 bits") };
        let is_in = |at: &&[f64; 3]| DVec3::from(**at).distance(DVec3::splat(radius)) < radius;
        OwnedPositions::F64(positions.iter().filter(is_in).copied().collect()).into()
    }

    /// Leaving particles deep inside unmoved does not change the surface.
    #[test]
    fn leaving_deep_particles_unmoved_keeps_the_surface() {
        let block = cloud(22);
        let ball = round(&cloud(28), 14.0);
        let [balls, neighbors, unmoved] = choices();
        for (choices, cloud) in
            [(balls, &ball), (neighbors.clone(), &block), (neighbors, &ball), (unmoved, &ball)]
        {
            let settings = Settings::paper(0.5, &choices).expect("sound");
            let (near, shape_stats) = shape_particles(cloud.clone(), &settings);
            let deep_count = cloud.positions.len() - shape_stats.near_count;
            assert!(deep_count > 1000, "{deep_count}");
            let config = neighbor_config(&settings);
            let found = from_neighbors(&cloud.positions, |_| true, None, &config);
            let step = settings.position_smoothing * settings.neighbor_radius;
            let OwnedPositions::F64(mut positions) = cloud.positions.clone() else { panic!("64 bits") };
            let mut shapes = vec![Ellipsoid::ball(1.0); positions.len()];
            for (particle, &index) in found.indices.iter().enumerate() {
                let mean = rounded(found.means[particle]).as_dvec3();
                move_double(&mut positions[index as usize], mean * step);
                if let Some(&shape) = found.shapes.get(particle) {
                    shapes[index as usize] = shape;
                }
            }
            let shapes = if config.stretch.is_some() { Shapes::Ellipsoids(shapes) } else { Shapes::Uniform };
            let all =
                ParticleCloud { positions: OwnedPositions::F64(positions), shapes, attributes: Vec::new() };
            let [near, all] =
                [reconstructed(&near, shape_stats, &settings), reconstructed(&all, shape_stats, &settings)];
            assert!(near.mesh == all.mesh && near.band.phi == all.band.phi, "{choices:?}");
            assert!(near.report.certificate.holds(), "{:?}", near.report.certificate);
        }
    }

    /// A sheet with a ridge: particles on the ridge are drawn inward, those in the sheet are not.
    #[test]
    fn original_positions_outside_the_surface_are_counted() {
        let settings = Settings::paper(0.25, &choices()[1]).expect("sound");
        let surface = |choices: &MethodOptions| {
            let settings = Settings::paper(0.25, choices).expect("sound");
            let (source, shape_stats) = shape_particles(cloud(8), &settings);
            reconstructed(&source, shape_stats, &settings)
        };
        let of = |choices: &MethodOptions| MethodOptions {
            preset: Some(Preset::Fluid),
            spacing: Some(1.0),
            ..choices.clone()
        };
        let smoothed = surface(&of(&choices()[1])).report.certificate;
        let outside = smoothed.input_positions_outside.expect("moved");
        assert!(outside.count > 0 && outside.deepest > 0.0, "{outside:?}");
        assert!(outside.deepest < settings.neighbor_radius, "{outside:?}");
        assert!(smoothed.holds());
        let given =
            surface(&MethodOptions { position_smoothing: Some(0.0), ..of(&choices()[2]) }).report.certificate;
        assert_eq!(given.input_positions_outside, None);
    }

    #[test]
    fn moved_positions_keep_their_precision() {
        let double =
            ParticleCloud::from(OwnedPositions::F64(vec![[0.0; 3], [1.0, 0.5, 0.0], [0.3, 0.7, 0.1]]));
        let single =
            ParticleCloud::from(OwnedPositions::F32(vec![[0.0; 3], [1.0, 0.5, 0.0], [0.3, 0.7, 0.1]]));
        let moved = |cloud: &ParticleCloud, part: f64| {
            let choices = MethodOptions { position_smoothing: Some(part), ..choices()[0].clone() };
            let settings = Settings::paper(0.5, &choices).expect("sound");
            shape_particles(cloud.clone(), &settings).0.into_moved().positions
        };
        let (half, whole) = (moved(&single, 0.5), moved(&single, 1.0));
        assert!(
            matches!(half, OwnedPositions::F32(_)) && matches!(moved(&double, 0.5), OwnedPositions::F64(_))
        );
        for index in 0..3 {
            let between = (single.positions.position(index) + whole.position(index)) * 0.5;
            assert!(half.position(index).distance(between) < 1e-5);
            assert!(half.position(index).distance(single.positions.position(index)) > 1e-2);
        }
        assert_eq!(moved(&single, 0.0), single.positions);
    }
}
