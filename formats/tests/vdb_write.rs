//! Level sets written as .vdb: read by our own reader and two others, and checked for rules of the format
//! that readers do not check.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use crate::solids;

use std::collections::HashMap;

use meniscus_formats::vdb::{Compression, LevelSetData, MetaValue, WriteOptions, read_level_set, write};
use meniscus_formats::{LevelSetView, Limits};
use solids::{Dice, Solid};

const COMPRESSIONS: [Compression; 3] = [Compression::None, Compression::ActiveMask, Compression::Blosc];

fn provenance() -> Vec<(String, String)> {
    [("radius", "0.025"), ("kernel", "isotropic"), ("input", "größe.ply\nsecond line")]
        .map(|(key, value)| (key.to_string(), value.to_string()))
        .to_vec()
}

fn options(compression: Compression, half: bool) -> WriteOptions {
    WriteOptions { compression, half, ..WriteOptions::default() }
}

fn to_bytes(view: &LevelSetView, options: &WriteOptions) -> Vec<u8> {
    let mut bytes = Vec::new();
    write(view, options, &provenance(), &mut bytes).expect("writing to memory");
    bytes
}

fn read(bytes: &[u8]) -> LevelSetData {
    read_level_set(bytes, None, &Limits::default()).expect("reading our own file")
}

/// Looks up values by voxel as a renderer does: in leaves, then tiles, then the background.
struct Lookup<'a> {
    data: &'a LevelSetData,
    leaves: HashMap<[i32; 3], usize>,
    tiles: HashMap<([i32; 3], i32), f32>,
}

impl<'a> Lookup<'a> {
    fn new(data: &'a LevelSetData) -> Lookup<'a> {
        let leaves = data.origins.iter().enumerate().map(|(index, &origin)| (origin, index)).collect();
        let tiles = data.tiles.iter().map(|tile| ((tile.origin, tile.size), tile.value)).collect();
        Lookup { data, leaves, tiles }
    }

    fn value(&self, voxel: [i32; 3]) -> f32 {
        let corner = |size: i32| voxel.map(|c| c & !(size - 1));
        if let Some(&leaf) = self.leaves.get(&corner(8)) {
            let [x, y, z] = voxel.map(|c| (c & 7) as usize);
            return self.data.leaves[leaf][x << 6 | y << 3 | z];
        }
        let tile = [8, 128, 4096].into_iter().find_map(|size| self.tiles.get(&(corner(size), size)));
        tile.copied().unwrap_or(self.data.background)
    }
}

/// The expected value of a voxel.
fn expected(solid: &Solid, voxel: [i32; 3], half: bool) -> f32 {
    let round = |value: f32| if half { half_round(value) } else { value };
    let background = round((f64::from(solid.half_width_voxels) * solid.voxel_size) as f32);
    let world = round((f64::from((solid.distance)(voxel) as f32) * solid.voxel_size) as f32);
    world.clamp(-background, background)
}

/// Rounds to 11 significant bits, ties to even: a half float without its range limits.
fn half_round(value: f32) -> f32 {
    let bits = value.to_bits();
    if value.abs() < 6.2e-5 {
        return (value * 16777216.0).round_ties_even() / 16777216.0;
    }
    let odd = bits >> 13 & 1;
    f32::from_bits((bits + 0xfff + odd) & !0x1fff)
}

#[test]
fn own_reader_reads_every_value() {
    for (name, solid) in solids::all() {
        for compression in COMPRESSIONS {
            for half in [false, true] {
                let data = read(&to_bytes(&solid.view(), &options(compression, half)));
                assert_level_set(&format!("{name} {compression:?} half {half}"), &solid, &data, half);
            }
        }
    }
}

fn assert_level_set(name: &str, solid: &Solid, data: &LevelSetData, half: bool) {
    assert_eq!((data.name.as_str(), data.class.as_str()), ("surface", "level set"), "{name}");
    assert_eq!(data.transform.voxel_size(), [solid.voxel_size; 3], "{name}");
    let lookup = Lookup::new(data);
    for (&origin, leaf) in solid.origins.iter().zip(&solid.leaves) {
        let has_active = (0..512)
            .any(|i| expected(solid, voxel(origin, i), half).abs() < data.background && leaf[i].is_finite());
        let stored = lookup.leaves.get(&origin);
        assert_eq!(stored.is_some(), has_active, "{name}: leaf {origin:?}");
        for i in 0..512 {
            let value = lookup.value(voxel(origin, i));
            assert_eq!(value, expected(solid, voxel(origin, i), half), "{name}: {:?}", voxel(origin, i));
            if let Some(&index) = stored {
                let active = data.masks[index][i >> 6] >> (i & 63) & 1 == 1;
                assert_eq!(active, value.abs() < data.background, "{name}");
            }
        }
    }
    assert!(data.tiles.iter().all(|tile| !tile.active && tile.value == -data.background), "{name}");
    let mut dice = Dice(7);
    let (low, high) = bounds(solid);
    for _ in 0..100_000 {
        let voxel =
            std::array::from_fn(|axis| low[axis] + dice.below((high[axis] - low[axis]) as usize) as i32);
        assert_eq!(lookup.value(voxel), expected(solid, voxel, half), "{name}: {voxel:?}");
    }
}

fn voxel(origin: [i32; 3], i: usize) -> [i32; 3] {
    let i = i as i32;
    [origin[0] + (i >> 6), origin[1] + (i >> 3 & 7), origin[2] + (i & 7)]
}

/// The bounds of the leaves, extended by a leaf on each side.
fn bounds(solid: &Solid) -> ([i32; 3], [i32; 3]) {
    let on = |axis: usize| solid.origins.iter().map(move |origin| origin[axis]);
    (
        std::array::from_fn(|axis| on(axis).min().unwrap_or(0) - 8),
        std::array::from_fn(|axis| on(axis).max().unwrap_or(0) + 16),
    )
}

/// A ball so large that whole nodes of 128 voxels lie inside.
#[test]
fn fully_inside_nodes_are_tiles() {
    let solid = solids::sphere([3.0, 5.0, -4.0], 300.0);
    let data = read(&to_bytes(&solid.view(), &options(Compression::Blosc, false)));
    let lookup = Lookup::new(&data);
    assert!(data.tiles.iter().any(|tile| tile.size == 128));
    let mut dice = Dice(3);
    for _ in 0..200_000 {
        let voxel = std::array::from_fn(|_| dice.below(640) as i32 - 320);
        assert_eq!(lookup.value(voxel), expected(&solid, voxel, false), "{voxel:?}");
    }
}

#[test]
fn vdb_rs_reads_the_active_values() {
    for (name, solid) in solids::all() {
        for compression in COMPRESSIONS {
            let bytes = to_bytes(&solid.view(), &options(compression, false));
            let data = read(&bytes);
            let mut reader = vdb_rs::VdbReader::new(std::io::Cursor::new(bytes)).expect(name);
            let grid = reader.read_grid::<f32>("surface").expect(name);
            let mut count = 0;
            let lookup = Lookup::new(&data);
            for node3 in
                grid.tree.root_nodes.iter().flat_map(|n| n.nodes.values()).flat_map(|n| n.nodes.values())
            {
                count += 1;
                let index = lookup.leaves[&node3.origin.to_array()];
                for i in 0..512 {
                    let active = data.masks[index][i >> 6] >> (i & 63) & 1 == 1;
                    assert_eq!(node3.value_mask[i], active, "{name}");
                    assert!(!active || node3.buffer[i] == data.leaves[index][i], "{name}");
                }
            }
            assert_eq!(count, data.leaves.len(), "{name}");
        }
    }
}

#[test]
fn openvdb_rs_accepts_the_level_set() {
    for (name, solid) in solids::all() {
        for compression in COMPRESSIONS {
            for half in [false, true] {
                let bytes = to_bytes(&solid.view(), &options(compression, half));
                let data = read(&bytes);
                let (_, grids) = vdb::io::read_stream(&bytes[..]).expect(name);
                let [vdb::AnyGrid::Float(grid)] = &grids[..] else { panic!("{name}: not one float grid") };
                assert_openvdb_rs(&format!("{name} {compression:?} half {half}"), &solid, grid, &data);
            }
        }
    }
}

fn assert_openvdb_rs(name: &str, solid: &Solid, grid: &vdb::FloatGrid, data: &LevelSetData) {
    if !data.origins.is_empty() {
        // The background, rounded to a half float, may be slightly less than three voxels.
        let checks = if grid.save_float_as_half() { [4..4, 5..9] } else { [1..9, 0..0] };
        let mut check = vdb::tools::diagnostics::CheckLevelSet::new(grid);
        for n in checks.into_iter().flatten() {
            let found = match n {
                5 => check.check_tiles(),
                6 => check.check_finite(false),
                7 => check.check_range(false),
                8 => check.check_inactive_values(false),
                n => check.check(n, false),
            };
            assert_eq!(found, "", "{name}");
        }
    }
    assert_eq!(grid.tree().leaf_count(), data.leaves.len(), "{name}");
    let active: u32 = data.masks.iter().flatten().map(|word| word.count_ones()).sum();
    assert_eq!(grid.active_voxel_count(), u64::from(active), "{name}");
    let count = data.metadata.iter().find(|(key, _)| key == "file_voxel_count").map(|(_, value)| value);
    assert_eq!(count, Some(&MetaValue::Integer(i64::from(active))), "{name}");
    let at = |[x, y, z]: [i32; 3]| vdb::Coord::new(x, y, z);
    for (origin, leaf) in data.origins.iter().zip(&data.leaves) {
        for (i, value) in leaf.iter().enumerate() {
            assert_eq!(grid.get_value(&at(voxel(*origin, i))), *value, "{name}");
        }
    }
    let (lookup, (low, high), mut dice) = (Lookup::new(data), bounds(solid), Dice(11));
    for _ in 0..20_000 {
        let voxel =
            std::array::from_fn(|axis| low[axis] + dice.below((high[axis] - low[axis]) as usize) as i32);
        assert_eq!(grid.get_value(&at(voxel)), lookup.value(voxel), "{name}");
    }
    if data.origins.is_empty() {
        return;
    }
    let bounds = grid.eval_active_voxel_bbox();
    let corner = |key: &str| match data.metadata.iter().find(|(name, _)| name == key) {
        Some((_, MetaValue::Vec3i(coord))) => at(*coord),
        other => panic!("{name}: {other:?}"),
    };
    assert_eq!((bounds.min, bounds.max), (corner("file_bbox_min"), corner("file_bbox_max")), "{name}");
}

#[test]
fn bytes_do_not_depend_on_threads_or_leaf_order() {
    let solid = solids::shell(60.0, 30.0);
    let reference = to_bytes(&solid.view(), &WriteOptions::default());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(7).build().expect("threads");
    assert!(pool.install(|| to_bytes(&solid.view(), &WriteOptions::default())) == reference);
    let mut pairs: Vec<_> = solid.origins.iter().copied().zip(solid.leaves.iter().copied()).collect();
    pairs.sort_by_key(|(origin, _)| origin.map(|c| c.wrapping_mul(0x9e3779b1u32 as i32)));
    let (origins, leaves): (Vec<_>, Vec<_>) = pairs.into_iter().unzip();
    let view = LevelSetView { origins: &origins, leaves: &leaves, ..solid.view() };
    assert!(to_bytes(&view, &WriteOptions::default()) == reference);
}

#[test]
fn uuid_depends_on_content() {
    let uuid = |bytes: &[u8]| String::from_utf8(bytes[21..57].to_vec()).expect("ASCII");
    let solid = solids::sphere([0.0; 3], 20.0);
    let reference = to_bytes(&solid.view(), &WriteOptions::default());
    let mut other = Vec::new();
    write(&solid.view(), &WriteOptions::default(), &[], &mut other).expect("writing to memory");
    assert_ne!(uuid(&reference), uuid(&other));
    let moved = WriteOptions { origin: [1e6, 0.0, 0.1], ..WriteOptions::default() };
    let moved = to_bytes(&solid.view(), &moved);
    assert_ne!(uuid(&reference), uuid(&moved));
    assert_eq!(read(&moved).transform.translation, [1e6, 0.0, 0.1]);
    assert_eq!(read(&moved).transform.voxel_size(), [0.05; 3]);
}

/// Walks through the bytes by the rules of the format, without our reader.
struct Walk<'a>(&'a [u8]);

impl Walk<'_> {
    fn take(&mut self, count: usize) -> &[u8] {
        let (taken, rest) = self.0.split_at(count);
        self.0 = rest;
        taken
    }
    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take(4).try_into().expect("four bytes"))
    }
    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take(8).try_into().expect("eight bytes"))
    }
    fn string(&mut self) -> String {
        let length = self.u32() as usize;
        String::from_utf8(self.take(length).to_vec()).expect("UTF-8")
    }
    fn metadata(&mut self) -> Vec<(String, String, Vec<u8>)> {
        (0..self.u32())
            .map(|_| {
                let (name, kind, length) = (self.string(), self.string(), self.u32() as usize);
                (name, kind, self.take(length).to_vec())
            })
            .collect()
    }
    fn children(&mut self, slots: usize) -> usize {
        let children = self.take(slots / 8).iter().map(|byte| byte.count_ones() as usize).sum();
        assert!(self.take(slots / 8).iter().all(|byte| *byte == 0), "an active tile");
        children
    }
    /// Skips the values of an internal node. Only active values are stored, and it has none.
    fn values(&mut self, slots: usize, prefix: usize) {
        match self.take(1)[0] {
            0 | 1 => {}
            3 => drop(self.take(slots / 8).to_vec()),
            case => panic!("case {case} in a level set"),
        }
        assert!(self.take(prefix).iter().all(|byte| *byte == 0));
    }
}

#[test]
fn output_follows_rules_that_readers_do_not_check() {
    // The solid has eight root children around the origin, with negative and positive coordinates.
    let solid = solids::sphere([0.5, 0.5, 0.5], 30.0);
    for compression in [Compression::ActiveMask, Compression::Blosc] {
        for half in [false, true] {
            let bytes = to_bytes(&solid.view(), &options(compression, half));
            let leaf_count = read(&bytes).leaves.len();
            let mut walk = Walk(&bytes);
            assert_eq!(walk.take(8), b" BDV\0\0\0\0");
            assert_eq!([walk.u32(), walk.u32(), walk.u32()], [224, 10, 0]);
            assert_eq!(walk.take(1), [1]);
            walk.take(36);
            assert_eq!([walk.u32(), walk.u32()], [0, 1]);
            assert_eq!(walk.string(), "surface");
            assert_eq!(walk.string(), if half { "Tree_float_5_4_3_HalfFloat" } else { "Tree_float_5_4_3" });
            assert_eq!(walk.string(), "");
            let (grid, block, end) = (walk.u64(), walk.u64(), walk.u64());
            let position = |walk: &Walk| (bytes.len() - walk.0.len()) as u64;
            assert_eq!((grid, end), (position(&walk), bytes.len() as u64));
            assert_eq!(walk.u32(), if compression == Compression::Blosc { 6 } else { 2 });
            let metadata = walk.metadata();
            let flag = metadata.iter().find(|(name, ..)| name == "is_saved_as_half_float");
            assert_eq!(
                flag.map(|(_, kind, value)| (kind.as_str(), &value[..])),
                half.then_some(("bool", &[1][..]))
            );
            assert!(
                metadata
                    .iter()
                    .any(|(name, kind, _)| (name.as_str(), kind.as_str()) == ("file_mem_bytes", "int64"))
            );
            assert_eq!(walk.string(), "UniformScaleMap");
            walk.take(15 * 8);
            walk.u32();
            let background = f32::from_bits(walk.u32());
            assert_eq!(background, if half { half_round(0.15) } else { 0.15 });
            assert_eq!([walk.u32(), walk.u32()], [0, 8]);
            let prefix = if compression == Compression::Blosc && !half { 8 } else { 0 };
            let mut origins = Vec::new();
            let mut leaves = 0;
            for _ in 0..8 {
                origins.push([walk.u32() as i32, walk.u32() as i32, walk.u32() as i32]);
                let nodes = walk.children(32768);
                walk.values(32768, prefix);
                for _ in 0..nodes {
                    let masks = walk.children(4096);
                    walk.values(4096, prefix);
                    walk.take(64 * masks);
                    leaves += masks;
                }
            }
            assert!(origins.is_sorted() && origins[0] == [-4096; 3] && origins[7] == [0; 3]);
            assert_eq!((leaves, position(&walk)), (leaf_count, block));
        }
    }
}

#[test]
fn invalid_level_sets_are_an_error() {
    let leaf = [0.5f32; 512];
    let view = LevelSetView {
        origins: &[[0, 8, 16]],
        leaves: &[leaf],
        half_width_voxels: 3.0,
        voxel_size: 0.1,
        grids: &[],
    };
    let refuse = |view: LevelSetView, options: WriteOptions, part: &str| {
        let error = write(&view, &options, &[], &mut Vec::new()).expect_err(part).to_string();
        assert!(error.contains(part), "{error}");
    };
    let default = WriteOptions::default;
    refuse(LevelSetView { origins: &[], ..view }, default(), "0 leaf origins");
    refuse(LevelSetView { origins: &[[0, 4, 0]], ..view }, default(), "multiple of 8");
    refuse(LevelSetView { origins: &[[0; 3]; 2], leaves: &[leaf; 2], ..view }, default(), "twice");
    refuse(LevelSetView { voxel_size: f64::NAN, ..view }, default(), "positive and finite");
    refuse(LevelSetView { half_width_voxels: 0.0, ..view }, default(), "positive and finite");
    refuse(LevelSetView { voxel_size: 1e6, ..view }, WriteOptions { half: true, ..default() }, "16 bits");
    let mut broken = leaf;
    broken[77] = f32::NAN;
    refuse(LevelSetView { leaves: &[broken], ..view }, default(), "[0, 8, 16]");
}
