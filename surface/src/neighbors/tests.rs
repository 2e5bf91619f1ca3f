//! Compares the search for neighbours with brute force.

use super::*;

fn random(state: &mut u32) -> f64 {
    *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    f64::from(*state >> 8) / f64::from(1 << 24)
}

fn cloud(count: usize, extent: f64, around: DVec3) -> Vec<[f64; 3]> {
    let mut state = 7;
    let mut along = || (random(&mut state) - 0.5) * extent;
    (0..count).map(|_| (DVec3::new(along(), along(), along()) + around).to_array()).collect()
}

/// Indices of the particles within the edge length of a cell from a point, sorted.
fn found(neighbors: &Neighbors, world: DVec3) -> Vec<u32> {
    let Some((cell, local)) = neighbors.locate(world) else { return Vec::new() };
    let mut surroundings = NeighborPackets::default();
    surroundings.gather(neighbors, cell, usize::MAX);
    let mut found = Vec::new();
    for eight in surroundings.eights() {
        for k in 0..8 {
            let [x, y, z] = [0, 1, 2].map(|axis| eight.along[axis][k]);
            if (Vec3::new(x, y, z) - local).length_squared() < 1.0 {
                found.push(eight.indices[k]);
            }
        }
    }
    found.sort_unstable();
    found
}

fn expected(positions: &[[f64; 3]], world: DVec3, radius: f64) -> Vec<u32> {
    let is_near = |index: &u32| DVec3::from(positions[*index as usize]).distance(world) < radius;
    (0..positions.len() as u32).filter(is_near).collect()
}

#[test]
fn all_particles_within_an_edge_are_found() {
    for (around, radius) in [(0.0, 0.3), (-1234.5, 0.17), (3e7, 0.4)] {
        let around = DVec3::new(around, 0.5 * around, -around);
        let positions = cloud(3000, 2.0, around);
        let neighbors = Neighbors::new(&OwnedPositions::F64(positions.clone()), radius);
        assert_eq!((neighbors.indices().len(), neighbors.dropped_count), (3000, 0));
        for point in cloud(200, 2.5, around) {
            let world = DVec3::from(point);
            assert_eq!(found(&neighbors, world), expected(&positions, world, radius), "at {world}");
        }
    }
}

#[test]
fn cells_are_sorted_and_particles_keep_file_order() {
    let mut positions = cloud(5000, 2.0, DVec3::ZERO);
    positions.extend_from_within(..100);
    let neighbors = Neighbors::new(&OwnedPositions::F64(positions.clone()), 0.25);
    assert!(neighbors.cells().is_sorted_by_key(|cell| cell.to_array()));
    for (cell, coord) in neighbors.cells().iter().enumerate() {
        let slots = neighbors.slots(cell);
        assert!(!slots.is_empty() && neighbors.indices()[slots.clone()].is_sorted());
        for slot in slots {
            assert_eq!(neighbors.cell_at(slot), cell);
            let [x, y, z] = neighbors.locals().map(|along| f64::from(along[slot]));
            let world = (coord.as_dvec3() + DVec3::new(x, y, z)) * 0.25;
            let original = DVec3::from(positions[neighbors.indices()[slot] as usize]);
            assert!(world.distance(original) < 1e-7, "{world} for {original}");
        }
    }
}

#[test]
fn particles_outside_the_grid_are_left_out() {
    let (nan, far) = (f32::NAN, 3e38);
    let positions = vec![[nan, 0.0, 0.0], [0.5, 0.5, 0.5], [0.0, f32::INFINITY, 0.0], [0.0, 0.0, far]];
    let neighbors = Neighbors::new(&OwnedPositions::F32(positions), 0.1);
    assert_eq!((neighbors.indices(), neighbors.dropped_count), (&[1u32][..], 3));
    assert_eq!(found(&neighbors, DVec3::splat(0.5)), [1]);
    assert_eq!(found(&neighbors, DVec3::splat(f64::NAN)), [0u32; 0]);
    for edge in [0.0, f64::NAN] {
        let neighbors = Neighbors::new(&OwnedPositions::F32(vec![[1.0; 3]]), edge);
        assert!(neighbors.cells().is_empty());
    }
    let empty = Neighbors::new(&OwnedPositions::F32(Vec::new()), 1.0);
    assert_eq!((empty.cells().len(), found(&empty, DVec3::ZERO).len()), (0, 0));
}

#[test]
fn cells_at_both_ends_of_the_range_differ() {
    let end = f64::from(INDEX_LIMIT) - 1.0;
    let positions: Vec<[f64; 3]> =
        vec![[end, -end, end], [-end, end, 0.5], [end, -end, end - 1.5], [-end, -end, -end]];
    let neighbors = Neighbors::new(&OwnedPositions::F64(positions), 1.0);
    assert_eq!(neighbors.indices(), [3, 1, 2, 0]);
    assert_eq!(found(&neighbors, DVec3::new(end, -end, end - 0.75)), [0, 2]);
    assert_eq!(neighbors.cells()[0], IVec3::splat(1 - INDEX_LIMIT));
}

#[test]
fn distant_particles_change_nothing() {
    let here = cloud(2000, 2.0, DVec3::ZERO);
    let mut more = cloud(500, 2.0, DVec3::splat(-90.0));
    more.extend(&here);
    let one = Neighbors::new(&OwnedPositions::F64(here), 0.3);
    let other = Neighbors::new(&OwnedPositions::F64(more), 0.3);
    let (mut around, mut around_other) = (NeighborPackets::default(), NeighborPackets::default());
    for &cell in one.cells() {
        around.gather(&one, cell, 20);
        around_other.gather(&other, cell, 20);
        for (eight, eight_other) in around.eights().iter().zip(around_other.eights()) {
            assert_eq!((eight.along, eight.multiplicity), (eight_other.along, eight_other.multiplicity));
        }
        assert_eq!(around.len(), around_other.len());
    }
}

#[test]
fn crowded_cells_are_sampled() {
    let mut positions = vec![[0.5f32, 0.5, 0.5]; 1000];
    positions.push([1.5, 0.5, 0.5]);
    let neighbors = Neighbors::new(&OwnedPositions::F32(positions), 1.0);
    let mut surroundings = NeighborPackets::default();
    surroundings.gather(&neighbors, IVec3::ZERO, 64);
    assert_eq!((surroundings.len(), surroundings.is_empty(), surroundings.eights().len()), (65, false, 9));
    let total: f32 = surroundings.eights().iter().flat_map(|eight| eight.multiplicity).sum();
    assert_eq!(total, 1001.0);
    let indices: Vec<u32> = surroundings.eights().iter().flat_map(|eight| eight.indices).collect();
    assert!(indices[..65].is_sorted_by(|one, next| one < next), "{indices:?}");
    assert_eq!(
        indices[64..],
        [1000, NO_PARTICLE, NO_PARTICLE, NO_PARTICLE, NO_PARTICLE, NO_PARTICLE, NO_PARTICLE, NO_PARTICLE]
    );
    for (part, &index) in indices[..64].iter().enumerate() {
        assert!((part * 1000 / 64..(part + 1) * 1000 / 64).contains(&(index as usize)));
    }
}
