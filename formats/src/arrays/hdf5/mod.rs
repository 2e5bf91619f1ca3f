//! Particles in HDF5 files: a hierarchy of groups with data sets and attributes, whose names each program
//! chooses.
//!
//! ```text
//!   /PartType0/Coordinates (N, 3), Velocities, ParticleIDs ..           GADGET, SWIFT: PartType0 is gas
//!   /particles/fluid/arrays/x (N), y, z, u, v, w, rho ..                PySPH
//!   /Step#0/x (N), y, z ..   /Step#1/ ..                                H5Part: a frame for each step
//!   /frame_0/pos (N, 3) ..   or /0, /frames/0                           scripts: the same
//!   /data/100/particles/water/position/x (N) ..                         openPMD: a frame for each iteration
//!   /VTKHDF/Points (N, 3), PointData/v                                  VTK
//!   /any/group/pos (N, 3), vel   or   x (N), y, z   or records          any other program
//!   /pos (T, N, 3), vel                                                 scripts: T frames
//! ```
//!
//! A group has particles if its data sets have names by which `crate::core::named_arrays` finds a position. The
//! groups nearest to the root are used. If they are several, one of them is the fluid, and a note names the
//! others; the species of openPMD are all read.
//!
//! Specifications: HDF5 File Format Specification 3.0, openPMD 1.1, H5Part, the manuals of GADGET-2 and SWIFT.

mod file;

use std::cmp::Reverse;
use std::collections::HashSet;
use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use hdf5_reader::group::Group;

use crate::core::batches::ReadAt;
use crate::core::columns::position_rank;
use crate::core::container::{ContainerFile, ContainerFrames, ContainerReader, ReadFrame, Sample, frame_at};
use crate::core::data::{FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::{
    ArrayShape, ParticlePart, frame_of, joined_parts, named_position, paired_position, position_count,
    unnamed_position_count,
};
use crate::core::number::wide;
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::text::{excerpt, excerpts};
use file::{
    HdfFile, HdfTable, OpenFile, StackedStep, UnreadPosition, attributes_of, number_in, with_file,
    with_open_file,
};

/// The format's name in errors.
const FORMAT: &str = "HDF5";

const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";

/// Whether the signature is behind a user block of up to 4 KiB, as in files of MATLAB.
pub(crate) fn has_user_block(head: &[u8]) -> bool {
    [512, 1024, 2048, 4096].iter().any(|at| head.get(*at..).is_some_and(|rest| rest.starts_with(SIGNATURE)))
}

/// The row in the table of formats.
pub(crate) static ROW: FormatRow = FormatRow {
    signatures: &[SIGNATURE],
    beginnings: &[SIGNATURE],
    particles: Some(ParticleReader::container(ContainerReader::new(frames))),
    ..FormatRow::new(FORMAT, &["h5", "hdf5", "hdf", "h5part"])
};

/// The frames of a file, in the order of their numbers; none if it has no particles.
///
/// # Errors
/// [`Error::Truncated`] if the file is not complete, [`Error::Invalid`] if it is damaged,
/// [`Error::Unsupported`] for what `hdf5-reader` cannot read, [`Error::TooLarge`] beyond `limits`.
pub fn frames(container: &ContainerFile, limits: &Limits) -> Result<ContainerFrames> {
    let found = OpenSteps::find(container.file, limits)?;
    let sample = |file: &HdfFile, step: &HdfStep| {
        let time = if step.stack.is_some() { None } else { time_of(file, &step.group)? };
        Ok(Sample { number: step.number, time })
    };
    let samples = with_open_file(&found.file, container.file, limits, |file| {
        let steps = found.steps.iter().filter(|_| found.have_particles);
        steps.map(|step| sample(file, step)).collect::<Result<Vec<_>>>()
    })?;
    // Only further frames need the structure again.
    let kept = Mutex::new((samples.len() > 1).then(|| Arc::new(found)));
    Ok(ContainerFrames::new(samples, HdfSteps(kept)))
}

/// An open file with its steps.
struct OpenSteps {
    file: OpenFile,
    /// At least one.
    steps: Vec<HdfStep>,
    /// False for a file without particles, whose only step is the whole file.
    have_particles: bool,
    /// The size of the data that were read with it, in bytes: `hdf5-reader` may keep them.
    read_bytes: AtomicU64,
}

/// After this size of data the file is opened again, and its steps are found again.
const KEPT_BYTES_MAX: u64 = 128 << 20;

impl OpenSteps {
    fn find(file: &dyn ReadAt, limits: &Limits) -> Result<OpenSteps> {
        let ((steps, have_particles), file) = with_file(file, limits, |file| {
            let mut steps = steps(file)?;
            let have_particles = !steps.is_empty();
            if !have_particles {
                if file.lacks_position.get() == Some(UnreadPosition::Unusable) {
                    let mut notes = Vec::new();
                    find_particles(file, &file.root()?, &mut notes)?;
                    return Err(no_particles(file, notes));
                }
                steps.push(HdfStep { number: 0, group: file.root()?, stack: None });
            }
            Ok((steps, have_particles))
        })?;
        Ok(OpenSteps { file, steps, have_particles, read_bytes: AtomicU64::new(0) })
    }
}

/// Reads the steps of a file. Keeps the file that they were found in, unless it has only one.
struct HdfSteps(Mutex<Option<Arc<OpenSteps>>>);

impl HdfSteps {
    fn kept(&self) -> MutexGuard<'_, Option<Arc<OpenSteps>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for HdfSteps {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list()
            .entries(self.kept().iter().flat_map(|found| &found.steps).map(|step| step.number))
            .finish()
    }
}

impl ReadFrame for HdfSteps {
    fn read(&self, container: &ContainerFile, index: usize, limits: &Limits) -> Result<ParticleFrame> {
        let kept = self.kept().clone();
        let found = match &kept {
            Some(found) => Arc::clone(found),
            None => Arc::new(OpenSteps::find(container.file, limits)?),
        };
        let step = frame_at(FORMAT, &found.steps, index)?;
        let frame = with_open_file(&found.file, container.file, limits, |file| {
            file.stack.set(step.stack);
            let mut notes = Vec::new();
            let groups = find_particles(file, &step.group, &mut notes)?;
            let frame =
                if groups.is_empty() { Err(no_particles(file, notes)) } else { frame(file, groups, notes) };
            found.read_bytes.fetch_add(file.spent_bytes(), Ordering::Relaxed);
            frame
        })?;
        let is_full = found.read_bytes.load(Ordering::Relaxed) > KEPT_BYTES_MAX;
        if found.steps.len() > 1 {
            *self.kept() = (!is_full).then_some(found);
        }
        Ok(frame)
    }
}

/// The numbers of a data set, given by its path; it must have this many.
///
/// # Errors
/// Those of [`frames`], and [`Error::Invalid`] if the data set is missing, not numeric or of another length.
pub(crate) fn read_values(file: &dyn ReadAt, path: &str, count: u64, limits: &Limits) -> Result<Values> {
    with_file(file, limits, |file| {
        let (group, name) = path.rsplit_once('/').unwrap_or(("", path));
        let mut notes = Vec::new();
        let table = file.table(&file.group(&file.root()?, group)?, name, &mut notes)?;
        let invalid = |what: &str| Error::invalid(FORMAT, Position::File, what);
        let table = table.ok_or_else(|| invalid(notes.first().map_or("", |note| note)))?;
        let [field] = &table.fields[..] else { return Err(invalid("expected numbers, found records")) };
        let found = table.row_count.saturating_mul(field.arity as u64);
        if found != count {
            let what = format!("`{}` has {found} numbers, and {count} were expected", excerpt(path));
            return Err(invalid(&what));
        }
        let array = file.read(table)?.pop().ok_or_else(|| invalid("expected numbers"))?;
        Ok(array.values)
    })
    .map(|(values, _)| values)
}

/// The group of a frame.
struct HdfStep {
    number: i64,
    group: Group,
    /// If all steps are in the same data sets: the part of this one.
    stack: Option<StackedStep>,
}

/// What stands before the number in the name of a step's group: H5Part's, and those of scripts.
const STEP_PREFIXES: &[&str] = &["Step#", "frame_", "step_", "frame", "step", "t", ""];

/// Groups of the root that have a group for each step: openPMD's, and those of scripts.
const STEP_PARENTS: &[&str] = &["data", "frames", "steps"];

/// The steps of the file; none if it has no particles. A file without steps is itself the only one.
fn steps(file: &HdfFile) -> Result<Vec<HdfStep>> {
    let root = file.root()?;
    let groups = file.groups(&root)?;
    if groups.iter().any(|group| group.name() == "h5md") {
        let what = "H5MD is not read: save the positions of each step as a data set pos of shape (N, 3)";
        return Err(Error::unsupported(FORMAT, what));
    }
    let parents = groups.iter().filter(|group| STEP_PARENTS.contains(&group.name()));
    let below: Vec<Vec<Group>> = parents.map(|parent| file.groups(parent)).collect::<Result<_>>()?;
    let mut steps = Vec::new();
    for groups in [groups].iter().chain(&below) {
        if steps.is_empty() {
            steps = numbered_steps(file, groups)?;
        }
    }
    if steps.is_empty() && has_particles(file, &root)? {
        steps.push(HdfStep { number: 0, group: root, stack: None });
    } else if steps.is_empty() {
        let count = stacked_steps(file, &root)?.unwrap_or_default();
        if let Some(last) = count.checked_sub(1) {
            file.limits.check_step(FORMAT, usize::try_from(last).unwrap_or(usize::MAX))?;
        }
        let step = |(index, number)| {
            let stack = Some(StackedStep { index, count });
            HdfStep { number, group: root.clone(), stack }
        };
        steps = (0..count).zip(0..).map(step).collect();
    }
    if let Some(last) = steps.len().checked_sub(1) {
        file.limits.check_step(FORMAT, last)?;
    }
    steps.sort_by_key(|step| step.number);
    Ok(steps)
}

/// The number of steps that data sets of a group are stacks of: the first axis of a position of shape (T, N, 3); `None` if
/// there is none.
fn stacked_steps(file: &HdfFile, group: &Group) -> Result<Option<u64>> {
    let (_, data_sets) = file.members(group)?;
    let (mut names, mut counts) = (Vec::new(), Vec::new());
    for name in &data_sets {
        if let Ok(data) = group.dataset(name)
            && let [count, _, 3] = *data.shape()
        {
            names.push(&**name);
            counts.push(count);
        }
    }
    let position = named_position(&names).or_else(|| paired_position(&names));
    Ok(position.map(|index| counts[index]))
}

/// The steps among groups: those with the first prefix of which one has particles. Iterations can have fields only.
fn numbered_steps(file: &HdfFile, groups: &[Group]) -> Result<Vec<HdfStep>> {
    for prefix in STEP_PREFIXES {
        let step = |group: &Group| {
            let number = group.name().strip_prefix(prefix)?.parse().ok()?;
            Some(HdfStep { number, group: group.clone(), stack: None })
        };
        let steps: Vec<HdfStep> = groups.iter().filter_map(step).collect();
        for step in &steps {
            if has_particles(file, &step.group)? {
                return Ok(steps);
            }
        }
    }
    Ok(Vec::new())
}

fn has_particles(file: &HdfFile, step: &Group) -> Result<bool> {
    Ok(!find_particles(file, step, &mut Vec::new())?.is_empty())
}

/// Where an openPMD file has particles, below each iteration; `None` for other files.
fn particles_path(file: &HdfFile) -> Result<Option<String>> {
    let attributes = attributes_of(&file.root()?)?;
    let text = |name: &str| attributes.iter().find(|attribute| attribute.name == name)?.read_string().ok();
    let path = || text("particlesPath").unwrap_or_else(|| "particles".to_owned());
    Ok(text("openPMD").map(|_| path().trim_matches('/').to_owned()))
}

/// The group at a path below another one, if there is one.
fn group_below(file: &HdfFile, group: &Group, path: &str) -> Result<Option<Group>> {
    let mut group = group.clone();
    for name in path.split('/') {
        if !file.members(&group)?.0.iter().any(|found| found == name) {
            return Ok(None);
        }
        group = file.group(&group, name)?;
    }
    Ok(Some(group))
}

/// The time that a step states, or that a header or the solver's data beside the particles state.
fn time_of(file: &HdfFile, group: &Group) -> Result<Option<f64>> {
    let (groups, _) = file.members(group)?;
    let beside = groups.iter().filter(|name| ["Header", "solver_data"].contains(&&***name));
    let mut all = vec![attributes_of(group)?];
    for name in beside {
        all.push(attributes_of(&file.group(group, name)?)?);
    }
    let time = |attributes: &Vec<_>| {
        let time = number_in(attributes, &["TimeValue", "Time", "time", "t"])?;
        Some(time * number_in(attributes, &["timeUnitSI"]).unwrap_or(1.0))
    };
    Ok(all.iter().find_map(time))
}

/// A group with particles.
#[derive(Default)]
struct ParticleGroup {
    path: String,
    tables: Vec<HdfTable>,
    particle_count: usize,
    /// Notes on its data sets.
    notes: Vec<String>,
}

/// How far below a step particles are searched.
const DEPTH_MAX: usize = 4;

/// Names of the fluid among several kinds of particles.
const FLUIDS: &[&str] = &["fluid", "water", "liquid"];

/// Finds the particles of a step: one group, or the species of openPMD. The notes are on the choice or, if there are
/// no particles, on data sets.
fn find_particles(file: &HdfFile, step: &Group, notes: &mut Vec<String>) -> Result<Vec<ParticleGroup>> {
    let named = groups_with(file, step, position_count, true, notes)?;
    if !named.is_empty() {
        *notes = Vec::new();
        let are_species = particles_path(file)?.is_some();
        return Ok(if are_species { named } else { vec![chosen(named, notes)] });
    }
    if file.lacks_position.get().is_some() {
        return Ok(Vec::new());
    }
    // Any vector can be a position without a name: the longest is the most likely one.
    let mut found = groups_with(file, step, unnamed_position_count, false, &mut Vec::new())?;
    found.sort_by_key(|group| Reverse(group.particle_count));
    let is_longest = found.get(1).is_none_or(|second| second.particle_count < found[0].particle_count);
    found.truncate(usize::from(is_longest));
    if !found.is_empty() {
        *notes = Vec::new();
    }
    Ok(found)
}

/// The groups of a step in whose tables `count` finds particles; only those nearest to the root if `nearest` is true.
fn groups_with(
    file: &HdfFile,
    step: &Group,
    count: fn(&[ArrayShape]) -> Option<usize>,
    nearest: bool,
    notes: &mut Vec<String>,
) -> Result<Vec<ParticleGroup>> {
    // Beside the particles of openPMD are meshes, whose components have the same names.
    let mut level = match particles_path(file)? {
        Some(path) => {
            let below = group_below(file, step, &path)?;
            below.map(|group| (format!("/{path}"), group)).into_iter().collect()
        }
        None => vec![(String::new(), step.clone())],
    };
    let mut visited: HashSet<u64> = level.iter().map(|(_, group)| group.address()).collect();
    let mut found = Vec::new();
    for _ in 0..=DEPTH_MAX {
        let mut below = Vec::new();
        for (path, group) in level {
            let (mut groups, data_sets) = file.members(&group)?;
            let mut own_notes = Vec::new();
            let tables = tables_of(file, &group, &path, (&groups, &data_sets), &mut own_notes)?;
            if let Some(particle_count) = count_of(&tables, count) {
                found.push(ParticleGroup { path: path.clone(), tables, particle_count, notes: own_notes });
                if nearest {
                    continue;
                }
            } else {
                notes.extend(own_notes);
            }
            // SWIFT has further names for the groups of GADGET.
            groups.sort_by_key(|name| !name.starts_with("PartType"));
            for name in groups {
                let group = file.group(&group, &name)?;
                if visited.insert(group.address()) {
                    below.push((format!("{path}/{name}"), group));
                }
            }
            file.limits.check_attributes(FORMAT, visited.len(), "groups")?;
        }
        if nearest && !found.is_empty() {
            break;
        }
        level = below;
    }
    Ok(found)
}

/// The fluid among the groups, or the first one.
fn chosen(mut found: Vec<ParticleGroup>, notes: &mut Vec<String>) -> ParticleGroup {
    let is_fluid = |group: &ParticleGroup| {
        let path = group.path.to_ascii_lowercase();
        FLUIDS.iter().any(|name| path.contains(name))
    };
    let chosen = found.remove(found.iter().position(is_fluid).unwrap_or(0));
    if !found.is_empty() {
        notes.push(format!(
            "only the particles of `{}` were read, not those of {}",
            shown_path(&chosen.path),
            excerpts(found.iter().map(|group| group.path.trim_start_matches('/')))
        ));
    }
    chosen
}

fn shown_path(path: &str) -> String {
    if path.is_empty() { "/".to_owned() } else { excerpt(path.trim_start_matches('/')) }
}

/// The tables of a group, which may have particles, with the names of its attributes.
fn tables_of(
    file: &HdfFile,
    group: &Group,
    path: &str,
    (groups, data_sets): (&[String], &[String]),
    notes: &mut Vec<String>,
) -> Result<Vec<HdfTable>> {
    let mut tables = Vec::new();
    for name in data_sets {
        tables.extend(file.table(group, name, notes)?);
    }
    if path.ends_with("/VTKHDF") {
        if groups.iter().any(|name| name == "Steps") {
            let what = "VTKHDF files with steps are not supported: save each step as a file, .vtp or .vtkhdf";
            return Err(Error::unsupported(FORMAT, what));
        }
        if groups.iter().any(|name| name == "PointData") {
            let data = file.group(group, "PointData")?;
            for name in &file.members(&data)?.1 {
                tables.extend(file.table(&data, name, notes)?);
            }
        }
    }
    if groups.iter().any(|name| position_rank(name).is_some()) {
        for name in groups {
            tables.extend(record(file, &file.group(group, name)?, name, notes)?);
        }
    }
    if path.ends_with("/arrays") {
        name_velocity(&mut tables);
    }
    Ok(tables)
}

/// A record of openPMD: a group with a data set, or a constant, for each component; or itself a constant.
fn record(file: &HdfFile, group: &Group, name: &str, notes: &mut Vec<String>) -> Result<Vec<HdfTable>> {
    let (groups, data_sets) = file.members(group)?;
    let constant = |group: &Group, name: String| {
        let attributes = attributes_of(group)?;
        let (value, shape) = (number_in(&attributes, &["value"]), number_in(&attributes, &["shape"]));
        let count = shape.filter(|count| (0.0..9e15).contains(count));
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in range")]
        Ok::<_, Error>(value.zip(count).map(|(value, count)| HdfTable::constant(name, value, count as u64)))
    };
    let mut tables: Vec<HdfTable> = constant(group, name.to_owned())?.into_iter().collect();
    for component in &groups {
        tables.extend(constant(&file.group(group, component)?, format!("{name}_{component}"))?);
    }
    for component in &data_sets {
        if let Some(mut table) = file.table(group, component, notes)? {
            let unit = number_in(&table.attributes(), &["unitSI"]);
            if position_rank(name).is_some()
                && component == "x"
                && let Some(unit) = unit.filter(|&unit| unit != 1.0)
            {
                notes.push(format!("positions are in units of {unit} m"));
            }
            table.fields.iter_mut().for_each(|field| field.name = format!("{name}_{component}"));
            tables.push(table);
        }
    }
    Ok(tables)
}

/// Gives the velocity of PySPH, u v w, a name that is recognised. Elsewhere, these can be displacements.
fn name_velocity(tables: &mut [HdfTable]) {
    const NAMES: [(&str, &str); 3] = [("u", "velocity_x"), ("v", "velocity_y"), ("w", "velocity_z")];
    let fields = || tables.iter().flat_map(|table| &table.fields);
    if NAMES.iter().all(|(name, _)| fields().any(|field| field.name == *name)) {
        for field in tables.iter_mut().flat_map(|table| &mut table.fields) {
            if let Some((_, name)) = NAMES.iter().find(|(name, _)| field.name == *name) {
                field.name = (*name).to_owned();
            }
        }
    }
}

/// The number of particles that `count` finds in the tables.
fn count_of(tables: &[HdfTable], count: fn(&[ArrayShape]) -> Option<usize>) -> Option<usize> {
    let mut described = Vec::new();
    for table in tables {
        let row_count = usize::try_from(table.row_count).unwrap_or(usize::MAX);
        described.extend(table.fields.iter().map(|field| ArrayShape {
            name: &field.name,
            arity: field.arity,
            row_count,
            is_real: field.is_real(),
        }));
    }
    count(&described)
}

/// Reads groups. Those of openPMD are joined, and their particles have the name of their group as the attribute `species`.
fn frame(file: &HdfFile, mut groups: Vec<ParticleGroup>, mut notes: Vec<String>) -> Result<ParticleFrame> {
    let are_species = particles_path(file)?.is_some();
    let arrays = if let [only] = &mut groups[..]
        && !are_species
    {
        arrays_of(file, std::mem::take(only), &mut notes)?
    } else {
        if groups.len() > 1 {
            notes.push(format!("joined the particles of {} species", groups.len()));
        }
        let mut parts = Vec::new();
        for group in groups {
            let (table, count) = (vec![group_name(&group.path).to_owned()], group.particle_count);
            let mut arrays = arrays_of(file, group, &mut notes)?;
            let values = Values::Strings { table, indices: vec![0; count] };
            arrays.push(FileAttribute::new("species", 1, values));
            // The positions are still among the arrays.
            parts.push(ParticlePart { positions: FilePositions::F32(vec![[0.0; 3]; count]), arrays });
        }
        joined_parts(parts, "species", &mut notes).arrays
    };
    let mut frame = frame_of(None, arrays).ok_or_else(|| no_particles(file, Vec::new()))?;
    frame.notes.append(&mut notes);
    frame.notes.extend(file.notes());
    Ok(frame)
}

/// The last part of a path.
fn group_name(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or_default()
}

/// Reads the tables of a group that have a row for each particle.
fn arrays_of(file: &HdfFile, group: ParticleGroup, notes: &mut Vec<String>) -> Result<Vec<FileAttribute>> {
    let mut arrays = Vec::new();
    notes.extend(group.notes);
    for table in group.tables {
        if table.row_count == group.particle_count as u64 {
            arrays.extend(file.read(table)?);
        } else if table.row_count > 0 {
            // PySPH has empty data sets for what it does not save.
            notes.push(format!(
                "skipped `{}`: it has {} rows for {} particles",
                table.fields.first().map_or(String::new(), |field| excerpt(&field.name)),
                table.row_count,
                group.particle_count
            ));
        }
    }
    file.limits.check_attributes(FORMAT, arrays.len(), "attributes")?;
    let offsets: Vec<FileAttribute> =
        arrays.extract_if(.., |array| array.name.starts_with("positionOffset_")).collect();
    if offsets.iter().any(|offset| wide(&offset.values).iter().any(|&value| value != 0.0)) {
        let what =
            "the positions have offsets (positionOffset), which are not supported: add them to the positions";
        return Err(Error::unsupported(FORMAT, what));
    }
    Ok(arrays)
}

fn no_particles(file: &HdfFile, notes: Vec<String>) -> Error {
    let (groups, data_sets) = file.root().and_then(|root| file.members(&root)).unwrap_or_default();
    let members: Vec<String> = groups.into_iter().map(|name| name + "/").chain(data_sets).collect();
    let mut what = format!(
        "expected a group with a data set `pos` of shape (N, 3), or x, y and z of shape (N), at most {DEPTH_MAX} groups \
         deep; the file has {}",
        if members.is_empty() { "no groups or data sets".to_owned() } else { excerpts(&members) }
    );
    for note in notes.into_iter().chain(file.notes()).take(4) {
        what += "; ";
        what += &note;
    }
    Error::invalid(FORMAT, Position::File, what)
}
