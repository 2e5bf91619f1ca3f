//! What is recorded beside the outputs of a frame: that what was made was checked, and which bytes that is said of.
//!
//! ```text
//!   dam.0012.glb                 says what it was made from, and how
//!   dam.0012.vdb                 the same
//!   dam.0012.certificate.json    says what was checked of them, and has the hash of each
//! ```
//!
//! An output cannot tell whether its certificate held without other bytes than it has, and a log of a run may be lost, or be
//! that of another run. A hash binds the certificate to the very bytes that it is about; whoever comes later needs neither the run
//! nor its machine to trust it. It appears in a row with the outputs, and after them: where it is, they are.
//!
//! Like all outputs it depends on nothing but the input, the settings and the version of this program.

use std::borrow::Cow;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::surface::report::SkinReport;

use super::provenance::{GENERATOR_AND_VERSION, hash_text};
use super::record::{CertificateRecord, certificate_record};
use crate::pipeline::files::input_file::{InputFile, read_start_unchanged};
use crate::pipeline::files::json::write_json;
use crate::pipeline::files::names::name_of_text;
use crate::pipeline::files::sink::stage;
use crate::pipeline::files::staged_file::StagedFile;
use crate::pipeline::input::steps::frame_name;

/// Another number, another form of the file.
const VERSION: u32 = 3;

/// One with more bytes is none.
const SIZE_MAX_BYTES: u64 = 1 << 20;

/// The certificate of a frame, as it was read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct CertifiedFrame {
    /// The hash of the input, as it stands in provenance.
    pub(crate) input_hash: String,
    /// What of it did not hold, in words; `None` where all that was checked did.
    pub(crate) fault: Option<String>,
    /// What it is about.
    pub(crate) outputs: Vec<CertifiedOutput>,
}

/// A file that a certificate is about.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CertifiedOutput {
    /// Its name, without folder.
    pub(crate) file: String,
    /// Its size.
    pub(crate) size_bytes: u64,
    /// Its hash, as it stands in provenance.
    pub(crate) hash: String,
    /// What of it the certificate is about, in words.
    pub(crate) checked: String,
}

/// The file. What this program did not write is an error: a certificate leaves nothing to interpret.
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

/// Which form the file has.
#[derive(Deserialize)]
struct Form {
    meniscus_certificate: u32,
}

/// Where the certificate of the frame called `stem` goes.
pub fn certificate_path(folder: &Path, stem: &str) -> PathBuf {
    folder.join(name_of_text(&format!("{stem}.certificate.json")))
}

/// Writes the certificate of a frame whose outputs are on the disk and not yet to be seen, each with what of it was checked.
///
/// # Errors
/// When an output cannot be read back, or the system refuses.
pub(crate) fn write_certificate(
    path: &Path,
    (input, input_hash): (&Path, u128),
    report: &SkinReport,
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

/// What is said of an output: of its bytes as they can be read, not as they were meant to be.
fn certified((output, checked): &(&StagedFile, &'static str)) -> io::Result<CertifiedOutput> {
    let file = name_of(output.path()).into_owned();
    let hash = hash_text(InputFile::open(output.written_path())?.hash()?);
    Ok(CertifiedOutput { file, size_bytes: output.size_bytes(), hash, checked: (*checked).to_owned() })
}

/// Reads a certificate.
///
/// # Errors
/// Why it is none that this program wrote.
pub(crate) fn read_certificate(path: &Path) -> Result<CertifiedFrame, String> {
    let bytes = read_start_unchanged(path, SIZE_MAX_BYTES).map_err(|error| error.to_string())?;
    let (bytes, _) = bytes.ok_or("written while it was read")?;
    let Form { meniscus_certificate } = serde_json::from_slice(&bytes).map_err(|error| error.to_string())?;
    if meniscus_certificate != VERSION {
        return Err(format!(
            "certificate version {meniscus_certificate} is not supported (expected {VERSION}); convert the frame again"
        ));
    }
    let CertificateFile { input_hash, certificate, outputs, .. } =
        serde_json::from_slice(&bytes).map_err(|error| error.to_string())?;
    let fault = certificate.fault().map_err(|why| format!("it contradicts itself: {why}"))?;
    let is_twice = |(place, output): (usize, &CertifiedOutput)| {
        outputs[..place].iter().any(|other| other.file == output.file)
    };
    if outputs.iter().enumerate().any(is_twice) {
        return Err("it contradicts itself: it has two entries for one file".to_owned());
    }
    Ok(CertifiedFrame { input_hash, fault, outputs })
}

impl CertifiedFrame {
    /// Whether it is about files of these names, and no others.
    pub(crate) fn is_about(&self, paths: &[PathBuf]) -> bool {
        let is_named = |path: &PathBuf| self.outputs.iter().any(|output| *output.file == *name_of(path));
        self.outputs.len() == paths.len() && paths.iter().all(is_named)
    }

    /// Whether these files are there to the last byte.
    ///
    /// # Errors
    /// What is wrong with the first that is not, in a sentence.
    pub(crate) fn check_bytes(&self, paths: &[PathBuf]) -> Result<(), String> {
        for path in paths {
            let name = name_of(path);
            let output = self.outputs.iter().find(|output| output.file == name);
            let output = output.ok_or_else(|| format!("the certificate is not about {name}"))?;
            let size_bytes = fs::metadata(path).map_err(|error| format!("{name}: {error}"))?.len();
            if size_bytes != output.size_bytes {
                return Err(format!("{name} has {size_bytes} bytes, and {} were written", output.size_bytes));
            }
            let hash = InputFile::open(path).and_then(|file| file.hash());
            if hash_text(hash.map_err(|error| format!("{name}: {error}"))?) != output.hash {
                return Err(format!("{name} has other bytes than were written"));
            }
        }
        Ok(())
    }
}

fn name_of(path: &Path) -> Cow<'_, str> {
    path.file_name().unwrap_or_default().to_string_lossy()
}
