//! meniscus from another program: one frame to a mesh in ten lines, and a folder to a folder in twenty.
//!
//! ```text
//! cargo run --release -p library -- examples/frames/dam.0001.bgeo out/dam.0001.glb
//! cargo run --release -p library -- examples/frames out/library
//! ```
//!
//! Another crate needs `meniscus` and `meniscus-formats` for the first, and `rayon`, whose threads do the computing, for
//! the second.

use std::error::Error;
use std::fs;
use std::io::Write;
use std::path::Path;
use std::sync::Arc;

use meniscus::pipeline::{
    self, Conduct, Frame, FrameFile, LevelSetSkinning, Outcome, OutputFormat, OutputOptions,
};
use meniscus::surface::options::{Choices, Settings};
use meniscus::surface::skin::skin;
use meniscus::surface::spacing::{estimate_spacing, rounded};
use meniscus_formats::{Limits, MeshOptions, gltf, read_particles};
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
        return skin_file(from, to);
    }
    let done_count = skin_folder(from, to)?;
    writeln!(std::io::stdout(), "{done_count} frames are in {}", to.display())?;
    Ok(())
}

/// A file of particles, in any format that is read, becomes a mesh in a .glb.
pub(crate) fn skin_file(from: &Path, to: &Path) -> Result<(), Box<dyn Error>> {
    let name = from.file_name().unwrap_or_default().to_string_lossy();
    let frame = read_particles(&fs::read(from)?, &name, &Limits::default())?;
    let particles = pipeline::particles(frame.positions);
    let spacing = estimate_spacing(&particles).ok_or("a particle alone has no spacing")?.spacing;
    let settings = Settings::resolve(&Choices::default(), Some(rounded(spacing).into()))?;
    let surface = skin(&particles, &settings);
    let mesh = pipeline::mesh_view(&surface.mesh, &[]);
    let options = MeshOptions::default();
    Ok(pipeline::write_whole(to, |out| gltf::write_glb(&mesh, &options, &[], out))?)
}

/// The sequences in a folder become meshes and level sets in another, as `meniscus convert FROM --out TO` makes them
/// where there is nothing else among them. Returns the number of frames.
pub(crate) fn skin_folder(from: &Path, to: &Path) -> Result<usize, Box<dyn Error>> {
    let outputs = Arc::new(OutputOptions::new(to, &[OutputFormat::Glb, OutputFormat::Vdb]));
    let files = pipeline::files_in(from)?.into_iter().map(FrameFile::new);
    let mut frames = Vec::new();
    for sequence in pipeline::sequences(files.collect()) {
        let paths = sequence.frames.iter().map(|file| &*file.path);
        let measured = pipeline::measure_spacing(paths, None)?;
        let settings = Arc::new(Settings::resolve(&Choices::default(), Some((&measured).into()))?);
        frames.extend(sequence.frames.iter().map(|file| Frame::new(file, &settings, &outputs)));
    }
    let pool = ThreadPoolBuilder::new().build()?;
    let mut failures = Vec::new();
    pipeline::run(&LevelSetSkinning, &frames, &Conduct::new(&pool), |_, outcome| {
        if let Outcome::Failed(error) = outcome {
            failures.push(error.to_string());
        }
    });
    if failures.is_empty() { Ok(frames.len()) } else { Err(failures.join("\n").into()) }
}
