//! A frame between the stages: in memory, or in tiles if it is larger than memory.
//!
//! ```text
//!   particles ──rasterize──▶ φ, bounds ──smooth──▶ φ, bounds ──contour──▶ surface
//!   level set ──bound──────▶
//! ```
//!
//! A frame in tiles keeps its fields and the particles near its surface in files. The surface is
//! bit-identical to that in memory; `tiles.rs` explains why.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::convert::Infallible;
use std::io;
use std::sync::Arc;

use glam::{DVec3, IVec3, Vec3};

use super::band::BoundedBand;
use super::postprocess::{self, SurfaceExclusions};
use super::tiles::{self, FieldStore, HALO_LEAVES, Tiling, tile_voxels, tiles_around};
use super::{
    FrameSurface, SurfaceAttributes, inside_obstacles, lattice, raster_params, reach_of_particles,
    smooth_config,
};
use crate::grid::LEAF_EDGE;
use crate::level_set::{Bounds, NarrowBand};
use crate::mesh::{Mesh, PositionRounding};
use crate::motion::MovingParticles;
use crate::obstacle::{ContactStats, Obstacles};
use crate::options::Settings;
use crate::particles::{AnySource, ParticleSource, Unread, erased};
use crate::rasterize::{self, Occupancy, ParticleBins, RasterFields, RasterParams, StoredBins};
use crate::report::{ReconstructionReport, ShapeStats, SmoothReport};
use crate::smooth;
use crate::space::CoordBox;
use crate::storage::Storage;
use crate::temporal::{self, OtherFrame, TemporalConfig, TimedFrame};
use crate::validation::{
    CheckedRegion, Checks, ExclusionMask, MeshCells, MovedParticle, ParticlesOutside, check,
    count_inputs_outside, count_inputs_outside_of_source, possibly_outside,
};

/// A frame between two stages.
pub struct StagedFrame<S> {
    fields: StagedFields<S>,
    obstacles: Obstacles,
    report: ReconstructionReport,
}

enum StagedFields<S> {
    /// With the particles, if their attributes are needed later.
    InMemory(Box<WholeFields>, Option<S>),
    Tiled(Box<TiledFields>, S),
    LevelSet(Box<BoundedBand>),
}

struct WholeFields {
    bins: ParticleBins,
    band: NarrowBand,
    bounds: Bounds,
    /// The particles that position smoothing moved and whose input positions may be outside the surface,
    /// batch by batch; `None` if it moved no particle.
    possibly_outside: Option<Vec<Vec<MovedParticle>>>,
}

struct TiledFields {
    particles: TileParticles,
    store: FieldStore,
    tiling: Tiling,
    half_width: f32,
}

/// Where a frame in tiles keeps its fields and particles.
pub struct TileStorage {
    tile_leaves: i32,
    store: FieldStore,
    particles: Box<dyn Storage>,
}

impl TileStorage {
    /// Storage for tiles that are cubes of this many leaves along each edge. `make` makes one file, and is
    /// called nine times.
    ///
    /// # Errors
    /// Those of `make`.
    pub fn new(
        tile_leaves: i32,
        mut make: impl FnMut() -> io::Result<Box<dyn Storage>>,
    ) -> io::Result<TileStorage> {
        Ok(TileStorage { tile_leaves, particles: make()?, store: FieldStore::new(make)? })
    }
}

/// Why a stage failed. A stage of a frame in memory whose particles are in memory cannot fail.
#[derive(Debug)]
pub enum StageError<E> {
    /// Particles could not be read.
    Source(E),
    /// Storage could not be read or written.
    Storage(io::Error),
}

impl<E> From<io::Error> for StageError<E> {
    fn from(error: io::Error) -> StageError<E> {
        StageError::Storage(error)
    }
}

impl From<Unread> for StageError<Unread> {
    fn from(unread: Unread) -> StageError<Unread> {
        StageError::Source(unread)
    }
}

impl<S: ParticleSource> StagedFrame<S> {
    /// First stage: particles to level sets, in memory or in tiles. `shape_stats` reports how the particles
    /// got their shapes.
    ///
    /// # Errors
    /// An error of the source or of the storage.
    pub fn rasterize(
        source: S,
        shape_stats: ShapeStats,
        obstacles: Obstacles,
        settings: &Settings,
        tiles: Option<TileStorage>,
    ) -> Result<StagedFrame<S>, StageError<S::Error>> {
        let scene = raster_params(settings, &obstacles);
        let (fields, mut report) = if let Some(tiles) = tiles {
            let (fields, report) = with_any(&source, |source| TiledFields::rasterize(source, &scene, tiles))?;
            (StagedFields::Tiled(Box::new(fields), source), report)
        } else {
            let rasterized = with_any(&source, |source| Ok(WholeFields::rasterize(source, &scene)?));
            let (fields, report) = rasterized?;
            (StagedFields::InMemory(Box::new(fields), settings.has_attributes().then_some(source)), report)
        };
        report.shapes = shape_stats;
        Ok(StagedFrame { fields, obstacles, report })
    }

    /// First stage for a level set, whose values are in units of the settings' voxel size. With a maximum
    /// deviation above 0, the surface is the smoothest one that stays within that distance, in voxels, of the
    /// given one; the settings' offset is applied afterwards. Settings for particles have no effect. Voxel
    /// (0, 0, 0) is at `translation`, in world units.
    pub fn of_level_set(
        band: NarrowBand,
        translation: DVec3,
        max_deviation_voxels: f32,
        settings: &Settings,
    ) -> StagedFrame<S> {
        let given = BoundedBand::new(band, translation, max_deviation_voxels, settings);
        let leaf_count = given.band.topology.len();
        StagedFrame {
            fields: StagedFields::LevelSet(Box::new(given)),
            obstacles: Obstacles::default(),
            report: ReconstructionReport { leaf_count, ..ReconstructionReport::default() },
        }
    }

    /// The report so far.
    pub fn report(&self) -> &ReconstructionReport {
        &self.report
    }

    /// Second stage: constrained smoothing. `advanced` receives the progress, from 0 to 1.
    ///
    /// # Errors
    /// An error of the storage.
    pub fn smooth(
        mut self,
        settings: &Settings,
        advanced: &mut dyn FnMut(f64),
    ) -> io::Result<StagedFrame<S>> {
        let config = smooth_config(settings, &self.obstacles);
        let reach_before = reach_of_particles(settings, &self.report.shapes);
        let (smoothed, reach_before) = match &mut self.fields {
            StagedFields::InMemory(fields, _) => {
                (smooth::smooth(&mut fields.band, &fields.bounds, &config, advanced), reach_before)
            }
            StagedFields::Tiled(fields, _) => {
                let TiledFields { store, tiling, half_width, .. } = &mut **fields;
                (tiles::smooth(store, tiling, *half_width, &config, advanced)?, reach_before)
            }
            StagedFields::LevelSet(given) => {
                let Some(bounds) = &given.bounds else { return Ok(self) };
                (smooth::smooth(&mut given.band, bounds, &config, advanced), 0)
            }
        };
        let reach_voxels = smoothed.reach_voxels.map(|reach| reach.saturating_add(reach_before));
        self.report.smoothing = SmoothReport { reach_voxels, ..smoothed };
        Ok(self)
    }

    /// The level set; `None` if it is in tiles, or was not made from particles.
    pub fn band(&self) -> Option<&NarrowBand> {
        match &self.fields {
            StagedFields::InMemory(fields, _) => Some(&fields.band),
            StagedFields::Tiled(..) | StagedFields::LevelSet(_) => None,
        }
    }

    /// After the second stage: what other frames need of this one to be averaged with it. `moving` are its
    /// particles as given. `None` if it has no [band](Self::band).
    pub fn timed(&self, moving: MovingParticles, settings: &Settings) -> Option<Arc<TimedFrame>> {
        let band = Arc::new(self.band()?.clone());
        Some(Arc::new(TimedFrame::new(band, moving, settings.spacing)))
    }

    /// After the second stage: averages the level set with those of other frames of the sequence. `own` is
    /// this frame as these others see it. Has no effect on a frame in tiles or a level set. If nothing
    /// changes, the level set is that of the frame alone.
    pub fn average(&mut self, own: &TimedFrame, others: &[OtherFrame], settings: &Settings) {
        let StagedFields::InMemory(fields, _) = &mut self.fields else { return };
        let config = TemporalConfig {
            frames: settings.temporal,
            seconds: settings.frame_time(),
            spacing: settings.spacing,
            lattice: lattice(settings),
        };
        let report = temporal::average(&mut fields.band, own, others, &config);
        let smoothing = smooth_config(settings, &self.obstacles);
        if report.change > 0.0 {
            smooth::restore(&mut fields.band, &fields.bounds, &smoothing);
        }
        if report.frame_count > 0 {
            let reach_voxels = &mut self.report.smoothing.reach_voxels;
            let reaches = reach_voxels.zip(smooth::restore_reach(&smoothing));
            *reach_voxels = reaches.map(|(smoothed, restored)| {
                config.reach_voxels(smoothed, fields.band.half_width).saturating_add(restored)
            });
        }
        self.report.temporal = report;
    }

    /// Third stage: the mesh with rounded positions, its measures, and the certificate. Also returns the
    /// particles if the settings select attributes, or the frame is in tiles.
    ///
    /// # Errors
    /// An error of the source or of the storage.
    pub fn contour(
        self,
        settings: &Settings,
        rounding: PositionRounding,
    ) -> Result<(FrameSurface, Option<S>), StageError<S::Error>> {
        let StagedFrame { fields, obstacles, mut report } = self;
        let scene = &raster_params(settings, &obstacles);
        match fields {
            StagedFields::InMemory(fields, source) => {
                let WholeFields { bins, band, bounds, possibly_outside } = *fields;
                report.certificate.bound_violation_count = bounds.violation_count(&band.phi);
                drop(bounds);
                let particles = WholeParticles { bins, possibly_outside };
                let Ok(surface) = contour_within(band, &particles, scene, settings, rounding, report);
                Ok((surface, source))
            }
            StagedFields::Tiled(fields, source) => {
                let surface = with_any(&source, |source| {
                    report.certificate.bound_violation_count = fields.bound_violation_count()?;
                    let TiledFields { particles, store, tiling, half_width } = *fields;
                    let phi = store.read(0, &tiling.all_slots())?;
                    drop(store);
                    let band = NarrowBand { topology: Arc::new(tiling.topology), phi, half_width };
                    contour_within(
                        band,
                        &StoredParticles { particles, source },
                        scene,
                        settings,
                        rounding,
                        report,
                    )
                })?;
                Ok((surface, Some(source)))
            }
            StagedFields::LevelSet(given) => Ok((given.contour(settings, rounding, report), None)),
        }
    }
}

/// Calls `work` with the source, without its type.
fn with_any<S: ParticleSource, T>(
    source: &S,
    work: impl FnOnce(&AnySource<'_>) -> Result<T, StageError<Unread>>,
) -> Result<T, StageError<S::Error>> {
    let worked = erased(source, |source| match work(source) {
        Ok(done) => Ok(Ok(done)),
        Err(StageError::Storage(error)) => Ok(Err(StageError::Storage(error))),
        Err(StageError::Source(unread)) => Err(unread),
    });
    worked.map_err(StageError::Source)?
}

impl WholeFields {
    fn rasterize(
        source: &AnySource<'_>,
        scene: &RasterParams,
    ) -> Result<(WholeFields, ReconstructionReport), Unread> {
        let RasterFields { bins, band, bounds, contact } = rasterize::rasterize_any(source, scene)?;
        let contact = ContactStats { particle_count: inside_obstacles(source, scene)?, ..contact };
        let possibly_outside = if source.is_smoothed() {
            Some(possibly_outside(source, scene, &band.topology, &bounds)?)
        } else {
            None
        };
        let report = ReconstructionReport {
            particle_count: bins.particle_count,
            dropped_count: bins.dropped_count,
            outlier_position: bins.outlier_position,
            leaf_count: band.topology.len(),
            contact,
            ..ReconstructionReport::default()
        };
        Ok((WholeFields { bins, band, bounds, possibly_outside }, report))
    }
}

impl TiledFields {
    fn rasterize(
        source: &AnySource<'_>,
        scene: &RasterParams,
        TileStorage { tile_leaves, store, particles: storage }: TileStorage,
    ) -> Result<(TiledFields, ReconstructionReport), StageError<Unread>> {
        let occupancy = Occupancy::new(source, &scene.lattice)?;
        let half_width = scene.radii.half_width();
        let surface_reach = scene.radii.start_reach() * occupancy.longest() + half_width;
        let tiles = tiles_near(&occupancy, tile_leaves, surface_reach.ceil() as i32 + 1);
        let mut origins: Vec<IVec3> = Vec::new();
        let mut contact = ContactStats::default();
        let mut particles = TileParticles { storage, tiles: Vec::new() };
        for tile in tiles {
            let window = tile_voxels(IVec3::from(tile), tile_leaves);
            let rasterized = rasterize::rasterize_window(source, &occupancy, scene, window)?;
            contact = contact.merge(rasterized.contact);
            let [lower, upper] = rasterized.bounds.to_fields();
            store.put(origins.len(), [&rasterized.band.phi, &lower, &upper])?;
            origins.extend_from_slice(rasterized.band.topology.origins());
            particles.push(window, &rasterized.bins)?;
        }
        contact.particle_count = inside_obstacles(source, scene)?;
        let report = ReconstructionReport {
            particle_count: occupancy.particle_count(),
            dropped_count: occupancy.dropped_count(),
            outlier_position: occupancy.outlier_position(),
            leaf_count: origins.len(),
            contact,
            ..ReconstructionReport::default()
        };
        let tiling = Tiling::new(&origins, tile_leaves, HALO_LEAVES);
        Ok((TiledFields { particles, store, tiling, half_width }, report))
    }

    /// Number of values outside their bounds.
    fn bound_violation_count(&self) -> io::Result<usize> {
        let mut count = 0;
        for run in self.tiling.all_slots() {
            // Long runs are read in parts of a few MiB.
            for first in run.clone().step_by(RUN_LEAVES) {
                let part = first..run.end.min(first + RUN_LEAVES);
                let slots = std::slice::from_ref(&part);
                let [lower, upper] = self.store.read_bounds(slots)?;
                count += Bounds::new(lower, upper).violation_count(&self.store.read(0, slots)?);
            }
        }
        Ok(count)
    }
}

/// Number of leaves that are compared with their bounds at a time.
const RUN_LEAVES: usize = 4096;

/// The tiles that contain leaves within `voxels` of a leaf with particles.
fn tiles_near(occupancy: &Occupancy, tile_leaves: i32, voxels: i32) -> BTreeSet<[i32; 3]> {
    // A particle is up to one voxel from its recorded position, and the surface is up to one voxel from the
    // voxels that are next to it.
    let margin_leaves = (voxels + 2) / LEAF_EDGE + 1;
    let origins = occupancy.topology.origins().iter();
    let tiles = origins.flat_map(|&origin| tiles_around(origin, margin_leaves, tile_leaves));
    tiles.map(|tile| tile.to_array()).collect()
}

/// The origin of a leaf and its particles, in voxels relative to that origin.
type ParticleLeaf<'a> = (IVec3, Cow<'a, [Vec3]>);

/// The particles near the surface, as contouring reads them.
trait NearParticles {
    type Error;

    /// Calls `work` with each part of the frame: its voxels, and the particles in and around them.
    fn for_each_part(&self, work: &mut dyn FnMut(CoordBox, &ParticleBins)) -> Result<(), Self::Error>;

    /// The particles of all leaves.
    fn leaves(&self) -> Result<Vec<ParticleLeaf<'_>>, Self::Error>;

    /// The moved particles whose input position is outside the surface; `None` if none was moved.
    fn inputs_outside(
        &self,
        band: &NarrowBand,
        scene: &RasterParams,
        exempt: &dyn ExclusionMask,
    ) -> Result<Option<ParticlesOutside>, Self::Error>;
}

/// Those of a frame in memory.
struct WholeParticles {
    bins: ParticleBins,
    possibly_outside: Option<Vec<Vec<MovedParticle>>>,
}

impl NearParticles for WholeParticles {
    type Error = Infallible;

    fn for_each_part(&self, work: &mut dyn FnMut(CoordBox, &ParticleBins)) -> Result<(), Infallible> {
        work(CoordBox::ALL, &self.bins);
        Ok(())
    }

    fn leaves(&self) -> Result<Vec<ParticleLeaf<'_>>, Infallible> {
        Ok(self.bins.leaves().map(|(origin, locals)| (origin, Cow::Borrowed(locals))).collect())
    }

    fn inputs_outside(
        &self,
        band: &NarrowBand,
        scene: &RasterParams,
        exempt: &dyn ExclusionMask,
    ) -> Result<Option<ParticlesOutside>, Infallible> {
        let batches = self.possibly_outside.as_ref();
        Ok(batches.map(|batches| count_inputs_outside(batches, band, scene, exempt)))
    }
}

/// The particles near the surface of a frame in tiles.
struct TileParticles {
    storage: Box<dyn Storage>,
    /// The voxels of each tile, and the particles in and around it.
    tiles: Vec<(CoordBox, StoredBins)>,
}

impl TileParticles {
    fn push(&mut self, tile: CoordBox, bins: &ParticleBins) -> io::Result<()> {
        let start = self.tiles.last().map_or(0, |(_, last)| last.end);
        self.tiles.push((tile, StoredBins::write(bins, &*self.storage, start)?));
        Ok(())
    }
}

/// The stored particles of a frame in tiles, and the source of all its particles.
struct StoredParticles<'a> {
    particles: TileParticles,
    source: &'a AnySource<'a>,
}

impl NearParticles for StoredParticles<'_> {
    type Error = StageError<Unread>;

    fn for_each_part(&self, work: &mut dyn FnMut(CoordBox, &ParticleBins)) -> Result<(), Self::Error> {
        let TileParticles { storage, tiles } = &self.particles;
        for (tile, stored) in tiles {
            work(*tile, &stored.read(&**storage)?);
        }
        Ok(())
    }

    fn leaves(&self) -> Result<Vec<ParticleLeaf<'_>>, Self::Error> {
        let mut leaves = Vec::new();
        self.for_each_part(&mut |owned, bins| {
            let own = bins.leaves().filter(|(origin, _)| owned.contains(*origin));
            leaves.extend(own.map(|(origin, locals)| (origin, Cow::Owned(locals.to_vec()))));
        })?;
        Ok(leaves)
    }

    fn inputs_outside(
        &self,
        band: &NarrowBand,
        scene: &RasterParams,
        exempt: &dyn ExclusionMask,
    ) -> Result<Option<ParticlesOutside>, Self::Error> {
        if !self.source.is_smoothed() {
            return Ok(None);
        }
        Ok(Some(count_inputs_outside_of_source(self.source, band, scene, exempt)?))
    }
}

/// The surface of a smoothed band.
fn contour_within<P: NearParticles>(
    mut band: NarrowBand,
    particles: &P,
    scene: &RasterParams,
    settings: &Settings,
    rounding: PositionRounding,
    mut report: ReconstructionReport,
) -> Result<FrameSurface, P::Error> {
    postprocess::offset_and_cut(&mut band, scene);
    let leaves = if settings.drop_islands > 0 { particles.leaves()? } else { Vec::new() };
    let edits = postprocess::edit(&mut band, leaves, scene, settings, &mut report.edits);
    let mut mesh = postprocess::mesh(&band, &edits, scene, settings, &mut report.depth);
    let exempt = &SurfaceExclusions { scene, edits: &edits };
    let validate = |mesh: &Mesh, rounding_voxels: f32| {
        let cells = MeshCells::new(mesh, &band, &scene.lattice);
        let mut parts = Vec::new();
        particles.for_each_part(&mut |owned, bins| {
            parts.push(check(&CheckedRegion {
                bins,
                radii: scene.radii,
                band: &band,
                mesh,
                cells: &cells,
                rounding_voxels,
                lattice: &scene.lattice,
                owned,
                exempt,
            }));
        })?;
        Ok(parts.into_iter().fold(Checks::EMPTY, Checks::merge))
    };
    postprocess::finalize(&mut mesh, settings, Some(&scene.radii), rounding, &mut report, validate)?;
    report.certificate.input_positions_outside = particles.inputs_outside(&band, scene, exempt)?;
    Ok(FrameSurface { band, mesh, attributes: SurfaceAttributes::default(), spray: None, report })
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::obstacle::{MeshSdf, Obstacle, ObstacleSdf};
    use crate::options::{AnisotropyKind, ClipBox, Integrator, MethodOptions};
    use crate::particles::{Attribute, AttributeValues, OwnedPositions, ParticleCloud, Role};
    use crate::reconstruction::{reconstruct_frame, reconstruct_shaped, shape_particles};
    use crate::storage::tests::InMemory;

    /// A long bar of two sheets that repeatedly join and separate, much longer than the width of a halo, and
    /// a few isolated particles.
    fn particles() -> OwnedPositions {
        let OwnedPositions::F64(mut positions) = bar(190) else { unreachable!("positions of 64 bits") };
        positions.extend([[31.0, -8.0, 8.0], [-20.0, 15.0, -9.0], [120.5, 10.5, 10.5]]);
        OwnedPositions::F64(positions)
    }

    /// The bar alone, of this length.
    fn bar(length: i32) -> OwnedPositions {
        let mut positions = Vec::new();
        for index in 0..length * 5 * 4 {
            let (x, y, z) = (f64::from(index / 20), f64::from(index / 4 % 5), f64::from(index % 4));
            let jitter = |seed: f64| 0.3 * (f64::from(index) * seed).sin();
            let gap = if z > 1.5 { 1.5 + 1.5 * (0.2 * x).sin() } else { 0.0 };
            let lift = 2.0 * (0.05 * x).sin() + gap;
            positions.push([x + jitter(12.9), y + jitter(78.2), z + lift + jitter(37.7)].map(|p| p - 13.0));
        }
        OwnedPositions::F64(positions)
    }

    fn storage() -> TileStorage {
        TileStorage::new(4, || Ok(Box::<InMemory>::default())).expect("in memory")
    }

    fn rasterized(settings: &Settings) -> StagedFrame<OwnedPositions> {
        let (stats, obstacles) = (ShapeStats::default(), Obstacles::default());
        let frame = StagedFrame::rasterize(particles(), stats, obstacles, settings, Some(storage()));
        frame.expect("in memory")
    }

    fn finished(frame: StagedFrame<OwnedPositions>, settings: &Settings) -> FrameSurface {
        let smoothed = frame.smooth(settings, &mut |_| {}).expect("in memory");
        smoothed.contour(settings, PositionRounding::Local).expect("in memory").0
    }

    /// A few tiles only, fast enough for every test run.
    #[test]
    fn tiled_result_of_a_short_frame_equals_in_memory_result() {
        let settings = Settings::paper(0.5, &Default::default()).expect("sound");
        same_in_tiles(ParticleCloud::from(bar(36)), &settings, &Obstacles::default());
    }

    #[test]
    #[ignore = "slow: `.ci/full slow` runs it"]
    fn tiled_result_equals_in_memory_result() {
        let choices = [
            MethodOptions::default(),
            MethodOptions { laplacian_steps: Some(0), radius_ratio: Some(1.5), ..MethodOptions::default() },
            MethodOptions { redistance_every: Some(2), ..MethodOptions::default() },
            MethodOptions {
                integrator: Some(Integrator::Explicit),
                steps: Some(60),
                ..MethodOptions::default()
            },
            MethodOptions { offset: Some((-0.7).into()), ..MethodOptions::default() },
            MethodOptions { offset: Some(0.9.into()), steps: Some(2), ..MethodOptions::default() },
        ];
        for choices in choices {
            let settings = Settings::paper(0.5, &choices).expect("sound");
            let whole = reconstruct_frame(&particles(), &settings);
            let tiled = finished(rasterized(&settings), &settings);
            assert_eq!(tiled.band.topology.origins(), whole.band.topology.origins());
            assert!(tiled.band.phi == whole.band.phi, "{choices:?}");
            assert!(tiled.mesh == whole.mesh);
            assert_eq!(tiled.report, whole.report);
            assert!(whole.report.certificate.holds());
        }
    }

    /// Per-particle radii, an obstacle among the particles, a dropped island, and a clip box.
    #[test]
    #[ignore = "slow: `.ci/full slow` runs it"]
    fn radii_obstacles_islands_and_clip_box_are_equal_in_tiles() {
        let numbers = |arity: usize| {
            AttributeValues::Numbers(
                (0..particles().len() * arity).map(|index| 0.9 + 0.7 * (index as f32 * 0.7).sin()).collect(),
            )
        };
        let attribute = |name: &str, role: Role, arity: usize| Attribute {
            name: name.to_owned(),
            role,
            arity,
            values: numbers(arity),
        };
        let attributes = vec![attribute("pscale", Role::Radius, 1), attribute("v", Role::Velocity, 3)];
        let ball = ObstacleSdf::Mesh(octahedron(DVec3::new(20.0, -10.0, -9.0), 4.0));
        let obstacles = Obstacles { members: vec![Arc::new(Obstacle::new(ball, 1 << 24))] };
        let plain = MethodOptions {
            drop_islands: Some(3),
            fill_cavities: Some(500.0),
            clip: Some(ClipBox { min: [-8.0, -100.0, -11.0], max: [170.0, 100.0, 100.0] }),
            ..MethodOptions::default()
        };
        let all = [
            MethodOptions { radius_attribute: Some("pscale".into()), ..plain.clone() },
            MethodOptions { offset: Some((-0.6).into()), ..plain.clone() },
            MethodOptions {
                anisotropy: Some(AnisotropyKind::Neighbors),
                position_smoothing: Some(0.9),
                ..plain.clone()
            },
            MethodOptions {
                anisotropy: Some(AnisotropyKind::Neighbors),
                offset: Some(0.8.into()),
                ..plain.clone()
            },
            MethodOptions { position_smoothing: Some(0.9), ..plain.clone() },
            MethodOptions {
                radius_attribute: Some("pscale".into()),
                position_smoothing: Some(0.5),
                ..plain.clone()
            },
            MethodOptions { anisotropy: Some(AnisotropyKind::Velocity), decimate: Some(0.1), ..plain },
        ];
        for choices in all {
            let settings = Settings::paper(0.5, &choices).expect("sound");
            let cloud = ParticleCloud { attributes: attributes.clone(), ..ParticleCloud::from(particles()) };
            let report = same_in_tiles(cloud, &settings, &obstacles);
            let ReconstructionReport { certificate, edits, contact, .. } = &report;
            assert!(certificate.holds(), "{certificate:?}");
            assert!(
                edits.island_count > 0 && edits.clipped_voxel_count > 0 && contact.void_count > 0,
                "{edits:?}"
            );
        }
    }

    /// Where the moved surface ends at the obstacle, some voxels lie exactly on the obstacle's surface, and
    /// all neighbors of these voxels are outside.
    #[test]
    #[ignore = "slow: `.ci/full slow` runs it"]
    fn outward_offset_next_to_an_obstacle_is_closed() {
        let ball = ObstacleSdf::Mesh(octahedron(DVec3::new(20.0, -10.0, -9.0), 4.0));
        let obstacles = Obstacles { members: vec![Arc::new(Obstacle::new(ball, 1 << 24))] };
        for offset in [0.4, 0.8] {
            let choices = MethodOptions {
                position_smoothing: Some(0.9),
                offset: Some(offset.into()),
                ..MethodOptions::default()
            };
            let settings = Settings::paper(0.5, &choices).expect("sound");
            let report = same_in_tiles(ParticleCloud::from(particles()), &settings, &obstacles);
            assert!(report.certificate.holds(), "{:?}", report.certificate);
        }
    }

    /// Obstacles with faces and corners on voxels, where distances to them are exactly zero.
    #[test]
    #[ignore = "slow: `.ci/full slow` runs it"]
    fn offset_next_to_obstacles_is_closed_and_equal_in_tiles() {
        let solids = [
            octahedron(DVec3::new(20.0, -10.0, -9.0), 4.0),
            cuboid(DVec3::new(14.0, -14.0, -12.0), DVec3::new(18.0, -9.0, -8.0)),
            cuboid(DVec3::new(-30.0, -30.0, -16.0), DVec3::new(60.0, 30.0, -12.0)),
        ];
        for solid in solids {
            let obstacles =
                Obstacles { members: vec![Arc::new(Obstacle::new(ObstacleSdf::Mesh(solid), 1 << 24))] };
            for (offset, position_smoothing) in [(-0.8, 0.9), (0.25, 0.5), (0.4, 0.4), (0.8, 0.0), (1.0, 0.9)]
            {
                let choices = MethodOptions {
                    position_smoothing: Some(position_smoothing),
                    offset: Some(offset.into()),
                    ..MethodOptions::default()
                };
                let settings = Settings::paper(0.5, &choices).expect("sound");
                let report = same_in_tiles(ParticleCloud::from(bar(36)), &settings, &obstacles);
                assert!(report.certificate.holds(), "{choices:?}: {:?}", report.certificate);
            }
        }
    }

    /// Drops stretched to needles: at some of their tips the interpolation error within a cell is more than
    /// half a voxel.
    #[test]
    #[ignore = "slow: `.ci/full slow` runs it"]
    fn clamped_vertices_are_equal_in_tiles() {
        let random = |index: usize| {
            let mixed = (index as u32 + 1).wrapping_mul(0x9e37_79b9);
            let mixed = (mixed ^ mixed >> 15).wrapping_mul(0x2c1b_3c6d);
            f64::from((mixed ^ mixed >> 12) >> 8) / f64::from(1 << 24)
        };
        let slots = (0..300).map(|index| [0, 1, 2].map(|axis| random(6 * index + axis)));
        let velocities = (0..900).map(|index| 8.0 * (random(2000 + index) as f32 - 0.5));
        let velocity = Attribute {
            name: "v".into(),
            role: Role::Velocity,
            arity: 3,
            values: AttributeValues::Numbers(velocities.collect()),
        };
        let choices = MethodOptions {
            anisotropy: Some(AnisotropyKind::Velocity),
            velocity_gain: Some(0.05),
            max_stretch: Some(8.0),
            radius_min: Some(0.05.into()),
            ..MethodOptions::default()
        };
        let settings = Settings::paper(0.02, &choices).expect("sound");
        let cloud = ParticleCloud {
            attributes: vec![velocity],
            ..ParticleCloud::from(OwnedPositions::F64(slots.collect()))
        };
        let report = same_in_tiles(cloud, &settings, &Obstacles::default());
        assert!(report.vertices_clamped > 0, "the scene must clamp some vertices");
        assert!(report.certificate.holds(), "{:?}", report.certificate);
    }

    /// Reconstructs particles in one piece and in tiles, and compares the results.
    fn same_in_tiles(
        cloud: ParticleCloud,
        settings: &Settings,
        obstacles: &Obstacles,
    ) -> ReconstructionReport {
        let (shaped, shape_stats) = shape_particles(cloud, settings);
        let surface = |tiles| {
            let entered = &mut |_| {};
            reconstruct_shaped(&shaped, shape_stats, obstacles.clone(), settings, tiles, entered)
                .expect("in memory")
                .0
        };
        let (whole, tiled) = (surface(None), surface(Some(storage())));
        assert_eq!(tiled.band.topology.origins(), whole.band.topology.origins());
        assert!(tiled.band.phi == whole.band.phi, "{settings:?}");
        assert!(tiled.mesh == whole.mesh);
        assert_eq!(tiled.report, whole.report);
        whole.report
    }

    fn octahedron(center: DVec3, radius: f64) -> MeshSdf {
        let corners = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y, DVec3::Z, -DVec3::Z];
        let positions = corners.map(|corner| (center + radius * corner).to_array());
        let faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];
        MeshSdf::new(&positions, &faces)
    }

    fn cuboid(least: DVec3, greatest: DVec3) -> MeshSdf {
        let corner = |slot: usize| {
            [0, 1, 2].map(|axis| if slot >> (2 - axis) & 1 == 1 { greatest[axis] } else { least[axis] })
        };
        let positions: Vec<[f64; 3]> = (0..8).map(corner).collect();
        let sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
        let faces: Vec<[u32; 3]> = sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        MeshSdf::new(&positions, &faces)
    }

    /// Shows that the comparison of tiled and whole frames can fail: a tile with too narrow a halo gives a
    /// wrong result.
    #[test]
    #[ignore = "slow: `.ci/full slow` runs it"]
    fn too_narrow_halo_changes_the_result() {
        let settings = Settings::paper(0.5, &MethodOptions::default()).expect("sound");
        let mut frame = rasterized(&settings);
        let StagedFields::Tiled(fields, _) = &mut frame.fields else { panic!("not in tiles") };
        assert!(fields.tiling.tile_count() > 12, "{}", fields.tiling.tile_count());
        fields.tiling = fields.tiling.with_halo(4, 1);
        assert!(finished(frame, &settings).band.phi != reconstruct_frame(&particles(), &settings).band.phi);
    }
}
