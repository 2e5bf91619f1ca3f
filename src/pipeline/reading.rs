//! From a file to particles.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::Path;

use meniscus_formats::{Limits, ParticleFrame, Positions, read_particles};

use crate::particles::Particles;

use super::frame::{FrameError, Stage};
use super::stamp::FileStamp;

/// What the pipeline needs of a file.
#[derive(Clone, Debug)]
pub struct ReadFrame {
    /// The particles.
    pub particles: Particles,
    /// What a user should know though the file was read.
    pub notes: Vec<String>,
}

/// The bytes of a file.
///
/// # Errors
/// When the system refuses.
pub fn read_file(path: &Path) -> Result<Vec<u8>, FrameError> {
    fs::read(path).map_err(|error| FrameError::file(path, Stage::Read, error))
}

/// The bytes of a file and its stamp; `None` when it was written, replaced or removed meanwhile.
///
/// # Errors
/// When the system refuses.
pub(super) fn read_unchanged(path: &Path) -> Result<Option<(Vec<u8>, FileStamp)>, FrameError> {
    let read = read_between_stamps(path, |file| {
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        Ok(bytes)
    });
    read.map_err(|error| FrameError::file(path, Stage::Read, error))
}

/// Reads between two looks at the open file and one at what its name leads to.
fn read_between_stamps(
    path: &Path,
    read: impl FnOnce(&mut File) -> io::Result<Vec<u8>>,
) -> io::Result<Option<(Vec<u8>, FileStamp)>> {
    let mut file = File::open(path)?;
    let metadata = file.metadata()?;
    let stamp = FileStamp::of(&metadata);
    let bytes = read(&mut file)?;
    // A pipe has no state that it could be in again.
    if !metadata.is_file() {
        return Ok(Some((bytes, stamp)));
    }
    let at_name = match FileStamp::of_path(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        at_name => at_name?,
    };
    let is_same = FileStamp::of(&file.metadata()?) == stamp && at_name == stamp;
    Ok((is_same && bytes.len() as u64 == stamp.size).then_some((bytes, stamp)))
}

/// The particles in the bytes of the file at `path`.
///
/// # Errors
/// When they are no particles that can be read.
pub fn parse_particles(path: &Path, bytes: &[u8]) -> Result<ReadFrame, FrameError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let frame = read_particles(bytes, &name, &Limits::default())
        .map_err(|error| FrameError::file(path, Stage::Read, error))?;
    let ParticleFrame { positions, notes, .. } = frame;
    Ok(ReadFrame { particles: particles(positions), notes })
}

/// The same vectors under the method's own type.
pub fn particles(positions: Positions) -> Particles {
    match positions {
        Positions::F32(positions) => Particles::Single(positions),
        Positions::F64(positions) => Particles::Double(positions),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use std::time::{Duration, SystemTime};

    /// Reads the file, which `meddle` changes when it is half read.
    fn read_while(path: &Path, meddle: impl FnOnce()) -> Option<Vec<u8>> {
        let read = read_between_stamps(path, |file| {
            let mut bytes = vec![0; 2];
            file.read_exact(&mut bytes)?;
            meddle();
            file.read_to_end(&mut bytes)?;
            Ok(bytes)
        });
        read.expect("readable").map(|(bytes, _)| bytes)
    }

    #[test]
    fn a_file_that_changes_while_it_is_read_is_found_out() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("f.ply");
        let other = folder.path().join("other.ply");
        let write = || fs::write(&path, "text").expect("written");
        let append = || {
            let mut file = File::options().append(true).open(&path).expect("there");
            file.write_all(b"more").expect("written");
        };
        let write_again = || {
            let later = SystemTime::now() + Duration::from_secs(1);
            fs::write(&path, "TEXT").expect("written");
            File::options().write(true).open(&path).expect("there").set_modified(later).expect("set");
        };
        let replace = || {
            let modified = fs::metadata(&path).expect("there").modified().expect("a time");
            fs::write(&other, "text").expect("written");
            File::options().write(true).open(&other).expect("there").set_modified(modified).expect("set");
            fs::rename(&other, &path).expect("renamed");
        };
        let shorten = || File::options().write(true).open(&path).expect("there").set_len(1).expect("cut");
        let meddles: [&dyn Fn(); 5] =
            [&append, &write_again, &replace, &shorten, &|| fs::remove_file(&path).expect("removed")];
        for (index, meddle) in meddles.into_iter().enumerate() {
            write();
            assert_eq!(read_while(&path, meddle), None, "case {index}");
        }
        write();
        assert_eq!(read_while(&path, || ()).as_deref(), Some(&b"text"[..]));
    }
}
