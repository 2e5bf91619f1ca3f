//! What a format says of itself: the types of the rows of the table of formats.

use std::io::Write;

use crate::data::{MeshData, MeshView, ParticleFrame, Provenance, VertexAttribute};
use crate::error::Result;
use crate::limits::Limits;
use crate::mesh_options::{MeshOptions, WriteOption};
use crate::picture::PictureView;
use crate::records::{ReadAt, Records};
use crate::step_finders::FindSteps;

/// What is known of a format whose files are read or recognised.
pub(crate) struct FormatRow {
    /// The name that users know.
    pub(crate) name: &'static str,
    /// The extensions of its files, in lower case and without the dot. Results have the first.
    pub(crate) extensions: &'static [&'static str],
    /// First bytes, each of which is enough to recognise a file. A format without signatures is recognised by `probe`.
    pub(crate) signatures: &'static [&'static [u8]],
    /// First bytes that every file has one of: a shorter beginning of one is a file that still grows.
    pub(crate) beginnings: &'static [&'static [u8]],
    /// How particles are read.
    pub(crate) particles: Option<ParticleInput>,
    /// How a mesh is read.
    pub(crate) read_mesh: Option<MeshReader>,
}

impl FormatRow {
    /// A format of which only its name and extensions are known.
    pub(crate) const fn new(name: &'static str, extensions: &'static [&'static str]) -> FormatRow {
        FormatRow { name, extensions, signatures: &[], beginnings: &[], particles: None, read_mesh: None }
    }
}

/// Reads a mesh from a whole file, and from those beside it that it names.
pub(crate) type MeshReader = fn(&[u8], &Limits, &Beside) -> Result<MeshData>;

/// Reads from the first bytes of a file the names and values that its writer recorded there.
pub(crate) type ProvenanceReader = fn(&[u8]) -> Result<Vec<(String, String)>>;

/// Finds the records of a file in its first bytes and its size: the outer error is that of the header, which may only
/// be longer than these bytes.
pub(crate) type FindRecords = fn(&[u8], u64, &dyn ReadAt, &Limits) -> Result<Result<Option<Records>>>;

/// How particles are read from a format.
pub(crate) struct ParticleInput {
    /// Reads the whole file, decompressed.
    pub(crate) read: fn(&[u8], &Limits) -> Result<ParticleFrame>,
    /// What the first bytes of a file and its size say of whether it is complete.
    pub(crate) completeness: fn(&[u8], u64) -> Result<HeadCheck>,
    /// Where particles are, if they can be read in batches.
    pub(crate) find_records: Option<FindRecords>,
    /// Where frames begin, if a file may have several.
    pub(crate) find_steps: Option<FindSteps>,
}

impl ParticleInput {
    /// Read whole; one frame; its completeness is unknown.
    pub(crate) const fn new(read: fn(&[u8], &Limits) -> Result<ParticleFrame>) -> ParticleInput {
        ParticleInput {
            read,
            completeness: |_, _| Ok(HeadCheck::Known(Completeness::Unproven)),
            find_records: None,
            find_steps: None,
        }
    }

    /// Read whole; one frame; its reader notices a missing end.
    pub(crate) const fn complete_by_reading(
        read: fn(&[u8], &Limits) -> Result<ParticleFrame>,
    ) -> ParticleInput {
        ParticleInput {
            completeness: |_, _| Ok(HeadCheck::Known(Completeness::ByReading)),
            ..ParticleInput::new(read)
        }
    }
}

/// What is known of a format that is written.
pub(crate) struct OutputRow {
    pub(crate) format: FormatRow,
    /// The help of its value of `--format` or `--preview`.
    pub(crate) help: &'static str,
    /// What its files hold.
    pub(crate) content: Content,
    /// How particles are written, if they are.
    pub(crate) write_particles: Option<ParticleWriter>,
    /// Whether its files have attributes such as velocities.
    pub(crate) has_attributes: bool,
    /// The options that change its files.
    pub(crate) options: &'static [WriteOption],
    /// Reads from the first bytes of a file what its writer recorded there.
    pub(crate) read_provenance: ProvenanceReader,
    /// How a file is checked for being whole.
    pub(crate) integrity: Integrity,
}

/// What the files of a format hold, and what writes them.
#[derive(Clone, Copy, Debug)]
pub enum Content {
    /// A mesh.
    Mesh(MeshWriter),
    /// A level set: see [`crate::vdb::encode`].
    LevelSet,
    /// A picture.
    Picture(PictureWriter),
}

/// How a format writes particles.
#[derive(Clone, Copy, Debug)]
pub struct ParticleWriter {
    /// Writes all of them.
    pub write: fn(&ParticleFrame, &Provenance, &mut dyn Write) -> Result<()>,
    /// Notes on what its files do not hold as it is.
    pub notes: fn(&ParticleFrame) -> Vec<String>,
}

/// Writes a picture.
pub type PictureWriter = fn(&PictureView, &mut dyn Write) -> Result<()>;

/// Writes a mesh to a stream.
pub type StreamWriter = fn(&MeshView, &MeshOptions, &Provenance, &mut dyn Write) -> Result<()>;

/// Encodes one of several batches of a mesh.
pub type BatchEncoder = fn(&MeshView, &MeshOptions, &Provenance, usize) -> Result<Vec<Vec<u8>>>;

/// How a format writes meshes.
#[derive(Clone, Copy, Debug)]
pub struct MeshWriter {
    /// Its code.
    pub encoder: MeshEncoder,
    /// Notes on vertex attributes that its files do not hold as they are.
    pub attribute_notes: fn(&[VertexAttribute]) -> Vec<String>,
    /// How its files round positions, if they do with these options.
    pub rounding: fn(&MeshOptions) -> Option<&'static Rounding>,
}

/// How a mesh becomes bytes.
#[derive(Clone, Copy, Debug)]
pub enum MeshEncoder {
    /// By copying: writing takes longer than encoding.
    Stream(StreamWriter),
    /// By formatting text, which takes longer than writing it, in batches of some 20 MB.
    Batches {
        /// The number of batches.
        count: fn(&MeshView, &MeshOptions) -> usize,
        /// The texts of a batch, to be written one after the other. They are made in the caller's pool. The first
        /// batch also checks the mesh: after an error there the others are of no use.
        encode: BatchEncoder,
    },
}

/// Positions relative to an origin, world units, as a reader of a file gets them.
pub type RoundPositions = fn(&[[f32; 3]], [f64; 3]) -> Vec<[f32; 3]>;

/// How a format rounds the positions of a mesh. Its functions take positions relative to an origin, in world units.
#[derive(Debug)]
pub struct Rounding {
    /// The positions that a reader gets, relative to the same origin.
    pub positions: RoundPositions,
    /// The largest distance along an axis by which a position is moved.
    pub error: fn(&[[f32; 3]], [f64; 3]) -> f64,
    /// What of such a file a certificate is about.
    pub certified_as: &'static str,
    /// Which file it is, and why it moves vertices: the end of a sentence.
    pub reason: &'static str,
}

impl MeshWriter {
    /// A writer that keeps all attributes under their names, and positions as they are.
    pub(crate) const fn new(encoder: MeshEncoder) -> MeshWriter {
        MeshWriter { encoder, attribute_notes: |_| Vec::new(), rounding: |_| None }
    }

    /// Writes a mesh.
    ///
    /// # Errors
    /// [`crate::Error::Io`] if `out` fails; [`crate::Error::TooLarge`] if the format cannot hold so much;
    /// [`crate::Error::Invalid`] if the
    /// mesh is inconsistent or not finite, or if what should be a quad is none.
    pub fn write(
        &self,
        mesh: &MeshView,
        options: &MeshOptions,
        provenance: &Provenance,
        out: &mut dyn Write,
    ) -> Result<()> {
        match self.encoder {
            MeshEncoder::Stream(write) => write(mesh, options, provenance, out),
            MeshEncoder::Batches { count, encode } => {
                for index in 0..count(mesh, options) {
                    for text in encode(mesh, options, provenance, index)? {
                        out.write_all(&text)?;
                    }
                }
                Ok(())
            }
        }
    }
}

/// How the end of an output is checked.
#[derive(Clone, Copy)]
pub(crate) enum Integrity {
    /// By its last 256 bytes, or all if there are fewer.
    Tail(fn(&[u8]) -> bool),
    /// By the length that its head claims; `None` where that is unknown. The second argument reads more of the file: so
    /// many bytes from a place on, or fewer where it ends.
    Length(fn(&[u8], &mut ReadPiece) -> Result<Option<u64>>),
    /// By parsing it as JSON that ends with a line.
    Json,
}

/// Reads a piece of a file, by where it starts and its length.
pub(crate) type ReadPiece<'a> = dyn FnMut(u64, u64) -> Result<Vec<u8>> + 'a;

/// What the format says of a file that may still be growing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Completeness {
    /// It has all that it declares.
    Complete,
    /// It declares more than there is.
    Incomplete {
        /// Bytes that it declares, at least.
        expected: u64,
        /// Bytes that there are.
        found: u64,
    },
    /// A cheap look does not show it, but reading it does: text with a count, and what is compressed.
    ByReading,
    /// The format has no way of telling: a table may always have another row.
    Unproven,
}

/// What the head of a file shows.
pub(crate) enum HeadCheck {
    Known(Completeness),
    /// The header does not end within the head, but the file goes on.
    ByMoreOfTheHead,
    /// Whether the last number of a text is whole.
    ByTheLastByte,
}

/// Of a file whose format says exactly how long it is.
pub(crate) fn exactly(expected: u64, found: u64) -> Completeness {
    let beyond = if expected < found { Completeness::Unproven } else { Completeness::Complete };
    at_least(expected, found, beyond)
}

/// Of a file that has at least so many bytes; `then` where it has.
pub(crate) fn at_least(expected: u64, found: u64, then: Completeness) -> Completeness {
    if found < expected { Completeness::Incomplete { expected, found } } else { then }
}

/// Gives the bytes of a file beside the one that is read, by its relative path: one of those that
/// [`crate::gltf::files_beside`] tells.
pub type Beside<'a> = dyn Fn(&str) -> std::io::Result<Vec<u8>> + 'a;
