//! splashsurf, as a program beside this one.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use glam::DVec3;
use meniscus_formats::{Limits, MeshData, ParticleFrame, Positions, ply};

use crate::Outcome;

/// Whether its mesh is smoothed afterwards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Post {
    /// As it comes.
    Plain,
    /// Weighted Laplacian smoothing, as its authors recommend it.
    Processed,
    /// The same, with a kernel twice as wide: for particles that leave gaps.
    Wide,
}

/// Smooths and cleans up; the same as in `benches/peers`.
const PROCESSED: [&str; 6] = [
    "--mesh-smoothing-weights=on",
    "--mesh-smoothing-iters=25",
    "--mesh-cleanup=on",
    "--decimate-barnacles=off",
    "--normals=on",
    "--normals-smoothing-iters=10",
];

/// Where it is.
pub(crate) struct Splashsurf {
    program: PathBuf,
    folder: tempfile::TempDir,
}

impl Splashsurf {
    /// What `SPLASHSURF` names, else what `benches/peers` has installed beside what cargo builds.
    pub(crate) fn find() -> Outcome<Splashsurf> {
        let built = env::var_os("CARGO_TARGET_DIR").map_or_else(|| "target".into(), PathBuf::from);
        let installed = || built.join("peers/bin/splashsurf");
        let program = env::var_os("SPLASHSURF").map_or_else(installed, PathBuf::from);
        if !program.is_file() {
            return Err(
                format!("{}: no splashsurf there; benches/peers installs it", program.display()).into()
            );
        }
        Ok(Splashsurf { program, folder: tempfile::tempdir()? })
    }

    /// The surface of particles that stand for so much room, with cells of this size.
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
        let ran = command.output()?;
        if !ran.status.success() {
            return Err(String::from_utf8_lossy(&ran.stderr).into_owned().into());
        }
        Ok(ply::read_mesh(&fs::read(&output)?, &Limits::default())?)
    }
}

fn write(particles: &[DVec3], path: &Path) -> Outcome<()> {
    let positions = particles.iter().map(|particle| particle.as_vec3().to_array()).collect();
    let frame = ParticleFrame { positions: Positions::F32(positions), ..ParticleFrame::default() };
    let mut bytes = Vec::new();
    ply::write_particles(&frame, &[], &mut bytes)?;
    Ok(fs::write(path, bytes)?)
}
