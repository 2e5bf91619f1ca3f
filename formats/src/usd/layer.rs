//! A layer of USD in memory: what both the text form and the binary form contain.
//!
//! ```text
//!   Layer ── node 0 (the layer itself) ─┬─ prim "World" ─┬─ prim "water" ─┬─ property "points"
//!                                       │                │                └─ property "primvars:id"
//!                                       │                └─ variant "{size=big}" ── ..
//!                                       └─ ..
//!   node ── fields: "specifier", "typeName", "default", "timeSamples", "references", ..
//! ```
//!
//! Arrays stay in the file until [`Layer::array`] reads one.

use std::collections::HashMap;
use std::sync::Arc;

use super::FORMAT;
use super::package::{LayerBytes, LimitedBytes};
use crate::core::data::{FileAttribute, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::NumberType;
pub(crate) use crate::core::number::wide;
use crate::usd::usdc::CrateFile;

/// A layer.
pub(crate) struct Layer<'a> {
    pub(crate) source: LayerSource<'a>,
    /// The first one is the layer itself.
    pub(crate) nodes: Vec<LayerNode>,
}

/// The file of a layer.
pub(crate) enum LayerSource<'a> {
    Binary(CrateFile<'a>),
    Text(LimitedBytes<'a>),
}

/// A prim, a variant, or a property.
#[derive(Default)]
pub(crate) struct LayerNode {
    pub(crate) name: Arc<str>,
    pub(crate) is_attribute: bool,
    pub(crate) fields: NodeFields,
    /// Prims, variants (named `{set=variant}`) and properties, in the order of the file.
    pub(crate) order: Vec<usize>,
    pub(crate) children: HashMap<Arc<str>, usize>,
}

/// The fields of a node.
pub(crate) enum NodeFields {
    /// In a binary file: the index of the first one in its table of field sets.
    Set(usize),
    /// In a text.
    Map(HashMap<String, Value>),
}

impl Default for NodeFields {
    fn default() -> NodeFields {
        NodeFields::Map(HashMap::new())
    }
}

/// What a node takes in memory, about.
pub(crate) const NODE_BYTES: usize = 1 << 10;

/// The value of a field.
#[derive(Clone, Debug)]
pub(crate) enum Value {
    /// There is explicitly no value.
    Blocked,
    /// A number, a vector, a matrix row by row, or a quaternion, real part first.
    Numbers(Vec<f64>),
    /// A string, a token, a path, or the path of a file.
    Word(String),
    Words(Vec<String>),
    Array(ArrayPlace),
    Samples(Arc<TimeSamples>),
    Dictionary(Vec<(String, Value)>),
    WordEdits(ListEdits<String>),
    ArcEdits(ListEdits<LayerArc>),
    /// The offset and scale of the time of each sublayer.
    Offsets(Vec<[f64; 2]>),
    /// A value of a kind that is not read.
    Unread(&'static str),
}

/// Where an array is in its file.
#[derive(Clone, Copy, Debug)]
pub(crate) enum ArrayPlace {
    /// The bits that represent an array in a binary file or, in a dictionary and among samples, any value.
    Binary(u64),
    /// Its elements, the first and the end of its bytes, and its line.
    Text(ArrayElement, u64, u64, u64),
}

/// The elements of an array.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum ArrayElement {
    /// Numbers, or vectors of several.
    Numbers(NumberType, usize),
    Words,
}

/// The types of numbers: their codes in binary files, their names in texts, the numbers, and how many.
const NUMBER_TYPES: [(u8, &str, NumberType, usize); 16] = {
    use NumberType::{Bool, F16, F32, F64, I32, I64, U8, U32, U64};
    [
        (1, "bool", Bool, 1),
        (2, "uchar", U8, 1),
        (3, "int", I32, 1),
        (4, "uint", U32, 1),
        (5, "int64", I64, 1),
        (6, "uint64", U64, 1),
        (7, "half", F16, 1),
        (8, "float", F32, 1),
        (9, "double", F64, 1),
        (13, "matrix2d", F64, 4),
        (14, "matrix3d", F64, 9),
        (15, "matrix4d", F64, 16),
        (16, "quatd", F64, 4),
        (17, "quatf", F32, 4),
        (18, "quath", F16, 4),
        (56, "timecode", F64, 1),
    ]
};

impl ArrayElement {
    /// The elements of values with this code in a binary file; `None` if they are neither numbers nor words.
    pub(crate) fn of_code(code: u8) -> Option<ArrayElement> {
        use NumberType::{F16, F32, F64, I32};
        let (number, arity) = match code {
            10..=12 => return Some(ArrayElement::Words),
            19..=30 => {
                let index = usize::from(code - 19);
                ([F64, F32, F16, I32][index % 4], 2 + index / 4)
            }
            42..=44 => (I32, 1), // specifiers, permissions and variabilities
            _ => NUMBER_TYPES.iter().find(|row| row.0 == code).map(|row| (row.2, row.3))?,
        };
        Some(ArrayElement::Numbers(number, arity))
    }

    /// The elements of an array of this type, such as `point3f`.
    pub(crate) fn named(name: &str) -> Option<ArrayElement> {
        let find = |name: &str| NUMBER_TYPES.iter().find(|(_, known, ..)| *known == name);
        let name = match name {
            "frame4d" => "matrix4d",
            // Types of old versions of USD, such as `Vec3f`, are below.
            "Point" | "Normal" | "Vector" | "Color" => "double3",
            "PointFloat" | "NormalFloat" | "VectorFloat" | "ColorFloat" => "float3",
            name => name,
        };
        if ["string", "token", "asset"].contains(&name) {
            return Some(ArrayElement::Words);
        } else if let Some(&(.., number, arity)) = find(name) {
            return Some(ArrayElement::Numbers(number, arity));
        }
        // `float3` or, with a role, `point3f`
        let (stem, rest) = name.split_at(name.find(|c: char| c.is_ascii_digit())?);
        let arity = ["2", "3", "4"].iter().position(|digit| rest.starts_with(digit))? + 2;
        let has_role = ["point", "normal", "vector", "color", "texCoord", "Vec"].contains(&stem);
        let scalar = match (stem, &rest[1..]) {
            ("int" | "half" | "float" | "double", "") => stem,
            (_, "h") if has_role => "half",
            (_, "f") if has_role => "float",
            (_, "d") if has_role => "double",
            ("Vec", "i") => "int",
            _ => return None,
        };
        find(scalar).map(|(.., number, _)| ArrayElement::Numbers(*number, arity))
    }
}

/// The values of a property over time, in the order of time codes.
#[derive(Debug)]
pub(crate) struct TimeSamples {
    pub(crate) codes: Vec<f64>,
    /// See [`Layer::resolved`].
    pub(crate) values: Vec<Value>,
}

/// A reference or a payload, or a sublayer.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct LayerArc {
    /// The path of the file; empty for the same layer.
    pub(crate) asset: String,
    /// The path of the prim; empty for the default one.
    pub(crate) prim: String,
    /// The offset and scale of its time.
    pub(crate) retime: [f64; 2],
}

/// An edit of the list in weaker layers.
#[derive(Clone, Debug, Default)]
pub(crate) struct ListEdits<T> {
    /// Replaces the list.
    pub(crate) explicit: Option<Vec<T>>,
    pub(crate) deleted: Vec<T>,
    pub(crate) prepended: Vec<T>,
    pub(crate) appended: Vec<T>,
}

impl<T: Clone + PartialEq> ListEdits<T> {
    /// The edited list.
    pub(crate) fn apply(&self, list: Vec<T>) -> Vec<T> {
        if let Some(explicit) = &self.explicit {
            return explicit.clone();
        }
        let is_edited =
            |item: &T| [&self.deleted, &self.prepended, &self.appended].iter().any(|l| l.contains(item));
        let kept = list.into_iter().filter(|item| !is_edited(item));
        self.prepended.iter().cloned().chain(kept).chain(self.appended.iter().cloned()).collect()
    }

    /// The same edit of other items; items without another are left out.
    pub(crate) fn filter_map<U>(
        &self,
        mut convert: impl FnMut(&T) -> Result<Option<U>>,
    ) -> Result<ListEdits<U>> {
        let mut all = |items: &[T]| {
            items.iter().filter_map(|item| convert(item).transpose()).collect::<Result<Vec<U>>>()
        };
        Ok(ListEdits {
            explicit: self.explicit.as_deref().map(&mut all).transpose()?,
            deleted: all(&self.deleted)?,
            prepended: all(&self.prepended)?,
            appended: all(&self.appended)?,
        })
    }
}

impl<'a> Layer<'a> {
    /// Reads the structure of a text or a binary layer.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if it is neither; otherwise those of its form.
    pub(crate) fn read(file: LayerBytes<'a>, limits: &Limits) -> Result<Layer<'a>> {
        match &file.head()? {
            b"#usda" => crate::usd::usda::read_layer(file, limits),
            _ => crate::usd::usdc::read_layer(file, limits),
        }
    }

    /// The child of a node with this name.
    pub(crate) fn child(&self, node: usize, name: &str) -> Option<usize> {
        self.nodes[node].children.get(name).copied()
    }

    /// The value of a field.
    pub(crate) fn field(&self, node: usize, name: &str) -> Result<Option<Value>> {
        match (&self.nodes[node].fields, &self.source) {
            (NodeFields::Set(first), LayerSource::Binary(file)) => file.field(*first, name),
            (NodeFields::Map(fields), _) => Ok(fields.get(name).cloned()),
            (NodeFields::Set(_), LayerSource::Text(_)) => Ok(None),
        }
    }

    /// The string, token or path in a field.
    pub(crate) fn word(&self, node: usize, name: &str) -> Result<Option<String>> {
        Ok(match self.field(node, name)? {
            Some(Value::Word(word)) => Some(word),
            _ => None,
        })
    }

    /// The first number in a field.
    pub(crate) fn number(&self, node: usize, name: &str) -> Result<Option<f64>> {
        Ok(self.field(node, name)?.and_then(|value| value.number()))
    }

    /// The value of an entry, if the value of a field is a dictionary that has it.
    pub(crate) fn entry(&self, dictionary: &Option<Value>, name: &str) -> Result<Option<Value>> {
        match dictionary {
            Some(Value::Dictionary(entries)) => {
                let found = entries.iter().find(|(key, _)| key == name);
                found.map(|(_, value)| self.resolved(value, name)).transpose()
            }
            _ => Ok(None),
        }
    }

    /// The strings in a value.
    pub(crate) fn words(&self, value: &Value) -> Result<Vec<String>> {
        Ok(match value {
            Value::Word(word) => vec![word.clone()],
            Value::Words(words) => words.clone(),
            Value::Array(place) => match self.array(place, "strings")?.values {
                Values::Strings { table, .. } => table,
                _ => Vec::new(),
            },
            _ => Vec::new(),
        })
    }

    /// The names of the prims below a node.
    pub(crate) fn prim_names(&self, node: usize) -> Result<Vec<String>> {
        if let NodeFields::Set(_) = self.nodes[node].fields
            && let Some(Value::Words(names)) = self.field(node, "primChildren")?
        {
            return Ok(names);
        }
        let children = self.nodes[node].order.iter().map(|child| &self.nodes[*child]);
        let prims = children.filter(|child| !child.name.starts_with('{') && child.fields.has("specifier"));
        Ok(prims.map(|child| child.name.to_string()).collect())
    }

    /// Reads an array. The table of strings has an element for each element of the array.
    pub(crate) fn array(&self, place: &ArrayPlace, name: &str) -> Result<FileAttribute> {
        let (arity, values) = match (place, &self.source) {
            (ArrayPlace::Binary(rep), LayerSource::Binary(file)) => file.array(*rep, name)?,
            (ArrayPlace::Text(kind, start, end, line), LayerSource::Text(file)) => {
                crate::usd::usda::read_array(file, *kind, *start..*end, *line)?
            }
            _ => return Err(unexpected(name)),
        };
        Ok(FileAttribute::new(name, arity, values))
    }

    /// A value of a dictionary or of a sample, which a binary file has elsewhere.
    pub(crate) fn resolved(&self, value: &Value, what: &str) -> Result<Value> {
        match (value, &self.source) {
            (Value::Array(ArrayPlace::Binary(rep)), LayerSource::Binary(file)) => file.value(*rep, what),
            _ => Ok(value.clone()),
        }
    }

    /// The value of a sample.
    pub(crate) fn sample(&self, samples: &TimeSamples, index: usize) -> Result<Value> {
        self.resolved(samples.values.get(index).ok_or_else(|| unexpected("a sample"))?, "a sample")
    }

    /// The sublayers, strongest first.
    pub(crate) fn sublayers(&self) -> Result<Vec<LayerArc>> {
        let offsets = match self.field(0, "subLayerOffsets")? {
            Some(Value::Offsets(offsets)) => offsets,
            _ => Vec::new(),
        };
        Ok(match self.field(0, "subLayers")? {
            Some(Value::ArcEdits(edits)) => edits.apply(Vec::new()),
            Some(Value::Words(assets)) => {
                let arc = |(index, asset): (usize, String)| LayerArc {
                    asset,
                    prim: String::new(),
                    retime: offsets.get(index).copied().unwrap_or([0.0, 1.0]),
                };
                assets.into_iter().enumerate().map(arc).collect()
            }
            _ => Vec::new(),
        })
    }

    /// Sets the count of decompressed bytes to 0.
    pub(crate) fn start_anew(&self) {
        match &self.source {
            LayerSource::Binary(file) => file.source.start_anew(),
            LayerSource::Text(file) => file.start_anew(),
        }
    }
}

/// Adds a node, or returns the one that has this name.
pub(crate) fn add_node(nodes: &mut Vec<LayerNode>, parent: usize, node: LayerNode) -> usize {
    let index = nodes.len();
    let found = *nodes[parent].children.entry(Arc::clone(&node.name)).or_insert(index);
    if found == index {
        nodes[parent].order.push(index);
        nodes.push(node);
    }
    found
}

impl NodeFields {
    /// Whether a text has a field.
    pub(crate) fn has(&self, name: &str) -> bool {
        matches!(self, NodeFields::Map(fields) if fields.contains_key(name))
    }

    /// Removes a field of a text.
    pub(crate) fn take(&mut self, name: &str) -> Option<Value> {
        let NodeFields::Map(fields) = self else { return None };
        fields.remove(name)
    }

    /// Sets a field of a text.
    pub(crate) fn set(&mut self, name: &str, value: Value) {
        if let NodeFields::Map(fields) = self {
            fields.insert(name.to_owned(), value);
        }
    }
}

impl Value {
    /// The first number.
    pub(crate) fn number(&self) -> Option<f64> {
        match self {
            Value::Numbers(numbers) => numbers.first().copied(),
            _ => None,
        }
    }
}

/// The error for a value that is missing or has another type.
pub(crate) fn unexpected(what: &str) -> Error {
    Error::invalid(FORMAT, Position::File, format!("the value of {what} is missing, or has another type"))
}
