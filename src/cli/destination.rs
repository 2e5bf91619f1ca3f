//! Where `convert` writes: to a folder, to one file, or to the standard output.
//!
//! ```text
//!   --out shot        a folder: one file for each frame and format
//!   -o w.####.glb     the same, in the folder before the name, with names of this pattern
//!   -o dam.ply        a file, unless a folder has this name: one frame, in the format of its extension
//!   -o -              the standard output: one frame, in one format; lines for the user go to the standard error
//! ```
//!
//! A single file is represented as a folder and a name for the outputs of the only frame. Output for the
//! standard output is written to a temporary folder first, so that an error never leaves half a mesh in the
//! pipe.

use std::collections::HashSet;
use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{self, IsTerminal, Read, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use meniscus_formats::listed;
use tempfile::TempDir;

use crate::pipeline::{
    NumberPattern, OutFolderError, OutputFormat, STANDARD_INPUT, make_out_folder, show_as, sweep_temporaries,
    write_atomically,
};

use super::CommandOutcome;
use super::args::{ConvertArgs, FormatArgs};
use super::console::Console;
use super::inputs::{InputSelection, SelectedSequence};
use super::machine::{memory_bytes, remove_when_interrupted};
use super::wording::pluralize;

/// Where the results are written.
pub(super) enum Destination {
    /// Into a folder, named after their frames, or by this pattern with their numbers.
    Folder { pattern: Option<String> },
    /// One frame, into a file of this name.
    File { out: PathBuf, stem: String },
    /// One frame, to the standard output, by way of this temporary folder.
    Stdout { folder: TempDir, extension: &'static str },
}

/// A destination, the folder for its files, and the format if it allows only one.
type OutputTarget = (Destination, PathBuf, Option<OutputFormat>);

impl Destination {
    /// The destination that `--out` names, with the folder to write to, and the formats.
    ///
    /// # Errors
    /// If `--out` contradicts other options.
    pub(super) fn of(
        args: &ConvertArgs,
        console: &mut Console,
    ) -> Result<(Destination, PathBuf, FormatArgs)> {
        let Some(out) = args.out.clone().or_else(|| args.print_settings.then(PathBuf::new)) else {
            let last = args
                .inputs
                .last()
                .filter(|last| args.inputs.len() > 1 && file_extension(last).is_some() && !last.exists());
            let example =
                last.map_or("--out surfaces".to_owned(), |last| format!("--out {}", last.display()));
            bail!("--out is missing: name a folder or a file for the results, as in {example}");
        };
        let (destination, folder, format) = if is_stdout(&out) {
            let format = only_format(args)?;
            if args.print_settings {
                // Nothing is converted, and the settings are printed on the standard output.
                (Destination::Folder { pattern: None }, out, Some(format))
            } else {
                Destination::stdout(&out, format, console)?
            }
        } else if let Some(extension) = file_extension(&out) {
            let name = out.file_name().and_then(OsStr::to_str).unwrap_or_default();
            let of_name = match NumberPattern::find_in_new(name) {
                Some(NumberPattern { before, .. }) if NumberPattern::find_in_new(before).is_some() => {
                    bail!("--out {name}: expected one placeholder for the frame number, found several")
                }
                Some(_) => Destination::pattern,
                None => Destination::file,
            };
            of_name(out, &extension, args.formats.format.as_deref())?
        } else {
            refuse_other_extension(&out)?;
            (Destination::Folder { pattern: None }, out, args.particles_only.then_some(OutputFormat::Ply))
        };
        if args.skip_done && !destination.is_folder() {
            bail!(
                "--skip-done compares results with the records in their folder: name a folder with --out, or \
                 leave --skip-done out"
            );
        }
        let mut formats = args.formats.clone();
        // If --format is given, it takes precedence. For a file or the standard output, it was checked above
        // to name the same format.
        formats.format = formats.format.or(format.map(|format| vec![format]));
        Ok((destination, folder, formats))
    }

    fn stdout(out: &Path, format: OutputFormat, console: &mut Console) -> Result<OutputTarget> {
        if io::stdout().is_terminal() {
            bail!(
                "--out {}: the standard output is a terminal: redirect it to a file or a program",
                out.display()
            );
        }
        console.print_to_stderr_only();
        let folder = private_folder()?;
        let path = folder.path().to_owned();
        Ok((Destination::Stdout { folder, extension: format.extension() }, path, Some(format)))
    }

    /// Whether the results are the files of a folder, which has records of them.
    pub(super) fn is_folder(&self) -> bool {
        matches!(self, Destination::Folder { .. })
    }

    /// Files in the folder of `out`, whose name is a pattern with this extension.
    fn pattern(out: PathBuf, extension: &str, formats: Option<&[OutputFormat]>) -> Result<OutputTarget> {
        let format = OutputFormat::from_extension(extension);
        if formats.is_some_and(|formats| format.is_none_or(|format| !formats.contains(&format))) {
            return Err(contradicts_format(&out, extension));
        }
        Ok(match Destination::file(out, extension, None)? {
            (Destination::File { stem, .. }, folder, format) => {
                (Destination::Folder { pattern: Some(stem) }, folder, format)
            }
            other => other,
        })
    }

    fn file(out: PathBuf, extension: &str, formats: Option<&[OutputFormat]>) -> Result<OutputTarget> {
        let name = out.display();
        let format = OutputFormat::from_extension(extension).filter(|format| !format.is_picture());
        let Some(format) = format else {
            bail!("{name}: convert does not write pictures: use `meniscus render`, or --preview {extension}");
        };
        refuse_capitals(&out, extension)?;
        if formats.is_some_and(|formats| formats.iter().any(|other| *other != format)) {
            return Err(contradicts_format(&out, extension));
        }
        let Some(stem) = out.file_stem().and_then(|stem| stem.to_str()).map(str::to_owned) else {
            bail!("{name}: expected a name in UTF-8");
        };
        let folder = folder_of(&out).to_owned();
        Ok((Destination::File { out, stem }, folder, Some(format)))
    }

    /// Sets the output names of the only frame.
    ///
    /// # Errors
    /// If several frames would go into one file.
    pub(super) fn name_outputs(&self, selection: &mut InputSelection) -> Result<()> {
        let (target, stem) = match self {
            Destination::Folder { pattern } => {
                return pattern.as_deref().map_or(Ok(()), |pattern| name_by(pattern, selection));
            }
            Destination::File { out, stem } => (out.display().to_string(), stem.clone()),
            Destination::Stdout { .. } => ("the standard output".to_owned(), STDOUT_STEM.to_owned()),
        };
        let mut selected: Vec<_> = selection.sequences.iter_mut().flat_map(|s| &mut s.selected).collect();
        let [frame] = &mut selected[..] else {
            bail!(
                "{target}: only one frame fits, and {} are selected: name a folder with --out, or one frame with --frames",
                pluralize(selected.len(), "frame")
            );
        };
        **frame = frame.clone().with_output_stem(stem);
        Ok(())
    }

    /// Copies the result to the standard output, if that is the destination.
    ///
    /// # Errors
    /// If the result cannot be read, or the standard output cannot be written.
    pub(super) fn copy_to_stdout(self, outcome: CommandOutcome) -> Result<CommandOutcome> {
        let Destination::Stdout { folder, extension } = self else { return Ok(outcome) };
        if outcome == CommandOutcome::NothingDone {
            return Ok(outcome);
        }
        let path = folder.path().join(format!("{STDOUT_STEM}.{extension}"));
        let mut file = File::open(&path).with_context(|| path.display().to_string())?;
        let mut out = io::stdout().lock();
        io::copy(&mut file, &mut out)
            .and_then(|_| out.flush())
            .context("cannot write to the standard output")?;
        Ok(outcome)
    }
}

/// Sets the output names of all frames: the pattern with their numbers.
///
/// # Errors
/// If a frame has no number, or two have the same.
fn name_by(pattern: &str, selection: &mut InputSelection) -> Result<()> {
    let name = NumberPattern::find(pattern).with_context(|| format!("{pattern}: expected a placeholder"))?;
    let mut numbers = HashSet::new();
    for frame in selection.sequences.iter().flat_map(|sequence| &sequence.selected) {
        let Some(number) = frame.number() else {
            bail!(
                "{}: the frame has no number for {pattern}: name a folder or a file with --out",
                frame.name()
            );
        };
        if !numbers.insert(number) {
            bail!(
                "{}: two frames have the number {number}, and {pattern} has one place for it: convert one \
                   sequence, or name a folder with --out",
                frame.name()
            );
        }
    }
    // A stage plays those that are not selected, too.
    for SelectedSequence { sequence, selected } in &mut selection.sequences {
        for frame in selected.iter_mut().chain(&mut sequence.frames) {
            if let Some(number) = frame.number() {
                *frame = frame.clone().with_output_stem(name.name_of(number));
            }
        }
    }
    Ok(())
}

/// A temporary folder, which is removed with its contents when the process ends, interrupted or not.
///
/// # Errors
/// If it cannot be created.
fn private_folder() -> Result<TempDir> {
    let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
    remove_when_interrupted(folder.path().to_owned());
    Ok(folder)
}

/// Refuses the name of a file where a folder is needed, because there may be several frames.
///
/// # Errors
/// If the path has the extension of a result and is not a folder.
pub(super) fn refuse_file_name(out: &Path) -> Result<()> {
    refuse_stdout(out)?;
    match file_extension(out) {
        Some(extension) => bail!(
            "{}: expected a folder for the results, but .{extension} names a file: name a folder, such as {}",
            out.display(),
            out.with_extension("").display()
        ),
        None => refuse_other_extension(out),
    }
}

/// Refuses the standard output.
///
/// # Errors
/// If the path names it.
pub(super) fn refuse_stdout(out: &Path) -> Result<()> {
    if is_stdout(out) {
        bail!("--out {}: only `meniscus convert` writes to the standard output: give a path", out.display());
    }
    Ok(())
}

/// Refuses the name of a file in another format, or with a misspelt extension. It would become a folder, which
/// the user hardly expects. A name of a folder may end in a dot and a number or a version, such as `run.v2`.
///
/// # Errors
/// If the path [names a file](names_file). The message says what to write instead.
fn refuse_other_extension(out: &Path) -> Result<()> {
    let file_name = out.file_name().and_then(OsStr::to_str).unwrap_or_default();
    let is_numbered = |text: &str| NumberPattern::find_in_new(text).is_some();
    let extension = out.extension().and_then(OsStr::to_str);
    if is_numbered(extension.unwrap_or(file_name)) && !is_existing_or_named_folder(out) {
        let name = out.display();
        bail!(
            "{name}: the names of results need an extension, such as {name}.glb; for a folder of this name, write {name}/"
        );
    }
    if !names_file(out) {
        return Ok(());
    }
    let (name, extension) = (out.display(), out.extension().unwrap_or_default().display());
    let written = OutputFormat::ALL.into_iter().filter(|format| !format.is_picture());
    let written = listed(written.map(|format| format!(".{format}")).collect(), "or");
    bail!(
        "{name}: .{extension} is not an output format: use {written}; for a folder of this name, write {name}/ \
         or create it first"
    )
}

/// Refuses an extension with capital letters: the file would have another name. `extension` is the path's own in lower
/// case.
///
/// # Errors
/// If the path's extension differs from it.
pub(super) fn refuse_capitals(out: &Path, extension: &str) -> Result<()> {
    if out.extension().is_some_and(|current| current != extension) {
        let (name, lower) = (out.display(), out.with_extension(extension));
        bail!("{name}: the extension of an output must be lower case: use {}", lower.display());
    }
    Ok(())
}

/// The error about a file that is not in the format of `--format`.
pub(super) fn contradicts_format(out: &Path, extension: &str) -> anyhow::Error {
    let name = out.display();
    anyhow!("{name}: --format names a format other than .{extension}: leave --format out, or name a folder")
}

/// Whether a path ends like the name of a file, with a dot and a word that is not a version, and is not a folder.
pub(super) fn names_file(out: &Path) -> bool {
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let is_word = |extension: &str| {
        extension.starts_with(|first: char| first.is_ascii_alphabetic())
            && extension.bytes().all(|byte| byte.is_ascii_alphanumeric())
            && !extension.strip_prefix(['v', 'V']).is_some_and(is_number)
    };
    out.extension().and_then(OsStr::to_str).is_some_and(is_word) && !is_existing_or_named_folder(out)
}

fn is_stdout(out: &Path) -> bool {
    ["-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"].iter().any(|name| out == Path::new(name))
}

/// The lower-case extension, if a path names a result file and not a folder.
fn file_extension(out: &Path) -> Option<String> {
    let extension = out.extension()?.to_str()?.to_ascii_lowercase();
    let is_known = OutputFormat::from_extension(&extension).is_some();
    (is_known && !is_existing_or_named_folder(out)).then_some(extension)
}

/// Whether a path is a folder, or ends like the name of one.
fn is_existing_or_named_folder(out: &Path) -> bool {
    out.as_os_str().to_string_lossy().ends_with(std::path::is_separator) || out.is_dir()
}

/// The format for the standard output.
fn only_format(args: &ConvertArgs) -> Result<OutputFormat> {
    if args.formats.preview.is_some() {
        bail!(
            "--preview writes a second file, and the standard output takes only one: name a folder with --out"
        );
    }
    if args.method.to_options().has_spray() {
        bail!(
            "--spray writes a second file, and the standard output takes only one: name a folder with --out"
        );
    }
    match args.formats.format.as_deref() {
        None if args.particles_only => Ok(OutputFormat::Ply),
        None => Ok(OutputFormat::Glb),
        Some([format]) => Ok(*format),
        Some(_) => bail!("the standard output takes one format: give one --format"),
    }
}

const STDOUT_STEM: &str = "stdout";

// The output folder, created if missing.

/// The folder that contains a file.
pub(super) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes a file that appears under its name only when it is complete.
///
/// # Errors
/// If it cannot be written.
pub(super) fn write_file(path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<()> {
    write_atomically(path, |out| Ok(content(out)?))
        .with_context(|| format!("{}: cannot write", path.display()))
}

/// An existing, writable folder. If [`keep`](OutFolder::keep) is not called, the folders that were created
/// for it are removed again when it is dropped, as far as they are empty.
#[derive(Debug)]
pub(super) struct OutFolder {
    /// The created folders, the innermost first.
    made: Vec<PathBuf>,
}

impl OutFolder {
    /// Creates a folder and its parents, and removes the temporary files of killed processes in it.
    ///
    /// # Errors
    /// If it cannot be created, or is not writable.
    pub(super) fn make(folder: &Path) -> Result<OutFolder, OutFolderError> {
        // An empty path is the current folder.
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let missing = folder
            .ancestors()
            .take_while(|part| !part.as_os_str().is_empty() && part.symlink_metadata().is_err())
            // A path that ends in `..` is another name of a folder further up.
            .filter(|part| part.file_name().is_some());
        let made = OutFolder { made: missing.map(Path::to_owned).collect() };
        make_out_folder(folder)?;
        // If the folder cannot be listed, the temporary files of killed processes stay.
        let _ = sweep_temporaries(folder);
        Ok(made)
    }

    /// Keeps the folder, because results will be written.
    pub(super) fn keep(mut self) {
        self.made.clear();
    }
}

impl Drop for OutFolder {
    fn drop(&mut self) {
        for folder in &self.made {
            // Removing fails if the folder is no longer empty, and then it stays.
            let _ = fs::remove_dir(folder);
        }
    }
}

// `convert -`: reads one file from the standard input, or from another pipe that a shell names, as with
// `<(zcat dam.ply.gz)`.
//
// The pipeline reads files, some of them twice, and a pipe can be read only once. So the pipe is first
// copied to a temporary file.

/// The temporary copy, removed on drop.
pub(super) struct StandardInput {
    pub(super) path: PathBuf,
    _folder: TempDir,
}

impl StandardInput {
    /// Copies the pipe among the inputs, if there is one.
    ///
    /// # Errors
    /// If it cannot be read or is larger than the memory limit, or if there are other inputs.
    pub(super) fn take(args: &ConvertArgs) -> Result<Option<StandardInput>> {
        let Some(pipe) = args.inputs.iter().find(|input| is_pipe(input)) else { return Ok(None) };
        let name = if is_stdin(pipe) { STANDARD_INPUT.to_owned() } else { pipe.display().to_string() };
        if args.inputs.len() > 1 {
            bail!("{name} is one frame, so it must be the only INPUT");
        }
        let folder = private_folder()?;
        let path = folder.path().join("stdin");
        let limit_bytes = memory_bytes(args.run.memory)?;
        let mut file = File::create_new(&path).with_context(|| path.display().to_string())?;
        let pipe = open(pipe).with_context(|| name.clone())?;
        let bytes = io::copy(&mut pipe.take(limit_bytes.saturating_add(1)), &mut file)
            .with_context(|| name.clone())?;
        match bytes {
            0 => bail!("{name} is empty: check the program that writes into it"),
            bytes if bytes > limit_bytes => bail!(
                "{name} is larger than the {} MiB that --memory allows: raise --memory, or convert a file",
                limit_bytes.div_ceil(1 << 20)
            ),
            _ => {}
        }
        show_as(&path, &name);
        Ok(Some(StandardInput { path, _folder: folder }))
    }
}

fn open(pipe: &Path) -> io::Result<Box<dyn Read>> {
    if !is_stdin(pipe) {
        return Ok(Box::new(File::open(pipe)?));
    }
    let stdin = io::stdin();
    if stdin.is_terminal() {
        return Err(io::Error::other("it is a terminal: redirect a file or a program into it"));
    }
    Ok(Box::new(stdin.lock()))
}

fn is_stdin(input: &Path) -> bool {
    ["-", "/dev/stdin", "/dev/fd/0", "/proc/self/fd/0"].iter().any(|name| input == Path::new(name))
}

/// Whether an input is the standard input, or an open descriptor of anything but a regular file. Named pipes are
/// excluded: opening one may block forever.
fn is_pipe(input: &Path) -> bool {
    let is_descriptor =
        || ["/dev/fd", "/proc/self/fd"].iter().any(|folder| input.parent() == Some(Path::new(folder)));
    is_stdin(input) || is_descriptor() && input.metadata().is_ok_and(|metadata| !metadata.is_file())
}
