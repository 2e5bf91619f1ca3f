//! Checks that the manifest has a reason for each direct dependency, and that no dependency has C code.

use std::process::Command;

const MANIFESTS: [(&str, &str); 4] = [
    ("Cargo.toml", include_str!("../../Cargo.toml")),
    ("formats", include_str!("../../formats/Cargo.toml")),
    ("surface", include_str!("../../surface/Cargo.toml")),
    ("render", include_str!("../../render/Cargo.toml")),
];

/// Crates that call a C compiler, or look for a C library.
const TOOLS_FOR_C: [&str; 6] = ["cc", "cmake", "bindgen", "pkg-config", "vcpkg", "system-deps"];

#[test]
fn every_dependency_has_a_reason() {
    for (name, manifest) in MANIFESTS {
        let dependencies = dependencies(manifest);
        assert!(dependencies.len() > 4, "{name}: {dependencies:?}");
        let without: Vec<&&str> = dependencies.iter().filter(|line| !has_reason(line)).collect();
        assert!(without.is_empty(), "{name}: these lines do not say what the crate is for: {without:#?}");
    }
}

/// The lines below headings such as `[dependencies]` and `[target.'cfg(unix)'.dev-dependencies]`.
fn dependencies(manifest: &str) -> Vec<&str> {
    let mut is_dependency = false;
    let mut found = Vec::new();
    for line in manifest.lines() {
        if line.starts_with('[') {
            is_dependency = line.trim_end_matches(']').ends_with("dependencies");
        } else if is_dependency && !line.starts_with('#') && line.contains('=') {
            found.push(line);
        }
    }
    found
}

fn has_reason(line: &str) -> bool {
    line.split_once("# ").is_some_and(|(_, reason)| reason.trim().len() > 3)
}

#[test]
fn reasons_are_found() {
    let manifest = "[package]\nname = \"a\"\n[dependencies]\n# On the side.\nb = \"1\" # to read\nc = \"2\"\n\
                    [dev-dependencies]\nd = \"3\"\n[lints]\nx = true\n";
    assert_eq!(dependencies(manifest), ["b = \"1\" # to read", "c = \"2\"", "d = \"3\""]);
    assert!(has_reason("b = \"1\" # to read"));
    assert!(!has_reason("c = \"2\""));
    assert!(!has_reason("c = \"2\" # "));
}

/// Checks the dependencies on this system. `.ci/supply_chain` checks all systems, and the build scripts.
#[test]
fn the_product_needs_no_c() {
    let words = "tree --package meniscus --edges normal,build --prefix none --format {p} --locked --offline";
    let tree = Command::new(env!("CARGO"))
        .args(words.split(' '))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("cargo starts");
    assert!(tree.status.success(), "{}", String::from_utf8_lossy(&tree.stderr));
    let tree = String::from_utf8_lossy(&tree.stdout);
    let crates: Vec<&str> = tree.lines().filter_map(|line| line.split_whitespace().next()).collect();
    assert!(crates.contains(&"rayon-core") && crates.len() > 50, "the crates were not found: {crates:?}");
    for tool in TOOLS_FOR_C {
        assert!(!crates.contains(&tool), "something in the program is built with {tool}");
    }
}
