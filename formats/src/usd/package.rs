//! A `.usdz`: a ZIP archive whose files are stored as they are, so that each can be read in place. The first
//! one is the layer of the stage.

use std::cell::Cell;
use std::io;
use std::rc::Rc;

use super::FORMAT;
use crate::core::batches::ReadAt;
use crate::core::bytes::{Cursor, Endian};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::text::excerpt;
use crate::core::zip::{ArchiveMember, STORED, directory, entries};

/// The bytes of a layer: a file, or a part of one.
#[derive(Clone)]
pub(crate) struct LayerBytes<'a> {
    file: Rc<dyn ReadAt + 'a>,
    start: u64,
    pub(crate) length: u64,
}

impl<'a> LayerBytes<'a> {
    /// All bytes of a file.
    pub(crate) fn new(file: Rc<dyn ReadAt + 'a>) -> Result<LayerBytes<'a>> {
        let length = file.size_bytes()?;
        Ok(LayerBytes { file, start: 0, length })
    }

    /// Fills `out` with the bytes from `offset` on.
    pub(crate) fn read(&self, out: &mut [u8], offset: u64) -> Result<()> {
        let end = offset.checked_add(out.len() as u64).filter(|end| *end <= self.length);
        end.ok_or(io::Error::from(io::ErrorKind::UnexpectedEof))?;
        Ok(self.file.read_exact_at(out, self.start + offset)?)
    }

    /// The first bytes, at most `N`; zeros beyond the end.
    pub(crate) fn head<const N: usize>(&self) -> Result<[u8; N]> {
        let mut head = [0; N];
        let length = usize::try_from(self.length).unwrap_or(N).min(N);
        self.read(&mut head[..length], 0)?;
        Ok(head)
    }

    /// Compares the checksum of a file of a package with the one that the package states.
    ///
    /// # Errors
    /// [`Error::Invalid`], with the name of the file, if they differ.
    pub(crate) fn check(&self, stated: u32, name: &str) -> Result<()> {
        let mut checksum = flate2::Crc::new();
        let mut at = 0;
        while at < self.length {
            let piece = self.piece(at, PIECE_BYTES.min(self.length - at))?;
            checksum.update(&piece);
            at += piece.len() as u64;
        }
        if checksum.sum() == stated {
            return Ok(());
        }
        let found = checksum.sum();
        let what = format!(
            "the file `{}` of the package has the checksum {found:08x}, not {stated:08x}: it is damaged, so copy or write \
             the package again",
            excerpt(name)
        );
        Err(Error::invalid(FORMAT, Position::Offset(self.start), what))
    }

    fn piece(&self, at: u64, length: u64) -> Result<Vec<u8>> {
        let too_large = |_| Error::too_large(FORMAT, "the package is too large");
        let mut bytes = vec![0; usize::try_from(length).map_err(too_large)?];
        self.read(&mut bytes, at)?;
        Ok(bytes)
    }
}

/// The bytes of a layer, and the number of bytes that were read since [`LimitedBytes::start_anew`].
pub(crate) struct LimitedBytes<'a> {
    bytes: LayerBytes<'a>,
    limits: Limits,
    unpacked: Cell<u64>,
}

impl<'a> LimitedBytes<'a> {
    pub(crate) fn new(bytes: LayerBytes<'a>, limits: &Limits) -> LimitedBytes<'a> {
        LimitedBytes { bytes, limits: *limits, unpacked: Cell::new(0) }
    }

    pub(crate) fn length(&self) -> u64 {
        self.bytes.length
    }

    /// Fills `out` with the bytes from `offset` on.
    pub(crate) fn read(&self, out: &mut [u8], offset: u64) -> Result<()> {
        self.bytes.read(out, offset)
    }

    /// Sets the count of bytes to 0.
    pub(crate) fn start_anew(&self) {
        self.unpacked.set(0);
    }

    /// Counts bytes that are about to be allocated; fails if the sum exceeds the limit.
    pub(crate) fn claim(&self, count: usize, bytes_each: usize) -> Result<()> {
        let bytes = (count as u64).saturating_mul(bytes_each as u64);
        self.unpacked.set(self.unpacked.get().saturating_add(bytes));
        self.limits.check_decompressed(FORMAT, self.unpacked.get(), self.bytes.length)
    }
}

/// An open package: its files with their names and checksums, the first one first.
pub(crate) struct Package<'a> {
    pub(crate) files: Vec<(String, LayerBytes<'a>, u32)>,
}

/// The bytes of a file that are in memory at a time while its checksum is computed.
const PIECE_BYTES: u64 = 1 << 20;

/// More than the end of an archive has: its comment, and the records before it.
const TAIL_BYTES: u64 = 70 << 10;

/// The largest central directory.
const DIRECTORY_BYTES_MAX: u64 = 16 << 20;

const LOCAL_BYTES: u64 = 30;

impl<'a> Package<'a> {
    /// Reads the list of files.
    ///
    /// # Errors
    /// [`Error::Truncated`] without a central directory; [`Error::Invalid`] if it is damaged;
    /// [`Error::Unsupported`] if a file is compressed.
    pub(crate) fn read(file: &LayerBytes<'a>) -> Result<Package<'a>> {
        let size = file.length;
        let tail_start = size.saturating_sub(TAIL_BYTES);
        let tail = file.piece(tail_start, size - tail_start)?;
        let (count, start) = directory(&tail, tail_start).map_err(|error| error.with_format(FORMAT))?;
        let length = size.saturating_sub(start);
        if length > DIRECTORY_BYTES_MAX {
            let what = format!("the list of files is longer than the limit of {DIRECTORY_BYTES_MAX} bytes");
            return Err(Error::too_large(FORMAT, what));
        }
        let bytes = file.piece(start.min(size), length)?;
        let mut files = Vec::new();
        for member in entries(&bytes, count).map_err(|error| error.with_format(FORMAT))? {
            let ArchiveMember { name, method, checksum, bytes: length, local_offset, .. } = member;
            if method != STORED {
                let what = format!(
                    "the file `{}` of the package is compressed, which .usdz does not allow",
                    excerpt(&name)
                );
                return Err(Error::unsupported(FORMAT, what));
            }
            let beyond = || {
                let what = format!("the file `{}` is beyond the end of the package", excerpt(&name));
                Error::invalid(FORMAT, Position::Offset(local_offset), what)
            };
            let after_header = local_offset.checked_add(LOCAL_BYTES).filter(|end| *end <= size);
            let after_header = after_header.ok_or_else(beyond)?;
            let head = file.piece(local_offset, LOCAL_BYTES)?;
            let mut cursor = Cursor::new(FORMAT, Endian::Little, &head, 26);
            let lengths = [cursor.u16("a length")?, cursor.u16("a length")?].map(u64::from);
            let start = after_header + lengths[0] + lengths[1];
            if start.checked_add(length).is_none_or(|end| end > size) {
                return Err(beyond());
            }
            files.push((name, LayerBytes { start: file.start + start, length, ..file.clone() }, checksum));
        }
        files.sort_by_key(|(_, bytes, _)| bytes.start);
        Ok(Package { files })
    }
}
