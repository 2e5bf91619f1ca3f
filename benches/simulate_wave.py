"""Moves particles with a standing wave in a box, as irregular and noisy as those of a FLIP solver.

    simulate_wave.py SEED FOLDER

Writes FOLDER/f001.ply and so on: 60 frames, 30 per second, with ids and velocities. y is up, and particles are
0.05 apart: eight at random places in each cell of twice that edge. Linear theory of waves gives the velocities,
which have no divergence, so that the density of the particles stays as it is. In each frame, a random step of
each particle stands for the noise of FLIP. The seed changes all random numbers.
"""

import sys
from pathlib import Path

import numpy

FRAMES, FRAMES_PER_SECOND, STEPS_PER_FRAME = 60, 30, 4
SPACING = 0.05
# The size of the box, and the depth of the water at rest.
LENGTH, DEPTH, WIDTH = 40 * SPACING, 16 * SPACING, 16 * SPACING
GRAVITY = 9.81
# Half waves along the length and the width of the box, and the amplitude.
WAVES = [(2, 0, 1.6 * SPACING), (1, 1, 0.8 * SPACING)]
# Standard deviation of the random step along each axis.
NOISE = 0.03 * SPACING


def main():
    random = numpy.random.default_rng(int(sys.argv[1]))
    folder = Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    positions = start(random)
    step = 1 / FRAMES_PER_SECOND / STEPS_PER_FRAME
    for frame in range(FRAMES):
        time = frame / FRAMES_PER_SECOND
        write_frame(folder, frame + 1, positions, velocities(positions, time))
        for number in range(STEPS_PER_FRAME):
            positions = moved(positions, time + number * step, step)
        positions += random.normal(0, NOISE, positions.shape)
        # Walls and floor reflect the particles.
        positions = numpy.abs(positions)
        for axis, size in [(0, LENGTH), (2, WIDTH)]:
            positions[:, axis] = numpy.minimum(positions[:, axis], 2 * size - positions[:, axis])


def start(random):
    cells = [int(size / SPACING / 2) for size in (LENGTH, 1.5 * DEPTH, WIDTH)]
    corners = numpy.indices(cells).reshape(3, -1).T.repeat(8, axis=0)
    positions = 2 * SPACING * (corners + random.random(corners.shape))
    surface = DEPTH + sum(a * shape for a, *_, shape in modes(positions))
    return positions[positions[:, 1] < surface]


def modes(positions):
    """The amplitude, the wave numbers along x and z, and the shape at the positions, of each wave."""
    for along, across, amplitude in WAVES:
        kx, kz = numpy.pi * along / LENGTH, numpy.pi * across / WIDTH
        yield amplitude, kx, kz, numpy.cos(kx * positions[:, 0]) * numpy.cos(kz * positions[:, 2])


def velocities(positions, time):
    x, y, z = positions.T
    total = numpy.zeros_like(positions)
    for amplitude, kx, kz, shape in modes(positions):
        k = numpy.hypot(kx, kz)
        frequency = numpy.sqrt(GRAVITY * k * numpy.tanh(k * DEPTH))
        speed = amplitude * frequency * numpy.sin(frequency * time) / numpy.sinh(k * DEPTH)
        total[:, 0] += speed * kx / k * numpy.cosh(k * y) * numpy.sin(kx * x) * numpy.cos(kz * z)
        total[:, 1] -= speed * numpy.sinh(k * y) * shape
        total[:, 2] += speed * kz / k * numpy.cosh(k * y) * numpy.cos(kx * x) * numpy.sin(kz * z)
    return total


def moved(positions, time, step):
    """The classical method of Runge and Kutta."""
    one = velocities(positions, time)
    two = velocities(positions + step / 2 * one, time + step / 2)
    three = velocities(positions + step / 2 * two, time + step / 2)
    four = velocities(positions + step * three, time + step)
    return positions + step / 6 * (one + 2 * two + 2 * three + four)


def write_frame(folder, number, positions, velocities):
    """Writes particles whose ids are their indices."""
    kinds = [(name, "<f4") for name in ("x", "y", "z", "vx", "vy", "vz")] + [("id", "<i4")]
    rows = numpy.empty(len(positions), kinds)
    for (name, _), column in zip(kinds, [*positions.T, *velocities.T, numpy.arange(len(positions))]):
        rows[name] = column
    lines = [f"property {'int' if kind == '<i4' else 'float'} {name}" for name, kind in kinds]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *lines, "end_header", ""]
    (folder / f"f{number:03}.ply").write_bytes("\n".join(lines).encode() + rows.tobytes())


if __name__ == "__main__":
    main()
