//! Sets of input particles: generated ones, and frames in files.

use std::f64::consts::{PI, TAU};
use std::fs;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3, IVec3};
use meniscus::pipeline::particles;
use meniscus::surface::flicker::MovingParticles;
use meniscus::surface::particles::OwnedPositions;
use meniscus_formats::{AttributeRole, FileAttribute, Limits, Values, read_particles};

use super::heights::{Rays, Up};
use crate::Outcome;
use crate::flow::Flow;
use crate::samples::{Random, particles_in};

/// Frames that are scored together.
pub(super) struct Set {
    pub(super) name: String,
    /// The distance between neighbouring particles at rest, world units.
    pub(super) spacing: f64,
    /// The frames: at least one.
    pub(super) frames: Vec<Frame>,
    /// Frames before and after these, which are not scored.
    pub(super) around: Vec<Frame>,
    pub(super) kind: Kind,
}

pub(super) struct Frame {
    pub(super) number: usize,
    pub(super) points: Vec<DVec3>,
    pub(super) motion: Motion,
    /// The radius of each particle, world units, if they have radii of their own.
    pub(super) radii: Option<Vec<f32>>,
    /// The density of each particle, if a simulator wrote it: [`REST_DENSITY`] at rest.
    pub(super) densities: Option<Vec<f32>>,
}

/// The density of the fluid at rest in simulations whose particles have densities.
pub(super) const REST_DENSITY: f64 = 1000.0;

impl Frame {
    pub(super) fn moving_particles(&self) -> MovingParticles {
        let positions = OwnedPositions::F64(self.points.iter().map(DVec3::to_array).collect());
        let Motion { ids, velocities } = self.motion.clone();
        MovingParticles { positions, ids, velocities }
    }
}

/// The motion data of particles in a file.
#[derive(Clone, Default)]
pub(super) struct Motion {
    /// The id of each particle, constant over frames.
    pub(super) ids: Option<Vec<i64>>,
    pub(super) velocities: Option<Vec<[f32; 3]>>,
}

/// The motion of a set.
pub(super) enum Kind {
    /// A single frame.
    Still,
    /// A known flow carries the particles.
    Flow(Flow),
    /// The particles have ids, or velocities and this time between two frames.
    Moving { seconds: f64 },
    /// A pool that is at rest, or nearly.
    Pool { rays: Rays },
    /// Clusters of different numbers of particles, several of each.
    Clusters,
    /// Two particles that approach each other in steps, several times: as many frames as steps each time.
    Pairs,
    /// A lone particle at several positions.
    Drops,
    /// Strips of different numbers of particles, each with a like strip from which it tears again.
    Welds,
    /// Lone particles with radii of their own, of several sizes in each frame.
    Sizes,
}

impl Set {
    /// The file name of a frame's particles, and of its mesh, for other programs.
    pub(super) fn file_name(&self, frame: &Frame) -> String {
        format!("{}.{:04}.ply", self.name.replace(' ', "_"), frame.number)
    }

    fn new(name: &str, spacing: f64, frames: Vec<Vec<DVec3>>, kind: Kind) -> Set {
        let radii = matches!(kind, Kind::Sizes).then(|| lone_radii().map(|radius| radius as f32).collect());
        let frame = |(number, points)| Frame {
            number,
            points,
            motion: Motion::default(),
            radii: radii.clone(),
            densities: None,
        };
        let frames = frames.into_iter().enumerate().map(frame).collect();
        Set { name: name.into(), spacing, frames, around: Vec::new(), kind }
    }

    /// The frame with this number, if it is known.
    pub(super) fn frame(&self, number: usize) -> Option<&Frame> {
        self.frames.iter().chain(&self.around).find(|frame| frame.number == number)
    }
}

/// Frames of a whole cycle of a flow, as in the experiment `flows`.
pub(super) const FRAMES: usize = 300;

/// Flows of a lattice of particles, and of randomly displaced particles: name, flow, number of particles,
/// displacement in spacings.
const FLOWS: [(&str, Flow, usize, f64); 8] = [
    ("Enright 500", Flow::Enright, 500, 0.0),
    ("Enright 5000", Flow::Enright, 5_000, 0.0),
    ("Zalesak", Flow::Zalesak, 5_000, 0.0),
    ("jittered Enright 500", Flow::Enright, 500, JITTER),
    ("jittered Enright 5000", Flow::Enright, 5_000, JITTER),
    ("jittered Zalesak", Flow::Zalesak, 5_000, JITTER),
    ("Enright 50000", Flow::Enright, 50_000, 0.0),
    ("jittered Enright 50000", Flow::Enright, 50_000, JITTER),
];

/// Upper limit of the displacement on each axis, in spacings.
const JITTER: f64 = 0.25;

/// The other generated sets, by name.
const GENERATED: [(&str, Generate); 11] = [
    ("jittered pool", jittered_pool),
    ("random ball", random_ball),
    ("sheet", sheet),
    ("thread", thread),
    ("plane sheet", plane_sheet),
    ("straight thread", straight_thread),
    ("clusters", clusters),
    ("pair", pair),
    ("drop", drop),
    ("welds", welds),
    ("sizes", sizes),
];

/// Generates frames; also returns the spacing.
type Generate = fn() -> (Vec<Vec<DVec3>>, f64, Kind);

/// The selected sets.
pub(super) struct Sets {
    /// Names of generated sets; `None` for all except slow ones.
    only: Option<Vec<String>>,
    /// Of a flow, three consecutive frames around each multiple of this number are used.
    every: usize,
    /// Files with their spacing.
    files: Vec<(PathBuf, f64)>,
    /// How many frames before and after those that are scored are known.
    pub(super) reach: usize,
    moving: Vec<Moving>,
    /// Folders of pools with their spacing.
    pools: Vec<(PathBuf, f64)>,
    /// The walls of the pools in folders.
    walls: [f64; 4],
    up: Up,
}

/// A folder with the frames of a simulation.
struct Moving {
    folder: PathBuf,
    spacing: f64,
    /// The seconds between two frames.
    seconds: f64,
    /// The first and the last frame, counted from 0 in the order of the files; all without it.
    window: Option<RangeInclusive<usize>>,
}

impl Default for Sets {
    fn default() -> Sets {
        let (files, moving, pools) = (Vec::new(), Vec::new(), Vec::new());
        Sets { only: None, every: 10, files, reach: 0, moving, pools, walls: [0.0; 4], up: Up::Z }
    }
}

impl Sets {
    /// Parses an argument. Returns false if it does not select sets.
    pub(super) fn parse_argument(&mut self, name: &str, value: &str) -> Outcome<bool> {
        let with_number = |value: &str, form: &str| -> Outcome<(PathBuf, f64)> {
            let (path, number) = value.rsplit_once(':').ok_or(form)?;
            Ok((path.into(), number.parse()?))
        };
        match name {
            "only" => {
                let names: Vec<String> =
                    value.split(',').filter(|name| !name.is_empty()).map(str::to_owned).collect();
                let known: Vec<&str> = generated_names().collect();
                if let Some(unknown) = names.iter().find(|name| !known.contains(&name.as_str())) {
                    return Err(
                        format!("unknown set {unknown}; expected one of: {}", known.join(", ")).into()
                    );
                }
                self.only = Some(names);
            }
            "every" => self.every = value.parse()?,
            "frame" => self.files.push(with_number(value, "frame=FILE:SPACING")?),
            "moving" => {
                let form = "moving=FOLDER:SPACING:SECONDS[:FIRST-LAST]";
                let window = |text: &str| {
                    let (first, last) = text.split_once('-')?;
                    Some(first.parse().ok()?..=last.parse().ok()?)
                };
                let (value, window) = match value.rsplit_once(':') {
                    Some((rest, last)) if window(last).is_some() => (rest, window(last)),
                    _ => (value, None),
                };
                let (rest, seconds) = value.rsplit_once(':').ok_or(form)?;
                let (folder, spacing) = with_number(rest, form)?;
                self.moving.push(Moving { folder, spacing, seconds: seconds.parse()?, window });
            }
            "pool" => self.pools.push(with_number(value, "pool=FOLDER:SPACING")?),
            "walls" => {
                let numbers: Vec<f64> = value.split(',').map(str::parse).collect::<Result<_, _>>()?;
                self.walls = numbers.try_into().map_err(|_| "walls=x0,y0,x1,y1")?;
            }
            "up" => {
                self.up = match value {
                    "y" => Up::Y,
                    "z" => Up::Z,
                    _ => return Err("up=y or up=z".into()),
                }
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    fn wants(&self, name: &str) -> bool {
        match &self.only {
            None => !name.contains("50000"),
            Some(names) => names.iter().any(|wanted| wanted == name),
        }
    }

    /// Calls `visitor` for each set. Only one is in memory at a time.
    pub(super) fn visit(&self, mut visitor: impl FnMut(Set) -> Outcome<()>) -> Outcome<()> {
        for (name, flow, count, jitter) in FLOWS.into_iter().filter(|flow| self.wants(flow.0)) {
            visitor(in_flow(name, flow, count, jitter, self.every, self.reach))?;
        }
        for (name, generate) in GENERATED.into_iter().filter(|set| self.wants(set.0)) {
            let (frames, spacing, kind) = generate();
            visitor(Set::new(name, spacing, frames, kind))?;
        }
        for (path, spacing) in &self.files {
            visitor(Set::new(&stem_of(path), *spacing, vec![frame_in(path, 0)?.points], Kind::Still))?;
        }
        for Moving { folder, spacing, seconds, window } in &self.moving {
            let frames = frames_in(folder, window.clone())?;
            let mut around = Vec::new();
            if let Some(window) = window {
                let (first, last) = (*window.start(), *window.end());
                let last_of_all = paths_in(folder)?.len() - 1;
                let wider = first.saturating_sub(self.reach)..=(last + self.reach).min(last_of_all);
                around = frames_in(folder, Some(wider))?;
                around.retain(|frame| !window.contains(&frame.number));
            }
            let of_window = window.as_ref().map(|window| format!(" {}-{}", window.start(), window.end()));
            let name = stem_of(folder) + &of_window.unwrap_or_default();
            visitor(Set {
                name,
                spacing: *spacing,
                frames,
                around,
                kind: Kind::Moving { seconds: *seconds },
            })?;
        }
        for (folder, spacing) in &self.pools {
            let kind = Kind::Pool { rays: Rays::new(self.walls, self.up, *spacing) };
            visitor(Set {
                name: stem_of(folder),
                spacing: *spacing,
                frames: frames_in(folder, None)?,
                around: Vec::new(),
                kind,
            })?;
        }
        Ok(())
    }
}

fn generated_names() -> impl Iterator<Item = &'static str> {
    FLOWS.iter().map(|flow| flow.0).chain(GENERATED.iter().map(|set| set.0))
}

fn in_flow(name: &str, flow: Flow, count: usize, jitter: f64, every: usize, reach: usize) -> Set {
    let (mut points, spacing) = particles_in(flow, count);
    let mut random = Random::new(7);
    for point in &mut points {
        *point += jitter * spacing * random_offset(&mut random);
    }
    let (mut frames, mut around) = (Vec::new(), Vec::new());
    let time = |number: usize| flow.period() * number as f64 / FRAMES as f64;
    let ids: Vec<i64> = (0..).take(points.len()).collect();
    for number in 0..=FRAMES {
        let motion = Motion { ids: Some(ids.clone()), velocities: None };
        let frame = || Frame { number, points: points.clone(), motion, radii: None, densities: None };
        if (number + 1) % every <= 2 {
            frames.push(frame());
        } else if (number + 1 + reach) % every <= 2 + 2 * reach {
            around.push(frame());
        }
        flow.carry(&mut points, time(number), time(number + 1));
    }
    Set { name: name.into(), spacing, frames, around, kind: Kind::Flow(flow) }
}

/// A vector with components from −1 to 1.
fn random_offset(random: &mut Random) -> DVec3 {
    DVec3::from_array([(); 3].map(|()| 2.0 * random.unit() - 1.0))
}

/// Number of particles along the edges of the jittered pool.
const POOL_SIZE: IVec3 = IVec3::new(28, 28, 8);

const POOL_FRAMES: usize = 8;

/// A lattice in which each particle has a new random displacement in each frame.
fn jittered_pool() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let frame = |number: usize| {
        let mut random = Random::new(100 + number as u64);
        let mut points = Vec::new();
        for z in 0..POOL_SIZE.z {
            for y in 0..POOL_SIZE.y {
                for x in 0..POOL_SIZE.x {
                    let corner = IVec3::new(x, y, z).as_dvec3() + 0.5;
                    points.push(corner + JITTER * random_offset(&mut random));
                }
            }
        }
        points
    };
    let walls = [0.0, 0.0, POOL_SIZE.x.into(), POOL_SIZE.y.into()];
    ((0..POOL_FRAMES).map(frame).collect(), 1.0, Kind::Pool { rays: Rays::new(walls, Up::Z, 1.0) })
}

/// 50 000 random particles in a ball. The spacing is the edge of a cube with the volume per particle.
fn random_ball() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let mut random = Random::new(12);
    let points: Vec<DVec3> = (0..50_000).map(|_| random.in_ball(1.0)).collect();
    let spacing = (4.0 / 3.0 * PI / points.len() as f64).cbrt();
    (vec![points], spacing, Kind::Still)
}

/// Number of particles along the edges of sheets, and of threads.
const SHEET_SIZE: usize = 40;
const THREAD_SIZE: u32 = 200;

/// A wavy sheet of particles, at a distance of 1 from their neighbours along the sheet.
fn sheet() -> (Vec<Vec<DVec3>>, f64, Kind) {
    const STEPS: usize = 64;
    let (amplitude, wave) = (2.0, TAU / 20.0);
    let mut points = Vec::new();
    let mut x = 0.0;
    for _ in 0..SHEET_SIZE {
        let height = amplitude * (wave * x).sin();
        points.extend((0..SHEET_SIZE).map(|y| DVec3::new(x, y as f64, height)));
        for _ in 0..STEPS {
            let slope: f64 = amplitude * wave * (wave * x).cos();
            x += 1.0 / STEPS as f64 / slope.hypot(1.0);
        }
    }
    (vec![points], 1.0, Kind::Still)
}

/// A helix of particles, at a distance of 1 from their neighbours along the thread.
fn thread() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let (radius, rise_per_radian) = (6.0, 1.0);
    let step = 1.0 / f64::hypot(radius, rise_per_radian);
    let point = |index: u32| {
        let angle = step * f64::from(index);
        DVec3::new(radius * angle.cos(), radius * angle.sin(), rise_per_radian * angle)
    };
    (vec![(0..THREAD_SIZE).map(point).collect()], 1.0, Kind::Still)
}

/// A plane sheet, inclined to the grid, so that its particles have all positions relative to voxels.
fn plane_sheet() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let turn = random_turn(&mut Random::new(3));
    let row = |y: usize| (0..SHEET_SIZE).map(move |x| turn * DVec3::new(x as f64, y as f64, 0.0));
    (vec![(0..SHEET_SIZE).flat_map(row).collect()], 1.0, Kind::Still)
}

/// A straight thread, inclined to the grid.
fn straight_thread() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let turn = random_turn(&mut Random::new(4));
    (vec![(0..THREAD_SIZE).map(|x| turn * DVec3::new(x.into(), 0.0, 0.0)).collect()], 1.0, Kind::Still)
}

/// The numbers of particles of compact clusters.
const CLUSTERS: [usize; 8] = [1, 2, 4, 6, 8, 13, 33, 251];

/// How often a cluster of each size, and the pair, occur: each time at another position and in another
/// direction.
const PLACES: usize = 8;

/// Clusters of the points of a face-centred cubic lattice that are nearest to a random point. Neighbours are
/// 1.12 apart, so that the volume per point is 1.
fn clusters() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let mut random = Random::new(5);
    let cluster = |count: usize| {
        let (center, turn) = (random_offset(&mut random), random_turn(&mut random));
        compact(count, center).into_iter().map(|point| turn * point + center).collect()
    };
    (CLUSTERS.into_iter().flat_map(|count| [count; PLACES]).map(cluster).collect(), 1.0, Kind::Clusters)
}

/// The points of that lattice that are nearest to `center`, relative to it.
fn compact(count: usize, center: DVec3) -> Vec<DVec3> {
    const REACH: i32 = 7;
    let along = || -REACH..=REACH;
    let all = along().flat_map(|x| along().flat_map(move |y| along().map(move |z| IVec3::new(x, y, z))));
    // The integer points with an even sum have a volume of 2 each.
    let even = all.filter(|point| point.element_sum() % 2 == 0);
    let mut points: Vec<DVec3> = even.map(|point| point.as_dvec3() - center).collect();
    points.sort_by(|one, other| one.length_squared().total_cmp(&other.length_squared()));
    points.iter().take(count).map(|point| 0.5f64.cbrt() * *point).collect()
}

/// The numbers of particles of strips that weld; the last is a cluster like a ball.
pub(super) const WELDS: [usize; 4] = [1, 2, 4, 33];

/// How many frames a weld has, and how many welds, of which each occurs at other positions and in other directions, each
/// number of particles has.
pub(super) const WELD_FRAMES: usize = 60;
pub(super) const WELD_PLACES: usize = 4;

/// The distance of two strips in a frame: they approach at a steady speed to 0.9, and leave at the same speed. The
/// distances while they leave are others than those while they approach.
pub(super) fn weld_distance(frame: usize) -> f64 {
    0.9 + 0.07 * (frame as f64 - 29.25).abs()
}

/// Two strips that face each other, of which the second is the mirror image of the first. Both move through the grid at
/// a steady speed, too.
fn welds() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let mut random = Random::new(10);
    let mut frames = Vec::new();
    for count in WELDS {
        let strip = if count > 4 {
            compact(count, DVec3::ZERO)
        } else {
            (0..count).map(|y| DVec3::new(0.0, y as f64, 0.0)).collect()
        };
        let front = strip.iter().map(|point| point.x).fold(f64::NEG_INFINITY, f64::max);
        for _ in 0..WELD_PLACES {
            let (turn, middle) = (random_turn(&mut random), random_offset(&mut random));
            let speed = 0.03 * random_offset(&mut random);
            frames.extend((0..WELD_FRAMES).map(|frame| {
                let at = |point: &DVec3| *point - (front + 0.5 * weld_distance(frame)) * DVec3::X;
                let pair = strip.iter().map(at).flat_map(|at| [at, at * DVec3::new(-1.0, 1.0, 1.0)]);
                pair.map(|at| turn * at + middle + frame as f64 * speed).collect()
            }));
        }
    }
    (frames, 1.0, Kind::Welds)
}

/// The distances of approaching pairs: from 3 to 0.5 in steps of 0.05.
pub(super) fn pair_distances() -> impl Iterator<Item = f64> {
    (10..=60).rev().map(|step| 0.05 * f64::from(step))
}

fn pair() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let mut random = Random::new(6);
    let mut frames = Vec::new();
    for _ in 0..PLACES {
        let (direction, middle) = (random_turn(&mut random) * DVec3::X, random_offset(&mut random));
        frames.extend(
            pair_distances().map(|apart| [-0.5, 0.5].map(|side| middle + side * apart * direction).into()),
        );
    }
    (frames, 1.0, Kind::Pairs)
}

fn drop() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let mut random = Random::new(8);
    ((0..64).map(|_| vec![random_offset(&mut random)]).collect(), 1.0, Kind::Drops)
}

/// The radii of lone particles: six from 0.25 to 1, around 0.5.
pub(super) fn lone_radii() -> impl Iterator<Item = f64> {
    (0..6).map(|size| 0.25 * 4f64.powf(f64::from(size) / 5.0))
}

/// A row of particles that are too far apart to join, at several positions.
fn sizes() -> (Vec<Vec<DVec3>>, f64, Kind) {
    let mut random = Random::new(9);
    let row =
        |_| (0..6).map(|x| DVec3::new(12.0 * f64::from(x), 0.0, 0.0) + random_offset(&mut random)).collect();
    ((0..PLACES).map(row).collect(), 1.0, Kind::Sizes)
}

/// A rotation with a random axis, by a random angle.
fn random_turn(random: &mut Random) -> DQuat {
    DQuat::from_axis_angle(random.in_ball(1.0).normalize(), TAU * random.unit())
}

fn stem_of(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// The files in a folder that have an extension, sorted by the length of their names first, because some numbers
/// have no leading zeros.
fn paths_in(folder: &Path) -> Outcome<Vec<PathBuf>> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.path())).collect::<Result<_, _>>()?;
    paths.retain(|path| path.extension().is_some());
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    Ok(paths)
}

/// The frames in a folder, or those in a window.
fn frames_in(folder: &Path, window: Option<RangeInclusive<usize>>) -> Outcome<Vec<Frame>> {
    let paths = paths_in(folder)?;
    let window = window.unwrap_or(0..=paths.len().wrapping_sub(1));
    let chosen = paths.get(window.clone()).filter(|chosen| !chosen.is_empty());
    let chosen = chosen.ok_or_else(|| {
        format!("{}: the window is empty or beyond the {} frames", folder.display(), paths.len())
    })?;
    window.zip(chosen).map(|(number, path)| frame_in(path, number)).collect()
}

fn frame_in(path: &Path, number: usize) -> Outcome<Frame> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let bytes = fs::read(path).map_err(|error| format!("{}: {error}", path.display()))?;
    let read = read_particles(&bytes, &name, &Limits::default())?;
    let of_role = |role| read.attributes.iter().find(|attribute| attribute.role == Some(role));
    let (ids, velocities) =
        (of_role(AttributeRole::Id).and_then(integers), of_role(AttributeRole::Velocity).and_then(vectors));
    let positions = particles(read.positions);
    let points = (0..positions.len()).map(|index| positions.position(index)).collect();
    let densities = read.attributes.iter().find(|attribute| attribute.name == "density");
    let densities = densities.and_then(|attribute| match &attribute.values {
        Values::F32(numbers) => Some(numbers.clone()),
        _ => None,
    });
    Ok(Frame { number, points, motion: Motion { ids, velocities }, radii: None, densities })
}

/// The values of an integer attribute, as simulators write ids.
fn integers(attribute: &FileAttribute) -> Option<Vec<i64>> {
    match &attribute.values {
        Values::I32(numbers) => Some(numbers.iter().map(|&number| number.into()).collect()),
        Values::I64(numbers) => Some(numbers.clone()),
        _ => None,
    }
}

/// The values of a 3-vector attribute in single precision, as simulators write velocities.
fn vectors(attribute: &FileAttribute) -> Option<Vec<[f32; 3]>> {
    match &attribute.values {
        Values::F32(numbers) if attribute.arity == 3 => Some(numbers.as_chunks::<3>().0.to_vec()),
        _ => None,
    }
}
