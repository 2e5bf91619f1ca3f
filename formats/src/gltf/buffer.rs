//! Reads typed numbers from the buffers of a glTF document, with all bounds checked.
//!
//! The crate gltf iterates over the elements, including sparse ones, but trusts what the document declares.
//! This module therefore first compares every declaration with the available bytes.
use std::rc::Rc;

use ::gltf::accessor::{DataType, Dimensions, Item, Iter, sparse};
use ::gltf::buffer::{Buffer, View};
use ::gltf::{Accessor, Semantic};

use super::FORMAT;
use crate::error::{Error, Position, Result};

/// The bytes of the document's buffers. Several buffers can share a file.
pub(super) struct Buffers {
    pub(super) bytes: Vec<Rc<Vec<u8>>>,
}

impl Buffers {
    /// The elements of an accessor of vectors; converts normalized integers to −1 ..= 1.
    pub(super) fn vectors(&self, accessor: &Accessor, semantic: &Semantic) -> Result<Vec<[f64; 3]>> {
        if accessor.dimensions() != Dimensions::Vec3 {
            return Err(invalid(format!(
                "{semantic:?} has the type {:?}; expected Vec3",
                accessor.dimensions()
            )));
        }
        let scale = match accessor.data_type() {
            // `normalized` has no meaning for floats, but some exporters set it.
            DataType::F32 => None,
            _ if !accessor.normalized() => None,
            DataType::I8 => Some(f64::from(i8::MAX)),
            DataType::U8 => Some(f64::from(u8::MAX)),
            DataType::I16 => Some(f64::from(i16::MAX)),
            DataType::U16 => Some(f64::from(u16::MAX)),
            DataType::U32 => Some(f64::from(u32::MAX)),
        };
        match accessor.data_type() {
            DataType::I8 => self.reals::<i8>(accessor, scale),
            DataType::U8 => self.reals::<u8>(accessor, scale),
            DataType::I16 => self.reals::<i16>(accessor, scale),
            DataType::U16 => self.reals::<u16>(accessor, scale),
            DataType::U32 => self.reals::<u32>(accessor, scale),
            DataType::F32 => self.reals::<f32>(accessor, scale),
        }
    }

    /// The elements of an accessor of indices.
    pub(super) fn indices(&self, accessor: &Accessor) -> Result<Vec<u32>> {
        match (accessor.dimensions(), accessor.data_type()) {
            (Dimensions::Scalar, DataType::U8) => {
                Ok(self.elements::<u8>(accessor)?.into_iter().map(u32::from).collect())
            }
            (Dimensions::Scalar, DataType::U16) => {
                Ok(self.elements::<u16>(accessor)?.into_iter().map(u32::from).collect())
            }
            (Dimensions::Scalar, DataType::U32) => self.elements::<u32>(accessor),
            (dimensions, data) => {
                Err(invalid(format!("the indices have the invalid type {dimensions:?} of {data:?}")))
            }
        }
    }

    /// The stored numbers of an accessor, element by element. Matrices are not supported.
    pub(super) fn components<T: Item + Copy>(&self, accessor: &Accessor) -> Result<Vec<T>> {
        Ok(match accessor.dimensions() {
            Dimensions::Scalar => self.elements::<T>(accessor)?,
            Dimensions::Vec2 => self.elements::<[T; 2]>(accessor)?.into_flattened(),
            Dimensions::Vec3 => self.elements::<[T; 3]>(accessor)?.into_flattened(),
            Dimensions::Vec4 => self.elements::<[T; 4]>(accessor)?.into_flattened(),
            dimensions => {
                return Err(invalid(format!("a vertex attribute has the unsupported type {dimensions:?}")));
            }
        })
    }

    fn reals<T: Item + Copy + Into<f64>>(
        &self,
        accessor: &Accessor,
        scale: Option<f64>,
    ) -> Result<Vec<[f64; 3]>> {
        let real = |component: T| match scale {
            Some(greatest) => (component.into() / greatest).max(-1.0),
            None => component.into(),
        };
        Ok(self.elements::<[T; 3]>(accessor)?.into_iter().map(|element| element.map(real)).collect())
    }

    /// The stored elements.
    fn elements<T: Item>(&self, accessor: &Accessor) -> Result<Vec<T>> {
        if accessor.count() == 0 {
            return Ok(Vec::new());
        }
        self.check(accessor)?;
        let bytes = |buffer: Buffer| self.bytes.get(buffer.index()).map(|bytes| bytes.as_slice());
        let elements = Iter::new(accessor.clone(), bytes).ok_or_else(|| beyond(accessor.count()))?;
        Ok(elements.take(accessor.count()).collect())
    }

    /// Checks that the buffers contain all data of an accessor.
    fn check(&self, accessor: &Accessor) -> Result<()> {
        let (count, size) = (accessor.count(), accessor.size());
        if let Some(view) = accessor.view() {
            self.part(&view, accessor.offset(), count, size)?;
        }
        match accessor.sparse() {
            Some(sparse) => self.check_sparse(&sparse, count, size),
            None if accessor.view().is_none() => {
                Err(Error::unsupported(FORMAT, "an accessor without a buffer view is not supported"))
            }
            None => Ok(()),
        }
    }

    /// Checks that the data of sparse elements exists, and that their indices are in bounds and ascend
    /// without repetition, as the iterator of the crate requires.
    fn check_sparse(&self, sparse: &sparse::Sparse, count: usize, size: usize) -> Result<()> {
        let sparse_count = sparse.count();
        if sparse_count == 0 || sparse_count > count {
            return Err(invalid(format!(
                "an accessor has {sparse_count} sparse elements, but only {count} elements"
            )));
        }
        let (indices, values) = (sparse.indices(), sparse.values());
        self.part(&values.view(), values.offset(), sparse_count, size)?;
        let width = indices.index_type().size();
        let (bytes, stride) = self.part(&indices.view(), indices.offset(), sparse_count, width)?;
        let mut last = None;
        for start in (0..sparse_count).map(|index| index * stride) {
            let index =
                bytes[start..start + width].iter().rfold(0, |index, byte| index << 8 | usize::from(*byte));
            if index >= count || last.is_some_and(|last| index <= last) {
                return Err(invalid(format!("the sparse element {index} of {count} is out of order")));
            }
            last = Some(index);
        }
        Ok(())
    }

    /// The bytes from the first element on, and the stride, after checking that all elements exist.
    fn part(&self, view: &View, offset: usize, count: usize, size: usize) -> Result<(&[u8], usize)> {
        let buffer = self.bytes.get(view.buffer().index());
        let end = view.offset().checked_add(view.length());
        let bytes = buffer.zip(end).and_then(|(buffer, end)| buffer.get(view.offset()..end));
        let bytes = bytes.and_then(|bytes| bytes.get(offset..));
        let stride = view.stride().unwrap_or(size);
        let needed = (count - 1)
            .checked_mul(stride)
            .and_then(|before| before.checked_add(size))
            .filter(|_| size <= stride);
        match (bytes, needed) {
            (Some(bytes), Some(needed)) if needed <= bytes.len() => Ok((bytes, stride)),
            _ => Err(beyond(count)),
        }
    }
}

fn beyond(count: usize) -> Error {
    invalid(format!("an accessor of {count} elements exceeds its buffer"))
}

pub(super) fn invalid(what: impl Into<String>) -> Error {
    Error::invalid(FORMAT, Position::File, what)
}
