//! Writes a triangle mesh as OBJ text.
//!
//! Reals are the shortest decimals that read back as the same number. Lines are formatted in
//! parallel, a run of elements per task, and written in order. The last line is a comment that says
//! how much there was, for nothing else in the format tells a whole file from a part of one.

use std::io::Write;

use rayon::prelude::*;

use super::FORMAT;
use crate::data::{MeshView, Provenance};
use crate::error::Result;
use crate::provenance::{GENERATOR, comments};

/// Elements that are formatted as one task, and tasks whose text is held at once.
const ELEMENTS_PER_TASK: usize = 1 << 13;
const TASKS_AT_ONCE: usize = 64;

/// What the last line begins with.
const LAST_LINE: &str = "# end: ";

/// How to write a mesh.
#[derive(Clone, Debug)]
pub struct WriteOptions {
    /// The name of the object.
    pub name: String,
}

impl Default for WriteOptions {
    fn default() -> WriteOptions {
        WriteOptions { name: "surface".into() }
    }
}

/// Writes positions, normals and faces. If the mesh has an origin, it is added in 64 bits and the
/// sums are printed. Axes are left as they are.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if the mesh is inconsistent or
/// not finite.
pub fn write(
    mesh: &MeshView,
    options: &WriteOptions,
    provenance: &Provenance,
    out: &mut impl Write,
) -> Result<()> {
    mesh.check(FORMAT)?;
    let name = options.name.replace(char::is_control, "_");
    write!(out, "# {GENERATOR}\n{}o {name}\n", comments(provenance, "# "))?;
    if mesh.origin == [0.0; 3] {
        write_lines(mesh.positions, |line, position| line.reals("v", *position), out)?;
    } else {
        let world =
            |p: &[f32; 3]| -> [f64; 3] { std::array::from_fn(|axis| mesh.origin[axis] + f64::from(p[axis])) };
        write_lines(mesh.positions, |line, position| line.reals("v", world(position)), out)?;
    }
    write_lines(mesh.normals, |line, normal| line.reals("vn", *normal), out)?;
    write_lines(mesh.triangles, |line, triangle| line.face(*triangle), out)?;
    let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len());
    writeln!(out, "{LAST_LINE}{vertices} vertices, {triangles} triangles")?;
    Ok(())
}

/// Whether the last bytes of a file are those of a whole one that [`write`] made.
pub(crate) fn ends_as_written(tail: &[u8]) -> bool {
    let Some(lines) = tail.strip_suffix(b"\n") else { return false };
    let start = lines.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
    lines[start..].starts_with(LAST_LINE.as_bytes())
}

/// Text in the making, with memory for one number.
struct Lines {
    text: Vec<u8>,
    real: zmij::Buffer,
    integer: itoa::Buffer,
}

impl Lines {
    fn reals<T: zmij::Float>(&mut self, keyword: &str, numbers: [T; 3]) {
        self.text.extend_from_slice(keyword.as_bytes());
        for number in numbers {
            let digits = self.real.format_finite(number);
            self.text.push(b' ');
            self.text.extend_from_slice(digits.strip_suffix(".0").unwrap_or(digits).as_bytes());
        }
        self.text.push(b'\n');
    }

    /// Vertices count from one; each has the normal of the same number.
    fn face(&mut self, triangle: [u32; 3]) {
        self.text.push(b'f');
        for index in triangle {
            let digits = self.integer.format(u64::from(index) + 1).as_bytes();
            self.text.push(b' ');
            self.text.extend_from_slice(digits);
            self.text.extend_from_slice(b"//");
            self.text.extend_from_slice(digits);
        }
        self.text.push(b'\n');
    }
}

/// Writes one line per element.
fn write_lines<T: Sync>(
    elements: &[T],
    format: impl Fn(&mut Lines, &T) + Sync,
    out: &mut impl Write,
) -> Result<()> {
    const LINE_BYTES: usize = 40; // about as long as most lines are
    for batch in elements.chunks(ELEMENTS_PER_TASK * TASKS_AT_ONCE) {
        let texts: Vec<Vec<u8>> = batch
            .par_chunks(ELEMENTS_PER_TASK)
            .map(|elements| {
                let text = Vec::with_capacity(elements.len() * LINE_BYTES);
                let mut lines = Lines { text, real: zmij::Buffer::new(), integer: itoa::Buffer::new() };
                elements.iter().for_each(|element| format(&mut lines, element));
                lines.text
            })
            .collect();
        for text in texts {
            out.write_all(&text)?;
        }
    }
    Ok(())
}
