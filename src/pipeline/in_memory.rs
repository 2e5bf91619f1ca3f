//! Files and reports for surfaces that another program reconstructs in memory, such as the Python package.
//!
//! The files have the same bytes as those of `meniscus convert` if the options, the particles and the source
//! file of the particles are the same. Only those of `meniscus convert` name the frames around a surface that is
//! averaged with them.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use meniscus_formats::{Content, FileAttribute, OutputFormat};

use crate::surface::mesh::PositionRounding;
use crate::surface::obstacle::Obstacle;
use crate::surface::options::{MethodOptions, OptionName, Settings};
use crate::surface::particles::{Attribute, Positions};
use crate::surface::reconstruction::FrameSurface;
use crate::surface::space::Lattice;
use crate::surface::{RequestedParts, checkpoint};

use super::error::ObstacleError;
use super::files::atomic_write::write_atomically;
use super::input::attributes::AttributeRequest;
use super::input::frame::{Frame, FrameReport, Job};
use super::input::obstacle_file::findings_of;
use super::input::obstacles::{ObstacleFiles, ObstacleStamps};
use super::input::out_of_reach::out_of_reach;
use super::input::source::FrameFile;
use super::output::writing::{
    attribute_half_width_voxels, encode_levels, encode_picture_of, mesh_view, output_warnings,
    surface_warnings, vertex_attributes,
};
use super::records::frame_warnings::{coarse_positions, left_out};
use super::records::provenance::{MadeFrom, provenance};
use super::records::record::measured_json;
use super::target::outputs::OutputOptions;
use super::target::picture::PictureScene;
use super::warning::Warning;

/// A surface in memory, with the settings and obstacles that its files record.
#[derive(Clone, Copy, Debug)]
pub struct EmbeddedSurface<'a> {
    /// The surface.
    pub surface: &'a FrameSurface,
    /// The settings that it was reconstructed with.
    pub settings: &'a Arc<Settings>,
    /// The names and hashes of its obstacles, as [`InMemoryObstacle`] has them, joined by commas.
    pub obstacles: &'a str,
}

impl EmbeddedSurface<'_> {
    /// Writes the file at `path` atomically. `source` is the source file of the particles and its XXH3 hash;
    /// if it is `None`, the output does not name its input.
    ///
    /// # Errors
    /// If the format cannot hold this amount of data, or the file cannot be written.
    pub fn write(
        &self,
        path: &Path,
        format: OutputFormat,
        outputs: &Arc<OutputOptions>,
        source: Option<(PathBuf, u128)>,
    ) -> meniscus_formats::Result<()> {
        let (surface, settings) = (self.surface, self.settings);
        let is_known = source.is_some();
        let (input, hash) = source.unwrap_or_default();
        let frame = Frame { job: Job::Surface, ..Frame::new(&FrameFile::new(input), settings, outputs) };
        let made_from = MadeFrom { input_hash: hash, obstacles: self.obstacles, around: &[] };
        let mut provenance = provenance(&frame, made_from, format);
        provenance.retain(|(name, _)| is_known || !["input", "input_hash"].contains(&&**name));
        write_atomically(path, |out| {
            let out = &mut Interruptible(out);
            match format.content() {
                Content::Mesh(writer) => {
                    let quads = if settings.quads { surface.mesh.quads().into() } else { Arc::default() };
                    let attributes = vertex_attributes(&surface.attributes.vertices);
                    writer.write(
                        &mesh_view(&surface.mesh, &attributes),
                        &outputs.mesh(quads),
                        &provenance,
                        out,
                    )
                }
                Content::LevelSet => encode_levels(surface, settings, outputs, &provenance)?.write(out),
                Content::Picture(_) => Ok(out.write_all(&self.picture(format, outputs, &provenance)?)?),
            }
        })
    }

    /// Whether the mesh has positions that a file in this format can store.
    pub fn is_checked(&self, format: OutputFormat) -> bool {
        !format.lacks_origin() || self.surface.mesh.is_rounded(PositionRounding::World)
    }

    /// Renders a picture with the size and the camera of `outputs`, and encodes it.
    ///
    /// # Errors
    /// If the format is not a picture format.
    pub fn picture(
        &self,
        format: OutputFormat,
        outputs: &OutputOptions,
        provenance: &[(String, String)],
    ) -> meniscus_formats::Result<Vec<u8>> {
        encode_picture_of(self.surface, self.settings, outputs, DVec3::ZERO, format, provenance)
    }

    /// The lower and upper corner of a box around the surface, world units; `None` if the surface is empty.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        let lattice = Lattice { voxel_size: self.settings.voxel_size };
        let (band, spray) = (&self.surface.band, self.surface.spray.as_ref());
        PictureScene { band, lattice, origin: DVec3::ZERO, velocity: None, spray }.bounds()
    }

    /// The measurements as JSON, like an entry of `frames` in a report, but without files, times and memory.
    pub fn report_json(&self) -> String {
        let report = FrameReport {
            reconstruction: self.surface.report.clone(),
            obstacles: self.obstacles.to_owned(),
            ..FrameReport::default()
        };
        let mut measured = measured_json(&report);
        if let Some(entries) = measured.as_object_mut() {
            for about_files in ["outputs", "notes", "seconds", "peak_memory_bytes"] {
                entries.remove(about_files);
            }
        }
        measured.to_string()
    }

    /// The warnings about the surface, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let outputs = OutputOptions::new("", &[]);
        let about_surface = surface_warnings(self.surface, &outputs, self.settings);
        let report = &self.surface.report;
        let mut formats = OutputFormat::ALL.into_iter().filter(|format| format.lacks_origin());
        let format = formats.find(|&format| self.is_checked(format));
        let warnings =
            about_surface.into_iter().chain(left_out(report)).chain(coarse_positions(report, format));
        warnings.map(|warning| warning.sentence).collect()
    }

    /// The warnings about what a file in this format cannot store exactly, one sentence each.
    pub fn output_warnings(&self, outputs: &OutputOptions) -> Vec<String> {
        let warnings = output_warnings(self.surface, outputs);
        warnings.iter().map(ToString::to_string).collect()
    }
}

/// Checks for an interruption before each write.
struct Interruptible<'a, W>(&'a mut W);

impl<W: Write> Write for Interruptible<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        checkpoint();
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

/// The parts that a reconstruction has to prepare for files in these formats.
pub fn requested_parts(formats: &[OutputFormat]) -> RequestedParts {
    RequestedParts {
        rounding: OutputOptions::new("", formats).position_rounding(),
        band_half_width_voxels: attribute_half_width_voxels(formats),
        allows_empty: true,
    }
}

/// The attributes that these options need, with warnings. `headers` are attributes without their values, and
/// `load` returns the attribute with this index: it is called only for those that are needed. Errors name
/// options in this spelling.
///
/// # Errors
/// If a required attribute is missing or unusable.
pub fn in_memory_attributes(
    headers: Vec<FileAttribute>,
    load: impl FnMut(usize) -> Option<FileAttribute>,
    options: &MethodOptions,
    spelled: fn(OptionName) -> String,
) -> Result<(Vec<Attribute>, Vec<String>), String> {
    // The needed attributes depend only on the options that are copied here. The spacing may not be known
    // yet, and any value will do.
    let options = MethodOptions {
        spacing: Some(1.0),
        r#where: options.r#where.clone(),
        radius_attribute: options.radius_attribute.clone(),
        radius_scale: options.radius_scale,
        anisotropy: Some(options.anisotropy_kind()),
        attributes: options.attributes.clone(),
        temporal: options.temporal,
        spray: options.spray,
        ..MethodOptions::default()
    };
    let settings = Settings::resolve(&options, None).map_err(|error| error.message(spelled))?;
    let (attributes, warnings) =
        AttributeRequest::for_settings(&settings).select_with(headers, load, spelled)?;
    Ok((attributes, warnings.into_iter().map(|warning| warning.sentence).collect()))
}

/// A static obstacle from a file.
pub struct InMemoryObstacle {
    /// The obstacle.
    pub obstacle: Arc<Obstacle>,
    /// Its name and hash, as the text that outputs record.
    pub recorded: String,
    files: ObstacleFiles,
    stamps: ObstacleStamps,
}

impl InMemoryObstacle {
    /// Loads an obstacle. `memory_bytes` limits the memory for loading a level set.
    ///
    /// # Errors
    /// If the file cannot be read, or contains no obstacle.
    pub fn load(path: &Path, memory_bytes: u64) -> Result<InMemoryObstacle, ObstacleError> {
        let files = ObstacleFiles::new(vec![path.to_owned()]);
        // Before the file is read: a later change is then noticed.
        let stamps = files.stamps(None);
        let found = files.find(None)?;
        let recorded = found.recorded();
        let missing = || ObstacleError { path: path.to_owned(), source: None };
        // Only warnings depend on the settings, and they are computed for each frame.
        let options = MethodOptions { spacing: Some(1.0), ..MethodOptions::default() };
        let settings = Settings::resolve(&options, None).map_err(|_| missing())?;
        let mut members = files.load(found, &settings, memory_bytes)?.obstacles.members;
        let obstacle = members.pop().ok_or_else(missing)?;
        Ok(InMemoryObstacle { obstacle, recorded, files, stamps })
    }

    /// Whether its files are as they were when it was loaded.
    pub fn is_current(&self) -> bool {
        self.files.stamps(None) == self.stamps
    }
}

/// The likely mistakes in obstacles and in their positions, one sentence each. Each obstacle has a name,
/// which identifies it.
pub fn obstacle_warnings(
    obstacles: &[(&Path, &Obstacle)],
    particles: &Positions<'_>,
    settings: &Settings,
) -> Vec<String> {
    let mut warnings = Vec::new();
    for (name, obstacle) in obstacles {
        let findings = findings_of(obstacle.sdf(), settings);
        warnings.extend(findings.iter().map(|finding| Warning::of_obstacle(name, finding)));
    }
    let Ok(out_of_reach) = out_of_reach(obstacles.iter().copied(), particles, settings);
    warnings.extend(out_of_reach);
    warnings.into_iter().map(|warning| warning.sentence).collect()
}
