//! Reads large tables in parts, in parallel.
//!
//! ```text
//!   x,y,z,id\n │ 0.1,0.2,0.3,1\n ..  │ ..  │ ..  │ ..      parts end at line ends
//!              └ each read as a separate table by any free thread, then joined in order
//! ```
//!
//! The meaning of a cell depends on the cells above it: `-0` may be an integer or a float, and `7` a number
//! or text. So a part that was read separately is used only if it contains no error and the cells above do
//! not change the result. Otherwise the part is read again, as a continuation of the rows already joined.
//! Thus the table, and any error with its line, are the same as those of a sequential reader.

use std::ops::Range;

use rayon::prelude::*;

use super::column::Column;
use super::layout::TableLayout;
use super::rows::Table;
use crate::{Limits, Result};

/// Size of a part: large enough to make the cost of starting one negligible, small enough to share the work.
const PART_BYTES: usize = 1 << 20;

/// Parts per thread held in memory at a time.
const PARTS_PER_THREAD: usize = 4;

/// Reads all rows in the caller's thread pool.
pub(super) fn read_rows(bytes: &[u8], layout: &TableLayout, limits: &Limits) -> Result<Table> {
    read_rows_in_parts(bytes, layout, limits, PART_BYTES)
}

fn read_rows_in_parts(
    bytes: &[u8],
    layout: &TableLayout,
    limits: &Limits,
    part_bytes: usize,
) -> Result<Table> {
    let mut table = Table::with_capacity_for(&bytes[layout.rows_offset..], layout.names.len());
    let thread_count = rayon::current_num_threads();
    if thread_count == 1 || bytes.len() < 2 * part_bytes {
        table.read_more(bytes, layout.rows_offset, layout, limits)?;
        return Ok(table);
    }
    let parts = parts(bytes, layout.rows_offset, part_bytes);
    for parts in parts.chunks(PARTS_PER_THREAD * thread_count) {
        let read_alone = |part: &Range<usize>| {
            let mut alone = Table::with_capacity_for(&bytes[part.clone()], layout.names.len());
            alone.read_more(&bytes[..part.end], part.start, layout, limits).is_ok().then_some(alone)
        };
        let tables: Vec<Option<Table>> = parts.par_iter().map(read_alone).collect();
        for (part, alone) in parts.iter().zip(tables) {
            match alone {
                Some(alone) if can_append(&table, &alone, limits) => append(&mut table, alone),
                _ => table.read_more(&bytes[..part.end], part.start, layout, limits)?,
            }
        }
    }
    Ok(table)
}

/// Splits the bytes from `start` on at line ends. A part extends to the end of its last line, so it can be
/// longer than `part_bytes`.
fn parts(bytes: &[u8], start: usize, part_bytes: usize) -> Vec<Range<usize>> {
    let mut parts = Vec::new();
    let mut at = start;
    while at < bytes.len() {
        let rest = bytes.get(at + part_bytes..).unwrap_or_default();
        // Parts end only at an LF, because an LF may follow a CR.
        let end = rest
            .iter()
            .position(|&byte| byte == b'\n')
            .map_or(bytes.len(), |length| at + part_bytes + length + 1);
        parts.push(at..end);
        at = end;
    }
    parts
}

fn can_append(table: &Table, next: &Table, limits: &Limits) -> bool {
    let row_count = table.row_count as u64 + next.row_count as u64;
    row_count <= limits.particle_count
        && table.columns.iter().zip(&next.columns).all(|(column, next)| column.can_append(next))
}

fn append(table: &mut Table, next: Table) {
    table.columns.iter_mut().zip(next.columns).for_each(|(column, next)| Column::append(column, next));
    table.row_count += next.row_count;
    table.dropped_row_count += next.dropped_row_count;
    table.line_count += next.line_count;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::csv::{frame, layout};

    /// The result of reading a text in parts of `part_bytes` bytes, formatted as text.
    fn outcome(text: &[u8], limits: &Limits, part_bytes: usize) -> std::result::Result<String, String> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads");
        let read = || {
            let layout = layout::layout(text, limits)?;
            let table = read_rows_in_parts(text, &layout, limits, part_bytes)?;
            frame::frame(layout, table)
        };
        // Debug output distinguishes -0 from 0 and has all digits.
        pool.install(read)
            .map(|frame| format!("{frame:?}"))
            .map_err(|error: crate::Error| format!("{error:?}"))
    }

    /// Lines that affect how other lines are read, inserted among lines that do not.
    const CHANGES: [&str; 22] = [
        "1,2,3,4,5,a",
        "0.5,2,3,4,5,a",
        "-0,2,3,-0,5,b",
        "+1,2,3,+4,5,b",
        "1,2,3,16777217,5,a",
        "1,2,3,100000000000000001,5,a",
        "1,2,3,1e3,5,a",
        "1,2,3,,5,a",
        "1,2,3,,5,",
        "nan,2,3,4.25,5,c",
        "nan,2,3,,5,7",
        "1,2,3,4,5,7",
        "1,2,3,4,5,\"7\"",
        "1,2,3,\"7\",5,a",
        "1,2,3,word,5,a",
        "1,2,3,4",
        "1,2,3,4,5,6,7,8",
        "1,2,word,4,5,a",
        "1,2,0.123456789,4,5,a",
        "# a comment",
        "",
        "  \t ",
    ];

    #[test]
    fn parts_give_the_same_result_as_one_pass() {
        let mut error_count = 0;
        for (first, second) in (0..22).flat_map(|first| (0..22).map(move |second| (first, second))) {
            for (usual, line_end) in [("1,2,3,4,5,a", "\n"), ("0.5,2,3,4.5,5,", "\r\n")] {
                let mut lines = vec![usual; 40];
                lines[9] = CHANGES[first];
                lines[25] = CHANGES[second];
                let text = format!("x,y,z,u,v,kind{line_end}{}", lines.join(line_end));
                let expected = outcome(text.as_bytes(), &Limits::default(), usize::MAX / 2);
                for part_bytes in [1, 30, 100, 220] {
                    let found = outcome(text.as_bytes(), &Limits::default(), part_bytes);
                    assert_eq!(found, expected, "{text} in parts of {part_bytes} bytes");
                }
                error_count += usize::from(expected.is_err());
            }
        }
        assert!((200..700).contains(&error_count), "{error_count} of 968 are wrong");
    }

    #[test]
    fn parts_respect_limits_and_invalid_utf8_like_one_pass() {
        let header = b"x,y,z,kind\n".as_slice();
        let rows = [b"1,2,3,\xff\n".as_slice(), b"1,2,3,\xfe\n", b"1,2,3,w\n"].concat().repeat(20);
        let text = [header, &rows].concat();
        for particle_count in [5, 59, 60] {
            let limits = Limits { particle_count, ..Limits::default() };
            let expected = outcome(&text, &limits, usize::MAX / 2);
            assert_eq!(expected.is_ok(), particle_count == 60);
            assert_eq!(outcome(&text, &limits, 50), expected);
        }
    }
}
