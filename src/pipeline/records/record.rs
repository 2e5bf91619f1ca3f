//! The report of a run, as JSON.
//!
//! Structs of measurements from `crate::surface`, such as [`MeshMeasures`], are serialized as they are: the
//! names in the report are the serde names of their fields. Lengths are in world units unless the name says
//! otherwise; infinite or unknown values are null.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize, Serializer};
use serde_json::{Value, json};

use crate::surface::mesh::MeshMeasures;
use crate::surface::options::Settings;
use crate::surface::report::{
    Convergence, EditReport, ParticlesOutside, ReconstructionReport, ShapeStats, TransferReport,
};

use super::provenance::{chosen_options, level_set_pairs};
use crate::pipeline::files::atomic_write::write_atomically;
use crate::pipeline::files::json::write_json;
use crate::pipeline::files::shown::shown;
use crate::pipeline::input::frame::{Frame, FrameReport, Job, Outcome, Seconds};
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
    frames: Vec<FrameRecord>,
    summary: Summary,
}

/// The settings of a sequence.
#[derive(Clone, Debug, Serialize)]
pub struct SequenceRecord {
    sequence: String,
    /// Null without settings, and for level sets.
    spacing: Option<f64>,
    /// From 0 to 1; null if the spacing was given, or is not needed.
    spacing_confidence: Option<f64>,
    /// Null if `spacing_confidence` is null.
    spacing_measured_on: Option<String>,
    /// The median r_min of particles with radii of their own, if it was measured; else null.
    radius_median: Option<f64>,
    #[serde(flatten)]
    settings: Option<Object>,
    error: Option<String>,
}

#[derive(Clone, Debug, Serialize)]
struct FrameRecord {
    input: String,
    /// Index into the settings of this report.
    settings: usize,
    status: OutcomeStatus,
    #[serde(flatten)]
    measured: Option<MeasuredRecord>,
    error: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum OutcomeStatus {
    Converted,
    AlreadyDone,
    Failed,
    NotStarted,
}

#[derive(Clone, Debug, Serialize)]
struct MeasuredRecord {
    outputs: Vec<String>,
    notes: Vec<String>,
    /// The voxel size of a level set, from its file.
    #[serde(skip_serializing_if = "Option::is_none")]
    voxel_size: Option<f64>,
    particles: usize,
    dropped: usize,
    /// Null if all particles are balls of the same size.
    shapes: Option<ShapeStats>,
    /// Null if no edit changed the surface.
    edits: Option<EditReport>,
    /// Null without obstacles.
    obstacles: Option<ObstaclesRecord>,
    leaves: usize,
    voxels: usize,
    free_voxels: usize,
    passes: usize,
    voxel_passes: u64,
    reach_voxels: Option<u32>,
    convergence: Option<Convergence>,
    cfl_exceeded: usize,
    /// Only if attributes were requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    attributes: Option<TransferReport>,
    seconds: Seconds,
    peak_memory_bytes: Option<u64>,
    certificate: CertificateRecord,
    bending_energy: f64,
    #[serde(flatten)]
    mesh: MeshMeasures,
}

/// The obstacles, and what they changed.
#[derive(Clone, Debug, Serialize)]
struct ObstaclesRecord {
    files: String,
    open_edges: usize,
    particles_inside: usize,
    /// Voxels that were filled because the gap to an obstacle was too narrow.
    void_voxels_filled: u64,
    /// Voxels in an obstacle that are in the r_min sphere of a particle, or nearer to such a sphere than to
    /// the obstacle's surface.
    voxels_taken: u64,
    /// How deep the deepest vertex is in an obstacle; 0 if none is inside.
    deepest_vertex_voxels: f64,
    /// Vertices that were inside an obstacle, at edges that the grid cannot resolve, and were moved out.
    vertices_cleared: u64,
}

/// The checks of a frame and their results.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CertificateRecord {
    holds: bool,
    /// How far the surface was moved outward after the check of its bounds, a length; negative if inward.
    offset: f64,
    /// The required minimum and maximum distance from a vertex to the nearest particle, lengths. Null for
    /// surfaces of level sets.
    distance_limits: Option<[f64; 2]>,
    bound_violations: usize,
    /// Null for an empty mesh.
    vertex_distance_min_voxels: Option<f64>,
    /// Null if a vertex has no particle near it: its distance is infinite.
    vertex_distance_max_voxels: Option<f64>,
    vertices_inside_min: usize,
    vertices_outside_max: usize,
    /// Particles that are not finite, or are too far from the others: the surface is made from the rest.
    particles_left_out: usize,
    /// The positions that were checked.
    positions: CheckedPositions,
    particles_outside: ParticlesOutside,
    /// Whether the surface was moved inward so far that particles outside are not a violation.
    particles_may_be_outside: bool,
    /// The particles whose positions in the file are outside the surface. Null unless position smoothing
    /// moved the particles.
    given_outside: Option<ParticlesOutside>,
    /// Particles near the surface that were not checked, because they are in a dropped island, outside the
    /// clip box or within a voxel of its faces, in an obstacle, or so near to it that the
    /// rounded edge of the fluid reaches them.
    particles_exempt: usize,
    /// Vertices that were out of their bounds, and were moved back.
    vertices_returned: usize,
    /// Triangles that were removed because they have no area at the written positions.
    flat_triangles_removed: usize,
    /// Whether every edge is in two triangles, the triangles around every vertex form one ring, and every
    /// triangle has an area.
    closed_manifold: bool,
    position_rounding_voxels: f64,
}

/// Which positions of the particles a certificate describes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum CheckedPositions {
    /// Those in the file.
    Given,
    /// Those to which position smoothing moved the particles.
    Smoothed,
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
        let (status, measured, error) = match outcome {
            Outcome::Converted(report) => (OutcomeStatus::Converted, Some(measured(report)), None),
            Outcome::AlreadyDone { .. } => (OutcomeStatus::AlreadyDone, None, None),
            Outcome::Changed => (OutcomeStatus::Failed, None, Some(CHANGED.to_owned())),
            Outcome::Failed(error) => (OutcomeStatus::Failed, None, Some(error.to_string())),
            Outcome::NotStarted => (OutcomeStatus::NotStarted, None, None),
        };
        self.add(&frame.input, sequence_index, status, measured, error);
    }

    /// Adds a frame that could not be converted because it has no settings.
    pub fn add_failed(&mut self, input: &Path, sequence_index: usize, why: &str) {
        self.add(input, sequence_index, OutcomeStatus::Failed, None, Some(why.to_owned()));
    }

    /// Adds a frame that was not attempted.
    pub fn add_not_started(&mut self, input: &Path, sequence_index: usize) {
        self.add(input, sequence_index, OutcomeStatus::NotStarted, None, None);
    }

    fn add(
        &mut self,
        input: &Path,
        settings: usize,
        status: OutcomeStatus,
        measured: Option<MeasuredRecord>,
        error: Option<String>,
    ) {
        let summary = &mut self.summary;
        summary.frames += 1;
        *match status {
            OutcomeStatus::Converted => &mut summary.converted,
            OutcomeStatus::AlreadyDone => &mut summary.already_done,
            OutcomeStatus::Failed => &mut summary.failed,
            OutcomeStatus::NotStarted => &mut summary.not_started,
        } += 1;
        self.frames.push(FrameRecord { input: text(input), settings, status, measured, error });
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
    /// A sequence with its settings. `measured`: its particle spacing, with confidence and source, if it was
    /// measured. `written`: the options of its outputs, and its obstacles.
    pub fn new(
        name: &str,
        job: &Job,
        settings: &Settings,
        measured: Option<&MeasuredSpacing>,
        written: (&OutputOptions, &ObstacleFiles),
    ) -> SequenceRecord {
        if let Job::LevelSet { max_deviation_voxels, .. } = job {
            let settings = Some(settings_of_level_sets(settings, *max_deviation_voxels, written.0));
            return SequenceRecord { settings, ..SequenceRecord::named(name) };
        }
        SequenceRecord {
            spacing: Some(settings.spacing),
            spacing_confidence: measured.map(|measured| measured.confidence),
            spacing_measured_on: measured.map(|measured| text(&measured.measured_on)),
            radius_median: measured.and_then(|measured| measured.radius_median),
            settings: Some(settings_of_particles(settings, written)),
            ..SequenceRecord::named(name)
        }
    }

    /// A sequence without settings.
    pub fn without_settings(name: &str, why: &str) -> SequenceRecord {
        SequenceRecord { error: Some(why.to_owned()), ..SequenceRecord::named(name) }
    }

    fn named(name: &str) -> SequenceRecord {
        SequenceRecord {
            sequence: name.to_owned(),
            spacing: None,
            spacing_confidence: None,
            spacing_measured_on: None,
            radius_median: None,
            settings: None,
            error: None,
        }
    }
}

/// A JSON object whose keys keep this order.
#[derive(Clone, Debug)]
struct Object(Vec<(&'static str, Value)>);

impl Serialize for Object {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.collect_map(self.0.iter().map(|(key, value)| (key, value)))
    }
}

/// The settings for particles. The main ones have keys of their own, with numbers or names as values. The
/// others are in the object `more`, with text as values; those that change nothing are left out.
fn settings_of_particles(
    settings: &Settings,
    (outputs, obstacles): (&OutputOptions, &ObstacleFiles),
) -> Object {
    let mut named = vec![
        ("voxel_size", json!(settings.voxel_size)),
        ("radius_min", json!(settings.radius_min)),
        ("radius_init", json!(settings.radius_init)),
        ("radius_max", json!(settings.radius_max)),
        ("integrator", json!(settings.integrator.name())),
        ("laplacian_steps", json!(settings.laplacian_steps)),
        ("steps", json!(settings.steps)),
        ("step_size", json!(settings.step_size)),
        ("redistance_every", json!(settings.redistance_every)),
        ("cg_tolerance", json!(settings.cg_tolerance)),
        ("contour", json!(settings.contouring.name())),
    ];
    // `quads` depends on the outputs, and `void_threshold` on the obstacles, so they are added below.
    let is_other = |name: &str| name == "quads" || name == "void_threshold";
    let more = settings.pairs(|name| !is_other(name) && named.iter().all(|(named, _)| *named != name));
    let mut more: BTreeMap<&str, String> = more.into_iter().collect();
    if !obstacles.is_empty() {
        more.insert("void_threshold", settings.void_threshold.to_string());
    }
    more.extend(chosen_options(outputs, settings));
    named.extend([("more", json!(more)), ("warnings", json!(settings.warnings()))]);
    Object(named)
}

/// The settings that all level sets of a sequence share. The voxel size is not among them: each file has its
/// own.
fn settings_of_level_sets(settings: &Settings, max_deviation_voxels: f64, outputs: &OutputOptions) -> Object {
    let pairs = level_set_pairs(settings, max_deviation_voxels, OutputFormat::Glb);
    let is_shared = |(name, _): &(&str, String)| !["max_deviation", "voxel_size"].contains(name);
    let mut more: BTreeMap<_, _> = pairs.into_iter().filter(is_shared).collect();
    more.extend(chosen_options(outputs, settings));
    Object(vec![("max_deviation", json!(max_deviation_voxels)), ("more", json!(more))])
}

/// The measurements of a frame, as in an entry of the report.
pub(crate) fn measured_json(report: &FrameReport) -> serde_json::Value {
    // Plain structs of numbers and text can always be serialized.
    serde_json::to_value(measured(report)).unwrap_or_default()
}

fn measured(report: &FrameReport) -> MeasuredRecord {
    let ReconstructionReport { mesh, smoothing, .. } = &report.reconstruction;
    MeasuredRecord {
        outputs: report.outputs.iter().map(|path| text(path)).collect(),
        notes: report.warnings.iter().map(ToString::to_string).collect(),
        voxel_size: report.voxel_size,
        particles: report.reconstruction.particle_count,
        dropped: report.reconstruction.dropped_count,
        shapes: Some(report.reconstruction.shapes)
            .filter(|shape_stats| *shape_stats != ShapeStats::default()),
        edits: Some(report.reconstruction.edits).filter(|edits| *edits != EditReport::default()),
        obstacles: obstacles_record(report),
        leaves: report.reconstruction.leaf_count,
        voxels: report.reconstruction.leaf_count * crate::surface::grid::LEAF_VOXELS,
        free_voxels: smoothing.free_voxel_count,
        passes: smoothing.pass_count,
        voxel_passes: smoothing.voxel_update_count,
        reach_voxels: smoothing.reach_voxels,
        convergence: smoothing.convergence,
        cfl_exceeded: smoothing.cfl_exceeded_count,
        attributes: report.reconstruction.transfer.clone(),
        seconds: report.seconds,
        peak_memory_bytes: report.peak_memory_bytes,
        certificate: certificate_record(&report.reconstruction),
        bending_energy: report.reconstruction.bending_energy,
        mesh: *mesh,
    }
}

fn obstacles_record(report: &FrameReport) -> Option<ObstaclesRecord> {
    let ReconstructionReport { contact, depth, .. } = &report.reconstruction;
    (!report.obstacles.is_empty()).then(|| ObstaclesRecord {
        files: report.obstacles.clone(),
        open_edges: report.obstacle_open_edge_count,
        particles_inside: contact.particle_count,
        void_voxels_filled: contact.void_count,
        voxels_taken: contact.displaced_voxel_count,
        deepest_vertex_voxels: depth.deepest_voxels,
        vertices_cleared: depth.moved_count,
    })
}

fn certificate_record(report: &ReconstructionReport) -> CertificateRecord {
    let certificate = &report.certificate;
    CertificateRecord {
        holds: certificate.holds(),
        offset: certificate.offset,
        distance_limits: certificate.distance_limits,
        bound_violations: certificate.bound_violation_count,
        vertex_distance_min_voxels: Some(certificate.vertex_distance_min).filter(|least| least.is_finite()),
        vertex_distance_max_voxels: Some(certificate.vertex_distance_max)
            .filter(|largest| largest.is_finite()),
        vertices_inside_min: certificate.vertices_inside_min,
        vertices_outside_max: certificate.vertices_outside_max,
        particles_left_out: certificate.particles_left_out,
        positions: match certificate.input_positions_outside {
            None => CheckedPositions::Given,
            Some(_) => CheckedPositions::Smoothed,
        },
        particles_outside: certificate.particles_outside,
        particles_may_be_outside: certificate.may_leave_particles_outside,
        given_outside: certificate.input_positions_outside,
        particles_exempt: certificate.particles_exempt,
        vertices_returned: report.vertices_clamped,
        flat_triangles_removed: report.flat_triangles_removed,
        closed_manifold: certificate.mesh_is_closed_manifold,
        position_rounding_voxels: certificate.position_rounding,
    }
}

fn text(path: &Path) -> String {
    shown(path).to_string()
}
