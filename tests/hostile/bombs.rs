//! Decompression bombs: ten megabytes that unpack to ten gigabytes. The program must refuse them early.

use std::io::Write;

use flate2::Compression;
use flate2::write::{DeflateEncoder, GzEncoder, ZlibEncoder};

use crate::hostile::scene::{Scene, is_long, ply_header};

/// Number of bytes of a piece. All pieces together have 10 GiB, or a tenth of that in the short form.
const PIECE_BYTES: usize = 64 << 20;

fn piece_count() -> usize {
    if is_long() { 160 } else { 16 }
}

/// Limit of the memory: for the program, for the valid frames, and for unpacked data in a growing buffer
/// until the limit on the compression ratio applies.
const BYTES_MAX: u64 = 256 << 20;

const RATIO: &str = "more than 200 times its compressed size";

/// Compressed zeros.
fn zeros<W: Write>(mut encoder: W, finish: impl Fn(W) -> Vec<u8>) -> Vec<u8> {
    let piece = vec![0; 1 << 20];
    (0..PIECE_BYTES >> 20).for_each(|_| encoder.write_all(&piece).expect("packed"));
    finish(encoder)
}

#[test]
fn gzip_bombs_are_refused() {
    let scene = Scene::new();
    let start = gzipped(b"x,y,z\n0,0,0\n");
    let member =
        zeros(GzEncoder::new(Vec::new(), Compression::best()), |encoder| encoder.finish().expect("packed"));
    scene.write("in/bomb.1.csv.gz", [start, member.repeat(piece_count())].concat());
    scene.assert_costs_itself_alone("bomb.1.csv.gz", RATIO, BYTES_MAX);
}

#[test]
fn zstd_bombs_are_refused() {
    let scene = Scene::new();
    let frame = ruzstd::encoding::compress_to_vec(
        &vec![0; PIECE_BYTES][..],
        ruzstd::encoding::CompressionLevel::Fastest,
    );
    let start = ruzstd::encoding::compress_to_vec(
        &ply_header(800_000_000)[..],
        ruzstd::encoding::CompressionLevel::Fastest,
    );
    scene.write("in/bomb.1.ply.zst", [start, frame.repeat(piece_count())].concat());
    scene.assert_costs_itself_alone("bomb.1.ply.zst", RATIO, BYTES_MAX);
}

fn gzipped(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes).expect("packed");
    encoder.finish().expect("packed")
}

#[test]
fn numpy_bombs_are_refused() {
    let scene = Scene::new();
    let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (5592394, 3), }";
    let start = [&b"\x93NUMPY\x01\0v\0"[..], format!("{header:<117}\n").as_bytes()].concat();
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(&start).expect("packed");
    let packed = zeros(encoder, |encoder| encoder.finish().expect("packed"));
    let names: Vec<String> = (0..piece_count()).map(|number| format!("pos{number}.npy")).collect();
    let length = start.len() + PIECE_BYTES;
    scene.write("in/bomb.1.npz", archive(&names, &packed, length as u32, 8));
    scene.assert_costs_itself_alone("bomb.1.npz", RATIO, BYTES_MAX);
}

/// A ZIP archive with the same bytes under several names.
pub(crate) fn archive(names: &[String], packed: &[u8], length: u32, method: u8) -> Vec<u8> {
    let (mut bytes, mut directory) = (Vec::new(), Vec::new());
    for name in names {
        let offset = bytes.len() as u32;
        let mut common = vec![20, 0, 0, 0, method, 0, 0, 0, 0x21, 0];
        for number in [0, packed.len() as u32, length] {
            common.extend(number.to_le_bytes());
        }
        common.extend((name.len() as u16).to_le_bytes());
        common.extend([0, 0]);
        bytes.extend([b"PK\x03\x04", &common[..], name.as_bytes(), packed].concat());
        directory.extend([b"PK\x01\x02\x14\0", &common[..], &[0; 10], &offset.to_le_bytes()].concat());
        directory.extend(name.as_bytes());
    }
    let (count, start) = ((names.len() as u16).to_le_bytes(), (bytes.len() as u32).to_le_bytes());
    let size = (directory.len() as u32).to_le_bytes();
    bytes.extend(directory);
    bytes.extend([&b"PK\x05\x06\0\0\0\0"[..], &count, &count, &size, &start, &[0, 0]].concat());
    bytes
}

/// VTK data in blocks that zlib compressed.
#[test]
fn vtk_bombs_are_refused() {
    let scene = Scene::new();
    let block =
        zeros(ZlibEncoder::new(Vec::new(), Compression::best()), |encoder| encoder.finish().expect("packed"));
    let count = piece_count();
    let points = PIECE_BYTES * count / 12;
    let mut bytes = format!(
        "<VTKFile type=\"PolyData\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\" \
         compressor=\"vtkZLibDataCompressor\"><PolyData><Piece NumberOfPoints=\"{points}\" NumberOfVerts=\"0\" \
         NumberOfLines=\"0\" NumberOfStrips=\"0\" NumberOfPolys=\"0\"><Points><DataArray type=\"Float32\" Name=\"Points\" \
         NumberOfComponents=\"3\" format=\"appended\" offset=\"0\"/></Points></Piece></PolyData>\
         <AppendedData encoding=\"raw\">_"
    )
    .into_bytes();
    let rest = points * 12 - PIECE_BYTES * (count - 1);
    for number in [count, PIECE_BYTES, rest].into_iter().chain(vec![block.len(); count]) {
        bytes.extend((number as u64).to_le_bytes());
    }
    bytes.extend(block.repeat(count));
    bytes.extend(b"</AppendedData></VTKFile>");
    scene.write("in/bomb.1.vtp", bytes);
    scene.assert_costs_itself_alone("bomb.1.vtp", RATIO, BYTES_MAX);
}

/// Blosc blocks with LZ4 in Houdini's container. The compression ratio of LZ4 is at most 255.
#[test]
fn houdini_bombs_are_refused() {
    let scene = Scene::new();
    let piece = vec![0; 1 << 20];
    let packed = lz4_flex::block::compress(&piece);
    let body = [&20u32.to_le_bytes()[..], &(packed.len() as u32).to_le_bytes(), &packed].concat();
    let mut frame = vec![2, 1, 0x31, 1];
    for number in [piece.len(), piece.len(), 16 + body.len()] {
        frame.extend((number as u32).to_le_bytes());
    }
    frame.extend(body);
    let count = piece_count() << 6;
    let mut bytes = b"scf1\0\0\0\0\0\0\0\x04meta".to_vec();
    bytes.extend(frame.repeat(count));
    let offsets = (1..count).map(|number| number * frame.len());
    let index: Vec<u8> =
        offsets.chain([piece.len(), piece.len()]).flat_map(|number| (number as u64).to_be_bytes()).collect();
    bytes.extend([&index[..], &(index.len() as u64).to_be_bytes(), b"1fcs"].concat());
    scene.write("in/bomb.1.bgeo.sc", bytes);
    scene.assert_costs_itself_alone("bomb.1.bgeo.sc", RATIO, BYTES_MAX);
}
