//! Writes scores as CSV.

use std::io::{Result, Write};

use crate::surface::flicker::Distribution;

use super::totals::{ScoredFrame, WorstPoint};

/// Writes a row for each frame. Lengths are in particle spacings, and positions in world units. The scores of
/// a frame are empty if none of its points can be tracked to both neighbouring frames.
pub(super) fn write_frames(frames: &[ScoredFrame], out: &mut dyn Write) -> Result<()> {
    writeln!(out, "frame,points,untracked,clamped,rms,median,p99,max,max_x,max_y,max_z")?;
    for frame in frames {
        let ScoredFrame { number, summary, untracked_count, clamped_count, worst, .. } = frame;
        let Distribution { count, rms, median, percentile_99, max } = summary;
        write!(out, "{number},{count},{untracked_count},{clamped_count}")?;
        match worst {
            Some(worst) => {
                let [x, y, z] = worst.position.to_array();
                writeln!(out, ",{rms},{median},{percentile_99},{max},{x},{y},{z}")?;
            }
            None => writeln!(out, ",,,,,,,")?,
        }
    }
    Ok(())
}

/// Writes a row for each point, the worst first.
pub(super) fn write_points(points: &[WorstPoint], out: &mut dyn Write) -> Result<()> {
    writeln!(out, "frame,x,y,z,flicker")?;
    for WorstPoint { frame, position: [x, y, z], value } in points {
        writeln!(out, "{frame},{x},{y},{z},{value}")?;
    }
    Ok(())
}
