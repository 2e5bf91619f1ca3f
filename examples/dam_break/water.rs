//! Simulates a block of water that collapses in a tank, with position-based fluids.
//!
//! The simulation is as small as possible and still splashes. It uses no random numbers, so its frames are
//! always the same.
//!
//! This work is based on:
//! Miles Macklin, Matthias Müller. Position Based Fluids. 2013

use std::collections::HashMap;

use glam::{IVec3, Vec3};

/// Distance between particles at rest, metres.
const SPACING: f32 = 0.05;
/// Radius of the smoothing kernel, metres.
const REACH: f32 = 2.2 * SPACING;
/// The tank reaches from the origin to this corner, in metres; y is up.
const TANK: Vec3 = Vec3::new(1.6, 1.2, 0.6);
/// Number of particles along the edges of the block of water.
const BLOCK: IVec3 = IVec3::new(16, 16, 12);
const GRAVITY: Vec3 = Vec3::new(0.0, -9.81, 0.0);
const SECONDS_PER_STEP: f32 = 1.0 / 120.0;
/// Number of position corrections per step.
const SOLVER_ITERATIONS: usize = 4;
/// Softens the density constraint of particles with few neighbours.
const RELAXATION: f32 = 200.0;
/// How much a velocity blends with those of its neighbours in a step.
const VISCOSITY: f32 = 0.02;

/// The state of the simulation.
pub(crate) struct Water {
    pub(crate) positions: Vec<Vec3>,
    pub(crate) velocities: Vec<Vec3>,
    /// The density of the block at rest, in particle masses per volume.
    rest_density: f32,
}

impl Water {
    /// A block of water at rest in a corner of the tank.
    pub(crate) fn block() -> Water {
        let mut positions = Vec::new();
        for x in 0..BLOCK.x {
            for y in 0..BLOCK.y {
                positions.extend((0..BLOCK.z).map(|z| (IVec3::new(x, y, z).as_vec3() + 0.5) * SPACING));
            }
        }
        let velocities = vec![Vec3::ZERO; positions.len()];
        let mut water = Water { positions, velocities, rest_density: 1.0 };
        let neighbors = neighbors(&water.positions);
        let densities = (0..water.positions.len()).map(|i| water.density(i, &neighbors[i]));
        water.rest_density = densities.fold(0.0, f32::max);
        water
    }

    pub(crate) fn step(&mut self) {
        let before = self.positions.clone();
        for (position, velocity) in self.positions.iter_mut().zip(&mut self.velocities) {
            *velocity += GRAVITY * SECONDS_PER_STEP;
            *position += *velocity * SECONDS_PER_STEP;
        }
        let neighbors = neighbors(&self.positions);
        for _ in 0..SOLVER_ITERATIONS {
            let corrections = self.corrections(&neighbors);
            for (position, correction) in self.positions.iter_mut().zip(corrections) {
                let margin = 0.5 * SPACING;
                *position = (*position + correction).clamp(Vec3::splat(margin), TANK - margin);
            }
        }
        let moved = self.positions.iter().zip(before).map(|(now, before)| (now - before) / SECONDS_PER_STEP);
        self.velocities = moved.collect();
        self.velocities =
            (0..self.positions.len()).map(|i| self.blended_velocity(i, &neighbors[i])).collect();
    }

    fn density(&self, i: usize, neighbors: &[usize]) -> f32 {
        neighbors.iter().map(|&j| kernel(self.positions[i].distance(self.positions[j]))).sum()
    }

    /// Displacements that reduce densities above the rest density towards the rest density (Eq. 12).
    fn corrections(&self, neighbors: &[Vec<usize>]) -> Vec<Vec3> {
        let multiplier = |i: usize| {
            let excess = (self.density(i, &neighbors[i]) / self.rest_density - 1.0).max(0.0);
            let gradients = neighbors[i].iter().map(|&j| self.gradient(i, j));
            let own: Vec3 = gradients.clone().sum();
            -excess / (gradients.map(Vec3::length_squared).sum::<f32>() + own.length_squared() + RELAXATION)
        };
        let multipliers: Vec<f32> = (0..self.positions.len()).map(multiplier).collect();
        let correction = |i: usize| {
            neighbors[i]
                .iter()
                .map(|&j| self.gradient(i, j) * (multipliers[i] + multipliers[j]))
                .sum::<Vec3>()
        };
        (0..self.positions.len()).map(correction).collect()
    }

    /// The contribution of particle j to the gradient of particle i's relative density with respect to the
    /// position of i.
    fn gradient(&self, i: usize, j: usize) -> Vec3 {
        let offset = self.positions[i] - self.positions[j];
        let distance = offset.length();
        if distance == 0.0 {
            Vec3::ZERO
        } else {
            offset / distance * kernel_slope(distance) / self.rest_density
        }
    }

    fn blended_velocity(&self, i: usize, neighbors: &[usize]) -> Vec3 {
        let own = self.velocities[i];
        let pull: Vec3 = neighbors
            .iter()
            .map(|&j| {
                let weight = kernel(self.positions[i].distance(self.positions[j])) / self.rest_density;
                (self.velocities[j] - own) * weight
            })
            .sum();
        own + VISCOSITY * pull
    }
}

/// The kernel Poly6, normalised.
fn kernel(distance: f32) -> f32 {
    let rest = (REACH * REACH - distance * distance).max(0.0);
    315.0 / (64.0 * std::f32::consts::PI * REACH.powi(9)) * rest * rest * rest
}

/// The slope of the spiky kernel, normalised.
fn kernel_slope(distance: f32) -> f32 {
    let rest = (REACH - distance).max(0.0);
    -45.0 / (std::f32::consts::PI * REACH.powi(6)) * rest * rest
}

/// The particles within the kernel radius of each particle, including itself, by index.
fn neighbors(positions: &[Vec3]) -> Vec<Vec<usize>> {
    let cell_of = |position: Vec3| (position / REACH).floor().as_ivec3();
    let mut cells: HashMap<IVec3, Vec<usize>> = HashMap::new();
    for (index, &position) in positions.iter().enumerate() {
        cells.entry(cell_of(position)).or_default().push(index);
    }
    let around = |&position: &Vec3| {
        let cell = cell_of(position);
        let steps = (0..27).map(|step| IVec3::new(step / 9, step / 3 % 3, step % 3) - 1);
        let mut near: Vec<usize> = steps
            .filter_map(|step| cells.get(&(cell + step)))
            .flatten()
            .copied()
            .filter(|&other| position.distance(positions[other]) < REACH)
            .collect();
        near.sort_unstable();
        near
    };
    positions.iter().map(around).collect()
}
