//! Writes a sequence as one mesh whose attributes have a sample per frame.
//!
//! ```text
//!   point3f[] points.timeSamples = {
//!       1001: [(0.5, 1, 2), ..],
//!       1002: [..],
//!   }
//! ```
//!
//! The samples of an attribute are contiguous, so the writer visits all frames once per attribute. It reads
//! only the required data from their files, which are `.glb` files of this crate. At any time, only one
//! attribute of one frame and its text are in memory.
//!
//! USD allows samples with different numbers of vertices, and holds each until the next. Programs that
//! evaluate times between frames get blends of samples that happen to have the same number of vertices, so
//! they should not do that; for motion blur they can use `velocities`.

use std::io::{self, Read, Seek, Write};

use crate::data::Provenance;
use crate::error::{Error, Position, Result};
use crate::gltf::{FramePlacement, SequenceFrame, VertexColumn};
use crate::mesh_options::UpAxis;
use crate::vertex_attributes::UsedNames;

use super::FORMAT;
use super::arrays::Elements;
use super::head::{LAST_LINE, LayerInfo, head};
use super::numbers::triple;
use super::write::{RESERVED, identifier};

const PRIM: &str = "surface";

/// Time codes are 64-bit floats, which cannot distinguish integers beyond this.
const CODE_MAX: u64 = 1 << 53;

/// Writes a sequence of frames, whose numbers become the time codes and must increase. `open` opens the file
/// of a frame, by its index. Returns notes on attributes that are omitted because the frames differ in them.
///
/// # Errors
///
/// [`Error::Io`] if a file cannot be read or `out` fails; [`Error::Invalid`] if a document is damaged,
/// numbers do not increase, or frames differ in their up axis; [`Error::Unsupported`] for numbers beyond 2⁵³.
pub fn write_sequence<R: Read + Seek>(
    frames: &[SequenceFrame],
    (fps, meters_per_unit): (f64, f64),
    provenance: &Provenance,
    open: impl Fn(usize) -> io::Result<R>,
    out: &mut impl Write,
) -> Result<Vec<String>> {
    let shot = UsdaSequence::of(frames)?;
    let (mut vertices, mut faces) = (0, 0);
    for frame in frames {
        vertices += frame.file.vertex_count() as u64;
        faces += frame.file.triangle_count()? as u64;
    }
    let codes = [frames.first(), frames.last()].map(|frame| frame.map_or(0, |frame| frame.code));
    let info = LayerInfo { vertices, faces, frames: Some(frames.len() as u64) };
    let (end, start) =
        (format!("    endTimeCode = {}\n", codes[1]), format!("    startTimeCode = {}\n", codes[0]));
    let times = format!("{end}    framesPerSecond = {fps}\n{start}    timeCodesPerSecond = {fps}\n");
    let (attributes, notes) = shot.attributes()?;
    let head = head(provenance, &info, (shot.up, meters_per_unit), &times);
    write!(out, "{head}    def Mesh \"{PRIM}\"\n    {{\n")?;

    shot.write_extents(out)?;
    shot.write_samples("int[] faceVertexCounts", "", out, |index, _| {
        let triangles = vec![[0; 3]; frames[index].file.triangle_count()?];
        Ok(Elements::FaceCounts { triangles: &triangles, quads: &[] }.texts())
    })?;
    shot.write_samples("int[] faceVertexIndices", "", out, |index, _| {
        let triangles = frames[index].file.read_triangles(&mut open(index)?)?;
        Ok(Elements::FaceCorners { triangles: &triangles, quads: &[] }.texts())
    })?;
    out.write_all(b"        uniform token orientation = \"rightHanded\"\n")?;
    for attribute in &attributes {
        let SequenceAttribute { semantic, name, first, arity, about } = attribute;
        shot.write_samples(name, about, out, |index, property| {
            let frame = &frames[index].file;
            let Some(column) = frame.column(semantic)? else { return Ok(Vec::new()) };
            let scale = if semantic == POSITION { property.scale } else { 1.0 };
            let values = frame.read_column(&column, scale, &mut open(index)?)?;
            let (stride, first, arity) = (column.arity, *first, *arity);
            Ok(Elements::Reals { values: &values, stride, first, arity }.texts())
        })?;
    }
    out.write_all(b"        uniform token subdivisionScheme = \"none\"\n")?;
    shot.write_origins(out)?;
    let count = frames.len();
    write!(out, "    }}\n}}\n\n{LAST_LINE}{count} frames, {vertices} vertices, {faces} faces\n")?;
    Ok(notes)
}

const POSITION: &str = "POSITION";

/// The frames and their placements, `None` for frames without a mesh.
struct UsdaSequence<'a> {
    frames: &'a [SequenceFrame],
    properties: Vec<Option<FramePlacement>>,
    up: UpAxis,
}

/// A vertex attribute to write.
struct SequenceAttribute {
    /// Its name in the frames.
    semantic: String,
    /// Its type and name in USD.
    name: String,
    /// The range of its components to write: the first, and their number.
    first: usize,
    arity: usize,
    about: String,
}

const OF_VERTICES: &str = "            interpolation = \"vertex\"\n";

impl<'a> UsdaSequence<'a> {
    fn of(frames: &'a [SequenceFrame]) -> Result<UsdaSequence<'a>> {
        let invalid = |what: String| Error::invalid(FORMAT, Position::File, what);
        if let Some(pair) = frames.windows(2).find(|pair| pair[1].code <= pair[0].code) {
            let [a, b] = [0, 1].map(|index| (&pair[index].name, pair[index].code));
            return Err(invalid(format!("{} and {} have the time codes {} and {}", a.0, b.0, a.1, b.1)));
        }
        if let Some(SequenceFrame { name, code, .. }) = frames.last().filter(|frame| frame.code > CODE_MAX) {
            let what =
                format!("the frame number {code} of {name} exceeds the limit for time codes, {CODE_MAX}");
            return Err(Error::unsupported(FORMAT, what));
        }
        let property =
            |frame: &SequenceFrame| frame.file.has_mesh().then(|| frame.file.placement()).transpose();
        let properties: Vec<Option<FramePlacement>> = frames.iter().map(property).collect::<Result<_>>()?;
        let mut ups = properties.iter().flatten().map(|property| property.up);
        let up = ups.next().unwrap_or_default();
        match ups.all(|other| other == up) {
            true => Ok(UsdaSequence { frames, properties, up }),
            false => Err(invalid("some frames have y up and others z up".to_owned())),
        }
    }

    /// The attributes that all frames with a mesh have, and notes on the others.
    fn attributes(&self) -> Result<(Vec<SequenceAttribute>, Vec<String>)> {
        let files = || self.frames.iter().map(|frame| &frame.file).filter(|file| file.has_mesh());
        let attribute = |semantic: &str, name: &str, first, arity, about: &str| SequenceAttribute {
            semantic: semantic.to_owned(),
            name: name.to_owned(),
            first,
            arity,
            about: about.to_owned(),
        };
        let mut found = vec![
            attribute("NORMAL", "normal3f[] normals", 0, 3, OF_VERTICES),
            attribute(POSITION, "point3f[] points", 0, 3, ""),
        ];
        let mut names: Vec<&String> = Vec::new();
        for file in files() {
            names.extend(file.attributes()?.keys());
        }
        names.sort();
        names.dedup();
        names.retain(|name| !["NORMAL", POSITION].contains(&name.as_str()));
        let (mut notes, mut taken) = (Vec::new(), UsedNames::new(&RESERVED));
        for name in names {
            if files().any(|file| file.has_string_indices(name)) {
                notes.push(format!(
                    "{name} is missing in the sequence: its values are strings, and each frame has its own table"
                ));
                continue;
            }
            let columns: Vec<Option<VertexColumn>> =
                files().map(|file| file.column(name)).collect::<Result<_>>()?;
            let arities: Option<Vec<usize>> = columns.iter().map(|column| Some((*column)?.arity)).collect();
            let arity =
                arities.and_then(|arities| arities.iter().all(|a| *a == arities[0]).then_some(arities[0]));
            let Some(arity) = arity else {
                notes.push(format!(
                    "{name} is missing in the sequence: not all frames have it with the same number of values per vertex"
                ));
                continue;
            };
            match (name.as_str(), arity) {
                ("_VELOCITY", 3) => found.push(attribute(name, "vector3f[] velocities", 0, 3, "")),
                ("COLOR_0", 3 | 4) => {
                    found.push(attribute(name, "color3f[] primvars:displayColor", 0, 3, OF_VERTICES));
                    let opacity = attribute(name, "float[] primvars:displayOpacity", 3, 1, OF_VERTICES);
                    found.extend((arity == 4).then_some(opacity));
                }
                _ => {
                    let kind = if arity == 1 { "float".to_owned() } else { format!("float{arity}") };
                    // In the frames, names start with an underscore and are in upper case.
                    let wanted = identifier(name.strip_prefix('_').unwrap_or(name)).to_ascii_lowercase();
                    let plain = taken.take(&wanted, |stem| vec![stem.to_owned()]).concat();
                    if plain != wanted {
                        notes.push(format!("{name} is named primvars:{plain} in the sequence"));
                    }
                    let property = format!("{kind}[] primvars:{plain}");
                    found.push(attribute(name, &property, 0, arity, OF_VERTICES));
                }
            }
        }
        Ok((found, notes))
    }

    /// Writes an array with a sample per frame, formatted by `texts`; the sample is empty for a frame without
    /// a mesh.
    fn write_samples(
        &self,
        name: &str,
        about: &str,
        out: &mut impl Write,
        texts: impl Fn(usize, &FramePlacement) -> Result<Vec<Vec<u8>>>,
    ) -> Result<()> {
        if !about.is_empty() {
            write!(out, "        {name} (\n{about}        )\n")?;
        }
        writeln!(out, "        {name}.timeSamples = {{")?;
        for (index, frame) in self.frames.iter().enumerate() {
            write!(out, "            {}: [", frame.code)?;
            if let Some(property) = &self.properties[index] {
                for text in texts(index, property)? {
                    out.write_all(&text)?;
                }
            }
            out.write_all(b"],\n")?;
        }
        out.write_all(b"        }\n")?;
        Ok(())
    }

    /// Writes a line per frame. If frames are missing before the next one, repeats the line just before it,
    /// because USD interpolates between samples of the same shape.
    fn write_lines(
        &self,
        name: &str,
        out: &mut impl Write,
        line: impl Fn(usize) -> Result<String>,
    ) -> Result<()> {
        writeln!(out, "        {name}.timeSamples = {{")?;
        for (index, frame) in self.frames.iter().enumerate() {
            let line = line(index)?;
            writeln!(out, "            {}: {line},", frame.code)?;
            let held = self.frames.get(index + 1).map(|next| next.code - 1).filter(|&held| held > frame.code);
            held.map(|held| writeln!(out, "            {held}: {line},")).transpose()?;
        }
        out.write_all(b"        }\n")?;
        Ok(())
    }

    fn write_extents(&self, out: &mut impl Write) -> Result<()> {
        self.write_lines("float3[] extent", out, |index| {
            let scale = self.properties[index].map_or(0.0, |property| property.scale);
            let [low, high] = self.frames[index].file.bounds()?.map(|corner| {
                #[expect(clippy::cast_possible_truncation, reason = "positions have 32 bits")]
                corner.map(|x| (x * scale) as f32)
            });
            Ok(format!("[{}, {}]", triple(low), triple(high)))
        })
    }

    /// Writes the origins of the frames, unless all are zero.
    fn write_origins(&self, out: &mut impl Write) -> Result<()> {
        // A frame without a mesh keeps the origin of the previous one.
        let origin = |index: usize| {
            let property = self.properties[..=index].iter().rev().flatten().next();
            property.map_or([0.0; 3], |property| property.origin)
        };
        if (0..self.frames.len()).all(|index| origin(index) == [0.0; 3]) {
            return Ok(());
        }
        self.write_lines("double3 xformOp:translate", out, |index| Ok(triple(origin(index))))?;
        out.write_all(b"        uniform token[] xformOpOrder = [\"xformOp:translate\"]\n")?;
        Ok(())
    }
}
