"""Simulates a column of water that collapses in a tank, with the material point method in Taichi.

    simulate_taichi.py FOLDER

Writes FOLDER/water_000001.ply and so on with Taichi's own writer, which closes each file after its
header and opens it again for the particles.

This work is based on:
Yuanming Hu, Yu Fang, Ziheng Ge, Ziyin Qu, Yixin Zhu, Andre Pradhana, Chenfanfu Jiang. A Moving Least Squares Material Point Method with Displacement Discontinuity and Two-Way Rigid Body Coupling. 2018
"""

import sys
from pathlib import Path

import numpy
import taichi as ti

FRAMES = 30
STEPS_PER_FRAME = 180
SECONDS_PER_STEP = 2e-4
# The grid is a cube with edge length 1, and y is up. The tank is a part of the grid, given by its first and
# last cells.
CELLS = 32
CELL = 1.0 / CELLS
TANK_FROM = (3, 3, 12)
TANK_TO = (29, 29, 20)
GRAVITY = 9.81
# Pressure at twice the density, for a density of 1.
STIFFNESS = 300.0
# Number of particles along the edges of the column, two per cell. The column is in a corner of the tank.
COLUMN = (16, 22, 16)
COUNT = COLUMN[0] * COLUMN[1] * COLUMN[2]
PARTICLE_VOLUME = (0.5 * CELL) ** 3

ti.init(arch=ti.cpu, log_level=ti.WARN, offline_cache=False)
positions = ti.Vector.field(3, ti.f32, COUNT)
velocities = ti.Vector.field(3, ti.f32, COUNT)
velocity_gradients = ti.Matrix.field(3, 3, ti.f32, COUNT)
# The volume of the water around each particle, divided by its volume at rest.
expansions = ti.field(ti.f32, COUNT)
grid_momenta = ti.Vector.field(3, ti.f32, (CELLS, CELLS, CELLS))
grid_masses = ti.field(ti.f32, (CELLS, CELLS, CELLS))


def main():
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    place()
    for frame in range(1, FRAMES + 1):
        for _ in range(STEPS_PER_FRAME):
            clear_grid()
            particles_to_grid()
            move_grid()
            grid_to_particles()
        write_frame(folder, frame)


def write_frame(folder, frame):
    writer = ti.tools.PLYWriter(num_vertices=COUNT)
    writer.add_vertex_pos(*columns(positions))
    writer.add_vertex_vel(*columns(velocities))
    writer.export_frame(frame, str(folder / "water.ply"))


def columns(field):
    return numpy.ascontiguousarray(field.to_numpy().T)


@ti.kernel
def place():
    for particle in positions:
        x = particle // (COLUMN[1] * COLUMN[2])
        y = particle // COLUMN[2] % COLUMN[1]
        z = particle % COLUMN[2]
        positions[particle] = CELL * (ti.Vector(TANK_FROM) + 0.5 * ti.Vector([x, y, z]) + 0.25)
        expansions[particle] = 1.0


@ti.kernel
def clear_grid():
    for cell in ti.grouped(grid_masses):
        grid_momenta[cell] = ti.Vector.zero(ti.f32, 3)
        grid_masses[cell] = 0.0


@ti.func
def stencil(position):
    """The first of the 27 grid nodes around a position, the offset of the position from that node in cells,
    and the weights along each axis."""
    base = ti.cast(position / CELL - 0.5, ti.i32)
    offset = position / CELL - base
    weights = [0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1.0) ** 2, 0.5 * (offset - 0.5) ** 2]
    return base, offset, weights


@ti.kernel
def particles_to_grid():
    for particle in positions:
        base, offset, weights = stencil(positions[particle])
        pressure = STIFFNESS * (1.0 - expansions[particle])
        stress = 4.0 * SECONDS_PER_STEP * PARTICLE_VOLUME * pressure / CELL**2
        affine = stress * ti.Matrix.identity(ti.f32, 3) + PARTICLE_VOLUME * velocity_gradients[particle]
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            node = ti.Vector([i, j, k])
            weight = weights[i][0] * weights[j][1] * weights[k][2]
            momentum = PARTICLE_VOLUME * velocities[particle] + affine @ ((node - offset) * CELL)
            grid_momenta[base + node] += weight * momentum
            grid_masses[base + node] += weight * PARTICLE_VOLUME


@ti.kernel
def move_grid():
    for cell in ti.grouped(grid_masses):
        if grid_masses[cell] > 0.0:
            velocity = grid_momenta[cell] / grid_masses[cell]
            velocity[1] -= GRAVITY * SECONDS_PER_STEP
            for axis in ti.static(range(3)):
                if cell[axis] < TANK_FROM[axis]:
                    velocity[axis] = ti.max(velocity[axis], 0.0)
                if cell[axis] >= TANK_TO[axis]:
                    velocity[axis] = ti.min(velocity[axis], 0.0)
            grid_momenta[cell] = velocity


@ti.kernel
def grid_to_particles():
    for particle in positions:
        base, offset, weights = stencil(positions[particle])
        velocity = ti.Vector.zero(ti.f32, 3)
        gradient = ti.Matrix.zero(ti.f32, 3, 3)
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            node = ti.Vector([i, j, k])
            weighted = weights[i][0] * weights[j][1] * weights[k][2] * grid_momenta[base + node]
            velocity += weighted
            gradient += 4.0 / CELL * weighted.outer_product(node - offset)
        velocities[particle] = velocity
        velocity_gradients[particle] = gradient
        positions[particle] += SECONDS_PER_STEP * velocity
        expansions[particle] *= 1.0 + SECONDS_PER_STEP * gradient.trace()


if __name__ == "__main__":
    main()
