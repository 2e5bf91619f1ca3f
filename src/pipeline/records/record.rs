//! The report of a run, as JSON.
//!
//! docs/report.md explains the fields. Structs of measurements from `crate::surface` are serialized as they
//! are: the names in the report are the serde names of their fields. Lengths are in world units unless the
//! name says otherwise; infinite or unknown values are null.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Serialize, Serializer};
use serde_json::{Value, json};

use crate::surface::grid::LEAF_VOXELS;
use crate::surface::options::{MethodOptions, Settings, Start};
use crate::surface::report::{EditReport, ReconstructionReport, ShapeStats, TemporalReport};

use super::provenance::{chosen_options, level_set_pairs};
use crate::pipeline::files::atomic_write::write_atomically;
use crate::pipeline::files::json::write_json;
use crate::pipeline::files::shown::shown;
use crate::pipeline::input::frame::{Frame, FrameReport, Job, Outcome};
use crate::pipeline::input::measured_spacing::MeasuredSpacing;
use crate::pipeline::input::obstacles::ObstacleFiles;
use crate::pipeline::target::outputs::{OutputFormat, OutputOptions};

/// Reported for a frame whose file changed while it was read.
const CHANGED: &str = "the file was written while it was read";

/// The contents of the report.
#[derive(Clone, Debug, Serialize)]
pub struct RunRecord {
    version: &'static str,
    settings: Vec<SequenceRecord>,
    frames: Vec<Object>,
    summary: Summary,
}

/// The settings of a sequence.
#[derive(Clone, Debug, Serialize)]
#[serde(transparent)]
pub struct SequenceRecord(Object);

/// A JSON object whose keys keep this order.
#[derive(Clone, Debug, Default)]
struct Object(Vec<(String, Value)>);

impl Object {
    fn new<const N: usize>(entries: [(&str, Value); N]) -> Object {
        let mut object = Object::default();
        object.extend(entries);
        object
    }

    fn extend<'a>(&mut self, entries: impl IntoIterator<Item = (&'a str, Value)>) {
        self.0.extend(entries.into_iter().map(|(key, value)| (key.to_owned(), value)));
    }
}

impl Serialize for Object {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.collect_map(self.0.iter().map(|(key, value)| (key, value)))
    }
}

#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Summary {
    frames: usize,
    converted: usize,
    already_done: usize,
    failed: usize,
    not_started: usize,
    threads: usize,
    seconds: f64,
}

impl RunRecord {
    /// An empty report for a run.
    pub fn new(thread_count: usize) -> RunRecord {
        RunRecord {
            version: env!("CARGO_PKG_VERSION"),
            settings: Vec::new(),
            frames: Vec::new(),
            summary: Summary { threads: thread_count, ..Summary::default() },
        }
    }

    /// Adds a sequence; frames refer to it by the returned index.
    pub fn add_sequence(&mut self, sequence: SequenceRecord) -> usize {
        self.settings.push(sequence);
        self.settings.len() - 1
    }

    /// Adds a frame that went through the pipeline. Frames are reported in the order they are added.
    pub fn add_frame(&mut self, frame: &Frame, sequence_index: usize, outcome: &Outcome) {
        match outcome {
            Outcome::Converted(report) => {
                self.summary.converted += 1;
                self.add(&frame.input, sequence_index, "converted", measured(report), None);
            }
            Outcome::AlreadyDone { .. } => {
                self.summary.already_done += 1;
                self.add(&frame.input, sequence_index, "already_done", Object::default(), None);
            }
            Outcome::Changed => self.add_failed(&frame.input, sequence_index, CHANGED),
            Outcome::Failed(error) => self.add_failed(&frame.input, sequence_index, &error.to_string()),
            Outcome::NotStarted => self.add_not_started(&frame.input, sequence_index),
        }
    }

    /// Adds a frame that could not be converted.
    pub fn add_failed(&mut self, input: &Path, sequence_index: usize, why: &str) {
        self.summary.failed += 1;
        self.add(input, sequence_index, "failed", Object::default(), Some(why));
    }

    /// Adds a frame that was not attempted.
    pub fn add_not_started(&mut self, input: &Path, sequence_index: usize) {
        self.summary.not_started += 1;
        self.add(input, sequence_index, "not_started", Object::default(), None);
    }

    fn add(
        &mut self,
        input: &Path,
        sequence_index: usize,
        status: &str,
        measured: Object,
        error: Option<&str>,
    ) {
        self.summary.frames += 1;
        let mut frame = Object::new([
            ("input", json!(text(input))),
            ("settings", json!(sequence_index)),
            ("status", json!(status)),
        ]);
        frame.0.extend(measured.0);
        frame.extend([("error", json!(error))]);
        self.frames.push(frame);
    }

    /// Writes the report atomically.
    ///
    /// # Errors
    /// When the system reports an error.
    pub fn write(mut self, path: &Path, seconds: f64) -> meniscus_formats::Result<()> {
        self.summary.seconds = seconds;
        write_atomically(path, |out| Ok(write_json(out, &self)?))
    }
}

impl SequenceRecord {
    /// A sequence with its settings, the options that they follow from, and the measurements of its particles
    /// if there are any. `written`: the options of its outputs, and its obstacles.
    pub fn new(
        name: &str,
        job: &Job,
        settings: &Settings,
        (choices, measured): (&MethodOptions, Option<&MeasuredSpacing>),
        (outputs, obstacles): (&OutputOptions, &ObstacleFiles),
    ) -> SequenceRecord {
        if let Job::LevelSet { max_deviation_voxels, .. } = job {
            let settings = settings_of_level_sets(settings, *max_deviation_voxels, outputs);
            return SequenceRecord::with_source(name, None, settings, None);
        }
        let source = SettingsSource { choices, measured, settings };
        let settings = settings_of_particles(settings, outputs, obstacles);
        SequenceRecord::with_source(name, Some(&source), settings, None)
    }

    /// A sequence without settings.
    pub fn without_settings(name: &str, why: &str) -> SequenceRecord {
        SequenceRecord::with_source(name, None, Object::default(), Some(why))
    }

    fn with_source(
        name: &str,
        source: Option<&SettingsSource<'_>>,
        settings: Object,
        error: Option<&str>,
    ) -> SequenceRecord {
        let measured = source.and_then(|source| source.measured);
        // With a given spacing, particles are measured only to choose a preset.
        let used = measured.filter(|_| source.is_some_and(|source| source.choices.spacing.is_none()));
        let mut record = Object::new([
            ("sequence", json!(name)),
            ("preset", json!(source.map(|source| source.settings.preset))),
            ("preset_given", json!(source.and_then(|source| source.choices.preset))),
            ("spacing", json!(source.map(|source| source.settings.spacing))),
            ("spacing_confidence", json!(used.map(|measured| measured.confidence))),
            ("measured_on", json!(measured.map(|measured| text(&measured.measured_on)))),
            ("irregularity", json!(measured.and_then(|measured| measured.irregularity))),
            ("radius_median", json!(used.and_then(|measured| measured.radius_median))),
        ]);
        record.0.extend(settings.0);
        record.extend([("error", json!(error))]);
        SequenceRecord(record)
    }
}

/// What the settings of a sequence of particles follow from.
struct SettingsSource<'a> {
    choices: &'a MethodOptions,
    measured: Option<&'a MeasuredSpacing>,
    settings: &'a Settings,
}

/// The settings for particles. The main ones have keys of their own, with numbers or names as values. The
/// others are in the object `more`, with text as values; those that change nothing are left out.
fn settings_of_particles(settings: &Settings, outputs: &OutputOptions, obstacles: &ObstacleFiles) -> Object {
    let mut named = Object::new([("voxel_size", json!(settings.voxel_size))]);
    match settings.start {
        Start::Spheres => named.extend([
            ("radius_min", json!(settings.radius_min)),
            ("radius_init", json!(settings.radius_init)),
            ("radius_max", json!(settings.radius_max)),
        ]),
        Start::Kernels => named.extend([("blend", json!(settings.radius_max))]),
    }
    named.extend([
        ("integrator", json!(settings.smoothing.integrator.name())),
        ("laplacian_steps", json!(settings.smoothing.laplacian_steps)),
        ("steps", json!(settings.smoothing.steps)),
        ("step_size", json!(settings.smoothing.step_size)),
        ("redistance_every", json!(settings.smoothing.redistance_every)),
        ("contour", json!(settings.contouring.name())),
    ]);
    // `quads` depends on the outputs, and `void_threshold` on the obstacles, so they are added below. The
    // spacing has a key of its own.
    let is_other = |name: &str| ["quads", "void_threshold", "spacing"].contains(&name);
    let more = settings.pairs(|name| !is_other(name) && named.0.iter().all(|(named, _)| *named != name));
    let mut more: BTreeMap<&str, String> = more.into_iter().collect();
    if !obstacles.is_empty() {
        more.insert("void_threshold", settings.void_threshold.to_string());
    }
    more.extend(chosen_options(outputs, settings));
    named.extend([("more", json!(more)), ("warnings", json!(settings.warnings()))]);
    named
}

/// The settings that all level sets of a sequence share. The voxel size is not among them: each file has its
/// own.
fn settings_of_level_sets(settings: &Settings, max_deviation_voxels: f64, outputs: &OutputOptions) -> Object {
    let pairs = level_set_pairs(settings, max_deviation_voxels, OutputFormat::Glb);
    let is_shared = |(name, _): &(&str, String)| !["max_deviation", "voxel_size"].contains(name);
    let mut more: BTreeMap<_, _> = pairs.into_iter().filter(is_shared).collect();
    more.extend(chosen_options(outputs, settings));
    Object::new([("max_deviation", json!(max_deviation_voxels)), ("more", json!(more))])
}

/// The measurements of a frame, as in an entry of the report.
pub(crate) fn measured_json(report: &FrameReport) -> Value {
    measured(report).0.into_iter().collect()
}

fn measured(report: &FrameReport) -> Object {
    let ReconstructionReport { shapes, edits, contact, depth, mesh, smoothing, temporal, .. } =
        &report.reconstruction;
    let reconstruction = &report.reconstruction;
    let obstacles = (!report.obstacles.is_empty()).then(|| {
        json!({
            "files": report.obstacles,
            "open_edges": report.obstacle_open_edge_count,
            "particles_inside": contact.particle_count,
            "void_voxels_filled": contact.void_count,
            "voxels_taken": contact.displaced_voxel_count,
            "deepest_vertex_voxels": depth.deepest_voxels,
            "vertices_cleared": depth.moved_count,
        })
    });
    let notes: Vec<String> = report.warnings.iter().map(ToString::to_string).collect();
    let mut measured = Object::new([
        ("outputs", report.outputs.iter().map(|path| text(path)).collect()),
        ("notes", json!(notes)),
    ]);
    measured.extend(report.voxel_size.map(|voxel_size| ("voxel_size", json!(voxel_size))));
    measured.extend([
        ("particles", json!(reconstruction.particle_count)),
        ("dropped", json!(reconstruction.dropped_count)),
        ("shapes", json!((*shapes != ShapeStats::default()).then_some(shapes))),
        ("edits", json!((*edits != EditReport::default()).then_some(edits))),
        ("obstacles", json!(obstacles)),
        ("leaves", json!(reconstruction.leaf_count)),
        ("voxels", json!(reconstruction.leaf_count * LEAF_VOXELS)),
        ("free_voxels", json!(smoothing.free_voxel_count)),
        ("passes", json!(smoothing.pass_count)),
        ("voxel_passes", json!(smoothing.voxel_update_count)),
        ("reach_voxels", json!(smoothing.reach_voxels)),
        ("convergence", json!(smoothing.convergence)),
        ("cfl_exceeded", json!(smoothing.cfl_exceeded_count)),
        ("temporal", json!((*temporal != TemporalReport::default()).then_some(temporal))),
    ]);
    measured.extend(reconstruction.spray.iter().map(|spray| ("spray", json!(spray))));
    measured.extend(reconstruction.transfer.iter().map(|transfer| ("attributes", json!(transfer))));
    measured.extend([
        ("seconds", json!(report.seconds)),
        ("peak_memory_bytes", json!(report.peak_memory_bytes)),
        ("certificate", certificate(reconstruction)),
    ]);
    if let Value::Object(mesh) = json!(mesh) {
        measured.0.extend(mesh);
    }
    measured
}

/// The checks of a frame and their results.
pub(crate) fn certificate(report: &ReconstructionReport) -> Value {
    let certificate = &report.certificate;
    let is_smoothed = certificate.input_positions_outside.is_some();
    json!({
        "holds": certificate.holds(),
        "offset": certificate.offset,
        "distance_limits": certificate.distance_limits,
        "bound_violations": certificate.bound_violation_count,
        "vertex_distance_min_voxels": certificate.vertex_distance_min,
        "vertex_distance_max_voxels": certificate.vertex_distance_max,
        "vertices_inside_min": certificate.vertices_inside_min,
        "vertices_outside_max": certificate.vertices_outside_max,
        "particles_left_out": certificate.particles_left_out,
        "positions": if is_smoothed { "smoothed" } else { "given" },
        "particles_outside": certificate.particles_outside,
        "particles_may_be_outside": certificate.may_leave_particles_outside,
        "given_outside": certificate.input_positions_outside,
        "particles_exempt": certificate.particles_exempt,
        "vertices_returned": report.vertices_clamped,
        "flat_triangles_removed": report.flat_triangles_removed,
        "closed_manifold": certificate.mesh_is_closed_manifold,
        "position_rounding_voxels": certificate.position_rounding,
    })
}

fn text(path: &Path) -> String {
    shown(path).to_string()
}
