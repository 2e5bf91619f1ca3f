//! What lies beside the frames of a simulation in formats of particles, and has none.

/// What a file in a format of particles contains instead of particles.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Neighbor {
    /// The names of other files, such as a `.pvd`.
    Index,
    /// A part of a frame: another file, such as a `.pvtu`, joins it to the others.
    Part,
    /// A mesh: its points are the corners of faces.
    Mesh,
    /// A grid, or other data without a list of points.
    Grid,
    /// A table without positions of particles, such as the pressures at a gauge.
    Table,
}

impl Neighbor {
    /// What it is, in words: one file, and several.
    pub fn words(self) -> [&'static str; 2] {
        match self {
            Neighbor::Index => ["a list of other files", "lists of other files"],
            Neighbor::Part => {
                ["part of a frame that another file joins", "parts of frames that other files join"]
            }
            Neighbor::Mesh => ["a mesh, not particles", "meshes, not particles"],
            Neighbor::Grid => ["a grid, not particles", "grids, not particles"],
            Neighbor::Table => ["a table without particles", "tables without particles"],
        }
    }
}
