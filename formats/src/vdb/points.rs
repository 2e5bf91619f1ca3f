//! Reads particles from grids of points (`PointDataGrid`).
//!
//! ```text
//!   topology     as for a level set: the origins of the leaves
//!   pass 0       per leaf: the size of its voxels' data
//!   pass 1       the attributes' types, names and groups; per leaf and attribute: flags, stride, bytes
//!   pass 2 ..    per attribute: the sizes of its pages, each with the arrays of several leaves
//!   then         per leaf: mask, and for each voxel the end of its points
//!   then         per attribute: its pages or, without Blosc, an array per leaf
//! ```
//!
//! A position is relative to its voxel, from −½ to ½ voxel. A codec stores it with 32, 16 or 8 bits. An array
//! with the same value for all points of a leaf stores this value once. A group is a bit in an array of bytes.
//!
//! This work is based on:
//! the headers of OpenVDB 10, <https://www.openvdb.org>

use std::collections::HashMap;

use super::read::{GridEntry, entries, tree_cursor};
use super::read_tree::{TreeBudget, ValueStorage, outline_of_tree};
use super::{FORMAT, MetaValue, TYPE_POINTS, Transform, read_metadata};
use crate::core::blosc::decode_frame;
use crate::core::bytes::{Cursor, Endian};
use crate::core::data::{FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::{ParticlePart, frame_of_parts};
use crate::core::number::{self, NumberType};
use crate::core::text::{excerpt, excerpts};

/// Reads the particles of a file: the points of all its grids, in world space.
///
/// # Errors
///
/// [`Error::Truncated`] or [`Error::Invalid`], with the position, if the file is truncated or damaged;
/// [`Error::Unsupported`] for maps such as those of frustums, for files without points, and for leaves with
/// different attributes; [`Error::TooLarge`] beyond `limits`.
pub fn read_points(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let entries = entries(bytes, limits)?;
    let is_points = |entry: &&GridEntry| entry.info.type_name == TYPE_POINTS;
    let (grids, others): (Vec<_>, Vec<_>) = entries.iter().partition(is_points);
    if grids.is_empty() {
        return Err(Error::unsupported(FORMAT, "the file has no grid of points"));
    }
    let (mut parts, mut notes) = (Vec::new(), Vec::new());
    let mut total = PointsTotal { count: 0, bytes: 0, file_bytes: bytes.len() as u64, limits };
    for entry in grids {
        let (mut cursor, storage, transform) = tree_cursor(bytes, &entries, entry)?;
        // Voxels are integers of 32 bits. Only their size matters here, and they are never stored as halves.
        let storage = ValueStorage { half: false, ..storage };
        let mut budget = TreeBudget::new(bytes.len(), limits);
        let (_, origins, _) = outline_of_tree::<f32>(&mut cursor, storage, &mut budget)?;
        if !origins.is_empty() {
            let mut grid = PointGrid::read_headers(&mut cursor, origins, &mut total, &mut notes)?;
            parts.push(grid.read_arrays(&mut cursor, &transform, &mut notes)?);
        }
    }
    if !others.is_empty() {
        let names = others.iter().take(8).map(|entry| &entry.info.name);
        notes.push(format!("skipped grids that are not points: {}", excerpts(names)));
    }
    Ok(frame_of_parts(parts, "grids of points", notes))
}

/// What the points of all grids need so far.
struct PointsTotal<'a> {
    count: u64,
    bytes: u64,
    file_bytes: u64,
    limits: &'a Limits,
}

impl PointsTotal<'_> {
    /// Counts the points of a grid before they are read: arrays with a single value could have any length.
    fn claim(&mut self, count: u64, bytes_each: usize) -> Result<()> {
        self.count = self.count.saturating_add(count);
        self.bytes = self.bytes.saturating_add(count.saturating_mul(bytes_each as u64));
        self.limits.check_particles(FORMAT, self.count)?;
        self.limits.check_decompressed(FORMAT, self.bytes, self.file_bytes)
    }
}

/// Flags of an array.
mod flags {
    pub(super) const HIDDEN: u8 = 2;
    /// The array has a stride even if it is 1; without it, the number of values varies from point to point.
    pub(super) const CONSTANT_STRIDE: u8 = 8;
    /// How the array is stored: with a stride, with a single value, in pages; and all known flags.
    pub(super) const STRIDED: u8 = 1;
    pub(super) const UNIFORM: u8 = 2;
    pub(super) const PAGED: u8 = 8;
    pub(super) const KNOWN: u8 = 0x0f;
}

/// The array of an attribute in a leaf, before its values.
#[derive(Clone, Copy)]
struct PointArray {
    byte_count: usize,
    flags: u8,
    stored: u8,
    /// The number of points.
    count: usize,
    stride: usize,
}

impl PointArray {
    fn is(self, flag: u8) -> bool {
        self.stored & flag != 0
    }

    fn read(cursor: &mut Cursor) -> Result<PointArray> {
        const FIXED_BYTES: u64 = 6; // flags and size, which the number of bytes includes
        let length = cursor.u64("the size of an attribute")?;
        let (flags, stored) =
            (cursor.u8("the flags of an attribute")?, cursor.u8("the flags of an attribute")?);
        let count = cursor.u32("the number of points")? as usize;
        let length = length.checked_sub(FIXED_BYTES).and_then(|length| usize::try_from(length).ok());
        let Some(byte_count) = length.filter(|_| stored & !flags::KNOWN == 0) else {
            return Err(
                cursor.invalid(format!("an attribute has an invalid size, or unknown flags {stored:#x}"))
            );
        };
        let is_strided = stored & flags::STRIDED != 0;
        let stride = if is_strided { cursor.u32("the stride of an attribute")? as usize } else { 1 };
        Ok(PointArray { byte_count, flags, stored, count, stride })
    }
}

/// How the values of an attribute are stored.
#[derive(Clone, Copy, Debug, PartialEq)]
enum PointCodec {
    /// As they are, or with fewer bits: so many numbers of this type.
    Plain(NumberType, usize),
    /// Bytes or 16-bit integers that stand for 0 to 1, or from `offset` on; and how many.
    Fixed(NumberType, usize, f32),
    /// A direction in 16 bits.
    UnitVector,
    /// Indices into the strings of the metadata; 0 is an empty string.
    String,
    /// A bit for each group.
    Group,
}

impl PointCodec {
    /// The codec of values of this type; `None` if it is not supported.
    fn of(value: &str, codec: &str) -> Option<PointCodec> {
        let (number, arity) = match value {
            "bool" => (NumberType::Bool, 1),
            "half" => (NumberType::F16, 1),
            "float" => (NumberType::F32, 1),
            "double" => (NumberType::F64, 1),
            "vec3h" => (NumberType::F16, 3),
            "vec3s" => (NumberType::F32, 3),
            "vec3d" => (NumberType::F64, 3),
            "vec3i" => (NumberType::I32, 3),
            "quats" => (NumberType::F32, 4),
            "quatd" => (NumberType::F64, 4),
            "mat3s" => (NumberType::F32, 9),
            "mat3d" => (NumberType::F64, 9),
            "mat4s" => (NumberType::F32, 16),
            "mat4d" => (NumberType::F64, 16),
            _ => (NumberType::named(value)?, 1),
        };
        let is_real = matches!(number, NumberType::F32 | NumberType::F64);
        match codec {
            "null" => Some(PointCodec::Plain(number, arity)),
            "trnc" if number == NumberType::F32 => Some(PointCodec::Plain(NumberType::F16, arity)),
            "trnc" if number == NumberType::I32 => Some(PointCodec::Plain(NumberType::I16, arity)),
            "fxpt8" if is_real => Some(PointCodec::Fixed(NumberType::U8, arity, -0.5)),
            "fxpt16" if is_real => Some(PointCodec::Fixed(NumberType::U16, arity, -0.5)),
            "ufxpt8" if is_real => Some(PointCodec::Fixed(NumberType::U8, arity, 0.0)),
            "ufxpt16" if is_real => Some(PointCodec::Fixed(NumberType::U16, arity, 0.0)),
            "uvec" if arity == 3 => Some(PointCodec::UnitVector),
            "str" => Some(PointCodec::String),
            "grp" => Some(PointCodec::Group),
            _ => None,
        }
    }

    /// Values per element, and bytes of an element as stored.
    fn size(self) -> (usize, usize) {
        match self {
            PointCodec::Plain(number, arity) | PointCodec::Fixed(number, arity, _) => {
                (arity, arity * number.size())
            }
            PointCodec::UnitVector => (3, 2),
            PointCodec::String => (1, 4),
            PointCodec::Group => (1, 1),
        }
    }

    fn decode(self, bytes: &[u8], strings: &HashMap<i64, i32>) -> Values {
        let little = Endian::Little;
        match self {
            PointCodec::Plain(number, _) => number.decode(bytes, little),
            PointCodec::Group => NumberType::U8.decode(bytes, little),
            PointCodec::Fixed(number, _, offset) => match number.decode(bytes, little) {
                Values::U8(values) => {
                    Values::F32(values.iter().map(|&value| f32::from(value) / 255.0 + offset).collect())
                }
                // Up to 65535, so exact.
                Values::I32(values) => {
                    Values::F32(values.iter().map(|&value| value as f32 / 65535.0 + offset).collect())
                }
                values => values,
            },
            PointCodec::UnitVector => {
                let words = bytes.as_chunks().0.iter().map(|&word| u16::from_le_bytes(word));
                Values::F32(words.flat_map(unit_vector).collect())
            }
            PointCodec::String => {
                let words = bytes.as_chunks().0.iter().map(|&word| u32::from_le_bytes(word));
                let index = |word: u32| strings.get(&(i64::from(word) - 1)).copied().unwrap_or(-1);
                Values::Strings { table: Vec::new(), indices: words.map(index).collect() }
            }
        }
    }
}

/// The direction in 16 bits: three signs, and shares of x and y, of 126, in six and seven bits. If both are
/// stored as differences to 127, their sum exceeds 126.
fn unit_vector(word: u16) -> [f32; 3] {
    let (mut x, mut y) = (f32::from(word >> 7 & 0x3f), f32::from(word & 0x7f));
    if x + y > 126.0 {
        (x, y) = (127.0 - x, 127.0 - y);
    }
    let z = 126.0 - x - y;
    let length = (x * x + y * y + z * z).sqrt();
    let signed = |value: f32, bit: u16| if word >> bit & 1 == 1 { -value / length } else { value / length };
    [signed(x, 15), signed(y, 14), signed(z, 13)]
}

/// The types, names and groups of the attributes of a grid.
struct PointDescriptor {
    /// The names of the value type and of the codec.
    types: Vec<[String; 2]>,
    /// A name for each attribute, in the order of `types`; the file has another order.
    names: Vec<String>,
    /// Each group, and its bit among those of all arrays for groups.
    groups: Vec<(String, u64)>,
    /// The strings, and the place of each by its number in the file.
    strings: Vec<String>,
    string_places: HashMap<i64, i32>,
}

impl PointDescriptor {
    fn read(cursor: &mut Cursor, limits: &Limits) -> Result<PointDescriptor> {
        let count = |cursor: &mut Cursor, what: &str| -> Result<usize> {
            let count = cursor.u64(what)?;
            let found = usize::try_from(count).unwrap_or(usize::MAX);
            limits.check_attributes(FORMAT, found, "attributes or groups")?;
            Ok(found)
        };
        let mut types = Vec::new();
        for _ in 0..count(cursor, "the number of attributes")? {
            types.push([
                cursor.string("the type of an attribute")?,
                cursor.string("the codec of an attribute")?,
            ]);
        }
        let mut names = vec![String::new(); types.len()];
        for _ in 0..types.len() {
            let name = cursor.string("the name of an attribute")?;
            let index = cursor.u64("the index of an attribute")?;
            match usize::try_from(index).ok().and_then(|index| names.get_mut(index)) {
                Some(place) => *place = name,
                None => return Err(cursor.invalid(format!("attribute `{}` has no type", excerpt(&name)))),
            }
        }
        let mut groups = Vec::new();
        for _ in 0..count(cursor, "the number of groups")? {
            groups.push((cursor.string("the name of a group")?, cursor.u64("the bit of a group")?));
        }
        groups.sort();
        let (mut strings, mut string_places) = (Vec::new(), HashMap::new());
        for (key, value) in read_metadata(cursor)? {
            if let (Some(Ok(number)), MetaValue::String(text)) =
                (key.strip_prefix("string:").map(str::parse), value)
            {
                string_places.insert(number, i32::try_from(strings.len()).unwrap_or(-1));
                strings.push(text);
            }
        }
        Ok(PointDescriptor { types, names, groups, strings, string_places })
    }
}

/// A page of an attribute: the arrays of several leaves.
struct PointPage {
    /// Negative if the page is not compressed.
    stored: i32,
    byte_count: usize,
}

/// A grid of points whose headers are read.
struct PointGrid {
    origins: Vec<[i32; 3]>,
    descriptor: PointDescriptor,
    codecs: Vec<Option<PointCodec>>,
    /// The arrays of each leaf, attribute by attribute.
    arrays: Vec<PointArray>,
    /// The index of the attribute with the positions.
    position: usize,
    /// The pages of each attribute.
    pages: Vec<Vec<PointPage>>,
}

impl PointGrid {
    /// Reads passes 0, 1 and those with the sizes of pages.
    fn read_headers(
        cursor: &mut Cursor,
        origins: Vec<[i32; 3]>,
        total: &mut PointsTotal,
        notes: &mut Vec<String>,
    ) -> Result<PointGrid> {
        let pass_count = usize::from(cursor.u16("the number of passes")?).saturating_sub(4) / 2;
        cursor.take(2 * origins.len(), "the sizes of voxels")?;
        let header = cursor.u8("the header of a leaf")?;
        if header & 1 == 0 {
            let what = "the leaves have different attributes: save the points with the same attributes in all leaves";
            return Err(Error::unsupported(FORMAT, what));
        }
        let descriptor = PointDescriptor::read(cursor, total.limits)?;
        if header & 2 != 0 {
            let length = cursor.u64("the size of an extension")?;
            cursor.take(usize::try_from(length).unwrap_or(usize::MAX), "an extension")?;
        }
        let attribute_count = descriptor.types.len();
        if header > 3 || attribute_count > pass_count {
            let what = format!(
                "the leaves have the header {header} and {attribute_count} attributes; the passes are those of {pass_count}"
            );
            return Err(cursor.invalid(what));
        }
        let mut arrays = Vec::new();
        for _ in 0..origins.len() * attribute_count {
            arrays.push(PointArray::read(cursor)?);
        }
        let codecs: Vec<_> =
            descriptor.types.iter().map(|[value, codec]| PointCodec::of(value, codec)).collect();
        let Some(position) = descriptor.names.iter().position(|name| name == "P") else {
            return Err(cursor.invalid("the points have no attribute P"));
        };
        let grid = PointGrid { origins, descriptor, codecs, arrays, position, pages: Vec::new() };
        grid.check_positions(notes)?;
        total.claim(grid.arrays_of(position).map(|array| array.count as u64).sum(), grid.memory_each())?;
        grid.with_pages(cursor)
    }

    /// The arrays of an attribute, leaf by leaf.
    fn arrays_of(&self, attribute: usize) -> impl Iterator<Item = &PointArray> {
        self.arrays.iter().skip(attribute).step_by(self.codecs.len().max(1))
    }

    /// Fails if the positions have an unsupported type. Otherwise notes their precision.
    fn check_positions(&self, notes: &mut Vec<String>) -> Result<()> {
        let [value, codec] = &self.descriptor.types[self.position];
        let precision = match (self.codecs[self.position], value.as_str()) {
            (Some(PointCodec::Plain(NumberType::F32, 3)), _) => "32-bit floats",
            (Some(PointCodec::Plain(NumberType::F16, 3)), "vec3s") => {
                "16-bit floats: up to 1/4096 of a voxel off"
            }
            (Some(PointCodec::Fixed(NumberType::U16, 3, _)), _) => "16 bits: up to 1/131070 of a voxel off",
            (Some(PointCodec::Fixed(NumberType::U8, 3, _)), _) => "8 bits: up to 1/510 of a voxel off",
            _ => {
                let what = format!(
                    "the positions have the type {} with the codec {}: save them with 32 bits",
                    excerpt(value),
                    excerpt(codec)
                );
                return Err(Error::unsupported(FORMAT, what));
            }
        };
        notes.push(format!("positions are stored relative to their voxels, in {precision}"));
        Ok(())
    }

    /// Memory for a point, in bytes.
    fn memory_each(&self) -> usize {
        let attributes = self.codecs.iter().enumerate().map(|(attribute, codec)| {
            let stride = self.arrays.get(attribute).map_or(1, |array| array.stride);
            codec.map_or(0, |codec| codec.size().0.saturating_mul(stride).saturating_mul(8))
        });
        attributes.fold(24 + self.descriptor.groups.len(), usize::saturating_add)
    }

    /// Reads the sizes of the pages.
    fn with_pages(mut self, cursor: &mut Cursor) -> Result<PointGrid> {
        for attribute in 0..self.codecs.len() {
            let (mut pages, mut rest) = (Vec::new(), 0);
            for array in self.arrays_of(attribute).filter(|array| array.is(flags::PAGED)) {
                if rest == 0 {
                    let stored = cursor.i32("the size of a page")?;
                    let byte_count = match stored {
                        1.. => cursor.u32("the size of a page")?,
                        _ => stored.unsigned_abs(),
                    };
                    rest = byte_count as usize;
                    pages.push(PointPage { stored, byte_count: rest });
                }
                let Some(left) = rest.checked_sub(array.byte_count).filter(|_| array.byte_count > 0) else {
                    let what = format!("an array of {} bytes is in a page of {rest}", array.byte_count);
                    return Err(cursor.invalid(what));
                };
                rest = left;
            }
            self.pages.push(pages);
        }
        Ok(self)
    }

    /// Reads the voxels and the values of all attributes.
    fn read_arrays(
        &mut self,
        cursor: &mut Cursor,
        transform: &Transform,
        notes: &mut Vec<String>,
    ) -> Result<ParticlePart> {
        let mut voxels = Vec::new();
        for leaf in 0..self.origins.len() {
            cursor.take(64, "the mask of a leaf")?;
            voxels.extend(self.read_voxels(cursor, leaf)?);
        }
        let (mut positions, mut arrays, mut bits) = (FilePositions::default(), Vec::new(), Vec::new());
        for attribute in 0..self.codecs.len() {
            let name = std::mem::take(&mut self.descriptor.names[attribute]);
            let values = self.read_attribute(cursor, attribute, &name, notes)?;
            match (self.codecs[attribute], values) {
                (Some(PointCodec::Group), Some((_, Values::U8(values)))) => bits.push(values),
                // It counts among the arrays for groups even if it is not valid.
                (Some(PointCodec::Group), _) => bits.push(Vec::new()),
                (_, Some((_, Values::F32(values)))) if attribute == self.position => {
                    positions = self.world(&values, &voxels, transform);
                }
                (_, Some((arity, values))) => arrays.push(FileAttribute::new(name, arity, values)),
                (_, None) => {}
            }
        }
        for (name, bit) in &self.descriptor.groups {
            let bytes = usize::try_from(bit / 8).ok().and_then(|array| bits.get(array));
            match bytes {
                Some(bytes)
                    if bytes.len() == positions.len() && arrays.iter().all(|array| array.name != *name) =>
                {
                    let values = Values::U8(bytes.iter().map(|byte| byte >> (bit % 8) & 1).collect());
                    arrays.push(FileAttribute::new(name.clone(), 1, values));
                }
                _ => notes.push(format!("skipped the group `{}`", excerpt(name))),
            }
        }
        Ok(ParticlePart { positions, arrays })
    }

    /// The end of the points of each voxel of a leaf.
    fn read_voxels(&self, cursor: &mut Cursor, leaf: usize) -> Result<Vec<u32>> {
        const RAW: u16 = u16::MAX;
        const VOXELS_BYTES: usize = 4 * 512;
        let size = cursor.u16("the size of voxels")?;
        let mut bytes = [0; VOXELS_BYTES];
        if size == RAW {
            bytes.copy_from_slice(cursor.take(VOXELS_BYTES, "voxels")?);
        } else {
            let at = cursor.at() as u64;
            let frame = cursor.take(size.into(), "voxels")?;
            decode_frame(frame, &mut bytes).map_err(|error| error.of_format(FORMAT, at))?;
        }
        let ends: Vec<u32> = bytes.as_chunks().0.iter().map(|&word| u32::from_le_bytes(word)).collect();
        let count = self.arrays[leaf * self.codecs.len() + self.position].count;
        if !ends.is_sorted() || ends.last().is_none_or(|&end| end as usize != count) {
            let what = format!("the voxels of a leaf do not divide its {count} points");
            return Err(cursor.invalid(what));
        }
        Ok(ends)
    }

    /// The positions in the world, from those in voxels.
    fn world(&self, local: &[f32], voxels: &[u32], transform: &Transform) -> FilePositions {
        let Transform { axes, translation } = transform;
        let mut points = local.as_chunks::<3>().0.iter();
        let mut world = Vec::with_capacity(local.len() / 3);
        for (origin, ends) in self.origins.iter().zip(voxels.chunks(512)) {
            let mut start = 0;
            for (slot, &end) in ends.iter().enumerate() {
                let within = super::slot_coord(slot, super::LEAF_LOG2);
                for point in points.by_ref().take((end - start) as usize) {
                    let index: [f64; 3] = std::array::from_fn(|axis| {
                        f64::from(origin[axis]) + f64::from(within[axis]) + f64::from(point[axis])
                    });
                    world.push(std::array::from_fn(|axis| {
                        translation[axis] + (0..3).map(|along| index[along] * axes[along][axis]).sum::<f64>()
                    }));
                }
                start = end;
            }
        }
        FilePositions::F64(world)
    }

    /// Reads the values of an attribute in all leaves, and their number per point; `None`, with a note, if they
    /// are not supported.
    fn read_attribute(
        &self,
        cursor: &mut Cursor,
        attribute: usize,
        name: &str,
        notes: &mut Vec<String>,
    ) -> Result<Option<(usize, Values)>> {
        let first = self.arrays_of(attribute).next().copied();
        let stride = first.map_or(1, |array| array.stride);
        let is_hidden = first.is_some_and(|array| array.flags & flags::HIDDEN != 0);
        let (codec, [value_type, codec_type]) = (self.codecs[attribute], &self.descriptor.types[attribute]);
        let is_regular = |array: &PointArray| {
            let has_stride = array.flags & flags::CONSTANT_STRIDE != 0 || !array.is(flags::STRIDED);
            has_stride && array.stride == stride && stride > 0
        };
        let reason = match codec {
            None => {
                Some(format!("its type is {} with the codec {}", excerpt(value_type), excerpt(codec_type)))
            }
            Some(PointCodec::Group) => None,
            Some(_) if is_hidden => Some("it is hidden".to_owned()),
            Some(_) if !self.arrays_of(attribute).all(is_regular) => {
                Some("the number of its values varies from point to point".to_owned())
            }
            Some(_) if stride > 1 && attribute == self.position => {
                return Err(cursor.invalid("P has a stride"));
            }
            Some(_) => None,
        };
        if let Some(reason) = &reason {
            if attribute == self.position {
                return Err(Error::unsupported(FORMAT, format!("the positions cannot be read: {reason}")));
            }
            notes.push(format!("skipped `{}`: {reason}", excerpt(name)));
        }
        let codec = codec.filter(|_| reason.is_none());
        let mut all: Option<Values> = None;
        let mut pages = ArrayPages { pages: self.pages[attribute].iter(), page: Vec::new(), rest: 0..0 };
        for (leaf, array) in self.arrays_of(attribute).enumerate() {
            let bytes = if array.is(flags::PAGED) {
                pages.next_array(cursor, array)?
            } else {
                read_array(cursor, array, codec)?
            };
            let Some(codec) = codec else { continue };
            let values = self.leaf_values(cursor, leaf, (array, &bytes), (attribute, codec))?;
            match &mut all {
                None => all = Some(values),
                Some(all) => drop(number::append(all, values)),
            }
        }
        if let Some(Values::Strings { table, .. }) = &mut all {
            table.clone_from(&self.descriptor.strings);
        }
        Ok(all.zip(codec).map(|(values, codec)| (codec.size().0 * stride, values)))
    }

    /// Decodes the values of an array, which has one for each point, or one for all.
    fn leaf_values(
        &self,
        cursor: &Cursor,
        leaf: usize,
        (array, bytes): (&PointArray, &[u8]),
        (attribute, codec): (usize, PointCodec),
    ) -> Result<Values> {
        let expected = self.arrays[leaf * self.codecs.len() + self.position].count;
        let element_bytes = codec.size().1;
        let element_count = array.count.saturating_mul(array.stride);
        let stored_count = if array.is(flags::UNIFORM) { 1 } else { element_count };
        if array.count != expected || stored_count.checked_mul(element_bytes) != Some(bytes.len()) {
            let what = format!(
                "attribute {attribute} of a leaf has {} bytes for {} points of {expected}",
                bytes.len(),
                array.count
            );
            return Err(cursor.invalid(what));
        }
        let places = &self.descriptor.string_places;
        if array.is(flags::UNIFORM) {
            return Ok(codec.decode(&bytes.repeat(element_count), places));
        }
        Ok(codec.decode(bytes, places))
    }
}

/// Reads an array that is not in a page.
fn read_array(cursor: &mut Cursor, array: &PointArray, codec: Option<PointCodec>) -> Result<Vec<u8>> {
    let is_packed = !array.is(flags::UNIFORM) && cursor.u8("the compression of an attribute")? == 1;
    let at = cursor.at() as u64;
    let bytes = cursor.take(array.byte_count, "an attribute")?;
    match codec.filter(|_| is_packed) {
        Some(codec) => {
            let element_count = array.count.saturating_mul(array.stride);
            unpacked(bytes, element_count.saturating_mul(codec.size().1), at)
        }
        None => Ok(bytes.to_vec()),
    }
}

/// Decodes a Blosc frame of so many bytes. OpenVDB fills short ones with zeros up to 128 bytes.
fn unpacked(frame: &[u8], byte_count: usize, at: u64) -> Result<Vec<u8>> {
    const PADDED_BYTES: usize = 128;
    /// More than LZ4 can expand.
    const RATIO_MAX: usize = 256;
    let declared = frame.get(4..).and_then(|rest| rest.first_chunk()).map(|bytes| u32::from_le_bytes(*bytes));
    let is_padded = byte_count < PADDED_BYTES && declared == u32::try_from(PADDED_BYTES).ok();
    let filled = if is_padded { PADDED_BYTES } else { byte_count };
    if filled / RATIO_MAX > frame.len() {
        let what = format!("{} bytes of Blosc cannot have {byte_count} bytes of values", frame.len());
        return Err(Error::invalid(FORMAT, Position::Offset(at), what));
    }
    let mut bytes = vec![0; filled];
    decode_frame(frame, &mut bytes).map_err(|error| error.of_format(FORMAT, at))?;
    bytes.truncate(byte_count);
    Ok(bytes)
}

/// Takes the arrays of an attribute from its pages.
struct ArrayPages<'a> {
    pages: std::slice::Iter<'a, PointPage>,
    page: Vec<u8>,
    /// The bytes of the page that are not yet taken.
    rest: std::ops::Range<usize>,
}

impl ArrayPages<'_> {
    fn next_array(&mut self, cursor: &mut Cursor, array: &PointArray) -> Result<Vec<u8>> {
        if self.rest.is_empty()
            && let Some(page) = self.pages.next()
        {
            let at = cursor.at() as u64;
            let bytes = cursor.take(page.stored.unsigned_abs() as usize, "a page")?;
            self.page = if page.stored > 0 { unpacked(bytes, page.byte_count, at)? } else { bytes.to_vec() };
            self.rest = 0..self.page.len();
        }
        let end = self.rest.start.saturating_add(array.byte_count);
        let bytes = self.page.get(self.rest.start..end).map(<[u8]>::to_vec);
        self.rest.start = end;
        bytes.ok_or_else(|| cursor.invalid("an array exceeds its page"))
    }
}
