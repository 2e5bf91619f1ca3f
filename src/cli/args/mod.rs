//! The parsed command line, command by command. Only the command-line layer uses these types.
//!
//! The structs that a configuration file shares have no defaults here: a default on the command line would look
//! like a given option, and override the file; a default in the file would override the preset.
//!
//! Options for numbers accept a leading minus sign, so that the range check reports `-1` as out of range, and
//! clap does not report it as an unknown option.

mod after_help;
mod option_set;
mod short_help;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Result, bail};
use clap::builder::TypedValueParser;
use clap::{Args, Parser, Subcommand, ValueEnum};
use clap_complete::Shell;
use meniscus_formats::{PointFormat, UpAxis, vdb};

use crate::pipeline::{CameraChoice, METERS_PER_UNIT, OnError, OutputFormat, OutputOptions, UsdStageOptions};
use crate::surface::options::{ColumnNames, MethodOptions, OptionGroup, expected, ranged};
use crate::surface::particles::ParticleFilter;
use crate::surface::reconstruction::DEVIATION_MAX_VOXELS;
use crate::watch::{Order, Poll};

use super::frame_selection::FrameSelection;
use super::quantities::{
    PictureSize, one_of, parse_bytes, parse_duration, parse_fps, parse_listen, parse_picture_size,
    parse_poll, parse_positive,
};
use super::sheets::VariedOption;
use after_help::{
    CAMERAS, CHOOSING, CONTACT_SHEETS, DEFINITION, PLAYING, STATUS_JSON, TUNING, VERIFY_STATUSES, WATCHING,
    WHERE_COMPLETIONS_GO, WHERE_PAGES_GO,
};
pub(super) use option_set::{MethodOptionArgs, OptionSet, option_set};
pub(super) use short_help::parse;

/// Convert particles into smooth meshes and level sets.
#[derive(Debug, Parser)]
#[command(name = "meniscus", version, max_term_width = 100)]
pub(super) struct Cli {
    #[command(subcommand)]
    pub(super) command: Command,
}

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// Convert frames of particles into meshes and level sets.
    Convert(Box<ConvertArgs>),
    /// Verify results: whether every frame is complete and up to date, and passed validation.
    Verify(VerifyArgs),
    /// Combine the frames of a sequence into one animated file.
    Sequence(SequenceArgs),
    /// Render pictures of frames: level sets, meshes, or particles, which are converted first.
    Render(Box<RenderArgs>),
    /// Show the frames of a sequence on one sheet.
    ContactSheet(Box<ContactSheetArgs>),
    /// Show one frame under a grid of settings, with the command for each, to choose by eye.
    Tune(Box<TuneArgs>),
    /// Score how much a sequence of surfaces flickers, compared with its particles.
    Flicker(Box<FlickerArgs>),
    /// Print the contents of files: particles, meshes, level sets.
    Info(InfoArgs),
    /// Watch folders, and convert every frame as it arrives.
    Watch(Box<WatchArgs>),
    /// Print the state of a daemon, or of one frame: finished, waiting and failed frames, with reasons.
    Status(StatusArgs),
    /// Print a script for shells that completes commands, options and values.
    Completions(CompletionsArgs),
    /// Write the manual: a page for each command.
    Man(ManArgs),
}

option_set! {
    #[derive(Clone, Debug, PartialEq, Args)]
    #[command(after_long_help = CHOOSING)]
    pub(super) struct ConvertArgs {
        /// Files, folders, globs, or numbered patterns such as dam.####.bgeo, dam.%04d.bgeo, dam.{}.bgeo
        ///
        /// PLY, BGEO of any version, VTK and lists of such files (.pvd), HDF5, USD, Alembic, OpenVDB points, PRT,
        /// PCD, JSON, NumPy arrays, LAMMPS dumps, XYZ files of atoms and delimited text, optionally compressed by gzip
        /// or zstd. The format is detected from the content. Files with several frames give each as a
        /// step. Level sets in .vdb are converted to meshes. Frames are in natural order (9 before 10); files whose
        /// names differ only in the frame number form one sequence, and share their settings. `-` reads one file
        /// from the standard input.
        #[arg(required_unless_present = "print_settings", value_name = "INPUT")]
        pub(super) inputs: Vec<PathBuf>,

        /// Folder for the results; names such as dam.####.glb; for a single frame also a file, or - for the standard
        /// output
        ///
        /// dam.0012.bgeo becomes DIR/dam.0012.glb and so on; a missing folder is created. If PATH is a file, its
        /// extension selects the format. To create a folder with a name like that of a file, end it with a slash:
        /// shot.obj/. A name such as surf/water.####.glb, out_{:04}.ply or out_%04d.ply names the results of a
        /// sequence with the numbers of its frames, in this format or those of --format. Files are written under temporary names, and renamed
        /// when they are complete. Existing files with these names are replaced, except inputs, and .ply, .vtp and
        /// .vdb files of other programs.
        #[arg(short, long, value_name = "PATH")]
        pub(super) out: Option<PathBuf>,

        #[command(flatten)]
        pub(super) formats: FormatArgs,

        /// Convert only frames with these numbers, such as 1-240x2 (every other frame) or 1-10,20,30-40x5
        #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
        pub(super) frames: Option<FrameSelection>,

        /// Write the measurements of each frame to this file, as JSON
        #[arg(long, value_name = "FILE")]
        pub(super) report: Option<PathBuf>,

        /// Skip frames that are done: recorded with the same input, settings and version, and with unchanged
        /// results
        #[arg(long)]
        pub(super) skip_done: bool,

        /// Print only warnings and errors
        #[arg(short, long)]
        pub(super) quiet: bool,

        /// For .vdb level sets only: maximum distance by which smoothing may move the surface, in voxels, 0 to 3; 0
        /// leaves it unchanged [default: 0]
        ///
        /// By default a level set is converted to a mesh unchanged. With a value above 0 it is first replaced
        /// by the smoothest surface within that distance. The voxel size is that of the file. Options for
        /// particles are refused.
        #[arg(long, value_name = "VOXELS", allow_negative_numbers = true, value_parser = deviation())]
        pub(super) max_deviation: Option<f64>,

        /// Write the particles unchanged, without a surface, as ply, or as vtp with --format vtp
        ///
        /// Every attribute keeps its name and type, and positions keep 64 bits. Options for surfaces are
        /// refused.
        #[arg(long)]
        pub(super) particles_only: bool,

        /// Convert only part K of N of the frames, such as 1/60, and skip finished ones; slurm takes K and N
        /// from the job array
        ///
        /// The parts are consecutive frames. Each part measures the settings on the same frames, so together
        /// the parts write the files of a single run. The folder of the results must exist.
        #[arg(long, value_name = "K/N", value_parser = parse_shard)]
        pub(super) shard: Option<ShardChoice>,

        #[command(flatten)]
        pub(super) method: MethodArgs,

        #[command(flatten, next_help_heading = "Run")]
        pub(super) run: RunArgs,

        /// After a failed frame, stop or continue with the next [default: continue]
        #[arg(long, value_name = "WHAT", value_parser = on_error(), help_heading = "Run")]
        pub(super) on_error: Option<OnError>,

        /// Exit with status 0 even if some results fail validation
        ///
        /// Each result is validated, with the vertex positions that are in its file: every particle is
        /// inside, the surface is between its bounds, the mesh is closed. A result that fails validation is
        /// kept, and the frame is named. Without this option the exit status is then 1.
        #[arg(long, help_heading = "Run")]
        pub(super) allow_violations: bool,

        /// Print the resolved settings (those of the preset, overridden by the given options) as keys of a
        /// configuration file, and convert nothing
        ///
        /// If none of INPUT, --spacing and --voxel-size is given, lengths are in units of the particle
        /// spacing.
        #[arg(long, help_heading = "Run")]
        pub(super) print_settings: bool,

        /// After the conversion, combine the frames into one animated .glb or .abc, as `meniscus sequence` does;
        /// may be repeated; requires a single sequence, and glb in --format
        #[arg(long, value_name = "FILE", help_heading = ANIMATION)]
        pub(super) sequence: Vec<PathBuf>,
    }
}

#[derive(Debug, Args)]
pub(super) struct InfoArgs {
    /// Files of particles, meshes or level sets
    #[arg(required = true, value_name = "FILE")]
    pub(super) files: Vec<PathBuf>,

    /// New names for columns of tables, as for `convert`, such as x=centroid_x,y=centroid_y,z=centroid_z
    #[arg(long, value_name = "LIST")]
    pub(super) columns: Option<ColumnNames>,

    /// Write JSON: a list with an object for each file
    #[arg(long)]
    pub(super) json: bool,
}

fn on_error() -> impl TypedValueParser<Value = OnError> {
    one_of([
        (OnError::Stop, "stop", "Stop: write exactly the frames before the one that failed"),
        (OnError::Continue, "continue", "Continue with the next frame"),
    ])
}

/// Parses the value of `--max-deviation` in voxels. The width of the narrow band limits it.
fn deviation() -> impl TypedValueParser<Value = f64> {
    ranged::<f64>(0.0..=DEVIATION_MAX_VOXELS.into())
}

// The output options, shared by all commands that convert and by the configuration file.

option_set! {
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(super) struct FormatArgs {
        /// Formats to write, separated by commas [default: glb,vdb]
        #[arg(
            long, value_name = "LIST", value_delimiter = ',', ignore_case = true, value_parser = surface_format(),
            help_heading = OptionGroup::General.heading()
        )]
        pub(super) format: Option<Vec<OutputFormat>>,

        /// Axis of the particles that points up; with z, .glb, .gltf and .abc are rotated, because they have Y
        /// up; USD records the axis; other formats keep the coordinates [default: y]
        #[arg(long, help_heading = FORMATS, value_name = "AXIS", ignore_case = true, value_parser = up_axis())]
        pub(super) up: Option<UpAxis>,

        /// Length of a world unit in metres, 1e-9 to 1e9, for USD: 0.01 if particles are in centimetres
        /// [default: 1]
        #[arg(long, help_heading = FORMATS, value_name = "M", value_parser = ranged::<f64>(METERS_PER_UNIT))]
        pub(super) meters_per_unit: Option<f64>,

        /// How .vdb stores values: blosc (compressed), active (only active values) or none (uncompressed); with
        /// half, in 16 bits of about three significant digits, as in half,blosc [default: blosc]
        #[arg(long, help_heading = FORMATS, value_name = "LIST")]
        pub(super) vdb: Option<vdb::ValueEncoding>,

        /// Also write a picture of each frame, with one camera for the whole sequence
        #[arg(long, help_heading = FORMATS, value_name = "FORMAT", ignore_case = true, value_parser = picture_format())]
        pub(super) preview: Option<OutputFormat>,

        /// Width and height of pictures, in pixels, each 16 to 8192 [default: 1280x720]
        #[arg(long, help_heading = FORMATS, value_name = "SIZE", value_parser = parse_picture_size)]
        pub(super) preview_size: Option<PictureSize>,

        /// Camera of the pictures: auto, or a list such as azimuth=32,elevation=22,view=30,zoom=1,up=z or
        /// eye=1:2:3,target=0:0:0,view=40,up=y. Angles are in degrees; `view` is the vertical field of view,
        /// and `zoom=1` fits the surface into the picture [default: auto]
        #[arg(long, help_heading = FORMATS, value_name = "SPEC")]
        pub(super) camera: Option<CameraChoice>,

        /// Formats of the points that --spray leaves out of the surface, separated by commas [default: those of the meshes
        /// that can hold points, else ply]
        #[arg(
            long, help_heading = FORMATS, value_name = "LIST", value_delimiter = ',', ignore_case = true,
            value_parser = point_format()
        )]
        pub(super) spray_format: Option<Vec<PointFormat>>,

        /// Write a small USD stage that plays the frames; requires usdc or usda in --format, or --format vdb for
        /// volumes only
        ///
        /// FILE must end in .usda. It is replaced while frames arrive: it plays the frames that are complete,
        /// and holds the previous one where a frame is missing. Its paths are relative to its folder, so move
        /// it together with the results. Each sequence is a prim. Processes that convert parts of a sequence
        /// update the same stage.
        #[arg(long, help_heading = ANIMATION, value_name = "FILE")]
        pub(super) stage: Option<PathBuf>,

        /// Frames per second at which the animation plays, more than 0 and at most 1000; use the frame rate of
        /// your scene [default: 24]
        #[arg(long, help_heading = ANIMATION, value_name = "N", value_parser = parse_fps)]
        pub(super) fps: Option<f64>,
    }
}

/// The help heading of these options, except `--format`, `--stage` and `--fps`.
const FORMATS: &str = "Formats";

/// The heading of the options for all frames together.
pub(super) const ANIMATION: &str = "Animation";

/// A surface format.
fn surface_format() -> impl TypedValueParser<Value = OutputFormat> {
    format_if(|format| !format.is_picture())
}

/// A format of points.
fn point_format() -> impl TypedValueParser<Value = PointFormat> {
    one_of(PointFormat::ALL.map(|format| (format, format.extension(), format.help())))
}

/// An image format.
fn picture_format() -> impl TypedValueParser<Value = OutputFormat> {
    format_if(OutputFormat::is_picture)
}

fn format_if(is_one: fn(OutputFormat) -> bool) -> impl TypedValueParser<Value = OutputFormat> {
    let formats = OutputFormat::ALL.into_iter().filter(move |format| is_one(*format));
    one_of(formats.map(|format| (format, format.extension(), format.help())))
}

/// An up axis.
fn up_axis() -> impl TypedValueParser<Value = UpAxis> {
    let help = |axis| match axis {
        UpAxis::Y => "As glTF has it",
        UpAxis::Z => "As Blender and many simulators have it",
    };
    one_of(UpAxis::ALL.map(|axis| (axis, axis.name(), help(axis))))
}

impl FormatArgs {
    /// The formats to write, without duplicates: .glb and .vdb by default, and the requested image format.
    pub(super) fn written(&self) -> Vec<OutputFormat> {
        let formats = self.format.as_deref().unwrap_or(&[OutputFormat::Glb, OutputFormat::Vdb]);
        let mut written = Vec::new();
        for format in formats.iter().copied().chain(self.preview) {
            if !written.contains(&format) {
                written.push(format);
            }
        }
        written
    }

    /// The output options, with `folder` as their folder.
    ///
    /// # Errors
    /// If --stage has nothing to play.
    pub(super) fn outputs(&self, folder: PathBuf) -> Result<OutputOptions> {
        let default = OutputOptions::new(folder, &self.written());
        let mut picture = default.picture;
        picture.size = self.preview_size.map_or(picture.size, |size| size.map(usize::from));
        picture.camera = self.camera.unwrap_or(picture.camera);
        let outputs = OutputOptions {
            up: self.up.unwrap_or(default.up),
            meters_per_unit: self.meters_per_unit.unwrap_or(default.meters_per_unit),
            vdb: self.vdb.unwrap_or(default.vdb),
            picture,
            stage: self.stage.clone().map(|path| UsdStageOptions { path, fps: self.fps.unwrap_or(FPS) }),
            ..default
        };
        check_stage(&outputs)?;
        Ok(outputs)
    }

    /// The formats of the points beside the surfaces, without duplicates: none unless the options ask for spray.
    pub(super) fn spray(&self, method: &MethodArgs, outputs: &OutputOptions) -> Vec<PointFormat> {
        if !method.to_options().has_spray() {
            return Vec::new();
        }
        let mut formats = self.spray_format.clone().unwrap_or_else(|| outputs.default_spray());
        let mut seen = Vec::new();
        formats.retain(|format| {
            let is_new = !seen.contains(format);
            seen.push(*format);
            is_new
        });
        formats
    }

    /// Refuses a frame rate without a stage: for commands that write no sequence files.
    ///
    /// # Errors
    /// What to give as well.
    pub(super) fn refuse_idle_fps(&self) -> Result<()> {
        if self.fps.is_some() && self.stage.is_none() {
            bail!("--fps is for a stage: give --stage as well");
        }
        Ok(())
    }
}

/// Refuses a stage with another extension, and one that plays no files.
fn check_stage(outputs: &OutputOptions) -> Result<()> {
    let Some(UsdStageOptions { path, .. }) = &outputs.stage else { return Ok(()) };
    if path.extension().is_none_or(|extension| !extension.eq_ignore_ascii_case("usda")) {
        bail!("--stage {}: the name of this file must end in .usda", path.display());
    }
    // A user who writes meshes, as by default, expects them in the stage.
    let has_meshes = outputs.formats.iter().any(|format| format.is_mesh());
    let is_of_volumes = outputs.formats.contains(&OutputFormat::Vdb) && !has_meshes;
    if outputs.stage_mesh_format().is_none() && !is_of_volumes {
        bail!(
            "--stage plays the .usdc or .usda files of the frames, and there are none: add usdc to --format, or give \
             --format vdb for a stage of volumes"
        );
    }
    Ok(())
}

// The reconstruction options, shared by all commands that convert and by the configuration file.

option_set! {
    /// The reconstruction options, and those that exist only on the command line.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(super) struct MethodArgs {
        #[command(flatten)]
        pub(super) options: MethodOptionArgs,

        /// Obstacles that the surface must not enter: meshes such as .obj, .glb or .ply, or a .vdb level set;
        /// may be repeated
        ///
        /// A file applies to all frames. With a numbered pattern such as body.####.obj, each frame uses the
        /// file with its own number. Of meshes with time samples, each frame uses those at its own number: the
        /// time code in USD, and in Alembic the frame at the rate of the samples.
        #[arg(long, value_name = "FILE", help_heading = OptionGroup::Obstacles.heading())]
        pub(super) obstacle: Vec<PathBuf>,
    }
}

impl MethodArgs {
    /// The reconstruction options.
    pub(super) fn to_options(&self) -> MethodOptions {
        self.options.0.clone()
    }
}

// The options of the daemon.
//
// The options in `FrameArgs` and `DaemonArgs` are also keys of `meniscus.toml`, with underscores in their names.

#[derive(Clone, Debug, Default, Args)]
#[command(after_long_help = WATCHING)]
pub(super) struct WatchArgs {
    /// Folders to watch; they replace the [[watch]] blocks of a --config
    ///
    /// A folder need not exist yet. If one disappears, the daemon waits for it.
    #[arg(value_name = "DIR", required_unless_present = "config")]
    pub(super) inputs: Vec<PathBuf>,

    /// Folder for the results; created if missing
    ///
    /// dam.0012.bgeo becomes DIR/dam.0012.glb and so on, and sub/dam.0012.bgeo becomes DIR/sub/dam.0012.glb. The
    /// records of converted frames are in DIR/.meniscus.
    #[arg(short, long, value_name = "DIR", required_unless_present = "config")]
    pub(super) out: Option<PathBuf>,

    /// Read folders and settings from this file; options given here override it
    ///
    /// examples/meniscus.toml has every key, explained.
    #[arg(long, value_name = "FILE")]
    pub(super) config: Option<PathBuf>,

    /// Convert the existing frames, and exit
    #[arg(long)]
    pub(super) once: bool,

    /// With --once: exit with status 0 even if some results fail validation
    #[arg(long, requires = "once")]
    pub(super) allow_violations: bool,

    #[command(flatten)]
    pub(super) frames: FrameArgs,

    #[command(flatten, next_help_heading = "Daemon")]
    pub(super) daemon: DaemonArgs,
}

option_set! {
    /// Which files are frames, and how they are converted: the keys of a `[[watch]]` block.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(super) struct FrameArgs {
        /// Convert only files whose names match this pattern, such as 'dam.*.bgeo'; a pattern with a / is
        /// compared with the path within DIR: '*/fluid*.ply', '**/dam.*.bgeo'
        ///
        /// By default all files with an extension of a particle format, and text files that hold particles,
        /// in DIR itself; '**' takes those in its sub-folders as well. Hidden files and results of meniscus
        /// are never taken.
        #[arg(long, value_name = "GLOB")]
        pub(super) pattern: Option<String>,

        /// A frame is complete when a file of this name, its sentinel, is beside it: such as {name}.ok
        ///
        /// {name} is the frame's name, {stem} the name without its extension. Frames then wait for their
        /// sentinels. Without this option, {stem}.done counts as a sentinel if it exists.
        #[arg(long, value_name = "NAME")]
        pub(super) sentinel: Option<String>,

        #[command(flatten)]
        pub(super) formats: FormatArgs,

        #[command(flatten)]
        pub(super) method: MethodArgs,
    }
}

option_set! {
    /// Settings of the daemon itself: the keys of the `[daemon]` block.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(super) struct DaemonArgs {
        /// Which of several waiting frames to convert next [default: natural]
        #[arg(long, value_name = "WHICH", ignore_case = true)]
        pub(super) order: Option<Order>,

        #[command(flatten)]
        pub(super) run: RunArgs,

        /// Start no frame while the disk of the results has less free space than this [default: 1GiB]
        #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
        pub(super) disk_floor: Option<u64>,

        /// How long a file that is complete by its format must be unchanged before it is read [default: 500ms]
        ///
        /// A file whose format cannot show this must be unchanged for four times as long. A file that is
        /// incomplete must be unchanged for at least 30s, or with --once only for four times this time; then
        /// its frame fails, with a message about the missing part.
        #[arg(long, value_name = "TIME", value_parser = parse_duration)]
        pub(super) settle: Option<Duration>,

        /// With --temporal, --spray, --rest or --time-step: how long a frame waits for the frames on which it depends; then it is
        /// converted without the missing ones, and again when they come [default: 30s]
        #[arg(long, value_name = "TIME", value_parser = parse_duration)]
        pub(super) temporal_wait: Option<Duration>,

        /// Find changes by scanning the folders at this interval; auto does so only where the operating
        /// system sends no file-system events, as on network file systems [default: auto]
        #[arg(long, value_name = "TIME", value_parser = parse_poll)]
        pub(super) poll: Option<Poll>,

        /// Format of the log on the standard error [default: text]
        #[arg(long, value_name = "HOW", ignore_case = true)]
        pub(super) log: Option<LogChoice>,

        /// Serve a status page and an HTTP API at this address, such as 127.0.0.1:7700
        ///
        /// Off by default, and read-only. An address that other machines can reach requires a token. With
        /// port 0 the system chooses a free port, which the log states.
        #[arg(long, value_name = "ADDRESS", value_parser = parse_listen)]
        pub(super) listen: Option<SocketAddr>,

        /// Require clients to send the token in the first line of this file: 16 to 256 characters, letters,
        /// digits or - _ . ~
        #[arg(long, value_name = "FILE")]
        pub(super) token_file: Option<PathBuf>,
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum LogChoice {
    /// Lines of text: short ones on a terminal, and elsewhere with all fields
    Text,
    /// One JSON object per line
    Json,
}

// The options of `meniscus render`.

#[derive(Debug, Args)]
#[command(after_long_help = CAMERAS)]
pub(super) struct RenderArgs {
    /// Level sets in .vdb, meshes, or any input of convert: files, folders, globs, numbered patterns
    ///
    /// Particles are first converted to a surface with the options below, as convert does it.
    #[arg(required = true, value_name = "INPUT")]
    pub(super) inputs: Vec<PathBuf>,

    /// Folder for the pictures; for a single frame also a file such as dam.png or dam.exr
    ///
    /// dam.0012.bgeo becomes DIR/dam.0012.png; a missing folder is created.
    #[arg(short, long, value_name = "PATH")]
    pub(super) out: PathBuf,

    /// The format of the pictures in a folder [default: png]
    #[arg(long, value_name = "FORMAT", value_parser = picture_format())]
    pub(super) format: Option<OutputFormat>,

    /// Only frames with these numbers, such as 1-240x2 (every other frame) or 1-10,20,30-40x5
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    pub(super) frames: Option<FrameSelection>,

    /// Width and height, pixels, each 16 to 8192
    #[arg(long, value_name = "SIZE", value_parser = parse_picture_size, default_value = "1280x720")]
    pub(super) size: PictureSize,

    /// Number of pictures of each frame, 2 to 1000, in a full turn around it: frame.000.png and so on
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(2..=1000))]
    pub(super) turntable: Option<u16>,

    /// Show the particles on the left, the surface on the right
    #[arg(long)]
    pub(super) particles: bool,

    #[command(flatten)]
    pub(super) pictures: PictureArgs,
}

/// The camera and settings of pictures, shared by every command that renders some.
#[derive(Clone, Debug, Args)]
pub(super) struct PictureArgs {
    /// Where pictures are taken from: auto, or a list of key=value, such as azimuth=32,zoom=2, which
    /// `meniscus render --help` explains [default: auto]
    #[arg(long, value_name = "SPEC", conflicts_with = "camera_from")]
    pub(super) camera: Option<CameraChoice>,

    /// Use the camera of this file: a .glb or .gltf with a camera, or a picture that meniscus wrote
    #[arg(long, value_name = "FILE")]
    pub(super) camera_from: Option<PathBuf>,

    /// Axis of the world that points up, unless --camera sets it; a camera of a .glb or .gltf is rotated to
    /// it [default: y]
    #[arg(long, value_name = "AXIS", ignore_case = true, value_parser = up_axis())]
    pub(super) up: Option<UpAxis>,

    #[command(flatten)]
    pub(super) method: MethodArgs,

    #[command(flatten, next_help_heading = "Run")]
    pub(super) run: RunArgs,
}

option_set! {
    /// The resources that a command may use.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(super) struct RunArgs {
        /// Number of threads, 1 to 1024 [default: all cores]. Results do not depend on it
        #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1024))]
        pub(super) threads: Option<u16>,

        /// Memory limit for all frames and pictures in flight together, such as 8GiB [default: half of the
        /// machine's memory]
        ///
        /// A frame that needs more is converted in tiles, which are stored in temporary files beside the
        /// results; the result is the same. If even that does not fit, the frame fails with an error that
        /// says how much memory it needs at least.
        #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
        pub(super) memory: Option<u64>,
    }
}

// The options of picture sheets.

#[derive(Debug, Args)]
#[command(after_long_help = CONTACT_SHEETS)]
pub(super) struct ContactSheetArgs {
    /// A folder of pictures, level sets in .vdb, meshes or particles; or files, globs, numbered patterns of
    /// them
    ///
    /// If a frame exists in several forms, the cheapest is shown. Particles are converted to a surface for
    /// the sheet with the options below, as convert does it; if one of these is given, only particles are
    /// used.
    #[arg(required = true, value_name = "INPUT")]
    pub(super) inputs: Vec<PathBuf>,

    /// The sheet: a name that ends with .png
    #[arg(short, long, value_name = "FILE")]
    pub(super) out: PathBuf,

    /// Only frames with these numbers, such as 1-240x2 (every other frame) or 1-10,20,30-40x5
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    pub(super) frames: Option<FrameSelection>,

    /// Maximum number of cells for each sequence, 2 to 1000; if a sequence has more frames, evenly spaced
    /// ones are shown, including the first and the last
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(2..=1000), default_value_t = 60)]
    pub(super) count: u16,

    /// Cells per row, 1 to 1000 [default: about as many as there are rows]
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1000))]
    pub(super) per_row: Option<u16>,

    /// Width and height of a cell, pixels, each 16 to 8192
    #[arg(long, value_name = "SIZE", value_parser = parse_picture_size, default_value = "240x180")]
    pub(super) size: PictureSize,

    #[command(flatten)]
    pub(super) pictures: PictureArgs,
}

#[derive(Debug, Args)]
#[command(after_long_help = TUNING)]
pub(super) struct TuneArgs {
    /// Particles, as convert takes them: a file, or a folder, glob or numbered pattern with one sequence
    ///
    /// Of a sequence, the middle frame is shown, unless --frames selects another.
    #[arg(required = true, value_name = "INPUT")]
    pub(super) inputs: Vec<PathBuf>,

    /// The sheet: a name that ends with .png
    #[arg(short, long, value_name = "FILE")]
    pub(super) out: PathBuf,

    /// An option of convert for surfaces, with the values to show, such as preset=fluid,noisy,splash
    /// [default: position-smoothing=0,0.25,0.5,0.75 and blend=1.4d,1.7d,2.1d,2.6d]
    ///
    /// Given once, the values fill the sheet; given twice, the first option differs from row to row, and the
    /// second from column to column. Values are written as on the command line, and separated by commas.
    #[arg(long, value_name = "OPTION=VALUES")]
    pub(super) vary: Vec<VariedOption>,

    /// Show the frame with this number; of several, such as 100-200, the middle one is shown
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    pub(super) frames: Option<FrameSelection>,

    /// Width and height of a cell, pixels, each 16 to 8192
    #[arg(long, value_name = "SIZE", value_parser = parse_picture_size, default_value = "480x360")]
    pub(super) size: PictureSize,

    /// The folder for results in the printed commands; tune does not create it
    #[arg(long, value_name = "DIR", default_value = "surfaces")]
    pub(super) results: PathBuf,

    #[command(flatten)]
    pub(super) pictures: PictureArgs,
}

// The options of `flicker`.

#[derive(Debug, Args)]
#[command(after_long_help = DEFINITION)]
pub(super) struct FlickerArgs {
    /// The surfaces, from any program: meshes such as .glb, .obj, .ply or .vtp
    ///
    /// A folder, files, globs, or a numbered pattern such as dam.####.glb, of one sequence. Of a folder with
    /// meshes in several formats, those in .glb are used, or else those in the next format of `convert
    /// --format`.
    #[arg(required = true, value_name = "MESHES")]
    pub(super) meshes: Vec<PathBuf>,

    /// The particles of the same frames: a folder, a file, a glob, or a numbered pattern such as
    /// cache/dam.####.bgeo
    #[arg(long, required = true, value_name = "PARTICLES")]
    pub(super) particles: Vec<PathBuf>,

    /// The surfaces of the same frames that were made without --temporal: measures how far the averaged
    /// ones lag behind them
    #[arg(long, value_name = "MESHES")]
    pub(super) unaveraged: Vec<PathBuf>,

    /// Frames of particles per second; needed if the particles have velocities but no ids
    #[arg(
        long,
        value_name = "N",
        allow_negative_numbers = true,
        value_parser = parse_fps,
        conflicts_with = "dt"
    )]
    pub(super) fps: Option<f64>,

    /// Time from one frame of particles to the next, in the unit of time of the velocities, instead of --fps
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true, value_parser = parse_positive)]
    pub(super) dt: Option<f64>,

    /// Distance between particles, the unit of the scores, in world units [default: measured as by convert]
    #[arg(long, value_name = "D", allow_negative_numbers = true, value_parser = parse_positive)]
    pub(super) spacing: Option<f64>,

    /// New names for columns of tables, as given to convert
    #[arg(long, value_name = "LIST")]
    pub(super) columns: Option<ColumnNames>,

    /// Use only the particles that meet this condition, as given to convert
    #[arg(long = "where", value_name = "CONDITION")]
    pub(super) filter: Option<ParticleFilter>,

    /// Points on the surface of each frame
    #[arg(
        long,
        value_name = "N",
        default_value_t = 20_000,
        allow_negative_numbers = true,
        value_parser = ranged::<u32>(100..=1_000_000)
    )]
    pub(super) samples: u32,

    /// Score only frames with these numbers, such as 1-240 or 1-10,20; their neighbours are read as well
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    pub(super) frames: Option<FrameSelection>,

    /// Write the scores of each frame to this file
    #[arg(long, value_name = "FILE")]
    pub(super) csv: Option<PathBuf>,

    /// Write the 1000 points that flicker most to this file: frame, position, flicker
    #[arg(long, value_name = "FILE")]
    pub(super) points: Option<PathBuf>,

    /// Plot the score of each frame, and show where the worst frames flicker: a name that ends with .png
    #[arg(long, value_name = "FILE")]
    pub(super) picture: Option<PathBuf>,

    /// Number of threads, 1 to 1024 [default: all cores]; does not affect results
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1024))]
    pub(super) threads: Option<u16>,
}

// The options of a sequence file: one animated file with all frames of a sequence.

#[derive(Debug, Args)]
#[command(after_long_help = PLAYING)]
pub(super) struct SequenceArgs {
    /// The .glb, .abc or .usdc files of the frames, as convert wrote them: files, a folder, globs, or
    /// numbered patterns such as dam.####.glb
    #[arg(required = true, value_name = "INPUT")]
    pub(super) inputs: Vec<PathBuf>,

    /// The sequence file to write: a .glb with an animation, or an .abc with time samples
    #[arg(short, long, value_name = "FILE")]
    pub(super) out: PathBuf,

    /// Frames per second of the sequence file, more than 0 and at most 1000; use the frame rate of your scene
    #[arg(long, value_name = "N", default_value_t = FPS, value_parser = parse_fps)]
    pub(super) fps: f64,
}

/// The default frames per second.
pub(super) const FPS: f64 = 24.0;

// The options of `verify`, and the shards of `convert`.

#[derive(Debug, Args)]
#[command(after_long_help = VERIFY_STATUSES)]
pub(super) struct VerifyArgs {
    /// Folder with the results
    #[arg(value_name = "DIR")]
    pub(super) folder: PathBuf,

    /// Files, folders, globs, or numbered patterns, as for convert: also report their frames without results
    #[arg(long, value_name = "INPUT", num_args = 1..)]
    pub(super) input: Vec<PathBuf>,

    /// Write the state of each frame to this file, as JSON
    #[arg(long, value_name = "FILE")]
    pub(super) report: Option<PathBuf>,

    /// Number of reading threads, 1 to 1024 [default: all cores]
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1024))]
    pub(super) threads: Option<u16>,
}

/// Which part of the frames to convert.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ShardChoice {
    /// One of several consecutive parts of nearly equal size.
    Part(FrameShard),
    /// The part that Slurm's environment variables name.
    Slurm,
}

/// A shard: the part `index`, from 0, of `count` parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FrameShard {
    pub(super) index: usize,
    pub(super) count: usize,
}

/// Parses a shard such as `3/60`, or `slurm`.
pub(super) fn parse_shard(text: &str) -> Result<ShardChoice, String> {
    if text == "slurm" {
        return Ok(ShardChoice::Slurm);
    }
    let number = |digits: &str| digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse().ok());
    let parts = text.split_once('/').and_then(|(number_text, count)| {
        let (number, count): (usize, usize) = (number(number_text)??, number(count)??);
        (1..=count).contains(&number).then(|| FrameShard { index: number - 1, count })
    });
    expected(text, parts.map(ShardChoice::Part), "K/N, with K from 1 to N, such as 3/60; or slurm")
}

// The options of `status`.

#[derive(Debug, Args)]
#[command(after_long_help = STATUS_JSON)]
pub(super) struct StatusArgs {
    /// Print what is recorded of this frame only: its state, the reason, its outputs
    #[arg(value_name = "FRAME")]
    pub(super) frame: Option<PathBuf>,

    /// The daemon's folder for the results
    #[arg(short, long, value_name = "DIR", required_unless_present = "config")]
    pub(super) out: Option<PathBuf>,

    /// The daemon's configuration file: show all its folders for results
    #[arg(long, value_name = "FILE", conflicts_with = "out")]
    pub(super) config: Option<PathBuf>,

    /// Write JSON
    #[arg(long)]
    pub(super) json: bool,
}

// The options of `meniscus completions` and `meniscus man`.

#[derive(Debug, Args)]
#[command(after_long_help = WHERE_COMPLETIONS_GO)]
pub(super) struct CompletionsArgs {
    /// The shell
    #[arg(value_name = "SHELL")]
    pub(super) shell: Shell,
}

#[derive(Debug, Args)]
#[command(after_long_help = WHERE_PAGES_GO)]
pub(super) struct ManArgs {
    /// Folder for the pages; created if missing
    ///
    /// meniscus.1, meniscus-convert.1 and so on; pages of these names are replaced.
    #[arg(short, long, value_name = "DIR")]
    pub(super) out: PathBuf,
}

#[cfg(test)]
mod tests;
