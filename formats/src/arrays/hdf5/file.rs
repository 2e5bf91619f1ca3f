//! Opens HDF5 files with the crate `hdf5-reader`, within the limits of this crate.
//!
//! The crate wants storage that it may keep and share, and a container only lends its file. So the crate runs
//! in a thread of its own while this one has the file, and asks it for pieces. What the crate knows of the
//! structure is kept from frame to frame, because it looks names up one by one:
//!
//! ```text
//!   this thread                                      thread of the crate
//!   reads the file   ←──── offset, length ─────      parses, decompresses
//!                    ───── bytes ─────────────→      result, at the end
//! ```
//!
//! The crate checks what it reads of the structure against the file. How much it may allocate for data is set
//! here, before it does.

use std::cell::{Cell, RefCell};
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Sender, SyncSender, channel, sync_channel};
use std::thread;

use hdf5_reader::error::Error as CrateError;
use hdf5_reader::group::Group;
use hdf5_reader::{
    Attribute, BlockCacheStorage, ByteOrder, Dataset, Datatype, ExternalLinkResolver, FilterRegistry, H5Type,
    Hdf5File, OpenOptions, SliceInfo, SliceInfoElem, Storage, StorageBuffer,
};

use super::FORMAT;
use crate::core::batches::ReadAt;
use crate::core::bytes::{Cursor, Endian};
use crate::core::columns::position_rank;
use crate::core::data::{FileAttribute, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::lzf;
use crate::core::number::NumberType;
use crate::core::text::{escaped, excerpt, excerpts};

/// A file of which the crate keeps what it knows of the structure.
pub(super) struct OpenFile {
    file: Hdf5File,
    /// The files that links lead to which were met when it was opened.
    linked: Vec<String>,
    byte_count: u64,
}

/// Runs `work` with a file that it opens, and returns this file, too.
///
/// # Errors
/// Those of `work` and of the file; [`Error::Truncated`] if the file is shorter than it states, or was not
/// closed by the program that writes it.
pub(super) fn with_file<T: Send>(
    file: &dyn ReadAt,
    limits: &Limits,
    work: impl FnOnce(&HdfFile) -> Result<T> + Send,
) -> Result<(T, OpenFile)> {
    let byte_count = file.size_bytes()?;
    lend(file, || {
        let mut open = OpenFile::open(byte_count, limits)?;
        let result = work(&HdfFile::of(&open, limits))?;
        open.linked = LINKED.take();
        Ok((result, open))
    })
}

/// Runs `work` with a file that was opened before.
///
/// # Errors
/// Those of `work` and of the file.
pub(super) fn with_open_file<T: Send>(
    open: &OpenFile,
    file: &dyn ReadAt,
    limits: &Limits,
    work: impl FnOnce(&HdfFile) -> Result<T> + Send,
) -> Result<T> {
    lend(file, || {
        LINKED.set(open.linked.clone());
        work(&HdfFile::of(open, limits))
    })
}

thread_local! {
    /// Where the thread of the crate asks for pieces of the file that it was lent.
    static LENDER: RefCell<Option<Sender<Option<PieceRequest>>>> = const { RefCell::new(None) };
    /// The files that links lead to which were met in this thread of the crate.
    static LINKED: RefCell<Vec<String>> = const { RefCell::new(Vec::new()) };
}

/// Runs `work` in another thread, which may ask for pieces of the file until it ends.
fn lend<T: Send>(file: &dyn ReadAt, work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    let (requests, received) = channel();
    thread::scope(|scope| {
        let run = move || {
            let _end = EndOfRequests(requests.clone());
            LENDER.set(Some(requests));
            work()
        };
        let worker = thread::Builder::new().name("hdf5".into()).spawn_scoped(scope, run)?;
        while let Ok(Some(PieceRequest { offset, length, reply })) = received.recv() {
            let mut bytes = vec![0; length];
            let piece = file.read_exact_at(&mut bytes, offset).map(|()| bytes);
            let _ = reply.send(piece); // without a receiver, nobody needs it
        }
        worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// A piece of the file to read; it is within the file.
struct PieceRequest {
    offset: u64,
    length: usize,
    reply: SyncSender<io::Result<Vec<u8>>>,
}

/// Ends the requests of a thread, however it ends.
struct EndOfRequests(Sender<Option<PieceRequest>>);

impl Drop for EndOfRequests {
    fn drop(&mut self) {
        let _ = self.0.send(None); // the receiver outlives this thread
    }
}

/// The file of another thread.
struct LentFile {
    byte_count: u64,
}

impl Storage for LentFile {
    fn len(&self) -> u64 {
        self.byte_count
    }

    fn read_range(&self, offset: u64, length: usize) -> hdf5_reader::error::Result<StorageBuffer> {
        if offset.checked_add(length as u64).is_none_or(|end| end > self.byte_count) {
            let available = self.byte_count.saturating_sub(offset);
            return Err(CrateError::UnexpectedEof { offset, needed: length as u64, available });
        }
        let (reply, answer) = sync_channel(1);
        let is_gone = |_| io::Error::from(io::ErrorKind::BrokenPipe);
        let request = PieceRequest { offset, length, reply };
        let is_sent = LENDER.with_borrow(|lender| {
            lender.as_ref().is_some_and(|requests| requests.send(Some(request)).is_ok())
        });
        if !is_sent {
            return Err(io::Error::from(io::ErrorKind::BrokenPipe).into());
        }
        Ok(StorageBuffer::from_vec(answer.recv().map_err(is_gone)??))
    }
}

/// Keeps blocks of the file for the many short reads of its structure; long reads of data pass by.
struct BufferedFile {
    blocks: BlockCacheStorage,
    file: Arc<LentFile>,
}

const BLOCK_BYTES: usize = 16 << 10;
const BLOCK_COUNT: usize = 64;

impl Storage for BufferedFile {
    fn len(&self) -> u64 {
        self.file.len()
    }

    fn read_range(&self, offset: u64, length: usize) -> hdf5_reader::error::Result<StorageBuffer> {
        if length < BLOCK_BYTES {
            self.blocks.read_range(offset, length)
        } else {
            self.file.read_range(offset, length)
        }
    }
}

/// Remembers the files that links lead to; they are not opened.
struct LinkedFiles;

impl ExternalLinkResolver for LinkedFiles {
    fn resolve_external_link(&self, file: &str) -> hdf5_reader::error::Result<Option<Hdf5File>> {
        LINKED.with_borrow_mut(|files| {
            if !files.iter().any(|known| known == file) && files.len() < 16 {
                files.push(file.to_owned());
            }
        });
        Ok(None)
    }
}

/// An open file, while it is lent.
pub(super) struct HdfFile<'a> {
    open: &'a OpenFile,
    pub(super) limits: &'a Limits,
    /// Bytes of data that may still be read.
    spent_bytes: Cell<u64>,
    /// Why a data set with the name of a position was left out, if one was.
    pub(super) lacks_position: Cell<Option<UnreadPosition>>,
    /// If data sets are stacks of all steps: which step is read of how many.
    pub(super) stack: Cell<Option<StackedStep>>,
}

/// Why a data set with the name of a position was left out.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum UnreadPosition {
    /// It has another shape.
    OtherShape,
    /// It has the shape of positions, but cannot be read.
    Unusable,
}

/// A step of data sets whose first axis is the steps.
#[derive(Clone, Copy)]
pub(super) struct StackedStep {
    pub(super) index: u64,
    pub(super) count: u64,
}

/// Columns of numbers: a data set, a column for each field of its records; or values that are all the same.
pub(super) struct HdfTable {
    source: TableSource,
    pub(super) fields: Vec<HdfField>,
    /// The number of rows.
    pub(super) row_count: u64,
    /// Bytes of a row.
    stride: usize,
}

enum TableSource {
    Stored(Box<Dataset>),
    /// The part at this index of the first axis.
    Stacked(Box<Dataset>, u64),
    Constant(f64),
}

/// One or more numbers in each row of a table.
pub(super) struct HdfField {
    pub(super) name: String,
    pub(super) arity: usize,
    offset: usize,
    number: NumberType,
    endian: Endian,
}

impl HdfField {
    /// Whether its numbers are floats.
    pub(super) fn is_real(&self) -> bool {
        matches!(self.number, NumberType::F16 | NumberType::F32 | NumberType::F64)
    }
}

/// The number under which the filter LZF of h5py is registered. `hdf5-reader` lacks it.
const LZF: u16 = 32000;

impl OpenFile {
    fn open(byte_count: u64, limits: &Limits) -> Result<OpenFile> {
        let budget = limits.decompressed_bytes_of(byte_count);
        let bytes = |count: u64| usize::try_from(count).unwrap_or(usize::MAX);
        let chunk_bytes = bytes(budget / 4);
        let mut filters = FilterRegistry::new();
        filters.register(
            LZF,
            Box::new(move |filter, packed, _| {
                let size = filter.client_data.get(2).copied().unwrap_or_default() as usize;
                if size > chunk_bytes {
                    let what = format!("a chunk of {size} bytes, more than {chunk_bytes}");
                    return Err(CrateError::ResourceLimit(what));
                }
                let damaged = || CrateError::DecompressionError("LZF: the chunk is damaged".into());
                lzf::unpacked(packed, size).ok_or_else(damaged)
            }),
        );
        let options = OpenOptions {
            chunk_cache_bytes: 0,
            filter_registry: Some(filters),
            external_link_resolver: Some(Arc::new(LinkedFiles)),
            max_chunk_bytes: chunk_bytes,
            max_read_bytes: bytes(budget),
            max_object_header_bytes: bytes(limits.header_bytes),
            ..OpenOptions::default()
        };
        let file = Arc::new(LentFile { byte_count });
        let blocks = BlockCacheStorage::new(file.clone(), BLOCK_BYTES, BLOCK_COUNT);
        let storage = Arc::new(BufferedFile { blocks, file });
        let file = Hdf5File::from_storage_with_options(storage, options).map_err(|error| match error {
            // The superblock is at the start of the file.
            CrateError::UnexpectedEof { .. } => {
                Error::truncated(FORMAT, Position::Offset(byte_count), "the file ends within its first block")
            }
            error => error_of(error),
        })?;
        check_complete(&file, byte_count)?;
        Ok(OpenFile { file, linked: Vec::new(), byte_count })
    }
}

impl<'a> HdfFile<'a> {
    fn of(open: &'a OpenFile, limits: &'a Limits) -> HdfFile<'a> {
        HdfFile {
            open,
            limits,
            spent_bytes: Cell::new(0),
            lacks_position: Cell::new(None),
            stack: Cell::new(None),
        }
    }

    /// The root group.
    pub(super) fn root(&self) -> Result<Group> {
        self.open.file.root_group().map_err(error_of)
    }

    /// A group of a group, given by its path.
    pub(super) fn group(&self, group: &Group, path: &str) -> Result<Group> {
        let mut names = path.split('/').filter(|name| !name.is_empty());
        names.try_fold(group.clone(), |group, name| group.group(name).map_err(error_of))
    }

    /// The groups in a group.
    pub(super) fn groups(&self, group: &Group) -> Result<Vec<Group>> {
        let (names, _) = self.members(group)?;
        // Opens them at once, but also the data sets, of which some may be beyond the crate.
        let all = group.groups();
        all.or_else(|_| names.iter().map(|name| group.group(name)).collect()).map_err(error_of)
    }

    /// The names of the groups and of the data sets in a group, sorted: some files have them in any order.
    pub(super) fn members(&self, group: &Group) -> Result<(Vec<String>, Vec<String>)> {
        let (mut groups, mut data_sets) = group.member_names().map_err(error_of)?;
        groups.sort_unstable();
        data_sets.sort_unstable();
        self.limits.check_attributes(FORMAT, data_sets.len(), "data sets in a group")?;
        Ok((groups, data_sets))
    }

    /// A note on each file that links lead to.
    pub(super) fn notes(&self) -> Vec<String> {
        let note = |file: &String| format!("links to the file `{}` were not followed", excerpt(file));
        LINKED.with_borrow(|files| files.iter().map(note).collect())
    }

    /// A data set of numbers, described by its header. Of any other data set, only a note.
    pub(super) fn table(
        &self,
        group: &Group,
        name: &str,
        notes: &mut Vec<String>,
    ) -> Result<Option<HdfTable>> {
        let reason = match group.dataset(name).map_err(error_of) {
            Ok(data) if is_axis(&data) => "it is the axis of a grid".to_owned(),
            Ok(data) => {
                let rank = data.shape().len();
                match table_of(name, data, self.stack.get()) {
                    Ok((table, skipped)) => {
                        if !skipped.is_empty() {
                            notes.push(format!(
                                "skipped fields of `{}` that are not numeric: {}",
                                excerpt(name),
                                excerpts(skipped)
                            ));
                        }
                        return Ok(Some(table));
                    }
                    Err(reason) => {
                        self.note_position(name, rank);
                        reason
                    }
                }
            }
            Err(Error::Unsupported { what, .. }) => {
                self.note_position(name, 2);
                what
            }
            Err(error) => return Err(error),
        };
        notes.push(format!("skipped `{}`: {reason}", excerpt(name)));
        Ok(None)
    }

    /// Notes that a data set with this number of axes was left out, if it has the name of a position.
    fn note_position(&self, name: &str, rank: usize) {
        if position_rank(name).is_some() {
            match rank {
                0 => {}
                1 | 2 => self.lacks_position.set(Some(UnreadPosition::Unusable)),
                _ => self.lacks_position.set(self.lacks_position.get().or(Some(UnreadPosition::OtherShape))),
            }
        }
    }

    /// Reads some fields of a table, which must be in it.
    pub(super) fn read(&self, table: HdfTable) -> Result<Vec<FileAttribute>> {
        let HdfTable { source, fields, row_count, stride } = table;
        self.limits.check_particles(FORMAT, row_count)?;
        // Values may become 64-bit floats later.
        let widths = fields.iter().map(|field| 8 * field.arity as u64);
        let row_bytes = widths.fold(stride as u64, u64::saturating_add);
        self.spend(row_count.saturating_mul(row_bytes))?;
        let bytes = match source {
            TableSource::Stored(data) => data.read_raw_bytes().map_err(error_of)?,
            TableSource::Stacked(data, step) => {
                let values = |HdfField { name, arity, number, .. }| {
                    Ok(FileAttribute::new(name, arity, values_of_step(&data, step, number)?))
                };
                return fields.into_iter().map(values).collect();
            }
            TableSource::Constant(value) => {
                value.to_le_bytes().repeat(usize::try_from(row_count).unwrap_or_default())
            }
        };
        let array = |HdfField { name, arity, offset, number, endian }| {
            let values = number.decode_strided(&bytes, endian, stride, offset, arity);
            FileAttribute::new(name, arity, values)
        };
        Ok(fields.into_iter().map(array).collect())
    }

    /// The bytes of data that were read.
    pub(super) fn spent_bytes(&self) -> u64 {
        self.spent_bytes.get()
    }

    fn spend(&self, bytes: u64) -> Result<()> {
        let spent = self.spent_bytes().saturating_add(bytes);
        self.limits.check_decompressed(FORMAT, spent, self.open.byte_count)?;
        self.spent_bytes.set(spent);
        Ok(())
    }
}

/// Whether the steps of a stack can have these numbers.
fn is_read_in_parts(number: NumberType) -> bool {
    use NumberType::{F32, F64, I32, I64, U8, U32};
    matches!(number, F32 | F64 | U8 | I32 | I64 | U32)
}

/// The numbers of one step of a stack.
fn values_of_step(data: &Dataset, step: u64, number: NumberType) -> Result<Values> {
    fn part<T: H5Type>(data: &Dataset, step: u64) -> Result<Vec<T>> {
        let whole = |&end: &u64| SliceInfoElem::Slice { start: 0, end, step: 1 };
        let further = data.shape().iter().skip(1).map(whole);
        let selections = std::iter::once(SliceInfoElem::Index(step)).chain(further).collect();
        Ok(data.read_slice::<T>(&SliceInfo { selections }).map_err(error_of)?.into_iter().collect())
    }
    Ok(match number {
        NumberType::F32 => Values::F32(part(data, step)?),
        NumberType::F64 => Values::F64(part(data, step)?),
        NumberType::U8 => Values::U8(part(data, step)?),
        NumberType::I32 => Values::I32(part(data, step)?),
        NumberType::U32 => Values::I64(part::<u32>(data, step)?.into_iter().map(i64::from).collect()),
        _ => Values::I64(part(data, step)?),
    })
}

/// A file ends where its first block states, unless it is still being written.
fn check_complete(file: &Hdf5File, byte_count: u64) -> Result<()> {
    let superblock = file.superblock();
    let what = if superblock.eof_address > byte_count {
        format!("expected {} bytes, found {byte_count}", superblock.eof_address)
    } else if superblock.version >= 3 && superblock.consistency_flags & 1 != 0 {
        "the program that writes the file has not closed it".to_owned()
    } else {
        return Ok(());
    };
    Err(Error::truncated(FORMAT, Position::Offset(byte_count), what))
}

impl HdfTable {
    /// A column in which all numbers are the same.
    pub(super) fn constant(name: String, value: f64, row_count: u64) -> HdfTable {
        let field = HdfField { name, arity: 1, offset: 0, number: NumberType::F64, endian: Endian::Little };
        HdfTable { source: TableSource::Constant(value), fields: vec![field], row_count, stride: 8 }
    }

    /// The attributes of a data set.
    pub(super) fn attributes(&self) -> Vec<Attribute> {
        match &self.source {
            TableSource::Stored(data) | TableSource::Stacked(data, _) => data.attributes(),
            TableSource::Constant(_) => Vec::new(),
        }
    }
}

/// The layout of a data set, and the names of fields that are not numeric; or why it cannot be a table.
fn table_of(
    name: &str,
    data: Dataset,
    stack: Option<StackedStep>,
) -> std::result::Result<(HdfTable, Vec<String>), String> {
    if has_wider_index(&data) {
        return Err(
            "its maximal shape is larger than its shape, and may number its chunks: save it with maxshape=None"
                .into()
        );
    }
    let shape = data.shape().to_vec();
    let description = data.raw_datatype().map_err(|error| error.to_string())?;
    let are_plain = plain_numbers(&mut Cursor::new(FORMAT, Endian::Little, &description, 0))
        .map_err(|error| error.to_string())?;
    let mut skipped = Vec::new();
    let stacked = stack.filter(|stack| shape.len() > 1 && shape[0] == stack.count);
    let of_frame = if stacked.is_some() { &shape[1..] } else { &shape[..] };
    let (fields, stride, row_count) = match (data.dtype(), of_frame) {
        (Datatype::Compound { .. }, _) if stacked.is_some() => {
            return Err("it has records for several steps: save a data set for each field".into());
        }
        (Datatype::Compound { size, fields }, &[row_count]) => {
            let stride = usize::try_from(*size).unwrap_or_default();
            let mut columns = Vec::new();
            for (field, is_plain) in fields.iter().zip(are_plain) {
                match numbers_of(&field.datatype).filter(|_| is_plain) {
                    Some((number, endian, arity)) => columns.push(HdfField {
                        name: field.name.clone(),
                        arity,
                        offset: usize::try_from(field.byte_offset).unwrap_or(usize::MAX),
                        number,
                        endian,
                    }),
                    None => skipped.push(field.name.clone()),
                }
            }
            (columns, stride, row_count)
        }
        (datatype, shape) => {
            let (number, endian, inner) = numbers_of(datatype).ok_or("it is not numeric")?;
            if stacked.is_some() && !is_read_in_parts(number) {
                return Err("the numbers of its steps have an unusual type: save it as float32".into());
            }
            if are_plain != [true] {
                return Err(
                    "its numbers have an unusual layout of bits: save it as 32- or 64-bit floats".into()
                );
            }
            let (row_count, columns) = match *shape {
                [row_count] => (row_count, 1),
                [row_count, columns] => (row_count, columns),
                [] => return Err("it is a single value".into()),
                _ => return Err(format!("it has the shape {shape:?}")),
            };
            let arity = usize::try_from(columns).ok().and_then(|columns| columns.checked_mul(inner));
            let stride = arity.and_then(|arity| arity.checked_mul(number.size()));
            let (Some(arity), Some(stride)) = (arity, stride) else {
                return Err("its rows are too long".into());
            };
            (vec![HdfField { name: name.to_owned(), arity, offset: 0, number, endian }], stride, row_count)
        }
    };
    let end = |field: &HdfField| field.arity.checked_mul(field.number.size())?.checked_add(field.offset);
    if stride == 0 || fields.iter().any(|field| end(field).is_none_or(|end| end > stride)) {
        return Err("it has no values, or fields beyond its rows".into());
    }
    let data = Box::new(data);
    let source = match stacked {
        Some(stack) => TableSource::Stacked(data, stack.index),
        None => TableSource::Stored(data),
    };
    Ok((HdfTable { source, fields, row_count, stride }, skipped))
}

/// The type, byte order and count of the numbers of an element; `None` for other elements.
fn numbers_of(datatype: &Datatype) -> Option<(NumberType, Endian, usize)> {
    let endian = |order: &ByteOrder| match order {
        ByteOrder::LittleEndian => Endian::Little,
        ByteOrder::BigEndian => Endian::Big,
    };
    match datatype {
        Datatype::FixedPoint { size, signed, byte_order } => {
            let kind = if *signed { 'i' } else { 'u' };
            Some((NumberType::of_kind(kind, (*size).into())?, endian(byte_order), 1))
        }
        Datatype::FloatingPoint { size, byte_order } => {
            Some((NumberType::of_kind('f', (*size).into())?, endian(byte_order), 1))
        }
        // Truth values are an enumeration.
        Datatype::Enum { base, .. } => match numbers_of(base)? {
            (NumberType::I8, endian, 1) => Some((NumberType::U8, endian, 1)),
            other => Some(other),
        },
        Datatype::Array { base, dims } if !matches!(**base, Datatype::Array { .. }) => {
            let (number, endian, _) = numbers_of(base)?;
            let count = dims.iter().try_fold(1u64, |count, &length| count.checked_mul(length))?;
            Some((number, endian, usize::try_from(count).ok()?))
        }
        _ => None,
    }
}

/// Whether a data set has the coordinates of a dimension of others, as netCDF marks it.
fn is_axis(data: &Dataset) -> bool {
    let is_mark = |attribute: &Attribute| {
        attribute.name == "CLASS" && attribute.read_string().is_ok_and(|class| class == "DIMENSION_SCALE")
    };
    data.attributes().iter().any(is_mark)
}

/// Whether the index of the chunks can number them by a maximal shape, where `hdf5-reader` takes the shape: one without
/// unlimited dimensions that has more chunks in a dimension other than the first. A fixed array does, and a B-tree does
/// not; `hdf5-reader` does not tell which of them the index is.
fn has_wider_index(data: &Dataset) -> bool {
    let (Some(chunks), Some(largest)) = (data.chunks(), data.max_dims()) else { return false };
    let count = |length: u64, chunk: u32| length.div_ceil(u64::from(chunk).max(1));
    let mut later = data.shape().iter().zip(largest).zip(chunks).skip(1);
    !largest.contains(&u64::MAX)
        && later.any(|((length, largest), chunk)| count(*length, chunk) != count(*largest, chunk))
}

/// Whether all bits of a number are those of an integer, or of a float of IEEE 754, as they are decoded; for records, of
/// the numbers in each field. The description of the type is the one that `hdf5-reader` has parsed, without a look at
/// the bits.
fn plain_numbers(cursor: &mut Cursor) -> Result<Vec<bool>> {
    const WHAT: &str = "the description of a type";
    let (word, size) = (cursor.u32(WHAT)?, cursor.u32(WHAT)?);
    let (class, version, flags) = (word & 15, word >> 4 & 15, word >> 8);
    let is_old = version < 3;
    let skip_name = |cursor: &mut Cursor| {
        let start = cursor.at();
        while cursor.u8(WHAT)? != 0 {}
        let length = cursor.at() - start;
        let padding = if is_old { length.next_multiple_of(8) - length } else { 0 };
        cursor.take(padding, WHAT).map(drop)
    };
    Ok(vec![match class {
        // bit offset, precision; the flags are the byte order, padding and the sign
        0 => flags < 16 && cursor.u32(WHAT)? == size.wrapping_mul(8) << 16,
        // bit offset, precision; places and sizes of exponent and mantissa; bias
        1 => is_ieee(flags, size, [cursor.u32(WHAT)?, cursor.u32(WHAT)?, cursor.u32(WHAT)?]),
        2 | 4 | 5 => {
            let length = if class == 5 { (flags & 0xff).next_multiple_of(8) } else { class };
            cursor.take(length as usize, WHAT)?;
            false
        }
        6 => {
            let mut are_plain = Vec::new();
            for _ in 0..flags & 0xffff {
                skip_name(cursor)?;
                let offset_bytes = if is_old { 4 } else { 4 - size.max(1).leading_zeros() as usize / 8 };
                cursor.take(offset_bytes, WHAT)?;
                // Fields of the first version can be arrays.
                let is_array = version == 1 && cursor.take(28, WHAT)?[0] != 0;
                are_plain.push(plain_numbers(cursor)? == [true] && !is_array);
            }
            return Ok(are_plain);
        }
        8 => {
            let is_plain = plain_numbers(cursor)? == [true];
            for _ in 0..flags & 0xffff {
                skip_name(cursor)?;
            }
            cursor.take(((flags & 0xffff) as usize).saturating_mul(size as usize), WHAT)?;
            is_plain
        }
        9 => {
            plain_numbers(cursor)?;
            false
        }
        10 => {
            let rank = usize::from(cursor.u8(WHAT)?);
            // the lengths; before the third version, also reserved bytes, and an order of the dimensions
            cursor.take(if is_old { 3 + 8 * rank } else { 4 * rank }, WHAT)?;
            plain_numbers(cursor)? == [true]
        }
        _ => false, // texts and references, without more
    }])
}

/// Whether the description of a float is that of IEEE 754.
fn is_ieee(flags: u32, size: u32, layout: [u32; 3]) -> bool {
    let (exponent, mantissa) = match size {
        2 => (5, 10),
        4 => (8, 23),
        _ => (11, 52),
    };
    let bits = 1 + u32::from(exponent) + u32::from(mantissa);
    let places = u32::from_le_bytes([mantissa, exponent, 0, mantissa]);
    // The leading bit of the mantissa is implied, and the sign is the last bit. The other flags are the byte order of
    // integers and padding.
    let expected_flags = (bits - 1) << 8 | 0x20;
    bits == size.wrapping_mul(8)
        && layout == [bits << 16, places, (1 << (exponent - 1)) - 1]
        && flags & !0xf == expected_flags
}

/// The first of these attributes that is a number.
pub(super) fn number_in(attributes: &[Attribute], names: &[&str]) -> Option<f64> {
    let named = |name: &&str| attributes.iter().find(|attribute| attribute.name == *name);
    let numbers = names.iter().filter_map(named).filter_map(|attribute| attribute.read_as_f64().ok());
    numbers.into_iter().find(|number| number.is_finite())
}

/// The attributes of a group; none if one of them is in an encoding that is not supported.
pub(super) fn attributes_of(group: &Group) -> Result<Vec<Attribute>> {
    match group.attributes().map_err(error_of) {
        Err(Error::Unsupported { .. }) => Ok(Vec::new()),
        attributes => attributes,
    }
}

/// An error of the crate in the words of this one.
fn error_of(error: CrateError) -> Error {
    let text = escaped(error.to_string()).to_string();
    let mut inner = error;
    while let CrateError::Context { source, .. } = inner {
        inner = *source;
    }
    match inner {
        CrateError::Io(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
            Error::truncated(FORMAT, Position::File, "the file has become shorter")
        }
        CrateError::Io(error) => error.into(),
        CrateError::ResourceLimit(_) => Error::too_large(FORMAT, text),
        CrateError::UnsupportedLayoutClass(3) => {
            let what = "it is a virtual data set, whose values are in other files: give those files";
            Error::unsupported(FORMAT, what)
        }
        CrateError::UnsupportedFilter(_) => {
            let what = format!("{text}: compress the file with gzip, as `h5repack -f GZIP=4 IN OUT` does");
            Error::unsupported(FORMAT, what)
        }
        CrateError::GroupNotFound(_) | CrateError::DatasetNotFound(_) | CrateError::AttributeNotFound(_) => {
            Error::invalid(FORMAT, Position::File, text)
        }
        _ if text.contains("unsupported") => Error::unsupported(FORMAT, text),
        _ => Error::invalid(FORMAT, Position::File, text),
    }
}
