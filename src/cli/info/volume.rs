//! The grids of an OpenVDB file for `meniscus info`.

use std::collections::BTreeMap;
use std::fmt;

use meniscus_formats::vdb::{GridInfo, MetaValue};
use serde::Serialize;

use super::super::wording::shortest;
use super::{block, row, vector};

/// A grid.
#[derive(Debug, Serialize)]
pub(super) struct GridRecord {
    name: String,
    class: String,
    #[serde(rename = "type")]
    tree_type: String,
    half: bool,
    /// Along each index axis, in world units; null if the transform has an unsupported type.
    voxel_size: Option<[f64; 3]>,
    /// The world position of voxel (0, 0, 0).
    origin: Option<[f64; 3]>,
    /// Minimum and maximum index of the active voxels.
    active_bounds: Option<[[i32; 3]; 2]>,
    active_voxels: Option<u64>,
    metadata: BTreeMap<String, serde_json::Value>,
}

impl From<GridInfo> for GridRecord {
    fn from(grid: GridInfo) -> GridRecord {
        GridRecord {
            name: grid.name,
            class: grid.class,
            tree_type: grid.type_name,
            half: grid.half,
            voxel_size: grid.transform.map(|transform| transform.voxel_size()),
            origin: grid.transform.map(|transform| transform.translation),
            active_bounds: grid.active_bounds.map(|(min, max)| [min, max]),
            active_voxels: grid.active_voxel_count,
            metadata: grid.metadata.into_iter().map(|(name, value)| (name, json_value(value))).collect(),
        }
    }
}

fn json_value(value: MetaValue) -> serde_json::Value {
    match value {
        MetaValue::String(text) => text.into(),
        MetaValue::Bool(flag) => flag.into(),
        MetaValue::Integer(number) => number.into(),
        MetaValue::Real(number) => number.into(),
        MetaValue::Vec3i(vector) => vector.to_vec().into(),
        MetaValue::Vec3d(vector) => vector.to_vec().into(),
        MetaValue::Other(type_name, byte_count) => format!("{type_name}, {byte_count} bytes").into(),
    }
}

impl fmt::Display for GridRecord {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let class = if self.class.is_empty() { "no class" } else { &self.class };
        row(f, "grid", format_args!("{}: {class}, {}", self.name, self.tree_type))?;
        if let Some(voxel_size) = self.voxel_size {
            row(f, "voxel size", voxel_size.map(shortest).join(" × "))?;
        }
        if let Some(origin) = self.origin {
            row(f, "voxel (0, 0, 0) at", vector(&origin.map(shortest)))?;
        }
        if let Some([min, max]) = self.active_bounds {
            row(f, "active voxels from", format_args!("{min:?} to {max:?}"))?;
        }
        if let Some(count) = self.active_voxels {
            row(f, "active voxels", count)?;
        }
        let shown = |value: &serde_json::Value| match value {
            serde_json::Value::String(text) => text.clone(),
            serde_json::Value::Number(number) if number.is_f64() => {
                number.as_f64().map_or_else(|| number.to_string(), shortest)
            }
            other => other.to_string(),
        };
        let (mut made_with, mut others) = (BTreeMap::new(), BTreeMap::new());
        for (name, value) in &self.metadata {
            match name.strip_prefix("meniscus_") {
                Some(name) => made_with.insert(name.to_owned(), shown(value)),
                None => others.insert(name.clone(), shown(value)),
            };
        }
        block(f, "metadata", &others)?;
        block(f, "made with", &made_with)
    }
}
