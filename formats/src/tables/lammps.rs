//! Text dumps of LAMMPS and LIGGGHTS: a table of particles for each time step, all in one file.
//!
//! ```text
//!   ITEM: TIMESTEP
//!   1000
//!   ITEM: NUMBER OF ATOMS
//!   2
//!   ITEM: BOX BOUNDS pp pp ff             or  xy xz yz pp pp ff: with the tilt factors of a triclinic box,
//!   0 10                                  or  abc origin pp pp ff: with its three edges and its origin
//!   0 10
//!   -0.5 20
//!   ITEM: ATOMS id type x y z vx vy vz radius
//!   1 1 0.5 0.25 1 0 0 -1 0.01
//!   2 1 0.75 0.25 1 0 0 -1 0.01
//!   ITEM: TIMESTEP                        and so on
//! ```
//!
//! `UNITS` and `TIME` sections can occur as well. The position is in the columns `x y z`; else in `xu yu zu`,
//! which are not wrapped into the periodic box; else in `xs ys zs` or `xsu ysu zsu`, which are fractions of
//! the box. The rows are read like those of any other table. If the last row has no line end, a note says so:
//! the last number of a dump that is still being written may lack digits.

use std::ops::Range;

use crate::core::data::{FilePositions, ParticleFrame};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::steps::{FoundStep, StepSource, end_at};
use crate::core::text::{excerpt, excerpts};
use crate::tables::csv;

/// The format's name in errors.
pub(crate) const FORMAT: &str = "LAMMPS dump";

/// One time step of a dump.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeStep {
    /// The step number.
    pub timestep: i64,
    /// Number of particles.
    pub particle_count: u64,
    /// The simulated time, if the dump has it, in the dump's units.
    pub time: Option<f64>,
    /// The byte range of this step in the dump.
    pub range: Range<usize>,
    /// Offset of the first row.
    rows_at: usize,
    /// Line number of the first row, starting at 1.
    rows_line: u64,
    /// The line with the column names, as a byte range of the dump.
    header: Range<usize>,
    /// The box, if the dump has it.
    space: Option<Space>,
}

/// Maps fractions of the box to positions.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Space {
    corner: [f64; 3],
    /// The three edges.
    edges: [[f64; 3]; 3],
}

/// Reads the only step of a dump.
///
/// # Errors
///
/// Those of [`steps`] and [`read_step`]; [`Error::Unsupported`] for a dump with several steps, which are
/// several frames.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    match &steps(bytes, limits)?[..] {
        [only] => read_step(bytes, only, limits),
        all => {
            let [first, last] = [all.first(), all.last()].map(|step| step.map_or(0, |step| step.timestep));
            let what = format!(
                "the dump has {} time steps, {first} to {last}: \
                 read each step separately",
                all.len()
            );
            Err(Error::unsupported(FORMAT, what))
        }
    }
}

/// The steps of a dump, at least one. Does not check their rows.
///
/// # Errors
///
/// [`Error::Truncated`] if the dump ends within a step, [`Error::Invalid`] for an unexpected line,
/// [`Error::Unsupported`] for dumps of anything but atoms, [`Error::TooLarge`] beyond `limits`.
pub fn steps(bytes: &[u8], limits: &Limits) -> Result<Vec<TimeStep>> {
    let mut lines = DumpLines { bytes, at: 0, number: 0 };
    let mut steps = Vec::new();
    // Ends at the blank lines that may follow the last step. Before a step, the check looks at only one byte,
    // because no step starts with a blank line.
    while lines.bytes[lines.at..].iter().any(|byte| !byte.is_ascii_whitespace()) {
        limits.check_step(FORMAT, steps.len())?;
        steps.push(step(&mut lines, limits)?);
    }
    if steps.is_empty() { Err(lines.truncated("expected ITEM: TIMESTEP")) } else { Ok(steps) }
}

/// Reads one step of the dump in which it was found.
///
/// # Errors
///
/// [`Error::Invalid`], with the line, if a row has the wrong number of cells or text in a numeric column, or
/// if the columns have no position.
pub fn read_step(bytes: &[u8], step: &TimeStep, limits: &Limits) -> Result<ParticleFrame> {
    let header = String::from_utf8_lossy(bytes.get(step.header.clone()).unwrap_or_default());
    let names = header.split_ascii_whitespace().skip(2); // ITEM: ATOMS
    let mut names: Vec<String> =
        names.take(limits.attribute_count.saturating_add(1)).map(String::from).collect();
    let header_line = Position::Line(step.rows_line.saturating_sub(1));
    limits.check_attributes(FORMAT, names.len(), "columns or more")?;
    let found = excerpts(&names);
    let no_position = || {
        Error::invalid(
            FORMAT,
            header_line,
            format!("no position columns, such as x y z or xs ys zs; found: {found}"),
        )
    };
    let (position, is_scaled) = position(&names).ok_or_else(no_position)?;
    for (name, column) in ["x", "y", "z"].into_iter().zip(position) {
        // An incomplete position beside the one that is read.
        for other in names.iter_mut().filter(|other| *other == name) {
            *other = format!("other_{name}");
        }
        name.clone_into(&mut names[column]);
    }
    let table = bytes.get(..step.range.end).unwrap_or_default();
    let rows = csv::CountedRows {
        names,
        position,
        offset: step.rows_at,
        line: step.rows_line,
        count: step.particle_count,
    };
    let mut frame = match step.particle_count {
        0 => ParticleFrame::default(),
        _ => csv::read_rows(table, rows, limits)
            .map_err(|error| error.with_format(FORMAT))?
            .ok_or_else(no_position)?,
    };
    if step.particle_count != 0 {
        frame.notes.extend(crate::core::text::open_end_note(table));
    }
    if is_scaled {
        let no_box = || {
            Error::invalid(
                FORMAT,
                header_line,
                "positions are fractions of the box, but ITEM: BOX BOUNDS is missing",
            )
        };
        frame.positions = unscaled(frame.positions, step.space.ok_or_else(no_box)?);
        frame.notes.push("positions are fractions of the box: converted to lengths".into());
    }
    Ok(frame)
}

/// The columns of the first position in `POSITIONS` that the dump has, and whether they are fractions of the
/// box.
fn position(names: &[String]) -> Option<([usize; 3], bool)> {
    const POSITIONS: [([&str; 3], bool); 4] = [
        (["x", "y", "z"], false),
        (["xu", "yu", "zu"], false),
        (["xs", "ys", "zs"], true),
        (["xsu", "ysu", "zsu"], true),
    ];
    let column_of = |name: &str| names.iter().position(|found| found == name);
    POSITIONS
        .iter()
        .find_map(|([x, y, z], is_scaled)| Some(([column_of(x)?, column_of(y)?, column_of(z)?], *is_scaled)))
}

/// Converts fractions of the box to positions. These have 64 bits, to lose no further digits: in a large box,
/// the six digits of a fraction give few decimals of a position.
fn unscaled(fractions: FilePositions, space: Space) -> FilePositions {
    let position = |fraction: [f64; 3]| {
        let along = |axis: usize| {
            let edges = fraction.iter().zip(space.edges).map(|(part, edge)| part * edge[axis]);
            space.corner[axis] + edges.sum::<f64>()
        };
        [along(0), along(1), along(2)]
    };
    FilePositions::F64(fractions.into_f64().into_iter().map(position).collect())
}

/// Parses the step that starts at the next line.
fn step(lines: &mut DumpLines, limits: &Limits) -> Result<TimeStep> {
    let start = lines.at;
    let (mut timestep, mut count, mut time) = (None, None, None);
    let mut space = None;
    loop {
        let item_at = lines.at;
        let item = lines.text_line("an ITEM")?;
        let item = item.strip_prefix("ITEM:").map(str::trim).ok_or_else(|| lines.expected("ITEM:", item))?;
        match item {
            "TIMESTEP" => timestep = Some(lines.number("the number of the time step")?),
            "TIME" => time = Some(lines.reals::<1>("the time")?[0]),
            "UNITS" => drop(lines.text_line("the units")?),
            "NUMBER OF ATOMS" => count = Some(lines.number("the number of atoms")?),
            _ if item.starts_with("BOX BOUNDS") => space = Some(box_bounds(item, lines)?),
            _ if item.starts_with("ATOMS") => {
                let missing = |what: &str| lines.invalid(format!("ITEM: ATOMS before {what}"));
                let timestep = timestep.ok_or_else(|| missing("ITEM: TIMESTEP"))?;
                let count = count.ok_or_else(|| missing("ITEM: NUMBER OF ATOMS"))?;
                let count = u64::try_from(count)
                    .map_err(|_| lines.invalid(format!("the number of atoms is {count}")))?;
                return rows(
                    lines,
                    start,
                    TimeStep {
                        timestep,
                        particle_count: count,
                        time,
                        range: 0..0,
                        rows_at: lines.at,
                        rows_line: lines.number + 1,
                        header: item_at..lines.at,
                        space,
                    },
                    limits,
                );
            }
            _ => {
                let what = format!(
                    "this dump contains `{}`, not atoms: dump atoms or custom columns",
                    excerpt(item)
                );
                return Err(Error::unsupported(FORMAT, what));
            }
        }
    }
}

/// Skips the rows of the step.
fn rows(lines: &mut DumpLines, start: usize, step: TimeStep, limits: &Limits) -> Result<TimeStep> {
    let count = step.particle_count;
    limits.check_particles(FORMAT, count)?;
    for found in 0..count {
        let line =
            lines.next().ok_or_else(|| lines.truncated(format!("expected {count} atoms, found {found}")))?;
        if line.starts_with(b"ITEM:") {
            return Err(lines.invalid(format!("expected {count} atoms, found {found}")));
        }
    }
    Ok(TimeStep { range: start..lines.at, ..step })
}

/// Parses the three lines of box bounds, which have one of three forms.
fn box_bounds(item: &str, lines: &mut DumpLines) -> Result<Space> {
    let words: Vec<&str> = item.split_ascii_whitespace().skip(2).collect();
    match words[..] {
        ["abc", "origin", ..] => {
            let rows = [(); 3].map(|()| lines.reals::<4>("an edge of the box and its corner"));
            let [a, b, c] = rows;
            let [a, b, c] = [a?, b?, c?];
            let edges = [a, b, c].map(|[x, y, z, _]| [x, y, z]);
            Ok(Space { corner: [a[3], b[3], c[3]], edges })
        }
        ["xy", "xz", "yz", ..] => {
            let rows = [(); 3].map(|()| lines.reals::<3>("bounds of the box and a tilt"));
            let [x, y, z] = rows;
            let ([x_low, x_high, xy], [y_low, y_high, xz], [z_low, z_high, yz]) = (x?, y?, z?);
            // The bounds are those of the axis-aligned box around the tilted one.
            let x_low = x_low - 0f64.min(xy).min(xz).min(xy + xz);
            let x_high = x_high - 0f64.max(xy).max(xz).max(xy + xz);
            let (y_low, y_high) = (y_low - 0f64.min(yz), y_high - 0f64.max(yz));
            let edges = [[x_high - x_low, 0.0, 0.0], [xy, y_high - y_low, 0.0], [xz, yz, z_high - z_low]];
            Ok(Space { corner: [x_low, y_low, z_low], edges })
        }
        _ => {
            let rows = [(); 3].map(|()| lines.reals::<2>("bounds of the box"));
            let [x, y, z] = rows;
            let [x, y, z] = [x?, y?, z?];
            let length = |[low, high]: [f64; 2]| high - low;
            let edges = [[length(x), 0.0, 0.0], [0.0, length(y), 0.0], [0.0, 0.0, length(z)]];
            Ok(Space { corner: [x[0], y[0], z[0]], edges })
        }
    }
}

/// The lines of the dump.
struct DumpLines<'a> {
    bytes: &'a [u8],
    at: usize,
    /// The number of the last returned line, starting at 1.
    number: u64,
}

impl<'a> DumpLines<'a> {
    /// The next line without its line end.
    fn next(&mut self) -> Option<&'a [u8]> {
        let rest = self.bytes.get(self.at..).filter(|rest| !rest.is_empty())?;
        let length = rest.iter().position(|&byte| byte == b'\n');
        let line = &rest[..length.unwrap_or(rest.len())];
        self.at += line.len() + usize::from(length.is_some());
        self.number += 1;
        Some(line)
    }

    /// The next line as text; `what` is named in the error if the line is missing or truncated.
    fn text_line(&mut self, what: &str) -> Result<&'a str> {
        let Some(line) = self.next() else { return Err(self.truncated(format!("expected {what}"))) };
        if !self.bytes[..self.at].ends_with(b"\n") {
            return Err(self.truncated(format!("the file ends within {what}: the line end is missing")));
        }
        std::str::from_utf8(line).map(str::trim).map_err(|_| self.invalid("expected text, found binary data"))
    }

    fn number(&mut self, what: &str) -> Result<i64> {
        let text = self.text_line(what)?;
        text.parse().map_err(|_| self.expected(what, text))
    }

    /// The first floats of the next line.
    fn reals<const N: usize>(&mut self, what: &str) -> Result<[f64; N]> {
        let text = self.text_line(what)?;
        let mut reals = [0.0; N];
        let mut words = text.split_ascii_whitespace();
        for real in &mut reals {
            let word = words.next().and_then(|word| fast_float2::parse(word).ok());
            *real = word.ok_or_else(|| self.expected(what, text))?;
        }
        Ok(reals)
    }

    fn expected(&self, what: &str, found: &str) -> Error {
        self.invalid(format!("expected {what}, found `{}`", excerpt(found)))
    }

    fn invalid(&self, what: impl Into<String>) -> Error {
        Error::invalid(FORMAT, Position::Line(self.number), what)
    }

    fn truncated(&self, what: impl Into<String>) -> Error {
        Error::truncated(FORMAT, Position::Line(self.number), what)
    }
}

/// The row in the table of formats.
pub(crate) static ROW: FormatRow = FormatRow {
    beginnings: &[b"ITEM: TIMESTEP\n"],
    particles: Some(ParticleReader { find_steps: Some(steps_of_dump), ..ParticleReader::new(read) }),
    ..FormatRow::new(FORMAT, &["dump", "lammpstrj"])
};

/// Finds the steps of a LAMMPS dump. A step starts at the first `ITEM:` line after the rows of the previous
/// step. If a step lacks its rows, it ends at the next `ITEM: TIMESTEP`.
fn steps_of_dump(mut lines: StepSource, steps: &mut Vec<FoundStep>, limits: &Limits) -> Result<()> {
    let mut is_first = true;
    let (mut is_numbered, mut is_in_rows, mut is_number_next) = (false, false, false);
    while let Some(start) = lines.next_line()? {
        let line = lines.head.trim_ascii();
        if let Some(item) = line.strip_prefix(b"ITEM:").map(<[u8]>::trim_ascii) {
            let is_timestep = item == b"TIMESTEP";
            if is_first || is_in_rows || (is_timestep && is_numbered) {
                is_first = false;
                end_at(steps, start);
                limits.check_step("LAMMPS dump", steps.len())?;
                steps.push(FoundStep::of_text(None, start, &lines));
                is_numbered = false;
            }
            is_numbered |= is_timestep;
            is_number_next = is_timestep;
            is_in_rows = item.starts_with(b"ATOMS") || item.starts_with(b"ENTRIES");
        } else if is_number_next {
            is_number_next = false;
            if let Some(step) = steps.last_mut() {
                step.number = std::str::from_utf8(line).ok().and_then(|number| number.parse().ok());
            }
        } else if is_first && !line.is_empty() {
            is_first = false;
            steps.push(FoundStep::of_text(None, start, &lines));
        }
    }
    end_at(steps, lines.end);
    Ok(())
}
