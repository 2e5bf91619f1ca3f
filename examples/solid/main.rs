//! Writes a solid full of particles, of any number, as binary PLY: something large to skin.
//!
//! ```text
//! cargo run --release -p solid -- 309e6 FILE.ply
//! ```
//!
//! The shape is always the same and the lattice in it as fine as the number asks for, so that it is to 0.6, 4.8,
//! 38.6 and 309 million particles what the Stanford dragon is to the method's paper. The header says the spacing in a
//! comment: a good `--voxel-size`. Planes are written as they are made; there are never more than a few in memory.

mod sponge;

use std::error::Error;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use sponge::Sponge;

/// R of the shape. There its area is 11.7 times the ⅔ power of its volume; a ball's is 4.8. With what the spheres around
/// particles add to the dragon, whose ratio is 12.5, and do not add to this, both have about as many leaves.
const RADIUS: f64 = 6.0;

/// Planes that are made side by side before they are written: a few MB each at 309 million particles.
const PLANES_AT_ONCE: usize = 32;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [count, path] = arguments.as_slice() else { return Err("usage: solid PARTICLES FILE.ply".into()) };
    let asked: f64 = count.parse()?;
    if !(1.0..=4e9).contains(&asked) {
        return Err(format!("{count} particles: from 1 to 4e9 can be had").into());
    }
    let solid = Sponge::new(RADIUS, (volume() / asked).cbrt());
    let count = write(&solid, Path::new(path))?;
    writeln!(std::io::stdout(), "{count} particles, spacing {}", solid.spacing)?;
    Ok(())
}

/// The volume of the shape, by counting points of a lattice of its own.
fn volume() -> f64 {
    let coarse = Sponge::new(RADIUS, RADIUS / 60.0);
    let count: usize = (0..coarse.plane_count()).map(|x| coarse.count_in_plane(x)).sum();
    count as f64 * coarse.spacing.powi(3)
}

/// Writes under another name and renames, so that no half file is ever taken for a whole one. Returns the number of
/// particles.
fn write(solid: &Sponge, path: &Path) -> Result<usize, Box<dyn Error>> {
    let count: usize = (0..solid.plane_count()).into_par_iter().map(|x| solid.count_in_plane(x)).sum();
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = PathBuf::from(part);
    let mut file = File::create(&part)?;
    write!(
        file,
        "ply\nformat binary_little_endian 1.0\ncomment spacing {}\nelement vertex {count}\n\
         property float x\nproperty float y\nproperty float z\nend_header\n",
        solid.spacing
    )?;
    for first in (0..solid.plane_count()).step_by(PLANES_AT_ONCE) {
        let planes = first..solid.plane_count().min(first + PLANES_AT_ONCE);
        let made: Vec<Vec<u8>> = planes.into_par_iter().map(|x| bytes_of_plane(solid, x)).collect();
        for bytes in made {
            file.write_all(&bytes)?;
        }
    }
    fs::rename(&part, path)?;
    Ok(count)
}

fn bytes_of_plane(solid: &Sponge, x: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    solid.for_each_in_plane(x, |particle| bytes.extend(particle.into_iter().flat_map(f32::to_le_bytes)));
    bytes
}
