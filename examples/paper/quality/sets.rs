//! Sets of input particles: generated ones, and frames in files.

use std::f64::consts::{PI, TAU};
use std::fs;
use std::path::{Path, PathBuf};

use glam::{DVec3, IVec3};
use meniscus::pipeline::particles;
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
    pub(super) kind: Kind,
}

pub(super) struct Frame {
    pub(super) number: usize,
    pub(super) points: Vec<DVec3>,
    pub(super) motion: Motion,
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
}

impl Set {
    /// The file name of a frame's particles, and of its mesh, for other programs.
    pub(super) fn file_name(&self, frame: &Frame) -> String {
        format!("{}.{:04}.ply", self.name.replace(' ', "_"), frame.number)
    }

    fn still(name: &str, spacing: f64, points: Vec<DVec3>) -> Set {
        let frames = vec![Frame { number: 0, points, motion: Motion::default() }];
        Set { name: name.into(), spacing, frames, kind: Kind::Still }
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

const POOL: &str = "jittered pool";
const STILLS: [(&str, Generate); 3] = [("random ball", random_ball), ("sheet", sheet), ("thread", thread)];

/// Generates particles; also returns their spacing.
type Generate = fn() -> (Vec<DVec3>, f64);

/// The selected sets.
pub(super) struct Sets {
    /// Names of generated sets; `None` for all except slow ones.
    only: Option<Vec<String>>,
    /// Of a flow, three consecutive frames around each multiple of this number are used.
    every: usize,
    /// Files with their spacing.
    files: Vec<(PathBuf, f64)>,
    /// Folders with their spacing and the seconds between two frames.
    moving: Vec<(PathBuf, f64, f64)>,
    /// Folders of pools with their spacing.
    pools: Vec<(PathBuf, f64)>,
    /// The walls of the pools in folders.
    walls: [f64; 4],
    up: Up,
}

impl Default for Sets {
    fn default() -> Sets {
        let (files, moving, pools) = (Vec::new(), Vec::new(), Vec::new());
        Sets { only: None, every: 10, files, moving, pools, walls: [0.0; 4], up: Up::Z }
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
                let form = "moving=FOLDER:SPACING:SECONDS";
                let (rest, seconds) = value.rsplit_once(':').ok_or(form)?;
                let (folder, spacing) = with_number(rest, form)?;
                self.moving.push((folder, spacing, seconds.parse()?));
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
            visitor(in_flow(name, flow, count, jitter, self.every))?;
        }
        if self.wants(POOL) {
            visitor(jittered_pool())?;
        }
        for (name, generate) in STILLS.into_iter().filter(|still| self.wants(still.0)) {
            let (points, spacing) = generate();
            visitor(Set::still(name, spacing, points))?;
        }
        for (path, spacing) in &self.files {
            visitor(Set::still(&stem_of(path), *spacing, frame_in(path, 0)?.points))?;
        }
        for (folder, spacing, seconds) in &self.moving {
            let (frames, kind) = (frames_in(folder)?, Kind::Moving { seconds: *seconds });
            visitor(Set { name: stem_of(folder), spacing: *spacing, frames, kind })?;
        }
        for (folder, spacing) in &self.pools {
            let kind = Kind::Pool { rays: Rays::new(self.walls, self.up, *spacing) };
            visitor(Set { name: stem_of(folder), spacing: *spacing, frames: frames_in(folder)?, kind })?;
        }
        Ok(())
    }
}

fn generated_names() -> impl Iterator<Item = &'static str> {
    FLOWS.iter().map(|flow| flow.0).chain([POOL]).chain(STILLS.iter().map(|still| still.0))
}

fn in_flow(name: &str, flow: Flow, count: usize, jitter: f64, every: usize) -> Set {
    let (mut points, spacing) = particles_in(flow, count);
    let mut random = Random::new(7);
    for point in &mut points {
        *point += jitter * spacing * random_offset(&mut random);
    }
    let mut frames = Vec::new();
    let time = |number: usize| flow.period() * number as f64 / FRAMES as f64;
    for number in 0..=FRAMES {
        if (number + 1) % every <= 2 {
            frames.push(Frame { number, points: points.clone(), motion: Motion::default() });
        }
        flow.carry(&mut points, time(number), time(number + 1));
    }
    Set { name: name.into(), spacing, frames, kind: Kind::Flow(flow) }
}

/// A vector with components from −1 to 1.
fn random_offset(random: &mut Random) -> DVec3 {
    DVec3::from_array([(); 3].map(|()| 2.0 * random.unit() - 1.0))
}

/// Number of particles along the edges of the jittered pool.
const POOL_SIZE: IVec3 = IVec3::new(28, 28, 8);

const POOL_FRAMES: usize = 8;

/// A lattice in which each particle has a new random displacement in each frame.
fn jittered_pool() -> Set {
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
        Frame { number, points, motion: Motion::default() }
    };
    let walls = [0.0, 0.0, POOL_SIZE.x.into(), POOL_SIZE.y.into()];
    let kind = Kind::Pool { rays: Rays::new(walls, Up::Z, 1.0) };
    Set { name: POOL.into(), spacing: 1.0, frames: (0..POOL_FRAMES).map(frame).collect(), kind }
}

/// 50 000 random particles in a ball. The spacing is the edge of a cube with the volume per particle.
fn random_ball() -> (Vec<DVec3>, f64) {
    let mut random = Random::new(12);
    let points: Vec<DVec3> = (0..50_000).map(|_| random.in_ball(1.0)).collect();
    let spacing = (4.0 / 3.0 * PI / points.len() as f64).cbrt();
    (points, spacing)
}

/// A wavy sheet of 40 by 40 particles, at a distance of 1 from their neighbours along the sheet.
fn sheet() -> (Vec<DVec3>, f64) {
    const COUNT: usize = 40;
    const STEPS: usize = 64;
    let (amplitude, wave) = (2.0, TAU / 20.0);
    let mut points = Vec::new();
    let mut x = 0.0;
    for _ in 0..COUNT {
        let height = amplitude * (wave * x).sin();
        points.extend((0..COUNT).map(|y| DVec3::new(x, y as f64, height)));
        for _ in 0..STEPS {
            let slope: f64 = amplitude * wave * (wave * x).cos();
            x += 1.0 / STEPS as f64 / slope.hypot(1.0);
        }
    }
    (points, 1.0)
}

/// A helix of 200 particles, at a distance of 1 from their neighbours along the thread.
fn thread() -> (Vec<DVec3>, f64) {
    let (radius, rise_per_radian) = (6.0, 1.0);
    let step = 1.0 / f64::hypot(radius, rise_per_radian);
    let point = |index: u32| {
        let angle = step * f64::from(index);
        DVec3::new(radius * angle.cos(), radius * angle.sin(), rise_per_radian * angle)
    };
    ((0..200).map(point).collect(), 1.0)
}

fn stem_of(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// All frames in a folder, sorted by the length of their names first: some numbers have no leading zeros.
fn frames_in(folder: &Path) -> Outcome<Vec<Frame>> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.path())).collect::<Result<_, _>>()?;
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    if paths.is_empty() {
        return Err(format!("{}: no frames", folder.display()).into());
    }
    paths.iter().enumerate().map(|(number, path)| frame_in(path, number)).collect()
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
    Ok(Frame { number, points, motion: Motion { ids, velocities } })
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
