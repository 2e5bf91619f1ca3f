//! The three stages for a frame larger than memory.
//!
//! The result is bit-identical to that in memory; `tiles.rs` explains why.

use std::collections::BTreeSet;
use std::io;
use std::sync::Arc;

use glam::IVec3;

use super::postprocess::{self, Edits, SurfaceExclusions};
use super::tiles::{self, FieldStore, HALO_LEAVES, Storage, Tiling, tile_voxels, tiles_around};
use super::{
    FrameSurface, SurfaceAttributes, inside_obstacles, raster_params, report_smoothing, smooth_config,
};
use crate::contour;
use crate::grid::LEAF_EDGE;
use crate::level_set::{Bounds, NarrowBand};
use crate::mesh::{Mesh, PositionRounding};
use crate::obstacle::{ContactStats, Obstacles};
use crate::options::Settings;
use crate::particles::{AnySource, ParticleSource, Unread, erased};
use crate::rasterize::{self, Occupancy, RasterParams};
use crate::report::{ReconstructionReport, ShapeStats};
use crate::validation::{CheckedRegion, Checks, MeshCells, check, count_inputs_outside_of_source};

/// Error of a tiled frame.
#[derive(Debug)]
pub enum TiledError<E> {
    /// Particles could not be read.
    Source(E),
    /// Storage could not be read or written.
    Storage(io::Error),
}

impl<E> From<io::Error> for TiledError<E> {
    fn from(error: io::Error) -> TiledError<E> {
        TiledError::Storage(error)
    }
}

/// Calls `work` with the source, without its type.
fn with_any<S: ParticleSource, T>(
    source: &S,
    work: impl FnOnce(&AnySource<'_>) -> Result<T, TiledError<Unread>>,
) -> Result<T, TiledError<S::Error>> {
    let worked = erased(source, |source| match work(source) {
        Ok(done) => Ok(Ok(done)),
        Err(TiledError::Storage(error)) => Ok(Err(TiledError::Storage(error))),
        Err(TiledError::Source(unread)) => Err(unread),
    });
    worked.map_err(TiledError::Source)?
}

/// A frame between two stages.
pub struct TiledFrame<S> {
    source: S,
    fields: TiledFields,
}

/// What the stages computed of a frame.
struct TiledFields {
    obstacles: Obstacles,
    occupancy: Occupancy,
    /// The tiles with particles in or near them.
    tiles: BTreeSet<[i32; 3]>,
    tile_leaves: i32,
    store: FieldStore,
    tiling: Tiling,
    half_width: f32,
    report: ReconstructionReport,
}

impl<S> TiledFrame<S> {
    /// The particle source.
    pub fn source(&self) -> &S {
        &self.source
    }

    /// The report so far. Callers that measure time add it here.
    pub fn report_mut(&mut self) -> &mut ReconstructionReport {
        &mut self.fields.report
    }
}

/// First stage: particles to level sets, which are written to the storages. Requires
/// [`FIELD_STORE_FILES`](super::FIELD_STORE_FILES) storages. Tiles are cubes of `tile_leaves` leaves.
///
/// # Errors
/// Returns an error of the source or of the storage.
pub fn rasterize<S: ParticleSource>(
    source: S,
    settings: &Settings,
    shape_stats: ShapeStats,
    obstacles: Obstacles,
    tile_leaves: i32,
    storages: Vec<Box<dyn Storage>>,
) -> Result<TiledFrame<S>, TiledError<S::Error>> {
    let fields = with_any(&source, |source| {
        rasterize_any(source, settings, shape_stats, obstacles, tile_leaves, storages)
    })?;
    Ok(TiledFrame { source, fields })
}

fn rasterize_any(
    source: &AnySource<'_>,
    settings: &Settings,
    shape_stats: ShapeStats,
    obstacles: Obstacles,
    tile_leaves: i32,
    storages: Vec<Box<dyn Storage>>,
) -> Result<TiledFields, TiledError<Unread>> {
    let scene = raster_params(settings, &obstacles);
    let RasterParams { lattice, radii, .. } = scene;
    let occupancy = Occupancy::new(source, &lattice).map_err(TiledError::Source)?;
    let tiles = tiles_near(
        &occupancy,
        tile_leaves,
        (radii.init * occupancy.longest() + radii.half_width()).ceil() as i32 + 1,
    );
    let store = FieldStore::new(storages);
    let mut origins: Vec<IVec3> = Vec::new();
    let mut contact = ContactStats::default();
    for &tile in &tiles {
        let window = tile_voxels(IVec3::from(tile), tile_leaves);
        let rasterized = rasterize::rasterize_window(source, &occupancy, &scene, window);
        let rasterized = rasterized.map_err(TiledError::Source)?;
        let rasterize::RasterFields { band, bounds, contact: of_tile, .. } = rasterized;
        contact = contact.merge(of_tile);
        store.put(origins.len(), [&band.phi, &bounds.lower, &bounds.upper])?;
        origins.extend_from_slice(band.topology.origins());
    }
    contact.particle_count = inside_obstacles(source, &scene).map_err(TiledError::Source)?;
    let report = ReconstructionReport {
        particle_count: occupancy.particle_count(),
        dropped_count: occupancy.dropped_count(),
        outlier_position: occupancy.outlier_position(),
        leaf_count: origins.len(),
        shapes: shape_stats,
        contact,
        ..ReconstructionReport::default()
    };
    let tiling = Tiling::new(&origins, tile_leaves, HALO_LEAVES);
    let half_width = radii.half_width();
    Ok(TiledFields { obstacles, occupancy, tiles, tile_leaves, store, tiling, half_width, report })
}

/// The tiles that contain leaves within `voxels` of a leaf with particles.
fn tiles_near(occupancy: &Occupancy, tile_leaves: i32, voxels: i32) -> BTreeSet<[i32; 3]> {
    // A particle is up to one voxel from its recorded position, and the surface is up to one voxel from the
    // voxels that are next to it.
    let margin_leaves = (voxels + 2) / LEAF_EDGE + 1;
    let origins = occupancy.topology.origins().iter();
    let tiles = origins.flat_map(|&origin| tiles_around(origin, margin_leaves, tile_leaves));
    tiles.map(|tile| tile.to_array()).collect()
}

/// Second stage: constrained smoothing. `advanced` receives the progress, from 0 to 1.
///
/// # Errors
/// Returns an error of the storage.
pub fn smooth<S>(
    mut frame: TiledFrame<S>,
    settings: &Settings,
    advanced: &mut dyn FnMut(f64),
) -> io::Result<TiledFrame<S>> {
    smooth_fields(&mut frame.fields, settings, advanced)?;
    Ok(frame)
}

fn smooth_fields(
    fields: &mut TiledFields,
    settings: &Settings,
    advanced: &mut dyn FnMut(f64),
) -> io::Result<()> {
    let config = smooth_config(settings, &fields.obstacles);
    let smoothed = tiles::smooth(&mut fields.store, &fields.tiling, fields.half_width, &config, advanced)?;
    report_smoothing(&mut fields.report, smoothed, settings);
    Ok(())
}

/// Third stage: the mesh, its measures and the certificate.
///
/// # Errors
/// Returns an error of the source or of the storage.
pub fn contour<S: ParticleSource>(
    frame: TiledFrame<S>,
    settings: &Settings,
    rounding: PositionRounding,
) -> Result<(FrameSurface, S), TiledError<S::Error>> {
    let TiledFrame { source, fields } = frame;
    let surface = with_any(&source, |source| contour_any(source, fields, settings, rounding))?;
    Ok((surface, source))
}

fn contour_any(
    source: &AnySource<'_>,
    fields: TiledFields,
    settings: &Settings,
    rounding: PositionRounding,
) -> Result<FrameSurface, TiledError<Unread>> {
    let TiledFields { obstacles, occupancy, tiles, tile_leaves, store, tiling, half_width, mut report } =
        fields;
    let scene = raster_params(settings, &obstacles);
    let RasterParams { lattice, radii, .. } = scene;
    report.certificate.bound_violation_count = bound_violations(&store, &tiling)?;
    let phi = store.read(0, &tiling.all_slots())?;
    drop(store);
    let mut band = NarrowBand { topology: Arc::new(tiling.topology), phi, half_width };
    let tile_particles = |tile: [i32; 3]| {
        let owned = tile_voxels(IVec3::from(tile), tile_leaves);
        let bins = rasterize::particles_in_window(source, &occupancy, &scene, owned);
        bins.map(|bins| (owned, bins)).map_err(TiledError::Source)
    };
    postprocess::offset_and_cut(&mut band, &scene);
    let mut edits = Edits::default();
    if postprocess::has_edits(settings) {
        let mut particles = Vec::new();
        for &tile in tiles.iter().filter(|_| settings.drop_islands > 0) {
            let (owned, bins) = tile_particles(tile)?;
            let own = bins.leaves().filter(|(origin, _)| owned.contains(*origin));
            particles.extend(own.map(|(origin, locals)| (origin, locals.to_vec())));
        }
        edits = postprocess::edit(&mut band, particles, &scene, settings, &mut report.edits);
    }
    let mut mesh = postprocess::mesh(&band, &edits, &scene, settings, &mut report.depth);
    report.bending_energy = contour::bending_energy(&band, &lattice, &mesh);
    let exempt = &SurfaceExclusions { scene: &scene, edits: &edits };
    let validate = |mesh: &Mesh, rounding_voxels: f32| {
        let cells = &MeshCells::new(mesh, &band, &lattice);
        let mut checks = Checks::EMPTY;
        for &tile in &tiles {
            let (owned, bins) = tile_particles(tile)?;
            let (bins, band, lattice) = (&bins, &band, &lattice);
            let region =
                CheckedRegion { bins, radii, band, mesh, cells, rounding_voxels, lattice, owned, exempt };
            checks = checks.merge(check(&region));
        }
        Ok::<Checks, TiledError<Unread>>(checks)
    };
    postprocess::finalize(&mut mesh, settings, Some(&radii), rounding, &mut report, validate)?;
    if source.is_smoothed() {
        let outside =
            count_inputs_outside_of_source(source, &band, &scene, exempt).map_err(TiledError::Source)?;
        report.certificate.input_positions_outside = Some(outside);
    }
    Ok(FrameSurface { band, mesh, attributes: SurfaceAttributes::default(), report })
}

/// Number of values outside their bounds.
fn bound_violations(store: &FieldStore, tiling: &Tiling) -> io::Result<usize> {
    let mut count = 0;
    for run in tiling.all_slots() {
        // Long runs are read in parts of a few MiB.
        for first in run.clone().step_by(RUN_LEAVES) {
            let part = first..run.end.min(first + RUN_LEAVES);
            let slots = std::slice::from_ref(&part);
            let [lower, upper] = store.read_bounds(slots)?;
            count += Bounds { lower, upper }.violation_count(&store.read(0, slots)?);
        }
    }
    Ok(count)
}

/// Number of leaves that are compared with their bounds at a time.
const RUN_LEAVES: usize = 4096;

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use glam::DVec3;

    use super::*;
    use crate::obstacle::{MeshSdf, Obstacle, ObstacleSdf};
    use crate::options::{AnisotropyKind, ClipBox, Integrator, MethodOptions};
    use crate::particles::{Attribute, AttributeValues, OwnedPositions, ParticleCloud, Role};
    use crate::reconstruction::{FIELD_STORE_FILES, reconstruct_frame};

    /// A storage in memory.
    #[derive(Default)]
    struct InMemory(Mutex<Vec<u8>>);

    impl Storage for InMemory {
        fn read(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
            let (stored, from) = (self.0.lock().unwrap(), offset as usize);
            let stored_bytes = stored.get(from..from + bytes.len()).ok_or(io::ErrorKind::UnexpectedEof)?;
            bytes.copy_from_slice(stored_bytes);
            Ok(())
        }

        fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
            let (mut stored, from) = (self.0.lock().unwrap(), offset as usize);
            let end = stored.len().max(from + bytes.len());
            stored.resize(end, 0);
            stored[from..from + bytes.len()].copy_from_slice(bytes);
            Ok(())
        }
    }

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

    fn storages() -> Vec<Box<dyn Storage>> {
        (0..FIELD_STORE_FILES).map(|_| Box::<InMemory>::default() as Box<dyn Storage>).collect()
    }

    fn rasterized(settings: &Settings, tile_leaves: i32) -> TiledFrame<OwnedPositions> {
        let storages = storages();
        let frame = rasterize(
            particles(),
            settings,
            ShapeStats::default(),
            Obstacles::default(),
            tile_leaves,
            storages,
        )
        .expect("in memory");
        assert!(frame.fields.tiling.tile_count() > 12, "{}", frame.fields.tiling.tile_count());
        frame
    }

    fn finished(frame: TiledFrame<OwnedPositions>, settings: &Settings) -> FrameSurface {
        let smoothed = smooth(frame, settings, &mut |_| {}).expect("in memory");
        contour(smoothed, settings, PositionRounding::Local).expect("in memory").0
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
            let tiled = finished(rasterized(&settings, 4), &settings);
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
        let (shaped, shape_stats) = super::super::shape_particles(cloud, settings);
        let Ok(whole) = super::super::rasterize(&shaped, settings, shape_stats, obstacles.clone());
        let whole =
            super::super::contour(super::super::smooth(whole, settings), settings, PositionRounding::Local);
        let frame = rasterize(shaped, settings, shape_stats, obstacles.clone(), 4, storages());
        let smoothed = smooth(frame.expect("in memory"), settings, &mut |_| {}).expect("in memory");
        let (tiled, _) = contour(smoothed, settings, PositionRounding::Local).expect("in memory");
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
        let mut frame = rasterized(&settings, 4);
        frame.fields.tiling = frame.fields.tiling.with_halo(4, 1);
        assert!(finished(frame, &settings).band.phi != reconstruct_frame(&particles(), &settings).band.phi);
    }
}
