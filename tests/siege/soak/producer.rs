//! A badly behaved producer: it writes in every possible way, rewrites, deletes, and damages its files.

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::{Duration, SystemTime};

use meniscus_formats::{Limits, read_particles};

use crate::siege::scene::box_ply;

use super::random::Random;

/// Writes frames into a folder, and damages them.
pub(super) struct Producer {
    folder: PathBuf,
    outputs: PathBuf,
    random: Random,
    act_count: usize,
}

/// Number of frames of each form.
const NUMBER_COUNT: u64 = 25;

/// The forms of frames: the name before the number, the name after it, and a function that makes the bytes.
const FORMS: [(&str, &str, Form); 4] = [
    ("dam", "ply", |edges, shift| box_ply(edges, shift)),
    ("spray", "ply", text_ply),
    ("foam", "csv", csv),
    ("mist", "npy", npy),
];

/// Turns a box of particles into the bytes of a file.
type Form = fn([usize; 3], f32) -> Vec<u8>;

type Act = fn(&mut Producer);

/// The operations of the producer, with their relative frequencies.
const ACTS: [(u64, Act); 13] = [
    (40, Producer::put),
    (15, Producer::write_in_place),
    (8, Producer::write_slowly),
    (8, Producer::delete),
    (5, Producer::truncate),
    (5, Producer::garble_the_head),
    (3, Producer::empty),
    (4, Producer::flip_bytes),
    (3, Producer::append),
    (4, Producer::touch),
    (4, Producer::rename_onto_another),
    (2, Producer::copy),
    (2, Producer::delete_outputs),
];

impl Producer {
    pub(super) fn new(folder: &Path, random: Random) -> Producer {
        Producer { folder: folder.join("in"), outputs: folder.join("out"), random, act_count: 0 }
    }

    pub(super) fn act_count(&self) -> usize {
        self.act_count
    }

    /// Performs one random operation.
    pub(super) fn act(&mut self) {
        self.act_count += 1;
        let mut drawn = self.random.below(ACTS.iter().map(|(weight, _)| weight).sum());
        for (weight, act) in ACTS {
            if drawn < weight {
                return act(self);
            }
            drawn -= weight;
        }
    }

    /// Writes other files that are usual in such folders.
    pub(super) fn clutter(&self) {
        fs::create_dir(self.folder.join("dam.900.ply")).expect("made");
        fs::write(self.folder.join(".dam.901.ply"), "hidden").expect("written");
        fs::write(self.folder.join("notes.txt"), "not a frame").expect("written");
        symlink("nowhere", self.folder.join("dam.902.ply")).expect("linked");
        symlink(".", self.folder.join("itself")).expect("linked");
        let pipe = self.folder.join("dam.903.ply");
        assert!(Command::new("mkfifo").arg(pipe).status().expect("mkfifo runs").success());
    }

    /// Rewrites most of the unreadable frames.
    pub(super) fn repair_most(&mut self) {
        for (path, form) in self.frames() {
            let Ok(bytes) = fs::read(&path) else { continue };
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let is_broken = read_particles(&bytes, &name, &Limits::default()).is_err();
            if is_broken && self.random.below(4) > 0 {
                let content = self.content(form);
                self.rename_into_place(&path, &content);
            }
        }
    }

    fn put(&mut self) {
        let (path, form) = self.any();
        let content = self.content(form);
        self.rename_into_place(&path, &content);
    }

    fn write_in_place(&mut self) {
        let (path, form) = self.any();
        fs::write(path, self.content(form)).expect("written");
    }

    /// Writes a frame in pieces, with pauses between some of them.
    fn write_slowly(&mut self) {
        let (path, form) = self.any();
        let content = self.content(form);
        let mut file = File::create(path).expect("made");
        for piece in content.chunks(content.len() / 3 + 1) {
            file.write_all(piece).expect("written");
            thread::sleep(Duration::from_millis(self.random.below(150)));
        }
    }

    fn delete(&mut self) {
        // The file may be missing.
        let _ = fs::remove_file(self.any().0);
    }

    fn truncate(&mut self) {
        self.change(|bytes, random| bytes.truncate(random.index(bytes.len())));
    }

    fn garble_the_head(&mut self) {
        self.change(|bytes, random| {
            let count = bytes.len().min(20);
            bytes[..count].iter_mut().for_each(|byte| *byte = random.below(256) as u8);
        });
    }

    fn empty(&mut self) {
        self.change(|bytes, _| bytes.clear());
    }

    /// Changes a few bytes at random positions. Most of them are in numbers, which then differ, are too
    /// large, or are invalid.
    fn flip_bytes(&mut self) {
        self.change(|bytes, random| {
            for _ in 0..4 {
                let index = random.index(bytes.len());
                if let Some(byte) = bytes.get_mut(index) {
                    *byte ^= 1 << random.below(8);
                }
            }
        });
    }

    fn append(&mut self) {
        self.change(|bytes, _| bytes.extend(b"and more that nobody asked for"));
    }

    /// Sets the modification time of a frame to the past or to the future.
    fn touch(&mut self) {
        let day = Duration::from_secs(86_400);
        let days = u32::try_from(self.random.below(4000)).expect("few");
        let is_past = self.random.below(2) == 0;
        let now = SystemTime::now();
        let time = if is_past { now.checked_sub(day * days) } else { now.checked_add(day * days) };
        if let (Ok(file), Some(time)) = (OpenOptions::new().append(true).open(self.any().0), time) {
            file.set_modified(time).expect("touched");
        }
    }

    fn rename_onto_another(&mut self) {
        let (from, _) = self.any();
        let to = self.another_like(&from);
        // The file may be missing.
        let _ = fs::rename(from, to);
    }

    fn copy(&mut self) {
        let (from, _) = self.any();
        let to = self.another_like(&from);
        if from != to {
            // The file may be missing.
            let _ = fs::copy(from, to);
        }
    }

    /// Deletes all outputs of a frame, or one of them.
    fn delete_outputs(&mut self) {
        let (path, _) = self.any();
        let Some(stem) = path.file_stem() else { return };
        let count = 1 + self.random.index(2);
        for extension in ["glb", "vdb"].iter().take(count) {
            let name = format!("{}.{extension}", stem.to_string_lossy());
            // The file may be missing.
            let _ = fs::remove_file(self.outputs.join(name));
        }
    }

    /// Changes a frame in place, if it exists.
    fn change(&mut self, change: impl Fn(&mut Vec<u8>, &mut Random)) {
        let (path, _) = self.any();
        if let Ok(mut bytes) = fs::read(&path) {
            change(&mut bytes, &mut self.random);
            fs::write(path, bytes).expect("written");
        }
    }

    fn rename_into_place(&self, path: &Path, content: &[u8]) {
        let hidden = self.folder.join(".part");
        fs::write(&hidden, content).expect("written");
        fs::rename(hidden, path).expect("renamed");
    }

    /// All names that frames may have, and their forms.
    fn frames(&self) -> Vec<(PathBuf, Form)> {
        let numbers = 1..=NUMBER_COUNT;
        let frames = FORMS.iter().flat_map(|&(stem, extension, form)| {
            let names = numbers.clone().map(move |number| format!("{stem}.{number}.{extension}"));
            names.map(move |name| (self.folder.join(name), form))
        });
        frames.collect()
    }

    fn any(&mut self) -> (PathBuf, Form) {
        let frames = self.frames();
        frames[self.random.index(frames.len())].clone()
    }

    /// A random frame of the same form, which may be the same frame.
    fn another_like(&mut self, path: &Path) -> PathBuf {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let number = 1 + self.random.below(NUMBER_COUNT);
        let parts: Vec<&str> = name.split('.').collect();
        self.folder.join(format!("{}.{number}.{}", parts[0], parts[2]))
    }

    /// The bytes of a frame: a box of random size and position.
    fn content(&mut self, form: Form) -> Vec<u8> {
        let edges = [(); 3].map(|()| 4 + self.random.index(4));
        form(edges, 0.01 * self.random.below(400) as f32)
    }
}

/// The positions of `box_ply`.
fn positions([x_count, y_count, z_count]: [usize; 3], shift: f32) -> impl Iterator<Item = [f32; 3]> {
    (0..x_count * y_count * z_count).map(move |index| {
        let [x, y, z] = [index % x_count, index / x_count % y_count, index / (x_count * y_count)];
        [0.1 * x as f32 + shift, 0.1 * y as f32, 0.1 * z as f32]
    })
}

fn text_ply(edges: [usize; 3], shift: f32) -> Vec<u8> {
    let count: usize = edges.iter().product();
    let header = format!(
        "ply\nformat ascii 1.0\nelement vertex {count}\n\
         property float x\nproperty float y\nproperty float z\nend_header\n"
    );
    let lines = positions(edges, shift).map(|[x, y, z]| format!("{x} {y} {z}\n"));
    (header + &lines.collect::<String>()).into_bytes()
}

fn csv(edges: [usize; 3], shift: f32) -> Vec<u8> {
    let lines = positions(edges, shift).map(|[x, y, z]| format!("{x},{y},{z}\n"));
    ("x,y,z\n".to_owned() + &lines.collect::<String>()).into_bytes()
}

/// An array of NumPy, version 1.0.
fn npy(edges: [usize; 3], shift: f32) -> Vec<u8> {
    let count: usize = edges.iter().product();
    let mut header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({count}, 3), }}");
    while (10 + header.len() + 1) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend(u16::try_from(header.len()).expect("short").to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(positions(edges, shift).flatten().flat_map(f32::to_le_bytes));
    bytes
}
