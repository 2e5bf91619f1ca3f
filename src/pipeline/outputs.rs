//! Which files a run will write, and that none of them replaces an input.
//!
//! Names are compared after links are followed, in two ways: the entry in its folder that a rename
//! would replace, and the file that the name leads to. On Unix the file's own identity is compared
//! too, which also sees through hard links, bind mounts and file systems that ignore case.

use std::collections::HashMap;
use std::fmt;
use std::fs;
use std::ops::{Not, RangeInclusive};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

pub use meniscus_formats::OutputFormat;
use meniscus_formats::{MeshOptions, UpAxis, WriteOption, vdb};

use crate::render::Up;

use super::json::{path, text};
use super::names::name_of_text;
use super::obstacles::ObstacleFiles;
use super::picture::{PictureOptions, up_of};
use super::steps::file_of;

/// How many metres a world unit may have: from a nanometre to a million kilometres.
pub const METERS_PER_UNIT: RangeInclusive<f64> = 1e-9..=1e9;

/// What is written of each frame, and where.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OutputOptions {
    /// The folder of all outputs. It is made where it is missing.
    #[serde(with = "path")]
    pub folder: PathBuf,
    /// One file for each.
    pub formats: Vec<OutputFormat>,
    /// Which axis of the particles points up, for glTF, where it must be y, and for USD, which asks.
    pub up: UpAxis,
    /// The length of a world unit in metres, positive and finite: USD says it.
    #[serde(with = "text", default = "meter", skip_serializing_if = "is_meter")]
    pub meters_per_unit: f64,
    /// Small integers in .glb.
    #[serde(default, skip_serializing_if = "Not::not")]
    pub quantize: bool,
    /// 16-bit values in .vdb.
    pub vdb_half: bool,
    /// How values are packed in .vdb.
    pub vdb_compression: vdb::Compression,
    /// How pictures are taken.
    #[serde(default)]
    pub picture: PictureOptions,
}

fn meter() -> f64 {
    1.0
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde's signature")]
fn is_meter(meters: &f64) -> bool {
    *meters == meter()
}

impl OutputOptions {
    /// These formats in this folder, and all else as `meniscus convert` has it where nobody asks for anything: y is up,
    /// nothing is rounded, and .vdb is packed by Blosc.
    pub fn new(folder: impl Into<PathBuf>, formats: &[OutputFormat]) -> OutputOptions {
        OutputOptions {
            folder: folder.into(),
            formats: formats.to_vec(),
            up: UpAxis::Y,
            meters_per_unit: 1.0,
            quantize: false,
            vdb_half: false,
            vdb_compression: vdb::Compression::Blosc,
            picture: PictureOptions::default(),
        }
    }

    /// Whether pictures are written.
    pub fn has_pictures(&self) -> bool {
        self.formats.iter().any(|format| format.is_picture())
    }

    /// Whether pictures are written whose camera is not fixed yet.
    pub fn needs_camera(&self) -> bool {
        self.has_pictures() && self.picture.camera.needs_bounds()
    }

    /// Whether an option changes any of the files that are written.
    pub fn has_option(&self, option: WriteOption) -> bool {
        self.formats.iter().any(|format| format.has_option(option))
    }

    /// The value of an option as text, as it is typed and recorded. Quads are a setting of the method: on, if given.
    pub fn value(&self, option: WriteOption) -> String {
        match option {
            WriteOption::Quads => true.to_string(),
            WriteOption::Up => self.up.name().to_owned(),
            WriteOption::MetersPerUnit => self.meters_per_unit.to_string(),
            WriteOption::Quantize => self.quantize.to_string(),
            WriteOption::Half => self.vdb_half.to_string(),
            WriteOption::Compression => self.vdb_compression.name().to_owned(),
            WriteOption::Size => {
                let [width, height] = self.picture.size;
                format!("{width}x{height}")
            }
            WriteOption::Camera => self.picture.camera.to_string(),
        }
    }

    /// Whether an option has the value that it has where it is not given.
    pub fn is_default(&self, option: WriteOption) -> bool {
        self.value(option) == OutputOptions::new("", &[]).value(option)
    }

    /// How meshes are written, with these triangles as halves of quads.
    pub(super) fn mesh(&self, quads: Arc<[bool]>) -> MeshOptions {
        let OutputOptions { up, meters_per_unit, quantize, .. } = *self;
        MeshOptions { up, meters_per_unit, quantize, quads, ..MeshOptions::default() }
    }

    /// Which way is up.
    pub fn up(&self) -> Up {
        self.picture.camera.up_or(up_of(self.up))
    }

    /// The same, with a camera that has what is within these bounds, least and greatest corner in world units.
    pub fn with_camera_around(&self, bounds: [DVec3; 2]) -> OutputOptions {
        let PictureOptions { size, camera } = self.picture;
        let viewpoint = camera.viewpoint(bounds, self.picture.aspect(), up_of(self.up));
        OutputOptions { picture: PictureOptions { size, camera: viewpoint.into() }, ..self.clone() }
    }
}

/// Where the output in `format` of the frame called `stem` goes.
pub fn output_path(folder: &Path, stem: &str, format: OutputFormat) -> PathBuf {
    folder.join(name_of_text(&format!("{stem}.{}", format.extension())))
}

/// Why a run must not begin.
#[derive(Debug)]
pub enum Conflict {
    /// An output would replace an input.
    ReplacesInput {
        /// The output.
        output: PathBuf,
        /// The input.
        input: PathBuf,
    },
    /// An output would replace an obstacle, or what is taken for one later.
    ReplacesObstacle {
        /// The output.
        output: PathBuf,
        /// The obstacle, as it was asked for.
        obstacle: PathBuf,
    },
    /// Two inputs have outputs of one name.
    SameOutput {
        /// The output.
        output: PathBuf,
        /// What it would be made from, twice.
        makers: [PathBuf; 2],
    },
    /// Something else that is written, such as the report, has the name of an output.
    ReplacesOutput {
        /// The output.
        output: PathBuf,
        /// The input that it would be made from.
        input: PathBuf,
        /// What else.
        what: &'static str,
    },
}

impl fmt::Display for Conflict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Conflict::ReplacesInput { output, input } => write!(
                f,
                "the output {} would replace the input {}: choose another folder",
                output.display(),
                input.display()
            ),
            Conflict::ReplacesObstacle { output, obstacle } => write!(
                f,
                "the output {} would replace the obstacle {}: choose another folder or format",
                output.display(),
                obstacle.display()
            ),
            Conflict::SameOutput { output, makers: [first, second] } => write!(
                f,
                "{} and {} would both become {}: convert them one by one, into different folders",
                first.display(),
                second.display(),
                output.display()
            ),
            Conflict::ReplacesOutput { output, input, what } => write!(
                f,
                "{what} and the result of {} would both become {}: choose another name for {what}",
                input.display(),
                output.display()
            ),
        }
    }
}

impl std::error::Error for Conflict {}

/// Checks that the outputs of all planned frames (input and stem), and whatever else is written (what it is, and where),
/// replace neither one of `inputs` nor an obstacle nor each other. The folder must exist: only then is it known
/// where its path leads.
///
/// # Errors
/// The first conflict found.
pub fn check_outputs(
    planned: &[(PathBuf, String)],
    inputs: &[PathBuf],
    obstacles: &ObstacleFiles,
    options: &OutputOptions,
    written: Option<(&'static str, &Path)>,
) -> Result<(), Conflict> {
    let mut input_of: HashMap<Identity, &Path> = HashMap::new();
    let mut files: Vec<&Path> = inputs.iter().map(|input| file_of(input)).collect();
    files.dedup(); // the steps of one stand together
    for input in files {
        input_of.extend(identities(input).into_iter().map(|identity| (identity, input)));
    }
    let outputs = planned.iter().flat_map(|(input, stem)| {
        options.formats.iter().map(move |&format| (output_path(&options.folder, stem, format), &**input))
    });
    let refuse_loss = |output: &Path| {
        if let Some(input) = identities(output).iter().find_map(|identity| input_of.get(identity)) {
            return Err(Conflict::ReplacesInput { output: output.to_owned(), input: (*input).to_owned() });
        }
        obstacles.refuse_output(output)
    };
    let mut maker_of: HashMap<PathBuf, &Path> = HashMap::new();
    for (output, maker) in outputs {
        refuse_loss(&output)?;
        if let Some(other) = maker_of.insert(entry(&output), maker) {
            return Err(Conflict::SameOutput { output, makers: [other.to_owned(), maker.to_owned()] });
        }
    }
    let Some((what, path)) = written else { return Ok(()) };
    refuse_loss(path)?;
    match maker_of.get(&entry(path)) {
        Some(&input) => {
            Err(Conflict::ReplacesOutput { output: path.to_owned(), input: input.to_owned(), what })
        }
        None => Ok(()),
    }
}

/// Whether two paths name one file, be it there or not.
pub fn are_one_file(one: &Path, other: &Path) -> bool {
    let identities = identities(one);
    self::identities(other).iter().any(|identity| identities.contains(identity))
}

/// Something that two names of one file have in common.
#[derive(PartialEq, Eq, Hash)]
enum Identity {
    Path(PathBuf),
    #[cfg(unix)]
    Inode(u64, u64),
}

fn identities(path: &Path) -> Vec<Identity> {
    let mut identities = vec![Identity::Path(entry(path))];
    if let Ok(canonical) = path.canonicalize() {
        identities.push(Identity::Path(canonical));
    }
    #[cfg(unix)]
    if let Ok(metadata) = fs::metadata(path) {
        use std::os::unix::fs::MetadataExt;
        identities.push(Identity::Inode(metadata.dev(), metadata.ino()));
    }
    identities
}

/// The entry in its folder that a path names: links in the folder's path are followed, the entry
/// itself is not.
pub fn entry(path: &Path) -> PathBuf {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    // What cannot be resolved does not exist: nothing in it is replaced.
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    folder.join(path.file_name().unwrap_or_default())
}
