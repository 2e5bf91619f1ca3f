//! The head of a file: its provenance and a summary of its content.

use crate::core::data::Provenance;
use crate::core::error::{Error, Position, Result};
use crate::core::options::UpAxis;
use crate::usd::{FORMAT, LayerInfo, ROOT, SampledProperty};

/// The beginning of the last line of a file.
pub(super) const LAST_LINE: &str = "# end: ";

/// The lines with the time codes of a stage: the first and the last, and how many a second has.
pub(super) fn times([first, last]: [i64; 2], fps: f64) -> String {
    format!(
        "    endTimeCode = {last}\n    framesPerSecond = {fps}\n    startTimeCode = {first}\n    timeCodesPerSecond = {fps}\n"
    )
}

/// The text before the mesh, including the start of the prim that contains the mesh. `times` are the lines
/// with the time codes of a stage. A stage has no meshes of its own, and thus no summary. `sampled` are
/// the properties with time samples in the file of a frame: stages read them here, because in the mesh they
/// are between long arrays.
pub(super) fn head(
    provenance: &Provenance,
    (info, sampled): (Option<&LayerInfo>, &[SampledProperty]),
    (up, meters_per_unit): (UpAxis, f64),
    times: &str,
) -> String {
    let mut text = "#usda 1.0\n(\n    customLayerData = {\n        dictionary meniscus = {\n".to_owned();
    for (key, value) in provenance {
        text += &format!("            string {} = {}\n", key_of(key), quoted(value));
    }
    text += "        }\n";
    if let Some(LayerInfo { vertices, faces }) = info {
        text += &format!("        dictionary meniscus_mesh = {{\n            int64 faces = {faces}\n");
        text += &format!("            int64 vertices = {vertices}\n        }}\n");
    }
    if !sampled.is_empty() {
        text += &format!("        dictionary {SAMPLED} = {{\n");
        for SampledProperty { kind, name } in sampled {
            text += &format!("            string {} = {}\n", key_of(name), quoted(kind));
        }
        text += "        }\n";
    }
    text += &format!("    }}\n    defaultPrim = \"{ROOT}\"\n");
    let up = match up {
        UpAxis::Y => "Y",
        UpAxis::Z => "Z",
    };
    text + &format!(
        "{times}    metersPerUnit = {meters_per_unit}\n    upAxis = \"{up}\"\n)\n\ndef Xform \"{ROOT}\"\n{{\n"
    )
}

/// Reads the provenance that [`head`] wrote.
pub(crate) fn read_provenance(head: &[u8]) -> Result<Vec<(String, String)>> {
    let text = head_text(head)?;
    Ok(entries(&text, "meniscus").filter_map(string_entry).collect())
}

/// Reads the summary in the head of a file of this crate; `None` for files of other programs.
///
/// # Errors
///
/// [`Error::Invalid`] if the file is not USD text.
pub fn read_layer_info(head: &[u8]) -> Result<Option<LayerInfo>> {
    let text = head_text(head)?;
    let number = |name: &str| {
        let mut entries = entries(&text, "meniscus_mesh");
        entries.find_map(|line| {
            line.strip_prefix("int64 ")?.strip_prefix(name)?.strip_prefix(" = ")?.parse().ok()
        })
    };
    let info = number("vertices").zip(number("faces"));
    Ok(info.map(|(vertices, faces)| LayerInfo { vertices, faces }))
}

/// The first and the last time code in the head of a stage, and the frames per second.
pub fn read_times(head: &[u8]) -> Option<([f64; 2], f64)> {
    let text = head_text(head).ok()?;
    let number = |name: &str| {
        let value = text.lines().find_map(|line| line.trim_start().strip_prefix(name)?.strip_prefix(" = "));
        value?.parse().ok()
    };
    Some(([number("startTimeCode")?, number("endTimeCode")?], number("timeCodesPerSecond")?))
}

/// The dictionary with the names and types of the properties that have time samples.
const SAMPLED: &str = "meniscus_samples";

/// Reads the properties with time samples from the head of the file of a frame; none if it was not written
/// for a stage.
///
/// # Errors
///
/// [`Error::Invalid`] if the file is not USD text.
pub fn read_sampled_properties(head: &[u8]) -> Result<Vec<SampledProperty>> {
    let text = head_text(head)?;
    let found = entries(&text, SAMPLED).filter_map(string_entry);
    Ok(found.filter_map(|(name, kind)| SampledProperty::checked(&kind, &name)).collect())
}

/// The part of the head that is text.
fn head_text(head: &[u8]) -> Result<String> {
    if !head.starts_with(b"#usda 1.0") {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected #usda 1.0"));
    }
    // The prim, which can be long, starts with `def`. `head` may end in the middle of a UTF-8 character,
    // hence the lossy conversion.
    let end = head.windows(5).position(|window| window == b"\ndef ").unwrap_or(head.len());
    Ok(String::from_utf8_lossy(&head[..end]).into_owned())
}

/// The lines of a dictionary.
fn entries<'a>(text: &'a str, name: &str) -> impl Iterator<Item = &'a str> {
    let open = format!("dictionary {name} = {{");
    let lines = text.lines().map(str::trim_start);
    lines.skip_while(move |line| *line != open).skip(1).take_while(|line| *line != "}")
}

fn string_entry(line: &str) -> Option<(String, String)> {
    let line = line.strip_prefix("string ")?;
    let (key, rest) = if line.starts_with('"') {
        unquoted(line)?
    } else {
        line.split_once(' ').map(|(key, _)| (key.to_owned(), &line[key.len()..]))?
    };
    let (value, rest) = unquoted(rest.strip_prefix(" = ")?)?;
    rest.is_empty().then_some((key, value))
}

fn key_of(key: &str) -> String {
    let is_plain =
        |(index, c): (usize, char)| c == '_' || c.is_ascii_alphabetic() || index > 0 && c.is_ascii_digit();
    let is_identifier = !key.is_empty() && key.chars().enumerate().all(is_plain);
    if is_identifier { key.to_owned() } else { quoted(key) }
}

/// A quoted string on a single line.
pub(super) fn quoted(text: &str) -> String {
    let mut quoted = String::with_capacity(text.len() + 2);
    quoted.push('"');
    for c in text.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            // The format escapes a byte with two hexadecimal digits.
            '\0'..='\x1f' | '\x7f' => quoted += &format!("\\x{:02x}", u32::from(c)),
            _ => quoted.push(c),
        }
    }
    quoted.push('"');
    quoted
}

/// Parses the string at the start of a text, in the form of [`quoted`], and returns the rest of the text.
fn unquoted(text: &str) -> Option<(String, &str)> {
    let text = text.strip_prefix('"')?;
    let (mut string, mut chars) = (String::new(), text.char_indices());
    while let Some((at, c)) = chars.next() {
        match c {
            '"' => return Some((string, &text[at + 1..])),
            '\\' => match chars.next()?.1 {
                'x' => {
                    let code = text.get(at + 2..at + 4)?;
                    string.push(char::from(u8::from_str_radix(code, 16).ok()?));
                    chars.nth(1)?;
                }
                c => string.push(c),
            },
            _ => string.push(c),
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn provenance_and_summary_round_trip() {
        let pair = |key: &str, value: &str| (key.to_owned(), value.to_owned());
        let provenance = [
            pair("generator", "meniscus 0.1.0"),
            pair("note: odd", "a = \"b\" \\ }\r\n\t\0 def Mesh"),
            pair("größe", "höhe ∞ \u{1F4A7}"),
            pair("", ""),
            pair("2", "\\x41"),
        ];
        let info = LayerInfo { vertices: u64::from(u32::MAX) + 1, faces: 7 };
        let sampled = [("point3f[]", "points"), ("int[]", "primvars:id")]
            .map(|(kind, name)| SampledProperty::checked(kind, name).expect("valid"));
        let text =
            head(&provenance, (Some(&info), &sampled), (UpAxis::Z, 1.0), "") + "def Mesh \"surface\"\n";
        assert_eq!(read_provenance(text.as_bytes()).expect("a head"), provenance);
        assert_eq!(read_layer_info(text.as_bytes()).expect("a head"), Some(info));
        assert_eq!(read_sampled_properties(text.as_bytes()).expect("a head"), sampled);
        for length in 0..text.len() {
            let _ = read_provenance(&text.as_bytes()[..length]);
        }
        let foreign = b"#usda 1.0\n(\n    defaultPrim = \"x\"\n)\n";
        assert_eq!(read_provenance(foreign).expect("a foreign file"), []);
        assert_eq!(read_layer_info(foreign).expect("a foreign file"), None);
        assert!(read_provenance(b"PXR-USDC").is_err() && read_layer_info(b"").is_err());
        assert_eq!(read_sampled_properties(foreign).expect("a foreign file"), []);
        assert!(read_sampled_properties(b"PXR-USDC").is_err());
    }

    #[test]
    fn sampled_properties_that_could_change_a_stage_are_ignored() {
        let entry = |line: &str| format!("#usda 1.0\ndictionary meniscus_samples = {{\n{line}\n}}\n");
        for (line, count) in [
            ("string points = \"point3f[]\"", 1),
            ("string points = \"point3f[] x = 1\"", 0),
            ("string points = \"\"", 0),
            ("string \"a\\x0ab\" = \"int[]\"", 0),
            ("string \"a { }\" = \"int[]\"", 0),
        ] {
            assert_eq!(read_sampled_properties(entry(line).as_bytes()).expect("text").len(), count, "{line}");
        }
    }
}
