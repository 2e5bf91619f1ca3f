//! Reading in batches gives the same positions, notes and errors as reading the whole file.

use std::path::Path;

use meniscus_formats::{
    Error, FilePositions, Limits, ParticleBatch, ParticleBatches, ParticleFrame, bgeo, ply, read_particles,
};

const BATCH_BYTES: [usize; 4] = [1, 100, 5000, 1 << 22];

/// The positions of all batches, read from last to first into the same buffer; `None` if the file cannot be
/// read in batches.
fn read_in_batches(
    bytes: &[u8],
    limits: &Limits,
    batch_bytes: usize,
) -> Result<Option<ParticleFrame>, Error> {
    let Some(batches) = ParticleBatches::open(bytes, "f", limits, batch_bytes)? else { return Ok(None) };
    let mut batch = ParticleBatch::default();
    let mut frame = ParticleFrame { notes: batches.notes().to_vec(), ..ParticleFrame::default() };
    for index in (0..batches.batch_count()).rev() {
        batches.read_batch(index, &mut batch)?;
        assert_eq!(batch.positions.len(), batches.particle_range(index).len());
        assert!(!batch.positions.is_empty(), "batch {index}");
        frame.positions = match (&batch.positions, frame.positions) {
            (FilePositions::F32(batch), FilePositions::F32(after)) => {
                FilePositions::F32([&batch[..], &after].concat())
            }
            (FilePositions::F64(batch), FilePositions::F64(after)) => {
                FilePositions::F64([&batch[..], &after].concat())
            }
            (first, after) if after.is_empty() => first.clone(),
            (first, after) => panic!("{first:?} before {after:?}"),
        };
    }
    assert_eq!(frame.positions.len(), batches.particle_count());
    Ok(Some(frame))
}

/// Compares reading in batches with reading the whole file. Returns whether the file can be read in batches.
fn check(name: &str, bytes: &[u8], limits: &Limits) -> bool {
    let whole = read_particles(bytes, "f", limits);
    let mut is_streamed = false;
    for batch_bytes in BATCH_BYTES {
        match (read_in_batches(bytes, limits, batch_bytes), &whole) {
            (Ok(None), _) => {}
            (Ok(Some(frame)), Ok(whole)) => {
                is_streamed = true;
                // The positions are compared as bits, because NaN is not equal to itself.
                assert!(bits(&frame.positions) == bits(&whole.positions), "{name}: {batch_bytes} bytes");
                assert_eq!(frame.notes, whole.notes, "{name}");
            }
            (Err(error), Err(whole)) => assert_eq!(error.to_string(), whole.to_string(), "{name}"),
            (batches, whole) => panic!("{name}: {batches:?} in batches, {whole:?} whole"),
        }
    }
    is_streamed
}

fn bits(positions: &FilePositions) -> Vec<u64> {
    match positions {
        FilePositions::F32(positions) => {
            positions.as_flattened().iter().map(|c| c.to_bits().into()).collect()
        }
        FilePositions::F64(positions) => positions.as_flattened().iter().map(|c| c.to_bits()).collect(),
    }
}

fn corpus(folder: &str) -> Vec<(String, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(folder);
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let files = entries.filter(|path| path.extension().is_some_and(|extension| extension == "ply"));
    files.map(|path| (path.display().to_string(), std::fs::read(&path).unwrap())).collect()
}

fn written_bgeo() -> Vec<u8> {
    let (_, source) =
        corpus("valid").into_iter().find(|(name, _)| name.ends_with("taichi_000007.ply")).unwrap();
    let mut bytes = Vec::new();
    bgeo::write(&ply::read(&source, &Limits::default()).unwrap(), &mut bytes).unwrap();
    bytes
}

#[test]
fn batches_match_reading_whole_files() {
    let mut streamed_count = 0;
    for (name, bytes) in corpus("valid").into_iter().chain(corpus("invalid")) {
        streamed_count += usize::from(check(&name, &bytes, &Limits::default()));
    }
    assert!(streamed_count >= 5, "{streamed_count} files of the corpus are read in batches");
    assert!(check("written.bgeo", &written_bgeo(), &Limits::default()));
}

#[test]
fn batches_have_the_attributes_of_the_whole_file() {
    let mut attribute_count = 0;
    for (name, bytes) in corpus("valid").into_iter().chain([("written.bgeo".into(), written_bgeo())]) {
        let batches = ParticleBatches::open(&bytes[..], "f", &Limits::default(), 500);
        let Ok(Some(batches)) = batches else { continue };
        let whole = read_particles(&bytes, "f", &Limits::default()).unwrap();
        for index in 0..=batches.batch_count() {
            let range = batches.particle_range(index);
            let mut part = whole.clone();
            part.retain(&(0..whole.positions.len()).map(|i| range.contains(&i)).collect::<Vec<_>>());
            let frame = batches.read_frame(index).unwrap();
            // As text, because NaN is not equal to itself.
            let data = |frame: &ParticleFrame| format!("{:?}", (&frame.positions, &frame.attributes));
            assert_eq!(data(&frame), data(&part), "{name}: batch {index}");
            attribute_count += frame.attributes.len();
        }
    }
    assert!(attribute_count > 10, "{attribute_count}");
}

#[test]
fn both_byte_orders_and_all_types_are_read_in_batches() {
    for encoding in ["binary_little_endian", "binary_big_endian"] {
        for types in ["float double uchar", "char short ushort", "int uint double", "float float float"] {
            let properties = types.split(' ').zip(["y", "x", "z"]);
            let properties: String =
                properties.map(|(kind, name)| format!("property {kind} {name}\n")).collect();
            let file = |before: &str, count: usize, after: &str| {
                let header = format!(
                    "ply\nformat {encoding} 1.0\n{before}element vertex {count}\n{properties}{after}end_header\n"
                );
                let body = (0..4000_usize).map(|index| (index * 37 % 251).to_le_bytes()[0]);
                [header.into_bytes(), body.collect()].concat()
            };
            let limits = Limits::default();
            let two = "element other 2\nproperty int k\n";
            let faces = "element face 1\nproperty list uchar int vertex_index\n";
            assert!(check(types, &file("", 150, ""), &limits));
            assert!(check(types, &file(two, 150, faces), &limits));
            assert!(check(types, &file("", 0, faces), &limits));
            assert!(!check(types, &file(faces, 10, ""), &limits));
            assert!(!check(types, &file("", 4000, ""), &limits), "the file has too few records");
            assert!(!check(types, &file(two, 10, ""), &Limits { particle_count: 9, ..limits }));
        }
    }
}

#[test]
fn headers_of_any_length_are_read_in_batches() {
    for line_count in [10, 3000, 30_000] {
        let comments = "comment nothing that matters here\n".repeat(line_count);
        let file = format!(
            "ply\nformat binary_little_endian 1.0\n{comments}element vertex 2\nproperty float x\nproperty float y\n\
             property float z\nend_header\nabcdefghijklmnopqrstuvwx"
        );
        assert!(check("comments", file.as_bytes(), &Limits::default()));
        assert!(!check("comments", file.as_bytes(), &Limits { header_bytes: 300, ..Limits::default() }));
        for cut in [100, 70_000, 900_000, file.len() - 25, file.len() - 1] {
            assert!(!check("cut", &file.as_bytes()[..cut.min(file.len() - 1)], &Limits::default()));
        }
    }
}

#[test]
fn damage_gives_the_same_error_as_reading_whole() {
    let mut state = 1_u32;
    let mut below = |bound: usize| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as usize % bound
    };
    let files = corpus("valid").into_iter().filter(|(name, bytes)| check(name, bytes, &Limits::default()));
    for (name, bytes) in files.chain([("written.bgeo".into(), written_bgeo())]).collect::<Vec<_>>() {
        for cut in (0..bytes.len()).step_by(bytes.len().div_ceil(150)) {
            check(&name, &bytes[..cut], &Limits::default());
        }
        for _ in 0..300 {
            let mut damaged = bytes.clone();
            for _ in 0..1 + below(3) {
                let range = [damaged.len(), damaged.len().min(512)][below(2)];
                damaged[below(range)] ^= 1 << below(8);
            }
            check(&name, &damaged, &Limits::default());
        }
    }
}

#[test]
fn file_that_becomes_shorter_is_a_short_error() {
    let bytes = written_bgeo();
    let shrinking = Shrinking { bytes: &bytes, length: std::sync::atomic::AtomicUsize::new(bytes.len()) };
    let batches = ParticleBatches::open(&shrinking, "f", &Limits::default(), 1000).unwrap().unwrap();
    let mut batch = ParticleBatch::default();
    batches.read_batch(batches.batch_count() - 1, &mut batch).unwrap();
    shrinking.length.store(bytes.len() / 2, std::sync::atomic::Ordering::Relaxed);
    batches.read_batch(0, &mut batch).unwrap();
    let error = batches.read_batch(batches.batch_count() - 1, &mut batch).unwrap_err();
    assert!(error.is_truncated(), "{error}");
}

struct Shrinking<'a> {
    bytes: &'a [u8],
    length: std::sync::atomic::AtomicUsize,
}

impl meniscus_formats::ReadAt for Shrinking<'_> {
    fn size_bytes(&self) -> std::io::Result<u64> {
        self.bytes.size_bytes()
    }

    fn read_exact_at(&self, out: &mut [u8], offset: u64) -> std::io::Result<()> {
        let length = self.length.load(std::sync::atomic::Ordering::Relaxed);
        self.bytes[..length].read_exact_at(out, offset)
    }
}
