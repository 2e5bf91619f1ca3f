//! Recognises files that lie beside the frames of a simulation in formats of particles, but are none.

use std::io;

use crate::core::batches::ReadAt;
use crate::core::compression::{self, Codec};
use crate::core::error::Result;
use crate::core::limits::Limits;
pub use crate::core::neighbor::Neighbor;
use crate::meshes::obj_points;
use crate::ply;
use crate::table::Format;
use crate::table::probe::{HEAD_BYTES, ProbedKind, probe};
use crate::tables::csv;
use crate::vtk;

/// What a file contains instead of particles, as far as that shows without reading all of it; `None` for
/// particles, and for files in which nothing shows it. `head` are the first bytes of `file`: 8 KiB, unless
/// the file is shorter; it may be compressed.
///
/// In a folder of frames, such a file belongs to the frames, and is no frame: simulators write the meshes of
/// rigid bodies and the bounds of the domain beside the particles.
pub fn neighbor(head: &[u8], file_name: &str, file: &dyn ReadAt) -> Option<Neighbor> {
    let ProbedKind::Format(format) = probe(head, file_name).kind else { return None };
    let unpacked = Codec::of(head).map(|codec| codec.decompress_head(head, HEAD_BYTES));
    let start = unpacked.as_deref().unwrap_or(head);
    match format {
        Format::Ply => {
            let has_faces =
                ply::read_header(start, &Limits::default()).is_ok_and(|header| header.has_faces());
            has_faces.then_some(Neighbor::Mesh)
        }
        Format::Delimited => {
            let whole_lines = start.iter().rposition(|&byte| byte == b'\n').map_or(0, |end| end + 1);
            let has_number = file_name.contains(|letter: char| letter.is_ascii_digit());
            csv::is_other_table(&start[..whole_lines], has_number).then_some(Neighbor::Table)
        }
        Format::Obj => {
            let has_faces_below = || match unpacked {
                None => tail(file).is_ok_and(|tail| obj_points::has_faces(&tail)),
                Some(_) => content(file).is_ok_and(|content| obj_points::has_faces(&content)),
            };
            (obj_points::has_faces(start) || has_faces_below()).then_some(Neighbor::Mesh)
        }
        Format::Vtp => vtk::xml_neighbor(start),
        Format::VtkIndex => Some(Neighbor::Index),
        // Of a compressed file, only the beginning is read.
        Format::VtkLegacy if unpacked.is_some() => vtk::legacy_neighbor(&start),
        Format::VtkLegacy => vtk::legacy_neighbor(file),
        _ => None,
    }
}

/// The content of a compressed file.
fn content(file: &dyn ReadAt) -> Result<Vec<u8>> {
    let limits = Limits::default();
    let mut bytes = vec![0; usize::try_from(file.size_bytes()?.min(limits.memory_bytes)).unwrap_or_default()];
    file.read_exact_at(&mut bytes, 0)?;
    Ok(compression::decompressed(&bytes, &limits)?.into_owned())
}

/// The last bytes of a file, from the beginning of a line on.
fn tail(file: &dyn ReadAt) -> io::Result<Vec<u8>> {
    const TAIL_BYTES: u64 = 64 << 10;
    let size = file.size_bytes()?;
    let start = size.saturating_sub(TAIL_BYTES);
    let mut tail = vec![0; usize::try_from(size - start).unwrap_or_default()];
    file.read_exact_at(&mut tail, start)?;
    if start > 0 {
        let line_end = tail.iter().position(|&byte| byte == b'\n').map_or(tail.len(), |end| end + 1);
        tail.drain(..line_end);
    }
    Ok(tail)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A binary file of the legacy format with three points: sections of a line and its numbers.
    fn binary(sections: &[(&str, &[i32])]) -> Vec<u8> {
        let mut bytes =
            b"# vtk DataFile Version 3.0\nmade by hand\nBINARY\nDATASET UNSTRUCTURED_GRID\n".to_vec();
        let points = ("POINTS 3 float", &[0; 9][..]);
        for (line, numbers) in [&[points], sections].concat() {
            bytes.extend(line.as_bytes());
            bytes.push(b'\n');
            bytes.extend(numbers.iter().flat_map(|number| number.to_be_bytes()));
            bytes.push(b'\n');
        }
        bytes
    }

    #[test]
    fn files_beside_frames_are_recognised() {
        let ascii = |data_set: &str, rest: &str| {
            format!("# vtk DataFile Version 4.2\nby hand\nASCII\nDATASET {data_set}\n{rest}").into_bytes()
        };
        let xml = |kind: &str, piece: &str| {
            format!("<?xml version=\"1.0\"?>\n<VTKFile type=\"{kind}\"><{kind}><Piece {piece}>").into_bytes()
        };
        let ply = |more: &str| {
            format!("ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n{more}end_header\n")
                .into_bytes()
        };
        let points = "POINTS 3 float\n0 0 0 1 0 0\nnan 1 0\n";
        let metadata = "METADATA\nINFORMATION 0\n\n";
        let (mesh, index, grid) = (Some(Neighbor::Mesh), Some(Neighbor::Index), Some(Neighbor::Grid));
        let table = Some(Neighbor::Table);
        for (bytes, name, expected) in [
            (ply("element face 1\nproperty list uchar int vertex_indices\n"), "a.ply", mesh),
            (ply("element face 0\nproperty list uchar int vertex_indices\n"), "a.ply", None),
            (ply(""), "a.ply", None),
            (ascii("POLYDATA", &format!("{points}{metadata}POLYGONS 1 4\n3 0 1 2\n")), "a.vtk", mesh),
            (ascii("POLYDATA", &format!("{points}VERTICES 3 6\n1 0 1 1 1 2\nPOINT_DATA 3\n")), "a.vtk", None),
            (
                ascii("UNSTRUCTURED_GRID", &format!("{points}CELLS 1 4\n3 0 1 2\nCELL_TYPES 1\n5\n")),
                "a.vtk",
                mesh,
            ),
            (
                ascii("UNSTRUCTURED_GRID", &format!("{points}CELLS 1 4\n3 0 1 2\nCELL_TYPES 1\n2\n")),
                "a.vtk",
                None,
            ),
            (
                ascii(
                    "POLYDATA",
                    &format!(
                        "{points}POLYGONS 2 3\nOFFSETS vtktypeint64\n0 3\nCONNECTIVITY vtktypeint64\n0 1 2\n"
                    ),
                ),
                "a.vtk",
                mesh,
            ),
            (ascii("RECTILINEAR_GRID", "DIMENSIONS 2 2 2\n"), "a.vtk", grid),
            (ascii("POLYDATA", "POINTS 3 float\n0 0"), "a.vtk", None),
            (binary(&[("CELLS 3 6", &[1, 0, 1, 1, 1, 2]), ("CELL_TYPES 3", &[1; 3])]), "a.vtk", None),
            (binary(&[("CELLS 1 4", &[3, 0, 1, 2]), ("CELL_TYPES 1", &[5])]), "a.vtk", mesh),
            (
                binary(&[
                    ("CELLS 2 3\nOFFSETS vtktypeint32", &[0, 3]),
                    ("CONNECTIVITY vtktypeint32", &[0, 1, 2]),
                    ("CELL_TYPES 1", &[5]),
                ]),
                "a.vtk",
                mesh,
            ),
            (binary(&[("POLYGONS 1 4", &[3, 0, 1, 2])]), "a.vtk", mesh),
            (binary(&[("CELLS 99999999999 99999999999", &[])]), "a.vtk", None),
            (xml("PolyData", "NumberOfPoints=\"3\" NumberOfPolys=\"1\""), "a.vtp", mesh),
            (xml("PolyData", "NumberOfPoints=\"3\" NumberOfVerts=\"3\" NumberOfPolys=\"0\""), "a.vtp", None),
            (xml("UnstructuredGrid", "NumberOfPoints=\"3\" NumberOfCells=\"2\""), "a.vtu", mesh),
            (xml("UnstructuredGrid", "NumberOfPoints=\"3\" NumberOfCells=\"3\""), "a.vtu", None),
            (xml("Collection", ""), "a.pvd", index),
            (xml("PUnstructuredGrid", ""), "a.pvtu", index),
            (xml("vtkMultiBlockDataSet", ""), "a.vtm", index),
            (xml("ImageData", ""), "a.vti", grid),
            (b"v 0 0 0\nv 1 0 0\nv 0 1 0\np 1 2 3\n".to_vec(), "a.obj", None),
            (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".to_vec(), "a.obj", mesh),
            (b"x,y,z\n0,0,0\n".to_vec(), "a.csv", None),
            (b"Time (s),p1,p2,p3\n0,1,2,3\n1,4,5,6\n".to_vec(), "gauge.csv", table),
            (b"# by hand\nstep energy\n0 1.5\n1 1.25\n".to_vec(), "energy.dat", table),
            (b"time,x,y,z\n0,0.1,0.1,0.1\n0.1,0.2,0.1,0.1\n".to_vec(), "probe.csv", table),
            (b"time,x,y,z\n0.5,0.1,0.1,0.1\n0.5,0.2,0.1,0.1\n".to_vec(), "a.csv", None),
            (b"0.0 1000 0.01\n0.1 1000 0.01\n".to_vec(), "energy.dat", table),
            (b"0.0 1000 0.01\n0.1 1000 0.01\n".to_vec(), "a.0001.dat", None),
            (b"# x y z\n0.1 0.2 0.3\n0.1 0.2 0.4\n".to_vec(), "a.dat", None),
            (b"1 0.1 0.2 0.3\n2 0.1 0.2 0.4\n".to_vec(), "a.1.dat", None),
            (b"# x y z\n0.1 0.2 0.3\n0.2 0.2 0.4\n".to_vec(), "a.dat", None),
            (Vec::new(), "a.vtk", None),
        ] {
            let shown = String::from_utf8_lossy(&bytes).into_owned();
            assert_eq!(neighbor(&bytes, name, &&bytes[..]), expected, "{name}: {shown}");
            // A file that is still being written is not mistaken for another.
            for length in 0..bytes.len() {
                let found = neighbor(&bytes[..length], name, &&bytes[..length]);
                assert!(found.is_none() || found == expected, "{name}, {length} bytes: {shown}");
            }
        }
    }

    /// Reading stops before the end of a long section of text.
    #[test]
    fn little_of_a_long_file_is_read() {
        let metadata = "METADATA\n".to_owned() + &"INFORMATION 0\n".repeat(2 << 20);
        let head = "# vtk DataFile Version 4.2\nt\nASCII\nDATASET POLYDATA\n";
        let text = format!("{head}{metadata}\nPOLYGONS 1 4\n");
        assert_eq!(neighbor(&text.as_bytes()[..8192], "a.vtk", &text.as_bytes()), None);
    }

    /// Programs without a header write all vertices before the first face.
    #[test]
    fn faces_at_the_end_of_a_long_obj_are_found() {
        let points = "v 0.25 0.5 0.75\n".repeat(20_000);
        let mesh = format!("{points}f 1 2 3\n");
        for (text, expected) in [(points, None), (mesh, Some(Neighbor::Mesh))] {
            assert_eq!(neighbor(&text.as_bytes()[..8192], "a.obj", &text.as_bytes()), expected);
        }
    }

    #[test]
    fn long_text_is_searched_in_pieces() {
        let line = "0.25 0.5 0.75\n";
        let points = line.repeat(20_000);
        let text =
            format!("# vtk DataFile Version 4.2\nt\nASCII\nDATASET POLYDATA\nPOINTS 20000 float\n{points}");
        let particles = format!("{text}VERTICES 1 2\n1 0\n");
        let mesh = format!("{text}POLYGONS 1 4\n3 0 1 2\n");
        for (text, expected) in [(particles, None), (mesh, Some(Neighbor::Mesh))] {
            assert_eq!(neighbor(&text.as_bytes()[..8192], "a.vtk", &text.as_bytes()), expected);
        }
    }
}
