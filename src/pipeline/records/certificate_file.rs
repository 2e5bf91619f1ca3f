//! The certificate file beside the outputs of a frame: the results of the checks, and hashes of the checked
//! files.
//!
//! ```text
//!   dam.0012.glb                 records its input and settings
//!   dam.0012.vdb                 the same
//!   dam.0012.certificate.json    records what was checked in them, and the hash of each
//! ```
//!
//! An output cannot record the checks of its own final bytes, and the log of a run may be lost or belong to
//! another run. The hashes bind the certificate to the exact bytes that were checked, so a later reader can
//! trust the outputs without the run and its machine. The certificate appears after the outputs: if it
//! exists, the outputs exist too.
//!
//! Like all outputs, it depends only on the input, the settings and the version of this program.

use std::borrow::Cow;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::surface::report::ReconstructionReport;

use super::provenance::{GENERATOR_AND_VERSION, hash_text};
use super::record::{CertificateRecord, certificate_record};
use crate::pipeline::files::atomic_write::stage;
use crate::pipeline::files::input_file::{InputFile, read_start_unchanged};
use crate::pipeline::files::json::write_json;
use crate::pipeline::files::names::name_of_text;
use crate::pipeline::files::open::require_regular;
use crate::pipeline::files::staged_file::StagedFile;
use crate::pipeline::input::steps::frame_name;

/// The version of the file format. Increase it when the format changes.
const VERSION: u32 = 3;

/// Maximum size of a certificate; a larger file is not one.
const SIZE_MAX_BYTES: u64 = 1 << 20;

/// The certificate of a frame, as it was read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct CertifiedFrame {
    /// The hash of the input, as in provenance.
    pub(crate) input_hash: String,
    /// The failed checks, in words; `None` if all passed.
    pub(crate) fault: Option<String>,
    /// The files that it describes.
    pub(crate) outputs: Vec<CertifiedOutput>,
}

/// A file that a certificate describes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CertifiedOutput {
    /// Its name, without folder.
    pub(crate) file: String,
    /// Its size.
    pub(crate) size_bytes: u64,
    /// Its hash, as in provenance.
    pub(crate) hash: String,
    /// What was checked, in words.
    pub(crate) checked: String,
}

/// The contents of the file. A field that this program does not write is an error, so that no certificate is
/// ambiguous.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CertificateFile {
    meniscus_certificate: u32,
    generator: String,
    input: String,
    input_hash: String,
    certificate: CertificateRecord,
    outputs: Vec<CertifiedOutput>,
}

/// The version of the file's format.
#[derive(Deserialize)]
struct FormatVersion {
    meniscus_certificate: u32,
}

/// The path of the certificate of the frame with this stem.
pub fn certificate_path(folder: &Path, stem: &str) -> PathBuf {
    folder.join(name_of_text(&format!("{stem}.certificate.json")))
}

/// Writes the certificate of a frame whose outputs are staged and not yet renamed; each comes with a
/// description of what was checked.
///
/// # Errors
/// When an output cannot be read back, or the system reports an error.
pub(crate) fn write_certificate(
    path: &Path,
    (input, input_hash): (&Path, u128),
    report: &ReconstructionReport,
    outputs: &[(&StagedFile, &'static str)],
) -> meniscus_formats::Result<StagedFile> {
    let written = CertificateFile {
        meniscus_certificate: VERSION,
        generator: GENERATOR_AND_VERSION.to_owned(),
        input: frame_name(input),
        input_hash: hash_text(input_hash),
        certificate: certificate_record(report),
        outputs: outputs.iter().map(certified).collect::<io::Result<_>>()?,
    };
    stage(path, |out| Ok(write_json(out, &written)?))
}

/// The entry for an output: the hash is of the bytes on disk, not of those in memory.
fn certified((output, checked): &(&StagedFile, &'static str)) -> io::Result<CertifiedOutput> {
    let file = name_of(output.path()).into_owned();
    let hash = hash_text(InputFile::open(output.written_path())?.hash()?);
    Ok(CertifiedOutput { file, size_bytes: output.size_bytes(), hash, checked: (*checked).to_owned() })
}

/// Reads a certificate.
///
/// # Errors
/// Why it is not a valid certificate of this program.
pub(crate) fn read_certificate(path: &Path) -> Result<CertifiedFrame, String> {
    let bytes = read_start_unchanged(path, SIZE_MAX_BYTES).map_err(|error| error.to_string())?;
    let (bytes, _) = bytes.ok_or("written while it was read")?;
    let FormatVersion { meniscus_certificate } =
        serde_json::from_slice(&bytes).map_err(|error| error.to_string())?;
    if meniscus_certificate != VERSION {
        return Err(format!(
            "certificate version {meniscus_certificate} is not supported (expected {VERSION}); convert the frame again"
        ));
    }
    let CertificateFile { input_hash, certificate, outputs, .. } =
        serde_json::from_slice(&bytes).map_err(|error| error.to_string())?;
    let fault = certificate.fault().map_err(|why| format!("it contradicts itself: {why}"))?;
    let is_twice = |(index, output): (usize, &CertifiedOutput)| {
        outputs[..index].iter().any(|other| other.file == output.file)
    };
    if outputs.iter().enumerate().any(is_twice) {
        return Err("it contradicts itself: it has two entries for one file".to_owned());
    }
    Ok(CertifiedFrame { input_hash, fault, outputs })
}

impl CertifiedFrame {
    /// Whether it describes files with exactly these names.
    pub(crate) fn is_about(&self, paths: &[PathBuf]) -> bool {
        let is_named = |path: &PathBuf| self.outputs.iter().any(|output| *output.file == *name_of(path));
        self.outputs.len() == paths.len() && paths.iter().all(is_named)
    }

    /// Checks that these files have exactly the certified bytes.
    ///
    /// # Errors
    /// A description of the first file that has other bytes, or cannot be read.
    pub(crate) fn check_bytes(&self, paths: &[PathBuf]) -> Result<(), String> {
        for path in paths {
            let name = name_of(path);
            let output = self.outputs.iter().find(|output| output.file == name);
            let output = output.ok_or_else(|| format!("the certificate has no entry for {name}"))?;
            let metadata =
                fs::metadata(path).and_then(|metadata| require_regular(&metadata).map(|()| metadata));
            let size_bytes = metadata.map_err(|error| format!("{name}: {error}"))?.len();
            if size_bytes != output.size_bytes {
                let size = output.size_bytes;
                return Err(format!(
                    "{name} was changed or replaced: it has {size_bytes} bytes, expected {size}"
                ));
            }
            let hash = InputFile::open(path).and_then(|file| file.hash());
            if hash_text(hash.map_err(|error| format!("{name}: {error}"))?) != output.hash {
                return Err(format!(
                    "{name} was changed or replaced: its hash differs from that in the certificate"
                ));
            }
        }
        Ok(())
    }
}

fn name_of(path: &Path) -> Cow<'_, str> {
    path.file_name().unwrap_or_default().to_string_lossy()
}
