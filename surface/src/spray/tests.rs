use super::history::frames_needed;
use super::*;
use crate::particles::{AttributeValues, Role};

fn positions(points: &[[f32; 3]]) -> OwnedPositions {
    OwnedPositions::F32(points.to_vec())
}

/// Particles linked up to a distance of 1.
fn links() -> Links {
    Links { radius_world: 0.5, scales: None }
}

/// Pseudo-random points in a box of this size, which is sparse enough for pieces of many sizes.
fn scattered(count: u32, size: f32) -> Vec<[f32; 3]> {
    let mut state = 1u32;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32 * size
    };
    (0..count).map(|_| [next(), next(), next()]).collect()
}

/// The pieces by comparison of all pairs.
fn walked(points: &[[f32; 3]], radius: impl Fn(usize) -> f32) -> Vec<Vec<u32>> {
    let is_linked = |one: usize, other: usize| {
        let squared: f32 = (0..3).map(|axis| (points[one][axis] - points[other][axis]).powi(2)).sum();
        squared.sqrt() <= radius(one) + radius(other)
    };
    let mut piece_of: Vec<usize> = (0..points.len()).collect();
    loop {
        let mut is_changed = false;
        for one in 0..points.len() {
            for other in 0..one {
                if piece_of[one] != piece_of[other] && is_linked(one, other) {
                    let least = piece_of[one].min(piece_of[other]);
                    (piece_of[one], piece_of[other]) = (least, least);
                    is_changed = true;
                }
            }
        }
        if !is_changed {
            break;
        }
    }
    let members = |piece: usize| -> Vec<u32> {
        (0..points.len() as u32).filter(|particle| piece_of[*particle as usize] == piece).collect()
    };
    (0..points.len()).map(members).filter(|members| !members.is_empty()).collect()
}

#[test]
fn small_pieces_match_a_comparison_of_all_pairs() {
    for size in [4.0, 7.0, 9.0, 14.0] {
        let points = scattered(400, size);
        for count_min in [1, 2, 3, 5, 20, 100, 401] {
            let mut expected = walked(&points, |_| 0.5);
            expected.retain(|members| members.len() < count_min as usize);
            let found: Vec<Vec<u32>> = small_pieces(&positions(&points), &links(), count_min)
                .into_iter()
                .map(|piece| piece.members)
                .collect();
            assert_eq!(found, expected, "box {size}, fewer than {count_min}");
        }
    }
}

#[test]
fn large_particles_are_linked_farther() {
    let points = scattered(300, 12.0);
    let scales: Vec<f32> = (0..300u16).map(|index| [0.5, 1.0, 2.5][usize::from(index) % 3]).collect();
    let mut expected = walked(&points, |index| 0.5 * scales[index]);
    expected.retain(|members| members.len() < 6);
    let links = Links { radius_world: 0.5, scales: Some(scales) };
    let found: Vec<Vec<u32>> =
        small_pieces(&positions(&points), &links, 6).into_iter().map(|piece| piece.members).collect();
    assert_eq!(found, expected);
    assert!(found.iter().any(|members| members.len() > 2));
}

#[test]
fn far_particles_change_no_pieces() {
    // All distances are those at which particles are linked, before rounding.
    let row = |at: u16| (0..40u16).map(move |step| [f32::from(step) * 0.1, f32::from(at) * 0.3, 0.0]);
    let points: Vec<[f32; 3]> = (0..40).flat_map(row).collect();
    let pieces = |far: f32| {
        let points = [&points[..], &[[500.0, 0.0, 0.0]]].concat();
        let mut scales = vec![1.0; points.len()];
        scales[1600] = far;
        small_pieces(&positions(&points), &Links { radius_world: 0.05, scales: Some(scales) }, 30)
    };
    let expected = pieces(1.0);
    assert!(expected.len() > 100, "{}", expected.len());
    for far in [1.1, 1.7, 3.1, 9.9] {
        assert_eq!(pieces(far), expected, "{far}");
    }
}

#[test]
fn particles_in_one_place_or_nowhere_are_no_problem() {
    let same = vec![[1.0, 2.0, 3.0]; 20_000];
    assert!(small_pieces(&positions(&same), &links(), 20).is_empty());
    let odd = [[f32::NAN, 0.0, 0.0], [0.0; 3], [0.0, f32::INFINITY, 0.0], [1e30, 0.0, 0.0]];
    let found = small_pieces(&positions(&odd), &links(), 2);
    assert_eq!(found.first().map(|piece| &*piece.members), Some(&[1][..]));
    assert!(found.iter().all(|piece| !piece.members.contains(&0) && !piece.members.contains(&2)));
    assert!(small_pieces(&positions(&[]), &links(), 20).is_empty());
}

#[test]
fn spray_keeps_its_attributes_and_gets_a_class() {
    let row = |x: f32, count: u8| (0..count).map(move |step| [x + 0.9 * f32::from(step), 0.0, 0.0]);
    // A drop, a filament, a cluster, and a block that stays.
    let mut points: Vec<[f32; 3]> = vec![[-10.0, 0.0, 0.0]];
    points.extend(row(10.0, 5));
    points.extend([[0.0, 20.0, 0.0], [0.9, 20.0, 0.0], [0.0, 20.9, 0.0], [0.0, 20.0, 0.9]]);
    points.extend(
        (0..27u8).map(|index| [index % 3, index / 3 % 3, index / 9].map(|along| 0.9 * f32::from(along))),
    );
    let count = points.len();
    let ids = Attribute {
        name: "id".to_owned(),
        role: Role::Id,
        arity: 1,
        values: AttributeValues::Integers((0..count as i64).collect()),
    };
    let positions = positions(&points);
    let mut is_spray = vec![false; count];
    for piece in small_pieces(&positions, &links(), 20) {
        piece.members.iter().for_each(|member| is_spray[*member as usize] = true);
    }
    let sides = SpraySides { is_spray, ages: None };
    let radii = vec![0.5; count];
    let (fluid, of_fluid, spray) = take_spray(&positions, &[ids], &sides, &radii, (&links(), 0.9));
    assert_eq!((fluid.len(), of_fluid[0].values.len(), spray.positions.len()), (27, 27, 10));
    assert_eq!(spray.attributes[0].values, AttributeValues::Integers((0..10).collect()));
    use SprayClass::{Cluster, Drop, Filament};
    assert_eq!(spray.classes, [[Drop; 1].as_slice(), &[Filament; 5], &[Cluster; 4]].concat());
    assert_eq!(spray.piece_sizes, [1, 5, 5, 5, 5, 5, 4, 4, 4, 4]);
    assert_eq!(spray.counts(), SprayCounts { particles: 10, drops: 1, clusters: 1, filaments: 1 });
    let volume = 4.0 / 3.0 * std::f64::consts::PI * radius_of_volume(0.1).powi(3);
    assert!((volume / 1e-3 - 1.0).abs() < 1e-12);
}

/// The sides of one particle in a sequence: `#` is apart, `.` is not, a space has no such particle, and `-` is a missing
/// frame.
fn history(frames: &str, keep: u32) -> String {
    let frames: Vec<char> = frames.chars().collect();
    let sides_of = |frame: char| match frame {
        '-' => None,
        ' ' => Some(FrameSides::default()),
        other => Some(FrameSides::of(&[7], &[Some(other == '#')])),
    };
    let side = |(at, frame): (usize, &char)| {
        if !['#', '.'].contains(frame) {
            return *frame;
        }
        let reach = frames_needed(keep) as usize;
        let near = frames.iter().enumerate().filter(|(other, _)| other.abs_diff(at) <= reach && *other != at);
        let around: Vec<(i32, FrameSides)> =
            near.filter_map(|(other, frame)| Some((other as i32 - at as i32, sides_of(*frame)?))).collect();
        let around: Vec<(i32, &FrameSides)> = around.iter().map(|(steps, sides)| (*steps, sides)).collect();
        let own = [Some(*frame == '#')];
        let (is_spray, _) = steady_sides(&[7], &own, &FrameSides::of(&[7], &own), &around, keep);
        if is_spray[0] { '#' } else { '.' }
    };
    frames.iter().enumerate().map(side).collect()
}

#[test]
fn rows_and_gaps_shorter_than_the_limit_change_nothing() {
    for (keep, frames, expected) in [
        (1, ".#.##.", ".#.##."),
        (3, ".....#.....##.....###.....", "..................###....."),
        (3, ".#..####.###...#....", "....########........"),
        (2, "#.##..#.#.##", "####......##"),
        // At the ends, and beside missing frames, nothing contradicts.
        (3, "#...........#", "#...........#"),
        (3, "...#-#...", "...#-#..."),
        (3, "   ##   ", "   ##   "),
        (3, "####--.--####", "####--.--####"),
    ] {
        assert_eq!(history(frames, keep), expected, "K = {keep}: {frames}");
    }
}

#[test]
fn no_row_is_shorter_than_the_limit() {
    let mut state = 7u32;
    for keep in 1..=4 {
        let frames: String = (0..400)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                if state >> 31 == 0 { '#' } else { '.' }
            })
            .collect();
        let found = history(&frames, keep);
        let inner = found.trim_matches(|side| found.starts_with(side) || found.ends_with(side));
        let rows = inner.as_bytes().chunk_by(|one, next| one == next);
        assert!(rows.into_iter().all(|row| row.len() >= keep as usize), "K = {keep}: {found}");
    }
}

#[test]
fn ages_count_frames_in_a_row_and_shared_ids_are_decided_alone() {
    let sides = |is_apart: bool| FrameSides::of(&[7], &[Some(is_apart)]);
    // Frame −2 is missing.
    let around = [(-4, sides(false)), (-3, sides(true)), (-1, sides(true)), (1, sides(true))];
    let around: Vec<(i32, &FrameSides)> = around.iter().map(|(steps, sides)| (*steps, sides)).collect();
    // The last one has no position, and the frames around say that it is spray.
    let (ids, own) = ([7, 8, 8, 9], [Some(true), Some(true), Some(false), None]);
    let far = FrameSides::of(&[9], &[Some(true)]);
    let around: Vec<(i32, &FrameSides)> =
        around.into_iter().chain([(2, &far), (3, &far), (4, &far)]).collect();
    assert_eq!(
        steady_sides(&ids, &own, &FrameSides::of(&ids, &own), &around, 3),
        (vec![true, true, false, false], vec![2, 0, 0, 0])
    );
}
