//! Reads a layer in the text form.
//!
//! ```text
//!   #usda 1.0
//!   ( metadata )
//!   def Points "water" ( metadata )
//!   {
//!       point3f[] points = [(0, 0, 0), ..]            the elements stay in the file until they are needed
//!       float3[] velocities.timeSamples = { 1: [..], 2: [..] }
//!       variantSet "size" = { "small" { .. } "big" { .. } }
//!   }
//! ```
//!
//! The text is read once from its start to its end, through a window of 64 KiB.

use std::ops::Range;
use std::sync::Arc;

use crate::core::bytes::Endian;
use crate::core::data::Values;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::NumberType;
use crate::core::text::excerpt;
use crate::usd::FORMAT;
use crate::usd::layer::{
    ArrayElement, ArrayPlace, Layer, LayerArc, LayerNode, LayerSource, ListEdits, NODE_BYTES, TimeSamples,
    Value, add_node,
};
use crate::usd::package::{LayerBytes, LimitedBytes};

/// Reads the structure of a layer.
///
/// # Errors
///
/// [`Error::Truncated`] if the text ends too early; [`Error::Invalid`] with the line if it violates the
/// syntax; [`Error::TooLarge`] if it exceeds the limits.
pub(crate) fn read_layer<'a>(file: LayerBytes<'a>, limits: &Limits) -> Result<Layer<'a>> {
    let file = LimitedBytes::new(file, limits);
    let size = file.length();
    let mut parser =
        UsdaParser { text: WindowedText::new(&file, 0..size, 1), nodes: vec![LayerNode::default()] };
    parser.layer()?;
    let nodes = parser.nodes;
    Ok(Layer { source: LayerSource::Text(file), nodes })
}

/// The deepest nesting of prims, and of values. Real layers have a tenth of it.
const DEPTH_MAX: usize = 64;

/// The size of the piece of text in memory.
const WINDOW_BYTES: usize = 64 << 10;

/// The longest name, string or number.
const WORD_BYTES_MAX: usize = 16 << 20;

/// A read position in a text.
struct WindowedText<'t, 'a> {
    source: &'t LimitedBytes<'a>,
    window: Vec<u8>,
    /// The offset of the window in the file.
    start: u64,
    at: usize,
    end: u64,
    line: u64,
}

impl<'t, 'a> WindowedText<'t, 'a> {
    fn new(source: &'t LimitedBytes<'a>, range: Range<u64>, line: u64) -> WindowedText<'t, 'a> {
        WindowedText { source, window: Vec::new(), start: range.start, at: 0, end: range.end, line }
    }

    /// The byte that is `ahead` bytes further; `None` beyond the end. At most three bytes.
    fn peek_at(&mut self, ahead: usize) -> Result<Option<u8>> {
        if self.at + ahead >= self.window.len() {
            self.start += self.at as u64;
            let rest = usize::try_from(self.end - self.start).unwrap_or(usize::MAX);
            self.window.resize(rest.min(WINDOW_BYTES), 0);
            self.source.read(&mut self.window, self.start)?;
            self.at = 0;
        }
        Ok(self.window.get(self.at + ahead).copied())
    }

    fn peek(&mut self) -> Result<Option<u8>> {
        match self.window.get(self.at) {
            Some(byte) => Ok(Some(*byte)),
            None => self.peek_at(0),
        }
    }

    /// Moves beyond the byte that was peeked.
    fn bump(&mut self) {
        self.line += u64::from(self.window.get(self.at) == Some(&b'\n'));
        self.at += 1;
    }

    fn next(&mut self) -> Result<u8> {
        let byte = self.peek()?.ok_or_else(|| self.ended())?;
        self.bump();
        Ok(byte)
    }

    fn offset(&self) -> u64 {
        self.start + self.at as u64
    }

    fn ended(&self) -> Error {
        Error::truncated(FORMAT, Position::Line(self.line), "the text ends too early")
    }

    fn invalid(&self, what: impl Into<String>) -> Error {
        Error::invalid(FORMAT, Position::Line(self.line), what)
    }

    /// Skips white space, comments and semicolons.
    fn skip_space(&mut self) -> Result<()> {
        while let Some(byte) = self.peek()? {
            match byte {
                b' ' | b'\t' | b'\r' | b'\n' | b';' => self.bump(),
                b'#' => self.skip_line()?,
                b'/' if self.peek_at(1)? == Some(b'/') => self.skip_line()?,
                b'/' if self.peek_at(1)? == Some(b'*') => {
                    (0..2).for_each(|_| self.bump());
                    while !(self.peek()? == Some(b'*') && self.peek_at(1)? == Some(b'/')) {
                        self.next()?;
                    }
                    (0..2).for_each(|_| self.bump());
                }
                _ => break,
            }
        }
        Ok(())
    }

    fn skip_line(&mut self) -> Result<()> {
        while self.peek()?.is_some_and(|byte| byte != b'\n') {
            self.bump();
        }
        Ok(())
    }

    /// The next byte that is not white space; `None` at the end.
    fn ahead(&mut self) -> Result<Option<u8>> {
        self.skip_space()?;
        self.peek()
    }

    /// Takes a byte if it is the next one.
    fn takes(&mut self, byte: u8) -> Result<bool> {
        let is_next = self.ahead()? == Some(byte);
        if is_next {
            self.bump();
        }
        Ok(is_next)
    }

    fn expect(&mut self, byte: u8) -> Result<()> {
        if self.takes(byte)? {
            return Ok(());
        }
        Err(self.unexpected(&format!("`{}`", byte.escape_ascii())))
    }

    /// The error for the next byte, or for the end.
    fn unexpected(&mut self, expected: &str) -> Error {
        match self.peek() {
            Ok(Some(found)) => self.invalid(format!("expected {expected}, found `{}`", found.escape_ascii())),
            Ok(None) => self.ended(),
            Err(error) => error,
        }
    }

    /// Takes the bytes for which `is_part` is true.
    fn take_while(&mut self, is_part: impl Fn(u8) -> bool) -> Result<String> {
        self.skip_space()?;
        let mut taken = Vec::new();
        while let Some(byte) = self.peek()?.filter(|&byte| is_part(byte)) {
            self.push(&mut taken, byte)?;
            self.bump();
        }
        self.text(taken)
    }

    fn push(&self, taken: &mut Vec<u8>, byte: u8) -> Result<()> {
        if taken.len() == WORD_BYTES_MAX {
            let what = format!("a string at line {} has more than {WORD_BYTES_MAX} bytes", self.line);
            return Err(Error::too_large(FORMAT, what));
        }
        taken.push(byte);
        Ok(())
    }

    fn text(&self, bytes: Vec<u8>) -> Result<String> {
        self.source.claim(bytes.len() + size_of::<Value>(), 1)?;
        String::from_utf8(bytes).map_err(|_| self.invalid("the text is not UTF-8"))
    }

    /// A word such as `def`, `point3f` or `primvars:id`.
    fn word(&mut self) -> Result<String> {
        let word =
            self.take_while(|byte| byte.is_ascii_alphanumeric() || byte >= 0x80 || b"_:|".contains(&byte))?;
        if word.is_empty() {
            return Err(self.unexpected("a word"));
        }
        Ok(word)
    }

    fn number(&mut self) -> Result<f64> {
        let word = self.take_while(|byte| byte.is_ascii_alphanumeric() || b"+-._".contains(&byte))?;
        if word.is_empty() {
            return Err(self.unexpected("a number"));
        }
        parsed(&word).ok_or_else(|| self.invalid(format!("expected a number, found `{}`", excerpt(&word))))
    }

    /// A string in single, double or triple quotes, the path of a file, or a path in angle brackets.
    fn quoted(&mut self) -> Result<String> {
        let (open, close) = match self.ahead()? {
            Some(open @ (b'"' | b'\'' | b'@')) => (open, open),
            Some(b'<') => (b'<', b'>'),
            _ => return Err(self.unexpected("a string")),
        };
        self.bump();
        let is_triple = open != b'<' && self.peek()? == Some(open) && self.peek_at(1)? == Some(open);
        if is_triple {
            (0..2).for_each(|_| self.bump());
        }
        let mut taken = Vec::new();
        loop {
            let byte = self.next()?;
            if byte == close {
                if !is_triple {
                    break;
                }
                if self.peek()? == Some(close) && self.peek_at(1)? == Some(close) {
                    (0..2).for_each(|_| self.bump());
                    break;
                }
            }
            let is_escape = byte == b'\\' && b"\"'".contains(&open);
            let byte = if is_escape { self.escape()? } else { byte };
            self.push(&mut taken, byte)?;
        }
        self.text(taken)
    }

    /// The byte that an escape sequence stands for, after its backslash.
    fn escape(&mut self) -> Result<u8> {
        let byte = self.next()?;
        Ok(match byte {
            b'n' => b'\n',
            b't' => b'\t',
            b'r' => b'\r',
            b'a' => 7,
            b'b' => 8,
            b'f' => 12,
            b'v' => 11,
            b'x' => {
                let digits = String::from_iter([self.next()?, self.next()?].map(char::from));
                u8::from_str_radix(&digits, 16)
                    .map_err(|_| self.invalid("expected two hexadecimal digits after \\x"))?
            }
            b'0'..=b'7' => {
                let mut code = u32::from(byte - b'0');
                for _ in 0..2 {
                    if let Some(digit @ b'0'..=b'7') = self.peek()? {
                        self.bump();
                        code = 8 * code + u32::from(digit - b'0');
                    }
                }
                code.to_le_bytes()[0]
            }
            _ => byte,
        })
    }

    /// Skips what is between two brackets, of which the first is the next byte; returns the end.
    fn skip_brackets(&mut self) -> Result<u64> {
        let mut depth = 0_u64;
        loop {
            match self.ahead()?.ok_or_else(|| self.ended())? {
                b'[' | b'(' | b'{' => depth += 1,
                b']' | b')' | b'}' => depth = depth.saturating_sub(1),
                b'"' | b'\'' | b'@' | b'<' => {
                    self.quoted()?;
                    continue;
                }
                _ => {}
            }
            self.bump();
            if depth == 0 {
                return Ok(self.offset());
            }
        }
    }
}

/// A number of the text form.
fn parsed(word: &str) -> Option<f64> {
    match word {
        "true" | "True" => Some(1.0),
        "false" | "False" => Some(0.0),
        _ => fast_float2::parse(word).ok(),
    }
}

/// Builds the nodes of a layer.
struct UsdaParser<'t, 'a> {
    text: WindowedText<'t, 'a>,
    nodes: Vec<LayerNode>,
}

impl UsdaParser<'_, '_> {
    fn layer(&mut self) -> Result<()> {
        self.text.skip_line()?; // #usda 1.0
        self.text.next()?; // a layer may have nothing but this line
        self.metadata(0)?;
        while self.text.ahead()?.is_some() {
            let word = self.text.word()?;
            self.statement(0, &word, 0)?;
        }
        Ok(())
    }

    /// Adds a node, or continues the one of this name.
    fn add(&mut self, parent: usize, name: &str) -> Result<usize> {
        self.text.source.claim(1, NODE_BYTES)?;
        let node = LayerNode { name: name.into(), ..LayerNode::default() };
        Ok(add_node(&mut self.nodes, parent, node))
    }

    fn set(&mut self, node: usize, field: &str, value: Value) {
        self.nodes[node].fields.set(field, value);
    }

    /// The fields, and the statements between braces.
    fn body(&mut self, node: usize, depth: usize) -> Result<()> {
        self.metadata(node)?;
        self.text.expect(b'{')?;
        while !self.text.takes(b'}')? {
            let word = self.text.word()?;
            self.statement(node, &word, depth)?;
        }
        Ok(())
    }

    /// A prim, a set of variants, or a property; `word` is its first word.
    fn statement(&mut self, node: usize, word: &str, depth: usize) -> Result<()> {
        if depth > DEPTH_MAX {
            return Err(Error::too_large(FORMAT, format!("the prims are nested more than {DEPTH_MAX} deep")));
        }
        match word {
            "def" | "over" | "class" => self.prim(node, word, depth),
            "variantSet" => self.variants(node, depth),
            _ => self.property(node, word),
        }
    }

    fn prim(&mut self, parent: usize, specifier: &str, depth: usize) -> Result<()> {
        let kind = match self.text.ahead()? {
            Some(b'"' | b'\'') => None,
            _ => Some(self.text.word()?),
        };
        let name = self.text.quoted()?;
        let node = self.add(parent, &name)?;
        let code = ["def", "over", "class"].iter().position(|word| *word == specifier).unwrap_or_default();
        self.set(node, "specifier", Value::Numbers(vec![code as f64]));
        if let Some(kind) = kind {
            self.set(node, "typeName", Value::Word(kind));
        }
        self.body(node, depth + 1)
    }

    fn variants(&mut self, parent: usize, depth: usize) -> Result<()> {
        let set = self.text.quoted()?;
        self.text.expect(b'=')?;
        self.text.expect(b'{')?;
        while !self.text.takes(b'}')? {
            let name = self.text.quoted()?;
            let node = self.add(parent, &format!("{{{set}={name}}}"))?;
            self.body(node, depth + 1)?;
        }
        Ok(())
    }

    /// An attribute or a relationship. The order of names is skipped.
    fn property(&mut self, parent: usize, first: &str) -> Result<()> {
        let mut kind = first.to_owned();
        while ["custom", "uniform", "varying", "config", "prepend", "append", "add", "delete", "reorder"]
            .contains(&kind.as_str())
        {
            kind = self.text.word()?;
        }
        if kind == "nameChildren" || kind == "properties" || kind == "rootPrims" {
            self.text.expect(b'=')?;
            return self.value(0).map(drop);
        }
        let is_array = self.text.takes(b'[')?;
        if is_array {
            self.text.expect(b']')?;
        }
        let name = self.text.word()?;
        let suffix = if self.text.takes(b'.')? { self.text.word()? } else { String::new() };
        let node = self.add(parent, &name)?;
        self.nodes[node].is_attribute = kind != "rel";
        let element = ArrayElement::named(&kind).filter(|_| is_array);
        let shown = if is_array { kind + "[]" } else { kind };
        self.set(node, "typeName", Value::Word(shown));
        if self.text.takes(b'=')? {
            match suffix.as_str() {
                "timeSamples" => {
                    let samples = Value::Samples(Arc::new(self.samples(is_array, element)?));
                    self.set(node, "timeSamples", samples);
                }
                "spline" => {
                    self.text.skip_brackets()?;
                    self.set(node, "spline", Value::Unread("a spline"));
                }
                "connect" => drop(self.value(0)?),
                _ => {
                    let value = self.typed_value(is_array, element)?;
                    self.set(node, "default", value);
                }
            }
        }
        self.metadata(node)
    }

    /// The value of an attribute. An array is only located.
    fn typed_value(&mut self, is_array: bool, element: Option<ArrayElement>) -> Result<Value> {
        if !is_array {
            return self.value(0);
        }
        if self.text.ahead()? != Some(b'[') {
            return match self.value(0)? {
                Value::Blocked => Ok(Value::Blocked),
                _ => Err(self.text.invalid("expected an array; edits of arrays are not supported")),
            };
        }
        let (start, line) = (self.text.offset(), self.text.line);
        let end = self.text.skip_brackets()?;
        Ok(match element {
            Some(element) => Value::Array(ArrayPlace::Text(element, start, end, line)),
            None => Value::Unread("an array of a type that is not supported"),
        })
    }

    fn samples(&mut self, is_array: bool, element: Option<ArrayElement>) -> Result<TimeSamples> {
        let mut samples = Vec::new();
        self.text.expect(b'{')?;
        while !self.text.takes(b'}')? {
            let code = self.text.number()?;
            self.text.expect(b':')?;
            self.text.source.claim(2, size_of::<(f64, Value)>())?;
            samples.push((code, self.typed_value(is_array, element)?));
            self.text.takes(b',')?;
        }
        samples.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        let (codes, values) = samples.into_iter().unzip();
        Ok(TimeSamples { codes, values })
    }

    /// The fields in parentheses, if there are some.
    fn metadata(&mut self, node: usize) -> Result<()> {
        if !self.text.takes(b'(')? {
            return Ok(());
        }
        while !self.text.takes(b')')? {
            if let Some(b'"' | b'\'') = self.text.ahead()? {
                self.text.quoted()?; // documentation
                continue;
            }
            self.text.takes(b',')?;
            let mut name = self.text.word()?;
            let edit =
                ["prepend", "append", "add", "delete", "reorder"].iter().find(|edit| **edit == name).copied();
            if edit.is_some() {
                name = self.text.word()?;
            }
            self.text.expect(b'=')?;
            let field = match name.as_str() {
                "inherits" => "inheritPaths",
                "variantSets" => "variantSetNames",
                "variants" => "variantSelection",
                other => other,
            }
            .to_owned();
            let old = self.nodes[node].fields.take(&field);
            let value = match field.as_str() {
                "references" | "payload" | "subLayers" => {
                    let items = self.arcs()?;
                    let edits =
                        if let Some(Value::ArcEdits(edits)) = old { edits } else { ListEdits::default() };
                    Value::ArcEdits(with_edit(edits, edit, items))
                }
                "inheritPaths" | "specializes" | "variantSetNames" | "apiSchemas" => {
                    let items = match self.value(0)? {
                        Value::Word(word) => vec![word],
                        Value::Words(words) => words,
                        _ => Vec::new(),
                    };
                    let edits =
                        if let Some(Value::WordEdits(edits)) = old { edits } else { ListEdits::default() };
                    Value::WordEdits(with_edit(edits, edit, items))
                }
                _ => self.value(0)?,
            };
            self.set(node, &field, value);
        }
        Ok(())
    }

    /// References, payloads or sublayers.
    fn arcs(&mut self) -> Result<Vec<LayerArc>> {
        let mut arcs = Vec::new();
        let is_list = self.text.takes(b'[')?;
        while !(is_list && self.text.takes(b']')?) {
            match self.text.ahead()? {
                Some(b',') if is_list => self.text.bump(),
                Some(b'@' | b'<') => arcs.push(self.arc()?),
                _ if self.text.word()? == "None" => {}
                _ => return Err(self.text.invalid("expected the path of a file between @")),
            }
            if !is_list {
                break;
            }
        }
        Ok(arcs)
    }

    fn arc(&mut self) -> Result<LayerArc> {
        let mut arc = LayerArc { asset: String::new(), prim: String::new(), retime: [0.0, 1.0] };
        if self.text.ahead()? == Some(b'@') {
            arc.asset = self.text.quoted()?;
        }
        if self.text.ahead()? == Some(b'<') {
            arc.prim = self.text.quoted()?;
        }
        if self.text.takes(b'(')? {
            while !self.text.takes(b')')? {
                self.text.takes(b',')?;
                let name = self.text.word()?;
                self.text.expect(b'=')?;
                match (name.as_str(), self.value(0)?.number()) {
                    ("offset", Some(offset)) => arc.retime[0] = offset,
                    ("scale", Some(scale)) => arc.retime[1] = scale,
                    _ => {}
                }
            }
        }
        Ok(arc)
    }

    /// A value whose type is not declared.
    fn value(&mut self, depth: usize) -> Result<Value> {
        if depth > DEPTH_MAX {
            return Err(Error::too_large(
                FORMAT,
                format!("the values are nested more than {DEPTH_MAX} deep"),
            ));
        }
        match self.text.ahead()? {
            None => Err(self.text.ended()),
            Some(b'"' | b'\'' | b'@' | b'<') => self.text.quoted().map(Value::Word),
            Some(b'{') => self.dictionary(depth),
            Some(b'[' | b'(') => self.list(depth),
            Some(b'0'..=b'9' | b'+' | b'-' | b'.') => Ok(Value::Numbers(vec![self.text.number()?])),
            Some(_) => {
                let word = self.text.word()?;
                Ok(match (word.as_str(), parsed(&word)) {
                    ("None", _) => Value::Blocked,
                    (_, Some(number)) => Value::Numbers(vec![number]),
                    _ => Value::Word(word),
                })
            }
        }
    }

    /// The words or the numbers of a list, of a vector or of a matrix.
    fn list(&mut self, depth: usize) -> Result<Value> {
        let close = if self.text.takes(b'[')? { b']' } else { b')' };
        if close == b')' {
            self.text.expect(b'(')?;
        }
        let (mut words, mut numbers, mut is_other) = (Vec::new(), Vec::new(), false);
        while !self.text.takes(close)? {
            match self.value(depth + 1)? {
                Value::Word(word) => words.push(word),
                Value::Words(more) => words.extend(more),
                Value::Numbers(more) => numbers.extend(more),
                _ => is_other = true,
            }
            self.text.source.claim(1, size_of::<f64>())?;
            self.text.takes(b',')?;
        }
        Ok(match (words.is_empty(), numbers.is_empty(), is_other) {
            (_, true, false) => Value::Words(words),
            (true, false, false) => Value::Numbers(numbers),
            _ => Value::Unread("a list"),
        })
    }

    /// A name, which may be quoted.
    fn key(&mut self) -> Result<String> {
        match self.text.ahead()? {
            Some(b'"' | b'\'' | b'<') => self.text.quoted(),
            _ => self.text.word(),
        }
    }

    fn dictionary(&mut self, depth: usize) -> Result<Value> {
        self.text.expect(b'{')?;
        let mut entries = Vec::new();
        while !self.text.takes(b'}')? {
            // `string name = value`, or `"old": "new"` in lists of relocated paths
            let mut key = self.key()?;
            if self.text.takes(b'[')? {
                self.text.expect(b']')?;
            }
            if !self.text.takes(b':')? && !self.text.takes(b'=')? {
                key = self.key()?;
                self.text.expect(b'=')?;
            }
            let value = self.value(depth + 1)?;
            self.text.source.claim(1, size_of::<(String, Value)>())?;
            entries.push((key, value));
            self.text.takes(b',')?;
        }
        Ok(Value::Dictionary(entries))
    }
}

/// Adds a statement such as `prepend references = ..` to the edits of a list.
fn with_edit<T>(mut edits: ListEdits<T>, edit: Option<&str>, items: Vec<T>) -> ListEdits<T> {
    match edit {
        None => edits.explicit = Some(items),
        Some("prepend") => edits.prepended.extend(items),
        Some("delete") => edits.deleted.extend(items),
        Some("reorder") => {}
        Some(_) => edits.appended.extend(items),
    }
    edits
}

/// Reads the array in these bytes, which start at a line: the number of values per element, and all values.
pub(crate) fn read_array(
    file: &LimitedBytes,
    kind: ArrayElement,
    range: Range<u64>,
    line: u64,
) -> Result<(usize, Values)> {
    let text = &mut WindowedText::new(file, range, line);
    let ArrayElement::Numbers(number, arity) = kind else {
        let mut table = Vec::new();
        elements(text, 1, |text| {
            table.push(text.quoted()?);
            Ok(())
        })?;
        let indices = 0..i32::try_from(table.len()).map_err(|_| text.invalid("too many strings"))?;
        return Ok((1, Values::Strings { indices: indices.collect(), table }));
    };
    // Half floats are read as floats, which they decode to.
    let number = if number == NumberType::F16 { NumberType::F32 } else { number };
    let (mut bytes, mut word) = (Vec::new(), Vec::new());
    elements(text, arity, |text| {
        word.clear();
        while let Some(byte) =
            text.peek()?.filter(|byte| byte.is_ascii_alphanumeric() || b"+-._".contains(byte))
        {
            text.push(&mut word, byte)?;
            text.bump();
        }
        file.claim(4, number.size())?;
        let put = str::from_utf8(&word).ok().and_then(|word| append(number, word, &mut bytes));
        put.ok_or_else(|| text.invalid(format!("expected a number, found `{}`", excerpt(&word))))
    })?;
    Ok((arity, number.decode(&bytes, Endian::Little)))
}

/// Appends the bytes of a number of this type.
fn append(number: NumberType, word: &str, bytes: &mut Vec<u8>) -> Option<()> {
    match number {
        NumberType::F32 => bytes.extend(fast_float2::parse::<f32, _>(word).ok()?.to_le_bytes()),
        NumberType::F64 => bytes.extend(parsed(word)?.to_le_bytes()),
        NumberType::Bool => bytes.push(u8::from(parsed(word)? != 0.0)),
        NumberType::U8 => bytes.push(word.parse().ok()?),
        NumberType::U32 => bytes.extend(word.parse::<u32>().ok()?.to_le_bytes()),
        NumberType::U64 => bytes.extend(word.parse::<u64>().ok()?.to_le_bytes()),
        NumberType::I64 => bytes.extend(word.parse::<i64>().ok()?.to_le_bytes()),
        _ => bytes.extend(word.parse::<i32>().ok()?.to_le_bytes()),
    }
    Some(())
}

/// Reads the elements of an array in brackets. Those of several values are in parentheses, which matrices nest.
fn elements(
    text: &mut WindowedText,
    arity: usize,
    mut value: impl FnMut(&mut WindowedText) -> Result<()>,
) -> Result<()> {
    let (mut depth, mut found) = (0, 0);
    text.expect(b'[')?;
    loop {
        let byte = text.ahead()?.ok_or_else(|| text.ended())?;
        match byte {
            b',' => {}
            b'(' if depth < 2 && arity > 1 => depth += 1,
            b')' if depth > 0 => {
                depth -= 1;
                if depth == 0 && std::mem::take(&mut found) != arity {
                    return Err(text.invalid(format!("expected {arity} numbers in parentheses")));
                }
            }
            b']' if depth == 0 => {}
            _ if depth == 0 && arity > 1 => return Err(text.invalid("expected `(`")),
            _ => {
                value(text)?;
                found += 1;
                continue;
            }
        }
        text.bump();
        if byte == b']' {
            return Ok(());
        }
    }
}
