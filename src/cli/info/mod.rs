//! `meniscus info`: what files hold.
//!
//! The structs here and in the files below are those of the JSON; the text shows the same.

mod mesh;
mod particles;
mod volume;

use std::fmt;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use anyhow::{Result, anyhow};
use meniscus_formats::{
    Kind, Limits, ParticleFrame, Positions, Probe, Role, gltf, obj, ply, probe, read_particles, vdb,
};
use serde::Serialize;

use super::Verdict;
use super::args::InfoArgs;
use super::console::Console;

use mesh::MeshInfo;
use particles::ParticlesInfo;
use volume::GridRecord;

/// One file.
#[derive(Debug, Default, Serialize)]
struct FileInfo {
    file: String,
    kind: String,
    gzipped: bool,
    bytes: usize,
    /// What a user should know though the file was read.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    notes: Vec<String>,
    /// Of a mesh: its vertices, where they have more than positions and normals.
    #[serde(skip_serializing_if = "Option::is_none")]
    particles: Option<ParticlesInfo>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mesh: Option<MeshInfo>,
    #[serde(skip_serializing_if = "Option::is_none")]
    grids: Option<Vec<GridRecord>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// Tells what the files hold, each on its own: one that cannot be read is told as such.
///
/// # Errors
/// When the result cannot be written as JSON.
pub(super) fn info(args: &InfoArgs, console: &mut Console) -> Result<Verdict> {
    let mut infos = Vec::new();
    let mut failed_count = 0;
    for path in &args.files {
        let info = file_info(path);
        match &info.error {
            Some(error) => {
                failed_count += 1;
                console.warn(format_args!("error: {}: {error}", info.file));
            }
            None if !args.json => console.say(format_args!("{info}")),
            None => {}
        }
        infos.push(info);
    }
    if args.json {
        console.say(serde_json::to_string_pretty(&infos)?);
    }
    Ok(match failed_count {
        0 => Verdict::Done,
        failed_count if failed_count < args.files.len() => Verdict::SomeFailed,
        _ => Verdict::NothingDone,
    })
}

fn file_info(path: &Path) -> FileInfo {
    let mut info = FileInfo { file: path.to_string_lossy().into_owned(), ..FileInfo::default() };
    // A fault in a reader costs this file only.
    let result = catch_unwind(AssertUnwindSafe(|| info.fill(path)))
        .unwrap_or_else(|_| Err(anyhow!("a fault in this program")));
    info.error = result.err().map(|error| format!("{error:#}"));
    info
}

impl FileInfo {
    fn fill(&mut self, path: &Path) -> Result<()> {
        let bytes = fs::read(path)?;
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let Probe { kind, gzipped } = probe(&bytes, &name);
        self.kind = kind.name().to_owned();
        self.gzipped = gzipped;
        self.bytes = bytes.len();
        let limits = Limits::default();
        match kind {
            Kind::OpenVdb if !gzipped => {
                self.grids = Some(vdb::grids(&bytes, &limits)?.into_iter().map(GridRecord::from).collect());
            }
            Kind::Glb | Kind::GltfJson if !gzipped => {
                let mesh = gltf::read_mesh(&bytes, &limits)?;
                self.mesh = Some(MeshInfo::of(&mesh));
                let attributes = gltf::read_attributes(&bytes, &limits)?;
                let vertices = ParticleFrame {
                    positions: Positions::F64(mesh.positions),
                    attributes,
                    notes: Vec::new(),
                };
                self.particles = has_more_than_a_mesh(&vertices).then(|| ParticlesInfo::of(vertices));
            }
            Kind::Obj if !gzipped => self.mesh = Some(MeshInfo::of(&obj::read_mesh(&bytes)?)),
            Kind::Ply if !gzipped && holds_mesh(&bytes, &limits)? => {
                let (mesh, vertices) = ply::read_mesh_and_vertices(&bytes, &limits)?;
                self.notes.clone_from(&vertices.notes);
                self.mesh = Some(MeshInfo::of(&mesh));
                self.particles = has_more_than_a_mesh(&vertices).then(|| ParticlesInfo::of(vertices));
            }
            _ => {
                let frame = read_particles(&bytes, &name, &limits)?;
                self.notes.clone_from(&frame.notes);
                self.particles = Some(ParticlesInfo::of(frame));
            }
        }
        Ok(())
    }
}

/// Whether a PLY file declares faces, of which there are none only where there are no vertices
/// either: programs declare no faces for clouds of points, too.
fn holds_mesh(bytes: &[u8], limits: &Limits) -> Result<bool> {
    let header = ply::read_header(bytes, limits)?;
    let count = |name: &str| {
        let mut elements = header.elements.iter();
        elements.find(|element| element.name.eq_ignore_ascii_case(name)).map(|element| element.count)
    };
    // Strips of triangles are refused by the reader of meshes, with what to do.
    let faces = [count("face"), count("tristrips").filter(|&count| count > 0)].into_iter().flatten().max();
    Ok(faces.is_some_and(|faces| faces > 0 || count("vertex") == Some(0)))
}

/// Whether the vertices of a mesh have anything beside their positions and normals.
fn has_more_than_a_mesh(vertices: &ParticleFrame) -> bool {
    vertices.attributes.iter().any(|attribute| attribute.role != Some(Role::Normal))
}

impl fmt::Display for FileInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let packed = if self.gzipped { ", gzipped" } else { "" };
        write!(f, "{}: {}{packed}, {} bytes", self.file, self.kind, self.bytes)?;
        match (&self.mesh, &self.particles) {
            (Some(mesh), particles) => {
                write!(f, "{mesh}")?;
                // Count and bounds were told with the mesh.
                particles.iter().try_for_each(|vertices| vertices.fmt_attributes(f))?;
            }
            (None, Some(particles)) => write!(f, "{particles}")?,
            (None, None) => {}
        }
        for grid in self.grids.iter().flatten() {
            write!(f, "{grid}")?;
        }
        for note in &self.notes {
            row(f, "note", note)?;
        }
        Ok(())
    }
}

/// One line of text: what it is, and what is to be said of it.
fn row(f: &mut fmt::Formatter<'_>, label: &str, value: impl fmt::Display) -> fmt::Result {
    write!(f, "\n  {label:<20} {value}")
}

/// A box in world units.
#[derive(Clone, Copy, Debug, Serialize)]
struct Bounds {
    min: [f64; 3],
    max: [f64; 3],
}

impl Bounds {
    /// The box of the finite ones among these positions; `None` where there is none.
    fn of(positions: impl Iterator<Item = [f64; 3]>) -> Option<Bounds> {
        let finite = positions.filter(|position| position.iter().all(|x| x.is_finite()));
        finite.fold(None, |bounds: Option<Bounds>, position| {
            let Bounds { mut min, mut max } = bounds.unwrap_or(Bounds { min: position, max: position });
            for axis in 0..3 {
                min[axis] = min[axis].min(position[axis]);
                max[axis] = max[axis].max(position[axis]);
            }
            Some(Bounds { min, max })
        })
    }

    /// The same for bounds of 32-bit positions: with the digits that these have.
    fn short(self) -> Bounds {
        Bounds { min: self.min.map(short), max: self.max.map(short) }
    }
}

/// The 64-bit real that prints with the digits of a 32-bit one: 1.4 and not 1.399999976158142.
fn short(value: f64) -> f64 {
    (value as f32).to_string().parse().unwrap_or(value)
}

impl fmt::Display for Bounds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [min, max] = [self.min, self.max].map(|corner| corner.map(|x| x.to_string()).join(", "));
        write!(f, "({min}) to ({max})")
    }
}
