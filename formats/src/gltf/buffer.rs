//! Typed numbers out of the buffers of a glTF document, with every bound checked.

use serde::Deserialize;

use super::{FORMAT, component};
use crate::error::{Error, Place, Result};

/// A typed view of a part of a buffer.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    r#type: String,
    sparse: Option<serde::de::IgnoredAny>,
}

/// A part of a buffer.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct BufferView {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

/// The elements of an accessor: bytes that are known to be there.
pub(super) struct Elements<'a> {
    bytes: &'a [u8],
    stride: usize,
    component_type: u32,
    normalized: bool,
    count: usize,
}

impl Accessor {
    /// Finds the elements, each of `arity` components.
    pub(super) fn elements<'a>(
        &self,
        arity: usize,
        views: &[BufferView],
        buffers: &'a [Vec<u8>],
    ) -> Result<Elements<'a>> {
        let kind = if arity == 1 { "SCALAR" } else { "VEC3" };
        let Some(component_bytes) = component_bytes(self.component_type).filter(|_| self.r#type == kind)
        else {
            let what = format!(
                "an accessor of {} with components {}; expected {kind}",
                self.r#type, self.component_type
            );
            return Err(invalid(what));
        };
        let Some(view) = self.buffer_view else {
            return Err(Error::unsupported(FORMAT, "an accessor without a buffer view"));
        };
        if self.sparse.is_some() {
            return Err(Error::unsupported(FORMAT, "a sparse accessor; export without sparse data"));
        }
        let view = views.get(view).ok_or_else(|| invalid(format!("no buffer view {view}")))?;
        let end = view.byte_offset.checked_add(view.byte_length);
        let bytes =
            buffers.get(view.buffer).zip(end).and_then(|(buffer, end)| buffer.get(view.byte_offset..end));
        let bytes = bytes.and_then(|bytes| bytes.get(self.byte_offset..));
        let element_bytes = arity * component_bytes;
        let stride = view.byte_stride.unwrap_or(element_bytes);
        let needed = match self.count.checked_sub(1) {
            None => Some(0),
            Some(last) => last.checked_mul(stride).and_then(|bytes| bytes.checked_add(element_bytes)),
        };
        match (bytes, needed) {
            (Some(bytes), Some(needed)) if needed <= bytes.len() && element_bytes <= stride => Ok(Elements {
                bytes,
                stride,
                component_type: self.component_type,
                normalized: self.normalized,
                count: self.count,
            }),
            _ => Err(invalid(format!("an accessor of {} elements that exceeds its buffer", self.count))),
        }
    }
}

impl Elements<'_> {
    /// How many elements there are.
    pub(super) fn len(&self) -> usize {
        self.count
    }

    /// The elements as vectors; integers that stand for −1 ..= 1 are converted.
    pub(super) fn vectors(&self) -> impl Iterator<Item = [f64; 3]> + '_ {
        let component_bytes = component_bytes(self.component_type).unwrap_or(0);
        (0..self.count).map(move |index| {
            let at = index * self.stride;
            std::array::from_fn(|axis| self.number(at + axis * component_bytes))
        })
    }

    /// The elements as indices; none if the component type cannot be one.
    pub(super) fn indices(&self) -> Option<Vec<u32>> {
        let at = |index: usize| &self.bytes[index * self.stride..];
        let indices = 0..self.count;
        match self.component_type {
            component::U8 => Some(indices.map(|i| u32::from(at(i)[0])).collect()),
            component::U16 => Some(indices.map(|i| u32::from(u16::from_le_bytes(first(at(i))))).collect()),
            component::U32 => Some(indices.map(|i| u32::from_le_bytes(first(at(i)))).collect()),
            _ => None,
        }
    }

    fn number(&self, at: usize) -> f64 {
        let bytes = &self.bytes[at..];
        let (value, greatest) = match self.component_type {
            component::I8 => (f64::from(i8::from_le_bytes(first(bytes))), f64::from(i8::MAX)),
            component::U8 => (f64::from(bytes[0]), f64::from(u8::MAX)),
            component::I16 => (f64::from(i16::from_le_bytes(first(bytes))), f64::from(i16::MAX)),
            component::U16 => (f64::from(u16::from_le_bytes(first(bytes))), f64::from(u16::MAX)),
            component::U32 => (f64::from(u32::from_le_bytes(first(bytes))), f64::from(u32::MAX)),
            // The flag means nothing for reals; some exporters set it all the same.
            _ => return f64::from(f32::from_le_bytes(first(bytes))),
        };
        if self.normalized { (value / greatest).max(-1.0) } else { value }
    }
}

/// The first bytes of a slice that is known to have them.
fn first<const N: usize>(bytes: &[u8]) -> [u8; N] {
    std::array::from_fn(|index| bytes[index])
}

fn component_bytes(component_type: u32) -> Option<usize> {
    match component_type {
        component::I8 | component::U8 => Some(1),
        component::I16 | component::U16 => Some(2),
        component::U32 | component::F32 => Some(4),
        _ => None,
    }
}

pub(super) fn invalid(what: impl Into<String>) -> Error {
    Error::invalid(FORMAT, Place::File, what)
}
