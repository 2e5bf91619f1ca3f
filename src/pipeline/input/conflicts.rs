//! Finds outputs that would replace an input, an obstacle or each other.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::obstacles::ObstacleFiles;
use super::steps::file_of;
use crate::pipeline::error::Conflict;
use crate::pipeline::files::identity::{FileId, canonical_path, entry_key};
use crate::pipeline::target::outputs::OutputOptions;

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
    let mut files: Vec<&Path> = inputs.iter().map(|input| file_of(input)).collect();
    files.dedup(); // the steps of one file are adjacent
    let input_of: HashMap<FileId, &Path> =
        files.into_iter().map(|input| (FileId::of(input), input)).collect();
    let refuse_loss = |output: &Path| match input_of.get(&FileId::of(output)) {
        Some(&input) => {
            let fault = "would replace the input";
            Err(Conflict::Replaces { output: output.to_owned(), fault, file: input.to_owned() })
        }
        None => obstacles.refuse_output(output),
    };
    let mut maker_of: HashMap<PathBuf, &Path> = HashMap::new();
    for (input, stem) in planned {
        for (_, output) in options.files(stem) {
            refuse_loss(&output)?;
            if let Some(other) = maker_of.insert(entry_key(canonical_path(&output)), input) {
                let makers = [other, input].map(|input| input.display().to_string());
                let remedy = "convert them one by one, into different folders".to_owned();
                return Err(Conflict::SameOutput { output, makers, remedy });
            }
        }
    }
    let mut other_of: HashMap<PathBuf, &'static str> = HashMap::new();
    for &(what, path) in written {
        refuse_loss(path)?;
        let (output, entry) = (path.to_owned(), entry_key(canonical_path(path)));
        if let Some(input) = maker_of.get(&entry) {
            let makers = [what.to_owned(), format!("the result of {}", input.display())];
            let remedy = format!("choose another name for {what}");
            return Err(Conflict::SameOutput { output, makers, remedy });
        }
        if let Some(other) = other_of.insert(entry, what) {
            let makers = [other, what].map(str::to_owned);
            return Err(Conflict::SameOutput { output, makers, remedy: "choose two names".to_owned() });
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
        let Some(obstacle) = self.replaced_by(output) else { return Ok(()) };
        let fault = "would replace the obstacle";
        Err(Conflict::Replaces { output: output.to_owned(), fault, file: obstacle.to_owned() })
    }
}
