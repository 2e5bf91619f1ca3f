//! Shapes of particles, the method with its defaults, and values of level sets.
//!
//! Shapes are in units of voxels: particles are about two voxels apart, as the method requires.

use glam::{DMat3, DVec3, IVec3, Vec3};
use meniscus_surface::grid::{LEAF_VOXELS, offset_in_leaf, voxel_in_leaf};
use meniscus_surface::level_set::{Bounds, NarrowBand};
use meniscus_surface::particles::OwnedPositions;
use meniscus_surface::rasterize::{Radii, RasterFields, RasterParams, rasterize};
use meniscus_surface::smooth::{Integrator, SmoothConfig, SmoothReport, SmoothSteps, smooth};
use meniscus_surface::space::Lattice;

/// Distance between neighbouring particles, in voxels.
pub(crate) const SPACING: f64 = 2.0;

/// The radii that follow from the voxel size alone (paper, §3.7).
pub(crate) fn default_radii() -> Radii {
    let min = 3f32.sqrt();
    Radii::uniform(min, 1.5 * min, 2.0 * min)
}

/// The defaults of each integrator.
pub(crate) fn default_config(integrator: Integrator) -> SmoothConfig {
    let (steps, step_size, redistance_every) = match integrator {
        Integrator::Explicit | Integrator::Adaptive => (500, 0.01, 50),
        Integrator::Fast | Integrator::Implicit => (5, 20.0, 1),
    };
    let steps = SmoothSteps { laplacian_steps: 15, integrator, steps, step_size, redistance_every };
    SmoothConfig { smoothing: steps, ..SmoothConfig::default() }
}

/// The three unions of spheres of particles given in voxels.
pub(crate) fn rasterized(positions: &[DVec3]) -> (NarrowBand, Bounds) {
    let particles = OwnedPositions::F64(positions.iter().map(|p| p.to_array()).collect());
    let Ok(RasterFields { band, bounds, .. }) =
        rasterize(&particles, &RasterParams::open(Lattice { voxel_size: 1.0 }, default_radii()));
    (band, bounds)
}

/// The surface of particles given in voxels, and its bounds.
pub(crate) fn skinned(positions: &[DVec3], integrator: Integrator) -> (NarrowBand, Bounds, SmoothReport) {
    let (mut band, bounds) = rasterized(positions);
    let report = smooth(&mut band, &bounds, &default_config(integrator), &mut |_| {});
    (band, bounds, report)
}

/// φ at a voxel, if it is stored.
pub(crate) fn value_at(band: &NarrowBand, voxel: IVec3) -> Option<f32> {
    let (leaf, local) = band.topology.find_voxel(voxel)?;
    Some(band.phi.leaves[leaf].values[offset_in_leaf(local)])
}

/// All stored voxels with their φ.
pub(crate) fn voxels(band: &NarrowBand) -> impl Iterator<Item = (IVec3, f32)> + '_ {
    band.topology.origins().iter().zip(&band.phi.leaves).flat_map(|(&origin, leaf)| {
        (0..LEAF_VOXELS).map(move |offset| (origin + voxel_in_leaf(offset), leaf.values[offset]))
    })
}

/// φ at a position in voxels by trilinear interpolation, if all eight voxels are stored.
pub(crate) fn interpolated(band: &NarrowBand, position: DVec3) -> Option<f64> {
    let base = position.floor();
    let t = position - base;
    let mut sum = 0.0;
    for corner in 0..8 {
        let step = IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2);
        let weight = (step.as_dvec3() * t + (IVec3::ONE - step).as_dvec3() * (1.0 - t)).element_product();
        sum += weight * f64::from(value_at(band, base.as_ivec3() + step)?);
    }
    Some(sum)
}

/// The points on the edges between neighbouring voxels where φ changes sign, by linear interpolation.
pub(crate) fn crossings(band: &NarrowBand) -> Vec<Vec3> {
    let mut found = Vec::new();
    for (voxel, here) in voxels(band) {
        for axis in [IVec3::X, IVec3::Y, IVec3::Z] {
            let Some(there) = value_at(band, voxel + axis) else { continue };
            if (here < 0.0) != (there < 0.0) {
                found.push(voxel.as_vec3() + axis.as_vec3() * (here / (here - there)));
            }
        }
    }
    found
}

/// Whether two level sets are the same to the last bit.
pub(crate) fn same_bits(one: &NarrowBand, other: &NarrowBand) -> bool {
    let bits = |band: &NarrowBand| -> Vec<u32> {
        band.phi.as_arrays().as_flattened().iter().map(|value| value.to_bits()).collect()
    };
    one.topology.origins() == other.topology.origins() && bits(one) == bits(other)
}

/// The volume that the zero set encloses, in voxels. Along each line in z, it adds the positions where the
/// line leaves the volume, and subtracts those where the line enters it.
pub(crate) fn volume(band: &NarrowBand) -> f64 {
    let crossing = |(voxel, here): (IVec3, f32)| {
        let there = value_at(band, voxel + IVec3::Z)?;
        let height = f64::from(voxel.z) + f64::from(here / (here - there));
        ((here < 0.0) != (there < 0.0)).then_some(if here < 0.0 { height } else { -height })
    };
    voxels(band).filter_map(crossing).sum()
}

/// ∫ H² over the zero set, where H is half the divergence of the normal, as ∫ H² δ(φ) |∇φ| over the voxels.
pub(crate) fn bending_energy(band: &NarrowBand) -> f64 {
    const WIDTH: f64 = 1.5;
    let share = |(voxel, phi): (IVec3, f32)| {
        let delta = (1.0 + (std::f64::consts::PI * f64::from(phi) / WIDTH).cos()) / (2.0 * WIDTH);
        let (gradient, hessian) = derivatives(band, voxel)?;
        let slope = gradient.length();
        // The divergence of ∇φ/|∇φ|, written out.
        let divergence = (hessian.x_axis.x + hessian.y_axis.y + hessian.z_axis.z
            - gradient.dot(hessian * gradient) / (slope * slope))
            / slope;
        Some(0.25 * divergence * divergence * delta * slope)
    };
    voxels(band).filter(|(_, phi)| f64::from(phi.abs()) < WIDTH).filter_map(share).sum()
}

/// Gradient and second derivatives of φ by central differences, if all neighbours are stored.
fn derivatives(band: &NarrowBand, voxel: IVec3) -> Option<(DVec3, DMat3)> {
    let at = |step: IVec3| value_at(band, voxel + step).map(f64::from);
    let here = at(IVec3::ZERO)?;
    let (mut gradient, mut hessian) = (DVec3::ZERO, DMat3::ZERO);
    for (i, &a) in IVec3::AXES.iter().enumerate() {
        gradient[i] = (at(a)? - at(-a)?) / 2.0;
        hessian.col_mut(i)[i] = at(a)? + at(-a)? - 2.0 * here;
        for (j, &b) in IVec3::AXES.iter().enumerate().filter(|&(j, _)| j != i) {
            hessian.col_mut(i)[j] = (at(a + b)? + at(-a - b)? - at(a - b)? - at(b - a)?) / 4.0;
        }
    }
    Some((gradient, hessian))
}

/// A ball of particles on a jittered lattice, with a finger that is one or two particles thick.
pub(crate) fn ball_with_finger() -> Vec<DVec3> {
    let mut random = Random::new(1);
    jittered_lattice(&mut random, 36, |p| {
        let across = (p.y * p.y + p.z * p.z).sqrt();
        p.length() < 14.0 || (0.0 < p.x && p.x < 34.0 && across < 2.2)
    })
}

/// Two balls with a gap that the outer bound closes and the inner bound does not.
pub(crate) fn two_balls() -> Vec<DVec3> {
    let mut random = Random::new(2);
    let centers = [DVec3::new(-11.0, 0.3, 0.0), DVec3::new(11.7, 0.0, 0.8)];
    jittered_lattice(&mut random, 24, |p| centers.iter().any(|center| (p - center).length() < 9.0))
}

/// A sheet that is one particle thick, drops above it, and single particles.
pub(crate) fn sheet_and_drops() -> Vec<DVec3> {
    let mut random = Random::new(3);
    let mut positions = jittered_lattice(&mut random, 24, |p| p.z.abs() < 0.1 && p.x.hypot(p.y) < 24.0);
    for _ in 0..12 {
        let center = random.in_box(DVec3::new(-20.0, -20.0, 8.0), DVec3::new(20.0, 20.0, 24.0));
        for _ in 0..8 {
            positions.push(center + random.in_ball(3.0));
        }
    }
    positions
}

/// The lattice points in a box of this size around the origin for which `holds` is true, each moved a little.
pub(crate) fn jittered_lattice(
    random: &mut Random,
    half_edge: i32,
    holds: impl Fn(DVec3) -> bool,
) -> Vec<DVec3> {
    let count = (f64::from(half_edge) / SPACING) as i32;
    let mut positions = Vec::new();
    for x in -count..=count {
        for y in -count..=count {
            for z in -count..=count {
                let position = IVec3::new(x, y, z).as_dvec3() * SPACING;
                let jitter = random.in_box(DVec3::splat(-0.3), DVec3::splat(0.3)) * SPACING;
                if holds(position) {
                    positions.push(position + jitter);
                }
            }
        }
    }
    positions
}

/// A generator of pseudo-random numbers (SplitMix64), the same in every run.
pub(crate) struct Random {
    state: u64,
}

impl Random {
    pub(crate) fn new(seed: u64) -> Random {
        Random { state: seed }
    }

    pub(crate) fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.state;
        mixed = (mixed ^ mixed >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ mixed >> 31
    }

    /// A number with a uniform distribution from 0 to 1.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// A point with a uniform distribution in a box.
    pub(crate) fn in_box(&mut self, min: DVec3, max: DVec3) -> DVec3 {
        min + DVec3::new(self.unit(), self.unit(), self.unit()) * (max - min)
    }

    /// A point with a uniform distribution in a ball around the origin.
    pub(crate) fn in_ball(&mut self, radius: f64) -> DVec3 {
        loop {
            let position = self.in_box(DVec3::splat(-radius), DVec3::splat(radius));
            if position.length() < radius {
                return position;
            }
        }
    }

    /// Shuffles a list.
    pub(crate) fn shuffle<T>(&mut self, list: &mut [T]) {
        for last in (1..list.len()).rev() {
            list.swap(last, (self.bits() % (last as u64 + 1)) as usize);
        }
    }
}
