//! `convert -`: reads one file from the standard input, or from another pipe that a shell names, as with
//! `<(zcat dam.ply.gz)`.
//!
//! The pipeline reads files, some of them twice, and a pipe can be read only once. So the pipe is first
//! copied to a temporary file.

use std::fs::File;
use std::io::{self, IsTerminal, Read};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use tempfile::TempDir;

use crate::pipeline::{STANDARD_INPUT, show_as};

use super::args::ConvertArgs;
use super::destination::private_folder;
use super::machine::memory_bytes;

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
            0 => bail!("{name} is empty"),
            bytes if bytes > limit_bytes => bail!(
                "{name} is larger than the {limit_bytes} bytes that --memory allows: give more, or convert a file"
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

/// Whether an input is an open pipe. Named pipes are excluded: opening one may block forever.
fn is_pipe(input: &Path) -> bool {
    let is_descriptor =
        || ["/dev/fd", "/proc/self/fd"].iter().any(|folder| input.parent() == Some(Path::new(folder)));
    is_stdin(input) || is_descriptor() && input.metadata().is_ok_and(|metadata| !metadata.is_file())
}
