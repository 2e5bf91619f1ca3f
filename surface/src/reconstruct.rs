//! Reconstructs surfaces from particles in memory: the entry points for other programs.

use std::borrow::Cow;
use std::convert::Infallible;
use std::io;
use std::sync::Arc;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::attributes::{add_computed, has_rest, wants_computed};
use crate::cancel::{CancelToken, catch};
use crate::error::Error;
use crate::level_set::NarrowBand;
use crate::mesh::{Mesh, PositionRounding};
use crate::motion::MovingParticles;
use crate::obstacle::{Obstacle, Obstacles};
use crate::options::{Anisotropy, Length, SequenceSpacing, Settings, SettingsError};
use crate::parallel::Loops as _;
use crate::particles::{Attribute, OwnedPositions, ParticleSource, Positions, Shapes, find_attribute};
use crate::reconstruction::{
    self, ApartParticles, MemoryPlan, MemoryPlanError, PlanInputs, PrecisionLimit, ShapedSource, StageError,
    StagedFrame, Targets, TileStorage, VoxelTooSmall,
};
use crate::report::Phase;
use crate::spacing::{estimate_spacing, median, rounded};
use crate::spray::Spray;
use crate::storage::Storage;
use crate::temporal::{OtherFrame, TimedFrame};
use crate::{Options, Report};

/// Reconstructs the surface of one frame of particles: a sum of kernels, smoothed by thin-plate flow
/// within bounds around it; with the preset `paper`, a union of spheres within two others.
///
/// `positions` are in world units: `&[[f32; 3]]` or `&[[f64; 3]]`, which are borrowed and not copied. The
/// same particles and options give the same bits on any number of threads. The function computes in rayon's
/// current pool: call it inside `ThreadPool::install` to choose one.
///
/// Use a [`Reconstructor`] for a sequence of frames, attributes, obstacles, progress, cancellation, or a
/// memory limit other than [`MEMORY_LIMIT`].
///
/// # Errors
/// See [`Error`]: options out of range, no usable particle, voxels too small, or more memory than the limit.
/// Particles whose position is not finite are left out and counted in [`Report::dropped_count`].
///
/// ```
/// use meniscus_surface::{Options, reconstruct};
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
/// # Ok::<(), meniscus_surface::Error>(())
/// ```
pub fn reconstruct<'a>(positions: impl Into<Positions<'a>>, options: &Options) -> Result<Surface, Error> {
    Reconstructor::new(options.clone()).reconstruct(positions)
}

/// The default [memory limit](Reconstructor::memory_limit) of a reconstruction: 16 GiB.
pub const MEMORY_LIMIT: u64 = 16 << 30;

/// The surface of a frame.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Surface {
    /// Vertex positions in absolute world units. The mesh is computed in 32 bits relative to an origin near
    /// the frame, and the origin is added in 64 bits, so the sum loses no digits.
    pub positions: Vec<DVec3>,
    /// Outward unit normals, one per vertex.
    pub normals: Vec<Vec3>,
    /// Three vertex indices per triangle, counter-clockwise seen from outside. The mesh is closed and
    /// 2-manifold unless
    /// [`Certificate::mesh_is_closed_manifold`](crate::Certificate::mesh_is_closed_manifold) says
    /// otherwise.
    pub triangles: Vec<[u32; 3]>,
    /// The particles' attributes at the vertices: those that [`Options::attributes`] selects, in the order of
    /// the input.
    pub attributes: Vec<Attribute>,
    /// The particles that are not in the mesh, because their pieces of fluid are smaller than [`Options::spray`]; `None`
    /// without this option. Without frames around, each frame decides alone.
    pub spray: Option<Spray>,
    /// The signed distances that were contoured, in voxels of [`Settings::voxel_size`].
    pub level_set: NarrowBand,
    /// The resolved options: the spacing, the voxel size, the radii, and all others.
    pub settings: Settings,
    /// The measurements and checks.
    pub report: Report,
}

impl Surface {
    /// The vertex positions in 32 bits relative to `origin`. Use `DVec3::ZERO` for world positions, or a
    /// point near the surface if the frame is so far from the world's origin that 32 bits are too few.
    pub fn positions_f32(&self, origin: DVec3) -> Vec<[f32; 3]> {
        self.positions.iter().map(|position| (*position - origin).as_vec3().to_array()).collect()
    }
}

/// The progress of a reconstruction.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Progress {
    /// The current phase.
    pub phase: Phase,
    /// The fraction of the phase that is done: 0 at its beginning. Only smoothing reports further fractions,
    /// up to 1.
    pub fraction: f64,
}

/// Reconstructs the frames of a sequence. Unlike [`reconstruct`], it also supports attributes, obstacles, a
/// memory limit, progress and cancellation.
///
/// The first frame resolves the options. All later frames use the same [`settings`](Self::settings): a
/// particle spacing estimated for each frame would make the surface flicker. The distance fields of obstacles
/// are cached across frames. All other memory is freed after each frame: keeping it would save 3 to 5 % of
/// the processor time (400 000 particles), but the peak memory of a frame would stay allocated until the next
/// frame.
///
/// ```
/// use meniscus_surface::{CancelToken, Options, Phase, Reconstructor};
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
/// # Ok::<(), meniscus_surface::Error>(())
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

/// What [`Reconstructor::reconstruct_parts`] prepares for files.
#[doc(hidden)]
#[derive(Clone, Copy, Debug)]
pub struct RequestedParts {
    /// How positions are rounded.
    pub rounding: PositionRounding,
    /// Attributes are also interpolated at voxels where |φ| is less than this, in voxels. `None`: only at
    /// vertices.
    pub band_half_width_voxels: Option<f32>,
    /// Whether a frame without a usable particle has an empty surface, as on the command line. Otherwise it
    /// fails with [`Error::NoParticles`].
    pub allows_empty: bool,
}

/// A frame of a sequence that has its smoothed level set.
#[doc(hidden)]
pub struct SmoothedFrame<'p> {
    staged: StagedFrame<ShapedSource<ShapedPositions<'p>>>,
    attributes: Cow<'p, [Attribute]>,
    /// What others need to be averaged with it, if it is to be averaged.
    timed: Option<Arc<TimedFrame>>,
    settings: Settings,
    wanted: RequestedParts,
    spray: Option<Spray>,
}

impl SmoothedFrame<'_> {
    /// The resolved options.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// What others need to be averaged with it.
    pub fn timed(&self) -> Option<Arc<TimedFrame>> {
        self.timed.clone()
    }
}

/// Creates one scratch file.
type MakeStorage<'a> = dyn FnMut() -> io::Result<Box<dyn Storage>> + Send + 'a;

impl<'a> Reconstructor<'a> {
    /// A reconstructor with these options, no obstacles and the default [memory limit](MEMORY_LIMIT). The
    /// options are checked when the first frame is reconstructed.
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

    /// Limits the memory that a frame may take in addition to its particles, in bytes. An upper bound of the
    /// memory is computed before anything is allocated; frames take about two thirds of this bound. A frame
    /// that needs more fails with an [error](Error::MemoryLimit), or uses [scratch storage](Self::scratch).
    pub fn memory_limit(&mut self, bytes: u64) -> &mut Self {
        self.memory_limit = bytes;
        self
    }

    /// Sets where to store what does not fit into the memory limit. For such a frame, `make` is called nine
    /// times, usually to create temporary files, which are dropped with the frame. The surface is
    /// bit-identical to that computed in memory. The integrators
    /// [`Implicit`](crate::Integrator::Implicit) and
    /// [`Adaptive`](crate::Integrator::Adaptive) cannot use scratch storage.
    pub fn scratch(&mut self, make: impl FnMut() -> io::Result<Box<dyn Storage>> + Send + 'a) -> &mut Self {
        self.scratch = Some(Box::new(make));
        self
    }

    /// Replaces the obstacles, for all later frames. Keep the `Arc` of a static obstacle: its distances are
    /// cached in it.
    pub fn obstacles(&mut self, obstacles: impl IntoIterator<Item = Arc<Obstacle>>) -> &mut Self {
        self.obstacles = Obstacles { members: obstacles.into_iter().collect() };
        self
    }

    /// Sets the token that cancels later frames.
    pub fn cancel_token(&mut self, token: CancelToken) -> &mut Self {
        self.token = token;
        self
    }

    /// Sets a callback, which runs on the calling thread as each phase begins and as smoothing advances.
    /// Measure time there if you need it: the method reads no clock.
    pub fn on_progress(&mut self, callback: impl FnMut(Progress) + Send + 'a) -> &mut Self {
        self.on_progress = Some(Box::new(callback));
        self
    }

    /// The resolved options; `None` until a frame had valid options.
    pub fn settings(&self) -> Option<&Settings> {
        self.settings.as_ref()
    }

    /// Reconstructs the next frame. See [`reconstruct`].
    ///
    /// # Errors
    /// See [`Error`]. The reconstructor can be used again after any of them.
    pub fn reconstruct<'p>(&mut self, positions: impl Into<Positions<'p>>) -> Result<Surface, Error> {
        self.reconstruct_with(positions, &[])
    }

    /// Reconstructs the next frame, whose particles have attributes: for [`Options::attributes`],
    /// [`Options::where`], [`Options::radius_attribute`] and stretching by velocity.
    ///
    /// # Errors
    /// See [`Error`]. Each attribute must have arity × particles values. An attribute that is listed in
    /// [`Options::attributes`] and not used otherwise may be missing.
    pub fn reconstruct_with<'p>(
        &mut self,
        positions: impl Into<Positions<'p>>,
        attributes: &[Attribute],
    ) -> Result<Surface, Error> {
        let parts = RequestedParts {
            rounding: PositionRounding::Local,
            band_half_width_voxels: None,
            allows_empty: false,
        };
        let (surface, settings) = self.reconstruct_parts(positions, attributes, parts)?;
        Ok(with_absolute_positions(surface, settings))
    }

    /// Like [`reconstruct_with`](Self::reconstruct_with), but the mesh has 32-bit positions relative to its
    /// origin. For programs that write the same files as the command line.
    ///
    /// # Errors
    /// Those of [`reconstruct_with`](Self::reconstruct_with).
    #[doc(hidden)]
    pub fn reconstruct_parts<'p>(
        &mut self,
        positions: impl Into<Positions<'p>>,
        attributes: &[Attribute],
        wanted: RequestedParts,
    ) -> Result<(reconstruction::FrameSurface, Settings), Error> {
        let positions = positions.into();
        // An interruption leaves the settings unchanged or `None`; all other state belongs to the frame.
        catch(|| {
            let smoothed = self.smooth_frame(positions, attributes.into(), wanted, false)?;
            self.contour_frame(smoothed)
        })
    }

    /// The first half of [`reconstruct_parts`](Self::reconstruct_parts), for a frame that is averaged with others
    /// of its sequence.
    ///
    /// # Errors
    /// Those of [`reconstruct_with`](Self::reconstruct_with).
    #[doc(hidden)]
    pub fn smooth_parts(
        &mut self,
        positions: OwnedPositions,
        attributes: Vec<Attribute>,
        wanted: RequestedParts,
    ) -> Result<SmoothedFrame<'static>, Error> {
        catch(|| self.smooth_frame(positions.into(), attributes.into(), wanted, true))
    }

    /// The second half: averages the frame with others that were smoothed with the same settings.
    ///
    /// # Errors
    /// Those of [`reconstruct_with`](Self::reconstruct_with).
    #[doc(hidden)]
    pub fn contour_parts(
        &mut self,
        mut frame: SmoothedFrame<'_>,
        others: &[OtherFrame],
    ) -> Result<(reconstruction::FrameSurface, Settings), Error> {
        catch(|| {
            if let Some(own) = &frame.timed {
                frame.staged.average(own, others, &frame.settings);
            }
            self.contour_frame(frame)
        })
    }

    fn smooth_frame<'p>(
        &mut self,
        positions: Positions<'p>,
        attributes: Cow<'p, [Attribute]>,
        wanted: RequestedParts,
        is_averaged: bool,
    ) -> Result<SmoothedFrame<'p>, Error> {
        self.begin(Phase::Prepare);
        let allows_empty = wanted.allows_empty;
        let given_count = positions.len();
        let (positions, attributes) = match chosen(&self.options, &positions, &attributes)? {
            Some((positions, attributes)) => (Positions::from(positions), attributes.into()),
            None => (positions, attributes),
        };
        // Nothing can be measured on an empty frame.
        let is_resolved = self.settings.is_some() || !self.options.needs_measuring();
        if positions.is_empty() && !(allows_empty && is_resolved) {
            return Err(no_particles(&self.options, given_count));
        }
        check_lengths(&positions, &attributes)?;
        let settings = &self.settings_on(&positions, &attributes)?.clone();
        settings.require_no_history()?;
        if !is_averaged {
            settings.require_single_frame()?;
        }
        check_required_attributes(settings, &attributes)?;
        let input_count = positions.len();
        let (positions, attributes) = with_computed(positions, attributes, settings);
        let (positions, attributes, spray) = without_spray(positions, attributes, settings);
        let plan = self.plan(&positions, &attributes, settings)?;
        self.begin(Phase::Rasterize);
        let moves = settings.temporal > 0;
        let moving = moves.then(|| MovingParticles::of(positions.borrowed().into(), &attributes));
        let fluid_count = positions.len();
        let (shapes, shape_stats) = reconstruction::shapes_by_attributes(fluid_count, &attributes, settings);
        let particles = ShapedPositions { positions, shapes };
        let Ok((particles, shape_stats)) =
            reconstruction::shape_by_neighbors(particles, shape_stats, settings);
        let tiles = self.tile_storage(&plan).map_err(Error::Scratch)?;
        let obstacles = self.obstacles.clone();
        let staged = StagedFrame::rasterize(particles, shape_stats, obstacles, settings, tiles)?;
        let is_all_spray = spray.as_ref().is_some_and(|spray| !spray.positions.is_empty());
        if staged.report().particle_count == 0 && !allows_empty && !is_all_spray {
            return Err(Error::NoParticles { input_count });
        }
        self.begin(Phase::Smooth);
        let staged = staged.smooth(settings, &mut |fraction| self.advance(Phase::Smooth, fraction));
        let staged = staged.map_err(Error::Scratch)?;
        let timed = moving.and_then(|moving| staged.timed(moving, settings));
        Ok(SmoothedFrame { staged, attributes, timed, settings: settings.clone(), wanted, spray })
    }

    fn contour_frame(
        &mut self,
        frame: SmoothedFrame<'_>,
    ) -> Result<(reconstruction::FrameSurface, Settings), Error> {
        let SmoothedFrame { staged, attributes, settings, wanted, spray, .. } = frame;
        let RequestedParts { rounding, band_half_width_voxels, .. } = wanted;
        self.begin(Phase::Contour);
        let (mut surface, particles) = staged.contour(&settings, rounding)?;
        if let Some(particles) = particles.filter(|_| settings.has_attributes()) {
            self.begin(Phase::Interpolate);
            let given = &particles.given().positions;
            let unsmoothed = has_rest(&attributes).then(|| OwnedPositions::from(given.clone()));
            let (positions, shapes) = particles.into_positions(|given| (given.positions, given.shapes));
            let targets = Targets { vertices: true, band_half_width_voxels };
            let surface = &mut surface;
            let positions = (positions, unsmoothed.as_ref());
            reconstruction::transfer_attributes(surface, positions, &shapes, &attributes, &settings, targets);
        }
        Ok((surface.with_spray(spray), settings))
    }

    /// The settings of the sequence. The first call resolves the options, and measures on these particles
    /// what the options leave open.
    ///
    /// # Errors
    /// The errors of [`reconstruct_with`](Self::reconstruct_with) that concern options.
    #[doc(hidden)]
    pub fn resolve_on<'p>(
        &mut self,
        positions: impl Into<Positions<'p>>,
        attributes: &[Attribute],
    ) -> Result<&Settings, Error> {
        let positions = positions.into();
        catch(|| match chosen(&self.options, &positions, attributes)? {
            Some((chosen, _)) if chosen.is_empty() && self.options.needs_measuring() => {
                Err(no_particles(&self.options, positions.len()))
            }
            Some((positions, attributes)) => self.settings_on(&(&positions).into(), &attributes),
            None => self.settings_on(&positions, attributes),
        })
    }

    /// Like [`resolve_on`](Self::resolve_on), on particles that were chosen already.
    fn settings_on(
        &mut self,
        positions: &Positions<'_>,
        attributes: &[Attribute],
    ) -> Result<&Settings, Error> {
        let settings = match self.settings.take() {
            Some(settings) => settings,
            None => resolve(&self.options, positions, attributes)?,
        };
        Ok(self.settings.insert(settings))
    }

    /// Reports the beginning of a phase.
    fn begin(&mut self, phase: Phase) {
        self.advance(phase, 0.0);
    }

    /// Reports progress. Unwinds if the token is cancelled.
    fn advance(&mut self, phase: Phase, fraction: f64) {
        if let Some(callback) = &mut self.on_progress {
            callback(Progress { phase, fraction });
        }
        self.token.checkpoint();
    }

    /// Decides whether the frame is computed in memory or in tiles.
    fn plan(
        &self,
        positions: &Positions<'_>,
        attributes: &[Attribute],
        settings: &Settings,
    ) -> Result<MemoryPlan, Error> {
        let selected = attributes.iter().filter(|attribute| settings.selects(attribute));
        let bytes: usize = selected.map(|attribute| attribute.values.size_bytes()).sum();
        let attribute_bytes = bytes as f64 / positions.len().max(1) as f64;
        // A frame in tiles cannot be averaged with others.
        let allows_tiles = self.scratch.is_some() && settings.temporal == 0;
        let surroundings = PlanInputs { obstacles: &self.obstacles, attribute_bytes, allows_tiles };
        let obstacle_bytes =
            self.obstacles.members.iter().map(|obstacle| obstacle.size_bytes_max() as u64).sum();
        let held_count = settings.held_frame_count();
        let allowed_bytes = self.memory_limit.saturating_sub(obstacle_bytes) / held_count;
        let Ok(planned) = reconstruction::plan_memory(positions, settings, surroundings, allowed_bytes);
        planned.map_err(|error| match error {
            MemoryPlanError::TooLarge(too_large) => Error::MemoryLimit {
                needed_bytes: too_large
                    .needed_bytes
                    .saturating_mul(held_count)
                    .saturating_add(obstacle_bytes),
                limit_bytes: self.memory_limit,
            },
            MemoryPlanError::VoxelTooSmall(VoxelTooSmall { voxel_size, spacing, least, limit }) => {
                match limit {
                    PrecisionLimit::Rounding(step) => Error::RoundedPositions { step, spacing },
                    _ => Error::VoxelTooSmall { voxel_size, least },
                }
            }
            MemoryPlanError::ObstacleTooFar(too_far) => Error::ObstacleTooFar(too_far),
        })
    }

    /// Scratch storage for a frame in tiles; `None` for a frame in memory.
    fn tile_storage(&mut self, plan: &MemoryPlan) -> io::Result<Option<TileStorage>> {
        let (Some(tile_leaves), Some(make)) = (plan.tile_leaves, &mut self.scratch) else { return Ok(None) };
        TileStorage::new(tile_leaves, make).map(Some)
    }
}

/// Positions with the shapes of their particles.
struct ShapedPositions<'a> {
    positions: Positions<'a>,
    shapes: Shapes,
}

impl ParticleSource for ShapedPositions<'_> {
    type Error = Infallible;

    fn batch_count(&self) -> usize {
        self.positions.batch_count()
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, Infallible> {
        self.positions.batch(batch)
    }

    fn batch_len(&self, batch: usize) -> usize {
        self.positions.batch_len(batch)
    }

    fn has_shapes(&self) -> bool {
        !self.shapes.is_uniform()
    }

    fn batch_shapes(&self, batch: usize) -> Shapes {
        self.shapes.slice(self.positions.range_of(batch))
    }
}

impl From<StageError<Infallible>> for Error {
    fn from(error: StageError<Infallible>) -> Error {
        match error {
            StageError::Storage(error) => Error::Scratch(error),
        }
    }
}

/// Resolves the options, and measures the particles if they need it.
fn resolve(
    options: &Options,
    positions: &Positions<'_>,
    attributes: &[Attribute],
) -> Result<Settings, Error> {
    if options.columns.is_some() {
        let what =
            "columns are of tables in files: the attributes of particles in memory have names".to_owned();
        return Err(SettingsError::of_value(what).into());
    }
    if options.spray_keep.is_some_and(|keep| keep > 1) {
        let what = "the frames before and after a frame in memory are not known, so each frame alone decides what is spray: \
                    the number of frames that a particle stays on one side must be 1";
        return Err(SettingsError::of_value(what.to_owned()).into());
    }
    let options = &Options { spray_keep: options.spray.map(|_| 1), ..options.clone() };
    let per_particle_radius = options.per_particle_radius()?;
    let mut measured = None;
    if options.needs_measuring() {
        let by_radius = per_particle_radius.as_ref().and_then(|own| own.spacing(attributes));
        let needs_positions = by_radius.is_none() || options.is_auto();
        let estimate = needs_positions.then(|| estimate_spacing(positions.borrowed())).flatten();
        let spacing = by_radius.or(estimate.map(|estimate| estimate.spacing));
        measured = spacing.map(|spacing| SequenceSpacing {
            spacing: rounded(spacing),
            radius_median: per_particle_radius.and_then(|own| median(own.radii_min(attributes))),
            irregularity: estimate.and_then(|estimate| estimate.irregularity),
        });
        let is_known = options.spacing.or(options.voxel_size.and_then(Length::world)).is_some();
        if measured.is_none() && !is_known {
            return Err(Error::UnknownSpacing);
        }
    }
    Ok(Settings::resolve(options, measured)?)
}

/// The particles that meet [`Options::where`], with their attributes; `None` without this option.
fn chosen(
    options: &Options,
    positions: &Positions<'_>,
    attributes: &[Attribute],
) -> Result<Option<(OwnedPositions, Vec<Attribute>)>, Error> {
    let Some(filter) = &options.r#where else { return Ok(None) };
    check_lengths(positions, attributes)?;
    let chosen = filter.chosen(positions, attributes);
    chosen.map(Some).map_err(|why| Error::Filter(format!("`{filter}`: {why}")))
}

/// The error of a frame of `input_count` particles of which none is left.
fn no_particles(options: &Options, input_count: usize) -> Error {
    match &options.r#where {
        Some(filter) if input_count > 0 => {
            Error::Filter(format!("none of the {input_count} particles meets `{filter}`"))
        }
        _ => Error::NoParticles { input_count },
    }
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

/// The particles with the attributes that are computed from others.
fn with_computed<'p>(
    positions: Positions<'p>,
    attributes: Cow<'p, [Attribute]>,
    settings: &Settings,
) -> (Positions<'p>, Cow<'p, [Attribute]>) {
    if !wants_computed(settings, &attributes) {
        return (positions, attributes);
    }
    let (positions, mut attributes): (OwnedPositions, _) = (positions.into(), attributes.into_owned());
    add_computed(&positions, &mut attributes, settings);
    (positions.into(), attributes.into())
}

/// The particles and attributes without spray, and the spray, if the settings ask for it.
fn without_spray<'p>(
    positions: Positions<'p>,
    attributes: Cow<'p, [Attribute]>,
    settings: &Settings,
) -> (Positions<'p>, Cow<'p, [Attribute]>, Option<Spray>) {
    if settings.spray == 0 {
        return (positions, attributes, None);
    }
    let positions: OwnedPositions = positions.into();
    let apart = ApartParticles::find(&positions, &attributes, settings);
    let (fluid, of_fluid, spray) = apart.take_spray(&positions, &attributes, &[], settings);
    (fluid.into(), of_fluid.into(), Some(spray))
}

/// Checks that the attributes that shape particles exist.
fn check_required_attributes(settings: &Settings, attributes: &[Attribute]) -> Result<(), Error> {
    let radius = settings.per_particle_radius.as_ref().map(|own| (&*own.attribute, 1));
    let velocity = matches!(settings.anisotropy, Anisotropy::Velocity { .. }).then_some(("velocity", 3));
    for (name, arity) in radius.into_iter().chain(velocity) {
        if find_attribute(attributes, name, arity).is_none() {
            return Err(Error::MissingAttribute { name: name.to_owned(), arity });
        }
    }
    Ok(())
}

/// Converts the mesh to absolute positions.
fn with_absolute_positions(surface: reconstruction::FrameSurface, settings: Settings) -> Surface {
    let reconstruction::FrameSurface { band, mesh, attributes, spray, report, .. } = surface;
    let Mesh { positions, normals, triangles, origin } = mesh;
    let positions = positions.into_par_iter().halved().map(|position| origin + position.as_dvec3()).collect();
    let attributes = attributes.vertices;
    Surface { positions, normals, triangles, attributes, spray, level_set: band, settings, report }
}

#[cfg(test)]
mod tests;
