//! The options of writers.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

/// The axis of the particles, and of the mesh, that points up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpAxis {
    /// As in glTF.
    #[default]
    Y,
    /// As in Blender and many simulators. In glTF, the node rotates the mesh by −90° about X.
    Z,
}

impl UpAxis {
    /// Both axes.
    pub const ALL: [UpAxis; 2] = [UpAxis::Y, UpAxis::Z];

    /// The value's name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            UpAxis::Y => "y",
            UpAxis::Z => "z",
        }
    }
}

/// How to write a mesh. Each format ignores options that it does not support.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshOptions {
    /// The object name, shown by other programs.
    pub name: String,
    /// The up axis.
    pub up: UpAxis,
    /// The length of a world unit in metres, positive and finite.
    pub meters_per_unit: f64,
    /// For each triangle, whether it and the next one form a quad, which is then written as one face. Empty:
    /// all faces are triangles.
    pub quads: Arc<[bool]>,
    /// Whether text USD stores each array that varies twice: as the default, and as a time sample, because a stage
    /// plays only time samples. Binary USD always has both, which share one array.
    pub time_samples: bool,
}

impl Default for MeshOptions {
    fn default() -> MeshOptions {
        MeshOptions {
            name: "surface".into(),
            up: UpAxis::Y,
            meters_per_unit: 1.0,
            quads: Arc::default(),
            time_samples: false,
        }
    }
}

/// An option that affects the files of some formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WriteOption {
    /// Quads instead of pairs of triangles.
    Quads,
    /// The up axis.
    Up,
    /// The length of a world unit.
    MetersPerUnit,
    /// The bits and the compression of the values of a level set.
    Values,
    /// The size of a picture.
    Size,
    /// The camera of a picture.
    Camera,
    /// Arrays as time samples, which a stage that plays text USD needs. Not a setting: the caller decides.
    TimeSamples,
}

impl WriteOption {
    /// All options that are settings, in the order in which they are printed.
    pub const SETTINGS: [WriteOption; 6] = [
        WriteOption::Quads,
        WriteOption::Up,
        WriteOption::MetersPerUnit,
        WriteOption::Values,
        WriteOption::Size,
        WriteOption::Camera,
    ];

    /// Its name in the provenance of a file. Unlike the key, it need not name the format: `values`, not `vdb`.
    pub fn name(self) -> &'static str {
        match self {
            WriteOption::Quads => "quads",
            WriteOption::Up => "up",
            WriteOption::MetersPerUnit => "meters_per_unit",
            WriteOption::Values => "values",
            WriteOption::Size => "size",
            WriteOption::Camera => "camera",
            WriteOption::TimeSamples => "time_samples",
        }
    }

    /// Its key in a settings file; with `-` for `_`, its name on the command line.
    pub fn key(self) -> &'static str {
        match self {
            WriteOption::Values => "vdb",
            WriteOption::Size => "preview_size",
            other => other.name(),
        }
    }
}
