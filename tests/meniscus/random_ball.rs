//! 50 000 particles at random in a ball come out nearly spherical (paper, Fig. 12).

#![expect(clippy::print_stdout, reason = "tests tell what they measured to those who ask with --nocapture")]

use std::collections::HashSet;

use glam::{DVec3, IVec3};
use meniscus::level_set::NarrowBand;
use meniscus::smooth::Integrator;

use crate::shapes::{Random, crossings, skinned, value_at, voxels};

/// So that the mean spacing of the particles is two voxels.
const RADIUS: f64 = 45.0;
const PARTICLE_COUNT: usize = 50_000;

#[test]
fn random_particles_in_a_ball_come_out_as_one_ball() {
    let mut random = Random::new(12);
    let positions: Vec<DVec3> = (0..PARTICLE_COUNT).map(|_| random.in_ball(RADIUS)).collect();
    let (band, bounds, report) = skinned(&positions, Integrator::Fast);
    assert_eq!(bounds.violation_count(&band.phi), 0);
    let radii: Vec<f64> = crossings(&band).iter().map(|p| p.as_dvec3().length()).collect();
    let mean = radii.iter().sum::<f64>() / radii.len() as f64;
    let deviation =
        (radii.iter().map(|radius| (radius - mean).powi(2)).sum::<f64>() / radii.len() as f64).sqrt();
    let pieces = piece_count(&band);
    println!(
        "{} free voxels; radius {mean:.2} ± {deviation:.3} voxels, {:.2} to {:.2}; {pieces} pieces",
        report.free_voxel_count,
        radii.iter().copied().fold(f64::INFINITY, f64::min),
        radii.iter().copied().fold(0.0, f64::max),
    );
    assert_eq!(pieces, 1);
    assert!(deviation <= 0.2, "{deviation}");
}

/// The number of pieces of the surface: connected sets of inside voxels with an outside neighbour.
fn piece_count(band: &NarrowBand) -> usize {
    let outside = |voxel: IVec3| value_at(band, voxel).is_some_and(|phi| phi >= 0.0);
    let mut rest: HashSet<IVec3> = voxels(band)
        .filter(|(voxel, phi)| {
            *phi < 0.0 && IVec3::AXES.iter().any(|&axis| outside(voxel + axis) || outside(voxel - axis))
        })
        .map(|(voxel, _)| voxel)
        .collect();
    let mut pieces = 0;
    while let Some(&first) = rest.iter().next() {
        pieces += 1;
        rest.remove(&first);
        let mut pending = vec![first];
        while let Some(voxel) = pending.pop() {
            for step in 0..27 {
                let near = voxel + IVec3::new(step / 9, step / 3 % 3, step % 3) - IVec3::ONE;
                if rest.remove(&near) {
                    pending.push(near);
                }
            }
        }
    }
    pieces
}
