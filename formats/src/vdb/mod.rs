//! OpenVDB files: writes level sets and attributes of their voxels; reads grids of floats, of vectors and of
//! points.
//!
//! ```text
//!   header      magic, version 224, UUID, metadata of the file, number of grids
//!   descriptor  name, Tree_float_5_4_3[_HalfFloat], three file offsets      ┐
//!   grid        compression, metadata, transform                            │ per
//!   topology    root ─▶ nodes of 32³ ─▶ nodes of 16³ ─▶ masks of 8³ leaves  │ grid
//!   buffers     per leaf in the same order: mask, values                    ┘
//!
//!   voxels across:  root child 4096 = 32 · 128,   128 = 16 · 8,   leaf 8
//! ```
//!
//! A node stores one value per slot. If a slot has no child, its value applies to all voxels of the slot:
//! this is a *tile*. A level set is a float grid. Its background is the half width of its band. A voxel is
//! active exactly if |φ| is less than the background. Inactive voxels and tiles are exactly the positive
//! background outside, and the negative background inside.
//!
//! This crate has its own writer, because the other crates that write these files are first releases. It has
//! its own reader, because the one older crate loses the sign of inactive voxels.
//!
//! This work is based on:
//! the file format of OpenVDB 10, <https://www.openvdb.org>

mod flood;
mod points;
mod read;
mod read_tree;
mod tree;
mod write;

use std::fmt;
use std::str::FromStr;

pub use points::read_points;
pub use read::{
    GridInfo, LevelSetOutline, grids, has_velocity, level_set_outline, read_level_set, read_vectors,
};
pub use read_tree::{ConstantTile, GridData, LevelSetData, VectorGridData};
pub use write::{EncodedVdb, WriteOptions, encode, grid_notes, write};

use crate::core::bytes::Cursor;
use crate::core::error::{Error, Result};
use crate::core::options::WriteOption;
use crate::core::provenance::from_strings;
use crate::core::row::{Content, FormatRow, Integrity, OutputRow, ParticleReader};
use read::{cursor_of, first_grid_metadata, first_grid_type, last_grid_end};

/// The format's name in errors.
const FORMAT: &str = "OpenVDB";

/// The compression of values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Compression {
    /// All values of each leaf, uncompressed.
    None,
    /// Only the values of active voxels.
    ActiveMask,
    /// Only the values of active voxels, in Blosc frames with LZ4: OpenVDB's default.
    #[default]
    Blosc,
}

impl Compression {
    /// All compression methods.
    pub const ALL: [Compression; 3] = [Compression::None, Compression::ActiveMask, Compression::Blosc];

    /// The name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Compression::None => "none",
            Compression::ActiveMask => "active",
            Compression::Blosc => "blosc",
        }
    }
}

/// How values are stored; as text a list of words, such as `half,none`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ValueEncoding {
    /// 16-bit floats, with about three significant digits, in place of 32-bit ones.
    pub half: bool,
    /// Their compression.
    pub compression: Compression,
}

impl fmt::Display for ValueEncoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", if self.half { "half," } else { "" }, self.compression.name())
    }
}

impl FromStr for ValueEncoding {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<ValueEncoding, String> {
        let (mut half, mut compression) = (false, None);
        for word in text.split(',').map(str::trim) {
            let named = Compression::ALL.into_iter().find(|known| known.name().eq_ignore_ascii_case(word));
            match named {
                Some(_) if compression.is_some() => {
                    return Err(format!("`{text}` names two compressions"));
                }
                Some(_) => compression = named,
                None if word.eq_ignore_ascii_case("half") => half = true,
                None => {
                    return Err(format!(
                        "`{word}` is unknown: expected half, none, active or blosc, such as half,blosc"
                    ));
                }
            }
        }
        Ok(ValueEncoding { half, compression: compression.unwrap_or_default() })
    }
}

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow { signatures: &[b" BDV\0\0\0\0"], ..FormatRow::new(FORMAT, &["vdb"]) },
    help: "The level set, for OpenVDB",
    content: Content::LevelSet,
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Values],
    read_provenance: |head| {
        let string = |(key, value)| match value {
            MetaValue::String(value) => Some((key, value)),
            _ => None,
        };
        Ok(from_strings(first_grid_metadata(head)?.into_iter().filter_map(string).collect()))
    },
    integrity: Integrity::Length(|head, read| last_grid_end(head, |start| read(start, DESCRIPTOR_BYTES_MAX))),
};

/// The row of files with points. Their signature is that of level sets: [`starts_with_points`] identifies them.
pub(crate) static POINTS: FormatRow = FormatRow {
    beginnings: &[&MAGIC],
    particles: Some(ParticleReader::needs_reading(read_points)),
    ..FormatRow::new("OpenVDB points", &["vdb"])
};

/// Whether the first grid of a file has points, judged by the first bytes of the file.
pub(crate) fn starts_with_points(head: &[u8]) -> bool {
    first_grid_type(head).is_ok_and(|type_name| type_name.starts_with(TYPE_POINTS))
}

/// Fails if a file ends before the type of its first grid, so that it is not known what the file contains.
pub(crate) fn check_first_grid(bytes: &[u8]) -> Result<()> {
    first_grid_type(bytes).map(drop).or_else(|error| if error.is_truncated() { Err(error) } else { Ok(()) })
}

/// Longer than any descriptor of a grid that this crate writes.
const DESCRIPTOR_BYTES_MAX: u64 = 64 << 10;

// Where the voxels of a grid are in the world.

/// An affine map: voxel (i, j, k) is centred on `translation + i·axes[0] + j·axes[1] + k·axes[2]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transform {
    /// Steps from a voxel to the next along each index, world units.
    pub axes: [[f64; 3]; 3],
    /// World position of voxel (0, 0, 0).
    pub translation: [f64; 3],
}

impl Transform {
    /// The lengths of the steps along each index, world units.
    pub fn voxel_size(&self) -> [f64; 3] {
        self.axes.map(|[x, y, z]| (x * x + y * y + z * z).sqrt())
    }
}

// Typed metadata entries of a file or a grid.

/// A value of OpenVDB metadata.
#[derive(Clone, Debug, PartialEq)]
pub enum MetaValue {
    /// `string`.
    String(String),
    /// `bool`.
    Bool(bool),
    /// `int32` and `int64`.
    Integer(i64),
    /// `float` and `double`.
    Real(f64),
    /// `vec3i`.
    Vec3i([i32; 3]),
    /// `vec3s` and `vec3d`.
    Vec3d([f64; 3]),
    /// Any other type: its name and its size in bytes.
    Other(String, usize),
}

/// Metadata to write, in order.
#[derive(Default)]
struct MetaWriter {
    count: u32,
    entries: Vec<u8>,
}

impl MetaWriter {
    fn push(&mut self, name: &str, type_name: &str, value: &[u8]) {
        self.count += 1;
        push_string(&mut self.entries, name.as_bytes());
        push_string(&mut self.entries, type_name.as_bytes());
        push_string(&mut self.entries, value);
    }

    fn string(&mut self, name: &str, value: &str) {
        self.push(name, "string", value.as_bytes());
    }

    fn int64(&mut self, name: &str, value: i64) {
        self.push(name, "int64", &value.to_le_bytes());
    }

    fn vec3i(&mut self, name: &str, value: [i32; 3]) {
        self.push(name, "vec3i", &value.map(i32::to_le_bytes).concat());
    }

    fn append_to(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(&self.count.to_le_bytes());
        out.extend_from_slice(&self.entries);
    }
}

/// Appends a u32 length and the bytes.
fn push_string(out: &mut Vec<u8>, bytes: &[u8]) {
    // The writer only stores names and provenance; an overlong string is truncated to keep the file readable.
    let length = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
    out.extend_from_slice(&length.to_le_bytes());
    out.extend_from_slice(&bytes[..length as usize]);
}

/// Reads the entries of a file or a grid.
fn read_metadata(cursor: &mut Cursor) -> Result<Vec<(String, MetaValue)>> {
    const ENTRY_BYTES_MIN: usize = 12;
    const ENTRY_COUNT_MAX: usize = 1 << 16; // real files have a few dozen
    let count = cursor.u32("the number of metadata entries")? as usize;
    if count > cursor.remaining() / ENTRY_BYTES_MIN {
        return Err(cursor.invalid(format!(
            "the file declares {count} metadata entries of at least {ENTRY_BYTES_MIN} bytes each, \
             but only {} bytes follow",
            cursor.remaining()
        )));
    }
    if count > ENTRY_COUNT_MAX {
        return Err(Error::too_large(
            FORMAT,
            format!("the file has {count} metadata entries, more than the limit of {ENTRY_COUNT_MAX}"),
        ));
    }
    let mut entries = Vec::with_capacity(count);
    for _ in 0..count {
        let name = cursor.string("the name of a metadata entry")?;
        let type_name = cursor.string("the type of a metadata entry")?;
        let byte_count = cursor.u32("the size of a metadata entry")? as usize;
        let bytes = cursor.take(byte_count, "the value of a metadata entry")?;
        if !type_name.starts_with("__") {
            entries.push((name, read_value(&type_name, bytes)));
        }
    }
    Ok(entries)
}

fn read_value(type_name: &str, bytes: &[u8]) -> MetaValue {
    let mut cursor = cursor_of(bytes);
    let value = match (type_name, bytes.len()) {
        ("string", _) => Ok(MetaValue::String(String::from_utf8_lossy(bytes).into_owned())),
        ("bool", 1) => Ok(MetaValue::Bool(bytes[0] != 0)),
        ("int32", 4) => cursor.i32("").map(|value| MetaValue::Integer(value.into())),
        ("int64", 8) => cursor.i64("").map(MetaValue::Integer),
        ("float", 4) => cursor.f32("").map(|value| MetaValue::Real(value.into())),
        ("double", 8) => cursor.f64("").map(MetaValue::Real),
        ("vec3i", 12) => cursor.coord("").map(MetaValue::Vec3i),
        ("vec3s", 12) => read_vector(|| cursor.f32("").map(f64::from)),
        ("vec3d", 24) => read_vector(|| cursor.f64("")),
        _ => Ok(MetaValue::Other(type_name.into(), bytes.len())),
    };
    value.unwrap_or_else(|_| MetaValue::Other(type_name.into(), bytes.len()))
}

fn read_vector(mut next: impl FnMut() -> Result<f64>) -> Result<MetaValue> {
    Ok(MetaValue::Vec3d([next()?, next()?, next()?]))
}

// Constants and helpers of the file format, shared by writer and reader.

/// The first eight bytes of a file.
const MAGIC: [u8; 8] = *b"\x20BDV\0\0\0\0";
/// The file version that the writer uses: all versions of OpenVDB since 4 read it without warnings.
const VERSION_WRITTEN: u32 = 224;
/// The file versions that the reader supports.
const VERSIONS_READ: std::ops::RangeInclusive<u32> = 222..=225;
/// The version of the OpenVDB library, major and minor, that the writer records in the header: it writes the
/// layout of OpenVDB 10.0.
const LIBRARY_VERSION: [u32; 2] = [10, 0];
const UUID_BYTES: usize = 36;

const TYPE_FLOAT: &str = "Tree_float_5_4_3";
const TYPE_VEC3S: &str = "Tree_vec3s_5_4_3";
const TYPE_POINTS: &str = "Tree_ptdataidx32_5_4_3";
/// The name of a grid of velocities, by which programs find it.
const VELOCITY: &str = "velocity";
const HALF_SUFFIX: &str = "_HalfFloat";
const META_HALF: &str = "is_saved_as_half_float";

/// Bits of the compression word of a grid.
const COMPRESS_ZIP: u32 = 1;
const COMPRESS_ACTIVE_MASK: u32 = 2;
const COMPRESS_BLOSC: u32 = 4;

/// The first byte of a block of values: it encodes the values of inactive slots.
mod inactive {
    /// All are + background, or there are no inactive slots.
    pub(super) const PLUS_BACKGROUND: u8 = 0;
    /// All are − background.
    pub(super) const MINUS_BACKGROUND: u8 = 1;
    /// All have the value that follows.
    pub(super) const ONE_VALUE: u8 = 2;
    /// A mask follows: on for + background, off for − background.
    pub(super) const MASK_OF_BACKGROUNDS: u8 = 3;
    /// A value and a mask follow: on for + background, off for the value.
    pub(super) const MASK_AND_ONE_VALUE: u8 = 4;
    /// Two values and a mask follow: on for the second, off for the first.
    pub(super) const MASK_AND_TWO_VALUES: u8 = 5;
    /// The value of every slot is stored.
    pub(super) const ALL_VALUES: u8 = 6;
}

/// Log2 of the number of slots along an edge: of a leaf (LEAF), a lower internal node (NODE4) and an upper
/// internal node (NODE5).
const LEAF_LOG2: u32 = 3;
const NODE4_LOG2: u32 = 4;
const NODE5_LOG2: u32 = 5;

/// Log2 of the number of voxels along an edge: of a lower and of an upper internal node.
const NODE4_VOXELS_LOG2: u32 = LEAF_LOG2 + NODE4_LOG2;
const NODE5_VOXELS_LOG2: u32 = NODE4_VOXELS_LOG2 + NODE5_LOG2;

/// The index of a child's slot in its parent, with z varying fastest. `coord` is the child's position in the
/// world, in units of its edge length; the parent has 2^`log2` slots along an edge.
fn slot_of(coord: [i32; 3], log2: u32) -> usize {
    let mask = (1 << log2) - 1;
    let [x, y, z] = coord.map(|c| (c & mask) as usize);
    x << (2 * log2) | y << log2 | z
}

/// The position of the child in a slot, from the minimum corner of the parent, in units of the child's edge
/// length.
fn slot_coord(slot: usize, log2: u32) -> [i32; 3] {
    let mask = (1 << log2) - 1;
    #[expect(clippy::cast_possible_truncation, reason = "masked to five bits at most")]
    let coord = [slot >> (2 * log2), slot >> log2, slot].map(|c| (c & mask) as i32);
    coord
}

/// The slots that are on in a mask, in order.
fn ones(mask: &[u64]) -> impl Iterator<Item = usize> + '_ {
    mask.iter().enumerate().flat_map(|(index, &word)| {
        std::iter::successors((word != 0).then_some(word), |&rest| {
            let rest = rest & (rest - 1);
            (rest != 0).then_some(rest)
        })
        .map(move |rest| index * 64 + rest.trailing_zeros() as usize)
    })
}

/// The number of slots that are on.
fn count_ones(mask: &[u64]) -> usize {
    mask.iter().map(|word| word.count_ones() as usize).sum()
}

/// Whether a slot is on.
fn is_on(mask: &[u64], slot: usize) -> bool {
    mask[slot >> 6] >> (slot & 63) & 1 == 1
}
