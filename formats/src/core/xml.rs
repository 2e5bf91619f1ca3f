//! Reads XML, event by event.

use std::borrow::Cow;
use std::fmt::Display;
use std::ops::Range;

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use crate::core::error::{Error, Position, Result};

/// A tag or a text. Names are without their prefixes.
pub(crate) enum XmlEvent<'a, 'b> {
    Start(&'b str, &'b BytesStart<'a>),
    End(&'b str),
    Text(&'a str),
}

/// Calls `event` with each tag and text, and with the range of its bytes. Empty elements give a start and an end.
///
/// # Errors
/// [`Error::Invalid`] for malformed tags; otherwise those of `event`.
pub(crate) fn parse<'a>(
    format: &'static str,
    text: &'a str,
    mut event: impl FnMut(XmlEvent<'a, '_>, Range<u64>) -> Result<()>,
) -> Result<()> {
    let mut reader = Reader::from_str(text);
    // To check the names of end tags, the parser would store the names of all open elements.
    reader.config_mut().check_end_names = false;
    loop {
        let start = reader.buffer_position();
        let found = reader.read_event().map_err(|error| {
            Error::invalid(format, Position::Offset(reader.error_position()), error.to_string())
        })?;
        let range = start..reader.buffer_position();
        match found {
            Event::Start(tag) => event(XmlEvent::Start(tag.local_name().as_ref(), &tag), range)?,
            Event::Empty(tag) => {
                event(XmlEvent::Start(tag.local_name().as_ref(), &tag), range.clone())?;
                event(XmlEvent::End(tag.local_name().as_ref()), range)?;
            }
            Event::End(tag) => event(XmlEvent::End(tag.local_name().as_ref()), range)?,
            Event::Text(text) => {
                if let Cow::Borrowed(text) = text.into_inner() {
                    event(XmlEvent::Text(text), range)?;
                }
            }
            Event::Eof => return Ok(()),
            _ => {}
        }
    }
}

/// The value of an attribute of a tag at this offset.
///
/// # Errors
/// [`Error::Invalid`] if the attributes are malformed.
pub(crate) fn attribute(
    format: &'static str,
    tag: &BytesStart,
    name: &str,
    at: u64,
) -> Result<Option<String>> {
    let wrong = |error: &dyn Display| {
        Error::invalid(format, Position::Offset(at), format!("the attribute `{name}`: {error}"))
    };
    let Some(found) = tag.try_get_attribute(name).map_err(|error| wrong(&error))? else { return Ok(None) };
    let value = quick_xml::escape::unescape(&found.value).map_err(|error| wrong(&error))?;
    Ok(Some(value.into_owned()))
}

/// Requires the last tag.
///
/// # Errors
/// [`Error::Truncated`] without it.
pub(crate) fn check_end(format: &'static str, bytes: &[u8], tag: &str) -> Result<()> {
    if bytes.trim_ascii_end().ends_with(tag.as_bytes()) {
        return Ok(());
    }
    let what = format!("the file ends without {tag}");
    Err(Error::truncated(format, Position::Offset(bytes.len() as u64), what))
}
