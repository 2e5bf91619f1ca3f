//! Checks the layers of the architecture: a module imports only modules in lower rows of the table, never in
//! its own or a higher row, and files do not import each other in cycles.
//!
//! If two modules need the same type, the type must be in a lower row; there is no other way to share types.

mod imports; // which file imports which

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

use imports::{Code, Crate};

/// The page that assigns modules to rows; the test checks the table on this page.
const ARCHITECTURE: &str = include_str!("../../../docs/architecture.md");

/// Modules in this row and above may use the crate of the file formats.
const FORMATS_VISIBLE_FROM: u32 = 3;

/// Cycles that still exist: files and folders that import each other. Do not add or extend lines; remove the
/// line of a cycle when you break the cycle.
const KNOWN_CYCLES: &[&str] = &[
    "src/surface/anisotropy: half_axes, neighborhoods",
    "src/surface/contour: dual_contouring, quads",
    "src/surface/obstacle: surface, tree, winding",
    "src/surface/options: definition, pairs, presets, values",
    "src/surface/rasterize: distances, signed_distance",
    "src/surface/smooth: explicit, schedule",
    "src/surface/validation: bound_violations, containment, distances, particle_checks, rays, surfaces",
];

fn root(folder: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)
}

#[test]
fn imports_go_down_only() {
    let all = Crate::read(&root("src"), Code::All);
    let mut wrong = imports_that_go_up(&all, Path::new(""), &rows(0));
    wrong.extend(imports_that_go_up(&all, Path::new("surface"), &rows(1)));
    let rows = rows(0);
    for file in all.files_with("meniscus_formats") {
        let unit = unit(file, Path::new("")).expect("below the root");
        if rows.get(unit.as_str()).is_some_and(|&row| row < FORMATS_VISIBLE_FROM) {
            wrong.push(format!("{} imports the formats", file.display()));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// The imports between the files and folders of a folder that lead to the same row or a higher one.
fn imports_that_go_up(all: &Crate, folder: &Path, rows: &HashMap<&str, u32>) -> Vec<String> {
    let mut wrong = Vec::new();
    let mut count = 0;
    for (file, targets) in all.imports() {
        let Some(own) = member(file, folder) else { continue };
        count += 1;
        let Some(&row) = rows.get(own.as_str()) else {
            wrong.push(format!("{}: the module `{own}` has no row", file.display()));
            continue;
        };
        for (target, path) in targets {
            let Some(other) = unit(target, folder).filter(|other| *other != own) else { continue };
            if rows.get(other.as_str()).is_some_and(|&imported| imported >= row) {
                wrong.push(format!("{} (row {row}) imports {path}", file.display()));
            }
        }
    }
    assert!(count > 10, "the sources were not found");
    wrong
}

/// The rows of a table under "Layers": a number, the modules between `,` or `|`, two blanks, a remark.
fn rows(table: usize) -> HashMap<&'static str, u32> {
    let table = ARCHITECTURE
        .split("## Layers")
        .nth(1)
        .and_then(|rest| rest.split("```").nth(2 * table + 1))
        .expect("a table of layers");
    let mut rows = HashMap::new();
    for line in table.lines() {
        let Some((number, rest)) = line.trim().split_once(' ') else { continue };
        let row = number.parse().expect("a row begins with its number");
        let modules = rest.trim().split("  ").next().expect("modules follow the number");
        rows.extend(modules.split([',', '|']).map(|module| (module.trim(), row)));
    }
    assert!(rows.len() > 6, "the table of layers was not understood");
    rows
}

/// The member of a folder that a file belongs to: `grid` for both `grid.rs` and all files in `grid`.
fn unit(file: &Path, folder: &Path) -> Option<String> {
    let first = file.strip_prefix(folder).ok()?.components().next()?;
    Some(first.as_os_str().to_string_lossy().trim_end_matches(".rs").to_owned())
}

/// The member of a folder that a file belongs to; `None` for the `mod.rs` of the folder itself.
fn member(file: &Path, folder: &Path) -> Option<String> {
    unit(file, folder).filter(|unit| !["lib", "mod"].contains(&&**unit))
}

/// Checks the files and subfolders of every folder. The `mod.rs` of a folder is not a member: members may use
/// its items, and it uses theirs.
#[test]
fn imports_have_no_cycles() {
    let mut found = Vec::new();
    for (name, source) in [("src", root("src")), ("formats/src", root("formats/src"))] {
        let all = Crate::read(&source, Code::WithoutTests);
        assert!(all.imports().len() > 20, "the sources were not found");
        found.extend(cycles(name, &all));
    }
    let known: Vec<_> = KNOWN_CYCLES.iter().map(|line| members(line)).collect();
    let is_known = |cycle: &Cycle| {
        let (folder, own) = members(&cycle.name);
        known.iter().any(|(known_folder, all)| *known_folder == folder && own.is_subset(all))
    };
    let new: Vec<String> = found
        .iter()
        .filter(|cycle| !is_known(cycle))
        .map(|cycle| format!("{}\n{}", cycle.name, cycle.why))
        .collect();
    assert!(new.is_empty(), "these import each other:\n{}", new.join("\n"));
    let is_left = |(folder, all): &(&str, BTreeSet<&str>)| {
        found
            .iter()
            .map(|cycle| members(&cycle.name))
            .any(|(other, own)| other == *folder && own.is_subset(all))
    };
    let gone: Vec<_> = known.iter().filter(|line| !is_left(line)).collect();
    assert!(gone.is_empty(), "these cycles are broken: remove their lines from KNOWN_CYCLES: {gone:?}");
}

/// The folder and the members in the name of a cycle.
fn members(name: &str) -> (&str, BTreeSet<&str>) {
    let (folder, members) = name.split_once(": ").expect("a folder and its members");
    (folder, members.split(", ").collect())
}

/// Members of a folder that import each other, directly or through each other.
struct Cycle {
    /// The folder and its members: `pipeline: crew, seats`.
    name: String,
    /// The imports among them, one a line.
    why: String,
}

type Edges = BTreeMap<String, BTreeMap<String, String>>;

fn cycles(root: &str, all: &Crate) -> Vec<Cycle> {
    let imports = all.imports();
    let folders: BTreeSet<&Path> = imports.keys().flat_map(|file| file.ancestors().skip(1)).collect();
    let mut cycles = Vec::new();
    for folder in folders {
        let mut edges = Edges::new();
        for (file, targets) in &imports {
            let Some(own) = member(file, folder) else { continue };
            for (target, path) in targets {
                let Some(other) = member(target, folder).filter(|other| *other != own) else { continue };
                let why = format!("    {} imports {path}", file.display());
                edges.entry(own.clone()).or_default().entry(other).or_insert(why);
            }
        }
        let name =
            Path::new(root).join(folder).display().to_string().trim_end_matches('/').replace('\\', "/");
        cycles.extend(groups(&edges).into_iter().map(|members| cycle_of(&name, &members, &edges)));
    }
    cycles
}

fn cycle_of(folder: &str, members: &BTreeSet<String>, edges: &Edges) -> Cycle {
    let names: Vec<&str> = members.iter().map(String::as_str).collect();
    let within = members.iter().filter_map(|member| edges.get(member));
    let why = within.flatten().filter(|(other, _)| members.contains(*other)).map(|(_, why)| why.clone());
    Cycle { name: format!("{folder}: {}", names.join(", ")), why: why.collect::<Vec<_>>().join("\n") }
}

/// The strongly connected components with more than one member.
fn groups(edges: &Edges) -> Vec<BTreeSet<String>> {
    let reached = |from: &str| {
        let mut reached = BTreeSet::new();
        let mut open = vec![from.to_owned()];
        while let Some(next) = open.pop() {
            for other in edges.get(&next).into_iter().flat_map(BTreeMap::keys) {
                if reached.insert(other.clone()) {
                    open.push(other.clone());
                }
            }
        }
        reached
    };
    let all: BTreeMap<&str, BTreeSet<String>> = edges.keys().map(|unit| (&**unit, reached(unit))).collect();
    let group = |unit: &str| -> BTreeSet<String> {
        all[unit]
            .iter()
            .filter(|other| all.get(&***other).is_some_and(|back| back.contains(unit)))
            .cloned()
            .collect()
    };
    let groups: BTreeSet<BTreeSet<String>> = all.keys().map(|unit| group(unit)).collect();
    groups.into_iter().filter(|group| group.len() > 1).collect()
}

fn crate_of(files: &[(&str, &str)], code: Code) -> Crate {
    Crate::of(files.iter().map(|(file, text)| (PathBuf::from(file), (*text).to_owned())).collect(), code)
}

/// The files that `a/b.rs` imports if it has this text.
fn imported_by(text: &str, code: Code) -> Vec<String> {
    let files = [
        ("lib.rs", "pub mod a; pub mod mesh;"),
        ("a/mod.rs", "mod b; mod c; pub use c::Passed; use crate::mesh::{Mesh as Own, normals};"),
        ("a/b.rs", text),
        ("a/b/inner.rs", ""),
        ("a/c.rs", "pub struct Passed; pub fn other() {}"),
        ("mesh.rs", "pub mod normals; pub struct Mesh;"),
        ("mesh/normals.rs", "pub fn of() {}"),
    ];
    let all = crate_of(&files, code);
    let imports = all.imports();
    imports[Path::new("a/b.rs")].keys().map(|file| file.to_string_lossy().replace('\\', "/")).collect()
}

#[test]
fn imports_are_found() {
    for (text, expected) in [
        ("use crate::mesh::Mesh;", &["mesh.rs"][..]),
        ("use crate::{mesh::{Mesh, normals::of}, a::c::*};", &["a/c.rs", "mesh/normals.rs", "mesh.rs"]),
        ("use super::c::other as own;", &["a/c.rs"]),
        ("use super::{Passed, Own};", &["a/c.rs", "mesh.rs"]),
        ("use super::Defined;", &["a/mod.rs"]),
        ("use super::super::mesh::Mesh;", &["mesh.rs"]),
        ("fn f() { super::super::mesh::normals::of::<u8>() }", &["mesh/normals.rs"]),
        ("pub(in crate::mesh) fn f() { std::mem::drop(1) }", &[]),
        ("mod inner; use inner::X; use std::fmt;", &["a/b/inner.rs"]),
        ("mod inner; fn f() { inner::of(); self::inner::of(); }", &["a/b/inner.rs"]),
        ("mod within { use super::super::c::other; use super::X; }", &["a/c.rs"]),
        (
            "// use crate::mesh;\n/* crate::mesh */ const A: &str = \"crate::mesh\"; const B: char = '\"';",
            &[],
        ),
        ("const R: &str = r#\"\" crate::mesh\"#; fn f<'a>(x: &'a crate::a::c::Passed) {}", &["a/c.rs"]),
        ("#[cfg(test)] mod tests { use crate::mesh::Mesh; }", &[]),
        ("#[cfg(test)] use crate::mesh::Mesh; use super::c::Passed;", &["a/c.rs"]),
    ] {
        assert_eq!(imported_by(text, Code::WithoutTests), expected, "{text}");
    }
    assert_eq!(imported_by("#[cfg(test)] mod tests { use crate::mesh::Mesh; }", Code::All), ["mesh.rs"]);
}

#[test]
fn cycles_are_found() {
    let name = |files: &[(&str, &str)]| -> Vec<String> {
        cycles("src", &crate_of(files, Code::WithoutTests)).into_iter().map(|cycle| cycle.name).collect()
    };
    assert_eq!(
        name(&[("lib.rs", "mod a; mod b;"), ("a.rs", "use crate::b;"), ("b.rs", "use super::a;")]),
        ["src: a, b"]
    );
    let through_folders = [
        ("p/mod.rs", "mod x; mod y; mod z;"),
        ("p/x/deep.rs", "use super::super::y::Y;"),
        ("p/y.rs", "use super::z::Z; pub struct Y;"),
        ("p/z.rs", "use crate::p::x::X;"),
        ("p/x/mod.rs", "pub mod deep; pub struct X;"),
    ];
    assert_eq!(name(&through_folders), ["src/p: x, y, z"]);
    let of_tests_only = [
        ("a.rs", "#[cfg(test)] mod tests; #[cfg(test)] mod more { use crate::b; }"),
        ("a/tests.rs", "use crate::b;"),
        ("b.rs", "use crate::a;"),
    ];
    assert_eq!(name(&of_tests_only), [""; 0]);
}
