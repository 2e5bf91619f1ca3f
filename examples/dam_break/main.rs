//! A dam break of 3 072 particles: the small sequence in `examples/frames`.
//!
//! ```text
//! cargo run --release --example dam_break -- examples/frames 8
//! ```
//!
//! Each frame is a classic BGEO with velocity, as SPlisHSPlasH and partio write them.

mod water;

use std::error::Error;
use std::path::Path;

use meniscus_formats::{Attribute, ParticleFrame, Positions, Role, Values, bgeo};

use water::Water;

const STEPS_PER_FRAME: usize = 15;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.as_slice() {
        [cache, count] => simulate(Path::new(cache), count.parse()?),
        _ => Err("usage: dam_break FOLDER FRAMES".into()),
    }
}

fn simulate(cache: &Path, frame_count: usize) -> Result<(), Box<dyn Error>> {
    std::fs::create_dir_all(cache)?;
    let mut water = Water::block();
    for frame in 1..=frame_count {
        write_frame(&water, &cache.join(format!("dam.{frame:04}.bgeo")))?;
        for _ in 0..STEPS_PER_FRAME {
            water.step();
        }
    }
    Ok(())
}

/// Writes under another name and renames: whoever watches the folder sees whole frames only.
fn write_frame(water: &Water, path: &Path) -> Result<(), Box<dyn Error>> {
    let velocity = Attribute {
        name: "v".into(),
        arity: 3,
        role: Some(Role::Velocity),
        values: Values::F32(water.velocities.iter().flat_map(|velocity| velocity.to_array()).collect()),
    };
    let frame = ParticleFrame {
        positions: Positions::F32(water.positions.iter().map(|position| position.to_array()).collect()),
        attributes: vec![velocity],
        ..ParticleFrame::default()
    };
    let unfinished = path.with_extension("unfinished");
    let mut file = std::io::BufWriter::new(std::fs::File::create(&unfinished)?);
    bgeo::write(&frame, &mut file)?;
    file.into_inner()?.sync_all()?;
    std::fs::rename(&unfinished, path)?;
    Ok(())
}
