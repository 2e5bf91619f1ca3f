//! The types of the rows of the table of formats. A row describes a format and contains its functions.

use std::io::Write;

use crate::core::batches::{ReadAt, Records};
use crate::core::container::ContainerReader;
use crate::core::data::{MeshData, MeshView, ParticleFrame, PictureView, Provenance, VertexAttribute};
use crate::core::error::Result;
use crate::core::limits::Limits;
use crate::core::options::{MeshOptions, WriteOption};
use crate::core::steps::FindSteps;

/// A format that files are read in or recognised as.
pub(crate) struct FormatRow {
    /// The name shown to users.
    pub(crate) name: &'static str,
    /// File extensions, in lower case and without the dot. Outputs use the first.
    pub(crate) extensions: &'static [&'static str],
    /// Signatures, any of which identifies the format. `probe` recognises formats without signatures by the
    /// rest of their content.
    pub(crate) signatures: &'static [&'static [u8]],
    /// Every valid file starts with one of these. A shorter file that is a prefix of one of them is still
    /// being written.
    pub(crate) beginnings: &'static [&'static [u8]],
    /// The particle reader.
    pub(crate) particles: Option<ParticleReader>,
    /// The mesh reader.
    pub(crate) read_mesh: Option<MeshReader>,
}

impl FormatRow {
    /// A format without a reader: only its name and extensions.
    pub(crate) const fn new(name: &'static str, extensions: &'static [&'static str]) -> FormatRow {
        FormatRow { name, extensions, signatures: &[], beginnings: &[], particles: None, read_mesh: None }
    }
}

/// Reads a mesh from a whole file and the external files that it references.
pub(crate) type MeshReader = fn(&[u8], &Limits, &ReadExternal) -> Result<MeshData>;

/// Reads provenance, as names and values, from the first bytes of a file.
pub(crate) type ProvenanceReader = fn(&[u8]) -> Result<Vec<(String, String)>>;

/// Locates the records of a file from its first bytes and its size. An outer error concerns the header, and
/// can mean that the function needs more of the first bytes; an inner error concerns the rest of the file.
/// `None` means that the file must be read whole, not in batches.
pub(crate) type FindRecords = fn(&[u8], u64, &dyn ReadAt, &Limits) -> Result<Result<Option<Records>>>;

/// How particles are read from a format.
pub(crate) struct ParticleReader {
    /// Reads a frame.
    pub(crate) read: ReadParticles,
    /// Checks the file's size against its first bytes.
    pub(crate) completeness: fn(&[u8], u64) -> Result<HeadCheck>,
    /// Locates the records of a file that can be read in batches.
    pub(crate) find_records: Option<FindRecords>,
    /// Finds the frames of a text or an array that can have several.
    pub(crate) find_steps: Option<FindSteps>,
}

/// How a frame of particles is read.
pub(crate) enum ReadParticles {
    /// From all bytes of a decompressed file, or of one of its steps.
    Whole(fn(&[u8], &Limits) -> Result<ParticleFrame>),
    /// From an open container, by its index.
    Sample(ContainerReader),
}

impl ParticleReader {
    /// A single-frame format that must be read whole and whose completeness is unknown.
    pub(crate) const fn new(read: fn(&[u8], &Limits) -> Result<ParticleFrame>) -> ParticleReader {
        ParticleReader {
            read: ReadParticles::Whole(read),
            completeness: |_, _| Ok(HeadCheck::Known(Completeness::Unknown)),
            find_records: None,
            find_steps: None,
        }
    }

    /// A container, whose reader notices missing bytes.
    pub(crate) const fn container(container: ContainerReader) -> ParticleReader {
        ParticleReader {
            read: ReadParticles::Sample(container),
            completeness: |_, _| Ok(HeadCheck::Known(Completeness::NeedsReading)),
            find_records: None,
            find_steps: None,
        }
    }

    /// A single-frame format that must be read whole and whose reader notices a missing end.
    pub(crate) const fn needs_reading(read: fn(&[u8], &Limits) -> Result<ParticleFrame>) -> ParticleReader {
        ParticleReader {
            completeness: |_, _| Ok(HeadCheck::Known(Completeness::NeedsReading)),
            ..ParticleReader::new(read)
        }
    }
}

/// A format that files are written in.
pub(crate) struct OutputRow {
    pub(crate) format: FormatRow,
    /// Help text of its value of `--format` or `--preview`.
    pub(crate) help: &'static str,
    /// What its files contain.
    pub(crate) content: Content,
    /// The particle writer.
    pub(crate) write_particles: Option<ParticleWriter>,
    /// Whether its files have attributes such as velocities.
    pub(crate) has_attributes: bool,
    /// The options that affect its files.
    pub(crate) options: &'static [WriteOption],
    /// Reads the provenance from the first bytes of a file.
    pub(crate) read_provenance: ProvenanceReader,
    /// How the completeness of a file is checked.
    pub(crate) integrity: Integrity,
}

/// What the files of a format contain, and their writer.
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
    /// Writes all particles.
    pub write: fn(&ParticleFrame, &Provenance, &mut dyn Write) -> Result<()>,
    /// Notes on data that its files cannot represent exactly.
    pub notes: fn(&ParticleFrame) -> Vec<String>,
}

/// Writes a picture.
pub type PictureWriter = fn(&PictureView, &mut dyn Write) -> Result<()>;

/// Writes a mesh to a stream.
pub type StreamWriter = fn(&MeshView, &MeshOptions, &Provenance, &mut dyn Write) -> Result<()>;

/// Encodes one batch of a mesh, chosen by its index.
pub type BatchEncoder = fn(&MeshView, &MeshOptions, &Provenance, usize) -> Result<Vec<Vec<u8>>>;

/// How a format writes meshes.
#[derive(Clone, Copy, Debug)]
pub struct MeshWriter {
    /// The encoder.
    pub encoder: MeshEncoder,
    /// Notes on vertex attributes that its files cannot represent exactly.
    pub attribute_notes: fn(&[VertexAttribute]) -> Vec<String>,
    /// Whether its files have no origin, and thus world positions in 32 bits. A mesh far from the origin must be
    /// rounded to such positions before, so that all files of a frame have the same ones.
    pub lacks_origin: bool,
}

/// How a mesh is encoded.
#[derive(Clone, Copy, Debug)]
pub enum MeshEncoder {
    /// Copies numbers to a stream: writing takes longer than encoding.
    Stream(StreamWriter),
    /// Formats text in batches of about 20 MB: encoding takes longer than writing.
    Batches {
        /// The number of batches, at least 1, of a mesh that is valid.
        count: fn(&MeshView, &MeshOptions) -> usize,
        /// Encodes a batch as pieces of text, to be written in order. Runs in the caller's thread pool. The
        /// first batch also checks the mesh: if it fails, there are no others.
        encode: BatchEncoder,
    },
}

impl MeshWriter {
    /// A writer that keeps all attributes under their names, and the origin of the mesh.
    pub(crate) const fn new(encoder: MeshEncoder) -> MeshWriter {
        MeshWriter { encoder, attribute_notes: |_| Vec::new(), lacks_origin: false }
    }

    /// Writes a mesh.
    ///
    /// # Errors
    /// [`crate::Error::Io`] if `out` fails; [`crate::Error::TooLarge`] if the mesh exceeds the format's
    /// limits; [`crate::Error::Invalid`] if the mesh is inconsistent or not finite, or if two triangles
    /// marked as a quad do not form one.
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
                let mut write_batch = |index| {
                    let texts = encode(mesh, options, provenance, index)?;
                    texts.iter().try_for_each(|text| Ok(out.write_all(text)?))
                };
                write_batch(0)?;
                (1..count(mesh, options)).try_for_each(write_batch)
            }
        }
    }
}

/// How the completeness of an output file is checked.
#[derive(Clone, Copy)]
pub(crate) enum Integrity {
    /// By its last 256 bytes, or the whole file if it is shorter.
    Tail(fn(&[u8]) -> bool),
    /// By the file size that its head declares; `None` if unknown. The second argument reads another piece of
    /// the file, by offset and length; the piece is shorter if the file ends within it.
    Length(fn(&[u8], &mut ReadPiece) -> Result<Option<u64>>),
    /// By parsing it as JSON with a final line feed.
    Json,
}

/// Reads a piece of a file by offset and length.
pub(crate) type ReadPiece<'a> = dyn FnMut(u64, u64) -> Result<Vec<u8>> + 'a;

/// What a file's head and size say about its completeness.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Completeness {
    /// The file has all the data that it declares.
    Complete,
    /// The file declares more data than it has.
    Incomplete {
        /// The declared size in bytes, at least.
        expected: u64,
        /// The size of the file, in bytes.
        found: u64,
    },
    /// Only reading the whole file shows whether it is complete: text with a count, and compressed files.
    NeedsReading,
    /// Nothing in the file shows whether it is complete: a table may always get another row.
    Unknown,
}

impl Completeness {
    /// Of a file in a format that declares the exact file size. A larger file is `Unknown`.
    pub(crate) fn of_exact_size(expected: u64, found: u64) -> Completeness {
        let beyond = if expected < found { Completeness::Unknown } else { Completeness::Complete };
        Completeness::of_minimum_size(expected, found, beyond)
    }

    /// Of a file in a format that declares a minimum file size: `then` if the file has this size.
    pub(crate) fn of_minimum_size(expected: u64, found: u64, then: Completeness) -> Completeness {
        if found < expected { Completeness::Incomplete { expected, found } } else { then }
    }
}

/// The result of checking a file's head.
pub(crate) enum HeadCheck {
    Known(Completeness),
    /// The header does not end within the bytes that were read so far.
    NeedsMoreHead,
    /// The last byte decides: without white space at the end of a text, the last number may be incomplete.
    NeedsLastByte,
}

/// Reads an external file by its relative path, one of those that [`crate::meshes::gltf::external_files`] returns.
pub type ReadExternal<'a> = dyn Fn(&str) -> std::io::Result<Vec<u8>> + 'a;

/// The refusal of a mesh.
pub(crate) const MESH_REFUSAL: &str =
    "this is a mesh, not particles: use the particle file, or save the mesh's vertices as PLY";
