//! The parts that the writers of one frame and of a sequence share: the beginning of a file, and the prims
//! that refer to its arrays.

use crate::data::Provenance;
use crate::error::Result;
use crate::mesh_options::UpAxis;
use crate::provenance::{comments, from_comments};
use crate::usd::{LayerInfo, ROOT, SAMPLE_CODE};

use super::array::{ALIGNMENT, CrateArray};
use super::contents::{BOOTSTRAP_BYTES, bootstrap, check_magic};
use super::tables::{SpecType, Tables, append_count};
use super::value::{ValueRep, ValueType};

/// The offset of the comment with the provenance.
const COMMENT_AT: usize = BOOTSTRAP_BYTES;

/// The start of each of its lines.
const COMMENT: &str = "# ";

/// The bytes before the first array.
pub(super) fn head(provenance: &Provenance, contents_at: u64) -> Vec<u8> {
    let mut bytes = bootstrap(contents_at).to_vec();
    bytes.extend_from_slice(comments(provenance, COMMENT).as_bytes());
    bytes.extend_from_slice(b"end_header\n");
    bytes
}

/// The provenance in the first bytes of a file.
pub(super) fn read_provenance(head: &[u8]) -> Result<Vec<(String, String)>> {
    check_magic(head)?;
    Ok(from_comments(head.get(COMMENT_AT..).unwrap_or_default(), COMMENT))
}

/// The zeros that are inserted before an array.
#[expect(clippy::cast_possible_truncation, reason = "fewer than the alignment")]
pub(super) fn padding(at: u64) -> &'static [u8] {
    &[0; ALIGNMENT as usize][..(at.next_multiple_of(ALIGNMENT) - at) as usize]
}

/// The metadata of the layer.
pub(super) struct LayerHead<'a> {
    pub(super) provenance: &'a Provenance,
    pub(super) info: LayerInfo,
    pub(super) up: UpAxis,
    pub(super) meters_per_unit: f64,
    /// The first and last time code, and the time codes per second; `None` for one frame.
    pub(super) times: Option<([i64; 2], f64)>,
    /// The name of the mesh.
    pub(super) prim: &'a str,
}

/// A property of the mesh.
pub(super) struct PropertySpec {
    pub(super) kind: String,
    pub(super) name: String,
    pub(super) value: SpecValue,
    pub(super) is_uniform: bool,
    pub(super) is_per_vertex: bool,
    pub(super) element_size: usize,
}

/// Where the value of a property is.
pub(super) enum SpecValue {
    Always(ValueRep),
    /// The value of a frame: the default, and a sample for stages, which see nothing but samples. Both refer
    /// to the same array.
    Frame(ValueRep),
    /// For each sample, its time code and its value.
    Samples(Vec<(f64, ValueRep)>),
}

/// The end of a file under construction: values, and the tables that refer to them.
pub(super) struct LayerEnd {
    base: u64,
    values: Vec<u8>,
    pub(super) tables: Tables,
}

impl LayerEnd {
    /// Starts at this offset of the file.
    pub(super) fn at(base: u64) -> LayerEnd {
        let mut tables = Tables::default();
        tables.token(ROOT); // no property may be named by token 0: see `Tables::append_paths`
        LayerEnd { base, values: Vec::new(), tables }
    }

    fn offset(&self) -> u64 {
        self.base + self.values.len() as u64
    }

    /// The representation of a number, which is inlined if a 32-bit float holds it exactly.
    #[expect(clippy::cast_possible_truncation, reason = "compared with the value afterwards")]
    fn double(&mut self, value: f64) -> ValueRep {
        if f64::from(value as f32) == value {
            return ValueRep::inlined(ValueType::Double, (value as f32).to_bits());
        }
        let rep = ValueRep::at(ValueType::Double, self.offset());
        self.values.extend_from_slice(&value.to_le_bytes());
        rep
    }

    fn int64(&mut self, value: u64) -> ValueRep {
        if let Ok(value) = i32::try_from(value) {
            return ValueRep::inlined(ValueType::Int64, value.cast_unsigned());
        }
        let rep = ValueRep::at(ValueType::Int64, self.offset());
        self.values.extend_from_slice(&value.to_le_bytes());
        rep
    }

    pub(super) fn double3(&mut self, value: [f64; 3]) -> ValueRep {
        let rep = ValueRep::at(ValueType::Vec3d, self.offset());
        value.iter().for_each(|part| self.values.extend_from_slice(&part.to_le_bytes()));
        rep
    }

    /// An array, written among the values.
    pub(super) fn array(&mut self, array: &CrateArray) -> Result<ValueRep> {
        self.values.extend_from_slice(padding(self.offset()));
        let rep = array.rep(self.offset());
        array.write(&mut self.values)?;
        Ok(rep)
    }

    /// A list of the names of children.
    fn names<'a>(&mut self, names: impl ExactSizeIterator<Item = &'a str>) -> ValueRep {
        let rep = ValueRep::at(ValueType::TokenVector, self.offset());
        append_count(names.len(), &mut self.values);
        for name in names {
            let token = self.tables.token(name);
            self.values.extend_from_slice(&token.to_le_bytes());
        }
        rep
    }

    fn dictionary(&mut self, entries: &[(&str, ValueRep)]) -> ValueRep {
        let rep = ValueRep::at(ValueType::Dictionary, self.offset());
        append_count(entries.len(), &mut self.values);
        for (key, value) in entries {
            let key = self.tables.string(key);
            self.values.extend_from_slice(&key.to_le_bytes());
            self.append_here(*value);
        }
        rep
    }

    /// Appends an offset and the value that it leads to. The offset is relative to its own position: it is 8,
    /// because nothing is in between. OpenUSD stores nested values in between.
    fn append_here(&mut self, value: ValueRep) {
        self.values.extend_from_slice(&8_i64.to_le_bytes());
        self.values.extend_from_slice(&value.0.to_le_bytes());
    }

    fn samples(&mut self, samples: &[(f64, ValueRep)]) -> ValueRep {
        let times = ValueRep::at(ValueType::DoubleVector, self.offset());
        append_count(samples.len(), &mut self.values);
        samples.iter().for_each(|(time, _)| self.values.extend_from_slice(&time.to_le_bytes()));
        let rep = ValueRep::at(ValueType::TimeSamples, self.offset());
        self.append_here(times);
        self.values.extend_from_slice(&8_i64.to_le_bytes());
        append_count(samples.len(), &mut self.values);
        samples.iter().for_each(|(_, value)| self.values.extend_from_slice(&value.0.to_le_bytes()));
        rep
    }

    fn custom_data(&mut self, head: &LayerHead) -> ValueRep {
        let mut provenance = Vec::new();
        for (key, value) in head.provenance {
            let value = ValueRep::inlined(ValueType::String, self.tables.string(value));
            provenance.push((key.as_str(), value));
        }
        let provenance = self.dictionary(&provenance);
        let LayerInfo { vertices, faces, frames } = head.info;
        let mut counts = vec![("faces", self.int64(faces)), ("vertices", self.int64(vertices))];
        counts.extend(frames.map(|frames| ("frames", self.int64(frames))));
        let counts = self.dictionary(&counts);
        self.dictionary(&[("meniscus", provenance), ("meniscus_mesh", counts)])
    }

    /// Adds the prims and properties; returns the bytes, and the offset of the table of contents.
    ///
    /// # Errors
    ///
    /// [`crate::Error::TooLarge`] if the tables exceed the format's limits.
    pub(super) fn finish(mut self, head: &LayerHead, properties: &[PropertySpec]) -> Result<(Vec<u8>, u64)> {
        let up = match head.up {
            UpAxis::Y => "Y",
            UpAxis::Z => "Z",
        };
        let mut fields = vec![
            ("customLayerData", self.custom_data(head)),
            ("defaultPrim", self.tables.token_value(ROOT)),
            ("metersPerUnit", self.double(head.meters_per_unit)),
            ("primChildren", self.names([ROOT].into_iter())),
            ("upAxis", self.tables.token_value(up)),
        ];
        if let Some(([first, last], fps)) = head.times {
            fields.extend([
                ("startTimeCode", self.double(first as f64)),
                ("endTimeCode", self.double(last as f64)),
                ("framesPerSecond", self.double(fps)),
                ("timeCodesPerSecond", self.double(fps)),
            ]);
        }
        self.tables.add_spec("", SpecType::PseudoRoot, &fields);
        let specifier = ValueRep::inlined(ValueType::Specifier, 0); // def
        let (kind, children) = (self.tables.token_value("Xform"), self.names([head.prim].into_iter()));
        let fields = [("specifier", specifier), ("typeName", kind), ("primChildren", children)];
        self.tables.add_spec(ROOT, SpecType::Prim, &fields);
        let kind = self.tables.token_value("Mesh");
        let names = self.names(properties.iter().map(|property| property.name.as_str()));
        let fields = [("specifier", specifier), ("typeName", kind), ("properties", names)];
        self.tables.add_spec(head.prim, SpecType::Prim, &fields);
        for property in properties {
            self.add_property(property)?;
        }
        let LayerEnd { base, mut values, tables } = self;
        let contents_at = tables.append(base, &mut values)?;
        Ok((values, contents_at))
    }

    fn add_property(&mut self, property: &PropertySpec) -> Result<()> {
        let PropertySpec { kind, name, value, is_uniform, is_per_vertex, element_size } = property;
        let mut fields = vec![
            ("typeName", self.tables.token_value(kind)),
            ("custom", ValueRep::inlined(ValueType::Bool, 0)),
            ("variability", ValueRep::inlined(ValueType::Variability, u32::from(*is_uniform))),
        ];
        match value {
            SpecValue::Always(value) => fields.push(("default", *value)),
            SpecValue::Frame(value) => {
                let sample = self.samples(&[(SAMPLE_CODE as f64, *value)]);
                fields.extend([("default", *value), ("timeSamples", sample)]);
            }
            SpecValue::Samples(samples) => fields.push(("timeSamples", self.samples(samples))),
        }
        if *is_per_vertex {
            fields.push(("interpolation", self.tables.token_value("vertex")));
        }
        if *element_size != 1 {
            let size = super::array::index(*element_size)?.cast_unsigned();
            fields.push(("elementSize", ValueRep::inlined(ValueType::Int, size)));
        }
        self.tables.add_spec(name, SpecType::Attribute, &fields);
        Ok(())
    }
}
