//! Checks that the table in docs/formats.md has a row for each format, with its extensions.

use meniscus_formats::Format;

#[test]
fn every_format_has_a_row() {
    let table = include_str!("../../docs/formats.md");
    let rows = table.lines().filter_map(|line| line.strip_prefix("| "));
    let rows: Vec<Vec<&str>> = rows.map(|row| row.split('|').map(str::trim).collect()).collect();
    let is_picture = |format: &Format| format.output().is_some_and(|output| output.is_picture());
    for format in Format::ALL.into_iter().filter(|format| !is_picture(format)) {
        let name = format.name();
        let row = rows.iter().find(|row| row[0] == name);
        let row = row.unwrap_or_else(|| panic!("docs/formats.md has no row for {name}"));
        assert!(row.len() >= 7, "the row of {name}");
        for extension in format.extensions() {
            assert!(row[1].contains(&format!("`.{extension}`")), "the extension .{extension} of {name}");
        }
        assert_eq!(format.output().is_some(), row[3] != "no", "whether {name} is written");
    }
}
