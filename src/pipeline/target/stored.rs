//! How files round the positions of a mesh: the certificate is about these.

use std::sync::Arc;

use meniscus_formats::{Content, OutputFormat, PositionRounding};

use crate::surface::skin::Stored;

use super::outputs::OutputOptions;

/// How a format rounds positions, if it does.
pub(crate) fn rounding(format: OutputFormat, outputs: &OutputOptions) -> Option<&'static PositionRounding> {
    (format.mesh()?.rounding)(&outputs.mesh(Arc::default()))
}

/// How the files that are written store the mesh, each way once. Where no file has it, it is checked as it is.
pub(crate) fn stored(outputs: &OutputOptions) -> Vec<Stored> {
    let mut stored = Vec::new();
    let mut is_rounded_always = true;
    for format in OutputFormat::ALL.into_iter().filter(|format| outputs.formats.contains(format)) {
        match rounding(format, outputs) {
            Some(rounding) => stored.push(Stored::Rounded(rounding.positions)),
            None => is_rounded_always &= !format.is_mesh(),
        }
    }
    if stored.is_empty() || !is_rounded_always {
        stored.push(Stored::AsTheyAre);
    }
    stored
}

/// What of a file was checked, as its certificate says it.
pub(crate) fn checked_as(format: OutputFormat, outputs: &OutputOptions) -> &'static str {
    match format.content() {
        Content::LevelSet if outputs.vdb_half => "level set, before its values are rounded to 16 bits",
        Content::LevelSet => "level set",
        Content::Picture(_) => "level set, of which it is a picture",
        Content::Mesh(_) => rounding(format, outputs)
            .map_or("mesh, at its positions relative to its origin", |rounding| rounding.certified_as),
    }
}
