//! Checks that docs/report.md has every field of a report.

use std::collections::BTreeSet;
use std::fs;

use serde_json::Value;
use tempfile::tempdir;

use crate::program::scene::{block, meniscus};

/// Every possible field of a report is in the docs, and no line of the docs starts with an unknown field.
#[test]
fn the_docs_have_every_field_of_the_report() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let mut ply = String::from(
        "ply\nformat ascii 1.0\nelement vertex 216\nproperty float x\nproperty float y\nproperty float z\n\
         property float age\nend_header\n",
    );
    block(6, 0.0).iter().for_each(|[x, y, z]| ply += &format!("{x} {y} {z} 1\n"));
    fs::write(path.join("dam.1.ply"), ply).expect("written");
    fs::write(path.join("a.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
        .expect("written");
    let arguments = [
        "dam.1.ply",
        "--out=o",
        "--report=r.json",
        "--integrator=implicit",
        "--anisotropy=neighbors",
        "--clip=0,0,0,0.4,0.4,0.4",
        "--obstacle=a.obj",
        "--attributes=age",
        "--spray=2",
    ];
    let result = meniscus(path, &[&["convert"], &arguments[..]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    // Level sets have additional fields.
    let result = meniscus(path, &["convert", "o/dam.1.vdb", "--out=l", "--format=glb", "--report=l.json"]);
    assert_eq!(result.status, 0, "{}", result.err);
    let mut fields = BTreeSet::new();
    for report in ["r.json", "l.json"] {
        let report = fs::read(path.join(report)).expect("written");
        collect_fields(&serde_json::from_slice(&report).expect("JSON"), &mut fields);
    }
    for field in ["vertices_cleared", "clipped_voxels", "isolated", "balls", "restarts", "holds"] {
        assert!(fields.contains(field), "{field} is not in this report");
    }
    let docs = include_str!("../../docs/report.md");
    let missing: Vec<&String> = fields.iter().filter(|field| !docs.contains(&format!("`{field}`"))).collect();
    assert_eq!(missing, [""; 0]);
    let leading = docs.lines().filter_map(|line| line.strip_prefix("- `")?.split('`').next());
    let unknown: Vec<&str> = leading.filter(|name| !fields.contains(*name)).collect();
    assert_eq!(unknown, [""; 0]);
}

/// The names of all fields, except those inside `more`, which are options.
fn collect_fields(value: &Value, fields: &mut BTreeSet<String>) {
    match value {
        Value::Object(object) => {
            for (name, value) in object {
                fields.insert(name.clone());
                if name != "more" {
                    collect_fields(value, fields);
                }
            }
        }
        Value::Array(values) => values.iter().for_each(|value| collect_fields(value, fields)),
        _ => {}
    }
}
