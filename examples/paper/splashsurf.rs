//! Runs splashsurf as a separate program.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use glam::DVec3;
use meniscus_formats::{FilePositions, Limits, MeshData, ParticleFrame, ply};

use crate::Outcome;

/// The post-processing of the mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Post {
    /// No post-processing.
    Plain,
    /// Weighted Laplacian smoothing, as its authors recommend.
    Processed,
    /// The same smoothing, and a kernel that is twice as wide: for particles with gaps.
    Wide,
}

/// The arguments for smoothing and cleanup; the same as in `benches/peers`.
const PROCESSED: [&str; 6] = [
    "--mesh-smoothing-weights=on",
    "--mesh-smoothing-iters=25",
    "--mesh-cleanup=on",
    "--decimate-barnacles=off",
    "--normals=on",
    "--normals-smoothing-iters=10",
];

/// The executable.
pub(crate) struct Splashsurf {
    program: PathBuf,
    folder: tempfile::TempDir,
}

impl Splashsurf {
    /// Uses `SPLASHSURF`, or else the executable that `benches/peers` installed in cargo's target folder.
    pub(crate) fn find() -> Outcome<Splashsurf> {
        let built = env::var_os("CARGO_TARGET_DIR").map_or_else(|| "target".into(), PathBuf::from);
        let installed = || built.join("peers/bin/splashsurf");
        let program = env::var_os("SPLASHSURF").map_or_else(installed, PathBuf::from);
        if !program.is_file() {
            return Err(format!(
                "{}: splashsurf not found; install it with benches/peers",
                program.display()
            )
            .into());
        }
        Ok(Splashsurf { program, folder: tempfile::tempdir()? })
    }

    /// The surface of particles with this spacing, with cells of this size.
    pub(crate) fn reconstruct(
        &self,
        particles: &[DVec3],
        spacing: f64,
        cell: f64,
        post: Post,
    ) -> Outcome<MeshData> {
        let [input, output] = ["in.ply", "out.ply"].map(|name| self.folder.path().join(name));
        write(particles, &input)?;
        let radius = 0.5 * spacing;
        let settings = [
            ("-r", radius),
            ("-l", if post == Post::Wide { 4.0 } else { 2.0 }),
            ("-c", cell / radius),
            ("-t", 0.6),
        ];
        let mut command = Command::new(&self.program);
        command.arg("reconstruct").arg(&input).arg("-o").arg(&output).arg("-q");
        for (option, value) in settings {
            command.args([option, &value.to_string()]);
        }
        if post != Post::Plain {
            command.args(PROCESSED);
        }
        let result = command.output()?;
        if !result.status.success() {
            return Err(String::from_utf8_lossy(&result.stderr).into_owned().into());
        }
        Ok(ply::read_mesh(&fs::read(&output)?, &Limits::default())?)
    }
}

fn write(particles: &[DVec3], path: &Path) -> Outcome<()> {
    let positions = particles.iter().map(|particle| particle.as_vec3().to_array()).collect();
    let frame = ParticleFrame { positions: FilePositions::F32(positions), ..ParticleFrame::default() };
    let mut bytes = Vec::new();
    ply::write_particles(&frame, &[], &mut bytes)?;
    Ok(fs::write(path, bytes)?)
}
