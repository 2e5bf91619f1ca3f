//! Lists the grids of an OpenVDB file, and finds the one to read.
//!
//! A file with offsets records where each grid ends, so grids of any type can be listed. A stream has no
//! offsets: the reader must parse a grid to find the next one, and it can parse only float and vector grids.

use std::io::{Read, Seek, SeekFrom};

use super::read_tree::{
    GridData, LevelSetData, TreeBudget, TreeSize, ValueStorage, VectorGridData, VoxelValue, count_tree,
    outline_of_tree, pass_tree, read_tree,
};
use super::{
    DESCRIPTOR_BYTES_MAX, FORMAT, HALF_SUFFIX, MAGIC, META_HALF, MetaValue, TYPE_FLOAT, TYPE_VEC3S,
    Transform, UUID_BYTES, VELOCITY, VERSIONS_READ, read_metadata,
};
use crate::core::bytes::{Cursor, Endian};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::provenance::HEAD_BYTES_MAX;
use crate::core::text::excerpt;

/// A grid of a file.
#[derive(Clone, Debug)]
pub struct GridInfo {
    /// The name shown to users.
    pub name: String,
    /// The name, followed by `[n]` if several grids have this name. Identifies the grid.
    pub unique_name: String,
    /// The type of the tree, such as `Tree_float_5_4_3`.
    pub type_name: String,
    /// Whether floats are stored in 16 bits.
    pub half: bool,
    /// `level set`, `fog volume`, `staggered` or another class from the file; empty if the file has none.
    pub class: String,
    /// Maps voxel coordinates to world positions; `None` if the file uses an unsupported kind of map.
    pub transform: Option<Transform>,
    /// The minimum and maximum coordinates of the active voxels; `None` if the file does not state them, or
    /// no voxel is active.
    pub active_bounds: Option<([i32; 3], [i32; 3])>,
    /// The number of active voxels, if the file states it.
    pub active_voxel_count: Option<u64>,
    /// All metadata of the grid, including the entries that the fields above were read from.
    pub metadata: Vec<(String, MetaValue)>,
}

/// The grids of a file, in file order.
///
/// # Errors
///
/// [`Error::Invalid`] if the file is not OpenVDB or is damaged; [`Error::Unsupported`] for file versions
/// outside 222 ..= 225, and for streams with a grid that cannot be skipped.
pub fn grids(bytes: &[u8], limits: &Limits) -> Result<Vec<GridInfo>> {
    Ok(entries(bytes, limits)?.into_iter().map(|entry| entry.info).collect())
}

/// Reads a float grid: the one with the given name or unique name, or else the first level set, or else the
/// first float grid.
///
/// # Errors
///
/// Those of [`grids`]; [`Error::Unsupported`] also if there is no such grid, or if its type or codec is not
/// supported; [`Error::MemoryLimit`] if the grid needs more memory than `limits` allow. The reader counts the
/// leaves and tiles first, so it fails before it allocates memory for them.
pub fn read_level_set(bytes: &[u8], name: Option<&str>, limits: &Limits) -> Result<LevelSetData> {
    let entries = entries(bytes, limits)?;
    let entry = find_level_set(&entries, name)?;
    let (mut cursor, storage, _) = tree_cursor(bytes, &entries, entry)?;
    let size = count_tree::<f32>(&mut cursor, storage, &mut TreeBudget::counting(bytes.len(), limits))?;
    limits.check_memory(bytes.len() as u64 + size.memory_bytes(), &size.described())?;
    read_grid(bytes, &entries, entry, limits)
}

/// The part of a level set that determines how much memory it needs.
#[derive(Clone, Debug)]
pub struct LevelSetOutline {
    /// Maps voxel coordinates to world positions.
    pub transform: Transform,
    /// Half the thickness of the band, world units.
    pub background: f32,
    /// Origins of the leaves, in voxels.
    pub origins: Vec<[i32; 3]>,
    size: TreeSize,
}

impl LevelSetOutline {
    /// Fails, like [`Limits::check_memory`], if reading the file of this size, or using its level set,
    /// needs more memory than the limit.
    ///
    /// # Errors
    /// [`Error::MemoryLimit`] with the larger of the two amounts.
    pub fn check_memory(&self, file_bytes: u64, using_bytes: u64, limits: &Limits) -> Result<()> {
        let reading_bytes = file_bytes.saturating_add(self.size.memory_bytes());
        limits.check_memory(reading_bytes.max(using_bytes), &self.size.described())
    }
}

/// The outline of the grid that [`read_level_set`] reads. Takes much less memory: at most a fifth of the
/// file's size.
///
/// # Errors
///
/// Those of [`read_level_set`], except that for too little memory.
pub fn level_set_outline(bytes: &[u8], name: Option<&str>, limits: &Limits) -> Result<LevelSetOutline> {
    let entries = entries(bytes, limits)?;
    let entry = find_level_set(&entries, name)?;
    let (mut cursor, storage, transform) = tree_cursor(bytes, &entries, entry)?;
    let mut budget = TreeBudget::counting(bytes.len(), limits);
    let (background, origins, size) = outline_of_tree(&mut cursor, storage, &mut budget)?;
    Ok(LevelSetOutline { transform, background, origins, size })
}

fn find_level_set<'a>(entries: &'a [GridEntry], name: Option<&str>) -> Result<&'a GridEntry> {
    let found = match name {
        Some(name) => {
            let unique = entries.iter().find(|entry| entry.info.unique_name == name);
            unique.or_else(|| entries.iter().find(|entry| entry.info.name == name))
        }
        None => {
            let float = |entry: &&GridEntry| entry.info.type_name == TYPE_FLOAT;
            let level_set = |entry: &&GridEntry| float(entry) && entry.info.class == "level set";
            entries.iter().find(level_set).or_else(|| entries.iter().find(float))
        }
    };
    let Some(entry) = found.filter(|entry| entry.info.type_name == TYPE_FLOAT) else {
        if entries.is_empty() {
            return Err(Error::unsupported(FORMAT, "the file has no grids"));
        }
        let wanted = name.map_or("no float grid".into(), |name| format!("no float grid named \"{name}\""));
        let mut names: Vec<String> = (entries.iter().take(8))
            .map(|e| format!("\"{}\" of type {}", excerpt(&e.info.unique_name), excerpt(&e.info.type_name)))
            .collect();
        names.extend(entries.get(8).map(|_| "…".to_owned()));
        return Err(Error::unsupported(
            FORMAT,
            format!("the file has {wanted}; it contains {}", names.join(", ")),
        ));
    };
    Ok(entry)
}

/// Reads the first grid of three-component float vectors with one of these names; `None` if there is none.
///
/// # Errors
///
/// Those of [`read_level_set`].
pub fn read_vectors(bytes: &[u8], names: &[&str], limits: &Limits) -> Result<Option<VectorGridData>> {
    let entries = entries(bytes, limits)?;
    let is_meant =
        |entry: &&GridEntry| entry.info.type_name == TYPE_VEC3S && names.contains(&entry.info.name.as_str());
    entries.iter().find(is_meant).map(|entry| read_grid(bytes, &entries, entry, limits)).transpose()
}

fn read_grid<V: VoxelValue>(
    bytes: &[u8],
    entries: &[GridEntry],
    entry: &GridEntry,
    limits: &Limits,
) -> Result<GridData<V>> {
    let (mut cursor, storage, transform) = tree_cursor(bytes, entries, entry)?;
    let info = entry.info.clone();
    let tree = read_tree(&mut cursor, storage, &mut TreeBudget::new(bytes.len(), limits))?;
    Ok(GridData { name: info.name, class: info.class, transform, metadata: info.metadata, ..tree })
}

/// A cursor at the start of a grid's tree, the storage of its values, and its transform.
pub(super) fn tree_cursor<'a>(
    bytes: &'a [u8],
    entries: &[GridEntry],
    entry: &GridEntry,
) -> Result<(Cursor<'a>, ValueStorage, Transform)> {
    let (Some(tree), Some(transform)) = (entry.tree_of(entries), entry.info.transform) else {
        let what = format!(
            "grid \"{}\" has an unsupported transform, or is an instance of a grid that is missing or unsupported: resample it with a \
             uniform voxel size, and save it without instances",
            excerpt(&entry.info.name)
        );
        return Err(Error::unsupported(FORMAT, what));
    };
    let mut cursor = cursor_of(&bytes[..tree.end]);
    cursor.seek(tree.position as u64, "a grid")?;
    Ok((cursor, tree.storage, transform))
}

/// The metadata of the file's first grid, from the first bytes of the file.
pub(crate) fn first_grid_metadata(head: &[u8]) -> Result<Vec<(String, MetaValue)>> {
    let mut cursor = cursor_of(head);
    let header = read_header(&mut cursor)?;
    if header.grid_count == 0 {
        return Ok(Vec::new());
    }
    let descriptor = read_descriptor(&mut cursor)?;
    if header.has_offsets {
        cursor.seek(descriptor.grid_start, "a grid")?;
    }
    cursor.u32("the compression of a grid")?;
    read_metadata(&mut cursor)
}

/// The type of the tree of a file's first grid, from the first bytes of the file.
pub(super) fn first_grid_type(head: &[u8]) -> Result<String> {
    let mut cursor = cursor_of(head);
    read_header(&mut cursor)?;
    Ok(read_descriptor(&mut cursor)?.type_name)
}

/// Whether a file of this crate has a grid of velocities. Reads only the names of the grids.
///
/// # Errors
///
/// [`Error::Io`] if reading fails; [`Error::Invalid`] if the file is not OpenVDB or is damaged.
pub fn has_velocity(file: &mut (impl Read + Seek)) -> Result<bool> {
    let mut read = |start: u64, byte_count: u64| -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        file.seek(SeekFrom::Start(start))?;
        file.by_ref().take(byte_count).read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    let head = read(0, HEAD_BYTES_MAX)?;
    let mut found = false;
    let visit = |grid: &Descriptor| found |= grid.name == VELOCITY && grid.type_name.starts_with(TYPE_VEC3S);
    walk_grids(&head, |start| read(start, DESCRIPTOR_BYTES_MAX), visit)?;
    Ok(found)
}

/// The offset of the end of a file's last grid. `read_at` returns the bytes at an offset: it is called with
/// the end of each grid except the last, where the next descriptor starts. Returns `None` if there are no
/// grids, if the file is a stream without offsets, or if a grid ends before it starts.
pub(crate) fn last_grid_end(head: &[u8], read_at: impl FnMut(u64) -> Result<Vec<u8>>) -> Result<Option<u64>> {
    walk_grids(head, read_at, |_| {})
}

/// Calls `visit` with the descriptors of all grids, and returns what [`last_grid_end`] does.
fn walk_grids(
    head: &[u8],
    mut read_at: impl FnMut(u64) -> Result<Vec<u8>>,
    mut visit: impl FnMut(&Descriptor),
) -> Result<Option<u64>> {
    let mut cursor = cursor_of(head);
    let header = read_header(&mut cursor)?;
    if header.grid_count == 0 || !header.has_offsets {
        return Ok(None);
    }
    let first = read_descriptor(&mut cursor)?;
    visit(&first);
    let mut end = first.end;
    for _ in 1..header.grid_count {
        let next = read_descriptor(&mut cursor_of(&read_at(end)?))?;
        if next.grid_start <= end || next.end < next.grid_start {
            return Ok(None);
        }
        visit(&next);
        end = next.end;
    }
    Ok(Some(end))
}

/// The location of a tree and the storage of its values.
#[derive(Clone, Copy)]
struct TreeLocation {
    position: usize,
    /// The end of the grid; the end of the file if the end of the grid is unknown.
    end: usize,
    storage: ValueStorage,
}

pub(super) struct GridEntry {
    pub(super) info: GridInfo,
    /// The name in the descriptor, which instances refer to.
    descriptor_name: String,
    /// The unique name of the grid whose tree this one shares, or empty.
    instance_parent: String,
    tree: Option<TreeLocation>,
}

impl GridEntry {
    fn tree_of(&self, entries: &[GridEntry]) -> Option<TreeLocation> {
        if self.instance_parent.is_empty() {
            return self.tree;
        }
        let parent = entries.iter().find(|entry| entry.descriptor_name == self.instance_parent)?;
        parent.tree.filter(|_| parent.info.type_name == self.info.type_name)
    }
}

pub(super) fn entries(bytes: &[u8], limits: &Limits) -> Result<Vec<GridEntry>> {
    let mut cursor = cursor_of(bytes);
    let header = read_header(&mut cursor)?;
    let mut entries = Vec::new();
    for index in 0..header.grid_count {
        let descriptor = read_descriptor(&mut cursor)?;
        if header.has_offsets {
            let (mut grid, end) = grid_cursor(&cursor, &descriptor, bytes)?;
            entries.push(read_entry(&mut grid, descriptor)?);
            cursor.seek(end, "the end of a grid")?;
            continue;
        }
        let entry = read_entry(&mut cursor, descriptor)?;
        let is_last = index + 1 == header.grid_count;
        if !is_last && entry.instance_parent.is_empty() {
            skip_tree(&mut cursor, &entry, limits)?;
        }
        entries.push(entry);
    }
    Ok(entries)
}

/// A cursor at the start of a grid, limited to the grid's bytes, and the offset of the grid's end.
///
/// Descriptors and grids must alternate. If grids could overlap, each could claim the bytes of all others,
/// and a small file would use the memory of a large one.
fn grid_cursor<'a>(after: &Cursor, descriptor: &Descriptor, bytes: &'a [u8]) -> Result<(Cursor<'a>, u64)> {
    let Descriptor { grid_start, end, .. } = *descriptor;
    let within = usize::try_from(end).ok().and_then(|end| bytes.get(..end));
    let Some(within) = within.filter(|_| after.at() as u64 <= grid_start && grid_start <= end) else {
        let length = bytes.len();
        if end > length as u64 {
            let what = format!("a grid ends at byte {end}, but the file at {length}");
            return Err(after.truncated(what));
        }
        let what = format!("a grid has the invalid range from byte {grid_start} to byte {end} of {length}");
        return Err(after.invalid(what));
    };
    let mut grid = cursor_of(within);
    grid.seek(grid_start, "a grid")?;
    Ok((grid, end))
}

struct FileHeader {
    has_offsets: bool,
    grid_count: usize,
}

fn read_header(cursor: &mut Cursor) -> Result<FileHeader> {
    const DESCRIPTOR_BYTES_MIN: usize = 36;
    const GRID_COUNT_MAX: usize = 1 << 16; // real files have a dozen
    if cursor.take(MAGIC.len(), "the magic number")? != MAGIC {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected the OpenVDB magic number"));
    }
    let version = cursor.u32("the file version")?;
    if !VERSIONS_READ.contains(&version) {
        let (from, to) = (VERSIONS_READ.start(), VERSIONS_READ.end());
        let what = format!("the file version is {version}; only {from} to {to} are supported");
        return Err(Error::unsupported(FORMAT, what));
    }
    cursor.take(8, "the library version")?;
    let has_offsets = cursor.u8("the flag for offsets")? != 0;
    cursor.take(UUID_BYTES, "the UUID")?;
    read_metadata(cursor)?;
    let grid_count = cursor.u32("the number of grids")? as usize;
    if grid_count > cursor.remaining() / DESCRIPTOR_BYTES_MIN {
        return Err(cursor.truncated(format!(
            "the file declares {grid_count} grids of at least {DESCRIPTOR_BYTES_MIN} bytes each, \
             but only {} bytes follow",
            cursor.remaining()
        )));
    }
    if grid_count > GRID_COUNT_MAX {
        return Err(Error::too_large(
            FORMAT,
            format!("the file has {grid_count} grids, more than the limit of {GRID_COUNT_MAX}"),
        ));
    }
    Ok(FileHeader { has_offsets, grid_count })
}

struct Descriptor {
    name: String,
    type_name: String,
    instance_parent: String,
    grid_start: u64,
    end: u64,
}

fn read_descriptor(cursor: &mut Cursor) -> Result<Descriptor> {
    let name = cursor.string("the name of a grid")?;
    let type_name = cursor.string("the type of a grid")?;
    let instance_parent = cursor.string("the instance parent of a grid")?;
    let mut position = || cursor.u64("an offset of a grid");
    let (grid_start, _buffers_start, end) = (position()?, position()?, position()?);
    Ok(Descriptor { name, type_name, instance_parent, grid_start, end })
}

fn read_entry(cursor: &mut Cursor, descriptor: Descriptor) -> Result<GridEntry> {
    let Descriptor { name: descriptor_name, type_name, instance_parent, .. } = descriptor;
    let compression = cursor.u32("the compression of a grid")?;
    let metadata = read_metadata(cursor)?;
    let string = |name: &str| match find(&metadata, name) {
        Some(MetaValue::String(text)) => Some(text.clone()),
        _ => None,
    };
    let coord = |name: &str| match find(&metadata, name) {
        Some(&MetaValue::Vec3i(coord)) => Some(coord),
        _ => None,
    };
    let half = find(&metadata, META_HALF) == Some(&MetaValue::Bool(true));
    let (type_name, has_suffix) = match type_name.strip_suffix(HALF_SUFFIX) {
        Some(name) => (name.to_string(), true),
        None => (type_name, false),
    };
    if half != has_suffix && [TYPE_FLOAT, TYPE_VEC3S].contains(&type_name.as_str()) {
        return Err(cursor.invalid("the type and metadata of a grid disagree on half floats"));
    }
    // Programs append the separator 0x1e and a number to duplicate names.
    let (stem, number) = match descriptor_name.split_once('\x1e') {
        Some((stem, number)) => (stem, Some(number)),
        None => (descriptor_name.as_str(), None),
    };
    let name = string("name").filter(|name| !name.is_empty()).unwrap_or_else(|| stem.to_string());
    let unique_name = number.map_or(name.clone(), |number| format!("{name}[{number}]"));
    let bounds = coord("file_bbox_min").zip(coord("file_bbox_max"));
    let active_voxel_count = match find(&metadata, "file_voxel_count") {
        Some(&MetaValue::Integer(count)) => u64::try_from(count).ok(),
        _ => None,
    };
    let transform = read_transform(cursor)?;
    let info = GridInfo {
        name,
        unique_name,
        type_name,
        half,
        class: string("class").unwrap_or_default(),
        transform,
        active_bounds: bounds.filter(|(min, max)| (0..3).all(|axis| min[axis] <= max[axis])),
        active_voxel_count,
        metadata,
    };
    let storage = ValueStorage { compression, half };
    let (position, end) = (cursor.at(), cursor.at() + cursor.remaining());
    let tree = transform.map(|_| TreeLocation { position, end, storage });
    Ok(GridEntry { info, descriptor_name, instance_parent, tree })
}

fn find<'a>(metadata: &'a [(String, MetaValue)], name: &str) -> Option<&'a MetaValue> {
    metadata.iter().find(|(key, _)| key == name).map(|(_, value)| value)
}

/// `None` if the kind of map is unknown. Its size is then unknown as well, so the grid cannot be read
/// further.
fn read_transform(cursor: &mut Cursor) -> Result<Option<Transform>> {
    let kind = cursor.string("the map of a grid")?;
    let mut numbers =
        |count: usize| -> Result<Vec<f64>> { (0..count).map(|_| cursor.f64("the map of a grid")).collect() };
    let scaled = |scale: &[f64], translation: [f64; 3]| Transform {
        axes: [[scale[0], 0.0, 0.0], [0.0, scale[1], 0.0], [0.0, 0.0, scale[2]]],
        translation,
    };
    Ok(match kind.as_str() {
        "UniformScaleMap" | "ScaleMap" => Some(scaled(&numbers(15)?, [0.0; 3])),
        "UniformScaleTranslateMap" | "ScaleTranslateMap" => {
            let n = numbers(18)?;
            Some(scaled(&n[3..], [n[0], n[1], n[2]]))
        }
        "TranslationMap" => {
            let n = numbers(3)?;
            Some(scaled(&[1.0; 3], [n[0], n[1], n[2]]))
        }
        "AffineMap" | "UnitaryMap" => {
            let n = numbers(16)?;
            let row = |r: usize| [n[4 * r], n[4 * r + 1], n[4 * r + 2]];
            Some(Transform { axes: [row(0), row(1), row(2)], translation: row(3) })
        }
        _ => None,
    })
}

/// Skips the tree of a grid in a stream, which does not record where the grid ends.
fn skip_tree(cursor: &mut Cursor, entry: &GridEntry, limits: &Limits) -> Result<()> {
    let mut budget = TreeBudget::new(cursor.at() + cursor.remaining(), limits);
    match (entry.tree, entry.info.type_name.as_str()) {
        (Some(tree), TYPE_FLOAT) => pass_tree::<f32>(cursor, tree.storage, &mut budget),
        (Some(tree), TYPE_VEC3S) => pass_tree::<[f32; 3]>(cursor, tree.storage, &mut budget),
        (_, type_name) => {
            let name = &entry.info.name;
            let what = format!(
                "the file is a stream without offsets, and grid \"{name}\" of type {type_name} cannot be skipped: remove that grid, or save the file with openvdb::io::File, which stores offsets"
            );
            Err(Error::unsupported(FORMAT, what))
        }
    }
}

/// Starts to read a file, or a part that begins at its start.
pub(super) fn cursor_of(bytes: &[u8]) -> Cursor<'_> {
    Cursor::new(FORMAT, Endian::Little, bytes, 0)
}

impl Cursor<'_> {
    pub(super) fn coord(&mut self, what: &str) -> Result<[i32; 3]> {
        Ok([self.i32(what)?, self.i32(what)?, self.i32(what)?])
    }

    /// Reads a u32 length and that number of bytes; replaces invalid UTF-8, because names are only displayed.
    pub(super) fn string(&mut self, what: &str) -> Result<String> {
        let length = self.u32(what)? as usize;
        Ok(String::from_utf8_lossy(self.take(length, what)?).into_owned())
    }

    /// Reads a bit mask in 64-bit words, least significant bit first.
    pub(super) fn mask(&mut self, word_count: usize, what: &str) -> Result<Vec<u64>> {
        let bytes = self.take(word_count * 8, what)?;
        Ok(bytes.as_chunks::<8>().0.iter().map(|&word| u64::from_le_bytes(word)).collect())
    }
}
