//! Tests of the public API, and of invalid input.

use std::io;
use std::ops::RangeInclusive;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex};

use glam::DVec3;

use super::*;
use crate::options::{AnisotropyKind, AttributeSelection, ClipBox, Integrator, LengthUnit, Preset};
use crate::particles::{AttributeValues, OwnedPositions, Role};
use crate::reconstruction::reconstruct_frame;
use crate::storage::tests::InMemory;

/// A block of particles, 1 apart, with this lower corner.
fn block(edge: usize, corner: [f64; 3]) -> Vec<[f64; 3]> {
    let lattice_point = |index: usize| [index / edge / edge, index / edge % edge, index % edge];
    let at = |steps: [usize; 3]| std::array::from_fn(|axis| corner[axis] + steps[axis] as f64);
    (0..edge.pow(3)).map(|index| at(lattice_point(index))).collect()
}

fn numbers(name: &str, role: Role, arity: usize, values: Vec<f32>) -> Attribute {
    Attribute { name: name.to_owned(), role, arity, values: AttributeValues::Numbers(values) }
}

#[test]
fn reconstruct_matches_the_stages_with_absolute_positions() {
    let corner = [3.0e6, -2.0e6, 1.0e6];
    let particles = block(6, corner);
    let surface = reconstruct(&particles, &Options::default()).expect("valid");
    assert_eq!(surface.settings.spacing, 1.0);
    let expected = reconstruct_frame(&OwnedPositions::F64(particles.clone()), &surface.settings);
    assert_eq!(surface.triangles, expected.mesh.triangles);
    let absolute = |position: &Vec3| expected.mesh.origin + position.as_dvec3();
    assert!(surface.positions.iter().copied().eq(expected.mesh.positions.iter().map(absolute)));
    assert_eq!(surface.report, expected.report);
    let [least, greatest] =
        [DVec3::min, DVec3::max].map(|of| surface.positions.iter().copied().reduce(of).expect("some"));
    assert!((least - DVec3::from(corner)).abs().max_element() < 1.5, "{least}");
    assert!((greatest - DVec3::from(corner) - 5.0).abs().max_element() < 1.5, "{greatest}");
    // At 3·10⁶, 32-bit numbers are multiples of ¼. Positions relative to the origin of the surface keep their
    // precision.
    let near = surface.positions_f32(least);
    assert!(near.iter().flatten().all(|along| (0.0..9.0).contains(along)));
}

#[test]
fn positions_of_either_precision_are_borrowed() {
    let double = block(5, [0.0; 3]);
    let single: Vec<[f32; 3]> = double.iter().map(|position| position.map(|along| along as f32)).collect();
    let options = Options { voxel_size: Some(0.5.into()), ..Options::default() };
    let [one, other] = [reconstruct(&double, &options), reconstruct(&*single, &options)].map(Result::unwrap);
    assert_eq!(one.positions, other.positions);
    assert!(matches!(Positions::from(&single), Positions::F32(std::borrow::Cow::Borrowed(_))));
}

#[test]
fn settings_of_the_first_frame_apply_to_all_frames() {
    let mut reconstructor = Reconstructor::new(Options::default());
    assert_eq!(reconstructor.settings(), None);
    reconstructor.reconstruct(block(5, [0.0; 3])).expect("valid");
    let wider: Vec<[f64; 3]> = block(5, [0.0; 3]).iter().map(|position| position.map(|x| 1.2 * x)).collect();
    let surface = reconstructor.reconstruct(&wider).expect("valid");
    assert_eq!((surface.settings.spacing, Some(&surface.settings)), (1.0, reconstructor.settings()));
}

#[test]
fn phases_are_reported_in_order_and_each_can_be_cancelled() {
    let particles = block(5, [0.0; 3]);
    let speeds = numbers("v", Role::Velocity, 3, vec![1.0; 3 * particles.len()]);
    let options = Options { attributes: Some(AttributeSelection::All), ..Options::default() };
    let all = [Phase::Prepare, Phase::Rasterize, Phase::Smooth, Phase::Contour, Phase::Interpolate];
    for cancelled_in in all.map(Some).into_iter().chain([None]) {
        let token = CancelToken::new();
        let seen = Mutex::new(Vec::new());
        let mut reconstructor = Reconstructor::new(options.clone());
        reconstructor.cancel_token(token.clone()).on_progress(|progress| {
            assert!((0.0..=1.0).contains(&progress.fraction));
            let mut seen = seen.lock().unwrap();
            if seen.last() != Some(&progress.phase) {
                seen.push(progress.phase);
            }
            if Some(progress.phase) == cancelled_in {
                token.cancel();
            }
        });
        let found = reconstructor.reconstruct_with(&particles, std::slice::from_ref(&speeds));
        drop(reconstructor);
        let count = all.iter().position(|phase| Some(*phase) == cancelled_in).map_or(all.len(), |at| at + 1);
        assert_eq!(*seen.lock().unwrap(), all[..count]);
        match cancelled_in {
            Some(_) => assert!(matches!(found, Err(Error::Cancelled))),
            None => {
                let AttributeValues::Numbers(speeds) = &found.expect("valid").attributes[0].values else {
                    panic!("numbers")
                };
                assert!(!speeds.is_empty() && speeds.iter().all(|speed| *speed == 1.0));
            }
        }
    }
}

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn memory_limit_is_an_error_without_scratch_and_same_bits_with_scratch() {
    // A long bar: most of its particles are in other tiles.
    let bar: Vec<[f64; 3]> =
        (0..4 * 4 * 600).map(|i| [f64::from(i / 16), f64::from(i / 4 % 4), f64::from(i % 4)]).collect();
    let options = Options {
        spacing: Some(1.0),
        anisotropy: Some(AnisotropyKind::None),
        position_smoothing: Some(0.0),
        ..Options::default()
    };
    let mut reconstructor = Reconstructor::new(options);
    let whole = reconstructor.reconstruct(&bar).expect("valid");
    let refused = reconstructor.memory_limit(1 << 20).reconstruct(&bar);
    let Err(Error::MemoryLimit { needed_bytes, limit_bytes }) = refused else { panic!("{refused:?}") };
    assert!(needed_bytes > limit_bytes && limit_bytes == 1 << 20);
    reconstructor.memory_limit(needed_bytes - 1);
    assert!(matches!(reconstructor.reconstruct(&bar), Err(Error::MemoryLimit { .. })));
    reconstructor.memory_limit(needed_bytes * 3 / 4).scratch(|| Ok(Box::<InMemory>::default()));
    let tiled = reconstructor.reconstruct(&bar).expect("fits in tiles");
    assert!(tiled.positions == whole.positions && tiled.triangles == whole.triangles);
    let token = CancelToken::new();
    let cancelling = token.clone();
    reconstructor.cancel_token(token).on_progress(move |progress| {
        if progress.phase == Phase::Smooth {
            cancelling.cancel();
        }
    });
    assert!(matches!(reconstructor.reconstruct(&bar), Err(Error::Cancelled)));
    reconstructor.cancel_token(CancelToken::new()).on_progress(|_| {});
    reconstructor.scratch(|| Err(io::ErrorKind::StorageFull.into()));
    assert!(matches!(reconstructor.reconstruct(&bar), Err(Error::Scratch(_))));
}

#[test]
fn surface_stays_outside_obstacles() {
    let particles = block(6, [0.0; 3]);
    // A flat tetrahedron, nearly a floor, half as high as the block.
    let corners = [[-300.0, -300.0, -30.0], [300.0, -300.0, -30.0], [0.0, 600.0, -30.0], [2.5, 2.5, 3.0]];
    let tetrahedron = Obstacle::from_mesh(&corners, &[[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]);
    let mut reconstructor = Reconstructor::new(Options::default());
    let open = reconstructor.reconstruct(&particles).expect("valid");
    let kept_out = reconstructor.obstacles([Arc::new(tetrahedron)]).reconstruct(&particles).expect("valid");
    assert_eq!(open.report.contact.particle_count, 0);
    let [kept_out, open] =
        [&kept_out, &open].map(|surface| (surface.report.contact.particle_count, surface.report.mesh.volume));
    assert!(kept_out.0 > 50 && kept_out.1 < 0.7 * open.1, "{kept_out:?}, {open:?}");
}

fn error(positions: &[[f64; 3]], attributes: &[Attribute], options: Options) -> Error {
    let mut reconstructor = Reconstructor::new(options);
    let found = reconstructor.memory_limit(1 << 28).reconstruct_with(positions, attributes);
    let error = found.expect_err("invalid");
    let text = error.to_string();
    assert!(!text.ends_with('.') && !text.contains("--"), "{text}");
    error
}

#[test]
fn invalid_input_returns_the_matching_error() {
    let (particles, default) = (block(4, [0.0; 3]), Options::default());
    let count = particles.len();
    let radii = |values| numbers("pscale", Role::Radius, 1, values);
    let by_radius = Options { radius_attribute: Some("pscale".into()), ..Options::default() };
    let by_speed = Options { anisotropy: Some(AnisotropyKind::Velocity), ..Options::default() };
    let with = |voxel_size: f64| Options { voxel_size: Some(voxel_size.into()), ..Options::default() };
    assert!(matches!(error(&[], &[], default.clone()), Error::NoParticles { input_count: 0 }));
    let nowhere = [[f64::NAN; 3], [f64::INFINITY, 0.0, 0.0]];
    assert!(matches!(error(&nowhere, &[], with(0.5)), Error::NoParticles { input_count: 2 }));
    assert!(matches!(
        error(&[[1e300; 3]], &[], with(0.5)),
        Error::NoParticles { .. } | Error::VoxelTooSmall { .. }
    ));
    assert!(matches!(error(&nowhere, &[], default.clone()), Error::UnknownSpacing));
    assert!(matches!(error(&[[1.0; 3]; 9], &[], default.clone()), Error::UnknownSpacing));
    assert!(matches!(error(&particles, &[], with(-1.0)), Error::Options(_)));
    assert!(matches!(error(&particles, &[], with(f64::NAN)), Error::Options(_)));
    assert!(matches!(error(&particles, &[], with(1e200)), Error::Options(_)));
    let thin = Options { blend: Some(1e-40.into()), ..with(1.0) };
    assert!(matches!(error(&particles, &[], thin), Error::Options(_)));
    assert!(matches!(error(&particles, &[], with(1e-9)), Error::VoxelTooSmall { .. } | Error::Options(_)));
    assert!(matches!(error(&particles, &[], by_radius.clone()), Error::MissingAttribute { arity: 1, .. }));
    assert!(matches!(error(&particles, &[], by_speed), Error::MissingAttribute { arity: 3, .. }));
    let short = radii(vec![1.0; count - 1]);
    let Error::AttributeLength { expected, found, .. } = error(&particles, &[short], by_radius) else {
        panic!("too few values")
    };
    assert_eq!((expected, found), (count, count - 1));
    let of_nothing = Attribute { arity: 0, ..radii(Vec::new()) };
    assert!(matches!(error(&particles, &[of_nothing], default.clone()), Error::AttributeLength { .. }));
    // Particles far apart, each with the largest possible surface.
    let spray: Vec<[f64; 3]> = (0..400).map(|i| [f64::from(i) * 150.0, 0.0, 0.0]).collect();
    let large = Options { blend: Some(60.0.into()), spacing: Some(26.0), ..with(1.0) };
    assert!(matches!(error(&spray, &[], large), Error::MemoryLimit { .. }));
}

/// The spacing, the surface and its attributes are those of the chosen particles alone.
#[test]
fn condition_gives_the_surface_of_the_particles_that_meet_it() {
    let fluid = block(5, [0.0; 3]);
    // Boundary particles, denser than the fluid and between its particles.
    let wall: Vec<[f64; 3]> = block(8, [2.0, 0.0, 0.0]).iter().map(|at| at.map(|x| 0.3 * x)).collect();
    let particles = [&fluid[..], &wall].concat();
    let phases = |count: usize, phase: i64| vec![phase; count];
    let phase = |values| Attribute {
        name: "phase".to_owned(),
        role: Role::Other,
        arity: 1,
        values: AttributeValues::Integers(values),
    };
    let of_all = phase([phases(fluid.len(), 0), phases(wall.len(), 1)].concat());
    let options = |condition: &str| Options {
        r#where: Some(condition.parse().expect("a condition")),
        attributes: Some(AttributeSelection::All),
        ..Options::default()
    };
    let mut reconstructor = Reconstructor::new(options("phase == 0"));
    let chosen = reconstructor.reconstruct_with(&particles, std::slice::from_ref(&of_all)).expect("valid");
    let mut reconstructor = Reconstructor::new(Options { r#where: None, ..options("phase") });
    let alone = reconstructor.reconstruct_with(&fluid, &[phase(phases(fluid.len(), 0))]).expect("valid");
    assert_eq!((&chosen.positions, &chosen.triangles), (&alone.positions, &alone.triangles));
    assert_eq!((chosen.attributes, chosen.settings.spacing), (alone.attributes, 1.0));
    assert_eq!(chosen.report.particle_count, fluid.len());
    let resolved = |condition: &str| {
        let mut reconstructor = Reconstructor::new(options(condition));
        let found = reconstructor.resolve_on(&particles, std::slice::from_ref(&of_all));
        found.map(|settings| settings.spacing).map_err(|error| error.to_string())
    };
    assert_eq!(resolved("phase == 0"), Ok(1.0));
    let none = "none of the 637 particles meets `phase > 1`";
    assert_eq!(resolved("phase > 1"), Err(none.to_owned()));
    assert_eq!(error(&particles, &[of_all], options("phase > 1")).to_string(), none);
    let missing = error(&particles, &[], options("mk == 1")).to_string();
    assert_eq!(missing, "`mk == 1`: the particles have no attribute `mk`; available: x, y, z");
}

/// A random generator that favours extreme values.
struct Hostile(u64);

impl Hostile {
    fn next(&mut self) -> u64 {
        // xorshift64*
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    fn below(&mut self, count: u64) -> u64 {
        (self.next() >> 32) % count
    }

    fn pick<T: Clone>(&mut self, all: &[T]) -> T {
        all[self.below(all.len() as u64) as usize].clone()
    }

    fn length(&mut self) -> Length {
        let unit = self.pick(&[LengthUnit::World, LengthUnit::Spacing, LengthUnit::Voxel]);
        Length { value: self.number(), unit }
    }

    fn number(&mut self) -> f64 {
        const ODD: [f64; 16] = [
            0.0,
            -0.0,
            f64::NAN,
            f64::INFINITY,
            f64::NEG_INFINITY,
            f64::MAX,
            f64::MIN_POSITIVE,
            5e-324,
            -1.0,
            1e-30,
            1e30,
            1e9,
            1.0,
            0.5,
            1.1,
            3.7,
        ];
        match self.below(4) {
            0 => f64::from_bits(self.next()),
            1 => self.pick(&ODD),
            _ => self.below(4000) as f64 / 1000.0,
        }
    }

    fn position(&mut self, kind: u64) -> [f64; 3] {
        let mut near = || self.below(800) as f64 / 100.0;
        let position = [near(), near(), near()];
        match (kind, self.below(10)) {
            (0, _) => position,
            (1, 0) => std::array::from_fn(|_| self.number()),
            (2, _) => position.map(f64::floor),
            (3, _) => position.map(|along| along + 1e7),
            (4, _) => [position[0], 0.0, 0.0],
            (5, _) => std::array::from_fn(|_| self.number()),
            _ => position,
        }
    }

    fn some<T>(&mut self, odds: u64, make: impl FnOnce(&mut Hostile) -> T) -> Option<T> {
        (self.below(odds) == 0).then(|| make(self))
    }

    fn options(&mut self) -> Options {
        const COUNTS: [u32; 6] = [0, 1, 2, 5, 1_000_001, u32::MAX];
        let count = |from: &mut Hostile| from.pick(&COUNTS);
        Options {
            preset: self.some(2, |from| from.pick(Preset::ALL)),
            spacing: self.some(3, Hostile::number),
            voxel_size: self.some(3, Hostile::length),
            radius_min: self.some(8, Hostile::length),
            radius_ratio: self.some(8, Hostile::number),
            blend: self.some(8, Hostile::length),
            offset: self.some(8, Hostile::length),
            radius_attribute: self.some(4, |_| "pscale".to_owned()),
            radius_scale: self.some(8, Hostile::number),
            anisotropy: self.some(2, |from| {
                from.pick(&[AnisotropyKind::None, AnisotropyKind::Neighbors, AnisotropyKind::Velocity])
            }),
            max_stretch: self.some(8, Hostile::number),
            neighbor_radius: self.some(8, Hostile::length),
            position_smoothing: self.some(4, Hostile::number),
            velocity_gain: self.some(4, Hostile::number),
            void_threshold: self.some(8, Hostile::number),
            attributes: self.some(2, |_| AttributeSelection::All),
            velocity_scale: self.some(4, Hostile::number),
            drop_islands: self.some(6, |from| from.pick(&[0, 3, 1000, 2000])),
            fill_cavities: self.some(6, Hostile::number),
            clip: self.some(6, |from| ClipBox {
                min: std::array::from_fn(|_| from.number() - 2.0),
                max: std::array::from_fn(|_| from.number() + 2.0),
            }),
            decimate: self.some(6, Hostile::number),
            smooth_normals: self.some(6, count),
            integrator: self.some(2, |from| {
                from.pick(&[
                    Integrator::Fast,
                    Integrator::Implicit,
                    Integrator::Explicit,
                    Integrator::Adaptive,
                ])
            }),
            laplacian_steps: self.some(4, count),
            steps: Some(count(self)),
            step_size: self.some(4, |from| from.pick(&[0.01, 0.02, 1.0, f64::NAN, -1.0, 1e300])),
            redistance_every: self.some(6, count),
            ..Options::default()
        }
    }

    fn attributes(&mut self, count: usize) -> Vec<Attribute> {
        let mut values = |count| (0..count).map(|_| self.number() as f32).collect::<Vec<f32>>();
        let mut all = vec![
            numbers("pscale", Role::Radius, 1, values(count)),
            numbers("v", Role::Velocity, 3, values(3 * count)),
        ];
        let kinds = AttributeValues::Strings {
            table: Arc::new(["a".to_owned(), "b".to_owned()]),
            indices: (0..count).map(|index| index as i32 - 3).collect(),
        };
        all.push(Attribute { name: "kind".into(), role: Role::Other, arity: 1, values: kinds });
        all
    }
}

/// Any input gives a surface or an error, and never a panic.
#[test]
fn hostile_positions_and_options_never_panic() {
    hostile_input_never_panics(1..=60);
}

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn more_hostile_positions_and_options_never_panic() {
    hostile_input_never_panics(61..=600);
}

/// Reconstructs a random input for each of these seeds.
fn hostile_input_never_panics(seeds: RangeInclusive<u64>) {
    let count = seeds.clone().count();
    let (mut made, mut panicked) = (0, Vec::new());
    for seed in seeds {
        let mut from = Hostile(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let options =
            if seed % 4 == 0 { Options { steps: Some(1), ..Options::default() } } else { from.options() };
        let (kind, count) = (from.below(6), from.pick(&[1, 2, 7, 60, 300]));
        let positions: Vec<[f64; 3]> = (0..count).map(|_| from.position(kind)).collect();
        let singles: Vec<[f32; 3]> = positions.iter().map(|position| position.map(|x| x as f32)).collect();
        let attributes = from.attributes(count);
        let run = || {
            let mut reconstructor = Reconstructor::new(options.clone());
            reconstructor.memory_limit(1 << 26);
            match seed % 2 {
                0 => reconstructor.reconstruct_with(&positions, &attributes),
                _ => reconstructor.reconstruct_with(&singles, &attributes),
            }
        };
        match catch_unwind(AssertUnwindSafe(run)) {
            Ok(Ok(_)) => made += 1,
            Ok(Err(error)) => assert!(!error.to_string().is_empty()),
            Err(_) => panicked.push(seed),
        }
    }
    assert!(panicked.is_empty(), "seeds {panicked:?}");
    assert!(made > count / 20, "only {made} surfaces: the input is too extreme to test anything");
}
