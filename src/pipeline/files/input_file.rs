//! An input file. Other processes may write it during a read, so its stamp is checked again after the read.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use meniscus_formats::ReadAt;
use twox_hash::XxHash3_128;
use twox_hash::xxhash3_128::Hasher;

use super::open::{open_regular, require_regular};
use super::stamp::FileStamp;

/// Reads a file, and returns its bytes and stamp; `None` if the file was written, replaced or removed
/// meanwhile.
///
/// # Errors
/// When the system reports an error.
pub(crate) fn read_unchanged(path: &Path) -> io::Result<Option<(Vec<u8>, FileStamp)>> {
    read_between_stamps(path, u64::MAX, |file| {
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        Ok(bytes)
    })
}

/// Reads the first `most` bytes of a file, and returns them with its stamp; `None` if the file was written,
/// replaced or removed meanwhile.
///
/// # Errors
/// When the system reports an error; `InvalidInput` if the file is not a regular file. For example, a pipe
/// may have no end.
pub(crate) fn read_start_unchanged(path: &Path, most: u64) -> io::Result<Option<(Vec<u8>, FileStamp)>> {
    require_regular(&path.metadata()?)?;
    read_between_stamps(path, most, |file| {
        let mut bytes = Vec::new();
        file.take(most).read_to_end(&mut bytes)?;
        Ok(bytes)
    })
}

/// Calls `read`, which reads at most `most` bytes, between two checks of the file's stamp.
fn read_between_stamps(
    path: &Path,
    most: u64,
    read: impl FnOnce(&mut &File) -> io::Result<Vec<u8>>,
) -> io::Result<Option<(Vec<u8>, FileStamp)>> {
    let input = InputFile::open(path)?;
    let bytes = read(&mut &input.file)?;
    let is_complete = !input.is_regular || bytes.len() as u64 == input.stamp.size.min(most);
    let has_same_bytes = || Ok(input.hash_of_start(bytes.len() as u64)? == XxHash3_128::oneshot(&bytes));
    Ok((is_complete && input.is_unchanged_or(has_same_bytes)?).then_some((bytes, input.stamp)))
}

/// An open particle file that several threads can read at any position at once.
///
/// Other processes may write the file, so call [`is_unchanged`](InputFile::is_unchanged) after reading the
/// last byte.
#[derive(Debug)]
pub struct InputFile {
    file: File,
    path: PathBuf,
    stamp: FileStamp,
    /// Whether it is a regular file. A pipe cannot be read at a position, and has no state to compare.
    is_regular: bool,
    /// The hash of the whole file, once it is computed.
    known_hash: OnceLock<u128>,
}

impl InputFile {
    /// Opens the file at `path`.
    ///
    /// # Errors
    /// Those of [`open_regular`].
    pub fn open(path: &Path) -> io::Result<InputFile> {
        let file = open_regular(path)?;
        let metadata = file.metadata()?;
        let (stamp, is_regular) = (FileStamp::of(&metadata), metadata.is_file());
        Ok(InputFile { file, path: path.to_owned(), stamp, is_regular, known_hash: OnceLock::new() })
    }

    /// The stamp of the file when it was opened.
    pub fn stamp(&self) -> FileStamp {
        self.stamp
    }

    /// Whether it is a regular file. Unlike a pipe, a regular file can be read at any position.
    pub fn is_regular(&self) -> bool {
        self.is_regular
    }

    /// Whether the file is unchanged: not written, replaced or removed since it was opened. Compares the
    /// stamps of the open file and of its path with the first stamp. If only the status change time differs,
    /// compares the bytes, provided that [`hash`](InputFile::hash) was called before.
    ///
    /// # Errors
    /// When the system reports an error.
    pub fn is_unchanged(&self) -> io::Result<bool> {
        self.is_unchanged_or(|| match self.known_hash.get() {
            Some(&known) => Ok(self.hash_of_start(self.stamp.size)? == known),
            None => Ok(false),
        })
    }

    /// Like [`is_unchanged`](InputFile::is_unchanged), but if only the status change time differs, calls
    /// `has_same_bytes`, which reads the open file again and compares its bytes. `chmod` and new hard links
    /// change that time, and so does a write whose modification time was set back.
    ///
    /// # Errors
    /// When the system reports an error.
    pub(crate) fn is_unchanged_or(&self, has_same_bytes: impl Fn() -> io::Result<bool>) -> io::Result<bool> {
        if !self.is_regular {
            return Ok(true);
        }
        let mut seen = self.stamp;
        // A backup creates a hard link and removes it later, perhaps during the comparison.
        for _ in 0..COMPARISONS_MAX {
            match self.stamp_now()? {
                Some(now) if now == seen => return Ok(true),
                Some(now) if now.without_status_change() == self.stamp.without_status_change() => seen = now,
                _ => return Ok(false),
            }
            match has_same_bytes() {
                Ok(true) => {}
                Ok(false) => return Ok(false),
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(false),
                Err(error) => return Err(error),
            }
        }
        Ok(self.stamp_now()? == Some(seen))
    }

    /// The current stamp; `None` if the path now leads to another file, or does not exist.
    fn stamp_now(&self) -> io::Result<Option<FileStamp>> {
        let at_name = match FileStamp::of_path(&self.path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            at_name => at_name?,
        };
        let open = FileStamp::of(&self.file.metadata()?);
        Ok((open == at_name).then_some(open))
    }

    /// The hash of the whole file. It equals the hash of its bytes in memory, but the file is read piece by
    /// piece.
    ///
    /// # Errors
    /// When the system reports an error; `UnexpectedEof` if the file has become shorter.
    pub fn hash(&self) -> io::Result<u128> {
        let hash = self.hash_of_start(self.stamp.size)?;
        Ok(*self.known_hash.get_or_init(|| hash))
    }

    /// The hash of the first `byte_count` bytes.
    fn hash_of_start(&self, byte_count: u64) -> io::Result<u128> {
        let mut hasher = Hasher::new();
        let mut piece = vec![0; HASHED_BYTES];
        let mut at = 0;
        while at < byte_count {
            let length = usize::try_from(byte_count - at).map_or(HASHED_BYTES, |left| left.min(HASHED_BYTES));
            self.read_exact_at(&mut piece[..length], at)?;
            hasher.write(&piece[..length]);
            at += length as u64;
        }
        Ok(hasher.finish_128())
    }
}

/// The maximum number of comparisons for a file whose status change time keeps changing.
const COMPARISONS_MAX: usize = 4;

impl ReadAt for InputFile {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.stamp.size)
    }

    #[cfg(unix)]
    fn read_exact_at(&self, out: &mut [u8], offset: u64) -> io::Result<()> {
        std::os::unix::fs::FileExt::read_exact_at(&self.file, out, offset)
    }

    #[cfg(windows)]
    fn read_exact_at(&self, mut out: &mut [u8], mut offset: u64) -> io::Result<()> {
        while !out.is_empty() {
            match std::os::windows::fs::FileExt::seek_read(&self.file, out, offset) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(length) => {
                    out = &mut out[length..];
                    offset += length as u64;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

/// Bytes per hashed piece: few enough to fit into the cache, many enough that the cost of system calls does
/// not matter.
const HASHED_BYTES: usize = 1 << 18;

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    use meniscus_formats::{FilePositions, Limits, ParticleBatch, ParticleBatches, ParticleFrame};
    use rayon::prelude::*;
    use std::io::Write;
    use std::time::{Duration, SystemTime};

    /// Reads the file while `meddle` changes it halfway.
    fn read_while(path: &Path, meddle: impl FnOnce()) -> Option<Vec<u8>> {
        let read = read_between_stamps(path, u64::MAX, |file| {
            let mut bytes = vec![0; 2];
            file.read_exact(&mut bytes)?;
            meddle();
            file.read_to_end(&mut bytes)?;
            Ok(bytes)
        });
        read.expect("readable").map(|(bytes, _)| bytes)
    }

    #[test]
    fn change_during_a_read_is_detected() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("f.ply");
        #[cfg(unix)]
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
        #[cfg(unix)]
        let write_unseen = || {
            let modified = fs::metadata(&path).expect("there").modified().expect("a time");
            // Until the file system's clock advances, a change has the same time as the one before.
            let changed = || FileStamp::of_path(&path).expect("there").changed_ns;
            let before = changed();
            while changed() == before {
                fs::write(&path, "TEXT").expect("written");
            }
            File::options().write(true).open(&path).expect("there").set_modified(modified).expect("set");
        };
        // Elsewhere, a file that is open cannot be replaced or removed.
        #[cfg(unix)]
        let replace = || {
            let modified = fs::metadata(&path).expect("there").modified().expect("a time");
            fs::write(&other, "text").expect("written");
            File::options().write(true).open(&other).expect("there").set_modified(modified).expect("set");
            fs::rename(&other, &path).expect("renamed");
        };
        let shorten = || File::options().write(true).open(&path).expect("there").set_len(1).expect("cut");
        #[cfg(unix)]
        let remove = || fs::remove_file(&path).expect("removed");
        let meddles: &[&dyn Fn()] = &[
            &append,
            &write_again,
            #[cfg(unix)]
            &write_unseen,
            #[cfg(unix)]
            &replace,
            &shorten,
            #[cfg(unix)]
            &remove,
        ];
        for (index, meddle) in meddles.iter().enumerate() {
            write();
            assert_eq!(read_while(&path, meddle), None, "case {index}");
        }
        write();
        assert_eq!(read_while(&path, || ()).as_deref(), Some(&b"text"[..]));
    }

    #[cfg(unix)]
    #[test]
    fn chmod_during_a_read_is_not_a_change() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("f.ply");
        let set_mode = |mode| fs::set_permissions(&path, fs::Permissions::from_mode(mode)).expect("set");
        // The file system's clock ticks every few milliseconds.
        let touch_status = || {
            let changed = || FileStamp::of_path(&path).expect("there").changed_ns;
            let before = changed();
            while changed() == before {
                set_mode(0o600);
                set_mode(0o644);
            }
        };
        fs::write(&path, "text").expect("written");
        assert_eq!(read_while(&path, touch_status).as_deref(), Some(&b"text"[..]), "read whole");
        let streamed = InputFile::open(&path).expect("there");
        let hash = streamed.hash().expect("readable");
        touch_status();
        assert!(streamed.is_unchanged().expect("readable"), "streamed");
        let modified = fs::metadata(&path).expect("there").modified().expect("a time");
        fs::write(&path, "TEXT").expect("written");
        File::options().write(true).open(&path).expect("there").set_modified(modified).expect("set");
        touch_status();
        assert!(!streamed.is_unchanged().expect("readable"), "other bytes under the old modification time");
        assert_ne!(InputFile::open(&path).and_then(|file| file.hash()).expect("readable"), hash);
    }

    #[test]
    fn file_hash_equals_the_hash_of_its_bytes() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("f.ply");
        for length in [0, 1, 17, 240, 241, HASHED_BYTES, HASHED_BYTES + 1, 3 * HASHED_BYTES + 12_345] {
            let bytes: Vec<u8> = (0..length).map(|index| (index * 31 % 251) as u8).collect();
            fs::write(&path, &bytes).expect("written");
            let input = InputFile::open(&path).expect("there");
            assert_eq!(input.hash().expect("readable"), twox_hash::XxHash3_128::oneshot(&bytes), "{length}");
            assert!(input.is_unchanged().expect("there"));
        }
        let input = InputFile::open(&path).expect("there");
        File::options().write(true).open(&path).expect("there").set_len(5).expect("cut");
        assert_eq!(input.hash().expect_err("short").kind(), io::ErrorKind::UnexpectedEof);
        assert!(!input.is_unchanged().expect("there"));
    }

    #[test]
    fn several_threads_read_a_file_in_batches() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("f.bgeo");
        let positions: Vec<[f32; 3]> = (0..5000).map(|n| [n as f32, 0.5, -1.0]).collect();
        let frame =
            ParticleFrame { positions: FilePositions::F32(positions.clone()), ..ParticleFrame::default() };
        let mut bytes = Vec::new();
        meniscus_formats::bgeo::write(&frame, &mut bytes).expect("written");
        fs::write(&path, &bytes).expect("written");
        let input = InputFile::open(&path).expect("there");
        let batches = ParticleBatches::open(&input, "f.bgeo", &Limits::default(), 1 << 12).expect("good");
        let batches = batches.expect("of fixed records");
        let read = |index: usize| {
            let mut batch = ParticleBatch::default();
            batches.read_batch(index, &mut batch).expect("there");
            batch.positions
        };
        let found: Vec<FilePositions> = (0..batches.batch_count()).into_par_iter().map(read).collect();
        let found: Vec<[f32; 3]> = found.into_iter().flat_map(single).collect();
        assert_eq!(found, positions);
    }

    fn single(positions: FilePositions) -> Vec<[f32; 3]> {
        match positions {
            FilePositions::F32(positions) => positions,
            FilePositions::F64(_) => Vec::new(),
        }
    }
}
