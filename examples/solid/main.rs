//! Writes a solid filled with any number of particles as binary PLY: a large test input.
//!
//! ```text
//! cargo run --release -p solid -- 309e6 FILE.ply
//! ```
//!
//! The shape is always the same, and the number of particles sets the spacing of the lattice. With 0.6, 4.8,
//! 38.6 and 309 million particles it corresponds to the Stanford dragon in the method's paper. A comment in
//! the header has the spacing: a good `--voxel-size`. Planes of particles are written as they are made, so
//! only a few are in memory.

mod sponge;

use std::error::Error;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use sponge::Sponge;

/// R of the shape, see `sponge.rs`. With this R, the area is 11.7 times the ⅔ power of the volume; the factor
/// of a ball is 4.8, and that of the dragon 12.5. The spheres around the particles change the area of the
/// dragon, but not that of this shape, so surfaces of both have about the same number of leaves.
const RADIUS: f64 = 6.0;

/// Number of planes that are made in parallel before they are written: a few MB each at 309 million
/// particles.
const PLANES_AT_ONCE: usize = 32;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [count, path] = arguments.as_slice() else { return Err("usage: solid PARTICLES FILE.ply".into()) };
    let requested: f64 = count.parse()?;
    if !(1.0..=4e9).contains(&requested) {
        return Err(format!("the number of particles is {count}; it must be from 1 to 4e9").into());
    }
    let solid = Sponge::new(RADIUS, (volume() / requested).cbrt());
    let count = write(&solid, Path::new(path))?;
    writeln!(std::io::stdout(), "{count} particles, spacing {}", solid.spacing)?;
    Ok(())
}

/// The volume of the shape, computed by counting the points of a lattice inside.
fn volume() -> f64 {
    let coarse = Sponge::new(RADIUS, RADIUS / 60.0);
    let count: usize = (0..coarse.plane_count()).map(|x| coarse.count_in_plane(x)).sum();
    count as f64 * coarse.spacing.powi(3)
}

/// Writes to a temporary name and renames it, so that an incomplete file is never mistaken for a complete
/// one. Returns the number of particles.
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
