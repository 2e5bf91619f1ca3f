//! Reads the strings in the field data of an XML file, which contain the provenance of this crate's files.

use quick_xml::Reader;
use quick_xml::events::Event;

use crate::error::{Error, Position, Result};

use super::XML;

/// Names and strings of all arrays with a single string, as far as the head of the file contains them.
pub(crate) fn field_strings(head: &[u8]) -> Result<Vec<(String, String)>> {
    let text = match std::str::from_utf8(head) {
        Ok(text) => text,
        // The head can end in the middle of a character, or contain the start of the appended data.
        Err(error) => std::str::from_utf8(&head[..error.valid_up_to()]).unwrap_or_default(),
    };
    let mut reader = Reader::from_str(text);
    reader.config_mut().check_end_names = false;
    let (mut found, mut name, mut is_vtk) = (Vec::new(), None, false);
    // An error means the end of the head, or of the XML text.
    while let Ok(event) = reader.read_event() {
        match event {
            Event::Start(tag) if tag.local_name().as_ref() == "VTKFile" => is_vtk = true,
            Event::Start(tag) if tag.local_name().as_ref() == "Array" => {
                let value = tag.try_get_attribute("Name").ok().flatten();
                let value = value
                    .and_then(|value| Some(quick_xml::escape::unescape(&value.value).ok()?.into_owned()));
                name = value;
            }
            Event::Text(text) => {
                let string = name.take().zip(string_of(&text));
                found.extend(string);
            }
            Event::End(tag) => match tag.local_name().as_ref() {
                "FieldData" => break,
                "Array" => name = None,
                _ => {}
            },
            Event::Eof => break,
            _ => {}
        }
    }
    match is_vtk {
        true => Ok(found),
        false => Err(Error::invalid(XML, Position::File, "expected <VTKFile>")),
    }
}

/// Decodes a single string from its byte codes.
fn string_of(codes: &str) -> Option<String> {
    let bytes: Option<Vec<u8>> = codes.split_ascii_whitespace().map(|code| code.parse().ok()).collect();
    let mut bytes = bytes?;
    (bytes.pop()? == 0 && !bytes.contains(&0)).then_some(())?;
    String::from_utf8(bytes).ok()
}
