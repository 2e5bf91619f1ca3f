//! Finds outputs that would replace an input, an obstacle or each other.

use std::collections::HashMap;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use super::obstacles::ObstacleFiles;
use super::steps::file_of;
use crate::pipeline::files::path_identity::{Identity, canonical_entry, identities};
use crate::pipeline::target::outputs::{OutputOptions, output_path};

/// Why a run cannot begin.
#[derive(Debug)]
pub enum Conflict {
    /// An output would replace an input.
    ReplacesInput {
        /// The output.
        output: PathBuf,
        /// The input.
        input: PathBuf,
    },
    /// An output would replace an obstacle, or would later be read as one.
    ReplacesObstacle {
        /// The output.
        output: PathBuf,
        /// The obstacle's path or pattern, as given.
        obstacle: PathBuf,
    },
    /// Two inputs have outputs with the same name.
    SameOutput {
        /// The output.
        output: PathBuf,
        /// The two inputs.
        makers: [PathBuf; 2],
    },
    /// An output would replace particles, or a mesh or a level set of another program.
    ReplacesData {
        /// The output.
        output: PathBuf,
        /// The number of other outputs with the same fault.
        other_count: usize,
    },
    /// An output exists and cannot be read, so it may be such a file.
    Unreadable {
        /// The output.
        output: PathBuf,
        /// The reason.
        source: io::Error,
    },
    /// Another written file, such as the report, has the name of an output.
    ReplacesOutput {
        /// The output.
        output: PathBuf,
        /// The input of that output.
        input: PathBuf,
        /// The other file.
        what: &'static str,
    },
    /// Two written files that are no outputs of frames have the same name.
    SameFile {
        /// Their name.
        output: PathBuf,
        /// The two files.
        files: [&'static str; 2],
    },
}

impl fmt::Display for Conflict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Conflict::ReplacesInput { output, input } => write!(
                f,
                "the output {} would replace the input {}: choose another folder",
                output.display(),
                input.display()
            ),
            Conflict::ReplacesObstacle { output, obstacle } => write!(
                f,
                "the output {} would replace the obstacle {}: choose another folder or format",
                output.display(),
                obstacle.display()
            ),
            Conflict::SameOutput { output, makers: [first, second] } => write!(
                f,
                "{} and {} would both become {}: convert them one by one, into different folders",
                first.display(),
                second.display(),
                output.display()
            ),
            Conflict::ReplacesData { output, other_count } => {
                let output = output.display();
                write!(f, "the output {output} would replace a file that is not a surface of meniscus")?;
                match other_count {
                    0 => write!(f, ": move that file away, or choose another folder or format"),
                    1 => write!(
                        f,
                        ", and so would another: move these files away, or choose another folder or format"
                    ),
                    _ => write!(
                        f,
                        ", and so would {other_count} others: move these files away, or choose another folder or format"
                    ),
                }
            }
            Conflict::Unreadable { output, source } => write!(
                f,
                "cannot check whether the output {} would replace particles: {source}: make it readable, or move it away",
                output.display()
            ),
            Conflict::ReplacesOutput { output, input, what } => write!(
                f,
                "{what} and the result of {} would both become {}: choose another name for {what}",
                input.display(),
                output.display()
            ),
            Conflict::SameFile { output, files: [first, second] } => {
                write!(f, "{first} and {second} would both become {}: choose two names", output.display())
            }
        }
    }
}

impl std::error::Error for Conflict {}

/// Checks that the outputs of all planned frames (input and stem), and all other `written` files (description
/// and path), do not replace one of `inputs`, an obstacle, or each other. The output folder must exist,
/// because only then can its path be resolved.
///
/// # Errors
/// The first conflict found.
pub fn check_outputs(
    planned: &[(PathBuf, String)],
    inputs: &[PathBuf],
    obstacles: &ObstacleFiles,
    options: &OutputOptions,
    written: &[(&'static str, &Path)],
) -> Result<(), Conflict> {
    let mut input_of: HashMap<Identity, &Path> = HashMap::new();
    let mut files: Vec<&Path> = inputs.iter().map(|input| file_of(input)).collect();
    files.dedup(); // the steps of one file are adjacent
    for input in files {
        input_of.extend(identities(input).into_iter().map(|identity| (identity, input)));
    }
    let outputs = planned.iter().flat_map(|(input, stem)| {
        options.formats.iter().map(move |&format| (output_path(&options.folder, stem, format), &**input))
    });
    let refuse_loss = |output: &Path| {
        if let Some(input) = identities(output).iter().find_map(|identity| input_of.get(identity)) {
            return Err(Conflict::ReplacesInput { output: output.to_owned(), input: (*input).to_owned() });
        }
        obstacles.refuse_output(output)
    };
    let mut maker_of: HashMap<PathBuf, &Path> = HashMap::new();
    for (output, maker) in outputs {
        refuse_loss(&output)?;
        if let Some(other) = maker_of.insert(canonical_entry(&output), maker) {
            return Err(Conflict::SameOutput { output, makers: [other.to_owned(), maker.to_owned()] });
        }
    }
    let mut other_of: HashMap<PathBuf, &'static str> = HashMap::new();
    for &(what, path) in written {
        refuse_loss(path)?;
        let (output, entry) = (path.to_owned(), canonical_entry(path));
        if let Some(&input) = maker_of.get(&entry) {
            return Err(Conflict::ReplacesOutput { output, input: input.to_owned(), what });
        }
        if let Some(other) = other_of.insert(entry, what) {
            return Err(Conflict::SameFile { output, files: [other, what] });
        }
    }
    Ok(())
}

impl ObstacleFiles {
    /// Refuses an output that would replace an obstacle, or would be read as one.
    ///
    /// # Errors
    /// The obstacle.
    pub fn refuse_output(&self, output: &Path) -> Result<(), Conflict> {
        let conflict = |obstacle: &Path| Conflict::ReplacesObstacle {
            output: output.to_owned(),
            obstacle: obstacle.to_owned(),
        };
        self.replaced_by(output).map_or(Ok(()), |obstacle| Err(conflict(obstacle)))
    }
}
