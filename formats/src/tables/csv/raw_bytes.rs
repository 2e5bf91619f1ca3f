//! Tables with 8-bit numbers as raw bytes, as ParaView writes columns of unsigned char.
//!
//! ```text
//!   "Idp","Type","Points:0","Points:1","Points:2"
//!   0,␃,0.25,0.5,0.75            ␃ is the byte 3: the number 3
//! ```
//!
//! A byte can be any character, such as the delimiter or a line end. So a cell of such a column is exactly one byte.

use super::rows::{Delimiter, cells, quoted_excerpt};
use crate::core::text::Lines;

/// The delimiter that ParaView writes.
const DELIMITER: Delimiter = Delimiter::Byte(b',');

/// Rows that are examined to find the columns.
const SAMPLE_ROWS: usize = 1000;

/// The text with decimal numbers in place of the raw bytes, and a note on them; `None` if it is another kind of text.
pub(super) fn with_numbers(text: &[u8]) -> Option<(Vec<u8>, String)> {
    let mut lines = Lines::new(text);
    let header: Vec<&[u8]> = cells(lines.next()?, DELIMITER).collect();
    let rows_at = lines.at();
    let mut is_raw = vec![false; header.len()];
    for line in lines.take(SAMPLE_ROWS) {
        let row: Vec<&[u8]> = line.split(|&byte| byte == b',').collect();
        if row.len() == header.len() {
            for (is_raw, cell) in is_raw.iter_mut().zip(row) {
                *is_raw |= matches!(cell, [byte] if *byte < b' ' && *byte != b'\t');
            }
        }
    }
    let raw: Vec<String> = header
        .iter()
        .zip(&is_raw)
        .filter(|(_, raw)| **raw)
        .map(|(name, _)| quoted_excerpt(&super::rows::unquoted(name)))
        .collect();
    if raw.is_empty() {
        return None;
    }
    let mut out = text[..rows_at].to_vec();
    let mut rest = &text[rows_at..];
    while !rest.trim_ascii().is_empty() {
        for (column, &is_raw) in is_raw.iter().enumerate() {
            if is_raw {
                let Some(byte) = rest.split_off_first() else { break }; // the table ends within the row
                out.extend_from_slice(byte.to_string().as_bytes());
            } else {
                let length =
                    rest.iter().position(|byte| matches!(byte, b',' | b'\n' | b'\r')).unwrap_or(rest.len());
                out.extend_from_slice(rest.split_off(..length)?);
            }
            if column + 1 < header.len() {
                match rest {
                    [b',', below @ ..] => rest = below,
                    [] => break,
                    _ => return None,
                }
                out.push(b',');
            }
        }
        rest = match rest {
            [b'\r', b'\n', rest @ ..] | [b'\n', rest @ ..] => rest,
            [] => break,
            _ => return None,
        };
        out.push(b'\n');
    }
    Some((out, format!("read raw bytes as numbers, in the columns {}", raw.join(", "))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raw_bytes_become_numbers() {
        let table = b"\"Type\",\"x\",\"y\",\"z\",\"Mk\"\r\n\x03,1,2,3,\x01\r\n,,4,5,6,\n\r\n0,7,8,9,\x00\r\n";
        let (text, note) = with_numbers(table).expect("raw bytes");
        let expected = "\"Type\",\"x\",\"y\",\"z\",\"Mk\"\r\n3,1,2,3,1\n44,4,5,6,10\n48,7,8,9,0\n";
        assert_eq!(String::from_utf8_lossy(&text), expected);
        assert_eq!(note, "read raw bytes as numbers, in the columns \"Type\", \"Mk\"");
    }

    #[test]
    fn incomplete_tables_are_left_to_the_reader_of_rows() {
        let table = b"x,y,z,Mk\n1,2,3,\x01\n4,5,6,\x02\n";
        let read =
            |end: usize| String::from_utf8(with_numbers(&table[..end]).expect("raw bytes").0).expect("text");
        assert_eq!(read(table.len() - 1), "x,y,z,Mk\n1,2,3,1\n4,5,6,2");
        assert_eq!(read(table.len() - 2), "x,y,z,Mk\n1,2,3,1\n4,5,6,");
        assert_eq!(read(table.len() - 5), "x,y,z,Mk\n1,2,3,1\n4,5");
        let (padded, _) = with_numbers(&[&table[..], b"\n \n"].concat()).expect("raw bytes");
        assert_eq!(padded, b"x,y,z,Mk\n1,2,3,1\n4,5,6,2\n");
    }

    #[test]
    fn other_binary_data_are_refused() {
        for text in [
            &b"x,y,z\n1,2,3\n"[..],
            b"x,y,z\n1,2,\x03\x04\n",
            b"x,y,k\n1,2,\x03\n1,2,ab\n",
            b"",
            b"\x01,\x02",
        ] {
            assert!(with_numbers(text).is_none(), "{text:?}");
        }
    }
}
