//! XDMF (`.xmf`, `.xdmf`): an index in XML, which says which data sets of HDF5 files are the points of a time.
//!
//! ```text
//!   <Xdmf><Domain>
//!    <Grid GridType="Collection" CollectionType="Temporal">
//!     <Grid>                                                     one for each time, or several within a Grid
//!      <Time Value="0.5"/>                                       GridType="Collection" CollectionType="Spatial"
//!      <Geometry GeometryType="XYZ">
//!       <DataItem Dimensions="64 3" NumberType="Float" Precision="8" Format="HDF"> run.h5:/0/points </DataItem>
//!      <Attribute Name="v" Center="Node"> <DataItem ..> </Attribute>
//! ```
//!
//! Items in the XML itself and in binary files are read, too. Of the XML, the frames are found first; the
//! items of a frame are parsed when it is read.
//!
//! Specification: the XDMF model and format, version 3.

use std::collections::HashSet;
use std::ops::Range;

use quick_xml::events::BytesStart;

use crate::arrays::hdf5;
use crate::core::batches;
use crate::core::bytes::Endian;
use crate::core::container::{
    ContainerFile, ContainerFrames, ContainerReader, ReadFrame, Sample, further_path,
};
use crate::core::data::{FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::ParticlePart;
use crate::core::named_arrays::frame_of_pieces;
use crate::core::number::decimals;
use crate::core::number::{NumberType, interleaved, positions};
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::text::excerpt;
use crate::core::xml::{XmlEvent, attribute, check_end, parse};

/// The format's name in errors.
const FORMAT: &str = "XDMF";

/// The row in the table of formats. The first element identifies a file.
pub(crate) static ROW: FormatRow = FormatRow {
    particles: Some(ParticleReader::container(ContainerReader::new(frames))),
    ..FormatRow::new(FORMAT, &["xmf", "xdmf"])
};

/// The frames, in the order of the file; none if the first grid does not consist of points.
///
/// # Errors
/// [`Error::Truncated`] if the last tag is missing, [`Error::Invalid`] for malformed XML, [`Error::TooLarge`]
/// for more frames than `limits` allows.
pub fn frames(container: &ContainerFile, limits: &Limits) -> Result<ContainerFrames> {
    let text = text_of(container)?;
    let frames = frames_in(&text, limits)?;
    let first = frames.first().and_then(|frame| frame.grids.first());
    if let Some(range) = first
        && !grid(&text[range.clone()], 0).is_ok_and(|grid| grid.has_points())
    {
        return Ok(ContainerFrames::new(Vec::new(), XdmfFrames(frames)));
    }
    let samples = frames.iter().zip(0..).map(|(frame, number)| Sample { number, time: frame.time }).collect();
    Ok(ContainerFrames::new(samples, XdmfFrames(frames)))
}

/// The frames of a file.
#[derive(Debug)]
struct XdmfFrames(Vec<XdmfFrame>);

impl ReadFrame for XdmfFrames {
    /// Reads a frame with the files that it names.
    ///
    /// # Errors
    /// Those of [`frames`] and of HDF5; [`Error::Truncated`] if a file is missing; [`Error::Unsupported`] for files
    /// outside of the folder, for items that select or compute values, and for grids that are not points.
    fn read(&self, container: &ContainerFile, index: usize, limits: &Limits) -> Result<ParticleFrame> {
        let frame = self.0.get(index).ok_or_else(|| {
            let is_empty = self.0.is_empty();
            let what =
                if is_empty { "expected a <Grid>".into() } else { format!("there is no frame {index}") };
            Error::invalid(FORMAT, Position::File, what)
        })?;
        let bytes = container.file.size_bytes()?;
        let mut items = ItemReader { container, limits, opened: HashSet::new(), bytes, spent: 0 };
        let (mut notes, mut pieces) = (Vec::new(), Vec::new());
        for range in &frame.grids {
            let text = batches::read(container.file, range.start as u64..range.end as u64)?;
            let text = text_at(text, range.start as u64)?;
            pieces.push(piece(&text, range.start as u64, &mut items, &mut notes)?);
        }
        notes.dedup();
        limits.check_particles(FORMAT, pieces.iter().map(|piece| piece.positions.len() as u64).sum())?;
        Ok(frame_of_pieces(pieces, notes))
    }
}

/// Whether a text is XDMF, judged by its start.
pub(crate) fn looks_like_xdmf(text: &[u8]) -> bool {
    text.starts_with(b"<") && text.windows(5).any(|window| window == b"<Xdmf")
}

fn text_of(container: &ContainerFile) -> Result<String> {
    let bytes = batches::read(container.file, 0..container.file.size_bytes()?)?;
    check_end(FORMAT, &bytes, "</Xdmf>")?;
    text_at(bytes, 0)
}

/// The text of bytes at an offset of the file.
fn text_at(bytes: Vec<u8>, offset: u64) -> Result<String> {
    String::from_utf8(bytes).map_err(|error| {
        let at = offset + error.utf8_error().valid_up_to() as u64;
        Error::invalid(FORMAT, Position::Offset(at), "expected UTF-8 text")
    })
}

fn malformed(at: u64, what: impl Into<String>) -> Error {
    Error::invalid(FORMAT, Position::Offset(at), what)
}

fn unsupported(what: impl Into<String>) -> Error {
    Error::unsupported(FORMAT, what)
}

/// The value of an attribute of a tag, which some versions write with a prefix: `GeometryType` and `Type`.
fn value(tag: &BytesStart, names: &[&str], at: u64) -> Result<Option<String>> {
    for name in names {
        if let Some(value) = attribute(FORMAT, tag, name, at)? {
            return Ok(Some(value));
        }
    }
    Ok(None)
}

// Finds the frames.

/// The grids of a time: ranges of the text.
#[derive(Debug)]
struct XdmfFrame {
    time: Option<f64>,
    /// The number of the child of a temporal collection in which they are.
    step: Option<usize>,
    grids: Vec<Range<usize>>,
}

/// An element that has not ended.
struct OpenGrid {
    start: u64,
    is_temporal: bool,
    is_uniform: bool,
    step: Option<usize>,
    /// The number of grids before it.
    grids_before: usize,
    time: Option<f64>,
}

/// The frames of the file: the children of a temporal collection, or the grids of each time.
fn frames_in(text: &str, limits: &Limits) -> Result<Vec<XdmfFrame>> {
    let mut frames: Vec<XdmfFrame> = Vec::new();
    for found in found_grids(text, limits)? {
        match frames.last_mut() {
            // Grids of one time follow one another.
            Some(last) if last.step == found.step && (found.step.is_some() || last.time == found.time) => {
                last.grids.extend(found.grids);
            }
            _ => frames.push(found),
        }
    }
    Ok(frames)
}

/// Each grid without grids in it, as a frame.
fn found_grids(text: &str, limits: &Limits) -> Result<Vec<XdmfFrame>> {
    let mut found: Vec<XdmfFrame> = Vec::new();
    let mut open: Vec<OpenGrid> = Vec::new();
    let mut step_count = 0;
    parse(FORMAT, text, |event, range| {
        match event {
            XmlEvent::Start("Grid", tag) => {
                if open.len() >= DEPTH_MAX {
                    let what = format!("grids are nested more than {DEPTH_MAX} deep");
                    return Err(malformed(range.start, what));
                }
                let kind = value(tag, &["GridType"], range.start)?.unwrap_or_default().to_ascii_lowercase();
                let collection = value(tag, &["CollectionType"], range.start)?.unwrap_or_default();
                let step = match open.last() {
                    Some(parent) if parent.is_temporal => {
                        step_count += 1;
                        Some(step_count)
                    }
                    parent => parent.and_then(|parent| parent.step),
                };
                open.push(OpenGrid {
                    start: range.start,
                    is_temporal: kind == "collection" && collection.eq_ignore_ascii_case("temporal"),
                    is_uniform: !["collection", "tree", "subset"].contains(&&*kind),
                    step,
                    grids_before: found.len(),
                    time: None,
                });
            }
            XmlEvent::Start("Time", tag) => {
                let time = value(tag, &["Value"], range.start)?.and_then(|time| time.trim().parse().ok());
                if let (Some(grid), Some(_)) = (open.last_mut(), time) {
                    grid.time = time.filter(|time: &f64| time.is_finite());
                }
            }
            XmlEvent::End("Grid") => {
                let grid = open.pop().ok_or_else(|| malformed(range.start, "expected no </Grid>"))?;
                if grid.is_uniform {
                    limits.check_step(FORMAT, found.len())?;
                    let at = |offset: u64| usize::try_from(offset).unwrap_or(usize::MAX);
                    let range = at(grid.start)..at(range.end);
                    found.push(XdmfFrame { time: None, step: grid.step, grids: vec![range] });
                }
                for inner in &mut found[grid.grids_before..] {
                    inner.time = inner.time.or(grid.time);
                }
            }
            XmlEvent::Start("include", _) => {
                let what = "it includes parts of another grid or file (xi:include), which is not supported";
                return Err(unsupported(what));
            }
            _ => {}
        }
        Ok(())
    })?;
    Ok(found)
}

/// How deep grids may be nested: the time of a grid is passed to all grids in it.
const DEPTH_MAX: usize = 16;

// Reads the items of a grid.

/// A grid with its items.
#[derive(Default)]
struct XdmfGrid<'a> {
    topology: String,
    /// The type of the geometry, if there is one.
    geometry: Option<String>,
    points: Vec<DataItem<'a>>,
    attributes: Vec<XdmfAttribute<'a>>,
}

struct XdmfAttribute<'a> {
    name: String,
    is_at_points: bool,
    items: Vec<DataItem<'a>>,
}

/// An array, before its values are read.
struct DataItem<'a> {
    at: u64,
    count: Option<u64>,
    number: Option<NumberType>,
    endian: Endian,
    format: String,
    seek: u64,
    /// Why it cannot be read.
    obstacle: Option<String>,
    text: &'a str,
}

impl XdmfGrid<'_> {
    /// Whether the grid lists its points, each with three coordinates.
    fn has_points(&self) -> bool {
        let is_listed = |kind: &String| ["XYZ", "X_Y_Z", ""].contains(&&*kind.to_ascii_uppercase());
        self.geometry.as_ref().is_some_and(is_listed)
    }
}

/// Parses a grid, which starts at `offset` of the file.
fn grid(text: &str, offset: u64) -> Result<XdmfGrid<'_>> {
    let mut grid = XdmfGrid::default();
    let (mut is_in_geometry, mut is_in_attribute, mut depth) = (false, false, 0u32);
    parse(FORMAT, text, |event, range| {
        let at = offset + range.start;
        let items = if is_in_geometry {
            Some(&mut grid.points)
        } else if is_in_attribute {
            grid.attributes.last_mut().map(|attribute| &mut attribute.items)
        } else {
            None
        };
        match event {
            XmlEvent::Start("Topology", tag) => {
                grid.topology = value(tag, &["TopologyType", "Type"], at)?.unwrap_or_default();
            }
            XmlEvent::Start("Geometry", tag) => {
                grid.geometry = Some(value(tag, &["GeometryType", "Type"], at)?.unwrap_or_default());
                is_in_geometry = true;
            }
            XmlEvent::Start("Attribute", tag) => {
                let center = value(tag, &["Center"], at)?.unwrap_or_default();
                grid.attributes.push(XdmfAttribute {
                    name: value(tag, &["Name"], at)?.unwrap_or_default(),
                    is_at_points: center.is_empty() || center.eq_ignore_ascii_case("node"),
                    items: Vec::new(),
                });
                is_in_attribute = true;
            }
            XmlEvent::Start("DataItem", tag) => {
                depth += 1;
                if let (Some(items), 1) = (items, depth) {
                    items.push(data_item(tag, at)?);
                }
            }
            XmlEvent::Text(text) => {
                if let Some(item) = items.and_then(|items| items.last_mut())
                    && depth == 1
                    && item.text.is_empty()
                {
                    item.text = text.trim();
                }
            }
            XmlEvent::End("DataItem") => depth = depth.saturating_sub(1),
            XmlEvent::End("Geometry") => is_in_geometry = false,
            XmlEvent::End("Attribute") => is_in_attribute = false,
            _ => {}
        }
        Ok(())
    })?;
    Ok(grid)
}

fn data_item<'a>(tag: &BytesStart, at: u64) -> Result<DataItem<'a>> {
    let text = |names: &[&str], default: &str| {
        Ok::<_, Error>(
            value(tag, names, at)?.map_or(default.to_owned(), |text| text.trim().to_ascii_lowercase()),
        )
    };
    let (kind, reference) = (text(&["ItemType"], "uniform")?, value(tag, &["Reference"], at)?);
    let obstacle = if kind != "uniform" {
        Some(format!("an item of the type {}", excerpt(&kind)))
    } else if reference.is_some() {
        Some("a reference to another item".to_owned())
    } else if !["", "raw"].contains(&&*text(&["Compression"], "")?) {
        Some("a compressed item".to_owned())
    } else {
        None
    };
    let dimensions = text(&["Dimensions"], "")?;
    let count = dimensions
        .split_ascii_whitespace()
        .try_fold(1u64, |count, word| count.checked_mul(word.parse().ok()?));
    let (kind, bytes) = match &*text(&["NumberType", "DataType"], "float")? {
        "char" => ('i', "1"),
        "uchar" => ('u', "1"),
        "int" => ('i', "4"),
        "uint" => ('u', "4"),
        "float" => ('f', "4"),
        _ => (' ', ""),
    };
    let bytes = text(&["Precision"], bytes)?;
    Ok(DataItem {
        at,
        count: count.filter(|_| !dimensions.is_empty()),
        number: bytes.parse().ok().and_then(|bytes| NumberType::of_kind(kind, bytes)),
        endian: if text(&["Endian"], "native")? == "big" { Endian::Big } else { Endian::Little },
        format: text(&["Format"], "xml")?,
        seek: text(&["Seek"], "0")?.parse().map_err(|_| malformed(at, "Seek: expected a number"))?,
        obstacle,
        text: "",
    })
}

/// The points of a grid, which starts at `offset` of the file, and their attributes.
fn piece(text: &str, offset: u64, items: &mut ItemReader, notes: &mut Vec<String>) -> Result<ParticlePart> {
    let grid = grid(text, offset)?;
    if !grid.has_points() {
        let kind = excerpt(grid.geometry.as_deref().unwrap_or("none"));
        return Err(unsupported(format!("expected a geometry of the type XYZ, found {kind}: not particles")));
    }
    if !["polyvertex", ""].contains(&&*grid.topology.to_ascii_lowercase()) {
        notes
            .push(format!("cells of the type {} are ignored: only points are read", excerpt(&grid.topology)));
    }
    let mut columns: Vec<Values> =
        grid.points.iter().map(|item| items.values(item)).collect::<Result<_>>()?;
    let at = grid.points.first().map_or(offset, |item| item.at);
    let values = match &columns[..] {
        [_] => columns.pop(),
        [x, y, z] => interleaved(&[x, y, z]),
        _ => None,
    };
    let wrong = || malformed(at, "the points must be one item, or three of the same type and length");
    let values = values.filter(|values| values.len() % 3 == 0).ok_or_else(wrong)?;
    let positions = positions(values).ok_or_else(wrong)?;
    let arrays = grid.attributes.iter().map(|attribute| array(attribute, &positions, items, notes));
    let arrays: Vec<Option<FileAttribute>> = arrays.collect::<Result<_>>()?;
    Ok(ParticlePart { positions, arrays: arrays.into_iter().flatten().collect() })
}

/// The values of an attribute; `None`, with a note, if it has none for the points.
fn array(
    attribute: &XdmfAttribute,
    positions: &FilePositions,
    items: &mut ItemReader,
    notes: &mut Vec<String>,
) -> Result<Option<FileAttribute>> {
    let count = positions.len() as u64;
    let reason = match &attribute.items[..] {
        _ if !attribute.is_at_points => "it has no values at the points".to_owned(),
        [DataItem { obstacle: Some(obstacle), .. }] => format!("it is {obstacle}"),
        [item @ DataItem { count: Some(found), .. }] if count > 0 && found % count == 0 && *found > 0 => {
            let values = items.values(item)?;
            let arity = usize::try_from(found / count).unwrap_or_default();
            return Ok(Some(FileAttribute::new(attribute.name.clone(), arity, values)));
        }
        [DataItem { count: Some(found), .. }] => format!("it has {found} values for {count} points"),
        _ => "it has no dimensions, or several items".to_owned(),
    };
    notes.push(format!("skipped `{}`: {reason}", excerpt(&attribute.name)));
    Ok(None)
}

/// Reads items, within the limits for all files of a frame.
struct ItemReader<'a, 'b> {
    container: &'a ContainerFile<'b>,
    limits: &'a Limits,
    opened: HashSet<String>,
    /// Bytes of the index and of the opened files.
    bytes: u64,
    /// Bytes of the values that were read.
    spent: u64,
}

impl ItemReader<'_, '_> {
    fn values(&mut self, item: &DataItem) -> Result<Values> {
        if let Some(obstacle) = &item.obstacle {
            return Err(unsupported(format!("{obstacle} is not supported: save plain items")));
        }
        let count = item.count.ok_or_else(|| malformed(item.at, "the item has no Dimensions"))?;
        let number = item
            .number
            .ok_or_else(|| malformed(item.at, "the item has an unknown NumberType or Precision"))?;
        match &*item.format {
            "xml" => {
                self.spend(count)?;
                parsed(item, number, count)
            }
            "hdf" => {
                let (path, name) = item
                    .text
                    .split_once(":/")
                    .ok_or_else(|| malformed(item.at, "expected FILE:/DATA_SET"))?;
                let file = self.open(path)?;
                self.spend(count)?;
                let values = hdf5::read_values(&*file, name, count, self.limits);
                values.map_err(|error| error.with_format(FORMAT).in_file(path))
            }
            "binary" => {
                let file = self.open(item.text)?;
                self.spend(count)?;
                let size =
                    count.checked_mul(number.size() as u64).and_then(|size| size.checked_add(item.seek));
                let available = file.size_bytes()?;
                let end = size.filter(|&end| end <= available).ok_or_else(|| {
                    let path = excerpt(item.text);
                    malformed(item.at, format!("the file {path} has fewer than {count} numbers"))
                })?;
                Ok(number.decode(&batches::read(&*file, item.seek..end)?, item.endian))
            }
            other => Err(malformed(item.at, format!("the item has the unknown format {}", excerpt(other)))),
        }
    }

    fn open(&mut self, path: &str) -> Result<Box<dyn batches::ReadAt>> {
        let file = self.container.open_further(FORMAT, &further_path(FORMAT, "", path)?)?;
        if self.opened.insert(path.to_owned()) {
            self.bytes = self.bytes.saturating_add(file.size_bytes()?);
        }
        Ok(file)
    }

    /// Counts values that become 64-bit numbers at most.
    fn spend(&mut self, count: u64) -> Result<()> {
        self.spent = self.spent.saturating_add(count.saturating_mul(8));
        self.limits.check_decompressed(FORMAT, self.spent, self.bytes)
    }
}

/// The numbers in the text of an item.
fn parsed(item: &DataItem, number: NumberType, count: u64) -> Result<Values> {
    let wrong = |what: &str| malformed(item.at, format!("expected {count} numbers, found {what}"));
    let words = item.text.as_bytes().split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    let found = words.clone().count();
    if found as u64 != count {
        return Err(wrong(&found.to_string()));
    }
    decimals(words, number, found).map_err(|word| wrong(&excerpt(word)))
}
