//! Serializes values that JSON cannot represent, or that readers may round. For `#[serde(with = …)]`.
//!
//! - [`text`]: the shortest text that reads back as the same value, because JSON parsers may round the last
//!   bit of a number;
//! - [`hex`]: a hash as 32 hexadecimal digits;
//! - [`raw`]: JSON as it is;
//! - [`path`]: text, or, where a path is not Unicode, a list of its bytes (on Windows, of its 16-bit units).
//!
//! The inner modules `option` and `list` are for optional fields and for lists.

use std::io::{self, Write};

use serde::Serialize;

/// Writes a value as indented JSON, followed by a line feed.
///
/// # Errors
/// When the system reports an error.
pub(crate) fn write_json(out: &mut impl Write, value: &impl Serialize) -> io::Result<()> {
    serde_json::to_writer_pretty(&mut *out, value)?;
    out.write_all(b"\n")
}

pub(crate) mod raw {
    use std::sync::Arc;

    use serde::ser::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};
    use serde_json::value::RawValue;

    pub(crate) fn serialize<S: Serializer>(value: &Option<Arc<str>>, to: S) -> Result<S::Ok, S::Error> {
        let raw = value.as_ref().map(|json| RawValue::from_string(json.to_string())).transpose();
        raw.map_err(S::Error::custom)?.serialize(to)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Arc<str>>, D::Error> {
        Ok(Option::<Box<RawValue>>::deserialize(from)?.map(|raw| raw.get().into()))
    }
}

pub(crate) mod text {
    use std::fmt::Display;
    use std::str::FromStr;

    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serializer};

    pub(crate) fn serialize<T: Display, S: Serializer>(value: &T, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(value)
    }

    pub(crate) fn deserialize<'de, T: FromStr, D: Deserializer<'de>>(from: D) -> Result<T, D::Error> {
        parse(&String::deserialize(from)?)
    }

    fn parse<T: FromStr, E: Error>(text: &str) -> Result<T, E> {
        text.parse().map_err(|_| E::custom(format!("`{text}` is not a valid value")))
    }

    pub(crate) mod option {
        use super::*;

        pub(crate) fn serialize<T: Display, S: Serializer>(
            value: &Option<T>,
            to: S,
        ) -> Result<S::Ok, S::Error> {
            match value {
                Some(value) => to.collect_str(value),
                None => to.serialize_none(),
            }
        }

        pub(crate) fn deserialize<'de, T: FromStr, D: Deserializer<'de>>(
            from: D,
        ) -> Result<Option<T>, D::Error> {
            Option::<String>::deserialize(from)?.map(|text| parse(&text)).transpose()
        }
    }

    pub(crate) mod list {
        use super::*;

        pub(crate) fn serialize<T: Display, S: Serializer>(list: &[T], to: S) -> Result<S::Ok, S::Error> {
            to.collect_seq(list.iter().map(ToString::to_string))
        }

        pub(crate) fn deserialize<'de, T: FromStr, D: Deserializer<'de>>(
            from: D,
        ) -> Result<Vec<T>, D::Error> {
            Vec::<String>::deserialize(from)?.iter().map(|text| parse(text)).collect()
        }
    }
}

pub(crate) mod hex {
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serializer};

    pub(crate) fn serialize<S: Serializer>(hash: &u128, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(&format_args!("{hash:032x}"))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<u128, D::Error> {
        parse(&String::deserialize(from)?)
    }

    fn parse<E: Error>(text: &str) -> Result<u128, E> {
        u128::from_str_radix(text, 16).map_err(E::custom)
    }

    pub(crate) mod option {
        use super::*;

        pub(crate) fn serialize<S: Serializer>(hash: &Option<u128>, to: S) -> Result<S::Ok, S::Error> {
            match hash {
                Some(hash) => super::serialize(hash, to),
                None => to.serialize_none(),
            }
        }

        pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<u128>, D::Error> {
            Option::<String>::deserialize(from)?.map(|text| parse(&text)).transpose()
        }
    }
}

pub(crate) mod path {
    use std::ffi::OsString;
    use std::path::{Path, PathBuf};

    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    /// The JSON form of a path.
    #[derive(Serialize, Deserialize)]
    #[serde(untagged)]
    enum PathForm {
        Text(String),
        Units(Vec<u16>),
    }

    impl From<&Path> for PathForm {
        fn from(path: &Path) -> PathForm {
            match path.to_str() {
                Some(text) => PathForm::Text(text.to_owned()),
                None => PathForm::Units(units(path)),
            }
        }
    }

    impl PathForm {
        fn into_path<E: Error>(self) -> Result<PathBuf, E> {
            match self {
                PathForm::Text(text) => Ok(text.into()),
                PathForm::Units(units) => {
                    let path = from_units(&units)
                        .ok_or_else(|| E::custom("invalid path: a code unit is out of range"))?;
                    Ok(path.into())
                }
            }
        }
    }

    pub(crate) fn serialize<P: AsRef<Path>, S: Serializer>(path: &P, to: S) -> Result<S::Ok, S::Error> {
        PathForm::from(path.as_ref()).serialize(to)
    }

    pub(crate) fn deserialize<'de, P: From<PathBuf>, D: Deserializer<'de>>(from: D) -> Result<P, D::Error> {
        PathForm::deserialize(from)?.into_path().map(P::from)
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
}
