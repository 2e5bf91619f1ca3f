//! Reads archives of this crate: their provenance, the times of their samples, and the mesh at each time.
//!
//! Every reference is an offset, so the reader checks that the target is inside the file. The reader follows
//! a fixed path from the root, so it terminates even if references form a cycle.
//!
//! [`read_sequence_info`] reads only the two ends of a file: the container is then a part of it.

use std::io::{Read, Seek, SeekFrom};

use super::FORMAT;
use super::document::{
    ACYCLIC, APPLICATION, DATA, EMPTY_GROUP, HEADER_BYTES, MAGIC, OBJECT_HASH_BYTES, Pod, ROOT_CHILDREN,
    Reference, START, bits,
};
use super::mesh::{IDENTITY, MESH, Matrix, TRANSFORM, names};
use crate::bytes::piece;
use crate::data::MeshData;
use crate::digest::DIGEST_BYTES;
use crate::error::{Error, Position, Result};
use crate::gltf::{SEQUENCE_FRAMES, SequenceInfo};
use crate::limits::Limits;
use crate::provenance::from_escaped;

/// Indices of children of the root group.
const TOP_OBJECT: usize = 2;
const SAMPLINGS: usize = 4;

/// What errors about the offset of the root group call it.
const ROOT: &str = "the offset of the root group";

/// Reads the provenance from the first bytes of a file, where our writer puts the metadata.
pub(super) fn read_provenance(head: &[u8]) -> Result<Vec<(String, String)>> {
    check_start(head)?;
    Ok(own_metadata(first_data(head).unwrap_or_default()).unwrap_or_default())
}

/// The first data of a file. In files of this crate, they are the metadata.
fn first_data(bytes: &[u8]) -> Result<&[u8]> {
    Container::new(bytes).data(DATA | HEADER_BYTES, "the metadata")
}

/// The provenance in the metadata of an archive; `None` if another program wrote the archive.
fn own_metadata(metadata: &[u8]) -> Option<Vec<(String, String)>> {
    let text = std::str::from_utf8(metadata).ok()?;
    let mut entries = text.split(';').filter_map(|entry| entry.split_once('='));
    entries.next().filter(|(key, value)| *key == APPLICATION && value.starts_with("meniscus "))?;
    Some(from_escaped(entries))
}

/// The size of a complete file with this head: the root group comes last. `None` for files of other programs.
pub(super) fn bytes_declared(head: &[u8]) -> Result<Option<u64>> {
    check_start(head)?;
    if own_metadata(first_data(head).unwrap_or_default()).is_none() {
        return Ok(None);
    }
    let root = Container::new(head).number(8, ROOT)?;
    Ok(root.checked_add(8 * (1 + ROOT_CHILDREN)))
}

fn check_start(bytes: &[u8]) -> Result<()> {
    let magic_length = bytes.len().min(MAGIC.len());
    if bytes[..magic_length] != MAGIC[..magic_length] {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected Ogawa"));
    }
    let position = Position::Offset(magic_length as u64);
    match bytes.get(magic_length..START.len()) {
        None | Some([0, ..]) => {
            let what = "the program that writes this file did not complete it";
            Err(Error::truncated(FORMAT, position, what))
        }
        Some(version) if version != &START[MAGIC.len()..] => {
            let what = format!("expected version 1 of Ogawa, found the bytes {version:02x?}");
            Err(Error::invalid(FORMAT, position, what))
        }
        Some(_) => Ok(()),
    }
}

/// Reads the mesh of an archive with one frame.
///
/// # Errors
///
/// [`Error::Unsupported`] for archives of other programs and for sequences; [`Error::Truncated`] or
/// [`Error::Invalid`], with the position, if the file is truncated or damaged; [`Error::TooLarge`] beyond
/// `limits`.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    let archive = MeshArchive::open(bytes)?;
    archive.check_single_frame()?;
    archive.mesh(0, limits)
}

/// The size of the start of an archive, with its provenance.
const HEAD_BYTES: u64 = 64 << 10;

/// The sizes of the end of an archive, with its headers and references: 16 bytes for each sample of each
/// property. It is read with the first size; if that does not suffice, with a larger one, up to the last.
const END_BYTES: u64 = 64 << 10;
const END_BYTES_MAX: u64 = 256 << 20;
const END_GROWTH: u64 = 16;

/// The content of a sequence of this crate, and the names of its vertex attributes, except normals; `None`
/// for an archive with one frame. Reads the two ends of the file, and the number of bytes of each array.
///
/// # Errors
///
/// [`Error::Io`] if the file cannot be read, and those of [`read_mesh`].
pub fn read_sequence_info(file: &mut (impl Read + Seek)) -> Result<Option<(SequenceInfo, Vec<String>)>> {
    let head = piece(file, 0, HEAD_BYTES)?;
    let (provenance, frames) = start_of(&head)?;
    let Some(frames) = frames else { return Ok(None) };
    let root = Container::new(&head).number(8, ROOT)?;
    let file_bytes = file.seek(SeekFrom::End(0))?;
    let mut size = END_BYTES;
    let (pairs, names) = loop {
        let base = file_bytes.saturating_sub(size);
        let end = piece(file, base, size)?;
        let start = (provenance.clone(), Some(frames));
        let found = MeshArchive::of_parts(start, root, Container::at_offset(&end, base))
            .and_then(|archive| Ok((archive.position_and_count_samples()?, archive.attribute_names()?)));
        match found {
            Err(_) if base > 0 && size < END_BYTES_MAX => size *= END_GROWTH,
            found => break found?,
        }
    };
    let mut info = SequenceInfo { frames, ..SequenceInfo::default() };
    for (index, [positions, counts]) in pairs.iter().enumerate() {
        // A frame may have two samples, which refer to the same data.
        if index > 0 && pairs[index - 1] == [*positions, *counts] {
            continue;
        }
        let mut count = |reference: Reference, subject: &str, bytes: u64| -> Result<u64> {
            Ok(sample_bytes(file, reference, subject)? / bytes)
        };
        info.vertices = info.vertices.saturating_add(count(*positions, names::POSITIONS, 12)?);
        info.triangles = info.triangles.saturating_add(count(*counts, names::COUNTS, 4)?);
    }
    Ok(Some((info, names)))
}

/// The number of bytes of a sample in a file.
fn sample_bytes(file: &mut (impl Read + Seek), reference: Reference, subject: &str) -> Result<u64> {
    let at = reference & !DATA;
    if reference == DATA {
        return Ok(0);
    }
    let file_bytes = file.seek(SeekFrom::End(0))?;
    let length = Container::at_offset(&piece(file, at, 8)?, at).number(at, subject)?;
    match length.checked_sub(DIGEST_BYTES as u64) {
        Some(bytes) if at.saturating_add(8).saturating_add(length) <= file_bytes => Ok(bytes),
        _ => {
            let what = format!("a sample of {subject} has {length} bytes, and the file {file_bytes}");
            Err(Error::invalid(FORMAT, Position::Offset(at), what))
        }
    }
}

/// The times of the samples of an archive, in seconds. A frame may have two samples.
///
/// # Errors
///
/// Those of [`read_mesh`].
pub fn read_times(bytes: &[u8]) -> Result<Vec<f64>> {
    MeshArchive::open(bytes)?.times()
}

/// Reads the mesh of one sample of an archive, by its index among [`read_times`].
///
/// # Errors
///
/// Those of [`read_mesh`]; [`Error::Invalid`] if there are fewer samples.
pub fn read_sample(bytes: &[u8], index: usize, limits: &Limits) -> Result<MeshData> {
    MeshArchive::open(bytes)?.mesh(index, limits)
}

/// The name of the attribute in the property for velocities.
pub(super) const VELOCITY: &str = "velocity";

/// The provenance at the start of an archive, and the number of frames of a sequence.
type ArchiveStart = (Vec<(String, String)>, Option<u64>);

fn start_of(head: &[u8]) -> Result<ArchiveStart> {
    check_start(head)?;
    let Some(provenance) = own_metadata(first_data(head)?) else {
        let what = "Alembic files of other programs are not supported: save the mesh as PLY, OBJ or glTF";
        return Err(Error::unsupported(FORMAT, what));
    };
    let frames = provenance.iter().find(|(name, _)| name == SEQUENCE_FRAMES);
    let frames = frames.map(|(_, frames)| {
        let what = format!("the sequence has an invalid number of frames `{frames}`");
        frames.parse().map_err(|_| Error::invalid(FORMAT, Position::Offset(HEADER_BYTES), what))
    });
    let frames = frames.transpose()?;
    Ok((provenance, frames))
}

/// An archive of this crate.
pub(super) struct MeshArchive<'a> {
    pub(super) container: Container<'a>,
    pub(super) provenance: Vec<(String, String)>,
    root: Vec<Reference>,
    /// The number of frames of a sequence; `None` for an archive with one frame.
    frames: Option<u64>,
    /// The properties of the mesh, and of its transform.
    geometry: Vec<(PropertyHeader, Reference)>,
    transform: Vec<(PropertyHeader, Reference)>,
}

impl<'a> MeshArchive<'a> {
    pub(super) fn open(bytes: &'a [u8]) -> Result<MeshArchive<'a>> {
        let container = Container::new(bytes);
        MeshArchive::of_parts(start_of(bytes)?, container.number(8, ROOT)?, container)
    }

    /// The archive with this start, and with its root group at this offset. The container needs no arrays.
    fn of_parts(
        (provenance, frames): ArchiveStart,
        root: Reference,
        container: Container<'a>,
    ) -> Result<MeshArchive<'a>> {
        let root = container.group(root, "the root group")?;
        if root.len() as u64 != ROOT_CHILDREN {
            let what = format!("the root group has {} children; expected {ROOT_CHILDREN}", root.len());
            return Err(Error::invalid(FORMAT, Position::Offset(8), what));
        }
        let transform = container.child_object(root[TOP_OBJECT], TRANSFORM)?;
        let mesh = container.child_object(transform, MESH)?;
        Ok(MeshArchive {
            frames,
            provenance,
            geometry: container.schema(mesh, names::GEOMETRY)?,
            transform: container.schema(transform, names::TRANSFORM)?,
            container,
            root,
        })
    }

    /// The data of the positions and of the corner counts, for each sample.
    fn position_and_count_samples(&self) -> Result<Vec<[Reference; 2]>> {
        let (positions, counts) = (self.references(names::POSITIONS)?, self.references(names::COUNTS)?);
        Ok(positions.into_iter().zip(counts).map(Into::into).collect())
    }

    /// The names of the vertex attributes, except normals.
    fn attribute_names(&self) -> Result<Vec<String>> {
        let velocity = self.has(names::VELOCITIES).then(|| VELOCITY.to_owned());
        Ok(velocity.into_iter().chain(self.params()?.into_iter().map(|(header, _)| header.name)).collect())
    }

    /// Fails for a sequence, because it is unknown which of its meshes to use.
    pub(super) fn check_single_frame(&self) -> Result<()> {
        let Some(frames) = self.frames else { return Ok(()) };
        let what = format!(
            "this file is a sequence of {frames} frames, and a single mesh is needed: use the file of one frame, or of each frame, as in body.####.abc"
        );
        Err(Error::unsupported(FORMAT, what))
    }

    /// Whether the mesh has this property.
    pub(super) fn has(&self, name: &str) -> bool {
        self.geometry.iter().any(|(header, _)| header.name == name)
    }

    /// The attributes for which the schema has no property, from `.arbGeomParams`.
    pub(super) fn params(&self) -> Result<Vec<(PropertyHeader, Reference)>> {
        if self.has(names::PARAMS) {
            self.container.properties(self.property(names::PARAMS)?.1)
        } else {
            Ok(Vec::new())
        }
    }

    fn property(&self, name: &str) -> Result<&(PropertyHeader, Reference)> {
        self.geometry
            .iter()
            .find(|(header, _)| header.name == name)
            .ok_or_else(|| Error::invalid(FORMAT, Position::File, format!("the mesh has no property {name}")))
    }

    /// The data of the samples of an array.
    fn references(&self, name: &str) -> Result<Vec<Reference>> {
        let (_, reference) = self.property(name)?;
        let children = self.container.group(*reference, name)?;
        Ok(children.chunks(2).map(|sample| sample[0]).collect())
    }

    /// The elements of a sample of an array, each of `N` bytes.
    pub(super) fn array<const N: usize>(
        &self,
        name: &str,
        pod: (Pod, u8),
        index: usize,
    ) -> Result<&'a [[u8; N]]> {
        let (header, _) = self.property(name)?;
        header.check_type(pod)?;
        let references = self.references(name)?;
        let Some(reference) = references.get(index) else {
            let what = format!("{name} has {} samples; expected {}", references.len(), index + 1);
            return Err(Error::invalid(FORMAT, Position::File, what));
        };
        let (bytes, at) = self.container.sample(*reference, name)?;
        match bytes.as_chunks() {
            (numbers, []) => Ok(numbers),
            _ => {
                let what = format!("{name} has {} bytes, not a multiple of {N}", bytes.len());
                Err(Error::invalid(FORMAT, Position::Offset(at), what))
            }
        }
    }

    /// The positions and normals of a sample, before its transform.
    pub(super) fn vertices(&self, index: usize, limits: &Limits) -> Result<[Vec<[f32; 3]>; 2]> {
        let positions = self.array::<12>(names::POSITIONS, (Pod::F32, 3), index)?;
        let normals = self.array::<12>(names::NORMALS, (Pod::F32, 3), index)?;
        let vertex_count = positions.len();
        limits.check_particles(FORMAT, vertex_count as u64)?;
        if normals.len() != vertex_count {
            let what = format!("the mesh has {} normals for {vertex_count} vertices", normals.len());
            return Err(Error::invalid(FORMAT, Position::File, what));
        }
        Ok([positions, normals].map(|vectors| vectors.iter().map(vector).collect()))
    }

    fn mesh(&self, index: usize, limits: &Limits) -> Result<MeshData> {
        let [positions, normals] = self.vertices(index, limits)?;
        let matrix = self.matrix(index)?;
        let normal = |normal: [f32; 3]| {
            let rotated = transformed(normal.map(f64::from), &matrix, 0.0);
            #[expect(clippy::cast_possible_truncation, reason = "a rotation by a right angle is exact")]
            rotated.map(|x| x as f32)
        };
        let position = |position: &[f32; 3]| transformed(position.map(f64::from), &matrix, 1.0);
        Ok(MeshData {
            triangles: self.triangles(index, positions.len())?,
            positions: positions.iter().map(position).collect(),
            normals: normals.into_iter().map(normal).collect(),
        })
    }

    /// The triangles of a sample, counterclockwise. Faces are clockwise in the file; those with more than
    /// three corners become triangle fans.
    pub(super) fn triangles(&self, index: usize, vertex_count: usize) -> Result<Vec<[u32; 3]>> {
        let invalid = |what: String| Error::invalid(FORMAT, Position::File, what);
        let corners = self.array::<4>(names::CORNERS, (Pod::I32, 1), index)?;
        let corners: Vec<u32> = corners.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect();
        if let Some(corner) = corners.iter().find(|corner| **corner as usize >= vertex_count) {
            let what = format!("a face has vertex index {corner}, but the mesh has {vertex_count} vertices");
            return Err(invalid(what));
        }
        let (mut rest, mut triangles) = (&*corners, Vec::new());
        for bytes in self.array::<4>(names::COUNTS, (Pod::I32, 1), index)? {
            let count = u32::from_le_bytes(*bytes) as usize;
            let Some((face, others)) = rest.split_at_checked(count).filter(|_| count >= 3) else {
                let what =
                    format!("a face has {count} corners, but all faces together have {}", corners.len());
                return Err(invalid(what));
            };
            let last = face[count - 1];
            triangles.extend(face[..count - 1].windows(2).rev().map(|pair| [last, pair[1], pair[0]]));
            rest = others;
        }
        match rest {
            [] => Ok(triangles),
            _ => Err(invalid(format!("{} corners belong to no face", rest.len()))),
        }
    }

    /// The transform of a sample.
    pub(super) fn matrix(&self, index: usize) -> Result<Matrix> {
        let property = self.transform.iter().find(|(header, _)| header.name == names::MATRIX);
        let Some((header, reference)) = property else { return Ok(IDENTITY) };
        header.check_type((Pod::F64, 16))?;
        let samples = self.container.group(*reference, names::MATRIX)?;
        // A transform that never changes has one sample.
        let sample = samples.get(index).or_else(|| samples.first()).copied().unwrap_or(DATA);
        let (bytes, at) = self.container.sample(sample, names::MATRIX)?;
        let (numbers, _) = bytes.as_chunks::<8>();
        let mut matrix = IDENTITY;
        if numbers.len() != 16 {
            let what = format!("a matrix has {} numbers; expected 16", numbers.len());
            return Err(Error::invalid(FORMAT, Position::Offset(at), what));
        }
        for (element, bytes) in matrix.as_flattened_mut().iter_mut().zip(numbers) {
            *element = f64::from_le_bytes(*bytes);
        }
        Ok(matrix)
    }

    fn times(&self) -> Result<Vec<f64>> {
        let (header, _) = self.property(names::POSITIONS)?;
        let count = self.references(names::POSITIONS)?.len();
        let samplings = self.container.data(self.root[SAMPLINGS], "the time samplings")?;
        let mut rest = samplings;
        let mut sampling_at = |index: u32| -> Option<(f64, &[[u8; 8]])> {
            let mut sampling = None;
            for _ in 0..=index {
                let (head, after) = rest.split_first_chunk::<16>()?;
                let [_, _, _, _, per_cycle @ .., a, b, c, d] = *head;
                let times = u32::from_le_bytes([a, b, c, d]) as usize;
                let (times, after) = after.split_at_checked(times.checked_mul(8)?)?;
                sampling = Some((f64::from_le_bytes(per_cycle), times.as_chunks().0));
                rest = after;
            }
            sampling
        };
        // Each sampling has at least 16 bytes, so the search for a wrong index soon reaches the end of the
        // data.
        let Some((per_cycle, times)) = sampling_at(header.sampling) else {
            let what = format!("the time sampling {} is missing or incomplete", header.sampling);
            return Err(Error::invalid(FORMAT, Position::File, what));
        };
        let times = || times.iter().map(|bytes| f64::from_le_bytes(*bytes));
        if per_cycle == ACYCLIC {
            return Ok(times().take(count).collect());
        }
        let first = times().next().unwrap_or_default();
        #[expect(clippy::cast_precision_loss, reason = "a file has fewer samples than 2⁵³")]
        Ok((0..count).map(|index| first + index as f64 * per_cycle).collect())
    }
}

fn vector(bytes: &[u8; 12]) -> [f32; 3] {
    let [a, b, c, d, e, f, g, h, rest @ ..] = *bytes;
    [[a, b, c, d], [e, f, g, h], rest].map(f32::from_le_bytes)
}

/// A row vector times a matrix. The fourth component is 1 for a point and 0 for a direction.
fn transformed(vector: [f64; 3], matrix: &Matrix, fourth: f64) -> [f64; 3] {
    if *matrix == IDENTITY {
        return vector;
    }
    let [x, y, z] = vector;
    std::array::from_fn(|axis| {
        let column = [0, 1, 2, 3].map(|row| matrix[row][axis]);
        x * column[0] + y * column[1] + z * column[2] + fourth * column[3]
    })
}

// Reads the groups, data and property headers of an archive, and checks all bounds.

/// The limit of properties in a compound: more than any mesh that this program writes has.
const PROPERTY_COUNT_MAX: usize = 1 << 16;

/// A file, or a part of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Container<'a> {
    pub(super) bytes: &'a [u8],
    /// The offset of the bytes in the file.
    base: u64,
}

/// The header of a property.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct PropertyHeader {
    pub(super) name: String,
    /// The index of the property's time sampling.
    pub(super) sampling: u32,
    pub(super) metadata: String,
    word: u32,
}

impl PropertyHeader {
    /// The type of the property's numbers; `None` for a compound.
    pub(super) fn pod(&self) -> Option<u32> {
        (self.word & bits::KIND != 0).then_some(self.word >> bits::POD_SHIFT & 0xf)
    }

    /// Fails unless the values have this type and extent.
    pub(super) fn check_type(&self, (pod, extent): (Pod, u8)) -> Result<()> {
        let kind = (self.word >> bits::POD_SHIFT & 0xf, self.word >> bits::EXTENT_SHIFT & 0xff);
        if kind == (u32::from(pod as u8), u32::from(extent)) && self.word & bits::KIND != 0 {
            return Ok(());
        }
        let what = format!(
            "{} has values of the type {} × {}; expected {pod:?} × {extent}",
            self.name, kind.0, kind.1
        );
        Err(Error::invalid(FORMAT, Position::File, what))
    }
}

impl<'a> Container<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Container<'a> {
        Container::at_offset(bytes, 0)
    }

    /// A part of a file, which starts at the offset `base`.
    fn at_offset(bytes: &'a [u8], base: u64) -> Container<'a> {
        Container { bytes, base }
    }

    /// The bytes from an offset on.
    fn tail(&self, at: u64, subject: &str) -> Result<&'a [u8]> {
        let start = at.checked_sub(self.base).and_then(|start| usize::try_from(start).ok());
        let start = start.filter(|start| *start < self.bytes.len());
        start.map(|start| &self.bytes[start..]).ok_or_else(|| self.truncated(at, subject))
    }

    fn truncated(&self, at: u64, subject: &str) -> Error {
        let end = self.base + self.bytes.len() as u64;
        let what = match self.base {
            0 => format!("{subject} exceeds the file, which has {end} bytes"),
            base => format!("{subject} is not in the last part of the file, from {base} to {end}"),
        };
        Error::truncated(FORMAT, Position::Offset(at), what)
    }

    /// The number at an offset.
    pub(super) fn number(&self, at: u64, subject: &str) -> Result<u64> {
        let number = self.tail(at, subject)?.first_chunk().ok_or_else(|| self.truncated(at, subject))?;
        Ok(u64::from_le_bytes(*number))
    }

    /// The bytes of the data at a reference.
    pub(super) fn data(&self, reference: Reference, subject: &str) -> Result<&'a [u8]> {
        if reference & DATA == 0 {
            let what = format!("expected a data block for {subject}, found a group");
            return Err(Error::invalid(FORMAT, Position::Offset(reference), what));
        }
        let at = reference & !DATA;
        if at == 0 {
            return Ok(&[]);
        }
        let length = self.number(at, subject)?;
        let bytes = &self.tail(at, subject)?[8..];
        let length = usize::try_from(length).ok().filter(|length| *length <= bytes.len());
        length.map(|length| &bytes[..length]).ok_or_else(|| self.truncated(at, subject))
    }

    /// The children of a group.
    pub(super) fn group(&self, reference: Reference, subject: &str) -> Result<Vec<Reference>> {
        if reference & DATA != 0 {
            let what = format!("expected a group for {subject}, found a data block");
            return Err(Error::invalid(FORMAT, Position::Offset(reference & !DATA), what));
        }
        if reference == EMPTY_GROUP {
            return Ok(Vec::new());
        }
        let count = self.number(reference, subject)?;
        let children = &self.tail(reference, subject)?[8..];
        let count = usize::try_from(count).ok().filter(|count| *count <= children.len() / 8);
        let count = count.ok_or_else(|| self.truncated(reference, subject))?;
        let children = children.as_chunks().0[..count].iter();
        Ok(children.map(|child| u64::from_le_bytes(*child)).collect())
    }

    /// The bytes of a sample without its digest, and their offset.
    pub(super) fn sample(&self, reference: Reference, subject: &str) -> Result<(&'a [u8], u64)> {
        let (bytes, at) = (self.data(reference, subject)?, reference & !DATA);
        match bytes.split_at_checked(DIGEST_BYTES) {
            Some((_, values)) => Ok((values, at + 8 + DIGEST_BYTES as u64)),
            None if bytes.is_empty() => Ok((bytes, at)),
            None => {
                let what = format!("a sample of {subject} has {} bytes, fewer than its digest", bytes.len());
                Err(Error::invalid(FORMAT, Position::Offset(at), what))
            }
        }
    }

    /// The child object named `name`.
    fn child_object(&self, object: Reference, name: &str) -> Result<Reference> {
        let children = self.group(object, "an object")?;
        // The first child is the compound of properties, the last one the data with the names of child
        // objects.
        let [_, objects @ .., headers] = &*children else { return Err(missing(object, name)) };
        let (at, headers) = (headers & !DATA, self.data(*headers, "the names of objects")?);
        let mut rest = Words {
            bytes: headers.get(..headers.len().saturating_sub(OBJECT_HASH_BYTES)).unwrap_or_default(),
            at,
        };
        for reference in objects {
            let length = rest.number(4)?;
            let found = rest.text(length)?;
            if rest.number(1)? == bits::METADATA_FOLLOW {
                let length = rest.number(4)?;
                rest.text(length)?;
            }
            if found == name {
                return Ok(*reference);
            }
        }
        Err(missing(object, name))
    }

    /// The properties in the object's compound property named `name`.
    pub(super) fn schema(&self, object: Reference, name: &str) -> Result<Vec<(PropertyHeader, Reference)>> {
        let properties = self.group(object, "an object")?.first().copied().unwrap_or(EMPTY_GROUP);
        let found = self.properties(properties)?.into_iter().find(|(header, _)| header.name == name);
        let (_, reference) = found.ok_or_else(|| missing(object, name))?;
        self.properties(reference)
    }

    /// The properties of a compound.
    pub(super) fn properties(&self, compound: Reference) -> Result<Vec<(PropertyHeader, Reference)>> {
        let children = self.group(compound, "a compound property")?;
        let Some((headers, references)) = children.split_last() else { return Ok(Vec::new()) };
        if references.len() > PROPERTY_COUNT_MAX {
            let what =
                format!("an object has {} properties; the limit is {PROPERTY_COUNT_MAX}", references.len());
            return Err(Error::too_large(FORMAT, what));
        }
        let bytes = self.data(*headers, "the headers of properties")?;
        let mut rest = Words { bytes, at: headers & !DATA };
        references.iter().map(|reference| Ok((rest.header()?, *reference))).collect()
    }
}

fn missing(object: Reference, name: &str) -> Error {
    Error::invalid(FORMAT, Position::Offset(object), format!("the object has no {name}"))
}

/// Reads headers, which are numbers and names one after the other.
struct Words<'a> {
    bytes: &'a [u8],
    /// The offset of the headers in the file, for errors.
    at: u64,
}

impl<'a> Words<'a> {
    fn take(&mut self, length: usize) -> Result<&'a [u8]> {
        let (taken, rest) = self.bytes.split_at_checked(length).ok_or_else(|| {
            let what = format!("expected {length} more bytes of headers, found {}", self.bytes.len());
            Error::invalid(FORMAT, Position::Offset(self.at), what)
        })?;
        self.bytes = rest;
        Ok(taken)
    }

    /// Reads a number of `width` bytes, at most four.
    fn number(&mut self, width: usize) -> Result<u32> {
        let mut number = [0; 4];
        number[..width].copy_from_slice(self.take(width)?);
        Ok(u32::from_le_bytes(number))
    }

    fn text(&mut self, length: u32) -> Result<String> {
        Ok(String::from_utf8_lossy(self.take(length as usize)?).into_owned())
    }

    fn header(&mut self) -> Result<PropertyHeader> {
        let word = self.number(4)?;
        let width = match word >> bits::WIDTH_SHIFT & 3 {
            0 => 1,
            1 => 2,
            _ => 4,
        };
        let mut sampling = 0;
        if word & bits::KIND != 0 {
            // Skip the number of samples, and the first and last sample that change: our writer stores all
            // samples.
            self.number(width)?;
            if word & bits::HAS_CHANGES != 0 {
                self.number(width)?;
                self.number(width)?;
            }
            if word & bits::HAS_TIMES != 0 {
                sampling = self.number(width)?;
            }
        }
        let length = self.number(width)?;
        let name = self.text(length)?;
        let mut metadata = String::new();
        if word >> bits::METADATA_SHIFT & bits::METADATA_FOLLOW == bits::METADATA_FOLLOW {
            let length = self.number(width)?;
            metadata = self.text(length)?;
        }
        Ok(PropertyHeader { name, sampling, metadata, word })
    }
}
