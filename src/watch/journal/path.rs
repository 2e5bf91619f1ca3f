//! Paths in lines: text, or, where a path is no text, a list of its bytes (on Windows, of its 16-bit units).

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
pub(super) enum WirePath {
    Text(String),
    Units(Vec<u16>),
}

impl WirePath {
    pub(super) fn of(path: &Path) -> WirePath {
        match path.to_str() {
            Some(text) => WirePath::Text(text.to_owned()),
            None => WirePath::Units(units(path)),
        }
    }

    pub(super) fn into_path(self) -> Option<PathBuf> {
        match self {
            WirePath::Text(text) => Some(PathBuf::from(text)),
            WirePath::Units(units) => from_units(&units).map(PathBuf::from),
        }
    }
}

#[cfg(unix)]
fn units(path: &Path) -> Vec<u16> {
    use std::os::unix::ffi::OsStrExt;
    path.as_os_str().as_bytes().iter().copied().map(u16::from).collect()
}

#[cfg(unix)]
fn from_units(units: &[u16]) -> Option<OsString> {
    use std::os::unix::ffi::OsStringExt;
    let bytes = units.iter().map(|&unit| u8::try_from(unit).ok()).collect::<Option<_>>()?;
    Some(OsString::from_vec(bytes))
}

#[cfg(windows)]
fn units(path: &Path) -> Vec<u16> {
    use std::os::windows::ffi::OsStrExt;
    path.as_os_str().encode_wide().collect()
}

#[cfg(windows)]
fn from_units(units: &[u16]) -> Option<OsString> {
    use std::os::windows::ffi::OsStringExt;
    Some(OsString::from_wide(units))
}
