//! Reads a layer that any program wrote.
//!
//! The tables are read at once; values and arrays are read from the file when they are needed. All that is
//! read counts towards the limit of decompressed bytes, because several values can refer to the same bytes.

use std::sync::Arc;

use super::array::{AS_INTEGERS, AS_TABLE, COMPRESSED_MIN, Integer, decode, decompress, encoded_bytes_max};
use super::tables::{
    BOOTSTRAP_BYTES, JUMP_CHILD, JUMP_SIBLING, SET_END, SpecType, ValueRep, ValueType, check_contents_at,
    contents_at, read_contents,
};
use crate::core::bytes::Endian;
use crate::core::data::Values;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::{NumberType, append_bytes, gathered};
use crate::usd::FORMAT;
use crate::usd::layer::{
    ArrayElement, ArrayPlace, Layer, LayerArc, LayerNode, LayerSource, ListEdits, NODE_BYTES, NodeFields,
    TimeSamples, Value, add_node, unexpected, wide,
};
use crate::usd::package::{LayerBytes, LimitedBytes};

/// A binary file, and its tables.
pub(crate) struct CrateFile<'a> {
    pub(crate) source: LimitedBytes<'a>,
    version: [u8; 3],
    tokens: Vec<Arc<str>>,
    strings: Vec<u32>,
    fields: Vec<(u32, ValueRep)>,
    sets: Vec<u32>,
    /// By their indices; `None` for a path that the file does not describe.
    paths: Vec<Option<CratePath>>,
}

/// An element of the table of paths.
#[derive(Clone, Copy)]
struct CratePath {
    parent: usize,
    token: u32,
    is_property: bool,
}

/// Reads the structure of a layer.
///
/// # Errors
///
/// [`Error::Truncated`] if the file is truncated; [`Error::Unsupported`] for other versions;
/// [`Error::Invalid`] if it is damaged; [`Error::TooLarge`] if it exceeds the limits.
pub(crate) fn read_layer<'a>(file: LayerBytes<'a>, limits: &Limits) -> Result<Layer<'a>> {
    let source = LimitedBytes::new(file, limits);
    let size = source.length();
    let head = cursor_at(&source, 0)?.take(size.min(BOOTSTRAP_BYTES as u64), "the bootstrap")?;
    let (at, version) = contents_at(&head)?;
    check_contents_at(at, size)?;
    let contents =
        cursor_at(&source, at)?.take((size - at).min(CONTENTS_BYTES_MAX), "the table of contents")?;
    let sections = read_contents(&contents, at)?;
    let section = |index: usize| cursor_at(&source, sections[index].0);
    let tokens = read_tokens(section(0)?)?;
    let mut cursor = section(1)?;
    let count = cursor.count("strings")?;
    let strings = cursor.u32s(count, "strings")?;
    let fields = read_fields(section(2)?)?;
    let mut cursor = section(3)?;
    let set_count = cursor.count("field sets")?;
    let sets = cursor.integers::<i32>(set_count, "field sets")?.into_iter().map(i32::cast_unsigned).collect();
    let (paths, order) = read_paths(section(4)?)?;
    let specs = read_specs(section(5)?, paths.len())?;
    let file = CrateFile { source, version, tokens, strings, fields, sets, paths };
    let nodes = file.nodes(&order, &specs)?;
    file.source.start_anew();
    Ok(Layer { source: LayerSource::Binary(file), nodes })
}

/// The type of the spec of a variant.
const VARIANT: i32 = 10;

/// More than any table of contents has: a file has six sections.
const CONTENTS_BYTES_MAX: u64 = 64 << 10;

fn read_tokens(mut cursor: CrateCursor) -> Result<Vec<Arc<str>>> {
    let at = cursor.clone();
    let token_count = cursor.count("tokens")?;
    let byte_count = cursor.count("bytes of tokens")?;
    let text = cursor.lz4(byte_count, "tokens")?;
    let text = String::from_utf8(text).map_err(|_| at.invalid("the tokens are not UTF-8"))?;
    let found = text.bytes().filter(|&byte| byte == 0).count();
    cursor.source.claim(found, 2 * size_of::<Arc<str>>())?;
    if found < token_count {
        return Err(at.invalid(format!("expected {token_count} tokens, found {found}")));
    }
    Ok(text.split('\0').take(token_count).map(Arc::from).collect())
}

fn read_fields(mut cursor: CrateCursor) -> Result<Vec<(u32, ValueRep)>> {
    let at = cursor.clone();
    let count = cursor.count("fields")?;
    let names = cursor.integers::<i32>(count, "names of fields")?;
    let values = cursor.lz4(count.saturating_mul(8), "values of fields")?;
    let values = values.as_chunks().0;
    if values.len() != count {
        return Err(at.invalid(format!("expected the values of {count} fields, found {}", values.len())));
    }
    cursor.source.claim(count, size_of::<(u32, ValueRep)>())?;
    let values = values.iter().map(|value| ValueRep(u64::from_le_bytes(*value)));
    Ok(names.into_iter().map(i32::cast_unsigned).zip(values).collect())
}

/// The paths by their indices, and the indices in an order in which parents precede their children.
fn read_paths(mut cursor: CrateCursor) -> Result<(Vec<Option<CratePath>>, Vec<usize>)> {
    let at = cursor.clone();
    let path_count = cursor.count("paths")?;
    let count = cursor.count("paths")?;
    let indices = cursor.integers::<i32>(count, "paths")?;
    let names = cursor.integers::<i32>(count, "names of paths")?;
    let jumps = cursor.integers::<i32>(count, "jumps of paths")?;
    cursor.source.claim(path_count, size_of::<Option<CratePath>>() + size_of::<usize>())?;
    let mut paths: Vec<Option<CratePath>> = vec![None; path_count];
    let mut order = Vec::new();
    let mut siblings: Vec<(usize, usize)> = Vec::new();
    let mut next = (count > 0).then_some((0, None));
    while let Some((entry, parent)) = next {
        let found = indices.get(entry).and_then(|&index| usize::try_from(index).ok());
        let place = found.and_then(|index| Some((index, paths.get_mut(index)?)));
        let (Some((index, place @ None)), true) = (place, order.len() < path_count) else {
            return Err(at.invalid("the paths do not form a tree"));
        };
        let (name, jump) = (names[entry], jumps[entry]);
        // The layer itself has no name.
        let parent_index = parent.unwrap_or(index);
        *place = Some(CratePath { parent: parent_index, token: name.unsigned_abs(), is_property: name < 0 });
        order.push(index);
        let has_child = jump > 0 || jump == JUMP_CHILD;
        let sibling = usize::try_from(jump).ok().map(|jump| entry + jump.max(1));
        next = match (has_child, sibling) {
            (true, sibling) => {
                siblings.extend(sibling.map(|sibling| (sibling, parent_index)));
                Some((entry + 1, Some(index)))
            }
            (false, Some(_)) if jump == JUMP_SIBLING => Some((entry + 1, Some(parent_index))),
            _ => siblings.pop().map(|(entry, parent)| (entry, Some(parent))),
        };
    }
    Ok((paths, order))
}

/// For each path, the type of its spec and the index of its first field in the sets.
fn read_specs(mut cursor: CrateCursor, path_count: usize) -> Result<Vec<Option<(i32, usize)>>> {
    let at = cursor.clone();
    let count = cursor.count("specs")?;
    let paths = cursor.integers::<i32>(count, "paths of specs")?;
    let firsts = cursor.integers::<i32>(count, "fields of specs")?;
    let kinds = cursor.integers::<i32>(count, "types of specs")?;
    cursor.source.claim(path_count, size_of::<Option<(i32, usize)>>())?;
    let mut specs = vec![None; path_count];
    for ((path, first), kind) in paths.into_iter().zip(firsts).zip(kinds) {
        let place = usize::try_from(path).ok().and_then(|path| specs.get_mut(path));
        let (Some(place), Ok(first)) = (place, usize::try_from(first)) else {
            return Err(at.invalid("the path or the fields of a spec do not exist"));
        };
        *place = Some((kind, first));
    }
    Ok(specs)
}

impl<'a> CrateFile<'a> {
    /// The prims, variants and properties.
    fn nodes(&self, order: &[usize], specs: &[Option<(i32, usize)>]) -> Result<Vec<LayerNode>> {
        let mut nodes = vec![LayerNode::default()];
        let mut node_of: Vec<Option<usize>> = vec![None; self.paths.len()];
        for &index in order {
            let (Some((kind, first)), Some(path)) = (specs[index], self.paths[index]) else { continue };
            let is = |wanted: SpecType| kind == wanted as i32;
            if is(SpecType::PseudoRoot) && path.parent == index {
                nodes[0].fields = NodeFields::Set(first);
                node_of[index] = Some(0);
                continue;
            }
            let is_attribute = is(SpecType::Attribute);
            let is_known = is_attribute || is(SpecType::Prim) || kind == VARIANT;
            let (true, Some(parent)) = (is_known, node_of[path.parent]) else { continue };
            self.source.claim(1, NODE_BYTES)?;
            let name = Arc::clone(self.token(path.token)?);
            let fields = NodeFields::Set(first);
            let node = LayerNode { name, is_attribute, fields, ..LayerNode::default() };
            node_of[index] = Some(add_node(&mut nodes, parent, node));
        }
        match &nodes[0].fields {
            NodeFields::Set(_) => Ok(nodes),
            NodeFields::Map(_) => Err(Error::invalid(FORMAT, Position::File, "the layer has no root")),
        }
    }

    fn at(&self, offset: u64) -> Result<CrateCursor<'_, 'a>> {
        cursor_at(&self.source, offset)
    }

    fn token(&self, index: u32) -> Result<&Arc<str>> {
        let missing = || Error::invalid(FORMAT, Position::File, format!("there is no token {index}"));
        self.tokens.get(index as usize).ok_or_else(missing)
    }

    fn string(&self, index: u32) -> Result<&Arc<str>> {
        let missing = || Error::invalid(FORMAT, Position::File, format!("there is no string {index}"));
        self.token(*self.strings.get(index as usize).ok_or_else(missing)?)
    }

    /// A copy of a token, which counts towards the limit.
    fn owned(&self, word: &str) -> Result<String> {
        self.source.claim(word.len() + size_of::<String>(), 1)?;
        Ok(word.to_owned())
    }

    /// The path with this index as text.
    fn path(&self, index: u32) -> Result<String> {
        let (mut index, mut names) = (index as usize, Vec::new());
        loop {
            let missing = || Error::invalid(FORMAT, Position::File, format!("there is no path {index}"));
            // The file does not describe the empty path.
            let Some(path) = self.paths.get(index).ok_or_else(missing)?.filter(|path| path.parent != index)
            else {
                break;
            };
            let name = self.token(path.token)?;
            let start = if path.is_property {
                "."
            } else if name.starts_with('{') {
                ""
            } else {
                "/"
            };
            names.push(format!("{start}{name}"));
            self.source.claim(name.len() + size_of::<String>(), 2)?;
            index = path.parent;
        }
        names.reverse();
        Ok(names.concat())
    }

    /// The value of the field with this name in a set.
    pub(crate) fn field(&self, first: usize, name: &str) -> Result<Option<Value>> {
        let set = self.sets.get(first..).unwrap_or_default();
        for &index in set.iter().take_while(|&&index| index != SET_END) {
            let missing = || Error::invalid(FORMAT, Position::File, format!("there is no field {index}"));
            let (token, rep) = *self.fields.get(index as usize).ok_or_else(missing)?;
            if **self.token(token)? == *name {
                return self.value(rep.0, name).map(Some);
            }
        }
        Ok(None)
    }

    /// Decodes the representation of a value.
    pub(crate) fn value(&self, rep: u64, what: &str) -> Result<Value> {
        let rep = ValueRep(rep);
        let code = rep.type_code();
        if rep.is_edit() {
            return Ok(Value::Unread("an edit of an array"));
        }
        if rep.is_array() {
            let array = ArrayElement::of_code(code).map(|_| Value::Array(ArrayPlace::Binary(rep.0)));
            return Ok(array.unwrap_or(Value::Unread("an array")));
        }
        if let Some(ArrayElement::Numbers(number, arity)) = ArrayElement::of_code(code) {
            return self.numbers(rep, number, arity, what).map(Value::Numbers);
        }
        let inlined = u32::try_from(rep.payload()).unwrap_or(u32::MAX);
        match (rep.is_inlined(), code) {
            (_, 51) => return Ok(Value::Blocked),
            (true, 10) => return Ok(Value::Word(self.owned(self.string(inlined)?)?)),
            (true, 11 | 12) => return Ok(Value::Word(self.owned(self.token(inlined)?)?)),
            (true, 31) => return Ok(Value::Dictionary(Vec::new())),
            (true, _) => return Ok(Value::Unread("an inlined value")),
            (false, _) => {}
        }
        let mut cursor = self.at(rep.payload())?;
        let token = |cursor: &mut CrateCursor| self.owned(self.token(cursor.u32("a token")?)?);
        let string = |cursor: &mut CrateCursor| self.owned(self.string(cursor.u32("a string")?)?);
        let path = |cursor: &mut CrateCursor| self.path(cursor.u32("a path")?);
        let arc = |cursor: &mut CrateCursor| self.arc(cursor, true);
        let payload = |cursor: &mut CrateCursor| self.arc(cursor, false);
        Ok(match code {
            31 => Value::Dictionary(self.dictionary(&mut cursor)?),
            32 => Value::WordEdits(edits(&mut cursor, token)?),
            33 => Value::WordEdits(edits(&mut cursor, string)?),
            34 => Value::WordEdits(edits(&mut cursor, path)?),
            35 => Value::ArcEdits(edits(&mut cursor, arc)?),
            55 => Value::ArcEdits(edits(&mut cursor, payload)?),
            47 => {
                let explicit = Some(vec![payload(&mut cursor)?]);
                Value::ArcEdits(ListEdits { explicit, ..ListEdits::default() })
            }
            40 => Value::Words(items(&mut cursor, path)?),
            41 => Value::Words(items(&mut cursor, token)?),
            50 => Value::Words(items(&mut cursor, string)?),
            45 => Value::Dictionary(items(&mut cursor, |cursor| {
                Ok((string(cursor)?, Value::Word(string(cursor)?)))
            })?),
            49 => {
                Value::Offsets(items(&mut cursor, |cursor| Ok([cursor.f64("time")?, cursor.f64("time")?]))?)
            }
            46 => Value::Samples(Arc::new(self.samples(&mut cursor, what)?)),
            _ => Value::Unread("a value of a type that is not supported"),
        })
    }

    /// A number, vector, matrix or quaternion.
    fn numbers(&self, rep: ValueRep, number: NumberType, arity: usize, what: &str) -> Result<Vec<f64>> {
        let (payload, width) = (rep.payload().to_le_bytes(), number.size());
        let decoded = |number: NumberType, bytes: &[u8]| wide(&number.decode(bytes, Endian::Little));
        if !rep.is_inlined() {
            let bytes = self.at(rep.payload())?.take((arity * width) as u64, what)?;
            return Ok(in_order(rep, decoded(number, &bytes)));
        }
        Ok(match (number, arity) {
            (NumberType::F64, 1) => decoded(NumberType::F32, &payload[..4]),
            (NumberType::I64, 1) => decoded(NumberType::I32, &payload[..4]),
            (NumberType::U64, 1) => decoded(NumberType::U32, &payload[..4]),
            _ if arity * width <= 4 => decoded(number, &payload[..arity * width]),
            // The diagonal of a matrix.
            (NumberType::F64, 4 | 9 | 16) if (13..=15).contains(&rep.type_code()) => {
                let side = usize::from(rep.type_code()) - 11;
                let mut matrix = vec![0.0; arity];
                for (row, value) in decoded(NumberType::I8, &payload[..side]).into_iter().enumerate() {
                    matrix[row * (side + 1)] = value;
                }
                matrix
            }
            _ if arity <= 4 => decoded(NumberType::I8, &payload[..arity]),
            _ => return Err(unexpected(what)),
        })
    }

    /// A dictionary. Those within it are not read.
    fn dictionary(&self, cursor: &mut CrateCursor) -> Result<Vec<(String, Value)>> {
        let what = "an entry of a dictionary";
        items(cursor, |cursor| {
            let key = self.owned(self.string(cursor.u32(what)?)?)?;
            cursor.jump(what)?;
            let rep = cursor.u64(what)?;
            Ok((key, Value::Array(ArrayPlace::Binary(rep))))
        })
    }

    /// A reference, which has a dictionary, or a payload.
    fn arc(&self, cursor: &mut CrateCursor, is_reference: bool) -> Result<LayerArc> {
        let what = "a reference";
        let asset = self.owned(self.string(cursor.u32(what)?)?)?;
        let prim = self.path(cursor.u32(what)?)?;
        let mut retime = [0.0, 1.0];
        if is_reference || self.version >= [0, 8, 0] {
            retime = [cursor.f64(what)?, cursor.f64(what)?];
        }
        if is_reference {
            self.dictionary(cursor)?;
        }
        Ok(LayerArc { asset, prim, retime })
    }

    fn samples(&self, cursor: &mut CrateCursor, what: &str) -> Result<TimeSamples> {
        cursor.jump(what)?;
        let times = ValueRep(cursor.u64(what)?);
        cursor.jump(what)?;
        let at = cursor.clone();
        let count = cursor.count("time samples")?;
        let values = cursor.take_all(count, 8, "time samples")?;
        self.source.claim(count, size_of::<Value>())?;
        let stored = |bytes: &[u8; 8]| Value::Array(ArrayPlace::Binary(u64::from_le_bytes(*bytes)));
        if (times.type_code(), times.is_inlined()) != (ValueType::DoubleVector as u8, false) {
            return Err(at.invalid(format!("the times of {what} are not numbers")));
        }
        let mut cursor = self.at(times.payload())?;
        let found = cursor.count("times")?;
        if found != count {
            return Err(at.invalid(format!("{what} has {count} time samples, but {found} time codes")));
        }
        let codes = wide(&NumberType::F64.decode(&cursor.take_all(count, 8, "times")?, Endian::Little));
        if !codes.is_sorted_by(|a, b| a < b) {
            return Err(at.invalid(format!("the times of {what} do not increase")));
        }
        Ok(TimeSamples { codes, values: values.as_chunks().0.iter().map(stored).collect() })
    }

    /// The number of values per element of an array, and all values.
    pub(crate) fn array(&self, rep: u64, what: &str) -> Result<(usize, Values)> {
        let rep = ValueRep(rep);
        let kind = ArrayElement::of_code(rep.type_code())
            .filter(|_| rep.is_array())
            .ok_or_else(|| unexpected(what))?;
        let mut cursor = self.at(rep.payload())?;
        let count = match rep.payload() {
            0 => 0,
            _ => {
                // Once, arrays could have several dimensions.
                if self.version < [0, 5, 0] {
                    cursor.u32(what)?;
                }
                let is_narrow = self.version < [0, 7, 0];
                if is_narrow { cursor.u32(what)? as usize } else { cursor.count(what)? }
            }
        };
        let is_compressed = rep.is_compressed() && count >= COMPRESSED_MIN;
        match kind {
            ArrayElement::Words => {
                let indices = cursor.u32s(count, what)?;
                let is_token = rep.type_code() == 11;
                let word =
                    |index: u32| self.owned(if is_token { self.token(index)? } else { self.string(index)? });
                let table = indices.into_iter().map(word).collect::<Result<Vec<String>>>()?;
                let indices = (0..i32::try_from(count).map_err(|_| unexpected(what))?).collect();
                Ok((1, Values::Strings { table, indices }))
            }
            ArrayElement::Numbers(number, 1) if is_compressed => {
                Ok((1, compressed(&mut cursor, number, count, what)?))
            }
            ArrayElement::Numbers(number, arity) => {
                let bytes = cursor.take_all(count, arity * number.size(), what)?;
                self.source.claim(bytes.len(), 1)?;
                Ok((arity, in_order_all(rep, arity, number.decode(&bytes, Endian::Little))))
            }
        }
    }
}

/// Numbers that are stored as compressed integers, or as a table and indices into it.
fn compressed(cursor: &mut CrateCursor, number: NumberType, count: usize, what: &str) -> Result<Values> {
    let source = cursor.source;
    source.claim(count, 8)?;
    match number {
        NumberType::I32 => return Ok(Values::I32(cursor.integers(count, what)?)),
        NumberType::U32 => {
            let values = cursor.integers::<i32>(count, what)?.into_iter();
            return Ok(Values::I64(values.map(|value| value.cast_unsigned().into()).collect()));
        }
        NumberType::I64 | NumberType::U64 => {
            let values = cursor.integers::<i64>(count, what)?;
            let mut bytes = Vec::new();
            append_bytes(&values, i64::to_le_bytes, &mut bytes);
            return Ok(number.decode(&bytes, Endian::Little));
        }
        NumberType::F16 | NumberType::F32 | NumberType::F64 => {}
        _ => return Err(cursor.invalid(format!("{what} cannot be compressed"))),
    }
    let at = cursor.clone();
    let (table, indices) = match cursor.u8(what)? {
        AS_INTEGERS => {
            let values = cursor.integers::<i32>(count, what)?.into_iter();
            return Ok(match number {
                NumberType::F64 => Values::F64(values.map(f64::from).collect()),
                _ => Values::F32(values.map(|value| value as f32).collect()),
            });
        }
        AS_TABLE => {
            let length = cursor.u32(what)? as usize;
            let bytes = cursor.take_all(length, number.size(), what)?;
            (number.decode(&bytes, Endian::Little), cursor.integers::<i32>(count, what)?)
        }
        code => return Err(at.invalid(format!("unknown compression {code} of {what}"))),
    };
    let values = gathered(&table, 1, &indices);
    values.ok_or_else(|| at.invalid(format!("an index of {what} is beyond the end of its table")))
}

/// Moves the real part of a quaternion, which is the last number in the file, to the front, as in the text form.
fn in_order<T>(rep: ValueRep, mut numbers: Vec<T>) -> Vec<T> {
    if (16..=18).contains(&rep.type_code()) {
        numbers.chunks_exact_mut(4).for_each(|quaternion| quaternion.rotate_right(1));
    }
    numbers
}

fn in_order_all(rep: ValueRep, arity: usize, values: Values) -> Values {
    match values {
        Values::F32(numbers) if arity == 4 => Values::F32(in_order(rep, numbers)),
        Values::F64(numbers) if arity == 4 => Values::F64(in_order(rep, numbers)),
        other => other,
    }
}

/// Reads a count and as many items.
fn items<'c, 'a, T>(
    cursor: &mut CrateCursor<'c, 'a>,
    mut item: impl FnMut(&mut CrateCursor<'c, 'a>) -> Result<T>,
) -> Result<Vec<T>> {
    let count = cursor.count("items")?;
    let mut found = Vec::new();
    for _ in 0..count {
        cursor.source.claim(1, size_of::<T>())?;
        found.push(item(cursor)?);
    }
    Ok(found)
}

/// Reads the edits of a list: which lists there are, and the lists.
fn edits<'c, 'a, T>(
    cursor: &mut CrateCursor<'c, 'a>,
    item: impl Fn(&mut CrateCursor<'c, 'a>) -> Result<T>,
) -> Result<ListEdits<T>> {
    let lists = cursor.u8("a list")?;
    let mut list = |bit: u8| if lists & bit == 0 { Ok(Vec::new()) } else { items(cursor, &item) };
    let [explicit, added, prepended, mut appended] = [list(2)?, list(4)?, list(32)?, list(64)?];
    let deleted = list(8)?;
    list(16)?; // another order
    appended.extend(added);
    let explicit = (lists & 1 != 0).then_some(explicit);
    Ok(ListEdits { explicit, deleted, prepended, appended })
}

/// A cursor at an offset.
fn cursor_at<'c, 'a>(source: &'c LimitedBytes<'a>, offset: u64) -> Result<CrateCursor<'c, 'a>> {
    if offset > source.length() {
        let what = format!("a value would be at {offset}, beyond the end of the file at {}", source.length());
        return Err(Error::invalid(FORMAT, Position::Offset(offset), what));
    }
    Ok(CrateCursor { source, at: offset })
}

/// Methods of [`CrateCursor`] with the name of a type: each takes the next number.
macro_rules! number_methods {
    ($($number:ident)*) => {$(
        fn $number(&mut self, what: &str) -> Result<$number> {
            Ok($number::from_le_bytes(self.array(what)?))
        }
    )*};
}

/// A read position in a file.
#[derive(Clone)]
struct CrateCursor<'c, 'a> {
    source: &'c LimitedBytes<'a>,
    at: u64,
}

impl CrateCursor<'_, '_> {
    fn invalid(&self, what: impl Into<String>) -> Error {
        Error::invalid(FORMAT, Position::Offset(self.at), what)
    }

    fn take(&mut self, length: u64, what: &str) -> Result<Vec<u8>> {
        let rest = self.source.length() - self.at;
        let length = match usize::try_from(length) {
            Ok(count) if length <= rest => count,
            _ => {
                let what = format!("expected {length} bytes of {what}, found {rest} before the end");
                return Err(Error::truncated(FORMAT, Position::Offset(self.at), what));
            }
        };
        self.source.claim(length, 1)?;
        let mut bytes = vec![0; length];
        self.source.read(&mut bytes, self.at)?;
        self.at += length as u64;
        Ok(bytes)
    }

    /// The bytes of `count` elements.
    fn take_all(&mut self, count: usize, bytes_each: usize, what: &str) -> Result<Vec<u8>> {
        self.take((count as u64).saturating_mul(bytes_each as u64), what)
    }

    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(&self.take(N as u64, what)?);
        Ok(array)
    }

    number_methods! { u8 u32 u64 f64 }

    /// Reads an offset, relative to where it is, and continues there.
    fn jump(&mut self, what: &str) -> Result<()> {
        let start = self.at;
        let offset = i64::from_le_bytes(self.array(what)?);
        let target = start.checked_add_signed(offset).filter(|target| *target <= self.source.length());
        self.at = target.ok_or_else(|| self.invalid(format!("{what} would be outside the file")))?;
        Ok(())
    }

    /// Reads a 64-bit count.
    fn count(&mut self, what: &str) -> Result<usize> {
        let at = self.clone();
        let count = self.u64(what)?;
        usize::try_from(count)
            .map_err(|_| at.invalid(format!("{count} {what} are more than a file can hold")))
    }

    fn u32s(&mut self, count: usize, what: &str) -> Result<Vec<u32>> {
        let bytes = self.take_all(count, 4, what)?;
        self.source.claim(bytes.len(), 1)?;
        Ok(bytes.as_chunks().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect())
    }

    /// Reads a size and as many compressed bytes, and decompresses them to at most `bytes_max` bytes.
    fn lz4(&mut self, bytes_max: usize, what: &str) -> Result<Vec<u8>> {
        let size = self.u64(what)?;
        let at = self.clone();
        let packed = self.take(size, what)?;
        self.source.claim(bytes_max, 1)?;
        let mut out = vec![0; bytes_max];
        let length = decompress(&packed, &mut out)
            .ok_or_else(|| at.invalid(format!("the compressed {what} are damaged")))?;
        out.truncate(length);
        Ok(out)
    }

    /// Reads a size and `count` compressed integers.
    fn integers<T: Integer>(&mut self, count: usize, what: &str) -> Result<Vec<T>> {
        let at = self.clone();
        let bytes_max = encoded_bytes_max::<T>(count)
            .ok_or_else(|| at.invalid(format!("{count} {what} are more than a file can hold")))?;
        self.source.claim(count, T::CODE_BYTES[2])?;
        let encoded = self.lz4(if count == 0 { 0 } else { bytes_max }, what)?;
        decode(&encoded, count).ok_or_else(|| at.invalid(format!("expected {count} compressed {what}")))
    }
}
