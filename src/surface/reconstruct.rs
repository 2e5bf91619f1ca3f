//! Particles in memory to a surface: what another program calls.

use std::io;
use std::ops::ControlFlow;
use std::sync::Arc;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::surface::cancel::{CancelToken, CancellableParticles, CancellableStorage};
use crate::surface::error::Error;
use crate::surface::level_set::NarrowBand;
use crate::surface::mesh::Mesh;
use crate::surface::obstacle::{Obstacle, Obstacles};
use crate::surface::options::{Anisotropy, Length, Measured, Settings};
use crate::surface::particles::{Attribute, Positions, Shapes, attribute_of};
use crate::surface::report::{Phase, Shaping};
use crate::surface::skin::tiled::{self, TiledError};
use crate::surface::skin::{
    self, Plan, SHELF_COUNT, ShapedSource, Storage, Stored, Surroundings, Targets, Unfit,
};
use crate::surface::spacing::{estimate_spacing, median, rounded};
use crate::surface::{Options, Report};

/// The surface of one frame of particles: the smoothest one, in the sense of least bending energy, that stays between two
/// unions of spheres around the particles.
///
/// `positions` are in world units: `&[[f32; 3]]` or `&[[f64; 3]]`, which are borrowed and not copied. The same particles and
/// options give the same bits on any number of threads. It computes in rayon's current pool: call it inside
/// `ThreadPool::install` to choose one.
///
/// Use a [`Reconstructor`] for a sequence of frames, attributes, obstacles, progress, cancellation, or another memory limit than
/// [`MEMORY_LIMIT`].
///
/// # Errors
/// See [`Error`]: options out of range, no usable particle, voxels too small, or more memory than the limit.
/// Positions that are not finite are left out, and counted in [`Report::dropped_count`].
///
/// ```
/// use meniscus::surface::{Options, reconstruct};
///
/// let block: Vec<[f32; 3]> = (0..1000)
///     .map(|i| [i % 10, i / 10 % 10, i / 100].map(|step| 0.1 * step as f32))
///     .collect();
/// let surface = reconstruct(&block, &Options::default())?;
/// assert_eq!(surface.normals.len(), surface.positions.len());
/// assert!(surface.report.certificate.holds());
/// // Positions are in world space, in 64 bits.
/// let highest = surface.positions.iter().map(|position| position.z).fold(f64::MIN, f64::max);
/// assert!((0.9..1.1).contains(&highest));
/// # Ok::<(), meniscus::surface::Error>(())
/// ```
pub fn reconstruct<'a>(positions: impl Into<Positions<'a>>, options: &Options) -> Result<Surface, Error> {
    Reconstructor::new(options.clone()).reconstruct(positions)
}

/// The memory that a reconstruction may take unless [another limit](Reconstructor::memory_limit) is set: 16 GiB.
pub const MEMORY_LIMIT: u64 = 16 << 30;

/// The surface of a frame.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Surface {
    /// Vertex positions in world units, absolute. Each is exact: the mesh is computed in 32 bits relative to an origin near
    /// the frame, and the origin is added in 64 bits.
    pub positions: Vec<DVec3>,
    /// Unit normals, outward; one for each vertex.
    pub normals: Vec<Vec3>,
    /// Three vertex indices for each triangle, counter-clockwise seen from outside. The mesh is closed and 2-manifold
    /// unless [`Certificate::mesh_is_closed_manifold`](crate::surface::Certificate::mesh_is_closed_manifold) says otherwise.
    pub triangles: Vec<[u32; 3]>,
    /// The particles' attributes at the vertices: those that [`Options::attributes`] selects, in the order in which they
    /// were given.
    pub attributes: Vec<Attribute>,
    /// The signed distances that were meshed, in voxels of [`Settings::voxel_size`].
    pub level_set: NarrowBand,
    /// The options in numbers: the spacing, the voxel size, the radii, and all others.
    pub settings: Settings,
    /// What was measured and checked on the way.
    pub report: Report,
}

impl Surface {
    /// The vertex positions in 32 bits relative to `origin`: `DVec3::ZERO` for world positions, or a point near the
    /// surface where the frame is so far from the world's origin that 32 bits are too few.
    pub fn positions_f32(&self, origin: DVec3) -> Vec<[f32; 3]> {
        self.positions.iter().map(|position| (*position - origin).as_vec3().to_array()).collect()
    }
}

/// How far a reconstruction is.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Progress {
    /// The phase.
    pub phase: Phase,
    /// The fraction of the phase that is done: 0 as it begins, and up to 1 while it smooths. The other phases report only
    /// their beginning.
    pub fraction: f64,
}

/// Reconstructs the frames of a sequence, with everything that [`reconstruct`] leaves out.
///
/// It resolves the options on the first frame and keeps the result, [`settings`](Self::settings), for all others: a particle
/// spacing estimated for each frame would make the surface flicker. Obstacles keep their distances from frame to frame. Other
/// memory is returned after each frame: keeping all of it would save 3 to 5 % of the processor time (400 000 particles), and hold
/// the peak of a frame in between.
///
/// ```
/// use meniscus::surface::{CancelToken, Options, Phase, Reconstructor};
///
/// let token = CancelToken::new();
/// let mut smoothing_steps = 0;
/// let mut reconstructor = Reconstructor::new(Options { spacing: Some(0.1), ..Options::default() });
/// reconstructor.memory_limit(1 << 30).cancel_token(token.clone()).on_progress(|progress| {
///     smoothing_steps += usize::from(progress.phase == Phase::Smooth);
/// });
/// for frame in [[[0.0f32, 0.0, 0.0]], [[0.05, 0.0, 0.0]]] {
///     let surface = reconstructor.reconstruct(&frame)?;
///     assert!(!surface.triangles.is_empty());
/// }
/// token.cancel();
/// assert!(reconstructor.reconstruct(&[[0.0f32; 3]]).is_err());
/// drop(reconstructor);
/// assert!(smoothing_steps > 2);
/// # Ok::<(), meniscus::surface::Error>(())
/// ```
pub struct Reconstructor<'a> {
    options: Options,
    settings: Option<Settings>,
    obstacles: Obstacles,
    memory_limit: u64,
    scratch: Option<Box<MakeStorage<'a>>>,
    token: CancelToken,
    on_progress: Option<Box<dyn FnMut(Progress) + Send + 'a>>,
}

/// Makes scratch storage.
type MakeStorage<'a> = dyn FnMut() -> io::Result<Box<dyn Storage>> + Send + 'a;

impl<'a> Reconstructor<'a> {
    /// A reconstructor with these options, no obstacles and the default [memory limit](MEMORY_LIMIT). The options are checked
    /// with the first frame.
    pub fn new(options: Options) -> Reconstructor<'a> {
        Reconstructor {
            options,
            settings: None,
            obstacles: Obstacles::default(),
            memory_limit: MEMORY_LIMIT,
            scratch: None,
            token: CancelToken::new(),
            on_progress: None,
        }
    }

    /// The memory that a frame may take, in bytes, beside its particles. It is estimated before any of it is allocated, from
    /// above: frames take about two thirds of the estimate. A frame that needs more is an
    /// [error](Error::MemoryLimit), or goes through [scratch storage](Self::scratch).
    pub fn memory_limit(&mut self, bytes: u64) -> &mut Self {
        self.memory_limit = bytes;
        self
    }

    /// Where to put what does not fit into the memory limit: for such a frame `make` is called eight times, for temporary files as a
    /// rule, which are dropped with the frame. The surface is the same to the bit. The integrators
    /// [`Implicit`](crate::surface::Integrator::Implicit) and [`Adaptive`](crate::surface::Integrator::Adaptive) cannot use it.
    pub fn scratch(&mut self, make: impl FnMut() -> io::Result<Box<dyn Storage>> + Send + 'a) -> &mut Self {
        self.scratch = Some(Box::new(make));
        self
    }

    /// The obstacles of the frames that follow, in place of those before. Keep the `Arc` of an obstacle that stands still:
    /// its distances are cached in it.
    pub fn obstacles(&mut self, obstacles: impl IntoIterator<Item = Arc<Obstacle>>) -> &mut Self {
        self.obstacles = Obstacles { members: obstacles.into_iter().collect() };
        self
    }

    /// The token that cancels the frames that follow.
    pub fn cancel_token(&mut self, token: CancelToken) -> &mut Self {
        self.token = token;
        self
    }

    /// Calls `callback` on the calling thread as each phase begins and as smoothing advances. Measure time there if you need it:
    /// the method has no clock.
    pub fn on_progress(&mut self, callback: impl FnMut(Progress) + Send + 'a) -> &mut Self {
        self.on_progress = Some(Box::new(callback));
        self
    }

    /// The resolved options; `None` before the first frame whose options are valid.
    pub fn settings(&self) -> Option<&Settings> {
        self.settings.as_ref()
    }

    /// The surface of the next frame. See [`reconstruct`].
    ///
    /// # Errors
    /// See [`Error`]. The reconstructor can be used again after any of them.
    pub fn reconstruct<'p>(&mut self, positions: impl Into<Positions<'p>>) -> Result<Surface, Error> {
        self.reconstruct_with(positions, &[])
    }

    /// The surface of the next frame, whose particles have attributes: for [`Options::attributes`],
    /// [`Options::radius_attribute`] and stretching by velocity.
    ///
    /// # Errors
    /// See [`Error`]. Each attribute must have its arity times as many values as there are particles. An attribute that only
    /// [`Options::attributes`] names may be missing.
    pub fn reconstruct_with<'p>(
        &mut self,
        positions: impl Into<Positions<'p>>,
        attributes: &[Attribute],
    ) -> Result<Surface, Error> {
        let positions = positions.into();
        self.enter(Phase::Prepare)?;
        if positions.is_empty() {
            return Err(Error::NoParticles { given: 0 });
        }
        check_lengths(&positions, attributes)?;
        let settings = match &self.settings {
            Some(settings) => settings.clone(),
            None => resolve(&self.options, &positions, attributes)?,
        };
        self.settings = Some(settings.clone());
        check_present(&settings, attributes)?;
        let token = self.token.clone();
        let given = CancellableParticles { positions, shapes: Shapes::Balls, token };
        let plan = self.plan(&given, attributes, &settings)?;
        self.enter(Phase::Rasterize)?;
        let (shapes, shaping) = skin::shapes_by_attributes(given.positions.len(), attributes, &settings);
        let given = CancellableParticles { shapes, ..given };
        let (shaped, shaping) = skin::shape_by_neighbors(given, shaping, &settings)?;
        let work = Work { settings: &settings, shaped, shaping };
        let (mut surface, shaped) = match plan.tile_leaves {
            None => self.whole(work)?,
            Some(tile_leaves) => self.in_tiles(work, tile_leaves)?,
        };
        if settings.attributes.is_some() {
            self.enter(Phase::Interpolate)?;
            let (positions, shapes) = shaped.into_positions(|given| (given.positions, given.shapes));
            let targets = Targets { vertices: true, band_half_width_voxels: None };
            skin::transfer_from((positions, &shapes, attributes), &mut surface, &settings, targets);
        }
        Ok(finished(surface, settings))
    }

    /// Reports that a phase begins, unless the token is cancelled.
    fn enter(&mut self, phase: Phase) -> Result<(), Error> {
        self.advance(phase, 0.0);
        self.token.check()
    }

    fn advance(&mut self, phase: Phase, fraction: f64) {
        if let Some(callback) = &mut self.on_progress {
            callback(Progress { phase, fraction });
        }
    }

    /// How the frame fits into memory.
    fn plan(
        &self,
        given: &CancellableParticles<'_>,
        attributes: &[Attribute],
        settings: &Settings,
    ) -> Result<Plan, Error> {
        let selected = |attribute: &&Attribute| {
            settings.attributes.as_ref().is_some_and(|selection| selection.selects(attribute))
        };
        let selected = attributes.iter().filter(selected);
        let bytes: usize = selected.map(|attribute| attribute.values.size_bytes()).sum();
        let attribute_bytes = bytes as f64 / given.positions.len() as f64;
        let surroundings = Surroundings { obstacles: &self.obstacles, attribute_bytes };
        let of_obstacles =
            self.obstacles.members.iter().map(|obstacle| obstacle.size_bytes_max() as u64).sum();
        let allowed_bytes = self.memory_limit.saturating_sub(of_obstacles);
        let over = |least_bytes: u64| Error::MemoryLimit {
            needed_bytes: least_bytes.saturating_add(of_obstacles),
            limit_bytes: self.memory_limit,
        };
        let planned = match &self.scratch {
            Some(_) => skin::plan(given, settings, surroundings, allowed_bytes)?,
            None => skin::plan_whole(given, settings, surroundings, allowed_bytes)?,
        };
        match planned {
            Ok(plan) => Ok(plan),
            Err(Unfit::TooLarge(too_large)) => Err(over(too_large.least_bytes)),
            Err(Unfit::TooFine(too_fine)) => {
                Err(Error::VoxelTooSmall { voxel_size: too_fine.voxel_size, least: too_fine.least })
            }
        }
    }

    /// A frame in memory.
    fn whole<'p>(&mut self, work: Work<'_, 'p>) -> Result<(skin::Surface, Shaped<'p>), Error> {
        let Work { settings, shaped, shaping } = work;
        let mut rasterized = skin::rasterize(&shaped, settings, shaping, self.obstacles.clone())?;
        has_particles(rasterized.report_mut().particle_count, &shaped)?;
        self.enter(Phase::Smooth)?;
        let token = self.token.clone();
        let smoothed = skin::smooth_while(rasterized, settings, &mut |fraction| {
            self.advance(Phase::Smooth, fraction);
            token.flow()
        });
        let smoothed = of_flow(smoothed)?;
        self.enter(Phase::Contour)?;
        let surface = skin::contour_while(smoothed, settings, &[Stored::AsTheyAre], &|| token.flow());
        Ok((of_flow(surface)?, shaped))
    }

    /// A frame that does not fit into memory.
    fn in_tiles<'p>(
        &mut self,
        work: Work<'_, 'p>,
        tile_leaves: i32,
    ) -> Result<(skin::Surface, Shaped<'p>), Error> {
        let Work { settings, shaped, shaping } = work;
        let mut storages: Vec<Box<dyn Storage>> = Vec::new();
        if let Some(make) = &mut self.scratch {
            for _ in 0..SHELF_COUNT {
                let (storage, token) = (make().map_err(Error::Scratch)?, self.token.clone());
                storages.push(Box::new(CancellableStorage { storage, token }));
            }
        }
        let obstacles = self.obstacles.clone();
        let mut frame = tiled::rasterize(shaped, settings, shaping, obstacles, tile_leaves, storages)
            .map_err(of_tiles)?;
        let left = frame.report_mut().particle_count;
        has_particles(left, frame.source())?;
        self.enter(Phase::Smooth)?;
        let frame = tiled::smooth(frame, settings, &mut |fraction| self.advance(Phase::Smooth, fraction));
        let frame = frame.map_err(of_storage)?;
        self.enter(Phase::Contour)?;
        tiled::contour(frame, settings, &[Stored::AsTheyAre]).map_err(of_tiles)
    }
}

/// Particles where and as the method has them.
type Shaped<'p> = ShapedSource<CancellableParticles<'p>>;

/// What is to be reconstructed.
struct Work<'s, 'p> {
    settings: &'s Settings,
    shaped: Shaped<'p>,
    shaping: Shaping,
}

/// Fills in what the options leave open.
fn resolve(
    options: &Options,
    positions: &Positions<'_>,
    attributes: &[Attribute],
) -> Result<Settings, Error> {
    let own_radii = options.own_radii()?;
    let mut measured = None;
    if options.needs_spacing() {
        measured = estimate_spacing(positions.borrowed()).map(|estimate| Measured {
            spacing: rounded(estimate.spacing),
            radius_median: own_radii.and_then(|own| median(own.radii_min(attributes))),
        });
        if measured.is_none() && options.voxel_size.and_then(Length::world).is_none() {
            return Err(Error::UnknownSpacing);
        }
    }
    Ok(Settings::resolve(options, measured)?)
}

fn check_lengths(positions: &Positions<'_>, attributes: &[Attribute]) -> Result<(), Error> {
    for attribute in attributes {
        let (found, expected) = (attribute.values.len(), attribute.arity.saturating_mul(positions.len()));
        if found != expected || attribute.arity == 0 {
            let expected = expected.max(positions.len());
            return Err(Error::AttributeLength { name: attribute.name.clone(), expected, found });
        }
    }
    Ok(())
}

/// Whether the attributes that shape particles are there.
fn check_present(settings: &Settings, attributes: &[Attribute]) -> Result<(), Error> {
    let radius = settings.own_radii.as_ref().map(|own| (&*own.attribute, 1));
    let velocity = matches!(settings.anisotropy, Anisotropy::Velocity { .. }).then_some(("velocity", 3));
    for (name, arity) in radius.into_iter().chain(velocity) {
        if attribute_of(attributes, name, arity).is_none() {
            return Err(Error::MissingAttribute { name: name.to_owned(), arity });
        }
    }
    Ok(())
}

/// An error where no particle was left.
fn has_particles(left: usize, shaped: &Shaped<'_>) -> Result<(), Error> {
    match left {
        0 => Err(Error::NoParticles { given: shaped.given().positions.len() }),
        _ => Ok(()),
    }
}

fn of_flow<T>(flow: ControlFlow<Error, T>) -> Result<T, Error> {
    match flow {
        ControlFlow::Continue(value) => Ok(value),
        ControlFlow::Break(error) => Err(error),
    }
}

/// Storage fails when the token is cancelled, too.
fn of_storage(error: io::Error) -> Error {
    if error.get_ref().is_some_and(|inner| inner.is::<Error>()) {
        Error::Cancelled
    } else {
        Error::Scratch(error)
    }
}

fn of_tiles(error: TiledError<Error>) -> Error {
    match error {
        TiledError::Source(error) => error,
        TiledError::Storage(error) => of_storage(error),
    }
}

/// The surface as callers get it: with absolute positions.
fn finished(surface: skin::Surface, settings: Settings) -> Surface {
    let skin::Surface { band, mesh, attributes, report } = surface;
    let Mesh { positions, normals, triangles, origin } = mesh;
    let positions = positions.into_par_iter().map(|position| origin + position.as_dvec3()).collect();
    let attributes = attributes.vertices;
    Surface { positions, normals, triangles, attributes, level_set: band, settings, report }
}

#[cfg(test)]
mod tests;
