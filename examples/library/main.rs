//! Uses meniscus as a library: converts one frame to a mesh, or all frames in a folder to meshes and level
//! sets in another.
//!
//! ```text
//! cargo run -p library -- examples/frames/dam.0001.bgeo out/dam.0001.glb
//! cargo run -p library -- examples/frames out/library
//! ```
//!
//! To convert one frame, your crate needs only
//!
//! ```toml
//! meniscus-surface = "0.1"
//! meniscus-formats = "0.1"    # only to read and write files
//! ```
//!
//! with `meniscus_surface` in place of `meniscus::surface` below. To convert folders, it needs `meniscus`,
//! and `rayon` for the threads.

use std::error::Error;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;
use std::sync::Arc;

use meniscus::glam::DVec3;
use meniscus::pipeline::{self, Frame, FrameFile, Outcome, OutputFormat, OutputOptions, PipelineOptions};
use meniscus::surface::options::{Settings, SpacingOptions};
use meniscus::surface::{Options, Phase, Reconstructor};
use meniscus_formats::{FilePositions, Limits, MeshOptions, MeshView, gltf, read_particles};
use rayon::ThreadPoolBuilder;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [from, to] = arguments.as_slice() else {
        return Err("usage: library FRAME FILE.glb | FOLDER FOLDER".into());
    };
    let (from, to) = (Path::new(from), Path::new(to));
    if !from.is_dir() {
        if let Some(folder) = to.parent() {
            fs::create_dir_all(folder)?;
        }
        return reconstruct_file(from, to);
    }
    let count = convert_folder(from, to)?;
    writeln!(std::io::stdout(), "{count} frames are in {}", to.display())?;
    Ok(())
}

/// Reads a file of particles in any supported format, reconstructs its surface and writes a .glb file.
pub(crate) fn reconstruct_file(from: &Path, to: &Path) -> Result<(), Box<dyn Error>> {
    let name = from.file_name().unwrap_or_default().to_string_lossy();
    let frame = read_particles(&fs::read(from)?, &name, &Limits::default())?;

    // If you need neither a callback nor a memory limit, `meniscus::surface::reconstruct(&positions,
    // &options)` is enough.
    let mut reconstructor = Reconstructor::new(Options::default());
    reconstructor.memory_limit(4 << 30).on_progress(|progress| {
        if progress.phase == Phase::Smooth {
            let _ = write!(std::io::stderr(), "\rsmoothing {:3.0} %", 100.0 * progress.fraction);
        }
    });
    let surface = match &frame.positions {
        FilePositions::F32(positions) => reconstructor.reconstruct(positions)?,
        FilePositions::F64(positions) => reconstructor.reconstruct(positions)?,
    };
    let certificate = &surface.report.certificate;
    if !certificate.holds() {
        return Err(format!("the surface failed validation: {}", certificate.violations()).into());
    }

    // Positions are absolute, in 64 bits. Files store 32 bits relative to an origin that you choose.
    let origin = DVec3::ZERO;
    let positions = surface.positions_f32(origin);
    let normals: Vec<[f32; 3]> = surface.normals.iter().map(|normal| normal.to_array()).collect();
    let mesh = MeshView {
        positions: &positions,
        normals: &normals,
        triangles: &surface.triangles,
        origin: origin.to_array(),
        attributes: &[],
    };
    let mut out = BufWriter::new(File::create(to)?);
    gltf::write_glb(&mesh, &MeshOptions::default(), &[], &mut out)?;
    Ok(out.flush()?)
}

/// Converts the sequences in a folder to meshes and level sets in another, as `meniscus convert FROM --out
/// TO` does if the folder contains nothing else. Returns the number of frames.
pub(crate) fn convert_folder(from: &Path, to: &Path) -> Result<usize, Box<dyn Error>> {
    let outputs = Arc::new(OutputOptions::new(to, &[OutputFormat::Glb, OutputFormat::Vdb]));
    let files = pipeline::files_in(from)?.into_iter().map(FrameFile::new);
    let mut frames = Vec::new();
    for sequence in pipeline::sequences(files.collect()) {
        let paths = sequence.frames.iter().map(|file| &*file.path);
        let measured = pipeline::measure_spacing(paths, &SpacingOptions::default())?;
        let settings = Arc::new(Settings::resolve(&Options::default(), Some((&measured).into()))?);
        frames.extend(sequence.frames.iter().map(|file| Frame::new(file, &settings, &outputs)));
    }
    let pool = ThreadPoolBuilder::new().build()?;
    let mut failures = Vec::new();
    pipeline::run(&frames, &PipelineOptions::new(&pool), |_, outcome| match outcome {
        Outcome::Converted(_) | Outcome::AlreadyDone { .. } => {}
        Outcome::Failed(error) => failures.push(error.to_string()),
        _ => failures.push("not converted: its file changed meanwhile".to_owned()),
    });
    if failures.is_empty() { Ok(frames.len()) } else { Err(failures.join("\n").into()) }
}
