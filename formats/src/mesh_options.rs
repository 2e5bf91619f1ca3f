//! How files are written, as far as that can be chosen.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

/// The axis of the particles that points up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpAxis {
    /// As in glTF.
    #[default]
    Y,
    /// As in Blender and many simulators. In glTF the node turns the mesh by −90° about X.
    Z,
}

impl UpAxis {
    /// Both axes.
    pub const ALL: [UpAxis; 2] = [UpAxis::Y, UpAxis::Z];

    /// Its name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            UpAxis::Y => "y",
            UpAxis::Z => "z",
        }
    }
}

/// How to write a mesh. Each format uses the options that it has.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshOptions {
    /// The name that programs show.
    pub name: String,
    /// Which axis of the mesh points up.
    pub up: UpAxis,
    /// The length of a world unit in metres, positive and finite.
    pub meters_per_unit: f64,
    /// Whether positions and normals are small integers.
    pub quantize: bool,
    /// For each triangle whether it and the next one are the halves of a quad, which is then written as one. Empty: all
    /// are triangles.
    pub quads: Arc<[bool]>,
}

impl Default for MeshOptions {
    fn default() -> MeshOptions {
        MeshOptions {
            name: "surface".into(),
            up: UpAxis::Y,
            meters_per_unit: 1.0,
            quantize: false,
            quads: Arc::default(),
        }
    }
}

/// An option that changes the files of some formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WriteOption {
    /// Quads instead of pairs of triangles.
    Quads,
    /// Which axis points up.
    Up,
    /// The length of a world unit.
    MetersPerUnit,
    /// Small integers.
    Quantize,
    /// 16-bit values.
    Half,
    /// How values are compressed.
    Compression,
    /// The size of a picture.
    Size,
    /// Where a picture is taken from.
    Camera,
}

impl WriteOption {
    /// All options, in the order in which settings are printed.
    pub const ALL: [WriteOption; 8] = [
        WriteOption::Quads,
        WriteOption::Up,
        WriteOption::MetersPerUnit,
        WriteOption::Quantize,
        WriteOption::Half,
        WriteOption::Compression,
        WriteOption::Size,
        WriteOption::Camera,
    ];

    /// Its name in what a file records of its making, where the format is known.
    pub fn name(self) -> &'static str {
        match self {
            WriteOption::Quads => "quads",
            WriteOption::Up => "up",
            WriteOption::MetersPerUnit => "meters_per_unit",
            WriteOption::Quantize => "quantize",
            WriteOption::Half => "half",
            WriteOption::Compression => "compression",
            WriteOption::Size => "size",
            WriteOption::Camera => "camera",
        }
    }

    /// Its key in a file of settings; with `-` for `_` its name on the command line.
    pub fn key(self) -> &'static str {
        match self {
            WriteOption::Half => "vdb_half",
            WriteOption::Compression => "vdb_compression",
            WriteOption::Size => "preview_size",
            other => other.name(),
        }
    }
}
