"""Simulates a column of water that collapses in a tank, or a block of sand that falls into it, with the material
point method in Taichi.

    simulate_mpm.py water|sand SEED FOLDER

Writes FOLDER/f001.ply and so on: 60 frames with ids and velocities, 0.036 seconds apart, of sand 0.012, because
it comes to rest soon. y is up. At the start, each particle has a random place in a cube of its own with edge length 1/64; the seed
changes the places. The water and the grid are those of `tests/clients/simulate_taichi.py`.

The sand is elastic, with stresses linear in the logarithm of its strain, up to the yield condition of Drucker
and Prager; its volume correction makes up for the volume that it gains in tension.

This work is based on:
Gergely Klár, Theodore Gast, Andre Pradhana, Chuyuan Fu, Craig Schroeder, Chenfanfu Jiang, Joseph Teran. Drucker-Prager Elastoplasticity for Sand Animation. 2016
Andre Pradhana Tampubolon, Theodore Gast, Gergely Klár, Chuyuan Fu, Joseph Teran, Chenfanfu Jiang, Ken Museth. Multi-Species Simulation of Porous Sand and Water Mixtures. 2017
"""

import math
import sys
from pathlib import Path

import numpy
import taichi as ti

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "clients"))
import simulate_taichi as water
from simulate_wave import write_frame

FRAMES = 60
SAND_STEPS_PER_FRAME = 60
# How far above the floor the sand starts.
SAND_HEIGHT = 6 * water.CELL
# Lamé's constants for Young's modulus 1000 and Poisson's ratio 0.3, for a density of 1.
SHEAR, LAME = 1000 / 2.6, 1000 * 0.3 / (1.3 * 0.4)
FRICTION_ANGLE = math.radians(35)
FRICTION = math.sqrt(2 / 3) * 2 * math.sin(FRICTION_ANGLE) / (3 - math.sin(FRICTION_ANGLE))

deformations = ti.Matrix.field(3, 3, ti.f32, water.COUNT)
# The logarithm of the volume that a particle has gained in tension and not lost since.
gains = ti.field(ti.f32, water.COUNT)


def main():
    is_sand, seed, folder = sys.argv[1] == "sand", int(sys.argv[2]), Path(sys.argv[3])
    height, steps = (SAND_HEIGHT, SAND_STEPS_PER_FRAME) if is_sand else (0, water.STEPS_PER_FRAME)
    folder.mkdir(parents=True, exist_ok=True)
    water.place()
    offsets = water.CELL * numpy.random.default_rng(seed).uniform(-0.25, 0.25, (water.COUNT, 3)) + [0, height, 0]
    water.positions.from_numpy((water.positions.to_numpy() + offsets).astype(numpy.float32))
    deformations.from_numpy(numpy.tile(numpy.eye(3, dtype=numpy.float32), (water.COUNT, 1, 1)))
    for frame in range(1, FRAMES + 1):
        for _ in range(steps):
            water.clear_grid()
            if is_sand:
                sand_to_grid()
                water.move_grid()
                stop_at_floor()
            else:
                water.particles_to_grid()
                water.move_grid()
            water.grid_to_particles()
            if is_sand:
                deform()
        write_frame(folder, frame, water.positions.to_numpy(), water.velocities.to_numpy())


@ti.kernel
def sand_to_grid():
    for particle in water.positions:
        base, offset, weights = water.stencil(water.positions[particle])
        rotation, stretch, _ = ti.svd(deformations[particle])
        strain = ti.Vector([ti.log(stretch[axis, axis]) for axis in ti.static(range(3))])
        diagonal = 2 * SHEAR * strain + LAME * strain.sum()
        stress = ti.Matrix.zero(ti.f32, 3, 3)
        for axis in ti.static(range(3)):
            stress[axis, axis] = diagonal[axis]
        stress = rotation @ stress @ rotation.transpose()
        affine = -4.0 * water.SECONDS_PER_STEP / water.CELL**2 * stress + water.velocity_gradients[particle]
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            node = ti.Vector([i, j, k])
            mass = water.PARTICLE_VOLUME * weights[i][0] * weights[j][1] * weights[k][2]
            velocity = water.velocities[particle] + affine @ ((node - offset) * water.CELL)
            water.grid_momenta[base + node] += mass * velocity
            water.grid_masses[base + node] += mass


@ti.kernel
def stop_at_floor():
    for cell in ti.grouped(water.grid_momenta):
        if cell[1] < water.TANK_FROM[1]:
            water.grid_momenta[cell] = ti.Vector.zero(ti.f32, 3)


@ti.kernel
def deform():
    for particle in deformations:
        change = ti.Matrix.identity(ti.f32, 3) + water.SECONDS_PER_STEP * water.velocity_gradients[particle]
        one, stretch, other = ti.svd(change @ deformations[particle])
        strain = ti.Vector([ti.log(ti.max(stretch[axis, axis], 1e-4)) for axis in ti.static(range(3))])
        strain += gains[particle] / 3
        volumetric = strain.sum()
        shear = strain - volumetric / 3
        kept = ti.Vector.zero(ti.f32, 3)
        if volumetric < 0:
            excess = shear.norm() + (3 * LAME + 2 * SHEAR) / (2 * SHEAR) * volumetric * FRICTION
            kept = strain - ti.max(excess, 0.0) * shear / ti.max(shear.norm(), 1e-12)
        gains[particle] = volumetric - kept.sum()
        for axis in ti.static(range(3)):
            stretch[axis, axis] = ti.exp(kept[axis])
        deformations[particle] = one @ stretch @ other.transpose()


if __name__ == "__main__":
    main()
