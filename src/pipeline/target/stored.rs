//! The position rounding of file formats: certificates describe the rounded positions.

use std::sync::Arc;

use meniscus_formats::{OutputFormat, PositionRounding};

use crate::surface::reconstruction::PositionFormat;

use super::outputs::OutputOptions;

/// The rounding of a format, if it rounds positions.
pub(crate) fn rounding(format: OutputFormat, outputs: &OutputOptions) -> Option<&'static PositionRounding> {
    (format.mesh()?.rounding)(&outputs.mesh(Arc::default()))
}

/// The forms of the positions that are checked: rounded as in each output format that rounds, and exact if a
/// mesh format does not round. If no output contains the mesh, it is checked with exact positions.
pub(crate) fn stored(outputs: &OutputOptions) -> Vec<PositionFormat> {
    let mut stored = Vec::new();
    let mut is_rounded_always = true;
    for format in OutputFormat::ALL.into_iter().filter(|format| outputs.formats.contains(format)) {
        match rounding(format, outputs) {
            Some(rounding) => stored.push(PositionFormat::Rounded(rounding.positions)),
            None => is_rounded_always &= !format.is_mesh(),
        }
    }
    if stored.is_empty() || !is_rounded_always {
        stored.push(PositionFormat::Exact);
    }
    stored
}
