//! The tests of the file formats, as a single program: with a program for each module, each would be linked
//! separately, which takes long. Only `hostile` is a separate program, because it measures the memory of the
//! whole process.

mod alembic; // .abc
mod band_grids; // additional grids in .vdb files
mod batches; // reading in batches matches reading whole files
mod bgeo; // classic BGEO
mod corpus; // files of other programs, and invalid files
mod delimited; // text tables
mod fixtures; // small valid files, built byte by byte
mod hdf5; // HDF5 files
mod houdini; // Houdini geometry
mod json; // JSON
mod lammps; // LAMMPS dumps
mod mesh_formats; // .vtp, .stl and USD
mod mesh_read; // meshes written by other programs
mod mesh_write; // .glb, .gltf, .obj and .ply
mod npy; // NumPy arrays
mod obj_points; // OBJ files without faces
mod obstacle; // obstacles in all supported formats
mod odd; // files of one kind each that were once read wrongly
mod particle_write; // particles as .ply and .vtp
mod pcd; // PCD
mod ply; // all dialects of PLY
mod prt; // PRT
mod sequences; // sequences assembled from the .glb files of frames
mod shared; // files of other programs, if found next to the repository
mod solids; // narrow-band level sets of solids
mod texture; // texture coordinates
mod truncated; // truncated files
mod usd; // meshes as .usda and .usdc
mod usd_points; // particles in .usda, .usdc and .usdz
mod vdb_points; // grids of points in .vdb files
mod vdb_read; // .vdb files written by other programs
mod vdb_write; // level sets written as .vdb
mod vertex_attributes; // vertex attributes
mod vtk; // VTK files
mod vtk_index; // files that list VTK files
mod xdmf; // XDMF, an index of HDF5 files
mod xyz_ext; // extended XYZ

/// If a file is missing in this list of modules, it is not compiled, and its tests do not run.
#[test]
fn every_test_file_is_listed_in_main() {
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
