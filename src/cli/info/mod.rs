//! `meniscus info`: prints the contents of files.
//!
//! The structs here and in `contents` define the JSON; the text shows the same values.

mod contents;

use std::collections::BTreeMap;
use std::error::Error;
use std::fmt;
use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::{io, iter};

use anyhow::{Result, anyhow, bail};
use meniscus_formats::{
    Codec, Format, Limits, Loaded, MeshData, Neighbor, OutputFormat, Probe, ProbedKind, abc, escaped, gltf,
    neighbor, ply, probe, read_mesh, read_particles, read_provenance, usda, usdc, vdb, vtk,
};
use serde::Serialize;

use crate::pipeline::{
    FrameError, USD_STAGE_FRAMES, file_of, frames_in, frames_in_unless, has_container_frames, is_absent,
    measure_spacing, natural_order, open_regular, read_file, read_particles_of, read_regular,
    read_scene_mesh, reading_limits, step_of, time_of_frame,
};

use crate::surface::options::{ColumnNames, ReadOptions, SpacingOptions};

use super::args::InfoArgs;
use super::console::{Console, json_text};
use super::inputs::find_inputs;
use super::wording::{shortest, with_causes};
use super::{CommandOutcome, DoneCounts};

use contents::{GridRecord, MeshInfo, ParticlesInfo, SequenceFileRecord};

/// One file.
#[derive(Debug, Default, Serialize)]
struct FileInfo {
    file: String,
    kind: String,
    gzipped: bool,
    /// The compression, in words: `gzipped`, `compressed with zstd`.
    #[serde(skip_serializing_if = "Option::is_none")]
    packed: Option<&'static str>,
    bytes: usize,
    /// The time of the frame in seconds, if the file states it.
    #[serde(skip_serializing_if = "Option::is_none")]
    time: Option<f64>,
    /// Warnings for the user about a file that was read.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    notes: Vec<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    particles: Option<ParticlesInfo>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mesh: Option<MeshInfo>,
    #[serde(skip_serializing_if = "Option::is_none")]
    grids: Option<Vec<GridRecord>>,
    /// Programs read it as `shot`, so the JSON keeps this name.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[serde(rename = "shot")]
    sequence: Option<SequenceFileRecord>,
    /// The contents of a .usda of meniscus.
    #[serde(skip_serializing_if = "Option::is_none")]
    layer: Option<LayerRecord>,
    /// What meniscus recorded in the file about how it was made.
    #[serde(skip_serializing_if = "Option::is_none")]
    made_by: Option<BTreeMap<String, String>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// The contents of a .usda.
#[derive(Debug, Serialize)]
struct LayerRecord {
    vertices: u64,
    faces: u64,
}

/// Prints the contents of each file; an unreadable file is reported as an error, and the others are still
/// printed.
///
/// # Errors
/// If the result cannot be written as JSON.
pub(super) fn info(args: &InfoArgs, console: &mut Console) -> Result<CommandOutcome> {
    let mut counts = DoneCounts::default();
    let mut array = JsonArray::default();
    for given in &args.files {
        // Steps are read one at a time, because a file may have a million of them.
        for path in files_of(given, console) {
            let info = file_info(&path, args.columns.as_ref());
            if args.json {
                array.add(&info, console)?;
            }
            match &info.error {
                Some(error) => {
                    console.error(format_args!("{}: {error}", info.file));
                }
                None if !args.json => console.print_lines(info.to_string().lines()),
                None => {}
            }
            counts.add(info.error.is_none());
        }
    }
    if args.json {
        array.end(console);
    }
    Ok(counts.outcome())
}

/// The files that the arguments name: of a folder or a pattern, those that `convert` takes. A file with several steps
/// yields each step; a file whose steps cannot be listed is returned as it is, and reading it reports the error.
fn files_of(path: &Path, console: &mut Console) -> Box<dyn Iterator<Item = PathBuf>> {
    let alone = Box::new(iter::once(path.to_owned()));
    if (path.symlink_metadata().is_ok() && !path.is_dir()) || step_of(path).is_some() {
        return match frames_in_unless(path, &AtomicBool::new(false)) {
            Ok(frames) => Box::new(frames.paths()),
            Err(_) => alone,
        };
    }
    // A pattern without matches is reported like a missing file.
    let Ok(found) = find_inputs(&[path.to_owned()], None) else { return alone };
    found.report(console);
    let mut paths: Vec<PathBuf> = found.files.into_iter().map(|file| file.path).collect();
    paths.sort_by(|one, other| natural_order(&one.to_string_lossy(), &other.to_string_lossy()));
    Box::new(paths.into_iter())
}

/// Prints a JSON array, each element as soon as the next one is known.
#[derive(Debug, Default)]
struct JsonArray {
    /// The last element is held back, because a comma follows unless it stays the last.
    last: Option<String>,
}

impl JsonArray {
    fn add(&mut self, element: &impl Serialize, console: &mut Console) -> serde_json::Result<()> {
        match self.last.replace(indented(&json_text(element)?)) {
            Some(before) => console.print_raw(&format!("{before},")),
            None => console.print_raw("["),
        }
        Ok(())
    }

    fn end(self, console: &mut Console) {
        console.print_raw(&self.last.map_or("[]".to_owned(), |last| format!("{last}\n]")));
    }
}

/// The lines of an element of a JSON array, indented.
fn indented(json: &str) -> String {
    json.lines().map(|line| format!("  {line}")).collect::<Vec<_>>().join("\n")
}

fn file_info(path: &Path, columns: Option<&ColumnNames>) -> FileInfo {
    let mut info = FileInfo { file: path.to_string_lossy().into_owned(), ..FileInfo::default() };
    // A panic in a reader affects this file only.
    let result = catch_unwind(AssertUnwindSafe(|| info.fill(path, columns)))
        .unwrap_or_else(|_| Err(anyhow!("internal error; please report it, with the file")));
    info.error = result.err().map(|error| with_causes(&error));
    info
}

impl FileInfo {
    fn fill(&mut self, path: &Path, columns: Option<&ColumnNames>) -> Result<()> {
        check_file(path)?;
        let content = if step_of(path).is_some() {
            read_file(path).map_err(|error| reason(&error))?
        } else {
            // A file with too many frames is refused before it is read as a whole. It may also be a mesh.
            match frames_in(path) {
                Err(meniscus_formats::Error::Unsupported { .. }) => {}
                frames => drop(frames?),
            }
            if self.fill_large_sequence(path)? {
                return Ok(());
            }
            if has_container_frames(path) {
                read_file(path).map_err(|error| reason(&error))?
            } else {
                Loaded::Bytes(read_regular(path)?)
            }
        };
        self.time = time_of_frame(path);
        match content {
            Loaded::Bytes(bytes) => self.fill_content(path, bytes, columns),
            Loaded::Particles(format, _) => {
                self.kind = format.name().to_owned();
                self.bytes = usize::try_from(file_of(path).metadata()?.len())?;
                self.fill_particles(path, content, columns)
            }
        }
    }

    /// Describes the bytes of a file.
    fn fill_content(&mut self, path: &Path, bytes: Vec<u8>, columns: Option<&ColumnNames>) -> Result<()> {
        let name = file_of(path).file_name().unwrap_or_default().to_string_lossy();
        let Probe { kind, codec } = probe(&bytes, &name);
        self.kind = kind.name().to_owned();
        self.gzipped = codec == Some(Codec::Gzip);
        self.packed = codec.map(Codec::adjective);
        self.bytes = bytes.len();
        self.made_by = if codec.is_none() { made_by(kind, &bytes) } else { None };
        let limits = reading_limits();
        let is_surface = match kind.format() {
            Some(format) if codec.is_none() => self.fill_surface(path, format, &bytes, &limits)?,
            Some(format) if is_only_mesh(format, &bytes, &name) => {
                self.mesh = Some(MeshInfo::of(&read_mesh_alone(&bytes, &name, &limits)?));
                true
            }
            _ => false,
        };
        if !is_surface {
            // This includes other compressed files. Compressed level sets are refused here.
            self.fill_particles(path, Loaded::Bytes(bytes), columns)?;
        }
        Ok(())
    }

    fn fill_particles(&mut self, path: &Path, content: Loaded, columns: Option<&ColumnNames>) -> Result<()> {
        let frame = read_particles_of(path, content, columns).map_err(|error| reason(&error))?;
        self.notes.clone_from(&frame.notes);
        let reading = ReadOptions { columns: columns.cloned(), filter: None };
        let measured = measure_spacing([path], &SpacingOptions { reading, ..SpacingOptions::default() }).ok();
        let (particles, shared) = ParticlesInfo::of(frame, measured.as_ref());
        self.particles = Some(particles);
        self.notes.extend(shared.map(|warning| warning.to_string()));
        Ok(())
    }

    /// Describes a sequence in an `.abc`, which may be larger than the memory, by the ends of the file. Returns false
    /// for other files.
    fn fill_large_sequence(&mut self, path: &Path) -> Result<bool> {
        let mut file = open_regular(path)?;
        let mut head = Vec::new();
        Read::by_ref(&mut file).take(HEAD_BYTES).read_to_end(&mut head)?;
        if !abc::is_archive(&head) {
            return Ok(false);
        }
        let made_by = made_by(ProbedKind::Format(Format::Abc), &head);
        if !made_by.as_ref().is_some_and(|made_by| made_by.contains_key(gltf::SEQUENCE_FRAMES)) {
            return Ok(false);
        }
        let Some(read) = abc::read_sequence_info(&mut file).transpose() else { return Ok(false) };
        // These are known, and printed, even if the sequence is damaged.
        self.kind = Format::Abc.name().to_owned();
        self.bytes = usize::try_from(file.metadata()?.len())?;
        self.made_by = made_by;
        let (info, attributes) = read?;
        self.set_sequence(info, attributes);
        Ok(true)
    }

    /// Describes a surface: grids, a mesh, a layer or a sequence of meshes. Returns false for files that are
    /// read as particles.
    fn fill_surface(&mut self, path: &Path, format: Format, bytes: &[u8], limits: &Limits) -> Result<bool> {
        let name = &*file_of(path).file_name().unwrap_or_default().to_string_lossy();
        match format {
            Format::Vdb => {
                self.grids = Some(vdb::grids(bytes, limits)?.into_iter().map(GridRecord::from).collect());
            }
            Format::Glb | Format::Gltf => match gltf::read_sequence_info(bytes)? {
                Some(info) => self.set_sequence(info, gltf::read_attribute_names(bytes)?),
                None => {
                    let mesh = MeshInfo::of(&gltf::read_mesh(bytes, limits)?);
                    self.mesh = Some(mesh.with_attributes(&gltf::read_attributes(bytes, limits)?));
                }
            },
            // Other programs write no summary.
            Format::Usda | Format::Usdc | Format::Usdz | Format::Abc if self.made_by.is_none() => {
                let (mesh, is_animated) = match read_scene_mesh(path) {
                    Ok(Some(found)) => found,
                    // Without meshes, it may have particles; their reader says what it has.
                    Ok(None) | Err(meniscus_formats::Error::Unsupported { .. }) => return Ok(false),
                    Err(error) => return Err(error.into()),
                };
                self.mesh = Some(MeshInfo::of(&mesh));
                let note = "the meshes are animated: these are those of the first samples";
                self.notes.extend(is_animated.then(|| note.to_owned()));
            }
            Format::Usda => match usda::read_layer_info(bytes)? {
                Some(usda::LayerInfo { vertices, faces }) => {
                    self.layer = Some(LayerRecord { vertices, faces });
                }
                None => self.notes.extend(self.made_by.iter().map(|made_by| stage_note(made_by, bytes))),
            },
            Format::Usdc => {
                let frame = usdc::UsdcLayer::read(bytes, limits)?.frame()?;
                self.mesh = Some(MeshInfo::of(&frame.mesh).with_attributes(&frame.attributes));
            }
            Format::Abc => {
                let attributes = abc::read_attributes(bytes, limits)?;
                self.mesh = Some(MeshInfo::of(&abc::read_mesh(bytes, limits)?).with_attributes(&attributes));
            }
            Format::Vtp if vtk::holds_polys(bytes) => {
                let mesh = vtk::read_mesh(bytes, limits)?;
                let vertices = read_particles(bytes, name, limits)?;
                // The polygons are reported as a mesh, so the note that they are ignored is omitted.
                let notes = vertices.notes.iter().filter(|note| *note != vtk::POLYGONS_NOTE);
                self.notes = notes.cloned().collect();
                self.mesh = Some(MeshInfo::of(&mesh).with_attributes(&vertices.attributes));
            }
            Format::Ply if ply::holds_mesh(bytes, limits)? => {
                let (mesh, vertices) = ply::read_mesh_and_vertices(bytes, limits)?;
                self.notes.clone_from(&vertices.notes);
                self.mesh = Some(MeshInfo::of(&mesh).with_attributes(&vertices.attributes));
            }
            format if is_only_mesh(format, bytes, name) => {
                self.mesh = Some(MeshInfo::of(&read_mesh_alone(bytes, name, limits)?));
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    fn set_sequence(&mut self, info: gltf::SequenceInfo, attributes: Vec<String>) {
        self.kind += ", a sequence file";
        self.sequence = Some(SequenceFileRecord::new(info, attributes, self.made_by.as_ref()));
    }
}

/// Refuses a path without a file, and says why.
fn check_file(path: &Path) -> Result<()> {
    if path.is_dir() {
        bail!(
            "this is a folder without particles: give the files in it, or a pattern such as {}",
            path.join("*.glb").display()
        );
    }
    if path.symlink_metadata().is_err_and(|error| is_absent(path, &error)) && step_of(path).is_none() {
        bail!("no such file or folder");
    }
    if path.is_symlink() && path.metadata().is_err_and(|error| error.kind() == io::ErrorKind::NotFound) {
        bail!("this link leads to a file that does not exist");
    }
    Ok(())
}

/// Whether a file of this format can only be a mesh.
fn is_only_mesh(format: Format, bytes: &[u8], name: &str) -> bool {
    let has_faces = || format == Format::Obj && neighbor(bytes, name, &bytes) == Some(Neighbor::Mesh);
    format.has_mesh() && !format.has_particles() || has_faces()
}

/// Reads a mesh, compressed or not. Fails if parts of it are in other files.
fn read_mesh_alone(bytes: &[u8], name: &str, limits: &Limits) -> meniscus_formats::Result<MeshData> {
    let no_files = |_: &str| -> io::Result<Vec<u8>> { Err(io::ErrorKind::NotFound.into()) };
    read_mesh(bytes, name, limits, &no_files)
}

/// Why a step cannot be read, without the name of the step, which the caller prints.
fn reason(error: &FrameError) -> anyhow::Error {
    error.source().map_or_else(|| anyhow!("{error}"), |source| anyhow!("{source}"))
}

/// What a stage plays, and when.
fn stage_note(made_by: &BTreeMap<String, String>, bytes: &[u8]) -> String {
    let frames = made_by.get(USD_STAGE_FRAMES).map_or("its", String::as_str);
    let times = usda::read_times(bytes).map_or_else(String::new, |([first, last], fps)| {
        format!(", from time code {first} to {last}, at {fps} frames per second")
    });
    format!("a stage: it plays the files of {frames} frames{times}")
}

/// Bytes at the start of a file that contain the provenance.
const HEAD_BYTES: u64 = 64 << 10;

/// What meniscus recorded in a file about how it was made; `None` for files of other programs.
fn made_by(kind: ProbedKind, bytes: &[u8]) -> Option<BTreeMap<String, String>> {
    // The metadata of a .vdb are printed with each grid.
    let format = kind.format().and_then(Format::output).filter(|format| *format != OutputFormat::Vdb)?;
    // The reader of the file reports errors.
    let pairs: BTreeMap<String, String> = read_provenance(format, bytes).ok()?.into_iter().collect();
    (!pairs.is_empty()).then_some(pairs)
}

impl fmt::Display for FileInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let packed = self.packed.map(|packed| format!(", {packed}")).unwrap_or_default();
        write!(f, "{}: {}{packed}, {} bytes", escaped(&self.file), self.kind, self.bytes)?;
        self.sequence.iter().try_for_each(|sequence| write!(f, "{sequence}"))?;
        self.mesh.iter().try_for_each(|mesh| write!(f, "{mesh}"))?;
        self.time.iter().try_for_each(|time| row(f, "time", format_args!("{} s", shortest(*time))))?;
        self.particles.iter().try_for_each(|particles| write!(f, "{particles}"))?;
        for grid in self.grids.iter().flatten() {
            write!(f, "{grid}")?;
        }
        if let Some(LayerRecord { vertices, faces }) = &self.layer {
            row(f, "vertices", vertices)?;
            row(f, "faces", faces)?;
        }
        self.made_by.iter().try_for_each(|made_by| block(f, "made with", made_by))?;
        for note in &self.notes {
            row(f, "note", note)?;
        }
        Ok(())
    }
}

/// One line of text: a label and a value.
fn row(f: &mut fmt::Formatter<'_>, label: &str, value: impl fmt::Display) -> fmt::Result {
    write!(f, "\n  {label:<20} {}", escaped(value))
}

/// A heading, and below it a line of text for each name and value.
fn block(f: &mut fmt::Formatter<'_>, heading: &str, values: &BTreeMap<String, String>) -> fmt::Result {
    if values.is_empty() {
        return Ok(());
    }
    write!(f, "\n  {heading}")?;
    let line = |(name, value)| write!(f, "\n    {:<18} {}", escaped(name).to_string(), escaped(value));
    values.iter().try_for_each(line)
}

/// A vector as text.
fn vector(components: &[String]) -> String {
    format!("({})", components.join(", "))
}

/// A box in world units.
#[derive(Clone, Copy, Debug, Serialize)]
struct BoundingBox {
    min: [f64; 3],
    max: [f64; 3],
}

impl BoundingBox {
    /// The bounding box of the finite positions; `None` if there are no finite ones.
    fn of(positions: impl Iterator<Item = [f64; 3]>) -> Option<BoundingBox> {
        let finite = positions.filter(|position| position.iter().all(|x| x.is_finite()));
        finite.fold(None, |bounds: Option<BoundingBox>, position| {
            let BoundingBox { mut min, mut max } =
                bounds.unwrap_or(BoundingBox { min: position, max: position });
            for axis in 0..3 {
                min[axis] = min[axis].min(position[axis]);
                max[axis] = max[axis].max(position[axis]);
            }
            Some(BoundingBox { min, max })
        })
    }

    /// The same box for 32-bit positions: its numbers are printed with the digits of 32-bit numbers.
    fn with_f32_digits(self) -> BoundingBox {
        BoundingBox { min: self.min.map(f32_digits), max: self.max.map(f32_digits) }
    }
}

/// The `f64` that prints with the digits of this `f32`: 1.4 and not 1.399999976158142.
fn f32_digits(value: f64) -> f64 {
    (value as f32).to_string().parse().unwrap_or(value)
}

impl fmt::Display for BoundingBox {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [min, max] = [self.min, self.max].map(|corner| vector(&corner.map(shortest)));
        write!(f, "{min} to {max}")
    }
}
