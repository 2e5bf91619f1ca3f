//! VTK's legacy format, 3.0 to 5.1: lines of keywords, some of them followed by data in decimals or
//! big-endian bytes.
//!
//! ```text
//!   # vtk DataFile Version 5.1
//!   a title
//!   BINARY                            or ASCII
//!   DATASET POLYDATA                  or UNSTRUCTURED_GRID
//!   POINTS 64 float                   768 bytes, or 192 decimals
//!   VERTICES 64 128                   128 integers of 32 bits, up to version 4.2; POLYGONS and CELLS likewise
//!   VERTICES 65 64                    since 5.0: 65 and 64 integers after separate lines,
//!   OFFSETS vtktypeint64 ..           OFFSETS and CONNECTIVITY
//!   POINT_DATA 64                     the following arrays have a value per point
//!   SCALARS id unsigned_int 1         (LOOKUP_TABLE default)
//!   FIELD FieldData 2                 arrays, each after a line: name, components, values, type
//!   METADATA ..                       up to a blank line: skipped
//!   CELL_DATA 64                      the following arrays are skipped
//! ```
//!
//! In a file of decimals, data can start on the line of its keyword.
//!
//! The format has no end mark: a file is complete if no data is missing.

use super::{
    LEGACY, POLYGON, POLYGONS_NOTE, Points, TRIANGLE_STRIP, add_cells, checked_count, integers, is_face,
    positions_of,
};
use crate::core::bytes::Endian;
use crate::core::data::{FileAttribute, FilePositions, MeshData, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::ParticlePart;
use crate::core::named_arrays::frame_of_pieces;
use crate::core::number::NumberType;
use crate::core::number::decimals;
use crate::core::text::excerpt;

/// The longest line of text.
const LINE_BYTES_MAX: usize = 64 << 10;

/// Reads the points and their arrays, as particles.
///
/// # Errors
///
/// [`Error::Truncated`] if data is missing, [`Error::Invalid`] for an unexpected line, [`Error::Unsupported`]
/// for data sets that are not point sets, [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let (piece, notes) = read_piece(bytes, limits)?;
    Ok(frame_of_pieces(vec![piece], notes))
}

/// Reads the points and their arrays, and notes.
///
/// # Errors
/// Those of [`read`].
pub(crate) fn read_piece(bytes: &[u8], limits: &Limits) -> Result<(ParticlePart, Vec<String>)> {
    let mut file = File { bytes, at: 0, is_binary: false, limits };
    file.head()?;
    let mut found = LegacyData::default();
    while let Some(line) = file.line()? {
        file.section(&line, &mut found)?;
    }
    if found.has_polygons {
        found.notes.push(POLYGONS_NOTE.into());
    }
    let positions = found.positions.ok_or_else(|| file.truncated("the file ends before any POINTS"))?;
    Ok((ParticlePart { positions, arrays: found.arrays }, found.notes))
}

/// Reads the points and the polygons, without normals. Polygons with more than three corners become triangle
/// fans. A file without polygons gives a mesh without triangles.
///
/// # Errors
///
/// Those of [`read`]; [`Error::Invalid`] for polygons with missing points, [`Error::Unsupported`] for
/// volumetric cells.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    let mut file = File { bytes, at: 0, is_binary: false, limits };
    file.head()?;
    let mut found = LegacyData { keeps_cells: true, ..LegacyData::default() };
    while let Some(line) = file.line()? {
        file.section(&line, &mut found)?;
    }
    let positions = found.positions.ok_or_else(|| file.truncated("the file ends before any POINTS"))?;
    let mut mesh = MeshData { positions: positions.into_f64(), ..MeshData::default() };
    let points = Points { first: 0, count: mesh.positions.len() as u64 };
    for CellList { kind, ends, corners } in &found.cells {
        if kind.is_none() && found.cell_types.len() != ends.len() {
            let what = format!("the file has {} CELL_TYPES for {} CELLS", found.cell_types.len(), ends.len());
            return Err(Error::invalid(LEGACY, Position::File, what));
        }
        let type_of = |index: usize| kind.unwrap_or_else(|| found.cell_types[index]);
        add_cells(LEGACY, (ends, corners), type_of, points, &mut mesh.triangles)?;
    }
    Ok(mesh)
}

/// The cells of a section.
struct CellList {
    /// The type of all cells; `None` if CELL_TYPES has a type for each.
    kind: Option<i64>,
    /// The end of each cell in the list of corners.
    ends: Vec<i64>,
    corners: Vec<i64>,
}

/// The content read so far.
#[derive(Default)]
struct LegacyData {
    positions: Option<FilePositions>,
    arrays: Vec<FileAttribute>,
    notes: Vec<String>,
    /// Whether the following arrays have values for points.
    is_of_points: bool,
    has_polygons: bool,
    /// Whether cells may have more than one corner each.
    has_large_cells: bool,
    /// Whether to read cells; otherwise they are skipped.
    keeps_cells: bool,
    cells: Vec<CellList>,
    cell_types: Vec<i64>,
}

/// A file, and the current position in it.
struct File<'a> {
    bytes: &'a [u8],
    at: usize,
    is_binary: bool,
    limits: &'a Limits,
}

/// The words of a line, and its offset.
struct LegacyLine<'a> {
    words: Vec<&'a str>,
    at: usize,
}

impl<'a> LegacyLine<'a> {
    /// The word at `index`; empty if there are fewer.
    fn word(&self, index: usize) -> &'a str {
        self.words.get(index).copied().unwrap_or_default()
    }

    /// The first word as an upper-case keyword.
    fn keyword(&self) -> String {
        self.word(0).to_ascii_uppercase()
    }

    fn count(&self, index: usize, what: &str) -> Result<u64> {
        let word = self.word(index);
        word.parse().map_err(|_| self.invalid(&format!("expected {what}, found `{}`", excerpt(word))))
    }

    fn invalid(&self, what: &str) -> Error {
        Error::invalid(LEGACY, Position::Offset(self.at as u64), what)
    }
}

/// The type of an array.
#[derive(Clone, Copy)]
enum Type {
    Of(NumberType),
    /// Bits, eight values per byte.
    Bits,
}

impl<'a> File<'a> {
    fn head(&mut self) -> Result<()> {
        let missing = |file: &File| file.truncated("the file ends within its first lines");
        let version = self.raw_line()?.ok_or_else(|| missing(self))?;
        let version = version.strip_prefix(b"# vtk DataFile Version ").unwrap_or_default().trim_ascii();
        if !matches!(version.first(), Some(b'1'..=b'5')) {
            let what = format!("the version is \"{}\"; only 1.0 to 5.1 are supported", excerpt(version));
            return Err(Error::unsupported(LEGACY, what));
        }
        self.raw_line()?.ok_or_else(|| missing(self))?;
        let line = self.line()?.ok_or_else(|| missing(self))?;
        self.is_binary = match line.keyword().as_str() {
            "BINARY" => true,
            "ASCII" => false,
            other => {
                return Err(line.invalid(&format!("expected ASCII or BINARY, found `{}`", excerpt(other))));
            }
        };
        Ok(())
    }

    /// Reads the section that starts with this line.
    fn section(&mut self, line: &LegacyLine, found: &mut LegacyData) -> Result<()> {
        let three = |name_at: usize| (line.word(name_at).to_string(), line.word(name_at + 1));
        match line.keyword().as_str() {
            "DATASET" => check_data_set(line),
            "POINTS" => self.points(line, found),
            "VERTICES" | "LINES" | "POLYGONS" | "TRIANGLE_STRIPS" | "CELLS" => self.cell_section(line, found),
            "CELL_TYPES" => {
                let count = line.count(1, "the number of cells")?;
                self.back_to_data(line, 2);
                if !found.keeps_cells && !found.has_large_cells {
                    return self.pass(line, NumberType::I32, count);
                }
                let types = self.cell_integers(line, NumberType::I32, count)?;
                found.has_polygons |= types.iter().any(|&kind| is_face(kind));
                found.cell_types.extend(types);
                Ok(())
            }
            "POINT_DATA" => {
                let count = line.count(1, "the number of points")?;
                found.is_of_points = true;
                match found.positions.as_ref().map(|positions| positions.len() as u64) {
                    Some(expected) if expected == count => Ok(()),
                    Some(expected) => Err(line
                        .invalid(&format!("POINT_DATA is for {count} points, but the file has {expected}"))),
                    None => Err(line.invalid("POINT_DATA comes before POINTS")),
                }
            }
            "CELL_DATA" => {
                found.is_of_points = false;
                self.cells(line)
            }
            "SCALARS" => {
                let (name, kind) = three(1);
                let arity = if line.words.len() > 3 { line.count(3, "the number of components")? } else { 1 };
                self.back_to_data(line, 4);
                self.skip_table_name()?;
                self.array(line, name, kind, arity, found)
            }
            "VECTORS" | "NORMALS" => self.array_of(line, 3, found),
            "TENSORS" => self.array_of(line, 9, found),
            "TENSORS6" => self.array_of(line, 6, found),
            "GLOBAL_IDS" | "PEDIGREE_IDS" | "EDGE_FLAGS" => self.array_of(line, 1, found),
            "TEXTURE_COORDINATES" => {
                let arity = line.count(2, "the number of components")?;
                self.back_to_data(line, 4);
                self.array(line, line.word(1).to_string(), line.word(3), arity, found)
            }
            "COLOR_SCALARS" => {
                let kind = if self.is_binary { "unsigned_char" } else { "float" };
                let arity = line.count(2, "the number of components")?;
                self.back_to_data(line, 3);
                self.array(line, line.word(1).to_string(), kind, arity, found)
            }
            "LOOKUP_TABLE" => {
                let number = if self.is_binary { NumberType::U8 } else { NumberType::F32 };
                let count = line.count(2, "the size of a table")?;
                self.back_to_data(line, 3);
                self.pass(line, number, count.saturating_mul(4))
            }
            "FIELD" => self.field(line, found),
            "METADATA" => self.skip_metadata(),
            other => {
                Err(line
                    .invalid(&format!("expected a keyword such as POINT_DATA, found `{}`", excerpt(other))))
            }
        }
    }

    /// Goes back to the decimals on the line of a keyword, after the words that belong to the keyword.
    fn back_to_data(&mut self, line: &LegacyLine, word_count: usize) {
        let is_number = |word: &&str| word.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c));
        if !self.is_binary && line.words.get(word_count).is_some_and(is_number) {
            let mut words = WordSpans { bytes: &self.bytes[line.at..], at: 0 };
            self.at = line.at + words.nth(word_count - 1).map_or(0, |(_, end)| end);
        }
    }

    fn points(&mut self, line: &LegacyLine, found: &mut LegacyData) -> Result<()> {
        if found.positions.is_some() {
            return Err(line.invalid("the file has POINTS twice"));
        }
        let count = checked_count(LEGACY, line.count(1, "the number of points")?, self.limits)?;
        let number = match type_of(line.word(2)) {
            Some(Type::Of(number)) => number,
            _ => {
                return Err(line
                    .invalid(&format!("the points have the unsupported type `{}`", excerpt(line.word(2)))));
            }
        };
        self.back_to_data(line, 3);
        let values = self.values(line, number, (count as u64).saturating_mul(3))?;
        found.positions = Some(positions_of(LEGACY, values)?);
        Ok(())
    }

    /// Reads the cells of a section if a mesh is read; otherwise skips them.
    fn cell_section(&mut self, line: &LegacyLine, found: &mut LegacyData) -> Result<()> {
        let (count, size) = (line.count(1, "the number of cells")?, line.count(2, "the size of the cells")?);
        self.back_to_data(line, 3);
        // If OFFSETS follow, the count is one more than the number of cells.
        let has_offsets = self.bytes[self.at..].trim_ascii_start().starts_with(b"OFFSETS");
        let cell_count = count.saturating_sub(has_offsets.into());
        let kind = match line.keyword().as_str() {
            "POLYGONS" => Some(POLYGON),
            "TRIANGLE_STRIPS" => Some(TRIANGLE_STRIP),
            "CELLS" => None,
            // Points and lines.
            _ => Some(0),
        };
        found.has_polygons |= matches!(kind, Some(POLYGON | TRIANGLE_STRIP)) && cell_count > 0;
        // Before version 5, each cell also has its number of corners.
        let corner_count = if has_offsets { size } else { size.saturating_sub(count) };
        found.has_large_cells |= kind.is_none() && corner_count > cell_count;
        if !has_offsets {
            let numbers = self.cell_numbers(line, NumberType::I32, size, found)?;
            if found.keeps_cells {
                found.cells.push(counted_cells(kind, &numbers, line)?);
            }
            return Ok(());
        }
        let offsets = self.line()?.ok_or_else(|| self.truncated("the file ends before OFFSETS"))?;
        let mut ends = self.typed_cell_numbers(&offsets, count, found)?;
        let corners = match self.line()? {
            Some(connectivity) if connectivity.keyword() == "CONNECTIVITY" => {
                self.typed_cell_numbers(&connectivity, size, found)?
            }
            Some(other) => return Err(other.invalid("expected CONNECTIVITY")),
            None => return Err(self.truncated("the file ends before CONNECTIVITY")),
        };
        if found.keeps_cells {
            // The first offset is the start of the first cell.
            ends.drain(..ends.len().min(1));
            found.cells.push(CellList { kind, ends, corners });
        }
        Ok(())
    }

    fn typed_cell_numbers(&mut self, line: &LegacyLine, count: u64, found: &LegacyData) -> Result<Vec<i64>> {
        self.back_to_data(line, 2);
        match type_of(line.word(1)) {
            Some(Type::Of(number)) => self.cell_numbers(line, number, count, found),
            _ => {
                Err(line.invalid(&format!("the cells have the unsupported type `{}`", excerpt(line.word(1)))))
            }
        }
    }

    /// Reads the next `count` integers if a mesh is read; otherwise skips them.
    fn cell_numbers(
        &mut self,
        line: &LegacyLine,
        number: NumberType,
        count: u64,
        found: &LegacyData,
    ) -> Result<Vec<i64>> {
        if found.keeps_cells {
            self.cell_integers(line, number, count)
        } else {
            self.pass(line, number, count).map(|()| Vec::new())
        }
    }

    fn cell_integers(&mut self, line: &LegacyLine, number: NumberType, count: u64) -> Result<Vec<i64>> {
        let no_integers = || line.invalid("the cells are not integers");
        integers(self.values(line, number, count)?).ok_or_else(no_integers)
    }

    /// Skips the data of cells, up to POINT_DATA or the end of the file. The points were read before, so this
    /// data is not validated.
    fn cells(&mut self, line: &LegacyLine) -> Result<()> {
        line.count(1, "the number of cells")?;
        let rest = &self.bytes[self.at..];
        // Point data can follow cell data.
        let next = find_line(rest, b"POINT_DATA");
        self.at = next.map_or(self.bytes.len(), |at| self.at + at);
        Ok(())
    }

    /// Reads an array declared by `VECTORS name type` or a similar line.
    fn array_of(&mut self, line: &LegacyLine, arity: u64, found: &mut LegacyData) -> Result<()> {
        self.back_to_data(line, 3);
        self.array(line, line.word(1).to_string(), line.word(2), arity, found)
    }

    /// Reads an array with values for each point.
    fn array(
        &mut self,
        line: &LegacyLine,
        name: String,
        kind: &str,
        arity: u64,
        found: &mut LegacyData,
    ) -> Result<()> {
        let points = found.positions.as_ref().filter(|_| found.is_of_points);
        let count = points.ok_or_else(|| line.invalid("a point array is outside POINT_DATA"))?.len() as u64;
        self.take_array(line, &name, kind, arity, count, Some(found))
    }

    /// Reads arrays that declare their own sizes.
    fn field(&mut self, line: &LegacyLine, found: &mut LegacyData) -> Result<()> {
        let count = line.count(2, "the number of arrays")?;
        for index in 0..count {
            let mut next = self.line()?;
            // METADATA alone on a line starts a section to skip. With more words, the line declares an array
            // of this name.
            while next.as_ref().is_some_and(|next| next.words.len() == 1 && next.keyword() == "METADATA") {
                self.skip_metadata()?;
                next = self.line()?;
            }
            let what = || {
                format!(
                    "the file ends before array {index} of {count} in the field `{}`",
                    excerpt(line.word(1))
                )
            };
            let next = next.ok_or_else(|| self.truncated(what()))?;
            let [arity, tuples] =
                [next.count(1, "the number of components")?, next.count(2, "the number of values")?];
            self.back_to_data(&next, 4);
            let expected = found.positions.as_ref().map(|positions| positions.len() as u64);
            let is_kept = found.is_of_points && expected == Some(tuples);
            if found.is_of_points && !is_kept {
                self.check_array_count(found)?;
                found.notes.push(format!(
                    "skipped the array `{}`: it does not have a value for each point",
                    excerpt(next.word(0))
                ));
            }
            let into = if is_kept { Some(&mut *found) } else { None };
            self.take_array(&next, next.word(0), next.word(3), arity, tuples, into)?;
        }
        Ok(())
    }

    /// Reads an array, and adds it to `found` if it belongs to points.
    fn take_array(
        &mut self,
        line: &LegacyLine,
        name: &str,
        kind: &str,
        arity: u64,
        count: u64,
        found: Option<&mut LegacyData>,
    ) -> Result<()> {
        let size = arity.checked_mul(count).ok_or_else(|| line.invalid("the array has too many values"))?;
        let name = percent_decoded(name);
        match (type_of(kind), found) {
            (Some(Type::Of(number)), Some(found)) if arity != 0 => {
                self.check_array_count(found)?;
                let arity = usize::try_from(arity).unwrap_or(usize::MAX);
                let values = self.values(line, number, size)?;
                found.arrays.push(FileAttribute::new(name, arity, values));
                Ok(())
            }
            (Some(Type::Of(number)), _) => self.pass(line, number, size),
            (Some(Type::Bits), found) => {
                if let Some(found) = found {
                    self.check_array_count(found)?;
                    found.notes.push(format!(
                        "skipped the array `{}`: arrays of bits are not supported",
                        excerpt(name)
                    ));
                }
                let size = if self.is_binary { size.div_ceil(8) } else { size };
                self.pass(line, NumberType::U8, size)
            }
            (None, _) => {
                let what = format!(
                    "the array `{}` has the unknown type `{}`: remove it",
                    excerpt(name),
                    excerpt(kind)
                );
                Err(Error::unsupported(LEGACY, what))
            }
        }
    }

    /// Checks that the limit allows one more array. An array that is skipped with a note counts as well.
    fn check_array_count(&self, found: &LegacyData) -> Result<()> {
        if found.arrays.len() + found.notes.len() >= self.limits.attribute_count {
            let what = format!("the file has more arrays than the limit of {}", self.limits.attribute_count);
            return Err(Error::too_large(LEGACY, what));
        }
        Ok(())
    }

    /// Reads the next `count` numbers.
    fn values(&mut self, line: &LegacyLine, number: NumberType, count: u64) -> Result<Values> {
        if self.is_binary {
            let data = self.data(line, number, count)?;
            return Ok(number.decode(data, Endian::Big));
        }
        let rest = &self.bytes[self.at..];
        let count = self.fitting(line, count, rest.len().div_ceil(2))?;
        let mut end = 0;
        let words =
            WordSpans { bytes: rest, at: 0 }.inspect(|(_, word_end)| end = *word_end).map(|(word, _)| word);
        let values = decimals(words, number, count).map_err(|word| {
            let what = format!("expected a number of {}, found `{}`", line.word(0), excerpt(word));
            Error::invalid(LEGACY, Position::Offset(self.at as u64), what)
        })?;
        let found = values.len();
        self.at += end;
        if found == count {
            Ok(values)
        } else {
            Err(self.truncated(format!("expected {count} numbers of {}, found {found}", line.word(0))))
        }
    }

    /// Skips the next `count` numbers.
    fn pass(&mut self, line: &LegacyLine, number: NumberType, count: u64) -> Result<()> {
        if self.is_binary {
            return self.data(line, number, count).map(drop);
        }
        let rest = &self.bytes[self.at..];
        let count = self.fitting(line, count, rest.len().div_ceil(2))?;
        let mut words = WordSpans { bytes: rest, at: 0 };
        let found = words.by_ref().take(count).count();
        let end = words.at;
        self.at += end;
        if found == count {
            Ok(())
        } else {
            Err(self.truncated(format!("expected {count} numbers of {}, found {found}", line.word(0))))
        }
    }

    /// The bytes of the next `count` numbers.
    fn data(&mut self, line: &LegacyLine, number: NumberType, count: u64) -> Result<&'a [u8]> {
        let rest = &self.bytes[self.at..];
        let count = self.fitting(line, count, rest.len() / number.size())?;
        let data = &rest[..count * number.size()];
        self.at += data.len();
        Ok(data)
    }

    /// The count as a length. Fails if the count exceeds `most`, the maximum number of values in the rest of
    /// the file.
    fn fitting(&self, line: &LegacyLine, count: u64, most: usize) -> Result<usize> {
        usize::try_from(count).ok().filter(|&count| count <= most).ok_or_else(|| {
            self.truncated(format!("expected {count} numbers of {}, but at most {most} remain", line.word(0)))
        })
    }

    /// Skips `LOOKUP_TABLE default`, which can precede the values of `SCALARS`.
    fn skip_table_name(&mut self) -> Result<()> {
        let before = self.at;
        if !self.bytes[self.at..].trim_ascii_start().starts_with(b"LOOKUP_TABLE") {
            return Ok(());
        }
        match self.line()? {
            Some(line) if line.keyword() == "LOOKUP_TABLE" => self.back_to_data(&line, 2),
            _ => self.at = before,
        }
        Ok(())
    }

    fn skip_metadata(&mut self) -> Result<()> {
        while let Some(line) = self.raw_line()? {
            if line.trim_ascii().is_empty() {
                break;
            }
        }
        Ok(())
    }

    /// The next nonblank line.
    fn line(&mut self) -> Result<Option<LegacyLine<'a>>> {
        loop {
            let at = self.at;
            let Some(line) = self.raw_line()? else { return Ok(None) };
            let is_text = |byte: &u8| *byte >= b' ' || byte.is_ascii_whitespace();
            let text = std::str::from_utf8(line).ok().filter(|_| line.iter().all(is_text));
            let text = text.ok_or_else(|| {
                Error::invalid(
                    LEGACY,
                    Position::Offset(at as u64),
                    "expected a line of text, found binary data",
                )
            })?;
            let words: Vec<&str> = text.split_ascii_whitespace().collect();
            if !words.is_empty() {
                return Ok(Some(LegacyLine { words, at }));
            }
        }
    }

    /// The next line. A line without a line end is an error, unless it contains only blanks.
    fn raw_line(&mut self) -> Result<Option<&'a [u8]>> {
        let rest = &self.bytes[self.at..];
        let searched = &rest[..rest.len().min(LINE_BYTES_MAX)];
        match searched.iter().position(|&byte| byte == b'\n') {
            Some(length) => {
                self.at += length + 1;
                Ok(Some(&rest[..length]))
            }
            None if rest.trim_ascii().is_empty() => {
                self.at = self.bytes.len();
                Ok(None)
            }
            None if searched.len() == rest.len() => Err(self.truncated("the file ends within a line")),
            None => Err(Error::invalid(LEGACY, Position::Offset(self.at as u64), "expected a line of text")),
        }
    }

    fn truncated(&self, what: impl Into<String>) -> Error {
        Error::truncated(LEGACY, Position::Offset(self.at as u64), what)
    }
}

/// The words of a text, each with the offset of its end.
struct WordSpans<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Iterator for WordSpans<'a> {
    type Item = (&'a [u8], usize);

    fn next(&mut self) -> Option<(&'a [u8], usize)> {
        let rest = self.bytes.get(self.at..)?;
        let start = self.at + rest.iter().position(|byte| !byte.is_ascii_whitespace())?;
        let word = &self.bytes[start..];
        let length = word.iter().position(u8::is_ascii_whitespace).unwrap_or(word.len());
        self.at = start + length;
        Some((&word[..length], self.at))
    }
}

/// Parses cells in the layout before version 5: each starts with its number of corners.
fn counted_cells(kind: Option<i64>, mut numbers: &[i64], line: &LegacyLine) -> Result<CellList> {
    let mut list = CellList { kind, ends: Vec::new(), corners: Vec::new() };
    while let Some((&count, rest)) = numbers.split_first() {
        let cell = usize::try_from(count).ok().and_then(|count| rest.split_at_checked(count));
        let (cell, after) = cell.ok_or_else(|| {
            line.invalid(&format!("a cell has {count} corners, but only {} numbers remain", rest.len()))
        })?;
        list.corners.extend_from_slice(cell);
        list.ends.push(list.corners.len() as i64);
        numbers = after;
    }
    Ok(list)
}

fn check_data_set(line: &LegacyLine) -> Result<()> {
    match line.word(1).to_ascii_uppercase().as_str() {
        "POLYDATA" | "UNSTRUCTURED_GRID" => Ok(()),
        other => {
            let what = format!(
                "the data set has the type {}, which is not supported: save it as POLYDATA",
                excerpt(other)
            );
            Err(Error::unsupported(LEGACY, what))
        }
    }
}

/// The size of a number of this type, in bytes.
pub(super) fn size_of_type(word: &str) -> Option<u64> {
    match type_of(word)? {
        Type::Of(number) => Some(number.size() as u64),
        Type::Bits => None,
    }
}

fn type_of(word: &str) -> Option<Type> {
    Some(Type::Of(match word.to_ascii_lowercase().as_str() {
        "bit" => return Some(Type::Bits),
        "char" | "signed_char" => NumberType::I8,
        "unsigned_char" => NumberType::U8,
        "short" => NumberType::I16,
        "unsigned_short" => NumberType::U16,
        "int" | "vtktypeint32" | "vtkidtype" => NumberType::I32, // VTK writes vtkIdType with 32 bits
        "unsigned_int" | "vtktypeuint32" => NumberType::U32,
        "long" | "vtktypeint64" | "long_long" => NumberType::I64,
        "unsigned_long" | "vtktypeuint64" | "unsigned_long_long" => NumberType::U64,
        "float" => NumberType::F32,
        "double" => NumberType::F64,
        _ => return None,
    }))
}

/// Decodes percent escapes: names have `%20` for a blank.
fn percent_decoded(name: &str) -> String {
    let mut bytes = Vec::with_capacity(name.len());
    let mut rest = name.as_bytes();
    while let Some((&byte, after)) = rest.split_first() {
        let digits = after.get(..2).and_then(|digits| std::str::from_utf8(digits).ok());
        let code = digits.filter(|_| byte == b'%').and_then(|digits| u8::from_str_radix(digits, 16).ok());
        bytes.push(code.unwrap_or(byte));
        rest = if code.is_some() { &after[2..] } else { after };
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

/// The offset of the first line that starts with the word.
fn find_line(bytes: &[u8], word: &[u8]) -> Option<usize> {
    let is_line_start = |&at: &usize| (at == 0 || bytes[at - 1] == b'\n') && bytes[at..].starts_with(word);
    (0..bytes.len()).find(is_line_start)
}
