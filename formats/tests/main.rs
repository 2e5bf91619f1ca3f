//! The tests of the file formats, in one program: each of its own would link everything again. `hostile` alone is another one,
//! because it counts the memory of the whole process.

mod band_grids; // grids beside a level set
mod batches; // reading in batches is reading whole
mod bgeo; // classic BGEO
mod corpus; // files as programs wrote them, and broken ones
mod delimited; // tables of text
mod fixtures; // small good files, built byte by byte
mod houdini; // Houdini's geometry
mod lammps; // LAMMPS dumps
mod mesh_formats; // .vtp, .stl, .usda and quantized .glb
mod mesh_read; // meshes of other programs
mod mesh_write; // .glb, .gltf, .obj and .ply
mod npy; // NumPy arrays
mod obstacle; // obstacles as programs write them
mod particle_write; // particles as .ply and .vtp
mod ply; // PLY in all its dialects
mod shared; // files of real programs, where they lie beside the sources
mod short; // files that are cut off
mod shots; // shots gathered from the .glb of their frames
mod solids; // solids as narrow bands
mod vdb_read; // .vdb files of other programs
mod vdb_write; // level sets written as .vdb
mod vertex_attributes; // what is known of vertices
mod vtk; // VTK's files
mod xyz_ext; // the .xyz of chemists

/// A file that is not a module here would be compiled by nobody, and its tests lost.
#[test]
fn every_file_of_tests_is_part_of_a_program() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests");
    let modules = include_str!("main.rs");
    for entry in std::fs::read_dir(folder).expect("the folder is there") {
        let name = entry.expect("an entry").file_name().to_string_lossy().into_owned();
        let Some(module) = name.strip_suffix(".rs").filter(|module| !["main", "hostile"].contains(module))
        else {
            continue;
        };
        assert!(modules.contains(&format!("\nmod {module};")), "tests/main.rs has no `mod {module};`");
    }
}
